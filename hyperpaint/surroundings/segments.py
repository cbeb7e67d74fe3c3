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
from .scratch import line_blocks, release, scratch_array, trim_memory


class Segments(NamedTuple):
    """Segments of a line."""

    number: npt.NDArray[np.int32]  #: (line, column), int32: Segment of every pixel; -1 without data.
    sure: Bools  #: (line, column), bool: False in small or thin segments that joined a neighbour.
    size: Ints  #: (segment,), int64: Number of pixels.


class Touching(NamedTuple):
    """Pairs of segments that touch, sorted; every pair occurs in both orders."""

    one: Ints  #: (pair,): First segment.
    other: Ints  #: (pair,): Second segment.
    length: Ints  #: (pair,): Number of pixel sides between them.
    #: (pair, 4): Number of these sides where the second segment lies along the track, against it, to the
    #: right, to the left.
    sides: Ints


def divide(channels: Floats32) -> Segments:
    """Return the segments of a line (line, column, channel).

    The steps between neighbouring pixels are visited in ascending order. A step joins its two segments unless
    it is larger than the steps inside them allow (Felzenszwalb & Huttenlocher, Int. J. Comput. Vis. 59,
    2004). The result does not depend on chunks.
    """
    from hyperpaint.kernels import segmentation as kernels

    lines, columns, _ = channels.shape
    has_data = np.empty((lines, columns), np.bool_)
    steps = scratch_array((lines, columns, 2), np.float32)  # to the right, and to the next line
    counts = np.zeros(1 << 15, np.int64)
    for rows, block in line_blocks(channels, overlap=1):
        block_steps = steps[rows]
        kernels.step_sizes(block, SEGMENTS.step_floor, block_steps[..., 0], block_steps[..., 1])
        kernels.count_steps(block_steps.ravel(), block_steps.ravel().view(np.uint32), counts)
        release(steps)
        has_data[rows] = np.isfinite(block[: rows.stop - rows.start]).mean(axis=2) > 0.5
    # segments as trees: parent of every pixel, and size and largest inner step of every root
    parent = np.arange(lines * columns, dtype=np.int32)
    size, inner_step = np.ones(parent.size, np.int32), np.zeros(parent.size, np.float32)
    order = scratch_array((int(counts.sum()),), np.int32)
    ends = [0]
    for indices, values in _sorted_steps(steps, counts):
        kernels.join_segments(indices, values, columns, SEGMENTS.granularity, parent, size, inner_step)
        ends.append(ends[-1] + indices.size)
        order[ends[-2] : ends[-1]] = indices
        release(order)
    del inner_step, steps
    # small and thin segments join a neighbour, over the smallest steps first
    large, sure = np.empty((2, parent.size), np.bool_)
    kernels.mark_large(parent, size, columns, SEGMENTS.min_pixels, SEGMENTS.min_core_px, large)
    kernels.to_pixels(parent, large, sure)
    for start, stop in pairwise(ends):
        kernels.absorb(order[start:stop], columns, large, parent, size)
        release(order)
    del order, size, large
    number = np.empty(parent.size, np.int32)
    count = kernels.number_segments(parent, has_data.ravel(), number)
    shape = lines, columns
    del parent
    sizes = np.bincount(number[number >= 0], minlength=count).astype(np.int64)
    return Segments(number.reshape(shape), sure.reshape(shape), sizes)


#: Number of groups of steps, in ascending ranges of size, that are sorted one after another.
_GROUPS = 8


def _sorted_steps(steps: Floats32, counts: Ints) -> Iterator[tuple[Array, Array]]:
    # Yield flat indices and sizes of the finite steps (line, column, direction), ascending, in groups.
    # `counts` is the histogram of the sizes, in bins of the upper bits of float32.
    from hyperpaint.kernels.segmentation import pick_steps, sort_steps

    total = np.concatenate([[0], np.cumsum(counts)])
    # last bin of every group; steps that are not finite lie beyond the last group
    last_bins = np.searchsorted(total, np.linspace(0, total[-1], _GROUPS + 1)[1:])
    edges = np.unique(np.concatenate([[0], last_bins]))
    max_count = np.diff(total[edges]).max(initial=0)
    # allocated once: repeated allocation would not reuse all memory
    indices, values = np.empty((2, max_count), np.int32), np.empty((2, max_count), np.uint32)
    for start, stop in pairwise(edges):
        count = 0
        for rows, block in line_blocks(steps):
            bits, offset = block.ravel().view(np.uint32), rows.start * steps.shape[1] * 2
            count = pick_steps(bits, offset, start, stop, indices[0], values[0], count)
        group = indices[0, :count], values[0, :count]
        sorted_group = indices[1, :count], values[1, :count]
        sort_steps(*group, *sorted_group)
        yield sorted_group[0], sorted_group[1].view(np.float32)


def sample_pixels(number: npt.NDArray[np.int32], inside: Bools, count: int) -> list[Ints]:
    """Return flat indices of at most `max_sample_px` pixels of every segment, evenly spread in line order.

    Pixels of the mask ``inside`` are sampled; all pixels of segments without such a pixel.
    """
    from hyperpaint.kernels.segmentation import count_pixels, sample_places

    counts = np.zeros((2, count), np.int64)
    count_pixels(number, inside, counts)
    has_inside = counts[1] > 0
    available = np.where(has_inside, counts[1], counts[0])
    step = np.maximum(1, -(-available // SEGMENTS.max_sample_px))
    sizes = -(-available // step)
    ends = np.cumsum(sizes)
    samples = np.empty(ends[-1] if count else 0, np.int64)
    sample_places(number, inside, has_inside, step, ends - sizes, np.zeros(count, np.int64), samples)
    return np.split(samples, ends[:-1]) if count else []


def touching(number: npt.NDArray[np.int32], count: int) -> Touching:
    """Return the touching segments, with the number and direction of their common sides."""
    # a pair of segments is coded as one number
    codes, directions = [], []
    for axis, (before, after) in enumerate(_NEIGHBOURS):
        for _, block in line_blocks(number, overlap=1 - axis):
            first, second = block[before].ravel(), block[after].ravel()
            differ = np.flatnonzero((first != second) & (first >= 0) & (second >= 0))
            one, other = first[differ].astype(np.int64), second[differ].astype(np.int64)
            codes += [one * count + other, other * count + one]
            directions += [np.full(one.size, 2 * axis, np.int8), np.full(one.size, 2 * axis + 1, np.int8)]
    pairs, pair = np.unique(np.concatenate(codes), return_inverse=True)
    sides = np.bincount(4 * pair + np.concatenate(directions), minlength=4 * pairs.size).reshape(-1, 4)
    del codes, directions, pair
    trim_memory()
    return Touching(pairs // max(count, 1), pairs % max(count, 1), sides.sum(axis=1), sides)


def beyond(pairs: Touching, size: Ints) -> tuple[Ints, Ints]:
    """Return pairs of segments that touch, or have a small segment between them that touches both.

    Large segments do not link others: everything in a car park touches the asphalt.
    """
    count = size.size
    near = pairs.length >= SEGMENTS.min_border_sides
    one, other = pairs.one[near], pairs.other[near]
    touch = scipy.sparse.csr_array((np.ones(one.size), (one, other)), shape=(count, count))
    small = scipy.sparse.diags_array((size < SEGMENTS.max_bridge_px).astype(np.float64))
    linked = (touch + touch @ small @ touch).tocoo()
    row, column = (axis.astype(np.int64) for axis in linked.coords)
    differ = row != column
    order = np.lexsort((column[differ], row[differ]))
    return row[differ][order], column[differ][order]


def distinct_pairs(one: Ints, other: Ints, count: int) -> tuple[Ints, Ints]:
    """Return the distinct pairs of numbers below ``count``, sorted."""
    codes = np.unique(one * count + other)
    return codes // max(count, 1), codes % max(count, 1)


def border_steps(channels: Floats32, number: npt.NDArray[np.int32], pairs: Touching) -> Array:
    """Return the mean difference in brightness of neighbouring pixels across a border (pair,) [1]."""
    count = int(number.max()) + 1
    codes = pairs.one * count + pairs.other
    total = np.zeros(codes.size)
    for axis, (before, after) in enumerate(_NEIGHBOURS):
        sums_of_orders = np.zeros((2, codes.size))
        for lines, block in line_blocks(channels, overlap=1 - axis):
            numbers, level = number[lines.start : lines.start + len(block)], block.mean(axis=2)
            first, second = numbers[before].ravel(), numbers[after].ravel()
            differ = np.flatnonzero((first != second) & (first >= 0) & (second >= 0))
            step = np.abs(level[before] - level[after]).ravel()[differ].astype(np.float64)
            one, other = first[differ].astype(np.int64), second[differ].astype(np.int64)
            for sums, code in zip(sums_of_orders, (one * count + other, other * count + one), strict=True):
                # sequential sums: the same bits for any blocks
                np.add.at(sums, np.searchsorted(codes, code), np.nan_to_num(step))
        for sums in sums_of_orders:
            total += sums
    return total / pairs.length


#: Slices of pixels and their neighbours, first in the next line, then in the next column.
_NEIGHBOURS: tuple[Any, Any] = (np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])


def edge_distance(
    segments: Segments, body: npt.NDArray[np.int32], surface: npt.NDArray[np.int32]
) -> npt.NDArray[np.uint8]:
    """Return the distance of every pixel from another surface (line, column) [pixel]; 0 in mixed pixels.

    Takes ``body``, ``surface`` (segment,): body and surface of every segment. Bodies of one surface differ by
    light and tilt only, so that pixels between them are not mixed; small or thin segments there still are.
    """
    from hyperpaint.kernels.segmentation import boundary_distance

    to_surface = np.empty(segments.number.shape, np.uint8)
    to_body = np.empty_like(to_surface)
    for labels, distance in ((surface, to_surface), (body, to_body)):
        pixel_labels = np.append(labels, np.int32(-1))[segments.number].astype(np.int32)
        boundary_distance(pixel_labels, segments.sure, 255, distance)
    to_surface[to_body == 0] = 0
    return to_surface


def distance_to(mask: Bools) -> npt.NDArray[np.uint8]:
    """Return the distance of every pixel from a mask (line, column) [pixel], 0 inside; at most 255."""
    from hyperpaint.kernels.segmentation import boundary_distance

    distance = np.empty(mask.shape, np.uint8)
    boundary_distance(mask.astype(np.int32), np.ones(mask.shape, bool), 255, distance)
    distance[mask] = 0
    return distance
