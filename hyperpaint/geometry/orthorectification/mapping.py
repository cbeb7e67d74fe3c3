"""Orthorectification: a flight line as a map.

The dask graph of a map has one task per tile for positions in the line, and one per variable. A task reads
only the slabs of lines that cover its tile. The survey of all lines decides the extent of a map; it keeps a
few numbers per line, so that it needs the memory of a few slabs, whatever the length of the flight.
"""

import math
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import getitem
from types import SimpleNamespace
from typing import Any, Literal

import dask
import dask.array as da
import numpy as np
import xarray as xr
from dask.array.core import normalize_chunks
from dask.base import tokenize
from dask.callbacks import Callback
from dask.highlevelgraph import HighLevelGraph

from hyperpaint.base import (
    ALONG_TRACK,
    BAND,
    CHUNK_LINES,
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
    dtype_of,
    label,
    numbers_of,
    one_of,
    require,
    takes_quantities,
    warn_if,
)
from hyperpaint.geometry.georeference.locating import (
    LOCATION_UNITS,
    crs_of,
    grid_mapping_attrs,
    is_located,
    locate,
)
from hyperpaint.io.store import client_in_force
from hyperpaint.kernels.arguments import InverseTile, LinePositions, MapCells, Places
from hyperpaint.kernels.rays import fill_between, gather_bilinear, gather_nearest, invert_lines
from hyperpaint.radiometry.counts_to_reflectance import reflectance
from hyperpaint.radiometry.spectral_axis import to_nominal

# smallest and largest distance to the right, then down, from the anchor of axes [m]
Box = tuple[float, float, float, float]

_MIN_ELONGATION = 2.0  # length over width of a track that has a direction of flight
_ROUNDING_CELLS = 1e-6  # overlap of a cell that counts as rounding [cell]


@dataclass(frozen=True)
class Axes:
    # Directions of the columns and rows of a grid, and its anchor.
    #: East and north components of the unit vector to the right. Down is a right angle clockwise from it, so
    #: that a map is never mirrored
    right: tuple[float, float]
    anchor: tuple[float, float]  #: East and north of a point on a corner of cells [m]

    @property
    def down(self) -> tuple[float, float]:
        return self.right[1], -self.right[0]

    def along(self, east: Floats, north: Floats) -> tuple[Floats, Floats]:
        # Return distances of points to the right of, and down from, the anchor [m].
        e, n = east - self.anchor[0], north - self.anchor[1]
        (a, b), (c, d) = self.right, self.down
        return a * e + b * n, c * e + d * n

    def point(self, x: Any, y: Any) -> tuple[Any, Any]:
        # Return east and north of points to the right of, and down from, the anchor [m].
        (a, b), (c, d) = self.right, self.down
        return self.anchor[0] + x * a + y * c, self.anchor[1] + x * b + y * d


#: Axes of a map with north up, whose cells start at whole multiples of their size.
NORTH = Axes((1.0, 0.0), (0.0, 0.0))


@dataclass(frozen=True)
class MapGrid:
    """Square cells on a map.

    Attributes
    ----------
    axes
        Directions and anchor.
    gsd
        Edge of a cell [m].
    first
        Row and column of its first cell, counted from the anchor of the axes.
    shape
        Rows and columns.

    Examples
    --------
    >>> grid = MapGrid(NORTH, 2.0, first=(-50, 10), shape=(30, 20))
    >>> grid.transform
    (20.0, 2.0, 0.0, 100.0, 0.0, -2.0)
    """

    axes: Axes
    gsd: float
    first: tuple[int, int]
    shape: tuple[int, int]

    @property
    def transform(self) -> tuple[float, float, float, float, float, float]:
        """GeoTransform of GDAL: map coordinates of the outer corner of the first cell, and steps."""
        (a, b), (c, d), size = self.axes.right, self.axes.down, self.gsd
        east, north = self._place(0.0, 0.0)
        return (east, size * a, size * c, north, size * b, size * d)

    def _place(self, row: Any, col: Any) -> tuple[Any, Any]:
        return self.axes.point((self.first[1] + col) * self.gsd, (self.first[0] + row) * self.gsd)

    def centres(self, rows: slice, cols: slice) -> tuple[Floats, Floats]:
        """Return east and north of the centres of cells (row, col) [m]."""
        row, col = (np.arange(part.start, part.stop) + 0.5 for part in (rows, cols))
        return self._place(row[:, None], col[None, :])

    @property
    def frame(self) -> Floats:
        """Transform from map coordinates to cells, see `hyperpaint.kernels.rays`."""
        east, north = self._place(0.5, 0.5)
        return np.concatenate([[east, north], np.array([*self.axes.right, *self.axes.down]) / self.gsd])


def covering(axes: Axes, gsd: float, box: Box, *, whole: bool) -> MapGrid:
    # Return the grid over a box of the axes; cells cover it if ``whole``, else their centres do.
    left, right, upper, lower = (edge / gsd for edge in box)
    if whole:
        first = math.floor(upper + _ROUNDING_CELLS), math.floor(left + _ROUNDING_CELLS)
        last = math.ceil(lower - _ROUNDING_CELLS), math.ceil(right - _ROUNDING_CELLS)
    else:
        first = math.ceil(upper - 0.5 - _ROUNDING_CELLS), math.ceil(left - 0.5 - _ROUNDING_CELLS)
        last = math.floor(lower + 0.5 + _ROUNDING_CELLS), math.floor(right + 0.5 + _ROUNDING_CELLS)
    return MapGrid(axes, gsd, first, (max(last[0] - first[0], 1), max(last[1] - first[1], 1)))


def check_cells(problems: Problems, gsd: Any, tile: Any) -> None:
    # Add the faults of the edge of a cell [m], None for the default, and of the cells of a tile's side.
    problems.add_if(
        gsd is not None and not (np.ndim(gsd) == 0 and 0.0 < gsd < np.inf),
        f"gsd {gsd!r:.60}",
        expected="a length above 0 [m]",
        code="value-out-of-range",
    )
    problems.add_if(
        not (isinstance(tile, int | np.integer) and tile > 0),
        f"tile {tile!r:.60}",
        expected="a whole number of cells above 0",
        code="value-out-of-range",
    )


Place = tuple[int, int]  # row and column of a tile


def tile_array(
    label: str,
    tasks: Mapping[Any, Any],
    chunks: tuple[tuple[int, ...], ...],
    dtype: Any,
    sources: Sequence[da.Array],
    options: Any = None,
    shared: Mapping[str, Any] | None = None,
) -> da.Array:
    # Return tasks by the place of their chunk as an array; its name is a hash of sources and options.
    name = f"{label}-{tokenize([source.name for source in sources], chunks, str(dtype), options)}"
    layer = {(name, *place): task for place, task in tasks.items()} | dict(shared or {})
    graph = HighLevelGraph.from_collections(name, layer, dependencies=list(sources))
    return da.Array(graph, name, chunks=chunks, meta=np.empty((0,) * len(chunks), dtype))


# --- the survey of all lines ---------------------------------------------------------------------------


_DIRECTION = SimpleNamespace(
    lines=64,  # sampled for the direction of flight
    sampled_columns=64,  # minimum number sampled for the median spacing of a line
    task_slabs=8,
)
_COLUMNS = 10  # numbers of a line: box (4), ends (4), median spacing across and along (2)


@dataclass(frozen=True)
class Survey:
    """Extent and spacing of every line."""

    #: (line, 4) float64: smallest and largest distance to the right and down along the axes [m]; NaN for a
    #: line without any located pixel
    boxes: Floats
    ends: Floats  #: (line, 2, 2) float64: east and north of its first and last located pixel [m]
    #: Median over lines of the median distance of neighbouring columns, and to the next line [m]
    across: float
    along: float

    @property
    def gsd(self) -> float:
        return float(np.nanmax([self.across, self.along]))

    @property
    def box(self) -> Box:
        low, high = np.nanmin(self.boxes, axis=0), np.nanmax(self.boxes, axis=0)
        return float(low[0]), float(high[1]), float(low[2]), float(high[3])


def direction_of_flight(east: da.Array, north: da.Array) -> Axes:
    # Return axes along the flight, with its direction up, from some lines spread evenly over it.
    #
    # Raises `SchemaError`: No line has a ground position.
    #
    # The direction is the longest axis of the middles of the lines. A track that is hardly longer than wide
    # has no direction; the normal of the lines is used instead.
    count = east.shape[0]
    sampled_lines = np.unique(np.linspace(0, count - 1, _DIRECTION.lines).astype(int))
    first_lines = np.cumsum((0, *east.chunks[0]))
    for lines in (sampled_lines, np.arange(count)):  # all lines, if the sampled lines have no pose
        # east and north of the first and last located pixel of every line (line, 2, 2)
        slabs = np.searchsorted(first_lines, lines, side="right") - 1
        needed_slabs = np.unique(slabs)
        surveyed = _computed_survey(east, north, [[slab] for slab in needed_slabs.tolist()], NORTH, None)
        ends = np.concatenate(
            [
                table[lines[slabs == slab] - first_lines[slab], 4:8]
                for slab, (table, _) in zip(needed_slabs, surveyed, strict=True)
            ]
        ).reshape(-1, 2, 2)
        ends = ends[np.isfinite(ends).all(axis=(1, 2))]
        if len(ends):
            break
    _refuse_unlocated(not len(ends))
    left, right = ends[:, 0], ends[:, 1]
    middles = (left + right) / 2
    _, spread, directions = np.linalg.svd(middles - middles.mean(axis=0), full_matrices=False)
    flight = directions[0]
    if len(middles) < 3 or not spread[0] > _MIN_ELONGATION * spread[1]:
        across = (right - left).mean(axis=0)
        flight = np.array([-across[1], across[0]]) if np.hypot(*across) > 0.0 else np.array([0.0, 1.0])
    if flight @ (middles[-1] - middles[0]) < 0.0:
        flight = -flight
    heading = math.atan2(flight[0], flight[1])
    return Axes((math.cos(heading), -math.sin(heading)), (float(middles[0, 0]), float(middles[0, 1])))


def survey_lines(east: da.Array, north: da.Array, axes: Axes, progress: Progress | None) -> Survey:
    # Return extent and spacing of every line (eager).
    #
    # Raises `SchemaError`: No pixel has a ground position.
    slabs = range(east.numblocks[0])
    groups = [list(slabs[first : first + _DIRECTION.task_slabs]) for first in slabs[:: _DIRECTION.task_slabs]]
    surveyed = _computed_survey(east, north, groups, axes, progress)
    table = np.concatenate([rows for rows, _ in surveyed])
    for (_, (_, last_pixels)), (_, (first_pixels, _)), start in zip(
        surveyed, surveyed[1:], np.cumsum([len(rows) for rows, _ in surveyed]), strict=False
    ):
        table[start - 1, 9] = _median(np.hypot(*(first_pixels - last_pixels)))
    _refuse_unlocated(np.isnan(table[:, :4]).all() or np.isnan(table[:, 8:]).all())
    across, along = (_median(table[:, column]) for column in (8, 9))
    return Survey(table[:, :4], table[:, 4:8].reshape(-1, 2, 2), across, along)


def _refuse_unlocated(is_unlocated: object) -> None:
    SchemaError.raise_if(
        is_unlocated,
        "no two neighbouring pixels have ground positions, so there is nothing to map",
        mend="compare the poses with the height of the ground or the extent of the DEM (flag off_swath)",
        code="ground-not-seen",
    )


def _computed_survey(
    east: da.Array, north: da.Array, groups: list[list[int]], axes: Axes, progress: Progress | None
) -> list[Any]:
    # Survey groups of consecutive slabs; progress is reported where the scheduler supports it.
    # One array holds all tasks: a collection per slab would take longer than the survey.
    tasks = {
        (k,): (
            _survey_of_slabs,
            *([(positions.name, slab, 0) for slab in group] for positions in (east, north)),
            axes,
        )
        for k, group in enumerate(groups)
    }
    lazy = tile_array("survey", tasks, ((1,) * len(groups),), object, [east, north], (groups, axes))
    if progress is None:
        return list(lazy.compute())
    pending = {(lazy.name, k): group for k, group in enumerate(groups)}
    slabs = sum(map(len, groups))

    def report(key: Any, *_: Any) -> None:
        if pending.pop(key, None) is not None:
            progress(slabs - sum(map(len, pending.values())), slabs)

    # schedulers of a cluster do not call `report`; then only the end is reported
    with Callback(posttask=report):
        surveyed = list(lazy.compute())
    if pending:
        progress(slabs, slabs)
    return surveyed


def _survey_of_slabs(easts: list[Floats], norths: list[Floats], axes: Axes) -> Array:
    # Return survey rows of slabs (line, `_COLUMNS`), and their first and last pixels, as an array of one
    # object.
    from hyperpaint.kernels.rays import look_at_lines

    out = np.full((sum(map(len, easts)), _COLUMNS), np.nan)
    frame = np.array([*axes.anchor, *axes.right, *axes.down])
    start = 0
    for east, north in zip(easts, norths, strict=True):
        look_at_lines(east, north, frame, out[start : start + len(east)])
        start += len(east)
    step = max(1, easts[0].shape[1] // _DIRECTION.sampled_columns)
    sampled, next_columns = (
        np.stack([np.concatenate([part[:, first::step] for part in parts]) for parts in (easts, norths)])
        for first in (0, 1)
    )
    out[:, 8] = _medians(np.hypot(*(next_columns - sampled[:, :, : next_columns.shape[2]])))
    out[:-1, 9] = _medians(np.hypot(*np.diff(sampled, axis=1)))
    result = np.empty(1, object)
    result[0] = out, (sampled[:, 0].copy(), sampled[:, -1].copy())
    return result


def _medians(steps: Floats) -> Floats:
    if not steps.shape[1] or not np.isnan(steps).any():
        return np.median(steps, axis=1) if steps.size else np.full(len(steps), np.nan)
    return np.array([_median(row) for row in steps])


def _median(values: Floats) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else np.nan


# --- pixel of a line at every cell of a tile --------------------------------------------------------------


Window = tuple[slice, slice]  # rows and columns of a tile
Windows = tuple[list[slice], list[slice]]  # rows of the rows of tiles, and columns of the columns of tiles

RULES = ("nadir", "first", "last")  # choice among several positions, in the order of the kernel's numbers


@dataclass(frozen=True)
class Plan:
    # Settings that all tiles share.
    grid: MapGrid
    rule: int  #: Position in `RULES`
    longest: float  #: Longest edge of a patch of four pixels [cell]
    last: int  #: Number of the last line
    #: Largest relative shift of neighbouring pixels by their heights without hidden ground [m]
    parallax: float
    #: (pair, 4, 2) float64: east and north of the corners of the area between every located line and the next
    #: located line, in order around it [m]
    between: Floats


@dataclass(frozen=True)
class TileIndex:
    # Positions in the line at the cells of a tile.
    line: Floats  #: (row, col) float64: as fractions; NaN where no patch covers a cell
    sample: Floats
    #: (row, col) int32: nearest of the four pixels around the position; -1 in uncovered cells
    nearest_line: Array
    nearest_sample: Array
    hits: Array  #: (row, col) uint16: patches over a cell


@dataclass(frozen=True)
class Reading:
    """Pixels of a tile in the order of reading, and the cells they fill."""

    shape: tuple[int, int]  #: Rows and columns of the tile
    #: (place,) int64: covered cells, numbered row by row, in the order of their lines
    cells: Ints
    lines: Ints  #: (place,) int64: pixel to read; for interpolation, the pixel before the position
    columns: Ints
    #: (place,) float64: fraction towards the next line and column; empty without interpolation
    along: Floats
    across: Floats


def needed_slabs(
    survey: Survey, grid: MapGrid, chunks: Sequence[int], windows: Windows
) -> dict[Place, list[int]]:
    # Return the slabs of lines that cover each tile; ``chunks`` are the lines of every slab.
    ends = np.cumsum(chunks)
    cells = survey.boxes / grid.gsd - np.repeat([grid.first[1], grid.first[0]], 2) - 0.5
    low, high = np.fmin(cells[:-1], cells[1:]), np.fmax(cells[:-1], cells[1:])
    # a patch needs both of its lines
    is_placed = np.isfinite(cells[:-1, 0]) & np.isfinite(cells[1:, 0])
    needed = {}
    for row, row_slice in enumerate(windows[0]):
        pairs = np.flatnonzero(
            is_placed & (high[:, 3] >= row_slice.start - 1) & (low[:, 2] <= row_slice.stop)
        )
        for col, col_slice in enumerate(windows[1]):
            covering_pairs = pairs[
                (high[pairs, 1] >= col_slice.start - 1) & (low[pairs, 0] <= col_slice.stop)
            ]
            needed[row, col] = np.unique(
                np.searchsorted(ends, np.concatenate([covering_pairs, covering_pairs + 1]), side="right")
            ).tolist()
    return needed


def index_tile(
    plan: Plan,
    rows: slice,
    cols: slice,
    starts: Sequence[int],
    east: Sequence[Floats],
    north: Sequence[Floats],
    *relief: Sequence[Floats],
) -> TileIndex:
    # Return the positions in the line at the cells of a tile.
    #
    # ``starts`` are the first lines of the slabs, whose pixels lie at ``east`` and ``north`` (line, column);
    # ``relief``, if available, are the height of the ground [m] and the tangent of the view zenith angle:
    # between pixels of very different height lies ground that neither shows.
    shape = rows.stop - rows.start, cols.stop - cols.start
    position, nearest = np.full((2, *shape), np.nan), np.full((2, *shape), -1, np.int32)
    rank, hits = np.full(shape, np.inf), np.zeros(shape, np.uint16)
    out = InverseTile(position, nearest, rank, hits)
    cells = MapCells(plan.grid.frame, (rows.start, cols.start), plan.longest, plan.rule)
    next_start, line_before = -1, [np.empty(0)] * (2 + len(relief))
    for start, *slab in zip(starts, east, north, *relief, strict=True):
        if start != next_start:
            line_before = [np.full(slab[0].shape[1], np.nan)] * len(slab)
        e, n, *surface = (np.ascontiguousarray(part) for part in slab)
        hidden = (
            hidden_between(surface[0], surface[1], line_before[2:], plan.parallax)
            if surface
            else np.zeros((0, 0), bool)
        )
        invert_lines(
            LinePositions(e, n, line_before[0], line_before[1], hidden), start, plan.last, cells, out
        )
        line_before, next_start = [e[-1], n[-1], *(part[-1] for part in surface)], start + len(e)
    return TileIndex(position[0], position[1], nearest[0], nearest[1], hits)


def hidden_between(height: Floats, tangent: Floats, before: Sequence[Floats], parallax: float) -> Bools:
    # Return where ground is hidden between pixels and those of the line before (line, column - 1).
    #
    # ``height`` [m] and ``tangent`` of the zenith angle (line, column) belong to consecutive lines,
    # ``before`` (column,) to the line before. For four pixels that span a patch, the difference of heights
    # times the tangent is their shift on the map against the line of sight of their neighbours. It exceeds
    # the pixel spacing only where the surface falls away steeper than the line of sight; on a visible wall it
    # equals the spacing.
    heights, tangents = (
        np.concatenate([first[None], lines]) for first, lines in zip(before, (height, tangent), strict=True)
    )

    def of_patches(reduce: np.ufunc, values: Floats) -> Floats:
        of_pairs = reduce(values[:-1], values[1:])
        return np.asarray(reduce(of_pairs[:, :-1], of_pairs[:, 1:]))

    drop = of_patches(np.maximum, heights) - of_patches(np.minimum, heights)
    return np.asarray(drop * of_patches(np.maximum, tangents) > parallax)


def gaps_of(plan: Plan, rows: slice, cols: slice, index: TileIndex) -> Array:
    # Return the uncovered cells between the ends of lines (row, col).
    frame = plan.grid.frame
    is_between: Bools = np.zeros(index.hits.shape, bool)
    offset = plan.between - frame[:2]
    is_near = np.ones(len(offset), bool)
    for (a, b), cells in ((frame[2:4], cols), (frame[4:6], rows)):
        coordinate = np.asarray(a * offset[..., 0] + b * offset[..., 1])
        is_near &= (coordinate.max(axis=1) >= cells.start) & (coordinate.min(axis=1) <= cells.stop - 1)
    fill_between(plan.between[is_near], frame, (rows.start, cols.start), is_between)
    return np.asarray(is_between & (index.hits == 0))


def reading_of(index: TileIndex, bilinear: bool) -> Reading:
    # Return the reading order of the pixels of a tile: the nearest pixels, or those before each place.
    positions = (index.line, index.sample) if bilinear else (index.nearest_line, index.nearest_sample)
    cells = np.flatnonzero(index.hits)
    line, sample = (part.ravel()[cells] for part in positions)
    order = np.argsort(line, kind="stable")
    line, sample = line[order], sample[order]
    lines, columns = line.astype(np.int64), sample.astype(np.int64)
    along, across = (
        np.asarray(position - whole if bilinear else [], np.float64)
        for position, whole in ((line, lines), (sample, columns))
    )
    return Reading(index.hits.shape, cells[order], lines, columns, along, across)


# --- values of a tile ----------------------------------------------------------------------------------


def map_spectra(reading: Reading, starts: Sequence[int], slabs: Sequence[Array], empty: Any) -> Array:
    # Return spectra (row, col, band) from slabs (line, band, column) that begin at the lines ``starts``.
    #
    # Uncovered cells get ``empty``, whose type the result has.
    bands, columns = slabs[0].shape[1:]
    bilinear = reading.along.size > 0
    dtype = np.asarray(empty).dtype
    out = np.empty((reading.shape[0] * reading.shape[1], bands), dtype)
    if reading.cells.size < len(out):
        is_uncovered = np.ones(len(out), bool)
        is_uncovered[reading.cells] = False
        out[is_uncovered] = empty
    buffer = np.empty((columns, bands), dtype)
    for slab, start, is_slab in _by_slab(reading, starts, slabs):
        pixel = reading.lines[is_slab] - start, reading.columns[is_slab]
        block = np.ascontiguousarray(slabs[slab])
        if not bilinear:
            gather_nearest(block, *pixel, reading.cells[is_slab], buffer, out)
            continue
        fractions = reading.along[is_slab].astype(dtype), reading.across[is_slab].astype(dtype)
        next_line = _line_after(starts, slabs, slab)
        positions = Places(*pixel, *fractions, reading.cells[is_slab])
        gather_bilinear(block, next_line, positions, buffer, np.empty_like(buffer), out)
    return out.reshape(*reading.shape, bands)


def plane_values(
    reading: Reading, starts: Sequence[int], slabs: Sequence[Array], flags: bool, empty: Any
) -> Array:
    # Return values (row, col) of slabs (line, column), see `map_spectra`.
    #
    # With ``flags`` the bits of the four pixels of an interpolation are combined by OR.
    out = np.full(reading.shape[0] * reading.shape[1], empty, slabs[0].dtype)
    for slab, start, is_slab in _by_slab(reading, starts, slabs):
        line, column, cells = reading.lines[is_slab] - start, reading.columns[is_slab], reading.cells[is_slab]
        if not reading.along.size:
            out[cells] = slabs[slab][line, column]
            continue
        along, across = reading.along[is_slab], reading.across[is_slab]
        lines = np.concatenate([slabs[slab], _line_after(starts, slabs, slab)[None]])
        # a pixel at distance 0 needs no neighbour
        corners = ((0, 0), (0, 1), (1, 0), (1, 1))
        corner_values = [lines[line + i * (along > 0), column + j * (across > 0)] for i, j in corners]
        if flags:
            out[cells] = corner_values[0] | corner_values[1] | corner_values[2] | corner_values[3]
        else:
            before = corner_values[0] + across * (corner_values[1] - corner_values[0])
            after = corner_values[2] + across * (corner_values[3] - corner_values[2])
            out[cells] = before + along * (after - before)
    return out.reshape(reading.shape)


def nearest_values(index: TileIndex, values: Array, of_lines: bool, empty: Any) -> Array:
    # Return values (row, col) of the nearest line or column, from one value per line or column.
    pixel = index.nearest_line if of_lines else index.nearest_sample
    return np.where(pixel >= 0, values[np.maximum(pixel, 0)], np.asarray(empty, values.dtype))


def _by_slab(
    reading: Reading, starts: Sequence[int], slabs: Sequence[Array]
) -> Iterator[tuple[int, int, slice]]:
    # Yield every slab with pixels to read, its first line, and the range of these pixels.
    edges = np.searchsorted(reading.lines, [*starts, starts[-1] + len(slabs[-1])])
    for slab, start in enumerate(starts):
        pixels = slice(int(edges[slab]), int(edges[slab + 1]))
        if pixels.stop > pixels.start:
            yield slab, start, pixels


def _line_after(starts: Sequence[int], slabs: Sequence[Array], slab: int) -> Array:
    # Return the first line of the next slab, or the last line of this slab if the next one is not read.
    is_consecutive = slab + 1 < len(slabs) and starts[slab + 1] == starts[slab] + len(slabs[slab])
    return np.ascontiguousarray(slabs[slab + 1][0] if is_consecutive else slabs[slab][-1])


def tile_windows(shape: tuple[int, int], tile: int) -> Windows:
    rows, cols = ([slice(k, min(k + tile, size)) for k in range(0, size, tile)] for size in shape)
    return rows, cols


@dataclass(frozen=True)
class Tiles:
    # The tiles of a map, and the slabs that each of them reads.
    grid: MapGrid
    windows: Windows  #: Cells of the tiles
    slabs: dict[Place, list[int]]  #: Slabs of lines that each tile reads
    starts: tuple[int, ...]  #: First line of every slab
    #: The `TileIndex` of every tile, lazy, as an array with one object per tile, and its gaps (row, col)
    index: da.Array
    gap: da.Array
    #: The `Reading` of every tile: of the nearest pixels, and of the pixels before positions
    nearest: da.Array
    before: da.Array
    bilinear: bool  #: Whether values are interpolated

    @classmethod
    def of(
        cls,
        plan: Plan,
        windows: Windows,
        slabs: dict[Place, list[int]],
        places: Sequence[da.Array],
        *,
        bilinear: bool,
    ) -> "Tiles":
        # Return tiles whose index follows from the places of pixels: see `index_tile`.
        starts = tuple(np.cumsum((0, *places[0].chunks[0][:-1])).tolist())
        shared = {f"orthorectification-plan-{tokenize(plan)}": plan}
        key = next(iter(shared))
        tasks: dict[Place, Any] = {}
        for place, (rows, cols) in _tiles_of(windows):
            first = [starts[slab] for slab in slabs[place]]
            read = [[(of.name, slab, 0) for slab in slabs[place]] for of in places]
            tasks[place] = (index_tile, key, rows, cols, first, *read)
        single = tuple((1,) * len(part) for part in windows)
        index = tile_array("map-index", tasks, single, object, places, plan, shared)
        gaps = {p: (gaps_of, key, *window, (index.name, *p)) for p, window in _tiles_of(windows)}
        gap = tile_array("map-gap", gaps, _chunks(windows), np.bool_, [index], plan, shared)
        nearest, before = (
            tile_array(
                "map-reading",
                {place: (reading_of, (index.name, *place), between) for place, _ in _tiles_of(windows)},
                single,
                object,
                [index],
                between,
            )
            for between in (False, True)
        )
        return cls(plan.grid, windows, slabs, starts, index, gap, nearest, before, bilinear)

    def part(self, name: str, dtype: Any) -> da.Array:
        tasks = {place: (getattr, (self.index.name, *place), name) for place, _ in _tiles_of(self.windows)}
        return tile_array(f"map-{name}", tasks, _chunks(self.windows), dtype, [self.index])

    def centres(self) -> tuple[da.Array, da.Array]:
        east, north = (
            tile_array(
                f"map-{name}",
                {
                    place: (getitem, (MapGrid.centres, self.grid, *window), part)
                    for place, window in _tiles_of(self.windows)
                },
                _chunks(self.windows),
                np.float64,
                [],
                (self.grid,),
            )
            for part, name in enumerate(("east", "north"))
        )
        return east, north

    def tiles_of(
        self,
        label: str,
        function: Callable[..., Array],
        index_array: da.Array,
        source: da.Array,
        options: tuple[Any, ...],
        bands: tuple[int, ...] = (),
    ) -> da.Array:
        # Return tiles (row, col[, band]) that ``function`` computes from an index or readings, and a source.
        #
        # The source is a cube (line, band, column) or plane (line, column) in chunks of the slabs, or one
        # value per line or column in one chunk; the result has the type of the last option.
        tasks: dict[tuple[int, ...], Any] = {}
        dtype = np.asarray(options[-1]).dtype
        for place, (rows, cols) in _tiles_of(self.windows):
            needed = self.slabs[place]
            key = (*place, *(0 for _ in bands))
            if not needed:
                shape = [rows.stop - rows.start, cols.stop - cols.start, *bands]
                tasks[key] = (np.full, shape, options[-1], dtype)
                continue
            inputs: list[Any] = [(source.name, 0)]
            if source.ndim > 1:
                blocks = [(source.name, slab, *(0,) * (source.ndim - 1)) for slab in needed]
                inputs = [[self.starts[slab] for slab in needed], blocks]
            tasks[key] = (function, (index_array.name, *place), *inputs, *options)
        chunks = (*_chunks(self.windows), *((size,) for size in bands))
        return tile_array(label, tasks, chunks, dtype, [index_array, source], options)


def _chunks(windows: Windows) -> tuple[tuple[int, ...], ...]:
    return tuple(tuple(cells.stop - cells.start for cells in part) for part in windows)


def _tiles_of(windows: Windows) -> Iterator[tuple[Place, Window]]:
    rows, cols = (list(enumerate(part)) for part in windows)
    return (((row, col), (row_cells, col_cells)) for row, row_cells in rows for col, col_cells in cols)


# --- variables of the map, and values of empty cells ---------------------------------------------------


_PRODUCTS = ("reflectance", "radiance")
_BY_DEFAULT = ("quality", "time", "irradiance_age", "view_zenith", "view_azimuth", "ground_height")
_RENAMED = {"time": "line_time"}
# angles that wrap at 360 or 180 degrees and cannot be interpolated
_WRAPPING = ("view_azimuth", "sun_azimuth", "heading", "longitude")
_PIXEL = (ALONG_TRACK, CROSS_TRACK)


def prepared(line: xr.Dataset, variables: Iterable[str] | None) -> tuple[xr.Dataset, list[str]]:
    # Return a line with spectra at nominal wavelengths, and the names of the variables to map.
    #
    # By default reflectance, else radiance; from counts alone reflectance is computed.
    #
    # Raises `SchemaError`: Variables that are missing, of dims that a map lacks, or of types other than
    # numbers, flags and times; all are listed. Or reflectance is missing and cannot be computed. Raises
    # `UnitsError`: As `hyperpaint.reflectance`.
    if isinstance(variables, str):
        variables = (variables,)
    if variables is None:
        product = [name for name in _PRODUCTS if name in line.variables][:1]
        if not product and "counts" in line.variables:
            line, product = reflectance(line), ["reflectance"]
        names = [*product, *(name for name in _BY_DEFAULT if name in line.variables)]
    else:
        names = list(dict.fromkeys(variables))
    with Problems("these variables cannot be mapped", SchemaError) as problems:
        for name in names:
            if name not in line.variables:
                expected = f"{', '.join(sorted(map(str, line.variables))):.400}"
                problems.add(f"{name!r} is missing", expected=expected, code="variable-missing")
                continue
            dims, dtype = line[name].dims, line[name].dtype
            if set(dims) not in ({*CUBE}, {*_PIXEL}, {ALONG_TRACK}, {CROSS_TRACK}):
                problems.add(
                    f"{name!r} ({', '.join(map(str, dims)) or 'a scalar'}) cannot be mapped",
                    expected="along_track or cross_track",
                    code="dim-missing",
                )
            elif _native(dtype) is None or (BAND in dims and dtype.kind == "M"):
                expected = "numbers" if BAND in dims else "numbers, flags or times"
                problems.add(f"{name!r} is {dtype}", expected=expected, code="type-wrong")
    # compare .str: numpy treats types of either byte order as equal
    native = {name: _native(line[name].dtype) for name in names}
    converted = {
        name: line[name].astype(dtype)
        for name, dtype in native.items()
        if dtype is not None and dtype.str != line[name].dtype.str
    }
    coords = {name: converted.pop(name) for name in native if name in line.coords and name in converted}
    line = line.assign(converted).assign_coords(coords)
    spectra = [name for name in names if name in _PRODUCTS]
    if spectra and "wavelength_shift" in line.variables:
        line = line.assign({name: to_nominal(line)[name] for name in spectra})
    return line, names


def _native(dtype: np.dtype[Any]) -> np.dtype[Any] | None:
    # Return the dtype in native byte order, with half floats as float32; None for unsupported types.
    floats = np.dtype(np.float64 if dtype.itemsize > 4 else np.float32)
    return floats if dtype.kind == "f" else dtype.newbyteorder("=") if dtype.kind in "biuM" else None


def empty_value(name: str, dtype: np.dtype[Any]) -> Any:
    # Return the value of an uncovered cell.
    #
    # NaN or NaT; ``off_swath`` for ``quality``; for integers -1, or the largest of an unsigned type.
    if name == "quality":
        return np.uint16(Quality.OFF_SWATH)
    if dtype.kind == "M":
        return np.datetime64("NaT", "ns")
    if dtype.kind == "f":
        return dtype.type(np.nan)
    return dtype.type(-1 if dtype.kind == "i" else 0 if dtype.kind == "b" else np.iinfo(dtype).max)


def mapped(line: xr.Dataset, names: Sequence[str], tiles: Tiles, lines: tuple[int, ...]) -> dict[str, Any]:
    # Return the variables of a `prepared` line on a map, by new name; ``lines`` is the number per slab.
    variables = {}
    for name in names:
        source = line[name]
        if BAND in source.dims:
            is_mixed = tiles.bilinear and source.dtype.kind != "f"
            empty = empty_value(name, np.dtype(np.float32) if is_mixed else source.dtype)
            cube = in_slabs(source.transpose(*CUBE), lines)
            reading = tiles.before if tiles.bilinear else tiles.nearest
            values = tiles.tiles_of("map-cube", map_spectra, reading, cube, (empty,), cube.shape[1:2])
        else:
            source = source.astype("datetime64[ns]") if source.dtype.kind == "M" else source
            empty = empty_value(name, source.dtype)
            is_flags = "flag_masks" in source.attrs or name == "quality"
            is_between = is_flags or (source.dtype.kind == "f" and name not in _WRAPPING)
            if source.ndim == 2:
                plane = in_slabs(source.transpose(*_PIXEL), lines)
                reading = tiles.before if tiles.bilinear and is_between else tiles.nearest
                # flags of all pixels are joined
                options = (is_flags, empty)
                values = tiles.tiles_of("map-plane", plane_values, reading, plane, options)
            else:
                row = source.chunk({source.dims[0]: -1}).data
                options = (source.dims == (ALONG_TRACK,), empty)
                values = tiles.tiles_of("map-nearest", nearest_values, tiles.index, row, options)
        attrs = {**line[name].attrs, "grid_mapping": "spatial_ref"}
        array = xr.DataArray(values, dims=("y", "x", BAND)[: values.ndim], attrs=attrs)
        if name == "quality":
            array = label(array, name, **attrs)
        elif values.dtype.kind in "iu":
            array.attrs["empty_value"] = empty_value(name, values.dtype)
        variables[_RENAMED.get(name, name)] = array
    return variables


class _InMemory:
    # Wrapper of an array that dask neither copies nor hashes.
    def __init__(self, array: Array) -> None:
        self._array = array
        self.shape, self.dtype, self.ndim = array.shape, array.dtype, array.ndim

    def __getitem__(self, key: Any) -> Any:
        return self._array[key]


def in_slabs(array: xr.DataArray, lines: tuple[int, ...]) -> da.Array:
    chunks: dict[Any, Any] = {dim: lines if dim == ALONG_TRACK else -1 for dim in array.dims}
    values = array.variable._data
    if not isinstance(values, np.ndarray):
        lazy: da.Array = array.chunk(chunks).data
        return lazy
    return in_memory(values, f"in-memory-{uuid.uuid4().hex}", tuple(chunks.values()))


def in_memory(values: Array, name: str, chunks: tuple[Any, ...]) -> da.Array:
    # Return an array in memory as a dask array, whose chunks are views of it.
    return da.from_array(
        _InMemory(values), chunks, name, asarray=False, meta=np.empty((0,) * values.ndim, values.dtype)
    )


_GRIDS = ("north", "flight")
_METHODS = ("nearest", "bilinear")
_TILING = SimpleNamespace(
    relief=("ground_height", "view_zenith"),
    # Largest relative shift of neighbouring pixels by their heights without hidden ground [spacing across].
    # On a visible wall it is 1, whatever its height. With 1.25, a sixth of the hidden cells behind cars is
    # shown; with 0.6, as many as with 1.05, and more visible ground is lost (support/hidden_ground.py).
    max_parallax_px=1.05,
    max_tiles=100_000,  # a larger graph takes minutes and gigabytes before anything is computed
)
# dim of the flight line along which positions are counted
_AXES = {
    "glt_line": ALONG_TRACK,
    "nearest_line": ALONG_TRACK,
    "glt_sample": CROSS_TRACK,
    "nearest_sample": CROSS_TRACK,
}
_MAX_KEPT_BYTES = 64 * 2**20  # positions kept from the survey for the tiles: 6,500 lines of 640 columns


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

    Warns
    -----
    PaintWarning
        The line lies outside of ``bounds``, or is smaller than a cell.

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
    with Problems("this line cannot be orthorectified", SchemaError) as problems:
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
    SchemaError.raise_if(
        is_located(line) and location,
        f"this line is located already, so {', '.join(f'{name}=' for name in location)} would have no effect",
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
    # the box and the swath (smallest to the right, largest, smallest down, largest), without a border pixel
    swath, margin = survey.box, survey.gsd
    width, height = swath[1] - swath[0], swath[3] - swath[2]
    warn_if(
        any(box[k] > swath[k + 1] + margin or box[k + 1] < swath[k] - margin for k in (0, 2))
        or size > max(width, height) + margin,
        f"the map misses the flight line of {width:.3g} x {height:.3g} m, which lies outside the bounds or "
        f"is smaller than a cell of {size:g} m; check gsd= and bounds=",
        "map-empty",
    )
    cells = covering(axes, size, box, whole=bounds is not None)
    rows, cols = cells.shape
    count = -(-rows // tile) * -(-cols // tile)
    SchemaError.raise_if(
        count > _TILING.max_tiles,
        f"a map of {rows} x {cols} cells of {cells.gsd:g} m is {count} tiles of {tile} x {tile}",
        expected=f"at most {_TILING.max_tiles}",
        mend="give a larger gsd, bounds, or a larger tile",
        option="give a larger --gsd",
        code="map-too-large",
    )
    windows = tile_windows(cells.shape, tile)
    # the areas between the ends of consecutive located lines (pair, 4, 2)
    ends = survey.ends[np.isfinite(survey.ends).all(axis=(1, 2))]
    plan = Plan(
        cells,
        RULES.index(multi_hit),
        max_stretch * max(1.0, survey.gsd / cells.gsd),
        line.sizes[ALONG_TRACK] - 1,
        _TILING.max_parallax_px * survey.across,
        np.stack([ends[:-1, 0], ends[:-1, 1], ends[1:, 1], ends[1:, 0]], axis=1),
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
    chunks: tuple[int, ...] = normalize_chunks(CHUNK_LINES, (line.sizes[ALONG_TRACK],))[0]
    return chunks


def _positions(line: xr.Dataset, lines: tuple[int, ...]) -> tuple[list[da.Array], str | None]:
    # Return east and north [m], over relief also heights and tangents of zenith angles; and the CRS.
    coordinates = require(line, ["east", "north"], "a map")
    SchemaError.raise_if(
        min(coordinates["east"].shape) < 2,
        f"{line.attrs.get('name', 'the line')}: scan lines and columns are "
        "{} x {}, too few for a map".format(*coordinates["east"].shape),
        expected="two or more of each",
        code="line-too-short",
    )
    crs = coordinates["east"].attrs.get("crs")
    # a line located on level ground has its height as an attribute
    is_level = isinstance(line.attrs.get("ground"), int | float)
    relief = []
    if not is_level and set(_TILING.relief) <= set(line.variables):
        surface = require(line, _TILING.relief, "a map without hidden ground")
        height, zenith = (in_slabs(surface[name], lines).astype(np.float64) for name in _TILING.relief)
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
    reference: dict[str, Any] = {}
    if crs is not None:
        has_crs = "spatial_ref" in line.variables and "crs_wkt" in line["spatial_ref"].attrs
        reference = line["spatial_ref"].attrs if has_crs else grid_mapping_attrs(crs_of(crs))
    crs_attrs = {} if crs is None else {"crs": crs}
    axes = {
        name: {
            "units": "m",
            "standard_name": f"projection_{name}_coordinate",
            "axis": name.upper(),
            "long_name": f"Map coordinate to the {direction}",
            **crs_attrs,
        }
        for name, direction in (("x", "east"), ("y", "north"))
    }
    coordinates = grid_coordinates(tiles.grid, reference, axes)
    if tiles.grid.axes.right == (1.0, 0.0):
        return coordinates
    # x and y would be distances from a corner, which other programs would read as map coordinates near 0, 0
    return {"spatial_ref": coordinates["spatial_ref"]} | {
        name: label(xr.DataArray(lazy, dims=("y", "x")), name, **crs_attrs)
        for name, lazy in zip(("east", "north"), tiles.centres(), strict=True)
    }


def grid_coordinates(
    grid: MapGrid, reference: Mapping[Any, Any], axes: Mapping[str, Mapping[Any, Any]]
) -> dict[str, Any]:
    # Return the coordinates x, y and spatial_ref of a grid with north up.
    #
    # ``reference`` are attributes of the CRS; ``axes`` attributes of x and y.
    east, _ = grid.centres(slice(0, 1), slice(0, grid.shape[1]))
    _, north = grid.centres(slice(0, grid.shape[0]), slice(0, 1))
    transform = " ".join(repr(float(number)) for number in grid.transform)
    return {
        "spatial_ref": ((), np.int64(0), {**reference, "GeoTransform": transform}),
        "x": ("x", east[0], axes["x"]),
        "y": ("y", north[:, 0], axes["y"]),
    }


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
    found = [
        text.format(attrs[name], low, high)
        for name, low, high, is_checked, text in (
            (
                "height_above_ground", MIN_HEIGHT_M, MAX_HEIGHT_M, True,
                "the camera is {:.4g} m above the ground, expected {:g} to {:g} m "
                "(ground is above the ellipsoid, not above the sea)",
            ),
            (
                "swath", MIN_SWATH_M, MAX_SWATH_M, is_complete,
                "the swath is {:.3g} m wide, expected {:g} to {:g} m",
            ),
            (
                "pixel_aspect", 1 / MAX_ASPECT, MAX_ASPECT, is_complete,
                "pixels are {:.3g} times as long as wide, expected {:g} to {:g}",
            ),
        )
        if name in attrs and is_checked and not low <= attrs[name] <= high
    ]  # fmt: skip
    name = line.attrs.get("name", "this line")
    warn_if(found, f"{name}: {'; '.join(found)}; check ground and camera", "swath-implausible")
    return attrs


def describe_swath(attrs: dict[Any, Any]) -> str:
    # Return the attributes of `swath_attrs`, and the heights and angles used, as one line of text.
    units = {
        "height_above_ground": "{:.1f} m above the ground",
        "swath": "swath {:.1f} m",
        "pixel_aspect": "pixels {:.2f} times as long as wide",
    }
    texts = [text.format(attrs[name]) for name, text in units.items() if name in attrs]
    return ", ".join([*texts, *([attrs["location_from"]] if "location_from" in attrs else [])])
