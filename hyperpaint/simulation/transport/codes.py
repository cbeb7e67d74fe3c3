"""Codes of paths (see `path_codes`): extended by factors, summed by pixel, and written."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from hyperpaint.base.arrays import Array
from hyperpaint.base.jit import borrowing_kernel

from .path_codes import FIRST_DIGIT

_MULTIPLIER = np.uint64(0x9E3779B1)


# Weights of a pixel's paths by code: an open-addressing table whose length is a power of two.
class PathTable(NamedTuple):
    codes: Array  # code of every place; -1 for empty places
    sums: Array  # sum of weights of every place
    used: Array  # numbers of the occupied places
    in_use: Array  # (1,) count of the occupied places


@borrowing_kernel
def with_factor(code: Any, factor: Any, digit_bits: int) -> Any:
    # insert a factor into a code, with digits in descending order
    digit = np.int64(factor) + 1
    max_digit = (np.int64(1) << digit_bits) - 1
    place = FIRST_DIGIT
    while (code >> place) & max_digit > digit:
        place += digit_bits
    lower_digits = code & ((np.int64(1) << place) - 1)
    return lower_digits | (digit << place) | ((code >> place) << (place + digit_bits))


@borrowing_kernel
def add_path(table: PathTable, code: int, weight: float) -> None:
    if not weight > 0.0:
        return
    codes, sums, in_use = table.codes, table.sums, table.in_use
    mask = codes.size - 1
    folded = np.uint64((code ^ (code >> 29)) & 0xFFFFFFFF) * _MULTIPLIER
    place = np.int64(folded >> np.uint64(16)) & mask
    while codes[place] != code:
        if codes[place] < 0:
            codes[place] = code
            sums[place] = 0.0
            table.used[in_use[0]] = place
            in_use[0] += 1
            break
        place = (place + 1) & mask
    sums[place] += weight


@borrowing_kernel
def _precedes(table: PathTable, a: int, b: int, by_weight: bool) -> Any:
    # order by descending weight, or by ascending code
    if by_weight and table.sums[a] != table.sums[b]:
        return table.sums[a] > table.sums[b]
    return table.codes[a] < table.codes[b]


@borrowing_kernel
def _sort(table: PathTable, count: int, by_weight: bool) -> None:
    places = table.used
    gap = 1
    while gap < count // 3:
        gap = 3 * gap + 1
    while gap > 0:
        for i in range(gap, count):
            place = places[i]
            j = i
            while j >= gap and _precedes(table, place, places[j - gap], by_weight):
                places[j] = places[j - gap]
                j -= gap
            places[j] = place
        gap //= 3


@borrowing_kernel
def _thin(table: PathTable, count: int, slots: int, draw: float) -> int:
    # Reduce the codes of a pixel to ``slots`` without bias or change of the total weight; return their
    # number. The heaviest codes are kept unchanged. Of other codes, systematic sampling selects with
    # probabilities proportional to weights, and gives all selected codes the same weight.
    sums, places = table.sums, table.used
    _sort(table, count, True)
    light_sum = 0.0
    for i in range(count - 1, -1, -1):
        light_sum += sums[places[i]]
    kept_count = 0
    # a code heavier than the mean weight of the remaining slots is kept unchanged
    while kept_count < slots and sums[places[kept_count]] * (slots - kept_count) > light_sum:
        light_sum -= sums[places[kept_count]]
        kept_count += 1
    if kept_count == slots:
        kept_count = slots - 1
    light_sum = 0.0
    for i in range(kept_count, count):
        light_sum += sums[places[i]]
    step = light_sum / (slots - kept_count)
    selected, passed = kept_count, 0.0
    for i in range(kept_count, count):
        passed += sums[places[i]]
        if selected < slots and passed > (selected - kept_count + draw) * step:
            places[selected], places[i] = places[i], places[selected]
            selected += 1
    for i in range(kept_count, selected):
        sums[places[i]] = step
    return selected


@borrowing_kernel
def write_paths(
    table: PathTable, scale: float, draw: float, weight: Array, code: Array, line: int, column: int
) -> None:
    """Write the table of a pixel in ascending order of codes.

    Parameters
    ----------
    table
        Table of the pixel.
    scale
        Multiplier of the weights.
    draw
        A random number inside (0, 1), for pixels with more codes than slots: see `_thin`.
    weight, code : (line, slot, column), float32 and int64
        Output.
    line, column
        The pixel.
    """
    slots = weight.shape[1]
    number = table.in_use[0]
    if number > slots:
        number = _thin(table, number, slots, draw)
    _sort(table, number, False)
    for slot in range(slots):
        if slot < number:
            code[line, slot, column] = table.codes[table.used[slot]]
            weight[line, slot, column] = table.sums[table.used[slot]] * scale
        else:
            code[line, slot, column] = -1
            weight[line, slot, column] = 0.0
