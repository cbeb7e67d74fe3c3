"""The fault campaigns at small counts; and that each of them can fail."""

import dataclasses
import functools
import pickle
import random
import re
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support import judged_inputs
from support.refusals import expect_error

from campaigns import all_faults, judged_collects
from campaigns.faults import (
    bomb_table,
    bombs,
    disks,
    interruptions,
    long_texts,
    outcome,
    parsers,
    storage,
    store_sequences,
    times,
)
from campaigns.faults.outcome import Outcome
from hyperpaint.simulation import simulate_collect

pytestmark = pytest.mark.campaign


def run(function: Any, *arguments: Any) -> Outcome:
    # Return the outcome of one fault, or of several: all but the first argument are passed on
    made = Outcome("test")
    function(*arguments, made)
    return made


# --- parsers -----------------------------------------------------------------------------------------------

PARSERS = tuple(parsers.PARSERS)


@pytest.fixture(scope="session")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder: Path = tmp_path_factory.mktemp("seeds") / "collect"
    parsers.prepare(folder)
    return folder


def test_there_are_forty_parsers() -> None:
    assert len(PARSERS) >= 39


@pytest.mark.parametrize("name", PARSERS)
def test_mutated_inputs_are_read_or_refused_and_whole_ones_read(name: str, seeds: Path) -> None:
    if name in ("mesh-ply", "mesh-glb"):
        pytest.importorskip("trimesh")
    made = parsers.run_part(name, seeds, range(150))
    assert made.good, str(made.wrong)
    assert made.notes["refused"] > 20  # the mutations do damage
    assert made.notes["read"] > 0  # and do not only destroy
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for path in parsers.PARSERS[name].files(seeds):
            parsers.PARSERS[name].read(path)


@pytest.mark.parametrize("piece", ["short lines", "brackets", "beginning"])
@pytest.mark.parametrize("name", ["frame-index", "irradiance-csv", "control-points", "nmea", "library-text"])
def test_long_texts_take_time_with_their_size(name: str, piece: str, seeds: Path, tmp_path: Path) -> None:
    # another process that takes the cores for a moment is no growth: what is quadratic fails every time
    for attempt in range(3):
        folder = tmp_path / str(attempt)
        folder.mkdir()
        problems = long_texts.judge(name, piece, (10**6, 2 * 10**6, 4 * 10**6), folder, seeds)
        if not problems:
            break
    assert not problems


def test_a_number_names_an_input(seeds: Path) -> None:
    data = (seeds / "flight/raw_0.hdr").read_bytes()
    inputs = [parsers.mutated(data, "envi", number) for number in range(100)]
    assert inputs == [parsers.mutated(data, "envi", number) for number in range(100)]
    assert len(set(inputs)) > 90


def _wrong_error(path: Path) -> None:
    raise KeyError(path.name)


def _slow(path: Path) -> None:
    until = time.process_time() + 1.1
    while time.process_time() < until and path.name:
        pass


def _greedy(path: Path) -> None:
    np.ones(300 * 2**20, np.uint8)  # written, so resident; no more work, since time is limited too


@pytest.mark.parametrize(
    ("read", "text"), [(_wrong_error, "KeyError"), (_slow, "1.1"), (_greedy, "(30[0-9] MB|MemoryError)")]
)
def test_a_bad_parser_is_found(read: Any, text: str, seeds: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = iter([lambda _: None])  # the first call, on a whole file, is not judged
    bad = parsers.Parser(lambda path: next(calls, read)(path), (), ("sky.csv",))
    monkeypatch.setattr(parsers, "PARSERS", {"bad": bad})
    made = parsers.run_part("bad", seeds, range(1))
    assert not made.good
    assert len(made.wrong) == 1
    assert re.search(text, made.wrong[0])


# --- bombs -------------------------------------------------------------------------------------------------

in_a_fork = [
    pytest.mark.timeout(0),  # a child ends by an alarm of its own, for which pytest-timeout would answer
    pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="memory is counted by Linux"),
    # the child never comes back to where the warning could matter
    pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning"),
    pytest.mark.usefixtures("warm"),
]
#: Each stands for a kind; the campaign `bombs` tries them all.
QUICK = (
    ("envi_with_10_to_12_samples", "envi"),
    ("envi_product_overflows_to_the_right_size", "envi"),
    ("envi_path_in_the_header", "envi"),
    ("asd_with_65535_channels", "asd"),
    ("frame_number_of_10_to_18", "frame-index"),
    ("pipe_in_place_of_a_file", "irradiance"),
    ("toml_key_of_100000_parts", "collect"),
    ("toml_pattern_of_stars_around_in_links", "collect"),
    ("toml_names_a_pipe", "collect"),
    ("json_50000_deep", "open-store"),
    ("json_of_10_million_lists", "info"),
    ("metadata_are_a_pipe", "info"),
    ("codec_numcodecs_pickle", "calibration"),
    ("format_2_text_and_pickle", "library"),
    ("shape_10_to_12_in_one_chunk", "verify"),
    ("index_of_a_gigabyte", "irradiance"),
    ("shard_of_huge_inner_chunks", "open-store"),
    ("a_gigabyte_without_chunks", "calibration"),
    ("texts_of_a_gigabyte", "library"),
    ("text_of_four_billion_items", "calibration"),
    ("zip_with_metadata_of_100_mb", "open-store"),
    ("manifest_of_10_to_12_chunks", "open-store"),
    ("groups_600_deep", "verify"),
    ("groups_beyond_the_longest_path", "info"),
    ("staged_group_leads_out", "writer"),
)
BLIND = (
    (
        "metadata_are_an_endless_device",
        lambda path: xr.open_zarr(path, consolidated=False).load(),
        "MemoryError|MB|hung",
    ),
    # unpickles a chunk, as numcodecs did before 0.16.6
    (
        "codec_numcodecs_pickle",
        lambda path: pickle.loads((path / "radiance_gain/c/0/0").read_bytes()),
        "code was run",
    ),
    (
        "many_documents_of_30_mb",
        lambda path: xr.open_zarr(path, consolidated=False).load(),
        "it was read|[0-9]{3} MB",
    ),
    ("metadata_are_a_pipe", lambda path: (path / "radiance_gain/zarr.json").read_bytes(), "hung"),
)


@pytest.fixture(scope="session")
def warm() -> None:
    bombs.warm_up()


class TestBombs:
    pytestmark = in_a_fork

    @pytest.mark.parametrize(("name", "door"), QUICK)
    def test_a_bomb_is_refused(self, name: str, door: str) -> None:
        made = run(bombs.run_bomb, name, door)
        assert made.good, str(made.wrong)
        assert made.notes["refused"] == 1

    @pytest.mark.parametrize(("name", "read", "text"), BLIND)
    def test_a_blind_reader_is_found(self, name: str, read: Any, text: str, monkeypatch: Any) -> None:
        if "hung" in text:
            monkeypatch.setattr(bombs, "_HANGS", 2)
        made = Outcome("test")
        bombs.run_bomb(name, "open-store", made, {"open-store": bombs.Door(read, (bombs.StoreError,))})
        assert not made.good
        assert re.search(text, made.wrong[0]), made.wrong


def test_there_are_enough_bombs_for_every_door() -> None:
    assert len(bomb_table.BOMBS) >= 136
    assert len(bombs.tries()) >= 460
    assert set(QUICK) <= set(bombs.tries())
    assert {door for _, door in bombs.tries()} == set(bombs.DOORS)


@pytest.mark.parametrize("how", [{}, {"zarr_format": 2}, {"ours": True}])
def test_the_stores_of_bombs_are_let_in(how: Any, tmp_path: Path) -> None:
    store = bomb_table.whole_store(tmp_path, **how)
    for door in bomb_table.STORE_DOORS.split():
        bombs.DOORS[door].read(store)


# --- damaged stores ----------------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def stores(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stores")
    storage.build(folder)
    return folder


@pytest.mark.parametrize("kind", storage.COUNTS)
def test_no_fault_of_a_store_is_missed(kind: str, stores: Path) -> None:
    for made in storage.run_part(stores, kind, range(6)):
        assert made.good, str(made.wrong)


def test_blind_readers_of_a_store_are_found(stores: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = storage.hp.verify(stores / "store.zarr")
    with monkeypatch.context() as patch:
        patch.setattr(storage.hp, "verify", lambda _: whole)
        assert len(storage.run_part(stores, "bit flip", range(3))[0].wrong) == 3
    monkeypatch.setattr("hyperpaint.io.store.reader.check_entry", lambda *_: None)
    assert any("missed" in text for text in storage.run_part(stores, "deletion", range(20))[1].wrong)
    values = {storage.GROUP: xr.open_zarr(stores / "store.zarr", group=storage.GROUP).load()}
    assert storage._plain(stores / "store.zarr", values) == "same"
    assert storage._plain(stores / "older.zarr", values) == "missed"


# --- writers -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "numbers"),
    [
        pytest.param("slow group", range(1), marks=pytest.mark.slow),
        pytest.param("slow group replaced", range(1, 2), marks=pytest.mark.slow),
        pytest.param("run of 40 lines replaced", range(5, 6), marks=pytest.mark.slow),
        # SIGKILL, SIGTERM and SIGINT in turn
        *(
            pytest.param(name, range(number, number + 1), marks=pytest.mark.slow)
            for number, name in enumerate(("orthorectify", "export", "site"))
        ),
        ("new group", range(3, 1000, 23)),
        ("group replaced", range(3, 1000, 23)),
        ("root replaced", range(3, 1000, 23)),
        ("by two renames", range(3, 1000, 23)),
        pytest.param("run of 2 lines replaced", (30, 60), marks=pytest.mark.slow),
    ],
)
def test_disturbed_writers_leave_nothing_half_written(name: str, numbers: Any, tmp_path: Path) -> None:
    if name == "orthorectify":
        pytest.importorskip("rasterio")
        pytest.importorskip("pyproj")
    work = interruptions.WORKS[name]
    if "40 lines" in name:  # a third of them, in a third of the time; the runs in a row are as many
        work = dataclasses.replace(work, inputs=functools.partial(interruptions.collects, 13))
    writer = interruptions.Writer(name, tmp_path, work)
    made: list[Outcome] = []
    if work.kills:
        made += outcome.each(name, numbers, interruptions.run_kills, writer)
    if work.calls != 0:
        at = numbers if work.calls is None else (writer.calls // 3, writer.calls)
        called = [number for number in at if number <= writer.calls]
        for code in work.codes if work.calls is None else (None,):
            made += outcome.each(name, called, interruptions.run_call, writer, code)
        assert len(called) >= 2
    (total,) = outcome.total(made)
    assert total.good, str(total.wrong)


def test_of_two_writers_one_is_what_the_store_holds(tmp_path: Path) -> None:
    writer = interruptions.Writer("slow group", tmp_path)
    (made,) = outcome.each("races", range(1), interruptions.run_race, writer)
    assert made.good, str(made.wrong)


def test_a_mixed_store_is_found(tmp_path: Path) -> None:
    writer = interruptions.Writer("group replaced", tmp_path)
    home = writer.begin(tmp_path / "home")
    assert writer.found(home) == "older"
    key = f"lot.zarr/{interruptions.GROUP}/counts/c/1/0/0"
    (home / key).write_bytes((tmp_path / "newer" / key).read_bytes())
    assert not interruptions.hp.verify(home / "lot.zarr").ok
    assert writer.found(home).startswith("mixed (it is opened, but verify says")
    assert "is left" in run(writer.judge, "fault", home).wrong[0]


# --- disks -------------------------------------------------------------------------------------------------


@pytest.fixture
def undisturbed(tmp_path: Path) -> Any:
    if not disks.can_mount():
        pytest.skip("mounting a disk needs root on Linux")
    return disks.undisturbed(tmp_path)


@pytest.mark.slow
def test_disks_that_fill_up(undisturbed: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    made = outcome.total(outcome.each("full", (0, 14, 29), disks.run_full, *undisturbed))[0]
    assert made.good, str(made.wrong)
    assert made.notes["stopped"] == 3
    # a store that looks finished is found
    expected, total = undisturbed
    monkeypatch.setattr(disks, "looks_finished", lambda *_: True)
    (made,) = outcome.each("full", (4,), disks.run_full, expected | {"counts/c/3/0/0": b"other"}, total)
    assert len(made.wrong) == 2
    assert made.wrong[0].endswith("looks finished")
    assert "differs from an undisturbed run" in made.wrong[1]


@pytest.mark.slow
def test_folders_that_vanish(undisturbed: Any) -> None:
    numbers = range(len(disks.FOLDERS))
    (made,) = outcome.total(outcome.each("folders", numbers, disks.run_folder, undisturbed[0]))
    assert made.good, str(made.wrong)
    assert made.notes["stopped"] >= len(disks.FOLDERS) - 2


@pytest.mark.slow
def test_sources_that_vanish(tmp_path: Path) -> None:
    numbers = range(len(disks.SOURCES))
    (made,) = outcome.total(outcome.each("sources", numbers, disks.run_source, *disks.processed(tmp_path)))
    assert made.good, str(made.wrong)
    assert made.notes["stopped"] == len(disks.SOURCES)


# --- sequences ---------------------------------------------------------------------------------------------


def test_sequences_keep_the_set_what_it_is_wanted_to_be(monkeypatch: pytest.MonkeyPatch) -> None:
    store_sequences.run_sequences(6, 6, derandomize=True)
    # a store that is always whole is found
    state = store_sequences.store_state
    monkeypatch.setattr(store_sequences, "store_state", lambda location: type(state(location))())
    expect_error(AssertionError, None, lambda: store_sequences.run_sequences(20, 6, derandomize=True))


# --- time --------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_faults_of_time_are_told() -> None:
    for made in times.run_part(False, range(len(times.FAULTS))):
        assert made.good, str(made.wrong)


def test_clean_flights_raise_no_alarm() -> None:
    for made in times.run_part(True, range(2)):
        assert not made.wrong


def test_a_wrong_reflectance_without_a_word_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    def double_the_exposure(folder: Path, _: random.Random) -> None:
        for name, before in (
            ("collect.toml", "exposure_time_ms"),
            ("flight/settings.txt", "(ms)"),
            ("flight/raw_0.hdr", ";Exposure (ms)"),
            ("dark/raw_0.hdr", ";Exposure (ms)"),
            ("dark/settings.txt", "(ms)"),
        ):
            times._replace(folder / name, f"{before} = 5.0", f"{before} = 2.5")

    monkeypatch.setattr(times, "FAULTS", {"exposure": double_the_exposure})
    (made,) = times.run_part(False, range(1))
    assert len(made.wrong) == 1
    assert "wrong by 100" in made.wrong[0]


# --- wrong scales ------------------------------------------------------------------------------------------

#: Faults that need no collect of their own, each at its first strength.
QUICK_FAULTS = (
    "record behind a filter",
    "one scan shaded",
    "one scan without light",
    "zero channels",
    "clipped channels",
    "filled channels",
    "gain x 1000",
    "gain per ms",
    "exposure",
    "order of the gain",
    "swath blocked",
    "dark with scene light",
    "counts left-justified",
    "step in the record",
)
QUICK_RIGHT = (
    "snow",
    "water",
    "dark",
    "short",
    "narrow",
    "camera of 16 bits",
    "bright roofs",
    "shadow along the track",
    "road along the track",
    "record of three digits",
    "panel",
    "white reference",
)


@pytest.fixture(scope="session")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder: Path = tmp_path_factory.mktemp("small") / "c"
    simulate_collect(
        folder,
        scene="plan",
        seed=17,
        lines=96,
        bands=48,
        columns=32,
        irradiance_noise=0.002,
        irradiance_margin_s=30.0,
    )
    return folder


@pytest.mark.parametrize("fault", QUICK_FAULTS)
def test_a_wrong_scale_is_named_by_its_check(fault: str, small: Path, tmp_path: Path) -> None:
    path = judged_inputs.wrong_scale(tmp_path / "c", fault, 0, 17, small)
    said = judged_collects.Verdict(judged_collects.said_of(path)).said(judged_inputs.FAULTS[fault].words)
    assert said in ("named", "refused")


@pytest.mark.parametrize("kind", QUICK_RIGHT)
def test_right_ones_that_resemble_them_pass(kind: str, tmp_path: Path) -> None:
    assert judged_collects.said_of(judged_inputs.right_input(tmp_path / "c", kind, 17)) == []


# --- the table ---------------------------------------------------------------------------------------------


def test_parts_add_up() -> None:
    parts = [
        Outcome("one", 3, ["a"], seconds=0.1),
        Outcome("two", 1, allowed=1),
        Outcome("one", 4, ["b"], seconds=0.3, memory=5),
    ]
    one, two = outcome.total(parts)
    assert (one.count, one.wrong, one.seconds, one.memory, one.good) == (7, ["a", "b"], 0.3, 5, False)
    assert (two.count, two.allowed, two.good) == (1, 1, True)
    assert "FAILED" in str(one)
    assert "held" in str(two)


def test_command_refuses_unknown_campaigns(capsys: pytest.CaptureFixture[str]) -> None:
    expect_error(SystemExit, None, lambda: all_faults.main(["--only", "parsers,weather"]))
    assert f"no campaign weather; there are {', '.join(all_faults.CAMPAIGNS)}" in capsys.readouterr().err
