"""A flight line from a Headwall folder made here by hand."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.headwall_flights import (
    BANDS,
    COLUMNS,
    ELEMENT,
    LINES,
    T0,
    make_calibration,
    make_irradiance,
    open_line,
    write_cube,
    write_index,
)  # fmt: skip

from hyperpaint.base import schema
from hyperpaint.base.errors import CollectError, FormatError, PaintWarning, SchemaError, TimeError
from hyperpaint.io.envi.envi_cubes import EnviArray
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
