"""Zarr stores: written completely or not at all, readable with plain `xarray.open_zarr`.

In: datasets and trees of them (`to_store`), or a store's path. Out: a store with a checksum for every chunk,
groups opened lazily and checked as they are read, a report of `verify`. Called by io, workflows and the user.
"""

from .computing import encoding
from .reader import (
    StoreReport,
    is_complete,
    list_groups,
    load_group,
    open_group,
    open_store,
    open_unverified,
    verify,
)
from .writer import to_store

__all__ = [
    "StoreReport",
    "encoding",
    "is_complete",
    "list_groups",
    "load_group",
    "open_group",
    "open_store",
    "open_unverified",
    "to_store",
    "verify",
]
