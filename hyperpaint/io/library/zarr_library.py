"""Paint libraries in Zarr stores."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from hyperpaint.base.errors import FormatError
from hyperpaint.base.schema import LIBRARY_VARIABLES, PAINT
from hyperpaint.io.store import list_groups, open_store, to_store

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["read_zarr_library", "write_zarr_library"]


def write_zarr_library(
    library: xr.Dataset, path: Path, *, overwrite: bool, progress: Callable[[int, int], None] | None
) -> None:
    """Write a checked library with `hyperpaint.to_store`.

    Raises
    ------
    StoreError
        As `hyperpaint.to_store`.
    """
    total = library.sizes[PAINT]
    if progress is not None:
        progress(0, total)
    to_store(library, path, overwrite=overwrite)
    if progress is not None:
        progress(total, total)


def read_zarr_library(path: str | os.PathLike[str]) -> xr.Dataset:
    """Open a library lazily.

    Raises
    ------
    FormatError
        The store is whole but holds no paint library; groups that do are named.
    StoreError
        It is not whole, or no store.
    """
    groups = list_groups(path)
    if "" not in groups:
        named = ", ".join(f"{os.fspath(path)}/{group}" for group in groups) or "none"
        raise FormatError(f"{os.fspath(path)} holds no paint library at its root; groups found: {named}")
    library = open_store(path)
    rows = {name: LIBRARY_VARIABLES[name] for name in (PAINT, "reflectance", "wavelength")}
    missing = [name for name in rows if name not in library.variables]
    wrong = [row.dim_problem(library[name]) for name, row in rows.items() if name not in missing]
    if missing or any(wrong):
        told = "; ".join([f"{name!r} is missing" for name in missing] + [text for text in wrong if text])
        raise FormatError(f"{os.fspath(path)} holds no paint library: {told}")
    return library
