"""From a sweep on disk to a calibration on disk, on the command line and inside a collect."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner
from support.codecs import plain_zarr
from support.refusals import expect_error, expect_refusals, expect_words

import hyperpaint as hp
from hyperpaint.base.errors import CollectError, FormatError
from hyperpaint.cli.program import main
from hyperpaint.io.collect.collect_toml import open_with_settings
from hyperpaint.io.flightline.calibration_store import open_calibration, open_sweep
from hyperpaint.simulation import simulate_collect, simulate_sweep


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("lab")
    sweep = simulate_sweep(steps=31, bands=136, columns=6, nonuniformity=0)
    truth = [name for name in sweep.variables if str(name).startswith("true_")]
    plain_zarr(sweep.drop_vars(truth).chunk(step=1), folder / "sweep.zarr")
    return folder


def test_what_is_written_is_read(lab: Path, tmp_path: Path) -> None:
    made = hp.calibrate(open_sweep(lab / "sweep.zarr"))
    hp.to_store(made, tmp_path / "cal.zarr")
    back = open_calibration(tmp_path / "cal.zarr")
    for name in made.variables:
        np.testing.assert_array_equal(back[name].values, made[name].values, err_msg=str(name))
        assert back[name].dtype == made[name].dtype, name
        assert (name in back.coords) == (name in made.coords), name
    assert (back.srf_shape, back.wavelength_residual_nm) == (made.srf_shape, made.wavelength_residual_nm)


def run(sweep: Path, out: Path, code: int, *words: str, options: tuple[str, ...] = ()) -> None:
    # Calibrate on the command line, and expect an exit code, these words, and no traceback
    done = CliRunner().invoke(main, ["calibrate", str(sweep), "--out", str(out), *options])
    assert done.exit_code == code, done.output
    expect_words(done.output, *words, without=("Traceback",))


@pytest.mark.slow
def test_command_line(lab: Path, tmp_path: Path) -> None:
    sweep, out, other = lab / "sweep.zarr", tmp_path / "cal.zarr", ("--flux-uncertainty", "0.02")
    run(sweep, out, 0, "of 136 bands have a gain", "line shape gaussian, FWHM 6.")
    assert hp.verify(out).ok
    run(sweep, out, 0)
    run(sweep, out, 2, "--overwrite", options=other)
    run(sweep, out, 0, options=(*other, "--wavelength-uncertainty", "0.2", "--overwrite"))
    made = open_calibration(out)
    assert (made.flux_uncertainty, float(made.wavelength_u)) == (0.02, pytest.approx(0.2, rel=0.01))


def test_command_line_says_what_is_wrong(lab: Path, tmp_path: Path) -> None:
    out = tmp_path / "cal.zarr"
    run(tmp_path, out, 2, "not a readable Zarr store")
    run(lab / "sweep.zarr", lab / "sweep.zarr", 2, "is the sweep itself")
    bad = xr.open_zarr(lab / "sweep.zarr", consolidated=False).drop_vars("flux")
    bad.to_zarr(tmp_path / "bad.zarr", zarr_format=3, consolidated=False)
    run(tmp_path / "bad.zarr", out, 2, "'flux' is missing")
    assert not out.exists()


def test_other_stores_are_no_sweeps(tmp_path: Path) -> None:
    expect_error(FormatError, "no such sweep", lambda: open_sweep(tmp_path / "nothing.zarr"))
    plain_zarr(xr.Dataset({"a": ("x", [1.0])}), tmp_path / "a.zarr")
    expect_refusals((FormatError, "counts-missing", lambda: open_sweep(tmp_path / "a.zarr")))


@pytest.fixture(scope="module")
def collect(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # A collect flown with the camera of a sweep, which calibrates it
    folder = tmp_path_factory.mktemp("collect")
    same = {"bands": 136, "columns": 6, "nonuniformity": 0}
    path = simulate_collect(folder / "c", scene="plan", lines=40, **same)
    sweep = simulate_sweep(**same)
    truth = [name for name in sweep.variables if str(name).startswith("true_")]
    plain_zarr(sweep.drop_vars(truth), folder / "c" / "lab.zarr")
    text = path.read_text()
    assert 'path = "calibration.zarr"' in text
    path.write_text(text.replace('path = "calibration.zarr"', 'sweep = "lab.zarr"'))
    return path


def test_a_collect_is_calibrated_on_the_way(collect: Path) -> None:
    tree = hp.open_collect(collect)
    made = tree["calibration"].to_dataset()
    assert made.sweep == "lab.zarr"
    truth = open_calibration(collect.parent / "calibration.zarr")
    assert np.nanmax(np.abs((made.radiance_gain / truth.radiance_gain - 1).values[10:-10])) < 1e-2
    line = tree["flightlines/raw_0"].to_dataset()
    assert not [name for name in line.variables if str(name).startswith(("line_", "beam_", "stray"))]
    assert line.radiance_gain_u_systematic.dims == ("band",)
    reflectance = line.paint.reflectance().reflectance.values
    assert np.isfinite(reflectance[:, 20:-20]).mean() > 0.9
    expect_refusals((CollectError, "calibrate-missing", lambda: open_with_settings(collect)))


def test_a_collect_has_one_calibration(collect: Path, tmp_path: Path) -> None:
    text = collect.read_text().replace('sweep = "lab.zarr"', 'sweep = "lab.zarr"\npath = "calibration.zarr"')
    both = collect.with_name("both.toml")
    both.write_text(text)
    expect_refusals((CollectError, "option-conflict", lambda: hp.open_collect(both)))
