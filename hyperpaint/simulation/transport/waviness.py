"""Orange peel: waves of millimetres to a centimetre in a clear coat."""

from __future__ import annotations

import math

import numpy as np

from hyperpaint.base.jit import borrowing_kernel

from .vectors import Vector, along, dot, unit


def _waves(count: int = 8) -> np.ndarray:
    """Return wave vectors [rad/m] and phases [rad], (wave, 4): all directions, lengths of 3 to 12 mm."""
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
