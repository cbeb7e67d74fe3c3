"""Least-squares fits of lamp lines, one after the other."""

import math

import numpy as np

from hyperpaint.base import Array
from hyperpaint.base.jit import kernel

from .arguments import LineFits, LineSamples

#: Positions of the parameters of a lamp line: centre [samples], full width at half maximum of the
#: instrument's own response [samples], area [value x samples], offset [value].
CENTRE, WIDTH, AREA, OFFSET = 0, 1, 2, 3

#: Shapes of the instrument's own response.
GAUSSIAN, SLIT = 0, 1

_SIGMA = 1.0 / (2.0 * math.sqrt(2.0 * math.log(2.0)))
_ROOT2 = math.sqrt(2.0)
_ROOT2PI = math.sqrt(2.0 * math.pi)
_MIN_BOX_SAMPLES = 0.05  # [sample]; narrower boxes have no effect
_MAX_STEPS = 60


@kernel
def _ramp(x: float, sigma: float) -> float:
    # Second integral of a Gaussian of unit area; for sigma 0, max(x, 0).
    if sigma < 1e-6 or abs(x) > 8.0 * sigma:
        return max(x, 0.0)
    z = x / sigma
    return float(0.5 * x * (1.0 + math.erf(z / _ROOT2)) + sigma * math.exp(-0.5 * z * z) / _ROOT2PI)


@kernel
def _two_boxes(x: float, a: float, b: float, sigma: float) -> float:
    # A Gaussian convolved with boxes ``a`` and ``b`` wide, of unit area.
    x = -abs(x)  # the ramps are small on the rising side: no cancellation of large terms
    outer, inner = 0.5 * (a + b), 0.5 * (a - b)
    total = _ramp(x + outer, sigma) - _ramp(x + inner, sigma)
    total -= _ramp(x - inner, sigma) - _ramp(x - outer, sigma)
    return max(total / (a * b), 0.0)


@kernel
def _cube(x: float) -> float:
    # Fourth integral of a delta function: x^3 / 6 above zero.
    return x * x * x / 6.0 if x > 0.0 else 0.0


@kernel
def _four_boxes(x: float, a: float, b: float, c: float) -> float:
    # Convolution of four boxes of unit area, ``a``, ``b``, ``c`` and ``c`` wide.
    x = -abs(x)
    total = 0.0
    for i in range(2):
        for j in range(2):
            offset = x + (0.5 - i) * a + (0.5 - j) * b
            sign = 1.0 if i == j else -1.0
            total += sign * (_cube(offset + c) - 2.0 * _cube(offset) + _cube(offset - c))
    return max(total / (a * b * c * c), 0.0)


@kernel
def line_profile(x: float, width: float, source: float, shape: int, triangular: bool) -> float:
    # Return the profile of a lamp line, of unit area, at a distance from its centre [samples].
    #
    # ``width`` is the full width at half maximum of the instrument's own response, whose ``shape`` is
    # `GAUSSIAN`, or `SLIT`: a box ``width`` wide, the slit's image, convolved with a sample of width 1.
    # ``source`` is the full width at half maximum of the light, whose spectrum is triangular or else
    # Gaussian.
    if shape == GAUSSIAN:
        if triangular and source > _MIN_BOX_SAMPLES:
            return _two_boxes(x, source, source, _SIGMA * width)
        sigma = _SIGMA * (width if triangular else math.sqrt(width * width + source * source))
        z = x / sigma
        return float(math.exp(-0.5 * z * z) / (_ROOT2PI * sigma))
    if triangular and source > _MIN_BOX_SAMPLES:
        return _four_boxes(x, width, 1.0, source)
    return _two_boxes(x, width, 1.0, 0.0 if triangular else _SIGMA * source)


@kernel
def _solve4(matrix: Array, right: Array, out: Array) -> bool:
    # Cholesky's method for a symmetric positive 4 x 4 system; False where it is singular.
    low = np.zeros((4, 4))
    for i in range(4):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= low[i, k] * low[j, k]
            if i == j:
                if not total > 1e-14 * matrix[i, i]:
                    return False
                low[i, i] = math.sqrt(total)
            else:
                low[i, j] = total / low[j, j]
    for i in range(4):
        total = right[i]
        for k in range(i):
            total -= low[i, k] * out[k]
        out[i] = total / low[i, i]
    for i in range(3, -1, -1):
        total = out[i]
        for k in range(i + 1, 4):
            total -= low[k, i] * out[k]
        out[i] = total / low[i, i]
    return True


@kernel
def _normal_equations(
    line: LineSamples, p: Array, shape: int, triangular: bool, matrix: Array, right: Array
) -> float:
    # Write the normal equations at parameters ``p``; return the weighted sum of squared residuals.
    values, weights, first, source = line
    step = 1e-5 * max(p[WIDTH], 0.1)
    matrix[:] = 0.0
    right[:] = 0.0
    chi2 = 0.0
    row = np.empty(4)
    for i in range(values.shape[0]):
        w = weights[i]
        if not w > 0.0:
            continue
        x = first + i - p[CENTRE]
        height = line_profile(x, p[WIDTH], source, shape, triangular)
        shifted_right = line_profile(x + step, p[WIDTH], source, shape, triangular)
        shifted_left = line_profile(x - step, p[WIDTH], source, shape, triangular)
        wider = line_profile(x, p[WIDTH] + step, source, shape, triangular)
        row[CENTRE] = -p[AREA] * (shifted_right - shifted_left) / (2.0 * step)
        row[WIDTH] = p[AREA] * (wider - height) / step
        row[AREA] = height
        row[OFFSET] = 1.0
        residual = values[i] - p[AREA] * height - p[OFFSET]
        chi2 += w * residual * residual
        for j in range(4):
            right[j] += w * row[j] * residual
            for k in range(j + 1):
                matrix[j, k] += w * row[j] * row[k]
    for j in range(4):
        for k in range(j):
            matrix[k, j] = matrix[j, k]
    return chi2


@kernel
def _chi2(line: LineSamples, p: Array, shape: int, triangular: bool) -> float:
    values, weights, first, source = line
    total = 0.0
    for i in range(values.shape[0]):
        if weights[i] > 0.0:
            height = line_profile(first + i - p[CENTRE], p[WIDTH], source, shape, triangular)
            residual = values[i] - p[AREA] * height - p[OFFSET]
            total += weights[i] * residual * residual
    return total


@kernel
def _fit_line(
    line: LineSamples, p: Array, shape: int, triangular: bool, covariance: Array
) -> tuple[float, bool]:
    # Improve the parameters in place; return chi2, and whether the search converged.
    matrix, right, damped = np.empty((4, 4)), np.empty(4), np.empty((4, 4))
    change, trial = np.empty(4), np.empty(4)
    damping = 1e-3
    chi2 = _normal_equations(line, p, shape, triangular, matrix, right)
    converged = False
    for _ in range(_MAX_STEPS):
        for j in range(4):
            for k in range(4):  # numba compiles assignments of whole arrays slowly
                damped[j, k] = matrix[j, k]
            damped[j, j] *= 1.0 + damping
        if not _solve4(damped, right, change):
            break
        for j in range(4):
            trial[j] = p[j] + change[j]
        trial[WIDTH] = min(max(trial[WIDTH], 0.5 * p[WIDTH], _MIN_BOX_SAMPLES), 2.0 * p[WIDTH])
        trial_chi2 = _chi2(line, trial, shape, triangular)
        if trial_chi2 <= chi2:
            change_size = abs(trial[CENTRE] - p[CENTRE]) + abs(trial[WIDTH] - p[WIDTH])
            for j in range(4):
                p[j] = trial[j]
            decrease = chi2 - trial_chi2
            chi2 = _normal_equations(line, p, shape, triangular, matrix, right)
            damping = max(damping * 0.1, 1e-12)
            if change_size < 1e-9 * p[WIDTH] or decrease <= 1e-13 * chi2:
                converged = True
                break
        else:
            damping *= 10.0
            if damping > 1e8:
                converged = True  # improvements are below rounding
                break
    unit = np.zeros(4)
    for j in range(4):
        unit[:] = 0.0
        unit[j] = 1.0
        if not _solve4(matrix, unit, change):
            covariance[:] = np.nan
            return chi2, False
        for k in range(4):
            covariance[j, k] = change[k]
    return chi2, converged


@kernel
def fit_lines(samples: LineSamples, shape: int, triangular: bool, fits: LineFits) -> None:
    # Fit offset + area x profile (see `line_profile`) to every row by the Levenberg-Marquardt method.
    #
    # ``fits`` hold the start values, and receive the results.
    parameters, covariance, chi2, converged = fits
    for line in range(samples.values.shape[0]):
        if not (np.isfinite(parameters[line]).all() and parameters[line, WIDTH] > 0.0):
            parameters[line] = np.nan
            covariance[line] = np.nan
            chi2[line] = np.nan
            converged[line] = False
            continue
        line_samples = LineSamples(
            samples.values[line], samples.weights[line], samples.first[line], samples.source[line]
        )
        chi2[line], ended = _fit_line(line_samples, parameters[line], shape, triangular, covariance[line])
        converged[line] = ended and np.isfinite(chi2[line])


@kernel
def profiles(places: Array, width: Array, source: Array, shape: int, triangular: bool, out: Array) -> None:
    # Write the `line_profile` of every lamp line at distances (line, sample) from its centre.
    for line in range(places.shape[0]):
        for i in range(places.shape[1]):
            out[line, i] = line_profile(places[line, i], width[line], source[line], shape, triangular)


@kernel
def full_widths(width: Array, source: Array, shape: int, triangular: bool, out: Array) -> None:
    # Write the full width at half maximum (line,) of observed lamp lines, by bisection.
    for line in range(width.shape[0]):
        if not np.isfinite(width[line] + source[line]):
            out[line] = np.nan
            continue
        half = 0.5 * line_profile(0.0, width[line], source[line], shape, triangular)
        low, high = 0.0, width[line] + 2.0 * source[line] + 1.0
        for _ in range(50):
            middle = 0.5 * (low + high)
            if line_profile(middle, width[line], source[line], shape, triangular) > half:
                low = middle
            else:
                high = middle
        out[line] = low + high
