"""Pedestal of a line: mean counts above dark of masked elements."""

from __future__ import annotations

from typing import Any

import numpy as np

from hyperpaint.base.arrays import Array
from hyperpaint.base.jit import borrowing_kernel

# Masked elements farther from the mean are left out as cosmic rays [standard deviations].
_FAR_SD = 5.0


@borrowing_kernel
def pedestal_of(counts: Array, dark: Array, masked: Array) -> Any:
    """Return the mean of counts less dark (band, column) over ``masked`` elements (n, 2) [count], float32.

    Computed twice; the second time without elements over `_FAR_SD` standard deviations from the first mean. 0
    where no count is finite.
    """
    mean, limit = 0.0, np.inf
    for _ in range(2):
        count, total, squares = 0, 0.0, 0.0
        for k in range(masked.shape[0]):
            excess = float(counts[masked[k, 0], masked[k, 1]]) - float(dark[masked[k, 0], masked[k, 1]])
            if abs(excess - mean) <= limit:
                count += 1
                total += excess - mean
                squares += (excess - mean) ** 2
        if count == 0:
            return np.float32(mean)
        shift = total / count
        mean += shift
        limit = _FAR_SD * np.sqrt(max(squares / count - shift * shift, 0.0)) + 1e-9
    return np.float32(mean)


@borrowing_kernel
def raise_dark(pedestal: Any, dark: Array, out: Array) -> None:
    for band in range(out.shape[0]):
        for x in range(out.shape[1]):
            out[band, x] = dark[band, x] + pedestal
