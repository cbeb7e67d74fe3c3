"""A flight over a checkerboard with known corners on the map, to test geolocation.

The board lies on level ground, which is a surface of equal height above the ellipsoid and so as round as the
earth. A pixel's radiance is the mean over its area and its exposure, along the camera's own wobbling line of
sight.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hyperpaint.base.arrays import Floats

from .flight import Flight, Layer, Lines, Seen
from .paint_spectra import reflectance
from .settings import PIXEL_ANGLE_RAD, SimulationSettings

_SQUARES = ("panel_05", "panel_50")
_LINES_AT_ONCE = 32  # a slab that stays in the cache
_SPARE = 1.0  # m of board around what is seen, whose corners are listed too

#: Where a pixel is looked at, in parts of its width, length and exposure about their middle: a sequence that
#: fills a cube evenly (Roberts 2018, from the root of x**4 = x + 1), and its mirror image, so that the mean
#: place is the middle.
_ROOT = 1.2207440846057596
_HALF = (np.arange(1, 41)[:, None] * _ROOT ** -np.arange(1.0, 4.0) + 0.5) % 1.0 - 0.5
_WITHIN = np.concatenate([_HALF, -_HALF])
_WEIGHTS = np.concatenate([_WITHIN, _WITHIN[:, 2:] ** 2], axis=1)


@dataclass(frozen=True)
class Checkerboard:
    """Squares that cover a map.

    Attributes
    ----------
    origin
        East and north of a corner [m].
    square
        Side [m].
    turn
        Direction of one of its two axes, clockwise from the map's north [degree].

    Examples
    --------
    >>> board = Checkerboard((500.0, 800.0), 0.5, 90.0)
    >>> board.corners(np.array([1.0, 0.0]))
    array([500.5, 800. ])
    """

    origin: tuple[float, float]
    square: float
    turn: float

    @property
    def _axes(self) -> Floats:
        sine, cosine = np.sin(np.radians(self.turn)), np.cos(np.radians(self.turn))
        return np.array([[sine, cosine], [cosine, -sine]])

    def corners(self, numbers: Floats) -> Floats:
        # East and north (..., 2) [m] of corners by their numbers along both axes.
        return np.asarray(self.origin + self.square * (numbers @ self._axes))

    def numbers(self, east: Floats, north: Floats) -> Floats:
        # Places in squares along both axes, shape (2, ...).
        first, second = self._axes / self.square
        x, y = east - self.origin[0], north - self.origin[1]
        return np.stack([first[0] * x + first[1] * y, second[0] * x + second[1] * y])

    def share(self, place: Floats, steps: Floats, weights: Floats) -> Floats:
        """Return the share of places around others that is on bright squares.

        Parameters
        ----------
        place
            East and north, shape (2, ...) [m].
        steps
            Ways from there, shape (step, 2, ...) [m].
        weights
            How much of each way leads to each of the places, shape (places, step).
        """
        middle = self.numbers(*place)
        ways = np.moveaxis(np.tensordot(self._axes / self.square, steps, axes=(1, 1)), 1, 0)
        bright = np.zeros(middle.shape[1:])
        for step_weights in weights:
            here = middle.copy()
            for weight, way in zip(step_weights.tolist(), ways, strict=True):
                here += weight * way
            half = 0.5 * np.floor(here).sum(axis=0)
            bright += half != np.floor(half)  # the square is odd
        return bright / len(weights)


class CheckerboardFlight(Flight):
    """A flight over a checkerboard.

    Examples
    --------
    >>> flight = CheckerboardFlight(SimulationSettings(lines=8, bands=4, columns=32, scene="checkerboard"))
    >>> block = flight.lines(0, 8)
    >>> block.counts.shape, sorted(block.layers)
    ((8, 4, 32), ['bright_share', 'east', 'height', 'north'])
    """

    surfaces = _SQUARES
    paints = _SQUARES

    def __init__(self, settings: SimulationSettings) -> None:
        super().__init__(settings)
        east, north = map(float, self.plane.project(self.frame.latitude, self.frame.longitude))
        self.board = Checkerboard((east, north), settings.square, settings.board_turn)
        place = f"of what the middle of the pixel shows at mid exposure, on {self.plane.crs}"
        metres = {
            "east": f"East {place}",
            "north": f"North {place}",
            "height": "Height above the ellipsoid of that place",
        }
        share = {"long_name": "Share of the pixel on bright squares", "units": "1"}
        self.layers = {
            "bright_share": Layer("float32", share),
            **{name: Layer("float64", {"long_name": text, "units": "m"}) for name, text in metres.items()},
        }
        rho = reflectance(list(_SQUARES), self.grid)
        integrals = self.imager.integrals(np.concatenate([light * rho for light in self.sky]), self.grid)
        #: INT rho_m E_k R, shape (light, square, band, cross_track)
        self._reflected = integrals.reshape(2, 2, settings.bands, settings.columns)

    @cached_property
    def corners(self) -> dict[str, Floats]:
        # East and north of the corners on the ground in view, and a little around [m].
        origin, rotation = self._cameras
        sides = self._tangents[[0, -1]]
        seen = np.stack(self._map(self._places(origin[:, 1], rotation[:, 1], sides))[:2]).reshape(2, -1)
        low, high = seen.min(axis=1) - _SPARE, seen.max(axis=1) + _SPARE
        box = np.array([[low[0], low[0], high[0], high[0]], [low[1], high[1], low[1], high[1]]])
        ranges = (np.arange(np.floor(n.min()), np.ceil(n.max()) + 1) for n in self.board.numbers(*box))
        u, v = np.meshgrid(*ranges, indexing="ij")
        corners = self.board.corners(np.stack([u.ravel(), v.ravel()], axis=-1))
        east, north = corners[((corners >= low) & (corners <= high)).all(axis=1)].T
        return {"east": east, "north": north}

    def _view(self, start: int, stop: int, into: Lines | None) -> Seen:
        number, columns = stop - start, self.settings.columns
        begins = range(start, stop, _LINES_AT_ONCE)
        parts = [self._look(begin, min(begin + _LINES_AT_ONCE, stop)) for begin in begins]
        layers: dict[str, NDArray[Any]] = {
            name: np.concatenate([part[name] for part in parts]).astype(layer.dtype)
            for name, layer in self.layers.items()
        }
        shares = layers["bright_share"]
        glint = np.zeros((number, columns), bool)
        block = Lines((shares > 0.5).astype(np.int16), glint, *self._cubes(number, into), layers)
        factors = self._factors(start, stop)

        def seen(row: int) -> Floats:
            reflected = np.zeros((self.settings.bands, columns))
            for factor, (dark, bright) in zip(factors[:, row], self._reflected, strict=True):
                reflected += factor * (dark + shares[row] * (bright - dark))
            return reflected

        return Seen(block, seen)

    def clean_paint(self, lines: Lines) -> NDArray[np.int32]:
        # Paint of pixels within a square, -1 of all others.
        shares = lines.layers["bright_share"]
        return np.where((shares == 0.0) | (shares == 1.0), super().clean_paint(lines), np.int32(-1))

    @property
    def _tangents(self) -> Floats:
        # Positive to the right.
        return np.tan(np.radians(self.look_angle))

    @cached_property
    def _cameras(self) -> tuple[Floats, Floats]:
        # Place and rotation at begin, middle and end of every exposure.
        half = self.settings.exposure_time / 2
        return self.trajectory.camera(self.line_times[:, None] / 1e9 + half * np.array([-1.0, 0.0, 1.0]))

    @cached_property
    def _to_map(self) -> Floats:
        # Small steps east and north in the scene, times this, are steps on the map.
        places = np.stack(self._map(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))[:2])
        return np.asarray(places[:, 1:] - places[:, :1])

    def _look(self, start: int, stop: int) -> dict[str, Floats]:
        origin, rotation = (part[start:stop] for part in self._cameras)
        across, aside = self._tangents, 0.5 * PIXEL_ANGLE_RAD
        begin, now, end = (self._places(origin[:, k], rotation[:, k], across) for k in range(3))
        east, north, height = self._map(now)
        camera = origin[:, 1], rotation[:, 1]
        # as far as a pixel reaches, places are straight in its width and length, and curved in time
        width = self._places(*camera, across + aside) - self._places(*camera, across - aside)
        length = self._places(*camera, across, aside) - self._places(*camera, across, -aside)
        steps = np.stack([width, length, end - begin, 2.0 * (begin + end - 2.0 * now)])[..., :2]
        steps = np.moveaxis(steps @ self._to_map.T, -1, 1)
        share = self.board.share(np.stack([east, north]), steps, _WEIGHTS)
        return {"bright_share": share, "east": east, "north": north, "height": height}

    def _places(self, origin: Floats, rotation: Floats, across: Floats, along: float = 0.0) -> Floats:
        # Ground points in the axes of the scene (line, column, 3) [m].
        rays = np.stack([np.full_like(across, along), across, np.ones_like(across)])
        rays = (rotation @ rays).swapaxes(1, 2)
        reach = -origin[:, None, 2] / rays[..., 2]
        # the ground falls off under the tangent plane by 8 cm in a kilometre; after two steps nothing is left
        for _ in range(2):
            level = origin[:, None] + reach[..., None] * rays
            level[..., 2] = 0.0
            _, _, height = self.frame.geodetic(level)
            reach = (self.frame.height - height - origin[:, None, 2]) / rays[..., 2]
        return np.asarray(origin[:, None] + reach[..., None] * rays)

    def _map(self, places: Floats) -> tuple[Floats, Floats, Floats]:
        # East, north and height above the ellipsoid of places in the axes of the scene (..., 3).
        latitude, longitude, height = self.frame.geodetic(places)
        return *self.plane.project(latitude, longitude), height
