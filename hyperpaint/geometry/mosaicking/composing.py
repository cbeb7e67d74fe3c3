"""Mosaic of several flight lines: each cell shows one line, chosen by a rule."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import getitem
from typing import Any, Literal

import dask
import dask.array as da
import numpy as np
import xarray as xr

from hyperpaint.base.errors import Problems, SchemaError, needs_extra
from hyperpaint.base.facts import documented, one_of, takes_quantities
from hyperpaint.base.schema import BAND, Array, Bools, Floats, Ints, Progress, Quality
from hyperpaint.geometry.georeference.poses import LOCATION_UNITS
from hyperpaint.geometry.orthorectification.grids import MapGrid, Place, check_cells, tile_array
from hyperpaint.io.store.layout import TILE as STORE_TILE

from .strips import Recipe, Strip, fill_of, located_lines, named_lines, shared_grid, strips_of

RULES = ("nadir", "unflagged", "newest")
# variables that a rule needs of every line
_RANKED_BY = {
    "nadir": ("view_zenith",),
    "unflagged": ("quality", "view_zenith"),
    "newest": ("line_time",),
}
_EMPTY_PIXEL = int(Quality.OFF_SWATH | Quality.NO_DATA)  # such pixels rank below pixels of any other line
_LOCATION = (*LOCATION_UNITS, "navigation", "dem", "crs", "camera", "convention", "interpolation")
NO_LINE = np.int16(-1)


@takes_quantities(**LOCATION_UNITS, gsd="m")
@documented()
def mosaic(
    lines: Mapping[str, xr.Dataset] | Sequence[xr.Dataset],
    gsd: float | None = None,
    *,
    rule: Literal["nadir", "unflagged", "newest"] = "nadir",
    levelling: Literal["overlap"] | None = None,
    variables: Iterable[str] | None = None,
    tile: int = 256,
    progress: Progress | None = None,
    **options: Any,
) -> xr.Dataset:
    """Return several flight lines as one map with north up; every cell shows one line.

    Lazy except for one survey of the pixel positions of each line. A tile reads only the lines that show it,
    one after another.

    Parameters
    ----------
    lines
        Flight lines by their names, located or to be located with the options of
        `hyperpaint.geometry.locate`; or maps with north up, as `hyperpaint.geometry.orthorectify`
        returns them, on grids that fit. Lines of a sequence are numbered.
    gsd
        Edge of a cell [m]; by default the cell of the maps, else the largest pixel spacing of any line.
    rule
        The line shown where several cover a cell: the line that looks down most steeply (``"nadir"``, by
        ``view_zenith``); the same, but pixels without any flag of ``quality`` first (``"unflagged"``); or
        the line flown last (``"newest"``, by ``line_time``). Under every rule pixels without data
        (``no_data``, ``off_swath``) rank last. Among equal ranks, the first line in alphabetical order is
        shown.
    levelling
        ``"overlap"`` multiplies the spectra of every line by one factor a band, so that lines agree where
        unflagged cells of two overlap: robust least squares on the logarithm of their ratio, which keeps the
        mean of all lines. Seams fade, but errors of one line enter the others: off by default. Reading the
        overlaps is eager.
    variables
        Variables of the map, as for `hyperpaint.geometry.orthorectify`; all lines must have them.
    tile
    progress
    **options
        ``method``, ``multi_hit`` and ``max_stretch`` of `hyperpaint.geometry.orthorectify`, and options of
        `hyperpaint.geometry.locate`, for all lines.

    Returns
    -------
    xarray.Dataset
        The variables (y, x[, band]) of the line shown, never averaged, and changed by levelling alone.
        ``flightline`` (y, x): its number, with its name in ``flag_values`` and ``flag_meanings``, -1 where no
        line covers a cell; ``line_count``: number of lines that cover it; ``gap``: uncovered, but between
        the ends of a line; ``levelling_factor`` (source, band), with levelling; its attribute
        ``interpolated_bands`` names the bands without usable overlaps, whose factors are interpolated.
        Sides of more than 256 cells begin at whole multiples of 128, as chunks of a store do.
        Otherwise as `hyperpaint.geometry.orthorectify`, whose ``nearest_line`` and ``nearest_sample`` are the
        pixel of that line.

    Raises
    ------
    SchemaError
        No lines, or lines on different maps or grids, of different wavelengths, units or types, or without
        the variables of the rule; unknown options; all problems of a kind are listed.
    TimeError, UnitsError, MissingExtraError
        As `hyperpaint.geometry.locate`.

    See Also
    --------
    hyperpaint.geometry.orthorectify

    Examples
    --------
    Two lines side by side; the second looks down more steeply at the cells that both cover:

    >>> import numpy as np, xarray as xr
    >>> def line(first, zenith):
    ...     north, east = np.meshgrid([9.0, 7.0, 5.0], first + np.array([1.0, 3.0, 5.0]), indexing="ij")
    ...     dims, metres = ("along_track", "cross_track"), {"units": "m"}
    ...     planes = {"red": (dims, np.full((3, 3), first)), "view_zenith": (dims, np.full((3, 3), zenith))}
    ...     places = {"east": (dims, east, metres), "north": (dims, north, metres)}
    ...     return xr.Dataset(planes).assign_coords(places)
    >>> pair = {"first": line(0.0, 9.0), "second": line(2.0, 5.0)}
    >>> both = mosaic(pair, 2.0, variables=["red", "view_zenith"])
    >>> both.red.values[0], both.flightline.values[0], both.flightline.attrs["flag_meanings"]
    (array([0., 2., 2., 2.]), array([0, 1, 1, 1], dtype=int16), 'first second')
    """
    lines_by_name = named_lines(lines)
    problems = Problems("these lines cannot be composed to a mosaic", SchemaError)
    one_of(rule, RULES, "rule", problems=problems)
    problems.add_if(
        levelling not in (None, "overlap"),
        f"levelling {levelling!r:.60}",
        expected="'overlap' or None",
        code="choice-unknown",
    )
    check_cells(problems, gsd, tile)
    problems.raise_if_any()
    lines_by_name = located_lines(
        lines_by_name, {name: options.pop(name) for name in _LOCATION if name in options}
    )
    shared = shared_grid(lines_by_name, gsd, progress)
    strips = strips_of(lines_by_name, shared, variables, tile, **options)
    rank_variables = _RANKED_BY[rule]
    names_lacking = [s.name for s in strips if not set(rank_variables) <= set(s.map.variables)]
    SchemaError.raise_if(
        names_lacking,
        f"rule {rule!r} chooses by {' and '.join(rank_variables)}, which {', '.join(names_lacking)} lack",
        mend="locate the lines, add it to variables=, or choose another rule",
        option="choose another --rule",
        code="variable-missing",
    )
    return _composed_map(strips, shared.grid, rule, tile, levelling)


def _planes_of_tile(
    rule: str, names: list[str], fills: list[Any], size: int, recipes: dict[int, Recipe], gaps: list[Recipe]
) -> dict[str, Array]:
    # Choose the line of every cell of a tile; return the planes ``names`` of the chosen lines (row, col).
    # The keys of ``recipes`` are line numbers.
    shape = size, size
    line, line_count = np.full(shape, NO_LINE), np.zeros(shape, np.uint8)
    out = {name: np.full(shape, fill) for name, fill in zip(names, fills, strict=True)}
    best_ranks: list[Array] = []
    for number, recipe in recipes.items():
        plane = dict(zip(names, recipe(), strict=True))
        # ranks of cells, the most important first; the line of lowest rank is shown
        quality = plane.get("quality", np.zeros_like(plane["hits"]))
        ranks = [(quality & _EMPTY_PIXEL) != 0]
        if rule == "newest":
            time = plane["line_time"].astype("datetime64[ns]").astype(np.int64)
            # NaT is the lowest integer: make it the oldest time
            ranks.append(-np.maximum(time, -np.iinfo(np.int64).max))
        else:
            ranks += [quality != 0] if rule == "unflagged" else []
            ranks.append(np.where(np.isnan(plane["view_zenith"]), np.inf, plane["view_zenith"]))
        if not best_ranks:
            best_ranks = [np.zeros(shape, rank.dtype) for rank in ranks]
        # the first rank that differs decides; with equal ranks the earlier line stays
        is_better, is_equal = np.zeros(shape, bool), np.ones(shape, bool)
        for rank, best_rank in zip(ranks, best_ranks, strict=True):
            is_better |= is_equal & (rank < best_rank)
            is_equal &= rank == best_rank
        is_shown = plane["hits"] > 0
        line_count += is_shown
        is_chosen = is_shown & (is_better | (line == NO_LINE))
        line[is_chosen] = number
        for rank, best_rank in zip(ranks, best_ranks, strict=True):
            best_rank[is_chosen] = rank[is_chosen]
        for name, values in plane.items():
            out[name][is_chosen] = values[is_chosen]
    is_within = np.zeros(shape, bool)
    for recipe in gaps:
        is_within |= recipe()[0]
    return {**out, "flightline": line, "line_count": line_count, "gap": is_within & (line == NO_LINE)}


def _spectra_of_tile(
    line: Array, fill: Any, bands: int, recipes: dict[int, Recipe], factors: Array | None
) -> Array:
    # Return (row, col, band) of the chosen lines, without reading other lines; ``factors`` is (line, band).
    out = np.full((*line.shape, bands), fill)
    for number, recipe in recipes.items():
        is_line = line == number
        if is_line.any():
            (tile,) = recipe()
            out[is_line] = tile[is_line] if factors is None else tile[is_line] * factors[number]
    return out


@dataclass(frozen=True)
class _Tiles:
    strips: list[Strip]
    first: Place  #: Row and column of the first tile
    count: Place  #: Tiles down and to the right
    size: int  #: Rows and columns of a tile

    def _array(
        self,
        label: str,
        tasks: Mapping[Any, Any],
        dtype: Any,
        sources: list[da.Array],
        options: Any = None,
        bands: tuple[int, ...] = (),
    ) -> da.Array:
        sides = tuple((1 if dtype is object else self.size,) * count for count in self.count)
        layer = {(*place, *(0 for _ in bands)): task for place, task in tasks.items()}
        return tile_array(label, layer, (*sides, *((size,) for size in bands)), dtype, sources, options)

    def levelling(self, variable: str) -> tuple[Floats, Bools]:
        first = self.strips[0].map[variable]
        tiles = (self._recipes([*LEVELLED_BY, variable], place) for place in np.ndindex(self.count))
        wavelength = first.coords.get("wavelength")
        wavelength_nm = (
            None if wavelength is None or wavelength.ndim != 1 else wavelength.values.astype(np.float64)
        )
        factors, interpolated = overlap_factors(tiles, len(self.strips), first.shape[2], wavelength_nm)
        return factors.astype(first.dtype), interpolated

    def _recipes(self, names: list[str], place: Place) -> dict[int, Recipe]:
        tile_index = self.first[0] + place[0], self.first[1] + place[1]
        return {
            number: strip.recipe(names, tile_index)
            for number, strip in enumerate(self.strips)
            if strip.reaches(tile_index)
        }

    def planes(self, rule: str, names: list[str]) -> da.Array:
        # one dict per tile
        first = self.strips[0].map
        fills = [fill_of(name, first[name].dtype) for name in names]
        tasks = {}
        for place in np.ndindex(self.count):
            tile_index = self.first[0] + place[0], self.first[1] + place[1]
            gaps = [strip.recipe(["gap"], tile_index) for strip in self.strips if strip.covers(tile_index)]
            arguments = (rule, names, fills, self.size, self._recipes(names, place), gaps)
            tasks[place] = (partial(_planes_of_tile, *arguments),)
        sources = [[strip.map[name].data.name for name in names] for strip in self.strips]
        options = (sources, rule, self.first, self.count, self.size)
        return self._array("mosaic-planes", tasks, object, [], options)

    def plane(self, planes: da.Array, name: str, dtype: Any) -> da.Array:
        tasks = {place: (getitem, (planes.name, *place), name) for place in np.ndindex(self.count)}
        return self._array(f"mosaic-{name}", tasks, dtype, [planes])

    def spectra(self, lines: da.Array, variable: str, factors: Array | None) -> da.Array:
        first = self.strips[0].map[variable]
        fill, (bands,) = fill_of(variable, first.dtype), first.shape[2:]
        tasks = {}
        for place in np.ndindex(self.count):
            options = {"fill": fill, "bands": bands, "factors": factors}
            recipes = self._recipes([variable], place)
            tasks[place] = (partial(_spectra_of_tile, recipes=recipes, **options), (lines.name, *place))
        sources = [strip.map[variable].data.name for strip in self.strips]
        return self._array(f"mosaic-{variable}", tasks, first.dtype, [lines], (sources, factors), (bands,))


def _composed_map(
    strips: list[Strip], grid: MapGrid, rule: str, tile: int, levelling: str | None
) -> xr.Dataset:
    # Longer sides begin at a chunk of a store. Tiles begin at whole multiples of their size on the map; if a
    # mosaic of several tiles began between two chunks, every chunk would be written from up to four tiles,
    # which stay in memory until then.
    sides = [
        (start - start % STORE_TILE if size > 2 * STORE_TILE else start, start + size)
        for start, size in zip(grid.first, grid.shape, strict=True)
    ]
    (top, bottom), (left, right) = sides
    grid = replace(grid, first=(top, left), shape=(bottom - top, right - left))
    first = strips[0].map
    starts = [start // tile for start in grid.first]
    ends = [-(-(start + size) // tile) for start, size in zip(grid.first, grid.shape, strict=True)]
    tiles = _Tiles(strips, (starts[0], starts[1]), (ends[0] - starts[0], ends[1] - starts[1]), tile)
    names_of_all = [str(name) for name in first.data_vars if name != "gap"]
    flat = [name for name in names_of_all if first[name].ndim == 2]
    planes = tiles.planes(rule, flat)
    numbers = np.arange(len(strips), dtype=np.int16)
    flags = {
        "flag_values": numbers,
        "flag_meanings": " ".join(strip.name.replace(" ", "_") for strip in strips),
        "empty_value": int(NO_LINE),
    }
    planes_of_choice: dict[str, tuple[Any, str, dict[str, Any]]] = {
        "flightline": (np.int16, "Flight line that shows a cell", flags),
        "line_count": (np.uint8, "How many flight lines show a cell", {"units": "1"}),
        "gap": (np.bool_, "Whether no line shows a cell within the ends of any", {}),
    }
    variables: dict[str, Any] = {}
    for name, (dtype, meaning, attrs) in planes_of_choice.items():
        attrs |= {"long_name": meaning, "grid_mapping": "spatial_ref"}
        variables[name] = (("y", "x"), tiles.plane(planes, name, dtype), attrs)
    factors = None
    if levelling is not None:
        cubes = [name for name in names_of_all if name not in flat and first[name].ndim == 3]
        missing = [name for name in LEVELLED_BY if name not in first.variables]
        SchemaError.raise_if(
            len(cubes) != 1 or first[cubes[0]].dtype.kind != "f" or missing,
            f"levelling, with {', '.join(cubes) or 'no cube'} and without {', '.join(missing) or 'nothing'}",
            expected="one cube of floats, such as reflectance, with quality",
            mend="give variables=",
            code="variable-missing",
        )
        factors, interpolated = tiles.levelling(cubes[0])
        attributes = {
            "units": "1",
            "long_name": "Factor of the spectra of a line, from its overlaps with others",
        }
        if interpolated.any():
            # bands without usable overlaps, by line, numbered from 0
            attributes["interpolated_bands"] = "; ".join(
                f"{strip.name}: {', '.join(map(str, np.flatnonzero(bands)))}"
                for strip, bands in zip(strips, interpolated, strict=True)
                if bands.any()
            )
        variables["levelling_factor"] = (("source", BAND), factors, attributes)
        variables["source"] = ("source", [strip.name for strip in strips], {"long_name": "Flight line"})
    for name in names_of_all:
        lazy = (
            tiles.plane(planes, name, first[name].dtype)
            if name in flat
            else tiles.spectra(variables["flightline"][1], name, factors)
        )
        variables[name] = (first[name].dims, lazy, {**first[name].attrs, "grid_mapping": "spatial_ref"})
    band_coordinates = {
        name: coordinate.variable
        for name, coordinate in first.coords.items()
        if coordinate.dims == (BAND,)
        and all(coordinate.variable.identical(s.map[name].variable) for s in strips)
    }
    attrs = {
        key: value
        for key, value in first.attrs.items()
        if all(repr(strip.map.attrs.get(key)) == repr(value) for strip in strips)
    }
    attrs |= {"gsd": grid.gsd, "grid": "north", "mosaic_rule": rule, "levelling": levelling or "none"}
    attrs["flightlines"] = [strip.name for strip in strips]
    tiled = xr.Dataset(variables, band_coordinates, attrs)
    # cut the tiles to the extent of the lines
    offset = [start - k * tile for start, k in zip(grid.first, starts, strict=True)]
    rows, cols = (slice(k, k + size) for k, size in zip(offset, grid.shape, strict=True))
    return tiled.isel(y=rows, x=cols).assign_coords(_coordinates(first, grid))


def _coordinates(first: xr.Dataset, grid: MapGrid) -> dict[str, Any]:
    rows, cols = grid.shape
    (east, _), (_, north) = (
        grid.centres(slice(0, 1), slice(0, cols)),
        grid.centres(slice(0, rows), slice(0, 1)),
    )
    attrs = first["spatial_ref"].attrs if "spatial_ref" in first.variables else {}
    return {
        "x": ("x", east[0], first["x"].attrs if "x" in first.coords else {"units": "m"}),
        "y": ("y", north[:, 0], first["y"].attrs if "y" in first.coords else {"units": "m"}),
        "spatial_ref": (
            (),
            np.int64(0),
            {**attrs, "GeoTransform": " ".join(repr(float(number)) for number in grid.transform)},
        ),
    }


def seamlines(mosaic: xr.Dataset) -> dict[str, Any]:
    """Return the area that each line of a mosaic shows, as GeoJSON (eager in ``flightline`` alone).

    Parameters
    ----------
    mosaic
        Result of `hyperpaint.geometry.mosaic`.

    Returns
    -------
    dict
        A FeatureCollection in map coordinates, with the ``crs`` of the map: a MultiPolygon per line, with
        the property ``flightline`` and the area in cells, ``cells``. Outlines follow the edges of cells.

    Raises
    ------
    SchemaError
        There is no ``flightline`` with its names, or no ``spatial_ref`` with a ``GeoTransform``.
    MissingExtraError
        rasterio is not installed (extra ``geo``).

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> names = {"flag_values": [0, 1], "flag_meanings": "left right"}
    >>> both = xr.Dataset({"flightline": (("y", "x"), np.int16([[0, 0, 1], [0, 1, 1]]), names)})
    >>> both = both.assign_coords(spatial_ref=((), 0, {"GeoTransform": "0 2 0 10 0 -2"}))
    >>> for area in seamlines(both)["features"]:
    ...     print(area["properties"], area["geometry"]["coordinates"][0][0][0])
    {'flightline': 'left', 'cells': 3} (0.0, 10.0)
    {'flightline': 'right', 'cells': 3} (4.0, 10.0)
    """
    attrs = mosaic["flightline"].attrs if "flightline" in mosaic.variables else {}
    transform = mosaic["spatial_ref"].attrs.get("GeoTransform") if "spatial_ref" in mosaic.variables else None
    SchemaError.raise_if(
        "flag_meanings" not in attrs or transform is None,
        "not a mosaic: flightline with flag_meanings, or spatial_ref with GeoTransform, is missing",
        mend="compose one with hyperpaint.geometry.mosaic",
        code="variable-missing",
    )
    with needs_extra("rasterio", "geo", "outlining the lines of a mosaic"):
        from rasterio import Affine
        from rasterio.features import shapes
    east, a, b, north, c, d = (float(number) for number in str(transform).split())
    numbers = mosaic["flightline"].values
    names = dict(
        zip(np.atleast_1d(attrs["flag_values"]).tolist(), attrs["flag_meanings"].split(), strict=True)
    )
    outlines: dict[int, list[Any]] = {number: [] for number in names}
    for outline, number in shapes(numbers, numbers >= 0, transform=Affine(a, b, east, c, d, north)):
        outlines[int(number)].append(outline["coordinates"])
    features = [
        {
            "type": "Feature",
            "properties": {"flightline": names[number], "cells": int((numbers == number).sum())},
            "geometry": {"type": "MultiPolygon", "coordinates": polygons},
        }
        for number, polygons in outlines.items()
        if polygons
    ]
    collection: dict[str, Any] = {"type": "FeatureCollection", "coordinates": "map", "features": features}
    crs = mosaic["x"].attrs.get("crs") if "x" in mosaic.coords else None
    if crs is not None:
        collection["crs"] = {"type": "name", "properties": {"name": str(crs)}}
    return collection


# --- levelling --------------------------------------------------------------------------------------------


LEVELLED_BY = ("hits", "quality")  # planes needed besides the spectra


# every second row and column is used: neighbouring cells are redundant
_LEVELLING_STEP = 2
_MIN_OVERLAP_CELLS = 20  # cells of a tile in which two lines must overlap
# standard deviations beyond which a tile counts less: 95 % efficient for normal errors (Huber 1964)
_HUBER_SD = 1.345
_FIT_ROUNDS = 20


def overlap_factors(
    tiles: Iterable[dict[int, Recipe]], lines: int, bands: int, wavelength: Floats | None = None
) -> tuple[Floats, Bools]:
    # Return factors (line, band) that make lines agree where they overlap (eager, a tile at a time).
    #
    # And whether the factor of an overlapping line is interpolated from neighbouring bands (line, band).
    #
    # ``tiles`` make `LEVELLED_BY` and spectra of every line of a tile, by its number. Robust least squares on
    # the logarithm of the medians of tiles, over unflagged cells. Lines connected by overlaps keep their mean
    # logarithm; lines without enough overlap have the factor 1. Two lines do not overlap in a band that is 0
    # or less in one of them; a factor of 1 there would be a step in the spectrum, so the logarithm is
    # interpolated line by line over ``wavelength`` (band,), or band numbers, and constant beyond the
    # outermost bands.
    #
    # Raises `SchemaError`: No two lines overlap.
    # recipes are bound to the callable: dask would search arguments for tasks
    tasks = [
        dask.delayed(partial(_ratios, tile), pure=False, traverse=False)() for tile in tiles if len(tile) > 1
    ]
    ratios = [ratio for tile in dask.compute(*tasks) for ratio in tile]
    SchemaError.raise_if(
        not ratios,
        "lines cannot be levelled: no two lines overlap in unflagged cells",
        mend="leave out levelling=",
        code="overlap-missing",
    )
    incidence = np.zeros((len(ratios), lines))
    for row, (first, second, _, _) in enumerate(ratios):
        incidence[row, first], incidence[row, second] = -1.0, 1.0
    weights = np.sqrt(np.stack([cells for _, _, cells, _ in ratios]))
    observed = np.stack([log_ratio for *_, log_ratio in ratios])
    # lines connected by overlaps in any band must be connected in this band too
    parts_of_all = _connected_parts(incidence)
    logs = np.zeros((lines, bands))
    is_tied = np.zeros((lines, bands), bool)
    for band in range(bands):
        is_observed = np.isfinite(observed[:, band])
        if is_observed.any():
            logs[:, band] = _robust_fit(
                incidence[is_observed], observed[is_observed, band], weights[is_observed, band]
            )
            parts = _connected_parts(incidence[is_observed])
            is_tied[:, band] = [np.unique(parts[parts_of_all == number]).size == 1 for number in parts_of_all]
    overlapping: Bools = np.any(incidence != 0.0, axis=0)
    interpolated = overlapping[:, None] & ~is_tied & is_tied.any(axis=1, keepdims=True)
    position = np.arange(bands, dtype=np.float64) if wavelength is None else wavelength
    for line in np.flatnonzero(interpolated.any(axis=1)):
        tied_bands = np.flatnonzero(~interpolated[line])
        tied_bands = tied_bands[np.argsort(position[tied_bands], kind="stable")]
        gap_bands = interpolated[line]
        logs[line, gap_bands] = np.interp(position[gap_bands], position[tied_bands], logs[line, tied_bands])
    return np.exp(logs), interpolated


def _connected_parts(incidence: Floats) -> Ints:
    # Return the number of the connected part of each line (line,).
    from scipy.sparse.csgraph import connected_components

    labels: Ints = connected_components(np.abs(incidence).T @ np.abs(incidence))[1]
    return labels


def _ratios(recipes: dict[int, Recipe]) -> list[tuple[int, int, Floats, Floats]]:
    # Return pairs of lines and per band the number of common cells and the median of log(first / second),
    # NaN where there are too few cells.
    logs = {}
    for number, recipe in recipes.items():
        hits, quality, cube = (values[::_LEVELLING_STEP, ::_LEVELLING_STEP] for values in recipe())
        is_good = ((hits > 0) & (quality == 0))[..., None] & (cube > 0.0)
        logs[number] = np.log(np.where(is_good, cube, np.nan))
    ratios = []
    for first, second in itertools.combinations(logs, 2):
        difference = (logs[first] - logs[second]).reshape(-1, logs[first].shape[2])
        cells = np.isfinite(difference).sum(axis=0)
        is_enough = cells >= _MIN_OVERLAP_CELLS
        if is_enough.any():
            median = np.full(cells.shape, np.nan)
            median[is_enough] = np.nanmedian(difference[:, is_enough], axis=0)
            ratios.append((first, second, cells.astype(np.float64), median))
    return ratios


def _robust_fit(incidence: Floats, observed: Floats, weights: Floats) -> Floats:
    # Return logarithms of factors (line,), whose mean is 0 over connected lines.
    huber_weights = np.ones_like(observed)
    for _ in range(_FIT_ROUNDS):
        scaled = (weights * np.sqrt(huber_weights))[:, None]
        solution = np.linalg.lstsq(scaled * incidence, scaled[:, 0] * observed, rcond=1e-9)[0]
        residuals = np.abs(observed - incidence @ solution)
        limit = _HUBER_SD * max(1.4826 * float(np.median(residuals)), 1e-6)
        huber_weights = limit / np.maximum(residuals, limit)
    return np.asarray(solution)
