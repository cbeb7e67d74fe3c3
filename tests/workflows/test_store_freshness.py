"""`process` again: what is the same is left alone, what is not is told, and inputs are never written over."""

import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.tiny_collects import tiny_collect

import hyperpaint as hp
from hyperpaint.io.files import reading
from hyperpaint.io.files.reading import sampled_digest
from hyperpaint.workflows.pipeline import compare_inputs, run
from hyperpaint.workflows.products import finishing_command, paths_in

LINES = ("flightlines/raw_0", "flightlines/raw_1")


@pytest.fixture
def collect(tmp_path: Path) -> Path:
    return tiny_collect(tmp_path / "raw", 2)


@pytest.fixture
def store(collect: Path, tmp_path: Path) -> Path:
    return process(collect, tmp_path / "lot.zarr").path


def process(collect: Path, out: Path, **options: Any) -> Any:
    return run(collect, out, to="radiance", **options)


def test_a_copied_collect_is_the_same(collect: Path, store: Path, tmp_path: Path) -> None:
    shutil.copytree(collect.parent, tmp_path / "copy", copy_function=shutil.copyfile)
    for file in collect.parent.iterdir():
        os.utime(file, (1e9, 1e9))
    assert (process(collect, store).written, process(tmp_path / "copy" / "collect.toml", store).written) == (
        (),
        (),
    )


def test_a_cube_of_other_content_is_told_whatever_its_times(collect: Path, store: Path) -> None:
    cube = collect.with_name("raw_1")
    status = cube.stat()
    values = np.fromfile(cube, "<f4")
    values[7] += 1
    values.tofile(cube)
    os.utime(cube, ns=(status.st_atime_ns, status.st_mtime_ns))
    with pytest.raises(hp.StoreError, match=r"raw_1 .*store-exists") as caught:
        process(collect, store)
    assert "raw_0" not in str(caught.value)
    assert process(collect, store, overwrite=True).written == (LINES[1],)


@pytest.mark.parametrize(
    ("old", "new"), [("interleave = bil", "interleave = bip"), ("byte order = 0", "byte order = 1")]
)
def test_another_header_makes_other_values_of_the_same_file(
    old: str, new: str, collect: Path, store: Path
) -> None:
    header = collect.with_name("raw_1.hdr")
    assert old in header.read_text()
    header.write_text(header.read_text().replace(old, new))
    with pytest.raises(hp.StoreError, match=r"raw_1 .*store-exists"):
        process(collect, store)


def test_the_command_that_finishes_a_run_names_its_options() -> None:
    options = {
        "--to": "radiance",
        "--accept": ["dark-of-zeros", "a b"],
        "--overwrite": True,
        "--alignment": None,
    }
    command = finishing_command("process lot.toml", options)
    assert command == (
        "hyperpaint process lot.toml --out {store} --to radiance --accept dark-of-zeros --accept 'a b' "
        "--overwrite"
    )


def test_large_files_are_told_apart_by_samples(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reading, "SAMPLES", 4)
    monkeypatch.setattr(reading, "SAMPLE_BYTES", 16)
    content = np.random.default_rng(1).bytes(1000)
    (tmp_path / "cube").write_bytes(content)
    digest = sampled_digest(tmp_path / "cube")
    for place in (0, 330, 660, 999):
        changed = bytearray(content)
        changed[place] ^= 1
        (tmp_path / "cube").write_bytes(changed)
        assert sampled_digest(tmp_path / "cube") != digest
    for other in (content[:-1], content + b"\0", bytes(1000)):
        (tmp_path / "cube").write_bytes(other)
        assert sampled_digest(tmp_path / "cube") != digest


def test_other_numerics_are_said_and_computed_on_request(
    collect: Path, store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("workflows.pipeline", "workflows.products", "io.store.manifest"):
        monkeypatch.setattr(f"hyperpaint.{module}.NUMERICS_VERSION", 7)
    report = hp.verify(store)
    assert report.ok
    assert report.notes == ("made by numerics 1, this is 7: --overwrite computes it again",)
    with pytest.raises(hp.StoreError, match=r"version 1 of the numerics;.*store-ex"):
        process(collect, store)
    assert (process(collect, store, overwrite=True).written, hp.verify(store).notes) == (LINES, ())


def test_other_settings_cut_short_are_not_whole(
    collect: Path, store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from hyperpaint.io.store.writer import WholeRun

    write = WholeRun.write

    def stop(self: WholeRun, group: str, dataset: xr.Dataset, **options: Any) -> None:
        if group == LINES[1]:
            raise KeyboardInterrupt
        write(self, group, dataset, **options)

    collect.write_text(collect.read_text().replace("frame_period_ms = 7.0", "frame_period_ms = 8.0"))
    with monkeypatch.context() as patch:
        patch.setattr(WholeRun, "write", stop)
        with pytest.raises(KeyboardInterrupt):
            process(collect, store, overwrite=True)
    report = hp.verify(store)
    assert "unfinished: 1 of 2 groups are written, without /flightlines/raw_1" in str(report)
    assert report.resume == f"hyperpaint process {collect} --out {store} --to radiance --overwrite"
    assert process(collect, store, overwrite=True).written == (LINES[1],)
    assert hp.verify(store).ok


@pytest.mark.parametrize("overwrite", [True, False])
def test_inputs_are_never_written_over(collect: Path, store: Path, overwrite: bool, tmp_path: Path) -> None:
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    for out in (collect.parent, tmp_path, collect.parent / ".." / "raw"):
        with pytest.raises(hp.StoreError, match="output-is-input") as caught:
            process(collect, out, overwrite=overwrite)
        assert "whether or not it may overwrite" in str(caught.value)
    inside = tiny_collect(store / "raw", 1)
    with pytest.raises(hp.StoreError, match=r"raw_0.*output-is-input"):
        process(inside, store, overwrite=overwrite)
    shutil.rmtree(store / "raw")
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_a_folder_with_a_calibration_is_no_damaged_store(tmp_path: Path) -> None:
    field = tmp_path / "field"
    hp.to_store(xr.Dataset({"radiance_gain": ("band", [1.0])}), field / "calibration.zarr")
    before = sorted(field.rglob("*"))
    for name in (None, "flightlines/raw_0"):
        with pytest.raises(hp.StoreError, match="store-foreign"):
            hp.to_store(xr.Dataset({"a": ("x", [1.0])}), field, name, overwrite=True)
    assert sorted(field.rglob("*")) == before


def test_paths_are_found_in_whatever_names_them(tmp_path: Path) -> None:
    one, two, three = (tmp_path / name for name in "abc")
    settings = {"cubes": [one, (two, "no path")], "more": {"deep": {three}}, "type": Path, "none": None}
    assert set(paths_in(settings)) == {one, two, three}


def test_inputs_are_compared_whole(
    collect: Path, store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    report = compare_inputs(store)
    assert (report.collect, report.blocks, report.problems) == (collect, 2, ())
    assert "all unchanged" in str(report)
    # what no sample shows
    monkeypatch.setattr("hyperpaint.workflows.pipeline.sampled_digest", lambda _: "same")
    run(collect, store, to="radiance", overwrite=True)
    assert compare_inputs(store).problems == ()
    cube = collect.with_name("raw_1")
    values = np.fromfile(cube, "<f4")
    values[7] += 1
    values.tofile(cube)
    assert compare_inputs(store).problems == (
        f"/{LINES[1]}: radiance, lines 0 to 5: differs from the stored samples",
    )
    hp.to_store(xr.Dataset({"a": ("x", [1.0])}), store, "signatures")
    os.rename(collect.parent, tmp_path / "elsewhere")
    with pytest.raises(hp.StoreError, match="file-not-found"):
        compare_inputs(store)
    moved = tmp_path / "elsewhere/collect.toml"
    moved.write_text(moved.read_text().replace("7.0", "8.0", 1))
    assert [text[:19] for text in compare_inputs(store, moved).problems] == [
        "/flightlines/raw_0:",
        "/flightlines/raw_1:",
    ]


def test_inputs_of_other_stores_are_not_known(tmp_path: Path) -> None:
    hp.to_store(xr.Dataset({"a": ("x", [1.0])}), tmp_path / "lot.zarr", "a")
    with pytest.raises(hp.StoreError, match="inputs-unrecorded"):
        compare_inputs(tmp_path / "lot.zarr")
