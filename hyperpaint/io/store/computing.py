"""Compute blocks on threads or a cluster; errors name the block, a bar shows the progress.

A cluster repeats a task whose worker died, and up to `RETRIES` times a task that raised an error, since a
file system shared by many nodes may fail for a moment. The result of a block is fetched as soon as it is
computed, so that a worker that dies loses only its current blocks.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import sys
import time
import traceback
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from hyperpaint.base.errors import PaintError, StoreError
from hyperpaint.base.schema import ALONG_TRACK

from .disk import RUN_AGAIN

if TYPE_CHECKING:
    import dask.array as da
    from distributed import Client

    from .chunks import Target

# Number of times a cluster repeats a task that raised an error.
RETRIES = 3

_SAME_FILES = "; every worker must see the same files, under the same paths"
_CANCELLED = (asyncio.CancelledError, concurrent.futures.CancelledError)

Key = Any  # Of dask: a text, or a tuple of a name and numbers
Results = Generator[tuple[Key, Any], None, None]


@dataclass(frozen=True)
class _Block:
    array: str
    sums: tuple[slice, ...]  # Its region in the checksums of the array
    words: str  # Description of its lines, for messages
    stage: int  # Stages are computed one after the other


def compute(
    lazy: Mapping[str, da.Array], targets: Mapping[str, Target], *, group: str, progress: bool
) -> dict[str, np.ndarray[Any, Any]]:
    # Compute lazy checksums (`chunks.lazy_checksums`) together, so that tasks of two arrays run once.
    #
    # Raises `StoreError`: A block could not be read, computed or written, or the cluster was lost; the
    # message names group and block. Other errors of a task are raised unchanged, with a note that names it.
    from dask.array.core import slices_from_chunks
    from dask.highlevelgraph import HighLevelGraph

    if not lazy:
        return {}
    # stages of a map are rows of tiles, or columns if it is wider than high
    maps = [name for name in lazy if targets[name].dims[:2] == ("y", "x")]
    axis = int(bool(maps) and targets[maps[0]].shape[1] > targets[maps[0]].shape[0])
    size = max((max(lazy[name].chunks[axis]) * targets[name].chunk[axis] for name in maps), default=1)
    blocks: dict[Key, _Block] = {}
    for name, array in lazy.items():
        target = targets[name]
        plural = "lines" if target.dims[0] == ALONG_TRACK else target.dims[0]
        for index, region in zip(np.ndindex(array.numblocks), slices_from_chunks(array.chunks), strict=True):
            start = region[0].start * target.chunk[0]
            end = min(region[0].stop * target.chunk[0], target.shape[0]) - 1
            stage = region[axis].start * target.chunk[axis] // size if name in maps else 0
            blocks[(array.name, *index)] = _Block(name, region, f"{plural} {start} to {end} of {name}", stage)
    arrays = list(lazy.values())
    merged = HighLevelGraph.merge(*(array.__dask_graph__() for array in arrays))
    # the arrays are optimised together, so that dask does not fuse a shared task into both
    graph = dict(arrays[0].__dask_optimize__(merged, list(blocks)))
    sums = {name: np.empty(array.shape, array.dtype) for name, array in lazy.items()}
    client = client_in_force()
    with contextlib.ExitStack() as stack:
        bar = stack.enter_context(BlockBar(len(blocks))) if progress else None
        if client is None:
            results = _on_threads(scheduler_in_force(), graph, blocks, group, bar)
        else:
            results = _on_cluster(client, graph, blocks, group, bar)
        stack.enter_context(contextlib.closing(results))
        for key, value in results:
            sums[blocks[key].array][blocks[key].sums] = value
    return sums


def client_in_force() -> Client | None:
    # Return the current client of dask.distributed, None without a cluster.
    client = getattr(scheduler_in_force(), "__self__", None)
    return client if hasattr(client, "scheduler_info") else None


def scheduler_in_force() -> Any:
    # Return the scheduler with which dask computes arrays.
    #
    # Without an import of distributed there is no client. dask would import it to look for one, which takes a
    # quarter of a second.
    import dask
    import dask.threaded
    from dask.base import get_scheduler

    if "distributed" in sys.modules or dask.config.get("scheduler", None):
        return get_scheduler() or dask.threaded.get
    return dask.threaded.get


@contextlib.contextmanager
def errors_of_the_cluster(subject: str) -> Iterator[None]:
    # Raise a StoreError for lost workers or a lost scheduler; ``subject`` begins the message.
    try:
        yield
    except (Exception, *_CANCELLED) as error:
        reason = _cluster_failure(error)
        if reason is None:
            raise
        raise StoreError(f"{subject}: {reason}", mend=RUN_AGAIN, code="cluster-lost") from error


def _on_threads(
    get: Any, graph: dict[Key, Any], blocks: Mapping[Key, _Block], group: str, bar: BlockBar | None
) -> Results:
    # Keys and checksums, stage by stage; ``get``: scheduler of dask in this process
    from dask.callbacks import Callback
    from dask.core import get_deps
    from dask.local import execute_task

    def count(key: Any, *_: Any) -> None:
        if bar is not None and key in blocks:
            bar.advance()

    try:
        with Callback(posttask=count):
            yield from in_stages(get, graph, {key: block.stage for key, block in blocks.items()})
    except Exception as error:
        # find the blocks that depend on the failed task
        frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
        pending = [frame.f_locals.get("key") for frame in frames if frame.f_code is execute_task.__code__]
        _, dependents = get_deps(graph)
        affected: set[Any] = set()
        while pending:
            key = pending.pop()
            if key not in affected:
                affected.add(key)
                pending.extend(dependents.get(key, ()))
        _raise_named(error, group, [block for key, block in blocks.items() if key in affected])


def _on_cluster(
    client: Client, graph: dict[Key, Any], blocks: Mapping[Key, _Block], group: str, bar: BlockBar | None
) -> Results:
    from distributed import as_completed

    with errors_of_the_cluster(f"cannot store /{group}"):
        futures = client.get(graph, list(blocks), sync=False, retries=RETRIES)
    futures_by_key = {future.key: future for future in futures}
    del futures
    try:
        for future, result in as_completed(futures_by_key.values(), with_results=True, raise_errors=False):
            # the future's status may have changed since the result was fetched, if its worker died
            if isinstance(result, tuple | BaseException):
                # the error of a task is a tuple with type and traceback, a cancellation is an exception
                error = result[1] if isinstance(result, tuple) else result
                hint = _SAME_FILES if isinstance(error, FileNotFoundError | PermissionError) else ""
                _raise_named(error, group, [blocks[future.key]], hint)
            # released, so that a worker that dies loses no finished block
            del futures_by_key[future.key]
            if bar is not None:
                bar.advance()
            yield future.key, result
    finally:
        # cancelled, since a traceback keeps the futures of failed tasks, and the next run would get them
        if futures_by_key:
            with contextlib.suppress(Exception):  # the scheduler may be lost
                client.cancel(list(futures_by_key.values()), force=True)


def in_stages(
    get: Callable[..., Any], graph: Mapping[Key, Any], stage_of: Mapping[Key, int]
) -> Iterator[tuple[Key, Any]]:
    """Yield the keys of a graph in ``stage_of`` and their values, stage by stage.

    If one task computes several variables of a map, dask computes the variables one after another, and
    keeps all slabs of the flight line in memory until the last. Here the tiles of one row (or of one
    column, if a map is wider than high) are a stage. Results that a later stage needs are passed on, so
    that every task runs once.

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


def _cluster_failure(error: BaseException) -> str | None:
    # Description of a failure of the cluster, None for other errors
    if type(error).__name__ == "KilledWorker":
        times = getattr(error, "allowed_failures", 0) + 1
        worker = getattr(getattr(error, "last_worker", None), "address", "unknown")
        workers = "a worker" if times == 1 else f"{times} workers"
        return f"{workers} died during it, last {worker}; see its log; most often memory is too small"
    if isinstance(error, _CANCELLED):
        reason = getattr(error, "reason", error)
        return "the scheduler was lost" if "connection" in str(reason) else f"it was cancelled ({reason})"
    if type(error).__module__.partition(".")[0] == "distributed":
        return f"the cluster was lost ({type(error).__name__}: {error})"
    return None


def _raise_named(error: BaseException, group: str, blocks: Sequence[_Block], hint: str = "") -> NoReturn:
    # Raise a task's error with the names of its blocks; an error of system, memory or cluster as StoreError.
    # A task that several blocks of an array need is named by its group only.
    words = dict.fromkeys(block.words for block in blocks)
    is_one_each = 0 < len(words) == len({block.array for block in blocks})
    subject = f"/{group}, {' and '.join(words)}" if is_one_each else f"/{group}"
    reason = _cluster_failure(error)
    if reason is None and not isinstance(error, PaintError) and isinstance(error, OSError | MemoryError):
        reason = f"{type(error).__name__}: {error}{hint}"
    if reason is None:
        error.add_note(f"while storing {subject}")
        raise error
    raise StoreError(f"cannot store {subject}: {reason}", mend=RUN_AGAIN, code="block-failed") from error


_WIDTH = 40
_MIN_SHARE = 0.02  # share finished before the remaining time is estimated


class BlockBar:
    # A progress bar on stdout for ``total`` blocks, in dask's style, with the remaining time.
    def __init__(self, total: int) -> None:
        self._total, self._done, self._shown = total, 0, 0
        self._begun = time.perf_counter()

    def __enter__(self) -> BlockBar:
        self.advance(0)
        return self

    def __exit__(self, *_: object) -> None:
        sys.stdout.write("\n")  # an error is reported below the bar
        sys.stdout.flush()

    def advance(self, blocks: int = 1) -> None:
        # Count finished blocks, and draw.
        from dask.utils import format_time

        self._done += blocks
        elapsed = time.perf_counter() - self._begun
        share = self._done / max(self._total, 1)
        bar, percent = "#" * int(_WIDTH * share), int(100 * share)
        text = f"[{bar:<{_WIDTH}}] | {percent}% Completed | {format_time(elapsed)}"
        if _MIN_SHARE <= share < 1.0:
            text += f", {format_time(elapsed / share - elapsed).strip()} left"
        # blanks first, to erase the end of a longer text
        sys.stdout.write("\r" + " " * self._shown + "\r" + text)
        sys.stdout.flush()
        self._shown = len(text)
