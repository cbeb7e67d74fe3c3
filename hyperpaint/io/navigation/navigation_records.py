"""Navigation records of all formats (position, attitude, clocks of the camera), and conversion of clocks.

GPS time, leap seconds, corrections, and a clock tied to UTC at knots: only corrections that the caller asks
for are applied.

Each reader returns a `PoseRecord`, which `navigation_opening` converts to UTC and labels. Of the
files of Headwall, ``imu_gps.txt`` is read by its header names (three generations of the program), and
``gps_time.txt`` ties the recording computer's clock to the receiver's.

Applanix SBET: a smoothed best estimate of trajectory, post-processed by POSPac. The file consists of records
of 17 little-endian float64, so that only its size and values show whether it is an SBET file. Stamps are
seconds of a GPS week that the file does not contain (POSPac exports seconds of the UTC week on request:
``time_scale="utc"``).

Resonon ``.lcf``, the navigation of an airborne Pika, stored beside the cube: a table without a header, with
columns separated by blanks or tabs: time [s of GPS time], roll, pitch, heading [rad], longitude, latitude
[degree], altitude [m], and two unused ones. The vendor has published no description; the meaning of the
columns follows public readers whose authors asked the maker (massipipe, mi3nts). Roll is positive with the
right wing UP.

AVIRIS-NG ``ang<date>t<time>_eph_att``: an ENVI file. Each of its lines is a row of the record, each band a
column with the name in ``band names``.

A table of text has a header of names and units, and comments with the conventions. NMEA 0183 sentences are
found in a log among other text.

Navigation of any format as one dataset with UTC stamps and declared conventions. Ground control points are
last: surveyed coordinates, and the pixels where the points are visible.
"""

import contextlib
import datetime
import itertools
import os
import re
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import reduce
from importlib.util import find_spec
from operator import xor
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import xarray as xr

from hyperpaint.base import (
    ANGLES,
    NAVIGATION_TIME,
    Array,
    Bools,
    Convention,
    Findings,
    Floats,
    FormatError,
    Indices,
    Ints,
    Problem,
    Problems,
    SchemaError,
    TimeError,
    Times,
    UnitsError,
    as_path,
    conversion_factor,
    documented,
    fetch,
    grouped,
    input_path,
    is_number,
    is_plain_file,
    is_unit,
    needs_extra,
    one_of,
    open_input,
    same_dimension,
    takes_quantities,
    warn_if,
)
from hyperpaint.io.envi.envi_cubes import EnviHeader, find_pair, read_header
from hyperpaint.io.files.reading import (
    MAX_TABLE_ROWS,
    Table,
    cells_of,
    decoded_text,
    name_rows,
    number,
    numbered_lines,
    read_limited_text,
    read_table,
    read_text,
    table_of,
    to_integers,
)
from hyperpaint.io.flightline.side_files import DAY_US, FrameIndex, check_increasing, time_of_day
from hyperpaint.io.store import is_zarr, load_group

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
CLOCK_LIMITS = SimpleNamespace(
    ns_per_us=1000,
    max_offset_s=1e9,
    min_clock_step_ns=200 * 1_000_000,  # larger than the drift of any clock between two rows
)
_DATE = re.compile(r"[0-9]{4}-[0-9]{2}-[0-9]{2}")


def gps_to_utc(gps: Ints, leap_seconds: int | None = None) -> Ints:
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
    warn_if(
        np.any(gps > np.datetime64(LEAP_SECONDS_EXPIRY, "ns").astype(np.int64)),
        f"the table of leap seconds ends on {LEAP_SECONDS_EXPIRY}; {offsets[-1]} s is used for "
        "later times; check this value, and pass gps_leap_seconds",
        "leap-seconds-expired",
    )
    return np.asarray(gps - offsets[number] * NS_PER_S)


def nanoseconds(seconds: Floats) -> Ints:
    # Return seconds, finite and below 1e10, as whole nanoseconds without loss of digits.
    whole_seconds = np.floor(seconds)
    whole_ns: Ints = whole_seconds.astype(np.int64) * NS_PER_S
    return whole_ns + np.round((seconds - whole_seconds) * NS_PER_S).astype(np.int64)


def unwrap_weeks(stamp: Ints) -> Ints:
    # Return nanoseconds of the GPS week that continue to increase in the next week.
    is_new_week = np.diff(stamp) < -(WEEK_S // 2) * NS_PER_S
    weeks = np.concatenate([np.zeros(1, np.int64), np.cumsum(is_new_week, dtype=np.int64)])
    return np.asarray(stamp + weeks * (WEEK_S * NS_PER_S))


def instants(texts: Sequence[str]) -> Times:
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


def refuse_backwards(name: str, stamp: Ints, rows: Ints | None = None, row: str = "line") -> None:
    # Refuse a record whose time runs backwards.
    # rows: Numbers of the record's rows in the file, by default from 1 on.
    # Raises TimeError: Time runs backwards; the rows are listed.
    backward_rows = np.flatnonzero(np.diff(stamp) < 0) + 1
    row_numbers = backward_rows + 1 if rows is None else rows[backward_rows]
    TimeError.raise_if(
        row_numbers.size,
        f"{name}: time runs backwards in {name_rows(row_numbers, row)}",
        mend="delete or reorder these rows",
        code="time-unordered",
    )


def to_utc(
    stamp: Ints, offset_s: float, time_scale: Literal["gps", "utc"], leap_seconds: int | None = None
) -> Ints:
    # Return UTC [ns since 1970-01-01] of the time stamps of a navigation record, ``stamp`` + ``offset_s``.
    #
    # From stamps of the scale ``"gps"``, leap seconds are subtracted: GPS minus UTC [s], by default from
    # `LEAP_SECONDS`.
    utc = gps_to_utc(stamp, leap_seconds) if time_scale == "gps" else stamp
    return utc + round(offset_s * NS_PER_S)


@dataclass(frozen=True)
class Clock:
    # Relation of a clock to UTC, which is interpolated linearly between knots.
    stamp: Ints  # microseconds of the clock, strictly increasing, (knot,)
    utc: Ints  # nanoseconds since 1970-01-01, strictly increasing, (knot,)
    source: str  # file and column of the knots, for messages
    daily: bool = False  # whether stamps are times of day, so that they may be a day early or late

    def at(self, stamp: Ints) -> Times:
        # Return UTC [datetime64[ns]] at stamps, NaT before the first and after the last knot.
        if self.daily:
            stamp = stamp + next((d for d in (0, DAY_US, -DAY_US) if overlap(stamp + d, self.stamp)), 0)
        knot, weight, is_inside = bracket(self.stamp, stamp)
        utc = self.utc[knot] + np.round(
            weight * (self.utc[np.minimum(knot + 1, len(self.utc) - 1)] - self.utc[knot]).astype(np.float64)
        ).astype(np.int64)
        return np.where(is_inside, utc, NAT).astype("datetime64[ns]")


def overlap(first: Ints, second: Ints) -> bool:
    # Return whether the ranges of two arrays overlap.
    return bool(first.min() <= second.max() and first.max() >= second.min())


def bracket(knots: Ints, times: Ints) -> tuple[Indices, Floats, Bools]:
    # Return the knot before each time, the weight of the next knot, and whether the time is in the range.
    is_inside = (times >= knots[0]) & (times <= knots[-1])
    knot = np.clip(np.searchsorted(knots, times, side="right") - 1, 0, max(len(knots) - 2, 0))
    # subtract in int64, since float64 resolves absolute times to 100 ns only
    knot_interval = np.maximum(knots[np.minimum(knot + 1, len(knots) - 1)] - knots[knot], 1)
    return knot, np.where(is_inside, times - knots[knot], 0) / knot_interval, is_inside


def tie_clock(
    stamp: Ints,
    utc: Ints,
    rows: Ints,
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
    drift = np.diff(utc).astype(np.float64) - np.diff(stamp).astype(np.float64) * CLOCK_LIMITS.ns_per_us
    steps = np.flatnonzero(np.abs(drift) > CLOCK_LIMITS.min_clock_step_ns)
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


# --- poses -------------------------------------------------------------------------------------------------


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
#: Lowest altitude [m]: many records write -9999 for an unknown one.
MIN_ALTITUDE_M = -1000.0
#: ``latitude longitude altitude roll pitch heading``.
POSE = tuple(LIMITS)
#: Fields of the convention of ``imu_gps.txt`` that its maker has not published.
ASSUMED = (
    *("roll_positive", "pitch_positive", "heading_positive", "heading_reference"),
    *("angle_unit", "euler_order", "height_reference"),
)
_CLOCK_COLUMNS = ("timestamp", "systemtime", "gps_utc")
_UTC_COLUMN = "gps_utc_date&time"


@dataclass(frozen=True)
class PoseRecord:
    # Content of one navigation file of any format.

    name: str  # file name, for messages
    format: str  # name of the format
    stamp: Ints  # nanoseconds, (row,)
    # Origin of the stamps: 1970-01-01, or the start of a GPS week
    counts_from: Literal["1970", "week"]
    # `POSE` (row,), float64: latitude and longitude [degree], altitude [m], angles in the unit of the
    # convention; NaN where unknown
    values: Mapping[str, Floats] = field(repr=False)
    convention: Convention  # of the format or the file
    assumed: tuple[str, ...] = ()  # fields of the convention that are not published
    time_scale: Literal["gps", "utc"] = "gps"  # of the stamps, unless the caller states another
    week: int | None = None  # GPS week that the file states
    leap_seconds: int | None = None  # GPS minus UTC [s] that the file states
    # Further columns (row,) with their attributes
    others: Mapping[str, tuple[Array, Mapping[str, str]]] = field(default_factory=dict, repr=False)
    attrs: Mapping[str, Any] = field(default_factory=dict)  # further attributes of the dataset


def check_poses(
    values: Mapping[str, Floats],
    unit: str,
    problems: Problems,
    row: str,
    rows: Ints,
) -> None:
    # Note positions and angles that are out of range; NaN is accepted.
    # values: `POSE`: latitude and longitude [degree], altitude [m].
    # unit: Unit of roll, pitch and heading: ``"degree"`` or ``"radian"``.
    # problems: Receives the faults.
    # row, rows: Name of a row of the file in messages, and the numbers of the rows.
    for name, limit in LIMITS.items():
        # heading minus wander angle may exceed a full turn
        maximum = limit if name not in ANGLES else 1.25 * (2.0 * np.pi if unit == "radian" else limit)
        minimum = MIN_ALTITUDE_M if name == "altitude" else -maximum
        with np.errstate(invalid="ignore"):
            is_invalid = ~((values[name] >= minimum) & (values[name] <= maximum)) & ~np.isnan(values[name])
        if is_invalid.any():
            problems.add(
                f"{name} is {values[name][is_invalid][0]:g} in {name_rows(rows[is_invalid], row)}",
                expected=f"{minimum:.4g} to {maximum:.4g}, or empty where it is unknown",
                code="value-out-of-range",
            )


# --- imu_gps.txt -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Navigation:
    """Content of one ``imu_gps.txt``."""

    name: str  # file name, for messages
    rows: Ints  # line number in the file of each row
    # Microseconds (row,) by the name of the clock's column in lower case; ``"time of day"`` counts from
    # midnight of the first row's day
    stamps: Mapping[str, Ints]
    # UTC [ns since 1970-01-01] (row,); None if the file contains no date
    utc: Ints | None
    # `POSE` (row,) [degree, m]; NaN if unknown
    values: Mapping[str, Floats] = field(repr=False)

    def clock_for(self, index: FrameIndex) -> Clock:
        # Return the relation of the frame index's clock to UTC.
        #
        # Raises TimeError: The record contains no UTC or no such clock, its stamps repeat or run backwards,
        # one
        #     of its clocks jumps relative to the other, or it does not overlap the frame index.
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

    def dated_by(self, clock: Clock) -> "Navigation":
        # Return the record with UTC from a clock of the recording computer; drop rows outside its range.
        stamp = self.stamps.get("time of day")
        if self.utc is not None or stamp is None:
            return self
        check_increasing(stamp, self.rows, f"{self.name}: column 'time'")
        utc = clock.at(stamp).astype(np.int64)
        return replace(self, utc=utc)._of_rows(utc != NAT)

    def _of_rows(self, keep: Bools) -> "Navigation":
        stamps = {name: stamp[keep] for name, stamp in self.stamps.items()}
        values = {name: value[keep] for name, value in self.values.items()}
        utc = None if self.utc is None else self.utc[keep]
        return Navigation(self.name, self.rows[keep], stamps, utc, values)

    def at(self, time: Times, max_gap_s: float | None = None) -> dict[str, Floats]:
        # Return position and attitude at times, linear between rows.
        #
        # time: UTC [datetime64[ns]], NaT allowed, (along_track,).
        # max_gap_s: Longest interval [s] that is interpolated; by default 2.5 times the median interval, at
        #     least 0.1 s.
        # Returns dict of (along_track,) float64: By the names of `values`; NaN in gaps, outside the record
        # and
        #     at NaT.
        # Raises TimeError: The record contains no UTC, or UTC runs backwards.
        utc = TimeError.raise_if_none(
            self.utc,
            f"{self.name} contains no UTC",
            mend="pass gps_time, or date and clock_offset_s",
            code="time-missing",
        )
        refuse_backwards(self.name, utc, self.rows)
        is_new_time = np.concatenate([[True], np.diff(utc) > 0])
        knots = utc[is_new_time]
        knot, weight_after, is_inside = bracket(knots, time.astype("datetime64[ns]").astype(np.int64))
        next_knot = np.minimum(knot + 1, len(knots) - 1)
        steps = np.diff(knots) / NS_PER_S
        gap = max_gap_s or max(2.5 * float(np.median(steps)) if steps.size else 0.0, 0.1)
        is_covered = is_inside & ((knots[next_knot] - knots[knot]) / NS_PER_S <= gap)
        poses: dict[str, Floats] = {}
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


def read_imu_gps(path: str | Path, utc_of: Callable[[Ints], Ints] = np.asarray) -> Navigation:
    # Read ``imu_gps.txt`` of any of its three generations.
    #
    # All have ``Roll Pitch Yaw Lat Lon Alt`` [degree, m]; the clock is ``Timestamp`` in microseconds with
    # ``Gps_UTC_Date&Time``, or ``Time`` of the recording computer, or ``SystemTime`` and ``GPS_UTC`` with a
    # date whose month is a word. ``heading`` is ``Yaw``, which belongs to roll and pitch; the meaning of the
    # column ``Heading`` is not published. Rows before the inertial system has aligned (``Roll`` exactly 0)
    # have no attitude, and are dropped if their date disagrees with the other rows.
    #
    # utc_of: Conversion of ``Gps_UTC_Date&Time`` to UTC; by default it is UTC.
    # Raises FormatError: The file is binary (some systems write another log under this name), lacks columns,
    # or
    #     contains cells that are not numbers, angles or dates.
    table = read_table(path, "navigation record", needs=list(_COLUMNS))
    with Problems(f"{path} cannot be used as navigation", FormatError) as problems:
        values = {
            name: limited_numbers(table, key, limit, problems) for key, (name, limit) in _COLUMNS.items()
        }
    is_unaligned = np.cumsum(values["roll"] != 0.0) == 0
    # without a fix, or with -9999 for an unknown altitude
    has_no_position = (values["latitude"] == 0.0) & (values["longitude"] == 0.0) | (
        values["altitude"] < MIN_ALTITUDE_M
    )
    for name in ANGLES:
        values[name][is_unaligned] = np.nan
    for name in ("latitude", "longitude", "altitude"):
        values[name][has_no_position] = np.nan
    utc = _dates(table, _UTC_COLUMN, is_unaligned) if _UTC_COLUMN in table.columns else None
    stamps: dict[str, Ints] = {}
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
    warn_if(
        is_unaligned.all(),
        f"{path}: Roll is 0 throughout, the inertial system never aligned: no attitude",
        "attitude-missing",
    )
    if utc is None:
        return record
    # the date of an unaligned row must agree with the aligned rows
    keep: Bools = np.not_equal(utc, NAT)
    is_aligned = keep & ~is_unaligned
    if record.stamps and is_aligned.any():
        offset = utc / 1e9 - next(iter(record.stamps.values())) / 1e6
        keep &= (np.abs(offset - np.median(offset[is_aligned])) < 1.0) | ~is_unaligned
    FormatError.raise_if(not keep.any(), f"{path}: no row with a date", code="date-missing")
    return replace(record, utc=utc_of(np.where(keep, utc, utc[keep][0])))._of_rows(keep)


def limited_numbers(table: Table, column: str, limit: float, problems: Problems, empty: str = "-") -> Floats:
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
        mend="write decimal points" if "," in "".join(cells) else "",
        code="value-out-of-range",
    )
    return numbers


def _dates(table: Table, column: str, is_unaligned: Bools) -> Ints:
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


def read_gps_time(path: str | Path, utc_of: Callable[[Ints], Ints] = np.asarray) -> Clock:
    # Read ``gps_time.txt``, which relates the recording computer's time of day to the receiver's clock.
    #
    # path: Rows of ``HH:MM:SS <microseconds>``, a tab, date and time. A first line of other content is
    # ignored
    #     as a header.
    # utc_of: Conversion of the receiver's stamps to UTC; by default they are UTC.
    # Raises FormatError: The file is binary, or rows are not such pairs.
    # Raises TimeError: Stamps repeat or run backwards, or one clock jumps relative to the other.
    path = as_path(path)
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
    utc = utc_of(_dates(table, "receiver", np.zeros(len(rows), bool)))
    return tie_clock(time_of_day(table, "computer")[0], utc, rows, path.name, daily=True)


# --- tables of numbers: SBET, lcf, eph_att -----------------------------------------------------------------


_MAX_TEXT_BYTES = 2**28
_MAX_COLUMNS = _MAX_COMMENTS = 1000
#: Largest time [s], counted from 1970 or 1980: end of the 22nd century.
_MAX_TIME_S = 7e9
_WEEKS_S = 2.0 * WEEK_S


@dataclass(frozen=True)
class Dialect:
    # A format that is a table of numbers: its columns and their meaning.

    name: str  # name of the format
    content: str  # content of a file, for messages
    columns: Mapping[str, str]  # name of the variable by the column of the file
    convention: Convention  # conventions of the format
    assumed: tuple[str, ...] = ()  # fields of the convention that are not published
    row: str = "row"  # noun of a row, for messages
    max_bytes: int = 2**32
    max_seconds: float = _WEEKS_S  # seconds of the GPS week, or larger for seconds of GPS time
    #: Meaning of columns that are returned besides the variables [radian].
    others: Mapping[str, str] = field(default_factory=dict)


_SBET_COLUMNS = (
    *("time", "latitude", "longitude", "altitude", "x_velocity", "y_velocity", "z_velocity"),
    *("roll", "pitch", "platform_heading", "wander_angle"),
    *("x_acceleration", "y_acceleration", "z_acceleration", "x_rate", "y_rate", "z_rate"),
)
_SBET = Dialect(
    "Applanix SBET",
    "an SBET file of little-endian float64",
    {name: name for name in ("time", "latitude", "longitude", "altitude", "roll", "pitch", "heading")},
    Convention(angle_unit="radian"),
    row="record",
    others={
        "platform_heading": "Heading from the north of the wander frame",
        "wander_angle": "Platform heading less heading from true north",
    },
)
_LCF = Dialect(
    "Resonon lcf",
    "a Resonon .lcf file",
    {name: name for name in ("time", "roll", "pitch", "heading", "longitude", "latitude", "altitude")},
    Convention(roll_positive="right_wing_up", angle_unit="radian"),
    assumed=("euler_order",),
    row="line",
    max_bytes=_MAX_TEXT_BYTES,
    max_seconds=_MAX_TIME_S,
)
_MAX_LCF_CELLS = 64
_EPH_ATT = Dialect(
    "AVIRIS-NG eph_att",
    "navigation",
    {
        "gpstime": "time",
        "lat": "latitude",
        "lon": "longitude",
        "alt": "altitude",
        "pitch": "pitch",
        "roll": "roll",
        "heading": "heading",
    },
    Convention(),
    assumed=("roll_positive", "pitch_positive", "euler_order", "height_reference"),
)
_EPH_ATT_START = re.compile(r"ang([0-9]{8})t([0-9]{6})", re.IGNORECASE)
_MAX_START_DIFFERENCE_S = 3600


def read_sbet(path: str | Path) -> PoseRecord:
    # Read an SBET file.
    #
    # The north of the wander frame rotates relative to true north as the aircraft travels: ``heading`` is the
    # platform heading minus the wander angle, both of which are also returned. (In the two records of PDAL's
    # sample, velocities are along the axes of the wander frame; with this sign they agree with the
    # displacement.)
    #
    # Returns PoseRecord: Roll, pitch and heading [rad]: right wing down, nose up, clockwise from true north;
    #     heights above the ellipsoid.
    # Raises FormatError: The file does not consist of records, or values are out of range; all are listed.
    # Raises TimeError: Time runs backwards.
    path, layout = Path(path), np.dtype([(name, "<f8") for name in _SBET_COLUMNS])
    with open_input(path, "an SBET file", _SBET.max_bytes) as file:
        size = os.fstat(file.fileno()).st_size
        count, extra_bytes = divmod(size, layout.itemsize)
        FormatError.raise_if(
            extra_bytes or not count,
            f"{path}: {size} bytes",
            expected=f"a multiple of {layout.itemsize}, the size of a record",
            mend="copy the file again, or check its format",
            code="file-truncated",
        )
        records = np.fromfile(file, layout, count)
    FormatError.raise_if(
        records.size != count, f"{path}: became shorter during reading", code="file-truncated"
    )
    names = (*_SBET.columns, *_SBET.others)  # heading is the difference of the others
    columns = {name: records[name].astype(np.float64) for name in names if name != "heading"}
    # values of damaged files may overflow; `check_poses` refuses the results
    with np.errstate(invalid="ignore", over="ignore"):
        columns |= {name: np.degrees(columns[name]) for name in ("latitude", "longitude")}
        columns["heading"] = columns["platform_heading"] - columns["wander_angle"]
    return _record_of(
        path, _SBET, columns, Problems(f"{path} cannot be used as {_SBET.content}", FormatError)
    )


def read_lcf(path: str | Path) -> PoseRecord:
    # Read a Resonon ``.lcf`` file.
    #
    # Returns PoseRecord: Roll, pitch and heading [rad]: right wing UP, nose up, clockwise from true north;
    #     heights above the ellipsoid. Stamps count from the beginning of GPS time, or of a GPS week if they
    # are
    #     below two weeks.
    # Raises FormatError: The file is not such a table, or cells are not numbers, positions and angles; all
    # are
    #     listed.
    # Raises TimeError: Time runs backwards.
    path = as_path(path)
    text = read_text(path, _LCF.max_bytes, MAX_TABLE_ROWS)

    def rows() -> Iterator[tuple[int, list[str]]]:
        for row, line in numbered_lines(text):
            if line.strip():
                yield row, line.replace(",", " ").split(None, _MAX_LCF_CELLS)

    # the first row has as many cells as the others; only seven of them have a meaning
    cell_count = min(len(next(rows(), (0, []))[1]), _MAX_LCF_CELLS)
    table = table_of(path, [*_LCF.columns, *map(str, range(len(_LCF.columns), cell_count))], rows())
    problems = Problems(f"{path} cannot be used as {_LCF.content}", FormatError)
    limits = {"time": _LCF.max_seconds, **LIMITS}
    columns = {name: limited_numbers(table, name, limits[name], problems) for name in _LCF.columns}
    return _record_of(path, _LCF, columns, problems, table.rows)


def is_eph_att(header: EnviHeader) -> bool:
    # Return whether the bands of an ENVI file are the columns of a navigation record.
    return set(_EPH_ATT.columns) <= {name.lower() for name in header.band_names}


def read_eph_att(path: str | Path) -> PoseRecord:
    # Read navigation of AVIRIS-NG.
    #
    # path: The header or the data file.
    # Returns PoseRecord: Angles [degree]. Their signs and the reference of the height are not published. In
    # the
    #     sample, heading rate = g tan(roll) / speed within 6 % if roll is positive with the right wing down
    # and
    #     heading clockwise. The height is assumed to be above the ellipsoid.
    # Raises FormatError: The file is not such a record, or values are out of range; all are listed.
    # Raises TimeError: Time runs backwards.
    header_path, data_path = find_pair(path)
    fetch([data_path])
    header = read_header(header_path)
    stored_bytes = data_path.stat().st_size
    expected_bytes = header.header_offset + header.lines * header.line_bytes
    found_bytes = f"{data_path.name} has {stored_bytes} bytes"
    names = ", ".join(header.band_names)[:120]
    with Problems(f"{header_path} cannot be used as {_EPH_ATT.content}", FormatError) as problems:
        for is_wrong, found, expected, mend, code in (
            (not is_eph_att(header), f"band names are {names!r}", ", ".join(_EPH_ATT.columns), "",
             "column-missing"),
            (header.samples != 1, f"samples is {header.samples}", "1, as in navigation", "", "dims-wrong"),
            (header.dtype.kind != "f", f"values are {header.dtype}", "float64 (data type 5)", "",
             "type-wrong"),
            (stored_bytes != expected_bytes or stored_bytes > _EPH_ATT.max_bytes, found_bytes,
             f"{expected_bytes}, as its header says", "copy it again", "file-size"),
        ):  # fmt: skip
            problems.add_if(is_wrong, found, expected=expected, mend=mend, code=code)
    with open_input(data_path, "navigation") as file:
        file.seek(header.header_offset)
        stored = np.fromfile(file, header.dtype, header.lines * header.bands)
    FormatError.raise_if(
        stored.size != header.lines * header.bands,
        f"{data_path}: became shorter during reading",
        code="file-truncated",
    )
    # with one sample per line, the dims are lines and bands
    is_band_sequential = header.interleave == "bsq"
    bands = stored.reshape((header.bands, -1)) if is_band_sequential else stored.reshape(header.lines, -1).T
    numbers = {name.lower(): number for number, name in enumerate(header.band_names)}
    columns = {name: bands[numbers[name]].astype(np.float64) for name in _EPH_ATT.columns}
    problems = Problems(f"{data_path} cannot be used as {_EPH_ATT.content}", FormatError)
    return _record_of(data_path, _EPH_ATT, columns, problems)


def _record_of(
    path: Path,
    dialect: Dialect,
    columns: Mapping[str, Floats],
    problems: Problems,
    rows: Ints | None = None,
) -> PoseRecord:
    # Return the record of a file with the columns of a dialect, after checks of times and values. ``rows``:
    # numbers of the rows in the file, by default from 1 on.
    are_cells_read = not len(problems)  # else the same cells would be listed twice
    values = {name: columns[column] for column, name in dialect.columns.items()}
    seconds = values.pop("time")
    rows = np.arange(1, seconds.size + 1) if rows is None else rows
    is_in_week = seconds <= _WEEKS_S
    # cells beyond the maximum are already listed by the reader of a text
    is_invalid = ~(seconds >= 0.0) | (are_cells_read & (seconds > dialect.max_seconds))
    if is_invalid.any():
        problems.add(
            f"time is {seconds[is_invalid][0]:g} s in {name_rows(rows[is_invalid], dialect.row)}",
            expected=f"0 to {dialect.max_seconds:g} s"
            + " of the GPS week (GPS seconds modulo 604800)" * (dialect.max_seconds == _WEEKS_S),
            mend=f"check the format of {path.name}",
            code="value-out-of-range",
        )
    elif are_cells_read and 0 < is_in_week.sum() < is_in_week.size:
        minority_rows = rows[is_in_week == (2 * is_in_week.sum() < is_in_week.size)]
        problems.add(
            f"time has another origin in {name_rows(minority_rows, dialect.row)} than in the other rows",
            code="time-origin-conflict",
        )
    if are_cells_read:
        check_poses(values, dialect.convention.angle_unit, problems, dialect.row, rows)
    problems.raise_if_any()
    is_week_time = bool(is_in_week.all())
    stamp = unwrap_weeks(nanoseconds(seconds)) if is_week_time else nanoseconds(seconds) + GPS_EPOCH
    refuse_backwards(path.name, stamp, rows, dialect.row)
    return PoseRecord(
        path.name,
        dialect.name,
        stamp,
        "week" if is_week_time else "1970",
        values,
        dialect.convention,
        assumed=dialect.assumed,
        week=_week_of_name(path.name, int(stamp[0])) if dialect is _EPH_ATT else None,
        others={
            name: (columns[name], {"units": "radian", "long_name": meaning})
            for name, meaning in dialect.others.items()
        },
    )


def _week_of_name(name: str, first_stamp: int) -> int | None:
    # Return the GPS week of the date and time in a file name of AVIRIS-NG if they agree with the first stamp.
    match = _EPH_ATT_START.search(name)
    if match is None:
        return None
    date, clock = match.groups()
    start = instants([f"{date[:4]}-{date[4:6]}-{date[6:]}T{clock[:2]}:{clock[2:4]}:{clock[4:]}"])[0]
    if np.isnat(start):
        return None
    offset_ns = int(start.astype(np.int64)) - GPS_EPOCH - first_stamp
    week = round(offset_ns / (WEEK_S * NS_PER_S))
    difference_ns = abs(offset_ns - week * WEEK_S * NS_PER_S)
    is_plausible = difference_ns < _MAX_START_DIFFERENCE_S * NS_PER_S and date[:4] < "2199"
    return week if week >= 0 and is_plausible else None


# --- tables of text ---------------------------------------------------------------------------------------


#: Name of the variable in a column, by the name in its heading.
_ALIASES: dict[str, str] = {
    **dict.fromkeys(("latitude", "lat"), "latitude"),
    **dict.fromkeys(("longitude", "lon", "lng", "long"), "longitude"),
    **dict.fromkeys(("altitude", "alt", "height", "ellipsoidal height", "elevation"), "altitude"),
    "roll": "roll",
    "pitch": "pitch",
    **dict.fromkeys(("heading", "yaw", "true heading"), "heading"),
}
#: Origin of the times in a column, by its name; "" if stamps need a zone.
_CLOCKS: Mapping[str, str] = {
    **dict.fromkeys(("utc", "utc time", "time utc"), "utc"),
    **dict.fromkeys(("time", "timestamp", "datetime", "date time"), ""),
    **dict.fromkeys(("gps time", "gps seconds"), "gps"),
    **dict.fromkeys(("time of week", "gps time of week", "gps seconds of week", "tow", "sow"), "week"),
    **dict.fromkeys(("unix time", "posix time", "epoch time", "unix"), "unix"),
}
_WEEK_NAMES = ("gps week", "week", "gps week number", "week number", "gpsweek")
#: Names of columns of dates beside times of day.
_DATE_NAMES = ("date", "utc date", "date utc", "gps date")
_UNIT_SUFFIXES = (
    "deg",
    "degree",
    "degrees",
    "rad",
    "radian",
    "radians",
    "m",
    "ft",
    "feet",
    "s",
    "ms",
    "us",
    "ns",
)
_CELL = re.compile(r"(?P<name>[^\[(]*)(?:[\[(](?P<unit>[^\])]*)[\])])?")
_STAMP = re.compile(
    r"(\d{4})[-/](\d{2})[-/](\d{2})[T ](\d{2}):(\d{2}):(\d{2})(?:\.(\d{1,9})\d*)?"
    r"\s*(Z|UTC|[+-]\d{2}(?::?\d{2})?)?",
    re.ASCII,
)


class _Column(NamedTuple):
    # One column of the header.
    key: str  # name in lower case, with blanks for underscores
    shown: str  # heading, for messages
    unit: str | None


def is_navigation_csv(head: bytes) -> bool:
    # Return whether the header of a file names position and attitude.
    lines = decoded_text(head).splitlines()
    header = next((line for line in lines if line.strip() and not line.lstrip().startswith("#")), "")
    names = {_ALIASES.get(_column(cell).key) for cell in re.split("[,;\t]", header, maxsplit=_MAX_COLUMNS)}
    return {"latitude", "longitude", "roll", "pitch"} <= names


def read_navigation_csv(path: str | Path, names: Sequence[str] | None = None) -> PoseRecord:
    # Read navigation from a table of text.
    #
    # The header names ``latitude``, ``longitude``, ``altitude``, ``roll``, ``pitch``, ``heading`` (or
    # ``lat``, ``lon``, ``alt``, ``yaw`` ...) with units, ``roll [degree]``, ``roll (rad)`` or ``roll_deg``,
    # and a time: ``time`` or ``utc``, ISO 8601 stamps (in a column ``time`` with a zone); ``gps_time [s]``
    # from 1980-01-06, ``time_of_week [s]`` (the week may be in a column ``gps_week``), ``unix_time [s]``; or
    # a ``date`` and a time of day. Cells are separated by commas, semicolons or tabs; an empty cell is NaN,
    # and a row without a time is left out. Other columns are ignored. Comments ``# key: value`` before the
    # header declare fields of the `hyperpaint.base.attitude_conventions.Convention`, ``gps_week``,
    # ``leap_seconds`` and ``time_scale``.
    #
    # names: Headings with units for a table without a header, in the order of its columns; columns to ignore
    #     may have any other name. Cells of such a table may also be separated by blanks.
    # Returns PoseRecord: Angles in radian if all three columns are, else in degree.
    # Raises FormatError: Columns or units are missing, or cells do not fit the header; all are listed.
    # Raises TimeError: Time runs backwards.
    path = as_path(path)
    # Comments, header and cells of a file.
    text = read_text(path, _MAX_TEXT_BYTES, MAX_TABLE_ROWS)
    comments: dict[str, str] = {}
    start, head = 0, ""
    for start, line in numbered_lines(text):  # noqa: B007
        if line.strip() and not line.lstrip().startswith("#"):
            head = line
            break
        key, _, value = line.lstrip("# \t").rstrip(",; \t").partition(":")  # a spreadsheet fills lines up
        if line.strip() and len(comments) < _MAX_COMMENTS:
            comments[_plain_words(key).replace(" ", "_")] = value.strip()
    separator = next(
        (character for character in ("\t", ";", ",") if character in head), "," if names is None else None
    )
    cells = cells_of(head, separator)[: _MAX_COLUMNS + 1] if names is None else list(names)
    header = [_column(cell) for cell in cells]
    if len(cells) > _MAX_COLUMNS or not any(column.key in _ALIASES for column in header):
        shown_header = head.strip()[:80] if names is None else ", ".join(cells)[:80]
        raise FormatError(
            f"{path}: the header is {shown_header!r}",
            expected=f"names of {', '.join(POSE)} and a time",
            mend="pass columns= for a table without a header",
            code="header-missing",
        )
    first = start + (names is None)
    rows = (
        (number, cells_of(line, separator))
        for number, line in numbered_lines(text)
        if number >= first and line.strip() and not line.lstrip().startswith("#")
    )
    table = table_of(path, [column.shown for column in header], rows)
    # the week may be in a column beside the seconds
    weeks = next((table.columns[column.shown] for column in header if column.key in _WEEK_NAMES), [])
    if re.fullmatch(r"\d{1,4}", week := next(filter(None, map(str.strip, weeks)), "")):
        comments.setdefault("gps_week", week)
    with Problems(f"{path} cannot be used as navigation", FormatError) as problems:
        convention, assumed, clock_settings = _declarations(comments, problems)
        columns = _columns(header, problems)
    is_unit_declared = "angle_unit" not in assumed
    is_radian = [conversion_factor(str(columns[name].unit), "radian") == 1.0 for name in ANGLES]
    unit: Literal["degree", "radian"] = "radian" if all(is_radian) else "degree"
    problems.add_if(
        is_unit_declared and convention.angle_unit != unit,
        f"comment 'angle_unit' is {convention.angle_unit!r}, the header has {unit!r}",
        mend="remove one of them",
        code="units-conflict",
    )
    values: dict[str, Floats] = {}
    for name in POSE:
        target_unit = unit if name in ANGLES else "m" if name == "altitude" else "degree"
        numbers = limited_numbers(table, columns[name].shown, 1e6, problems, empty="nan")
        in_radians = target_unit == "degree" and conversion_factor(str(columns[name].unit), "radian") == 1.0
        factor = conversion_factor(str(columns[name].unit), target_unit)
        # np.degrees is exact, unlike conversion factors, which have twelve digits
        values[name] = np.degrees(numbers) if in_radians else numbers * factor
    stamp, has_time, clock = _time_column(table, columns["time"], clock_settings, problems)
    if not len(problems):  # else the same cells would be listed twice
        check_poses(values, unit, problems, "row", np.arange(1, stamp.size + 1))
    problems.raise_if_any()
    FormatError.raise_if(not has_time.any(), f"{path}: no row with a time", code="time-missing")
    timed_stamps = unwrap_weeks(stamp[has_time]) if clock == "week" else stamp[has_time]
    refuse_backwards(path.name, timed_stamps, row="row")
    rows_left_out = int((~has_time).sum())
    return PoseRecord(
        path.name,
        "csv",
        timed_stamps,
        "week" if clock == "week" else "1970",
        {name: value[has_time] for name, value in values.items()},
        convention.replace(angle_unit=unit),
        assumed=tuple(name for name in assumed if name != "angle_unit"),
        time_scale=clock_settings.get("time_scale") or ("gps" if clock in ("gps", "week") else "utc"),
        week=clock_settings.get("gps_week"),
        leap_seconds=clock_settings.get("leap_seconds"),
        attrs={"rows_without_time": rows_left_out} if rows_left_out else {},
    )


def _plain_words(text: str) -> str:
    return " ".join(text.strip().strip('"').lower().replace("_", " ").split())


def _column(cell: str) -> _Column:
    heading = cell.strip().strip('"')[:60]
    match = _CELL.match(heading)
    name, unit = (match["name"], match["unit"]) if match else (heading, None)
    key = _plain_words(name)
    if unit is None and key not in _ALIASES and key not in _CLOCKS:
        stem, _, unit_suffix = key.rpartition(" ")
        if unit_suffix in _UNIT_SUFFIXES and (stem in _ALIASES or stem in _CLOCKS):
            return _Column(stem, heading, unit_suffix)
    return _Column(key, heading, unit.strip() if unit is not None else None)


def _declarations(
    comments: Mapping[str, str], problems: Problems
) -> tuple[Convention, list[str], dict[str, Any]]:
    # Return the convention and the clock settings in the comments, and the fields assumed without a comment.
    names = {field.name for field in fields(Convention)}
    declared: dict[str, Any] = {}
    for key, value in comments.items():
        name = key.removeprefix("convention_")
        if name in ("declination", "geoid_undulation"):
            try:
                declared[name] = float(value)
            except ValueError:
                problems.add(
                    f"comment {key!r} is {value[:40]!r}", expected="a number", code="number-unreadable"
                )
        elif name in names:
            declared[name] = value
    clock_settings: dict[str, Any] = {}
    for name, maximum in (("gps_week", 11_479), ("leap_seconds", 100)):
        text = comments.get(name)
        if text is None:
            continue
        if re.fullmatch(r"[0-9]{1,5}", text) and int(text) <= maximum:
            clock_settings[name] = int(text)
        else:
            problems.add(
                f"comment {name!r} is {text[:40]!r}",
                expected=f"a whole number up to {maximum}",
                code="value-out-of-range",
            )
    if "time_scale" in comments:
        time_scale = comments["time_scale"].lower()
        if one_of(time_scale, ("gps", "utc"), "time_scale", problems=problems):
            clock_settings["time_scale"] = time_scale
    convention = Convention()
    with problems.noting(SchemaError):
        convention = Convention(**declared)
    optional_fields = ("stamp_reference", "column_order", "declination", "geoid_undulation", "grid_crs")
    assumed = [f.name for f in fields(Convention) if f.name not in declared and f.name not in optional_fields]
    return convention, assumed, clock_settings


def _columns(header: list[_Column], problems: Problems) -> dict[str, _Column]:
    meanings = _ALIASES | dict.fromkeys(_CLOCKS, "time")
    columns_by_name = grouped((meanings[column.key], column) for column in header if column.key in meanings)
    for name in (*POSE, "time"):
        if name not in columns_by_name:
            names = _CLOCKS if name == "time" else [key for key, value in _ALIASES.items() if value == name]
            problems.add(
                f"no column of {name}",
                expected=f"one named {' or '.join(map(repr, list(names)[:4]))}",
                code="column-missing",
            )
        elif len(columns_by_name[name]) > 1:
            headings = ", ".join(repr(column.shown) for column in columns_by_name[name])
            problems.add(f"{headings} all mean {name}", mend="keep one of them", code="column-duplicate")
        elif name != "time" and columns_by_name[name][0].unit is None:
            heading, unit = columns_by_name[name][0].shown, "m" if name == "altitude" else "degree"
            problems.add(
                f"column {heading!r} has no unit",
                mend=f"name it for example '{heading} [{unit}]'",
                code="units-missing",
            )
        elif name != "time":
            with problems.noting(UnitsError, f"column {columns_by_name[name][0].shown!r}"):
                conversion_factor(str(columns_by_name[name][0].unit), "m" if name == "altitude" else "degree")
    return {name: columns[0] for name, columns in columns_by_name.items()}


def _time_column(
    table: Table, column: _Column, clock_settings: Mapping[str, Any], problems: Problems
) -> tuple[Ints, Bools, str]:
    # Return stamps [ns], whether each row has one, and their origin as in `_CLOCKS`.
    clock = _CLOCKS[column.key]
    cells = [cell.strip() for cell in table.columns[column.shown]]
    has_time = np.array([bool(cell) and cell != "NaT" for cell in cells])
    stamp = np.zeros(len(cells), np.int64)
    first_stamp = next((cell for cell, has_stamp in zip(cells, has_time, strict=True) if has_stamp), "")
    if not first_stamp:
        return stamp, has_time, clock
    if ":" in first_stamp:
        # times of day, with their dates in another column
        dates = next((name for name in table.columns if _plain_words(name) in _DATE_NAMES), None)
        if dates is not None and first_stamp.find(":") < 3:
            cells = [f"{date.strip()} {cell}" for date, cell in zip(table.columns[dates], cells, strict=True)]
        is_zone_required = not clock and "time_scale" not in clock_settings
        # Nanoseconds since 1970, and the line numbers of unreadable stamps.
        texts, shifts = ["1970-01-01"] * len(cells), np.zeros(len(cells), np.int64)
        is_unreadable = np.zeros(len(cells), np.bool_)
        for position in np.flatnonzero(has_time).tolist():
            match = _STAMP.fullmatch(cells[position][:64])
            if match is None or not "1980" <= match[1] < "2199" or (is_zone_required and match[8] is None):
                is_unreadable[position] = True
                continue
            texts[position] = (
                f"{match[1]}-{match[2]}-{match[3]}T{match[4]}:{match[5]}:{match[6]}.{match[7] or 0}"
            )
            if match[8] and match[8][0] in "+-":
                zone_text = match[8].replace(":", "")
                minutes = int(zone_text[1:3]) * 60 + int(zone_text[3:5] or 0)
                shifts[position] = (-minutes if zone_text[0] == "-" else minutes) * 60
        stamps = instants(texts)
        is_unreadable |= np.isnat(stamps)
        stamp, wrong_rows = stamps.astype(np.int64) - shifts * NS_PER_S, table.rows[is_unreadable]
        if wrong_rows.size:
            zone = " with a zone (or '# time_scale: utc')" if is_zone_required else ""
            problems.add(
                f"column {column.shown!r} is unreadable in {name_rows(wrong_rows)}",
                expected=f"times such as '2024-06-01T12:00:00.5Z'{zone}",
                code="time-unreadable",
            )
        return stamp, has_time, clock if clock == "gps" else ""
    if clock in ("", "utc"):
        problems.add(
            f"column {column.shown!r} contains numbers of unknown origin",
            mend="name it 'gps_time [s]' (from 1980-01-06), 'time_of_week [s]' or 'unix_time [s]'",
            code="time-origin-unknown",
        )
        return stamp, has_time, clock
    try:
        factor = conversion_factor(str(column.unit or "no unit"), "s")
    except UnitsError:
        problems.add(
            f"column {column.shown!r} has no unit of time",
            mend=f"name it for example '{column.key} [s]'",
            code="units-missing",
        )
        return stamp, has_time, clock
    numbers = Table(table.name, table.rows, {column.shown: [cell or "0" for cell in cells]})
    maximum = (_WEEKS_S if clock == "week" else _MAX_TIME_S) / factor
    problem_count = len(problems)
    seconds = limited_numbers(numbers, column.shown, maximum, problems) * factor
    if len(problems) > problem_count:
        return stamp, has_time, clock
    has_time = has_time & ~np.isnan(seconds)
    problems.add_if(
        (seconds < 0.0).any(),
        f"column {column.shown!r} is negative in {name_rows(table.rows[seconds < 0.0])}",
        code="value-out-of-range",
    )
    stamp = nanoseconds(np.where(has_time & (seconds >= 0.0), seconds, 0.0))
    if clock == "gps" and has_time.any() and (seconds[has_time] <= _WEEKS_S).all():
        clock = "week"
    return (stamp + GPS_EPOCH if clock == "gps" else stamp), has_time, clock


# --- NMEA 0183 ---------------------------------------------------------------------------------------------


SENTENCES = SimpleNamespace(
    #: Largest number of positions in a log: five hours at 20 Hz.
    max_positions=400_000,
    day_s=86_400,
    half_day_s=43_200.0,
    #: Quality codes of GGA for measured positions, without estimated, manual and simulated ones.
    measured_qualities=(1, 2, 3, 4, 5, 9),
    #: Largest share of sentences with a wrong checksum [1].
    max_damaged_share=0.5,
)

_SENTENCE = re.compile(r"\$?((?:[A-Z]{2}(?:GGA|RMC|ZDA|HDT|THS)|PASHR),[ -)+-~]{0,120})\*([0-9A-Fa-f]{2})")
_CLOCK = re.compile(r"([0-9]{2})([0-9]{2})([0-9]{2}(?:\.[0-9]{1,9})?)")
_ANGLE = re.compile(r"([0-9]{1,3})([0-9]{2}(?:\.[0-9]{1,12})?)")
_NUMBER = re.compile(r"[+-]?[0-9]{1,9}(?:\.[0-9]{0,12})?")


def is_nmea(head: bytes) -> bool:
    # Return whether the first bytes of a file contain NMEA sentences with positions.
    return any("GGA" in match[1][:6] for match in _SENTENCE.finditer(head.decode("latin-1")))


def read_nmea(path: str | Path, midnight: int | None = None) -> PoseRecord:
    # Read a log of NMEA 0183 sentences.
    #
    # Each GGA sentence with a fix gives a row: time of day in UTC, position, and height above the ellipsoid,
    # which is the sum of its heights above mean sea level and of the geoid. If a sentence lacks the latter,
    # all heights are above the geoid. The date comes from RMC or ZDA. Roll, pitch and heading come from PASHR
    # of the same time; without it, heading comes from the HDT or THS before or after the GGA sentence. The
    # course over ground is not the heading, and is ignored, as are other texts, and sentences with a wrong
    # checksum.
    #
    # path: The log.
    # midnight: 0 h UTC of the first row's day [ns since 1970-01-01], for a log without dates.
    # Returns PoseRecord: Angles [degree], NaN if unknown. The standard does not define the signs of roll and
    #     pitch, which are assumed.
    # Raises FormatError: No position with a fix, too many damaged sentences, or positions and angles out of
    # range. Raises TimeError: No date, or time runs backwards. Warns PaintWarning: Damaged sentences; no
    # attitude in the whole log.
    path = as_path(path)
    text = read_text(path, _MAX_TEXT_BYTES, MAX_TABLE_ROWS)
    log, damaged, total = _Log(path), 0, 0
    for match in _SENTENCE.finditer(text):
        total += 1
        sentence, checksum = match.groups()
        if reduce(xor, sentence.encode("latin-1")) != int(checksum, 16):
            damaged += 1
            continue
        try:
            log.take(sentence.split(","))
        except (ValueError, LookupError, OverflowError):
            log.problems.add_if(
                len(log.problems) < 5,
                f"sentence {sentence[:60]!r} does not follow NMEA 0183",
                code="row-unreadable",
            )
        if len(log.rows) > SENTENCES.max_positions:
            break
    FormatError.raise_if(
        len(log.rows) > SENTENCES.max_positions,
        f"{path}: over {SENTENCES.max_positions} positions",
        expected="a log of hours",
        mend="shorten the log to the flight",
        code="file-too-large",
    )
    wrong_checksums = f"{damaged} of {total} sentences have a wrong checksum"
    FormatError.raise_if(
        damaged > SENTENCES.max_damaged_share * total,
        f"{path}: {wrong_checksums}",
        mend="copy it again",
        code="checksum-wrong",
    )
    warn_if(damaged, f"{path.name}: {wrong_checksums}, and are ignored", "checksum-wrong")
    log.problems.raise_if_any()
    FormatError.raise_if(
        not log.rows,
        f"{path}: no position with a fix",
        expected="GGA sentences of NMEA 0183",
        code="position-missing",
    )
    midnight_ns = TimeError.raise_if_none(
        log.first_day if log.first_day is not None else midnight,
        f"{path.name} contains no date (RMC or ZDA)",
        mend="pass date='YYYY-MM-DD' of its first row",
        code="date-missing",
    )
    stamp = np.rint(np.array(list(log.rows)) * NS_PER_S).astype(np.int64) + midnight_ns
    names = (*POSE, "separation")
    values = {name: np.array([row.get(name, np.nan) for row in log.rows.values()]) for name in names}
    separation = values.pop("separation")
    height: Literal["ellipsoid", "geoid"] = "geoid" if np.isnan(separation).any() else "ellipsoid"
    if height == "ellipsoid":
        values["altitude"] += separation
    check_poses(values, "degree", log.problems, "position", np.arange(1, stamp.size + 1))
    log.problems.raise_if_any()
    refuse_backwards(path.name, stamp, row="position")
    warn_if(
        all(np.isnan(values[name]).all() for name in ANGLES),
        f"{path.name} contains no roll, pitch or heading (PASHR, HDT or THS)",
        "attitude-missing",
    )
    return PoseRecord(
        path.name,
        "NMEA 0183",
        stamp,
        "1970",
        values,
        Convention(height_reference=height),
        assumed=("roll_positive", "pitch_positive", "euler_order"),
        time_scale="utc",
    )


class _Log:
    # Collects the sentences of a log into rows.
    def __init__(self, path: Path) -> None:
        self.rows: dict[float, dict[str, float]] = {}  # poses by seconds from 0 h of the first day
        self.first_day: int | None = None  # 0 h of the first day [ns since 1970-01-01]
        self.problems = Problems(f"{path} cannot be used as a log of NMEA sentences", FormatError)
        self._last_seconds: float | None = None  # of the previous sentence with a time
        self._last_clock = ""
        self._heading_ahead: float | None = None  # for the next position
        self._is_heading_first = False  # whether the heading precedes its position
        # attitudes of positions that follow, by seconds
        self._attitudes_ahead: dict[float, dict[str, float]] = {}

    def take(self, fields: list[str]) -> None:
        # Raises ValueError, LookupError, OverflowError: the fields do not follow NMEA 0183.
        match fields[0][-3:]:
            case "GGA" if int(fields[6] or 0) in SENTENCES.measured_qualities and fields[2]:
                seconds = self._record_seconds(fields[1])
                if seconds in self.rows:
                    return
                row = self.rows[seconds] = {
                    "latitude": _angle(fields[2]) * {"N": 1.0, "S": -1.0}[fields[3]],
                    "longitude": _angle(fields[4]) * {"E": 1.0, "W": -1.0}[fields[5]],
                    "altitude": _number(fields[9]),
                    "separation": _number(fields[11]),
                }
                if self._heading_ahead is not None:
                    row["heading"], self._heading_ahead = self._heading_ahead, None
                row.update(self._attitudes_ahead.pop(seconds, {}))
                self._attitudes_ahead.clear()
            case "RMC" if fields[2] == "A":
                day, month, year = (int(fields[9][start : start + 2]) for start in (0, 2, 4))
                self._date(fields[1], 2000 + year if year < 80 else 1900 + year, month, day)
            case "ZDA" if fields[2]:
                self._date(fields[1], int(fields[4]), int(fields[3]), int(fields[2]))
            case "SHR" if len(fields) >= 6 and _CLOCK.fullmatch(fields[1]):  # else of the same maker
                seconds = self._record_seconds(fields[1])
                numbers = {"heading": 2, "roll": 4, "pitch": 5}
                pose = {name: _number(fields[number]) for name, number in numbers.items() if fields[number]}
                if seconds in self.rows:
                    self.rows[seconds].update(pose)
                else:
                    self._attitudes_ahead[seconds] = pose
            case ("HDT" | "THS") as kind if (kind == "HDT" or fields[2] == "A") and fields[1]:
                # without a time: belongs to the next position if the log begins with it, else to the previous
                self._is_heading_first |= not self.rows
                if self._is_heading_first:
                    self._heading_ahead = _number(fields[1])
                else:
                    self.rows[next(reversed(self.rows))].setdefault("heading", _number(fields[1]))

    def _record_seconds(self, clock: str) -> float:
        # Return seconds from 0 h of the first row's day.
        if clock == self._last_clock:  # sentences of one epoch have the same
            return round(self._last_seconds or 0.0, 9)
        match = _CLOCK.fullmatch(clock)
        if match is None:
            raise ValueError(clock)
        hours, minutes, seconds = match.groups()
        seconds_of_day = int(hours) * 3600.0 + int(minutes) * 60.0 + float(seconds)
        if self._last_seconds is None:
            self._last_seconds = seconds_of_day
        # some sentences are late: choose the day that is nearest to the previous sentence
        self._last_seconds += (
            seconds_of_day - self._last_seconds + SENTENCES.half_day_s
        ) % SENTENCES.day_s - SENTENCES.half_day_s
        self._last_clock = clock
        return round(self._last_seconds, 9)

    def _date(self, clock: str, year: int, month: int, day: int) -> None:
        seconds = self._record_seconds(clock)
        if not 1980 <= year < 2200:  # nanoseconds overflow, or a receiver without a fix writes its epoch
            raise ValueError(year)
        date = datetime.date(year, month, day)  # refuses days that do not exist
        if self.first_day is None:
            midnight = int(np.datetime64(date, "ns").astype(np.int64))
            self.first_day = midnight - int(seconds // SENTENCES.day_s) * SENTENCES.day_s * NS_PER_S


def _angle(text: str) -> float:
    # Convert ``dddmm.mmmm`` to degrees.
    match = _ANGLE.fullmatch(text)
    if match is None:
        raise ValueError(text)
    return int(match[1]) + float(match[2]) / 60.0


def _number(text: str) -> float:
    if not text:
        return np.nan
    if not _NUMBER.fullmatch(text):
        raise ValueError(text)
    return float(text)


# --- opening -----------------------------------------------------------------------------------------------

#: A file's record, its UTC [ns since 1970-01-01], and attributes that describe the conversion to UTC.
Part = tuple[PoseRecord, Ints, dict[str, Any]]

NavigationFormat = Literal["imu_gps", "sbet", "lcf", "eph_att", "csv", "nmea"]
Paths = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]

_HEAD_BYTES = 4096
_DAY_NS = 86_400 * NS_PER_S
#: GPS week in the year 2199; int64 nanoseconds overflow in the 23rd century.
_MAX_GPS_WEEK = 11_479
_WEEKDAYS = ("Sunday", "Monday", "Tuesday", "Wednesday", "Thursday", "Friday", "Saturday")
_MEANINGS = {
    "latitude": "Latitude of the navigation's reference point, north positive",
    "longitude": "Longitude of the navigation's reference point, east positive",
    "altitude": "Height of the navigation's reference point",
    "roll": "Roll, as recorded",
    "pitch": "Pitch, as recorded",
    "heading": "Heading, as recorded",
}


@takes_quantities(clock_offset_s="s")
def open_navigation(
    paths: Paths,
    *,
    convention: Convention | Mapping[str, Any] | None = None,
    format: NavigationFormat | None = None,
    week: int | None = None,
    date: str | datetime.date | None = None,
    leap_seconds: int | None = None,
    time_scale: Literal["gps", "utc"] | None = None,
    clock_offset_s: float | None = None,
    gps_time: str | os.PathLike[str] | None = None,
    columns: Sequence[str] | None = None,
) -> xr.Dataset:
    """Read a navigation record: position, attitude and time of the platform.

    ==================  ===================================================================================
    ``imu_gps``         Headwall ``imu_gps.txt``, three generations; degree; UTC
    ``sbet``            Applanix SBET (POSPac); radian; seconds of the GPS week
    ``lcf``             Resonon ``.lcf``; radian, roll positive with the right wing UP; GPS time
    ``eph_att``         AVIRIS-NG ``*_eph_att`` with its ENVI header; degree; seconds of the GPS week
    ``csv``             a table with a header that names columns and units, see `read_navigation_csv`; without
                        one, with ``columns``
    ``nmea``            a log of NMEA 0183 sentences: GGA with RMC or ZDA, and PASHR, HDT or THS; degree; UTC
    ==================  ===================================================================================

    Each reader declares the published conventions of its format. Conventions that are not published are
    listed in the attribute ``assumed``. Navigation files contain neither the side of column 0 nor the instant
    of the camera's stamps; these remain undeclared unless ``convention`` declares them.

    Parameters
    ----------
    paths
        One file, or several of one format whose times do not overlap; or any Zarr that contains a record
        as this function returns it. Its times remain unchanged, and without ``convention`` its declarations.
    convention
        Conventions of the numbers, used instead of the format's; or a mapping that replaces some of its
        choices, such as ``{"column_order": "left_to_right"}``.
    format
        Format of the files; by default detected from name and content.
    week, date
        For files that count seconds of a GPS week: number of the week since 1980-01-06, or the day of the first
        row, ``"2021-05-20"``. A date is also compared with the stamps.
    leap_seconds
        GPS minus UTC [s]; by default from the IERS table. Unused if stamps are UTC.
    time_scale
        Time scale of the stamps, if it differs from the usual one of the format.
    clock_offset_s
        UTC = stamp + ``clock_offset_s`` [s]. An ``imu_gps.txt`` whose only time is the time of day of the
        recording computer needs this and ``date``, or ``gps_time``.
    gps_time
        The file ``gps_time.txt`` of the same flight, for such an ``imu_gps.txt``.
    columns
        Names and units of the columns of a table without a header, in their order:
        ``["time_of_week [s]", "latitude [degree]", ..., "heading [degree]"]``, with any other name for columns
        to ignore.

    Returns
    -------
    xarray.Dataset
        ``latitude``, ``longitude`` [degree], ``altitude`` [m], ``roll``, ``pitch``, ``heading`` (units as in
        the file) on ``navigation_time`` [UTC, datetime64[ns]], float64, wrapped as in the file, NaN where
        unknown. Attributes: the convention, ``format``, ``source``, and how stamps became UTC
        (``time_scale``, ``gps_week``, ``leap_seconds``, ``clock_offset_s``).

    Raises
    ------
    FormatError
        A file is damaged, or of another or unknown format; all problems are listed.
    TimeError
        The GPS week is unknown, or contradicts the stamps; time runs backwards, within a file or from one
        to the next; a clock setting is invalid.
    SchemaError
        A convention is invalid, or contradicts the unit of the angles.

    Warns
    -----
    PaintWarning
        Times after the end of the table of leap seconds; a record whose inertial system never aligned.

    Examples
    --------
    >>> import tempfile
    >>> scratch = tempfile.TemporaryDirectory()
    >>> path = Path(scratch.name) / "flight.csv"
    >>> _ = path.write_text('''time,latitude [degree],longitude [degree],altitude [m],roll [degree],pitch [degree],heading [degree]
    ... 2024-06-01T12:00:00Z,43.1,-77.6,150,0.5,-1,359.5
    ... 2024-06-01T12:00:01Z,43.1,-77.6,150,0.4,-1,0.5
    ... ''')
    >>> flight = open_navigation(path, convention={"column_order": "left_to_right"})
    >>> flight.heading.values
    array([359.5,   0.5])
    >>> flight.attrs["convention_column_order"]
    'left_to_right'
    >>> scratch.cleanup()
    """  # noqa: E501
    if is_zarr(paths):
        stored = load_group(paths)
        with Problems(f"{paths} cannot be used as navigation", FormatError) as problems:
            for name in (NAVIGATION_TIME, *POSE):
                if name not in stored.variables:
                    problems.add(
                        f"{name!r} is missing among {', '.join(map(str, stored.variables))[:200]}",
                        code="variable-missing",
                    )
                elif stored[name].dims != (NAVIGATION_TIME,):
                    problems.add(
                        f"{name!r} has dims {stored[name].dims}",
                        expected=f"({NAVIGATION_TIME!r},)",
                        code="dims-wrong",
                    )
                elif name != NAVIGATION_TIME and "units" not in stored[name].attrs:
                    problems.add(
                        f"{name!r} has no units",
                        expected="the units of open_navigation",
                        code="units-missing",
                    )
        stored_times = stored[NAVIGATION_TIME].values
        TimeError.raise_if(
            stored_times.dtype.kind != "M" or not stored_times.size or np.isnat(stored_times).any(),
            f"{paths}: {NAVIGATION_TIME} is {stored_times.dtype}",
            expected="UTC, datetime64[ns]",
            code="type-wrong",
        )
        refuse_backwards(str(paths), stored_times.astype("datetime64[ns]").astype(np.int64), row="sample")
        own = Convention.from_attrs(stored.attrs)
        stored_convention = _convention(
            str(paths), own or Convention(), ("angle_unit",) if own is None else (), convention
        )
        floats = {name: stored[name].astype(np.float64) for name in POSE}
        return stored.assign(floats).assign_attrs(stored_convention.to_attrs())
    files = [Path(paths)] if isinstance(paths, str | os.PathLike) else [Path(path) for path in paths]
    FormatError.raise_if(
        not files, "an empty list of navigation files", expected="one or more", code="empty-input"
    )
    source = TimeSource(week, date, leap_seconds, time_scale, clock_offset_s)
    if format is not None:
        one_of(format, get_args(NavigationFormat), "format")
    parts: list[Part] = []
    findings = Findings("the navigation cannot be used")
    SchemaError.raise_if(
        columns is not None and format not in (None, "csv"),
        f"columns= with format {format!r}",
        expected="format 'csv'",
        code="option-conflict",
    )
    for path in files:
        with findings.step():
            kind = format or ("csv" if columns is not None else navigation_format(path))
            record = (
                _headwall_record(path, source, None if gps_time is None else Path(gps_time))
                if kind == "imu_gps"
                else read_record(path, kind, columns, source.midnight)
            )
            parts.append((record, *utc_of_record(record, source)))
    findings.raise_if_any()
    parts.sort(key=lambda part: int(part[1][0]))
    first = parts[0][0]
    for (earlier_record, earlier_utc, _), (record, utc, _) in itertools.pairwise(parts):
        FormatError.raise_if(
            (record.format, record.convention, set(record.others))
            != (
                first.format,
                first.convention,
                set(first.others),
            ),
            f"{first.name} ({first.format}) and {record.name} ({record.format}) differ in format, "
            "columns or convention",
            mend="open them separately",
            code="formats-mixed",
        )
        if utc[0] <= earlier_utc[-1]:
            end, start = (
                np.datetime64(int(t), "ns").astype("datetime64[ms]") for t in (earlier_utc[-1], utc[0])
            )
            raise TimeError(
                f"{earlier_record.name} ends at {end}, after {record.name} begins at {start}",
                mend="open one of them",
                code="time-overlap",
            )
    record, _, time_attrs = parts[0]
    source_text = f"{record.name} ({record.format})"
    chosen_convention = _convention(source_text, record.convention, record.assumed, convention)
    units = {"latitude": "degree", "longitude": "degree", "altitude": "m"}
    variables = {
        name: (
            NAVIGATION_TIME,
            np.concatenate([part.values[name] for part, _, _ in parts]),
            {"long_name": _MEANINGS[name], "units": units.get(name, chosen_convention.angle_unit)},
        )
        for name in POSE
    }
    for name, (_, attrs) in record.others.items():
        values = np.concatenate([part.others[name][0] for part, _, _ in parts])
        variables[name] = (NAVIGATION_TIME, values, dict(attrs))
    time = np.concatenate([utc for _, utc, _ in parts]).astype("datetime64[ns]")
    declared = set(
        chosen_convention.__dataclass_fields__ if isinstance(convention, Convention) else convention or ()
    )
    assumed = ", ".join(name for name in record.assumed if name not in declared)
    return xr.Dataset(
        variables,
        {NAVIGATION_TIME: (NAVIGATION_TIME, time, {"long_name": "UTC of the navigation record"})},
        {
            "source": ", ".join(part[0].name for part in parts),
            "format": record.format,
            **record.attrs,
            **time_attrs,
            **chosen_convention.to_attrs(),
            **({"assumed": assumed} if assumed else {}),
        },
    )


def navigation_format(path: str | Path) -> NavigationFormat:
    # Return the format of a navigation file, by its name and first bytes.
    #
    # Raises FormatError: The file cannot be read, or its format is unknown.
    path = input_path(path, "a navigation record")
    suffix = path.suffix.lower()
    if suffix == ".hdr" or is_plain_file(path.with_name(path.name + ".hdr")):
        return "eph_att"
    with open_input(path, "a navigation record") as file:
        head = file.read(_HEAD_BYTES)
    if suffix == ".sbet" or (suffix == ".out" and b"\0" in head):
        return "sbet"
    if suffix == ".lcf":
        return "lcf"
    head = decoded_text(head).encode()
    first_line = head.partition(b"\n")[0].lower()
    if b"\0" not in head and {b"roll", b"pitch", b"yaw", b"lat", b"lon", b"alt"} <= set(first_line.split()):
        return "imu_gps"
    if is_nmea(head):
        return "nmea"
    if b"\0" not in head and suffix in (".csv", ".tsv", ".txt", ".asc", ".dat"):
        return "csv"
    formats = ", ".join(map(repr, get_args(NavigationFormat)))
    content = "binary" if b"\0" in head else f"begins {head[:60].decode('latin-1')!r}"
    raise FormatError(
        f"{path}: {content}, no known format of navigation",
        mend=f"pass format=, one of {formats}",
        code="format-unknown",
    )


# --- one file ----------------------------------------------------------------------------------------------


def read_record(
    path: Path, format: NavigationFormat, columns: Sequence[str] | None = None, midnight: int | None = None
) -> PoseRecord:
    # Read a file of any format except ``imu_gps``, with stamps as in the file.
    #
    # columns: As for `open_navigation`.
    # midnight: As for `read_nmea`.
    #
    # Raises FormatError, TimeError: By the reader of the format.
    readers: Mapping[str, Callable[[Path], PoseRecord]] = {
        "sbet": read_sbet,
        "lcf": read_lcf,
        "eph_att": read_eph_att,
        "nmea": lambda path: read_nmea(path, midnight),
        "csv": lambda path: read_navigation_csv(path, columns),
    }
    return readers[format](path)


def _headwall_record(path: Path, source: "TimeSource", gps_time: Path | None) -> PoseRecord:
    # Read ``imu_gps.txt`` with stamps before correction by ``clock_offset_s``.
    record: Navigation = read_imu_gps(path)
    needs_date = record.utc is None
    if needs_date and gps_time is not None:
        record = record.dated_by(read_gps_time(gps_time))
    elif needs_date and source.midnight is not None and source.clock_offset_s is not None:
        # 0 h of the first row's day by the computer's clock, and microseconds since then
        stamp = record.stamps.get("time of day")
        record = record if stamp is None else replace(record, utc=source.midnight + stamp * 1000)
    if record.utc is None or not record.utc.size:
        raise TimeError(
            f"{path.name} contains no date",
            mend=(
                "pass gps_time= (gps_time.txt of the same flight), or date= and clock_offset_s= (UTC "
                "= the computer's clock + clock_offset_s)"
            ),
            code="date-missing",
        )
    refuse_backwards(path.name, record.utc, record.rows)
    return PoseRecord(
        path.name,
        "Headwall imu_gps",
        record.utc,
        "1970",
        record.values,
        Convention(),
        assumed=ASSUMED,
        time_scale="utc",
    )


# --- stamps as UTC -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TimeSource:
    # Clock settings of a navigation record given by the caller; see `open_navigation`.

    week: int | None = None
    date: str | datetime.date | None = None
    leap_seconds: int | None = None
    time_scale: Literal["gps", "utc"] | None = None
    clock_offset_s: float | None = None

    def __post_init__(self) -> None:
        # Refuse invalid settings, all in one error.
        # Raises TimeError: A week, date, number of leap seconds, time scale or clock offset is invalid.
        with Problems("the clock settings of the navigation are invalid", TimeError) as problems:
            week, leap, offset = self.week, self.leap_seconds, self.clock_offset_s
            if self.time_scale is not None:
                one_of(self.time_scale, ("gps", "utc"), "time_scale", problems=problems)
            for is_valid, found, expected, code in (
                (week is None or _is_whole(week, _MAX_GPS_WEEK), f"week {week!r:.40}",
                 "the number of weeks since 1980-01-06, such as 2158", "value-out-of-range"),
                (leap is None or _is_whole(leap, 100), f"leap_seconds {leap!r:.40}",
                 "GPS minus UTC in whole seconds, such as 18", "value-out-of-range"),
                (self.date is None or self.midnight is not None, f"date {str(self.date)!r:.40}",
                 "a date such as '2024-06-01'", "time-unreadable"),
                (offset is None or (is_number(offset) and abs(offset) <= CLOCK_LIMITS.max_offset_s),
                 f"clock_offset_s {offset!r:.40}", "seconds, -1e9 to 1e9", "value-out-of-range"),
            ):  # fmt: skip
                problems.add_if(not is_valid, found, expected=expected, code=code)

    @property
    def midnight(self) -> int | None:
        # Nanoseconds from 1970 to 0 h of the date; None without a valid date.
        return midnight_of(self.date)


def _is_whole(value: Any, maximum: int) -> bool:
    is_integer = isinstance(value, int | np.integer) and not isinstance(value, bool)
    return is_integer and 0 <= int(value) <= maximum


def utc_of_record(record: PoseRecord, source: TimeSource) -> tuple[Ints, dict[str, Any]]:
    # Return UTC [ns since 1970-01-01] of the rows of a record, and attributes that describe the conversion.
    # Raises TimeError: Seconds of the week without a week or date; a week or date that the stamps contradict;
    #     times before GPS time began.
    # Warns PaintWarning: Times beyond the table of leap seconds, ``leap_seconds`` not given.
    stamp, midnight = record.stamp, source.midnight
    first_second = int(stamp[0]) // NS_PER_S
    attrs: dict[str, Any] = {}
    if record.counts_from == "week":
        if source.week is not None:
            week, week_source = int(source.week), "given"
        elif midnight is not None:
            # the week whose first row is nearest to noon of the day, since a date may be local
            noon = midnight + _DAY_NS // 2 - GPS_EPOCH
            week = max(0, round((noon - int(stamp[0])) / (WEEK_S * NS_PER_S)))
            week_source = "from the date given"
        elif record.week is not None:
            week, week_source = record.week, f"said by {record.name}"
        else:
            raise TimeError(
                f"{record.name} counts seconds of an unknown GPS week (from {first_second} s: a "
                f"{_WEEKDAYS[first_second // 86_400 % 7]})",
                mend="pass week=, the weeks since 1980-01-06, or date='YYYY-MM-DD' of the flight",
                code="gps-week-missing",
            )
        stamp = stamp + (GPS_EPOCH + week * WEEK_S * NS_PER_S)
        attrs = {"gps_week": week, "gps_week_source": week_source}
    # a week or date that the stamps contradict
    problems, first = Problems(f"{record.name} contradicts week or date", TimeError), int(stamp[0])
    begins = f"it begins at {np.datetime64(first // NS_PER_S, 's')}"
    stamp_week = (first - GPS_EPOCH) // (WEEK_S * NS_PER_S)
    problems.raise_if_any(
        (
            midnight is not None and abs(first - midnight - _DAY_NS // 2) > 1.5 * _DAY_NS,
            Problem(
                f"{begins}, but date is {source.date}",
                mend="correct date, or open another file",
                code="date-conflict",
            ),
        ),
        (
            source.week not in (None, stamp_week) and record.counts_from != "week",
            Problem(f"{begins}, in week {stamp_week}, but week is {source.week}", code="gps-week-conflict"),
        ),
    )
    scale = source.time_scale or record.time_scale
    leap = record.leap_seconds if source.leap_seconds is None else int(source.leap_seconds)
    offset_s = source.clock_offset_s or 0.0
    utc = to_utc(stamp, offset_s, scale, leap)
    attrs["time_scale"] = scale
    if scale == "gps":
        steps = np.unique((stamp - (utc - round(offset_s * NS_PER_S))) // NS_PER_S)
        attrs["leap_seconds"] = int(steps[0]) if steps.size == 1 else ", ".join(map(str, steps.tolist()))
        attrs["leap_seconds_source"] = (
            "given" if source.leap_seconds is not None else record.name if leap is not None else "IERS table"
        )
    attrs["clock_offset_s"] = float(offset_s)
    return utc, attrs


# --- the dataset -------------------------------------------------------------------------------------------


def _convention(
    source: str, own: Convention, assumed: Sequence[str], declared: Convention | Mapping[str, Any] | None
) -> Convention:
    # Return the convention of a record: its own, changed by the caller's declarations.
    choices = {} if declared is None or isinstance(declared, Convention) else declared
    SchemaError.raise_if(
        unknown := set(choices) - set(own.__dataclass_fields__),
        f"convention has no {', '.join(map(repr, sorted(unknown)))}",
        mend="see Convention",
        code="key-unknown",
    )
    chosen = declared if isinstance(declared, Convention) else own.replace(**choices)
    if "angle_unit" not in assumed and chosen.angle_unit != own.angle_unit:
        unit = own.angle_unit
        raise SchemaError(
            f"convention declares angle_unit {chosen.angle_unit!r}, {source} contains {unit}",
            mend=f"pass Convention(angle_unit={unit!r}, ...), or a mapping of the fields that differ",
            code="units-conflict",
        )
    return chosen


_MAX_BYTES = 16 << 20
_MAX_ROWS = 100_000
_MAP_COLUMNS = SimpleNamespace(
    max_coordinate=1e8,
    unit_tolerance=1e-9,  # rounding error of unit factors; international and US survey feet differ by 2e-6
    pixels=("", "1", "px", "pixel", "pixels"),
)
_NUMBERS = ("along_track", "cross_track", "east", "north", "height")
_POINT_ALIASES = {
    **dict.fromkeys(("along_track", "line", "row"), "along_track"),
    **dict.fromkeys(("cross_track", "sample", "column", "col"), "cross_track"),
    **dict.fromkeys(("east", "easting", "x", "e"), "east"),
    **dict.fromkeys(("north", "northing", "y", "n"), "north"),
    **dict.fromkeys(("height", "elevation", "z", "h", "altitude"), "height"),
    **dict.fromkeys(("flightline", "flight_line", "image"), "flightline"),
    **dict.fromkeys(("name", "point", "id", "label"), "name"),
}
_SUFFIXES = ("m", "ft", "km", "cm", "mm", "foot", "feet", "px", "usft", "ftus")
_BRACKETS = re.compile(r"[\[(]([^\[\]()]*)[\])]")
_ONE_BASED = re.compile(r"\b(?:1|one)[ -]?based|(?:from|at) (?:1|one)\b", re.IGNORECASE)
_METRES = {
    **dict.fromkeys(("m", "metre", "metres", "meter", "meters"), 1.0),
    **dict.fromkeys(("ft", "foot", "feet", "intft", "internationalfoot", "internationalfeet"), 0.3048),
    **dict.fromkeys(("usft", "ftus", "usfoot", "usfeet", "sft", "surveyfoot", "surveyfeet"), 1200 / 3937),
    **dict.fromkeys(("ussurveyfoot", "ussurveyfeet", "ussft", "sftus"), 1200 / 3937),
    **dict.fromkeys(("km", "kilometre", "kilometres", "kilometer", "kilometers"), 1000.0),
    "cm": 0.01,
    "mm": 0.001,
}
#: Words of lengths other than metres: a heading with one is refused, since metres would be assumed.
_LENGTHS = {
    *("yd", "yds", "yard", "yards", "inch", "inches", "mi", "mile", "miles", "nmi"),
    *("furlong", "furlongs", "fathom", "fathoms", "chain", "chains"),
    *(word for word, metres in _METRES.items() if metres != 1.0),
}


@documented()
def read_control_points(path: str | Path) -> xr.Dataset:
    r"""Read ground control points from a table of text.

    The header names ``along_track`` and ``cross_track`` (or ``line`` and ``sample``; pixels, whole numbers
    at their centres, counted from 0), ``east``, ``north`` (of a map) and ``height`` above the ellipsoid, in
    metres, or in the unit that follows their name, ``height [ft]`` or ``height_ft`` (other text in
    brackets, ``height (ellipsoidal)``, is a label; ``[US survey feet]`` are 1200/3937 m); ``flightline``, if
    the points belong to several flight lines; and ``name``, which is optional. Cells are separated by commas,
    semicolons or tabs. A comment ``# crs: EPSG:32617`` before the header declares the map's CRS; east and
    north are returned in its unit, which is also that of columns without a unit.

    Parameters
    ----------
    path

    Returns
    -------
    xarray.Dataset
        ``along_track_pixel``, ``cross_track_pixel`` [1], ``east``, ``north`` [m, or the unit of ``crs``],
        ``height`` [m] (point), float64, coordinates ``name`` and ``flightline`` (str; empty if the file
        has none), and the attribute ``crs`` if the file declares it.

    Raises
    ------
    FormatError
        The file cannot be read; columns are missing, duplicate, or not in a unit of length; cells
        are not finite numbers; the first problems are listed.
    MissingExtraError
        The file declares a CRS and coordinates in another unit than metres, and pyproj is not installed.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "points.csv"
    ...     _ = path.write_text("# crs: EPSG:32617\nname,line,sample,east,north,height\nA,10.5,3,1,2,50\n")
    ...     points = read_control_points(path)
    >>> points.attrs["crs"], points.along_track_pixel.values.tolist(), points.name.values.tolist()
    ('EPSG:32617', [10.5], ['A'])
    """
    path = as_path(path)
    text = decoded_text(read_limited_text(path, _MAX_BYTES, "a table of control points"))
    rows = [(number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip()]
    comments = [line for _, line in rows if line.lstrip().startswith("#")]
    rows = [(number, line) for number, line in rows if not line.lstrip().startswith("#")]
    FormatError.raise_if(
        len(rows) < 2 or len(rows) > _MAX_ROWS,
        f"{path}: {max(len(rows) - 1, 0)} points",
        expected=f"a header and 1 to {_MAX_ROWS}",
        code="table-missing",
    )
    separator = next((separator for separator in ("\t", ";", ",") if separator in rows[0][1]), ",")
    cells = cells_of(rows[0][1], separator)
    headings = [column_heading(cell) for cell in cells]
    header = [_POINT_ALIASES.get(name, "") for name, _ in headings]
    units = dict(zip(header, (unit for _, unit in headings), strict=True))
    with Problems(f"{path} cannot be used as control points", FormatError) as problems:
        for name in _NUMBERS:
            problems.add_if(
                header.count(name) != 1,
                f"{header.count(name)} columns for {name!r} in {rows[0][1][:80]!r}",
                expected="one column",
                code="column-missing",
            )
        origins = [cell for name, cell in zip(header, cells, strict=True) if name.endswith("_track")]
        origins += [comment for comment in comments if re.search("based|count|start", comment)]
        for text in origins:
            problems.add_if(
                _ONE_BASED.search(text),
                f"the heading or comment {text.strip()[:40]!r}",
                expected="pixels counted from 0",
                mend="subtract 1",
                code="pixel-origin",
            )
    table = table_of(path, header, [(number, cells_of(line, separator)) for number, line in rows[1:]])
    # the last comment with a CRS is valid
    pairs = (comment.lstrip("# \t").partition(":") for comment in comments)
    crs_texts = [value.strip() for key, _, value in pairs if key.strip().lower() == "crs" and value.strip()]
    crs = crs_texts[-1][:10_000] if crs_texts else None
    map_units = {units[name] for name in ("east", "north")} - {""}
    # metres do not require pyproj, which is needed only to convert another unit
    needs_axis = crs and (
        any(_metres(unit) != 1.0 for unit in map_units) or (map_units and find_spec("pyproj"))
    )
    axis = _map_axis(crs, problems) if crs and needs_axis else None
    numbers = {
        name: limited_numbers(table, name, _MAP_COLUMNS.max_coordinate, problems)
        * _factor(name, units[name], problems, axis if name in ("east", "north") else None)
        for name in _NUMBERS
    }
    for name, values in numbers.items():
        problems.add_if(
            np.isnan(values).any(),
            f"column {name!r} is not finite in {name_rows(table.rows[np.isnan(values)])}",
            code="not-finite",
        )
    problems.raise_if_any()
    map_unit = "m" if axis is None or axis[1] == 1.0 else axis[0]
    # variable and unit by the name of a column
    meanings = {
        "along_track": ("along_track_pixel", "1"),
        "cross_track": ("cross_track_pixel", "1"),
        "east": ("east", map_unit),
        "north": ("north", map_unit),
        "height": ("height", "m"),
    }
    texts = {name: table.columns.get(name, [""] * len(table.rows)) for name in ("name", "flightline")}
    points = xr.Dataset(
        {
            meanings[name][0]: ("point", values, {"units": meanings[name][1]})
            for name, values in numbers.items()
        },
        coords={
            name: ("point", np.array([cell.strip()[:200] for cell in cells], dtype=str))
            for name, cells in texts.items()
        },
        attrs={"source": path.name},
    )
    return points if crs is None else points.assign_attrs(crs=crs)


def _map_axis(crs: str, problems: Problems) -> tuple[str, float] | None:
    # Return the unit of the axes of a CRS, and its size in metres or radians.
    with needs_extra("pyproj", "geo", "the unit of a map of control points"):
        import pyproj
    try:
        with warnings.catch_warnings(action="ignore"):
            axes = pyproj.CRS.from_user_input(crs).to_2d().axis_info
    except (pyproj.exceptions.CRSError, ValueError):
        axes = []
    units = {(axis.unit_name, axis.unit_conversion_factor) for axis in axes}
    if len(units) != 1:
        problems.add(
            f"crs {crs[:80]!r} is unknown, or its axes have no common unit",
            expected="a CRS such as 'EPSG:32617'",
            code="crs-unknown",
        )
        return None
    return units.pop()


def column_heading(cell: str) -> tuple[str, str]:
    """Return the name in a column's heading, and its unit, empty without one.

    Examples
    --------
    >>> column_heading("Easting [m]"), column_heading("height_ft"), column_heading("Line (0-based)")
    (('easting', 'm'), ('height', 'ft'), ('line', ''))
    """
    bracket_texts = [
        text.strip() for content in _BRACKETS.findall(cell) for text in re.split("[,;]", content)
    ]
    unit = next(
        (
            text
            for text in bracket_texts
            if _metres(text)
            or text.lower() in (*_MAP_COLUMNS.pixels, "in")
            # a unit, rather than a label
            or is_unit(text)
            or same_dimension(text, "m")
            or not _LENGTHS.isdisjoint(re.findall("[a-z]+", text.lower()))
        ),
        "",
    )
    name = "_".join(_BRACKETS.sub(" ", cell).lower().split())
    if not unit and name.rpartition("_")[2] in _SUFFIXES:
        name, _, unit = name.rpartition("_")
    return name, unit


def metres_of(name: str, unit: str, problems: Problems) -> float:
    # Return the size of a column's unit in metres; 1 without a unit, and for a wrong one, which is noted.
    metres = _metres(unit or "m")
    problems.add_if(
        metres is None,
        f"column {name!r} in {unit!r:.40}",
        expected="a unit of length, such as [m] or [ft]",
        code="units-unknown",
    )
    return metres or 1.0


def _metres(unit: str) -> float | None:
    return _METRES.get(re.sub(r"[ ._-]", "", unit).lower())


def _factor(name: str, unit: str, problems: Problems, axis: tuple[str, float] | None = None) -> float:
    # Return the size of a column's unit in metres, pixels, or units of the CRS axis; 1 without a unit.
    if name.endswith("_track"):
        problems.add_if(
            unit.lower() not in _MAP_COLUMNS.pixels,
            f"column {name!r} in {unit!r:.40}",
            expected="pixels, counted from 0",
            code="units-unknown",
        )
        return 1.0
    if axis is None or not unit:
        return metres_of(name, unit, problems)
    axis_unit, axis_unit_size = axis
    # "ft" with a CRS in US survey feet means US survey feet
    if unit.lower() in ("ft", "foot", "feet") and "foot" in axis_unit.lower():
        return 1.0
    if _metres(axis_unit) is None:
        problems.add_if(
            unit.lower() != axis_unit.lower()
            and not (axis_unit == "degree" and unit.lower().startswith(("deg", "°"))),
            f"column {name!r} in {unit!r:.40}",
            expected=f"{axis_unit!r}, the unit of the crs",
            code="units-conflict",
        )
        return 1.0
    factor = metres_of(name, unit, problems) / axis_unit_size
    return 1.0 if abs(factor - 1.0) < _MAP_COLUMNS.unit_tolerance else factor
