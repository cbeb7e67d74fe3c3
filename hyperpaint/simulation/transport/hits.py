"""Hits of rays on surfaces: normals, lifted points, waves of the coat.

Orange peel is a clear coat that has set in waves of millimetres to a centimetre.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hyperpaint.base.arrays import Array
from hyperpaint.base.jit import borrowing_kernel

from .hierarchy import Geometry
from .vectors import Frame, Vector, along, dot, frame_of, unit


def _waves(count: int = 8) -> np.ndarray:
    # Wave vectors [rad/m] and phases [rad], (wave, 4): all directions, lengths of 3 to 12 mm.
    place = np.arange(count) + 0.5
    z, angle = 1.0 - place / count, np.pi * (1.0 + np.sqrt(5.0)) * place  # a spiral over half a sphere
    across = np.sqrt(1.0 - z**2)
    length = 3e-3 * 4.0 ** ((place * 0.6180339887498949) % 1.0)
    directions = np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)
    phase = 2.0 * np.pi * ((place * 0.7548776662466927) % 1.0)
    return np.concatenate([2.0 * np.pi / length[:, None] * directions, phase[:, None]], axis=1)


#: Waves that add up to the height of a coat over its surface.
WAVES = _waves()


@borrowing_kernel
def waved(normal: Vector, point: Vector, slope: float) -> Vector:
    """Return the normal of a wavy surface.

    Parameters
    ----------
    normal
        Of the surface without waves.
    point
        Where on it [m]; the waves stand in space, so that a place has the same normal whoever asks.
    slope
        Root mean square of the slope, over all directions of the normal [rad].
    """
    gradient = (0.0, 0.0, 0.0)
    for k in range(WAVES.shape[0]):
        x, y, z, phase = WAVES[k, 0], WAVES[k, 1], WAVES[k, 2], WAVES[k, 3]
        rise = math.cos(x * point[0] + y * point[1] + z * point[2] + phase) / math.sqrt(x * x + y * y + z * z)
        gradient = along(gradient, (x, y, z), rise)
    # cos^2 is 1/2 on an average, the part of a wave along a surface 2/3 of its square
    gradient = along((0.0, 0.0, 0.0), gradient, slope * math.sqrt(3.0 / WAVES.shape[0]))
    level = along(gradient, normal, -dot(gradient, normal))
    return unit((normal[0] - level[0], normal[1] - level[1], normal[2] - level[2]))


#: A direction at a smaller cosine does not face a surface.
FACING = 1e-9

_LIFT = 1e-9  # of the size of the coordinates


class Hit(NamedTuple):
    point: Vector  # lifted off the surface
    own: Vector  # normal of the triangle, on the side the path comes from
    frame: Frame  # its last vector is the shading normal
    coat_frame: Frame  # the same with the waves of the coat
    raised: bool  # the point lies on the smooth surface that the triangle stands for


@borrowing_kernel
def _corner(array: Array, face: int, corner: int) -> Vector:
    at = 9 * face + 3 * corner
    return array[at], array[at + 1], array[at + 2]


@borrowing_kernel
def _at_hit(array: Array, face: int, weights: Vector) -> Vector:
    point = along((0.0, 0.0, 0.0), _corner(array, face, 0), weights[0])
    point = along(point, _corner(array, face, 1), weights[1])
    return along(point, _corner(array, face, 2), weights[2])


@borrowing_kernel
def _normals(geometry: Geometry, face: int, weights: Vector, direction: Vector) -> tuple[Vector, Vector]:
    # Both the triangle's normal and the shading normal are on the side that a ray comes from.
    at = 3 * face
    own = (geometry.face_normal[at], geometry.face_normal[at + 1], geometry.face_normal[at + 2])
    if dot(own, direction) > 0.0:
        own = (-own[0], -own[1], -own[2])
    first = _corner(geometry.corner_normals, face, 0)
    if first[0] == 0.0 and first[1] == 0.0 and first[2] == 0.0:
        return own, own
    shading = _at_hit(geometry.corner_normals, face, weights)
    square = dot(shading, shading)
    if square < 1e-12:
        return own, own
    shading = along((0.0, 0.0, 0.0), shading, math.copysign(1.0 / math.sqrt(square), dot(shading, own)))
    if dot(shading, direction) > -FACING:  # interpolated past the horizon
        return own, own
    return own, shading


@borrowing_kernel
def _on_smooth_surface(
    geometry: Geometry, face: int, weights: Vector, point: Vector, normal: Vector
) -> Vector:
    # A point raised from its triangle to the curved surface that the corners' normals stand for.
    # J. Hanika, "Hacking the shadow terminator", Ray Tracing Gems II (2021), chapter 4: the mean of the
    # point's projections on the planes at the corners, where they lie above it.
    raised = point
    for corner in range(3):
        up = _corner(geometry.corner_normals, face, corner)
        up = along((0.0, 0.0, 0.0), up, math.copysign(1.0, dot(up, normal)))
        below = dot(along(point, _corner(geometry.triangles, face, corner), -1.0), up)
        raised = along(raised, up, -weights[corner] * min(0.0, below))
    return raised


@borrowing_kernel
def hit_at(
    geometry: Geometry, face: int, weights: Vector, direction: Vector, slope: float
) -> tuple[Hit, Vector]:
    """Return the hit from which a path continues, and the point on the triangle.

    ``slope`` is that of the coat's waves [rad], 0 for a flat one.
    """
    own, normal = _normals(geometry, face, weights, direction)
    point = _at_hit(geometry.triangles, face, weights)
    origin = point
    if dot(own, normal) < 1.0 - 1e-12:
        origin = _on_smooth_surface(geometry, face, weights, point, normal)
    raised = dot(along(origin, point, -1.0), own) > 0.0
    frame = frame_of(normal)
    coat_frame = frame
    if slope > 0.0:
        tilted = waved(normal, point, slope)
        if dot(tilted, direction) < -FACING:
            coat_frame = frame_of(tilted)
    return Hit(_lifted(origin, own), own, frame, coat_frame, raised), point


@borrowing_kernel
def behind(hit: Hit, point: Vector) -> Hit:
    # Other side of a thin plate at a point of its triangle.
    own, normal = hit.own, hit.frame[2]
    back = (-own[0], -own[1], -own[2])
    frame = frame_of((-normal[0], -normal[1], -normal[2]))
    return Hit(_lifted(point, back), back, frame, frame, False)


@borrowing_kernel
def _lifted(point: Vector, normal: Vector) -> Vector:
    # By more than the rounding error.
    return along(point, normal, _LIFT * (1.0 + abs(point[0]) + abs(point[1]) + abs(point[2])))


@borrowing_kernel
def leaves(hit: Hit, direction: Vector) -> bool:
    # Whether a direction leads away from a surface; a shading normal alone can be wrong.
    return hit.raised or dot(hit.own, direction) > 0.0
