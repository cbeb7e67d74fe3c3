"""Where in the spectrum to look, and what several windows tell together."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

from hyperpaint.base.arrays import Array, Floats
from hyperpaint.base.errors import Problems, SchemaError

from .declared import Declared
from .least_squares import RESIDUAL_FLOOR, Fit, fewest_bands

__all__ = [
    "FLAGS",
    "Estimate",
    "Window",
    "bands_of",
    "checked_windows",
    "combined",
    "default_windows",
    "estimate",
]

Window = tuple[float, float]

WINDOWS = ((740.0, 800.0), (890.0, 985.0))
"""Where to look [nm]: the oxygen A band and the water around 940 nm, without vegetation's red edge."""
_RECORD_MARGIN = 15.0
"""How far beyond a window the irradiance record must reach to be used unasked [nm]."""
FLAGS = {"no_data": 1, "too_noisy": 2, "at_limit": 4, "record_too_coarse": 8}
"""Why a column cannot tell."""
MAX_NOISE_GAIN = 3.0
_SAME_NOISE = 3.0
"""Ratio of the windows' variances up to which they are taken for one."""


def default_windows(declared: Declared, degree: int) -> list[Window]:
    """Return those of `WINDOWS` that camera and record have; the first where they have none."""
    channels = declared.light.wavelength
    there = [
        (low, high)
        for low, high in WINDOWS
        if _inside(declared, low, high).sum() >= fewest_bands(degree)
        and channels.min() <= low - _RECORD_MARGIN
        and channels.max() >= high + _RECORD_MARGIN
    ]
    return there or [*WINDOWS[:1]]


def _inside(declared: Declared, low: float, high: float) -> Array:
    """Return which good bands lie in a window, (band,) bool."""
    return declared.good & (declared.wavelength >= low) & (declared.wavelength <= high)


def checked_windows(window: Any) -> list[Window]:
    """Return the windows, in the order given, or raise."""
    problems = Problems(f"window={window!r} cannot be used", SchemaError)
    try:
        given = np.asarray(window, np.float64)
    except (TypeError, ValueError):  # texts, or pairs of unlike lengths
        given = np.empty(0)
    if given.ndim not in (1, 2) or given.shape[-1] != 2 or not given.size:
        problems.add("expected a lowest and a highest wavelength [nm], or several such pairs")
        problems.raise_if_any()
    pairs = [(float(low), float(high)) for low, high in np.atleast_2d(given)]
    for low, high in pairs:
        if not (np.isfinite([low, high]).all() and low < high):
            problems.add(f"({low:g}, {high:g}): the lowest wavelength must be below the highest [nm]")
    in_order = sorted(pairs)
    for (_, high), (low, _) in itertools.pairwise(in_order):
        if low < high:
            problems.add(f"windows overlap from {low:g} to {high:g} nm")
    problems.raise_if_any()
    return pairs


def bands_of(windows: list[Window], declared: Declared, degree: int) -> list[Array]:
    """Return which good bands lie in each window, (band,) bool."""
    chosen = [_inside(declared, low, high) for low, high in windows]
    fewest = fewest_bands(degree)
    problems = Problems("the alignment cannot be found", SchemaError)
    for (low, high), inside in zip(windows, chosen, strict=True):
        if inside.sum() < fewest:
            problems.add(
                f"{low:g} to {high:g} nm holds {inside.sum()} good bands, expected at least {fewest} for "
                f"a polynomial of degree {degree}, shift and width; widen the window or lower degree="
            )
    problems.raise_if_any()
    return chosen


@dataclass(frozen=True)
class Estimate:
    """Shift [nm] and width factor [1] of every column with their covariance, and what goes with them."""

    value: Floats  # (column, 2)
    covariance: Floats  # (column, 2, 2)
    shift: Floats  # (column,), declared [nm]
    fwhm: float  # declared [nm]
    centre: float  # mean wavelength of the bands [nm]
    residual: Floats
    residual_declared: Floats
    freedom: Array
    flag: Array
    chi2: Floats


def estimate(fit: Fit, inside: Array, declared: Declared, shift: Floats) -> Estimate:
    """Return what one window tells; its flags but that of noise, which is for the mean to decide."""
    flag = np.where(np.isfinite(fit.shift), 0, FLAGS["no_data"])
    flag |= np.where(fit.at_limit, FLAGS["at_limit"], 0)
    with np.errstate(invalid="ignore"):
        flag |= np.where(fit.noise_gain > MAX_NOISE_GAIN, FLAGS["record_too_coarse"], 0)
        common = fit.correlation * fit.shift_u * fit.factor_u
        covariance = np.array([[fit.shift_u**2, common], [common, fit.factor_u**2]])
    return Estimate(
        value=np.stack([fit.shift, fit.factor], axis=1),
        covariance=np.moveaxis(covariance, -1, 0),
        shift=shift[inside].mean(axis=0),
        fwhm=float(declared.fwhm[inside].mean()),
        centre=float(declared.wavelength[inside].mean()),
        residual=fit.residual,
        residual_declared=fit.residual_declared,
        freedom=fit.freedom,
        flag=flag.astype(np.uint8),
        chi2=np.full(fit.shift.shape, np.nan),
    )


def combined(windows: list[Estimate]) -> Estimate:
    """Return the mean of the windows that can tell, weighted with the inverse of their covariances."""
    value = np.stack([each.value for each in windows])
    covariance = np.stack([each.covariance for each in windows])
    flag = np.stack([each.flag for each in windows])
    is_reliable = (flag == 0) & np.isfinite(covariance).all(axis=(2, 3))
    covariance = covariance * _one_noise(windows, is_reliable)[..., None, None]
    # where no window can tell, the first says why
    is_reliable[0] |= ~is_reliable.any(axis=0)
    plain = np.where(is_reliable[..., None, None] & np.isfinite(covariance), covariance, np.eye(2))
    weight = np.where(is_reliable[..., None, None], np.linalg.inv(plain), 0.0)
    total = np.linalg.inv(weight.sum(axis=0))
    seen = np.where(is_reliable[..., None], value, 0.0)
    mean = np.einsum("xij,wxjk,wxk->xi", total, weight, seen)
    away = seen - mean
    chi2 = np.einsum("wxi,wxij,wxj->x", away, weight, away)
    freedom = 2 * (is_reliable.sum(axis=0) - 1)
    # of a single window, its own
    single, only, columns = (
        is_reliable.sum(axis=0) == 1,
        np.argmax(is_reliable, axis=0),
        np.arange(is_reliable.shape[1]),
    )
    own_freedom = np.stack([each.freedom for each in windows])
    return Estimate(
        value=mean,
        covariance=np.where(single[:, None, None], covariance[only, columns], total),
        shift=np.mean(np.stack([each.shift for each in windows]), axis=0),
        fwhm=float(np.mean([each.fwhm for each in windows])),
        centre=float(np.mean([each.centre for each in windows])),
        residual=_pooled(windows, is_reliable, "residual"),
        residual_declared=_pooled(windows, is_reliable, "residual_declared"),
        freedom=np.where(is_reliable, own_freedom, 0).sum(axis=0),
        flag=np.where(single, flag[only, columns], 0).astype(np.uint8),
        chi2=np.where(freedom > 0, chi2 / np.maximum(freedom, 1), np.nan),
    )


def _pooled(windows: list[Estimate], is_reliable: Array, name: str) -> Floats:
    """Return a residual (column,) over the windows that can tell."""
    freedom = np.where(is_reliable, np.stack([each.freedom for each in windows]), 0)
    square = np.where(is_reliable, np.stack([getattr(each, name) for each in windows]) ** 2, 0.0)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt((freedom * square).sum(axis=0) / freedom.sum(axis=0)))


def _one_noise(windows: list[Estimate], is_reliable: Array) -> Floats:
    """Return the pooled variance over each window's own (window, column); 1 where they differ too much.

    Variances from a few tens of bands are uncertain by a third, and would make weights as uncertain.
    """
    own = np.where(
        is_reliable, np.stack([np.maximum(each.residual, RESIDUAL_FLOOR) for each in windows]) ** 2, np.nan
    )
    pooled = np.maximum(_pooled(windows, is_reliable, "residual"), RESIDUAL_FLOOR) ** 2
    with np.errstate(invalid="ignore", all="ignore"):
        largest, least = (np.where(is_reliable, own, end) for end in (-np.inf, np.inf))
        alike = largest.max(axis=0) <= _SAME_NOISE * least.min(axis=0)
        return np.asarray(np.where(is_reliable & alike, pooled / own, 1.0))
