"""Damaged libraries are refused with an error of ours, or read; the campaign tries thousands."""

import importlib
from pathlib import Path
from typing import Any

import pytest

pytestmark = [
    pytest.mark.campaign,
    pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="memory is counted by Linux"),
]


@pytest.fixture(scope="module")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder: Path = tmp_path_factory.mktemp("seeds")
    importlib.import_module("campaigns.faults.parsers").prepare(folder)
    return folder


@pytest.mark.parametrize("name", ["library-envi", "library-metadata", "library-csv", "library-text"])
def test_three_hundred_damages(name: str, seeds: Path) -> None:
    parsers: Any = importlib.import_module("campaigns.faults.parsers")
    made = parsers.run_part(name, seeds, range(300))
    assert made.wrong == []
    assert made.notes["read"] > 10
    assert made.notes["refused"] > 10
