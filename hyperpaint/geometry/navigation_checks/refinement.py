"""Clock and height once the meaning of a record is known: what changes motion little by little."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Floats

from .likelihood import CLIP, SLANT, inflation, residuals, robust_scale
from .picture_motion import RowMotion
from .pose_motion import Motion, View

__all__ = ["Refined", "amplitude", "costs_of", "fit_clock", "fit_height"]


_STEP = 0.002
"""Over which motion is differenced in time [s]."""
_TILT, _TURN = 2.0, 1.0
"""How far a boresight may be off in pitch, and the turn over which motion is differenced [degree]."""
_BLOCK, _FEWEST_BLOCKS = 128, 8
"""Lines over which structures on the ground are taken to lean alike, and least number of such blocks."""
_UNEXPLAINED = 0.006
"""Shift that structures on the ground can keep up in step with a platform's motion [pixel]; found on
simulated flights: on calm ones offsets scatter by three times what blocks of lines would have them."""
_OUTLYING = 2.5
"""Standard deviations at which a shift is left out of a fit."""
_SMOOTH = 9
"""Lines that motion is averaged over."""
_TURNS, _ARRIVED, _LEAP = 12, 0.1, 0.03
"""Most steps, part of the uncertainty that a last step is below, and longest step [s]."""
_FACTORS = np.geomspace(1 / 4, 4.0, 49)


@dataclass(frozen=True)
class Refined:
    """A number that the picture tells.

    Attributes
    ----------
    value, sd
        The number and its standard uncertainty.
    odds
        Logarithm of the likelihood over that of the number declared.
    """

    value: float
    sd: float
    odds: float


def fit_clock(
    seen: RowMotion,
    poses: Callable[[float], Floats],
    view: View,
    used: npt.NDArray[np.bool_],
    start: float = 0.0,
) -> Refined:
    """Return the offset of the clock [s] at which poses and picture move together.

    Parameters
    ----------
    seen
        Motion of the picture.
    poses
        Canonical poses (6, line) at an offset of the clock [s].
    view
        How the camera looks down.
    used : (line - 1, zone)
        What is compared.
    start
        Offset that is already nearly right [s].

    Notes
    -----
    Gauss and Newton's method; fitted with it are a boresight's pitch, which couples to the heading's rate,
    and, for every zone and block of lines, the ground's slant. The uncertainty is that of a jackknife over
    blocks of lines (Efron, 1982), which asks nothing about how neighbouring residuals depend on one another,
    and of `_UNEXPLAINED`.
    """
    offset, sd = start, np.inf
    first = last = 0.0
    for turn in range(_TURNS):
        meant = view.motion(poses(offset))
        later, earlier = view.motion(poses(offset + _STEP)), view.motion(poses(offset - _STEP))
        late = (later.shift - earlier.shift) / (2.0 * _STEP)
        roll, pitch, heading = view.boresight
        tilted = view.motion(poses(offset), boresight=(roll, pitch + _TURN, heading)).shift - meant.shift
        step, sd, last = _solved(seen.shift - meant.shift, (late, tilted), meant.travel, used)
        first = last if turn == 0 else first
        offset += float(np.clip(step, -_LEAP, _LEAP))
        if abs(step) < _ARRIVED * sd:
            return Refined(offset, sd, first - last)
    return Refined(offset, float("inf"), first - last)


def costs_of(
    seen: RowMotion,
    poses: Callable[[float], Floats],
    view: View,
    used: npt.NDArray[np.bool_],
    offsets: Floats,
) -> Floats:
    """Return the robust standard deviation of shifts (offset,) [pixel] at offsets of the clock [s].

    NaN where less than half of the picture has a pose.
    """
    made = np.full(offsets.size, np.nan)
    for k, offset in enumerate(offsets):
        meant = view.motion(poses(float(offset)))
        left = _levelled(np.where(used, seen.shift - meant.shift, np.nan), meant.travel)
        if np.isfinite(left).sum() > 0.5 * used.sum():
            scale = robust_scale(left)
            made[k] = np.sqrt(np.nanmean(np.minimum(left**2, (_OUTLYING * scale) ** 2)))
    return made


def _levelled(left: Floats, travel: Floats) -> Floats:
    """Return residuals less what leans on the ground, which is in proportion to the way."""
    known = np.isfinite(left) & (np.abs(left) < CLIP * robust_scale(left))
    lean = float((left[known] * travel[known]).sum() / max((travel[known] ** 2).sum(), 1e-12))
    return np.asarray(left - np.clip(lean, -SLANT, SLANT) * travel)


def amplitude(seen: RowMotion, meant: Floats, rest: Floats, used: npt.NDArray[np.bool_]) -> float:
    """Return what shifts of the picture are of those expected, both less those of a platform at rest."""
    good = used & np.isfinite(meant) & np.isfinite(rest)
    away = seen.shift - meant
    good &= np.abs(away) < CLIP * robust_scale(away[good])
    x, y = (_smooth(np.where(good, part - rest, 0.0)) for part in (meant, seen.shift))
    x, y = x - x.mean(axis=0), y - y.mean(axis=0)
    return float((x * y).sum() / max((x**2).sum(), 1e-12))


def _solved(
    values: Floats, parts: tuple[Floats, ...], travel: Floats, used: npt.NDArray[np.bool_]
) -> tuple[float, float, float]:
    """Return the size of the first part, its uncertainty, and the cost before it is taken out."""
    good = used & np.isfinite(values) & np.isfinite(parts).all(axis=0) & np.isfinite(travel)
    scale = robust_scale(values[good])
    good &= np.abs(values) < _OUTLYING * scale
    # the noise of attitudes is in neighbouring lines with opposite signs, their motion is not
    design = np.stack([_smooth(np.where(good, part, 0.0)) for part in parts], axis=-1)
    wanted = _smooth(np.where(good, values, 0.0))
    scale = robust_scale(wanted[good])
    count = max(values.shape[0] // _BLOCK, _FEWEST_BLOCKS)
    blocks = np.array_split(np.arange(values.shape[0]), count)
    lean = _smooth(np.where(good, travel, 0.0))
    for b in blocks:
        wanted[b] = _apart(wanted[b], lean[b])
        for k in range(len(parts)):
            design[b, :, k] = _apart(design[b, :, k], lean[b])
    normal = np.stack([np.einsum("nzi,nzj->ij", design[b], design[b]) for b in blocks]) / scale**2
    right = np.stack([np.einsum("nzi,nz->i", design[b], wanted[b]) for b in blocks]) / scale**2
    whole_a, whole_b = normal.sum(0) + np.diag([1.0, (_TURN / _TILT) ** 2]), right.sum(0)
    size = np.linalg.solve(whole_a, whole_b)
    sd = max(_jackknife(normal, right, whole_a, whole_b, group) for group in (1, 2))
    motion = float(np.sqrt((design[..., 0][good] ** 2).mean()))
    sd = float(np.hypot(sd, _UNEXPLAINED / max(motion, 1e-12)))
    remains = wanted - design[..., 1:] @ size[1:]
    fewer = inflation(np.where(good, wanted - design @ size, np.nan))
    return float(size[0]), sd, 0.5 * float(np.minimum((remains[good] / scale) ** 2, CLIP**2).sum()) / fewer


def _jackknife(normal: Floats, right: Floats, whole_a: Floats, whole_b: Floats, group: int) -> float:
    """Return the uncertainty of the first part when groups of neighbouring blocks are left out in turn."""
    starts = np.arange(0, normal.shape[0], group)
    normal, right = (np.add.reduceat(a, starts, axis=0) for a in (normal, right))
    count = starts.size
    without = np.array(
        [np.linalg.solve(whole_a - a, whole_b - b)[0] for a, b in zip(normal, right, strict=True)]
    )
    return float(np.sqrt((count - 1) / count * ((without - without.mean()) ** 2).sum()))


def _apart(values: Floats, lean: Floats) -> Floats:
    """Return values (line, zone) less what is in proportion to the way, zone by zone."""
    size = (values * lean).sum(axis=0) / np.maximum((lean**2).sum(axis=0), 1e-12)
    return np.asarray(values - size * lean)


def _smooth(values: Floats) -> Floats:
    from scipy.ndimage import uniform_filter1d

    return np.asarray(uniform_filter1d(values, _SMOOTH, axis=0, mode="constant"))


def fit_height(
    seen: RowMotion, poses: Floats, view: View, used: npt.NDArray[np.bool_], interval: float, height: float
) -> Refined:
    """Return the height above the ground [m] at which the way over ground fits the turns of the platform.

    What a platform's turns do to the picture does not depend on its height, what its way does goes with the
    inverse of it. Sideways the way shows where the platform flies aslant, by the wobble of its heading; along
    the track by how alike rows are.
    """
    heights = height * _FACTORS
    cost = np.zeros(heights.size)
    left = []
    for h in heights:
        meant: Motion = replace(view, ground=view.ground + height - float(h)).motion(poses)
        left.append(residuals(seen, meant, used, interval))
    for part in ("shift", "unlikeness"):
        parts = [getattr(one, part) for one in left]
        scale, fewer = min(robust_scale(p[used]) for p in parts), inflation(parts[_FACTORS.size // 2])
        cost += np.array([0.5 * np.minimum((p[used] / scale) ** 2, CLIP**2).sum() for p in parts]) / fewer
    best = int(cost.argmin())
    near = heights[cost < cost[best] + 2.0]  # two standard deviations to either side
    sd = float(near[-1] - near[0]) / 4.0 if 0 < best < heights.size - 1 else np.inf
    step = float(heights[best] * np.log(_FACTORS[1] / _FACTORS[0]))
    declared = float(np.interp(height, heights, cost))
    return Refined(float(heights[best]), max(sd, step / 2), declared - float(cost[best]))
