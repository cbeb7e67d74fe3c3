"""Order of the bands, judged by the lines of the daylight in the picture."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.light.clear_sky import ClearSky

from .finding import KINDS, Finding

__all__ = ["judge_bands"]


@dataclass(frozen=True)
class BandRules:
    """When bands stand in another order than their wavelengths.

    bands, spacing_nm, fwhm_nm
        Fewest bands, widest spacing and width [nm]: the lines of oxygen and water are 5 to 40 nm wide, and
        have to be seen.
    explained, unexplained
        Correlation of the picture's curvature over wavelength with that of daylight and gain, in the order
        that explains it best, and in the order that is said [1].
    shift_nm
        Smallest shift that is one [nm]: a smaller one is measured and mended by `hyperpaint.alignment`.
    stretches, shifts_nm
        Other wavelengths that are tried: intervals of bands over those said [1], and shifts of the middle
        band [nm].
    rough
        Mean squared difference of neighbouring bands over twice the variance [1]: 1 of bands in any order.
    """

    bands: int = 24
    fwhm_nm: float = 24.0
    spacing_nm: float = 15.0
    explained: float = 0.7
    unexplained: float = 0.35
    shift_nm: float = 6.0
    stretches: tuple[float, float] = (0.5, 2.0)
    shifts_nm: float = 120.0
    rough: float = 0.5


RULES = BandRules()


def judge_bands(
    name: str,
    light: Floats,
    gain: Floats,
    wavelength: Floats,
    fwhm: float,
    record: tuple[Floats, Floats] | None,
) -> Iterator[Finding]:
    """Judge the mean light over the dark [count] of every band, (band,) as gain and wavelength [nm].

    fwhm: of the camera [nm]; record: wavelengths [nm] and irradiance, None for a clear sky's.
    """
    spacing = float(np.median(np.abs(np.diff(wavelength)))) if wavelength.size > 1 else np.inf
    if wavelength.size < RULES.bands or not 0.0 < spacing <= RULES.spacing_nm or fwhm > RULES.fwhm_nm:
        return
    spread = float(np.nanvar(light))
    roughness = float(np.nanmean(np.diff(light) ** 2)) / (2.0 * spread) if spread else 0.0
    if roughness > RULES.rough:
        yield Finding(
            KINDS["band-order"], name,
            f"neighbouring bands differ by {roughness:.2g} of the variance of all",
            f"under {RULES.rough:g}: spectra are smooth",
        )  # fmt: skip
        return
    daylight = _Daylight(wavelength, fwhm, record)
    expected = _curvature(daylight.at(wavelength) / gain)
    shown = _curvature(light)
    as_said = float(_correlation(shown, expected))
    if not as_said < RULES.unexplained:
        return
    orders = {"reversed": float(_correlation(shown[::-1], expected))}
    for shift in range(1, wavelength.size):
        if min(shift, wavelength.size - shift) * spacing >= RULES.shift_nm:
            # a roll by all bands but a few is one by a few the other way
            by = shift if shift <= wavelength.size // 2 else shift - wavelength.size
            orders[f"shifted by {-by} bands"] = float(_correlation(np.roll(shown, -shift), expected))
    orders |= _agreements(_curvature(light * gain), wavelength, daylight)
    order, best = max(orders.items(), key=lambda item: -1.0 if np.isnan(item[1]) else item[1])
    if best > RULES.explained:
        yield Finding(
            KINDS["band-order"], name,
            f"the lines of the daylight agree with the bands by a correlation of {as_said:.2f}, by "
            f"{best:.2f} where their order is {order}", f"at least {RULES.unexplained:g} as it is",
        )  # fmt: skip


def _agreements(radiance: Floats, wavelength: Floats, daylight: _Daylight) -> dict[str, float]:
    """Return how well the lines of the daylight agree with the bands at other wavelengths."""
    agreements = {}
    middle = float(wavelength.mean())
    shifts = np.arange(-RULES.shifts_nm, RULES.shifts_nm, 3.0)[:, None]
    for stretch in np.geomspace(*RULES.stretches, 140):
        for signed in (stretch, -stretch):
            nm = middle + shifts + signed * (wavelength - middle)
            agreement = _correlation(radiance, _curvature(daylight.at(nm)))
            best = int(np.argmax(np.nan_to_num(agreement, nan=-1.0)))
            agreements[f"that of {nm[best, 0]:.0f} to {nm[best, -1]:.0f} nm"] = float(agreement[best])
    return agreements


class _Daylight:
    """Daylight as bands of a width see it, NaN beyond what is known of it."""

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
    """Return second differences of the logarithm (..., band), NaN where there is next to no light."""
    least = 0.03 * np.nan_to_num(spectrum).max(axis=-1, keepdims=True)
    curvature = np.full(spectrum.shape, np.nan)
    curvature[..., 1:-1] = np.diff(np.log(np.where(spectrum > least, spectrum, np.nan)), 2)
    return curvature


def _correlation(first: Floats, second: Floats) -> Floats:
    """Return the correlation over the last axis, where both are known; NaN of too few."""
    both = np.isfinite(first) & np.isfinite(second)
    count = both.sum(axis=-1)
    a, b = (np.where(both, part, 0.0) for part in (first, second))
    a, b = (np.where(both, part - part.sum(axis=-1, keepdims=True) / np.maximum(count, 1)[..., None], 0.0)
            for part in (a, b))  # fmt: skip
    size = np.sqrt((a**2).sum(axis=-1) * (b**2).sum(axis=-1))
    enough = (count >= RULES.bands // 2) & (size > 0.0)
    return np.where(enough, (a * b).sum(axis=-1) / np.where(enough, size, 1.0), np.nan)
