"""Workers of a cluster that are killed amid a run: the store is right, or an error names the block."""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import random
import re
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import hyperpaint as hp
from hyperpaint.base.errors import PaintError
from hyperpaint.io.store import is_complete, list_groups
from hyperpaint.simulation import simulate_collect, simulate_line

from .outcome import Outcome

__all__ = ["RUNS", "Cluster", "Work", "campaign", "kills_in", "processing", "run_kills", "storing"]

RUNS = 30
GROUP = "flightlines/raw_0"
_LINES, _DELAY = 768, 0.12
_COLLECT = {"scene": "plan", "lines": 2560, "bands": 24, "columns": 40, "cubes": 2, "seed": 5}
_WAIT = 60.0
_SETTINGS = {
    # workers are forked by a server that has imported everything: they are back within a moment
    "distributed.worker.multiprocessing-method": "forkserver",
    # a worker that is away at two looks is not given up: it was killed twice
    "distributed.deploy.lost-worker-timeout": "1 hour",
}
#: The server is one for the whole process: the writers' children come from it, too.
_PRELOAD = ["distributed", "dask.array", "zarr", "hyperpaint.kernels.radiometry", __name__]
_PRELOAD += ["campaigns.faults.writers"]
#: How often a task's worker may die before dask gives the task up: few, so that some runs end with an error.
_ALLOWED_FAILURES = (0, 1, 3)
_NAMED = re.compile(r"/[\w/]+, \w+ \d+ to \d+ of \w+|the first lines of /[\w/]+")


def kills_in(number: int) -> int:
    """Return how many workers die in a run: 100 in 30."""
    return 3 + (number % 3 == 0)


class Cluster:
    """Two workers, each with a nanny that starts it again; a context manager."""

    def __enter__(self) -> Cluster:
        import dask
        from distributed import Client, LocalCluster
        from distributed.utils import get_mp_context

        with contextlib.ExitStack() as stack:
            stack.enter_context(dask.config.set(_SETTINGS))
            get_mp_context().set_forkserver_preload(_PRELOAD)
            self._local = stack.enter_context(
                LocalCluster(
                    n_workers=2, threads_per_worker=1, dashboard_address=":0", silence_logs=logging.CRITICAL
                )
            )
            stack.enter_context(Client(self._local))
            self._stack = stack.pop_all()
        self._killed: set[int] = set()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def allow_failures(self, count: int) -> None:
        """Set how often a task's worker may die before dask gives the task up."""
        self._local.scheduler.allowed_failures = count

    def kill(self, which: int) -> None:
        """Kill one of the workers; wait for it to be there first."""
        until = time.monotonic() + _WAIT
        while time.monotonic() < until:
            nanny = list(self._local.workers.values())[which]
            if nanny.status.name == "running" and nanny.pid and nanny.pid not in self._killed:
                self._killed.add(nanny.pid)
                os.kill(nanny.pid, signal.SIGKILL)
                return
            time.sleep(0.01)
        msg = f"no worker to kill within {_WAIT:.0f} s"
        raise TimeoutError(msg)


class Work:
    """What is written, and what an undisturbed run writes; by ``to_store`` or by ``process``."""

    def __init__(self, name: str, write: Callable[[Path], Any], folder: Path) -> None:
        import dask

        self.name, self.write = name, write
        with dask.config.set(scheduler="threads"):
            write(folder / f"{name}.zarr")
        self.chunks = _chunks(folder / f"{name}.zarr")
        self.seconds = 0.0

    def measure(self, folder: Path) -> None:
        """Note how long an undisturbed run takes; the first one also compiles and imports."""
        for attempt in range(2):
            begun = time.monotonic()
            self.write(folder / f"{self.name}-{attempt}.zarr")
            self.seconds = time.monotonic() - begun


def _slow(block: Any) -> Any:
    time.sleep(_DELAY)
    return block


def _store_line(path: Path) -> None:
    line = simulate_line(lines=_LINES, bands=8, columns=12, seed=3).chunk({"along_track": 32})
    line["counts"] = line["counts"].copy(data=line["counts"].data.map_blocks(_slow, dtype="uint16"))
    hp.to_store(line.paint.reflectance(keep_bits=12), path, GROUP, source_token="workers")


def _process(collect: Path, path: Path) -> None:
    hp.process(collect, path)


def storing(folder: Path) -> Work:
    """Return `to_store` of a line whose slabs take their time."""
    return Work("to_store", _store_line, folder)


def processing(folder: Path) -> Work:
    """Return `process` of a collect of two lines."""
    return Work("process", functools.partial(_process, simulate_collect(folder / "raw", **_COLLECT)), folder)


def _chunks(path: Path) -> dict[str, bytes]:
    files = (file for file in sorted(path.rglob("*")) if file.is_file() and "c" in file.parts)
    return {str(file.relative_to(path)): file.read_bytes() for file in files}


def _of(group: str, chunks: dict[str, bytes]) -> dict[str, bytes]:
    return {key: value for key, value in chunks.items() if key.startswith(f"{group}/")}


def run_kills(number: int, cluster: Cluster, work: Work, folder: Path, made: Outcome) -> None:
    """Kill workers at random instants of a run; run again after an error, until the store is there.

    Parameters
    ----------
    number
        Of the run.
    folder
        Empty.
    made
        Takes the outcome.
    """
    rng = random.Random(f"workers:{number}")
    path = folder / "lot.zarr"
    instants = sorted((rng.uniform(0.0, work.seconds), rng.randrange(2)) for _ in range(kills_in(number)))
    cluster.allow_failures(_ALLOWED_FAILURES[number % len(_ALLOWED_FAILURES)])
    amid: list[bool] = []
    running = threading.Event()
    running.set()

    def kill() -> None:
        begun = time.monotonic()
        for instant, which in instants:
            time.sleep(max(0.0, begun + instant - time.monotonic()))
            cluster.kill(which)
            amid.append(running.is_set())

    killer = threading.Thread(target=kill)
    killer.start()
    undisturbed = False
    while True:
        if undisturbed:
            cluster.allow_failures(max(_ALLOWED_FAILURES))
        try:
            work.write(path)
            break
        except Exception as error:  # whatever comes out is what is looked at
            _look_at(error, number, work, path, made)
            if undisturbed:
                made.wrong.append(f"run {number}: nobody was killed, and yet it fails")
                return
        undisturbed = not killer.is_alive()
    running.clear()
    killer.join()
    made.count += len(amid)
    made.notes["amid a run"] += sum(amid)
    made.notes["runs"] += 1
    if not hp.verify(path).ok:
        made.wrong.append(f"run {number}: verify finds it damaged")
    if _chunks(path) != work.chunks:
        made.wrong.append(f"run {number}: it differs from an undisturbed run")
    if left := sorted({entry.name for entry in folder.iterdir()} - {"lot.zarr"}):
        made.wrong.append(f"run {number}: left beside the store: {left}")


def _look_at(error: Exception, number: int, work: Work, path: Path, made: Outcome) -> None:
    """Note an error that does not name the block, and a group that is taken for complete and is not."""
    made.notes["clean errors"] += 1
    if not isinstance(error, PaintError) or not _NAMED.search(str(error)):
        made.wrong.append(f"run {number}: {type(error).__name__}: {error!s:.300}")
    for group in list_groups(path) if path.exists() else ():
        if is_complete(path, group) and _of(group, _chunks(path)) != _of(group, work.chunks):
            made.wrong.append(f"run {number}: /{group} is taken for complete, but is not")


def campaign(scale: float = 1.0, *, first: int = 0) -> Iterator[Outcome]:
    """Yield the outcome of every run; every third three of them are a whole `process`."""
    with tempfile.TemporaryDirectory() as scratch, Cluster() as cluster:
        works = [make(Path(scratch)) for make in (storing, processing)]
        for work in works:
            work.measure(Path(scratch))
        for number in range(first, first + max(1, round(RUNS * scale))):
            made = Outcome("workers killed")
            with tempfile.TemporaryDirectory() as folder:
                run_kills(number, cluster, works[number // 3 % 3 == 1], Path(folder), made)
            yield made
