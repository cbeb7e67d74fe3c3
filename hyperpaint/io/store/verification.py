"""`verify`: checks whether every chunk of a store is there, readable, and what was written."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

from hyperpaint.base.errors import StoreError

from .budget import counted
from .chunks import region
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
    recorded_form,
)
from .root_record import set_stamp, set_state

#: Most names without a node, and most strays of a folder, that are listed one by one.
_MOST_LISTED = 20

_NO_RECORDS = (
    "icechunk keeps no checksums of chunks to compare with, so read a group whole instead: where it was "
    "written with hyperpaint.io.encoding, a damaged chunk raises"
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
    notes
        What could not be checked.
    resume
        What finishes an unfinished store on the command line, where that is known.
    """

    path: str
    groups: tuple[str, ...]
    chunks: int
    problems: tuple[str, ...]
    notes: tuple[str, ...] = ()
    resume: str = ""

    @property
    def ok(self) -> bool:
        """True where nothing is wrong."""
        return not self.problems

    def __str__(self) -> str:
        state = counted(len(self.problems), "problem") if self.problems else "whole"
        held = f"{counted(len(self.groups), 'group')}, {counted(self.chunks, 'chunk')}"
        head = f"{self.path}: {held}, {state}"
        return "\n  ".join([head, *self.problems, *(f"note: {note}" for note in self.notes)])


def verify(path: str | os.PathLike[str]) -> StoreReport:
    """Read every chunk of a store and compare it with the completion records.

    Finds what the store lacks of the groups that it is to hold, or has in their place (unfinished, deleted,
    swapped, foreign, mixed settings); groups that were never finished, chunks that are missing, damaged,
    exchanged, stale or not of the store, metadata that were changed, and groups that are listed but gone.
    Safe on a store from any source: what may not be read (foreign codecs and data types, chunks that would
    not decode to what is declared, links) is reported and not touched; plain `xarray.open_zarr` has no such
    guard.

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
    begin = set_stamp(location)
    groups = location.groups()
    state = set_state(location, groups)
    problems = [*state.problems, *_until_error(_root_problems(location, groups))]
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
        problems.extend(_until_error(_group_problems(location, group, record)))
    if set_stamp(location) != begin:
        problems.insert(0, "/: was written to meanwhile, what else is said may hold no longer; verify again")
    return StoreReport(
        location.url, tuple(groups), chunks, tuple(dict.fromkeys(problems)), state.notes, state.resume
    )


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


def _until_error(lines: Iterator[str]) -> Iterator[str]:
    """Yield what a check finds; where it cannot go on, the error is the last line."""
    try:
        yield from lines
    except StoreError as error:
        yield str(error)


def _root_problems(location: Location, groups: list[str]) -> Iterator[str]:
    root = location.read_json("", METADATA) or {}
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
        yield from _until_error(_folder_problems(location, group))
    # what is in a group that is gone is gone with it
    gone = [name for name in listed if name not in nodes and (_above(name) in nodes or not _above(name))]
    for name in gone[:_MOST_LISTED]:
        yield f"/{name[:200]}: listed in the root's metadata but not there"
    if len(gone) > _MOST_LISTED:
        yield f"/: {len(gone) - _MOST_LISTED} more nodes listed in the root's metadata but not there"
    for name, document in listed.items():
        if name in nodes:
            yield from _until_error(_listed_problems(location, name, document))
    for group in groups:
        if group and group not in listed:
            yield f"/{group}: not listed in the root's consolidated metadata; run the writer again"


def _above(name: str) -> str:
    return name.rpartition("/")[0]


def _folder_problems(location: Location, group: str) -> Iterator[str]:
    """Yield what is in a group's folder and not of the store, and whether its attributes are others."""
    node, strays = location.metadata(group), location.strays(group)
    for name in strays[:_MOST_LISTED]:
        yield f"/{group}/{name}".replace("//", "/") + ": neither a group nor an array of the store"
    if len(strays) > _MOST_LISTED:
        yield f"/{group}: {len(strays) - _MOST_LISTED} more that are neither groups nor arrays"
    if node is not None and not has_sealed_attributes(node):
        yield f"/{group}: attributes are not those that were written; run the writer again"


def _listed_problems(location: Location, name: str, document: Any) -> Iterator[str]:
    """Yield whether the root describes a node as it is."""
    actual = location.metadata(name)
    if actual is None:
        yield f"/{name}: listed in the root's metadata but not there"
        return
    listed = {**document, "consolidated_metadata": None} if isinstance(document, dict) else {}
    if metadata_checksum(listed) != metadata_checksum({**actual, "consolidated_metadata": None}):
        yield f"/{name}: the root's consolidated metadata are not those of the node"


def _group_problems(location: Location, group: str, record: GroupRecord) -> Iterator[str]:
    if attributes_checksum(location.metadata(group) or {}) != record.attributes:
        yield f"/{group}: attributes are not those recorded"
    for name, array in record.arrays.items():
        yield from _until_error(_array_problems(location, group, name, array))


def _array_problems(location: Location, group: str, name: str, record: ArrayRecord) -> Iterator[str]:
    import numpy as np
    import zarr

    from .guard import guarded

    where = f"{group}/{name}" if group else name
    recorded_form(location, group, name, record)
    try:
        array = zarr.open_array(guarded(location), path=where, mode="r", zarr_format=3)
    except StoreError:
        raise
    except Exception as error:  # zarr's own checks have classes of their own
        yield f"/{where}: {type(error).__name__}: {error}"
        return
    present = location.files(where)
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
