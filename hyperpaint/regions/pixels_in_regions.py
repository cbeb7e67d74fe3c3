"""Pixels of a flight line inside regions, by an exact test of points in a polygon.

A point on an edge is inside. The sign of a cross product tells on which side of an edge a point lies. Where
its float64 value is within its rounding error bound [1]_, it is computed again in rational numbers. shapely
is not used: GEOS takes points very close to an edge for points on it (tests/regions/test_regions.py, corners
divided by three).

References
----------
.. [1] J. R. Shewchuk, "Adaptive Precision Floating-Point Arithmetic and Fast Robust Geometric Predicates",
   Discrete Comput. Geom. 18, 305-363 (1997), section 4.1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from fractions import Fraction
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base import schema
from hyperpaint.base.arrays import Bools, Floats, Ints
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.schema import ALONG_TRACK, CROSS_TRACK, numbers_of
from hyperpaint.geometry.georeference.geodesy import between_maps, crs_of
from hyperpaint.geometry.georeference.locating import POSE, locate

from .geojson import Region, Regions, regions_from

Index = npt.NDArray[np.intp]

_EPSILON = 2.0**-53
_ROUNDING = (3.0 + 16.0 * _EPSILON) * _EPSILON
_TINIEST = float(np.finfo(np.float64).tiny)

#: Maximum mean number of edges whose y range contains the y of a pixel: few for an outline, thousands for a
#: zigzag.
MAX_EDGES_PER_PIXEL = 100
#: Number of comparisons of an edge with a point below which no polygon is refused.
FREE_COMPARISONS = 10_000_000

RegionsT = TypeVar("RegionsT", bound=Regions)
#: Positions along and across the track, line by line.
Pixels = tuple[Ints, Ints]

#: Number of pixels that are tested together.
_BLOCK_PIXELS = 2**20

#: Pairs of variables that hold x and y of the pixels on the ground.
_GROUND = (("east", "north"), ("easting", "northing"), ("longitude", "latitude"), ("lon", "lat"), ("x", "y"))
_GEOGRAPHIC = ("longitude", "lon")
_GEOGRAPHIC_CRS = "EPSG:4326"
#: Variables of a map: column and line of the pixel that a cell shows; -1 in empty cells.
_SOURCE_PIXEL = ("nearest_sample", "nearest_line")
#: Variable of a map of several flight lines: the flight line that a cell shows.
_SOURCE_LINE = "flightline"


def pixels(
    region: Region, line: xr.Dataset, *, coordinates: str = "sensor", crs: str | None = None
) -> Pixels:
    """Return the pixels of a flight line that lie in a region.

    Parameters
    ----------
    region
        A polygon.
    line
        A flight line, or a map. Coordinates of a map need the place of every pixel on the ground, as
        ``longitude`` and ``latitude``, ``east`` and ``north`` (along_track, cross_track), or ``x`` and ``y``
        of a map; a line with poses and the attribute ``ground`` only is located first. Sensor coordinates in
        a map are the coordinates of the pixels that its cells show (``nearest_line`` and ``nearest_sample``,
        where present); in a map of several flight lines, of the region's own flight line.
    coordinates, crs
        Coordinate system of the region, see `Regions`.

    Returns
    -------
    along_track, cross_track : (pixel,), int64
        Positions, line by line; rows and columns of a map. A pixel belongs to the region where its centre
        lies in the polygon or on its edge.

    Raises
    ------
    SchemaError
        The line has no along_track and cross_track; it has no place of its pixels in the region's reference
        system; a region in sensor coordinates names none of a map's several flight lines; or the polygon has
        too many long edges.

    Examples
    --------
    >>> import xarray as xr
    >>> line = xr.Dataset({"quality": (("along_track", "cross_track"), np.zeros((9, 9), "u2"))})
    >>> along, across = pixels(Region("corner", [(0, 0), (1.5, 0), (0, 1.5)]), line)
    >>> along.tolist(), across.tolist()
    ([0, 0, 1], [0, 1, 0])
    """
    return pixels_of(Regions((region,), coordinates, crs), line)[0]


def region_mask(regions: Any, line: xr.Dataset) -> xr.DataArray:
    """Return the region of every pixel of a flight line.

    Parameters
    ----------
    regions
        See `regions_from`.
    line
        See `pixels`.

    Returns
    -------
    (along_track, cross_track), of a map (y, x), int16
        Position of the region among ``regions``, the later one where several overlap; -1 elsewhere. The
        attributes ``flag_values`` and ``flag_meanings`` name them.

    Raises
    ------
    FormatError, SchemaError
        As `regions_from` and `pixels`.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> from hyperpaint.regions import Region
    >>> line = xr.Dataset({"counts": (("along_track", "band", "cross_track"), np.zeros((3, 2, 4)))})
    >>> left = Region("left", [(-0.5, -0.5), (1.5, -0.5), (1.5, 1.5), (-0.5, 1.5)])
    >>> region_mask([left], line).values
    array([[ 0,  0, -1, -1],
           [ 0,  0, -1, -1],
           [-1, -1, -1, -1]], dtype=int16)
    """
    region_list = regions_from(regions)
    dims = "yx" if {"y", "x"} <= set(line.dims) else (ALONG_TRACK, CROSS_TRACK)
    line = schema.rename_to_roles(line)
    region_pixels = pixels_of(region_list, line)
    mask = np.full((line.sizes[ALONG_TRACK], line.sizes[CROSS_TRACK]), -1, np.int16)
    for number, positions in enumerate(region_pixels):
        mask[positions] = number
    attrs = {
        "long_name": "Region that a pixel lies in",
        "flag_values": np.arange(-1, len(region_list), dtype=np.int16),
        "flag_meanings": " ".join(["none", *(name.replace(" ", "_") for name in region_list.names)]),
    }
    return xr.DataArray(mask, dims=tuple(dims), name="region", attrs=attrs)


def pixels_of(regions: Regions, line: xr.Dataset) -> list[Pixels]:
    """Return the pixels of every region; see `pixels`.

    Regions in sensor coordinates read nothing; for regions on a map the ground coordinates of the pixels are
    read once, in blocks of lines.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> from hyperpaint.regions import Region, Regions
    >>> line = xr.Dataset({"counts": (("along_track", "band", "cross_track"), np.zeros((3, 2, 4)))})
    >>> left = Region("left", [(-0.5, -0.5), (1.5, -0.5), (1.5, 1.5), (-0.5, 1.5)])
    >>> ((lines, columns),) = pixels_of(Regions((left,)), line)
    >>> lines, columns
    (array([0, 0, 1, 1]), array([0, 1, 0, 1]))
    """
    line = schema.rename_to_roles(line)
    problems = Problems("pixels of regions cannot be found in this line", SchemaError)
    for dim in (ALONG_TRACK, CROSS_TRACK):
        problems.add_if(
            dim not in line.dims,
            f"dims {', '.join(map(str, line.dims))}",
            expected=f"the dim {dim!r}",
            mend=f"select with isel({dim}=[5]) to keep it, or name it with dims=",
            code="dim-missing",
        )
    problems.raise_if_any()
    shape = line.sizes[ALONG_TRACK], line.sizes[CROSS_TRACK]
    if regions.coordinates == "map":
        line = located_for(regions, line)
        x, y, crs = ground_of(line, regions.crs)
        if crs is not None and regions.crs is not None:
            regions = _transformed(regions, crs)
        return _by_coordinates(regions, x, y, shape)
    if set(_SOURCE_PIXEL) <= set(line.variables):
        # a cell of a map has the sensor coordinates of the pixel that it shows
        across, along = (line[name].reset_coords(drop=True) for name in _SOURCE_PIXEL)
        coordinates = across.where(across >= 0), along.where(along >= 0)
        names = lines_of_cells(line)
        if not names:
            return _by_coordinates(regions, *coordinates, shape)
        # number of the flight line of every region
        problems = Problems(
            "pixels of regions cannot be found in this map of several flight lines", SchemaError
        )
        lines = [region.flightline.replace(" ", "_") for region in regions]
        for region, name in zip(regions, lines, strict=True):
            if name not in names:
                source = f"is of flight line {region.flightline!r}" if name else "names no flight line"
                problems.add(
                    f"region {region.name!r} in sensor coordinates {source}",
                    expected=f"one of {', '.join(names)}",
                    mend="give it the property flightline, or draw it in map coordinates",
                    code="flightline-unknown",
                )
        problems.raise_if_any()
        return _by_coordinates(
            regions, *coordinates, shape, (line[_SOURCE_LINE], [names[name] for name in lines])
        )
    columns, rows = numbers_of(line, CROSS_TRACK), numbers_of(line, ALONG_TRACK)
    return [_on_axes(region, columns, rows) for region in regions]


def lines_of_cells(line: xr.Dataset) -> dict[str, int]:
    # Return the numbers of the flight lines in a map by name; empty for a map of one line.
    if _SOURCE_LINE not in line.variables or set(line[_SOURCE_LINE].dims) != {ALONG_TRACK, CROSS_TRACK}:
        return {}
    attrs = line[_SOURCE_LINE].attrs
    numbers = np.atleast_1d(attrs.get("flag_values", ())).astype(int).tolist()
    names = dict(zip(str(attrs.get("flag_meanings", "")).split(), numbers, strict=False))
    return names if len(names) > 1 else {}


def located_for(regions: Regions, line: xr.Dataset) -> xr.Dataset:
    # Return a flight line with ground coordinates for regions on a map; it is located if it has only poses.
    #
    # Raises `SchemaError`: the height of the ground is unknown; or as `hyperpaint.geometry.locate`.
    renamed = schema.rename_to_roles(line)
    is_placed = any(_has_pair(renamed, pair) for pair in _GROUND)
    if regions.coordinates != "map" or is_placed or not set(POSE) <= set(renamed.variables):
        return line
    if not isinstance(renamed.attrs.get("ground"), int | float):
        raise SchemaError(
            "the flight line has no height of the ground to locate regions in map coordinates",
            mend="pass the height above the ellipsoid: locate(line, ground=...) or dem=, or the attribute "
            "ground [m] of the line",
            option="give --ground or --dem, or [geometry] ground in collect.toml and process again",
            code="ground-height-missing",
        )
    return locate(renamed)


def renumbered(regions: RegionsT, line: xr.Dataset, *, back: bool = False) -> RegionsT:
    # Return regions with array positions changed to index coordinates of the line; ``back`` reverses it.
    numbers = [numbers_of(line, dim) for dim in (CROSS_TRACK, ALONG_TRACK)]
    first = np.array([values[0] for values in numbers])
    step = np.array([(values[-1] - values[0]) / max(values.size - 1, 1) or 1.0 for values in numbers])
    return (
        regions
        if not first.any() and (step == 1.0).all()
        else _with_rings(
            regions, lambda ring: np.asarray((ring - first) / step if back else ring * step + first)
        )
    )


def _with_rings(regions: RegionsT, move: Callable[[Floats], Floats], **changes: Any) -> RegionsT:
    members = (
        replace(region, polygon=move(region.polygon), holes=tuple(move(hole) for hole in region.holes))
        for region in regions
    )
    return replace(regions, regions=tuple(members), **changes)


def _by_coordinates(
    regions: Regions,
    x: xr.DataArray,
    y: xr.DataArray,
    shape: tuple[int, int],
    sources: tuple[xr.DataArray, Sequence[int]] | None = None,
) -> list[Pixels]:
    # Pixels of every region, from x and y of all pixels, in blocks of lines.
    # `sources`, for a map of several flight lines: the flight line numbers of its cells, and of the regions.
    if x.dims == (CROSS_TRACK,) and y.dims == (ALONG_TRACK,):
        return [_on_axes(region, x.values.astype(float), y.values.astype(float)) for region in regions]
    blocks: list[list[Pixels]] = [[] for _ in regions]
    for lines in _blocks(*shape):
        block_x, block_y, *numbers = (
            _values(axis, lines, shape[1]) for axis in (x, y, *([] if sources is None else sources[:1]))
        )
        for number, (region, pieces) in enumerate(zip(regions, blocks, strict=True)):
            is_in = _inside(region, block_x, block_y)
            if sources is not None:
                is_in &= numbers[0] == sources[1][number]
            along, across = np.divmod(np.flatnonzero(is_in), shape[1])
            pieces.append((along + lines.start, across))
    return [_joined(pieces) for pieces in blocks]


def _on_axes(region: Region, x: Floats, y: Floats) -> Pixels:
    # Pixels of a region where x depends on the column only and y on the row only.
    # Only pixels in the bounding box of the region are tested.
    low, high = region.polygon.min(axis=0), region.polygon.max(axis=0)
    across, along = (np.flatnonzero((axis >= low[k]) & (axis <= high[k])) for k, axis in enumerate((x, y)))
    blocks = []
    for lines in _blocks(along.size, across.size):
        row, col = (axis.ravel() for axis in np.meshgrid(along[lines], across, indexing="ij"))
        inside = _inside(region, x[col], y[row])
        blocks.append((row[inside], col[inside]))
    return _joined(blocks)


def _inside(region: Region, x: Floats, y: Floats) -> Bools:
    try:
        return contains(region.polygon, region.holes, x, y)
    except SchemaError as error:
        raise SchemaError(
            f"the pixels of region {region.name!r} cannot be found", problems=[error.problem]
        ) from error


def _values(axis: xr.DataArray, lines: slice, columns: int) -> Floats:
    # A coordinate of all pixels in a block of lines, line by line (pixel,)
    block = axis.isel({ALONG_TRACK: lines}, missing_dims="ignore")
    block = block.expand_dims([dim for dim in (ALONG_TRACK, CROSS_TRACK) if dim not in block.dims])
    values = block.transpose(ALONG_TRACK, CROSS_TRACK).values.astype(np.float64)
    return np.broadcast_to(values, (lines.stop - lines.start, columns)).ravel()


def _blocks(lines: int, columns: int) -> list[slice]:
    step = max(1, _BLOCK_PIXELS // max(columns, 1))
    return [slice(start, min(start + step, lines)) for start in range(0, lines, step)]


def _joined(blocks: Sequence[Pixels]) -> Pixels:
    empty = np.empty(0, np.int64)
    along, across = (
        np.concatenate([empty, *(block[axis] for block in blocks)]).astype(np.int64) for axis in (0, 1)
    )
    return along, across


# --- places on the ground ----------------------------------------------------------------------------------


def _transformed(regions: Regions, crs: str) -> Regions:
    # Regions with their corners transformed to another reference system; edges stay straight.
    # GeoJSON has longitude first in every reference system.
    source, target = crs_of(_canonical(str(regions.crs))), crs_of(crs)

    def transformed(ring: Any) -> Floats:
        corners = between_maps(np.asarray(ring, np.float64), source, target)
        SchemaError.raise_if(
            not np.isfinite(corners).all(),
            f"the corner {ring[0][0]:g}, {ring[0][1]:g} lies outside {regions.crs!r:.60}",
            mend="name the crs of the regions",
            code="corner-outside-crs",
        )
        return corners

    return _with_rings(regions, transformed, crs=crs)


def ground_of(line: xr.Dataset, crs: str | None) -> tuple[xr.DataArray, xr.DataArray, str | None]:
    # x and y of every pixel on the ground, and the reference system to transform regions to.
    # The latter is None where x and y are in the reference system of the regions.
    systems = {pair: _crs_of(line, pair) for pair in _GROUND if _has_pair(line, pair)}
    SchemaError.raise_if(
        not systems,
        "the line has no ground coordinates of its pixels",
        expected="east and north, or longitude and latitude (along_track, cross_track), or x and y of a map",
        mend="draw the regions in sensor coordinates, or locate the line first",
        code="pixel-places-missing",
    )
    region_crs = None if crs is None else _canonical(crs)
    fitting = [pair for pair, system in systems.items() if region_crs is None or system in (None, region_crs)]
    declared = [pair for pair, system in systems.items() if system is not None]
    if (region_crs is None and len(fitting) > 1) or not (fitting or declared):
        pairs = ", ".join(f"{x} and {y} ({system or 'unknown'})" for (x, y), system in systems.items())
        stated = "name no crs" if crs is None else f"are in {crs!r:.80}"
        raise SchemaError(
            f"the regions {stated}, the line has {pairs}",
            mend="write the regions in one of these reference systems, and name it as crs",
            code="crs-missing" if crs is None else "crs-mismatch",
        )
    # pairs with a declared crs take precedence
    x, y = pair = min(fitting, key=lambda pair: systems[pair] is None) if fitting else declared[0]
    system = None if fitting else systems[pair]
    return line[x].reset_coords(drop=True), line[y].reset_coords(drop=True), system


def _has_pair(line: xr.Dataset, pair: tuple[str, str]) -> bool:
    # latitude and longitude of the camera have the dim along_track only
    dims = {dim for name in pair if name in line.variables for dim in line[name].dims}
    return set(pair) <= set(line.variables) and dims == {ALONG_TRACK, CROSS_TRACK}


def _crs_of(line: xr.Dataset, pair: tuple[str, str]) -> str | None:
    if pair[0] in _GEOGRAPHIC:
        return _GEOGRAPHIC_CRS
    stated = line[pair[0]].attrs.get("crs", line.attrs.get("crs"))
    if stated is None and "spatial_ref" in line.variables:
        # rioxarray stores the crs of a GeoTIFF there
        mapping = line["spatial_ref"].attrs
        wkt = mapping.get("crs_wkt") or mapping.get("spatial_ref")
        stated = None if wkt is None else crs_of(wkt)
    return _canonical(stated) if isinstance(stated, str) else None


def _canonical(crs: str) -> str:
    # Unique spelling of the name of a reference system; CRS84 and EPSG:4326 are equal, as GeoJSON has
    # longitude first
    text = crs.strip()
    if text.lower().startswith("urn:ogc:def:crs:"):
        fields = text.split(":")
        text = f"{fields[4]}:{fields[-1]}"
    if text.upper() in ("OGC:CRS84", _GEOGRAPHIC_CRS, "WGS84"):
        return _GEOGRAPHIC_CRS
    return text if "[" in text else text.upper()  # names within WKT are case-sensitive


# --- points in polygons ------------------------------------------------------------------------------------


def contains(polygon: Floats, holes: Sequence[Floats], x: Floats, y: Floats) -> Bools:
    """Return whether points lie in a polygon or on one of its edges (point,).

    ``polygon`` (vertex, 2): x and y of its corners, in order, the last joined to the first; ``holes``: rings
    cut out of it, whose edges belong to the polygon; ``x``, ``y`` (point,): the points; NaN are in no
    polygon. Where a ring crosses itself, areas that it winds around an even number of times are outside
    (even-odd rule).

    Raises `SchemaError`: too many long edges; the test would take minutes.

    Examples
    --------
    >>> square = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]])
    >>> contains(square, [], np.array([1.0, 2.0, 2.1]), np.array([1.0, 0.5, 0.5])).tolist()
    [True, True, False]
    """
    low, high = polygon.min(axis=0), polygon.max(axis=0)
    near = np.flatnonzero((x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1]))
    # sorted by y, the points within the y range of an edge are one run
    near = near[np.argsort(y[near], kind="stable")]
    near_x, near_y = x[near], y[near]
    rings = [polygon, *holes]
    runs = [_runs(ring, near_y) for ring in rings]
    comparisons = sum(int((last - first).clip(0).sum()) for first, last in runs)
    if comparisons > FREE_COMPARISONS + MAX_EDGES_PER_PIXEL * near.size:
        raise SchemaError(
            f"on average {comparisons / near.size:.0f} edges lie beside each of {near.size} pixels",
            expected=f"at most {MAX_EDGES_PER_PIXEL}",
            mend="split the polygon, or give it fewer corners",
            code="polygon-too-complex",
        )
    inside = np.ones(near.size, bool)
    for number, (ring, (first, last)) in enumerate(zip(rings, runs, strict=True)):
        # only points within the y range of a hole can lie in it
        run = slice(int(first.min()), int(last.max())) if number else slice(0, near.size)
        if run.start >= run.stop:
            continue
        within, edge = _ring(ring, near_x[run], near_y[run], first - run.start, last - run.start)
        inside[run] &= ~within | edge if number else within | edge
    belongs: Bools = np.zeros(x.size, bool)
    belongs[near] = inside
    return belongs


def _runs(ring: Floats, y: Floats) -> tuple[Index, Index]:
    # Start and stop (edge,) of the points whose y lies within an edge's y range; y ascends
    closed = np.concatenate([ring, ring[:1]])[:, 1]
    first = np.searchsorted(y, np.minimum(closed[:-1], closed[1:]), "left")
    return first, np.searchsorted(y, np.maximum(closed[:-1], closed[1:]), "right")


def _ring(ring: Floats, x: Floats, y: Floats, first: Index, last: Index) -> tuple[Bools, Bools]:
    # Masks of the points that a ring winds around an odd number of times, and of those on the ring
    within, edge = np.zeros((2, x.size), bool)
    closed = np.concatenate([ring, ring[:1]])
    low, high = np.minimum(closed[:-1], closed[1:]), np.maximum(closed[:-1], closed[1:])
    for k in np.flatnonzero(first < last):
        run = slice(first[k], last[k])
        start, stop = closed[k], closed[k + 1]
        side = _side(start, stop, x[run], y[run])
        edge[run] |= (side == 0) & (x[run] >= low[k, 0]) & (x[run] <= high[k, 0])
        # a ray from the point in +x crosses rising edges left of them, falling edges right of them;
        # half-open y ranges count a corner once
        rises = (start[1] <= y[run]) & (y[run] < stop[1]) & (side > 0)
        within[run] ^= rises | (stop[1] <= y[run]) & (y[run] < start[1]) & (side < 0)
    return within, edge


def _side(start: Floats, stop: Floats, x: Floats, y: Floats) -> npt.NDArray[np.int8]:
    # 1 for points left of a directed edge, -1 right of it, 0 on its line
    along_x, along_y = stop[0] - start[0], stop[1] - start[1]
    off_x, off_y = x - start[0], y - start[1]
    product_xy, product_yx = along_x * off_y, along_y * off_x
    cross = product_xy - product_yx
    side: npt.NDArray[np.int8] = np.sign(cross).astype(np.int8)
    doubtful = np.abs(cross) <= _ROUNDING * (np.abs(product_xy) + np.abs(product_yx)) + _TINIEST
    # products with a zero difference are exact
    doubtful &= ((along_x != 0) & (off_y != 0)) | ((along_y != 0) & (off_x != 0))
    # the sign in exact rational arithmetic
    x0, y0, x1, y1 = (Fraction(float(value)) for value in (*start, *stop))
    for k in np.flatnonzero(doubtful).tolist():
        exact = (x1 - x0) * (Fraction(float(y[k])) - y0) - (y1 - y0) * (Fraction(float(x[k])) - x0)
        side[k] = (exact > 0) - (exact < 0)
    return side
