"""Pixels of a flight line inside regions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
import xarray as xr

from hyperpaint.base import schema
from hyperpaint.base.arrays import Bools, Floats, Ints
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.schema import ALONG_TRACK, CROSS_TRACK, numbers_of
from hyperpaint.geometry.georeference.geodesy import between_maps, crs_of
from hyperpaint.geometry.georeference.locating import locate
from hyperpaint.geometry.georeference.poses import POSE

from .geojson import regions_from
from .outlines import Region, Regions
from .polygons import contains

RegionsT = TypeVar("RegionsT", bound=Regions)
#: Positions along and across the track, line by line.
Pixels = tuple[Ints, Ints]

#: Pixels whose places are processed together.
_BLOCK_PIXELS = 2**20

_GROUND = (("east", "north"), ("easting", "northing"), ("longitude", "latitude"), ("lon", "lat"), ("x", "y"))
_GEOGRAPHIC = ("longitude", "lon")
_DEGREES = "EPSG:4326"
#: Variables of a map: column and line of the flight line that every cell shows.
_SHOWN = ("nearest_sample", "nearest_line")
#: Variable of a map of several flight lines: the flight line that a cell shows.
_OF_LINE = "flightline"


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
    places = pixels_of(region_list, line)
    mask = np.full((line.sizes[ALONG_TRACK], line.sizes[CROSS_TRACK]), -1, np.int16)
    for number, place in enumerate(places):
        mask[place] = number
    attrs = {
        "long_name": "Region that a pixel lies in",
        "flag_values": np.arange(-1, len(region_list), dtype=np.int16),
        "flag_meanings": " ".join(["none", *(name.replace(" ", "_") for name in region_list.names)]),
    }
    return xr.DataArray(mask, dims=tuple(dims), name="region", attrs=attrs)


def pixels_of(regions: Regions, line: xr.Dataset) -> list[Pixels]:
    """Return the pixels of every region; see `pixels`.

    In sensor coordinates nothing is read; of a map the places of the pixels are read once, in blocks of
    lines.

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
        if dim not in line.dims:
            problems.add(
                f"dims {', '.join(map(str, line.dims))}",
                expected=f"the dim {dim!r}",
                mend=f"select with isel({dim}=[5]) to keep it, or name it with dims=",
                code="dim-missing",
            )
    problems.raise_if_any()
    shape = line.sizes[ALONG_TRACK], line.sizes[CROSS_TRACK]
    if regions.coordinates == "map":
        line = located_for(regions, line)
        x, y, crs = _ground(line, regions.crs)
        if crs is not None and regions.crs is not None:
            regions = _moved(regions, crs)
        return _by_place(regions, x, y, shape)
    if set(_SHOWN) <= set(line.variables):
        # coordinates of a map's cell are those of the pixel that it shows; -1 is an empty cell
        across, along = (line[name].reset_coords(drop=True) for name in _SHOWN)
        places = across.where(across >= 0), along.where(along >= 0)
        names = lines_of_cells(line)
        if not names:
            return _by_place(regions, *places, shape)
        return _by_place(regions, *places, shape, (line[_OF_LINE], _own_lines(regions, names)))
    columns, rows = numbers_of(line, CROSS_TRACK), numbers_of(line, ALONG_TRACK)
    return [_on_axes(region, columns, rows) for region in regions]


def lines_of_cells(line: xr.Dataset) -> dict[str, int]:
    """Return the numbers of the flight lines in a map by name; empty for a map of one line."""
    if _OF_LINE not in line.variables or set(line[_OF_LINE].dims) != {ALONG_TRACK, CROSS_TRACK}:
        return {}
    attrs = line[_OF_LINE].attrs
    numbers = np.atleast_1d(attrs.get("flag_values", ())).astype(int).tolist()
    names = dict(zip(str(attrs.get("flag_meanings", "")).split(), numbers, strict=False))
    return names if len(names) > 1 else {}


def _own_lines(regions: Regions, names: Mapping[str, int]) -> list[int]:
    problems = Problems("pixels of regions cannot be found in this map of several flight lines", SchemaError)
    for region in regions:
        if region.flightline.replace(" ", "_") not in names:
            named = (
                f"is of flight line {region.flightline!r}" if region.flightline else "names no flight line"
            )
            problems.add(
                f"region {region.name!r} in coordinates of the sensor {named}",
                expected=f"one of {', '.join(names)}",
                mend="give it the property flightline, or draw it in coordinates of the map",
                code="flightline-unknown",
            )
    problems.raise_if_any()
    return [names[region.flightline.replace(" ", "_")] for region in regions]


def located_for(regions: Regions, line: xr.Dataset) -> xr.Dataset:
    """Return a flight line with the places that regions of a map need, located where it has poses only.

    Raises `SchemaError`: the height of the ground is unknown; or as `hyperpaint.geometry.locate`.
    """
    named = schema.rename_to_roles(line)
    is_placed = any(_is_place(named, pair) for pair in _GROUND)
    if regions.coordinates != "map" or is_placed or not set(POSE) <= set(named.variables):
        return line
    if not isinstance(named.attrs.get("ground"), int | float):
        raise SchemaError(
            "the flight line has no height of the ground to locate regions in map coordinates",
            mend="pass the height above the ellipsoid: locate(line, ground=...) or dem=, or the attribute "
            "ground [m] of the line",
            option="give --ground or --dem, or [geometry] ground in collect.toml and process again",
            code="ground-height-missing",
        )
    return locate(named)


def renumbered(regions: RegionsT, line: xr.Dataset, *, back: bool = False) -> RegionsT:
    """Return regions in positions of a line as regions in its numbers, or ``back`` from them to positions."""
    numbers = [numbers_of(line, dim) for dim in (CROSS_TRACK, ALONG_TRACK)]
    first = np.array([values[0] for values in numbers])
    step = np.array([(values[-1] - values[0]) / max(values.size - 1, 1) or 1.0 for values in numbers])
    if not first.any() and (step == 1.0).all():
        return regions

    return _with_rings(
        regions, lambda ring: np.asarray((ring - first) / step if back else ring * step + first)
    )


def _with_rings(regions: RegionsT, move: Callable[[Floats], Floats], **changes: Any) -> RegionsT:
    members = (
        replace(region, polygon=move(region.polygon), holes=tuple(move(hole) for hole in region.holes))
        for region in regions
    )
    return replace(regions, regions=tuple(members), **changes)


def _by_place(
    regions: Regions,
    x: xr.DataArray,
    y: xr.DataArray,
    shape: tuple[int, int],
    of_lines: tuple[xr.DataArray, Sequence[int]] | None = None,
) -> list[Pixels]:
    # Pixels of every region by their coordinates, in blocks of lines.
    # `of_lines`: in a map of several flight lines, the flight line of each cell, and of each region.
    if x.dims == (CROSS_TRACK,) and y.dims == (ALONG_TRACK,):
        return [_on_axes(region, x.values.astype(float), y.values.astype(float)) for region in regions]
    parts: list[list[Pixels]] = [[] for _ in regions]
    for start, stop in _blocks(0, shape[0], shape[1]):
        rows = {ALONG_TRACK: slice(start, stop)}
        there_x, there_y = (
            _values(part.isel(rows, missing_dims="ignore"), stop - start, shape[1]) for part in (x, y)
        )
        numbers = None if of_lines is None else _values(of_lines[0].isel(rows), stop - start, shape[1])
        for number, (region, pieces) in enumerate(zip(regions, parts, strict=True)):
            is_in = _inside(region, there_x, there_y)
            if of_lines is not None:
                is_in &= numbers == of_lines[1][number]
            inside = np.flatnonzero(is_in)
            if inside.size:
                along, across = np.divmod(inside, shape[1])
                pieces.append((along + start, across))
    return [_joined(pieces) for pieces in parts]


def _on_axes(region: Region, x: Floats, y: Floats) -> Pixels:
    # Cells of a map with north up; only cells in the box around the region are tested
    low, high = region.polygon.min(axis=0), region.polygon.max(axis=0)
    across, along = (np.flatnonzero((axis >= low[k]) & (axis <= high[k])) for k, axis in enumerate((x, y)))
    parts = []
    for start, stop in _blocks(0, along.size, across.size):
        row, col = np.meshgrid(along[start:stop], across, indexing="ij")
        inside = _inside(region, x[col.ravel()], y[row.ravel()])
        parts.append((row.ravel()[inside], col.ravel()[inside]))
    return _joined(parts)


def _inside(region: Region, x: Floats, y: Floats) -> Bools:
    try:
        return contains(region.polygon, region.holes, x, y)
    except SchemaError as error:
        raise SchemaError(
            f"the pixels of region {region.name!r} cannot be found", problems=[error.problem]
        ) from error


def _values(part: xr.DataArray, lines: int, columns: int) -> Floats:
    # A coordinate of a block of lines, line by line (pixel,)
    values = part.transpose(ALONG_TRACK, CROSS_TRACK, missing_dims="ignore").values.astype(np.float64)
    if part.dims == (ALONG_TRACK,):
        values = values[:, None]
    return np.broadcast_to(values, (lines, columns)).ravel()


def _blocks(start: int, stop: int, width: int) -> Iterator[tuple[int, int]]:
    step = max(1, _BLOCK_PIXELS // max(width, 1))
    for first in range(start, stop, step):
        yield first, min(first + step, stop)


def _joined(parts: Sequence[Pixels]) -> Pixels:
    empty = np.empty(0, np.int64)
    along = np.concatenate([empty, *(part[0] for part in parts)]).astype(np.int64)
    across = np.concatenate([empty, *(part[1] for part in parts)]).astype(np.int64)
    return along, across


# --- places on the ground ----------------------------------------------------------------------------------


def _moved(regions: Regions, crs: str) -> Regions:
    # Regions transformed to another reference system; edges between the new corners are straight
    # in GeoJSON longitude comes first, whatever the system's own order
    source, target = crs_of(_normal(str(regions.crs))), crs_of(crs)

    def moved(ring: Any) -> Floats:
        corners = between_maps(np.asarray(ring, np.float64), source, target)
        if not np.isfinite(corners).all():
            raise SchemaError(
                f"the corner {ring[0][0]:g}, {ring[0][1]:g} lies outside {regions.crs!r:.60}",
                mend="name the crs of the regions",
                code="corner-outside-crs",
            )
        return corners

    return _with_rings(regions, moved, crs=crs)


def _ground(line: xr.Dataset, crs: str | None) -> tuple[xr.DataArray, xr.DataArray, str | None]:
    # X and y of every pixel on the ground, and the reference system to transform regions to.
    # This system is None where the line has places in the regions' own.
    there = {pair: _crs_of(line, pair) for pair in _GROUND if _is_place(line, pair)}
    if not there:
        raise SchemaError(
            "the line has no place of its pixels on the map",
            expected="east and north, or longitude and latitude (along_track, cross_track), or x and y of "
            "a map",
            mend="draw the regions in sensor coordinates, or locate the line first",
            code="pixel-places-missing",
        )
    wanted = None if crs is None else _normal(crs)
    fitting = [pair for pair, pair_crs in there.items() if wanted is None or pair_crs in (None, wanted)]
    # places with a known crs take precedence over those without
    fitting.sort(key=lambda pair: there[pair] is None)
    others = [pair for pair, pair_crs in there.items() if pair_crs is not None]
    if not fitting and others:
        x, y = others[0]
        return line[x].reset_coords(drop=True), line[y].reset_coords(drop=True), there[others[0]]
    if not fitting or (wanted is None and len(fitting) > 1):
        held = ", ".join(f"{x} and {y} ({pair_crs or 'unknown'})" for (x, y), pair_crs in there.items())
        stated = "name no crs" if crs is None else f"are in {crs!r:.80}"
        raise SchemaError(
            f"the regions {stated}, the line has {held}",
            mend="write the regions in one of these, and name its crs",
            code="crs-missing" if crs is None else "crs-mismatch",
        )
    x, y = fitting[0]
    return line[x].reset_coords(drop=True), line[y].reset_coords(drop=True), None


def _is_place(line: xr.Dataset, pair: tuple[str, str]) -> bool:
    if not set(pair) <= set(line.variables):
        return False
    dims = [set(line[name].dims) for name in pair]
    # the camera's latitude and longitude have along_track only
    return set.union(*dims) == {ALONG_TRACK, CROSS_TRACK}


def _crs_of(line: xr.Dataset, pair: tuple[str, str]) -> str | None:
    if pair[0] in _GEOGRAPHIC:
        return _DEGREES
    stated = line[pair[0]].attrs.get("crs", line.attrs.get("crs"))
    if stated is None and "spatial_ref" in line.variables:
        # as rioxarray opens a GeoTIFF
        mapping = line["spatial_ref"].attrs
        wkt = mapping.get("crs_wkt") or mapping.get("spatial_ref")
        stated = None if wkt is None else crs_of(wkt)
    return _normal(stated) if isinstance(stated, str) else None


def _normal(crs: str) -> str:
    # A unique spelling of a reference system's name; in GeoJSON longitude always comes first
    text = crs.strip()
    if text.lower().startswith("urn:ogc:def:crs:"):
        parts = text.split(":")
        text = f"{parts[4]}:{parts[-1]}"
    if text.upper() in ("OGC:CRS84", _DEGREES, "WGS84"):
        return _DEGREES
    return text if "[" in text else text.upper()  # names within WKT are case-sensitive
