"""Check the order of the bands by the solar lines and absorption bands of daylight in the cube."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.light.clear_sky import ClearSky

from .finding import KINDS, Finding


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


RULES = BandRules()


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
    if wavelength.size < RULES.bands or not 0.0 < spacing <= RULES.spacing_nm or fwhm > RULES.fwhm_nm:
        return
    rising = np.argsort(wavelength)
    # a camera of many filters has unlike gains in neighbouring bands, and a smooth radiance
    roughness = min(_roughness(spectrum[rising], light[rising]) for spectrum in (light, light * gain))
    if roughness > RULES.rough:
        yield Finding(
            KINDS["band-order"],
            name,
            f"neighbouring bands differ by {roughness:.2g} of the difference of any two bands",
            f"under {RULES.rough:g}, as in smooth spectra",
        )
        return
    if record is None:
        return
    daylight = _Daylight(wavelength, fwhm, record)
    clear = _curvature(_Daylight(wavelength, fwhm, None).at(wavelength))
    if not _correlation(_curvature(daylight.at(wavelength)), clear) > RULES.daylight:
        return
    expected = _curvature(daylight.at(wavelength) / gain)
    measured = _curvature(light)
    declared = float(_correlation(measured, expected))
    if not declared < RULES.unexplained:
        return
    # reversed, rotated, and at other wavelengths
    orders = {"reversed": float(_correlation(measured[::-1], expected))}
    for shift in range(1, wavelength.size):
        if min(shift, wavelength.size - shift) * spacing >= RULES.shift_nm:
            # a rotation by more than half of the bands is one the other way
            by = shift if shift <= wavelength.size // 2 else shift - wavelength.size
            orders[f"shifted by {-by} bands"] = float(_correlation(np.roll(measured, -shift), expected))
    orders |= _agreements(_curvature(light * gain), wavelength, daylight)
    turned = _agreements(-_curvature(light * gain), wavelength, daylight)
    order, best = max(orders.items(), key=lambda item: -1.0 if np.isnan(item[1]) else item[1])
    chance = np.nanmax([-value for value in orders.values()] + list(turned.values()))
    if best > max(RULES.explained, chance + RULES.margin):
        yield Finding(
            KINDS["band-order"],
            name,
            f"the correlation of the bands with daylight is {declared:.2f}, and {best:.2f} where their order "
            f"is {order}",
            f"at least {RULES.unexplained:g} in the declared order",
        )


def _roughness(spectrum: Floats, light: Floats) -> float:
    # Squared difference of neighbouring bands relative to all pairs; 0 where too few are lit
    lit = (light > max(RULES.lit_counts, RULES.lit_share * np.nanmax(light))) & np.isfinite(spectrum)
    if lit.sum() < RULES.bands:
        return 0.0
    pairs = np.abs(np.subtract.outer(spectrum[lit], spectrum[lit]))[np.triu_indices(lit.sum(), 1)]
    steps = np.abs(np.diff(np.where(lit, spectrum, np.nan)))
    typical = float(np.median(pairs))
    even = typical < RULES.spread * float(np.median(spectrum[lit]))
    return 0.0 if even else float(np.nanmedian(steps) / typical) ** 2


def _agreements(radiance: Floats, wavelength: Floats, daylight: _Daylight) -> dict[str, float]:
    agreements = {}
    middle = float(wavelength.mean())
    shifts = np.arange(-RULES.shifts_nm, RULES.shifts_nm, 3.0)[:, None]
    for stretch in np.geomspace(*RULES.stretches, 140):
        for signed in (stretch, -stretch):
            nm = middle + shifts + signed * (wavelength - middle)
            agreement = _correlation(radiance, _curvature(daylight.at(nm)))
            best = int(np.argmax(np.nan_to_num(agreement, nan=-1.0)))
            agreements[f"{nm[best, 0]:.0f} to {nm[best, -1]:.0f} nm"] = float(agreement[best])
    return agreements


class _Daylight:
    # Daylight at the resolution of the bands, NaN outside its range
    def __init__(self, wavelength: Floats, fwhm: float, record: tuple[Floats, Floats] | None) -> None:
        beyond = 2.0 * RULES.shifts_nm
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
    enough = (count >= np.maximum(RULES.bands, RULES.common * lit)) & (size > 0.0)
    return np.where(enough, (a * b).sum(axis=-1) / np.where(enough, size, 1.0), np.nan)
