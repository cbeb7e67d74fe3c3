"""Assign irradiance samples to the lines that they light, by time.

Irradiance is linear in time between the two samples around a line. Lines outside the record, or in a gap of
it, are flagged: nothing is extrapolated. The data do not contain the offset between the clocks of camera and
spectrometer; `timing_sensitivity` bounds the error that it could cause.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.errors import Problems, SchemaError, TimeError
from hyperpaint.base.facts import convert
from hyperpaint.base.schema import (
    IRRADIANCE_TIME,
    IRRADIANCE_WAVELENGTH,
    Array,
    Floats,
    Floats32,
    Ints,
    Quality,
)

from .sun import solar_position

#: Relative change of the 400-1000 nm irradiance between two samples above which the light is unstable.
UNSTABLE_CHANGE = 0.02
LOW_SUN_ZENITH = 75.0
#: Error of clocks [s] that are not checked: GPS time taken for UTC is 18 s off, TAI 37 s.
UNKNOWN_CLOCK = 40.0
#: Relative change of irradiance within the clocks' uncertainty above which a line is timing sensitive.
TIMING_EFFECT = 0.01


@dataclass(frozen=True)
class LineLight:
    # Irradiance samples on either side of each line, with weight, age and flags.
    #: before, after (line,) int64: the samples on either side of the line
    before: Ints
    after: Ints
    weight: Floats  #: (line,) float64: of the later sample; NaN where the line has no light
    age: Floats32  #: (line,) float32: time to the nearest sample [s]
    #: (line,) float32: largest relative error of reflectance by an error of the clocks [1]; see
    #: `timing_sensitivity`
    sensitivity: Floats32
    flags: Array  #: (line,) uint16: bits of `Quality` that hold for the whole line


def line_light(
    time: Array,
    irradiance_time: Array,
    levels: Floats,
    max_gap: float | None = None,
    latitude: Array | None = None,
    longitude: Array | None = None,
    clock_uncertainty: float | None = None,
) -> LineLight:
    # Return the neighbours and weights of every line in an irradiance record.
    #
    # ``time`` (line,) is UTC at mid exposure, in any order, NaT for a line without data; ``irradiance_time``
    # (sample,) is UTC of the samples and must increase. ``levels`` (sample,) or (sample, interval) are the
    # irradiance of each sample, summed over 400-1000 nm or over intervals of it, any scale; NaN, zero or a
    # negative value marks a sample to leave out. ``max_gap`` is the longest interval that is interpolated
    # [s], 2.5 median intervals by default; without the camera's ``latitude`` and ``longitude`` (line,)
    # [degree] the sun's height is not judged; ``clock_uncertainty`` is how far the clocks of camera and
    # spectrometer may disagree [s], `UNKNOWN_CLOCK` by default.
    #
    # Raises `TimeError`: Irradiance times do not increase, are missing, or there is no valid sample. Raises
    # `SchemaError`: ``max_gap`` or ``clock_uncertainty`` is out of range.
    #
    # The weight is the quotient of two int64 intervals in nanoseconds, so that no bit of it depends on chunks
    # or on the distance to 1970.
    lines = np.asarray(time).astype("datetime64[ns]")
    samples = np.asarray(irradiance_time).astype("datetime64[ns]")
    check_irradiance_times(samples)
    problems = Problems("irradiance cannot be assigned to lines", SchemaError)
    if max_gap is not None and not max_gap > 0:
        problems.add(
            f"'irradiance_max_gap' is {max_gap:g} s", expected="a positive number", code="value-out-of-range"
        )
    if clock_uncertainty is not None and not 0 <= clock_uncertainty < 1e6:
        problems.add(
            f"'irradiance_clock_uncertainty' is {clock_uncertainty:g} s",
            expected="0 or more seconds",
            code="value-out-of-range",
        )
    problems.raise_if_any()
    levels = np.reshape(levels, (samples.size, -1))
    valid = np.flatnonzero((np.isfinite(levels) & (levels > 0.0)).all(axis=1))
    TimeError.raise_if(
        valid.size == 0, "the irradiance record holds no valid spectrum", code="irradiance-empty"
    )
    missing = np.isnat(lines)
    stamps, ticks = lines.astype(np.int64), samples[valid].astype(np.int64)
    stamps = np.where(missing, ticks[0], stamps)
    low = np.searchsorted(ticks, stamps, side="right") - 1
    outside = (low < 0) | (stamps > ticks[-1])
    low = np.clip(low, 0, max(ticks.size - 2, 0))
    high = np.minimum(low + 1, ticks.size - 1)
    since, interval = stamps - ticks[low], ticks[high] - ticks[low]
    weight = since / np.maximum(interval, 1)
    age = np.minimum(np.abs(since), np.abs(ticks[high] - stamps)) / 1e9
    if max_gap is None:
        max_gap = 2.5 * float(np.median(np.diff(ticks))) / 1e9 if ticks.size > 1 else 0.0
    gap = ~outside & (interval / 1e9 > max_gap) & (weight > 0.0) & (weight < 1.0)
    level = levels[valid].sum(axis=1)
    change = np.abs(level[high] - level[low]) / np.maximum(np.minimum(level[high], level[low]), 1e-30)
    has_no_light = outside | gap | missing
    max_offset = UNKNOWN_CLOCK if clock_uncertainty is None else clock_uncertainty
    sensitivity = timing_sensitivity(stamps, ticks, levels[valid], max_offset)
    sensitivity[has_no_light] = np.nan
    flags = np.zeros(lines.shape, np.uint16)
    flags[outside | gap] |= np.uint16(Quality.IRRADIANCE_GAP)
    flags[~outside & (change > UNSTABLE_CHANGE)] |= np.uint16(Quality.ILLUMINATION_UNSTABLE)
    flags[sensitivity > TIMING_EFFECT] |= np.uint16(Quality.TIMING_SENSITIVE)
    if latitude is not None and longitude is not None:
        zenith, _ = solar_position(lines, latitude, longitude)
        flags[np.nan_to_num(zenith, nan=0.0) > LOW_SUN_ZENITH] |= np.uint16(Quality.LOW_SUN)
    flags[missing] = Quality.NO_DATA
    return LineLight(
        valid[low].astype(np.int64),
        valid[high].astype(np.int64),
        np.where(has_no_light, np.nan, weight),
        np.where(missing, np.nan, age).astype(np.float32),
        sensitivity.astype(np.float32),
        flags,
    )


def timing_sensitivity(stamps: Array, ticks: Array, levels: Floats, within: float) -> Floats:
    r"""Return the largest relative error of each line's irradiance that clock errors could cause (line,) [1].

    ``stamps`` (line,) and ``ticks`` (sample,), which increase, are times of lines and samples, int64 [ns];
    ``levels`` (sample, interval) irradiances summed over intervals of wavelength, any scale; ``within`` is
    the largest offset between the clocks [s].

    Notes
    -----
    .. math:: \max_{k, |\delta| \le u} \exp \left| \ln \frac{E_k(t + \delta)}{E_k(t)} \right| - 1

    over the intervals :math:`k`, since a cloud dims the red more than the blue. Limited to the time of the
    record. A cloud's shadow also needs time from the spectrometer to the scene, which acts as a clock error
    does.

    Examples
    --------
    >>> ramp = np.array([[1.0], [1.0], [0.9], [0.9]])  # one sample a second
    >>> seconds = np.arange(4) * 10**9
    >>> timing_sensitivity(np.array([0, 10**9]), seconds, ramp, 0.5).round(4)
    array([0.    , 0.0526])
    """
    if len(ticks) < 2:
        return np.zeros(stamps.shape)
    logs = np.log(np.maximum(levels, 1e-30))
    empty = np.full(levels.shape[1], np.inf)
    offset = round(within * 1e9)
    at_early, at_stamp, at_late = (
        _log_level_at(ticks, levels, stamps + shift) for shift in (-offset, 0, offset)
    )
    # inside a window, extremes are at samples; many lines share a window
    first, last = (
        np.searchsorted(ticks, stamps - offset),
        np.searchsorted(ticks, stamps + offset, side="right"),
    )
    windows, window_of_line = np.unique(np.stack([first, last]), axis=1, return_inverse=True)
    extremes = np.array(
        [(logs[a:b].min(axis=0), logs[a:b].max(axis=0)) if b > a else (empty, -empty) for a, b in windows.T]
    )
    lowest, highest = np.moveaxis(extremes[window_of_line.ravel()], 1, 0)
    lowest, highest = (
        np.minimum(lowest, np.minimum(at_early, at_late)),
        np.maximum(highest, np.maximum(at_early, at_late)),
    )
    return np.asarray(np.expm1(np.maximum(at_stamp - lowest, highest - at_stamp).max(axis=1)))


def _log_level_at(ticks: Array, levels: Floats, stamps: Array) -> Floats:
    after = np.clip(np.searchsorted(ticks, stamps, side="right"), 1, ticks.size - 1)
    weight = np.clip((stamps - ticks[after - 1]) / (ticks[after] - ticks[after - 1]), 0.0, 1.0)[:, None]
    level = levels[after - 1] + weight * (levels[after] - levels[after - 1])
    return np.asarray(np.log(np.maximum(level, 1e-30)))


def channels_of(record: xr.DataArray) -> Floats:
    # Return the wavelengths of a record's channels [nm]; SchemaError where it has no such coordinate.
    SchemaError.raise_if(
        IRRADIANCE_WAVELENGTH not in record.coords,
        "'irradiance' has no coordinate 'irradiance_wavelength' [nm]",
        code="coordinate-missing",
    )
    channels = record[IRRADIANCE_WAVELENGTH]
    return (convert(channels, "nm") if "units" in channels.attrs else channels).values.astype(np.float64)


def check_irradiance_times(samples: Array) -> None:
    # Raise TimeError unless all stamps are present and increase.
    problems = Problems("irradiance times cannot be used", TimeError)
    problems.add_if(not samples.size, "irradiance_time has size 0: no sample is selected", code="empty-input")
    problems.add_if(
        np.isnat(samples).any(),
        f"{int(np.isnat(samples).sum())} of {samples.size} stamps are missing (NaT)",
        mend="drop them",
        code="time-missing",
    )
    steps = np.diff(samples.astype(np.int64))
    same, back = np.flatnonzero(steps == 0), np.flatnonzero(steps < 0)
    if same.size:
        problems.add(
            f"{same.size} duplicate stamps, first {samples[same[0]]}",
            mend="keep one spectrum of each",
            code="time-duplicate",
        )
    if back.size:
        problems.add(
            f"stamps run backwards at {samples[back[0] + 1]}",
            mend="sort them with .sortby('irradiance_time')",
            code="time-unordered",
        )
    problems.raise_if_any()


def replace_record(dataset: xr.Dataset, irradiance: Any) -> xr.Dataset:
    # Return the line with another irradiance record, attributes included, in place of its own.
    #
    # Raises `SchemaError`: ``irradiance`` is no Dataset, or lacks 'irradiance'.
    SchemaError.raise_if(
        not isinstance(irradiance, xr.Dataset),
        f"irradiance= is {type(irradiance).__name__}",
        expected=(
            "a Dataset with 'irradiance' and 'irradiance_fwhm', as hyperpaint.open_irradiance returns it"
        ),
        code="type-wrong",
    )
    names = [name for name in irradiance.data_vars if str(name).startswith("irradiance")]
    if "irradiance" not in names:
        contents = ", ".join(map(str, irradiance.data_vars)) or "nothing"
        raise SchemaError(
            f"the Dataset given as irradiance= holds {contents}",
            expected="'irradiance' and 'irradiance_fwhm'",
            code="variable-missing",
        )
    SchemaError.raise_if(
        IRRADIANCE_TIME not in irradiance["irradiance"].dims,
        f"the Dataset given as irradiance= has irradiance {tuple(map(str, irradiance['irradiance'].dims))}",
        expected=f"({IRRADIANCE_TIME}, {IRRADIANCE_WAVELENGTH})",
        mend="pass it through hyperpaint.open_irradiance(..., fwhm_nm=) first",
        code="dims-wrong",
    )
    old_names = [name for name in dataset.variables if str(name).startswith("irradiance")]
    line_attrs = {
        name: text for name, text in dataset.attrs.items() if not name.startswith(("irradiance", "alignment"))
    }
    record_attrs = {
        name: text for name, text in irradiance.attrs.items() if str(name).startswith("irradiance")
    }
    line = dataset.drop_vars(old_names).merge(irradiance[names], combine_attrs="override")
    line.attrs = {**line_attrs, **record_attrs}
    return line
