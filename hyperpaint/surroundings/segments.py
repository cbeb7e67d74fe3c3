"""Division of a picture in channels into segments of one surface in one light."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.sparse

from hyperpaint.base.arrays import Array, Bools, Floats32, Ints

from .detection_rules import SEGMENTS
from .scratch import line_parts, release, scratch_array, trim_memory


class Segments(NamedTuple):
    """Segments of a line."""

    number: npt.NDArray[np.int32]  #: (line, column), int32: Of every pixel; -1 without data.
    sure: Bools  #: (line, column), bool: False where a pixel only goes with its neighbours.
    size: Ints  #: (segment,), int64: Pixels.


class Touching(NamedTuple):
    """Pairs of segments that touch, sorted, both ways round."""

    #: (pair,): Segments.
    one: Ints
    other: Ints
    length: Ints  #: (pair,): Sides of pixels that lie between them.
    #: (pair, 4): Number of these sides crossed from one to the other along, against, to the right and to the
    #: left.
    sides: Ints


def divide(channels: Floats32) -> Segments:
    """Return the segments of a line (line, column, channel).

    The steps between neighbouring pixels are taken in ascending order, and join their two segments unless
    they stand out from the steps inside (Felzenszwalb & Huttenlocher, Ints. J. Comput. Vis. 59, 2004). The
    result does not depend on chunks.
    """
    from hyperpaint.kernels import segmentation as kernels

    lines, columns, _ = channels.shape
    has_data = np.empty((lines, columns), np.bool_)
    steps = scratch_array((lines, columns, 2), np.float32)  # to the right, and to the next line
    counts = np.zeros(1 << 15, np.int64)
    for part, seen in line_parts(channels, more=1):
        here = steps[part]
        kernels.step_sizes(seen, SEGMENTS.step_floor, here[..., 0], here[..., 1])
        kernels.count_steps(here.ravel(), here.ravel().view(np.uint32), counts)
        release(steps)
        has_data[part] = np.isfinite(seen[: part.stop - part.start]).mean(axis=2) > 0.5
    parent = np.arange(lines * columns, dtype=np.int32)
    size, within = np.ones(parent.size, np.int32), np.zeros(parent.size, np.float32)
    order = scratch_array((int(counts.sum()),), np.int32)
    ends = [0]
    for places, values in _sorted_steps(steps, counts):
        kernels.join_segments(places, values, columns, SEGMENTS.granularity, parent, size, within)
        ends.append(ends[-1] + places.size)
        order[ends[-2] : ends[-1]] = places
        release(order)
    del within, steps
    large, sure = np.empty((2, parent.size), np.bool_)
    kernels.mark_large(parent, size, columns, SEGMENTS.min_pixels, SEGMENTS.min_core_px, large)
    kernels.to_pixels(parent, large, sure)
    for first, end in pairwise(ends):
        kernels.absorb(order[first:end], columns, large, parent, size)
        release(order)
    del order, size, large
    number = np.empty(parent.size, np.int32)
    count = kernels.number_segments(parent, has_data.ravel(), number)
    shape = lines, columns
    del parent
    sizes = np.bincount(number[number >= 0], minlength=count).astype(np.int64)
    return Segments(number.reshape(shape), sure.reshape(shape), sizes)


#: Number of parts in which steps are sorted.
_PARTS = 8


def _sorted_steps(steps: Floats32, counts: Ints) -> Iterator[tuple[Array, Array]]:
    # Yield places and sizes of the finite steps (line, column, way), ascending, in parts
    from hyperpaint.kernels.segmentation import pick_steps, sort_steps

    total = np.concatenate([[0], np.cumsum(counts)])
    # bins at which each part is full; beyond the last lie steps that are not finite
    full = np.searchsorted(total, np.linspace(0, total[-1], _PARTS + 1)[1:])
    edges = np.unique(np.concatenate([[0], full]))
    most = np.diff(total[edges]).max(initial=0)
    # allocated once: repeated allocation would not reuse all memory
    places, values = np.empty((2, most), np.int32), np.empty((2, most), np.uint32)
    for first, end in pairwise(edges):
        count = 0
        for part, here in line_parts(steps):
            bits, offset = here.ravel().view(np.uint32), part.start * steps.shape[1] * 2
            count = pick_steps(bits, offset, first, end, places[0], values[0], count)
        one, other = (places[0, :count], values[0, :count]), (places[1, :count], values[1, :count])
        sort_steps(*one, *other)
        yield other[0], other[1].view(np.float32)


def sample_pixels(number: npt.NDArray[np.int32], chosen: Bools, count: int) -> list[Ints]:
    """Return places of at most `max_sample_px` chosen pixels of every segment, evenly spread in line order.

    Segments without a chosen pixel give their first pixels.
    """
    from hyperpaint.kernels.segmentation import count_pixels, sample_places

    counts = np.zeros((2, count), np.int64)
    count_pixels(number, chosen, counts)
    # segments without a chosen pixel use all their pixels
    wanted = counts[1] > 0
    held = np.where(wanted, counts[1], counts[0])
    step = np.maximum(1, -(-held // SEGMENTS.max_sample_px))
    ends = np.cumsum(-(-held // step))
    out = np.empty(ends[-1] if count else 0, np.int64)
    sample_places(number, chosen, wanted, step, ends - -(-held // step), np.zeros(count, np.int64), out)
    return np.split(out, ends[:-1]) if count else []


def touching(number: npt.NDArray[np.int32], count: int) -> Touching:
    """Return the touching segments, with the number and direction of their common sides."""
    codes, ways = [], []
    for axis, (a, b) in enumerate(_NEXT):
        for _, part in line_parts(number, more=1 - axis):
            first, second = part[a].ravel(), part[b].ravel()
            differ = np.flatnonzero((first != second) & (first >= 0) & (second >= 0))
            one, other = first[differ].astype(np.int64), second[differ].astype(np.int64)
            codes += [one * count + other, other * count + one]
            ways += [np.full(one.size, 2 * axis, np.int8), np.full(one.size, 2 * axis + 1, np.int8)]
    pairs, place = np.unique(np.concatenate(codes), return_inverse=True)
    sides = np.bincount(4 * place + np.concatenate(ways), minlength=4 * pairs.size).reshape(-1, 4)
    del codes, ways, place
    trim_memory()
    return Touching(pairs // max(count, 1), pairs % max(count, 1), sides.sum(axis=1), sides)


def beyond(pairs: Touching, size: Ints) -> tuple[Ints, Ints]:
    """Return pairs of segments that touch, or have a small segment between them that touches both.

    Large segments are no bridge: everything in a car park touches the asphalt.
    """
    count = size.size
    near = pairs.length >= SEGMENTS.min_border_sides
    one, other = pairs.one[near], pairs.other[near]
    touch = scipy.sparse.csr_array((np.ones(one.size), (one, other)), shape=(count, count))
    small = scipy.sparse.diags_array((size < SEGMENTS.max_bridge_px).astype(np.float64))
    both = (touch + touch @ small @ touch).tocoo()
    row, column = (axis.astype(np.int64) for axis in both.coords)
    apart = row != column
    order = np.lexsort((column[apart], row[apart]))
    return row[apart][order], column[apart][order]


def distinct_pairs(one: Ints, other: Ints, count: int) -> tuple[Ints, Ints]:
    """Return pairs of numbers below ``count``, each once, sorted."""
    codes = np.unique(one * count + other)
    return codes // max(count, 1), codes % max(count, 1)


def border_steps(channels: Floats32, number: npt.NDArray[np.int32], pairs: Touching) -> Array:
    """Return the mean difference of brightness of the pixels on both sides of a border (pair,) [1]."""
    count = int(number.max()) + 1
    codes = pairs.one * count + pairs.other
    total = np.zeros(codes.size)
    for axis, (a, b) in enumerate(_NEXT):
        both_ways = np.zeros((2, codes.size))
        for lines, seen in line_parts(channels, more=1 - axis):
            part, level = number[lines.start : lines.start + len(seen)], seen.mean(axis=2)
            first, second = part[a].ravel(), part[b].ravel()
            differ = np.flatnonzero((first != second) & (first >= 0) & (second >= 0))
            step = np.abs(level[a] - level[b]).ravel()[differ].astype(np.float64)
            one, other = first[differ].astype(np.int64), second[differ].astype(np.int64)
            for sums, code in zip(both_ways, (one * count + other, other * count + one), strict=True):
                # summed one after another: the same bits for any parts
                np.add.at(sums, np.searchsorted(codes, code), np.nan_to_num(step))
        for sums in both_ways:
            total += sums
    return total / pairs.length


#: Pixels and those of the next line; and those to the right.
_NEXT: tuple[Any, Any] = (np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])


def edge_distance(
    segments: Segments, body: npt.NDArray[np.int32], surface: npt.NDArray[np.int32]
) -> npt.NDArray[np.uint8]:
    """Return the distance of every pixel from another surface (line, column) [pixel]; 0 in mixed pixels.

    Bodies (segment,) of one surface (segment,) differ by light and tilt, so that no material is mixed where
    they meet; small or thin segments between them are still mixed.
    """
    from hyperpaint.kernels.segmentation import boundary_distance

    to_surface = np.empty(segments.number.shape, np.uint8)
    between = np.empty_like(to_surface)
    for labels, distance in ((surface, to_surface), (body, between)):
        shown = np.append(labels, np.int32(-1))[segments.number].astype(np.int32)
        boundary_distance(shown, segments.sure, 255, distance)
    to_surface[between == 0] = 0
    return to_surface


def distance_to(chosen: Bools) -> npt.NDArray[np.uint8]:
    """Return the distance of every pixel from a chosen one (line, column) [pixel], 0 in one; at most 255."""
    from hyperpaint.kernels.segmentation import boundary_distance

    distance = np.empty(chosen.shape, np.uint8)
    boundary_distance(chosen.astype(np.int32), np.ones(chosen.shape, bool), 255, distance)
    distance[chosen] = 0
    return distance
