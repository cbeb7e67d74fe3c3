"""Open stores, and refuse what was never finished."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

from hyperpaint.errors import IncompleteStoreError, StoreError

from .location import Location, clean_group
from .record import GroupRecord, metadata_checksum, read_record

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["is_complete", "list_groups", "open_store"]


def list_groups(path: str | os.PathLike[str]) -> list[str]:
    """Return the groups of a store that hold arrays, finished or not, sorted; the root is ``""``.

    Raises
    ------
    StoreError
        There is no Zarr store.
    """
    location = Location.of(path)
    if location.read_json("", "zarr.json") is None:
        msg = f"{location.url} is not a Zarr v3 store; expected a folder with a zarr.json"
        raise StoreError(msg)
    return location.groups()


def is_complete(path: str | os.PathLike[str], group: str | None = None) -> bool:
    """Tell whether a group was finished: it is sealed, and its arrays are those recorded.

    Cheap: no chunk is read. That every chunk is there and right is checked by `hyperpaint.verify`.
    """
    try:
        _complete_record(Location.of(path), clean_group(group))
    except StoreError:
        return False
    return True


def open_store(path: str | os.PathLike[str], group: str | None = None, **kwargs: Any) -> xr.Dataset:
    """Open a finished group lazily, like `xarray.open_zarr`.

    Parameters
    ----------
    path
        Folder or URL of the store.
    group
        Group inside it; by default the root.
    **kwargs
        Passed to `xarray.open_zarr`, such as ``chunks={"along_track": 256}``.

    Returns
    -------
    xarray.Dataset
        With one dask chunk to a storage chunk, unless ``chunks`` says otherwise.

    Raises
    ------
    IncompleteStoreError
        The group was never finished, or its metadata are damaged.
    StoreError
        There is no such store or group; those that exist are listed.
    """
    import xarray as xr

    location, name = Location.of(path), clean_group(group)
    _complete_record(location, name)
    # the root's consolidated metadata may be older than a group whose writer was killed just before the end
    opened: xr.Dataset = xr.open_zarr(location.url, group=name or None, **{"consolidated": False, **kwargs})
    return opened


def _complete_record(location: Location, group: str) -> GroupRecord:
    """Return the record of a finished group, or raise."""
    where = f"group {'/' + group!r} of {location.url}"
    node = location.metadata(group)
    if node is None or node.get("node_type") != "group":
        found = ", ".join("/" + name for name in location.groups()) or "none"
        msg = f"there is no {where}; groups found: {found}"
        raise StoreError(msg)
    record = read_record(location, group)
    if record is None:
        msg = f"{where} has no completion record: it was never finished, or not by hyperpaint; write it again"
        raise IncompleteStoreError(msg)
    for name, array in record.arrays.items():
        document = location.metadata(group, name)
        if document is None or metadata_checksum(document) != array.metadata:
            state = "is missing" if document is None else "has metadata other than recorded"
            msg = f"array {name!r} in {where} {state}; write the group again"
            raise IncompleteStoreError(msg)
    return record
