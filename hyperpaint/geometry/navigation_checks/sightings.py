"""Surveyed points in the camera's frame: computed and observed directions."""

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

#: Seconds of a record around every point that are kept, for the clock to be moved in.
_AROUND_S = 3.0
#: Part of a pixel that picking is uncertain by, even on a platform at rest.
_MIN_PICKING_PX = 0.05


@dataclass(frozen=True)
class Sightings:
    """The points of one line."""

    times: npt.NDArray[np.datetime64]  #: (row,): canonical record around the points
    poses: Floats  #: (6, row): canonical record around the points
    #: (point,): mid exposure of the line, a fraction of which the point is at
    seen: npt.NDArray[np.datetime64]
    line_time: Floats  #: (point,): time from line to line there [s]
    ground: Floats  #: (point, 3): geocentric coordinates [m]
    forward: Floats  #: (point,): tangents of the column
    right: Floats
    step: Floats  #: (point, 2): change of these from a column to the next
    lever_arm: tuple[float, float, float]  #: Forward, right, down [m]
    index: Ints  #: (point,): which of all points they are
    field_of_view: float  #: Way between the outermost columns [tangent]
    _cache: dict[tuple[float, float], Floats] = field(default_factory=dict, repr=False)

    def misses(self, mounting: Floats, lines: float = 0.0) -> Floats:
        """Return by how much points are not where they were seen (point, 2): forward, right [tangent].

        ``mounting`` is roll, pitch, heading of the camera in the body [degree], what is added to the altitude
        of the record [m], and to the time of the line [s]; ``lines`` is by how many lines the points are
        taken to be seen later than they were.
        """
        way = self._ways(mounting, lines)
        return np.asarray(way[:, :2] / way[:, 2:] - np.stack([self.forward, self.right], axis=-1))

    def behind(self, mounting: Floats) -> Bools:
        """Return the points behind the camera (point,), whose residuals have no meaning."""
        return np.asarray(self._ways(mounting, 0.0)[:, 2] <= 0.0)

    def hits(self, mounting: Floats, height: Floats) -> Floats:
        """Return geocentric places (point, 3) where the lines of sight reach a height [m]."""
        *boresight, above, clock = mounting.tolist()
        poses = self._poses(clock, 0.0)
        body = matrices(quaternions(*poses[3:]))
        centre, axes = _place(poses[0], poses[1], poses[2] + above)
        look = np.stack([self.forward, self.right, np.ones_like(self.right)], axis=-1)
        arm = body @ np.array(self.lever_arm)
        ray = np.einsum("nij,nj->ni", body, look @ matrices(quaternions(*boresight)).T)
        fall = poses[2] + above - arm[:, 2] - height[self.index]
        aside = (ray[:, :2] ** 2).sum(axis=-1)
        reach = fall / ray[:, 2]
        # ground of equal height falls off under the tangent plane by 8 cm in a kilometre
        for _ in range(2):
            reach = (fall + reach**2 * aside / (2.0 * WGS84_SEMI_MAJOR_AXIS_M)) / ray[:, 2]
        return np.asarray(centre + np.einsum("nji,nj->ni", axes, arm + reach[:, None] * ray))

    def whitening(self, mounting: Floats) -> Floats:
        """Return the matrix that turns residuals into pixels of picking (point, 2, 2).

        A pixel in the line and one in the column move a point by two directions in the camera's frame; what
        is picked with the same care in both is then of unit covariance.
        """
        moved = self.misses(mounting, 0.5) - self.misses(mounting, -0.5)
        floor = _MIN_PICKING_PX**2 * (self.step**2).sum(axis=-1)[:, None, None] * np.eye(2)
        both = moved[:, :, None] * moved[:, None] + self.step[:, :, None] * self.step[:, None] + floor
        return np.asarray(np.linalg.inv(np.linalg.cholesky(both)))

    def _ways(self, mounting: Floats, lines: float) -> Floats:
        # from the camera to the points, in its frame (point, 3) [m]
        *boresight, height, clock = mounting.tolist()
        poses = self._poses(clock, lines)
        body = matrices(quaternions(*poses[3:]))
        centre, axes = _place(poses[0], poses[1], poses[2] + height)
        # axes: north, east, down as rows, geocentric
        way = np.einsum("nij,nj->ni", axes, self.ground - centre)
        way = np.einsum("nji,nj->ni", body, way) - np.array(self.lever_arm)
        return np.asarray(way @ matrices(quaternions(*boresight)))

    def _poses(self, clock: float, lines: float) -> Floats:
        if (clock, lines) not in self._cache:
            if len(self._cache) > 16:
                self._cache.clear()
            wanted = self.seen + np.round(lines * self.line_time * 1e9).astype("timedelta64[ns]")
            self._cache[clock, lines] = poses_at(self.times, self.poses, wanted, clock_offset_s=clock)
        return self._cache[clock, lines]


def _place(latitude: Floats, longitude: Floats, height: Floats) -> tuple[Floats, Floats]:
    # geocentric coordinates (n, 3) and the directions north, east, down there (n, 3, 3)
    phi, lam = np.radians(latitude), np.radians(longitude)
    sp, cp, sl, cl = np.sin(phi), np.cos(phi), np.sin(lam), np.cos(lam)
    radius = WGS84_SEMI_MAJOR_AXIS_M / np.sqrt(1.0 - WGS84_ECCENTRICITY_SQUARED * sp**2)
    place = np.stack(
        [
            (radius + height) * cp * cl,
            (radius + height) * cp * sl,
            (radius * (1.0 - WGS84_ECCENTRICITY_SQUARED) + height) * sp,
        ],
        axis=-1,
    )
    axes = [[-sp * cl, -sp * sl, cp], [-sl, cl, np.zeros_like(sp)], [-cp * cl, -cp * sl, -sp]]
    return place, np.stack([np.stack(row, axis=-1) for row in axes], axis=-2)


def sightings_of(
    line: xr.Dataset,
    points: Mapping[str, Any],
    index: Ints,
    *,
    navigation: xr.Dataset | None,
    convention: Convention | None,
    camera: Any,
    lever_arm: tuple[float, float, float],
    crs: Any,
    clock: float,
) -> Sightings:
    """Return the view of a line on points: columns ``along_track_pixel`` ... ``height`` (point,).

    Raises
    ------
    SchemaError
        Points are outside the line, or where it has no time or pose; no convention, camera or pose.
    """
    meant = convention_of_line(line, navigation, convention)
    columns = pose_columns(line if navigation is None else navigation, meant)
    values = canonical_values(*(column.values for column in columns.values()), convention=meant, crs=crs)
    time = require(line, ["time"], "control points")["time"].values.astype("datetime64[ns]")
    recorded = time if navigation is None else navigation[NAVIGATION_TIME].values.astype("datetime64[ns]")
    at, column = (np.asarray(points[f"{name}_pixel"], np.float64) for name in ("along_track", "cross_track"))
    across, along = (np.tan(np.radians(np.asarray(a))) for a in look_angles(line, camera, meant))
    outside = ~((at >= -0.5) & (at <= time.size - 0.5) & (column >= -0.5) & (column <= across.size - 0.5))
    if outside.any() or time.size < 2:
        raise SchemaError(
            f"points {index[outside].tolist()} are outside {time.size} lines of {across.size} columns",
            code="pixel-outside",
        )
    before = np.clip(np.floor(at).astype(np.int64), 0, time.size - 2)
    steps = (time[before + 1] - time[before]).astype(np.int64)
    seen = time[before] + np.round((at - before) * steps).astype("timedelta64[ns]")
    moment, rows = seen + np.timedelta64(round(clock * 1e9), "ns"), np.zeros(recorded.size, bool)
    around = np.timedelta64(round(_AROUND_S * 1e9), "ns")
    for one in moment[~np.isnat(moment)]:
        rows |= np.abs(recorded - one) <= around
    places = between_maps(np.stack([points["east"], points["north"]], -1), crs_of(crs), "OGC:CRS84")
    index_of = np.arange(across.size)
    step = np.stack([np.gradient(along), np.gradient(across)], axis=-1)
    ground, _ = _place(places[:, 1], places[:, 0], np.asarray(points["height"], np.float64))
    sightings = Sightings(
        recorded[rows], values[:, rows], seen, steps / 1e9, ground, _beyond(column, index_of, along),
        _beyond(column, index_of, across),
        step[np.clip(np.round(column).astype(np.int64), 0, across.size - 1)], lever_arm, index,
        float(np.hypot(np.ptp(along), np.ptp(across))),
    )  # fmt: skip
    missing: Bools = np.ones(at.size, bool)
    if rows.any():
        missing[:] = ~np.isfinite(sightings.misses(np.array([0.0, 0.0, 0.0, 0.0, clock]))).all(axis=1)
    if missing.any():
        raise SchemaError(
            f"points {index[missing].tolist()} are on lines without time or pose",
            mend="look at gaps of the record",
            code="pose-missing",
        )
    return sightings


def _beyond(at: Floats, index: Ints, values: Floats) -> Floats:
    # extrapolates half a step beyond the ends
    inside = np.interp(at, index, values)
    low, high = np.minimum(at, 0.0), np.maximum(at - index[-1], 0.0)
    if values.size < 2:
        return np.asarray(inside)
    return np.asarray(inside + low * (values[1] - values[0]) + high * (values[-1] - values[-2]))
