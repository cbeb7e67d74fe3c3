"""Flags of raw counts, gathered over the bands of a line."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ._jit import kernel

__all__ = ["count_levels", "flag_line", "gather_row"]

Array = npt.NDArray[Any]

_SATURATED = np.uint16(1)
_BELOW_DARK = np.uint16(2)


@kernel
def count_levels(dark: Array, margin: Array, whole: Any, level: Array, floor: Array) -> None:
    """Write the counts below which a sample lies under the dark, and under it beyond noise.

    An integer is below a bound exactly when it is below the bound rounded up. Nothing is below the levels of
    an element without a margin.
    """
    nothing = -np.inf if not whole else 0.0
    for band in range(dark.shape[0]):
        for x in range(dark.shape[1]):
            high, low = dark[band, x], dark[band, x] - margin[band, x]
            if whole:
                high, low = max(np.ceil(high), np.float32(0.0)), max(np.ceil(low), np.float32(0.0))
            watched = margin[band, x] == margin[band, x]
            level[band, x] = high if watched else nothing
            floor[band, x] = low if watched else nothing


@kernel
def gather_row(counts: Array, level: Array, line: Any, band: Any, peak: Array, negative: Array) -> None:
    """Keep the highest counts of each column, and how many of its bands lie under the dark.

    Two loops, since one that wrote two arrays would not be vectorised.
    """
    for x in range(peak.size):
        peak[x] = max(peak[x], counts[line, band, x])
    for x in range(peak.size):
        negative[x] += np.uint16(counts[line, band, x] < level[band, x])


@kernel
def saturated_row(
    counts: Array, saturation_limit: Array, margin: Array, line: Any, band: Any, saturated: Array
) -> None:
    """Mark columns whose element in this band has a margin, and reaches its limit."""
    one = saturation_limit.size == 1
    for x in range(saturated.size):
        limit = saturation_limit[0, 0] if one else saturation_limit[band, x]
        watched = margin[band, x] == margin[band, x]
        saturated[x] |= np.uint16(watched & (counts[line, band, x] >= limit))


@kernel
def below_row(counts: Array, floor: Array, line: Any, band: Any, below: Array) -> None:
    """Mark columns whose element in this band lies under the dark beyond noise."""
    for x in range(below.size):
        below[x] |= np.uint16(counts[line, band, x] < floor[band, x])


@kernel
def flag_line(
    counts: Array,
    saturation_limit: Array,
    lowest: Any,
    floor: Array,
    margin: Array,
    peak: Array,
    negative: Array,
    most_negative: Any,
    no_data: Any,
    line_flags: Any,
    column_flags: Array,
    line: Any,
    saturated: Array,
    below: Array,
    quality: Array,
) -> None:
    """Write the quality of one line from what `gather_row` kept.

    The bands are visited again only on lines where the counts of single elements decide: where a column
    reaches the lowest limit, or has anything under the dark. A line without data carries the flags of the
    line alone, since its counts mean nothing.
    """
    if (line_flags & no_data) != 0:
        for x in range(peak.size):
            quality[line, x] = line_flags
        return
    bright, doubtful = False, False
    for x in range(peak.size):
        saturated[x] = 0
        below[x] = 0
        bright |= peak[x] >= lowest
        doubtful |= negative[x] > 0
    if bright:
        for band in range(counts.shape[1]):
            saturated_row(counts, saturation_limit, margin, line, band, saturated)
    if doubtful:
        for band in range(counts.shape[1]):
            below_row(counts, floor, line, band, below)
    for x in range(peak.size):
        found = line_flags | column_flags[x]
        if saturated[x] != 0:
            found |= _SATURATED
        if below[x] != 0 or negative[x] > most_negative:
            found |= _BELOW_DARK
        quality[line, x] = found
