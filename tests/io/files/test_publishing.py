"""Files and folders appear whole or not at all, and nothing of others is replaced."""

from __future__ import annotations

from pathlib import Path

import pytest

from hyperpaint.base.errors import StoreError
from hyperpaint.io.files.publishing import publish_file, published_files, published_folder


def no_foreign(_: Path) -> str:
    return ""


def test_a_file_is_replaced_only_where_asked(tmp_path: Path) -> None:
    path = tmp_path / "new" / "page.html"
    publish_file(path, b"one", overwrite=False)
    with pytest.raises(StoreError, match="exists; pass overwrite=True"):
        publish_file(path, b"two", overwrite=False)
    assert path.read_bytes() == b"one"
    publish_file(path, b"two", overwrite=True)
    assert path.read_bytes() == b"two"
    assert [found.name for found in path.parent.iterdir()] == ["page.html"]


def test_a_file_that_appears_meanwhile_stays(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"

    def write() -> None:
        with published_files([path], overwrite=False) as (written,):
            written.write_bytes(b"ours")
            path.write_bytes(b"theirs")

    with pytest.raises(StoreError, match="exists"):
        write()
    assert path.read_bytes() == b"theirs"
    assert [found.name for found in tmp_path.iterdir()] == ["table.csv"]


def test_what_fails_leaves_what_was_there(tmp_path: Path) -> None:
    path, folder = tmp_path / "table.csv", tmp_path / "spectra"
    publish_file(path, b"old", overwrite=False)
    folder.mkdir()
    (folder / "old.txt").write_bytes(b"old")

    def write_file() -> None:
        with published_files([path], overwrite=True) as (written,):
            written.write_bytes(b"half")
            raise KeyboardInterrupt

    def write_folder() -> None:
        with published_folder(folder, overwrite=True, foreign=no_foreign) as build:
            (build / "new.txt").write_bytes(b"half")
            raise KeyboardInterrupt

    for write in (write_file, write_folder):
        with pytest.raises(KeyboardInterrupt):
            write()
    assert path.read_bytes() == b"old"
    assert [found.name for found in folder.iterdir()] == ["old.txt"]
    assert sorted(found.name for found in tmp_path.iterdir()) == ["spectra", "table.csv"]


def test_a_missing_file_of_a_product_is_told(tmp_path: Path) -> None:
    targets = [tmp_path / "values.bin", tmp_path / "values.hdr"]
    with (
        pytest.raises(StoreError, match="cannot be written"),
        published_files(targets, overwrite=False) as (values, _),
    ):
        values.write_bytes(b"values")
    assert list(tmp_path.iterdir()) == []


def test_a_folder_of_others_is_never_replaced(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    folder.mkdir()
    with published_folder(folder, overwrite=False, foreign=no_foreign) as build:  # it is empty
        (build / "a.txt").write_bytes(b"a")
    with (
        pytest.raises(StoreError, match=r"out holds a thesis; choose a new or empty folder"),
        published_folder(folder, overwrite=True, foreign=lambda _: "a thesis"),
    ):
        pytest.fail("entered")
    with (
        pytest.raises(StoreError, match="exists; pass overwrite=True"),
        published_folder(folder, overwrite=False, foreign=no_foreign),
    ):
        pytest.fail("entered")
    with published_folder(folder, overwrite=True, foreign=no_foreign) as build:
        (build / "b.txt").write_bytes(b"b")
    assert [found.name for found in folder.iterdir()] == ["b.txt"]
    link = tmp_path / "link"
    link.symlink_to(folder)
    with (
        pytest.raises(StoreError, match="a file or a link"),
        published_folder(link, overwrite=True, foreign=no_foreign),
    ):
        pytest.fail("entered")
