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
    if shape == GAUSSIAN:
        own = np.exp(-4 * np.log(2) * (grid / width) ** 2)
    else:
        box = lambda w: np.clip((w / 2 - np.abs(grid)) / step + 0.5, 0, 1)  # noqa: E731
        own = np.convolve(box(width), box(1.0), mode="same")
    if source > 0:
        if triangular:
            light = np.clip(1 - np.abs(grid) / source, 0, None)
        else:
            light = np.exp(-4 * np.log(2) * (grid / source) ** 2)
        own = np.fft.fftshift(
            np.fft.ifft(np.fft.fft(np.fft.ifftshift(own)) * np.fft.fft(np.fft.ifftshift(light))).real
        )
    own /= own.sum() * step
    return np.interp(x, grid, own)


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


@pytest.mark.parametrize(("shape", "triangular", "source"), CASES)
def test_fits_find_what_was_put_in(shape: int, triangular: bool, source: float) -> None:
    truth = np.array([[20.3, 2.7, 5000.0, 3.0], [19.8, 3.1, 800.0, -1.0]])
    places = np.arange(41.0)
    values = np.empty((2, 41))
    light = np.full(2, source)
    profiles(places - truth[:, CENTRE, None], truth[:, WIDTH].copy(), light, shape, triangular, values)
    values = truth[:, AREA, None] * values + truth[:, OFFSET, None]
    found = truth * [1.0, 1.3, 0.8, 0.0] + [0.7, 0, 0, 0]
    covariance, chi2, converged = np.empty((2, 4, 4)), np.empty(2), np.zeros(2, bool)
    samples = LineSamples(values, np.ones((2, 41)), np.zeros(2, np.int64), light)
    fit_lines(samples, shape, triangular, LineFits(found, covariance, chi2, converged))
    assert converged.all()
    np.testing.assert_allclose(found, truth, rtol=2e-5, atol=2e-3)


def test_covariance_is_that_of_repeated_fits() -> None:
    rng = np.random.default_rng(5)
    lines, sigma = 800, 20.0
    truth = np.tile([20.3, 2.7, 5000.0, 3.0], (lines, 1))
    values = np.empty((lines, 41))
    none = np.zeros(lines)
    profiles(np.arange(41.0) - truth[:, CENTRE, None], truth[:, WIDTH].copy(), none, GAUSSIAN, False, values)
    values = (
        truth[:, AREA, None] * values + truth[:, OFFSET, None] + sigma * rng.standard_normal(values.shape)
    )
    found = truth.copy()
    covariance, chi2, converged = np.empty((lines, 4, 4)), np.empty(lines), np.zeros(lines, bool)
    weights = np.full(values.shape, sigma**-2)
    samples = LineSamples(values, weights, np.zeros(lines, np.int64), none)
    fit_lines(samples, GAUSSIAN, False, LineFits(found, covariance, chi2, converged))
    assert converged.all()
    told = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)).mean(axis=0)
    np.testing.assert_allclose(found.std(axis=0), told, rtol=0.1)
    assert chi2.mean() == pytest.approx(37, rel=0.03)


def test_widths_are_where_the_profile_is_half() -> None:
    out = np.empty(1)
    full_widths(np.array([2.7]), np.array([1.0]), GAUSSIAN, False, out)
    assert out[0] == pytest.approx(np.hypot(2.7, 1.0), rel=1e-9)
    full_widths(np.array([2.7]), np.array([0.0]), SLIT, False, out)
    assert out[0] == pytest.approx(2.7, rel=1e-9)


def test_what_cannot_be_fitted_is_said() -> None:
    found = np.array([[np.nan, 1, 1, 0], [2.0, 1.0, 1.0, 0.0]])
    covariance, chi2, converged = np.empty((2, 4, 4)), np.empty(2), np.ones(2, bool)
    samples = LineSamples(np.zeros((2, 5)), np.zeros((2, 5)), np.zeros(2, np.int64), np.zeros(2))
    fit_lines(samples, GAUSSIAN, False, LineFits(found, covariance, chi2, converged))
    assert not converged.any()
    assert np.isnan(covariance).all()
