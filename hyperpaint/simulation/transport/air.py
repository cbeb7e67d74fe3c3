"""What the air between the scene and the camera takes from the light, and adds to it."""

from __future__ import annotations

import numpy as np

from hyperpaint.base.arrays import Array
from hyperpaint.base.jit import kernel

__all__ = ["through_air"]


_THIN = 0.15  # optical depth up to which a short series is exact to float32


def through_air(surface: Array, extinction: Array, path_radiance: Array, distance: Array, out: Array) -> None:
    """Write L exp(-k d) + Lp d.

    Parameters
    ----------
    surface : (line, band, column), float32
        L [W m-2 sr-1 nm-1].
    extinction, path_radiance : (band, column or 1), float32
        k [m-1], Lp [W m-2 sr-1 nm-1 m-1].
    distance : (line, column), float32
        d [m]; not finite where there is no air.
    out : (line, band, column), float32
        Written.
    """
    columns = surface.shape[2]
    take = np.ascontiguousarray(np.broadcast_to(extinction, (surface.shape[1], columns)), np.float32)
    add = np.ascontiguousarray(np.broadcast_to(path_radiance, take.shape), np.float32)
    metres = np.ascontiguousarray(np.where(np.isfinite(distance), distance, 0.0), np.float32)
    deepest = take.max(axis=0, initial=0.0)
    for line in range(len(surface)):
        # of this line alone: what else is in the block changes no bit
        if (deepest * metres[line]).max(initial=0.0) < _THIN:
            _thin_air(surface[line], take, add, metres[line], out[line])
        else:
            np.multiply(surface[line], np.exp(take * -metres[line]), out=out[line])
            out[line] += add * metres[line]


@kernel
def _thin_air(surface: Array, take: Array, add: Array, metres: Array, out: Array) -> None:
    one = np.float32(1.0)
    for band in range(surface.shape[0]):
        for column in range(surface.shape[1]):
            depth = take[band, column] * metres[column]
            # exp(-depth): what is left out is below depth^6 / 720
            left = one - depth * np.float32(1 / 5)
            left = one - depth * np.float32(1 / 4) * left
            left = one - depth * np.float32(1 / 3) * left
            left = one - depth * np.float32(1 / 2) * left
            left = one - depth * left
            out[band, column] = surface[band, column] * left + add[band, column] * metres[column]
