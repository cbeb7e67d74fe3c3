"""Orthorectification: a flight line as a map."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, Literal

import dask
import dask.array as da
import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Array, Progress
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.facts import documented
from hyperpaint.base.schema import (
    ALONG_TRACK,
    BAND,
    CHUNK_LINES,
    CROSS_TRACK,
    dtype_of,
    label,
    numbers_of,
    require,
)
from hyperpaint.base.units import takes_quantities
from hyperpaint.geometry.georeference import LOCATION_UNITS, locate
from hyperpaint.geometry.georeference.geodesy import crs_of, grid_mapping_attrs
from hyperpaint.geometry.georeference.locating import is_located, line_slabs
from hyperpaint.io.store.computing import client_in_force

from .grids import MapGrid, Survey, box_of, covering, direction_of_flight, north_axes, survey_lines
from .indexing import RULES, Plan, areas_between, needed_slabs
from .plausibility import swath_attrs
from .tiling import Tiles, in_memory, in_slabs, mapped, prepared, tile_windows

_GRIDS = ("north", "flight")
_METHODS = ("nearest", "bilinear")
_RELIEF = ("ground_height", "view_zenith")
# dim of the flight line along which a position counts
_AXES = {
    "glt_line": ALONG_TRACK,
    "nearest_line": ALONG_TRACK,
    "glt_sample": CROSS_TRACK,
    "nearest_sample": CROSS_TRACK,
}
# Shift of neighbouring pixels by their heights beyond which ground between them is hidden [spacing across].
# On a wall that the camera sees it is 1, whatever its height. With 1.25 a sixth of the hidden cells behind
# cars is shown; with 0.6 no fewer than with 1.05, and more visible ground is lost (support/hidden_ground.py).
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
    """Return a flight line as a map of square cells, with the place of every cell in the line.

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
        between four pixels, is NaN where one of them is, and joins their flags; directions, times and values
        per line or column are those of the nearest pixel.
    multi_hit
        Choice where several places of the line show one cell: the place nearest to the middle column
        (``"nadir"``), or the first or last in time. Spectra are never averaged.
    max_stretch
        Four neighbouring pixels with an edge longer than this many cells, or pixel spacings where these are
        larger, are a gap, and nothing is drawn between them: two lost frames are bridged, three are not.
    tile
    bounds
        West, south, east, north of the part wanted, in the line's crs [m]; by default all of the line.
    progress
    **location

    Returns
    -------
    xarray.Dataset
        The variables on (y, x[, band]), all lazy, and ``glt_line`` and ``glt_sample``: the place of every
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
        Options that do not exist or fit; no pixel is placed on the ground; variables are missing; all
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
    _check(gsd, grid, method, multi_hit, max_stretch, tile, bounds)
    if is_located(line) and location:
        options = ", ".join(f"{name}=" for name in location)
        raise SchemaError(
            f"this line is located already, so {options} would have no effect",
            mend="leave it out, or drop east and north",
            code="option-conflict",
        )
    line, names = prepared(line if is_located(line) else locate(line, **location), variables)
    lines = _line_chunks(line, names)
    (east, north, *relief), crs = _places(line, lines)
    survey, cells = _planned(east, north, gsd, grid, bounds, progress)
    rows, cols = cells.shape
    count = -(-rows // tile) * -(-cols // tile)
    if count > _MAX_TILES:
        raise SchemaError(
            f"a map of {rows} x {cols} cells of {cells.gsd:g} m is {count} tiles of {tile} x {tile}",
            expected=f"at most {_MAX_TILES}",
            mend="give a larger gsd, bounds, or a larger tile",
            code="map-too-large",
        )
    windows = tile_windows(cells.shape, tile)
    stretch = max_stretch * max(1.0, survey.gsd / cells.gsd)
    last = line.sizes[ALONG_TRACK] - 1
    parallax = _MAX_PARALLAX_PX * survey.across
    plan = Plan(cells, RULES.index(multi_hit), stretch, last, parallax, areas_between(survey))
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


def _check(
    gsd: Any, grid: Any, method: Any, multi_hit: Any, max_stretch: Any, tile: Any, bounds: Any
) -> None:
    problems = Problems("this line cannot be orthorectified", SchemaError)
    for name, value, choices in (
        ("grid", grid, _GRIDS),
        ("method", method, _METHODS),
        ("multi_hit", multi_hit, RULES),
    ):
        if value not in choices:
            problems.add(
                f"{name} {value!r:.60}", expected=" or ".join(map(repr, choices)), code="choice-unknown"
            )
    if gsd is not None and not (np.ndim(gsd) == 0 and 0.0 < gsd < np.inf):
        problems.add(f"gsd {gsd!r:.60}", expected="a length above 0 [m]", code="value-out-of-range")
    if not 1.0 <= max_stretch < np.inf:
        problems.add(
            f"max_stretch {max_stretch!r:.60}",
            expected="a number of cells from 1 on",
            code="value-out-of-range",
        )
    if not (isinstance(tile, int | np.integer) and tile > 0):
        problems.add(
            f"tile {tile!r:.60}", expected="a whole number of cells above 0", code="value-out-of-range"
        )
    if bounds is not None:
        edges = np.asarray(bounds, np.float64)
        is_valid = (
            edges.shape == (4,) and np.isfinite(edges).all() and edges[0] < edges[2] and edges[1] < edges[3]
        )
        if not is_valid:
            problems.add(
                f"bounds {bounds!r:.80}",
                expected="west, south, east, north [m], in this order",
                code="bounds-invalid",
            )
    problems.raise_if_any()


def _line_chunks(line: xr.Dataset, names: Sequence[str]) -> tuple[int, ...]:
    # as the cube is chunked, else the positions
    cubes = [name for name in names if BAND in line[name].dims]
    for name in (*cubes, "east"):
        if line[name].chunks is not None:
            return tuple(line[name].variable.chunksizes[ALONG_TRACK])
    return line_slabs(line.sizes[ALONG_TRACK], CHUNK_LINES)


def _places(line: xr.Dataset, lines: tuple[int, ...]) -> tuple[list[da.Array], str | None]:
    # east and north [m], over relief also heights and tangents of zenith angles; the CRS
    coordinates = require(line, ["east", "north"], "a map")
    if min(coordinates["east"].shape) < 2:
        count, columns = coordinates["east"].shape
        raise SchemaError(
            f"{count} lines of {columns} columns make no map",
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
    places = [in_slabs(each, lines).astype(np.float64) for each in coordinates.values()]
    is_lazy = any(each.chunks is not None for each in coordinates.values())
    # over relief, heights are computed in the same tasks and would be computed again anyway
    return [*(_kept(places) if is_lazy and not relief else places), *relief], crs


def _kept(places: list[da.Array]) -> list[da.Array]:
    # a line short enough to trace its rays once (eager)
    if sum(place.nbytes for place in places) > _MAX_KEPT_BYTES or client_in_force() is not None:
        return places
    arrays = [np.empty(place.shape) for place in places]
    da.store(places, arrays, lock=False)
    names = (f"kept-{place.name}" for place in places)
    return [
        in_memory(*each, place.chunks)
        for each, place in zip(zip(arrays, names, strict=True), places, strict=True)
    ]


def _planned(
    east: da.Array, north: da.Array, gsd: float | None, kind: str, bounds: Any, progress: Progress | None
) -> tuple[Survey, MapGrid]:
    axes = direction_of_flight(east, north) if kind == "flight" else north_axes()
    survey = survey_lines(east, north, axes, progress)
    size = survey.gsd if gsd is None else float(gsd)
    if not size > 0.0:
        raise SchemaError(
            "the pixels lie upon one another and give no cell size", mend="give gsd= [m]", code="gsd-missing"
        )
    if kind == "flight":
        # the centre of the first cell lies in the corner of the covered area
        left, _, upper, _ = survey.box
        x, y = left - size / 2, upper - size / 2
        axes = axes.moved(x, y)
        survey = replace(survey, boxes=survey.boxes - np.array([x, x, y, y]))
    box = survey.box if bounds is None else box_of(axes, bounds)
    return survey, covering(axes, size, box, whole=bounds is not None)


def _dataset(
    line: xr.Dataset, names: Sequence[str], tiles: Tiles, lines: tuple[int, ...], crs: str | None
) -> xr.Dataset:
    variables = mapped(line, names, tiles, lines)
    for name in ("glt_line", "glt_sample", "nearest_line", "nearest_sample", "hits", "gap"):
        part = tiles.gap if name == "gap" else tiles.part(name.removeprefix("glt_"), dtype_of(name))
        if name in _AXES:
            part = _numbered(part, line, _AXES[name])
        extra = {"empty_value": -1} if name.startswith("nearest") else {}
        of_cells = xr.DataArray(part, dims=("y", "x"))
        variables[name] = label(of_cells, name, grid_mapping="spatial_ref", **extra)
    of_bands = {
        name: line[name].variable
        for name in line.coords
        if line[name].dims == (BAND,) and any(BAND in array.dims for array in variables.values())
    }
    return xr.Dataset(variables, coords=of_bands).assign_coords(_coordinates(tiles, crs, line))


def _numbered(positions: da.Array, line: xr.Dataset, dim: str) -> da.Array:
    # the line's own line or column numbers, which a crop keeps; numbers other than integers from 0 on, such
    # as those of averaged lines, name no pixel: positions stay
    numbers = numbers_of(line, dim)
    counted = np.arange(numbers.size)
    is_whole = np.isfinite(numbers).all() and (numbers == np.round(numbers)).all() and numbers.min() >= 0.0
    if not is_whole or numbers.max() > np.iinfo(np.int32).max or np.array_equal(numbers, counted):
        return positions
    return positions.map_blocks(_numbers_at, numbers, dtype=positions.dtype)


def _numbers_at(positions: Array, numbers: Array) -> Array:
    at = np.interp(positions, np.arange(numbers.size), numbers)
    return np.where(positions >= 0, at, positions).astype(positions.dtype)  # below 0 and NaN stay


def _coordinates(tiles: Tiles, crs: str | None, line: xr.Dataset) -> dict[str, Any]:
    grid = tiles.grid
    transform = " ".join(repr(float(number)) for number in grid.transform)
    attrs: dict[str, Any] = {"GeoTransform": transform}
    if crs is not None:
        stands = "spatial_ref" in line.variables and "crs_wkt" in line["spatial_ref"].attrs
        attrs |= line["spatial_ref"].attrs if stands else grid_mapping_attrs(crs_of(crs))
    coordinates: dict[str, Any] = {"spatial_ref": ((), np.int64(0), {**attrs, "GeoTransform": transform})}
    named = {} if crs is None else {"crs": crs}
    rows, cols = grid.shape
    if grid.axes.right == (1.0, 0.0):
        east, _ = grid.centres(slice(0, 1), slice(0, cols))
        _, north = grid.centres(slice(0, rows), slice(0, 1))
        for name, values, towards in (("x", east[0], "east"), ("y", north[:, 0], "north")):
            axis = {"standard_name": f"projection_{name}_coordinate", "axis": name.upper()}
            meaning = f"Map coordinate to the {towards}"
            coordinates[name] = (name, values, {"units": "m", **axis, "long_name": meaning, **named})
        return coordinates
    # distances from a corner as x and y: with a crs beside them, programs see the Gulf of Guinea
    for name, lazy in zip(("east", "north"), tiles.centres(), strict=True):
        coordinates[name] = label(xr.DataArray(lazy, dims=("y", "x")), name, **named)
    return coordinates


def map_report(made: xr.Dataset) -> dict[str, float]:
    """Return the number of cells that are covered, covered several times, or gaps (eager, a tile at a time).

    Parameters
    ----------
    made
        What `hyperpaint.geometry.orthorectify` has returned.

    Returns
    -------
    dict
        Numbers of cells. ``cells``: in the whole rectangle; ``covered``: by one patch of four pixels or more;
        ``gaps``: uncovered, between the ends of the lines; ``multiple``: covered by several patches, where
        the line goes back over itself. ``most_hits``: largest number of patches over one cell.

    Raises
    ------
    SchemaError
        This is no map: it has no ``hits`` or ``gap``.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> made = xr.Dataset({"hits": (("y", "x"), np.uint16([[0, 2], [1, 0]]))})
    >>> map_report(made.assign(gap=made.hits == np.array([[0, 9], [9, 9]])))
    {'cells': 4, 'covered': 2, 'gaps': 1, 'multiple': 1, 'most_hits': 2}
    """
    missing = [name for name in ("hits", "gap") if name not in made.variables]
    if missing:
        raise SchemaError(
            f"this is no map: {' and '.join(map(repr, missing))} missing",
            mend="orthorectify a flight line first",
            code="variable-missing",
        )
    hits, gap = made["hits"], made["gap"]
    lazy = ((hits > 0).sum(), gap.sum(), (hits > 1).sum(), hits.max())
    covered, gaps, multiple, most = dask.compute(*(part.data for part in lazy))
    return {
        "cells": int(np.prod(hits.shape)),
        "covered": int(covered),
        "gaps": int(gaps),
        "multiple": int(multiple),
        "most_hits": int(most),
    }
