"""Workers of a cluster that are killed amid a run: the store is right, or an error names the block."""

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

import dask

import hyperpaint as hp
from hyperpaint.base.errors import PaintError
from hyperpaint.io.store import is_complete, list_groups
from hyperpaint.simulation import simulate_collect, simulate_line

from .interruptions import GROUP, chunks_of
from .outcome import Outcome, each, numbers_of

RUNS = 30
_LINES, _DELAY = 768, 0.12
_COLLECT = {"scene": "plan", "lines": 2560, "bands": 24, "columns": 40, "cubes": 2, "seed": 5}
_WAIT = 60.0
_SETTINGS = {
    # workers are forked by a server that has imported everything: they are back within a moment
    "distributed.worker.multiprocessing-method": "forkserver",
    # a worker that is away at two looks is not given up: it was killed twice
    "distributed.deploy.lost-worker-timeout": "1 hour",
}
#: How often a task's worker may die before dask gives the task up: few, so that some runs end with an error.
_ALLOWED_FAILURES = (0, 1, 3)
_NAMED = re.compile(r"/[\w/]+, \w+ \d+ to \d+ of \w+|the first lines of /[\w/]+")


def kills_in(number: int) -> int:
    # Return how many workers die in a run: 100 in 30
    return 3 + (number % 3 == 0)


class Cluster(contextlib.ExitStack):
    # Two workers, each with a nanny that starts it again; a context manager
    def __enter__(self) -> "Cluster":
        from distributed import Client, LocalCluster
        from distributed.utils import get_mp_context

        self.enter_context(dask.config.set(_SETTINGS))
        # the server is one for the whole process: the writers' children come from it, too
        get_mp_context().set_forkserver_preload(
            ["distributed", "dask.array", "zarr", "hyperpaint.kernels.radiometry", __name__]
        )
        options = {"threads_per_worker": 1, "dashboard_address": ":0", "silence_logs": logging.CRITICAL}
        self.local = self.enter_context(LocalCluster(n_workers=2, **options))
        self.enter_context(Client(self.local))
        self.killed: set[int] = set()
        return self

    def kill(self, which: int) -> None:
        # Kill one of the workers; wait for it to be there first
        until = time.monotonic() + _WAIT
        while time.monotonic() < until:
            nanny = list(self.local.workers.values())[which]
            if nanny.status.name == "running" and nanny.pid and nanny.pid not in self.killed:
                self.killed.add(nanny.pid)
                os.kill(nanny.pid, signal.SIGKILL)
                return
            time.sleep(0.01)
        raise TimeoutError(f"no worker to kill within {_WAIT:.0f} s")


class Task:
    # What is written, what an undisturbed run writes, and how long that takes on the cluster
    def __init__(self, write: Callable[[Path], Any], folder: Path, seconds: float | None = None) -> None:
        self.write, place = write, folder / f"whole-{id(self)}.zarr"
        with dask.config.set(scheduler="threads"):
            write(place)
        self.chunks = chunks_of(place)
        # the first run on the cluster also compiles and imports
        for attempt in range(2 if seconds is None else 0):
            began = time.monotonic()
            write(place.with_name(f"{attempt}-{place.name}"))
            seconds = time.monotonic() - began
        self.seconds = seconds or 0.0


def _slow(block: Any) -> Any:
    time.sleep(_DELAY)
    return block


def _store_line(path: Path) -> None:
    line = simulate_line(lines=_LINES, bands=8, columns=12, seed=3).chunk({"along_track": 32})
    line["counts"] = line["counts"].copy(data=line["counts"].data.map_blocks(_slow, dtype="uint16"))
    hp.to_store(line.paint.reflectance(keep_bits=12), path, GROUP, source_token="workers")


def storing(folder: Path, seconds: float | None = None) -> Task:
    # Return `to_store` of a line whose slabs take their time
    return Task(_store_line, folder, seconds)


def processing(folder: Path) -> Task:
    # Return `process` of a collect of two lines
    return Task(functools.partial(hp.process, simulate_collect(folder / "raw", **_COLLECT)), folder)


def run_kills(number: int, folder: Path, cluster: Cluster, task: Task, outcome: Outcome) -> None:
    # Kill workers at random instants of a run; run again after an error, until the store is there
    rng, path = random.Random(f"workers:{number}"), folder / "lot.zarr"
    instants = sorted((rng.uniform(0.0, task.seconds), rng.randrange(2)) for _ in range(kills_in(number)))
    scheduler: Any = cluster.local.scheduler
    scheduler.allowed_failures = _ALLOWED_FAILURES[number % len(_ALLOWED_FAILURES)]
    amid: list[bool] = []
    running = threading.Event()
    running.set()

    def kill() -> None:
        began = time.monotonic()
        for instant, which in instants:
            time.sleep(max(0.0, began + instant - time.monotonic()))
            cluster.kill(which)
            amid.append(running.is_set())

    killer = threading.Thread(target=kill)
    killer.start()
    undisturbed = False
    while True:
        if undisturbed:
            scheduler.allowed_failures = max(_ALLOWED_FAILURES)
        try:
            task.write(path)
            break
        except Exception as error:  # whatever comes out is what is looked at
            _look_at(error, number, task, path, outcome)
            if undisturbed:
                outcome.wrong.append(f"run {number}: nobody was killed, and yet it fails")
                return
        undisturbed = not killer.is_alive()
    running.clear()
    killer.join()
    outcome.count += len(amid)
    outcome.notes["amid a run"] += sum(amid)
    outcome.notes["runs"] += 1
    left = sorted({entry.name for entry in folder.iterdir()} - {"lot.zarr"})
    for wrong, text in (
        (not hp.verify(path).ok, "verify finds it damaged"),
        (chunks_of(path) != task.chunks, "it differs from an undisturbed run"),
        (left, f"left beside the store: {left}"),
    ):
        if wrong:
            outcome.wrong.append(f"run {number}: {text}")


def _look_at(error: Exception, number: int, task: Task, path: Path, outcome: Outcome) -> None:
    # Note an error that does not name the block, and a group that is taken for complete and is not
    outcome.notes["clean errors"] += 1
    if not isinstance(error, PaintError) or not _NAMED.search(str(error)):
        outcome.wrong.append(f"run {number}: {type(error).__name__}: {error!s:.300}")
    written = chunks_of(path)
    for group in list_groups(path) if path.exists() else ():
        there, whole = (
            {key: value for key, value in chunks.items() if key.startswith(f"{group}/")}
            for chunks in (written, task.chunks)
        )
        if is_complete(path, group) and there != whole:
            outcome.wrong.append(f"run {number}: /{group} is taken for complete, but is not")


def campaign(scale: float = 1.0, *, first: int = 0) -> Iterator[Outcome]:
    # Yield the outcome of every run; every third three of them are a whole `process`
    with tempfile.TemporaryDirectory() as scratch, Cluster() as cluster:
        tasks = [make(Path(scratch)) for make in (storing, processing)]
        for number in numbers_of(RUNS, scale, first):
            yield from each(
                "workers killed", range(number, number + 1), run_kills, cluster, tasks[number // 3 % 3 == 1]
            )
