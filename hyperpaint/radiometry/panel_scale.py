"""Interpolate the scale of panels, seen at some times, to all lines of a flight line."""

from __future__ import annotations

import warnings

import numpy as np

from hyperpaint.base.arrays import Array, Floats
from hyperpaint.base.errors import PaintWarning, SchemaError

from .panel_judging import RULES, PanelClosure


def usable_panels(closure: PanelClosure) -> Array:
    """Return the indices of panels that are not refused.

    Raises SchemaError: All are refused. Warns PaintWarning: Some are refused and left out.
    """
    refused = [reason for reason in closure.reasons if reason]
    if len(refused) == len(closure.reasons):
        raise SchemaError(
            f"the panel is refused: {'; '.join(dict.fromkeys(refused))}",
            mend="see hyperpaint.radiometry.panel_closure; outline another part of it, give its attitude, "
            "Panel(..., tilt=(angle, azimuth)), or its uncertainty, Panel(..., uncertainty=0.05), or leave "
            "out panel=",
            option="under [[panels]] of the collect.toml give another part of it (along_track, cross_track), "
            "its attitude, tilt = [angle, azimuth], or its uncertainty, uncertainty = 0.05, or leave it out",
            code="panel-refused",
        )
    if refused:
        text = f"{len(refused)} of {len(closure.reasons)} panels are refused and left out: {refused[0]}"
        warnings.warn(PaintWarning(text, code="panel-refused"), stacklevel=2)
    return np.flatnonzero([not reason for reason in closure.reasons])


def panel_correction(closure: PanelClosure, time: Array) -> tuple[Floats, Floats, Floats]:
    r"""Return logarithms of panels' scales (panel, band), weights (line, panel), and the level's uncertainty.

    Last is the relative standard uncertainty of the level of every line (line,) [1], without the uncertainty
    of the panels' own reflectance. All panels of ``closure`` count; ``time`` is UTC of the lines, NaT for
    unknown.

    Ordinary kriging: the record's error is modelled as a random walk of variance q a second, observed by
    panels with an error each. Between two panels the weights are linear in time where the panels differ by
    more than their errors, and equal where they do not; before the first and after the last panel its scale
    is held.

    .. math:: q = \frac{\sum_j \left[(\Delta_j \ln F)^2 - u_j^2 - u_{j+1}^2\right]_+}{\sum_j \Delta_j t}
    """
    # variance of the random walk, from the steps between panels
    scale = _filled(np.log(closure.scale))
    error = np.hypot(np.nanmedian(closure.mean_u, axis=1), RULES.repeatability)
    ticks = (closure.time - closure.time[0]) / np.timedelta64(1, "s")
    order = np.argsort(ticks, kind="stable")
    steps = np.nanmedian(np.abs(np.diff(scale[order], axis=0)), axis=1) ** 2
    span = float(np.ptp(ticks))
    excess = np.maximum(steps - error[order][1:] ** 2 - error[order][:-1] ** 2, 0.0)
    walk = float(excess.sum()) / span if span > 0.0 else 0.0
    # kriging system, and its solution for every line
    number = len(ticks)
    system = np.ones((number + 1, number + 1))
    system[:-1, :-1] = -0.5 * walk * np.abs(ticks[:, None] - ticks) + np.diag(error**2)
    system[-1, -1] = 0.0
    dated = ~np.isnat(time)
    at = np.where(dated, time - closure.time[0], np.timedelta64(0, "ns")) / np.timedelta64(1, "s")
    right = np.ones((number + 1, at.size))
    right[:-1] = -0.5 * walk * np.abs(at - ticks[:, None])
    solved = np.linalg.inv(system) @ right
    variance = -(solved * right).sum(axis=0)
    return scale, np.ascontiguousarray(solved[:-1].T), np.sqrt(np.maximum(variance, 0.0))


def scale_of_factors(factor: Floats, weight: Floats, refused: Array) -> tuple[Floats, Floats | None]:
    """Return the scale of a line from the stored factors of its panels, as a `Plan` has it.

    ``factor`` (panel, band), ``weight`` (line, panel), ``refused`` (panel,). One usable panel gives its scale
    (band,) and None; several give logarithms of their scales (panel, band) and their weights (line, panel).
    """
    scale = 1.0 / np.asarray(factor, np.float64)[~refused]
    if len(scale) == 1:
        return scale[0], None
    return _filled(np.log(scale)), np.ascontiguousarray(weight[:, ~refused], np.float64)


def _filled(scale: Floats) -> Floats:
    # Scales (panel, band) with refused bands filled from other panels, at the panel's own level
    valid = np.isfinite(scale)
    if valid.all():
        return scale
    number, level = valid.sum(axis=0), np.zeros(len(scale))
    # alternate between a shape of all panels and a level of each
    for _ in range(100):
        shape = np.where(valid, scale - level[:, None], 0.0).sum(axis=0) / np.where(
            number > 0, number, np.nan
        )
        level = np.nanmedian(scale - shape, axis=1)
    return np.where(valid, scale, shape + level[:, None])


def scale_of_lines(scale: Floats, weights: Floats) -> Floats:
    """Return the scale of lines (line, band) from logarithms of panels' scales and weights of the lines."""
    # panel by panel, so that no bit depends on how lines are grouped
    total = np.zeros((len(weights), scale.shape[1]))
    for panel, weight in zip(scale, weights.T, strict=True):
        total += weight[:, None] * panel
    return np.exp(total)
