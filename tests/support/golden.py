"""Checksums of everything the command line makes of small fixed inputs, to be held against a later state.

Record before a change that must not change results, compare after it, on the same machine (compiled kernels
give other last bits on other processors)::

    python tests/support/golden.py record before.json
    python tests/support/golden.py compare before.json

Values, dims, dtypes and units make the checksum of a variable, the bytes that of an exported file, words
that of a report or attribute, so that a rewritten sentence is told apart from a number that moved.
"""

import argparse
import hashlib
import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import xarray as xr

_ENVIRONMENT = {**os.environ, "PYTHONHASHSEED": "0"}
_FLIGHT = "--lines 256 --bands 64 --columns 192 --samples 4 --seed 11 --set smile_nm=1.0 --set fleet=solid"
_SWEPT = "--lines 16 --bands 136 --columns 24 --scene plan --seed 3 --sweep"
_CAMERA = "--ground 152.4 --set field_of_view=18.9 --set column_order=left_to_right"
#: What differs from run to run: places, moments and identifiers.
_RUN = re.compile(
    r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d(\.\d+)?)?(Z|\+00:00)?"
    r"|\b[0-9a-f]{32}(?:[0-9a-f]{32})?\b"
    r"|(?:attributes|crc32c)=[0-9a-f]{8}|\bhyperpaint[.\w]*|\b\d+\.\d+ ?(?:s|MB|MiB|GiB)\b"
)


def journey(folder: Path) -> list[list[str]]:
    # Return the commands, in their order; every later one reads what an earlier one wrote
    sim, lab = folder / "sim", folder / "swept"
    store, paints = folder / "lot.zarr", folder / "paints.zarr"
    regions = ["--regions", str(sim / "regions.geojson"), "--keep", "mixed_edge", "--keep", "shadow"]
    export = ["export", str(paints), "--quiet", "--format"]
    return [
        ["simulate", str(sim), *_FLIGHT.split(), "--quiet"],
        ["simulate", str(lab), *_SWEPT.split(), "--quiet"],
        ["calibrate", str(lab / "lab" / "sweep.zarr"), "--out", str(folder / "calibration.zarr"), "--quiet"],
        ["process", str(sim / "collect.toml"), "--out", str(store), "--quiet"],
        ["signatures", str(store), *regions, "--out", str(paints), "--quiet"],
        [*export, "dirsig", "--out", str(folder / "dirsig"), "--gaps", "interpolate"],
        [*export, "csv", "--out", str(folder / "paints.csv")],
        [*export, "envi", "--out", str(folder / "paints.sli")],
        ["validate", str(paints), "--reference", str(sim / "svc" / "*.sig")],
        ["orthorectify", str(store), *_CAMERA.split(), "--out", str(folder / "map.zarr"), "--quiet"],
        ["report", str(store), "--library", str(paints), "--out", str(folder / "report.html"), "--quiet"],
        ["info", str(store)],
        ["verify", str(store)],
        ["render", "--example"],
    ]


def digests(folder: Path) -> dict[str, str]:
    # Run the journey in an empty folder, and return the checksum of everything that it left or said
    sums: dict[str, str] = {}
    for command in journey(folder):
        done = subprocess.run(
            [sys.executable, "-m", "hyperpaint", *command],
            capture_output=True,
            text=True,
            check=False,
            env=_ENVIRONMENT,
        )
        said = _text(done.stdout + done.stderr, folder)
        sums[f"words: hyperpaint {command[0]} {' '.join(command[3:5]) if command[0] == 'export' else ''}"] = (
            f"exit {done.returncode}, {_sum(said.encode())}"
        )
        if done.returncode == 2:
            sys.stderr.write(done.stderr)
        if command == ["render", "--example"]:
            sums |= _rendered(folder, done.stdout)
    for path in sorted(folder.rglob("*.zarr")):
        if not any(parent.suffix == ".zarr" for parent in path.parents):
            sums |= _store(path, folder)
    for path in sorted(folder.rglob("*")):
        inside = any(parent.suffix == ".zarr" for parent in path.parents)
        if path.is_file() and not inside:
            sums |= _file(path, folder)
    return sums


def _rendered(folder: Path, example: str) -> dict[str, str]:
    # Render the example scene small, and return the checksum of what was said
    scene = folder / "scene.toml"
    small = re.sub(r"(?m)^(lines|columns|bands)( *= *)\d+", r"\g<1>\g<2>24", example)
    scene.write_text(small, encoding="utf-8")
    command = ["render", str(scene), "--out", str(folder / "scene.zarr"), "--samples", "4", "--quiet"]
    done = subprocess.run(
        [sys.executable, "-m", "hyperpaint", *command],
        capture_output=True,
        text=True,
        check=False,
        env=_ENVIRONMENT,
    )
    if done.returncode == 2:
        sys.stderr.write(done.stderr)
    return {
        "words: hyperpaint render": f"exit {done.returncode}, {_sum(_text(done.stdout, folder).encode())}"
    }


def _store(path: Path, folder: Path) -> dict[str, str]:
    sums = {}
    name = path.relative_to(folder).as_posix()
    with xr.open_datatree(path, engine="zarr", decode_timedelta=True) as tree:
        for node in tree.subtree:
            dataset = node.to_dataset(inherit=False)
            group = f"{name}{node.path}"
            for key in sorted(map(str, dataset.variables)):
                variable = dataset.variables[key]
                what = f"{variable.dims} {variable.dtype} {variable.attrs.get('units')}"
                values = np.ascontiguousarray(variable.values)
                raw = repr(values.tolist()).encode() if values.dtype.hasobject else values.tobytes()
                sums[f"values: {group}/{key}"] = _sum(what.encode() + raw)
                sums[f"attrs: {group}/{key}"] = _sum(
                    _text(json.dumps(variable.attrs, default=str), folder).encode()
                )
            sums[f"attrs: {group}"] = _sum(
                _text(json.dumps(_settled(dataset.attrs), default=str), folder).encode()
            )
    return sums


def _settled(attrs: dict[str, object]) -> dict[str, object]:
    # Return attributes without those that name a run or a version of the code
    return {
        key: value for key, value in attrs.items() if not re.search("inputs|created|history|version", key)
    }


def _file(path: Path, folder: Path) -> dict[str, str]:
    name = path.relative_to(folder).as_posix()
    raw = path.read_bytes()
    if path.suffix == ".html":
        pictures = re.findall(rb"data:image/png;base64,([A-Za-z0-9+/=]+)", raw)
        words = re.sub(rb"data:image/[^\"']*", b"", raw)
        plain = re.sub(rb"<style.*?</style>|<script.*?</script>|<[^>]*>", b" ", words, flags=re.S)
        text = " ".join(_text(plain.decode(), folder).split())
        return {f"words: {name}": _sum(text.encode()), f"pictures: {name}": _sum(b"".join(pictures))}
    try:
        text = _text(raw.decode(), folder)
    except UnicodeDecodeError:
        return {f"bytes: {name}": _sum(raw)}
    numbers = re.findall(r"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?", text)
    return {
        f"numbers: {name}": _sum(" ".join(numbers).encode()),
        f"words: {name}": _sum(text.encode()),
    }


def _text(text: str, folder: Path) -> str:
    return _RUN.sub("", text.replace(str(folder), ""))


def _sum(raw: bytes) -> str:
    return hashlib.sha256(raw).hexdigest()[:16]


def compare(before: dict[str, str], after: dict[str, str]) -> list[str]:
    # Return a line for every checksum that is missing, new or different
    return [
        f"{name}: {before.get(name, 'absent')} -> {after.get(name, 'absent')}"
        for name in sorted({*before, *after})
        if before.get(name) != after.get(name)
    ]


def main() -> int:
    # Record checksums in a file, or compare with those in it; 1 where any differ
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("action", choices=("record", "compare"))
    parser.add_argument("file", type=Path)
    parser.add_argument("--keep", type=Path, help="empty folder in which everything is left to be looked at")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = given.keep or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        sums = digests(folder)
    if given.action == "record":
        given.file.write_text(json.dumps(sums, indent=1, sort_keys=True), encoding="utf-8")
        print(f"{len(sums)} checksums in {given.file}")
        return 0
    differences = compare(json.loads(given.file.read_text(encoding="utf-8")), sums)
    print("\n".join([*differences, f"{len(sums)} checksums, {len(differences)} differ"]))
    return int(bool(differences))


if __name__ == "__main__":
    raise SystemExit(main())
