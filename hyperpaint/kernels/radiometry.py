"""Counts to radiance or reflectance, with flags and uncertainties, in one pass over memory.

Rows are short functions, compiled into the loop over lines and bands of `calibrate_slab`. A band's values are
computed in one loop; flags and uncertainties follow while its counts are in the cache. Division and rounding
are IEEE single precision throughout, so the bits do not depend on the number of lines in a slab.
"""

from typing import Any, NamedTuple

import numpy as np

from hyperpaint.base.jit import borrowing_kernel, inlined_kernel, kernel
from hyperpaint.base.schema import Array

from .arguments import (
    Calibration,
    CountLimits,
    ErrorTerms,
    FixedFlags,
    LightCells,
    LineCounts,
    Rounding,
    SlabOutputs,
)
from .linear_counts import linear_memory, rounded, signal_of, signal_row, straighten_dark
from .sample_errors import ErrorMemory, propagate_band

_NAN = np.float32(np.nan)


# --- the dark of a line


@borrowing_kernel
def blend(low: Array, high: Array, weight: Any, out: Array) -> None:
    # Write low + weight (high - low) over (band, column).
    for band in range(out.shape[0]):
        for x in range(out.shape[1]):
            out[band, x] = low[band, x] + weight * (high[band, x] - low[band, x])


@kernel
def dark_of_line(
    counts: Array,
    dark: Array,
    index: Array | None,
    weight: Array | None,
    masked: Array | None,
    line: Any,
    blended: Array,
) -> Array:
    # Return the dark of a line of counts (band, column), computed in ``blended`` where it is not stored.
    #
    # The other arguments are members of `Calibration` and its `DetectorModel`.
    line_dark: Array = dark[0]
    if index is not None and weight is not None:
        blend(dark[index[line]], dark[index[line] + 1], weight[line], blended)
        line_dark = blended
    if masked is not None:
        raise_dark(pedestal_of(counts, line_dark, masked), line_dark, blended)
        line_dark = blended
    return line_dark


# --- values, row by row


@inlined_kernel
def value_row(
    samples: LineCounts,
    signal: Array | None,
    light: LightCells,
    shift: Array | None,
    line_and_band: tuple[Any, Any],
    out: Array,
) -> None:
    # Write the values of ``line_and_band`` from counts, or from the linear ``signal`` above dark.
    #
    # ``signal`` is (column,); ``shift`` is ``light.shift``. Arrays are indexed by line and band: four row
    # views would cost a quarter of the loop's time.
    line, band = line_and_band
    counts, dark, gain = samples.counts, samples.dark, samples.gain
    if shift is None:
        scale = light.coefficients[line, band, 0, 0]
        for x in range(counts.shape[2]):
            raw = np.float32(counts[line, band, x])
            above = raw - dark[band, x] if signal is None else signal[x]
            value = above * (gain[band, x] * scale)
            value = value if raw < samples.saturation_limit else _NAN
            out[line, band, x] = rounded(value, samples.rounding)
    else:
        smile_band = band if shift.shape[0] > 1 else 0
        for run in range(light.cells.shape[1]):
            first, last = light.edges[smile_band, run], light.edges[smile_band, run + 1]
            above_dark = dark[band, first:last] if signal is None else signal[first:last]
            divide_run(
                counts[line, band, first:last],
                above_dark,
                signal,
                gain[band, first:last],
                shift[smile_band, first:last],
                light.coefficients[line, band, light.cells[smile_band, run]],
                samples,
                out[line, band, first:last],
            )


@inlined_kernel
def divide_run(
    counts: Array,
    dark_or_signal: Array,
    signal: Array | None,
    gain: Array,
    shift: Array,
    cubic: Array,
    samples: LineCounts,
    out: Array,
) -> None:
    # Write gain x (counts - dark) / E, or gain x signal / E; E is a cubic in ``shift``.
    c0, c1, c2, c3 = cubic[0], cubic[1], cubic[2], cubic[3]
    for x in range(out.size):
        raw, s = np.float32(counts[x]), shift[x]
        irradiance = c0 + s * (c1 + s * (c2 + s * c3))
        above = raw - dark_or_signal[x] if signal is None else dark_or_signal[x]
        value = above * gain[x] / irradiance
        value = value if raw < samples.saturation_limit else _NAN
        out[x] = rounded(value, samples.rounding)


@inlined_kernel
def limit_row(counts: Array, saturation: Array | None, line_and_band: tuple[Any, Any], out: Array) -> None:
    # Write NaN where counts reach the saturation count of their element (band, column); None does nothing.
    if saturation is not None:
        line, band = line_and_band
        for x in range(counts.shape[2]):
            is_reached = counts[line, band, x] >= saturation[band, x]
            out[line, band, x] = _NAN if is_reached else out[line, band, x]


# --- a slab of lines


@kernel
def calibrate_slab(
    counts: Array,
    calibration: Calibration,
    light: LightCells,
    limits: CountLimits,
    flags: FixedFlags | None,
    terms: ErrorTerms | None,
    rounding: Rounding | None,
    out: SlabOutputs,
) -> None:
    # Calibrate whole lines of counts (line, band, column), uint16 or float32, with flags and uncertainties.
    #
    # The cube is always written; the quality only with ``flags``, the uncertainties only with ``terms``.
    # Absent members of detector and terms are None (`without_empty_arrays`), so that their branches are not
    # compiled.
    n_line, n_band, n_column = counts.shape
    detector = calibration.detector
    is_dark_by_line = calibration.dark_index is not None or detector.masked is not None
    line_dark = np.empty((n_band, n_column) if is_dark_by_line else (0, 0), np.float32)
    linear = linear_memory(detector.polynomial, detector.table, n_band, n_column)
    signal = signal_of(linear)
    if flags is not None:
        level = np.empty((n_band, n_column), counts.dtype)
        floor = np.empty((n_band, n_column), counts.dtype)
        tally = Tally(
            np.empty(n_column, counts.dtype),
            np.empty(n_column, np.uint16),
            np.empty(n_column, np.uint16),
            np.empty(n_column, np.uint16),
        )
    if terms is not None:
        memory = ErrorMemory(
            np.empty((3, n_column), np.float32),
            np.empty((3, n_column), np.float32),
            np.empty(n_column, np.float32),
            rounding,
        )
    for line in range(n_line):
        dark = dark_of_line(
            counts[line],
            calibration.dark,
            calibration.dark_index,
            calibration.dark_weight,
            detector.masked,
            line,
            line_dark,
        )
        if line == 0 or is_dark_by_line:
            straighten_dark(detector, dark, linear)
            if flags is not None:
                count_levels(dark, limits.noise_margin, limits.is_integer, level, floor)
        if flags is not None:
            for x in range(n_column):
                tally.peak[x] = 0
                tally.negative[x] = 0
        # uncertainties follow from values that are not rounded yet
        samples = LineCounts(
            counts, dark, calibration.gain, np.float32(limits.highest), rounding if terms is None else None
        )
        for band in range(n_band):
            line_and_band = (line, band)
            signal_row(counts, detector, linear, line_and_band)
            value_row(samples, signal, light, light.shift, line_and_band, out.cube)
            limit_row(counts, limits.saturation, line_and_band, out.cube)
            if terms is not None:
                propagate_band(samples, linear, detector, light, terms, memory, line_and_band, out)
            if flags is not None:
                gather_row(counts, level, tally, line_and_band)
        if flags is not None:
            flag_line(counts[line], limits, floor, tally, flags, flags.lines[line], out.quality[line])


# --- pedestal of a line: mean counts above dark of masked elements -----------------------------------------


# Masked elements farther from the mean are left out as cosmic rays [standard deviations].
_FAR_SD = 5.0


@borrowing_kernel
def pedestal_of(counts: Array, dark: Array, masked: Array) -> Any:
    # Return the mean of counts less dark (band, column) over ``masked`` elements (n, 2) [count], float32.
    #
    # Computed twice; the second time without elements over `_FAR_SD` standard deviations from the first mean.
    # 0 where no count is finite.
    mean, limit = 0.0, np.inf
    for _ in range(2):
        count, total, squares = 0, 0.0, 0.0
        for k in range(masked.shape[0]):
            excess = float(counts[masked[k, 0], masked[k, 1]]) - float(dark[masked[k, 0], masked[k, 1]])
            if abs(excess - mean) <= limit:
                count += 1
                total += excess - mean
                squares += (excess - mean) ** 2
        if count == 0:
            return np.float32(mean)
        shift = total / count
        mean += shift
        limit = _FAR_SD * np.sqrt(max(squares / count - shift * shift, 0.0)) + 1e-9
    return np.float32(mean)


@borrowing_kernel
def raise_dark(pedestal: Any, dark: Array, out: Array) -> None:
    for band in range(out.shape[0]):
        for x in range(out.shape[1]):
            out[band, x] = dark[band, x] + pedestal


# --- quality flags of raw counts, combined over the bands of a line ----------------------------------------


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
    # Write the dark level, and the dark less its noise margin, as counts (band, column).
    #
    # A sample is below a level exactly when its integer count is below the level rounded up. Levels of an
    # element without a margin are set so that no count is below them.
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
    # Write the quality (column,) of a line of counts (band, column) from the tally of `gather_row`.
    #
    # Bands are visited again only where single elements decide: in columns that reach the lowest saturation
    # count, or have counts below the dark. A few such columns are visited one by one, many row by row. A line
    # without data gets the flags of the line alone.
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
