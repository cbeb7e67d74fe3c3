"""Clocks: GPS time, leap seconds, corrections, and a clock tied to UTC at knots.

Only corrections that the caller asks for are applied.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import FormatError, Problems, TimeError, warn_user
from hyperpaint.base.facts import one_of
from hyperpaint.io.files.reading import number
from hyperpaint.io.files.text_tables import Table, name_rows, read_table, read_text, to_integers
from hyperpaint.io.flightline.headwall import FrameIndex, check_increasing, time_of_day

#: GPS time minus UTC [s], valid from 0 h UTC of a day on (IERS ``leap-seconds.list``: TAI - UTC - 19 s).
LEAP_SECONDS: Mapping[str, int] = {
    "1980-01-06": 0, "1981-07-01": 1, "1982-07-01": 2, "1983-07-01": 3, "1985-07-01": 4, "1988-01-01": 5,
    "1990-01-01": 6, "1991-01-01": 7, "1992-07-01": 8, "1993-07-01": 9, "1994-07-01": 10, "1996-01-01": 11,
    "1997-07-01": 12, "1999-01-01": 13, "2006-01-01": 14, "2009-01-01": 15, "2012-07-01": 16,
    "2015-07-01": 17, "2017-01-01": 18,
}  # fmt: skip

#: Last day for which `LEAP_SECONDS` is valid (IERS); later times get the last value, with a warning.
LEAP_SECONDS_EXPIRY = "2026-06-28"

#: NaT of a datetime64 as an integer.
NAT = np.iinfo(np.int64).min

NS_PER_S = 1_000_000_000
WEEK_S = 604_800
#: Beginning of GPS time [ns since 1970-01-01].
GPS_EPOCH: int = np.datetime64("1980-01-06", "ns").astype(np.int64).item()
_NS_PER_US = 1000
_DATE = re.compile(r"[0-9]{4}-[0-9]{2}-[0-9]{2}")
_MAX_OFFSET_S = 1e9
_DAY_US = 86_400_000_000
_MIN_CLOCK_STEP_NS = 200 * 1_000_000  # larger than the drift of any clock between two rows


def gps_to_utc(gps: NDArray[np.int64], leap_seconds: int | None = None) -> NDArray[np.int64]:
    """Convert GPS time to UTC.

    gps: Nanoseconds since 1970-01-01 as a GPS clock shows them, any shape.
    leap_seconds: GPS minus UTC [s]; by default from `LEAP_SECONDS`.
    Warns PaintWarning: Times beyond `LEAP_SECONDS_EXPIRY`, ``leap_seconds`` not given.
    Raises TimeError: Times before the beginning of GPS time.

    Examples
    --------
    >>> shown = np.array(["2024-06-01T12:00:18"], "datetime64[ns]").astype("int64")
    >>> gps_to_utc(shown).astype("datetime64[ns]").astype("datetime64[s]")
    array(['2024-06-01T12:00:00'], dtype='datetime64[s]')
    """
    if leap_seconds is not None:
        return gps - leap_seconds * NS_PER_S
    offsets = np.array(list(LEAP_SECONDS.values()), np.int64)
    days = np.array(list(LEAP_SECONDS), "datetime64[ns]").astype(np.int64)
    number = np.searchsorted(days + offsets * NS_PER_S, gps, side="right") - 1
    TimeError.raise_if(
        np.any(number < 0),
        "times before 1980-01-06, the beginning of GPS time",
        mend="check that this clock counts GPS time",
        code="time-before-gps",
    )
    if np.any(gps > np.datetime64(LEAP_SECONDS_EXPIRY, "ns").astype(np.int64)):
        warn_user(
            f"the table of leap seconds ends on {LEAP_SECONDS_EXPIRY}; {offsets[-1]} s is used for "
            "later times; check this value, and pass gps_leap_seconds",
            "leap-seconds-expired",
        )
    utc: NDArray[np.int64] = gps - offsets[number] * NS_PER_S
    return utc


def nanoseconds(seconds: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return seconds, finite and below 1e10, as whole nanoseconds without loss of digits."""
    whole_seconds = np.floor(seconds)
    whole_ns: NDArray[np.int64] = whole_seconds.astype(np.int64) * NS_PER_S
    return whole_ns + np.round((seconds - whole_seconds) * NS_PER_S).astype(np.int64)


def unwrap_weeks(stamp: NDArray[np.int64]) -> NDArray[np.int64]:
    # Return nanoseconds of the GPS week that continue to increase in the next week.
    is_new_week = np.diff(stamp) < -(WEEK_S // 2) * NS_PER_S
    weeks = np.concatenate([np.zeros(1, np.int64), np.cumsum(is_new_week, dtype=np.int64)])
    unwrapped: NDArray[np.int64] = stamp + weeks * (WEEK_S * NS_PER_S)
    return unwrapped


def instants(texts: Sequence[str]) -> NDArray[np.datetime64]:
    # Return texts such as ``2024-06-01T12:00:00.5`` as times [ns]; NaT for dates that do not exist.
    try:
        return np.array(texts, "datetime64[ns]")
    except ValueError:  # the 31st of a shorter month, the 25th hour
        times = np.full(len(texts), np.datetime64("NaT", "ns"))
        for number, text in enumerate(texts):
            with contextlib.suppress(ValueError):
                times[number] = np.datetime64(text, "ns")
        return times


def midnight_of(date: object) -> int | None:
    # Return nanoseconds from 1970 to 0 h of a date such as 2024-06-01; None where it is no date in GPS time.
    text = str(date)
    if not _DATE.fullmatch(text) or not "1980-01-06" <= text < "2199-12-25":
        return None
    midnight = instants([text])[0]
    return None if np.isnat(midnight) else int(midnight.astype(np.int64))


def refuse_backwards(
    name: str, stamp: NDArray[np.int64], rows: NDArray[np.int64] | None = None, row: str = "line"
) -> None:
    # Refuse a record whose time runs backwards.
    # rows: Numbers of the record's rows in the file, by default from 1 on.
    # Raises TimeError: Time runs backwards; the rows are listed.
    backward_rows = np.flatnonzero(np.diff(stamp) < 0) + 1
    if backward_rows.size:
        row_numbers = backward_rows + 1 if rows is None else rows[backward_rows]
        raise TimeError(
            f"{name}: time runs backwards in {name_rows(row_numbers, row)}",
            mend="delete or reorder these rows",
            code="time-unordered",
        )


@dataclass(frozen=True)
class ClockCorrection:
    """Conversion of the time stamps of a navigation record to UTC."""

    offset_s: float = 0.0  # [s], UTC = stamp + ``offset_s``
    # Time scale of the stamps; from ``"gps"``, leap seconds are subtracted
    time_scale: Literal["utc", "gps"] = "utc"
    leap_seconds: int | None = None  # GPS minus UTC [s]; None takes it from `LEAP_SECONDS`

    def __post_init__(self) -> None:
        TimeError.raise_if(
            not abs(self.offset_s) <= _MAX_OFFSET_S,
            f"clock offset {self.offset_s} s",
            expected=f"-{_MAX_OFFSET_S:g} to {_MAX_OFFSET_S:g} s",
            code="value-out-of-range",
        )
        one_of(self.time_scale, ("utc", "gps"), "time_scale", error=TimeError)

    def apply(self, stamp: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return UTC in nanoseconds since 1970-01-01."""
        if self.time_scale == "gps":
            stamp = gps_to_utc(stamp, self.leap_seconds)
        return stamp + round(self.offset_s * NS_PER_S)


@dataclass(frozen=True)
class Clock:
    """Relation of a clock to UTC, which is interpolated linearly between knots."""

    stamp: NDArray[np.int64]  # microseconds of the clock, strictly increasing, (knot,)
    utc: NDArray[np.int64]  # nanoseconds since 1970-01-01, strictly increasing, (knot,)
    source: str  # file and column of the knots, for messages
    daily: bool = False  # whether stamps are times of day, so that they may be a day early or late

    def at(self, stamp: NDArray[np.int64]) -> NDArray[np.datetime64]:
        """Return UTC [datetime64[ns]] at stamps, NaT before the first and after the last knot."""
        if self.daily:
            stamp = stamp + next((d for d in (0, _DAY_US, -_DAY_US) if overlap(stamp + d, self.stamp)), 0)
        knot, weight, is_inside = bracket(self.stamp, stamp)
        utc = self.utc[knot] + np.round(
            weight * (self.utc[np.minimum(knot + 1, len(self.utc) - 1)] - self.utc[knot]).astype(np.float64)
        ).astype(np.int64)
        return np.where(is_inside, utc, NAT).astype("datetime64[ns]")


def overlap(first: NDArray[np.int64], second: NDArray[np.int64]) -> bool:
    """Return whether the ranges of two arrays overlap."""
    return bool(first.min() <= second.max() and first.max() >= second.min())


def bracket(
    knots: NDArray[np.int64], times: NDArray[np.int64]
) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.bool_]]:
    # Return the knot before each time, the weight of the next knot, and whether the time is in the range.
    is_inside = (times >= knots[0]) & (times <= knots[-1])
    knot = np.clip(np.searchsorted(knots, times, side="right") - 1, 0, max(len(knots) - 2, 0))
    # subtract in int64, since float64 resolves absolute times to 100 ns only
    knot_interval = np.maximum(knots[np.minimum(knot + 1, len(knots) - 1)] - knots[knot], 1)
    return knot, np.where(is_inside, times - knots[knot], 0) / knot_interval, is_inside


def tie_clock(
    stamp: NDArray[np.int64],
    utc: NDArray[np.int64],
    rows: NDArray[np.int64],
    source: str,
    *,
    daily: bool = False,
) -> Clock:
    # Return a clock from rows of stamps and UTC, after a check that both run at the same rate.
    check_increasing(stamp, rows, source)
    refuse_backwards(f"{source}, UTC", utc, rows)
    # a receiver that is slower than the log repeats its time; only the first row of each time is used
    is_first = np.concatenate([[True], np.diff(utc) > 0])
    stamp, utc, rows = stamp[is_first], utc[is_first], rows[is_first]
    drift = np.diff(utc).astype(np.float64) - np.diff(stamp).astype(np.float64) * _NS_PER_US
    steps = np.flatnonzero(np.abs(drift) > _MIN_CLOCK_STEP_NS)
    if steps.size:
        raise TimeError(
            (
                f"{source}: UTC jumps by {drift[steps[0]] / NS_PER_S:+.3f} s relative to the clock of the "
                f"stamps in {name_rows(rows[steps + 1])} (the receiver applied leap seconds?)"
            ),
            mend="split the record there",
            code="clock-step",
        )
    return Clock(stamp, utc, source, daily)


# --- navigation records: position, attitude, and clocks of the camera --------------------------------------


_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_DATE_TIME = re.compile(
    r"([0-9]{4})[-/]([0-9]{1,2}|[A-Za-z]{3})[-/]([0-9]{1,2})[ T]+"
    r"([0-9]{1,2}):([0-9]{2}):([0-9]{2})(?:\.([0-9]{1,9}))?Z?"
)
#: Name of a variable and its largest magnitude, by its column in ``imu_gps.txt``.
_COLUMNS = {
    "lat": ("latitude", 90.0),
    "lon": ("longitude", 360.0),
    "alt": ("altitude", 1e5),
    "roll": ("roll", 360.0),
    "pitch": ("pitch", 360.0),
    "yaw": ("heading", 360.0),
}
#: Largest magnitude of positions and angles [degree, m].
LIMITS = dict(_COLUMNS.values())
#: ``latitude longitude altitude roll pitch heading``.
POSE = tuple(LIMITS)
#: Fields of the convention of ``imu_gps.txt`` that its maker has not published.
ASSUMED = (
    *("roll_positive", "pitch_positive", "heading_positive", "heading_reference"),
    *("angle_unit", "euler_order", "height_reference"),
)
ANGLES = ("roll", "pitch", "heading")
_CLOCK_COLUMNS = ("timestamp", "systemtime", "gps_utc")
_UTC_COLUMN = "gps_utc_date&time"


@dataclass(frozen=True)
class PoseRecord:
    # Content of one navigation file of any format.

    name: str  # file name, for messages
    format: str  # name of the format
    stamp: NDArray[np.int64]  # nanoseconds, (row,)
    # Origin of the stamps: 1970-01-01, or the start of a GPS week
    counts_from: Literal["1970", "week"]
    # `POSE` (row,), float64: latitude and longitude [degree], altitude [m], angles in the unit of the
    # convention; NaN where unknown
    values: Mapping[str, NDArray[np.float64]] = field(repr=False)
    convention: Convention  # of the format or the file
    assumed: tuple[str, ...] = ()  # fields of the convention that are not published
    time_scale: Literal["gps", "utc"] = "gps"  # of the stamps, unless the caller states another
    week: int | None = None  # GPS week that the file states
    leap_seconds: int | None = None  # GPS minus UTC [s] that the file states
    # Further columns (row,) with their attributes
    others: Mapping[str, tuple[NDArray[Any], Mapping[str, str]]] = field(default_factory=dict, repr=False)
    attrs: Mapping[str, Any] = field(default_factory=dict)  # further attributes of the dataset


def check_poses(
    values: Mapping[str, NDArray[np.float64]],
    unit: str,
    problems: Problems,
    row: str,
    rows: NDArray[np.int64],
) -> None:
    # Note positions and angles that are out of range; NaN is accepted.
    # values: `POSE`: latitude and longitude [degree], altitude [m].
    # unit: Unit of roll, pitch and heading: ``"degree"`` or ``"radian"``.
    # problems: Receives the faults.
    # row, rows: Name of a row of the file in messages, and the numbers of the rows.
    for name, limit in LIMITS.items():
        # heading minus wander angle may exceed a full turn
        maximum = limit if name not in ANGLES else 1.25 * (2.0 * np.pi if unit == "radian" else limit)
        with np.errstate(invalid="ignore"):
            is_invalid = ~(np.abs(values[name]) <= maximum) & ~np.isnan(values[name])
        if is_invalid.any():
            problems.add(
                f"{name} is {values[name][is_invalid][0]:g} in {name_rows(rows[is_invalid], row)}",
                expected=f"within +-{maximum:.4g}",
                code="value-out-of-range",
            )


# --- imu_gps.txt -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Navigation:
    """Content of one ``imu_gps.txt``."""

    name: str  # file name, for messages
    rows: NDArray[np.int64]  # line number in the file of each row
    # Microseconds (row,) by the name of the clock's column in lower case; ``"time of day"`` counts from
    # midnight of the first row's day
    stamps: Mapping[str, NDArray[np.int64]]
    # UTC [ns since 1970-01-01] (row,); None if the file contains no date
    utc: NDArray[np.int64] | None
    # `POSE` (row,) [degree, m]; NaN if unknown
    values: Mapping[str, NDArray[np.float64]] = field(repr=False)

    def clock_for(self, index: FrameIndex) -> Clock:
        """Return the relation of the frame index's clock to UTC.

        Raises TimeError: The record contains no UTC or no such clock, its stamps repeat or run backwards, one
            of its clocks jumps relative to the other, or it does not overlap the frame index.
        """
        clock_columns = _CLOCK_COLUMNS if index.clock == "instrument" else ("time of day",)
        uncovered_spans: list[str] = []
        for column in clock_columns:
            stamp = self.stamps.get(column)
            if stamp is None or self.utc is None:
                continue
            daily = column == "time of day"
            if not daily and not overlap(index.stamp, stamp):
                uncovered_spans.append(f"{column} {stamp.min()} to {stamp.max()}")
                continue
            return tie_clock(stamp, self.utc, self.rows, f"{self.name}: {column}", daily=daily)
        contents_text = (
            "; ".join(uncovered_spans)
            or f"columns {sorted(self.stamps)}, {'no ' if self.utc is None else ''}UTC"
        )
        raise TimeError(
            (
                f"{index.name} counts {index.clock} {index.stamp[0]} to {index.stamp[-1]} us, which "
                f"{self.name} does not cover ({contents_text})"
            ),
            mend="pass the navigation of this flight, or gps_time or date",
            code="time-uncovered",
        )

    def dated_by(self, clock: Clock) -> Navigation:
        """Return the record with UTC from a clock of the recording computer; drop rows outside its range."""
        stamp = self.stamps.get("time of day")
        if self.utc is not None or stamp is None:
            return self
        check_increasing(stamp, self.rows, f"{self.name}: column 'time'")
        utc = clock.at(stamp).astype(np.int64)
        return replace(self, utc=utc)._of_rows(utc != NAT)

    def _of_rows(self, keep: NDArray[np.bool_]) -> Navigation:
        stamps = {name: stamp[keep] for name, stamp in self.stamps.items()}
        values = {name: value[keep] for name, value in self.values.items()}
        utc = None if self.utc is None else self.utc[keep]
        return Navigation(self.name, self.rows[keep], stamps, utc, values)

    def at(
        self, time: NDArray[np.datetime64], max_gap_s: float | None = None
    ) -> dict[str, NDArray[np.float64]]:
        """Return position and attitude at times, linear between rows.

        time: UTC [datetime64[ns]], NaT allowed, (along_track,).
        max_gap_s: Longest interval [s] that is interpolated; by default 2.5 times the median interval, at
            least 0.1 s.
        Returns dict of (along_track,) float64: By the names of `values`; NaN in gaps, outside the record and
            at NaT.
        Raises TimeError: The record contains no UTC, or UTC runs backwards.
        """
        if self.utc is None:
            raise TimeError(
                f"{self.name} contains no UTC",
                mend="pass gps_time, or date and clock_offset_s",
                code="time-missing",
            )
        refuse_backwards(self.name, self.utc, self.rows)
        is_new_time = np.concatenate([[True], np.diff(self.utc) > 0])
        knots = self.utc[is_new_time]
        knot, weight_after, is_inside = bracket(knots, time.astype("datetime64[ns]").astype(np.int64))
        next_knot = np.minimum(knot + 1, len(knots) - 1)
        steps = np.diff(knots) / NS_PER_S
        gap = max_gap_s or max(2.5 * float(np.median(steps)) if steps.size else 0.0, 0.1)
        is_covered = is_inside & ((knots[next_knot] - knots[knot]) / NS_PER_S <= gap)
        poses: dict[str, NDArray[np.float64]] = {}
        for name, value in self.values.items():
            value_before = value[is_new_time][knot]
            difference = value[is_new_time][next_knot] - value_before
            if name in ("heading", "longitude"):
                difference = (difference + 180.0) % 360.0 - 180.0  # the shorter way round
            pose = value_before + weight_after * difference
            if name == "heading":
                pose %= 360.0
            elif name == "longitude":
                pose = (pose + 180.0) % 360.0 - 180.0
            poses[name] = np.where(is_covered, pose, np.nan)
        return poses


def read_imu_gps(path: str | Path, correction: ClockCorrection | None = None) -> Navigation:
    """Read ``imu_gps.txt`` of any of its three generations.

    All have ``Roll Pitch Yaw Lat Lon Alt`` [degree, m]; the clock is ``Timestamp`` in microseconds with
    ``Gps_UTC_Date&Time``, or ``Time`` of the recording computer, or ``SystemTime`` and ``GPS_UTC`` with a
    date whose month is a word. ``heading`` is ``Yaw``, which belongs to roll and pitch; the meaning of the
    column ``Heading`` is not published. Rows before the inertial system has aligned (``Roll`` exactly 0) have
    no attitude, and are dropped if their date disagrees with the other rows.

    correction: Conversion of ``Gps_UTC_Date&Time`` to UTC; by default it is UTC.
    Raises FormatError: The file is binary (some systems write another log under this name), lacks columns, or
        contains cells that are not numbers, angles or dates.
    """
    table = read_table(path, "navigation record", needs=list(_COLUMNS))
    problems = Problems(f"{path} cannot be used as navigation", FormatError)
    values = {name: limited_numbers(table, key, limit, problems) for key, (name, limit) in _COLUMNS.items()}
    problems.raise_if_any()
    is_unaligned = np.cumsum(values["roll"] != 0.0) == 0
    has_no_position = (values["latitude"] == 0.0) & (values["longitude"] == 0.0)
    for name in ANGLES:
        values[name][is_unaligned] = np.nan
    for name in ("latitude", "longitude", "altitude"):
        values[name][has_no_position] = np.nan
    utc = _dates(table, _UTC_COLUMN, is_unaligned) if _UTC_COLUMN in table.columns else None
    stamps: dict[str, NDArray[np.int64]] = {}
    for column in _CLOCK_COLUMNS:
        if column not in table.columns:
            continue
        try:
            stamps[column] = to_integers(table, column)
        except FormatError:
            if column == "timestamp":
                raise
            # SystemTime or GPS_UTC may be in another unit than microseconds, and is then ignored
    if "time" in table.columns:
        stamps["time of day"] = time_of_day(table, "time")[0]
    record = Navigation(table.name, table.rows, stamps, utc=None, values=values)
    if is_unaligned.all():
        message = f"{path}: Roll is 0 throughout, the inertial system never aligned: no attitude"
        warn_user(message, "attitude-missing")
    if utc is None:
        return record
    # the date of an unaligned row must agree with the aligned rows
    keep: NDArray[np.bool_] = np.not_equal(utc, NAT)
    is_aligned = keep & ~is_unaligned
    if record.stamps and is_aligned.any():
        offset = utc / 1e9 - next(iter(record.stamps.values())) / 1e6
        keep &= (np.abs(offset - np.median(offset[is_aligned])) < 1.0) | ~is_unaligned
    FormatError.raise_if(not keep.any(), f"{path}: no row with a date", code="date-missing")
    return replace(
        record, utc=(correction or ClockCorrection()).apply(np.where(keep, utc, utc[keep][0]))
    )._of_rows(keep)


def limited_numbers(
    table: Table, column: str, limit: float, problems: Problems, empty: str = "-"
) -> NDArray[np.float64]:
    # Return a column of numbers or NaN; note other cells, and values beyond the limit.
    # empty: Text to parse in place of an empty cell.
    cells = [cell if cell.strip() else empty for cell in table.columns[column]]
    try:
        numbers = np.array(list(map(float, cells)))
    except ValueError:
        numbers = np.array([np.inf if (value := number(cell)) is None else value for cell in cells])
    if "_" in "".join(cells):  # float() would accept 1_000
        numbers[["_" in cell for cell in cells]] = np.inf
    invalid_rows = table.rows[np.abs(numbers) > limit]
    problems.add_if(
        invalid_rows.size,
        f"column {column!r} is not a number within {limit:g} in {name_rows(invalid_rows)}",
        code="value-out-of-range",
    )
    return numbers


def _dates(table: Table, column: str, is_unaligned: NDArray[np.bool_]) -> NDArray[np.int64]:
    # Return nanoseconds since 1970-01-01; NaT for an unaligned row without a date.
    dates = instants([_iso_text(cell) for cell in table.columns[column]])
    invalid_rows = table.rows[np.isnat(dates) & ~is_unaligned]
    FormatError.raise_if(
        invalid_rows.size,
        f"{table.name}: column {column!r} is unreadable in {name_rows(invalid_rows)}",
        expected="times such as '2021/07/23 12:34:56.789'",
        code="time-unreadable",
    )
    return dates.astype(np.int64)


def _iso_text(cell: str) -> str:
    match = _DATE_TIME.fullmatch(cell.strip())
    if match is None:
        return "NaT"
    year, month, day, hour, minute, second, fraction = match.groups()
    # outside these years nanoseconds may overflow, or a receiver without a fix writes its epoch
    if not "1980" <= year < "2200":
        return "NaT"
    if not month.isdigit():
        if month.lower() not in _MONTHS:
            return "NaT"
        month = str(_MONTHS.index(month.lower()) + 1)
    return f"{year}-{month:0>2}-{day:0>2}T{hour:0>2}:{minute}:{second}.{fraction or '0'}"


# --- gps_time.txt ------------------------------------------------------------------------------------------


def read_gps_time(path: str | Path, correction: ClockCorrection | None = None) -> Clock:
    """Read ``gps_time.txt``, which relates the recording computer's time of day to the receiver's clock.

    path: Rows of ``HH:MM:SS <microseconds>``, a tab, date and time. A first line of other content is ignored
        as a header.
    correction: Conversion of the receiver's stamps to UTC; by default they are UTC.
    Raises FormatError: The file is binary, or rows are not such pairs.
    Raises TimeError: Stamps repeat or run backwards, or one clock jumps relative to the other.
    """
    path = Path(path)
    lines = [(number, line) for number, line in enumerate(read_text(path).split("\n"), 1) if line.strip()]
    if lines and _iso_text(lines[0][1].partition("\t")[2]) == "NaT":
        del lines[0]
    FormatError.raise_if(
        not lines, f"{path}: no rows of computer time, tab, receiver date and time", code="table-missing"
    )
    rows = np.array([number for number, _ in lines], np.int64)
    pairs = [line.split("\t") for _, line in lines]
    rows_without_tab = [int(row) for row, pair in zip(rows, pairs, strict=True) if len(pair) < 2]
    FormatError.raise_if(
        rows_without_tab,
        f"{path}: {name_rows(rows_without_tab)} without a tab between computer time and receiver time",
        code="row-unreadable",
    )
    columns = {name: [pair[k] for pair in pairs] for k, name in enumerate(("computer", "receiver"))}
    table = Table(path.name, rows, columns)
    utc = _dates(table, "receiver", np.zeros(len(rows), bool))
    utc = (correction or ClockCorrection()).apply(utc)
    return tie_clock(time_of_day(table, "computer")[0], utc, rows, path.name, daily=True)
