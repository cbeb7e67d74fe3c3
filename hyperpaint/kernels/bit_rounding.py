"""Rounding of float32 values to the stored mantissa bits."""

from __future__ import annotations

from typing import Any

import numpy as np

from hyperpaint.base.arrays import Array
from hyperpaint.base.jit import inlined_kernel

from .arguments import Rounding


@inlined_kernel
def rounded(value: Any, rounding: Rounding | None) -> Any:
    """Return a float32 rounded to nearest-even.

    Masks are used instead of shifts, which numba would do in 64 bits.
    """
    if rounding is None:
        return value
    bits = np.float32(value).view(np.uint32)
    even = np.uint32((bits & rounding.last) == np.uint32(0))
    return np.uint32(np.uint32(bits + rounding.half - even) & rounding.mask).view(np.float32)


@inlined_kernel
def round_row(values: Array, rounding: Rounding | None) -> None:
    if rounding is not None:
        for x in range(values.size):
            values[x] = rounded(values[x], rounding)
