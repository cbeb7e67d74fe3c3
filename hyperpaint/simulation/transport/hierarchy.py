"""Triangles in a hierarchy of boxes: rays, their nearest triangles, and the hits from which paths continue.

Vectors are tuples of three numbers, which the compiler keeps in registers. A node holds the boxes of its two
children. Triangles are stored in the order of the leaves, so that the triangles of a leaf are contiguous.
"""

import math
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from hyperpaint.base import Array
from hyperpaint.base.jit import borrowing_kernel

Vector: TypeAlias = tuple[float, float, float]
Frame: TypeAlias = tuple[Vector, Vector, Vector]


@borrowing_kernel
def dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@borrowing_kernel
def along(origin: Vector, direction: Vector, distance: float) -> Vector:
    return (
        origin[0] + distance * direction[0],
        origin[1] + distance * direction[1],
        origin[2] + distance * direction[2],
    )


@borrowing_kernel
def unit(a: Vector) -> Vector:
    scale = 1.0 / math.sqrt(dot(a, a))
    return scale * a[0], scale * a[1], scale * a[2]


@borrowing_kernel
def frame_of(z: Vector) -> Frame:
    # three orthonormal vectors, the last one given.
    # T. Duff et al., "Building an orthonormal basis, revisited", JCGT 6 (2017).
    sign = math.copysign(1.0, z[2])
    a = -1.0 / (sign + z[2])
    b = z[0] * z[1] * a
    return ((1.0 + sign * z[0] * z[0] * a, sign * b, -sign * z[0]), (b, sign + z[1] * z[1] * a, -z[1]), z)


@borrowing_kernel
def in_frame(frame: Frame, a: Vector) -> Vector:
    return dot(frame[0], a), dot(frame[1], a), dot(frame[2], a)


@borrowing_kernel
def from_frame(frame: Frame, a: Vector) -> Vector:
    # Vector with these components along the axes of a frame.
    x, y, z = frame
    return (
        a[0] * x[0] + a[1] * y[0] + a[2] * z[0],
        a[0] * x[1] + a[1] * y[1] + a[2] * z[1],
        a[0] * x[2] + a[1] * y[2] + a[2] * z[2],
    )


_BINS = 16
_MAX_LEAF_TRIANGLES = 4
_NODE_COST = 1.5  # cost of visiting a node relative to a test of a triangle
_MAX_LEVELS_BY_COST = 56  # below this level runs are halved by count, which adds at most 31 levels
# boxes after those of the bins: of all triangles, of the bins swept so far, of the centres of triangles
_TOTAL, _SWEPT, _CENTRES = 3 * _BINS, 3 * _BINS + 1, 3 * _BINS + 2


class _Workspace(NamedTuple):
    boxes: Array  # (3 bins + 3, 6): boxes of the bins of the three axes, and three further boxes
    counts: Array  # (3 bins,) number of triangles in a bin
    costs: Array  # (bins,) cost of this bin and all higher bins
    waiting: Array  # (256, 4) runs to be split: start, stop, level, child


@borrowing_kernel
def _clear(boxes: Array, index: int) -> None:
    for k in range(3):
        boxes[index, k] = np.inf
        boxes[index, k + 3] = -np.inf


@borrowing_kernel
def _widen(boxes: Array, index: int, other_boxes: Array, other_index: int) -> None:
    for k in range(3):
        boxes[index, k] = min(boxes[index, k], other_boxes[other_index, k])
        boxes[index, k + 3] = max(boxes[index, k + 3], other_boxes[other_index, k + 3])


@borrowing_kernel
def _half_area(boxes: Array, index: int, floor: float) -> Any:
    # half the area of a box for the surface area heuristic; ``floor`` adds to flat boxes
    dx = boxes[index, 3] - boxes[index, 0]
    dy = boxes[index, 4] - boxes[index, 1]
    dz = boxes[index, 5] - boxes[index, 2]
    return dx * dy + dy * dz + dz * dx + floor * (dx + dy + dz)


@borrowing_kernel
def _bin(boxes: Array, index: int, axis: int, axis_start: float, per_length: float) -> int:
    place = int((0.5 * (boxes[index, axis] + boxes[index, axis + 3]) - axis_start) * per_length)
    return min(max(place, 0), _BINS - 1)


@borrowing_kernel
def _bins_per_length(room: _Workspace, axis: int) -> float:
    # bins per metre along an axis; 0 if all centres coincide
    extent = room.boxes[_CENTRES, axis + 3] - room.boxes[_CENTRES, axis]
    return _BINS / extent if extent > 1e-200 else 0.0


@borrowing_kernel
def _best_split(
    boxes: Array, order: Array, start: int, stop: int, room: _Workspace
) -> tuple[float, int, int]:
    # lowest cost, with its axis and the first bin on its upper side; infinite cost if no split is possible
    for bin_number in range(3 * _BINS):
        _clear(room.boxes, bin_number)
        room.counts[bin_number] = 0
    floor = 0.0
    for axis in range(3):
        axis_start, per_length = room.boxes[_CENTRES, axis], _bins_per_length(room, axis)
        for i in range(start, stop):
            bin_number = axis * _BINS + _bin(boxes, order[i], axis, axis_start, per_length)
            room.counts[bin_number] += 1
            _widen(room.boxes, bin_number, boxes, order[i])
        floor = max(floor, 1e-6 * (room.boxes[_CENTRES, axis + 3] - room.boxes[_CENTRES, axis]))
    cost, best_axis, best_bin = np.inf, 0, 0
    for axis in range(3):
        first_bin = axis * _BINS
        _clear(room.boxes, _SWEPT)
        total = 0
        for bin_number in range(_BINS - 1, 0, -1):
            total += room.counts[first_bin + bin_number]
            _widen(room.boxes, _SWEPT, room.boxes, first_bin + bin_number)
            room.costs[bin_number] = total * _half_area(room.boxes, _SWEPT, floor) if total > 0 else np.inf
        _clear(room.boxes, _SWEPT)
        total = 0
        for bin_number in range(1, _BINS):
            total += room.counts[first_bin + bin_number - 1]
            _widen(room.boxes, _SWEPT, room.boxes, first_bin + bin_number - 1)
            if 0 < total < stop - start:
                split_cost = total * _half_area(room.boxes, _SWEPT, floor) + room.costs[bin_number]
                if split_cost < cost:
                    cost, best_axis, best_bin = split_cost, axis, bin_number
    return cost, best_axis, best_bin


@borrowing_kernel
def _push(waiting: Array, index: int, start: int, stop: int, level: int, child: int) -> None:
    # numba compiles the assignment of a tuple to a row slowly
    waiting[index, 0], waiting[index, 1] = start, stop
    waiting[index, 2], waiting[index, 3] = level, child


@borrowing_kernel
def _split_runs(boxes: Array, order: Array, nodes: Array, links: Array, room: _Workspace) -> int:
    # split runs into nodes and sort ``order`` by leaf; return the number of nodes
    node_count, size = 1, min(order.size, 1)
    _push(room.waiting, 0, 0, order.size, 0, 0)
    while size > 0:
        size -= 1
        start, stop = room.waiting[size, 0], room.waiting[size, 1]
        level, child = room.waiting[size, 2], room.waiting[size, 3]
        # the boxes of the run's triangles and of their centres
        _clear(room.boxes, _TOTAL)
        _clear(room.boxes, _CENTRES)
        for i in range(start, stop):
            _widen(room.boxes, _TOTAL, boxes, order[i])
            for k in range(3):
                centre = 0.5 * (boxes[order[i], k] + boxes[order[i], k + 3])
                room.boxes[_CENTRES, k] = min(room.boxes[_CENTRES, k], centre)
                room.boxes[_CENTRES, k + 3] = max(room.boxes[_CENTRES, k + 3], centre)
        for k in range(6):
            nodes[child, k] = room.boxes[_TOTAL, k]
        count, cost, axis, first_high = stop - start, np.inf, 0, 0
        if count > 1 and level < _MAX_LEVELS_BY_COST:
            cost, axis, first_high = _best_split(boxes, order, start, stop, room)
        area = _half_area(room.boxes, _TOTAL, 0.0)
        if count <= _MAX_LEAF_TRIANGLES and count * area <= cost + _NODE_COST * area:
            links[child] = -(16 * start + count) - 1
            continue
        middle = (start + stop) // 2
        if cost < np.inf:
            # move triangles of lower bins to the front
            axis_start, per_length = room.boxes[_CENTRES, axis], _bins_per_length(room, axis)
            middle, last = start, stop - 1
            while middle <= last:
                if _bin(boxes, order[middle], axis, axis_start, per_length) < first_high:
                    middle += 1
                else:
                    order[middle], order[last] = order[last], order[middle]
                    last -= 1
        links[child] = node_count
        _push(room.waiting, size, start, middle, level + 1, 2 * node_count)
        _push(room.waiting, size + 1, middle, stop, level + 1, 2 * node_count + 1)
        node_count, size = node_count + 1, size + 2
    return node_count


#: Length of the stack of a traversal; branches are shorter.
STACK = 96

#: Maximum coordinate [m], so that products of lengths do not overflow.
_MAX_COORDINATE_M = 1e9

_0, _1, _2, _3 = np.uint64(0), np.uint64(1), np.uint64(2), np.uint64(3)
_4, _5, _6, _9, _12 = np.uint64(4), np.uint64(5), np.uint64(6), np.uint64(9), np.uint64(12)
_MISS = 1e300  # distance for a ray that misses a box
_ROUND_UP = 1.0 + 8e-16  # more than six rounding errors: T. Ize, "Robust BVH ray traversal", JCGT 2 (2013)


# Triangles sorted for ray tracing, from `build_geometry`; lengths [m]
class Geometry(NamedTuple):
    nodes: Array  # (node * 12,) float64: boxes of both children: minimum and maximum of x, y and z
    # (node * 2,) int64: node of a child; for a leaf -(16 first + count) - 1, with its first triangle and
    # their number
    links: Array
    triangles: Array  # (face * 9,) float64: corners of the triangles
    face_normal: Array  # (face * 3,) float64: unit normals
    corner_normals: Array  # (face * 9,) float64: unit normals at the corners; zero where a face is flat
    # face_material, face_instance: (face,) int32: labels
    face_material: Array
    face_instance: Array


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
        Corners of every triangle, shape (face, 3), integers. Triangles without area are omitted.
    normals
        Normals at the vertices for smooth shading, shape (vertex, 3), or empty. A triangle with a zero normal
        at a corner is flat.
    face_material, face_instance
        Labels, shape (face,), integers.

    Raises
    ------
    ValueError
        For coordinates that are not finite or beyond 1e9 m.

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
    if not (np.abs(points) <= _MAX_COORDINATE_M).all():
        raise ValueError(f"vertices must be finite and within {_MAX_COORDINATE_M:g} m")
    triangles = points[corners]
    cross_products = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    area = np.sqrt((cross_products**2).sum(axis=1))
    has_area = np.flatnonzero(area > 0)
    # split runs of triangles where the expected cost of a ray is lowest (surface area heuristic over bins:
    # I. Wald, "On fast construction of SAH-based bounding volume hierarchies", IEEE RT 2007)
    count = len(has_area)
    boxes = np.concatenate([triangles[has_area].min(axis=1), triangles[has_area].max(axis=1)], axis=1)
    # widen boxes by more than the rounding error of a test, so that rays do not miss them
    margin = 1e-12 * (1.0 + float(np.abs(boxes).max(initial=0.0)))
    boxes += np.repeat([-margin, margin], 3)
    nodes, links = np.empty((2 * max(count, 1), 6)), np.full(2 * max(count, 1), -1)
    nodes[:2] = [np.inf, np.inf, np.inf, -np.inf, -np.inf, -np.inf]  # leaves without triangles
    room = _Workspace(
        np.empty((3 * _BINS + 3, 6)),
        np.empty(3 * _BINS, np.int64),
        np.empty(_BINS),
        np.empty((256, 4), np.int64),
    )
    order = np.arange(count)
    entry_count = 2 * _split_runs(boxes, order, nodes, links, room)
    order = has_area[order]
    corner_normals = np.zeros((len(order), 3, 3))
    if len(shading):
        corner_normals = shading[corners[order]]
        length = np.sqrt((corner_normals**2).sum(axis=2, keepdims=True))
        corner_normals = np.where(
            (length > 0).all(axis=1, keepdims=True), corner_normals / np.where(length > 0, length, 1.0), 0.0
        )
    return Geometry(
        # minimum and maximum of an axis are neighbours
        nodes[:entry_count, [0, 3, 1, 4, 2, 5]].ravel(),
        links[:entry_count].copy(),
        np.ascontiguousarray(triangles[order]).ravel(),
        np.ascontiguousarray(cross_products[order] / area[order, None]).ravel(),
        np.ascontiguousarray(corner_normals).ravel(),
        material[order],
        instance[order],
    )


# A ray, prepared for the tests of boxes and triangles.
class _Ray(NamedTuple):
    sides: tuple[Any, Any, Any]  # side of a box at which the ray enters, by axis: 0 minimum, 1 maximum
    origin: Vector
    inverse: Vector  # inverse of the direction
    axes: tuple[Any, Any, Any]  # axes of the ray's frame: the last is its dominant axis
    begin: Vector  # origin in the ray's frame
    shear: Vector  # shear that maps the direction to the last axis


@borrowing_kernel
def _enter(nodes: Array, offset: Any, ray: _Ray, limit: float) -> float:
    # distance at which a ray enters a box, at least 0; `_MISS` if it does not enter before ``limit``
    (nx, ny, nz), (ox, oy, oz), (ix, iy, iz) = ray.sides, ray.origin, ray.inverse
    near = (nodes[offset + nx] - ox) * ix
    far = (nodes[offset + (nx ^ _1)] - ox) * ix
    low = (nodes[offset + _2 + ny] - oy) * iy
    high = (nodes[offset + _2 + (ny ^ _1)] - oy) * iy
    near = low if low > near else near
    far = high if high < far else far
    low = (nodes[offset + _4 + nz] - oz) * iz
    high = (nodes[offset + _4 + (nz ^ _1)] - oz) * iz
    near = low if low > near else near
    far = high if high < far else far
    near = near if near > 0.0 else 0.0
    far = far * _ROUND_UP
    far = far if far < limit else limit
    return near if near <= far else _MISS


@borrowing_kernel
def _inverse(x: float) -> float:
    # inverse of a number, large but finite near 0
    return 1.0 / x if abs(x) > 1e-150 else 1e150


@borrowing_kernel
def _axes(dx: float, dy: float, dz: float) -> tuple[Any, Any, Any]:
    # axes of a ray's frame: the last is the dominant axis
    ax, ay, az = abs(dx), abs(dy), abs(dz)
    if ax >= ay and ax >= az:
        return _1, _2, _0
    return (_2, _0, _1) if ay >= az else (_0, _1, _2)


@borrowing_kernel
def _component(axis: Any, x: float, y: float, z: float) -> float:
    if axis == _0:
        return x
    return y if axis == _1 else z


@borrowing_kernel
def _intersect(triangles: Array, face: Any, ray: _Ray) -> tuple[float, float, float, float]:
    # distance to a triangle, and the barycentric weights of the hit; distance -1 for a miss
    # S. Woop, C. Benthin, I. Wald, "Watertight ray/triangle intersection", JCGT 2 (2013). Edge
    # functions have exactly opposite values in the two triangles that share an edge; 0 is a hit of both.
    (kx, ky, kz), (ox, oy, oz), (sx, sy, sz) = ray.axes, ray.begin, ray.shear
    offset = face * _9
    az = triangles[offset + kz] - oz
    ax = triangles[offset + kx] - ox - sx * az
    ay = triangles[offset + ky] - oy - sy * az
    offset += _3
    bz = triangles[offset + kz] - oz
    bx = triangles[offset + kx] - ox - sx * bz
    by = triangles[offset + ky] - oy - sy * bz
    offset += _3
    cz = triangles[offset + kz] - oz
    cx = triangles[offset + kx] - ox - sx * cz
    cy = triangles[offset + ky] - oy - sy * cz
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
def _prepared_ray(origin: Vector, direction: Vector) -> _Ray:
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
    # nearest triangle hit by a ray
    # geometry: triangles
    # stack, entries: memory for `STACK` nodes: int64 and float64
    # origin, direction: origin of the ray [m], and its direction of any length
    # limit: maximum distance, in units of this length
    # returns distance, face, weights: face -1 for a miss; otherwise the hit is the sum of the face's corners
    # with these weights
    return _traverse(geometry, stack, entries, _prepared_ray(origin, direction), limit, False)


@borrowing_kernel
def occluded(
    geometry: Geometry, stack: Array, entries: Array, origin: Vector, direction: Vector, limit: float
) -> bool:
    # whether a ray hits any triangle; parameters as for `closest`
    _, face, _ = _traverse(geometry, stack, entries, _prepared_ray(origin, direction), limit, True)
    return face >= 0


@borrowing_kernel
def _traverse(
    geometry: Geometry, stack: Array, entries: Array, ray: _Ray, limit: float, is_any: bool
) -> tuple[float, int, Vector]:
    # the nearest hit, or with ``is_any`` the first one that is found
    nodes, links, triangles = geometry.nodes, geometry.links, geometry.triangles
    distance, nearest_face, weights = limit, -1, (0.0, 0.0, 0.0)
    size = 0
    link = 0
    while True:
        if link >= 0:
            offset = np.uint64(link) * _12
            first_distance = _enter(nodes, offset, ray, distance)
            second_distance = _enter(nodes, offset + _6, ray, distance)
            child = np.uint64(link) * _2
            if first_distance < _MISS or second_distance < _MISS:
                link, other = links[child], links[child + _1]
                if second_distance < first_distance:
                    first_distance, second_distance = second_distance, first_distance
                    link, other = other, link
                if second_distance < _MISS:
                    stack[size] = other
                    entries[size] = second_distance
                    size += 1
                continue
        else:
            packed = -(link + 1)
            for face in range(packed >> 4, (packed >> 4) + (packed & 15)):
                t, a, b, c = _intersect(triangles, np.uint64(face), ray)
                if 0.0 < t < distance:
                    distance, nearest_face, weights = t, face, (a, b, c)
                    if is_any:
                        return distance, nearest_face, weights
        while size > 0 and entries[size - 1] >= distance:
            size -= 1
        if size == 0:
            return distance, nearest_face, weights
        size -= 1
        link = stack[size]


def _waves(count: int = 8) -> np.ndarray:
    # wave vectors [rad/m] and phases [rad], (wave, 4): all directions, lengths of 3 to 12 mm
    number = np.arange(count) + 0.5
    z, angle = 1.0 - number / count, np.pi * (1.0 + np.sqrt(5.0)) * number  # a spiral on a hemisphere
    horizontal = np.sqrt(1.0 - z**2)
    length = 3e-3 * 4.0 ** ((number * 0.6180339887498949) % 1.0)
    directions = np.stack([horizontal * np.cos(angle), horizontal * np.sin(angle), z], axis=1)
    phase = 2.0 * np.pi * ((number * 0.7548776662466927) % 1.0)
    return np.concatenate([2.0 * np.pi / length[:, None] * directions, phase[:, None]], axis=1)


#: Waves whose sum is the height of a coat.
WAVES = _waves()


@borrowing_kernel
def waved(normal: Vector, point: Vector, slope: float) -> Vector:
    # normal of a wavy surface
    # normal: normal of the surface without waves
    # point: position [m]; the waves are fixed in space, so that a position always has the same normal
    # slope: root mean square of the slope, over all directions of the normal [rad]
    gradient = (0.0, 0.0, 0.0)
    for k in range(WAVES.shape[0]):
        x, y, z, phase = WAVES[k, 0], WAVES[k, 1], WAVES[k, 2], WAVES[k, 3]
        rise = math.cos(x * point[0] + y * point[1] + z * point[2] + phase) / math.sqrt(x * x + y * y + z * z)
        gradient = along(gradient, (x, y, z), rise)
    # the mean of cos^2 is 1/2, the mean squared component of a wave vector along the surface is 2/3
    gradient = along((0.0, 0.0, 0.0), gradient, slope * math.sqrt(3.0 / WAVES.shape[0]))
    level = along(gradient, normal, -dot(gradient, normal))
    return unit((normal[0] - level[0], normal[1] - level[1], normal[2] - level[2]))


#: Minimum cosine of a direction that faces a surface.
FACING = 1e-9

_LIFT = 1e-9  # distance of lifted points, relative to the coordinates


class Hit(NamedTuple):
    point: Vector  # position, lifted off the surface
    face_normal: Vector  # normal of the triangle, on the side of the incoming path
    frame: Frame  # its last vector is the shading normal
    coat_frame: Frame  # frame with the waves of the coat
    raised: bool  # whether the point is on the curved surface that the triangle approximates


@borrowing_kernel
def _corner(array: Array, face: int, corner: int) -> Vector:
    index = 9 * face + 3 * corner
    return array[index], array[index + 1], array[index + 2]


@borrowing_kernel
def _interpolated(array: Array, face: int, weights: Vector) -> Vector:
    point = along((0.0, 0.0, 0.0), _corner(array, face, 0), weights[0])
    point = along(point, _corner(array, face, 1), weights[1])
    return along(point, _corner(array, face, 2), weights[2])


@borrowing_kernel
def _normals(geometry: Geometry, face: int, weights: Vector, direction: Vector) -> tuple[Vector, Vector]:
    # normal of the triangle and shading normal, both on the side of the incoming ray
    index = 3 * face
    face_normal = (
        geometry.face_normal[index],
        geometry.face_normal[index + 1],
        geometry.face_normal[index + 2],
    )
    if dot(face_normal, direction) > 0.0:
        face_normal = (-face_normal[0], -face_normal[1], -face_normal[2])
    corner_normal = _corner(geometry.corner_normals, face, 0)
    if corner_normal[0] == 0.0 and corner_normal[1] == 0.0 and corner_normal[2] == 0.0:
        return face_normal, face_normal
    shading = _interpolated(geometry.corner_normals, face, weights)
    square = dot(shading, shading)
    if square < 1e-12:
        return face_normal, face_normal
    shading = along(
        (0.0, 0.0, 0.0), shading, math.copysign(1.0 / math.sqrt(square), dot(shading, face_normal))
    )
    if dot(shading, direction) > -FACING:  # the shading normal faces away from the ray
        return face_normal, face_normal
    return face_normal, shading


@borrowing_kernel
def _on_smooth_surface(
    geometry: Geometry, face: int, weights: Vector, point: Vector, normal: Vector
) -> Vector:
    # Point raised from its triangle to the curved surface given by the normals at the corners. J. Hanika,
    # "Hacking the shadow terminator", Ray Tracing Gems II (2021), chapter 4: the weighted mean of the point's
    # projections on the tangent planes at the corners, as far as these are above it.
    raised = point
    for corner in range(3):
        corner_normal = _corner(geometry.corner_normals, face, corner)
        corner_normal = along((0.0, 0.0, 0.0), corner_normal, math.copysign(1.0, dot(corner_normal, normal)))
        height = dot(along(point, _corner(geometry.triangles, face, corner), -1.0), corner_normal)
        raised = along(raised, corner_normal, -weights[corner] * min(0.0, height))
    return raised


@borrowing_kernel
def hit_at(
    geometry: Geometry, face: int, weights: Vector, direction: Vector, slope: float
) -> tuple[Hit, Vector]:
    # hit from which a path continues, and the point on the triangle.
    # ``slope``: slope of the waves of the coat [rad], 0 for a flat coat.
    face_normal, normal = _normals(geometry, face, weights, direction)
    point = _interpolated(geometry.triangles, face, weights)
    is_smooth = dot(face_normal, normal) < 1.0 - 1e-12
    origin = _on_smooth_surface(geometry, face, weights, point, normal) if is_smooth else point
    raised = dot(along(origin, point, -1.0), face_normal) > 0.0
    frame = frame_of(normal)
    coat_frame = frame
    if slope > 0.0:
        tilted = waved(normal, point, slope)
        if dot(tilted, direction) < -FACING:
            coat_frame = frame_of(tilted)
    return Hit(_lifted(origin, face_normal), face_normal, frame, coat_frame, raised), point


@borrowing_kernel
def behind(hit: Hit, point: Vector) -> Hit:
    # hit on the other side of a thin plate at a point of its triangle
    face_normal, normal = hit.face_normal, hit.frame[2]
    back = (-face_normal[0], -face_normal[1], -face_normal[2])
    frame = frame_of((-normal[0], -normal[1], -normal[2]))
    return Hit(_lifted(point, back), back, frame, frame, False)


@borrowing_kernel
def _lifted(point: Vector, normal: Vector) -> Vector:
    # move a point along the normal by more than the rounding error
    return along(point, normal, _LIFT * (1.0 + abs(point[0]) + abs(point[1]) + abs(point[2])))


@borrowing_kernel
def leaves(hit: Hit, direction: Vector) -> bool:
    # whether a direction leads away from the triangle, which the shading normal alone does not show
    return hit.raised or dot(hit.face_normal, direction) > 0.0
