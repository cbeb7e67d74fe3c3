"""Random and systematic uncertainty of every sample."""

from typing import Any, NamedTuple

import numpy as np

from hyperpaint.base.jit import inlined_kernel
from hyperpaint.base.schema import Array

from .arguments import DetectorModel, ErrorTerms, LightCells, LineCounts, Rounding, SlabOutputs
from .linear_counts import LinearMemory, round_row, rounded, slope_row

_NAN = np.float32(np.nan)
_ONE_F32 = np.float32(1.0)
_NOTHING = np.float32(0.0)


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
        slope_row(counts, dark, detector, detector.polynomial, detector.table, slope)
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
