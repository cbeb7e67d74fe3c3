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
from hyperpaint.base.facts import check_fields, declared, fact
from hyperpaint.simulation.settings import MAX_SEED

_WAVES = 64
#: Share of the direct light blocked by clouds that becomes diffuse light everywhere.
_SCATTERED_SHARE = 1.0 / 3.0


@declared
@dataclass(frozen=True)
class BrokenClouds:
    """Shadows of broken clouds.

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

    cover: float = fact(0.4, "share of the ground in shadow", least=0.0, most=1.0)
    size: float = fact(
        200.0,
        "distance over which the random field of the clouds loses its correlation",
        unit="m",
        least=0.0,
        above=True,
        most=1e6,
    )
    speed: float = fact(8.0, "speed of the shadows", unit="m s-1", least=0.0, most=1e3)
    heading: float = fact(90.0, "direction of the shadows, clockwise from north", unit="degree")
    opacity: float = fact(0.8, "share of the direct light that a cloud takes", least=0.0, most=1.0)
    edge: float = fact(
        0.05, "width of the edge of a shadow relative to ``size``", least=0.0, above=True, most=10.0
    )
    station: tuple[float, float] = fact(
        (0.0, 0.0), "east and north of the spectrometer that records the irradiance", unit="m", length=2
    )
    seed: int = fact(0, "chooses the clouds", least=0, most=MAX_SEED)

    def __post_init__(self) -> None:
        problems = Problems("the clouds cannot be used", SchemaError)
        check_fields(self, problems)
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
