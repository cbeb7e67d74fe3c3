"""Counts to radiance or reflectance, with flags and uncertainties, in one pass over memory.

Rows are short functions of their own, which the compiler inlines and vectorises; the slab function below is
what tasks call. Division and rounding are IEEE single precision throughout: the same bits come out whatever
the number of lines in a slab.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from hyperpaint.base.arrays import Array
from hyperpaint.base.jit import borrowing_kernel, kernel

from .arguments import (
    Calibration,
    CountLimits,
    ErrorTerms,
    FixedFlags,
    LightCells,
    SlabOutputs,
)  # fmt: skip
from .linear_counts import (
    LinearRow,
    linear_random_row,
    scale_linear_row,
    signal_row,
    slope_row,
    straighten_row,
)  # fmt: skip
from .pedestal import pedestal_of, raise_dark

__all__ = ["calibrate_slab", "round_row"]


_NAN = np.float32(np.nan)
_ONE = np.uint32(1)
_ONE_F32 = np.float32(1.0)
_NOTHING = np.float32(0.0)
_SATURATED = np.uint16(1)
_BELOW_DARK = np.uint16(2)
_FEW = 20
"""One column in so many costs as much, visited alone, as all of them row by row."""


class Tally(NamedTuple):
    """What is counted of a line, column by column: memory of `calibrate_slab`."""

    #: peak, negative (column,): highest counts over the bands, and how many bands lie under the dark
    peak: Array
    negative: Array
    #: saturated, below (column,) uint16: whether an element reaches its limit, or lies under the dark beyond
    #: noise
    saturated: Array
    below: Array


class BandLight(NamedTuple):
    """What dark-subtracted counts times gain are divided by, and its inverse, of a band and two before."""

    #: irradiance, inverse (3, column) float32: band ``b`` is in row ``b % 3``
    irradiance: Array
    inverse: Array
    per_count: Array  #: (column,) float32: reflectance per count of the band in work


# --- values, row by row


@borrowing_kernel
def scale_row(
    counts: Array,
    dark: Array,
    gain: Array,
    scale: Any,
    saturation_limit: Any,
    place: tuple[int, int],
    out: Array,
) -> None:
    """Write gain * scale * (counts - dark) of a ``place`` (line, band); NaN from ``saturation_limit`` on.

    Indexed by line and band: views of four rows would cost a quarter of the loop.
    """
    line, band = place
    for x in range(counts.shape[2]):
        raw = counts[line, band, x]
        value = (np.float32(raw) - dark[band, x]) * (gain[band, x] * scale)
        out[line, band, x] = value if raw < saturation_limit else _NAN


@borrowing_kernel
def divide_row(
    counts: Array, dark: Array, gain: Array, shift: Array, cubic: Array, saturation_limit: Any, out: Array
) -> None:
    """Write gain * (counts - dark) over a cubic in ``shift``; NaN from ``saturation_limit`` counts on."""
    c0, c1, c2, c3 = cubic[0], cubic[1], cubic[2], cubic[3]
    for x in range(out.size):
        s = shift[x]
        irradiance = c0 + s * (c1 + s * (c2 + s * c3))
        value = (np.float32(counts[x]) - dark[x]) * gain[x] / irradiance
        out[x] = value if counts[x] < saturation_limit else _NAN


@borrowing_kernel
def limit_row(counts: Array, saturation_limit: Array, out: Array) -> None:
    """Write NaN where counts reach the limits of their own elements."""
    for x in range(out.size):
        out[x] = out[x] if counts[x] < saturation_limit[x] else _NAN


@borrowing_kernel
def round_row(bits: Array, cleared_bits: Any) -> None:
    """Round float32 values, given as uint32, to nearest-even, in place; as numcodecs' BitRound does."""
    half = (_ONE << (cleared_bits - _ONE)) - _ONE
    keep = ~((_ONE << cleared_bits) - _ONE)
    for x in range(bits.size):
        value = bits[x]
        bits[x] = (value + half + ((value >> cleared_bits) & _ONE)) & keep


@borrowing_kernel
def blend(low: Array, high: Array, weight: Any, out: Array) -> None:
    """Write low + weight (high - low) over (band, column)."""
    for band in range(out.shape[0]):
        for x in range(out.shape[1]):
            out[band, x] = low[band, x] + weight * (high[band, x] - low[band, x])


# --- values of linear counts


@borrowing_kernel
def light_signal_row(
    signal: Array, gain: Array, light: LightCells, place: tuple[int, int], nothing: Array, out: Array
) -> None:
    """Write the values of linear counts above dark (column,) of a ``place`` (line, band).

    ``nothing`` (column,) is zero: the dark has been subtracted.
    """
    line, band = place
    if light.coefficients.shape[3] == 1:
        scale = light.coefficients[line, band, 0, 0]
        for x in range(out.size):
            out[x] = signal[x] * (gain[x] * scale)
        return
    own = band if light.shift.shape[0] > 1 else 0
    for run in range(light.cells.shape[1]):
        first, last = light.edges[own, run], light.edges[own, run + 1]
        divide_row(
            signal[first:last], nothing[first:last], gain[first:last], light.shift[own, first:last],
            light.coefficients[line, band, light.cells[own, run]], np.float32(np.inf), out[first:last],
        )  # fmt: skip


# --- flags of raw counts, gathered over the bands of a line


@borrowing_kernel
def count_levels(dark: Array, margin: Array, whole: Any, level: Array, floor: Array) -> None:
    """Write the counts below which a sample lies under the dark, and under it beyond noise (band, column).

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


@borrowing_kernel
def gather_row(counts: Array, level: Array, peak: Array, negative: Array) -> None:
    """Keep the highest counts of each column, and how many of its bands lie under the dark.

    Two loops, since one that wrote two arrays would not be vectorised.
    """
    for x in range(peak.size):
        peak[x] = max(peak[x], counts[x])
    for x in range(peak.size):
        negative[x] += np.uint16(counts[x] < level[x])


@borrowing_kernel
def reaches_limit(counts: Array, limits: CountLimits, band: Any, x: Any) -> Any:
    """Tell whether an element of a line (band, column) has a margin, and reaches its limit."""
    one = limits.saturation.size == 1
    limit = limits.saturation[0, 0] if one else limits.saturation[band, x]
    margin = limits.noise_margin[band, x]
    return (margin == margin) & (counts[band, x] >= limit)


@borrowing_kernel
def saturated_row(counts: Array, limits: CountLimits, band: Any, saturated: Array) -> None:
    """Mark columns whose element in this band has a margin, and reaches its limit."""
    for x in range(saturated.size):
        saturated[x] |= np.uint16(reaches_limit(counts, limits, band, x))


@borrowing_kernel
def below_row(counts: Array, floor: Array, below: Array) -> None:
    """Mark columns whose element in this band lies under the dark beyond noise."""
    for x in range(below.size):
        below[x] |= np.uint16(counts[x] < floor[x])


@borrowing_kernel
def flag_line(
    counts: Array,
    limits: CountLimits,
    lowest: Any,
    floor: Array,
    tally: Tally,
    line_flags: Any,
    flags: FixedFlags,
    quality: Array,
) -> None:
    """Write the quality (column,) of one line of counts (band, column) from what `gather_row` kept.

    The bands are visited again only where the counts of single elements decide: in columns that reach the
    ``lowest`` limit, or have anything under the dark. A few columns are visited one by one, many row by row.
    A line without data carries the flags of the line alone, since its counts mean nothing.
    """
    peak, negative, saturated, below = tally.peak, tally.negative, tally.saturated, tally.below
    if (line_flags & flags.no_data) != 0:
        for x in range(peak.size):
            quality[x] = line_flags
        return
    bright, doubtful = 0, 0
    for x in range(peak.size):
        saturated[x] = 0
        below[x] = 0
        bright += peak[x] >= lowest
        doubtful += negative[x] > 0
    few = peak.size // _FEW
    bands = counts.shape[0]
    if bright > few:
        for band in range(bands):
            saturated_row(counts, limits, band, saturated)
    if doubtful > few:
        for band in range(bands):
            below_row(counts[band], floor[band], below)
    for x in range(peak.size):
        if 0 < bright <= few and peak[x] >= lowest:
            for band in range(bands):
                saturated[x] |= np.uint16(reaches_limit(counts, limits, band, x))
        if 0 < doubtful <= few and negative[x] > 0:
            for band in range(bands):
                below[x] |= np.uint16(counts[band, x] < floor[band, x])
    for x in range(peak.size):
        bits = line_flags | flags.columns[x]
        if saturated[x] != 0:
            bits |= _SATURATED
        if below[x] != 0 or negative[x] > limits.most_negative:
            bits |= _BELOW_DARK
        quality[x] = bits


# --- how sure every sample is: noise, and what is common to a flight
#     Each loop writes one array, since one that wrote two would not be vectorised.


@borrowing_kernel
def light_run(cubic: Array, shift: Array, irradiance: Array) -> None:
    """Write a cubic in ``shift`` (column,)."""
    c0, c1, c2, c3 = cubic[0], cubic[1], cubic[2], cubic[3]
    for x in range(irradiance.size):
        s = shift[x]
        irradiance[x] = c0 + s * (c1 + s * (c2 + s * c3))


@borrowing_kernel
def light_row(light: LightCells, line: Any, band: Any, irradiance: Array, inverse: Array) -> None:
    """Write what dark-subtracted counts times gain are divided by, and its inverse (column,)."""
    if light.coefficients.shape[3] == 1:
        inverse[:] = light.coefficients[line, band, 0, 0]
        irradiance[:] = _ONE_F32 / light.coefficients[line, band, 0, 0]
        return
    own = band if light.shift.shape[0] > 1 else 0
    for run in range(light.cells.shape[1]):
        first, last = light.edges[own, run], light.edges[own, run + 1]
        cubic = light.coefficients[line, band, light.cells[own, run]]
        light_run(cubic, light.shift[own, first:last], irradiance[first:last])
    for x in range(inverse.size):
        inverse[x] = _ONE_F32 / irradiance[x]


@borrowing_kernel
def random_row(
    values: Array, gain: Array, inverse: Array, per_electron: Array, noise_floor: Array, u_random: Array
) -> None:
    """Write m sqrt(signal / k + floor), m reflectance per count; a negative signal adds no variance."""
    for x in range(u_random.size):
        value, per_count = values[x], abs(gain[x] * inverse[x])
        # not max(), which would lose the NaN
        shot = _NOTHING if value < _NOTHING else value
        variance = per_count * (shot * per_electron[x] + per_count * noise_floor[x])
        u_random[x] = np.sqrt(variance)


@borrowing_kernel
def proportional_row(values: Array, relative: Array, u_systematic: Array) -> None:
    """Write the systematic uncertainty where all of it is proportional to reflectance."""
    for x in range(u_systematic.size):
        u_systematic[x] = abs(values[x]) * relative[x]


@borrowing_kernel
def offset_row(
    values: Array, gain: Array, inverse: Array, relative: Array, offset: Array, out: Array
) -> None:
    """Write the systematic uncertainty where it is of reflectance and of the dark alone."""
    for x in range(out.size):
        scale, dark = values[x] * relative[x], gain[x] * inverse[x] * offset[x]
        out[x] = np.sqrt(scale * scale + dark * dark)


@borrowing_kernel
def systematic_row(
    values: Array, gain: Array, lit: BandLight, terms: ErrorTerms, band: Any, u_systematic: Array
) -> None:
    """Write the systematic uncertainty of a band, from its line (band, column)."""
    low, high = max(band - 1, 0), min(band + 1, values.shape[0] - 1)
    row, row_low, row_high = band % 3, low % 3, high % 3
    relative = terms.relative[band if terms.relative.shape[0] > 1 else 0]
    offset = terms.offset[band if terms.offset.shape[0] > 1 else 0]
    irradiance, inverse, slope = lit.irradiance, lit.inverse, terms.slope
    up, up_alone, down, down_alone = slope[band, 0], slope[band, 1], slope[band, 2], slope[band, 3]
    # indexed by band: with a view of every row the compiler would have too many arrays to tell apart
    for x in range(u_systematic.size):
        here, per_light = values[band, x], inverse[row, x]
        # radiance of the neighbours, in units of this band's light
        below = values[low, x] * (irradiance[row_low, x] * per_light)
        above = values[high, x] * (irradiance[row_high, x] * per_light)
        rise = above - here if above == above else _NOTHING
        fall = here - below if below == below else _NOTHING
        # without one neighbour, the other alone tells the slope
        to_above = up if below == below else up_alone
        to_below = down if above == above else down_alone
        wavelength = rise * to_above + fall * to_below
        dark = gain[band, x] * per_light * offset[x]
        scale = here * relative[x]
        u_systematic[x] = np.sqrt(scale * scale + (wavelength * wavelength + dark * dark))


@borrowing_kernel
def propagate_line(
    counts: Array, dark: Array, calibration: Calibration, light: LightCells, terms: ErrorTerms, line: Any,
    lit: BandLight, out: SlabOutputs,
) -> None:  # fmt: skip
    """Write the random and the systematic uncertainty of a line, whose reflectance is not yet rounded.

    The systematic one of a band needs the light of the band after it, and so comes one band later.
    ``counts`` and the line's ``dark`` are (band, column); ``lit`` is memory to work in.
    """
    values, gain, detector = out.cube[line], calibration.gain, calibration.detector
    last = values.shape[0] - 1
    for band in range(last + 1):
        inverse = lit.inverse[band % 3]
        light_row(light, line, band, lit.irradiance[band % 3], inverse)
        per_electron = terms.per_electron[band if terms.per_electron.shape[0] > 1 else 0]
        noise_floor = terms.noise_floor[band if terms.noise_floor.shape[0] > 1 else 0]
        u_random = out.u_random[line, band]
        if detector.polynomial.size + detector.table.size > 0:
            per_count = lit.per_count
            slope_row(counts[band], dark[band], detector, per_count)
            for x in range(inverse.size):
                per_count[x] *= gain[band, x] * inverse[x]
            linear_random_row(
                counts[band], dark[band], per_count, per_electron, noise_floor, values[band], u_random
            )
        else:
            random_row(values[band], gain[band], inverse, per_electron, noise_floor, u_random)
        if terms.slope.shape[0] == 0:
            relative = terms.relative[band if terms.relative.shape[0] > 1 else 0]
            u = out.u_systematic[line, band]
            if terms.offset.shape[0] == 0:
                proportional_row(values[band], relative, u)
            else:
                offset = terms.offset[band if terms.offset.shape[0] > 1 else 0]
                offset_row(values[band], gain[band], inverse, relative, offset, u)
            continue
        for done in range(max(band - 1, 0), band + (band == last)):
            systematic_row(values, gain, lit, terms, done, out.u_systematic[line, done])


# --- a slab of lines


@borrowing_kernel
def divide_by_light(
    counts: Array, dark: Array, gain: Array, light: LightCells, saturation_limit: Any, place: tuple[int, int],
    out: Array,
) -> None:  # fmt: skip
    """Write the values of one band of one line, ``place``, under light that varies over the columns.

    ``counts`` and ``out`` are (line, band, column), ``dark`` and ``gain`` (band, column).
    """
    line, band = place
    own = band if light.shift.shape[0] > 1 else 0
    for run in range(light.cells.shape[1]):
        first, last = light.edges[own, run], light.edges[own, run + 1]
        divide_row(
            counts[line, band, first:last], dark[band, first:last], gain[band, first:last],
            light.shift[own, first:last], light.coefficients[line, band, light.cells[own, run]],
            saturation_limit, out[line, band, first:last],
        )  # fmt: skip


@kernel
def calibrate_slab(
    counts: Array,
    calibration: Calibration,
    light: LightCells,
    limits: CountLimits,
    flags: FixedFlags,
    terms: ErrorTerms,
    cleared_bits: Any,
    out: SlabOutputs,
) -> None:
    """Calibrate whole lines of counts (line, band, column), uint16 or float32, with flags and uncertainties.

    What of ``out`` is not empty is written, with ``cleared_bits`` of the mantissas cleared. ``terms`` may be
    empty where no uncertainty is written.
    """
    n_line, n_band, n_column = counts.shape
    dark, gain, detector = calibration.dark, calibration.gain, calibration.detector
    curved = detector.polynomial.size + detector.table.size > 0
    flagging = out.quality.shape[0] > 0
    doubting = out.u_random.shape[0] > 0
    uniform = light.coefficients.shape[3] == 1
    # what is written, as the bits that are rounded
    bits, u_random_bits = out.cube.view(np.uint32), out.u_random.view(np.uint32)
    u_systematic_bits = out.u_systematic.view(np.uint32)
    lights = np.empty((2, 3, n_column), np.float32)
    lit = BandLight(lights[0], lights[1], np.empty(n_column, np.float32))
    lowest, highest = limits.saturation.min(), limits.saturation.max()
    has_pedestal = detector.masked.shape[0] > 0
    own_dark = dark.shape[0] > 1 or has_pedestal  # of every line
    mixed_dark = np.empty((n_band, n_column) if own_dark else (0, 0), np.float32)
    linear_dark = np.empty((n_band, n_column) if curved else (0, 0), np.float32)
    signal, nothing = np.empty(n_column, np.float32), np.zeros(n_column, np.float32)
    work = LinearRow(np.empty(n_column, np.int32), np.empty(n_column, np.float32))
    level = np.empty((n_band, n_column) if flagging else (0, 0), counts.dtype)
    floor = np.empty((n_band, n_column) if flagging else (0, 0), counts.dtype)
    tally = Tally(
        np.empty(n_column, counts.dtype), np.empty(n_column, np.uint16),
        np.empty(n_column, np.uint16), np.empty(n_column, np.uint16),
    )  # fmt: skip
    for line in range(n_line):
        line_dark = dark[0]
        if dark.shape[0] > 1:
            first = calibration.dark_index[line]
            blend(dark[first], dark[first + 1], calibration.dark_weight[line], mixed_dark)
            line_dark = mixed_dark
        if has_pedestal:
            raise_dark(pedestal_of(counts[line], line_dark, detector.masked), line_dark, mixed_dark)
            line_dark = mixed_dark
        if curved and (line == 0 or own_dark):
            linear_dark[:] = line_dark
            for band in range(n_band if detector.on_raw else 0):
                straighten_row(detector, linear_dark[band], work)
        if flagging and (line == 0 or own_dark):
            count_levels(line_dark, limits.noise_margin, limits.whole, level, floor)
        tally.peak[:] = 0
        tally.negative[:] = 0
        for band in range(n_band):
            if curved and uniform and detector.table.size == 0:
                scale = light.coefficients[line, band, 0, 0]
                scale_linear_row(
                    counts, linear_dark, gain, detector, (highest, scale), (line, band), out.cube
                )
            elif curved:
                signal_row(counts[line, band], linear_dark[band], detector, highest, work, signal)
                light_signal_row(signal, gain[band], light, (line, band), nothing, out.cube[line, band])
            elif uniform:  # handing ``light`` on, five arrays, would cost as much as half of the row
                scale = light.coefficients[line, band, 0, 0]
                scale_row(counts, line_dark, gain, scale, highest, (line, band), out.cube)
            else:
                divide_by_light(counts, line_dark, gain, light, highest, (line, band), out.cube)
            if limits.saturation.size > 1:
                limit_row(counts[line, band], limits.saturation[band], out.cube[line, band])
            if cleared_bits > 0 and not doubting:
                round_row(bits[line, band], cleared_bits)
            if flagging:
                gather_row(counts[line, band], level[band], tally.peak, tally.negative)
        if doubting:
            propagate_line(counts[line], line_dark, calibration, light, terms, line, lit, out)
            for band in range(n_band if cleared_bits > 0 else 0):
                round_row(bits[line, band], cleared_bits)
                round_row(u_random_bits[line, band], cleared_bits)
                round_row(u_systematic_bits[line, band], cleared_bits)
        if flagging:
            flag_line(counts[line], limits, lowest, floor, tally, flags.lines[line], flags, out.quality[line])
