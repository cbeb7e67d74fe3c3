"""Structure of the responsivity between the lines of a sweep: fringes and etalons that its steps miss.

The areas of the lines show that there is a ripple, not whether they follow it: a fringe of 8 nm seen every
10 nm looks like one of 40. The places of the lines tell: light of variance v moves by v g where the
responsivity rises by g per nanometre, wherever the next line is.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hyperpaint.base.arrays import Floats


@dataclass(frozen=True)
class FringeRules:
    """What tells that the steps of a sweep are too wide.

    Attributes
    ----------
    least_error
        Relative error of the gain from which it is said [1].
    window_steps
        Steps over which departures are averaged: structure need not be everywhere.
    degree
        Of the polynomial of the logarithm over the whole sweep, beside which areas ripple: detectors and
        gratings change over some 60 nm and more.
    spread
        Error between lines over the root mean square of the ripple, where they have nothing to do with each
        other: root mean squares are as sqrt(0.82 + 1) = 1.35, a cubic's squared weights and the truth, over
        what the polynomial leaves of such a ripple, sqrt(1 - 10 / 61) = 0.91 for 61 lines. The largest error
        is up to twice that, less where bands average over fringes.
    """

    least_error: float = 0.01
    window_steps: int = 9
    degree: int = 9
    spread: float = 1.5

    @property
    def scatters(self) -> float:
        """Error from which it is said, in units of what columns differ in, as it is left in their median.

        It ripples like what lines miss, by `spread`; twice that is more than chance.
        """
        return 2.0 * self.spread


FRINGES = FringeRules()


class Between(NamedTuple):
    """Relative error of the gain between lines where it is largest [1], and the wavelength there [nm]."""

    error: float
    wavelength: float


def error_between_lines(wavelength: Floats, level: Floats, moved: Floats, source: Floats) -> Between | None:
    r"""Return how wrong the gain may be between lines; None where lines are too few to tell.

    ``level`` (step,): responsivity by the lines' areas, any scale, NaN where it is not known; ``moved``
    (step,): distance of the lines from the wavelengths of their light [nm]; ``source`` (step,): variance of
    the monochromator's line [nm2].

    With :math:`r` the ripple of the areas, :math:`r'` its slope as they have it and :math:`g` what that slope
    lacks of the one that moves lines, the error is :math:`s\,r \min(1, g^2 / r'^2)`, root mean squares
    over some steps, with :math:`s` the ``spread`` of `FringeRules`. A ripple that lines follow has the slope
    that moves them; of one that they miss, or that is none but the scatter of a power meter, the two have
    nothing in common. Noise of places counts as if it were such.
    """
    from scipy.interpolate import CubicSpline

    rules = FRINGES
    at = np.flatnonzero(np.isfinite(level) & (level > 0) & np.isfinite(moved))
    if at.size < 2 * rules.window_steps:
        return None
    nm, log = wavelength[at], np.log(level[at])
    place = 2.0 * (nm - nm[0]) / (nm[-1] - nm[0]) - 1.0
    rippling = log - np.polynomial.chebyshev.Chebyshev.fit(place, log, rules.degree)(place)
    slope = CubicSpline(nm, rippling).derivative()(nm)
    lacking = moved[at] / source[at] - CubicSpline(nm, log).derivative()(nm)
    for values in (slope, lacking):  # a spline's slope at its ends is a guess
        values[:2], values[-2:] = np.nan, np.nan
    missed = (_running(lacking) / np.maximum(_running(slope), 1e-12)) ** 2
    error = rules.spread * _running(rippling) * np.minimum(1.0, missed)
    worst = int(error.argmax())
    return Between(float(error[worst]), float(nm[worst]))


def level_scatter(nodes: Floats) -> float:
    """Return the relative uncertainty of the columns' median, from what columns (step, column) differ in [1].

    What a column differs in at all steps is its own; NaN marks what is not known.
    """
    with np.errstate(invalid="ignore", divide="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of columns and steps that are all NaN
        away = np.log(nodes)
        away = away - np.nanmedian(away, axis=0)
        away = away - np.nanmedian(away, axis=1, keepdims=True)
        number = np.maximum(np.isfinite(away).sum(axis=1), 1)
        scatter = 1.25 * 1.4826 * np.nanmedian(np.abs(away), axis=1) / np.sqrt(number)
    return float(np.nan_to_num(np.nanmax(scatter, initial=0.0)))


def _running(values: Floats) -> Floats:
    """Return the root mean square over some steps; of the ends that of what is there."""
    there, window = np.isfinite(values), np.ones(FRINGES.window_steps)
    total = np.convolve(np.where(there, values, 0.0) ** 2, window, "same")
    return np.asarray(np.sqrt(total / np.maximum(np.convolve(there, window, "same"), 1.0)))
