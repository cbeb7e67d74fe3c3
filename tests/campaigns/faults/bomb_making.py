"""Whole Zarr stores, and how to change them so that they look sealed all the same."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["BOMBS", "bomb", "unsealed", "whole_store"]

Bomb = Callable[[Path], Path]
BOMBS: list[tuple[Bomb, tuple[str, ...]]] = []

#: Doors that read metadata, and those that read chunks as well.
READ = ("open-store", "verify", "calibration", "foreign")
ALL = (*READ, "irradiance", "info")
NAME = "radiance_gain"
MEGA = 10**6


def bomb(*doors: str) -> Callable[[Bomb], Bomb]:
    """Register a bomb for the doors that it is put through."""

    def register(made: Bomb) -> Bomb:
        BOMBS.append((made, doors))
        return made

    return register


def sealed_store(folder: Path) -> Path:
    """Write a whole store that every door would let in: a calibration and a series of irradiance in one."""
    import xarray as xr

    import hyperpaint as hp

    units = {"units": "W m-2 sr-1 nm-1 s count-1"}
    stamps = np.datetime64("2024-05-21T12:00:00", "ns") + np.arange(8) * np.timedelta64(1, "s")
    nm = {"units": "nm"}
    made = xr.Dataset(
        {
            NAME: (("band", "cross_track"), np.full((4, 6), 1e-8, "f4"), units),
            "irradiance": (
                ("irradiance_time", "irradiance_wavelength"),
                np.full((8, 60), 1.0, "f4"),
                {"units": "W m-2 nm-1"},
            ),
            "note": ((), "text"),
        },
        {
            "wavelength": ("band", [500.0, 550.0, 600.0, 650.0], nm),
            "fwhm": ("band", [6.0] * 4, nm),
            "irradiance_time": stamps,
            "irradiance_wavelength": ("irradiance_wavelength", np.arange(400.0, 1000, 10), nm),
        },
        {"srf_shape": "gaussian"},
    )
    return hp.to_store(made, folder / "lot.zarr")


def whole_store(folder: Path) -> Path:
    """Write what is no bomb."""
    return sealed_store(folder)


def seal(store: Path, *, grids: bool = True) -> Path:
    """Make the records fit what is there now, as whoever forges a store would."""
    from hyperpaint.io.store import record as records

    digests = {}
    for path in sorted(store.glob("*/hyperpaint-chunks.json")):
        document = json.loads((path.parent / "zarr.json").read_bytes())
        kept = json.loads(path.read_bytes())
        kept["metadata"] = records.metadata_checksum(document)
        grid = _grid(document)
        if grids and grid is not None and grid != kept["grid"] and np.prod(grid) < 10**5:
            kept |= {"grid": grid, "crc32c": [0] * int(np.prod(grid))}
        path.write_text(json.dumps(kept))
        digests[path.parent.name] = records.metadata_checksum(kept)
    root = json.loads((store / "zarr.json").read_bytes())
    token = root["attributes"]["hyperpaint_complete"].partition(" ")[0]
    text = f"{token} chunks={records.metadata_checksum(digests):08x} "
    text += f"attributes={records.attributes_checksum(root):08x}"
    root["attributes"]["hyperpaint_complete"] = text
    (store / "zarr.json").write_text(json.dumps(root))
    return store


def unsealed(store: Path) -> Path:
    """Make a store one that hyperpaint never wrote."""
    for path in store.rglob("hyperpaint-chunks.json"):
        path.unlink()
    root = store / "zarr.json"
    if root.is_file():
        root.write_bytes(root.read_bytes().replace(b'"hyperpaint_', b'"other_'))
    return store


def _grid(document: dict[str, Any]) -> list[int] | None:
    try:
        chunk = document["chunk_grid"]["configuration"]["chunk_shape"]
        return [-(-size // step) for size, step in zip(document["shape"], chunk, strict=True)]
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return None


def altered(folder: Path, name: str = NAME, **entries: Any) -> Path:
    """Write a sealed store in which an array's metadata have other entries."""
    store = sealed_store(folder)
    path = store / name / "zarr.json"
    path.write_text(json.dumps({**json.loads(path.read_bytes()), **entries}))
    return seal(store)


def codec_chain(*last: dict[str, Any], first: str = "bytes") -> list[dict[str, Any]]:
    little = {"configuration": {"endian": "little"}} if first == "bytes" else {}
    return [{"name": first, **little}, *last]


def blosc(**configuration: Any) -> dict[str, Any]:
    known = {"typesize": 4, "cname": "lz4", "clevel": 5, "shuffle": "bitshuffle", "blocksize": 0}
    return {"name": "blosc", "configuration": {**known, **configuration}}


ZSTD = {"name": "zstd", "configuration": {"level": 1, "checksum": False}}
GZIP = {"name": "gzip", "configuration": {"level": 5}}


def framed(folder: Path, frame: bytes, *codecs: dict[str, Any], name: str = NAME, **entries: Any) -> Path:
    """Write a sealed store in which a chunk is ``frame``, its array declaring ``codecs``."""
    first = "vlen-utf8" if name == "note" else "bytes"
    store = altered(folder, name, codecs=codec_chain(*codecs, first=first), **entries)
    chunk = next(path for path in (store / name / "c", store / name / "c/0/0") if path.is_file())
    chunk.write_bytes(frame)
    return store


def grid_of(*chunk: int) -> dict[str, Any]:
    return {"name": "regular", "configuration": {"chunk_shape": list(chunk)}}


def sizes(*chunk: int) -> dict[str, Any]:
    """Return the entries of an array of one chunk."""
    return {"shape": list(chunk), "chunk_grid": grid_of(*chunk)}
