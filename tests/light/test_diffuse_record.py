"""What sky a record of irradiance is of: against SPECTRL2 by pvlib, ASTM G173, and clouds over them."""

from typing import Any

import numpy as np
import pytest
import xarray as xr

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError, TimeError
from hyperpaint.light.clear_sky import ClearSky, air_mass
from hyperpaint.light.diffuse_record import SKY_STATES, diffuse_from_record, split_of_lines
from hyperpaint.light.sun import solar_position
from hyperpaint.simulation import simulate_line
from hyperpaint.simulation.atmosphere import Sky

NM = np.arange(390.0, 1021.0)
FINE = NM[:, None] + np.arange(-0.5, 0.5, 0.05)  # lines of the simulator within a channel
BANDS = np.array([450.0, 550.0, 750.0, 850.0])
SAMPLES = 30


def spectrl2(zenith: float, aerosol: float, water: float = 1.5) -> tuple[np.ndarray, np.ndarray]:
    table = pytest.importorskip("pvlib").spectrum.spectrl2(
        apparent_zenith=zenith, aoi=zenith, surface_tilt=0, ground_albedo=0.2, surface_pressure=101325.0,
        relative_airmass=float(air_mass(zenith)), precipitable_water=water, ozone=0.31,
        aerosol_turbidity_500nm=aerosol, dayofyear=94,  # at 1 AU
    )  # fmt: skip
    whole, sky = (np.interp(NM, table["wavelength"], np.ravel(table[name])) for name in ("poa_global", "dhi"))
    return whole - sky, sky


def moments(zenith: float) -> np.ndarray:
    # Return two minutes in which the sun stands at a zenith angle over the equator, at 1 AU
    morning = np.datetime64("2024-04-03T06:00", "ns") + np.arange(0, 6 * 3600, 4).astype("timedelta64[s]")
    start = int(np.abs(solar_position(morning, 0.0, 0.0)[0] - zenith).argmin())
    return morning[start : start + SAMPLES]


def record(light: np.ndarray, time: np.ndarray) -> xr.Dataset:
    light = np.broadcast_to(light, (time.size, NM.size))
    coords = {"irradiance_time": time, "irradiance_wavelength": NM}
    return xr.DataArray(light, coords, attrs={"units": "W m-2 nm-1"}).to_dataset(name="irradiance")


def split(light: np.ndarray, time: np.ndarray, **options: Any) -> xr.Dataset:
    return diffuse_from_record(record(light, time), 0.0, 0.0, wavelength=BANDS, **options)


def words(one: xr.Dataset) -> set[str]:
    return {SKY_STATES[number] for number in one.sky_state.values}


def expect_contradiction(one: xr.Dataset, truth: np.ndarray | None = None) -> None:
    assert words(one) == {"contradictory"}
    assert truth is None or inside(one, truth) == 1.0


def inside(one: xr.Dataset, truth: np.ndarray) -> float:
    # Return how often an interval of 95 % holds the truth
    return float((np.abs(one.diffuse_fraction - truth) < 1.96 * one.diffuse_fraction_u).mean())


@pytest.mark.parametrize("zenith", [25.0, 45.0, 65.0])
@pytest.mark.parametrize(
    ("aerosol", "water", "word"), [(0.03, 0.5, "clear"), (0.1, 3.0, "clear"), (0.45, 1.5, "hazy")]
)
def test_clear_air_of_another_model(zenith: float, aerosol: float, water: float, word: str) -> None:
    direct, sky = spectrl2(zenith, aerosol, water)
    one = split(direct + sky, moments(zenith))
    truth = np.interp(BANDS, NM, sky / (direct + sky))
    assert (words(one), inside(one, truth)) == ({word}, 1.0)
    # a third of the range that skies have, as a clear sky of any aerosol
    assert float(one.diffuse_fraction_u.max()) < 0.2
    # SPECTRL2 has too little blue skylight: against DISORT, by the simulator's reading, the fraction is right
    of_water = Sky(zenith, aerosol=aerosol, water=water / 1.416)
    direct, sky = (part.reshape(NM.size, -1).mean(axis=1) for part in of_water.irradiance(FINE.ravel()))
    one, truth = split(direct + sky, moments(zenith)), np.interp(BANDS, NM, sky / (direct + sky))
    assert (words(one), inside(one, truth)) == ({word}, 1.0)
    assert np.abs(one.diffuse_fraction - truth).max() < 0.1


def test_the_split_of_g173() -> None:
    table = pytest.importorskip("pvlib").spectrum.get_reference_spectra(standard="ASTM G173-03")
    direct = np.interp(NM, table.index, table["direct"].values) * np.cos(np.radians(48.19))
    # its skylight is isotropic, on a slope: that of DISORT for its aerosol, by the simulator's reading
    _, sky = Sky(48.19, aerosol=0.084, ozone=0.344).irradiance(FINE.ravel())
    sky = sky.reshape(NM.size, -1).mean(axis=1)
    one = split(direct + sky, moments(48.19))
    assert (words(one), inside(one, np.interp(BANDS, NM, sky / (direct + sky)))) == ({"clear"}, 1.0)


@pytest.mark.parametrize("level", [0.1, 0.25, 0.5])
def test_overcast(level: float) -> None:
    direct, sky = spectrl2(40.0, 0.1)
    one = split(level * (0.85 + 0.15 * (NM / 490.0) ** -4.0) * (direct + sky), moments(40.0))
    assert words(one) == {"overcast"}
    assert float(one.diffuse_fraction.min()) > 0.97
    assert inside(one, np.ones(4)) == 1.0


def test_broken_cloud_takes_the_sun_and_gives_it_back() -> None:
    direct, sky = spectrl2(40.0, 0.1)
    free = (np.arange(SAMPLES) // 5 % 2).astype(float)[:, None]  # 20 s of sun, 20 s without
    diffuse = 0.6 * sky + 0.12 * (direct + sky)
    one = split(free * direct + diffuse, moments(40.0))
    assert words(one) == {"broken"}
    truth = np.array([np.interp(BANDS, NM, row) for row in diffuse / (free * direct + diffuse)])
    assert inside(one, truth) > 0.95
    # beside the edge of a cloud, the sky next to the receiver may be the other way round
    order = np.arange(SAMPLES) % 10
    inner = (order > 5) & (order < 9) & (np.arange(SAMPLES) < SAMPLES - 1)
    assert float(one.diffuse_fraction_u[inner].max()) < 0.1
    assert float(one.diffuse_fraction_u[~inner].min()) > 0.15


@pytest.mark.parametrize("factor", [0.78, 1.25, 1.6])
def test_a_level_that_no_sky_has_contradicts(factor: float) -> None:
    direct, sky = spectrl2(40.0, 0.1)
    light, truth = factor * (direct + sky), np.interp(BANDS, NM, sky / (direct + sky))
    expect_contradiction(split(light, moments(40.0)), truth)
    # a receiver that is known to be that bad leaves it to colour
    assert inside(split(light, moments(40.0), calibration_uncertainty=0.3), truth) == 1.0


@pytest.mark.parametrize(("true", "clock"), [(60.0, 22.6), (70.0, 30.0), (30.0, 60.0)])
def test_a_clear_sky_under_a_clock_that_is_wrong_contradicts(true: float, clock: float) -> None:
    direct, sky = spectrl2(true, 0.1)
    one = split(direct + sky, moments(clock))
    expect_contradiction(one, np.interp(BANDS, NM, sky / (direct + sky)) if true > clock else None)
    # nothing is said with certainty
    assert float(one.sky_probability.isel(state=slice(0, 4)).max()) < 0.5


def test_thin_cloud_contradicts() -> None:
    direct, sky = spectrl2(40.0, 0.1)
    one = split(0.6 * direct + sky + 0.2 * direct, moments(40.0))
    expect_contradiction(one, np.interp(BANDS, NM, (sky + 0.2 * direct) / (0.8 * direct + sky)))
    assert float(one.diffuse_fraction_u.min()) > 0.08


def test_samples_without_data_and_a_sun_below_the_horizon() -> None:
    light = np.tile(sum(spectrl2(40.0, 0.1)), (SAMPLES, 1))
    light[3] = np.nan
    one = split(light, moments(40.0))
    assert np.isnan(one.diffuse_fraction[3]).all()
    assert np.isfinite(one.diffuse_fraction[4]).all()
    assert int(one.sky_state[3]) == SKY_STATES.index("contradictory")
    expect_contradiction(split(light, moments(40.0) + np.timedelta64(9, "h")))
    unknown = split(np.full(NM.size, np.nan), moments(40.0))
    expect_contradiction(unknown)
    assert np.isnan(unknown.diffuse_fraction).all()


def test_refusals() -> None:
    plain = record(np.ones(NM.size), moments(40.0))
    far = plain.assign_coords(irradiance_wavelength=NM + 1000.0)
    # sorted wrongly, a clear sky would read as broken clouds
    unordered, twice = (plain.isel(irradiance_time=order) for order in ([1, 0, 2], [0, 1, 1]))
    out_of_range = "value-out-of-range"
    for error, match, one, options in (
        (SchemaError, f"latitude .*{out_of_range}", plain, {"latitude": np.nan}),
        (SchemaError, f"calibration_uncertainty=.*{out_of_range}", plain, {"calibration_uncertainty": 0.0}),
        (SchemaError, "irradiance-coverage", far, {}),
        (TimeError, "time-unordered", unordered, {}),
        (TimeError, "time-duplicate", twice, {}),
    ):
        with pytest.raises(error, match=match):
            diffuse_from_record(one, **{"latitude": 0.0, "longitude": 0.0} | options)


def test_lines_have_the_split_of_their_record(no_compute: Any) -> None:
    line = simulate_line(lines=32, bands=40, columns=24)
    with no_compute():
        lazy = split_of_lines(line)
    assert lazy is not None
    assert lazy.diffuse_fraction.dims == ("along_track", "band")
    one = lazy.compute()
    assert {name: one[name].dtype for name in one} == {
        "diffuse_fraction": np.float32, "diffuse_fraction_u": np.float32, "sky_state": np.int8,
    }  # fmt: skip
    assert one.sky_state.attrs["flag_meanings"].split() == list(SKY_STATES)
    assert (one.sky_state == 0).all()
    blue = one.diffuse_fraction.values[:, np.abs(line.wavelength.values - 450.0).argmin()]
    assert blue == pytest.approx(0.23, abs=0.06)
    part = split_of_lines(line.isel(along_track=slice(7, 20)))
    assert part is not None
    xr.testing.assert_identical(part.compute(), one.isel(along_track=slice(7, 20)))
    assert split_of_lines(line.drop_vars("latitude")) is None
    assert hp.light.diffuse_from_record is diffuse_from_record


def test_every_rule_of_skies_counts() -> None:
    # records between two answers: a rule that is doubled or halved moves one of them by more than 0.01
    direct, sky = ClearSky(40.0).irradiance(NM)
    light, hazy = direct + sky, sum(ClearSky(40.0, aerosol=0.27).irradiance(NM))
    ripple, turns = np.sin(NM / 9.0), 2.0 * np.pi * np.arange(SAMPLES)[:, None]
    moving, wavering = 1.0 + 0.04 * np.sin(turns / 45), 0.4 * (1.0 + 0.08 * np.sin(turns / 15))
    # light, zenith angle by the clock, uncertainty of the level; mean probabilities of the states, and ten
    # times the mean uncertainty of the fraction at 550 nm
    cases = {
        "thin": (0.9 * direct + sky, 40.0, 0.05, [0.546, 0.109, 0.0, 0.0, 0.346, 1.495]),
        "rippled": ((1 + 0.03 * ripple) * light, 40.0, 0.05, [0.852, 0.062, 0.0, 0.0, 0.087, 0.821]),
        "torn": ((1 + 0.06 * ripple) * light, 40.0, 0.05, [0.0, 0.0, 0.0, 0.0, 1.0, 0.932]),
        "blue": ((1 - 0.0004 * (NM - 700)) * light, 40.0, 0.05, [0.749, 0.002, 0.0, 0.0, 0.250, 1.384]),
        "hazy": (hazy, 40.0, 0.05, [0.588, 0.320, 0.0, 0.0, 0.092, 1.092]),
        "moving": (moving * light, 40.0, 0.05, [0.679, 0.081, 0.061, 0.0, 0.179, 1.013]),
        "overcast": (wavering * light, 40.0, 0.05, [0.0, 0.0, 0.236, 0.612, 0.152, 1.672]),
        "late": (light, 49.0, 0.05, [0.351, 0.002, 0.0, 0.0, 0.647, 0.883]),
        "later": (light, 51.5, 0.05, [0.017, 0.0, 0.0, 0.0, 0.983, 0.935]),
        "dull": (0.4 * light, 40.0, 0.05, [0.0, 0.0, 0.0, 0.757, 0.243, 0.532]),
        "well known": (light, 40.0, 0.01, [0.886, 0.079, 0.0, 0.0, 0.035, 0.678]),
    }
    for name, (spectra, zenith, level_u, expected) in cases.items():
        one = split(spectra, moments(zenith), calibration_uncertainty=level_u).mean("irradiance_time")
        made = [*one.sky_probability.values, 10.0 * float(one.diffuse_fraction_u[1])]
        np.testing.assert_allclose(made, expected, atol=0.01, err_msg=name)
