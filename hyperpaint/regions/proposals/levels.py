"""How bright the roof of a car is where it is level."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hyperpaint.base.arrays import Bools, Floats

__all__ = ["LEVELS", "Levelled", "level_light"]


@dataclass(frozen=True)
class LevelRules:
    """The fit to a roof's brightness."""

    rounds: int = 30  #: Turns in which glint is left out of the plane through a roof's brightness.
    #: Residuals that stay in the fit above the plane: glint only adds [standard deviation].
    max_above_sd: float = 1.5
    max_below_sd: float = 3.0  #: The same below it [standard deviation].
    min_sd: float = 0.003  #: That standard deviation relative to the brightness, at least [1].
    min_fitted_px: int = 25  #: Pixels of the fit, at least.


LEVELS = LevelRules()


class Levelled(NamedTuple):
    """Brightness of a roof."""

    middle: float  #: In its middle, relative to what brightness is given in [1].
    misfit: float  #: How far what is seen there is off the fit [1].
    unsure: float  #: What it may be off by because the middle is elsewhere [1].
    #: Half of what lies between the 10th and 90th percentiles of the fit over the roof, relative [1].
    change: float


def level_light(
    brightness: Floats, inside: Bools, lit: Bools, middle: tuple[float, float], unsure: Floats
) -> Levelled | None:
    """Return how bright a roof is in its middle; None where too little of it is seen.

    A crowned roof leans in proportion to the distance from its middle, and a small lean changes its light in
    proportion: brightness is a plane. What glint adds lies above it, and is left out round by round.

    Takes ``brightness`` (line, column): of the roof [1]; ``inside``, ``lit``: the roof, and what of it is
    fitted; ``middle``: line and column; ``unsure`` (way, 2): lines and columns by which the middle may be
    elsewhere, along the car and across it.
    """
    y, x = np.nonzero(lit)
    if y.size < LEVELS.min_fitted_px:
        return None
    place = np.stack([np.ones(y.size), y - middle[0], x - middle[1]], axis=1)
    seen = brightness[lit]
    fitted = np.ones(seen.size, bool)
    for _ in range(LEVELS.rounds):
        plane = np.linalg.lstsq(place[fitted], seen[fitted], rcond=None)[0]
        off = seen - place @ plane
        spread = max(1.4826 * float(np.median(np.abs(off[fitted]))), LEVELS.min_sd * abs(float(plane[0])))
        chosen = (off < LEVELS.max_above_sd * spread) & (off > -LEVELS.max_below_sd * spread)
        if chosen.sum() < LEVELS.min_fitted_px or np.array_equal(chosen, fitted):
            break
        fitted = chosen
    near = np.hypot(*(place[:, 1:].T)) < np.quantile(np.hypot(*(place[:, 1:].T)), 0.4)
    # of all that is there, and not of what was fitted: on flakes, what is above the plane may be most of it
    there = float(np.median(off[near])) if near.any() else 0.0
    y, x = np.nonzero(inside)
    low, high = np.quantile(plane[1] * y + plane[2] * x, [0.1, 0.9])
    change = 0.5 * float(high - low) / max(abs(float(plane[0])), 1e-9)
    return Levelled(float(plane[0]), abs(there), float(np.linalg.norm(unsure @ plane[1:])), change)
