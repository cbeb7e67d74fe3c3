"""What a pixel's light is made of, given what it shows: least squares without negative parts."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ._jit import kernel

__all__ = ["PARTS", "average_bands", "unmix_lines"]

Array = npt.NDArray[Any]

PARTS = 8
"""Direct, diffuse, sun's mirror image, sky's mirror image, and two neighbours: reflected twice, mirrored."""
_SWEEPS = 200
_SETTLED = 1e-7


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
def fill_parts(body: Array, direct: Array, diffuse: Array, first: Array, second: Array, parts: Array) -> None:
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
def solve(
    seen: Array,
    parts: Array,
    used: Any,
    noise: Any,
    floor: Any,
    expected: Array,
    spread: Array,
    most: Array,
    amount: Array,
) -> Any:
    """Write the amounts of the parts, 0 to ``most``; return the rms misfit in standard deviations.

    Towards the minimum of sum(((seen - parts amount) / sigma)^2) + sum(((amount - expected) / spread)^2),
    with sigma = noise x seen + floor, by at most 200 sweeps from part to part, from ``expected`` on (for
    flags c = 1, g = 0). Where parts are nearly of one colour, as on grey bodies, the minimum is some
    thousands of sweeps away: what is written is an early-stopped, hence regularised, solution. Thresholds of
    flags are tuned to this number of sweeps. NaN where less than half is known.
    """
    count = seen.size
    gram = np.zeros((PARTS, PARTS))
    right = np.zeros(PARTS)
    known = 0
    for k in range(count):
        value = np.float64(seen[k])
        if not np.isfinite(value):
            continue
        known += 1
        sigma = noise * abs(value) + floor
        weight = 1.0 / (sigma * sigma)
        for i in range(used):
            right[i] += weight * parts[i, k] * value
            for j in range(i + 1):
                gram[i, j] += weight * parts[i, k] * parts[j, k]
    if 2 * known < count:
        amount[:] = np.nan
        return np.nan
    for i in range(used):
        for j in range(i):
            gram[j, i] = gram[i, j]
        gram[i, i] += 1.0 / (spread[i] * spread[i])
        right[i] += expected[i] / (spread[i] * spread[i])
    for i in range(PARTS):
        amount[i] = expected[i] if i < used else 0.0
    for _ in range(_SWEEPS):
        moved = 0.0
        for i in range(used):
            rest = right[i]
            for j in range(used):
                if j != i:
                    rest -= gram[i, j] * amount[j]
            new = min(max(rest / gram[i, i], 0.0), most[i])
            moved = max(moved, abs(new - amount[i]) / spread[i])
            amount[i] = new
        if moved < _SETTLED:
            break
    misfit = 0.0
    for k in range(count):
        value = np.float64(seen[k])
        if not np.isfinite(value):
            continue
        sigma = noise * abs(value) + floor
        for i in range(used):
            value -= amount[i] * parts[i, k]
        misfit += (value / sigma) ** 2
    return np.sqrt(misfit / known)


@kernel
def unmix_lines(
    seen: Array,
    body_of: Array,
    bodies: Array,
    neighbours: Array,
    direct: Array,
    diffuse: Array,
    noise: Any,
    floor: Any,
    expected: Array,
    spread: Array,
    most: Array,
    amount: Array,
    added: Array,
    together: Array,
    misfit: Array,
) -> None:
    """Unmix every pixel of a block of lines.

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
    noise, floor
        Standard deviation of a channel: relative to what is seen, and what is added [1].
    expected, spread : (part,), float64
        What amounts are without evidence, and how far from it they come to lie.
    most : (part,), float64
        Amounts are no larger.
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
    parts = np.empty((PARTS, channels))
    nothing = np.zeros(channels)
    found = np.empty(PARTS)
    for line in range(lines):
        for x in range(columns):
            number = body_of[line, x]
            if number < 0:
                amount[line, x] = np.nan
                added[line, x] = np.nan
                together[line, x] = np.nan
                misfit[line, x] = np.nan
                continue
            first, second = neighbours[line, x, 0], neighbours[line, x, 1]
            used = 4 if first < 0 else (6 if second < 0 else 8)
            one = nothing if first < 0 else bodies[first]
            other = nothing if second < 0 else bodies[second]
            body = bodies[number]
            fill_parts(body, direct, diffuse, one, other, parts)
            misfit[line, x] = solve(seen[line, x], parts, used, noise, floor, expected, spread, most, found)
            for part in range(PARTS):
                amount[line, x, part] = found[part]
            if found[0] != found[0]:
                added[line, x] = np.nan
                together[line, x] = np.nan
                continue
            most_first, most_second, most_both = 0.0, 0.0, 0.0
            for k in range(channels):
                of_first = found[4] * parts[4, k] + found[5] * parts[5, k]
                of_second = found[6] * parts[6, k] + found[7] * parts[7, k]
                most_first = max(most_first, of_first)
                most_second = max(most_second, of_second)
                most_both = max(most_both, of_first + of_second)
            added[line, x, 0], added[line, x, 1] = most_first, most_second
            together[line, x] = most_both
