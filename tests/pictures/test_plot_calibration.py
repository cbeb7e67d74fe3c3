"""The figure of a calibration: what is drawn is what was found, and calls that cannot be are refused."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner
from support.codecs import plain_zarr
from support.refusals import expect_errors, expect_refusals

from hyperpaint import calibrate
from hyperpaint.base.errors import MissingExtraError, PaintWarning, SchemaError
from hyperpaint.calibration.calibration_dataset import fitted_lines
from hyperpaint.cli.program import main
from hyperpaint.pictures.figures import check_picture
from hyperpaint.pictures.plot import calibration_report
from hyperpaint.simulation import simulate_sweep

COLUMNS, STEPS = 6, 31


@pytest.fixture(scope="module")
def sweep() -> xr.Dataset:
    return simulate_sweep(steps=STEPS, bands=136, columns=COLUMNS, smile_nm=1.5, seed=2)


@pytest.fixture(scope="module")
def calibration(sweep: xr.Dataset) -> xr.Dataset:
    return calibrate(sweep)


@pytest.fixture(scope="module")
def figure(sweep: xr.Dataset, calibration: xr.Dataset) -> Any:
    pytest.importorskip("matplotlib")
    return calibration_report(calibration, sweep)


def panel(figure: Any, title: str) -> Any:
    # Return the axes whose title opens with these words
    (found,) = (axes for axes in figure.axes if axes.get_title().startswith(title))
    return found


def curve(axes: Any, label: str) -> np.ndarray:
    (found,) = (line for line in axes.get_lines() if str(line.get_label()).startswith(label))
    return np.asarray(found.get_ydata(), np.float64)


def test_every_axis_says_what_it_shows(figure: Any) -> None:
    titles = (
        "lamp lines",
        "wavelength residual",
        "smile",
        "width of",
        "responsivity",
        "standard uncertainty",
    )
    ylabels = [panel(figure, title).get_ylabel() for title in titles]
    assert ylabels == [
        *("counts above dark [count]", "cross_track [column]", "cross_track [column]", "FWHM [nm]"),
        *("counts per joule in a pixel [count J$^{-1}$]", "relative to the gain [%]"),
    ]
    assert all(panel(figure, title).get_xlabel() == "wavelength [nm]" for title in titles[1:])
    bars = {axes.get_ylabel() for axes in figure.axes}
    assert {"map - monochromator [nm]", "wavelength shift [nm]"} <= bars
    assert f"{STEPS} of {STEPS} steps used" in figure.get_suptitle()


def test_lines_are_the_counts_of_the_sweep(figure: Any, sweep: xr.Dataset, calibration: xr.Dataset) -> None:
    axes = panel(figure, "lamp lines and")
    assert axes.get_title().endswith(f"column {COLUMNS // 2}")
    curves = [line for line in axes.get_lines() if str(line.get_label()).endswith(" nm")]
    points = [line for line in axes.get_lines() if line.get_marker() == "o"]
    assert len(curves) == len(points) == 5
    for fit, drawn in zip(curves, points, strict=True):
        at = float(str(fit.get_label()).removesuffix(" nm"))
        counts = (sweep.counts.sel(step=sweep.step_wavelength == at) - sweep.dark_counts)[0, :, COLUMNS // 2]
        assert drawn.get_ydata().max() == pytest.approx(float(counts.max()), abs=3.0)
        # between the points, the fit is where the counts would be
        there = np.interp(drawn.get_xdata(), fit.get_xdata(), fit.get_ydata())
        np.testing.assert_allclose(there, drawn.get_ydata(), atol=0.05 * fit.get_ydata().max())
    low, high = (axes.get_xlim() for axes in (axes, figure.axes[1]))
    assert low == high


@pytest.mark.parametrize("shape", ["gaussian", "slit"])
@pytest.mark.parametrize("light", ["gaussian", "triangle"])
def test_fits_of_exact_lines_leave_nothing(shape: str, light: str) -> None:
    exact: Any = {"noise": False, "quantise": False, "nonuniformity": 0.0}
    sweep = simulate_sweep(
        steps=13, bands=272, columns=3, srf_shape=shape, monochromator_shape=light,
        monochromator_fwhm_nm=4.0, **exact,
    )  # fmt: skip
    for line in fitted_lines(calibrate(sweep), sweep, [3, 6, 9], 1):
        assert line.counts.size > 5
        assert np.abs(line.residual).max() < 0.01
        assert line.curve.max() == pytest.approx(line.counts.max(), rel=0.1)


def test_maps_and_curves_are_those_of_the_calibration(figure: Any, calibration: xr.Dataset) -> None:
    residual = panel(figure, "wavelength residual").collections[0].get_array()
    expected = calibration.line_centre - calibration.step_wavelength
    np.testing.assert_allclose(residual.filled(np.nan), expected.where(calibration.line_trusted).values.T)
    np.testing.assert_allclose(
        panel(figure, "smile").collections[0].get_array(), calibration.wavelength_shift.values.T
    )
    np.testing.assert_array_equal(curve(panel(figure, "width of"), "calibration"), calibration.fwhm)
    response = panel(figure, "responsivity")
    np.testing.assert_array_equal(
        curve(response, f"column {COLUMNS // 2}"), calibration.responsivity[:, COLUMNS // 2]
    )
    assert len(response.collections[0].get_segments()) == COLUMNS


def test_uncertainties_add_in_squares(figure: Any, calibration: xr.Dataset) -> None:
    axes = panel(figure, "standard uncertainty")
    random, common = curve(axes, "random"), curve(axes, "systematic")
    np.testing.assert_allclose(curve(axes, "both"), np.hypot(random, common))
    np.testing.assert_allclose(common, 100 * calibration.radiance_gain_u_systematic, rtol=1e-6)
    assert np.nanmedian(common) == pytest.approx(4.0, rel=0.05)  # the power meter's


def test_bands_without_a_gain_are_shaded(figure: Any, calibration: xr.Dataset) -> None:
    bad = ~calibration.good.values
    assert bad[0]
    assert bad[-1]
    for title in ("width of", "responsivity", "standard uncertainty"):
        patches = panel(figure, title).patches
        assert len(patches) == 2
        left, right = (patch.get_extents() for patch in patches)
        data = panel(figure, title).transData.inverted()
        (end, _), (begin, _) = data.transform([(left.x1, 0), (right.x0, 0)])
        inside = (calibration.wavelength > end) & (calibration.wavelength < begin)
        np.testing.assert_array_equal(inside, calibration.good)


def test_without_the_sweep_fits_stand_alone(calibration: xr.Dataset) -> None:
    pytest.importorskip("matplotlib")
    axes = panel(calibration_report(calibration, column=0), "lamp lines and")
    assert axes.get_title().endswith("column 0")
    assert sum(line.get_xdata().size > 0 for line in axes.get_lines()) == 5


def test_unlit_columns_and_single_columns_are_drawn() -> None:
    pytest.importorskip("matplotlib")
    beam = simulate_sweep(steps=13, bands=136, columns=24, beam_fwhm_columns=6.0, seed=1)
    with pytest.warns(PaintWarning, match="columns are not lit"):
        calibration = calibrate(beam)
    assert not calibration.line_trusted.any("step").all()
    assert "column 12" in panel(calibration_report(calibration, beam), "lamp lines and").get_title()
    dark = panel(calibration_report(calibration, beam, column=0), "lamp lines and")
    assert not [line for line in dark.get_lines() if line.get_xdata().size]
    narrow = simulate_sweep(steps=13, bands=136, columns=1)
    assert len(calibration_report(calibrate(narrow), narrow).axes) == 9


def test_what_cannot_be_drawn_is_refused(sweep: xr.Dataset, calibration: xr.Dataset, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    with pytest.raises(SchemaError) as refused:
        calibration_report(calibration, sweep.isel(step=slice(9)), column=9)
    assert refused.value.codes == ("grid-mismatch", "value-out-of-range")
    expect_refusals(
        (
            SchemaError,
            "variable-missing",
            "line_band",
            lambda: calibration_report(calibration.drop_vars("line_band")),
        ),
        (
            SchemaError,
            "suffix-unknown",
            "cal.xls",
            ".pdf",
            ".png",
            lambda: check_picture(tmp_path / "cal.xls"),
        ),
        (SchemaError, "folder-missing", lambda: check_picture(tmp_path / "none" / "cal.png")),
    )


def test_without_matplotlib(monkeypatch: pytest.MonkeyPatch, calibration: xr.Dataset) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    expect_errors((MissingExtraError, r"\[viz\].*extra-missing", lambda: calibration_report(calibration)))


@pytest.mark.slow
def test_command_line_writes_the_picture(sweep: xr.Dataset, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    known = [name for name in sweep.variables if not str(name).startswith("true_")]
    plain_zarr(sweep[known], tmp_path / "sweep.zarr")

    def call(picture: str) -> Any:
        paths = [str(tmp_path / name) for name in ("sweep.zarr", "cal.zarr", picture)]
        return CliRunner().invoke(main, ["calibrate", paths[0], "--out", paths[1], "--picture", paths[2]])

    refused = call("report.xls")
    assert refused.exit_code == 2
    assert "suffix-unknown" in refused.stderr
    assert not (tmp_path / "cal.zarr").exists()  # before anything is computed
    done = call("report.png")
    assert done.exit_code == 0, done.stderr
    assert done.stdout.splitlines()[-1] == f"look at it in {tmp_path / 'report.png'}"
    assert (tmp_path / "report.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "cal.zarr").is_dir()
