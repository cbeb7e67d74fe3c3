"""A flight over a flat picture of a car park: made in no time, for tests of single functions and huge cubes.

A pixel sees one of some twenty level Lambert materials, so that every radiance integral of a flight is in one
table, INT rho_m E_k R_b,x (k direct or diffuse), made once.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hyperpaint.base.arrays import Floats

from .flight import Flight, Lines
from .paints import CAR_PAINTS, MATERIALS, reflectance
from .scenes import CarPark
from .settings import SimulationSettings

__all__ = ["PlanFlight"]


_TEXTURE, _GLINT = 10, 11  # keys of the random streams

_CAR = np.array([name in CAR_PAINTS for name in MATERIALS])
_TEXTURED = np.array([not name.startswith("panel") for name in MATERIALS])


class PlanFlight(Flight):
    """A flight over the car park in plan view.

    Parameters
    ----------
    settings
        Size and effects.
    """

    surfaces = tuple(MATERIALS)
    paints = tuple(CAR_PAINTS)

    def __init__(self, settings: SimulationSettings) -> None:
        super().__init__(settings)
        self.park = CarPark(settings.columns, settings.seed)
        rho = reflectance(list(MATERIALS), self.grid)
        integrals = self.imager.integrals(np.concatenate([light * rho for light in self.sky]), self.grid)
        #: INT rho_m E_k R, shape (light, band, material x cross_track), ready to be looked up
        self._reflected = np.stack(
            [part.transpose(1, 0, 2).reshape(settings.bands, -1) for part in np.split(integrals, 2)]
        )

    def lines(self, start: int, stop: int, into: Lines | None = None) -> Lines:
        """Return lines ``start`` to ``stop``; the same whatever lines are asked for together."""
        number = stop - start
        surface = self.park.surface(start, stop)
        mirrored = np.stack([self._mirrored(start + row, surface[row]) for row in range(number)])
        made = Lines(surface, mirrored > 0, *self._cubes(number, into))
        factors = self.light.factors(self.line_times[start:stop] / 1e9)

        def expose(row: int) -> None:
            seen = self._seen(start + row, surface[row], factors[:, row], mirrored[row])
            self._record(made, row, start + row, factors[:, row], seen)

        self._for_lines(number, expose)
        return made

    def _seen(self, line: int, surface: NDArray[np.int16], factors: Floats, mirrored: Floats) -> Floats:
        """Return pi INT L R of every element of a line, shape (band, cross_track)."""
        direct, diffuse = factors
        columns = self.settings.columns
        index = surface.astype(np.intp) * columns + np.arange(columns)
        seen = self._reflected[0].take(index, axis=1, mode="clip")
        seen *= direct
        term = self._reflected[1].take(index, axis=1, mode="clip")
        term *= diffuse
        seen += term
        if self.settings.texture:
            seen *= self._texture(line, surface)
        if mirrored.any():
            seen += mirrored * direct * self._incident[0]
        return np.asarray(seen)

    def _texture(self, line: int, surface: NDArray[np.int16]) -> Floats:
        normal = np.clip(self._rng(_TEXTURE, line).standard_normal(surface.shape), -3.0, 3.0)
        return np.where(_TEXTURED[surface], 1.0 + self.settings.texture * normal, 1.0)

    def _mirrored(self, line: int, surface: NDArray[np.int16]) -> Floats:
        """Return the reflectance factor of the clear coat's mirror image of the sun, zero for most pixels."""
        rng = self._rng(_GLINT, line)
        chance, strength = rng.random(surface.shape), rng.uniform(2.0, 12.0, surface.shape)
        return np.where((chance < self.settings.glint) & _CAR[surface], strength, 0.0)
