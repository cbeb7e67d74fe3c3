"""Position and attitude of the camera, in canonical form, at the middle of every exposure."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base.attitude_conventions import Convention, wrapped
from hyperpaint.base.errors import Problems, SchemaError, TimeError
from hyperpaint.base.facts import conversion_factor, convert, documented, one_of, takes_quantities
from hyperpaint.base.schema import ALONG_TRACK, Array, Floats, Ints, label

from .geodesy import meridian_convergence

Interpolation = Literal["linear", "cubic"]

NAVIGATION_TIME = "navigation_time"
#: Variables of a pose, in the order in which arrays (6, row) hold them.
POSE = ("latitude", "longitude", "altitude", "roll", "pitch", "heading")
ANGLES = ("roll", "pitch", "heading")

_NS_PER_S = 1e9
_NAT = np.iinfo(np.int64).min
_GAP_INTERVALS, _MIN_GAP_S = (
    2.5,
    0.1,
)  # an interval between rows above both is a gap: median intervals, and seconds

#: Units of the arguments of `locate`.
LOCATION_UNITS = {
    "ground": "m",
    "boresight": "degree",
    "lever_arm": "m",
    "clock_offset_s": "s",
    "max_gap_s": "s",
}


# --- canonical form ----------------------------------------------------------------------------------------


@documented()
def canonical_navigation(
    navigation: xr.Dataset, *, convention: Convention | None = None, crs: Any = None
) -> xr.Dataset:
    """Return a navigation record in canonical form (see `hyperpaint.base.attitude_conventions`).

    Parameters
    ----------
    navigation
        ``latitude``, ``longitude`` [degree], ``altitude`` [m], ``roll``, ``pitch``, ``heading``
        (navigation_time), as their file has them; also of a flight line (along_track).
    convention
        Meaning of these variables; by default as their attributes declare.
    crs

    Returns
    -------
    xarray.Dataset
        The record with these six in canonical form, float64, and attributes that say so. Other variables are
        kept.

    Raises
    ------
    SchemaError
        Variables are missing, their meaning is not declared, or units contradict it; all are listed. A
        declination, geoid undulation or grid is needed and missing.
    UnitsError
        Units that cannot be read, or are of another dimension.

    Examples
    --------
    >>> import xarray as xr
    >>> record = xr.Dataset({name: ("navigation_time", [1.0]) for name in POSE})
    >>> mirrored = Convention(roll_positive="right_wing_up")
    >>> canonical_navigation(record, convention=mirrored)["roll"].values
    array([-1.])
    """
    convention = convention_of(navigation, convention)
    columns = pose_columns(navigation, convention)
    values = canonical_values(*(columns[n].values for n in POSE), convention=convention, crs=crs)
    dims = columns["roll"].dims
    canonical = navigation.assign({n: _labelled(v, n, dims) for n, v in zip(POSE, values, strict=True)})
    canonical.attrs = with_convention(navigation.attrs, convention.of_canonical)
    return canonical


def with_convention(attrs: Mapping[Any, Any], convention: Convention) -> dict[Any, Any]:
    # Return attributes that declare this convention and no other.
    return {
        **{name: value for name, value in attrs.items() if not str(name).startswith("convention_")},
        **convention.to_attrs(),
    }


def _labelled(values: Any, name: str, dims: tuple[Any, ...]) -> xr.DataArray:
    return label(xr.DataArray(values, dims=dims), name)


def convention_of_line(
    line: xr.Dataset, navigation: xr.Dataset | None, convention: Convention | None
) -> Convention:
    # Return the convention of a line's poses; the line's own column order fills a missing one.
    #
    # Raises `SchemaError`: Neither the argument nor the attributes of the record, or of the line without one,
    # declare it.
    source, subject = (line, "this line") if navigation is None else (navigation, "this navigation record")
    declared = convention_of(source, convention, subject)
    line_convention = Convention.from_attrs(line.attrs)
    if declared.column_order is None and line_convention is not None:
        declared = declared.replace(column_order=line_convention.column_order)
    return declared


def convention_of(
    dataset: xr.Dataset, convention: Convention | None, subject: str = "this navigation record"
) -> Convention:
    # Return the given convention, else the one of the attributes; SchemaError where there is neither.
    declared = convention or Convention.from_attrs(dataset.attrs)
    if declared is None:
        raise SchemaError(
            f"{subject} does not declare its angles and heights, which differ between makers",
            mend="give convention=Convention(...), by default roll positive with the right wing down, pitch "
            "with the nose up, heading clockwise from true north [degree], heights above the ellipsoid",
            code="convention-missing",
        )
    return declared


def pose_columns(
    dataset: xr.Dataset, convention: Convention, dim: str | None = None
) -> dict[str, xr.DataArray]:
    # Return the six variables of a pose, positions in degree and metre, angles in the convention's unit.
    #
    # Raises `SchemaError`: Variables are missing, or units contradict the convention; all are listed. Raises
    # `UnitsError`: Units that cannot be read, or are of another dimension.
    problems = Problems("the poses of the camera cannot be read", SchemaError)
    columns: dict[str, xr.DataArray] = {}
    for name in POSE:
        if name not in dataset.variables:
            problems.add(f"{name!r} is missing", code="variable-missing")
            continue
        column = dataset[name].reset_coords(drop=True)
        if column.ndim != 1 or (dim or column.dims[0]) != column.dims[0]:
            dims = ", ".join(map(str, column.dims))
            problems.add(
                f"{name!r} has dims ({dims})", expected=f"({dim or NAVIGATION_TIME})", code="dim-missing"
            )
            continue
        units = column.attrs.get("units")
        if name not in ANGLES:
            column = column if units is None else convert(column, "m" if name == "altitude" else "degree")
        elif units is not None and conversion_factor(str(units), convention.angle_unit) != 1.0:
            problems.add(
                f"{name!r} has units {units!r}, while the convention declares angle_unit "
                f"{convention.angle_unit!r}",
                mend="correct the one that is wrong",
                code="units-conflict",
            )
        columns[name] = column
    problems.raise_if_any()
    return columns


def canonical_values(
    latitude: npt.ArrayLike,
    longitude: npt.ArrayLike,
    altitude: npt.ArrayLike,
    roll: npt.ArrayLike,
    pitch: npt.ArrayLike,
    heading: npt.ArrayLike,
    *,
    convention: Convention,
    crs: Any = None,
) -> Floats:
    # Return canonical poses (6, row), float64, from columns in the given convention.
    latitude, longitude = np.asarray(latitude, np.float64), np.asarray(longitude, np.float64)
    convergence = None
    if convention.heading_reference == "grid" and (convention.grid_crs or crs) is not None:
        convergence = meridian_convergence(latitude, longitude, convention.grid_crs or crs)
    angles = convention.canonical(roll, pitch, heading, convergence=convergence)
    return np.stack([latitude, longitude, convention.ellipsoidal(altitude), *angles])


# --- at given times ----------------------------------------------------------------------------------------


@takes_quantities(clock_offset_s="s", max_gap_s="s")
@documented()
def interpolate_pose(
    navigation: xr.Dataset,
    time: xr.DataArray,
    *,
    convention: Convention | None = None,
    clock_offset_s: float = 0.0,
    max_gap_s: float | None = None,
    interpolation: Interpolation = "linear",
    crs: Any = None,
) -> xr.Dataset:
    """Return canonical poses at given times, interpolated on the shortest arc between rows of a record.

    Parameters
    ----------
    navigation
        See `canonical_navigation`; ``navigation_time`` [UTC] must not run backwards.
    time
        UTC at mid exposure (along_track), datetime64; NaT allowed.
    convention, crs
        See `canonical_navigation`.
    clock_offset_s
    max_gap_s
        Longest interval between rows that is interpolated [s]; by default 2.5 times the median one, at least
        0.1 s.
    interpolation
        ``"linear"``: positions linear, attitude by slerp. ``"cubic"``: cubic splines of both between gaps,
        which gain where rows are further apart than some 20 ms.

    Returns
    -------
    xarray.Dataset
        `POSE` (along_track), float64; NaN in gaps, outside the record and at NaT. Nothing is extrapolated. A
        row with a NaN position counts as missing for positions, one with a NaN angle for the attitude.

    Raises
    ------
    SchemaError, UnitsError
        As `canonical_navigation`; an interpolation that does not exist; a gap that is not above 0.
    TimeError
        Times of the record run backwards.

    Examples
    --------
    >>> pose = {"latitude": [34.0, 34.001], "longitude": [-81.0, -81.0], "altitude": [150.0, 150.0]}
    >>> pose |= {"roll": [0.0, 0.0], "pitch": [0.0, 0.0], "heading": [350.0, 10.0]}
    >>> start = np.datetime64("2021-07-20T17:00", "ns")
    >>> rows = {"navigation_time": start + np.array([0, 2], "timedelta64[s]")}
    >>> record = xr.Dataset({name: ("navigation_time", values) for name, values in pose.items()}, rows)
    >>> times = xr.DataArray(start + np.array([1, 3], "timedelta64[s]"), dims="along_track")
    >>> poses = interpolate_pose(record, times, convention=Convention())
    >>> poses.heading.values, poses.latitude.values  # through north; nothing beyond the record
    (array([ 0., nan]), array([34.0005,     nan]))
    """
    convention = convention_of(navigation, convention)
    columns = pose_columns(navigation, convention)
    poses = poses_at(
        navigation[NAVIGATION_TIME].values,
        canonical_values(*(columns[n].values for n in POSE), convention=convention, crs=crs),
        time.values,
        clock_offset_s=clock_offset_s,
        max_gap_s=max_gap_s,
        interpolation=interpolation,
    )
    interpolated = xr.Dataset({n: _labelled(v, n, (ALONG_TRACK,)) for n, v in zip(POSE, poses, strict=True)})
    return interpolated.assign_attrs(convention.of_canonical.to_attrs())


def poses_at(
    recorded: npt.NDArray[np.datetime64],
    values: Floats,
    time: npt.NDArray[np.datetime64],
    *,
    clock_offset_s: float = 0.0,
    max_gap_s: float | None = None,
    interpolation: Interpolation = "linear",
) -> Floats:
    # Return poses (6, line) at given times from canonical ones (6, row); see `interpolate_pose`.
    check_interpolation(interpolation, max_gap_s)
    knot_ns = _nanoseconds(recorded)
    wanted_ns = _nanoseconds(time)
    wanted_ns = np.where(wanted_ns == _NAT, _NAT, wanted_ns + np.int64(round(clock_offset_s * _NS_PER_S)))
    # rows later than all rows before them
    rows_with_time = np.flatnonzero(knot_ns != _NAT)
    steps = np.diff(knot_ns[rows_with_time])
    if np.any(steps < 0):
        rows = rows_with_time[1:][steps < 0]
        listed = ", ".join(map(str, rows[:5].tolist())) + (", ..." if rows.size > 5 else "")
        raise TimeError(
            f"{NAVIGATION_TIME} runs backwards at {rows.size} of {knot_ns.size} rows ({listed})",
            mend="sort the record by time, or remove these rows",
            code="time-backwards",
        )
    later = rows_with_time[np.concatenate([[True], steps > 0])[: rows_with_time.size]]
    knot_ns, values = knot_ns[later], values[:, later]
    steps = np.diff(knot_ns) / _NS_PER_S
    gap = max_gap_s or max(_GAP_INTERVALS * float(np.median(steps)) if steps.size else 0.0, _MIN_GAP_S)
    poses = np.full((len(POSE), wanted_ns.size), np.nan)
    for part in (slice(0, 3), slice(3, 6)):
        is_recorded = np.isfinite(values[part]).all(axis=0)
        if is_recorded.any():
            poses[part] = _between(
                knot_ns[is_recorded],
                values[part][:, is_recorded],
                wanted_ns,
                gap,
                interpolation,
                is_attitude=part.start == 3,
            )
    # an incomplete pose becomes NaN in all six
    poses[:, np.isnan(poses).any(axis=0)] = np.nan
    return poses


def check_interpolation(interpolation: str, max_gap_s: float | None) -> None:
    # Refuse an unknown interpolation and a gap of 0 or less, as SchemaError.
    problems = Problems("poses cannot be interpolated with these options", SchemaError)
    one_of(interpolation, ("linear", "cubic"), "interpolation", problems=problems)
    problems.add_if(
        max_gap_s is not None and not max_gap_s > 0.0,
        f"max_gap_s {max_gap_s!r:.60}",
        expected="a time above 0 [s]",
        code="value-out-of-range",
    )
    problems.raise_if_any()


def _nanoseconds(time: Array) -> Ints:
    TimeError.raise_if(
        time.dtype.kind != "M",
        f"times have dtype {time.dtype}",
        expected="datetime64[ns] (UTC)",
        code="type-wrong",
    )
    return time.astype("datetime64[ns]").astype(np.int64)


def _between(
    knots: Ints, values: Floats, wanted: Ints, gap: float, interpolation: str, *, is_attitude: bool
) -> Floats:
    # Return positions, or roll, pitch and heading (3, line), from rows of them (3, row); NaN in gaps.
    before = np.clip(np.searchsorted(knots, wanted, side="right") - 1, 0, max(knots.size - 2, 0))
    after = np.minimum(before + 1, knots.size - 1)
    is_inside = (wanted >= knots[0]) & (wanted <= knots[-1])
    step = knots[after] - knots[before]
    elapsed = np.where(is_inside, wanted - knots[before], 0)
    # a time equal to that of a row needs no interpolation, whatever the distance of the next row
    is_covered = is_inside & ((step / _NS_PER_S <= gap) | (elapsed == 0) | (elapsed == step))
    if is_attitude:
        values = quaternions(*values).T
    else:
        values = np.stack([values[0], np.unwrap(values[1], period=360.0), values[2]])
    if interpolation == "cubic" and knots.size > 1:
        # cubic splines of positions (3, row) or quaternions (4, row), which end at every gap
        from scipy.interpolate import CubicSpline
        from scipy.spatial.transform import Rotation, RotationSpline

        between = np.full((len(values), wanted.size), np.nan)
        ends = [0, *(np.flatnonzero(np.diff(knots) / _NS_PER_S > gap) + 1).tolist(), knots.size]
        for start, stop in itertools.pairwise(ends):
            is_here = is_covered & (wanted >= knots[start]) & (wanted <= knots[stop - 1])
            if not is_here.any():
                continue
            # a spline needs two rows: a stretch of a single row, whose values it keeps, takes a neighbour
            rows = slice(start, stop) if stop - start > 1 else slice(max(start - 1, 0), max(stop, 2))
            s, t = ((time - knots[start]) / _NS_PER_S for time in (knots[rows], wanted[is_here]))
            if len(values) == 3:
                between[:, is_here] = CubicSpline(s, values[:, rows], axis=1)(t)
            else:
                rotations = RotationSpline(s, Rotation.from_quat(values[:, rows].T, scalar_first=True))(t)
                between[:, is_here] = rotations.as_quat(scalar_first=True).T
    else:
        weight = elapsed / np.maximum(step, 1)
        first, second = values[:, before], values[:, after]
        between = slerp(first.T, second.T, weight).T if is_attitude else first + weight * (second - first)
    if is_attitude:
        between = np.stack(angles_of(between.T))
    else:
        between[1] = wrapped(between[1])
    return np.where(is_covered, between, np.nan)


# --- rotations of a body (forward, right, down) in the frame north, east, down ----------------------------
#
# Quaternions are (scalar, x, y, z); q and -q are the same rotation. scipy's Rotation is not used: it takes
# eight times as long for a line of 4000 rows, and differs in the last place in 27 % of the matrix elements,
# which would move pixels of stored maps.


_MIN_ARC_RAD = 1e-8  # half angle between rotations below which the arc is replaced by its chord


def quaternions(roll: npt.ArrayLike, pitch: npt.ArrayLike, heading: npt.ArrayLike) -> Floats:
    # Return Rz(heading) Ry(pitch) Rx(roll) of angles [degree] (..., 4).
    halves = [np.radians(np.asarray(angle, np.float64)) / 2 for angle in (roll, pitch, heading)]
    (cr, cp, ch), (sr, sp, sh) = ([f(half) for half in halves] for f in (np.cos, np.sin))
    return np.stack(
        [
            ch * cp * cr + sh * sp * sr,
            ch * cp * sr - sh * sp * cr,
            ch * sp * cr + sh * cp * sr,
            sh * cp * cr - ch * sp * sr,
        ],
        axis=-1,
    )


def matrices(rotation: Floats) -> Floats:
    # Return quaternions as matrices (..., 3, 3) from the body's frame to north, east, down.
    w, x, y, z = np.moveaxis(rotation, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def angles_of(rotation: Floats) -> tuple[Floats, Floats, Floats]:
    # Return roll (-180 to 180), pitch (-90 to 90) and heading (0 to 360) [degree] of quaternions.
    w, x, y, z = np.moveaxis(rotation, -1, 0)
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - x * z), -1.0, 1.0))
    heading = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    # twice: the first mod turns a tiny negative angle into 360
    return np.degrees(roll), np.degrees(pitch), np.mod(np.mod(np.degrees(heading), 360.0), 360.0)


def slerp(first: Floats, second: Floats, weight: Floats) -> Floats:
    # Return rotations on the shorter arc from ``first`` (weight 0) to ``second`` (weight 1) (..., 4).
    #
    # Shoemake (1985), "Animating rotation with quaternion curves".
    second = np.where(((first * second).sum(axis=-1) < 0)[..., None], -second, second)
    # from the chord: an arc cosine near 1 loses half of its digits
    angle = 2.0 * np.arcsin(np.clip(np.linalg.norm(second - first, axis=-1) / 2.0, 0.0, 1.0))
    is_near = angle < _MIN_ARC_RAD
    sine = np.where(is_near, 1.0, np.sin(angle))
    first_weight = np.where(is_near, 1.0 - weight, np.sin((1.0 - weight) * angle) / sine)
    second_weight = np.where(is_near, weight, np.sin(weight * angle) / sine)
    rotation = first_weight[..., None] * first + second_weight[..., None] * second
    return np.asarray(rotation / np.linalg.norm(rotation, axis=-1, keepdims=True))
