"""Cells of a map as pixels of the flight line that they show.

Nearest resampling repeats some pixels and leaves others out; statistics count every pixel once.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from typing import NamedTuple

import dask
import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Ints
from hyperpaint.base.errors import MissingExtraError, SchemaError
from hyperpaint.base.schema import ALONG_TRACK, CROSS_TRACK
from hyperpaint.geometry.georeference.geodesy import between_maps, crs_of
from hyperpaint.regions.pixels_in_regions import Pixels, lines_of_cells

_PLACES = ("nearest_line", "nearest_sample", "glt_line", "glt_sample")


class Shown(NamedTuple):
    """Pixels of a region: their cells, and their positions in the flight line."""

    cells: Pixels
    pixels: Pixels
    #: (pixel,): number of the flight line; of a map of several alone
    lines: Ints | None = None

    @property
    def size(self) -> int:
        """Number of pixels."""
        return int(self.cells[0].size)


def shown_pixels(line: xr.Dataset, places: Sequence[Pixels]) -> list[Shown]:
    """Return the pixels in regions, each once, from the cells of a map that lie in them (eager).

    ``line`` is a flight line or a map, its dims named by role; ``places`` are positions in it, by region. A
    pixel shown by several cells belongs to the region of the cell nearest to its centre, and is read there.
    Empty cells are no pixels. Positions in a flight line, or in a map without indices of its pixels, are
    returned unchanged.
    """
    if not set(_PLACES) <= set(line.variables):
        return [Shown(place, place) for place in places]
    # largest distance of the cell nearest to the centre of a pixel
    attrs = {"spacing_across": 1.0, "spacing_along": 1.0, "gsd": 1.0, **line.attrs}
    reach = 1 + math.ceil(max(attrs["spacing_across"], attrs["spacing_along"]) / attrs["gsd"])
    windows = [_window(place, reach) for place in places]
    names = [*_PLACES, *(["flightline"] if lines_of_cells(line) else [])]
    planes = [line[name].reset_coords(drop=True).transpose(ALONG_TRACK, CROSS_TRACK) for name in names]
    # computed together: cells shared by regions are read once
    tables = dask.compute(*([plane.isel(window).data for plane in planes] for window in windows))
    return [
        _once(place, window, *table) for place, window, table in zip(places, windows, tables, strict=True)
    ]


def _window(place: Pixels, reach: int) -> dict[str, slice]:
    if not place[0].size:
        return {ALONG_TRACK: slice(0, 0), CROSS_TRACK: slice(0, 0)}
    return {
        dim: slice(max(0, int(axis.min()) - reach), int(axis.max()) + reach + 1)
        for dim, axis in zip((ALONG_TRACK, CROSS_TRACK), place, strict=True)
    }


def _once(
    place: Pixels,
    window: dict[str, slice],
    line: np.ndarray,
    sample: np.ndarray,
    at_line: np.ndarray,
    at_sample: np.ndarray,
    of_line: np.ndarray | None = None,
) -> Shown:
    # Every pixel once, from the cells of a window (row, col) that lie in a region.
    # In a map of several flight lines, the same line and column are a different pixel of each flight line.
    corner = window[ALONG_TRACK].start, window[CROSS_TRACK].start
    inside = np.zeros(line.shape, bool)
    inside[place[0] - corner[0], place[1] - corner[1]] = True
    row, col = np.nonzero(line >= 0)
    along, across = line[row, col].astype(np.int64), sample[row, col].astype(np.int64)
    away = np.hypot(at_line[row, col] - along, at_sample[row, col] - across)
    # pixels in the order of the flight line, of each the nearest cell first
    keys = [across, along] if of_line is None else [across, along, of_line[row, col].astype(np.int64)]
    order = np.lexsort((away, *keys))
    pixel = np.stack([key[order] for key in keys])
    first = np.r_[True, (np.diff(pixel, axis=1) != 0).any(axis=0)] if order.size else np.zeros(0, bool)
    nearest = order[first]
    nearest = nearest[inside[row[nearest], col[nearest]]]
    cells = row[nearest] + corner[0], col[nearest] + corner[1]
    return Shown(cells, (along[nearest], across[nearest]), None if of_line is None else keys[2][nearest])


def middle_of_map(line: xr.Dataset) -> tuple[float, float] | None:
    """Return latitude and longitude of the middle of a map [degree]; None for a flight line, or unknown."""
    mapping = line["spatial_ref"].attrs if "spatial_ref" in line.variables else {}
    axes = [line.variables.get(name) for name in ("x", "y")]
    wkt = mapping.get("crs_wkt") or mapping.get("spatial_ref")
    if wkt is None or "GeoTransform" not in mapping:
        return None
    if all(axis is not None and axis.ndim == 1 for axis in axes):
        middle = [float(np.mean(axis.values)) for axis in axes if axis is not None]
    else:
        a, b, c, d, e, f = map(float, str(mapping["GeoTransform"]).split())
        col, row = line.sizes[CROSS_TRACK] / 2, line.sizes[ALONG_TRACK] / 2
        middle = [a + b * col + c * row, d + e * col + f * row]
    # only the position of the sun depends on it, which is then unknown
    with contextlib.suppress(MissingExtraError, SchemaError):
        ((longitude, latitude),) = between_maps(np.array([middle]), crs_of(wkt), "EPSG:4326").tolist()
        return latitude, longitude
    return None
