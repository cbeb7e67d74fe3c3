"""Residuals of control points as a function of the camera's mounting and clock."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hyperpaint.base.arrays import Bools, Floats

from .sightings import Sightings

PARAMETERS = ("roll", "pitch", "heading", "height", "clock")
#: Over which misses are differenced.
STEPS = {"roll": 1e-3, "pitch": 1e-3, "heading": 1e-3, "height": 1e-3, "clock": 5e-4}


@dataclass(frozen=True)
class Misses:
    """Residuals of all points as a function of the free parameters."""

    sights: list[Sightings]
    start: Floats  #: all five parameters where the solution begins
    free: list[int]  #: positions in `PARAMETERS` of those that are solved for
    count: int
    white: list[Floats]  #: turns the misses of each sighting into pixels of picking

    def parameters(self, free: Floats) -> Floats:
        """Return all five parameters."""
        parameters = self.start.copy()
        parameters[self.free] = free
        return parameters

    def misses(self, free: Floats) -> Floats:
        """Return misses of all points (point, 2) [pixel of picking]."""
        at, misses = self.parameters(free), np.zeros((self.count, 2))
        for sight, white in zip(self.sights, self.white, strict=True):
            misses[sight.index] = np.einsum("nij,nj->ni", white, sight.misses(at))
        return misses

    def distances(self, free: Floats) -> Floats:
        """Return how far points miss (point,) [pixel of picking]."""
        return np.asarray(np.linalg.norm(self.misses(free), axis=1))

    def whitened(self, free: Floats) -> Misses:
        """Return the same with the motion of points in the picture as it is with these parameters."""
        at = self.parameters(free)
        return replace(self, white=[sight.whitening(at) for sight in self.sights])

    def slopes(self, free: Floats, used: Bools) -> Floats:
        """Return derivatives of the misses of points that are used (2 point, parameter)."""
        columns = []
        for k, parameter in enumerate(self.free):
            step = np.zeros(free.size)
            step[k] = STEPS[PARAMETERS[parameter]]
            change = self.misses(free + step) - self.misses(free - step)
            columns.append(change[used].ravel() / (2.0 * step[k]))
        return np.stack(columns, axis=1)

    def lengths(self, free: Floats, used: Bools) -> Floats:
        """Return how far a unit of each parameter moves points whose places are given (parameter,)."""
        plain = Misses(self.sights, self.start, self.free, self.count, self.white)
        return np.asarray(np.linalg.norm(plain.slopes(free, used), axis=0))


@dataclass(frozen=True)
class TieMisses(Misses):
    """Misses of tie points: the first half of them as one line sees them, the other as another does."""

    height: Floats  #: (point,): of the ground above the ellipsoid [m]

    def misses(self, free: Floats) -> Floats:
        """Return misses of all points (point, 2) from the mean of where the two lines see them."""
        at, misses = self.parameters(free), np.zeros((self.count, 2))
        places = np.zeros((self.count, 3))
        for sight in self.sights:
            places[sight.index] = sight.hits(at, self.height)
        middle = np.tile(places.reshape(2, -1, 3).mean(axis=0), (2, 1))
        for sight, white in zip(self.sights, self.white, strict=True):
            away = replace(sight, ground=middle[sight.index]).misses(at)
            misses[sight.index] = np.einsum("nij,nj->ni", white, away)
        return misses

    def distances(self, free: Floats) -> Floats:
        """Return how far points miss (point,) [pixel]; both lines' alike."""
        return np.tile(super().distances(free).reshape(2, -1).max(axis=0), 2)
