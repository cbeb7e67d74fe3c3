"""Rotations of a body (forward, right, down) in the frame north, east, down, as unit quaternions.

Quaternions are (scalar, x, y, z); q and -q are the same rotation. scipy's Rotation is not used, since it
differs in the last place in 27 % of the matrix elements, which would move pixels of stored maps.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Floats

_MIN_ARC_RAD = 1e-8  # half angle between rotations below which the arc is replaced by its chord


def quaternions(roll: npt.ArrayLike, pitch: npt.ArrayLike, heading: npt.ArrayLike) -> Floats:
    """Return Rz(heading) Ry(pitch) Rx(roll) of angles [degree] (..., 4)."""
    halves = [np.radians(np.asarray(angle, np.float64)) / 2 for angle in (roll, pitch, heading)]
    (cr, cp, ch), (sr, sp, sh) = ([f(half) for half in halves] for f in (np.cos, np.sin))
    return np.stack(
        [
            ch * cp * cr + sh * sp * sr,
            ch * cp * sr - sh * sp * cr,
            ch * sp * cr + sh * cp * sr,
            sh * cp * cr - ch * sp * sr,
        ],
        axis=-1,
    )


def matrices(rotation: Floats) -> Floats:
    """Return quaternions as matrices (..., 3, 3) from the body's frame to north, east, down."""
    w, x, y, z = np.moveaxis(rotation, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def angles_of(rotation: Floats) -> tuple[Floats, Floats, Floats]:
    """Return roll (-180 to 180), pitch (-90 to 90) and heading (0 to 360) [degree] of quaternions."""
    w, x, y, z = np.moveaxis(rotation, -1, 0)
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - x * z), -1.0, 1.0))
    heading = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    # twice: the first mod turns a tiny negative angle into 360
    return np.degrees(roll), np.degrees(pitch), np.mod(np.mod(np.degrees(heading), 360.0), 360.0)


def slerp(first: Floats, second: Floats, weight: Floats) -> Floats:
    """Return rotations on the shorter arc from ``first`` (weight 0) to ``second`` (weight 1) (..., 4).

    Notes
    -----
    Shoemake (1985), "Animating rotation with quaternion curves".
    """
    second = np.where(((first * second).sum(axis=-1) < 0)[..., None], -second, second)
    # from the chord: an arc cosine near 1 loses half of its digits
    angle = 2.0 * np.arcsin(np.clip(np.linalg.norm(second - first, axis=-1) / 2.0, 0.0, 1.0))
    is_near = angle < _MIN_ARC_RAD
    sine = np.where(is_near, 1.0, np.sin(angle))
    first_weight = np.where(is_near, 1.0 - weight, np.sin((1.0 - weight) * angle) / sine)
    second_weight = np.where(is_near, weight, np.sin(weight * angle) / sine)
    rotation = first_weight[..., None] * first + second_weight[..., None] * second
    return np.asarray(rotation / np.linalg.norm(rotation, axis=-1, keepdims=True))
