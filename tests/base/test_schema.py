"""The table of variables, and the two doors through which variables pass."""

import subprocess
import sys
from functools import partial
from typing import Any

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, strategies as st
from support.refusals import expect_error, expect_errors, expect_refusals, expect_words

import hyperpaint as hp
from hyperpaint.base import facts, schema
from hyperpaint.base.errors import MissingExtraError, PaintError, SchemaError, UnitsError
from hyperpaint.base.facts import (
    canonical,
    conversion_factor,
    convert,
    plain,
    quantify,
    registry,
    same_dimension,
)
from hyperpaint.base.schema import VARIABLES, Quality, label, rename_to_roles, require


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
