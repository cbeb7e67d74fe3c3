"""Rasters of heights that rays are followed to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Floats
from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.kernels.rays import BLOCK

from .geodesy import crs_of

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Terrain", "TerrainGrid", "grid_of", "terrain_of"]


_EVEN = 1e-3
"""Part of a cell by which the coordinates of a raster may miss their even spacing."""


@dataclass(frozen=True)
class TerrainGrid:
    """How the cells of a raster lie on its map, and what its heights mean.

    Attributes
    ----------
    crs
        Reference system, as `hyperpaint.geometry.georeference.geodesy.crs_of` returns it.
    x, y
        Coordinate of the centre of the first cell, and step from cell to cell.
    heights
        What the raster's numbers are above.
    missing
        Numbers that stand for holes.
    """

    crs: str
    x: tuple[float, float]
    y: tuple[float, float]
    heights: Convention
    missing: tuple[float, ...]


@dataclass(frozen=True)
class Terrain:
    """A raster of heights, ready for the kernel.

    Attributes
    ----------
    grid
        Where its cells lie.
    heights : (row, col), float64
        Above the ellipsoid [m]; NaN in holes.
    tops : (block, block), float64
        Highest point of every block of `hyperpaint.kernels.rays.BLOCK` cells; minus infinity in holes.
    lowest, highest
        Of all [m].
    """

    grid: TerrainGrid
    heights: Floats
    tops: Floats
    lowest: float
    highest: float


def grid_of(dem: xr.DataArray) -> TerrainGrid:
    """Return how a raster lies, from its coordinates and attributes; its heights are not read.

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
        problems.add(f"dims ({', '.join(map(str, dem.dims))}), expected (y, x)")
    else:
        for name in ("x", "y"):
            found = _axis(dem, name)
            if isinstance(found, str):
                problems.add(found)
            else:
                axes[name] = found
    if _is_turned(dem, axes):
        problems.add(
            "it lies turned on its map, as the GeoTransform of spatial_ref says, so that x and y are no map "
            "coordinates; bring it to a grid with north up (rioxarray's reproject, or "
            "hyperpaint.orthorectify onto such a grid)"
        )
    crs = _crs_text(dem)
    if crs is None:
        problems.add("no crs; open it with rioxarray, or declare it: dem.assign_attrs(crs='EPSG:32617')")
    told = {name: dem.attrs[name] for name in ("height_reference", "geoid_undulation") if name in dem.attrs}
    heights = Convention()
    if "height_reference" not in told:
        problems.add(
            "what its heights are above is not declared; positions are above the ellipsoid, most DEMs above "
            "the geoid: dem.assign_attrs(height_reference='ellipsoid'), or height_reference='geoid' with "
            "geoid_undulation=, the height of the geoid above the ellipsoid [m]"
        )
    else:
        try:
            heights = Convention(**told)
            heights.ellipsoidal(0.0)
        except SchemaError as error:
            problems.add(str(error))
    problems.raise_if_any()
    return TerrainGrid(crs_of(crs), axes["x"], axes["y"], heights, _missing(dem))


def terrain_of(heights: npt.NDArray[Any], grid: TerrainGrid) -> Terrain:
    """Return the raster of heights (row, col), made ready for the kernel.

    Raises
    ------
    SchemaError
        It is nothing but holes.
    """
    made = np.array(heights, dtype=np.float64)
    for value in grid.missing:
        made[np.asarray(heights) == value] = np.nan
    made[~np.isfinite(made)] = np.nan
    if np.isnan(made).all():
        raise SchemaError("this DEM holds no heights, only holes")
    made = np.ascontiguousarray(grid.heights.ellipsoidal(made))
    return Terrain(grid, made, _tops(made), float(np.nanmin(made)), float(np.nanmax(made)))


def _tops(heights: Floats) -> Floats:
    filled = np.where(np.isnan(heights), -np.inf, heights)
    rows, cols = (range(0, size - 1, BLOCK) for size in filled.shape)
    # a block owns the borders it shares
    strips = [filled[r : r + BLOCK + 1].max(axis=0) for r in rows]
    return np.array([[strip[c : c + BLOCK + 1].max() for c in cols] for strip in strips])


def _axis(dem: xr.DataArray, name: str) -> tuple[float, float] | str:
    """Return the first coordinate and the step of an axis, or what is wrong with it."""
    if name not in dem.coords:
        return f"no coordinate {name!r} of the centres of its cells"
    values = dem[name].values.astype(np.float64)
    if values.size < 2:
        return f"{values.size} cells along {name!r}, expected two or more"
    step = (values[-1] - values[0]) / (values.size - 1)
    uneven = np.abs(values - (values[0] + step * np.arange(values.size)))
    if not (np.isfinite(step) and step != 0.0 and uneven.max() <= _EVEN * abs(step)):
        return f"coordinate {name!r} is not evenly spaced; bring the DEM to a regular grid"
    return float(values[0]), float(step)


def _is_turned(dem: xr.DataArray, axes: Mapping[str, tuple[float, float]]) -> bool:
    """Tell whether a raster, by its GeoTransform, has rows that do not run east or west.

    That of a part of a raster may be stale, so that nothing but directions are taken from it.
    """
    try:
        numbers = [float(part) for part in str(_mapping_attrs(dem).get("GeoTransform", "")).split()]
    except ValueError:
        return False
    if len(numbers) != 6:
        return False
    _, right, right_by_row, _, up_by_column, _ = numbers
    # of a flight to the south: distances from a corner grow to the west
    return bool(right_by_row or up_by_column) or (right < 0.0 < axes.get("x", (0.0, 0.0))[1])


def _mapping_attrs(dem: xr.DataArray) -> Mapping[Any, Any]:
    mapping = dem.attrs.get("grid_mapping", dem.encoding.get("grid_mapping", "spatial_ref"))
    return dem.coords[mapping].attrs if mapping in dem.coords else {}


def _crs_text(dem: xr.DataArray) -> str | None:
    """Return the crs that a raster declares, as rioxarray or by hand."""
    for attrs in (dem.attrs, _mapping_attrs(dem)):
        for name in ("crs", "crs_wkt", "spatial_ref"):
            if attrs.get(name):
                return str(attrs[name])
    return None


def _missing(dem: xr.DataArray) -> tuple[float, ...]:
    # of what xarray has decoded, with the mark in `encoding`, holes are NaN already
    told = [dem.attrs[name] for name in ("_FillValue", "missing_value", "nodata") if name in dem.attrs]
    return tuple({float(value) for value in told if np.ndim(value) == 0 and np.isfinite(float(value))})
