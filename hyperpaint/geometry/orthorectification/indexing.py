"""Which place of a flight line lies at every cell of a tile."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Array, Floats, Ints

from .grids import MapGrid
from .surveys import Survey

__all__ = [
    "RULES",
    "Plan",
    "Reading",
    "TileIndex",
    "Window",
    "areas_between",
    "gaps_of",
    "index_tile",
    "needed_slabs",
    "reading_of",
]

Window = tuple[slice, slice]
"""Rows and columns of a tile."""

RULES = ("nadir", "first", "last")
"""Which of several places of the line counts, in the order of the kernel's numbers."""


@dataclass(frozen=True)
class Plan:
    """What all tiles share.

    Attributes
    ----------
    grid
        How the cells lie.
    rule
        Position in `RULES`.
    longest
        Edge from which four pixels do not span a patch [cell].
    last
        Number of the last line.
    between : (pair, 4, 2), float64
        East and north of the corners of the area from every line that has a place to the next that has,
        around it [m].
    """

    grid: MapGrid
    rule: int
    longest: float
    last: int
    between: Floats


@dataclass(frozen=True)
class TileIndex:
    """The places of the line at the cells of a tile.

    Attributes
    ----------
    line, sample : (row, col), float64
        As fractions; NaN where no patch covers a cell.
    nearest_line, nearest_sample : (row, col), int32
        Pixel that lies nearest, of the four around the place; -1 where there is none.
    hits : (row, col), uint16
        Patches over a cell.
    """

    line: Floats
    sample: Floats
    nearest_line: Array
    nearest_sample: Array
    hits: Array


@dataclass(frozen=True)
class Reading:
    """In which order the pixels of a tile are read, and where they go.

    Attributes
    ----------
    shape
        Rows and columns of the tile.
    cells : (place,), int64
        Covered cells, counted row by row, in the order of the lines that are read for them.
    lines, columns : (place,), int64
        Pixel to read; where one is to be interpolated, the one before it.
    along, across : (place,), float64
        Way from there to the next line and column; empty where nothing is interpolated.
    """

    shape: tuple[int, int]
    cells: Ints
    lines: Ints
    columns: Ints
    along: Floats
    across: Floats


def areas_between(survey: Survey) -> Floats:
    """Return the areas between the ends of lines, over lines without a place (pair, 4, 2)."""
    ends = survey.ends[np.isfinite(survey.ends).all(axis=(1, 2))]
    before, after = ends[:-1], ends[1:]
    return np.stack([before[:, 0], before[:, 1], after[:, 1], after[:, 0]], axis=1)


def needed_slabs(
    survey: Survey, grid: MapGrid, chunks: Sequence[int], windows: Sequence[Sequence[Window]]
) -> dict[tuple[int, int], list[int]]:
    """Return the slabs of lines that cover each tile.

    Parameters
    ----------
    survey
        Boxes of the lines, along the axes of the grid.
    grid
        How the cells lie.
    chunks
        Lines of every slab.
    windows
        Cells of the tiles, by row and column.
    """
    ends = np.cumsum(chunks)
    cells = survey.boxes / grid.gsd - np.repeat([grid.first[1], grid.first[0]], 2) - 0.5
    low, high = np.fmin(cells[:-1], cells[1:]), np.fmax(cells[:-1], cells[1:])
    # a patch needs both of its lines
    known = np.isfinite(cells[:-1, 0]) & np.isfinite(cells[1:, 0])
    made = {}
    for row, of_row in enumerate(windows):
        down = of_row[0][0]
        pairs = np.flatnonzero(known & (high[:, 3] >= down.start - 1) & (low[:, 2] <= down.stop))
        for col, (_, across) in enumerate(of_row):
            here = pairs[(high[pairs, 1] >= across.start - 1) & (low[pairs, 0] <= across.stop)]
            slabs = np.searchsorted(ends, np.concatenate([here, here + 1]), side="right")
            made[row, col] = np.unique(slabs).tolist()
    return made


def index_tile(
    plan: Plan,
    rows: slice,
    cols: slice,
    starts: Sequence[int],
    east: Sequence[Floats],
    north: Sequence[Floats],
) -> TileIndex:
    """Return the places of the line at the cells of a tile.

    Parameters
    ----------
    plan
        What all tiles share.
    rows, cols
        Cells of the tile.
    starts
        First line of every slab.
    east, north
        Where the pixels of the slabs lie (line, column).
    """
    from hyperpaint.kernels.arguments import InverseTile, LinePositions, MapCells
    from hyperpaint.kernels.inverse_map import invert_lines

    shape = rows.stop - rows.start, cols.stop - cols.start
    place, nearest = np.full((2, *shape), np.nan), np.full((2, *shape), -1, np.int32)
    rank, hits = np.full(shape, np.inf), np.zeros(shape, np.uint16)
    out = InverseTile(place, nearest, rank, hits)
    cells = MapCells(plan.grid.frame, (rows.start, cols.start), plan.longest, plan.rule)
    follows, before = -1, (np.empty(0), np.empty(0))
    for start, *slab in zip(starts, east, north, strict=True):
        if start != follows:
            before = np.full(slab[0].shape[1], np.nan), np.full(slab[0].shape[1], np.nan)
        e, n = (np.ascontiguousarray(part) for part in slab)
        invert_lines(LinePositions(e, n, *before), start, plan.last, cells, out)
        before, follows = (e[-1], n[-1]), start + len(e)
    return TileIndex(place[0], place[1], nearest[0], nearest[1], hits)


def gaps_of(plan: Plan, rows: slice, cols: slice, index: TileIndex) -> Array:
    """Return whether cells that no patch covers lie between the ends of lines (row, col)."""
    from hyperpaint.kernels.inverse_map import fill_between

    frame = plan.grid.frame
    inside: npt.NDArray[np.bool_] = np.zeros(index.hits.shape, bool)
    offset = plan.between - frame[:2]
    meets = np.ones(len(offset), bool)
    for (a, b), cells in ((frame[2:4], cols), (frame[4:6], rows)):
        at = np.asarray(a * offset[..., 0] + b * offset[..., 1])
        meets &= (at.max(axis=1) >= cells.start) & (at.min(axis=1) <= cells.stop - 1)
    fill_between(plan.between[meets], frame, (rows.start, cols.start), inside)
    return np.asarray(inside & (index.hits == 0))


def reading_of(index: TileIndex, bilinear: bool) -> Reading:
    """Return in which order the pixels of a tile are read: the nearest, or those before each place."""
    cells = np.flatnonzero(index.hits)
    if not bilinear:
        lines, columns = (part.ravel()[cells] for part in (index.nearest_line, index.nearest_sample))
        order = np.argsort(lines, kind="stable")
        none = np.zeros(0)
        return Reading(index.hits.shape, cells[order], *_whole(lines[order], columns[order]), none, none)
    line, sample = index.line.ravel()[cells], index.sample.ravel()[cells]
    order = np.argsort(line, kind="stable")
    line, sample = line[order], sample[order]
    lines, columns = _whole(line, sample)
    return Reading(index.hits.shape, cells[order], lines, columns, line - lines, sample - columns)


def _whole(line: Array, sample: Array) -> tuple[Ints, Ints]:
    return line.astype(np.int64), sample.astype(np.int64)
