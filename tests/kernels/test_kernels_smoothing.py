"""Filters over the bands against scipy, and what a missing band touches."""

import numpy as np
import pytest

from hyperpaint.kernels.radiometry import average_slab, filter_slab
from hyperpaint.radiometry.spectral_axis import _window_polynomials


def filtered(values: np.ndarray, method: str, window: int, order: int = 2) -> np.ndarray:
    out = np.full(values.shape, 77, np.float32)
    if method == "box":
        average_slab(values, window, out)
    else:
        first, weights, fallback = _window_polynomials(window, order, values.shape[1])
        filter_slab(values, weights, first, fallback, out)
    return out


@pytest.fixture
def values() -> np.ndarray:
    return np.random.default_rng(0).uniform(0, 1, (3, 25, 7)).astype(np.float32)


@pytest.mark.parametrize(("window", "order"), [(3, 1), (5, 2), (11, 2), (11, 3), (25, 4), (7, 0)])
def test_savitzky_golay_is_that_of_scipy(values: np.ndarray, window: int, order: int) -> None:
    signal = pytest.importorskip("scipy.signal")
    expected = signal.savgol_filter(values.astype(np.float64), window, order, axis=1, mode="interp")
    np.testing.assert_allclose(filtered(values, "savitzky-golay", window, order), expected, atol=2e-6)


@pytest.mark.parametrize("window", [3, 5, 11, 25])
def test_box_is_the_mean_of_what_is_there(values: np.ndarray, window: int) -> None:
    values[0, 8, 2] = values[1, 0, 0] = values[2, 23:, 4] = values[2, 4:9, 5] = np.nan
    made = filtered(values, "box", window)
    for line, band, x in np.ndindex(values.shape):
        near = values[line, max(0, band - window // 2) : band + window // 2 + 1, x].astype(np.float64)
        expected = np.nan if np.isnan(values[line, band, x]) else np.nanmean(near)
        np.testing.assert_allclose(made[line, band, x], expected, rtol=2e-6)


@pytest.mark.parametrize("method", ["savitzky-golay", "box"])
@pytest.mark.parametrize("gap", [0, 2, 12, 24])
def test_a_missing_band_touches_its_window_only(values: np.ndarray, method: str, gap: int) -> None:
    before = filtered(values, method, 5)
    values[1, gap, 3] = np.nan
    after = filtered(values, method, 5)
    changed = np.argwhere(after.view(np.uint32) != before.view(np.uint32))
    assert {(line, x) for line, _, x in changed} == {(1, 3)}
    # at the ends the window of a polynomial keeps its width
    assert np.abs(changed[:, 1] - gap).max() <= (2 if method == "box" or 4 < gap < 20 else 4)
    assert np.isnan(after[1, gap, 3])
    assert np.isnan(after).sum() == 1


def test_a_polynomial_passes_a_gap_unchanged() -> None:
    band = np.arange(25.0)
    curve = (0.2 + 0.01 * band - 0.0004 * band**2).astype(np.float32)
    values = np.tile(curve[None, :, None], (1, 1, 25))
    for x in range(25):
        values[0, x, x] = np.nan
    made = filtered(values, "savitzky-golay", 7)
    np.testing.assert_array_equal(np.isnan(made), np.isnan(values))
    np.testing.assert_allclose(made[~np.isnan(made)], values[~np.isnan(made)], atol=1e-6)


def test_two_gaps_leave_the_value_as_it_is(values: np.ndarray) -> None:
    values[0, [10, 12], 0] = np.nan
    made = filtered(values, "savitzky-golay", 5)
    assert made[0, 11, 0] == values[0, 11, 0]
    assert np.isnan(made[0, [10, 12], 0]).all()


def test_nothing_at_all() -> None:
    values = np.full((1, 9, 2), np.nan, np.float32)
    assert np.isnan(filtered(values, "box", 3)).all()
    assert np.isnan(filtered(values, "savitzky-golay", 5)).all()


@pytest.mark.parametrize("method", ["savitzky-golay", "box"])
@pytest.mark.parametrize("value", [1e30, np.inf])
def test_a_huge_band_touches_its_window_only(values: np.ndarray, method: str, value: float) -> None:
    before = filtered(values, method, 7)
    values[1, 12, 3] = value
    with np.errstate(invalid="ignore"):  # infinity without weight, where loops are plain Python
        after = filtered(values, method, 7)
    changed = np.argwhere(after.view(np.uint32) != before.view(np.uint32))
    assert {(line, x) for line, _, x in changed} == {(1, 3)}
    assert sorted({band for _, band, _ in changed}) == list(range(9, 16))


@pytest.mark.parametrize("method", ["savitzky-golay", "box"])
def test_no_bit_depends_on_other_lines_and_columns(values: np.ndarray, method: str) -> None:
    values[0, 8, 2] = values[2, 4:9, 5] = np.nan
    whole = filtered(values, method, 11)
    for line, x in np.ndindex(3, 7):
        alone = np.ascontiguousarray(values[line : line + 1, :, x : x + 1])
        assert filtered(alone, method, 11).tobytes() == whole[line, :, x].tobytes()
