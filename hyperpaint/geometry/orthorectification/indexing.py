"""Pixel of a flight line at every cell of a tile, and the line's values there."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hyperpaint.base.arrays import Array, Bools, Floats, Ints
from hyperpaint.kernels.arguments import InverseTile, LinePositions, MapCells, Places
from hyperpaint.kernels.inverse_map import fill_between, gather_bilinear, gather_nearest, invert_lines

from .grids import MapGrid, Survey

Window = tuple[slice, slice]  # rows and columns of a tile

RULES = ("nadir", "first", "last")  # choice among several positions, in the order of the kernel's numbers


@dataclass(frozen=True)
class Plan:
    """Settings that all tiles share."""

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
    """Positions in the line at the cells of a tile."""

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
    survey: Survey, grid: MapGrid, chunks: Sequence[int], windows: Sequence[Sequence[Window]]
) -> dict[tuple[int, int], list[int]]:
    """Return the slabs of lines that cover each tile; ``chunks`` are the lines of every slab."""
    ends = np.cumsum(chunks)
    cells = survey.boxes / grid.gsd - np.repeat([grid.first[1], grid.first[0]], 2) - 0.5
    low, high = np.fmin(cells[:-1], cells[1:]), np.fmax(cells[:-1], cells[1:])
    # a patch needs both of its lines
    is_placed = np.isfinite(cells[:-1, 0]) & np.isfinite(cells[1:, 0])
    needed = {}
    for row, tile_row in enumerate(windows):
        row_slice = tile_row[0][0]
        pairs = np.flatnonzero(
            is_placed & (high[:, 3] >= row_slice.start - 1) & (low[:, 2] <= row_slice.stop)
        )
        for col, (_, col_slice) in enumerate(tile_row):
            covering_pairs = pairs[
                (high[pairs, 1] >= col_slice.start - 1) & (low[pairs, 0] <= col_slice.stop)
            ]
            slabs = np.searchsorted(ends, np.concatenate([covering_pairs, covering_pairs + 1]), side="right")
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
    """Return the positions in the line at the cells of a tile.

    ``starts`` are the first lines of the slabs, whose pixels lie at ``east`` and ``north`` (line, column);
    ``relief``, if available, are the height of the ground [m] and the tangent of the view zenith angle:
    between pixels of very different height lies ground that neither shows.
    """
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
        hidden = np.zeros((0, 0), bool)
        if surface:
            hidden = hidden_between(surface[0], surface[1], line_before[2:], plan.parallax)
        invert_lines(
            LinePositions(e, n, line_before[0], line_before[1], hidden), start, plan.last, cells, out
        )
        line_before, next_start = [e[-1], n[-1], *(part[-1] for part in surface)], start + len(e)
    return TileIndex(position[0], position[1], nearest[0], nearest[1], hits)


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
    is_between: Bools = np.zeros(index.hits.shape, bool)
    offset = plan.between - frame[:2]
    is_near = np.ones(len(offset), bool)
    for (a, b), cells in ((frame[2:4], cols), (frame[4:6], rows)):
        coordinate = np.asarray(a * offset[..., 0] + b * offset[..., 1])
        is_near &= (coordinate.max(axis=1) >= cells.start) & (coordinate.min(axis=1) <= cells.stop - 1)
    fill_between(plan.between[is_near], frame, (rows.start, cols.start), is_between)
    return np.asarray(is_between & (index.hits == 0))


def reading_of(index: TileIndex, bilinear: bool) -> Reading:
    """Return the reading order of the pixels of a tile: the nearest pixels, or those before each place."""
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
    """Return spectra (row, col, band) from slabs (line, band, column) that begin at the lines ``starts``.

    Uncovered cells get ``empty``, whose type the result has.
    """
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
    """Return values (row, col) of slabs (line, column), see `map_spectra`.

    With ``flags`` the bits of the four pixels of an interpolation are combined by OR.
    """
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
    """Return values (row, col) of the nearest line or column, from one value per line or column."""
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
