"""A flight over a flat picture of a car park: quickly made, for tests of single functions and huge cubes.

Across the track lie grass, a kerb, a row of bays, the aisle with grey panels and a second row of bays; the
bays repeat every 2.5 m. The swath is always 16 m wide, so that a line of few columns is a coarse picture of
the same place. A pixel sees one of some twenty level Lambert materials, so that every radiance integral of a
flight is in one table, INT rho_m E_k R_b,x (k direct or diffuse), made once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hyperpaint.base.arrays import Floats

from .flight import Flight, Lines, Seen
from .paint_spectra import CAR_PAINTS, MATERIALS, PANELS, reflectance
from .settings import SWATH_M, SimulationSettings

_BAY_LENGTH, _BAY_WIDTH = 5.0, 2.5
_ROWS = (1.4, 10.9)  # where the two rows of bays begin across the track [m]
_GRASS_END, _KERB_END = 1.0, 1.3
_LINE_HALF_WIDTH = 0.07
_PANEL_SIZE, _PANEL_PERIOD, _PANEL_START = 0.90, 30.0, 1.4
_CLASS = {name: index for index, name in enumerate(MATERIALS)}

#: Dark glass on a car: bounds along its length and half its width, as fractions of the car's own size.
_WINDOWS = ((0.27, 0.40, 0.0, 0.74), (0.74, 0.84, 0.0, 0.70), (0.42, 0.72, 0.76, 0.90))
#: Wheels that look out from under the body.
_WHEELS = ((0.13, 0.25, 0.98, 1.03), (0.72, 0.84, 0.98, 1.03))


@dataclass(frozen=True)
class CarPark:
    """Layout of a car park.

    Attributes
    ----------
    columns
        Columns of the imager across the swath.
    seed
        Chooses which bays are taken, by cars of which paint, and how they stand.

    Examples
    --------
    >>> park = CarPark(columns=32, seed=0)
    >>> park.surface(0, 2).shape, park.surface(0, 2).dtype
    ((2, 32), dtype('int16'))
    """

    columns: int
    seed: int = 0

    @property
    def ground_sample(self) -> float:
        # Side of a pixel on the ground [m].
        return SWATH_M / self.columns

    def surface(self, start: int, stop: int) -> NDArray[np.int16]:
        # Class of the pixels of lines ``start`` to ``stop``, shape (along_track, cross_track).
        along = (np.arange(start, stop) + 0.5) * self.ground_sample
        y, x = np.meshgrid(along, (np.arange(self.columns) + 0.5) * self.ground_sample, indexing="ij")
        classes = np.full(y.shape, _CLASS["asphalt"], dtype=np.int16)
        classes[x < _KERB_END] = _CLASS["concrete"]
        classes[x < _GRASS_END] = _CLASS["grass"]
        # painted lines, at least a pixel wide, or coarse pictures would have none
        half = max(_LINE_HALF_WIDTH, self.ground_sample / 2)
        beside = np.abs((y + _BAY_WIDTH / 2) % _BAY_WIDTH - _BAY_WIDTH / 2) <= half
        for begin in _ROWS:
            classes[beside & (x >= begin) & (x <= begin + _BAY_LENGTH)] = _CLASS["painted_line"]
        # panels in the aisle
        beside = (y - _PANEL_START) % _PANEL_PERIOD <= _PANEL_SIZE
        pitch = (_ROWS[1] - _ROWS[0] - _BAY_LENGTH) / len(PANELS)
        for index, level in enumerate(PANELS):
            begin = _ROWS[0] + _BAY_LENGTH + (index + 0.5) * pitch - _PANEL_SIZE / 2
            here = beside & (x >= begin) & (x <= begin + _PANEL_SIZE)
            classes[here] = _CLASS[f"panel_{round(100 * level):02d}"]
        # cars
        first, last = int(along[0] // _BAY_WIDTH) - 1, int(along[-1] // _BAY_WIDTH) + 1
        for bay in range(first, last + 1):
            for row in range(len(_ROWS)):
                self._park(classes, y, x, bay, row)
        return classes

    def _park(
        self, classes: NDArray[np.int16], y: NDArray[np.float64], x: NDArray[np.float64], bay: int, row: int
    ) -> None:
        rng = np.random.default_rng([self.seed, 1, bay + 2, row])
        if rng.random() > 0.85:
            return
        paint = self._paint_of(2 * bay + row)
        length, width = rng.uniform(4.0, 4.7), rng.uniform(1.7, 1.9)
        middle = (bay + 0.5) * _BAY_WIDTH + rng.normal(0.0, 0.08)
        nose = _ROWS[row] + rng.uniform(0.1, _BAY_LENGTH - length)
        turn, forward = rng.normal(0.0, 0.02), rng.random() < 0.7
        near = np.abs(y[:, 0] - middle) < _BAY_WIDTH
        if not near.any():
            return
        y, x, view = y[near], x[near], classes[near]
        # u runs from the nose (0) to the tail (1), v from the middle line (0) to the flank (1)
        u = (x - nose + turn * (y - middle)) / length
        u = u if forward else 1.0 - u
        v = np.abs(y - middle - turn * (x - nose - length / 2)) / (width / 2)
        body = np.abs(2 * u - 1) ** 6 + v**5 <= 1.0
        view[_inside(_WHEELS, u, v)] = _CLASS["tyre"]
        view[body] = _CLASS[paint]
        view[body & _inside(_WINDOWS, u, v)] = _CLASS["glass"]
        classes[near] = view

    def _paint_of(self, place: int) -> str:
        # Twelve neighbouring bays have twelve paints.
        paints = list(CAR_PAINTS)
        deck, card = divmod(place + 2 * len(paints), len(paints))
        return paints[int(np.random.default_rng([self.seed, 2, deck]).permutation(len(paints))[card])]


def _inside(
    boxes: tuple[tuple[float, float, float, float], ...], u: NDArray[np.float64], v: NDArray[np.float64]
) -> NDArray[np.bool_]:
    within = np.zeros(u.shape, dtype=bool)
    for first, last, inner, outer in boxes:
        within |= (u >= first) & (u <= last) & (v >= inner) & (v <= outer)
    return within


_TEXTURE, _GLINT = 10, 11  # keys of the random streams

_CAR = np.array([name in CAR_PAINTS for name in MATERIALS])
_TEXTURED = np.array([not name.startswith("panel") for name in MATERIALS])


class PlanFlight(Flight):
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

    def _view(self, start: int, stop: int, into: Lines | None) -> Seen:
        number = stop - start
        surface = self.park.surface(start, stop)
        mirrored = np.stack([self._mirrored(start + row, surface[row]) for row in range(number)])
        block = Lines(surface, mirrored > 0, *self._cubes(number, into))
        factors = self._factors(start, stop)

        def seen(row: int) -> Floats:
            return self._seen(start + row, surface[row], factors[:, row], mirrored[row])

        return Seen(block, seen)

    def _seen(self, line: int, surface: NDArray[np.int16], factors: Floats, mirrored: Floats) -> Floats:
        # pi INT L R of every element, shape (band, cross_track).
        direct, diffuse = factors
        columns = self.settings.columns
        index = surface.astype(np.intp) * columns + np.arange(columns)
        seen = self._reflected[0].take(index, axis=1, mode="clip")
        seen *= direct
        term = self._reflected[1].take(index, axis=1, mode="clip")
        term *= diffuse
        seen += term
        if self.settings.texture:
            normal = np.clip(self._rng(_TEXTURE, line).standard_normal(surface.shape), -3.0, 3.0)
            seen *= np.where(_TEXTURED[surface], 1.0 + self.settings.texture * normal, 1.0)
        if mirrored.any():
            seen += mirrored * direct * self._incident[0]
        return np.asarray(seen)

    def _mirrored(self, line: int, surface: NDArray[np.int16]) -> Floats:
        # Reflectance factor of the clear coat's mirror image of the sun, zero for most pixels.
        rng = self._rng(_GLINT, line)
        chance, strength = rng.random(surface.shape), rng.uniform(2.0, 12.0, surface.shape)
        return np.where((chance < self.settings.glint) & _CAR[surface], strength, 0.0)
