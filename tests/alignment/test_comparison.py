"""Shift and width that separate camera and record, and how well they are known."""

from __future__ import annotations

import numpy as np
import pytest

import hyperpaint as hp
from hyperpaint.simulation import simulate_line


@pytest.mark.slow
def test_uncertainties_are_what_scatters() -> None:
    """Eight scenes, noise and smile: nothing is wrong, and what is found lies within what is stated."""
    away = []
    for seed in range(420, 428):
        line = simulate_line(lines=48, columns=48, seed=seed, irradiance_noise=1e-3)
        found = hp.alignment.compared(line)
        assert found is not None
        assert not found.is_significant()
        numbers = np.array([found.shift, found.tilt, found.width - 1.0])
        away.append(numbers / np.sqrt(np.diag(found.covariance)))
    assert 0.2 < np.sqrt(np.mean(np.square(away))) < 1.6


def test_a_record_too_short_for_any_window_is_not_compared() -> None:
    line = simulate_line(lines=16, columns=16)
    assert hp.alignment.compared(line.sel(irradiance_wavelength=slice(600, 680))) is None
