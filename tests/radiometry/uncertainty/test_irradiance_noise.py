"""Noise of an irradiance record, from the record, and what bands see of it."""

import numpy as np
import pytest
from support.noisy_collects import BANDS, noisy_collect

from hyperpaint.light.illumination import matched_noise, noise_of_record
from hyperpaint.radiometry.uncertainty import estimate_noise

CHANNELS = np.arange(350.0, 1051.0)


def record(samples: int, seed: int, noise: float = 0.004) -> tuple[np.ndarray, np.ndarray]:
    # Return spectra with a band of absorption under light that changes by 20 %, and their times
    rng = np.random.default_rng(seed)
    seconds = 2.0 * np.arange(samples) + rng.uniform(-0.2, 0.2, samples)
    sky = 1.0 - 0.3 * np.exp(-(((CHANNELS - 760.0) / 5.0) ** 2))
    light = 1.0 + 0.2 * np.sin(seconds / 7.0)[:, None] * (1.0 + 0.3 * (CHANNELS - 700.0) / 350.0)
    size = noise * (1.0 + (CHANNELS - 350.0) / 700.0)
    spectra = sky * light * (1.0 + size * rng.standard_normal((samples, CHANNELS.size)))
    return spectra, np.datetime64("2020-06-21", "ns") + (seconds * 1e9).astype("timedelta64[ns]")


def over_truth(spectra: np.ndarray, times: np.ndarray, **options: int) -> np.ndarray:
    # Return the noise that a record tells over its own
    noise = noise_of_record(spectra, times, **options)
    assert noise is not None
    return noise / (0.004 * (1.0 + (CHANNELS - 350.0) / 700.0))


@pytest.mark.parametrize(("samples", "within"), [(12, 0.3), (400, 0.1)])
def test_noise_is_told_from_changes_of_light(samples: int, within: float) -> None:
    ratio = over_truth(*record(samples, 3))
    assert abs(ratio.mean() - 1.0) < 0.05
    assert np.percentile(np.abs(ratio - 1.0), 95) < within


def test_channels_without_light_and_gaps_in_time() -> None:
    spectra, times = record(30, 4)
    spectra[:, :40], spectra[3, 300] = 0.0, np.nan
    times[15:] += np.timedelta64(300, "s")
    noise = noise_of_record(spectra, times)
    assert noise is not None
    assert np.isfinite(noise).all()
    assert noise[:40] == pytest.approx(noise[40])
    assert noise_of_record(spectra[:5], times[:5]) is None
    assert noise_of_record(spectra[:, :10], times) is None


def test_three_samples_tell_where_that_is_asked_and_lost_ones_count_for_nothing() -> None:
    spectra, times = record(40, 7)
    assert over_truth(spectra[:3], times[:3], fewest=1).mean() == pytest.approx(1.0, abs=0.15)
    assert noise_of_record(spectra[:2], times[:2], fewest=1) is None
    spectra[[5, 20]], spectra[30] = np.nan, 0.0
    assert over_truth(spectra, times).mean() == pytest.approx(1.0, abs=0.05)
    assert noise_of_record(np.full_like(spectra, np.nan), times) is None


def test_a_flight_tells_the_noise_of_its_record() -> None:
    line = noisy_collect(np.random.default_rng(5), 2400, 2, 10, gain_u=0.0)
    found = estimate_noise(line.drop_vars("irradiance_u_random"))
    assert found.irradiance_u_random.dims == ("irradiance_wavelength",)
    assert float(found.irradiance_u_random.mean()) == pytest.approx(0.005, rel=0.15)
    quiet = noisy_collect(np.random.default_rng(5), 2400, 2, 10, gain_u=0.0, irradiance_u=0.0)
    assert "irradiance_u_random" not in estimate_noise(quiet)


def test_bands_average_the_channels_they_are_matched_from() -> None:
    line = noisy_collect(np.random.default_rng(6), 4, 3, 10)
    arrays = {name: line[name].values for name in line.variables} | dict(line.attrs)
    _, covariance = matched_noise(arrays)
    assert covariance.shape == (BANDS, BANDS)
    own = np.sqrt(np.diagonal(covariance))
    assert (own < 0.005).all()
    # many draws of the same record, matched as the chain does
    noise = np.random.default_rng(7).standard_normal((400, 1, line.irradiance.shape[1]))
    drawn = line.irradiance.values[:1] * (1.0 + 0.005 * noise)
    draws = np.array([matched_noise({**arrays, "irradiance": spectra})[0] for spectra in drawn])
    np.testing.assert_allclose(own, draws.std(axis=0) / draws.mean(axis=0), rtol=0.2)
    between = np.corrcoef(draws.T)[3, 4]
    assert covariance[3, 4] / (own[3] * own[4]) == pytest.approx(between, abs=0.12)
