"""What an ENVI header makes of a cube: name, units, coordinates, map; and how the pair of files is found."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.envi_cubes import FROM_LBS, toy, write_cube
from support.refusals import expect_errors

from hyperpaint.base import schema
from hyperpaint.base.errors import FormatError, PaintWarning
from hyperpaint.io.backends import EnviBackendEntrypoint
from hyperpaint.io.envi.envi_cubes import find_pair, open_envi

# --- names, units, coordinates -----------------------------------------------------------------------------


_RADIANCE_UNITS = ";Units = mW/(cm2*sr*um)"


@pytest.mark.parametrize(
    ("dtype", "lines", "name", "units"),
    [
        ("u2", (), "values", None),
        ("u2", ("description = {raw data of the line}",), "counts", "count"),
        ("u2", ("description = {hood, counts}",), "counts", "count"),
        ("u2", (";Units = DN",), "counts", "count"),
        ("u2", ("data units = DN",), "counts", "count"),
        ("u2", ("description = {[HEADWALL Hyperspec III],RADIANCE}",), "radiance", None),
        ("f4", ("description = {raw}",), "values", None),
        ("i4", ("file type = ENVI Standard", "description = {[HEADWALL Hyperspec III]}"), "counts", "count"),
        ("u1", ("file type = ENVI Classification",), "values", None),
        ("f4", (), "values", None),
        ("f4", ("description = {[HEADWALL Hyperspec III],RADIANCE}",), "radiance", None),
        ("f4", ("description = {[HEADWALL Hyperspec III],RADIANCE}", _RADIANCE_UNITS), "radiance", "said"),
        ("u2", ("description = {[HEADWALL Hyperspec III],RADIANCE}", _RADIANCE_UNITS), "radiance", "said"),
        ("f4", (_RADIANCE_UNITS,), "radiance", "said"),
        ("f4", (";Units = mW/(cm^2*sr*um)",), "radiance", "mW/(cm2*sr*um)"),
        ("f4", (";Units = furlong per fortnight",), "values", None),
        ("f4", ("description = {[x],RADIANCE,REFLECTANCE}", _RADIANCE_UNITS), "reflectance", "1"),
        ("f4", ("description = {[HEADWALL Hyperspec III],REFLECTANCE,[OR]}",), "reflectance", "1"),
        ("u2", ("description = {x,REFLECTANCE}", "reflectance scale factor = 1e4"), "reflectance", "1"),
        ("u2", ("reflectance scale factor = 10000",), "reflectance", "1"),
        ("f4", ("reflectance scale factor = 1",), "reflectance", "1"),
        ("u2", ("reflectance scale factor = 1.0",), "values", None),
        ("f4", ("description = {radiance and other irradiance}",), "values", None),
        ("u2", ("data gain values = {" + "2," * 20 + "}",), "values", None),
        ("u2", ("data gain values = {" + "1," * 20 + "}", ";Units = counts"), "counts", "count"),
        ("f4", ("data gain values = {" + "2," * 20 + "}", _RADIANCE_UNITS), "radiance", "said"),
    ],
)
def test_name_and_units(
    tmp_path: Path, dtype: str, lines: tuple[str, ...], name: str, units: str | None
) -> None:
    line = open_envi(write_cube(tmp_path / "toy", toy(dtype), *lines))
    assert list(line.data_vars) == [name]
    assert line[name].attrs.get("units") == ("mW/(cm2*sr*um)" if units == "said" else units)
    if name in ("radiance", "reflectance"):
        assert (line[name].dtype, line[name].values.dtype) == (np.float32, np.float32)
        assert line[name].attrs["long_name"] == schema.VARIABLES[name].meaning


def test_integers_called_reflectance_need_a_scale(tmp_path: Path) -> None:
    header = write_cube(tmp_path / "toy", toy("u2"), "description = {x,REFLECTANCE}")
    with pytest.warns(PaintWarning, match="header-doubtful"):
        line = open_envi(header)
    assert (list(line.data_vars), line["values"].dtype) == (["values"], np.uint16)


def test_radiance_units_convert_through_the_schema(tmp_path: Path) -> None:
    line = open_envi(write_cube(tmp_path / "toy", toy("f4"), "description = {x,RADIANCE}", _RADIANCE_UNITS))
    found = schema.require(line, ["radiance"], "reflectance")["radiance"]
    assert found.attrs["units"] == "W m-2 sr-1 nm-1"
    np.testing.assert_allclose(found.values, toy("f8") * 0.01, rtol=1e-6)


def test_ignore_value_is_compared_before_scaling(tmp_path: Path) -> None:
    cube = toy("i2")
    cube[1, 2, 3] = -9999
    header = write_cube(
        tmp_path / "toy", cube, "reflectance scale factor = 10000", "data ignore value = -9999"
    )
    line = open_envi(header).chunk({"along_track": 2})
    values = line.reflectance.compute()
    assert values.dtype == line.reflectance.dtype == np.float32
    expected = (cube / 1e4).astype(np.float32)
    expected[1, 2, 3] = np.nan
    np.testing.assert_array_equal(values, expected)


@pytest.mark.parametrize("interleave", FROM_LBS)
def test_gain_and_offset_of_each_band(tmp_path: Path, interleave: str) -> None:
    cube, gain, offset = toy("u2"), 0.5 + np.arange(20) / 7, np.arange(20) - 3.0
    header = write_cube(
        tmp_path / "toy", cube,
        f"data gain values = {{{', '.join(map(repr, gain.tolist()))}}}",
        f"data offset values = {{{', '.join(map(repr, offset.tolist()))}}}",
        "data ignore value = 1", interleave=interleave,
    )  # fmt: skip
    values = open_envi(header)["values"].isel(band=[3, 0, 11])
    expected = (cube * gain[:, None] + offset[:, None])[:, [3, 0, 11]]
    expected[0, 1, 0] = np.nan
    assert values.dtype == np.float32
    np.testing.assert_allclose(values, expected, rtol=3e-7, atol=1e-5)
    assert values.values.dtype == np.float32


def test_ignore_values_of_floats_and_counts(tmp_path: Path) -> None:
    cube = toy("f4")
    cube[0, 0, 0] = -1.23e34
    # written with fewer digits
    values = open_envi(write_cube(tmp_path / "toy", cube, "data ignore value = -1.23e+034"))["values"]
    assert (np.flatnonzero(np.isnan(values)).tolist(), values.dtype) == ([0], np.float32)
    header = write_cube(tmp_path / "toy", toy("u2"), "data ignore value = 65535", "description = {raw}")
    counts = open_envi(header).counts
    assert (counts.dtype, counts.attrs["data_ignore_value"]) == (np.uint16, 65535)


def test_coordinates_on_band_have_no_index(tmp_path: Path) -> None:
    values = ", ".join(str(0.9 - i / 100) for i in range(20))
    line = open_envi(
        write_cube(
            tmp_path / "toy", toy("u2"), f"wavelength = {{{values}}}", "wavelength units = um",
            "fwhm = {" + "0.006," * 20 + "}", "bbl = {" + "0 " * 3 + "1 " * 17 + "}",
        )
    )  # fmt: skip
    assert not line.indexes
    np.testing.assert_allclose(line.wavelength, 900 - 10 * np.arange(20), rtol=1e-14)  # not sorted
    for name in ("wavelength", "fwhm", "good"):
        assert (line[name].dims, line[name].dtype) == (("band",), schema.dtype_of(name))
        assert line[name].attrs == schema.VARIABLES[name].attrs
    assert int((~line.good).sum()) == 3


def test_attributes_keep_all_the_header_says(tmp_path: Path) -> None:
    header = write_cube(
        tmp_path / "raw_0", toy("u2"), "strange key = {a, b}", ";Exposure (ms) = 5", "; remark"
    )
    line = open_envi(header)
    assert line.attrs["source"] == "raw_0"
    fields = json.loads(line.attrs["envi_header"])
    assert (next(iter(fields)), fields["strange key"]) == ("lines", "{a, b}")
    assert json.loads(line.attrs["envi_comments"]) == {"Exposure (ms)": "5"}
    assert json.dumps(line.attrs)
    assert str(tmp_path) not in json.dumps(line.attrs)


_UTM = "map info = {UTM, 1, 1, 500000, 4000000, 0.5, 0.25, 18, North, WGS-84, units=Meters}"


def test_map_geometry(tmp_path: Path) -> None:
    line = open_envi(write_cube(tmp_path / "toy", toy("f4"), _UTM, interleave="bsq"))
    array = line["values"]
    assert array.dims == ("y", "x", "band")
    np.testing.assert_array_equal(array, toy("f4").transpose(0, 2, 1))
    np.testing.assert_array_equal(line.x, 500000.25 + 0.5 * np.arange(4))
    np.testing.assert_array_equal(line.y, 4000000 - 0.125 - 0.25 * np.arange(5))
    assert line.x.attrs == {"standard_name": "projection_x_coordinate", "units": "m"}
    assert line.attrs["map_info"].startswith("{UTM")
    np.testing.assert_array_equal(array.sel(x=500000.75, y=3999999.9, method="nearest"), toy()[0, :, 1])
    # a rotated map has no one-dimensional coordinates
    line = open_envi(write_cube(tmp_path / "toy", toy("f4"), _UTM.replace("}", ", rotation=30}")))
    assert line["values"].dims == ("y", "x", "band")
    assert not {"x", "y"} & set(line.coords)
    assert "rotation=30" in line.attrs["map_info"]
    # an arbitrary one is sensor geometry
    info = "map info = {Arbitrary, 1, 1, 0, 0, 1, 1, 0, North}"
    assert open_envi(write_cube(tmp_path / "toy", toy("u2"), info))["values"].dims == schema.CUBE


def test_map_geometry_geographic_with_another_reference_pixel(tmp_path: Path) -> None:
    info = "map info = {Geographic Lat/Lon, 2.5, 3, -77.5, 43.1, 1e-5, 2e-5, WGS84, units=Degrees}"
    line = open_envi(write_cube(tmp_path / "toy", toy("f4"), info))
    # the middle of column 1 (counted from 0) is column 2.5 of ENVI
    np.testing.assert_allclose(line.x.values[1], -77.5, rtol=1e-15)
    np.testing.assert_allclose(line.y.values[2], 43.1 - 1e-5, rtol=1e-15)
    assert line.x.attrs == {"standard_name": "longitude", "units": "degrees_east"}


# --- the pair ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("header", "data"),
    [
        ("raw_0.hdr", "raw_0"), ("raw_0.HDR", "raw_0"), ("a.hdr", "a.img"), ("a.hdr", "a.DAT"),
        ("a.hdr", "a.raw"), ("a.hdr", "a.bil"), ("a.hdr", "a.bip"), ("a.hdr", "a.bsq"),
        ("x.img.hdr", "x.img"), ("x.bil.hdr", "x.bil"), ("v1.2.hdr", "v1.2"), ("v1.2.hdr", "v1.2.img"),
        ("toy.hdr", "toy.bin"),
    ],
)  # fmt: skip
def test_either_file_finds_the_other(tmp_path: Path, header: str, data: str) -> None:
    written = write_cube(tmp_path / data, toy("u2"))
    if written.name != header:
        written.rename(tmp_path / header)
    backend = EnviBackendEntrypoint()
    for name in (header, data):
        assert find_pair(tmp_path / name) == (tmp_path / header, tmp_path / data)
        is_guessed = not name.endswith(".bin")  # other formats have that suffix too
        assert backend.guess_can_open(tmp_path / name) == is_guessed
        assert backend.guess_can_open(str(tmp_path / name)) == is_guessed
    for name in (header, data):
        np.testing.assert_array_equal(open_envi(str(tmp_path / name))["values"], toy("u2"))


def test_pair_problems(tmp_path: Path) -> None:
    header = write_cube(tmp_path / "a.img", toy("u2")).rename(tmp_path / "a.hdr")
    shutil.copy(tmp_path / "a.img", tmp_path / "a.dat")
    (tmp_path / "lonely.hdr").write_text("ENVI\n")
    (tmp_path / "bare").write_bytes(b"")
    for name, code in (
        ("a.hdr", "data-file-ambiguous"),
        ("lonely.hdr", "data-file-missing"),
        ("bare", "header-missing"),
    ):
        with pytest.raises(FormatError, match=code):
            find_pair(tmp_path / name)
    assert find_pair(tmp_path / "a.dat") == (header, tmp_path / "a.dat")
    for missing in ("nothing.hdr", "nothing", "."):
        with pytest.raises(FileNotFoundError, match="no such file"):
            find_pair(tmp_path / missing)


def test_guess_leaves_other_files_alone(tmp_path: Path) -> None:
    (tmp_path / "a.hdr").write_text("ENVI\n")
    for name in ("a.nc", "a.tif", "b", "b.img"):
        (tmp_path / name).write_bytes(b"x")
    (tmp_path / "other.hdr").write_bytes(b"#?RADIANCE\n")
    (tmp_path / "a.zarr").mkdir()
    guess = EnviBackendEntrypoint().guess_can_open
    for name in ("a.nc", "a.tif", "b", "b.img", "other.hdr", "missing.hdr", "a.zarr", "bad\0name", "."):
        assert not guess(str(tmp_path / name)), name
    for thing in ("", ".", "..", "https://example.org/a.img", 3, None, b"bytes", {}):
        assert not guess(thing)


# --- what integers are -------------------------------------------------------------------------------------


def test_integers_are_what_the_caller_says_where_the_header_does_not(tmp_path: Path) -> None:
    header = write_cube(tmp_path / "toy", toy("u2"))
    counts = open_envi(header, quantity="counts").counts
    assert (counts.dtype, counts.attrs["units"]) == (np.dtype(np.uint16), "count")
    assert list(open_envi(header, quantity="radiance").data_vars) == ["radiance"]
    assert list(open_envi(header, unsaid="counts").data_vars) == ["counts"]
    opened = xr.open_dataset(header, engine=EnviBackendEntrypoint, quantity="counts")
    np.testing.assert_array_equal(opened.counts, toy("u2"))


@pytest.mark.parametrize(
    ("dtype", "lines", "quantity", "message"),
    [
        ("u2", ("description = {x,RADIANCE}",), "counts", "quantity-conflict"),
        ("u2", ("description = {[HEADWALL Hyperspec III]}",), "radiance", "quantity-conflict"),
        ("u2", ("reflectance scale factor = 10000",), "counts", "quantity-conflict"),
        ("f4", (), "counts", "quantity-conflict"),
        ("u2", ("data gain values = {" + "2," * 20 + "}",), "counts", "quantity-conflict"),
        ("u2", (), "reflectance", "quantity-conflict"),
        ("u2", (), "brightness", "choice-unknown"),
    ],
)
def test_what_the_header_contradicts_is_refused(
    tmp_path: Path, dtype: str, lines: tuple[str, ...], quantity: str, message: str
) -> None:
    header = write_cube(tmp_path / "toy", toy(dtype), *lines)
    expect_errors((FormatError, message, lambda: open_envi(header, quantity=quantity)))
