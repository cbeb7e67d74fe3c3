"""Checks of the product of a flight line: reflectance of sampled lines, and patterns of gain, smile and slit.

Plain arrays of a sample come in, verdicts go out, those that passed as well. A wrong scale of any input shows
in reflectance, the one number with a known range.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hyperpaint.base import Bools, Floats


@dataclass(frozen=True)
class Rules:
    """Limits of a plausible product, each between right and wrong collects of seeds 0 to 9.

    docs/guide/plausibility.md states the alarms over right collects of 38 kinds: cloud, overcast, dusk, sun
    at 75 degrees, snow, water, dark asphalt, bright roofs, one column, 10 to 16 bits, a real line scanner.

    Attributes
    ----------
    judged_nm
        Wavelengths of the compared bands [nm]: outside, light or responsivity are weak.
    most_coloured, most_grey
        Highest reflectance of a surface whose bands differ, such as vegetation, soil or coloured paint, and
        of a grey one such as snow, roofs and white paint [1].
    grey
        Reflectance of the darkest over that of the brightest tenth of the bands from which a pixel is grey
        [1]: snow has 0.7 and more, white paint 0.8.
    bright_share
        Accepted share of pixels above these limits [1]; glint and mirrors fill less.
    refused_level
        Reflectance of the brightest tenth of the pixels above which a line is refused [1]: level snow has
        1.0, slopes of it 1.15.
    slope_deg
        Slope towards the sun whose additional light is accepted [degree], and maximum factor of it.
    least_top, refused_top
        Reflectance of the brightest pixels in their brightest bands below which a line is doubtful, and
        refused [1]: water and wet asphalt mirror 0.02 of the sky; a dusk of 0.03 of the declared light has
        0.010.
    least_full_scale
        Reflectance at which the first band saturates, below which a line is doubtful [1]: ordinary exposures
        reach 0.8; long ones, for dark water, are told as well.
    ordinary_level
        Median reflectance of ordinary ground, from which the factor of a slip is estimated [1].
    slip_range
        Range of factors around the estimate within which slips are named [1].
    multiple, known_top
        Smallest common divisor of counts that is reported, and range of reflectance of the brightest pixels
        in which counts with a divisor are nevertheless right [1].
    least_light
        Light above which elements are compared [count].
    pattern_elements
        Minimum number of differences between elements.
    foreign_slope, matching_slope
        Share of the gain's pattern in the scene below which the gain is not of these elements, and above
        which another order of the gain explains it [1]: right gains have 0.95 to 1.03, foreign ones -0.3 to
        0.3.
    significance
        Distance of a slope from its expected value [standard uncertainties].
    smile_nm, wrong_smile
        Minimum range of a judged smile [nm], and share of it in the scene below which its sign is wrong [1]:
        0.7 to 1.4 for right ones, 0 for scenes without smile, -0.7 to -1.0 for the wrong sign.
    jump, jump_nm, not_judged_nm
        Median over the pixels of the logarithm of a band's reflectance over that of its two neighbours from
        which the band is named [1]; range in which it is judged, and range within it that is not, where
        wavelengths of camera and record that differ leave the oxygen band [nm].
    usual_nm, widest_nm
        Median spacing of bands [nm] above which the limit increases with its square, as red edges do (0.15 at
        10 nm, 0.01 at 2 nm), and above which no band is judged.
    step
        Minimum step of the logarithm of radiance between neighbouring columns [1].
    step_colour, step_change, step_part
        Largest standard deviation of a step over bands (with a third of 1), and change in a part of blocks of
        lines, relative to the step and a half [1]: an edge of the slit dims all bands of all lines alike
        (0.002 and 0.006); edges of surfaces along the track change colour (0.01 to 0.03), others wander.
    strong_step, strong_colour, strong_change
        Minimum of a strong step, and its limits: without colour (0.001 to 0.007) it is an edge of the slit
        even where the ground beside it changes (0.11); shadows of this depth change more (0.3).
    step_blocks
        Minimum number of blocks of lines.
    """

    judged_nm: tuple[float, float] = (420.0, 950.0)
    most_coloured: float = 1.05
    most_grey: float = 1.4
    grey: float = 0.6
    bright_share: float = 0.04
    refused_level: float = 1.6
    slope_deg: float = 6.0
    most_slope: float = 2.5
    least_top: float = 0.008
    refused_top: float = 0.003
    least_full_scale: float = 0.2
    ordinary_level: float = 0.2
    slip_range: float = 2.5
    multiple: int = 4
    known_top: tuple[float, float] = (0.1, 1.05)
    least_light: float = 20.0
    pattern_elements: int = 200
    foreign_slope: float = 0.4
    matching_slope: float = 0.7
    significance: float = 5.0
    smile_nm: float = 0.4
    wrong_smile: float = -0.4
    jump: float = 0.18
    jump_nm: tuple[float, float] = (430.0, 880.0)
    not_judged_nm: tuple[float, float] = (750.0, 775.0)
    usual_nm: float = 10.0
    widest_nm: float = 16.0
    step: float = 0.08
    step_colour: float = 0.015
    step_change: float = 0.014
    step_part: float = 0.7
    strong_step: float = 0.3
    strong_colour: float = 0.008
    strong_change: float = 0.07
    step_blocks: int = 4


RULES = Rules()

#: Frequent slips of scale: factor [1], slip, and whether it is one of the irradiance record.
_SLIPS = (
    (math.pi, "radiance taken for irradiance", True),
    (10.0, "mW cm-2 taken for W m-2", True),
    (20.0, "a filter before the receptor", True),
    (100.0, "uW cm-2 taken for W m-2", True),
    (1000.0, "mW taken for W", True),
    (math.pi, "pi in the gain", False),
    (4.0, "counts of 12 bits in 14, or 14 in 16", False),
    (5.0, "an exposure time that the camera did not use", False),
    (16.0, "counts of 12 bits in 16", False),
    (100.0, "cm-2 taken for m-2, or per cent for fractions", False),
    (1000.0, "mW taken for W, or ms for s", False),
)


class Verdict(NamedTuple):
    # Result of one check of a product.
    kind: str  # Name of the kind of finding
    found: str
    expected: str
    passes: bool


class Product(NamedTuple):
    # Sample of a line: means of blocks of lines, and what calibrates them.
    light: Floats  # (block, band, column) counts above the dark, NaN where saturated [count]
    gain: Floats  # (band, column), of radiance or of reflectance to a white
    wavelength: Floats  # (band,) [nm]
    lines: int  # Number of lines in the sample
    divisor: int  # Greatest common divisor of all counts
    reflectance: Floats | None  # (block, band, column) [1], None where unknown
    full_scale: Floats | None  # (band,) reflectance at which the band saturates [1], None where unknown
    share: float  # Irradiance over that of a clear sky [1], NaN where unknown
    zenith: float  # Zenith angle of the sun [degree], NaN where unknown
    shift: Floats | None  # (column,) declared smile [nm]
    irradiance_at: Callable[[Floats], Floats] | None  # Irradiance at wavelengths [nm]


def judge_product(product: Product) -> Iterator[Verdict]:
    # Judge level, gain, smile and swath of a sample.
    top = math.nan
    if product.reflectance is not None:
        verdicts, top = _level(product, product.reflectance)
        yield from verdicts
        yield from _jump(product, product.reflectance)
    if product.divisor >= RULES.multiple and product.divisor.bit_count() == 1:
        low, high = RULES.known_top
        yield Verdict(
            "counts-multiple",
            f"all counts are multiples of {product.divisor}: left-justified, or shifted by a program",
            f"counts in steps of 1, or reflectance of the brightest pixels of {low:g} to {high:g}",
            low <= top <= high,
        )
    yield from _gain(product)
    yield from _smile(product)
    yield from _swath(product)


def _level(product: Product, reflectance: Floats) -> tuple[list[Verdict], float]:
    # Return the verdict on the level, and reflectance of the brightest pixels in their brightest bands [1].
    first, last = RULES.judged_nm
    is_judged = (product.wavelength >= first) & (product.wavelength <= last)
    is_judged |= is_judged.sum() < 3
    spectra = reflectance[:, is_judged]
    # saturated pixels, mostly glint, say nothing by their few other bands
    is_known = np.isfinite(spectra).mean(axis=1, keepdims=True) > 0.5
    low, level, high = np.nanquantile(np.where(is_known, spectra, np.nan), (0.1, 0.5, 0.9), axis=1)
    if not np.isfinite(level).any():
        return [], math.nan
    zenith = math.radians(min(product.zenith, 89.0)) if math.isfinite(product.zenith) else 0.0
    slope = math.cos(zenith - min(math.radians(RULES.slope_deg), zenith)) / math.cos(zenith)
    slope = min(slope, RULES.most_slope)
    is_grey = low > RULES.grey * high
    limit = slope * np.where(is_grey, RULES.most_grey, RULES.most_coloured)
    share = float(np.mean(high[np.isfinite(high)] > limit[np.isfinite(high)]))
    median, bright = (float(np.nanquantile(level, part)) for part in (0.5, 0.9))
    top = float(np.nanquantile(high, 0.98))
    is_high = share > RULES.bright_share
    is_refused = top < RULES.refused_top or (is_high and bright > slope * RULES.refused_level)
    found = f"the median reflectance is {median:.3g}, {bright:.3g} in the brightest tenth of the pixels"
    full_scale = math.inf if product.full_scale is None else float(np.nanmin(product.full_scale[is_judged]))
    is_short = full_scale < RULES.least_full_scale
    passes = not (is_high or top < RULES.least_top or is_short)
    if not passes:
        found += f", {100 * share:.3g} % of them too bright for their colour" * is_high
        found += f", and the camera saturates at {full_scale:.2g}" * is_short + _slip(product, median)
    expected = (
        f"{RULES.least_top:g} to {slope * RULES.most_coloured:.3g}, grey surfaces to "
        f"{slope * RULES.most_grey:.3g}; saturation from {RULES.least_full_scale:g} on"
    )
    kind = "reflectance-impossible" if is_refused else "reflectance-level"
    return [Verdict(kind, found, expected, passes)], top


def _slip(product: Product, median: float) -> str:
    # Return the likely cause of a wrong level: the inputs to blame, and slips with about its factor.
    #
    # Radiance that a clear sky explains blames the record; the other inputs otherwise.
    ratio = median / RULES.ordinary_level
    is_record = ratio > 1.0 and product.share < 0.6 and ratio * product.share < 2.0
    if is_record:
        ratio = 1.0 / product.share
    elif product.divisor >= RULES.multiple:
        ratio = product.divisor
    factor = max(ratio, 1.0 / ratio)
    likely = [
        (abs(math.log(slip / factor)), f"{slip:.4g} ({text})") for slip, text, of in _SLIPS if of == is_record
    ]
    nearest = min(likely)[0]
    slips = " or ".join(
        text for distance, text in likely if distance <= max(nearest, math.log(RULES.slip_range))
    )
    blamed = (
        f"the irradiance record, which has {product.share:.2g} of a clear sky's light"
        if is_record
        else "the gain of the calibration, the exposure time, the bit depth or the irradiance"
    )
    return f": likely {blamed}, by a factor of about {factor:.2g}; known slips of this size: {slips}"


def _jump(product: Product, reflectance: Floats) -> Iterator[Verdict]:
    # Find a band whose reflectance differs from that of its neighbours by about one factor in most pixels.
    nm, order = np.sort(product.wavelength), np.argsort(product.wavelength)
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = np.log(np.where(reflectance > 0.0, reflectance, np.nan))[:, order]
    jumps = logs[:, 1:-1] - 0.5 * (logs[:, :-2] + logs[:, 2:])
    (first, last), (low, high), centre = RULES.jump_nm, RULES.not_judged_nm, nm[1:-1]
    is_judged = (centre > first) & (centre < last) & ~((centre > low) & (centre < high))
    is_judged &= np.isfinite(jumps).mean(axis=(0, 2)) > 0.5
    spacing = float(np.median(np.diff(nm)))
    if not is_judged.any() or spacing > RULES.widest_nm:
        return
    limit = RULES.jump * max(1.0, spacing / RULES.usual_nm) ** 2
    jump = np.where(is_judged, np.nanmedian(jumps, axis=(0, 2)), 0.0)
    band = int(np.argmax(np.abs(jump)))
    yield Verdict(
        "band-jump",
        f"reflectance at {centre[band]:.1f} nm is {math.exp(jump[band]):.3g} times that of the neighbouring "
        "bands in most pixels: a fault of the calibration's gain, or of the irradiance record's channels",
        f"bands that differ by less than {100.0 * limit:.0f} %",
        abs(jump[band]) < limit,
    )


def _gain(product: Product) -> Iterator[Verdict]:
    # Compare the pattern of neighbouring elements in scene and gain: 1 of it is in a scene of this gain.
    light = np.nanmean(product.light, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        scene = _pattern(np.log(np.where(light > RULES.least_light / 4.0, light, np.nan)))
        noise = (4.0 + np.abs(light)) / product.lines / np.maximum(light, 1.0) ** 2 + 1e-6
        response = -np.log(product.gain)
    weight = 1.0 / (noise[:-2, 1:] + 4.0 * noise[1:-1, 1:] + noise[2:, 1:])
    slope, u = _regressed(scene, _pattern(response), weight)
    if not math.isfinite(slope):
        return
    orders = {"its bands reversed": response[::-1], "its columns reversed": response[:, ::-1]}
    orders |= {f"its bands shifted by {k}": np.roll(response, k, axis=0) for k in (-3, -2, -1, 1, 2, 3)}
    passes = slope > RULES.foreign_slope or slope + RULES.significance * u > RULES.foreign_slope + 0.3
    found, kind = f"{slope:.2f} +- {u:.2f} of the gain's pattern is in the scene", "gain-pattern"
    for order, values in {} if passes else orders.items():
        other, other_u = _regressed(scene, _pattern(values), weight)
        if other - RULES.significance * other_u > 0.5 and other > RULES.matching_slope:
            found += f", {other:.2f} with {order}"
            kind = "gain-order"
    yield Verdict(kind, found, f"1, at least {RULES.foreign_slope:g}", passes)


def _pattern(logarithm: Floats) -> Floats:
    # Second differences over bands of first differences over columns: spectra and surfaces cancel
    return np.diff(np.diff(logarithm, 2, axis=0), axis=1) if len(logarithm) > 2 else logarithm[:0, 1:]


def _regressed(values: Floats, terms: Floats, weight: Floats | float = 1.0) -> tuple[float, float]:
    # Return the slope of values on terms, without outliers, and its standard uncertainty; NaN with too few.
    usable: Bools = np.isfinite(values) & np.isfinite(terms) & np.isfinite(weight)
    if usable.sum() < RULES.pattern_elements:
        return math.nan, math.nan
    for array in (values, terms):
        usable &= np.abs(array) <= 6.0 * np.median(np.abs(array[usable])) + 1e-12
    w = np.broadcast_to(weight, values.shape)[usable]
    v, t = values[usable], terms[usable]
    size = float((w * t * t).sum())
    if usable.sum() < RULES.pattern_elements or size <= 0.0 or np.median(np.abs(t)) < 1e-4:
        return math.nan, math.nan
    slope = float((w * v * t).sum()) / size
    # neighbouring differences share elements: three times the uncertainty of independent differences
    return slope, 3.0 * math.sqrt(float(np.mean(w * (v - slope * t) ** 2)) / size)


def _smile(product: Product) -> Iterator[Verdict]:
    # Compare solar lines in the columns with those that the declared smile moves: 1 of it is in the scene.
    if product.shift is None or product.irradiance_at is None or np.ptp(product.shift) < RULES.smile_nm:
        return
    light = np.nanmean(product.light, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        scene = np.diff(np.log(np.where(light > RULES.least_light, light * product.gain, np.nan)), 2, axis=0)
        sky = np.stack([product.irradiance_at(product.wavelength + shift) for shift in product.shift], axis=1)
        moved = np.diff(np.log(sky), 2, axis=0)
    # all columns share the curvature of the ground's spectra
    scene, moved = (array - np.nanmedian(array, axis=1, keepdims=True) for array in (scene, moved))
    # most bands are without solar lines, where the term is small and no outlier
    usable = np.isfinite(scene) & np.isfinite(moved)
    if usable.sum() < RULES.pattern_elements:
        return
    usable &= np.abs(scene) <= 8.0 * np.median(np.abs(scene[usable])) + 0.05
    values, terms = scene[usable], moved[usable]
    size = float(terms @ terms)
    slope = float(values @ terms) / size if size > 0.0 else math.nan
    u = 3.0 * math.sqrt(float(np.mean((values - slope * terms) ** 2)) / size) if size > 0.0 else math.nan
    if not slope + RULES.significance * u < math.inf:
        return
    yield Verdict(
        "smile-sign",
        f"{slope:.2f} +- {u:.2f} of the declared wavelength_shift (smile) is in the columns of the scene",
        f"1, not under {RULES.wrong_smile:g}",
        not (slope < RULES.wrong_smile and slope < -RULES.significance * u / 3.0),
    )


def _swath(product: Product) -> Iterator[Verdict]:
    # Find a step of radiance between neighbouring columns that is the same in all bands and all lines.
    light = product.light
    bands = np.nanmean(light, axis=(0, 2))
    is_lit = bands > max(RULES.least_light, 0.1 * float(np.nanmax(bands)))
    if len(light) < RULES.step_blocks or is_lit.sum() < 8 or light.shape[2] < 8:
        return
    radiance = (light * product.gain)[:, is_lit]
    parts = np.array_split(np.arange(radiance.shape[1]), 8)
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = np.log(np.stack([np.nanmean(radiance[:, part], axis=1) for part in parts], axis=1))
    steps = np.diff(logs, axis=2)  # (block, part, column)
    size = np.median(steps, axis=(0, 1))
    colour, blocks = np.median(steps, axis=0).std(axis=0), np.median(steps, axis=1)
    change = np.quantile(np.abs(blocks - np.median(blocks, axis=0)), RULES.step_part, axis=0)
    colour, change = colour / (0.3 + np.abs(size)), change / (0.5 + np.abs(size))
    limits = (
        (RULES.step, RULES.step_colour, RULES.step_change),
        (RULES.strong_step, RULES.strong_colour, RULES.strong_change),
    )
    is_edge = np.any(
        [(np.abs(size) > least) & (colour < most) & (change < moved) for least, most, moved in limits], axis=0
    )
    column = int(np.argmax(np.where(is_edge, np.abs(size), -1.0)))
    factor = math.exp(float(size[column]))
    found = (
        f"from column {column + 1} on, the swath has {factor:.2f} of the light beside it, alike in all bands "
        "and lines: a blocked or vignetted slit"
        if is_edge.any()
        else "no step between columns is alike in all bands and lines"
    )
    yield Verdict("swath-step", found, "edges that change with line or band", not is_edge.any())
