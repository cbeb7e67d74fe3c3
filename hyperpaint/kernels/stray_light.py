"""Stray light and smear subtracted from calibrated lines.

Both are sums over all bands of a column. Every line is therefore linearised again before the sums.
"""

from typing import Any, NamedTuple

import numpy as np

from hyperpaint.base.jit import borrowing_kernel, kernel
from hyperpaint.base.schema import Array

from .arguments import Calibration, DetectorModel, LightCells, Rounding, SlabOutputs, StrayLight
from .linear_counts import LinearMemory, linear_memory, round_row, signal_row, straighten_dark
from .radiometry import dark_of_line
from .sample_errors import light_row

# Columns summed together, so that they stay in the first-level cache.
_BLOCK_COLUMNS = 128
_NOTHING = np.float32(0.0)
_NO_LIMIT = np.float32(np.inf)


# Buffers of `sum_line`.
class StrayWork(NamedTuple):
    total: Array  #: (column,) float32: smear of a line [count]
    #: block (band, column), sums (term, column) float32: counts of `_BLOCK_COLUMNS` columns, and their sums
    #: over the bands; contiguous, because rows at a distance of a power of two evict one another from the
    #: cache
    block: Array
    sums: Array


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


@borrowing_kernel
def sum_line(net: Array, stray: StrayLight, smear: Any, work: StrayWork, out: Array) -> None:
    # Write the counts of a line (band, column) that come from other bands [count].
    #
    # First the smear, a share of the sum over the bands; then, from the counts without smear, the product of
    # two narrow matrices. Terms are summed four at a time in the order of the bands, so the bits do not
    # depend on the number of columns.
    bands, columns = out.shape
    total, block, sums = work.total, work.block, work.sums
    total[:] = _NOTHING
    if smear != _NOTHING:
        for band in range(bands):
            for x in range(columns):
                total[x] += net[band, x]
        for x in range(columns):
            total[x] *= smear
    for first in range(0, columns, _BLOCK_COLUMNS):
        width = min(_BLOCK_COLUMNS, columns - first)
        for band in range(bands):
            for x in range(width):
                column = first + x
                block[band, x] = (net[band, column] - total[column]) * stray.level[band, column]
        for term in range(stray.source_terms.shape[0]):
            sum_rows(block, stray.source_terms[term], sums[term])
        for band in range(bands):
            row = block[band]
            sum_rows(sums, stray.band_terms[band], row)
            for x in range(width):
                out[band, first + x] = row[x] / stray.level[band, first + x] + total[first + x]


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
    # rows of zeros pad the bands to a multiple of four
    memory = StrayWork(
        np.empty(n_column, np.float32),
        np.zeros((max(stray.source_terms.shape[1], n_band), _BLOCK_COLUMNS), np.float32),
        np.zeros((stray.source_terms.shape[0], _BLOCK_COLUMNS), np.float32),
    )
    irradiance, inverse = np.empty(n_column, np.float32), np.empty(n_column, np.float32)
    for line in range(n_line):
        dark = dark_of_line(
            counts[line],
            calibration.dark,
            calibration.dark_index,
            calibration.dark_weight,
            detector.masked,
            line,
            blended_dark,
        )
        straighten_dark(detector, dark, linear)
        net_line(counts, line, dark, detector, linear, net)
        replace_bad(net, stray.replacements)
        sum_line(net, stray, stray.smear[line], memory, stray_counts)
        for band in range(n_band):
            light_row(light, light.shift, (line, band), irradiance, inverse)
            subtract_row(
                stray_counts[band], calibration.gain[band], inverse, stray.relative, out, (line, band)
            )
            round_row(out.cube[line, band], rounding)
            if out.u_random.shape[0] > 0:
                round_row(out.u_random[line, band], rounding)
                round_row(out.u_systematic[line, band], rounding)
