"""Files and folders appear whole or not at all, and nothing of others is replaced."""

import errno
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support.refusals import expect_errors

from hyperpaint.base.errors import StoreError
from hyperpaint.io.files import publishing
from hyperpaint.io.files.publishing import check_place, publish_file, published_files, published_folder
from hyperpaint.io.store.writer import staging

HERE = Path(__file__).parent


def no_foreign(_: Path) -> str:
    return ""


def test_a_file_is_replaced_only_where_asked(tmp_path: Path) -> None:
    path = tmp_path / "new" / "page.html"
    publish_file(path, b"one", overwrite=False)
    expect_errors((StoreError, "file-exists", lambda: publish_file(path, b"two", overwrite=False)))
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

    expect_errors((StoreError, "exists", write))
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
        pytest.raises(StoreError, match="file-unwritable"),
        published_files(targets, overwrite=False) as (values, _),
    ):
        values.write_bytes(b"values")
    assert list(tmp_path.iterdir()) == []


def test_a_folder_of_others_is_never_replaced(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    folder.mkdir()
    with published_folder(folder, overwrite=False, foreign=no_foreign) as build:  # it is empty
        (build / "a.txt").write_bytes(b"a")
    link = tmp_path / "link"
    link.symlink_to(folder)
    for target, overwrite, foreign, code in (
        (folder, True, lambda _: "a thesis", "folder-occupied"),
        (folder, False, no_foreign, "file-exists"),
        (link, True, no_foreign, "path-not-folder"),
    ):
        with (
            pytest.raises(StoreError, match=code),
            published_folder(target, overwrite=overwrite, foreign=foreign),
        ):
            pytest.fail("entered")
    with published_folder(folder, overwrite=True, foreign=no_foreign) as build:
        (build / "b.txt").write_bytes(b"b")
    assert [found.name for found in folder.iterdir()] == ["b.txt"]


# --- several files -----------------------------------------------------------------------------------------


WHOLE = ["map.geojson", "map.json", "map.tif", "seams"]


def places(home: Path) -> list[Path]:
    # Return the places of a map: its item beside it, its seamlines in another folder, the map itself
    return [home / "map.json", home / "seams" / "map.geojson", home / "map.tif"]


def write(home: Path, text: str) -> None:
    with published_files(places(home), overwrite=True) as news:
        for new in news:
            new.write_text(text)


def texts(home: Path) -> list[str | None]:
    return [path.read_text() if path.exists() else None for path in places(home)]


def names(home: Path) -> list[str]:
    return sorted(path.name for path in home.rglob("*"))


def failing(function: Callable[..., None], step: int) -> Callable[..., None]:
    # Return a function whose call number ``step`` fails, as on a disk that is full for a moment
    left = [step]

    def call(*arguments: Any, **options: Any) -> None:
        left[0] -= 1
        if left[0] == -1:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        function(*arguments, **options)

    return call


@pytest.mark.parametrize("links", [True, False])
@pytest.mark.parametrize(
    ("there", "name", "step"),
    [
        *((there, name, at) for there in (True, False) for name in ("rename", "replace") for at in (0, 1)),
        *((True, "rename", 2), (True, "rename", 3), (False, "rename", 2)),
    ],
)  # fmt: skip
def test_a_failing_rename_brings_the_old_files_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, there: bool, name: str, step: int, links: bool
) -> None:
    if there:
        write(tmp_path, "old")
    before = texts(tmp_path)
    with monkeypatch.context() as patched:
        if not links:
            patched.setattr(publishing.os, "link", failing(lambda *_: None, 0))
        patched.setattr(publishing.os, name, failing(getattr(os, name), step))
        expect_errors((StoreError, "disk-full", lambda: write(tmp_path, "new")))
    assert texts(tmp_path) == before
    assert not [found for found in names(tmp_path) if found.startswith(".partial")]
    write(tmp_path, "new")
    assert (texts(tmp_path), names(tmp_path)) == (["new"] * 3, WHOLE)


def killed(home: Path, call: int) -> bool:
    # Write in a process that ends before a call that changes files; return whether there was such a call
    child = os.fork()
    if not child:
        left = [call]

        def hook(event: str, arguments: tuple[Any, ...]) -> None:
            writes = event == "open" and isinstance(arguments[2], int) and arguments[2] & os.O_CREAT
            if writes or event in ("os.rename", "os.link", "os.mkdir", "os.rmdir", "os.remove"):
                left[0] -= 1
                if not left[0]:
                    os._exit(9)

        sys.addaudithook(hook)
        write(home, "new")
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9


def judge_kills(home: Path) -> list[str]:
    # Kill a writer before each call, and return what is wrong with what is there then
    wrong, call = [], 0
    for there in (True, False):
        for call in range(1, 1000):
            folder = home / f"{there} {call}"
            folder.mkdir()
            if there:
                write(folder, "old")
            old = ["old"] * 3 if there else [None] * 3
            if not killed(folder, call):
                break
            found = texts(folder)
            if found[-1] is not None and found not in (old, ["new"] * 3):
                wrong.append(f"there {there}, call {call}: {found} can be opened")
            if call % 2:
                check_place(places(folder)[-1], "the map", example="map.tif", overwrite=True)
                if texts(folder) not in (old, ["new"] * 3) or any(folder.glob(".partial*")):
                    wrong.append(f"there {there}, call {call}: {names(folder)} are there after the check")
            write(folder, "newer")
            if texts(folder) != ["newer"] * 3 or names(folder) != [
                "map.geojson",
                "map.json",
                "map.tif",
                "seams",
            ]:
                wrong.append(f"there {there}, call {call}: {names(folder)} are there after the rerun")
    return [*wrong, f"{call} calls"]


def test_a_kill_at_any_call_leaves_no_mixed_product() -> None:
    # In a process of its own, which has no threads when it forks
    code = (
        f"import json, pathlib, sys; sys.path[:0] = {[str(HERE), str(HERE.parents[1])]!r}\n"
        "import test_publishing; print(json.dumps(test_publishing.judge_kills(pathlib.Path(sys.argv[1]))))"
    )
    memory = Path("/dev/shm")  # hundreds of flushes
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as home:
        run = subprocess.run([sys.executable, "-c", code, home], capture_output=True, check=True)
    *wrong, count = json.loads(run.stdout)
    assert wrong == []
    assert int(count.split()[0]) > 30


def planted(home: Path) -> Path:
    # Return a folder like that of a swap that was cut short
    with staging(home / "map.tif") as stage:
        swap = stage.folder / "swap"
        swap.mkdir()
    return swap


@pytest.mark.parametrize(
    "journal", ["{", "[]", "[7]", '[[".", ".."]]', '[[".", "a/b"]]', '[["..", ""]]', "[" * 100_000]
)
def test_a_planted_journal_is_refused(tmp_path: Path, journal: str) -> None:
    write(tmp_path, "old")
    (planted(tmp_path) / "journal").write_text(journal)
    expect_errors((StoreError, "staging-foreign", lambda: write(tmp_path, "new")))
    assert texts(tmp_path) == ["old"] * 3


def test_a_planted_journal_reaches_no_other_folder(tmp_path: Path) -> None:
    write(tmp_path, "old")
    swap = planted(tmp_path)
    (swap / "1").mkdir()
    (swap / "1" / "map.tif").write_text("planted")
    (swap / "0.old").write_text("planted")
    (swap / "journal").write_text(json.dumps([["seams", "map.geojson"], [".", "map.tif"]]))
    check_place(tmp_path / "map.tif", "the map", example="map.tif", overwrite=True)
    assert (texts(tmp_path), names(tmp_path)) == (["old"] * 3, WHOLE)


def test_what_is_no_plain_file_is_never_replaced(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(StoreError, match="file-not-plain"):
        publish_file(tmp_path / "pipe", b"", overwrite=True)
