"""Which pieces of paint as dark as glass are of the same car."""

from __future__ import annotations

import numpy as np

from hyperpaint.surroundings import SceneModel

from .cars import Judged, better_part
from .surroundings import Surfaces

__all__ = ["settle_dark"]

_SAME_PAINT = np.cos(np.radians(5.0))
"""Of the spectral angle between two pieces of one paint, at most."""
_FARTHEST = 300.0
"""How far pieces of one car are apart, at most [pixel]."""
_GROUND = 3
"""Pixels of ground in a row that part two cars."""


def settle_dark(judged: list[Judged], model: SceneModel, surfaces: Surfaces) -> None:
    """Object to all but one usable piece of a car: that of the most homogeneous colour, away from windows.

    Two are of one car where their spectra are the same but for brightness, and on the straight way from one
    to the other there is no ground.
    """
    parts = [one for one in judged if one[2].kind and not one[2].objections]
    group = list(range(len(parts)))
    for later in range(len(parts)):
        for earlier in range(later):
            if group[later] != group[earlier] and _linked(parts[earlier], parts[later], model, surfaces):
                old, new = group[later], group[earlier]
                group = [new if one == old else one for one in group]
    for name in dict.fromkeys(group):
        car = [part for part, of in zip(parts, group, strict=True) if of == name]
        best = min(car, key=lambda one: one[1].angle)
        for one in car:
            if one is not best:
                one[2].objections.append(better_part(best))


def _linked(one: Judged, other: Judged, model: SceneModel, surfaces: Surfaces) -> bool:
    """Tell whether two pieces are of one paint, and no ground lies between them."""
    spectra = [np.nan_to_num(model.reference[each[0].body]) for each in (one, other)]
    length = float(np.linalg.norm(spectra[0]) * np.linalg.norm(spectra[1]))
    if float(spectra[0] @ spectra[1]) < _SAME_PAINT * length:
        return False
    start, stop = one[0].middle, other[0].middle
    far = float(np.hypot(*(stop - start)))
    if far > _FARTHEST:
        return False
    steps = np.linspace(0.0, 1.0, max(2, int(np.ceil(far)) + 1))[:, None]
    y, x = np.rint(start + steps * (stop - start)).astype(np.int64).T
    way = model.segment[y, x]
    way = way[way >= 0]
    off = (surfaces.ground | surfaces.shade)[way] & ~surfaces.dark[way]
    return bool(np.convolve(off, np.ones(_GROUND), "valid").max(initial=0.0) < _GROUND)
