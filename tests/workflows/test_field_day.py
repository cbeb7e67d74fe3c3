"""`run_field_day`: two commands from a folder to products; what is there already is left alone."""

import json
import os
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.commands import hyperpaint
from support.refusals import expect_words

import hyperpaint as hp
from hyperpaint.io.files.publishing import publish_file
from hyperpaint.io.maps.geotiff import read_geotiff_header
from hyperpaint.workflows import field_day
from hyperpaint.workflows.field_day import RECORD, STEPS, FieldDay, FieldDayRun, Step, run_field_day
from hyperpaint.workflows.products import Record

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # Folder of a simulated flight with its regions of paint and the height of its ground
    folder = tmp_path_factory.mktemp("day")
    hp.simulate_collect(
        folder, lines=320, bands=24, columns=256, seed=0, clock_offset_s=0.0, samples=4, fleet="solid"
    )
    (folder / "collect.toml").rename(folder / "author.toml")
    return folder


@pytest.fixture(scope="module")
def day(folder: Path) -> FieldDay:
    hyperpaint("init", folder, status=0)
    return run_field_day(folder / "collect.toml", skip=["report"])


def write_level_dem(path: Path, located: xr.Dataset, height: float) -> None:
    # Write a raster of one height around a located line
    rasterio = pytest.importorskip("rasterio")
    west, north = float(located["east"].min()) - 50.0, float(located["north"].max()) + 50.0
    size = int(max(np.ptp(located[name].values) for name in ("east", "north"))) + 100
    profile = {"driver": "GTiff", "width": size, "height": size, "count": 1, "dtype": "float32"}
    transform = rasterio.Affine(1.0, 0.0, west, 0.0, -1.0, north)
    with rasterio.open(path, "w", crs=located["east"].attrs["crs"], transform=transform, **profile) as dem:
        dem.write(np.full((size, size), height, np.float32), 1)


def test_every_step_is_done(day: FieldDay) -> None:
    assert [outcome.step for outcome in day.outcomes] == list(STEPS)
    states = {outcome.step: outcome.state for outcome in day.outcomes}
    assert states.pop("report") == states.pop("mosaic") == "left out"
    assert set(states.values()) == {"done"}, str(day)
    for outcome in day.outcomes:
        assert all(path.exists() for path in outcome.paths)


def test_pixels_lie_where_the_simulator_saw_them(folder: Path) -> None:
    # Ground, lens and mounting are those of the table [geometry]: nothing is passed to locate
    line = hp.open_collect(folder / "author.toml")["flightlines/raw_0"].to_dataset()
    truth = xr.open_zarr(folder / "truth.zarr")
    flat = abs(truth["height"] - line.attrs["ground"]).values < 0.02  # pavement, not cars
    located = line.paint.locate(crs=truth.attrs["crs"])
    pixel = float(abs(np.diff(truth["east"].values[0])).mean())
    assert flat.mean() > 0.3
    for axis in ("east", "north"):
        miss = (located[axis].values - truth[axis].values)[flat]
        # the truth is the mean place of a few random rays a pixel
        assert abs(np.median(miss)) < 0.01 * pixel
        assert np.percentile(abs(miss), 95) < 0.5 * pixel


def test_angles_of_a_file_are_those_of_the_field_of_view(folder: Path) -> None:
    angles = hp.open_collect(folder / "author.toml")["flightlines/raw_0"].to_dataset()["look_across"].values
    text = re.sub(r"fov_deg = \S+", 'look_angle = "angles.txt"', (folder / "author.toml").read_text("utf-8"))
    other = folder / "angles.toml"
    other.write_text(text, encoding="utf-8")
    (folder / "angles.txt").write_text("\n".join(map(repr, angles.tolist())), encoding="utf-8")
    read = hp.open_collect(other)["flightlines/raw_0"].to_dataset()
    assert (read["look_across"].values == angles).all()
    assert read["look_across"].attrs["units"] == "degree"
    for wrong, said in (("1 2 3", "3 numbers"), ("left", "words")):
        (folder / "angles.txt").write_text(wrong, encoding="utf-8")
        with pytest.raises(hp.PaintError, match=rf"{said}, .*length-mismatch"):
            hp.open_collect(other)
    for name in ("angles.toml", "angles.txt"):
        (folder / name).unlink()


def test_a_second_run_does_nothing(day: FieldDay, folder: Path) -> None:
    times = {path: path.stat().st_mtime_ns for path in sorted(day.out.rglob("*")) if path.is_file()}
    again = run_field_day(folder / "collect.toml", skip=["report"])
    assert {outcome.state for outcome in again.outcomes} == {"unchanged", "left out"}
    assert {path: path.stat().st_mtime_ns for path in sorted(day.out.rglob("*")) if path.is_file()} == times
    assert again.passed == day.passed


def test_products_are_known_by_content(day: FieldDay, folder: Path) -> None:
    table = day.out / "agreement.csv"
    text, status = table.read_bytes(), table.stat()
    states = []
    for content, times in ((text, (1, 1)), (text.swapcase(), (status.st_atime_ns, status.st_mtime_ns))):
        table.write_bytes(content)
        os.utime(table, ns=times)
        again = run_field_day(folder / "collect.toml", skip=["report"])
        states += [each.state for each in again.outcomes if each.step == "validate"]
    table.write_bytes(text)
    assert states == ["unchanged", "failed"]


def test_a_step_is_done_again_after_its_product_or_the_form_of_its_record_was_lost(
    day: FieldDay, folder: Path
) -> None:
    # Sizes and times, which earlier versions recorded, are no reason to refuse
    (day.out / "agreement.csv").unlink()
    record = json.loads((day.out / RECORD).read_text())
    record["dirsig"]["products"] = {"dirsig": "0" * 64}
    (day.out / RECORD).write_text(json.dumps(record))
    again = run_field_day(folder / "collect.toml", skip=["report"])
    states = {outcome.step: outcome.state for outcome in again.outcomes}
    assert states["validate"] == states["dirsig"] == "done"
    assert states["signatures"] == states["map"] == "unchanged"


def test_a_new_product_is_one_declaration(
    day: FieldDay, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The engine decides whether it is current, protects files of other programs, and reports it
    shutil.copytree(folder, tmp_path / "new")

    def count_paints(run: FieldDayRun) -> str:
        publish_file(run.out / "count.txt", str(hp.open_library(run.library).sizes).encode(), overwrite=True)
        return "counted"

    monkeypatch.setitem(field_day.STEPS, "count", Step("count.txt", count_paints, ("library",), ("library",)))
    states, others = [], [name for name in STEPS if name not in ("process", "count")]
    for content in (None, None, "of another program"):
        if content is not None:
            (tmp_path / "new" / "products" / "count.txt").write_text(content)
        count = run_field_day(tmp_path / "new", skip=others).outcomes[-1]
        states.append((count.step, count.state))
    assert states == [("count", "done"), ("count", "unchanged"), ("count", "failed")]
    assert run_field_day(tmp_path / "new", skip=others, overwrite=True).outcomes[-1].text == "counted"


def test_what_a_collect_does_not_have_is_said(day: FieldDay, folder: Path, tmp_path: Path) -> None:
    copied = tmp_path / "bare"
    shutil.copytree(folder, copied, ignore=shutil.ignore_patterns("products", "svc", "asd_reflectance"))
    text = (copied / "collect.toml").read_text(encoding="utf-8").replace("ground = ", "# ground = ")
    (copied / "collect.toml").write_text(text.partition("\n[[references]]")[0], encoding="utf-8")
    bare = run_field_day(copied / "collect.toml", skip=["dirsig", "report"])
    said = {outcome.step: outcome.text for outcome in bare.outcomes if outcome.state == "left out"}
    assert "[[references]]" in said["validate"]
    assert "[geometry] ground" in said["map"]
    assert bare.passed is None


def test_lines_make_one_map(folder: Path, tmp_path: Path) -> None:
    copied = tmp_path / "two"
    shutil.copytree(folder, copied, ignore=shutil.ignore_patterns("products"))
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


def test_steps_have_names(tmp_path: Path) -> None:
    with pytest.raises(hp.SchemaError, match="step-required"):
        run_field_day(tmp_path / "collect.toml", skip=["process", "albedo"])


def test_a_spoilt_record_and_a_kill_only_cost_time(
    day: FieldDay, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copied = tmp_path / "spoilt"
    shutil.copytree(folder, copied)
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
        with pytest.raises(KeyboardInterrupt):
            run_field_day(copied, skip=skip)
    again = run_field_day(copied, skip=skip)
    assert {one.step: one.state for one in again.outcomes}["validate"] == "unchanged"
    assert again.passed == day.passed is not None
    assert json.loads(record.read_text())["validate"]["inputs"] == kept["validate"]["inputs"]


def test_products_of_another_library_are_made_again(day: FieldDay, folder: Path, tmp_path: Path) -> None:
    copied = tmp_path / "other"
    shutil.copytree(folder, copied)
    library = copied / "products" / "paints.zarr"
    first = hp.open_library(library).load()
    shutil.rmtree(library)
    hp.write_library(first.isel(signature=slice(0, 3)), library)
    skip = ["map", "mosaic", "report"]
    again = run_field_day(copied, skip=skip)
    states = {outcome.step: outcome for outcome in again.outcomes}
    assert states["signatures"].state == "failed"
    assert "paints.zarr: written or changed by another program" in states["signatures"].text
    assert hp.open_library(library).sizes["signature"] == 3  # it is the user's
    used = run_field_day(copied, skip=["signatures", *skip])
    assert {one.step: one.text for one in used.outcomes}["dirsig"].endswith("3 materials")
    mended = run_field_day(copied, skip=skip, overwrite=True)
    states = {outcome.step: outcome for outcome in mended.outcomes}
    assert (
        {states[step].state for step in ("signatures", "validate", "dirsig")},
        hp.open_library(library).sizes["signature"],
    ) == ({"done"}, first.sizes["signature"])


@pytest.mark.filterwarnings("ignore:Use `@` matmul:PendingDeprecationWarning")  # rioxarray, of affine
def test_a_height_model_places_regions_and_is_looked_at_again(folder: Path, tmp_path: Path) -> None:
    copied = tmp_path / "dem"
    shutil.copytree(folder, copied, ignore=shutil.ignore_patterns("products"))
    line = hp.open_collect(copied / "author.toml")["flightlines/raw_0"].to_dataset()
    located = line.paint.locate()
    write_level_dem(copied / "dem.tif", located, line.attrs["ground"])
    text = re.sub(
        r"(?m)^ground = .*$", 'dem = "dem.tif"\ndem_heights = "ellipsoid"',
        (copied / "author.toml").read_text("utf-8"),
    )  # fmt: skip
    (copied / "collect.toml").write_text(text, encoding="utf-8")
    roof = hp.read_regions(copied / "regions.geojson")[0]
    x, y = np.round(roof.polygon).astype(int).T
    x, y = x.clip(0, line.sizes["cross_track"] - 1), y.clip(0, line.sizes["along_track"] - 1)
    corners = np.stack([located[name].values[y, x] for name in ("east", "north")], axis=-1)
    drawn = hp.Region("roof", corners, flightline="raw_0")
    crs = located["east"].attrs["crs"]
    hp.write_regions(hp.Regions((drawn,), "map", crs), copied / "drawn.geojson")
    skip = ["validate", "mosaic", "dirsig", "report"]
    day = run_field_day(copied, regions=copied / "drawn.geojson", skip=skip)
    states = {outcome.step: outcome for outcome in day.outcomes}
    assert {states[step].state for step in ("signatures", "map")} == {"done"}, str(day)
    (copied / "dem.tif").unlink()
    write_level_dem(copied / "dem.tif", located, line.attrs["ground"] - 20.0)
    day = run_field_day(copied, regions=copied / "drawn.geojson", skip=["signatures", *skip])
    assert {one.step: one.state for one in day.outcomes}["map"] == "done"


@pytest.mark.usefixtures("day")  # which writes the collect.toml
def test_regions_are_read_before_anything_is_processed(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(hp.SchemaError, match="file-not-found"):
        run_field_day(folder / "collect.toml", tmp_path / "none", regions=tmp_path / "typo.geojson")
    assert not (tmp_path / "none").exists()


def test_a_step_that_fails_does_not_end_the_day(
    day: FieldDay, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise hp.StoreError("the disk is full")

    (day.out / "raw_0.tif").unlink()
    (day.out / "agreement.csv").unlink()
    with monkeypatch.context() as patch:
        patch.setattr("hyperpaint.workflows.field_day.validate_files", refuse)
        again = hyperpaint("run", folder, "--skip", "report")
    assert again.exit_code == 2
    expect_words(again.output, "validate    failed", "the disk is full", "map         done")
    assert (day.out / "raw_0.tif").exists()


def test_proposed_paints_are_not_compared_by_name(day: FieldDay, folder: Path, tmp_path: Path) -> None:
    copied = tmp_path / "proposed"
    shutil.copytree(
        folder, copied, ignore=shutil.ignore_patterns("regions.geojson", "products", "truth.zarr")
    )
    shutil.copytree(day.out / "lot.zarr", copied / "products" / "lot.zarr")
    proposed = run_field_day(copied, skip=["map", "dirsig", "report"])
    outcome = {one.step: one for one in proposed.outcomes}["validate"]
    assert outcome.state == "left out"
    assert "--pairs" in outcome.text


def test_a_flight_cut_into_five_cubes_has_the_same_signatures(
    day: FieldDay, folder: Path, tmp_path: Path
) -> None:
    # ASD files and darks lie elsewhere as well; no bit of any paint differs
    cut = tmp_path / "cut"
    hp.simulate_collect(
        cut, lines=320, bands=24, columns=256, seed=0, clock_offset_s=0.0, samples=4, cubes=5, truth=False,
        fleet="solid",
    )  # fmt: skip
    (cut / "collect.toml").unlink()
    shutil.copy(folder / "regions.geojson", cut)
    for name in ("asd", "dark"):
        shutil.move(cut / name, tmp_path / name)
    elsewhere = ["--asd", str(tmp_path / "asd"), "--dark", str(tmp_path / "dark")]
    written = hyperpaint("init", cut, *elsewhere)
    assert "5 cubes, 1 dark" in written.output
    other = run_field_day(cut, skip=["validate", "map", "dirsig", "report"])
    one, five = (hp.open_library(each.out / "paints.zarr") for each in (day, other))
    assert set(one.data_vars) == set(five.data_vars)
    for name in one.data_vars:
        assert one[name].values.tobytes() == five[name].values.tobytes(), name


def test_paints_of_an_earlier_run_do_not_stand_for_those_that_failed(
    day: FieldDay, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise hp.SchemaError("no region holds a pixel")

    with monkeypatch.context() as patch:
        patch.setattr("hyperpaint.workflows.field_day.write_signatures", refuse)
        again = run_field_day(folder, specular_sky=True, skip=["map", "report"])
    states = {one.step: one.state for one in again.outcomes}
    assert day.passed is not None
    assert (day.out / "paints.zarr").exists()
    assert (states["signatures"], states["validate"], states["dirsig"]) == ("failed", "left out", "left out")
