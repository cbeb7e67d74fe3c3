"""Whether reflectance holds mirrored light, told alike to all who ask."""

import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_errors

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.mirrored_light import EXCLUDED, INCLUDED, mirror_reflection
from hyperpaint.io.dirsig.dirsig_writing import Coats, PaintCurves
from hyperpaint.paints.paint_libraries import coating_of
from hyperpaint.validation.validating import _library_spectra

CASES = [
    ({}, False, None),
    ({"mirror_reflection": "included"}, False, INCLUDED),
    ({"mirror_reflection": "excluded"}, False, EXCLUDED),
    ({}, True, EXCLUDED),
    ({"mirror_reflection": "included"}, True, INCLUDED),
    ({"mirrored_sky_removed": "F0 0.04 x sky view 1 x diffuse fraction (model)"}, False, EXCLUDED),
    ({"mirrored_sky_removed": "none"}, False, INCLUDED),
    ({"mirrored_sky_removed": ""}, False, INCLUDED),
    ({"mirrored_sky_removed": "F0 0.04; none"}, False, INCLUDED),
    ({"mirrored_sky_removed": "none"}, True, EXCLUDED),
    ({"mirrored_sky_removed": "F0 0.04", "mirror_reflection": "included"}, False, INCLUDED),
]


def library(attrs: dict[str, str], apart: bool) -> xr.Dataset:
    spectra = (("signature", "band"), np.full((1, 3), 0.3, np.float32), {"units": "1"})
    made = xr.Dataset(
        {"reflectance": spectra},
        {"signature": ["red"], "wavelength": ("band", [450.0, 550.0, 650.0], {"units": "nm"})},
    )
    if apart:
        made["specular_reflectance"] = spectra
    made["reflectance"].attrs |= attrs
    return made


@pytest.mark.parametrize(("attrs", "apart", "expected"), CASES)
def test_all_are_told_the_same(attrs: dict[str, str], apart: bool, expected: str | None) -> None:
    paints = library(attrs, apart)
    assert mirror_reflection(paints) == expected
    attrs = PaintCurves(paints, Coats(np.zeros(1), np.zeros(1))).attrs
    assert attrs["mirror_reflection"] == (expected or INCLUDED)
    assert attrs["mirror_reflection_source"].startswith("stated") == (expected is not None)
    assert float(coating_of(paints, 0.04, 0.6, None).mirrored) == (0.0 if expected == EXCLUDED else 0.04)
    assert next(_library_spectra(paints, 0, None, "band")).mirror == (expected or "unknown")


def test_the_word_may_stand_at_the_library() -> None:
    paints = library({}, False).assign_attrs(mirror_reflection="excluded")
    assert mirror_reflection(paints) == EXCLUDED
    paints["reflectance"].attrs["mirror_reflection"] = "included"
    assert mirror_reflection(paints) == INCLUDED


def test_another_word_is_refused() -> None:
    paints = library({"mirror_reflection": "yes"}, False)
    expect_errors(
        (SchemaError, r"'yes'.*choice-unknown", lambda: mirror_reflection(paints)),
        (SchemaError, "'yes'", lambda: hp.paints.mix_paints(paints, {"same": {"red": 1.0}})),
        (SchemaError, "'yes'", lambda: PaintCurves(paints, Coats(np.zeros(1), np.zeros(1)))),
    )
