"""Damaged stores: nothing that was changed on disk may be taken for what was written."""

import json
import random
import shutil
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import xarray as xr

import hyperpaint as hp
from hyperpaint.base.errors import PaintError
from hyperpaint.io.store.manifest import OWN_ATTRS

from .outcome import Outcome, in_parallel, numbers_of, parts_of

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


#: New content of some files; None where a file is deleted.
Damage = Mapping[Path, bytes | None]


def build(folder: Path) -> None:
    # Write a store of a line and its irradiance, and the same with another scene, for stale chunks
    from hyperpaint.simulation import simulate_line

    for name, seed in (("store.zarr", 1), ("older.zarr", 2)):
        line = simulate_line(lines=70, bands=6, columns=8, seed=seed, dropped=2)
        small = line[["irradiance", "irradiance_fwhm", "irradiance_max_gap"]]
        hp.to_store(line, folder / name, GROUP)
        hp.to_store(small, folder / name, "irradiance")


def _files(store: Path) -> dict[Path, bytes]:
    return {path.relative_to(store): path.read_bytes() for path in sorted(store.rglob("*")) if path.is_file()}


def _burst(data: bytearray, place: int, rng: random.Random) -> None:
    length = rng.randrange(2, 513)
    data[place : place + length] = rng.randbytes(len(data[place : place + length]))


def _flip(data: bytearray, place: int, rng: random.Random) -> None:
    data[place] ^= 1 << rng.randrange(8)


#: Damages of one file at a place.
_IN_PLACE: Mapping[str, Callable[[bytearray, int, random.Random], None]] = {
    "bit flip": _flip,
    "burst": _burst,
    "truncation": lambda data, place, _: data.__delitem__(slice(place, None)),
}


def _make(
    kind: str, files: Mapping[Path, bytes], older: Mapping[Path, bytes], rng: random.Random
) -> Damage | None:
    # Return a fault of a kind, or None where this draw would change nothing
    # every array and document is as likely as any other: chosen by folder first
    folder = rng.choice(sorted({path.parent for path in files}))
    path = rng.choice([path for path in files if path.parent == folder])
    if kind in ("deletion", "zero length"):
        return {path: None if kind == "deletion" else b""}
    if kind == "swapped":
        other = rng.choice([p for p in files if p.name == "zarr.json" or "c" in p.parts])
        return None if files[other] == files[path] else {path: files[other], other: files[path]}
    if kind == "stale":
        return (
            {path: older[path]} if "c" in path.parts and older.get(path, files[path]) != files[path] else None
        )
    data = bytearray(files[path])
    _IN_PLACE[kind](data, rng.randrange(len(data)), rng)
    return None if _means_the_same(bytes(data), files[path]) else {path: bytes(data)}


def _means_the_same(damaged: bytes, whole: bytes) -> bool:
    # Tell whether two files are equal, or JSON that differs in blanks only
    if damaged == whole:
        return True
    try:
        return bool(json.loads(damaged) == json.loads(whole))
    except ValueError:  # UnicodeDecodeError is one
        return False


def _verify(store: Path) -> str:
    # Return what `hyperpaint.verify` says: ``found``, ``missed``, or the error that it should not raise
    try:
        return "missed" if hp.verify(store).ok else "found"
    except PaintError:
        return "found"
    except Exception as error:
        return f"verify raised {type(error).__name__}: {error!s:.150}"


def _opened(store: Path, whole: Mapping[str, xr.Dataset]) -> str:
    # Return what `open_store` hands out: ``refused`` by us or by zarr, ``same`` values, or ``missed``
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
    # Return what a plain reader notices: ``error``, ``same`` values, or ``missed``
    try:
        loaded = {name: xr.open_zarr(store, group=name).load() for name in whole}
    except Exception:
        return "error"
    return "same" if all(loaded[name].identical(whole[name]) for name in whole) else "missed"


def run_part(folder: Path, kind: str, numbers: range) -> list[Outcome]:
    # Try faults ``numbers`` of a kind, each on a whole store; return what verify and two readers saw
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
            for path, data in fault.items():
                (store / path).unlink() if data is None else (store / path).write_bytes(data)
            in_chunks, where = all("c" in path.parts for path in fault), ", ".join(map(str, fault))
            verified.count += 1
            if (said := _verify(store)) != "found":
                verified.wrong.append(f"{kind} {number} in {where}: {said}")
            ours.count += 1
            said = _opened(store, whole)
            if said == "missed" and kind in _VERIFY_ONLY and in_chunks:
                ours.notes["verify only"] += 1
            elif said == "missed":
                ours.wrong.append(f"{kind} {number} in {where}: {said}")
            elif said == "same":  # what was damaged is not of what is read, as the list in the root
                ours.notes["read as written"] += 1
            said = _plain(store, whole) if kind in _PLAIN else ""
            if said and in_chunks:
                plain.count += 1
                if said != "error":
                    plain.wrong.append(f"{kind} {number} in {where}: {said}")
            elif said == "missed":  # no checksum of Zarr's covers metadata: that is what verify is for
                plain.notes["in metadata missed"] += 1
            for path in fault:
                (store / path).write_bytes(files[path])
        if not hp.verify(store).ok:  # the next fault would be found for the sake of this one
            msg = f"{kind} {numbers}: the store was not whole again"
            raise RuntimeError(msg)
    return [verified, ours, plain] if plain.count else [verified, ours]


def _run(part: tuple[Path, str, range]) -> list[Outcome]:
    return run_part(*part)


def campaign(scale: float = 1.0, *, first: int = 0) -> Iterator[Outcome]:
    # Yield the outcomes of every part
    with tempfile.TemporaryDirectory() as scratch:
        build(Path(scratch))
        yield from in_parallel(
            _run,
            [
                (Path(scratch), kind, part)
                for kind, full in COUNTS.items()
                for part in parts_of(numbers_of(full, scale, first), _PART)
            ],
        )
