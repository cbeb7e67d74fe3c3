"""Navigation of any format as one dataset with UTC stamps and declared conventions."""

from __future__ import annotations

import datetime
import itertools
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import Findings, FormatError, Problems, SchemaError, TimeError
from hyperpaint.base.facts import is_number, one_of, takes_quantities
from hyperpaint.base.input_files import input_path, is_plain_file, open_input
from hyperpaint.io.store import load_group
from hyperpaint.io.store.reader import is_zarr

from .navigation_records import (
    ASSUMED,
    GPS_EPOCH,
    NS_PER_S,
    POSE,
    WEEK_S,
    ClockCorrection,
    Navigation,
    PoseRecord,
    is_nmea,
    midnight_of,
    read_eph_att,
    read_gps_time,
    read_imu_gps,
    read_lcf,
    read_navigation_csv,
    read_nmea,
    read_sbet,
    refuse_backwards,
)

#: A file's record, its UTC [ns since 1970-01-01], and attributes that describe the conversion to UTC.
Part = tuple[PoseRecord, NDArray[np.int64], dict[str, Any]]

NAVIGATION_TIME = "navigation_time"
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
        return _stored_record(paths, convention)
    files = [Path(paths)] if isinstance(paths, str | os.PathLike) else [Path(path) for path in paths]
    FormatError.raise_if(
        not files, "an empty list of navigation files", expected="one or more", code="empty-input"
    )
    source = TimeSource(week, date, leap_seconds, time_scale, clock_offset_s)
    source.check()
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
            gps_time_path = None if gps_time is None else Path(gps_time)
            if kind == "imu_gps":
                record = _headwall_record(path, source, gps_time_path)
            else:
                record = read_record(path, kind, columns, source.midnight)
            parts.append((record, *utc_of_record(record, source)))
    findings.raise_if_any()
    parts.sort(key=lambda part: int(part[1][0]))
    _refuse_mixtures(parts)
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


def _stored_record(path: Any, convention: Convention | Mapping[str, Any] | None) -> xr.Dataset:
    record = load_group(path)
    problems = Problems(f"{path} cannot be used as navigation", FormatError)
    for name in (NAVIGATION_TIME, *POSE):
        if name not in record.variables:
            problems.add(
                f"{name!r} is missing among {', '.join(map(str, record.variables))[:200]}",
                code="variable-missing",
            )
        elif record[name].dims != (NAVIGATION_TIME,):
            problems.add(
                f"{name!r} has dims {record[name].dims}",
                expected=f"({NAVIGATION_TIME!r},)",
                code="dims-wrong",
            )
        elif name != NAVIGATION_TIME and "units" not in record[name].attrs:
            problems.add(
                f"{name!r} has no units", expected="the units of open_navigation", code="units-missing"
            )
    problems.raise_if_any()
    time = record[NAVIGATION_TIME].values
    TimeError.raise_if(
        time.dtype.kind != "M" or not time.size or np.isnat(time).any(),
        f"{path}: {NAVIGATION_TIME} is {time.dtype}",
        expected="UTC, datetime64[ns]",
        code="type-wrong",
    )
    refuse_backwards(str(path), time.astype("datetime64[ns]").astype(np.int64), row="sample")
    own = Convention.from_attrs(record.attrs)
    declared = _convention(str(path), own or Convention(), ("angle_unit",) if own is None else (), convention)
    values = {name: record[name].astype(np.float64) for name in POSE}
    return record.assign(values).assign_attrs(declared.to_attrs())


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


def _headwall_record(path: Path, source: TimeSource, gps_time: Path | None) -> PoseRecord:
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

    def check(self) -> None:
        # Refuse invalid settings, all in one error.
        # Raises TimeError: A week, date, number of leap seconds, time scale or clock offset is invalid.
        problems = Problems("the clock settings of the navigation are invalid", TimeError)
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
            (offset is None or (is_number(offset) and abs(offset) <= 1e9), f"clock_offset_s {offset!r:.40}",
             "seconds, -1e9 to 1e9", "value-out-of-range"),
        ):  # fmt: skip
            problems.add_if(not is_valid, found, expected=expected, code=code)
        problems.raise_if_any()

    @property
    def midnight(self) -> int | None:
        # Nanoseconds from 1970 to 0 h of the date; None without a valid date.
        return midnight_of(self.date)


def _is_whole(value: Any, maximum: int) -> bool:
    is_integer = isinstance(value, int | np.integer) and not isinstance(value, bool)
    return is_integer and 0 <= int(value) <= maximum


def utc_of_record(record: PoseRecord, source: TimeSource) -> tuple[NDArray[np.int64], dict[str, Any]]:
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
    problems.add_if(
        midnight is not None and abs(first - midnight - _DAY_NS // 2) > 1.5 * _DAY_NS,
        f"{begins}, but date is {source.date}",
        mend="correct date, or open another file",
        code="date-conflict",
    )
    problems.add_if(
        source.week not in (None, stamp_week) and record.counts_from != "week",
        f"{begins}, in week {stamp_week}, but week is {source.week}",
        code="gps-week-conflict",
    )
    problems.raise_if_any()
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


# --- the dataset -------------------------------------------------------------------------------------------


def _refuse_mixtures(parts: Sequence[Part]) -> None:
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


def _convention(
    source: str, own: Convention, assumed: Sequence[str], declared: Convention | Mapping[str, Any] | None
) -> Convention:
    # Return the convention of a record: its own, changed by the caller's declarations.
    choices = {} if declared is None or isinstance(declared, Convention) else declared
    if unknown := set(choices) - set(own.__dataclass_fields__):
        raise SchemaError(
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
