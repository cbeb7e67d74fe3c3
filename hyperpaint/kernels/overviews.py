"""Overviews of a slab: block means, and colours from bands."""

import numpy as np

from hyperpaint.base import Array
from hyperpaint.base.jit import kernel

_ZERO, _ONE = np.float32(0.0), np.float32(1.0)


@kernel
def average_blocks(values: Array, side: int, out: Array) -> None:
    # Write the means of ``side`` x ``side`` blocks of values (line, band, column), float32.
    #
    # ``out`` is (row, band, block), float32. NaN samples are left out; blocks at the far edges may be
    # smaller. Sums run over lines, then over columns, so that they vectorise.
    lines, bands, columns = values.shape
    sums, counts = np.empty(columns, np.float32), np.empty(columns, np.float32)
    for row in range(out.shape[0]):
        for band in range(bands):
            for x in range(columns):
                sums[x] = counts[x] = _ZERO
            for line in range(row * side, min((row + 1) * side, lines)):
                for x in range(columns):
                    value = values[line, band, x]
                    is_valid = value == value
                    sums[x] += value if is_valid else _ZERO
                    counts[x] += _ONE if is_valid else _ZERO
            for block in range(out.shape[2]):
                total, count = _ZERO, _ZERO
                for x in range(block * side, min((block + 1) * side, columns)):
                    total += sums[x]
                    count += counts[x]
                out[row, band, block] = total / count  # NaN where all are missing


@kernel
def mix_bands(values: Array, weights: Array, out: Array) -> None:
    # Write linear sRGB (line, column, 3) of values (line, band, column), all float32.
    #
    # ``weights`` are (3, band, column). A NaN band of a pixel with other valid bands is saturated and counts
    # as 1; a pixel without valid bands is black.
    lines, bands, columns = values.shape
    filled, fallback = np.empty(columns, np.float32), np.empty(columns, np.float32)
    sums = np.empty((3, columns), np.float32)
    for line in range(lines):
        for x in range(columns):
            fallback[x] = sums[0, x] = sums[1, x] = sums[2, x] = _ZERO
        for band in range(bands):
            for x in range(columns):
                value = values[line, band, x]
                fallback[x] = _ONE if value == value else fallback[x]
        for band in range(bands):
            for x in range(columns):
                value = values[line, band, x]
                filled[x] = value if value == value else fallback[x]
            for colour in range(3):
                for x in range(columns):
                    sums[colour, x] += filled[x] * weights[colour, band, x]
        for x in range(columns):
            out[line, x, 0], out[line, x, 1], out[line, x, 2] = sums[0, x], sums[1, x], sums[2, x]
