"""Lights of which nothing is said, and orders of bands that are named, as plain arrays."""

from typing import Any

import numpy as np
import pytest
import xarray as xr

from hyperpaint.light.clear_sky import ClearSky
from hyperpaint.plausibility.judging import (
    CubeSample,
    judge_bands,
    judge_dark,
    judge_dark_frames,
    judge_irradiance,
    judge_navigation,
    judge_range,
    judge_top,
    sample_cube,
)
from hyperpaint.radiometry.planning import LightLevel

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
    mixed = np.random.default_rng(seed).permutation(900.0 * _seen(DAYLIGHT, nm))
    assert "neighbouring bands" in _said(mixed, nm)[0]


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


@pytest.mark.parametrize(
    ("record", "found"),
    [
        (0.99 + 1e-4 * np.random.default_rng(5).normal(size=FINE.size), "; that of the scene"),  # a tile
        (DAYLIGHT[::-1], "; that of the scene"),
        (np.roll(DAYLIGHT, -20), "with 10 nm added to its wavelengths"),
        (np.roll(DAYLIGHT, 10), "with -5 nm added to its wavelengths"),
        (np.roll(DAYLIGHT, 2), None),
        (0.05 * DAYLIGHT * np.exp((FINE - 700.0) / 300.0), None),  # at dusk
    ],
)
def test_a_record_without_the_bands_that_the_scene_has(record: np.ndarray, found: str | None) -> None:
    nm = np.linspace(400.0, 1000.0, 66)
    said = _said(900.0 * _seen(DAYLIGHT, nm), nm, record)
    assert [found in text and "[irradiance-spectrum]" in text for text in said if found] == [True] * bool(
        found
    )
    assert len(said) == bool(found)
    # broad bands do not show them
    assert _said(900.0 * _seen(DAYLIGHT, nm)[::3], nm[::3], record) == []


# --- Right darks of which nothing is said, and wrong ones that are named, as plain arrays ---

NM = np.linspace(400.0, 1000.0, 60)
RNG = np.random.default_rng(18)


def _said_darks(
    dark: np.ndarray, scene: np.ndarray, uncertainty: np.ndarray | None = None, daylight: Any = None
) -> list[str]:
    sample = CubeSample(128, scene, scene, 1, np.zeros(scene.shape, bool))
    return [
        finding.kind.name
        for finding in judge_dark("dark", dark, uncertainty, np.ones_like(dark), sample, 4000.0, daylight)
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
    assert _said_darks(dark, scene) == []
    assert _said_darks(np.where(RNG.random((60, 40)) < 0.51, 0.0, 0.4), _daylight(80.0) + 0.2) == []
    dark[:, 4:] *= np.arange(36) % 2
    assert _said_darks(dark, scene) == ["dark-of-zeros"]


def test_a_dark_that_drifts_with_temperature_over_dim_water_is_right() -> None:
    dark, water = RNG.normal(100.0, 3.0, (60, 40)), _daylight(2.0)
    assert _said_darks(1.15 * dark, dark + water) == []
    assert _said_darks(dark + 60.0, dark + water) == ["dark-over-scene"]


def test_a_gradient_of_the_bias_under_a_spectrum_that_rises_as_well_is_right() -> None:
    bias = 60.0 + np.linspace(0.0, 20.0, 60)[:, None] + RNG.normal(0.0, 0.5, (60, 40))
    rising = np.tile(np.linspace(0.0, 1.0, 60)[:, None] ** 2, 40)
    for light in (_daylight(15.0), 30.0 * rising, 500.0 * rising, _daylight(800.0)):
        assert _said_darks(bias, bias + light) == []
    for share in (0.1, 0.3, 0.6, 0.9, 0.99, 1.1):
        light = _daylight(800.0)
        dark, scene = bias + share * light, bias + light
        assert _said_darks(dark, scene, daylight=light[:, 0]) == ["dark-lit"]
    drifted = 1.1 * bias + _daylight(1.0)  # a dark of another temperature under a dim scene
    assert _said_darks(bias, drifted, daylight=_daylight(1.0)[:, 0]) == []


def test_rounded_darks_are_right_and_those_of_another_exposure_are_not() -> None:
    pattern, light = RNG.normal(8.4, 0.2, (60, 40)), _daylight(120.0)
    still = np.zeros((60, 40))  # a camera of 8 bits whose noise is under a count: every frame the same
    assert _said_darks(np.rint(pattern), pattern + light, still) == []
    dark = RNG.normal(60.0, 6.0, (60, 40))
    noise = np.full(dark.shape, 0.2)
    for factor, named in ((0.5, True), (0.8, False), (1.0, False), (1.25, False), (2.0, True)):
        assert _said_darks(dark, 60.0 + factor * (dark - 60.0) + light, noise) == ["dark-pattern"] * named, (
            factor
        )


# --- thresholds: right just inside, named just outside -----------------------------------------------------


def _flown(steps: np.ndarray, roll: np.ndarray) -> xr.Dataset:
    # Return the coordinates of lines that move north by steps [degree]
    count = steps.size
    pose = {"latitude": np.cumsum(steps) + 43.0, "longitude": np.full(count, -77.0), "roll": roll}
    time = np.datetime64("2024-06-01T12", "ns") + np.arange(count) * np.timedelta64(1, "s")
    return xr.Dataset(coords={"time": ("line", time), **{key: ("line", v) for key, v in pose.items()}})


@pytest.mark.parametrize(("share", "named"), [(0.14, False), (0.3, True)])
def test_shares_of_lines_without_movement_or_angle(share: float, named: bool) -> None:
    is_part = np.arange(200) < 200 * share
    still = _flown(np.where(np.arange(200) < 250 * share, 0.0, 1e-5), np.zeros(200))
    lost = _flown(np.full(200, 1e-5), np.where(is_part, np.nan, 0.0))
    kinds = [[f.kind.name for f in judge_navigation("line", line)] for line in (still, lost)]
    assert kinds == [["navigation-still"] * named, ["navigation-gaps"] * named]


@pytest.mark.parametrize(
    ("share", "named"),
    [
        (0.011, ["irradiance-level"]),
        (0.02, []),
        (1.6, []),
        (2.6, ["irradiance-doubtful"]),
        (5.0, ["irradiance-level"]),
    ],
)
def test_irradiance_over_that_of_a_clear_sky(share: float, named: list[str], monkeypatch: Any) -> None:
    level = LightLevel(share, 40.0, 1.0)
    monkeypatch.setattr("hyperpaint.plausibility.judging.light_level", lambda *_: level)
    time = np.array(["2024-06-01T12", "2024-06-01T13"], "datetime64[ns]")
    line = xr.Dataset(
        {"irradiance": (("irradiance_time", "irradiance_wavelength"), [[1.0, 2.0], [3.0, 4.0]])},
        {"irradiance_time": time, "irradiance_wavelength": [500.0, 600.0], "time": ("line", time)},
    )
    assert [f.kind.name for f in judge_irradiance("line", line)] == named


@pytest.mark.parametrize(
    ("stuck", "repeats", "step", "named"),
    [
        (slice(50, 90), 1, 1e-6, True),  # from the middle of the line on
        (slice(50, 62), 1, 1e-6, True),
        (slice(50, 54), 1, 1e-6, False),  # a stall of the logger
        (slice(5, 38), 1, 1e-6, False),  # before the line
        (slice(50, 70), 3, 1e-6, True),
        (slice(50, 57), 3, 1e-6, False),
        (slice(50, 90), 1, 0.01, False),  # two digits of a steady light
    ],
)
def test_spectra_that_stay_equal_over_a_part_of_the_line(
    stuck: slice, repeats: int, step: float, named: bool
) -> None:
    scan = np.arange(90) // repeats * repeats
    scan[stuck] = scan[stuck][0]
    spectra = (np.random.default_rng(5).normal(1.0, 0.002, (90, 5))[scan] / step).round() * step
    time = np.datetime64("2024-06-01T12", "ns") + np.arange(90) * np.timedelta64(1, "s")
    line = xr.Dataset(
        {"irradiance": (("irradiance_time", "irradiance_wavelength"), spectra)},
        {"irradiance_time": time, "irradiance_wavelength": np.arange(5) * 50.0 + 500.0},
    ).assign_coords(time=("line", time[40:80]))
    assert ("irradiance-constant" in {f.kind.name for f in judge_irradiance("line", line)}) == named


@pytest.mark.parametrize("divisor", [1, 16])
def test_elements_that_never_change_between_columns_that_do(divisor: int) -> None:
    ground = 100.0 + 900.0 * np.random.default_rng(4).random((64, 6, 12))
    ground[:, :, :2], ground[:, 0] = 20.0, 105.0  # masked columns, and a band without light
    ground[:, :, 7] = 500.0
    counts = (divisor * ground.round()).astype("u2")
    sample = sample_cube(xr.DataArray(counts, dims=("line", "band", "column")), np.ones(64, bool))
    assert sample is not None
    assert np.argwhere(sample.stuck).tolist() == [[band, 7] for band in range(1, 6)]


@pytest.mark.parametrize(("share", "name"), [(1.4e-3, "stray-counts"), (3e-3, "counts-over-range")])
def test_share_of_elements_over_the_range(share: float, name: str) -> None:
    maximum = np.where(np.arange(10_000) < 10_000 * share, 5000.0, 100.0)
    sample = CubeSample(1, maximum, maximum, 1, np.zeros(maximum.shape, bool))
    assert [f.kind.name for f in judge_range("line", sample, 12, 4095.0)] == [name]


@pytest.mark.parametrize(
    ("highest", "named"),
    [(3000.0, True), (4095.0, False), (9000.0, False)],
    ids=["clipped", "saturated", "free"],
)
def test_counts_that_end_at_one_value_below_saturation(highest: float, named: bool) -> None:
    maximum = np.minimum(np.random.default_rng(2).normal(2000.0, 600.0, (60, 40)), highest).round()
    sample = CubeSample(128, maximum, maximum, 1, np.zeros(maximum.shape, bool))
    assert [f.kind.name for f in judge_top("line", sample, 4090.0)] == ["counts-clipped"] * named
    # a white roof seen by a camera of 8 bits
    roof = CubeSample(
        128, maximum, np.full((60, 40), 199.0) + RNG.integers(2, size=(60, 40)), 1, sample.counters
    )
    assert [*judge_top("line", roof, 254.0)] == []


@pytest.mark.parametrize(("share", "named"), [(0.035, False), (0.075, True)])
def test_share_of_zeros_in_a_dark(share: float, named: bool) -> None:
    dark = np.full((40, 50), 60.0)
    dark.flat[: round(2000 * share)] = 0.0
    assert _said_darks(dark, dark + _daylight(800.0)[:40, :1]) == ["dark-of-zeros"] * named


@pytest.mark.parametrize(("share", "named"), [(0.075, False), (0.15, True)])
def test_share_of_bands_in_which_a_dark_exceeds_the_scene(share: float, named: bool) -> None:
    dark = np.full((40, 50), 60.0)
    scene = dark + np.where(np.arange(40) < 40 * share, -20.0, 20.0)[:, None]
    assert _said_darks(dark, scene) == ["dark-over-scene"] * named
    # a drift of 15 % of the dark is right, one of 30 % is not
    assert _said_darks(dark, 0.85 * dark) == []
    assert _said_darks(dark, 0.7 * dark) == ["dark-over-scene"]


@pytest.mark.parametrize(("change", "named"), [(0.18, False), (0.35, True)])
def test_change_of_the_median_of_dark_frames(change: float, named: bool) -> None:
    level = np.where(np.arange(20) == 7, 100.0 * (1.0 + change), 100.0)
    counts = xr.DataArray(np.broadcast_to(level[:, None, None], (20, 9, 5)), dims=("line", "band", "column"))
    assert [f.kind.name for f in judge_dark_frames("dark", counts)] == ["dark-unsteady"] * named


@pytest.mark.parametrize(("rise", "frames", "named"), [(0.2, 20, False), (0.55, 20, True), (0.2, 2, False)])
def test_rise_of_the_median_over_the_dark_frames(rise: float, frames: int, named: bool) -> None:
    level = np.linspace(100.0, 100.0 * (1.0 + rise), frames)[:, None, None]
    counts = xr.DataArray(np.broadcast_to(level, (frames, 9, 5)), dims=("line", "band", "column"))
    assert [f.kind.name for f in judge_dark_frames("dark", counts)] == ["dark-unsteady"] * named
