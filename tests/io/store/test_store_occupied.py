"""What stands in a group's place, and around it, is not lost; what is damaged there can be mended."""

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_error

from hyperpaint.base.errors import StoreError
from hyperpaint.io.store import open_store, to_store, verify

GROUP = "flightlines/raw_0"


def line(value: int = 1) -> xr.Dataset:
    counts = np.full((70, 2, 3), value, "uint16")
    return xr.Dataset({"counts": (("along_track", "band", "cross_track"), counts)})


@pytest.fixture
def path(tmp_path: Path) -> Path:
    to_store(line(), tmp_path / "lot.zarr", GROUP)
    return tmp_path / "lot.zarr"


def holds(path: Path, value: int, group: str = GROUP) -> bool:
    return verify(path).ok and bool((open_store(path, group).counts == value).all())


def files(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


@pytest.mark.parametrize("name", [".zarr.json.4711", f"zarr.{'ab' * 16}.partial"])
def test_a_writer_killed_at_its_first_metadata_is_no_other_store(name: str, tmp_path: Path) -> None:
    path = tmp_path / "lot.zarr"
    path.mkdir()
    (path / name).write_text("{")
    to_store(line(), path, GROUP)
    assert holds(path, 1)
    assert not (path / name).exists()


@pytest.mark.parametrize(
    "damage",
    [
        lambda path: (path / "flightlines/zarr.json").write_text("{"),
        lambda path: (path / "flightlines/zarr.json").unlink(),
        lambda path: (path / "flightlines/zarr.json").write_text('{"node_type": "group"'),
    ],
)
@pytest.mark.parametrize("group", [None, "flightlines"])
def test_groups_below_damaged_metadata_are_not_lost(
    damage: Callable[[Path], object], group: str | None, path: Path
) -> None:
    damage(path)
    before = files(path)
    for overwrite in (True, False):
        expect_error(
            StoreError, "group-occupied", partial(to_store, line(2), path, group, overwrite=overwrite)
        )
        assert files(path) == before


def test_a_folder_of_somebody_elses_is_not_lost(path: Path) -> None:
    (path / "photos/2026").mkdir(parents=True)
    (path / "photos/2026/a.jpg").touch()
    expect_error(StoreError, "group-occupied", lambda: to_store(line(2), path, "photos", overwrite=True))
    (path / "notes").mkdir()
    (path / "notes/a.txt").touch()
    (path / GROUP / "notes.txt").touch()
    for group in ("notes", GROUP):
        expect_error(StoreError, "group-occupied", partial(to_store, line(2), path, group, overwrite=True))


@pytest.mark.parametrize("place", [GROUP, f"{GROUP}/counts", "new"])
def test_nothing_is_written_as_a_store_into_a_store(place: str, path: Path) -> None:
    before = files(path)
    for group in (None, "g"):
        expect_error(
            StoreError, "path-inside-store", partial(to_store, line(2), path / place, group, overwrite=True)
        )
    assert files(path) == before


def test_damaged_arrays_do_not_keep_a_group_from_being_replaced(path: Path) -> None:
    (path / GROUP / "counts/zarr.json").write_text("{")
    to_store(line(2), path, GROUP, overwrite=True)
    assert holds(path, 2)


@pytest.mark.parametrize("damage", ["damaged", "missing"])
@pytest.mark.parametrize("value", [1, 2])
def test_a_root_is_rebuilt_when_asked_for(value: int, damage: str, path: Path) -> None:
    to_store(line(5), path, "flightlines/raw_1")
    if damage == "damaged":
        (path / "zarr.json").write_text('{"attributes": {')
    else:
        (path / "zarr.json").unlink()
    before = files(path)
    expect_error(StoreError, "metadata-damaged", lambda: to_store(line(value), path, GROUP))
    assert files(path) == before
    to_store(line(value), path, GROUP, overwrite=True)
    assert holds(path, value)
    assert holds(path, 5, "flightlines/raw_1")
    assert os.listdir(path.parent) == ["lot.zarr"]


def test_a_damaged_group_above_is_rebuilt_when_asked_for(path: Path) -> None:
    (path / "flightlines/zarr.json").write_text("[" * 1000)
    expect_error(StoreError, "metadata-damaged", lambda: to_store(line(2), path, "flightlines/raw_1"))
    to_store(line(2), path, "flightlines/raw_1", overwrite=True)
    assert holds(path, 1)
    assert holds(path, 2, "flightlines/raw_1")


@pytest.mark.parametrize("group", [GROUP, None])
def test_a_group_that_lacks_a_chunk_is_made_again(group: str | None, tmp_path: Path) -> None:
    path = tmp_path / "lot.zarr"
    to_store(line(), path, group)
    (path / (group or "") / "counts/c/1/0/0").unlink()
    to_store(line(), path, group)
    assert holds(path, 1, group or "")
    (path / (group or "") / "counts/c/1/0/0").unlink()
    expect_error(StoreError, "store-exists", lambda: to_store(line(2), path, group))


def test_a_store_behind_a_link_is_written_where_it_is(path: Path, tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    os.rename(path, tmp_path / "disk/lot.zarr")
    path.symlink_to(tmp_path / "disk/lot.zarr")
    to_store(line(2), path, GROUP, overwrite=True)
    assert path.is_symlink()
    assert holds(path, 2)
    assert os.listdir(tmp_path / "disk") == ["lot.zarr"]
