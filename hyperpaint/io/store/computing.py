"""Where blocks are computed: on threads or a cluster; errors name the block, a bar shows the progress.

A cluster repeats a task whose worker died, and `RETRIES` times one that raised: a file system shared by many
nodes fails for a moment now and then. The result of a block is fetched as soon as it is done, so that the
death of a worker costs only the blocks it had in hand.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import sys
import time
import traceback
from collections.abc import Generator, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NoReturn

from hyperpaint.base.errors import PaintError, StoreError
from hyperpaint.base.schema import ALONG_TRACK

from .disk import RUN_AGAIN

if TYPE_CHECKING:
    import dask.array as da
    import numpy as np
    from distributed import Client

    from .chunks import Target

RETRIES = 3
"""How often a cluster repeats a task that raised an error, before the error counts."""

_SAME_FILES = "; every worker must see the same files, under the same paths"
_CANCELLED = (asyncio.CancelledError, concurrent.futures.CancelledError)

Key = tuple[Any, ...]
Found = Generator[tuple[Key, Any], None, None]


@dataclass(frozen=True)
class _Block:
    """One block to compute."""

    array: str
    sums: tuple[slice, ...]  # Its place among the array's checksums
    words: str  # Name its lines in messages


def compute(
    lazy: Mapping[str, da.Array], targets: Mapping[str, Target], *, group: str, progress: bool
) -> dict[str, np.ndarray[Any, Any]]:
    """Compute lazy checksums (`chunks.lazy_checksums`) together: what two arrays share is computed once.

    Raises
    ------
    StoreError
        A block could not be read, computed or written, or the cluster was lost; the message names group and
        block. Other errors of a task are raised as they are, with a note that names it.
    """
    import numpy as np
    from dask.highlevelgraph import HighLevelGraph

    if not lazy:
        return {}
    arrays = list(lazy.values())
    blocks: dict[Key, _Block] = {}
    for name, array in lazy.items():
        blocks |= _blocks(name, array, targets[name])
    merged = HighLevelGraph.merge(*(array.__dask_graph__() for array in arrays))
    # together: apart, what two arrays share would be fused into both
    graph = dict(arrays[0].__dask_optimize__(merged, list(blocks)))
    sums = {name: np.empty(array.shape, array.dtype) for name, array in lazy.items()}
    client = client_in_force()
    if client is None:
        stages = _stages(blocks, targets)
        results = _on_threads(scheduler_in_force(), graph, blocks, stages, group, progress=progress)
    else:
        results = _on_cluster(client, graph, blocks, group)
        results = _with_bar(results, len(blocks)) if progress else results
    with contextlib.closing(results):
        for key, value in results:
            sums[blocks[key].array][blocks[key].sums] = value
    return sums


def client_in_force() -> Client | None:
    """Return the client with which dask computes, None where it is none."""
    client = getattr(scheduler_in_force(), "__self__", None)
    return client if hasattr(client, "scheduler_info") else None


def scheduler_in_force() -> Any:
    """Return what dask computes arrays with.

    dask itself imports distributed to ask for a client, which takes a quarter of a second; where nobody has
    imported it, there is none.
    """
    import dask
    import dask.threaded
    from dask.base import get_scheduler

    if "distributed" in sys.modules or dask.config.get("scheduler", None):
        return get_scheduler() or dask.threaded.get
    return dask.threaded.get


@contextlib.contextmanager
def errors_of_the_cluster(what: str) -> Iterator[None]:
    """Turn lost workers, and a lost scheduler, into a StoreError; ``what`` opens the message."""
    try:
        yield
    except PaintError:
        raise
    except (Exception, *_CANCELLED) as error:
        reason = _cluster_failure(error)
        if reason is None:
            raise
        raise StoreError(f"{what}: {reason}; {RUN_AGAIN}") from error


# --- blocks ------------------------------------------------------------------------------------------------


def _blocks(name: str, sums: da.Array, target: Target) -> dict[Key, _Block]:
    """Return the blocks of an array by their keys in the graph."""
    import numpy as np
    from dask.array.core import slices_from_chunks

    dim, *_ = target.array.metadata.dimension_names or ("row",)
    called = "lines" if dim == ALONG_TRACK else dim
    blocks = {}
    for index, region in zip(np.ndindex(sums.numblocks), slices_from_chunks(sums.chunks), strict=True):
        first = region[0].start * target.chunk[0]
        last = min(region[0].stop * target.chunk[0], target.array.shape[0]) - 1
        blocks[(sums.name, *index)] = _Block(name, region, f"{called} {first} to {last} of {name}")
    return blocks


def _stages(blocks: Mapping[Key, _Block], targets: Mapping[str, Target]) -> dict[Key, int]:
    """Return when each block is computed: those of a map by rows of tiles, or by columns of a wide one."""
    shapes = [
        targets[block.array].array.shape for block in blocks.values() if _is_of_map(targets[block.array])
    ]
    if not shapes:
        return dict.fromkeys(blocks, 0)
    axis = int(shapes[0][1] > shapes[0][0])

    def cells(block: _Block, edge: str) -> int:
        return int(getattr(block.sums[axis], edge) * targets[block.array].chunk[axis])

    of_map = {key: block for key, block in blocks.items() if _is_of_map(targets[block.array])}
    size = max(cells(block, "stop") - cells(block, "start") for block in of_map.values())
    return {key: cells(block, "start") // size if key in of_map else 0 for key, block in blocks.items()}


def _is_of_map(target: Target) -> bool:
    return (target.array.metadata.dimension_names or ())[:2] == ("y", "x")


def _fed(graph: Mapping[Key, Any], blocks: Mapping[Key, _Block], key: Any) -> list[_Block]:
    """Return the blocks that a task of the graph is needed for."""
    from dask.core import get_deps

    _, dependents = get_deps(dict(graph))
    seen, pending = set(), [key]
    while pending:
        above = pending.pop()
        if above not in seen:
            seen.add(above)
            pending.extend(dependents.get(above, ()))
    return [block for name, block in blocks.items() if name in seen]


def _place(group: str, blocks: Iterable[_Block]) -> str:
    """Return words for a group's blocks; the group alone where the task was needed for many of them."""
    listed = list(blocks)
    words = dict.fromkeys(block.words for block in listed)
    arrays = {block.array for block in listed}
    return f"/{group}, {' and '.join(words)}" if 0 < len(words) == len(arrays) else f"/{group}"


# --- threads -----------------------------------------------------------------------------------------------


def _on_threads(
    get: Any, graph: dict[Key, Any], blocks: Mapping[Key, _Block], stages: Mapping[Key, int], group: str, *,
    progress: bool,
) -> Found:  # fmt: skip
    """Yield keys and checksums, a stage at a time; ``get`` is any scheduler of dask in this process."""
    from dask.callbacks import Callback

    from .stages import in_stages

    with contextlib.ExitStack() as stack:
        if progress:
            bar = stack.enter_context(_bar(len(blocks)))
            bar.advance(0)

            def count(key: Any, *_: Any) -> None:
                if key in blocks:
                    bar.advance()

            stack.enter_context(Callback(posttask=count))
        try:
            yield from in_stages(get, graph, stages)
        except Exception as error:
            failed = _failed_task(error)
            _raise_named(error, _place(group, [] if failed is None else _fed(graph, blocks, failed)))


def _failed_task(error: BaseException) -> Any:
    """Return the key of the task that raised an error, None where it is not known."""
    from dask.local import execute_task

    for frame, _ in traceback.walk_tb(error.__traceback__):
        if frame.f_code is execute_task.__code__:
            return frame.f_locals.get("key")
    return None


# --- cluster -----------------------------------------------------------------------------------------------


def _on_cluster(client: Client, graph: dict[Key, Any], blocks: Mapping[Key, _Block], group: str) -> Found:
    """Yield keys and checksums as they come."""
    from distributed import as_completed

    with errors_of_the_cluster(f"cannot store /{group}"):
        futures = client.get(graph, list(blocks), sync=False, retries=RETRIES)
    wanted = {future.key: future for future in futures}
    del futures
    try:
        for future, result in as_completed(wanted.values(), with_results=True, raise_errors=False):
            # not the future's status: it may be lost again, with its worker, since the result was fetched
            if isinstance(result, tuple | BaseException):
                # a task's error comes with its type and traceback, a cancellation as it is
                error = result[1] if isinstance(result, tuple) else result
                hint = _SAME_FILES if isinstance(error, FileNotFoundError | PermissionError) else ""
                _raise_named(error, _place(group, [blocks[future.key]]), hint)
            # the cluster forgets what is fetched: a worker that dies takes no finished block with it
            del wanted[future.key]
            yield future.key, result
    finally:
        # the cluster would remember failed tasks for as long as a traceback holds their futures, and another
        # run would fail with them
        if wanted:
            with contextlib.suppress(Exception):  # of a scheduler that is lost
                client.cancel(list(wanted.values()), force=True)


def _with_bar(results: Found, total: int) -> Found:
    """Draw a bar while blocks come in; distributed's own vanishes in notebooks and at its end."""
    with contextlib.closing(results), _bar(total) as bar:
        for each in results:
            bar.advance()
            yield each


def _cluster_failure(error: BaseException) -> str | None:
    """Return what happened to the cluster, None for an error of other origin."""
    if type(error).__name__ == "KilledWorker":
        times = getattr(error, "allowed_failures", 0) + 1
        last = getattr(getattr(error, "last_worker", None), "address", "unknown")
        workers = "a worker" if times == 1 else f"{times} workers"
        return f"{workers} died over it, last {last}, whose log may say why; mostly it is too little memory"
    if isinstance(error, _CANCELLED):
        reason = getattr(error, "reason", error)
        return "the scheduler was lost" if "connection" in str(reason) else f"it was cancelled ({reason})"
    if type(error).__module__.partition(".")[0] == "distributed":
        return f"the cluster was lost ({type(error).__name__}: {error})"
    return None


def _raise_named(error: BaseException, place: str, hint: str = "") -> NoReturn:
    """Raise a task's error so that it names the block; those of system, memory, cluster as StoreError."""
    reason = _cluster_failure(error)
    if reason is None and not isinstance(error, PaintError) and isinstance(error, OSError | MemoryError):
        reason = f"{type(error).__name__}: {error}{hint}; mend this"
    if reason is None:
        error.add_note(f"while storing {place}")
        raise error
    raise StoreError(f"cannot store {place}: {reason}; {RUN_AGAIN}") from error


_WIDTH = 40
_FEWEST = 0.02  # share that must be done before the rest is guessed


class BlockBar:
    """A bar on stdout over ``total`` blocks, as dask draws it, with the time that is left."""

    def __init__(self, total: int) -> None:
        self._total, self._done, self._shown = total, 0, 0
        self._begun = time.perf_counter()

    def advance(self, blocks: int = 1) -> None:
        """Count blocks that are done, and draw."""
        from dask.utils import format_time

        self._done += blocks
        elapsed = time.perf_counter() - self._begun
        share = self._done / max(self._total, 1)
        bar, percent = "#" * int(_WIDTH * share), int(100 * share)
        text = f"[{bar:<{_WIDTH}}] | {percent}% Completed | {format_time(elapsed)}"
        if _FEWEST <= share < 1.0:
            text += f", {format_time(elapsed / share - elapsed).strip()} left"
        # what a longer text has left would stay
        sys.stdout.write(("\r" + " " * self._shown if len(text) < self._shown else "") + "\r" + text)
        sys.stdout.flush()
        self._shown = len(text)


@contextlib.contextmanager
def _bar(total: int) -> Iterator[BlockBar]:
    """Yield a bar; an error is reported below it."""
    try:
        yield BlockBar(total)
    finally:
        sys.stdout.write("\n")
        sys.stdout.flush()
