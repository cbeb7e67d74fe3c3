"""Ground position of every pixel of a flight line.

It follows from the look directions of the columns of a line camera, and from position and attitude of the
camera, in canonical form, at the middle of every exposure. Outline of a located line, and spacing of its
pixels, follow from it.

Mounting and clock of a camera are solved from control or tie points.

Reference systems and maps of the earth, through pyproj (extra ``geo``).
"""

import functools
import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any, Literal, NamedTuple

import dask
import dask.array as da
import numpy as np
import xarray as xr
from dask.array.core import normalize_chunks

from hyperpaint.base import (
    ALONG_TRACK,
    ANGLES,
    BAND,
    CHUNK_LINES,
    CROSS_TRACK,
    NAVIGATION_TIME,
    WGS84_ECCENTRICITY_SQUARED,
    WGS84_SEMI_MAJOR_AXIS_M,
    Array,
    ArrayLike,
    Bools,
    Convention,
    Fact,
    Floats,
    Ints,
    Problem,
    Problems,
    Quality,
    SchemaError,
    TimeError,
    Times,
    UnitsError,
    conversion_factor,
    convert,
    documented,
    is_number,
    label,
    lines_a_task,
    needs_extra,
    one_of,
    require,
    schema,
    takes_quantities,
    warn_if,
    warn_user,
    wrapped,
)
from hyperpaint.io.files.reading import numbers
from hyperpaint.io.maps.map_grids import cut_at_dateline
from hyperpaint.kernels.arguments import BLOCK, LineFrames, LineRays, Raster

GEODETIC = "EPSG:4979"  # latitude, longitude, height above the ellipsoid of WGS 84
_GEOCENTRIC = "EPSG:4978"
_MAX_LATITUDE_DEG = 89.9  # nearer to a pole, east and north rotate too fast for a polynomial


def _pyproj() -> Any:
    with needs_extra("pyproj", "geo", "placing pixels on a map"):
        import pyproj
    return pyproj


@functools.lru_cache(maxsize=64)
def _crs(text: str) -> Any:
    return _pyproj().CRS.from_user_input(text).to_2d()


@functools.lru_cache(maxsize=64)
def _transformer(source: str, target: str) -> Any:
    # x or longitude come first; only `GEODETIC` and geocentric X, Y, Z [m] have heights [m]; other systems
    # are reduced to two dimensions
    systems = (name if name in (GEODETIC, _GEOCENTRIC) else _crs(name) for name in (source, target))
    return _pyproj().Transformer.from_crs(*systems, always_xy=True)


def crs_of(crs: Any) -> str:
    # Return a reference system as text: its EPSG code, else WKT.
    #
    # ``crs``: A reference system in a form that pyproj reads: ``"EPSG:32617"``, 32617, WKT, a CRS of pyproj
    # or rasterio.
    #
    # Raises `SchemaError`: PROJ does not know it, or it is not of the earth's surface. Raises
    # `MissingExtraError`: pyproj is not installed.
    pyproj = _pyproj()
    with SchemaError.instead_of(
        pyproj.exceptions.CRSError,
        f"crs {crs!r:.80} is unknown to PROJ",
        expected="such as 'EPSG:32617'",
        code="crs-unknown",
    ):
        system = pyproj.CRS.from_user_input(crs).to_2d()
    SchemaError.raise_if(
        not (system.is_projected or system.is_geographic),
        f"crs {crs!r:.80} is neither projected nor geographic",
        expected="such as 'EPSG:32617'",
        code="crs-unusable",
    )
    code = system.to_authority(min_confidence=100)
    return ":".join(code) if code and pyproj.CRS(":".join(code)) == system else system.to_wkt()


class Vertical(NamedTuple):
    # Heights of a compound or three-dimensional reference system.
    name: str
    unit: str
    metres: float  #: Metres of a unit upwards; negative for depths
    reference: str  #: ``"ellipsoid"`` or ``"geoid"``, the surface from which heights are measured


def utm_zone(latitude: float, longitude: float) -> str:
    """Return the EPSG code of the UTM zone of a position, on WGS 84.

    The irregular zones of Norway and Svalbard are included.

    Parameters
    ----------
    latitude, longitude
        [degree].

    Returns
    -------
    str
        Such as ``"EPSG:32617"``.

    Raises
    ------
    SchemaError
        The position is not finite, or beyond 84 degrees north or 80 degrees south.

    Examples
    --------
    >>> utm_zone(34.0, -81.0)
    'EPSG:32617'
    >>> utm_zone(60.4, 5.3)
    'EPSG:32632'
    """
    SchemaError.raise_if(
        not (-80.0 <= latitude <= 84.0 and np.isfinite(longitude)),
        f"no UTM zone at latitude {latitude:g}, longitude {longitude:g}",
        mend="pass crs=",
        code="crs-missing",
    )
    longitude = (longitude + 180.0) % 360.0 - 180.0
    zone = int((longitude + 180.0) // 6.0) + 1
    if 56.0 <= latitude < 64.0 and 3.0 <= longitude < 12.0:
        zone = 32
    elif latitude >= 72.0 and 0.0 <= longitude < 42.0:
        zone = (31, 33, 35, 37)[int((longitude + 3.0) // 12.0)]
    return f"EPSG:{(32600 if latitude >= 0 else 32700) + zone}"


def meridian_convergence(latitude: ArrayLike, longitude: ArrayLike, crs: Any) -> Floats:
    """Return the direction of grid north, clockwise from true north [degree].

    Parameters
    ----------
    latitude, longitude
        [degree].
    crs
        Projected reference system.

    Returns
    -------
    float64
        Positive where grid north lies east of true north; 0 for a geographic system.

    Raises
    ------
    SchemaError
        PROJ does not know the system.
    MissingExtraError
        pyproj is not installed.

    Examples
    --------
    East of the central meridian, in the northern hemisphere, grid north lies to the east of true north:

    >>> round(float(meridian_convergence(45.0, -80.0, "EPSG:32617")), 4)
    0.7071
    """
    pyproj = _pyproj()
    system = _crs(crs_of(crs))
    latitude, longitude = np.broadcast_arrays(np.asarray(latitude, float), np.asarray(longitude, float))
    return (
        np.zeros(latitude.shape)
        if system.is_geographic
        else np.asarray(pyproj.Proj(system).get_factors(longitude, latitude).meridian_convergence, np.float64)
    )


def grid_mapping_attrs(crs: str) -> dict[str, Any]:
    # Return the CF attributes of a ``spatial_ref`` coordinate.
    system = _crs(crs)
    return {**system.to_cf(), "spatial_ref": system.to_wkt()}


def between_maps(positions: Floats, source: str, target: str) -> Floats:
    # Return positions (n, 2) converted between reference systems, x or longitude first.
    if source == target:
        return positions
    x, y = _transformer(source, target).transform(positions[:, 0], positions[:, 1])
    return np.stack([x, y], axis=-1)


def is_in_metres(crs: str) -> bool:
    # Return whether a reference system is a map with coordinates in metres to the east and north.
    #
    # Axes to the west or south (EPSG:2053) would mirror every map.
    system = _crs(crs)
    directions = {axis.direction.lower() for axis in system.axis_info}
    # both axes of a map of the north pole may point south
    is_mirrored = "west" in directions or {"south", "east"} <= directions
    in_metres = all(axis.unit_conversion_factor == 1.0 for axis in system.axis_info)
    return system.is_projected and not is_mirrored and in_metres


# --- frames of lines ---------------------------------------------------------------------------------------

_OFFSETS = np.array(
    [(0, 0, 0)]
    + [tuple(sign * (axis == k) for k in range(3)) for axis in range(3) for sign in (1, -1)]
    + [
        tuple(a if k == i else b if k == j else 0 for k in range(3))
        for i, j in ((0, 1), (0, 2), (1, 2))
        for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1))
    ],
    dtype=np.float64,
)  # points around the camera, whose differences give a polynomial of second degree


def polynomials(
    latitude: Floats, longitude: Floats, altitude: Floats, reach: Floats, crs: str
) -> tuple[Floats, Floats, Floats]:
    # Return map coordinates and height around cameras, as polynomials of metres east, north and up.
    #
    # ``latitude``, ``longitude``, ``altitude`` (line,): Position of every camera [degree, m above the
    # ellipsoid]. ``reach`` (line,): Distance from the camera up to which the polynomials are accurate [m].
    # ``crs``: Map, as `crs_of` returns it.
    #
    # Returns: ``x, y, height`` (line, 10), float64: Coefficients in the order of `hyperpaint.kernels.rays`;
    # NaN where the position is NaN.
    #
    # Direction of north and scale of a map change from place to place. Terms beyond the second degree are of
    # the order of d (d / R)^2, for a distance d on an earth of radius R: 25 nm at 100 m, 0.2 mm at 2 km.
    coefficients = np.full((3, latitude.size, 10), np.nan)
    is_finite = [np.isfinite(part) for part in (latitude, longitude, altitude, reach)]
    is_valid = np.all(is_finite, axis=0) & (np.abs(latitude) < _MAX_LATITUDE_DEG)
    if is_valid.any():
        lat, lon, alt, distance = (part[is_valid] for part in (latitude, longitude, altitude, reach))
        # map coordinates and heights of points around the cameras
        geocentric = _transformer(GEODETIC, _GEOCENTRIC)
        origin = np.stack(geocentric.transform(lon, lat, alt), axis=-1)
        points = origin[:, None] + (_OFFSETS * distance[:, None, None]) @ east_north_up(lat, lon)
        lon, lat, height = geocentric.transform(*np.moveaxis(points, -1, 0), direction="INVERSE")
        x, y, *_ = _transformer(GEODETIC, crs).transform(lon, lat, height)
        if _crs(crs).is_geographic:
            x = x[:, :1] + (x - x[:, :1] + 180.0) % 360.0 - 180.0
        fitted = np.stack([_coefficients(np.asarray(value), distance) for value in (x, y, height)])
        coefficients[:, is_valid] = np.where(np.isfinite(fitted), fitted, np.nan)  # infinite outside the map
    return coefficients[0], coefficients[1], coefficients[2]


def east_north_up(latitude: Floats, longitude: Floats) -> Floats:
    phi, lam = np.radians(latitude), np.radians(longitude)
    sin_lat, cos_lat, sin_lon, cos_lon = np.sin(phi), np.cos(phi), np.sin(lam), np.cos(lam)
    rows = [
        [-sin_lon, cos_lon, np.zeros_like(sin_lat)],
        [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
        [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _coefficients(value: Floats, reach: Floats) -> Floats:
    # Return ten coefficients (line, 10) from values at `_OFFSETS` times the reach (line, 19).
    centre, axis_points, corners = (
        value[:, 0],
        value[:, 1:7].reshape(-1, 3, 2),
        value[:, 7:].reshape(-1, 3, 4),
    )
    linear_terms = (axis_points[..., 0] - axis_points[..., 1]) / (2.0 * reach[:, None])
    square_terms = (axis_points[..., 0] + axis_points[..., 1] - 2.0 * centre[:, None]) / (
        2.0 * reach[:, None] ** 2
    )
    equal_signs, opposite_signs = corners[..., 0] + corners[..., 3], corners[..., 1] + corners[..., 2]
    mixed_terms = (equal_signs - opposite_signs) / (4.0 * reach[:, None] ** 2)
    return np.concatenate([centre[:, None], linear_terms, square_terms, mixed_terms], axis=1)


Interpolation = Literal["linear", "cubic"]

#: Variables of a pose, in the order in which arrays (6, row) hold them.
POSE = ("latitude", "longitude", "altitude", "roll", "pitch", "heading")

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
    canonical = navigation.assign(
        {n: _labelled(v, n, columns["roll"].dims) for n, v in zip(POSE, values, strict=True)}
    )
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
    return SchemaError.raise_if_none(
        convention or Convention.from_attrs(dataset.attrs),
        f"{subject} does not declare its angles and heights, which differ between makers",
        mend=(
            "give convention=Convention(...), by default roll positive with the right wing down, pitch "
            "with the nose up, heading clockwise from true north [degree], heights above the ellipsoid"
        ),
        code="convention-missing",
    )


def pose_columns(
    dataset: xr.Dataset, convention: Convention, dim: str | None = None
) -> dict[str, xr.DataArray]:
    # Return the six variables of a pose, positions in degree and metre, angles in the convention's unit.
    #
    # Raises `SchemaError`: Variables are missing, or units contradict the convention; all are listed. Raises
    # `UnitsError`: Units that cannot be read, or are of another dimension.
    with Problems("the poses of the camera cannot be read", SchemaError) as problems:
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
    return columns


def canonical_values(
    latitude: ArrayLike,
    longitude: ArrayLike,
    altitude: ArrayLike,
    roll: ArrayLike,
    pitch: ArrayLike,
    heading: ArrayLike,
    *,
    convention: Convention,
    crs: Any = None,
) -> Floats:
    # Return canonical poses (6, row), float64, from columns in the given convention.
    latitude, longitude = np.asarray(latitude, np.float64), np.asarray(longitude, np.float64)
    convergence = (
        meridian_convergence(latitude, longitude, convention.grid_crs or crs)
        if convention.heading_reference == "grid" and (convention.grid_crs or crs) is not None
        else None
    )
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
    recorded: Times,
    values: Floats,
    time: Times,
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
            knots, samples = knot_ns[is_recorded], values[part][:, is_recorded]
            is_attitude = part.start == 3
            # positions, or roll, pitch and heading (3, line), from rows of them (3, row); NaN in gaps
            before = np.clip(np.searchsorted(knots, wanted_ns, side="right") - 1, 0, max(knots.size - 2, 0))
            after = np.minimum(before + 1, knots.size - 1)
            is_inside = (wanted_ns >= knots[0]) & (wanted_ns <= knots[-1])
            step = knots[after] - knots[before]
            elapsed = np.where(is_inside, wanted_ns - knots[before], 0)
            # a time equal to that of a row needs no interpolation, whatever the distance of the next row
            is_covered = is_inside & ((step / _NS_PER_S <= gap) | (elapsed == 0) | (elapsed == step))
            samples = (
                quaternions(*samples).T
                if is_attitude
                else np.stack([samples[0], np.unwrap(samples[1], period=360.0), samples[2]])
            )
            if interpolation == "cubic" and knots.size > 1:
                # cubic splines of positions (3, row) or quaternions (4, row), which end at every gap
                from scipy.interpolate import CubicSpline
                from scipy.spatial.transform import Rotation, RotationSpline

                between = np.full((len(samples), wanted_ns.size), np.nan)
                ends = [0, *(np.flatnonzero(np.diff(knots) / _NS_PER_S > gap) + 1).tolist(), knots.size]
                for start, stop in itertools.pairwise(ends):
                    is_here = is_covered & (wanted_ns >= knots[start]) & (wanted_ns <= knots[stop - 1])
                    if not is_here.any():
                        continue
                    # a spline needs two rows: a stretch of a single row, whose values it keeps, takes a
                    # neighbour
                    stretch = (
                        slice(start, stop) if stop - start > 1 else slice(max(start - 1, 0), max(stop, 2))
                    )
                    s, t = (
                        (time - knots[start]) / _NS_PER_S for time in (knots[stretch], wanted_ns[is_here])
                    )
                    if len(samples) == 3:
                        between[:, is_here] = CubicSpline(s, samples[:, stretch], axis=1)(t)
                    else:
                        rotations = RotationSpline(
                            s, Rotation.from_quat(samples[:, stretch].T, scalar_first=True)
                        )(t)
                        between[:, is_here] = rotations.as_quat(scalar_first=True).T
            else:
                weight = elapsed / np.maximum(step, 1)
                first, second = samples[:, before], samples[:, after]
                between = (
                    slerp(first.T, second.T, weight).T if is_attitude else first + weight * (second - first)
                )
            if is_attitude:
                between = np.stack(angles_of(between.T))
            else:
                between[1] = wrapped(between[1])
            poses[part] = np.where(is_covered, between, np.nan)
    # an incomplete pose becomes NaN in all six
    poses[:, np.isnan(poses).any(axis=0)] = np.nan
    return poses


def check_interpolation(interpolation: str, max_gap_s: float | None) -> None:
    # Refuse an unknown interpolation and a gap of 0 or less, as SchemaError.
    with Problems("poses cannot be interpolated with these options", SchemaError) as problems:
        one_of(interpolation, ("linear", "cubic"), "interpolation", problems=problems)
        problems.add_if(
            max_gap_s is not None and not max_gap_s > 0.0,
            f"max_gap_s {max_gap_s!r:.60}",
            expected="a time above 0 [s]",
            code="value-out-of-range",
        )


def _nanoseconds(time: Array) -> Ints:
    TimeError.raise_if(
        time.dtype.kind != "M",
        f"times have dtype {time.dtype}",
        expected="datetime64[ns] (UTC)",
        code="type-wrong",
    )
    return time.astype("datetime64[ns]").astype(np.int64)


# --- rotations of a body (forward, right, down) in the frame north, east, down ----------------------------
#
# Quaternions are (scalar, x, y, z); q and -q are the same rotation. scipy's Rotation is not used: it takes
# eight times as long for a line of 4000 rows, and differs in the last place in 27 % of the matrix elements,
# which would move pixels of stored maps.


_MIN_ARC_RAD = 1e-8  # half angle between rotations below which the arc is replaced by its chord


def quaternions(roll: ArrayLike, pitch: ArrayLike, heading: ArrayLike) -> Floats:
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


_MAX_LOOK_ANGLE_DEG = 89.0  # angle from the optical axis


@takes_quantities(pixel_pitch="m", focal_length="m", field_of_view="degree")
@dataclass(frozen=True)
class PinholeCamera:
    """A line camera whose columns are evenly spaced behind one projection centre.

    Columns are evenly spaced in the tangent of the angle, not in the angle.

    Attributes
    ----------
    columns
        Number of columns; the axis runs through their middle.
    pixel_pitch, focal_length
        Distance of columns on the detector, and of the detector from the projection centre [m].
    field_of_view
        Angle between the outermost columns [degree], instead of the two lengths.
    edges
        Ends of ``field_of_view``: ``"centres"`` of the outermost columns, or their ``"outer"`` edges. The two
        differ by half a column at either edge of the swath; makers use both, so there is no default.

    Raises
    ------
    SchemaError
        Neither or both of the two descriptions, or numbers out of range; all are listed.

    Examples
    --------
    >>> PinholeCamera(3, pixel_pitch=7.4e-6, focal_length=7.4e-6).look_across("left_to_right")
    array([-45.,   0.,  45.])
    >>> PinholeCamera(3, field_of_view=90.0, edges="centres").look_across("right_to_left")
    array([ 45.,   0., -45.])
    """

    columns: int
    pixel_pitch: float | None = None
    focal_length: float | None = None
    field_of_view: float | None = None
    edges: Literal["centres", "outer"] | None = None

    def __post_init__(self) -> None:
        with Problems("the description of this camera is not valid", SchemaError) as problems:
            problems.add_if(
                not (isinstance(self.columns, int | np.integer) and self.columns > 0),
                f"columns {self.columns!r:.60}",
                expected="a whole number above 0",
                code="value-out-of-range",
            )
            lengths = (self.pixel_pitch, self.focal_length)
            problems.add_if(
                (self.field_of_view is None) == (None in lengths)
                or (self.field_of_view is not None and lengths != (None, None)),
                "pixel_pitch, focal_length and field_of_view do not describe one camera",
                expected="either the two lengths, or field_of_view with edges",
                code="option-conflict",
            )
            for name, limit, expected in (
                ("pixel_pitch", np.inf, "a length above 0 [m]"),
                ("focal_length", np.inf, "a length above 0 [m]"),
                ("field_of_view", 2 * _MAX_LOOK_ANGLE_DEG, "0 to 178 [degree]"),
            ):
                value = getattr(self, name)
                problems.add_if(
                    value is not None and not 0.0 < value < limit,
                    f"{name} {value!r:.60}",
                    expected=expected,
                    code="value-out-of-range",
                )
            problems.add_if(
                self.field_of_view is not None
                and one_of(self.edges, ("centres", "outer"), "edges", problems=problems)
                and self.edges == "centres"
                and self.columns == 1,
                "one column has no angle between centres",
                mend="give edges='outer'",
                code="option-conflict",
            )

    @property
    def spacing(self) -> float:
        """Distance of neighbouring columns at unit distance, a tangent [1]."""
        if self.pixel_pitch is not None and self.focal_length is not None:
            return self.pixel_pitch / self.focal_length
        intervals = self.columns - 1 if self.edges == "centres" else self.columns
        return float(2.0 * np.tan(np.radians(self.field_of_view or 0.0) / 2.0) / intervals)

    def look_across(self, column_order: Literal["left_to_right", "right_to_left"]) -> Floats:
        """Return the angles of the columns from the axis, positive to the right (cross_track,) [degree]."""
        sign = -1.0 if column_order == "right_to_left" else 1.0
        offset = np.arange(self.columns) - (self.columns - 1) / 2
        return np.asarray(np.degrees(np.arctan(sign * offset * self.spacing)) + 0.0)


def look_angles(
    line: xr.Dataset, camera: PinholeCamera | xr.Dataset | None, convention: Convention
) -> tuple[Any, Any]:
    # Return look angles of the columns, across and along the track (cross_track,) [degree]; maybe lazy.
    #
    # ``line``: Has ``cross_track``; and, without a camera, ``look_across`` and perhaps ``look_along``, or
    # ``look_angle``. ``camera``: A pinhole, whose ``column_order`` the convention must declare; or a table of
    # the angles of every column: ``look_across`` [degree], positive to the right, and, for a slit that is
    # seen bent or turned, ``look_along``, positive forward. ``convention``: Declares ``column_order``; not
    # needed for a table, whose angles have signs.
    #
    # Raises `SchemaError`: No camera, a camera with another number of columns, or an undeclared order of
    # columns. Raises `UnitsError`: The angles of a table have no units.
    if isinstance(camera, PinholeCamera):
        order: Any = SchemaError.raise_if_none(
            convention.column_order,
            "the order of columns is not declared: whether column 0 looks left or right",
            mend="give convention=Convention(column_order='left_to_right') or 'right_to_left'",
            code="column-order-missing",
        )
        across = camera.look_across(order)
        along = np.zeros_like(across)
    else:
        source = line if camera is None else camera
        name = SchemaError.raise_if_none(
            next((name for name in ("look_across", "look_angle") if name in source.variables), None),
            "the line has neither look_across nor look_angle (cross_track) [degree]",
            mend=(
                "give camera=hp.geometry.PinholeCamera(columns, pixel_pitch, focal_length), or a table "
                "of the angles"
            ),
            code="camera-missing",
        )
        schema.refuse_other_labels(source, line, "camera=", (CROSS_TRACK,))
        across = convert(source[name], "degree").data.astype(np.float64)
        along = (
            convert(source["look_along"], "degree").data.astype(np.float64)
            if "look_along" in source.variables
            else np.zeros(across.shape)
        )
    with Problems("the directions of the columns cannot be used", SchemaError) as problems:
        for name, angles in (("look_across", across), ("look_along", along)):
            problems.add_if(
                angles.shape != (line.sizes[CROSS_TRACK],),
                f"{name} has shape {angles.shape}",
                expected=f"{line.sizes[CROSS_TRACK]} columns, as the line",
                code="length-mismatch",
            )
    return across, along


def directions(across: Floats, along: Floats) -> Floats:
    # Return unit vectors in the camera's frame (cross_track, 3): forward, right, along the optical axis.
    #
    # Raises `SchemaError`: Angles that are not finite, or point to the horizon or above it.
    SchemaError.raise_if(
        not (np.abs(across) < _MAX_LOOK_ANGLE_DEG).all() or not (np.abs(along) < _MAX_LOOK_ANGLE_DEG).all(),
        "some columns look to the horizon or above it, or have no angle",
        expected=f"angles below {_MAX_LOOK_ANGLE_DEG:g} degrees",
        code="value-out-of-range",
    )
    vectors = np.stack([np.tan(np.radians(along)), np.tan(np.radians(across)), np.ones(across.size)], axis=1)
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


# converts north, east, down to east, north, up
_MAP_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_MIN_REACH_M, _MAX_REACH_M = 10.0, 20_000.0  # distances over which the map around a camera is fitted


@dataclass(frozen=True)
class Swath:
    # Inputs that all slabs of lines share.
    poses: Floats  #: (6, line) float64: canonical; see `hyperpaint.geometry.georeference.poses.POSE`
    look: Floats  #: (column, 3) float64: directions of the columns in the camera's frame
    boresight: tuple[float, float, float]  #: Roll, pitch, heading of the camera in the body [degree]
    #: From the reference point of positions to the projection centre: forward, right, down [m]
    lever_arm: tuple[float, float, float]
    ground: "float | Terrain"  #: Height of level ground above the ellipsoid [m], or height raster
    crs: str  #: Map
    starts: Ints  #: (slab + 1,): first line of every slab, and the number of lines


def places_of(swath: Swath, block_id: tuple[int, ...]) -> Floats:
    # Return x, y, height [m], zenith and azimuth [degree] of the pixels of a slab (part, line, column).
    from hyperpaint.kernels.rays import PLACES, level_places, raster_places

    poses = swath.poses[:, swath.starts[block_id[1]] : swath.starts[block_id[1] + 1]]
    latitude, longitude, altitude = poses[:3]
    body = _MAP_FROM_NED @ matrices(quaternions(*poses[3:]))
    origin = np.ascontiguousarray(body @ np.array(swath.lever_arm, np.float64))
    rotation = np.ascontiguousarray(body @ matrices(quaternions(*swath.boresight)))
    lowest = swath.ground if isinstance(swath.ground, float) else swath.ground.lowest
    reach = np.clip(altitude - lowest, _MIN_REACH_M, _MAX_REACH_M)
    x, y, height = polynomials(latitude, longitude, altitude, reach, swath.crs)
    out = np.empty((PLACES, latitude.size, len(swath.look)))
    rays = LineRays(origin, rotation, swath.look)
    # rotation of true north per metre to the east [rad m-1]
    phi = np.radians(latitude)
    radius = WGS84_SEMI_MAJOR_AXIS_M / np.sqrt(1.0 - WGS84_ECCENTRICITY_SQUARED * np.sin(phi) ** 2)
    frames = LineFrames(x, y, height, np.tan(phi) / radius)
    if isinstance(swath.ground, float):
        level_places(rays, frames, swath.ground, out)
        return out
    terrain, grid = swath.ground, swath.ground.grid
    col, row = x.copy(), y.copy()
    if grid.crs != swath.crs:
        col, row, _ = polynomials(latitude, longitude, altitude, reach, grid.crs)
    # longitudes of rasters begin at -180 or 0, or cross 180: full turns bring them near the raster's middle
    if _crs(grid.crs).is_geographic:
        middle = grid.x[0] + grid.x[1] * (terrain.heights.shape[1] - 1) / 2
        col[:, 0] += 360.0 * np.round((middle - col[:, 0]) / 360.0)
    for coefficients, (first_centre, step) in ((col, grid.x), (row, grid.y)):
        coefficients[:, 0] -= first_centre
        coefficients /= step
    raster = Raster(row, col, terrain.heights, terrain.block_max, terrain.lowest, terrain.highest)
    raster_places(rays, frames, raster, out)
    return out


_SAMPLED_LINES = 33  # lines that are located at once, to warn where they see no ground
_MAX_MAP_DISTORTION = 0.01

# coordinates that `locate` adds, in the order in which the kernels write them
_PLACES = ("east", "north", "ground_height", "view_zenith", "view_azimuth")


@takes_quantities(**LOCATION_UNITS)
@documented()
def locate(
    line: xr.Dataset,
    *,
    navigation: xr.Dataset | None = None,
    boresight: Sequence[float] | None = None,
    lever_arm: Sequence[float] | None = None,
    ground: float | None = None,
    dem: xr.DataArray | None = None,
    crs: Any = None,
    camera: PinholeCamera | xr.Dataset | None = None,
    clock_offset_s: float = 0.0,
    convention: Convention | None = None,
    max_gap_s: float | None = None,
    interpolation: Interpolation = "linear",
) -> xr.Dataset:
    """Add the ground position of every pixel, and the direction from there to the camera.

    Parameters
    ----------
    line
        Flight line (along_track, cross_track) with ``time`` at mid exposure; and, without ``navigation``, its
        own ``latitude longitude altitude roll pitch heading`` (along_track).
    navigation
        Record to take the poses from, with the same variables on ``navigation_time`` [UTC]; see
        `hyperpaint.geometry.interpolate_pose`.
    boresight
        Roll, pitch and heading of the camera in the body [degree], applied like the angles of the body:
        first heading, then pitch, then roll; by default the line's attribute ``boresight``, else zero.
    lever_arm
        From the reference point of positions to the camera's projection centre, forward, right, down [m]; by
        default the line's attribute ``lever_arm``, else zero.
    ground
        Height of level ground above the ellipsoid [m]; either this or ``dem``; by default the line's
        attribute ``ground``.
    dem
        Heights (y, x) [m, unless an attribute ``units`` or the vertical part of the crs says otherwise] with
        coordinates of cell centres and a crs, as rioxarray opens them; ``scale_factor`` and ``add_offset`` in
        the attributes are applied. Its attribute ``height_reference`` declares the zero of heights:
        ``"ellipsoid"``, or ``"geoid"`` with ``geoid_undulation`` [m].
    crs
        Map of ``east`` and ``north``, projected and in metres; by default the UTM zone of the line's centre.
    camera
        `hyperpaint.geometry.PinholeCamera`, or the angles of the columns as a dataset: ``look_across``
        (positive to the right) and ``look_along`` (positive forward) (cross_track) [degree]; by default those
        of the line,
        else its ``look_angle``.
    clock_offset_s
    convention
        Meaning of angles and heights, and the order of the columns; by default as the attributes of
        ``navigation``, or of the line, declare. ``column_order`` is needed for a pinhole alone, and is also
        taken from the attributes of the line.
    max_gap_s, interpolation
        See `hyperpaint.geometry.interpolate_pose`.

    Returns
    -------
    xarray.Dataset
        The line with lazy coordinates ``east``, ``north``, ``ground_height`` [m], ``view_zenith`` and
        ``view_azimuth`` [degree] (along_track, cross_track), float64; ``spatial_ref``; and the poses used
        (along_track), in canonical form, as its attributes declare from then on. Where a line has no pose or
        a ray meets no known ground (it looks to the horizon or above it, past the DEM or into a hole of it)
        all five are NaN, and ``quality`` has the bit ``off_swath``.

    Raises
    ------
    SchemaError
        Neither or both of ``ground`` and ``dem``; variables, the declaration of their meaning, or the camera
        are missing; the map is not in metres; all problems of a kind are listed.
    TimeError
        The record runs backwards.
    UnitsError
        Units are missing, unreadable or of another dimension.
    MissingExtraError
        pyproj is not installed (extra ``geo``).

    See Also
    --------
    hyperpaint.geometry.orthorectify, hyperpaint.geometry.footprint, hyperpaint.geometry.spacing

    Notes
    -----
    A pixel's direction is ``R_nb R_bc u``: the camera's direction u turned into the body by the boresight
    and into north, east, down by ``R_nb = Rz(heading) Ry(pitch) Rx(roll)``. Each line is computed in the
    local frame of its position, the frame of its attitude, so that neither the map's convergence nor its
    scale needs a correction. Local coordinates are converted to the map by a polynomial of second degree
    around the camera, see `hyperpaint.geometry.georeference.locating.polynomials`.

    Poses of lines in memory are computed at once; of lazy lines nothing is read, unless ``crs`` has to be
    derived from their positions.

    Examples
    --------
    Over level ground, 100 m below, a camera that flies north sees 45 degrees to its right 100 m to the east:

    >>> import xarray as xr
    >>> pose = dict(latitude=34.0, longitude=-81.0, altitude=150.0, roll=0.0, pitch=0.0, heading=0.0)
    >>> line = xr.Dataset({name: ("along_track", [value]) for name, value in pose.items()})
    >>> line = line.assign_coords(cross_track=[0, 1, 2])
    >>> camera = PinholeCamera(3, field_of_view=90.0, edges="centres")
    >>> convention = Convention(column_order="left_to_right")
    >>> located = locate(line, ground=50.0, camera=camera, convention=convention)
    >>> located.east.attrs["crs"], located.east.diff("cross_track").values.round(1).tolist()
    ('EPSG:32617', [[100.0, 100.0]])
    >>> located.view_azimuth.values.round().tolist()
    [[90.0, 0.0, 270.0]]
    """
    # arguments take precedence over declarations of the line, and these over defaults
    arguments = {"ground": ground, "boresight": boresight, "lever_arm": lever_arm}
    origins = {
        name: "as passed" if value is not None else "of the line" if name in line.attrs else "assumed"
        for name, value in arguments.items()
    }
    zero: Sequence[float] = (0.0, 0.0, 0.0)
    boresight = line.attrs.get("boresight", zero) if boresight is None else boresight
    lever_arm = line.attrs.get("lever_arm", zero) if lever_arm is None else lever_arm
    ground = line.attrs.get("ground") if ground is None and dem is None else ground
    with Problems("this line cannot be located", SchemaError) as problems:
        for dim in (ALONG_TRACK, CROSS_TRACK):
            problems.add_if(
                dim not in line.dims,
                f"it has no dim {dim!r}, only {', '.join(map(str, line.dims))}",
                mend="it is a map, which is straightened already"
                if {"y", "x"} <= set(line.dims)
                else f"isel({dim}=[5]) keeps it, dims= names it",
                code="dim-missing",
            )
        for name, vector in (("boresight", boresight), ("lever_arm", lever_arm)):
            problems.add_if(
                Fact(doc="", kind="numbers", length=3).fault(np.asarray(vector, object)),
                f"{name} {vector!r:.80}",
                expected="three finite numbers",
                code="type-wrong",
            )
        problems.add_if(
            (ground is None) == (dem is None),
            "ground= and dem= are both missing" if dem is None else "ground= and dem= are both given",
            mend="give the height of the ground above the ellipsoid (ground=, in m), or dem=",
            code="argument-missing" if dem is None else "option-conflict",
        )
        for name, number in (("ground", ground), ("clock_offset_s", clock_offset_s)):
            problems.add_if(
                number is not None and not is_number(number),
                f"{name} {number!r:.80}",
                expected="a finite number",
                code="not-finite",
            )
    check_interpolation(interpolation, max_gap_s)
    declared = convention_of_line(line, navigation, convention)
    across, along = look_angles(line, camera, declared)
    # poses as recorded, with the times of rows and lines where they are to be interpolated
    source, dim = (line, ALONG_TRACK) if navigation is None else (navigation, NAVIGATION_TIME)
    columns = {name: column.data for name, column in pose_columns(source, declared, dim).items()}
    if navigation is not None or clock_offset_s != 0.0:
        columns["recorded"] = columns["wanted"] = require(line, ["time"], "poses")["time"].data
    if navigation is not None:
        SchemaError.raise_if(
            NAVIGATION_TIME not in navigation.variables,
            f"this navigation record has no {NAVIGATION_TIME!r}, UTC as datetime64[ns]",
            code="variable-missing",
        )
        columns["recorded"] = navigation[NAVIGATION_TIME].data
    grid = None if dem is None else grid_of(dem)
    if crs is None and _is_lazy(*columns.values()):
        columns, across, along = dask.compute(columns, across, along)
    poses = _call(
        _poses,
        convention=declared,
        crs=crs,
        clock_offset_s=clock_offset_s,
        max_gap_s=max_gap_s,
        interpolation=interpolation,
        **columns,
    )
    # default: the UTM zone of the middle line among the lines with a pose
    if crs is None:
        lines_with_pose = np.flatnonzero(np.isfinite(poses[0]))
        SchemaError.raise_if(
            not lines_with_pose.size,
            "no line has a pose, so the UTM zone is unknown",
            mend="check the navigation and its times, or give crs=",
            code="pose-missing",
        )
        latitude, longitude = poses[:2, lines_with_pose[lines_with_pose.size // 2]]
        crs = utm_zone(float(latitude), float(longitude))
    user_crs, crs = crs, crs_of(crs)
    SchemaError.raise_if(
        not is_in_metres(crs),
        f"crs {user_crs!r:.80} is not a map in metres to the east and north",
        mend="give a projected one, such as 'EPSG:32617'",
        code="crs-unusable",
    )
    terrain = (
        _call(terrain_of, heights=dem.squeeze(drop=True).transpose("y", "x").data, grid=grid)
        if dem is not None
        else None
        if ground is None
        else float(ground)
    )
    # chunks of the line, or else the chunks that radiometry will use
    planes = [array for array in line.variables.values() if {ALONG_TRACK, CROSS_TRACK} <= set(array.dims)]
    chunked = [array for array in sorted(planes, key=lambda array: -array.ndim) if array.chunks is not None]
    samples = line.sizes[CROSS_TRACK] * line.sizes.get(BAND, 1)
    chunks = (
        tuple(chunked[0].chunksizes[ALONG_TRACK])
        if chunked
        else normalize_chunks(lines_a_task(4 * samples, CHUNK_LINES), (line.sizes[ALONG_TRACK],))[0]
    )
    boresight_angles, lever_arm_m = tuple(map(float, boresight)), tuple(map(float, lever_arm))
    swath = _call(
        Swath,
        poses=poses,
        look=_call(directions, across=across, along=along),
        boresight=boresight_angles,
        lever_arm=lever_arm_m,
        ground=terrain,
        crs=crs,
        starts=np.concatenate([[0], np.cumsum(chunks)]),
    )
    if isinstance(swath, Swath):
        _warn_of_nothing_seen(swath, None if user_crs is None else crs)
    places = da.map_blocks(
        places_of,
        dask.delayed(swath, pure=True),
        chunks=((len(_PLACES),), chunks, (len(across),)),
        dtype=np.float64,
        meta=np.empty((0, 0, 0)),
        name=None,
    )
    # store the poses used; lazy ones in chunks of the cube
    if not isinstance(poses, np.ndarray):
        poses = da.from_delayed(poses, (len(POSE), line.sizes[ALONG_TRACK]), np.float64).rechunk((1, chunks))
    located = line.drop_vars(POSE, errors="ignore").assign_coords(
        {name: label(xr.DataArray(poses[row], dims=(ALONG_TRACK,)), name) for row, name in enumerate(POSE)}
    )
    # the positions of pixels, and a flag for those without
    dims = (ALONG_TRACK, CROSS_TRACK)
    attrs: dict[str, dict[str, str]] = {name: {"grid_mapping": "spatial_ref"} for name in _PLACES}
    for name, standard in (("east", "projection_x_coordinate"), ("north", "projection_y_coordinate")):
        attrs[name] |= {"crs": crs, "standard_name": standard}
    coordinates = {n: label(xr.DataArray(places[k], dims=dims), n, **attrs[n]) for k, n in enumerate(_PLACES)}
    coordinates["spatial_ref"] = xr.DataArray(np.int64(0), attrs=grid_mapping_attrs(crs))
    quality = xr.Variable(dims, (np.isnan(places[0]) * np.uint16(Quality.OFF_SWATH)).astype(np.uint16))
    if "quality" in line.variables:
        bits = require(line, ["quality"], "ground positions")["quality"]
        quality = bits.variable.astype(np.uint16) | quality
    located = (
        located.drop_vars(coordinates, errors="ignore")
        .assign(quality=label(xr.DataArray(quality), "quality"))
        .assign_coords(coordinates)
    )
    height = "of the raster" if ground is None else f"{float(ground):g} m {origins['ground']}"
    angles, arm = (" ".join(map("{:g}".format, vector)) for vector in (boresight_angles, lever_arm_m))
    settings = {
        "boresight": list(boresight_angles),
        "lever_arm": list(lever_arm_m),
        "ground": "dem" if ground is None else float(ground),
        "clock_offset_s": float(clock_offset_s),
        "location_from": f"ground {height}, boresight {angles} degrees {origins['boresight']}, "
        f"lever arm {arm} m {origins['lever_arm']}",
        "pose_interpolation": interpolation if "recorded" in columns else "none",
    }
    located.attrs = with_convention({**line.attrs, **settings}, declared.of_canonical)
    return located


def _warn_of_nothing_seen(swath: Swath, crs: str | None) -> None:
    # Locate some lines; warn if none of their pixels meets the ground, or if ``crs`` distorts distances.
    lines = np.flatnonzero(np.isfinite(swath.poses).all(axis=0))
    if not lines.size:
        return
    lines = lines[np.unique(np.linspace(0, lines.size - 1, _SAMPLED_LINES).astype(int))]
    sample = replace(swath, poses=swath.poses[:, lines], starts=np.array([0, lines.size]))
    latitude, longitude, altitude = np.median(sample.poses[:3], axis=1).tolist()
    ground = swath.ground
    height = f"at {ground:.4g}" if isinstance(ground, float) else f"of the DEM at up to {ground.highest:.4g}"
    warn_if(
        np.isnan(places_of(sample, (0, 0, 0))[0]).all(),
        f"no pixel of {lines.size} lines meets the ground {height} m: the camera is at "
        f"latitude {latitude:.6f}, longitude {longitude:.6f}, {altitude:.4g} m above the ellipsoid; "
        "look at the poses and at the extent of the DEM",
        "ground-not-seen",
    )
    if crs is not None:
        factors = _pyproj().Proj(_crs(crs)).get_factors(longitude, latitude)
        scale = max(factors.meridional_scale, factors.parallel_scale, key=lambda scale: abs(scale - 1.0))
        warn_if(
            abs(scale - 1.0) > _MAX_MAP_DISTORTION,
            f"a metre of ground is {scale:.3g} m on the map {crs:.40}, so cells and areas are wrong; the "
            f"UTM zone there is {utm_zone(latitude, longitude)}",
            "crs-distorted",
        )


# --- poses -------------------------------------------------------------------------------------------------


def _poses(
    *,
    convention: Convention,
    crs: Any,
    clock_offset_s: float,
    max_gap_s: float | None,
    interpolation: Interpolation,
    recorded: Any = None,
    wanted: Any = None,
    **columns: Any,
) -> Floats:
    # Return canonical poses (6, line), float64; an incomplete pose is NaN in all six.
    values = canonical_values(*(columns[name] for name in POSE), convention=convention, crs=crs)
    if recorded is None:
        values[:, ~np.isfinite(values).all(axis=0)] = np.nan
        return values
    return poses_at(
        np.asarray(recorded),
        values,
        np.asarray(wanted),
        clock_offset_s=clock_offset_s,
        max_gap_s=max_gap_s,
        interpolation=interpolation,
    )


# --- places ------------------------------------------------------------------------------------------------


def is_located(line: xr.Dataset) -> bool:
    # Return whether every pixel of a line has ``east`` and ``north``.
    return all(
        axis in line.variables and set(line[axis].dims) == {ALONG_TRACK, CROSS_TRACK}
        for axis in ("east", "north")
    )


def _is_lazy(*values: Any) -> bool:
    return any(dask.is_dask_collection(value) for value in values)


def _call(function: Any, **inputs: Any) -> Any:
    # Call a function at once if all inputs are in memory, else as a node of the graph.
    return dask.delayed(function, pure=True)(**inputs) if _is_lazy(*inputs.values()) else function(**inputs)


# --- rasters of heights -----------------------------------------------------------------------------------


_HEIGHTS_M = (-500.0, 9000.0)  # of the land on earth
_MAX_UNEVENNESS_CELLS = 1e-3  # deviation of a raster's coordinates from even spacing


@dataclass(frozen=True)
class TerrainGrid:
    # Grid of a height raster, and the reference of its heights.
    crs: str  #: Reference system, as `hyperpaint.geometry.georeference.locating.crs_of` returns it
    x: tuple[float, float]  #: Coordinate of the centre of the first cell, and step from cell to cell
    y: tuple[float, float]
    heights: Convention  #: Height reference of the raster
    metres: float  #: Metres of a unit of height; negative for depths
    missing: tuple[float, ...]  #: Numbers that mark holes


@dataclass(frozen=True)
class Terrain:
    # A height raster, prepared for the kernel.
    grid: TerrainGrid  #: Position of its cells
    heights: Floats  #: (row, col) float64: above the ellipsoid [m]; NaN in holes
    #: (block, block) float64: highest point of every block of `hyperpaint.kernels.arguments.BLOCK` cells;
    #: minus infinity in holes
    block_max: Floats
    lowest: float  #: Lowest height of the raster [m]
    highest: float


def grid_of(dem: xr.DataArray) -> TerrainGrid:
    # Return the grid of a raster from its coordinates and attributes; its heights are not read.
    #
    # Raises `SchemaError`: Other dims than (y, x), fewer than two cells, coordinates that are missing or
    # uneven, a grid that is turned, no crs, a unit that contradicts the crs, or
    # ``height_reference`` that is not declared; all are listed. Raises `UnitsError`: The unit of heights
    # is not a length. Raises `MissingExtraError`: pyproj is not installed. Warns `PaintWarning`:
    # ``height_reference`` contradicts the crs.
    SchemaError.raise_if(
        not isinstance(dem, xr.DataArray),
        f"the DEM is {type(dem).__name__}",
        expected="a DataArray (y, x) of heights",
        mend="open a file with rioxarray.open_rasterio; of a Dataset choose a variable: dataset['band_data']",
        code="type-wrong",
    )
    problems = Problems("this DEM cannot be used", SchemaError)
    dem = dem.squeeze(drop=True) if dem.ndim > 2 else dem
    axes: dict[str, tuple[float, float]] = {}
    if set(dem.dims) != {"y", "x"}:
        problems.add(f"dims ({', '.join(map(str, dem.dims))})", expected="(y, x)", code="dim-missing")
    else:
        for name in ("x", "y"):
            with problems.noting(SchemaError, "grid"):
                # The first coordinate and the step.
                SchemaError.raise_if(
                    name not in dem.coords, f"no coordinate {name!r} of cell centres", code="variable-missing"
                )
                values = dem[name].values.astype(np.float64)
                SchemaError.raise_if(
                    values.size < 2,
                    f"{values.size} cells along {name!r}",
                    expected="two or more",
                    code="length-mismatch",
                )
                step = (values[-1] - values[0]) / (values.size - 1)
                deviation = np.abs(values - (values[0] + step * np.arange(values.size)))
                SchemaError.raise_if(
                    not (
                        np.isfinite(step)
                        and step != 0.0
                        and deviation.max() <= _MAX_UNEVENNESS_CELLS * abs(step)
                    ),
                    f"coordinate {name!r} is not evenly spaced",
                    mend="bring the DEM to a regular grid",
                    code="grid-uneven",
                )
                axes[name] = float(values[0]), float(step)
    mapping = dem.attrs.get("grid_mapping", dem.encoding.get("grid_mapping", "spatial_ref"))
    mapping_attrs = dem.coords[mapping].attrs if mapping in dem.coords else {}
    # the origin of a GeoTransform may be stale in a cropped raster, so only directions are used; on the grid
    # of a flight to the south, x increases to the west
    steps = numbers(str(mapping_attrs.get("GeoTransform", "")).split()) or []
    problems.add_if(
        len(steps) == 6 and (steps[2] or steps[4] or steps[1] < 0.0 < axes.get("x", (0.0, 0.0))[1]),
        "the GeoTransform of spatial_ref rotates the raster, so x and y are not map coordinates",
        mend="resample it to a grid with north up, by rioxarray's reproject or "
        "hyperpaint.geometry.orthorectify",
        code="grid-turned",
    )
    # declared by rioxarray's coordinate, or by an attribute of the raster
    crs_texts = [
        str(attrs[name])
        for attrs in (dem.attrs, mapping_attrs)
        for name in ("crs", "crs_wkt", "spatial_ref")
        if attrs.get(name)
    ]
    problems.add_if(
        not crs_texts,
        "no crs",
        mend="open it with rioxarray, or declare it: dem.assign_attrs(crs='EPSG:32617')",
        code="crs-missing",
    )
    declared = {
        name: dem.attrs[name] for name in ("height_reference", "geoid_undulation") if name in dem.attrs
    }
    crs, vertical = "", None
    if crs_texts:
        crs = crs_of(crs_texts[0])
        # the heights of the reference system; None where it has none
        system = _pyproj().CRS.from_user_input(crs_texts[0])
        parts = [part for part in system.sub_crs_list if part.is_vertical] or [system]
        axis = next((axis for axis in parts[0].axis_info if axis.direction in ("up", "down")), None)
        if axis is not None:
            is_ellipsoidal = not parts[0].is_vertical or "ellips" in parts[0].name.lower()
            sign = -1.0 if axis.direction == "down" else 1.0
            reference = "ellipsoid" if is_ellipsoidal else "geoid"
            vertical = Vertical(parts[0].name, axis.unit_name, sign * axis.unit_conversion_factor, reference)
    # the unit of heights, by the raster or else by its reference system
    metres = 1.0 if vertical is None else vertical.metres
    if "units" in dem.attrs:
        units = str(dem.attrs["units"])
        try:
            stated = conversion_factor(units, "m")
            problems.add_if(
                vertical is not None and abs(stated / abs(metres) - 1.0) > 1e-5,
                f"units {units!r}, but its crs has heights in {vertical.unit if vertical else ''}",
                mend="correct the attribute units, or the crs",
                code="units-conflict",
            )
            metres = metres if vertical is not None else stated
        except UnitsError as error:
            raise UnitsError(
                f"units {units!r} of the heights of this dem",
                expected="a length such as 'm', 'ft' or 'US survey foot'",
                code=error.problem.code,
            ) from error
    if vertical is not None and vertical.reference == "ellipsoid":
        declared.setdefault("height_reference", "ellipsoid")
    heights = Convention()
    if "height_reference" not in declared:
        problems.add(
            "height_reference is not declared; positions are above the ellipsoid, most DEMs above the geoid",
            mend="dem.assign_attrs(height_reference='ellipsoid'), or height_reference='geoid' with "
            "geoid_undulation=, the height of the geoid above the ellipsoid [m]",
            code="height-reference-missing",
        )
    else:
        with problems.noting(SchemaError, "heights"):
            heights = Convention(**declared)
            heights.ellipsoidal(0.0)
    problems.raise_if_any()
    if vertical is not None and declared.get("height_reference", vertical.reference) != vertical.reference:
        warn_user(
            f"heights of the dem are declared above the {declared['height_reference']}, but its crs has "
            f"{vertical.name}, above the {vertical.reference}",
            "heights-conflict",
        )
    # where xarray decoded the raster (fill value in `encoding`), holes are already NaN
    hole_marks = [dem.attrs[name] for name in ("_FillValue", "missing_value", "nodata") if name in dem.attrs]
    holes = {float(mark) for mark in hole_marks if np.ndim(mark) == 0 and np.isfinite(float(mark))}
    return TerrainGrid(crs, axes["x"], axes["y"], heights, metres, tuple(holes))


def terrain_of(heights: Array, grid: TerrainGrid) -> Terrain:
    # Return a raster of heights (row, col), prepared for the kernel.
    #
    # Raises `SchemaError`: All cells are holes.
    elevation = np.array(heights, dtype=np.float64)
    for value in grid.missing:
        elevation[np.asarray(heights) == value] = np.nan
    elevation[~np.isfinite(elevation)] = np.nan
    elevation *= grid.metres
    # a number that marks holes, such as -9999, and is not declared
    is_false = (elevation < _HEIGHTS_M[0]) | (elevation > _HEIGHTS_M[1])
    if is_false.any():
        warn_user(
            f"{is_false.sum()} heights of the DEM, such as {elevation[is_false][0]:g} m, are outside "
            f"{_HEIGHTS_M[0]:g} to {_HEIGHTS_M[1]:g} m and are holes; declare the number that marks holes "
            "as the attribute _FillValue",
            "dem-heights",
        )
    elevation[is_false] = np.nan
    SchemaError.raise_if(np.isnan(elevation).all(), "this DEM contains only holes", code="dem-empty")
    elevation = np.ascontiguousarray(grid.heights.ellipsoidal(elevation))
    # highest point of every block of cells; neighbouring blocks share a border
    filled = np.where(np.isnan(elevation), -np.inf, elevation)
    rows, cols = (range(0, size - 1, BLOCK) for size in filled.shape)
    strips = [filled[r : r + BLOCK + 1].max(axis=0) for r in rows]
    block_max = np.array([[strip[c : c + BLOCK + 1].max() for c in cols] for strip in strips])
    return Terrain(grid, elevation, block_max, float(np.nanmin(elevation)), float(np.nanmax(elevation)))


_LONGITUDE_LATITUDE = "OGC:CRS84"
_PERCENTILES = (5.0, 95.0)


@documented()
def footprint(located: xr.Dataset, *, crs: Any = None) -> dict[str, Any]:
    """Return the outline of the ground that a located line covers, as a GeoJSON Feature (eager).

    Parameters
    ----------
    located
    crs
        Reference system of the outline; by default longitude and latitude, as GeoJSON wants it.

    Returns
    -------
    dict
        Feature with a Polygon through the centres of
        the outermost pixels; a MultiPolygon where lines without a pose, or the longitude of 180 degrees,
        divide it. Properties: ``area`` on the
        map of the line [m2]; ``lines``, the number of located lines; ``crs``.

    Raises
    ------
    SchemaError
        The line is not located, or no two successive lines are.
    MissingExtraError
        shapely or pyproj is not installed (extra ``geo``).

    Notes
    -----
    The outline is the union of the quadrilaterals between the ends of neighbouring lines: ground that a
    wobble shows twice is counted once. Bends of less than half the spacing of the pixels are left out.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> from hyperpaint.base.attitude_conventions import Convention
    >>> from hyperpaint.geometry import PinholeCamera, locate
    >>> pose = dict(longitude=-81.0, altitude=150.0, roll=0.0, pitch=0.0, heading=0.0)
    >>> line = xr.Dataset({name: ("along_track", np.full(2, value)) for name, value in pose.items()})
    >>> line = line.assign(latitude=("along_track", [34.0, 34.0001]), cross_track=[0, 1, 2])
    >>> camera = PinholeCamera(3, field_of_view=90.0, edges="centres")
    >>> convention = Convention(column_order="left_to_right")
    >>> located = locate(line, ground=50.0, camera=camera, convention=convention)
    >>> outline = footprint(located)
    >>> outline["geometry"]["type"], round(outline["properties"]["area"], -1)  # [m2]
    ('Polygon', 1110.0)
    """
    with needs_extra("shapely", "geo", "the outline of a line"):
        import shapely
    east, north, source = _positions(located)
    # the outermost located pixels of every line (line, end, 2)
    is_located = np.isfinite(east) & np.isfinite(north)
    outermost = is_located.argmax(axis=1), is_located.shape[1] - 1 - is_located[:, ::-1].argmax(axis=1)
    rows = np.arange(len(east))
    ends = np.stack(
        [np.stack([east[rows, columns], north[rows, columns]], axis=-1) for columns in outermost], axis=1
    )
    is_placed = np.all(np.isfinite(ends), axis=(1, 2))
    pairs = np.flatnonzero(is_placed[1:] & is_placed[:-1])
    SchemaError.raise_if(
        not pairs.size,
        "no two neighbouring lines have ground positions",
        mend="look at poses and at the quality's off_swath",
        code="ground-not-seen",
    )
    quads = shapely.convex_hull(shapely.multipoints(np.concatenate([ends[pairs], ends[pairs + 1]], axis=1)))
    bend = 0.5 * float(np.nanmedian(np.concatenate([steps.ravel() for steps in _steps(east, north)])))
    covered = shapely.simplify(shapely.union_all(quads), bend)
    target = _LONGITUDE_LATITUDE if crs is None else crs_of(crs)
    outline = shapely.transform(covered, lambda xy: between_maps(xy, source, target))
    geometry = json.loads(shapely.to_geojson(outline))
    if crs is None:
        geometry, _ = cut_at_dateline(geometry)
    return {
        "type": "Feature",
        "geometry": geometry,
        "properties": {"area": float(covered.area), "lines": int(is_placed.sum()), "crs": target},
    }


@documented()
def spacing(located: xr.Dataset) -> dict[str, float]:
    """Return the spacing of the pixels of a located line on the ground (eager).

    Parameters
    ----------
    located

    Returns
    -------
    dict
        ``across`` and ``along``: median distance of neighbouring columns and lines [m]; with ``_p05`` and
        ``_p95`` their 5th and 95th percentiles. ``gsd``: the larger of the medians, the default of maps.
        ``reversed``: share of the steps from line to line that go back against the flight [1]. ``off_swath``:
        share of the pixels without a ground position [1].

    Raises
    ------
    SchemaError
        The line is not located, or no two neighbouring pixels are.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> from hyperpaint.base.attitude_conventions import Convention
    >>> from hyperpaint.geometry import PinholeCamera, locate
    >>> pose = dict(longitude=-81.0, altitude=150.0, roll=0.0, pitch=0.0, heading=0.0)
    >>> line = xr.Dataset({name: ("along_track", np.full(2, value)) for name, value in pose.items()})
    >>> line = line.assign(latitude=("along_track", [34.0, 34.0001]), cross_track=[0, 1, 2])
    >>> camera = PinholeCamera(3, field_of_view=90.0, edges="centres")
    >>> convention = Convention(column_order="left_to_right")
    >>> located = locate(line, ground=50.0, camera=camera, convention=convention)
    >>> distances = spacing(located)
    >>> round(distances["across"]), round(distances["along"], 1)  # [m]
    (100, 11.1)
    """
    east, north, _ = _positions(located)
    distances: dict[str, float] = {}
    for name, steps in zip(("across", "along"), _steps(east, north), strict=True):
        finite = steps[np.isfinite(steps)]
        # a single column or line has no neighbour
        distances[name] = float(np.median(finite)) if finite.size else np.nan
        for percent in _PERCENTILES:
            distances[f"{name}_p{percent:02.0f}"] = (
                float(np.percentile(finite, percent)) if finite.size else np.nan
            )
    SchemaError.raise_if(
        np.isnan([distances["across"], distances["along"]]).all(),
        "no two neighbouring pixels have ground positions",
        mend="look at poses and at the quality's off_swath",
        code="ground-not-seen",
    )
    distances["gsd"] = float(np.nanmax([distances["across"], distances["along"]]))
    # steps from line to line at the middle column, against the mean direction of flight
    middle_column = east.shape[1] // 2
    steps = np.stack([np.diff(east[:, middle_column]), np.diff(north[:, middle_column])], axis=-1)
    steps = steps[np.isfinite(steps).all(axis=1)]
    distances["reversed"] = float((steps @ steps.mean(axis=0) < 0.0).mean()) if steps.size else np.nan
    distances["off_swath"] = float(np.isnan(east).mean())
    return distances


def _positions(located: xr.Dataset) -> tuple[Floats, Floats, str]:
    coordinates = require(located, ["east", "north"], "the outline of a line")
    crs: Any = coordinates["east"].attrs.get("crs")
    SchemaError.raise_if(
        not isinstance(crs, str),
        "'east' does not declare its map",
        mend="locate the line with hyperpaint.geometry.locate",
        code="crs-missing",
    )
    east, north = dask.compute(coordinates["east"].data, coordinates["north"].data)
    return np.asarray(east), np.asarray(north), crs


def _steps(east: Floats, north: Floats) -> tuple[Floats, Floats]:
    across = np.hypot(np.diff(east, axis=1), np.diff(north, axis=1))
    return across, np.hypot(np.diff(east, axis=0), np.diff(north, axis=0))


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


#: Thresholds of a solution, and where they come from.
RULES = SimpleNamespace(
    # Largest factor by which the other solved parameters may widen the uncertainty of a parameter.
    max_widening=30.0,
    # Standard deviations of picking beyond which a point is left out: 1 in 25,000 valid points.
    outlier_sd=4.5,
    max_outlier_rounds=10,
    # Tested clock offsets relative to the start value [s]: every period of a wobble has a local minimum.
    clock_search_s=tuple((np.arange(-10, 11) * 0.1).tolist()),
    max_clock_candidates=3,
    # Largest residual of a candidate relative to the best one.
    candidate_ratio=3.0,
    soft_miss_px=5.0,  # misses above this have less weight in the search of the clock
    # Smallest accepted ratio of the residual of another clock offset to that of the best one.
    rival_ratio=1.3,
    same_clock_s=0.05,  # clock offsets nearer than this are equal
    # Deviation from the median miss above which a point is a blunder [fields of view].
    blunder_fields=2.0,
)


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
        return dict(zip(self.solved, np.sqrt(np.diag(self.covariance.values)).tolist(), strict=True))

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
    # faults of the arguments come before faults of the numbers
    problems = Problems("a boresight cannot be solved for", SchemaError)
    count = control_points.sizes.get("point", 0)
    problems.raise_if_any(
        (
            isinstance(solve, str) or not names or set(solve) - set(PARAMETERS),
            Problem(f"solve {solve!r:.80}", f"some of {', '.join(PARAMETERS)}", code="choice-unknown"),
        ),
        (
            missing,
            Problem(
                f"control points have no {', '.join(missing)} (point)",
                mend="see hyperpaint.io.read_control_points",
                code="variable-missing",
            ),
        ),
    )
    problems.raise_if_any(
        (
            not all(np.isfinite(control_points[name].values).all() for name in _FIELDS),
            Problem(
                "control points have numbers that are not finite",
                mend="leave these points out",
                code="not-finite",
            ),
        ),
        (
            2 * count <= len(names),
            Problem(
                f"{count} points",
                f"more than {len(names) / 2:g} for {', '.join(names)}",
                code="control-points-few",
            ),
        ),
    )
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
    crs = SchemaError.raise_if_none(
        points.attrs.get("crs") if crs is None else crs,
        "the CRS of east and north is missing",
        mend="pass crs=",
        code="crs-missing",
    )
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

    def whitened(self, free: Floats) -> "Misses":
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
