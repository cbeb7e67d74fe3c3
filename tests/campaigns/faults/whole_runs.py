"""A `process` of many lines that is killed, or whose disk fails: the store is whole, or says that it is not.

The lines are tiny and the store lies in memory where that is a folder, so that hundreds of runs take minutes.
Signals end a child as they end the command: SIGTERM and Ctrl-C as an exception, SIGKILL at once.
"""

from __future__ import annotations

import errno
import itertools
import multiprocessing
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from support.tiny_collects import tiny_collect

import hyperpaint as hp
from hyperpaint.base.errors import PaintError

from .outcome import Outcome

__all__ = [
    "FEW_LINES", "LINES", "PRELOAD", "SCRATCH", "SIGNALS", "Fault", "Lot", "calls", "kills", "run_call",
    "run_kills",
]  # fmt: skip

KILLS, KILLS_A_STORE = 500, 5
LINES, FEW_LINES = 40, 2
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
_KILLED, _FAILED, _MOST_CALLS = 9, 3, 2000
_MOST_SECONDS = 60.0  # that a child may take to start
_CHANGES = ("os.rename", "os.mkdir", "os.rmdir", "os.remove", "os.link", "os.truncate")
SCRATCH = Path("/dev/shm") if Path("/dev/shm").is_dir() else None
_CONTEXT = multiprocessing.get_context("forkserver")
PRELOAD = [
    "xarray", "dask.array", "zarr", "hyperpaint", "hyperpaint.workflows.pipeline", "hyperpaint.alignment",
    "hyperpaint.workflows.pipeline", "hyperpaint.accessor", "hyperpaint.pictures.plot",
    "hyperpaint.io.store.writer", "hyperpaint.radiometry", __name__,
]  # fmt: skip
_CONTEXT.set_forkserver_preload(PRELOAD)


class Lot:
    """A collect in two versions, and what an undisturbed run makes of each."""

    def __init__(self, folder: Path, lines: int) -> None:
        self.newer = tiny_collect(folder / "raw", lines)
        self.older = folder / "raw" / "older.toml"
        self.older.write_text(self.newer.read_text().replace('"uW cm-2', '"W m-2'))
        self.store = folder / "older.zarr"
        _process(self.older, self.store, overwrite=False, old=True)
        self.chunks = {"older": chunks_of(self.store)}
        start = time.monotonic()
        _process(self.newer, folder / "newer.zarr", overwrite=False)
        self.seconds = time.monotonic() - start
        self.chunks["newer"] = chunks_of(folder / "newer.zarr")

    def content(self, path: Path) -> str:
        """Return of which version a store is, ``mixed`` where it is of none."""
        chunks = chunks_of(path)
        return next((name for name, expected in self.chunks.items() if chunks == expected), "mixed")


def chunks_of(path: Path) -> dict[str, bytes]:
    files = (file for file in sorted(path.rglob("*")) if file.is_file() and "c" in file.parts)
    return {str(file.relative_to(path)): file.read_bytes() for file in files}


def _process(collect: Path, path: Path, *, overwrite: bool, old: bool = False) -> None:
    hp.process(collect, path, to="radiance", reflectance="none" if old else "stored", overwrite=overwrite)


def _end(number: int, _: object) -> None:
    sys.exit(128 + number)


def _answer_signals(answer: Any) -> None:
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, answer)


def _child_process(collect: Path, path: Path, overwrite: bool, fault: Fault | None, ready: Any) -> None:
    """Process as the command does; a signal is an exception, an error of the store a status of its own.

    Before ``ready`` and after the end a signal would only meet the start and the end of `multiprocessing`,
    which answers an interrupt there with a status of 1.
    """
    _answer_signals(_end)
    ready.send(True)
    if fault is not None:
        fault.arm(path.parent)
    try:
        _process(collect, path, overwrite=overwrite)
    except PaintError:
        os._exit(_FAILED)
    _answer_signals(signal.SIG_IGN)


def _started(lot: Lot, path: Path, *, overwrite: bool, fault: Fault | None = None) -> Any:
    armed, ready = _CONTEXT.Pipe(duplex=False)
    with armed, ready:
        process = _CONTEXT.Process(target=_child_process, args=(lot.newer, path, overwrite, fault, ready))
        process.start()
        armed.poll(_MOST_SECONDS)
    return process


def left_by(lot: Lot, path: Path, *, overwrite: bool) -> Iterator[str]:
    """Yield what is wrong with what a disturbed run left: it may be whole, or say that it is not."""
    if not path.exists():
        return
    said = [name for name, whole in (("verify", _verified), ("open_store", _opened)) if whole(path)]
    if said and (content := lot.content(path)) not in (("older", "newer") if overwrite else ("newer",)):
        yield f"{' and '.join(said)} take it for whole, but it is {content}"


def rerun_of(lot: Lot, path: Path, *, overwrite: bool) -> Iterator[str]:
    """Run again, undisturbed, and yield what is wrong with that."""
    try:
        _process(lot.newer, path, overwrite=overwrite)
    except Exception as error:
        yield f"the rerun raises {type(error).__name__}: {error!s:.300}"
        return
    if not _verified(path) or lot.content(path) != "newer":
        yield "the rerun differs from an undisturbed run, or is not whole"
    if left := sorted({entry.name for entry in path.parent.iterdir()} - {path.name}):
        yield f"left beside the store: {left}"
    if left := [str(file) for file in path.rglob(".*")]:
        yield f"left in the store: {left}"


def _verified(path: Path) -> bool:
    try:
        return hp.verify(path).ok
    except PaintError:
        return False


def _opened(path: Path) -> bool:
    try:
        return bool(hp.open_store(path).groups)
    except PaintError:
        return False


# --- killed at random instants ---


def run_kills(number: int, lot: Lot, folder: Path, duration: float, outcome: Outcome) -> None:
    """End runs at random instants by signals, each run going on where the last was ended; let one end well.

    Parameters
    ----------
    number
        Of the first fault, which with those that follow is the seed of the instants; half of the stores hold
        what other settings made.
    lot
        What is processed.
    folder
        Empty.
    duration
        Of a whole run [s].
    outcome
        Takes the outcome.
    """
    path, replacing = folder / "lot.zarr", number // KILLS_A_STORE % 2 == 1
    if replacing:
        shutil.copytree(lot.store, path)
    for kill in range(number, number + KILLS_A_STORE):
        rng = random.Random(f"run:{kill}")
        which = SIGNALS[kill % len(SIGNALS)]
        writer = _started(lot, path, overwrite=replacing)
        writer.join(rng.uniform(0.0, 1.02 * duration / (1 + kill - number)))
        amid = writer.is_alive()
        if amid:
            os.kill(writer.pid, which)
        writer.join()
        outcome.count += 1
        outcome.notes[f"{which.name} amid" if amid else "done before"] += 1
        fault = f"kill {kill} ({which.name}, replacing: {replacing})"
        if writer.exitcode not in (-which, 128 + which, 0):
            outcome.wrong.append(f"{fault}: exits with {writer.exitcode}")
        outcome.wrong += [f"{fault}: {text}" for text in left_by(lot, path, overwrite=replacing)]
    outcome.wrong += [f"after kill {kill}: {text}" for text in rerun_of(lot, path, overwrite=replacing)]


def _duration(lot: Lot) -> float:
    """Return how long a child takes; the first one also waits for the server's imports."""
    seconds = []
    for _ in range(3):
        with tempfile.TemporaryDirectory(dir=SCRATCH) as scratch:
            start = time.monotonic()
            _started(lot, Path(scratch) / "lot.zarr", overwrite=False).join()
            seconds.append(time.monotonic() - start)
    return seconds[-1]


def kills(scale: float = 1.0, *, first: int = 0) -> Iterator[Outcome]:
    """Yield the outcome of every kill."""
    with tempfile.TemporaryDirectory(dir=SCRATCH) as home:
        lot = Lot(Path(home), LINES)
        duration = _duration(lot)
        for number in range(first, first + max(1, round(KILLS * scale)), KILLS_A_STORE):
            outcome = Outcome("runs killed")
            with tempfile.TemporaryDirectory(dir=SCRATCH) as scratch:
                run_kills(number, lot, Path(scratch), duration, outcome)
            yield outcome


# --- before every call ---


@dataclass(frozen=True)
class Fault:
    """What happens at a call that changes files: the process ends, or the call fails."""

    number: int
    code: int | None = None  # errno; None ends the process

    def arm(self, folder: Path) -> Iterator[int]:
        """Let it happen at a call of this process below a folder; return the counter of such calls."""
        counter = itertools.count(1)

        def hook(event: str, arguments: tuple[Any, ...]) -> None:
            if event == "open":
                _, mode, flags = arguments
                writes = os.O_CREAT | os.O_WRONLY | os.O_RDWR
                changes = bool(set(mode) & set("wax+")) if mode else bool(flags & writes)
            else:
                changes = event in _CHANGES
            if not changes or isinstance(arguments[0], int):
                return
            # folders are removed by names relative to a descriptor
            place = os.fsdecode(arguments[0])
            inside = place.startswith(os.fspath(folder)) or (event != "open" and not os.path.isabs(place))
            if inside and next(counter) == self.number:
                if self.code is None:
                    os._exit(_KILLED)
                raise OSError(self.code, os.strerror(self.code), place)

        sys.addaudithook(hook)
        return counter


def run_call(
    number: int, lot: Lot, folder: Path, outcome: Outcome, *, replacing: bool, code: int | None
) -> bool:
    """Let one call of a run end it, or fail; False where the run has no such call."""
    path = folder / "lot.zarr"
    if replacing:
        shutil.copytree(lot.store, path)
    writer = _started(lot, path, overwrite=replacing, fault=Fault(number, code))
    writer.join()
    fault = f"call {number} ({'killed' if code is None else errno.errorcode[code]}, replacing: {replacing})"
    if code is None and writer.exitcode == 0:
        return False
    outcome.count += 1
    # a call whose failure does not matter, such as the removal of the empty folder, is passed over
    if writer.exitcode not in ((_KILLED,) if code is None else (_FAILED, 0)):
        outcome.wrong.append(f"{fault}: exits with {writer.exitcode}")
    for texts in (left_by, rerun_of):
        outcome.wrong += [f"{fault}: {text}" for text in texts(lot, path, overwrite=replacing)]
    return True


def last_call(lot: Lot, *, replacing: bool) -> int:
    """Return how many calls of a run change files."""
    low, high = 0, _MOST_CALLS
    while high - low > 1:
        middle = (low + high) // 2
        with tempfile.TemporaryDirectory(dir=SCRATCH) as scratch:
            probe = run_call(middle, lot, Path(scratch), Outcome(""), replacing=replacing, code=None)
        low, high = (middle, high) if probe else (low, middle)
    return low


def calls(scale: float = 1.0, *, first: int = 0) -> Iterator[Outcome]:
    """Yield the outcome of every call of a run of a few lines: killed before it, and failing."""
    step = max(1, round(1 / scale))
    with tempfile.TemporaryDirectory(dir=SCRATCH) as home:
        lot = Lot(Path(home), FEW_LINES)
        for replacing in (False, True):
            numbers: Iterable[int] = range(1 + first % step, last_call(lot, replacing=replacing) + 1, step)
            for number, code in itertools.product(numbers, (None, errno.ENOSPC)):
                outcome = Outcome("calls of a run: " + ("killed" if code is None else "failing"))
                with tempfile.TemporaryDirectory(dir=SCRATCH) as scratch:
                    run_call(number, lot, Path(scratch), outcome, replacing=replacing, code=code)
                yield outcome
