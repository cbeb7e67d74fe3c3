"""Time and position of the exposure of each line of a cube, from frame index, clocks and navigation."""

import datetime
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hyperpaint.base.constants import MID_EXPOSURE_OFFSETS
from hyperpaint.base.errors import Problems, TimeError, warn_user
from hyperpaint.base.facts import one_of
from hyperpaint.io.navigation.navigation_records import (
    NS_PER_S,
    Clock,
    ClockCorrection,
    Navigation,
    midnight_of,
    read_gps_time,
    read_imu_gps,
)

from .headwall import FrameIndex, cube_number, match_frames, read_frame_index

_MAX_EXPOSURE_S = 3600.0
_DAY_US = 86_400_000_000
#: Source of the times of lines without times.
UNKNOWN_TIMES = "unknown"
_MAX_INTERVAL_S = 1e4


@dataclass(frozen=True)
class Timing:
    # Clock settings of one flight line; see `hyperpaint.open_flightline`.
    frame_index: Path | None = None
    nav: Path | Navigation | None = None
    gps_time: Path | None = None
    date: str | None = None
    start_time: Any = None
    frame_period: float | None = None
    stamp: str = "end"
    clock_offset_s: float | None = None
    time_scale: Literal["utc", "gps"] = "utc"
    gps_leap_seconds: int | None = None
    max_gap_s: float | None = None

    @property
    def correction(self) -> ClockCorrection:
        # Correction of the navigation's stamps to UTC.
        return ClockCorrection(self.clock_offset_s or 0.0, self.time_scale, self.gps_leap_seconds)


@dataclass(frozen=True)
class LineTimes:
    # Times and poses of the lines of a cube.

    frame: NDArray[np.int64]  #: (along_track,): Frame numbers.
    recorded: NDArray[np.bool_]  #: (along_track,): False where the frame was dropped and the line is blank.
    time: NDArray[np.datetime64]  #: (along_track,): UTC at mid exposure, NaT where unknown.
    #: ``latitude`` to ``heading`` (along_track,), float64, by name; empty without navigation.
    pose: Mapping[str, NDArray[np.float64]] = field(repr=False)
    dropped: int  #: Number of frames missing between the first and the last line, blank lines included.
    source: str  #: Source of the times.

    @classmethod
    def unknown(cls, lines: int) -> "LineTimes":
        # Return the numbers of lines that have no times.
        return cls(
            np.arange(lines),
            np.ones(lines, bool),
            np.full(lines, np.datetime64("NaT", "ns"), "datetime64[ns]"),
            {},
            0,
            UNKNOWN_TIMES,
        )


def utc_of(value: Any, name: str) -> np.datetime64:
    """Return an instant as datetime64[ns] UTC.

    ``value``: ISO text or a datetime, both with a zone, or a numpy.datetime64, which is UTC; ``name``: name
    of the value in messages.

    Raises `TimeError`: The value is unreadable, or without a zone.

    Examples
    --------
    >>> utc_of("2024-06-01T14:00:00+02:00", "start_time")
    np.datetime64('2024-06-01T12:00:00.000000000')
    """
    if isinstance(value, np.datetime64) and not np.isnat(value):
        return np.datetime64(value.astype("datetime64[ns]").astype(np.int64).item(), "ns")
    if isinstance(value, str):
        try:
            value = datetime.datetime.fromisoformat(value.strip())
        except ValueError as error:
            raise TimeError(
                f"{name} {value[:60]!r} is not a time",
                expected="a time such as '2024-06-01T12:00:00Z'",
                code="time-unreadable",
            ) from error
    if not isinstance(value, datetime.datetime) or value.tzinfo is None:
        raise TimeError(
            f"{name} {value!s:.60} has no zone",
            mend="write '2024-06-01T12:00:00Z', or '-05:00' at the end",
            code="zone-missing",
        )
    TimeError.raise_if(
        not 1980 <= value.year <= 2200,
        f"{name} {value!s:.60} is out of range",
        expected="a year from 1980 to 2200",
        code="value-out-of-range",
    )
    return np.datetime64(value.astimezone(datetime.UTC).replace(tzinfo=None), "ns")


def line_times(
    cube: Path,
    lines: int,
    timing: Timing,
    exposure_time: float | NDArray[np.float64] = 0.0,
    *,
    shortened: bool = False,
) -> LineTimes:
    # Return times and poses of the lines of a cube, from frame index, clocks and navigation.
    #
    # The stamp of a line in the instrument's microseconds is converted to UTC by linear interpolation, in
    # int64, between rows of the navigation record that have both clocks; nothing is extrapolated. Half an
    # exposure leads from the start or end of an exposure to its middle.
    #
    # ``cube``: path of the cube, whose name ``raw_<N>`` states its first frame; ``lines``: its number of
    # lines; ``timing``: the sources; ``exposure_time``: seconds, scalar or (along_track,); ``shortened``:
    # whether the file was cut short, so that its frame index may have more rows than the cube has lines.
    #
    # Raises `FormatError`: A side file is damaged, or the frame index does not fit the cube. Raises
    # `TimeError`: Sources are missing or contradict each other, or no line lies within the navigation record.
    #
    # Warns `PaintWarning`: Lines outside the navigation record; a frame period or exposure that the stamps
    # contradict; stamps of whole seconds.
    problems = Problems("the clocks of the flight cannot be used as described", TimeError)
    one_of(timing.stamp, MID_EXPOSURE_OFFSETS, "stamp", problems=problems)
    exposure_s = float(np.max(exposure_time, initial=0.0))
    problems.add_if(
        exposure_s > _MAX_EXPOSURE_S,
        f"an exposure of {exposure_s:g} s",
        expected=f"at most {_MAX_EXPOSURE_S:g} s",
        code="value-out-of-range",
    )
    for name, seconds in (("frame_period", timing.frame_period), ("nav_max_gap_s", timing.max_gap_s)):
        problems.add_if(
            seconds is not None and not 0 < seconds <= _MAX_INTERVAL_S,
            f"{name} {seconds} s",
            expected="a positive number",
            code="value-out-of-range",
        )
    problems.raise_if_any()
    index = read_frame_index(timing.frame_index) if timing.frame_index is not None else None
    nav = read_imu_gps(timing.nav, timing.correction) if isinstance(timing.nav, Path) else timing.nav
    if index is None:
        frame = np.arange(lines, dtype=np.int64) + (cube_number(cube) or 0)
        row = np.arange(lines)
    else:
        frame, row = match_frames(index, lines, cube, shortened=shortened)
    recorded = row >= 0
    clock = _clock(timing, index, nav, row[recorded], cube)
    time = np.full(lines, np.datetime64("NaT", "ns"), "datetime64[ns]")
    if index is not None:
        time[recorded] = clock.at(index.stamp[row[recorded]])
        _check_rate(index, row[recorded], timing, exposure_time, cube)
    else:
        time = clock.at(np.zeros(1, np.int64)) + np.round(
            (frame - frame[0]) * (NS_PER_S * float(timing.frame_period or 0.0))
        ).astype("timedelta64[ns]")
    outside = np.isnat(time[recorded])
    if outside.any():
        TimeError.raise_if(
            outside.all(),
            f"{cube.name}: no line lies inside {clock.source}",
            mend="pass the record of this flight",
            code="time-uncovered",
        )
        missing = np.flatnonzero(outside)
        warn_user(
            f"{cube.name}: {len(missing)} of {len(outside)} lines ({missing[0]} to {missing[-1]}) lie "
            f"outside {clock.source} and have no time and position",
            "time-uncovered",
        )
    # from the stamped instant of the exposure to its middle
    to_middle = np.asarray(exposure_time) * MID_EXPOSURE_OFFSETS[timing.stamp]
    time = time + np.round(to_middle * NS_PER_S).astype("timedelta64[ns]")
    pose = {} if nav is None else nav.dated_by(clock).at(time, timing.max_gap_s)
    dropped = int(frame[-1] - frame[0]) + 1 - int(recorded.sum()) if lines else 0
    return LineTimes(frame, recorded, time, pose, dropped, clock.source)


def _clock(
    timing: Timing, index: FrameIndex | None, nav: Navigation | None, rows: NDArray[np.intp], cube: Path
) -> Clock:
    if timing.start_time is not None:
        TimeError.raise_if(
            index is not None and nav is not None and nav.utc is not None,
            f"{cube.name}: both start_time and a navigation record with UTC",
            mend="pass one of them",
            code="option-conflict",
        )
        start = utc_of(timing.start_time, "start_time").astype(np.int64)
        TimeError.raise_if(
            index is None and not timing.frame_period,
            f"{cube.name}: start_time without frame_index or frame_period",
            mend="pass one of them",
            code="argument-missing",
        )
        return _steady(0 if index is None else int(index.stamp[rows[0]]), int(start), "start_time")
    if index is None:
        files = ", ".join(
            name
            for name in (f"frameIndex_{cube_number(cube)}.txt", "imu_gps.txt")
            if (cube.parent / name).is_file()
        )
        beside = f" (beside the cube: {files})" if files else ""
        raise TimeError(
            f"{cube.name}: no line times",
            mend=f"pass frame_index and nav, or start_time and frame_period{beside}",
            code="time-missing",
        )
    if index.clock == "time of day" and timing.gps_time is not None:
        return read_gps_time(timing.gps_time, timing.correction)
    if index.clock == "time of day" and timing.date is not None:
        # midnight of the date on the recording computer's clock
        midnight = midnight_of(timing.date)
        if midnight is None:
            raise TimeError(
                f"date {str(timing.date)[:40]!r}",
                expected="a date such as '2024-06-01'",
                code="time-unreadable",
            )
        TimeError.raise_if(
            timing.clock_offset_s is None,
            "date without clock_offset_s",
            mend="pass clock_offset_s = UTC minus the computer's clock (0.0 for a clock in UTC)",
            code="clock-offset-missing",
        )
        return _steady(0, int(timing.correction.apply(np.array([midnight]))[0]), "date and time of day")
    if nav is None:
        raise TimeError(
            f"{cube.name}: {index.name} has no UTC",
            mend="pass nav (imu_gps.txt), or start_time",
            code="time-missing",
        )
    return nav.clock_for(index)


def _steady(stamp: int, utc: int, source: str) -> Clock:
    # A clock without drift, from one stamp and its UTC
    span = np.array([-10 * _DAY_US, 10 * _DAY_US], np.int64)
    return Clock(stamp + span, utc + span * 1000, source)


def _check_rate(
    index: FrameIndex,
    rows: NDArray[np.intp],
    timing: Timing,
    exposure_time: float | NDArray[np.float64],
    cube: Path,
) -> None:
    # Warn where stated period, exposure and stamps contradict one another
    def warn(text: str, code: str) -> None:
        warn_user(f"{cube.name}: {text}", code)

    if index.fitted:
        warn(f"{index.name} has whole seconds: line times are from a straight line fit", "time-rounded")
    if len(rows) < 2:
        return
    period = float(np.median(np.diff(index.stamp[rows]) / np.diff(index.frame[rows]))) * 1e-6
    stated = timing.frame_period
    if stated and abs(period / stated - 1.0) > 0.05:
        text = f"{index.name} has {period * 1e3:.4g} ms a frame; its stamps are used"
        warn(f"frame_period {stated * 1e3:g} ms, but {text}", "frame-rate-conflict")
    exposure_s = float(np.max(exposure_time))
    if exposure_s > 1.01 * period:
        text = f"exposure {exposure_s * 1e3:g} ms is longer than the {period * 1e3:.4g} ms between frames"
        warn(f"{text}; check its unit", "exposure-too-long")
