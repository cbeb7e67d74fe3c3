"""Range of daylight irradiance, and the unit mistakes that explain values outside it."""

from __future__ import annotations

import math

import numpy as np

from .arrays import Floats

#: Range of plausible median irradiance over 400-1000 nm [W m-2 nm-1]. Above the atmosphere the sun has a
#: maximum of 2.2 and a median of 1.5, and clouds add little more than the air absorbs; 3e-4 is deep
#: twilight, but more than full sun in W m-2 nm-1 that is declared as W cm-2 nm-1.
HIGHEST_MEDIAN, LOWEST_MEDIAN = 3.0, 3e-4

#: Median irradiance below which light is too weak for a flight [W m-2 nm-1]: an overcast sky at the lowest
#: usable sun gives 0.04.
DULL_MEDIAN = 0.02

_JUDGED_NM = (400.0, 1000.0)
_UNIT_FACTORS = {
    "uW cm-2 nm-1": 1e-2, "mW m-2 nm-1 (W m-2 um-1)": 1e-3, "uW m-2 nm-1": 1e-6, "mW cm-2 nm-1": 10.0,
    "W cm-2 nm-1": 1e4,
}  # fmt: skip
_MAX_LOG_RATIO = math.log(3.0)


def brightest_median(wavelength: Floats, values: Floats) -> float:
    """Return the median over 400-1000 nm of the brightest sample; NaN without samples.

    wavelength: (irradiance_wavelength,) [nm]; values: (irradiance_time, irradiance_wavelength).
    """
    samples = values[:, (wavelength >= _JUDGED_NM[0]) & (wavelength <= _JUDGED_NM[1])]
    samples = samples[np.isfinite(samples).any(axis=1)] if samples.shape[1] else samples[:0]
    return float(np.nanmedian(samples, axis=1).max()) if len(samples) else math.nan


def unit_slip(ratio: float) -> str:
    """Return the unit mistake that explains irradiance ``ratio`` times the expected one; empty for none.

    Examples
    --------
    >>> unit_slip(1.2e-6)
    'as of values in W m-2 nm-1 that are declared in uW m-2 nm-1'
    >>> unit_slip(90.0)
    'as of values in uW cm-2 nm-1 that are taken for W m-2 nm-1'
    >>> unit_slip(1.5)
    ''
    """
    if not 0.0 < ratio < math.inf:
        return ""
    texts = {
        f"as of values in W m-2 nm-1 that are declared in {unit}": factor
        for unit, factor in _UNIT_FACTORS.items()
    } | {
        f"as of values in {unit} that are taken for W m-2 nm-1": 1.0 / factor
        for unit, factor in _UNIT_FACTORS.items()
    }
    nearest = min(texts, key=lambda text: abs(math.log(texts[text] / ratio)))
    return nearest if abs(math.log(texts[nearest] / ratio)) <= _MAX_LOG_RATIO else ""
