"""Camera and irradiance record are compared before a line is processed; the store says what was applied."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.commands import hyperpaint

import hyperpaint as hp
from hyperpaint.base.errors import CollectError, PaintWarning, SchemaError
from hyperpaint.simulation import simulate_collect
from hyperpaint.workflows.pipeline import run

GROUP = "flightlines/raw_0"


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # A collect whose record is 4 nm wide, where its collect.toml says 3
    folder = tmp_path_factory.mktemp("collect")
    path = simulate_collect(
        folder, lines=24, columns=32, scene="plan", seed=71, irradiance_fwhm_nm=4.0, noise=False
    )
    path.write_text(path.read_text().replace("fwhm_nm = 4.0", "fwhm_nm = 3.0"))
    return path


@pytest.fixture(scope="module")
def store(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return hp.process(source, tmp_path_factory.mktemp("store") / "lot.zarr")


def copy_of(source: Path, folder: Path, table: str) -> Path:
    shutil.copytree(source.parent, folder)
    path = folder / source.name
    path.write_text(path.read_text() + table)
    return path


def oxygen_error(line: xr.Dataset, source: Path) -> float:
    truth = xr.open_zarr(source.parent / "truth.zarr").reflectance.values
    measured = line.reflectance.values.astype(float)
    near = abs(line.wavelength.values - 760.5) < 6
    ratio = np.nanmean(measured, axis=(0, 2)) / np.nanmean(
        np.where(np.isnan(measured), np.nan, truth), axis=(0, 2)
    )
    return float(abs(ratio - 1)[near].max())


def test_a_wrong_width_is_corrected_by_default(source: Path, store: Path) -> None:
    line = hp.open_store(store, GROUP)
    assert (line.attrs["alignment_state"], line.attrs["alignment_width"]) == (
        "applied",
        pytest.approx(4 / 3, abs=0.02),
    )
    assert "irradiance record corrected in flight" in line.attrs["alignment"]
    assert oxygen_error(line, source) < 0.003


def test_a_store_computes_again_what_it_holds(store: Path) -> None:
    line = hp.open_store(store, GROUP)
    again = hp.reflectance(line.drop_vars("reflectance"), keep_bits=12)
    np.testing.assert_array_equal(again.reflectance, line.reflectance)
    assert hp.open_store(store, "irradiance").irradiance_fwhm.values == pytest.approx(3.0)


def test_a_rerun_changes_nothing(source: Path, store: Path) -> None:
    assert run(source, store).written == ()


def test_never_is_a_warning_and_the_collect_may_say_so(source: Path, tmp_path: Path) -> None:
    path = copy_of(source, tmp_path / "raw", '\n[alignment]\napply = "never"\n')
    with pytest.warns(PaintWarning, match="irradiance record differ"):
        hp.process(path, tmp_path / "lot.zarr")
    line = hp.open_store(tmp_path / "lot.zarr", GROUP)
    assert line.attrs["alignment_state"] == "not applied"
    assert oxygen_error(line, source) > 0.02


def test_words_are_checked(source: Path, tmp_path: Path) -> None:
    with pytest.raises(SchemaError, match="choice-unknown"):
        hp.process(source, tmp_path / "lot.zarr", alignment="yes")  # type: ignore[arg-type]
    path = copy_of(source, tmp_path / "raw", '\n[alignment]\napply = "yes"\n')
    with pytest.raises(CollectError, match="alignment"):
        hp.process(path, tmp_path / "lot.zarr")


def test_the_command_line_says_what_was_corrected(source: Path, tmp_path: Path) -> None:
    options = ["--out", str(tmp_path / "lot.zarr"), "--alignment", "auto", "--quiet"]
    done = hyperpaint("process", source, *options, status=0)
    assert "/flightlines/raw_0: irradiance record corrected in flight" in done.output
