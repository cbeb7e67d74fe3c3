"""Pixels that show members of a population: their spread, their place, and what stays as it was."""

from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.traced_scenes import FEW_BANDS, SUN, flat_light, two_cars

import hyperpaint as hp
from hyperpaint.simulation.rendering.materials import Coat, Material
from hyperpaint.simulation.rendering.platforms import pushbroom
from hyperpaint.simulation.rendering.scene import plane
from hyperpaint.simulation.transport.mixing import Grain, member_rows

LIGHT = flat_light()
NM = np.linspace(390.0, 1010.0, 63)


def library(members: np.ndarray) -> xr.Dataset:
    # Return a library of one paint whose centre is the mean of its members (member, band)
    return xr.Dataset(
        {
            "reflectance": (("signature", "band"), members.mean(axis=0, keepdims=True)),
            "member_reflectance": (("signature", "member", "band"), members[np.newaxis]),
        },
        {"signature": ["measured"], "wavelength": ("band", NM, {"units": "nm"})},
    )


def spread_members(count: int = 200, spread: float = 0.10) -> np.ndarray:
    rng = np.random.default_rng(1)
    level = rng.standard_normal(count)
    level = 1.0 + spread * (level - level.mean()) / level.std()
    tilt = 0.02 * rng.standard_normal((count, 1)) * (NM - 700.0) / 300.0
    return np.asarray((0.3 + 0.1 * np.sin(NM / 80.0)) * (level[:, None] + tilt - tilt.mean()))


def panel(ground_sample: float, lines: int = 96, columns: int = 96, **more: Any) -> xr.Dataset:
    # Return a traced flight over a coated plane
    paint = Material("paint", "white", "paint", Coat(1.5, 0.05))
    flight = pushbroom(lines, columns, altitude=15.0, ground_sample=ground_sample, centre=(0.0, 0.0))
    return hp.simulation.trace(plane(200.0, paint), flight, [SUN], samples=2, depth=1, **more).compute()


@pytest.mark.slow
@pytest.mark.parametrize("ground_sample", [0.015, 0.10])
def test_rendered_pixels_have_the_spread_of_the_members(ground_sample: float) -> None:
    traced, paints = panel(ground_sample), library(spread_members())
    sunlight = flat_light(sky=0.0)  # without the noise of a sampled sky
    options = {"paints": {"white": "measured"}, "spectra": paints, "atmosphere": sunlight}
    flat = traced.paint.relight(FEW_BANDS, **options, population=False)
    mirrored = traced.paint.relight(FEW_BANDS, paints={"white": (NM, 0 * NM)}, atmosphere=sunlight)
    body = (traced.paint.relight(FEW_BANDS, **options).reflectance - mirrored.reflectance).values
    relative = body.std(axis=(0, 2)) / body.mean(axis=(0, 2))
    assert abs(relative - 0.10).max() < 0.01, relative
    # over 1.4 m of a panel some 50 patches of 20 cm are drawn, over 10 m thousands
    np.testing.assert_allclose(
        body.mean(axis=(0, 2)), (flat.reflectance - mirrored.reflectance).values.mean(axis=(0, 2)), rtol=0.03
    )


@pytest.mark.slow
def test_a_pixel_is_the_render_of_its_member() -> None:
    members = spread_members(3)
    traced = panel(0.1, lines=12, columns=12)
    bands = FEW_BANDS
    line = traced.paint.relight(
        bands, paints={"white": "measured"}, spectra=library(members), atmosphere=LIGHT
    ).radiance.values
    paints = [{"white": (NM, row)} for row in members]
    alone = np.stack([traced.paint.relight(bands, paints=one, atmosphere=LIGHT).radiance for one in paints])
    error = np.abs(line / alone - 1.0).max(axis=2)
    assert error.min(axis=0).max() < 2e-4  # of the band's response over a curved spectrum
    assert len(np.unique(error.argmin(axis=0))) == 3


@pytest.mark.slow
def test_neither_chunks_nor_blocks_change_a_bit() -> None:
    paints = library(spread_members())
    lines = [
        hp.simulation.trace(
            two_cars(), pushbroom(24, 16, altitude=12.0, ground_sample=0.45, line_spacing=0.3), [SUN],
            samples=4, chunk_lines=chunk,
        ).paint.relight(FEW_BANDS, paints=paints, atmosphere=LIGHT)
        for chunk in (1, 7, 24)
    ]  # fmt: skip
    for other in lines[1:]:
        np.testing.assert_array_equal(other.radiance.values, lines[0].radiance.values)
    np.testing.assert_array_equal(
        lines[0].isel(along_track=slice(5, 9)).radiance.values, lines[0].radiance.values[5:9]
    )


@pytest.mark.slow
def test_only_the_painted_car_changes() -> None:
    traced = hp.simulation.trace(
        two_cars(), pushbroom(24, 16, altitude=12.0, ground_sample=0.45, line_spacing=0.3), [SUN], samples=4
    ).compute()
    options = {"paints": {"car_0": "measured"}, "spectra": library(spread_members()), "atmosphere": LIGHT}
    without = traced.paint.relight(FEW_BANDS, **options, population=False)
    changed = (traced.paint.relight(FEW_BANDS, **options).radiance != without.radiance).any("band").values
    car = int(next(n for n, one in enumerate(["ground", "car_0", "car_1", "wall"]) if one == "car_0"))
    assert changed.any()
    assert (traced.instance.values[changed] == car).all()


def grain(length: float, count: int = 1000, *, is_averaged: bool = False) -> Grain:
    return Grain(
        np.array([0]), np.array([count]), np.array([[length]]), np.array([[1.0]]), np.array([is_averaged])
    )


def field(spacing: float, made: Grain, seed: int = 3, instance: int = 0) -> np.ndarray:
    east, north = np.meshgrid(np.arange(200) * spacing, np.arange(150) * spacing)
    label = np.zeros(east.shape, np.int32)
    place = np.stack([east + 0.123, north - 7.77, 0.0 * east])
    return member_rows(label, label + np.int32(instance), *place, made, seed) / 1000.0


def test_ranks_are_even_and_alike_over_the_length() -> None:
    ranks = field(0.05, grain(0.1))
    assert abs(ranks.mean() - 0.5) < 0.02
    assert abs(ranks.std() - np.sqrt(1 / 12)) < 0.01
    assert abs((np.histogram(ranks, 10, (0, 1))[0] / ranks.size) - 0.1).max() < 0.02
    near = np.corrcoef(field(0.005, grain(0.1))[:, :-1].ravel(), field(0.005, grain(0.1))[:, 1:].ravel())
    assert near[0, 1] > 0.95
    assert abs(np.corrcoef(ranks[:, :-5].ravel(), ranks[:, 5:].ravel())[0, 1]) < 0.03


def test_things_and_seeds_have_fields_of_their_own() -> None:
    first = field(0.05, grain(0.1))
    for other in (field(0.05, grain(0.1), instance=1), field(0.05, grain(0.1), seed=4)):
        assert abs(np.corrcoef(first.ravel(), other.ravel())[0, 1]) < 0.05


def test_what_is_smaller_than_a_pixel_averages_out() -> None:
    assert field(0.4, grain(0.1, is_averaged=True)).std() < 0.35 * field(0.4, grain(0.1)).std()
    assert (field(0.01, grain(0.1, is_averaged=True)).std() / field(0.01, grain(0.1)).std()) > 0.95


def test_the_sky_and_plain_surfaces_have_no_member() -> None:
    label = np.array([[-1, 0, 1]], np.int32)
    made = Grain(np.array([0, 0]), np.array([0, 9]), np.ones((2, 1)), np.ones((2, 1)), np.zeros(2, bool))
    place = np.array([[[np.nan, 0.0, 1.0]]] * 3)
    assert member_rows(label, label, *place, made, 0).tolist()[0][:2] == [-1, -1]
    assert member_rows(label, label, *place, made, 0)[0, 2] >= 0
