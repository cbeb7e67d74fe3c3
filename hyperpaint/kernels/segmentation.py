"""Segmentation of a cube: neighbouring pixels are joined, smallest relative steps between spectra first."""

from typing import Any

import numpy as np

from hyperpaint.base import Array
from hyperpaint.base.jit import kernel


@kernel
def step_sizes(channels: Array, floor: Any, across: Array, along: Array) -> None:
    # Write the relative step from every pixel to the next one across and along the track (line, column).
    #
    # A step is the root mean square over ``channels`` (line, column, channel), reflectances [1], of
    # differences over their mean plus ``floor`` [1]; infinite where there is no next pixel, or half the
    # channels lack data. The outputs may have fewer lines than ``channels``.
    lines, columns, count = channels.shape
    for line in range(across.shape[0]):
        for x in range(columns):
            for axis in range(2):
                other_line, other_x = (line, x + 1) if axis == 0 else (line + 1, x)
                size = np.inf
                if other_line < lines and other_x < columns:
                    total = 0.0
                    valid = 0
                    for k in range(count):
                        value, other_value = (
                            np.float64(channels[line, x, k]),
                            np.float64(channels[other_line, other_x, k]),
                        )
                        if value == value and other_value == other_value:
                            step = (value - other_value) / (
                                0.5 * (max(value, 0.0) + max(other_value, 0.0)) + floor
                            )
                            total += step * step
                            valid += 1
                    if 2 * valid > count:
                        size = np.sqrt(total / valid)
                if axis == 0:
                    across[line, x] = size
                else:
                    along[line, x] = size


@kernel
def count_steps(steps: Array, bits: Array, counts: Array) -> None:
    # Count finite ``steps``, float32 >= 0, in buckets (32768,) by the upper 16 of their ``bits``.
    #
    # ``bits`` are the steps viewed as uint32, whose order is that of the steps.
    for k in range(steps.size):
        if steps[k] < np.inf:
            counts[bits[k] >> 16] += 1


@kernel
def pick_steps(
    bits: Array,
    first_place: Any,
    first_bucket: Any,
    end_bucket: Any,
    places: Array,
    values: Array,
    start: Any,
) -> Any:
    # Write places and bits of the steps in a range of buckets; return the number written so far.
    #
    # ``first_place`` is the place of the first given step, ``start`` the number written before.
    count = start
    for k in range(bits.size):
        bucket = bits[k] >> 16
        if first_bucket <= bucket < end_bucket:
            places[count], values[count] = first_place + k, bits[k]
            count += 1
    return count


@kernel
def sort_steps(places: Array, values: Array, other_places: Array, other_values: Array) -> None:
    # Sort places by their values (uint32), keeping the order of equal ones: a radix sort in three passes.
    #
    # Each pass sorts into 2048 buckets by 11 bits, lowest bits first. The result is in ``other_places`` and
    # ``other_values``.
    starts = np.empty(2049, np.int64)
    for digit in range(3):
        if digit % 2 == 0:
            source, target, value, moved_values = places, other_places, values, other_values
        else:
            source, target, value, moved_values = other_places, places, other_values, values
        starts[:] = 0
        for k in range(source.size):
            starts[((value[k] >> (11 * digit)) & 2047) + 1] += 1
        for bucket in range(2048):
            starts[bucket + 1] += starts[bucket]
        for k in range(source.size):
            bucket = (value[k] >> (11 * digit)) & 2047
            target[starts[bucket]], moved_values[starts[bucket]] = source[k], value[k]
            starts[bucket] += 1


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
    # Join pixels over the steps between them, smallest first (Felzenszwalb & Huttenlocher 2004).
    #
    # Two segments are joined where the step between them is at most the largest step inside
    # the segment plus ``scale`` over its size, for both segments.
    #
    # ``order`` (step,) are the places of ``steps`` (step,), both by ascending steps: 2 x pixel for the step
    # across, 2 x pixel + 1 for the step along; ``columns``: pixels of a line. Outputs are the tree of every
    # pixel, ``parent`` (pixel,), and at its root the ``size`` of the segment [pixel] and ``within``, the
    # largest step inside it. A later call may continue with larger steps.
    for k in range(order.size):
        edge, step = order[k], steps[k]
        root = edge // 2
        other_root = root + 1 if edge % 2 == 0 else root + columns
        root, other_root = root_of(parent, root), root_of(parent, other_root)
        if root == other_root:
            continue
        if (
            step <= within[root] + scale / size[root]
            and step <= within[other_root] + scale / size[other_root]
        ):
            low, high = min(root, other_root), max(root, other_root)
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
            is_inside = root_of(parent, pixel - 1) == root and root_of(parent, pixel + 1) == root
            is_inside = is_inside and root_of(parent, pixel - columns) == root
            if is_inside and root_of(parent, pixel + columns) == root:
                core[root] += 1


@kernel
def mark_large(parent: Array, size: Array, columns: Any, min_size: Any, min_core: Any, large: Array) -> None:
    # Write, at the root of every segment, whether it has enough pixels and core pixels, see `absorb`.
    core = np.zeros(parent.size, np.int32)
    count_cores(parent, columns, core)
    for pixel in range(parent.size):
        large[pixel] = parent[pixel] == pixel and size[pixel] >= min_size and core[pixel] >= min_core


@kernel
def absorb(order: Array, columns: Any, large: Array, parent: Array, size: Array) -> None:
    # Join every segment that is not ``large`` (pixel,), at its root, to a neighbour, by ascending steps.
    #
    # A later call may continue with larger steps.
    for edge in order:
        root = edge // 2
        other_root = root + 1 if edge % 2 == 0 else root + columns
        root, other_root = root_of(parent, root), root_of(parent, other_root)
        if root == other_root or (large[root] and large[other_root]):
            continue
        low, high = min(root, other_root), max(root, other_root)
        parent[high] = low
        size[low] += size[high]
        large[low] = large[low] or large[high]


@kernel
def number_segments(parent: Array, valid: Array, number: Array) -> Any:
    # Write the segment of every pixel, numbered by first pixel; return the number of segments.
    #
    # Pixels that are not ``valid`` get -1.
    count = 0
    numbers = np.full(parent.size, -1, np.int32)
    for pixel in range(parent.size):
        root = root_of(parent, pixel)
        if not valid[pixel]:
            number[pixel] = -1
            continue
        if numbers[root] < 0:
            numbers[root] = count
            count += 1
        number[pixel] = numbers[root]
    return count


@kernel
def count_pixels(number: Array, chosen: Array, counts: Array) -> None:
    # Count the pixels of every segment (2, segment): row 0 those not chosen, row 1 the chosen ones.
    for line in range(number.shape[0]):
        for x in range(number.shape[1]):
            if number[line, x] >= 0:
                counts[1 if chosen[line, x] else 0, number[line, x]] += 1


@kernel
def sample_places(
    number: Array, chosen: Array, wanted: Array, step: Array, start: Array, counts: Array, out: Array
) -> None:
    # Write the places (line by line) of every ``step``-th pixel of each segment.
    #
    # Only pixels whose ``chosen`` equals the segment's ``wanted`` are sampled. ``start`` (segment,) is the
    # place in ``out`` of a segment's first sample; ``counts`` (segment,) starts at 0.
    columns = number.shape[1]
    for line in range(number.shape[0]):
        for x in range(columns):
            segment = number[line, x]
            if segment >= 0 and chosen[line, x] == wanted[segment]:
                if counts[segment] % step[segment] == 0:
                    out[start[segment] + counts[segment] // step[segment]] = line * columns + x
                counts[segment] += 1


@kernel
def to_pixels(parent: Array, root_values: Array, pixel_values: Array) -> None:
    # Write to every pixel the value at the root of its segment.
    for pixel in range(parent.size):
        pixel_values[pixel] = root_values[root_of(parent, pixel)]


@kernel
def boundary_distance(body: Array, reliable: Array, max_distance: Any, distance: Array) -> None:
    # Write the distance of every pixel (in steps to eight neighbours) from a mixed or unknown pixel.
    #
    # ``body`` (line, column) is the body a pixel shows, -1 where unknown. The ``distance`` is 0 in a mixed
    # pixel, 1 beside another body, and so on up to ``max_distance`` (<= 255). A pixel that is not
    # ``reliable``, because its body was taken from its neighbours, has 0 where another body is within 2
    # pixels.
    lines, columns = body.shape
    for line in range(lines):
        for x in range(columns):
            nearest = max_distance
            radius = 1 if reliable[line, x] else 2
            for dy in range(-radius, radius + 1):
                for dx in range(-radius, radius + 1):
                    y, z = line + dy, x + dx
                    if 0 <= y < lines and 0 <= z < columns and body[y, z] != body[line, x]:
                        nearest = 1 if reliable[line, x] else 0
            distance[line, x] = 0 if body[line, x] < 0 else nearest
    for sweep in range(2):
        for i in range(lines):
            line = i if sweep == 0 else lines - 1 - i
            for j in range(columns):
                x = j if sweep == 0 else columns - 1 - j
                step = -1 if sweep == 0 else 1
                best = np.int64(distance[line, x])
                for dy, dx in ((step, -1), (step, 0), (step, 1), (0, step)):
                    y, z = line + dy, x + dx
                    if 0 <= y < lines and 0 <= z < columns:
                        best = min(best, np.int64(distance[y, z]) + 1)
                distance[line, x] = best


@kernel
def squared_depth(mask: Array, squared: Array) -> None:
    # Write the squared distance [pixel] of every pixel of a mask from the nearest pixel outside it.
    #
    # The bits of scipy's distance transform in a fifth of its time: distances along the columns, then along
    # every line the lower envelope of the parabolas that rise from them (P. F. Felzenszwalb and
    # D. P. Huttenlocher, Theory of Computing 8, 415, 2012, doi:10.4086/toc.2012.v008a019).
    lines, columns = mask.shape
    far = lines + columns  # no pixel is so far away
    for sweep in range(2):
        for i in range(lines):
            line = i if sweep == 0 else lines - 1 - i
            for x in range(columns):
                gap = far if i == 0 else squared[line - 1 if sweep == 0 else line + 1, x] + 1
                squared[line, x] = min(gap, (far if mask[line, x] else 0) if sweep == 0 else squared[line, x])
    # the parabolas of the envelope: the place of their lowest point, their value at 0, where they begin
    places, values, starts = np.empty(columns, np.int64), np.empty(columns, np.int64), np.empty(columns)
    for line in range(lines):
        last = -1
        for x in range(columns):
            value, start = squared[line, x] ** 2 + x * x, -np.inf
            while last >= 0:
                start = (value - values[last]) / (2.0 * (x - places[last]))
                if start > starts[last]:
                    break
                last, start = last - 1, -np.inf
            last += 1
            places[last], values[last], starts[last] = x, value, start
        parabola = 0
        for x in range(columns):
            while parabola < last and starts[parabola + 1] < x:
                parabola += 1
            squared[line, x] = values[parabola] - 2 * x * places[parabola] + x * x


@kernel
def offer(label: Any, squared: Any, labels: Array, distances: Array) -> None:
    # Insert a source into a short list of the nearest sources, which holds every label at most once.
    count = labels.size
    for slot in range(count):
        if labels[slot] == label:
            if squared >= distances[slot]:
                return
            for k in range(slot, count - 1):
                labels[k], distances[k] = labels[k + 1], distances[k + 1]
            labels[count - 1], distances[count - 1] = -1, np.inf
            break
    for slot in range(count):
        if squared < distances[slot]:
            for k in range(count - 1, slot, -1):
                labels[k], distances[k] = labels[k - 1], distances[k - 1]
            labels[slot], distances[slot] = label, squared
            return


@kernel
def nearest_sources(labels: Array, distances: Array, reach: Any) -> None:
    # Spread labels from labelled cells to all cells within reach, keeping the nearest ones.
    #
    # ``labels`` (line, column, place) hold a cell's label at the first place, -1 without one, and receive the
    # nearest labels; ``distances`` hold 0 at a label, else infinity, and receive their distances [cell];
    # labels spread no farther than ``reach`` [cell].
    lines, columns, slots = labels.shape
    for _ in range(2):
        for sweep in range(2):
            step_back = -1 if sweep == 0 else 1
            for i in range(lines):
                line = i if sweep == 0 else lines - 1 - i
                for j in range(columns):
                    x = j if sweep == 0 else columns - 1 - j
                    for dy, dx in ((step_back, -1), (step_back, 0), (step_back, 1), (0, step_back)):
                        y, z = line + dy, x + dx
                        if 0 <= y < lines and 0 <= z < columns:
                            step = np.sqrt(float(dy * dy + dx * dx))
                            for slot in range(slots):
                                distance = distances[y, z, slot] + step
                                if labels[y, z, slot] >= 0 and distance <= reach:
                                    offer(labels[y, z, slot], distance, labels[line, x], distances[line, x])
