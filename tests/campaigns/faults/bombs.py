"""Bombs: small files that would fill the memory, never end, lead out of their folder or run code.

Each is made by hand, and read in a child process of its own that may not grow, nor run for long. It must be
refused with an error of the class that its reader documents, and a reason; a canary tells whether any code of
the file was run, and a bait whether a path of the file was followed out of its folder.
"""

from __future__ import annotations

import contextlib
import json
import os
import resource
import signal
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hyperpaint.base.errors import CollectError, FormatError, PaintError, PaintWarning, StoreError, TimeError

from .outcome import MOST_BYTES, MOST_SECONDS, Outcome, in_parallel

__all__ = ["DOORS", "Door", "all_bombs", "campaign", "run_bomb"]

#: A child that runs longer is stopped [s].
_HANGS = 10
_CANARY = "canary"
_BAIT = "bait"
_PART = 8
#: What the interpreter is about to do when code of a file is run.
_RUNS_CODE = ("os.system", "subprocess.Popen", "os.exec", "os.posix_spawn")


@dataclass(frozen=True)
class Door:
    """A public way in, and the errors that its documentation names.

    Attributes
    ----------
    read
        Takes a path, reads all there is to read.
    errors
        May be raised.
    """

    read: Callable[[Path], object]
    errors: tuple[type[PaintError], ...]


def _envi(path: Path) -> None:
    from hyperpaint.io.envi.envi_cubes import open_envi

    open_envi(path).load()


def _asd(path: Path) -> None:
    from hyperpaint.io.spectrometers.asd import open_asd

    open_asd(path, quantity="reflectance", utc_offset_h=0.0)


def _irradiance(path: Path) -> None:
    from hyperpaint.io.spectrometers.irradiance import open_irradiance

    open_irradiance(path, utc_offset_h=0.0, fwhm_nm=3.0, max_gap_s=5.0, units="W m-2 nm-1")


def _frame_index(path: Path) -> None:
    from hyperpaint.io.flightline.headwall import read_frame_index

    read_frame_index(path)


def _navigation(path: Path) -> None:
    from hyperpaint.io.navigation.navigation_records import read_imu_gps

    read_imu_gps(path)


def _settings(path: Path) -> None:
    from hyperpaint.io.flightline.headwall import exposure_seconds, read_settings

    exposure_seconds(read_settings(path), path.name)


def _collect(path: Path) -> None:
    from hyperpaint.io.collect.collect_toml import open_collect

    open_collect(path)


def _info(path: Path) -> None:
    from hyperpaint.cli.info_command import describe_path

    describe_path(path)


def _open_store(path: Path) -> None:
    from hyperpaint.io.store import open_store

    open_store(path).load()


def _verify(path: Path) -> None:
    from hyperpaint.io.store import verify

    report = verify(path)
    if not report.ok:
        raise StoreError(str(report))


def _writer(path: Path) -> None:
    import xarray as xr

    from hyperpaint.io.store import to_store

    to_store(xr.Dataset({"a": ("x", [1.0])}), path, "more", overwrite=True)


def _calibration(path: Path) -> None:
    from hyperpaint.io.flightline.calibration_store import open_calibration

    open_calibration(path)


def _library(path: Path) -> None:
    from hyperpaint.io.library import open_library

    open_library(path).load()


DOORS: Mapping[str, Door] = {
    "envi": Door(_envi, (FormatError,)),
    "asd": Door(_asd, (FormatError, TimeError)),
    "irradiance": Door(_irradiance, (FormatError, TimeError, StoreError)),
    "frame-index": Door(_frame_index, (FormatError, TimeError)),
    "imu-gps": Door(_navigation, (FormatError,)),
    "settings": Door(_settings, (FormatError,)),
    "collect": Door(_collect, (CollectError, FormatError, StoreError, TimeError)),
    "info": Door(_info, (FormatError, StoreError, CollectError)),
    "open-store": Door(_open_store, (StoreError,)),
    "verify": Door(_verify, (StoreError,)),
    # writes beside what is there
    "writer": Door(_writer, (StoreError,)),
    "calibration": Door(_calibration, (FormatError,)),
    "library": Door(_library, (FormatError, StoreError)),
}


def all_bombs() -> list[tuple[str, str, Callable[[Path], Path]]]:
    """Return every try: name of a bomb, name of the door it is put through, and what makes it in a folder."""
    from .bomb_files import BOMBS as FILES
    from .bomb_stores import BOMBS as STORES

    files = [(made.__name__, door, made) for made, doors in FILES for door in doors]
    return files + [(name, door, made) for name, (doors, made) in STORES.items() for door in doors]


# --- one child ---------------------------------------------------------------------------------------------


def _status(key: str) -> int:
    text = Path("/proc/self/status").read_text()
    return int(text.partition(f"{key}:")[2].split()[0]) * 1024


def _watch(bait: Path, found: list[str]) -> None:
    """Note from now on when the interpreter runs a program, or opens the bait."""

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if event in _RUNS_CODE:
            found.append(f"{event} {arguments!r:.60}")
        elif event == "open" and isinstance(arguments[0], str | os.PathLike):
            with contextlib.suppress(OSError, ValueError):
                if Path(os.path.realpath(arguments[0])).is_relative_to(bait):
                    found.append(f"opened {arguments[0]:.80}")

    sys.addaudithook(hook)


def _judge(door: Door, path: Path, bait: Path) -> dict[str, Any]:
    """Read a bomb under limits; return what happened."""
    import dask

    # a pool of threads that the parent started is dead here
    dask.config.set(scheduler="synchronous")
    events: list[str] = []
    warnings.simplefilter("error")
    for harmless in (PaintWarning, UserWarning):
        warnings.simplefilter("ignore", harmless)
    _watch(bait, events)
    resource.setrlimit(resource.RLIMIT_AS, (_status("VmSize") + 2 * MOST_BYTES,) * 2)
    before, begun = _status("VmRSS"), time.process_time()
    Path("/proc/self/clear_refs").write_text("5")
    said, raised = "", False
    try:
        door.read(path)
    except BaseException as error:  # the point is which
        raised = isinstance(error, door.errors)
        said = f"{type(error).__name__}: {error!s:.300}"
    return {
        "refused": raised and len(said.partition(": ")[2]) > 10,
        "said": said or "it was read",
        "seconds": time.process_time() - begun,
        "memory": max(_status("VmHWM") - before, 0),
        "events": events,
    }


def _in_child(door: Door, path: Path, bait: Path) -> dict[str, Any]:
    """Return what `_judge` tells from a child; of one that died or hung, that."""
    reading, writing = os.pipe()
    sys.stdout.flush()
    sys.stderr.flush()
    child = os.fork()
    if child == 0:  # pragma: no cover - another process
        os.close(reading)
        signal.alarm(_HANGS)
        try:
            told = json.dumps(_judge(door, path, bait)).encode()
            os.write(writing, told[:60_000])
        finally:
            os._exit(0)
    os.close(writing)
    with os.fdopen(reading, "rb") as pipe:
        told = pipe.read()
    _, status = os.waitpid(child, 0)
    if told:
        return dict(json.loads(told))
    said = f"the process died or hung: status {status}"
    return {"refused": False, "said": said, "seconds": 0.0, "memory": 0, "events": []}


def run_bomb(
    name: str, door: str, make: Callable[[Path], Path], made: Outcome, doors: Mapping[str, Door] = DOORS
) -> None:
    """Make a bomb, put it through a door, and note what came of it."""
    with tempfile.TemporaryDirectory() as scratch:
        folder, bait = Path(scratch) / "given", Path(scratch) / _BAIT
        folder.mkdir()
        bait.mkdir()
        path = make(folder)
        told = _in_child(doors[door], path, bait.resolve())
        # where bombs put it: some are too deep to be searched
        ran = any(any(Path(scratch).glob(f"{above}{_CANARY}")) for above in ("", "*/", "*/*/"))
    made.count += 1
    made.notes["refused"] += told["refused"]
    made.seconds = max(made.seconds or 0.0, told["seconds"])
    made.memory = max(made.memory or 0, told["memory"])
    where, said = f"{name} through {door}", told["said"].replace(scratch, "")
    if ran or told["events"]:
        made.wrong.append(f"{where}: {'code was run; ' if ran else ''}{told['events'][:3]}")
    elif not told["refused"]:
        made.wrong.append(f"{where}: {said}")
    elif told["seconds"] > MOST_SECONDS or told["memory"] > MOST_BYTES:
        made.wrong.append(f"{where}: {told['seconds']:.2f} s, {told['memory'] / 2**20:.0f} MB ({said:.60})")


def warm_up() -> None:
    """Import what the readers import, so that a child's time and memory are those of the bomb."""
    import importlib

    for module in (
        "hyperpaint.io.collect.collect_toml",
        "hyperpaint.io.envi.envi_cubes",
        "hyperpaint.io.flightline.calibration_store",
        "hyperpaint.io.navigation.navigation_opening",
        "hyperpaint.io.spectrometers.asd",
        "hyperpaint.io.spectrometers.irradiance",
        "hyperpaint.io.library",
        "hyperpaint.io.store.verification",
        "fsspec.implementations.zip",
        "xarray",
        "zarr.storage",
        "hyperpaint.cli.info_command",
        "google_crc32c",
        "dask.array",
        "fsspec.core",
    ):
        importlib.import_module(module)
    from hyperpaint.base.units import conversion_factor

    conversion_factor("W m-2 nm-1", "W m-2 um-1")


def _run(numbers: range) -> list[Outcome]:
    warm_up()
    made: dict[str, Outcome] = {}
    tries = all_bombs()
    for number in numbers:
        name, door, make = tries[number]
        kind = "stores" if make.__module__.endswith("stores") else "files"
        outcome = made.setdefault(kind, Outcome(f"bombs: {kind}", seconds=0.0, memory=0))
        run_bomb(name, door, make, outcome)
    return list(made.values())


def campaign(scale: float = 1.0, *, first: int = 0) -> Iterator[Outcome]:
    """Yield the outcome of every part; each bomb is tried once: none is left for ``first`` above 0."""
    if first:
        return
    step = max(1, round(1 / scale)) if scale < 1 else 1
    numbers = range(0, len(all_bombs()), step)
    parts = [numbers[start : start + _PART] for start in range(0, len(numbers), _PART)]
    yield from in_parallel(_run, parts)
