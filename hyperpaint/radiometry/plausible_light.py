"""Irradiance that cannot be daylight, or lacks channels, before reflectance is made of it."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from hyperpaint.base.arrays import Array, Floats
from hyperpaint.base.daylight import DULL_MEDIAN, HIGHEST_MEDIAN, LOWEST_MEDIAN, brightest_median, unit_slip
from hyperpaint.base.errors import PaintWarning, SchemaError
from hyperpaint.light.clear_sky import ClearSky
from hyperpaint.light.sun import solar_position


@dataclass(frozen=True)
class LightRules:
    """From where on a record is hardly that of the sky over a flight.

    least_share, most_share
        Median of 400-1000 nm over that of a clear sky at the place and time [1]. A thunderstorm lets 0.02
        through, light off the sides of clouds adds 0.5, and the clear sky is modelled to a tenth.
    max_zenith
        Of the sun, up to which the clear sky is asked [degree].
    most_low_sun
        Median where the sun is lower [W m-2 nm-1]: a clear sky has 0.2 at 80 degree.
    """

    least_share: float = 0.015
    most_share: float = 1.8
    max_zenith: float = 80.0
    most_low_sun: float = 0.3


RULES = LightRules()


class LightLevel(NamedTuple):
    """How bright a record is: the brightest sample's median of 400-1000 nm [W m-2 nm-1], NaN of none.

    zenith: of the sun at its highest [degree]; clear: the median of a clear sky then; NaN where not known.
    """

    median: float
    zenith: float
    clear: float

    @property
    def slip(self) -> str:
        """Which unit was taken for which, if one explains the level; empty where none does."""
        return unit_slip(self.median / (self.clear if math.isfinite(self.clear) else 1.0))


def light_level(cube: Mapping[str, Any], spectra: Array, channels: Floats, stamps: Array) -> LightLevel:
    """Return how bright the spectra (sample, channel) are that light a line, at its place and time."""
    zenith = _highest_sun(cube, stamps)
    clear = _clear_median(zenith, channels) if zenith <= RULES.max_zenith else math.nan
    return LightLevel(brightest_median(channels, np.asarray(spectra, np.float64)), zenith, clear)


def check_light(cube: Mapping[str, Any], spectra: Array, channels: Floats, stamps: Array) -> None:
    """Judge the level of the spectra (sample, channel) that light a line [W m-2 nm-1].

    Raises SchemaError: No daylight is so bright or so dim. Warns PaintWarning: It is hardly that of the place
    and time.
    """
    judged = light_level(cube, spectra, channels, stamps)
    level, zenith, clear = judged
    if not math.isfinite(level):
        return
    shown = f"the median irradiance of 400-1000 nm is {level:.3g} W m-2 nm-1"
    slip = f", {judged.slip}" if judged.slip else ""
    if not LOWEST_MEDIAN <= level <= HIGHEST_MEDIAN:
        raise SchemaError(
            f"{shown}",
            expected=f"{LOWEST_MEDIAN:g} to {HIGHEST_MEDIAN:g} of daylight{slip}",
            mend="correct its units",
            code="irradiance-level",
        )
    if math.isfinite(clear):
        doubtful = not RULES.least_share <= level / clear <= RULES.most_share
        against = f"{level / clear:.2g} times that of a clear sky at its place and time{slip}"
    elif zenith > RULES.max_zenith:
        doubtful = level > RULES.most_low_sun
        against = f"though the sun is {90 - zenith:.0f} degree above the horizon: is its time local, not UTC?"
    else:
        doubtful = level < DULL_MEDIAN
        against = f"expected {DULL_MEDIAN:g} at least by day{slip}"
    if doubtful:
        text = f"{shown}, {against}; check its units, its time, and the line's place"
        warnings.warn(text, PaintWarning, stacklevel=2)


def _highest_sun(cube: Mapping[str, Any], stamps: Array) -> float:
    """Return the least zenith angle of the sun [degree]; NaN where the place is not known."""
    places = [np.asarray(cube.get(name, np.nan), np.float64) for name in ("latitude", "longitude")]
    if not all(np.isfinite(degrees).any() for degrees in places) or not stamps.size:
        return math.nan
    latitude, longitude = (float(degrees[np.isfinite(degrees)].mean()) for degrees in places)
    return float(np.min(solar_position(stamps, latitude, longitude)[0]))


def _clear_median(zenith: float, channels: Floats) -> float:
    """Return the median of a clear sky over 400-1000 nm [W m-2 nm-1]; NaN where no channel is there."""
    nm = channels[(channels >= 300.0) & (channels <= 2500.0)][:: max(1, channels.size // 200)]
    return brightest_median(nm, np.asarray(sum(ClearSky(zenith).irradiance(nm)))[None])


def warn_of_lost_bands(spectra: Array, channels: Floats, matched: Floats, wavelength: Floats) -> None:
    """Warn of bands (band,) whose matched irradiance is undefined since channels of a sample are.

    spectra: (sample, channel); matched: (sample, node, band). A sample without any channel is a gap.
    """
    sampled = np.isfinite(spectra).any(axis=1)
    lost = (
        np.isnan(matched[sampled]).any(axis=(0, 1))
        & (wavelength >= channels[0])
        & (wavelength <= channels[-1])
    )
    missing = np.isnan(spectra[sampled]).any(axis=0)
    if not (lost.any() and missing.any()):
        return
    text = (
        f"irradiance is undefined in {missing.sum()} channels, such as {channels[missing][0]:g} nm: "
        f"{lost.sum()} of {lost.size} bands have no reflectance where it is, "
        f"{wavelength[lost].min():g} to {wavelength[lost].max():g} nm; interpolate the record over them"
    )
    warnings.warn(text, PaintWarning, stacklevel=2)
