"""Clouds: amount, colour, light and path, and the shadows of broken clouds on scene and spectrometer."""

from typing import Any

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings, strategies as st
from numpy.testing import assert_allclose
from support.traced_scenes import FEW_BANDS, SUN, flat_light

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError
from hyperpaint.simulation.atmosphere import (
    CIE_OVERCAST_SHARE,
    BrokenClouds,
    cloud_factor,
    cloud_transmittance,
)
from hyperpaint.simulation.rendering.four_curves import Atmosphere
from hyperpaint.simulation.rendering.materials import Material
from hyperpaint.simulation.rendering.platforms import pushbroom
from hyperpaint.simulation.rendering.scene import plane

GRID = np.arange(380.0, 1020.0, 2.0)
CLEAR = Atmosphere.clear(40.0, wavelength=GRID)


def test_amount_of_kasten_and_czeplak() -> None:
    # 1 - 0.75 (N/8)^3.4 by hand
    for oktas, left in ((0, 1.0), (4, 0.92895), (6, 0.71800), (8, 0.25)):
        assert cloud_factor(oktas) == pytest.approx(left, abs=1e-4)


def test_colour_of_an_overcast_sky() -> None:
    # the prototype's figures; the ratio at 490 nm is the cloud factor itself
    found = cloud_transmittance(np.array([400.0, 490.0, 700.0, 1000.0]), 8)
    assert_allclose(found, [0.306, 0.250, 0.216, 0.208], atol=5e-4)
    # the printed coefficients, a(CF) = 0.76 + 0.24 CF and b(CF) = 0.24 (1 - CF)
    factor = cloud_factor(6)
    expected = factor * (0.76 + 0.24 * factor + 0.24 * (1.0 - factor) * (GRID / 490.0) ** -4)
    assert_allclose(cloud_transmittance(GRID, 6), expected, rtol=1e-12)


def test_grey_clouds_have_no_colour() -> None:
    assert_allclose(cloud_transmittance(GRID, 8, colour=0.0), 0.25, rtol=1e-14)


@given(st.floats(0.0, 8.0), st.floats(0.0, 85.0))
@settings(max_examples=30)
def test_light_is_split_and_never_negative(oktas: float, zenith: float) -> None:
    clear = Atmosphere.clear(zenith, wavelength=GRID)
    cloudy = clear.clouded(oktas)
    assert_allclose(cloudy.sun, clear.sun * (1.0 - oktas / 8.0), rtol=1e-12, atol=1e-18)
    assert_allclose(cloudy.irradiance, clear.irradiance * cloud_transmittance(GRID, oktas), rtol=1e-12)
    assert (cloudy.sky >= 0.0).all()
    assert (cloudy.path_radiance >= 0.0).all()


def test_no_clouds_change_nothing() -> None:
    same = CLEAR.clouded(0)
    for name in ("sun", "sky", "extinction", "path_radiance"):
        assert_allclose(getattr(same, name), getattr(CLEAR, name), rtol=1e-12)
    assert same.overcast_share == 0.0


def test_eight_oktas_leave_no_sun_and_a_cie_sky() -> None:
    overcast = CLEAR.clouded(8)
    assert (overcast.sun == 0.0).all()
    assert (overcast.overcast_share, overcast.name) == (CIE_OVERCAST_SHARE, "clear, 8 oktas")
    blue, red = np.searchsorted(GRID, [450.0, 700.0])
    assert (
        overcast.irradiance[blue] / overcast.irradiance[red] > CLEAR.irradiance[blue] / CLEAR.irradiance[red]
    )


def test_the_two_parts_are_the_cie_overcast_sky() -> None:
    cosine = (np.arange(100_000) + 0.5) / 100_000
    cie = (1.0 + 2.0 * cosine) / 3.0  # zenith radiance 1
    level = 2.0 * np.pi * np.mean(cie * cosine)
    assert level == pytest.approx(7.0 * np.pi / 9.0, rel=1e-8)
    share = CIE_OVERCAST_SHARE
    assert_allclose((1.0 - share) * level / np.pi + share * 1.5 * cosine * level / np.pi, cie, rtol=1e-8)


def test_a_path_adds_in_proportion_where_the_haze_is_not_known() -> None:
    overcast = Atmosphere(
        GRID, CLEAR.sun, CLEAR.sky, CLEAR.extinction, CLEAR.path_radiance, 40.0, 180.0, name="table"
    ).clouded(8)
    light = overcast.sky * 2.0 / (CLEAR.sun + 2.0 * CLEAR.sky)
    assert_allclose(overcast.path_radiance, CLEAR.path_radiance * light, rtol=1e-12)
    dark = Atmosphere(GRID, 0 * GRID, 0 * GRID, 0 * GRID, 0 * GRID, 40.0, 180.0).clouded(8)
    assert (dark.path_radiance == 0.0).all()


@pytest.mark.parametrize("oktas", [-1, 8.5, np.nan])
def test_there_are_no_such_oktas(oktas: float) -> None:
    with pytest.raises(SchemaError, match="oktas"):
        CLEAR.clouded(oktas)


def test_all_problems_at_once() -> None:
    with pytest.raises(SchemaError, match=r"(?s)oktas.*colour"):
        CLEAR.clouded(9, colour=-1.0)


EAST, NORTH = np.meshgrid(np.arange(0.0, 20_000.0, 50.0), np.arange(0.0, 20_000.0, 50.0))


@pytest.mark.parametrize("cover", [0.2, 0.5, 0.8])
def test_as_much_is_in_shadow_as_is_asked_for(cover: float) -> None:
    direct, diffuse = BrokenClouds(cover=cover, size=300.0, opacity=0.7).factors(EAST, NORTH, 0.0)
    assert np.mean((1.0 - direct) / 0.7) == pytest.approx(cover, abs=0.05)
    assert (direct.min(), direct.max()) == (pytest.approx(0.3), 1.0)
    assert np.ptp(diffuse) == 0.0 < diffuse[0, 0] - 1.0


def test_shadows_are_as_large_as_is_asked_for() -> None:
    for size in (200.0, 800.0):
        direct, _ = BrokenClouds(size=size, cover=0.5).factors(EAST, NORTH, 0.0)
        part = direct - direct.mean()
        shift = round(size / 50.0)
        # a field with correlation 1/e, cut at its median: 2/pi arcsin(1/e)
        assert ((part[:, shift:] * part[:, :-shift]).mean() / (part**2).mean()) == pytest.approx(
            2.0 / np.pi * np.arcsin(np.exp(-1.0)), abs=0.12
        )


def test_shadows_go_with_the_wind() -> None:
    clouds = BrokenClouds(speed=10.0, heading=60.0)
    moved = 30.0 * 10.0 * np.array([np.sin(np.radians(60.0)), np.cos(np.radians(60.0))])
    np.testing.assert_allclose(
        clouds.factors(EAST + moved[0], NORTH + moved[1], 30.0), clouds.factors(EAST, NORTH, 0.0), atol=1e-9
    )


def relit(clouds: BrokenClouds, chunk_lines: int = 32) -> tuple[xr.Dataset, xr.Dataset]:
    flown = pushbroom(40, 24, altitude=40.0, ground_sample=2.0, line_spacing=2.0)
    trace = hp.simulation.trace(
        plane(400.0, Material("grey", "panel_20", "panel")), flown, [SUN], samples=4, sun_radius=0.0,
        chunk_lines=chunk_lines,
    )  # fmt: skip
    return trace, trace.paint.relight(FEW_BANDS, atmosphere=flat_light(), variation=clouds)


@pytest.mark.slow
def test_the_swath_is_lit_by_its_own_clouds() -> None:
    clouds = BrokenClouds(size=20.0, speed=5.0, seed=2, station=(3.0, 4.0))
    trace, made = relit(clouds)
    assert made.radiance.chunks is not None
    start = np.datetime64(trace.attrs["time_coverage_start"], "ns")
    direct, diffuse = clouds.factors(
        trace.east.values, trace.north.values, ((trace.time.values - start) / np.timedelta64(1, "s"))[:, None]
    )
    assert np.ptp(direct[0]) > 0.5  # over one line
    level = 1.2 * np.cos(np.radians(SUN[0])) * direct + 0.3 * diffuse
    np.testing.assert_allclose(made.radiance[:, 0] * np.pi, 0.2 * level, rtol=1e-4)
    np.testing.assert_allclose(made.reflectance, 0.2, rtol=1e-4)
    there = clouds.factors(*clouds.station, (made.irradiance_time.values - start) / np.timedelta64(1, "s"))
    np.testing.assert_allclose(
        made.irradiance[:, 100], 1.2 * np.cos(np.radians(SUN[0])) * there[0] + 0.3 * there[1], rtol=1e-4
    )
    _, other = relit(clouds, chunk_lines=7)
    np.testing.assert_array_equal(made.radiance, other.radiance)


@pytest.mark.parametrize(
    "wrong", [{"cover": 1.2}, {"size": 0.0}, {"opacity": -1}, {"station": (np.nan, 0.0)}]
)
def test_there_are_no_such_clouds(wrong: dict[str, Any]) -> None:
    with pytest.raises(SchemaError, match=next(iter(wrong))):
        BrokenClouds(**wrong)
