"""Interpolation with weights of every column's own."""

import numpy as np

from hyperpaint.kernels.radiometry import resample_slab
from hyperpaint.radiometry.spectral_axis import _lagrange_weights


def test_against_plain_numpy_with_missing_taps() -> None:
    rng = np.random.default_rng(0)
    values = rng.uniform(0, 1, (3, 9, 5)).astype(np.float32)
    values[1, 4, 2] = np.nan
    first = rng.integers(0, 6, (9, 5))
    weights = rng.normal(size=(9, 5, 4)).astype(np.float32)
    weights[3, 1] = np.nan
    weights[:, 4] = [0, 1, 0, 0]
    out = np.full(values.shape, 77, np.float32)
    resample_slab(values, first, weights, out)
    for line, band, x in np.ndindex(values.shape):
        taps = values[line, first[band, x] : first[band, x] + 4, x].astype(np.float64)
        used = weights[band, x] != 0
        expected = (taps[used] * weights[band, x][used]).sum()
        np.testing.assert_allclose(out[line, band, x], expected, rtol=1e-5, atol=1e-6)


def test_a_cubic_is_interpolated_exactly() -> None:
    wavelength = np.array([400.0, 402.0, 405.0, 407.0, 410.0, 414.0, 415.0])
    shift = np.array([[-0.7, 0.0, 0.4]])
    own = wavelength[:, None] + shift

    def cubic(nm: np.ndarray) -> np.ndarray:
        s = (nm - 407) / 8
        return 0.3 + 0.2 * s - 0.1 * s**2 + 0.25 * s**3

    for turn in (slice(None), slice(None, None, -1)):
        first, weights = _lagrange_weights(wavelength[turn], shift)
        values = cubic(own)[turn][None].astype(np.float32)
        out = np.empty(values.shape, np.float32)
        resample_slab(np.ascontiguousarray(values), first, weights, out)
        expected = np.broadcast_to(cubic(wavelength)[turn][:, None], out.shape[1:])
        there = ~np.isnan(out[0])
        np.testing.assert_allclose(out[0][there], expected[there], atol=2e-6)
        missing = np.argwhere(~there[turn])
        np.testing.assert_array_equal(missing, [[0, 2], [6, 0]])  # beyond the outermost bands
        np.testing.assert_array_equal(out[0][:, 1], values[0][:, 1])  # without shift, not a bit
