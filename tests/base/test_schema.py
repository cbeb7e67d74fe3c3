"""The table of variables, and the two doors through which variables pass."""

import pickle
import subprocess
import sys
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, strategies as st
from support.key_tables import DOCS, PAGES, key_table, with_tables
from support.refusals import expect_error, expect_errors, expect_refusals, expect_words

import hyperpaint
import hyperpaint as hp
from hyperpaint.base import errors, facts, schema
from hyperpaint.base.errors import MissingExtraError, PaintError, Problems, SchemaError, UnitsError
from hyperpaint.base.facts import (
    PARAMETERS,
    Fact,
    arguments_of,
    by_key,
    canonical,
    check_fields,
    conversion_factor,
    convert,
    declared,
    documented,
    fact,
    is_number,
    plain,
    quantify,
    registry,
    same_dimension,
)
from hyperpaint.base.mirrored_light import EXCLUDED, INCLUDED, mirror_reflection
from hyperpaint.base.schema import VARIABLES, Quality, label, rename_to_roles, require
from hyperpaint.io.dirsig.dirsig_writing import Coats, PaintCurves
from hyperpaint.paints.paint_libraries import coating_of
from hyperpaint.simulation.settings import SimulationSettings
from hyperpaint.validation.validating import _library_spectra


def test_every_row_is_whole() -> None:
    for name, row in VARIABLES.items():
        assert row.name == name
        assert row.meaning
        np.dtype(row.dtype)
        if row.units:
            canonical(row.units)
        for dims in row.alternatives:
            assert set(dims) != set(row.dims)


def test_quality_bits_are_those_of_the_store() -> None:
    assert {flag.name.lower(): int(flag) for flag in Quality} == {
        "saturated": 1,
        "below_dark": 2,
        "bad_detector": 4,
        "irradiance_gap": 8,
        "illumination_unstable": 16,
        "low_sun": 32,
        "glint": 64,
        "shadow": 128,
        "adjacency": 256,
        "mixed_edge": 512,
        "off_swath": 1024,
        "no_data": 2048,
        "timing_sensitive": 4096,
    }
    attrs = schema.quality_attrs()
    assert attrs["flag_meanings"].split()[-1] == "timing_sensitive"
    assert attrs["flag_masks"].tolist() == [2**k for k in range(13)]


def test_label_replaces_attributes() -> None:
    array = xr.DataArray(np.ones(2, "f4"), dims="band", name="L", attrs={"units": "furlong", "stale": 1})
    made = label(array, "fwhm", source="here")
    assert made.attrs == {**VARIABLES["fwhm"].attrs, "source": "here"}
    assert made.name == "fwhm"
    assert array.attrs == {"units": "furlong", "stale": 1}
    made.attrs["units"] = "changed"
    assert VARIABLES["fwhm"].attrs["units"] == "nm"


def test_require_converts_and_puts_dims_in_order() -> None:
    dataset = xr.Dataset(
        {
            "radiance_gain": (
                ("cross_track", "band"),
                np.ones((3, 2), "f4"),
                {"units": "uW cm-2 sr-1 nm-1 s count-1"},
            ),
            "fwhm": ("band", [0.006, 0.006], {"units": "um"}),
        }
    )
    found = require(dataset, ["radiance_gain", "fwhm"], "a test")
    assert found["radiance_gain"].dims == ("band", "cross_track")
    np.testing.assert_allclose(found["radiance_gain"], 0.01)
    np.testing.assert_allclose(found["fwhm"], 6.0)
    assert dataset.fwhm.attrs["units"] == "um"


def test_require_lists_every_problem() -> None:
    dataset = xr.Dataset(
        {
            "fwhm": ("colour", [1.0], {"units": "nm"}),
            "exposure_time": ((), 1.0),
            "saturation_count": ((), 1.0, {"units": "W"}),
        }
    )
    caught = expect_error(
        SchemaError,
        None,
        lambda: require(dataset, ["radiance_gain", "fwhm", "exposure_time", "saturation_count"], "radiance"),
    )
    message = str(caught)
    assert message.startswith("cannot compute radiance")
    expect_words(
        message,
        "'radiance_gain' is missing",
        "'fwhm' has dims (colour), expected (band)",
        "'exposure_time' has no units",
        "'saturation_count' has units 'W'",
    )
    assert message.count("\n") == 4


@pytest.mark.parametrize(("units", "is_named"), [("nm", True), ("um", True), ("s", False)])
def test_a_coordinate_of_another_name_is_named(units: str, is_named: bool) -> None:
    cube = xr.Dataset(coords={"central_wavelengths": ("band", [500.0, 600.0], {"units": units})})
    caught = expect_error(
        SchemaError, "variable-missing", lambda: require(cube, ["wavelength"], "a true-colour picture")
    )
    assert ("central_wavelengths" in str(caught)) == is_named


def test_times_are_decoded_or_refused() -> None:
    units = {"units": "seconds since 2021-09-27"}
    line = xr.Dataset(coords={"time": ("along_track", [1.5, np.nan], units)})
    expected = np.array(["2021-09-27T00:00:01.5", "NaT"], "datetime64[ns]")
    for encoded in (line, line.chunk()):
        decoded = require(rename_to_roles(encoded), ["time"], "a test")["time"]
        np.testing.assert_array_equal(decoded.values, expected)
    indexed = xr.Dataset(coords={"irradiance_time": ("irradiance_time", [1.5, 2.5], units)})
    assert rename_to_roles(indexed).indexes["irradiance_time"][0] == expected[0]
    for wrong in ([1.5, 2.5], np.array([1, 2], "m8[ns]")):
        numbers = xr.Dataset(coords={"time": ("along_track", wrong)})
        expect_error(SchemaError, "type-wrong", lambda d=numbers: require(d, ["time"], "a test"))


@pytest.mark.parametrize(
    "names",
    [
        ("downtrack", "bands", "crosstrack"),
        ("y", "band", "x"),
        ("lines", "wavelength", "samples"),
        ("Line", "Band", "Sample"),
    ],
)
def test_dims_of_the_neighbours(names: tuple[str, str, str]) -> None:
    cube = xr.Dataset({"counts": (names, np.zeros((2, 3, 4)))})
    assert (rename_to_roles(cube).counts.dims, cube.counts.dims) == (schema.CUBE, names)


def test_other_dims_are_named_by_role() -> None:
    cube = xr.Dataset({"counts": (("a", "b", "c"), np.zeros((2, 3, 4)))})
    made = rename_to_roles(cube, {"along_track": "a", "band": "b", "cross_track": "c"})
    assert made.counts.dims == schema.CUBE
    for wrong in ({"line": "a"}, {"band": "nothing"}):
        expect_error(SchemaError, "dim-missing", partial(rename_to_roles, cube, wrong))


def test_an_index_of_wavelengths_becomes_a_plain_coordinate() -> None:
    made = rename_to_roles(
        xr.Dataset(
            {"reflectance": (("y", "x", "wavelength"), np.zeros((2, 3, 4), "f4"))},
            {"wavelength": ("wavelength", [1.0, 2.0, 3.0, 4.0], {"units": "nm"})},
        )
    )
    assert made.wavelength.dims == ("band",)
    assert "wavelength" not in made.xindexes
    assert made.wavelength.attrs["units"] == "nm"


# --- scale, offset and fill value in attributes, integers without a scale, and axes of other names --------


NM = np.linspace(400.0, 1000.0, 31)
TRUE = np.linspace(0.1, 0.5, 31)
FULL = np.broadcast_to(TRUE[:, None], (6, 31, 5))


def cube(values: Any, axis: str = "wavelength", **attrs: Any) -> xr.Dataset:
    return xr.Dataset(
        {"reflectance": (("along_track", "band", "cross_track"), values, {"units": "1", **attrs})},
        {axis: ("band", NM, {"units": "nm"})},
    )


PACKED: dict[str, tuple[Any, dict[str, Any]]] = {
    "ten thousandths": (np.rint(FULL * 1e4).astype("i2"), {"scale_factor": 1e-4}),
    "per cent in bytes": (np.rint(FULL * 200).astype("u1"), {"scale_factor": 0.005}),
    "offset": (np.rint(FULL * 1e4 + 1000).astype("u2"), {"scale_factor": 1e-4, "add_offset": -0.1}),
    "offset alone": (FULL.astype("f4") + 1, {"add_offset": -1.0}),
    "numpy scalars": (np.rint(FULL * 1e4).astype("i4"), {"scale_factor": np.float32(1e-4)}),
    "floats, one": (FULL.astype("f4"), {"scale_factor": 1.0, "add_offset": 0.0}),
}


@pytest.mark.parametrize("case", PACKED)
@pytest.mark.parametrize("chunks", [None, {"along_track": 2}])
def test_packed_reflectance_is_unpacked_wherever_it_enters(case: str, chunks: Any) -> None:
    values, attrs = PACKED[case]
    line = cube(values, **attrs)
    line = line if chunks is None else line.chunk(chunks)
    region = hp.Regions((hp.Region("a", [(0, 0), (5, 0), (5, 6), (0, 6)]),))
    spectra = {
        "signatures": hp.extract_signatures(line, region, exclude=0).reflectance[0],
        "at": line.paint.at(NM).reflectance[0, :, 0],
        "smooth": line.paint.smooth(window=3, order=1).reflectance[0, :, 0],
        "require": require(line, ["reflectance"], "a test")["reflectance"][0, :, 0],
    }
    for name, spectrum in spectra.items():
        np.testing.assert_allclose(spectrum, TRUE, atol=0.003, err_msg=name)
    plain_picture = cube(FULL.astype("f4")).paint.rgb()
    np.testing.assert_allclose(line.paint.rgb(), plain_picture, atol=0.03)


def test_fill_values_become_missing() -> None:
    values = np.rint(FULL * 1e4).astype("i2")
    values[0, 0, 0] = -9999
    for name in ("_FillValue", "missing_value", "nodata"):
        unpacked = plain(cube(values, scale_factor=1e-4, **{name: np.int16(-9999)})).reflectance
        assert int(np.isnan(unpacked).sum()) == 1
    for name in ("_FillValue", "nodata"):
        alone = cube(np.where(values == -9999, -9999.0, FULL), **{name: -9999.0})
        assert int(np.isnan(plain(alone).reflectance).sum()) == 1
        # counts and flags keep their type
        assert plain(cube(values, **{name: np.int16(-9999)})).reflectance.dtype == values.dtype


def test_pictures_do_not_depend_on_the_order_of_bands() -> None:
    order = np.random.default_rng(1).permutation(31)
    line = cube(FULL.astype("f4"))
    np.testing.assert_allclose(line.isel(band=order).paint.rgb(), line.paint.rgb(), atol=1e-5)


def test_unpacking_reads_nothing(tmp_path: Any) -> None:
    path = tmp_path / "packed.zarr"
    cube(np.rint(FULL * 1e4).astype("i2"), scale_factor=1e-4).to_zarr(path, consolidated=False)
    line = xr.open_zarr(path, chunks=None, mask_and_scale=False, consolidated=False)
    assert not plain(line).reflectance.variable._in_memory


@pytest.mark.parametrize(
    ("attrs", "code"),
    [({}, "scale-missing"), ({"scale_factor": "1e-4"}, "scale-wrong"), ({"scale_factor": 0}, "scale-wrong")],
)
def test_integers_without_a_scale_are_refused(attrs: dict[str, Any], code: str) -> None:
    line = cube(np.rint(FULL * 1e4).astype("i2"), **attrs)
    region = hp.Regions((hp.Region("a", [(0, 0), (5, 0), (5, 6), (0, 6)]),))
    expect_refusals((PaintError, code, lambda: hp.extract_signatures(line, region, exclude=0)))


@pytest.mark.parametrize("axis", ["wavelengths", "Wavelength", "wvl", "WL", "centre_wavelength"])
def test_wavelengths_of_another_name_are_found(axis: str) -> None:
    line = cube(FULL.astype("f4"), axis)
    np.testing.assert_allclose(line.paint.at(700.0).reflectance, TRUE[15], rtol=1e-6)
    assert line.paint.rgb().shape == (6, 5, 3)


@pytest.mark.parametrize("units", ["unitless", "dimensionless", "1", "%", "percent"])
def test_words_for_fractions(units: str) -> None:
    factor = 100.0 if units in ("%", "percent") else 1.0
    line = cube((FULL * factor).astype("f4"), units=units)
    np.testing.assert_allclose(line.paint.smooth(window=3, order=1).reflectance[0, :, 0], TRUE, atol=1e-3)


# --- The private registry: what it reads, what it refuses, and that it always comes back


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
    # the registry is private: that of others stays as it was
    pint = pytest.importorskip("pint")
    assert pint.get_application_registry().get() is not units
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
    expect_error(UnitsError, "type-wrong", lambda: canonical(found))


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
    # a unit that is missing or wrong is named
    bare, wrong = (xr.DataArray(1.0, name="fwhm", attrs=attrs) for attrs in ({}, {"units": "s"}))
    expect_errors(
        (UnitsError, r"'fwhm' .*units-missing", lambda: convert(bare, "nm")),
        (UnitsError, "'fwhm': units", lambda: convert(wrong, "nm")),
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


# --- Errors a user can catch by what they are, and that name everything at once ---


def test_every_error_has_the_base_and_a_builtin() -> None:
    builtin = {
        "UnitsError": ValueError,
        "SchemaError": ValueError,
        "FormatError": ValueError,
        "TimeError": ValueError,
        "CollectError": ValueError,
        "StoreError": OSError,
        "IncompleteStoreError": errors.StoreError,
        "MissingExtraError": ImportError,
    }
    for name, parent in builtin.items():
        error = getattr(errors, name)
        assert issubclass(error, errors.PaintError)
        assert issubclass(error, parent)
        assert getattr(hyperpaint.errors, name) is error
    assert issubclass(errors.PaintWarning, UserWarning)


def test_errors_survive_a_process_boundary() -> None:
    # a task that fails on a worker must not fail twice
    for name in errors.__all__:
        error = getattr(errors, name)
        if isinstance(error, type) and issubclass(error, errors.PaintError):
            copy = pickle.loads(pickle.dumps(error("2 lights", expected="1", code="light-number")))
            assert (str(copy), copy.codes) == ("2 lights, expected 1 [light-number]", ("light-number",))


def test_problems_are_listed_together() -> None:
    problems = errors.Problems("the file", errors.FormatError)
    problems.raise_if_any()
    problems.add("one")
    problems.add("two\nlines")
    assert (list(problems), len(problems)) == (["one", "two\nlines"], 2)
    caught = expect_error(errors.FormatError, None, lambda: problems.raise_if_any())
    assert str(caught) == "the file:\n  one\n  two\n  lines"


def test_a_missing_extra_says_how_to_install_it() -> None:
    error = errors.MissingExtraError.of("matplotlib", "viz", "a picture")
    assert error.codes == ("extra-missing",)
    assert "hyperpaint[viz]" in error.problem.mend


# --- Facts: checks, messages, docstrings and tables that follow from one declaration


@pytest.mark.parametrize(
    ("options", "good", "bad"),
    [
        ({"kind": "number"}, [0, -1.5, np.float32(2)], [True, "1", None, float("nan"), 10**400]),
        ({"kind": "number", "least": 0, "above": True, "most": 1.2}, [1.2, 1e-9], [0, 1.3, -1]),
        ({"kind": "number", "least": 0, "most": 1, "below": True}, [0, 0.99], [1, -0.1]),
        ({"kind": "whole", "least": 1, "most": 16}, [1, 16, np.int64(3)], [0, 17, 2.0, True]),
        ({"kind": "flag"}, [True, False], [1, "true", None]),
        ({"kind": "choice", "choices": ("a", "b")}, ["a"], ["c", 1, ["a"], None]),
        ({"kind": "text"}, ["a"], ["", " ", 3]),
        ({"kind": "texts"}, ["a", ["a", "b"]], [[], ["a", 3], ""]),
        ({"kind": "words"}, [[], ["a"]], ["a", [3]]),
        ({"kind": "words", "choices": ("a",)}, [[], ["a"]], ["a", ["b"]]),
        ({"kind": "numbers", "length": 2}, [[1, 2], (1.0, 2.0)], [[1], 1, [1, "2"], [1, True]]),
        ({"kind": "numbers", "single": True, "least": 0}, [1, [1, 2, 3], np.ones(2)], [[], -1, [1, -1]]),
        ({"kind": "number", "optional": True}, [None, 1], ["1"]),
        ({"kind": "table"}, [{}], [[]]),
        ({"kind": "own", "accepts": callable, "phrase": "a function"}, [len], [3]),
    ],
)
def test_kinds(options: dict[str, Any], good: list[Any], bad: list[Any]) -> None:
    one = Fact(doc="value", **options)
    assert [one.fault(value) for value in good] == [None] * len(good)
    assert None not in [one.fault(value) for value in bad]
    assert one.expected


def test_keys_have_the_units_of_the_file() -> None:
    keys = by_key([Fact(doc="length", kind="number", name="length", key="length_m", scale=1.0)])
    assert arguments_of(keys, {"length_m": 0.1234567890123456}) == {"length": 0.1234567890123456}
    assert isinstance(arguments_of(keys, {"length_m": 2})["length"], float)
    exposure = Fact(
        doc="exposure", kind="number", name="exposure", key="exposure_ms", scale=1e-3, least=0.0, most=3600.0,
        default=5e-3,
    )  # fmt: skip
    key = by_key([exposure])["exposure_ms"]
    assert (key.default, key.most, key.argument(7)) == (5.0, 3.6e6, 0.007)
    assert "| `exposure_ms` | a number from 0 to 3.6e+06 | `5.0` | exposure |" in key_table(
        {"exposure_ms": key}
    )


def test_a_declared_class_documents_its_fields() -> None:
    @declared
    @dataclass
    class Lamp:
        """A lamp.

        Raises
        ------
        SchemaError
            Wrong.
        """

        power: float = fact(3.0, "radiant flux", unit="W", least=0)

        def __post_init__(self) -> None:
            problems = Problems("no lamp", SchemaError)
            check_fields(self, problems)
            problems.raise_if_any()

    assert Lamp.__doc__ == (
        "A lamp.\n\nAttributes\n----------\npower\n    Radiant flux [W]; a number from 0.\n\n"
        "Raises\n------\nSchemaError\n    Wrong."
    )
    expect_error(SchemaError, "value-out-of-range", lambda: Lamp(-1.0))


def test_pint_quantities_follow_from_the_facts() -> None:
    pint = pytest.importorskip("pint")
    assert SimulationSettings(exposure_time_ms=pint.Quantity(4.0, "ms")).exposure_time_ms == 4.0
    assert SimulationSettings(swath=pint.Quantity(16.0, "m")).swath == 16.0


def test_every_field_of_the_simulator_is_documented() -> None:
    for name in SimulationSettings.__dataclass_fields__:
        assert f"\n{name}\n    " in (SimulationSettings.__doc__ or ""), name


def test_shared_parameters_are_described() -> None:
    @documented(depth="Number of levels.", width="picture")
    def walk(depth: int, overwrite: bool, own: int, width: str, **kwargs: int) -> None:
        """Walk.

        Parameters
        ----------
        depth
        own
            Described here.
        overwrite
        width
        **kwargs

        Returns
        -------
        Nothing.
        """

    doc = walk.__doc__ or ""
    expect_words(
        doc,
        "depth\n    Number of levels.\nown\n    Described here.\noverwrite\n    Replace the output",
        f"\nwidth\n    {PARAMETERS['picture']}\n**kwargs\n    Passed to",
    )
    assert doc.endswith("\n\nReturns\n-------\nNothing.")


@pytest.mark.parametrize("page", PAGES)
def test_pages_have_the_keys_of_the_facts(page: str) -> None:
    assert (DOCS / page).read_text(encoding="utf-8") == with_tables(page)


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        *((value, True) for value in (np.array(0.04), xr.DataArray(37.25), np.float32(1.0))),
        *((value, False) for value in (np.array([0.04]), np.array(True), np.array("1"))),
    ],
)
def test_a_number_may_be_an_array_without_dims(value: Any, expected: bool) -> None:
    assert is_number(value) is expected


# --- Whether reflectance holds mirrored light, told alike to all who ask ---


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


def test_the_complement_of_flags_has_all_others() -> None:
    for flag in Quality:
        assert int(~flag) == sum(Quality) - flag
