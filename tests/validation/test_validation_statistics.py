"""Statistics of agreement: against plain numpy, and what no data can change."""

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays

from hyperpaint.validation.validating import statistics_of, uncertainty_of
from hyperpaint.validation.validation_result import STATISTICS

SPECTRA = arrays(np.float64, 12, elements=st.floats(0.01, 1.0))


def test_statistics_by_hand() -> None:
    s, r = np.array([0.2, 0.5, 0.4]), np.array([0.1, 0.5, 0.5])
    found = {name: float(value) for name, value in statistics_of(s, r).items()}
    assert (found["bias"], found["mae"], found["rmse"]) == (
        pytest.approx(0.0, abs=1e-15),
        pytest.approx(0.2 / 3),
        pytest.approx(math.sqrt(0.02 / 3)),
    )
    dot, ss, rr = 0.02 + 0.25 + 0.2, 0.04 + 0.25 + 0.16, 0.01 + 0.25 + 0.25
    assert found["spectral_angle"] == pytest.approx(math.degrees(math.acos(dot / math.sqrt(ss * rr))))
    k = dot / rr
    assert found["scale"] == pytest.approx(k)
    left = [(a / k - b) ** 2 for a, b in zip(s, r, strict=True)]
    assert (found["scale_free_error"], found["scale_free_error"]) == (
        pytest.approx(math.sqrt(sum(left) / 3)),
        pytest.approx(math.tan(math.radians(found["spectral_angle"])) * math.sqrt(rr / 3)),
    )


@settings(max_examples=60)
@given(SPECTRA, SPECTRA, st.floats(0.2, 5.0))
def test_what_a_factor_does_not_change(s: np.ndarray, r: np.ndarray, factor: float) -> None:
    one, other = statistics_of(s, r), statistics_of(factor * s, r)
    assert (other["scale_free_error"], other["spectral_angle"], other["scale"]) == (
        pytest.approx(one["scale_free_error"], rel=1e-9, abs=1e-12),
        pytest.approx(one["spectral_angle"], rel=1e-7, abs=1e-12),
        pytest.approx(factor * one["scale"]),
    )


@settings(max_examples=60)
@given(SPECTRA, SPECTRA)
def test_order_of_sizes(s: np.ndarray, r: np.ndarray) -> None:
    found = statistics_of(s, r)
    assert abs(found["bias"]) <= found["mae"] + 1e-15
    assert found["mae"] <= found["rmse"] + 1e-15
    swapped = statistics_of(r, s)
    assert swapped["bias"] == pytest.approx(-found["bias"], abs=1e-15)
    for name in ("rmse", "mae", "spectral_angle"):
        assert swapped[name] == pytest.approx(found[name], abs=1e-12)


@settings(max_examples=30)
@given(SPECTRA, st.floats(0.2, 5.0))
def test_equal_shapes_have_no_angle(s: np.ndarray, factor: float) -> None:
    found = statistics_of(s, s)
    assert ([float(found[name]) for name in ("bias", "rmse", "mae", "spectral_angle")], found["scale"]) == (
        [0.0] * 4,
        pytest.approx(1.0, abs=1e-15),
    )
    assert found["scale_free_error"] < 1e-15
    assert statistics_of(factor * s, s)["spectral_angle"] < 1e-13


def test_nothing_gives_nothing() -> None:
    none = statistics_of(np.zeros(0), np.zeros(0))
    assert set(none) == set(STATISTICS)
    assert all(np.isnan(value) for value in none.values())
    dark = statistics_of(np.zeros(4), np.full(4, 0.2))
    assert dark["rmse"] == pytest.approx(0.2)
    assert np.isnan(dark["spectral_angle"])
    assert np.isnan(dark["scale_free_error"])
    assert np.isnan(statistics_of(np.full(4, 0.2), np.zeros(4))["scale"])


def test_draws_agree_with_linear_propagation() -> None:
    rng = np.random.default_rng(1)
    r = np.linspace(0.2, 0.6, 40)
    s = 1.05 * r + 0.01
    random, common = np.full(40, 0.004), 0.01 * r
    draws = 4000
    own = random * rng.standard_normal((draws, 40)) + common * rng.standard_normal((draws, 1))
    found = uncertainty_of(s, r, own, np.zeros_like(own))
    d = s - r
    slopes = {
        "bias": np.full(40, 1 / 40),
        "mae": np.sign(d) / 40,
        "rmse": d / (40 * np.sqrt((d**2).mean())),
        "scale": r / (r**2).sum(),
    }
    for name, slope in slopes.items():
        assert found[name] == pytest.approx(
            math.sqrt(((slope * random) ** 2).sum() + (slope * common).sum() ** 2), rel=0.06
        ), name


def test_equal_spectra_are_not_sure_beyond_their_noise() -> None:
    rng = np.random.default_rng(2)
    s = np.full(50, 0.3)
    noise = 0.01 * rng.standard_normal((2000, 50))
    found = uncertainty_of(s, s, noise, np.zeros_like(noise))
    assert (found["rmse"], found["bias"]) == (
        pytest.approx(0.01, rel=0.03),
        pytest.approx(0.01 / math.sqrt(50), rel=0.06),
    )
