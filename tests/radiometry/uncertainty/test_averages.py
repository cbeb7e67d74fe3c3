"""Means over pixels: what shrinks in them, what does not, and what nobody knows."""

import numpy as np
import xarray as xr
from support.refusals import expect_refusals
from support.strategies import flight, with_noise

from hyperpaint.base.errors import SchemaError
from hyperpaint.radiometry.counts_to_reflectance import reflectance
from hyperpaint.radiometry.uncertainty import mean_uncertainty

U = ("reflectance_u_random", "reflectance_u_systematic")


def region(field: np.ndarray, u: float) -> xr.Dataset:
    dims = ("along_track", "cross_track")
    return xr.Dataset(
        {
            "reflectance": (dims, field),
            U[0]: (dims, np.full(field.shape, u)),
            U[1]: (dims, np.full(field.shape, 0.02)),
        }
    )


def test_only_the_random_part_of_a_mean_shrinks() -> None:
    rng = np.random.default_rng(0)
    for side in (5, 20, 60):
        made, n = mean_uncertainty(region(rng.normal(0.3, 0.01, (side, side)), 0.01)), side**2
        assert int(made.n) == n
        assert 0.7 * n < float(made.n_eff) <= n
        np.testing.assert_allclose(float(made.u_systematic), 0.02)
        np.testing.assert_allclose(float(made.u_random), 0.01 / np.sqrt(float(made.n_eff)))


def test_correlated_pixels_count_for_fewer() -> None:
    rng, found = np.random.default_rng(1), []
    for _ in range(200):
        white = rng.normal(size=(46, 46))
        # five by five pixels share their error
        field = np.lib.stride_tricks.sliding_window_view(white, (5, 5)).mean(axis=(2, 3)) * 0.05
        made = mean_uncertainty(region(0.3 + field, 0.01))
        found.append((float(made["mean"]), float(made.u_random)))
    truth = np.std(found, axis=0)[0]
    assert truth > 3 * 0.01 / 42  # far more than independent pixels would have
    assert 0.7 < np.median(found, axis=0)[1] / truth < 1.4


def test_a_mean_over_bands_keeps_them_and_skips_what_is_missing() -> None:
    line = with_noise(flight(dtype=np.uint16).line, radiance_gain_u_systematic=0.02)
    line["counts"].values[3, 5, 2] = 4090
    made = reflectance(line, uncertainty=True)
    found = mean_uncertainty(made)
    assert found["mean"].dims == ("band",)
    assert "wavelength" in found.coords
    np.testing.assert_array_equal(found.n, np.where(np.arange(12) == 5, 143, 144))
    np.testing.assert_allclose(
        found["mean"], made.reflectance.mean(["along_track", "cross_track"]), rtol=1e-5
    )
    expect_refusals(
        (SchemaError, "dim-missing", lambda: mean_uncertainty(made, "pixel")),
        (SchemaError, "variable-missing", lambda: mean_uncertainty(made.drop_vars(U[0]))),
    )


def test_an_error_that_nobody_knows_is_not_none() -> None:
    line = flight(dtype=np.uint16).line
    unknown = reflectance(with_noise(line), uncertainty=True)
    found = mean_uncertainty(unknown)
    assert found.u_systematic.isnull().all()
    assert found.u_systematic.attrs["components"] == "none known"
    assert (found.u_random > 0).all()
    assert "read_noise" in found.u_random.attrs["components"]
    for name in U:
        unknown[name].attrs = {}
    assert mean_uncertainty(unknown).u_systematic.isnull().all()
    known = mean_uncertainty(reflectance(with_noise(line, wavelength_u=0.1), uncertainty=True))
    assert (known.u_systematic > 0).all()
    assert known.u_systematic.attrs["components"] == "wavelength_u"
