"""Open stores, and refuse what was never finished, or may not be read at all.

Whoever wrote a store, nothing of it is decoded before its metadata (`documents`) and each chunk as it is read
(`guard`) have been checked. What only all chunks together show, `verification` finds.
"""

from __future__ import annotations

import os
import warnings
from typing import TYPE_CHECKING, Any, overload

from hyperpaint.base.errors import IncompleteStoreError, PaintWarning, Problems, StoreError
from hyperpaint.base.schema import BAND, CROSS_TRACK, stamp_means

from .documents import check_node
from .groups import groups_above
from .location import Location, clean_group
from .record import (
    PLACE,
    SET,
    SETTINGS,
    GroupRecord,
    attributes_checksum,
    has_sealed_attributes,
    metadata_checksum,
    read_record,
    read_seal,
    recorded_form,
)
from .root_record import check_member, check_set, is_misplaced, set_stamp

if TYPE_CHECKING:
    import xarray as xr

MOST_LOADED_BYTES = 2**30
"""Bytes of all arrays of a group that is loaded at once."""


def list_groups(path: str | os.PathLike[str]) -> list[str]:
    """Return the groups of a store that hold arrays, finished or not, sorted; the root is ``""``.

    Raises
    ------
    StoreError
        There is no Zarr store.
    """
    location = Location.of(path)
    if location.read_json("", "zarr.json") is None:
        raise StoreError(f"{location.url} is not a Zarr v3 store; expected a folder with a zarr.json")
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


@overload
def open_store(path: str | os.PathLike[str], group: str, **kwargs: Any) -> xr.Dataset: ...


@overload
def open_store(path: str | os.PathLike[str], group: None = None, **kwargs: Any) -> Any: ...


def open_store(path: str | os.PathLike[str], group: str | None = None, **kwargs: Any) -> Any:
    """Open a finished group lazily, like `xarray.open_zarr`, or all of a collect's store.

    The store must hold the groups that it is to hold, by its root record: none unfinished, deleted, swapped
    or foreign, none of other settings (of a single group its own part of that is looked at, and that the
    store is finished). The group must be sealed and its metadata those recorded; each chunk must be there and
    hold what was recorded for it, which shows when it is read. A group that is replaced while it is open is
    not read any further: open it again. All chunks at once are checked by `hyperpaint.verify`.

    Parameters
    ----------
    path
        Folder or URL of the store.
    group
        Group inside it, ``""`` for the root; by default the root, or all groups where that holds no arrays.
    **kwargs
        Passed to `xarray.open_zarr`, such as ``chunks={"along_track": 256}``.

    Returns
    -------
    xarray.Dataset or xarray.DataTree
        With one dask chunk to a storage chunk, or to those of all bands, unless ``chunks`` says otherwise. A
        tree of all groups where they were asked for.

    Raises
    ------
    IncompleteStoreError
        The store is not whole, the group was never finished, or its metadata are damaged; on reading values,
        a chunk is missing or is not what was written, or the group was replaced since.
    StoreError
        There is no such store or group (those that exist are listed); or it holds what is not read: codecs,
        data types, sizes or links that no store of ours has.

    Warns
    -----
    PaintWarning
        Whether the store lacks groups is not known: it was written by hyperpaint 0.1, which kept no record of
        them, or is a part without its root. Or, of a tree, groups were made by other numerics.

    See Also
    --------
    open_group : A finished group of a store that is still being written.

    Examples
    --------
    >>> import xarray as xr
    >>> from hyperpaint.io.store import to_store
    >>> light = xr.Dataset({"wavelength": ("band", [450.0, 550.0])})
    >>> path = to_store(light, "memory://small_collect.zarr", "flightlines/raw_0")
    >>> open_store(path, "flightlines/raw_0").wavelength.values
    array([450., 550.])
    >>> sorted(open_store(path)["flightlines"].children)
    ['raw_0']
    """
    location, name = Location.of(path), clean_group(group)
    if group is None and (groups := location.groups()) and "" not in groups:
        return _opened_tree(location, **kwargs)
    if (node := location.metadata(name)) is not None:
        _warn(check_member(location, name, node), 3)
    return open_group(path, name, **kwargs)


def _warn(notes: tuple[str, ...], stacklevel: int) -> None:
    for note in notes:
        warnings.warn(note, PaintWarning, stacklevel)


def open_group(path: str | os.PathLike[str], group: str, **kwargs: Any) -> xr.Dataset:
    """Open a finished group as `open_store` does, also while others of its store are still being written.

    So a run can be followed, line by line. Whether the store holds all that it is to hold is not looked at.

    Raises
    ------
    IncompleteStoreError, StoreError
        As `open_store`, of this group.
    """
    location, name = Location.of(path), clean_group(group)
    before = read_seal(location, name)
    try:
        record = _complete_record(location, name)
        return _opened(location, name, record.seal, record, **kwargs)
    except IncompleteStoreError as error:
        if before is None or read_seal(location, name) == before:
            raise
        # what was read is partly of one version, partly of the other
        raise IncompleteStoreError(
            f"group {'/' + name!r} of {location.url} was replaced while it was opened; open it again"
        ) from error


def _opened_tree(location: Location, **kwargs: Any) -> xr.DataTree:
    """Open all groups, as they were at one instant."""
    for _ in range(2):
        begin = set_stamp(location)
        try:
            groups = location.groups()
            notes = check_set(location, groups)
            opened = _opened_groups(location, groups, **kwargs)
        except IncompleteStoreError:
            if set_stamp(location) == begin:
                raise
        else:
            if set_stamp(location) == begin:
                _warn(notes, 4)
                return opened
    raise IncompleteStoreError(f"{location.url} was written to while it was opened; open it again")


def _opened_groups(location: Location, groups: list[str], **kwargs: Any) -> xr.DataTree:
    import xarray as xr

    problems = Problems(f"{location.url} cannot be opened whole", IncompleteStoreError)
    opened: dict[str, xr.Dataset | xr.DataTree] = {}
    for group in groups:
        try:
            opened[group] = open_group(location.url, group, **kwargs)
        except IncompleteStoreError as error:
            problems.add(str(error), mend="open the others by open_store(path, group)")
    for above in dict.fromkeys(each for group in groups for each in groups_above(group) if each):
        try:
            node = location.metadata(above)
            intact = node is not None and has_sealed_attributes(node)
        except IncompleteStoreError:
            intact = False
        if not intact:
            problems.add(f"the metadata of /{above} are missing or damaged; write one of its groups again")
    problems.raise_if_any()
    return xr.DataTree.from_dict(opened)


def open_unverified(path: str | os.PathLike[str], group: str | None = None, **kwargs: Any) -> xr.Dataset:
    """Open a group lazily, finished or not, by hyperpaint or not; its chunks are checked as they are read.

    Raises
    ------
    StoreError
        There is no such store or group, or it holds what is not read.
    """
    location, name = Location.of(path), clean_group(group)
    node = location.metadata(name)
    if node is None:
        old = any(location.has(name, file) for file in (".zgroup", ".zarray", ".zmetadata"))
        hint = "; it is Zarr 2: rewrite it with xarray's to_zarr(..., zarr_format=3)" if old else ""
        raise StoreError(f"there is no group {'/' + name!r} of Zarr 3 in {location.url}{hint}")
    check_node(node, location.key(name))
    return _opened(location, name, str(metadata_checksum(node)), None, **kwargs)


def load_unverified(path: str | os.PathLike[str], group: str | None = None) -> xr.Dataset:
    """Load a small group whole, finished or not, by hyperpaint or not.

    Raises
    ------
    StoreError
        As `open_unverified`; or its arrays are larger than `MOST_LOADED_BYTES` together.
    """
    opened = open_unverified(path, group, chunks=None)
    if opened.nbytes > MOST_LOADED_BYTES:
        raise StoreError(
            f"{os.fspath(path)} declares {opened.nbytes} bytes, expected at most {MOST_LOADED_BYTES}"
        )
    return opened.load()


def _opened(
    location: Location, group: str, content: str, record: GroupRecord | None, **kwargs: Any
) -> xr.Dataset:
    import xarray as xr

    from .guard import guarded, stored_codecs

    store = guarded(location, group=group, record=record, content=content)
    # the root's consolidated metadata may be older than a group whose writer was killed just before the end
    options = {"consolidated": False, **kwargs}
    arrays = {} if record is None or "chunks" in options else record.arrays
    grouped = {name for name, array in arrays.items() if len(array.grid) == 3 and max(array.grid[1:]) > 1}
    if grouped:  # one task a slab, also of cubes that are cut into bands or tiles
        options["chunks"] = {BAND: -1, CROSS_TRACK: -1}
    try:
        opened: xr.Dataset = xr.open_zarr(store, group=group or None, **options)
        if COARSE in grouped:  # of which a picture of one band reads its group alone
            others = [name for name in arrays if name != COARSE]
            options |= {"chunks": {}, "drop_variables": others}
            opened[COARSE] = xr.open_zarr(store, group=group or None, **options)[COARSE].variable
    except StoreError:
        raise
    except Exception as error:  # zarr, numpy and xarray's decoding each have their own
        raise StoreError(
            f"{location.group_url(group)} cannot be opened: {type(error).__name__}: {error!s:.300}"
        ) from error
    if COARSE in opened.variables:
        stamp_means(opened[COARSE], opened)
    for name, variable in opened.variables.items():
        variable.encoding["compressors"] = stored_codecs(store, f"{group}/{name}".lstrip("/"))
    opened.encoding["source"] = location.url
    for name in (SET, PLACE, SETTINGS):  # of the place, not of what is made from it
        opened.attrs.pop(name, None)
    return opened


COARSE = "coarse_reflectance"


def _complete_record(location: Location, group: str) -> GroupRecord:
    """Return the record of a finished group, or raise."""
    where = f"group {'/' + group!r} of {location.url}"
    node = location.metadata(group)
    if node is None or node.get("node_type") != "group":
        others = ", ".join("/" + name for name in location.groups()) or "none"
        raise StoreError(f"there is no {where}; groups found: {others}")
    if is_misplaced(node, location, group):
        place = node["attributes"][PLACE]
        raise IncompleteStoreError(
            f"{where} was swapped or copied: by its own record it is {place!s:.200}; write the group again"
        )
    record = read_record(location, group)
    if record is None:
        raise IncompleteStoreError(
            f"{where} has no completion record: it was never finished, or not by hyperpaint; write it again"
        )
    if attributes_checksum(node) != record.attributes:
        raise IncompleteStoreError(f"{where} has attributes other than recorded; write the group again")
    for name, array in record.arrays.items():
        recorded_form(location, group, name, array)
    return record
