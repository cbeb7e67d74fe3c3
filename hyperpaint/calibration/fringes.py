"""Structure of the responsivity between the lamp lines of a sweep: fringes and etalons that its steps miss.

The areas of the lamp lines show a ripple, but not whether the steps resolve it: a fringe of 8 nm sampled
every 10 nm looks like one of 40. The places of the lamp lines do: light of variance v moves by v g where the
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
    """Thresholds beyond which the steps of a sweep are too wide.

    Attributes
    ----------
    least_error
        Relative error of the gain from which it is reported [1].
    window_steps
        Steps over which departures are averaged: structure need not be everywhere.
    degree
        Of the polynomial of the logarithm over the whole sweep, around which areas ripple: detectors and
        gratings change over some 60 nm and more.
    spread
        Error between lamp lines over the root mean square of the ripple, where they are independent:
        root mean squares are as sqrt(0.82 + 1) = 1.35, a cubic's squared weights and the truth, over
        the residual of such a ripple after the polynomial, sqrt(1 - 10 / 61) = 0.91 for 61 lines. The largest
        error is up to twice that, less where bands average over fringes.
    """

    least_error: float = 0.01
    window_steps: int = 9
    degree: int = 9
    spread: float = 1.5

    @property
    def scatters(self) -> float:
        """Error from which it is reported, in units of the scatter of the columns' median.

        That scatter ripples like missed structure, by `spread`; twice that exceeds chance.
        """
        return 2.0 * self.spread


FRINGES = FringeRules()


class Between(NamedTuple):
    """Relative error of the gain between lines where it is largest [1], and the wavelength there [nm]."""

    error: float
    wavelength: float


def error_between_lines(wavelength: Floats, level: Floats, moved: Floats, source: Floats) -> Between | None:
    r"""Return the largest error of the gain between lamp lines; None where they are too few.

    ``level`` (step,): responsivity by the lines' areas, any scale, NaN where unknown; ``moved``
    (step,): distance of the lines from the wavelengths of their light [nm]; ``source`` (step,): variance of
    the monochromator's line [nm2].

    With :math:`r` the ripple of the areas, :math:`r'` its slope and :math:`g` the difference of that slope to
    the slope that moves lines, the error is :math:`s\,r \min(1, g^2 / r'^2)`, root mean squares over some
    steps, with :math:`s` the ``spread`` of `FringeRules`. A ripple that the steps resolve has the slope that
    moves the lines; a ripple that they miss, or the scatter of a power meter, is unrelated to it. Noise of
    places counts as such.
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
    """Return the relative uncertainty of the columns' median, from differences of columns (step, column) [1].

    Differences that a column has at all steps are its own; NaN marks unknown values.
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
    # Root mean square over some steps; near the ends over the existing ones
    there, window = np.isfinite(values), np.ones(FRINGES.window_steps)
    total = np.convolve(np.where(there, values, 0.0) ** 2, window, "same")
    return np.asarray(np.sqrt(total / np.maximum(np.convolve(there, window, "same"), 1.0)))
