"""``collect.toml``, the tree it opens, and the lines that its cubes make."""

import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from support.files import write_file
from support.refusals import expect_equal, expect_error, expect_errors, expect_refusals

import hyperpaint as hp
from hyperpaint.base.errors import CollectError, FormatError, PaintWarning
from hyperpaint.io.collect.collect_toml import join_lines, read_collect
from hyperpaint.io.envi.envi_cubes import EnviArray, parse_header
from hyperpaint.io.flightline.flightline_opening import Timing
from hyperpaint.io.spectrometers.asd import open_asd
from hyperpaint.io.spectrometers.irradiance import open_irradiance
from hyperpaint.simulation.collect import simulate_collect
from hyperpaint.workflows.pipeline import run

LINES = 60


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate_collect(
        tmp_path_factory.mktemp("collect"),
        scene="plan",
        lines=LINES,
        bands=6,
        columns=5,
        cubes=2,
        dropped=[7, 8, 40],
        dark_frames=20,
        noise=False,
    ).parent


@pytest.fixture
def folder(simulated: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(simulated, tmp_path / "collect"))


def change(folder: Path, *pairs: tuple[str, str], end: str = "") -> Path:
    path = folder / "collect.toml"
    text = path.read_text()
    for old, new in pairs:
        assert re.search(old, text, re.MULTILINE), old
        text = re.sub(old, new, text, flags=re.MULTILINE)
    path.write_text(text + end)
    return path


def problems_of(path: Path, *, opened: bool = False, **options: Any) -> str:
    caught = expect_error(
        CollectError, None, lambda: (hp.open_collect if opened else read_collect)(path, **options)
    )
    return str(caught)


# --- what is right -----------------------------------------------------------------------------------------


def test_the_frame_index_and_the_navigation_beside_a_cube_are_found(folder: Path) -> None:
    expected = hp.open_collect(folder / "collect.toml")["flightlines/raw_0"].to_dataset()
    path = change(folder, (r"^frame_index = .*\n", ""), (r"^nav = .*\n", ""))
    xr.testing.assert_identical(hp.open_collect(path)["flightlines/raw_0"].to_dataset(), expected)
    for name in ("frameIndex_0.txt", "imu_gps.txt"):
        (folder / "flight" / name).unlink()
    assert "[[flightlines]] 1 no line times: found frame_period_ms" in problems_of(path)


def test_patterns_may_begin_outside_the_folder(folder: Path) -> None:
    expected = hp.open_collect(folder / "collect.toml")["irradiance"].to_dataset()
    shutil.move(folder / "asd", folder.parent / "asd_elsewhere")
    for pattern in ("../asd_elsewhere/*.asd", f"{folder.parent}/asd_elsewhere/*.asd"):
        path = change(folder, (r'^files = ".*asd\w*/\*\.asd"\nquantity', f'files = "{pattern}"\nquantity'))
        xr.testing.assert_identical(hp.open_collect(path)["irradiance"].to_dataset(), expected)


def test_what_the_file_says(folder: Path) -> None:
    path = change(
        folder,
        (r"^stamp = .*\n\n\[cal", 'stamp = "mid"\nclock_offset_s = 1.5\ntime_scale = "gps"\n\n[cal'),
        (r'(id = "raw_0")', r"\1\nexposure_time_ms = 4"),
        end='\n[[references]]\ninstrument = "asd_sky"\nfiles = ["asd/sky00000.asd", "asd/sky0000[12].asd"]\n',
    )
    collect = read_collect(path)
    assert (collect.name, collect.clock.stamp, collect.clock.clock_offset_s, collect.clock.time_scale) == (
        "simulated car park",
        "mid",
        1.5,
        "gps",
    )
    assert collect.calibration == folder / "calibration.zarr"
    assert [line.name for line in collect.flightlines] == ["raw_0", "raw_30"]
    assert [line.exposure_time for line in collect.flightlines] == [0.004, 0.005]
    assert collect.nav == (folder / "flight" / "imu_gps.txt",)
    for line in collect.flightlines:
        assert line.dark == (folder / "dark" / "raw_0.hdr",)
        assert isinstance(line.timing, Timing)
        assert (line.timing.stamp, line.timing.frame_period, line.timing.nav) == ("mid", 0.007, *collect.nav)
    assert collect.irradiance is not None
    assert collect.irradiance.files == tuple(sorted((folder / "asd").glob("*.asd")))
    assert collect.irradiance.options == {
        "quantity": "irradiance", "utc_offset_h": -5.0, "clock_offset_s": 37.25,
        "stamp": "end", "fwhm_nm": 3.0,
    }  # fmt: skip
    assert [file.name for file in collect.references[-1].files] == [f"sky0000{i}.asd" for i in range(3)]


@pytest.mark.parametrize("said", ['dark = "none"\n', "[dark]\ncubes = 'none'\n"])
def test_no_dark_is_said_in_either_way(folder: Path, said: str) -> None:
    path = change(folder, (r"^\[dark\]\ncubes = .*\n", ""))
    text = path.read_text()
    path.write_text(said + text if said.startswith("dark") else text + said)
    assert {line.dark for line in read_collect(path).flightlines} == {"none"}
    assert (hp.open_collect(path)["flightlines/raw_0/dark_counts"] == 0).all()


def test_the_tree_holds_every_line_and_nothing_at_its_root(folder: Path) -> None:
    tree = hp.open_collect(folder / "collect.toml")
    assert tree.to_dataset().sizes == {}
    assert not tree.to_dataset().variables
    assert set(tree["flightlines"].children) == {"raw_0", "raw_30"}
    truth = xr.open_zarr(folder / "truth.zarr")
    for name, first in (("raw_0", 0), ("raw_30", 30)):
        line = tree[f"flightlines/{name}"].to_dataset()
        frame = line["frame"].values
        assert frame[0] == first
        assert not set(frame.tolist()) & {7, 8, 40}
        apart = np.abs(line["time"].values - truth["time"].isel(along_track=frame).values).max()
        assert apart <= np.timedelta64(1, "us")
        assert line.attrs["collect"] == "simulated car park"
        assert "irradiance" in line
    assert tree["irradiance"]["irradiance"].ndim == 2
    assert tree["calibration"]["radiance_gain"].shape == (6, 5)
    assert float(tree["flightlines/raw_0"].attrs["dropped_frames"]) == 2


def test_no_cube_is_read(folder: Path, monkeypatch: pytest.MonkeyPatch, no_compute: Any) -> None:
    (folder / "dark" / "raw_0").rename(folder / "dark" / "kept")
    path = change(folder, (r"^\[dark\]\ncubes = .*\n", "[dark]\ncubes = 'none'\n"))

    def refuse(self: EnviArray, key: Any) -> None:
        pytest.fail("a cube was read")

    monkeypatch.setattr(EnviArray, "__getitem__", refuse)
    with no_compute():
        tree = hp.open_collect(path)
    assert tree["flightlines/raw_0/counts"].chunks is not None


def test_navigation_shared_by_the_cubes_is_read_once(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from hyperpaint.io.collect import collect_toml as collect

    read: list[Path] = []
    original = collect.read_imu_gps

    def count(path: Path, *arguments: Any) -> Any:
        read.append(path)
        return original(path, *arguments)

    monkeypatch.setattr(collect, "read_imu_gps", count)
    hp.open_collect(folder / "collect.toml")
    assert read == [folder / "flight" / "imu_gps.txt"]


def test_the_clock_of_the_navigation_is_corrected(folder: Path) -> None:
    before = hp.open_collect(folder / "collect.toml")["flightlines/raw_0/time"].values
    path = change(folder, (r"^bit_depth", 'clock_offset_s = 20.5\ntime_scale = "gps"\nbit_depth'))
    after = hp.open_collect(path)["flightlines/raw_0/time"].values
    assert np.unique(after - before).tolist() == [np.timedelta64(2_500_000_000, "ns").astype(int)]


def test_lines_without_side_files_start_at_a_time(folder: Path) -> None:
    path = change(
        folder,
        (r"^frame_index = .*raw_0.*\n|^frame_index = .*_0.*\n", "start_time = 2021-07-20T12:10:00-05:00\n"),
        (r"^nav = .*\n", ""),
        (r"^frame_index = .*_30.*\n", 'start_time = "2021-07-20T17:10:00.210Z"\n'),
    )
    tree = hp.open_collect(path)
    assert tree["flightlines/raw_0/time"].values[0] == np.datetime64("2021-07-20T17:09:59.997500000")
    assert "latitude" not in tree["flightlines/raw_0"].to_dataset()


def test_radiance_needs_no_irradiance(folder: Path) -> None:
    path = change(folder, (r"^\[irradiance\]\n(.+\n)+", ""))
    assert "no [irradiance]" in problems_of(path)
    tree = hp.open_collect(path, need_irradiance=False)
    assert "irradiance" not in tree.children
    assert "irradiance" not in tree["flightlines/raw_0"].to_dataset()


# --- what is wrong -----------------------------------------------------------------------------------------


def test_every_problem_of_the_file_is_listed(folder: Path) -> None:
    path = change(
        folder,
        (r"^exposure_time_ms = .*", "exposure_time_ms = -5.0\nexposure_ms = 5"),
        (r"^bit_depth = .*", "bit_depth = 'twelve'"),
        (r'^path = "calibration.zarr"', 'path = "nowhere.zarr"'),
        (r'^files = "asd/\*.asd"', 'files = "asd/*.csv"'),
        (r'^id = "raw_30"', 'id = "raw_0"'),
        (r'^cube = "flight/raw_0.hdr"', 'cube = "flight/raw_1.hdr"'),
        (r"^\[collect\]", "[colect]"),
        end='\n[[flightlines]]\nid = "../escape"\ncube = "flight/raw_0.hdr"\n\n[[references]]\nfiles = 3\n',
    )
    text = problems_of(path)
    for part in (
        "[camera] exposure_time_ms = -5.0, expected a number above 0",
        "[camera] unknown key 'exposure_ms'; did you mean 'exposure_time_ms'?",
        "[camera] bit_depth = 'twelve', expected a whole number from 1 to 16",
        "[calibration] path = 'nowhere.zarr': no such file",
        "[irradiance] files = 'asd/*.csv' matches no file",
        "[[flightlines]] 1 cube = 'flight/raw_1.hdr': no such file",
        "unknown table or key 'colect'; did you mean 'collect'?",
        "[[flightlines]] 3 id = '../escape'",
        "[[references]] 3 instrument is missing",
        "[[references]] 3 files = 3, expected a text or a list of texts",
    ):
        assert part in text, part


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        (r"^\[calibration\]\npath = .*\n", "", "no calibration"),
        (r"^path = .*", 'sweep = "lab.zarr"', "[calibration] sweep = 'lab.zarr': no such file"),
        (r"^path = .*", "", "[calibration] path is missing"),
        (r"^\[dark\]\ncubes = .*\n", "", 'dark="none"'),
        (r"^cube = .*raw_0.*\n", "", "[[flightlines]] 1 cube is missing"),
        (
            r"^stamp = .*\n\n\[cal",
            'stamp = "begin"\n\n[cal',
            "one of start, mid, end; leave the key out",
        ),
        (r"^nav = .*\n", "", "line-times-missing"),
        (r"^nav = .*\n", "start_time = 2021-07-20T12:10:00\n", "no zone"),
        (r"^nav = .*\n", 'date = "2021-07-20"\n', "clock-offset-missing"),
        (r"^utc_offset_h = .*", "utc_offset_h = nan", "expected a number"),
        (r"^utc_offset_h = .*", "utc_offset_h = true", "expected a number"),
        (r"^\[camera\]", "[[camera]]", "'camera' is"),
        (r"^\[\[flightlines\]\]", "[[lines]]", "no [[flightlines]]"),
        (r"^cubes = .*", "cubes = []", "expected a text or a list of texts"),
        # ids are names of groups; some systems ignore case
        (r'^id = "raw_30"', 'id = "RAW_0"', "2 lines have the id 'raw_0'"),
        *(
            (r'^id = "raw_30"', f'id = "{name}"', "[[flightlines]] 2 id = ")
            for name in ("", "a/b", "..", ".hidden", "zarr.json", "c", "a b", "x" * 200)
        ),
    ],
)
def test_one_problem_at_a_time(folder: Path, old: str, new: str, expected: str) -> None:
    # the lines are opened only where the file itself shows no problem
    opened = expected in ("no calibration", 'dark="none"')
    assert expected in problems_of(change(folder, (old, new)), opened=opened)


def test_the_place_of_a_mistake_in_the_toml_is_told(folder: Path) -> None:
    assert "line 7" in problems_of(change(folder, (r"^bit_depth = .*", "bit_depth = = 12")))
    for content in (b"\xff\xfe", b"a = " + b"[" * 10_000):
        (folder / "collect.toml").write_bytes(content)
        assert "not TOML" in problems_of(folder / "collect.toml")
    assert "cannot be read" in problems_of(folder / "none.toml")


def test_problems_of_all_files_come_in_one_message(folder: Path) -> None:
    with (folder / "flight" / "raw_0").open("ab") as file:
        file.write(b"123")
    (folder / "flight" / "frameIndex_30.txt").write_text("Frame#\tTimestamp\n30\t5\n31\t5\n")
    xr.open_zarr(folder / "calibration.zarr").load().isel(band=slice(5)).to_zarr(
        folder / "fewer.zarr", consolidated=False, zarr_format=3
    )
    path = change(
        folder, (r"calibration.zarr", "fewer.zarr"), (r"^exposure_time_ms = .*", "exposure_time_ms = -1")
    )
    text = problems_of(path, opened=True)
    assert "exposure_time_ms = -1, expected a number above 0" in text
    assert "the file is 3 bytes longer than its header says" in text
    assert "6 bands x 5 columns, the calibration 5 bands x 5 columns" in text
    assert "repeats or decreases in line 3" in text


def test_one_problem_shared_by_the_lines_is_said_once(folder: Path) -> None:
    (folder / "flight" / "imu_gps.txt").write_text("nothing")
    text = problems_of(folder / "collect.toml", opened=True)
    assert text.count("header-wrong") == 1
    assert "no line times" not in text


# --- `[[references]]` of a collect: opened with it, kept in its store, and named where they cannot be ------


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("references")
    return hp.simulate_collect(folder, scene="plan", lines=8, bands=6, columns=6, truth=False).parent


@pytest.fixture
def collect(source: Path, tmp_path: Path) -> Path:
    return shutil.copytree(source, tmp_path / "raw") / "collect.toml"


def test_references_are_opened_by_what_they_are(collect: Path) -> None:
    tree = hp.open_collect(collect)
    for name, opened in {"svc": hp.open_svc, "asd": hp.open_asd}.items():
        folder = collect.parent / {"svc": "svc", "asd": "asd_reflectance"}[name]
        assert tree[f"references/{name}"].to_dataset().identical(opened(folder))


def test_a_table_of_any_program_may_be_a_reference(collect: Path) -> None:
    # Rationale: the first heading 'Wavelength' made it an export of ASD, whose quantity is unknown.
    (collect.parent / "red.csv").write_text("Wavelength,red\n400,0.2\n500,0.3\n600,0.4\n")
    collect.write_text(f'{collect.read_text()}\n[[references]]\ninstrument = "red"\nfiles = "red.csv"\n')
    opened = hp.open_collect(collect)["references/red"]
    assert opened["signature"].values.tolist() == ["red"]


def test_a_damaged_reference_is_an_error_that_names_it(collect: Path) -> None:
    (collect.parent / "svc" / "red.sig").write_text("/*** Spectra Vista SIG Data ***/\nunits= ?\n")
    (collect.parent / "asd_reflectance" / "blue.asd").write_bytes(b"as7")
    error = expect_error(CollectError, "cannot be processed", lambda: hp.open_collect(collect))
    assert "red.sig" in str(error)
    assert "blue.asd" in str(error)


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('instrument = "svc"', 'instrument = "../svc"', "instrument = '../svc', expected letters"),
        ('instrument = "svc"', 'instrument = ""', "instrument = '', expected a text"),
        ('instrument = "svc"', 'instrument = "ASD"', "'asd' has another table"),
        ('files = "svc/*.sig"', 'files = ["svc/red.sig", "asd_reflectance/red.asd"]', "instrument-mixed"),
    ],
)
def test_instruments_name_groups_of_one_kind(collect: Path, old: str, new: str, told: str) -> None:
    collect.write_text(collect.read_text().replace(old, new))
    expect_errors((CollectError, re.escape(told), lambda: hp.open_collect(collect)))


def test_an_instrument_may_be_called_by_its_model(collect: Path) -> None:
    collect.write_text(collect.read_text().replace('instrument = "svc"', 'instrument = "SVC HR-1024i"'))
    opened = hp.open_collect(collect)["references/SVC_HR-1024i"].to_dataset()
    assert (opened.attrs["instrument_name"], opened.attrs["instrument"]) == ("SVC HR-1024i", "SVC")
    collect.write_text(collect.read_text().replace('instrument = "asd"', 'instrument = "svc_hr-1024i"'))
    expect_refusals((CollectError, "name-duplicate", "'svc_hr-1024i'", lambda: hp.open_collect(collect)))


@pytest.mark.slow
def test_another_reference_is_other_input(collect: Path, tmp_path: Path) -> None:
    # Texts count by what they say: a store is the same in another process, and differs by a name
    out = tmp_path / "lot.zarr"
    assert set(run(collect, out).written) >= {"references/svc", "references/asd"}
    assert run(collect, out).written == ()
    (collect.parent / "svc" / "red.sig").rename(collect.parent / "svc" / "crimson.sig")
    expect_refusals(
        (hp.StoreError, "store-exists", "/references/svc", "other inputs", lambda: run(collect, out))
    )
    assert run(collect, out, overwrite=True).written == ("references/svc",)
    assert "crimson" in hp.open_store(out, "references/svc")["spectrum"].values.tolist()
    assert hp.verify(out).ok


# --- inputs that the fault campaigns found: each once left its parser in a wrong way -----------------------


@pytest.mark.parametrize(
    ("pattern", "match"),
    [
        # RecursionError from glob (a level a folder); with many '**' the time multiplies
        ("*/" * 3000, "pattern-invalid"),
        ("**/" * 30 + "*.txt", "file-not-found"),
        ("[" * 5000, "pattern-invalid"),
        # a pipe was left out, and with it a spectrum of the sky, without a word
        ("*.asd", r"sky\.asd .*file-special"),
    ],
)
def test_globs_that_recurse_or_never_end_or_match_a_pipe(pattern: str, match: str, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "sky.asd")
    (tmp_path / "sky_1.asd").touch()
    path = write_file(tmp_path / "collect.toml", f'[irradiance]\nfiles = "{pattern}"\n')
    expect_errors((CollectError, match, lambda: read_collect(path)))


@pytest.mark.parametrize("number", ["9" * 400, "-" + "9" * 400, "0x" + "f" * 5000, "[0x" + "f" * 5000 + "]"])
def test_whole_numbers_beyond_float64(number: str, tmp_path: Path) -> None:
    # OverflowError: int too large to convert to float; ValueError where it is printed
    path = write_file(tmp_path / "collect.toml", f"[camera]\nexposure_time_ms = {number}\n")
    error = expect_error(CollectError, None, lambda: read_collect(path))
    assert error.codes[0] == ("type-wrong" if number.startswith("[") else "not-finite")
    assert "exposure_time_ms" in error.problems[0].found


@pytest.mark.parametrize("cell", ["1e39", "-1e300", "1.7e308"])
def test_irradiance_beyond_float32(cell: str, tmp_path: Path) -> None:
    # RuntimeWarning: overflow encountered in cast, and inf in the series
    path = tmp_path / "sky.csv"
    rows = "2024-05-21T12:00:00Z,0.9,0.9,0.9\n" + f"2024-05-21T12:00:02Z,0.9,{cell},0.9\n"
    path.write_text(f"# units: kW m-2 nm-1\n# fwhm_nm: 3\ntime,500,600,700\n{rows}")
    expect_refusals((FormatError, "value-out-of-range", "sky.csv:5", lambda: open_irradiance(path)))


def test_asd_product_beyond_float64(write_asd: Callable[..., Path]) -> None:
    # RuntimeWarning: overflow encountered in multiply
    damaged = np.full(11, 1000.0)
    damaged[4] = 1e300
    blocks: dict[int, Any] = {2: (136, np.full(11, 1e10)), 3: (136, np.full(11, 1.0))}
    path = write_asd("sky.asd", damaged, data_type=7, blocks=blocks, utc_offset_h=0.0)
    with pytest.warns(PaintWarning, match="not finite"):
        opened = open_asd(path, "irradiance", utc_offset_h=0.0)
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(opened.irradiance.values[0])), [4])


@pytest.mark.parametrize(
    "lists", ["wavelength = {1e305, 2e305}", "wavelength = {0.4, 0.5}\nfwhm = {1, 1e306}"]
)
def test_wavelengths_beyond_float64(lists: str) -> None:
    # RuntimeWarning: overflow encountered in multiply
    head = "ENVI\nsamples = 1\nlines = 1\nbands = 2\ndata type = 12\ninterleave = bil\nbyte order = 0\n"
    expect_error(
        FormatError,
        "not-finite",
        lambda: parse_header(f"{head}wavelength units = Meters\n{lists}\n", "cube.hdr"),
    )


# --- Cubes of one flight: one line where the recording goes on, else lines of their own, with the reason ---

CAMERA = {"scene": "plan", "lines": 60, "bands": 8, "columns": 6, "seed": 4, "truth": False}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> xr.Dataset:
    # The line of one cube
    path = hp.simulate_collect(tmp_path_factory.mktemp("whole"), **CAMERA)
    return hp.open_collect(path)["flightlines/raw_0"].to_dataset()


@pytest.fixture(scope="module")
def cut(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # The same flight cut into five cubes; its ``collect.toml`` with one table for all
    path = hp.simulate_collect(tmp_path_factory.mktemp("cut"), cubes=5, **CAMERA)
    return with_lines(path, 'cube = "flight/raw_*.hdr"')


@pytest.fixture
def copied(cut: Path, tmp_path: Path) -> Path:
    return shutil.copytree(cut.parent, tmp_path / "raw") / cut.name


def with_lines(path: Path, *tables: str) -> Path:
    # Replace the tables [[flightlines]] of a collect
    text = re.sub(r"\[\[flightlines\]\][^\[]*", "", path.read_text(encoding="utf-8"))
    text += "".join(f"\n[[flightlines]]\n{table}\n" for table in tables)
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("cubes", ['"flight/raw_*.hdr"', '"flight"', '"flight/"'])
def test_a_flight_that_goes_on_is_one_line(whole: xr.Dataset, copied: Path, cubes: str) -> None:
    lines = hp.open_collect(with_lines(copied, f"cube = {cubes}"))["flightlines"]
    assert set(lines.children) == {"raw_0"}
    line = lines["raw_0"].to_dataset()
    assert line.attrs["source"] == "raw_0.hdr, raw_12.hdr, raw_24.hdr, raw_36.hdr, raw_48.hdr"
    xr.testing.assert_identical(line.drop_attrs(), whole.drop_attrs())
    np.testing.assert_array_equal(
        line.paint.reflectance()["reflectance"].values, whole.paint.reflectance()["reflectance"].values
    )


@pytest.mark.parametrize(
    ("tables", "names"),
    [
        (['id = "north"\ncube = "flight/raw_*.hdr"'], {"north"}),
        (['cube = "flight/raw_0.hdr"', 'cube = "flight/raw_12.hdr"'], {"raw_0", "raw_12"}),
    ],
)
def test_a_table_makes_a_line_of_its_name(copied: Path, tables: list[str], names: set[str]) -> None:
    assert set(hp.open_collect(with_lines(copied, *tables))["flightlines"].children) == names


def test_a_cube_that_is_missing_makes_two_lines_and_says_why(copied: Path) -> None:
    for name in ("raw_24", "raw_24.hdr", "frameIndex_24.txt"):
        (copied.parent / "flight" / name).unlink()
    with pytest.warns(hp.errors.PaintWarning, match=r"raw_36 .*recording-interrupted"):
        lines = hp.open_collect(copied)["flightlines"]
    assert {name: line.sizes["along_track"] for name, line in lines.children.items()} == {
        "raw_0": 24,
        "raw_36": 24,
    }


def test_a_store_of_joined_cubes_is_the_store_of_one(cut: Path, whole: xr.Dataset, tmp_path: Path) -> None:
    store = hp.process(cut, tmp_path / "lot.zarr")
    line = xr.open_zarr(store, group="flightlines/raw_0")
    np.testing.assert_array_equal(line["counts"].values, whole["counts"].values)
    assert hp.process(cut, tmp_path / "lot.zarr") == store  # nothing to do


def test_blank_lines_of_lost_frames_do_not_part_a_flight(tmp_path: Path) -> None:
    # They have no time: the period is that of the lines that have one, and blank ones take a period each
    tree = hp.open_collect(hp.simulate_collect(tmp_path, cubes=3, **CAMERA))["flightlines"]
    lines = {name: tree[name].to_dataset() for name in ("raw_0", "raw_20", "raw_40")}
    for name, lost in (("raw_0", [5, 17, 18, 19]), ("raw_20", [0, 1, 2])):
        times = lines[name]["time"].values.copy()
        times[lost] = np.datetime64("NaT", "ns")
        lines[name] = lines[name].assign_coords(time=lines[name]["time"].copy(data=times))
    ((flown, cubes, _),) = join_lines(lines, None)
    assert cubes == ("raw_0", "raw_20", "raw_40")
    assert int(np.isnat(flown["time"].values).sum()) == 7
    # a pause is one all the same
    lines["raw_20"] = lines["raw_20"].assign_coords(time=lines["raw_20"]["time"] + np.timedelta64(1, "s"))
    assert next(len(cubes) for _, cubes, _ in join_lines(lines, None)) == 1


DAY = 'id = "day"\n'


@pytest.mark.parametrize(
    ("tables", "problem"),
    [
        ([DAY + 'cube = "flight/raw_[01]*.hdr"', DAY + 'cube = "flight/raw_[34]*.hdr"'], "the id 'day'"),
        ([DAY + 'cube = "flight/raw_[01]*.hdr"', DAY + 'cube = "flight/raw_48.hdr"'], "the id 'day'"),
        ([DAY + 'cube = "flight"', 'id = "Day"\ncube = "flight/raw_[01]*.hdr"'], "the id 'day'"),
        (['id = "a/b"\ncube = "flight/raw_*.hdr"'], "id = 'a/b', expected letters"),
        (['id = "c"\ncube = "flight"'], "id = 'c', expected letters"),
        (['cube = "flight/raw_*.hdr"', 'cube = "flight/raw_1*.hdr"'], "the id 'raw_12'"),
    ],
)  # fmt: skip
def test_no_line_takes_the_place_of_another(copied: Path, tables: list[str], problem: str) -> None:
    path = with_lines(copied, *tables)
    error = expect_error(hp.errors.PaintError, re.escape(problem), lambda: hp.open_collect(path))
    assert str(error).count("expected letters") <= 1


def test_flights_of_one_day_may_have_cubes_of_the_same_names(copied: Path) -> None:
    (shutil.copytree(copied.parent / "flight", copied.parent / "second") / "raw_24.hdr").unlink()
    tables = ['id = "one"\ncube = "flight"', 'id = "two"\ncube = "second/raw_*.hdr"']
    with pytest.warns(hp.errors.PaintWarning, match=r"two_raw_36 .*recording-interrupted"):
        lines = hp.open_collect(with_lines(copied, *tables))["flightlines"]
    assert {name: line.sizes["along_track"] for name, line in lines.children.items()} == {
        "one": 60, "two_raw_0": 24, "two_raw_36": 24,
    }  # fmt: skip
    # regions of a line name it
    assert {line.attrs["name"] for line in lines.children.values()} == set(lines.children)


def test_a_frame_lost_between_two_cubes_is_a_blank_line_as_within_one(
    tmp_path: Path, whole: xr.Dataset
) -> None:
    # Against the flight in one cube, which lost the same frame
    path = hp.simulate_collect(tmp_path, cubes=3, **CAMERA)
    folder = path.parent / "flight"
    header = (folder / "raw_20.hdr").read_text(encoding="utf-8")
    raw = (folder / "raw_20").read_bytes()
    (folder / "raw_21").write_bytes(raw[len(raw) // 20 :])
    (folder / "raw_21.hdr").write_text(re.sub(r"lines\s*=\s*20", "lines = 19", header), encoding="utf-8")
    title, _, *rows = (folder / "frameIndex_20.txt").read_text(encoding="utf-8").splitlines(keepends=True)
    (folder / "frameIndex_21.txt").write_text("".join([title, *rows]), encoding="utf-8")
    for name in ("raw_20", "raw_20.hdr", "frameIndex_20.txt"):
        (folder / name).unlink()
    (line,) = hp.open_collect(with_lines(path, 'cube = "flight"'))["flightlines"].children.values()
    assert (line.attrs["dropped_frames"], line.sizes["along_track"]) == (1, 60)
    np.testing.assert_array_equal(line["along_track"], np.arange(60))
    np.testing.assert_array_equal(line["frame"], whole["frame"])
    there = np.arange(60) != 20
    assert (line["counts"].values[20] == 65535).all()
    for name in ("time", "latitude", "roll"):
        assert pd.isna(line[name].values[20])
    for name in ("counts", "time", "latitude", "roll"):
        np.testing.assert_array_equal(line[name].values[there], whole[name].values[there])
        assert line[name].dtype == whole[name].dtype
    # as without a loss: in the tasks of the first cube
    assert line["counts"].chunks == ((20, 20, 20), (8,), (6,))
    # without numbers that count on, time says it
    tree = hp.open_collect(with_lines(path, *(f'cube = "flight/raw_{n}.hdr"' for n in (0, 21, 40))))
    own = {name: child.to_dataset() for name, child in tree["flightlines"].children.items()}
    own = {name: each.assign_coords(frame=each.frame - each.frame[0]) for name, each in own.items()}
    ((joined, *_),) = join_lines(own, None)
    expect_equal((joined.attrs["dropped_frames"], 1), (np.isnat(joined["time"].values), ~there))
