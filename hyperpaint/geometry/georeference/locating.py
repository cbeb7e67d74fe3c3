"""Ground position of every pixel of a flight line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import dask
import dask.array as da
import numpy as np
import xarray as xr

from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.constants import lines_a_task
from hyperpaint.base.errors import Problems, SchemaError, UnitsError, warn_user
from hyperpaint.base.facts import conversion_factor, documented, takes_quantities
from hyperpaint.base.schema import (
    ALONG_TRACK,
    BAND,
    CHUNK_LINES,
    CROSS_TRACK,
    Array,
    Floats,
    Ints,
    Quality,
    label,
    require,
)
from hyperpaint.io.files.reading import numbers
from hyperpaint.kernels.arguments import BLOCK, LineFrames, LineRays, Raster

from .cameras import PinholeCamera, directions, look_angles
from .geodesy import (
    crs_of,
    grid_mapping_attrs,
    is_in_metres,
    near_turns,
    polynomials,
    turn_of_north,
    utm_zone,
    vertical_of,
)
from .poses import (
    LOCATION_UNITS,
    NAVIGATION_TIME,
    POSE,
    Interpolation,
    canonical_values,
    check_interpolation,
    convention_of_line,
    matrices,
    pose_columns,
    poses_at,
    quaternions,
    with_convention,
)

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
    ground: float | Terrain  #: Height of level ground above the ellipsoid [m], or height raster
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
    frames = LineFrames(x, y, height, turn_of_north(latitude))
    if isinstance(swath.ground, float):
        level_places(rays, frames, swath.ground, out)
        return out
    terrain, grid = swath.ground, swath.ground.grid
    col, row = x.copy(), y.copy()
    if grid.crs != swath.crs:
        col, row, _ = polynomials(latitude, longitude, altitude, reach, grid.crs)
    # longitudes of rasters begin at -180 or 0, or cross 180
    col[:, 0] += near_turns(col[:, 0], grid.x[0] + grid.x[1] * (terrain.heights.shape[1] - 1) / 2, grid.crs)
    for coefficients, (first_centre, step) in ((col, grid.x), (row, grid.y)):
        coefficients[:, 0] -= first_centre
        coefficients /= step
    raster = Raster(row, col, terrain.heights, terrain.block_max, terrain.lowest, terrain.highest)
    raster_places(rays, frames, raster, out)
    return out


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
    around the camera, see `hyperpaint.geometry.georeference.geodesy.polynomials`.

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
    _check(line, boresight, lever_arm, ground, dem, clock_offset_s)
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
        (columns,) = dask.compute(columns)
    poses = _call(
        _poses,
        convention=declared,
        crs=crs,
        clock_offset_s=clock_offset_s,
        max_gap_s=max_gap_s,
        interpolation=interpolation,
        **columns,
    )
    crs = _map_of(poses, crs)
    terrain = None if ground is None else float(ground)
    if dem is not None:
        terrain = _call(terrain_of, heights=dem.squeeze(drop=True).transpose("y", "x").data, grid=grid)
    chunks = _line_chunks(line)
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
        quality = line["quality"].variable.transpose(*dims).astype(np.uint16) | quality
    located = located.drop_vars(coordinates, errors="ignore")
    located = located.assign(quality=label(xr.DataArray(quality), "quality")).assign_coords(coordinates)
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


# --- arguments ---------------------------------------------------------------------------------------------


def _check(
    line: xr.Dataset,
    boresight: Sequence[float],
    lever_arm: Sequence[float],
    ground: float | None,
    dem: xr.DataArray | None,
    clock_offset_s: float,
) -> None:
    problems = Problems("this line cannot be located", SchemaError)
    for dim in (ALONG_TRACK, CROSS_TRACK):
        problems.add_if(
            dim not in line.dims,
            f"it has no dim {dim!r}, only {', '.join(map(str, line.dims))}",
            mend=f"isel({dim}=[5]) keeps it, dims= names it",
            code="dim-missing",
        )
    for name, vector in (("boresight", boresight), ("lever_arm", lever_arm)):
        try:
            is_valid = np.shape(vector) == (3,) and bool(np.isfinite(np.asarray(vector, np.float64)).all())
        except (TypeError, ValueError):
            is_valid = False
        problems.add_if(
            not is_valid, f"{name} {vector!r:.80}", expected="three finite numbers", code="type-wrong"
        )
    problems.add_if(
        (ground is None) == (dem is None),
        "ground= and dem= are both missing" if dem is None else "ground= and dem= are both given",
        mend="give the height of the ground above the ellipsoid (ground=, in m), or dem=",
        code="argument-missing" if dem is None else "option-conflict",
    )
    for name, number in (("ground", ground), ("clock_offset_s", clock_offset_s)):
        is_number = isinstance(number, int | float | np.number) and np.isfinite(number)
        problems.add_if(
            number is not None and not is_number,
            f"{name} {number!r:.80}",
            expected="a finite number",
            code="not-finite",
        )
    problems.raise_if_any()


def _map_of(poses: Any, crs: Any) -> str:
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
    code = crs_of(crs)
    SchemaError.raise_if(
        not is_in_metres(code),
        f"crs {crs!r:.80} is not a map in metres to the east and north",
        mend="give a projected one, such as 'EPSG:32617'",
        code="crs-unusable",
    )
    return code


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


def _line_chunks(line: xr.Dataset) -> tuple[int, ...]:
    # Return the chunks of the line, or else the chunks that radiometry will use.
    for array in sorted(
        [v for v in line.variables.values() if {ALONG_TRACK, CROSS_TRACK} <= set(v.dims)],
        key=lambda v: -v.ndim,
    ):
        if array.chunks is not None:
            return tuple(array.chunksizes[ALONG_TRACK])
    samples = line.sizes[CROSS_TRACK] * line.sizes.get(BAND, 1)
    return line_slabs(line.sizes[ALONG_TRACK], lines_a_task(4 * samples, CHUNK_LINES)) or (0,)


def line_slabs(lines: int, slab: int) -> tuple[int, ...]:
    # Return the number of lines of every slab; the last slab has the remainder.
    full_slabs, remainder = divmod(lines, slab)
    return (slab,) * full_slabs + ((remainder,) if remainder else ())


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


_MAX_UNEVENNESS_CELLS = 1e-3  # deviation of a raster's coordinates from even spacing


@dataclass(frozen=True)
class TerrainGrid:
    # Grid of a height raster, and the reference of its heights.
    crs: str  #: Reference system, as `hyperpaint.geometry.georeference.geodesy.crs_of` returns it
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
    problems = Problems("this DEM cannot be used", SchemaError)
    dem = dem.squeeze(drop=True) if dem.ndim > 2 else dem
    axes: dict[str, tuple[float, float]] = {}
    if set(dem.dims) != {"y", "x"}:
        problems.add(f"dims ({', '.join(map(str, dem.dims))})", expected="(y, x)", code="dim-missing")
    else:
        for name in ("x", "y"):
            try:
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
            except SchemaError as error:
                problems.add_error("grid", error)
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
        vertical = vertical_of(crs_texts[0])
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
        try:
            heights = Convention(**declared)
            heights.ellipsoidal(0.0)
        except SchemaError as error:
            problems.add_error("heights", error)
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
    SchemaError.raise_if(np.isnan(elevation).all(), "this DEM contains only holes", code="dem-empty")
    elevation *= grid.metres
    elevation = np.ascontiguousarray(grid.heights.ellipsoidal(elevation))
    # highest point of every block of cells; neighbouring blocks share a border
    filled = np.where(np.isnan(elevation), -np.inf, elevation)
    rows, cols = (range(0, size - 1, BLOCK) for size in filled.shape)
    strips = [filled[r : r + BLOCK + 1].max(axis=0) for r in rows]
    block_max = np.array([[strip[c : c + BLOCK + 1].max() for c in cols] for strip in strips])
    return Terrain(grid, elevation, block_max, float(np.nanmin(elevation)), float(np.nanmax(elevation)))
