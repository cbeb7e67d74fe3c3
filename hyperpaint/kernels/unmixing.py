"""Unmixing of pixel spectra into body reflectance, light and mirror images, by bounded least squares."""

from typing import Any, NamedTuple

import numpy as np

from hyperpaint.base import Array
from hyperpaint.base.jit import kernel

from .arguments import AmountPrior, Bodies, ChannelErrors, Glinting, LightParts, Unmixed

# Direct, diffuse, mirror images of the sun, of the zenith sky and of the sky around the sun, and of each of
# two neighbours: light reflected twice, mirror image.
PARTS = 9
# Number of first parts, which need no neighbour.
_OWN_PARTS = 5
# Parts of the mirror images of the sun, and of the sky around it.
_GLINT, _SUNWARD = 2, 4
# Smallest gradient, for a curvature of 1, at which a part is freed: above rounding.
_MIN_GRADIENT = 1e-9
# Minimum amount of direct light on a surface that mirrors the sun, since it faces halfway to the sun.
_MIN_SUNLIT_DIRECT = 0.7
# Share of the channels with independent errors: model errors are smooth over several channels.
_INDEPENDENT_SHARE = 0.25


@kernel
def average_bands(cube: Array, channel: Array, out: Array) -> None:
    # Write means (line, column, group) of a cube (line, band, column) over groups of bands.
    #
    # ``channel`` (band,) is the group of every band, -1 for none. NaN where at most half of a group is valid.
    lines, bands, columns = cube.shape
    groups = out.shape[2]
    members = np.zeros(groups, np.int64)
    for band in range(bands):
        if channel[band] >= 0:
            members[channel[band]] += 1
    # columns are the last axis: the loop over them vectorises
    total = np.empty((groups, columns), np.float64)
    valid = np.empty((groups, columns), np.float64)
    for line in range(lines):
        total[:] = 0.0
        valid[:] = 0
        for band in range(bands):
            group = channel[band]
            if group < 0:
                continue
            for x in range(columns):
                value = cube[line, band, x]
                is_finite = abs(value) < np.inf
                total[group, x] += value if is_finite else 0.0
                valid[group, x] += 1.0 if is_finite else 0.0
        for x in range(columns):
            for group in range(groups):
                is_valid = 2 * valid[group, x] > members[group]
                out[line, x, group] = total[group, x] / valid[group, x] if is_valid else np.nan


@kernel
def _fill_parts(body: Array, light: LightParts, first: Array, second: Array, parts: Array) -> None:
    # Write the spectra (part, channel) whose weighted sum is the reflectance of a pixel.
    for k in range(body.size):
        parts[0, k] = body[k] * light.direct[k]
        parts[1, k] = body[k] * light.diffuse[k]
        parts[2, k] = light.direct[k]
        parts[3, k] = light.above[k]
        parts[4, k] = light.sunward[k]
        parts[5, k] = body[k] * first[k]
        parts[6, k] = first[k]
        parts[7, k] = body[k] * second[k]
        parts[8, k] = second[k]


@kernel
def _solve_free(gram: Array, right: Array, is_free: Array, amount: Array, factor: Array, goal: Array) -> None:
    # Write the minimum over the free parts, with all other parts fixed, by Cholesky's method.
    count = right.size
    for i in range(count):
        goal[i] = amount[i]
        if not is_free[i]:
            continue
        residual, pivot = right[i], gram[i, i]
        for j in range(count):
            if not is_free[j]:
                residual -= gram[i, j] * amount[j]
        for j in range(i):
            if not is_free[j]:
                continue
            value = gram[i, j]
            for k in range(j):
                if is_free[k]:
                    value -= factor[i, k] * factor[j, k]
            factor[i, j] = value / factor[j, j]
            residual -= factor[i, j] * goal[j]
            pivot -= factor[i, j] * factor[i, j]
        factor[i, i] = np.sqrt(max(pivot, 1e-14 * gram[i, i]))
        goal[i] = residual / factor[i, i]
    for i in range(count - 1, -1, -1):
        if is_free[i]:
            for j in range(i + 1, count):
                if is_free[j]:
                    goal[i] -= factor[j, i] * goal[j]
            goal[i] /= factor[i, i]


@kernel
def minimise(gram: Array, right: Array, most: Array, fixed: Array, amount: Array) -> Any:
    # Write the minimum of x' gram x / 2 - right' x over 0 <= x <= most, by an active-set method.
    #
    # Exact except for rounding: the parts inside their bounds are solved for together (Cholesky); a part that
    # would pass a bound is fixed there, and the part whose gradient points inside most steeply is freed. Each
    # iteration lowers the value, so no set of free parts recurs.
    #
    # ``gram`` (part, part) is positive definite; ``most`` (part,) are upper bounds; parts that are ``fixed``
    # stay unchanged; ``amount`` (part,) is the start, within the bounds, and receives the minimum. Return
    # whether it was found; False if more iterations than there are sets of free parts were needed.
    count = right.size
    is_free = np.empty(count, np.bool_)
    for i in range(count):
        is_free[i] = (not fixed[i]) and 0.0 < amount[i] < most[i]
    factor, goal = np.empty((count, count)), np.empty(count)
    for _ in range(4 * count * count):
        _solve_free(gram, right, is_free, amount, factor, goal)
        blocked, step = -1, 1.0
        for i in range(count):
            if is_free[i] and not 0.0 <= goal[i] <= most[i]:
                limit = 0.0 if goal[i] < 0.0 else most[i]
                fraction = (limit - amount[i]) / (goal[i] - amount[i])
                if blocked < 0 or fraction < step:
                    blocked, step = i, fraction
        for i in range(count):
            if is_free[i]:
                amount[i] += step * (goal[i] - amount[i])
        if blocked >= 0:
            amount[blocked] = 0.0 if goal[blocked] < 0.0 else most[blocked]
            is_free[blocked] = False
            continue
        steepest, release = _MIN_GRADIENT, -1
        for i in range(count):
            if is_free[i] or fixed[i]:
                continue
            slope = right[i]
            for j in range(count):
                slope -= gram[i, j] * amount[j]
            gain = (slope if amount[i] <= 0.0 else -slope) / np.sqrt(gram[i, i])
            if gain > steepest and most[i] > 0.0:
                steepest, release = gain, i
        if release < 0:
            return True
        is_free[release] = True
    return False


@kernel
def _cost(gram: Array, right: Array, amount: Array) -> Any:
    # Return amount' gram amount - 2 right' amount: the sum of squares, up to a constant.
    total = 0.0
    for i in range(right.size):
        if amount[i] != 0.0:
            inner = -2.0 * right[i]
            for j in range(right.size):
                inner += gram[i, j] * amount[j]
            total += amount[i] * inner
    return total


class Equations(NamedTuple):
    #: gram (part, part), right (part,)
    gram: Array
    right: Array
    valid: Any  #: Number of valid channels
    used: Any  #: Number of parts: of the body of the pixel, and of the neighbours that light it


@kernel
def _normal_equations(
    spectrum: Array, parts: Array, used: Any, errors: ChannelErrors, gram: Array, right: Array
) -> Any:
    # Write the equations; return the number of valid channels, and the cost of zero amounts.
    gram[:] = 0.0
    right[:] = 0.0
    valid, zero_cost = 0, 0.0
    for k in range(spectrum.size):
        value = np.float64(spectrum[k])
        if not np.isfinite(value):
            continue
        valid += 1
        sigma = errors.noise[k] * abs(value) + errors.floor
        weight = 1.0 / (sigma * sigma)
        zero_cost += weight * value * value
        for i in range(used):
            scaled = weight * parts[i, k]
            right[i] += scaled * value
            for j in range(i + 1):
                gram[i, j] += scaled * parts[j, k]
    for i in range(used):
        for j in range(i):
            gram[j, i] = gram[i, j]
    return valid, zero_cost


@kernel
def _copy(values: Array, out: Array) -> None:
    # numba compiles ``out[:] = values`` with a formatted error message, which takes a second
    for i in range(out.size):
        out[i] = values[i]


@kernel
def _neighbour_lowers_residual(gram: Array, right: Array, used: Any, amount: Array) -> Any:
    for i in range(_OWN_PARTS, used):
        slope = right[i]
        for j in range(_OWN_PARTS):
            slope -= gram[i, j] * amount[j]
        if slope > _MIN_GRADIENT * np.sqrt(gram[i, i]):
            return True
    return False


@kernel
def _minimise_with_neighbours(
    equations: Equations, zero_cost: Any, most: Array, evidence: Any, fixed: Array, amount: Array
) -> Any:
    # Minimise, with neighbours only where they lower the cost by ``evidence``; return the cost.
    gram, right, used = equations.gram, equations.right, equations.used
    fixed[_OWN_PARTS:] = True
    minimise(gram, right, most, fixed, amount)
    cost = zero_cost + _cost(gram, right, amount)
    if used > _OWN_PARTS and cost > evidence and _neighbour_lowers_residual(gram, right, used, amount):
        fixed[_OWN_PARTS:used] = False
        trial = amount.copy()
        minimise(gram, right, most, fixed, trial)
        trial_cost = zero_cost + _cost(gram, right, trial)
        if cost - trial_cost > evidence * max(1.0, trial_cost / (_INDEPENDENT_SHARE * equations.valid)):
            _copy(trial, amount)
            cost = trial_cost
    return cost


@kernel
def _solve(
    equations: Equations,
    zero_cost: Any,
    prior: AmountPrior,
    evidence: Any,
    additions: Glinting,
    direct_weight: Any,
    amount: Array,
) -> None:
    # Write the amounts, starting from the prior.
    #
    # ``equations`` and ``zero_cost`` (the cost of zero amounts) include the prior; ``direct_weight`` is the
    # prior weight of the direct light. Neighbours and glint are kept only where omitting them raises the cost
    # by ``evidence``, in units of the reduced residual where that exceeds noise. With glint, ``additions``
    # are added to the prior mean, and the direct light must be at least `_MIN_SUNLIT_DIRECT`.
    right, most = equations.right, prior.most
    is_fixed = np.zeros(PARTS, np.bool_)
    start = amount.copy()
    sunward_weight = 1.0 / prior.spread[_SUNWARD] ** 2
    right[0] += direct_weight * additions.direct
    right[_SUNWARD] += sunward_weight * additions.sunward
    glint_cost = zero_cost + direct_weight * additions.direct * (2.0 * prior.expected[0] + additions.direct)
    glint_cost += sunward_weight * additions.sunward * (2.0 * prior.expected[_SUNWARD] + additions.sunward)
    cost = _minimise_with_neighbours(equations, glint_cost, most, evidence, is_fixed, amount)
    right[0] -= direct_weight * additions.direct
    right[_SUNWARD] -= sunward_weight * additions.sunward
    if evidence <= 0.0:
        return
    trial = start
    trial[_GLINT] = 0.0
    is_fixed[_GLINT] = True
    cost_without_glint = _minimise_with_neighbours(equations, zero_cost, most, evidence, is_fixed, trial)
    is_weak = cost_without_glint - cost <= evidence * max(1.0, cost / (_INDEPENDENT_SHARE * equations.valid))
    if is_weak or amount[_GLINT] <= 0.0 or amount[0] < _MIN_SUNLIT_DIRECT:
        _copy(trial, amount)


@kernel
def unmix_lines(
    spectrum: Array,
    bodies: Bodies,
    light: LightParts,
    errors: ChannelErrors,
    prior: AmountPrior,
    evidence: Any,
    glinting: Glinting,
    out: Unmixed,
) -> None:
    # Unmix every pixel of a block of lines.
    #
    # Minimises sum(((spectrum - parts amount) / sigma)^2) + sum(((amount - expected) / spread)^2) with sigma
    # = noise x spectrum + floor and amounts from 0 to the upper bound. NaN where fewer than half the channels
    # are valid.
    #
    # ``spectrum`` (line, column, channel) is reflectance [1]. ``evidence`` is the increase of the sum by
    # which an omission of glint or neighbours is rejected, 9 for three standard deviations; with 0 all are
    # kept. ``glinting`` is added to the prior mean where there is glint, direct light by at most the body's
    # tilt.
    lines, columns, channels = spectrum.shape
    parts, nothing = np.empty((PARTS, channels)), np.zeros(channels)
    gram, right, amount = np.empty((PARTS, PARTS)), np.empty(PARTS), np.empty(PARTS)
    reflectance, expected, spread, tilt = bodies.reflectance, prior.expected, prior.spread, prior.tilt
    for line in range(lines):
        for x in range(columns):
            number = bodies.body_of[line, x]
            valid, parts_used = 0, 0
            if number >= 0:
                first, second = bodies.neighbours[line, x, 0], bodies.neighbours[line, x, 1]
                parts_used = _OWN_PARTS if first < 0 else (_OWN_PARTS + 2 if second < 0 else _OWN_PARTS + 4)
                first_spectrum = nothing if first < 0 else reflectance[first]
                second_spectrum = nothing if second < 0 else reflectance[second]
                _fill_parts(reflectance[number], light, first_spectrum, second_spectrum, parts)
                valid, zero_cost = _normal_equations(
                    spectrum[line, x], parts, parts_used, errors, gram, right
                )
            if 2 * valid < channels or number < 0:
                out.amount[line, x] = np.nan
                out.added[line, x] = np.nan
                out.together[line, x] = np.nan
                out.misfit[line, x] = np.nan
                continue
            for part in range(PARTS):
                weight = 1.0 / spread[part] ** 2 if part else 1.0 / tilt[number] ** 2
                gram[part, part] += weight
                right[part] += weight * expected[part]
                zero_cost += weight * expected[part] ** 2
                amount[part] = expected[part] if part < parts_used else 0.0
            equations = Equations(gram, right, valid, parts_used)
            weight = 1.0 / tilt[number] ** 2
            additions = Glinting(min(glinting.direct, tilt[number]), glinting.sunward)
            _solve(equations, zero_cost, prior, evidence, additions, weight, amount)
            _copy(amount, out.amount[line, x])
            out.misfit[line, x] = _misfit(spectrum[line, x], parts, amount, errors)
            max_first, max_second, max_both = 0.0, 0.0, 0.0
            for k in range(channels):
                from_first = amount[5] * parts[5, k] + amount[6] * parts[6, k]
                from_second = amount[7] * parts[7, k] + amount[8] * parts[8, k]
                max_first = max(max_first, from_first)
                max_second = max(max_second, from_second)
                max_both = max(max_both, from_first + from_second)
            out.added[line, x, 0], out.added[line, x, 1] = max_first, max_second
            out.together[line, x] = max_both


@kernel
def _misfit(spectrum: Array, parts: Array, amount: Array, errors: ChannelErrors) -> Any:
    # Return the root mean square residual, in standard deviations.
    total, valid = 0.0, 0
    for k in range(spectrum.size):
        value = np.float64(spectrum[k])
        if not np.isfinite(value):
            continue
        valid += 1
        residual = value
        for i in range(PARTS):
            residual -= amount[i] * parts[i, k]
        total += (residual / (errors.noise[k] * abs(value) + errors.floor)) ** 2
    return np.sqrt(total / max(valid, 1))
