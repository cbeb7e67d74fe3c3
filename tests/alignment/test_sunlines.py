"""The record alone against the sun's lines."""

from pathlib import Path

import numpy as np
import pytest

from hyperpaint.alignment.comparison import divided, record_against_sun
from hyperpaint.simulation import simulate_line


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
