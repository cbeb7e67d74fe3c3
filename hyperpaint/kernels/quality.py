"""Flags of raw counts, gathered over the bands of a line."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ._jit import kernel

__all__ = ["flag_row", "merge_flags"]

Array = npt.NDArray[Any]

_SATURATED = np.uint16(1)
_BELOW_DARK = np.uint16(2)
_NONE = np.uint16(0)


@kernel
def flag_row(
    counts: Array, limit: Array, floor: Array, zero: Array, saturated: Array, below: Array, negative: Array
) -> None:
    """Add one band to the flags of a line.

    Three loops, since one that wrote three arrays would not be vectorised.
    """
    if limit.size == 1:
        for x in range(counts.size):
            saturated[x] |= np.uint16(counts[x] >= limit[0])
    else:
        for x in range(counts.size):
            saturated[x] |= np.uint16(counts[x] >= limit[x])
    for x in range(counts.size):
        below[x] |= np.uint16(counts[x] < floor[x])
    for x in range(counts.size):
        negative[x] += np.uint16(counts[x] < zero[x])


@kernel
def merge_flags(
    saturated: Array,
    below: Array,
    negative: Array,
    limits: Array,
    line_flags: Any,
    column_flags: Array,
    quality: Array,
) -> None:
    """Write the quality of one line from what `flag_row` gathered.

    A line without data carries the flags of the line alone: its counts mean nothing.
    """
    no_data = (line_flags & limits[1]) != 0
    for x in range(quality.size):
        found = saturated[x] * _SATURATED
        dark = below[x] != 0 or negative[x] > limits[0]
        found |= _BELOW_DARK if dark else _NONE
        quality[x] = line_flags if no_data else found | line_flags | column_flags[x]
