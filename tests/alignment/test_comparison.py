"""Shift and width that separate camera and record, and how well they are known."""

import numpy as np
import pytest

import hyperpaint as hp
from hyperpaint.simulation import simulate_line


@pytest.mark.slow
def test_uncertainties_are_what_scatters() -> None:
    # Eight scenes of one camera, noise and smile: nothing is wrong, and shifts lie within their uncertainty
    away = []
    for seed in range(420, 428):
        line = simulate_line(lines=16, columns=48, seed=seed, irradiance_noise=1e-3, nonuniformity=0.0)
        found = hp.alignment.compared(line)
        assert found is not None
        assert not found.is_significant()
        away.append(
            np.array([found.shift, found.tilt, found.width - 1.0]) / np.sqrt(np.diag(found.covariance))
        )
    assert 0.2 < np.sqrt(np.mean(np.square(away))) < 1.6


def test_a_record_too_short_for_any_window_is_not_compared() -> None:
    assert (
        hp.alignment.compared(simulate_line(lines=16, columns=16).sel(irradiance_wavelength=slice(600, 680)))
        is None
    )


def test_air_below_the_camera_is_no_width_of_the_record() -> None:
    # One per cent of the oxygen that the light has crossed lies between ground and camera: 150 m or more
    line = hp.radiance(simulate_line(lines=24, columns=32, seed=431, noise=False)).drop_vars("counts")
    light = line.irradiance.values.mean(axis=0).astype(float)
    nm = line.wavelength.values
    seen = np.interp(nm, line.irradiance_wavelength.values, light)
    beside = np.interp(nm, [755.0, 772.0], [np.interp(at, nm, seen) for at in (755.0, 772.0)])
    path = np.where((nm > 755.0) & (nm < 772.0), np.minimum(seen / beside, 1.0), 1.0) ** 0.01
    cube = line.radiance.transpose("along_track", "band", "cross_track")
    deeper = line.assign(radiance=cube.copy(data=(cube.values * path[:, None]).astype("f4")))
    before, after = hp.alignment.compared(line), hp.alignment.compared(deeper)
    assert before is not None
    assert after is not None
    assert not after.is_significant()
    assert abs(after.width - before.width) < 0.015
