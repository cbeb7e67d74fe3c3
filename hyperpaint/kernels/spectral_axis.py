"""Operations along the spectral axis: running means, weighted sums, interpolation with weights per column.

A NaN band affects only the windows that contain it.
"""

from typing import Any

import numpy as np

from hyperpaint.base.jit import borrowing_kernel, inlined_kernel, kernel
from hyperpaint.base.schema import Array

_NAN = np.float32(np.nan)
_NOTHING = np.float32(0.0)
_ONE_F32 = np.float32(1.0)
# Bands weighted in one loop: few enough for the registers of any processor.
_BANDS_PER_LOOP = 6


# --- running means


@kernel
def average_slab(values: Array, width: int, out: Array) -> None:
    """Write running means of values (line, band, column), float32, over ``width`` (odd) bands.

    Windows are cut at the ends; NaN bands are left out of the mean, and stay NaN themselves.

    Notes
    -----
    The bands are cut into blocks as wide as a window, so that a window is the end of one block
    and the beginning of the next [1]_: three additions a value, whatever the width. There is no subtraction,
    which would let a large value affect bands beyond its windows.

    References
    ----------
    .. [1] M. van Herk, Pattern Recognition Letters 13, 517-521 (1992). doi:10.1016/0167-8655(92)90069-C
    """
    _, bands, columns = values.shape
    ends, beginning = np.empty((width + 1, columns), np.float32), np.empty(columns, np.float32)
    filled, counts = np.empty((bands, columns), np.float32), np.empty((bands, columns), np.float32)
    for line in range(values.shape[0]):
        if has_gap(values[line]):
            fill_gaps(values[line], filled, counts)
            average_line(filled, width, ends, beginning, out[line])
            average_line(counts, width, ends, beginning, filled)
            correct_means(values[line], filled, width // 2, out[line])
        else:
            average_line(values[line], width, ends, beginning, out[line])


@borrowing_kernel
def has_gap(values: Array) -> Any:
    # Return whether any value (band, column) is NaN.
    for band in range(values.shape[0]):
        gap = False
        for x in range(values.shape[1]):
            gap |= values[band, x] != values[band, x]
        if gap:
            return True
    return False


@borrowing_kernel
def average_line(values: Array, width: int, ends: Array, beginning: Array, out: Array) -> None:
    # Write the means of a line (band, column) without NaN.
    #
    # ``ends`` (width + 1, column): sums from a band of the block to its end; ``beginning`` (column,): sum
    # from the beginning of the next block.
    bands, columns = values.shape
    half = width // 2
    for first in range(0, bands, width):
        for x in range(columns):
            ends[width, x] = _NOTHING
            beginning[x] = _NOTHING
        for offset in range(width - 1, -1, -1):
            band, sums, previous = first + offset - half, ends[offset], ends[offset + 1]
            if 0 <= band < bands:
                row = values[band]
                for x in range(columns):
                    sums[x] = previous[x] + row[x]
            else:
                for x in range(columns):
                    sums[x] = previous[x]
        for band in range(first, min(first + width, bands)):
            share, to_end, mean = share_of_window(band, half, bands), ends[band - first], out[band]
            if band > first and band + half < bands:
                row = values[band + half]
                for x in range(columns):
                    beginning[x] = beginning[x] + row[x]
                    mean[x] = (to_end[x] + beginning[x]) * share
            else:
                for x in range(columns):
                    mean[x] = (to_end[x] + beginning[x]) * share


@inlined_kernel
def share_of_window(band: Any, half: Any, bands: Any) -> Any:
    # 1 / (number of bands in a window of ``half`` bands to either side, cut at the ends).
    return _ONE_F32 / np.float32(min(band + half, bands - 1) - max(band - half, 0) + 1)


@borrowing_kernel
def fill_gaps(values: Array, filled: Array, counts: Array) -> None:
    # Write values (band, column) with NaN replaced by 0, and their validity as 1 or 0.
    for band in range(values.shape[0]):
        for x in range(values.shape[1]):
            value = values[band, x]
            filled[band, x] = value if value == value else _NOTHING
        for x in range(values.shape[1]):
            value = values[band, x]
            counts[band, x] = _ONE_F32 if value == value else _NOTHING


@borrowing_kernel
def correct_means(values: Array, shares: Array, half: int, out: Array) -> None:
    # Divide means over whole windows (band, column) by the ``shares`` of their bands that are valid.
    bands = values.shape[0]
    full_window = _ONE_F32 - np.float32(0.5) / np.float32(2 * half + 1)
    for band in range(bands):
        for x in range(values.shape[1]):
            share, missing = shares[band, x], values[band, x] != values[band, x]
            out[band, x] = _NAN if missing else out[band, x] if share > full_window else out[band, x] / share


# --- weighted sums


@kernel
def filter_slab(values: Array, weights: Array, first: Array, fallback: Array, out: Array) -> None:
    # Write the weighted sum of each band's window of values (line, band, column), float32.
    #
    # ``weights`` (band, width) are for a band's window, which begins at the band ``first`` (band,); a row
    # sums to 1. Row ``k`` of ``fallback`` (band, width, width) has the weights without the ``k``-th value.
    #
    # A NaN band stays NaN. A value with two or more NaN in its window is not filtered.
    width = weights.shape[1]
    for line in range(values.shape[0]):
        for band in range(values.shape[1]):
            for k in range(0, width, _BANDS_PER_LOOP):
                weigh_rows(values[line], weights[band], first[band], k, out[line, band])
            gap = False
            for x in range(values.shape[2]):
                gap |= out[line, band, x] != out[line, band, x]
            if gap:
                for x in range(values.shape[2]):
                    value = values[line, band, x]
                    if value == value and out[line, band, x] != out[line, band, x]:
                        out[line, band, x] = without_missing(values, fallback, line, band, x, first[band])


@inlined_kernel
def weigh_rows(values: Array, weights: Array, first: Any, k: Any, out: Array) -> None:
    # Add the weighted values (band, column) of `_BANDS_PER_LOOP` bands of a window, from its ``k``-th on.
    #
    # Beyond the window, its first band is read with weight 0; where that is NaN, the sum is NaN already.
    w0, r0 = weight_and_row(values, weights, first, k)
    w1, r1 = weight_and_row(values, weights, first, k + 1)
    w2, r2 = weight_and_row(values, weights, first, k + 2)
    w3, r3 = weight_and_row(values, weights, first, k + 3)
    w4, r4 = weight_and_row(values, weights, first, k + 4)
    w5, r5 = weight_and_row(values, weights, first, k + 5)
    if k == 0:
        for x in range(out.size):
            low = (w0 * r0[x] + w1 * r1[x]) + (w2 * r2[x] + w3 * r3[x])
            out[x] = low + (w4 * r4[x] + w5 * r5[x])
    else:
        for x in range(out.size):
            low = (w0 * r0[x] + w1 * r1[x]) + (w2 * r2[x] + w3 * r3[x])
            out[x] += low + (w4 * r4[x] + w5 * r5[x])


@kernel
def weight_and_row(values: Array, weights: Array, first: Any, k: Any) -> tuple[Any, Array]:
    # Return weight and values of the ``k``-th band of a window.
    is_inside = k < weights.size
    return (weights[k] if is_inside else _NOTHING), values[first + (k if is_inside else 0)]


@borrowing_kernel
def without_missing(values: Array, fallback: Array, line: Any, band: Any, x: Any, first: Any) -> Any:
    # Return the filtered value of a window with one NaN, the unfiltered value with more.
    gaps, gap, width = 0, 0, fallback.shape[1]
    for k in range(width):
        value = values[line, first + k, x]
        if value != value:
            gaps += 1
            gap = k
    if gaps != 1:
        return values[line, band, x] if gaps > 1 else _NAN
    total = _NOTHING
    for k in range(width):
        if k != gap:
            total += fallback[band, gap, k] * values[line, first + k, x]
    return total


@kernel
def resample_slab(values: Array, first: Array, weights: Array, out: Array) -> None:
    # Write sum_k weights[band, column, k] values[first + k]; NaN where a sample with weight is NaN.
    #
    # ``first`` (band, column) is the first of four bands; ``weights`` are NaN where interpolation is
    # impossible. Values are (line, band, column), float32.
    for line in range(values.shape[0]):
        for band in range(out.shape[1]):
            for x in range(out.shape[2]):
                total = np.float32(0.0)
                for k in range(4):
                    weight = weights[band, x, k]
                    if weight != np.float32(0.0):
                        total += weight * values[line, first[band, x] + k, x]
                out[line, band, x] = total
