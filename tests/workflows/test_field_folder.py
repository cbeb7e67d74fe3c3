"""`find_field_files` and its ``collect.toml``: what is found is named, what no file says is marked."""

import os
import re
import shutil
import tomllib
from pathlib import Path

import pytest
import xarray as xr
from support.refusals import expect_refusals

import hyperpaint as hp
from hyperpaint.workflows.field_folder import (
    _surveyed_heights,
    find_field_files,
    unknown_keys,
    write_collect_toml,
)


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # Folder of a small simulated collect: two cubes, clocks that agree
    folder = tmp_path_factory.mktemp("collect")
    hp.simulate_collect(
        folder, scene="plan", lines=40, bands=12, columns=10, cubes=2, seed=5, clock_offset_s=0.0
    )
    return folder


@pytest.fixture
def folder(simulated: Path, tmp_path: Path) -> Path:
    # A copy of it without what hyperpaint wrote about it
    copied = tmp_path / "flight_day"
    shutil.copytree(simulated, copied, ignore=shutil.ignore_patterns("collect.toml", "truth.zarr"))
    return copied


def test_everything_of_a_collect_is_found(folder: Path) -> None:
    found = find_field_files(folder)
    assert [cube.header.name for cube in found.cubes] == ["raw_0.hdr", "raw_20.hdr"]
    assert [str(cube.frame_index and cube.frame_index.name) for cube in found.cubes] == [
        "frameIndex_0.txt",
        "frameIndex_20.txt",
    ]
    assert {str(cube.navigation and cube.navigation.name) for cube in found.cubes} == {"imu_gps.txt"}
    assert (
        [path.parent.name for path in found.darks],
        found.calibration,
        [path.name for path, _ in found.irradiance],
    ) == (["dark"], folder / "calibration.zarr", ["asd"])
    assert {(instrument, path.name) for instrument, path, _ in found.references} <= {
        ("asd", "asd_reflectance"),
        ("svc", "svc"),
    }


def test_the_collect_opens_to_what_its_author_wrote(simulated: Path, folder: Path) -> None:
    path = write_collect_toml(find_field_files(folder))
    assert unknown_keys(path) == []
    opened, expected = hp.open_collect(path), hp.open_collect(simulated / "collect.toml")
    assert set(opened.groups) == set(expected.groups) - {"/flightlines/raw_20"}  # one line of two cubes
    line = opened["flightlines/raw_0"].to_dataset().drop_vars("look_across")  # of six digits in the file
    truth = [
        expected[f"flightlines/{name}"].to_dataset().drop_vars("look_across") for name in ("raw_0", "raw_20")
    ]
    # the lines of the second cube count on in the line of both
    truth[1] = truth[1].assign_coords(along_track=truth[1]["along_track"] + truth[0].sizes["along_track"])
    for name in ("counts", "time"):
        xr.testing.assert_equal(line[name], xr.concat([part[name] for part in truth], "along_track"))
    reflectance = [part.paint.reflectance()["reflectance"] for part in truth]
    xr.testing.assert_allclose(
        line.paint.reflectance()["reflectance"], xr.concat(reflectance, "along_track"), rtol=1e-6
    )


def test_what_lies_elsewhere_is_named(folder: Path, tmp_path: Path) -> None:
    for name in ("asd", "dark", "calibration.zarr"):
        shutil.move(folder / name, tmp_path / name)
    found = find_field_files(
        folder, asd=tmp_path / "asd", dark=tmp_path / "dark", calibration=tmp_path / "calibration.zarr"
    )
    path = write_collect_toml(found)
    written = tomllib.loads(path.read_text(encoding="utf-8"))
    assert (written["irradiance"]["files"], written["dark"]["cubes"], written["calibration"]["path"]) == (
        "../asd/*.asd",
        ["../dark/raw_0.hdr"],
        "../calibration.zarr",
    )
    assert set(hp.open_collect(path).children) >= {"flightlines", "irradiance", "calibration"}


def test_what_no_file_says_is_marked_and_refused_by_name(folder: Path) -> None:
    for name in ("asd", "dark", "calibration.zarr"):
        shutil.rmtree(folder / name)
    path = write_collect_toml(find_field_files(folder))
    assert [line.partition(" =")[0] for line in unknown_keys(path)] == ["path", "cubes", "files"]
    with pytest.raises(hp.errors.CollectError) as caught:
        hp.open_collect(path)
    for key in ("[calibration] path", "[dark] cubes", "[irradiance] files"):
        assert f"{key} is still '?'" in str(caught.value)


def test_a_record_that_misses_the_flight_asks_for_its_clock(tmp_path: Path) -> None:
    hp.simulate_collect(tmp_path, scene="plan", lines=40, bands=12, columns=10, clock_offset_s=37.25)
    (tmp_path / "collect.toml").unlink()
    found = find_field_files(tmp_path)
    assert found.clock_offsets_s is not None
    least, most = found.clock_offsets_s
    assert least <= 37.25 <= most
    assert any(line.startswith("clock_offset_s") for line in unknown_keys(write_collect_toml(found)))


def test_cubes_that_are_not_raw_are_said(folder: Path) -> None:
    text = (folder / "flight" / "raw_0.hdr").read_text(encoding="utf-8")
    (folder / "flight" / "raw_0_rd.hdr").write_text(text.replace("data type = 12", "data type = 4"))
    shutil.copy(folder / "flight" / "raw_0", folder / "flight" / "raw_0_rd")
    found = find_field_files(folder)
    assert len(found.cubes) == 2
    assert any("raw_0_rd.hdr is not used" in note for note in found.notes)


def test_two_calibrations_are_not_chosen_between(folder: Path) -> None:
    shutil.copytree(folder / "calibration.zarr", folder / "older.zarr")
    found = find_field_files(folder)
    assert found.calibration is None
    assert any("several calibrations" in note for note in found.notes)


def test_a_folder_without_a_flight_is_one_error(tmp_path: Path) -> None:
    expect_refusals(
        (hp.errors.CollectError, "cube-missing", lambda: find_field_files(tmp_path)),
        (hp.errors.CollectError, "folder-not-found", lambda: find_field_files(tmp_path / "absent")),
    )


def test_a_collect_that_is_there_stays(folder: Path) -> None:
    found = find_field_files(folder)
    path = write_collect_toml(found)
    with pytest.raises(hp.StoreError, match="exists"):
        write_collect_toml(found)
    assert write_collect_toml(found, overwrite=True) == path


def test_the_ground_and_the_lens_are_those_of_the_simulator(simulated: Path, folder: Path) -> None:
    written = tomllib.loads(write_collect_toml(find_field_files(folder)).read_text(encoding="utf-8"))
    truth = tomllib.loads((simulated / "collect.toml").read_text(encoding="utf-8"))
    assert written["geometry"]["ground"] == pytest.approx(truth["geometry"]["ground"], abs=1e-3)
    assert written["geometry"]["fov_deg"] == pytest.approx(truth["geometry"]["fov_deg"], rel=1e-5)


def test_heights_that_do_not_say_what_they_are_above_are_not_used(folder: Path) -> None:
    survey = folder / "survey.csv"
    survey.write_text(survey.read_text().replace("ellipsoidal_height_m", "height_m"))
    found = find_field_files(folder)
    assert found.survey is None
    assert any("height-column-missing" in note for note in found.notes)
    assert "geometry" in tomllib.loads(write_collect_toml(found).read_text(encoding="utf-8"))


def test_a_survey_of_a_slope_is_no_height_of_the_ground(folder: Path) -> None:
    (folder / "survey.csv").write_text("name,ellipsoidal_height_m\nA,100.0\nB,103.5\n")
    found = find_field_files(folder)
    assert found.survey is None
    assert any("heights differ by 3.50 m" in note for note in found.notes)


@pytest.mark.parametrize(
    ("heading", "metres"),
    [
        ("ellipsoidal_height_ft", 0.3048),
        ("Ellipsoidal height [US survey feet]", 1200 / 3937),
        ("hae (M)", 1.0),
    ],
)
def test_surveyed_heights_come_in_metres(tmp_path: Path, heading: str, metres: float) -> None:
    (tmp_path / "survey.csv").write_text(f"name,{heading}\nA,500.0\nB,500.0\n")
    assert _surveyed_heights(tmp_path / "survey.csv").tolist() == [500.0 * metres] * 2


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("name,hae [degree]\nA,1.0\n", "'hae' in 'degree', expected a unit of length"),
        (f"name,hae\n{'A' * 200_000},1.0\n", "text-unreadable"),
    ],
)
def test_a_survey_in_other_units_or_of_endless_cells_is_refused(
    tmp_path: Path, text: str, problem: str
) -> None:
    (tmp_path / "survey.csv").write_text(text)
    with pytest.raises(hp.errors.FormatError, match=problem):
        _surveyed_heights(tmp_path / "survey.csv")


def test_binned_pixels_leave_the_field_of_view_open(folder: Path) -> None:
    for header in (folder / "flight").glob("*.hdr"):
        header.write_text(header.read_text() + ";Row binning = 2\n")
    found = find_field_files(folder)
    assert {cube.lens for cube in found.cubes} == {None}
    assert "fov_deg" not in tomllib.loads(write_collect_toml(found).read_text(encoding="utf-8"))["geometry"]


def test_what_is_no_toml_is_not_written_over(folder: Path) -> None:
    for name in ("flight/settings.txt", "flight/raw_0", "calibration.zarr/zarr.json"):
        before = (folder / name).read_bytes()
        with pytest.raises(hp.StoreError, match="file-foreign"):
            write_collect_toml(find_field_files(folder), folder / name, overwrite=True)
        assert (folder / name).read_bytes() == before


def test_a_calibration_that_does_not_open_is_said(folder: Path, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "camera.zarr")
    found = find_field_files(folder, calibration=tmp_path / "camera.zarr")
    assert found.calibration is None
    assert any(re.match(r".*camera\.zarr is not used: .* a pipe", note) for note in found.notes)


def test_a_processed_store_is_no_calibration_to_choose(folder: Path) -> None:
    path = write_collect_toml(find_field_files(folder))
    hp.process(path, folder / "products" / "lot.zarr")
    assert find_field_files(folder).calibration == folder / "calibration.zarr"


def test_two_flights_whose_cubes_have_the_same_names_open(folder: Path) -> None:
    shutil.copytree(folder / "flight", folder / "second flight")
    path = write_collect_toml(find_field_files(folder))
    lines = hp.open_collect(path)["flightlines"]
    assert {name: line.sizes["along_track"] for name, line in lines.children.items()} == {
        "flight": 40, "second_flight": 40,
    }  # fmt: skip
    # cubes that have a table each are named as well
    (folder / "flight" / "raw_99.hdr").write_text("no cube", encoding="utf-8")
    path = write_collect_toml(find_field_files(folder), overwrite=True)
    tables = tomllib.loads(path.read_text(encoding="utf-8"))["flightlines"]
    assert [table["id"] for table in tables] == ["flight_raw_0", "flight_raw_20", "second_flight"]


def test_one_flight_needs_no_id(folder: Path) -> None:
    path = write_collect_toml(find_field_files(folder))
    assert "id" not in tomllib.loads(path.read_text(encoding="utf-8"))["flightlines"][0]
