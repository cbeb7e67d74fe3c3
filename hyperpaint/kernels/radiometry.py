"""Counts to radiance or reflectance, with flags and uncertainties, in one pass over memory.

Rows are short functions, compiled into the loop over lines and bands of `calibrate_slab`, which is what tasks
call: the values of a band in one loop, and while its counts are in the nearest cache what else is asked of
them. Division and rounding are IEEE single precision throughout: the same bits come out whatever the number
of lines in a slab.
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
)  # fmt: skip
from .bit_rounding import rounded
from .linear_counts import linear_memory, signal_of, signal_row, straighten_dark
from .pedestal import pedestal_of, raise_dark
from .quality_flags import Tally, count_levels, flag_line, gather_row
from .sample_errors import ErrorMemory, propagate_band

_NAN = np.float32(np.nan)


# --- the dark of a line


@borrowing_kernel
def blend(low: Array, high: Array, weight: Any, out: Array) -> None:
    """Write low + weight (high - low) over (band, column)."""
    for band in range(out.shape[0]):
        for x in range(out.shape[1]):
            out[band, x] = low[band, x] + weight * (high[band, x] - low[band, x])


@kernel
def dark_of_line(
    counts: Array, dark: Array, index: Array | None, weight: Array | None, masked: Array | None, line: Any,
    mixed: Array,
) -> Array:  # fmt: skip
    """Return the dark of a line of counts (band, column): the one there is, or what is written to ``mixed``.

    The other arguments are those of `Calibration` and its `DetectorModel`.
    """
    own: Array = dark[0]
    if index is not None and weight is not None:
        blend(dark[index[line]], dark[index[line] + 1], weight[line], mixed)
        own = mixed
    if masked is not None:
        raise_dark(pedestal_of(counts, own, masked), own, mixed)
        own = mixed
    return own


# --- values, row by row


@inlined_kernel
def value_row(
    samples: LineCounts, signal: Array | None, light: LightCells, shift: Array | None,
    place: tuple[Any, Any], out: Array,
) -> None:  # fmt: skip
    """Write the values of a ``place`` (line, band) from counts, or from the linear ``signal`` above dark.

    ``signal`` is (column,), ``shift`` that of ``light``. Indexed by line and band: views of four rows would
    cost a quarter of the loop.
    """
    line, band = place
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
        own = band if shift.shape[0] > 1 else 0
        for run in range(light.cells.shape[1]):
            first, last = light.edges[own, run], light.edges[own, run + 1]
            above_dark = dark[band, first:last] if signal is None else signal[first:last]
            divide_run(
                counts[line, band, first:last], above_dark, signal, gain[band, first:last],
                shift[own, first:last], light.coefficients[line, band, light.cells[own, run]], samples,
                out[line, band, first:last],
            )  # fmt: skip


@inlined_kernel
def divide_run(
    counts: Array, dark_or_signal: Array, signal: Array | None, gain: Array, shift: Array, cubic: Array,
    samples: LineCounts, out: Array,
) -> None:  # fmt: skip
    """Write gain * (counts - dark), or where there is one gain * signal, over a cubic in ``shift``."""
    c0, c1, c2, c3 = cubic[0], cubic[1], cubic[2], cubic[3]
    for x in range(out.size):
        raw, s = np.float32(counts[x]), shift[x]
        irradiance = c0 + s * (c1 + s * (c2 + s * c3))
        above = raw - dark_or_signal[x] if signal is None else dark_or_signal[x]
        value = above * gain[x] / irradiance
        value = value if raw < samples.saturation_limit else _NAN
        out[x] = rounded(value, samples.rounding)


@inlined_kernel
def limit_row(counts: Array, saturation: Array | None, place: tuple[Any, Any], out: Array) -> None:
    """Write NaN where counts reach the limits of their own elements (band, column), if these have any."""
    if saturation is not None:
        line, band = place
        for x in range(counts.shape[2]):
            reached = counts[line, band, x] >= saturation[band, x]
            out[line, band, x] = _NAN if reached else out[line, band, x]


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

    Written are the cube; ``flags`` given, the quality; ``terms`` given, the uncertainties. The detector and
    the terms hold None where they hold nothing (`hyperpaint.kernels.arguments.given`): a loop is compiled for
    what is there.
    """
    n_line, n_band, n_column = counts.shape
    detector = calibration.detector
    own_dark = calibration.dark_index is not None or detector.masked is not None  # of every line
    mixed_dark = np.empty((n_band, n_column) if own_dark else (0, 0), np.float32)
    linear = linear_memory(detector.polynomial, detector.table, n_band, n_column)
    signal = signal_of(linear)
    if flags is not None:
        level = np.empty((n_band, n_column), counts.dtype)
        floor = np.empty((n_band, n_column), counts.dtype)
        tally = Tally(
            np.empty(n_column, counts.dtype), np.empty(n_column, np.uint16),
            np.empty(n_column, np.uint16), np.empty(n_column, np.uint16),
        )  # fmt: skip
    if terms is not None:
        memory = ErrorMemory(
            np.empty((3, n_column), np.float32), np.empty((3, n_column), np.float32),
            np.empty(n_column, np.float32), rounding,
        )  # fmt: skip
    for line in range(n_line):
        dark = dark_of_line(
            counts[line], calibration.dark, calibration.dark_index, calibration.dark_weight, detector.masked,
            line, mixed_dark,
        )  # fmt: skip
        if line == 0 or own_dark:
            straighten_dark(detector, dark, linear)
            if flags is not None:
                count_levels(dark, limits.noise_margin, limits.whole, level, floor)
        if flags is not None:
            for x in range(n_column):
                tally.peak[x] = 0
                tally.negative[x] = 0
        # uncertainties follow from values that are not rounded yet
        samples = LineCounts(
            counts, dark, calibration.gain, np.float32(limits.highest), rounding if terms is None else None
        )
        for band in range(n_band):
            place = (line, band)
            signal_row(counts, detector, linear, place)
            value_row(samples, signal, light, light.shift, place, out.cube)
            limit_row(counts, limits.saturation, place, out.cube)
            if terms is not None:
                propagate_band(samples, linear, detector, light, terms, memory, place, out)
            if flags is not None:
                gather_row(counts, level, tally, place)
        if flags is not None:
            flag_line(counts[line], limits, floor, tally, flags, flags.lines[line], out.quality[line])
