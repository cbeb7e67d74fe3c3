"""Height rasters (DEM) that rays are intersected with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Array, Floats
from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.io.files.reading import numbers
from hyperpaint.kernels.arguments import BLOCK

from .geodesy import crs_of

_MAX_UNEVENNESS_CELLS = 1e-3  # deviation of a raster's coordinates from even spacing


@dataclass(frozen=True)
class TerrainGrid:
    """Grid of a height raster, and the reference of its heights."""

    crs: str  #: Reference system, as `hyperpaint.geometry.georeference.geodesy.crs_of` returns it
    x: tuple[float, float]  #: Coordinate of the centre of the first cell, and step from cell to cell
    y: tuple[float, float]
    heights: Convention  #: Height reference of the raster
    missing: tuple[float, ...]  #: Numbers that mark holes


@dataclass(frozen=True)
class Terrain:
    """A height raster, prepared for the kernel."""

    grid: TerrainGrid  #: Position of its cells
    heights: Floats  #: (row, col) float64: above the ellipsoid [m]; NaN in holes
    #: (block, block) float64: highest point of every block of `hyperpaint.kernels.arguments.BLOCK` cells;
    #: minus infinity in holes
    block_max: Floats
    lowest: float  #: Lowest height of the raster [m]
    highest: float


def grid_of(dem: xr.DataArray) -> TerrainGrid:
    """Return the grid of a raster from its coordinates and attributes; its heights are not read.

    Raises
    ------
    SchemaError
        Other dims than (y, x), fewer than two cells, coordinates that are missing or uneven, a grid that is
        turned, no crs, or ``height_reference`` that is not declared; all are listed.
    MissingExtraError
        pyproj is not installed.
    """
    problems = Problems("this DEM cannot be used", SchemaError)
    dem = dem.squeeze(drop=True) if dem.ndim > 2 else dem
    axes: dict[str, tuple[float, float]] = {}
    if set(dem.dims) != {"y", "x"}:
        problems.add(f"dims ({', '.join(map(str, dem.dims))})", expected="(y, x)", code="dim-missing")
    else:
        for name in ("x", "y"):
            try:
                axes[name] = _axis(dem, name)
            except SchemaError as error:
                problems.add_error("grid", error)
    mapping = dem.attrs.get("grid_mapping", dem.encoding.get("grid_mapping", "spatial_ref"))
    mapping_attrs = dem.coords[mapping].attrs if mapping in dem.coords else {}
    # the origin of a GeoTransform may be stale in a cropped raster, so only directions are used; on the grid
    # of a flight to the south, x increases to the west
    steps = numbers(str(mapping_attrs.get("GeoTransform", "")).split()) or []
    if len(steps) == 6 and (steps[2] or steps[4] or steps[1] < 0.0 < axes.get("x", (0.0, 0.0))[1]):
        problems.add(
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
    if not crs_texts:
        problems.add(
            "no crs",
            mend="open it with rioxarray, or declare it: dem.assign_attrs(crs='EPSG:32617')",
            code="crs-missing",
        )
    declared = {
        name: dem.attrs[name] for name in ("height_reference", "geoid_undulation") if name in dem.attrs
    }
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
    # where xarray decoded the raster (fill value in `encoding`), holes are already NaN
    hole_marks = [dem.attrs[name] for name in ("_FillValue", "missing_value", "nodata") if name in dem.attrs]
    holes = {float(mark) for mark in hole_marks if np.ndim(mark) == 0 and np.isfinite(float(mark))}
    return TerrainGrid(crs_of(crs_texts[0]), axes["x"], axes["y"], heights, tuple(holes))


def terrain_of(heights: Array, grid: TerrainGrid) -> Terrain:
    """Return a raster of heights (row, col), prepared for the kernel.

    Raises
    ------
    SchemaError
        All cells are holes.
    """
    elevation = np.array(heights, dtype=np.float64)
    for value in grid.missing:
        elevation[np.asarray(heights) == value] = np.nan
    elevation[~np.isfinite(elevation)] = np.nan
    if np.isnan(elevation).all():
        raise SchemaError("this DEM contains only holes", code="dem-empty")
    elevation = np.ascontiguousarray(grid.heights.ellipsoidal(elevation))
    # highest point of every block of cells; neighbouring blocks share a border
    filled = np.where(np.isnan(elevation), -np.inf, elevation)
    rows, cols = (range(0, size - 1, BLOCK) for size in filled.shape)
    strips = [filled[r : r + BLOCK + 1].max(axis=0) for r in rows]
    block_max = np.array([[strip[c : c + BLOCK + 1].max() for c in cols] for strip in strips])
    return Terrain(grid, elevation, block_max, float(np.nanmin(elevation)), float(np.nanmax(elevation)))


def _axis(dem: xr.DataArray, name: str) -> tuple[float, float]:
    # Return the first coordinate and the step.
    if name not in dem.coords:
        raise SchemaError(f"no coordinate {name!r} of cell centres", code="variable-missing")
    values = dem[name].values.astype(np.float64)
    if values.size < 2:
        raise SchemaError(
            f"{values.size} cells along {name!r}", expected="two or more", code="length-mismatch"
        )
    step = (values[-1] - values[0]) / (values.size - 1)
    deviation = np.abs(values - (values[0] + step * np.arange(values.size)))
    if not (np.isfinite(step) and step != 0.0 and deviation.max() <= _MAX_UNEVENNESS_CELLS * abs(step)):
        raise SchemaError(
            f"coordinate {name!r} is not evenly spaced",
            mend="bring the DEM to a regular grid",
            code="grid-uneven",
        )
    return float(values[0]), float(step)
