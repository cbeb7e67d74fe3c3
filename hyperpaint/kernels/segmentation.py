"""Segmentation of a cube: relative steps between neighbouring spectra, joined from the smallest on."""

from __future__ import annotations

from typing import Any

import numpy as np

from hyperpaint.base.arrays import Array
from hyperpaint.base.jit import kernel


@kernel
def step_sizes(channels: Array, floor: Any, across: Array, along: Array) -> None:
    """Write the relative step from every pixel to the next one across and along the track (line, column).

    The root mean square over ``channels`` (line, column, channel), reflectances [1], of differences over
    their mean plus ``floor`` [1]; infinite where there is no next pixel, or half the channels lack data. The
    outputs may have fewer lines than ``channels``.
    """
    lines, columns, count = channels.shape
    for line in range(across.shape[0]):
        for x in range(columns):
            for way in range(2):
                other_line, other_x = (line, x + 1) if way == 0 else (line + 1, x)
                size = np.inf
                if other_line < lines and other_x < columns:
                    total = 0.0
                    valid = 0
                    for k in range(count):
                        one, other = (
                            np.float64(channels[line, x, k]),
                            np.float64(channels[other_line, other_x, k]),
                        )
                        if one == one and other == other:
                            step = (one - other) / (0.5 * (max(one, 0.0) + max(other, 0.0)) + floor)
                            total += step * step
                            valid += 1
                    if 2 * valid > count:
                        size = np.sqrt(total / valid)
                if way == 0:
                    across[line, x] = size
                else:
                    along[line, x] = size


@kernel
def count_steps(steps: Array, bits: Array, counts: Array) -> None:
    """Count finite ``steps``, float32 from 0 on, in piles (32768,) by the upper 16 of their ``bits``.

    ``bits`` are the steps viewed as uint32, which ascend as the steps do.
    """
    for place in range(steps.size):
        if steps[place] < np.inf:
            counts[bits[place] >> 16] += 1


@kernel
def pick_steps(
    bits: Array, first_place: Any, first_pile: Any, end_pile: Any, places: Array, values: Array, start: Any
) -> Any:
    """Write places and bits of the steps in a range of piles; return the number written so far.

    ``first_place`` is the place of the first given step, ``start`` the number written before.
    """
    count = start
    for k in range(bits.size):
        pile = bits[k] >> 16
        if first_pile <= pile < end_pile:
            places[count], values[count] = first_place + k, bits[k]
            count += 1
    return count


@kernel
def sort_steps(places: Array, values: Array, other_places: Array, other_values: Array) -> None:
    """Sort places by their values (uint32), keeping the order of equal ones: a radix sort in three passes.

    Each pass deals to 2048 piles by 11 bits, the lowest first. The result is in ``other_places`` and
    ``other_values``.
    """
    starts = np.empty(2049, np.int64)
    for turn in range(3):
        if turn % 2 == 0:
            source, target, value, moved = places, other_places, values, other_values
        else:
            source, target, value, moved = other_places, places, other_values, values
        starts[:] = 0
        for k in range(source.size):
            starts[((value[k] >> (11 * turn)) & 2047) + 1] += 1
        for pile in range(2048):
            starts[pile + 1] += starts[pile]
        for k in range(source.size):
            pile = (value[k] >> (11 * turn)) & 2047
            target[starts[pile]], moved[starts[pile]] = source[k], value[k]
            starts[pile] += 1


@kernel
def root_of(parent: Array, pixel: Any) -> Any:
    # Root of a pixel's tree, halving the path to it.
    while parent[pixel] != pixel:
        parent[pixel] = parent[parent[pixel]]
        pixel = parent[pixel]
    return pixel


@kernel
def join_segments(
    order: Array, steps: Array, columns: Any, scale: Any, parent: Array, size: Array, within: Array
) -> None:
    """Join pixels over the steps between them, smallest first (Felzenszwalb & Huttenlocher 2004).

    Two segments are joined where the step between them is at most, for each of them, the largest step inside
    it plus ``scale`` over its size.

    ``order`` (step,) are the places of ``steps`` (step,), both by ascending steps: 2 x pixel for the step
    across, 2 x pixel + 1 for that along; ``columns``: pixels of a line. Written are the tree of every pixel,
    ``parent`` (pixel,), and at its root the ``size`` of the segment [pixel] and ``within``, the largest step
    inside it. Larger steps may follow in another call.
    """
    for k in range(order.size):
        place, step = order[k], steps[k]
        one = place // 2
        other = one + 1 if place % 2 == 0 else one + columns
        one, other = root_of(parent, one), root_of(parent, other)
        if one == other:
            continue
        if step <= within[one] + scale / size[one] and step <= within[other] + scale / size[other]:
            low, high = min(one, other), max(one, other)
            parent[high] = low
            size[low] += size[high]
            within[low] = step


@kernel
def count_cores(parent: Array, columns: Any, core: Array) -> None:
    # Write, at the root of every segment, the number of its pixels whose four neighbours belong to it.
    lines = parent.size // columns
    for pixel in range(parent.size):
        root_of(parent, pixel)
    core[:] = 0
    for line in range(1, lines - 1):
        for x in range(1, columns - 1):
            pixel = line * columns + x
            root = root_of(parent, pixel)
            inside = root_of(parent, pixel - 1) == root and root_of(parent, pixel + 1) == root
            inside = inside and root_of(parent, pixel - columns) == root
            if inside and root_of(parent, pixel + columns) == root:
                core[root] += 1


@kernel
def mark_large(parent: Array, size: Array, columns: Any, least: Any, least_core: Any, large: Array) -> None:
    # Write, at the root of every segment, whether it has enough pixels and core pixels, see `absorb`.
    core = np.zeros(parent.size, np.int32)
    count_cores(parent, columns, core)
    for pixel in range(parent.size):
        large[pixel] = parent[pixel] == pixel and size[pixel] >= least and core[pixel] >= least_core


@kernel
def absorb(order: Array, columns: Any, large: Array, parent: Array, size: Array) -> None:
    """Join segments that are not ``large`` (pixel,), at their roots, to a neighbour, by ascending steps.

    Larger steps may follow in another call.
    """
    for place in order:
        one = place // 2
        other = one + 1 if place % 2 == 0 else one + columns
        one, other = root_of(parent, one), root_of(parent, other)
        if one == other or (large[one] and large[other]):
            continue
        low, high = min(one, other), max(one, other)
        parent[high] = low
        size[low] += size[high]
        large[low] = large[low] or large[high]


@kernel
def number_segments(parent: Array, valid: Array, number: Array) -> Any:
    """Write the segment of every pixel, numbered by first pixel; return the number of segments.

    Pixels that are not ``valid`` get -1.
    """
    count = 0
    names = np.full(parent.size, -1, np.int32)
    for pixel in range(parent.size):
        root = root_of(parent, pixel)
        if not valid[pixel]:
            number[pixel] = -1
            continue
        if names[root] < 0:
            names[root] = count
            count += 1
        number[pixel] = names[root]
    return count


@kernel
def count_pixels(number: Array, chosen: Array, counts: Array) -> None:
    # Count the pixels of every segment (2, segment): those not chosen, and those chosen.
    for line in range(number.shape[0]):
        for x in range(number.shape[1]):
            if number[line, x] >= 0:
                counts[1 if chosen[line, x] else 0, number[line, x]] += 1


@kernel
def sample_places(
    number: Array, chosen: Array, wanted: Array, step: Array, start: Array, seen: Array, out: Array
) -> None:
    """Write the places (line by line) of every ``step``-th pixel of each segment.

    Only pixels whose ``chosen`` equals the segment's ``wanted`` count. ``start`` (segment,) is the place in
    ``out`` of a segment's first sample; ``seen`` (segment,) starts at 0.
    """
    columns = number.shape[1]
    for line in range(number.shape[0]):
        for x in range(columns):
            segment = number[line, x]
            if segment >= 0 and chosen[line, x] == wanted[segment]:
                if seen[segment] % step[segment] == 0:
                    out[start[segment] + seen[segment] // step[segment]] = line * columns + x
                seen[segment] += 1


@kernel
def to_pixels(parent: Array, of_roots: Array, of_pixels: Array) -> None:
    # Write to every pixel the value at the root of its segment.
    for pixel in range(parent.size):
        of_pixels[pixel] = of_roots[root_of(parent, pixel)]


@kernel
def boundary_distance(body: Array, sure: Array, most: Any, distance: Array) -> None:
    """Write the distance of every pixel (in steps to eight neighbours) from a mixed pixel or an unknown one.

    ``body`` (line, column) is the body a pixel shows, -1 where unknown. The ``distance`` is 0 in a mixed
    pixel, 1 beside another body, and so on up to ``most``, at most 255. A pixel that is not ``sure``, because
    its body was taken from its neighbours, has 0 where another body is within 2 pixels.
    """
    lines, columns = body.shape
    for line in range(lines):
        for x in range(columns):
            nearest = most
            around = 1 if sure[line, x] else 2
            for dy in range(-around, around + 1):
                for dx in range(-around, around + 1):
                    y, z = line + dy, x + dx
                    if 0 <= y < lines and 0 <= z < columns and body[y, z] != body[line, x]:
                        nearest = 1 if sure[line, x] else 0
            distance[line, x] = 0 if body[line, x] < 0 else nearest
    for sweep in range(2):
        for i in range(lines):
            line = i if sweep == 0 else lines - 1 - i
            for j in range(columns):
                x = j if sweep == 0 else columns - 1 - j
                ahead = -1 if sweep == 0 else 1
                best = np.int64(distance[line, x])
                for dy, dx in ((ahead, -1), (ahead, 0), (ahead, 1), (0, ahead)):
                    y, z = line + dy, x + dx
                    if 0 <= y < lines and 0 <= z < columns:
                        best = min(best, np.int64(distance[y, z]) + 1)
                distance[line, x] = best


@kernel
def offer(label: Any, squared: Any, labels: Array, distances: Array) -> None:
    # Insert a source into a short list of the nearest, in which every label stands once.
    count = labels.size
    for place in range(count):
        if labels[place] == label:
            if squared >= distances[place]:
                return
            for later in range(place, count - 1):
                labels[later], distances[later] = labels[later + 1], distances[later + 1]
            labels[count - 1], distances[count - 1] = -1, np.inf
            break
    for place in range(count):
        if squared < distances[place]:
            for later in range(count - 1, place, -1):
                labels[later], distances[later] = labels[later - 1], distances[later - 1]
            labels[place], distances[place] = label, squared
            return


@kernel
def nearest_sources(labels: Array, distances: Array, reach: Any) -> None:
    """Spread labels from labelled cells to all cells within reach, keeping the nearest ones.

    ``labels`` (line, column, place) hold a cell's label at the first place, -1 without one, and receive the
    nearest labels; ``distances`` hold 0 at a label, else infinity, and receive their distances [cell]; labels
    spread no farther than ``reach`` [cell].
    """
    lines, columns, places = labels.shape
    for _ in range(2):
        for sweep in range(2):
            ahead = -1 if sweep == 0 else 1
            for i in range(lines):
                line = i if sweep == 0 else lines - 1 - i
                for j in range(columns):
                    x = j if sweep == 0 else columns - 1 - j
                    for dy, dx in ((ahead, -1), (ahead, 0), (ahead, 1), (0, ahead)):
                        y, z = line + dy, x + dx
                        if 0 <= y < lines and 0 <= z < columns:
                            step = np.sqrt(float(dy * dy + dx * dx))
                            for place in range(places):
                                far = distances[y, z, place] + step
                                if labels[y, z, place] >= 0 and far <= reach:
                                    offer(labels[y, z, place], far, labels[line, x], distances[line, x])
