"""Navigation in formats of vendors, each read into a `PoseRecord`.

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
"""

from __future__ import annotations

import itertools
import os
import re
from pathlib import Path

import numpy as np

from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import FormatError, Problems
from hyperpaint.base.input_files import open_input
from hyperpaint.io.envi.envi_cubes import find_pair
from hyperpaint.io.envi.envi_header import EnviHeader, read_header
from hyperpaint.io.files.reading import numbered_lines
from hyperpaint.io.files.text_tables import MAX_TABLE_ROWS, name_rows, read_text, table_of

from .clocks import GPS_EPOCH, NS_PER_S, WEEK_S, nanoseconds, refuse_backwards, unwrap_weeks
from .navigation_records import LIMITS, PoseRecord, check_poses, check_seconds, limited_numbers

_SBET_FIELDS = (
    *("time", "latitude", "longitude", "altitude", "x_velocity", "y_velocity", "z_velocity"),
    *("roll", "pitch", "platform_heading", "wander_angle"),
    *("x_acceleration", "y_acceleration", "z_acceleration", "x_rate", "y_rate", "z_rate"),
)
_SBET_RECORD = np.dtype([(name, "<f8") for name in _SBET_FIELDS])
#: Largest SBET file [bytes]: 44 hours at 200 Hz.
_MAX_SBET_BYTES = 2**32
_SBET_OTHER_MEANINGS = {
    "platform_heading": "Heading from the north of the wander frame",
    "wander_angle": "Platform heading less heading from true north",
}
_SBET_CONVENTION = Convention(angle_unit="radian")


def read_sbet(path: str | Path) -> PoseRecord:
    """Read an SBET file.

    The north of the wander frame rotates relative to true north as the aircraft travels: ``heading`` is the
    platform heading minus the wander angle, both of which are also returned. (In the two records of PDAL's
    sample, velocities are along the axes of the wander frame; with this sign they agree with the
    displacement.)

    Returns PoseRecord: Roll, pitch and heading [rad]: right wing down, nose up, clockwise from true north;
        heights above the ellipsoid.
    Raises FormatError: The file does not consist of records, or values are out of range; all are listed.
    Raises TimeError: Time runs backwards.
    """
    path = Path(path)
    with open_input(path, "an SBET file", _MAX_SBET_BYTES) as file:
        size = os.fstat(file.fileno()).st_size
        count, extra_bytes = divmod(size, _SBET_RECORD.itemsize)
        if extra_bytes or not count:
            raise FormatError(
                f"{path}: {size} bytes",
                expected=f"a multiple of {_SBET_RECORD.itemsize}, the size of a record",
                mend="copy the file again, or check its format",
                code="file-truncated",
            )
        records = np.fromfile(file, _SBET_RECORD, count)
    if records.size != count:
        raise FormatError(f"{path}: became shorter during reading", code="file-truncated")
    values = {name: records[name].astype(np.float64) for name in ("altitude", "roll", "pitch")}
    # values of damaged files may overflow; `check_poses` refuses the results
    with np.errstate(invalid="ignore", over="ignore"):
        values["latitude"] = np.degrees(records["latitude"])
        values["longitude"] = np.degrees(records["longitude"])
        values["heading"] = records["platform_heading"] - records["wander_angle"]
    problems = Problems(f"{path} cannot be used as an SBET file of little-endian float64", FormatError)
    check_seconds(path.name, records["time"], 2.0 * WEEK_S, problems, "record")
    check_poses(values, "radian", problems, "record")
    problems.raise_if_any()
    stamp = unwrap_weeks(nanoseconds(records["time"]))
    refuse_backwards(path.name, stamp, row="record")
    other_columns = {
        name: (records[name].astype(np.float64), {"units": "radian", "long_name": meaning})
        for name, meaning in _SBET_OTHER_MEANINGS.items()
    }
    return PoseRecord(
        path.name, "Applanix SBET", stamp, "week", values, _SBET_CONVENTION, others=other_columns
    )


_LCF_COLUMNS = ("time", "roll", "pitch", "heading", "longitude", "latitude", "altitude")
_MAX_LCF_BYTES = 2**28
_MAX_LCF_CELLS = 64
#: Largest time [s], counted from 1980: the year 2199.
_MAX_LCF_TIME_S = 7e9
_LCF_CONVENTION = Convention(roll_positive="right_wing_up", angle_unit="radian")


def read_lcf(path: str | Path) -> PoseRecord:
    """Read a Resonon ``.lcf`` file.

    Returns PoseRecord: Roll, pitch and heading [rad]: right wing UP, nose up, clockwise from true north;
        heights above the ellipsoid. Stamps count from the beginning of GPS time, or of a GPS week if they are
        below two weeks.
    Raises FormatError: The file is not such a table, or cells are not numbers, positions and angles; all are
        listed.
    Raises TimeError: Time runs backwards.
    """
    path = Path(path)
    text = read_text(path, _MAX_LCF_BYTES, MAX_TABLE_ROWS)
    cells = (
        (number, line.replace(",", " ").split(None, _MAX_LCF_CELLS))
        for number, line in numbered_lines(text)
        if line.strip()
    )
    first = next(cells, None)
    column_count = 0 if first is None else min(len(first[1]), _MAX_LCF_CELLS)
    rows = itertools.chain(() if first is None else (first,), cells)
    table = table_of(path, [*_LCF_COLUMNS, *map(str, range(len(_LCF_COLUMNS), column_count))], rows)
    problems = Problems(f"{path} cannot be used as a Resonon .lcf file", FormatError)
    values = {
        name: limited_numbers(table, name, _MAX_LCF_TIME_S if name == "time" else LIMITS[name], problems)
        for name in _LCF_COLUMNS
    }
    seconds = values.pop("time")
    invalid_rows = table.rows[~(seconds >= 0.0)]
    is_in_week = seconds <= 2.0 * WEEK_S
    if invalid_rows.size:
        problems.add(
            f"time is negative or unknown in {name_rows(invalid_rows)}",
            expected="seconds of GPS time",
            code="value-out-of-range",
        )
    elif is_in_week.any() and not is_in_week.all():
        minority_rows = (
            table.rows[is_in_week] if 2 * is_in_week.sum() < is_in_week.size else table.rows[~is_in_week]
        )
        problems.add(
            f"time has another origin in {name_rows(minority_rows)} than in the other rows",
            code="time-origin-conflict",
        )
    if not len(problems):  # else the same cells would be listed twice
        check_poses(values, "radian", problems, "row")
    problems.raise_if_any()
    is_week_time = bool(is_in_week.all())
    stamp = unwrap_weeks(nanoseconds(seconds)) if is_week_time else nanoseconds(seconds) + GPS_EPOCH
    refuse_backwards(path.name, stamp, row="row")
    return PoseRecord(
        path.name,
        "Resonon lcf",
        stamp,
        "week" if is_week_time else "1970",
        values,
        _LCF_CONVENTION,
        assumed=("euler_order",),
    )


_EPH_ATT_BANDS = {
    "gpstime": "time",
    "lat": "latitude",
    "lon": "longitude",
    "alt": "altitude",
    "pitch": "pitch",
    "roll": "roll",
    "heading": "heading",
}
_MAX_EPH_ATT_BYTES = 2**32
_EPH_ATT_START = re.compile(r"ang([0-9]{8})t([0-9]{6})", re.IGNORECASE)
_MAX_START_DIFFERENCE_S = 3600


def is_eph_att(header: EnviHeader) -> bool:
    """Return whether the bands of an ENVI file are the columns of a navigation record."""
    return set(_EPH_ATT_BANDS) <= {name.lower() for name in header.band_names}


def read_eph_att(path: str | Path) -> PoseRecord:
    """Read navigation of AVIRIS-NG.

    path: The header or the data file.
    Returns PoseRecord: Angles [degree]. Their signs and the reference of the height are not published. In the
        sample, heading rate = g tan(roll) / speed within 6 % if roll is positive with the right wing down and
        heading clockwise. The height is assumed to be above the ellipsoid.
    Raises FormatError: The file is not such a record, or values are out of range; all are listed.
    Raises TimeError: Time runs backwards.
    """
    header_path, data_path = find_pair(path)
    header = read_header(header_path)
    problems = Problems(f"{header_path} cannot be used as navigation", FormatError)
    if not is_eph_att(header):
        names = ", ".join(header.band_names)[:120]
        problems.add(f"band names are {names!r}", expected=", ".join(_EPH_ATT_BANDS), code="column-missing")
    if header.samples != 1:
        problems.add(f"samples is {header.samples}", expected="1, as in navigation", code="dims-wrong")
    if header.dtype.kind != "f":
        problems.add(f"values are {header.dtype}", expected="float64 (data type 5)", code="type-wrong")
    stored_bytes = data_path.stat().st_size
    expected_bytes = header.header_offset + header.lines * header.line_bytes
    if stored_bytes != expected_bytes or stored_bytes > _MAX_EPH_ATT_BYTES:
        problems.add(
            f"{data_path.name} has {stored_bytes} bytes",
            expected=f"{expected_bytes}, as its header says",
            mend="copy it again",
            code="file-size",
        )
    problems.raise_if_any()
    with open_input(data_path, "navigation") as file:
        file.seek(header.header_offset)
        stored = np.fromfile(file, header.dtype, header.lines * header.bands)
    if stored.size != header.lines * header.bands:
        raise FormatError(f"{data_path}: became shorter during reading", code="file-truncated")
    # with one sample per line, the dims are lines and bands
    is_band_sequential = header.interleave == "bsq"
    table = (
        stored.reshape((header.bands, header.lines)).T
        if is_band_sequential
        else stored.reshape(header.lines, -1)
    )
    column_numbers = {name.lower(): number for number, name in enumerate(header.band_names)}
    values = {
        name: table[:, column_numbers[band]].astype(np.float64) for band, name in _EPH_ATT_BANDS.items()
    }
    seconds = values.pop("time")
    problems = Problems(f"{data_path} cannot be used as navigation", FormatError)
    check_seconds(data_path.name, seconds, 2.0 * WEEK_S, problems, "row")
    check_poses(values, "degree", problems, "row")
    problems.raise_if_any()
    stamp = unwrap_weeks(nanoseconds(seconds))
    refuse_backwards(data_path.name, stamp, row="row")
    return PoseRecord(
        data_path.name,
        "AVIRIS-NG eph_att",
        stamp,
        "week",
        values,
        Convention(),
        assumed=("roll_positive", "pitch_positive", "euler_order", "height_reference"),
        week=_week_of_name(data_path.name, int(stamp[0])),
    )


def _week_of_name(name: str, first_stamp: int) -> int | None:
    # Return the GPS week of the date and time in a file name if they agree with the first stamp, else None.
    match = _EPH_ATT_START.search(name)
    if match is None:
        return None
    date, clock = match.groups()
    text = f"{date[:4]}-{date[4:6]}-{date[6:]}T{clock[:2]}:{clock[2:4]}:{clock[4:]}"
    try:
        start_ns = int(np.datetime64(text, "ns").astype(np.int64)) - GPS_EPOCH
    except ValueError:
        return None
    week = round((start_ns - first_stamp) / (WEEK_S * NS_PER_S))
    difference_ns = abs(start_ns - first_stamp - week * WEEK_S * NS_PER_S)
    return (
        week
        if week >= 0 and difference_ns < _MAX_START_DIFFERENCE_S * NS_PER_S and date[:4] < "2199"
        else None
    )
