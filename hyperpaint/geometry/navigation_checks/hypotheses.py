"""All possible conventions of a navigation record, and the fit of each to the picture."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from hyperpaint.base.arrays import Bools, Floats
from hyperpaint.base.attitude_conventions import Convention

from .motion_fit import RULES, Residuals, inflation, residuals, robust_scale
from .picture_motion import RowMotion
from .pose_motion import Motion, Recorded, View

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
_MAX_LATITUDE_DEG = 90.0
#: Logarithm of the odds against any one declaration being wrong.
_LOG_ODDS_AGAINST = 6.0


@dataclass(frozen=True)
class Hypothesis:
    """One possible convention of a record."""

    convention: Convention  #: What angles mean, and the order of columns
    positions: Positions = "as declared"  #: What latitude and longitude are

    def poses(self, recorded: Recorded, clock_offset_s: float = 0.0) -> Floats:
        """Return canonical poses (6, line)."""
        columns = recorded.columns
        if self.positions == POSITIONS[1]:
            columns = {**columns, "latitude": columns["longitude"], "longitude": columns["latitude"]}
        elif self.positions == POSITIONS[2]:
            columns = {**columns, "longitude": -columns["longitude"]}
        return replace(recorded, columns=columns).at(self.convention, clock_offset_s)

    def view(self, view: View) -> View:
        """Return the look directions of the zones for this order of columns."""
        if self.convention.column_order != "right_to_left":
            return view
        return replace(view, right=-view.right, step=-view.step)


@dataclass(frozen=True)
class Scored:
    """A hypothesis and its fit."""

    hypothesis: Hypothesis  #: What is supposed
    odds: float  #: Logarithm of its probability over that of the most probable; 0 for that
    #: The same over the likelihood of a platform that does not turn at all, from shifts alone
    over_rest: float


def fields_of(hypothesis: Hypothesis) -> dict[str, str]:
    """Return the fields of a hypothesis by name."""
    senses = {name: getattr(hypothesis.convention, name) for name in _SENSES}
    return {**senses, "positions": hypothesis.positions}


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
            meanings: dict[str, Any] = dict(zip(senses, chosen, strict=True))
            yield Hypothesis(replace(declared, **meanings), positions)


def score(
    seen: RowMotion,
    recorded: Recorded,
    view: View,
    declared: Hypothesis,
    *,
    columns_matter: bool,
    used: Bools,
    interval: float,
) -> list[Scored]:
    """Return hypotheses, the most probable first; those from which the ground is not seen are left out.

    Notes
    -----
    A picture does not separate a world from its mirror image, in which roll, heading, the order of columns
    and longitudes are all of the other sign. Every declaration is taken as wrong with odds of 1 to 400 only.

    Residuals are taken as normal, those beyond `RULES.clip_sd` standard deviations as outliers, and as fewer
    than they are by what those of the best resemble their neighbours; see `motion_fit`.
    """
    explained: list[tuple[Hypothesis, Residuals]] = []
    poses: dict[Any, Floats] = {}
    meant: Motion | None = None
    for hypothesis in hypotheses_of(declared.convention, columns_matter=columns_matter):
        key = (hypothesis.convention.replace(column_order=None), hypothesis.positions)
        if key not in poses:
            poses[key] = hypothesis.poses(recorded)
        canonical = poses[key]
        if not np.isfinite(canonical[0]).any() or np.nanmax(np.abs(canonical[0])) >= _MAX_LATITUDE_DEG:
            continue
        motion = hypothesis.view(view).motion(canonical)
        if not (np.isfinite(motion.shift) | ~used).all():
            continue
        meant = motion
        explained.append((hypothesis, residuals(seen, meant, used, interval)))
    if meant is None:
        return []
    # the same way over ground, at rest in all else
    rest = Motion(*(np.zeros_like(seen.shift) + np.median(part[used]) for part in (seen.shift, meant.travel)))
    shift = _costs(
        [left.shift for _, left in explained] + [residuals(seen, rest, used, interval).shift], used
    )
    total = shift[:-1] + _costs([left.unlikeness for _, left in explained], used)
    own = fields_of(declared)
    total += _LOG_ODDS_AGAINST * np.array(
        [sum(own[n] != v for n, v in fields_of(h).items()) for h, _ in explained]
    )
    scored = [
        Scored(h, float(total.min() - cost), float(shift[-1] - own))
        for (h, _), cost, own in zip(explained, total, shift, strict=False)
    ]
    return sorted(scored, key=lambda one: -one.odds)


def _costs(left: list[Floats], used: Bools) -> Floats:
    # negative logarithms of likelihoods up to a constant
    scales = [robust_scale(one[used]) for one in left]
    best = int(np.argmin(scales))
    scale, fewer = scales[best], inflation(left[best])
    return (
        np.array([0.5 * np.minimum((one[used] / scale) ** 2, RULES.clip_sd**2).sum() for one in left]) / fewer
    )
