"""The private registry: what it reads, what it refuses, and that it always comes back."""

import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, strategies as st
from support.refusals import expect_error, expect_errors

from hyperpaint.base import facts, schema
from hyperpaint.base.errors import MissingExtraError, UnitsError
from hyperpaint.base.facts import canonical, conversion_factor, convert, quantify, registry, same_dimension

RADIANCE = "W m-2 sr-1 nm-1"


@pytest.mark.parametrize(
    ("found", "wanted", "factor"),
    [
        ("uW cm-2 sr-1 nm-1", RADIANCE, 0.01),
        ("µW cm-2 sr-1 nm-1", RADIANCE, 0.01),
        ("μW cm⁻² sr⁻¹ nm⁻¹", RADIANCE, 0.01),
        ("W/m²/sr/nm", RADIANCE, 1.0),
        ("W m^-2 sr^-1 um^-1", RADIANCE, 1e-3),
        ("W m**-2 sr**-1 um**-1", RADIANCE, 1e-3),
        ("1e-10 W cm-2 nm-1 sr-1", RADIANCE, 1e-6),
        ("uflick", "W m-2 sr-1 um-1", 0.01),
        ("mW m-2 nm-1", "W m-2 nm-1", 1e-3),
        ("Nanometers", "nm", 1.0),
        ("nanometers", "nm", 1.0),
        ("Micrometers", "nm", 1000.0),
        ("microns", "nm", 1000.0),
        ("angstrom", "nm", 0.1),
        ("ms", "s", 1e-3),
        ("percent", "1", 0.01),
        ("%", "1", 0.01),
        ("", "1", 1.0),
        ("DN", "count", 1.0),
        ("digital_numbers", "count", 1.0),
        ("rad", "degree", 57.2957795131),
        ("ft", "m", 0.3048),
        ("10² m", "m", 100.0),
        ("10⁻⁹ m", "nm", 1.0),
        ("m²s⁻¹", "m2 s-1", 1.0),
    ],
)
def test_spellings(found: str, wanted: str, factor: float) -> None:
    assert conversion_factor(found, wanted) == factor


def test_usual_factors_are_those_of_pint(monkeypatch: pytest.MonkeyPatch) -> None:
    usual = dict(facts.USUAL_FACTORS)
    monkeypatch.setattr(facts, "USUAL_FACTORS", {})
    assert usual == {pair: conversion_factor(*pair) for pair in usual}


@pytest.mark.parametrize(
    ("found", "wanted"),
    [
        (RADIANCE, "W m-2 nm-1"),  # a forgotten pi sr
        ("sr", "1"),
        ("count", "1"),
        ("electron", "count"),
        ("electron", "1"),
        ("W m-2", "W m-2 nm-1"),
        ("W2 m-4 sr-1 nm-2", "1"),  # the paper's last equation as printed
        ("s", "m"),
    ],
)
def test_dimensions_that_pint_alone_lets_pass(found: str, wanted: str) -> None:
    assert not same_dimension(found, wanted)
    expect_error(UnitsError, "units-not-convertible", lambda: conversion_factor(found, wanted))


def test_pi_sr_makes_a_reflectance() -> None:
    units = registry()
    radiance = units.Quantity(1.0, units.parse_units(RADIANCE))
    irradiance = units.Quantity(1.0, units.parse_units("W m-2 nm-1"))
    assert str((np.pi * units.steradian * radiance / irradiance).dimensionality) == "dimensionless"
    assert "solid_angle" in str((np.pi * radiance / irradiance).dimensionality)


def test_the_registry_is_private() -> None:
    pint = pytest.importorskip("pint")
    assert pint.get_application_registry().get() is not registry()
    assert pint.UnitRegistry()("sr").dimensionless


HOSTILE = [
    "9**9**9",
    "d1000000000000",
    "W m-1000000000000",
    "9^9^9",
    "(9**9)**9",
    "9**(9**9)",
    "9** 9 **9",
    "9⁹⁹⁹⁹⁹⁹⁹⁹⁹",
    "m⁹⁹⁹⁹⁹⁹⁹⁹⁹**9",
    "9" + " squared" * 20,
    "9" + " cubed" * 20,
    "(" * 190,
    "m" * 201,
    "m " * 5000,
    "9**+9**+9",
    "__import__('os').system('true')",
    "lambda: 0",
    "m; m",
    "m\nm",
    "\x00",
    "1e999 m",
    "0 m",
    "-1 m",
    "nan m",
    "inf",
    "furlong",
    "W m-2 sr-1 nm-1 [",
    "٩**9999999",
]


@pytest.mark.slow
def test_hostile_text_is_refused_at_once() -> None:
    # in a process of its own, which can be ended
    code = (
        "import sys\nfrom hyperpaint.base.facts import conversion_factor, same_dimension\n"
        "from hyperpaint.base.errors import UnitsError\n"
        f"for text in {HOSTILE!r}:\n"
        "    try:\n        conversion_factor(text, 'm'); sys.exit(f'accepted {text!r}')\n"
        "    except UnitsError as error:\n        assert len(str(error)) < 700, text\n"
        "    assert not same_dimension(text, 'm')\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], timeout=60, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


@given(st.text("mWsrn0123456789 *^/()-+.eµ²⁻%", max_size=40))
def test_any_text_is_read_or_refused(text: str) -> None:
    try:
        canonical(text)
    except UnitsError:
        assert not same_dimension(text, "m")
    else:
        assert conversion_factor(text, text) == 1.0


@pytest.mark.parametrize("found", [None, 5, 1.0, b"nm", ["nm"]])
def test_units_are_text(found: object) -> None:
    with pytest.raises(UnitsError, match="type-wrong"):
        canonical(found)  # type: ignore[arg-type]


def test_every_unit_of_the_table_is_read() -> None:
    for variable in schema.VARIABLES.values():
        if variable.units:
            assert conversion_factor(variable.units + " ", variable.units) == 1.0


@pytest.mark.parametrize("dtype", ["float32", "float64", "int64", "int32", "uint16"])
def test_convert_keeps_floats_and_loses_no_integer(dtype: str) -> None:
    array = xr.DataArray(np.array([5, 6], dtype), dims="x", attrs={"units": "ms", "note": "kept"}, name="t")
    made = convert(array, "s")
    np.testing.assert_allclose(made.values, [0.005, 0.006], rtol=1e-6)
    assert made.dtype == (dtype if dtype.startswith("float") else np.result_type(dtype, np.float16))
    assert made.attrs == {"units": "s", "note": "kept"}
    assert array.attrs["units"] == "ms"
    assert convert(array.assign_attrs(units="s"), "s").dtype == dtype


def test_small_integers_are_not_converted_in_half_precision() -> None:
    assert convert(
        xr.DataArray(np.array([0, 200, 255], np.uint8), attrs={"units": "m"}), "mm", "height"
    ).values.tolist() == [0.0, 200_000.0, 255_000.0]


def test_convert_is_lazy(no_compute: Any) -> None:
    array = xr.DataArray(np.ones(4, "f4"), dims="x", attrs={"units": "um"}, name="fwhm").chunk(x=2)
    with no_compute():
        made = convert(array, "nm")
    assert made.chunks is not None
    assert made.dtype == made.compute().dtype == np.float32


def test_a_missing_unit_is_named() -> None:
    expect_errors(
        (UnitsError, r"'fwhm' .*units-missing", lambda: convert(xr.DataArray(1.0, name="fwhm"), "nm")),
        (
            UnitsError,
            "'fwhm': units",
            lambda: convert(xr.DataArray(1.0, name="fwhm", attrs={"units": "s"}), "nm"),
        ),
    )


def test_quantify_gives_quantities_and_plain_coordinates() -> None:
    pytest.importorskip("pint_xarray")
    dataset = xr.Dataset(
        {
            "radiance": ("band", np.ones(3, "f4"), {"units": RADIANCE}),
            "reflectance": ("band", np.ones(3, "f4"), {"units": "1"}),
            "quality": ("band", np.ones(3, "u2")),
        },
        {"wavelength": ("band", [500.0, 550.0, 600.0], {"units": "nm"})},
    )
    made = dataset.paint.quantify()
    assert made.radiance.data.to("uW cm-2 sr-1 nm-1").magnitude == pytest.approx(100.0)
    assert made.radiance.data.dtype == np.float32
    assert isinstance(made.wavelength.data, np.ndarray)
    assert isinstance(made.quality.data, np.ndarray)
    assert dataset.radiance.attrs["units"] == RADIANCE
    expect_error(Exception, "Cannot convert", lambda: made.radiance.data.to("W m-2 nm-1"))


def test_quantify_lists_what_it_cannot_read() -> None:
    pytest.importorskip("pint_xarray")
    values = {"a": "1e-10 W", "b": "garbage", "c": "9**9**9", "fine": "nm"}
    dataset = xr.Dataset({name: ("x", np.ones(2), {"units": unit}) for name, unit in values.items()})
    caught = expect_error(UnitsError, None, lambda: quantify(dataset))
    assert all(repr(name) in str(caught) for name in "abc")
    assert "'fine'" not in str(caught)


def test_quantify_without_pint_xarray(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pint_xarray", None)
    expect_error(MissingExtraError, r"hyperpaint\[units\]", lambda: quantify(xr.Dataset()))
