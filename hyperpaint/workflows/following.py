"""A flight processed while it is recorded: slabs of complete lines become blocks, and `process` ends it.

In flight a slab of 32 lines is calibrated as soon as its lines, their places and the light after them are
there, and written as a block. Whether a block is right is decided in the end alone, when `process` opens the
finished flight: a block is taken up where the counts on the disk, and all that its lines are calibrated with,
are those that it was made of. The others are made anew, so that the store is that of the batch, bit for bit.
"""

from __future__ import annotations

import bisect
import contextlib
import os
import tempfile
import time
import warnings
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hyperpaint.base.constants import DEFAULT_CODEC, KEPT_BITS
from hyperpaint.base.errors import CollectError, Findings, PaintError, Problems
from hyperpaint.base.schema import ALONG_TRACK, CHUNK_LINES, IRRADIANCE_TIME, Quality
from hyperpaint.io.files.toml_tables import load_tables
from hyperpaint.io.flightline.growing import GrowingLine, growing_cubes

from .flown_slabs import PRODUCTS, digest_of, form_of, take_up
from .pipeline import Outcome, local_folder, run

if TYPE_CHECKING:
    import xarray as xr

    from hyperpaint.io.collect.collect_toml import Collect
    from hyperpaint.io.flightline.flightline_opening import FlightlineInputs
    from hyperpaint.io.store.layout import Codec
    from hyperpaint.io.store.stage import Staging
    from hyperpaint.radiometry.slabs import Plan

    from .flight_blocks import FlightBlocks

#: Time between two looks at the files [s].
POLL_S = 0.1
#: Time without growth after which a flight counts as ended [s].
IDLE_S = 10.0
#: Wait after the last line: for further lines, and for the irradiance record of the line [s].
QUIET_S, RECORD_S = 3.0, 60.0
#: Maximum number of lines planned together, so that the data read for a plan do not grow with the flight.
WINDOW_LINES = 2048
#: Rows of the navigation and files of the record that are read again from before the first line.
MARGIN_POSES, MARGIN_SPECTRA = 500, 30
#: Slabs between two looks at the files, where many wait.
SLABS_A_TURN = 16
#: Over how long the rate is taken [s].
RECENT_S = 3.0


@dataclass
class FlightState:
    """How far a flight has been followed."""

    lines: int = 0  #: Complete lines on the disk
    done: int = 0  #: Lines in blocks
    rate: float = 0.0  #: Lines recorded a second, of late
    lag_s: float = 0.0  #: Age of the oldest complete line that is in no block yet
    longest_lag_s: float = 0.0
    busy_s: float = 0.0  #: Time that planning, calibration and writing took
    waits_for: str = ""  #: Why lines have no products yet
    flagged: dict[Quality, int] = field(default_factory=dict)  #: Pixels under every flag
    pixels: int = 0

    def __str__(self) -> str:
        shares = ", ".join(
            f"{str(flag.name).lower().replace('_', ' ')} {count / self.pixels:.2%}"
            for flag, count in self.flagged.items()
            if count
        )
        waits = f"; {self.waits_for}" if self.waits_for else ""
        return (
            f"{self.done} of {self.lines} lines, {self.rate:.0f} a second, {self.lag_s:.1f} s behind{waits}; "
            f"flags: {shares or 'none'}"
        )


class _Line:
    def __init__(self, group: str, growing: GrowingLine) -> None:
        self.group, self.growing = group, growing
        self.blocks: FlightBlocks | None = None
        self.settings: Collect | None = None
        self.plan: Plan | None = None
        self.first, self.final = 0, 0  # lines from where the plan begins to where it is final
        self.unlit: Any = None  # the record that ended before the last line of a plan
        self.lines = self.done = self.counted = 0
        #: Complete lines, poses and spectra, and when there were so many
        self.marks: list[tuple[int, int, int, float]] = []

    def mark_before(self, line: int) -> tuple[int, int, int, float]:
        # the last mark at which a line was not there yet
        place = bisect.bisect_right(self.marks, line, key=lambda mark: mark[0])
        return self.marks[place - 1] if place else (0, 0, 0, 0.0)


class Following:
    """The state of a flight that is followed; `look` takes one turn."""

    def __init__(
        self, collect: Path, stage: Staging, view: Path, *, products: tuple[str, ...] = PRODUCTS,
        codec: Codec = DEFAULT_CODEC, clock: Callable[[], float] = time.time,
    ) -> None:  # fmt: skip
        self._path, self._stage, self._view, self._clock = collect, stage, view, clock
        self._products, self._codec = products, codec
        self._lines: dict[int, _Line] = {}
        self._opened: dict[Path, Any] = {}
        self._record: tuple[Any, xr.Dataset] | None = None
        self._sizes: Any = None
        self._pool = ThreadPoolExecutor(max(2, min(4, os.cpu_count() or 2)))
        self.state = FlightState()
        self._recorded: list[int] = []
        self._grown_at = self._recorded_at = 0.0

    def prepare(self) -> None:
        """Open the available files and load the kernels before the first line arrives."""
        from hyperpaint.io.collect.collect_toml import parse_collect
        from hyperpaint.radiometry.counts_to_reflectance import reflectance
        from hyperpaint.radiometry.example_pixel import worked_example

        example = worked_example()
        example["counts"] = example["counts"].astype(np.uint16)  # as cubes hold them
        reflectance(example, keep_bits=KEPT_BITS)["quality"].compute(scheduler="sync")
        tables = load_tables(self._path, "a collect.toml")
        # any file serves as the cube: calibration and dark are read, which are the same for every line
        tables |= {"flightlines": [{"cube": str(self._path.absolute())}], "panels": [], "references": []}
        settings = parse_collect(self._path, Problems("", CollectError), need_irradiance=True, tables=tables)
        with warnings.catch_warnings(), contextlib.suppress(PaintError, OSError):
            warnings.simplefilter("ignore")
            self._constants(settings, settings.flightlines[0].dark)

    # --- one turn ---

    def look(self) -> bool:
        """Look at the files, and write complete slabs; return whether more could be written at once."""
        waits: list[str] = []
        sizes = []
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # `process` gives them in the end
            tables = load_tables(self._path, "a collect.toml")
            for number, table in enumerate(tables.get("flightlines", ())):
                cubes = growing_cubes(self._path.parent, str(table.get("cube", "")))
                if not cubes:
                    continue
                line = None
                try:
                    problems = Problems(f"{self._path} cannot be followed yet", CollectError)
                    line, files = self._grown(number, tables, table, cubes, problems)
                    sizes.append((line.lines, line.growing.poses, files))
                    if line.blocks is None and line.lines >= CHUNK_LINES:
                        self._begin(line)
                    problems.raise_if_any()
                    self._advance(line, files)
                except (PaintError, OSError) as error:
                    waits.append(" ".join(str(error).split())[:120])
                    if line is not None:
                        self._count(line)
                if line is not None:
                    self._judge_lag(line)
        self.state.waits_for = "; ".join(dict.fromkeys(waits))
        now = self._clock()
        if sizes != self._sizes:
            self._sizes, self._grown_at = sizes, now
        if (lines := [size[0] for size in sizes]) != self._recorded:
            self._recorded, self._recorded_at = lines, now
        return any(line.done + CHUNK_LINES <= line.final for line in self._lines.values())

    def has_ended(self, idle: float) -> bool:
        """Return whether the flight has ended; ``idle``: time without growth after which it has [s]."""
        quiet, recorded = self._clock() - self._grown_at, self._clock() - self._recorded_at
        if not any(self._recorded):
            return False
        if all(0 < line.growing.planned <= line.lines <= line.final for line in self._lines.values()):
            return quiet >= min(idle, QUIET_S) or recorded >= RECORD_S
        return recorded >= idle and (quiet >= idle or recorded >= RECORD_S)

    def _grown(
        self, number: int, tables: Mapping[str, Any], table: Mapping[str, Any], cubes: list[Path],
        problems: Problems,
    ) -> tuple[_Line, list[tuple[Path, int, int]]]:  # fmt: skip
        from hyperpaint.io.collect.collect_toml import parse_collect
        from hyperpaint.io.flightline.headwall import frame_index_beside, navigation_beside

        beside: dict[str, Path | None] = {}
        if not {"frame_index", "start_time"} & set(table):
            beside["frame_index"] = frame_index_beside(cubes[0])
            if not {"nav", "gps_time", "date"} & set(table):
                beside["nav"] = navigation_beside(cubes[0])
        name = str(table.get("id", cubes[0].name.split(".")[0]))
        own = {key: str(path.absolute()) for key, path in beside.items() if path is not None}
        # the cube alone, and nothing that is for the end
        alone = {**table, **own, "cube": str(cubes[0].absolute()), "id": name}
        flown = {**tables, "flightlines": [alone], "panels": [], "references": []}
        settings = parse_collect(self._path, problems, need_irradiance=True, tables=flown)
        if number not in self._lines:
            growing = GrowingLine(self._view / str(number))
            self._lines[number] = _Line(f"flightlines/{name}", growing)
        line = self._lines[number]
        line.settings = settings
        line.lines = line.growing.look(cubes, settings.flightlines[0])
        paths = settings.irradiance.files if settings.irradiance is not None else ()
        states = ((path, path.stat()) for path in paths)
        files = [(path, state.st_size, state.st_mtime_ns) for path, state in states]
        if not line.marks or line.marks[-1][0] != line.lines:
            line.marks.append((line.lines, line.growing.poses, len(files), self._clock()))
        return line, sorted(files, key=lambda file: (file[2], file[0]))

    def _advance(self, line: _Line, files: list[tuple[Path, int, int]]) -> None:
        while line.blocks is not None and line.done + CHUNK_LINES <= line.lines:
            if line.done + CHUNK_LINES > line.final and not self._plan(line, files):
                break
            self._write(line)
            if line.done + CHUNK_LINES <= line.final:
                break  # other lines, and whoever watches, come in between
        if line.final < line.lines == line.growing.planned:
            self._plan(line, files)  # the last lines fill no slab, and wait for their light as well

    def _judge_lag(self, line: _Line) -> None:
        # the age of the oldest line that is in no block
        state, now = self.state, self._clock()
        state.lines = sum(each.lines for each in self._lines.values())
        state.done = sum(each.done for each in self._lines.values())
        late = bisect.bisect_right(line.marks, line.done, key=lambda mark: mark[0])
        state.lag_s = now - line.marks[late][3] if late < len(line.marks) else 0.0
        if line.lines - line.done >= CHUNK_LINES:
            state.longest_lag_s = max(state.longest_lag_s, state.lag_s)
        recent = [mark for mark in line.marks[-100:] if now - mark[3] <= RECENT_S]
        if len(recent) > 1 and recent[-1][3] > recent[0][3]:
            state.rate = (recent[-1][0] - recent[0][0]) / (recent[-1][3] - recent[0][3])

    # --- blocks ---

    def _begin(self, line: _Line) -> None:
        # from the first slab on
        from .flight_blocks import FlightBlocks

        header = line.growing.header
        form = form_of(header.bands, header.samples, header.dtype.newbyteorder("="))
        line.blocks = FlightBlocks.of(self._stage, line.group, form[["counts", *self._products]], self._codec)
        while line.done // CHUNK_LINES in line.blocks.digests:
            line.done += CHUNK_LINES
        line.counted = line.done

    def _count(self, line: _Line) -> None:
        # counts only, of slabs that cannot be calibrated yet
        slabs = range(line.counted // CHUNK_LINES, line.lines // CHUNK_LINES)[:SLABS_A_TURN]
        if line.blocks is None or not slabs:
            return
        write = line.blocks.write
        for _ in self._pool.map(lambda slab: write(slab, {"counts": self._read(line, slab)}), slabs):
            line.counted += CHUNK_LINES

    def _write(self, line: _Line) -> None:
        begun = self._clock()
        slabs = range(line.done // CHUNK_LINES, line.final // CHUNK_LINES)[:SLABS_A_TURN]
        for quality in self._pool.map(lambda slab: self._slab(line, slab), slabs):
            self._note_flags(quality)
        line.done += len(slabs) * CHUNK_LINES
        line.counted = max(line.counted, line.done)
        self.state.busy_s += self._clock() - begun

    @staticmethod
    def _read(line: _Line, slab: int) -> Any:
        return line.growing.counts(slab * CHUNK_LINES, (slab + 1) * CHUNK_LINES)

    def _slab(self, line: _Line, slab: int) -> Any:
        from hyperpaint.radiometry.slabs import run_slab

        assert line.blocks is not None
        assert line.plan is not None
        counts, place = self._read(line, slab), slab * CHUNK_LINES - line.first
        source = counts if counts.dtype == np.uint16 else counts.astype(np.float32)
        reflectance, quality = run_slab(source, replace(line.plan, starts=np.array([place])), (0,))
        arrays = {"counts": counts, "reflectance": reflectance, "quality": quality}
        blocks = {name: arrays[name] for name in ("counts", *self._products)}
        line.blocks.write(slab, blocks, digest_of(line.plan, place))
        return quality

    def _note_flags(self, quality: Any) -> None:
        state = self.state
        state.pixels += quality.size
        for flag in Quality:
            state.flagged[flag] = state.flagged.get(flag, 0) + int(np.count_nonzero(quality & int(flag)))

    # --- plan ---

    def _plan(self, line: _Line, files: list[tuple[Path, int, int]]) -> bool:
        # returns whether a slab of the planned lines is final
        from hyperpaint.radiometry.counts_to_reflectance import reflectance
        from hyperpaint.radiometry.slabs import plan_of

        if files == line.unlit:
            return False
        begun, done = self._clock(), line.done
        _, poses, spectra, _ = line.mark_before(done)
        stop = min(line.lines, done + WINDOW_LINES)
        inputs, first = line.growing.ended(done, stop, max(0, poses - MARGIN_POSES))
        record = self._irradiance(line, files[max(0, spectra - MARGIN_SPECTRA) :])
        flown = self._assembled(line, inputs, record)
        lit = np.flatnonzero(flown["time"].values <= record[IRRADIANCE_TIME].values[-1])
        line.final = first + (int(lit[-1]) + 1 if lit.size else 0)
        line.unlit = files if line.final < stop else None
        is_final = line.final >= done + CHUNK_LINES
        if is_final:
            line.plan, line.first = plan_of(reflectance(flown, keep_bits=KEPT_BITS)["quality"].data), first
        self.state.busy_s += self._clock() - begun
        return is_final

    def _assembled(self, line: _Line, inputs: FlightlineInputs, record: xr.Dataset) -> xr.Dataset:
        # calibration and dark never change and are opened once
        from hyperpaint.io.flightline.flightline_opening import assemble

        assert line.settings is not None
        calibration, dark = self._constants(line.settings, inputs.dark)
        findings = Findings("a line in flight")
        parts: Any = {"dark": dark, "calibration": calibration, "irradiance": record}
        flown = assemble(replace(inputs, chunks={ALONG_TRACK: CHUNK_LINES}, **parts), findings)
        findings.raise_if_any()
        return flown

    def _constants(self, settings: Collect, dark: Any) -> tuple[Any, Any]:
        from hyperpaint.io.flightline.calibration_store import open_calibration
        from hyperpaint.io.flightline.dark import open_dark

        from .laboratory import calibrate_sweep

        calibration: Any = settings.calibration
        if settings.sweep is not None:
            calibration = self._once(settings.sweep, lambda path: open_calibration(calibrate_sweep(path)))
        elif isinstance(calibration, Path):
            calibration = self._once(calibration, open_calibration)
        if isinstance(dark, tuple):
            dark = self._once(dark[0], lambda _: open_dark(dark, settings.clock, calibration, None))
        return calibration, dark

    def _once(self, path: Path, opens: Callable[[Path], Any]) -> Any:
        if path not in self._opened:
            self._opened[path] = opens(path)
        return self._opened[path]

    def _irradiance(self, line: _Line, files: list[tuple[Path, int, int]]) -> xr.Dataset:
        from hyperpaint.io.spectrometers.irradiance import open_irradiance

        entry = None if line.settings is None else line.settings.irradiance
        if entry is None or not files:
            raise CollectError("no irradiance yet", code="irradiance-missing")
        if entry.on_aircraft:
            raise CollectError(
                "a record from the aircraft is made level when it is whole", code="record-incomplete"
            )
        if self._record is None or self._record[0] != files:
            self._record = (files, open_irradiance([path for path, _, _ in files], **entry.options))
        return self._record[1]

    def close(self) -> None:
        """End the threads."""
        self._pool.shutdown()


def follow(
    folder: str | Path,
    out: str | Path | None = None,
    *,
    collect: str | Path | None = None,
    idle: float = IDLE_S,
    watch: Callable[[FlightState], None] | None = None,
    **options: Any,
) -> Outcome:
    """Process a flight while it is being recorded, and end as `process` does.

    Slabs of 32 complete lines are calibrated and written as soon as their places and the light after them are
    there. A flight has ended when every line has as many lines as its header promises, light for all of them,
    and nothing more comes (a minute of the record at the most); when no line has come for a while; or at
    Ctrl-C. Then the finished flight is processed: what was
    written in flight is taken up where it is what would be written, else made anew. Killed at any time, the
    same call goes on.

    Parameters
    ----------
    folder
        Folder of the flight.
    out
        The store; by default ``products/lot.zarr`` beside the collect.
    collect
        The ``collect.toml``; by default the one in the folder, or in the folder above. What it names may
        still be to come.
    idle
        Time without a line after which the flight has ended [s].
    watch
        Called after every look with the `FlightState`.
    **options
        Those of `hyperpaint.process`, but ``to`` and ``scheduler``.

    Returns
    -------
    hyperpaint.workflows.pipeline.Outcome
        What was written.

    Raises
    ------
    CollectError, SchemaError, StoreError
        As `hyperpaint.process`, when the flight has ended; there is no collect; or another writer is at work.

    Examples
    --------
    >>> import tempfile
    >>> from hyperpaint.simulation import simulate_collect
    >>> path = simulate_collect(tempfile.mkdtemp(), scene="plan", lines=64, bands=4, columns=6)
    >>> follow(path.parent / "flight").written[0]
    'flightlines/raw_0'
    """
    from hyperpaint.io.store.stage import Staging, staging
    from hyperpaint.io.store.writer import real_folder

    from .field_day import store_of

    path = _collect_of(Path(folder), collect)
    store = local_folder(store_of(path) if out is None else out, "follow")
    products = ("quality",) if options.get("reflectance") == "none" else PRODUCTS
    store.parent.mkdir(parents=True, exist_ok=True)
    place = real_folder(store)
    with staging(place, Staging(place).begun()) as stage, tempfile.TemporaryDirectory() as view:
        following = Following(
            path, stage, Path(view), products=products, codec=options.get("codec", DEFAULT_CODEC)
        )
        with contextlib.closing(following), contextlib.suppress(KeyboardInterrupt):
            following.prepare()
            while True:
                busy = following.look()
                if watch is not None:
                    watch(following.state)
                if not busy and following.has_ended(idle):
                    break
                if not busy:
                    time.sleep(POLL_S)
    outcome = run(path, store, take_up=take_up, **options)
    if Staging(place).begun():  # the store was whole before: nothing takes up what was written in flight
        with contextlib.suppress(PaintError, OSError), staging(place):
            pass
    return outcome


def _collect_of(folder: Path, collect: str | Path | None) -> Path:
    if collect is not None:
        return Path(collect)
    places = [folder / "collect.toml", folder.parent / "collect.toml"]
    found = next((place for place in places if place.is_file()), None)
    if found is None:
        raise CollectError(
            f"{folder}: no collect.toml there, nor in the folder above",
            mend="give collect=; what it names may still be to come",
            option="give --collect; what it names may still be to come",
            code="collect-missing",
        )
    return found
