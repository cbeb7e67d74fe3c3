"""Fringes that the steps of a sweep miss, and ripples that they follow."""

import contextlib

import numpy as np
import pytest

import hyperpaint as hp
from hyperpaint.base.errors import PaintWarning
from hyperpaint.calibration.calibration_dataset import MIN_REPORTED_ERROR, error_between_lines
from hyperpaint.calibration.detector import interpolate_nodes
from hyperpaint.simulation import simulate_sweep

STEPS = np.arange(400.0, 1001.0, 10.0)
VARIANCE = np.full(STEPS.size, 2.0**2 / (8 * np.log(2)))
FINE = np.arange(430.0, 970.0, 0.5)


def fringed(nm: np.ndarray, period: float, phase: float = 0.7) -> np.ndarray:
    # Return the logarithm of a responsivity with fringes of 5 %
    return np.log1p(0.05 * np.cos(2 * np.pi * nm / period + phase)) - ((nm - 620.0) / 300.0) ** 2


def slope_of(nm: np.ndarray, period: float) -> np.ndarray:
    return (fringed(nm + 0.01, period) - fringed(nm - 0.01, period)) / 0.02


def stated(period: float) -> float:
    level, moved = np.exp(fringed(STEPS, period)), VARIANCE * slope_of(STEPS, period)
    noise = 2e-4 * np.random.default_rng(6).standard_normal(STEPS.size)
    between = error_between_lines(STEPS, level, moved + noise, VARIANCE)
    assert between is not None
    return between[0]


def largest_error(period: float) -> float:
    used = np.ones((STEPS.size, 1), bool)
    values, _ = interpolate_nodes(STEPS, fringed(STEPS, period)[:, None], used, FINE[:, None])
    return float(np.abs(np.expm1(values[:, 0] - fringed(FINE, period))).max())


@pytest.mark.parametrize("period", [6.0, 7.0, 8.0, 12.0, 15.0])
def test_fringes_that_steps_miss_are_stated_within_a_factor_of_two(period: float) -> None:
    assert 0.5 < stated(period) / largest_error(period) < 2.0


@pytest.mark.parametrize("period", [60.0, 90.0])
def test_ripples_that_steps_follow_are_none(period: float) -> None:
    assert stated(period) < MIN_REPORTED_ERROR


def test_a_sweep_of_too_few_lines_says_nothing() -> None:
    assert error_between_lines(STEPS[:10], np.ones(10), np.zeros(10), VARIANCE[:10]) is None


@pytest.mark.parametrize("depth", [0.05, 0.015, 0.007])
def test_calibrate_warns_and_is_as_unsure(depth: float) -> None:
    sweep = simulate_sweep(columns=8, bands=136, seed=21, nonuniformity=0.0)
    fringe = 1 + depth * np.cos(2 * np.pi * sweep.step_wavelength / 8.0)
    sweep["counts"] = ((sweep.counts - sweep.dark_counts) * fringe + sweep.dark_counts).transpose(
        *sweep.counts.dims
    ).assign_attrs(sweep.counts.attrs)  # fmt: skip
    # an error below 1 % is not reported
    expected = pytest.warns(PaintWarning, match=r"10 nm.*steps-too-coarse")
    with expected if depth > 0.01 else contextlib.nullcontext():
        calibration = hp.calibrate(sweep)
    size = calibration.attrs["gain_between_lines"]
    wrong = np.abs(calibration.radiance_gain / sweep.true_radiance_gain - 1)[10:-10]
    assert 0.5 < size / float(wrong.max()) < 2.0
    assert (float(calibration.radiance_gain_u_systematic.min()) >= size) or depth < 0.01
