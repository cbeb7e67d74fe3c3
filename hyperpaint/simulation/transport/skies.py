"""Skylight of paths that leave the scene."""

from __future__ import annotations

import math

from hyperpaint.base.arrays import Array
from hyperpaint.base.jit import borrowing_kernel
from hyperpaint.light.sky_functions import HORIZON_SHIFT

from .codes import PathTable, add_path
from .path_blocks import Sources
from .path_codes import CLEAR_SKY_FUNCTIONS, FIRST_CLEAR_SKY, OVERCAST_SKY, SKY
from .vectors import Vector, dot


@borrowing_kernel
def record_sky(table: PathTable, sources: Sources, code: int, beta: float, direction: Vector) -> None:
    """Add an escaped path once for every sky: its weight times the sky's value in that direction.

    Parameters
    ----------
    table
        Of the pixel.
    sources
        Their skies are recorded; ``shapes`` is an array, empty for no clear sky.
    code, beta
        Code of the path without a source, and its weight.
    direction
        Where it leaves to, a unit vector; upwards, there is no sky below the horizon.
    """
    add_path(table, code | SKY, beta)
    up = direction[2]
    if sources.overcast:
        add_path(table, code | OVERCAST_SKY, 1.5 * up * beta)
    if sources.shapes.size == 0:
        return
    u = math.log(up + HORIZON_SHIFT)
    for sun in range(sources.suns.shape[0]):
        towards = (sources.suns[sun, 0], sources.suns[sun, 1], sources.suns[sun, 2])
        t = math.acos(min(1.0, max(-1.0, dot(direction, towards))))
        for function in range(CLEAR_SKY_FUNCTIONS):
            value = beta * _value(sources.shapes, sun, function, u, t)
            add_path(table, code | FIRST_CLEAR_SKY + CLEAR_SKY_FUNCTIONS * sun + function, value)


@borrowing_kernel
def _value(shapes: Array, sun: int, function: int, u: float, t: float) -> float:
    """Return a sky function over a uniform sky, see `hyperpaint.light.sky_functions.relative_radiance`."""
    c = shapes[sun, function]
    power = u * (c[0] + u * (c[1] + u * c[2])) + t * (c[3] + t * (c[4] + t * c[5])) + c[6] * u * t + c[7]
    return math.exp(power)
