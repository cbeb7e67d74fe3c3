r"""From the areas of lamp lines to the gain of every element.

With :math:`R_b(\lambda) = R_0(\lambda)\,s(\lambda - \lambda_b)`, :math:`s` of unit area, a lamp line of
unit-area profile :math:`m` counts in all bands together, per energy that enters,

.. math:: \sum_b \int m\,R_b\,d\lambda = (m * R_0)(\lambda_k) / \delta

for any width and shape of :math:`m` and :math:`s`: the line-area identity (:math:`\delta` the spacing of
bands). The gain of a band needs :math:`\int R_b\,d\lambda = (s * R_0)(\lambda_b)`. To second order the two
differ by :math:`\tfrac12 (\sigma_s^2 - \sigma_m^2) R_0''`, which is taken from the sweep itself.

A sloping responsivity also shifts the lamp lines (`slope_shift_of_lines`). Where it rises by g per nanometre,
a Gaussian line of variance v is shifted by v g: a quarter of a nanometre for a line of 12 nm in the blue. A
triangle becomes asymmetric too, and its fit shifts by a little less than its centroid; the shift is therefore
computed by a fit.
"""

from __future__ import annotations

import numpy as np

from hyperpaint.base.arrays import Bools, Floats
from hyperpaint.kernels.arguments import LineSamples
from hyperpaint.kernels.line_fits import CENTRE, profiles

from .lab_sweep import LabSweep
from .line_fits import SHAPES, NoiseModel, fitted

_MAX_GAP_STEPS = 3.0  # median steps; wider gaps are not interpolated


def shape_variance(fwhm: Floats, shape: str, spacing: Floats | float = 0.0) -> Floats:
    """Return the variance of a line shape [nm2]: "gaussian", "triangle" (of equal slits) or "slit"."""
    if shape == "gaussian":
        return np.asarray(fwhm**2 / (8.0 * np.log(2.0)))
    if shape == "triangle":
        return np.asarray(fwhm**2 / 6.0)
    return np.asarray((fwhm**2 + np.square(spacing)) / 12.0)


def second_order_factor(
    wavelength: Floats, level: Floats, camera_variance: Floats, source_variance: Floats
) -> Floats:
    """Return the factor from the responsivity in a lamp line to that of a band at the same wavelength.

    ``wavelength`` (step,) [nm]; ``level`` (step,) is the responsivity from the lamp lines' areas at any
    scale, median of the columns, NaN where unknown; ``camera_variance`` and ``source_variance`` (step,) are
    those of the camera's line shape and of the monochromator's [nm2].
    """
    factor = np.ones_like(level)
    positive = np.flatnonzero(np.isfinite(level) & (level > 0))
    if positive.size < 5:
        return factor
    x, y = wavelength[positive], level[positive]
    step_before, step_after = np.diff(x)[:-1], np.diff(x)[1:]
    curvature = (
        2.0 * ((y[2:] - y[1:-1]) / step_after - (y[1:-1] - y[:-2]) / step_before) / (step_before + step_after)
    )
    relative_curvature = np.empty_like(y)
    relative_curvature[1:-1] = curvature / y[1:-1]
    relative_curvature[0], relative_curvature[-1] = relative_curvature[1], relative_curvature[-2]
    # smoothed, since noise of a second difference is six times that of the values
    smooth_curvature = np.convolve(
        np.pad(relative_curvature, 1, mode="edge"), [0.25, 0.5, 0.25], mode="valid"
    )
    factor[positive] = 1.0 + 0.5 * (camera_variance - source_variance)[positive] * smooth_curvature
    return np.clip(factor, 0.9, 1.1)


def monotone_slopes(x: Floats, y: Floats) -> Floats:
    """Return slopes at nodes ``x`` (node,) for interpolation of ``y`` (node, column) without ringing.

    Slopes of a cubic spline, of fourth order. Where curvature changes sign, they are limited
    as by Fritsch and Carlson (Hyman 1983), which keeps monotone pieces monotone.
    """
    from scipy.interpolate import CubicSpline

    if len(x) < 3:
        return np.repeat(np.diff(y, axis=0) / np.diff(x)[:, None], len(x), axis=0)
    slope = np.asarray(CubicSpline(x, y, axis=0).derivative()(x))
    secant = np.diff(y, axis=0) / np.diff(x)[:, None]
    secant_before, secant_after = np.vstack([secant[:1], secant]), np.vstack([secant, secant[-1:]])
    limit = 3.0 * np.minimum(np.abs(secant_before), np.abs(secant_after))
    limited = np.clip(slope, -limit, limit)
    limited = np.where((secant_before * secant_after > 0) & (limited * secant_before < 0), 0.0, limited)
    curvature = np.sign(np.diff(secant, axis=0))
    # concave or convex at a node and both its neighbours: a smooth extremum, not the foot of a step
    padded = np.vstack([curvature[:1], curvature[:1], curvature, curvature[-1:], curvature[-1:]])
    is_smooth = (padded[:-2] == padded[1:-1]) & (padded[1:-1] == padded[2:]) & (padded[1:-1] != 0)
    return np.asarray(np.where(is_smooth, slope, limited))


def interpolate_nodes(
    x: Floats, y: Floats, used: Bools, at: Floats, tolerance: float = 0.0
) -> tuple[Floats, Bools]:
    """Return each column's values (place, column) between its used nodes, and where they are finite.

    ``x`` (node,) increases; ``y`` and ``used`` (node, column): columns with fewer than four used nodes get
    nothing; ``at`` (place, column) may lie ``tolerance`` beyond the outer nodes. NaN beyond them and in gaps
    of over three steps.
    """
    values = np.full(at.shape, np.nan)
    patterns, member = np.unique(used, axis=1, return_inverse=True)
    max_gap = _MAX_GAP_STEPS * float(np.median(np.diff(x)))
    for index in range(patterns.shape[1]):
        nodes = np.flatnonzero(patterns[:, index])
        columns = np.flatnonzero(member.ravel() == index)
        if nodes.size < 4:
            continue
        x_used, y_used, place = x[nodes], y[np.ix_(nodes, columns)], at[:, columns]
        place = np.where((place < x_used[0]) & (place >= x_used[0] - tolerance), x_used[0], place)
        place = np.where((place > x_used[-1]) & (place <= x_used[-1] + tolerance), x_used[-1], place)
        # cubic Hermite polynomials between the nodes
        left = np.clip(np.searchsorted(x_used, place, side="right") - 1, 0, len(x_used) - 2)
        width = np.diff(x_used)[left]
        u = (place - x_used[left]) / width
        slope, column = monotone_slopes(x_used, y_used), np.arange(columns.size)
        y0, y1 = y_used[left, column], y_used[left + 1, column]
        m0, m1 = slope[left, column] * width, slope[left + 1, column] * width
        cubic = y0 * (1 + 2 * u) * (1 - u) ** 2 + m0 * u * (1 - u) ** 2
        cubic += y1 * u**2 * (3 - 2 * u) + m1 * u**2 * (u - 1)
        values[:, columns] = np.where((u >= 0) & (u <= 1) & (width <= max_gap), cubic, np.nan)
    return values, np.isfinite(values)


def element_gain(
    step_wavelength: Floats,
    node: Floats,
    used: Bools,
    wavelength: Floats,
    etendue: Floats,
    tolerance: float = 0.0,
) -> tuple[Floats, Bools]:
    """Return the gain of every element [W m-2 sr-1 nm-1 s count-1], and whether it is known.

    NaN where it would be extrapolated. ``node`` (step, cross_track) is the responsivity of a band times
    spacing, the integral of its response [count nm J-1], of the steps ``used`` there; ``step_wavelength``
    (step,) and ``wavelength`` (band, cross_track) of the elements [nm]; ``etendue`` (cross_track,) [m2 sr].
    Within the ``tolerance``, the uncertainty of the wavelengths [nm], an element counts as on the outer step.
    """
    log = np.log(np.where(used & (node > 0), node, 1.0))
    log_gain, finite = interpolate_nodes(step_wavelength, log, used & (node > 0), wavelength, tolerance)
    return np.asarray(np.exp(-log_gain) / etendue), finite


_PARTS = 161  # points of the monochromator's line
_REACH = {True: 1.0, False: 2.2}  # half support of a triangle and of a Gaussian in full widths


def slope_shift_of_lines(
    lab: LabSweep,
    noise: NoiseModel,
    slope: Floats,
    camera_width: Floats,
    spacing: Floats,
    amplitude: Floats,
    shape: str,
) -> Floats:
    """Return by how much a sloping responsivity shifts the centres of the lamp lines (step,) [nm].

    ``slope`` (step,) is d ln responsivity / d wavelength [nm-1]; ``camera_width``, ``spacing`` and
    ``amplitude`` (step,) are the width of the camera's line [nm], the spacing of the bands [nm] and the
    height of the line [count]; ``shape`` is the camera's line shape, ``noise`` weights the fits.
    """
    curvature = np.gradient(slope, lab.wavelength)
    shifts = np.zeros(len(slope))
    for step, source in enumerate(lab.width):
        offset = np.linspace(-1.0, 1.0, _PARTS) * _REACH[lab.triangular] * source
        light = (
            np.maximum(1.0 - np.abs(offset) / source, 0.0)
            if lab.triangular
            else np.exp(-4.0 * np.log(2.0) * (offset / source) ** 2)
        )
        light *= np.exp(slope[step] * offset + 0.5 * curvature[step] * offset**2)
        # a lamp line of this light in units of bands, and the shift of its fitted centre
        place, width, slit = (nm / spacing[step] for nm in (offset, camera_width[step], source))
        half = int(np.ceil(2.2 * np.hypot(width, slit) + 2.0))
        bands = np.arange(-half, half + 1, dtype=np.float64)
        parts = np.empty((_PARTS, bands.size))
        widths, zeros = np.full(_PARTS, width), np.zeros(_PARTS)
        profiles(bands - place[:, None], widths, zeros, SHAPES[shape], False, parts)
        line = (light / light.sum()) @ parts
        line *= amplitude[step] / line.max()
        variance = noise.variance(line, float(lab.frames[step])) + (1e-4 * amplitude[step]) ** 2
        samples = LineSamples(line[None], 1.0 / variance[None], np.array([-half]), np.array([slit]))
        start = np.array([[0.0, width, line.sum(), 0.0]])
        fits = fitted(samples, SHAPES[shape], lab.triangular, start)
        shifts[step] = spacing[step] * (fits.parameters[0, CENTRE] if fits.converged[0] else 0.0)
    return shifts
