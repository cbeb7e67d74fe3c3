"""Directional skies in the renderer against sums over the sky: level ground, slopes, a mirror."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.traced_scenes import SUN, flat_light, flight, two_cars

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError
from hyperpaint.light.sky_functions import (
    clear_sky_shares,
    function_shapes,
    relative_radiance,
    zenith_radiance,
)
from hyperpaint.simulation.camera import BandSet
from hyperpaint.simulation.rendering.four_curves import Atmosphere, preset_atmosphere
from hyperpaint.simulation.rendering.materials import Coat, Material
from hyperpaint.simulation.rendering.platforms import pushbroom
from hyperpaint.simulation.rendering.scene import Scene, box, plane
from hyperpaint.simulation.rendering.scene_record import sun_vectors

BANDS = BandSet(np.array([450.0, 550.0, 850.0]), np.array(6.0))
NM = np.array([400.0, 450.0, 550.0, 850.0, 900.0])


def dome(count: int = 400) -> np.ndarray:
    # Return directions spread evenly over the whole sphere (direction, 3)
    number = np.arange(2 * count * count) + 0.5
    up = 1.0 - number / (count * count)
    angle = np.pi * (1.0 + np.sqrt(5.0)) * number
    across = np.sqrt(1.0 - up**2)
    return np.stack([across * np.cos(angle), across * np.sin(angle), up], axis=1)


DOME = dome()


def sky_light(direction: tuple[float, float], **shares: float) -> Atmosphere:
    # Return skylight of 1 alone, spread over directions by shares that are even over wavelengths
    spread: Any = {
        name: np.full(NM.shape, value) if name != "overcast_share" else value
        for name, value in shares.items()
    }
    none = np.zeros(NM.shape)
    return Atmosphere(NM, none, none + 1.0, none, none, *direction, **spread)


def slope(tilt: float, azimuth: float) -> tuple[Scene, np.ndarray]:
    # Return a Lambert panel of 0.5 that leans towards an azimuth [degree], and its normal
    normal = sun_vectors([(tilt, azimuth)])[0]
    aside = np.cross(normal, [0.3, 0.2, 1.0])
    aside /= np.linalg.norm(aside)
    ahead = np.cross(normal, aside)
    corners = 5.0 * np.array([aside + ahead, aside - ahead, -aside - ahead, ahead - aside])
    return Scene.from_arrays(corners, [[0, 1, 2], [0, 2, 3]], Material("grey", "panel_50", "panel")), normal


def traced(scene: Scene, light: Atmosphere, samples: int = 1024) -> xr.Dataset:
    # Return the light that a panel alone scatters once
    platform = pushbroom(16, 16, altitude=40.0, ground_sample=0.05)
    return hp.simulation.trace(scene, platform, [light], samples=samples, slots=64, depth=1).compute()


def relit(trace: xr.Dataset, light: Atmosphere) -> float:
    # Return the mean radiance times pi
    return float(trace.paint.relight(BANDS, atmosphere=light, truth=False).radiance.mean()) * np.pi


@pytest.mark.parametrize("sun", [(25.0, 180.0), (60.0, 75.0), (82.0, 265.0)])
@pytest.mark.parametrize(("tilt", "turn"), [(0.0, 0.0), (35.0, 0.0), (35.0, 180.0), (60.0, 90.0)])
def test_the_functions_on_slopes(tilt: float, turn: float, sun: tuple[float, float]) -> None:
    # The irradiance of a panel is the sum of each function over what it sees of the sky
    scene, normal = slope(tilt, sun[1] + turn)
    trace = traced(scene, sky_light(sun, molecular=1.0))
    above = DOME[:, 2] > 0.0
    for name, shape in zip(("molecular", "aureole"), function_shapes(sun[0]), strict=True):
        value = relative_radiance(shape, DOME[above, 2], DOME[above] @ sun_vectors([sun])[0])
        # the noise of a quarter of a million paths
        assert relit(trace, sky_light(sun, **{name: 1.0})) == pytest.approx(
            0.5 * 4.0 * np.sum(value * np.maximum(DOME[above] @ normal, 0.0)) / len(DOME), rel=0.015
        ), name


@pytest.mark.parametrize("tilt", [0.0, 30.0, 60.0])
def test_an_overcast_sky_on_slopes(tilt: float) -> None:
    # CIE's sky on a slope, (1 + cos) / 2 for its uniform part, and nothing from below the horizon
    scene, normal = slope(tilt, 100.0)
    expected = 0.5 * 4.0 * np.mean(1.5 * DOME[:, 2] * (DOME[:, 2] > 0.0) * np.maximum(DOME @ normal, 0.0))
    light = sky_light((40.0, 180.0), overcast_share=1.0)
    assert relit(traced(scene, light, samples=4096), light) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("sun", [(25.0, 180.0), (60.0, 90.0), (82.0, 265.0)])
def test_a_bonnet_mirrors_the_zenith(sun: tuple[float, float]) -> None:
    # A level black roof with a smooth coat, seen from above, under the sky alone
    light = Atmosphere.clear(*sun, haze=None, wavelength=np.arange(380.0, 951.0))
    light = dataclasses.replace(light, sun=0.0 * light.sun)
    scene = plane(50.0, Material("roof", "panel_50", "paint", Coat(roughness=0.01)))
    made = hp.simulation.trace(
        scene, pushbroom(8, 8, altitude=200.0, ground_sample=0.1), [light], samples=512
    ).paint.relight(BANDS, atmosphere=light, paints={"panel_50": ([300.0, 1100.0], [0.0, 0.0])})
    mirrored = made.reflectance.mean(("along_track", "cross_track")).values
    np.testing.assert_allclose(mirrored, 0.04 * zenith_radiance(BANDS.wavelength, sun[0]), rtol=0.02)


def test_presets_have_the_sky_of_their_sun() -> None:
    for name in ("noon", "near_sunset"):
        light = preset_atmosphere(name)
        shares = clear_sky_shares(light.wavelength, light.sun_zenith)
        np.testing.assert_allclose(light.molecular, shares[1])
        np.testing.assert_allclose(light.aureole, shares[2])
    cloudy = preset_atmosphere("cloudy")
    assert not np.any([cloudy.molecular, cloudy.aureole])
    half = preset_atmosphere("noon").clouded(4)
    np.testing.assert_allclose(half.molecular, 0.5 * preset_atmosphere("noon").molecular)
    np.testing.assert_allclose(half.uniform + half.molecular + half.aureole + half.overcast_share, 1.0)


def test_the_sky_is_written_and_read() -> None:
    light = Atmosphere.clear(50.0, wavelength=np.arange(380.0, 1000.0))
    np.testing.assert_array_equal(Atmosphere.from_dataset(light.to_dataset()).molecular, light.molecular)
    old = Atmosphere.from_dataset(light.to_dataset().drop_vars(["molecular", "aureole"]))
    np.testing.assert_array_equal(old.uniform, 1.0)
    with pytest.raises(SchemaError, match="shares-too-large"):
        dataclasses.replace(light, overcast_share=0.5)


def test_what_was_not_traced_is_said() -> None:
    bare = hp.simulation.trace(two_cars(), flight(2, 2), [SUN], samples=2, clear=False)
    with pytest.raises(SchemaError, match="sky-not-traced"):
        bare.paint.relight(BANDS, atmosphere=Atmosphere.clear(*SUN))
    bare.paint.relight(BANDS, atmosphere=flat_light())
    old = bare.copy()
    del old.attrs["source_bits"]
    with pytest.raises(SchemaError, match="trace-outdated"):
        old.paint.relight(BANDS, atmosphere=flat_light())


def test_a_shadow_has_a_penumbra() -> None:
    # The edge of a wall's shadow is as wide as the sun's disc throws it
    wall = box((40.0, 0.2, 10.0), Material("wall", "brick", "wall"), centre=(0.0, 0.0, 0.0))
    scene = Scene.join([plane(200.0), wall])
    sun = (45.0, 180.0)  # from the south: the edge falls 10 m north of the wall's top
    platform = pushbroom(60, 4, altitude=30.0, ground_sample=0.02, line_spacing=0.01)
    moved = dataclasses.replace(
        platform, origin=platform.origin + np.array([0.0, 9.8 - platform.origin[:, :, 1].min(), 0.0])
    )
    visible, sharp, coarse = (
        hp.simulation.trace(scene, moved, [sun], **options).compute().mean("cross_track")
        for options in ({"samples": 256}, {"samples": 256, "sun_radius": 0.0}, {"samples": 4})
    )

    def width(trace: xr.Dataset) -> float:
        part = trace.sun_visibility[:, 0].values
        return float(np.ptp(coarse.north.values[(part > 0.02) & (part < 0.98)]))

    # 2 x 0.267 degrees over a slant of 10 sqrt(2) m, on ground that meets the beam at 45 degrees
    expected = 2.0 * np.tan(np.radians(0.267)) * 10.0 * np.sqrt(2.0) * np.sqrt(2.0)
    assert width(visible) == pytest.approx(expected, rel=0.25)
    assert width(sharp) < 0.5 * expected
