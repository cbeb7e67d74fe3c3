"""Vectors as tuples of three numbers, which the compiler keeps in registers."""

from __future__ import annotations

import math
from typing import TypeAlias

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
    """Return three orthonormal vectors, the last one given.

    T. Duff et al., "Building an orthonormal basis, revisited", JCGT 6 (2017).
    """
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
