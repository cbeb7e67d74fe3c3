"""Constants that several rooms share."""

import math
from collections.abc import Mapping
from typing import Literal, get_args

import numpy as np

from .schema import Floats

#: A sample within this distance of the largest count of the converter is saturated (DESIGN.md,
#: `saturated`).
SATURATION_MARGIN_COUNTS = 16

#: Variance that conversion to whole counts adds [count2]: a uniform error of the width of one count.
QUANTISATION_VARIANCE_COUNT2 = 1.0 / 12.0

#: Mantissa bits of the stored reflectance: a relative error of at most 2**-13, 1.2e-4.
KEPT_BITS = 12

WGS84_SEMI_MAJOR_AXIS_M = 6378137.0
#: NIMA TR8350.2, World Geodetic System 1984. The simulator's ellipsoid has its own, to check against.
WGS84_ECCENTRICITY_SQUARED = 6.69437999014e-3

#: Time from the stamp of a frame to its mid exposure [exposure times], by the instant that stamps mark.
MID_EXPOSURE_OFFSETS: Mapping[str, float] = {"start": 0.5, "mid": 0.0, "end": -0.5}

#: Version of the numbers that `process` and `render` store. Raise it with every change after which the same
#: inputs and settings may give other bits (a formula, a constant, a threshold, an order of summation); not
#: for speed, words or layout. `tests/workflows/test_numerics_version.py` holds the checksums of this version.
#: A store of another version is reported, and computed again on request.
NUMERICS_VERSION = 2

#: Size of the output of one task; the allocator requests a larger block from the kernel each time.
MAX_TASK_BYTES = 24_000_000

#: Surfaces of calibration panels with known factors by direction, see `hyperpaint.radiometry.panel_factor`.
PANEL_SURFACES = ("lambertian", "sintered-ptfe")

#: Codec of stored arrays, see `hyperpaint.to_store`.
DEFAULT_CODEC: Literal["compact", "fast"] = "compact"

#: When differences between camera and irradiance record are corrected: see `hyperpaint.alignment.align`.
Alignment = Literal["auto", "never", "always"]
ALIGNMENTS: tuple[Alignment, ...] = get_args(Alignment)

#: Relative standard uncertainty of stray light from which it is not subtracted: it is then less than two
#: standard uncertainties from zero [1].
MAX_STRAY_LIGHT_U = 0.5


def lines_a_task(bytes_a_line: int, max_lines: int = 32) -> int:
    """Return the number of whole lines in a task: at most ``max_lines`` and `MAX_TASK_BYTES`, at least one.

    Examples
    --------
    >>> lines_a_task(640 * 272 * 4), lines_a_task(2_000_000)
    (32, 12)
    """
    return min(max_lines, max(1, MAX_TASK_BYTES // max(bytes_a_line, 1)))


def finite_mean(values: Floats, axis: int) -> Floats:
    # Return the mean of finite values; NaN without finite values.
    is_finite = np.isfinite(values)
    count = is_finite.sum(axis=axis)
    total = np.where(is_finite, values, 0.0).sum(axis=axis)
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))


# --- range of daylight irradiance, and the unit mistakes that explain values outside it --------------------


#: Range of plausible median irradiance over 400-1000 nm [W m-2 nm-1]. Above the atmosphere the sun has a
#: maximum of 2.2 and a median of 1.5, and clouds add little more than the air absorbs; 3e-4 is deep
#: twilight, but more than full sun in W m-2 nm-1 that is declared as W cm-2 nm-1.
HIGHEST_MEDIAN, LOWEST_MEDIAN = 3.0, 3e-4

#: Median irradiance below which light is too weak for a flight [W m-2 nm-1]: an overcast sky at the lowest
#: usable sun gives 0.04.
DULL_MEDIAN = 0.02

#: Wavelengths at which a record is judged, where daylight exceeds the noise of spectrometers [nm].
JUDGED_NM = (400.0, 1000.0)
_UNIT_FACTORS = {
    "uW cm-2 nm-1": 1e-2, "mW m-2 nm-1 (W m-2 um-1)": 1e-3, "uW m-2 nm-1": 1e-6, "mW cm-2 nm-1": 10.0,
    "W cm-2 nm-1": 1e4,
}  # fmt: skip
_MAX_LOG_RATIO = math.log(3.0)


def brightest_median(wavelength: Floats, values: Floats) -> float:
    # Return the median over 400-1000 nm of the brightest sample; NaN without samples.
    #
    # wavelength: (irradiance_wavelength,) [nm]; values: (irradiance_time, irradiance_wavelength).
    samples = values[:, (wavelength >= JUDGED_NM[0]) & (wavelength <= JUDGED_NM[1])]
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
