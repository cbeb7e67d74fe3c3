"""Lines at the edge of the array, of which a side is missing, completed by what is known of them.

Four parameters cannot be told from half a line. Where the wavelength map says the line lies, and the
neighbours say how wide it is, its height alone is left, and the area follows.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Floats
from hyperpaint.kernels.line_fits import AREA, profiles

from .lab_sweep import LabSweep
from .line_fits import SHAPES, Window
from .steps import Lines, Read
from .wavelength_map import WavelengthMap

__all__ = ["complete_edge_lines"]


_LEAST_SEEN = 0.3  # of a line's area
_DEVIANT = 0.15  # of a line's height: a sample this far from the completed line says that it is another
_OWN_WIDTH_U = 0.005  # relative uncertainty of the width at the edge, where no line has told it


def complete_edge_lines(
    lab: LabSweep, read: Read, lines: Lines, surface: WavelengthMap, light: Floats, fwhm: Floats, shape: str
) -> None:
    """Fit the heights of lines that are cut off by the edge of the array, and mark them as completed.

    Parameters
    ----------
    lab, read, lines, surface
        The sweep and what has been found; ``lines`` is changed.
    light : (step,)
        Wavelengths at which the camera sees the lines [nm].
    fwhm : (step,)
        The camera's own width there [nm].
    shape
        Line shape of the camera.
    """
    for step, window in enumerate(read.windows):
        if window is None:
            continue
        cut = (window.first < 0) | (window.first + window.values.shape[1] > lab.shape[1])
        cut &= ~lines.trusted[step, window.columns] & ~window.saturated
        if cut.any():
            centre = surface.band_of(float(light[step]), window.columns)
            _complete(lab, read, lines, surface, step, window, cut, centre, float(fwhm[step]), shape)


def _complete(
    lab: LabSweep, read: Read, lines: Lines, surface: WavelengthMap, step: int, window: Window,
    cut: npt.NDArray[np.bool_], centre: Floats, fwhm: float, shape: str,
) -> None:  # fmt: skip
    spacing = surface.spacing(centre, window.columns)
    width, source = fwhm / spacing, lab.width[step] / spacing
    frames = float(lab.frames[step])

    def profile(moved: float, wider: float) -> Floats:
        out = np.empty(window.values.shape)
        distance = window.places - (centre + moved)[:, None]
        profiles(distance, width * wider, source, SHAPES[shape], lab.triangular, out)
        return out

    known = np.isfinite(window.values)
    values = np.where(known, window.values, 0.0)
    unit = np.where(known, profile(0.0, 1.0), 0.0)
    variance = read.noise.variance(values, frames) + (1e-4 * values.max(axis=1, keepdims=True)) ** 2
    weight = np.where(known, 1.0 / np.maximum(variance, 1e-300), 0.0)
    norm = np.maximum((weight * unit**2).sum(axis=1), 1e-300)

    def area_of(shape_of: Floats) -> Floats:
        shape_of = np.where(known, shape_of, 0.0)
        height = (weight * shape_of * values).sum(axis=1)
        return np.asarray(height / np.maximum((weight * shape_of**2).sum(axis=1), 1e-300))

    fitted = area_of(unit)
    seen = unit.sum(axis=1)
    area = values.sum(axis=1) + (1.0 - seen) * fitted
    # what the place and the width are not known to, the area is not known to either
    by_place = (1.0 - seen) * (area_of(profile(1e-3, 1.0)) - fitted) / 1e-3
    by_place -= (profile(1e-3, 1.0) * known - unit).sum(axis=1) * fitted / 1e-3
    by_width = (1.0 - seen) * (area_of(profile(0.0, 1.0 + 1e-3)) - fitted) / 1e-3
    by_width -= (profile(0.0, 1.0 + 1e-3) * known - unit).sum(axis=1) * fitted / 1e-3
    noise = np.where(known, read.noise.variance(values, frames), 0.0).sum(axis=1) + (1.0 - seen) ** 2 / norm
    total = noise + (by_place * surface.residual / spacing) ** 2 + (by_width * _OWN_WIDTH_U) ** 2
    apart = np.abs(np.where(known, values - fitted[:, None] * unit, 0.0))
    height = np.abs(fitted) * profile(0.0, 1.0).max(axis=1)
    # one free parameter: what is not noise is a dead element, or a line elsewhere
    far = apart > np.maximum(8.0 * np.sqrt(variance), _DEVIANT * height[:, None])
    done = cut & (seen >= _LEAST_SEEN) & (fitted > 0) & np.isfinite(total) & ~far.any(axis=1)
    at = (step, window.columns[done])
    lines.area[at] = area[done]
    lines.area_u[at] = np.sqrt(total[done]) / area[done]
    lines.centre[at] = centre[done]
    lines.completed[at] = True
    lines.covariance[(*at, AREA, AREA)] = total[done]
