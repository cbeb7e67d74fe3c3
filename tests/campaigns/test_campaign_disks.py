"""The campaign of full and vanishing disks at small counts; and that it can fail."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.campaign


@pytest.fixture
def disks() -> Any:
    return importlib.import_module("campaigns.faults.disks")


@pytest.fixture
def mounted(disks: Any) -> Any:
    if not disks.can_mount():
        pytest.skip("mounting a disk needs root on Linux")
    return disks


@pytest.fixture
def made(disks: Any) -> Any:
    return importlib.import_module("campaigns.faults.outcome").Outcome("disks")


@pytest.mark.slow
def test_disks_that_fill_up(mounted: Any, made: Any, tmp_path: Path) -> None:
    expected, total = mounted.undisturbed(tmp_path)
    for number in (0, 14, 29):
        (tmp_path / str(number)).mkdir()
        mounted.run_full(number, tmp_path / str(number), expected, total, made)
    assert made.good, str(made.wrong)
    assert made.notes["stopped"] == 3


@pytest.mark.slow
def test_folders_that_vanish(mounted: Any, made: Any, tmp_path: Path) -> None:
    expected, _ = mounted.undisturbed(tmp_path)
    for number in range(len(mounted.FOLDERS)):
        (tmp_path / str(number)).mkdir()
        mounted.run_folder(number, tmp_path / str(number), expected, made)
    assert made.good, str(made.wrong)
    assert made.notes["stopped"] >= len(mounted.FOLDERS) - 2


@pytest.mark.slow
def test_sources_that_vanish(disks: Any, made: Any, tmp_path: Path) -> None:
    collect, expected = disks.processed(tmp_path)
    for number in range(len(disks.SOURCES)):
        (tmp_path / str(number)).mkdir()
        disks.run_source(number, tmp_path / str(number), collect, expected, made)
    assert made.good, str(made.wrong)
    assert made.notes["stopped"] == len(disks.SOURCES)


@pytest.mark.slow
def test_a_store_that_looks_finished_is_found(
    mounted: Any, made: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected, total = mounted.undisturbed(tmp_path)
    monkeypatch.setattr(mounted, "looks_finished", lambda *_: True)
    expected["counts/c/3/0/0"] = b"other"
    folder = tmp_path / "full"
    folder.mkdir()
    mounted.run_full(4, folder, expected, total, made)
    assert len(made.wrong) == 2
    assert made.wrong[0].endswith("looks finished")
    assert "differs from an undisturbed run" in made.wrong[1]
