"""Flight lines over made-up ground, by scipy's rotations and bisection; nothing of the package is used.

A flat earth: metres to the east, north and up. The body looks forward, right, down.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from scipy.spatial.transform import Rotation

HEIGHT, GSD, PERIOD, SPEED = 15.24, 0.008, 0.007, 0.008 / 0.007
"""Height above ground [m], spacing of pixels below the camera [m], time of a line [s], speed [m/s]."""
WOBBLES = {"none": (0.0, 0.0), "calm": (0.15, 1.1), "rough": (0.42, 3.1)}
"""Spread of roll and pitch, and of heading [degree]."""
MAP = "EPSG:32617"
EAST, NORTH = 500_000.0, 3_760_000.0

_TO_MAP = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@dataclass(frozen=True)
class Flown:
    # Where the pixels of a line lie on the ground (line, column), and the pose of every line
    east: np.ndarray
    north: np.ndarray
    up: np.ndarray
    position: np.ndarray
    attitude: np.ndarray


def hills(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    # Return the height of smooth ground [m]
    return 0.3 * np.sin((east - EAST) / 1.3) * np.cos((north - NORTH) / 0.9)


def fly(
    lines: int,
    columns: int,
    wobble: str = "calm",
    *,
    heading: float = 0.0,
    ground: Any = None,
    seed: int = 0,
) -> Flown:
    # Return a line flown over level ground, or over that whose height ``ground(east, north)`` returns
    rng = np.random.default_rng(seed)
    time = np.arange(lines) * PERIOD
    spread = WOBBLES[wobble]
    attitude = np.stack([_swings(time, s, rng) for s in (spread[0], spread[0], spread[1])], axis=-1)
    attitude[:, 2] += heading
    along = np.radians(heading)
    way = SPEED * (time - time[-1] / 2)
    position = np.stack(
        [EAST + way * np.sin(along), NORTH + way * np.cos(along), np.full(lines, HEIGHT)], axis=-1
    )
    roll, pitch, yaw = attitude.T
    turn = Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], axis=-1), degrees=True).as_matrix()
    across = (np.arange(columns) - (columns - 1) / 2) * GSD / HEIGHT
    look = np.stack([np.zeros(columns), across, np.ones(columns)], axis=-1)
    ray = np.einsum("ij,ljk,ck->lci", _TO_MAP, turn, look)
    near, far = np.zeros(ray.shape[:2]), (HEIGHT + 2.0) / -ray[..., 2]
    for _ in range(60):
        middle = (near + far) / 2
        at = position[:, None] + middle[..., None] * ray
        above = at[..., 2] > (0.0 if ground is None else ground(at[..., 0], at[..., 1]))
        near, far = np.where(above, middle, near), np.where(above, far, middle)
    at = position[:, None] + near[..., None] * ray
    return Flown(at[..., 0], at[..., 1], at[..., 2], position, attitude)


def _swings(time: np.ndarray, spread: float, rng: np.random.Generator) -> np.ndarray:
    made = np.zeros(time.size)
    for frequency in (0.4, 1.1, 2.2):
        made += rng.normal() * np.sin(2 * np.pi * frequency * time + rng.uniform(0, 2 * np.pi))
    return spread * made / max(made.std(), 1e-9)


def located(flown: Flown, *, chunk: int | None = 32, **variables: Any) -> xr.Dataset:
    # Return a located line: places of its pixels, line times, and more variables
    dims = ("along_track", "cross_track")
    start = np.datetime64("2021-07-20T17:10:00", "ns")
    lines = len(flown.east)
    attrs = {"units": "m", "crs": MAP}
    coords = {
        "east": (dims, flown.east, attrs),
        "north": (dims, flown.north, attrs),
        "time": (dims[:1], start + (np.arange(lines) * PERIOD * 1e9).astype("timedelta64[ns]")),
    }
    line = xr.Dataset(variables, coords=coords)
    line["quality"] = (dims, np.where(np.isnan(flown.east), 1024, 0).astype("uint16"))
    return line if chunk is None else line.chunk(along_track=chunk)


def nearest_by_distance(flown: Flown, east: np.ndarray, north: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    # Return the distance from places to the nearest pixel [m], and its position in the raveled line
    from scipy.spatial import cKDTree

    offset = np.array([EAST, NORTH])
    tree = cKDTree(np.stack([flown.east.ravel(), flown.north.ravel()], axis=-1) - offset)
    return tree.query(np.stack([np.ravel(east), np.ravel(north)], axis=-1) - offset)
