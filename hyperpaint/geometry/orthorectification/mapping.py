"""Orthorectification: a flight line as a map."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, Literal

import dask
import dask.array as da
import numpy as np
import xarray as xr

from hyperpaint.base.errors import Problems, SchemaError, warn_user
from hyperpaint.base.facts import documented, one_of, takes_quantities
from hyperpaint.base.schema import (
    ALONG_TRACK,
    BAND,
    CHUNK_LINES,
    CROSS_TRACK,
    Array,
    Progress,
    dtype_of,
    label,
    numbers_of,
    require,
)
from hyperpaint.geometry.georeference.geodesy import crs_of, grid_mapping_attrs
from hyperpaint.geometry.georeference.locating import is_located, line_slabs, locate
from hyperpaint.geometry.georeference.poses import LOCATION_UNITS
from hyperpaint.io.store.computing import client_in_force

from .grids import NORTH, check_cells, covering, direction_of_flight, survey_lines
from .tiling import RULES, Plan, Tiles, in_memory, in_slabs, mapped, needed_slabs, prepared, tile_windows

_GRIDS = ("north", "flight")
_METHODS = ("nearest", "bilinear")
_RELIEF = ("ground_height", "view_zenith")
# dim of the flight line along which positions are counted
_AXES = {
    "glt_line": ALONG_TRACK,
    "nearest_line": ALONG_TRACK,
    "glt_sample": CROSS_TRACK,
    "nearest_sample": CROSS_TRACK,
}
# Largest relative shift of neighbouring pixels by their heights without hidden ground [spacing across].
# On a visible wall it is 1, whatever its height. With 1.25, a sixth of the hidden cells behind
# cars is shown; with 0.6, as many as with 1.05, and more visible ground is lost (support/hidden_ground.py).
_MAX_PARALLAX_PX = 1.05
_MAX_KEPT_BYTES = 64 * 2**20  # positions kept from the survey for the tiles: 6,500 lines of 640 columns
_MAX_TILES = 100_000  # a larger graph takes minutes and gigabytes before anything is computed


@takes_quantities(**LOCATION_UNITS, gsd="m", bounds="m")
@documented()
def orthorectify(
    line: xr.Dataset,
    gsd: float | None = None,
    *,
    grid: Literal["north", "flight"] = "north",
    variables: Iterable[str] | None = None,
    method: Literal["nearest", "bilinear"] = "nearest",
    multi_hit: Literal["nadir", "first", "last"] = "nadir",
    max_stretch: float = 3.0,
    tile: int = 256,
    bounds: Sequence[float] | None = None,
    progress: Progress | None = None,
    **location: Any,
) -> xr.Dataset:
    """Return a flight line as a map of square cells, with the position in the line of every cell.

    Lazy except for one survey of the lines' positions. A task makes one tile, and reads only the slabs of
    lines that cover it.

    Parameters
    ----------
    line
        A flight line; either located (``east``, ``north``, as `hyperpaint.geometry.locate` adds them), or to
        be located with the options of ``location``.
    gsd
        Edge of a cell [m]; by default the larger of the spacings across and along the track, as medians over
        lines. Finer cells repeat pixels, coarser ones leave pixels out: nothing is averaged.
    grid
        ``"north"``: north up, cells starting at whole multiples of ``gsd``, so that several lines share one
        grid. ``"flight"``: rows across the flight, which goes up; smaller, and quicker, since a tile then
        needs few lines.
    variables
        Variables of the map: cubes, and variables with one value per pixel, line or column. By default
        reflectance (else radiance; with neither it is computed from counts), ``quality``, ``time`` as
        ``line_time``, ``irradiance_age``, ``view_zenith``, ``view_azimuth`` and ``ground_height``, as far as
        the line has them. Spectra are brought to nominal wavelengths first; counts are not.
    method
        ``"nearest"`` leaves spectra and integers unchanged. ``"bilinear"`` interpolates spectra and numbers
        between four pixels, is NaN where one of them is NaN, and combines their flags by OR; directions,
        times and values per line or column come from the nearest pixel.
    multi_hit
        Choice where several positions of the line show one cell: the position nearest to the middle column
        (``"nadir"``), or the first or last in time. Spectra are never averaged.
    max_stretch
        Longest edge between neighbouring pixels, in cells, or in pixel spacings where these are
        larger. Four pixels with a longer edge are a gap: two lost frames are bridged, three are not.
    tile
    bounds
        West, south, east, north of the map, in the line's crs [m]; by default all of the line.
    progress
    **location

    Returns
    -------
    xarray.Dataset
        The variables on (y, x[, band]), all lazy, and ``glt_line`` and ``glt_sample``: the position of every
        cell in the line, in lines and columns and fractions of them; ``nearest_line`` and ``nearest_sample``:
        the nearest of the four pixels around it; all by the index coordinates of the line where these are
        integers, so that a crop keeps the numbers of the whole line; ``hits``: number of patches of four
        pixels that cover a cell; ``gap``: uncovered, between the ends of the lines. In uncovered cells
        numbers are NaN, integers have the value of their attribute ``empty_value``, and ``quality`` is
        ``off_swath``. ``spatial_ref`` holds the crs and the ``GeoTransform`` of GDAL. ``x`` and ``y`` are map
        coordinates with north up. A grid along the flight is turned, see its GeoTransform, and has ``east``
        and ``north`` (y, x) instead: other programs would read distances as map coordinates. (The
        ``reproject`` of rioxarray needs a target for it, or another map to match.)

    Raises
    ------
    SchemaError
        Options that are unknown or in conflict; no pixel has a ground position; variables are missing; all
        problems of a kind are listed.
    TimeError, UnitsError, MissingExtraError
        As `hyperpaint.geometry.locate`.

    See Also
    --------
    hyperpaint.geometry.locate, hyperpaint.geometry.map_report

    Notes
    -----
    Four neighbouring pixels span a bilinear patch on the map, which is inverted at every cell whose centre
    lies in it. This is exact, needs no search radius and leaves no holes in a line that has none [1]_.

    On a line located on a raster of heights, ground hidden behind a car or a house is a gap: where the
    heights of four neighbouring pixels shift them against each other by more than their spacing, the surface
    falls away steeper than the line of sight, and the ground between them was not seen. Some cells along the
    edges of raised objects, which were seen in part, become gaps too.

    Positions of pixels are computed once for a line on level ground of up to 4 million pixels, else twice:
    once for the extent, and once a tile. For a long line over a DEM,
    ``line = line.assign_coords(east=line.east.compute(), north=line.north.compute())`` computes them once,
    for 16 bytes a pixel.

    Average signatures over the pixels of the line: nearest resampling leaves out 15 to 40 % of them. Regions
    drawn on this map can be given to ``line.paint.signatures`` of the located line.

    References
    ----------
    .. [1] D. Schlaepfer, R. Richter, "Geo-atmospheric processing of airborne imaging spectrometry data.
       Part 1: parametric orthorectification", Int. J. Remote Sensing 23, 2609-2630 (2002).

    Examples
    --------
    A line of 3 x 3 pixels, 2 m apart, that looks down on a plane:

    >>> import numpy as np, xarray as xr
    >>> north, east = np.meshgrid([0.0, 2.0, 4.0], [10.0, 12.0, 14.0], indexing="ij")
    >>> dims, attrs = ("along_track", "cross_track"), {"units": "m"}
    >>> line = xr.Dataset({"red": (dims, np.arange(9.0).reshape(3, 3))})
    >>> line = line.assign_coords(east=(dims, east, attrs), north=(dims, north, attrs))
    >>> orthorectify(line, 2.0, grid="flight", variables="red").red.values
    array([[6., 7., 8.],
           [3., 4., 5.],
           [0., 1., 2.]])
    """
    problems = Problems("this line cannot be orthorectified", SchemaError)
    one_of(grid, _GRIDS, "grid", problems=problems)
    one_of(method, _METHODS, "method", problems=problems)
    one_of(multi_hit, RULES, "multi_hit", problems=problems)
    check_cells(problems, gsd, tile)
    problems.add_if(
        not 1.0 <= max_stretch < np.inf,
        f"max_stretch {max_stretch!r:.60}",
        expected="a number of cells from 1 on",
        code="value-out-of-range",
    )
    if bounds is not None:
        edges = np.asarray(bounds, np.float64)
        problems.add_if(
            not (edges.shape == (4,) and np.isfinite(edges).all() and (edges[:2] < edges[2:]).all()),
            f"bounds {bounds!r:.80}",
            expected="west, south, east, north [m], in this order",
            code="bounds-invalid",
        )
    problems.raise_if_any()
    if is_located(line) and location:
        options = ", ".join(f"{name}=" for name in location)
        raise SchemaError(
            f"this line is located already, so {options} would have no effect",
            mend="leave it out, or drop east and north",
            code="option-conflict",
        )
    line, names = prepared(line if is_located(line) else locate(line, **location), variables)
    lines = line_chunks(line, names)
    (east, north, *relief), crs = _positions(line, lines)
    axes = direction_of_flight(east, north) if grid == "flight" else NORTH
    survey = survey_lines(east, north, axes, progress)
    size = survey.gsd if gsd is None else float(gsd)
    SchemaError.raise_if(
        not size > 0.0,
        "the pixels have the same position, so the cell size is undefined",
        mend="give gsd= [m]",
        code="gsd-missing",
    )
    if grid == "flight":
        # the centre of the first cell lies in the corner of the covered area
        left, _, upper, _ = survey.box
        x, y = left - size / 2, upper - size / 2
        axes = replace(axes, anchor=axes.point(x, y))
        survey = replace(survey, boxes=survey.boxes - np.array([x, x, y, y]))
    box = survey.box
    if bounds is not None:
        west, south, east_end, north_end = (float(edge) for edge in bounds)
        right, down = axes.along(
            np.array([west, west, east_end, east_end]), np.array([south, north_end, south, north_end])
        )
        box = float(right.min()), float(right.max()), float(down.min()), float(down.max())
    cells = covering(axes, size, box, whole=bounds is not None)
    rows, cols = cells.shape
    count = -(-rows // tile) * -(-cols // tile)
    SchemaError.raise_if(
        count > _MAX_TILES,
        f"a map of {rows} x {cols} cells of {cells.gsd:g} m is {count} tiles of {tile} x {tile}",
        expected=f"at most {_MAX_TILES}",
        mend="give a larger gsd, bounds, or a larger tile",
        code="map-too-large",
    )
    windows = tile_windows(cells.shape, tile)
    # the areas between the ends of consecutive located lines (pair, 4, 2)
    ends = survey.ends[np.isfinite(survey.ends).all(axis=(1, 2))]
    between = np.stack([ends[:-1, 0], ends[:-1, 1], ends[1:, 1], ends[1:, 0]], axis=1)
    plan = Plan(
        cells,
        RULES.index(multi_hit),
        max_stretch * max(1.0, survey.gsd / cells.gsd),
        line.sizes[ALONG_TRACK] - 1,
        _MAX_PARALLAX_PX * survey.across,
        between,
    )
    slabs = needed_slabs(survey, cells, lines, windows)
    tiles = Tiles.of(plan, windows, slabs, (east, north, *relief), bilinear=method == "bilinear")
    rectified = _dataset(line, names, tiles, lines, crs)
    settings = {
        "gsd": cells.gsd,
        "spacing_across": survey.across,
        "spacing_along": survey.along,
        "grid": grid,
        "resampling": method,
        "multi_hit": multi_hit,
        "max_stretch": float(max_stretch),
        **swath_attrs(line, survey.across, survey.along),
    }
    rectified.attrs = {**line.attrs, **settings}
    return rectified


def line_chunks(line: xr.Dataset, names: Sequence[str] = ()) -> tuple[int, ...]:
    # Return the chunks of the cube among variables, else of the positions, along the track.
    cubes = [name for name in names if BAND in line[name].dims]
    for name in (*cubes, "east"):
        if line[name].chunks is not None:
            return tuple(line[name].variable.chunksizes[ALONG_TRACK])
    return line_slabs(line.sizes[ALONG_TRACK], CHUNK_LINES)


def _positions(line: xr.Dataset, lines: tuple[int, ...]) -> tuple[list[da.Array], str | None]:
    # Return east and north [m], over relief also heights and tangents of zenith angles; and the CRS.
    coordinates = require(line, ["east", "north"], "a map")
    if min(coordinates["east"].shape) < 2:
        count, columns = coordinates["east"].shape
        raise SchemaError(
            f"{count} lines of {columns} columns are too few for a map",
            expected="two or more of each",
            code="line-too-short",
        )
    crs = coordinates["east"].attrs.get("crs")
    # a line located on level ground has its height as an attribute
    is_level = isinstance(line.attrs.get("ground"), int | float)
    relief = []
    if not is_level and set(_RELIEF) <= set(line.variables):
        surface = require(line, _RELIEF, "a map without hidden ground")
        height, zenith = (in_slabs(surface[name], lines).astype(np.float64) for name in _RELIEF)
        relief = [height, np.tan(np.radians(zenith))]
    positions = [in_slabs(coordinate, lines).astype(np.float64) for coordinate in coordinates.values()]
    is_lazy = any(coordinate.chunks is not None for coordinate in coordinates.values())
    is_small = sum(position.nbytes for position in positions) <= _MAX_KEPT_BYTES
    # The positions of a short line are computed once, and kept in memory (eager). Over relief nothing is
    # saved: the same tasks compute the heights, which are not kept.
    if is_lazy and not relief and is_small and client_in_force() is None:
        arrays = [np.empty(position.shape) for position in positions]
        da.store(positions, arrays, lock=False)
        positions = [
            in_memory(array, f"kept-{position.name}", position.chunks)
            for array, position in zip(arrays, positions, strict=True)
        ]
    return [*positions, *relief], crs


def _dataset(
    line: xr.Dataset, names: Sequence[str], tiles: Tiles, lines: tuple[int, ...], crs: str | None
) -> xr.Dataset:
    variables = mapped(line, names, tiles, lines)
    for name in ("glt_line", "glt_sample", "nearest_line", "nearest_sample", "hits", "gap"):
        cells = tiles.gap if name == "gap" else tiles.part(name.removeprefix("glt_"), dtype_of(name))
        if name in _AXES:
            # Positions become the line or column numbers of the line, which a crop keeps. Numbers that are
            # not integers >= 0, such as those of averaged lines, identify no pixel: then positions remain.
            numbers = numbers_of(line, _AXES[name])
            is_integer = np.isfinite(numbers).all() and (numbers == np.round(numbers)).all()
            is_number = is_integer and numbers.min() >= 0.0 and numbers.max() <= np.iinfo(np.int32).max
            if is_number and not np.array_equal(numbers, np.arange(numbers.size)):
                cells = cells.map_blocks(_numbers_at, numbers, dtype=cells.dtype)
        attrs_of_index = {"empty_value": -1} if name.startswith("nearest") else {}
        cell_array = xr.DataArray(cells, dims=("y", "x"))
        variables[name] = label(cell_array, name, grid_mapping="spatial_ref", **attrs_of_index)
    band_coordinates = {
        name: line[name].variable
        for name in line.coords
        if line[name].dims == (BAND,) and any(BAND in array.dims for array in variables.values())
    }
    return xr.Dataset(variables, coords=band_coordinates).assign_coords(_coordinates(tiles, crs, line))


def _numbers_at(positions: Array, numbers: Array) -> Array:
    interpolated = np.interp(positions, np.arange(numbers.size), numbers)
    return np.where(positions >= 0, interpolated, positions).astype(positions.dtype)  # below 0 and NaN stay


def _coordinates(tiles: Tiles, crs: str | None, line: xr.Dataset) -> dict[str, Any]:
    grid = tiles.grid
    transform = " ".join(repr(float(number)) for number in grid.transform)
    attrs: dict[str, Any] = {"GeoTransform": transform}
    if crs is not None:
        has_crs = "spatial_ref" in line.variables and "crs_wkt" in line["spatial_ref"].attrs
        attrs |= line["spatial_ref"].attrs if has_crs else grid_mapping_attrs(crs_of(crs))
    coordinates: dict[str, Any] = {"spatial_ref": ((), np.int64(0), {**attrs, "GeoTransform": transform})}
    crs_attrs = {} if crs is None else {"crs": crs}
    rows, cols = grid.shape
    if grid.axes.right == (1.0, 0.0):
        east, _ = grid.centres(slice(0, 1), slice(0, cols))
        _, north = grid.centres(slice(0, rows), slice(0, 1))
        for name, values, direction in (("x", east[0], "east"), ("y", north[:, 0], "north")):
            axis = {"standard_name": f"projection_{name}_coordinate", "axis": name.upper()}
            coordinates[name] = (
                name,
                values,
                {"units": "m", **axis, "long_name": f"Map coordinate to the {direction}", **crs_attrs},
            )
        return coordinates
    # x and y would be distances from a corner, which other programs would read as map coordinates near 0, 0
    for name, lazy in zip(("east", "north"), tiles.centres(), strict=True):
        coordinates[name] = label(xr.DataArray(lazy, dims=("y", "x")), name, **crs_attrs)
    return coordinates


def map_report(made: xr.Dataset) -> dict[str, float]:
    """Return the number of cells that are covered, covered several times, or gaps (eager, a tile at a time).

    Parameters
    ----------
    made
        Result of `hyperpaint.geometry.orthorectify`.

    Returns
    -------
    dict
        Numbers of cells. ``cells``: in the whole rectangle; ``covered``: by one patch of four pixels or more;
        ``gaps``: uncovered, between the ends of the lines; ``multiple``: covered by several patches, where
        the line goes back over itself. ``most_hits``: largest number of patches over one cell.

    Raises
    ------
    SchemaError
        The dataset is not a map: it has no ``hits`` or ``gap``.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> made = xr.Dataset({"hits": (("y", "x"), np.uint16([[0, 2], [1, 0]]))})
    >>> map_report(made.assign(gap=made.hits == np.array([[0, 9], [9, 9]])))
    {'cells': 4, 'covered': 2, 'gaps': 1, 'multiple': 1, 'most_hits': 2}
    """
    missing = [name for name in ("hits", "gap") if name not in made.variables]
    SchemaError.raise_if(
        missing,
        f"not a map: {' and '.join(map(repr, missing))} missing",
        mend="orthorectify a flight line first",
        code="variable-missing",
    )
    hits, gap = made["hits"], made["gap"]
    lazy = ((hits > 0).sum(), gap.sum(), (hits > 1).sum(), hits.max())
    covered, gaps, multiple, max_hits = dask.compute(*(part.data for part in lazy))
    return {
        "cells": int(np.prod(hits.shape)),
        "covered": int(covered),
        "gaps": int(gaps),
        "multiple": int(multiple),
        "most_hits": int(max_hits),
    }


# --- plausibility of the swath -------------------------------------------------------------------------


# camera above the ground; heights above the sea differ by up to 106 m from heights above the ellipsoid
MIN_HEIGHT_M, MAX_HEIGHT_M = 5.0, 10_000.0
MIN_SWATH_M, MAX_SWATH_M = 4.0, 10_000.0  # full swath of a camera: at least two cars side by side
MAX_ASPECT = 5.0  # longer over shorter side of a pixel; frame rates are set for square pixels
WHOLE_CAMERA_COLUMNS = 200  # narrower lines are crops or examples, whose swath is not checked


def swath_attrs(line: xr.Dataset, across: float, along: float) -> dict[str, float]:
    # Return attributes of a map: ``swath``, ``height_above_ground`` [m] and ``pixel_aspect``, if known.
    #
    # Takes a located line and the median distances of its columns and lines [m]. Warns (`PaintWarning`) about
    # implausible values.
    attrs = {"swath": across * line.sizes[CROSS_TRACK], "pixel_aspect": along / across}
    ground = line.attrs.get("ground")
    if isinstance(ground, float | int) and "altitude" in line.variables:
        altitude = line["altitude"].values
        attrs["height_above_ground"] = float(np.median(altitude[np.isfinite(altitude)])) - ground
    attrs = {name: float(value) for name, value in attrs.items() if np.isfinite(value)}
    is_complete = line.sizes[CROSS_TRACK] >= WHOLE_CAMERA_COLUMNS
    texts = []
    height = attrs.get("height_above_ground", MIN_HEIGHT_M)
    if not MIN_HEIGHT_M <= height <= MAX_HEIGHT_M:
        texts.append(
            f"the camera is {height:.4g} m above the ground, expected {MIN_HEIGHT_M:g} to {MAX_HEIGHT_M:g} m "
            "(ground is above the ellipsoid, not above the sea)"
        )
    swath = attrs.get("swath", MIN_SWATH_M)
    if is_complete and not MIN_SWATH_M <= swath <= MAX_SWATH_M:
        texts.append(f"the swath is {swath:.3g} m wide, expected {MIN_SWATH_M:g} to {MAX_SWATH_M:g} m")
    aspect = attrs.get("pixel_aspect", 1.0)
    if is_complete and not 1 / MAX_ASPECT <= aspect <= MAX_ASPECT:
        texts.append(
            f"pixels are {aspect:.3g} times as long as wide, expected {1 / MAX_ASPECT:g} to {MAX_ASPECT:g}"
        )
    if texts:
        name = line.attrs.get("name", "this line")
        warn_user(f"{name}: {'; '.join(texts)}; check ground and camera", "swath-implausible")
    return attrs


def describe_swath(attrs: dict[Any, Any]) -> str:
    # Return the attributes of `swath_attrs`, and the heights and angles used, as one line of text.
    units = {"height_above_ground": "{:.1f} m above the ground", "swath": "swath {:.1f} m"}
    units["pixel_aspect"] = "pixels {:.2f} times as long as wide"
    texts = [text.format(attrs[name]) for name, text in units.items() if name in attrs]
    return ", ".join([*texts, *([attrs["location_from"]] if "location_from" in attrs else [])])
