"""Rotations of a camera (x forward, y right, z down) in a scene (x east, y north, z up).

Quaternions are (scalar, x, y, z), of unit length, and turn camera directions into north, east, down; q and -q
are the same rotation.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from hyperpaint.base.arrays import Floats

__all__ = ["attitude_of", "interpolate", "matrices", "quaternions", "turns"]


#: north, east, down into east, north, up, and the other way round
_SCENE = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_NEARLY_EQUAL = 1e-8  # angles below which the arc is taken for its chord [rad]


def quaternions(roll: ArrayLike, pitch: ArrayLike, heading: ArrayLike) -> Floats:
    """Return qz(heading) qy(pitch) qx(roll), shape (..., 4); angles [degree]."""
    halves = [np.radians(np.asarray(angle, dtype=np.float64)) / 2 for angle in (roll, pitch, heading)]
    (cr, cp, ch), (sr, sp, sh) = ([f(half) for half in halves] for f in (np.cos, np.sin))
    return np.stack(
        [
            cr * cp * ch + sr * sp * sh,
            sr * cp * ch - cr * sp * sh,
            cr * sp * ch + sr * cp * sh,
            cr * cp * sh - sr * sp * ch,
        ],
        axis=-1,
    )


def turns(rotation: Floats) -> Floats:
    """Return quaternions as matrices within the frame forward, right, down, shape (..., 3, 3)."""
    w, x, y, z = np.moveaxis(rotation, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def matrices(rotation: Floats) -> Floats:
    """Return what turns camera directions into the scene's, of quaternions, shape (..., 3, 3).

    Examples
    --------
    Heading east, right is south and down stays down:

    >>> matrices(quaternions([0.0], [0.0], [90.0]))[0].round(9) + 0.0
    array([[ 1.,  0.,  0.],
           [ 0., -1.,  0.],
           [ 0.,  0., -1.]])
    """
    return np.asarray(_SCENE @ turns(rotation))


def interpolate(first: Floats, second: Floats, part: Floats) -> Floats:
    """Return rotations on the shorter arc from ``first`` (part 0) to ``second`` (part 1), shape (..., 4)."""
    dot = (first * second).sum(axis=-1)
    second = np.where((dot < 0)[..., None], -second, second)
    angle = np.arccos(np.clip(np.abs(dot), 0.0, 1.0))
    sine = np.where(angle > _NEARLY_EQUAL, np.sin(angle), 1.0)
    near = angle <= _NEARLY_EQUAL
    one = np.where(near, 1.0 - part, np.sin((1.0 - part) * angle) / sine)
    other = np.where(near, part, np.sin(part * angle) / sine)
    made = one[..., None] * first + other[..., None] * second
    return np.asarray(made / np.linalg.norm(made, axis=-1, keepdims=True))


def attitude_of(rotation: Floats) -> Floats:
    """Return roll, pitch, heading halfway between two rotations [degree], shape (line, 3).

    Parameters
    ----------
    rotation
        Shape (line, 2, 3, 3), as `matrices` returns them.
    """
    sum_of_both = _SCENE @ rotation.sum(axis=1)
    # the rotation nearest to the sum is the one halfway (Moakher 2002)
    left, _, right = np.linalg.svd(sum_of_both)
    middle = left @ right
    roll = np.arctan2(middle[:, 2, 1], middle[:, 2, 2])
    pitch = -np.arcsin(np.clip(middle[:, 2, 0], -1.0, 1.0))
    heading = np.arctan2(middle[:, 1, 0], middle[:, 0, 0])
    made = np.degrees(np.stack([roll, pitch, heading], axis=-1))
    made[:, 2] %= 360.0
    return np.asarray(made)
