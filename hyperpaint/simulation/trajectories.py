"""How a drone flies: a straight course, and what wind and propellers make of it.

Angles are those of ISO 1151-2: heading clockwise from true north, pitch with the nose up, roll with the right
wing down, turned in this order; heights are above the ellipsoid. A wobble is a sum of sines whose frequencies
are chosen by the seed, so that it is known at every moment and not at samples only.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from hyperpaint.base.arrays import Floats

from .ellipsoid import LocalFrame
from .rendering.platform_geometry import quaternions, turns

if TYPE_CHECKING:
    from .settings import SimulationSettings

__all__ = ["CONVENTION", "WOBBLES", "Motion", "Trajectory"]


WOBBLES = ("none", "slow", "calm", "rough")
"""How a platform may move about its course."""

CONVENTION = {
    "roll_positive": "right_wing_down",
    "pitch_positive": "nose_up",
    "heading_positive": "clockwise",
    "heading_reference": "true",
    "euler_order": "ZYX",
    "height_reference": "ellipsoid",
    "column_order": "left_to_right",
}
"""What angles, heights and columns of a simulated flight mean."""

_STREAM = 20  # key of the random stream
_SINES = 12


@dataclass(frozen=True)
class Motion:
    """A sum of sines about a mean.

    Attributes
    ----------
    amplitude, frequency, phase
        Of each sine, shape (sine,); frequency [Hz], phase [rad].
    mean
        What it moves about.
    """

    amplitude: Floats
    frequency: Floats
    phase: Floats
    mean: float = 0.0

    @classmethod
    def slow(cls, amplitude: float, period: float, phase: float, mean: float = 0.0) -> Motion:
        """Return one sine of a period [s]."""
        return cls(np.array([amplitude]), np.array([1 / period]), np.array([phase]), mean)

    @classmethod
    def random(cls, spread: float, rate: float, rng: np.random.Generator) -> Motion:
        """Return sines of these standard deviations, of the motion and of its rate of change [1 s-1]."""
        part = np.geomspace(0.2, 2.0, _SINES) * rng.uniform(0.94, 1.06, _SINES)
        amplitude = part**-0.5
        amplitude *= spread * np.sqrt(2 / (amplitude**2).sum())
        rate_of_part = np.sqrt(((amplitude * part) ** 2).sum() / 2)
        frequency = part * rate / rate_of_part / (2 * np.pi)
        return cls(amplitude, frequency, rng.uniform(0, 2 * np.pi, _SINES))

    def at(self, seconds: Floats) -> Floats:
        """Return the motion at times [s]."""
        made = np.full(np.shape(seconds), self.mean)
        for a, f, p in zip(
            self.amplitude.tolist(), self.frequency.tolist(), self.phase.tolist(), strict=True
        ):
            made += a * np.sin(2 * np.pi * f * seconds + p)
        return made

    @property
    def most(self) -> float:
        """Largest magnitude that it can have."""
        return abs(self.mean) + float(np.abs(self.amplitude).sum())


#: Standard deviations of an angle [degree] or a distance [m], and of their rates [s-1], of what drones do.
_SPREADS: Mapping[str, Mapping[str, tuple[float, float]]] = {
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
    spreads = _SPREADS.get(settings.wobble, {})
    return {name: Motion.random(*pair, rng) for name, pair in spreads.items()}


@dataclass(frozen=True)
class Trajectory:
    """Where the navigation system is, and the camera that is fixed to it, at any moment.

    Attributes
    ----------
    frame
        Scene: x east, y north, z up of a place on the ground, over which the camera is at time zero [m].
    course
        Direction of flight, clockwise from north [degree].
    speed
        [m s-1]
    altitude
        Of the navigation's reference point above the ground [m].
    boresight
        Roll, pitch and heading of the camera in the body [degree].
    lever_arm
        Camera from the navigation's reference point: forward, right, down [m].
    motions
        Of ``roll``, ``pitch``, ``heading`` [degree], ``altitude``, and to the ``right`` of the course [m].
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
        """Return the flight of these settings."""
        first, second, third = settings.boresight
        forward, right, down = settings.lever_arm
        return cls(
            frame,
            float(settings.course),
            speed,
            altitude,
            (float(first), float(second), float(third)),
            (float(forward), float(right), float(down)),
            _motions(settings),
        )

    def pose(self, seconds: Floats) -> dict[str, Floats]:
        """Return position and attitude of the navigation system [degree, m]; heading from 0 to 360."""
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
        """Return the camera's place (..., 3) [m], and its rotation into the scene's axes (..., 3, 3).

        Notes
        -----
        With M from north, east, down at the platform into the scene, and the attitude R of the body and B of
        the camera in it: p = p_nav + M R l, and M R B.
        """
        pose = self.pose(seconds)
        place = self.frame.local(pose["latitude"], pose["longitude"], pose["altitude"])
        down = self.frame.from_north_east_down(pose["latitude"], pose["longitude"])
        body = down @ turns(quaternions(pose["roll"], pose["pitch"], pose["heading"]))
        return place + body @ np.array(self.lever_arm), body @ turns(quaternions(*self.boresight))

    @property
    def steepest(self) -> float:
        """Angle by which the camera's axis can lean from the vertical, along or across the track [degree]."""
        tilt = max(self._most("roll"), self._most("pitch"))
        return tilt + max(map(abs, self.boresight[:2]))

    @property
    def most_yaw(self) -> float:
        """Angle by which the camera can be turned from its course [degree]."""
        return self._most("heading") + abs(self.boresight[2])

    def _motion(self, name: str, seconds: Floats) -> Floats:
        return self.motions[name].at(seconds) if name in self.motions else np.zeros_like(seconds)

    def _most(self, name: str) -> float:
        return self.motions[name].most if name in self.motions else 0.0
