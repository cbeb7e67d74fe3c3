"""Corrections of mirrored sky and of light against foreign skies: a Monte Carlo, and CIE's."""

from typing import Any

import numpy as np
import pytest
import xarray as xr
from oracles.scattered_sky import Air, SkyRadiance, rayleigh_depth, sky_radiance
from support.refusals import expect_refusals

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError
from hyperpaint.light.clear_sky import facing_gain

NM = np.array([410.0, 450.0, 550.0, 700.0, 850.0, 980.0])
SUNS = (30.0, 45.0, 60.0, 75.0)
BLACK = 0.013
COAT = 0.04  # reflectance of a coat of 1.5 at normal incidence
ROOF_LEAN = np.radians(4.0)  # of a roof's parts; what they mirror is twice as far from the zenith

_skies: dict[tuple[float, float], SkyRadiance] = {}


def truth(nm: float, sun: float) -> SkyRadiance:
    if (nm, sun) not in _skies:
        _skies[nm, sun] = sky_radiance(nm, sun, photons=1500, zeniths=20, azimuths=20)
    return _skies[nm, sun]


def diffuse_share(nm: float, sun: float) -> float:
    # Return diffuse over global light of the Monte Carlo's air
    air, cosine = Air(), np.cos(np.radians(sun))
    direct = cosine * np.exp(-(rayleigh_depth(nm) + air.aerosol * (nm / 500.0) ** -air.angstrom) / cosine)
    diffuse = truth(nm, sun).diffuse
    return float(diffuse / (diffuse + direct))


def near_zenith(sky: SkyRadiance) -> float:
    # Return what a slightly arched roof mirrors: the mean of the sky within twice its lean
    inside = sky.cosine > np.cos(2.0 * ROOF_LEAN)
    ring = sky.relative[inside].mean() if inside.any() else sky.zenith
    return 0.5 * (sky.zenith + float(ring))


def paint(values: Any) -> xr.Dataset:
    seen = xr.DataArray(np.float32(values), dims="band", attrs={"units": "1"})
    return xr.Dataset({"reflectance": seen}, {"wavelength": ("band", NM, {"units": "nm"})})


@pytest.mark.slow
@pytest.mark.parametrize("sun", SUNS)
def test_black_paint_stays_black(sun: float) -> None:
    mirrored = [COAT * diffuse_share(nm, sun) * near_zenith(truth(nm, sun)) for nm in NM]
    seen = paint(BLACK + np.array(mirrored))
    removed = hp.surroundings.remove_mirrored_sky(seen, sun_zenith=sun).reflectance
    np.testing.assert_allclose(removed, BLACK, atol=0.002)
    assert float(removed.mean()) > 0.0
    assert "sky (clear)" in removed.attrs["mirrored_sky_removed"]
    uniform = hp.surroundings.remove_mirrored_sky(seen, sun_zenith=sun, sky="uniform").reflectance
    if sun >= 45.0:  # what it was before
        assert np.abs(uniform - BLACK).max() > 2.0 * np.abs(removed - BLACK).max()


@pytest.mark.slow
@pytest.mark.parametrize("sun", [30.0, 45.0, 60.0])
@pytest.mark.parametrize("lean", [-8.0, 8.0])
def test_a_leaning_panel_gets_the_light_of_its_side(sun: float, lean: float) -> None:
    # Of a matt panel that leans towards the sun or away from it
    tilt = np.radians(lean)
    c = np.cos(np.radians(sun - lean)) / np.cos(np.radians(sun))
    light, share = [], []
    for nm in NM:
        sky = truth(nm, sun)
        cosine, azimuth = np.meshgrid(sky.cosine, sky.azimuth, indexing="ij")
        facing = cosine * np.cos(tilt) + np.sqrt(1.0 - cosine**2) * np.sin(tilt) * np.cos(azimuth)
        part = sky.mean(sky.relative * np.maximum(facing, 0.0) / cosine)
        share.append(diffuse_share(nm, sun))
        light.append(c * (1.0 - share[-1]) + part * share[-1])
    options = {"direct": c, "sky_view_factor": 0.5 * (1.0 + np.cos(tilt)), "neighbour_reflectance": 0.0}
    seen = paint(0.5 * np.array(light))
    split = np.array(share)  # measured, so that the sky's directions alone are judged
    clear = hp.surroundings.correct_light(seen, diffuse=split, sun_zenith=sun, sky="clear", **options)
    uniform = hp.surroundings.correct_light(seen, diffuse=split, **options)
    np.testing.assert_allclose(clear.reflectance, 0.5, rtol=0.01)
    assert np.abs(clear.reflectance - 0.5).max() < 0.5 * np.abs(uniform.reflectance - 0.5).max()
    assert "sky (uniform)" in uniform.reflectance.attrs["light_corrected"]


@pytest.mark.slow
@pytest.mark.parametrize("sun", [30.0, 60.0])
@pytest.mark.parametrize("turn", [0.0, 90.0, 180.0])
def test_a_steep_slope_gets_the_light_of_its_side(sun: float, turn: float) -> None:
    # Of any lean, and of any side: a windscreen, a boot, a door
    tilt = np.radians(30.0)
    gains = []
    for nm in NM:
        sky = truth(nm, sun)
        cosine, azimuth = np.meshgrid(sky.cosine, sky.azimuth, indexing="ij")
        across = np.sqrt(1.0 - cosine**2) / cosine * np.sin(tilt)
        # the table has one half of the sky, the other is its mirror image
        sides = (np.cos(azimuth - np.radians(turn)), np.cos(azimuth + np.radians(turn)))
        lit = sum(np.maximum(np.cos(tilt) + across * away, 0.0) for away in sides)
        gains.append(sky.mean(sky.relative * lit) / sky.mean(lit))
    # the three functions are that near to the horizon beside the sun, where the slope looks
    np.testing.assert_allclose(facing_gain(NM, sun, 30.0, turn), gains, rtol=0.08)
    if turn != 90.0:  # what a uniform sky gives instead
        assert np.abs(np.array(gains) - 1.0).max() > 0.15


def test_an_overcast_sky_is_brighter_above() -> None:
    # CIE: L = L_z (1 + 2 cos) / 3 has 7 pi L_z / 9 on level ground
    seen = paint(BLACK + COAT * np.full(NM.size, 9.0 / 7.0))
    measured = np.ones(NM.size)
    removed = hp.surroundings.remove_mirrored_sky(seen, diffuse=measured, sky="overcast")
    np.testing.assert_allclose(removed.reflectance, BLACK, atol=1e-6)
    # a measured split may be of any sky: none is assumed
    plain = hp.surroundings.remove_mirrored_sky(seen, diffuse=measured)
    np.testing.assert_allclose(plain.reflectance, BLACK + COAT * 2.0 / 7.0, atol=1e-6)


def test_a_clear_sky_needs_its_sun() -> None:
    seen = paint(np.full(NM.size, 0.3))
    expect_refusals(
        (
            SchemaError,
            "sun-unknown",
            lambda: hp.surroundings.remove_mirrored_sky(seen, diffuse=np.full(NM.size, 0.2), sky="clear"),
        ),
        (
            SchemaError,
            "choice-unknown",
            lambda: hp.surroundings.remove_mirrored_sky(seen, sun_zenith=30.0, sky="blue"),
        ),
    )
