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

from .building import build_nodes
from .vectors import Vector

#: Length of the stack of a traversal; `building` keeps every branch shorter.
STACK = 96

#: Coordinates beyond this [m] are refused: products of lengths must not overflow.
_LARGEST = 1e9

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
    if not (np.abs(points) <= _LARGEST).all():
        raise ValueError(f"vertices must be finite and within {_LARGEST:g} m")

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


class _Ray(NamedTuple):
    """A ray as the tests of boxes and triangles need it."""

    sides: tuple[Any, Any, Any]  # of a box that it enters by, for each axis: 0 the lowest, 1 the highest
    origin: Vector
    inverse: Vector  # of the direction
    axes: tuple[Any, Any, Any]  # of its own frame: the last is the one it runs along most
    begin: Vector  # the origin in that frame
    shear: Vector  # what turns the direction into the last axis


@borrowing_kernel
def _enter(nodes: Array, at: Any, ray: _Ray, limit: float) -> float:
    """Return the distance at which a ray enters a box, from 0 on; `_FAR` for a miss before ``limit``."""
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
    """Return 1 / x; large but finite near zero."""
    return 1.0 / x if abs(x) > 1e-150 else 1e150


@borrowing_kernel
def _axes(dx: float, dy: float, dz: float) -> tuple[Any, Any, Any]:
    """Return the axes of a ray's own frame: the last is the dominant one."""
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
    """Return the distance to a triangle and the hit's weights of the corners; -1 for a miss.

    S. Woop, C. Benthin, I. Wald, "Watertight ray/triangle intersection", JCGT 2 (2013). The function of an
    edge has exactly opposite values for the two triangles that share it; zero belongs to both.
    """
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
    """Return whether a ray hits any triangle; parameters as for `closest`."""
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
