"""Mixtures and shades against numbers worked out by hand."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, strategies as st
from scipy.integrate import solve_ivp
from support.library_examples import make_library
from support.refusals import expect_error, expect_errors

import hyperpaint as hp
from hyperpaint.base.errors import PaintWarning, SchemaError
from hyperpaint.paints.paint_libraries import (
    Interface,
    absorption_to_scattering,
    draw_variants,
    thick_layer_reflectance,
)
from hyperpaint.simulation.rendering.materials import fresnel_reflectance, internal_reflectance
from hyperpaint.simulation.rendering.scene_spectra import Paint

WHITE, BLACK, RED = "Synthetic Polar White", "Synthetic Carbon Black", "Synthetic Signal Red"


def library_of(spectra: dict[str, list[float]], mirror: str | None = "excluded") -> xr.Dataset:
    # Return a library of a few bands
    bands = len(next(iter(spectra.values())))
    attrs = {"units": "1", **({} if mirror is None else {"mirror_reflection": mirror})}
    return xr.Dataset(
        {"reflectance": (("signature", "band"), np.float32(list(spectra.values())), attrs)},
        {
            "signature": np.array(list(spectra), object),
            "wavelength": ("band", np.linspace(450.0, 900.0, bands), {"units": "nm"}),
        },
    )


@pytest.fixture(scope="module")
def paints() -> xr.Dataset:
    return hp.paints.starter_library(members=6)


def test_mixtures_by_hand() -> None:
    # without an interface: R = 0.5 has K/S 0.25, R = 0.2 has 1.6; a half of each 0.925
    library = library_of({"a": [0.5, 0.5], "b": [0.2, 0.5]})
    made = hp.paints.mix_paints(library, {"c": {"a": 1.0, "b": 1.0}}, k1=0.0, k2=0.0)
    np.testing.assert_allclose(made.reflectance.values[0], [1.925 - np.sqrt(1.925**2 - 1.0), 0.5], rtol=1e-6)
    library = library_of({"a": [0.5, 0.4], "b": [0.2, 0.5]})
    thrice = hp.paints.mix_paints(library, {"c": {"a": 1, "b": 1}}, scattering={"a": 3.0})
    parts = hp.paints.mix_paints(library, {"c": {"a": 3, "b": 1}})
    np.testing.assert_array_equal(thrice.reflectance, parts.reflectance)
    assert (thrice.attrs["scattering"], json.loads(thrice.weights.item())) == ("a 3", [0.5, 0.5])
    turned = (library * 100.0).transpose("band", "signature")
    turned["reflectance"].attrs = {"units": "percent", "mirror_reflection": "excluded"}
    made, other = (hp.paints.mix_paints(one, {"c": {"a": 1, "b": 1}}) for one in (library, turned))
    np.testing.assert_allclose(made.reflectance, other.reflectance, rtol=1e-6)
    library = library_of({"a": [0.5, np.nan, 0.5], "b": [0.2, 0.3, 0.4], "c": [0.1, 0.1, 0.1]})
    made = hp.paints.mix_paints(library, {"ab": {"a": 1, "b": 1}, "bc": {"a": 0, "b": 1, "c": 1}})
    assert np.isnan(made.reflectance.values).tolist() == [[False, True, False], [False] * 3]


@pytest.mark.parametrize("mirror", ["excluded", "included"])
def test_mirrored_light_is_taken_off_and_put_back(mirror: str) -> None:
    layers = np.array([[0.8, 0.3], [0.1, 0.6]])
    offset = 0.04 if mirror == "included" else 0.0
    seen = Interface().outside(layers) + offset
    library = library_of({"a": seen[0].tolist(), "b": seen[1].tolist()}, mirror)
    made = hp.paints.mix_paints(library, {"c": {"a": 3, "b": 1}})
    ratio = np.array([0.75, 0.25]) @ absorption_to_scattering(layers)
    expected = Interface().outside(thick_layer_reflectance(ratio)) + offset
    np.testing.assert_allclose(made.reflectance.values[0], expected, rtol=1e-6)
    assert made.reflectance.attrs["mirror_reflection"] == mirror


def test_linear_mixing_is_a_mean_and_pigments_darken_more(paints: xr.Dataset) -> None:
    made = hp.paints.mix_paints(paints, {"pink": {WHITE: 3, RED: 1}}, method="linear")
    own = paints.reflectance.values.astype(np.float64)
    np.testing.assert_allclose(made.reflectance.values[0], 0.75 * own[0] + 0.25 * own[5], rtol=1e-6)
    recipe = {"grey": {WHITE: 0.9, BLACK: 0.1}}
    pot, side = (
        hp.paints.mix_paints(paints, recipe, method=m).reflectance for m in ("kubelka-munk", "linear")
    )
    assert (pot <= side + 1e-6).all()
    assert float(pot.mean()) < 0.3 * float(side.mean())


@given(
    st.lists(st.floats(0.0, 1.0), min_size=3, max_size=3),
    st.lists(st.floats(0.0, 1.0), min_size=3, max_size=3),
    st.floats(0.01, 1.0),
)
@pytest.mark.filterwarnings("ignore:.*reflectance-outside-model:hyperpaint.base.errors.PaintWarning")
def test_mixtures_lie_between_their_parents(first: list[float], second: list[float], share: float) -> None:
    library = library_of({"a": first, "b": second})
    made = hp.paints.mix_paints(library, {"c": {"a": share, "b": 1.0}}).reflectance.values[0]
    low = np.minimum(*library.reflectance.values) - 1e-6
    high = np.maximum(*library.reflectance.values) + 1e-6
    # what no layer can have is replaced: blacker than a thousandth, brighter than 1 - k1
    assert ((made >= np.minimum(low, 0.96)) & (made <= np.maximum(high, 4e-4))).all()


def test_one_parent_alone_is_itself_with_members_and_coat(paints: xr.Dataset) -> None:
    made = hp.paints.mix_paints(paints, {"same": {RED: 2.0, WHITE: 0.0}})
    np.testing.assert_allclose(made.reflectance[0], paints.reflectance[5], rtol=2e-6)
    np.testing.assert_allclose(made.member_reflectance[0], paints.member_reflectance[5], rtol=2e-6)
    np.testing.assert_allclose(made.reflectance_sd[0], paints.reflectance_sd[5], rtol=1e-3, atol=1e-7)
    np.testing.assert_allclose(made.specular_reflectance[0], paints.specular_reflectance[5])
    # a coat in percent is converted
    percent = paints.assign(
        specular_reflectance=(100.0 * paints.specular_reflectance).assign_attrs(units="%")
    )
    mixed = hp.paints.mix_paints(percent, {"same": {RED: 1.0}})
    for made in (mixed, hp.paints.shade_paints(percent.isel(signature=[5]), [1.0])):
        np.testing.assert_allclose(made.specular_reflectance[0], paints.specular_reflectance[5], rtol=1e-5)


def test_provenance_is_told_and_survives_stores(paints: xr.Dataset, tmp_path: Path) -> None:
    made = hp.paints.mix_paints(paints, {"Grün, hell": {WHITE: 2, "Synthetic Arctic Green": 1}})
    assert made.provenance.item() == made.attrs["provenance"] == "synthetic"
    assert json.loads(made.parents.item()) == [WHITE, "Synthetic Arctic Green"]
    assert json.loads(made.weights.item()) == pytest.approx([2 / 3, 1 / 3])
    assert made.reflectance.dtype == made.member_reflectance.dtype == np.float32
    for name in ("made.zarr", "made.sli", "made.csv"):
        back = hp.open_library(hp.write_library(made, tmp_path / name, curves="all")).load()
        np.testing.assert_array_equal(back.member_reflectance, made.member_reflectance)
        assert (back["signature"].item(), back.parents.item()) == ("Grün, hell", made.parents.item())
        assert back.reflectance.attrs["mirror_reflection"] == "excluded"


def test_what_cannot_be_mixed_is_refused_all_at_once() -> None:
    twins = make_library()
    twins["signature"] = twins["signature"].str.replace("Grün (2)", "Grün", regex=False)
    with pytest.raises(SchemaError) as told:
        hp.paints.mix_paints(
            twins,
            {"x": {"Grün": 1.0}, "y": {"red, mat": 1.0}, "z": {"red, matt": -1.0}, "w": {}},
            method="magic",  # type: ignore[arg-type]
            scattering={"red, matt": 0.0},
        )
    assert sorted(told.value.codes) == [
        "choice-unknown",
        "paint-ambiguous",
        "paint-unknown",
        *["value-out-of-range"] * 3,
    ]
    assert "did you mean 'red, matt'" in [problem.mend for problem in told.value.problems][2]


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"mirrored": [0.1]}, "length-mismatch"),
        ({"mirrored": 1.0}, "mirrored.*value-out-of-range"),
        ({"k1": 1.5}, "k1=1.5"),
    ],
)
def test_impossible_coats_are_refused(options: dict[str, Any], text: str) -> None:
    library = library_of({"a": [0.5, 0.4], "b": [0.2, 0.5]})
    expect_error(SchemaError, text, lambda: hp.paints.mix_paints(library, {"c": {"a": 1, "b": 1}}, **options))


def test_less_light_than_the_coat_mirrors_is_refused_with_a_way_out() -> None:
    field = library_of({"black": [0.03, 0.02], "white": [0.8, 0.8]}, "included")
    expect_error(
        SchemaError,
        r"100%.*paint-too-dark",
        lambda: hp.paints.mix_paints(field, {"grey": {"black": 1, "white": 9}}),
    )
    made = hp.paints.mix_paints(field, {"grey": {"black": 1, "white": 9}}, mirrored=[0.016, 0.004])
    assert (made.reflectance > 0.02).all()


def test_impossible_reflectance_is_replaced_with_a_warning() -> None:
    library = library_of({"black": [-0.01, 0.02, 0.02], "white": [0.8, 0.99, 0.8]})
    with pytest.warns(PaintWarning, match=r"1 of 6 .*outside-model"):
        made = hp.paints.mix_paints(library, {"grey": {"black": 1, "white": 9}})
    assert ((made.reflectance > 0.0) & (made.reflectance < 1.0)).all()
    library = library_of({"a": [1.2, 0.5, np.nan], "b": [-0.02, 0.5, 0.5]})
    with pytest.warns(PaintWarning, match=r"2 of 5.*-clipped"):
        mixed = hp.paints.mix_paints(library, {"x": {"a": 1.0}, "y": {"b": 1.0}}, method="linear")
    np.testing.assert_array_equal(mixed.reflectance, np.float32([[1.0, 0.5, np.nan], [0.0, 0.5, 0.5]]))


# --- shades ---


def test_depths_multiply_absorption(paints: xr.Dataset) -> None:
    red = paints.isel(signature=[5])
    ladder = hp.paints.shade_paints(red, [0.25, 1.0, 4.0])
    assert ladder["signature"].values.tolist() == [f"{RED} x {depth}" for depth in ("0.25", "1", "4")]
    assert ladder.depth.values.tolist() == [0.25, 1.0, 4.0]
    np.testing.assert_allclose(ladder.reflectance[1], red.reflectance[0], rtol=2e-6)
    ratio = absorption_to_scattering(Interface().layer(ladder.reflectance.values.astype(np.float64)))
    np.testing.assert_allclose(ratio[2] / ratio[0], 16.0, rtol=1e-4)
    assert (np.diff(ladder.reflectance, axis=0) < 0.0).all()
    assert ladder.member_reflectance.shape == (3, 6, 272)
    library = library_of({"a": [0.5, 0.3], "ideal": [0.96, 0.96]})
    tint = hp.paints.shade_paints(library.isel(signature=[0]), [0.1])
    mixed = hp.paints.mix_paints(library, {"m": {"a": 1, "ideal": 9}})
    np.testing.assert_allclose(tint.reflectance, mixed.reflectance, rtol=1e-5)


@pytest.mark.parametrize("depths", [[], [0.0], [np.nan], 2.0])
def test_depths_that_cannot_be(paints: xr.Dataset, depths: Any) -> None:
    expect_error(SchemaError, "value-out-of-range", lambda: hp.paints.shade_paints(paints, depths))


# --- members, and units ---


def with_members(counts: dict[str, list[int]], members: int = 4) -> xr.Dataset:
    # Return paints of two bands that have the members said, all of the reflectance of their paint
    library = library_of({name: [0.2 + 0.1 * k, 0.5] for k, name in enumerate(counts)})
    stack = np.full((len(counts), members, 2), np.nan, np.float32)
    for number, held in enumerate(counts.values()):
        stack[number, held] = library.reflectance.values[number] * (1.0 + 0.01 * np.float32(held)[:, None])
    library["member_reflectance"] = (("signature", "member", "band"), stack, {"units": "1"})
    return library


def test_every_paint_keeps_its_own_members() -> None:
    library = with_members({"all": [0, 1, 2, 3], "two": [0, 2], "none": [], "late": [2, 3]})
    shades = hp.paints.shade_paints(library, [1.0])
    held = np.isfinite(shades.member_reflectance.values).all(axis=2)
    assert held.sum(axis=1).tolist() == [4, 2, 0, 2]
    # padding comes last
    assert (np.diff(held.astype(int), axis=1) <= 0).all()
    own = library.member_reflectance.values
    np.testing.assert_allclose(shades.member_reflectance[0], own[0], rtol=1e-6)
    np.testing.assert_allclose(shades.member_reflectance[3, :2], own[3, 2:], rtol=1e-6)
    np.testing.assert_allclose(shades.reflectance_sd[1], own[1, [0, 2]].std(axis=0, ddof=1), rtol=1e-3)
    np.testing.assert_allclose(shades.reflectance_quantiles[3, 2], own[3, 2:].mean(axis=0), rtol=1e-5)
    assert np.isnan(shades.reflectance_sd.values[2]).all()
    assert np.isnan(shades.reflectance_quantiles.values[2]).all()


@pytest.mark.parametrize("method", ["kubelka-munk", "linear"])
def test_members_without_a_partner_are_left_out_with_a_warning(method: Any) -> None:
    library = with_members({"all": [0, 1, 2, 3], "two": [0, 2], "late": [2, 3], "none": []})
    recipes = {"a": {"all": 1.0}, "b": {"two": 1.0, "late": 3.0}, "c": {"all": 1.0, "two": 0.0}}
    mixed = hp.paints.mix_paints(library, recipes, method=method)
    assert np.isfinite(mixed.member_reflectance.values).all(axis=2).sum(axis=1).tolist() == [4, 2, 4]
    assert np.isfinite(mixed.reflectance_sd).all()
    with pytest.warns(PaintWarning, match=r"2 m.*1 of 2.*unpaired"):
        mixed = hp.paints.mix_paints(
            library, {"a": {"all": 1.0}, "d": {"all": 1.0, "two": 1.0}}, method=method
        )
    assert np.isfinite(mixed.member_reflectance.values).all(axis=2).sum(axis=1).tolist() == [4, 2]
    with pytest.warns(PaintWarning, match="members-unpaired"):
        alone = hp.paints.mix_paints(library, {"e": {"all": 1.0, "none": 1.0}}, method=method)
    assert "member_reflectance" not in alone


# --- the thick layer, its interface, and what they are worth against another way to the same numbers ------


@pytest.mark.parametrize("ratio", [0.003, 0.2, 1.5, 20.0])
def test_a_thick_layer_is_what_the_two_streams_end_at(ratio: float) -> None:
    # dR/dx = S - 2 (S + K) R + S R^2 from a black ground up: Kubelka and Munk's differential equation
    found = solve_ivp(
        lambda _, r: 1.0 - 2.0 * (1.0 + ratio) * r + r**2, (0.0, 400.0), [0.0], rtol=1e-10, atol=1e-12
    )
    assert thick_layer_reflectance(ratio) == pytest.approx(found.y[0, -1], rel=1e-8)


def test_judds_table_and_the_interface() -> None:
    # Judd & Wyszecki, Color in Business, Science and Industry: K/S of 0.5, 0.1 and 0.9
    np.testing.assert_allclose(absorption_to_scattering([0.5, 0.1, 0.9]), [0.25, 4.05, 0.005556], rtol=1e-4)
    interface, layer = Interface(), 0.7
    light, left = 1.0 - interface.k1, 0.0
    for _ in range(200):
        up = light * layer
        left += up * (1.0 - interface.k2)
        light = up * interface.k2
    assert interface.outside(layer) == pytest.approx(left, rel=1e-12)
    assert Interface().k1 == pytest.approx(float(fresnel_reflectance(1.0, 1.5)))
    assert Interface().k2 == pytest.approx(internal_reflectance(1.5), abs=0.005)
    ratio = np.array([0.01, 0.3, 12.0])
    simulated = np.array([Paint(q)(np.array([550.0]))[0] for q in ratio])
    mine = Interface().k1 + Interface().outside(thick_layer_reflectance(ratio))
    np.testing.assert_allclose(mine, simulated, rtol=1e-12)
    expect_error(SchemaError, r"(?s)k1=1\.0.*k2=-0\.1", lambda: Interface(1.0, -0.1))


@given(st.floats(1e-6, 1.0), st.floats(0.0, 0.9), st.floats(0.0, 0.9))
def test_both_are_undone_and_bounded(layer: float, k1: float, k2: float) -> None:
    interface = Interface(k1, k2)
    seen = interface.outside(layer)
    assert 0.0 <= seen <= (1.0 - k1) * (1.0 + 1e-12)
    assert interface.layer(seen) == pytest.approx(layer, rel=1e-9)
    assert thick_layer_reflectance(absorption_to_scattering(layer)) == pytest.approx(layer, rel=1e-7)


# --- variants keep what their population is: mean, covariance, tails, bounds ------------------------------


def population(count: int = 60, seed: int = 3) -> np.ndarray:
    # Return pixels of a red paint: brightness, hue and noise vary, and a third is in half shade
    rng = np.random.default_rng(seed)
    nm = np.linspace(400.0, 1000.0, 40)
    spectra = 0.03 + 0.5 / (1.0 + np.exp(-(nm - (605.0 + 3.0 * rng.standard_normal((count, 1)))) / 8.0))
    spectra *= np.where(np.arange(count) % 3 == 0, 0.5, 1.0)[:, None] * np.exp(
        0.05 * rng.standard_normal((count, 1))
    )
    return np.asarray(spectra + 0.002 * rng.standard_normal(spectra.shape))


def library_of_paints(*members: np.ndarray) -> xr.Dataset:
    # Return a library of populations
    stack = np.float32(np.stack(members))
    return xr.Dataset(
        {
            "reflectance": (("signature", "band"), np.nan_to_num(stack).mean(axis=1), {"units": "1"}),
            "member_reflectance": (("signature", "member", "band"), stack, {"units": "1"}),
        },
        {
            "signature": np.array([f"paint {k}" for k in range(len(members))], object),
            "make": ("signature", np.array(["VW"] * len(members), object)),
            "wavelength": ("band", np.linspace(400.0, 1000.0, stack.shape[2]), {"units": "nm"}),
        },
    )


def test_mean_covariance_and_groups_are_kept() -> None:
    own = population()
    drawn = draw_variants(own, 40_000, np.random.default_rng(0))
    mean, spread = own.mean(axis=0), own.std(axis=0, ddof=1)
    # standard error of the mean of 40 000: 0.005 spreads; the curved scale moves it by a little more
    assert np.abs((drawn.mean(axis=0) - mean) / spread).max() < 0.04
    covariance, other = np.cov(own.T), np.cov(drawn.T)
    assert np.linalg.norm(other - covariance) < 0.06 * np.linalg.norm(covariance)
    assert np.abs(drawn.std(axis=0, ddof=1) / spread - 1.0).max() < 0.06
    level = draw_variants(population(), 4000, np.random.default_rng(0))[:, -1]
    # half shade at 0.27, light at 0.53: little between, which a normal distribution would fill
    between = ((level > 0.35) & (level < 0.42)).mean()
    assert (level < 0.38).mean() == pytest.approx(1 / 3, abs=0.05)
    normal = draw_variants(population(), 4000, np.random.default_rng(0), bandwidth=20.0)[:, -1]
    assert between < 0.5 * ((normal > 0.35) & (normal < 0.42)).mean()
    # no bandwidth repeats members
    few = population(30)
    drawn = draw_variants(few, 50, np.random.default_rng(0), bandwidth=0.0)
    middle = few.mean(axis=0)
    apart = [np.abs((few - middle) - (one - middle) / np.sqrt(30 / 29)).mean(axis=1).min() for one in drawn]
    assert max(apart) < 2e-3


@pytest.mark.parametrize("level", [0.0005, 0.9995])
def test_variants_stay_between_nothing_and_all(level: float) -> None:
    rng = np.random.default_rng(0)
    own = level + 0.001 * rng.standard_normal((50, 20))
    drawn = draw_variants(own, 2000, rng, bandwidth=3.0)
    assert ((drawn >= 0.0) & (drawn <= 1.0)).all()
    assert drawn.mean() == pytest.approx(level, abs=3e-4)
    assert drawn.std() == pytest.approx(own.std(), rel=0.4)


def test_members_and_paints_are_the_same_draws() -> None:
    library = library_of_paints(population(), population(seed=5))
    library["reflectance"].attrs["mirror_reflection"] = "included"
    drawn, paints = (hp.paints.sample_paints(library, 7, form=form) for form in ("members", "paints"))
    assert dict(drawn.member_reflectance.sizes) == {"signature": 2, "member": 7, "band": 40}
    np.testing.assert_array_equal(drawn.member_reflectance.values.reshape(14, 40), paints.reflectance)
    np.testing.assert_allclose(drawn.reflectance, drawn.member_reflectance.mean("member"), rtol=1e-5)
    assert drawn.reflectance.dtype == drawn.member_reflectance.dtype == np.float32
    assert paints["signature"].values[8] == "paint 1 (synthetic 2)"
    assert (paints.parents.values[8], set(paints.provenance.values)) == ('["paint 1"]', {"synthetic"})
    assert paints.make.values.tolist() == ["VW"] * 14
    assert paints.reflectance.attrs["mirror_reflection"] == "included"
    both = library_of_paints(population(), population(seed=5))
    drawn, alone = hp.paints.sample_paints(both, 12), hp.paints.sample_paints(both.isel(signature=[1]), 12)
    np.testing.assert_array_equal(drawn.member_reflectance[1], alone.member_reflectance[0])
    np.testing.assert_array_equal(
        hp.paints.sample_paints(both, 12).member_reflectance, drawn.member_reflectance
    )
    other = hp.paints.sample_paints(both, 12, seed=1)
    assert not np.array_equal(other.member_reflectance, drawn.member_reflectance)


def test_members_left_out_and_clipped_are_warned_of() -> None:
    own = population()
    own[:40, 5] = np.nan  # most lack this band
    own[50, 20] = np.nan  # one lacks another
    own[55:] = np.nan  # padding
    with pytest.warns(PaintWarning, match=r"1 members .*left-out"):
        drawn = hp.paints.sample_paints(library_of_paints(own), 9)
    assert np.isnan(drawn.member_reflectance.values[0]).any(axis=0).nonzero()[0].tolist() == [5]
    own[3, 4] = 1.2
    with pytest.warns(PaintWarning, match=r"1 values .*left-out"):
        drawn = hp.paints.sample_paints(library_of_paints(own), 9)
    assert float(drawn.member_reflectance.max()) <= 1.0


@pytest.mark.parametrize(
    ("options", "text"),
    [({"count": 0}, "count=0"), ({"form": "x"}, "form='x'"), ({"bandwidth": -1.0}, "bandwidth=-1.0")],
)
def test_options_that_cannot_be(options: dict[str, Any], text: str) -> None:
    expect_error(
        SchemaError,
        text,
        lambda: hp.paints.sample_paints(library_of_paints(population()), **{"count": 3, **options}),
    )


def test_a_library_without_a_population_is_refused() -> None:
    expect_errors(
        (
            SchemaError,
            "member_reflectance",
            lambda: hp.paints.sample_paints(hp.paints.starter_library(members=0), 3),
        ),
        (
            SchemaError,
            r"(?s)0' has 1.*1' has 0",
            lambda: hp.paints.sample_paints(library_of_paints(population()[:1], np.full((1, 40), np.nan)), 3),
        ),
    )
    library = library_of_paints(population())
    library["specular_reflectance"] = xr.full_like(library.reflectance, 4.0).assign_attrs(units="percent")
    drawn = hp.paints.sample_paints(library, 3)
    np.testing.assert_allclose(drawn.specular_reflectance, 0.04, rtol=1e-6)
    assert drawn.specular_reflectance.attrs["units"] == "1"


@pytest.mark.parametrize(("level", "noise"), [(0.015, 0.01), (0.02, 0.006), (0.985, 0.01)])
def test_noise_near_black_and_white_is_kept(level: float, noise: float) -> None:
    # Rationale: on a logit scale with a margin below the noise, tails grew three times too long
    rng = np.random.default_rng(0)
    own = level + noise * rng.standard_normal((300, 40))
    drawn = draw_variants(own, 4000, rng)
    # nothing is below 0, of variants: that much is told of the population, too
    held = np.clip(own, 0.0, 1.0)
    assert drawn.mean() == pytest.approx(held.mean(), abs=0.03 * noise)
    np.testing.assert_allclose(drawn.std(axis=0), held.std(axis=0), rtol=0.1)
    beyond = own.std(axis=0)  # Silverman's rule never gives more than one of these
    assert (drawn <= own.max(axis=0) + beyond).all()
    assert (drawn >= own.min(axis=0) - beyond).all()
