"""Writers that are killed, and writers that race: a store is whole, or it says that it is not."""

from __future__ import annotations

import multiprocessing
import os
import random
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

import hyperpaint as hp
from hyperpaint.errors import PaintError
from hyperpaint.io.store import is_complete, open_store

from .outcome import Outcome

__all__ = ["kills", "races", "run_kill", "run_race"]

KILLS, RACES = 200, 50
GROUP = "flightlines/raw_0"
_SLABS, _SHAPE = 12, (32, 4, 50)
_DELAY = 0.02
_REFUSED = 3
_UNLISTED = "/: no consolidated metadata"
#: Children are forked by a server that has imported everything: they write within milliseconds.
_CONTEXT = multiprocessing.get_context("forkserver")
_CONTEXT.set_forkserver_preload(["xarray", "dask.array", "zarr", "hyperpaint", __name__])


def _values(scene: int, number: int) -> Any:
    return np.random.default_rng((scene, number)).integers(0, 4096, _SHAPE, dtype="uint16")


def _slab(scene: int, block_id: tuple[int, ...] = ()) -> Any:
    time.sleep(_DELAY)
    return _values(scene, block_id[0])


def _line(scene: int) -> xr.Dataset:
    """Return a line whose slabs take their time, so that most kills fall among them."""
    import dask.array as da

    chunks = ((_SHAPE[0],) * _SLABS, *((size,) for size in _SHAPE[1:]))
    meta = np.empty((0, 0, 0), "uint16")
    counts = da.map_blocks(_slab, scene=scene, chunks=chunks, dtype="uint16", meta=meta, name=f"slab-{scene}")
    frame = np.arange(_SHAPE[0] * _SLABS) + scene
    return xr.Dataset(
        {"counts": (("along_track", "band", "cross_track"), counts)}, {"frame": ("along_track", frame)}
    )


def _expected(scene: int) -> Any:
    return np.concatenate([_values(scene, number) for number in range(_SLABS)])


def _write(path: Path, scene: int, wait: Any = None) -> None:
    """Store a scene; exit with a status of its own where that is refused."""
    import dask

    if wait is not None:
        wait.wait()
    try:
        with dask.config.set(scheduler="threads", num_workers=1):
            hp.to_store(_line(scene), path, GROUP, overwrite=True)
    except PaintError:
        os._exit(_REFUSED)


def _child(path: Path, scene: int, wait: Any = None) -> Any:
    process = _CONTEXT.Process(target=_write, args=(path, scene, wait))
    process.start()
    return process


def _holds(path: Path) -> int | None:
    """Return the scene that our reader takes the store for, None where it refuses.

    Raises
    ------
    ValueError
        What it read is no scene, or another than its own frame numbers say.
    """
    if not is_complete(path, GROUP):
        try:
            open_store(path, GROUP)
        except PaintError:
            return None
        msg = "not complete, but opened"
        raise ValueError(msg)
    opened = open_store(path, GROUP).load()
    scene = int(opened.frame[0])
    if not np.array_equal(opened.counts, _expected(scene)):
        msg = f"read as scene {scene}, but its counts are others"
        raise ValueError(msg)
    # between a group's place and the root's list a kill leaves a whole group, of which verify says just that
    if told := [problem for problem in hp.verify(path).problems if not problem.startswith(_UNLISTED)]:
        msg = f"read as scene {scene}, but verify says {told[0]}"
        raise ValueError(msg)
    return scene


def _chunks(path: Path) -> dict[str, bytes]:
    files = (file for file in sorted((path / GROUP).rglob("*")) if file.is_file() and "c" in file.parts)
    return {str(file.relative_to(path)): file.read_bytes() for file in files}


def run_kill(number: int, folder: Path, duration: float, made: Outcome) -> None:
    """Kill a writer at a random instant, read what is there, run it again and compare.

    Parameters
    ----------
    number
        Of the fault.
    folder
        Empty.
    duration
        Of a whole write [s].
    made
        Takes the outcome.
    """
    rng = random.Random(f"kill:{number}")
    path, older, newer = folder / "lot.zarr", 2 * number + 1, 2 * number + 2
    replacing = rng.random() < 0.5
    if replacing:
        hp.to_store(_line(older), path, GROUP)
    writer = _child(path, newer)
    writer.join(rng.uniform(0.0, 1.1 * duration))
    writer.kill()
    writer.join()
    made.count += 1
    try:
        found = _holds(path) if path.exists() else None
        if found not in ((older, newer) if replacing else (None, newer)):
            made.wrong.append(f"kill {number}: the store holds scene {found}")
        made.notes["found unwritten" if found != newer else "found written"] += 1
        again = _child(path, newer)
        again.join()
        if again.exitcode or _holds(path) != newer:
            made.wrong.append(f"kill {number}: the rerun exits with {again.exitcode}")
        hp.to_store(_line(newer), folder / "fresh.zarr", GROUP)
        if _chunks(path) != _chunks(folder / "fresh.zarr"):
            made.wrong.append(f"kill {number}: the rerun differs from an undisturbed run")
        if left := sorted({entry.name for entry in folder.iterdir()} - {"lot.zarr", "fresh.zarr"}):
            made.wrong.append(f"kill {number}: left beside the store: {left}")
    except (PaintError, ValueError, OSError) as error:
        made.wrong.append(f"kill {number}: {type(error).__name__}: {error!s:.200}")


def run_race(number: int, folder: Path, made: Outcome) -> None:
    """Start two writers of different scenes at once; one of them is what the store holds."""
    path, scenes = folder / "lot.zarr", (2 * number + 1, 2 * number + 2)
    barrier = _CONTEXT.Barrier(2)
    writers = [_child(path, scene, barrier) for scene in scenes]
    for writer in writers:
        writer.join()
    made.count += 1
    status = [writer.exitcode for writer in writers]
    made.notes[f"{status.count(_REFUSED)} refused"] += 1
    try:
        found = _holds(path)
        won = [scene for scene, code in zip(scenes, status, strict=True) if code == 0]
        if not won or not set(status) <= {0, _REFUSED} or found not in won:
            made.wrong.append(f"race {number}: writers exit with {status}, the store holds {found}")
    except (PaintError, ValueError, OSError) as error:
        made.wrong.append(f"race {number}: {type(error).__name__}: {error!s:.200}")


def _duration() -> float:
    """Return how long a child takes to write; the first one also waits for the server's imports."""
    seconds = []
    for _ in range(2):
        with tempfile.TemporaryDirectory() as scratch:
            begun = time.monotonic()
            _child(Path(scratch) / "lot.zarr", 1).join()
            seconds.append(time.monotonic() - begun)
    return seconds[-1]


def kills(scale: float = 1.0, *, first: int = 0) -> Iterator[Outcome]:
    """Yield the outcome of every kill."""
    duration = _duration()
    for number in range(first, first + max(1, round(KILLS * scale))):
        with tempfile.TemporaryDirectory() as scratch:
            made = Outcome("writers killed")
            run_kill(number, Path(scratch), duration, made)
            yield made


def races(scale: float = 1.0, *, first: int = 0) -> Iterator[Outcome]:
    """Yield the outcome of every race."""
    for number in range(first, first + max(1, round(RACES * scale))):
        with tempfile.TemporaryDirectory() as scratch:
            made = Outcome("two writers")
            run_race(number, Path(scratch), made)
            yield made
