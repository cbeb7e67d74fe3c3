"""Writers that are killed, fail or race: what they leave is whole, or says that it is not.

    python tests/campaigns/all_faults.py --only kills,calls               every row of the table, hours
    python tests/campaigns/all_faults.py --only kills --scale 0.01        a hundredth of it

A row of `WORKS` is a product that is written in two versions by a child process. The child is ended at random
instants by SIGKILL, SIGTERM and SIGINT, or before a call that changes files, or such a call fails. Then the
home of the product holds the older version, the newer, or what nobody takes for a product; the next run mends
it, to the bytes of an undisturbed one. The old and the new version differ in every file.
"""

import contextlib
import ctypes
import errno
import functools
import hashlib
import itertools
import multiprocessing
import os
import random
import re
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from support.tiny_collects import tiny_collect

import hyperpaint as hp
from hyperpaint.base.errors import PaintError
from hyperpaint.io.store import is_complete, open_store, writer as store_writer

from .outcome import SCRATCH, Outcome, each, numbers_of

GROUP = "flightlines/raw_0"
RACES = 50
VERSIONS = ("older", "newer")
#: What verify says of a whole group between its place and the root's list, where a kill may leave it.
UNLISTED = "/: the root has no list of all metadata"
_REPORT_TIME = re.compile(rb"[0-9: -]+ UTC by hyperpaint")
os.environ.setdefault("ICECHUNK_LOG", "off")  # what it cannot open is counted


# --- children: disturbed by signals, at a call that changes files, or as common users ----------------------

DONE, REFUSED, ENDED_AT_A_CALL = 0, 3, 9
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
_START_S, _END_S = 120.0, 120.0
_CHANGES = ("os.rename", "os.mkdir", "os.rmdir", "os.remove", "os.link", "os.truncate")
#: Children are forked by a server that has imported everything: they write within milliseconds.
CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(
    [
        "xarray",
        "dask.array",
        "zarr",
        "rasterio",
        "distributed",
        "hyperpaint",
        "hyperpaint.accessor",
        "hyperpaint.workflows.pipeline",
        "hyperpaint.workflows.collects",
        "hyperpaint.workflows.field_day",
        "hyperpaint.alignment",
        "hyperpaint.pictures.plot",
        "hyperpaint.io.store.writer",
        "hyperpaint.radiometry",
        "hyperpaint.kernels.radiometry",
        "hyperpaint.cli.program",
        "hyperpaint.report.store_report",
        "campaigns.faults.interruptions",
        "campaigns.faults.disks",
    ]
)


@dataclass(frozen=True)
class Fault:
    # What happens at a call that changes files: the process ends, or the call fails
    number: int
    code: int | None = None  # errno; None ends the process

    def arm(self, folder: Path) -> Iterator[int]:
        # Let it happen at a call of this process below a folder; return the counter of such calls
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
                    os._exit(ENDED_AT_A_CALL)
                raise OSError(self.code, os.strerror(self.code), place)

        sys.addaudithook(hook)
        return counter


def start(
    work: Callable[..., object],
    *arguments: Any,
    fault: Fault | None = None,
    folder: Path | None = None,
    common: bool = False,
) -> Any:
    # Start a child; return its process when it is at work
    # work, *arguments: What it does
    # fault, folder: What happens to it, below which folder; without a fault its calls there are counted
    # only
    # common: Let it heed permissions as a common user does
    receiver, sender = CONTEXT.Pipe(duplex=False)
    process = CONTEXT.Process(target=_run, args=(sender, fault, folder, common, work, *arguments))
    process.start()
    sender.close()
    if receiver.poll(_START_S):
        receiver.recv()
    process.report = receiver
    return process


def end_of(process: Any) -> tuple[int, str, int]:
    # Wait for a child; return its exit status, its error, and how many of its calls change files
    process.join(_END_S)
    if process.is_alive():
        process.kill()
        process.join()
    try:
        text, calls = process.report.recv()
    except EOFError:
        text, calls = "", 0
    process.report.close()
    return process.exitcode, text, calls


def _run(
    sender: Any,
    fault: Fault | None,
    folder: Path | None,
    common: bool,
    work: Callable[..., object],
    *arguments: Any,
) -> None:
    # Work; a signal is an exception, an error of hyperpaint a status of its own
    # Before the first message and after the end a signal would only meet the start and the end of
    # `multiprocessing`, which answers an interrupt there with a status of 1
    import dask

    if common:
        # permission bits hold for root; another user may not be able to read Python itself
        header, none = (ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)()
        if ctypes.CDLL(None, use_errno=True).capset(header, none):
            raise OSError(ctypes.get_errno(), "capset")
    for number in SIGNALS[1:]:
        signal.signal(number, lambda got, _: sys.exit(128 + got))
    sender.send("at work")
    counter = itertools.count(1) if folder is None else (fault or Fault(-1)).arm(folder)
    status, text = DONE, ""
    try:
        # one thread: the calls of two runs are the same
        with dask.config.set(scheduler="threads", num_workers=1):
            work(*arguments)
    except PaintError as error:
        status, text = REFUSED, str(error)
    except Exception:
        status, text = 1, traceback.format_exc()[-800:]
    for number in SIGNALS[1:]:
        signal.signal(number, signal.SIG_IGN)
    sender.send((text, next(counter) - 1))
    os._exit(status)


# --- what is written ---------------------------------------------------------------------------------------


def _slab(seed: int, shape: tuple[int, ...], delay: float, block_id: tuple[int, ...] = ()) -> Any:
    time.sleep(delay)
    return np.random.default_rng((seed, block_id[0])).integers(0, 4096, shape, dtype="uint16")


def scene_line(
    seed: int,
    slabs: int,
    delay: float,
    shape: tuple[int, ...] = (32, 4, 50),
    slab: Any = _slab,
    **options: Any,
) -> xr.Dataset:
    # Return a line whose slabs take their time, so that most kills fall among them
    import dask.array as da

    chunks = ((shape[0],) * slabs, *((size,) for size in shape[1:]))
    counts = da.map_blocks(
        slab,
        seed=seed,
        shape=shape,
        delay=delay,
        chunks=chunks,
        dtype="uint16",
        meta=np.empty((0, 0, 0), "uint16"),
        name=f"slab-{seed}",
        **options,
    )
    frame = np.arange(shape[0] * slabs) + seed
    return xr.Dataset(
        {"counts": (("along_track", "band", "cross_track"), counts)}, {"frame": ("along_track", frame)}
    )


def _group(
    slabs: int, delay: float, group: str | None, exchanging: bool, _: Path, version: str, home: Path
) -> None:
    # Store a scene; without ``exchanging`` the system cannot let two folders change places at once
    if not exchanging:
        store_writer.exchange = lambda *_: False  # type: ignore[assignment]
    line = scene_line(1 + VERSIONS.index(version), slabs, delay)
    hp.to_store(line, home / "lot.zarr", group, overwrite=True)


def collects(lines: int, folder: Path) -> None:
    newer = tiny_collect(folder / "raw", lines)
    newer.with_name("newer.toml").write_text(newer.read_text())
    newer.with_name("older.toml").write_text(newer.read_text().replace('"uW cm-2', '"W m-2'))


def _process(overwrite: bool, inputs: Path, version: str, home: Path) -> None:
    reflectance = "none" if version == "older" else "stored"
    collect, path = inputs / "raw" / f"{version}.toml", home / "lot.zarr"
    hp.process(collect, path, to="radiance", reflectance=reflectance, overwrite=overwrite)


def _command(words: str, inputs: Path, version: str, home: Path) -> None:
    # Run a command of the command line: its words name its inputs and the home of the product
    from hyperpaint.cli.program import main

    called = words.format(inputs=inputs / version, home=home).split("|")
    with open(os.devnull, "w") as sink, contextlib.redirect_stdout(sink), contextlib.redirect_stderr(sink):
        if status := main.main([*called, "--overwrite"], "hyperpaint", standalone_mode=False):
            os._exit(status)


def _lots(folder: Path) -> None:
    # Write inputs of the commands in two versions
    from support.flown_lines import fly, located

    from hyperpaint.simulation import simulate_collect

    for number, version in enumerate(VERSIONS):
        own, rng, lines = folder / version, np.random.default_rng(number), {}
        simulate_collect(own / "raw", scene="plan", lines=64, bands=4, columns=6, seed=number)
        for at in range(2):
            flown = fly(40, 20, "calm", heading=30.0 + 90.0 * at, seed=at)
            values = rng.random((40, 6, 20)).astype(np.float32)
            line = located(
                flown, reflectance=(("along_track", "band", "cross_track"), values, {"units": "1"})
            )
            zenith = (
                ("along_track", "cross_track"),
                np.full((40, 20), 5.0 - at + number),
                {"units": "degree"},
            )
            nm = ("band", np.linspace(450.0, 700.0, 6), {"units": "nm"})
            lines[f"/flightlines/raw_{at}"] = line.assign_coords(wavelength=nm, view_zenith=zenith)
        hp.to_store(xr.DataTree.from_dict(lines), own / "lot.zarr")
        corners = [(2, 2), (18 - number, 2), (18, 30 - number), (2, 30)]
        regions = [hp.Region(f"paint {at}", corners, flightline="raw_0") for at in range(1 + number)]
        hp.write_regions(regions, own / "regions.geojson")
        rho = ("signature", "band"), rng.random((4, 30)).astype(np.float32), {"units": "1"}
        coords = {
            "signature": [f"paint {at} of {number}" for at in range(4)],
            "wavelength": ("band", np.linspace(400.0, 900.0, 30), {"units": "nm"}),
        }
        paints = xr.Dataset({"reflectance": rho, "standard_error": rho}, coords)
        hp.write_library(paints, own / "paints.zarr")


# --- what is there -----------------------------------------------------------------------------------------


def chunks_of(path: Path) -> dict[str, bytes]:
    # Return the bytes of every chunk below a folder
    files = (file for file in sorted(path.rglob("*")) if file.is_file() and "c" in file.parts)
    return {str(file.relative_to(path)): file.read_bytes() for file in files}


def stored(group: str | None, home: Path) -> str:
    # Return a checksum of the chunks of a store, empty where no reader takes it for whole
    # ``group`` is the one that was written, "" the root, None all of a tree
    path = home / "lot.zarr"
    if not path.exists():
        return ""
    try:
        opened = open_store(path, group or None) is not None
    except PaintError:
        opened = False
    try:
        problems = hp.verify(path).problems
    except PaintError as error:
        problems = [str(error)]
    if group is not None and opened != is_complete(path, group or None):
        return f"open_store: {opened}, is_complete: {not opened}"
    if opened and (wrong := [text for text in problems if not text.startswith(UNLISTED)]):
        return f"it is opened, but verify says {wrong[0]}"
    return hashlib.sha256(repr(chunks_of(path)).encode()).hexdigest() if opened or not problems else ""


def files(places: tuple[str, ...], home: Path) -> str:
    # Return a checksum of the files of a product, empty without the last one, by which it is opened
    key = home / places[-1]
    if not key.exists():
        return ""
    if key.suffix == ".icechunk":  # names of its files are random
        from hyperpaint.io.store.raw_references import virtual_groups

        try:
            return repr(virtual_groups(key))
        except Exception as error:
            return f"cannot be opened: {error!r:.200}"
    stores = [path.parent for path in key.rglob("zarr.json") if path.parent.suffix == ".zarr"]
    problems = [problem for store in stores for problem in hp.verify(store).problems]
    if wrong := [problem for problem in problems if not problem.startswith(UNLISTED)]:
        return f"verify says {wrong[0]}"
    digest = hashlib.sha256()
    for place in (home / name for name in places):
        for file in (
            sorted(path for path in place.rglob("*") if path.is_file()) if place.is_dir() else [place]
        ):
            content = file.read_bytes() if file.exists() else b"absent"
            # metadata of a store hold times, and have been verified
            content = b"" if file.name == "zarr.json" else _REPORT_TIME.sub(b"", content)
            digest.update(str(file.relative_to(home)).encode() + content)
    return digest.hexdigest()


# --- the table ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Work:
    # A product, and how often its writer is disturbed
    # write: Writes a version: takes the folder of the inputs, the version and the home of the product
    # content: Returns what a home holds: a checksum of the product, empty where there is none
    # inputs: Writes the inputs of both versions into a folder
    # replacing: The home holds the older version already
    # absent: A kill may leave no product that is whole; else the older one stays until the newer is in its
    # place
    # kills, in_a_row: At random instants; each run of a row goes on where the last was ended
    # calls: Kills before a call that changes files: how many; None before every one
    # codes: What happens at such a call: None, a kill; or the errno with which it fails
    write: Callable[[Path, str, Path], object]
    content: Callable[[Path], str]
    inputs: Callable[[Path], None] = lambda _: None
    replacing: bool = True
    absent: bool = False
    kills: int = 0
    in_a_row: int = 1
    calls: int | None = 0
    codes: tuple[int | None, ...] = (None,)


_of = functools.partial
_SLOW, _QUICK = (12, 0.02), (2, 0.0)
_IN_GROUP, _WHOLE = _of(stored, GROUP), _of(stored, None)
_BOTH: dict[str, Any] = {"calls": None, "codes": (None, errno.ENOSPC)}
#: By command: its words, and the files of its product, the last of which is the one that is opened.
_COMMANDS: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "signatures": (
        "signatures|{inputs}/lot.zarr|--regions|{inputs}/regions.geojson|--no-flags|--out|{home}/paints.zarr|--quiet",
        ("paints.zarr",),
    ),
    "orthorectify": (
        "orthorectify|{inputs}/lot.zarr|--line|raw_0|--out|{home}/map.tif|--stac|--quiet",
        ("map.json", "map.tif"),
    ),
    "mosaic": (
        "mosaic|{inputs}/lot.zarr|--out|{home}/both.tif|--seamlines|{home}/seams/both.geojson|--quiet",
        ("seams/both.geojson", "both.tif"),
    ),
    "virtual": ("virtual|{inputs}/raw/collect.toml|--out|{home}/lot.icechunk", ("lot.icechunk",)),
    "export": (
        "export|{inputs}/paints.zarr|--format|envi|--curves|all|--out|{home}/paints.sli|--quiet",
        ("paints.sli", "paints.sli.json", "paints.hdr"),
    ),
    "site": ("site|{inputs}/lot.zarr|--out|{home}/page|--quiet", ("page",)),
    "report": ("report|{inputs}/lot.zarr|--out|{home}/report.html|--quiet", ("report.html",)),
}
WORKS: Mapping[str, Work] = {
    "slow group": Work(_of(_group, *_SLOW, GROUP, True), _IN_GROUP, replacing=False, absent=True, kills=100),
    "slow group replaced": Work(_of(_group, *_SLOW, GROUP, True), _IN_GROUP, kills=100),
    "new group": Work(_of(_group, *_QUICK, GROUP, True), _IN_GROUP, replacing=False, absent=True, calls=None),
    "group replaced": Work(_of(_group, *_QUICK, GROUP, True), _IN_GROUP, calls=None),
    "root replaced": Work(_of(_group, *_QUICK, None, True), _of(stored, ""), calls=None),
    "by two renames": Work(_of(_group, *_QUICK, GROUP, False), _IN_GROUP, absent=True, calls=None),
    "run of 40 lines": Work(
        _of(_process, False), _WHOLE, _of(collects, 40), replacing=False, absent=True, kills=250, in_a_row=5
    ),
    "run of 40 lines replaced": Work(
        _of(_process, True), _WHOLE, _of(collects, 40), absent=True, kills=250, in_a_row=5
    ),
    "run of 2 lines": Work(
        _of(_process, False), _WHOLE, _of(collects, 2), replacing=False, absent=True, **_BOTH
    ),
    "run of 2 lines replaced": Work(_of(_process, True), _WHOLE, _of(collects, 2), absent=True, **_BOTH),
    **{
        name: Work(
            _of(_command, words), _of(files, places), _lots, absent=len(places) > 1, kills=10, calls=10
        )
        for name, (words, places) in _COMMANDS.items()
    },
}


# --- the engine --------------------------------------------------------------------------------------------


class Writer:
    # A row of the table at work: its inputs, and what undisturbed children make of both versions
    def __init__(self, name: str, folder: Path, work: Work | None = None) -> None:
        self.name, self.work, self.inputs = name, work or WORKS[name], folder / "inputs"
        self.inputs.mkdir()
        self.work.inputs(self.inputs)
        self.older, again = folder / "older", folder / "again"
        self.seconds, self.calls, self.contents = 0.0, 0, {"": "absent"}
        for version, home in (("older", self.older), ("newer", folder / "newer"), ("newer", again)):
            if home == again and self.work.replacing:
                shutil.copytree(self.older, home)
            home.mkdir(exist_ok=True)
            began = time.monotonic()
            status, text, self.calls = end_of(self.start(home, version))
            self.seconds = time.monotonic() - began
            if status != DONE:
                raise RuntimeError(f"{name} exits with {status}: {text}")
            content = self.work.content(home)
            if home == again and self.contents.get(content) != "newer":
                raise RuntimeError(f"{name}: two runs write different bytes")
            self.contents[content] = version
            self.entries = _entries(home)
        if len(self.contents) != 3:
            raise RuntimeError(f"{name}: the versions are the same")
        allowed = {"newer"} | ({"older"} if self.work.replacing else {"absent"})
        self.allowed = allowed | ({"absent"} if self.work.absent else set())

    def start(self, home: Path, version: str = "newer", fault: Fault | None = None, wait: Any = None) -> Any:
        return start(_after, wait, self.work.write, self.inputs, version, home, fault=fault, folder=home)

    def begin(self, home: Path) -> Path:
        # Make a home before a fault
        if self.work.replacing:
            shutil.copytree(self.older, home)
        else:
            home.mkdir()
        return home

    def found(self, home: Path) -> str:
        # Return the version in a home; what it is else
        content = self.work.content(home)
        return self.contents.get(content, f"mixed ({content:.300})")

    def judge(self, fault: str, home: Path, outcome: Outcome, *, again: bool = True) -> None:
        # Note what is wrong with what a disturbed run left, and with what the next run makes of it
        found = self.found(home)
        outcome.notes[f"{found.partition(' ')[0]} left"] += 1
        if found not in self.allowed:
            outcome.wrong.append(f"{fault}: {found} is left, {_entries(home)}")
        if again:
            status, text, _ = end_of(self.start(home))
            found, entries = self.found(home), _entries(home)
            if status != DONE or found != "newer" or entries != self.entries:
                outcome.wrong.append(
                    f"{fault}: the rerun exits with {status}, {found}, {entries}: {text:.300}"
                )


def _after(wait: Any, write: Callable[..., object], *arguments: Any) -> None:
    # Write, at once or when others are ready
    if wait is not None:
        wait.wait()
    write(*arguments)


def _entries(home: Path) -> list[str]:
    # Return what lies in a home, and what is hidden anywhere below
    found = {*home.iterdir(), *home.glob("seams/*"), *home.rglob(".*")}
    return sorted(str(path.relative_to(home)) for path in found)


def run_kills(number: int, folder: Path, writer: Writer, outcome: Outcome) -> None:
    # End runs at random instants by signals, each run of a row going on where the last was ended
    home = writer.begin(folder / "home")
    for kill in range(number, number + writer.work.in_a_row):
        rng, which = random.Random(f"{writer.name}:{kill}"), SIGNALS[kill % len(SIGNALS)]
        child = writer.start(home)
        child.join(rng.uniform(0.0, 1.05 * writer.seconds / (1 + kill - number)))
        amid = child.is_alive()
        if amid:
            os.kill(child.pid, which)
        status, text, _ = end_of(child)
        outcome.count += 1
        outcome.notes[f"{which.name} amid" if amid else "done before"] += 1
        fault = f"{writer.name}, kill {kill} ({which.name})"
        if status not in (-which, 128 + which, DONE):
            outcome.wrong.append(f"{fault}: exits with {status}: {text:.300}")
        writer.judge(fault, home, outcome, again=kill == number + writer.work.in_a_row - 1)


def run_call(number: int, folder: Path, writer: Writer, code: int | None, outcome: Outcome) -> None:
    # Let one call of a run end it, or fail
    home = writer.begin(folder / "home")
    status, text, _ = end_of(writer.start(home, fault=Fault(number, code)))
    how = "killed" if code is None else errno.errorcode[code]
    fault = f"{writer.name}, call {number} of {writer.calls} ({how})"
    if code is None and status == DONE:
        return  # its last call came before
    outcome.count += 1
    # a call whose failure does not matter, such as the removal of an empty folder, is passed over
    if status not in ((ENDED_AT_A_CALL,) if code is None else (REFUSED, DONE)):
        outcome.wrong.append(f"{fault}: exits with {status}: {text:.300}")
    writer.judge(fault, home, outcome)


def run_race(number: int, folder: Path, writer: Writer, outcome: Outcome) -> None:
    # Start two writers of different versions at once; one of them is what the home holds
    home, barrier = folder / "home", CONTEXT.Barrier(2)
    home.mkdir()
    children = {version: writer.start(home, version, wait=barrier) for version in VERSIONS}
    status = {version: end_of(child)[0] for version, child in children.items()}
    outcome.count += 1
    outcome.notes[f"{list(status.values()).count(REFUSED)} refused"] += 1
    won, found = [version for version, code in status.items() if code == DONE], writer.found(home)
    if not won or not set(status.values()) <= {DONE, REFUSED} or found not in won:
        outcome.wrong.append(f"race {number}: writers exit with {status}, the home holds {found}")


# --- campaigns ---------------------------------------------------------------------------------------------


def _writers(names: Iterable[str]) -> Iterator[Writer]:
    for name in names:
        with tempfile.TemporaryDirectory(dir=SCRATCH) as folder:
            yield Writer(name, Path(folder))


def kills(scale: float = 1.0, *, first: int = 0) -> Iterator[Outcome]:
    # Yield the outcome of every kill at a random instant
    for writer in _writers(name for name, work in WORKS.items() if work.kills):
        numbers = numbers_of(writer.work.kills, scale, first, writer.work.in_a_row)
        yield from each(f"killed: {writer.name}", numbers, run_kills, writer)


def calls(scale: float = 1.0, *, first: int = 0) -> Iterator[Outcome]:
    # Yield the outcome of every call that ends a run, or fails
    for writer in _writers(name for name, work in WORKS.items() if work.calls != 0):
        least = 1 if writer.work.calls is None else writer.calls / writer.work.calls
        step = max(1, round(least / scale))
        for code in writer.work.codes:
            title = f"{'killed' if code is None else 'failing'} call: {writer.name}"
            yield from each(title, range(1 + first % step, writer.calls + 1, step), run_call, writer, code)


def races(scale: float = 1.0, *, first: int = 0) -> Iterator[Outcome]:
    # Yield the outcome of every race
    for writer in _writers(["slow group"]):
        yield from each("two writers", numbers_of(RACES, scale, first), run_race, writer)
