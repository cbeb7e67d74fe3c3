"""Which Zarr arrays a dataset still reads from: a store must not be overwritten by what it feeds."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .location import Location

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["is_named_by_content", "reads_from"]

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
    found = "/".join(part.strip("/") for part in (str(base), place.path) if part)
    return (found + "/").startswith(location.key(group).strip("/") + "/")
