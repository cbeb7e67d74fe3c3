"""Flights with one fault of time each: reflectance that is wrong by a hundredth must say so."""

import datetime as dt
import random
import shutil
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

import hyperpaint as hp
from hyperpaint.base.errors import PaintError
from hyperpaint.base.schema import Quality

from .outcome import Outcome, in_parallel, numbers_of, parts_of

FAULTY, CLEAN = 1000, 500
FALSE_ALARMS = 5
LARGEST_EFFECT = 0.01
_PART = 25
_CLOUDY_SHARE = 5
_LINES, _BANDS, _COLUMNS, _PERIOD_MS = 48, 6, 6, 200.0
_TELLING = Quality.IRRADIANCE_GAP | Quality.ILLUMINATION_UNSTABLE | Quality.NO_DATA
#: Faults of which `timing_sensitive` warns; of the others it does not count as a word.
_OF_CLOCKS = ("offset 0.5-5 s", "offset in known 2 s", "offset 18 s", "offset 37 s", "whole hours", "drift")
_KNOWN_CLOCK = 0.1
_DATE = "%Y/%m/%d %H:%M:%S.%f"

_Change = Callable[[Path, random.Random], None]


# --- files of the collect, changed -------------------------------------------------------------------------


def _rows(path: Path, change: Callable[[list[str]], list[str]]) -> None:
    # Change the rows of a table under its header
    head, *rows = path.read_text().splitlines()
    path.write_text("\n".join([head, *change(rows)]) + "\n")


def _spectra(folder: Path) -> list[Path]:
    # Return the files of the samples around the middle of the line, in order of time
    files = sorted((folder / "asd").glob("*.asd"))
    middle = len(files) // 2
    return files[middle - 2 : middle + 3]


def _replace(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    if old not in text:
        raise ValueError(f"{path.name} holds no {old!r}; the simulator writes something else now")
    path.write_text(text.replace(old, new))


def _later_sky(folder: Path, seconds: float) -> None:
    _replace(folder / "collect.toml", "clock_offset_s = 37.25", f"clock_offset_s = {37.25 + seconds}")


def _redate(folder: Path, change: Callable[[float], float]) -> None:
    # Change the seconds of navigation since its first row
    def rows_of(rows: list[str]) -> list[str]:
        cells = [row.split("\t") for row in rows]
        dates = [dt.datetime.strptime(row[7], _DATE) for row in cells]
        for row, date in zip(cells, dates, strict=True):
            since = (date - dates[0]).total_seconds()
            row[7] = (dates[0] + dt.timedelta(seconds=change(since))).strftime(_DATE)
        return ["\t".join(row) for row in cells]

    _rows(folder / "flight/imu_gps.txt", rows_of)


def _duplicate_sky(folder: Path, rng: random.Random) -> None:
    chosen, other = rng.sample(_spectra(folder), 2)
    data = other.read_bytes()
    other.write_bytes(data[:160] + chosen.read_bytes()[160:178] + data[178:])  # the time of another spectrum


def _duplicate_frame(folder: Path, rng: random.Random) -> None:
    place = rng.randrange(1, _LINES)

    def repeat(rows: list[str]) -> list[str]:
        rows[place] = rows[place].split("\t")[0] + "\t" + rows[place - 1].split("\t")[1]
        return rows

    _rows(folder / "flight/frameIndex_0.txt", repeat)


def _gap(folder: Path, rng: random.Random) -> None:
    for path in _spectra(folder)[: rng.randrange(1, 6)]:
        path.unlink()


def _spoil(path: Path, change: Callable[[Any], None], flag: int = 0) -> None:
    # Change the spectrum of a binary file, and set bits of its saturation flags
    from hyperpaint.io.spectrometers.asd import read_asd

    data, count = bytearray(path.read_bytes()), len(read_asd(path).spectrum)
    change(np.frombuffer(data, {0: "<f4", 2: "<f8"}[data[199]], count, 484))
    data[422] |= flag
    path.write_bytes(bytes(data))


def _saturated(folder: Path, rng: random.Random) -> None:
    level = rng.uniform(0.3, 0.8)
    _spoil(rng.choice(_spectra(folder)), lambda v: np.minimum(v, level * v.max(), out=v), flag=1)


def _shift(folder: Path, seconds: float) -> None:
    _redate(folder, lambda since: since + seconds)


def _offset(folder: Path, rng: random.Random) -> None:
    seconds = rng.choice((-1, 1)) * rng.uniform(0.5, 5.0)
    rng.choice((_later_sky, _shift))(folder, seconds)


def _known_offset(folder: Path, rng: random.Random) -> None:
    # Shift the sky by less than what is declared of its clock
    _later_sky(folder, rng.choice((-1, 1)) * rng.uniform(0.2, 2.0))
    _replace(folder / "collect.toml", "[irradiance]\n", "[irradiance]\nclock_uncertainty_s = 2.0\n")


def _drift(folder: Path, rng: random.Random) -> None:
    rate = 1.0 + rng.uniform(-5e-5, 5e-5)
    _redate(folder, lambda since: since * rate)


def _missing_exposure(folder: Path, _: random.Random) -> None:
    _replace(folder / "collect.toml", "exposure_time_ms = 5.0\n", "")
    _replace(folder / "flight/settings.txt", "Exposure", "Aperture")
    _replace(folder / "flight/raw_0.hdr", ";Exposure (ms)", ";Aperture (mm)")


def _no_date(folder: Path, rng: random.Random) -> None:
    start, count = rng.randrange(50, 300), rng.randrange(1, 400)

    def blank(rows: list[str]) -> list[str]:
        cells = [row.split("\t") for row in rows]
        for row in cells[start : start + count]:
            row[7] = rng.choice(("", "NaT", "0000/00/00 00:00:00.000000"))
        return ["\t".join(row) for row in cells]

    _rows(folder / "flight/imu_gps.txt", blank)


def _frame_count(folder: Path, rng: random.Random) -> None:
    extra = rng.choice((-3, -1, 1, 2))

    def change(rows: list[str]) -> list[str]:
        frame, stamp = map(int, rows[-1].split("\t"))
        more = [f"{frame + step}\t{stamp + step * 200_000}" for step in range(1, extra + 1)]
        return rows[:extra] if extra < 0 else rows + more

    _rows(folder / "flight/frameIndex_0.txt", change)


def _dropped(folder: Path, rng: random.Random) -> None:
    # Take frames out of the index that the cube holds as blank lines, or of the cube as well
    gone = set(rng.sample(range(1, _LINES - 1), rng.randrange(1, 6)))
    _rows(folder / "flight/frameIndex_0.txt", lambda rows: [r for i, r in enumerate(rows) if i not in gone])
    if rng.random() < 0.5:
        cube = folder / "flight/raw_0"
        counts = np.fromfile(cube, "<u2").reshape(_LINES, -1)
        np.delete(counts, sorted(gone), axis=0).tofile(cube)
        _replace(folder / "flight/raw_0.hdr", f"lines = {_LINES}", f"lines = {_LINES - len(gone)}")


def _hours(folder: Path, rng: random.Random) -> None:
    hours = rng.choice([step for step in range(-12, 13) if step])
    if rng.random() < 0.5:
        _replace(folder / "collect.toml", "utc_offset_h = -5.0", f"utc_offset_h = {-5.0 + hours}")
    else:
        _shift(folder, 3600.0 * hours)


FAULTS: dict[str, _Change] = {
    "reversed": lambda folder, rng: _rows(
        folder / rng.choice(("flight/frameIndex_0.txt", "flight/imu_gps.txt")), lambda rows: rows[::-1]
    ),
    "duplicate spectrum": _duplicate_sky,
    "duplicate frame": _duplicate_frame,
    "gap": _gap,
    "NaN spectrum": lambda folder, rng: _spoil(
        rng.choice(_spectra(folder)), lambda values: values.fill(np.nan)
    ),
    "saturated spectrum": _saturated,
    "offset 0.5-5 s": _offset,
    "offset in known 2 s": _known_offset,
    # GPS time that is taken for UTC, or corrected twice; TAI
    "offset 18 s": lambda folder, rng: _shift(folder, rng.choice((-18.0, 18.0))),
    "offset 37 s": lambda folder, rng: _later_sky(folder, rng.choice((-37.0, 37.0))),
    "whole hours": _hours,
    "drift": _drift,
    "no date": _no_date,
    "missing exposure": _missing_exposure,
    "frame count": _frame_count,
    "dropped frames": _dropped,
}


# --- one flight --------------------------------------------------------------------------------------------


def _simulate(folder: Path, rng: random.Random, *, cloudy: bool, known_clock: float | None = None) -> float:
    # Write a collect of ten seconds, during which a cloud covers the sun
    # Returns: An upper bound of the relative change of the light in a second
    from hyperpaint.simulation import simulate_collect

    ramp = rng.uniform(5.0, 120.0)
    cloud = (rng.uniform(0.05, 0.8), ramp, rng.uniform(-ramp, 8.0)) if cloudy else None
    simulate_collect(
        folder,
        scene="plan",
        lines=_LINES,
        bands=_BANDS,
        columns=_COLUMNS,
        seed=rng.randrange(2**31),
        frame_period_ms=_PERIOD_MS,
        irradiance_margin_s=rng.choice((6.0, 30.0, 60.0)),
        drift_per_minute=rng.choice((0.0, 0.001, 0.02)) if cloudy else 0.001,
        cloud=cloud,
        clock_uncertainty_s=known_clock,
        glint=0.0,
        bad_elements=0,
    )
    return 0.0 if cloud is None else cloud[0] / cloud[1] / (1.0 - cloud[0]) + 0.001


def _process(folder: Path) -> tuple[Any, list[str]]:
    # Return the line with its reflectance, in memory, and the warnings on the way
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        line = hp.open_collect(folder / "collect.toml")["flightlines/raw_0"].to_dataset()
        made = line.paint.reflectance()[["reflectance", "quality", "frame"]].compute()
    return made, [str(warning.message) for warning in heard]


def _effects(made: Any, whole: Any, telling: int) -> tuple[float, float]:
    # Return the largest relative error of a line, and that of a line that none of these flags tells of
    rows = {frame: row for row, frame in enumerate(whole.frame.values.tolist())}
    errors, untold = [0.0], [0.0]
    for row, frame in enumerate(made.frame.values.tolist()):
        if frame not in rows:
            return np.inf, np.inf
        ratio = made.reflectance.values[row] / whole.reflectance.values[rows[frame]]
        ratio = ratio[np.isfinite(ratio)]
        if ratio.size:
            errors.append(abs(float(np.median(ratio)) - 1.0))
            if not (made.quality.values[row] & np.uint16(telling)).any():
                untold.append(errors[-1])
    return max(errors), max(untold)


def _faulty(number: int, made: Outcome) -> None:
    # Make a fault and note whether its effect was told
    rng = random.Random(f"time:{number}")
    kind = list(FAULTS)[number % len(FAULTS)]
    with tempfile.TemporaryDirectory() as scratch:
        whole, folder = Path(scratch) / "whole", Path(scratch) / "faulty"
        _simulate(whole, rng, cloudy=True)
        shutil.copytree(whole, folder)
        FAULTS[kind](folder, rng)
        expected, usual = _process(whole)
        made.count += 1
        try:
            found, heard = _process(folder)
        except PaintError:
            made.notes["errors"] += 1
            return
        except Exception as error:
            made.wrong.append(f"{kind} {number}: {type(error).__name__}: {error!s:.200}")
            return
    telling = _TELLING | (Quality.TIMING_SENSITIVE if kind in _OF_CLOCKS else 0)
    effect, untold = _effects(found, expected, telling)
    if effect <= LARGEST_EFFECT:
        made.notes["without effect"] += 1
    elif untold <= LARGEST_EFFECT:
        made.notes["flagged"] += 1
        if kind in _OF_CLOCKS and (expected.quality.values & np.uint16(telling)).any(axis=1).all():
            # the flag tells of a danger: light that changes, which it does without the fault as well
            made.notes["flagged without the fault, too"] += 1
    elif set(heard) - set(usual):
        made.notes["warned"] += 1
    else:
        made.wrong.append(f"{kind} {number}: reflectance wrong by {untold:.1%} without a word")


def _clean(number: int, made: Outcome) -> None:
    # Process a flight without any fault and note what is said all the same
    with tempfile.TemporaryDirectory() as scratch:
        _simulate(Path(scratch) / "whole", random.Random(f"clean:{number}"), cloudy=False)
        made.count += 1
        try:
            found, heard = _process(Path(scratch) / "whole")
        except Exception as error:
            made.wrong.append(f"clean {number}: {type(error).__name__}: {error!s:.200}")
            return
    flagged = (found.quality.values & np.uint16(_TELLING | Quality.TIMING_SENSITIVE)).any()
    if heard or flagged:
        made.wrong.append(f"clean {number}: {'flags' if flagged else heard[0]:.200}")


def _cloudy(number: int, made: Outcome) -> None:
    # Process a flight under clouds with known clocks; light that hardly changes meanwhile sets no flag
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "whole"
        rate = _simulate(folder, random.Random(f"cloudy:{number}"), cloudy=True, known_clock=_KNOWN_CLOCK)
        made.count += 1
        found, _ = _process(folder)
    flagged = (found.quality.values & np.uint16(Quality.TIMING_SENSITIVE)).any(axis=1).mean()
    made.notes["flagged"] += bool(flagged)
    if flagged and rate * _KNOWN_CLOCK < LARGEST_EFFECT / 1.2:
        made.wrong.append(f"cloudy {number}: {flagged:.0%} of the lines flagged at {rate:.1%} a second")


def run_part(clean: bool, numbers: range) -> list[Outcome]:
    # Fly ``numbers``; one outcome a kind of fault
    made: dict[str, Outcome] = {}
    for number in numbers:
        kind = "clean flights" if clean else list(FAULTS)[number % len(FAULTS)]
        outcome = made.setdefault(kind, Outcome(f"time: {kind}", allowed=FALSE_ALARMS if clean else 0))
        (_clean if clean else _faulty)(number, outcome)
        if clean and number % _CLOUDY_SHARE == 0:
            title = f"time: clouds, clock known to {_KNOWN_CLOCK:g} s"
            _cloudy(number, made.setdefault("cloudy", Outcome(title)))
    return list(made.values())


def _run(part: tuple[bool, range]) -> list[Outcome]:
    return run_part(*part)


def campaign(scale: float = 1.0, *, first: int = 0) -> Iterator[Outcome]:
    # Yield the outcomes of every part
    yield from in_parallel(
        _run,
        [
            (clean, part)
            for clean, full in ((False, FAULTY), (True, CLEAN))
            for part in parts_of(numbers_of(full, scale, first), _PART)
        ],
    )
