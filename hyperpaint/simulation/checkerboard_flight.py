"""A flight over a checkerboard with known corners on the map, to test geolocation.

The board lies on ground of constant height above the ellipsoid, so that it is as curved as the earth. The
radiance of a pixel is the mean over its area and its exposure, along the moving line of sight of the camera.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hyperpaint.base.arrays import Floats

from .flight import Flight, Layer, Lines, LineView
from .paint_spectra import reflectance
from .settings import PIXEL_ANGLE_RAD, SimulationSettings

_SQUARES = ("panel_05", "panel_50")
_LINES_AT_ONCE = 32  # lines of a slab that fits into the cache of a processor
_MARGIN_M = 1.0  # margin around the imaged area for the list of corners

#: Sample points of a pixel, as fractions of its width, length and exposure around their centre: a sequence
#: that fills a cube evenly (Roberts 2018, from the root of x**4 = x + 1), and its mirror image, so that the
#: mean point is the centre.
_ROOT = 1.2207440846057596
_HALF_OF_POINTS = (np.arange(1, 41)[:, None] * _ROOT ** -np.arange(1.0, 4.0) + 0.5) % 1.0 - 0.5
_POINTS = np.concatenate([_HALF_OF_POINTS, -_HALF_OF_POINTS])
_WEIGHTS = np.concatenate([_POINTS, _POINTS[:, 2:] ** 2], axis=1)


@dataclass(frozen=True)
class Checkerboard:
    """Squares that cover a map.

    Attributes
    ----------
    origin
        East and north of a corner [m].
    square
        Side of a square [m].
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
        # east and north (..., 2) [m] of corners, from their numbers along both axes
        return np.asarray(self.origin + self.square * (numbers @ self._axes))

    def numbers(self, east: Floats, north: Floats) -> Floats:
        # positions along both axes, in squares, shape (2, ...)
        first_axis, second_axis = self._axes / self.square
        x, y = east - self.origin[0], north - self.origin[1]
        return np.stack([first_axis[0] * x + first_axis[1] * y, second_axis[0] * x + second_axis[1] * y])

    def share(self, place: Floats, steps: Floats, weights: Floats) -> Floats:
        """Return the share of the sample points of pixels that are on bright squares.

        Parameters
        ----------
        place
            East and north of pixel centres, shape (2, ...) [m].
        steps
            Vectors along width, length and exposure of a pixel, shape (step, 2, ...) [m].
        weights
            Weights of these vectors for every sample point, shape (point, step).
        """
        centre = self.numbers(*place)
        vectors = np.moveaxis(np.tensordot(self._axes / self.square, steps, axes=(1, 1)), 1, 0)
        bright = np.zeros(centre.shape[1:])
        for step_weights in weights:
            point = centre.copy()
            for weight, vector in zip(step_weights.tolist(), vectors, strict=True):
                point += weight * vector
            half_sum = 0.5 * np.floor(point).sum(axis=0)
            bright += half_sum != np.floor(half_sum)  # a square with an odd sum of numbers
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
        # east and north of the corners in the imaged area and a margin around it [m]
        origin, rotation = self._cameras
        sides = self._tangents[[0, -1]]
        imaged = np.stack(
            self._map_coordinates(self._places(origin[:, 1], rotation[:, 1], sides))[:2]
        ).reshape(2, -1)
        minimum, maximum = imaged.min(axis=1) - _MARGIN_M, imaged.max(axis=1) + _MARGIN_M
        box = np.array(
            [
                [minimum[0], minimum[0], maximum[0], maximum[0]],
                [minimum[1], maximum[1], minimum[1], maximum[1]],
            ]
        )
        ranges = (np.arange(np.floor(n.min()), np.ceil(n.max()) + 1) for n in self.board.numbers(*box))
        u, v = np.meshgrid(*ranges, indexing="ij")
        corners = self.board.corners(np.stack([u.ravel(), v.ravel()], axis=-1))
        east, north = corners[((corners >= minimum) & (corners <= maximum)).all(axis=1)].T
        return {"east": east, "north": north}

    def _view(self, start: int, stop: int, into: Lines | None) -> LineView:
        number, columns = stop - start, self.settings.columns
        starts = range(start, stop, _LINES_AT_ONCE)
        slabs = [
            self._pixel_truth(start_line, min(start_line + _LINES_AT_ONCE, stop)) for start_line in starts
        ]
        layers: dict[str, NDArray[Any]] = {
            name: np.concatenate([slab[name] for slab in slabs]).astype(layer.dtype)
            for name, layer in self.layers.items()
        }
        shares = layers["bright_share"]
        glint = np.zeros((number, columns), bool)
        block = Lines((shares > 0.5).astype(np.int16), glint, *self._cubes(number, into), layers)
        factors = self._factors(start, stop)

        def element_radiance(row: int) -> Floats:
            reflected = np.zeros((self.settings.bands, columns))
            for factor, (dark, bright) in zip(factors[:, row], self._reflected, strict=True):
                reflected += factor * (dark + shares[row] * (bright - dark))
            return reflected

        return LineView(block, element_radiance)

    def clean_paint(self, lines: Lines) -> NDArray[np.int32]:
        # paint of pixels within a square, -1 for all others
        shares = lines.layers["bright_share"]
        return np.where((shares == 0.0) | (shares == 1.0), super().clean_paint(lines), np.int32(-1))

    @property
    def _tangents(self) -> Floats:
        # tangents of the look angles of columns, positive to the right
        return np.tan(np.radians(self.look_angle))

    @cached_property
    def _cameras(self) -> tuple[Floats, Floats]:
        # position and rotation of the camera at start, middle and end of every exposure
        half_exposure = self.settings.exposure_time / 2
        return self.trajectory.camera(
            self.line_times[:, None] / 1e9 + half_exposure * np.array([-1.0, 0.0, 1.0])
        )

    @cached_property
    def _to_map(self) -> Floats:
        # matrix from steps east and north in the scene to steps on the map
        places = np.stack(
            self._map_coordinates(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))[:2]
        )
        return np.asarray(places[:, 1:] - places[:, :1])

    def _pixel_truth(self, start: int, stop: int) -> dict[str, Floats]:
        origin, rotation = (pose[start:stop] for pose in self._cameras)
        tangents, half_pixel = self._tangents, 0.5 * PIXEL_ANGLE_RAD
        at_start, at_middle, at_end = (self._places(origin[:, k], rotation[:, k], tangents) for k in range(3))
        east, north, height = self._map_coordinates(at_middle)
        camera = origin[:, 1], rotation[:, 1]
        # within a pixel, positions are linear in width and length, and quadratic in time
        width = self._places(*camera, tangents + half_pixel) - self._places(*camera, tangents - half_pixel)
        length = self._places(*camera, tangents, half_pixel) - self._places(*camera, tangents, -half_pixel)
        steps = np.stack([width, length, at_end - at_start, 2.0 * (at_start + at_end - 2.0 * at_middle)])[
            ..., :2
        ]
        steps = np.moveaxis(steps @ self._to_map.T, -1, 1)
        share = self.board.share(np.stack([east, north]), steps, _WEIGHTS)
        return {"bright_share": share, "east": east, "north": north, "height": height}

    def _places(self, origin: Floats, rotation: Floats, across: Floats, along: float = 0.0) -> Floats:
        # points on the ground in the axes of the scene (line, column, 3) [m]
        rays = np.stack([np.full_like(across, along), across, np.ones_like(across)])
        rays = (rotation @ rays).swapaxes(1, 2)
        reach = -origin[:, None, 2] / rays[..., 2]
        # the ground is 8 cm below the tangent plane at a kilometre; two steps of the iteration are exact
        for _ in range(2):
            level = origin[:, None] + reach[..., None] * rays
            level[..., 2] = 0.0
            _, _, height = self.frame.geodetic(level)
            reach = (self.frame.height - height - origin[:, None, 2]) / rays[..., 2]
        return np.asarray(origin[:, None] + reach[..., None] * rays)

    def _map_coordinates(self, places: Floats) -> tuple[Floats, Floats, Floats]:
        # east, north and height above the ellipsoid of points (..., 3) in the axes of the scene
        latitude, longitude, height = self.frame.geodetic(places)
        return *self.plane.project(latitude, longitude), height
