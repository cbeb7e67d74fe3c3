"""The flight of a drone over the earth: a straight course, with deviations by wind and propellers.

The ellipsoid is WGS-84 by closed formulas, the map a UTM zone. Simulation and geolocation must be
independent: this module uses neither a geodesy library nor `hyperpaint.geometry`.

Angles are those of ISO 1151-2: heading clockwise from true north, pitch with the nose up, roll with the right
wing down, applied in this order; heights are above the ellipsoid. A deviation is a sum of sines with random
frequencies, so that it is defined at all times and not only at samples.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from hyperpaint.base.arrays import Floats

from .rendering.platform_geometry import quaternions, turns
from .settings import SimulationSettings

_A, _F = 6_378_137.0, 1 / 298.257223563
_B = _A * (1 - _F)
_E2 = _F * (2 - _F)
_N = _F / (2 - _F)


def geocentric(latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike) -> Floats:
    """Return earth-centred coordinates (..., 3) [m] of latitude and longitude [degree] and height [m]."""
    lat, lon = np.radians(latitude), np.radians(longitude)
    h = np.asarray(height, np.float64)
    normal = _A / np.sqrt(1 - _E2 * np.sin(lat) ** 2)
    axis_distance = (normal + h) * np.cos(lat)
    return np.stack(
        [axis_distance * np.cos(lon), axis_distance * np.sin(lon), ((1 - _E2) * normal + h) * np.sin(lat)], -1
    )


def geodetic(xyz: Floats) -> tuple[Floats, Floats, Floats]:
    """Return latitude, longitude [degree] and height [m] of earth-centred coordinates (..., 3).

    Notes
    -----
    Bowring (1976), "Transformation from spatial to geographical coordinates": one step has an
    error below a micrometre up to some tens of kilometres of height.

    Examples
    --------
    >>> [float(value.round(6)) for value in geodetic(geocentric(43.0, -77.5, 160.0))]
    [43.0, -77.5, 160.0]
    """
    x, y, z = np.moveaxis(xyz, -1, 0)
    axis_distance = np.hypot(x, y)
    reduced = np.arctan2(z * _A, axis_distance * _B)
    second_eccentricity = _E2 / (1 - _E2)
    lat = np.arctan2(
        z + second_eccentricity * _B * np.sin(reduced) ** 3, axis_distance - _E2 * _A * np.cos(reduced) ** 3
    )
    sine = np.sin(lat)
    height = axis_distance * np.cos(lat) + z * sine - _A * np.sqrt(1 - _E2 * sine**2)
    return np.degrees(lat), np.degrees(np.arctan2(y, x)), height


def north_east_down(latitude: ArrayLike, longitude: ArrayLike) -> Floats:
    # rotations from north, east, down at a position [degree] to the earth-centred frame (..., 3, 3)
    lat, lon = np.broadcast_arrays(np.radians(latitude), np.radians(longitude))
    (cl, co), (sl, so) = ([f(angle) for angle in (lat, lon)] for f in (np.cos, np.sin))
    rows = [[-sl * co, -so, -cl * co], [-sl * so, co, -cl * so], [cl, np.zeros_like(cl), -sl]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


@dataclass(frozen=True)
class LocalFrame:
    """A local tangent frame at a position: x east, y north, z up [m].

    Attributes
    ----------
    latitude, longitude
        Position of the origin [degree].
    height
        Height of the origin above the ellipsoid [m].

    Examples
    --------
    At a distance of a kilometre, the tangent plane is eight centimetres above the ellipsoid:

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
        # rotation from this frame to the earth-centred frame, (3, 3)
        north, east, down = north_east_down(self.latitude, self.longitude).T
        return np.stack([east, north, -down], axis=-1)

    def local(self, latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike) -> Floats:
        # x, y, z (..., 3) of positions
        return np.asarray((geocentric(latitude, longitude, height) - self._origin) @ self.axes)

    def geodetic(self, xyz: Floats) -> tuple[Floats, Floats, Floats]:
        # latitude, longitude [degree] and height [m] of x, y, z (..., 3)
        return geodetic(self._origin + xyz @ self.axes.T)


@dataclass(frozen=True)
class TransverseMercator:
    """The map projection of a UTM zone in the northern hemisphere.

    Attributes
    ----------
    zone
        Number of the zone, 1 to 60.

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
        # projection of the zone of a position [degree] in the northern hemisphere
        if not 0.0 <= latitude < 84.0:
            raise ValueError(latitude)
        return cls(int((longitude + 180.0) // 6.0) % 60 + 1)

    @property
    def crs(self) -> str:
        # EPSG code
        return f"EPSG:{32600 + self.zone}"

    def project(self, latitude: ArrayLike, longitude: ArrayLike) -> tuple[Floats, Floats]:
        # east and north [m] of latitude and longitude [degree]
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


#: Conventions of angles, heights and columns of a simulated flight.
CONVENTION = {
    "roll_positive": "right_wing_down",
    "pitch_positive": "nose_up",
    "heading_positive": "clockwise",
    "heading_reference": "true",
    "euler_order": "ZYX",
    "height_reference": "ellipsoid",
    "column_order": "left_to_right",
}

_STREAM = 20  # key of the random stream
_SINES = 12


@dataclass(frozen=True)
class Motion:
    """A sum of sines around a mean.

    Attributes
    ----------
    amplitude, frequency, phase
        Parameters of the sines, shape (sine,); frequency [Hz], phase [rad].
    mean
        Mean of the motion.
    """

    amplitude: Floats
    frequency: Floats
    phase: Floats
    mean: float = 0.0

    @classmethod
    def slow(cls, amplitude: float, period: float, phase: float, mean: float = 0.0) -> Motion:
        # a single sine of this period [s]
        return cls(np.array([amplitude]), np.array([1 / period]), np.array([phase]), mean)

    @classmethod
    def random(cls, sd: float, rate_sd: float, rng: np.random.Generator) -> Motion:
        # random sines with these standard deviations of the motion and of its rate of change [s-1]
        relative_frequency = np.geomspace(0.2, 2.0, _SINES) * rng.uniform(0.94, 1.06, _SINES)
        amplitude = relative_frequency**-0.5
        amplitude *= sd * np.sqrt(2 / (amplitude**2).sum())
        frequency = (
            relative_frequency
            * rate_sd
            / np.sqrt(((amplitude * relative_frequency) ** 2).sum() / 2)
            / (2 * np.pi)
        )
        return cls(amplitude, frequency, rng.uniform(0, 2 * np.pi, _SINES))

    def at(self, seconds: Floats) -> Floats:
        # motion at times [s]
        motion = np.full(np.shape(seconds), self.mean)
        for a, f, p in zip(
            self.amplitude.tolist(), self.frequency.tolist(), self.phase.tolist(), strict=True
        ):
            motion += a * np.sin(2 * np.pi * f * seconds + p)
        return motion

    @property
    def peak(self) -> float:
        # maximum possible magnitude
        return abs(self.mean) + float(np.abs(self.amplitude).sum())


#: Standard deviations of motions of drones, angles [degree] or distances [m], and of their rates [s-1].
_STANDARD_DEVIATIONS: Mapping[str, Mapping[str, tuple[float, float]]] = {
    "calm": {
        "roll": (0.15, 0.69), "pitch": (0.15, 0.87), "heading": (1.1, 3.7),
        "right": (0.02, 0.03), "altitude": (0.02, 0.03),
    },
    "rough": {
        "roll": (0.42, 1.9), "pitch": (0.42, 2.5), "heading": (3.1, 10.6),
        "right": (0.05, 0.08), "altitude": (0.05, 0.08),
    },
}  # fmt: skip


def _motions(settings: SimulationSettings) -> dict[str, Motion]:
    if settings.wobble == "slow":
        return {
            "roll": Motion.slow(0.4, 3.1, 0.3),
            "pitch": Motion.slow(0.3, 4.7, 1.1),
            "heading": Motion.slow(0.2, 7.9, 0.0, mean=0.5),
            "altitude": Motion.slow(0.1, 11.0, 0.0),
        }
    rng = np.random.default_rng([settings.seed, _STREAM])
    return {
        name: Motion.random(*pair, rng)
        for name, pair in _STANDARD_DEVIATIONS.get(settings.wobble, {}).items()
    }


@dataclass(frozen=True)
class Trajectory:
    """Pose of the navigation system, and of the camera fixed to it, at any time.

    Attributes
    ----------
    frame
        Frame of the scene: x east, y north, z up, from the point on the ground below the camera at time zero
        [m].
    course
        Direction of flight, clockwise from north [degree].
    speed
        Ground speed [m s-1].
    altitude
        Height of the navigation's reference point above the ground [m].
    boresight
        Roll, pitch and heading of the camera in the body [degree].
    lever_arm
        Position of the camera from the navigation's reference point: forward, right, down [m].
    motions
        Motions of ``roll``, ``pitch``, ``heading`` [degree], ``altitude``, and to the ``right`` of the course
        [m].
    """

    frame: LocalFrame
    course: float
    speed: float
    altitude: float
    boresight: tuple[float, float, float] = (0.0, 0.0, 0.0)
    lever_arm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    motions: Mapping[str, Motion] = field(default_factory=dict)

    @classmethod
    def of(cls, settings: SimulationSettings, frame: LocalFrame, speed: float, altitude: float) -> Trajectory:
        roll, pitch, heading = settings.boresight
        forward, right, down = settings.lever_arm
        return cls(
            frame,
            float(settings.course),
            speed,
            altitude,
            (float(roll), float(pitch), float(heading)),
            (float(forward), float(right), float(down)),
            _motions(settings),
        )

    def pose(self, seconds: Floats) -> dict[str, Floats]:
        # position and attitude of the navigation system [degree, m]; heading from 0 to 360
        seconds = np.asarray(seconds, np.float64)
        sine, cosine = np.sin(np.radians(self.course)), np.cos(np.radians(self.course))
        ahead, right = self.speed * seconds, self._motion("right", seconds)
        level = np.stack(
            [ahead * sine + right * cosine, ahead * cosine - right * sine, np.zeros_like(ahead)], axis=-1
        )
        latitude, longitude, _ = self.frame.geodetic(level)
        return {
            "roll": self._motion("roll", seconds),
            "pitch": self._motion("pitch", seconds),
            "heading": (self.course + self._motion("heading", seconds)) % 360.0,
            "latitude": latitude,
            "longitude": longitude,
            "altitude": self.frame.height + self.altitude + self._motion("altitude", seconds),
        }

    def camera(self, seconds: Floats) -> tuple[Floats, Floats]:
        """Return the position of the camera (..., 3) [m], and its rotation to the scene's axes (..., 3, 3).

        Notes
        -----
        With M the rotation from north, east, down at the platform to the scene, R the attitude of the body, B
        that of the camera in the body, and l the lever arm: p = p_nav + M R l, and the rotation is M R B.
        """
        pose = self.pose(seconds)
        position = self.frame.local(pose["latitude"], pose["longitude"], pose["altitude"])
        down = np.asarray(self.frame.axes.T @ north_east_down(pose["latitude"], pose["longitude"]))
        body = down @ turns(quaternions(pose["roll"], pose["pitch"], pose["heading"]))
        return position + body @ np.array(self.lever_arm), body @ turns(quaternions(*self.boresight))

    @property
    def steepest(self) -> float:
        # maximum angle between camera axis and vertical, along or across the track [degree]
        return max(self._peak("roll"), self._peak("pitch")) + max(map(abs, self.boresight[:2]))

    @property
    def max_yaw(self) -> float:
        # maximum angle between camera and course [degree]
        return self._peak("heading") + abs(self.boresight[2])

    def _motion(self, name: str, seconds: Floats) -> Floats:
        return self.motions[name].at(seconds) if name in self.motions else np.zeros_like(seconds)

    def _peak(self, name: str) -> float:
        return self.motions[name].peak if name in self.motions else 0.0
