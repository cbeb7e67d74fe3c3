"""Directions of the clear sky: the project's table, a Monte Carlo of its own, perezsky and CIE type 12."""

import numpy as np
import pytest
from oracles.disort_sky import relative_sky
from oracles.scattered_sky import Air, sky_radiance

from hyperpaint.base.errors import SchemaError
from hyperpaint.light.clear_sky import ClearSky, scattering_cosine, sunward_gain, zenith_radiance
from hyperpaint.light.sky_functions import clear_sky_shares, function_tables, functions_towards

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


def test_a_sun_below_the_horizon_has_no_clear_sky() -> None:
    with pytest.raises(SchemaError, match="value-out-of-range"):
        functions_towards(90.0, 1.0, 0.0)
