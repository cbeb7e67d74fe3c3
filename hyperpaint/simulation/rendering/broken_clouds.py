"""Broken clouds over a scene: their shadows move over the ground, so that light varies over swath and time.

The ground is in shadow where a Gaussian random field, which moves with the wind, exceeds a threshold. The
field is a sum of plane waves with random directions and phases (M. Shinozuka, J. Sound Vib. 25, 111, 1972):
it is defined at every position and time without a grid, and does not depend on the order of evaluation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.simulation.setting_checks import check_number, check_whole

_WAVES = 64
#: Share of the direct light blocked by clouds that becomes diffuse light everywhere.
_SCATTERED_SHARE = 1.0 / 3.0


@dataclass(frozen=True)
class BrokenClouds:
    """Shadows of broken clouds.

    Attributes
    ----------
    cover
        Share of the ground in shadow, 0 to 1.
    size
        Correlation length of the field [m].
    speed, heading
        Speed of the shadows [m s-1], and the direction they move to, clockwise from north [degree].
    opacity
        Share of the direct light that a cloud blocks, 0 to 1.
    edge
        Width of a shadow's edge relative to ``size``.
    station
        East and north of the spectrometer that records the irradiance [m].
    seed
        Random seed of the clouds.

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
        problems = Problems("the clouds cannot be used", SchemaError)
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
            Positions on the ground, of shapes that broadcast [m].
        seconds
            Times, of a shape that broadcasts [s].
        """
        from scipy.special import ndtri

        x, y, t = np.broadcast_arrays(*(np.asarray(values, np.float64) for values in (east, north, seconds)))
        towards = np.radians(self.heading)
        x = x - self.speed * np.sin(towards) * t
        y = y - self.speed * np.cos(towards) * t
        rng = np.random.default_rng([self.seed, 7])
        # waves of a field with the correlation exp(-d^2 / size^2)
        waves = rng.standard_normal((_WAVES, 2)) * np.sqrt(2.0) / self.size
        phase = rng.uniform(0.0, 2.0 * np.pi, _WAVES)
        field = np.zeros(x.shape)
        for (kx, ky), start in zip(waves, phase, strict=True):
            field += np.cos(kx * x + ky * y + start)
        field *= np.sqrt(2.0 / _WAVES)
        shadow = np.clip(0.5 + (field - ndtri(1.0 - self.cover)) / self.edge, 0.0, 1.0)
        direct = 1.0 - self.opacity * shadow
        diffuse = np.full(x.shape, 1.0 + _SCATTERED_SHARE * self.opacity * self.cover)
        is_finite = np.isfinite(x + y)
        return np.stack([np.where(is_finite, direct, 1.0), np.where(is_finite, diffuse, 1.0)])
