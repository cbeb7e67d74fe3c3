"""Paints by name, colour and spectral angle."""

from typing import Any

import dask.array
import numpy as np
import pytest
import xarray as xr
from support.library_examples import make_library
from support.refusals import expect_error, expect_errors

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError, UnitsError
from hyperpaint.light.daylight_colours import COLOURS, ciede2000, lab_of, parse_colour, srgb_hex
from hyperpaint.paints.paint_libraries import one_spectrum, paint_colours
from hyperpaint.validation.validating import statistics_of

RED = "Synthetic Signal Red"


@pytest.fixture(scope="module")
def paints() -> xr.Dataset:
    return hp.paints.starter_library(members=2)


def names(found: xr.Dataset) -> list[str]:
    return [str(name) for name in found["signature"].values]


@pytest.mark.parametrize(
    ("wanted", "expected"),
    [
        ("RED", ["red, matt"]),
        ("grün", ["Grün", "Grün (2)"]),
        ("grun", ["Grün", "Grün (2)"]),
        ("GRUEN", ["Grün", "Grün (2)"]),
        ("gr?n", ["Grün"]),
        ("gr*en", ["Grün"]),
        ("gr", ["Grün", "Grün (2)"]),
        ("gr?", []),
        ("a/b*", ['a/b "x" | c {d}']),
        ("[r]ed*", ["red, matt"]),
        (".*", []),
    ],
)
def test_names(wanted: str, expected: list[str]) -> None:
    assert names(hp.paints.search_library(make_library(), name=wanted)) == expected


def test_a_sharp_s_and_decomposed_letters() -> None:
    library = make_library().assign_coords(
        signature=("signature", np.array(["Weiß", "Gru\u0308n", "Škoda", "Bœuf", "x"], object))
    )
    for wanted, expected in (
        ("weiss", "Weiß"),
        ("grün", "Gru\u0308n"),
        ("skoda", "Škoda"),
        ("ŠKODA", "Škoda"),
    ):
        assert names(hp.paints.search_library(library, name=wanted)) == [expected]


def test_paints_are_found_by_swatch_and_word(paints: xr.Dataset) -> None:
    for name, digits in zip(names(paints), paints.srgb.values, strict=True):
        found = hp.paints.search_library(paints, colour=digits)
        # a swatch is rounded to eight bits
        assert found.colour_difference[names(found).index(name)] < 1.0
        assert (np.diff(found.colour_difference) >= 0.0).all()
        assert found.sizes["signature"] == 40
    for word in ("white", "red", "blue", "green", "yellow", "black", "violet", "brown"):
        found = hp.paints.search_library(paints, colour=word, limit=1)
        assert word in found.colour.item(), (word, found.colour.item())
    turned = paints.isel(band=slice(None, None, -1))
    found, other = (hp.paints.search_library(one, colour="blue") for one in (paints, turned))
    assert names(found) == names(other)
    np.testing.assert_allclose(found.colour_difference, other.colour_difference, atol=1e-3)
    assert np.isfinite(paint_colours(paints)).all()


def test_limits_and_bad_bands_leave_out(paints: xr.Dataset) -> None:
    near = hp.paints.search_library(paints, colour="red", maximum_colour_difference=10.0)
    assert 0 < near.sizes["signature"] < 10
    assert float(near.colour_difference.max()) <= 10.0
    alike = hp.paints.search_library(paints, like=RED, maximum_angle=0.1, limit=3, name="*red")
    assert (names(alike)[0], float(alike.spectral_angle[0])) == (RED, pytest.approx(0.0, abs=1e-7))
    assert alike.spectral_angle.attrs["units"] == "rad"
    assert hp.paints.search_library(paints, name="no such paint").sizes["signature"] == 0
    spoilt = paints.copy(deep=True)
    good = np.ones(272, bool)
    good[100] = False
    spoilt.reflectance[:, 100] = 5.0
    spoilt.reflectance[7] = np.nan
    spoilt = spoilt.assign_coords(good=("band", good))
    found = hp.paints.search_library(spoilt, like=paints.isel(signature=5), colour="red")
    assert (names(found)[0], float(found.spectral_angle[0])) == (RED, pytest.approx(0.0, abs=1e-7))
    assert np.isinf(found.spectral_angle[-1])
    assert np.isinf(found.colour_difference[-1])


def test_the_angle_by_hand_and_blind_to_scale(paints: xr.Dataset) -> None:
    own = paints.reflectance.values.astype(np.float64)
    found = hp.paints.search_library(paints, like=3.0 * own[5]).spectral_angle
    by_name = dict(zip(found["signature"].values, found.values, strict=True))
    for number, name in enumerate(names(paints)):
        cosine = own[number] @ own[5] / np.linalg.norm(own[number]) / np.linalg.norm(own[5])
        assert by_name[name] == pytest.approx(np.arccos(min(cosine, 1.0)), abs=2e-7)
    # the same word for the same thing
    angles = statistics_of(own, own[5])["spectral_angle"]
    degrees = np.degrees([by_name[name] for name in names(paints)])
    np.testing.assert_allclose(degrees, angles, rtol=0.0, atol=1e-10)


def test_spectra_on_other_bands_and_in_other_units(paints: xr.Dataset) -> None:
    truth = paints.isel(signature=5).reflectance
    nm = np.linspace(350.0, 2500.0, 900)[::-1]
    values = np.interp(nm, paints.wavelength, truth, right=np.nan)
    axis = {"wavelength": ("wavelength", nm, {"units": "nm"})}
    field = xr.Dataset({"reflectance": (("spectrum", "wavelength"), values[np.newaxis])}, axis)
    for like in (
        field,
        field.reflectance,
        field.reflectance[0],
        paints.isel(signature=5),
        paints.isel(signature=[5]),
    ):
        found = hp.paints.search_library(paints, like=like, limit=1)
        assert names(found) == [RED]
        assert float(found.spectral_angle[0]) < 0.01
    nm = paints.wavelength.values
    like = paints.reflectance[5].assign_coords(wavelength=("band", nm / 1000.0, {"units": "um"}))
    found = hp.paints.search_library(paints, like=like, limit=1)
    assert (names(found), float(found.spectral_angle[0])) == ([RED], pytest.approx(0.0, abs=1e-5))
    like.wavelength.attrs["units"] = "K"
    expect_error(UnitsError, None, lambda: hp.paints.search_library(paints, like=like))
    # Rationale: a straight line over 300 nm of a red paint is another paint
    whole = paints.isel(signature=5).reflectance
    for hole in (
        whole.where(np.abs(whole.wavelength - 650.0) > 150.0),
        whole[[*range(40), *range(200, 272)]],
    ):
        alike = hp.paints.search_library(paints, like=hole, limit=1)
        assert (names(alike), float(alike.spectral_angle[0])) == ([RED], pytest.approx(0.0, abs=1e-7))
    # but a lost sample is what interpolation is for, and so are coarser detectors
    sparse = whole.where(np.arange(272) % 9 != 4)[[*range(150), *range(150, 272, 6)]]
    assert np.isfinite(one_spectrum(paints, sparse, paints.wavelength.values)).mean() > 0.95


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"maximum_angle": 0.1}, "like= .argument-missing"),
        ({"maximum_colour_difference": 3.0}, "colour= .argument-missing"),
        ({"colour": "red", "maximum_colour_difference": -1.0}, "value-out-of-range"),
        ({"limit": 0}, "limit=0"),
        ({"name": " "}, "name= .*empty-input"),
        ({"colour": "reddish"}, "colour-unknown"),
        ({"like": "nobody"}, "paint-unknown"),
        ({"like": [0.1, 0.2]}, "length-mismatch"),
        ({"like": xr.Dataset({"counts": ("band", [1.0])})}, "variable-missing"),
        ({"like": xr.DataArray(np.ones((2, 3)), dims=("a", "b"))}, "dims-wrong"),
        (
            {"like": xr.DataArray([0.1, 0.2], {"wavelength": ("band", [401.0, 403.0])}, "band")},
            "bands-not-shared",
        ),
    ],
)
def test_what_cannot_be_searched_for(paints: xr.Dataset, options: dict[str, Any], text: str) -> None:
    expect_error(SchemaError, text, lambda: hp.paints.search_library(paints, **options))


def test_a_library_beyond_the_visible_has_no_colours(paints: xr.Dataset, no_compute: Any) -> None:
    infrared = hp.paints.starter_library(members=0, wavelength=np.linspace(800.0, 1000.0, 20))
    assert set(infrared.srgb.values) == {""}
    expect_error(
        SchemaError, "visible-bands-missing", lambda: hp.paints.search_library(infrared, colour="red")
    )
    assert hp.paints.search_library(infrared, like=RED, limit=1)["signature"].item() == RED
    # members stay lazy
    lazy = paints.assign(member_reflectance=paints.member_reflectance.chunk({"signature": 4}))
    with no_compute():
        found = hp.paints.search_library(lazy, colour="red", limit=2)
    assert isinstance(found.member_reflectance.data, dask.array.Array)


# --- CIE Lab and CIEDE2000 against published values -------------------------------------------------------


PAIRS = [
    ((50.0, 2.6772, -79.7751), (50.0, 0.0, -82.7485), 2.0425),
    ((50.0, 3.1571, -77.2803), (50.0, 0.0, -82.7485), 2.8615),
    ((50.0, -1.3802, -84.2814), (50.0, 0.0, -82.7485), 1.0000),
    ((50.0, 0.0, 0.0), (50.0, -1.0, 2.0), 2.3669),
    ((50.0, 2.4900, -0.0010), (50.0, -2.4900, 0.0009), 7.1792),
    ((50.0, 2.4900, -0.0010), (50.0, -2.4900, 0.0011), 7.2195),
    ((50.0, 2.5, 0.0), (50.0, 0.0, -2.5), 4.3065),
    ((50.0, 2.5, 0.0), (73.0, 25.0, -18.0), 27.1492),
    ((60.2574, -34.0099, 36.2677), (60.4626, -34.1751, 39.4387), 1.2644),
    ((22.7233, 20.0904, -46.6940), (23.0331, 14.9730, -42.5619), 2.0373),
    ((90.8027, -2.0831, 1.4410), (91.1528, -1.6435, 0.0447), 1.4441),
    ((2.0776, 0.0795, -1.1350), (0.9033, -0.0636, -0.5514), 0.9082),
]
"""Some of the pairs of Sharma, Wu & Dalal (2005), table 1, those with turns of hue among them."""


@pytest.mark.parametrize(("one", "other", "expected"), PAIRS)
def test_published_pairs(one: tuple[float, ...], other: tuple[float, ...], expected: float) -> None:
    assert ciede2000(one, other) == pytest.approx(expected, abs=5e-5)
    assert ciede2000(other, one) == pytest.approx(expected, abs=5e-5)


def test_names_digits_and_lab_of_colours() -> None:
    for name, digits in COLOURS.items():
        assert srgb_hex(parse_colour(name)) == digits
        np.testing.assert_array_equal(parse_colour(digits.upper()), parse_colour(name))
    assert srgb_hex(parse_colour(" GRAY")) == COLOURS["grey"]
    assert (srgb_hex(parse_colour("Dark_Red")), srgb_hex([np.nan, 0.0, 0.0])) == (COLOURS["dark red"], "")
    expect_errors(
        (SchemaError, "did you mean 'red'", lambda: parse_colour("rde")),
        (SchemaError, "colour-unknown", lambda: parse_colour("#12345")),
    )
    # the usual values of sRGB's primaries under D65
    expected = [[53.24, 80.09, 67.20], [87.73, -86.18, 83.18], [32.30, 79.19, -107.86]]
    np.testing.assert_allclose(lab_of(np.eye(3)), expected, atol=0.02)
