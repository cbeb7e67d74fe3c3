"""`verify`: checks whether every chunk of a store is there, readable, and what was written."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

from hyperpaint.base.errors import StoreError

from .chunks import region
from .documents import check_node
from .location import METADATA, Location
from .record import (
    CHUNKS,
    ArrayRecord,
    GroupRecord,
    attributes_checksum,
    checksum,
    has_sealed_attributes,
    metadata_checksum,
    read_record,
)

#: Names without a node that are told one by one.
_MOST_LISTED = 20

_NO_RECORDS = (
    "icechunk keeps no checksums of chunks to compare with, so read a group whole instead: where it was "
    "written with hyperpaint.encoding, a damaged chunk raises"
)


@dataclass(frozen=True)
class StoreReport:
    """What `verify` found.

    Attributes
    ----------
    path
        The store.
    groups
        Groups that hold arrays.
    chunks
        Number of chunks that were read and compared.
    problems
        One line each; empty where all is well.
    """

    path: str
    groups: tuple[str, ...]
    chunks: int
    problems: tuple[str, ...]

    @property
    def ok(self) -> bool:
        """True where nothing is wrong."""
        return not self.problems

    def __str__(self) -> str:
        state = _count(len(self.problems), "problem") if self.problems else "whole"
        held = f"{_count(len(self.groups), 'group')}, {_count(self.chunks, 'chunk')}"
        head = f"{self.path}: {held}, {state}"
        return "\n  ".join([head, *self.problems])


def _count(number: int, thing: str) -> str:
    return f"{number} {thing}{'' if number == 1 else 's'}"


def verify(path: str | os.PathLike[str]) -> StoreReport:
    """Read every chunk of a store and compare it with the completion records.

    Finds groups that were never finished, chunks that are missing, damaged, exchanged, stale or not of the
    store, metadata that were changed, and groups that are listed but gone. Safe on a store from anybody:
    what may not be read (foreign codecs and data types, chunks that would not decode to what is declared,
    links) is reported and not touched; plain `xarray.open_zarr` has no such guard.

    Parameters
    ----------
    path
        Folder or URL of the store.

    Returns
    -------
    StoreReport
        With every problem found; ``report.ok`` where there is none.

    Raises
    ------
    StoreError
        There is no Zarr store, or it has no place of its own, as a session of icechunk.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> from hyperpaint.io.store import to_store
    >>> path = to_store(xr.Dataset({"wavelength": ("band", np.arange(3.0))}), "memory://small.zarr")
    >>> print(verify(path))
    memory://small.zarr: 1 group, 1 chunk, whole
    """
    location = _location(path)
    problems: list[str] = []
    groups = location.groups()
    problems.extend(_root_problems(location, groups))
    chunks = 0
    for group in groups:
        try:
            record = read_record(location, group)
        except StoreError as error:
            problems.append(str(error))
            continue
        if record is None:
            problems.append(f"/{group}: no completion record; it was never finished, write it again")
            continue
        chunks += sum(len(array.chunks) for array in record.arrays.values())
        problems.extend(_group_problems(location, group, record))
    return StoreReport(location.url, tuple(groups), chunks, tuple(dict.fromkeys(problems)))


def _location(path: str | os.PathLike[str]) -> Location:
    try:
        location = Location.of(os.fspath(path))
    except TypeError:
        kind = type(path).__name__
        raise StoreError(
            f"a store to verify is named by its folder or URL, not by {kind}; {_NO_RECORDS}"
        ) from None
    if not location.has("", METADATA):
        msg = f"{location.url} is not a Zarr v3 store; expected a folder with a {METADATA}"
        if location.has("", "snapshots") and location.has("", "manifests"):
            msg = f"{location.url} is an icechunk repository, not a store of hyperpaint; {_NO_RECORDS}"
        raise StoreError(msg)
    return location


def _root_problems(location: Location, groups: list[str]) -> Iterator[str]:
    try:
        root = location.read_json("", METADATA) or {}
    except StoreError as error:
        yield str(error)
        return
    consolidated = root.get("consolidated_metadata")
    listed = consolidated.get("metadata") if isinstance(consolidated, dict) else None
    if not isinstance(listed, dict):
        yield "/: no consolidated metadata; run the writer again"
        return
    nodes = location.nodes()
    yield from (
        f"/{name}: its metadata cannot be read" for name, kind in nodes.items() if kind == "unreadable"
    )
    for group in ("", *(name for name, kind in nodes.items() if kind == "group")):
        yield from _folder_problems(location, group)
    gone = [name for name in listed if name not in nodes]
    for name in gone[:_MOST_LISTED]:
        yield f"/{name[:200]}: listed in the root's metadata but not there"
    if len(gone) > _MOST_LISTED:
        yield f"/: {len(gone) - _MOST_LISTED} more nodes listed in the root's metadata but not there"
    for name, document in listed.items():
        if name not in nodes:
            continue
        try:
            actual = location.metadata(name)
        except StoreError as error:
            yield str(error)
            continue
        if actual is None:
            yield f"/{name}: listed in the root's metadata but not there"
        elif not isinstance(document, dict) or not _same_node(document, actual):
            yield f"/{name}: the root's consolidated metadata are not those of the node"
    for group in groups:
        if group and group not in listed:
            yield f"/{group}: not listed in the root's consolidated metadata; run the writer again"


def _folder_problems(location: Location, group: str) -> Iterator[str]:
    """Yield what is in a group's folder and not of the store, and whether its attributes are others."""
    try:
        node, strays = location.metadata(group), location.strays(group)
    except StoreError as error:
        yield str(error)
        return
    for name in strays[:_MOST_LISTED]:
        yield f"/{group}/{name}".replace("//", "/") + ": neither a group nor an array of the store"
    if len(strays) > _MOST_LISTED:
        yield f"/{group}: {len(strays) - _MOST_LISTED} more that are neither groups nor arrays"
    if node is not None and not has_sealed_attributes(node):
        yield f"/{group}: attributes are not those that were written; run the writer again"


def _same_node(listed: dict[str, Any], actual: dict[str, Any]) -> bool:
    plain = {key: value for key, value in listed.items() if key != "consolidated_metadata"}
    return metadata_checksum(plain) == metadata_checksum(actual)


def _group_problems(location: Location, group: str, record: GroupRecord) -> Iterator[str]:
    where = f"/{group}"
    try:
        node = location.metadata(group)
    except StoreError as error:
        yield str(error)
        return
    if node is None or attributes_checksum(node) != record.attributes:
        yield f"{where}: attributes are not those recorded"
    for name, array in record.arrays.items():
        yield from _array_problems(location, group, name, array)


def _array_problems(location: Location, group: str, name: str, record: ArrayRecord) -> Iterator[str]:
    import numpy as np
    import zarr

    from .guard import guarded

    where = f"{group}/{name}" if group else name
    try:
        document = location.metadata(where)
    except StoreError as error:
        yield str(error)
        return
    if document is None:
        yield f"/{where}: the array is missing"
        return
    if metadata_checksum(document) != record.metadata:
        yield f"/{where}: metadata are not those recorded"
        return  # its chunks cannot be read without them
    try:
        form = check_node(document, f"/{where}")
        array = zarr.open_array(guarded(location), path=where, mode="r", zarr_format=3)
    except Exception as error:  # zarr's own checks have classes of their own
        yield str(error) if isinstance(error, StoreError) else f"/{where}: {type(error).__name__}: {error}"
        return
    if form is None or form.grid != record.grid:
        yield f"/{where}: has {form and form.grid} chunks, recorded are {record.grid}"
        return
    try:
        present = location.files(where)
    except StoreError as error:
        yield str(error)
        return
    positions = list(np.ndindex(record.grid))
    keys = [array.metadata.encode_chunk_key(position) for position in positions]
    for stray in sorted(present - {*keys, METADATA, CHUNKS}):
        yield f"/{where}/{stray}: not a chunk of this array"

    def problem(position: tuple[int, ...], key: str, expected: int) -> str | None:
        if key not in present:
            return f"/{where}/{key}: the chunk is missing"
        try:
            values = array[region(position, array.chunks, array.shape)] if array.ndim else array[...]
            computed = checksum(np.asarray(values))
        except Exception as error:  # a damaged chunk may raise anything that a codec raises
            return f"/{where}/{key}: cannot be read: {type(error).__name__}: {error}"
        return None if computed == expected else f"/{where}/{key}: not what was written (checksum differs)"

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        problems = pool.map(problem, positions, keys, record.chunks)
        yield from (line for line in problems if line)
