"""The table of variables, and the two doors through which variables pass."""

from functools import partial

import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_error, expect_words

from hyperpaint.base import schema
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.facts import canonical
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
