"""`verify`: check that every chunk of a store is present, readable, and unchanged since it was written."""

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
        One line per problem with its code at the end; empty for a valid store.
    notes
        Groups and arrays that could not be checked, and additions by other programs.
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
        # Whether there are no problems.
        return not self.problems

    def __str__(self) -> str:
        state = counted(len(self.problems), "problem") if self.problems else "whole"
        counts = f"{counted(len(self.groups), 'group')}, {counted(self.chunks, 'chunk')}"
        return "\n  ".join(
            [f"{self.path}: {counts}, {state}", *self.problems, *(f"note: {note}" for note in self.notes)]
        )


def verify(path: str | os.PathLike[str]) -> StoreReport:
    """Read every chunk of a store and compare it with the store's manifest.

    Finds groups that are unfinished, deleted, exchanged or changed; chunks that are missing, damaged,
    exchanged or outdated; and changed metadata. Groups and variables that other programs added are read, and
    listed in the notes. In a Zarr store without a manifest, damaged chunks are found if they have checksums.

    Parameters
    ----------
    path
        Folder, zip file or URL of the store.

    Returns
    -------
    StoreReport
        Report with all problems; ``report.ok`` is True if there are none.

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

    opened_location, source = place_of(path)
    location = opened_location or Location.of(path)
    check_metadata(location, "")
    StoreError.raise_if(
        location.has("snapshots") and location.has("manifests"),
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
    groups = sorted({name.rpartition("/")[0] for name, node_type in nodes.items() if node_type == "array"})
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
        for group in ("", *(name for name, node_type in nodes.items() if node_type == "group")):
            strays = [name for name in location.strays(group) if joined(group, name) not in manifest.groups]
            stray_paths = [joined(group, name) for name in strays[:MAX_MESSAGES]]
            notes += [f"/{stray_path}: neither a group nor an array" for stray_path in stray_paths]
    chunks = 0
    for group in dict.fromkeys((*manifest.groups, *groups)):
        entry = manifest.groups.get(group)
        # a group with the content of another write is reported by `store_state`
        replaced = entry is not None and attributes_replaced(location, group, entry)
        content = content_of(location, group, manifest)
        current = entry is not None and entry.content == content
        if not current and content in manifest.allowed(group):  # its writer has not yet written the manifest
            try:
                entry, current = entry_of(location, group), True
            except StoreError as error:
                problems.append(f"/{group}: {error!s:.400}")
        recorded: Mapping[str, Any] = entry.arrays if entry is not None and current else {}
        if replaced:
            notes.append(f"/{group}: another program replaced its attributes; open_store knows them")
        elif entry is not None and current and group:
            problems += _metadata_problems(location, group, entry)
        array_names = [name for name in location.folders(group) if nodes.get(joined(group, name)) == "array"]
        for name in dict.fromkeys((*recorded, *array_names)):
            array_path = joined(group, name)
            if recorded and name not in recorded:
                notes.append(f"/{array_path}: added by another program, not in the manifest")
            try:
                if name in recorded:
                    count, faults = _recorded_chunks(location, group, name, recorded[name])
                else:
                    count, faults = _other_chunks(location, source, array_path)
                chunks += count
                problems += faults
            except StoreError as error:
                problems.append(f"/{array_path}: {error!s:.400}")
    if _stamp(location) != begin:
        problems.insert(0, "/: a writer changed the store during the check; run verify again [store-locked]")
    return StoreReport(
        location.url,
        tuple(groups),
        chunks,
        tuple(dict.fromkeys(problems)),
        tuple(dict.fromkeys(notes)),
        state.resume,
    )


def _stamp(location: Location) -> bytes | None:
    # Bytes of the manifest, which every writer changes at its start and end
    try:
        return location.read(MANIFEST_NODE, METADATA)
    except StoreError:
        return None


def _listing_problems(location: Location, nodes: Mapping[str, str], manifest: Manifest) -> Iterator[str]:
    # Differences between the consolidated metadata of the root and the manifest
    try:
        root, listed = location.read_json("", METADATA) or {}, listed_documents(location)
    except StoreError:
        return  # reported by `_metadata_problems`
    head = root.get("consolidated_metadata")
    if not isinstance(head, dict) or not head.items() >= LISTED.items():
        yield "/: the root has no list of all metadata; run the writer again [listing-missing]"
        return
    missing = [name for name in listed if name not in nodes and name.partition("/")[0] != MANIFEST_NODE]
    for name in missing[:MAX_MESSAGES]:
        yield f"/{name[:200]}: listed in the root's metadata but missing [listing-wrong]"
    expected = {}
    for group, entry in manifest.groups.items():
        # skip a group that a killed writer replaced by one with other content
        if not entry.content or content_of(location, group, manifest) == entry.content:
            if group and not attributes_replaced(location, group, entry):
                expected[group] = entry.metadata
            expected |= {joined(group, name): array.metadata for name, array in entry.arrays.items()}
    for name in filter(nodes.get, expected):
        document = listed.get(name)
        listed_document = dict(document) if isinstance(document, dict) else {}
        inner_list = listed_document.pop("consolidated_metadata", {**LISTED, "metadata": {}})
        if document_checksum(listed_document) != expected[name] or inner_list != {**LISTED, "metadata": {}}:
            yield f"/{name}: the root's list of all metadata differs; run the writer again [listing-wrong]"


def _metadata_problems(location: Location, group: str, entry: GroupEntry | None) -> Iterator[str]:
    # Problems of a group's metadata: unreadable, missing, or different from the manifest
    try:
        document = location.metadata(group)
        if entry is not None and document is None and not entry.content:  # else reported by `store_state`
            yield f"/{group}: its metadata are missing [metadata-missing]"
        changed = [] if entry is None or document is None else changed_attributes(location, group, entry)
        if changed:
            names = ", ".join(changed)[:200]
            yield f"/{group}: attributes differ from those written: {names} [attributes-changed]"
    except StoreError as error:
        yield f"/{group}: {error!s:.200}"


def _recorded_chunks(location: Location, group: str, name: str, array: Any) -> tuple[int, list[str]]:
    # Number of chunks of an array, and their differences from its manifest entry
    array_path = joined(group, name)
    document = location.metadata(array_path)
    if document is None or document_checksum(document) != array.metadata:
        changed = "metadata differ from those written [metadata-changed]"
        return 0, [
            f"/{array_path}: {'the array is missing [array-missing]' if document is None else changed}"
        ]
    keys = chunk_keys(document, array_path)
    problems = [
        f"/{array_path}/{stray}: not a chunk of this array [chunk-foreign]"
        for stray in sorted(location.files(array_path) - {*keys, METADATA, OLD_RECORD})[:MAX_MESSAGES]
    ]

    def end(key: str) -> bytes | str:
        encoded = location.read(array_path, key, limit=MAX_CHUNK_BYTES)
        if encoded is None:
            return "the chunk is missing [chunk-missing]"
        return "the chunk is damaged [chunk-damaged]" if whole_chunk(encoded) is None else encoded[-4:]

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        ends = dict(zip(keys, pool.map(end, keys), strict=True))
    faults = [f"/{array_path}/{key}: {state}" for key, state in ends.items() if isinstance(state, str)]
    if not faults and chunk_digest(group, name, ends.items()) != array.digest:  # type: ignore[arg-type]
        faults = [
            f"/{array_path}: chunks differ from those written: exchanged, stale or altered [chunk-changed]"
        ]
    return len(keys), problems + faults


def _other_chunks(location: Location, source: Any, array_path: str) -> tuple[int, list[str]]:
    # Number of chunks of an array without a manifest entry, and its unreadable chunks
    import zarr

    try:
        array: Any = zarr.open_array(source, path=array_path, mode="r")
    except Exception as error:  # zarr raises many classes of errors
        return 0, [f"/{array_path}: {type(error).__name__}: {error!s:.200} [array-unreadable]"]
    check_arrays(location.url, {array_path: array})

    def state(index: tuple[int, ...]) -> str:
        region = tuple(slice(i * step, (i + 1) * step) for i, step in zip(index, array.chunks, strict=True))
        try:
            np.asarray(array[region])
        except Exception as error:  # a damaged chunk may raise anything that a codec raises
            cause = f"{type(error).__name__}: {error!s:.200}"
            return f"/{array_path}: chunk {index} cannot be read: {cause} [chunk-damaged]"
        return ""

    positions = list(
        np.ndindex(*(-(-size // max(step, 1)) for size, step in zip(array.shape, array.chunks, strict=True)))
    )
    is_large = array.nbytes > MAX_CHUNK_BYTES // 8 * len(positions)  # chunks are read one by one
    with ThreadPoolExecutor(1 if is_large else os.cpu_count()) as pool:
        return len(positions), [text for text in pool.map(state, positions) if text]
