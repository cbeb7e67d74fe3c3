"""Zarr stores: written whole or not at all, readable with plain `xarray.open_zarr`."""

from __future__ import annotations

from .reader import is_complete, list_groups, open_store
from .verification import StoreReport, verify
from .writer import to_store

__all__ = ["StoreReport", "is_complete", "list_groups", "open_store", "to_store", "verify"]
