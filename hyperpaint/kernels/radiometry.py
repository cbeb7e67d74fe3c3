"""Counts to radiance or reflectance, with flags and uncertainties, in one pass over memory.

Rows are short functions, compiled into the loop over lines and bands of `calibrate_slab`. A band's values are
computed in one loop; flags and uncertainties follow while its counts are in the cache. Division and rounding
are IEEE single precision throughout, so the bits do not depend on the number of lines in a slab.

Linearity correction of counts, a row of columns at a time.

Random and systematic uncertainty of every sample.

Stray light and smear subtracted from calibrated lines.

Both are sums over all bands of a column. Every line is therefore linearised again before the sums.

Operations along the spectral axis: running means, weighted sums, interpolation with weights per column.

A NaN band affects only the windows that contain it.
"""

from typing import Any, NamedTuple

import numpy as np

from hyperpaint.base import Array
from hyperpaint.base.jit import borrowing_kernel, inlined_kernel, kernel

from .arguments import (
    Calibration,
    CountLimits,
    DetectorModel,
    ErrorTerms,
    FixedFlags,
    LightCells,
    LineCounts,
    Rounding,
    SlabOutputs,
    StrayLight,
    StrayTerms,
)

_NAN = np.float32(np.nan)
_NOTHING = np.float32(0.0)
_ONE_F32 = np.float32(1.0)
# Bands weighted in one loop: few enough for the registers of any processor.
_BANDS_PER_LOOP = 6


# --- running means


@kernel
def average_slab(values: Array, width: int, out: Array) -> None:
    """Write running means of values (line, band, column), float32, over ``width`` (odd) bands.

    Windows are cut at the ends; NaN bands are left out of the mean, and stay NaN themselves.

    Notes
    -----
    The bands are cut into blocks as wide as a window, so that a window is the end of one block
    and the beginning of the next [1]_: three additions a value, whatever the width. There is no subtraction,
    which would let a large value affect bands beyond its windows.

    References
    ----------
    .. [1] M. van Herk, Pattern Recognition Letters 13, 517-521 (1992). doi:10.1016/0167-8655(92)90069-C
    """
    _, bands, columns = values.shape
    ends, beginning = np.empty((width + 1, columns), np.float32), np.empty(columns, np.float32)
    filled, counts = np.empty((bands, columns), np.float32), np.empty((bands, columns), np.float32)
    for line in range(values.shape[0]):
        if has_gap(values[line]):
            fill_gaps(values[line], filled, counts)
            average_line(filled, width, ends, beginning, out[line])
            average_line(counts, width, ends, beginning, filled)
            correct_means(values[line], filled, width // 2, out[line])
        else:
            average_line(values[line], width, ends, beginning, out[line])


@borrowing_kernel
def has_gap(values: Array) -> Any:
    # Return whether any value (band, column) is NaN.
    for band in range(values.shape[0]):
        gap = False
        for x in range(values.shape[1]):
            gap |= values[band, x] != values[band, x]
        if gap:
            return True
    return False


@borrowing_kernel
def average_line(values: Array, width: int, ends: Array, beginning: Array, out: Array) -> None:
    # Write the means of a line (band, column) without NaN.
    #
    # ``ends`` (width + 1, column): sums from a band of the block to its end; ``beginning`` (column,): sum
    # from the beginning of the next block.
    bands, columns = values.shape
    half = width // 2
    for first in range(0, bands, width):
        for x in range(columns):
            ends[width, x] = _NOTHING
            beginning[x] = _NOTHING
        for offset in range(width - 1, -1, -1):
            band, sums, previous = first + offset - half, ends[offset], ends[offset + 1]
            if 0 <= band < bands:
                row = values[band]
                for x in range(columns):
                    sums[x] = previous[x] + row[x]
            else:
                for x in range(columns):
                    sums[x] = previous[x]
        for band in range(first, min(first + width, bands)):
            share, to_end, mean = share_of_window(band, half, bands), ends[band - first], out[band]
            if band > first and band + half < bands:
                row = values[band + half]
                for x in range(columns):
                    beginning[x] = beginning[x] + row[x]
                    mean[x] = (to_end[x] + beginning[x]) * share
            else:
                for x in range(columns):
                    mean[x] = (to_end[x] + beginning[x]) * share


@inlined_kernel
def share_of_window(band: Any, half: Any, bands: Any) -> Any:
    # 1 / (number of bands in a window of ``half`` bands to either side, cut at the ends).
    return _ONE_F32 / np.float32(min(band + half, bands - 1) - max(band - half, 0) + 1)


@borrowing_kernel
def fill_gaps(values: Array, filled: Array, counts: Array) -> None:
    # Write values (band, column) with NaN replaced by 0, and their validity as 1 or 0.
    for band in range(values.shape[0]):
        for x in range(values.shape[1]):
            value = values[band, x]
            filled[band, x] = value if value == value else _NOTHING
        for x in range(values.shape[1]):
            value = values[band, x]
            counts[band, x] = _ONE_F32 if value == value else _NOTHING


@borrowing_kernel
def correct_means(values: Array, shares: Array, half: int, out: Array) -> None:
    # Divide means over whole windows (band, column) by the ``shares`` of their bands that are valid.
    bands = values.shape[0]
    full_window = _ONE_F32 - np.float32(0.5) / np.float32(2 * half + 1)
    for band in range(bands):
        for x in range(values.shape[1]):
            share, missing = shares[band, x], values[band, x] != values[band, x]
            out[band, x] = _NAN if missing else out[band, x] if share > full_window else out[band, x] / share


# --- weighted sums


@kernel
def filter_slab(values: Array, weights: Array, first: Array, fallback: Array, out: Array) -> None:
    # Write the weighted sum of each band's window of values (line, band, column), float32.
    #
    # ``weights`` (band, width) are for a band's window, which begins at the band ``first`` (band,); a row
    # sums to 1. Row ``k`` of ``fallback`` (band, width, width) has the weights without the ``k``-th value.
    #
    # A NaN band stays NaN. A value with two or more NaN in its window is not filtered.
    width = weights.shape[1]
    for line in range(values.shape[0]):
        for band in range(values.shape[1]):
            for k in range(0, width, _BANDS_PER_LOOP):
                weigh_rows(values[line], weights[band], first[band], k, out[line, band])
            gap = False
            for x in range(values.shape[2]):
                gap |= out[line, band, x] != out[line, band, x]
            if gap:
                for x in range(values.shape[2]):
                    value = values[line, band, x]
                    if value == value and out[line, band, x] != out[line, band, x]:
                        out[line, band, x] = without_missing(values, fallback, line, band, x, first[band])


@inlined_kernel
def weigh_rows(values: Array, weights: Array, first: Any, k: Any, out: Array) -> None:
    # Add the weighted values (band, column) of `_BANDS_PER_LOOP` bands of a window, from its ``k``-th on.
    #
    # Beyond the window, its first band is read with weight 0; where that is NaN, the sum is NaN already.
    w0, r0 = weight_and_row(values, weights, first, k)
    w1, r1 = weight_and_row(values, weights, first, k + 1)
    w2, r2 = weight_and_row(values, weights, first, k + 2)
    w3, r3 = weight_and_row(values, weights, first, k + 3)
    w4, r4 = weight_and_row(values, weights, first, k + 4)
    w5, r5 = weight_and_row(values, weights, first, k + 5)
    if k == 0:
        for x in range(out.size):
            low = (w0 * r0[x] + w1 * r1[x]) + (w2 * r2[x] + w3 * r3[x])
            out[x] = low + (w4 * r4[x] + w5 * r5[x])
    else:
        for x in range(out.size):
            low = (w0 * r0[x] + w1 * r1[x]) + (w2 * r2[x] + w3 * r3[x])
            out[x] += low + (w4 * r4[x] + w5 * r5[x])


@kernel
def weight_and_row(values: Array, weights: Array, first: Any, k: Any) -> tuple[Any, Array]:
    # Return weight and values of the ``k``-th band of a window.
    is_inside = k < weights.size
    return (weights[k] if is_inside else _NOTHING), values[first + (k if is_inside else 0)]


@borrowing_kernel
def without_missing(values: Array, fallback: Array, line: Any, band: Any, x: Any, first: Any) -> Any:
    # Return the filtered value of a window with one NaN, the unfiltered value with more.
    gaps, gap, width = 0, 0, fallback.shape[1]
    for k in range(width):
        value = values[line, first + k, x]
        if value != value:
            gaps += 1
            gap = k
    if gaps != 1:
        return values[line, band, x] if gaps > 1 else _NAN
    total = _NOTHING
    for k in range(width):
        if k != gap:
            total += fallback[band, gap, k] * values[line, first + k, x]
    return total


@kernel
def resample_slab(values: Array, first: Array, weights: Array, out: Array) -> None:
    # Write sum_k weights[band, column, k] values[first + k]; NaN where a sample with weight is NaN.
    #
    # ``first`` (band, column) is the first of four bands; ``weights`` are NaN where interpolation is
    # impossible. Values are (line, band, column), float32.
    for line in range(values.shape[0]):
        for band in range(out.shape[1]):
            for x in range(out.shape[2]):
                total = np.float32(0.0)
                for k in range(4):
                    weight = weights[band, x, k]
                    if weight != np.float32(0.0):
                        total += weight * values[line, first[band, x] + k, x]
                out[line, band, x] = total


# --- bands on other wavelengths ----------------------------------------------------------------------------

_ONE = np.uint32(1)


# --- linearity ---------------------------------------------------------------------------------------------


# Buffers of a line whose counts are linearised.
class LinearMemory(NamedTuple):
    #: (band, column) float32: dark of the line, linearised where the detector's curve is of raw counts
    dark: Array
    signal: Array  #: (column,) float32: linear counts above dark of the current band
    #: node (column,) int32, part (column,) float32: integer and fraction of the position of counts in a table
    node: Array
    part: Array


@kernel
def linear_memory(
    polynomial: Array | None, table: Array | None, bands: int, columns: int
) -> LinearMemory | None:
    # Return buffers for a linearity curve; None without a curve.
    if polynomial is None and table is None:
        return None
    return LinearMemory(
        np.empty((bands, columns), np.float32),
        np.empty(columns, np.float32),
        np.empty(columns, np.int32),
        np.empty(columns, np.float32),
    )


@kernel
def signal_of(linear: LinearMemory | None) -> Array | None:
    if linear is None:
        return None
    return linear.signal


@borrowing_kernel
def polynomial_row(polynomial: Array | None, counts: Array) -> None:
    # Linearise counts (column,) in place: c + a2 c^2 + ... + a5 c^5.
    if polynomial is not None:
        a2, a3, a4, a5 = polynomial[0], polynomial[1], polynomial[2], polynomial[3]
        for x in range(counts.size):
            c = counts[x]
            counts[x] = c + c * (c * (a2 + c * (a3 + c * (a4 + c * a5))))


@borrowing_kernel
def table_row(
    detector: DetectorModel,
    table: Array | None,
    weights: Array | None,
    memory: LinearMemory,
    band: Any,
    counts: Array,
) -> None:
    # Linearise counts (column,) of a band in place by a table of corrections.
    #
    # ``table`` and ``weights`` are members of ``detector``.
    # The table is linear between nodes, and extrapolated from the two outermost nodes. Node numbers are
    # computed in a separate loop, because look-ups do not vectorise.
    if table is not None:
        node, part = memory.node, memory.part
        last = np.float32(table.shape[1] - 2)
        for x in range(counts.size):
            position = (counts[x] - detector.first_node) * detector.nodes_per_count
            # false for NaN, whose conversion to an integer is undefined
            clipped = min(position, last) if position > _NOTHING else _NOTHING
            node[x] = np.int32(clipped)
            part[x] = position - np.float32(node[x])
        if weights is not None:
            for term in range(weights.shape[0]):
                row, weight = table[1 + term], weights[term, band]
                for x in range(counts.size):
                    low, high = row[np.uint32(node[x])], row[np.uint32(node[x]) + _ONE]
                    counts[x] += weight[x] * (low + part[x] * (high - low))
        for x in range(counts.size):
            correction = table[0, np.uint32(node[x])]
            part[x] = correction + part[x] * (table[0, np.uint32(node[x]) + _ONE] - correction)
        for x in range(counts.size):
            counts[x] = counts[x] + part[x]


@borrowing_kernel
def straighten_dark(detector: DetectorModel, dark: Array, linear: LinearMemory | None) -> None:
    # Write the dark (band, column) of a line, linearised where the detector's curve is of raw counts.
    if linear is not None:
        for band in range(dark.shape[0]):
            for x in range(dark.shape[1]):
                linear.dark[band, x] = dark[band, x]
            if detector.on_raw:
                table_row(detector, detector.table, detector.weights, linear, band, linear.dark[band])
                polynomial_row(detector.polynomial, linear.dark[band])


@inlined_kernel
def signal_row(
    counts: Array, detector: DetectorModel, linear: LinearMemory | None, line_and_band: tuple[Any, Any]
) -> None:
    # Write the linear counts above dark of ``line_and_band`` to the buffer.
    if linear is not None:
        line, band = line_and_band
        signal, dark = linear.signal, linear.dark[band]
        for x in range(signal.size):
            signal[x] = np.float32(counts[line, band, x]) - (_NOTHING if detector.on_raw else dark[x])
        table_row(detector, detector.table, detector.weights, linear, band, signal)
        polynomial_row(detector.polynomial, signal)
        if detector.on_raw:
            for x in range(signal.size):
                signal[x] = signal[x] - dark[x]


@borrowing_kernel
def slope_row(
    counts: Array,
    dark: Array,
    detector: DetectorModel,
    polynomial: Array | None,
    table: Array | None,
    weights: Array | None,
    band: Any,
    slope: Array,
) -> None:
    # Write the derivative of linear counts with respect to counts (column,), which scales the noise.
    if polynomial is not None:
        a2, a3 = np.float32(2.0) * polynomial[0], np.float32(3.0) * polynomial[1]
        a4, a5 = np.float32(4.0) * polynomial[2], np.float32(5.0) * polynomial[3]
        for x in range(slope.size):
            c = np.float32(counts[x]) - (_NOTHING if detector.on_raw else dark[x])
            slope[x] = _ONE_F32 + c * (a2 + c * (a3 + c * (a4 + c * a5)))
    elif table is not None:
        last, per_count = np.float32(table.shape[1] - 2), detector.nodes_per_count
        for x in range(slope.size):
            count = np.float32(counts[x]) - (_NOTHING if detector.on_raw else dark[x])
            position = (count - detector.first_node) * per_count
            node = np.uint32(np.int32(min(position, last) if position > _NOTHING else _NOTHING))
            slope[x] = _ONE_F32 + (table[0, node + _ONE] - table[0, node]) * per_count
            if weights is not None:
                for term in range(weights.shape[0]):
                    rise = table[1 + term, node + _ONE] - table[1 + term, node]
                    slope[x] += weights[term, band, x] * rise * per_count


# --- rounding of float32 values to the stored mantissa bits ------------------------------------------------


@inlined_kernel
def rounded(value: Any, rounding: Rounding | None) -> Any:
    # Return a float32 rounded to nearest-even.
    #
    # Masks are used instead of shifts, which numba would do in 64 bits.
    if rounding is None:
        return value
    bits = np.float32(value).view(np.uint32)
    even = np.uint32((bits & rounding.last) == np.uint32(0))
    return np.uint32(np.uint32(bits + rounding.half - even) & rounding.mask).view(np.float32)


@inlined_kernel
def round_row(values: Array, rounding: Rounding | None) -> None:
    if rounding is not None:
        for x in range(values.size):
            values[x] = rounded(values[x], rounding)


# --- uncertainties of samples ------------------------------------------------------------------------------


# Buffers of `propagate_band`.
class ErrorMemory(NamedTuple):
    #: irradiance E, inverse 1 / E (3, column) float32: of a band and the two before, band ``b`` in row
    #: ``b % 3``
    irradiance: Array
    inverse: Array
    slope: Array  #: (column,) float32: linear counts per count of the current band
    rounding: Rounding | None


@inlined_kernel
def light_run(cubic: Array, shift: Array, irradiance: Array) -> None:
    # Evaluate a cubic in ``shift`` (column,).
    c0, c1, c2, c3 = cubic[0], cubic[1], cubic[2], cubic[3]
    for x in range(irradiance.size):
        s = shift[x]
        irradiance[x] = c0 + s * (c1 + s * (c2 + s * c3))


@inlined_kernel
def light_row(
    light: LightCells, shift: Array | None, line_and_band: tuple[Any, Any], irradiance: Array, inverse: Array
) -> None:
    # Write the irradiance E of ``line_and_band``, and 1 / E (column,).
    #
    # Values are gain x (counts - dark) / E. ``shift`` is ``light.shift``.
    line, band = line_and_band
    if shift is None:
        scale = light.coefficients[line, band, 0, 0]
        for x in range(inverse.size):
            inverse[x] = scale
        for x in range(inverse.size):
            irradiance[x] = _ONE_F32 / scale
    else:
        smile_band = band if shift.shape[0] > 1 else 0
        for run in range(light.cells.shape[1]):
            first, last = light.edges[smile_band, run], light.edges[smile_band, run + 1]
            cubic = light.coefficients[line, band, light.cells[smile_band, run]]
            light_run(cubic, shift[smile_band, first:last], irradiance[first:last])
        for x in range(inverse.size):
            inverse[x] = _ONE_F32 / irradiance[x]


@inlined_kernel
def random_row(
    samples: LineCounts,
    linear: LinearMemory | None,
    detector: DetectorModel,
    terms: ErrorTerms,
    memory: ErrorMemory,
    line_and_band: tuple[Any, Any],
    out: SlabOutputs,
) -> None:
    # Write u = m sqrt(signal / k + floor), m: reflectance per count, k: counts per electron.
    #
    # A negative signal adds no variance.
    line, band = line_and_band
    inverse, gain = memory.inverse[band % 3], samples.gain[band]
    per_electron = terms.per_electron[band if terms.per_electron.shape[0] > 1 else 0]
    noise_floor = terms.noise_floor[band if terms.noise_floor.shape[0] > 1 else 0]
    values, u_random = out.cube[line, band], out.u_random[line, band]
    if linear is None:
        for x in range(u_random.size):
            value, per_count = values[x], abs(gain[x] * inverse[x])
            # max() would drop the NaN
            shot = _NOTHING if value < _NOTHING else value
            variance = per_count * (shot * per_electron[x] + per_count * noise_floor[x])
            u_random[x] = rounded(np.sqrt(variance), memory.rounding)
    else:
        # noise arises in raw counts: u = m L'(C) sqrt((C - D) / k + floor)
        counts, dark, slope = samples.counts[line, band], samples.dark[band], memory.slope
        slope_row(counts, dark, detector, detector.polynomial, detector.table, detector.weights, band, slope)
        for x in range(u_random.size):
            net_count = np.float32(counts[x]) - dark[x]
            shot = _NOTHING if net_count < _NOTHING else net_count
            noise = np.sqrt(shot * per_electron[x] + noise_floor[x])
            u = abs(slope[x] * (gain[x] * inverse[x])) * noise
            u_random[x] = rounded(u if values[x] == values[x] else _NAN, memory.rounding)


@inlined_kernel
def systematic_row(
    values: Array,
    gain: Array,
    memory: ErrorMemory,
    terms: ErrorTerms,
    slope: Array | None,
    offset: Array | None,
    band: Any,
    u_systematic: Array,
) -> None:
    # Write the systematic uncertainty (column,) of a band from the values of its line (band, column).
    #
    # It is the root of the sum of squares of three terms: relative, dark offset, and wavelength. ``slope``
    # and ``offset`` are members of ``terms``.
    relative = terms.relative[band if terms.relative.shape[0] > 1 else 0]
    rounding = memory.rounding
    if offset is None:
        for x in range(u_systematic.size):
            u_systematic[x] = rounded(abs(values[band, x]) * relative[x], rounding)
    elif slope is None:
        dark_offset, inverse = offset[band if offset.shape[0] > 1 else 0], memory.inverse[band % 3]
        for x in range(u_systematic.size):
            scale, dark = values[band, x] * relative[x], gain[band, x] * inverse[x] * dark_offset[x]
            u_systematic[x] = rounded(np.sqrt(scale * scale + dark * dark), rounding)
    else:
        low, high = max(band - 1, 0), min(band + 1, values.shape[0] - 1)
        row, row_low, row_high = band % 3, low % 3, high % 3
        dark_offset = offset[band if offset.shape[0] > 1 else 0]
        irradiance, inverse = memory.irradiance, memory.inverse
        rise_factor, rise_factor_alone, fall_factor, fall_factor_alone = (
            slope[band, 0],
            slope[band, 1],
            slope[band, 2],
            slope[band, 3],
        )
        # indexed by band: row views would exceed the compiler's limit of alias checks
        for x in range(u_systematic.size):
            value, per_light = values[band, x], inverse[row, x]
            # radiance of the neighbours, in units of this band's light
            below = values[low, x] * (irradiance[row_low, x] * per_light)
            above = values[high, x] * (irradiance[row_high, x] * per_light)
            rise = above - value if above == above else _NOTHING
            fall = value - below if below == below else _NOTHING
            # where a neighbour is missing, the other alone gives the slope
            to_above = rise_factor if below == below else rise_factor_alone
            to_below = fall_factor if above == above else fall_factor_alone
            wavelength = rise * to_above + fall * to_below
            dark = gain[band, x] * per_light * dark_offset[x]
            scale = value * relative[x]
            total = np.sqrt(scale * scale + (wavelength * wavelength + dark * dark))
            u_systematic[x] = rounded(total, rounding)


@inlined_kernel
def propagate_band(
    samples: LineCounts,
    linear: LinearMemory | None,
    detector: DetectorModel,
    light: LightCells,
    terms: ErrorTerms,
    memory: ErrorMemory,
    line_and_band: tuple[Any, Any],
    out: SlabOutputs,
) -> None:
    # Write the random uncertainty of ``line_and_band``, and round finished bands.
    #
    # The systematic uncertainty of a band needs irradiance and unrounded values of the next band, and is
    # therefore computed one band later.
    line, band = line_and_band
    values = out.cube[line]
    last = values.shape[0] - 1
    light_row(light, light.shift, line_and_band, memory.irradiance[band % 3], memory.inverse[band % 3])
    random_row(samples, linear, detector, terms, memory, line_and_band, out)
    for done in range(max(band - 1, 0), band + (band == last)):
        systematic_row(
            values, samples.gain, memory, terms, terms.slope, terms.offset, done, out.u_systematic[line, done]
        )
        if done > 0:
            round_row(values[done - 1], memory.rounding)
        if done == last:
            round_row(values[last], memory.rounding)


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
    detector: DetectorModel,
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
        blended[:] = line_dark
        add_pedestals(counts, detector, blended)
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
            detector,
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


# --- pedestals of a line: counts above dark of masked elements ---------------------------------------------


# Masked elements farther from the mean are left out as cosmic rays [standard deviations].
_FAR_SD = 5.0


@kernel
def add_pedestals(counts: Array, detector: DetectorModel, dark: Array) -> None:
    # Add the pedestals of a line of counts (band, column) to its ``dark``, group after group.
    #
    # A pedestal is the median or mean of the finite counts less dark of a group, 0 without any.
    masked, groups = detector.masked, detector.groups
    values = np.empty(masked.shape[0], np.float64)
    for group in range(groups.shape[0]):
        count = 0
        for k in range(groups[group, 0], groups[group, 1]):
            above = float(counts[masked[k, 0], masked[k, 1]]) - float(dark[masked[k, 0], masked[k, 1]])
            if abs(above) < np.inf:
                values[count] = above
                count += 1
        if count == 0:
            continue
        pedestal = np.float32(np.median(values[:count]) if detector.is_median else near_mean(values[:count]))
        axis, index = groups[group, 2], groups[group, 3]
        for band in range(index, index + 1) if axis == 0 else range(dark.shape[0]):
            for x in range(index, index + 1) if axis == 1 else range(dark.shape[1]):
                dark[band, x] += pedestal


@borrowing_kernel
def near_mean(values: Array) -> Any:
    # Return the mean without values over `_FAR_SD` standard deviations from the mean of all.
    mean, limit = 0.0, np.inf
    for _ in range(2):
        count, total, squares = 0, 0.0, 0.0
        for value in values:
            if abs(value - mean) <= limit:
                count += 1
                total += value - mean
                squares += (value - mean) ** 2
        shift = total / count
        mean += shift
        limit = _FAR_SD * np.sqrt(max(squares / count - shift * shift, 0.0)) + 1e-9
    return mean


# --- quality flags of raw counts, combined over the bands of a line ----------------------------------------


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
                high, low = high if high > _NOTHING else _NOTHING, low if low > _NOTHING else _NOTHING
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


# --- stray light and smear: sums over all bands of a column, for which every line is linearised again ---


# Columns summed together, so that they stay in the first-level cache.
_BLOCK_COLUMNS = 128
_NO_LIMIT = np.float32(np.inf)


@borrowing_kernel
def net_line(
    counts: Array, line: Any, dark: Array, detector: DetectorModel, linear: LinearMemory | None, net: Array
) -> None:
    # Write linear counts above the ``dark`` of a line (band, column), 0 where they are not finite.
    #
    # Saturated counts are used as read, as a lower bound.
    for band in range(counts.shape[1]):
        row = net[band]
        if linear is None:
            for x in range(row.size):
                row[x] = np.float32(counts[line, band, x]) - dark[band, x]
        else:
            signal_row(counts, detector, linear, (line, band))
            for x in range(row.size):
                row[x] = linear.signal[x]
        for x in range(row.size):
            row[x] = row[x] if abs(row[x]) < _NO_LIMIT else _NOTHING


@borrowing_kernel
def replace_bad(net: Array, replacements: Array) -> None:
    # Replace bad elements (n, 3) of a line: column, band, and the band whose counts are copied; -1 for 0.
    for k in range(replacements.shape[0]):
        x, band, source = replacements[k, 0], replacements[k, 1], replacements[k, 2]
        net[band, x] = net[source, x] if source >= 0 else _NOTHING


@kernel
def sum_line(
    net: Array, stray: StrayLight, across: StrayTerms | None, smear: Any, total: Array, out: Array
) -> None:
    # Write the counts of a line (band, column) that come from other bands and columns [count].
    #
    # First the smear ``total`` (column,), a share of the sum over the bands; then, of the counts without
    # smear, which are written to ``net``, the light scattered between columns and that between bands.
    # ``across`` is ``stray.columns``.
    bands, columns = out.shape
    total[:] = _NOTHING
    if smear != _NOTHING:
        for band in range(bands):
            for x in range(columns):
                total[x] += net[band, x]
        for x in range(columns):
            total[x] *= smear
    for band in range(bands):
        for x in range(columns):
            net[band, x] = (net[band, x] - total[x]) * stray.level[band, x]
    if across is not None:
        sideways = np.empty((columns, bands), np.float32)
        scatter(net.T, across.source, across.out, sideways)
        net -= sideways.T
    scatter(net, stray.bands.source, stray.bands.out, out)
    if across is not None:
        out += sideways.T
    for band in range(bands):
        for x in range(columns):
            out[band, x] = out[band, x] / stray.level[band, x] + total[x]


@kernel
def scatter(light: Array, source_terms: Array, out_terms: Array | None, out: Array) -> None:
    # Write the part of ``light`` (row, column) that is scattered into each row, by members of `StrayTerms`.
    #
    # Terms are summed four at a time in the order of the rows, so the bits do not depend on the number of
    # columns. Rows of zeros pad the block to a multiple of four.
    rows, columns = light.shape
    terms = source_terms.shape[0]
    block = np.zeros((source_terms.shape[1], _BLOCK_COLUMNS), np.float32)
    sums = np.empty((terms, _BLOCK_COLUMNS), np.float32)
    for first in range(0, columns, _BLOCK_COLUMNS):
        width = min(_BLOCK_COLUMNS, columns - first)
        for row in range(rows):
            for x in range(width):
                block[row, x] = light[row, first + x]
        for term in range(terms):
            sum_rows(block, source_terms[term], sums[term])
        for row in range(rows):
            if out_terms is None:
                out[row, first : first + width] = sums[row, :width]
            else:
                sum_rows(sums, out_terms[row], out[row, first : first + width])


@borrowing_kernel
def sum_rows(rows: Array, weights: Array, out: Array) -> None:
    # Write sum_r weights[r] rows[r] of rows (row, column); ``weights`` are padded to a multiple of four.
    out[:] = _NOTHING
    for row in range(0, weights.size, 4):
        a, b, c, d = weights[row], weights[row + 1], weights[row + 2], weights[row + 3]
        for x in range(out.size):
            out[x] += (a * rows[row, x] + b * rows[row + 1, x]) + (
                c * rows[row + 2, x] + d * rows[row + 3, x]
            )


@borrowing_kernel
def subtract_row(
    stray: Array, gain: Array, inverse: Array, relative: Any, out: SlabOutputs, line_and_band: tuple[int, int]
) -> None:
    # Subtract stray counts (column,) of ``line_and_band``; add their uncertainty in quadrature.
    line, band = line_and_band
    values = out.cube[line, band]
    for x in range(values.size):
        values[x] -= stray[x] * (gain[x] * inverse[x])
    if out.u_systematic.shape[0] > 0:
        u_systematic = out.u_systematic[line, band]
        for x in range(values.size):
            uncertainty = relative * (stray[x] * (gain[x] * inverse[x]))
            u_systematic[x] = np.sqrt(u_systematic[x] * u_systematic[x] + uncertainty * uncertainty)


@kernel
def subtract_stray_light(
    counts: Array,
    calibration: Calibration,
    light: LightCells,
    stray: StrayLight,
    rounding: Rounding | None,
    out: SlabOutputs,
) -> None:
    # Subtract stray light from calibrated lines, not yet rounded, of counts (line, band, column).
    #
    # Then round the outputs that are not empty.
    n_line, n_band, n_column = counts.shape
    detector = calibration.detector
    blended_dark = np.empty((n_band, n_column), np.float32)
    linear = linear_memory(detector.polynomial, detector.table, n_band, n_column)
    net = np.empty((n_band, n_column), np.float32)
    stray_counts = np.empty((n_band, n_column), np.float32)
    total = np.empty(n_column, np.float32)
    irradiance, inverse = np.empty(n_column, np.float32), np.empty(n_column, np.float32)
    for line in range(n_line):
        dark = dark_of_line(
            counts[line],
            calibration.dark,
            calibration.dark_index,
            calibration.dark_weight,
            detector,
            detector.masked,
            line,
            blended_dark,
        )
        straighten_dark(detector, dark, linear)
        net_line(counts, line, dark, detector, linear, net)
        replace_bad(net, stray.replacements)
        sum_line(net, stray, stray.columns, stray.smear[line], total, stray_counts)
        for band in range(n_band):
            light_row(light, light.shift, (line, band), irradiance, inverse)
            subtract_row(
                stray_counts[band], calibration.gain[band], inverse, stray.relative, out, (line, band)
            )
            round_row(out.cube[line, band], rounding)
            if out.u_random.shape[0] > 0:
                round_row(out.u_random[line, band], rounding)
                round_row(out.u_systematic[line, band], rounding)
