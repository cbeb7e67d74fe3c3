"""Shift and width that separate camera and record, and how well they are known."""

from pathlib import Path

import numpy as np
import pytest

import hyperpaint as hp
from hyperpaint.alignment.comparison import divided, record_against_sun
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


# --- the record alone against the sun's lines ---------------------------------------------------------------


@pytest.mark.parametrize("width", [3.0, 4.0])
def test_a_simulated_record_is_found(width: float) -> None:
    record = simulate_line(lines=4, columns=4, bands=4, irradiance_fwhm_nm=width, seed=311)
    seen = record.irradiance.values.mean(axis=0).astype(float)
    found = record_against_sun(record.irradiance_wavelength.values - 0.33, seen)
    assert found is not None
    assert abs(found.shift - 0.33) < 2 * found.shift_u < 0.3
    assert abs(found.width - width) < 2 * found.width_u < 1.0


def test_a_record_of_few_channels_says_nothing() -> None:
    channels = np.arange(400.0, 1000.0, 10.0)
    assert record_against_sun(channels, np.ones(channels.size)) is None


def test_without_a_sun_what_is_believed_before_divides() -> None:
    apart = divided((-0.5, 0.01), (1.0, 0.01), None, (3.0, 6.0))
    assert apart["camera_shift"] - apart["record_shift"] == pytest.approx(-0.5, abs=0.01)
    assert apart["record_shift"] > -apart["camera_shift"] > 0.0
    assert apart["record_fwhm"] == pytest.approx(3.0)


@pytest.mark.real_data
def test_a_real_field_spectrometer_stands_eight_tenths_off(shared_data: Path) -> None:
    # Real irradiance of an ASD; its three windows agree to 0.15 nm. No other measurement of it is known.
    text = (shared_data / "asd_ascii" / "asd-e-irrad-sky.tsv").read_text(errors="replace")
    cells = [line.split("\t") for line in text.splitlines()]
    rows = [(float(one[0]), float(one[1])) for one in cells if len(one) == 2 and one[0].isdigit()]
    channels, seen = np.array(rows).T
    found = record_against_sun(channels, seen)
    assert found is not None
    assert found.shift == pytest.approx(-0.8, abs=0.1)
    assert 2.5 < found.width < 4.5
