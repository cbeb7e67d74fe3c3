"""What one task places, a slab of lines, and what all tasks share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Floats

from .cameras import directions
from .geodesy import near_turns, polynomials, turn_of_north
from .rotations import matrices, quaternions
from .terrain import Terrain

__all__ = ["Mounting", "Swath", "places_of", "swath_of"]


_MAP_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""Turns north, east, down into east, north, up."""
_NEAREST, _FARTHEST = 10.0, 20_000.0
"""Bounds of the way from the camera over which a map is looked at [m]."""


@dataclass(frozen=True)
class Mounting:
    """How a camera sits in the body.

    Attributes
    ----------
    boresight
        Roll, pitch, heading of the camera in the body [degree].
    lever_arm
        Projection centre from the point that positions are of: forward, right, down [m].
    """

    boresight: tuple[float, float, float]
    lever_arm: tuple[float, float, float]


@dataclass(frozen=True)
class Swath:
    """All that a slab of lines needs.

    Attributes
    ----------
    poses : (6, line), float64
        Canonical; see `hyperpaint.geometry.georeference.poses.POSE`.
    look : (column, 3), float64
        Directions of the columns in the camera's frame.
    mounting
        How the camera sits in the body.
    ground
        Height of level ground above the ellipsoid [m], or a raster of heights.
    crs
        Map.
    starts : (slab + 1,)
        First line of every slab, and the number of lines.
    """

    poses: Floats
    look: Floats
    mounting: Mounting
    ground: float | Terrain
    crs: str
    starts: npt.NDArray[np.int64]


def swath_of(
    poses: Floats,
    across: Floats,
    along: Floats,
    mounting: Mounting,
    ground: float | Terrain,
    crs: str,
    starts: npt.NDArray[np.int64],
) -> Swath:
    """Return what all tasks share."""
    return Swath(poses, directions(np.asarray(across), np.asarray(along)), mounting, ground, crs, starts)


def places_of(swath: Swath, block_id: tuple[int, ...]) -> Floats:
    """Return what is known of the pixels of a slab (part, line, column), float64."""
    here = slice(int(swath.starts[block_id[1]]), int(swath.starts[block_id[1] + 1]))
    return place_lines(swath, swath.poses[:, here])


def place_lines(swath: Swath, poses: Floats) -> Floats:
    """Return x, y, height [m], zenith and azimuth [degree] (part, line, column) of lines with poses."""
    from hyperpaint.kernels.arguments import LineFrames, LineRays, Raster
    from hyperpaint.kernels.rays import PLACES, level_places, raster_places

    latitude, longitude, altitude = poses[:3]
    body = _MAP_FROM_NED @ matrices(quaternions(*poses[3:]))
    origin = np.ascontiguousarray(body @ np.array(swath.mounting.lever_arm, np.float64))
    rotation = np.ascontiguousarray(body @ matrices(quaternions(*swath.mounting.boresight)))
    lowest = swath.ground if isinstance(swath.ground, float) else swath.ground.lowest
    reach = np.clip(altitude - lowest, _NEAREST, _FARTHEST)
    x, y, height = polynomials(latitude, longitude, altitude, reach, swath.crs)
    out = np.empty((PLACES, latitude.size, len(swath.look)))
    rays = LineRays(origin, rotation, swath.look)
    frames = LineFrames(x, y, height, turn_of_north(latitude))
    if isinstance(swath.ground, float):
        level_places(rays, frames, swath.ground, out)
        return out
    terrain, grid = swath.ground, swath.ground.grid
    col, row = x.copy(), y.copy()
    if grid.crs != swath.crs:
        col, row, _ = polynomials(latitude, longitude, altitude, reach, grid.crs)
    # rasters count longitude from -180 or 0, or reach across 180
    col[:, 0] += near_turns(col[:, 0], grid.x[0] + grid.x[1] * (terrain.heights.shape[1] - 1) / 2, grid.crs)
    for place, (first, step) in ((col, grid.x), (row, grid.y)):
        place[:, 0] -= first
        place /= step
    raster = Raster(row, col, terrain.heights, terrain.tops, terrain.lowest, terrain.highest)
    raster_places(rays, frames, raster, out)
    return out
