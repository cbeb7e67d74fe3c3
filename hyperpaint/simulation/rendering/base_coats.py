"""The base coat of a car paint: pigments in a binder, with or without flakes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.simulation.paint_spectra import Bump, Edge, Feature, Paint

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


@dataclass(frozen=True)
class Pigments:
    """Contents of a base coat.

    Attributes
    ----------
    absorption
        K/S that is constant over wavelength.
    absorbers
        Edges and bands added to K/S.
    interference
        Optical thickness of the film on mica flakes [nm] and depth of its modulation, 0 to 1; None without
        mica.
    """

    absorption: float
    absorbers: tuple[Feature, ...] = ()
    interference: tuple[float, float] | None = None

    def albedo(self, wavelength: Floats) -> Floats:
        # albedo of the base under the coat at ``wavelength`` [nm], 0 to 1: Paint without interface is the
        # bare layer
        return Paint(self.absorption, self.absorbers, interface=0.0, internal=0.0)(wavelength)

    def flakes(self, wavelength: Floats, *, turned: bool = False) -> Floats:
        """Return the reflectance of the flakes through the tinted binder, 0 to 1.

        Light passes the tint twice, to a flake and back, with S d = 0.05. A film on mica adds the modulation
        cos^2(2 pi d cos(theta) / lambda), with the angle theta in the film: 0, or with ``turned`` that of
        light which meets the flake at 45 degrees.
        """
        tint = np.full_like(wavelength, self.absorption, dtype=np.float64)
        for absorber in self.absorbers:
            tint += absorber(wavelength)
        metal = aluminium(wavelength)
        if self.interference is not None:
            thickness, depth = self.interference
            thickness *= _TURNED_COSINE if turned else 1.0
            metal = metal * (1.0 - depth * np.cos(2.0 * np.pi * thickness / wavelength) ** 2)
        return np.asarray(metal * np.exp(-2.0 * _FLAKE_DEPTH * tint))


def aluminium(wavelength: Floats) -> Floats:
    """Return the reflectance of aluminium in a binder, with the dip of its interband transition at 825 nm.

    A smooth fit to handbook values of the bare metal, about 0.92 in the green and 0.87 at 825 nm.
    """
    return 0.92 - 0.01 * (wavelength - 550.0) / 1000.0 + Bump(825.0, 65.0, -0.045)(wavelength)


def mix(family: str, hue: str, rng: np.random.Generator) -> tuple[Pigments, str]:
    """Return the base coat of a random paint of a family of `FAMILIES`, and its colour in words."""
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
    absorbers = absorbers_of(HUES[hue], float(strength), rng)
    if family == "tinted":
        return Pigments(0.2 * floor, (*absorbers, _TITANIUM)), colour
    if family == "pearl":
        film = (float(rng.uniform(180.0, 420.0)), float(rng.uniform(0.2, 0.5)))
        return Pigments(floor, absorbers, film), colour
    return Pigments(floor, absorbers), colour


def absorbers_of(
    rows: Sequence[tuple[str, float, float, float, float]], strength: float, rng: np.random.Generator
) -> tuple[Feature, ...]:
    """Return absorption edges and bands of K/S drawn around the ``rows`` of `HUES`."""
    return tuple(
        (Edge if kind == "edge" else Bump)(
            centre + rng.normal(0.0, centre_range / 2.0),
            width * rng.uniform(0.8, 1.3),
            strength * height * rng.uniform(0.8, 1.2),
        )
        for kind, centre, centre_range, width, height in rows
    )
