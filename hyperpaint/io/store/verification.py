"""`verify`: check that every chunk of a store is present, readable, and unchanged since it was written."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from hyperpaint.base.errors import StoreError

from .budget import counted
from .chunks import whole_chunk
from .groups import LISTED, listed_documents
from .location import MANIFEST_NODE, METADATA, Location, joined
from .manifest import (
    MAX_MESSAGES,
    OLD_RECORD,
    GroupEntry,
    Manifest,
    attributes_replaced,
    changed_attributes,
    chunk_digest,
    chunk_keys,
    content_of,
    document_checksum,
    entry_of,
    store_state,
)
from .reader import (
    MAX_CHUNK_BYTES,
    check_arrays,
    check_metadata,
    is_format_3,
    list_groups,
    place_of,
)


@dataclass(frozen=True)
class StoreReport:
    """Result of `verify`.

    Attributes
    ----------
    path
        The store.
    groups
        Groups that hold arrays.
    chunks
        Number of chunks read.
    problems
        One line each, ending in its code; empty where all is well.
    notes
        Parts that could not be checked, and additions by other programs.
    resume
        Command that finishes an unfinished store; empty if unknown.
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
        counts = f"{counted(len(self.groups), 'group')}, {counted(self.chunks, 'chunk')}"
        head = f"{self.path}: {counts}, {state}"
        return "\n  ".join([head, *self.problems, *(f"note: {note}" for note in self.notes)])


def verify(path: str | os.PathLike[str]) -> StoreReport:
    """Read every chunk of a store and compare it with the store's manifest.

    Finds groups that are unfinished, deleted, exchanged or changed; chunks that are missing, damaged,
    exchanged or stale; and metadata that were changed. Groups and variables that others added are read too,
    and noted. Of a Zarr store without a manifest all chunks are read, which finds damaged ones where they
    have checksums.

    Parameters
    ----------
    path
        Folder, zip file or URL of the store.

    Returns
    -------
    StoreReport
        With every problem found; ``report.ok`` where there is none.

    Raises
    ------
    StoreError
        There is no Zarr store; or it is a store object or a repository of icechunk, which icechunk checks.
    MissingExtraError
        The package for this kind of URL is not installed.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> from hyperpaint.io.store import to_store
    >>> path = to_store(xr.Dataset({"wavelength": ("band", np.arange(3.0))}), "memory://small.zarr")
    >>> print(verify(path))
    memory://small.zarr: 1 group, 1 chunk, whole
    """
    import zarr

    found, source = place_of(path)
    location = found or Location.of(path)
    check_metadata(location, "")
    if location.has("snapshots") and location.has("manifests"):
        raise StoreError(
            f"{location.url} is an icechunk repository, whose snapshots icechunk checks",
            expected="a Zarr store",
            code="store-unreadable",
        )
    begin = _stamp(location)
    if is_format_3(location):
        nodes = location.nodes()
    else:
        nodes = {
            joined(group, name): "array"
            for group in list_groups(path)
            for name in zarr.open_group(source, path=group, mode="r", use_consolidated=False).array_keys()
        }
    groups = sorted({name.rpartition("/")[0] for name, kind in nodes.items() if kind == "array"})
    state = store_state(location, groups)
    problems, notes = list(state.problems), list(state.notes)
    try:
        manifest = Manifest.read(location) or Manifest()
    except StoreError:
        manifest = Manifest()  # reported by the state
    problems += [
        f"/{name}: its metadata cannot be read [metadata-damaged]"
        for name in nodes
        if nodes[name] == "unreadable"
    ]
    problems += _metadata_problems(location, "", manifest.groups.get(""))
    if manifest.groups:
        problems += _listing_problems(location, nodes, manifest)
        for group in ("", *(name for name, kind in nodes.items() if kind == "group")):
            strays = [name for name in location.strays(group) if joined(group, name) not in manifest.groups]
            places = [joined(group, name) for name in strays[:MAX_MESSAGES]]
            notes += [f"/{place}: neither a group nor an array" for place in places]
    chunks = 0
    for group in dict.fromkeys((*manifest.groups, *groups)):
        entry = manifest.groups.get(group)
        # the state reports groups that another write published
        replaced = entry is not None and attributes_replaced(location, group, entry)
        content = content_of(location, group, manifest)
        current = entry is not None and entry.content == content
        if not current and content in manifest.allowed(group):  # published, but its writer has not finished
            try:
                entry, current = entry_of(location, group), True
            except StoreError as error:
                problems.append(f"/{group}: {error!s:.400}")
        recorded: Mapping[str, Any] = entry.arrays if entry is not None and current else {}
        if replaced:
            notes.append(f"/{group}: another program replaced its attributes; open_store knows them")
        elif entry is not None and current and group:
            problems += _metadata_problems(location, group, entry)
        there = [name for name in location.folders(group) if nodes.get(joined(group, name)) == "array"]
        for name in dict.fromkeys((*recorded, *there)):
            where = joined(group, name)
            if recorded and name not in recorded:
                notes.append(f"/{where}: added by another program, not in the manifest")
            try:
                if name in recorded:
                    count, wrong = _recorded_chunks(location, group, name, recorded[name])
                else:
                    count, wrong = _other_chunks(location, source, where)
                chunks += count
                problems += wrong
            except StoreError as error:
                problems.append(f"/{where}: {error!s:.400}")
    if _stamp(location) != begin:
        problems.insert(0, "/: was written to meanwhile; run verify again [store-locked]")
    return StoreReport(
        location.url,
        tuple(groups),
        chunks,
        tuple(dict.fromkeys(problems)),
        tuple(dict.fromkeys(notes)),
        state.resume,
    )


def _stamp(location: Location) -> bytes | None:
    # The bytes of the manifest, which change whenever a writer begins or ends.
    try:
        return location.read(MANIFEST_NODE, METADATA)
    except StoreError:
        return None


def _listing_problems(location: Location, nodes: Mapping[str, str], manifest: Manifest) -> Iterator[str]:
    # Differences between the root's list of all metadata and the manifest.
    try:
        root, listed = location.read_json("", METADATA) or {}, listed_documents(location)
    except StoreError:
        return  # reported already
    head = root.get("consolidated_metadata")
    if not isinstance(head, dict) or not head.items() >= LISTED.items():
        yield "/: the root has no list of all metadata; run the writer again [listing-missing]"
        return
    missing = [name for name in listed if name not in nodes and name.partition("/")[0] != MANIFEST_NODE]
    for name in missing[:MAX_MESSAGES]:
        yield f"/{name[:200]}: listed in the root's metadata but missing [listing-wrong]"
    wanted = {}
    for group, entry in manifest.groups.items():
        # a killed writer may have published another group under this name
        if not entry.content or content_of(location, group, manifest) == entry.content:
            if group and not attributes_replaced(location, group, entry):
                wanted[group] = entry.metadata
            wanted |= {joined(group, name): array.metadata for name, array in entry.arrays.items()}
    for name in filter(nodes.get, wanted):
        document = listed.get(name)
        plain = dict(document) if isinstance(document, dict) else {}
        below = plain.pop("consolidated_metadata", {**LISTED, "metadata": {}})
        if document_checksum(plain) != wanted[name] or below != {**LISTED, "metadata": {}}:
            yield f"/{name}: the root's list of all metadata differs; run the writer again [listing-wrong]"


def _metadata_problems(location: Location, group: str, entry: GroupEntry | None) -> Iterator[str]:
    # The problems of a group's metadata: unreadable, missing, or different from the manifest.
    try:
        document = location.metadata(group)
        if entry is not None and document is None and not entry.content:  # others are reported by the state
            yield f"/{group}: its metadata are missing [metadata-missing]"
        changed = [] if entry is None or document is None else changed_attributes(location, group, entry)
        if changed:
            named = ", ".join(changed)[:200]
            yield f"/{group}: attributes differ from those written: {named} [attributes-changed]"
    except StoreError as error:
        yield f"/{group}: {error!s:.200}"


def _recorded_chunks(location: Location, group: str, name: str, array: Any) -> tuple[int, list[str]]:
    # The number of chunks of an array, and how they differ from its manifest entry.
    where = joined(group, name)
    document = location.metadata(where)
    if document is None or document_checksum(document) != array.metadata:
        changed = "metadata differ from those written [metadata-changed]"
        return 0, [f"/{where}: {'the array is missing [array-missing]' if document is None else changed}"]
    keys = chunk_keys(document, where)
    problems = [
        f"/{where}/{stray}: not a chunk of this array [chunk-foreign]"
        for stray in sorted(location.files(where) - {*keys, METADATA, OLD_RECORD})[:MAX_MESSAGES]
    ]

    def end(key: str) -> bytes | str:
        encoded = location.read(where, key, limit=MAX_CHUNK_BYTES)
        if encoded is None:
            return "the chunk is missing [chunk-missing]"
        return "the chunk is damaged [chunk-damaged]" if whole_chunk(encoded) is None else encoded[-4:]

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        ends = dict(zip(keys, pool.map(end, keys), strict=True))
    wrong = [f"/{where}/{key}: {state}" for key, state in ends.items() if isinstance(state, str)]
    if not wrong and chunk_digest(group, name, ends.items()) != array.digest:  # type: ignore[arg-type]
        wrong = [f"/{where}: chunks differ from those written: exchanged, stale or altered [chunk-changed]"]
    return len(keys), problems + wrong


def _other_chunks(location: Location, source: Any, where: str) -> tuple[int, list[str]]:
    # The number of chunks of an array without a manifest entry, and the unreadable ones.
    import zarr

    try:
        array: Any = zarr.open_array(source, path=where, mode="r")
    except Exception as error:  # zarr raises many classes of errors
        return 0, [f"/{where}: {type(error).__name__}: {error!s:.200} [array-unreadable]"]
    check_arrays(location.url, {where: array})

    def state(index: tuple[int, ...]) -> str:
        place = tuple(slice(i * step, (i + 1) * step) for i, step in zip(index, array.chunks, strict=True))
        try:
            np.asarray(array[place])
        except Exception as error:  # a damaged chunk may raise anything that a codec raises
            cause = f"{type(error).__name__}: {error!s:.200}"
            return f"/{where}: chunk {index} cannot be read: {cause} [chunk-damaged]"
        return ""

    positions = list(
        np.ndindex(*(-(-size // max(step, 1)) for size, step in zip(array.shape, array.chunks, strict=True)))
    )
    large = array.nbytes > MAX_CHUNK_BYTES // 8 * len(positions)  # one by one
    with ThreadPoolExecutor(1 if large else os.cpu_count()) as pool:
        return len(positions), [text for text in pool.map(state, positions) if text]
