"""Groups of a store: metadata, the list of all nodes in the root, and checks before a group is written."""

import functools
import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import xarray as xr

from hyperpaint.base.errors import IncompleteStoreError, Problems, StoreError
from hyperpaint.base.schema import FORMAT_VERSION

from .location import MANIFEST_NODE, METADATA, Location, joined
from .manifest import OWN_ATTRS, Manifest, content_of, entry_of
from .reader import check_entry

# Attributes that depend on the time of writing, and are not part of the content.
VOLATILE_ATTRS = ("created", "history", "hyperpaint_version", *OWN_ATTRS)

LISTED = {"kind": "inline", "must_understand": False}


def groups_above(group: str) -> list[str]:
    # Return the ancestors of a group, the root first.
    names = group.split("/") if group else []
    return ["/".join(names[:depth]) for depth in range(len(names))]


def stamped(attrs: Mapping[Any, Any], action: str) -> dict[str, Any]:
    # Return attributes with format, version, time and a new line of history.
    import datetime

    time = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    line = f"{time} hyperpaint {version_of_program()}: {action}"
    return {
        **{key: value for key, value in attrs.items() if key not in OWN_ATTRS},
        "Conventions": "CF-1.11",
        "hyperpaint_format": FORMAT_VERSION,
        "hyperpaint_version": version_of_program(),
        "created": time,
        "history": "\n".join(text for text in (str(attrs.get("history", "")), line) if text),
    }


@functools.cache
def version_of_program() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("hyperpaint")
    except PackageNotFoundError:
        return "unknown"


def group_document(attributes: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "attributes": json.loads(json.dumps(attributes, default=lambda value: value.tolist())),
        "zarr_format": 3,
        "node_type": "group",
    }


def ensure_groups(groups: Iterable[str], location: Location) -> None:
    # Write the missing or damaged metadata of groups; their contents stay.
    for group in groups:
        try:
            if location.metadata(group) is not None:
                continue
        except IncompleteStoreError:
            pass
        location.write_json(group_document(stamped({}, "created")), group, METADATA)


def set_attributes(group: str, attributes_to_set: Mapping[str, Any], location: Location) -> None:
    stored = location.attributes(group)
    if not has_attributes(group, attributes_to_set, location):
        location.write_json(
            group_document({**stored, **stamped({**stored, **attributes_to_set}, "to_store")}),
            group,
            METADATA,
        )


def has_attributes(group: str, expected: Mapping[str, Any], location: Location) -> bool:
    # Return whether a group exists with the expected attributes, except `VOLATILE_ATTRS`.
    if not location.has(group, METADATA):
        return False
    stored, plain = location.attributes(group), group_document(expected)["attributes"]
    lasting = {key: value for key, value in plain.items() if key not in VOLATILE_ATTRS}
    return all(key in stored and stored[key] == value for key, value in lasting.items())


def listed_documents(location: Location) -> dict[str, Any]:
    # Return the consolidated metadata of the root by path, empty if it has none.
    try:
        root = location.read_json("", METADATA) or {}
    except IncompleteStoreError:
        return {}
    listed = root.get("consolidated_metadata")
    documents = listed.get("metadata") if isinstance(listed, dict) else None
    return dict(documents) if isinstance(documents, dict) else {}


def with_listed(root: Mapping[str, Any], documents: Mapping[str, Any]) -> dict[str, Any]:
    # Return the root's metadata with those of all nodes, as consolidated by zarr.
    listed = {}
    for path in sorted(documents, key=lambda path: (path.count("/"), path)):
        document = {key: value for key, value in documents[path].items() if key != "consolidated_metadata"}
        if document["node_type"] == "group":
            document["consolidated_metadata"] = {**LISTED, "metadata": {}}
        listed[path] = document
    return {**root, "consolidated_metadata": {**LISTED, "metadata": listed}}


# --- checks before a group is written ----------------------------------------------------------------------


def check_above(groups: Iterable[str], location: Location, problems: Problems, *, overwrite: bool) -> None:
    # Add the reasons why no group can be written below ``groups`` to the problems.
    #
    # ``overwrite``: whether damaged metadata may be replaced.
    entries = location.entries("")
    file = location.local is not None and location.local.is_file()
    # a store without the root's metadata has a manifest
    if file or (entries and METADATA not in entries and MANIFEST_NODE not in entries):
        problems.add("it exists and is not a Zarr v3 store", mend="choose another path", code="store-foreign")
        return
    parents = [] if location.local is None else location.local.absolute().parents
    if outer := [str(parent) for parent in parents if (parent / METADATA).is_file()]:
        problems.add(
            f"it is inside the store {outer[0]}",
            mend="write a group of that store, or choose another path",
            code="path-inside-store",
        )
        return
    for group in groups:
        try:
            # a store with only a manifest was left by a writer that was killed at its start
            damaged = location.metadata(group) is None and not group and bool({*entries} - {MANIFEST_NODE})
        except IncompleteStoreError:
            damaged = True
        problems.add_if(
            damaged and not overwrite,
            f"the metadata of group {'/' + group!r} are missing or damaged",
            mend="pass overwrite=True to replace them; the groups in it stay",
            option="pass --overwrite to replace them; the groups in it stay",
            code="metadata-damaged",
        )


def occupant(group: str, content: str, location: Location, manifest: Manifest | None) -> str:
    # Return the state of the path where a group with some content is to be written.
    #
    # ``""``: nothing. ``"same"``: this content, complete. ``"lacks chunks"``: this content, chunks missing.
    # ``"parent"``: other groups or files of other programs. ``"array"``: an array, there or at a parent. Any
    # other text describes a group that only ``overwrite`` replaces.
    kinds = [location.kind(node) for node in (*groups_above(group)[1:], group)]
    if "array" in kinds:
        return "array"
    entries = [name for name in location.entries(group) if name != MANIFEST_NODE or group]
    if not kinds[-1] and not entries:
        return ""
    stored, lacks_chunks = content_of(location, group, manifest), False
    if stored == content:
        try:
            if manifest is None:
                entry_of(location, group)
            else:
                check_entry(location, group, manifest)
            return "same"
        except StoreError:
            lacks_chunks = True
    # only arrays of the group, also damaged ones, may be overwritten
    children = {name: location.kind(joined(group, name)) for name in location.folders(group)}
    children.pop("" if group else MANIFEST_NODE, None)
    arrays = {
        name
        for name, node_type in children.items()
        if node_type == "array" or (node_type == "unreadable" and location.has(group, name, "c"))
    }
    if len(arrays) < len(children) or (group and location.strays(group)):
        return "parent"
    entry = manifest.groups.get(group) if manifest is not None else None
    added = sorted(arrays - set(entry.arrays)) if entry is not None else []
    if lacks_chunks and added:
        return f"lacks chunks, and contains {', '.join(added)} of other programs"
    if lacks_chunks:
        return "lacks chunks"
    return "with other content" if stored else "was not written by this version of hyperpaint"


#: Attributes of array wrappers of xarray and hyperpaint that refer to the wrapped array.
_INNER = ("array", "_array", "variable", "_data")


def reads_from(dataset: xr.Dataset, location: Any, group: str) -> list[str]:
    # Return the names of variables that read lazily from a group of a store or store object of zarr.
    return [
        str(name)
        for name, variable in dataset.variables.items()
        if any(_lies_in(array, location, group) for array in _zarr_arrays(variable))
    ]


def is_named_by_content(variable: xr.Variable) -> bool:
    # Return whether dask's name for a variable changes with the content of the Zarr arrays it reads.
    #
    # Usual names depend on the URL and the time of the root folder, names of `named_stores` on the content.
    return all(getattr(array.store_path.store, "content", "") for array in _zarr_arrays(variable))


def _zarr_arrays(variable: xr.Variable) -> Iterator[Any]:
    import dask
    import zarr
    from dask.blockwise import Blockwise

    pending: list[Any] = [] if variable._in_memory else [variable]
    # values in the layers of a graph, without creating their tasks
    if pending and dask.is_dask_collection(variable):
        pending = []
        for layer in variable.__dask_graph__().layers.values():  # type: ignore[union-attr]
            if isinstance(layer, Blockwise):
                pending += [layer.task, *(value for value, index in layer.indices if index is None)]
            else:
                pending += getattr(layer, "mapping", {}).values()
    # search the wrappers for zarr arrays
    visited: set[int] = set()
    while pending:
        value = pending.pop()
        if id(value) not in visited:
            visited.add(id(value))
            if isinstance(value, zarr.Array):
                yield value
            else:
                pending.extend(_parts(value))


def _parts(value: Any) -> Iterable[Any]:
    if isinstance(value, Mapping):
        return value.values()
    if isinstance(value, list | tuple | set):
        return value
    module = type(value).__module__.partition(".")[0]
    if module == "dask":  # Task, DataNode, Alias
        return (getattr(value, name) for name in ("args", "kwargs", "value") if hasattr(value, name))
    if module in ("xarray", "hyperpaint"):
        names = {slot for kind in type(value).__mro__ for slot in getattr(kind, "__slots__", ())}
        names |= set(getattr(value, "__dict__", ()))
        return (getattr(value, name) for name in _INNER if name in names)
    return ()


def _lies_in(array: Any, location: Any, group: str) -> bool:
    place = array.store_path
    if not isinstance(location, Location):
        return bool(place.store == location) and f"{place.path}/".startswith(f"{group}/" if group else "")
    root, base = getattr(place.store, "root", None), getattr(place.store, "path", None)
    if location.local is not None:  # local stores
        return root is not None and (Path(root) / place.path).resolve().is_relative_to(
            (location.local / group).resolve()
        )
    if base is None or root is not None:  # fsspec stores
        return False
    source = "/".join(part.strip("/") for part in (str(base), place.path) if part)
    return (source + "/").startswith(location.key(group).strip("/") + "/")
