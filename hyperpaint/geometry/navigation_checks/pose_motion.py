"""Motion of a picture from row to row as expected from poses, and the inputs of a check."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base.arrays import Bools, Floats
from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.constants import WGS84_ECCENTRICITY_SQUARED, WGS84_SEMI_MAJOR_AXIS_M
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.schema import ALONG_TRACK, require
from hyperpaint.geometry.georeference.attitude_rotations import matrices, quaternions
from hyperpaint.geometry.georeference.cameras import PinholeCamera, look_angles
from hyperpaint.geometry.georeference.poses import (
    NAVIGATION_TIME,
    POSE,
    canonical_values,
    convention_of_line,
    poses_at,
)

from .picture_motion import RowMotion, picture_of, row_motion

#: Minimum downward component of a unit direction for an intersection with the ground.
_MIN_DOWNWARD = 0.05


@dataclass(frozen=True)
class Motion:
    """Expected motion from each row to the next; see `picture_motion.RowMotion`."""

    shift: Floats  #: (line - 1, zone): sideways [pixel]
    travel: Floats  #: (line - 1, zone): across the row, forward positive [pixel of the row]


@dataclass(frozen=True)
class Recorded:
    """Poses as recorded, and the times of the lines."""

    times: npt.NDArray[np.datetime64]  #: (row,): times of the record
    columns: dict[str, Floats]  #: Values (row,) in the units of the file, by the name of the variable
    line_times: npt.NDArray[np.datetime64]  #: (line,): mid exposures
    crs: Any = None  #: Map whose north grid headings count from

    def at(self, convention: Convention, clock_offset_s: float = 0.0) -> Floats:
        """Return canonical poses (6, line) under ``convention``."""
        columns = (self.columns[name] for name in POSE)
        values = canonical_values(*columns, convention=convention, crs=self.crs)
        return poses_at(self.times, values, self.line_times, clock_offset_s=clock_offset_s)


@dataclass(frozen=True)
class View:
    """Viewing geometry of a camera in its platform."""

    #: (zone,): tangents of the middle of every zone, to the right and forward, columns from left to right
    right: Floats
    forward: Floats
    step: Floats  #: (zone,): change of ``right`` from a column to the next
    boresight: tuple[float, ...]  #: Roll, pitch, heading of the camera in the body [degree]
    lever_arm: tuple[float, ...]  #: Forward, right, down [m]
    ground: float  #: Height of the ground above the ellipsoid [m]

    def motion(self, poses: Floats, *, boresight: tuple[float, ...] | None = None) -> Motion:
        """Return the motion that follows from poses (6, line); NaN without a pose."""
        north, east = local_metres(poses[0], poses[1])
        body = matrices(quaternions(*poses[3:]))
        camera = body @ matrices(quaternions(*(boresight or self.boresight)))
        origin = np.stack([north, east], axis=-1)
        lever_arm = body @ np.array(self.lever_arm)
        height = poses[2] - lever_arm[:, 2] - self.ground
        position = self._hits(origin + lever_arm[:, :2], height, camera, 0.0)
        pixel_step = self._hits(origin + lever_arm[:, :2], height, camera, 1.0) - position
        travel = np.diff(position, axis=0)
        pixel_step = (pixel_step[1:] + pixel_step[:-1]) / 2
        area = (pixel_step**2).sum(axis=-1)
        with np.errstate(invalid="ignore", divide="ignore"):
            sideways = (travel * pixel_step).sum(axis=-1) / area
            forward = (travel[..., 0] * pixel_step[..., 1] - travel[..., 1] * pixel_step[..., 0]) / area
        return Motion(sideways, forward * np.sign(self.step))

    def _hits(self, origin: Floats, height: Floats, rotation: Floats, columns: float) -> Floats:
        u = np.stack([self.forward, self.right + columns * self.step, np.ones_like(self.right)], axis=-1)
        d = np.einsum("nij,zj->nzi", rotation, u)
        with np.errstate(invalid="ignore", divide="ignore"):
            s = np.where(d[..., 2] > _MIN_DOWNWARD, height[:, None] / d[..., 2], np.nan)
        return np.asarray(origin[:, None] + s[..., None] * d[..., :2])


def local_metres(latitude: Floats, longitude: Floats) -> tuple[Floats, Floats]:
    """Return metres to the north and to the east of the first located line; valid within a flight line."""
    located = np.flatnonzero(np.isfinite(latitude) & np.isfinite(longitude))
    if not located.size:
        return np.full(latitude.shape, np.nan), np.full(latitude.shape, np.nan)
    start = located[0]
    phi = np.radians(latitude[start])
    squared = 1.0 - WGS84_ECCENTRICITY_SQUARED * np.sin(phi) ** 2
    meridian = WGS84_SEMI_MAJOR_AXIS_M * (1.0 - WGS84_ECCENTRICITY_SQUARED) / squared**1.5
    parallel = WGS84_SEMI_MAJOR_AXIS_M / np.sqrt(squared) * np.cos(phi)
    north = np.radians(latitude - latitude[start]) * meridian
    return north, np.radians(longitude - longitude[start]) * parallel


def course_of(poses: Floats) -> float:
    """Return the direction from the first to the last located line, clockwise from true north [degree]."""
    north, east = local_metres(poses[0], poses[1])
    located = np.flatnonzero(np.isfinite(north))
    if located.size < 2:
        return float("nan")
    return float(np.degrees(np.arctan2(east[located[-1]], north[located[-1]])) % 360.0)


# --- inputs of a check -------------------------------------------------------------------------


#: Lines of a check by default, from the middle of the flight line.
MAX_LINES = 4000
_MIN_LINES = 64
#: Interval above which frames are missing between two lines [median intervals].
_MAX_STEADY_INTERVALS = 1.5


@dataclass(frozen=True)
class Setting:
    """Inputs of a check of one line."""

    declared: Convention  #: Declared convention of the record
    recorded: Recorded  #: Poses as recorded
    observed: RowMotion  #: Motion of the picture
    view: View  #: Viewing geometry, columns from left to right
    columns_matter: bool  #: Whether the order of columns is tested
    interval: float  #: Time between lines [s]
    exposure: float  #: Exposure time [s]; NaN where unknown
    lines: slice  #: Lines of the check

    @property
    def is_steady(self) -> Bools:
        """Return the lines after which no frame is missing (line - 1,)."""
        steps = np.diff(self.recorded.line_times.astype(np.int64).astype(np.float64)) / 1e9
        return np.asarray((steps > 0) & (steps < _MAX_STEADY_INTERVALS * self.interval))

    def comparable(self, expected: Motion) -> Bools:
        """Return where picture and poses have a motion and no frame is missing (line - 1, zone)."""
        is_seen = np.isfinite(self.observed.shift) & np.isfinite(self.observed.unlikeness)
        return np.asarray(is_seen & np.isfinite(expected.shift) & self.is_steady[:, None])


def setting_of(
    line: xr.Dataset,
    navigation: xr.Dataset | None,
    *,
    convention: Convention | None,
    camera: Any,
    ground: float | None,
    boresight: Sequence[float],
    lever_arm: Sequence[float],
    image: xr.DataArray | None,
    lines: slice | None,
    crs: Any,
) -> Setting:
    """Return the inputs of a check (eager: reads a few bands of the lines).

    Raises
    ------
    SchemaError
        No convention, camera, height of the ground, pose or picture; too few lines or columns.
    """
    declared = convention_of_line(line, navigation, convention)
    if declared.stamp_reference is None:
        declared = declared.replace(stamp_reference=line.attrs.get("convention_stamp_reference"))
    ground = line.attrs.get("ground") if ground is None else float(ground)
    if not isinstance(ground, int | float):
        raise SchemaError(
            "the height of the ground is missing",
            mend="give ground= [m above the ellipsoid]",
            code="ground-height-missing",
        )
    first = max((line.sizes[ALONG_TRACK] - MAX_LINES) // 2, 0)
    selected = slice(first, min(first + MAX_LINES, line.sizes[ALONG_TRACK])) if lines is None else lines
    part = line.isel({ALONG_TRACK: selected})
    if part.sizes[ALONG_TRACK] < _MIN_LINES:
        raise SchemaError(
            f"{part.sizes[ALONG_TRACK]} lines", expected=f"at least {_MIN_LINES}", code="line-too-short"
        )
    observed = row_motion(picture_of(part, None if image is None else image.isel({ALONG_TRACK: selected})))
    if observed is None:
        raise SchemaError(
            "the picture is too narrow or without contrast",
            expected="at least 64 columns",
            code="picture-narrow",
        )
    tangents = look_angles(line, camera, Convention(column_order="left_to_right"))
    right_tangents, forward_tangents = (np.tan(np.radians(np.asarray(angles))) for angles in tangents)
    look_right, look_forward, step = (
        np.interp(observed.centres, np.arange(right_tangents.size), values)
        for values in (right_tangents, forward_tangents, np.gradient(right_tangents))
    )
    (forward, right, down), (roll, pitch, heading) = (map(float, mount) for mount in (lever_arm, boresight))
    view = View(look_right, look_forward, step, (roll, pitch, heading), (forward, right, down), float(ground))
    # poses as recorded, whatever their units
    source, dim = (part, ALONG_TRACK) if navigation is None else (navigation, NAVIGATION_TIME)
    line_times = require(part, ["time"], "a check of navigation")["time"].values
    names = POSE if navigation is None else (*POSE, NAVIGATION_TIME)
    missing = [name for name in names if name not in source.variables or source[name].dims != (dim,)]
    if missing:
        subject = "this line" if navigation is None else "this navigation record"
        raise SchemaError(
            f"{subject} has no {', '.join(missing)} ({dim})",
            mend="give navigation=hp.open_navigation(...)",
            code="variable-missing",
        )
    times = line_times if navigation is None else source[NAVIGATION_TIME].values
    columns = {name: np.asarray(source[name].values, np.float64) for name in POSE}
    recorded = Recorded(times.astype("datetime64[ns]"), columns, line_times.astype("datetime64[ns]"), crs)
    steps = np.diff(recorded.line_times.astype(np.int64)) / 1e9
    exposure = float(np.median(part["exposure_time"].values)) if "exposure_time" in part.variables else np.nan
    # a table of look angles has signs, which define the order of columns
    columns_matter = isinstance(camera, PinholeCamera)
    interval = float(np.median(steps[steps > 0]))
    return Setting(declared, recorded, observed, view, columns_matter, interval, exposure, selected)
