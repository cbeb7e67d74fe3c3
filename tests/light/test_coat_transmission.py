"""What a clear coat lets through: Fresnel's equations, a Monte Carlo's sky, the renderer's coat."""

import numpy as np
import pytest
from oracles.disort_sky import relative_sky
from oracles.fresnel import plain_fresnel
from oracles.scattered_sky import sky_radiance

from hyperpaint.light.coat_transmission import interface_reflectance, sky_reflectance, transmitted_share
from hyperpaint.light.sun import diffuse_fraction
from hyperpaint.simulation.rendering.materials import (
    base_albedo,
    coated_reflectance,
    fresnel_reflectance,
    hemispherical_reflectance,
    internal_reflectance,
)


@pytest.mark.parametrize("index", [1.47, 1.5, 1.55])
def test_the_interface_is_fresnels(index: float) -> None:
    for angle in (5.0, 30.0, 56.0, 75.0, 88.0):
        assert interface_reflectance(angle, index) == pytest.approx(
            plain_fresnel(np.radians(angle), index), rel=1e-9
        )
    assert interface_reflectance(0.0, index) == pytest.approx(((index - 1.0) / (index + 1.0)) ** 2)
    assert sky_reflectance([550.0], None, index=index) == pytest.approx(
        hemispherical_reflectance(index), abs=2e-5
    )
    # CIE: radiance over that of the mean, 3 (1 + 2 cos) / 7
    cosine = (np.arange(20_000) + 0.5) / 20_000
    overcast = np.sum(fresnel_reflectance(cosine, index) * cosine * (1 + 2 * cosine)) / np.sum(
        cosine * (1 + 2 * cosine)
    )
    assert sky_reflectance([550.0], 40.0, 1.0, index) == pytest.approx(overcast, abs=2e-5)


@pytest.mark.slow
@pytest.mark.parametrize("sun", [25.0, 60.0, 75.0])
def test_a_clear_sky_loses_more_than_a_uniform_one(sun: float) -> None:
    for nm in (450.0, 850.0):
        sky = sky_radiance(nm, sun, photons=2500, zeniths=20, azimuths=12)
        truth = sky.mean(sky.relative * fresnel_reflectance(sky.cosine)[:, None])
        assert sky_reflectance([nm], sun) == pytest.approx(truth, rel=0.08)
        assert truth > hemispherical_reflectance()


@pytest.mark.parametrize("albedo", [0.05, 0.5, 0.95])
def test_returns_inside_the_coat_are_common_to_all_geometries(albedo: float) -> None:
    # The renderer's coat with all its returns, over its near-normal factor, is C for any body
    near = float(coated_reflectance(np.array([albedo]))[0])
    body = float(base_albedo(np.array([near]))[0])
    assert body == pytest.approx(albedo)
    for sun, f in ((0.0, 0.1), (60.0, 0.12), (75.0, 0.3)):
        into = (1 - f) * (1 - fresnel_reflectance(np.cos(np.radians(sun)))) + f * (
            1 - hemispherical_reflectance()
        )
        out = 0.96 / 1.5**2 * body / (1.0 - body * internal_reflectance())
        ratio = transmitted_share(np.array([f]), sky_reflectance([550.0], None), sun)
        assert float(into * out / near) == pytest.approx(float(ratio[0]), rel=1e-4)


@pytest.mark.parametrize("sun", [0.0, 45.0, 60.0, 75.0])
def test_the_share_under_another_reading_of_the_sky(sun: float) -> None:
    # Sums over a degree's steps of the tables' sky by splines, with Fresnel by Snell's law
    zenith, azimuth = np.meshgrid(np.radians(np.arange(0.5, 90.0)), np.radians(np.arange(1.0, 180.0, 2.0)))
    weight = np.cos(zenith) * np.sin(zenith)
    lost = plain_fresnel(zenith, 1.5)
    entering = 1.0 - plain_fresnel(np.radians(sun), 1.5)
    for nm in (450.0, 600.0, 850.0):
        sky = weight * relative_sky(nm, sun, np.cos(zenith), azimuth)
        of_sky = float((sky * lost).sum() / sky.sum())
        assert sky_reflectance([nm], sun)[0] == pytest.approx(of_sky, rel=3e-3)
        f = diffuse_fraction([nm], sun)
        expected = ((1.0 - f) * entering + f * (1.0 - of_sky)) / 0.96
        np.testing.assert_allclose(transmitted_share(f, sky_reflectance([nm], sun), sun), expected, rtol=3e-4)
