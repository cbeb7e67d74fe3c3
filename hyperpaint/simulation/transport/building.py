"""Building the hierarchy of boxes over triangles."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from hyperpaint.base.arrays import Array
from hyperpaint.base.jit import borrowing_kernel

_BINS = 16
_LARGEST_LEAF = 4
_TRAVERSAL = 1.5  # cost of a node, in tests of a triangle
_DEEPEST_BY_COST = 56  # below it a run is halved by count: at most 31 levels more
_WHOLE, _SWEPT, _CENTRES = 3 * _BINS, 3 * _BINS + 1, 3 * _BINS + 2  # boxes behind those of the bins


class _Room(NamedTuple):
    """Memory of a build."""

    boxes: Array  # (3 bins + 3, 6): of the bins of the three axes, and three more
    counts: Array  # (3 bins,) triangles in the bins
    costs: Array  # (bins,) of all bins from one on
    waiting: Array  # (256, 4) runs not split yet: start, stop, level, child


def build_nodes(triangles: Array) -> tuple[Array, Array, Array]:
    """Return nodes, links (see `Geometry`) and the order of the triangles (face, 3, 3) in the leaves.

    Runs are split where the expected cost of a ray is lowest (surface area heuristic over bins: I. Wald, "On
    fast construction of SAH-based bounding volume hierarchies", IEEE RT 2007).
    """
    count = len(triangles)
    boxes = np.empty((count, 6))
    boxes[:, :3] = triangles.min(axis=1)
    boxes[:, 3:] = triangles.max(axis=1)
    # more than the roundings of a test, so that no ray passes between a triangle and its box
    margin = 1e-12 * (1.0 + float(np.abs(boxes).max(initial=0.0)))
    boxes[:, :3] -= margin
    boxes[:, 3:] += margin
    order = np.arange(count)
    nodes = np.empty((2 * max(count, 1), 6))
    nodes[:2] = [np.inf, np.inf, np.inf, -np.inf, -np.inf, -np.inf]
    links = np.empty(2 * max(count, 1), np.int64)
    links[:2] = -1  # leaves without triangles
    room = _Room(
        np.empty((3 * _BINS + 3, 6)),
        np.empty(3 * _BINS, np.int64),
        np.empty(_BINS),
        np.empty((256, 4), np.int64),
    )
    used = 2 * _split_runs(boxes, order, nodes, links, room)
    # lowest and highest side by side, as rays take them
    return nodes[:used, [0, 3, 1, 4, 2, 5]].ravel(), links[:used].copy(), order


@borrowing_kernel
def _clear(boxes: Array, at: int) -> None:
    for k in range(3):
        boxes[at, k] = np.inf
        boxes[at, k + 3] = -np.inf


@borrowing_kernel
def _widen(boxes: Array, at: int, others: Array, other: int) -> None:
    for k in range(3):
        boxes[at, k] = min(boxes[at, k], others[other, k])
        boxes[at, k + 3] = max(boxes[at, k + 3], others[other, k + 3])


@borrowing_kernel
def _measure(boxes: Array, at: int, floor: float) -> Any:
    """Return the surface area heuristic's measure of a box: half its area; flat boxes get a little more."""
    dx = boxes[at, 3] - boxes[at, 0]
    dy = boxes[at, 4] - boxes[at, 1]
    dz = boxes[at, 5] - boxes[at, 2]
    return dx * dy + dy * dz + dz * dx + floor * (dx + dy + dz)


@borrowing_kernel
def _bin(boxes: Array, at: int, axis: int, low: float, per_length: float) -> int:
    place = int((0.5 * (boxes[at, axis] + boxes[at, axis + 3]) - low) * per_length)
    return min(max(place, 0), _BINS - 1)


@borrowing_kernel
def _bins_per_length(room: _Room, axis: int) -> float:
    """Return bins per length; 0 if all centres coincide."""
    extent = room.boxes[_CENTRES, axis + 3] - room.boxes[_CENTRES, axis]
    return _BINS / extent if extent > 1e-200 else 0.0


@borrowing_kernel
def _fill_bins(boxes: Array, order: Array, start: int, stop: int, room: _Room) -> None:
    for at in range(3 * _BINS):
        _clear(room.boxes, at)
        room.counts[at] = 0
    for axis in range(3):
        low, per_length = room.boxes[_CENTRES, axis], _bins_per_length(room, axis)
        for i in range(start, stop):
            at = axis * _BINS + _bin(boxes, order[i], axis, low, per_length)
            room.counts[at] += 1
            _widen(room.boxes, at, boxes, order[i])


@borrowing_kernel
def _best_split(count: int, room: _Room) -> tuple[float, int, int]:
    """Return the lowest cost of a split, its axis, and the first bin on its high side; infinite if none."""
    cost, best_axis, best_bin = np.inf, 0, 0
    floor = 0.0
    for axis in range(3):
        floor = max(floor, 1e-6 * (room.boxes[_CENTRES, axis + 3] - room.boxes[_CENTRES, axis]))
    for axis in range(3):
        first = axis * _BINS
        _clear(room.boxes, _SWEPT)
        total = 0
        for at in range(_BINS - 1, 0, -1):
            total += room.counts[first + at]
            _widen(room.boxes, _SWEPT, room.boxes, first + at)
            room.costs[at] = total * _measure(room.boxes, _SWEPT, floor) if total > 0 else np.inf
        _clear(room.boxes, _SWEPT)
        total = 0
        for at in range(1, _BINS):
            total += room.counts[first + at - 1]
            _widen(room.boxes, _SWEPT, room.boxes, first + at - 1)
            if 0 < total < count:
                split_cost = total * _measure(room.boxes, _SWEPT, floor) + room.costs[at]
                if split_cost < cost:
                    cost, best_axis, best_bin = split_cost, axis, at
    return cost, best_axis, best_bin


@borrowing_kernel
def _enclose(boxes: Array, order: Array, start: int, stop: int, room: _Room) -> None:
    """Compute the box of a run and the box of its centres."""
    _clear(room.boxes, _WHOLE)
    _clear(room.boxes, _CENTRES)
    for i in range(start, stop):
        _widen(room.boxes, _WHOLE, boxes, order[i])
        for k in range(3):
            centre = 0.5 * (boxes[order[i], k] + boxes[order[i], k + 3])
            room.boxes[_CENTRES, k] = min(room.boxes[_CENTRES, k], centre)
            room.boxes[_CENTRES, k + 3] = max(room.boxes[_CENTRES, k + 3], centre)


@borrowing_kernel
def _partition(
    boxes: Array, order: Array, start: int, stop: int, axis: int, first_high: int, room: _Room
) -> int:
    """Move a run's triangles of low bins to its front; return where the others begin."""
    low, per_length = room.boxes[_CENTRES, axis], _bins_per_length(room, axis)
    last = stop - 1
    while start <= last:
        if _bin(boxes, order[start], axis, low, per_length) < first_high:
            start += 1
        else:
            order[start], order[last] = order[last], order[start]
            last -= 1
    return start


@borrowing_kernel
def _await(room: _Room, size: int, start: int, stop: int, level: int, child: int) -> int:
    """Push a run on the stack; return the stack's new size."""
    room.waiting[size, 0], room.waiting[size, 1] = start, stop
    room.waiting[size, 2], room.waiting[size, 3] = level, child
    return size + 1


@borrowing_kernel
def _split_runs(boxes: Array, order: Array, nodes: Array, links: Array, room: _Room) -> int:
    """Write nodes and links, sort ``order`` by leaf, and return the number of nodes."""
    used = 1
    size = _await(room, 0, 0, order.size, 0, 0) if order.size > 0 else 0
    while size > 0:
        size -= 1
        start, stop = room.waiting[size, 0], room.waiting[size, 1]
        level, child = room.waiting[size, 2], room.waiting[size, 3]
        count = stop - start
        _enclose(boxes, order, start, stop, room)
        for k in range(6):
            nodes[child, k] = room.boxes[_WHOLE, k]
        cost, axis, first_high = np.inf, 0, 0
        if count > 1 and level < _DEEPEST_BY_COST:
            _fill_bins(boxes, order, start, stop, room)
            cost, axis, first_high = _best_split(count, room)
        own = _measure(room.boxes, _WHOLE, 0.0)
        if count <= _LARGEST_LEAF and count * own <= cost + _TRAVERSAL * own:
            links[child] = -(16 * start + count) - 1
            continue
        cut = (start + stop) // 2
        if cost < np.inf:
            cut = _partition(boxes, order, start, stop, axis, first_high, room)
        links[child] = used
        size = _await(room, size, start, cut, level + 1, 2 * used)
        size = _await(room, size, cut, stop, level + 1, 2 * used + 1)
        used += 1
    return used
