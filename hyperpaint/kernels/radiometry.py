"""Counts to radiance or reflectance, with flags and uncertainties, in one pass over memory.

Rows are short functions, compiled into the loop over lines and bands of `calibrate_slab`. A band's values are
computed in one loop; flags and uncertainties follow while its counts are in the cache. Division and rounding
are IEEE single precision throughout, so the bits do not depend on the number of lines in a slab.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from hyperpaint.base.arrays import Array
from hyperpaint.base.jit import borrowing_kernel, inlined_kernel, kernel

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
from .bit_rounding import rounded
from .linear_counts import linear_memory, signal_of, signal_row, straighten_dark
from .pedestal import pedestal_of, raise_dark
from .quality_flags import Tally, count_levels, flag_line, gather_row
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
    """Return the dark of a line of counts (band, column), computed in ``blended`` where it is not stored.

    The other arguments are members of `Calibration` and its `DetectorModel`.
    """
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
    """Write the values of ``line_and_band`` from counts, or from the linear ``signal`` above dark.

    ``signal`` is (column,); ``shift`` is ``light.shift``. Arrays are indexed by line and band: four row views
    would cost a quarter of the loop's time.
    """
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
    """Calibrate whole lines of counts (line, band, column), uint16 or float32, with flags and uncertainties.

    The cube is always written; the quality only with ``flags``, the uncertainties only with ``terms``. Absent
    members of detector and terms are None (`without_empty_arrays`), so that their branches are not compiled.
    """
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
