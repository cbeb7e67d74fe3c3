"""Applanix SBET: a smoothed best estimate of trajectory, post-processed by POSPac.

Records of 17 little-endian float64 and nothing else, so that only the size and the values can tell whether a
file is one. Stamps are seconds of a GPS week that the file does not name (POSPac exports seconds of the UTC
week on request: ``time_scale="utc"``).
"""

from __future__ import annotations

import os
import stat
from pathlib import Path

import numpy as np

from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import FormatError, Problems

from .gps_weeks import WEEK_S, nanoseconds, unwrap_weeks
from .pose_records import PoseRecord, check_poses, check_seconds, check_time_order

__all__ = ["read_sbet"]

_FIELDS = (
    *("time", "latitude", "longitude", "altitude", "x_velocity", "y_velocity", "z_velocity"),
    *("roll", "pitch", "platform_heading", "wander_angle"),
    *("x_acceleration", "y_acceleration", "z_acceleration", "x_rate", "y_rate", "z_rate"),
)
_RECORD = np.dtype([(name, "<f8") for name in _FIELDS])
_LARGEST = 2**32
"""Bytes: 44 hours at 200 Hz."""
_CONVENTION = Convention(angle_unit="radian")


def read_sbet(path: str | Path) -> PoseRecord:
    """Read an SBET file.

    The wander frame's north turns against true north as the aircraft travels: ``heading`` is the platform's
    heading less the wander angle, both of which are kept. (In the two records of PDAL's sample, velocities
    are along the axes of that frame: with this sign they point where the displacement does.)

    Parameters
    ----------
    path
        The file.

    Returns
    -------
    PoseRecord
        Roll, pitch and heading [rad]: right wing down, nose up, clockwise from true north; heights above the
        ellipsoid.

    Raises
    ------
    FormatError
        Not whole records, or values that no trajectory has; all are listed.
    TimeError
        Time runs backwards.
    """
    path = Path(path)
    records = _records(path)
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
    check_time_order(path.name, stamp, "record")
    radian = {"units": "radian"}
    return PoseRecord(
        path.name,
        "Applanix SBET",
        stamp,
        "week",
        values,
        _CONVENTION,
        others={
            "platform_heading": (
                records["platform_heading"].astype(np.float64),
                {**radian, "long_name": "Heading from the north of the wander frame"},
            ),
            "wander_angle": (
                records["wander_angle"].astype(np.float64),
                {**radian, "long_name": "Platform heading less heading from true north"},
            ),
        },
    )


def _records(path: Path) -> np.ndarray[tuple[int], np.dtype[np.void]]:
    try:
        with open(path, "rb") as file:
            status = os.fstat(file.fileno())
            count, rest = divmod(status.st_size, _RECORD.itemsize)
            if not stat.S_ISREG(status.st_mode) or status.st_size > _LARGEST:
                raise FormatError(
                    f"{path}: no file of at most {_LARGEST >> 30} GB, expected an SBET file; check the path"
                )
            if rest or not count:
                raise FormatError(
                    f"{path}: {status.st_size} bytes, expected records of {_RECORD.itemsize} bytes: {count} "
                    f"whole ones and {rest} bytes more; it is cut short, or of another kind: copy it again"
                )
            made = np.fromfile(file, _RECORD, count)
    except OSError as error:
        raise FormatError(f"{path}: cannot be read ({error.strerror or error}); check the path") from error
    if made.size != count:
        raise FormatError(f"{path}: became shorter while it was read")
    return made
