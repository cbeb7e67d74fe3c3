"""The code of a path: the source of its light, and the spectra by which it was multiplied.

The code is one int64, so that a stored table of weights needs no key:

* bits 0 to 4: the source: 0 the uniform sky, 1 the overcast sky, 2 to 7 the suns, from 8 the functions of
  the clear sky of every sun (`hyperpaint.light.sky_functions`): 8 to 11, of the second sun 12 to 15;
* bit 5: mirror reflection by the coat of the first surface;
* bit 6: reflection by more than one surface;
* from bit 7, ``depth`` digits of ``digit_bits`` bits, the lowest first: the number of a factor plus 1, or 0
  for none, in descending order, so that equal products have equal codes.

A negative code is an empty slot.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from hyperpaint.base import Bools, Ints, SchemaError

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
        if FIRST_DIGIT + depth * bits > USABLE_BITS:
            max_depth = (USABLE_BITS - FIRST_DIGIT) // bits
            raise SchemaError(
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
