"""Navigation records: position, attitude, and clocks of the camera.

A reader of any format fills a `PoseRecord`, which `navigation_opening` turns into UTC and labels. Of the
files of Headwall, ``imu_gps.txt`` is read by its header names (three generations of the program), and
``gps_time.txt`` ties the recording computer's clock to the receiver's.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import FormatError, PaintWarning, Problems, TimeError
from hyperpaint.io.files.text_tables import Table, name_rows, read_table, read_text, to_integers
from hyperpaint.io.flightline.headwall import FrameIndex, check_increasing, time_of_day

from .clocks import (
    NAT,
    NS_PER_S,
    Clock,
    ClockCorrection,
    bracket,
    instants,
    overlap,
    refuse_backwards,
    tie_clock,
)

_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_DATE_TIME = re.compile(
    r"([0-9]{4})[-/]([0-9]{1,2}|[A-Za-z]{3})[-/]([0-9]{1,2})[ T]+"
    r"([0-9]{1,2}):([0-9]{2}):([0-9]{2})(?:\.([0-9]{1,9}))?Z?"
)
#: Name in the file to name in a flight line, and largest possible magnitude.
_COLUMNS = {
    "lat": ("latitude", 90.0),
    "lon": ("longitude", 360.0),
    "alt": ("altitude", 1e5),
    "roll": ("roll", 360.0),
    "pitch": ("pitch", 360.0),
    "yaw": ("heading", 360.0),
}
#: Largest possible magnitude of positions and angles [degree, m].
LIMITS = dict(_COLUMNS.values())
#: ``latitude longitude altitude roll pitch heading``.
POSE = tuple(LIMITS)
#: Fields of the convention of ``imu_gps.txt`` on which no statement of its maker is public.
ASSUMED = (
    *("roll_positive", "pitch_positive", "heading_positive", "heading_reference"),
    *("angle_unit", "euler_order", "height_reference"),
)
_ATTITUDE = ("roll", "pitch", "heading")
_CLOCK_COLUMNS = ("timestamp", "systemtime", "gps_utc")
_UTC_COLUMN = "gps_utc_date&time"


@dataclass(frozen=True)
class PoseRecord:
    """One navigation file."""

    name: str  # file name, for messages
    format: str  # name of the format
    stamp: NDArray[np.int64]  # nanoseconds, (row,)
    # ``"1970"``, as the clock shows it; or the start of a GPS ``"week"``
    counts_from: Literal["1970", "week"]
    # `POSE` (row,), float64: latitude and longitude [degree], altitude [m], angles in the unit of the
    # convention; NaN where unknown
    values: Mapping[str, NDArray[np.float64]] = field(repr=False)
    convention: Convention  # meaning of the numbers, by the format or the file
    assumed: tuple[str, ...] = ()  # fields of the convention that nothing published states
    time_scale: Literal["gps", "utc"] = "gps"  # time scale of the stamps, unless the caller gives another
    week: int | None = None  # from the file itself
    leap_seconds: int | None = None
    # Further columns (row,) with their attributes
    others: Mapping[str, tuple[NDArray[Any], Mapping[str, str]]] = field(default_factory=dict, repr=False)
    attrs: Mapping[str, Any] = field(default_factory=dict)  # anything else that is to be kept


def check_poses(values: Mapping[str, NDArray[np.float64]], unit: str, problems: Problems, row: str) -> None:
    """Note positions and angles out of range; NaN is allowed.

    values: `POSE`: latitude and longitude [degree], altitude [m].
    unit: Of roll, pitch and heading: ``"degree"`` or ``"radian"``.
    problems: Takes the faults.
    row: Name of a row of the file in messages.
    """
    for name, limit in LIMITS.items():
        # a heading less an angle of wander may pass a full turn
        maximum = 2.0 * np.pi * 1.25 if name in _ATTITUDE and unit == "radian" else limit * 1.25
        maximum = limit if name not in _ATTITUDE else maximum
        with np.errstate(invalid="ignore"):
            wrong = np.flatnonzero(~(np.abs(values[name]) <= maximum) & ~np.isnan(values[name]))
        if wrong.size:
            where = name_rows(wrong + 1, row)
            problems.add(
                f"{name} is {values[name][wrong[0]]:g} in {where}",
                expected=f"within +-{maximum:.4g}",
                code="value-out-of-range",
            )


def check_seconds(name: str, seconds: NDArray[np.float64], most: float, problems: Problems, row: str) -> None:
    """Note times that are not finite, negative, or beyond ``most`` seconds."""
    wrong = np.flatnonzero(~((seconds >= 0.0) & (seconds <= most)))
    if wrong.size:
        problems.add(
            f"time is {seconds[wrong[0]]:g} s in {name_rows(wrong + 1, row)}",
            expected=f"0 to {most:g} s",
            mend=f"check that {name} is of this format",
            code="value-out-of-range",
        )


# --- imu_gps.txt -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Navigation:
    """One navigation record."""

    name: str  # file name, for messages
    rows: NDArray[np.int64]  # line of the file of each row
    # Clock column (lower case) to microseconds, (row,); ``"time of day"`` counts from midnight of the first
    # row's day
    stamps: Mapping[str, NDArray[np.int64]]
    # UTC, nanoseconds since 1970-01-01, (row,); None where the file holds no date
    utc: NDArray[np.int64] | None
    # ``latitude longitude altitude roll pitch heading`` [degree, m], (row,); NaN where unknown
    values: Mapping[str, NDArray[np.float64]] = field(repr=False)

    def clock_for(self, index: FrameIndex) -> Clock:
        """Return the clock of the frame index, tied to UTC by this record.

        Raises TimeError: The record holds no UTC or no such clock, its stamps repeat or run backwards, its
            clocks step against each other, or it does not overlap the frame index.
        """
        wanted = _CLOCK_COLUMNS if index.clock == "instrument" else ("time of day",)
        spans: list[str] = []
        for column in wanted:
            stamp = self.stamps.get(column)
            if stamp is None or self.utc is None:
                continue
            daily = column == "time of day"
            if not daily and not overlap(index.stamp, stamp):
                spans.append(f"{column} {stamp.min()} to {stamp.max()}")
                continue
            return tie_clock(stamp, self.utc, self.rows, f"{self.name}: {column}", daily=daily)
        held = "; ".join(spans) or f"columns {sorted(self.stamps)}, {'no ' if self.utc is None else ''}UTC"
        raise TimeError(
            (
                f"{index.name} counts {index.clock} {index.stamp[0]} to {index.stamp[-1]} us, which "
                f"{self.name} does not cover ({held})"
            ),
            mend="give the navigation of this flight, or gps_time or date",
            code="time-uncovered",
        )

    def dated_by(self, clock: Clock) -> Navigation:
        """Return the record with UTC from a clock of the recording computer; rows outside are dropped."""
        stamp = self.stamps.get("time of day")
        if self.utc is not None or stamp is None:
            return self
        check_increasing(stamp, self.rows, f"{self.name}: column 'time'")
        utc = clock.at(stamp).astype(np.int64)
        return replace(self, utc=utc)._where(utc != NAT)

    def dated_at(self, midnight: int) -> Navigation:
        """Return the record with UTC from the recording computer's time of day.

        midnight: 0 h of the first row's day on that clock [ns since 1970-01-01].
        """
        stamp = self.stamps.get("time of day")
        return self if stamp is None else replace(self, utc=midnight + stamp * 1000)

    def _where(self, keep: NDArray[np.bool_]) -> Navigation:
        stamps = {name: stamp[keep] for name, stamp in self.stamps.items()}
        values = {name: value[keep] for name, value in self.values.items()}
        utc = None if self.utc is None else self.utc[keep]
        return Navigation(self.name, self.rows[keep], stamps, utc, values)

    def at(
        self, time: NDArray[np.datetime64], max_gap_s: float | None = None
    ) -> dict[str, NDArray[np.float64]]:
        """Return position and attitude at times, linear between rows.

        time: UTC [datetime64[ns]], NaT allowed, (along_track,).
        max_gap_s: Longest interval [s] that is interpolated; by default 2.5 times the median one, at least
            0.1 s.
        Returns dict of (along_track,) float64: The names of `values`; NaN in gaps, outside the record and at
            NaT.
        Raises TimeError: The record has no UTC, or it runs backwards.
        """
        if self.utc is None:
            raise TimeError(
                f"{self.name} holds no UTC",
                mend="give gps_time, or date and clock_offset_s",
                code="time-missing",
            )
        refuse_backwards(self.name, self.utc, self.rows)
        new = np.concatenate([[True], np.diff(self.utc) > 0])
        knots = self.utc[new]
        place, weight, inside = bracket(knots, time.astype("datetime64[ns]").astype(np.int64))
        after = np.minimum(place + 1, len(knots) - 1)
        steps = np.diff(knots) / NS_PER_S
        gap = max_gap_s or max(2.5 * float(np.median(steps)) if steps.size else 0.0, 0.1)
        covered = inside & ((knots[after] - knots[place]) / NS_PER_S <= gap)
        poses: dict[str, NDArray[np.float64]] = {}
        for name, value in self.values.items():
            before = value[new][place]
            step = value[new][after] - before
            if name in ("heading", "longitude"):
                step = (step + 180.0) % 360.0 - 180.0  # the short way round
            result = before + weight * step
            if name == "heading":
                result %= 360.0
            elif name == "longitude":
                result = (result + 180.0) % 360.0 - 180.0
            poses[name] = np.where(covered, result, np.nan)
        return poses


def read_imu_gps(path: str | Path, correction: ClockCorrection | None = None) -> Navigation:
    """Read ``imu_gps.txt`` of any of its three generations.

    All have ``Roll Pitch Yaw Lat Lon Alt`` [degree, m]; the clock is ``Timestamp`` in microseconds with
    ``Gps_UTC_Date&Time``, or ``Time`` of the recording computer, or ``SystemTime`` and ``GPS_UTC`` with a
    date that spells its month. ``heading`` is ``Yaw``, which belongs to roll and pitch; what the column
    ``Heading`` means is not published. Rows before the inertial system has aligned (``Roll`` exactly 0) have
    no attitude, and are dropped where their date does not agree with the others.

    correction: How ``Gps_UTC_Date&Time`` becomes UTC; by default it is UTC.
    Raises FormatError: Binary (some systems write another log under this name), without the columns, or cells
        that are not numbers, angles or dates.
    """
    table = read_table(path, "navigation record", needs=list(_COLUMNS))
    problems = Problems(f"{path} cannot be used as navigation", FormatError)
    values = {name: limited_numbers(table, key, limit, problems) for key, (name, limit) in _COLUMNS.items()}
    problems.raise_if_any()
    unaligned = np.cumsum(values["roll"] != 0.0) == 0
    nowhere = (values["latitude"] == 0.0) & (values["longitude"] == 0.0)
    for name in _ATTITUDE:
        values[name][unaligned] = np.nan
    for name in ("latitude", "longitude", "altitude"):
        values[name][nowhere] = np.nan
    utc = _dates(table, _UTC_COLUMN, unaligned) if _UTC_COLUMN in table.columns else None
    stamps: dict[str, NDArray[np.int64]] = {}
    for column in _CLOCK_COLUMNS:
        if column not in table.columns:
            continue
        try:
            stamps[column] = to_integers(table, column)
        except FormatError:
            if column == "timestamp":
                raise
            # of SystemTime and GPS_UTC either may be no count of microseconds
    if "time" in table.columns:
        stamps["time of day"] = time_of_day(table, "time")[0]
    record = Navigation(table.name, table.rows, stamps, utc=None, values=values)
    if unaligned.all():
        message = f"{path}: Roll is 0 throughout, the inertial system never aligned: no attitude"
        warnings.warn(PaintWarning(message, code="attitude-missing"), stacklevel=2)
    if utc is None:
        return record
    keep = _dated(utc, next(iter(record.stamps.values()), None), unaligned)
    if not keep.any():
        raise FormatError(f"{path}: no row with a date", code="date-missing")
    return replace(
        record, utc=(correction or ClockCorrection()).apply(np.where(keep, utc, utc[keep][0]))
    )._where(keep)


def limited_numbers(
    table: Table, column: str, limit: float, problems: Problems, empty: str = ""
) -> NDArray[np.float64]:
    """Return a column of numbers, NaN allowed; other cells and values beyond the limit are noted.

    empty: What an empty cell stands for, if for a number.
    """
    cells = [cell if cell.strip() else empty for cell in table.columns[column]]
    try:
        numbers = np.array(list(map(float, cells)))
    except ValueError:
        numbers = np.array([_number(cell) for cell in cells])
    if "_" in "".join(cells):  # 1_000 is a number to Python only
        numbers[["_" in cell for cell in cells]] = np.inf
    wrong = table.rows[np.abs(numbers) > limit]
    if wrong.size:
        problems.add(
            f"column {column!r} is not a number within {limit:g} in {name_rows(wrong)}",
            code="value-out-of-range",
        )
    return numbers


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return np.inf


def _dates(table: Table, column: str, unaligned: NDArray[np.bool_]) -> NDArray[np.int64]:
    # Nanoseconds since 1970-01-01; NaT where an unaligned row has no date.
    dates = instants([_iso(cell) for cell in table.columns[column]])
    wrong = table.rows[np.isnat(dates) & ~unaligned]
    if wrong.size:
        raise FormatError(
            f"{table.name}: column {column!r} is unreadable in {name_rows(wrong)}",
            expected="times such as '2021/07/23 12:34:56.789'",
            code="time-unreadable",
        )
    return dates.astype(np.int64)


def _iso(cell: str) -> str:
    match = _DATE_TIME.fullmatch(cell.strip())
    if match is None:
        return "NaT"
    year, month, day, hour, minute, second, fraction = match.groups()
    # beyond these years nanoseconds overflow, and a receiver without a fix shows its epoch
    if not "1980" <= year < "2200":
        return "NaT"
    if not month.isdigit():
        if month.lower() not in _MONTHS:
            return "NaT"
        month = str(_MONTHS.index(month.lower()) + 1)
    return f"{year}-{month:0>2}-{day:0>2}T{hour:0>2}:{minute}:{second}.{fraction or '0'}"


def _dated(
    utc: NDArray[np.int64], stamp: NDArray[np.int64] | None, unaligned: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    # Which rows have a date; an unaligned row needs one that agrees with the aligned rows.
    dated: NDArray[np.bool_] = np.not_equal(utc, NAT)
    aligned = dated & ~unaligned
    if stamp is None or not aligned.any():
        return dated
    offset = utc / 1e9 - stamp / 1e6
    has_date: NDArray[np.bool_] = dated & ((np.abs(offset - np.median(offset[aligned])) < 1.0) | ~unaligned)
    return has_date


# --- gps_time.txt ------------------------------------------------------------------------------------------


def read_gps_time(path: str | Path, correction: ClockCorrection | None = None) -> Clock:
    """Read ``gps_time.txt``, which ties the recording computer's time of day to the receiver's clock.

    path: The file: ``HH:MM:SS <microseconds>``, a tab, date and time. A first line that is neither is taken
        for a header.
    correction: How the receiver's stamps become UTC; by default they are UTC.
    Raises FormatError: Binary, or rows that are not such pairs.
    Raises TimeError: Stamps repeat or run backwards, or the two clocks step against each other.
    """
    path = Path(path)
    lines = [(number, line) for number, line in enumerate(read_text(path).split("\n"), 1) if line.strip()]
    if lines and _iso(lines[0][1].partition("\t")[2]) == "NaT":
        del lines[0]
    if not lines:
        raise FormatError(
            f"{path}: no rows of computer time, tab, receiver date and time", code="table-missing"
        )
    rows = np.array([number for number, _ in lines], np.int64)
    pairs = [line.split("\t") for _, line in lines]
    wrong = [int(row) for row, pair in zip(rows, pairs, strict=True) if len(pair) < 2]
    if wrong:
        raise FormatError(
            f"{path}: {name_rows(wrong)} without a tab between computer time and receiver time",
            code="row-unreadable",
        )
    table = Table(path.name, rows, {"pc": [pair[0] for pair in pairs], "pos": [pair[1] for pair in pairs]})
    utc = _dates(table, "pos", np.zeros(len(rows), bool))
    utc = (correction or ClockCorrection()).apply(utc)
    return tie_clock(time_of_day(table, "pc")[0], utc, rows, path.name, daily=True)
