"""How bright a car's roof is where it is level, whatever glint, shadow and lean do beside that."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hyperpaint.base.arrays import Bools, Floats

__all__ = ["Levelled", "level_light"]


_ROUNDS = 30
_ABOVE, _BELOW, _LEAST = 1.5, 3.0, 0.003
"""Residuals that stay in the fit [standard deviations], and the least of these [1]: glint only adds."""
_ENOUGH = 25


class Levelled(NamedTuple):
    """Brightness of a roof.

    Attributes
    ----------
    middle
        In its middle, relative to what brightness is given in [1].
    misfit
        How far what is seen there is off the fit [1].
    unsure
        What it may be off by because the middle is elsewhere [1].
    change
        Half of what lies between the 10th and 90th percentiles of the fit over the roof, relative [1].
    """

    middle: float
    misfit: float
    unsure: float
    change: float


def level_light(
    brightness: Floats, inside: Bools, lit: Bools, middle: tuple[float, float], unsure: float, axis: Floats
) -> Levelled | None:
    """Return how bright a roof is in its middle; None where too little of it is seen.

    A crowned roof leans in proportion to the distance from its middle, and a small lean changes its light in
    proportion: brightness is a plane. What glint adds lies above it, and is left out round by round.

    Parameters
    ----------
    brightness : (line, column)
        Of the roof [1].
    inside, lit
        The roof, and what of it is fitted.
    middle
        Line and column.
    unsure
        How far along the axis the middle may be elsewhere [pixel].
    axis : (2,)
        Direction (line, column) along the car.
    """
    y, x = np.nonzero(lit)
    if y.size < _ENOUGH:
        return None
    place = np.stack([np.ones(y.size), y - middle[0], x - middle[1]], axis=1)
    seen = brightness[lit]
    kept = np.ones(seen.size, bool)
    for _ in range(_ROUNDS):
        plane = np.linalg.lstsq(place[kept], seen[kept], rcond=None)[0]
        off = seen - place @ plane
        spread = max(1.4826 * float(np.median(np.abs(off[kept]))), _LEAST * abs(float(plane[0])))
        chosen = (off < _ABOVE * spread) & (off > -_BELOW * spread)
        if chosen.sum() < _ENOUGH or np.array_equal(chosen, kept):
            break
        kept = chosen
    near = np.hypot(*(place[:, 1:].T)) < np.quantile(np.hypot(*(place[:, 1:].T)), 0.4)
    there = float(np.median(off[near & kept])) if (near & kept).any() else 0.0
    y, x = np.nonzero(inside)
    low, high = np.quantile(plane[1] * y + plane[2] * x, [0.1, 0.9])
    change = 0.5 * float(high - low) / max(abs(float(plane[0])), 1e-9)
    return Levelled(float(plane[0]), abs(there), unsure * abs(float(plane[1:] @ axis)), change)
