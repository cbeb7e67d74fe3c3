"""Run all checks of one flight line."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Bools, Floats
from hyperpaint.base.constants import SATURATION_MARGIN_COUNTS
from hyperpaint.base.errors import PaintWarning
from hyperpaint.base.variables import BAND, CROSS_TRACK
from hyperpaint.io.envi.envi_cubes import find_pair, open_envi
from hyperpaint.io.envi.envi_header import read_header
from hyperpaint.io.flightline.dark import DARK_NONE
from hyperpaint.io.flightline.flightline_opening import FlightlineInputs
from hyperpaint.radiometry.planning import SAME_EXPOSURE_SHARE, darks_of_lines

from .cube_sample import CubeSample, sample_cube
from .finding import KINDS, Finding
from .plausible_bands import judge_bands
from .plausible_frames import judge_doubles, judge_index
from .plausible_layout import judge_layout
from .plausible_record import judge_irradiance, judge_navigation

# -- Check that a dark belongs to the camera and settings of the scene.


@dataclass(frozen=True)
class DarkRules:
    """Thresholds beyond which frames are not a dark of this scene.

    zero_share
        Elements of exactly zero counts under a lit scene [1]: set between dead elements of a detector, under
        1 %, and every second column or band, 50 %.
    zero_counts
        Mean of the scene over an element from which it is lit, and of the dark's other elements from which
        zeros stand out [count]: masked columns hold a stray count, a black level of 0.2 counts is rounded to
        true zeros.
    over_share, over_counts, over_level
        Bands [1] whose dark, as a mean of all columns, lies above the scene by so many counts, and by
        this part of the dark: water beyond 900 nm lies on its dark, which drifts with temperature. Set
        between a drift of 11 % over a pedestal of 100 counts (right) and half the scene's light (wrong).
    lit_correlation, lit_slope, lit_most, lit_bands
        Correlation [1] and slopes [1] of the dark's curvature over wavelength on the curvature of the scene's
        light, and the fewest bands: any two rising curves agree in their slopes, light and a bias only by
        chance in their curvature. Set between 0.36 of right and 0.97 of lit darks of the campaign. Above
        `lit_most` the dark's own shape is the larger one.
    lit_range
        Range of the scene's light over the range of the dark without it [1]: set between a gradient of the
        bias under a dim scene (right, 1) and a tenth to a third of the light (wrong, 17).
    frames, frame_bands, frame_counts, frame_share
        Frames of a dark, and bands of each, that are sampled, and by how many counts and what part of
        itself [1] the median of a frame may change: temperature changes it by some per cent.
    pattern_slopes
        Slope of the scene's pattern on the dark's [1]: it is 1 for the matching dark, 0 for a foreign one,
        2 and 0.5 for a dark of half and twice the exposure; set between these and the 0.88 to 1.36 that
        right collects of the campaign reach.
    pattern_sds
        Standard uncertainties by which it has to differ from 1.
    pattern_contrast
        Variance of the dark's pattern over the variance of its noise and rounding from which it is judged
        [1]: noise of a quarter lowers the slope to 0.75, which is still right.
    pattern_range
        Range of the dark below which it has no pattern [count]: rounding makes steps of one.
    pattern_elements
        Fewest differences of elements to judge by.
    """

    zero_share: float = 0.05
    zero_counts: float = 1.0
    over_share: float = 0.1
    over_counts: float = 5.0
    over_level: float = 0.2
    lit_correlation: float = 0.9
    lit_slope: float = 0.03
    lit_most: float = 1.0
    lit_bands: int = 16
    lit_range: float = 5.0
    frames: int = 512
    frame_bands: int = 8
    frame_counts: float = 5.0
    frame_share: float = 0.25
    pattern_slopes: tuple[float, float] = (0.6, 1.6)
    pattern_sds: float = 5.0
    pattern_contrast: float = 4.0
    pattern_range: float = 2.0
    pattern_elements: int = 200


RULES = DarkRules()


def judge_dark(
    name: str, dark: Floats, uncertainty: Floats | None, gain: Floats, sample: CubeSample, full: float
) -> Iterator[Finding]:
    """Judge dark counts, all (band, cross_track), against a sample of the scene.

    uncertainty: of the mean dark [count], None where unknown; gain: of radiance, in any unit; full: count
    from which an element is saturated.
    """
    zeros = float(np.mean((dark == 0.0) & (sample.mean > RULES.zero_counts)))
    others = dark[dark > 0.0]
    if zeros > RULES.zero_share and (others.size == 0 or others.mean() > RULES.zero_counts):
        yield Finding(
            KINDS["dark-of-zeros"],
            name,
            f"{100 * zeros:.3g} % of the dark's elements are exactly 0 in every frame, under light",
            f"at most {100 * RULES.zero_share:g} %",
        )
        return
    dark_bands, light_bands = np.nanmean(dark, axis=1), np.nanmean(sample.mean - dark, axis=1)
    over = float(np.mean(light_bands < -np.maximum(RULES.over_counts, RULES.over_level * dark_bands)))
    if over > RULES.over_share:
        yield Finding(
            KINDS["dark-over-scene"],
            name,
            f"the dark lies above the mean of the scene in {100 * over:.3g} % of the bands, "
            f"{np.median(dark):.4g} against {np.median(sample.mean):.4g} counts",
            f"at most {100 * RULES.over_share:g} %",
        )
        return
    yield from _judge_light(name, dark_bands, light_bands)
    if uncertainty is not None:
        yield from _judge_pattern(name, dark, uncertainty, gain, sample, full)


def judge_dark_frames(name: str, counts: xr.DataArray) -> Iterator[Finding]:
    """Find frames of a dark cube (along_track, band, cross_track), read lazily, that are blank or lit."""
    bands = np.unique(np.linspace(0, counts.shape[1] - 1, RULES.frame_bands).astype(int))
    frames = np.unique(np.linspace(0, counts.shape[0] - 1, RULES.frames).astype(int))
    sample = counts.isel({counts.dims[0]: frames, counts.dims[1]: bands})
    levels = np.median(sample.to_numpy(), axis=(1, 2))
    median = float(np.median(levels))
    tolerance = max(RULES.frame_counts, RULES.frame_share * median)
    if float(np.abs(levels - median).max()) > tolerance:
        yield Finding(
            KINDS["dark-unsteady"],
            name,
            f"medians of {levels.size} frames range from {levels.min():g} to {levels.max():g} counts",
            f"{median:g} +- {tolerance:.3g}",
        )


def _judge_light(name: str, dark: Floats, light: Floats) -> Iterator[Finding]:
    # Find the light of the scene in a dark, both (band,)
    finite = np.isfinite(dark) & np.isfinite(light)
    dark, light = dark[finite], light[finite]
    if dark.size < RULES.lit_bands or not (np.ptp(dark) > 0.0 and np.ptp(light) > 0.0):
        return
    bend, lit = np.diff(dark, 2), np.diff(light, 2)
    if not (np.any(bend) and np.any(lit)):
        return
    correlation = float(bend @ lit / np.sqrt((bend @ bend) * (lit @ lit)))
    slope = float(bend @ lit / (lit @ lit))
    if not RULES.lit_slope < slope <= RULES.lit_most:
        return
    if correlation > RULES.lit_correlation and np.ptp(light) > RULES.lit_range * np.ptp(dark - slope * light):
        yield Finding(
            KINDS["dark-lit"],
            name,
            f"the spectrum of the dark follows the scene (correlation {correlation:.2f}), with "
            f"{100 * slope:.3g} % of its light",
            f"no light, under {100 * RULES.lit_slope:g} %",
        )


def _judge_pattern(
    name: str, dark: Floats, uncertainty: Floats, gain: Floats, sample: CubeSample, full: float
) -> Iterator[Finding]:
    # Find a dark whose pattern is not part of the scene.
    # Mean scene = dark + light / gain: differences of neighbouring elements leave the two patterns, and a
    # regression of the scene's on both gives the share of the dark's pattern in it.
    if dark.shape[0] < 3 or dark.shape[1] < 2 or not np.nanmax(dark) - np.nanmin(dark) > RULES.pattern_range:
        return
    level = np.nanmedian(np.where(np.isfinite(gain), (sample.mean - dark) * gain, np.nan), axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        expected = level[:, None] / gain
    scene, pattern, lit = _differences(sample.mean), _differences(dark), _differences(expected)
    # residuals of the scene in the differences grow with the light, and with noise
    scale = np.hypot(np.maximum(np.abs(expected), 0.0), 0.05 * np.nanmax(np.abs(expected)) + 1.0)[1:-1, 1:]
    # differences of unsaturated elements alone
    unsaturated = sample.highest < full
    rows = unsaturated[:-2] & unsaturated[1:-1] & unsaturated[2:]
    usable: Bools = np.isfinite(scene) & np.isfinite(pattern) & np.isfinite(lit)
    usable &= rows[:, 1:] & rows[:, :-1]
    if usable.sum() < RULES.pattern_elements:
        return
    # variance of a difference: 12 is the sum of its squared weights; rounding to whole counts adds 1/12,
    # which frames do not average out where the noise is under a count
    noise = 12.0 * (float(np.mean(np.square(uncertainty))) + 1.0 / 12.0)
    # without hot elements, whose dark changes differently
    usable &= np.abs(pattern) <= 8.0 * np.median(np.abs(pattern[usable])) + 1e-9
    if np.var(pattern[usable]) < RULES.pattern_contrast * noise or not np.any(pattern[usable]):
        return
    weights = 1.0 / scale[usable]
    terms = np.stack([pattern[usable], lit[usable]]) * weights
    values = scene[usable] * weights
    for _ in range(2):  # the second fit without outliers
        slopes = np.linalg.lstsq(terms @ terms.T, terms @ values, rcond=None)[0]
        residual = values - slopes @ terms
        near = np.abs(residual) <= 4.0 * (1.4826 * np.median(np.abs(residual)) + 1e-12)
        terms, values, residual = terms[:, near], values[near], residual[near]
    # neighbouring differences share elements: three times the uncertainty of independent ones
    spread = 3.0 * np.sqrt(np.mean(np.square(residual)) / max(float(np.square(terms[0]).sum()), 1e-30))
    least, most = RULES.pattern_slopes
    if not least <= slopes[0] <= most and abs(1.0 - slopes[0]) > RULES.pattern_sds * spread:
        yield Finding(
            KINDS["dark-pattern"],
            name,
            f"{slopes[0]:.2f} +- {spread:.2f} of the dark's pattern is in the scene",
            f"1, {least:g} to {most:g}",
        )


def _differences(array: Floats) -> Floats:
    # Second differences over bands of first differences over columns: slow changes cancel
    return np.asarray(np.diff(np.diff(array, 2, axis=0), axis=1))


# -- Check for counts above the range of the camera's converter.

#: Largest share of the elements [1] that a frame counter or status word takes: a column in 640.
STRAY_SHARE = 2e-3


def judge_range(name: str, sample: CubeSample, bit_depth: int, saturation_count: float) -> Iterator[Finding]:
    """Find counts above the converter's highest one; a larger ``saturation_count`` replaces it."""
    limit = max(2**bit_depth - 1, int(saturation_count))
    highest = int(sample.highest.max())
    if highest <= limit:
        return
    share = float(np.mean(sample.highest > limit))
    shifted = sample.divisor > 1 and sample.divisor.bit_count() == 1  # by whole bits
    multiple = f", all multiples of {sample.divisor}: left-justified" if shifted else ""
    yield Finding(
        KINDS["stray-counts" if share < STRAY_SHARE else "counts-over-range"],
        name,
        f"counts up to {highest}{multiple}, above {limit} in {100 * share:.3g} % of the elements",
        f"at most {limit}, of {bit_depth} bits",
    )


def judge_line(
    line: xr.Dataset, cubes: tuple[FlightlineInputs, ...], *, lit: bool = True
) -> Iterator[Finding]:
    """Judge a flight line and its cubes; samples of them are read.

    ``lit``: whether reflectance is computed, so that the record of irradiance matters.
    """
    name = str(line.attrs["name"])
    if lit:
        yield from judge_irradiance(name, line)
    yield from judge_navigation(name, line)
    for inputs in cubes:
        yield from _judge_cube(line, inputs)


def judge_dark_cube(path: Path) -> Iterator[Finding]:
    """Judge the frames of a dark cube."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PaintWarning)  # opening the dark has warned
        counts = open_envi(path, unsaid="counts")["counts"]
    yield from judge_dark_frames(f"{path.parent.name}/{path.name}", counts)


def _judge_cube(line: xr.Dataset, inputs: FlightlineInputs) -> Iterator[Finding]:
    name = str(inputs.name)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PaintWarning)  # opening the line has warned
        opened = open_envi(
            inputs.path, keep_whole_lines=inputs.keep_whole_lines, quantity=inputs.quantity, unsaid="counts"
        )
        interleave = read_header(find_pair(inputs.path)[0]).interleave
    cube = next(iter(opened.data_vars.values()))
    recorded, findings = judge_index(inputs, cube.shape[0])
    yield from findings
    yield from judge_doubles(name, cube, interleave == "bip", recorded)
    if "counts" not in line or "counts" not in opened:
        return
    layout = list(judge_layout(name, inputs.path, cube.shape[0]))
    yield from layout
    sample = sample_cube(cube, recorded)
    # a cube that is read in a wrong order allows no further check
    if sample is not None and not layout:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # bands without a gain have no mean
            findings = list(_judge_sample(name, line, inputs, sample))
        yield from findings


def _judge_sample(
    name: str, line: xr.Dataset, inputs: FlightlineInputs, sample: CubeSample
) -> Iterator[Finding]:
    saturation = float(np.max(line["saturation_count"].values))
    full = saturation - SATURATION_MARGIN_COUNTS
    yield from judge_range(name, sample, inputs.bit_depth, saturation)
    gain = line["radiance_gain"].transpose(BAND, CROSS_TRACK).values.astype(np.float64)
    dark, is_measured = _dark_of(line)
    if line.attrs.get("dark_source") != DARK_NONE:
        uncertainty = line.get("dark_counts_u_random") if is_measured else None
        spread = None if uncertainty is None else uncertainty.transpose(BAND, CROSS_TRACK).values
        yield from judge_dark(name, dark, spread, gain, sample, full)
    if "wavelength" in line.coords:
        record = None
        if "irradiance" in line:
            record = (line["irradiance_wavelength"].values, line["irradiance"].mean("irradiance_time").values)
        fwhm = float(np.median(line["fwhm"].values)) if "fwhm" in line.coords else 5.0
        light = np.nanmean(np.where(np.isfinite(gain), sample.mean - dark, np.nan), axis=1)
        mean_gain = np.nanmean(gain, axis=1)
        yield from judge_bands(name, light, mean_gain, line["wavelength"].values, fwhm, record)


def _dark_of(line: xr.Dataset) -> tuple[Floats, bool]:
    # Dark (band, cross_track) of a line, and whether it was measured at the line's exposure.
    # A dark that is fitted to darks of other exposures has no noise of its own.
    parts = {"dark_counts": line["dark_counts"].transpose(..., BAND, CROSS_TRACK).values}
    exposure = np.atleast_1d(line["exposure_time"].values).astype(np.float64)
    if "dark_exposure_time" in line:
        parts["dark_exposure_time"] = line["dark_exposure_time"].values
    taken = np.atleast_1d(parts.get("dark_exposure_time", exposure.mean())).astype(np.float64)
    dark = darks_of_lines(parts, exposure)[0].mean(axis=0, dtype=np.float64)
    return dark, bool((np.abs(taken / exposure.mean() - 1.0) <= SAME_EXPOSURE_SHARE).all())
