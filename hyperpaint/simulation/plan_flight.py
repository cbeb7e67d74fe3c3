"""A flight over a flat picture of a car park: fast, for tests of single functions and for huge cubes.

Across the track are grass, a kerb, a row of bays, the aisle with grey panels, and a second row of bays; bays
repeat every 2.5 m. The swath is always 16 m wide, so that few columns give a coarse picture of the same
scene. A pixel shows one of some twenty level Lambert materials, so that a table of INT rho_m E_k R_b,x (k
direct or diffuse), computed once, has all radiance integrals of a flight.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hyperpaint.base.arrays import Floats

from .flight import Flight, Lines, LineView
from .paint_spectra import CAR_PAINTS, MATERIALS, PANELS, reflectance
from .settings import SWATH_M, SimulationSettings

_BAY_LENGTH, _BAY_WIDTH = 5.0, 2.5
_ROWS = (1.4, 10.9)  # positions across the track at which the two rows of bays begin [m]
_GRASS_END, _KERB_END = 1.0, 1.3
_LINE_HALF_WIDTH = 0.07
_PANEL_SIZE, _PANEL_PERIOD, _PANEL_START = 0.90, 30.0, 1.4
_CLASS = {name: index for index, name in enumerate(MATERIALS)}

#: Windows of a car: bounds along its length and half its width, as fractions of length and half width.
_WINDOWS = ((0.27, 0.40, 0.0, 0.74), (0.74, 0.84, 0.0, 0.70), (0.42, 0.72, 0.76, 0.90))
#: Parts of the wheels outside the body, with the same bounds.
_WHEELS = ((0.13, 0.25, 0.98, 1.03), (0.72, 0.84, 0.98, 1.03))


@dataclass(frozen=True)
class CarPark:
    """Layout of a car park.

    Attributes
    ----------
    columns
        Columns of the imager across the swath.
    seed
        Seed of the occupied bays, and of paints and positions of the cars.

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
        # side of a pixel on the ground [m]
        return SWATH_M / self.columns

    def surface(self, start: int, stop: int) -> NDArray[np.int16]:
        # class of the pixels of lines ``start`` to ``stop``, shape (along_track, cross_track)
        along = (np.arange(start, stop) + 0.5) * self.ground_sample
        y, x = np.meshgrid(along, (np.arange(self.columns) + 0.5) * self.ground_sample, indexing="ij")
        classes = np.full(y.shape, _CLASS["asphalt"], dtype=np.int16)
        classes[x < _KERB_END] = _CLASS["concrete"]
        classes[x < _GRASS_END] = _CLASS["grass"]
        # painted lines, at least a pixel wide, so that coarse pictures have them
        half_width = max(_LINE_HALF_WIDTH, self.ground_sample / 2)
        is_along = np.abs((y + _BAY_WIDTH / 2) % _BAY_WIDTH - _BAY_WIDTH / 2) <= half_width
        for edge in _ROWS:
            classes[is_along & (x >= edge) & (x <= edge + _BAY_LENGTH)] = _CLASS["painted_line"]
        # panels in the aisle
        is_along = (y - _PANEL_START) % _PANEL_PERIOD <= _PANEL_SIZE
        pitch = (_ROWS[1] - _ROWS[0] - _BAY_LENGTH) / len(PANELS)
        for index, level in enumerate(PANELS):
            edge = _ROWS[0] + _BAY_LENGTH + (index + 0.5) * pitch - _PANEL_SIZE / 2
            is_panel = is_along & (x >= edge) & (x <= edge + _PANEL_SIZE)
            classes[is_panel] = _CLASS[f"panel_{round(100 * level):02d}"]
        # cars
        first_bay, last_bay = int(along[0] // _BAY_WIDTH) - 1, int(along[-1] // _BAY_WIDTH) + 1
        for bay in range(first_bay, last_bay + 1):
            for row in range(len(_ROWS)):
                self._park(classes, y, x, bay, row)
        return classes

    def _park(
        self, classes: NDArray[np.int16], y: NDArray[np.float64], x: NDArray[np.float64], bay: int, row: int
    ) -> None:
        rng = np.random.default_rng([self.seed, 1, bay + 2, row])
        if rng.random() > 0.85:
            return
        paint = self._bay_paint(2 * bay + row)
        length, width = rng.uniform(4.0, 4.7), rng.uniform(1.7, 1.9)
        centre = (bay + 0.5) * _BAY_WIDTH + rng.normal(0.0, 0.08)
        nose = _ROWS[row] + rng.uniform(0.1, _BAY_LENGTH - length)
        turn, forward = rng.normal(0.0, 0.02), rng.random() < 0.7
        is_near = np.abs(y[:, 0] - centre) < _BAY_WIDTH
        if not is_near.any():
            return
        y, x, view = y[is_near], x[is_near], classes[is_near]
        # u is 0 at the nose and 1 at the tail, v is 0 on the centre line and 1 at the flank
        u = (x - nose + turn * (y - centre)) / length
        u = u if forward else 1.0 - u
        v = np.abs(y - centre - turn * (x - nose - length / 2)) / (width / 2)
        body = np.abs(2 * u - 1) ** 6 + v**5 <= 1.0
        view[_in_boxes(_WHEELS, u, v)] = _CLASS["tyre"]
        view[body] = _CLASS[paint]
        view[body & _in_boxes(_WINDOWS, u, v)] = _CLASS["glass"]
        classes[is_near] = view

    def _bay_paint(self, bay_number: int) -> str:
        # twelve neighbouring bays have twelve different paints
        paints = list(CAR_PAINTS)
        group, index = divmod(bay_number + 2 * len(paints), len(paints))
        return paints[int(np.random.default_rng([self.seed, 2, group]).permutation(len(paints))[index])]


def _in_boxes(
    boxes: tuple[tuple[float, float, float, float], ...], u: NDArray[np.float64], v: NDArray[np.float64]
) -> NDArray[np.bool_]:
    is_inside = np.zeros(u.shape, dtype=bool)
    for start, stop, inner, outer in boxes:
        is_inside |= (u >= start) & (u <= stop) & (v >= inner) & (v <= outer)
    return is_inside


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
        #: INT rho_m E_k R, shape (light, band, material x cross_track), as a lookup table
        self._reflected = np.stack(
            [integral.transpose(1, 0, 2).reshape(settings.bands, -1) for integral in np.split(integrals, 2)]
        )

    def _view(self, start: int, stop: int, into: Lines | None) -> LineView:
        number = stop - start
        surface = self.park.surface(start, stop)
        mirrored = np.stack([self._mirrored(start + row, surface[row]) for row in range(number)])
        block = Lines(surface, mirrored > 0, *self._cubes(number, into))
        factors = self._factors(start, stop)

        def element_radiance(row: int) -> Floats:
            return self._element_radiance(start + row, surface[row], factors[:, row], mirrored[row])

        return LineView(block, element_radiance)

    def _element_radiance(
        self, line: int, surface: NDArray[np.int16], factors: Floats, mirrored: Floats
    ) -> Floats:
        # pi INT L R of every element, shape (band, cross_track)
        direct, diffuse = factors
        columns = self.settings.columns
        index = surface.astype(np.intp) * columns + np.arange(columns)
        radiance = self._reflected[0].take(index, axis=1, mode="clip")
        radiance *= direct
        term = self._reflected[1].take(index, axis=1, mode="clip")
        term *= diffuse
        radiance += term
        if self.settings.texture:
            normal = np.clip(self._rng(_TEXTURE, line).standard_normal(surface.shape), -3.0, 3.0)
            radiance *= np.where(_TEXTURED[surface], 1.0 + self.settings.texture * normal, 1.0)
        if mirrored.any():
            radiance += mirrored * direct * self._incident[0]
        return np.asarray(radiance)

    def _mirrored(self, line: int, surface: NDArray[np.int16]) -> Floats:
        # reflectance factor of the sun mirrored in clear coats, zero for most pixels
        rng = self._rng(_GLINT, line)
        chance, strength = rng.random(surface.shape), rng.uniform(2.0, 12.0, surface.shape)
        return np.where((chance < self.settings.glint) & _CAR[surface], strength, 0.0)
