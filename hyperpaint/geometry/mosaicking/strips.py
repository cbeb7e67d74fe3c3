"""Several flight lines as maps on one grid, each cut into the tiles of the mosaic.

The extent of a line is surveyed once. Then the line is orthorectified over the tiles of the mosaic that it
touches, so that no tile is cut again.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import dask
import dask.array as da
import numpy as np
import xarray as xr
from dask._task_spec import convert_legacy_graph, cull
from dask.highlevelgraph import HighLevelGraph

from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.schema import ALONG_TRACK, BAND, CROSS_TRACK, Array, Progress
from hyperpaint.geometry.georeference.locating import is_located, locate
from hyperpaint.geometry.orthorectification.grids import NORTH, MapGrid, Survey, covering, survey_lines
from hyperpaint.geometry.orthorectification.mapping import line_chunks, orthorectify
from hyperpaint.geometry.orthorectification.tiling import empty_value, in_slabs, needed_slabs, tile_windows

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
        f"{type(lines).__name__} is no collection of flight lines",
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
            strips.append(_cut_map(name, line, covered, ((row, col), rows, cols), variables))
            continue
        line_grid = replace(
            shared.grid, first=(rows[0], cols[0]), shape=(rows[-1] - rows[0], cols[-1] - cols[0])
        )
        west, _, _, north, _, _ = line_grid.transform
        bounds = (
            west,
            north - line_grid.shape[0] * line_grid.gsd,
            west + line_grid.shape[1] * line_grid.gsd,
            north,
        )
        orthomap = orthorectify(
            line, line_grid.gsd, grid="north", variables=variables, tile=tile, bounds=bounds, **options
        )
        survey = shared.surveys[name]
        windows = tile_windows(line_grid.shape, tile)
        touched = np.zeros((len(windows), len(windows[0])), bool)
        for place, slabs in needed_slabs(survey, line_grid, [len(survey.boxes)], windows).items():
            touched[place] = bool(slabs)
        strips.append(Strip(name, orthomap, (row, col), touched))
    # the variables of all lines must be those of the first
    problems = Problems("these lines make no mosaic", SchemaError)
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
    problems.raise_if_any()
    return strips


def _cut_map(
    name: str,
    line: xr.Dataset,
    map_grid: MapGrid,
    tiles: tuple[tuple[int, int], list[int], list[int]],
    variables: Iterable[str] | None,
) -> Strip:
    # Cut a map into the tiles of the mosaic, padded to complete tiles.
    missing = [needed for needed in _MAP_VARIABLES if needed not in line.variables]
    SchemaError.raise_if(
        missing,
        f"the map {name} lacks {', '.join(missing)}",
        mend="give what hyperpaint.geometry.orthorectify returns, or the flight line",
        code="variable-missing",
    )
    corner, *edges = tiles
    pads = [
        (start - edge[0], edge[-1] - (start + count))
        for start, count, edge in zip(map_grid.first, map_grid.shape, edges, strict=True)
    ]
    sizes = [tuple(np.diff(edge).tolist()) for edge in edges]
    names = list(line.data_vars) if variables is None else [*dict.fromkeys([*_MAP_VARIABLES, *variables])]
    cut = {}
    for variable in (variable_name for variable_name in names if {"y", "x"} <= set(line[variable_name].dims)):
        array = line[variable].transpose("y", "x", ...)
        data = array.chunk(dict(zip(("y", "x"), map(max, sizes), strict=True))).data
        if any(map(any, pads)):
            other_pads = [(0, 0)] * (data.ndim - 2)
            data = da.pad(data, [*pads, *other_pads], constant_values=fill_of(str(variable), data.dtype))
        data = data.rechunk((*sizes, *(-1,) * (data.ndim - 2)))
        cut[variable] = xr.DataArray(data, dims=array.dims, attrs=array.attrs)
    band_coordinates = {key: line[key].variable for key in line.coords if line[key].dims == (BAND,)}
    axis_coordinates = {
        axis: (axis, np.zeros(sum(size)), line[axis].attrs)
        for axis, size in zip(("y", "x"), sizes, strict=True)
    }
    strip = xr.Dataset(
        cut, coords={**band_coordinates, **axis_coordinates, **_reference(line)}, attrs=line.attrs
    )
    return Strip(name, strip, corner, np.ones([len(size) for size in sizes], bool))


def fill_of(name: str, dtype: np.dtype[Any]) -> Any:
    # Return the value of a cell of a mosaic that no line shows.
    return dtype.type(0) if name == "hits" else empty_value(name, dtype)


def _positions(line: xr.Dataset) -> tuple[da.Array, da.Array]:
    slabs = line_chunks(line)
    east, north = (line[axis].transpose(ALONG_TRACK, CROSS_TRACK) for axis in ("east", "north"))
    return in_slabs(east, slabs), in_slabs(north, slabs)


def _reference(line: xr.Dataset) -> dict[str, xr.Variable]:
    return {"spatial_ref": line["spatial_ref"].variable} if "spatial_ref" in line.variables else {}


def _crs(line: xr.Dataset) -> Any:
    if not is_map(line):
        return line["east"].attrs.get("crs")
    named = line["x"].attrs.get("crs") if "x" in line.coords else None
    return named or _reference(line).get("spatial_ref", xr.Variable((), 0)).attrs.get("crs_wkt")


def _transform(name: str, line: xr.Dataset, problems: Problems) -> tuple[float, ...]:
    text = _reference(line).get("spatial_ref", xr.Variable((), 0)).attrs.get("GeoTransform")
    numbers = () if text is None else tuple(float(number) for number in str(text).split())
    problems.add_if(
        not (len(numbers) == 6 and numbers[1] == -numbers[5] > 0.0 and numbers[2] == numbers[4] == 0.0),
        f"the map {name} has the GeoTransform {text}",
        expected="square cells with north up",
        mend="orthorectify with grid='north'",
        code="grid-turned",
    )
    return numbers
