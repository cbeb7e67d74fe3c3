"""What the uncertainties of a comparison are made of, and what is said where some are not known."""

import numpy as np
import pytest
from support.agreeing_spectra import NM, field, library, seen, value_of

import hyperpaint as hp

FIELD_NM = np.arange(380.0, 1021.0)
LEVEL = seen(FIELD_NM, 3.0)
PAINT = seen(NM, 6.0)


def readings(count: int, **spreads: float) -> hp.validation.Validation:
    # Compare a paint with readings that are nearly the same, of known uncertainty
    values = LEVEL + 1e-5 * np.arange(count)[:, None]
    made = field(values, ["hood"] * count)
    for name, value in spreads.items():
        made[f"reflectance_{name}"] = ("spectrum", "wavelength"), np.full(values.shape, value), {"units": "1"}
    return hp.validate(library(PAINT), made)


def test_repeating_does_not_lessen_what_is_systematic() -> None:
    for count in (1, 2, 5):
        assert value_of(readings(count, u_systematic=0.03), "bias_u") == pytest.approx(0.03, rel=0.1)


def test_readings_that_agree_by_chance_keep_their_noise() -> None:
    one, four = (readings(count, u_random=0.01).spectra[0]["reference_u"].median() for count in (1, 4))
    assert float(four) == pytest.approx(0.5 * float(one), rel=0.1)
    assert float(four) > 0.001


def test_what_is_known_of_some_bands_only() -> None:
    u = np.full(NM.size, np.nan)
    u[:60] = 0.005  # VIS, hardly any of NIR
    found = hp.validate(library(PAINT, reflectance_u_random=u), field(LEVEL))
    assert 700.0 < NM[59] < 710.0
    assert value_of(found, "bias_u", "VIS") > 0.0
    assert np.isnan(value_of(found, "bias_u", "NIR"))
    assert np.isnan(value_of(found, "bias_u", "all"))
    assert np.isnan(found.spectra[0]["signature_u"].values[60:]).all()
    told = "uncertainty of the signature: random part known in 60 of 117 channels"
    assert any(told in note for note in found.notes[0])


@pytest.mark.parametrize("known", ["random", "systematic"])
def test_one_part_is_said_to_be_one_part(known: str) -> None:
    other = {"random": "systematic", "systematic": "random"}[known]
    assert (
        f"uncertainty of the signature: {known} part only, the {other} part is unknown"
        in hp.validate(
            library(PAINT, **{f"reflectance_u_{known}": np.full(NM.size, 0.005)}), field(LEVEL)
        ).notes[0]
    )
    both = hp.validate(
        library(PAINT, **{f"reflectance_u_{name}": np.full(NM.size, 0.005) for name in (known, other)}),
        field(LEVEL),
    )
    assert not any("part only" in note for note in both.notes[0])


def test_pixels_that_are_not_independent_do_not_count() -> None:
    paints = library(PAINT, reflectance_sd=np.full(NM.size, 0.03)).assign(
        n=("signature", [10_000], {"units": "1"}), n_eff=("signature", [25.0], {"units": "1"})
    )
    assert value_of(hp.validate(paints, field(LEVEL)), "bias_u") == pytest.approx(0.03 / 5, rel=0.1)
    assert value_of(
        hp.validate(paints.assign(n_eff=("signature", [np.nan], {"units": "1"})), field(LEVEL)), "bias_u"
    ) == pytest.approx(0.03 / 100, rel=0.1)


def test_errors_of_opposite_signs_leave_the_mean_over_bands() -> None:
    # an error of wavelength on both flanks of a peak: large in every band, nothing in their mean
    u = np.full(NM.size, 0.01)
    signs = np.where(np.arange(NM.size) % 2, 1.0, -1.0)[None, None]
    paints = library(PAINT, reflectance_u_random=1e-5 * u, reflectance_u_systematic=u)
    alike = hp.validate(paints, field(LEVEL))
    lags = np.ones((1, 1, NM.size))
    by_source = paints.assign(
        reflectance_errors=(("signature", "error_source", "band"), 0.01 * signs, {"units": "1"}),
        error_correlation=(("signature", "lag", "band"), lags, {"units": "1"}),
    ).assign_coords(error_source=["wavelength"], error_form=("error_source", ["band systematic"]))
    apart = hp.validate(by_source, field(LEVEL))
    for each in (alike, apart):
        assert float(each.spectra[0]["signature_u"].median()) == pytest.approx(0.01, rel=0.1)
    assert value_of(alike, "bias_u") == pytest.approx(0.01, rel=0.1)
    assert value_of(apart, "bias_u") < 0.001
