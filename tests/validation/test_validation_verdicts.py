"""What must not pass: what was not compared, and what has no reference."""

import numpy as np
import pytest
from support.agreeing_spectra import NM, agreeing, field, library, seen, smooth, value_of
from support.refusals import expect_refusals

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError


def test_a_part_that_is_asked_for_needs_bands() -> None:
    signatures, references = agreeing()
    found = hp.validate(signatures, references, parts={"red": (600.0, 700.0), "SWIR": (1500.0, 1700.0)})
    assert (
        found.statistics["passes"].values.tolist(),
        found.statistics["judged"].values.tolist(),
        found.passed,
        found.problems,
    ) == (
        [[True, False]],
        [[True, False]],
        False,
        (("hood against hood: SWIR (0 of 0 bands, too few to judge)",)),
    )
    assert "0 of 1 pair within tolerance" in found.verdict


def test_a_single_band_passes_nothing() -> None:
    values = np.full(NM.size, np.nan)
    values[60] = 0.9
    limits = {"spectral_angle": 0.01, "scale_free_error": 0.01}
    found = hp.validate(library(values), agreeing()[1], tolerance=limits)
    assert (found.statistics["bands"].sel(part="all").item(), found.passed) == (1, False)
    for name in limits:
        assert np.isnan(value_of(found, name))
        assert np.isnan(value_of(found, f"{name}_u"))
    assert not found.statistics["passes"].any()


def test_few_of_many_bands_pass_nothing_yet_can_fail() -> None:
    signatures, _ = agreeing()
    nm = np.arange(380.0, 541.0)  # most of VIS is not seen, NIR not at all
    few = field(seen(nm, 3.0), nm=nm)
    found = hp.validate(signatures, few)
    assert (found.statistics["judged"].values.tolist(), found.passed) == ([[False, False, False]], False)
    # a part that names what is seen is judged
    assert hp.validate(signatures, few, parts={"blue": (400.0, 530.0)}).passed
    # all of the spectrum is not judged, but VIS is, which suffices
    nm = np.arange(380.0, 690.0)
    most = hp.validate(signatures, field(seen(nm, 3.0), nm=nm))
    assert (most.statistics["judged"].values.tolist(), most.passed) == ([[True, False, False]], True)
    assert "not judged" in most.table()
    # what is outside fails, judged or not
    nm = np.arange(380.0, 800.0)
    outside = hp.validate(signatures, field(seen(nm, 3.0) + np.where(nm > 720, 0.2, 0.0), nm=nm))
    assert outside.statistics["judged"].sel(part="NIR").item() is False
    assert outside.statistics["passes"].sel(part="NIR").item() is False
    assert outside.statistics["passes"].sel(part="VIS").item() is True


def test_a_reference_that_is_asked_for_must_be_there() -> None:
    found = hp.validate(
        library([smooth(NM)] * 2, ("red", "blue")).assign_coords(
            reference=("signature", np.array(["", "blu.sig"], object))
        ),
        library([smooth(NM)] * 2, ("red", "blue")),
    )
    assert found.missing == ("blue (no reference 'blu.sig')",)
    assert found.statistics["passes"].all()
    assert (found.passed, found.problems) == (
        False,
        (("blue (no reference 'blu.sig'): its reference is missing",)),
    )
    assert found.verdict.endswith("1 of 2 paints compared")


def test_all_paints_can_be_required() -> None:
    paints = library([smooth(NM)] * 2, ("red", "blue"))
    references = paints.isel(signature=[0])
    assert hp.validate(paints, references).passed
    found = hp.validate(paints, references, require_all=True)
    assert (found.missing, found.passed) == ((("blue",)), False)


@pytest.mark.parametrize("wrong", [1e-7, 1e-3, 1e4])
def test_widths_of_channels_have_bounds(wrong: float) -> None:
    signatures, references = agreeing()
    widths = np.full(references.sizes["wavelength"], 3.0)
    widths[150] = wrong
    bad = references.assign_coords(fwhm=("wavelength", widths, {"units": "nm"}))
    expect_refusals(
        (SchemaError, "value-out-of-range", lambda: hp.validate(signatures, bad)),
        (
            SchemaError,
            "value-out-of-range",
            lambda: hp.validate(signatures, references, reference_fwhm=wrong),
        ),
    )
