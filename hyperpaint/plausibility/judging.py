"""Checks of the inputs of a flight line: counts, bands, layout, dark, frames, irradiance and navigation.

Checks of its product: plain arrays of sampled lines come in, and reflectance, the one number with a known
range, is judged by level, colour and patterns of gain, smile and slit; a wrong scale of any input shows.
"""

import io
import math
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from hyperpaint.base import (
    ALONG_TRACK,
    ANGLES,
    BAND,
    CROSS_TRACK,
    IRRADIANCE_TIME,
    SATURATION_MARGIN_COUNTS,
    Array,
    Bools,
    Floats,
    Ints,
    PaintWarning,
    Problem,
    RemoteData,
    lines_a_task,
    open_data,
    pieces_of,
)
from hyperpaint.io.envi.envi_cubes import EnviHeader, find_pair, open_envi, read_header
from hyperpaint.io.flightline.flightline_opening import DARK_NONE, FlightlineInputs, Timing
from hyperpaint.io.flightline.side_files import cube_number, match_frames, read_frame_index
from hyperpaint.io.spectrometers.record_faults import FAULTS_ATTR, RECORD
from hyperpaint.light.clear_sky import ClearSky
from hyperpaint.radiometry.darks import SAME_EXPOSURE_SHARE, darks_of_lines
from hyperpaint.radiometry.planning import has_white, light_level

#: Limits of a plausible product, each between right and wrong collects of seeds 0 to 9.
#:
#: docs/guide/plausibility.md states the alarms over right collects of 38 kinds: cloud, overcast, dusk, sun at
#: 75 degrees, snow, water, dark asphalt, bright roofs, one column, 10 to 16 bits, a real line scanner.
RULES = SimpleNamespace(
    # Wavelengths of the compared bands [nm]: outside, light or responsivity are weak.
    judged_nm=(420.0, 950.0),
    # Highest reflectance of a surface whose bands differ, such as vegetation, soil or coloured paint, and of
    # a grey one such as snow, roofs and white paint [1].
    most_coloured=1.05,
    most_grey=1.4,
    # Reflectance of the darkest over that of the brightest tenth of the bands from which a pixel is grey [1]:
    # snow has 0.7 and more, white paint 0.8.
    grey=0.6,
    # Accepted share of pixels above these limits [1]; glint and mirrors fill less.
    bright_share=0.04,
    # Reflectance of the brightest tenth of the pixels above which a line is refused [1]: level snow has 1.0,
    # slopes of it 1.15.
    refused_level=1.6,
    # Slope towards the sun whose additional light is accepted [degree], and maximum factor of it.
    slope_deg=6.0,
    most_slope=2.5,
    # Reflectance of the brightest pixels in their brightest bands below which a line is doubtful, and refused
    # [1]: water and wet asphalt mirror 0.02 of the sky; a dusk of 0.03 of the declared light has 0.010.
    least_top=0.008,
    refused_top=0.003,
    # Reflectance at which the first band saturates, below which a line is doubtful [1]: ordinary exposures
    # reach 0.8; long ones, for dark water, are told as well.
    least_full_scale=0.2,
    # Median reflectance of ordinary ground, from which the factor of a slip is estimated [1].
    ordinary_level=0.2,
    # Range of factors around the estimate within which slips are named [1].
    slip_range=2.5,
    # Smallest common divisor of counts that is reported, and range of reflectance of the brightest pixels in
    # which counts with a divisor are nevertheless right [1]; number of steps up to saturation below which
    # they are reported at any reflectance: left-justified counts of 10 bits have 1024.
    multiple=4,
    known_top=(0.1, 1.05),
    least_steps=512,
    # Light above which elements are compared [count].
    least_light=20.0,
    # Minimum number of differences between elements.
    pattern_elements=200,
    # Share of the gain's pattern in the scene below which the gain is not of these elements, and above which
    # another order of the gain explains it [1]: right gains have 0.95 to 1.03, foreign ones -0.3 to 0.3.
    foreign_slope=0.4,
    matching_slope=0.7,
    # Distance of a slope from its expected value [standard uncertainties].
    significance=5.0,
    # Minimum range of a judged smile [nm], and share of it in the scene below which its sign is wrong [1]:
    # 0.7 to 1.4 for right ones, 0 for scenes without smile, -0.7 to -1.0 for the wrong sign.
    smile_nm=0.4,
    wrong_smile=-0.4,
    # Correlation of solar lines in the mean column and in the record [1] from which the smile is judged: 0.66
    # and more in right collects, 0.4 with a record that is off by 5 nm.
    smile_lines=0.5,
    # Median over the pixels of the logarithm of a band's reflectance over that of its two neighbours from
    # which the band is named [1]; range in which it is judged, and range within it that is not, where
    # wavelengths of camera and record that differ leave the oxygen band [nm].
    jump=0.18,
    jump_nm=(430.0, 880.0),
    not_judged_nm=(750.0, 775.0),
    # Median spacing of bands [nm] above which the limit increases with its square, as red edges do (0.15 at
    # 10 nm, 0.01 at 2 nm), and above which no band is judged.
    usual_nm=10.0,
    widest_nm=16.0,
    # Minimum step of the logarithm of radiance between neighbouring columns [1].
    step=0.08,
    # Largest standard deviation of a step over bands (with a third of 1), and change in a part of blocks of
    # lines, relative to the step and a half [1]: an edge of the slit dims all bands of all lines alike (0.002
    # and 0.006); edges of surfaces along the track change colour (0.01 to 0.03), others wander.
    step_colour=0.015,
    step_change=0.014,
    step_part=0.7,
    # Minimum of a strong step, and its limits: without colour (0.001 to 0.007) it is an edge of the slit even
    # where the ground beside it changes (0.11); shadows of this depth change more (0.3).
    strong_step=0.3,
    strong_colour=0.008,
    strong_change=0.07,
    # Minimum of a deep step, and its limit of colour: what is left of the light has errors of the dark. Edges
    # of grey surfaces along the track have 1.2.
    deep_step=2.0,
    deep_colour=0.02,
    # Standard deviation of a strong step over bands (with a third of 1), and difference between blocks,
    # relative to the step and a half [1], below which blocks show the same grey step: edges of grey surfaces
    # have 0.0065 and more. Number of such blocks from which it is an edge of the slit (2 at most in right
    # collects, beside wandering shadows), and share of the blocks with any grey step.
    part_colour=0.004,
    part_change=0.02,
    part_blocks=3,
    part_share=0.75,
    # Share of the brightest column below which radiance counts as none [1]: columns without any light have
    # noise around zero.
    no_light=0.003,
    # Minimum number of blocks of lines; wavelength below which surfaces differ in colour [nm], and minimum
    # share of the lit bands below it [1]: one of the eight intervals of bands that are compared.
    step_blocks=4,
    visible_nm=700.0,
    visible_share=0.125,
)


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


class Product(NamedTuple):
    # Sample of a line: means of blocks of lines, and what calibrates them.
    light: Floats  # (block, band, column) counts above the dark, NaN where saturated [count]
    gain: Floats  # (band, column), of radiance or of reflectance to a white
    wavelength: Floats  # (band,) [nm]
    lines: int  # Number of lines in the sample
    divisor: int  # Greatest common divisor of all counts
    saturation: float  # Count from which elements are saturated
    reflectance: Floats | None  # (block, band, column) [1], None where unknown
    full_scale: Floats | None  # (band,) reflectance at which the band saturates [1], None where unknown
    share: float  # Irradiance over that of a clear sky [1], NaN where unknown
    zenith: float  # Zenith angle of the sun [degree], NaN where unknown
    shift: Floats | None  # (column,) declared smile [nm]
    irradiance_at: Callable[[Floats], Floats] | None  # Irradiance at wavelengths [nm]


def judge_product(name: str, product: Product) -> Iterator["Finding"]:
    # Judge level, gain, smile and swath of a sample.
    top = math.nan
    if product.reflectance is not None:
        findings, top = _level(name, product, product.reflectance)
        yield from findings
        yield from _jump(name, product, product.reflectance)
    if product.divisor >= RULES.multiple and product.divisor.bit_count() == 1:
        (low, high), steps = RULES.known_top, product.saturation / product.divisor
        yield Finding(
            KINDS["counts-multiple"],
            name,
            f"all counts are multiples of {product.divisor}, with {steps:.3g} steps up to saturation: "
            "left-justified, shifted by a program, or without their low bits",
            f"counts in steps of 1, or reflectance of the brightest pixels of {low:g} to {high:g} and "
            f"{RULES.least_steps} steps",
            low <= top <= high and steps >= RULES.least_steps,
        )
    yield from _gain(name, product)
    yield from _smile(name, product)
    yield from _swath(name, product)


def _level(name: str, product: Product, reflectance: Floats) -> tuple[list["Finding"], float]:
    # Return the finding on the level, and reflectance of the brightest pixels in their brightest bands [1].
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
    limit = slope * np.where(low > RULES.grey * high, RULES.most_grey, RULES.most_coloured)
    share = float(np.mean(high[np.isfinite(high)] > limit[np.isfinite(high)]))
    median, bright = (float(np.nanquantile(level, part)) for part in (0.5, 0.9))
    top = float(np.nanquantile(high, 0.98))
    is_high = share > RULES.bright_share
    is_refused = top < RULES.refused_top or (is_high and bright > slope * RULES.refused_level)
    found = f"the median reflectance is {median:.3g}, {bright:.3g} in the brightest tenth of the pixels"
    full_scale = math.inf if product.full_scale is None else float(np.nanmin(product.full_scale[is_judged]))
    is_short = full_scale < RULES.least_full_scale
    passes = not (is_high or top < RULES.least_top or is_short)
    if not passes and median <= 0.0:
        found += ": the scene is no brighter than the dark, as with a capped lens or at night"
    elif not passes:
        found += f", {100 * share:.3g} % of them too bright for their colour" * is_high
        # likely cause of the wrong level: the inputs to blame, and slips with about its factor
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
            (abs(math.log(slip / factor)), f"{slip:.4g} ({text})")
            for slip, text, of in _SLIPS
            if of == is_record
        ]
        nearest = min(likely)[0]
        slips = " or ".join(
            text for distance, text in likely if distance <= max(nearest, math.log(RULES.slip_range))
        )
        blamed = (
            f"the irradiance record, which has {product.share:.2g} of a clear sky's light"
            if is_record
            else "the gain of the calibration, the exposure time, the bit depth, the unit of radiance or the "
            "irradiance"
        )
        found += f", and the camera saturates at {full_scale:.2g}" * is_short + (
            f": likely {blamed}, by a factor of about {factor:.2g}; known slips of this size: {slips}"
        )
    expected = (
        f"{RULES.least_top:g} to {slope * RULES.most_coloured:.3g}, grey surfaces to "
        f"{slope * RULES.most_grey:.3g}; saturation from {RULES.least_full_scale:g} on"
    )
    kind = "reflectance-impossible" if is_refused else "reflectance-level"
    return [Finding(KINDS[kind], name, found, expected, passes)], top


def _jump(name: str, product: Product, reflectance: Floats) -> Iterator["Finding"]:
    # Find a band whose reflectance differs from that of its neighbours by about one factor in most pixels.
    nm, order = np.sort(product.wavelength), np.argsort(product.wavelength)
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = np.log(np.where(reflectance > 0.0, reflectance, np.nan))[:, order]
    jumps = logs[:, 1:-1] - 0.5 * (logs[:, :-2] + logs[:, 2:])
    (first, last), (low, high), centre = RULES.jump_nm, RULES.not_judged_nm, nm[1:-1]
    is_judged = (
        (centre > first)
        & (centre < last)
        & ~((centre > low) & (centre < high))
        & (np.isfinite(jumps).mean(axis=(0, 2)) > 0.5)
    )
    spacing = float(np.median(np.diff(nm)))
    if not is_judged.any() or spacing > RULES.widest_nm:
        return
    limit = RULES.jump * max(1.0, spacing / RULES.usual_nm) ** 2
    jump = np.where(is_judged, np.nanmedian(jumps, axis=(0, 2)), 0.0)
    band = int(np.argmax(np.abs(jump)))
    yield Finding(
        KINDS["band-jump"],
        name,
        f"reflectance at {centre[band]:.1f} nm is {math.exp(jump[band]):.3g} times that of the neighbouring "
        "bands in most pixels: a fault of the calibration's gain, or of the irradiance record's channels",
        f"bands that differ by less than {100.0 * limit:.0f} %",
        abs(jump[band]) < limit,
    )


def _gain(name: str, product: Product) -> Iterator["Finding"]:
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
    orders = {
        "its bands reversed": response[::-1],
        "its columns reversed": response[:, ::-1],
        **{f"its bands shifted by {k}": np.roll(response, k, axis=0) for k in (-3, -2, -1, 1, 2, 3)},
    }
    passes = slope > RULES.foreign_slope or slope + RULES.significance * u > RULES.foreign_slope + 0.3
    found, kind = f"{slope:.2f} +- {u:.2f} of the gain's pattern is in the scene", "gain-pattern"
    for order, values in {} if passes else orders.items():
        other, other_u = _regressed(scene, _pattern(values), weight)
        if other - RULES.significance * other_u > 0.5 and other > RULES.matching_slope:
            found += f", {other:.2f} with {order}"
            kind = "gain-order"
    yield Finding(KINDS[kind], name, found, f"1, at least {RULES.foreign_slope:g}", passes)


def _pattern(array: Floats) -> Floats:
    # Second differences over bands of first differences over columns: spectra and surfaces cancel
    return np.diff(np.diff(array, 2, axis=0), axis=1) if len(array) > 2 else array[:0, 1:]


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


def _smile(name: str, product: Product) -> Iterator["Finding"]:
    # Compare solar lines in the columns with those that the declared smile moves: 1 of it is in the scene.
    if product.shift is None or product.irradiance_at is None or np.ptp(product.shift) < RULES.smile_nm:
        return
    light = np.nanmean(product.light, axis=0)
    # with few bands, or where camera and record differ by a common shift, columns do not show the smile
    spectrum, sky = np.nanmean(light * product.gain, axis=1), product.irradiance_at(product.wavelength)
    if not _correlation(_curvature(spectrum), _curvature(sky)) > RULES.smile_lines:
        return
    with np.errstate(divide="ignore", invalid="ignore"):
        scene = np.diff(np.log(np.where(light > RULES.least_light, light * product.gain, np.nan)), 2, axis=0)
        sky = np.stack([product.irradiance_at(product.wavelength + shift) for shift in product.shift], axis=1)
        moved = np.diff(np.log(sky), 2, axis=0)
    # all columns share the curvature of the ground's spectra
    scene, moved = (array - np.nanmedian(array, axis=1, keepdims=True) for array in (scene, moved))
    # most bands are without solar lines, where the term is small and no outlier
    usable = np.isfinite(scene) & np.isfinite(moved)
    usable &= np.abs(scene) <= 8.0 * np.nanmedian(np.abs(np.where(usable, scene, np.nan))) + 0.05
    values, terms = scene[usable], moved[usable]
    size = float(terms @ terms)
    if values.size < RULES.pattern_elements or not 0.0 < size < math.inf:
        return
    slope = float(values @ terms) / size
    u = 3.0 * math.sqrt(float(np.mean((values - slope * terms) ** 2)) / size)
    yield Finding(
        KINDS["smile-sign"],
        name,
        f"{slope:.2f} +- {u:.2f} of the declared wavelength_shift (smile) is in the columns of the scene",
        f"1, not under {RULES.wrong_smile:g}",
        not (slope < RULES.wrong_smile and slope < -RULES.significance * u / 3.0),
    )


def _swath(name: str, product: Product) -> Iterator["Finding"]:
    # Find a step of radiance between neighbouring columns that is the same in all bands and all lines.
    light = product.light
    bands = np.nanmean(light, axis=(0, 2))
    is_lit = bands > max(RULES.least_light, 0.1 * float(np.nanmax(bands)))
    # colour tells surfaces apart by visible light only: in the near infrared a lawn beside asphalt has none
    has_colour = np.mean(product.wavelength[is_lit] < RULES.visible_nm) > RULES.visible_share
    if len(light) < RULES.step_blocks or is_lit.sum() < 8 or light.shape[2] < 8 or not has_colour:
        return
    radiance = (light * product.gain)[:, is_lit]
    parts = np.array_split(np.arange(radiance.shape[1]), 8)
    means = np.stack([np.nanmean(radiance[:, part], axis=1) for part in parts], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = np.log(np.maximum(means, RULES.no_light * np.nanmax(means, axis=2, keepdims=True)))
    steps = np.diff(logs, axis=2)  # (block, part, column)
    size = np.median(steps, axis=(0, 1))
    colour, blocks = np.median(steps, axis=0).std(axis=0), np.median(steps, axis=1)
    change = np.quantile(np.abs(blocks - np.median(blocks, axis=0)), RULES.step_part, axis=0)
    colour, change = colour / (0.3 + np.abs(size)), change / (0.5 + np.abs(size))
    limits = (
        (RULES.step, RULES.step_colour, RULES.step_change),
        (RULES.strong_step, RULES.strong_colour, RULES.strong_change),
        (RULES.deep_step, RULES.deep_colour, RULES.strong_change),
    )
    is_edge = np.any(
        [(np.abs(size) > least) & (colour < most) & (change < moved) for least, most, moved in limits], axis=0
    )
    # where edges of the ground coincide with the slit's in a part of the blocks, the others show it
    is_grey = steps.std(axis=1) < RULES.part_colour * (0.3 + np.abs(blocks))
    is_alike = np.abs(blocks[:, None] - blocks) < RULES.part_change * (0.5 + np.abs(blocks))
    alike = (is_alike & is_grey[:, None] & is_grey).sum(axis=0)
    common = np.take_along_axis(blocks, alike.argmax(axis=0)[None], axis=0)[0]
    least = np.maximum(RULES.part_blocks, RULES.part_share * is_grey.sum(axis=0))
    is_part = ~is_edge & (alike.max(axis=0) >= least) & (np.abs(common) > RULES.strong_step)
    size, is_edge = np.where(is_part, common, size), is_edge | is_part
    # the darker columns: down to the next step up, or up from the last step down
    column = int(np.argmax(np.where(is_edge, np.abs(size), -1.0)))
    ups, downs = (np.flatnonzero(is_edge & (np.sign(size) == sign)) for sign in (1, -1))
    if size[column] < 0:
        ends = ups[ups > column]
        columns = f"{column + 1} to {ends[0]}" if ends.size else f"from {column + 1} on"
    else:
        starts = downs[downs < column]
        columns = f"{starts[-1] + 1} to {column}" if starts.size else f"up to {column}"
    found = (
        f"columns {columns} have {math.exp(-abs(float(size[column]))):.2f} of the light beside them, "
        "alike in all bands and lines: a blocked or vignetted slit"
        if is_edge.any()
        else "no step between columns is alike in all bands and lines"
    )
    yield Finding(KINDS["swath-step"], name, found, "edges that change with line or band", not is_edge.any())


@dataclass(frozen=True)
class Kind:
    """A kind of finding.

    Attributes
    ----------
    name
        Name by which it is listed and accepted; its error code.
    meaning
        Fault of the inputs.
    mend
        Remedy.
    refused
        Whether processing stops, because results would be wrong; otherwise a warning is given.
    """

    name: str
    meaning: str
    mend: str
    refused: bool = True


_ROWS = (
    Kind(
        "counts-over-range",
        "Counts are above the highest count of the camera's converter.",
        "set bit_depth in [camera], or shift left-justified counts down",
    ),
    Kind(
        "stray-counts",
        "A few elements hold counts above the highest count of the camera's converter.",
        "nothing if a frame counter or status word is in the picture: its elements are flagged saturated",
        refused=False,
    ),
    Kind(
        "byte-order",
        "Spectra are noise as stored, and smooth with the two bytes of every count exchanged.",
        "mend `byte order` in the header of the cube",
    ),
    Kind(
        "interleave",
        "Neighbouring bands are similar in another interleave, but not in the declared one.",
        "mend `interleave` in the header of the cube",
    ),
    Kind(
        "band-order",
        "Absorption bands of daylight (such as oxygen at 760 nm) are not in the bands that wavelengths and "
        "gains predict, or neighbouring bands are uncorrelated.",
        "mend the order of the bands in cube and dark, or name the calibration of this camera and binning",
    ),
    Kind(
        "dark-of-zeros",
        "Elements of the dark are exactly zero in every frame.",
        'record the dark again; for dark-corrected counts write cubes = "none" in [dark]',
    ),
    Kind(
        "dark-missing",
        'The counts stand on a level that is not light, and [dark] declares cubes = "none".',
        'name the dark in [dark]; cubes = "none" is for counts whose dark is subtracted',
        refused=False,
    ),
    Kind(
        "dark-over-scene",
        "The dark is brighter than the scene.",
        "name the dark of this exposure and gain, recorded with the lens capped",
    ),
    Kind(
        "dark-lit",
        "The dark holds light: its spectrum follows the scene's.",
        "record the dark again with the lens capped",
    ),
    Kind(
        "dark-unsteady",
        "The frames of the dark differ: some are blank, or lit.",
        "leave these frames out of the dark cube",
    ),
    Kind(
        "dark-pattern",
        "The scene does not contain the fixed pattern of the dark, which belongs to another camera, binning "
        "or order of columns or bands.",
        "name the dark of this camera, in the same binning and orientation",
    ),
    Kind(
        "first-frame",
        "The number in the cube's name is not the number of its first frame.",
        "name the frame index of this cube; nothing for a renamed cube",
        refused=False,
    ),
    Kind(
        "foreign-frame-index",
        "The frame index belongs to another cube.",
        "name the frame index of this cube",
    ),
    Kind(
        "doubled-frames",
        "Lines repeat the line before them bit for bit, although noise makes frames differ.",
        "leave these lines out of regions; places and times after them may be late",
        refused=False,
    ),
    Kind(
        "lost-frames",
        "Frames are missing, although the frame index counts them or does not mention them.",
        "check the frame index against the cube; times and places may be wrong from there on",
        refused=False,
    ),
    Kind(
        "irradiance-constant",
        "All spectra of irradiance are bit-identical, or those during the line or a part of it are: the "
        "spectrometer had stopped.",
        "name the record of this flight, with spectra measured during the line",
    ),
    Kind(
        "irradiance-level",
        "Irradiance is far below or far above that of a clear sky at the place and time.",
        "check the units of the record (units in [irradiance]), its receptor, its time and the line's place",
    ),
    Kind(
        "irradiance-doubtful",
        "Irradiance does not fit a clear sky at the place and time, or the height of the sun.",
        "check the units of the record, its time and time zone, and the line's place",
        refused=False,
    ),
    Kind(
        "irradiance-spectrum",
        "The camera sees the absorption bands of daylight, and the record has none, or at other wavelengths.",
        "name a record of irradiance, in the order of its wavelengths; pass alignment= for a shift",
        refused=False,
    ),
    Kind(
        "irradiance-scans",
        "Scans of the irradiance record hold no daylight, or differ from the scans before and after.",
        "nothing: they are left out of the interpolation; leave them out of the record",
        refused=False,
    ),
    Kind(
        "irradiance-channels",
        "Channels of the irradiance record hold no daylight: zero, filled, clipped or stuck.",
        "nothing: bands of these channels are NaN; record with a shorter integration time if clipped",
        refused=False,
    ),
    Kind(
        "irradiance-step",
        "All channels of the irradiance record change by one factor between two scans, which no cloud does: "
        "the gain or integration time of the spectrometer changed.",
        "divide the scans before or after by the factor, or name only those of the right gain",
    ),
    Kind(
        "irradiance-receptor",
        "The files of the spectrometer name a fore optic or a quantity that does not yield irradiance.",
        "name the record of a cosine receptor, or write it as a csv series if the files are wrong",
    ),
    Kind(
        "frame-counter",
        "Elements at the edge of the picture count lines: the camera writes its frame counter into them. "
        "Processing keeps their values, which are not light.",
        "leave these columns out of regions, or replace the elements before processing",
        refused=False,
    ),
    Kind(
        "stuck-elements",
        "Elements of the detector hold one count in all lines, while the columns beside them change.",
        "set the gain of these elements to NaN in the calibration, or leave these columns out of regions",
        refused=False,
    ),
    Kind(
        "navigation-still",
        "The platform does not move along the line.",
        "name the navigation of this flight, or none",
        refused=False,
    ),
    Kind(
        "navigation-gaps",
        "Positions or angles are missing for many lines.",
        "name the navigation of this flight; check its clock",
        refused=False,
    ),
    Kind(
        "navigation-convention",
        "The picture of a line contradicts a declared sign, order or reference of the navigation.",
        "check this declaration in [navigation], and [geometry] ground",
        refused=False,
    ),
    Kind(
        "navigation-clock",
        "The picture of a line is early or late against the navigation, or against the irradiance record.",
        "set clock_offset_s of this record, or stamp",
        refused=False,
    ),
    Kind(
        "reflectance-impossible",
        "Reflectance of sampled lines is far beyond any surface's: the scale of an input is wrong.",
        "correct the unit or scale of the input that is named",
    ),
    Kind(
        "reflectance-level",
        "Reflectance of sampled lines does not suit its colour: an input may be wrong by a factor.",
        "check scale and unit of calibration, radiance, exposure time, bit depth and irradiance; nothing for "
        "glint or slopes to a low sun",
        refused=False,
    ),
    Kind(
        "counts-clipped",
        "Counts of many elements end at one value below the saturation count.",
        "set bit_depth or saturation_count in [camera]; clipped pixels are not flagged otherwise",
        refused=False,
    ),
    Kind(
        "counts-multiple",
        "All counts share a divisor: a converter of fewer bits was shifted up, or low bits were lost.",
        "shift counts and dark down and set bit_depth in [camera], or export all bits; nothing if the gain "
        "is shifted too",
        refused=False,
    ),
    Kind(
        "gain-order",
        "The pattern of the gain is in the scene in another order of bands or columns.",
        "name the calibration in the order of this camera's bands and columns",
    ),
    Kind(
        "gain-pattern",
        "The pattern of the gain over neighbouring elements is not in the scene.",
        "name the calibration of this camera, in the same binning and orientation",
        refused=False,
    ),
    Kind(
        "smile-sign",
        "Solar lines move over the columns against the declared smile.",
        "change the sign of wavelength_shift in the calibration",
        refused=False,
    ),
    Kind(
        "band-jump",
        "Reflectance of a band differs from that of its neighbours by about one factor in most pixels.",
        "check gain, bands and detector taps of the calibration, and channels of the irradiance record",
        refused=False,
    ),
    Kind(
        "swath-step",
        "Radiance steps at one column, alike in all bands and lines: part of the slit or lens is covered.",
        "leave out the darker columns, or calibrate the gain with this slit",
        refused=False,
    ),
    Kind(
        "dark-faintly-lit",
        "The dark holds some light: its spectrum follows the scene's.",
        "record the dark again with the lens capped and the shutter closed",
        refused=False,
    ),
    Kind(
        "panel-level",
        "A panel measures more than twice or less than half of its certificate.",
        "name the certificate of this panel, in fractions or per cent as its heading states",
    ),
    Kind(
        "panel-doubtful",
        "A panel does not measure its certificate, or is shaded, tilted or saturated.",
        "check the region, the certificate and the irradiance record",
        refused=False,
    ),
)
#: Every kind of finding, by its name.
KINDS = {kind.name: kind for kind in _ROWS}


@dataclass(frozen=True)
class Finding:
    """A fault found in the inputs of a flight line.

    Attributes
    ----------
    kind
        Its row in `KINDS`.
    line
        Name of the flight line or cube.
    found, expected
        Measured and accepted values, in words.
    passes
        Whether the measured value is accepted: then it is no fault.
    """

    kind: Kind
    line: str
    found: str
    expected: str
    passes: bool = False

    def __str__(self) -> str:
        return str(self.problem())

    def problem(self, *, acceptable: bool = False) -> Problem:
        # Return the finding as a `Problem`; ``acceptable`` adds the option that accepts it.
        name, mend = self.kind.name, self.kind.mend
        option = mend
        if acceptable:
            mend, option = f"{mend}, or pass accept=[{name!r}]", f"{mend}, or pass --accept {name}"
        return Problem(f"{self.line}: {self.found}", self.expected, mend, option, code=name)


def _found_if(is_fault: Any, kind: str, name: str, found: str, expected: str) -> Iterator[Finding]:
    # Yield the finding if the input has the fault.
    if is_fault:
        yield Finding(KINDS[kind], name, found, expected)


# -- Statistics of a sample of a cube: blocks of complete lines, spread over the cube.


#: Size of the sample of a cube.
SAMPLE_RULES = SimpleNamespace(
    # Number of blocks, and of lines in a block [1]: 128 lines give a mean to a tenth of the noise, and are
    # 45 MB of the 1.4 GB of a cube of 640 x 4000 x 272.
    blocks=8,
    lines=16,
    # Minimum number of steps between lines, maximum spread of a step relative to the median [1], and minimum
    # share of such steps in an element that counts lines [1]: steps of noise have a median near 0 and
    # spread far beyond it; 15 of 16 steps are alike where a counter begins anew every 16 lines.
    counter_lines=30,
    counter_spread=0.1,
    counter_share=0.8,
    # Range of the counts of both neighbouring columns from which an element that never changes is stuck
    # [steps of the converter].
    stuck_range=20.0,
)


@dataclass(frozen=True)
class CubeSample:
    # Statistics of a sample of a cube for every element (band, cross_track), in counts.
    lines: int  #: Lines of the sample
    mean: Floats
    maximum: Floats
    divisor: int  #: Greatest common divisor of all counts
    counters: Bools  #: Elements that count lines; only columns at the edges are examined
    blocks: Floats | None = None  #: Means of the blocks (block, band, cross_track)
    stuck: Bools | bool = False  #: Elements of one count in all lines, while the columns beside them change


def sample_cube(counts: xr.DataArray, recorded: Bools) -> CubeSample | None:
    # Return a sample of lazy counts (along_track, band, cross_track); None where no line is recorded.
    #
    # recorded: (along_track,), False where a frame was lost and the line is blank.
    total = int(counts.shape[0])
    size = min(max(2, lines_a_task(4 * int(np.prod(counts.shape[1:])), SAMPLE_RULES.lines)), total)
    starts = np.unique(
        np.linspace(0, total - size, min(SAMPLE_RULES.blocks, max(1, total // size))).astype(int)
    )
    shape = counts.shape[1:]
    found: list[tuple[Any, ...]] = []  # statistics of every block
    edges = sorted({0, 1, shape[1] - 2, shape[1] - 1} & {*range(shape[1])})
    for start in starts.tolist():
        block = counts[start : start + size].to_numpy()[recorded[start : start + size]]
        if len(block):
            ends, divisor = (block.max(axis=0), block.min(axis=0)), np.gcd.reduce(block, axis=None)
            step = np.diff(block[:, :, edges].astype(np.float64), axis=0)
            found.append((len(block), block.sum(axis=0, dtype=np.float64), *ends, divisor, step))
    if not found:
        return None
    counts_of, sums, maxima, minima, divisors, steps = zip(*found, strict=True)
    lines, divisor = sum(counts_of), int(np.gcd.reduce(divisors))
    maximum = np.max(maxima, axis=0).astype(np.float64)
    # a counter or a time stamp goes on by the same step from line to line, except where it begins anew
    step = np.concatenate(steps)
    counters, stuck, change = np.zeros(shape, bool), np.zeros(shape, bool), maximum - np.min(minima, axis=0)
    if len(step) >= SAMPLE_RULES.counter_lines:
        usual = np.median(step, axis=0)
        is_usual = np.abs(step - usual) <= SAMPLE_RULES.counter_spread * np.abs(usual)
        beside = np.minimum(change[:, :-2], change[:, 2:])
        stuck[:, 1:-1] = (change[:, 1:-1] == 0.0) & (beside >= SAMPLE_RULES.stuck_range * divisor)
        counters[:, edges] = (usual != 0) & (is_usual.mean(axis=0) >= SAMPLE_RULES.counter_share)
    means = np.stack([total / count for total, count in zip(sums, counts_of, strict=True)])
    return CubeSample(lines, sum(sums) / lines, maximum, divisor, counters, means, stuck)


# -- Check the order of the bands by the solar lines and absorption bands in the cube.


#: Thresholds beyond which bands are not in the order of their wavelengths.
BAND_RULES = SimpleNamespace(
    # Minimum number of bands, maximum spacing and width [nm]: absorption bands of oxygen and water are 5 to
    # 40 nm wide and have to be resolved.
    bands=24,
    spacing_nm=15.0,
    fwhm_nm=24.0,
    # Correlation of the cube's curvature over wavelength with the curvature of daylight over gain [1]: at
    # least `explained` in the best order, at most `unexplained` in the declared one. `explained` is set
    # between 0.85, the maximum by chance over 100 lamps of one to six peaks in the right order, and 0.94,
    # the minimum over the wrong orders of the fault campaign.
    explained=0.9,
    unexplained=0.35,
    # Minimum excess of the best correlation over the best one with inverted curvature [1]: among 22 000
    # orders, lamp lines match some by chance, and some inverted. Wrong orders of the fault campaign have an
    # excess of 0.15 and more.
    margin=0.1,
    # Minimum share of the lit bands [1] over which a correlation is taken, and at least `bands`.
    common=0.5,
    # Correlation of the curvatures of irradiance record and clear sky [1], above which the record is
    # daylight, and largest shift of its wavelengths that is tried [nm].
    daylight=0.7,
    record_nm=15.0,
    # Minimum shift that is tried [nm]; `hyperpaint.alignment` measures and corrects smaller ones.
    shift_nm=6.0,
    # Range of wavelengths that are tried: band spacing over the declared spacing [1], and shift of the mean
    # wavelength [nm].
    stretches=(0.5, 2.0),
    shifts_nm=120.0,
    # Squared ratio of the median difference of neighbouring lit bands to the median difference of all pairs
    # [1]: 1 for bands in random order. Medians, because a dead band or lamp lines dominate a mean. Set
    # between 0.1, the maximum over right collects of the fault campaign, and 0.38, the minimum over mixed
    # bands.
    rough=0.33,
    # Light above which a band is lit [count], and as a share of the brightest band [1]: darks drift by this
    # much.
    lit_counts=5.0,
    lit_share=0.05,
    # Median difference of all pairs over the median light [1], below which the spectrum is flat and not
    # judged: a saturated line minus its dark varies by some per cent.
    spread=0.2,
)


def judge_bands(
    name: str,
    light: Floats,
    gain: Floats,
    wavelength: Floats,
    fwhm: float,
    record: tuple[Floats, Floats] | None,
) -> Iterator[Finding]:
    # Judge the order of bands by their mean counts above the dark, ``light`` [count].
    #
    # light, gain, wavelength [nm]: (band,); fwhm: of the camera [nm]; record: wavelengths [nm] and
    # irradiance. Without a record (None) the source may be a lamp, and only the roughness is judged.
    spacing = float(np.median(np.abs(np.diff(wavelength)))) if wavelength.size > 1 else np.inf
    if (
        wavelength.size < BAND_RULES.bands
        or not 0.0 < spacing <= BAND_RULES.spacing_nm
        or fwhm > BAND_RULES.fwhm_nm
    ):
        return
    rising = np.argsort(wavelength)
    # gains of neighbouring bands differ in cameras with many filters: counts are rough, radiance is smooth
    roughness = min(_roughness(spectrum[rising], light[rising]) for spectrum in (light, light * gain))
    if roughness > BAND_RULES.rough:
        yield Finding(
            KINDS["band-order"],
            name,
            f"neighbouring bands differ by {roughness:.2g} of the difference of any two bands",
            f"under {BAND_RULES.rough:g}, as in smooth spectra",
        )
        return
    if record is None:
        return
    irradiance_at = _daylight(wavelength, fwhm, record)
    clear_curvature = _curvature(_daylight(wavelength, fwhm, None)(wavelength))
    radiance_curvature = _curvature(light * gain)
    record_share = float(_correlation(_curvature(irradiance_at(wavelength)), clear_curvature))
    if not record_share > BAND_RULES.daylight:
        # a lamp is smooth, in the record and in the scene
        scene_share = float(_correlation(radiance_curvature, clear_curvature))
        shifts = np.arange(-BAND_RULES.record_nm, BAND_RULES.record_nm + 1.0)[:, None]
        matches = _correlation(radiance_curvature, _curvature(irradiance_at(wavelength + shifts)))
        best = int(np.argmax(np.nan_to_num(matches, nan=-1.0)))
        is_shifted = matches[best] > BAND_RULES.explained
        shifted = f" and {matches[best]:.2f} with {-shifts[best, 0]:.0f} nm added to its wavelengths"
        yield from _found_if(
            scene_share > BAND_RULES.explained and (is_shifted or record_share < BAND_RULES.unexplained),
            "irradiance-spectrum",
            name,
            f"the correlation of the record with the bands of daylight is {record_share:.2f}"
            f"{shifted * bool(is_shifted)}; that of the scene is {scene_share:.2f}",
            f"at least {BAND_RULES.daylight:g}",
        )
        return
    expected_curvature = _curvature(irradiance_at(wavelength) / gain)
    curvature = _curvature(light)
    agreement = float(_correlation(curvature, expected_curvature))
    if not agreement < BAND_RULES.unexplained:
        return
    # correlations of reversed bands, rotated bands, and other wavelengths
    orders = {"reversed": float(_correlation(curvature[::-1], expected_curvature))}
    half = wavelength.size // 2
    orders |= {
        f"shifted by {-rotation} bands": float(
            _correlation(np.roll(curvature, -rotation), expected_curvature)
        )
        for rotation in (*range(1, half + 1), *range(half + 1 - wavelength.size, 0))
        if abs(rotation) * spacing >= BAND_RULES.shift_nm
    }
    orders |= _agreements(_curvature(light * gain), wavelength, irradiance_at)
    inverted = _agreements(-_curvature(light * gain), wavelength, irradiance_at)
    order, best_agreement = max(orders.items(), key=lambda item: -1.0 if np.isnan(item[1]) else item[1])
    chance = np.nanmax([-value for value in orders.values()] + list(inverted.values()))
    yield from _found_if(
        best_agreement > max(BAND_RULES.explained, chance + BAND_RULES.margin),
        "band-order",
        name,
        f"the correlation of the bands with daylight is {agreement:.2f}, and {best_agreement:.2f} where "
        f"their order is {order}",
        f"at least {BAND_RULES.unexplained:g} in the declared order",
    )


def _roughness(spectrum: Floats, light: Floats) -> float:
    # Squared median difference of neighbouring bands relative to all pairs of bands; 0 with too few lit bands
    is_lit = (light > max(BAND_RULES.lit_counts, BAND_RULES.lit_share * np.nanmax(light))) & np.isfinite(
        spectrum
    )
    if is_lit.sum() < BAND_RULES.bands:
        return 0.0
    pairs = np.abs(np.subtract.outer(spectrum[is_lit], spectrum[is_lit]))[np.triu_indices(is_lit.sum(), 1)]
    steps = np.abs(np.diff(np.where(is_lit, spectrum, np.nan)))
    pair_step = float(np.median(pairs))
    is_flat = pair_step < BAND_RULES.spread * float(np.median(spectrum[is_lit]))
    return 0.0 if is_flat else float(np.nanmedian(steps) / pair_step) ** 2


def _agreements(
    curvature: Floats, wavelength: Floats, irradiance_at: Callable[[Floats], Floats]
) -> dict[str, float]:
    # Best correlation of a curvature with daylight over all shifts, by the wavelengths of each stretch
    agreements = {}
    mean_nm = float(wavelength.mean())
    shifts = np.arange(-BAND_RULES.shifts_nm, BAND_RULES.shifts_nm, 3.0)[:, None]
    narrowest, widest = BAND_RULES.stretches
    for stretch in np.geomspace(narrowest, widest, 140):
        for signed in (stretch, -stretch):
            nm = mean_nm + shifts + signed * (wavelength - mean_nm)
            agreement = _correlation(curvature, _curvature(irradiance_at(nm)))
            best = int(np.argmax(np.nan_to_num(agreement, nan=-1.0)))
            agreements[f"{nm[best, 0]:.0f} to {nm[best, -1]:.0f} nm"] = float(agreement[best])
    return agreements


def _daylight(wavelength: Floats, fwhm: float, record: tuple[Floats, Floats] | None) -> Callable[..., Any]:
    # Return irradiance at wavelengths, of the record or a clear sky, at the resolution of the bands; NaN
    # outside its wavelengths
    margin = 2.0 * BAND_RULES.shifts_nm
    # at least one margin, also of wavelengths without sunlight
    first = max(wavelength.min() - margin, 300.0)
    nm = np.arange(first, max(min(wavelength.max() + margin, 2500.0), first + margin), 0.5)
    irradiance = np.asarray(
        sum(ClearSky(45.0).irradiance(nm)) if record is None else np.interp(nm, *record, np.nan, np.nan)
    )
    half_width = round(2.0 * max(fwhm, 1.0))  # in steps of 0.5 nm: one FWHM to either side
    weights = np.exp(-0.5 * (2.3548 * np.linspace(-1.0, 1.0, 2 * half_width + 1)) ** 2)
    values = np.convolve(irradiance, weights / weights.sum(), "same")
    return partial(np.interp, xp=nm, fp=values, left=np.nan, right=np.nan)


def _curvature(spectrum: Floats) -> Floats:
    # Second differences of the logarithm (..., band), NaN where there is almost no light
    min_light = 0.03 * np.nan_to_num(spectrum).max(axis=-1, keepdims=True)
    curvature = np.full(spectrum.shape, np.nan)
    curvature[..., 1:-1] = np.diff(np.log(np.where(spectrum > min_light, spectrum, np.nan)), 2)
    return curvature


def _correlation(first: Floats, second: Floats) -> Floats:
    # Correlation over the last axis, where both are finite; NaN where too few bands of the first are
    is_finite = np.isfinite(first) & np.isfinite(second)
    count = is_finite.sum(axis=-1)
    a, b = (np.where(is_finite, values, 0.0) for values in (first, second))
    a, b = (
        np.where(
            is_finite, values - values.sum(axis=-1, keepdims=True) / np.maximum(count, 1)[..., None], 0.0
        )
        for values in (a, b)
    )
    size = np.sqrt((a**2).sum(axis=-1) * (b**2).sum(axis=-1))
    first_count = np.isfinite(first).sum(axis=-1)
    enough = (count >= np.maximum(BAND_RULES.bands, BAND_RULES.common * first_count)) & (size > 0.0)
    return np.where(enough, (a * b).sum(axis=-1) / np.where(enough, size, 1.0), np.nan)


# -- Check that irradiance and navigation belong to the flight.


#: Thresholds beyond which records do not belong to the flight.
RECORD_RULES = SimpleNamespace(
    # Minimum number of equal spectra in a row that is reported [1].
    samples=3,
    # Length of the longest run of equal spectra over the median of the other runs [1], above which it is
    # reported: loggers write every reading several times.
    still_factor=3.0,
    # Share of the lines [1] within a run that does not cover them all, above which it is reported: loggers
    # stall for a second or two.
    still_line_share=0.1,
    # Share of the channels [1] that differ between unequal spectra, from which such a run is no rounding.
    exact_share=0.5,
    # Accepted irradiance over that of a clear sky [1]: a thunderstorm transmits 0.02, sides of clouds add
    # 0.5.
    least_share=0.015,
    most_share=3.6,
    # Minimum number of lines to judge; a platform does not move if more than this share of the lines [1]
    # repeats the position before, or if all positions lie within this extent [m].
    still_lines=24,
    still_share=0.25,
    still_m=0.03,
    # Range of an angle [degree] from which a camera turns in place, and need not move.
    turned=5.0,
    # Accepted share of lines without a position or angle [1].
    gap_share=0.2,
)


def judge_irradiance(name: str, line: xr.Dataset) -> Iterator[Finding]:
    # Judge the irradiance record of a line.
    if "irradiance" not in line:
        return
    receptor = str(line["irradiance"].attrs.get("receptor", ""))
    yield from _found_if(receptor, "irradiance-receptor", name, receptor, "a cosine receptor")
    spectra = line["irradiance"].transpose(IRRADIANCE_TIME, ...).values
    times = line[IRRADIANCE_TIME].values
    if not np.isfinite(spectra).any():
        yield Finding(
            KINDS["irradiance-level"],
            name,
            f"all {len(spectra)} spectra are zero or undefined",
            "daylight",
        )
        return
    yield from _judge_changes(name, spectra, times, line["time"].values)
    has_value = np.isfinite(spectra)
    known = has_value.mean(axis=0)
    is_hole = ~has_value[:, known > 0.5 * known.max()].all()
    for fault in str(line.attrs.get(FAULTS_ATTR, "")).splitlines():
        code, _, found = fault.partition(": ")
        # scans that were left out may be of another flight line
        if is_hole or code != "irradiance-scans":
            yield Finding(KINDS[code], RECORD, found, "daylight that changes as the sun and clouds change it")
    position = {key: line[key].values for key in ("latitude", "longitude") if key in line.coords}
    level = light_level(position, spectra, line["irradiance_wavelength"].values.astype(np.float64), times)
    share = level.median / level.clear
    is_refused = math.isfinite(share) and not RECORD_RULES.least_share <= share <= RECORD_RULES.most_share
    yield from _found_if(
        level.doubt,
        "irradiance-level" if is_refused else "irradiance-doubtful",
        name if is_refused else RECORD,  # of whose doubts processing warns when it reads the record
        level.doubt,
        f"{RECORD_RULES.least_share:g} to {RECORD_RULES.most_share:g} times a clear sky's"
        if is_refused
        else "daylight at this place and time",
    )


def _judge_changes(name: str, spectra: Array, times: Array, line_times: Array) -> Iterator[Finding]:
    is_repeat = (spectra[1:] == spectra[:-1]) | (np.isnan(spectra[1:]) & np.isnan(spectra[:-1]))
    is_repeat = is_repeat.all(axis=1) & np.isfinite(spectra[1:]).any(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_repeat, [False]]).astype(int)))
    starts, lengths = edges[::2], edges[1::2] - edges[::2] + 1
    if not lengths.size or lengths.max() < RECORD_RULES.samples:
        return
    run = int(np.argmax(lengths))
    start, end = starts[run], starts[run] + lengths[run] - 1
    median_length = float(np.median(np.delete(lengths, run))) if lengths.size > 1 else 1.0
    line_times = line_times[~np.isnat(line_times)]
    covered = np.mean((times[start] <= line_times) & (line_times <= times[end])) if line_times.size else 0.0
    # a run within the line, or over one end of it, is compared with the longest of the others; rounded values
    # of a steady light stay equal in most channels also where spectra differ
    usual_length, is_exact = median_length, True
    if covered < 1.0 and lengths[run] < len(spectra):
        usual_length = np.delete(lengths, run).max(initial=2)
        is_exact = (spectra[1:] != spectra[:-1])[~is_repeat].mean() > RECORD_RULES.exact_share
    is_still = covered > RECORD_RULES.still_line_share and is_exact
    is_still &= lengths[run] > RECORD_RULES.still_factor * usual_length
    seconds = (times[end] - times[start]) / np.timedelta64(1, "s")
    yield from _found_if(
        lengths[run] == len(spectra) or is_still,
        "irradiance-constant",
        name,
        f"{lengths[run]} of {len(spectra)} spectra in a row are bit-identical, for {seconds:.3g} s",
        "spectra that differ, at least by noise",
    )


def judge_navigation(name: str, line: xr.Dataset) -> Iterator[Finding]:
    # Judge positions and angles of the lines.
    if "latitude" not in line.coords:
        return
    timed = ~np.isnat(line["time"].values)
    if timed.sum() < RECORD_RULES.still_lines:
        return
    pose = {
        key: line[key].values[timed]
        for key in ("latitude", "longitude", "altitude", "roll", "pitch", "heading")
        if key in line.coords
    }
    # angles that were never measured are not gaps: functions that need them raise their own error
    gaps = {
        key: float(np.mean(~np.isfinite(values)))
        for key, values in pose.items()
        if key not in ANGLES or np.isfinite(values).any()
    }
    shares = ", ".join(
        f"{key} {100 * share:.3g} %" for key, share in gaps.items() if share > RECORD_RULES.gap_share
    )
    yield from _found_if(
        shares,
        "navigation-gaps",
        name,
        f"missing for the lines: {shares}",
        f"at most {100 * RECORD_RULES.gap_share:g} %",
    )
    located = np.isfinite(pose["latitude"]) & np.isfinite(pose["longitude"])
    if located.sum() < RECORD_RULES.still_lines:
        return
    north, east = np.radians(pose["latitude"][located]), np.radians(pose["longitude"][located])
    metres = 6.371e6 * np.stack([north, east * math.cos(float(north.mean()))])
    extent = float(np.hypot(*np.ptp(metres, axis=1)))
    angles = [pose[key][located] for key in ANGLES if key in pose]
    finite = [values[np.isfinite(values)] for values in angles]
    turn = max((float(np.ptp(np.unwrap(angle, period=360.0))) for angle in finite if angle.size), default=0.0)
    repeat_share = float(np.mean((np.diff(metres, axis=1) == 0.0).all(axis=0)))
    yield from _found_if(
        turn < RECORD_RULES.turned
        and (repeat_share > RECORD_RULES.still_share or extent < RECORD_RULES.still_m),
        "navigation-still",
        name,
        f"positions stay the same over {100 * repeat_share:.3g} % of the lines, and lie within "
        f"{extent:.3g} m",
        "a platform that moves between lines",
    )


# -- Check for a frame index of another cube, and for doubled or missing frames.


#: Thresholds of doubled and lost frames.
FRAME_RULES = SimpleNamespace(
    # Number of samples compared between neighbouring lines, and of lines read at once.
    samples=1024,
    block=1024,
    # Expected number of lines in a cube that equal the line before by chance [1], up to which equal lines
    # are reported.
    chance=1e-3,
    # Maximum share of equal samples in neighbouring lines that differ [1], up to which noise is visible and
    # equal lines are reported.
    noisy=0.9,
    # Lasting delay of the time stamps [frame periods] that is reported, and number of lines before and after
    # over which it must last: single stamps of a computer are late, and later ones are not.
    jump=0.7,
    window=8,
)


def judge_index(inputs: FlightlineInputs, lines: int) -> tuple[Bools, list[Finding]]:
    # Return which lines of a cube were recorded, (along_track,), and the findings about its frame index.
    timing, name = inputs.timing, str(inputs.name)
    if not isinstance(timing, Timing) or timing.frame_index is None:
        return np.ones(lines, bool), []
    index = read_frame_index(timing.frame_index)
    frame, row = match_frames(index, lines, inputs.path, shortened=inputs.keep_whole_lines)
    findings = []
    number, first_frame = cube_number(inputs.path), int(frame[0])
    if number is not None and number != first_frame:
        # cubes may lack their first frame or be renamed: the index is foreign only if a matching one exists
        matching = timing.frame_index.with_name(f"frameIndex_{number}.txt")
        foreign = matching != timing.frame_index and matching.is_file()
        findings.append(
            Finding(
                KINDS["foreign-frame-index" if foreign else "first-frame"],
                name,
                f"the first frame of {timing.frame_index.name} for {inputs.path.name} is {first_frame}",
                str(number),
            )
        )
    recorded = row >= 0
    if not index.fitted:
        findings += _jumps(name, frame[recorded], index.stamp[row[recorded]])
    return recorded, findings


def _jumps(name: str, frame: Ints, stamp: Ints) -> Iterator[Finding]:
    window = FRAME_RULES.window
    if frame.size < 4 * window:
        return
    steps = np.diff(stamp) / np.diff(frame)
    period = float(np.median(steps))
    delay = stamp - stamp[0] - period * (frame - frame[0])
    delays = np.median(np.lib.stride_tricks.sliding_window_view(delay, window), axis=1)
    # compare the median delay before and after every long step
    for step in (
        np.flatnonzero(steps[window - 1 : 1 - window] > (1.0 + FRAME_RULES.jump) * period) + window - 1
    ):
        if (delays[step + 1] - delays[step + 1 - window]) / period > FRAME_RULES.jump:
            yield Finding(
                KINDS["lost-frames"],
                name,
                f"stamps step by {steps[step] / period:.3g} periods from frame {frame[step]} to "
                f"{frame[step + 1]}, and stay late",
                "1, or frame numbers that skip the lost frames",
            )
            return


def judge_doubles(name: str, counts: xr.DataArray, by_pixel: bool, recorded: Bools) -> Iterator[Finding]:
    # Find lines of lazy counts (along_track, band, cross_track) that are equal to the line before.
    #
    # by_pixel: whether the file is interleaved by pixel (BIP); recorded: (along_track,).
    lines, bands, columns = counts.shape
    # compare the central pixels of all bands, or the central bands of all columns
    axis, width = (2, bands) if by_pixel else (1, columns)
    size = counts.shape[axis]
    count = min(size, 4 + FRAME_RULES.samples // width)
    centre = slice((size - count) // 2, (size + count) // 2)  # contiguous in the file: one read a line
    rows = counts.isel({counts.dims[axis]: centre})
    starts = range(0, rows.shape[0] - 1, FRAME_RULES.block)
    blocks = (rows[start : start + FRAME_RULES.block + 1].to_numpy() for start in starts)
    # Share of samples that are equal to the line before, (along_track - 1,)
    shares = [(block[1:] == block[:-1]).mean(axis=(1, 2)) for block in blocks]
    equal_shares = np.concatenate([*shares, np.zeros(0)])[recorded[1:] & recorded[:-1]]
    doubled = equal_shares == 1.0
    if not doubled.any():
        return
    max_share = float(equal_shares[~doubled].max()) if not doubled.all() else 0.0
    chance_count = doubled.size * max_share ** (count * width)
    first = int(np.flatnonzero(doubled)[0]) + 1
    yield from _found_if(
        max_share <= FRAME_RULES.noisy and chance_count <= FRAME_RULES.chance,
        "doubled-frames",
        name,
        f"{int(doubled.sum())} of {lines} lines are bit for bit the line before, the first is line {first}",
        f"noise: in all other lines at most {100 * max_share:.3g} % of the samples equal the line before",
    )


# -- Check interleave and byte order of a cube by the smoothness of its spectra.


#: Thresholds at which another layout explains a cube better.
LAYOUT_RULES = SimpleNamespace(
    # Number of random bands, and of pixels in a band, that are read.
    bands=24,
    pixels=64,
    remote_lines=4,  # number of lines with these pixels behind a URL, where every place is a request
    # Roughness (mean squared difference of neighbouring bands over twice the variance [1]) above which other
    # layouts are tried, and factor by which another layout must be smoother; observed are 30 for the right
    # interleave and 1000 for the right byte order.
    rough=0.1,
    smoother=10.0,
    # Maximum roughness of another layout [1]; noise has 1. A band of status words makes the declared layout
    # rougher than noise, and every other layout smoother than it.
    unlike=0.5,
    # Minimum share of the variance between bands in the better interleave [1], and its minimum ratio to this
    # share in the declared one: every band has its own mean level, which a wrong interleave mixes. Without
    # this check, neighbouring columns of a uniform field would pass for bands of a camera with few bands.
    separate=0.06,
    separation=0.5,
)


class _View(NamedTuple):
    # Counts read in one interleave, both (band, pixel)
    values: Floats
    neighbours: Floats  # Values of the next band

    @property
    def roughness(self) -> float:
        # squared difference of neighbouring bands, over twice the variance
        twice_variance = 2.0 * float(self.values.var())
        return (
            float(np.mean((self.values - self.neighbours) ** 2)) / twice_variance if twice_variance else 0.0
        )

    @property
    def separation(self) -> float:
        # share of the variance between bands, less its expectation by chance
        bands, pixels = self.values.shape
        within = float(self.values.var(axis=1).mean()) * pixels / (pixels - 1)
        between = max(float(self.values.mean(axis=1).var()) * bands / (bands - 1) - within / pixels, 0.0)
        return between / (between + within) if within else 0.0


def judge_layout(name: str, path: Path, lines: int) -> Iterator[Finding]:
    # Judge interleave and byte order of the file of a cube with this number of lines.
    header_path, data_path = find_pair(path)
    header = read_header(header_path)
    if header.bands < 4 or header.dtype.kind not in "iu" or lines * header.samples < LAYOUT_RULES.pixels:
        return
    with open_data(data_path) as (file, _, _):
        declared = _view(file, header, lines, header.interleave)
        if declared.roughness <= LAYOUT_RULES.rough:
            return
        others = (order for order in ("bil", "bip", "bsq") if order != header.interleave)
        views = {order: _view(file, header, lines, order) for order in others}
    max_roughness = min(declared.roughness / LAYOUT_RULES.smoother, LAYOUT_RULES.unlike)
    if header.dtype.itemsize == 2:
        swapped = _View(*(values.astype(header.dtype).byteswap().astype(np.float64) for values in declared))
        if swapped.roughness < max_roughness:
            byte_order = "0 (little)" if header.dtype.newbyteorder("<") != header.dtype else "1 (big)"
            yield Finding(
                KINDS["byte-order"],
                name,
                f"neighbouring bands differ by {declared.roughness:.2g} of the variance, by "
                f"{swapped.roughness:.2g} with bytes exchanged",
                f"byte order = {byte_order}",
            )
            return
    order, smoothest = min(views.items(), key=lambda item: item[1].roughness)
    min_separation = max(LAYOUT_RULES.separate, LAYOUT_RULES.separation * declared.separation)
    yield from _found_if(
        smoothest.roughness < max_roughness and smoothest.separation > min_separation,
        "interleave",
        name,
        f"neighbouring bands differ by {declared.roughness:.2g} of the variance as {header.interleave}, "
        f"by {smoothest.roughness:.2g} as {order}",
        f"interleave = {order}",
    )


def _view(file: io.RawIOBase, header: EnviHeader, lines: int, order: str) -> _View:
    # Read random pixels of some bands, and the same pixels of the next bands, in the given interleave
    rng = np.random.default_rng(0)
    count = min(LAYOUT_RULES.bands, header.bands - 1)
    bands = np.linspace(0, header.bands - 2, count).astype(np.int64)[:, None]
    shape = (count, LAYOUT_RULES.pixels)
    line, column = rng.integers(lines, size=shape), rng.integers(header.samples, size=shape)
    if isinstance(file, RemoteData):
        line = line[0, rng.integers(LAYOUT_RULES.remote_lines, size=shape)]

    def read_band(band: Ints) -> Floats:
        offsets = {
            "bil": (line * header.bands + band) * header.samples + column,
            "bip": (line * header.samples + column) * header.bands + band,
            "bsq": (band * lines + line) * header.samples + column,
        }[order]
        size = header.dtype.itemsize
        # single reads: a memory map would take address space of the size of the file
        starts = (header.header_offset + size * offsets.ravel()).tolist()
        samples = b"".join(pieces_of(file, starts, size))
        return np.frombuffer(samples, header.dtype).astype(np.float64).reshape(offsets.shape)

    return _View(read_band(bands), read_band(bands + 1))


# -- Check that a dark was recorded with the camera and settings of the scene.


#: Thresholds beyond which frames are not a dark for this scene.
DARK_RULES = SimpleNamespace(
    # Accepted share of elements with a dark of exactly zero and a lit scene [1]: set between dead elements
    # of a detector, under 1 %, and every second column or band, 50 %.
    zero_share=0.05,
    # Mean count above which an element of the scene is lit, and above which the non-zero elements of the
    # dark make zeros suspicious [count]: masked columns have a mean below it, and a black level of 0.2
    # counts is rounded to true zeros.
    zero_counts=1.0,
    # Accepted share of bands [1] whose mean dark over all columns exceeds the mean scene by these counts and
    # by this share of the dark: water beyond 900 nm is as dark as the dark, which drifts with temperature.
    # Set between a drift of 11 % over a pedestal of 100 counts (right) and half the scene's light (wrong).
    over_share=0.1,
    over_counts=5.0,
    over_level=0.2,
    # Slope [1] of the spectrum of the dark on that of the scene's light from which the dark is doubtful, and
    # refused; its significance [standard uncertainties] for either; maximum slope, and minimum number of
    # bands. A polynomial of `lit_degree` over bands is left out of both: the bias of a detector is smooth.
    # Right darks have 1.5 standard uncertainties at most, 2 % of the light 5 (48 columns).
    lit_slope=0.004,
    lit_refused=0.03,
    lit_sds=3.2,
    lit_refused_sds=8.0,
    lit_most=1.0,
    # Correlation of the dark's spectrum with daylight [1] that shows light where the slope exceeds
    # ``lit_most``: right darks have 0.48 at most, those with 0.6 to 1.3 of the light 0.92.
    lit_daylight=0.75,
    lit_bands=16,
    lit_degree=5,
    # Range of the scene's light over bands, over the range of the dark after this light is subtracted [1],
    # for a refusal: set between a gradient of the bias under a dim scene (right, 1) and darks with a tenth to
    # a third of the light (wrong, 17).
    lit_range=5.0,
    # Number of frames of a dark, and of bands, that are sampled; accepted change of the median of a frame,
    # in counts and as a share [1]: temperature changes it by some per cent. Accepted change from the first to
    # the last third of the frames as a share [1]: one frame does not move their medians.
    frames=512,
    frame_bands=8,
    frame_counts=5.0,
    frame_share=0.25,
    frame_drift=0.2,
    # Counts without a dark: correlation of their bands with daylight's from which they are judged [1],
    # accepted weakening of these bands [1], accepted darkest counts [count], and their minimum share of the
    # level that explains the weakening [1]: right collects with weaker bands have 0.45 at most, pedestals
    # 0.48 to 3.
    floor_bands=0.7,
    floor_share=0.15,
    floor_counts=10.0,
    floor_level=0.5,
    # Accepted regression slope of the scene's pattern on the dark's [1]: 1 for the matching dark, 0 for a
    # dark of another camera, 2 and 0.5 for a dark of half and twice the exposure; right collects of the
    # fault campaign have 0.88 to 1.36.
    pattern_slopes=(0.6, 1.6),
    # Minimum difference of this slope from 1 [standard uncertainties].
    pattern_sds=5.0,
    # Variance of the dark's pattern over the variance of its noise and rounding, from which it is judged
    # [1]: at 4, noise lowers the slope to 0.75, which is accepted.
    pattern_contrast=4.0,
    # Minimum range of the dark to be judged [count]: rounding alone makes steps of 1.
    pattern_range=2.0,
    # Minimum number of differences of elements to judge by.
    pattern_elements=200,
)


def judge_dark(
    name: str,
    dark: Floats,
    uncertainty: Floats | None,
    gain: Floats,
    sample: CubeSample,
    full: float,
    daylight: Floats | None = None,
) -> Iterator[Finding]:
    # Judge dark counts, all (band, cross_track), against a sample of the scene.
    #
    # daylight: (band,) counts of a grey scene under the sky, in any unit, None where unknown;
    # uncertainty: standard uncertainty of the mean dark [count], None where unknown; gain: of radiance, in
    # any unit; full: count from which an element is saturated.
    zero_share = float(np.mean((dark == 0.0) & (sample.mean > DARK_RULES.zero_counts)))
    nonzero = dark[dark > 0.0]
    if zero_share > DARK_RULES.zero_share and (nonzero.size == 0 or nonzero.mean() > DARK_RULES.zero_counts):
        yield Finding(
            KINDS["dark-of-zeros"],
            name,
            f"{100 * zero_share:.3g} % of the dark's elements are exactly 0 in every frame, under light",
            f"at most {100 * DARK_RULES.zero_share:g} %",
        )
        return
    dark_bands, light_bands = np.nanmean(dark, axis=1), np.nanmean(sample.mean - dark, axis=1)
    over_share = float(
        np.mean(light_bands < -np.maximum(DARK_RULES.over_counts, DARK_RULES.over_level * dark_bands))
    )
    if over_share > DARK_RULES.over_share:
        yield Finding(
            KINDS["dark-over-scene"],
            name,
            f"the dark lies above the mean of the scene in {100 * over_share:.3g} % of the bands, "
            f"{np.median(dark):.4g} against {np.median(sample.mean):.4g} counts",
            f"at most {100 * DARK_RULES.over_share:g} %",
        )
        return
    yield from _judge_light(name, dark, light_bands, daylight)
    if uncertainty is not None:
        yield from _judge_pattern(name, dark, uncertainty, gain, sample, full)


def judge_dark_frames(name: str, counts: xr.DataArray) -> Iterator[Finding]:
    # Find frames of a dark cube (along_track, band, cross_track), read lazily, that are blank or lit.
    bands = np.unique(np.linspace(0, counts.shape[1] - 1, DARK_RULES.frame_bands).astype(int))
    frames = np.unique(np.linspace(0, counts.shape[0] - 1, DARK_RULES.frames).astype(int))
    levels = np.median(counts.isel({counts.dims[0]: frames, counts.dims[1]: bands}).to_numpy(), axis=(1, 2))
    median = float(np.median(levels))
    tolerance = max(DARK_RULES.frame_counts, DARK_RULES.frame_share * median)
    drift = max(DARK_RULES.frame_counts, DARK_RULES.frame_drift * median)
    third = levels.size // 3
    is_drifting = third > 2 and abs(np.median(levels[:third]) - np.median(levels[-third:])) > drift
    yield from _found_if(
        float(np.abs(levels - median).max()) > tolerance or is_drifting,
        "dark-unsteady",
        name,
        f"medians of {levels.size} frames range from {levels.min():g} to {levels.max():g} counts",
        f"{median:g} +- {tolerance:.3g}, at most {drift:.3g} from the first to the last third",
    )


def _judge_light(name: str, dark: Floats, light: Floats, daylight: Floats | None) -> Iterator[Finding]:
    # Find light of the scene (band,), or daylight (band,), in a dark (band, cross_track)
    finite = np.isfinite(dark).any(axis=1) & np.isfinite(light)
    if finite.sum() < DARK_RULES.lit_bands or not np.ptp(light[finite]) > 0.0:
        return
    smooth = np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, light.size), DARK_RULES.lit_degree)
    basis = np.linalg.qr(smooth[finite])[0]
    # hot elements are pulled to the spread of their band
    middle = np.nanmedian(dark[finite], axis=1, keepdims=True)
    spread = 6.0 * np.nanmedian(np.abs(dark[finite] - middle), axis=1, keepdims=True)
    columns = np.clip(dark[finite], middle - spread, middle + spread)

    def rough(spectrum: Floats) -> Floats:
        return np.asarray(spectrum - basis @ (basis.T @ spectrum))

    scene = rough(light[finite])
    whole, *halves = (
        rough(np.nanmean(columns[:, part], axis=1))
        for part in (slice(None), slice(0, None, 2), slice(int(dark.shape[1] > 1), None, 2))
    )
    size = float(scene @ scene)
    slope, first, second = (float(part @ scene) / size for part in (whole, *halves))
    freedom = scene.size - DARK_RULES.lit_degree - 2
    u = math.sqrt(float(np.sum((whole - slope * scene) ** 2)) / freedom / size)
    # most of the light is in the dark: little is left in the scene, and daylight shows in the dark itself
    sky = np.zeros(scene.shape) if daylight is None else rough(daylight[finite])
    if np.isfinite(sky).all() and sky.size >= BAND_RULES.bands and not 0.0 < slope <= DARK_RULES.lit_most:
        share = float(whole @ sky) / math.sqrt(float((whole @ whole) * (sky @ sky)) or 1.0)
        yield from _found_if(
            share > DARK_RULES.lit_daylight,
            "dark-lit",
            name,
            f"the dark's spectrum has a correlation of {share:.2f} with daylight, and little light above",
            f"under {DARK_RULES.lit_daylight:g}",
        )
    rest = np.nanmean(columns, axis=1) - slope * light[finite]
    is_significant = (
        DARK_RULES.lit_slope < slope <= DARK_RULES.lit_most and not slope < DARK_RULES.lit_sds * u
    )
    is_in_all_columns = not min(first, second) < 0.4 * slope  # as light of the scene is
    has_range = float(np.ptp(light[finite])) > DARK_RULES.lit_range * float(np.ptp(rest))
    is_clear = has_range and slope > max(DARK_RULES.lit_refused, DARK_RULES.lit_refused_sds * u)
    yield from _found_if(
        is_significant and is_in_all_columns,
        "dark-lit" if is_clear else "dark-faintly-lit",
        name,
        f"the spectrum of the dark follows the scene, with {100 * slope:.2g} +- {100 * u:.1g} % of its light",
        f"no light, under {100 * DARK_RULES.lit_slope:g} %",
    )


def _judge_floor(name: str, blocks: Floats, daylight: Floats) -> Iterator[Finding]:
    # Find a constant level in counts (block, band, column) that need no dark: it weakens bands of daylight
    seen, expected = _curvature(np.nanmean(blocks, axis=(0, 2))), _curvature(daylight)
    usable = np.isfinite(seen) & np.isfinite(expected)
    if not _correlation(seen, expected) > DARK_RULES.floor_bands:
        return
    weakened = 1.0 - float(seen[usable] @ expected[usable]) / float(expected[usable] @ expected[usable])
    level = weakened * float(np.nanmedian(blocks))
    lowest = float(np.nanmin(np.nanquantile(blocks, 0.05, axis=(0, 2))))
    yield from _found_if(
        weakened > DARK_RULES.floor_share
        and lowest > max(DARK_RULES.floor_counts, DARK_RULES.floor_level * level),
        "dark-missing",
        name,
        f"bands of daylight are weaker by {100 * weakened:.0f} %, as by a level of {level:.0f} counts, "
        f"and the darkest counts are {lowest:.0f}",
        f"under {100 * DARK_RULES.floor_share:.0f} %, or dark counts under {DARK_RULES.floor_counts:g}",
    )


def _judge_pattern(
    name: str, dark: Floats, uncertainty: Floats, gain: Floats, sample: CubeSample, saturation_limit: float
) -> Iterator[Finding]:
    # Find a dark whose fixed pattern is missing in the scene. Mean scene = dark + light / gain. Differences
    # of neighbouring elements leave the patterns of dark and gain; a regression of the scene's differences on
    # both gives the share of the dark's pattern in the scene.
    if (
        dark.shape[0] < 3
        or dark.shape[1] < 2
        or not np.nanmax(dark) - np.nanmin(dark) > DARK_RULES.pattern_range
    ):
        return
    level = np.nanmedian(np.where(np.isfinite(gain), (sample.mean - dark) * gain, np.nan), axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        signal = level[:, None] / gain
    scene, dark_pattern, gain_pattern = (_pattern(array) for array in (sample.mean, dark, signal))
    # residuals of the regression grow with light and noise
    scale = np.hypot(np.maximum(np.abs(signal), 0.0), 0.05 * np.nanmax(np.abs(signal)) + 1.0)[1:-1, 1:]
    # use only differences of unsaturated elements
    unsaturated = sample.maximum < saturation_limit
    rows = unsaturated[:-2] & unsaturated[1:-1] & unsaturated[2:]
    usable: Bools = np.isfinite(scene) & np.isfinite(dark_pattern) & np.isfinite(gain_pattern)
    usable &= rows[:, 1:] & rows[:, :-1]
    if usable.sum() < DARK_RULES.pattern_elements:
        return
    # noise variance of a difference: 12 is the sum of its squared weights; rounding adds a variance of 1/12,
    # which does not average out over frames where the noise is below one count
    noise = 12.0 * (float(np.mean(np.square(uncertainty))) + 1.0 / 12.0)
    # exclude hot elements, whose dark changes differently
    usable &= np.abs(dark_pattern) <= 8.0 * np.median(np.abs(dark_pattern[usable])) + 1e-9
    if np.var(dark_pattern[usable]) < DARK_RULES.pattern_contrast * noise or not np.any(dark_pattern[usable]):
        return
    weights = 1.0 / scale[usable]
    terms = np.stack([dark_pattern[usable], gain_pattern[usable]]) * weights
    values = scene[usable] * weights
    for _ in range(2):  # the second fit excludes outliers
        slopes = np.linalg.lstsq(terms @ terms.T, terms @ values, rcond=None)[0]
        residual = values - slopes @ terms
        is_inlier = np.abs(residual) <= 4.0 * (1.4826 * np.median(np.abs(residual)) + 1e-12)
        terms, values, residual = terms[:, is_inlier], values[is_inlier], residual[is_inlier]
    # neighbouring differences share elements: three times the uncertainty of independent differences
    slope_u = 3.0 * np.sqrt(np.mean(np.square(residual)) / max(float(np.square(terms[0]).sum()), 1e-30))
    min_slope, max_slope = DARK_RULES.pattern_slopes
    yield from _found_if(
        not min_slope <= slopes[0] <= max_slope and abs(1.0 - slopes[0]) > DARK_RULES.pattern_sds * slope_u,
        "dark-pattern",
        name,
        f"{slopes[0]:.2f} +- {slope_u:.2f} of the dark's pattern is in the scene",
        f"1, {min_slope:g} to {max_slope:g}",
    )


# -- Check for counts above the range of the camera's converter.

#: Maximum share of elements [1] that a frame counter or status word fills: one column of 640 is below it.
STRAY_SHARE = 2e-3
#: Minimum number of elements whose maximum is the highest count, and minimum ratio of it to the number of
#: elements with a maximum in the next steps: right collects have 3 elements at most, clipped ones hundreds.
TOP_ELEMENTS, TOP_EXCESS, TOP_STEPS = 24, 5, 4


def judge_range(name: str, sample: CubeSample, bit_depth: int, saturation_count: float) -> Iterator[Finding]:
    # Find counts above the converter's maximum, or above a larger ``saturation_count``.
    limit = max(2**bit_depth - 1, int(saturation_count))
    max_count = int(sample.maximum.max())
    share = float(np.mean(sample.maximum > limit))
    shifted = sample.divisor > 1 and sample.divisor.bit_count() == 1  # a power of 2
    multiple = f", all multiples of {sample.divisor}: left-justified" if shifted else ""
    yield from _found_if(
        max_count > limit,
        "stray-counts" if share < STRAY_SHARE else "counts-over-range",
        name,
        f"counts up to {max_count}{multiple}, above {limit} in {100 * share:.3g} % of the elements",
        f"at most {limit}, of {bit_depth} bits",
    )


def judge_top(name: str, sample: CubeSample, saturation_limit: float) -> Iterator[Finding]:
    # Find maxima of elements that pile up at one value below saturation; brightness thins out towards its top
    top = float(sample.maximum.max())
    below = (sample.maximum < top) & (sample.maximum >= top - TOP_STEPS * max(sample.divisor, 1))
    is_top = sample.maximum == top
    least = max(TOP_ELEMENTS, TOP_EXCESS * int(below.sum()))
    yield from _found_if(
        0.0 < top < saturation_limit and is_top.sum() >= least and is_top.any(axis=1).sum() > 2,
        "counts-clipped",
        name,
        f"the counts of {is_top.sum()} elements end at {top:g}, of {below.sum()} just below",
        f"an end at the saturation count, {saturation_limit + SATURATION_MARGIN_COUNTS:g}",
    )


def judge_line(
    line: xr.Dataset, cubes: tuple[FlightlineInputs, ...], *, lit: bool = True
) -> Iterator[Finding]:
    # Judge a flight line by its records and samples of its cubes.
    #
    # ``lit``: whether reflectance is computed, which needs the irradiance record.
    name = str(line.attrs["name"])
    if lit:
        yield from judge_irradiance(name, line)
    yield from judge_navigation(name, line)
    for inputs in cubes:
        yield from _judge_cube(line, inputs)
    if lit and {"radiance", "irradiance", "wavelength"} <= set(line.variables):
        # the level of a vendor's radiance, as of calibrated counts
        radiance = line["radiance"].transpose(ALONG_TRACK, BAND, CROSS_TRACK)
        lines, shape = SAMPLE_RULES.lines, radiance.shape[1:]
        starts = np.linspace(0, max(len(radiance) - lines, 0), SAMPLE_RULES.blocks).astype(int)
        with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # lost lines and bad bands
            means = [
                np.nanmean(radiance[start : start + lines].to_numpy(), axis=0) for start in starts.tolist()
            ]
            blocks = np.stack(means).astype(np.float64)
            sample = CubeSample(lines, blocks[0], blocks.max(axis=0), 1, np.zeros(shape, bool), blocks)
            product = _product(line, sample, np.zeros(shape), np.ones(shape), 5.0, math.inf)
            findings = [] if product.reflectance is None else _level(name, product, product.reflectance)[0]
        yield from findings


def judge_dark_cube(path: Path) -> Iterator[Finding]:
    # Judge the frames of a dark cube.
    # already given when the dark was opened
    with warnings.catch_warnings(action="ignore", category=PaintWarning):
        counts = open_envi(path, unsaid="counts")["counts"]
    yield from judge_dark_frames(f"{path.parent.name}/{path.name}", counts)


def _judge_cube(line: xr.Dataset, inputs: FlightlineInputs) -> Iterator[Finding]:
    name = str(inputs.name)
    # already given when the line was opened
    with warnings.catch_warnings(action="ignore", category=PaintWarning):
        dataset = open_envi(
            inputs.path, keep_whole_lines=inputs.keep_whole_lines, quantity=inputs.quantity, unsaid="counts"
        )
        interleave = read_header(find_pair(inputs.path)[0]).interleave
    cube = next(iter(dataset.data_vars.values()))
    recorded, findings = judge_index(inputs, cube.shape[0])
    yield from findings
    yield from judge_doubles(name, cube, interleave == "bip", recorded)
    if "counts" not in line or "counts" not in dataset:
        return
    layout = list(judge_layout(name, inputs.path, cube.shape[0]))
    yield from layout
    sample = sample_cube(cube, recorded)
    # a cube with a wrong layout cannot be checked further
    if sample is not None and not layout:
        # bands without a gain have no mean
        with warnings.catch_warnings(action="ignore", category=RuntimeWarning):
            findings = list(_judge_sample(name, line, inputs, sample))
        yield from findings


def _judge_sample(
    name: str, line: xr.Dataset, inputs: FlightlineInputs, sample: CubeSample
) -> Iterator[Finding]:
    saturation = float(np.max(line["saturation_count"].values))
    saturation_limit = saturation - SATURATION_MARGIN_COUNTS
    yield from judge_range(name, sample, inputs.bit_depth, saturation)
    yield from judge_top(name, sample, saturation_limit)
    # a ramp in all columns at the edges is a test picture
    whole_columns = (sample.counters.mean(axis=0) > 0.5).sum()
    if sample.counters.any() and whole_columns < min(4, sample.counters.shape[1]):
        band, column = np.argwhere(sample.counters)[0].tolist()
        yield Finding(
            KINDS["frame-counter"],
            name,
            f"{int(sample.counters.sum())} elements rise by the same step from line to line, such as band "
            f"{band} of column {column}",
            "light in every element",
        )
    gain = (
        line["reflectance_gain" if has_white(line) else "radiance_gain"]
        .transpose(BAND, CROSS_TRACK)
        .values.astype(np.float64)
    )
    # elements at saturation are flagged, and those without a gain are no elements
    stuck = np.argwhere(sample.stuck & np.isfinite(gain) & (sample.maximum < saturation_limit)).tolist()
    if stuck:
        band, column = stuck[0]
        yield Finding(
            KINDS["stuck-elements"],
            name,
            f"{len(stuck)} elements never change, such as band {band} of column {column} with "
            f"{sample.maximum[band, column]:g} counts, while the columns beside them do",
            "light in every element",
        )
    dark, is_measured = mean_dark(line)
    daylight, record, fwhm = None, None, 5.0
    if "wavelength" in line.coords:
        wavelength = line["wavelength"].values.astype(np.float64)
        fwhm = float(np.median(line["fwhm"].values)) if "fwhm" in line.coords else fwhm
        if "irradiance" in line:
            record = line["irradiance_wavelength"].values, line["irradiance"].mean("irradiance_time").values
        if not has_white(line):
            sky = _daylight(wavelength, fwhm, record)(wavelength)
            daylight = sky / np.nanmean(gain, axis=1)
    if line.attrs.get("dark_source") != DARK_NONE:
        uncertainty = line.get("dark_counts_u_random") if is_measured else None
        dark_u = None if uncertainty is None else uncertainty.transpose(BAND, CROSS_TRACK).values
        yield from judge_dark(name, dark, dark_u, gain, sample, saturation_limit, daylight)
    elif daylight is not None and sample.blocks is not None:
        yield from _judge_floor(name, np.where(np.isfinite(gain), sample.blocks, np.nan), daylight)
    if "wavelength" in line.coords:
        light = np.nanmean(np.where(np.isfinite(gain), sample.mean - dark, np.nan), axis=1)
        # a coarse record has no narrow bands of daylight
        widths = [fwhm, *line["irradiance_fwhm"].values.ravel()] if "irradiance_fwhm" in line else [fwhm]
        yield from judge_bands(name, light, np.nanmean(gain, axis=1), wavelength, float(max(widths)), record)
        with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # elements without a value
            product = _product(line, sample, dark, gain, fwhm, saturation_limit)
            findings = list(judge_product(name, product))
        yield from findings


def _product(
    line: xr.Dataset, sample: CubeSample, dark: Floats, gain: Floats, fwhm: float, saturation_limit: float
) -> Product:
    # Calibrate the blocks of a sample as the line would be.
    assert sample.blocks is not None
    is_unsaturated = sample.maximum < saturation_limit
    light = np.where(is_unsaturated & np.isfinite(gain), sample.blocks - dark, np.nan)
    wavelength = line["wavelength"].values.astype(np.float64)
    shift, reflectance, full_scale, daylight = None, None, None, None
    share, zenith = math.nan, math.nan
    if "wavelength_shift" in line.coords:
        shift = line["wavelength_shift"].transpose(..., CROSS_TRACK).values
        shift = shift.mean(axis=0) if shift.ndim == 2 else shift
    if "irradiance" in line and not has_white(line):
        # spectra around the line
        times, channels = (
            line[IRRADIANCE_TIME].values,
            line["irradiance_wavelength"].values.astype(np.float64),
        )
        spectra = line["irradiance"].transpose(IRRADIANCE_TIME, ...).values
        stamps = line["time"].values
        stamps = stamps[~np.isnat(stamps)]
        if stamps.size:
            first, last = np.searchsorted(times, [stamps.min(), stamps.max()])
            spectra, times = (values[max(first - 1, 0) : last + 1] for values in (spectra, times))
        position = {key: line[key].values for key in ("latitude", "longitude") if key in line.coords}
        level = light_level(position, spectra, channels, times)
        share, zenith = level.median / level.clear, level.zenith
        daylight = _daylight(wavelength, fwhm, (channels, np.nanmean(spectra, axis=0)))
        if line.attrs.get("absolute_scale") != "unknown":
            exposure = float(np.nanmean(line["exposure_time"].values)) if "counts" in line else 1.0
            light_of_bands = np.where(daylight(wavelength) > 0.0, daylight(wavelength), np.nan)
            per_count = np.pi * gain / (exposure * light_of_bands[:, None])
            reflectance = per_count * light
            full_scale = np.nanmedian(per_count * (saturation_limit - dark), axis=1)
    return Product(
        light,
        gain,
        wavelength,
        sample.lines,
        sample.divisor,
        saturation_limit,
        reflectance,
        full_scale,
        share,
        zenith,
        shift,
        daylight,
    )


def mean_dark(line: xr.Dataset) -> tuple[Floats, bool]:
    # Mean dark (band, cross_track) of a line, and whether it was measured at the line's exposure. A dark that
    # is interpolated from other exposures has no measured noise.
    variables = {"dark_counts": line["dark_counts"].transpose(..., BAND, CROSS_TRACK).values}
    exposure = np.atleast_1d(line["exposure_time"].values).astype(np.float64)
    if "dark_exposure_time" in line:
        variables["dark_exposure_time"] = line["dark_exposure_time"].values
    dark_exposure = np.atleast_1d(variables.get("dark_exposure_time", exposure.mean())).astype(np.float64)
    dark = darks_of_lines(variables, exposure)[0].mean(axis=0, dtype=np.float64)
    return dark, bool((np.abs(dark_exposure / exposure.mean() - 1.0) <= SAME_EXPOSURE_SHARE).all())
