"""What a pixel's light is made of, given what it shows: least squares without negative parts."""

from __future__ import annotations

from typing import Any

import numpy as np

from hyperpaint.base.arrays import Array
from hyperpaint.base.jit import kernel

__all__ = ["PARTS", "average_bands", "minimise", "unmix_lines"]


PARTS = 8
"""Direct, diffuse, sun's mirror image, sky's mirror image, and two neighbours: reflected twice, mirrored."""
_OWN = 4
"""The first of them, that need no neighbour."""
_GLINT = 2
"""The sun's mirror image among them."""
_SLOPE = 1e-9
"""Gradient below which nothing is let go, of parts scaled to have a curvature of 1: rounding."""
_SUNLIT = 0.7
"""Amount of direct light on what mirrors the sun, at least: it faces halfway to it."""
_INDEPENDENT = 0.25
"""Share of the channels that err on their own: what a model lacks is smooth over some of them."""


@kernel
def average_bands(cube: Array, channel: Array, out: Array) -> None:
    """Write means over groups of bands, pixel by pixel.

    Parameters
    ----------
    cube : (line, band, column), float32
        Reflectance [1].
    channel : (band,), int64
        Group of every band; -1 for none.
    out : (line, column, group), float32
        Written; NaN where half of a group's bands or more are missing.
    """
    lines, bands, columns = cube.shape
    groups = out.shape[2]
    members = np.zeros(groups, np.int64)
    for band in range(bands):
        if channel[band] >= 0:
            members[channel[band]] += 1
    total = np.empty((columns, groups), np.float64)
    known = np.empty((columns, groups), np.int64)
    for line in range(lines):
        total[:] = 0.0
        known[:] = 0
        for band in range(bands):
            group = channel[band]
            if group < 0:
                continue
            for x in range(columns):
                value = cube[line, band, x]
                if np.isfinite(value):
                    total[x, group] += value
                    known[x, group] += 1
        for x in range(columns):
            for group in range(groups):
                enough = 2 * known[x, group] > members[group]
                out[line, x, group] = total[x, group] / known[x, group] if enough else np.nan


@kernel
def _fill_parts(
    body: Array, direct: Array, diffuse: Array, first: Array, second: Array, parts: Array
) -> None:
    """Write the spectra (part, channel) that a pixel's reflectance is a sum of."""
    for k in range(body.size):
        parts[0, k] = body[k] * direct[k]
        parts[1, k] = body[k] * diffuse[k]
        parts[2, k] = direct[k]
        parts[3, k] = diffuse[k]
        parts[4, k] = body[k] * first[k]
        parts[5, k] = first[k]
        parts[6, k] = body[k] * second[k]
        parts[7, k] = second[k]


@kernel
def _solve_free(gram: Array, right: Array, free: Array, amount: Array, factor: Array, goal: Array) -> None:
    """Write the minimum ``goal`` over the free parts, the others as they are: Cholesky, in place."""
    count = right.size
    for i in range(count):
        goal[i] = amount[i]
        if not free[i]:
            continue
        rest, pivot = right[i], gram[i, i]
        for j in range(count):
            if not free[j]:
                rest -= gram[i, j] * amount[j]
        for j in range(i):
            if not free[j]:
                continue
            value = gram[i, j]
            for k in range(j):
                if free[k]:
                    value -= factor[i, k] * factor[j, k]
            factor[i, j] = value / factor[j, j]
            rest -= factor[i, j] * goal[j]
            pivot -= factor[i, j] * factor[i, j]
        factor[i, i] = np.sqrt(max(pivot, 1e-14 * gram[i, i]))
        goal[i] = rest / factor[i, i]
    for i in range(count - 1, -1, -1):
        if free[i]:
            for j in range(i + 1, count):
                if free[j]:
                    goal[i] -= factor[j, i] * goal[j]
            goal[i] /= factor[i, i]


@kernel
def minimise(gram: Array, right: Array, most: Array, held: Array, amount: Array) -> Any:
    """Write the minimum of x' gram x / 2 - right' x over 0 <= x <= most, by an active-set method.

    Exact, but for rounding: the parts inside their limits are solved for together (Cholesky); one that would
    pass a limit is held there, and one whose gradient points back inside is let go, the steepest first. Each
    turn makes the value smaller, so that no set of parts comes twice.

    Parameters
    ----------
    gram : (part, part)
        Positive definite.
    right, most : (part,)
        Linear term, and the largest amounts.
    held : (part,), bool
        Parts that stay as they are; the others may be changed.
    amount : (part,)
        Start, within the limits, and minimum.

    Returns
    -------
    bool
        Whether it was found; False, with the best so far, after more turns than there are sets.
    """
    count = right.size
    free = np.empty(count, np.bool_)
    for i in range(count):
        free[i] = (not held[i]) and 0.0 < amount[i] < most[i]
    factor, goal = np.empty((count, count)), np.empty(count)
    for _ in range(4 * count * count):
        _solve_free(gram, right, free, amount, factor, goal)
        stopped, step = -1, 1.0
        for i in range(count):
            if free[i] and not 0.0 <= goal[i] <= most[i]:
                limit = 0.0 if goal[i] < 0.0 else most[i]
                reach = (limit - amount[i]) / (goal[i] - amount[i])
                if stopped < 0 or reach < step:
                    stopped, step = i, reach
        for i in range(count):
            if free[i]:
                amount[i] += step * (goal[i] - amount[i])
        if stopped >= 0:
            amount[stopped] = 0.0 if goal[stopped] < 0.0 else most[stopped]
            free[stopped] = False
            continue
        steepest, release = _SLOPE, -1
        for i in range(count):
            if free[i] or held[i]:
                continue
            slope = right[i]
            for j in range(count):
                slope -= gram[i, j] * amount[j]
            gain = (slope if amount[i] <= 0.0 else -slope) / np.sqrt(gram[i, i])
            if gain > steepest and most[i] > 0.0:
                steepest, release = gain, i
        if release < 0:
            return True
        free[release] = True
    return False


@kernel
def _cost(gram: Array, right: Array, amount: Array) -> Any:
    """Return amount' gram amount - 2 right' amount: the sum of squares, up to a constant."""
    total = 0.0
    for i in range(right.size):
        if amount[i] != 0.0:
            inner = -2.0 * right[i]
            for j in range(right.size):
                inner += gram[i, j] * amount[j]
            total += amount[i] * inner
    return total


@kernel
def _normal_equations(
    seen: Array, parts: Array, used: Any, noise: Array, floor: Any, gram: Array, right: Array
) -> Any:
    """Write what least squares needs; return the number of channels known, and the sum without parts."""
    gram[:] = 0.0
    right[:] = 0.0
    known, whole = 0, 0.0
    for k in range(seen.size):
        value = np.float64(seen[k])
        if not np.isfinite(value):
            continue
        known += 1
        sigma = noise[k] * abs(value) + floor
        weight = 1.0 / (sigma * sigma)
        whole += weight * value * value
        for i in range(used):
            scaled = weight * parts[i, k]
            right[i] += scaled * value
            for j in range(i + 1):
                gram[i, j] += scaled * parts[j, k]
    for i in range(used):
        for j in range(i):
            gram[j, i] = gram[i, j]
    return known, whole


@kernel
def _tempted(gram: Array, right: Array, used: Any, amount: Array) -> Any:
    """Tell whether some of a neighbour's light, of which there is none yet, would lessen the misfit."""
    for i in range(_OWN, used):
        slope = right[i]
        for j in range(_OWN):
            slope -= gram[i, j] * amount[j]
        if slope > _SLOPE * np.sqrt(gram[i, i]):
            return True
    return False


@kernel
def _settle(
    gram: Array,
    right: Array,
    whole: Any,
    known: Any,
    used: Any,
    most: Array,
    evidence: Any,
    held: Array,
    amount: Array,
) -> Any:
    """Write the least of the cost, with neighbours where they are worth it; return it."""
    held[_OWN:] = True
    minimise(gram, right, most, held, amount)
    cost = whole + _cost(gram, right, amount)
    if used > _OWN and cost > evidence and _tempted(gram, right, used, amount):
        held[_OWN:used] = False
        trial = amount.copy()
        minimise(gram, right, most, held, trial)
        less = whole + _cost(gram, right, trial)
        if cost - less > evidence * max(1.0, less / (_INDEPENDENT * known)):
            amount[:] = trial
            cost = less
    return cost


@kernel
def _solve(
    gram: Array,
    right: Array,
    whole: Any,
    known: Any,
    used: Any,
    most: Array,
    evidence: Any,
    lean: Any,
    tie: Any,
    amount: Array,
) -> None:
    """Write the amounts that the light gives evidence of, from what is expected on.

    ``gram``, ``right`` and ``whole`` (the cost without any parts) with the tie to what is expected, which of
    direct light is ``tie``. Neighbours, and glint, are in only where leaving them out makes the cost larger
    by ``evidence``, in units of the misfit of what is left, where that is more than noise. What mirrors the
    sun faces halfway to it: it is expected to get ``lean`` more direct light, and is not in shadow.
    """
    held = np.zeros(PARTS, np.bool_)
    start = amount.copy()
    more = tie * lean
    right[0] += more
    glinting = whole + more * (2.0 * start[0] + lean)
    cost = _settle(gram, right, glinting, known, used, most, evidence, held, amount)
    right[0] -= more
    if evidence <= 0.0:
        return
    trial = start
    trial[_GLINT] = 0.0
    held[_GLINT] = True
    plain = _settle(gram, right, whole, known, used, most, evidence, held, trial)
    weak = plain - cost <= evidence * max(1.0, cost / (_INDEPENDENT * known))
    if weak or amount[_GLINT] <= 0.0 or amount[0] < _SUNLIT:
        amount[:] = trial


@kernel
def unmix_lines(
    seen: Array,
    body_of: Array,
    bodies: Array,
    neighbours: Array,
    direct: Array,
    diffuse: Array,
    noise: Array,
    floor: Any,
    expected: Array,
    spread: Array,
    tilt: Array,
    most: Array,
    evidence: Any,
    lean: Any,
    amount: Array,
    added: Array,
    together: Array,
    misfit: Array,
) -> None:
    """Unmix every pixel of a block of lines.

    The minimum of sum(((seen - parts amount) / sigma)^2) + sum(((amount - expected) / spread)^2) with
    sigma = noise x seen + floor and amounts from 0 to ``most``. NaN where less than half is known.

    Parameters
    ----------
    seen : (line, column, channel), float32
        Reflectance [1].
    body_of : (line, column), int32
        What each pixel shows, a row of ``bodies``; -1 leaves it NaN.
    bodies : (body, channel), float64
        Reflectance in full light [1].
    neighbours : (line, column, 2), int32
        Rows of ``bodies`` that light each pixel; -1 for none.
    direct, diffuse : (channel,), float64
        Parts of the irradiance [1].
    noise : (channel,), float64
        Standard deviation relative to what is seen [1].
    floor
        Standard deviation that is added [1].
    expected, spread : (part,), float64
        What amounts are without evidence, and how far from it they come to lie.
    tilt : (body,), float64
        The spread of the amount of direct light, in place of that in ``spread``.
    most : (part,), float64
        Amounts are no larger.
    evidence
        By how much leaving glint or neighbours out must enlarge the sum, 9 for three standard deviations;
        they are left out otherwise. 0: nothing is left out.
    lean
        By how much more direct light than usual is expected where there is glint, at most the body's tilt.
    amount : (line, column, part), float32
        Written.
    added : (line, column, 2), float32
        Largest reflectance over the channels that each neighbour adds, written.
    together : (line, column), float32
        Largest reflectance over the channels that both add, written; less than the sum of ``added`` where
        they are of different colours.
    misfit : (line, column), float32
        Root mean square of what remains, in standard deviations, written.
    """
    lines, columns, channels = seen.shape
    parts, nothing = np.empty((PARTS, channels)), np.zeros(channels)
    gram, right, found = np.empty((PARTS, PARTS)), np.empty(PARTS), np.empty(PARTS)
    for line in range(lines):
        for x in range(columns):
            number = body_of[line, x]
            known, used = 0, 0
            if number >= 0:
                first, second = neighbours[line, x, 0], neighbours[line, x, 1]
                used = _OWN if first < 0 else (_OWN + 2 if second < 0 else _OWN + 4)
                one = nothing if first < 0 else bodies[first]
                other = nothing if second < 0 else bodies[second]
                _fill_parts(bodies[number], direct, diffuse, one, other, parts)
                known, whole = _normal_equations(seen[line, x], parts, used, noise, floor, gram, right)
            if 2 * known < channels or number < 0:
                amount[line, x] = np.nan
                added[line, x] = np.nan
                together[line, x] = np.nan
                misfit[line, x] = np.nan
                continue
            for part in range(PARTS):
                tie = 1.0 / spread[part] ** 2 if part else 1.0 / tilt[number] ** 2
                gram[part, part] += tie
                right[part] += tie * expected[part]
                whole += tie * expected[part] ** 2
                found[part] = expected[part] if part < used else 0.0
            _solve(
                gram, right, whole, known, used, most, evidence, min(lean, tilt[number]),
                1.0 / tilt[number] ** 2, found,
            )  # fmt: skip
            amount[line, x] = found
            misfit[line, x] = _misfit(seen[line, x], parts, found, noise, floor)
            most_first, most_second, most_both = 0.0, 0.0, 0.0
            for k in range(channels):
                of_first = found[4] * parts[4, k] + found[5] * parts[5, k]
                of_second = found[6] * parts[6, k] + found[7] * parts[7, k]
                most_first = max(most_first, of_first)
                most_second = max(most_second, of_second)
                most_both = max(most_both, of_first + of_second)
            added[line, x, 0], added[line, x, 1] = most_first, most_second
            together[line, x] = most_both


@kernel
def _misfit(seen: Array, parts: Array, amount: Array, noise: Array, floor: Any) -> Any:
    """Return the root mean square of what remains, in standard deviations."""
    total, known = 0.0, 0
    for k in range(seen.size):
        value = np.float64(seen[k])
        if not np.isfinite(value):
            continue
        known += 1
        rest = value
        for i in range(PARTS):
            rest -= amount[i] * parts[i, k]
        total += (rest / (noise[k] * abs(value) + floor)) ** 2
    return np.sqrt(total / max(known, 1))
