"""What is written appears whole or not at all, and nothing is replaced unasked."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_errors

import hyperpaint as hp
from hyperpaint.base.errors import FormatError, StoreError
from hyperpaint.io.files import publishing
from hyperpaint.io.library import spectra_files
from hyperpaint.io.store.writer import MARK_TEXT

NAMES = {"envi": "paints.sli", "csv": "paints.csv", "zarr": "paints.zarr"}


@pytest.fixture
def library(library: xr.Dataset) -> xr.Dataset:
    return library.isel(band=[0, 1, 3, 4])


@pytest.fixture(autouse=True)
def _no_leftovers(tmp_path: Path) -> Iterator[None]:
    yield
    assert not list(tmp_path.glob(".*"))


def state(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.mark.parametrize("format", NAMES)
def test_nothing_is_replaced_unasked(library: xr.Dataset, tmp_path: Path, format: str) -> None:
    path = tmp_path / NAMES[format]
    assert hp.write_library(library, path, format=format) == path
    before = state(tmp_path)
    other = library.isel(signature=[0, 1])
    expect_errors(
        (StoreError, r"exist.*overwrite=True", lambda: hp.write_library(other, path, format=format))
    )
    assert state(tmp_path) == before
    hp.write_library(other, path, format=format, overwrite=True)
    assert hp.open_library(path).sizes["signature"] == 2
    # a folder with anything else is never replaced
    thesis = tmp_path / "folder" / "thesis.doc"
    thesis.parent.mkdir()
    thesis.write_text("ten years of work")
    expect_errors(
        (
            StoreError,
            r"is a folder|holds|other",
            lambda: hp.write_library(
                library, thesis.parent, format="zarr" if format == "zarr" else "csv", overwrite=True
            ),
        )
    )
    assert thesis.read_text() == "ten years of work"


@pytest.mark.parametrize(
    ("format", "name", "written"),
    [
        ("csv", "paints", "paints.csv"),
        ("csv", "paints.txt", "paints.txt"),
        ("envi", "paints", "paints.sli"),
        ("envi", "paints.hdr", "paints.sli"),
        ("envi", "paints.v2", "paints.v2.sli"),
    ],
)
def test_a_file_gets_the_suffix_that_it_is_known_by(
    library: xr.Dataset, tmp_path: Path, format: str, name: str, written: str
) -> None:
    path = hp.write_library(library, tmp_path / name, format=format)
    assert (path, hp.open_library(path).sizes["signature"]) == (tmp_path / written, 5)


@pytest.mark.parametrize("format", ["envi", "csv"])
@pytest.mark.parametrize("overwrite", [False, True])
def test_a_failure_leaves_what_was_there(
    library: xr.Dataset, tmp_path: Path, format: str, overwrite: bool
) -> None:
    path = tmp_path / NAMES[format]
    if overwrite:
        hp.write_library(library.isel(signature=[0]), path, format=format)
    before = state(tmp_path)

    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        hp.write_library(library, path, format=format, overwrite=overwrite, progress=stop)
    assert state(tmp_path) == before


class Power(BaseException):
    """The lights go out: nothing is cleared up."""


@pytest.mark.parametrize("step", range(3))
@pytest.mark.parametrize("overwrite", [False, True])
def test_a_kill_between_two_renames__leaves_nothing_that_opens_as_another(
    library: xr.Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: int, overwrite: bool
) -> None:
    # Rationale: a library of ENVI is three files; without its header it is none.
    path = tmp_path / "paints.sli"
    old, new = library.isel(signature=[0, 1]), library
    if overwrite:
        hp.write_library(old, path)
    names, left = ("paints.sli", "paints.sli.json", "paints.hdr"), [step]

    def dying(move: Any) -> Any:
        def call(source: Any, target: Any) -> None:
            if Path(target).name in names and Path(target).parent == tmp_path:
                if not left[0]:
                    raise Power
                left[0] -= 1
            move(source, target)

        return call

    with monkeypatch.context() as patched:
        for name in ("replace", "rename"):
            patched.setattr(publishing.os, name, dying(getattr(os, name)))
        patched.setattr(publishing, "_settle", lambda _: None)  # as a process that is killed
        with pytest.raises(Power):
            hp.write_library(new, path, overwrite=overwrite)
    expect_errors((FormatError, r"no header|no such file", lambda: hp.open_library(path)))
    hp.write_library(new, path, overwrite=overwrite)
    assert hp.open_library(path).sizes["signature"] == 5
    assert sorted(p.name for p in tmp_path.iterdir()) == ["paints.hdr", "paints.sli", "paints.sli.json"]


def test_leftovers_of_a_killed_writer__are_cleared(library: xr.Dataset, tmp_path: Path) -> None:
    stage = tmp_path / ".partial-paints.hdr"
    build = stage / "build-%root-product-0123456789ab"
    build.mkdir(parents=True)
    (build / "paints.sli").write_bytes(b"half")
    (stage / "hyperpaint").write_bytes(MARK_TEXT)
    hp.write_library(library, tmp_path / "paints.sli")
    assert not stage.exists()


def test_one_writer_at_a_time(library: xr.Dataset, tmp_path: Path) -> None:
    path = tmp_path / "paints.csv"

    def second(done: int, total: int) -> None:
        if done == total:  # it is there by now
            return
        expect_errors((StoreError, "is being written", lambda: hp.write_library(library, path)))

    hp.write_library(library, path, progress=second)
    assert hp.open_library(path).sizes["signature"] == 5


def test_a_header_too_large_to_be_read__is_refused(
    library: xr.Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(spectra_files, "MAX_LIBRARY_HEADER_BYTES", 500)
    expect_errors((ValueError, "file-too-large", lambda: hp.write_library(library, tmp_path / "paints.sli")))
    assert list(tmp_path.iterdir()) == []


def test_members_are_written_some_paints_at_a_time(tmp_path: Path) -> None:
    # Rationale: 40,000 lazy members of 100 bands are 16 MB; no more than two lots are in memory at once.
    import dask.array as da

    seen: list[int] = []

    def block(block_info: Any = None) -> np.ndarray:
        seen.append(block_info[None]["array-location"][0][0])
        return np.full((20, 100, 100), 0.5, np.float32)

    lazy = da.map_blocks(
        block, chunks=((20,) * 20, (100,), (100,)), dtype=np.float32, meta=np.empty((0, 0, 0), "f4")
    )
    library = xr.Dataset(
        {
            "reflectance": (("signature", "band"), np.full((400, 100), 0.5, np.float32), {"units": "1"}),
            "member_reflectance": (("signature", "member", "band"), lazy, {"units": "1"}),
        },
        coords={
            "signature": [f"paint {at}" for at in range(400)],
            "wavelength": ("band", np.linspace(400, 1000, 100), {"units": "nm"}),
        },
    )
    done: list[tuple[int, int]] = []
    path = hp.write_library(
        library, tmp_path / "many.sli", curves="all", progress=lambda *call: done.append((len(seen), call[0]))
    )
    assert seen == list(range(0, 400, 20))
    # what is computed is written before the next is
    assert [computed for computed, _ in done[1:]] == list(range(1, 21))
    assert path.stat().st_size == 4 * 100 * (400 + 40_000)
