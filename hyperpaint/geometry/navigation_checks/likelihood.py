"""How well motion that poses mean fits motion that a picture shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Floats

from .picture_motion import RowMotion
from .pose_motion import Motion

__all__ = ["Residuals", "inflation", "residuals", "robust_scale"]


CLIP = 4.0
"""Standard deviations at which a residual counts no more."""
SLANT, LATE = 0.3, 0.005
"""How far structures on the ground lean [pixel sideways a pixel forward]; how late a clock may be [s]."""
_FARTHEST_LAG = 64
_EPS = 1e-30


@dataclass(frozen=True)
class Residuals:
    """What a hypothesis leaves unexplained.

    Attributes
    ----------
    shift : (line - 1, zone)
        [pixel].
    unlikeness : (line - 1, zone)
        [1].
    """

    shift: Floats
    unlikeness: Floats


def robust_scale(values: Floats) -> float:
    """Return the standard deviation of values about 0, by the median of their size; NaN is left out."""
    known = np.abs(values[np.isfinite(values)])
    return max(1.4826 * float(np.median(known)), 1e-9) if known.size else float("nan")


def residuals(seen: RowMotion, meant: Motion, used: npt.NDArray[np.bool_], interval: float) -> Residuals:
    """Return what is left of a picture's motion, the ground's slant and the clock's lag taken out.

    Parameters
    ----------
    seen, meant
        Motion of the picture, and of the poses.
    used : (line - 1, zone)
        Which are compared.
    interval
        Between lines [s].

    Notes
    -----
    Whatever leans on the ground seems to move sideways as the camera moves on: in proportion to the way, and
    for every line alike where structures are parallel. That part is not told from a heading that is off, and
    taken out before hypotheses are compared; as is what a clock that is late by some milliseconds would do.
    """
    late = np.gradient(meant.shift, axis=0) / interval if meant.shift.shape[0] > 1 else 0 * meant.shift
    shift = _without(seen.shift - meant.shift, [(meant.travel, SLANT), (late, LATE)], used)
    alike = np.interp(np.abs(meant.travel), np.arange(seen.structure.size), seen.structure)
    return Residuals(shift, _unexplained(seen.unlikeness, alike, used))


def _without(values: Floats, parts: list[tuple[Floats, float]], used: npt.NDArray[np.bool_]) -> Floats:
    """Return values less parts of known form and of unknown, but bounded, size; robust."""
    design = np.stack([np.where(used, part, 0.0) for part, _ in parts])
    limits = np.array([limit for _, limit in parts])
    left = values
    for _ in range(3):
        scale = robust_scale(left[used])
        kept = used & (np.abs(left) < CLIP * scale)
        a = design[:, kept]
        normal = a @ a.T / scale**2 + np.diag(limits**-2.0)
        size = np.linalg.solve(normal, a @ values[kept] / scale**2)
        left = values - np.tensordot(size, design, 1)
    return np.where(used, left, np.nan)


def _unexplained(values: Floats, alike: Floats, used: npt.NDArray[np.bool_]) -> Floats:
    """Return values less a constant and a multiple of ``alike`` that is not negative; robust."""
    left = values - np.median(values[used])
    for _ in range(3):
        kept = used & (np.abs(left) < CLIP * robust_scale(left[used]))
        x, y = alike[kept], values[kept]
        slope = ((x - x.mean()) * (y - y.mean())).sum() / max(((x - x.mean()) ** 2).sum(), _EPS)
        slope = max(float(slope), 0.0)
        left = values - (y.mean() + slope * (alike - x.mean()))
    return np.where(used, left, np.nan)


def inflation(left: Floats) -> float:
    """Return by how much residuals (line, zone) are fewer than they are many: they resemble their neighbours.

    Notes
    -----
    The ratio of the variance of means over lines and zones to what it would be were all independent, from
    the correlation of zones and that of lines up to `_FARTHEST_LAG` apart.
    """
    scale = robust_scale(left)
    values = np.clip(np.where(np.isfinite(left), left, 0.0), -CLIP * scale, CLIP * scale)
    values = values - values.mean()
    row = values.mean(axis=1)
    power = float((values**2).mean())
    if not power > 0.0 or row.size < 4:
        return 1.0
    zones = max(float((row**2).mean()) * values.shape[1] / power, 1.0)
    lags = range(1, min(_FARTHEST_LAG, row.size // 4))
    own = float((row**2).mean())
    sums = [float((row[k:] * row[:-k]).sum()) / (own * row.size) for k in lags]
    total = 1.0
    for first, second in zip(sums[::2], sums[1::2], strict=False):
        if first + second <= 0.0:  # Geyer (1992): sums of pairs are positive, but for noise
            break
        total += 2.0 * (first + second)
    return float(zones * total)
