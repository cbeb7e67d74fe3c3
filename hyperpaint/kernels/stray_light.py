"""Light that a band counts of others, taken out of calibrated lines: scattered in the camera, and smear.

Both are sums over all bands of a column, so that a line is made linear once more before anything is summed.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from hyperpaint.base.arrays import Array
from hyperpaint.base.jit import borrowing_kernel, kernel

from .arguments import Calibration, DetectorModel, LightCells, Rounding, SlabOutputs, StrayLight
from .bit_rounding import round_row
from .linear_counts import LinearMemory, linear_memory, signal_row, straighten_dark
from .radiometry import dark_of_line
from .sample_errors import light_row

_BLOCK = 128
"""Columns whose sums are made side by side, so that they stay in the nearest cache."""
_NOTHING = np.float32(0.0)
_NO_LIMIT = np.float32(np.inf)


class StrayWork(NamedTuple):
    """Memory of `sum_line`."""

    total: Array  #: (column,) float32: smear of a line [count]
    #: block (band, column), sums (term, column) float32: counts of some columns, and their sums over the
    #: bands; contiguous, since rows a power of two apart would displace one another from the cache
    block: Array
    sums: Array


@borrowing_kernel
def net_line(
    counts: Array, line: Any, dark: Array, detector: DetectorModel, linear: LinearMemory | None, net: Array
) -> None:
    """Write linear counts above the ``dark`` of a line (band, column), 0 where they are not finite.

    Saturated counts are taken as they are read: the least they can be.
    """
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
def replace_bad(net: Array, stands_in: Array) -> None:
    """Set elements (n, 3) of a line: column, band, and the band whose counts are taken; -1 for no light."""
    for k in range(stands_in.shape[0]):
        x, band, other = stands_in[k, 0], stands_in[k, 1], stands_in[k, 2]
        net[band, x] = net[other, x] if other >= 0 else _NOTHING


@borrowing_kernel
def sum_line(net: Array, stray: StrayLight, smear: Any, work: StrayWork, out: Array) -> None:
    """Write what of a line's counts (band, column) is that of other bands [count].

    First the smear, a share of the sum over the bands, then what is left of it through the product of two
    narrow matrices. Four terms at a time, whose order is that of the bands, whatever the number of columns.
    """
    bands, columns = out.shape
    total, block, sums = work.total, work.block, work.sums
    total[:] = _NOTHING
    if smear != _NOTHING:
        for band in range(bands):
            for x in range(columns):
                total[x] += net[band, x]
        for x in range(columns):
            total[x] *= smear
    for first in range(0, columns, _BLOCK):
        width = min(_BLOCK, columns - first)
        for band in range(bands):
            for x in range(width):
                at = first + x
                block[band, x] = (net[band, at] - total[at]) * stray.level[band, at]
        for term in range(stray.take.shape[0]):
            sum_rows(block, stray.take[term], sums[term])
        for band in range(bands):
            own = block[band]
            sum_rows(sums, stray.give[band], own)
            for x in range(width):
                out[band, first + x] = own[x] / stray.level[band, first + x] + total[first + x]


@borrowing_kernel
def sum_rows(rows: Array, weights: Array, out: Array) -> None:
    """Write the sum of rows (row, column) times ``weights`` (row,), which are padded to whole fours."""
    out[:] = _NOTHING
    for row in range(0, weights.size, 4):
        a, b, c, d = weights[row], weights[row + 1], weights[row + 2], weights[row + 3]
        for x in range(out.size):
            out[x] += (a * rows[row, x] + b * rows[row + 1, x]) + (
                c * rows[row + 2, x] + d * rows[row + 3, x]
            )


@borrowing_kernel
def take_off(
    stray: Array, gain: Array, inverse: Array, relative: Any, out: SlabOutputs, place: tuple[int, int]
) -> None:
    """Subtract stray counts (column,) of a ``place`` (line, band), and add what is unsure of them."""
    line, band = place
    values = out.cube[line, band]
    for x in range(values.size):
        values[x] -= stray[x] * (gain[x] * inverse[x])
    if out.u_systematic.shape[0] > 0:
        u_systematic = out.u_systematic[line, band]
        for x in range(values.size):
            unsure = relative * (stray[x] * (gain[x] * inverse[x]))
            u_systematic[x] = np.sqrt(u_systematic[x] * u_systematic[x] + unsure * unsure)


@kernel
def subtract_stray_light(
    counts: Array, calibration: Calibration, light: LightCells, stray: StrayLight, rounding: Rounding | None,
    out: SlabOutputs,
) -> None:  # fmt: skip
    """Free whole lines, calibrated from counts (line, band, column) but not rounded, of stray light.

    What of ``out`` is not empty is rounded.
    """
    n_line, n_band, n_column = counts.shape
    detector = calibration.detector
    mixed_dark = np.empty((n_band, n_column), np.float32)
    linear = linear_memory(detector.polynomial, detector.table, n_band, n_column)
    net = np.empty((n_band, n_column), np.float32)
    other = np.empty((n_band, n_column), np.float32)
    # rows of zeros fill up the last four bands
    memory = StrayWork(
        np.empty(n_column, np.float32), np.zeros((max(stray.take.shape[1], n_band), _BLOCK), np.float32),
        np.zeros((stray.take.shape[0], _BLOCK), np.float32),
    )  # fmt: skip
    irradiance, inverse = np.empty(n_column, np.float32), np.empty(n_column, np.float32)
    for line in range(n_line):
        dark = dark_of_line(
            counts[line], calibration.dark, calibration.dark_index, calibration.dark_weight, detector.masked,
            line, mixed_dark,
        )  # fmt: skip
        straighten_dark(detector, dark, linear)
        net_line(counts, line, dark, detector, linear, net)
        replace_bad(net, stray.stands_in)
        sum_line(net, stray, stray.smear[line], memory, other)
        for band in range(n_band):
            light_row(light, light.shift, (line, band), irradiance, inverse)
            take_off(other[band], calibration.gain[band], inverse, stray.relative, out, (line, band))
            round_row(out.cube[line, band], rounding)
            if out.u_random.shape[0] > 0:
                round_row(out.u_random[line, band], rounding)
                round_row(out.u_systematic[line, band], rounding)
