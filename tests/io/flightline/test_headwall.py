"""Settings, frame indices and dark cubes of a Headwall folder."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_errors, expect_refusals

from hyperpaint.base.errors import FormatError, SchemaError, TimeError
from hyperpaint.io.envi.envi_cubes import open_envi
from hyperpaint.io.files.reading import MAX_TABLE_ROWS, read_table
from hyperpaint.io.flightline.flightline_opening import DARK_NONE, Timing, open_dark
from hyperpaint.io.flightline.side_files import (
    FrameIndex,
    exposure_seconds,
    match_frames,
    read_frame_index,
    read_settings,
    sum_dark,
)


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
        with pytest.raises(FormatError, match=match):
            sum_dark(xr.DataArray(values, dims=dims), "dark")


@pytest.mark.real_data
def test_the_real_headwall_dark_cube(shared_data: Path) -> None:
    frames = sum_dark(open_envi(shared_data / "envi_cube" / "darkReference")["counts"], "darkReference")
    assert frames.lines == 1
    assert frames.mean.shape == (978, 1600)
    assert frames.mean.mean() == pytest.approx(13.97111260, abs=5e-9)
    assert (frames.mean.min(), frames.mean.max()) == (2, 47)


# --- dark references, against plain means of the frames ---------------------------------------------------


BANDS, COLUMNS = 3, 4
CUBE = ("along_track", "band", "cross_track")
ELEMENT = ("band", "cross_track")
LINE = xr.DataArray(np.zeros((2, BANDS, COLUMNS), np.uint16), dims=CUBE)
NOON = np.datetime64("2024-06-01T12:00:00", "ns")


def frames(lines: int, seed: int = 0) -> np.ndarray[Any, Any]:
    return np.random.default_rng(seed).integers(10, 60, (lines, BANDS, COLUMNS)).astype(np.uint16)


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
    assert (dark.counts.dims, dark.counts.dtype, dark.read_noise.dtype) == (ELEMENT, np.float32, np.float32)
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
    assert dark.counts.dims == ("dark_time", *ELEMENT)
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
            "dark_counts": (ELEMENT, np.full((BANDS, COLUMNS), 12.5), {"units": "count"}),
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


HOLLOW = {"dark_counts": (ELEMENT, np.full((BANDS, COLUMNS), np.nan), {"units": "count"})}


@pytest.mark.parametrize(
    ("source", "columns", "error", "match"),
    [
        *((missing, COLUMNS, SchemaError, "dark-missing") for missing in (None, [], ())),
        ([cube(frames(2), exposure=0.005), cube(frames(2))], COLUMNS, SchemaError,
         r"5 ms.*unknown.*exposure-conflict"),
        (cube(frames(2)), 5, SchemaError, "grid-mismatch"),
        (xr.Dataset({"radiance": (CUBE, np.ones((2, BANDS, COLUMNS), np.float32))}), COLUMNS, FormatError,
         "counts-missing"),
        (xr.Dataset(HOLLOW), COLUMNS, SchemaError, "not-finite"),
    ],
)  # fmt: skip
def test_what_is_no_dark(source: Any, columns: int, error: Any, match: str) -> None:
    with pytest.raises(error, match=match):
        open_dark(source, Timing(), None, xr.DataArray(np.zeros((2, BANDS, columns), np.uint16), dims=CUBE))
