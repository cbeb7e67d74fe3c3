"""What `describe_path` says of files and stores; the command line's own tests cover every kind of file."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.codecs import plain_zarr
from support.commands import hyperpaint
from support.library_examples import make_library
from support.refusals import expect_error, expect_refusals, expect_words
from support.tiny_collects import tiny_collect

import hyperpaint as hp
from hyperpaint.cli.info_command import describe_path
from hyperpaint.io.store.writer import WholeRun
from hyperpaint.report import write_report


@pytest.fixture
def line() -> xr.Dataset:
    counts = np.ones((40, 3, 2), np.uint16)
    return xr.Dataset(
        {
            "counts": (("along_track", "band", "cross_track"), counts, {"units": "count"}),
            "exposure_time": ((), 0.005, {"units": "s"}),
            "read_noise": ((), np.float32(2.0), {"units": "count"}),
        },
        {"wavelength": ("band", [450.0, 550.0, 650.0], {"units": "nm"})},
        {"exposure_source": "collect.toml"},
    )


def test_groups_say_whether_they_are_complete(tmp_path: Path, line: xr.Dataset) -> None:
    hp.to_store(line, tmp_path / "lot.zarr", "flightlines/raw_0")
    expect_words(
        describe_path(tmp_path / "lot.zarr"),
        "1 group with arrays",
        "state: complete, written 20",
        "counts: 40 along_track x 3 band x 2 cross_track, uint16 [count]",
        "wavelength: 450 to 650 nm",
        "exposure: 5 ms (collect.toml)",
        "also holds: read_noise",
    )
    hp.to_store(line, tmp_path / "damaged.zarr")
    next((tmp_path / "damaged.zarr/counts/c").rglob("*/0/0")).unlink()
    assert "NOT COMPLETE: " in describe_path(tmp_path / "damaged.zarr")
    # a copy without a manifest, and a store of another program
    plain_zarr(line.assign_attrs(hyperpaint_version="0.1"), tmp_path / "copy.zarr")
    plain_zarr(line, tmp_path / "other.zarr")
    unknown = "not in a manifest, so that completeness is unknown; written at an unknown time by another"
    expect_words(describe_path(tmp_path / "copy.zarr"), "not in a manifest", without=("another program",))
    expect_words(describe_path(tmp_path / "other.zarr"), unknown, without=("NOT COMPLETE",))
    expect_refusals(
        (hp.FormatError, "file-not-found", lambda: describe_path(tmp_path / "none")),
        (hp.StoreError, "format-unknown", lambda: describe_path(tmp_path)),
    )


def test_the_simulators_stores(tmp_path: Path) -> None:
    collect = hp.simulate_collect(tmp_path / "sim", scene="plan", lines=8, bands=4, columns=4)
    for name in ("calibration.zarr", "truth.zarr"):
        assert "not in a manifest" in describe_path(collect.parent / name)
    assert "5 ms (collect.toml)" in describe_path(collect)


@pytest.mark.parametrize("name", ["paints.sli", "paints.csv", "paints.zarr"])
def test_a_paint_library(tmp_path: Path, name: str) -> None:
    path = hp.write_library(make_library().isel(band=[0, 1, 4]), tmp_path / name)
    text = describe_path(path)
    expect_words(text, "Grün; Grün", "reflectance", "400 to 800 nm")
    if path.suffix != ".zarr":
        expect_words(text, "5 spectra", "make")


def test_a_folder_of_texts_of_single_spectra() -> None:
    folder = Path(__file__).parents[1] / "io" / "library" / "conformance" / "ecostress"
    assert "3 spectra" in describe_path(folder)


# --- `verify`, `info` and `report` of a store that is not whole: what it lacks, and how to finish it ---


@pytest.fixture
def collect(tmp_path: Path) -> Path:
    return tiny_collect(tmp_path / "raw", 2)


def test_an_unfinished_store_says_how_it_is_finished(
    collect: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, write = tmp_path / "lot.zarr", WholeRun.write

    def stop(self: WholeRun, group: str, dataset: xr.Dataset, **options: Any) -> None:
        if group.endswith("raw_1"):
            raise KeyboardInterrupt
        write(self, group, dataset, **options)

    monkeypatch.setattr(WholeRun, "write", stop)
    expect_error(KeyboardInterrupt, None, lambda: hp.process(collect, out, to="radiance"))
    again = "unfinished: 1 of 2 groups are written, without /flightlines/raw_1; to finish it"
    for command, status in (("verify", 1), ("info", 0)):
        expect_words(hyperpaint(command, out, status=status).output, again, f"--out {out} --to radiance")
    page = write_report(out, tmp_path / "report.html")
    assert page.flightlines == ("flightlines/raw_0",)
    assert again[:40] in page.problems[0]


def test_inputs_are_compared_on_request(collect: Path, tmp_path: Path) -> None:
    out = hp.process(collect, tmp_path / "lot.zarr", to="radiance")
    assert "all unchanged" in hyperpaint("verify", out, "--inputs", status=0).output
    collect.with_name("raw_0").write_bytes(bytes(collect.with_name("raw_0").stat().st_size))
    changed = hyperpaint("verify", out, "--collect", collect, status=1).output
    assert "/flightlines/raw_0: its inputs have changed" in changed
    hyperpaint("verify", out, status=0)
