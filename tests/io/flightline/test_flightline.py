"""A flight line from a Headwall folder made here by hand."""

import json
import re
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import dask
import numpy as np
import pytest
import xarray as xr
from hypothesis import given, strategies as st
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
from support.refusals import expect_equal, expect_error, expect_errors, expect_refusals

import hyperpaint as hp
from hyperpaint.base import schema
from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import (
    CollectError,
    FormatError,
    PaintError,
    PaintWarning,
    SchemaError,
    StoreError,
    TimeError,
)
from hyperpaint.io.envi.envi_cubes import EnviArray
from hyperpaint.io.files.reading import MAX_TABLE_ROWS, read_table
from hyperpaint.io.flightline.flightline_opening import DARK_NONE, Timing, open_dark, open_flightline
from hyperpaint.io.flightline.side_files import (
    FrameIndex,
    exposure_seconds,
    match_frames,
    open_calibration,
    read_frame_index,
    read_settings,
    sum_dark,
)
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
    expect_equal((line["counts"].values, counts), (line["counts"].compute().dtype, np.uint16))
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
    # lines and columns are numbered; an index would join two cameras by the number of a band, in silence
    for dim in ("along_track", "cross_track"):
        expect_equal((line[dim], np.arange(line.sizes[dim])), (line.indexes[dim].dtype, np.int64))
    assert "band" not in line.coords
    assert line.isel(along_track=[2, 3])["along_track"].values.tolist() == [2, 3]
    # a slab is one task; other chunks are those asked for
    (optimised,) = dask.optimize(line["counts"].data)
    assert len(optimised.__dask_graph__()) <= 3 + 1
    whole = open_line(folder, chunks=None, exposure_time=np.full(LINES, 0.005))
    assert (whole["counts"].chunks, whole["exposure_time"].dims) == (None, ("along_track",))
    np.testing.assert_array_equal(whole["counts"].values, counts)
    assert open_line(folder, chunks={"along_track": 50})["counts"].chunks[0] == (50, 20)
    # the exposure is in the settings, or else in the header
    assert line.attrs["exposure_source"] == "settings.txt"
    (folder / "flight" / "settings.txt").unlink()
    other = open_line(folder, irradiance=None)
    assert (float(other["exposure_time"]), other.attrs["exposure_source"]) == (0.005, "header comments")
    assert "irradiance" not in other


def test_nothing_of_the_cube_is_read(folder: Path, monkeypatch: pytest.MonkeyPatch, no_compute: Any) -> None:
    dark = xr.Dataset({"dark_counts": (ELEMENT, np.zeros((BANDS, COLUMNS)), {"units": "count"})})

    def refuse(self: EnviArray, key: Any) -> None:
        pytest.fail("the cube was read")

    monkeypatch.setattr(EnviArray, "__getitem__", refuse)
    write_index(folder / "flight" / "frameIndex_0.txt", np.delete(np.arange(LINES), 7))
    with no_compute():
        line = open_line(folder, dark=dark)
    assert line["counts"].chunks == ((32, 32, 6), (BANDS,), (COLUMNS,))


def test_a_dataset_or_eight_bits_serve_as_cube(folder: Path, counts: np.ndarray[Any, Any]) -> None:
    small = write_cube(folder / "flight", "raw_0", (counts % 256).astype(np.uint8), ";Exposure (ms) = 5\n")
    assert open_line(folder, cube=small, bit_depth=8)["counts"].compute().dtype == np.uint16
    cube = xr.Dataset({"counts": (("line", "bands", "sample"), counts, {"units": "count"})})
    line = open_line(folder, cube=cube, exposure_time=0.005, name="mine")
    expect_equal((line["counts"].values, counts), (line.attrs["name"], "mine"))


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
    assert open_line(folder, frame_index=whole)["frame"].values[-1] == 69


def test_a_cube_cut_short_in_flight(folder: Path, counts: np.ndarray[Any, Any]) -> None:
    counts[:60].tofile(folder / "flight" / "raw_0")
    expect_errors((FormatError, "shorter", lambda: open_line(folder)))
    with pytest.warns(PaintWarning, match="60 whole lines"):
        line = open_line(folder, keep_whole_lines=True)
    assert (line.sizes["along_track"], line["frame"].values[-1]) == (60, 59)


# --- exposure ----------------------------------------------------------------------------------------------


def test_the_given_exposure_wins_with_a_warning(folder: Path) -> None:
    with pytest.warns(PaintWarning) as caught:
        line = open_line(folder, exposure_time=0.004)
    assert "exposure_time 4 ms is used; settings.txt 5 ms, header comments 5 ms" in str(caught[0].message)
    assert (float(line["exposure_time"]), line["time"].values[1]) == (0.004, T0 + np.timedelta64(5, "ms"))


# --- irradiance --------------------------------------------------------------------------------------------


def test_the_irradiance_is_cut_to_the_line(folder: Path) -> None:
    seconds = (open_line(folder)["irradiance_time"].values - T0) / np.timedelta64(1, "s")
    assert (seconds[0], seconds[-1]) == (-60, 60)
    # at least the bracketing samples are kept
    sky = make_irradiance(-500, 1000, 500)
    made = cut_irradiance(sky, T0 + np.array([1, 2]) * np.timedelta64(1, "s"))
    assert ((made["irradiance_time"].values - T0) / np.timedelta64(1, "s")).tolist() == [0, 500]
    made = cut_irradiance(sky, np.array([T0, np.datetime64("NaT", "ns")]))
    assert ((made["irradiance_time"].values - T0) / np.timedelta64(1, "s")).tolist() == [0]


@pytest.mark.parametrize(
    ("zones", "minutes", "words"),
    [
        ([-4.0], (60, 80), "utc_offset_h = -3 instead of -4 would fit [time-uncovered]"),
        ([-4.0], (60, 200), "utc_offset_h = -3 or -2 or -1 instead of -4 would fit"),
        ([0.0], (-40, -20), "utc_offset_h = -0.5 instead of 0 would fit"),
        ([-13.5], (-65, -55), "clock_offset_s = 3305 to 3900 would fit"),  # no zone of -14.5 h
        ([], (2, 4), "clock_offset_s = -235 to -120 would fit"),
        ([0.0], (1, 1.05), "the record is 2 s shorter than the flight"),
    ],
)
def test_the_clock_that_would_fit_is_told(
    zones: list[float], minutes: tuple[float, float], words: str
) -> None:
    # the record begins or ends some minutes from five seconds of flight
    first, last = (round(60 * value) for value in minutes)
    sky = make_irradiance(first, last + 1, 1).assign_attrs(irradiance_utc_offset_h=zones)
    line_times = T0 + np.array([0, 5]) * np.timedelta64(1, "s")
    expect_error(TimeError, re.escape(words), lambda: cut_irradiance(sky, line_times))
    # an offset of the clock that is as large as a zone may be the mistake itself
    sky = sky.assign_attrs(irradiance_clock_offset_s=3600.0)
    expect_error(TimeError, "clock_offset_s = |shorter", lambda: cut_irradiance(sky, line_times))


@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
def test_mixed_datetime_units_are_one(unit: str) -> None:
    sky = make_irradiance()
    sky = sky.assign_coords(irradiance_time=sky["irradiance_time"].values.astype(f"datetime64[{unit}]"))
    made = cut_irradiance(sky, np.array([T0], "datetime64[ns]"))
    assert (made["irradiance_time"].dtype, made.sizes["irradiance_time"]) == ("datetime64[ns]", 61)


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


# --- refusals ----------------------------------------------------------------------------------------------

WORDLESS = {"description": "{hood}"}


def cube_of(folder: Path, counts: np.ndarray[Any, Any], place: str = "flight", **fields: str) -> None:
    write_cube(folder / place, "raw_0", counts, **{**WORDLESS, **fields})


def _away(**steps: int) -> xr.Dataset:
    sky = make_irradiance()
    return sky.assign_coords(irradiance_time=sky["irradiance_time"] + np.timedelta64(steps["h"], "h"))


def _without_exposure(folder: Path, counts: np.ndarray[Any, Any]) -> None:
    (folder / "flight" / "settings.txt").unlink()
    write_cube(folder / "flight", "raw_0", counts)


_RADIANCE = {"description": "{[HEADWALL Hyperspec III],RADIANCE}"}
_VALUES = np.ones((LINES, BANDS, COLUMNS), np.float32)


@pytest.mark.filterwarnings("ignore:.*is used; settings.txt")
@pytest.mark.parametrize(
    ("change", "options", "error", "match"),
    [
        (lambda f, _: write_index(f / "flight/frameIndex_0.txt", np.arange(LINES - 1)), {}, FormatError,
         "frame-index-mismatch"),
        *((None, {"exposure_time": wrong}, SchemaError, "positive")
          for wrong in (-0.005, 0.0, np.nan, np.inf)),
        (None, {"exposure_time": [0.005, 0.005]}, SchemaError, "70 lines"),
        (None, {"exposure_time": []}, SchemaError, "70 lines"),
        (None, {"exposure_time": 1e19}, TimeError, "value-out-of-range"),
        (_without_exposure, {}, SchemaError, "exposure-missing"),
        *((None, {"irradiance": _away(h=hours)}, TimeError, "utc_offset_h") for hours in (-5, 5)),
        (None, {"irradiance": make_irradiance().isel(irradiance_time=slice(None, None, -1))}, TimeError,
         "time-unordered"),
        (lambda f, _: cube_of(f, _VALUES, **_RADIANCE), {"calibration": None}, FormatError, "radiance_units"),
        (lambda f, _: cube_of(f, _VALUES, description="{[HEADWALL],REFLECTANCE}"), {"calibration": None},
         FormatError, "holds reflectance"),
        *((lambda f, c, end=end: (f / "flight/raw_0").write_bytes(c.tobytes() + end), {}, FormatError,
           "file-size") for end in (b"\0\0", b"x" * 4)),
        (lambda f, c: (f / "flight/raw_0").write_bytes(c.tobytes()[:-3]), {}, FormatError, "file-size"),
        (lambda f, c: write_cube(f / "flight", "raw_0", c.astype(np.int16)), {}, FormatError, "int16"),
        (None, {"calibration": make_calibration().isel(band=slice(2))}, SchemaError, "grid-mismatch"),
        (cube_of, {"dark": None}, FormatError, "quantity-ambiguous"),
        (lambda f, c: cube_of(f, c, "dark", **_RADIANCE), {}, FormatError, "counts-missing"),
        (None, {"quantity": "radiance", "radiance_units": "W m-2 sr-1 nm-1"}, FormatError,
         r"header.* counts"),
        (None, {"dark": None}, SchemaError, 'dark="none"'),
        (None, {"dark": "calibration"}, SchemaError, "'dark_counts' is missing"),
    ],
)  # fmt: skip
def test_what_is_no_flight_line(
    folder: Path, counts: np.ndarray[Any, Any], change: Any, options: dict[str, Any], error: Any, match: str
) -> None:
    if change is not None:
        change(folder, counts)
    expect_errors((error, match, lambda: open_line(folder, **options)))


@pytest.mark.parametrize(
    ("dims", "name", "code"),
    [
        (("band", "cross_track"), "counts", "dims-wrong"),
        (("along_track", "band"), "counts", "dims-wrong"),
        (("along_track", "band", "cross_track"), "radiance", "units-missing"),
    ],
)
def test_what_depends_on_a_wrong_cube_is_not_examined(dims: tuple[str, ...], name: str, code: str) -> None:
    sizes = {"along_track": 3, "band": 4, "cross_track": 5}
    cube = xr.Dataset({name: (dims, np.zeros([sizes[dim] for dim in dims], "u2"))})
    recorded = {"exposure_time": 0.005, "start_time": T0, "frame_period": 0.007}
    caught = expect_error(PaintError, code, lambda: open_flightline(cube, dark="none", **recorded))
    assert set(re.findall(r"\[([a-z]+-[a-z-]+)\]", str(caught))) <= {code, "calibration-missing"}


# --- everything at once ------------------------------------------------------------------------------------


def test_all_problems_come_in_one_message(folder: Path, counts: np.ndarray[Any, Any]) -> None:
    wrong = make_calibration()
    del wrong["radiance_gain"].attrs["units"]
    caught = expect_error(
        SchemaError,
        None,
        lambda: open_line(folder, calibration=wrong, exposure_time=-0.005, dark=None, saturation_count=-1),
    )
    text = str(caught)
    expected = ("radiance_gain' has no units", "exposure_time -5 ms", 'dark="none"', "saturation_count -1")
    assert all(part in text for part in expected)
    counts[:-1].tofile(folder / "flight" / "raw_0")
    (folder / "flight" / "settings.txt").write_text("Exposure (ms) = -1")
    text = str(expect_error(CollectError, None, lambda: open_line(folder, calibration=wrong, dark=[])))
    expected = ("no units", "shorter than its header", "positive exposure", "no dark")
    assert all(part in text for part in expected)


# --- the calibration and the dark of a flight line --------------------------------------------------------


# --- calibration -------------------------------------------------------------------------------------------


def test_wavelengths_of_the_calibration_win(folder: Path) -> None:
    own = make_calibration().assign_coords(wavelength=("band", [500.5, 600.5, 701.0], NM))
    with pytest.warns(PaintWarning, match="wavelength-conflict"):
        line = open_line(folder, calibration=own)
    assert line["wavelength"].values.tolist() == [500.5, 600.5, 701.0]


def test_gain_in_microwatts_is_converted(folder: Path) -> None:
    gain = make_calibration()["radiance_gain"].copy(data=np.full((BANDS, COLUMNS), 2e-4))
    gain.attrs["units"] = "uW cm-2 sr-1 nm-1 s count-1"
    line = open_line(folder, calibration=make_calibration(radiance_gain=gain))
    np.testing.assert_allclose(line["radiance_gain"], 2e-6, rtol=1e-7)


TABULATED = make_calibration(srf=(("band", "srf_offset"), np.ones((BANDS, 5)), {"units": "1"})).assign_coords(
    srf_offset=("srf_offset", np.arange(-2.0, 3.0), NM)
)


def test_bad_elements_line_shapes_noise_and_dark_of_a_calibration(folder: Path) -> None:
    calibration = make_calibration()
    calibration["radiance_gain"].values[0, 0] = np.nan
    del calibration.attrs["srf_shape"]
    with pytest.warns(PaintWarning, match="Gaussian"):
        opened = open_calibration(calibration)
    assert (opened.attrs["srf_shape"], int(opened["radiance_gain"].isnull().sum())) == ("gaussian", 1)
    line = open_line(folder, calibration=TABULATED.assign_attrs(srf_shape="tabulated"))
    assert (line["srf"].dtype, line["srf_offset"].values.tolist()) == (np.float64, [-2, -1, 0, 1, 2])
    assert (line["srf"].dims, line.attrs["srf_shape"]) == (("band", "srf_offset"), "tabulated")
    stored = make_calibration(
        read_noise=((), 0.5, {"units": "count"}),
        dark_counts=(ELEMENT, np.full((BANDS, COLUMNS), 42.5), {"units": "count"}),
    )
    line = open_line(folder, dark="calibration", calibration=stored)
    assert float(line["read_noise"]) == 0.5
    assert (line["dark_counts"] == 42.5).all()


def _gain(value: float) -> xr.Dataset:
    calibration = make_calibration()
    calibration["radiance_gain"].values[:, 0 if np.isfinite(value) else slice(None)] = value
    return calibration


def test_what_is_no_calibration(tmp_path: Path) -> None:
    (tmp_path / "a.nc").write_bytes(b"CDF\x01 is not enough")
    expect_refusals(
        (FormatError, "file-not-found", lambda: open_calibration(tmp_path / "none.zarr")),
        (FormatError, "file-unreadable", lambda: open_calibration(tmp_path)),
        (FormatError, "file-unreadable", lambda: open_calibration(tmp_path / "a.nc")),
        (SchemaError, "not-finite", "NaN everywhere", lambda: open_calibration(_gain(np.nan))),
        *(
            (SchemaError, "value-out-of-range", text, lambda gain=gain: open_calibration(_gain(gain)))
            for gain, text in {0.0: "zero, negative", -1.0: "zero, negative", np.inf: "infinite"}.items()
        ),
        (
            SchemaError,
            "variable-missing",
            lambda: open_calibration(make_calibration().assign_attrs(srf_shape="tabulated")),
        ),
    )


def test_a_calibration_says_all_that_is_wrong_with_it() -> None:
    wrong = make_calibration()
    del wrong["radiance_gain"].attrs["units"]
    wrong = wrong.assign_coords(fwhm=("band", [6.0, -6.0, 6.0], NM)).drop_vars("wavelength")
    wrong.attrs["srf_shape"] = "box"
    text = str(expect_error(SchemaError, None, lambda: open_calibration(wrong)))
    assert all(
        part in text for part in ("no units", "'fwhm' is not finite", "'wavelength' is missing", "'box'")
    )
    micrometres = make_calibration().assign_coords(wavelength=("band", [0.5, 0.6, 0.7], NM))
    expect_error(SchemaError, "wavelength-range", lambda: open_calibration(micrometres))


@pytest.mark.parametrize("suffix", [".zarr", ".nc"])
def test_calibration_stores(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"calibration{suffix}"
    calibration = make_calibration(radiance_gain_u=(ELEMENT, np.ones((BANDS, COLUMNS))))
    if suffix == ".zarr":
        plain_zarr(calibration, path)
    else:
        calibration.to_netcdf(path, engine="h5netcdf")
    opened = open_calibration(path)
    assert opened["radiance_gain"].dtype == np.float32
    assert "radiance_gain_u" in opened
    xr.testing.assert_allclose(opened.drop_attrs(), open_calibration(calibration).drop_attrs())


# --- dark --------------------------------------------------------------------------------------------------


def test_dark_is_the_mean_of_its_lines(folder: Path) -> None:
    frames = np.fromfile(folder / "dark" / "raw_0", "u2").reshape(40, BANDS, COLUMNS).astype(np.float64)
    line = open_line(folder)
    np.testing.assert_allclose(line["dark_counts"], frames.mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(line["read_noise"] ** 2, frames.var(axis=0, ddof=1) - 1 / 12, rtol=1e-5)
    assert line.attrs["dark_source"] == "raw_0.hdr (40 lines)"
    none = open_line(folder, dark="none")
    assert (none["dark_counts"] == 0).all()
    assert (none["dark_counts"].dtype, none.attrs["dark_source"]) == (np.float32, "none")


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


@pytest.mark.parametrize("where", [None, "calibration"])
@pytest.mark.parametrize(
    "damage",
    [
        lambda group: shutil.rmtree(group / "radiance_gain" / "c"),
        lambda group: shutil.rmtree(group / "fwhm"),
        lambda group: replace(group / "zarr.json", b"slit", b"gaussian"),
        lambda group: replace(group / "fwhm/c/0", (group / "fwhm/c/0").read_bytes()[-1:], b""),
    ],
    ids=["chunk lost", "array lost", "attributes changed", "chunk damaged"],
)
def test_what_we_wrote_must_be_whole(
    damage: Callable[[Path], None], where: str | None, tmp_path: Path
) -> None:
    path, calibration = tmp_path / "cal.zarr", make_calibration()
    hp.to_store(calibration, path, where)
    np.testing.assert_array_equal(
        open_calibration(path).radiance_gain, open_calibration(calibration).radiance_gain
    )
    damage(path / (where or ""))
    expect_errors((FormatError, "file-unreadable", lambda: open_calibration(path)))


def replace(path: Path, old: bytes, new: bytes) -> None:
    path.write_bytes(path.read_bytes().replace(old, new))


# --- integers are counts of a flight line where their header, a dark or the user says so ------------------


def test_a_dark_says_that_integers_are_counts(folder: Path, counts: np.ndarray[Any, Any]) -> None:
    cube_of(folder, counts)
    write_cube(folder / "dark", "raw_0", np.full_like(counts, 100), **WORDLESS)
    line = open_line(folder)
    expect_equal((line["counts"].values, counts), (float(line["dark_counts"].mean()), 100))
    # so does the user
    for said in ({"quantity": "counts"}, {}):
        assert open_line(folder, dark="none", **said)["counts"].shape == counts.shape


@pytest.mark.parametrize("said", [{}, {"quantity": "radiance"}])
def test_integers_with_units_of_radiance_are_no_counts(
    folder: Path, counts: np.ndarray[Any, Any], said: dict[str, Any]
) -> None:
    # Rationale: a vendor's radiance in integers opened as counts, and its units were of no account
    cube_of(folder, counts)
    said = {"radiance_units": "uW m-2 sr-1 nm-1", "dark": None, "calibration": None, **said}
    line = open_line(folder, **said, fwhm_nm=6.0)
    assert "counts" not in line
    assert line["radiance"].shape == (LINES, BANDS, counts.shape[2])
    np.testing.assert_allclose(line["radiance"].values[3, 1, 2], counts[3, 1, 2] * 1e-6, rtol=1e-6)


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
    expect_error(
        SchemaError,
        "dim-missing",
        lambda: hp.io.write_line_table(xr.Dataset({"a": ("x", [1.0])}), tmp_path / "lines.csv"),
    )
    path = hp.io.write_line_table(line_of({name: [0.0] * 3 for name in POSE}), tmp_path / "lines.csv")
    expect_error(
        StoreError,
        "overwrite=True",
        lambda: hp.io.write_line_table(line_of({name: [0.0] * 3 for name in POSE}), path),
    )
    assert [one.name for one in tmp_path.iterdir()] == ["lines.csv"]


# --- Settings, frame indices and dark cubes of a Headwall folder ---


def write(path: Path, text: str, newline: str = "\n") -> Path:
    path.write_bytes(text.replace("\n", newline).encode("latin-1"))
    return path


def index_of(frame: list[int], stamp: list[int] | None = None) -> FrameIndex:
    stamps = stamp or [7000 * number for number in frame]
    return FrameIndex("frameIndex.txt", np.array(frame), np.array(stamps), "instrument")


# --- settings ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
def test_settings_keep_every_pair(tmp_path: Path, newline: str) -> None:
    text = "Exposure (ms) = 5.5\nFrame Period (ms)=7\n\nOperator = a = b\nno pair\n"
    pairs = read_settings(write(tmp_path / "settings.txt", text, newline))
    assert pairs == {"Exposure (ms)": "5.5", "Frame Period (ms)": "7", "Operator": "a = b"}
    assert exposure_seconds(pairs, "settings.txt") == 0.0055


@pytest.mark.parametrize(
    ("pairs", "seconds"),
    [
        ({"Exposure (ms)": "5.0"}, 0.005),
        ({"  exposure   (us) ": "5000"}, 0.005),
        ({"Exposure Time (s)": "0.005"}, 0.005),
        ({"Integration (ms)": "12"}, 0.012),
        ({"Exposure": "5"}, None),
        ({"Exposure mode": "auto"}, None),
        ({}, None),
    ],
)
def test_exposure_with_its_unit(pairs: dict[str, str], seconds: float | None) -> None:
    assert exposure_seconds(pairs, "x") == seconds


@pytest.mark.parametrize(
    "pairs",
    [
        {"Exposure (ms)": "five"},
        {"Exposure (ms)": "-5"},
        {"Exposure (ms)": "0"},
        {"Exposure (ms)": "nan"},
        {"Exposure (nm)": "5"},
        {"Exposure (ms)": "5", "Exposure (us)": "6000"},
    ],
)
def test_exposure_that_is_none(pairs: dict[str, str]) -> None:
    expect_errors((FormatError, r"settings\.txt", lambda: exposure_seconds(pairs, "settings.txt")))


def test_settings_that_cannot_be_read(tmp_path: Path) -> None:
    expect_refusals(
        (FormatError, "file-unreadable", lambda: read_settings(tmp_path / "settings.txt")),
        (FormatError, "file-special", lambda: read_settings(tmp_path)),
    )


# --- frame index -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_frame_index_in_microseconds(tmp_path: Path, newline: str) -> None:
    index = read_frame_index(
        write(tmp_path / "frameIndex_458.txt", "Frame#\tTimestamp\n458\t10\n459\t7010\n461\t21010\n", newline)
    )
    assert (index.frame.tolist(), index.stamp.tolist()) == ([458, 459, 461], [10, 7010, 21010])
    assert (index.clock, index.fitted) == ("instrument", False)
    assert index.frame.dtype == index.stamp.dtype == np.int64


def test_frame_index_by_time_of_day_across_midnight(tmp_path: Path) -> None:
    text = "Frame#\tTime\n0\t23:59:59 993000\n1\t00:00:00 0\n2\t00:00:00 7000\n"
    index = read_frame_index(write(tmp_path / "f.txt", text))
    assert (index.clock, (index.stamp - 86_400_000_000).tolist()) == ("time of day", [-7000, 0, 7000])


def test_frame_index_in_whole_seconds_is_straightened(tmp_path: Path) -> None:
    frame = np.arange(100, 1100)
    true = 36_000_000_000 + 400_000 + 33_333 * (frame - 100)
    rows = "".join(
        f"{number} {second // 3600:02d}:{second // 60 % 60:02d}:{second % 60:02d}\n"
        for number, second in zip(frame, true // 1_000_000, strict=True)
    )
    index = read_frame_index(write(tmp_path / "f.txt", "Frame# Time\n" + rows))
    assert index.fitted
    assert np.abs(index.stamp - true).max() < 30_000
    assert (np.diff(index.stamp) > 0).all()


@pytest.mark.parametrize(
    ("text", "error", "match"),
    [
        ("Frame#\tTimestamp\n0\t5\n1\t5\n", TimeError, "line 3"),
        ("Frame#\tTimestamp\n0\t5\n1\t9\n2\t8\n3\t7\n", TimeError, "lines 4, 5"),
        ("Frame#\tTimestamp\n1\t5\n1\t6\n", FormatError, "line 3"),
        ("Frame#\tTimestamp\n-1\t5\n", FormatError, "line 2"),
        ("Frame#\tTimestamp\n0\n", FormatError, "line 2"),
        ("Frame#\tTimestamp\n0\t5.5\n", FormatError, "line 2"),
        ("Frame#\tTimestamp\n0\t1_000\n", FormatError, "line 2"),
        ("Frame#\tTimestamp\n0\t99999999999999999999\n", FormatError, "line 2"),
        ("Frame#\tTimestamp\n", FormatError, "no rows"),
        ("0\t5\n1\t6\n", FormatError, "header"),
        ("Frame#\n0\n", FormatError, "one column"),
        ("", FormatError, "header"),
        ("Frame#\tTime\n0\t25:00:00 1\n", FormatError, "line 2"),
        ("Frame#\tTimestamp\n0\t5\n\0\0", FormatError, "binary"),
        # whole seconds need a steady rate
        ("Frame#\tTime\n0\t10:00:00\n1\t10:00:00\n2\t10:00:01\n", TimeError, "frame-rate-unknown"),
        ("Frame#\tTime\n0\t10:00:00\n1\t10:00:01\n2\t10:00:02\n3\t10:00:30\n", TimeError, "steady"),
    ],
)
def test_damaged_frame_index(tmp_path: Path, text: str, error: type[Exception], match: str) -> None:
    expect_errors((error, match, lambda: read_frame_index(write(tmp_path / "f.txt", text))))


def test_trailing_tabs_and_blank_lines_are_no_cells_and_rows_are_bounded(tmp_path: Path) -> None:
    table = read_table(write(tmp_path / "t.txt", "a\tb\t\n1\t2\t\n\n3\t4\n"), "table", needs=["a"])
    assert (table.columns, table.rows.tolist()) == ({"a": ["1", "3"], "b": ["2", "4"]}, [2, 4])
    path = write(tmp_path / "long.txt", "a\tb\n" + "\n" * MAX_TABLE_ROWS)
    expect_errors((FormatError, "at most 2000000", lambda: read_table(path, "table", needs=["a"])))


# --- lines of a cube ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("rows", [1, 5, 40_000])
def test_a_regular_table_is_read_as_an_irregular_one(tmp_path: Path, rows: int) -> None:
    lines = [f"{row}\t{row % 7} x\t" for row in range(rows)]
    regular = read_table(write(tmp_path / "r.txt", "a\tb\tc\n" + "\n".join(lines)), "table", needs=["a"])
    # a tab too many in the last line, and a line of blanks
    text = "a\tb\tc\n" + "\n".join(lines) + "\t\n \t \n"
    other = read_table(write(tmp_path / "o.txt", text), "table", needs=["a"])
    assert dict(regular.columns) == dict(other.columns)
    np.testing.assert_array_equal(regular.rows, other.rows)
    np.testing.assert_array_equal(regular.rows, np.arange(2, rows + 2))


FLIGHT = [0, 1, 2, 3, 4, 6, 7, 8, 9]


@pytest.mark.parametrize(
    ("frames", "name", "lines", "expected"),
    [
        ([10, 11, 14], "cube", 3, [[10, 11, 14], [0, 1, 2]]),  # as many lines as rows
        ([10, 11, 14], "cube", 5, [[10, 11, 12, 13, 14], [0, 1, -1, -1, 2]]),  # as many lines as frames
        ([10, 11, 14], "cube", 4, None),
        ([5, 6, 7, 8], "short", 3, [[5, 6, 7], [0, 1, 2]]),  # cut short in flight
        ([5, 6, 8, 9], "short", 3, None),  # which frames are missing is unknown
        # cubes of a flight share its frame index
        (FLIGHT, "raw_0.hdr", 4, [[0, 1, 2, 3], [0, 1, 2, 3]]),
        (FLIGHT, "raw_4.hdr", 3, [[4, 6, 7], [4, 5, 6]]),  # only what was recorded
        (FLIGHT, "raw_4", 4, [[4, 5, 6, 7], [4, -1, 5, 6]]),  # with a blank line for the dropped frame
        (FLIGHT, "raw_8.hdr", 2, [[8, 9], [7, 8]]),
        (FLIGHT, "raw_4.hdr", 5, None),
    ],
)
def test_lines_of_a_cube_have_rows_of_its_index(
    frames: list[int], name: str, lines: int, expected: list[list[int]] | None, tmp_path: Path
) -> None:
    for number in (0, 4, 8):
        (tmp_path / f"raw_{number}.hdr").touch()

    def match() -> list[list[int]]:
        found = match_frames(index_of(frames), lines, tmp_path / name, shortened=name == "short")
        return [part.tolist() for part in found]

    if expected is None:
        expect_errors((FormatError, "frame-index-mismatch", match))
    else:
        assert match() == expected


# --- dark --------------------------------------------------------------------------------------------------


def test_sums_of_a_dark_cube_are_exact() -> None:
    counts = np.random.default_rng(1).integers(0, 65536, (75, 3, 4), dtype=np.uint16)
    frames = sum_dark(xr.DataArray(counts, dims=("along_track", "band", "cross_track")), "dark")
    np.testing.assert_array_equal(frames.total, counts.astype(object).sum(axis=0).astype(np.uint64))
    np.testing.assert_allclose(frames.mean, counts.mean(axis=0, dtype=np.float64), rtol=1e-15)
    np.testing.assert_allclose(frames.variance, counts.var(axis=0, ddof=1, dtype=np.float64), rtol=1e-12)


def test_sum_dark_refuses_what_is_no_raw_cube() -> None:
    for values, dims, match in (
        (np.full((2, 2, 2), 0.5, np.float32), CUBE, "float32"),
        (np.full((2, 2, 2), -1, np.int16), CUBE, "value-out-of-range"),
        (np.full((2, 2, 2), True), CUBE, "type-wrong"),
        (np.zeros((0, 2, 2), np.uint16), CUBE, "empty-input"),
        (np.zeros((2, 2), np.uint16), ("y", "x"), "expected"),
    ):
        expect_error(FormatError, match, partial(sum_dark, xr.DataArray(values, dims=dims), "dark"))


# --- dark references, against plain means of the frames ---------------------------------------------------


DARK_BANDS, SAMPLES = 3, 4
CUBE = ("along_track", "band", "cross_track")
PIXEL = ("band", "cross_track")
LINE = xr.DataArray(np.zeros((2, DARK_BANDS, SAMPLES), np.uint16), dims=CUBE)
NOON = np.datetime64("2024-06-01T12:00:00", "ns")


def frames(lines: int, seed: int = 0) -> np.ndarray[Any, Any]:
    return np.random.default_rng(seed).integers(10, 60, (lines, DARK_BANDS, SAMPLES)).astype(np.uint16)


def cube(
    counts: np.ndarray[Any, Any], second: int | None = None, exposure: float | None = None
) -> xr.Dataset:
    made = xr.Dataset({"counts": (CUBE, counts, {"units": "count"})})
    if second is not None:
        made = made.assign_coords(
            time=("along_track", np.full(len(counts), NOON + np.timedelta64(second, "s")))
        )
    if exposure is not None:
        made["exposure_time"] = ((), exposure, {"units": "s"})
    return made


def test_one_cube_is_the_mean_of_its_lines_and_their_spread() -> None:
    counts = frames(20)
    dark = open_dark(cube(counts, exposure=0.005), Timing(), None, LINE)
    assert (dark.counts.dims, dark.counts.dtype, dark.read_noise.dtype) == (PIXEL, np.float32, np.float32)
    np.testing.assert_allclose(dark.counts, counts.mean(axis=0, dtype="f8"), rtol=1e-6)
    variance = counts.var(axis=0, ddof=1, dtype="f8")
    np.testing.assert_allclose(dark.read_noise, np.sqrt(variance - 1 / 12), rtol=1e-6)
    np.testing.assert_allclose(dark.uncertainty, np.sqrt(variance / 20), rtol=1e-6)
    made = dark.variables(needs_noise=True)
    assert (float(made["dark_exposure_time"]), set(dark.variables(needs_noise=False))) == (
        0.005,
        {*("dark_counts", "dark_exposure_time", "dark_counts_u_random")},
    )


def test_few_lines_measure_no_noise_of_elements() -> None:
    counts = frames(15)
    dark = open_dark(cube(counts), Timing(), None, LINE)
    assert dark.read_noise is None
    # their mean is less sure than that of many, which must not be unsaid
    assert set(dark.variables(needs_noise=True)) == {"dark_counts", "dark_counts_u_random"}
    own = counts.var(axis=0, ddof=1, dtype="f8")
    np.testing.assert_allclose(dark.uncertainty, np.sqrt(((14 * own + 16 * own.mean()) / 30) / 15), rtol=1e-6)
    single = open_dark(cube(frames(1)), Timing(), None, LINE)
    assert set(single.variables(needs_noise=True)) == {"dark_counts"}


def test_cubes_of_known_times_stay_apart_and_others_are_averaged() -> None:
    late, early = frames(2, 1), frames(3, 2)
    dark = open_dark([cube(late, 60, 0.004), cube(early, 0, 0.005)], Timing(), None, LINE)
    assert dark.counts.dims == ("dark_time", *PIXEL)
    np.testing.assert_allclose(dark.counts[0], early.mean(axis=0, dtype="f8"), rtol=1e-6)
    np.testing.assert_allclose(dark.counts[1], late.mean(axis=0, dtype="f8"), rtol=1e-6)
    assert dark.counts["dark_time"].dtype == "datetime64[ns]"
    assert (dark.counts["dark_time"].values - NOON).astype("timedelta64[s]").astype(int).tolist() == [0, 60]
    assert dark.variables(needs_noise=False)["dark_exposure_time"].values.tolist() == [0.005, 0.004]
    # cubes of unknown times are averaged line by line
    one, two = frames(2, 1), frames(5, 2)
    dark = open_dark([cube(one), cube(two, 0)], Timing(), None, LINE)
    np.testing.assert_allclose(dark.counts, np.concatenate([one, two]).mean(axis=0, dtype="f8"), rtol=1e-6)
    assert "averaged" in dark.source


def test_none_the_calibrations_and_what_failed_to_open() -> None:
    none = open_dark(DARK_NONE, Timing(), None, LINE)
    assert none.counts.dtype == np.float32
    assert not none.counts.any()
    assert none.counts.attrs["dark"] == "none"
    calibration = xr.Dataset(
        {
            "dark_counts": (PIXEL, np.full((DARK_BANDS, SAMPLES), 12.5), {"units": "count"}),
            "dark_exposure_time": ((), 5.0, {"units": "ms"}),
        }
    )
    given = open_dark("calibration", Timing(), calibration, LINE)
    assert (given.counts == 12.5).all()
    assert (given.counts.dtype, given.exposures) == (np.float32, (0.005,))
    # a cube or calibration that failed to open is not reported again
    assert (
        open_dark(DARK_NONE, Timing(), None, None) is open_dark("calibration", Timing(), None, LINE) is None
    )


HOLLOW = {"dark_counts": (PIXEL, np.full((DARK_BANDS, SAMPLES), np.nan), {"units": "count"})}


@pytest.mark.parametrize(
    ("source", "columns", "error", "match"),
    [
        *((missing, SAMPLES, SchemaError, "dark-missing") for missing in (None, [], ())),
        ([cube(frames(2), exposure=0.005), cube(frames(2))], SAMPLES, SchemaError,
         r"5 ms.*unknown.*exposure-conflict"),
        (cube(frames(2)), 5, SchemaError, "grid-mismatch"),
        (xr.Dataset({"radiance": (CUBE, np.ones(LINE.shape, np.float32))}), SAMPLES, FormatError,
         "counts-missing"),
        (xr.Dataset(HOLLOW), SAMPLES, SchemaError, "not-finite"),
    ],
)  # fmt: skip
def test_what_is_no_dark(source: Any, columns: int, error: Any, match: str) -> None:
    expect_error(
        error,
        match,
        lambda: open_dark(
            source, Timing(), None, xr.DataArray(np.zeros((2, DARK_BANDS, columns), np.uint16), dims=CUBE)
        ),
    )
