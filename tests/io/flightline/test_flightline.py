"""A flight line from a Headwall folder made here by hand."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings, strategies as st
from support.codecs import plain_zarr
from support.headwall_flights import (
    BANDS,
    COLUMNS,
    ELEMENT,
    GAIN,
    LINES,
    NM,
    T0,
    make_calibration,
    make_irradiance,
    open_line,
    write_cube,
    write_index,
    write_nav,
)
from support.refusals import expect_refusals

import hyperpaint as hp
from hyperpaint.base import schema
from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import CollectError, FormatError, PaintWarning, SchemaError, StoreError, TimeError
from hyperpaint.io.envi.envi_cubes import EnviArray
from hyperpaint.io.flightline.calibration_store import open_calibration
from hyperpaint.io.flightline.flightline_opening import open_flightline
from hyperpaint.io.navigation.navigation_records import read_imu_gps
from hyperpaint.io.spectrometers.irradiance import cut_irradiance

# --- the line ----------------------------------------------------------------------------------------------


def test_a_line_has_everything_that_calibrates_it(folder: Path, counts: np.ndarray[Any, Any]) -> None:
    line = open_line(folder)
    for name, variable in line.variables.items():
        spec = schema.VARIABLES[str(name)]
        assert variable.dtype == spec.dtype, name
        assert variable.dims in (spec.dims, *spec.alternatives), name
        assert variable.attrs.get("units", "") == spec.units, name
        assert (str(name) in line.coords) == spec.coordinate, name
    schema.require(line, ["counts", "dark_counts", "radiance_gain", "exposure_time", "irradiance"], "a test")
    np.testing.assert_array_equal(line["counts"].values, counts)
    assert line["counts"].compute().dtype == np.uint16
    middle = T0 + (np.arange(LINES) * 7_000_000 - 2_500_000).astype("timedelta64[ns]")
    np.testing.assert_array_equal(line["time"].values[1:], middle[1:])
    assert line["frame"].values.tolist() == list(range(LINES))
    assert line["altitude"].values[10] == pytest.approx(15 + 6.75)
    assert float(line["exposure_time"]) == 0.005
    assert float(line["saturation_count"]) == 4095
    assert float(line["dark_exposure_time"]) == 0.005
    assert line.attrs["srf_shape"] == "slit"
    assert (line.attrs["name"], line.attrs["dropped_frames"]) == ("raw_0", 0)
    assert json.loads(line.attrs["envi_comments"])["Serial Number"] == "G4-426"
    json.dumps(line.attrs)


def test_lines_and_columns_are_numbered_and_bands_are_not(folder: Path) -> None:
    line = open_line(folder)
    assert set(line.indexes) >= {"along_track", "cross_track"}
    for dim in ("along_track", "cross_track"):
        np.testing.assert_array_equal(line[dim], np.arange(line.sizes[dim]))
        assert line[dim].dtype == np.int64
    # an index would join two cameras by the number of a band, in silence
    assert "band" not in line.coords
    assert line.isel(along_track=[2, 3])["along_track"].values.tolist() == [2, 3]


def test_nothing_of_the_cube_is_read(folder: Path, monkeypatch: pytest.MonkeyPatch, no_compute: Any) -> None:
    dark = xr.Dataset({"dark_counts": (ELEMENT, np.zeros((BANDS, COLUMNS)), {"units": "count"})})

    def refuse(self: EnviArray, key: Any) -> None:
        pytest.fail("the cube was read")

    monkeypatch.setattr(EnviArray, "__getitem__", refuse)
    write_index(folder / "flight" / "frameIndex_0.txt", np.delete(np.arange(LINES), 7))
    with no_compute():
        line = open_line(folder, dark=dark)
    assert line["counts"].chunks == ((32, 32, 6), (BANDS,), (COLUMNS,))


def test_chunks_are_those_asked_for(folder: Path, counts: np.ndarray[Any, Any]) -> None:
    assert open_line(folder, chunks=None)["counts"].chunks is None
    line = open_line(folder, chunks={"along_track": 50})
    assert line["counts"].chunks is not None
    assert line["counts"].chunks[0] == (50, 20)
    np.testing.assert_array_equal(open_line(folder, chunks=None)["counts"].values, counts)


def test_a_line_costs_one_task_a_slab(folder: Path) -> None:
    import dask

    (optimised,) = dask.optimize(open_line(folder)["counts"].data)
    assert len(optimised.__dask_graph__()) <= 3 + 1


def test_a_dataset_serves_as_cube(folder: Path, counts: np.ndarray[Any, Any]) -> None:
    cube = xr.Dataset({"counts": (("line", "bands", "sample"), counts, {"units": "count"})})
    line = open_line(folder, cube=cube, exposure_time=0.005, name="mine")
    np.testing.assert_array_equal(line["counts"].values, counts)
    assert line.attrs["name"] == "mine"


# --- dropped frames ----------------------------------------------------------------------------------------


def test_dropped_frames_by_row(folder: Path, counts: np.ndarray[Any, Any]) -> None:
    frames = np.delete(np.arange(LINES + 3), [5, 6, 40])
    write_index(folder / "flight" / "frameIndex_0.txt", frames)
    line = open_line(folder)
    assert (line["frame"].values.tolist(), line.attrs["dropped_frames"]) == (frames.tolist(), 3)
    assert not np.isnat(line["time"].values[1:]).any()
    assert (line["time"].values[5] - line["time"].values[4]) == np.timedelta64(21, "ms")
    np.testing.assert_array_equal(line["counts"].values, counts)


def test_dropped_frames_by_number_are_blank(folder: Path, counts: np.ndarray[Any, Any]) -> None:
    dropped = [5, 6, 40]
    write_index(folder / "flight" / "frameIndex_0.txt", np.delete(np.arange(LINES), dropped))
    line = open_line(folder)
    assert line["frame"].values.tolist() == list(range(LINES))
    assert np.flatnonzero(np.isnat(line["time"].values)).tolist() == dropped
    assert np.isnan(line["latitude"].values[dropped]).all()
    assert line.attrs["dropped_frames"] == 3
    found = line["counts"].compute()
    assert found.dtype == np.uint16
    assert (found[dropped] == 65535).all()
    kept = np.delete(np.arange(LINES), dropped)
    np.testing.assert_array_equal(found[kept], counts[kept])


def test_cubes_of_one_flight_share_their_navigation(folder: Path, counts: np.ndarray[Any, Any]) -> None:
    flight = folder / "flight"
    write_cube(flight, "raw_70", counts[:20])
    write_index(flight / "frameIndex_70.txt", np.arange(70, 90))
    whole = write_index(flight / "frameIndex.txt", np.arange(90))
    nav = read_imu_gps(flight / "imu_gps.txt")
    own = open_line(folder, cube=flight / "raw_70", frame_index=flight / "frameIndex_70.txt", nav=nav)
    shared = open_line(folder, cube=flight / "raw_70.hdr", frame_index=whole)
    xr.testing.assert_identical(own.drop_attrs(), shared.drop_attrs())
    assert own["time"].values[0] == T0 + np.timedelta64(70 * 7_000_000 - 2_500_000, "ns")
    first = open_line(folder, frame_index=whole)
    assert first["frame"].values[-1] == 69


def test_a_frame_index_of_another_cube_is_refused(folder: Path) -> None:
    write_index(folder / "flight" / "frameIndex_0.txt", np.arange(LINES - 1))
    with pytest.raises(FormatError, match="frame-index-mismatch"):
        open_line(folder)


def test_a_cube_cut_short_in_flight(folder: Path, counts: np.ndarray[Any, Any]) -> None:
    counts[:60].tofile(folder / "flight" / "raw_0")
    with pytest.raises(FormatError, match="shorter"):
        open_line(folder)
    with pytest.warns(PaintWarning, match="60 whole lines"):
        line = open_line(folder, keep_whole_lines=True)
    assert (line.sizes["along_track"], line["frame"].values[-1]) == (60, 59)


# --- exposure ----------------------------------------------------------------------------------------------


def test_exposure_from_settings_then_from_the_header(folder: Path) -> None:
    assert open_line(folder).attrs["exposure_source"] == "settings.txt"
    (folder / "flight" / "settings.txt").unlink()
    line = open_line(folder)
    assert (float(line["exposure_time"]), line.attrs["exposure_source"]) == (0.005, "header comments")


def test_the_given_exposure_wins_with_a_warning(folder: Path) -> None:
    with pytest.warns(PaintWarning) as caught:
        line = open_line(folder, exposure_time=0.004)
    assert "exposure_time 4 ms is used; settings.txt 5 ms, header comments 5 ms" in str(caught[0].message)
    assert (float(line["exposure_time"]), line["time"].values[1]) == (0.004, T0 + np.timedelta64(5, "ms"))


def test_exposure_of_every_line(folder: Path) -> None:
    line = open_line(folder, exposure_time=np.full(LINES, 0.005))
    assert line["exposure_time"].dims == ("along_track",)
    with pytest.raises(SchemaError, match="70 lines"):
        open_line(folder, exposure_time=[0.005, 0.005])


@pytest.mark.parametrize("exposure", [-0.005, 0.0, float("nan"), float("inf")])
def test_exposure_must_be_positive(folder: Path, exposure: float) -> None:
    with pytest.raises(SchemaError, match="positive"):
        open_line(folder, exposure_time=exposure)


def test_exposure_from_nowhere(folder: Path, counts: np.ndarray[Any, Any]) -> None:
    (folder / "flight" / "settings.txt").unlink()
    write_cube(folder / "flight", "raw_0", counts)
    with pytest.raises(SchemaError, match="exposure-missing"):
        open_line(folder)


# --- irradiance --------------------------------------------------------------------------------------------


def test_the_irradiance_is_cut_to_the_line(folder: Path) -> None:
    seconds = (open_line(folder)["irradiance_time"].values - T0) / np.timedelta64(1, "s")
    assert (seconds[0], seconds[-1]) == (-60, 60)
    assert "irradiance" not in open_line(folder, irradiance=None)


def test_at_least_the_bracketing_samples_are_kept() -> None:
    sky = make_irradiance(-500, 1000, 500)
    made = cut_irradiance(sky, T0 + np.array([1, 2]) * np.timedelta64(1, "s"))
    assert ((made["irradiance_time"].values - T0) / np.timedelta64(1, "s")).tolist() == [0, 500]
    made = cut_irradiance(sky, np.array([T0, np.datetime64("NaT", "ns")]))
    assert ((made["irradiance_time"].values - T0) / np.timedelta64(1, "s")).tolist() == [0]


@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
def test_mixed_datetime_units_are_one(unit: str) -> None:
    sky = make_irradiance()
    sky = sky.assign_coords(irradiance_time=sky["irradiance_time"].values.astype(f"datetime64[{unit}]"))
    made = cut_irradiance(sky, np.array([T0], "datetime64[ns]"))
    assert (made["irradiance_time"].dtype, made.sizes["irradiance_time"]) == ("datetime64[ns]", 61)


def test_a_record_of_another_time_is_refused(folder: Path) -> None:
    sky = make_irradiance()
    for hours in (-5, 5):
        away = sky.assign_coords(irradiance_time=sky["irradiance_time"] + np.timedelta64(hours, "h"))
        with pytest.raises(TimeError, match="utc_offset_h"):
            open_line(folder, irradiance=away)
    with pytest.raises(TimeError, match="time-unordered"):
        open_line(folder, irradiance=sky.isel(irradiance_time=slice(None, None, -1)))


# --- a vendor's radiance -----------------------------------------------------------------------------------


def test_a_radiance_cube_is_a_start(folder: Path) -> None:
    values = np.random.default_rng(1).random((LINES, BANDS, COLUMNS)).astype(np.float32)
    cube = write_cube(
        folder / "flight", "raw_0_rd", values, ";Units = mW/(cm2*sr*um)\n",
        description="{[HEADWALL Hyperspec III],RADIANCE}",
    )  # fmt: skip
    line = open_line(folder, cube=cube, calibration=None, dark=None, fwhm_nm=6.0)
    assert "counts" not in line
    assert "dark_counts" not in line
    assert line["radiance"].dtype == line["radiance"].compute().dtype == np.float32
    assert line["radiance"].attrs["units"] == "W m-2 sr-1 nm-1"
    np.testing.assert_allclose(line["radiance"].values, values * 0.01, rtol=1e-6)
    assert line["fwhm"].values.tolist() == [6.0] * BANDS


def test_radiance_without_units_or_reflectance_is_refused(folder: Path) -> None:
    values = np.ones((LINES, BANDS, COLUMNS), np.float32)
    for level, match in (("RADIANCE", "radiance_units"), ("REFLECTANCE", "holds reflectance")):
        cube = write_cube(folder / "flight", "raw_0_x", values, description=f"{{[HEADWALL],{level}}}")
        with pytest.raises(FormatError, match=match):
            open_line(folder, cube=cube, calibration=None)


# --- everything at once ------------------------------------------------------------------------------------


def test_all_problems_come_in_one_message(folder: Path, counts: np.ndarray[Any, Any]) -> None:
    wrong = make_calibration()
    del wrong["radiance_gain"].attrs["units"]
    with pytest.raises(SchemaError) as caught:
        open_line(folder, calibration=wrong, exposure_time=-0.005, dark=None, saturation_count=-1)
    text = str(caught.value)
    expected = ("radiance_gain' has no units", "exposure_time -5 ms", 'dark="none"', "saturation_count -1")
    assert all(part in text for part in expected)
    counts[:-1].tofile(folder / "flight" / "raw_0")
    (folder / "flight" / "settings.txt").write_text("Exposure (ms) = -1")
    with pytest.raises(CollectError) as caught_too:
        open_line(folder, calibration=wrong, dark=[])
    text = str(caught_too.value)
    expected = ("no units", "shorter than its header", "positive exposure", "no dark")
    assert all(part in text for part in expected)


@pytest.mark.parametrize("change", [b"", b"\0\0", b"x" * 4])
def test_over_long_and_truncated_cubes(folder: Path, counts: np.ndarray[Any, Any], change: bytes) -> None:
    data = counts.tobytes()
    (folder / "flight" / "raw_0").write_bytes(data + change if change else data[:-3])
    with pytest.raises(FormatError, match="file-size"):
        open_line(folder)


def test_counts_of_another_type_are_refused(folder: Path, counts: np.ndarray[Any, Any]) -> None:
    cube = write_cube(folder / "flight", "raw_0", counts.astype(np.int16), ";Exposure (ms) = 5\n")
    with pytest.raises(FormatError, match="int16"):
        open_line(folder, cube=cube)
    cube = write_cube(folder / "flight", "raw_0", (counts % 256).astype(np.uint8), ";Exposure (ms) = 5\n")
    assert open_line(folder, cube=cube, bit_depth=8)["counts"].compute().dtype == np.uint16


@pytest.mark.filterwarnings("ignore:.*is used; settings.txt")
def test_an_exposure_of_years_is_refused(folder: Path) -> None:
    with pytest.raises(TimeError, match="value-out-of-range"):
        open_line(folder, exposure_time=1e19)


# --- the calibration and the dark of a flight line --------------------------------------------------------


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


# --- calibration stores that hyperpaint wrote must be whole; those of others are in test_any_zarr ---------


@pytest.fixture
def calibration() -> xr.Dataset:
    gain = np.linspace(1e-10, 2e-10, 12, dtype=np.float32).reshape(3, 4)
    return xr.Dataset(
        {"radiance_gain": (("band", "cross_track"), gain, {"units": "W m-2 sr-1 nm-1 s count-1"})},
        {
            "wavelength": ("band", [500.0, 550.0, 600.0], {"units": "nm"}),
            "fwhm": ("band", [6.0, 6.0, 6.0], {"units": "nm"}),
        },
        {"srf_shape": "slit"},
    )


def _chunk_lost(group: Path) -> None:
    shutil.rmtree(group / "radiance_gain" / "c")


def _array_lost(group: Path) -> None:
    shutil.rmtree(group / "fwhm")


def _attributes_changed(group: Path) -> None:
    document = json.loads((group / "zarr.json").read_text())
    document["attributes"]["srf_shape"] = "gaussian"
    (group / "zarr.json").write_text(json.dumps(document))


def _chunk_damaged(group: Path) -> None:
    chunk = group / "fwhm/c/0"
    chunk.write_bytes(chunk.read_bytes()[:-1])


@pytest.mark.parametrize("where", [None, "calibration"])
@pytest.mark.parametrize("damage", [_chunk_lost, _array_lost, _attributes_changed, _chunk_damaged])
def test_what_we_wrote_must_be_whole(
    damage: Callable[[Path], None], where: str | None, calibration: xr.Dataset, tmp_path: Path
) -> None:
    path = tmp_path / "cal.zarr"
    hp.to_store(calibration, path, where)
    np.testing.assert_array_equal(open_calibration(path).radiance_gain, calibration.radiance_gain)
    damage(path / (where or ""))
    with pytest.raises(FormatError, match="file-unreadable"):
        open_calibration(path)


# --- integers are counts of a flight line where their header, a dark or the user says so ------------------


WORDLESS = {"description": "{hood}"}


def _rewrite(folder: Path, counts: np.ndarray[Any, Any], **fields: str) -> None:
    write_cube(folder / "flight", "raw_0", counts, **{**WORDLESS, **fields})


def test_a_dark_says_that_integers_are_counts(folder: Path, counts: np.ndarray[Any, Any]) -> None:
    _rewrite(folder, counts)
    write_cube(folder / "dark", "raw_0", np.full_like(counts, 100), **WORDLESS)
    line = open_line(folder)
    np.testing.assert_array_equal(line["counts"].values, counts)
    assert float(line["dark_counts"].mean()) == 100


@pytest.mark.parametrize("said", [{"quantity": "counts", "dark": "none"}, {"dark": "none"}])
def test_so_does_the_user(folder: Path, counts: np.ndarray[Any, Any], said: dict[str, Any]) -> None:
    _rewrite(folder, counts)
    assert open_line(folder, **said)["counts"].shape == counts.shape


def test_otherwise_they_are_refused_with_the_ways_out(folder: Path, counts: np.ndarray[Any, Any]) -> None:
    _rewrite(folder, counts)
    with pytest.raises(FormatError, match="quantity-ambiguous"):
        open_line(folder, dark=None)


@pytest.mark.parametrize("said", [{}, {"quantity": "radiance"}])
def test_integers_with_units_of_radiance_are_no_counts(
    folder: Path, counts: np.ndarray[Any, Any], said: dict[str, Any]
) -> None:
    # Rationale: a vendor's radiance in integers opened as counts, and its units were of no account
    _rewrite(folder, counts)
    said = {"radiance_units": "uW m-2 sr-1 nm-1", "dark": None, "calibration": None, **said}
    line = open_line(folder, **said, fwhm_nm=6.0)
    assert "counts" not in line
    assert line["radiance"].shape == (LINES, BANDS, counts.shape[2])
    np.testing.assert_allclose(line["radiance"].values[3, 1, 2], counts[3, 1, 2] * 1e-6, rtol=1e-6)


def test_a_dark_that_is_radiance_is_refused(folder: Path, counts: np.ndarray[Any, Any]) -> None:
    write_cube(folder / "dark", "raw_0", counts, description="{[HEADWALL Hyperspec III],RADIANCE}")
    with pytest.raises(FormatError, match="counts-missing"):
        open_line(folder)


def test_what_the_user_says_against_the_header_is_refused(folder: Path) -> None:
    with pytest.raises(FormatError, match=r"header.* counts"):
        open_line(folder, quantity="radiance", radiance_units="W m-2 sr-1 nm-1")


# --- the line table: every number keeps its bits, and the pose is read again as navigation ----------------


POSE = ("latitude", "longitude", "altitude", "roll", "pitch", "heading")
START = np.datetime64("2024-06-01T12:00:00.000000001", "ns")


def line_of(pose: dict[str, Any], lines: int = 3) -> xr.Dataset:
    coords = {
        name: ("along_track", np.asarray(pose[name], float), schema.VARIABLES[name].attrs) for name in POSE
    }
    return xr.Dataset(
        {
            "reflectance": (schema.CUBE, np.zeros((lines, 2, 4), "f4"), {"units": "1"}),
            "irradiance_age": ("along_track", np.linspace(0, 1, lines, dtype="f4"), {"units": "s"}),
            "exposure_time": ((), 5e-3, {"units": "s"}),
            "wavelength_note": ("band", ["a", "b"]),
        },
        {
            "time": ("along_track", START + np.arange(lines) * np.timedelta64(7, "ms")),
            "frame": ("along_track", np.arange(10, 10 + lines)),
            "comment": ("along_track", ["x,y"] * lines),
            **coords,
        },
        Convention(column_order="left_to_right", stamp_reference="end").to_attrs(),
    )


def test_a_table_of_lines(tmp_path: Path) -> None:
    line = line_of({name: [0.1, np.nan, 1 / 3] for name in POSE})
    line["time"] = line.time.where(line.frame != 11)
    text = hp.io.write_line_table(line, tmp_path / "lines.csv").read_text().splitlines()
    assert "# convention_column_order: left_to_right" in text
    rows = [row for row in text if not row.startswith("#")]
    assert rows[0] == (
        "line,frame,time,latitude [degree],longitude [degree],altitude [m],roll [degree],pitch [degree],"
        "heading [degree],exposure_time [s],irradiance_age [s]"
    )
    assert rows[1] == "0,10,2024-06-01T12:00:00.000000001Z,0.1,0.1,0.1,0.1,0.1,0.1,0.005,0.0"
    assert rows[2] == "1,11,,,,,,,,0.005,0.5"
    flight = hp.open_navigation(tmp_path / "lines.csv")
    assert flight.attrs["rows_without_time"] == 1
    assert Convention.from_attrs(flight.attrs) == Convention.from_attrs(line.attrs)
    assert "assumed" not in flight.attrs


@settings(max_examples=30)
@given(st.data())
def test_the_pose_comes_back_bit_for_bit(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    lines = data.draw(st.integers(1, 8))
    number = st.floats(-90.0, 90.0) | st.just(float("nan"))
    pose = {name: data.draw(st.lists(number, min_size=lines, max_size=lines)) for name in POSE}
    line = line_of(pose, lines)
    flight = hp.open_navigation(hp.io.write_line_table(line, tmp_path_factory.mktemp("table") / "lines.csv"))
    for name in POSE:
        np.testing.assert_array_equal(flight[name], line[name])
    np.testing.assert_array_equal(flight.navigation_time, line.time)


def test_what_is_no_line_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SchemaError, match="dim-missing"):
        hp.io.write_line_table(xr.Dataset({"a": ("x", [1.0])}), tmp_path / "lines.csv")
    path = hp.io.write_line_table(line_of({name: [0.0] * 3 for name in POSE}), tmp_path / "lines.csv")
    with pytest.raises(StoreError, match="overwrite=True"):
        hp.io.write_line_table(line_of({name: [0.0] * 3 for name in POSE}), path)
    assert [one.name for one in tmp_path.iterdir()] == ["lines.csv"]
