"""The starter library: what it promises, and that other programs get it."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_error, expect_refusals

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError
from hyperpaint.io.dirsig import open_emissivity
from hyperpaint.light.daylight_colours import srgb_hex
from hyperpaint.paints import join_views
from hyperpaint.paints.paint_libraries import paint_colours
from hyperpaint.pictures.plot import library_overview
from hyperpaint.simulation.rendering.scene_spectra import FOURTEEN, paint_spec, spectrum_of


@pytest.fixture(scope="module")
def paints() -> xr.Dataset:
    return hp.paints.starter_library()


def test_its_form_names_and_swatches(paints: xr.Dataset) -> None:
    assert dict(paints.member_reflectance.sizes) == {"signature": 40, "member": 24, "band": 272}
    assert (paints.wavelength.values[[0, -1]] == [400.0, 1000.0]).all()
    for name in ("reflectance", "member_reflectance", "specular_reflectance", "reflectance_sd"):
        assert (paints[name].dtype, paints[name].attrs["units"]) == (np.float32, "1")
        assert ((paints[name] >= 0.0) & (paints[name] <= 1.0)).all(), name
    assert paints.reflectance.attrs["mirror_reflection"] == "excluded"
    assert (paints.reflectance + paints.specular_reflectance <= 1.0).all()
    names = paints["signature"].values.tolist()
    assert len(set(names)) == 40
    assert all(name.startswith("Synthetic ") and name.isascii() for name in names)
    assert set(paints.provenance.values) == {"synthetic"}
    assert [json.loads(text)[0] for text in paints.parents.values[:14]] == list(FOURTEEN)
    assert "none of them measured" in paints.attrs["title"]
    assert paints.srgb.values.tolist() == [srgb_hex(colour) for colour in paint_colours(paints)]


def test_paints_are_those_of_the_simulator(paints: xr.Dataset) -> None:
    nm = paints.wavelength.values
    assert {"solid", "metallic", "pearl"} == set(paints.finish.values)
    for number, text in enumerate(paints.parents.values):
        spec = paint_spec(json.loads(text)[0])
        share = 0.0 if spec.flakes is None else spec.flakes.share
        metal = 0.0 if spec.flakes is None else spectrum_of(spec.flakes.spectrum)(nm)
        body = (1.0 - share) * spectrum_of(spec.name)(nm)
        np.testing.assert_allclose(paints.reflectance[number], body, rtol=1e-6)
        np.testing.assert_allclose(
            paints.specular_reflectance[number], 0.04 + 0.96**2 * share * metal, rtol=1e-6
        )
        assert paints.roughness[number] == spec.coat.roughness
        assert (paints.finish[number], paints.colour[number]) == (spec.finish, spec.colour)


def test_same_call_same_bits_and_another_seed_other_members(paints: xr.Dataset) -> None:
    xr.testing.assert_identical(hp.paints.starter_library(), paints)
    other = hp.paints.starter_library(seed=1, members=4)
    np.testing.assert_array_equal(other.reflectance, paints.reflectance)
    assert not np.array_equal(other.member_reflectance, paints.member_reflectance[:, :4])


@pytest.mark.slow
def test_members_surround_their_paint(paints: xr.Dataset) -> None:
    many = hp.paints.starter_library(members=400)
    apart = many.member_reflectance.median("member") - many.reflectance
    assert float((apart / many.reflectance_sd).max()) < 0.3
    relative = (many.reflectance_sd / many.reflectance).mean("band")
    assert ((relative > 0.015) & (relative < 0.12)).all()
    assert "member_reflectance" not in hp.paints.starter_library(members=0)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"members": -1}, "members=-1"),
        ({"wavelength": [500.0, 400.0]}, "order-wrong"),
        ({"wavelength": [0.4, 0.5]}, "wavelength.*value-out-of-range"),
        ({"wavelength": []}, "wavelength.*value-out-of-range"),
    ],
)
def test_what_it_cannot_be(options: dict[str, Any], text: str) -> None:
    expect_error(SchemaError, text, lambda: hp.paints.starter_library(**options))


def test_dirsig_takes_it_without_counting_the_coat_twice(tmp_path: Path) -> None:
    solid = hp.paints.starter_library(members=3).isel(signature=[0, 3, 5])
    made = hp.write_dirsig(solid, tmp_path / "dirsig", specular="library")
    assert made.attrs["mirror_reflection"] == "excluded"
    file = tmp_path / "dirsig" / made.emissivity_file.values[2]
    back = open_emissivity(file)
    assert back.member_reflectance.shape == (1, 3, 272)
    xr.testing.assert_identical(hp.open_library(file), back)


@pytest.mark.parametrize("suffix", ["zarr", "sli", "csv"])
def test_it_is_saved_and_opened(tmp_path: Path, suffix: str) -> None:
    paints = hp.paints.starter_library(members=2)
    back = hp.open_library(hp.write_library(paints, tmp_path / f"starter.{suffix}", curves="all")).load()
    for name in paints.variables:
        np.testing.assert_array_equal(back[name], paints[name], err_msg=str(name))


def test_an_overview_is_drawn(paints: xr.Dataset, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    figure = library_overview(paints.isel(signature=slice(0, 4)), tmp_path / "starter.png")
    assert (tmp_path / "starter.png").stat().st_size > 10_000
    # two shades of quantiles in each panel
    assert all(len(axes.collections) == 2 for axes in figure.axes)


# --- Views of one car are joined by place, and their change with the angle shows flakes


BAND = np.linspace(0.0, 1.0, 30)
RED = 0.05 + 0.4 / (1.0 + np.exp(-12.0 * (BAND - 0.5)))


def views_of(
    angle: list[float], level: list[float], u: float = 0.02, east_m: list[float] | None = None
) -> xr.Dataset:
    # Views of a red paint (view,), its level over the aspecular angle; 5.5 m to the next car by default
    places = np.zeros(len(angle)) if east_m is None else np.asarray(east_m)
    spectra = np.float32(np.outer(level, RED / RED.mean()))
    return xr.Dataset(
        {
            "reflectance": (("signature", "band"), spectra, {"units": "1"}),
            "aspecular_angle": ("signature", np.asarray(angle, float), {"units": "degree"}),
        },
        {
            "signature": [f"red-{number:02}" for number in range(len(angle))],
            "latitude": ("signature", np.full(len(angle), 48.0)),
            "longitude": ("signature", 11.0 + places / (111_195.0 * np.cos(np.radians(48.0)))),
            "level_uncertainty": ("signature", np.full(len(angle), u)),
        },
    )


def test_places__join_views_and_part_neighbours() -> None:
    """Expected: views 1 m apart are one car; the next bay, 2.5 m on, is another; no place, a car alone."""
    views = views_of([20.0] * 4, [0.3] * 4, east_m=[0.0, 1.0, 2.5, 0.5])
    views["latitude"][3] = np.nan
    joined = join_views(views)
    assert joined.views.values.tolist() == [2, 2, 1, 1]
    assert joined.car.values.tolist() == ["red-00", "red-00", "red-02", "red-03"]
    assert join_views(views, distance=0.5).views.values.tolist() == [1, 1, 1, 1]
    expect_refusals((SchemaError, "value-out-of-range", lambda: join_views(views, distance=0.0)))


@pytest.mark.parametrize(
    ("change", "u", "finish"),
    [(-0.013, 0.02, "metallic"), (-0.035, 0.05, "metallic"), (0.0, 0.02, "solid"), (0.0, 0.10, "unknown")],
    ids=["flop index 5", "flop index 17", "solid", "too uncertain"],
)
def test_finish__follows_from_the_change_with_the_angle(change: float, u: float, finish: str) -> None:
    """Rationale: flakes darken by 1.3 to 3.5 % a degree away from the mirrored sun, solid paint does not."""
    angle = np.array([20.0, 35.0, 50.0])
    joined = join_views(views_of(angle.tolist(), np.exp(change * (angle - 35.0)).tolist(), u))
    assert set(joined.finish.values) == {finish}
    np.testing.assert_allclose(joined.level_change, change, atol=1e-6)
    np.testing.assert_allclose(joined.level_change_u, u / np.sqrt(450.0), rtol=1e-6)


def test_lean__cancels_between_views_that_are_not_too_near() -> None:
    """Expected: a car leans alike in all views, and its slope is uncertain by the other causes alone."""
    views = views_of([20.0, 50.0], [0.35, 0.30], 0.05)
    terms = '{"noise and dust": 0.01, "an unknown lean of 0.9 degrees": 0.049}'
    joined = join_views(views.assign_coords(level_terms=("signature", [terms, terms])))
    np.testing.assert_allclose(joined.level_change_u, 0.01 * np.sqrt(2.0) / 30.0, rtol=1e-6)
    assert set(joined.finish.values) == {"metallic"}
    # angles too near decide nothing
    joined = join_views(views_of([30.0, 36.0], [0.3, 0.2]))
    assert set(joined.finish.values) == {"unknown"}
    assert np.isnan(joined.level_change).all()


def test_best_view__has_least_mirrored_light_and_is_no_stray() -> None:
    """Expected: of alike views the lowest; of flakes the surest."""
    assert join_views(views_of([30.0, 31.0, 32.0], [0.31, 0.30, 0.33])).is_best.values.tolist() == [
        False, True, False,
    ]  # fmt: skip
    flakes = views_of([20.0, 60.0], [0.5, 0.2])
    flakes["level_uncertainty"][0] = 0.01
    joined = join_views(flakes)
    assert joined.is_best.values.tolist() == [True, False]
    assert joined.isel(signature=joined.is_best).sizes["signature"] == 1
    # a view of another colour decides neither on the finish nor is it the best
    views = views_of([20.0, 35.0, 50.0, 65.0], [0.3] * 4)
    views["reflectance"][1] += 0.1
    joined = join_views(views)
    assert joined.is_stray.values.tolist() == [False, True, False, False]
    assert set(joined.finish.values) == {"solid"}
    assert not joined.is_best[1]


def test_missing_values__decide_nothing() -> None:
    """Expected: a view without values or without an angle is joined, and the others decide as without it."""
    views = views_of([20.0, 35.0, 50.0, 50.0, np.nan], [0.3] * 5)
    views["reflectance"][2] = np.nan
    joined = join_views(views)
    assert joined.views.values.tolist() == [5] * 5
    assert set(joined.finish.values) == {"solid"}
    assert joined.is_best.sum() == 1
    assert not joined.is_best[2]
    assert join_views(views.isel(signature=[2])).is_best.all()
    assert join_views(views.isel(signature=[])).sizes["signature"] == 0
