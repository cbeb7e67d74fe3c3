"""The body under a coat against readings of its outside: converted where they say how, named where not."""

import warnings
from typing import Any

import numpy as np
import pytest
import xarray as xr

import hyperpaint as hp
from hyperpaint.base.errors import PaintWarning
from hyperpaint.base.mirrored_light import BODY, OUTSIDE, THROUGH_COAT
from hyperpaint.light.diffuse_record import SKY_STATES
from hyperpaint.simulation.rendering.materials import coated_reflectance

NM = np.linspace(420.0, 980.0, 113)
ALBEDO = 0.3 + 0.5 * (NM - 420.0) / 560.0
NEAR = coated_reflectance(ALBEDO)


def signature(values: np.ndarray = NEAR, quantity: str = BODY, **more: Any) -> xr.Dataset:
    component = "included" if quantity == OUTSIDE else "excluded"
    attrs = {"units": "1", "quantity": quantity, "specular_component": component}
    variables = {name: ("signature", [value]) for name, value in more.items()}
    return xr.Dataset(
        {"reflectance": (("signature", "band"), values[None].astype(np.float32), attrs), **variables},
        {"signature": ["hood"], "wavelength": ("band", NM, {"units": "nm"})},
    )


def reading(values: np.ndarray, **attrs: Any) -> xr.Dataset:
    return xr.Dataset(
        {"reflectance": (("spectrum", "wavelength"), values[None], {"units": "1", **attrs})},
        {"wavelength": ("wavelength", NM, {"units": "nm"}), "spectrum": ["hood"]},
    )


def scale(*pair: xr.Dataset) -> float:
    return float(hp.validate(*pair, reference_fwhm=5.0).statistics.bias.sel(part="all").item())


@pytest.mark.parametrize(
    ("geometry", "included"), [("d/8", True), ("d/8", False), ("0/0", True), ("45/0", False)]
)
def test_readings_of_the_outside_are_brought_to_the_body(geometry: str, included: bool) -> None:
    # What instruments read of a base under a coat is the renderer's
    seen = coated_reflectance(
        ALBEDO, geometry={"d/8": "d/0", "45/0": "0/45"}.get(geometry, geometry), specular_included=included
    )
    assert np.abs(seen / NEAR - 1.0).max() > 0.001
    field = reading(
        seen,
        quantity=OUTSIDE,
        specular_component="included" if included else "excluded",
        measurement_geometry=geometry,
    )
    one = hp.validate(signature(), field, reference_fwhm=5.0)
    assert np.abs(one.statistics.bias).max() < 2e-4
    assert any("converted to the body" in note for note in one.notes[0])
    if included:  # as it is where the signature is of the outside too
        assert not any("converted" in note for note in hp.validate(signature(seen, OUTSIDE), field).notes[0])


def test_what_cannot_be_converted_is_named() -> None:
    outside = reading(NEAR + 0.04, quantity=OUTSIDE, specular_component="included")
    with pytest.warns(PaintWarning, match="coats-differ"):
        assert scale(signature(), outside) == pytest.approx(-0.04, abs=1e-3)
    for quantity, mend in ((THROUGH_COAT, "coat=True"), (OUTSIDE, "specular_sky=True")):
        with pytest.warns(PaintWarning, match=mend):
            hp.validate(signature(quantity=quantity), reading(NEAR, quantity=BODY), reference_fwhm=5.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        hp.validate(signature(), reading(NEAR), reference_fwhm=5.0)  # of what it is nothing is said


def test_the_light_leaves_less_to_be_judged() -> None:
    assert any(
        "80 degrees from the zenith" in note
        for note in hp.validate(signature(sun_zenith=80.0), reading(NEAR)).notes[0]
    )
    odd = signature(sun_zenith=40.0, sky_state=np.int8(SKY_STATES.index("contradictory")))
    share = (("signature", "band"), np.full((1, NM.size), 0.4), {"units": "1"})
    stored = odd.assign(diffuse_fraction=share).chunk(signature=1)  # as it comes from a store
    assert any("contradicted" in note for note in hp.validate(stored, reading(NEAR)).notes[0])
    assert not any("contradicted" in note for note in hp.validate(odd, reading(NEAR)).notes[0])
