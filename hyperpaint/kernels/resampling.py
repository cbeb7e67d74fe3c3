"""Interpolation over the spectral axis, each column with weights of its own."""

from __future__ import annotations

import numpy as np

from hyperpaint.base.arrays import Array
from hyperpaint.base.jit import kernel

__all__ = ["resample_slab"]


@kernel
def resample_slab(values: Array, first: Array, weights: Array, out: Array) -> None:
    """Write sum_k weights[band, column, k] values[first + k]; NaN where a tap with weight is missing.

    Parameters
    ----------
    values, out : (line, band, column), float32
    first : (band, column), int64
        First of the four bands that are weighed.
    weights : (band, column, 4), float32
        NaN where there is nothing to interpolate between.
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
