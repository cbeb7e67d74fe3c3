"""Compute maps in stages, so that slabs shared by tiles leave memory early.

If one task makes several variables of a map, dask computes the variables one after another, and holds every
slab of the flight line until the last. Here the tiles of one row (or column, of a map that is wider than
high) are a stage. Results that a later stage needs are passed on, so that nothing is computed twice.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

Key = Any


def in_stages(
    get: Callable[..., Any], graph: Mapping[Key, Any], stage_of: Mapping[Key, int]
) -> Iterator[tuple[Key, Any]]:
    """Yield wanted keys and their values, stage by stage.

    ``get`` is a scheduler of dask; ``stage_of`` maps the wanted keys to their stages.

    Examples
    --------
    >>> from operator import add
    >>> graph = {"slab": 1, "first": (add, "slab", 1), "second": (add, "slab", 2)}
    >>> import dask
    >>> dict(in_stages(dask.get, graph, {"first": 0, "second": 1}))
    {'first': 2, 'second': 3}
    """
    if len(set(stage_of.values())) < 2:
        keys = list(stage_of)
        yield from zip(keys, get(dict(graph), keys), strict=True)
        return
    from dask._task_spec import DataNode
    from dask.core import get_deps

    dependencies, dependents = get_deps(dict(graph))
    # the first and the last stage that needs a task
    first: dict[Key, int] = {}
    for target, stage in sorted(stage_of.items(), key=lambda item: item[1]):
        pending = [target]
        while pending:
            key = pending.pop()
            if key not in first:
                first[key] = stage
                pending.extend(dependencies[key])
    last = {key: max((first[each] for each in dependents[key] if each in first), default=0) for key in first}
    by_stage: dict[int, list[Key]] = {}
    for key, stage in first.items():
        by_stage.setdefault(stage, []).append(key)
    carried: dict[Key, Any] = {}
    for stage in sorted(by_stage):
        tasks = by_stage[stage]
        wanted = [key for key in tasks if key in stage_of]
        later = [key for key in tasks if last[key] > stage]
        values = get({key: graph[key] for key in tasks} | carried, [*wanted, *later])
        yield from zip(wanted, values, strict=False)
        carried = {key: node for key, node in carried.items() if last[key] > stage}
        carried |= {
            key: DataNode(key, value) for key, value in zip(later, values[len(wanted) :], strict=True)
        }
        del values
