"""How far a sloping responsivity moves a line: found by fitting lines that are made with that slope.

The camera sees the light m(lambda) R0(lambda). Where R0 rises by g per nanometre, a Gaussian line of
variance v moves by v g: a quarter of a nanometre for one 12 nm wide in the blue. A triangle becomes lopsided
besides, and its fit moves by a little less than its centroid; so the fit itself is asked.
"""

from __future__ import annotations

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.kernels.line_fits import CENTRE, fit_lines, profiles

from .lab_sweep import LabSweep
from .line_fits import SHAPES, NoiseModel

__all__ = ["line_pull"]


_PARTS = 161  # of the light's line
_REACH = {True: 1.0, False: 2.2}  # half support of a triangle and of a Gaussian in full widths


def line_pull(
    lab: LabSweep,
    noise: NoiseModel,
    slope: Floats,
    own: Floats,
    spacing: Floats,
    amplitude: Floats,
    shape: str,
) -> Floats:
    """Return by how much the lines of a sweep are found beyond the wavelengths of their light (step,) [nm].

    Parameters
    ----------
    lab, noise
        The sweep, and the weights of its fits.
    slope : (step,)
        d ln responsivity / d wavelength [nm-1].
    own, spacing, amplitude : (step,)
        Width of the camera's line [nm], spacing of the bands [nm] and height of the line [count].
    shape
        Line shape of the camera.
    """
    bend = np.gradient(slope, lab.wavelength)
    pulled = np.zeros(len(slope))
    for step, source in enumerate(lab.width):
        offset = np.linspace(-1.0, 1.0, _PARTS) * _REACH[lab.triangular] * source
        light = (
            np.maximum(1.0 - np.abs(offset) / source, 0.0)
            if lab.triangular
            else np.exp(-4.0 * np.log(2.0) * (offset / source) ** 2)
        )
        light *= np.exp(slope[step] * offset + 0.5 * bend[step] * offset**2)
        pulled[step] = spacing[step] * _fitted(
            offset / spacing[step], light / light.sum(), own[step] / spacing[step], source / spacing[step],
            lab, noise, float(lab.frames[step]), amplitude[step], SHAPES[shape],
        )  # fmt: skip
    return pulled


def _fitted(
    offset: Floats, light: Floats, own: float, source: float, lab: LabSweep, noise: NoiseModel, frames: float,
    amplitude: float, shape: int,
) -> float:  # fmt: skip
    """Return where the fit puts a line of such light that is centred at zero [band]."""
    half = int(np.ceil(2.2 * np.hypot(own, source) + 2.0))
    place = np.arange(-half, half + 1, dtype=np.float64)
    parts = np.empty((len(offset), place.size))
    width, none = np.full(len(offset), own), np.zeros(len(offset))
    profiles(place - offset[:, None], width, none, shape, False, parts)
    line = light @ parts
    line *= amplitude / line.max()
    variance = noise.variance(line, frames) + (1e-4 * amplitude) ** 2
    parameters = np.array([[0.0, own, line.sum(), 0.0]])
    covariance, chi2, converged = np.empty((1, 4, 4)), np.empty(1), np.zeros(1, np.bool_)
    fit_lines(
        line[None], 1.0 / variance[None], np.array([-half]), np.array([source]), shape, lab.triangular,
        parameters, covariance, chi2, converged,
    )  # fmt: skip
    return float(parameters[0, CENTRE]) if converged[0] else 0.0
