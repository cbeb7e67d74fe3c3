"""The groups of a store: what writing one would lose, those around it, and the root's list of all metadata.

Plain `xarray.open_zarr` reads the metadata of every group from the root's list; our readers ask each group.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import json
import warnings
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hyperpaint.base.errors import IncompleteStoreError
from hyperpaint.base.schema import FORMAT_VERSION

from .location import METADATA, Location, is_temporary, sync
from .record import (
    CHUNKS,
    COMPLETE,
    OWN_ATTRS,
    PLACE,
    SET,
    GroupRecord,
    metadata_checksum,
    read_record,
    sealed_attributes,
)

if TYPE_CHECKING:
    import xarray as xr

VOLATILE_ATTRS = ("created", "history", "hyperpaint_version", *OWN_ATTRS)
"""Attributes that say when, not what: they do not make another content."""

INPUTS = "inputs_digest"
"""Attribute of what `process` writes: names the inputs and parameters. In what a user made of that it would
say so no longer, and is left out."""


def groups_above(group: str) -> list[str]:
    """Return the groups that a group is in, the root first."""
    parts = group.split("/") if group else []
    return ["/".join(parts[:depth]) for depth in range(len(parts))]


def stamped(attrs: Any, action: str) -> dict[str, Any]:
    """Return attributes with format, version, time and one more line of history."""
    import datetime

    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    line = f"{now} hyperpaint {version_of_program()}: {action}"
    return {
        **{key: value for key, value in attrs.items() if key not in OWN_ATTRS},
        "Conventions": "CF-1.11",
        "hyperpaint_format": FORMAT_VERSION,
        "hyperpaint_version": version_of_program(),
        "created": now,
        "history": "\n".join(text for text in (str(attrs.get("history", "")), line) if text),
    }


@functools.cache
def version_of_program() -> str:
    """Return the version of hyperpaint that is running."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("hyperpaint")
    except PackageNotFoundError:
        return "unknown"


@contextlib.contextmanager
def without_known_warnings() -> Iterator[None]:
    """Silence the one known warning: consolidated metadata are not in the v3 specification."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Consolidated metadata is currently not part")
        yield


def make_groups_above(group: str, location: Location) -> None:
    """Make the groups that a group is in, where they are missing."""
    for above in groups_above(group):
        if location.metadata(above) is None:
            _write_group(above, stamped({}, "created"), location)


def has_all_chunks(location: Location, group: str, record: GroupRecord) -> bool:
    """Tell whether every chunk of a finished group has its file; none is read."""
    for name, array in record.arrays.items():
        present = location.files(f"{group}/{name}" if group else name)
        places = itertools.product(*map(range, array.grid))
        if not all("/".join(("c", *map(str, place))) in present for place in places):
            return False
    return True


def is_damaged(group: str, location: Location) -> bool:
    """Tell whether there is metadata of a group that cannot be read; a link or pipe there is a StoreError."""
    try:
        location.metadata(group)
    except IncompleteStoreError:
        return True
    return False


def rebuild_groups(groups: Iterable[str], location: Location) -> None:
    """Write the metadata of damaged or missing groups without arrays anew; what is in them stays."""
    for group in groups:
        _write_group(group, stamped({}, "rebuilt"), location)


def _write_group(group: str, attributes: Mapping[str, Any], location: Location) -> None:
    """Write the metadata of a group without arrays: there whole or not at all, even after a power cut."""
    if location.local is not None:
        (location.local / group).mkdir(parents=True, exist_ok=True)
    plain = json.loads(json.dumps(attributes, default=lambda value: value.tolist()))
    node = {"attributes": sealed_attributes(plain), "zarr_format": 3, "node_type": "group"}
    location.write_json(node, group, METADATA)
    if location.local is not None:
        sync((location.local / group).absolute().parent)


def announce(text: str, groups: Collection[str], location: Location) -> None:
    """Write the root record into the root, before the first of ``groups`` gets its place.

    Consolidated metadata that list one of them are dropped: they would describe the old one.
    """
    document = location.read_json("", METADATA)
    if document is None:
        _write_group("", {**stamped({}, "created"), SET: text}, location)
        return
    listed = (document.get("consolidated_metadata") or {}).get("metadata", {})
    others = {key: value for key, value in document.items() if key != "consolidated_metadata"}
    kept = document if listed.keys().isdisjoint(groups) else others
    announced = {**kept, "attributes": {**kept.get("attributes", {}), SET: text}}
    if announced != document:
        location.write_json(announced, METADATA)


def finish_root(attrs: Mapping[str, dict[str, Any]], text: str, location: Location) -> None:
    """Set the attributes of groups without variables (by group), then list all metadata in the root.

    ``text`` is the root record, empty where the root holds the only group.
    """
    for group, wanted in attrs.items():
        make_groups_above(group, location)
        node = location.metadata(group)
        if node is None or not _has_attrs(node, wanted):
            stored = (node or {}).get("attributes", {})
            _write_group(group, {**stored, **stamped({**stored, **_plain(wanted)}, "to_store")}, location)
    document = _consolidated(location)
    if text:
        document["attributes"] = {**document.get("attributes", {}), SET: text}
    location.write_json(document, METADATA)


def _consolidated(location: Location) -> dict[str, Any]:
    """Return the root's metadata with those of all nodes in it.

    zarr does it, to a copy of the metadata in memory: what it writes to a disk itself a power cut could tear.
    """
    import zarr
    from zarr.core.buffer import default_buffer_prototype

    copied: dict[str, Any] = {}
    pending = [""]
    while pending:
        path = pending.pop()
        document = location.metadata(path)
        if document is None:
            continue
        raw = json.dumps(document).encode()
        copied[f"{path}/{METADATA}".lstrip("/")] = default_buffer_prototype().buffer.from_bytes(raw)
        if document.get("node_type") == "group":
            pending += [f"{path}/{child}".lstrip("/") for child in location.folders(path)]
    with without_known_warnings():
        zarr.consolidate_metadata(zarr.storage.MemoryStore(copied), zarr_format=3)
    return dict(json.loads(copied[METADATA].to_bytes()))


def _plain(attrs: dict[str, Any]) -> dict[str, Any]:
    """Return attributes as JSON holds them."""
    import numpy as np

    return {
        key: value.tolist() if isinstance(value, np.ndarray | np.generic) else value
        for key, value in attrs.items()
    }


def _has_attrs(node: dict[str, Any], wanted: dict[str, Any]) -> bool:
    stored = node.get("attributes", {})
    return all(
        key in stored and stored[key] == value
        for key, value in _plain(wanted).items()
        if key not in VOLATILE_ATTRS
    )


def is_listed(groups: Iterable[str], attrs: Mapping[str, dict[str, Any]], location: Location) -> bool:
    """Tell whether the root's consolidated metadata and attributes are up to date."""
    root = location.read_json("", METADATA) or {}
    listed = (root.get("consolidated_metadata") or {}).get("metadata", {})
    for group, wanted in attrs.items():
        node = location.metadata(group)
        if node is None or not _has_attrs(node, wanted) or (group and group not in listed):
            return False
    records = {group: read_record(location, group) for group in groups}
    return None not in records.values() and all(
        metadata_checksum(listed.get(f"{group}/{name}".lstrip("/"), {})) == array.metadata
        for group, record in records.items()
        for name, array in (record.arrays.items() if record else ())
    )


# --- what writing a group would lose -----------------------------------------------------------------------


def problems_above(groups: Iterable[str], location: Location, *, overwrite: bool) -> list[str]:
    """Return why groups cannot be written below ``groups``, one line each; empty where they can.

    With ``overwrite``, damaged metadata may be written anew.
    """
    if _is_foreign(location):
        return ["it exists and is not a Zarr v3 store; choose another path"]
    outer = _store_around(location)
    if outer:
        return [f"it lies in the store {outer}; write a group of that, or choose another path"]
    return [
        f"the metadata of group {'/' + group!r} are missing or damaged; pass overwrite=True to write them "
        "anew, the groups in it stay"
        for group in ([] if overwrite else damaged_groups(groups, location))
    ]


def _store_around(location: Location) -> str:
    """Return the store that a path lies in, which would be damaged: an array, or a group that none wrote."""
    parents = [] if location.local is None else location.local.absolute().parents
    return next((str(parent) for parent in parents if (parent / METADATA).is_file()), "")


def damaged_groups(groups: Iterable[str], location: Location) -> list[str]:
    """Return the groups whose metadata cannot be read; the root also where they are missing in a store."""
    return [
        group
        for group in groups
        if is_damaged(group, location)
        or (not group and location.metadata("") is None and _entries(location, ""))
    ]


def occupant(group: str, token: str, location: Location) -> str:
    """Return what is in a group's place; ``token`` names the content that is to be written.

    Nothing (""), the "same" content, which perhaps "lacks chunks", a "parent" of what is not part of it, an
    "array", or in words that go into a sentence what else.
    """
    if any(_is_array(location, each) for each in (*groups_above(group), group) if each):
        return "array"
    try:
        metadata = location.metadata(group)
        record = read_record(location, group)
    except IncompleteStoreError:  # damaged: to be replaced
        metadata, record = {}, None
    if metadata is None and not _entries(location, group):
        return ""
    if record is not None and record.token == token and _lies_at(metadata, group):
        return "same" if has_all_chunks(location, group, record) else "lacks chunks"
    below = (f"{group}/{child}" if group else child for child in location.folders(group))
    strays = location.strays(group) if group else []
    if strays or not all(_is_array(location, path) for path in below):
        return "parent"
    return "was never finished or is damaged" if record is None else "with other content"


def _lies_at(metadata: Mapping[str, Any] | None, group: str) -> bool:
    """Tell whether a group's own record says that it belongs where it is."""
    return ((metadata or {}).get("attributes") or {}).get(PLACE) == f"/{group}"


def _is_foreign(location: Location) -> bool:
    """Tell whether something else than a store is in its place."""
    if not location.has("") or location.has("", METADATA):
        return False
    if location.local is not None and not location.local.is_dir():
        return True
    # without the root's metadata it is still one where it holds a group of its own, and nothing else
    return bool(_entries(location, "")) and (
        bool(location.strays("")) or not any(_is_own(location, group) for group in location.groups())
    )


def _is_own(location: Location, group: str) -> bool:
    """Tell whether a group was finished where it is: a calibration in a folder is a store of its own."""
    metadata = location.metadata(group) or {}
    attributes = metadata.get("attributes") or {}
    return COMPLETE in attributes and (PLACE not in attributes or _lies_at(metadata, group))


def _entries(location: Location, group: str) -> list[str]:
    """Return the names in a group's folder, without what a killed writer left half-written."""
    try:
        listed = location.fs.ls(location.key(group), detail=False)
    except (FileNotFoundError, NotADirectoryError):
        return []
    names = (str(entry).rstrip("/").rpartition("/")[2] for entry in listed)
    return [name for name in names if not is_temporary(name)]


def _is_array(location: Location, path: str) -> bool:
    """Tell whether a folder is an array's: from its metadata or, where they are damaged, its record."""
    metadata = None if is_damaged(path, location) else location.metadata(path)
    if metadata is not None:
        return metadata.get("node_type") == "array"
    return location.has(path, CHUNKS)


#: Where arrays that wrap others keep them: xarray's adapters, its zarr wrapper, ours.
_INNER = ("array", "_array", "variable", "_data")


def reads_from(dataset: xr.Dataset, location: Location, group: str) -> list[str]:
    """Return the variables that are still read, lazily, from a group of a store."""
    return [
        str(name)
        for name, variable in dataset.variables.items()
        if any(_lies_in(array, location, group) for array in _zarr_arrays(variable))
    ]


def is_named_by_content(variable: xr.Variable) -> bool:
    """Tell whether dask's name for a variable changes with what is stored in the Zarr arrays it reads.

    Names follow the URL, and the time of the root folder at best: a source that is rewritten keeps them. Only
    those of our finished groups follow the content.
    """
    stores = (array.store_path.store for array in _zarr_arrays(variable))
    return all(getattr(store, "record", None) is not None for store in stores)


def _zarr_arrays(variable: xr.Variable) -> Iterator[Any]:
    import dask
    import zarr

    if variable._in_memory:
        return
    seen: set[int] = set()
    pending: list[Any] = list(_graph_values(variable)) if dask.is_dask_collection(variable) else [variable]
    while pending:
        thing = pending.pop()
        if id(thing) in seen:
            continue
        seen.add(id(thing))
        if isinstance(thing, zarr.Array):
            yield thing
        else:
            pending.extend(_parts(thing))


def _graph_values(variable: xr.Variable) -> Iterator[Any]:
    """Yield what the layers of a graph hold, without making their tasks."""
    from dask.blockwise import Blockwise

    for layer in variable.__dask_graph__().layers.values():  # type: ignore[union-attr]
        if isinstance(layer, Blockwise):
            yield layer.task
            yield from (argument for argument, index in layer.indices if index is None)
        elif hasattr(layer, "mapping"):
            yield from layer.mapping.values()


def _parts(thing: Any) -> Iterable[Any]:
    if isinstance(thing, Mapping):
        return thing.values()
    if isinstance(thing, list | tuple | set):
        return thing
    module = type(thing).__module__.partition(".")[0]
    if module == "dask":  # Task, DataNode, Alias
        return (getattr(thing, name) for name in ("args", "kwargs", "value") if hasattr(thing, name))
    if module in ("xarray", "hyperpaint"):
        return (getattr(thing, name) for name in _INNER if name in _names(thing))
    return ()


def _names(thing: Any) -> set[str]:
    slots = {slot for kind in type(thing).__mro__ for slot in getattr(kind, "__slots__", ())}
    return slots | set(getattr(thing, "__dict__", ()))


def _lies_in(array: Any, location: Location, group: str) -> bool:
    place = array.store_path
    root = getattr(place.store, "root", None)  # local stores
    if location.local is not None:
        if root is None:
            return False
        target = (location.local / group).resolve()
        return bool((Path(root) / place.path).resolve().is_relative_to(target))
    base = getattr(place.store, "path", None)  # fsspec stores
    if base is None or root is not None:
        return False
    source = "/".join(part.strip("/") for part in (str(base), place.path) if part)
    return (source + "/").startswith(location.key(group).strip("/") + "/")
