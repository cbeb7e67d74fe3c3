"""Navigation as a table of text: a header of names and units, and comments with the conventions."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import FormatError, Problems, SchemaError, UnitsError
from hyperpaint.base.facts import one_of
from hyperpaint.base.units import conversion_factor
from hyperpaint.io.files.reading import numbered_lines
from hyperpaint.io.files.text_tables import MAX_TABLE_ROWS, Table, name_rows, read_text, table_of

from .clocks import GPS_EPOCH, NS_PER_S, WEEK_S, instants, nanoseconds, refuse_backwards, unwrap_weeks
from .navigation_records import POSE, PoseRecord, check_poses, limited_numbers

_MAX_BYTES = 2**28
_MAX_COLUMNS = 1000
_MAX_COMMENTS = 1000
#: Largest time [s], counted from 1970 or 1980: end of the 22nd century.
_MAX_TIME_S = 7e9
_ALIASES: Mapping[str, str] = {
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
_ANGLES = ("roll", "pitch", "heading")
_UNIT_SUFFIXES = ("deg", "degree", "degrees", "rad", "radian", "radians", "m", "s", "ms", "us", "ns")
_CELL = re.compile(r"(?P<name>[^\[(]*)(?:[\[(](?P<unit>[^\])]*)[\])])?")
_STAMP = re.compile(
    r"(\d{4})[-/](\d{2})[-/](\d{2})[T ](\d{2}):(\d{2}):(\d{2})(?:\.(\d{1,9})\d*)?"
    r"\s*(Z|UTC|[+-]\d{2}:?\d{2})?",
    re.ASCII,
)


@dataclass(frozen=True)
class _Column:
    # One column of the header.
    key: str  # name in lower case, with blanks for underscores
    shown: str  # heading, for messages
    unit: str | None


def is_navigation_csv(head: bytes) -> bool:
    """Return whether the header of a file names position and attitude."""
    lines = head.decode("latin-1").removeprefix("\xef\xbb\xbf").splitlines()
    header = next((line for line in lines if line.strip() and not line.lstrip().startswith("#")), "")
    names = {_ALIASES.get(_column(cell).key) for cell in re.split("[,;\t]", header, maxsplit=_MAX_COLUMNS)}
    return {"latitude", "longitude", "roll", "pitch"} <= names


def read_navigation_csv(path: str | Path, names: Sequence[str] | None = None) -> PoseRecord:
    r"""Read navigation from a table of text.

    The header names ``latitude``, ``longitude``, ``altitude``, ``roll``, ``pitch``, ``heading`` (or ``lat``,
    ``lon``, ``alt``, ``yaw`` ...) with units, ``roll [degree]``, ``roll (rad)`` or ``roll_deg``, and a time:
    ``time`` or ``utc``, ISO 8601 stamps (in a column ``time`` with a zone); ``gps_time [s]`` from 1980-01-06,
    ``time_of_week [s]`` or ``unix_time [s]``. Cells are separated by commas, semicolons or tabs; an empty
    cell is NaN, and a row without a time is left out. Other columns are ignored. Comments ``# key: value``
    before the header declare fields of the `hyperpaint.base.attitude_conventions.Convention`, ``gps_week``,
    ``leap_seconds`` and ``time_scale``.

    names: Headings with units for a table without a header, in the order of its columns; columns to ignore
        may have any other name. Cells of such a table may also be separated by blanks.
    Returns PoseRecord: Angles in radian if all three columns are, else in degree.
    Raises FormatError: Columns or units are missing, or cells do not fit the header; all are listed.
    Raises TimeError: Time runs backwards.
    """
    path = Path(path)
    comments, header, table = _table_and_comments(path, names)
    problems = Problems(f"{path} cannot be used as navigation", FormatError)
    convention, assumed, clock_settings = _declarations(comments, problems)
    columns = _columns(header, problems)
    problems.raise_if_any()
    is_unit_declared = "angle_unit" not in assumed
    is_radian = [conversion_factor(str(columns[name].unit), "radian") == 1.0 for name in _ANGLES]
    unit: Literal["degree", "radian"] = "radian" if all(is_radian) else "degree"
    if is_unit_declared and convention.angle_unit != unit:
        problems.add(
            f"comment 'angle_unit' is {convention.angle_unit!r}, the header has {unit!r}",
            mend="remove one of them",
            code="units-conflict",
        )
    values: dict[str, NDArray[np.float64]] = {}
    for name in POSE:
        target_unit = unit if name in _ANGLES else "m" if name == "altitude" else "degree"
        values[name] = _converted_column(table, columns[name], target_unit, problems)
    stamp, has_time, clock = _time_column(table, columns["time"], clock_settings, problems)
    if not len(problems):  # else the same cells would be listed twice
        check_poses(values, unit, problems, "row")
    problems.raise_if_any()
    if not has_time.any():
        raise FormatError(f"{path}: no row with a time", code="time-missing")
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


# --- text --------------------------------------------------------------------------------------------------


def _table_and_comments(
    path: Path, names: Sequence[str] | None
) -> tuple[dict[str, str], list[_Column], Table]:
    # Return comments, header and cells of a file.
    text = read_text(path, _MAX_BYTES, MAX_TABLE_ROWS)
    comments: dict[str, str] = {}
    start, head = 0, ""
    for start, line in numbered_lines(text):  # noqa: B007
        if line.strip() and not line.lstrip().startswith("#"):
            head = line
            break
        key, _, value = line.lstrip("# \t").partition(":")
        if line.strip() and len(comments) < _MAX_COMMENTS:
            comments[_plain_words(key).replace(" ", "_")] = value.strip()
    separator = next(
        (character for character in ("\t", ";", ",") if character in head), "," if names is None else None
    )
    cells = head.split(separator, _MAX_COLUMNS) if names is None else list(names)
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
        (
            number,
            line.strip().split(separator, len(header))
            if separator is None
            else line.split(separator, len(header)),
        )
        for number, line in numbered_lines(text)
        if number >= first and line.strip() and not line.lstrip().startswith("#")
    )
    return comments, header, table_of(path, [column.shown for column in header], rows)


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


# --- declarations in comments ------------------------------------------------------------------------------


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
    try:
        convention = Convention(**declared)
    except SchemaError as error:
        problems.add_error("", error)
    optional_fields = ("stamp_reference", "column_order", "declination", "geoid_undulation", "grid_crs")
    assumed = [f.name for f in fields(Convention) if f.name not in declared and f.name not in optional_fields]
    return convention, assumed, clock_settings


def _columns(header: list[_Column], problems: Problems) -> dict[str, _Column]:
    columns_by_name: dict[str, list[_Column]] = {}
    for column in header:
        name = _ALIASES.get(column.key) or ("time" if column.key in _CLOCKS else None)
        if name:
            columns_by_name.setdefault(name, []).append(column)
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
            try:
                conversion_factor(str(columns_by_name[name][0].unit), "m" if name == "altitude" else "degree")
            except UnitsError as error:
                problems.add_error(f"column {columns_by_name[name][0].shown!r}", error)
    return {name: columns[0] for name, columns in columns_by_name.items()}


def _converted_column(
    table: Table, column: _Column, target_unit: str, problems: Problems
) -> NDArray[np.float64]:
    numbers = limited_numbers(table, column.shown, 1e6, problems, empty="nan")
    if target_unit == "degree" and conversion_factor(str(column.unit), "radian") == 1.0:
        return np.degrees(numbers)  # exact, unlike conversion factors, which have twelve digits
    factor = conversion_factor(str(column.unit), target_unit)
    return numbers if factor == 1.0 else numbers * factor


# --- time --------------------------------------------------------------------------------------------------


def _time_column(
    table: Table, column: _Column, clock_settings: Mapping[str, Any], problems: Problems
) -> tuple[NDArray[np.int64], NDArray[np.bool_], str]:
    # Return stamps [ns], whether each row has one, and their origin as in `_CLOCKS`.
    clock = _CLOCKS[column.key]
    cells = [cell.strip().strip('"') for cell in table.columns[column.shown]]
    has_time = np.array([bool(cell) and cell != "NaT" for cell in cells])
    stamp = np.zeros(len(cells), np.int64)
    first_stamp = next((cell for cell, has_stamp in zip(cells, has_time, strict=True) if has_stamp), "")
    if not first_stamp:
        return stamp, has_time, clock
    if ":" in first_stamp:
        is_zone_required = not clock and "time_scale" not in clock_settings
        stamp, wrong_rows = _iso_times(cells, has_time, table.rows, is_zone_required=is_zone_required)
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
    return _numeric_times(table, column, [cell or "0" for cell in cells], factor, clock, problems, has_time)


def _numeric_times(
    table: Table,
    column: _Column,
    cells: list[str],
    factor: float,
    clock: str,
    problems: Problems,
    has_time: NDArray[np.bool_],
) -> tuple[NDArray[np.int64], NDArray[np.bool_], str]:
    maximum = (2.0 * WEEK_S if clock == "week" else _MAX_TIME_S) / factor
    numbers = Table(table.name, table.rows, {column.shown: cells})
    problem_count = len(problems)
    seconds = limited_numbers(numbers, column.shown, maximum, problems) * factor
    if len(problems) > problem_count:
        return np.zeros(len(cells), np.int64), has_time, clock
    has_time = has_time & ~np.isnan(seconds)
    if (seconds < 0.0).any():
        problems.add(
            f"column {column.shown!r} is negative in {name_rows(table.rows[seconds < 0.0])}",
            code="value-out-of-range",
        )
    stamp = nanoseconds(np.where(has_time & (seconds >= 0.0), seconds, 0.0))
    if clock == "gps" and has_time.any() and (seconds[has_time] <= 2.0 * WEEK_S).all():
        clock = "week"
    return (stamp + GPS_EPOCH if clock == "gps" else stamp), has_time, clock


def _iso_times(
    cells: list[str], has_time: NDArray[np.bool_], rows: NDArray[np.int64], *, is_zone_required: bool
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    # Return nanoseconds since 1970, and the line numbers of unreadable stamps.
    texts, shifts = ["1970-01-01"] * len(cells), np.zeros(len(cells), np.int64)
    is_unreadable = np.zeros(len(cells), np.bool_)
    for number in np.flatnonzero(has_time).tolist():
        match = _STAMP.fullmatch(cells[number][:64])
        if match is None or not "1980" <= match[1] < "2199" or (is_zone_required and match[8] is None):
            is_unreadable[number] = True
            continue
        texts[number] = f"{match[1]}-{match[2]}-{match[3]}T{match[4]}:{match[5]}:{match[6]}.{match[7] or 0}"
        if match[8] and match[8][0] in "+-":
            zone_text = match[8].replace(":", "")
            minutes = int(zone_text[1:3]) * 60 + int(zone_text[3:5])
            shifts[number] = (-minutes if zone_text[0] == "-" else minutes) * 60
    stamps = instants(texts)
    is_unreadable |= np.isnat(stamps)
    return stamps.astype(np.int64) - shifts * NS_PER_S, rows[is_unreadable]
