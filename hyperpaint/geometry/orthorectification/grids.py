"""Cells of a map, and the survey of all lines that decides its extent.

The survey keeps a few numbers per line, so that it needs the memory of a few slabs, whatever the length of
the flight.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import dask.array as da
import numpy as np
from dask.base import tokenize
from dask.callbacks import Callback
from dask.highlevelgraph import HighLevelGraph

from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.schema import Array, Floats, Progress

# smallest and largest distance to the right, then down, from the anchor of axes [m]
Box = tuple[float, float, float, float]

_MIN_ELONGATION = 2.0  # length over width of a track that has a direction of flight
_ROUNDING_CELLS = 1e-6  # overlap of a cell that counts as rounding [cell]


@dataclass(frozen=True)
class Axes:
    """Directions of the columns and rows of a grid, and its anchor."""

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


_DIRECTION_LINES = 64  # sampled for the direction of flight
_SAMPLED_COLUMNS = 64  # minimum number sampled for the median spacing of a line
_TASK_SLABS = 8
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
    sampled_lines = np.unique(np.linspace(0, count - 1, _DIRECTION_LINES).astype(int))
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
    else:
        raise _nothing_located()
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
    groups = [list(slabs[first : first + _TASK_SLABS]) for first in slabs[::_TASK_SLABS]]
    surveyed = _computed_survey(east, north, groups, axes, progress)
    table = np.concatenate([rows for rows, _ in surveyed])
    for (_, (_, last_pixels)), (_, (first_pixels, _)), start in zip(
        surveyed, surveyed[1:], np.cumsum([len(rows) for rows, _ in surveyed]), strict=False
    ):
        table[start - 1, 9] = _median(np.hypot(*(first_pixels - last_pixels)))
    if np.isnan(table[:, :4]).all() or np.isnan(table[:, 8:]).all():
        raise _nothing_located()
    across, along = (_median(table[:, column]) for column in (8, 9))
    return Survey(table[:, :4], table[:, 4:8].reshape(-1, 2, 2), across, along)


def _nothing_located() -> SchemaError:
    return SchemaError(
        "no two neighbouring pixels have ground positions, so there is nothing to map",
        mend="look at the poses and at the quality's off_swath",
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
    step = max(1, easts[0].shape[1] // _SAMPLED_COLUMNS)
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
