"""The clear sky against runs of DISORT, ASTM G173 by pvlib, and other readings of its tables."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from oracles.disort_sky import relative_sky
from oracles.scattered_sky import Air, sky_radiance
from support.refusals import expect_refusals

from hyperpaint.base.errors import SchemaError
from hyperpaint.light.clear_sky import (
    ClearSky,
    dome,
    ozone_mass,
    scattering_cosine,
    sunlight_table,
    sunward_gain,
    zenith_radiance,
)
from hyperpaint.light.sky_functions import clear_sky_shares, function_tables, functions_towards
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


def test_the_oxygen_band_is_that_of_g173(g173: tuple[np.ndarray, np.ndarray]) -> None:
    def depth(spectrum: np.ndarray) -> float:
        left, band, right = seen(spectrum, np.array([750.0, 761.0, 780.0]))
        return float(1.0 - band / (left + (right - left) * 11.0 / 30.0))

    assert depth(g173[1]) == pytest.approx(0.49, abs=0.02)
    assert depth(Sky(AIR_MASS_OF_G173).irradiance(FINE)[0]) == pytest.approx(0.49, abs=0.03)


def test_lines_leave_every_nanometre_its_light(g173: tuple[np.ndarray, np.ndarray]) -> None:
    # The simulator's lines are finer than the table, and add nothing to it
    cell = round(1.0 / GRID_STEP)
    lines = solar_irradiance(FINE)
    channels = np.arange(380.0, 1020.0)
    np.testing.assert_allclose(seen(lines, channels), seen(g173[0], channels), rtol=0.02)
    inside = lines[(FINE > 500.0) & (FINE < 540.0)][: 39 * cell].reshape(-1, cell)
    assert np.median(inside.std(axis=1) / inside.mean(axis=1)) > 0.02


def test_fresh_runs_of_disort(shared_data: Path) -> None:
    # 22 values of uvspec and of the tables' reader; both see the same gases
    with (shared_data / "sky_disort/check_values.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 22
    for row in rows:
        nm, sun, aerosol, angstrom, albedo, _, ground, pressure = (
            float(text or 0.0) for text in list(row.values())[1:9]
        )
        sky = ClearSky(
            sun,
            aerosol * (500.0 / 550.0) ** -angstrom,
            angstrom,
            pressure=pressure,
            ground=ground,
            model="humid" if albedo > 0.95 else "rural",
        )
        wavelength, name = np.array([nm]), row["quantity"]
        if name.startswith("sky_radiance"):
            zenith, azimuth = (np.radians(float(row[key])) for key in list(row)[9:11])
            found = sky.radiance(wavelength, np.cos(zenith), azimuth)[0]
        elif name == "spherical_albedo":
            # from the light that a white ground adds to the sky of a black one
            (direct, black), (_, white) = (
                replace(sky, ground=ground).transmittances(wavelength) for ground in (0.0, 1.0)
            )
            share = (white - black) / (direct + black)
            found = (share / (1.0 + share))[0]
        else:
            parts = sky.gases if name.startswith("gas") else sky.transmittances
            found = parts(wavelength)["diffuse" in name][0]
        assert found == pytest.approx(float(row["reference_reader"]), rel=2e-4), row
        if row["uvspec"]:
            within = 0.008 if name.startswith("sky_radiance") else 1e-3
            assert found == pytest.approx(float(row["uvspec"]), rel=within), row


def test_diffuse_fraction_of_the_tables_and_the_sky_mirrored_on_black_paint(shared_data: Path) -> None:
    # Fractions within 0.003 of DISORT, where the file's single-scattering albedo is near that of the tables
    with (shared_data / "sky_disort/today_vs_disort.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    compared = 0
    for row in rows:
        if row["quantity"] != "diffuse_fraction":
            continue
        sun, nm = float(row["sun_zenith_degree"]), float(row["wavelength_nm"])
        if sun <= 82.0 and nm < 700.0:
            found = diffuse_fraction([nm], sun)[0]
            assert found == pytest.approx(float(row["table"]), abs=0.003), row
            compared += 1
    assert compared > 35
    # What a coat of 4 % mirrors of the zenith, with fraction and radiance of DISORT; five suns, four bands
    fractions = {
        (row["sun_zenith_degree"], row["wavelength_nm"]): float(row["table"])
        for row in rows
        if row["quantity"] == "diffuse_fraction"
    }
    zeniths = [row for row in rows if row["quantity"] == "relative_radiance" and row["where"] == "zenith"]
    assert len(zeniths) >= 20
    for row in zeniths:
        place = row["sun_zenith_degree"], row["wavelength_nm"]
        sun, nm = float(place[0]), [float(place[1])]
        if place in fractions:
            ours = 0.04 * diffuse_fraction(nm, sun) * zenith_radiance(nm, sun)
            assert ours[0] == pytest.approx(0.04 * fractions[place] * float(row["table"]), abs=5e-4), row


@pytest.mark.parametrize("sun", [3.0, 33.0, 63.0, 79.0, 85.0])
def test_another_reading_of_the_tables(sun: float) -> None:
    sky = dome()
    for nm in (411.0, 555.0, 873.0):
        theirs = relative_sky(nm, sun, sky.cosine, sky.azimuth)
        ours = ClearSky(sun).relative_radiance(np.array([nm]), sky.cosine, sky.azimuth)[0]
        assert np.sqrt((sky.level * (ours / theirs - 1.0) ** 2).sum()) < 1.5e-3
        # all light of the sky is the diffuse irradiance
        assert (sky.level * ours).sum() == pytest.approx(1.0, abs=2e-3 if sun < 80.0 else 6e-3)


def test_direct_and_circumsolar_light_of_g173() -> None:
    # ASTM G173: air mass 1.5, within 2.9 degrees of the sun; windows between bands of gases. The exponent of
    # its aerosol is 0.93 below 500 nm and about 1.14 above
    table = pytest.importorskip("pvlib").spectrum.get_reference_spectra(standard="ASTM G173-03")
    windows = [(410, 425), (440, 455), (465, 480), (495, 510), (520, 540), (550, 570), (605, 620), (660, 680),
               (740, 755)]  # fmt: skip
    for low, high in windows:
        nm = np.arange(low, high + 1.0)
        sky = ClearSky(48.236, 0.084, 0.93 if high < 500 else 1.14, ozone=0.344)
        direct, _ = sky.irradiance(nm)
        direct = direct / np.cos(np.radians(48.236))
        # the cone around the sun: rings of directions in the sun's plane and across it
        angle, around = np.meshgrid(np.radians(np.arange(0.1, 2.9, 0.2)), np.arange(16) * np.pi / 8)
        zenith = np.radians(48.236) + angle * np.cos(around)
        azimuth = angle * np.sin(around) / np.sin(np.radians(48.236))
        radiance = sky.radiance(nm, np.cos(zenith), azimuth)
        solid = np.sin(angle) * np.radians(0.2) * np.pi / 8
        above = np.interp(nm, sunlight_table().wavelength, sunlight_table().extraterrestrial)
        circumsolar = above * (radiance * solid).sum(axis=(1, 2)) * sky.gases(nm)[0]
        standard = np.interp(nm, table.index.values, table.direct.values)
        assert (direct + circumsolar).sum() == pytest.approx(standard.sum(), rel=0.005), (low, high)


@pytest.mark.parametrize("zenith", [20.0, 60.0, 75.0])
def test_the_simulator_reads_the_same_sky(zenith: float) -> None:
    # Lines of the simulator have, in bands of 5 nm, the light of the chain's cells of 1 nm
    cells = np.arange(345.0, 1055.0)
    channels = np.arange(380.0, 1000.1, 5.0)
    for ours, theirs in zip(ClearSky(zenith).irradiance(cells), Sky(zenith).irradiance(FINE), strict=True):
        of_cells = convolve_gaussian(ours[None], cells, channels, 5.0)[0]
        ratio = seen(theirs, channels) / of_cells - 1.0
        assert np.sqrt(np.mean(ratio**2)) < 0.008
        # at the floor of the water band a cell of 1 nm is too coarse
        assert np.abs(ratio[(channels < 925.0) | (channels > 950.0)]).max() < 0.03


def test_the_layer_of_ozone_is_high_and_the_table_has_the_suns_power() -> None:
    assert ozone_mass(0.0) == pytest.approx(1.0, abs=1e-4)
    assert ozone_mass(85.0) < relative_air_mass(85.0)
    table = sunlight_table()
    # 280-2500 nm of the standard hold 1319 W m-2, of which 1307 beyond 300 nm
    assert np.trapezoid(table.extraterrestrial, table.wavelength) == pytest.approx(1307.0, rel=0.01)
    expect_refusals(
        (SchemaError, "value-out-of-range", lambda: ClearSky().irradiance(np.array([250.0, 400.0]))),
        (SchemaError, "value-out-of-range", lambda: ClearSky(91.0)),
        (SchemaError, "value-out-of-range", lambda: functions_towards(90.0, 1.0, 0.0)),
    )


def test_bands_saturate_water_counts_and_oxygen_follows_the_air() -> None:
    nm = np.array([723.0, 762.0, 942.0])
    few, many = (sum(ClearSky(30.0, water=water).irradiance(nm)) for water in (0.2, 2.0))
    assert (many[[0, 2]] < few[[0, 2]]).all()
    assert many[1] == pytest.approx(few[1], rel=1e-9)
    # one camera sees less than four times the depth of four air masses
    shallow, deep = (
        -np.log(np.divide(*seen(Sky(sun).irradiance(FINE)[0], np.array([762.0, 754.0]))))
        for sun in (0.0, 76.0)
    )
    assert 1.3 * shallow < deep < 3.2 * shallow
    # saturated lines absorb with the root of column times width: both are proportional to the pressure
    oxygen = np.arange(740.0, 790.1, 0.1)
    depths = []
    for pressure in (70_000.0, 101_325.0):
        direct, _ = ClearSky(40.0, pressure=pressure).irradiance(oxygen)
        smooth = convolve_gaussian(direct[None], oxygen, np.array([752.0, 761.5, 776.0]), 3.0)[0]
        depths.append(-np.log(smooth[1] / np.sqrt(smooth[0] * smooth[2])))
    assert 0.45 < depths[0] / depths[1] < 0.9


# --- Directions of the clear sky: the project's table, a Monte Carlo of its own, perezsky and CIE type 12


#: Sun zenith -> radiance at the zenith over that of a uniform sky, at 450, 550 and 850 nm: project notes.
TABLE = {25.0: (0.99, 1.04, 1.18), 60.0: (0.53, 0.44, 0.34), 82.0: (0.51, 0.39, 0.26)}
COSINE, AZIMUTH = np.meshgrid((np.arange(100) + 0.5) / 100, (np.arange(60) + 0.5) / 60 * np.pi, indexing="ij")
LEVEL = COSINE / COSINE.sum()


def sky(nm: list[float], sun: float, cosine: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    # Return the sky of the package over a uniform one, as the renderer has it (band, ...)
    functions = functions_towards(sun, cosine, azimuth)
    return np.tensordot(clear_sky_shares(nm, sun).T, functions, 1)


def visual_sky(sun: float) -> tuple[np.ndarray, float]:
    # Return the luminance of the sky over its mean, of all directions and at the zenith
    nm = np.arange(400.0, 700.0, 10.0)
    weight = ClearSky(sun).irradiance(nm)[1] * np.exp(-0.5 * ((nm - 556.0) / 42.0) ** 2)
    weight /= weight.sum()
    everywhere = np.tensordot(weight, ClearSky(sun).relative_radiance(nm, COSINE, AZIMUTH), 1)
    return everywhere, float(weight @ zenith_radiance(nm, sun))


@pytest.mark.parametrize("sun", TABLE)
def test_the_zenith_is_that_of_the_table(sun: float) -> None:
    np.testing.assert_allclose(zenith_radiance([450.0, 550.0, 850.0], sun), TABLE[sun], rtol=0.07)


@pytest.mark.parametrize("sun", [0.0, 8.0, 33.0, 60.0, 79.0, 88.0])
def test_functions_have_the_light_of_a_uniform_sky(sun: float) -> None:
    for function in functions_towards(sun, COSINE, AZIMUTH):
        assert (LEVEL * function).sum() == pytest.approx(1.0, abs=2e-3)
    shares = clear_sky_shares(np.arange(350.0, 1100.0, 50.0), sun, 0.17)
    np.testing.assert_allclose(shares.sum(axis=0), 1.0, rtol=1e-12)
    assert np.abs(shares).max() < 6.0  # so that noise is not amplified much
    # the tables of the renderer, and half a step beside their nodes
    tables = function_tables(sun)
    assert tables.min() > 0.1
    zenith, azimuth = (
        np.radians(0.5 * (a[1:] + a[:-1])) for a in (np.arange(0, 84.1, 1.5), np.arange(0, 181, 3))
    )
    middle = 0.25 * (tables[:, :-1, :-1] + tables[:, 1:, :-1] + tables[:, :-1, 1:] + tables[:, 1:, 1:])
    exact = functions_towards(sun, np.cos(zenith)[:, None], azimuth)[1:]
    np.testing.assert_allclose(middle[:, : zenith.size], exact, rtol=0.01)


@pytest.mark.parametrize(("sun", "within"), [(20.0, 0.005), (45.0, 0.01), (60.0, 0.015), (78.0, 0.025)])
def test_sums_of_functions_are_the_sky_of_the_tables(sun: float, within: float) -> None:
    # Against radiances by another interpolation, rms of level light, and at the zenith
    waves = [400.0, 480.0, 560.0, 660.0, 780.0, 900.0, 1000.0]
    everywhere, zeniths = sky(waves, sun, COSINE, AZIMUTH), sky(waves, sun, np.array(1.0), np.array(0.0))
    for nm, ours, zenith in zip(waves, everywhere, zeniths, strict=True):
        theirs = relative_sky(nm, sun, COSINE, AZIMUTH)
        assert np.sqrt((LEVEL * (ours / theirs - 1.0) ** 2).sum()) < within
        above = float(relative_sky(nm, sun, np.array(1.0), np.array(0.0)))
        assert zenith == pytest.approx(above, rel=0.02)
        assert zenith_radiance([nm], sun)[0] == pytest.approx(above, rel=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("sun", [33.0, 55.0, 73.0, 82.0])
def test_the_whole_sky_is_that_of_the_monte_carlo(sun: float) -> None:
    # At suns and wavelengths between those of the fit
    for nm in (430.0, 620.0, 900.0):
        truth = sky_radiance(nm, sun, photons=6000)
        cosine, azimuth = np.meshgrid(truth.cosine, truth.azimuth, indexing="ij")
        assert np.sqrt(truth.mean((sky([nm], sun, cosine, azimuth)[0] / truth.relative - 1.0) ** 2)) < 0.06
        assert truth.mean(np.abs(1.0 / truth.relative - 1.0)) > 0.2  # what a uniform sky is off
        assert zenith_radiance([nm], sun)[0] == pytest.approx(truth.zenith, rel=0.06)


@pytest.mark.slow
@pytest.mark.parametrize(("aerosol", "within"), [(0.03, 0.15), (0.25, 0.12)])
def test_other_aerosol_is_worse_known(aerosol: float, within: float) -> None:
    truth = sky_radiance(700.0, 55.0, Air(aerosol=aerosol), photons=6000)
    assert zenith_radiance([700.0], 55.0, aerosol)[0] == pytest.approx(truth.zenith, rel=within)


@pytest.mark.slow
def test_the_monte_carlo_has_the_diffuse_light_of_spectrl2() -> None:
    # The oracle itself, against a model that knows nothing of directions
    pvlib = pytest.importorskip("pvlib")
    for sun in (25.0, 60.0):
        table = pvlib.spectrum.spectrl2(
            apparent_zenith=sun, aoi=sun, surface_tilt=0, ground_albedo=0.15, surface_pressure=101325.0,
            relative_airmass=1.0 / np.cos(np.radians(sun)), precipitable_water=0.0, ozone=0.0,
            aerosol_turbidity_500nm=0.1, dayofyear=94,
        )  # fmt: skip
        share = np.ravel(table["dhi"]) / np.ravel(table["dni_extra"])
        for nm in (450.0, 550.0, 870.0):
            ours = sky_radiance(nm, sun, photons=3000, zeniths=16, azimuths=16).diffuse
            assert ours == pytest.approx(np.interp(nm, table["wavelength"], share), rel=0.1)


@pytest.mark.parametrize("sun", [45.0, 60.0, 75.0])
def test_perezsky_means_the_same_sky(sun: float) -> None:
    perezsky = pytest.importorskip("perezsky")
    direct, diffuse = (5.0 * part.sum() for part in ClearSky(sun).irradiance(np.arange(300.0, 2500.0, 5.0)))
    state = perezsky.perez_parameters(direct / np.cos(np.radians(sun)), diffuse, sun)
    zenith = np.degrees(np.arccos(COSINE))
    from_sun = np.degrees(np.arccos(scattering_cosine(COSINE, AZIMUTH, sun).clip(-1.0, 1.0)))
    theirs = perezsky.relative_luminance(state, zenith.ravel(), from_sun.ravel()[:, None])[:, 0]
    theirs = theirs.reshape(zenith.shape)
    mean = (LEVEL * theirs).sum()
    above = perezsky.relative_luminance(state, np.zeros(1), np.full((1, 1), sun))[0, 0]
    ours, our_zenith = visual_sky(sun)
    assert our_zenith == pytest.approx(above / mean, rel=0.07)
    apart = np.sqrt((LEVEL * (ours * mean / theirs - 1.0) ** 2).sum())
    assert apart < 0.2 < 4.0 * apart < np.sqrt((LEVEL * (mean / theirs - 1.0) ** 2).sum())


@pytest.mark.parametrize("sun", [45.0, 60.0, 75.0])
def test_cie_type_12_is_near(sun: float) -> None:
    def relative(cosine: np.ndarray, angle: np.ndarray) -> np.ndarray:
        around = 1.0 + 10.0 * (np.exp(-3.0 * angle) - np.exp(-1.5 * np.pi)) + 0.45 * np.cos(angle) ** 2
        return np.asarray(around * (1.0 - np.exp(-0.32 / cosine)))

    cie = relative(COSINE, np.arccos(scattering_cosine(COSINE, AZIMUTH, sun).clip(-1.0, 1.0)))
    ours, _ = visual_sky(sun)
    assert np.sqrt((LEVEL * (ours * (LEVEL * cie).sum() / cie - 1.0) ** 2).sum()) < 0.15


@pytest.mark.parametrize("sun", [10.0, 45.0, 70.0])
def test_a_panel_that_leans_to_the_sun_gets_more_sky(sun: float) -> None:
    lean, nm = np.radians(1.0), np.array([450.0, 850.0])
    for k, wave in enumerate(nm):
        radiance = relative_sky(wave, sun, COSINE, AZIMUTH)
        sine = np.sqrt(1.0 - COSINE**2)
        gains = []
        for side in (1.0, -1.0):
            seen = COSINE * np.cos(lean) + side * np.sin(lean) * sine * np.cos(AZIMUTH)
            gains.append((radiance * np.maximum(seen, 0.0)).sum() / (radiance * COSINE).sum())
        slope = (gains[0] - gains[1]) / (2.0 * np.sin(lean) * np.tan(np.radians(sun)))
        assert sunward_gain(nm, sun)[k] == pytest.approx(slope, rel=0.025)
