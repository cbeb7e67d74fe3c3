"""Corrections that are offered, against light computed by hand."""

from typing import Any

import numpy as np
import pytest
import xarray as xr
from oracles.scattered_sky import Air, SkyRadiance, rayleigh_depth, sky_radiance
from support.refusals import expect_refusals

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError
from hyperpaint.light.clear_sky import facing_gain
from hyperpaint.light.sun import diffuse_fraction, solar_position
from hyperpaint.simulation import simulate_line

NM = np.linspace(400.0, 1000.0, 40)
SKY = diffuse_fraction(NM, 35.0)
PART = {"direct": 1.2, "sky_view_factor": 0.6}


def line(values: Any) -> xr.Dataset:
    cube = np.broadcast_to(np.asarray(values, np.float32)[None, :, None], (4, NM.size, 3))
    return xr.Dataset(
        {"reflectance": (("along_track", "band", "cross_track"), cube.copy(), {"units": "1"})},
        {"wavelength": ("band", NM, {"units": "nm"})},
    ).chunk(along_track=2)


def test_black_paint_and_tilted_panels() -> None:
    seen = line(0.03 + 0.04 * SKY)
    assert float(seen.reflectance.max() / seen.reflectance.min()) > 1.3
    made = hp.surroundings.remove_mirrored_sky(seen, sun_zenith=35.0, sky="uniform")
    assert made.reflectance.chunks is not None
    np.testing.assert_allclose(made.reflectance.values, 0.03, atol=1e-6)
    assert made.reflectance.dtype == np.float32
    assert "0.04" in made.reflectance.attrs["mirrored_sky_removed"]
    assert "mirrored_sky_removed" not in seen.reflectance.attrs
    light = 1.2 * (1 - SKY) + 0.6 * SKY + 0.4 * 0.2
    made = hp.surroundings.correct_light(line(0.3 * light), **PART, sun_zenith=35.0, sky="uniform")
    np.testing.assert_allclose(made.reflectance.values, 0.3, rtol=1e-5)
    assert made.reflectance.dims == ("along_track", "band", "cross_track")
    direct = xr.DataArray(np.linspace(0.9, 1.1, 12).reshape(4, 3), dims=("along_track", "cross_track"))
    light = direct * (1 - xr.DataArray(SKY, dims="band")) + xr.DataArray(SKY, dims="band")
    seen = line(np.ones(NM.size))
    seen["reflectance"] = (seen.reflectance * 0.5 * light).astype(np.float32).assign_attrs(units="1")
    made = hp.surroundings.correct_light(seen, direct=direct, sun_zenith=35.0, sky="uniform")
    np.testing.assert_allclose(made.reflectance.values, 0.5, rtol=1e-5)


def test_nothing_is_corrected_twice_or_in_another_order() -> None:
    once = hp.surroundings.remove_mirrored_sky(line(np.ones(NM.size)), sun_zenith=35.0)
    expect_refusals(
        (SchemaError, "corrected-before", lambda: hp.surroundings.remove_mirrored_sky(once, sun_zenith=35.0)),
        (
            SchemaError,
            "value-out-of-range",
            "strength=2",
            "sky_view_factor=-1",
            lambda: hp.surroundings.remove_mirrored_sky(
                line(np.ones(NM.size)), strength=2.0, sky_view_factor=-1.0, sun_zenith=35.0
            ),
        ),
        (
            SchemaError,
            "variable-missing",
            "'wavelength'",
            lambda: hp.surroundings.correct_light(
                line(np.ones(NM.size)).drop_vars("wavelength"), sun_zenith=35.0
            ),
        ),
    )
    seen = line(np.full(NM.size, 0.3))
    lit = hp.surroundings.correct_light(seen, direct=0.9, sun_zenith=35.0)
    with pytest.raises(SchemaError, match=r"0\.9.*corrected-before"):
        hp.surroundings.remove_mirrored_sky(lit, sun_zenith=35.0)
    both = hp.surroundings.correct_light(
        hp.surroundings.remove_mirrored_sky(seen, sun_zenith=35.0), direct=0.9, sun_zenith=35.0
    )
    assert {"mirrored_sky_removed", "light_corrected"} <= set(both.reflectance.attrs)
    assert "sun zenith 35 degree" in both.reflectance.attrs["mirrored_sky_removed"]


def test_uncertainties_are_divided_by_the_same_light() -> None:
    seen = line(np.full(NM.size, 0.3))
    u = {
        name: (seen.reflectance * np.float32(part)).assign_attrs(units="1", components=name)
        for name, part in (("reflectance_u_random", 0.02), ("reflectance_u_systematic", 0.05))
    }
    made = hp.surroundings.correct_light(seen.assign(u), direct=0.6, sun_zenith=35.0, sky="uniform")
    light = (0.6 * (1 - SKY) + SKY)[None, :, None]
    for name, array in u.items():
        assert made[name].chunks is not None
        assert (made[name].dtype, made[name].attrs) == (np.float32, array.attrs)
        np.testing.assert_allclose(made[name].values, array.values / light, rtol=1e-5)


def test_light_is_of_the_pixels_of_the_line() -> None:
    # warnings are errors here
    direct = xr.DataArray(np.array([1.0, 0.0, -2.0, np.nan]), dims="along_track")
    options = {"sky_view_factor": 0.0, "sun_zenith": 35.0, "neighbour_reflectance": 0.0}
    grey = line(np.full(NM.size, 0.3))
    made = hp.surroundings.correct_light(grey, direct=direct, **options).reflectance.values
    assert np.isfinite(made[0]).all()
    assert np.isnan(made[1:]).all()
    numbered = line(0.3 + 0.0 * NM).assign_coords(along_track=np.arange(4))
    direct = xr.DataArray(np.full(4, 0.9), dims="along_track", coords={"along_track": np.arange(4)})
    crop, correct_light = numbered.isel(along_track=slice(1, 3)), hp.surroundings.correct_light
    alike = correct_light(crop, direct=direct.isel(along_track=slice(1, 3)), sun_zenith=30.0)
    assert alike.sizes["along_track"] == 2
    # xarray would cut both to the lines that they have in common
    with pytest.raises(SchemaError, match="grid-mismatch"):
        correct_light(crop, direct=direct, sun_zenith=30.0)


def test_a_tilted_panel_is_corrected_in_one_order_only() -> None:
    seen = simulate_line(lines=4, bands=12, columns=6, smile_nm=0.0, noise=False)
    tilted = hp.reflectance(seen, tilt=(10.0, 180.0))
    for correct in (hp.surroundings.remove_mirrored_sky, hp.surroundings.correct_light):
        with pytest.raises(SchemaError, match=r"tilt.*corrected-before"):
            correct(tilted)
    # what the message says to do gives what tilt= gives, but for the sky that is subtracted before
    zenith, azimuth = solar_position(seen.time.values[0], seen.latitude.values[0], seen.longitude.values[0])
    incidence = hp.Tilt(10.0, 180.0)
    cosine = np.cos(np.radians(zenith)) * np.cos(np.radians(10.0)) + np.sin(np.radians(zenith)) * np.sin(
        np.radians(10.0)
    ) * np.cos(np.radians(azimuth - 180.0))
    options = {
        "direct": float(cosine / np.cos(np.radians(zenith))),
        "sky_view_factor": float((1 + np.cos(np.radians(10.0))) / 2),
        "sun_zenith": float(zenith),
        "neighbour_reflectance": incidence.ground_reflectance,
        "diffuse": "model",  # as Tilt has it
    }
    plain = hp.reflectance(seen)
    np.testing.assert_allclose(
        hp.surroundings.correct_light(plain, **options).reflectance, tilted.reflectance, rtol=4e-3, atol=1e-4
    )  # Tilt integrates over the sky; correct_light has its gain to first order
    sky = 0.04 * diffuse_fraction(seen.wavelength.values, float(zenith))[None, :, None]
    light = plain.reflectance.values / hp.surroundings.correct_light(plain, **options).reflectance.values
    bare = hp.surroundings.correct_light(
        hp.surroundings.remove_mirrored_sky(plain, sun_zenith=float(zenith), sky="uniform", diffuse="model"),
        **options,
    )
    np.testing.assert_allclose(bare.reflectance, (plain.reflectance - sky) / light, rtol=1e-4, atol=1e-5)


def test_a_library_corrected_is_that_of_a_line_corrected() -> None:
    rng = np.random.default_rng(0)
    seen = line(np.full(NM.size, 0.3))
    noise = 0.02 * rng.standard_normal(seen.reflectance.shape)
    seen["reflectance"] = (seen.reflectance + noise).astype(np.float32).assign_attrs(units="1")
    region = hp.Region("hood", [(0, 0), (2, 0), (2, 3), (0, 3)])
    for correct in (
        lambda given: hp.surroundings.remove_mirrored_sky(given, sun_zenith=35.0),
        lambda given: hp.surroundings.correct_light(given, direct=0.7, sun_zenith=35.0),
    ):
        early = hp.extract_signatures(correct(seen), region)
        late = correct(hp.extract_signatures(seen, region))
        for name in ("reflectance", "reflectance_sd", "reflectance_quantiles", "member_reflectance"):
            assert (late[name].dims, late[name].dtype) == (early[name].dims, np.float32)
            np.testing.assert_allclose(late[name], early[name], rtol=2e-5, atol=1e-7, err_msg=name)
        assert late.attrs["corrections"] == early.attrs["corrections"] != "none"
        for library in (early, late):
            with pytest.raises(SchemaError, match="corrected-before"):
                correct(library)


# --- Corrections of mirrored sky and of light against foreign skies: a Monte Carlo, and CIE's


SKY_NM = np.array([410.0, 450.0, 550.0, 700.0, 850.0, 980.0])
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
    return xr.Dataset({"reflectance": seen}, {"wavelength": ("band", SKY_NM, {"units": "nm"})})


@pytest.mark.slow
@pytest.mark.parametrize("sun", SUNS)
def test_black_paint_stays_black(sun: float) -> None:
    mirrored = [COAT * diffuse_share(nm, sun) * near_zenith(truth(nm, sun)) for nm in SKY_NM]
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
    for nm in SKY_NM:
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
    for nm in SKY_NM:
        sky = truth(nm, sun)
        cosine, azimuth = np.meshgrid(sky.cosine, sky.azimuth, indexing="ij")
        across = np.sqrt(1.0 - cosine**2) / cosine * np.sin(tilt)
        # the table has one half of the sky, the other is its mirror image
        sides = (np.cos(azimuth - np.radians(turn)), np.cos(azimuth + np.radians(turn)))
        lit = sum(np.maximum(np.cos(tilt) + across * away, 0.0) for away in sides)
        gains.append(sky.mean(sky.relative * lit) / sky.mean(lit))
    # the three functions are that near to the horizon beside the sun, where the slope looks
    np.testing.assert_allclose(facing_gain(SKY_NM, sun, 30.0, turn), gains, rtol=0.08)
    if turn != 90.0:  # what a uniform sky gives instead
        assert np.abs(np.array(gains) - 1.0).max() > 0.15


def test_an_overcast_sky_is_brighter_above() -> None:
    # CIE: L = L_z (1 + 2 cos) / 3 has 7 pi L_z / 9 on level ground
    seen = paint(BLACK + COAT * np.full(SKY_NM.size, 9.0 / 7.0))
    measured = np.ones(SKY_NM.size)
    removed = hp.surroundings.remove_mirrored_sky(seen, diffuse=measured, sky="overcast")
    np.testing.assert_allclose(removed.reflectance, BLACK, atol=1e-6)
    # a measured split may be of any sky: none is assumed
    plain = hp.surroundings.remove_mirrored_sky(seen, diffuse=measured)
    np.testing.assert_allclose(plain.reflectance, BLACK + COAT * 2.0 / 7.0, atol=1e-6)


def test_a_clear_sky_needs_its_sun() -> None:
    seen = paint(np.full(SKY_NM.size, 0.3))
    expect_refusals(
        (
            SchemaError,
            "sun-unknown",
            lambda: hp.surroundings.remove_mirrored_sky(seen, diffuse=np.full(SKY_NM.size, 0.2), sky="clear"),
        ),
        (
            SchemaError,
            "choice-unknown",
            lambda: hp.surroundings.remove_mirrored_sky(seen, sun_zenith=30.0, sky="blue"),
        ),
    )
