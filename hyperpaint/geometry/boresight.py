"""Solution for the mounting and the clock of a camera from control or tie points."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Array, Bools, Floats, Ints
from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.constants import WGS84_ECCENTRICITY_SQUARED, WGS84_SEMI_MAJOR_AXIS_M
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.schema import require
from hyperpaint.base.units import takes_quantities
from hyperpaint.geometry.georeference.geodesy import between_maps, crs_of, east_north_up
from hyperpaint.geometry.georeference.locating import (
    LOCATION_UNITS,
    NAVIGATION_TIME,
    PinholeCamera,
    canonical_values,
    convention_of_line,
    look_angles,
    matrices,
    pose_columns,
    poses_at,
    quaternions,
)

#: Parameters that can be solved for: unit, step of numerical derivatives, and largest useful uncertainty from
#: points picked to one pixel.
_PARAMETERS = {
    "roll": ("degree", 1e-3, 5.0),
    "pitch": ("degree", 1e-3, 5.0),
    "heading": ("degree", 1e-3, 5.0),
    "height": ("m", 1e-3, 50.0),
    "clock": ("s", 5e-4, 1.0),
}
PARAMETERS = tuple(_PARAMETERS)
_STEPS = np.array([step for _, step, _ in _PARAMETERS.values()])
_FIELDS = ("along_track_pixel", "cross_track_pixel", "east", "north", "height")
#: Duration of the record that is kept around every point, the range of clock offsets [s].
_AROUND_S = 3.0
#: Minimum uncertainty of picking [pixel].
_MIN_PICKING_PX = 0.05


@dataclass(frozen=True)
class Rules:
    """Thresholds of a solution, and where they come from."""

    #: Largest factor by which the other solved parameters may widen the uncertainty of a parameter.
    max_widening: float = 30.0
    #: Standard deviations of picking beyond which a point is left out: 1 in 25,000 valid points.
    outlier_sd: float = 4.5
    max_outlier_rounds: int = 10
    #: Tested clock offsets relative to the start value [s]: every period of a wobble has a local minimum.
    clock_search_s: tuple[float, ...] = tuple((np.arange(-10, 11) * 0.1).tolist())
    max_clock_candidates: int = 3
    #: Largest residual of a candidate relative to the best one.
    candidate_ratio: float = 3.0
    soft_miss_px: float = 5.0  #: misses above this have less weight in the search of the clock
    #: Smallest accepted ratio of the residual of another clock offset to that of the best one.
    rival_ratio: float = 1.3
    same_clock_s: float = 0.05  #: clock offsets nearer than this are equal
    #: Deviation from the median miss above which a point is a blunder [fields of view].
    blunder_fields: float = 2.0


RULES = Rules()


@dataclass(frozen=True)
class BoresightSolution:
    """Mounting of a camera in its platform, and its clock offset.

    Attributes
    ----------
    boresight
        Roll, pitch, heading of the camera in the body [degree], as `hyperpaint.geometry.locate` takes them.
    height_offset_m
        To be added to the altitude of the record; equivalently, `hyperpaint.geometry.locate` takes a
        ``ground`` lower by as much [m].
    clock_offset_s
        To be added to the time of lines, as `hyperpaint.geometry.locate` takes it [s].
    covariance : (parameter, other_parameter)
        Covariance of the solved parameters, in their units.
    points
        ``miss`` [pixel] and ``outlier`` of every point (point).
    picking_sd
        Standard deviation of a picked line or column, from the residuals of the points [pixel].
    condition
        Ratio of the largest to the smallest singular value, columns scaled to unit length.
    """

    boresight: tuple[float, float, float]
    height_offset_m: float
    clock_offset_s: float
    covariance: xr.DataArray
    points: xr.Dataset
    picking_sd: float
    condition: float

    @property
    def solved(self) -> tuple[str, ...]:
        # Names of the parameters solved for.
        return tuple(str(name) for name in self.covariance["parameter"].values)

    @property
    def sd(self) -> dict[str, float]:
        # Standard uncertainty of the parameters solved for, in their units.
        variance = np.diag(self.covariance.values)
        return {name: float(np.sqrt(v)) for name, v in zip(self.solved, variance, strict=True)}

    def value(self, name: str) -> float:
        # Return one parameter: roll, pitch, heading [degree], height [m] or clock [s].
        return (*self.boresight, self.height_offset_m, self.clock_offset_s)[PARAMETERS.index(name)]

    def table(self) -> str:
        # Return the solution as text.
        sd = self.sd
        uncertainties = {n: f"+- {sd[n]:.5f}" if n in sd else "as given" for n in PARAMETERS}
        rows = [f"{n:8} {self.value(n):+12.5f} {uncertainties[n]:12} {_PARAMETERS[n][0]}" for n in PARAMETERS]
        outliers = self.points["point"].values[self.points["outlier"].values].tolist()
        n_used = int((~self.points["outlier"]).sum())
        rows += [
            f"{n_used} points, {self.picking_sd:.2f} pixel left, condition {self.condition:.1f}",
            f"left out: {', '.join(map(str, outliers))}" if outliers else "no point left out",
        ]
        return "\n".join(rows)


@takes_quantities(**LOCATION_UNITS)
def solve_boresight(
    lines: xr.Dataset | Mapping[str, xr.Dataset],
    control_points: xr.Dataset,
    *,
    navigation: xr.Dataset | Mapping[str, xr.Dataset] | None = None,
    solve: Sequence[str] | None = None,
    boresight: Sequence[float] = (0.0, 0.0, 0.0),
    lever_arm: Sequence[float] = (0.0, 0.0, 0.0),
    clock_offset_s: float = 0.0,
    camera: PinholeCamera | xr.Dataset | None = None,
    convention: Convention | None = None,
    crs: Any = None,
    largest_picking_sd: float = 3.0,
) -> BoresightSolution:
    r"""Solve for the mounting of a camera, and its clock offset, from control or tie points (eager).

    Parameters
    ----------
    lines
        A flight line, or several by their names.
    control_points
        ``along_track_pixel``, ``cross_track_pixel``: position of a point in the line, fractions of a pixel
        from the centre of the first; ``east``, ``north`` and ``height`` above the ellipsoid of the point
        (point) [m]; with several lines ``flightline``. See `hyperpaint.io.read_control_points`. Or tie points
        (point, side), whose ground position is unknown, as `hyperpaint.geometry.find_tie_points` returns
        them.
    navigation
        See `hyperpaint.geometry.locate`; one record for all lines, or one per line by its name.
    solve
        Which of ``"roll"``, ``"pitch"``, ``"heading"``, ``"height"`` (added to the record's altitude) and
        ``"clock"`` (added to the lines' time); the rest stay as passed. By default all for control points,
        and the three angles for tie points.
    boresight, lever_arm, clock_offset_s
        Start values; ``lever_arm`` is not solved for.
    camera, convention
        See `hyperpaint.geometry.locate`.
    crs
        Map of ``east`` and ``north``; by default the attribute ``crs`` of the points.
    largest_picking_sd
        Largest accepted residual of the points kept; a larger one is not an error of picking and is refused
        [pixel]. Raise it where, for example, positions are less accurate.

    Returns
    -------
    BoresightSolution
        Values, covariance, and the residual of every point; points that do not fit are named and left out.

    Raises
    ------
    SchemaError
        These points do not determine the parameters, which are named with the reason; several clock offsets
        fit equally well, or none fits; points outside of lines, of lines that are not passed, or without a
        pose; variables or a map are missing.
    MissingExtraError
        pyproj is not installed (extra ``geo``).

    Notes
    -----
    Least squares of residuals in the camera's frame: the point's direction,
    :math:`(R_{nb} R_{bc})^T (x - p)`, minus the direction of the column at the time of the line, in
    units of pixels of picking, equal for line and column. Points are first weighted by soft-L1, then those
    beyond 4.5 standard deviations are left out and the solution is repeated. The covariance is :math:`s^2
    (J^T J)^{-1}`, with :math:`s` from the residuals.

    The sum of squares has a minimum for every period of a wobble: the clock offset is searched within 1 s of
    its start value. Points that miss by more than twice the field of view are left out from the start.

    The ground position of a tie point is the mean of the positions where both lines of sight reach its
    ``height``, for any parameters. Lines of one course and height all shift equally, and do not determine
    pitch, height or clock: that needs opposite and crossing lines.

    Pitch and clock both move points along the track, equally on a line without rotation. Lines of
    opposite courses separate them, as does the wobble of the platform.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> from hyperpaint.geometry import locate
    >>> from hyperpaint.simulation import simulate_line
    >>> mounted = dict(boresight=(0.4, -0.6, 0.8))
    >>> line = simulate_line(scene="checkerboard", lines=400, bands=2, columns=320, **mounted)
    >>> located = locate(line, ground=160.0, crs="EPSG:32618", **mounted)
    >>> lines, columns = np.array([20, 100, 200, 300, 380]), np.array([10, 300, 160, 20, 310])
    >>> places = {name: ("point", located[name].values[lines, columns]) for name in ("east", "north")}
    >>> points = xr.Dataset(places)
    >>> points = points.assign(along_track_pixel=("point", lines), cross_track_pixel=("point", columns))
    >>> points = points.assign(height=("point", np.full(5, 160.0))).assign_attrs(crs="EPSG:32618")
    >>> np.round(solve_boresight(line, points, solve=("roll", "pitch", "heading")).boresight, 4)
    array([ 0.4, -0.6,  0.8])
    """
    pairs = control_points.sizes["point"] if "side" in control_points.dims else 0
    if pairs:
        # points in the first line of each pair, then points in the second
        control_points = xr.concat(
            [control_points.isel(side=side) for side in range(2)], "point", data_vars="all"
        )
    # Names to solve for, once arguments and points are valid
    solve = (PARAMETERS[:3] if pairs else PARAMETERS) if solve is None else solve
    names = [name for name in PARAMETERS if name in solve]
    missing = [
        name
        for name in _FIELDS
        if name not in control_points.variables or control_points[name].dims != ("point",)
    ]
    is_finite = bool(missing) or all(np.isfinite(control_points[name].values).all() for name in _FIELDS)
    # faults of the arguments come before faults of the numbers
    tables = (
        (
            (
                isinstance(solve, str) or not names or bool(set(solve) - set(PARAMETERS)),
                f"solve {solve!r:.80}", f"some of {', '.join(PARAMETERS)}", "", "choice-unknown",
            ),
            (
                bool(missing),
                f"control points have no {', '.join(missing)} (point)", "",
                "see hyperpaint.io.read_control_points", "variable-missing",
            ),
        ),
        (
            (
                not is_finite,
                "control points have numbers that are not finite", "", "leave these points out", "not-finite",
            ),
            (
                2 * control_points.sizes.get("point", 0) <= len(names),
                f"{control_points.sizes.get('point', 0)} points",
                f"more than {len(names) / 2:g} for {', '.join(names)}", "", "control-points-few",
            ),
        ),
    )  # fmt: skip
    problems = Problems("a boresight cannot be solved for", SchemaError)
    for table in tables:
        for is_wrong, found, expected, mend, code in table:
            problems.add_if(is_wrong, found, expected=expected, mend=mend, code=code)
        problems.raise_if_any()
    start = np.array([*boresight, 0.0, clock_offset_s], np.float64)
    forward, right, down = map(float, lever_arm)
    sights = _sightings(
        lines, control_points, navigation, (forward, right, down), camera, convention, crs, start
    )
    free = [PARAMETERS.index(name) for name in names]
    white = [sight.whitening(start) for sight in sights]
    heights = control_points["height"].values.astype(np.float64) if pairs else None
    points = Misses(sights, start, free, control_points.sizes["point"], white, heights)
    # points with misses that a mounting or a clock offset can explain
    plausible = np.ones(points.count, bool)
    misses_at_start = [sight.misses(start) for sight in sights]
    median_miss = np.median(np.concatenate(misses_at_start), axis=0)
    for sight, miss in zip(sights, misses_at_start, strict=True):
        limit = RULES.blunder_fields * max(sight.field_of_view, 0.5)
        plausible[sight.index] = ~((np.linalg.norm(miss - median_miss, axis=1) > limit) | sight.behind(start))
    if 2 * plausible.sum() <= points.count:
        plausible[:] = True
    _refuse_unidentifiable(points, start[free], names, plausible)
    fit = _best_fit(points, plausible)
    slopes = fit.points.slopes(fit.free, fit.used)
    condition = _refuse_unidentifiable(fit.points, fit.free, names, fit.used)
    misses = fit.points.misses(fit.free)
    # half of the measurements of a tie point determine its ground position
    freedom = (1 if pairs else 2) * int(fit.used.sum()) - len(free)
    variance = float((misses[fit.used] ** 2).sum()) / freedom
    SchemaError.raise_if(
        variance > largest_picking_sd**2,
        f"control points do not fit: residual {np.sqrt(variance):.1f} px",
        expected=f"at most {largest_picking_sd:g} px (largest_picking_sd=)",
        mend="check clock_offset_s= (within 1 s), convention=, camera=, crs= and the points' lines",
        code="control-points-misfit",
    )
    roll, pitch, heading, height, clock = fit.points.parameters(fit.free).tolist()
    covariance = xr.DataArray(
        np.asarray(variance * np.linalg.inv(slopes.T @ slopes), np.float64),
        dims=("parameter", "other_parameter"),
        coords={"parameter": names, "other_parameter": names},
        attrs={
            "long_name": "Covariance of the camera's mounting",
            "parameter_units": ", ".join(_PARAMETERS[name][0] for name in names),
        },
    )
    labels = control_points["name"].values if "name" in control_points.variables else [""] * points.count
    residuals = xr.Dataset(
        {
            "miss": (
                "point",
                np.linalg.norm(misses, axis=1),
                {"units": "1", "long_name": "Distance [pixel]"},
            ),
            "outlier": ("point", ~fit.used, {"long_name": "Left out"}),
        },
        coords={"point": [str(label) or str(number) for number, label in enumerate(labels)]},
    )
    return BoresightSolution(
        (roll, pitch, heading), height, clock, covariance, residuals, float(np.sqrt(variance)), condition
    )


# --- points of one line ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Sightings:
    # The points of one line, in the camera's frame: computed minus observed directions.
    times: Array  #: (row,): canonical record around the points
    poses: Floats  #: (6, row): canonical record around the points
    observed_at: Array  #: (point,): time of the point, interpolated between mid exposures of lines
    line_time: Floats  #: (point,): time between lines at the point [s]
    ground: Floats  #: (point, 3): geocentric coordinates [m]
    forward: Floats  #: (point,): tangents of the column
    right: Floats
    step: Floats  #: (point, 2): change of both tangents from a column to the next
    lever_arm: tuple[float, ...]  #: Forward, right, down [m]
    index: Ints  #: (point,): numbers of the points among the points of all lines
    field_of_view: float  #: Distance between the outermost columns [tangent]
    _cache: dict[tuple[float, float], tuple[Floats, ...]] = field(default_factory=dict, repr=False)

    def misses(self, mounting: Floats, lines: float = 0.0) -> Floats:
        # Return computed minus observed directions of points (point, 2): forward, right [tangent].
        #
        # ``mounting`` is roll, pitch, heading of the camera in the body [degree], offset added to the
        # altitude of the record [m], and offset added to the time of the line [s]; ``lines`` is the number of
        # lines by which the observation is shifted to later times.
        vector = self._vectors(mounting, lines)
        return np.asarray(vector[:, :2] / vector[:, 2:] - np.stack([self.forward, self.right], axis=-1))

    def behind(self, mounting: Floats) -> Bools:
        # Return the points behind the camera (point,), whose residuals have no meaning.
        return np.asarray(self._vectors(mounting, 0.0)[:, 2] <= 0.0)

    def hits(self, mounting: Floats, height: Floats) -> Floats:
        # Return geocentric positions (point, 3) where the lines of sight reach a height [m].
        *boresight, height_offset, clock = mounting.tolist()
        centre, axes, body, _, altitude = self._frames(clock, 0.0)
        look = np.stack([self.forward, self.right, np.ones_like(self.right)], axis=-1)
        lever_arm = body @ np.array(self.lever_arm)
        ray = np.einsum("nij,nj->ni", body, look @ _rotation(*boresight).T)
        vertical = altitude + height_offset - lever_arm[:, 2] - height[self.index]
        horizontal_squared = (ray[:, :2] ** 2).sum(axis=-1)
        distance = vertical / ray[:, 2]
        # a surface of equal height is 8 cm below the tangent plane at a kilometre
        for _ in range(2):
            distance = (vertical + distance**2 * horizontal_squared / (2.0 * WGS84_SEMI_MAJOR_AXIS_M)) / ray[
                :, 2
            ]
        offset = lever_arm + distance[:, None] * ray - np.array([0.0, 0.0, height_offset])
        return np.asarray(centre + np.einsum("nji,nj->ni", axes, offset))

    def whitening(self, mounting: Floats) -> Floats:
        # Return the matrix that converts residuals to pixels of picking (point, 2, 2).
        #
        # A pixel along the track and a pixel across move a point in two directions of the camera's frame.
        # With equal uncertainty of picking in both, the converted residuals have unit covariance.
        per_line = self.misses(mounting, 0.5) - self.misses(mounting, -0.5)
        floor = _MIN_PICKING_PX**2 * (self.step**2).sum(axis=-1)[:, None, None] * np.eye(2)
        covariance = (
            per_line[:, :, None] * per_line[:, None] + self.step[:, :, None] * self.step[:, None] + floor
        )
        return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))

    def _vectors(self, mounting: Floats, lines: float) -> Floats:
        # Return the vectors from the camera to the points in its frame (point, 3) [m].
        *boresight, height, clock = mounting.tolist()
        centre, axes, _, to_body, _ = self._frames(clock, lines)
        vector = np.einsum("nij,nj->ni", to_body, self.ground - centre + height * axes[:, 2])
        return np.asarray((vector - np.array(self.lever_arm)) @ _rotation(*boresight))

    def _frames(self, clock: float, lines: float) -> tuple[Floats, ...]:
        # Return, at the time of the points: geocentric position (point, 3), directions north, east, down
        # (rows), rotations from the body to these, and from the geocentric frame to the body (point, 3, 3),
        # and altitudes. Only the clock changes them, so that few are computed in a fit.
        if (clock, lines) not in self._cache:
            if len(self._cache) > 16:
                self._cache.clear()
            times = self.observed_at + np.round(lines * self.line_time * 1e9).astype("timedelta64[ns]")
            poses = poses_at(self.times, self.poses, times, clock_offset_s=clock)
            body = matrices(quaternions(*poses[3:]))
            centre, axes = _geocentric(*poses[:3])
            self._cache[clock, lines] = (centre, axes, body, np.einsum("nji,njk->nik", body, axes), poses[2])
        return self._cache[clock, lines]


@functools.lru_cache(maxsize=64)
def _rotation(roll: float, pitch: float, heading: float) -> Floats:
    # Return the rotation from the camera to the body, which the lines of a flight share.
    return matrices(quaternions(roll, pitch, heading))


def _geocentric(latitude: Floats, longitude: Floats, height: Floats) -> tuple[Floats, Floats]:
    # Return geocentric coordinates (n, 3), and the directions north, east, down at them (n, 3, 3).
    axes = east_north_up(latitude, longitude)[:, [1, 0, 2]] * np.array([[1.0], [1.0], [-1.0]])
    phi = np.radians(latitude)
    radius = WGS84_SEMI_MAJOR_AXIS_M / np.sqrt(1.0 - WGS84_ECCENTRICITY_SQUARED * np.sin(phi) ** 2)
    # along the vertical, from the equatorial plane; the centre of curvature lies below the earth's centre
    position = -(radius + height)[:, None] * axes[:, 2]
    position[:, 2] -= WGS84_ECCENTRICITY_SQUARED * radius * np.sin(phi)
    return position, axes


def _sightings(
    lines: xr.Dataset | Mapping[str, xr.Dataset],
    points: xr.Dataset,
    navigation: xr.Dataset | Mapping[str, xr.Dataset] | None,
    lever_arm: tuple[float, ...],
    camera: Any,
    convention: Convention | None,
    crs: Any,
    start: Floats,
) -> list[Sightings]:
    # Return the view of every line on its points.
    crs = points.attrs.get("crs") if crs is None else crs
    if crs is None:
        raise SchemaError("the CRS of east and north is missing", mend="pass crs=", code="crs-missing")
    parts: list[tuple[str, Any, Ints]] = [("", lines, np.arange(points.sizes["point"]))]
    if not isinstance(lines, xr.Dataset):
        SchemaError.raise_if(
            "flightline" not in points.variables,
            "control points do not name their line: flightline (point) is missing",
            code="variable-missing",
        )
        line_names = points["flightline"].values.astype(str)
        unknown = sorted(set(line_names) - set(lines))
        SchemaError.raise_if(
            unknown,
            f"control points are of {', '.join(unknown)}",
            expected=f"points of {', '.join(map(str, lines))}",
            code="flightline-unknown",
        )
        parts = [(name, line, np.flatnonzero(line_names == name)) for name, line in lines.items()]
    sights = []
    for name, line, index in parts:
        if not index.size:
            continue
        one_record = navigation is None or isinstance(navigation, xr.Dataset)
        record: Any = navigation if one_record else navigation.get(name)  # type: ignore[union-attr]
        declared = convention_of_line(line, record, convention)
        columns = pose_columns(line if record is None else record, declared)
        values = canonical_values(*(c.values for c in columns.values()), convention=declared, crs=crs)
        time = require(line, ["time"], "control points")["time"].values.astype("datetime64[ns]")
        recorded = time if record is None else record[NAVIGATION_TIME].values.astype("datetime64[ns]")
        position, column, east, north, height = (
            points[field].values[index].astype(np.float64) for field in _FIELDS
        )
        across, along = (np.tan(np.radians(np.asarray(a))) for a in look_angles(line, camera, declared))
        is_inside = (position >= -0.5) & (position <= time.size - 0.5)
        is_inside &= (column >= -0.5) & (column <= across.size - 0.5)
        SchemaError.raise_if(
            not is_inside.all() or time.size < 2,
            f"points {index[~is_inside].tolist()} are outside {time.size} lines of {across.size} columns",
            code="pixel-outside",
        )
        line_before = np.clip(np.floor(position).astype(np.int64), 0, time.size - 2)
        steps = (time[line_before + 1] - time[line_before]).astype(np.int64)
        since = np.round((position - line_before) * steps).astype("timedelta64[ns]")
        observed_at = time[line_before] + since
        # rows of the record around any point
        sought = (observed_at + np.timedelta64(round(float(start[4]) * 1e9), "ns"))[~np.isnat(observed_at)]
        reach = np.timedelta64(round(_AROUND_S * 1e9), "ns")
        is_near = np.zeros(recorded.size, bool)
        for time_of_point in sought:
            is_near |= np.abs(recorded - time_of_point) <= reach
        positions = between_maps(np.stack([east, north], -1), crs_of(crs), "OGC:CRS84")
        ground, _ = _geocentric(positions[:, 1], positions[:, 0], height)
        # tangents at fractions of columns, extrapolated by half a column at both ends
        numbers = np.arange(-1, across.size + 1)
        forward, right = (
            np.interp(column, numbers, np.concatenate([[2 * t[0] - t[1]], t, [2 * t[-1] - t[-2]]]))
            for t in (along, across)
        )
        step = np.stack([np.gradient(along), np.gradient(across)], axis=-1)
        sight = Sightings(
            recorded[is_near], values[:, is_near], observed_at, steps / 1e9, ground, forward, right,
            step[np.clip(np.round(column).astype(np.int64), 0, across.size - 1)], lever_arm, index,
            float(np.hypot(np.ptp(along), np.ptp(across))),
        )  # fmt: skip
        is_missing: Bools = np.ones(index.size, bool)
        if is_near.any():
            is_missing[:] = ~np.isfinite(sight.misses(np.array([0.0, 0.0, 0.0, 0.0, start[4]]))).all(axis=1)
        SchemaError.raise_if(
            is_missing.any(),
            f"points {index[is_missing].tolist()} are on lines without time or pose",
            mend="check the record for gaps",
            code="pose-missing",
        )
        sights.append(sight)
    return sights


# --- fit ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Misses:
    # Residuals of all points as a function of the free parameters.
    #
    # Of tie points, the first half is seen by one line of a pair, the second half by the other.
    sights: list[Sightings]
    start: Floats  #: start values of all five parameters
    free: list[int]  #: positions in `PARAMETERS` of the solved parameters
    count: int
    white: list[Floats]  #: matrices that convert the misses of each sighting to pixels of picking
    height: Floats | None  #: (point,): of tie points, height of the ground above the ellipsoid [m]

    def parameters(self, free: Floats) -> Floats:
        # Return all five parameters.
        parameters = self.start.copy()
        parameters[self.free] = free
        return parameters

    def misses(self, free: Floats) -> Floats:
        # Return misses of all points (point, 2) [pixel of picking]; of ties from their mean position.
        parameters, misses = self.parameters(free), np.zeros((self.count, 2))
        sights = self.sights
        if self.height is not None:
            positions = np.zeros((self.count, 3))
            for sight in sights:
                positions[sight.index] = sight.hits(parameters, self.height)
            means = np.tile(positions.reshape(2, -1, 3).mean(axis=0), (2, 1))
            sights = [replace(sight, ground=means[sight.index]) for sight in sights]
        for sight, white in zip(sights, self.white, strict=True):
            misses[sight.index] = np.einsum("nij,nj->ni", white, sight.misses(parameters))
        return misses

    def distances(self, free: Floats) -> Floats:
        # Return the length of the misses (point,) [pixel of picking]; of ties the larger one for both.
        distances = np.linalg.norm(self.misses(free), axis=1)
        return distances if self.height is None else np.tile(distances.reshape(2, -1).max(axis=0), 2)

    def whitened(self, free: Floats) -> Misses:
        # Return the misses with whitening computed at these parameters.
        parameters = self.parameters(free)
        return replace(self, white=[sight.whitening(parameters) for sight in self.sights])

    def slopes(self, free: Floats, used: Bools) -> Floats:
        # Return derivatives of the misses of points that are used (2 point, parameter).
        changes = [self.misses(free + step) - self.misses(free - step) for step in np.diag(_STEPS[self.free])]
        return np.stack([c[used].ravel() for c in changes], axis=1) / (2.0 * _STEPS[self.free])

    def lengths(self, free: Floats, used: Bools) -> Floats:
        # Return the length of the misses per unit of a parameter, for fixed ground points (parameter,).
        return np.asarray(np.linalg.norm(replace(self, height=None).slopes(free, used), axis=0))


class _Fit(NamedTuple):
    # Parameters, the points used, and their median miss [pixel].
    free: Floats
    used: Bools
    median_miss: float
    points: Misses


def _fit(
    points: Misses, free: Floats, used: Bools, scale: float | None = None, roughly: bool = False
) -> Floats:
    # Fit by least squares, or with a scale [pixel] by soft-L1.
    from scipy.optimize import least_squares

    units = _STEPS[points.free]
    solution = least_squares(
        lambda u: np.nan_to_num(points.misses(u * units)[used].ravel(), nan=1e3),
        free / units,
        jac=lambda u: np.nan_to_num(points.slopes(u * units, used)) * units,
        loss="linear" if scale is None else "soft_l1",
        f_scale=scale or 1.0,
        x_scale=1e3
        if roughly
        else 1.0,  # allows a first step of a degree: smaller steps would end the search
        ftol=1e-3 if roughly else 1e-8,
        max_nfev=12 if roughly else None,
    )
    return np.asarray(solution.x * units)


def _best_fit(points: Misses, plausible: Bools) -> _Fit:
    if PARAMETERS.index("clock") not in points.free:
        return _robust_fit(points, points.start[points.free], plausible)
    # the clock is the last free parameter
    # start values: the best clock offsets of the search, with the other parameters fitted to them
    starts, medians = [], []
    for clock in points.start[4] + np.array(RULES.clock_search_s):
        # misses of all clock offsets have the whitening of the start values
        fixed = replace(points, start=np.append(points.start[:4], clock), free=points.free[:-1])
        free = fixed.start[fixed.free]
        # the record may end before other points
        is_usable = plausible & np.isfinite(fixed.misses(free)).all(axis=1)
        if free.size and is_usable.any():
            # plain least squares first: soft-L1 converges slowly from far away
            rough = _fit(fixed, free, is_usable, roughly=True)
            free = _fit(fixed, rough, is_usable, RULES.soft_miss_px, roughly=True)
        starts.append(np.append(free, clock))
        medians.append(_median_distance(fixed.misses(free)[plausible]))
    padded = np.pad(medians, 1, constant_values=np.inf)
    lowest = [k for k, median in enumerate(medians) if median <= min(padded[k], padded[k + 2])]
    candidates = [k for k in lowest if medians[k] <= RULES.candidate_ratio * min(medians)]
    candidates = sorted(candidates, key=lambda k: medians[k])[: RULES.max_clock_candidates]
    best, *rest = sorted(
        [_robust_fit(points, starts[k], plausible) for k in candidates], key=lambda fit: fit.median_miss
    )
    for rival in rest:
        is_distinct = abs(rival.free[-1] - best.free[-1]) > RULES.same_clock_s
        SchemaError.raise_if(
            is_distinct and not rival.median_miss > RULES.rival_ratio * best.median_miss,
            f"clocks {best.free[-1]:+.3f} and {rival.free[-1]:+.3f} s fit these control points equally: "
            f"residuals {best.median_miss:.2f} and {rival.median_miss:.2f} px",
            mend="add points, or leave 'clock' out of solve=",
            code="clock-ambiguous",
        )
    return best._replace(points=points.whitened(best.free))


def _robust_fit(points: Misses, free: Floats, plausible: Bools) -> _Fit:
    # Fit by soft-L1, then by least squares without outliers.
    compared, count = plausible, int(plausible.sum())
    free = _fit(points, free, compared)
    points = points.whitened(free)
    for _ in range(3):
        scale = max(1.4826 * float(np.nanmedian(np.abs(points.misses(free)[plausible]))), 1e-6)
        free = _fit(points, free, compared, 1.5 * scale)
    freedom = np.sqrt(2 * count / max(2 * count - len(points.free), 1))
    for _ in range(RULES.max_outlier_rounds):
        distances = points.distances(free)
        # the median distance of points is 1.177 standard deviations of line or column
        scale = freedom * max(float(np.nanmedian(distances[compared])) / 1.1774, 1e-6)
        is_inlier = (distances < RULES.outlier_sd * scale) & plausible
        if 2 * is_inlier.sum() <= len(points.free):
            break
        free = _fit(points, free, is_inlier)
        if (is_inlier == compared).all():
            break
        compared = is_inlier
    return _Fit(free, compared, _median_distance(points.misses(free)[plausible]), points)


def _median_distance(misses: Floats) -> float:
    # Return the median distance [pixel]; points without a ground position count as infinite.
    distances = np.linalg.norm(misses, axis=1)
    return float(np.median(np.where(np.isfinite(distances), distances, np.inf)))


def _refuse_unidentifiable(points: Misses, free: Floats, names: list[str], used: Bools) -> float:
    # Return the condition number; SchemaError if it is too large.
    slopes, lengths_fixed = points.slopes(free, used), points.lengths(free, used)
    length = np.maximum(np.linalg.norm(slopes, axis=0), 1e-12)
    problems = Problems(f"{int(used.sum())} points do not determine all of {', '.join(names)}", SchemaError)
    for name, size in zip(names, lengths_fixed, strict=True):
        unit, _, max_sd = _PARAMETERS[name]
        problems.add_if(
            not size * max_sd > 1.0,
            f"{name}: {max_sd:g} {unit} would move points by less than a pixel",
            mend="leave it out of solve=, or add points across the swath",
            code="parameter-insensitive",
        )
    problems.raise_if_any()
    _, singular, directions = np.linalg.svd(slopes / length, full_matrices=False)
    condition = float(singular[0] / singular[-1]) if singular[-1] > 0 else np.inf
    widened = np.sqrt(((directions.T / np.maximum(singular, 1e-12)) ** 2).sum(axis=1))
    # a tie point moves with both lines: it determines less the more equally they move it
    widened *= np.maximum(lengths_fixed / length, 1.0)
    weak = [k for k in range(len(names)) if widened[k] > RULES.max_widening]
    if 2 * used.sum() <= len(names) or weak:
        for k in weak:
            partners = [n for j, n in enumerate(names) if j != k and abs(directions[-1, j]) > 0.3]
            problems.add(
                f"{names[k]}: its uncertainty is {min(widened[k], 1e9):.3g} times that of {names[k]} alone, "
                f"since {' and '.join(partners) or 'both lines'} would move the points equally",
                code="parameter-correlated",
            )
        problems.add(
            f"condition number {min(condition, 1e12):.3g}",
            mend="add lines of other courses or heights or points across the swath, or shorten solve=",
            code="condition-poor",
        )
    problems.raise_if_any()
    return condition
