"""Mosaic of several flight lines: each cell shows one line, chosen by a rule.

Lines are maps on one grid, each cut into the tiles of the mosaic. The extent of a line is surveyed once. Then
the line is orthorectified over the tiles of the mosaic that it touches, so that no tile is cut again.

Tie points are the same places on the ground in two overlapping lines, found by correlation.
"""

import contextlib
import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from operator import getitem
from types import SimpleNamespace
from typing import Any, Literal, NamedTuple

import dask
import dask.array as da
import numpy as np
import xarray as xr
from dask._task_spec import convert_legacy_graph, cull
from dask.highlevelgraph import HighLevelGraph

from hyperpaint.base import (
    ALONG_TRACK,
    BAND,
    CROSS_TRACK,
    CUBE,
    Array,
    Bools,
    Floats,
    Ints,
    Problems,
    Progress,
    Quality,
    SchemaError,
    documented,
    needs_extra,
    one_of,
    takes_quantities,
)
from hyperpaint.geometry.georeference.locating import LOCATION_UNITS, is_located, locate
from hyperpaint.geometry.orthorectification.mapping import (
    NORTH,
    MapGrid,
    Place,
    Survey,
    check_cells,
    covering,
    empty_value,
    grid_coordinates,
    in_slabs,
    line_chunks,
    needed_slabs,
    orthorectify,
    survey_lines,
    tile_array,
    tile_windows,
)
from hyperpaint.io.store import TILE as STORE_TILE

_MAX_GRID_OFFSET_CELLS = 1e-3  # largest offset between two grids that are taken as equal
_WAVELENGTH_TOLERANCE_NM = 1e-6
_MAP_VARIABLES = ("hits", "gap")  # variables of every map from `orthorectify`

#: The tasks of one tile of one line, run one after another within a task of the mosaic. As separate tasks
#: they would be shared between neighbouring tiles, and dask would hold the slabs of all lines of a row of
#: tiles until the row is done: memory would grow with the number of lines. In exchange, a slab is computed
#: again for every tile that it touches.
Recipe = Callable[[], Sequence[Array]]


@dataclass(frozen=True)
class Strip:
    # One line as a map on the grid of the mosaic.
    name: str
    map: xr.Dataset  #: Variables (y, x[, band]), lazy, in chunks of the tiles of the mosaic
    corner: tuple[int, int]  #: Row and column of its first tile
    touched: Array  #: (tile row, tile column) bool: whether the line covers any cell of a tile

    def covers(self, place: tuple[int, int]) -> bool:
        # Return whether the map has a tile at an index (row, column) of the mosaic.
        return all(
            0 <= k - first < size
            for k, first, size in zip(place, self.corner, self.touched.shape, strict=True)
        )

    def reaches(self, place: tuple[int, int]) -> bool:
        # Return whether the line may cover a cell of a tile.
        return self.covers(place) and bool(self.touched[place[0] - self.corner[0], place[1] - self.corner[1]])

    def recipe(self, names: Sequence[str], place: tuple[int, int]) -> Recipe:
        row, col = place[0] - self.corner[0], place[1] - self.corner[1]
        arrays = [self.map[name].data for name in names]
        keys = [(array.name, row, col, *(0,) * (array.ndim - 2)) for array in arrays]
        return partial(dask.get, cull(self._graph, keys), keys)

    @cached_property
    def _graph(self) -> dict[Any, Any]:
        merged = HighLevelGraph.merge(*(array.data.dask for array in self.map.data_vars.values()))
        graph: dict[Any, Any] = convert_legacy_graph(dict(merged))
        return graph


def named_lines(lines: Any) -> dict[str, xr.Dataset]:
    # Return lines by name, sorted; lines of a sequence are numbered.
    if isinstance(lines, xr.DataTree):
        lines = {name: branch.to_dataset() for name, branch in lines.children.items()}
    SchemaError.raise_if(
        not isinstance(lines, Mapping | Sequence) or isinstance(lines, xr.Dataset) or not lines,
        "no flight line"
        if isinstance(lines, list | tuple | dict) and not lines
        else f"{type(lines).__name__} is no collection of flight lines",
        mend="give a dict of datasets by their names",
        code="type-wrong",
    )
    if isinstance(lines, Mapping):
        return {str(name): lines[name] for name in sorted(lines, key=str)}
    digits = len(str(len(lines) - 1))
    return {f"{number:0{digits}}": line for number, line in enumerate(lines)}


def is_map(line: xr.Dataset) -> bool:
    # Return whether a dataset is a map.
    return {"y", "x"} <= set(line.dims)


def located_lines(lines: Mapping[str, xr.Dataset], location: Mapping[str, Any]) -> dict[str, xr.Dataset]:
    # Return the lines with ground positions; maps and located lines are returned unchanged.
    return {
        name: line if is_map(line) or is_located(line) else locate(line, **location)
        for name, line in lines.items()
    }


@dataclass(frozen=True)
class SharedGrid:
    # The grid of a mosaic, and the part of it that each line covers.
    grid: MapGrid
    surveys: dict[str, Survey]  #: Surveys of lines that are not maps yet
    grids: dict[str, MapGrid]  #: Cells that every line covers


def shared_grid(lines: Mapping[str, xr.Dataset], gsd: float | None, progress: Progress | None) -> SharedGrid:
    # Return the grid that covers all lines; surveys the lines (eager) one at a time.
    #
    # Raises `SchemaError`: The lines are on different maps; maps have other cells than the mosaic, or are
    # turned; all are listed.
    problems = Problems("these lines make no mosaic", SchemaError)
    crs = {name: _crs(line) for name, line in lines.items()}
    if len(set(crs.values())) > 1:
        crs_list = ", ".join(f"{name}: {code}" for name, code in crs.items())
        problems.add(
            f"lines on different maps ({crs_list})",
            mend="give crs=",
            option="give --set crs=",
            code="crs-conflict",
        )
    surveys = {
        name: survey_lines(*_positions(line), NORTH, progress)
        for name, line in lines.items()
        if not is_map(line)
    }
    transforms = {name: _transform(name, line, problems) for name, line in lines.items() if is_map(line)}
    problems.raise_if_any()
    # the cell of the first map, else the largest spacing of a line
    largest = max((survey.gsd for survey in surveys.values()), default=np.nan)
    size = float(next((transform[1] for transform in transforms.values()), largest) if gsd is None else gsd)
    axes = NORTH
    if transforms:
        # maps of hyperpaint begin at multiples of the cell size, maps of other programs anywhere
        east, *_, north, _, _ = next(iter(transforms.values()))
        phase = [coordinate - size * round(coordinate / size) for coordinate in (east, north)]
        if max(map(abs, phase)) > _MAX_GRID_OFFSET_CELLS * size:
            axes = type(axes)(axes.right, (phase[0], phase[1]))
    grids = {name: covering(axes, size, survey.box, whole=False) for name, survey in surveys.items()}
    for name, transform in transforms.items():
        col, row = (transform[0] - axes.anchor[0]) / size, -(transform[3] - axes.anchor[1]) / size
        max_offset = max(abs(col - round(col)), abs(row - round(row)), abs(transform[1] / size - 1.0) * 1e4)
        problems.add_if(
            max_offset > _MAX_GRID_OFFSET_CELLS,
            f"{name} has cells of {transform[1]:.9g} m from ({transform[0]:.9g}, {transform[3]:.9g})",
            expected=f"cells of {size:.9g} m on the grid of the other lines",
            mend="orthorectify all lines with one gsd and grid='north', or give the lines",
            code="grid-mismatch",
        )
        shape = lines[name].sizes["y"], lines[name].sizes["x"]
        grids[name] = MapGrid(axes, size, (round(row), round(col)), shape)
    problems.raise_if_any()
    firsts = np.array([grid.first for grid in grids.values()])
    ends = firsts + [grid.shape for grid in grids.values()]
    first, end = firsts.min(axis=0).tolist(), ends.max(axis=0).tolist()
    shape = (end[0] - first[0], end[1] - first[1])
    return SharedGrid(MapGrid(axes, size, (first[0], first[1]), shape), surveys, grids)


def strips_of(
    lines: Mapping[str, xr.Dataset],
    shared: SharedGrid,
    variables: Iterable[str] | None,
    tile: int,
    **options: Any,
) -> list[Strip]:
    # Return all lines on the grid of the mosaic, cut into its tiles; options as for `orthorectify`.
    #
    # Raises `SchemaError`: Lines have other wavelengths, units or types than the first; maps lack ``hits`` or
    # ``gap``.
    strips = []
    for name, line in lines.items():
        # Tiles are counted from the anchor of the grid, like cells: the tiles of a line do not move when
        # another line joins the mosaic, so its rounding does not change either.
        covered = shared.grids[name]
        row, col = (first // tile for first in covered.first)
        end_row, end_col = (
            -(-(k + count) // tile) for k, count in zip(covered.first, covered.shape, strict=True)
        )
        rows, cols = ([k * tile for k in range(*ends)] for ends in ((row, end_row + 1), (col, end_col + 1)))
        if is_map(line):
            # cut a map into the tiles of the mosaic, padded to complete tiles
            missing = [needed for needed in _MAP_VARIABLES if needed not in line.variables]
            SchemaError.raise_if(
                missing,
                f"the map {name} lacks {', '.join(missing)}",
                mend="give what hyperpaint.geometry.orthorectify returns, or the flight line",
                code="variable-missing",
            )
            pads = [
                (start - edge[0], edge[-1] - (start + count))
                for start, count, edge in zip(covered.first, covered.shape, (rows, cols), strict=True)
            ]
            sizes = [tuple(np.diff(edge).tolist()) for edge in (rows, cols)]
            names = line.data_vars if variables is None else dict.fromkeys([*_MAP_VARIABLES, *variables])
            cut = {}
            for layer in (key for key in names if {"y", "x"} <= set(line[key].dims)):
                plane = line[layer].transpose("y", "x", ...)
                data = plane.chunk(dict(zip(("y", "x"), map(max, sizes), strict=True))).data
                if any(map(any, pads)):
                    other_pads = [(0, 0)] * (data.ndim - 2)
                    data = da.pad(data, [*pads, *other_pads], constant_values=fill_of(str(layer), data.dtype))
                data = data.rechunk((*sizes, *(-1,) * (data.ndim - 2)))
                cut[layer] = xr.DataArray(data, dims=plane.dims, attrs=plane.attrs)
            band_coordinates = {key: line[key].variable for key in line.coords if line[key].dims == (BAND,)}
            axis_coordinates = {
                axis: (axis, np.zeros(sum(size)), line[axis].attrs)
                for axis, size in zip(("y", "x"), sizes, strict=True)
            }
            strip = xr.Dataset(
                cut,
                coords={**band_coordinates, **axis_coordinates, "spatial_ref": _reference(line)},
                attrs=line.attrs,
            )
            strips.append(Strip(name, strip, (row, col), np.ones([len(size) for size in sizes], bool)))
            continue
        line_grid = replace(
            shared.grid, first=(rows[0], cols[0]), shape=(rows[-1] - rows[0], cols[-1] - cols[0])
        )
        west, _, _, north, _, _ = line_grid.transform
        orthomap = orthorectify(
            line,
            line_grid.gsd,
            grid="north",
            variables=variables,
            tile=tile,
            bounds=(
                west,
                north - line_grid.shape[0] * line_grid.gsd,
                west + line_grid.shape[1] * line_grid.gsd,
                north,
            ),
            **options,
        )
        survey = shared.surveys[name]
        windows = tile_windows(line_grid.shape, tile)
        touched = np.zeros([len(part) for part in windows], bool)
        for place, slabs in needed_slabs(survey, line_grid, [len(survey.boxes)], windows).items():
            touched[place] = bool(slabs)
        strips.append(Strip(name, orthomap, (row, col), touched))
    # the variables of all lines must be those of the first
    with Problems("these lines make no mosaic", SchemaError) as problems:
        first = strips[0]
        for other in strips[1:]:
            for variable in first.map.data_vars:
                first_array, array = first.map[variable], other.map.variables.get(variable)
                if array is None:
                    problems.add(
                        f"{other.name} has no {variable}, which {first.name} has",
                        mend="give variables=",
                        code="variable-missing",
                    )
                    continue
                for property_name, found, expected in (
                    ("type", array.dtype, first_array.dtype),
                    ("size", array.shape[2:], first_array.shape[2:]),
                    ("units", array.attrs.get("units"), first_array.attrs.get("units")),
                ):
                    problems.add_if(
                        found != expected,
                        f"{property_name} of {variable} of {other.name} {found}",
                        expected=f"{expected} of {first.name}",
                        code="variable-mismatch",
                    )
            first_wavelength, wavelength = (
                np.asarray(s.map.coords.get("wavelength", ())) for s in (first, other)
            )
            problems.add_if(
                first_wavelength.shape != wavelength.shape
                or not np.allclose(first_wavelength, wavelength, rtol=0, atol=_WAVELENGTH_TOLERANCE_NM),
                f"wavelengths of {other.name} differ from those of {first.name}",
                code="wavelength-mismatch",
            )
    return strips


def fill_of(name: str, dtype: np.dtype[Any]) -> Any:
    # Return the value of a cell of a mosaic that no line shows.
    return dtype.type(0) if name == "hits" else empty_value(name, dtype)


def _positions(line: xr.Dataset) -> tuple[da.Array, da.Array]:
    slabs = line_chunks(line)
    east, north = (line[axis].transpose(ALONG_TRACK, CROSS_TRACK) for axis in ("east", "north"))
    return in_slabs(east, slabs), in_slabs(north, slabs)


def _reference(line: xr.Dataset) -> xr.Variable:
    return line["spatial_ref"].variable if "spatial_ref" in line.variables else xr.Variable((), 0)


def _crs(line: xr.Dataset) -> Any:
    if not is_map(line):
        return line["east"].attrs.get("crs")
    named = line["x"].attrs.get("crs") if "x" in line.coords else None
    return named or _reference(line).attrs.get("crs_wkt")


def _transform(name: str, line: xr.Dataset, problems: Problems) -> tuple[float, ...]:
    text = _reference(line).attrs.get("GeoTransform")
    numbers = () if text is None else tuple(float(number) for number in str(text).split())
    problems.add_if(
        not (len(numbers) == 6 and numbers[1] == -numbers[5] > 0.0 and numbers[2] == numbers[4] == 0.0),
        f"the map {name} has the GeoTransform {text}",
        expected="square cells with north up",
        mend="orthorectify with grid='north'",
        code="grid-turned",
    )
    return numbers


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
    with Problems("these lines cannot be composed to a mosaic", SchemaError) as problems:
        one_of(rule, RULES, "rule", problems=problems)
        problems.add_if(
            levelling not in (None, "overlap"),
            f"levelling {levelling!r:.60}",
            expected="'overlap' or None",
            code="choice-unknown",
        )
        check_cells(problems, gsd, tile)
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
    grid = shared.grid
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
    flags = {
        "flag_values": np.arange(len(strips), dtype=np.int16),
        "flag_meanings": " ".join(strip.name.replace(" ", "_") for strip in strips),
        "empty_value": int(NO_LINE),
    }
    planes_of_choice: dict[str, tuple[Any, str, dict[str, Any]]] = {
        "flightline": (np.int16, "Flight line that shows a cell", flags),
        "line_count": (np.uint8, "How many flight lines show a cell", {"units": "1"}),
        "gap": (np.bool_, "Whether no line shows a cell within the ends of any", {}),
    }
    in_map = {"grid_mapping": "spatial_ref"}
    layers: dict[str, Any] = {
        name: (("y", "x"), tiles.plane(planes, name, dtype), {**attrs, "long_name": meaning, **in_map})
        for name, (dtype, meaning, attrs) in planes_of_choice.items()
    }
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
        layers |= {
            "levelling_factor": (("source", BAND), factors, attributes),
            "source": ("source", [strip.name for strip in strips], {"long_name": "Flight line"}),
        }
    for name in names_of_all:
        lazy = (
            tiles.plane(planes, name, first[name].dtype)
            if name in flat
            else tiles.spectra(layers["flightline"][1], name, factors)
        )
        layers[name] = (first[name].dims, lazy, {**first[name].attrs, **in_map})
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
    } | {
        "gsd": grid.gsd,
        "grid": "north",
        "mosaic_rule": rule,
        "levelling": levelling or "none",
        "flightlines": [strip.name for strip in strips],
    }
    tiled = xr.Dataset(layers, band_coordinates, attrs)
    # cut the tiles to the extent of the lines
    offset = [start - k * tile for start, k in zip(grid.first, starts, strict=True)]
    rows, cols = (slice(k, k + size) for k, size in zip(offset, grid.shape, strict=True))
    axes = {name: first[name].attrs if name in first.coords else {"units": "m"} for name in ("x", "y")}
    return tiled.isel(y=rows, x=cols).assign_coords(grid_coordinates(grid, _reference(first).attrs, axes))


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
        # Return factors (line, band) that make lines agree where they overlap (eager, a tile at a time).
        #
        # And whether the factor of an overlapping line is interpolated from neighbouring bands (line, band).
        #
        # Robust least squares on the logarithm of the medians of tiles, over unflagged cells. Lines connected
        # by overlaps keep their mean logarithm; lines without enough overlap have the factor 1. Two lines do
        # not overlap in a band that is 0 or less in one of them; a factor of 1 there would be a step in the
        # spectrum, so the logarithm is interpolated line by line over the wavelength, or band numbers, and
        # constant beyond the outermost bands.
        #
        # Raises `SchemaError`: No two lines overlap.
        first = self.strips[0].map[variable]
        tiles = (self._recipes([*LEVELLED_BY, variable], place) for place in np.ndindex(self.count))
        wavelength = first.coords.get("wavelength")
        wavelength_nm = (
            None if wavelength is None or wavelength.ndim != 1 else wavelength.values.astype(np.float64)
        )
        lines, bands = len(self.strips), first.shape[2]
        # recipes are bound to the callable: dask would search arguments for tasks
        tasks = [
            dask.delayed(partial(_ratios, tile), pure=False, traverse=False)()
            for tile in tiles
            if len(tile) > 1
        ]
        ratios = [ratio for tile in dask.compute(*tasks) for ratio in tile]
        SchemaError.raise_if(
            not ratios,
            "lines cannot be levelled: no two lines overlap in unflagged cells",
            mend="leave out levelling=",
            code="overlap-missing",
        )
        incidence = np.zeros((len(ratios), lines))
        for row, (earlier, later, _, _) in enumerate(ratios):
            incidence[row, earlier], incidence[row, later] = -1.0, 1.0
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
                is_tied[:, band] = [
                    np.unique(parts[parts_of_all == number]).size == 1 for number in parts_of_all
                ]
        overlapping: Bools = np.any(incidence != 0.0, axis=0)
        interpolated = overlapping[:, None] & ~is_tied & is_tied.any(axis=1, keepdims=True)
        position = np.arange(bands, dtype=np.float64) if wavelength_nm is None else wavelength_nm
        for line in np.flatnonzero(interpolated.any(axis=1)):
            tied_bands = np.flatnonzero(~interpolated[line])
            tied_bands = tied_bands[np.argsort(position[tied_bands], kind="stable")]
            gap_bands = interpolated[line]
            logs[line, gap_bands] = np.interp(
                position[gap_bands], position[tied_bands], logs[line, tied_bands]
            )
        return np.exp(logs).astype(first.dtype), interpolated

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
        return self._array(
            "mosaic-planes", tasks, object, [], (sources, rule, self.first, self.count, self.size)
        )

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


_LEVELLING = SimpleNamespace(
    # every second row and column is used: neighbouring cells are redundant
    step=2,
    min_overlap_cells=20,  # cells of a tile in which two lines must overlap
    # standard deviations beyond which a tile counts less: 95 % efficient for normal errors (Huber 1964)
    huber_sd=1.345,
    fit_rounds=20,
)


def _connected_parts(incidence: Floats) -> Ints:
    # Return the number of the connected part of each line (line,).
    from scipy.sparse.csgraph import connected_components

    return np.asarray(connected_components(np.abs(incidence).T @ np.abs(incidence))[1])


def _ratios(recipes: dict[int, Recipe]) -> list[tuple[int, int, Floats, Floats]]:
    # Return pairs of lines and per band the number of common cells and the median of log(first / second),
    # NaN where there are too few cells.
    logs = {}
    for number, recipe in recipes.items():
        hits, quality, cube = (values[:: _LEVELLING.step, :: _LEVELLING.step] for values in recipe())
        is_good = ((hits > 0) & (quality == 0))[..., None] & (cube > 0.0)
        logs[number] = np.log(np.where(is_good, cube, np.nan))
    ratios = []
    for first, second in itertools.combinations(logs, 2):
        difference = (logs[first] - logs[second]).reshape(-1, logs[first].shape[2])
        cells = np.isfinite(difference).sum(axis=0)
        is_enough = cells >= _LEVELLING.min_overlap_cells
        if is_enough.any():
            median = np.full(cells.shape, np.nan)
            median[is_enough] = np.nanmedian(difference[:, is_enough], axis=0)
            ratios.append((first, second, cells.astype(np.float64), median))
    return ratios


def _robust_fit(incidence: Floats, observed: Floats, weights: Floats) -> Floats:
    # Return logarithms of factors (line,), whose mean is 0 over connected lines.
    huber_weights = np.ones_like(observed)
    for _ in range(_LEVELLING.fit_rounds):
        scaled = (weights * np.sqrt(huber_weights))[:, None]
        solution = np.linalg.lstsq(scaled * incidence, scaled[:, 0] * observed, rcond=1e-9)[0]
        residuals = np.abs(observed - incidence @ solution)
        limit = _LEVELLING.huber_sd * max(1.4826 * float(np.median(residuals)), 1e-6)
        huber_weights = limit / np.maximum(residuals, limit)
    return np.asarray(solution)


_CUBE_NAMES = ("counts", "radiance", "reflectance")
_FIELDS = ("glt_line", "glt_sample", "ground_height")


@dataclass(frozen=True)
class Rules:
    """Thresholds of the search, and their origin."""

    #: Cells from the middle of a patch to its edge: large enough for a few objects, small enough that the
    #: camera's errors are one shift in it.
    half_patch: int = 20
    #: Smallest correlation accepted as the same place. Noise of half the contrast leaves 0.8.
    min_correlation: float = 0.8
    #: Largest correlation elsewhere, relative to the best: beyond it the pattern repeats.
    max_rival: float = 0.9
    #: Smallest standard deviation of a patch along its flattest direction, relative to its mean.
    min_texture: float = 0.01
    max_patches: int = 150  #: patches of a pair of lines, those with the most texture
    outlier_sd: float = 4.0  #: standard deviations of shifts from a plane through those of a pair


TIE_RULES = Rules()


class _Picture(NamedTuple):
    corner: tuple[int, int]
    image: Floats  #: (row, col); NaN where nothing is shown
    fields: Floats  #: (field, row, col): of `_FIELDS`


@takes_quantities(**LOCATION_UNITS, gsd="m", search_m="m")
@documented()
def find_tie_points(
    lines: Mapping[str, xr.Dataset] | Sequence[xr.Dataset],
    gsd: float | None = None,
    *,
    search_m: float | None = None,
    band: int | None = None,
    rules: Rules = TIE_RULES,
    progress: Progress | None = None,
    **location: Any,
) -> xr.Dataset:
    """Find ground points that two overlapping lines show, for `hyperpaint.geometry.solve_boresight` (eager).

    Parameters
    ----------
    lines
        Flight lines by their names, located or to be located with the options of
        `hyperpaint.geometry.locate`.
    gsd
        Edge of a cell in which pictures are compared [m]; by default twice the largest spacing of pixels.
    search_m
        Largest distance on the map between the two positions of a point [m]; by default 16 cells. It should
        be less than half the distance at which the ground repeats itself.
    band
        Number of the band to compare, of counts, else radiance, else reflectance; by default the middle one.
    rules
    progress
    **location

    Returns
    -------
    xarray.Dataset
        ``along_track_pixel`` and ``cross_track_pixel`` (point, side): position in each of the two lines, in
        fractions of a pixel from the centre of the first; ``flightline`` (point, side); ``east``, ``north``
        and ``height`` (point) [m]: ground position by the first line; ``shift`` (point, side): position by
        the second line minus the first, east and north [m]; ``quality`` (point): correlation, at most 1.

    Raises
    ------
    SchemaError
        Fewer than two lines, maps instead of lines, no cube, or no tie points in the overlaps.

    Notes
    -----
    Both lines are resampled bilinearly on one grid with north up. Patches with texture in every direction are
    searched in the other line by normalised cross-correlation, whose peak is refined by a paraboloid.
    Patterns that repeat within the search, and shifts off a plane through all shifts of a pair, are left out.

    Examples
    --------
    >>> from hyperpaint.geometry import locate
    >>> from hyperpaint.simulation import simulate_line
    >>> size = dict(lines=400, bands=2, columns=400, swath=6.0, square=0.64)
    >>> lines = {
    ...     seed: locate(simulate_line(scene="checkerboard", wobble="calm", seed=seed, **size), ground=160.0)
    ...     for seed in (0, 1)}
    >>> ties = find_tie_points(lines, search_m=0.4)
    >>> ties.sizes["point"] > 30, float(abs(ties["shift"]).max()) < 0.01  # [m]
    (True, True)
    """
    lines_by_name = named_lines(lines)
    SchemaError.raise_if(
        len(lines_by_name) < 2 or any(map(is_map, lines_by_name.values())),
        "tie points need two flight lines or more, in the geometry of the camera",
        code="line-number",
    )
    lines_by_name = located_lines(lines_by_name, location)
    gsd = 2.0 * shared_grid(lines_by_name, None, None).grid.gsd if gsd is None else gsd
    shared = shared_grid(lines_by_name, gsd, None)
    pictures = {name: _picture(line, shared.grids[name], gsd, band) for name, line in lines_by_name.items()}
    reach = 16 if search_m is None else max(1, round(search_m / gsd))
    pairs = list(itertools.combinations(lines_by_name, 2))
    rows, names = [], []
    for count, (first, second) in enumerate(pairs, start=1):
        ties = _ties_of(pictures[first], pictures[second], reach, rules)
        rows.append(ties)
        names += [(first, second)] * len(ties)
        if progress is not None:
            progress(count, len(pairs))
    table = np.concatenate(rows)
    SchemaError.raise_if(
        not len(table),
        f"no tie points between {', '.join(lines_by_name)}",
        expected=f"lines that overlap by more than {2 * rules.half_patch * gsd:.3g} m",
        mend="give a larger search_m=, another band= or gsd=",
        code="tie-points-missing",
    )
    east, north = shared.grid.axes.anchor
    row, col, shift_down, shift_right, quality, height = table[:, :6].T
    pixels = table[:, 6:].reshape(-1, 2, 2)
    side = ("point", "side")
    return xr.Dataset(
        {
            "along_track_pixel": (side, pixels[:, :, 0]),
            "cross_track_pixel": (side, pixels[:, :, 1]),
            "flightline": (side, np.array(names)),
            "east": ("point", east + (col + 0.5) * gsd, {"units": "m"}),
            "north": ("point", north - (row + 0.5) * gsd, {"units": "m"}),
            "height": ("point", height, {"units": "m"}),
            "shift": (side, np.stack([shift_right, -shift_down], axis=-1) * gsd, {"units": "m"}),
            "quality": ("point", quality, {"units": "1", "long_name": "Correlation of the two pictures"}),
        },
        attrs={"crs": next(iter(lines_by_name.values()))["east"].attrs.get("crs"), "gsd": gsd},
    )


def _picture(line: xr.Dataset, grid: Any, gsd: float, band: int | None) -> _Picture:
    cubes = [name for name in _CUBE_NAMES if name in line.variables and set(line[name].dims) == set(CUBE)]
    SchemaError.raise_if(
        not cubes or "ground_height" not in line.variables,
        "a line has no counts, radiance or reflectance, or no ground_height",
        mend="locate lines with hyperpaint.geometry.locate before",
        code="variable-missing",
    )
    number = line.sizes[BAND] // 2 if band is None else band
    image = line[cubes[0]].isel({BAND: number}, drop=True).astype(np.float32)
    names = {name for name in line.data_vars if BAND in line[name].dims}
    # without index coordinates the map holds positions in the line, also for a crop
    other = [n for n in line.coords if BAND in line[n].dims or n in (ALONG_TRACK, CROSS_TRACK)]
    orthomap = orthorectify(
        line.drop_vars([*names, *other]).assign(picture=image.drop_vars(other, errors="ignore")),
        gsd,
        grid="north",
        variables=["picture", "ground_height"],
        method="bilinear",
    )[["picture", *_FIELDS]].compute()
    return _Picture(
        grid.first,
        orthomap["picture"].values.astype(np.float64),
        np.stack([orthomap[name].values for name in _FIELDS]),
    )


def _ties_of(first_picture: _Picture, second_picture: _Picture, reach: int, rules: Rules) -> Floats:
    # Return row, col, shift down and right, correlation, height and pixels of ties (tie, 10).
    half = rules.half_patch
    low = np.maximum(first_picture.corner, second_picture.corner)
    high = np.minimum(
        np.add(first_picture.corner, first_picture.image.shape),
        np.add(second_picture.corner, second_picture.image.shape),
    )
    if (high - low <= 2 * half).any():
        return np.empty((0, 10))
    centres = [
        (row, col)
        for row in range(low[0] + half, high[0] - half, half)
        for col in range(low[1] + half, high[1] - half, half)
    ]
    # the pictures continue by NaN, so that they have all windows
    margin = half + reach
    first_image, second_image = (
        np.pad(picture.image, margin, constant_values=np.nan) for picture in (first_picture, second_picture)
    )
    to_first, to_second = (np.subtract(margin, picture.corner) for picture in (first_picture, second_picture))
    textures = np.array([_texture(_window(first_image, centre + to_first, half)) for centre in centres])
    order = np.argsort(-textures, kind="stable")[: rules.max_patches]
    ties = []
    for centre in (centres[k] for k in order if textures[k] > rules.min_texture):
        shift, quality = _match(
            _window(first_image, centre + to_first, half),
            _window(second_image, centre + to_second, margin),
            rules,
        )
        if quality < rules.min_correlation:
            continue
        pixel_first = _fields_at(first_picture, np.array(centre, float))
        pixel_second = _fields_at(second_picture, np.array(centre) + shift)
        tie = [*centre, *shift, quality, pixel_first[2], *pixel_first[:2], *pixel_second[:2]]
        if np.isfinite(tie).all():
            ties.append(tie)
    table = np.array(ties, np.float64).reshape(-1, 10)
    # leave out ties with shifts off a plane through all shifts of the pair
    is_near = np.ones(len(table), bool)
    if len(table) < 6:
        return table
    terms = np.column_stack([np.ones(len(table)), table[:, :2] - table[:, :2].mean(axis=0, keepdims=True)])
    for _ in range(10):
        plane = np.linalg.lstsq(terms[is_near], table[is_near, 2:4], rcond=None)[0]
        distance = np.linalg.norm(table[:, 2:4] - terms @ plane, axis=1)
        limit = rules.outlier_sd * max(float(np.median(distance[is_near])) / 1.1774, 0.05)
        before, is_near = is_near, distance < limit
        if is_near.sum() < 6 or (is_near == before).all():
            break
    return table[is_near]


def _window(image: Floats, place: Array, half: int) -> Floats:
    # Return a copy of the part of an image around a cell: sums over a view would differ in the last bit.
    row, col = place
    return image[row - half : row + half + 1, col - half : col + half + 1].copy()


def _texture(patch: Floats) -> float:
    # Return the root of the smaller eigenvalue of the mean product of gradients, relative to the mean.
    if np.isnan(patch).any() or not patch.mean() > 0.0:
        return 0.0
    down, right = np.gradient(patch / patch.mean())
    mixed = float((down * right).mean())
    matrix = np.array([[float((down**2).mean()), mixed], [mixed, float((right**2).mean())]])
    return float(np.sqrt(max(np.linalg.eigvalsh(matrix)[0], 0.0)))


def _match(patch: Floats, window: Floats, rules: Rules) -> tuple[Floats, float]:
    # Return the offset of a patch from the middle of a window (rows, columns), and its correlation.
    from scipy.ndimage import maximum_filter
    from scipy.signal import fftconvolve

    no_match = np.zeros(2), 0.0
    is_shown = np.isfinite(window)
    if is_shown.mean() < 0.25:
        return no_match
    size, mean = patch.size, float(window[is_shown].mean())
    filled = np.where(is_shown, window - mean, 0.0)
    weights = patch - patch.mean()
    box = np.ones(patch.shape)
    sums, squares, counts = (
        fftconvolve(values, box, "valid") for values in (filled, filled**2, is_shown * 1.0)
    )
    spread = np.sqrt(np.maximum(squares - sums**2 / size, 1e-12 * mean**2)) * np.linalg.norm(weights)
    score = fftconvolve(filled, weights[::-1, ::-1], "valid") / spread
    score[counts < size - 0.5] = -1.0  # only complete patches are compared
    peak = np.unravel_index(int(np.argmax(score)), score.shape)
    best, reach = float(score[peak]), score.shape[0] // 2
    if not all(0 < k < n - 1 for k, n in zip(peak, score.shape, strict=True)):
        return no_match
    neighbourhood = score[peak[0] - 1 : peak[0] + 2, peak[1] - 1 : peak[1] + 2]
    # the highest local maximum other than the peak
    rivals = np.where(score == maximum_filter(score, 5), score, -1.0)
    rivals[tuple(peak)] = -1.0
    if neighbourhood.min() <= -1.0 or float(rivals.max()) > rules.max_rival * best:
        return no_match
    # the maximum of the paraboloid through the 3 x 3 values, from the middle one
    y, x = np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0], indexing="ij")
    terms = np.stack([np.ones(9), y.ravel(), x.ravel(), y.ravel() ** 2, x.ravel() ** 2, (x * y).ravel()], 1)
    _, a, b, aa, bb, ab = np.linalg.lstsq(terms, neighbourhood.ravel(), rcond=None)[0]
    summit = np.zeros(2)
    with contextlib.suppress(np.linalg.LinAlgError):
        summit = np.clip(np.linalg.solve(np.array([[2 * aa, ab], [ab, 2 * bb]]), [-a, -b]), -1.0, 1.0)
    return np.array(peak) - reach + summit, best


def _fields_at(picture: _Picture, cell: Array) -> Floats:
    # Interpolate the fields at a fractional row and column; NaN beyond the picture.
    from scipy.ndimage import map_coordinates

    position = (cell - picture.corner)[:, None]
    return np.array([map_coordinates(values, position, order=1, cval=np.nan)[0] for values in picture.fields])
