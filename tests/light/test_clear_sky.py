"""The level of the clear sky against ASTM G173 and SPECTRL2, by pvlib."""

from typing import Any

import numpy as np
import pytest
from support.refusals import expect_refusals

from hyperpaint.base.errors import SchemaError
from hyperpaint.light.sky_functions import ClearSky, ozone_mass, sunlight_table
from hyperpaint.light.sun import diffuse_fraction
from hyperpaint.simulation.atmosphere import (
    GRID_STEP,
    Sky,
    relative_air_mass,
    solar_irradiance,
    spectral_grid,
)
from hyperpaint.simulation.camera import convolve_gaussian

FINE = spectral_grid(350.0, 1050.0)
CHANNELS = np.arange(400.0, 1000.1, 5.0)
AIR_MASS_OF_G173 = 48.19  # degree: 1.5


@pytest.fixture(scope="module")
def g173() -> tuple[np.ndarray, np.ndarray]:
    # Return extraterrestrial and direct irradiance of the standard on the fine grid
    table = pytest.importorskip("pvlib").spectrum.get_reference_spectra(standard="ASTM G173-03")
    nm = table.index.values
    return np.interp(FINE, nm, table.extraterrestrial.values), np.interp(FINE, nm, table.direct.values)


def seen(spectrum: np.ndarray, channels: np.ndarray = CHANNELS, fwhm: float = 5.0) -> np.ndarray:
    return convolve_gaussian(spectrum[None], FINE, channels, fwhm)[0]


def direct_normal_of_g173() -> np.ndarray:
    direct, _ = Sky(AIR_MASS_OF_G173, aerosol=0.084, ozone=0.344, airmass=1.5).irradiance(FINE)
    return direct / np.cos(np.radians(AIR_MASS_OF_G173))


def spectrl2(zenith: float) -> dict[str, Any]:
    return pytest.importorskip("pvlib").spectrum.spectrl2(
        apparent_zenith=zenith, aoi=zenith, surface_tilt=0, ground_albedo=0.2, surface_pressure=101325.0,
        relative_airmass=relative_air_mass(zenith), precipitable_water=1.416, ozone=0.31,
        aerosol_turbidity_500nm=0.1, dayofyear=94,  # at 1 AU
    )  # fmt: skip


def test_the_direct_beam_is_that_of_g173(g173: tuple[np.ndarray, np.ndarray]) -> None:
    ours, theirs = direct_normal_of_g173(), g173[1]
    ratio = seen(ours) / seen(theirs) - 1.0
    assert np.sqrt(np.mean(ratio**2)) < 0.03
    assert np.abs(ratio).max() < 0.05

    def depth(spectrum: np.ndarray) -> float:
        left, band, right = seen(spectrum, np.array([750.0, 761.0, 780.0]))
        return float(1.0 - band / (left + (right - left) * 11.0 / 30.0))

    # the band of oxygen
    assert depth(theirs) == pytest.approx(0.49, abs=0.02)
    assert depth(ours) == pytest.approx(depth(theirs), abs=0.02)


def test_lines_leave_every_nanometre_its_light(g173: tuple[np.ndarray, np.ndarray]) -> None:
    # The simulator's lines are finer than the table, and add nothing to it
    cell = round(1.0 / GRID_STEP)
    lines = solar_irradiance(FINE)
    channels = np.arange(380.0, 1020.0)
    np.testing.assert_allclose(seen(lines, channels), seen(g173[0], channels), rtol=0.02)
    inside = lines[(FINE > 500.0) & (FINE < 540.0)][: 39 * cell].reshape(-1, cell)
    assert np.median(inside.std(axis=1) / inside.mean(axis=1)) > 0.02


@pytest.mark.parametrize(("zenith", "within"), [(25.0, 0.05), (60.0, 0.05), (82.0, 0.10)])
def test_global_and_diffuse_light_are_those_of_spectrl2(zenith: float, within: float) -> None:
    theirs = spectrl2(zenith)
    direct, diffuse = Sky(zenith, airmass=relative_air_mass(zenith)).irradiance(FINE)

    def at(name: str, channels: np.ndarray) -> np.ndarray:
        return np.interp(channels, theirs["wavelength"], np.ravel(theirs[name]))

    ends = np.array([450.0, 850.0])
    blue, red = seen(direct + diffuse, ends, 10.0)
    expected = at("poa_global", ends)
    assert red / blue == pytest.approx(expected[1] / expected[0], rel=0.05)
    assert np.trapezoid(seen(diffuse)) == pytest.approx(np.trapezoid(at("dhi", CHANNELS)), rel=within)
    # outside the bands, which SPECTRL2 has in steps of 10 nm, and the steps of its sun in the violet
    clear = np.array([460.0, 490.0, 520.0, 550.0, 610.0, 670.0, 780.0, 860.0, 880.0])
    np.testing.assert_allclose(seen(diffuse, clear), at("dhi", clear), rtol=0.05)


def test_the_chain_means_the_same_sky() -> None:
    nm = np.array([450.0, 550.0, 850.0])
    direct, diffuse = ClearSky(53.0).irradiance(nm)
    np.testing.assert_allclose(diffuse / (direct + diffuse), diffuse_fraction(nm, 53.0), rtol=1e-12)


def test_the_layer_of_ozone_is_high_and_the_table_has_the_suns_power() -> None:
    assert ozone_mass(0.0) == pytest.approx(1.0, abs=1e-4)
    assert ozone_mass(85.0) < relative_air_mass(85.0)
    table = sunlight_table()
    # 280-2500 nm of the standard hold 1319 W m-2, of which 1307 beyond 300 nm
    assert np.trapezoid(table.extraterrestrial, table.wavelength) == pytest.approx(1307.0, rel=0.01)
    expect_refusals(
        (SchemaError, "value-out-of-range", lambda: ClearSky().irradiance(np.array([250.0, 400.0]))),
        (SchemaError, "value-out-of-range", lambda: ClearSky(91.0)),
    )


def test_bands_saturate_and_water_counts() -> None:
    nm = np.array([723.0, 762.0, 942.0])
    few, many = (sum(ClearSky(30.0, water=water).irradiance(nm)) for water in (0.2, 2.0))
    assert (many[[0, 2]] < few[[0, 2]]).all()
    assert many[1] == pytest.approx(few[1], rel=1e-12)
    # one camera sees less than four times the depth of four air masses
    shallow, deep = (
        -np.log(np.divide(*seen(sum(Sky(10.0, airmass=mass).irradiance(FINE)), np.array([762.0, 754.0]))))
        for mass in (1.0, 4.0)
    )
    assert 1.3 * shallow < deep < 3.2 * shallow
