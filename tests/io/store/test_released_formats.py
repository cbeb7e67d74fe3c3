"""Stores of every format that was released, and of the present one, are read: one of each is kept."""

import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import hyperpaint as hp
from hyperpaint.base.constants import KEPT_BITS
from hyperpaint.base.schema import FORMAT_VERSION

RELEASED = Path(__file__).with_name("released")


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


@pytest.mark.parametrize("number", [1, 2])
def test_a_store_of_an_older_format_opens_and_is_noted(number: int, tmp_path: Path) -> None:
    # Two lines as 0.1 and 0.2 began to write them; that of format 2 has a group of a user
    path = _unpacked(number, tmp_path)
    report = hp.verify(path)
    assert report.ok, str(report)
    assert "hyperpaint 0.2 or older" in report.notes[0]
    assert {"flightlines/raw_1", "flightlines/raw_2"} <= set(report.groups)
    tree = hp.open_store(path)
    _has_its_counts(tree)
    assert not [key for key in tree["flightlines/raw_1"].attrs if key.startswith("hyperpaint_complete")]
    chunk = path / "flightlines/raw_1/counts/c/0/0/0"
    chunk.write_bytes(chunk.read_bytes()[:-1])
    assert "/flightlines/raw_1/counts: chunk (0, 0, 0) cannot be read" in str(hp.verify(path))


@pytest.mark.parametrize("number", [1, 2])
def test_a_store_of_an_older_format_takes_more_groups(number: int, tmp_path: Path) -> None:
    path = _unpacked(number, tmp_path)
    hp.to_store(xr.Dataset({"a": ("x", [1.0])}), path, "more")
    report = hp.verify(path)
    assert report.ok, str(report)
    assert len(report.notes) >= 2  # the groups of before are not in the manifest
    _has_its_counts(hp.open_store(path))
    shutil.rmtree(path / "more")
    assert "/more: deleted" in str(hp.verify(path))


def test_a_store_of_format_3_is_whole(tmp_path: Path) -> None:
    path = _unpacked(3, tmp_path)
    report = hp.verify(path)
    assert (report.ok, report.notes) == (True, ()), str(report)
    _has_its_counts(hp.open_store(path))
    shutil.rmtree(path / "flightlines/raw_1")
    assert "/flightlines/raw_1: deleted" in str(hp.verify(path))


@pytest.mark.filterwarnings("ignore::hyperpaint.base.errors.PaintWarning")  # of later numerics
def test_a_store_of_release_0_2_is_whole_and_gives_its_reflectance(tmp_path: Path) -> None:
    # A simulated line as `process` of 0.2.0 stored it, with its collect and calibration
    path = _unpacked("release_0_2", tmp_path)
    report = hp.verify(path)
    assert report.ok, str(report)
    line = hp.open_store(path, "flightlines/raw_0")
    assert line.attrs["hyperpaint_version"] == "0.2.0"
    again = line.drop_vars(["reflectance", "quality"]).paint.reflectance()
    np.testing.assert_allclose(again.reflectance, line.reflectance, rtol=2.0**-KEPT_BITS)
    np.testing.assert_array_equal(again.quality, line.quality)
