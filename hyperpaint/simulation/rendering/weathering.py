"""Weathered surfaces: populations of spectra that vary over the ground and over cars.

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

from .materials import fresnel_reflectance, hemispherical_reflectance


@dataclass(frozen=True)
class Octaves:
    """Spatial variation of a population over a surface.

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


#: Of the members of a library: a third each of dirt and curvature over a body part, of patches, and of noise.
MEASURED = Octaves((0.20, 0.05, 0.0125), (1 / 3, 1 / 3, 1 / 3), is_averaged=False)


#: Reflectance of mineral dust: brownish, brighter in the near infrared.
DUST = Plain(0.24, 0.20, [Edge(530.0, 60.0, 0.05)])

#: Of a weathered surface.
MEMBERS = 96

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
        # Members at ``wavelength`` [nm], (member, wavelength), 0 to 1.
        return np.clip(self.members(np.atleast_1d(np.asarray(wavelength, np.float64))), 0.0, 1.0)

    def __call__(self, wavelength: Floats) -> Floats:
        """Return the reflectance at ``wavelength`` [nm], the mean of the members."""
        grid = np.asarray(wavelength, np.float64)
        return np.asarray(self.population(grid.ravel()).mean(axis=0).reshape(grid.shape))


#: Refractive index of leaf tissue, and how many plates a leaf is like.
LEAF_INDEX, LEAF_LAYERS = 1.42, 1.55


def leaf_optics(passed: Floats, layers: float = LEAF_LAYERS) -> tuple[Floats, Floats]:
    """Return diffuse reflectance and transmittance of a leaf from the transmittance inside a plate [1].

    A leaf is a pile of plates, whose two streams Stokes (1862) has summed; the first plate is met within 40
    degrees of its normal, the others by diffuse light (Allen et al., J. Opt. Soc. Am. 59, 1376, 1969;
    Jacquemoud and Baret, Remote Sens. Environ. 34, 75, 1990).

    Examples
    --------
    >>> reflected, transmitted = leaf_optics(np.array([0.0, 0.9, 1.0]))
    >>> reflected.round(2), (reflected + transmitted).round(2)
    (array([0.03, 0.35, 0.49]), array([0.03, 0.73, 1.  ]))
    """
    sines = (np.arange(400) + 0.5) / 400 * np.sin(np.radians(40.0)) ** 2  # squares of them, even in flux
    first = 1.0 - float(fresnel_reflectance(np.sqrt(1.0 - sines), LEAF_INDEX).mean())
    outside = 1.0 - hemispherical_reflectance(LEAF_INDEX)
    inside = outside / LEAF_INDEX**2
    across = passed * inside / (1.0 - ((1.0 - inside) * passed) ** 2)
    top, through = 1.0 - first + (1.0 - inside) * passed * first * across, first * across
    t = np.maximum(outside * across, 1e-9)
    r = 1.0 - outside + (1.0 - inside) * passed * t
    root = np.sqrt(np.maximum((1 + r + t) * (1 + r - t) * (1 - r + t) * (1 - r - t), 0.0))
    lossless = 1.0 - r - t < 1e-9
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (1 + r**2 - t**2 + root) / (2 * r), ((1 - r**2 + t**2 + root) / (2 * t)) ** (layers - 1.0)
        below = np.where(lossless, 1.0 - t / (t + (1 - t) * (layers - 1)), a * (b**2 - 1) / (a**2 * b**2 - 1))
        under = np.where(lossless, 1.0 - below, b * (a**2 - 1) / (a**2 * b**2 - 1))
    return np.asarray(top + through * below * t / (1.0 - below * r)), through * under / (1.0 - below * r)


def leaf_transmittance(reflectance: Floats) -> Floats:
    """Return the transmittance of a leaf of a diffuse reflectance [1], at most 1 minus the reflectance.

    Examples
    --------
    >>> leaf_transmittance(np.array([0.06, 0.125, 0.468])).round(2)
    array([0.05, 0.13, 0.49])
    """
    low, high = np.zeros_like(reflectance, np.float64), np.ones_like(reflectance, np.float64)
    for _ in range(50):
        middle = 0.5 * (low + high)
        too_bright = leaf_optics(middle)[0] > reflectance
        low, high = np.where(too_bright, low, middle), np.where(too_bright, middle, high)
    return np.minimum(leaf_optics(low)[1], 1.0 - np.asarray(reflectance))


def _draws(kind: int, columns: int) -> Floats:
    # Standard normal numbers (column, member, 1), the same at every call.
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

#: Weathered surfaces by the names of their spectra.
WEATHERED: dict[str, Weathered] = {
    "worn_asphalt": Weathered(_asphalt(MATERIALS["asphalt"], 1), _STONES),
    "worn_patch": Weathered(_asphalt(_PATCH, 2), _STONES),
    "worn_line": Weathered(_line, Octaves((1.2, 0.35, 0.10, 0.03, 0.012), (0.25, 0.20, 0.20, 0.20, 0.15))),
    "weathered_concrete": Weathered(
        _concrete, Octaves((1.5, 0.45, 0.15, 0.04, 0.01), (0.25, 0.20, 0.15, 0.15, 0.25))
    ),
    "mixed_grass": Weathered(_grass, Octaves((2.0, 0.60, 0.20, 0.06, 0.02), (0.20, 0.15, 0.15, 0.25, 0.25))),
}
