"""Fit of the motion expected from poses to the motion of a picture; best clock offset and height."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hyperpaint.base.arrays import Bools, Floats

from .picture_motion import RowMotion
from .pose_motion import Motion, View


@dataclass(frozen=True)
class Rules:
    """Thresholds of the fit; set on simulated flights."""

    clip_sd: float = 4.0  #: standard deviations at which the cost of a residual is limited
    max_slant: float = 0.3  #: slant of structures on the ground [pixel sideways per pixel forward]
    max_lag_s: float = 0.005  #: allowed clock lag while conventions are compared
    max_lag_lines: int = 64  #: largest distance of lines for correlations of residuals
    time_step_s: float = 0.002  #: step of numerical derivatives in time
    max_tilt_deg: float = 2.0  #: prior error of the boresight's pitch
    turn_step_deg: float = 1.0  #: step of numerical derivatives in pitch
    #: Lines of a block, over which structures on the ground have one slant, and minimum number of blocks.
    block_lines: int = 128
    min_blocks: int = 8
    #: Shift by structures on the ground that can be correlated with the platform's motion [pixel]: on calm
    #: simulated flights offsets scatter three times as much as blocks of lines suggest.
    unexplained_px: float = 0.006
    outlier_sd: float = 2.5  #: standard deviations beyond which a shift is excluded from a clock fit
    smooth_lines: int = 9  #: lines over which motion is averaged
    max_steps: int = 12
    converged_sd: float = 0.1  #: largest last step, relative to the uncertainty
    max_step_s: float = 0.03
    height_factors: tuple[float, ...] = tuple(np.geomspace(1 / 4, 4.0, 49).tolist())


RULES = Rules()
_EPS = 1e-30


def robust_scale(values: Floats) -> float:
    """Return the standard deviation of values about 0 from the median of their size; NaN is ignored."""
    sizes = np.abs(values[np.isfinite(values)])
    return max(1.4826 * float(np.median(sizes)), 1e-9) if sizes.size else float("nan")


def residuals(
    observed: RowMotion, expected: Motion, compared: Bools, interval: float
) -> tuple[Floats, Floats]:
    """Return the motion of a picture minus expected motion, slant of the ground and lag of the clock.

    Shift [pixel] and unlikeness [1], both (line - 1, zone).

    ``observed`` and ``expected`` are the motion of the picture and of the poses, used where ``compared``
    (line - 1, zone); ``interval`` is the time between lines [s].

    Notes
    -----
    Slanted structures on the ground seem to move sideways as the camera moves forward: in proportion to the
    travel, and equally in every line where structures are parallel. That part looks like an error of the
    heading, and is subtracted before hypotheses are compared, as is the effect of a clock lag of some
    milliseconds.
    """
    shift_per_lag = (
        np.gradient(expected.shift, axis=0) / interval if expected.shift.shape[0] > 1 else 0 * expected.shift
    )
    # shifts without terms of known form and unknown, but bounded, size; robust
    design = np.stack([np.where(compared, term, 0.0) for term in (expected.travel, shift_per_lag)])
    limits = np.array([RULES.max_slant, RULES.max_lag_s])
    values = shift = observed.shift - expected.shift
    for _ in range(3):
        scale = robust_scale(shift[compared])
        inliers = compared & (np.abs(shift) < RULES.clip_sd * scale)
        a = design[:, inliers]
        sizes = np.linalg.solve(a @ a.T / scale**2 + np.diag(limits**-2.0), a @ values[inliers] / scale**2)
        shift = values - np.tensordot(sizes, design, 1)
    # unlikeness without a constant and a non-negative multiple of the expected one; robust
    expected_unlikeness = np.interp(
        np.abs(expected.travel), np.arange(observed.structure.size), observed.structure
    )
    unlikeness = observed.unlikeness - np.median(observed.unlikeness[compared])
    for _ in range(3):
        inliers = compared & (np.abs(unlikeness) < RULES.clip_sd * robust_scale(unlikeness[compared]))
        x, y = expected_unlikeness[inliers], observed.unlikeness[inliers]
        slope = ((x - x.mean()) * (y - y.mean())).sum() / max(((x - x.mean()) ** 2).sum(), _EPS)
        unlikeness = observed.unlikeness - (
            y.mean() + max(float(slope), 0.0) * (expected_unlikeness - x.mean())
        )
    return np.where(compared, shift, np.nan), np.where(compared, unlikeness, np.nan)


def likelihood_costs(parts: Sequence[Floats], compared: Bools, independent: int | None = None) -> Floats:
    """Return negative logarithms of likelihoods of residuals (line, zone), up to a constant.

    The number of residuals is reduced by the correlation of those at ``independent``, by default the
    smallest.
    """
    scales = [robust_scale(part[compared]) for part in parts]
    smallest = int(np.argmin(scales))
    limited = [np.minimum((part[compared] / scales[smallest]) ** 2, RULES.clip_sd**2) for part in parts]
    costs = np.array([0.5 * squares.sum() for squares in limited])
    return costs / correlation_factor(parts[smallest if independent is None else independent])


def correlation_factor(residual: Floats) -> float:
    """Return the ratio of the number of residuals (line, zone) to the number of independent ones.

    Notes
    -----
    The ratio of the variance of means over lines and zones to the variance for independent residuals, from
    the correlation of zones, and of lines up to `RULES.max_lag_lines` apart.
    """
    scale = robust_scale(residual)
    values = np.clip(
        np.where(np.isfinite(residual), residual, 0.0), -RULES.clip_sd * scale, RULES.clip_sd * scale
    )
    values = values - values.mean()
    row_means = values.mean(axis=1)
    variance = float((values**2).mean())
    if not variance > 0.0 or row_means.size < 4:
        return 1.0
    zone_factor = max(float((row_means**2).mean()) * values.shape[1] / variance, 1.0)
    lags = range(1, min(RULES.max_lag_lines, row_means.size // 4))
    row_variance = float((row_means**2).mean())
    sums = [float((row_means[k:] * row_means[:-k]).sum()) / (row_variance * row_means.size) for k in lags]
    total = 1.0
    for first, second in zip(sums[::2], sums[1::2], strict=False):
        if first + second <= 0.0:  # Geyer (1992): sums of pairs are positive, but for noise
            break
        total += 2.0 * (first + second)
    return float(zone_factor * total)


@dataclass(frozen=True)
class Refined:
    """A number estimated from the picture."""

    value: float  #: Estimate and standard uncertainty
    sd: float
    odds: float  #: Logarithm of the likelihood relative to the declared number


def fit_clock(
    observed: RowMotion, poses: Callable[[float], Floats], view: View, compared: Bools, start: float = 0.0
) -> Refined:
    """Return the offset of the clock [s] at which poses and picture move together.

    ``poses`` returns canonical poses (6, line) at an offset; shifts enter where ``compared`` (line - 1,
    zone); ``start`` is an approximate offset [s].

    Notes
    -----
    Gauss-Newton iterations, which also fit the pitch of the boresight, which couples to the rate of heading,
    and, for every zone and block of lines, the slant of the ground. The uncertainty combines a jackknife over
    blocks of lines (Efron, 1982), which needs no model of the correlation of neighbouring residuals,
    with `RULES.unexplained_px`.
    """
    offset, sd = start, np.inf
    first = last = 0.0
    for iteration in range(RULES.max_steps):
        expected = view.motion(poses(offset))
        shifts = (view.motion(poses(offset + sign * RULES.time_step_s)).shift for sign in (1.0, -1.0))
        per_offset = np.subtract(*shifts) / (2.0 * RULES.time_step_s)
        roll, pitch, heading = view.boresight
        per_pitch = (
            view.motion(poses(offset), boresight=(roll, pitch + RULES.turn_step_deg, heading)).shift
            - expected.shift
        )
        step, sd, last = _fit_step(
            observed.shift - expected.shift, (per_offset, per_pitch), expected.travel, compared
        )
        first = last if iteration == 0 else first
        offset += float(np.clip(step, -RULES.max_step_s, RULES.max_step_s))
        if abs(step) < RULES.converged_sd * sd:
            return Refined(offset, sd, first - last)
    return Refined(offset, float("inf"), first - last)


def costs_of(
    observed: RowMotion, poses: Callable[[float], Floats], view: View, compared: Bools, offsets: Floats
) -> Floats:
    """Return the robust standard deviation of shifts (offset,) [pixel] at offsets of the clock [s].

    NaN where less than half of the picture has a pose.
    """
    costs = np.full(offsets.size, np.nan)
    for k, offset in enumerate(offsets):
        expected = view.motion(poses(float(offset)))
        residual = np.where(compared, observed.shift - expected.shift, np.nan)
        # subtract the part proportional to travel, which comes from slanted structures
        inliers = np.isfinite(residual) & (np.abs(residual) < RULES.clip_sd * robust_scale(residual))
        x, y = expected.travel[inliers], residual[inliers]
        slant = np.clip(float((y * x).sum() / max((x**2).sum(), 1e-12)), -RULES.max_slant, RULES.max_slant)
        residual = residual - slant * expected.travel
        if np.isfinite(residual).sum() > 0.5 * compared.sum():
            limit = (RULES.outlier_sd * robust_scale(residual)) ** 2
            costs[k] = np.sqrt(np.nanmean(np.minimum(residual**2, limit)))
    return costs


def amplitude(observed: RowMotion, expected: Floats, rest: Floats, compared: Bools) -> float:
    """Return the ratio of measured to expected shifts, both less the shifts of a platform at rest."""
    is_valid = compared & np.isfinite(expected) & np.isfinite(rest)
    residual = observed.shift - expected
    is_valid &= np.abs(residual) < RULES.clip_sd * robust_scale(residual[is_valid])
    expected_motion, observed_motion = (
        _running_mean(np.where(is_valid, part - rest, 0.0)) for part in (expected, observed.shift)
    )
    expected_motion, observed_motion = (
        expected_motion - expected_motion.mean(axis=0),
        observed_motion - observed_motion.mean(axis=0),
    )
    return float((expected_motion * observed_motion).sum() / max((expected_motion**2).sum(), 1e-12))


def _fit_step(
    values: Floats, parts: tuple[Floats, ...], travel: Floats, compared: Bools
) -> tuple[float, float, float]:
    # Return the size of the first part, its uncertainty, and the cost without it.
    is_valid = compared & np.isfinite(values) & np.isfinite(parts).all(axis=0) & np.isfinite(travel)
    scale = robust_scale(values[is_valid])
    is_valid &= np.abs(values) < RULES.outlier_sd * scale
    # smoothing: noise of attitude has opposite signs in neighbouring lines, motion has not
    design = np.stack([_running_mean(np.where(is_valid, part, 0.0)) for part in parts], axis=-1)
    target = _running_mean(np.where(is_valid, values, 0.0))
    scale = robust_scale(target[is_valid])
    count = max(values.shape[0] // RULES.block_lines, RULES.min_blocks)
    blocks = np.array_split(np.arange(values.shape[0]), count)
    smooth_travel = _running_mean(np.where(is_valid, travel, 0.0))
    for b in blocks:
        target[b] = _without_slope(target[b], smooth_travel[b])
        for k in range(len(parts)):
            design[b, :, k] = _without_slope(design[b, :, k], smooth_travel[b])
    matrices = np.stack([np.einsum("nzi,nzj->ij", design[b], design[b]) for b in blocks]) / scale**2
    vectors = np.stack([np.einsum("nzi,nz->i", design[b], target[b]) for b in blocks]) / scale**2
    matrix, vector = (
        matrices.sum(0) + np.diag([1.0, (RULES.turn_step_deg / RULES.max_tilt_deg) ** 2]),
        vectors.sum(0),
    )
    sizes = np.linalg.solve(matrix, vector)
    sd = max(_jackknife(matrices, vectors, matrix, vector, group) for group in (1, 2))
    rms_shift = float(np.sqrt((design[..., 0][is_valid] ** 2).mean()))
    sd = float(np.hypot(sd, RULES.unexplained_px / max(rms_shift, 1e-12)))
    residual = target - design[..., 1:] @ sizes[1:]
    factor = correlation_factor(np.where(is_valid, target - design @ sizes, np.nan))
    return (
        float(sizes[0]),
        sd,
        0.5 * float(np.minimum((residual[is_valid] / scale) ** 2, RULES.clip_sd**2).sum()) / factor,
    )


def _jackknife(matrices: Floats, vectors: Floats, matrix: Floats, vector: Floats, group: int) -> float:
    # Leave out groups of neighbouring blocks in turn.
    starts = np.arange(0, matrices.shape[0], group)
    matrices, vectors = (np.add.reduceat(a, starts, axis=0) for a in (matrices, vectors))
    count = starts.size
    estimates = np.array(
        [np.linalg.solve(matrix - a, vector - b)[0] for a, b in zip(matrices, vectors, strict=True)]
    )
    return float(np.sqrt((count - 1) / count * ((estimates - estimates.mean()) ** 2).sum()))


def _without_slope(values: Floats, travel: Floats) -> Floats:
    # Subtract from values (line, zone), zone by zone, the part proportional to travel.
    slope = (values * travel).sum(axis=0) / np.maximum((travel**2).sum(axis=0), 1e-12)
    return np.asarray(values - slope * travel)


def _running_mean(values: Floats) -> Floats:
    from scipy.ndimage import uniform_filter1d

    return np.asarray(uniform_filter1d(values, RULES.smooth_lines, axis=0, mode="constant"))


def fit_height(
    observed: RowMotion, poses: Floats, view: View, compared: Bools, interval: float, height: float
) -> Refined:
    """Return the height above the ground [m] at which travel over ground is consistent with rotations.

    Shifts by rotation do not depend on the height, shifts by travel are proportional to its
    inverse. Travel shows sideways where the platform drifts, by the wobble of its heading, and along
    the track by the likeness of rows.
    """
    factors = np.array(RULES.height_factors)
    heights = height * factors
    motions = [replace(view, ground=view.ground + height - float(h)).motion(poses) for h in heights]
    shifts, unlikeness = zip(*(residuals(observed, m, compared, interval) for m in motions), strict=True)
    middle = factors.size // 2
    cost = likelihood_costs(shifts, compared, middle) + likelihood_costs(unlikeness, compared, middle)
    best = int(cost.argmin())
    plausible = heights[cost < cost[best] + 2.0]  # within two standard deviations
    sd = float(plausible[-1] - plausible[0]) / 4.0 if 0 < best < heights.size - 1 else np.inf
    step = float(heights[best] * np.log(factors[1] / factors[0]))
    declared = float(np.interp(height, heights, cost))
    return Refined(float(heights[best]), max(sd, step / 2), declared - float(cost[best]))
