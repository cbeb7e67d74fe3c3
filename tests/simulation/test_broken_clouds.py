"""Shadows of broken clouds: how much, how large, where they go, what scene and spectrometer see of them."""

from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.traced_scenes import FEW_BANDS, SUN, flat_light

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError
from hyperpaint.simulation.atmosphere import BrokenClouds
from hyperpaint.simulation.rendering.materials import Material
from hyperpaint.simulation.rendering.platforms import pushbroom
from hyperpaint.simulation.rendering.scene import plane

EAST, NORTH = np.meshgrid(np.arange(0.0, 20_000.0, 50.0), np.arange(0.0, 20_000.0, 50.0))


@pytest.mark.parametrize("cover", [0.2, 0.5, 0.8])
def test_as_much_is_in_shadow_as_is_asked_for(cover: float) -> None:
    clouds = BrokenClouds(cover=cover, size=300.0, opacity=0.7)
    direct, diffuse = clouds.factors(EAST, NORTH, 0.0)
    assert np.mean((1.0 - direct) / 0.7) == pytest.approx(cover, abs=0.05)
    assert direct.min() == pytest.approx(0.3)
    assert direct.max() == 1.0
    assert np.ptp(diffuse) == 0.0 < diffuse[0, 0] - 1.0


def test_shadows_are_as_large_as_is_asked_for() -> None:
    for size in (200.0, 800.0):
        direct, _ = BrokenClouds(size=size, cover=0.5).factors(EAST, NORTH, 0.0)
        part = direct - direct.mean()
        shift = round(size / 50.0)
        here = (part[:, shift:] * part[:, :-shift]).mean() / (part**2).mean()
        # a field with correlation 1/e, cut at its median: 2/pi arcsin(1/e)
        assert here == pytest.approx(2.0 / np.pi * np.arcsin(np.exp(-1.0)), abs=0.12)


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
    seconds = (trace.time.values - start) / np.timedelta64(1, "s")
    direct, diffuse = clouds.factors(trace.east.values, trace.north.values, seconds[:, None])
    assert np.ptp(direct[0]) > 0.5  # over one line
    level = 1.2 * np.cos(np.radians(SUN[0])) * direct + 0.3 * diffuse
    np.testing.assert_allclose(made.radiance[:, 0] * np.pi, 0.2 * level, rtol=1e-4)
    np.testing.assert_allclose(made.reflectance, 0.2, rtol=1e-4)
    times = (made.irradiance_time.values - start) / np.timedelta64(1, "s")
    there = clouds.factors(*clouds.station, times)
    expected = 1.2 * np.cos(np.radians(SUN[0])) * there[0] + 0.3 * there[1]
    np.testing.assert_allclose(made.irradiance[:, 100], expected, rtol=1e-4)
    _, other = relit(clouds, chunk_lines=7)
    np.testing.assert_array_equal(made.radiance, other.radiance)


@pytest.mark.parametrize(
    "wrong", [{"cover": 1.2}, {"size": 0.0}, {"opacity": -1}, {"station": (np.nan, 0.0)}]
)
def test_there_are_no_such_clouds(wrong: dict[str, Any]) -> None:
    with pytest.raises(SchemaError, match=next(iter(wrong))):
        BrokenClouds(**wrong)
