"""Operators between instruments: rows that sum to one, the residual kernel, identity, coverage."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st
from support.refusals import expect_error

from hyperpaint.base.errors import SchemaError
from hyperpaint.base.responsivity import log_slope
from hyperpaint.light.responses import (
    Responses,
    band_spacing,
    matching_operator,
    misfit_through,
)

SIGMA = 1 / (2 * np.sqrt(2 * np.log(2)))
SAMPLES = np.arange(480.0, 621.0)


def gaussian(distance: np.ndarray, fwhm: float) -> np.ndarray:
    made = np.exp(-0.5 * (distance / (SIGMA * fwhm)) ** 2)
    return made / made.sum()


def weights_of(bands: Responses, channels: np.ndarray = SAMPLES, width: Any = 3.0) -> np.ndarray:
    # Return weights (node, band, channel) of a spectrometer 3 nm wide
    return matching_operator(Responses(channels, width), bands).weights


def test_sharper_than_the_spectrometer_gains_noise_and_equal_widths_are_nearly_the_identity() -> None:
    made = [matching_operator(Responses(SAMPLES, 3.0), Responses([550.0], [w])) for w in (6.0, 3.0, 2.0, 1.5)]
    gains = [each.noise_gain.max() for each in made]
    assert (np.diff(gains) > 0).all()
    assert 0.6 < gains[1] < 1.2
    assert gains[2] > 3.0
    assert made[1].misfit.max() < 5e-3
    light = 1 + 0.3 * np.sin(2 * np.pi * SAMPLES / 9)
    assert made[1].weights[0, 0] @ light == pytest.approx(light[70], rel=3e-3)


def test_nodes_and_slope_of_the_responsivity_move_the_centre_of_gravity() -> None:
    ramp = SAMPLES - 550.0
    made = matching_operator(Responses(SAMPLES, 3.0), Responses([550.0], [6.0]), (-1.5, 0.0, 2.0))
    np.testing.assert_allclose(made.weights[:, 0] @ ramp, [-1.5, 0.0, 2.0], atol=1e-4)
    moved = weights_of(Responses([550.0], [6.0], slope=np.array([0.01])))[0, 0] @ ramp
    assert moved == pytest.approx(0.01 * (6.0 * SIGMA) ** 2, rel=0.01)


@given(
    spectrometer=st.floats(1.5, 5.0),
    imager=st.floats(1.5, 12.0),
    centre=st.floats(520.0, 580.0),
    shape=st.sampled_from(["gaussian", "slit"]),
    slope=st.floats(-0.02, 0.02),
    node=st.floats(-3, 3),
)
def test_rows_sum_to_one_and_grey_light_passes(
    spectrometer: float, imager: float, centre: float, shape: str, slope: float, node: float
) -> None:
    bands = Responses([centre, centre + 4], [imager] * 2, shape, slope=np.full(2, slope))
    made = matching_operator(Responses(SAMPLES, spectrometer), bands, (node,))
    np.testing.assert_allclose(made.weights.sum(axis=-1), 1.0, atol=1e-9)
    assert np.isfinite(made.misfit).all()
    np.testing.assert_allclose(made.noise_gain, np.sqrt((made.weights**2).sum(axis=-1)))


@pytest.mark.parametrize("imager", [4.5, 6.0, 9.0])
def test_two_gaussians_equal_the_residual_kernel(imager: float) -> None:
    made = matching_operator(Responses(SAMPLES, 3.0), Responses([550.3], [imager]))
    kernel = gaussian(SAMPLES - 550.3, np.sqrt(imager**2 - 9.0))
    np.testing.assert_allclose(made.weights[0, 0], kernel, atol=3e-4)
    assert made.misfit.max() < 5e-4


def test_samples_in_any_order() -> None:
    bands = Responses([530.0, 550.0], [6.0, 6.0])
    for turn in (np.arange(141)[::-1], np.random.default_rng(0).permutation(141)):
        np.testing.assert_allclose(weights_of(bands, SAMPLES[turn]), weights_of(bands)[..., turn], atol=1e-12)


def test_what_is_not_covered_is_missing() -> None:
    bands = Responses([470.0, 484.0, 490.0, 550.0, 616.0, 640.0], [6.0] * 6)
    made = matching_operator(Responses(SAMPLES, 3.0), bands)
    assert np.isnan(made.weights[0]).all(axis=-1).tolist() == [True, True, False, False, True, True]
    assert made.coverage[0, 3] == pytest.approx(1.0, abs=1e-5)
    assert made.coverage[0, 0] < 0.01
    assert made.coverage[0, 1] == pytest.approx(0.94, abs=0.03)


def test_a_table_equals_the_shape_it_was_made_from() -> None:
    offset, centres = np.linspace(-14, 14, 561), np.array([540.0, 555.5])
    light = 1 + 0.3 * np.sin(2 * np.pi * SAMPLES / 11)
    for shape in ("gaussian", "slit"):
        plain = Responses(centres, [6.0, 6.0], shape)
        table = np.stack([plain.on(offset + c, b) for b, c in enumerate(centres)])
        tabulated = Responses(centres, [6.0, 6.0], "tabulated", offset=offset, table=7 * table)
        np.testing.assert_allclose(weights_of(tabulated) @ light, weights_of(plain) @ light, atol=5e-4)


def test_slit_is_a_trapezoid_of_unit_area() -> None:
    grid = np.arange(-10, 10, 0.01) + 550
    made = Responses([548.0, 550.0, 552.0], [6.0] * 3, "slit").on(grid, 1)
    assert made.sum() * 0.01 == pytest.approx(1.0)
    box = np.convolve(np.abs(grid - 550) <= 3, np.ones(200) / 200, "same")
    np.testing.assert_allclose(made, box / box.sum() / 0.01, atol=2e-3)
    assert np.ptp(grid[made > made.max() / 2]) == pytest.approx(6.0, abs=0.05)


def test_everything_that_is_wrong_is_listed() -> None:
    error = expect_error(SchemaError, None, lambda: Responses([500.0, np.nan], [6.0, -1.0], "round"))
    assert error.codes == ("choice-unknown", "not-finite", "fwhm-invalid")
    two = [500.0, 502.0], [6.0, 6.0]
    for code, nm, offset, table in (
        ("variable-missing", two, np.arange(5.0), None),
        ("length-mismatch", two, np.arange(5.0), np.zeros((1, 5))),
        ("response-table-invalid", two, np.arange(5.0), np.zeros((2, 5))),
        ("srf_offset.*response-table-invalid", ([500.0], [6.0]), np.zeros(5), np.ones((1, 5))),
    ):
        with pytest.raises(SchemaError, match=code):
            Responses(*nm, "tabulated", offset=offset, table=table)


def test_band_spacing() -> None:
    for nm, steps in (
        ([400.0, 402.0, 405.0], [2, 2.5, 3]),
        ([405.0, 402.0, 400.0], [3, 2.5, 2]),
        ([4e2], [1]),
    ):
        np.testing.assert_allclose(band_spacing(nm), steps)


def test_log_slope_is_found_and_leaves_bad_bands_out() -> None:
    nm = np.arange(500.0, 600.0, 2.0)
    responsivity = 7e3 * np.exp(-0.012 * nm)
    responsivity[[3, 20, 21]] = [np.nan, 0.0, -1.0]
    np.testing.assert_allclose(log_slope(nm, responsivity, np.full(50, 9.0)), -0.012, rtol=1e-9)
    np.testing.assert_array_equal(log_slope(nm, np.full(50, np.nan), np.full(50, 9.0)), 0.0)


@pytest.mark.parametrize(("narrow", "wide"), [(1e-7, 3.0), (1e-3, 3.0), (3.0, 1e6)])
def test_widths_that_no_grid_holds_are_refused(narrow: float, wide: float) -> None:
    widths = np.full(50, wide)
    widths[25] = narrow
    channels = Responses(np.linspace(400.0, 500.0, 50), widths)
    expect_error(
        SchemaError,
        "fwhm-range",
        lambda: matching_operator(channels, Responses(np.array([450.0]), np.array([6.0]))),
    )


def test_a_wider_detector_elsewhere_changes_nothing() -> None:
    # A field spectrometer's channels beyond 1000 nm are wider; bands of the visible know nothing of it
    channels = np.arange(500.0, 1400.0)
    widths = np.where(channels <= 1000.0, 3.0, 10.0)
    bands = Responses(np.linspace(600.0, 640.0, 8), np.full(8, 6.0))
    np.testing.assert_array_equal(weights_of(bands, channels), weights_of(bands, channels, widths))
    # seven channels are missing: more than two of their widths, less than two of those beyond
    holed = np.abs(channels - 620.0) > 3.5
    assert np.isnan(weights_of(bands, channels[holed], widths[holed])).any()


def test_misfit_of_weights_made_for_another_spectrometer() -> None:
    channels = np.arange(560.0, 680.0)
    bands, declared = Responses(np.linspace(600.0, 640.0, 5), np.full(5, 6.0)), Responses(channels, 3.0)
    same = misfit_through(declared, declared, bands, (0.0, 0.5))
    matching = matching_operator(declared, bands, (0.0, 0.5))
    np.testing.assert_allclose(same, matching.misfit, rtol=1e-3, atol=1e-6)
    # weights for 3 nm make of 4 nm a Gaussian of a = sqrt(36 - 9 + 16) nm; its distance from one of b = 6 nm,
    # both of unit area, is sqrt(1 + b / a - 2 sqrt(2 / (1 + (a / b)^2))) in norms of the latter
    ratio = 6.0 / np.sqrt(43.0)
    expected = np.sqrt(1.0 + ratio - 2.0 * np.sqrt(2.0 / (1.0 + 1.0 / ratio**2)))
    wide = misfit_through(declared, Responses(channels, 4.0), bands, (0.0, 0.5))
    np.testing.assert_allclose(wide, expected, rtol=0.02)


@pytest.mark.parametrize("shape", ["gaussian", "slit", "tabulated"])
def test_responses_of_several_bands_have_the_bits_of_each(shape: str) -> None:
    rng = np.random.default_rng(4)
    nm = np.sort(rng.uniform(450.0, 850.0, 40))
    table = {"offset": np.linspace(-9.0, 9.0, 37), "table": rng.uniform(0.1, 1.0, (40, 37))}
    extra = {"gaussian": {}, "slit": {"spacing": rng.uniform(1.0, 5.0, 40)}, "tabulated": table}[shape]
    bands = Responses(nm, rng.uniform(1.0, 8.0, 40), shape, slope=rng.normal(0.0, 0.01, 40), **extra)
    grid, chosen = np.arange(600.0, 640.0, 0.37), np.array([0, *np.argsort(np.abs(nm - 620.0))[:3], 39])
    together = bands.on(grid, chosen)
    np.testing.assert_array_equal(together, [bands.on(grid, int(band)) for band in chosen])
    assert not together[0].any()  # no point of the grid in it
    np.testing.assert_allclose(together[1].sum() * 0.37, 1.0, rtol=1e-12)
