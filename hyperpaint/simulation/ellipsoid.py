"""The earth's figure: WGS-84 by closed formulas, and the map of one UTM zone.

What a flight is simulated on must not be what it is located with: nothing here is from a library of geodesy,
nor shared with the part of the package that places pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from hyperpaint.base.arrays import Floats

__all__ = ["LocalFrame", "TransverseMercator", "geocentric", "geodetic", "north_east_down"]


_A, _F = 6_378_137.0, 1 / 298.257223563
_B = _A * (1 - _F)
_E2 = _F * (2 - _F)
_N = _F / (2 - _F)


def geocentric(latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike) -> Floats:
    """Return earth-centred coordinates (..., 3) [m] of latitude and longitude [degree] and height [m]."""
    lat, lon = np.radians(latitude), np.radians(longitude)
    h = np.asarray(height, np.float64)
    normal = _A / np.sqrt(1 - _E2 * np.sin(lat) ** 2)
    across = (normal + h) * np.cos(lat)
    return np.stack([across * np.cos(lon), across * np.sin(lon), ((1 - _E2) * normal + h) * np.sin(lat)], -1)


def geodetic(place: Floats) -> tuple[Floats, Floats, Floats]:
    """Return latitude, longitude [degree] and height [m] of earth-centred coordinates (..., 3).

    Notes
    -----
    Bowring (1976), "Transformation from spatial to geographical coordinates": one step is good to less than
    a micrometre up to some tens of kilometres of height.

    Examples
    --------
    >>> [float(value.round(6)) for value in geodetic(geocentric(43.0, -77.5, 160.0))]
    [43.0, -77.5, 160.0]
    """
    x, y, z = np.moveaxis(place, -1, 0)
    across = np.hypot(x, y)
    reduced = np.arctan2(z * _A, across * _B)
    second = _E2 / (1 - _E2)
    lat = np.arctan2(z + second * _B * np.sin(reduced) ** 3, across - _E2 * _A * np.cos(reduced) ** 3)
    sine = np.sin(lat)
    height = across * np.cos(lat) + z * sine - _A * np.sqrt(1 - _E2 * sine**2)
    return np.degrees(lat), np.degrees(np.arctan2(y, x)), height


def north_east_down(latitude: ArrayLike, longitude: ArrayLike) -> Floats:
    """Return what turns north, east, down at a place [degree] into the earth-centred frame (..., 3, 3)."""
    lat, lon = np.broadcast_arrays(np.radians(latitude), np.radians(longitude))
    (cl, co), (sl, so) = ([f(angle) for angle in (lat, lon)] for f in (np.cos, np.sin))
    none = np.zeros_like(cl)
    rows = [[-sl * co, -so, -cl * co], [-sl * so, co, -cl * so], [cl, none, -sl]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


@dataclass(frozen=True)
class LocalFrame:
    """A frame that touches the earth at a place: x east, y north, z up [m].

    Attributes
    ----------
    latitude, longitude
        Of its origin [degree].
    height
        Of its origin above the ellipsoid [m].

    Examples
    --------
    A kilometre away the earth has fallen off by eight centimetres:

    >>> frame = LocalFrame(43.0, -77.5, 160.0)
    >>> latitude, longitude, height = frame.geodetic(np.array([0.0, 1000.0, 0.0]))
    >>> round(float(height - 160.0), 3)
    0.079
    """

    latitude: float
    longitude: float
    height: float

    @cached_property
    def _origin(self) -> Floats:
        return geocentric(self.latitude, self.longitude, self.height)

    @cached_property
    def axes(self) -> Floats:
        """What turns this frame into the earth-centred one, (3, 3)."""
        north, east, down = north_east_down(self.latitude, self.longitude).T
        return np.stack([east, north, -down], axis=-1)

    def local(self, latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike) -> Floats:
        """Return x, y, z (..., 3) of places."""
        return np.asarray((geocentric(latitude, longitude, height) - self._origin) @ self.axes)

    def geodetic(self, place: Floats) -> tuple[Floats, Floats, Floats]:
        """Return latitude, longitude [degree] and height [m] of x, y, z (..., 3)."""
        return geodetic(self._origin + place @ self.axes.T)

    def from_north_east_down(self, latitude: ArrayLike, longitude: ArrayLike) -> Floats:
        """Return what turns north, east, down at places into this frame (..., 3, 3)."""
        return np.asarray(self.axes.T @ north_east_down(latitude, longitude))


@dataclass(frozen=True)
class TransverseMercator:
    """The map of a UTM zone of the northern half of the earth.

    Attributes
    ----------
    zone
        1 to 60.

    Notes
    -----
    The series of Krüger (1912) in the third flattening, to its sixth power as Karney (2011, "Transverse
    Mercator with an accuracy of a few nanometers", eq. 35) gives it.

    Examples
    --------
    >>> plane = TransverseMercator.of(43.0845, -77.6749)
    >>> plane.crs, plane.project(43.0, -75.0)[0].round(6)
    ('EPSG:32618', np.float64(500000.0))
    """

    zone: int

    @classmethod
    def of(cls, latitude: float, longitude: float) -> TransverseMercator:
        """Return the map of a place [degree], north of the equator."""
        if not 0.0 <= latitude < 84.0:
            raise ValueError(latitude)
        return cls(int((longitude + 180.0) // 6.0) % 60 + 1)

    @property
    def crs(self) -> str:
        """Its name in the register of the EPSG."""
        return f"EPSG:{32600 + self.zone}"

    def project(self, latitude: ArrayLike, longitude: ArrayLike) -> tuple[Floats, Floats]:
        """Return east and north [m] of latitude and longitude [degree]."""
        lat = np.radians(np.asarray(latitude, np.float64))
        lon = np.radians(np.asarray(longitude, np.float64) - (6.0 * self.zone - 183.0))
        tau = np.tan(lat)
        sigma = np.sinh(np.sqrt(_E2) * np.arctanh(np.sqrt(_E2) * np.sin(lat)))
        conformal = tau * np.sqrt(1 + sigma**2) - sigma * np.sqrt(1 + tau**2)
        xi = np.arctan2(conformal, np.cos(lon))
        eta = np.arcsinh(np.sin(lon) / np.hypot(conformal, np.cos(lon)))
        north, east = xi.copy(), eta.copy()
        for order, weight in enumerate(_ALPHA, 1):
            north += weight * np.sin(2 * order * xi) * np.cosh(2 * order * eta)
            east += weight * np.cos(2 * order * xi) * np.sinh(2 * order * eta)
        return 500_000.0 + _SCALE * east, _SCALE * north


_ALPHA = tuple(
    sum(part * _N**power for power, part in enumerate(parts, order))
    for order, parts in enumerate(
        (
            (1 / 2, -2 / 3, 5 / 16, 41 / 180, -127 / 288, 7891 / 37800),
            (13 / 48, -3 / 5, 557 / 1440, 281 / 630, -1983433 / 1935360),
            (61 / 240, -103 / 140, 15061 / 26880, 167603 / 181440),
            (49561 / 161280, -179 / 168, 6601661 / 7257600),
            (34729 / 80640, -3418889 / 1995840),
            (212378941 / 319334400,),
        ),
        1,
    )
)
_SCALE = 0.9996 * _A / (1 + _N) * (1 + _N**2 / 4 + _N**4 / 64 + _N**6 / 256)
