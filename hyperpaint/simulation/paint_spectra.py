"""Reflectance spectra of car paints and other surfaces of a car park, computed from a few parameters.

A paint is a scattering layer under a clear coat. Kubelka & Munk (1931): a thick layer whose absorption is K/S
times its scattering reflects R_inf = 1 + K/S - sqrt((K/S)^2 + 2 K/S). Saunderson (1942) adds the interface:
R = k1 + (1 - k1)(1 - k2) R_inf / (1 - k2 R_inf), with k1 = 0.04 and k2 = 0.60 for a refractive index of 1.5.
Other spectra are a straight line plus edges and bumps. No measured spectra are used, which may have licences.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from hyperpaint.base.arrays import Floats


class Feature(Protocol):
    def __call__(self, wavelength: Floats) -> Floats:
        """Return the height of the feature at ``wavelength`` [nm]."""


# A logistic step of ``height`` at ``centre`` [nm]; a positive ``width`` [nm] rises, a negative one falls.
@dataclass(frozen=True)
class Edge:
    centre: float
    width: float
    height: float

    def __call__(self, wavelength: Floats) -> Floats:
        return np.asarray(self.height * 0.5 * (1.0 + np.tanh((wavelength - self.centre) / (2 * self.width))))


# A Gaussian of ``height`` at ``centre`` [nm] with the standard deviation ``width`` [nm].
@dataclass(frozen=True)
class Bump:
    centre: float
    width: float
    height: float

    def __call__(self, wavelength: Floats) -> Floats:
        return np.asarray(self.height * np.exp(-0.5 * ((wavelength - self.centre) / self.width) ** 2))


# A paint layer by Kubelka-Munk and Saunderson: K/S is ``absorption`` plus the absorbers.
@dataclass(frozen=True)
class Paint:
    absorption: float
    absorbers: Sequence[Feature] = ()
    interface: float = 0.04
    internal: float = 0.60

    def __call__(self, wavelength: Floats) -> Floats:
        """Return the reflectance factor at ``wavelength`` [nm].

        Examples
        --------
        >>> thick = Paint(absorption=0.005555555555555556)  # R_inf = 0.9
        >>> thick(np.array([550.0])).round(3)
        array([0.791])
        """
        ratio = np.full_like(wavelength, self.absorption, dtype=np.float64)
        for absorber in self.absorbers:
            ratio += absorber(wavelength)
        # this form of R_inf has no cancellation for dark layers
        deep = 1.0 / (1.0 + ratio + np.sqrt(ratio * (ratio + 2.0)))
        k1, k2 = self.interface, self.internal
        return k1 + (1.0 - k1) * (1.0 - k2) * deep / (1.0 - k2 * deep)


# A surface with its reflectance at 550 nm, its slope per micrometre, and features.
@dataclass(frozen=True)
class PlainSurface:
    level: float
    slope: float = 0.0
    features: Sequence[Feature] = ()

    def __call__(self, wavelength: Floats) -> Floats:
        total = self.level + self.slope * (wavelength - 550.0) / 1000.0
        for feature in self.features:
            total = total + feature(wavelength)
        return np.asarray(total)


#: A dozen car paints.
CAR_PAINTS: dict[str, Paint] = {
    "white": Paint(0.006, [Edge(405.0, -5.0, 4.0), Bump(930.0, 40.0, 0.003)]),
    "silver": Paint(0.10, [Edge(420.0, -12.0, 0.25), Bump(820.0, 70.0, 0.02)]),
    "grey": Paint(0.75, [Edge(430.0, -25.0, 0.3), Edge(800.0, 60.0, 0.1)]),
    "black": Paint(14.0, [Edge(800.0, 80.0, -2.0)]),
    "ir_black": Paint(0.25, [Edge(735.0, -16.0, 12.0)]),
    "red": Paint(0.035, [Edge(603.0, -7.0, 7.0), Bump(860.0, 40.0, 0.02)]),
    "dark_red": Paint(0.45, [Edge(622.0, -11.0, 10.0), Bump(880.0, 50.0, 0.2)]),
    "blue": Paint(0.12, [Bump(640.0, 62.0, 6.0), Edge(415.0, -14.0, 2.0), Bump(560.0, 35.0, 1.5)]),
    "light_blue": Paint(0.05, [Bump(640.0, 55.0, 0.9), Edge(412.0, -10.0, 1.0)]),
    "green": Paint(0.25, [Edge(485.0, -12.0, 5.0), Bump(655.0, 50.0, 5.0)]),
    "yellow": Paint(0.02, [Edge(508.0, -7.0, 6.0)]),
    "orange": Paint(0.025, [Edge(562.0, -8.0, 7.0)]),
}

#: Reflectance factors of the grey panels, constant over wavelength.
PANELS = (0.05, 0.20, 0.50, 0.90)

_VEGETATION: list[Feature] = [Bump(552.0, 28.0, 0.075), Edge(716.0, 12.0, 0.40), Bump(968.0, 22.0, -0.05)]

#: Materials of a scene; the position in this table is the class of a pixel.
MATERIALS: dict[str, Paint | PlainSurface] = {
    "asphalt": PlainSurface(0.085, 0.08, [Edge(430.0, 30.0, 0.01)]),
    "painted_line": Paint(0.03, [Edge(410.0, -8.0, 3.0)]),
    "grass": PlainSurface(0.035, 0.02, _VEGETATION),
    "concrete": PlainSurface(0.30, 0.18, [Edge(480.0, 60.0, 0.04)]),
    "glass": PlainSurface(0.035, -0.005),
    "tyre": PlainSurface(0.04, 0.01),
    **{f"panel_{round(100 * level):02d}": PlainSurface(level) for level in PANELS},
    **CAR_PAINTS,
}


def reflectance(names: Sequence[str], wavelength: Floats) -> Floats:
    """Return the reflectance factor of the named materials, shape (name, wavelength).

    Parameters
    ----------
    names
        Keys of `MATERIALS`.
    wavelength
        Shape (wavelength,) [nm].

    Examples
    --------
    >>> reflectance(["panel_20", "panel_90"], np.array([550.0, 760.0]))
    array([[0.2, 0.2],
           [0.9, 0.9]])
    """
    return np.stack([MATERIALS[name](wavelength) for name in names])
