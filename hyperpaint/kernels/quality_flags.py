"""Quality flags of raw counts, combined over the bands of a line."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from hyperpaint.base.arrays import Array
from hyperpaint.base.jit import borrowing_kernel, inlined_kernel

from .arguments import CountLimits, FixedFlags

_ZERO = np.float32(0.0)
_SATURATED = np.uint16(1)
_BELOW_DARK = np.uint16(2)
# With more doubtful columns than one in this number, visiting all columns row by row is faster.
_COLUMNS_PER_DOUBTFUL = 20


# Per-column statistics of a line.
class Tally(NamedTuple):
    #: peak, negative (column,): highest count over the bands, and number of bands below the dark
    peak: Array
    negative: Array
    #: saturated, below (column,) uint16: whether an element is saturated, or below the dark by more than
    #: noise
    saturated: Array
    below: Array


@borrowing_kernel
def count_levels(dark: Array, margin: Array, is_integer: Any, level: Array, floor: Array) -> None:
    """Write the dark level, and the dark less its noise margin, as counts (band, column).

    A sample is below a level exactly when its integer count is below the level rounded up. Levels of an
    element without a margin are set so that no count is below them.
    """
    lowest = np.float32(0.0 if is_integer else -np.inf)
    for band in range(dark.shape[0]):
        for x in range(dark.shape[1]):
            high, low = dark[band, x], dark[band, x] - margin[band, x]
            if is_integer:
                high, low = np.ceil(high), np.ceil(low)
                high, low = high if high > _ZERO else _ZERO, low if low > _ZERO else _ZERO
            has_margin = margin[band, x] == margin[band, x]
            level[band, x] = high if has_margin else lowest
            floor[band, x] = low if has_margin else lowest


@inlined_kernel
def gather_row(counts: Array, level: Array, tally: Tally, line_and_band: tuple[Any, Any]) -> None:
    # Update each column's highest count, and its number of bands below the dark.
    line, band = line_and_band
    peak, negative = tally.peak, tally.negative
    for x in range(counts.shape[2]):
        raw = counts[line, band, x]
        peak[x] = raw if raw > peak[x] else peak[x]
        negative[x] += np.uint16(raw < level[band, x])


@inlined_kernel
def limit_of(saturation: Array | None, limits: CountLimits, band: Any, x: Any) -> Any:
    return limits.highest if saturation is None else saturation[band, x]


@inlined_kernel
def check_element(counts: Array, limits: CountLimits, floor: Array, tally: Tally, band: Any, x: Any) -> None:
    # Mark a column whose element is saturated (if it has a margin), or is below its floor.
    raw, margin = counts[band, x], limits.noise_margin[band, x]
    is_reached = raw >= limit_of(limits.saturation, limits, band, x)
    tally.saturated[x] |= np.uint16(is_reached & (margin == margin))
    tally.below[x] |= np.uint16(raw < floor[band, x])


@borrowing_kernel
def flag_line(
    counts: Array,
    limits: CountLimits,
    floor: Array,
    tally: Tally,
    flags: FixedFlags,
    line_flags: Any,
    quality: Array,
) -> None:
    """Write the quality (column,) of a line of counts (band, column) from the tally of `gather_row`.

    Bands are visited again only where single elements decide: in columns that reach the lowest saturation
    count, or have counts below the dark. A few such columns are visited one by one, many row by row. A line
    without data gets the flags of the line alone.
    """
    bands, columns = counts.shape
    if (line_flags & flags.no_data) != 0:
        for x in range(columns):
            quality[x] = line_flags
        return
    doubtful = 0
    for x in range(columns):
        tally.saturated[x] = 0
        tally.below[x] = 0
        doubtful += (tally.peak[x] >= limits.lowest) | (tally.negative[x] > 0)
    if doubtful > columns // _COLUMNS_PER_DOUBTFUL:
        for band in range(bands):
            for x in range(columns):
                check_element(counts, limits, floor, tally, band, x)
    elif doubtful > 0:
        for x in range(columns):
            if tally.peak[x] >= limits.lowest or tally.negative[x] > 0:
                for band in range(bands):
                    check_element(counts, limits, floor, tally, band, x)
    for x in range(columns):
        bits = line_flags | flags.columns[x]
        if tally.saturated[x] != 0:
            bits |= _SATURATED
        if tally.below[x] != 0 or tally.negative[x] > limits.max_negative_bands:
            bits |= _BELOW_DARK
        quality[x] = bits
