"""Bombs are refused with a reason; a reader without guards is found."""

from __future__ import annotations

import importlib
import pickle
import re
from pathlib import Path
from typing import Any

import pytest
import xarray as xr

pytestmark = [
    pytest.mark.campaign,
    pytest.mark.timeout(0),  # a child ends by an alarm of its own, for which pytest-timeout would answer
    pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="memory is counted by Linux"),
    # the child never comes back to where the warning could matter
    pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning"),
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
    ("metadata_are_a_link_out", "info"),
    ("codec_numcodecs_pickle", "foreign"),
    ("zarr_2_with_text_and_pickle_filters", "calibration"),
    ("shape_10_to_12_in_one_chunk", "verify"),
    ("record_of_10_to_9_chunks", "open-store"),
    ("blosc_frame_that_ends_beyond_the_chunk", "verify"),
    ("zstd_bomb_of_10_gb", "foreign"),
    ("gzip_bomb_in_a_large_chunk", "open-store"),
    ("chunk_is_a_link_out", "open-store"),
    ("link_to_the_whole_disk_among_chunks", "verify"),
    ("listed_names_lead_out", "verify"),
    ("groups_600_deep", "verify"),
    ("groups_beyond_the_longest_path", "info"),
)


@pytest.fixture
def bombs() -> Any:
    module = importlib.import_module("campaigns.faults.bombs")
    module.warm_up()
    return module


def tried(bombs: Any, name: str, door: str, doors: Any = None) -> Any:
    made = importlib.import_module("campaigns.faults.outcome").Outcome("bombs")
    (make,) = [make for bomb, through, make in bombs.all_bombs() if (bomb, through) == (name, door)]
    bombs.run_bomb(name, door, make, made, doors or bombs.DOORS)
    return made


@pytest.mark.parametrize(("name", "door"), QUICK)
def test_a_bomb_is_refused(name: str, door: str, bombs: Any) -> None:
    made = tried(bombs, name, door)
    assert made.good, str(made.wrong)
    assert made.notes["refused"] == 1


def test_there_are_sixty_and_each_has_its_name(bombs: Any) -> None:
    tries = [(name, door) for name, door, _ in bombs.all_bombs()]
    assert len(tries) == len(set(tries))
    assert len({name for name, _ in tries}) >= 60
    assert set(QUICK) <= set(tries)
    assert {door for _, door in tries} == set(bombs.DOORS)


@pytest.mark.parametrize("door", ["open-store", "verify", "calibration", "irradiance", "info", "foreign"])
def test_the_store_they_are_made_from_is_let_in(door: str, bombs: Any, tmp_path: Path) -> None:
    store = importlib.import_module("campaigns.faults.bomb_making").whole_store(tmp_path)
    bombs.DOORS[door].read(store)


def plain(path: Path) -> None:
    xr.open_zarr(path, consolidated=False).load()


def runs_it(path: Path) -> None:
    """Unpickle a chunk, as numcodecs did before 0.16.6."""
    pickle.loads((path / "radiance_gain/0.0").read_bytes())


@pytest.mark.parametrize(
    ("name", "read", "said"),
    [
        ("chunk_is_a_link_out", plain, "opened "),
        ("gzip_of_many_members", lambda _: None, "it was read"),
        ("zarr_2_with_text_and_pickle_filters", runs_it, "code was run"),
        ("zstd_bomb_of_10_gb", plain, r"Error|[0-9]{3} MB|hung"),
        ("metadata_are_a_pipe", lambda path: (path / "radiance_gain/zarr.json").read_bytes(), "hung"),
    ],
)
def test_a_blind_reader_is_found(name: str, read: Any, said: str, bombs: Any, monkeypatch: Any) -> None:
    monkeypatch.setattr(bombs, "_HANGS", 2)
    made = tried(bombs, name, "open-store", {"open-store": bombs.Door(read, (bombs.StoreError,))})
    assert not made.good
    assert re.search(said, made.wrong[0]), made.wrong
