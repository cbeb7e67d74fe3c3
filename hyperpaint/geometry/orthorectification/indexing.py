"""Pixel of a flight line at every cell of a tile, and the line's values there."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hyperpaint.base.arrays import Array, Bools, Floats, Ints
from hyperpaint.kernels.arguments import InverseTile, LinePositions, MapCells, Places
from hyperpaint.kernels.gathering import gather_bilinear, gather_nearest
from hyperpaint.kernels.inverse_map import fill_between, invert_lines

from .grids import MapGrid, Survey

Window = tuple[slice, slice]  # rows and columns of a tile

RULES = ("nadir", "first", "last")  # choice among several places, in the order of the kernel's numbers


@dataclass(frozen=True)
class Plan:
    """Settings that all tiles share."""

    grid: MapGrid
    rule: int  #: Position in `RULES`
    longest: float  #: Edge beyond which four pixels do not span a patch [cell]
    last: int  #: Number of the last line
    #: Largest shift of neighbouring pixels against each other by their heights [m]
    parallax: float
    #: (pair, 4, 2) float64: east and north of the corners of the area from every line that has a place to
    #: the next that has, around it [m]
    between: Floats


@dataclass(frozen=True)
class TileIndex:
    """Places of the line at the cells of a tile."""

    line: Floats  #: (row, col) float64: as fractions; NaN where no patch covers a cell
    sample: Floats
    #: (row, col) int32: pixel that lies nearest, of the four around the place; -1 where there is none
    nearest_line: Array
    nearest_sample: Array
    hits: Array  #: (row, col) uint16: patches over a cell


@dataclass(frozen=True)
class Reading:
    """Pixels of a tile in the order of reading, and the cells they fill."""

    shape: tuple[int, int]  #: Rows and columns of the tile
    #: (place,) int64: covered cells, counted row by row, in the order of the lines that are read for them
    cells: Ints
    lines: Ints  #: (place,) int64: pixel to read; where one is to be interpolated, the one before it
    columns: Ints
    #: (place,) float64: way from there to the next line and column; empty where nothing is interpolated
    along: Floats
    across: Floats


def areas_between(survey: Survey) -> Floats:
    """Return the areas between the ends of consecutive located lines (pair, 4, 2)."""
    ends = survey.ends[np.isfinite(survey.ends).all(axis=(1, 2))]
    before, after = ends[:-1], ends[1:]
    return np.stack([before[:, 0], before[:, 1], after[:, 1], after[:, 0]], axis=1)


def needed_slabs(
    survey: Survey, grid: MapGrid, chunks: Sequence[int], windows: Sequence[Sequence[Window]]
) -> dict[tuple[int, int], list[int]]:
    """Return the slabs of lines that cover each tile; ``chunks`` are the lines of every slab."""
    ends = np.cumsum(chunks)
    cells = survey.boxes / grid.gsd - np.repeat([grid.first[1], grid.first[0]], 2) - 0.5
    low, high = np.fmin(cells[:-1], cells[1:]), np.fmax(cells[:-1], cells[1:])
    # a patch needs both of its lines
    is_placed = np.isfinite(cells[:-1, 0]) & np.isfinite(cells[1:, 0])
    needed = {}
    for row, of_row in enumerate(windows):
        down = of_row[0][0]
        pairs = np.flatnonzero(is_placed & (high[:, 3] >= down.start - 1) & (low[:, 2] <= down.stop))
        for col, (_, across) in enumerate(of_row):
            here = pairs[(high[pairs, 1] >= across.start - 1) & (low[pairs, 0] <= across.stop)]
            slabs = np.searchsorted(ends, np.concatenate([here, here + 1]), side="right")
            needed[row, col] = np.unique(slabs).tolist()
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
    """Return the places of the line at the cells of a tile.

    ``starts`` are the first lines of the slabs, whose pixels lie at ``east`` and ``north`` (line, column);
    ``relief``, where known, are the height of the ground [m] and the tangent of the view zenith angle:
    between pixels far apart in height there is ground that neither shows.
    """
    shape = rows.stop - rows.start, cols.stop - cols.start
    place, nearest = np.full((2, *shape), np.nan), np.full((2, *shape), -1, np.int32)
    rank, hits = np.full(shape, np.inf), np.zeros(shape, np.uint16)
    out = InverseTile(place, nearest, rank, hits)
    cells = MapCells(plan.grid.frame, (rows.start, cols.start), plan.longest, plan.rule)
    follows, before = -1, [np.empty(0)] * (2 + len(relief))
    for start, *slab in zip(starts, east, north, *relief, strict=True):
        if start != follows:
            before = [np.full(slab[0].shape[1], np.nan)] * len(slab)
        e, n, *surface = (np.ascontiguousarray(part) for part in slab)
        hidden = np.zeros((0, 0), bool)
        if surface:
            hidden = hidden_between(surface[0], surface[1], before[2:], plan.parallax)
        invert_lines(LinePositions(e, n, before[0], before[1], hidden), start, plan.last, cells, out)
        before, follows = [e[-1], n[-1], *(part[-1] for part in surface)], start + len(e)
    return TileIndex(place[0], place[1], nearest[0], nearest[1], hits)


def hidden_between(height: Floats, tangent: Floats, before: Sequence[Floats], parallax: float) -> Bools:
    """Return where ground is hidden between pixels and those of the line before (line, column - 1).

    ``height`` [m] and ``tangent`` of the zenith angle (line, column) belong to consecutive lines, ``before``
    (column,) to the line before. For four pixels that span a patch, the difference of heights times the
    tangent is their shift on the map against the line of sight of their neighbours. It exceeds the pixel
    spacing only where the surface falls away steeper than the line of sight; on a visible wall it equals the
    spacing.
    """
    heights, tangents = (
        np.concatenate([first[None], lines]) for first, lines in zip(before, (height, tangent), strict=True)
    )

    def of_patches(reduce: np.ufunc, values: Floats) -> Floats:
        of_pairs = reduce(values[:-1], values[1:])
        return np.asarray(reduce(of_pairs[:, :-1], of_pairs[:, 1:]))

    drop = of_patches(np.maximum, heights) - of_patches(np.minimum, heights)
    return np.asarray(drop * of_patches(np.maximum, tangents) > parallax)


def gaps_of(plan: Plan, rows: slice, cols: slice, index: TileIndex) -> Array:
    """Return the uncovered cells between the ends of lines (row, col)."""
    frame = plan.grid.frame
    inside: Bools = np.zeros(index.hits.shape, bool)
    offset = plan.between - frame[:2]
    meets = np.ones(len(offset), bool)
    for (a, b), cells in ((frame[2:4], cols), (frame[4:6], rows)):
        at = np.asarray(a * offset[..., 0] + b * offset[..., 1])
        meets &= (at.max(axis=1) >= cells.start) & (at.min(axis=1) <= cells.stop - 1)
    fill_between(plan.between[meets], frame, (rows.start, cols.start), inside)
    return np.asarray(inside & (index.hits == 0))


def reading_of(index: TileIndex, bilinear: bool) -> Reading:
    """Return the reading order of the pixels of a tile: the nearest pixels, or those before each place."""
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


# --- values of a tile ----------------------------------------------------------------------------------


def map_spectra(reading: Reading, starts: Sequence[int], slabs: Sequence[Array], empty: Any) -> Array:
    """Return spectra (row, col, band) from slabs (line, band, column) that begin at the lines ``starts``.

    Uncovered cells get ``empty``, whose type the result has.
    """
    bands, columns = slabs[0].shape[1:]
    bilinear = reading.along.size > 0
    dtype = np.asarray(empty).dtype
    out = np.empty((reading.shape[0] * reading.shape[1], bands), dtype)
    if reading.cells.size < len(out):
        uncovered = np.ones(len(out), bool)
        uncovered[reading.cells] = False
        out[uncovered] = empty
    turned = np.empty((columns, bands), dtype)
    for slab, start, here in _by_slab(reading, starts, slabs):
        place = reading.lines[here] - start, reading.columns[here]
        part = np.ascontiguousarray(slabs[slab])
        if not bilinear:
            gather_nearest(part, *place, reading.cells[here], turned, out)
            continue
        ways = reading.along[here].astype(dtype), reading.across[here].astype(dtype)
        after = _line_after(starts, slabs, slab)
        places = Places(*place, *ways, reading.cells[here])
        gather_bilinear(part, after, places, turned, np.empty_like(turned), out)
    return out.reshape(*reading.shape, bands)


def plane_values(
    reading: Reading, starts: Sequence[int], slabs: Sequence[Array], flags: bool, empty: Any
) -> Array:
    """Return values (row, col) of slabs (line, column), see `map_spectra`.

    With ``flags`` the bits of all pixels that interpolation looks at are joined, instead of interpolated.
    """
    out = np.full(reading.shape[0] * reading.shape[1], empty, slabs[0].dtype)
    for slab, start, here in _by_slab(reading, starts, slabs):
        line, column, cells = reading.lines[here] - start, reading.columns[here], reading.cells[here]
        if not reading.along.size:
            out[cells] = slabs[slab][line, column]
            continue
        along, across = reading.along[here], reading.across[here]
        lines = np.concatenate([slabs[slab], _line_after(starts, slabs, slab)[None]])
        # a pixel at distance 0 needs no neighbour
        corners = ((0, 0), (0, 1), (1, 0), (1, 1))
        taps = [lines[line + i * (along > 0), column + j * (across > 0)] for i, j in corners]
        if flags:
            out[cells] = taps[0] | taps[1] | taps[2] | taps[3]
        else:
            first = taps[0] + across * (taps[1] - taps[0])
            second = taps[2] + across * (taps[3] - taps[2])
            out[cells] = first + along * (second - first)
    return out.reshape(reading.shape)


def nearest_values(index: TileIndex, values: Array, of_lines: bool, empty: Any) -> Array:
    """Return values (row, col) of the nearest line or column, from one value per line or column."""
    place = index.nearest_line if of_lines else index.nearest_sample
    return np.where(place >= 0, values[np.maximum(place, 0)], np.asarray(empty, values.dtype))


def _by_slab(
    reading: Reading, starts: Sequence[int], slabs: Sequence[Array]
) -> Iterator[tuple[int, int, slice]]:
    # every slab with pixels to read, its first line, and the range of these pixels
    edges = np.searchsorted(reading.lines, [*starts, starts[-1] + len(slabs[-1])])
    for slab, start in enumerate(starts):
        here = slice(int(edges[slab]), int(edges[slab + 1]))
        if here.stop > here.start:
            yield slab, start, here


def _line_after(starts: Sequence[int], slabs: Sequence[Array], slab: int) -> Array:
    # the slab's own last line where nothing is read of the next
    follows = slab + 1 < len(slabs) and starts[slab + 1] == starts[slab] + len(slabs[slab])
    return np.ascontiguousarray(slabs[slab + 1][0] if follows else slabs[slab][-1])
