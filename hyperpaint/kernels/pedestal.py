"""What every element of a line counts beyond its dark, from those that see no light."""

from __future__ import annotations

from typing import Any

import numpy as np

from hyperpaint.base.arrays import Array
from hyperpaint.base.jit import borrowing_kernel

_FAR_SD = 5.0
"""Standard deviations from the mean beyond which a masked element is left out: a cosmic ray, not noise."""


@borrowing_kernel
def pedestal_of(counts: Array, dark: Array, masked: Array) -> Any:
    """Return the mean of counts less dark (band, column) over ``masked`` elements (n, 2) [count], float32.

    Twice, the second time without those far from the first mean; 0 where no count is finite.
    """
    mean, far = 0.0, np.inf
    for _ in range(2):
        number, total, square = 0, 0.0, 0.0
        for k in range(masked.shape[0]):
            beyond = float(counts[masked[k, 0], masked[k, 1]]) - float(dark[masked[k, 0], masked[k, 1]])
            if abs(beyond - mean) <= far:
                number += 1
                total += beyond - mean
                square += (beyond - mean) ** 2
        if number == 0:
            return np.float32(mean)
        shift = total / number
        mean += shift
        far = _FAR_SD * np.sqrt(max(square / number - shift * shift, 0.0)) + 1e-9
    return np.float32(mean)


@borrowing_kernel
def raise_dark(pedestal: Any, dark: Array, out: Array) -> None:
    """Write the dark with the pedestal of its line (band, column)."""
    for band in range(out.shape[0]):
        for x in range(out.shape[1]):
            out[band, x] = dark[band, x] + pedestal
