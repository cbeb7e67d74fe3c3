"""What writing a group would lose: what stands in its place, and what the dataset still reads."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hyperpaint.base.errors import IncompleteStoreError

from .listing import groups_above, has_all_chunks, is_damaged
from .location import METADATA, Location, is_temporary
from .record import CHUNKS, COMPLETE, read_record

if TYPE_CHECKING:
    import xarray as xr


def problems_above(groups: Iterable[str], location: Location, *, overwrite: bool) -> list[str]:
    """Return why groups cannot be written below ``groups``, one line each; empty where they can.

    With ``overwrite``, damaged metadata may be written anew.
    """
    if _is_foreign(location):
        return ["it exists and is not a Zarr v3 store; choose another path"]
    return [
        f"the metadata of group {'/' + group!r} are missing or damaged; pass overwrite=True to write them "
        "anew, the groups in it stay"
        for group in ([] if overwrite else damaged_groups(groups, location))
    ]


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
    if record is not None and record.token == token:
        return "same" if has_all_chunks(location, group, record) else "lacks chunks"
    below = (f"{group}/{child}" if group else child for child in location.folders(group))
    if not all(_is_array(location, path) for path in below):
        return "parent"
    return "was never finished or is damaged" if record is None else "with other content"


def _is_foreign(location: Location) -> bool:
    """Tell whether something else than a store is in its place."""
    if not location.has("") or location.has("", METADATA):
        return False
    if location.local is not None and not location.local.is_dir():
        return True
    # without the root's metadata it is still one where a group of it is
    return bool(_entries(location, "")) and not any(_is_sealed(each, location) for each in location.groups())


def _is_sealed(group: str, location: Location) -> bool:
    return COMPLETE in ((location.metadata(group) or {}).get("attributes") or {})


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
