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
    ("json_of_10_million_lists", "info"),
    ("metadata_are_a_pipe", "info"),
    ("codec_numcodecs_pickle", "calibration"),
    ("format_2_text_and_pickle", "library"),
    ("shape_10_to_12_in_one_chunk", "verify"),
    ("index_of_a_gigabyte", "irradiance"),
    ("shard_of_huge_inner_chunks", "open-store"),
    ("a_gigabyte_without_chunks", "calibration"),
    ("zip_with_metadata_of_100_mb", "open-store"),
    ("manifest_of_10_to_12_chunks", "open-store"),
    ("groups_600_deep", "verify"),
    ("groups_beyond_the_longest_path", "info"),
    ("staged_group_leads_out", "writer"),
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


@pytest.mark.parametrize("how", [{}, {"zarr_format": 2}, {"ours": True}])
def test_the_stores_they_are_made_from_are_let_in(how: Any, bombs: Any, tmp_path: Path) -> None:
    stores = importlib.import_module("campaigns.faults.bomb_stores")
    store = stores.whole_store(tmp_path, **how)
    for door in stores.ALL:
        bombs.DOORS[door].read(store)


def plain(path: Path) -> None:
    xr.open_zarr(path, consolidated=False).load()


def runs_it(path: Path) -> None:
    """Unpickle a chunk, as numcodecs did before 0.16.6."""
    pickle.loads((path / "radiance_gain/c/0/0").read_bytes())


@pytest.mark.parametrize(
    ("name", "read", "said"),
    [
        ("metadata_are_an_endless_device", plain, "MemoryError|MB|hung"),
        ("codec_numcodecs_pickle", runs_it, "code was run"),
        ("many_documents_of_30_mb", plain, "it was read|[0-9]{3} MB"),
        ("metadata_are_a_pipe", lambda path: (path / "radiance_gain/zarr.json").read_bytes(), "hung"),
    ],
)
def test_a_blind_reader_is_found(name: str, read: Any, said: str, bombs: Any, monkeypatch: Any) -> None:
    monkeypatch.setattr(bombs, "_HANGS", 2)
    made = tried(bombs, name, "open-store", {"open-store": bombs.Door(read, (bombs.StoreError,))})
    assert not made.good
    assert re.search(said, made.wrong[0]), made.wrong
