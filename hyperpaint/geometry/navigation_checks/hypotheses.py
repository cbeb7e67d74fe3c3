"""All possible conventions of a navigation record, and the fit of each to the picture."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from hyperpaint.base.arrays import Bools, Floats
from hyperpaint.base.attitude_conventions import Convention

from .motion_fit import likelihood_costs, residuals
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
#: Prior logarithm of the odds that a declaration is right.
_LOG_ODDS_AGAINST = 6.0


@dataclass(frozen=True)
class Hypothesis:
    """One possible convention of a record."""

    convention: Convention  #: Meaning of angles, and order of columns
    positions: Positions = "as declared"  #: Meaning of latitude and longitude

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

    hypothesis: Hypothesis  #: Supposed convention
    odds: float  #: Logarithm of its probability relative to the most probable hypothesis, whose odds are 0
    #: Logarithm of the likelihood relative to a platform without rotation, from shifts alone
    over_rest: float


def fields_of(hypothesis: Hypothesis) -> dict[str, str]:
    """Return the fields of a hypothesis by name."""
    senses = {name: getattr(hypothesis.convention, name) for name in _SENSES}
    return {**senses, "positions": hypothesis.positions}


def score(
    observed: RowMotion,
    recorded: Recorded,
    view: View,
    declared: Hypothesis,
    *,
    columns_matter: bool,
    compared: Bools,
    interval: float,
) -> list[Scored]:
    """Return hypotheses, the most probable first; those from which the ground is not seen are left out.

    Notes
    -----
    A picture cannot distinguish a scene from its mirror image, in which roll, heading, the order of columns
    and longitude have opposite signs. The prior odds that a declaration is wrong are therefore 1 to 400.

    Residuals are assumed normal, with outliers beyond `RULES.clip_sd` standard deviations; their number is
    reduced by the correlation of the best hypothesis' residuals with their neighbours; see `motion_fit`.
    """
    # all possible conventions, the declared one first
    convention = declared.convention
    senses = _SENSES if columns_matter else {**_SENSES, "column_order": (str(convention.column_order),)}
    declared_first: list[Any] = [
        sorted(choices, key=lambda choice: choice != getattr(convention, name))
        for name, choices in senses.items()
    ]
    explained: list[tuple[Hypothesis, Floats, Floats]] = []
    poses_by_convention: dict[Any, Floats] = {}
    expected: Motion | None = None
    for positions, *choices in itertools.product(POSITIONS, *declared_first):
        meanings: dict[str, Any] = dict(zip(senses, choices, strict=True))
        hypothesis = Hypothesis(replace(convention, **meanings), positions)
        key = (hypothesis.convention.replace(column_order=None), hypothesis.positions)
        if key not in poses_by_convention:
            poses_by_convention[key] = hypothesis.poses(recorded)
        canonical = poses_by_convention[key]
        if not np.isfinite(canonical[0]).any() or np.nanmax(np.abs(canonical[0])) >= _MAX_LATITUDE_DEG:
            continue
        motion = hypothesis.view(view).motion(canonical)
        if not (np.isfinite(motion.shift) | ~compared).all():
            continue
        expected = motion
        explained.append((hypothesis, *residuals(observed, expected, compared, interval)))
    if expected is None:
        return []
    # the same travel over ground, without rotation
    no_rotation = Motion(
        *(
            np.zeros_like(observed.shift) + np.median(part[compared])
            for part in (observed.shift, expected.travel)
        )
    )
    shift_at_rest, _ = residuals(observed, no_rotation, compared, interval)
    shift_costs = likelihood_costs([*(shift for _, shift, _ in explained), shift_at_rest], compared)
    costs = shift_costs[:-1] + likelihood_costs([unlikeness for *_, unlikeness in explained], compared)
    declared_fields = fields_of(declared)
    costs += _LOG_ODDS_AGAINST * np.array(
        [sum(declared_fields[n] != v for n, v in fields_of(h).items()) for h, *_ in explained]
    )
    scored = [
        Scored(h, float(costs.min() - cost), float(shift_costs[-1] - shift_cost))
        for (h, *_), cost, shift_cost in zip(explained, costs, shift_costs, strict=False)
    ]
    return sorted(scored, key=lambda hypothesis: -hypothesis.odds)
