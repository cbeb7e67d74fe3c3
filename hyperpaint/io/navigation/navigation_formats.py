"""Navigation in the formats of vendors, each read into a `PoseRecord`.

Applanix SBET: a smoothed best estimate of trajectory, post-processed by POSPac. Records of 17 little-endian
float64 and nothing else, so that only the size and the values can tell whether a file is one. Stamps are
seconds of a GPS week that the file does not name (POSPac exports seconds of the UTC week on request:
``time_scale="utc"``).

Resonon ``.lcf``, the navigation beside a cube of an airborne Pika: a table without a header, its columns
separated by blanks or tabs: time [s of GPS time], roll, pitch, heading [rad], longitude, latitude [degree],
altitude [m], and two that are not used. No vendor description is public; what the columns mean is what public
readers were told by the maker (massipipe, mi3nts). Roll is positive with the right wing UP.

AVIRIS-NG ``ang<date>t<time>_eph_att``: an ENVI file, a line of which is a row of the record, a band a column,
named by ``band names``.
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
from hyperpaint.io.files.text_tables import MAX_TABLE_ROWS, Table, name_rows, read_text, table_of

from .clocks import GPS_EPOCH, NS_PER_S, WEEK_S, nanoseconds, refuse_backwards, unwrap_weeks
from .navigation_records import LIMITS, PoseRecord, check_poses, check_seconds, limited_numbers

_SBET_FIELDS = (
    *("time", "latitude", "longitude", "altitude", "x_velocity", "y_velocity", "z_velocity"),
    *("roll", "pitch", "platform_heading", "wander_angle"),
    *("x_acceleration", "y_acceleration", "z_acceleration", "x_rate", "y_rate", "z_rate"),
)
_SBET_RECORD = np.dtype([(name, "<f8") for name in _SBET_FIELDS])
_MAX_SBET_BYTES = 2**32
"""Bytes: 44 hours at 200 Hz."""
_SBET_OTHERS = {
    "platform_heading": "Heading from the north of the wander frame",
    "wander_angle": "Platform heading less heading from true north",
}
_SBET_CONVENTION = Convention(angle_unit="radian")


def read_sbet(path: str | Path) -> PoseRecord:
    """Read an SBET file.

    The wander frame's north turns against true north as the aircraft travels: ``heading`` is the platform's
    heading less the wander angle, both of which are kept. (In the two records of PDAL's sample, velocities
    are along the axes of that frame: with this sign they point where the displacement does.)

    Returns PoseRecord: Roll, pitch and heading [rad]: right wing down, nose up, clockwise from true north;
        heights above the ellipsoid.
    Raises FormatError: Not whole records, or values that no trajectory has; all are listed.
    Raises TimeError: Time runs backwards.
    """
    path = Path(path)
    records = _sbet_records(path)
    values = {name: records[name].astype(np.float64) for name in ("altitude", "roll", "pitch")}
    # numbers of a damaged file may overflow: what they become is refused below
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
    others = {
        name: (records[name].astype(np.float64), {"units": "radian", "long_name": meaning})
        for name, meaning in _SBET_OTHERS.items()
    }
    return PoseRecord(path.name, "Applanix SBET", stamp, "week", values, _SBET_CONVENTION, others=others)


def _sbet_records(path: Path) -> np.ndarray[tuple[int], np.dtype[np.void]]:
    with open_input(path, "an SBET file", _MAX_SBET_BYTES) as file:
        size = os.fstat(file.fileno()).st_size
        count, rest = divmod(size, _SBET_RECORD.itemsize)
        if rest or not count:
            raise FormatError(
                f"{path}: {size} bytes, expected records of {_SBET_RECORD.itemsize} bytes: "
                f"{count} whole ones and {rest} bytes more; it is cut short, or of another kind: copy it"
            )
        records = np.fromfile(file, _SBET_RECORD, count)
    if records.size != count:
        raise FormatError(f"{path}: became shorter while it was read")
    return records


_LCF_COLUMNS = ("time", "roll", "pitch", "heading", "longitude", "latitude", "altitude")
_MAX_LCF_BYTES = 2**28
_MAX_LCF_CELLS = 64
_LATEST_LCF_S = 7e9
"""Seconds from 1980 to 2199."""
_LCF_CONVENTION = Convention(roll_positive="right_wing_up", angle_unit="radian")


def read_lcf(path: str | Path) -> PoseRecord:
    """Read a Resonon ``.lcf`` file.

    Returns PoseRecord: Roll, pitch and heading [rad]: right wing UP, nose up, clockwise from true north;
        heights above the ellipsoid. Stamps count from the beginning of GPS time, or of a week where they are
        below two weeks.
    Raises FormatError: Not such a table, or cells that are no numbers or no positions and angles; all are
        listed.
    Raises TimeError: Time runs backwards.
    """
    path = Path(path)
    table = _lcf_table(path)
    problems = Problems(f"{path} cannot be used as a Resonon .lcf file", FormatError)
    values = {
        name: limited_numbers(table, name, _LATEST_LCF_S if name == "time" else LIMITS[name], problems)
        for name in _LCF_COLUMNS
    }
    seconds = values.pop("time")
    if problem := _lcf_time_problem(seconds, table):
        problems.add(problem)
    if not len(problems):  # the same cells would be named twice
        check_poses(values, "radian", problems, "row")
    problems.raise_if_any()
    weekly = bool((seconds <= 2.0 * WEEK_S).all())
    stamp = unwrap_weeks(nanoseconds(seconds)) if weekly else nanoseconds(seconds) + GPS_EPOCH
    refuse_backwards(path.name, stamp, row="row")
    return PoseRecord(
        path.name, "Resonon lcf", stamp, "week" if weekly else "1970", values, _LCF_CONVENTION,
        assumed=("euler_order",),
    )  # fmt: skip


def _lcf_time_problem(seconds: np.ndarray[tuple[int], np.dtype[np.float64]], table: Table) -> str:
    wrong = table.rows[~(seconds >= 0.0)]
    if wrong.size:
        return f"time is negative or unknown in {name_rows(wrong)}, expected seconds of GPS time"
    weekly = seconds <= 2.0 * WEEK_S
    if weekly.any() and not weekly.all():
        lesser = table.rows[weekly] if 2 * weekly.sum() < weekly.size else table.rows[~weekly]
        return f"time counts from elsewhere in {name_rows(lesser)} than in the other rows"
    return ""


def _lcf_table(path: Path) -> Table:
    text = read_text(path, _MAX_LCF_BYTES, MAX_TABLE_ROWS)
    cells = (
        (number, line.replace(",", " ").split(None, _MAX_LCF_CELLS))
        for number, line in numbered_lines(text)
        if line.strip()
    )
    first = next(cells, None)
    width = 0 if first is None else min(len(first[1]), _MAX_LCF_CELLS)
    rows = itertools.chain(() if first is None else (first,), cells)
    return table_of(path, [*_LCF_COLUMNS, *map(str, range(len(_LCF_COLUMNS), width))], rows)


_EPH_ATT_BANDS = {
    "gpstime": "time", "lat": "latitude", "lon": "longitude", "alt": "altitude",
    "pitch": "pitch", "roll": "roll", "heading": "heading",
}  # fmt: skip
_MAX_EPH_ATT_BYTES = 2**32
_EPH_ATT_START = re.compile(r"ang([0-9]{8})t([0-9]{6})", re.IGNORECASE)
_MAX_START_DIFFERENCE_S = 3600


def is_eph_att(header: EnviHeader) -> bool:
    """Tell whether the bands of an ENVI file are the columns of a navigation record."""
    return set(_EPH_ATT_BANDS) <= {name.lower() for name in header.band_names}


def read_eph_att(path: str | Path) -> PoseRecord:
    """Read navigation of AVIRIS-NG.

    path: The header or the data file.
    Returns PoseRecord: Angles [degree]. Nothing published states their signs, nor what the height is above.
        The aircraft of the sample turns as it should where roll is right wing down and heading clockwise:
        heading rate = g tan(roll) / speed, within 6 %. The height is taken to be above the ellipsoid.
    Raises FormatError: No such file, or values that no flight has; all are listed.
    Raises TimeError: Time runs backwards.
    """
    header_path, data_path = find_pair(path)
    header = read_header(header_path)
    _refuse_others(header, header_path, data_path)
    with open_input(data_path, "navigation") as file:
        file.seek(header.header_offset)
        stored = np.fromfile(file, header.dtype, header.lines * header.bands)
    if stored.size != header.lines * header.bands:
        raise FormatError(f"{data_path}: became shorter while it was read")
    # one sample a line leaves lines and bands
    by_bands = header.interleave == "bsq"
    table = stored.reshape((header.bands, header.lines)).T if by_bands else stored.reshape(header.lines, -1)
    places = {name.lower(): place for place, name in enumerate(header.band_names)}
    values = {name: table[:, places[band]].astype(np.float64) for band, name in _EPH_ATT_BANDS.items()}
    seconds = values.pop("time")
    problems = Problems(f"{data_path} cannot be used as navigation", FormatError)
    check_seconds(data_path.name, seconds, 2.0 * WEEK_S, problems, "row")
    check_poses(values, "degree", problems, "row")
    problems.raise_if_any()
    stamp = unwrap_weeks(nanoseconds(seconds))
    refuse_backwards(data_path.name, stamp, row="row")
    return PoseRecord(
        data_path.name, "AVIRIS-NG eph_att", stamp, "week", values, Convention(),
        assumed=("roll_positive", "pitch_positive", "euler_order", "height_reference"),
        week=_week_of_name(data_path.name, int(stamp[0])),
    )  # fmt: skip


def _refuse_others(header: EnviHeader, path: Path, data: Path) -> None:
    problems = Problems(f"{path} cannot be used as navigation", FormatError)
    if not is_eph_att(header):
        names = ", ".join(header.band_names)[:120]
        problems.add(f"band names are {names!r}, expected {', '.join(_EPH_ATT_BANDS)}")
    if header.samples != 1:
        problems.add(f"samples is {header.samples}, expected 1: a row of navigation is a line")
    if header.dtype.kind != "f":
        problems.add(f"values are {header.dtype}, expected float64 (data type 5)")
    stored_bytes = data.stat().st_size
    expected_bytes = header.header_offset + header.lines * header.line_bytes
    if stored_bytes != expected_bytes or stored_bytes > _MAX_EPH_ATT_BYTES:
        problems.add(f"{data.name} has {stored_bytes} bytes, its header says {expected_bytes}; copy it again")
    problems.raise_if_any()


def _week_of_name(name: str, first: int) -> int | None:
    """Return the GPS week that a name's date and time say, where they agree with the first row's stamp."""
    match = _EPH_ATT_START.search(name)
    if match is None:
        return None
    day, clock = match.groups()
    text = f"{day[:4]}-{day[4:6]}-{day[6:]}T{clock[:2]}:{clock[2:4]}:{clock[4:]}"
    try:
        started = int(np.datetime64(text, "ns").astype(np.int64)) - GPS_EPOCH
    except ValueError:
        return None
    week = round((started - first) / (WEEK_S * NS_PER_S))
    late = abs(started - first - week * WEEK_S * NS_PER_S)
    return week if week >= 0 and late < _MAX_START_DIFFERENCE_S * NS_PER_S and day[:4] < "2199" else None
