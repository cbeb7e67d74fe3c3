"""Surveyed points in the camera's frame: computed minus observed directions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base.arrays import Bools, Floats, Ints
from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.constants import WGS84_ECCENTRICITY_SQUARED, WGS84_SEMI_MAJOR_AXIS_M
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.schema import require
from hyperpaint.geometry.georeference.attitude_rotations import matrices, quaternions
from hyperpaint.geometry.georeference.cameras import look_angles
from hyperpaint.geometry.georeference.geodesy import between_maps, crs_of
from hyperpaint.geometry.georeference.poses import (
    NAVIGATION_TIME,
    canonical_values,
    convention_of_line,
    pose_columns,
    poses_at,
)

#: Duration of the record that is kept around every point, the range of clock offsets [s].
_AROUND_S = 3.0
#: Minimum uncertainty of picking [pixel].
_MIN_PICKING_PX = 0.05


@dataclass(frozen=True)
class Sightings:
    """The points of one line."""

    times: npt.NDArray[np.datetime64]  #: (row,): canonical record around the points
    poses: Floats  #: (6, row): canonical record around the points
    #: (point,): time of the point, interpolated between mid exposures of lines
    observed_at: npt.NDArray[np.datetime64]
    line_time: Floats  #: (point,): time between lines at the point [s]
    ground: Floats  #: (point, 3): geocentric coordinates [m]
    forward: Floats  #: (point,): tangents of the column
    right: Floats
    step: Floats  #: (point, 2): change of both tangents from a column to the next
    lever_arm: tuple[float, ...]  #: Forward, right, down [m]
    index: Ints  #: (point,): numbers of the points among the points of all lines
    field_of_view: float  #: Distance between the outermost columns [tangent]
    _cache: dict[tuple[float, float], Floats] = field(default_factory=dict, repr=False)

    def misses(self, mounting: Floats, lines: float = 0.0) -> Floats:
        """Return computed minus observed directions of points (point, 2): forward, right [tangent].

        ``mounting`` is roll, pitch, heading of the camera in the body [degree], offset added to the altitude
        of the record [m], and offset added to the time of the line [s]; ``lines`` is the number of lines by
        which the observation is shifted to later times.
        """
        vector = self._vectors(mounting, lines)
        return np.asarray(vector[:, :2] / vector[:, 2:] - np.stack([self.forward, self.right], axis=-1))

    def behind(self, mounting: Floats) -> Bools:
        """Return the points behind the camera (point,), whose residuals have no meaning."""
        return np.asarray(self._vectors(mounting, 0.0)[:, 2] <= 0.0)

    def hits(self, mounting: Floats, height: Floats) -> Floats:
        """Return geocentric positions (point, 3) where the lines of sight reach a height [m]."""
        *boresight, height_offset, clock = mounting.tolist()
        poses = self._poses(clock, 0.0)
        body = matrices(quaternions(*poses[3:]))
        centre, axes = _geocentric(poses[0], poses[1], poses[2] + height_offset)
        look = np.stack([self.forward, self.right, np.ones_like(self.right)], axis=-1)
        lever_arm = body @ np.array(self.lever_arm)
        ray = np.einsum("nij,nj->ni", body, look @ matrices(quaternions(*boresight)).T)
        vertical = poses[2] + height_offset - lever_arm[:, 2] - height[self.index]
        horizontal_squared = (ray[:, :2] ** 2).sum(axis=-1)
        distance = vertical / ray[:, 2]
        # a surface of equal height is 8 cm below the tangent plane at a kilometre
        for _ in range(2):
            distance = (vertical + distance**2 * horizontal_squared / (2.0 * WGS84_SEMI_MAJOR_AXIS_M)) / ray[
                :, 2
            ]
        return np.asarray(centre + np.einsum("nji,nj->ni", axes, lever_arm + distance[:, None] * ray))

    def whitening(self, mounting: Floats) -> Floats:
        """Return the matrix that converts residuals to pixels of picking (point, 2, 2).

        A pixel along the track and a pixel across move a point in two directions of the camera's frame. With
        equal uncertainty of picking in both, the converted residuals have unit covariance.
        """
        per_line = self.misses(mounting, 0.5) - self.misses(mounting, -0.5)
        floor = _MIN_PICKING_PX**2 * (self.step**2).sum(axis=-1)[:, None, None] * np.eye(2)
        covariance = (
            per_line[:, :, None] * per_line[:, None] + self.step[:, :, None] * self.step[:, None] + floor
        )
        return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))

    def _vectors(self, mounting: Floats, lines: float) -> Floats:
        # Return the vectors from the camera to the points in its frame (point, 3) [m].
        *boresight, height, clock = mounting.tolist()
        poses = self._poses(clock, lines)
        body = matrices(quaternions(*poses[3:]))
        centre, axes = _geocentric(poses[0], poses[1], poses[2] + height)
        # axes: north, east, down as rows, geocentric
        vector = np.einsum("nij,nj->ni", axes, self.ground - centre)
        vector = np.einsum("nji,nj->ni", body, vector) - np.array(self.lever_arm)
        return np.asarray(vector @ matrices(quaternions(*boresight)))

    def _poses(self, clock: float, lines: float) -> Floats:
        if (clock, lines) not in self._cache:
            if len(self._cache) > 16:
                self._cache.clear()
            times = self.observed_at + np.round(lines * self.line_time * 1e9).astype("timedelta64[ns]")
            self._cache[clock, lines] = poses_at(self.times, self.poses, times, clock_offset_s=clock)
        return self._cache[clock, lines]


def _geocentric(latitude: Floats, longitude: Floats, height: Floats) -> tuple[Floats, Floats]:
    # Return geocentric coordinates (n, 3), and the directions north, east, down at them (n, 3, 3).
    phi, lam = np.radians(latitude), np.radians(longitude)
    sp, cp, sl, cl = np.sin(phi), np.cos(phi), np.sin(lam), np.cos(lam)
    radius = WGS84_SEMI_MAJOR_AXIS_M / np.sqrt(1.0 - WGS84_ECCENTRICITY_SQUARED * sp**2)
    position = np.stack(
        [
            (radius + height) * cp * cl,
            (radius + height) * cp * sl,
            (radius * (1.0 - WGS84_ECCENTRICITY_SQUARED) + height) * sp,
        ],
        axis=-1,
    )
    axes = [[-sp * cl, -sp * sl, cp], [-sl, cl, np.zeros_like(sp)], [-cp * cl, -cp * sl, -sp]]
    return position, np.stack([np.stack(row, axis=-1) for row in axes], axis=-2)


def sightings_of(
    line: xr.Dataset,
    points: Mapping[str, Any],
    index: Ints,
    *,
    navigation: xr.Dataset | None,
    convention: Convention | None,
    camera: Any,
    lever_arm: tuple[float, ...],
    crs: Any,
    clock: float,
) -> Sightings:
    """Return the view of a line on points: columns ``along_track_pixel`` ... ``height`` (point,).

    Raises
    ------
    SchemaError
        Points are outside the line, or where it has no time or pose; no convention, camera or pose.
    """
    declared = convention_of_line(line, navigation, convention)
    columns = pose_columns(line if navigation is None else navigation, declared)
    values = canonical_values(*(column.values for column in columns.values()), convention=declared, crs=crs)
    time = require(line, ["time"], "control points")["time"].values.astype("datetime64[ns]")
    recorded = time if navigation is None else navigation[NAVIGATION_TIME].values.astype("datetime64[ns]")
    line_position, column = (
        np.asarray(points[f"{name}_pixel"], np.float64) for name in ("along_track", "cross_track")
    )
    across, along = (np.tan(np.radians(np.asarray(a))) for a in look_angles(line, camera, declared))
    is_outside = ~(
        (line_position >= -0.5)
        & (line_position <= time.size - 0.5)
        & (column >= -0.5)
        & (column <= across.size - 0.5)
    )
    if is_outside.any() or time.size < 2:
        raise SchemaError(
            f"points {index[is_outside].tolist()} are outside {time.size} lines of {across.size} columns",
            code="pixel-outside",
        )
    line_before = np.clip(np.floor(line_position).astype(np.int64), 0, time.size - 2)
    steps = (time[line_before + 1] - time[line_before]).astype(np.int64)
    observed_at = time[line_before] + np.round((line_position - line_before) * steps).astype(
        "timedelta64[ns]"
    )
    record_times, is_near = (
        observed_at + np.timedelta64(round(clock * 1e9), "ns"),
        np.zeros(recorded.size, bool),
    )
    reach = np.timedelta64(round(_AROUND_S * 1e9), "ns")
    for time_of_point in record_times[~np.isnat(record_times)]:
        is_near |= np.abs(recorded - time_of_point) <= reach
    positions = between_maps(np.stack([points["east"], points["north"]], -1), crs_of(crs), "OGC:CRS84")
    numbers = np.arange(across.size)
    step = np.stack([np.gradient(along), np.gradient(across)], axis=-1)
    ground, _ = _geocentric(positions[:, 1], positions[:, 0], np.asarray(points["height"], np.float64))
    sightings = Sightings(
        recorded[is_near], values[:, is_near], observed_at, steps / 1e9, ground,
        _extrapolated(column, numbers, along), _extrapolated(column, numbers, across),
        step[np.clip(np.round(column).astype(np.int64), 0, across.size - 1)], lever_arm, index,
        float(np.hypot(np.ptp(along), np.ptp(across))),
    )  # fmt: skip
    is_missing: Bools = np.ones(line_position.size, bool)
    if is_near.any():
        is_missing[:] = ~np.isfinite(sightings.misses(np.array([0.0, 0.0, 0.0, 0.0, clock]))).all(axis=1)
    if is_missing.any():
        raise SchemaError(
            f"points {index[is_missing].tolist()} are on lines without time or pose",
            mend="check the record for gaps",
            code="pose-missing",
        )
    return sightings


def _extrapolated(x: Floats, index: Ints, values: Floats) -> Floats:
    # Interpolate linearly, and extrapolate beyond the ends.
    interpolated = np.interp(x, index, values)
    low, high = np.minimum(x, 0.0), np.maximum(x - index[-1], 0.0)
    if values.size < 2:
        return np.asarray(interpolated)
    return np.asarray(interpolated + low * (values[1] - values[0]) + high * (values[-1] - values[-2]))
