"""Linearity correction of counts, a row of columns at a time."""

from typing import Any, NamedTuple

import numpy as np

from hyperpaint.base.jit import borrowing_kernel, inlined_kernel, kernel
from hyperpaint.base.schema import Array

from .arguments import DetectorModel, Rounding

_ONE = np.uint32(1)
_ONE_F32 = np.float32(1.0)
_NOTHING = np.float32(0.0)


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
def table_row(detector: DetectorModel, table: Array | None, memory: LinearMemory, counts: Array) -> None:
    # Linearise counts (column,) in place by a table of corrections.
    #
    # The table is linear between nodes, and extrapolated from the two outermost nodes. Node numbers are
    # computed in a separate loop, because look-ups do not vectorise.
    if table is not None:
        node, part = memory.node, memory.part
        last = np.float32(table.size - 2)
        for x in range(counts.size):
            position = (counts[x] - detector.first_node) * detector.nodes_per_count
            # false for NaN, whose conversion to an integer is undefined
            clipped = min(position, last) if position > _NOTHING else _NOTHING
            node[x] = np.int32(clipped)
            part[x] = position - np.float32(node[x])
        for x in range(counts.size):
            correction = table[np.uint32(node[x])]
            part[x] = correction + part[x] * (table[np.uint32(node[x]) + _ONE] - correction)
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
                table_row(detector, detector.table, linear, linear.dark[band])
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
        table_row(detector, detector.table, linear, signal)
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
        last, per_count = np.float32(table.size - 2), detector.nodes_per_count
        for x in range(slope.size):
            count = np.float32(counts[x]) - (_NOTHING if detector.on_raw else dark[x])
            position = (count - detector.first_node) * per_count
            node = np.uint32(np.int32(min(position, last) if position > _NOTHING else _NOTHING))
            slope[x] = _ONE_F32 + (table[node + _ONE] - table[node]) * per_count


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
