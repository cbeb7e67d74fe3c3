"""Clocks: GPS time, leap seconds, corrections, and a clock tied to UTC at knots.

Offsets and leap seconds are data: nothing is corrected that the caller did not ask for.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hyperpaint.base.errors import PaintWarning, TimeError
from hyperpaint.io.files.text_tables import name_rows
from hyperpaint.io.flightline.headwall import check_increasing

#: GPS time minus UTC [s] from 0 h UTC of a day on (IERS ``leap-seconds.list``: TAI - UTC less 19 s).
LEAP_SECONDS: Mapping[str, int] = {
    "1980-01-06": 0, "1981-07-01": 1, "1982-07-01": 2, "1983-07-01": 3, "1985-07-01": 4, "1988-01-01": 5,
    "1990-01-01": 6, "1991-01-01": 7, "1992-07-01": 8, "1993-07-01": 9, "1994-07-01": 10, "1996-01-01": 11,
    "1997-07-01": 12, "1999-01-01": 13, "2006-01-01": 14, "2009-01-01": 15, "2012-07-01": 16,
    "2015-07-01": 17, "2017-01-01": 18,
}  # fmt: skip

#: Day until which `LEAP_SECONDS` is valid (IERS); later times get the last value, with a warning.
LEAP_SECONDS_EXPIRY = "2026-06-28"

#: NaT of a datetime64 as an integer.
NAT = np.iinfo(np.int64).min

NS_PER_S = 1_000_000_000
WEEK_S = 604_800
#: Nanoseconds from 1970 to the beginning of GPS time, on its own clock.
GPS_EPOCH: int = np.datetime64("1980-01-06", "ns").astype(np.int64).item()
_NS_PER_US = 1000
_MAX_OFFSET_S = 1e9
_DAY = 86_400_000_000  # us
_CLOCK_STEP = 200 * 1_000_000  # ns: no two clocks drift this far apart between neighbouring rows


def gps_to_utc(gps: NDArray[np.int64], leap_seconds: int | None = None) -> NDArray[np.int64]:
    """Convert GPS time to UTC.

    gps: Nanoseconds since 1970-01-01 as a GPS clock shows them, any shape.
    leap_seconds: GPS minus UTC [s]; by default from `LEAP_SECONDS`.
    Warns PaintWarning: Times beyond `LEAP_SECONDS_EXPIRY`, ``leap_seconds`` not given.
    Raises TimeError: Times before GPS time began.

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
    place = np.searchsorted(days + offsets * NS_PER_S, gps, side="right") - 1
    if np.any(place < 0):
        raise TimeError(
            "times before 1980-01-06, when GPS time began",
            mend="check that this clock counts GPS time",
            code="time-before-gps",
        )
    if np.any(gps > np.datetime64(LEAP_SECONDS_EXPIRY, "ns").astype(np.int64)):
        warnings.warn(
            PaintWarning(
                (
                    f"leap seconds are known until {LEAP_SECONDS_EXPIRY}, and {offsets[-1]} s is used for "
                    "later times; check it, and pass gps_leap_seconds"
                ),
                code="leap-seconds-expired",
            ),
            stacklevel=2,
        )
    utc: NDArray[np.int64] = gps - offsets[place] * NS_PER_S
    return utc


def nanoseconds(seconds: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return seconds, finite and below 1e10, as whole nanoseconds without loss of digits."""
    whole = np.floor(seconds)
    whole_ns: NDArray[np.int64] = whole.astype(np.int64) * NS_PER_S
    return whole_ns + np.round((seconds - whole) * NS_PER_S).astype(np.int64)


def unwrap_weeks(stamp: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return nanoseconds of the week that continue past the end of the week."""
    back = np.diff(stamp) < -(WEEK_S // 2) * NS_PER_S
    weeks = np.concatenate([np.zeros(1, np.int64), np.cumsum(back, dtype=np.int64)])
    unwrapped: NDArray[np.int64] = stamp + weeks * (WEEK_S * NS_PER_S)
    return unwrapped


def instants(texts: Sequence[str]) -> NDArray[np.datetime64]:
    """Return texts like ``2024-06-01T12:00:00.5`` as times [ns]; NaT for dates outside the calendar."""
    try:
        return np.array(texts, "datetime64[ns]")
    except ValueError:  # the 31st of a shorter month, the 25th hour
        return np.array([_instant(text) for text in texts])


def _instant(text: str) -> np.datetime64:
    try:
        return np.datetime64(text, "ns")
    except ValueError:
        return np.datetime64("NaT", "ns")


def refuse_backwards(
    name: str, stamp: NDArray[np.int64], rows: NDArray[np.int64] | None = None, row: str = "line"
) -> None:
    """Refuse a record whose time runs backwards.

    rows: Numbers of its rows in the file, by default from 1 on; row: name of a row in messages.
    Raises TimeError: It does; the rows are named.
    """
    wrong = np.flatnonzero(np.diff(stamp) < 0) + 1
    if wrong.size:
        numbers = wrong + 1 if rows is None else rows[wrong]
        raise TimeError(
            f"{name}: time runs backwards in {name_rows(numbers, row)}",
            mend="delete or reorder them",
            code="time-unordered",
        )


@dataclass(frozen=True)
class ClockCorrection:
    """Conversion of the time stamps of a navigation record to UTC."""

    offset_s: float = 0.0  # UTC = stamp + ``offset_s`` [s]
    # Time scale of the stamps: ``"utc"``, or ``"gps"``, from which leap seconds are subtracted
    time_scale: Literal["utc", "gps"] = "utc"
    leap_seconds: int | None = None  # GPS minus UTC [s], in place of `LEAP_SECONDS`

    def __post_init__(self) -> None:
        if not abs(self.offset_s) <= _MAX_OFFSET_S:
            raise TimeError(
                f"clock offset {self.offset_s} s",
                expected=f"at most {_MAX_OFFSET_S:g} s either way",
                code="value-out-of-range",
            )
        if self.time_scale not in ("utc", "gps"):
            raise TimeError(
                f"time_scale {self.time_scale!r}", expected="'utc' or 'gps'", code="choice-unknown"
            )

    def apply(self, stamp: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return UTC in nanoseconds since 1970-01-01."""
        if self.time_scale == "gps":
            stamp = gps_to_utc(stamp, self.leap_seconds)
        return stamp + round(self.offset_s * NS_PER_S)


@dataclass(frozen=True)
class Clock:
    """A clock tied to UTC at knots, linear between them."""

    stamp: NDArray[np.int64]  # microseconds of the clock, strictly increasing, (knot,)
    utc: NDArray[np.int64]  # nanoseconds since 1970-01-01, strictly increasing, (knot,)
    source: str  # source of the knots
    daily: bool = False  # the stamps are times of day, so that one past midnight may be a day early or late

    def at(self, stamp: NDArray[np.int64]) -> NDArray[np.datetime64]:
        """Return UTC [datetime64[ns]] at stamps, NaT before the first and after the last knot."""
        if self.daily:
            stamp = stamp + next((d for d in (0, _DAY, -_DAY) if overlap(stamp + d, self.stamp)), 0)
        place, weight, inside = bracket(self.stamp, stamp)
        step = (self.utc[np.minimum(place + 1, len(self.utc) - 1)] - self.utc[place]).astype(np.float64)
        utc = self.utc[place] + np.round(weight * step).astype(np.int64)
        return np.where(inside, utc, NAT).astype("datetime64[ns]")


def overlap(first: NDArray[np.int64], second: NDArray[np.int64]) -> bool:
    """Return whether the ranges of two arrays overlap."""
    return bool(first.min() <= second.max() and first.max() >= second.min())


def bracket(
    knots: NDArray[np.int64], at: NDArray[np.int64]
) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.bool_]]:
    """Return the knot before, the weight of the knot after, and whether a time lies inside the knots."""
    inside = (at >= knots[0]) & (at <= knots[-1])
    place = np.clip(np.searchsorted(knots, at, side="right") - 1, 0, max(len(knots) - 2, 0))
    # differences of int64 first: an absolute time in float64 would lose 100 ns
    width = np.maximum(knots[np.minimum(place + 1, len(knots) - 1)] - knots[place], 1)
    return place, np.where(inside, at - knots[place], 0) / width, inside


def tie_clock(
    stamp: NDArray[np.int64],
    utc: NDArray[np.int64],
    rows: NDArray[np.int64],
    source: str,
    *,
    daily: bool = False,
) -> Clock:
    """Return a clock from rows of stamps and UTC, checked to run together."""
    check_increasing(stamp, rows, source)
    refuse_backwards(f"{source}, UTC", utc, rows)
    # a receiver slower than the log repeats its time: a new value counts from its first row
    first = np.concatenate([[True], np.diff(utc) > 0])
    stamp, utc, rows = stamp[first], utc[first], rows[first]
    drift = np.diff(utc).astype(np.float64) - np.diff(stamp).astype(np.float64) * _NS_PER_US
    steps = np.flatnonzero(np.abs(drift) > _CLOCK_STEP)
    if steps.size:
        raise TimeError(
            (
                f"{source}: UTC steps by {drift[steps[0]] / NS_PER_S:+.3f} s against the clock of the "
                f"stamps in {name_rows(rows[steps + 1])} (the receiver applied leap seconds?)"
            ),
            mend="cut the record there",
            code="clock-step",
        )
    return Clock(stamp, utc, source, daily)
