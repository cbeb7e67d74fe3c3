"""What years and weather make of surfaces: populations of spectra that vary over the ground and over cars.

Asphalt is bitumen worn off its stones, with stains and dust; painted lines wear down to it; concrete darkens;
lawns have dry blades. Dust lies on everything as a thin diffuse layer. It covers the part c of a surface of
reflectance R, and light passes it twice elsewhere:

    R' = c D + (1 - c)^2 R / (1 - c D R)

with D the reflectance of thick dust (Kubelka's layers: J. Opt. Soc. Am. 44, 330, 1954). Levels, covers and
distances are plausible, not measured: fine aggregate of asphalt is 4 to 16 mm, lines lose a half of their
paint in some years.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.simulation.paint_spectra import MATERIALS, Bump, Edge, Plain

__all__ = ["DUST", "MEASURED", "WEATHERED", "Octaves", "Weathered", "dusty"]


@dataclass(frozen=True)
class Octaves:
    """How a population varies over a surface.

    Attributes
    ----------
    lengths
        Distances over which it does [m].
    shares
        Parts of its variance [1].
    is_averaged
        Whether what is smaller than a pixel averages out in it. Members that were pixels themselves have
        their spread whatever the size of a pixel.
    """

    lengths: tuple[float, ...]
    shares: tuple[float, ...]
    is_averaged: bool = True


MEASURED = Octaves((0.20, 0.05, 0.0125), (1 / 3, 1 / 3, 1 / 3), is_averaged=False)
"""Of the members of a library: a third each of dirt and curvature over a panel, of patches, and of noise."""


DUST = Plain(0.24, 0.20, [Edge(530.0, 60.0, 0.05)])
"""Reflectance of mineral dust: brownish, brighter in the near infrared."""

MEMBERS = 96
"""Of a weathered surface."""

_DRY = Plain(0.26, 0.40, [Edge(680.0, 40.0, 0.03), Bump(968.0, 22.0, -0.02)])  # blades
_PATCH = Plain(0.055, 0.05)  # mended asphalt, young


def dusty(reflectance: Floats, cover: Floats | float, wavelength: Floats) -> Floats:
    """Return the reflectance of a surface under dust that covers the part ``cover`` of it [1].

    Examples
    --------
    >>> black = np.array([0.02])
    >>> [dusty(black, cover, np.array([550.0])).round(3).item() for cover in (0.0, 0.05, 1.0)]
    [0.02, 0.032, 0.269]
    """
    dust = DUST(wavelength)
    cover = np.asarray(cover)
    return np.asarray(cover * dust + (1.0 - cover) ** 2 * reflectance / (1.0 - cover * dust * reflectance))


@dataclass(frozen=True)
class Weathered:
    """A surface whose spectrum varies from place to place; as a function it is the mean of its members.

    Attributes
    ----------
    members
        Gives the members at wavelengths [nm], (member, wavelength) [1].
    octaves
        Over which distances it varies.
    """

    members: Callable[[Floats], Floats] = field(repr=False)
    octaves: Octaves

    def population(self, wavelength: Floats) -> Floats:
        """Return the members at ``wavelength`` [nm], (member, wavelength), 0 to 1."""
        grid = np.atleast_1d(np.asarray(wavelength, np.float64))
        return np.clip(self.members(grid), 0.0, 1.0)

    def __call__(self, wavelength: Floats) -> Floats:
        """Return the reflectance at ``wavelength`` [nm], the mean of the members."""
        grid = np.asarray(wavelength, np.float64)
        return np.asarray(self.population(grid.ravel()).mean(axis=0).reshape(grid.shape))


def _draws(kind: int, columns: int) -> Floats:
    """Return standard normal numbers (column, member, 1), the same at every call."""
    return np.random.default_rng([31, kind]).standard_normal((columns, MEMBERS, 1))


def _asphalt(stone: Callable[[Floats], Floats], kind: int) -> Callable[[Floats], Floats]:
    def members(wavelength: Floats) -> Floats:
        level, dust, tint = _draws(kind, 3)
        worn = np.exp(0.20 * level) * stone(wavelength) * (1.0 + 0.06 * tint * (wavelength - 650.0) / 300.0)
        return dusty(worn, 0.05 * np.exp(0.45 * dust), wavelength)

    return members


def _line(wavelength: Floats) -> Floats:
    level, wear, dirt = _draws(3, 3)
    worn = 1.0 / (1.0 + np.exp(1.1 - 1.4 * wear))  # share of the asphalt that shows again
    paint = MATERIALS["painted_line"](wavelength) * np.exp(0.05 * level)
    bare = (1.0 - worn) * paint + worn * MATERIALS["asphalt"](wavelength) * np.exp(0.15 * level)
    return dusty(bare, 0.10 * np.exp(0.5 * dirt), wavelength)


def _concrete(wavelength: Floats) -> Floats:
    level, stain, tint = _draws(4, 3)
    dark = 0.35 / (1.0 + np.exp(1.8 - 1.2 * stain))
    tinted = 1.0 + 0.04 * tint * (wavelength - 650.0) / 300.0
    stone = MATERIALS["concrete"](wavelength) * np.exp(0.08 * level) * tinted
    return np.asarray((1.0 - dark) * stone + dark * MATERIALS["asphalt"](wavelength))


def _grass(wavelength: Floats) -> Floats:
    level, dry = _draws(5, 2)
    share = 0.7 / (1.0 + np.exp(1.2 - 1.1 * dry))
    blades = (1.0 - share) * MATERIALS["grass"](wavelength) + share * _DRY(wavelength)
    return np.asarray(np.exp(0.22 * level) * blades)


_SLABS = Octaves((1.5, 0.45, 0.15, 0.04, 0.01), (0.25, 0.20, 0.15, 0.15, 0.25))
_STONES = Octaves((3.0, 1.0, 0.35, 0.12, 0.04, 0.012), (0.14, 0.08, 0.06, 0.07, 0.15, 0.50))

WEATHERED: dict[str, Weathered] = {
    "worn_asphalt": Weathered(_asphalt(MATERIALS["asphalt"], 1), _STONES),
    "worn_patch": Weathered(_asphalt(_PATCH, 2), _STONES),
    "worn_line": Weathered(_line, Octaves((1.2, 0.35, 0.10, 0.03, 0.012), (0.25, 0.20, 0.20, 0.20, 0.15))),
    "weathered_concrete": Weathered(
        _concrete, Octaves((1.5, 0.45, 0.15, 0.04, 0.01), (0.25, 0.20, 0.15, 0.15, 0.25))
    ),
    "mixed_grass": Weathered(_grass, Octaves((2.0, 0.60, 0.20, 0.06, 0.02), (0.20, 0.15, 0.15, 0.25, 0.25))),
}
"""Weathered surfaces by the names of their spectra."""
