"""Variants keep what their population is: mean, covariance, tails, bounds."""

from typing import Any

import numpy as np
import pytest
import xarray as xr

import hyperpaint as hp
from hyperpaint.base.errors import PaintWarning, SchemaError
from hyperpaint.paints.paint_libraries import draw_variants


def population(count: int = 60, seed: int = 3) -> np.ndarray:
    # Return pixels of a red paint: brightness, hue and noise vary, and a third is in half shade
    rng = np.random.default_rng(seed)
    nm = np.linspace(400.0, 1000.0, 40)
    spectra = 0.03 + 0.5 / (1.0 + np.exp(-(nm - (605.0 + 3.0 * rng.standard_normal((count, 1)))) / 8.0))
    spectra *= np.where(np.arange(count) % 3 == 0, 0.5, 1.0)[:, None] * np.exp(
        0.05 * rng.standard_normal((count, 1))
    )
    return np.asarray(spectra + 0.002 * rng.standard_normal(spectra.shape))


def library_of(*members: np.ndarray) -> xr.Dataset:
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


def test_no_bandwidth_repeats_members() -> None:
    own = population(30)
    drawn = draw_variants(own, 50, np.random.default_rng(0), bandwidth=0.0)
    mean = own.mean(axis=0)
    apart = [np.abs((own - mean) - (one - mean) / np.sqrt(30 / 29)).mean(axis=1).min() for one in drawn]
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
    library = library_of(population(), population(seed=5))
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
    both = library_of(population(), population(seed=5))
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
        drawn = hp.paints.sample_paints(library_of(own), 9)
    assert np.isnan(drawn.member_reflectance.values[0]).any(axis=0).nonzero()[0].tolist() == [5]
    own[3, 4] = 1.2
    with pytest.warns(PaintWarning, match=r"1 values .*left-out"):
        drawn = hp.paints.sample_paints(library_of(own), 9)
    assert float(drawn.member_reflectance.max()) <= 1.0


@pytest.mark.parametrize(
    ("options", "text"),
    [({"count": 0}, "count=0"), ({"form": "x"}, "form='x'"), ({"bandwidth": -1.0}, "bandwidth=-1.0")],
)
def test_options_that_cannot_be(options: dict[str, Any], text: str) -> None:
    with pytest.raises(SchemaError, match=text):
        hp.paints.sample_paints(library_of(population()), **{"count": 3, **options})


def test_a_library_without_a_population_is_refused() -> None:
    with pytest.raises(SchemaError, match="member_reflectance"):
        hp.paints.sample_paints(hp.paints.starter_library(members=0), 3)
    with pytest.raises(SchemaError, match=r"(?s)0' has 1.*1' has 0"):
        hp.paints.sample_paints(library_of(population()[:1], np.full((1, 40), np.nan)), 3)
    library = library_of(population())
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
