"""Everything that a navigation record could mean, and how well each meaning fits the picture."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Floats
from hyperpaint.base.attitude_conventions import Convention

from .likelihood import CLIP, Residuals, inflation, residuals, robust_scale
from .picture_motion import RowMotion
from .pose_motion import Motion, Recorded, View

__all__ = ["Hypothesis", "Scored", "fields_of", "hypotheses_of", "score"]

Positions = Literal["as declared", "latitude and longitude swapped", "longitude west positive"]

POSITIONS: tuple[Positions, ...] = (
    "as declared", "latitude and longitude swapped", "longitude west positive",
)  # fmt: skip
_SENSES = {
    "roll_positive": ("right_wing_down", "right_wing_up"),
    "pitch_positive": ("nose_up", "nose_down"),
    "heading_positive": ("clockwise", "counterclockwise"),
    "angle_unit": ("degree", "radian"),
    "euler_order": ("ZYX", "ZXY", "XYZ"),
    "column_order": ("left_to_right", "right_to_left"),
}
_STEEPEST = 90.0
_RARE = 6.0
"""Logarithm of the odds against any one declaration being wrong."""


@dataclass(frozen=True)
class Hypothesis:
    """One meaning of a record.

    Attributes
    ----------
    convention
        What angles mean, and the order of columns.
    positions
        What latitude and longitude are.
    """

    convention: Convention
    positions: Positions = "as declared"

    def poses(self, recorded: Recorded, clock_offset_s: float = 0.0) -> Floats:
        """Return canonical poses (6, line)."""
        if self.positions == POSITIONS[1]:
            recorded = recorded.swapped()
        elif self.positions == POSITIONS[2]:
            recorded = recorded.mirrored()
        return recorded.at(self.convention, clock_offset_s)

    def view(self, view: View) -> View:
        """Return where zones look with this order of columns."""
        if self.convention.column_order != "right_to_left":
            return view
        return replace(view, right=-view.right, step=-view.step)


@dataclass(frozen=True)
class Scored:
    """A hypothesis and how well it fits.

    Attributes
    ----------
    hypothesis
        What is supposed.
    odds
        Logarithm of its probability over that of the most probable; 0 for that.
    over_rest
        The same over the likelihood of a platform that does not turn at all, from shifts alone.
    """

    hypothesis: Hypothesis
    odds: float
    over_rest: float


def fields_of(hypothesis: Hypothesis) -> dict[str, str]:
    """Return what a hypothesis says, field by field."""
    told = {name: getattr(hypothesis.convention, name) for name in _SENSES}
    return {**told, "positions": hypothesis.positions}


def hypotheses_of(declared: Convention, *, columns_matter: bool) -> Iterator[Hypothesis]:
    """Return all meanings, the declared one first."""
    senses = dict(_SENSES)
    if not columns_matter:
        senses["column_order"] = (str(declared.column_order),)
    options = []
    for name, choices in senses.items():
        own = getattr(declared, name)
        options.append((own, *(choice for choice in choices if choice != own)) if own in choices else choices)
    for positions in POSITIONS:
        for chosen in itertools.product(*options):
            told: dict[str, Any] = dict(zip(senses, chosen, strict=True))
            yield Hypothesis(replace(declared, **told), positions)


def score(
    seen: RowMotion,
    recorded: Recorded,
    view: View,
    declared: Hypothesis,
    *,
    columns_matter: bool,
    used: npt.NDArray[np.bool_],
    interval: float,
) -> list[Scored]:
    """Return hypotheses, the most probable first; those that cannot be are left out.

    Notes
    -----
    A picture cannot tell a world from its mirror image, in which roll, heading, the order of columns and
    longitudes are all of the other sign. So every declaration is taken as wrong with odds of 1 to 400 only.

    Residuals are taken as normal, those beyond `CLIP` standard deviations as outliers, and as fewer than they
    are by what those of the best resemble their neighbours; see `likelihood`.
    """
    found: list[tuple[Hypothesis, Residuals]] = []
    poses: dict[Any, Floats] = {}
    for hypothesis in hypotheses_of(declared.convention, columns_matter=columns_matter):
        key = (hypothesis.convention.replace(column_order=None), hypothesis.positions)
        if key not in poses:
            poses[key] = hypothesis.poses(recorded)
        made = poses[key]
        if not np.isfinite(made[0]).any() or np.nanmax(np.abs(made[0])) >= _STEEPEST:
            continue
        meant = hypothesis.view(view).motion(made)
        if not (np.isfinite(meant.shift) | ~used).all():
            continue
        found.append((hypothesis, residuals(seen, meant, used, interval)))
    if not found:
        return []
    # the same way over ground, at rest in all else
    rest = Motion(*(np.zeros_like(seen.shift) + np.median(part[used]) for part in (seen.shift, meant.travel)))
    shift = _costs([left.shift for _, left in found] + [residuals(seen, rest, used, interval).shift], used)
    total = shift[:-1] + _costs([left.unlikeness for _, left in found], used)
    own = fields_of(declared)
    total += _RARE * np.array([sum(own[n] != v for n, v in fields_of(h).items()) for h, _ in found])
    scored = [
        Scored(h, float(total.min() - cost), float(shift[-1] - own))
        for (h, _), cost, own in zip(found, total, shift, strict=False)
    ]
    return sorted(scored, key=lambda one: -one.odds)


def _costs(left: list[Floats], used: npt.NDArray[np.bool_]) -> Floats:
    """Return negative logarithms of likelihoods, but for a constant."""
    scales = [robust_scale(one[used]) for one in left]
    best = int(np.argmin(scales))
    scale, fewer = scales[best], inflation(left[best])
    return np.array([0.5 * np.minimum((one[used] / scale) ** 2, CLIP**2).sum() for one in left]) / fewer
