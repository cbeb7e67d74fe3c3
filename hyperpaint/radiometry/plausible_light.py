"""Check that irradiance is plausible daylight and has all channels, before reflectance is computed."""

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
    """Limits of an irradiance record that fits the sky over a flight.

    least_share, most_share
        Median of 400-1000 nm over the median of a clear sky at the place and time [1]. A thunderstorm
        transmits 0.02, light off the sides of clouds adds 0.5, and the clear sky is modelled to a tenth.
    max_zenith
        Zenith angle of the sun up to which the clear sky is modelled [degree].
    most_low_sun
        Largest median for a lower sun [W m-2 nm-1]: a clear sky has 0.2 at 80 degree.
    """

    least_share: float = 0.015
    most_share: float = 1.8
    max_zenith: float = 80.0
    most_low_sun: float = 0.3


RULES = LightRules()


class LightLevel(NamedTuple):
    """Brightness of a record: median over 400-1000 nm of its brightest sample [W m-2 nm-1], or NaN.

    zenith: smallest zenith angle of the sun [degree]; clear: median of a clear sky at that angle; NaN if
    unknown.
    """

    median: float
    zenith: float
    clear: float

    @property
    def slip(self) -> str:
        """Mistaken unit that explains the level, as "A taken for B"; empty without one."""
        return unit_slip(self.median / (self.clear if math.isfinite(self.clear) else 1.0))


def light_level(cube: Mapping[str, Any], spectra: Array, channels: Floats, stamps: Array) -> LightLevel:
    """Return the brightness of the spectra (sample, channel) that light a line, at its place and time."""
    # smallest zenith angle of the sun; NaN where the position is unknown
    zenith = clear = math.nan
    coordinates = [np.asarray(cube.get(name, np.nan), np.float64) for name in ("latitude", "longitude")]
    if all(np.isfinite(degrees).any() for degrees in coordinates) and stamps.size:
        position = [float(degrees[np.isfinite(degrees)].mean()) for degrees in coordinates]
        zenith = float(np.min(solar_position(stamps, *position)[0]))
    if zenith <= RULES.max_zenith:
        nm = channels[(channels >= 300.0) & (channels <= 2500.0)][:: max(1, channels.size // 200)]
        clear = brightest_median(nm, np.asarray(sum(ClearSky(zenith).irradiance(nm)))[None])
    return LightLevel(brightest_median(channels, np.asarray(spectra, np.float64)), zenith, clear)


def check_light(cube: Mapping[str, Any], spectra: Array, channels: Floats, stamps: Array) -> None:
    """Check the level of the spectra (sample, channel) that light a line [W m-2 nm-1].

    Raises SchemaError: The level is impossible for daylight. Warns PaintWarning: It does not fit position and
    time.
    """
    light = light_level(cube, spectra, channels, stamps)
    level, zenith, clear = light
    if not math.isfinite(level):
        return
    found = f"the median irradiance of 400-1000 nm is {level:.3g} W m-2 nm-1"
    slip = f", {light.slip}" if light.slip else ""
    if not LOWEST_MEDIAN <= level <= HIGHEST_MEDIAN:
        raise SchemaError(
            found,
            expected=f"{LOWEST_MEDIAN:g} to {HIGHEST_MEDIAN:g} of daylight{slip}",
            mend="correct its units",
            code="irradiance-level",
        )
    if math.isfinite(clear):
        is_doubtful = not RULES.least_share <= level / clear <= RULES.most_share
        comparison = f"{level / clear:.2g} times that of a clear sky at its place and time{slip}"
    elif zenith > RULES.max_zenith:
        is_doubtful = level > RULES.most_low_sun
        comparison = f"with the sun {90 - zenith:.0f} degree above the horizon, as with local time for UTC"
    else:
        is_doubtful = level < DULL_MEDIAN
        comparison = f"expected at least {DULL_MEDIAN:g} by day{slip}"
    if is_doubtful:
        text = f"{found}, {comparison}; check its units, its time, and the line's place"
        warnings.warn(PaintWarning(text, code="irradiance-level"), stacklevel=2)


def warn_of_lost_bands(spectra: Array, channels: Floats, matched: Floats, wavelength: Floats) -> None:
    """Warn of bands (band,) whose matched irradiance is undefined because channels of a sample are missing.

    spectra: (sample, channel); matched: (sample, node, band). A sample without any channel is a gap.
    """
    has_values = np.isfinite(spectra).any(axis=1)
    is_lost = (
        np.isnan(matched[has_values]).any(axis=(0, 1))
        & (wavelength >= channels[0])
        & (wavelength <= channels[-1])
    )
    is_missing = np.isnan(spectra[has_values]).any(axis=0)
    if not (is_lost.any() and is_missing.any()):
        return
    text = (
        f"irradiance is undefined in {is_missing.sum()} channels, such as {channels[is_missing][0]:g} nm: "
        f"{is_lost.sum()} of {is_lost.size} bands become NaN at these times, "
        f"{wavelength[is_lost].min():g} to {wavelength[is_lost].max():g} nm; interpolate the record over them"
    )
    warnings.warn(PaintWarning(text, code="irradiance-gaps"), stacklevel=2)
