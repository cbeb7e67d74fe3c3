"""Where the wavelength map puts the lines, which of them lie where they should, and how wide bands are."""

from __future__ import annotations

import numpy as np

from hyperpaint.base.arrays import Bools, Floats

from .lab_sweep import LabSweep
from .steps import Lines
from .wavelength_map import WavelengthMap, fit_width

__all__ = ["at_steps", "band_widths", "line_wavelengths", "placed_lines"]


_MISPLACED = 0.5  # nm from the wavelength map, beyond which a line's wavelength is not what is said

_ODD = 20.0  # times the step's usual chi2: several dead elements in one line
_ODD_WIDTH = 0.3  # of the step's usual width


def line_wavelengths(lines: Lines, surface: WavelengthMap, pull: Floats) -> Floats:
    """Return where the map puts the centres of the lines (step, cross_track) [nm], less the slope's pull."""
    columns = np.arange(lines.centre.shape[1])
    there = surface.at(np.nan_to_num(lines.centre), columns) - pull[:, None]
    return np.asarray(np.where(np.isfinite(lines.centre), there, np.nan))


def placed_lines(lab: LabSweep, lines: Lines, surface: WavelengthMap, pull: Floats) -> Bools:
    """Return the good fits (step, cross_track) that are like the others, and lie where the map says."""
    apart = np.abs(line_wavelengths(lines, surface, pull) - lab.wavelength[:, None])
    misfit = np.where(lines.trusted, lines.chi2 / lines.degrees, np.nan)
    width = np.where(lines.trusted, lines.own_width, np.nan)
    usual, usual_width = np.ones((len(apart), 1)), np.ones((len(apart), 1))
    rows = lines.trusted.any(axis=1)
    usual[rows, 0] = np.maximum(np.nanmedian(misfit[rows], axis=1), 1.0)
    usual_width[rows, 0] = np.nanmedian(width[rows], axis=1)
    with np.errstate(invalid="ignore"):
        like_others = (misfit < _ODD * usual) & (np.abs(width / usual_width - 1.0) < _ODD_WIDTH)
        return np.asarray(like_others & (apart < max(_MISPLACED, 6.0 * surface.residual)))


def band_widths(lab: LabSweep, lines: Lines, surface: WavelengthMap, placed: Bools) -> Floats:
    """Return the camera's own width of every band (band,) [nm] from those of the placed lines."""
    steps = np.flatnonzero(placed.any(axis=1))
    spacing = surface.spacing(np.nan_to_num(lines.centre), np.arange(lab.shape[2]))
    widths = np.where(placed, lines.own_width * spacing, np.nan)[steps]
    spread = np.where(placed, lines.own_width_u * spacing, np.nan)[steps]
    return fit_width(
        lab.wavelength[steps],
        np.nanmedian(widths, axis=1),
        np.nanmedian(spread, axis=1) / np.sqrt(placed[steps].sum(axis=1)),
        surface.at(np.arange(lab.shape[1]), lab.shape[2] // 2),
    )


def at_steps(lab: LabSweep, surface: WavelengthMap, of_bands: Floats) -> Floats:
    """Return what is known of the bands (band,) at the wavelengths of the steps (step,)."""
    centre = surface.at(np.arange(lab.shape[1]), lab.shape[2] // 2)
    order = np.argsort(centre)
    return np.interp(lab.wavelength, centre[order], of_bands[order])
