"""Irradiance series that lie in a Zarr or netCDF store, a collect's own among them."""

from __future__ import annotations

from pathlib import Path

import xarray as xr

from hyperpaint.base.errors import FormatError, IncompleteStoreError
from hyperpaint.io.files.reading import load_netcdf

__all__ = ["is_store", "stored_series"]

_SUFFIXES = (".zarr", ".nc", ".nc4", ".h5")
_FILES = ("zarr.json", ".zgroup", ".zattrs")


def is_store(path: Path) -> bool:
    """Tell whether a path is a Zarr or netCDF store, by its name or by what is in it."""
    return path.suffix.lower() in _SUFFIXES or any((path / name).exists() for name in _FILES)


def stored_series(path: Path) -> xr.Dataset:
    """Return the dataset that holds the series: the root, or of a collect's store its group irradiance."""
    from hyperpaint.io.store import load_unverified, open_store
    from hyperpaint.io.store.location import Location

    group, ours = None, False
    try:
        if not path.is_dir():
            return load_netcdf(path)
        location = Location.of(path)
        inner, node = location.metadata("irradiance") or {}, location.metadata("") or {}
        if inner.get("node_type") == "group":
            group, node = "irradiance", inner
        ours = "hyperpaint_format" in (node.get("attributes") or {})
        # ours is refused where it was never finished
        return open_store(path, group, chunks=None).load() if ours else load_unverified(path, group)
    except IncompleteStoreError as error:
        if ours:
            raise
        raise FormatError(f"{path}: cannot be opened as a Zarr store ({error})") from error
    except Exception as error:  # zarr, h5py and xarray leak classes of their own on damaged stores
        raise FormatError(
            f"{path}: cannot be opened as a Zarr or netCDF store ({type(error).__name__}: {error})"
        ) from error
