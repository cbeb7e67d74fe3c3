"""The fault campaigns at small counts; and that each of them can fail."""

from __future__ import annotations

import importlib
import random
import re
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support import ROOT

pytestmark = pytest.mark.campaign

PARSERS = (
    *("envi", "asd", "asd-text", "asd-open", "svc", "irradiance-csv", "irradiance-open"),
    *("frame-index", "imu-gps", "sbet", "lcf", "eph-att", "nav-csv", "settings", "gps-time", "collect-toml"),
    *("uvspec", "tape7", "sixs", "sky-csv"),
    *("nmea", "control-points", "radcal", "certificate", "light-table"),
    *("mesh-obj", "mesh-ply", "mesh-glb", "regions", "pairs", "geotiff", "heights", "scene-toml"),
    *("dirsig-ems", "dirsig-mat"),
    *("library-envi", "library-metadata", "library-csv", "library-text"),
)


def faults(name: str) -> Any:
    return importlib.import_module(f"campaigns.faults.{name}")


# --- parsers -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("seeds")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT))
        faults("parsers").prepare(folder / "collect")
    return folder / "collect"


def test_every_parser_is_named() -> None:
    assert tuple(faults("parsers").PARSERS) == PARSERS


def _needs(parser: str) -> None:
    if parser in ("mesh-ply", "mesh-glb"):
        pytest.importorskip("trimesh")


@pytest.mark.parametrize("name", PARSERS)
def test_mutated_inputs_are_read_or_refused(name: str, seeds: Path) -> None:
    _needs(name)
    made = faults("parsers").run_part(name, seeds, range(150))
    assert made.good, str(made.wrong)
    assert made.notes["refused"] > 20  # the mutations do damage
    assert made.notes["read"] > 0  # and do not only destroy


@pytest.mark.parametrize("name", PARSERS)
def test_whole_seeds_are_read(name: str, seeds: Path) -> None:
    _needs(name)
    parser = faults("parsers").PARSERS[name]
    refused = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for path in parser.files(seeds):
            try:
                parser.read(path)
            except parser.errors as error:
                refused[path] = error
    assert not refused


@pytest.mark.parametrize("piece", ["short lines", "brackets", "beginning"])
@pytest.mark.parametrize("name", ["frame-index", "irradiance-csv", "control-points", "nmea", "library-text"])
def test_long_texts_take_time_with_their_size(name: str, piece: str, seeds: Path, tmp_path: Path) -> None:
    long_texts = importlib.import_module("campaigns.long_texts")
    sizes = (10**6, 2 * 10**6, 4 * 10**6)
    rooms = [tmp_path / str(number) for number in range(3)]
    for room in rooms:
        room.mkdir()
    # another process that takes the cores for a moment is no growth: what is quadratic fails every time
    problems = [long_texts.judge(name, piece, sizes, room, seeds) for room in rooms]
    assert not all(wrong for _row, wrong in problems), str(problems)


def test_a_number_names_an_input(seeds: Path) -> None:
    mutated = faults("mutation").mutated
    data = (seeds / "flight/raw_0.hdr").read_bytes()
    inputs = [mutated(data, "envi", number) for number in range(100)]
    assert inputs == [mutated(data, "envi", number) for number in range(100)]
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
    ("read", "said"), [(_wrong_error, "KeyError"), (_slow, "1.1"), (_greedy, "(30[0-9] MB|MemoryError)")]
)
def test_a_bad_parser_is_found(read: Any, said: str, seeds: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    parsers = faults("parsers")
    calls = iter([lambda _: None])  # the first call, on a whole file, is not judged
    bad = parsers.Parser(lambda path: next(calls, read)(path), (), ("sky.csv",))
    monkeypatch.setattr(parsers, "PARSERS", {"bad": bad})
    made = parsers.run_part("bad", seeds, range(1))
    assert not made.good
    assert len(made.wrong) == 1
    assert re.search(said, made.wrong[0])


# --- stores ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def stores(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stores")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT))
        faults("storage").build(folder)
    return folder


@pytest.mark.parametrize(
    "kind", ["bit flip", "burst", "truncation", "deletion", "zero length", "swapped", "stale"]
)
def test_no_fault_of_a_store_is_missed(kind: str, stores: Path) -> None:
    for made in faults("storage").run_part(stores, kind, range(6)):
        assert made.good, str(made.wrong)


def test_a_blind_verify_is_found(stores: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    storage = faults("storage")
    whole = storage.hp.verify(stores / "store.zarr")
    monkeypatch.setattr(storage.hp, "verify", lambda _: whole)
    verified, *_ = storage.run_part(stores, "bit flip", range(3))
    assert len(verified.wrong) == 3


def test_a_blind_reader_is_found(stores: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    storage = faults("storage")
    monkeypatch.setattr("hyperpaint.io.store.reader.check_entry", lambda *_: None)
    ours = [storage.run_part(stores, "deletion", range(20))[1]]
    assert any("missed" in told for told in ours[0].wrong)


def test_a_changed_value_is_seen_by_the_plain_reader(stores: Path) -> None:
    storage = faults("storage")
    whole = {storage.GROUP: xr.open_zarr(stores / "store.zarr", group=storage.GROUP).load()}
    assert storage._plain(stores / "store.zarr", whole) == "same"
    assert storage._plain(stores / "older.zarr", whole) == "missed"


# --- writers -----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_killed_writers_leave_nothing_half_written(tmp_path: Path) -> None:
    made = faults("outcome").Outcome("kills")
    for number, duration in enumerate((0.3, 1.0)):
        (tmp_path / str(number)).mkdir()
        faults("writers").run_kill(number, tmp_path / str(number), duration, made)
    assert made.good, str(made.wrong)
    assert made.count == 2


@pytest.mark.parametrize("variant", ["new group", "group replaced", "root replaced", "by two renames"])
def test_writers_killed_before_a_call_leave_nothing_half_written(variant: str, tmp_path: Path) -> None:
    writers, made = faults("writers"), faults("outcome").Outcome("calls")
    writers.run_last_calls(variant, tmp_path, made, range(3, 1000, 23))
    assert made.good, str(made.wrong)
    assert made.count >= 2


def test_of_two_writers_one_is_what_the_store_holds(tmp_path: Path) -> None:
    made = faults("outcome").Outcome("races")
    faults("writers").run_race(0, tmp_path, made)
    assert made.good, str(made.wrong)


def test_a_mixed_store_is_found(tmp_path: Path) -> None:
    writers = faults("writers")
    for name, scene in (("lot.zarr", 1), ("other.zarr", 2)):
        writers.hp.to_store(writers._line(scene), tmp_path / name, writers.GROUP)
    assert writers._holds(tmp_path / "lot.zarr") == 1
    key = f"{writers.GROUP}/counts/c/3/0/0"
    (tmp_path / "lot.zarr" / key).write_bytes((tmp_path / "other.zarr" / key).read_bytes())
    assert not writers.hp.verify(tmp_path / "lot.zarr").ok
    with pytest.raises(ValueError, match="its counts are others"):
        writers._holds(tmp_path / "lot.zarr")


# --- runs of several lines ----------------------------------------------------------------------------------


@pytest.mark.slow
def test_killed_runs_are_whole_or_say_that_they_are_not(tmp_path: Path) -> None:
    runs, made = faults("whole_runs"), faults("outcome").Outcome("runs")
    (tmp_path / "home").mkdir()
    (tmp_path / "store").mkdir()
    lot = runs.Lot(tmp_path / "home", 6)
    runs.run_kills(5, lot, tmp_path / "store", 1.0, made)
    for number in (30, 60):
        (tmp_path / str(number)).mkdir()
        runs.run_call(number, lot, tmp_path / str(number), made, replacing=True, code=None)
    assert made.good, str(made.wrong)
    assert made.count == 7


@pytest.mark.slow
@pytest.mark.parametrize("name", ["orthorectify", "export", "site"])
def test_killed_commands_leave_the_old_product_or_the_new_one(name: str, tmp_path: Path) -> None:
    for package in ("rasterio", "pyproj"):
        pytest.importorskip(package)
    products, outcome = faults("products"), faults("outcome")
    (tmp_path / "inputs").mkdir()
    (tmp_path / "homes").mkdir()
    lots = products.Lots(tmp_path / "inputs", [name])
    parts = list(products.run_kills(name, lots, tmp_path / "homes", range(4)))
    (row,) = outcome.total(parts)
    assert row.good, str(row.wrong)
    assert row.count == 4


def test_sequences_keep_the_set_what_it_is_wanted_to_be() -> None:
    importlib.import_module("campaigns.store_sequences").run_sequences(6, 6, derandomize=True)


def test_a_store_that_is_always_whole_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    sequences = importlib.import_module("campaigns.store_sequences")
    state = sequences.store_state
    monkeypatch.setattr(sequences, "store_state", lambda location: type(state(location))())
    with pytest.raises(AssertionError):
        sequences.run_sequences(20, 6, derandomize=True)


# --- time --------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_faults_of_time_are_told() -> None:
    times = faults("times")
    for made in times.run_part(False, range(len(times.FAULTS))):
        assert made.good, str(made.wrong)


def test_clean_flights_raise_no_alarm() -> None:
    for made in faults("times").run_part(True, range(2)):
        assert not made.wrong


def test_a_wrong_reflectance_without_a_word_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    times = faults("times")

    def double_the_exposure(folder: Path, _: random.Random) -> None:
        times._replace(folder / "collect.toml", "exposure_time_ms = 5.0", "exposure_time_ms = 2.5")
        times._replace(folder / "flight/settings.txt", "(ms) = 5.0", "(ms) = 2.5")
        times._replace(folder / "flight/raw_0.hdr", ";Exposure (ms) = 5.0", ";Exposure (ms) = 2.5")
        times._replace(folder / "dark/raw_0.hdr", ";Exposure (ms) = 5.0", ";Exposure (ms) = 2.5")
        times._replace(folder / "dark/settings.txt", "(ms) = 5.0", "(ms) = 2.5")

    monkeypatch.setattr(times, "FAULTS", {"exposure": double_the_exposure})
    (made,) = times.run_part(False, range(1))
    assert len(made.wrong) == 1
    assert "wrong by 100" in made.wrong[0]


# --- the table ---------------------------------------------------------------------------------------------


def test_parts_add_up() -> None:
    outcome = faults("outcome")
    parts = [
        outcome.Outcome("one", 3, ["a"], seconds=0.1),
        outcome.Outcome("two", 1, allowed=1),
        outcome.Outcome("one", 4, ["b"], seconds=0.3, memory=5),
    ]
    one, two = outcome.total(parts)
    assert (one.count, one.wrong, one.seconds, one.memory, one.good) == (7, ["a", "b"], 0.3, 5, False)
    assert (two.count, two.allowed, two.good) == (1, 1, True)
    assert "FAILED" in str(one)
    assert "held" in str(two)


def test_command_refuses_unknown_campaigns(capsys: pytest.CaptureFixture[str]) -> None:
    campaigns = importlib.import_module("campaigns.all_faults")
    with pytest.raises(SystemExit):
        campaigns.main(["--only", "parsers,weather"])
    known = ", ".join(campaigns.CAMPAIGNS)
    assert f"no campaign weather; there are {known}" in capsys.readouterr().err
