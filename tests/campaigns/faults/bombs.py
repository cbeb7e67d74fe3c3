"""Bombs: small files that would fill the memory, never end, lead out of their folder or run code.

Each is made from its row of `bomb_table`, and read in a child process of its own that may not grow, nor run
for long. It must be refused with an error of the class that its reader documents, and a reason; a canary
tells whether any code of the file was run, and a bait whether a path of the file was followed out of its
folder.
"""

import contextlib
import importlib
import json
import os
import resource
import signal
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from hyperpaint.base.errors import CollectError, FormatError, PaintError, PaintWarning, StoreError, TimeError

from .bomb_table import BOMBS, Bomb
from .outcome import MOST_BYTES, MOST_SECONDS, Outcome, begin_peak, in_parallel, parts_of, resident
from .parsers import SKY, exposure, reader

#: A child that runs longer is stopped [s].
_HANGS = 10
_PART = 8
#: What the interpreter is about to do when code of a file is run.
_RUNS_CODE = ("os.system", "subprocess.Popen", "os.exec", "os.posix_spawn")


class Door(NamedTuple):
    # A public way in, which reads all there is to read, and the errors that its documentation names
    read: Callable[[Path], object]
    errors: tuple[type[PaintError], ...]


def _verified(report: Any, _: Path) -> None:
    if not report.ok:
        raise StoreError(str(report))


def _write(path: Path) -> None:
    import xarray as xr

    from hyperpaint.io.store import to_store

    to_store(xr.Dataset({"a": ("x", [1.0])}), path, "more", overwrite=True)


def _load(opened: Any, _: Path) -> None:
    opened.load()


DOORS: Mapping[str, Door] = {
    "envi": Door(reader("io.envi.envi_cubes:open_envi", then=_load), (FormatError,)),
    "asd": Door(
        reader("io.spectrometers.asd:open_asd", {"quantity": "reflectance", "utc_offset_h": 0.0}),
        (FormatError, TimeError),
    ),
    "irradiance": Door(
        reader("io.spectrometers.irradiance:open_irradiance", SKY), (FormatError, TimeError, StoreError)
    ),
    "frame-index": Door(reader("io.flightline.side_files:read_frame_index"), (FormatError, TimeError)),
    "imu-gps": Door(reader("io.navigation.navigation_records:read_imu_gps"), (FormatError,)),
    "settings": Door(
        reader("io.flightline.side_files:read_settings", then=exposure),
        (FormatError,),
    ),
    "collect": Door(
        reader("workflows.collects:open_collect"), (CollectError, FormatError, StoreError, TimeError)
    ),
    "info": Door(reader("cli.info_command:describe_path"), (FormatError, StoreError, CollectError)),
    "open-store": Door(reader("io.store:open_store", then=_load), (StoreError,)),
    "verify": Door(reader("io.store:verify", then=_verified), (StoreError,)),
    # writes beside what is there
    "writer": Door(_write, (StoreError,)),
    "calibration": Door(reader("io.flightline.side_files:open_calibration"), (FormatError,)),
    "library": Door(reader("io.library:open_library", then=_load), (FormatError, StoreError)),
}


def tries() -> list[tuple[str, str]]:
    # Return every try: name of a bomb, and name of a door that it is put through
    return [(name, door) for name, bomb in BOMBS.items() for door in bomb.doors.split()]


def _watch(bait: Path, found: list[str]) -> None:
    # Note from now on when the interpreter runs a program, or opens the bait
    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if event in _RUNS_CODE:
            found.append(f"{event} {arguments!r:.60}")
        elif event == "open" and isinstance(arguments[0], str | os.PathLike):
            with contextlib.suppress(OSError, ValueError):
                if Path(os.path.realpath(arguments[0])).is_relative_to(bait):
                    found.append(f"opened {arguments[0]:.80}")

    sys.addaudithook(hook)


def _judge(door: Door, path: Path, bait: Path) -> dict[str, Any]:
    # Read a bomb under limits; return what happened
    import dask

    # a pool of threads that the parent started is dead here
    dask.config.set(scheduler="synchronous")
    events: list[str] = []
    warnings.simplefilter("error")
    for harmless in (PaintWarning, UserWarning):
        warnings.simplefilter("ignore", harmless)
    _watch(bait, events)
    resource.setrlimit(resource.RLIMIT_AS, (resident("VmSize") + 2 * MOST_BYTES,) * 2)
    before, begun = begin_peak(), time.process_time()
    text, raised = "", False
    try:
        door.read(path)
    except BaseException as error:  # the point is which
        raised = isinstance(error, door.errors)
        text = f"{type(error).__name__}: {error!s:.300}"
    return {
        "refused": raised and len(text.partition(": ")[2]) > 10,
        "text": text or "it was read",
        "seconds": time.process_time() - begun,
        "memory": max(resident("VmHWM") - before, 0),
        "events": events,
    }


def _in_child(door: Door, path: Path, bait: Path) -> dict[str, Any]:
    # Return what `_judge` tells from a child; of one that died or hung, that
    reading, writing = os.pipe()
    sys.stdout.flush()
    sys.stderr.flush()
    child = os.fork()
    if child == 0:  # pragma: no cover - another process
        os.close(reading)
        signal.alarm(_HANGS)
        try:
            os.write(writing, json.dumps(_judge(door, path, bait)).encode()[:60_000])
        finally:
            os._exit(0)
    os.close(writing)
    with os.fdopen(reading, "rb") as pipe:
        answer = pipe.read()
    _, status = os.waitpid(child, 0)
    if answer:
        return dict(json.loads(answer))
    text = f"the process died or hung: status {status}"
    return {"refused": False, "text": text, "seconds": 0.0, "memory": 0, "events": []}


def run_bomb(name: str, door: str, outcome: Outcome, doors: Mapping[str, Door] = DOORS) -> None:
    # Make a bomb, put it through a door, and note what came of it
    bomb: Bomb = BOMBS[name]
    with tempfile.TemporaryDirectory() as scratch:
        folder, bait = Path(scratch) / "given", Path(scratch) / "bait"
        folder.mkdir()
        bait.mkdir()
        seen = _in_child(doors[door], bomb.make(folder), bait.resolve())
        # where bombs put it: some are too deep to be searched
        ran = any(any(Path(scratch).glob(f"{above}canary")) for above in ("", "*/", "*/*/"))
    outcome.count += 1
    outcome.notes["refused"] += seen["refused"]
    outcome.seconds = max(outcome.seconds or 0.0, seen["seconds"])
    outcome.memory = max(outcome.memory or 0, seen["memory"])
    where, text = f"{name} through {door}", seen["text"].replace(scratch, "")
    if ran or seen["events"]:
        outcome.wrong.append(f"{where}: {'code was run; ' if ran else ''}{seen['events'][:3]}")
    elif not seen["refused"]:
        outcome.wrong.append(f"{where}: {text}")
    elif seen["seconds"] > MOST_SECONDS or seen["memory"] > MOST_BYTES:
        outcome.wrong.append(
            f"{where}: {seen['seconds']:.2f} s, {seen['memory'] / 2**20:.0f} MB ({text:.60})"
        )


def warm_up() -> None:
    # Import what the readers import, so that a child's time and memory are those of the bomb
    for module in (
        *(f"hyperpaint.io.{name}" for name in ("collect.collect_toml", "envi.envi_cubes", "library")),
        *(f"hyperpaint.io.{name}" for name in ("flightline.side_files", "store.reader")),
        *(f"hyperpaint.io.{name}" for name in ("navigation.navigation_records", "spectrometers.asd")),
        *(
            "hyperpaint.io.spectrometers.irradiance",
            "hyperpaint.cli.info_command",
            "hyperpaint.workflows.collects",
        ),
        *(
            "google_crc32c",
            "fsspec.implementations.zip",
            "fsspec.core",
            "xarray",
            "zarr.storage",
            "dask.array",
        ),
    ):
        importlib.import_module(module)
    from hyperpaint.base.facts import conversion_factor

    conversion_factor("W m-2 nm-1", "W m-2 um-1")


def _run(numbers: range) -> list[Outcome]:
    warm_up()
    outcomes: dict[str, Outcome] = {}
    for name, door in (tries()[number] for number in numbers):
        kind = "files" if BOMBS[name].store is None else "stores"
        run_bomb(name, door, outcomes.setdefault(kind, Outcome(f"bombs: {kind}", seconds=0.0, memory=0)))
    return list(outcomes.values())


def campaign(scale: float = 1.0, *, first: int = 0) -> Iterator[Outcome]:
    # Yield the outcome of every part; each bomb is tried once: none is left for ``first`` above 0
    if not first:
        yield from in_parallel(_run, parts_of(range(0, len(tries()), max(1, round(1 / scale))), _PART))
