"""The clocks of camera and irradiance spectrometer, by clouds that both of them see.

Lines brighten and darken with what they show much more than with the light. But from one line to the next
most pixels show nearly what they showed before, so that the median over columns of the change is that of the
light, and of little else.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, NoReturn

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import TimeError
from hyperpaint.base.schema import ALONG_TRACK, IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH, require
from hyperpaint.light.synchrony import check_irradiance_times

from .pictures import picture_of

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["LightOffset", "light_offset"]


_WAVELENGTHS = (500.0, 850.0)
"""What pictures are of, too [nm]."""
_FLATTEST = 0.02
"""Relative change of the light over the line below which clocks cannot be compared."""
_BINS = 2.0
"""Bins an irradiance interval."""
_FEWEST_BINS = 12
_STEPS, _BLOCKS = 400, 12
"""Steps of the offset, and blocks of lines that are left out in turn."""
_CLEAR = 10.0
"""Logarithm of the likelihood over that of no change of the light at all."""
_FAR, _NEAREST = 5.0, 0.5
"""Standard deviations, and seconds, from which an offset that fits nearly as well is another one."""
_EPS = 1e-12


@dataclass(frozen=True)
class LightOffset:
    """What is to be added to the stamps of irradiance, and why.

    Attributes
    ----------
    offset, sd
        Offset and its standard uncertainty [s].
    evidence
        Why it is believed.
    offsets, misfit : (offset,)
        What was tried, and what it leaves over what is left of a light that does not change.
    """

    offset: float
    sd: float
    evidence: str
    offsets: Floats
    misfit: Floats


def light_offset(
    line: xr.Dataset,
    irradiance: xr.Dataset,
    image: xr.DataArray | None,
    lines: slice | None,
    most: float,
    loosest: float,
) -> LightOffset:
    """Return the offset at which the light and the brightness of lines change together.

    Raises
    ------
    TimeError
        It cannot be told; the reason is given.
    """
    part = line if lines is None else line.isel({ALONG_TRACK: lines})
    part_image = image if image is None or lines is None else image.isel({ALONG_TRACK: lines})
    asked = [IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH, "irradiance"]
    record = require(irradiance, asked, "a clock's offset")
    ticks = record[IRRADIANCE_TIME].values.astype("datetime64[ns]")
    check_irradiance_times(ticks)
    time = require(part, ["time"], "a clock's offset")["time"].values.astype("datetime64[ns]")
    start = ticks[0]
    samples, at = ((t - start).astype(np.int64) / 1e9 for t in (ticks, time))
    level = np.log(np.maximum(_level(record), _EPS))
    known = np.isfinite(level)
    samples, level = samples[known], level[known]
    if samples.size < 4:
        _refuse(f"the record has {samples.size} spectra")
    at, change = _changes(picture_of(part, part_image), at)
    width = float(np.median(np.diff(samples))) / _BINS
    edges = np.arange(at[0], at[-1], max(width, 3.0 * float(np.median(np.diff(at)))))
    if edges.size <= _FEWEST_BINS:
        _refuse(
            f"the line lasts {at[-1] - at[0]:.1f} s, expected {_FEWEST_BINS * width:.0f} s for this record"
        )
    seen = np.diff(np.interp(edges, at, np.concatenate([[0.0], np.cumsum(change)])))
    offsets = np.linspace(-most, most, _STEPS + 1)
    meant = np.full((offsets.size, seen.size), np.nan)
    for k, offset in enumerate(offsets):
        stamps = samples + offset
        if edges[0] >= stamps[0] and edges[-1] <= stamps[-1]:
            meant[k] = np.diff(np.interp(edges, stamps, level))
    covered = np.asarray(np.isfinite(meant).all(axis=1))
    if not covered.any():
        _refuse("the irradiance record does not cover the line, whatever the offset; look at dates and zones")
    swing = float(np.ptp(np.cumsum(meant[covered], axis=1), axis=1).max())
    if swing < _FLATTEST:
        _refuse(f"the light changes by {100 * swing:.1f} % over the line, expected {100 * _FLATTEST:.0f} %")
    return _best(offsets, seen, meant, covered, loosest)


def _best(
    offsets: Floats, seen: Floats, meant: Floats, covered: npt.NDArray[np.bool_], loosest: float
) -> LightOffset:
    """Return the best offset, unless it is none."""
    seen = seen - np.median(seen)
    centred = meant - meant.mean(axis=1, keepdims=True)
    scale = min(_scale(seen - m) for m in centred[covered])
    cost = np.full(meant.shape, np.nan)
    cost[covered] = _clipped(seen - centred[covered], scale)
    left, none = cost.mean(axis=1), float(_clipped(seen, scale).mean())
    best = int(np.nanargmin(left))
    residual = seen - centred[best]
    follows = float((residual[1:] * residual[:-1]).sum() / max((residual**2).sum(), _EPS))
    count = seen.size * (1.0 - max(follows, 0.0)) / (1.0 + max(follows, 0.0))
    odds = 0.5 * count * np.log(left / left[best])
    gain = 0.5 * count * np.log(none / left[best])
    if not gain > _CLEAR:
        _refuse(
            f"the brightness of lines does not follow the light (log odds {gain:.1f}, expected {_CLEAR:g})"
        )
    rivals = covered & (odds < 2.0)
    if rivals[0] or rivals[-1] or (rivals[1:-1] & ~(covered[2:] & covered[:-2])).any():
        _refuse(f"the best offset, {offsets[best]:+.2f} s, is at the end of those that the record allows")
    offset = _minimum(offsets, left)
    blocks = np.array_split(np.arange(seen.size), _BLOCKS)
    without = np.array([_minimum(offsets, cost.sum(axis=1) - cost[:, b].sum(axis=1)) for b in blocks])
    spread = np.sqrt((_BLOCKS - 1) / _BLOCKS * ((without - without.mean()) ** 2).sum())
    near = offsets[odds < 0.5]  # where a curve is a parabola, one standard deviation to either side
    sd = max(float(spread), float(np.ptp(near)) / 2.0, float(offsets[1] - offsets[0]) / 2.0)
    away = rivals & (np.abs(offsets - offsets[best]) > max(_FAR * sd, _NEAREST))
    if away.any():
        _refuse(f"{offsets[away][0]:+.2f} s fits nearly as well as {offsets[best]:+.2f} s")
    if sd > loosest:
        _refuse(f"it is {offset:+.2f} +- {sd:.2f} s, while {loosest:g} s is asked for")
    share = 100.0 * (1.0 - left[best] / none)
    told = f"the light explains {share:.0f} % of the changes of brightness, log odds {gain:.0f}"
    return LightOffset(offset, sd, told, offsets, np.sqrt(left / none))


def _minimum(offsets: Floats, cost: Floats) -> float:
    """Return where a cost is least, by a parabola through the least and its neighbours."""
    best = int(np.nanargmin(cost))
    if not 0 < best < offsets.size - 1 or not np.isfinite(cost[best - 1 : best + 2]).all():
        return float(offsets[best])
    low, mid, high = cost[best - 1 : best + 2]
    part = 0.5 * (low - high) / max(float(low + high - 2.0 * mid), _EPS)
    return float(offsets[best] + np.clip(part, -1.0, 1.0) * (offsets[1] - offsets[0]))


def _scale(values: Floats) -> float:
    return 1.4826 * float(np.median(np.abs(values))) + _EPS


def _clipped(values: Floats, scale: float) -> Floats:
    """Return squares, those of outliers held at that of four standard deviations."""
    return np.asarray(np.minimum(values**2, (4.0 * scale) ** 2))


def _level(irradiance: Mapping[str, xr.DataArray]) -> Floats:
    """Return the level of every spectrum (irradiance_time,), any scale."""
    wavelength = irradiance[IRRADIANCE_WAVELENGTH].values
    inside = (wavelength >= _WAVELENGTHS[0]) & (wavelength <= _WAVELENGTHS[1])
    chosen = np.flatnonzero(inside) if inside.any() else np.arange(wavelength.size)
    spectra = irradiance["irradiance"].transpose(IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH).values
    return np.asarray(spectra[:, chosen].mean(axis=1), np.float64)


def _changes(picture: npt.NDArray[np.float32], at: Floats) -> tuple[Floats, Floats]:
    """Return times of lines that have one, and the logarithm of the light's change from each to the next."""
    good = np.isfinite(at) & (np.abs(at) < 1e9)
    order = np.flatnonzero(good)[np.argsort(at[good], kind="stable")]
    values = picture[order].astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        steps = np.diff(np.log(np.where(values > 0, values, np.nan)), axis=0)
    empty = ~np.isfinite(steps).any(axis=1)
    steps[empty] = 0.0
    return at[order], np.asarray(np.nanmedian(steps, axis=1))


def _refuse(reason: str) -> NoReturn:
    raise TimeError(f"the clocks cannot be compared: {reason}")
