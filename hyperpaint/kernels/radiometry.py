"""Counts to radiance or reflectance, in one pass over memory.

Rows are short functions of their own, which the compiler inlines and vectorises; the slab function below is
what tasks call. Division and rounding are IEEE single precision throughout: the same bits come out whatever
the number of lines in a slab.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from hyperpaint.base.arrays import Array
from hyperpaint.base.jit import kernel

from .quality import count_levels, flag_line, gather_row
from .uncertainty import propagate_line

__all__ = ["calibrate_slab", "round_bits"]


_NAN = np.float32(np.nan)
_ONE = np.uint32(1)


@kernel
def scale_row(
    counts: Array,
    dark: Array,
    gain: Array,
    scale: Any,
    saturation_limit: Any,
    line: Any,
    band: Any,
    out: Array,
) -> None:
    """Write gain * scale * (counts - dark); NaN from ``saturation_limit`` counts on."""
    for x in range(counts.shape[2]):
        raw = counts[line, band, x]
        value = (np.float32(raw) - dark[band, x]) * (gain[band, x] * scale)
        out[line, band, x] = value if raw < saturation_limit else _NAN


@kernel
def divide_run(
    counts: Array,
    dark: Array,
    gain: Array,
    shift: Array,
    light: Array,
    cell: Any,
    saturation_limit: Any,
    line: Any,
    band: Any,
    own: Any,
    first: Any,
    last: Any,
    out: Array,
) -> None:
    """Write gain * (counts - dark) over a cubic in ``shift``, for columns ``first`` to ``last``."""
    c0, c1 = light[line, band, cell, 0], light[line, band, cell, 1]
    c2, c3 = light[line, band, cell, 2], light[line, band, cell, 3]
    # unsigned: an index that cannot be negative needs no wrap-around, which would stop vectorisation
    for x in range(np.uint64(first), np.uint64(last)):
        raw, s = counts[line, band, x], shift[own, x]
        irradiance = c0 + s * (c1 + s * (c2 + s * c3))
        value = (np.float32(raw) - dark[band, x]) * gain[band, x] / irradiance
        out[line, band, x] = value if raw < saturation_limit else _NAN


@kernel
def limit_row(counts: Array, saturation_limit: Array, line: Any, band: Any, out: Array) -> None:
    """Write NaN where counts reach the limits of their own elements."""
    for x in range(counts.shape[2]):
        out[line, band, x] = out[line, band, x] if counts[line, band, x] < saturation_limit[band, x] else _NAN


@kernel
def round_row(bits: Array, line: Any, band: Any, cleared_bits: Any) -> None:
    """Round float32 values, given as their bits, to nearest-even, clearing the last mantissa bits."""
    half = (_ONE << (cleared_bits - _ONE)) - _ONE
    keep = ~((_ONE << cleared_bits) - _ONE)
    for x in range(bits.shape[2]):
        value = bits[line, band, x]
        bits[line, band, x] = (value + half + ((value >> cleared_bits) & _ONE)) & keep


@kernel
def round_bits(bits: Array, cleared_bits: Any) -> None:
    """Round float32 values (line, band, column), given as uint32, in place; as numcodecs' BitRound does."""
    for line in range(bits.shape[0]):
        for band in range(bits.shape[1]):
            round_row(bits, line, band, cleared_bits)


@kernel
def blend(low: Array, high: Array, weight: Any, out: Array) -> None:
    """Write low + weight (high - low) over (band, column)."""
    for band in range(out.shape[0]):
        for x in range(out.shape[1]):
            out[band, x] = low[band, x] + weight * (high[band, x] - low[band, x])


@kernel
def calibrate_slab(
    counts: Array,
    dark: Array,
    dark_index: Array,
    dark_weight: Array,
    gain: Array,
    light: Array,
    shift: Array,
    edges: Array,
    cells: Array,
    saturation_limit: Array,
    noise_margin: Array,
    whole: Any,
    most_negative: Any,
    no_data: Any,
    line_flags: Array,
    column_flags: Array,
    cleared_bits: Any,
    out: Array,
    bits: Array,
    quality: Array,
    per_electron: Array,
    noise_floor: Array,
    relative: Array,
    offset: Array,
    slope: Array,
    u_random: Array,
    u_systematic: Array,
    u_random_bits: Array,
    u_systematic_bits: Array,
) -> None:
    """Calibrate whole lines, flag them, say how sure they are, and round what is written.

    Parameters
    ----------
    counts : (line, band, column), uint16 or float32
    dark : (n, band, column), float32; dark_index, dark_weight : (line,)
        The dark of a line lies between ``dark[i]`` and ``dark[i + 1]``; one dark alone serves every line.
    gain : (band, column), float32
        NaN marks a bad element.
    light : (line, band, cell, 1 or 4), float32
        One coefficient: what counts are multiplied by. Four: a cubic in ``shift``, by which they are
        divided, for each cell of the smile.
    shift : (1 or band, column), float32
        Position of a column inside its cell.
    edges : (1 or band, run + 1), int64; cells : (1 or band, run), int64
        Columns where runs begin whose columns share a cell, and that cell.
    saturation_limit : (1, 1) or (band, column), like counts
        Counts from which a sample is saturated.
    noise_margin : (band, column), float32
        How far below the dark noise may take a sample; NaN for an element that sets no flag.
    whole : bool
        Counts are integers.
    most_negative, no_data : uint16
        Number of samples under the dark that a pixel may have; the bit of a line without data.
    line_flags : (line,), column_flags : (column,), uint16
        Bits that hold for whole lines and columns.
    cleared_bits : uint32
        Mantissa bits cleared in what is written; 0 writes all.
    out : (line, band, column), float32; bits
        Written; the same memory as uint32.
    quality : (line, column) or (0, 0), uint16
        Written unless empty.
    per_electron, noise_floor, relative, offset, slope
        See `hyperpaint.kernels.uncertainty.propagate_line`.
    u_random, u_systematic : (line, band, column) or (0, 0, 0), float32; their bits
        Written unless empty; the same memory as uint32.
    """
    n_line, n_band, n_column = counts.shape
    flagging = quality.shape[0] > 0
    doubting = u_random.shape[0] > 0
    irradiance = np.empty((3, n_column), np.float32)
    inverse = np.empty((3, n_column), np.float32)
    one_limit = saturation_limit.size == 1
    lowest, highest = saturation_limit.min(), saturation_limit.max()
    mixed_dark = np.empty((n_band, n_column) if dark.shape[0] > 1 else (0, 0), np.float32)
    peak = np.empty(n_column, counts.dtype)
    negative = np.empty(n_column, np.uint16)
    level = np.empty((n_band, n_column) if flagging else (0, 0), counts.dtype)
    floor = np.empty((n_band, n_column) if flagging else (0, 0), counts.dtype)
    saturated = np.empty(n_column, np.uint16)
    below = np.empty(n_column, np.uint16)
    for line in range(n_line):
        line_dark = dark[0]
        if dark.shape[0] > 1:
            first = dark_index[line]
            blend(dark[first], dark[first + 1], dark_weight[line], mixed_dark)
            line_dark = mixed_dark
        if flagging and (line == 0 or dark.shape[0] > 1):
            count_levels(line_dark, noise_margin, whole, level, floor)
        peak[:] = 0
        negative[:] = 0
        for band in range(n_band):
            if light.shape[3] == 1:
                scale_row(counts, line_dark, gain, light[line, band, 0, 0], highest, line, band, out)
            else:
                own = band if shift.shape[0] > 1 else 0
                for run in range(cells.shape[1]):
                    divide_run(
                        counts, line_dark, gain, shift, light, cells[own, run], highest,
                        line, band, own, edges[own, run], edges[own, run + 1], out,
                    )  # fmt: skip
            if not one_limit:
                limit_row(counts, saturation_limit, line, band, out)
            if cleared_bits > 0 and not doubting:
                round_row(bits, line, band, cleared_bits)
            if flagging:
                gather_row(counts, level, line, band, peak, negative)
        if doubting:
            propagate_line(
                gain, light, shift, edges, cells, per_electron, noise_floor, relative, offset, slope,
                line, out, irradiance, inverse, u_random, u_systematic,
            )  # fmt: skip
            for band in range(n_band if cleared_bits > 0 else 0):
                round_row(bits, line, band, cleared_bits)
                round_row(u_random_bits, line, band, cleared_bits)
                round_row(u_systematic_bits, line, band, cleared_bits)
        if flagging:
            flag_line(
                counts,
                saturation_limit,
                lowest,
                floor,
                noise_margin,
                peak,
                negative,
                most_negative,
                no_data,
                line_flags[line],
                column_flags,
                line,
                saturated,
                below,
                quality,
            )
