"""Broken clouds over a scene: their shadows move over the ground, so that light varies over swath and time.

Where a Gaussian random field of ground position, carried along by the wind, is above a threshold, there is a
cloud's shadow. The field is a sum of plane waves with random directions and phases (M. Shinozuka, J. Sound
Vib. 25, 111, 1972): it has a value at every place and time, needs no grid, and is the same whatever is asked
for first.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.simulation.setting_checks import check_number, check_whole

_WAVES = 64
_RETURNED = 1.0 / 3.0  # of the direct light that clouds take, as diffuse light everywhere


@dataclass(frozen=True)
class BrokenClouds:
    """Shadows of broken clouds.

    Attributes
    ----------
    cover
        Share of the ground in shadow, 0 to 1.
    size
        Distance over which the field loses its memory [m].
    speed, heading
        Of the shadows [m s-1], and where they go to, clockwise from north [degree].
    opacity
        Share of the direct light that a cloud takes, 0 to 1.
    edge
        Width of a shadow's edge relative to ``size``.
    station
        East and north of the spectrometer that records the irradiance [m].
    seed
        Another seed, other clouds.

    Raises
    ------
    SchemaError
        Attributes are out of range; all are listed.

    Examples
    --------
    >>> clouds = BrokenClouds(cover=0.4, size=30.0)
    >>> direct, diffuse = clouds.factors(np.array([0.0, 40.0, 80.0]), 0.0, 0.0)
    >>> bool((direct >= 1.0 - clouds.opacity).all()), bool((direct <= 1.0).all())
    (True, True)
    """

    cover: float = 0.4
    size: float = 200.0
    speed: float = 8.0
    heading: float = 90.0
    opacity: float = 0.8
    edge: float = 0.05
    station: tuple[float, float] = (0.0, 0.0)
    seed: int = 0

    def __post_init__(self) -> None:
        problems = Problems("clouds cannot be over this scene", SchemaError)
        for name in ("cover", "opacity"):
            check_number(problems, name, getattr(self, name), 0.0, 1.0)
        check_number(problems, "size", self.size, 0.0, 1e6, above=True)
        check_number(problems, "speed", self.speed, 0.0, 1e3)
        check_number(problems, "edge", self.edge, 0.0, 10.0, above=True)
        check_whole(problems, "seed", self.seed, 0, 2**63 - 1)
        if not np.isfinite([self.heading, *self.station]).all():
            problems.add(
                f"heading={self.heading!r} and station={self.station!r:.60}",
                expected="finite numbers",
                code="not-finite",
            )
        problems.raise_if_any()

    def factors(self, east: npt.ArrayLike, north: npt.ArrayLike, seconds: npt.ArrayLike) -> Floats:
        """Return factors of direct and of diffuse light, (2, ...); 1 at NaN places.

        Parameters
        ----------
        east, north
            Places on the ground, any shapes that go together [m].
        seconds
            Times, likewise [s].
        """
        from scipy.special import ndtri

        x, y, t = np.broadcast_arrays(*(np.asarray(part, np.float64) for part in (east, north, seconds)))
        towards = np.radians(self.heading)
        x = x - self.speed * np.sin(towards) * t
        y = y - self.speed * np.cos(towards) * t
        rng = np.random.default_rng([self.seed, 7])
        # waves of a field whose correlation falls as exp(-d^2 / size^2)
        waves = rng.standard_normal((_WAVES, 2)) * np.sqrt(2.0) / self.size
        phase = rng.uniform(0.0, 2.0 * np.pi, _WAVES)
        field = np.zeros(x.shape)
        for (kx, ky), start in zip(waves, phase, strict=True):
            field += np.cos(kx * x + ky * y + start)
        field *= np.sqrt(2.0 / _WAVES)
        shadow = np.clip(0.5 + (field - ndtri(1.0 - self.cover)) / self.edge, 0.0, 1.0)
        direct = 1.0 - self.opacity * shadow
        diffuse = np.full(x.shape, 1.0 + _RETURNED * self.opacity * self.cover)
        there = np.isfinite(x + y)
        return np.stack([np.where(there, direct, 1.0), np.where(there, diffuse, 1.0)])
