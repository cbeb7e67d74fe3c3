"""Spectra of a slab of lines, copied or interpolated to the cells of a map.

Slabs are (line, band, column), maps (row, column, band). Each line is transposed into a buffer that fits the
processor's cache; every cell is then one contiguous copy of a spectrum.
"""

from __future__ import annotations

from hyperpaint.base.arrays import Array
from hyperpaint.base.jit import kernel

from .arguments import Places

# Columns transposed together: one cache line of float32.
_COLUMNS = 16


@kernel
def _transpose(source: Array, start: int, stop: int, out: Array) -> None:
    # Copy (band, column) to (column, band).
    for block in range(start, stop, _COLUMNS):
        end = min(block + _COLUMNS, stop)
        for band in range(source.shape[0]):
            for column in range(block, end):
                out[column, band] = source[band, column]


@kernel
def gather_nearest(
    slab: Array, lines: Array, columns: Array, cells: Array, spectra: Array, out: Array
) -> None:
    """Copy the spectra of pixels of a slab (line, band, column) to ``out`` (cell, band).

    ``lines`` and ``columns`` (pixel,) are the pixels in the order of their lines, ``cells`` (pixel,) their
    targets; ``spectra`` (column, band) is a buffer of the dtype of ``out``.
    """
    k = 0
    while k < lines.size:
        stop, low, high = k, columns[k], columns[k]
        while stop < lines.size and lines[stop] == lines[k]:
            low, high = min(low, columns[stop]), max(high, columns[stop])
            stop += 1
        _transpose(slab[lines[k]], low, high + 1, spectra)
        for pixel in range(k, stop):
            column, cell = columns[pixel], cells[pixel]
            for band in range(spectra.shape[1]):
                out[cell, band] = spectra[column, band]
        k = stop


@kernel
def gather_bilinear(
    slab: Array, after: Array, places: Places, spectra: Array, next_spectra: Array, out: Array
) -> None:
    """Write spectra (cell, band), interpolated between four pixels of a slab (line, band, column).

    A value is NaN where a pixel that has weight is NaN. ``after`` (band, column) is the line that follows the
    slab; ``spectra`` and ``next_spectra`` (column, band) are buffers of the dtype of ``out``.
    """
    lines, columns, along, across, cells = places
    last = slab.shape[2] - 1
    k = 0
    while k < lines.size:
        line = lines[k]
        stop, low, high = k, columns[k], columns[k]
        while stop < lines.size and lines[stop] == line:
            low, high = min(low, columns[stop]), max(high, columns[stop])
            stop += 1
        high = min(high + 1, last)
        _transpose(slab[line], low, high + 1, spectra)
        if line + 1 < slab.shape[0]:
            _transpose(slab[line + 1], low, high + 1, next_spectra)
        else:
            _transpose(after, low, high + 1, next_spectra)
        for number in range(k, stop):
            along_share, across_share = along[number], across[number]
            left = columns[number]
            right = left if across_share == 0 else left + 1
            lower = spectra
            upper = lower if along_share == 0 else next_spectra
            cell = cells[number]
            for band in range(out.shape[1]):
                before = lower[left, band] + across_share * (lower[right, band] - lower[left, band])
                next_value = upper[left, band] + across_share * (upper[right, band] - upper[left, band])
                out[cell, band] = before + along_share * (next_value - before)
        k = stop
