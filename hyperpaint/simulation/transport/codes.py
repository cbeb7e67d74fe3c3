"""Codes of paths (see `path_codes`): put together, added up by pixel, and written."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from hyperpaint.base.arrays import Array
from hyperpaint.base.jit import borrowing_kernel

from .path_codes import FIRST_DIGIT

_MULTIPLIER = np.uint64(0x9E3779B1)


# Weights of a pixel's paths by code: an open-addressing table whose length is a power of two.
class PathTable(NamedTuple):
    codes: Array  # by place; -1 where empty
    sums: Array  # weights by place
    used: Array  # places in use
    in_use: Array  # (1,) their number


@borrowing_kernel
def with_factor(code: Any, factor: Any, digit_bits: int) -> Any:
    # A code with one more factor, its digits still in descending order.
    digit = np.int64(factor) + 1
    full = (np.int64(1) << digit_bits) - 1
    place = FIRST_DIGIT
    while (code >> place) & full > digit:
        place += digit_bits
    low = code & ((np.int64(1) << place) - 1)
    return low | (digit << place) | ((code >> place) << (place + digit_bits))


@borrowing_kernel
def add_path(table: PathTable, code: int, weight: float) -> None:
    if not weight > 0.0:
        return
    codes, sums, in_use = table.codes, table.sums, table.in_use
    mask = codes.size - 1
    folded = np.uint64((code ^ (code >> 29)) & 0xFFFFFFFF) * _MULTIPLIER
    at = np.int64(folded >> np.uint64(16)) & mask
    while codes[at] != code:
        if codes[at] < 0:
            codes[at] = code
            sums[at] = 0.0
            table.used[in_use[0]] = at
            in_use[0] += 1
            break
        at = (at + 1) & mask
    sums[at] += weight


@borrowing_kernel
def _precedes(table: PathTable, a: int, b: int, by_weight: bool) -> Any:
    # Heavier first, or smaller code first.
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
    # Keep ``slots`` of the codes without bias or change of their total; the result is the number kept. The
    # heaviest stay as they are. Of the others, systematic sampling takes each with a probability proportional
    # to its weight, and gives all that are taken the same weight.
    sums, places = table.sums, table.used
    _sort(table, count, True)
    rest = 0.0
    for i in range(count - 1, -1, -1):
        rest += sums[places[i]]
    exact = 0
    # a code heavier than an even share of the rest is always kept, with its weight
    while exact < slots and sums[places[exact]] * (slots - exact) > rest:
        rest -= sums[places[exact]]
        exact += 1
    if exact == slots:
        exact = slots - 1
    rest = 0.0
    for i in range(exact, count):
        rest += sums[places[i]]
    step = rest / (slots - exact)
    taken, passed = exact, 0.0
    for i in range(exact, count):
        passed += sums[places[i]]
        if taken < slots and passed > (taken - exact + draw) * step:
            places[taken], places[i] = places[i], places[taken]
            taken += 1
    for i in range(exact, taken):
        sums[places[i]] = step
    return taken


@borrowing_kernel
def write_paths(
    table: PathTable, scale: float, draw: float, weight: Array, code: Array, line: int, column: int
) -> None:
    """Write the table of a pixel, by ascending code.

    Parameters
    ----------
    table
        Of the pixel.
    scale
        What weights are multiplied by.
    draw
        A random number inside (0, 1), for pixels with more codes than slots: see `_thin`.
    weight, code : (line, slot, column), float32 and int64
        Written.
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
