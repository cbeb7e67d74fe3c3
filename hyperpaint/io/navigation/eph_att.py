"""Navigation in an ENVI file, as AVIRIS-NG keeps it: ``ang<date>t<time>_eph_att``.

A line of the file is a row of the record, a band a column, named by ``band names``.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import FormatError, Problems
from hyperpaint.io.envi.envi_cubes import find_pair
from hyperpaint.io.envi.envi_header import EnviHeader, read_header

from .gps_weeks import GPS_EPOCH, WEEK_S, nanoseconds, unwrap_weeks
from .pose_records import PoseRecord, check_poses, check_seconds, check_time_order

__all__ = ["is_eph_att", "read_eph_att"]

_NAMES = {
    "gpstime": "time", "lat": "latitude", "lon": "longitude", "alt": "altitude",
    "pitch": "pitch", "roll": "roll", "heading": "heading",
}  # fmt: skip
_LARGEST = 2**32
_STARTED = re.compile(r"ang([0-9]{8})t([0-9]{6})", re.IGNORECASE)
_LATE = 3600


def is_eph_att(header: EnviHeader) -> bool:
    """Tell whether the bands of an ENVI file are the columns of a navigation record."""
    return set(_NAMES) <= {name.lower() for name in header.band_names}


def read_eph_att(path: str | Path) -> PoseRecord:
    """Read navigation of AVIRIS-NG.

    Parameters
    ----------
    path
        The header or the data file.

    Returns
    -------
    PoseRecord
        Angles [degree]. Nothing published states their signs, nor what the height is above. The aircraft of
        the sample turns as it should where roll is right wing down and heading clockwise: heading rate =
        g tan(roll) / speed, within 6 %. The height is taken to be above the ellipsoid.

    Raises
    ------
    FormatError
        No such file, or values that no flight has; all are listed.
    TimeError
        Time runs backwards.
    """
    header_path, data_path = find_pair(path)
    header = read_header(header_path)
    _refuse_others(header, header_path, data_path)
    with open(data_path, "rb") as file:
        file.seek(header.header_offset)
        stored = np.fromfile(file, header.dtype, header.lines * header.bands)
    if stored.size != header.lines * header.bands:
        raise FormatError(f"{data_path}: became shorter while it was read")
    # one sample a line leaves lines and bands
    by_bands = header.interleave == "bsq"
    table = stored.reshape((header.bands, header.lines)).T if by_bands else stored.reshape(header.lines, -1)
    places = {name.lower(): place for place, name in enumerate(header.band_names)}
    values = {name: table[:, places[band]].astype(np.float64) for band, name in _NAMES.items()}
    seconds = values.pop("time")
    problems = Problems(f"{data_path} cannot be used as navigation", FormatError)
    check_seconds(data_path.name, seconds, 2.0 * WEEK_S, problems, "row")
    check_poses(values, "degree", problems, "row")
    problems.raise_if_any()
    stamp = unwrap_weeks(nanoseconds(seconds))
    check_time_order(data_path.name, stamp, "row")
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


def _refuse_others(header: EnviHeader, path: Path, data: Path) -> None:
    problems = Problems(f"{path} cannot be used as navigation", FormatError)
    if not is_eph_att(header):
        problems.add(f"band names are {', '.join(header.band_names)[:120]!r}, expected {', '.join(_NAMES)}")
    if header.samples != 1:
        problems.add(f"samples is {header.samples}, expected 1: a row of navigation is a line")
    if header.dtype.kind != "f":
        problems.add(f"values are {header.dtype}, expected float64 (data type 5)")
    found, expected = data.stat().st_size, header.header_offset + header.lines * header.line_bytes
    if found != expected or found > _LARGEST:
        problems.add(f"{data.name} has {found} bytes, its header says {expected}; copy it again")
    problems.raise_if_any()


def _week_of_name(name: str, first: int) -> int | None:
    """Return the GPS week that a name's date and time say, where they agree with the first row's stamp."""
    match = _STARTED.search(name)
    if match is None:
        return None
    day, clock = match.groups()
    text = f"{day[:4]}-{day[4:6]}-{day[6:]}T{clock[:2]}:{clock[2:4]}:{clock[4:]}"
    try:
        started = int(np.datetime64(text, "ns").astype(np.int64)) - GPS_EPOCH
    except ValueError:
        return None
    week = round((started - first) / (WEEK_S * 1_000_000_000))
    late = abs(started - first - week * WEEK_S * 1_000_000_000)
    return week if week >= 0 and late < _LATE * 1_000_000_000 and day[:4] < "2199" else None
