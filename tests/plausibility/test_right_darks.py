"""Right darks of which nothing is said, and wrong ones that are named, as plain arrays."""

import numpy as np

from hyperpaint.plausibility.line_judging import CubeSample, judge_dark

NM = np.linspace(400.0, 1000.0, 60)
RNG = np.random.default_rng(18)


def _said(dark: np.ndarray, scene: np.ndarray, uncertainty: np.ndarray | None = None) -> list[str]:
    sample = CubeSample(128, scene, scene, 1)
    return [
        finding.kind.name
        for finding in judge_dark("dark", dark, uncertainty, np.ones_like(dark), sample, 4000.0)
    ]


def _daylight(level: float) -> np.ndarray:
    # Return light with the lines of water and oxygen [count], (band, column)
    light = 1.0 - ((NM - 650.0) / 400.0) ** 2
    for line, depth in ((687.0, 0.2), (761.0, 0.5), (820.0, 0.15), (940.0, 0.4)):
        light *= 1.0 - depth * np.exp(-(((NM - line) / 8.0) ** 2))
    return level * np.tile(light[:, None], 40)


def test_zeros_under_no_light_and_of_a_low_black_level_are_right() -> None:
    dark, scene = RNG.normal(60.0, 3.0, (60, 40)), _daylight(800.0) + 60.0
    dark[:, :4], scene[:, :4] = 0.0, 0.02  # masked columns, with a stray count
    assert (
        _said(dark, scene),
        _said(np.where(RNG.random((60, 40)) < 0.51, 0.0, 0.4), _daylight(80.0) + 0.2),
    ) == ([], [])
    dark[:, 4:] *= np.arange(36) % 2
    assert _said(dark, scene) == ["dark-of-zeros"]


def test_a_dark_that_drifts_with_temperature_over_dim_water_is_right() -> None:
    dark, water = RNG.normal(100.0, 3.0, (60, 40)), _daylight(2.0)
    assert (_said(1.15 * dark, dark + water), _said(dark + 60.0, dark + water)) == ([], ["dark-over-scene"])


def test_a_gradient_of_the_bias_under_a_spectrum_that_rises_as_well_is_right() -> None:
    bias = 60.0 + np.linspace(0.0, 20.0, 60)[:, None] + RNG.normal(0.0, 0.5, (60, 40))
    rising = np.tile(np.linspace(0.0, 1.0, 60)[:, None] ** 2, 40)
    for light in (_daylight(15.0), 30.0 * rising, 500.0 * rising, _daylight(800.0)):
        assert _said(bias, bias + light) == []
    for share in (0.1, 0.3):
        light = _daylight(800.0)
        assert _said(bias + share * light, bias + light) == ["dark-lit"]


def test_rounded_darks_are_right_and_those_of_another_exposure_are_not() -> None:
    pattern, light = RNG.normal(8.4, 0.2, (60, 40)), _daylight(120.0)
    still = np.zeros((60, 40))  # a camera of 8 bits whose noise is under a count: every frame the same
    assert _said(np.rint(pattern), pattern + light, still) == []
    dark = RNG.normal(60.0, 6.0, (60, 40))
    noise = np.full(dark.shape, 0.2)
    for factor, named in ((0.5, True), (0.8, False), (1.0, False), (1.25, False), (2.0, True)):
        assert _said(dark, 60.0 + factor * (dark - 60.0) + light, noise) == ["dark-pattern"] * named, factor
