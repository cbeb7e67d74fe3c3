"""Clocks: GPS time, leap seconds, corrections, and a clock tied to UTC at knots.

Only corrections that the caller asks for are applied.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hyperpaint.base.errors import TimeError, warn_user
from hyperpaint.base.facts import one_of
from hyperpaint.io.files.text_tables import name_rows
from hyperpaint.io.flightline.headwall import check_increasing

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
