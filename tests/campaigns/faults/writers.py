"""Writers that are killed, and writers that race: a store is whole, or it says that it is not."""

from __future__ import annotations

import itertools
import multiprocessing
import os
import random
import shutil
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

import hyperpaint as hp
from hyperpaint.base.errors import PaintError
from hyperpaint.io.store import is_complete, open_store

from .outcome import Outcome

__all__ = ["UNLISTED", "VARIANTS", "kills", "races", "run_kill", "run_last_calls", "run_race"]

KILLS, RACES = 200, 50
GROUP = "flightlines/raw_0"
_SLABS, _SHAPE = 12, (32, 4, 50)
_DELAY = 0.02
_REFUSED = 3
UNLISTED = "/: the root has no list of all metadata"
#: Children are forked by a server that has imported everything: they write within milliseconds.
_CONTEXT = multiprocessing.get_context("forkserver")
_CONTEXT.set_forkserver_preload(["xarray", "dask.array", "zarr", "hyperpaint", __name__])


def _values(scene: int, number: int) -> Any:
    return np.random.default_rng((scene, number)).integers(0, 4096, _SHAPE, dtype="uint16")


def _slab(scene: int, delay: float, block_id: tuple[int, ...] = ()) -> Any:
    time.sleep(delay)
    return _values(scene, block_id[0])


def _line(scene: int, slabs: int = _SLABS, delay: float = _DELAY) -> xr.Dataset:
    """Return a line whose slabs take their time, so that most kills fall among them."""
    import dask.array as da

    chunks = ((_SHAPE[0],) * slabs, *((size,) for size in _SHAPE[1:]))
    meta = np.empty((0, 0, 0), "uint16")
    counts = da.map_blocks(
        _slab, scene=scene, delay=delay, chunks=chunks, dtype="uint16", meta=meta, name=f"slab-{scene}"
    )
    frame = np.arange(_SHAPE[0] * slabs) + scene
    return xr.Dataset(
        {"counts": (("along_track", "band", "cross_track"), counts)}, {"frame": ("along_track", frame)}
    )


def _expected(scene: int, slabs: int) -> Any:
    return np.concatenate([_values(scene, number) for number in range(slabs)])


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


def _holds(path: Path, group: str | None = GROUP, slabs: int = _SLABS) -> int | None:
    """Return the scene that our reader takes the store for, None where it refuses.

    Raises
    ------
    ValueError
        What it read is no scene, or another than its own frame numbers say.
    """
    if not is_complete(path, group):
        try:
            open_store(path, group)
        except PaintError:
            return None
        msg = "not complete, but opened"
        raise ValueError(msg)
    opened = open_store(path, group).load()
    scene = int(opened.frame[0])
    if not np.array_equal(opened.counts, _expected(scene, slabs)):
        msg = f"read as scene {scene}, but its counts are others"
        raise ValueError(msg)
    # between a group's place and the root's list a kill leaves a whole group, of which verify says just that
    if told := [problem for problem in hp.verify(path).problems if not problem.startswith(UNLISTED)]:
        msg = f"read as scene {scene}, but verify says {told[0]}"
        raise ValueError(msg)
    return scene


def _chunks(path: Path) -> dict[str, bytes]:
    files = (file for file in sorted(path.rglob("*")) if file.is_file() and "c" in file.parts)
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


# --- before every call -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Variant:
    """What a writer does that is killed before each of its calls.

    Attributes
    ----------
    group
        Where it writes.
    replacing
        Something is there already.
    exchanging
        The system can let two folders change places, so that one of them is always there.
    """

    group: str | None = GROUP
    replacing: bool = True
    exchanging: bool = True


VARIANTS = {
    "new group": Variant(replacing=False),
    "group replaced": Variant(),
    "root replaced": Variant(group=None),
    "by two renames": Variant(exchanging=False),
}
_FEW_SLABS = 2
_OLDER, _NEWER = 1, 2
_KILLED = 9
_MOST_CALLS = 1000
_CHANGES = ("os.rename", "os.mkdir", "os.rmdir", "os.remove", "os.link", "os.truncate")


def _die_before(number: int, folder: Path) -> None:
    """End this process at once before its so-manieth call that changes files below a folder."""
    calls = itertools.count(1)

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if event == "open":
            _, mode, flags = arguments
            changes = set(mode) & set("wax+") if mode else flags & (os.O_CREAT | os.O_WRONLY | os.O_RDWR)
        else:
            changes = event in _CHANGES
        if not changes or isinstance(arguments[0], int):
            return
        # folders are removed by names relative to a descriptor
        path = os.fsdecode(arguments[0])
        inside = path.startswith(os.fspath(folder)) or (event != "open" and not os.path.isabs(path))
        if inside and next(calls) == number:
            os._exit(_KILLED)

    sys.addaudithook(hook)


def _write_until(path: Path, variant: Variant, number: int | None) -> None:
    """Write the newer scene; end before a call."""
    import dask

    from hyperpaint.io.store import stage

    if not variant.exchanging:
        stage.exchange = lambda *_: False  # type: ignore[assignment]
    if number is not None:
        _die_before(number, path.parent)
    with dask.config.set(scheduler="synchronous"):
        hp.to_store(_line(_NEWER, _FEW_SLABS, 0.0), path, variant.group, overwrite=True)


def _status(path: Path, variant: Variant, number: int | None) -> int | None:
    writer = _CONTEXT.Process(target=_write_until, args=(path, variant, number))
    writer.start()
    writer.join()
    return writer.exitcode


def run_last_calls(name: str, folder: Path, made: Outcome, calls: Iterable[int]) -> None:
    """Kill a writer before some of its calls that change files, each time from the start.

    Parameters
    ----------
    name
        Of the variant.
    folder
        Empty.
    made
        Takes the outcome.
    calls
        Ascending, from 1; those beyond the writer's last are none.
    """
    variant = VARIANTS[name]
    whole = folder / "whole.zarr"
    hp.to_store(_line(_NEWER, _FEW_SLABS, 0.0), whole, variant.group)
    if variant.replacing:
        hp.to_store(_line(_OLDER, _FEW_SLABS, 0.0), folder / "older.zarr", variant.group)
    for number in calls:
        path = folder / f"call-{number}" / "lot.zarr"
        path.parent.mkdir()
        if variant.replacing:
            shutil.copytree(folder / "older.zarr", path)
        status = _status(path, variant, number)
        if status == 0:
            return
        made.count += 1
        made.wrong += [f"{name}, call {number}: {text}" for text in _judged(path, variant, status, whole)]
        shutil.rmtree(path.parent)


def _judged(path: Path, variant: Variant, status: int | None, whole: Path) -> Iterator[str]:
    """Yield what is wrong with a store whose writer was killed, and with that of the next run."""
    if status != _KILLED:
        yield f"the writer exits with {status}"
    allowed = {_NEWER, _OLDER if variant.replacing else None}
    if not variant.exchanging:
        allowed.add(None)
    try:
        found = _holds(path, variant.group, _FEW_SLABS) if path.exists() else None
        if found not in allowed:
            yield f"the store holds scene {found}"
        if (again := _status(path, variant, None)) != 0:
            yield f"the rerun exits with {again}"
        elif _holds(path, variant.group, _FEW_SLABS) != _NEWER or not hp.verify(path).ok:
            yield "the rerun does not mend it"
        elif _chunks(path) != _chunks(whole):
            yield "the rerun differs from an undisturbed run"
        if left := sorted({entry.name for entry in path.parent.iterdir()} - {"lot.zarr"}):
            yield f"left beside the store: {left}"
        if left := [str(file) for file in path.rglob(".*")]:
            yield f"left in the store: {left}"
    except (PaintError, ValueError, OSError) as error:
        yield f"{type(error).__name__}: {error!s:.200}"


# --- two writers -------------------------------------------------------------------------------------------


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
    """Yield the outcome of every kill: at random instants, then before each call that changes files."""
    duration = _duration()
    for number in range(first, first + max(1, round(KILLS * scale))):
        with tempfile.TemporaryDirectory() as scratch:
            made = Outcome("writers killed")
            run_kill(number, Path(scratch), duration, made)
            yield made
    step = max(1, round(1 / scale))
    for name in VARIANTS:
        with tempfile.TemporaryDirectory() as scratch:
            made = Outcome("writers killed before each call")
            run_last_calls(name, Path(scratch), made, range(1 + first % step, _MOST_CALLS, step))
            yield made


def races(scale: float = 1.0, *, first: int = 0) -> Iterator[Outcome]:
    """Yield the outcome of every race."""
    for number in range(first, first + max(1, round(RACES * scale))):
        with tempfile.TemporaryDirectory() as scratch:
            made = Outcome("two writers")
            run_race(number, Path(scratch), made)
            yield made
