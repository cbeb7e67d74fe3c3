"""Stores of every format that was released, and of the present one, are read: one of each is kept."""

from __future__ import annotations

import shutil
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import hyperpaint as hp
from hyperpaint.base.constants import KEPT_BITS
from hyperpaint.base.errors import IncompleteStoreError, PaintWarning
from hyperpaint.base.schema import FORMAT_VERSION

RELEASED = Path(__file__).with_name("released")


def _problems(path: Path) -> str:
    with pytest.raises(IncompleteStoreError):
        hp.open_store(path)
    return "\n".join(hp.verify(path).problems)


def test_a_store_of_every_format_is_kept() -> None:
    kept = {path.name for path in RELEASED.glob("format_*")}
    assert kept == {f"format_{number}.zip" for number in range(1, FORMAT_VERSION + 1)}


def _unpacked(name: str | int, folder: Path) -> Path:
    stem = f"format_{name}" if isinstance(name, int) else name
    with zipfile.ZipFile(RELEASED / f"{stem}.zip") as archive:
        archive.extractall(folder)
    return folder / f"{stem}.zarr"


def _has_its_counts(tree: xr.DataTree) -> None:
    for number in (1, 2):
        expected = np.random.default_rng(number).integers(0, 4096, (40, 3, 4), dtype="uint16")
        np.testing.assert_array_equal(tree[f"flightlines/raw_{number}"]["counts"].values, expected)


@pytest.fixture
def released(tmp_path: Path) -> Path:
    """Unpack a store of format 1: two lines written by `to_store` of 0.1, before root records."""
    return _unpacked(1, tmp_path)


def test_a_store_of_format_1_opens_with_a_note(released: Path) -> None:
    report = hp.verify(released)
    assert report.ok
    assert "written by hyperpaint 0.1" in report.notes[0]
    assert "note: " in str(report)
    with pytest.warns(PaintWarning, match=r"hyperpaint 0\.1"):
        tree = hp.open_store(released)
    _has_its_counts(tree)
    with pytest.warns(PaintWarning, match=r"hyperpaint 0\.1"):
        hp.open_store(released, "flightlines/raw_1")


def test_a_store_of_format_1_takes_more_groups(released: Path) -> None:
    hp.to_store(xr.Dataset({"a": ("x", [1.0])}), released, "signatures")
    report = hp.verify(released)
    assert report.ok
    assert "held groups before the record" in report.notes[0]
    with pytest.warns(PaintWarning, match="held groups before the record"):
        hp.open_store(released)
    assert hp.open_store(released, "flightlines/raw_1").sizes["band"] == 3
    shutil.rmtree(released / "flightlines/raw_1")
    assert "/flightlines/raw_1: deleted" in _problems(released)


def test_a_store_of_format_2_is_whole(tmp_path: Path) -> None:
    """Two lines of a run of numerics 1, and a group that a user added; as format 2 began."""
    path = _unpacked(2, tmp_path)
    report = hp.verify(path)
    assert report.ok, str(report)
    assert all("made by numerics 1" in note for note in report.notes)
    assert set(report.groups) == {"flightlines/raw_1", "flightlines/raw_2", "signatures"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PaintWarning)
        _has_its_counts(hp.open_store(path))
    shutil.rmtree(path / "flightlines/raw_1")
    assert "/flightlines/raw_1: deleted" in _problems(path)


@pytest.mark.filterwarnings("ignore::hyperpaint.base.errors.PaintWarning")  # of later numerics
def test_a_store_of_release_0_2_is_whole_and_gives_its_reflectance(tmp_path: Path) -> None:
    """A simulated line as `process` of 0.2.0 stored it, with its collect and calibration."""
    path = _unpacked("release_0_2", tmp_path)
    report = hp.verify(path)
    assert report.ok, str(report)
    line = hp.open_store(path, "flightlines/raw_0")
    assert line.attrs["hyperpaint_version"] == "0.2.0"
    again = line.drop_vars(["reflectance", "quality"]).paint.reflectance()
    np.testing.assert_allclose(again.reflectance, line.reflectance, rtol=2.0**-KEPT_BITS)
    np.testing.assert_array_equal(again.quality, line.quality)
