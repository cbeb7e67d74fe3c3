"""Line profiles against numerical convolution, and fits against what was put in."""

import numpy as np
import pytest

from hyperpaint.kernels.arguments import LineFits, LineSamples
from hyperpaint.kernels.line_fits import (
    AREA,
    CENTRE,
    GAUSSIAN,
    OFFSET,
    SLIT,
    WIDTH,
    fit_lines,
    full_widths,
    line_profile,
    profiles,
)

CASES = [
    (shape, triangular, source)
    for shape in (GAUSSIAN, SLIT)
    for triangular in (False, True)
    for source in (0.0, 0.9, 5.4)
]


def convolved(x: np.ndarray, width: float, source: float, shape: int, triangular: bool) -> np.ndarray:
    # Return the profile by sums on a fine grid: an oracle that shares no formula with the kernel
    step = 0.002
    grid = np.arange(-20, 20 + step / 2, step)

    def box(w: float) -> np.ndarray:
        return np.clip((w / 2 - np.abs(grid)) / step + 0.5, 0, 1)

    def bell(w: float) -> np.ndarray:
        return np.exp(-4 * np.log(2) * (grid / w) ** 2)

    parts = [bell(width)] if shape == GAUSSIAN else [box(width), box(1.0)]
    if source > 0:
        parts.append(np.clip(1 - np.abs(grid) / source, 0, None) if triangular else bell(source))
    own = np.fft.ifft(np.prod([np.fft.fft(np.fft.ifftshift(part)) for part in parts], axis=0)).real
    return np.interp(x, grid, np.fft.fftshift(own) / (own.sum() * step))


@pytest.mark.parametrize(("shape", "triangular", "source"), CASES)
def test_profiles_are_convolutions(shape: int, triangular: bool, source: float) -> None:
    x = np.linspace(-8, 8, 81)
    made = np.array([line_profile(float(at), 2.7, source, shape, triangular) for at in x])
    np.testing.assert_allclose(made, convolved(x, 2.7, source, shape, triangular), atol=1e-3 * made.max())
    fine = np.arange(-30, 30, 0.01)[None]
    out = np.empty_like(fine)
    profiles(fine, np.array([2.7]), np.array([source]), shape, triangular, out)
    assert out.sum() * 0.01 == pytest.approx(1.0, abs=1e-6)
    assert (out >= 0).all()


def fitted(samples: LineSamples, start: np.ndarray, shape: int, triangular: bool) -> LineFits:
    # Return fits from start values; what is not written stays 0, and lines are not converged
    lines = len(start)
    fits = LineFits(start.copy(), np.zeros((lines, 4, 4)), np.zeros(lines), np.zeros(lines, bool))
    fit_lines(samples, shape, triangular, fits)
    return fits


def lamp_lines(truth: np.ndarray, light: np.ndarray, shape: int, triangular: bool) -> np.ndarray:
    values = np.empty((len(truth), 41))
    places = np.arange(41.0) - truth[:, CENTRE, None]
    profiles(places, truth[:, WIDTH].copy(), light, shape, triangular, values)
    return truth[:, AREA, None] * values + truth[:, OFFSET, None]


@pytest.mark.parametrize(("shape", "triangular", "source"), CASES)
def test_fits_find_what_was_put_in(shape: int, triangular: bool, source: float) -> None:
    truth, light = np.array([[20.3, 2.7, 5000.0, 3.0], [19.8, 3.1, 800.0, -1.0]]), np.full(2, source)
    values = lamp_lines(truth, light, shape, triangular)
    samples = LineSamples(values, np.ones((2, 41)), np.zeros(2, np.int64), light)
    fits = fitted(samples, truth * [1.0, 1.3, 0.8, 0.0] + [0.7, 0, 0, 0], shape, triangular)
    assert fits.converged.all()
    np.testing.assert_allclose(fits.parameters, truth, rtol=2e-5, atol=2e-3)


def test_covariance_is_that_of_repeated_fits() -> None:
    lines, sigma, none = 800, 20.0, np.zeros(800)
    truth = np.tile([20.3, 2.7, 5000.0, 3.0], (lines, 1))
    noise = sigma * np.random.default_rng(5).standard_normal((lines, 41))
    values = lamp_lines(truth, none, GAUSSIAN, False) + noise
    samples = LineSamples(values, np.full(values.shape, sigma**-2), np.zeros(lines, np.int64), none)
    fits = fitted(samples, truth, GAUSSIAN, False)
    assert fits.converged.all()
    told = np.sqrt(np.diagonal(fits.covariance, axis1=1, axis2=2)).mean(axis=0)
    np.testing.assert_allclose(fits.parameters.std(axis=0), told, rtol=0.1)
    assert fits.chi2.mean() == pytest.approx(37, rel=0.03)


def test_widths_are_where_the_profile_is_half() -> None:
    out = np.empty(1)
    for source, shape, width in ((1.0, GAUSSIAN, np.hypot(2.7, 1.0)), (0.0, SLIT, 2.7)):
        full_widths(np.array([2.7]), np.array([source]), shape, False, out)
        assert out[0] == pytest.approx(width, rel=1e-9)


def test_what_cannot_be_fitted_is_said() -> None:
    samples = LineSamples(np.zeros((2, 5)), np.zeros((2, 5)), np.zeros(2, np.int64), np.zeros(2))
    start = np.array([[np.nan, 1, 1, 0], [2.0, 1.0, 1.0, 0.0]])
    fits = LineFits(start, np.empty((2, 4, 4)), np.empty(2), np.ones(2, bool))
    fit_lines(samples, GAUSSIAN, False, fits)
    assert not fits.converged.any()
    assert np.isnan(fits.covariance).all()
