"""Values of a flight line at the cells of a tile."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from hyperpaint.base.arrays import Array

from .indexing import Reading, TileIndex

__all__ = ["column_values", "line_values", "map_spectra", "plane_values"]


def map_spectra(reading: Reading, starts: Sequence[int], slabs: Sequence[Array], empty: Any) -> Array:
    """Return spectra (row, col, band) of slabs (line, band, column).

    Parameters
    ----------
    reading
        The pixels to read, and whether to interpolate, which makes whole numbers float32.
    starts
        First line of every slab.
    slabs
        Lines, slab by slab.
    empty
        What cells get that no patch covers.
    """
    from hyperpaint.kernels.arguments import Places
    from hyperpaint.kernels.gathering import gather_bilinear, gather_nearest

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
    """Return values (row, col) of slabs (line, column).

    Parameters
    ----------
    reading, starts, slabs, empty
        See `map_spectra`.
    flags
        Whether the bits of all pixels that interpolation looks at are joined, instead of interpolated.
    """
    out = np.full(reading.shape[0] * reading.shape[1], empty, slabs[0].dtype)
    for slab, start, here in _by_slab(reading, starts, slabs):
        line, column, cells = reading.lines[here] - start, reading.columns[here], reading.cells[here]
        if not reading.along.size:
            out[cells] = slabs[slab][line, column]
            continue
        along, across = reading.along[here], reading.across[here]
        lines = np.concatenate([slabs[slab], _line_after(starts, slabs, slab)[None]])
        # of what is 0 away the next is not looked at
        corners = ((0, 0), (0, 1), (1, 0), (1, 1))
        taps = [lines[line + i * (along > 0), column + j * (across > 0)] for i, j in corners]
        if flags:
            out[cells] = taps[0] | taps[1] | taps[2] | taps[3]
        else:
            first = taps[0] + across * (taps[1] - taps[0])
            second = taps[2] + across * (taps[3] - taps[2])
            out[cells] = first + along * (second - first)
    return out.reshape(reading.shape)


def line_values(index: TileIndex, values: Array, empty: Any) -> Array:
    """Return values (row, col) of what every line has one of, of the nearest line."""
    return _looked_up(index.nearest_line, values, empty)


def column_values(index: TileIndex, values: Array, empty: Any) -> Array:
    """Return values (row, col) of what every column has one of, of the nearest column."""
    return _looked_up(index.nearest_sample, values, empty)


def _looked_up(place: Array, values: Array, empty: Any) -> Array:
    return np.where(place >= 0, values[np.maximum(place, 0)], np.asarray(empty, values.dtype))


def _by_slab(
    reading: Reading, starts: Sequence[int], slabs: Sequence[Array]
) -> Iterator[tuple[int, int, slice]]:
    """Yield every slab that pixels are read of, its first line, and which these are."""
    edges = np.searchsorted(reading.lines, [*starts, starts[-1] + len(slabs[-1])])
    for slab, start in enumerate(starts):
        here = slice(int(edges[slab]), int(edges[slab + 1]))
        if here.stop > here.start:
            yield slab, start, here


def _line_after(starts: Sequence[int], slabs: Sequence[Array], slab: int) -> Array:
    """Return the line that follows a slab; its own last one where nothing is to be read of it."""
    follows = slab + 1 < len(slabs) and starts[slab + 1] == starts[slab] + len(slabs[slab])
    return np.ascontiguousarray(slabs[slab + 1][0] if follows else slabs[slab][-1])
