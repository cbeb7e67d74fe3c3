"""The starter library: what it promises, and that other programs get it."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError
from hyperpaint.io.dirsig import open_emissivity
from hyperpaint.light.daylight_colours import srgb_hex
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
    with pytest.raises(SchemaError, match=text):
        hp.paints.starter_library(**options)


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
