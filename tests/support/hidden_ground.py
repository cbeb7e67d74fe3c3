"""Cars on level ground seen by a pushbroom camera that flies straight: exact hits of rays with boxes.

Nothing of the package is used. A flat earth: metres to the east, north and up.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

HEIGHT, SPACING, COLUMNS, LINES = 60.0, 0.1, 240, 260
EAST, NORTH, MAP = 500_000.0, 4_000_000.0, "EPSG:32617"
#: West, south, east, north and height of boxes [m], from the corner of the scene.
CARS = np.array(
    [(x, y, x + 1.9, y + 4.6, 1.5) for x in (1.5, 4.6, 8.0, 11.2, 14.5, 18.0, 21.0) for y in (2.0, 9.0, 17.0)]
)


@dataclass(frozen=True)
class Seen:
    # Where the rays of a line end (line, column), and on what
    east: np.ndarray
    north: np.ndarray
    up: np.ndarray
    zenith: np.ndarray
    is_car: np.ndarray


def _first_hit(origin: np.ndarray, ray: np.ndarray) -> np.ndarray:
    # Return how far rays (..., 3) go until they meet a box or the ground, in lengths of the ray
    way = -origin[..., 2] / ray[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        for west, south, east, north, top in CARS:
            low, high = np.array([west, south, 0.0]), np.array([east, north, top])
            near, far = (low - origin) / ray, (high - origin) / ray
            enter = np.fmin(near, far).max(axis=-1)
            leave = np.fmax(near, far).min(axis=-1)
            way = np.where((enter <= leave) & (enter > 0.0), np.minimum(way, enter), way)
    return way


def fly_over_cars() -> Seen:
    # Return what a line to the north over the middle of the scene sees
    along = np.arange(LINES) * SPACING
    look = (np.arange(COLUMNS) - (COLUMNS - 1) / 2) * SPACING / HEIGHT
    middle = COLUMNS * SPACING / 2
    origin = np.stack([np.full(LINES, middle), along, np.full(LINES, HEIGHT)], axis=-1)[:, None]
    # nothing is parallel to a wall
    ray = np.stack([look, np.full(COLUMNS, 1e-9), np.full(COLUMNS, -1.0)], axis=-1)[None]
    at = origin + _first_hit(origin, ray)[..., None] * ray
    zenith = np.broadcast_to(np.degrees(np.arctan(np.abs(look))), at.shape[:2])
    return Seen(at[..., 0] + EAST, at[..., 1] + NORTH, at[..., 2], zenith, at[..., 2] > 1e-6)


def surface(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    # Return the height of what stands at places [m]
    x, y = east - EAST, north - NORTH
    height = np.zeros(np.broadcast(x, y).shape)
    for west, south, right, top, up in CARS:
        height = np.where((x >= west) & (x <= right) & (y >= south) & (y <= top), up, height)
    return height


def is_hidden(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    # Return whether the camera, as it flies past places, sees something else in front of them
    point = np.stack([east - EAST, north - NORTH, surface(east, north)], axis=-1)
    origin = np.stack(
        [np.full(east.shape, COLUMNS * SPACING / 2), point[..., 1], np.full(east.shape, HEIGHT)], axis=-1
    )
    ray = point - origin
    ray[..., 1] = 1e-12
    return _first_hit(origin, ray) < 1.0 - 1e-6


def located(seen: Seen, **variables: Any) -> xr.Dataset:
    # Return the line as it is when it was located on a model of the surface
    dims, crs = ("along_track", "cross_track"), {"units": "m", "crs": MAP}
    line = xr.Dataset(variables).assign_coords(
        east=(dims, seen.east, crs), north=(dims, seen.north, crs),
        ground_height=(dims, seen.up, {"units": "m"}), view_zenith=(dims, seen.zenith, {"units": "degree"}),
    )  # fmt: skip
    return line.assign_attrs(ground="dem")
