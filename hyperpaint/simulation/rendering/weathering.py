"""Weathered surfaces: populations of spectra that vary over the ground and over cars.

Asphalt is stones with worn bitumen, stains and dust; painted lines wear down to asphalt; concrete darkens;
lawns have dry blades. Dust is a thin diffuse layer on all surfaces. It covers a share c of a surface of
reflectance R, and light to and from the rest passes the dust twice:

    R' = c D + (1 - c)^2 R / (1 - c D R)

with the reflectance D of thick dust (Kubelka's layers: J. Opt. Soc. Am. 44, 330, 1954). Levels, covers and
distances are plausible, not measured: fine aggregate of asphalt is 4 to 16 mm, and lines lose half of their
paint in some years.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.simulation.paint_spectra import MATERIALS, Bump, Edge, PlainSurface

from .materials import fresnel_reflectance, hemispherical_reflectance


@dataclass(frozen=True)
class Octaves:
    """Spatial variation of a population over a surface.

    Attributes
    ----------
    lengths
        Lengths of the variation [m].
    shares
        Shares of the variance by length [1].
    is_averaged
        Whether variation smaller than a pixel is averaged. False for members that were measured on pixels.
    """

    lengths: tuple[float, ...]
    shares: tuple[float, ...]
    is_averaged: bool = True


#: Variation of the members of a library: equal shares of curvature and dirt on a body part, patches, and
#: noise.
MEASURED = Octaves((0.20, 0.05, 0.0125), (1 / 3, 1 / 3, 1 / 3), is_averaged=False)


#: Reflectance of mineral dust: brownish, brighter in the near infrared.
DUST = PlainSurface(0.24, 0.20, [Edge(530.0, 60.0, 0.05)])

#: Number of members of a weathered surface.
MEMBERS = 96

_DRY_GRASS = PlainSurface(0.26, 0.40, [Edge(680.0, 40.0, 0.03), Bump(968.0, 22.0, -0.02)])
_PATCH = PlainSurface(0.055, 0.05)  # new asphalt of a repair


def dusty(reflectance: Floats, cover: Floats | float, wavelength: Floats) -> Floats:
    """Return the reflectance of a surface under dust that covers the share ``cover`` of the surface [1].

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
    """A surface whose spectrum varies with position; as a function it is the mean of its members.

    Attributes
    ----------
    members
        Function that returns the members at wavelengths [nm], (member, wavelength) [1].
    octaves
        Spatial variation.
    """

    members: Callable[[Floats], Floats] = field(repr=False)
    octaves: Octaves

    def population(self, wavelength: Floats) -> Floats:
        # members at ``wavelength`` [nm], (member, wavelength), 0 to 1
        return np.clip(self.members(np.atleast_1d(np.asarray(wavelength, np.float64))), 0.0, 1.0)

    def __call__(self, wavelength: Floats) -> Floats:
        """Return the reflectance at ``wavelength`` [nm], the mean of the members."""
        grid = np.asarray(wavelength, np.float64)
        return np.asarray(self.population(grid.ravel()).mean(axis=0).reshape(grid.shape))


#: Refractive index of leaf tissue, and the number of plates equivalent to a leaf.
LEAF_INDEX, LEAF_LAYERS = 1.42, 1.55


def leaf_optics(plate_transmittance: Floats, layers: float = LEAF_LAYERS) -> tuple[Floats, Floats]:
    """Return diffuse reflectance and transmittance of a leaf from the transmittance inside a plate [1].

    A leaf is a pile of plates with two streams of light (Stokes 1862); light reaches the first plate within
    40 degrees of its normal, other plates as diffuse light (Allen et al., J. Opt. Soc. Am. 59, 1376, 1969;
    Jacquemoud and Baret, Remote Sens. Environ. 34, 75, 1990).

    Examples
    --------
    >>> reflected, transmitted = leaf_optics(np.array([0.0, 0.9, 1.0]))
    >>> reflected.round(2), (reflected + transmitted).round(2)
    (array([0.03, 0.35, 0.49]), array([0.03, 0.73, 1.  ]))
    """
    squared_sines = (np.arange(400) + 0.5) / 400 * np.sin(np.radians(40.0)) ** 2  # evenly spaced in flux
    entering = 1.0 - float(fresnel_reflectance(np.sqrt(1.0 - squared_sines), LEAF_INDEX).mean())
    outer_transmittance = 1.0 - hemispherical_reflectance(LEAF_INDEX)
    inner_transmittance = outer_transmittance / LEAF_INDEX**2
    crossing = (
        plate_transmittance
        * inner_transmittance
        / (1.0 - ((1.0 - inner_transmittance) * plate_transmittance) ** 2)
    )
    top_reflectance, top_transmittance = (
        1.0 - entering + (1.0 - inner_transmittance) * plate_transmittance * entering * crossing,
        entering * crossing,
    )
    t = np.maximum(outer_transmittance * crossing, 1e-9)
    r = 1.0 - outer_transmittance + (1.0 - inner_transmittance) * plate_transmittance * t
    root = np.sqrt(np.maximum((1 + r + t) * (1 + r - t) * (1 - r + t) * (1 - r - t), 0.0))
    is_lossless = 1.0 - r - t < 1e-9
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (1 + r**2 - t**2 + root) / (2 * r), ((1 - r**2 + t**2 + root) / (2 * t)) ** (layers - 1.0)
        lower_reflectance = np.where(
            is_lossless, 1.0 - t / (t + (1 - t) * (layers - 1)), a * (b**2 - 1) / (a**2 * b**2 - 1)
        )
        lower_transmittance = np.where(
            is_lossless, 1.0 - lower_reflectance, b * (a**2 - 1) / (a**2 * b**2 - 1)
        )
    return np.asarray(
        top_reflectance + top_transmittance * lower_reflectance * t / (1.0 - lower_reflectance * r)
    ), top_transmittance * lower_transmittance / (1.0 - lower_reflectance * r)


def leaf_transmittance(reflectance: Floats) -> Floats:
    """Return the transmittance of a leaf from its diffuse reflectance [1], at most 1 minus the reflectance.

    Examples
    --------
    >>> leaf_transmittance(np.array([0.06, 0.125, 0.468])).round(2)
    array([0.05, 0.13, 0.49])
    """
    lower, upper = np.zeros_like(reflectance, np.float64), np.ones_like(reflectance, np.float64)
    for _ in range(50):
        mean = 0.5 * (lower + upper)
        too_bright = leaf_optics(mean)[0] > reflectance
        lower, upper = np.where(too_bright, lower, mean), np.where(too_bright, mean, upper)
    return np.minimum(leaf_optics(lower)[1], 1.0 - np.asarray(reflectance))


def _draws(kind: int, columns: int) -> Floats:
    # standard normal numbers (column, member, 1), the same in every call
    return np.random.default_rng([31, kind]).standard_normal((columns, MEMBERS, 1))


def _asphalt(stone: Callable[[Floats], Floats], kind: int) -> Callable[[Floats], Floats]:
    def members(wavelength: Floats) -> Floats:
        level, dust, tint = _draws(kind, 3)
        worn = np.exp(0.20 * level) * stone(wavelength) * (1.0 + 0.06 * tint * (wavelength - 650.0) / 300.0)
        return dusty(worn, 0.05 * np.exp(0.45 * dust), wavelength)

    return members


def _line(wavelength: Floats) -> Floats:
    level, wear, dirt = _draws(3, 3)
    worn = 1.0 / (1.0 + np.exp(1.1 - 1.4 * wear))  # share of visible asphalt
    paint = MATERIALS["painted_line"](wavelength) * np.exp(0.05 * level)
    mixture = (1.0 - worn) * paint + worn * MATERIALS["asphalt"](wavelength) * np.exp(0.15 * level)
    return dusty(mixture, 0.10 * np.exp(0.5 * dirt), wavelength)


def _concrete(wavelength: Floats) -> Floats:
    level, stain, tint = _draws(4, 3)
    dark = 0.35 / (1.0 + np.exp(1.8 - 1.2 * stain))
    tinted = 1.0 + 0.04 * tint * (wavelength - 650.0) / 300.0
    stone = MATERIALS["concrete"](wavelength) * np.exp(0.08 * level) * tinted
    return np.asarray((1.0 - dark) * stone + dark * MATERIALS["asphalt"](wavelength))


def _grass(wavelength: Floats) -> Floats:
    level, dry = _draws(5, 2)
    share = 0.7 / (1.0 + np.exp(1.2 - 1.1 * dry))
    blades = (1.0 - share) * MATERIALS["grass"](wavelength) + share * _DRY_GRASS(wavelength)
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
