"""Flights of a line camera whose platform wobbles, and what it sees; shares no code with the package.

Attitudes are sums of sines; the ground is a function of east and north, with edges and stripes; every
exposure is a mean over its duration. Rotations are those of scipy, positions those of PROJ.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyproj
import xarray as xr
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

START = np.datetime64("2024-06-01T15:00:00", "ns")
#: Standard deviations of roll, pitch, heading [degree] of the two kinds of flight.
WOBBLES = {"calm": (0.15, 0.15, 1.1), "rough": (0.42, 0.42, 3.1), "none": (0.0, 0.0, 0.0)}


@dataclass
class Flight:
    # What was flown: pass it on with changes to fly something else
    seed: int = 0
    wobble: str = "calm"
    lines: int = 1200
    columns: int = 256
    heading: float = 37.0
    pitch: float = 0.0  #: Mean, nose up [degree]
    crab: float = 4.0
    latitude: float = 43.1
    longitude: float = -77.6
    ground: float = 120.0
    above: float = 15.24
    gsd: float = 0.008
    period: float = 0.007
    exposure: float = 0.005
    boresight: tuple[float, float, float] = (0.0, 0.0, 0.0)
    lever_arm: tuple[float, float, float] = (0.05, -0.02, 0.12)
    clock_offset: float = 0.0
    noise: float = 0.01
    attitude_noise: float = 0.003
    rate: float = 100.0
    column_sign: int = 1
    start: tuple[float, float] = (0.0, 0.0)
    turns: list[Any] = field(init=False)

    def __post_init__(self) -> None:
        rng = np.random.default_rng([self.seed, 11])
        self.turns = []
        for sd in WOBBLES[self.wobble]:
            f = rng.uniform(0.15, 2.5, 8)
            weight = rng.uniform(0.5, 1.0, 8) / np.sqrt(f)
            weight *= sd * np.sqrt(2.0 / (weight**2).sum())
            self.turns.append((f, weight, rng.uniform(0, 2 * np.pi, 8)))

    @property
    def spacing(self) -> float:
        # Tangent between columns
        return self.gsd / self.above

    def attitude(self, t: np.ndarray) -> np.ndarray:
        # Return true roll, pitch, heading (n, 3) [degree] at seconds of the navigation's clock
        made = [(w * np.sin(2 * np.pi * f * t[:, None] + p)).sum(axis=1) for f, w, p in self.turns]
        return np.stack([made[0], self.pitch + made[1], self.heading + self.crab + made[2]], axis=1)

    def places(self, t: np.ndarray) -> np.ndarray:
        # Return east, north, up (n, 3) of the navigation's reference point [m]
        way = (self.gsd / self.period) * t
        course = np.radians(self.heading)
        drift = 0.02 * np.sin(0.7 * t)
        return np.stack(
            [
                self.start[0] + way * np.sin(course) + drift * np.cos(course),
                self.start[1] + way * np.cos(course) - drift * np.sin(course),
                self.above + 0.03 * np.sin(0.5 * t),
            ],
            axis=1,
        )

    def topocentric(self) -> pyproj.Transformer:
        # Return what turns longitude, latitude, height into east, north, up
        return pyproj.Transformer.from_pipeline(
            "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
            f"+step +proj=topocentric +ellps=WGS84 +lon_0={self.longitude} +lat_0={self.latitude} "
            f"+h_0={self.ground}"
        )

    def rays(self, t: np.ndarray, column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        # Return the projection centre (n, 3) and directions (n, column, 3), east, north, up
        body = Rotation.from_euler("ZYX", self.attitude(t)[:, ::-1], degrees=True)
        whole = body * Rotation.from_euler("ZYX", self.boresight[::-1], degrees=True)
        to_map = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1.0]])
        y = self.column_sign * (column - (self.columns - 1) / 2) * self.spacing
        u = np.stack([np.zeros_like(y), y, np.ones_like(y)], axis=-1)
        directions = np.einsum("ij,njk,...k->n...i", to_map, whole.as_matrix(), u)
        return self.places(t) + body.apply(self.lever_arm) @ to_map.T, directions

    def hits(self, t: np.ndarray, column: np.ndarray, height: float = 0.0) -> np.ndarray:
        # Return east and north (n, column, 2) of what is seen on level ground
        centre, d = self.rays(t, column)
        s = (height - centre[:, 2])[:, None] / d[..., 2]
        return centre[:, None, :2] + s[..., None] * d[..., :2]

    def ground_at(self, places: np.ndarray) -> np.ndarray:
        # Return brightness of the ground
        rng = np.random.default_rng([self.seed, 5])
        grain = self.gsd
        made = np.zeros(places.shape[:-1])
        for octave in range(6):
            angle = rng.uniform(0, 2 * np.pi)
            turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
            at = places @ turn.T / (grain * 2.0 * 2**octave)
            lattice = rng.standard_normal((128, 128))
            made += 1.5**octave * map_coordinates(lattice, np.moveaxis(at, -1, 0), mode="grid-wrap")
        made /= 4.0
        angle = rng.uniform(0, np.pi)
        across = places @ np.array([np.cos(angle), np.sin(angle)]) / (90.0 * grain)
        stripe = 1.0 / (1.0 + np.exp(-(np.cos(2 * np.pi * across) - 0.93) * 60.0))
        return np.exp(0.25 * np.tanh(0.8 * made) + 0.4 * stripe)

    def seconds(self) -> np.ndarray:
        # Return mid exposures on the navigation's clock
        return 1.0 + self.period * np.arange(self.lines)

    def image(self) -> np.ndarray:
        # Return what the camera records (line, column), 1000 counts or so
        rng = np.random.default_rng([self.seed, 7])
        made = np.zeros((self.lines, self.columns))
        column = np.arange(self.columns, dtype=float)
        for part in (-0.4, -0.2, 0.0, 0.2, 0.4):
            made += self.ground_at(self.hits(self.seconds() + part * self.exposure, column)) / 5
        gain = 1.0 + 0.02 * rng.standard_normal(self.columns)
        return 1000.0 * gain * made * (1.0 + self.noise * rng.standard_normal(made.shape))

    def line(self, *, image: bool = True) -> xr.Dataset:
        # Return the flight line; its clock is `clock_offset` behind that of the navigation
        time = START + np.round((self.seconds() - self.clock_offset) * 1e9).astype("timedelta64[ns]")
        made = xr.Dataset(coords={"time": ("along_track", time), "cross_track": np.arange(self.columns)})
        made["exposure_time"] = xr.DataArray(self.exposure, attrs={"units": "s"})
        if image:
            counts = np.clip(self.image()[:, None, :], 0, 60000).astype(np.uint16)
            made["counts"] = (("along_track", "band", "cross_track"), counts, {"units": "count"})
        return made

    def navigation(self) -> xr.Dataset:
        # Return the record, in canonical form and without a word on what it means
        rng = np.random.default_rng([self.seed, 3])
        t = np.arange(0.0, 2.0 + self.period * self.lines, 1.0 / self.rate)
        lon, lat, height = self.topocentric().transform(*self.places(t).T, direction="INVERSE")
        angles = self.attitude(t) + self.attitude_noise * rng.standard_normal((t.size, 3))
        time = START + np.round(t * 1e9).astype("timedelta64[ns]")
        roll, pitch, heading = angles.T
        values = {"latitude": lat, "longitude": lon, "altitude": height, "roll": roll, "pitch": pitch}
        values["heading"] = heading % 360.0
        return xr.Dataset(
            {name: ("navigation_time", np.asarray(v)) for name, v in values.items()},
            coords={"navigation_time": time},
        )
