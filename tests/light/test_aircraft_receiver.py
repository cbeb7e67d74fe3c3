"""Light sensors on the aircraft: what they read when they lean, and what a level one would have read."""

from typing import NamedTuple

import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_error

from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import PaintWarning, SchemaError
from hyperpaint.light import level_irradiance
from hyperpaint.light.clear_sky import ClearSky
from hyperpaint.light.sun import solar_position

# --- Light sensors that lean under the skies of the CIE: plain numpy, but for the spectra of beam and sky


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


# --- tests


def errors(flown: Leaning, record: xr.Dataset) -> np.ndarray:
    # Return departures from a level sensor (sample, interval of 50 nm)
    off = record.irradiance.values / flown.level - 1.0
    return off[:, :300].reshape(len(off), 12, 25).mean(axis=-1)


def test_under_a_closed_cloud_and_a_low_sun_nothing_is_corrected() -> None:
    for zenith in (30.0, 70.0):
        flown = leaning(zenith, seed=62, kind="overcast")
        level = level_irradiance(flown.record, flown.attitude)
        np.testing.assert_array_equal(level.irradiance, flown.record.irradiance)
        assert "overcast" in level.attrs["irradiance_mount"]
    flown = leaning(82.0, seed=68)
    with pytest.warns(PaintWarning, match="sun-low"):
        level = level_irradiance(flown.record, flown.attitude)
    np.testing.assert_array_equal(level.irradiance, flown.record.irradiance)


def test_a_sensor_that_is_level_or_mounted_askew() -> None:
    flown = leaning(50.0, seed=65, most=0.0)
    level = level_irradiance(flown.record, flown.attitude)
    np.testing.assert_allclose(level.irradiance, flown.record.irradiance, rtol=1e-6)
    expected = level_irradiance(flown.record, flown.attitude.assign(roll=flown.attitude["roll"] + 4.0))
    mounted = level_irradiance(flown.record, flown.attitude, mounting=(4.0, 0.0, 0.0))
    np.testing.assert_allclose(mounted.irradiance, expected.irradiance, rtol=1e-6)
    np.testing.assert_allclose(mounted.irradiance_tilt, 4.0, atol=1e-4)
    expect_error(SchemaError, "record-already-levelled", lambda: level_irradiance(level, flown.attitude))


@pytest.mark.parametrize("aerosol", [0.05, 0.15])
@pytest.mark.parametrize(("zenith", "as_read"), [(30.0, 0.08), (50.0, 0.15), (60.0, 0.2), (70.0, 0.3)])
def test_under_a_clear_sky_it_is_as_good_as_level(zenith: float, as_read: float, aerosol: float) -> None:
    flown = leaning(zenith, seed=61, aerosol=aerosol)
    level = level_irradiance(flown.record, flown.attitude)
    assert np.abs(errors(flown, flown.record)).max() > as_read
    off = np.abs(errors(flown, level))
    assert np.sqrt((off**2).mean()) < 0.002
    assert off.max() < 0.01
    np.testing.assert_allclose(level.irradiance_tilt, flown.tilt, atol=0.01)
    assert level.attrs["irradiance_mount"] == "aircraft, corrected to level: clear"


def test_angles_are_what_the_convention_says() -> None:
    flown = leaning(50.0, seed=64)
    expected = level_irradiance(flown.record, flown.attitude).irradiance
    turned = Convention(roll_positive="right_wing_up", pitch_positive="nose_down", angle_unit="radian")
    attitude = flown.attitude.assign_attrs(turned.to_attrs())
    attitude["roll"], attitude["pitch"] = -np.radians(attitude["roll"]), -np.radians(attitude["pitch"])
    attitude["heading"] = np.radians(attitude["heading"])
    np.testing.assert_allclose(level_irradiance(flown.record, attitude).irradiance, expected, rtol=1e-6)


def test_the_response_of_a_receptor() -> None:
    flown = leaning(60.0, seed=66, most=0.0, noise=0.0)
    incidence = np.arange(0.0, 91.0)
    response = xr.DataArray(
        1.0 - 0.1 * (incidence / 90.0) ** 2, dims="incidence", coords={"incidence": incidence}
    )
    direct, diffuse = ClearSky(60.0, aerosol=0.1).irradiance(NM)
    beam = 1.0 - 0.1 * (60.0 / 90.0) ** 2
    of_sky = np.average(response.values, weights=np.sin(np.radians(2.0 * incidence)))
    share = (beam * direct + of_sky * diffuse) / (direct + diffuse)
    read = flown.record.assign(irradiance=(flown.record.irradiance * share).assign_attrs(units="W m-2 nm-1"))
    level = level_irradiance(read, flown.attitude, cosine_response=response)
    assert np.abs(errors(flown, read)).max() > 0.03
    assert np.abs(errors(flown, level)).max() < 0.003


def test_samples_without_an_attitude_single_ones_and_what_is_missing() -> None:
    flown = leaning(50.0, seed=67)
    attitude = flown.attitude.isel(time=slice(10, 30))
    with pytest.warns(PaintWarning, match="20 of 40 .*attitude-missing"):
        level = level_irradiance(flown.record, attitude)
    known = np.isfinite(level.irradiance).all("irradiance_wavelength").values
    np.testing.assert_array_equal(known[:30], np.arange(30) >= 10)
    expect_error(
        SchemaError,
        "attitude-missing",
        lambda: level_irradiance(flown.record, attitude.assign(roll=attitude["roll"] * np.nan)),
    )
    # what is missing is listed
    short = leaning(50.0, seed=69, samples=4)
    error = expect_error(
        SchemaError,
        "no roll, latitude",
        lambda: level_irradiance(
            short.record, short.attitude.drop_vars(["roll", "latitude"]), mounting=(0.0, np.nan, 0.0),
            ground_reflectance=2.0, cosine_response=xr.DataArray([1.0]),
        ),
    )  # fmt: skip
    codes = ("variable-missing", "angles-unreadable", "value-out-of-range", "coordinate-missing")
    assert error.codes == codes
    # one sample is enough
    single = leaning(40.0, seed=70, samples=1)
    level = level_irradiance(single.record, single.attitude)
    assert np.abs(errors(single, level)).max() < 0.01
