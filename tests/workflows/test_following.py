"""A flight that is followed ends in the store of the batch, whatever happens on the way."""

from __future__ import annotations

import itertools
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.flown_writers import Recording

import hyperpaint as hp
from hyperpaint.base.errors import CollectError
from hyperpaint.io.flightline.growing import GrowingTable, growing_cubes
from hyperpaint.io.store.stage import Staging, staging
from hyperpaint.simulation import simulate_collect
from hyperpaint.workflows import flight_blocks, following as followed, pipeline
from hyperpaint.workflows.following import FlightState, Following, follow
from hyperpaint.workflows.pipeline import run

LINE = "flightlines/raw_0"
LINES, SLABS = 200, 6
pytestmark = pytest.mark.filterwarnings("ignore::hyperpaint.base.errors.PaintWarning")


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flown") / "source"
    options: dict[str, Any] = {"irradiance_interval_s": 1, "frame_period_ms": 20.0, "exposure_time_ms": 5.0}
    simulate_collect(folder, scene="plan", lines=LINES, bands=8, columns=6, truth=False, **options)
    return folder


@pytest.fixture(scope="module")
def batch(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    store = tmp_path_factory.mktemp("batch") / "lot.zarr"
    run(source / "collect.toml", store)
    return store


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(followed, "QUIET_S", 0.1)
    monkeypatch.setattr(followed, "POLL_S", 0.02)


@pytest.fixture
def dropped(monkeypatch: pytest.MonkeyPatch) -> dict[str, set[int]]:
    """Slabs of which something written in flight was not taken up, by array."""
    slabs: dict[str, set[int]] = {}
    forget = flight_blocks.FlightBlocks.forget

    def noted(self: Any, wrong: Any, names: Any) -> None:
        wrong, names = list(wrong), list(names)
        for name in names:
            slabs.setdefault(name, set()).update(wrong)
        forget(self, wrong, names)

    monkeypatch.setattr(flight_blocks.FlightBlocks, "forget", noted)
    return slabs


def looks(recording: Recording, store: Path, view: Path, times: Any) -> list[FlightState]:
    """Follow a flight up to some of its times, and stop there, as killed: nothing is put right."""
    states = []
    with staging(store, Staging(store).begun()) as stage:
        following = Following(recording.flight.parent / "collect.toml", stage, view)
        for time in times:
            recording.record(time)
            while following.look():
                pass
            states.append(FlightState(**vars(following.state)))
        following.close()
    return states


def same_content(one: Path, other: Path) -> bool:
    """Tell whether two stores hold the same bits, attributes of the writing left out."""
    first, second = (xr.open_datatree(path, engine="zarr") for path in (one, other))
    assert {node.path for node in first.subtree} == {node.path for node in second.subtree}
    for node in first.subtree:
        a, b = (tree[node.path].to_dataset() for tree in (first, second))
        for dataset in (a, b):
            for name in (
                "history",
                "created",
                "hyperpaint_complete",
                "hyperpaint_attributes",
                "hyperpaint_set",
            ):
                dataset.attrs.pop(name, None)
        xr.testing.assert_identical(a, b)
    chunks = [
        {
            path.relative_to(store): path.read_bytes()
            for path in (store / LINE).rglob("c/**/*")
            if path.is_file()
        }
        for store in (one, other)
    ]
    assert chunks[0] == chunks[1]
    hp.verify(one)
    return True


@pytest.mark.parametrize("header", ["planned", "zero", "late"])
def test_what_is_written_in_flight_is_that_of_the_batch(
    source: Path, batch: Path, tmp_path: Path, dropped: dict[str, set[int]], header: str
) -> None:
    recording, store = Recording(source, tmp_path / "copy", header=header), tmp_path / "lot.zarr"
    states = looks(recording, store, tmp_path / "view", np.arange(-6.0, recording.length_s, 0.37))
    assert states[-1].done == SLABS * 32
    assert all(one.done <= other.done for one, other in itertools.pairwise(states))
    assert states[-1].flagged[hp.Quality.NO_DATA] == 0
    recording.finish()
    assert follow(recording.flight, store).written[0] == LINE
    assert same_content(store, batch)
    # but for the last lines, which fill no slab, nothing was made again
    assert dropped["counts"] == {SLABS}
    assert len(dropped["reflectance"]) <= 2


def test_a_store_that_is_whole_has_nothing_left_beside_it(source: Path, batch: Path, tmp_path: Path) -> None:
    store = tmp_path / "lot.zarr"
    shutil.copytree(batch, store)
    assert follow(source / "flight", store, collect=source / "collect.toml", idle=0.2).written == ()
    assert [path.name for path in tmp_path.iterdir()] == ["lot.zarr"]


def test_lines_wait_for_places_and_for_the_light_after_them(source: Path, tmp_path: Path) -> None:
    recording = Recording(source, tmp_path / "copy")
    spectra, recording._spectra = recording._spectra, recording._spectra[:6]  # up to 4 s before
    (state,) = looks(recording, tmp_path / "lot.zarr", tmp_path / "view", [recording.length_s])
    assert state.lines == LINES
    assert state.done == 0
    assert "irradiance record covers" in state.waits_for
    recording._spectra = spectra
    poses, recording._poses = recording._poses, recording._poses[:1]
    recording.at = [LINES, 0, 6]
    (recording.flight / "imu_gps.txt").write_bytes(b"".join(poses[:300]))  # 2 s before the line, 1 s of it
    (state,) = looks(recording, tmp_path / "lot.zarr", tmp_path / "view", [recording.length_s])
    assert state.done == 32
    assert "32 of 200 lines" in str(state)


def test_a_killed_follower_goes_on_where_it_was(
    source: Path, batch: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording, store = Recording(source, tmp_path / "copy"), tmp_path / "lot.zarr"
    looks(recording, store, tmp_path / "view", [1.0, 2.4])
    (folder,) = (tmp_path / ".partial-lot.zarr").glob("build-*")
    written = {path: path.stat().st_mtime_ns for path in folder.rglob("c/*/0/0")}
    assert len(written) > 3
    with open(folder / "slabs.log", "a") as log:  # killed while it wrote that
        log.write("3 0123456789abcdef")
    states = looks(recording, store, tmp_path / "view", [2.4, recording.length_s])
    assert 0 < states[0].done < states[-1].done
    assert all(path.stat().st_mtime_ns == time for path, time in written.items())
    recording.finish()
    follow(recording.flight, store)
    assert same_content(store, batch)


def test_blocks_of_other_counts_or_another_calibration_are_made_anew(
    source: Path, tmp_path: Path, dropped: dict[str, set[int]]
) -> None:
    recording, store = Recording(source, tmp_path / "copy"), tmp_path / "lot.zarr"
    looks(recording, store, tmp_path / "view", np.arange(0.0, recording.length_s, 0.5))
    recording.finish()
    cube = np.memmap(recording.flight / "raw_0", "<u2", "r+").reshape(LINES, 8, 6)
    cube[40, 3, 2] += 1  # of slab 1
    cube.flush()
    run_again = pipeline.run
    collect = recording.flight.parent / "collect.toml"
    collect.write_text(collect.read_text() + '\n[alignment]\napply = "never"\n')
    outcome = follow(recording.flight, store)
    assert outcome.written[0] == LINE
    assert dropped["counts"] == {1, SLABS}
    run_again(collect, tmp_path / "again.zarr")
    assert same_content(store, tmp_path / "again.zarr")


def test_a_dark_after_the_flight_leaves_only_the_counts_to_the_flight(
    source: Path, batch: Path, tmp_path: Path, dropped: dict[str, set[int]]
) -> None:
    recording, store = Recording(source, tmp_path / "copy"), tmp_path / "lot.zarr"
    dark = tmp_path / "copy" / "dark"
    dark.rename(tmp_path / "dark")
    states = looks(recording, store, tmp_path / "view", np.arange(0.0, recording.length_s, 0.5))
    assert states[-1].done == 0
    assert "dark" in states[-1].waits_for
    recording.finish()
    (tmp_path / "dark").rename(dark)
    folder = next((tmp_path / ".partial-lot.zarr").glob("build-*"))
    assert {path.parent.parent.name for path in folder.glob("counts/c/*/0/0")} == set("012345")
    assert not list(folder.glob("reflectance/c"))
    follow(recording.flight, store, idle=0.5)
    assert same_content(store, batch)


def test_cubes_that_follow_one_another_are_one_line(tmp_path: Path) -> None:
    options: dict[str, Any] = {"irradiance_interval_s": 1, "frame_period_ms": 20.0, "cubes": 2}
    collect = simulate_collect(
        tmp_path / "lot", scene="plan", lines=160, bands=5, columns=4, truth=False, **options
    )
    text = collect.read_text()
    tables = [part for part in text.split("[[flightlines]]") if "references" in part or "[collect]" in part]
    references = tables[-1][tables[-1].index("[[references]]") :]
    pattern = '[[flightlines]]\ncube = "flight/raw_*.hdr"\n\n'
    collect.write_text(tables[0] + pattern + references)
    flight, store = collect.parent / "flight", tmp_path / "lot.zarr"
    second = [flight / name for name in ("raw_80", "raw_80.hdr", "frameIndex_80.txt")]
    away = [path.rename(tmp_path / path.name) for path in second]
    with staging(store) as stage:
        following = Following(collect, stage, tmp_path / "view")
        while following.look():
            pass
        assert following.state.lines == 80
        assert following.state.done == 64
        for path, place in zip(away, second, strict=True):
            path.rename(place)
        while following.look():
            pass
        assert following.state.done == 160
        following.close()
    outcome = follow(flight, store, idle=0.5)
    run(collect, tmp_path / "batch.zarr")
    assert outcome.written[0] == LINE
    assert same_content(store, tmp_path / "batch.zarr")


def test_when_a_flight_has_ended(source: Path, tmp_path: Path) -> None:
    now = [0.0]
    recording, store = Recording(source, tmp_path / "copy"), tmp_path / "lot.zarr"
    with staging(store) as stage:
        collect = tmp_path / "copy" / "collect.toml"
        following = Following(collect, stage, tmp_path / "view", clock=lambda: now[0])
        following.look()
        assert not following.has_ended(10.0)  # nothing has come
        recording.record(1.0)
        following.look()
        now[0] = 9.0
        assert not following.has_ended(10.0)
        now[0] = 11.0
        assert following.has_ended(10.0)
        recording.finish()
        while following.look():
            pass
        assert not following.has_ended(10.0)  # more may come
        now[0] += 0.2
        assert following.has_ended(10.0)  # all lines of the header, and their light
        following.close()


def test_what_goes_wrong_is_said(source: Path, tmp_path: Path) -> None:
    with pytest.raises(CollectError, match="collect-missing"):
        follow(tmp_path / "flight")
    recording = Recording(source, tmp_path / "copy")
    (recording.flight / "raw_0.hdr").write_text(recording._header.replace("bil", "bsq"))
    (state,) = looks(recording, tmp_path / "lot.zarr", tmp_path / "view", [2.0])
    assert "bsq" in state.waits_for


def test_only_complete_rows_count(tmp_path: Path) -> None:
    path = tmp_path / "table.txt"
    table = GrowingTable(path)
    assert table.grow() == 0
    path.write_bytes(b"a\tb\n1\t2\n3")
    assert table.grow() == 1
    with path.open("ab") as file:
        file.write(b"\t4\n\n5\t6\n")
    assert table.grow() == 3
    table.write(tmp_path / "part.txt", 1, 2)
    assert (tmp_path / "part.txt").read_bytes() == b"a\tb\n3\t4\n"


def test_cubes_are_found_with_a_header_or_without(tmp_path: Path) -> None:
    for name in ("raw_0", "raw_0.hdr", "raw_200", "raw_1000", "frameIndex_0.txt"):
        (tmp_path / name).touch()
    names = ["raw_0", "raw_200", "raw_1000"]
    for text in ("raw_*.hdr", ".", str(tmp_path / "raw_*")):
        assert [path.name for path in growing_cubes(tmp_path, text)] == names
    assert [path.name for path in growing_cubes(tmp_path, "raw_0.hdr")] == ["raw_0"]
    assert growing_cubes(tmp_path, "raw_1.hdr") == []


@pytest.mark.slow
def test_a_follower_that_is_killed_in_a_line_ends_in_the_same_bits(
    source: Path, batch: Path, tmp_path: Path
) -> None:
    recording, store = Recording(source, tmp_path / "copy"), tmp_path / "lot.zarr"
    command = [sys.executable, "-m", "hyperpaint", "follow", str(recording.flight), "--out", str(store)]
    for kill in (1.5, 2.7):
        recording.record(kill)
        process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        folder = tmp_path / ".partial-lot.zarr"
        written = 32 * int(kill - 1)
        while len(list(folder.glob("build-*/reflectance/c/*/0/0"))) * 32 < written:
            assert process.poll() is None
        process.kill()
        process.wait()
    process = subprocess.Popen([*command, "--idle", "2"], stdout=subprocess.PIPE, text=True)
    recording.finish()
    said, _ = process.communicate(timeout=120)
    assert process.returncode == 0
    assert f"wrote /{LINE}" in said
    assert same_content(store, batch)
    shutil.rmtree(store)
