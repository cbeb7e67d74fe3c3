"""The calibration and the dark of a flight line."""

import json
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.codecs import plain_zarr
from support.headwall_flights import (
    BANDS,
    COLUMNS,
    ELEMENT,
    GAIN,
    NM,
    T0,
    make_calibration,
    open_line,
    write_cube,
    write_index,
    write_nav,
)  # fmt: skip
from support.refusals import expect_refusals

from hyperpaint.base.errors import FormatError, PaintWarning, SchemaError
from hyperpaint.io.flightline.calibration_store import open_calibration
from hyperpaint.io.flightline.flightline_opening import open_flightline

# --- calibration -------------------------------------------------------------------------------------------


def test_wavelengths_of_the_calibration_win(folder: Path) -> None:
    own = make_calibration().assign_coords(wavelength=("band", [500.5, 600.5, 701.0], NM))
    with pytest.warns(PaintWarning, match="wavelength-conflict"):
        line = open_line(folder, calibration=own)
    assert line["wavelength"].values.tolist() == [500.5, 600.5, 701.0]


def test_a_calibration_of_another_camera_names_both(folder: Path) -> None:
    with pytest.raises(SchemaError, match="grid-mismatch"):
        open_line(folder, calibration=make_calibration().isel(band=slice(2)))


def test_gain_in_microwatts_is_converted(folder: Path) -> None:
    gain = make_calibration()["radiance_gain"].copy(data=np.full((BANDS, COLUMNS), 2e-4))
    gain.attrs["units"] = "uW cm-2 sr-1 nm-1 s count-1"
    line = open_line(folder, calibration=make_calibration(radiance_gain=gain))
    np.testing.assert_allclose(line["radiance_gain"], 2e-6, rtol=1e-7)


def test_a_calibration_says_all_that_is_wrong_with_it() -> None:
    wrong = make_calibration()
    del wrong["radiance_gain"].attrs["units"]
    wrong = wrong.assign_coords(fwhm=("band", [6.0, -6.0, 6.0], NM)).drop_vars("wavelength")
    wrong.attrs["srf_shape"] = "box"
    with pytest.raises(SchemaError) as caught:
        open_calibration(wrong)
    text = str(caught.value)
    assert all(
        part in text for part in ("no units", "'fwhm' is not finite", "'wavelength' is missing", "'box'")
    )


@pytest.mark.parametrize(
    ("value", "match"), [(0.0, "zero, negative"), (-1.0, "zero, negative"), (np.inf, "infinite")]
)
def test_impossible_gains(value: float, match: str) -> None:
    calibration = make_calibration()
    calibration["radiance_gain"].values[0, 0] = value
    with pytest.raises(SchemaError, match=match):
        open_calibration(calibration)


def test_bad_elements_are_nan_but_not_all() -> None:
    calibration = make_calibration()
    calibration["radiance_gain"].values[0, 0] = np.nan
    assert np.isnan(open_calibration(calibration)["radiance_gain"].values).sum() == 1
    calibration["radiance_gain"].values[:] = np.nan
    with pytest.raises(SchemaError, match="NaN everywhere"):
        open_calibration(calibration)


def test_an_unsaid_line_shape_is_told() -> None:
    calibration = make_calibration()
    del calibration.attrs["srf_shape"]
    with pytest.warns(PaintWarning, match="Gaussian"):
        assert open_calibration(calibration).attrs["srf_shape"] == "gaussian"


def test_a_tabulated_line_shape_needs_its_table() -> None:
    calibration = make_calibration().assign_attrs(srf_shape="tabulated")
    with pytest.raises(SchemaError, match="variable-missing"):
        open_calibration(calibration)
    table = calibration.assign(srf=(("band", "srf_offset"), np.ones((BANDS, 5)), {"units": "1"}))
    table = table.assign_coords(srf_offset=("srf_offset", np.arange(-2.0, 3.0), NM))
    assert open_calibration(table)["srf"].dims == ("band", "srf_offset")


def test_a_tabulated_line_shape_goes_with_the_line(folder: Path) -> None:
    table = make_calibration(srf=(("band", "srf_offset"), np.ones((BANDS, 5)), {"units": "1"}))
    table = table.assign_coords(srf_offset=("srf_offset", np.arange(-2.0, 3.0), NM))
    line = open_line(folder, calibration=table.assign_attrs(srf_shape="tabulated"))
    assert (line["srf"].dtype, line["srf_offset"].values.tolist()) == (np.float64, [-2, -1, 0, 1, 2])
    assert line.attrs["srf_shape"] == "tabulated"


@pytest.mark.parametrize("suffix", [".zarr", ".nc"])
def test_calibration_stores(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"calibration{suffix}"
    calibration = make_calibration(radiance_gain_u=(ELEMENT, np.ones((BANDS, COLUMNS))))
    if suffix == ".zarr":
        plain_zarr(calibration, path)
    else:
        pytest.importorskip("h5netcdf")
        calibration.to_netcdf(path, engine="h5netcdf")
    opened = open_calibration(path)
    assert opened["radiance_gain"].dtype == np.float32
    assert "radiance_gain_u" in opened
    xr.testing.assert_allclose(opened.drop_attrs(), open_calibration(calibration).drop_attrs())


def test_what_is_no_calibration_store(tmp_path: Path) -> None:
    expect_refusals(
        (FormatError, "file-not-found", lambda: open_calibration(tmp_path / "none.zarr")),
        (FormatError, "file-unreadable", lambda: open_calibration(tmp_path)),
    )
    (tmp_path / "a.nc").write_bytes(b"CDF\x01 is not enough")
    with pytest.raises(FormatError, match="file-unreadable"):
        open_calibration(tmp_path / "a.nc")


# --- dark --------------------------------------------------------------------------------------------------


def test_dark_is_the_mean_of_its_lines(folder: Path) -> None:
    frames = np.fromfile(folder / "dark" / "raw_0", "u2").reshape(40, BANDS, COLUMNS).astype(np.float64)
    line = open_line(folder)
    np.testing.assert_allclose(line["dark_counts"], frames.mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(line["read_noise"] ** 2, frames.var(axis=0, ddof=1) - 1 / 12, rtol=1e-5)
    assert line.attrs["dark_source"] == "raw_0.hdr (40 lines)"


def test_read_noise_of_the_calibration_stands(folder: Path) -> None:
    calibration = make_calibration(read_noise=((), 0.5, {"units": "count"}))
    assert float(open_line(folder, calibration=calibration)["read_noise"]) == 0.5


def test_no_dark_must_be_said(folder: Path) -> None:
    with pytest.raises(SchemaError, match='dark="none"'):
        open_line(folder, dark=None)
    line = open_line(folder, dark="none")
    assert (line["dark_counts"] == 0).all()
    assert (line["dark_counts"].dtype, line.attrs["dark_source"]) == (np.float32, "none")


def test_the_dark_of_a_calibration(folder: Path) -> None:
    stored = (ELEMENT, np.full((BANDS, COLUMNS), 42.5), {"units": "count"})
    line = open_line(folder, dark="calibration", calibration=make_calibration(dark_counts=stored))
    assert (line["dark_counts"] == 42.5).all()
    with pytest.raises(SchemaError, match="'dark_counts' is missing"):
        open_line(folder, dark="calibration")


def test_darks_of_known_times_are_kept_apart(folder: Path) -> None:
    paths = []
    for name, frames, level in (("after", np.arange(60, 70), 30), ("before", np.arange(10), 10)):
        cube = np.full((10, BANDS, COLUMNS), level, np.uint16)
        paths.append(write_cube(folder / name, f"raw_{frames[0]}", cube, ";Exposure (ms) = 5\n"))
        write_index(folder / name / f"frameIndex_{frames[0]}.txt", frames)
        write_nav(folder / name / "imu_gps.txt")
    line = open_line(folder, dark=paths)
    assert line["dark_counts"].dims == ("dark_time", "band", "cross_track")
    assert line["dark_counts"].values[:, 0, 0].tolist() == [10, 30]
    assert line["dark_time"].dtype == "datetime64[ns]"
    assert ((line["dark_time"].values - T0) / np.timedelta64(1, "ms")).tolist() == [31.5, 451.5]
    assert line["dark_exposure_time"].values.tolist() == [0.005, 0.005]


@pytest.mark.real_data
def test_the_real_headwall_dark_is_a_dark(shared_data: Path, tmp_path: Path) -> None:
    shape = (978, 1600)
    calibration = xr.Dataset(
        {"radiance_gain": (ELEMENT, np.ones(shape, np.float32), GAIN)},
        {"wavelength": ("band", np.linspace(379, 1001, 978), NM), "fwhm": ("band", np.full(978, 3.0), NM)},
        {"srf_shape": "gaussian"},
    )  # fmt: skip
    path = shared_data / "envi_cube" / "darkReference.hdr"
    line = open_flightline(
        path, dark=path, calibration=calibration, exposure_time=0.005, start_time=T0, frame_period=0.007
    )
    assert float(line["dark_counts"].mean(dtype="float64")) == pytest.approx(13.97111260, abs=5e-9)
    assert line["counts"].shape == (1, *shape)
    assert json.loads(line.attrs["envi_comments"])["Serial Number"]
