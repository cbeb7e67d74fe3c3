"""Flags of raw counts, gathered over the bands of a line."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ._jit import kernel

__all__ = ["flag_line", "gather_row"]

Array = npt.NDArray[Any]

_SATURATED = np.uint16(1)
_BELOW_DARK = np.uint16(2)


@kernel
def gather_row(counts: Array, zero: Array, line: Any, band: Any, peak: Array, negative: Array) -> None:
    """Keep the highest counts of each column, and how many of its bands lie under the dark.

    Two loops, since one that wrote two arrays would not be vectorised.
    """
    for x in range(peak.size):
        peak[x] = max(peak[x], counts[line, band, x])
    for x in range(peak.size):
        negative[x] += np.uint16(counts[line, band, x] < zero[band, x])


@kernel
def flag_line(
    counts: Array,
    limit: Array,
    lowest: Any,
    floor: Array,
    watched: Array,
    peak: Array,
    negative: Array,
    limits: Array,
    line_flags: Any,
    column_flags: Array,
    line: Any,
    quality: Array,
) -> None:
    """Write the quality of one line from what `gather_row` kept.

    Bands are visited again only where the counts of an element decide: in a column that reaches the lowest
    limit, or with anything under the dark. Elements that are not watched set nothing. A line without data
    carries the flags of the line alone, since its counts mean nothing.
    """
    if (line_flags & limits[1]) != 0:
        for x in range(peak.size):
            quality[line, x] = line_flags
        return
    for x in range(peak.size):
        found = line_flags | column_flags[x]
        if peak[x] >= lowest:
            for band in range(counts.shape[1]):
                own = limit[0, 0] if limit.size == 1 else limit[band, x]
                if watched[band, x] and counts[line, band, x] >= own:
                    found |= _SATURATED
        if negative[x] > limits[0]:
            found |= _BELOW_DARK
        elif negative[x] > 0:
            for band in range(counts.shape[1]):
                if counts[line, band, x] < floor[band, x]:
                    found |= _BELOW_DARK
        quality[line, x] = found
