"""Cubes of one flight: one line where the recording goes on, else lines of their own, with the reason."""

import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from support.refusals import expect_equal

import hyperpaint as hp
from hyperpaint.io.collect.collect_toml import join_lines

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


def with_lines(path: Path, *tables: str) -> Path:
    # Replace the tables [[flightlines]] of a collect
    text = re.sub(r"\[\[flightlines\]\][^\[]*", "", path.read_text(encoding="utf-8"))
    text += "".join(f"\n[[flightlines]]\n{table}\n" for table in tables)
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("cubes", ['"flight/raw_*.hdr"', '"flight"', '"flight/"'])
def test_a_flight_that_goes_on_is_one_line(whole: xr.Dataset, cut: Path, tmp_path: Path, cubes: str) -> None:
    shutil.copytree(cut.parent, tmp_path / "raw")
    lines = hp.open_collect(with_lines(tmp_path / "raw" / "collect.toml", f"cube = {cubes}"))["flightlines"]
    assert set(lines.children) == {"raw_0"}
    line = lines["raw_0"].to_dataset()
    assert line.attrs["source"] == "raw_0.hdr, raw_12.hdr, raw_24.hdr, raw_36.hdr, raw_48.hdr"
    xr.testing.assert_identical(line.drop_attrs(), whole.drop_attrs())
    np.testing.assert_array_equal(
        line.paint.reflectance()["reflectance"].values, whole.paint.reflectance()["reflectance"].values
    )


def test_the_line_has_the_name_it_is_given(cut: Path, tmp_path: Path) -> None:
    shutil.copytree(cut.parent, tmp_path / "raw")
    path = with_lines(tmp_path / "raw" / "collect.toml", 'id = "north"\ncube = "flight/raw_*.hdr"')
    assert set(hp.open_collect(path)["flightlines"].children) == {"north"}


def test_a_cube_that_is_missing_makes_two_lines_and_says_why(cut: Path, tmp_path: Path) -> None:
    shutil.copytree(cut.parent, tmp_path / "raw")
    for name in ("raw_24", "raw_24.hdr", "frameIndex_24.txt"):
        (tmp_path / "raw" / "flight" / name).unlink()
    with pytest.warns(hp.errors.PaintWarning, match=r"raw_36 .*recording-interrupted"):
        lines = hp.open_collect(tmp_path / "raw" / "collect.toml")["flightlines"]
    assert {name: line.sizes["along_track"] for name, line in lines.children.items()} == {
        "raw_0": 24,
        "raw_36": 24,
    }


def test_tables_of_their_own_stay_lines_of_their_own(cut: Path, tmp_path: Path) -> None:
    shutil.copytree(cut.parent, tmp_path / "raw")
    tables = [f'cube = "flight/raw_{number}.hdr"' for number in (0, 12)]
    lines = hp.open_collect(with_lines(tmp_path / "raw" / "collect.toml", *tables))["flightlines"]
    assert set(lines.children) == {"raw_0", "raw_12"}


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
    (flown,) = join_lines(lines, None)
    assert flown.members == ("raw_0", "raw_20", "raw_40")
    assert int(np.isnat(flown.line["time"].values).sum()) == 7
    # a pause is one all the same
    lines["raw_20"] = lines["raw_20"].assign_coords(time=lines["raw_20"]["time"] + np.timedelta64(1, "s"))
    assert next(len(each.members) for each in join_lines(lines, None)) == 1


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
def test_no_line_takes_the_place_of_another(
    cut: Path, tmp_path: Path, tables: list[str], problem: str
) -> None:
    shutil.copytree(cut.parent, tmp_path / "raw")
    with pytest.raises(hp.errors.PaintError, match=re.escape(problem)) as caught:
        hp.open_collect(with_lines(tmp_path / "raw" / "collect.toml", *tables))
    assert str(caught.value).count("expected letters") <= 1


def test_flights_of_one_day_may_have_cubes_of_the_same_names(cut: Path, tmp_path: Path) -> None:
    shutil.copytree(cut.parent, tmp_path / "raw")
    shutil.copytree(tmp_path / "raw" / "flight", tmp_path / "raw" / "second")
    (tmp_path / "raw" / "second" / "raw_24.hdr").unlink()
    tables = ['id = "one"\ncube = "flight"', 'id = "two"\ncube = "second/raw_*.hdr"']
    with pytest.warns(hp.errors.PaintWarning, match=r"two_raw_36 .*recording-interrupted"):
        lines = hp.open_collect(with_lines(tmp_path / "raw" / "collect.toml", *tables))["flightlines"]
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
    (joined,) = join_lines(own, None)
    expect_equal((joined.line.attrs["dropped_frames"], 1), (np.isnat(joined.line["time"].values), ~there))
