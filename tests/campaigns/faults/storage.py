"""Damaged stores: nothing that was changed on disk may be taken for what was written."""

from __future__ import annotations

import json
import random
import shutil
import tempfile
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import xarray as xr

import hyperpaint as hp
from hyperpaint.base.errors import PaintError
from hyperpaint.io.store.manifest import OWN_ATTRS

from .outcome import Outcome, in_parallel

__all__ = ["COUNTS", "build", "campaign", "run_part"]

#: Faults of each kind at full count.
COUNTS: Mapping[str, int] = {
    "bit flip": 1000,
    "burst": 500,
    "truncation": 300,
    "deletion": 200,
    "zero length": 100,
    "swapped": 100,
    "stale": 100,
}
#: What the codec's own checksum must show to any reader of Zarr, wherever chunks are damaged.
_PLAIN = ("bit flip", "burst", "truncation")
#: Whole chunks in another's place have the right checksum: `verify` alone tells them.
_VERIFY_ONLY = ("swapped", "stale")
GROUP = "flightlines/raw_0"
_PART = 50


@dataclass(frozen=True)
class _Fault:
    """New content of some files; None where a file is deleted."""

    files: Mapping[Path, bytes | None]

    @property
    def in_chunks(self) -> bool:
        return all("c" in path.parts for path in self.files)

    def __str__(self) -> str:
        return ", ".join(map(str, self.files))


def build(folder: Path) -> None:
    """Write a store of a line and its irradiance, and the same with another scene, for stale chunks."""
    from hyperpaint.simulation import simulate_line

    for name, seed in (("store.zarr", 1), ("older.zarr", 2)):
        line = simulate_line(lines=70, bands=6, columns=8, seed=seed, dropped=2)
        small = line[["irradiance", "irradiance_fwhm", "irradiance_max_gap"]]
        hp.to_store(line, folder / name, GROUP)
        hp.to_store(small, folder / name, "irradiance")


def _files(store: Path) -> dict[Path, bytes]:
    return {path.relative_to(store): path.read_bytes() for path in sorted(store.rglob("*")) if path.is_file()}


def _make(
    kind: str, files: Mapping[Path, bytes], older: Mapping[Path, bytes], rng: random.Random
) -> _Fault | None:
    """Return a fault of a kind, or None where this draw would change nothing."""
    # every array and document is as likely as any other: chosen by folder first
    folder = rng.choice(sorted({path.parent for path in files}))
    path = rng.choice([path for path in files if path.parent == folder])
    data = bytearray(files[path])
    if kind == "deletion":
        return _Fault({path: None})
    if kind == "zero length":
        return _Fault({path: b""})
    if kind == "swapped":
        other = rng.choice([p for p in files if p.name == "zarr.json" or "c" in p.parts])
        if files[other] == files[path]:
            return None
        return _Fault({path: files[other], other: files[path]})
    if kind == "stale":
        if "c" not in path.parts or older.get(path, files[path]) == files[path]:
            return None
        return _Fault({path: older[path]})
    place = rng.randrange(len(data))
    if kind == "bit flip":
        data[place] ^= 1 << rng.randrange(8)
    elif kind == "burst":
        length = rng.randrange(2, 513)
        data[place : place + length] = rng.randbytes(len(data[place : place + length]))
    else:
        del data[place:]
    return None if _means_the_same(bytes(data), files[path]) else _Fault({path: bytes(data)})


def _means_the_same(damaged: bytes, whole: bytes) -> bool:
    """Tell whether two files are equal, or JSON that differs in blanks only."""
    if damaged == whole:
        return True
    try:
        return bool(json.loads(damaged) == json.loads(whole))
    except ValueError:  # UnicodeDecodeError is one
        return False


def _verify(store: Path) -> str:
    """Return what `hyperpaint.verify` says: ``found``, ``missed``, or the error that it should not raise."""
    try:
        return "missed" if hp.verify(store).ok else "found"
    except PaintError:
        return "found"
    except Exception as error:
        return f"verify raised {type(error).__name__}: {error!s:.150}"


def _opened(store: Path, whole: Mapping[str, xr.Dataset]) -> str:
    """Return what `open_store` hands out: ``refused`` by us or by zarr, ``same`` values, or ``missed``."""
    try:
        loaded = {name: hp.open_store(store, name).load() for name in whole}
    except Exception:  # zarr and its codecs have errors of their own
        return "refused"
    for name, group in whole.items():
        attrs = {key: value for key, value in group.attrs.items() if key not in OWN_ATTRS}
        if not loaded[name].identical(group.assign_attrs().drop_attrs(deep=False).assign_attrs(attrs)):
            return "missed"
    return "same"


def _plain(store: Path, whole: Mapping[str, xr.Dataset]) -> str:
    """Return what a plain reader notices: ``error``, ``same`` values, or ``missed``."""
    try:
        loaded = {name: xr.open_zarr(store, group=name).load() for name in whole}
    except Exception:
        return "error"
    return "same" if all(loaded[name].identical(whole[name]) for name in whole) else "missed"


def run_part(folder: Path, kind: str, numbers: range) -> list[Outcome]:
    """Try faults ``numbers`` of a kind, each on a whole store; return what verify and two readers saw."""
    older = _files(folder / "older.zarr")
    verified, plain = Outcome(f"store, verify: {kind}"), Outcome(f"store, xr.open_zarr: {kind}")
    ours = Outcome(f"store, open_store: {kind}")
    with tempfile.TemporaryDirectory() as scratch, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        store = Path(scratch) / "store.zarr"
        shutil.copytree(folder / "store.zarr", store)
        files = _files(store)
        whole = {name: xr.open_zarr(store, group=name).load() for name in (GROUP, "irradiance")}
        for number in numbers:
            rng = random.Random(f"{kind}:{number}")
            while (fault := _make(kind, files, older, rng)) is None:
                pass
            for path, data in fault.files.items():
                (store / path).unlink() if data is None else (store / path).write_bytes(data)
            verified.count += 1
            if (said := _verify(store)) != "found":
                verified.wrong.append(f"{kind} {number} in {fault}: {said}")
            ours.count += 1
            said = _opened(store, whole)
            if said == "missed" and kind in _VERIFY_ONLY and fault.in_chunks:
                ours.notes["verify only"] += 1
            elif said == "missed":
                ours.wrong.append(f"{kind} {number} in {fault}: {said}")
            elif said == "same":  # what was damaged is not of what is read, as the list in the root
                ours.notes["read as written"] += 1
            said = _plain(store, whole) if kind in _PLAIN else ""
            if said and fault.in_chunks:
                plain.count += 1
                if said != "error":
                    plain.wrong.append(f"{kind} {number} in {fault}: {said}")
            elif said == "missed":  # no checksum of Zarr's covers metadata: that is what verify is for
                plain.notes["in metadata missed"] += 1
            for path in fault.files:
                (store / path).write_bytes(files[path])
        if not hp.verify(store).ok:  # the next fault would be found for the sake of this one
            msg = f"{kind} {numbers}: the store was not whole again"
            raise RuntimeError(msg)
    return [verified, ours, plain] if plain.count else [verified, ours]


def _run(part: tuple[Path, str, range]) -> list[Outcome]:
    return run_part(*part)


def campaign(scale: float = 1.0, *, first: int = 0) -> Iterator[Outcome]:
    """Yield the outcomes of every part."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        build(folder)
        parts = []
        for kind, full in COUNTS.items():
            last = first + max(1, round(full * scale))
            parts += [
                (folder, kind, range(start, min(start + _PART, last))) for start in range(first, last, _PART)
            ]
        yield from in_parallel(_run, parts)
