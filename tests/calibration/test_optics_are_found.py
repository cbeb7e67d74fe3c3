"""What optics and electronics of the simulated camera do, as the calibration of its lab sweep finds it.

Smile, stray light and a dark that is off have estimators. Keystone has one where the beam is narrow and stays
where it is: `beam_centre`. A point spread has none: all columns of a monochromator's light look alike.
"""

import warnings
from typing import Any

import numpy as np
import pytest

import hyperpaint as hp
from hyperpaint.base.errors import PaintWarning
from hyperpaint.io.flightline.side_files import calibration_parts, check_calibration
from hyperpaint.simulation import simulate_line, simulate_sweep

CAMERA: dict[str, Any] = {"bands": 136, "columns": 12}
EXACT: dict[str, Any] = {"noise": False, "quantise": False}


@pytest.mark.parametrize("share", [0.005, 0.02])
def test_stray_light_of_the_sweep_mends_a_flight(share: float) -> None:
    sweep = simulate_sweep(**CAMERA, stray_light=share)
    matrix, truth = hp.calibrate(sweep).stray_light.values, sweep.true_stray_light.values
    # what falls into a line's own window cannot be told from the line
    far = np.abs(np.subtract.outer(np.arange(136), np.arange(136))) > 12
    assert matrix[far].sum() == pytest.approx(truth[far].sum(), rel=0.1)
    flight: dict[str, Any] = {"lines": 24, "glint": 0.0, **CAMERA, **EXACT}
    hazy, clear = simulate_line(**flight, stray_light=share), simulate_line(**flight)
    seen, true = ((line.counts - line.dark_counts).astype("f8") for line in (hazy, clear))
    mended = np.einsum("bs,lsx->lbx", np.linalg.inv(np.eye(136) + matrix), seen.values)
    error = {
        name: float(np.median(np.abs(cube / true.values - 1)))
        for name, cube in (("none", seen.values), ("swept", mended))
    }
    assert error["none"] == pytest.approx(share, rel=0.1)
    assert error["swept"] < 0.3 * share


@pytest.mark.filterwarnings("ignore:.*counts-averaged")
def test_reflectance_is_freed_of_wings_by_the_sweep_that_holds_them() -> None:
    # By default, by gain and matrix of one calibration, against a camera without wings
    camera: dict[str, Any] = {"bands": 136, "columns": 24, "nonuniformity": 0.02, "seed": 21}
    flight: dict[str, Any] = {"lines": 24, "glint": 0.0, **camera, **EXACT}

    def seen(stray: dict[str, float]) -> list[np.ndarray]:
        # with the gain alone, and with the wings
        calibration = hp.calibrate(simulate_sweep(**camera, **stray))
        parts = calibration_parts(check_calibration(calibration), is_counts=True)
        line = simulate_line(**flight, **stray)
        lines = [
            line.assign({name: parts[name] for name in names if name in parts})
            for names in (gain, gain + wings)
        ]
        return [np.asarray(each.paint.reflectance().reflectance.values) for each in lines]

    gain, wings = ["radiance_gain"], ["stray_light", "stray_light_u"]
    without, expected = seen({})  # without any, nothing is subtracted
    np.testing.assert_array_equal(expected, without)
    for share in (0.01, 0.03):
        unaware, mended = (
            np.nanmedian(np.abs(found / expected - 1.0)[:, 4:-4], axis=(0, 2))
            for found in seen({"stray_light": share})
        )
        np.testing.assert_array_less([share, mended.max(), np.median(mended)], [unaware.max(), 3e-3, 1e-3])


@pytest.mark.parametrize("pedestal", [-3.0, 2.0, 5.0])
def test_a_pedestal_is_the_dark_that_is_off(pedestal: float) -> None:
    with pytest.warns(PaintWarning, match="dark-offset"):
        calibration = hp.calibrate(simulate_sweep(**CAMERA, pedestal=pedestal))
    assert calibration.dark_offset_count == pytest.approx(pedestal, abs=0.02)


def test_smile_is_found_behind_any_optics() -> None:
    optics = {"psf_across_columns": 2.0, "keystone_columns": 0.6, "stray_light": 0.01}
    sweep = simulate_sweep(bands=136, columns=40, smile_nm=0.8, **optics)
    assert float(np.abs(hp.calibrate(sweep).wavelength_shift - sweep.true_wavelength_shift).max()) < 0.02


def test_masked_columns_have_no_gain() -> None:
    with pytest.warns(PaintWarning, match=r"4 of 12 .*columns-unlit"):
        calibration = hp.calibrate(simulate_sweep(**CAMERA, masked_columns=2))
    is_blind = np.isnan(calibration.radiance_gain.values).all(axis=0)
    np.testing.assert_array_equal(is_blind, np.isin(np.arange(12), [0, 1, 10, 11]))


@pytest.mark.parametrize(("nonuniformity", "tolerance"), [(0.0, 0.01), (0.02, 0.06)])
def test_a_narrow_beam_shows_the_keystone(nonuniformity: float, tolerance: float) -> None:
    sweep = simulate_sweep(
        bands=136, columns=41, beam_fwhm_columns=12.0, smile_nm=0.0, keystone_columns=0.6,
        nonuniformity=nonuniformity,
    )  # fmt: skip
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "22 of 41 columns are not lit", PaintWarning)
        calibration = hp.calibrate(sweep)
    keystone = np.interp(sweep.step_wavelength, sweep.true_wavelength, sweep.true_keystone)
    assert np.nanmax(np.abs(calibration.beam_centre.values - 20.0 - keystone)) < tolerance


def test_an_even_beam_shows_no_keystone() -> None:
    plain, skew = (simulate_sweep(**CAMERA, steps=5, keystone_columns=k) for k in (0.0, 0.6))
    np.testing.assert_allclose(plain.counts, skew.counts, rtol=1e-6)
