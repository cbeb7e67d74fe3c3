"""Hits of rays on surfaces: normals, lifted points, waves of the coat.

Orange peel is waviness of a clear coat with wavelengths of millimetres to a centimetre.
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
    """Return the normal of a wavy surface.

    Parameters
    ----------
    normal
        Normal of the surface without waves.
    point
        Position [m]; the waves are fixed in space, so that a position always has the same normal.
    slope
        Root mean square of the slope, over all directions of the normal [rad].
    """
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
    """Return the hit from which a path continues, and the point on the triangle.

    ``slope``: slope of the waves of the coat [rad], 0 for a flat coat.
    """
    face_normal, normal = _normals(geometry, face, weights, direction)
    point = _interpolated(geometry.triangles, face, weights)
    origin = point
    if dot(face_normal, normal) < 1.0 - 1e-12:
        origin = _on_smooth_surface(geometry, face, weights, point, normal)
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
