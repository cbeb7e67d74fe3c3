"""The table of variables, and the two doors through which variables pass."""

from functools import partial
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_error, expect_refusals, expect_words

import hyperpaint as hp
from hyperpaint.base import schema
from hyperpaint.base.errors import PaintError, SchemaError
from hyperpaint.base.facts import canonical, plain
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
