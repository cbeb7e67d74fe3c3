"""`find_field_files` and its ``collect.toml``: what is found is named, what no file says is marked."""

import json
import os
import re
import shutil
import tomllib
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import xarray as xr
from support.commands import hyperpaint
from support.files import write_file
from support.refusals import expect_error, expect_errors, expect_refusals, expect_words

import hyperpaint as hp
from hyperpaint.base.errors import CollectError, PaintWarning
from hyperpaint.io.files.publishing import publish_file
from hyperpaint.io.maps.map_grids import read_geotiff_header
from hyperpaint.surroundings.surveying import flag_line, without_scene_flags
from hyperpaint.workflows import field_day
from hyperpaint.workflows.field_day import RECORD, STEPS, FieldDay, FieldDayRun, Step, run_field_day
from hyperpaint.workflows.field_folder import (
    find_field_files,
    surveyed_heights,
    unknown_keys,
    write_collect_toml,
)
from hyperpaint.workflows.pipeline import Record

#: A region across the ends of cubes.
ROOF = hp.Region("roof", [(2, 2), (7, 2), (7, 37), (2, 37)], flightline="raw_0")


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
        [path.parent.name for path in found.irradiance],
    ) == (["dark"], folder / "calibration.zarr", ["asd"])
    assert {name: [path.parent.name for path in paths] for name, paths in found.references.items()} == {
        "asd": ["asd_reflectance"],
        "svc": ["svc"],
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
    xr.testing.assert_allclose(
        line.paint.reflectance()["reflectance"],
        xr.concat([part.paint.reflectance()["reflectance"] for part in truth], "along_track"),
        rtol=1e-6,
    )


def test_what_lies_elsewhere_is_named(folder: Path, tmp_path: Path) -> None:
    for name in ("asd", "dark", "calibration.zarr", "svc"):
        shutil.move(folder / name, tmp_path / name)
    table = tmp_path / "svc.csv"  # a table with the name of an instrument
    table.write_text("wavelength [nm],red,blue\n" + "".join(f"{nm},0.1,0.2\n" for nm in range(400, 1000)))
    elsewhere = {name: tmp_path / path for name, path in (("asd", "asd"), ("dark", "dark"))}
    elsewhere["calibration"] = tmp_path / "calibration.zarr"
    path = write_collect_toml(
        find_field_files(folder, **elsewhere, references=[tmp_path / "svc" / "*.sig", table])
    )
    written = tomllib.loads(path.read_text(encoding="utf-8"))
    assert (written["irradiance"]["files"], written["dark"]["cubes"], written["calibration"]["path"]) == (
        "../asd/*.asd",
        ["../dark/raw_0.hdr"],
        "../calibration.zarr",
    )
    assert {entry["instrument"]: entry["files"] for entry in written["references"]} == {
        "svc": "../svc/*.sig",
        "asd": "asd_reflectance/*.asd",
        "svc_2": "../svc.csv",
    }
    opened = hp.open_collect(path)
    assert set(opened.children) >= {"flightlines", "irradiance", "calibration"}
    assert opened["references/svc_2"]["signature"].values.tolist() == ["red", "blue"]
    assert find_field_files(folder, **elsewhere, references=[tmp_path / "svc"]).references["svc"] == [
        tmp_path / "svc" / "*.sig"
    ]
    for name in ("*.sig", "dark", "asd", "nothing"):
        expect_error(
            hp.PaintError, "file-not-found", partial(find_field_files, folder, references=[tmp_path / name])
        )


def test_what_no_file_says_is_marked_and_refused_by_name(folder: Path) -> None:
    for name in ("asd", "dark", "calibration.zarr"):
        shutil.rmtree(folder / name)
    path = write_collect_toml(find_field_files(folder))
    assert [line.partition(" =")[0] for line in unknown_keys(path)] == ["path", "cubes", "files"]
    caught = expect_error(hp.errors.CollectError, None, lambda: hp.open_collect(path))
    for key in ("[calibration] path", "[dark] cubes", "[irradiance] files"):
        assert f"{key} is still '?'" in str(caught)


def test_a_record_that_misses_the_flight_asks_for_its_clock(tmp_path: Path) -> None:
    hp.simulate_collect(tmp_path, scene="plan", lines=40, bands=12, columns=10, clock_offset_s=37.25)
    (tmp_path / "collect.toml").unlink()
    found = find_field_files(tmp_path)
    assert found.clock_offsets_s is not None
    least, most = found.clock_offsets_s
    assert least <= 37.25 <= most
    assert any(line.startswith("clock_offset_s") for line in unknown_keys(write_collect_toml(found)))


def test_a_wrong_zone_is_one_problem_of_all_cubes(folder: Path) -> None:
    path = write_collect_toml(find_field_files(folder))
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace("clock_offset_s = 0.0", "clock_offset_s = 0.0\nutc_offset_h = -6.5"))
    with pytest.warns(hp.errors.PaintWarning, match="-5 h in .* more .utc-offset-conflict"):
        error = expect_error(hp.errors.CollectError, "time-uncovered", lambda: hp.open_collect(path))
    assert str(error).count("irradiance record covers") == 1
    assert "all 2 cubes (raw_0, raw_20) were recorded 2021" in str(error)
    # the nearest zone by a quarter of an hour, since no whole hour fits
    assert "utc_offset_h = -5 instead of -6.5 would fit" in str(error)


def test_files_without_a_use_are_said(folder: Path, tmp_path: Path) -> None:
    # a cube of floats, two calibrations, a survey of a slope, binned pixels
    text = (folder / "flight" / "raw_0.hdr").read_text(encoding="utf-8")
    (folder / "flight" / "raw_0_rd.hdr").write_text(text.replace("data type = 12", "data type = 4"))
    shutil.copy(folder / "flight" / "raw_0", folder / "flight" / "raw_0_rd")
    shutil.copytree(folder / "calibration.zarr", folder / "older.zarr")
    (folder / "survey.csv").write_text("name,ellipsoidal_height_m\nA,100.0\nB,103.5\n")
    for header in (folder / "flight").glob("*.hdr"):
        header.write_text(header.read_text() + ";Row binning = 2\n")
    found = find_field_files(folder)
    assert (len(found.cubes), found.calibration, found.survey) == (2, None, None)
    notes = ("raw_0_rd.hdr is not used", "several calibrations", "heights differ by 3.50 m")
    expect_words("\n".join(found.notes), *notes)
    assert {cube.lens for cube in found.cubes} == {None}
    assert "fov_deg" not in tomllib.loads(write_collect_toml(found).read_text(encoding="utf-8"))["geometry"]
    # heights that do not say what they are above, and a calibration that does not open
    (folder / "survey.csv").write_text("name,height_m\nA,100.0\nB,100.5\n")
    os.mkfifo(tmp_path / "camera.zarr")
    found = find_field_files(folder, calibration=tmp_path / "camera.zarr")
    assert (found.calibration, found.survey) == (None, None)
    assert any(re.match(r".*camera\.zarr is not used: .* a pipe", note) for note in found.notes)
    assert any("height-column-missing" in note for note in found.notes)
    assert "geometry" in tomllib.loads(write_collect_toml(found, overwrite=True).read_text(encoding="utf-8"))


def test_a_folder_without_a_flight_is_one_error(tmp_path: Path) -> None:
    expect_refusals(
        (hp.errors.CollectError, "cube-missing", lambda: find_field_files(tmp_path)),
        (hp.errors.CollectError, "folder-not-found", lambda: find_field_files(tmp_path / "absent")),
    )


def test_the_ground_and_the_lens_are_those_of_the_simulator(simulated: Path, folder: Path) -> None:
    found = find_field_files(folder)
    path = write_collect_toml(found)
    written = tomllib.loads(path.read_text(encoding="utf-8"))
    truth = tomllib.loads((simulated / "collect.toml").read_text(encoding="utf-8"))
    assert written["geometry"]["ground"] == pytest.approx(truth["geometry"]["ground"], abs=1e-3)
    assert written["geometry"]["fov_deg"] == pytest.approx(truth["geometry"]["fov_deg"], rel=1e-5)
    assert "id" not in written["flightlines"][0]  # one flight needs none
    # a collect that exists stays, and what is no TOML is not written over
    expect_error(hp.StoreError, "exists", lambda: write_collect_toml(found))
    assert write_collect_toml(found, overwrite=True) == path
    for place in (
        folder / "flight/settings.txt",
        folder / "flight/raw_0",
        folder / "calibration.zarr/zarr.json",
    ):
        before = place.read_bytes()
        expect_error(hp.StoreError, "file-foreign", partial(write_collect_toml, found, place, overwrite=True))
        assert place.read_bytes() == before
    # a processed store is no calibration to choose
    hp.process(path, folder / "products" / "lot.zarr")
    assert find_field_files(folder).calibration == folder / "calibration.zarr"


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
    assert surveyed_heights(tmp_path / "survey.csv").tolist() == [500.0 * metres] * 2


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
    expect_error(hp.errors.FormatError, problem, lambda: surveyed_heights(tmp_path / "survey.csv"))


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


@pytest.mark.parametrize("name", ["mosaic", "RAW_0_colour"])
def test_lines_whose_maps_would_replace_another_product_are_refused(simulated: Path, name: str) -> None:
    text = (simulated / "collect.toml").read_text(encoding="utf-8")
    path = write_file(
        simulated / f"{name}.toml", text.replace('id = "raw_20"', f'id = "{name}"'), encoding="utf-8"
    )
    expect_error(CollectError, "name-duplicate", lambda: run_field_day(path))
    path.unlink()


def test_a_single_scan_line_is_left_out_of_the_maps(simulated: Path, tmp_path: Path) -> None:
    copied = tmp_path / "day"
    shutil.copytree(simulated, copied)
    flight = copied / "flight"
    header, index = flight / "raw_20.hdr", flight / "frameIndex_20.txt"
    header.write_text(header.read_text().replace("lines = 20", "lines = 1"))
    (flight / "raw_20").write_bytes((flight / "raw_20").read_bytes()[: 12 * 10 * 2])
    index.write_text("".join(index.read_text().splitlines(keepends=True)[:2]))
    ran = run_field_day(copied, skip=[step for step in STEPS if step not in ("process", "map", "mosaic")])
    states = {outcome.step: (outcome.state, outcome.text) for outcome in ran.outcomes}
    assert states["map"][0] == "done"
    assert "left out raw_20" in states["map"][1]
    assert (ran.out / "raw_0.tif").exists()
    # both lists of references, and lines by their groups
    facts = json.loads(hyperpaint("info", "--json", copied / "collect.toml", status=0).output)
    assert (
        str(facts).count("asd: ") == str(facts).count("svc: ") == str(facts).count("/flightlines/raw_20") == 1
    )


def test_a_damaged_chunk_fails_the_report_of_the_run(simulated: Path, tmp_path: Path) -> None:
    copied = tmp_path / "day"
    shutil.copytree(simulated, copied)
    run = partial(run_field_day, copied, skip=[step for step in STEPS if step not in ("process", "report")])
    ran = run()
    chunk = next((ran.out / "lot.zarr/flightlines/raw_0/reflectance/c").rglob("0"))
    while chunk.is_dir():
        chunk = chunk / "0"
    chunk.write_bytes(chunk.read_bytes()[::-1])
    (ran.out / "report.html").unlink()
    assert [error.codes for error in run().errors] == [("store-damaged",)]
    # the way out that the error names
    chunk.unlink()
    ran = run()
    assert not ran.errors
    assert {outcome.step: outcome.state for outcome in ran.outcomes}["report"] == "done"


def test_a_renamed_frame_index_is_found(folder: Path) -> None:
    for suffix in ("", ".hdr"):
        (folder / f"flight/raw_0{suffix}").rename(folder / f"flight/raw_a{suffix}")
    (folder / "flight/frameIndex_0.txt").rename(folder / "flight/frameIndex_a.txt")
    indices = {cube.header.stem: cube.frame_index for cube in find_field_files(folder).cubes}
    assert indices == {name: folder / f"flight/frameIndex_{name[4:]}.txt" for name in ("raw_a", "raw_20")}


# --- `run_field_day`: two commands from a folder to products; what is there already is left alone ---


@pytest.fixture(scope="module")
def folder_day(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # Folder of a simulated flight with its regions of paint and the height of its ground
    folder_day = tmp_path_factory.mktemp("day")
    hp.simulate_collect(
        folder_day, lines=160, bands=16, columns=192, seed=0, clock_offset_s=0.0, samples=4, fleet="solid"
    )
    (folder_day / "collect.toml").rename(folder_day / "author.toml")
    # four paints, which a library of three is not, and their references: all are compared with all
    regions = folder_day / "regions.geojson"
    four = hp.Regions(tuple(hp.read_regions(regions))[:4])
    hp.write_regions(four, regions, overwrite=True)
    for path in (*folder_day.glob("svc/*"), *folder_day.glob("asd_reflectance/*")):
        if path.stem not in four.names:
            path.unlink()
    return folder_day


@pytest.fixture(scope="module")
def day(folder_day: Path) -> FieldDay:
    hyperpaint("init", folder_day, status=0)
    return run_field_day(folder_day / "collect.toml", skip=["report"])


def write_level_dem(path: Path, located: xr.Dataset, height: float) -> None:
    # Write a raster of one height around a located line
    west, north = float(located["east"].min()) - 50.0, float(located["north"].max()) + 50.0
    size = int(max(np.ptp(located[name].values) for name in ("east", "north"))) + 100
    profile = {"driver": "GTiff", "width": size, "height": size, "count": 1, "dtype": "float32"}
    transform = rasterio.Affine(1.0, 0.0, west, 0.0, -1.0, north)
    with rasterio.open(path, "w", crs=located["east"].attrs["crs"], transform=transform, **profile) as dem:
        dem.write(np.full((size, size), height, np.float32), 1)


@pytest.mark.slow
def test_every_step_is_done(day: FieldDay) -> None:
    assert [outcome.step for outcome in day.outcomes] == list(STEPS)
    states = {outcome.step: outcome.state for outcome in day.outcomes}
    assert states.pop("report") == states.pop("mosaic") == "left out"
    assert set(states.values()) == {"done"}, str(day)
    for outcome in day.outcomes:
        assert all(path.exists() for path in outcome.paths)
    # the flags of the scene are stored, and are those of the stored reflectance
    line = hp.open_store(day.out / "lot.zarr", "flightlines/raw_0")
    assert line["quality"].attrs["flags_from"] in hp.open_library(day.out / "paints.zarr").attrs["flags"]
    bare = line.drop_vars("counts")
    bare["quality"] = without_scene_flags(line)["quality"]
    xr.testing.assert_equal(flag_line(bare).line["quality"], line["quality"])


@pytest.mark.slow
def test_pixels_lie_where_the_simulator_saw_them(folder_day: Path) -> None:
    # Ground, lens and mounting are those of the table [geometry]: nothing is passed to locate
    line = hp.open_collect(folder_day / "author.toml")["flightlines/raw_0"].to_dataset()
    truth = xr.open_zarr(folder_day / "truth.zarr")
    flat = abs(truth["height"] - line.attrs["ground"]).values < 0.02  # pavement, not cars
    located = line.paint.locate(crs=truth.attrs["crs"])
    pixel = float(abs(np.diff(truth["east"].values[0])).mean())
    assert flat.mean() > 0.3
    for axis in ("east", "north"):
        miss = (located[axis].values - truth[axis].values)[flat]
        # the truth is the mean place of a few random rays a pixel
        assert abs(np.median(miss)) < 0.01 * pixel
        assert np.percentile(abs(miss), 95) < 0.5 * pixel


@pytest.mark.slow
def test_angles_of_a_file_are_those_of_the_field_of_view(folder_day: Path) -> None:
    angles = (
        hp.open_collect(folder_day / "author.toml")["flightlines/raw_0"].to_dataset()["look_across"].values
    )
    text = re.sub(
        r"fov_deg = \S+", 'look_angle = "angles.txt"', (folder_day / "author.toml").read_text("utf-8")
    )
    other = write_file(folder_day / "angles.toml", text, encoding="utf-8")
    (folder_day / "angles.txt").write_text("\n".join(map(repr, angles.tolist())), encoding="utf-8")
    read = hp.open_collect(other)["flightlines/raw_0"].to_dataset()
    assert (read["look_across"].values == angles).all()
    assert read["look_across"].attrs["units"] == "degree"
    for wrong, said in (("1 2 3", "3 numbers"), ("left", "words")):
        (folder_day / "angles.txt").write_text(wrong, encoding="utf-8")
        expect_error(hp.PaintError, rf"{said}, .*length-mismatch", lambda: hp.open_collect(other))
    for name in ("angles.toml", "angles.txt"):
        (folder_day / name).unlink()


@pytest.mark.slow
def test_a_second_run_does_what_is_missing(day: FieldDay, folder_day: Path) -> None:
    def states() -> dict[str, str]:
        again = run_field_day(folder_day / "collect.toml", skip=["report"])
        assert again.passed in (day.passed, None)
        return {outcome.step: outcome.state for outcome in again.outcomes}

    # products are known by content, whatever their times are
    table = day.out / "agreement.csv"
    text = table.read_bytes()
    os.utime(table, ns=(1, 1))
    times = {path: path.stat().st_mtime_ns for path in sorted(day.out.rglob("*")) if path.is_file()}
    assert set(states().values()) == {"unchanged", "left out"}
    assert {path: path.stat().st_mtime_ns for path in sorted(day.out.rglob("*")) if path.is_file()} == times
    table.write_bytes(text.swapcase())
    os.utime(table, ns=(1, 1))
    assert states()["validate"] == "failed"
    # sizes and times, which earlier versions recorded, are no reason to refuse
    table.unlink()
    record = json.loads((day.out / RECORD).read_text())
    record["dirsig"]["products"] = {"dirsig": "0" * 64}
    (day.out / RECORD).write_text(json.dumps(record))
    expected = {"signatures": "unchanged", "validate": "done", "map": "unchanged", "dirsig": "done"}
    assert states().items() >= expected.items()


@pytest.mark.slow
def test_a_new_product_is_one_declaration(
    day: FieldDay, folder_day: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The engine decides whether it is current, protects files of other programs, and reports it
    def count_paints(run: FieldDayRun) -> str:
        publish_file(run.out / "count.txt", str(hp.open_library(run.library).sizes).encode(), overwrite=True)
        return "counted"

    def state(*, overwrite: bool = False) -> str:
        others = [name for name in STEPS if name not in ("process", "count")]
        return run_field_day(folder_day, skip=others, overwrite=overwrite).outcomes[-1].state

    monkeypatch.setitem(field_day.STEPS, "count", Step("count.txt", count_paints, ("library",), ("library",)))
    assert (state(), state()) == ("done", "unchanged")
    (day.out / "count.txt").write_text("of another program")
    assert (state(), state(overwrite=True)) == ("failed", "done")
    (day.out / "count.txt").unlink()


def test_what_a_collect_does_not_have_is_said(folder: Path) -> None:
    for name in ("svc", "asd_reflectance"):
        shutil.rmtree(folder / name)
    path = write_collect_toml(find_field_files(folder))
    path.write_text(path.read_text(encoding="utf-8").replace("ground = ", "# ground = "), encoding="utf-8")
    hp.write_regions([ROOF], folder / "regions.geojson", overwrite=True)
    bare = run_field_day(path, skip=["dirsig", "report"])
    said = {outcome.step: outcome.text for outcome in bare.outcomes if outcome.state == "left out"}
    assert "[[references]]" in said["validate"]
    assert "[geometry] ground" in said["map"]
    assert bare.passed is None


@pytest.mark.slow
def test_lines_make_one_map(folder_day: Path, tmp_path: Path) -> None:
    copied = tmp_path / "two"
    shutil.copytree(folder_day, copied, ignore=shutil.ignore_patterns("products"))
    text = (copied / "author.toml").read_text(encoding="utf-8")
    (table,) = re.findall(r"\[\[flightlines\]\]\n(?:[^\[\n].*\n?)+", text[text.index("[[flightlines]]") :])
    again = re.sub(r'id = "\w+"', 'id = "again"', table)
    assert again != table
    (copied / "collect.toml").write_text(text.replace(table, f"{table}\n{again}\n"), encoding="utf-8")
    day = run_field_day(copied, skip=["signatures", "validate", "dirsig", "report"])
    said = {outcome.step: outcome for outcome in day.outcomes}
    assert said["mosaic"].state == "done", str(day)
    assert "again, raw_0" in said["mosaic"].text or "raw_0, again" in said["mosaic"].text
    one, both = (read_geotiff_header(day.out / f"{name}.tif") for name in ("raw_0", "mosaic"))
    assert one.shape == pytest.approx(both.shape, rel=0.1)  # cells of a mosaic are of the mean spacing
    assert (one.bands, one.dtype) == (both.bands, both.dtype)
    pictures = [read_geotiff_header(day.out / f"{name}_colour.tif") for name in ("raw_0", "mosaic")]
    assert [(picture.shape, picture.bands) for picture in pictures] == [(one.shape, 4), (both.shape, 4)]
    assert "of the line" in said["map"].text


@pytest.mark.slow
def test_a_spoilt_record_and_a_kill_only_cost_time(
    day: FieldDay, folder_day: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copied = tmp_path / "spoilt"
    shutil.copytree(folder_day, copied)
    record = copied / "products" / "steps.json"
    kept = json.loads(record.read_text())
    skip = ["signatures", "map", "dirsig", "report"]
    record.write_text("[1, 2")
    write = Record.write

    def killed(record: Record, entries: dict[str, Any]) -> None:
        write(record, entries)
        if entries.get("validate", {}).get("inputs"):
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Record, "write", killed)
        expect_error(KeyboardInterrupt, None, lambda: run_field_day(copied, skip=skip))
    again = run_field_day(copied, skip=skip)
    assert {one.step: one.state for one in again.outcomes}["validate"] == "unchanged"
    assert again.passed == day.passed is not None
    assert json.loads(record.read_text())["validate"]["inputs"] == kept["validate"]["inputs"]


@pytest.mark.slow
def test_products_of_another_library_are_made_again(day: FieldDay, folder_day: Path, tmp_path: Path) -> None:
    copied = tmp_path / "other"
    shutil.copytree(folder_day, copied)
    library = copied / "products" / "paints.zarr"
    first = hp.open_library(library).load()
    shutil.rmtree(library)
    hp.write_library(first.isel(signature=slice(0, 3)), library)
    skip = ["map", "mosaic", "report"]
    states = {outcome.step: outcome for outcome in run_field_day(copied, skip=skip).outcomes}
    assert states["signatures"].state == "failed"
    assert "paints.zarr: written or changed by another program" in states["signatures"].text
    assert hp.open_library(library).sizes["signature"] == 3  # it is the user's
    assert {one.step: one.text for one in run_field_day(copied, skip=["signatures", *skip]).outcomes}[
        "dirsig"
    ].endswith("3 materials")
    states = {outcome.step: outcome for outcome in run_field_day(copied, skip=skip, overwrite=True).outcomes}
    assert (
        {states[step].state for step in ("signatures", "validate", "dirsig")},
        hp.open_library(library).sizes["signature"],
    ) == ({"done"}, first.sizes["signature"])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Use `@` matmul:PendingDeprecationWarning")  # rioxarray, of affine
def test_a_height_model_places_regions_and_is_looked_at_again(folder_day: Path, tmp_path: Path) -> None:
    copied = tmp_path / "dem"
    shutil.copytree(folder_day, copied, ignore=shutil.ignore_patterns("products"))
    line = hp.open_collect(copied / "author.toml")["flightlines/raw_0"].to_dataset()
    located = line.paint.locate()
    write_level_dem(copied / "dem.tif", located, line.attrs["ground"])
    text = re.sub(
        r"(?m)^ground = .*$", 'dem = "dem.tif"\ndem_heights = "ellipsoid"',
        (copied / "author.toml").read_text("utf-8"),
    )  # fmt: skip
    (copied / "collect.toml").write_text(text, encoding="utf-8")
    x, y = np.round(hp.read_regions(copied / "regions.geojson")[0].polygon).astype(int).T
    x, y = x.clip(0, line.sizes["cross_track"] - 1), y.clip(0, line.sizes["along_track"] - 1)
    corners = np.stack([located[name].values[y, x] for name in ("east", "north")], axis=-1)
    drawn = hp.Region("roof", corners, flightline="raw_0")
    hp.write_regions(hp.Regions((drawn,), "map", located["east"].attrs["crs"]), copied / "drawn.geojson")
    skip = ["validate", "mosaic", "dirsig", "report"]
    day = run_field_day(copied, regions=copied / "drawn.geojson", skip=skip)
    states = {outcome.step: outcome for outcome in day.outcomes}
    assert {states[step].state for step in ("signatures", "map")} == {"done"}, str(day)
    (copied / "dem.tif").unlink()
    write_level_dem(copied / "dem.tif", located, line.attrs["ground"] - 20.0)
    day = run_field_day(copied, regions=copied / "drawn.geojson", skip=["signatures", *skip])
    assert {one.step: one.state for one in day.outcomes}["map"] == "done"


@pytest.mark.slow
@pytest.mark.usefixtures("day")  # which writes the collect.toml
def test_regions_and_steps_are_checked_before_anything_is_processed(folder_day: Path, tmp_path: Path) -> None:
    call = partial(run_field_day, folder_day / "collect.toml", tmp_path / "none")
    expect_errors(
        (hp.SchemaError, "file-not-found", lambda: call(regions=tmp_path / "typo.geojson")),
        (hp.SchemaError, "step-required", lambda: call(skip=["process", "albedo"])),
    )
    assert not (tmp_path / "none").exists()


@pytest.mark.slow
def test_a_step_that_fails_does_not_end_the_day(
    day: FieldDay, folder_day: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise hp.StoreError("the disk is full")

    (day.out / "raw_0.tif").unlink()
    (day.out / "agreement.csv").unlink()
    with monkeypatch.context() as patch:
        patch.setattr("hyperpaint.workflows.field_day.validate_files", refuse)
        again = hyperpaint("run", folder_day, "--skip", "report")
    assert again.exit_code == 2
    expect_words(again.output, "validate    failed", "the disk is full", "map         done")
    assert (day.out / "raw_0.tif").exists()


@pytest.mark.slow
def test_proposed_paints_are_not_compared_by_name(day: FieldDay, folder_day: Path, tmp_path: Path) -> None:
    copied = tmp_path / "proposed"
    shutil.copytree(
        folder_day, copied, ignore=shutil.ignore_patterns("regions.geojson", "products", "truth.zarr")
    )
    shutil.copytree(day.out / "lot.zarr", copied / "products" / "lot.zarr")
    outcome = {one.step: one for one in run_field_day(copied, skip=["map", "dirsig", "report"]).outcomes}[
        "validate"
    ]
    assert outcome.state == "left out"
    assert "--pairs" in outcome.text


def test_a_flight_cut_into_five_cubes_has_the_same_signatures(tmp_path: Path) -> None:
    # ASD files and darks of the second lie elsewhere as well; no bit of any paint differs
    libraries = []
    for cubes, names in ((1, ()), (5, ("asd", "dark"))):
        flight, elsewhere = tmp_path / f"flight_{cubes}", list[object]()
        hp.simulate_collect(
            flight, scene="plan", lines=40, bands=12, columns=10, seed=5, clock_offset_s=0.0, cubes=cubes,
            truth=False,
        )  # fmt: skip
        (flight / "collect.toml").unlink()
        for references in ("svc", "asd_reflectance"):  # signatures need none
            shutil.rmtree(flight / references)
        hp.write_regions([ROOF], flight / "regions.geojson", overwrite=True)
        for name in names:
            elsewhere += [f"--{name}", shutil.move(flight / name, tmp_path / name)]
        assert re.search(
            rf"\b{cubes} cubes?, 1 dark", hyperpaint("init", flight, *elsewhere, status=0).output
        )
        day = run_field_day(flight, skip=["validate", "map", "dirsig", "report"])
        libraries.append(hp.open_library(day.out / "paints.zarr"))
    one, five = libraries
    assert set(one.data_vars) == set(five.data_vars)
    for name in one.data_vars:
        assert one[name].values.tobytes() == five[name].values.tobytes(), name


@pytest.mark.slow
def test_paints_of_an_earlier_run_do_not_stand_for_those_that_failed(
    day: FieldDay, folder_day: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise hp.SchemaError("no region holds a pixel")

    with monkeypatch.context() as patch:
        patch.setattr("hyperpaint.workflows.field_day.write_signatures", refuse)
        again = run_field_day(folder_day, specular_sky=True, skip=["map", "report"])
    states = {one.step: one.state for one in again.outcomes}
    assert day.passed is not None
    assert (day.out / "paints.zarr").exists()
    assert (states["signatures"], states["validate"], states["dirsig"]) == ("failed", "left out", "left out")


# --- A folder of a line scanner, from `init` to signatures: raw, white and dark, and nothing else


BANDS, COLUMNS, TILE = 6, 20, 0.97
RNG = np.random.default_rng(3)
FIXED = RNG.normal(100.0, 3.0, (BANDS, COLUMNS))
RESPONSE = RNG.uniform(1500.0, 3500.0, (BANDS, COLUMNS))


def write(
    path: Path, reflectance: float, clock: str, lines: int = 30, lamp: float = 1.0, scene: int | None = None
) -> None:
    # a cube of an even surface, with the header of a Specim camera; without a clock as of another camera
    path.parent.mkdir(parents=True, exist_ok=True)
    # after ``scene`` lines of the scene follow dark lines
    mean = np.tile(lamp * reflectance * RESPONSE, (lines, 1, 1))
    mean[scene or lines :] = 0.0
    own_dark = f"autodarkstartline = {scene}\n" if scene else ""
    counts = np.rint(FIXED + RNG.normal(mean, np.sqrt(mean / 40.0 + 1.5))).clip(0, 4095)
    counts.astype("u2").tofile(path.with_suffix(".raw"))
    clock = clock and f"acquisition date = DATE(yyyy-mm-dd): 2024-06-14\nStart Time = UTC TIME: {clock}\n"
    clock = clock and f"{clock}fps = 50.00\n"
    nm = ", ".join(f"{500 + 50 * band}" for band in range(BANDS))
    path.with_suffix(".hdr").write_text(
        f"ENVI\n{clock}{own_dark}samples = {COLUMNS}\nbands = {BANDS}\nlines = {lines}\ninterleave = bil\n"
        f"data type = 12\nheader offset = 0\nbyte order = 0\ntint = 9.00\nwavelength = {{{nm}}}\n"
    )


@pytest.mark.parametrize(
    ("key", "exposure_s"),
    [("tint = 9.00", 0.009), ("tint = 9000 us", 0.009), ("tint (us) = 9000", 0.009), ("tint = 9,00", 0.009)],
)
def test_exposures_of_a_line_scanner(tmp_path: Path, key: str, exposure_s: float) -> None:
    write(tmp_path / "lot1", 0.4, "")
    header = tmp_path / "lot1.hdr"
    header.write_text(header.read_text().replace("tint = 9.00", key))
    (cube,) = find_field_files(tmp_path).cubes
    assert cube.exposure_s == exposure_s


@pytest.mark.parametrize(
    "text",
    [
        "description = {x,RADIANCE}",
        "description = {x,REFLECTANCE}",
        "map info = {UTM, 1, 1, 5, 5, 1, 1, 32, North}",
    ],
)
def test_products_are_no_raw_cubes(tmp_path: Path, text: str) -> None:
    for name in ("lot1", "lot1_product"):
        write(tmp_path / name, 0.4, "")
    with (tmp_path / "lot1_product.hdr").open("a") as file:
        file.write(f"{text}\n")
    found = find_field_files(tmp_path)
    assert [cube.header.stem for cube in found.cubes] == ["lot1"]
    assert "lot1_product.hdr is not used" in found.notes[0]


def test_scenes_whose_names_say_dark_or_white(tmp_path: Path) -> None:
    scenes = ["car_white", "dark_cars", "darkwood", "lot1"]
    darks = ["DARKREF_lot1", "dark_10ms", "dark_lot1", "lot1_dark"]
    whites = ["darkroom_white_ref", "lot1_WHITE", "spectralon", "white_board"]
    for level, names in ((0.4, scenes), (0.0, darks), (TILE, whites)):
        for name in names:
            write(tmp_path / name, level, "")
    found = find_field_files(tmp_path)
    cubes = [cube.header for cube in found.cubes]
    assert [[path.stem for path in paths] for paths in (cubes, found.darks, found.whites)] == [
        scenes, darks, whites
    ]  # fmt: skip
    assert [name in " ".join(found.notes) for name in ("dark_cars", "darkwood", "lot1_WHITE")] == [True] * 3


@pytest.mark.parametrize("clocks", [("09:46:00", "09:47:00", "09:48:00"), ("", "", "")])
def test_a_folder_of_a_line_scanner_is_processed(tmp_path: Path, clocks: tuple[str, str, str]) -> None:
    capture = tmp_path / "day/lot1/capture"
    before, during, after = clocks
    if during:
        write(capture / "lot1", 0.4, during, 40, lamp=0.98)
        write(capture / "DARKREF_lot1", 0.0, during)
    else:
        write(capture / "lot1", 0.4, during, 70, scene=40)
    write(capture / "WHITEREF_lot1", TILE, before)
    if after:
        write(capture / "WHITEREF_end", TILE, after, lamp=0.96)
    found = find_field_files(tmp_path / "day")
    assert [path.stem for path in found.whites] == ["WHITEREF_end", "WHITEREF_lot1"][not after :]
    toml = write_collect_toml(found)
    assert unknown_keys(toml) == ['reflectance = "?"']
    expect_error(CollectError, "reflectance", lambda: hp.open_collect(toml))
    toml.write_text(
        toml.read_text().replace('reflectance = "?"', f"reflectance = {TILE}\nuncertainty = 0.01")
    )
    regions = hp.Regions([hp.Region("grey", [(2, 2), (17, 2), (17, 37), (2, 37)], flightline="lot1")])
    hp.write_regions(regions, tmp_path / "regions.geojson")
    # flags of the lamp are told; without them, steps of other tests are left out
    skip = () if after else ("dirsig", "report")
    with pytest.warns(PaintWarning, match="illumination_unstable") if after else nullcontext():
        day = run_field_day(toml, tmp_path / "out", regions=tmp_path / "regions.geojson", skip=skip)
    assert not day.errors
    line = hp.open_store(tmp_path / "out/lot.zarr", "flightlines/lot1")
    assert ("time" in line.coords) == bool(during)
    assert float(line.reflectance.mean()) == pytest.approx(0.4, rel=2e-3)
    np.testing.assert_allclose(line.paint.reflectance().reflectance, line.reflectance, rtol=2**-12)
    paint = hp.open_library(tmp_path / "out/paints.zarr")
    assert paint.reflectance.values == pytest.approx(np.full((1, BANDS), 0.4), rel=4e-3)
    assert paint.reflectance_u_systematic.values == pytest.approx(np.full((1, BANDS), 0.004), rel=0.1)
