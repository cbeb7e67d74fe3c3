"""Random numbers keyed by place: (seed, line, column, sample, draw), independent of the order of calls.

A stream that is drawn from in turn would give other numbers for other blocks of lines. Counters give numbers
that do not depend on one another (`uniforms`); the first reflections of a pixel's paths share out the
directions evenly instead (`even_pair`), which leaves less noise.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from hyperpaint.base.jit import borrowing_kernel

_MASK = np.uint64(0xFFFFFFFF)
_HALF = np.uint64(32)
_MULTIPLIER_0, _MULTIPLIER_1 = np.uint64(0xD2511F53), np.uint64(0xCD9E8D57)
_WEYL_0, _WEYL_1 = np.uint64(0x9E3779B9), np.uint64(0xBB67AE85)
_STEP = 2.0**-32
_PIXEL = 65536  # draw of the key of a pixel

_0, _1, _2, _4, _8, _16 = (np.uint64(count) for count in (0, 1, 2, 4, 8, 16))
_15 = np.uint64(15)
_ODD, _PAIRS, _NIBBLES, _BYTES = (np.uint64(m) for m in (0x55555555, 0x33333333, 0x0F0F0F0F, 0x00FF00FF))
_MIX_0, _MIX_1 = np.uint64(0x7FEB352D), np.uint64(0x846CA68B)
_OWEN = tuple(np.uint64(m) for m in (0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6))
_OWEN_0, _OWEN_1, _OWEN_2, _OWEN_3 = _OWEN


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
    """Return four numbers inside (0, 1) for one draw of one sample of one pixel.

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


@borrowing_kernel
def pixel_key(seed: Any, line: Any, column: Any) -> Any:
    # A word of 32 bits, in uint64, that belongs to a pixel.
    key = np.uint64(seed)
    word, _, _, _ = philox(
        np.uint64(line), np.uint64(column), _0, np.uint64(_PIXEL), key & _MASK, key >> _HALF
    )
    return word


@borrowing_kernel
def even_pair(key: Any, sample: Any, draw: Any, mask: Any) -> tuple[float, float]:
    """Return two numbers inside (0, 1): a point of a sequence that covers the square evenly.

    Parameters
    ----------
    key
        Of the pixel.
    sample
        Number of the point.
    draw
        What the numbers are for: other draws share out the points in another order.
    mask
        A power of two less 1, not below the last sample.

    Notes
    -----
    The first two dimensions of Sobol's sequence, each scrambled as by A. B. Owen, "Randomly permuted
    (t,m,s)-nets and (t,s)-sequences" (1995), in an order scrambled likewise: B. Burley, "Practical hash-based
    Owen scrambling", JCGT 9 (2020). Any single point is uniform: means over pixels have no bias.
    """
    seed = _mixed((np.uint64(key) ^ (np.uint64(draw) * _WEYL_0)) & _MASK)
    place = _reversed(_scrambled(_reversed(np.uint64(sample)), seed)) & np.uint64(mask)
    first = _scrambled(place, _mixed(seed ^ _1))  # the radical inverse is the place itself, reversed
    second = _scrambled(_sobol_reversed(place), _mixed(seed ^ _2))
    return (np.float64(_reversed(first)) + 0.5) * _STEP, (np.float64(_reversed(second)) + 0.5) * _STEP


@borrowing_kernel
def _mixed(x: Any) -> Any:
    # A hash by C. Wellons, "Prospecting for hash functions".
    x ^= x >> _16
    x = (x * _MIX_0) & _MASK
    x ^= x >> _15
    x = (x * _MIX_1) & _MASK
    return x ^ (x >> _16)


@borrowing_kernel
def _reversed(x: Any) -> Any:
    x = ((x >> _1) & _ODD) | ((x & _ODD) << _1)
    x = ((x >> _2) & _PAIRS) | ((x & _PAIRS) << _2)
    x = ((x >> _4) & _NIBBLES) | ((x & _NIBBLES) << _4)
    x = ((x >> _8) & _BYTES) | ((x & _BYTES) << _8)
    return ((x >> _16) | (x << _16)) & _MASK


@borrowing_kernel
def _scrambled(x: Any, seed: Any) -> Any:
    # Bits flipped by lower bits (Laine and Karras 2011, Vegdahl's constants).
    x = (x + seed) & _MASK
    x ^= (x * _OWEN_0) & _MASK
    x ^= (x * _OWEN_1) & _MASK
    x ^= (x * _OWEN_2) & _MASK
    return x ^ ((x * _OWEN_3) & _MASK)


@borrowing_kernel
def _sobol_reversed(place: Any) -> Any:
    """Return a number of the second dimension of Sobol's sequence, its 32 bits in opposite order.

    Its direction numbers are (1 + s)^k, s a shift by a bit: with the bits of the place as coefficients of a
    polynomial, it is that of x + 1, halved into a(x) + x^16 b(x), where (x + 1)^16 = x^16 + 1, and so on.
    """
    place ^= place >> _16
    place ^= (place >> _8) & _BYTES
    place ^= (place >> _4) & _NIBBLES
    place ^= (place >> _2) & _PAIRS
    return place ^ ((place >> _1) & _ODD)
