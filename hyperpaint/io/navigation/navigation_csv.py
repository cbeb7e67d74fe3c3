"""Navigation as a plain table: a header that names columns and units, and comments that say the rest."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import FormatError, Problems, SchemaError, UnitsError
from hyperpaint.base.units import conversion_factor
from hyperpaint.io.files.reading import numbered_lines
from hyperpaint.io.files.text_tables import MAX_TABLE_ROWS, Table, name_rows, read_text, table_of

from .clocks import GPS_EPOCH, NS_PER_S, WEEK_S, instants, nanoseconds, refuse_backwards, unwrap_weeks
from .navigation_records import POSE, PoseRecord, check_poses, limited_numbers

if TYPE_CHECKING:
    from numpy.typing import NDArray

_LARGEST = 2**28
_MOST_COLUMNS = 1000
_MOST_COMMENTS = 1000
_LATEST_S = 7e9
"""Seconds from 1970, or 1980, to the end of the 22nd century."""
_ALIASES: Mapping[str, str] = {
    **dict.fromkeys(("latitude", "lat"), "latitude"),
    **dict.fromkeys(("longitude", "lon", "lng", "long"), "longitude"),
    **dict.fromkeys(("altitude", "alt", "height", "ellipsoidal height", "elevation"), "altitude"),
    "roll": "roll",
    "pitch": "pitch",
    **dict.fromkeys(("heading", "yaw", "true heading"), "heading"),
}
#: What a time column counts from, by its name; "" where only a stamp with a zone tells.
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
    """One column of the header: its place, and the unit that follows its name."""

    key: str
    shown: str
    unit: str | None


def is_navigation_csv(head: bytes) -> bool:
    """Tell from its first bytes whether a file is such a table: its header names a place and an attitude."""
    lines = head.decode("latin-1").removeprefix("\xef\xbb\xbf").splitlines()
    first = next((line for line in lines if line.strip() and not line.lstrip().startswith("#")), "")
    names = {_ALIASES.get(_column(cell).key) for cell in re.split("[,;\t]", first, maxsplit=_MOST_COLUMNS)}
    return {"latitude", "longitude", "roll", "pitch"} <= names


def read_navigation_csv(path: str | Path, names: Sequence[str] | None = None) -> PoseRecord:
    r"""Read navigation from a table of text.

    The header names ``latitude``, ``longitude``, ``altitude``, ``roll``, ``pitch``, ``heading`` (or ``lat``,
    ``lon``, ``alt``, ``yaw`` ...) with units, ``roll [degree]``, ``roll (rad)`` or ``roll_deg``, and a time:
    ``time`` or ``utc``, ISO 8601 stamps (in a column ``time`` with a zone); ``gps_time [s]`` from 1980-01-06,
    ``time_of_week [s]`` or ``unix_time [s]``. Cells are parted by commas, semicolons or tabs; an empty one is
    unknown, and a row without a time is left out. Other columns are ignored. Comments ``# key: value`` before
    the header declare fields of the `hyperpaint.base.attitude_conventions.Convention`, ``gps_week``,
    ``leap_seconds`` and ``time_scale``.

    names: Headings of a table that has none, with units, in the order of its columns; those of columns that
        are not wanted may be anything else. Its cells may be parted by blanks, too.
    Returns PoseRecord: Angles in radian where all three are, else in degree.
    Raises FormatError: Columns or units are missing, or cells are not what the header says; all are listed.
    Raises TimeError: Time runs backwards.
    """
    path = Path(path)
    comments, header, table = _split(path, names)
    problems = Problems(f"{path} cannot be used as navigation", FormatError)
    convention, assumed, said = _declared(comments, problems)
    columns = _columns(header, problems)
    problems.raise_if_any()
    unit = _angle_unit(columns, convention, "angle_unit" not in assumed, problems)
    values: dict[str, NDArray[np.float64]] = {}
    for name in POSE:
        wanted = unit if name in _ANGLES else "m" if name == "altitude" else "degree"
        values[name] = _values(table, columns[name], wanted, problems)
    stamp, has_time, clock = _stamps(table, columns["time"], said, problems)
    if not len(problems):  # the same cells would be named twice
        check_poses(values, unit, problems, "row")
    problems.raise_if_any()
    if not has_time.any():
        raise FormatError(f"{path}: no row with a time")
    timed_stamps = stamp[has_time]
    if clock == "week":
        timed_stamps = unwrap_weeks(timed_stamps)
    refuse_backwards(path.name, timed_stamps, row="row")
    left_out = int((~has_time).sum())
    return PoseRecord(
        path.name, "csv", timed_stamps, "week" if clock == "week" else "1970",
        {name: value[has_time] for name, value in values.items()}, convention.replace(angle_unit=unit),
        assumed=tuple(name for name in assumed if name != "angle_unit"), time_scale=_scale(said, clock),
        week=said.get("gps_week"), leap_seconds=said.get("leap_seconds"),
        attrs={"rows_without_time": left_out} if left_out else {},
    )  # fmt: skip


# --- text --------------------------------------------------------------------------------------------------


def _split(path: Path, names: Sequence[str] | None) -> tuple[dict[str, str], list[_Column], Table]:
    """Return comments, header and cells; cells of columns that nobody asks for are dropped."""
    text = read_text(path, _LARGEST, MAX_TABLE_ROWS)
    comments: dict[str, str] = {}
    start, head = 0, ""
    for start, line in numbered_lines(text):  # noqa: B007
        if line.strip() and not line.lstrip().startswith("#"):
            head = line
            break
        key, _, value = line.lstrip("# \t").partition(":")
        if line.strip() and len(comments) < _MOST_COMMENTS:
            comments[_plain(key).replace(" ", "_")] = value.strip()
    separator = next((mark for mark in ("\t", ";", ",") if mark in head), "," if names is None else None)
    cells = head.split(separator, _MOST_COLUMNS) if names is None else list(names)
    header = [_column(cell) for cell in cells]
    if len(cells) > _MOST_COLUMNS or not any(column.key in _ALIASES for column in header):
        shown = head.strip()[:80] if names is None else ", ".join(cells)[:80]
        raise FormatError(
            f"{path}: expected a header that names {', '.join(POSE)} and a time, found {shown!r}; "
            "those of a table without one are given as columns="
        )
    first = start + (names is None)
    rows = (
        (number, line.strip().split(separator, len(header)) if separator is None else
         line.split(separator, len(header)))
        for number, line in numbered_lines(text)
        if number >= first and line.strip() and not line.lstrip().startswith("#")
    )  # fmt: skip
    return comments, header, table_of(path, [column.shown for column in header], rows)


def _plain(text: str) -> str:
    return " ".join(text.strip().strip('"').lower().replace("_", " ").split())


def _column(cell: str) -> _Column:
    shown = cell.strip().strip('"')[:60]
    match = _CELL.match(shown)
    name, unit = (match["name"], match["unit"]) if match else (shown, None)
    key = _plain(name)
    if unit is None and key not in _ALIASES and key not in _CLOCKS:
        stem, _, last = key.rpartition(" ")
        if last in _UNIT_SUFFIXES and (stem in _ALIASES or stem in _CLOCKS):
            return _Column(stem, shown, last)
    return _Column(key, shown, unit.strip() if unit is not None else None)


# --- what the file says of itself --------------------------------------------------------------------------


def _declared(
    comments: Mapping[str, str], problems: Problems
) -> tuple[Convention, list[str], dict[str, Any]]:
    """Return the convention, what of it is assumed, and what is said of the clock."""
    names = {field.name for field in fields(Convention)}
    declared: dict[str, Any] = {}
    for key, value in comments.items():
        name = key.removeprefix("convention_")
        if name in ("declination", "geoid_undulation"):
            try:
                declared[name] = float(value)
            except ValueError:
                problems.add(f"comment {key!r} is {value[:40]!r}, expected a number")
        elif name in names:
            declared[name] = value
    said: dict[str, Any] = {}
    for name, most in (("gps_week", 11_479), ("leap_seconds", 100)):
        text = comments.get(name)
        if text is None:
            continue
        if re.fullmatch(r"[0-9]{1,5}", text) and int(text) <= most:
            said[name] = int(text)
        else:
            problems.add(f"comment {name!r} is {text[:40]!r}, expected a whole number up to {most}")
    if "time_scale" in comments:
        if comments["time_scale"].lower() in ("gps", "utc"):
            said["time_scale"] = comments["time_scale"].lower()
        else:
            problems.add(f"comment 'time_scale' is {comments['time_scale'][:40]!r}, expected 'gps' or 'utc'")
    convention = Convention()
    try:
        convention = Convention(**declared)
    except SchemaError as error:
        problems.add(str(error))
    unsaid = ("stamp_reference", "column_order", "declination", "geoid_undulation", "grid_crs")
    assumed = [f.name for f in fields(Convention) if f.name not in declared and f.name not in unsaid]
    return convention, assumed, said


def _columns(header: list[_Column], problems: Problems) -> dict[str, _Column]:
    """Return the columns of the pose and of the time; what is missing or doubled is noted."""
    columns_by_name: dict[str, list[_Column]] = {}
    for column in header:
        name = _ALIASES.get(column.key) or ("time" if column.key in _CLOCKS else None)
        if name:
            columns_by_name.setdefault(name, []).append(column)
    for name in (*POSE, "time"):
        if name not in columns_by_name:
            names = _CLOCKS if name == "time" else [key for key, value in _ALIASES.items() if value == name]
            problems.add(f"no column of {name}; expected one named {' or '.join(map(repr, list(names)[:4]))}")
        elif len(columns_by_name[name]) > 1:
            shown = ", ".join(repr(column.shown) for column in columns_by_name[name])
            problems.add(f"{shown} are all {name}; keep one of them")
        elif name != "time" and columns_by_name[name][0].unit is None:
            one, unit = columns_by_name[name][0].shown, "m" if name == "altitude" else "degree"
            problems.add(f"column {one!r} has no unit; call it for example '{one} [{unit}]'")
        elif name != "time":
            try:
                conversion_factor(str(columns_by_name[name][0].unit), "m" if name == "altitude" else "degree")
            except UnitsError as error:
                problems.add(f"column {columns_by_name[name][0].shown!r}: {error}")
    return {name: columns[0] for name, columns in columns_by_name.items()}


def _angle_unit(
    columns: Mapping[str, _Column], convention: Convention, declared: bool, problems: Problems
) -> Literal["degree", "radian"]:
    radian = [conversion_factor(str(columns[name].unit), "radian") == 1.0 for name in _ANGLES]
    unit: Literal["degree", "radian"] = "radian" if all(radian) else "degree"
    if declared and convention.angle_unit != unit:
        problems.add(f"comment 'angle_unit' is {convention.angle_unit!r}, the header says {unit!r}; drop one")
    return unit


def _values(table: Table, column: _Column, wanted: str, problems: Problems) -> NDArray[np.float64]:
    numbers = limited_numbers(table, column.shown, 1e6, problems, empty="nan")
    if wanted == "degree" and conversion_factor(str(column.unit), "radian") == 1.0:
        return np.degrees(numbers)  # all digits: the factors of units have twelve
    factor = conversion_factor(str(column.unit), wanted)
    return numbers if factor == 1.0 else numbers * factor


# --- time --------------------------------------------------------------------------------------------------


def _stamps(
    table: Table, column: _Column, said: Mapping[str, Any], problems: Problems
) -> tuple[NDArray[np.int64], NDArray[np.bool_], str]:
    """Return nanoseconds, which rows have a time, and what they count from."""
    clock = _CLOCKS[column.key]
    cells = [cell.strip().strip('"') for cell in table.columns[column.shown]]
    has_time = np.array([bool(cell) and cell != "NaT" for cell in cells])
    stamp = np.zeros(len(cells), np.int64)
    first = next((cell for cell, here in zip(cells, has_time, strict=True) if here), "")
    if not first:
        return stamp, has_time, clock
    if ":" in first:
        zoned = not clock and "time_scale" not in said
        stamp, wrong = _iso(cells, has_time, table.rows, zoned=zoned)
        if wrong.size:
            zone = " with a zone (or '# time_scale: utc')" if zoned else ""
            problems.add(
                f"column {column.shown!r} is not like '2024-06-01T12:00:00.5Z'{zone} in {name_rows(wrong)}"
            )
        return stamp, has_time, clock if clock == "gps" else ""
    if clock in ("", "utc"):
        problems.add(
            f"column {column.shown!r} holds numbers: from when do they count? Call it 'gps_time [s]' (from "
            "1980-01-06), 'time_of_week [s]' or 'unix_time [s]'"
        )
        return stamp, has_time, clock
    try:
        factor = conversion_factor(str(column.unit or "no unit"), "s")
    except UnitsError:
        problems.add(f"column {column.shown!r} has no unit of time; call it for example '{column.key} [s]'")
        return stamp, has_time, clock
    return _counted(table, column, [cell or "0" for cell in cells], factor, clock, problems, has_time)


def _counted(
    table: Table, column: _Column, cells: list[str], factor: float, clock: str, problems: Problems,
    has_time: NDArray[np.bool_],
) -> tuple[NDArray[np.int64], NDArray[np.bool_], str]:  # fmt: skip
    """Return the stamps of a column of numbers."""
    most = (2.0 * WEEK_S if clock == "week" else _LATEST_S) / factor
    numbers = Table(table.name, table.rows, {column.shown: cells})
    count = len(problems)
    seconds = limited_numbers(numbers, column.shown, most, problems) * factor
    if len(problems) > count:
        return np.zeros(len(cells), np.int64), has_time, clock
    has_time = has_time & ~np.isnan(seconds)
    if (seconds < 0.0).any():
        problems.add(f"column {column.shown!r} is negative in {name_rows(table.rows[seconds < 0.0])}")
    stamp = nanoseconds(np.where(has_time & (seconds >= 0.0), seconds, 0.0))
    if clock == "gps" and has_time.any() and (seconds[has_time] <= 2.0 * WEEK_S).all():
        clock = "week"
    return (stamp + GPS_EPOCH if clock == "gps" else stamp), has_time, clock


def _scale(said: Mapping[str, Any], clock: str) -> Literal["gps", "utc"]:
    scale: Literal["gps", "utc"] = said.get("time_scale") or ("gps" if clock in ("gps", "week") else "utc")
    return scale


def _iso(
    cells: list[str], has_time: NDArray[np.bool_], rows: NDArray[np.int64], *, zoned: bool
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return nanoseconds since 1970, and the lines whose cell is no stamp."""
    texts, shifts = ["1970-01-01"] * len(cells), np.zeros(len(cells), np.int64)
    bad = np.zeros(len(cells), np.bool_)
    for place in np.flatnonzero(has_time).tolist():
        match = _STAMP.fullmatch(cells[place][:64])
        if match is None or not "1980" <= match[1] < "2199" or (zoned and match[8] is None):
            bad[place] = True
            continue
        texts[place] = f"{match[1]}-{match[2]}-{match[3]}T{match[4]}:{match[5]}:{match[6]}.{match[7] or 0}"
        if match[8] and match[8][0] in "+-":
            zone = match[8].replace(":", "")
            minutes = int(zone[1:3]) * 60 + int(zone[3:5])
            shifts[place] = (-minutes if zone[0] == "-" else minutes) * 60
    stamps = instants(texts)
    bad |= np.isnat(stamps)
    return stamps.astype(np.int64) - shifts * NS_PER_S, rows[bad]
