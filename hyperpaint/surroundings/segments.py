"""A picture in channels, divided into segments of one surface in one light."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Array, Bools, Floats32, Ints

from .detection_rules import SEGMENTS

__all__ = [
    "Segments", "Touching", "beyond", "border_steps", "distance_to", "distinct_pairs", "divide",
    "edge_distance", "sample_pixels", "touching",
]  # fmt: skip


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
    #: (pair, 4): How many of these sides are steps from one to the other along, against, to the right and to
    #: the left.
    sides: Ints


def divide(channels: Floats32) -> Segments:
    """Return the segments of a line (line, column, channel).

    The steps between neighbouring pixels are taken from the gentlest on, and join what they lie between
    unless they stand out from the steps inside (Felzenszwalb & Huttenlocher, Ints. J. Comput. Vis. 59, 2004).
    Nothing depends on how the line came into memory.
    """
    from hyperpaint.kernels.segmentation import absorb, is_large, join_segments, number_segments, step_sizes

    lines, columns, _ = channels.shape
    across, along = np.empty((2, lines, columns), np.float32)
    step_sizes(channels, SEGMENTS.step_floor, across, along)
    steps = np.stack([across.ravel(), along.ravel()], axis=1).ravel()
    del across, along
    order = np.argsort(steps, kind="stable")
    order = order[: np.searchsorted(steps[order], np.inf)]
    parent = np.arange(lines * columns, dtype=np.int32)
    size = np.ones(parent.size, np.int32)
    join_segments(order, steps, columns, SEGMENTS.granularity, parent, size)
    has_data = np.isfinite(channels).mean(axis=2).ravel() > 0.5
    sure = np.empty(parent.size, np.bool_)
    is_large(parent, size, columns, SEGMENTS.min_pixels, SEGMENTS.min_core_px, sure)
    absorb(order, columns, SEGMENTS.min_pixels, SEGMENTS.min_core_px, parent, size)
    number = np.empty(parent.size, np.int32)
    count = number_segments(parent, has_data, number)
    shape = lines, columns
    sizes = np.bincount(number[number >= 0], minlength=count).astype(np.int64)
    return Segments(number.reshape(shape), sure.reshape(shape), sizes)


def sample_pixels(number: npt.NDArray[np.int32], chosen: Bools, count: int) -> list[Ints]:
    """Return places of at most `max_sample_px` chosen pixels of every segment, evenly spread in line order.

    Segments without a chosen pixel give the first ones they have.
    """
    flat, wanted = number.ravel(), chosen.ravel()
    # chosen pixels first; a stable sort keeps the order of lines
    key = np.where(flat < 0, 2 * count, 2 * flat.astype(np.int64) + ~wanted)
    order = np.argsort(key, kind="stable")
    starts = np.searchsorted(key[order], np.arange(2 * count + 1))
    samples = []
    for segment in range(count):
        first, middle, last = starts[2 * segment], starts[2 * segment + 1], starts[2 * segment + 2]
        here = order[first:middle] if middle > first else order[first:last]
        samples.append(here[:: max(1, -(-here.size // SEGMENTS.max_sample_px))])
    return samples


def touching(number: npt.NDArray[np.int32], count: int) -> Touching:
    """Return which segments touch, how far, and on which side."""
    codes, ways = [], []
    for axis, (a, b) in enumerate(((number[:-1], number[1:]), (number[:, :-1], number[:, 1:]))):
        differ = (a != b) & (a >= 0) & (b >= 0)
        one, other = a[differ].astype(np.int64), b[differ].astype(np.int64)
        codes += [one * count + other, other * count + one]
        ways += [np.full(one.size, 2 * axis), np.full(one.size, 2 * axis + 1)]
    pairs, place = np.unique(np.concatenate(codes), return_inverse=True)
    sides = np.bincount(4 * place + np.concatenate(ways), minlength=4 * pairs.size).reshape(-1, 4)
    return Touching(pairs // max(count, 1), pairs % max(count, 1), sides.sum(axis=1), sides)


def beyond(pairs: Touching, size: Ints) -> tuple[Ints, Ints]:
    """Return pairs of segments that touch, or have a small one between them that touches both.

    Large segments are no bridge: everything in a car park touches the asphalt.
    """
    import scipy.sparse

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
    level = channels.mean(axis=2)
    count = int(number.max()) + 1
    codes = pairs.one * count + pairs.other
    total = np.zeros(codes.size)
    for a, b in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        one, other = number[a].astype(np.int64), number[b].astype(np.int64)
        differ = (one != other) & (one >= 0) & (other >= 0)
        step = np.abs(level[a] - level[b])[differ].astype(np.float64)
        one, other = one[differ], other[differ]
        for code in (one * count + other, other * count + one):
            total += np.bincount(np.searchsorted(codes, code), np.nan_to_num(step), codes.size)
    return total / pairs.length


def edge_distance(
    segments: Segments, body: npt.NDArray[np.int32], surface: npt.NDArray[np.int32]
) -> npt.NDArray[np.uint8]:
    """Return how many pixels every pixel is from another surface (line, column); 0 in mixed pixels.

    Bodies (segment,) of one surface (segment,) differ by light and tilt, so that no material is mixed where
    they meet; what is small or thin between them is in doubt all the same.
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
    """Return how many pixels every pixel is from a chosen one (line, column), 0 in one; at most 255."""
    from hyperpaint.kernels.segmentation import boundary_distance

    distance = np.empty(chosen.shape, np.uint8)
    boundary_distance(chosen.astype(np.int32), np.ones(chosen.shape, bool), 255, distance)
    distance[chosen] = 0
    return distance
