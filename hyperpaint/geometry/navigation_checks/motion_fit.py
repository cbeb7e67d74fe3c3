"""Fit of the motion expected from poses to the motion of a picture; best clock offset and height."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from hyperpaint.base.arrays import Bools, Floats

from .picture_motion import RowMotion
from .pose_motion import Motion, View


@dataclass(frozen=True)
class Rules:
    """Thresholds of the fit; set on simulated flights."""

    clip_sd: float = 4.0  #: standard deviations at which a residual counts no more
    max_slant: float = 0.3  #: lean of structures on the ground [pixel sideways a pixel forward]
    max_late_s: float = 0.005  #: how late a clock may be while meanings are compared
    max_lag_lines: int = 64  #: over which residuals are taken to resemble their neighbours
    time_step_s: float = 0.002  #: over which motion is differenced in time
    max_tilt_deg: float = 2.0  #: how far a boresight may be off in pitch
    turn_step_deg: float = 1.0  #: over which motion is differenced in pitch
    #: Lines over which structures on the ground are taken to lean alike, and least number of such blocks.
    block_lines: int = 128
    min_blocks: int = 8
    #: Shift that structures on the ground can keep up in step with a platform's motion [pixel]: on calm
    #: simulated flights offsets scatter by three times what blocks of lines would have them.
    unexplained_px: float = 0.006
    outlier_sd: float = 2.5  #: standard deviations at which a shift is left out of a fit of the clock
    smooth_lines: int = 9  #: that motion is averaged over
    max_steps: int = 12
    converged_sd: float = 0.1  #: part of the uncertainty that the last step is below
    max_step_s: float = 0.03
    height_factors: tuple[float, ...] = tuple(np.geomspace(1 / 4, 4.0, 49).tolist())


RULES = Rules()
_EPS = 1e-30


@dataclass(frozen=True)
class Residuals:
    """Motion of the picture that a hypothesis does not explain."""

    shift: Floats  #: (line - 1, zone) [pixel]
    unlikeness: Floats  #: (line - 1, zone) [1]


def robust_scale(values: Floats) -> float:
    """Return the standard deviation of values about 0, by the median of their size; NaN is left out."""
    sizes = np.abs(values[np.isfinite(values)])
    return max(1.4826 * float(np.median(sizes)), 1e-9) if sizes.size else float("nan")


def residuals(seen: RowMotion, meant: Motion, used: Bools, interval: float) -> Residuals:
    """Return the motion of a picture less the expected motion, the ground's slant and the clock's lag.

    ``seen`` and ``meant`` are the motion of the picture and of the poses, compared where ``used`` (line - 1,
    zone); ``interval`` is that between lines [s].

    Notes
    -----
    Whatever leans on the ground seems to move sideways as the camera moves on: in proportion to the way, and
    for every line alike where structures are parallel. That part looks like an error of the heading, and is
    taken out before hypotheses are compared; as is what a clock that is late by some milliseconds would do.
    """
    late = np.gradient(meant.shift, axis=0) / interval if meant.shift.shape[0] > 1 else 0 * meant.shift
    shift = _without(
        seen.shift - meant.shift, [(meant.travel, RULES.max_slant), (late, RULES.max_late_s)], used
    )
    alike = np.interp(np.abs(meant.travel), np.arange(seen.structure.size), seen.structure)
    return Residuals(shift, _unexplained(seen.unlikeness, alike, used))


def _without(values: Floats, parts: list[tuple[Floats, float]], used: Bools) -> Floats:
    # subtract parts of known form and unknown, but bounded, size; robust
    design = np.stack([np.where(used, part, 0.0) for part, _ in parts])
    limits = np.array([limit for _, limit in parts])
    left = values
    for _ in range(3):
        scale = robust_scale(left[used])
        inliers = used & (np.abs(left) < RULES.clip_sd * scale)
        a = design[:, inliers]
        size = np.linalg.solve(a @ a.T / scale**2 + np.diag(limits**-2.0), a @ values[inliers] / scale**2)
        left = values - np.tensordot(size, design, 1)
    return np.where(used, left, np.nan)


def _unexplained(values: Floats, alike: Floats, used: Bools) -> Floats:
    # subtract a constant and a multiple of ``alike`` that is not negative; robust
    left = values - np.median(values[used])
    for _ in range(3):
        inliers = used & (np.abs(left) < RULES.clip_sd * robust_scale(left[used]))
        x, y = alike[inliers], values[inliers]
        slope = ((x - x.mean()) * (y - y.mean())).sum() / max(((x - x.mean()) ** 2).sum(), _EPS)
        slope = max(float(slope), 0.0)
        left = values - (y.mean() + slope * (alike - x.mean()))
    return np.where(used, left, np.nan)


def inflation(left: Floats) -> float:
    """Return the ratio of the number of residuals (line, zone) to the number of independent ones.

    Notes
    -----
    The ratio of the variance of means over lines and zones to what it would be were all independent, from
    the correlation of zones and that of lines up to `RULES.max_lag_lines` apart.
    """
    scale = robust_scale(left)
    values = np.clip(np.where(np.isfinite(left), left, 0.0), -RULES.clip_sd * scale, RULES.clip_sd * scale)
    values = values - values.mean()
    row = values.mean(axis=1)
    power = float((values**2).mean())
    if not power > 0.0 or row.size < 4:
        return 1.0
    zones = max(float((row**2).mean()) * values.shape[1] / power, 1.0)
    lags = range(1, min(RULES.max_lag_lines, row.size // 4))
    own = float((row**2).mean())
    sums = [float((row[k:] * row[:-k]).sum()) / (own * row.size) for k in lags]
    total = 1.0
    for first, second in zip(sums[::2], sums[1::2], strict=False):
        if first + second <= 0.0:  # Geyer (1992): sums of pairs are positive, but for noise
            break
        total += 2.0 * (first + second)
    return float(zones * total)


@dataclass(frozen=True)
class Refined:
    """A number estimated from the picture."""

    value: float  #: The number and its standard uncertainty
    sd: float
    odds: float  #: Logarithm of the likelihood over that of the number declared


def fit_clock(
    seen: RowMotion, poses: Callable[[float], Floats], view: View, used: Bools, start: float = 0.0
) -> Refined:
    """Return the offset of the clock [s] at which poses and picture move together.

    ``poses`` gives canonical poses (6, line) at an offset; what is ``used`` (line - 1, zone) is compared;
    ``start`` is an offset that is already nearly right [s].

    Notes
    -----
    Gauss and Newton's method; fitted with it are a boresight's pitch, which couples to the heading's rate,
    and, for every zone and block of lines, the ground's slant. The uncertainty is that of a jackknife over
    blocks of lines (Efron, 1982), which asks nothing about how neighbouring residuals depend on one another,
    and of `RULES.unexplained_px`.
    """
    offset, sd = start, np.inf
    first = last = 0.0
    for turn in range(RULES.max_steps):
        meant = view.motion(poses(offset))
        later, earlier = (
            view.motion(poses(offset + RULES.time_step_s)),
            view.motion(poses(offset - RULES.time_step_s)),
        )
        late = (later.shift - earlier.shift) / (2.0 * RULES.time_step_s)
        roll, pitch, heading = view.boresight
        tilted = (
            view.motion(poses(offset), boresight=(roll, pitch + RULES.turn_step_deg, heading)).shift
            - meant.shift
        )
        step, sd, last = _solved(seen.shift - meant.shift, (late, tilted), meant.travel, used)
        first = last if turn == 0 else first
        offset += float(np.clip(step, -RULES.max_step_s, RULES.max_step_s))
        if abs(step) < RULES.converged_sd * sd:
            return Refined(offset, sd, first - last)
    return Refined(offset, float("inf"), first - last)


def costs_of(
    seen: RowMotion, poses: Callable[[float], Floats], view: View, used: Bools, offsets: Floats
) -> Floats:
    """Return the robust standard deviation of shifts (offset,) [pixel] at offsets of the clock [s].

    NaN where less than half of the picture has a pose.
    """
    costs = np.full(offsets.size, np.nan)
    for k, offset in enumerate(offsets):
        meant = view.motion(poses(float(offset)))
        left = _levelled(np.where(used, seen.shift - meant.shift, np.nan), meant.travel)
        if np.isfinite(left).sum() > 0.5 * used.sum():
            scale = robust_scale(left)
            costs[k] = np.sqrt(np.nanmean(np.minimum(left**2, (RULES.outlier_sd * scale) ** 2)))
    return costs


def _levelled(left: Floats, travel: Floats) -> Floats:
    # the part proportional to the way comes from structures that lean
    inliers = np.isfinite(left) & (np.abs(left) < RULES.clip_sd * robust_scale(left))
    lean = float((left[inliers] * travel[inliers]).sum() / max((travel[inliers] ** 2).sum(), 1e-12))
    return np.asarray(left - np.clip(lean, -RULES.max_slant, RULES.max_slant) * travel)


def amplitude(seen: RowMotion, meant: Floats, rest: Floats, used: Bools) -> float:
    """Return the ratio of measured to expected shifts, both less the shifts of a platform at rest."""
    good = used & np.isfinite(meant) & np.isfinite(rest)
    away = seen.shift - meant
    good &= np.abs(away) < RULES.clip_sd * robust_scale(away[good])
    x, y = (_smooth(np.where(good, part - rest, 0.0)) for part in (meant, seen.shift))
    x, y = x - x.mean(axis=0), y - y.mean(axis=0)
    return float((x * y).sum() / max((x**2).sum(), 1e-12))


def _solved(
    values: Floats, parts: tuple[Floats, ...], travel: Floats, used: Bools
) -> tuple[float, float, float]:
    # size of the first part, its uncertainty, and the cost before it is taken out
    good = used & np.isfinite(values) & np.isfinite(parts).all(axis=0) & np.isfinite(travel)
    scale = robust_scale(values[good])
    good &= np.abs(values) < RULES.outlier_sd * scale
    # the noise of attitudes is in neighbouring lines with opposite signs, their motion is not
    design = np.stack([_smooth(np.where(good, part, 0.0)) for part in parts], axis=-1)
    wanted = _smooth(np.where(good, values, 0.0))
    scale = robust_scale(wanted[good])
    count = max(values.shape[0] // RULES.block_lines, RULES.min_blocks)
    blocks = np.array_split(np.arange(values.shape[0]), count)
    lean = _smooth(np.where(good, travel, 0.0))
    for b in blocks:
        wanted[b] = _apart(wanted[b], lean[b])
        for k in range(len(parts)):
            design[b, :, k] = _apart(design[b, :, k], lean[b])
    normal = np.stack([np.einsum("nzi,nzj->ij", design[b], design[b]) for b in blocks]) / scale**2
    right = np.stack([np.einsum("nzi,nz->i", design[b], wanted[b]) for b in blocks]) / scale**2
    whole_a, whole_b = (
        normal.sum(0) + np.diag([1.0, (RULES.turn_step_deg / RULES.max_tilt_deg) ** 2]),
        right.sum(0),
    )
    size = np.linalg.solve(whole_a, whole_b)
    sd = max(_jackknife(normal, right, whole_a, whole_b, group) for group in (1, 2))
    motion = float(np.sqrt((design[..., 0][good] ** 2).mean()))
    sd = float(np.hypot(sd, RULES.unexplained_px / max(motion, 1e-12)))
    remains = wanted - design[..., 1:] @ size[1:]
    fewer = inflation(np.where(good, wanted - design @ size, np.nan))
    return (
        float(size[0]),
        sd,
        0.5 * float(np.minimum((remains[good] / scale) ** 2, RULES.clip_sd**2).sum()) / fewer,
    )


def _jackknife(normal: Floats, right: Floats, whole_a: Floats, whole_b: Floats, group: int) -> float:
    # groups of neighbouring blocks are left out in turn
    starts = np.arange(0, normal.shape[0], group)
    normal, right = (np.add.reduceat(a, starts, axis=0) for a in (normal, right))
    count = starts.size
    without = np.array(
        [np.linalg.solve(whole_a - a, whole_b - b)[0] for a, b in zip(normal, right, strict=True)]
    )
    return float(np.sqrt((count - 1) / count * ((without - without.mean()) ** 2).sum()))


def _apart(values: Floats, lean: Floats) -> Floats:
    # values (line, zone) less their part proportional to the way, zone by zone
    size = (values * lean).sum(axis=0) / np.maximum((lean**2).sum(axis=0), 1e-12)
    return np.asarray(values - size * lean)


def _smooth(values: Floats) -> Floats:
    from scipy.ndimage import uniform_filter1d

    return np.asarray(uniform_filter1d(values, RULES.smooth_lines, axis=0, mode="constant"))


def fit_height(
    seen: RowMotion, poses: Floats, view: View, used: Bools, interval: float, height: float
) -> Refined:
    """Return the height above the ground [m] at which the way over ground fits the turns of the platform.

    What a platform's turns do to the picture does not depend on its height, what its way does goes with the
    inverse of it. Sideways the way shows where the platform flies aslant, by the wobble of its heading; along
    the track by how alike rows are.
    """
    factors = np.array(RULES.height_factors)
    heights = height * factors
    cost = np.zeros(heights.size)
    left = []
    for h in heights:
        meant: Motion = replace(view, ground=view.ground + height - float(h)).motion(poses)
        left.append(residuals(seen, meant, used, interval))
    for part in ("shift", "unlikeness"):
        parts = [getattr(one, part) for one in left]
        scale, fewer = min(robust_scale(p[used]) for p in parts), inflation(parts[factors.size // 2])
        cost += (
            np.array([0.5 * np.minimum((p[used] / scale) ** 2, RULES.clip_sd**2).sum() for p in parts])
            / fewer
        )
    best = int(cost.argmin())
    near = heights[cost < cost[best] + 2.0]  # two standard deviations to either side
    sd = float(near[-1] - near[0]) / 4.0 if 0 < best < heights.size - 1 else np.inf
    step = float(heights[best] * np.log(factors[1] / factors[0]))
    declared = float(np.interp(height, heights, cost))
    return Refined(float(heights[best]), max(sd, step / 2), declared - float(cost[best]))
