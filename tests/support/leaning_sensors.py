"""Light sensors that lean under the skies of the CIE: plain numpy, but for the spectra of beam and sky."""

from typing import NamedTuple

import numpy as np
import xarray as xr

from hyperpaint.light.clear_sky import ClearSky
from hyperpaint.light.sun import solar_position

NM = np.arange(400.0, 1001.0, 2.0)
HEADING = 70.0
LATITUDE, LONGITUDE = 40.0, 0.0
CIE = {"clear": (-1.0, -0.32, 10.0, -3.0, 0.45), "overcast": (4.0, -0.7, 0.0, -1.0, 0.0)}
"""a, b, c, d, e of ISO 15469, types 12 and 1."""


class Leaning(NamedTuple):
    # What a sensor read, how it stood, and what a level one would have read
    record: xr.Dataset
    attitude: xr.Dataset
    level: np.ndarray  # (sample, channel)
    tilt: np.ndarray  # (sample,) [degree]


def share_of_sky(normal: np.ndarray, sun: np.ndarray, kind: str) -> np.ndarray:
    # Return diffuse light on planes (plane, 3) over that on level ground
    a, b, c, d, e = CIE[kind]
    cosine, azimuth = np.meshgrid(
        (np.arange(60) + 0.5) / 60, (np.arange(120) + 0.5) / 60 * np.pi, indexing="ij"
    )
    sine = np.sqrt(1.0 - cosine**2)
    way = np.stack([sine * np.sin(azimuth), sine * np.cos(azimuth), cosine], axis=-1)
    away = np.arccos(np.clip(way @ sun, -1.0, 1.0))
    sky = 1.0 + a * np.exp(b / cosine)
    sky *= 1.0 + c * (np.exp(d * away) - np.exp(d * np.pi / 2.0)) + e * np.cos(away) ** 2
    return np.array([(sky * np.clip(way @ each, 0.0, None)).sum() for each in normal]) / (sky * cosine).sum()


def leaning(
    zenith: float,
    *,
    seed: int,
    kind: str = "clear",
    most: float = 10.0,
    aerosol: float = 0.1,
    samples: int = 40,
    noise: float = 0.002,
) -> Leaning:
    # Return a record of a sensor that leans at random, by up to ``most`` [degree], once a second
    rng = np.random.default_rng(seed)
    day = np.datetime64("2024-06-21T05:00", "ns") + np.arange(0, 25200, 10) * np.timedelta64(1, "s")
    start = day[np.abs(solar_position(day, LATITUDE, LONGITUDE)[0] - zenith).argmin()]
    time = start + np.arange(samples) * np.timedelta64(1, "s")
    angle, turn = (np.radians(each[0]) for each in solar_position(time, LATITUDE, LONGITUDE))
    sun = np.array([np.sin(angle) * np.sin(turn), np.sin(angle) * np.cos(turn), np.cos(angle)])
    tilt, towards = np.radians(rng.uniform(0.0, most, samples)), rng.uniform(0.0, 2.0 * np.pi, samples)
    normal = np.stack([np.sin(tilt) * np.sin(towards), np.sin(tilt) * np.cos(towards), np.cos(tilt)], axis=-1)
    direct, diffuse = ClearSky(float(np.degrees(angle)), aerosol=aerosol).irradiance(NM)
    if kind == "overcast":
        direct, diffuse = 0.0 * direct, 0.3 * (direct + diffuse) * (NM / 550.0) ** -0.1
    level = np.tile(direct + diffuse, (samples, 1))
    ground = 0.1 * (1.0 - normal[:, 2])
    read = direct * np.clip(normal @ sun, 0.0, None)[:, None] / sun[2]
    read = read + diffuse * share_of_sky(normal, sun, kind)[:, None] + ground[:, None] * level
    read = read * (1.0 + noise * rng.standard_normal(read.shape))
    # nose up leans it backwards, right wing down to the right
    course = np.radians(HEADING)
    forward, right = (
        normal @ (np.sin(course), np.cos(course), 0.0),
        normal @ (np.cos(course), -np.sin(course), 0.0),
    )
    pitch, roll = np.degrees(np.arctan2(-forward, normal[:, 2])), np.degrees(np.arcsin(right))
    pose = {"roll": roll, "pitch": pitch, "heading": np.full(samples, HEADING)}
    place = {"latitude": np.full(samples, LATITUDE), "longitude": np.full(samples, LONGITUDE)}
    attitude = xr.Dataset({name: ("time", values) for name, values in (pose | place).items()}, {"time": time})
    light = xr.DataArray(
        read.astype(np.float32),
        {"irradiance_time": time, "irradiance_wavelength": NM},
        attrs={"units": "W m-2 nm-1"},
    )
    return Leaning(light.to_dataset(name="irradiance"), attitude, level, np.degrees(tilt))
