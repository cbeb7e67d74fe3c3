"""The code of a path, its source of light and its spectra; and the random numbers that paths draw.

The code is one int64, so that a stored table of weights needs no key:

* bits 0 to 4: the source: 0 the uniform sky, 1 the overcast sky, 2 to 7 the suns, from 8 the functions of
  the clear sky of every sun (`hyperpaint.light.sky_functions`): 8 to 11, of the second sun 12 to 15;
* bit 5: mirror reflection by the coat of the first surface;
* bit 6: reflection by more than one surface;
* from bit 7, ``depth`` digits of ``digit_bits`` bits, the lowest first: the number of a factor plus 1, or 0
  for none, in descending order, so that equal products have equal codes.

A negative code is an empty slot.

Random numbers keyed by (seed, line, column, sample, draw), independent of the order of calls.

Numbers of a sequential stream would depend on the blocks of lines. Counters give independent numbers
(`uniforms`); for the first reflections of a pixel's paths, numbers of an even sequence give less noise
(`even_pair`).
"""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from hyperpaint.base import Bools, Ints, SchemaError
from hyperpaint.base.jit import borrowing_kernel

#: Numbers of the sources.
SKY, OVERCAST_SKY, FIRST_SUN, FIRST_CLEAR_SKY = 0, 1, 2, 8

#: Maximum number of suns of a trace.
MAX_SUNS = FIRST_CLEAR_SKY - FIRST_SUN

#: Number of functions of the clear sky of a sun, besides the uniform sky.
CLEAR_SKY_FUNCTIONS = 4

#: Bits of the source, stored in the attributes of a trace, because older traces have 3.
SOURCE_BITS = 5

#: Number of possible sources.
SOURCES = 1 << SOURCE_BITS

#: Bits of the flags.
MIRROR, INDIRECT = 1 << SOURCE_BITS, 2 << SOURCE_BITS

#: Lowest bit of the first digit, and number of bits of a non-negative code.
FIRST_DIGIT, USABLE_BITS = SOURCE_BITS + 2, 63


def source_of(codes: Ints) -> Ints:
    # number of the source of every code
    return codes & (SOURCES - 1)


def is_direct(codes: Ints) -> Bools:
    # whether paths start at a sun; light of the sky is diffuse
    source = source_of(codes)
    return np.asarray((source >= FIRST_SUN) & (source < FIRST_CLEAR_SKY))


def is_mirrored(codes: Ints) -> Bools:
    # whether paths were mirrored by the coat of the first surface
    return np.asarray((codes & MIRROR) != 0)


def is_indirect(codes: Ints) -> Bools:
    # whether paths met more than one surface
    return np.asarray((codes & INDIRECT) != 0)


@dataclass(frozen=True)
class PathCodes:
    """Digit layout of the path codes of a trace.

    Attributes
    ----------
    depth
        Maximum number of factors of a path.
    digit_bits
        Bits of a digit.

    Examples
    --------
    >>> codes = PathCodes.of(factors=14, depth=4)
    >>> codes.digit_bits
    4
    >>> codes.factors(np.array([2 + (12 << 7) + (4 << 11)]))  # source 2, factors 11 and 3
    array([[11,  3, -1, -1]])
    """

    depth: int
    digit_bits: int

    @classmethod
    def of(cls, factors: int, depth: int) -> Self:
        # Return the codes for a number of factors and of scatterings.
        #
        # Raises `SchemaError`: The digits do not fit into 63 bits.
        SchemaError.raise_if(
            depth < 1, f"depth={depth}", expected="at least 1 scattering", code="value-out-of-range"
        )
        bits = max(factors, 1).bit_length()
        max_depth = (USABLE_BITS - FIRST_DIGIT) // bits
        SchemaError.raise_if(
            depth > max_depth,
            f"{factors} spectra and depth={depth} do not fit into the code of a path",
            mend=f"take depth={max_depth} or less, or fewer materials (twice counted with flakes)",
            code="path-code-too-long",
        )
        return cls(depth, bits)

    def factors(self, codes: Ints) -> Ints:
        # factors of every code, shape (code, depth); -1 for no factor
        shifts = FIRST_DIGIT + self.digit_bits * np.arange(self.depth)
        digits = (np.asarray(codes, np.int64)[:, None] >> shifts) & ((1 << self.digit_bits) - 1)
        return np.asarray(digits - 1)


_MASK = np.uint64(0xFFFFFFFF)
_WORD_BITS = np.uint64(32)
_MULTIPLIER_0, _MULTIPLIER_1 = np.uint64(0xD2511F53), np.uint64(0xCD9E8D57)
_WEYL_0, _WEYL_1 = np.uint64(0x9E3779B9), np.uint64(0xBB67AE85)
_STEP = 2.0**-32
_PIXEL = 65536  # number of the draw for the key of a pixel

_0, _1, _2, _4, _8, _16 = (np.uint64(count) for count in (0, 1, 2, 4, 8, 16))
_15 = np.uint64(15)
_ODD, _PAIRS, _NIBBLES, _BYTES = (np.uint64(m) for m in (0x55555555, 0x33333333, 0x0F0F0F0F, 0x00FF00FF))
_MIX_0, _MIX_1 = np.uint64(0x7FEB352D), np.uint64(0x846CA68B)
_OWEN = tuple(np.uint64(m) for m in (0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6))
_OWEN_0, _OWEN_1, _OWEN_2, _OWEN_3 = _OWEN


@borrowing_kernel
def place_of(table: Any, code: Any) -> Any:
    # place of a code in an open-addressing table, whose length is a power of two, or the empty place for it
    mask = table.size - 1
    place = np.int64((np.uint64((code ^ (code >> 29)) & 0xFFFFFFFF) * _WEYL_0) >> _16) & mask
    while table[place] >= 0 and table[place] != code:
        place = (place + 1) & mask
    return place


@borrowing_kernel
def philox(c0: Any, c1: Any, c2: Any, c3: Any, k0: Any, k1: Any) -> tuple[Any, Any, Any, Any]:
    # four words of 32 bits: Philox4x32-10
    # c0, c1, c2, c3: the counter, words of 32 bits in uint64
    # k0, k1: the key, words of 32 bits in uint64
    # J. K. Salmon, M. A. Moraes, R. O. Dror, D. E. Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC11
    # (2011). Products of two 32-bit words fit 64 bits, so that nothing overflows, compiled or not.
    for _ in range(10):
        product_0 = _MULTIPLIER_0 * c0
        product_1 = _MULTIPLIER_1 * c2
        c0 = (product_1 >> _WORD_BITS) ^ c1 ^ k0
        c2 = (product_0 >> _WORD_BITS) ^ c3 ^ k1
        c1 = product_1 & _MASK
        c3 = product_0 & _MASK
        k0 = (k0 + _WEYL_0) & _MASK
        k1 = (k1 + _WEYL_1) & _MASK
    return c0, c1, c2, c3


@borrowing_kernel
def uniforms(seed: Any, line: Any, column: Any, sample: Any, draw: Any) -> tuple[float, float, float, float]:
    # four numbers inside (0, 1) for a draw of a sample of a pixel
    # seed: non-negative integer
    # line, column, sample, draw: non-negative integers below 2^32: scan line of the flight line, column,
    # sample of the pixel, and number of the draw
    key = np.uint64(seed)
    a, b, c, d = philox(
        np.uint64(line), np.uint64(column), np.uint64(sample), np.uint64(draw), key & _MASK, key >> _WORD_BITS
    )
    return (
        (np.float64(a) + 0.5) * _STEP,
        (np.float64(b) + 0.5) * _STEP,
        (np.float64(c) + 0.5) * _STEP,
        (np.float64(d) + 0.5) * _STEP,
    )


@borrowing_kernel
def pixel_key(seed: Any, line: Any, column: Any) -> Any:
    # key of a pixel: a random word of 32 bits, in uint64
    key = np.uint64(seed)
    word, _, _, _ = philox(
        np.uint64(line), np.uint64(column), _0, np.uint64(_PIXEL), key & _MASK, key >> _WORD_BITS
    )
    return word


@borrowing_kernel
def even_pair(key: Any, sample: Any, draw: Any, mask: Any) -> tuple[float, float]:
    # two numbers inside (0, 1): a point of a sequence that fills the square evenly
    # key: key of the pixel
    # sample: number of the point
    # draw: number of the draw, which changes the order of the points
    # mask: a power of two minus 1, at least the number of the last sample
    # The first two dimensions of Sobol's sequence, scrambled as by A. B. Owen, "Randomly permuted
    # (t,m,s)-nets and (t,s)-sequences" (1995), in an order scrambled in the same way: B. Burley, "Practical
    # hash-based Owen scrambling", JCGT 9 (2020). A single point is distributed uniformly, so that means over
    # pixels have no bias.
    seed = _hashed((np.uint64(key) ^ (np.uint64(draw) * _WEYL_0)) & _MASK)
    number = _reversed(_scrambled(_reversed(np.uint64(sample)), seed)) & np.uint64(mask)
    x = _scrambled(number, _hashed(seed ^ _1))  # the radical inverse is the reversed number
    y = _scrambled(_sobol_reversed(number), _hashed(seed ^ _2))
    return (np.float64(_reversed(x)) + 0.5) * _STEP, (np.float64(_reversed(y)) + 0.5) * _STEP


@borrowing_kernel
def _hashed(x: Any) -> Any:
    # hash by C. Wellons, "Prospecting for hash functions"
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
    # flip bits depending on lower bits (Laine and Karras 2011, constants of Vegdahl)
    x = (x + seed) & _MASK
    x ^= (x * _OWEN_0) & _MASK
    x ^= (x * _OWEN_1) & _MASK
    x ^= (x * _OWEN_2) & _MASK
    return x ^ ((x * _OWEN_3) & _MASK)


@borrowing_kernel
def _sobol_reversed(place: Any) -> Any:
    # second dimension of Sobol's sequence with its 32 bits reversed.
    # Its direction numbers are (1 + s)^k with the shift s by a bit. With the bits of the argument as
    # coefficients of a polynomial p(x), the result is p(x + 1): halves are combined by p = a(x) + x^16 b(x)
    # and (x + 1)^16 = x^16 + 1, and so on for quarters.
    place ^= place >> _16
    place ^= (place >> _8) & _BYTES
    place ^= (place >> _4) & _NIBBLES
    place ^= (place >> _2) & _PAIRS
    return place ^ ((place >> _1) & _ODD)
