"""Named reflectance spectra of a scene: near normal, without the mirror reflection.

The renderer computes the first reflection of the clear coat over car paints, so that spectra exclude it:
Saunderson's k1 is subtracted from `CAR_PAINTS`. Spectra of surfaces
without a coat include all reflected light. The spectrum of glass is that of the surface behind it.

A paint is a scattering layer under a clear coat. Kubelka & Munk (1931): a thick layer whose absorption is K/S
times its scattering reflects R_inf = 1 + K/S - sqrt((K/S)^2 + 2 K/S). Saunderson (1942) adds the interface:
R = k1 + (1 - k1)(1 - k2) R_inf / (1 - k2 R_inf), with k1 = 0.04 and k2 = 0.60 for a refractive index of 1.5.
Other spectra are a straight line plus edges and bumps. No measured spectra are used, which may have licences.

*Weathered surfaces* are populations of spectra that vary over the ground and over cars. Asphalt is stones
with worn bitumen, stains and dust; painted lines wear down to asphalt; concrete darkens; lawns have dry
blades. Dust is a thin diffuse layer on all surfaces. It covers a share c of a surface of reflectance R, and
light to and from the rest passes the dust twice:

    R' = c D + (1 - c)^2 R / (1 - c D R)

with the reflectance D of thick dust (Kubelka's layers: J. Opt. Soc. Am. 44, 330, 1954). Levels, covers and
distances are plausible, not measured: fine aggregate of asphalt is 4 to 16 mm, and lines lose half of their
paint in some years.

*Car paints* are computed from a few parameters: pigments in a binder, with or without flakes, under a clear
coat. The base is opaque. Its albedo follows from absorption over scattering of its pigments, R_inf = 1 + K/S
- sqrt((K/S)^2 + 2 K/S) (Kubelka & Munk 1931), and K/S from absorption edges and bands; its reflectance
through the clear coat, near normal and without the mirror reflection, is `materials.coated_reflectance`.
Families differ in absorption and mixture; a number always gives the same paint of a family.

*The fleet* has realistic shares of colours, finishes, age and dust; "fleet-<number>" is a car of it. Of a
hundred cars, 39 are white, 23 black, 16 grey, 8 silver, 14 coloured. Paint manufacturers publish shares of
new cars: BASF's Color Report has white 39, grey 16, silver 8 in 2022 and white 36, black 21, grey 15, silver
9 in 2023, and 19 coloured in both years, of which 8 blue; Axalta's of 2017 has 26 solid and 13 pearl among
39 white [1]_ [2]_. Other finishes are not published by colour: here nearly all grey and silver cars are
metallic, and six in ten of all cars have flakes or mica. Consecutive numbers are distributed evenly over the
shares (R2 sequence), so that small car parks have them too.

References
----------
.. [1] BASF, "Color Report for Automotive OEM Coatings", 2022 and 2023.
.. [2] Axalta, "Global Automotive Color Popularity Report", 2017.
"""

import difflib
import functools
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from hyperpaint.base import Floats, SchemaError, one_of

from .materials import (
    Coat,
    Flakes,
    Material,
    coated_reflectance,
    flakes_of_flop,
    fresnel_reflectance,
    hemispherical_reflectance,
)

# --- paints and plain surfaces ------------------------------------------------------------------------------


# An edge or band of a spectrum: ``height`` times a form of the distance from ``centre`` in units of ``width``
# [nm].
class Feature(NamedTuple):
    form: Callable[[Floats], Floats]
    centre: float
    width: float
    height: float

    def __call__(self, wavelength: Floats) -> Floats:
        return np.asarray(self.height * self.form((wavelength - self.centre) / self.width))


#: Features by centre, width and height: a logistic step, which falls with a negative width, and a Gaussian.
Edge = functools.partial(Feature, lambda distance: 0.5 * (1.0 + np.tanh(distance / 2)))
Bump = functools.partial(Feature, lambda distance: np.exp(-0.5 * distance**2))


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
        clear = np.full_like(wavelength, self.absorption, dtype=np.float64)
        ratio = sum((absorber(wavelength) for absorber in self.absorbers), clear)
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


#: Reflectance factor, 0 to 1, by wavelength [nm].
Spectrum = Callable[[Floats], Floats]

# --- weathered surfaces ------------------------------------------------------------------------------------


# Spatial variation of a population over a surface
@dataclass(frozen=True)
class Octaves:
    lengths: tuple[float, ...]  # lengths of the variation [m]
    shares: tuple[float, ...]  # shares of the variance by length [1]
    # whether variation smaller than a pixel is averaged. False for members that were measured on pixels.
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


# A surface whose spectrum varies with position; as a function it is the mean of its members
@dataclass(frozen=True)
class Weathered:
    # function that returns the members at wavelengths [nm], (member, wavelength) [1]
    members: Callable[[Floats], Floats] = field(repr=False)
    octaves: Octaves  # spatial variation

    def population(self, wavelength: Floats) -> Floats:
        # members at ``wavelength`` [nm], (member, wavelength), 0 to 1
        return np.clip(self.members(np.atleast_1d(np.asarray(wavelength, np.float64))), 0.0, 1.0)

    def __call__(self, wavelength: Floats) -> Floats:
        # Return the reflectance at ``wavelength`` [nm], the mean of the members.
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


# --- base coats: pigments in a binder, with or without flakes ----------------------------------------------

#: Families of base coats of `generate_paint`: titanium white; a coloured pigment; a coloured pigment in a
#: white base; carbon in a white base; carbon; a black dye that is transparent in the near infrared; a pigment
#: with aluminium flakes; a pigment with mica flakes of an interference colour.
FAMILIES = ("white", "solid", "tinted", "grey", "carbon_black", "ir_black", "metallic", "pearl")


#: Edges and bands of K/S of the coloured pigments: kind, centre and its spread [nm], width [nm], height.
HUES: dict[str, tuple[tuple[str, float, float, float, float], ...]] = {
    "red": (("edge", 605.0, 10.0, -8.0, 7.0),),
    "orange": (("edge", 563.0, 8.0, -8.0, 7.0),),
    "yellow": (("edge", 510.0, 9.0, -8.0, 6.0),),
    "green": (("edge", 485.0, 8.0, -12.0, 5.0), ("bump", 655.0, 12.0, 48.0, 5.0)),
    "turquoise": (("edge", 430.0, 8.0, -12.0, 2.5), ("bump", 648.0, 10.0, 55.0, 5.0)),
    "blue": (
        ("edge", 415.0, 6.0, -14.0, 2.0), ("bump", 635.0, 12.0, 60.0, 6.0), ("bump", 562.0, 8.0, 35.0, 1.8),
    ),
    "violet": (("bump", 568.0, 9.0, 40.0, 5.0), ("edge", 412.0, 5.0, -12.0, 1.5)),
    "brown": (("edge", 575.0, 12.0, -32.0, 4.5),),
}  # fmt: skip

_FLAKE_DEPTH = 0.05  # depth of the flakes times the scattering S of the pigment
_BINDER_INDEX, _FILM_INDEX = 1.5, 2.5  # refractive index of binder and coat, and of titanium dioxide on mica

#: Cosine in the film for light that meets a flake at 45 degrees [1].
_TURNED_COSINE = float(np.sqrt(1.0 - 0.5 * (_BINDER_INDEX / _FILM_INDEX) ** 2))

_TITANIUM = Edge(404.0, -5.0, 4.0)  # rutile absorbs in the ultraviolet


# Contents of a base coat
@dataclass(frozen=True)
class Pigments:
    absorption: float  # K/S that is constant over wavelength
    absorbers: tuple[Feature, ...] = ()  # edges and bands added to K/S
    # optical thickness of the film on mica flakes [nm] and depth of its modulation, 0 to 1; None without mica
    interference: tuple[float, float] | None = None

    def albedo(self, wavelength: Floats) -> Floats:
        # albedo of the base under the coat at ``wavelength`` [nm], 0 to 1: Paint without interface is the
        # bare layer
        return Paint(self.absorption, self.absorbers, interface=0.0, internal=0.0)(wavelength)

    def flakes(self, wavelength: Floats, *, turned: bool = False) -> Floats:
        # reflectance of the flakes through the tinted binder, 0 to 1.
        # Light passes the tint twice, to a flake and back, with S d = 0.05. A film on mica adds the
        # modulation cos^2(2 pi d cos(theta) / lambda), with the angle theta in the film: 0, or with
        # ``turned`` that of light which meets the flake at 45 degrees.
        clear = np.full_like(wavelength, self.absorption, dtype=np.float64)
        tint = sum((absorber(wavelength) for absorber in self.absorbers), clear)
        metal = aluminium(wavelength)
        if self.interference is not None:
            thickness, depth = self.interference
            thickness *= _TURNED_COSINE if turned else 1.0
            metal = metal * (1.0 - depth * np.cos(2.0 * np.pi * thickness / wavelength) ** 2)
        return np.asarray(metal * np.exp(-2.0 * _FLAKE_DEPTH * tint))


def aluminium(wavelength: Floats) -> Floats:
    # reflectance of aluminium in a binder, with the dip of its interband transition at 825 nm.
    # A smooth fit to handbook values of the bare metal, about 0.92 in the green and 0.87 at 825 nm.
    return 0.92 - 0.01 * (wavelength - 550.0) / 1000.0 + Bump(825.0, 65.0, -0.045)(wavelength)


def mix(family: str, hue: str, rng: np.random.Generator) -> tuple[Pigments, str]:
    # base coat of a random paint of a family of `FAMILIES`, and its colour in words
    match family:
        case "white":
            return Pigments(rng.uniform(0.002, 0.012), (_TITANIUM,)), "white"
        case "grey":
            return Pigments(rng.uniform(0.15, 1.5), (_TITANIUM,)), "grey"
        case "carbon_black":
            return Pigments(rng.uniform(8.0, 20.0), (Edge(800.0, 90.0, -rng.uniform(0.0, 3.0)),)), "black"
        case "ir_black":
            edge = Edge(rng.uniform(700.0, 770.0), -rng.uniform(12.0, 22.0), rng.uniform(9.0, 15.0))
            return Pigments(rng.uniform(0.08, 0.4), (edge,)), "black"
    is_tinted = family == "tinted"
    strength = np.exp(rng.uniform(np.log(0.6), np.log(1.6)))
    if is_tinted:
        strength *= np.exp(rng.uniform(np.log(0.03), np.log(0.2)))
    floor = float(np.exp(rng.uniform(np.log(0.02), np.log(0.2))))
    absorbers = absorbers_of(HUES[hue], float(strength), rng)
    if is_tinted:
        return Pigments(0.2 * floor, (*absorbers, _TITANIUM)), f"light {hue}"
    film = (float(rng.uniform(180.0, 420.0)), float(rng.uniform(0.2, 0.5))) if family == "pearl" else None
    return Pigments(floor, absorbers, film), hue


def absorbers_of(
    rows: Sequence[tuple[str, float, float, float, float]], strength: float, rng: np.random.Generator
) -> tuple[Feature, ...]:
    # absorption edges and bands of K/S drawn around the ``rows`` of `HUES`
    return tuple(
        (Edge if kind == "edge" else Bump)(
            centre + rng.normal(0.0, centre_range / 2.0),
            width * rng.uniform(0.8, 1.3),
            strength * height * rng.uniform(0.8, 1.2),
        )
        for kind, centre, centre_range, width, height in rows
    )


# --- the fleet ---------------------------------------------------------------------------------------------

#: Share of all cars, by colour.
COLOUR_SHARES: Mapping[str, float] = {
    "white": 0.39,
    "black": 0.23,
    "grey": 0.16,
    "silver": 0.08,
    "coloured": 0.14,
}

#: Share of the cars of a colour, by finish.
FINISH_SHARES: Mapping[str, Mapping[str, float]] = {
    "white": {"solid": 2 / 3, "pearl": 1 / 3},
    "black": {"solid": 0.40, "metallic": 0.45, "pearl": 0.15},
    "grey": {"solid": 0.10, "metallic": 0.85, "pearl": 0.05},
    "silver": {"metallic": 1.0},
    "coloured": {"solid": 0.25, "metallic": 0.50, "pearl": 0.25},
}

#: Share of the coloured cars, by hue.
HUE_SHARES: Mapping[str, float] = {
    "blue": 0.55,
    "red": 0.27,
    "green": 0.06,
    "brown": 0.06,
    "orange": 0.03,
    "yellow": 0.03,
}

#: Minimum and maximum share of the light in the paint that meets flakes, by colour.
FLAKE_SHARES: Mapping[str, tuple[float, float]] = {
    "white": (0.10, 0.20), "black": (0.03, 0.10), "grey": (0.15, 0.35), "silver": (0.45, 0.65),
    "coloured": (0.08, 0.28),
}  # fmt: skip

_FLEET = SimpleNamespace(
    #: Minimum and maximum flop index of a paint with flakes, as far as pigment and share allow it; real
    #: paints reach 17.
    flops=(5.0, 16.0),
    mean_age_years=9.0,
    fleet_members=64,
    #: Steps of the sequence: powers of the inverse of the plastic number (M. Roberts 2018).
    r2=(0.7548776662466927, 0.5698402909980532),
)

# dust cover: median, standard deviation of the logarithm, maximum
_COVER, _COVER_LOG_SD, _MAX_COVER = 0.015, 0.7, 0.30
_DIRTY_SHARE, _DIRT = 0.08, 0.10  # share of dirty cars, and their additional dust cover

#: Spatial variation of dust on a car.
DIRT = Octaves((0.6, 0.20, 0.06, 0.02), (0.4, 0.25, 0.2, 0.15))


# The paint of a car of the fleet
@dataclass(frozen=True)
class FleetPaint:
    # colour, finish: colour and finish in words; the finish is "solid", "metallic" or "pearl"
    colour: str
    finish: str
    pigments: Pigments  # pigments of the base coat
    # flake_share, flop: share of the light in the paint that meets flakes, and the flop index, see
    # `hyperpaint.simulation.rendering.materials.flop_index`; 0 for a solid paint
    flake_share: float
    flop: float
    age: float  # age of the car [years]
    cover: float  # share of the car covered by dust [1]
    index: float  # refractive index of its clear coat

    def base(self, wavelength: Floats) -> Floats:
        # reflectance of its base under dust at many positions on the car, (member, wavelength)
        clean = coated_reflectance(self.pigments.albedo(wavelength), self.index)
        normal = np.random.default_rng([41, int(1e9 * self.cover)]).standard_normal((_FLEET.fleet_members, 1))
        return dusty(clean, np.minimum(self.cover * np.exp(0.45 * normal - 0.10), 0.6), wavelength)


@functools.lru_cache(maxsize=4096)
def fleet_paint(number: int) -> FleetPaint:
    """Return the paint of a car of the fleet; the same number always gives the same paint.

    Examples
    --------
    >>> cars = [fleet_paint(number) for number in range(200)]
    >>> sum(car.colour == "white" for car in cars), sum(car.finish != "solid" for car in cars)
    (78, 120)
    """
    rng = np.random.default_rng([43, number])
    positions = [(0.5 + (number + 1) * step) % 1.0 for step in _FLEET.r2]
    group = _choose(COLOUR_SHARES, positions[0])
    finish = _choose(FINISH_SHARES[group], positions[1])
    film = (float(rng.uniform(180.0, 420.0)), float(rng.uniform(0.1, 0.4))) if finish == "pearl" else None
    colour = group
    if group == "coloured":
        colour = _choose(HUE_SHARES, rng.random())
        strength, floor = np.exp(rng.uniform(np.log(0.6), np.log(1.6))), np.exp(rng.uniform(-3.5, -1.2))
        pigments = Pigments(float(floor), absorbers_of(HUES[colour], float(strength), rng), film)
    else:
        black = (
            "ir_black" if group == "black" and finish == "solid" and rng.random() < 0.2 else "carbon_black"
        )
        base, _ = mix({"white": "white", "black": black}.get(group, "grey"), "blue", rng)
        # greys are mixed with carbon, from light grey to anthracite; silver consists mostly of flakes
        if limits := {"grey": (0.3, 4.0), "silver": (0.08, 0.3)}.get(group):
            base = replace(base, absorption=float(np.exp(rng.uniform(*np.log(limits)))))
        pigments = replace(base, interference=film)
    share, flop = float(rng.uniform(*FLAKE_SHARES[group])), float(rng.uniform(*_FLEET.flops))
    age = float(min(rng.gamma(2.0, _FLEET.mean_age_years / 2.0), 30.0))
    cover = _COVER * np.exp(_COVER_LOG_SD * rng.standard_normal()) + _DIRT * (rng.random() < _DIRTY_SHARE)
    has_flakes = finish != "solid"
    return FleetPaint(
        colour=colour,
        finish=finish,
        pigments=pigments,
        flake_share=share if has_flakes else 0.0,
        flop=flop if has_flakes else 0.0,
        age=age,
        cover=float(min(cover, _MAX_COVER)),
        index=float(rng.uniform(1.48, 1.55)),
    )


def _choose(shares: Mapping[str, float], position: float) -> str:
    # the name whose share of the unit interval contains the position
    number = np.searchsorted(np.cumsum(list(shares.values())), position, side="right")
    return list(shares)[min(int(number), len(shares) - 1)]


# --- spectra and paints by name ----------------------------------------------------------------------------

#: Finishes of a paint, which differ in the change of reflectance with the angle of view.
FINISHES = ("solid", "metallic", "pearl")

_ADJECTIVES = (
    "Arctic",
    "Alpine",
    "Baltic",
    "Desert",
    "Harbour",
    "Imperial",
    "Lunar",
    "Monsoon",
    "Nordic",
    "Polar",
    "Solar",
    "Tundra",
)
#: Names of generated paints, of their flakes, and of flakes for light and view at right angles.
_NAME = re.compile(rf"(?:pigment:({'|'.join(FAMILIES)}):|(fleet)-)([0-9]{{1,9}})(:flakes(:turned)?)?")
_ROUGHENING = 0.03  # relative increase of the roughness of a coat in a year


@dataclass(frozen=True)
class PaintSpec:
    """A car paint: appearance and composition.

    Attributes
    ----------
    name
        Name of its spectrum: a name of the catalogue, or "pigment:<family>:<number>".
    finish
        One of `FINISHES`.
    colour
        Colour in words.
    trade_name
        Invented trade name.
    coat
        The clear coat.
    flakes
        Flakes in the base; None in a solid paint.
    pigments
        Pigments of the base coat of a generated paint; None for the catalogue.
    """

    name: str
    finish: str
    colour: str
    trade_name: str
    coat: Coat = Coat()  # noqa: RUF009  (frozen)
    flakes: Flakes | None = None
    pigments: Pigments | None = None

    def reflectance(self, wavelength: Floats) -> Floats:
        # Return the near-normal reflectance, specular component excluded, at ``wavelength`` [nm].
        #
        # Reflectance of the pigment only: in a metallic or pearl paint it applies to the light that does not
        # meet flakes; flakes add another lobe, mostly near the mirror direction.
        return spectrum_of(self.name)(wavelength)

    def material(self, name: str = "") -> Material:
        # material with this paint; its name is by default that of the spectrum
        return Material(name or self.name, self.name, "paint", self.coat, self.flakes)


#: Name, colour, trade name and flake share of the paints of the catalogue.
_CATALOGUE = {
    name: PaintSpec(
        name,
        "metallic" if share else "solid",
        colour,
        trade_name,
        flakes=Flakes(share) if share else None,
    )
    for name, colour, trade_name, share in (
        ("white", "white", "Polar White", 0.0),
        ("silver", "silver", "Lunar Silver", 0.5),
        ("grey", "grey", "Harbour Grey", 0.3),
        ("black", "black", "Carbon Black", 0.0),
        ("ir_black", "black", "Night Glass Black", 0.0),
        ("red", "red", "Signal Red", 0.0),
        ("dark_red", "dark red", "Garnet Red", 0.0),
        ("blue", "blue", "Baltic Blue", 0.15),
        ("light_blue", "light blue", "Alpine Blue", 0.0),
        ("green", "green", "Tundra Green", 0.15),
        ("yellow", "yellow", "Solar Yellow", 0.0),
        ("orange", "orange", "Desert Orange", 0.0),
        ("beige", "beige", "Dune Beige", 0.0),
        ("brown", "brown", "Umber Brown", 0.2),
    )
}

#: Names of fourteen plausible car paints, those of the paper's figure of one car park under three skies.
FOURTEEN = tuple(_CATALOGUE)


def paint_spec(name: str) -> PaintSpec:
    """Return a paint by the name of its spectrum.

    Parameters
    ----------
    name
        One of `FOURTEEN`, "pigment:<family>:<number>" with one of `FAMILIES`, or "fleet-<number>".

    Raises
    ------
    SchemaError
        There is no such paint.

    Examples
    --------
    >>> paint_spec("silver").finish, paint_spec("pigment:pearl:3").flakes.spectrum
    ('metallic', 'pigment:pearl:3:flakes')
    """
    if name in _CATALOGUE:
        return _CATALOGUE[name]
    parsed = _NAME.fullmatch(name)
    if parsed is None or parsed[4]:
        raise SchemaError(
            f"there is no paint {name!r}",
            expected=f"one of {', '.join(FOURTEEN)}, pigment:<family>:<number> or fleet-<number>",
            code="paint-unknown",
        )
    number = int(parsed[3])
    if parsed[1]:
        return generate_paint(parsed[1], number)
    # a car of the fleet; coats of older cars are rougher
    car, coat = fleet_paint(number), Coat()
    flakes = _flakes(name, car.finish, car.flake_share, car.flop, car.pigments) if car.flake_share else None
    coat = replace(coat, index=car.index, roughness=coat.roughness * (1.0 + _ROUGHENING * car.age))
    trade_name = f"{_ADJECTIVES[number % len(_ADJECTIVES)]} {car.colour.title()}"
    return PaintSpec(name, car.finish, car.colour, trade_name, coat, flakes)


def is_paint(name: str) -> bool:
    parsed = _NAME.fullmatch(name)
    return name in _CATALOGUE or (parsed is not None and not parsed[4])


def fleet_names(first: int, count: int) -> tuple[str, ...]:
    """Return the names of ``count`` cars of the fleet.

    Examples
    --------
    >>> fleet_names(7, 2)
    ('fleet-7', 'fleet-8')
    """
    return tuple(f"fleet-{number}" for number in range(first, first + count))


@functools.lru_cache(maxsize=4096)
def generate_paint(family: str, number: int) -> PaintSpec:
    """Return a paint of a family; the same number always gives the same paint.

    Parameters
    ----------
    family
        One of `FAMILIES`.
    number
        0 to 999 999 999.

    Raises
    ------
    SchemaError
        There is no such family or number.

    Examples
    --------
    >>> black = generate_paint("ir_black", 7)
    >>> black.reflectance(np.array([550.0, 900.0])).round(2)
    array([0.02, 0.29])
    """
    one_of(family, FAMILIES, "family")
    SchemaError.raise_if(
        not 0 <= number < 10**9,
        f"the number of a paint is {number!r}",
        expected="0 to 999999999",
        code="value-out-of-range",
    )
    rng = np.random.default_rng([FAMILIES.index(family), number])
    hue = str(rng.choice(list(HUES)))
    adjective = str(rng.choice(_ADJECTIVES))
    roughness = float(rng.uniform(5e-4, 3e-3))  # 82 to 74 gloss units
    pigments, colour = mix(family, hue, rng)
    finish, flakes = "solid", None
    name = f"pigment:{family}:{number}"
    if family in ("metallic", "pearl"):
        finish = family
        min_share, max_share = (0.3, 0.7) if family == "metallic" else (0.15, 0.4)
        flop = float(rng.uniform(4.0, 15.0))
        flakes = _flakes(name, finish, float(rng.uniform(min_share, max_share)), flop, pigments)
    trade_name, coat = f"{adjective} {colour.title()}", Coat(roughness=roughness)
    return PaintSpec(name, finish, colour, trade_name, coat, flakes, pigments)


def _flakes(name: str, finish: str, share: float, flop: float, pigments: Pigments) -> Flakes:
    # flakes with the lobe that gives a paint this flop index, or the nearest possible one
    spectrum = f"{name}:flakes"
    flakes = Flakes(share, spectrum=spectrum, turned=f"{spectrum}:turned" if finish == "pearl" else "")
    grid = np.linspace(380.0, 780.0, 41)
    paint = Material("paint", "body", "paint", Coat(), flakes)
    body = coated_reflectance(pigments.albedo(grid), Coat().index)
    return flakes_of_flop(flop, paint, grid, body, pigments.flakes(grid), nearest=True)


def _without_mirror(paint: Paint) -> Spectrum:
    return lambda wavelength: paint(wavelength) - paint.interface


_FURTHER_PAINTS = {
    "beige": Paint(0.09, [Edge(500.0, -45.0, 0.45), Edge(405.0, -6.0, 2.0)]),
    "brown": Paint(0.30, [Edge(570.0, -50.0, 3.0)]),
}

_LEAF = PlainSurface(
    0.045, 0.01, [Bump(552.0, 28.0, 0.08), Edge(716.0, 12.0, 0.42), Bump(968.0, 22.0, -0.03)]
)
_RED_LENS = PlainSurface(0.03, 0.0, [Edge(606.0, 7.0, 0.35)])
_REFLECTOR = PlainSurface(0.30, 0.05)  # reflector behind a clear lens

#: Named spectra; `spectrum_of` also returns generated paints.
SPECTRA: dict[str, Spectrum] = {
    **MATERIALS,
    **{name: _without_mirror(paint) for name, paint in {**CAR_PAINTS, **_FURTHER_PAINTS}.items()},
    "glass": PlainSurface(0.012),
    "aluminium": aluminium,
    "leaf": _LEAF,
    "leaf_through": lambda wavelength: leaf_transmittance(_LEAF(wavelength).clip(0.0, 1.0)),
    "brick": PlainSurface(0.13, 0.10, [Edge(585.0, 22.0, 0.16), Bump(870.0, 60.0, -0.015)]),
    "lamp_red": _RED_LENS,
    "tail_lamp": _RED_LENS,
    "lamp_clear": _REFLECTOR,
    "lamp": _REFLECTOR,
    "rim": PlainSurface(0.42, 0.03, [Bump(825.0, 65.0, -0.015)]),
    "plate": PlainSurface(0.55, 0.02, [Edge(415.0, 8.0, 0.15)]),
    "trim": PlainSurface(0.045, 0.005),
    "bark": PlainSurface(0.11, 0.22, [Edge(600.0, 60.0, 0.04)]),
    "steel": PlainSurface(0.36, 0.06),
    "patch": PlainSurface(0.055, 0.05),
    **WEATHERED,
}


def spectrum_of(name: str) -> Spectrum:
    """Return a reflectance spectrum by name.

    Parameters
    ----------
    name
        A key of `SPECTRA`; or a generated paint, "pigment:<family>:<number>" or "fleet-<number>", with the
        suffix ":flakes" for its flakes, and ":flakes:turned" for light and view at right angles (`Flakes`).

    Returns
    -------
    callable
        Function from wavelengths of any shape [nm] to reflectance factors, same shape, float64, 0 to 1.

    Raises
    ------
    SchemaError
        There is no such spectrum.

    Examples
    --------
    >>> spectrum_of("panel_20")(np.array([550.0, 800.0]))
    array([0.2, 0.2])
    >>> bool(spectrum_of("pigment:solid:17")(np.array([550.0]))[0] < 1.0)
    True
    >>> spectrum_of("panel_21")
    Traceback (most recent call last):
    hyperpaint.base.errors.SchemaError: ... 'panel_21'; did you mean 'panel_20'? [spectrum-unknown]
    """
    if parsed := _NAME.fullmatch(name):
        family, _, digits, of_flakes, turned = parsed.groups()
        car = None if family else fleet_paint(int(digits))
        paint: Any = car or generate_paint(family, int(digits))
        pigments: Pigments = paint.pigments
        if of_flakes:
            return _limited(functools.partial(pigments.flakes, turned=turned is not None))
        return (
            Weathered(car.base, DIRT)
            if car is not None
            else _limited(lambda wavelength: coated_reflectance(pigments.albedo(wavelength), Coat().index))
        )
    if name in WEATHERED:
        return WEATHERED[name]
    if name in SPECTRA:
        return _limited(SPECTRA[name])
    matches = difflib.get_close_matches(name, SPECTRA, 1)
    raise SchemaError(
        f"there is no spectrum {name!r}",
        mend=f"did you mean {matches[0]!r}?" if matches else f"there are {', '.join(SPECTRA)}",
        code="spectrum-unknown",
    )


def _limited(spectrum: Spectrum) -> Spectrum:
    # limit a spectrum to 0 to 1, which straight lines exceed far from 550 nm
    return lambda wavelength: np.clip(spectrum(np.asarray(wavelength, dtype=np.float64)), 0.0, 1.0)
