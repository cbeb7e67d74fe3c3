"""Triangles in a hierarchy of boxes, and their intersection with rays.

A node holds the boxes of its two children. Triangles are stored in the order of the leaves, so that a leaf
is a run of them.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Array
from hyperpaint.base.jit import borrowing_kernel

from .vectors import Vector

_BINS = 16
_MAX_LEAF_TRIANGLES = 4
_TRAVERSAL = 1.5  # cost of a node, in tests of a triangle
_MAX_LEVELS_BY_COST = 56  # below it a run is halved by count: at most 31 levels more
_WHOLE, _SWEPT, _CENTRES = 3 * _BINS, 3 * _BINS + 1, 3 * _BINS + 2  # boxes behind those of the bins


class _Room(NamedTuple):
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
    # Surface area heuristic: half the area of the box; flat boxes get a little more.
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
    # 0 if all centres coincide.
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
    # Lowest cost, its axis, and the first bin on its high side; infinite if there is no split.
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
    # Triangles of low bins move to the front; the result is where the others begin.
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
def _push(room: _Room, size: int, start: int, stop: int, level: int, child: int) -> int:
    room.waiting[size, 0], room.waiting[size, 1] = start, stop
    room.waiting[size, 2], room.waiting[size, 3] = level, child
    return size + 1


@borrowing_kernel
def _split_runs(boxes: Array, order: Array, nodes: Array, links: Array, room: _Room) -> int:
    # Also sorts ``order`` by leaf; the result is the number of nodes.
    used = 1
    size = _push(room, 0, 0, order.size, 0, 0) if order.size > 0 else 0
    while size > 0:
        size -= 1
        start, stop = room.waiting[size, 0], room.waiting[size, 1]
        level, child = room.waiting[size, 2], room.waiting[size, 3]
        count = stop - start
        _enclose(boxes, order, start, stop, room)
        for k in range(6):
            nodes[child, k] = room.boxes[_WHOLE, k]
        cost, axis, first_high = np.inf, 0, 0
        if count > 1 and level < _MAX_LEVELS_BY_COST:
            _fill_bins(boxes, order, start, stop, room)
            cost, axis, first_high = _best_split(count, room)
        own = _measure(room.boxes, _WHOLE, 0.0)
        if count <= _MAX_LEAF_TRIANGLES and count * own <= cost + _TRAVERSAL * own:
            links[child] = -(16 * start + count) - 1
            continue
        cut = (start + stop) // 2
        if cost < np.inf:
            cut = _partition(boxes, order, start, stop, axis, first_high, room)
        links[child] = used
        size = _push(room, size, start, cut, level + 1, 2 * used)
        size = _push(room, size, cut, stop, level + 1, 2 * used + 1)
        used += 1
    return used


#: Length of the stack of a traversal; `building` keeps every branch shorter.
STACK = 96

#: Coordinates beyond this [m] are refused: products of lengths must not overflow.
_MAX_COORDINATE_M = 1e9

_0, _1, _2, _3 = np.uint64(0), np.uint64(1), np.uint64(2), np.uint64(3)
_4, _5, _6, _9, _12 = np.uint64(4), np.uint64(5), np.uint64(6), np.uint64(9), np.uint64(12)
_FAR = 1e300
_ROUND_UP = 1.0 + 8e-16  # more than six roundings: T. Ize, "Robust BVH ray traversal", JCGT 2 (2013)


class Geometry(NamedTuple):
    """Triangles, sorted for rays; lengths [m]. Made by `build_geometry`.

    Attributes
    ----------
    nodes : (node * 12,) float64
        Of either child: lowest and highest x, y and z.
    links : (node * 2,) int64
        Number of a child's node; of a leaf -(16 first + count) - 1.
    triangles : (face * 9,) float64
        Three corners.
    face_normal : (face * 3,) float64
        Unit normals.
    corner_normals : (face * 9,) float64
        Unit normals at the corners; zero where a face is flat.
    face_material, face_instance : (face,) int32
        Labels.
    face_number : (face,) int64
        Place of a face in what was given.
    """

    nodes: Array
    links: Array
    triangles: Array
    face_normal: Array
    corner_normals: Array
    face_material: Array
    face_instance: Array
    face_number: Array


def build_geometry(
    vertices: npt.ArrayLike,
    faces: npt.ArrayLike,
    normals: npt.ArrayLike,
    face_material: npt.ArrayLike,
    face_instance: npt.ArrayLike,
) -> Geometry:
    """Sort triangles into a hierarchy of boxes.

    Parameters
    ----------
    vertices
        Shape (vertex, 3) [m].
    faces
        Corners of every triangle, shape (face, 3), integers. Triangles without area are left out.
    normals
        Normals at the vertices for smooth shading, shape (vertex, 3), or empty. A triangle one of whose
        corners has a zero normal is flat.
    face_material, face_instance
        Labels, shape (face,), integers.

    Raises
    ------
    ValueError
        For shapes that do not fit, numbers of corners outside the vertices, and coordinates that are not
        finite or beyond 1e9 m.

    Examples
    --------
    >>> corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    >>> build_geometry(corners, [[0, 1, 2]], [], [0], [0]).face_normal
    array([0., 0., 1.])
    """
    points = np.asarray(vertices, np.float64).reshape(-1, 3)
    corners = np.asarray(faces, np.int64).reshape(-1, 3)
    shading = np.asarray(normals, np.float64).reshape(-1, 3)
    material = np.asarray(face_material, np.int32)
    instance = np.asarray(face_instance, np.int32)
    if material.shape != (len(corners),) or instance.shape != (len(corners),):
        raise ValueError(f"{len(corners)} faces, materials {material.shape} and instances {instance.shape}")
    if len(shading) not in (0, len(points)):
        raise ValueError(f"{len(shading)} normals for {len(points)} vertices")
    if len(corners) and not (corners.min() >= 0 and corners.max() < len(points)):
        raise ValueError(f"faces number corners {corners.min()} to {corners.max()} of {len(points)} vertices")
    if not (np.abs(points) <= _MAX_COORDINATE_M).all():
        raise ValueError(f"vertices must be finite and within {_MAX_COORDINATE_M:g} m")

    triangles = points[corners]
    across = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    area = np.sqrt((across**2).sum(axis=1))
    with_area = np.flatnonzero(area > 0)
    nodes, links, order = build_nodes(np.ascontiguousarray(triangles[with_area]))
    order = with_area[order]
    at_corners = np.zeros((len(order), 3, 3))
    if len(shading):
        at_corners = shading[corners[order]]
        length = np.sqrt((at_corners**2).sum(axis=2, keepdims=True))
        smooth = (length > 0).all(axis=1, keepdims=True)
        at_corners = np.where(smooth, at_corners / np.where(length > 0, length, 1.0), 0.0)
    return Geometry(
        nodes,
        links,
        np.ascontiguousarray(triangles[order]).ravel(),
        np.ascontiguousarray(across[order] / area[order, None]).ravel(),
        np.ascontiguousarray(at_corners).ravel(),
        material[order],
        instance[order],
        order,
    )


# As the tests of boxes and triangles need it.
class _Ray(NamedTuple):
    sides: tuple[Any, Any, Any]  # of a box that it enters by, for each axis: 0 the lowest, 1 the highest
    origin: Vector
    inverse: Vector  # of the direction
    axes: tuple[Any, Any, Any]  # of its own frame: the last is the one it runs along most
    begin: Vector  # the origin in that frame
    shear: Vector  # what turns the direction into the last axis


@borrowing_kernel
def _enter(nodes: Array, at: Any, ray: _Ray, limit: float) -> float:
    # Distance at which a ray enters a box, from 0 on; `_FAR` for a miss before ``limit``.
    (nx, ny, nz), (ox, oy, oz), (ix, iy, iz) = ray.sides, ray.origin, ray.inverse
    near = (nodes[at + nx] - ox) * ix
    far = (nodes[at + (nx ^ _1)] - ox) * ix
    low = (nodes[at + _2 + ny] - oy) * iy
    high = (nodes[at + _2 + (ny ^ _1)] - oy) * iy
    near = low if low > near else near
    far = high if high < far else far
    low = (nodes[at + _4 + nz] - oz) * iz
    high = (nodes[at + _4 + (nz ^ _1)] - oz) * iz
    near = low if low > near else near
    far = high if high < far else far
    near = near if near > 0.0 else 0.0
    far = far * _ROUND_UP
    far = far if far < limit else limit
    return near if near <= far else _FAR


@borrowing_kernel
def _inverse(x: float) -> float:
    # Large but finite near zero.
    return 1.0 / x if abs(x) > 1e-150 else 1e150


@borrowing_kernel
def _axes(dx: float, dy: float, dz: float) -> tuple[Any, Any, Any]:
    # Axes of a ray's own frame: the last is the dominant one.
    ax, ay, az = abs(dx), abs(dy), abs(dz)
    if ax >= ay and ax >= az:
        return _1, _2, _0
    if ay >= az:
        return _2, _0, _1
    return _0, _1, _2


@borrowing_kernel
def _component(axis: Any, x: float, y: float, z: float) -> float:
    if axis == _0:
        return x
    return y if axis == _1 else z


@borrowing_kernel
def _meet(triangles: Array, face: Any, ray: _Ray) -> tuple[float, float, float, float]:
    # Distance to a triangle and the hit's weights of the corners; -1 for a miss.
    # S. Woop, C. Benthin, I. Wald, "Watertight ray/triangle intersection", JCGT 2 (2013). The function of an
    # edge has exactly opposite values for the two triangles that share it; zero belongs to both.
    (kx, ky, kz), (ox, oy, oz), (sx, sy, sz) = ray.axes, ray.begin, ray.shear
    at = face * _9
    az = triangles[at + kz] - oz
    ax = triangles[at + kx] - ox - sx * az
    ay = triangles[at + ky] - oy - sy * az
    at += _3
    bz = triangles[at + kz] - oz
    bx = triangles[at + kx] - ox - sx * bz
    by = triangles[at + ky] - oy - sy * bz
    at += _3
    cz = triangles[at + kz] - oz
    cx = triangles[at + kx] - ox - sx * cz
    cy = triangles[at + ky] - oy - sy * cz
    u = cx * by - cy * bx
    v = ax * cy - ay * cx
    w = bx * ay - by * ax
    if (u < 0.0 or v < 0.0 or w < 0.0) and (u > 0.0 or v > 0.0 or w > 0.0):
        return -1.0, 0.0, 0.0, 0.0
    total = u + v + w
    if total == 0.0:
        return -1.0, 0.0, 0.0, 0.0
    inverse = 1.0 / total
    return (u * az + v * bz + w * cz) * sz * inverse, u * inverse, v * inverse, w * inverse


@borrowing_kernel
def _ray_of(origin: Vector, direction: Vector) -> _Ray:
    ox, oy, oz = origin
    dx, dy, dz = direction
    ix, iy, iz = _inverse(dx), _inverse(dy), _inverse(dz)
    nx, ny, nz = _0 if ix > 0.0 else _1, _0 if iy > 0.0 else _1, _0 if iz > 0.0 else _1
    kx, ky, kz = _axes(dx, dy, dz)
    sz = 1.0 / _component(kz, dx, dy, dz)
    sx, sy = _component(kx, dx, dy, dz) * sz, _component(ky, dx, dy, dz) * sz
    px, py, pz = _component(kx, ox, oy, oz), _component(ky, ox, oy, oz), _component(kz, ox, oy, oz)
    return _Ray((nx, ny, nz), (ox, oy, oz), (ix, iy, iz), (kx, ky, kz), (px, py, pz), (sx, sy, sz))


@borrowing_kernel
def closest(
    geometry: Geometry, stack: Array, entries: Array, origin: Vector, direction: Vector, limit: float
) -> tuple[float, int, Vector]:
    """Return the first triangle that a ray hits.

    Parameters
    ----------
    geometry
        Triangles.
    stack, entries
        Room for `STACK` nodes: int64 and float64.
    origin, direction
        Where the ray begins [m], and its direction; of any length.
    limit
        Largest distance, in units of that length.

    Returns
    -------
    distance, face, weights
        The face is -1 where nothing is met; else the hit is the sum of its corners with these weights.
    """
    nodes, links, triangles = geometry.nodes, geometry.links, geometry.triangles
    ray = _ray_of(origin, direction)
    best, nearest, weights = limit, -1, (0.0, 0.0, 0.0)
    size = 0
    link = 0
    while True:
        if link >= 0:
            at = np.uint64(link) * _12
            first = _enter(nodes, at, ray, best)
            second = _enter(nodes, at + _6, ray, best)
            child = np.uint64(link) * _2
            if first < _FAR or second < _FAR:
                link, other = links[child], links[child + _1]
                if second < first:
                    first, second = second, first
                    link, other = other, link
                if second < _FAR:
                    stack[size] = other
                    entries[size] = second
                    size += 1
                continue
        else:
            packed = -(link + 1)
            for face in range(packed >> 4, (packed >> 4) + (packed & 15)):
                t, a, b, c = _meet(triangles, np.uint64(face), ray)
                if 0.0 < t < best:
                    best, nearest, weights = t, face, (a, b, c)
        while size > 0 and entries[size - 1] >= best:
            size -= 1
        if size == 0:
            return best, nearest, weights
        size -= 1
        link = stack[size]


@borrowing_kernel
def occluded(geometry: Geometry, stack: Array, origin: Vector, direction: Vector, limit: float) -> bool:
    # Whether a ray hits any triangle; parameters as for `closest`.
    nodes, links, triangles = geometry.nodes, geometry.links, geometry.triangles
    ray = _ray_of(origin, direction)
    size = 0
    link = 0
    while True:
        if link >= 0:
            at = np.uint64(link) * _12
            first = _enter(nodes, at, ray, limit)
            second = _enter(nodes, at + _6, ray, limit)
            child = np.uint64(link) * _2
            if first < _FAR:
                if second < _FAR:
                    stack[size] = links[child + _1]
                    size += 1
                link = links[child]
                continue
            if second < _FAR:
                link = links[child + _1]
                continue
        else:
            packed = -(link + 1)
            for face in range(packed >> 4, (packed >> 4) + (packed & 15)):
                t, _, _, _ = _meet(triangles, np.uint64(face), ray)
                if 0.0 < t < limit:
                    return True
        if size == 0:
            return False
        size -= 1
        link = stack[size]
