"""Random numbers without a state: each is a function of where it is used.

A stream that is drawn from in turn would give other numbers for other blocks of lines. A counter-based
generator gives the number that belongs to (seed, line, column, sample, draw), whoever asks, in any order.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from hyperpaint.base.jit import borrowing_kernel

__all__ = ["philox", "uniforms"]

_MASK = np.uint64(0xFFFFFFFF)
_HALF = np.uint64(32)
_MULTIPLIER_0, _MULTIPLIER_1 = np.uint64(0xD2511F53), np.uint64(0xCD9E8D57)
_WEYL_0, _WEYL_1 = np.uint64(0x9E3779B9), np.uint64(0xBB67AE85)
_STEP = 2.0**-32


@borrowing_kernel
def philox(c0: Any, c1: Any, c2: Any, c3: Any, k0: Any, k1: Any) -> tuple[Any, Any, Any, Any]:
    """Return four words of 32 bits: Philox4x32-10.

    Parameters
    ----------
    c0, c1, c2, c3
        The counter, words of 32 bits held in uint64.
    k0, k1
        The key, likewise.

    Notes
    -----
    J. K. Salmon, M. A. Moraes, R. O. Dror, D. E. Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC11
    (2011). Products of two 32-bit words fit 64 bits: nothing overflows, compiled or not.
    """
    for _ in range(10):
        product_0 = _MULTIPLIER_0 * c0
        product_1 = _MULTIPLIER_1 * c2
        c0 = (product_1 >> _HALF) ^ c1 ^ k0
        c2 = (product_0 >> _HALF) ^ c3 ^ k1
        c1 = product_1 & _MASK
        c3 = product_0 & _MASK
        k0 = (k0 + _WEYL_0) & _MASK
        k1 = (k1 + _WEYL_1) & _MASK
    return c0, c1, c2, c3


@borrowing_kernel
def uniforms(seed: Any, line: Any, column: Any, sample: Any, draw: Any) -> tuple[float, float, float, float]:
    """Return four numbers inside (0, 1) that belong to one draw of one sample of one pixel.

    Parameters
    ----------
    seed
        Non-negative integer.
    line, column, sample, draw
        Non-negative integers below 2^32: the absolute scan line, the column, the sample of the pixel, and
        what the numbers are for.
    """
    key = np.uint64(seed)
    a, b, c, d = philox(
        np.uint64(line), np.uint64(column), np.uint64(sample), np.uint64(draw), key & _MASK, key >> _HALF
    )
    return (
        (np.float64(a) + 0.5) * _STEP,
        (np.float64(b) + 0.5) * _STEP,
        (np.float64(c) + 0.5) * _STEP,
        (np.float64(d) + 0.5) * _STEP,
    )
