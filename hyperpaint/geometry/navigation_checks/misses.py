"""Residuals of control points as a function of the camera's mounting and clock."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hyperpaint.base.arrays import Bools, Floats

from .sightings import Sightings

PARAMETERS = ("roll", "pitch", "heading", "height", "clock")
#: Parameter steps of the numerical derivatives of misses.
STEPS = {"roll": 1e-3, "pitch": 1e-3, "heading": 1e-3, "height": 1e-3, "clock": 5e-4}


@dataclass(frozen=True)
class Misses:
    """Residuals of all points as a function of the free parameters."""

    sights: list[Sightings]
    start: Floats  #: start values of all five parameters
    free: list[int]  #: positions in `PARAMETERS` of the solved parameters
    count: int
    white: list[Floats]  #: matrices that convert the misses of each sighting to pixels of picking

    def parameters(self, free: Floats) -> Floats:
        """Return all five parameters."""
        parameters = self.start.copy()
        parameters[self.free] = free
        return parameters

    def misses(self, free: Floats) -> Floats:
        """Return misses of all points (point, 2) [pixel of picking]."""
        parameters, misses = self.parameters(free), np.zeros((self.count, 2))
        for sight, white in zip(self.sights, self.white, strict=True):
            misses[sight.index] = np.einsum("nij,nj->ni", white, sight.misses(parameters))
        return misses

    def distances(self, free: Floats) -> Floats:
        """Return the length of the misses (point,) [pixel of picking]."""
        return np.asarray(np.linalg.norm(self.misses(free), axis=1))

    def whitened(self, free: Floats) -> Misses:
        """Return the misses with whitening computed at these parameters."""
        parameters = self.parameters(free)
        return replace(self, white=[sight.whitening(parameters) for sight in self.sights])

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
        """Return the length of the misses per unit of a parameter, for fixed ground points (parameter,)."""
        fixed_points = Misses(self.sights, self.start, self.free, self.count, self.white)
        return np.asarray(np.linalg.norm(fixed_points.slopes(free, used), axis=0))


@dataclass(frozen=True)
class TieMisses(Misses):
    """Misses of tie points: the first half seen by one line of a pair, the second half by the other."""

    height: Floats  #: (point,): height of the ground above the ellipsoid [m]

    def misses(self, free: Floats) -> Floats:
        """Return misses (point, 2) from the mean ground position of the two lines."""
        parameters, misses = self.parameters(free), np.zeros((self.count, 2))
        positions = np.zeros((self.count, 3))
        for sight in self.sights:
            positions[sight.index] = sight.hits(parameters, self.height)
        mean_positions = np.tile(positions.reshape(2, -1, 3).mean(axis=0), (2, 1))
        for sight, white in zip(self.sights, self.white, strict=True):
            misses_of_sight = replace(sight, ground=mean_positions[sight.index]).misses(parameters)
            misses[sight.index] = np.einsum("nij,nj->ni", white, misses_of_sight)
        return misses

    def distances(self, free: Floats) -> Floats:
        """Return the length of the misses (point,) [pixel], the larger one for both points of a pair."""
        return np.tile(super().distances(free).reshape(2, -1).max(axis=0), 2)
