"""Counts made proportional to light, a row of columns at a time: rows of `hyperpaint.kernels.radiometry`."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from hyperpaint.base.arrays import Array
from hyperpaint.base.jit import borrowing_kernel

from .arguments import DetectorModel

__all__ = [
    "LinearRow", "linear_random_row", "scale_linear_row", "signal_row", "slope_row", "straighten_row",
]  # fmt: skip

_NAN = np.float32(np.nan)
_ONE = np.uint32(1)
_ONE_F32 = np.float32(1.0)
_NOTHING = np.float32(0.0)


class LinearRow(NamedTuple):
    """Memory of `straighten_row`: where counts lie in a table."""

    #: node (column,) int32, part (column,) float32
    node: Array
    part: Array


@borrowing_kernel
def straighten_row(detector: DetectorModel, counts: Array, work: LinearRow) -> None:
    """Add to counts (column,), in place, what they lack to be proportional to light.

    A table is straight between its nodes, and beyond the outer ones as between the last two. Places come
    first, by themselves: the compiler cannot vectorise what looks up.
    """
    table, node, part = detector.table, work.node, work.part
    if table.size == 0:
        a2, a3, a4, a5 = (
            detector.polynomial[0], detector.polynomial[1], detector.polynomial[2], detector.polynomial[3]
        )  # fmt: skip
        for x in range(counts.size):
            c = counts[x]
            counts[x] = c + c * (c * (a2 + c * (a3 + c * (a4 + c * a5))))
        return
    last = np.float32(table.size - 2)
    for x in range(counts.size):
        place = (counts[x] - detector.first_node) * detector.nodes_per_count
        # a comparison that is false of NaN, whose node would be any
        inside = min(place, last) if place > _NOTHING else _NOTHING
        node[x] = np.int32(inside)
        part[x] = place - np.float32(node[x])
    for x in range(counts.size):
        low = table[np.uint32(node[x])]
        part[x] = low + part[x] * (table[np.uint32(node[x]) + _ONE] - low)
    for x in range(counts.size):
        counts[x] = counts[x] + part[x]


@borrowing_kernel
def signal_row(
    counts: Array, dark: Array, detector: DetectorModel, saturation_limit: Any, work: LinearRow, out: Array
) -> None:
    """Write linear counts above dark (column,), NaN from ``saturation_limit`` raw counts on.

    ``dark`` is a linear one where the detector's curve is of raw counts.
    """
    for x in range(out.size):
        out[x] = np.float32(counts[x]) - (_NOTHING if detector.on_raw else dark[x])
    straighten_row(detector, out, work)
    if detector.on_raw:
        for x in range(out.size):
            out[x] = out[x] - dark[x]
    for x in range(out.size):
        out[x] = out[x] if counts[x] < saturation_limit else _NAN


@borrowing_kernel
def scale_linear_row(
    counts: Array, dark: Array, gain: Array, detector: DetectorModel, limited_scale: tuple[Any, Any],
    place: tuple[int, int], out: Array,
) -> None:  # fmt: skip
    """Write what `scale_row` does, of counts that a polynomial makes linear, in one loop.

    ``limited_scale``: the saturation limit, and the scale.
    """
    line, band = place
    saturation_limit, scale = limited_scale
    a2, a3, a4, a5 = (
        detector.polynomial[0], detector.polynomial[1], detector.polynomial[2], detector.polynomial[3]
    )  # fmt: skip
    for x in range(counts.shape[2]):
        raw, d = counts[line, band, x], dark[band, x]
        c = np.float32(raw) - (_NOTHING if detector.on_raw else d)
        c = (c + c * (c * (a2 + c * (a3 + c * (a4 + c * a5))))) - (d if detector.on_raw else _NOTHING)
        out[line, band, x] = c * (gain[band, x] * scale) if raw < saturation_limit else _NAN


@borrowing_kernel
def slope_row(counts: Array, dark: Array, detector: DetectorModel, slope: Array) -> None:
    """Write linear counts per count (column,), with which noise grows."""
    table, per_count = detector.table, detector.nodes_per_count
    if table.size == 0:
        a2, a3 = np.float32(2.0) * detector.polynomial[0], np.float32(3.0) * detector.polynomial[1]
        a4, a5 = np.float32(4.0) * detector.polynomial[2], np.float32(5.0) * detector.polynomial[3]
        for x in range(slope.size):
            c = np.float32(counts[x]) - (_NOTHING if detector.on_raw else dark[x])
            slope[x] = _ONE_F32 + c * (a2 + c * (a3 + c * (a4 + c * a5)))
        return
    last = np.float32(table.size - 2)
    for x in range(slope.size):
        count = np.float32(counts[x]) - (_NOTHING if detector.on_raw else dark[x])
        place = (count - detector.first_node) * per_count
        node = np.uint32(np.int32(min(place, last) if place > _NOTHING else _NOTHING))
        slope[x] = _ONE_F32 + (table[node + _ONE] - table[node]) * per_count


@borrowing_kernel
def linear_random_row(
    counts: Array, dark: Array, per_count: Array, per_electron: Array, noise_floor: Array, values: Array,
    u_random: Array,
) -> None:  # fmt: skip
    """Write m L'(C) sqrt((C - D) / k + floor): noise is that of counts as they are read.

    ``per_count`` (column,) is m L', reflectance per count.
    """
    for x in range(u_random.size):
        above = np.float32(counts[x]) - dark[x]
        shot = _NOTHING if above < _NOTHING else above
        noise = np.sqrt(shot * per_electron[x] + noise_floor[x])
        u_random[x] = abs(per_count[x]) * noise if values[x] == values[x] else _NAN
