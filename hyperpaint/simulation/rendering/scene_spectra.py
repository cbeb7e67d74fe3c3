"""Every reflectance spectrum that a scene can name: near normal, without the mirror reflection.

Car paints lie under a clear coat whose first reflection the renderer makes itself, so that it is left out
here: of the paints of `hyperpaint.simulation.paint_spectra`, Saunderson's k1 is taken off. What has no coat
keeps all that it reflects. Of glass, what is behind it is left.

*Car paints* come from a few parameters: pigments in a binder, flakes among them, a clear coat over all.
A base is as thick as light goes. Its albedo follows from the absorption over the scattering of its pigments,
R_inf = 1 + K/S - sqrt((K/S)^2 + 2 K/S) (Kubelka & Munk 1931), and K/S from absorption edges and bands; what
an instrument sees of it through the clear coat near normal, without the mirror reflection, is
`materials.coated_reflectance`. Families differ in where they absorb and what they are mixed with; a number
chooses one paint of a family, always the same.
"""

from __future__ import annotations

import difflib
import functools
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import SchemaError
from hyperpaint.simulation.paint_spectra import CAR_PAINTS, MATERIALS, Bump, Edge, Feature, Paint, Plain

from .materials import Coat, Flakes, Material, coated_reflectance

__all__ = [
    "FAMILIES", "FINISHES", "FOURTEEN", "SPECTRA", "PaintSpec", "Pigments", "Spectrum", "generate_paint",
    "paint_spec", "spectrum_of",
]  # fmt: skip


FINISHES = ("solid", "metallic", "pearl")
"""What a paint looks like when one walks around it."""

FAMILIES = ("white", "solid", "tinted", "grey", "carbon_black", "ir_black", "metallic", "pearl")
"""What `generate_paint` makes: titanium white; a coloured pigment; the same in a white base; carbon in a
white base; carbon; a dye that is black to the eye and transparent in the near infrared; colour over aluminium
flakes; colour among mica flakes with an interference colour."""

#: Edges and bands of K/S of the coloured pigments: kind, centre and its spread [nm], width [nm], height.
_HUES: dict[str, tuple[tuple[str, float, float, float, float], ...]] = {
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

_FLAKE_DEPTH = 0.05  # of the flakes, times S of the pigment
_TITANIUM = Edge(404.0, -5.0, 4.0)  # rutile absorbs in the ultraviolet
_ADJECTIVES = ("Arctic", "Alpine", "Baltic", "Desert", "Harbour", "Imperial", "Lunar", "Monsoon", "Nordic",
               "Polar", "Solar", "Tundra")  # fmt: skip
_NAME = re.compile(r"pigment:([a-z_]{1,20}):([0-9]{1,9})(:flakes)?")


@dataclass(frozen=True)
class Pigments:
    """What is in a base coat.

    Attributes
    ----------
    absorption
        K/S at every wavelength.
    absorbers
        What they add at some.
    interference
        Optical thickness of the mica flakes' film [nm] and depth of its modulation, 0 to 1; None without.
    """

    absorption: float
    absorbers: tuple[Feature, ...] = ()
    interference: tuple[float, float] | None = None

    def albedo(self, wavelength: Floats) -> Floats:
        """Return the albedo of the base under the coat at ``wavelength`` [nm], 0 to 1."""
        # without an interface, Paint is the bare Kubelka-Munk layer
        return Paint(self.absorption, self.absorbers, interface=0.0, internal=0.0)(wavelength)

    def flakes(self, wavelength: Floats) -> Floats:
        """Return the reflectance of the flakes, seen through the tinted binder, 0 to 1.

        Light passes the tint twice, down to a flake and back, each time a twentieth of the depth in which the
        pigment would scatter it (S d = 0.05). A film on mica adds a comb cos^2(2 pi d / lambda).
        """
        tint = np.full_like(wavelength, self.absorption, dtype=np.float64)
        for absorber in self.absorbers:
            tint += absorber(wavelength)
        bare = aluminium(wavelength)
        if self.interference is not None:
            thickness, depth = self.interference
            bare = bare * (1.0 - depth * np.cos(2.0 * np.pi * thickness / wavelength) ** 2)
        return np.asarray(bare * np.exp(-2.0 * _FLAKE_DEPTH * tint))


def aluminium(wavelength: Floats) -> Floats:
    """Return the reflectance of aluminium in a binder, with its dip of the interband transition at 825 nm.

    A smooth curve through handbook values of the bare metal, about 0.92 in the green and 0.87 at 825 nm.
    """
    return 0.92 - 0.01 * (wavelength - 550.0) / 1000.0 + Bump(825.0, 65.0, -0.045)(wavelength)


@dataclass(frozen=True)
class PaintSpec:
    """A car paint: how it looks and what it is made of.

    Attributes
    ----------
    name
        Of its spectrum: a name of the catalogue, or "pigment:<family>:<number>".
    finish
        One of `FINISHES`.
    colour
        In a word.
    trade_name
        Invented.
    coat
        The clear coat.
    flakes
        Flakes in the base; None in a solid paint.
    """

    name: str
    finish: str
    colour: str
    trade_name: str
    coat: Coat = Coat()  # noqa: RUF009  (frozen)
    flakes: Flakes | None = None

    def reflectance(self, wavelength: Floats) -> Floats:
        """Return the near-normal reflectance, specular component excluded, at ``wavelength`` [nm].

        That of the pigment alone: in a metallic or pearl paint it counts with the part of the light that
        meets no flakes, and flakes add a lobe of their own, most of it near the mirror direction.
        """
        return spectrum_of(self.name)(wavelength)

    def material(self, name: str = "") -> Material:
        """Return the surface of this paint, called ``name`` (by default, as its spectrum)."""
        return Material(name or self.name, self.name, "paint", self.coat, self.flakes)


def _solid(name: str, colour: str, trade_name: str) -> PaintSpec:
    return PaintSpec(name, "solid", colour, trade_name)


def _metallic(name: str, colour: str, trade_name: str, share: float) -> PaintSpec:
    return PaintSpec(name, "metallic", colour, trade_name, flakes=Flakes(share))


_CATALOGUE = {
    spec.name: spec
    for spec in (
        _solid("white", "white", "Polar White"),
        _metallic("silver", "silver", "Lunar Silver", 0.5),
        _metallic("grey", "grey", "Harbour Grey", 0.3),
        _solid("black", "black", "Carbon Black"),
        _solid("ir_black", "black", "Night Glass Black"),
        _solid("red", "red", "Signal Red"),
        _solid("dark_red", "dark red", "Garnet Red"),
        _metallic("blue", "blue", "Baltic Blue", 0.15),
        _solid("light_blue", "light blue", "Alpine Blue"),
        _metallic("green", "green", "Tundra Green", 0.15),
        _solid("yellow", "yellow", "Solar Yellow"),
        _solid("orange", "orange", "Desert Orange"),
        _solid("beige", "beige", "Dune Beige"),
        _metallic("brown", "brown", "Umber Brown", 0.2),
    )
}

FOURTEEN = tuple(_CATALOGUE)
"""Names of fourteen plausible car paints, those of the paper's figure of one car park under three skies."""


def paint_spec(name: str) -> PaintSpec:
    """Return what is known of a paint by the name of its spectrum.

    Parameters
    ----------
    name
        One of `FOURTEEN`, or "pigment:<family>:<number>" with one of `FAMILIES`.

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
    parsed = parse_name(name)
    if parsed is None or parsed[2]:
        raise SchemaError(
            f"there is no paint {name!r}; expected one of {', '.join(FOURTEEN)}, or pigment:<family>:<number>"
        )
    return generate_paint(parsed[0], parsed[1])


def generate_paint(family: str, number: int) -> PaintSpec:
    """Return one paint of a family: the same number always gives the same paint.

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
    return _generate(family, number)[0]


def pigments_of(family: str, number: int) -> Pigments:
    """Return what is in a generated paint."""
    return _generate(family, number)[1]


def parse_name(name: str) -> tuple[str, int, bool] | None:
    """Return family, number and whether the flakes are meant, of the name of a generated spectrum."""
    match = _NAME.fullmatch(name)
    if match is None or match[1] not in FAMILIES:
        return None
    return match[1], int(match[2]), match[3] is not None


@functools.lru_cache(maxsize=4096)
def _generate(family: str, number: int) -> tuple[PaintSpec, Pigments]:
    if family not in FAMILIES:
        raise SchemaError(f"there is no family of paints {family!r}; expected one of {', '.join(FAMILIES)}")
    if not 0 <= number < 10**9:
        raise SchemaError(f"the number of a paint is {number!r}, expected 0 to 999999999")
    rng = np.random.default_rng([FAMILIES.index(family), number])
    hue = str(rng.choice(list(_HUES)))
    adjective = str(rng.choice(_ADJECTIVES))
    roughness = float(rng.uniform(0.02, 0.08))
    pigments, colour = _mix(family, hue, rng)
    finish, flakes = "solid", None
    name = f"pigment:{family}:{number}"
    if family in ("metallic", "pearl"):
        finish = family
        low, high = (0.3, 0.7) if family == "metallic" else (0.15, 0.4)
        lobe = rng.uniform(0.25, 0.45)
        flakes = Flakes(float(rng.uniform(low, high)), float(lobe), f"{name}:flakes")
    trade_name = f"{adjective} {colour.title()}"
    return PaintSpec(name, finish, colour, trade_name, Coat(roughness=roughness), flakes), pigments


def _mix(family: str, hue: str, rng: np.random.Generator) -> tuple[Pigments, str]:
    """Return the base of one paint, and its colour in words."""
    if family == "white":
        return Pigments(rng.uniform(0.002, 0.012), (_TITANIUM,)), "white"
    if family == "grey":
        return Pigments(rng.uniform(0.15, 1.5), (_TITANIUM,)), "grey"
    if family == "carbon_black":
        return Pigments(rng.uniform(8.0, 20.0), (Edge(800.0, 90.0, -rng.uniform(0.0, 3.0)),)), "black"
    if family == "ir_black":
        edge = Edge(rng.uniform(700.0, 770.0), -rng.uniform(12.0, 22.0), rng.uniform(9.0, 15.0))
        return Pigments(rng.uniform(0.08, 0.4), (edge,)), "black"
    strength = np.exp(rng.uniform(np.log(0.6), np.log(1.6)))
    colour = hue
    if family == "tinted":
        strength *= np.exp(rng.uniform(np.log(0.03), np.log(0.2)))
        colour = f"light {hue}"
    floor = float(np.exp(rng.uniform(np.log(0.02), np.log(0.2))))
    absorbers = _absorbers(_HUES[hue], float(strength), rng)
    if family == "tinted":
        return Pigments(0.2 * floor, (*absorbers, _TITANIUM)), colour
    if family == "pearl":
        film = (float(rng.uniform(180.0, 420.0)), float(rng.uniform(0.2, 0.5)))
        return Pigments(floor, absorbers, film), colour
    return Pigments(floor, absorbers), colour


def _absorbers(
    rows: Sequence[tuple[str, float, float, float, float]], strength: float, rng: np.random.Generator
) -> tuple[Feature, ...]:
    features: list[Feature] = []
    for kind, centre, spread, width, height in rows:
        feature = Edge if kind == "edge" else Bump
        at = centre + rng.normal(0.0, spread / 2.0)
        features.append(feature(at, width * rng.uniform(0.8, 1.3), strength * height * rng.uniform(0.8, 1.2)))
    return tuple(features)


Spectrum = Callable[[Floats], Floats]
"""Reflectance factor, 0 to 1, by wavelength [nm]."""


def _without_mirror(paint: Paint) -> Spectrum:
    return lambda wavelength: paint(wavelength) - paint.interface


_MORE_PAINTS = {
    "beige": Paint(0.09, [Edge(500.0, -45.0, 0.45), Edge(405.0, -6.0, 2.0)]),
    "brown": Paint(0.30, [Edge(570.0, -50.0, 3.0)]),
}

_RED_LENS = Plain(0.03, 0.0, [Edge(606.0, 7.0, 0.35)])
_REFLECTOR = Plain(0.30, 0.05)  # behind a clear lens

SPECTRA: dict[str, Spectrum] = {
    **MATERIALS,
    **{name: _without_mirror(paint) for name, paint in {**CAR_PAINTS, **_MORE_PAINTS}.items()},
    "glass": Plain(0.012),
    "aluminium": aluminium,
    "leaf": Plain(0.045, 0.01, [Bump(552.0, 28.0, 0.08), Edge(716.0, 12.0, 0.42), Bump(968.0, 22.0, -0.03)]),
    "brick": Plain(0.13, 0.10, [Edge(585.0, 22.0, 0.16), Bump(870.0, 60.0, -0.015)]),
    "lamp_red": _RED_LENS,
    "tail_lamp": _RED_LENS,
    "lamp_clear": _REFLECTOR,
    "lamp": _REFLECTOR,
    "rim": Plain(0.42, 0.03, [Bump(825.0, 65.0, -0.015)]),
    "plate": Plain(0.55, 0.02, [Edge(415.0, 8.0, 0.15)]),
    "trim": Plain(0.045, 0.005),
    "bark": Plain(0.11, 0.22, [Edge(600.0, 60.0, 0.04)]),
    "steel": Plain(0.36, 0.06),
    "patch": Plain(0.055, 0.05),
}
"""The named spectra; generated paints are reached by `spectrum_of` alone."""


def spectrum_of(name: str) -> Spectrum:
    """Return a reflectance spectrum by name.

    Parameters
    ----------
    name
        A key of `SPECTRA`; or of a generated paint, "pigment:<family>:<number>", with ":flakes" behind it for
        those of its flakes.

    Returns
    -------
    callable
        Takes wavelengths of any shape [nm], gives the reflectance factor, same shape, float64, 0 to 1.

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
    hyperpaint.base.errors.SchemaError: there is no spectrum 'panel_21'; did you mean 'panel_20'?
    """
    generated = parse_name(name)
    if generated is not None:
        family, number, flakes = generated
        pigments = pigments_of(family, number)
        if flakes:
            return _limited(pigments.flakes)
        # near normal, under the usual clear coat, mirror reflection excluded
        return _limited(lambda wavelength: coated_reflectance(pigments.albedo(wavelength), Coat().index))
    if name in SPECTRA:
        return _limited(SPECTRA[name])
    close = difflib.get_close_matches(name, SPECTRA, 1)
    hint = f"did you mean {close[0]!r}?" if close else f"there are {', '.join(SPECTRA)}"
    raise SchemaError(f"there is no spectrum {name!r}; {hint}")


def _limited(spectrum: Spectrum) -> Spectrum:
    """Return ``spectrum`` for any wavelength: straight lines leave 0 to 1 far from where they were drawn."""

    def limited(wavelength: Floats) -> Floats:
        grid = np.asarray(wavelength, dtype=np.float64)
        return np.clip(spectrum(grid), 0.0, 1.0)

    return limited
