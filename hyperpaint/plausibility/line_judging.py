"""Run all checks of one flight line."""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Array, Bools, Floats, Ints
from hyperpaint.base.constants import SATURATION_MARGIN_COUNTS, lines_a_task
from hyperpaint.base.errors import PaintWarning
from hyperpaint.base.variables import BAND, CROSS_TRACK, IRRADIANCE_TIME
from hyperpaint.io.envi.envi_cubes import find_pair, open_envi
from hyperpaint.io.envi.envi_header import EnviHeader, read_header
from hyperpaint.io.flightline.dark import DARK_NONE
from hyperpaint.io.flightline.flightline_opening import FlightlineInputs
from hyperpaint.io.flightline.headwall import cube_number, match_frames, read_frame_index
from hyperpaint.io.flightline.timing import Timing
from hyperpaint.light.clear_sky import ClearSky
from hyperpaint.radiometry.planning import SAME_EXPOSURE_SHARE, darks_of_lines
from hyperpaint.radiometry.plausible_light import light_level

from .finding import KINDS, Finding

# -- A sample of a cube: blocks of whole lines, spread over it, and sums of them.


@dataclass(frozen=True)
class SampleRules:
    """Size of the sample of a cube.

    blocks, lines
        Blocks, and lines in each: 128 lines give a mean to a tenth of the noise, and a cube of 640 x 4000 x
        272 is read in a tenth of a second [1].
    """

    blocks: int = 8
    lines: int = 16


SAMPLE_RULES = SampleRules()


@dataclass(frozen=True)
class CubeSample:
    """Statistics of a sample of a cube for every element (band, cross_track), in counts."""

    lines: int  #: Lines of the sample
    mean: Floats
    highest: Floats
    divisor: int  #: Greatest common divisor of all counts


def sample_cube(counts: xr.DataArray, recorded: Bools) -> CubeSample | None:
    """Return a sample of lazy counts (along_track, band, cross_track); None where no line is recorded.

    recorded: (along_track,), False where a frame was lost and the line is blank.
    """
    total = int(counts.shape[0])
    size = min(max(2, lines_a_task(4 * int(np.prod(counts.shape[1:])), SAMPLE_RULES.lines)), total)
    starts = np.unique(
        np.linspace(0, total - size, min(SAMPLE_RULES.blocks, max(1, total // size))).astype(int)
    )
    shape = counts.shape[1:]
    sums = np.zeros(shape)
    highest = np.full(shape, -np.inf)
    lines, divisor = 0, 0
    for start in starts.tolist():
        block = counts[start : start + size].to_numpy()[recorded[start : start + size]]
        if not len(block):
            continue
        lines += len(block)
        sums += block.sum(axis=0, dtype=np.float64)
        highest = np.maximum(highest, block.max(axis=0))
        divisor = int(np.gcd.reduce(block, axis=None, initial=divisor))
    return None if not lines else CubeSample(lines, sums / lines, highest, divisor)


# -- Check the order of the bands by the solar lines and absorption bands of daylight in the cube.


@dataclass(frozen=True)
class BandRules:
    """Thresholds beyond which bands are in another order than their wavelengths.

    bands, spacing_nm, fwhm_nm
        Fewest bands, widest spacing and width [nm]: the bands of oxygen and water are 5 to 40 nm wide, and
        have to be resolved.
    explained, unexplained
        Correlation of the cube's curvature over wavelength with the curvature of daylight and gain, in the
        best order, and in the declared order [1]. The first is set between 0.85, the highest of 100 lamps of
        one to six peaks by chance (right), and 0.94, the least of the campaign's orders (wrong).
    margin
        Least difference of the best order to the best one with inverted curvature [1]: among 22 000 orders a
        lamp's lines match some by chance, inverted as well. Orders of the campaign (wrong) exceed it by 0.15
        and more.
    common
        Part of the lit bands [1] that an order has to explain, and at least `bands`.
    daylight
        Correlation of the record's curvature with a clear sky's [1] from which it is daylight.
    shift_nm
        Smallest shift [nm]: a smaller one is measured and corrected by `hyperpaint.alignment`.
    stretches, shifts_nm
        Other wavelengths that are tried: intervals of bands over the declared ones [1], and shifts of the
        middle band [nm].
    rough
        Median squared difference of neighbouring bands over the median of all pairs [1], of lit bands: 1 for
        bands in any order. A median, since one dead band or the lines of a lamp dominate a mean. Set
        between 0.1, the highest of right collects of the campaign, and 0.38, the least of mixed bands.
    lit_counts, lit_share
        Light from which a band is lit [count], and part of the brightest band [1]: darks drift by so much.
    spread
        Median difference of all pairs over the median light [1], below which the spectrum is even: a
        saturated line leaves the pattern of the dark, some per cent of it.
    """

    bands: int = 24
    fwhm_nm: float = 24.0
    spacing_nm: float = 15.0
    explained: float = 0.9
    margin: float = 0.1
    common: float = 0.5
    daylight: float = 0.7
    unexplained: float = 0.35
    shift_nm: float = 6.0
    stretches: tuple[float, float] = (0.5, 2.0)
    shifts_nm: float = 120.0
    rough: float = 0.33
    lit_counts: float = 5.0
    lit_share: float = 0.05
    spread: float = 0.2


BAND_RULES = BandRules()


def judge_bands(
    name: str,
    light: Floats,
    gain: Floats,
    wavelength: Floats,
    fwhm: float,
    record: tuple[Floats, Floats] | None,
) -> Iterator[Finding]:
    """Judge the mean light above the dark [count] of every band, (band,) as gain and wavelength [nm].

    fwhm: of the camera [nm]; record: wavelengths [nm] and irradiance, None without one: the light may then be
    a lamp, and its lines are not judged.
    """
    spacing = float(np.median(np.abs(np.diff(wavelength)))) if wavelength.size > 1 else np.inf
    if (
        wavelength.size < BAND_RULES.bands
        or not 0.0 < spacing <= BAND_RULES.spacing_nm
        or fwhm > BAND_RULES.fwhm_nm
    ):
        return
    rising = np.argsort(wavelength)
    # a camera of many filters has unlike gains in neighbouring bands, and a smooth radiance
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
    daylight = _Daylight(wavelength, fwhm, record)
    clear = _curvature(_Daylight(wavelength, fwhm, None).at(wavelength))
    if not _correlation(_curvature(daylight.at(wavelength)), clear) > BAND_RULES.daylight:
        return
    expected = _curvature(daylight.at(wavelength) / gain)
    measured = _curvature(light)
    declared = float(_correlation(measured, expected))
    if not declared < BAND_RULES.unexplained:
        return
    # reversed, rotated, and at other wavelengths
    orders = {"reversed": float(_correlation(measured[::-1], expected))}
    for shift in range(1, wavelength.size):
        if min(shift, wavelength.size - shift) * spacing >= BAND_RULES.shift_nm:
            # a rotation by more than half of the bands is one the other way
            by = shift if shift <= wavelength.size // 2 else shift - wavelength.size
            orders[f"shifted by {-by} bands"] = float(_correlation(np.roll(measured, -shift), expected))
    orders |= _agreements(_curvature(light * gain), wavelength, daylight)
    turned = _agreements(-_curvature(light * gain), wavelength, daylight)
    order, best = max(orders.items(), key=lambda item: -1.0 if np.isnan(item[1]) else item[1])
    chance = np.nanmax([-value for value in orders.values()] + list(turned.values()))
    if best > max(BAND_RULES.explained, chance + BAND_RULES.margin):
        yield Finding(
            KINDS["band-order"],
            name,
            f"the correlation of the bands with daylight is {declared:.2f}, and {best:.2f} where their order "
            f"is {order}",
            f"at least {BAND_RULES.unexplained:g} in the declared order",
        )


def _roughness(spectrum: Floats, light: Floats) -> float:
    # Squared difference of neighbouring bands relative to all pairs; 0 where too few are lit
    lit = (light > max(BAND_RULES.lit_counts, BAND_RULES.lit_share * np.nanmax(light))) & np.isfinite(
        spectrum
    )
    if lit.sum() < BAND_RULES.bands:
        return 0.0
    pairs = np.abs(np.subtract.outer(spectrum[lit], spectrum[lit]))[np.triu_indices(lit.sum(), 1)]
    steps = np.abs(np.diff(np.where(lit, spectrum, np.nan)))
    typical = float(np.median(pairs))
    even = typical < BAND_RULES.spread * float(np.median(spectrum[lit]))
    return 0.0 if even else float(np.nanmedian(steps) / typical) ** 2


def _agreements(radiance: Floats, wavelength: Floats, daylight: _Daylight) -> dict[str, float]:
    agreements = {}
    middle = float(wavelength.mean())
    shifts = np.arange(-BAND_RULES.shifts_nm, BAND_RULES.shifts_nm, 3.0)[:, None]
    for stretch in np.geomspace(*BAND_RULES.stretches, 140):
        for signed in (stretch, -stretch):
            nm = middle + shifts + signed * (wavelength - middle)
            agreement = _correlation(radiance, _curvature(daylight.at(nm)))
            best = int(np.argmax(np.nan_to_num(agreement, nan=-1.0)))
            agreements[f"{nm[best, 0]:.0f} to {nm[best, -1]:.0f} nm"] = float(agreement[best])
    return agreements


class _Daylight:
    # Daylight at the resolution of the bands, NaN outside its range
    def __init__(self, wavelength: Floats, fwhm: float, record: tuple[Floats, Floats] | None) -> None:
        beyond = 2.0 * BAND_RULES.shifts_nm
        nm = np.arange(max(wavelength.min() - beyond, 300.0), min(wavelength.max() + beyond, 2500.0), 0.5)
        clear = sum(ClearSky(45.0).irradiance(nm)) if record is None else None
        fine = np.asarray(clear if record is None else np.interp(nm, *record, np.nan, np.nan))
        steps = round(2.0 * max(fwhm, 1.0))  # of half a nanometre: one width to either side
        weights = np.exp(-0.5 * (2.3548 * np.linspace(-1.0, 1.0, 2 * steps + 1)) ** 2)
        self._nm, self._values = nm, np.convolve(fine, weights / weights.sum(), "same")

    def at(self, wavelength: Floats) -> Floats:
        return np.asarray(np.interp(wavelength, self._nm, self._values, np.nan, np.nan))


def _curvature(spectrum: Floats) -> Floats:
    # Second differences of the logarithm (..., band), NaN where there is almost no light
    least = 0.03 * np.nan_to_num(spectrum).max(axis=-1, keepdims=True)
    curvature = np.full(spectrum.shape, np.nan)
    curvature[..., 1:-1] = np.diff(np.log(np.where(spectrum > least, spectrum, np.nan)), 2)
    return curvature


def _correlation(first: Floats, second: Floats) -> Floats:
    # Correlation over the last axis, where both are known; NaN where few of the first are
    both = np.isfinite(first) & np.isfinite(second)
    count = both.sum(axis=-1)
    a, b = (np.where(both, part, 0.0) for part in (first, second))
    a, b = (
        np.where(both, part - part.sum(axis=-1, keepdims=True) / np.maximum(count, 1)[..., None], 0.0)
        for part in (a, b)
    )
    size = np.sqrt((a**2).sum(axis=-1) * (b**2).sum(axis=-1))
    lit = np.isfinite(first).sum(axis=-1)
    enough = (count >= np.maximum(BAND_RULES.bands, BAND_RULES.common * lit)) & (size > 0.0)
    return np.where(enough, (a * b).sum(axis=-1) / np.where(enough, size, 1.0), np.nan)


# -- Check that records of irradiance and navigation belong to the flight.


@dataclass(frozen=True)
class RecordRules:
    """Thresholds beyond which records do not belong to the flight.

    samples
        Fewest equal spectra in a row that are not a coincidence [1].
    still_factor
        Length of a standstill relative to the others of the record [1]: loggers write a reading several
        times.
    least_share, most_share
        Irradiance over a clear sky's [1]: a thunderstorm transmits 0.02, sides of clouds add 0.5.
    still_lines, still_share, still_m
        Fewest lines, share of the lines [1] with bit-identical positions, and extent of all positions [m]
        below which a platform does not move.
    turned
        Change of attitude that shows a camera turning in place [degree].
    gap_share
        Lines without a position or angle [1].
    """

    samples: int = 3
    still_factor: float = 3.0
    least_share: float = 0.015
    most_share: float = 3.6
    still_lines: int = 24
    still_share: float = 0.25
    still_m: float = 0.03
    turned: float = 5.0
    gap_share: float = 0.2


RECORD_RULES = RecordRules()
_ANGLES = ("roll", "pitch", "heading")


def judge_irradiance(name: str, line: xr.Dataset) -> Iterator[Finding]:
    """Judge the record that lights a line."""
    if "irradiance" not in line:
        return
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
    channels = line["irradiance_wavelength"].values.astype(np.float64)
    place = {key: line[key].values for key in ("latitude", "longitude") if key in line.coords}
    level = light_level(place, spectra, channels, times)
    share = level.median / level.clear
    if math.isfinite(share) and not RECORD_RULES.least_share <= share <= RECORD_RULES.most_share:
        slip = f", {level.slip}" if level.slip else ""
        yield Finding(
            KINDS["irradiance-level"],
            name,
            f"the median irradiance of 400-1000 nm is {level.median:.3g} W m-2 nm-1, {share:.2g} times "
            f"a clear sky's at its place and time{slip}",
            f"{RECORD_RULES.least_share:g} to {RECORD_RULES.most_share:g} times",
        )


def _judge_changes(name: str, spectra: Array, times: Array, flown: Array) -> Iterator[Finding]:
    same = (spectra[1:] == spectra[:-1]) | (np.isnan(spectra[1:]) & np.isnan(spectra[:-1]))
    same = same.all(axis=1) & np.isfinite(spectra[1:]).any(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]]).astype(int)))
    starts, lengths = edges[::2], edges[1::2] - edges[::2] + 1
    if not lengths.size or lengths.max() < RECORD_RULES.samples:
        return
    longest = int(np.argmax(lengths))
    first, last = starts[longest], starts[longest] + lengths[longest] - 1
    others = float(np.median(np.delete(lengths, longest))) if lengths.size > 1 else 1.0
    flown = flown[~np.isnat(flown)]
    covers = flown.size and times[first] <= flown.min() and flown.max() <= times[last]
    if lengths[longest] == len(spectra) or (covers and lengths[longest] > RECORD_RULES.still_factor * others):
        seconds = (times[last] - times[first]) / np.timedelta64(1, "s")
        yield Finding(
            KINDS["irradiance-constant"],
            name,
            f"{lengths[longest]} of {len(spectra)} spectra in a row are bit-identical, for {seconds:.3g} s",
            "spectra that differ, at least by noise",
        )


def judge_navigation(name: str, line: xr.Dataset) -> Iterator[Finding]:
    """Judge positions and angles of the lines."""
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
    gaps = {key: float(np.mean(~np.isfinite(values))) for key, values in pose.items()}
    # angles that were never measured are no gap: functions that need them ask for them
    gaps = {key: share for key, share in gaps.items() if share < 1.0 or key not in _ANGLES}
    if max(gaps.values()) > RECORD_RULES.gap_share:
        lost = ", ".join(
            f"{key} {100 * share:.3g} %" for key, share in gaps.items() if share > RECORD_RULES.gap_share
        )
        yield Finding(
            KINDS["navigation-gaps"],
            name,
            f"missing for the lines: {lost}",
            f"at most {100 * RECORD_RULES.gap_share:g} %",
        )
    located = np.isfinite(pose["latitude"]) & np.isfinite(pose["longitude"])
    if located.sum() < RECORD_RULES.still_lines:
        return
    north, east = np.radians(pose["latitude"][located]), np.radians(pose["longitude"][located])
    metres = 6.371e6 * np.stack([north, east * math.cos(float(north.mean()))])
    extent = float(np.hypot(*np.ptp(metres, axis=1)))
    angles = [pose[key][located] for key in _ANGLES if key in pose]
    finite = [values[np.isfinite(values)] for values in angles]
    turned = max(
        (float(np.ptp(np.unwrap(angle, period=360.0))) for angle in finite if angle.size), default=0.0
    )
    still = float(np.mean((np.diff(metres, axis=1) == 0.0).all(axis=0)))
    if turned < RECORD_RULES.turned and (still > RECORD_RULES.still_share or extent < RECORD_RULES.still_m):
        yield Finding(
            KINDS["navigation-still"],
            name,
            f"positions stay the same over {100 * still:.3g} % of the lines, and lie within {extent:.3g} m",
            "a platform that moves between lines",
        )


# -- Check for frames that belong to another cube, are doubled, or are missing.


@dataclass(frozen=True)
class FrameRules:
    """Thresholds of doubled and lost frames.

    samples, block
        Samples of a line that are compared with the next, and lines read at once.
    chance
        Doubled lines that noise alone may cause, in the whole cube [1].
    noisy
        Share of equal samples in the most similar of the other neighbouring lines, up to which noise is
        visible.
    jump, window
        Lasting step of the stamps, in frame periods, and lines before and after it that show it: stamps of
        a computer are delayed one by one, and catch up.
    """

    samples: int = 1024
    block: int = 1024
    chance: float = 1e-3
    noisy: float = 0.9
    jump: float = 0.7
    window: int = 8


FRAME_RULES = FrameRules()


def judge_index(inputs: FlightlineInputs, lines: int) -> tuple[Bools, list[Finding]]:
    """Return whether each line of a cube was recorded (along_track,), and findings of its frame index."""
    timing, name = inputs.timing, str(inputs.name)
    if not isinstance(timing, Timing) or timing.frame_index is None:
        return np.ones(lines, bool), []
    index = read_frame_index(timing.frame_index)
    frame, row = match_frames(index, lines, inputs.path, shortened=inputs.keep_whole_lines)
    findings = []
    number, first = cube_number(inputs.path), int(frame[0])
    if number is not None and number != first:
        # a cube may lack its first frame or be renamed: the index is foreign only if the cube has another
        matching = timing.frame_index.with_name(f"frameIndex_{number}.txt")
        foreign = matching != timing.frame_index and matching.is_file()
        kind = KINDS["foreign-frame-index" if foreign else "first-frame"]
        found = f"the first frame of {timing.frame_index.name} for {inputs.path.name} is {first}"
        findings.append(Finding(kind, name, found, str(number)))
    recorded = row >= 0
    if not index.fitted:
        findings += _jumps(name, frame[recorded], index.stamp[row[recorded]])
    return recorded, findings


def _jumps(name: str, frame: Ints, stamp: Ints) -> Iterator[Finding]:
    wide = FRAME_RULES.window
    if frame.size < 4 * wide:
        return
    steps = np.diff(stamp) / np.diff(frame)
    period = float(np.median(steps))
    late = stamp - stamp[0] - period * (frame - frame[0])
    windows = np.median(np.lib.stride_tricks.sliding_window_view(late, wide), axis=1)
    # compare before and after every long step
    for at in np.flatnonzero(steps[wide - 1 : 1 - wide] > (1.0 + FRAME_RULES.jump) * period) + wide - 1:
        if (windows[at + 1] - windows[at + 1 - wide]) / period > FRAME_RULES.jump:
            yield Finding(
                KINDS["lost-frames"],
                name,
                f"stamps step by {steps[at] / period:.3g} periods from frame {frame[at]} to {frame[at + 1]}, "
                "and stay late",
                "1, or frame numbers that skip the lost frames",
            )
            return


def judge_doubles(name: str, counts: xr.DataArray, by_pixel: bool, recorded: Bools) -> Iterator[Finding]:
    """Find lines of lazy counts (along_track, band, cross_track) that repeat the line before.

    by_pixel: whether samples of one pixel lie together in the file; recorded: (along_track,).
    """
    lines, bands, columns = counts.shape
    axis, across = (2, bands) if by_pixel else (1, columns)
    size = counts.shape[axis]
    count = min(size, 4 + FRAME_RULES.samples // across)
    middle = slice((size - count) // 2, (size + count) // 2)  # contiguous: one read a line
    equal = _equal_shares(counts.isel({counts.dims[axis]: middle}), FRAME_RULES.block)
    equal = equal[recorded[1:] & recorded[:-1]]
    doubled = equal == 1.0
    if not doubled.any():
        return
    highest = float(equal[~doubled].max()) if not doubled.all() else 0.0
    by_chance = doubled.size * highest ** (count * across)
    if highest > FRAME_RULES.noisy or by_chance > FRAME_RULES.chance:
        return
    first = int(np.flatnonzero(doubled)[0]) + 1
    yield Finding(
        KINDS["doubled-frames"],
        name,
        f"{int(doubled.sum())} of {lines} lines are bit for bit the line before, the first is line {first}",
        f"noise: of other neighbouring lines at most {100 * highest:.3g} % of the samples are equal",
    )


def _equal_shares(rows: xr.DataArray, block: int) -> Floats:
    # Share of samples that equal the line before, (along_track - 1,)
    shares: list[Array] = []
    for start in range(0, rows.shape[0] - 1, block):
        part = rows[start : start + block + 1].to_numpy()
        shares.append((part[1:] == part[:-1]).mean(axis=(1, 2)))
    return np.concatenate(shares) if shares else np.zeros(0)


# -- Check interleave and byte order of a cube by the smoothness of its spectra.


@dataclass(frozen=True)
class LayoutRules:
    """Thresholds at which another layout explains a cube better.

    bands, pixels
        Random bands, and pixels in each, that are read: some thousand places of the file.
    rough, smoother
        Mean squared difference of neighbouring bands over twice the variance [1]: value above which other
        layouts are tried, and ratio by which one has to be smoother: 30 times in another interleave, 1000
        times with bytes exchanged.
    unlike
        The same [1] above which bands have nothing in common in the other layout either (1: noise): one band
        of status words makes a cube rougher than noise, and every other layout smoother.
    separate, separation
        Share of the variance that bands explain in the better interleave, and over that share in the declared
        one [1]: light and camera give every band a level of its own, and a wrong order mixes them. Without
        it, neighbouring columns of an even field would look like bands of a camera that has few.
    """

    bands: int = 24
    pixels: int = 64
    rough: float = 0.1
    smoother: float = 10.0
    unlike: float = 0.5
    separate: float = 0.06
    separation: float = 0.5


LAYOUT_RULES = LayoutRules()


class _View(NamedTuple):
    # Counts read in one interleave, both (band, pixel)
    values: Floats
    neighbours: Floats  # Of the next band

    @property
    def roughness(self) -> float:
        # squared difference of neighbouring bands, over twice the variance
        spread = 2.0 * float(self.values.var())
        return float(np.mean((self.values - self.neighbours) ** 2)) / spread if spread else 0.0

    @property
    def separation(self) -> float:
        # share of the variance between bands, less its expectation by chance
        bands, pixels = self.values.shape
        within = float(self.values.var(axis=1).mean()) * pixels / (pixels - 1)
        between = max(float(self.values.mean(axis=1).var()) * bands / (bands - 1) - within / pixels, 0.0)
        return between / (between + within) if within else 0.0


def judge_layout(name: str, path: Path, lines: int) -> Iterator[Finding]:
    """Judge the file of a cube of so many lines against its header."""
    header_path, data_path = find_pair(path)
    header = read_header(header_path)
    if header.bands < 4 or header.dtype.kind not in "iu" or lines * header.samples < LAYOUT_RULES.pixels:
        return
    with open(data_path, "rb", buffering=0) as file:
        views = {order: _view(file, header, lines, order) for order in ("bil", "bip", "bsq")}
    declared = views.pop(header.interleave)
    if declared.roughness <= LAYOUT_RULES.rough:
        return
    smooth = min(declared.roughness / LAYOUT_RULES.smoother, LAYOUT_RULES.unlike)
    if header.dtype.itemsize == 2:
        swapped = _View(*(part.astype(header.dtype).byteswap().astype(np.float64) for part in declared))
        if swapped.roughness < smooth:
            other = "0 (little)" if header.dtype.newbyteorder("<") != header.dtype else "1 (big)"
            yield Finding(
                KINDS["byte-order"],
                name,
                f"neighbouring bands differ by {declared.roughness:.2g} of the variance, by "
                f"{swapped.roughness:.2g} with bytes exchanged",
                f"byte order = {other}",
            )
            return
    order, best = min(views.items(), key=lambda item: item[1].roughness)
    least = max(LAYOUT_RULES.separate, LAYOUT_RULES.separation * declared.separation)
    if best.roughness < smooth and best.separation > least:
        yield Finding(
            KINDS["interleave"],
            name,
            f"neighbouring bands differ by {declared.roughness:.2g} of the variance as {header.interleave}, "
            f"by {best.roughness:.2g} as {order}",
            f"interleave = {order}",
        )


def _view(file: io.FileIO, header: EnviHeader, lines: int, order: str) -> _View:
    # Read random pixels, the same in every band, with the file's samples in the given interleave
    rng = np.random.default_rng(0)
    count = min(LAYOUT_RULES.bands, header.bands - 1)
    bands = np.linspace(0, header.bands - 2, count).astype(np.int64)[:, None]
    shape = (count, LAYOUT_RULES.pixels)
    line, column = rng.integers(lines, size=shape), rng.integers(header.samples, size=shape)

    def at(band: Ints) -> Floats:
        places = {
            "bil": (line * header.bands + band) * header.samples + column,
            "bip": (line * header.samples + column) * header.bands + band,
            "bsq": (band * lines + line) * header.samples + column,
        }[order]
        size = header.dtype.itemsize
        # single reads: mapping the file would take its size in address space
        starts = (header.header_offset + size * places.ravel()).tolist()
        samples = bytearray()
        for start in starts:
            file.seek(start)
            samples += file.read(size)
        return np.frombuffer(samples, header.dtype).astype(np.float64).reshape(places.shape)

    return _View(at(bands), at(bands + 1))


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


DARK_RULES = DarkRules()


def judge_dark(
    name: str, dark: Floats, uncertainty: Floats | None, gain: Floats, sample: CubeSample, full: float
) -> Iterator[Finding]:
    """Judge dark counts, all (band, cross_track), against a sample of the scene.

    uncertainty: of the mean dark [count], None where unknown; gain: of radiance, in any unit; full: count
    from which an element is saturated.
    """
    zeros = float(np.mean((dark == 0.0) & (sample.mean > DARK_RULES.zero_counts)))
    others = dark[dark > 0.0]
    if zeros > DARK_RULES.zero_share and (others.size == 0 or others.mean() > DARK_RULES.zero_counts):
        yield Finding(
            KINDS["dark-of-zeros"],
            name,
            f"{100 * zeros:.3g} % of the dark's elements are exactly 0 in every frame, under light",
            f"at most {100 * DARK_RULES.zero_share:g} %",
        )
        return
    dark_bands, light_bands = np.nanmean(dark, axis=1), np.nanmean(sample.mean - dark, axis=1)
    over = float(
        np.mean(light_bands < -np.maximum(DARK_RULES.over_counts, DARK_RULES.over_level * dark_bands))
    )
    if over > DARK_RULES.over_share:
        yield Finding(
            KINDS["dark-over-scene"],
            name,
            f"the dark lies above the mean of the scene in {100 * over:.3g} % of the bands, "
            f"{np.median(dark):.4g} against {np.median(sample.mean):.4g} counts",
            f"at most {100 * DARK_RULES.over_share:g} %",
        )
        return
    yield from _judge_light(name, dark_bands, light_bands)
    if uncertainty is not None:
        yield from _judge_pattern(name, dark, uncertainty, gain, sample, full)


def judge_dark_frames(name: str, counts: xr.DataArray) -> Iterator[Finding]:
    """Find frames of a dark cube (along_track, band, cross_track), read lazily, that are blank or lit."""
    bands = np.unique(np.linspace(0, counts.shape[1] - 1, DARK_RULES.frame_bands).astype(int))
    frames = np.unique(np.linspace(0, counts.shape[0] - 1, DARK_RULES.frames).astype(int))
    sample = counts.isel({counts.dims[0]: frames, counts.dims[1]: bands})
    levels = np.median(sample.to_numpy(), axis=(1, 2))
    median = float(np.median(levels))
    tolerance = max(DARK_RULES.frame_counts, DARK_RULES.frame_share * median)
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
    if dark.size < DARK_RULES.lit_bands or not (np.ptp(dark) > 0.0 and np.ptp(light) > 0.0):
        return
    bend, lit = np.diff(dark, 2), np.diff(light, 2)
    if not (np.any(bend) and np.any(lit)):
        return
    correlation = float(bend @ lit / np.sqrt((bend @ bend) * (lit @ lit)))
    slope = float(bend @ lit / (lit @ lit))
    if not DARK_RULES.lit_slope < slope <= DARK_RULES.lit_most:
        return
    if correlation > DARK_RULES.lit_correlation and np.ptp(light) > DARK_RULES.lit_range * np.ptp(
        dark - slope * light
    ):
        yield Finding(
            KINDS["dark-lit"],
            name,
            f"the spectrum of the dark follows the scene (correlation {correlation:.2f}), with "
            f"{100 * slope:.3g} % of its light",
            f"no light, under {100 * DARK_RULES.lit_slope:g} %",
        )


def _judge_pattern(
    name: str, dark: Floats, uncertainty: Floats, gain: Floats, sample: CubeSample, full: float
) -> Iterator[Finding]:
    # Find a dark whose pattern is not part of the scene.
    # Mean scene = dark + light / gain: differences of neighbouring elements leave the two patterns, and a
    # regression of the scene's on both gives the share of the dark's pattern in it.
    if (
        dark.shape[0] < 3
        or dark.shape[1] < 2
        or not np.nanmax(dark) - np.nanmin(dark) > DARK_RULES.pattern_range
    ):
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
    if usable.sum() < DARK_RULES.pattern_elements:
        return
    # variance of a difference: 12 is the sum of its squared weights; rounding to whole counts adds 1/12,
    # which frames do not average out where the noise is under a count
    noise = 12.0 * (float(np.mean(np.square(uncertainty))) + 1.0 / 12.0)
    # without hot elements, whose dark changes differently
    usable &= np.abs(pattern) <= 8.0 * np.median(np.abs(pattern[usable])) + 1e-9
    if np.var(pattern[usable]) < DARK_RULES.pattern_contrast * noise or not np.any(pattern[usable]):
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
    least, most = DARK_RULES.pattern_slopes
    if not least <= slopes[0] <= most and abs(1.0 - slopes[0]) > DARK_RULES.pattern_sds * spread:
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
