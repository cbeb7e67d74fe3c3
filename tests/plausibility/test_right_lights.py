"""Lights of which nothing is said, and orders of bands that are named, as plain arrays."""

import numpy as np
import pytest

from hyperpaint.light.clear_sky import ClearSky
from hyperpaint.plausibility.line_judging import judge_bands

FINE = np.arange(350.0, 1100.0, 0.5)
DAYLIGHT = sum(ClearSky(45.0).irradiance(FINE))


def _seen(spectrum: np.ndarray, nm: np.ndarray) -> np.ndarray:
    weights = np.exp(-0.5 * ((FINE - nm[:, None]) / 2.4) ** 2)
    return weights @ spectrum / weights.sum(axis=1)


def _lamps(*peaks: tuple[float, float, float]) -> np.ndarray:
    # Return lamps of peaks: middle and width [nm], and height
    return np.sum([height * np.exp(-0.5 * ((FINE - at) / width) ** 2) for at, width, height in peaks], axis=0)


def _said(light: np.ndarray, nm: np.ndarray, sky: np.ndarray | None = None) -> list[str]:
    return [
        str(finding)
        for finding in judge_bands(
            "line", light, np.ones(nm.size), nm, 5.6, None if sky is None else (FINE, sky)
        )
    ]


MERCURY = _lamps(*((at, 1.5, height) for at, height in (
    (405, 0.3), (436, 0.8), (488, 0.4), (546, 1.0), (578, 0.3), (588, 0.3), (611, 1.0), (631, 0.3), (709, 0.1)
)))  # fmt: skip


@pytest.mark.parametrize("bands", [42, 60, 120])
@pytest.mark.parametrize("seed", range(2))
def test_lights_that_are_not_smooth_over_bands_are_right(bands: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    nm = np.linspace(400.0, 1000.0, bands)
    drift = rng.normal(0.0, rng.uniform(0.1, 1.0), bands)  # of the dark, band by band
    sky = _seen(DAYLIGHT, nm)
    dead = np.where(np.arange(bands) == rng.integers(bands), 0.0, 900.0 * sky)
    for light in (
        drift,
        dead,
        (10.0 * sky * np.exp(-np.clip(nm - 520.0, 0.0, None) / 70.0)) + drift,
        (4095.0 - rng.normal(60.0, 3.0, bands)),
        900.0 * _seen(MERCURY, nm) + drift,
    ):
        assert _said(light, nm, DAYLIGHT) == []


@pytest.mark.parametrize("seed", range(3))
def test_bands_in_any_order_are_named(seed: int) -> None:
    nm = np.linspace(400.0, 1000.0, 120)
    assert (
        "neighbouring bands"
        in _said(np.random.default_rng(seed).permutation(900.0 * _seen(DAYLIGHT, nm)), nm)[0]
    )


@pytest.mark.parametrize("seed", range(3))
def test_lamps_are_right_and_bands_of_daylight_that_are_shifted_are_not(seed: int) -> None:
    rng = np.random.default_rng(seed)
    nm = np.linspace(400.0, 1000.0, 90)
    led = _lamps((450, rng.uniform(8, 12), rng.uniform(0.3, 1)), (rng.uniform(540, 620), 50, 1.0))
    lamp = 900.0 * _seen(led, nm) + rng.normal(0.0, 0.3, nm.size)
    assert _said(lamp, nm) == _said(lamp, nm, led) == _said(lamp, nm, DAYLIGHT) == []
    light = 900.0 * _seen(DAYLIGHT, nm)
    assert _said(light, nm, DAYLIGHT) == []
    for shifted in (light[::-1], np.roll(light, 10), _seen(900.0 * DAYLIGHT, nm + 30.0)):
        assert "correlation of the bands with daylight" in _said(shifted, nm, DAYLIGHT)[0]
