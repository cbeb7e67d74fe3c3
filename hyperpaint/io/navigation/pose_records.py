"""A navigation file as its reader leaves it: stamps, poses, and what their numbers mean.

Readers of a format fill a `PoseRecord`; `navigation_opening` turns its stamps into UTC and labels it.
"""

from __future__ import annotations

import datetime
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import Problems, TimeError

from .clocks import NS_PER_S, ClockCorrection
from .navigation_records import LIMITS

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = [
    "GPS_EPOCH", "POSE", "WEEK_S", "PoseRecord", "TimeSource", "check_poses", "check_seconds",
    "check_time_order", "nanoseconds", "unwrap_weeks", "utc_of_record",
]  # fmt: skip

POSE = tuple(LIMITS)
"""``latitude longitude altitude roll pitch heading``."""
_ANGLES = ("roll", "pitch", "heading")


@dataclass(frozen=True)
class PoseRecord:
    """One navigation file."""

    name: str  # file name, for messages
    format: str  # what the file is
    stamp: NDArray[np.int64]  # nanoseconds, (row,)
    # ``"1970"``, as the clock shows it; or the start of a GPS ``"week"``
    counts_from: Literal["1970", "week"]
    # `POSE` (row,), float64: latitude and longitude [degree], altitude [m], angles in the unit of the
    # convention; NaN where unknown
    values: Mapping[str, NDArray[np.float64]] = field(repr=False)
    convention: Convention  # what the numbers mean, as far as the format or the file says
    assumed: tuple[str, ...] = ()  # fields of the convention that nothing published states
    time_scale: Literal["gps", "utc"] = "gps"  # what the stamps count, unless the caller knows better
    week: int | None = None  # what the file itself says
    leap_seconds: int | None = None
    # Further columns (row,) with their attributes
    others: Mapping[str, tuple[NDArray[Any], Mapping[str, str]]] = field(default_factory=dict, repr=False)
    attrs: Mapping[str, Any] = field(default_factory=dict)  # anything else that is to be kept


def check_poses(values: Mapping[str, NDArray[np.float64]], unit: str, problems: Problems, row: str) -> None:
    """Note positions and angles that are none, NaN allowed.

    values: `POSE`: latitude and longitude [degree], altitude [m].
    unit: Of roll, pitch and heading: ``"degree"`` or ``"radian"``.
    problems: Takes what is wrong.
    row: What a row of the file is called in messages.
    """
    for name, limit in LIMITS.items():
        # a heading less an angle of wander may pass a full turn
        most = 2.0 * np.pi * 1.25 if name in _ANGLES and unit == "radian" else limit * 1.25
        most = limit if name not in _ANGLES else most
        with np.errstate(invalid="ignore"):
            wrong = np.flatnonzero(~(np.abs(values[name]) <= most) & ~np.isnan(values[name]))
        if wrong.size:
            where = _numbered(row, wrong + 1)
            problems.add(f"{name} is {values[name][wrong[0]]:g} in {where}, expected within +-{most:.4g}")


def check_time_order(name: str, stamp: NDArray[np.int64], row: str) -> None:
    """Refuse a record whose time runs backwards.

    Raises TimeError: It does; the rows are named.
    """
    wrong = np.flatnonzero(np.diff(stamp) < 0) + 2
    if wrong.size:
        raise TimeError(f"{name}: time runs backwards in {_numbered(row, wrong)}; delete or re-order them")


def check_seconds(name: str, seconds: NDArray[np.float64], most: float, problems: Problems, row: str) -> None:
    """Note times that are not finite, negative, or beyond ``most`` seconds."""
    wrong = np.flatnonzero(~((seconds >= 0.0) & (seconds <= most)))
    if wrong.size:
        problems.add(
            f"time is {seconds[wrong[0]]:g} s in {_numbered(row, wrong + 1)}, expected 0 to {most:g} s; "
            f"is {name} of this format?"
        )


def _numbered(row: str, numbers: Sequence[int] | NDArray[np.int64]) -> str:
    """Return ``"record 7"`` or ``"records 7, 9, 11 ... (40 in all)"`` for a message."""
    shown = ", ".join(str(int(number)) for number in numbers[:5])
    if len(numbers) == 1:
        return f"{row} {shown}"
    return f"{row}s {shown}" + (f" ... ({len(numbers)} in all)" if len(numbers) > 5 else "")


WEEK_S = 604_800
GPS_EPOCH: int = np.datetime64("1980-01-06", "ns").astype(np.int64).item()
"""Nanoseconds from 1970 to the beginning of GPS time, on its own clock."""
_DATE = re.compile(r"[0-9]{4}-[0-9]{2}-[0-9]{2}")
_DAY_NS = 86_400 * NS_PER_S
_LAST_WEEK = 11_479
"""Of the year 2199: nanoseconds overflow in the 23rd century."""


@dataclass(frozen=True)
class TimeSource:
    """What the caller says of the clock of a navigation record; see `open_navigation`."""

    week: int | None = None
    date: str | datetime.date | None = None
    leap_seconds: int | None = None
    time_scale: Literal["gps", "utc"] | None = None
    clock_offset_s: float | None = None

    def check(self) -> None:
        """Raise one error that lists what cannot be.

        Raises TimeError: A week, date, number of leap seconds, time scale or offset that does not exist.
        """
        problems = Problems("the clock of the navigation cannot be as described", TimeError)
        week, leap = self.week, self.leap_seconds
        if week is not None and not (_is_whole(week) and 0 <= week <= _LAST_WEEK):
            problems.add(f"week {week!r:.40}, expected the number of weeks since 1980-01-06, such as 2158")
        if leap is not None and not (_is_whole(leap) and 0 <= leap <= 100):
            problems.add(f"leap_seconds {leap!r:.40}, expected GPS minus UTC in whole seconds, such as 18")
        if self.time_scale not in (None, "gps", "utc"):
            problems.add(f"time_scale {self.time_scale!r:.40}, expected 'gps' or 'utc'")
        if self.date is not None and self.midnight is None:
            problems.add(f"date {str(self.date)!r:.40}, expected one like '2024-06-01'")
        offset = self.clock_offset_s
        if offset is not None and not abs(offset) <= 1e9:
            problems.add(f"clock_offset_s {offset!r:.40}, expected seconds, at most 1e9 either way")
        problems.raise_if_any()

    @property
    def midnight(self) -> int | None:
        """Nanoseconds from 1970 to 0 h of the date; None where there is none, or it is no date."""
        text = str(self.date)
        if self.date is None or not _DATE.fullmatch(text) or not "1980-01-06" <= text < "2199-12-25":
            return None
        try:
            return int(np.datetime64(text, "ns").astype(np.int64))
        except ValueError:  # the 31st of a shorter month
            return None


def _is_whole(value: Any) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def nanoseconds(seconds: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return seconds, finite and below 1e10, as whole nanoseconds; the whole part keeps every digit."""
    whole = np.floor(seconds)
    whole_ns: NDArray[np.int64] = whole.astype(np.int64) * NS_PER_S
    return whole_ns + np.round((seconds - whole) * NS_PER_S).astype(np.int64)


def unwrap_weeks(stamp: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return nanoseconds of the week that count on where the seconds begin anew at the end of a week."""
    back = np.diff(stamp) < -(WEEK_S // 2) * NS_PER_S
    weeks = np.concatenate([np.zeros(1, np.int64), np.cumsum(back, dtype=np.int64)])
    unwrapped: NDArray[np.int64] = stamp + weeks * (WEEK_S * NS_PER_S)
    return unwrapped


def utc_of_record(record: PoseRecord, source: TimeSource) -> tuple[NDArray[np.int64], dict[str, Any]]:
    """Return UTC [ns since 1970-01-01] of the rows of a record, and attributes that say how it came about.

    Raises TimeError: Seconds of the week without a week or date; a week or date that the stamps contradict;
        times before GPS time began.
    Warns PaintWarning: Times beyond the table of leap seconds, ``leap_seconds`` not given.
    """
    stamp = record.stamp
    attrs: dict[str, Any] = {}
    if record.counts_from == "week":
        week, said = _week_of(record, source)
        stamp = stamp + (GPS_EPOCH + week * WEEK_S * NS_PER_S)
        attrs = {"gps_week": week, "gps_week_source": said}
    _refuse_another_date(record, int(stamp[0]), source)
    scale = source.time_scale or record.time_scale
    leap = record.leap_seconds if source.leap_seconds is None else int(source.leap_seconds)
    correction = ClockCorrection(source.clock_offset_s or 0.0, scale, leap)
    utc = correction.apply(stamp)
    attrs["time_scale"] = scale
    if scale == "gps":
        steps = np.unique((stamp - (utc - round(correction.offset_s * NS_PER_S))) // NS_PER_S)
        attrs["leap_seconds"] = int(steps[0]) if steps.size == 1 else ", ".join(map(str, steps.tolist()))
        attrs["leap_seconds_source"] = (
            "given" if source.leap_seconds is not None else record.name if leap is not None else "IERS table"
        )
    attrs["clock_offset_s"] = float(correction.offset_s)
    return utc, attrs


def _week_of(record: PoseRecord, source: TimeSource) -> tuple[int, str]:
    """Return the GPS week in which the stamps count, and who says so."""
    if source.week is not None:
        return int(source.week), "given"
    if source.midnight is not None:
        # the week that brings the first row nearest to noon of the day: a date may be local
        noon = source.midnight + _DAY_NS // 2 - GPS_EPOCH
        return max(0, round((noon - int(record.stamp[0])) / (WEEK_S * NS_PER_S))), "from the date given"
    if record.week is not None:
        return record.week, f"said by {record.name}"
    first = int(record.stamp[0]) // NS_PER_S
    day = ("Sunday", "Monday", "Tuesday", "Wednesday", "Thursday", "Friday", "Saturday")[first // 86_400 % 7]
    raise TimeError(
        f"{record.name} counts seconds of a GPS week (from {first} s: a {day}) and does not say which week; "
        "give week=, the weeks since 1980-01-06, or date='YYYY-MM-DD' of the flight"
    )


def _refuse_another_date(record: PoseRecord, first: int, source: TimeSource) -> None:
    problems = Problems(f"{record.name} is of another day than was given", TimeError)
    shown = np.datetime64(first // NS_PER_S, "s")
    if source.midnight is not None and abs(first - source.midnight - _DAY_NS // 2) > 1.5 * _DAY_NS:
        problems.add(f"it begins at {shown}, date is {source.date}; correct the one that is wrong")
    if source.week is not None and record.counts_from != "week":
        stamp_week = (first - GPS_EPOCH) // (WEEK_S * NS_PER_S)
        if stamp_week != source.week:
            problems.add(f"it begins at {shown}, in week {stamp_week}; week is {source.week}")
    problems.raise_if_any()
