"""Patterns find what glob finds, within bounds."""

import glob
from pathlib import Path

import pytest
from support.refusals import expect_errors

from hyperpaint.io.files.reading import is_pattern, matching_files


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("a.asd", "b.asd", "c.txt", "x/a.asd", "x/y/a.asd", "x/y/[1].asd", ".h/a.asd", "x/.h.asd"):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    return tmp_path


@pytest.mark.parametrize(
    "pattern",
    ["*.asd", "?.asd", "[ab].asd", "[!a].asd", "x/*.asd", "*/*.asd", "**/*.asd", "x/**/*.asd", "**/y/*", "*/",
     "**/[[]1].asd", "./*.asd", "x/./*.asd", "nothing/*.asd", "*.nothing", ".h/*", ".*/*.asd", "**/.h.asd"],
)  # fmt: skip
def test_finds_what_glob_finds(pattern: str, folder: Path) -> None:
    expected = sorted({folder / name for name in glob.glob(pattern, root_dir=folder, recursive=True)})
    if pattern == "*/":  # files are not told from folders
        expected = sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    assert matching_files(folder, pattern) == expected


@pytest.mark.parametrize("pattern", ["/*", "../*", "x/../../*", "/**/*.asd", "*\0", "*" * 2000])
def test_refuses_what_leads_out(pattern: str, folder: Path) -> None:
    expect_errors((ValueError, "expected a pattern", lambda: matching_files(folder, pattern)))


def test_links_are_not_walked_without_end(folder: Path) -> None:
    for name in ("p", "q"):
        (folder / name).symlink_to(".")
    assert folder / "p/a.asd" in matching_files(folder, "*/*.asd")  # a link named by one part is followed
    assert folder / "p/a.asd" not in matching_files(folder, "**/*.asd")
    with pytest.raises(ValueError, match="more than 5000 files"):
        matching_files(folder, "*/" * 30 + "*.asd", most=5000)


def test_what_is_a_pattern() -> None:
    assert all(map(is_pattern, ("a*", "[a]", "?")))
    assert not is_pattern("raw_0.hdr")
