"""Compute maps in stages, so that slabs needed by several tiles leave memory early.

If one task computes several variables of a map, dask computes the variables one after another, and keeps all
slabs of the flight line in memory until the last. Here the tiles of one row (or of one column, if a map is
wider than high) are a stage. Results that a later stage needs are passed on, so that every task runs once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

Key = Any


def in_stages(
    get: Callable[..., Any], graph: Mapping[Key, Any], stage_of: Mapping[Key, int]
) -> Iterator[tuple[Key, Any]]:
    """Yield the keys of a graph in ``stage_of`` and their values, stage by stage.

    ``get``: scheduler of dask; ``stage_of``: stages by key.

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
    # first and last stage that needs the value of a key
    first_stage: dict[Key, int] = {}
    for target, stage in sorted(stage_of.items(), key=lambda item: item[1]):
        pending = [target]
        while pending:
            key = pending.pop()
            if key not in first_stage:
                first_stage[key] = stage
                pending.extend(dependencies[key])
    last_stage = {
        key: max(
            (first_stage[dependent] for dependent in dependents[key] if dependent in first_stage), default=0
        )
        for key in first_stage
    }
    by_stage: dict[int, list[Key]] = {}
    for key, stage in first_stage.items():
        by_stage.setdefault(stage, []).append(key)
    carried: dict[Key, Any] = {}
    for stage in sorted(by_stage):
        tasks = by_stage[stage]
        targets = [key for key in tasks if key in stage_of]
        shared = [key for key in tasks if last_stage[key] > stage]
        values = get({key: graph[key] for key in tasks} | carried, [*targets, *shared])
        yield from zip(targets, values, strict=False)
        carried = {key: node for key, node in carried.items() if last_stage[key] > stage}
        carried |= {
            key: DataNode(key, value) for key, value in zip(shared, values[len(targets) :], strict=True)
        }
        del values
