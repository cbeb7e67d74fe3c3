"""Flight lines with poses, and where their rays end by other means: scipy's rotations and geocentric space.

Nothing of the package is used but its convention; hits are found by bisection on PROJ's own geodetic heights.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import pyproj
import xarray as xr
from scipy.spatial.transform import Rotation

from hyperpaint.base.attitude_conventions import Convention

START = np.datetime64("2026-06-21T17:00:00", "ns")
PERIOD = np.timedelta64(7_000_000, "ns")
UTM = "EPSG:32617"
LEFT_TO_RIGHT = Convention(column_order="left_to_right", stamp_reference="mid")
_NED_TO_ENU = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
_GEOCENTRIC = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)

Heights = Callable[[np.ndarray, np.ndarray], np.ndarray]


def flown(
    lines: int = 40, columns: int = 5, *, seed: int = 0, wobble: float = 3.0, **fixed: Any
) -> xr.Dataset:
    # Return a line that flies north at 1.14 m/s and wobbles, at 15.24 m unless ``fixed`` says else
    rng = np.random.default_rng(seed)
    seconds = np.arange(lines) * 0.007
    wave = [np.sin(2 * np.pi * (rng.uniform(0.5, 2) * seconds + rng.uniform())) for _ in range(3)]
    pose = {
        "latitude": 34.0 + 1.14 * seconds / 111e3,
        "longitude": np.full(lines, -80.2),
        "altitude": np.full(lines, 15.24),
        "roll": wobble * wave[0],
        "pitch": wobble * wave[1],
        "heading": np.mod(wobble * wave[2] + 1.0, 360.0),
    } | {name: np.broadcast_to(np.asarray(value, float), lines) for name, value in fixed.items()}
    units = {"altitude": "m"}
    variables = {n: ("along_track", np.array(v), {"units": units.get(n, "degree")}) for n, v in pose.items()}
    return xr.Dataset(
        {"counts": (("along_track", "band", "cross_track"), np.zeros((lines, 2, columns), np.uint16))},
        {**variables, "time": ("along_track", START + np.arange(lines) * PERIOD)},
        LEFT_TO_RIGHT.to_attrs(),
    )


def recorded(line: xr.Dataset) -> xr.Dataset:
    # Return the poses of a line as a navigation record
    names = ["latitude", "longitude", "altitude", "roll", "pitch", "heading"]
    record = line[names].reset_coords(drop=False).drop_vars("time", errors="ignore")
    record = record.rename_dims(along_track="navigation_time")
    return record.assign_coords(navigation_time=line.time.values)


def level(height: float) -> Heights:
    return lambda longitude, _: np.full(np.shape(longitude), height)


def exact_places(
    line: xr.Dataset,
    tangents: np.ndarray,
    surface: Heights,
    *,
    boresight: tuple[float, ...] = (0, 0, 0),
    lever_arm: tuple[float, ...] = (0, 0, 0),
    farthest: float = 100.0,
    crs: str = UTM,
) -> dict[str, np.ndarray]:
    # Return where rays meet a surface, of directions (column, 2): tangents forward and to the right
    lat, lon, alt, roll, pitch, heading = (
        line[n].values for n in ("latitude", "longitude", "altitude", "roll", "pitch", "heading")
    )
    body = Rotation.from_euler("ZYX", np.stack([heading, pitch, roll], -1), degrees=True)
    mount = Rotation.from_euler("ZYX", boresight[::-1], degrees=True)
    axes = _east_north_up(lat, lon)  # rows are directions
    to_space = np.swapaxes(axes, -1, -2) @ _NED_TO_ENU @ body.as_matrix()
    camera = np.stack(_GEOCENTRIC.transform(lon, lat, alt), -1) + to_space @ np.asarray(lever_arm, float)
    u = np.column_stack([tangents, np.ones(len(tangents))])
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    d = np.einsum("lij,cj->lci", to_space @ mount.as_matrix(), u)

    def above(s: np.ndarray) -> np.ndarray:
        places = np.moveaxis(camera[:, None] + s[..., None] * d, -1, 0)
        x, y, h = _GEOCENTRIC.transform(*places, direction="INVERSE")
        return h - surface(x, y)

    low, high = np.zeros(d.shape[:2]), np.full(d.shape[:2], farthest)
    for _ in range(80):
        middle = 0.5 * (low + high)
        over = above(middle) > 0
        low, high = np.where(over, middle, low), np.where(over, high, middle)
    hit = camera[:, None] + high[..., None] * d
    x, y, h = _GEOCENTRIC.transform(*np.moveaxis(hit, -1, 0), direction="INVERSE")
    east, north = pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(x, y)
    back = np.einsum("lcij,lcj->lci", _east_north_up(y, x), -d)
    return {
        "east": east,
        "north": north,
        "ground_height": h,
        "view_zenith": np.degrees(np.arctan2(np.hypot(back[..., 0], back[..., 1]), back[..., 2])),
        "view_azimuth": np.degrees(np.arctan2(back[..., 0], back[..., 1])) % 360.0,
    }


def _east_north_up(latitude: np.ndarray, longitude: np.ndarray) -> np.ndarray:
    p, q = np.radians(latitude), np.radians(longitude)
    zero = np.zeros_like(p)
    east = np.stack([-np.sin(q), np.cos(q), zero], -1)
    north = np.stack([-np.sin(p) * np.cos(q), -np.sin(p) * np.sin(q), np.cos(p)], -1)
    up = np.stack([np.cos(p) * np.cos(q), np.cos(p) * np.sin(q), np.sin(p)], -1)
    return np.stack([east, north, up], axis=-2)
