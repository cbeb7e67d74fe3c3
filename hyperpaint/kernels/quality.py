"""Flags of raw counts, gathered over the bands of a line."""

from __future__ import annotations

from typing import Any

import numpy as np

from hyperpaint.base.arrays import Array
from hyperpaint.base.jit import kernel

__all__ = ["count_levels", "flag_line", "gather_row"]


_SATURATED = np.uint16(1)
_BELOW_DARK = np.uint16(2)
_FEW = 20
"""One column in so many costs as much, visited alone, as all of them row by row."""


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
def reaches_limit(counts: Array, saturation_limit: Array, margin: Array, line: Any, band: Any, x: Any) -> Any:
    """Tell whether an element has a margin, and reaches its limit."""
    limit = saturation_limit[0, 0] if saturation_limit.size == 1 else saturation_limit[band, x]
    return (margin[band, x] == margin[band, x]) & (counts[line, band, x] >= limit)


@kernel
def saturated_row(
    counts: Array, saturation_limit: Array, margin: Array, line: Any, band: Any, saturated: Array
) -> None:
    """Mark columns whose element in this band has a margin, and reaches its limit."""
    for x in range(saturated.size):
        saturated[x] |= np.uint16(reaches_limit(counts, saturation_limit, margin, line, band, x))


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

    The bands are visited again only where the counts of single elements decide: in columns that reach the
    lowest limit, or have anything under the dark. A few columns are visited one by one, many row by row. A
    line without data carries the flags of the line alone, since its counts mean nothing.
    """
    if (line_flags & no_data) != 0:
        for x in range(peak.size):
            quality[line, x] = line_flags
        return
    bright, doubtful = 0, 0
    for x in range(peak.size):
        saturated[x] = 0
        below[x] = 0
        bright += peak[x] >= lowest
        doubtful += negative[x] > 0
    few = peak.size // _FEW
    bands = counts.shape[1]
    if bright > few:
        for band in range(bands):
            saturated_row(counts, saturation_limit, margin, line, band, saturated)
    if doubtful > few:
        for band in range(bands):
            below_row(counts, floor, line, band, below)
    for x in range(peak.size):
        if 0 < bright <= few and peak[x] >= lowest:
            for band in range(bands):
                saturated[x] |= np.uint16(reaches_limit(counts, saturation_limit, margin, line, band, x))
        if 0 < doubtful <= few and negative[x] > 0:
            for band in range(bands):
                below[x] |= np.uint16(counts[line, band, x] < floor[band, x])
    for x in range(peak.size):
        found = line_flags | column_flags[x]
        if saturated[x] != 0:
            found |= _SATURATED
        if below[x] != 0 or negative[x] > most_negative:
            found |= _BELOW_DARK
        quality[line, x] = found
