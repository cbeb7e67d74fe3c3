"""Weighted sums over the spectral axis: filters, and interpolation with weights of each column.

A missing band touches its own window only.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from hyperpaint.base.arrays import Array
from hyperpaint.base.jit import kernel

__all__ = ["filter_slab", "resample_slab"]


_NAN = np.float32(np.nan)
_ZERO = np.float32(0.0)
_ONE = np.float32(1.0)


@kernel
def accumulate_row(
    values: Array, line: Any, source: Any, weight: Any, total: Array, norm: Array, complete: Array
) -> None:
    """Add one band of the window to the sums of a row; a missing value adds nothing."""
    for x in range(total.size):
        value = values[line, source, x]
        there = value == value
        total[x] += weight * (value if there else _ZERO)
        norm[x] += weight if there else _ZERO
        complete[x] = complete[x] if there or weight == _ZERO else _ZERO


@kernel
def filter_slab(
    values: Array, weights: Array, first: Array, renormalise: Any, fallback: Array, out: Array
) -> None:
    """Write the weighted sum of each band's window of values (line, band, column), float32.

    ``weights`` (band, width) are those of a band's window, which begins at the band ``first`` (band,); a row
    sums to 1. With ``renormalise`` a window with missing values is divided by the weights that are left (a
    mean); else row ``k`` of ``fallback`` (band, width, width) has the weights without the ``k``-th value (a
    filter with negative weights, whose rest may sum to nothing).

    Notes
    -----
    A missing band stays missing. Where two or more values are missing and the filter does not renormalise,
    the value is left as it is.
    """
    n_line, n_band, n_column = values.shape
    width = weights.shape[1]
    total = np.empty(n_column, np.float32)
    norm = np.empty(n_column, np.float32)
    complete = np.empty(n_column, np.float32)
    for line in range(n_line):
        for band in range(n_band):
            total[:] = _ZERO
            norm[:] = _ZERO
            complete[:] = _ONE
            for k in range(width):
                accumulate_row(values, line, first[band] + k, weights[band, k], total, norm, complete)
            for x in range(n_column):
                value = values[line, band, x]
                if value != value:
                    out[line, band, x] = _NAN
                elif complete[x] == _ONE:
                    out[line, band, x] = total[x]
                elif renormalise:
                    out[line, band, x] = total[x] / norm[x]
                else:
                    out[line, band, x] = without_missing(values, fallback, line, band, x, first[band], width)


@kernel
def without_missing(
    values: Array, fallback: Array, line: Any, band: Any, x: Any, first: Any, width: Any
) -> Any:
    """Return the filtered value of a window with one value missing, the value itself with more."""
    missing = 0
    gap = 0
    for k in range(width):
        value = values[line, first + k, x]
        if value != value:
            missing += 1
            gap = k
    if missing > 1:
        return values[line, band, x]
    total = _ZERO
    for k in range(width):
        if k != gap:
            total += fallback[band, gap, k] * values[line, first + k, x]
    return total


@kernel
def resample_slab(values: Array, first: Array, weights: Array, out: Array) -> None:
    """Write sum_k weights[band, column, k] values[first + k]; NaN where a tap with weight is missing.

    ``first`` (band, column) is the first of the four bands that are weighed; ``weights`` are NaN where there
    is nothing to interpolate between. Values are (line, band, column), float32.
    """
    for line in range(values.shape[0]):
        for band in range(out.shape[1]):
            for x in range(out.shape[2]):
                total = np.float32(0.0)
                for k in range(4):
                    weight = weights[band, x, k]
                    if weight != np.float32(0.0):
                        total += weight * values[line, first[band, x] + k, x]
                out[line, band, x] = total
