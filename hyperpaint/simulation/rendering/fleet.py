"""A fleet of cars with realistic shares of colours, finishes, age and dust.

Of a hundred cars, 39 are white, 23 black, 16 grey, 8 silver, 14 coloured. Paint manufacturers publish shares
of new cars: BASF's Color Report has white 39, grey 16, silver 8 in 2022 and white 36, black 21, grey 15,
silver 9 in 2023, and 19 coloured in both years, of which 8 blue; Axalta's of 2017 has 26 solid and 13 pearl
among 39 white [1]_ [2]_. Other finishes are not published by colour: here nearly all grey and silver cars are
metallic, and six in ten of all cars have flakes or mica.

Consecutive numbers are distributed evenly over the shares (R2 sequence), so that small car parks have them
too.

References
----------
.. [1] BASF, "Color Report for Automotive OEM Coatings", 2022 and 2023.
.. [2] Axalta, "Global Automotive Color Popularity Report", 2017.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hyperpaint.base.arrays import Floats

from .base_coats import HUES, Pigments, absorbers_of, mix
from .weathering import Octaves, dusty

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

#: Minimum and maximum flop index of a paint with flakes, as far as pigment and share allow it.
FLOPS = (5.0, 16.0)

_MEAN_AGE_YEARS = 9.0
# dust cover: median, standard deviation of the logarithm, maximum
_COVER, _COVER_LOG_SD, _MAX_COVER = 0.015, 0.7, 0.30
_DIRTY_SHARE, _DIRT = 0.08, 0.10  # share of dirty cars, and their additional dust cover
_MEMBERS = 64

#: Spatial variation of dust on a car.
DIRT = Octaves((0.6, 0.20, 0.06, 0.02), (0.4, 0.25, 0.2, 0.15))

#: Steps of the sequence: powers of the inverse of the plastic number (M. Roberts 2018).
_R2 = (0.7548776662466927, 0.5698402909980532)


@dataclass(frozen=True)
class FleetPaint:
    """The paint of a car of the fleet.

    Attributes
    ----------
    colour, finish
        Colour and finish in words; the finish is "solid", "metallic" or "pearl".
    pigments
        Pigments of the base coat.
    flake_share, flop
        Share of the light in the paint that meets flakes, and the flop index, see
        `hyperpaint.simulation.rendering.appearance.flop_index`; 0 for a solid paint.
    age
        Age of the car [years].
    cover
        Share of the car covered by dust [1].
    index
        Refractive index of its clear coat.
    """

    colour: str
    finish: str
    pigments: Pigments
    flake_share: float
    flop: float
    age: float
    cover: float
    index: float

    def weathered(self, clean_reflectance: Floats, wavelength: Floats) -> Floats:
        # reflectance of a clean base (wavelength,) under dust, for many positions on the car
        normal = np.random.default_rng([41, int(1e9 * self.cover)]).standard_normal((_MEMBERS, 1))
        return dusty(
            clean_reflectance, np.minimum(self.cover * np.exp(0.45 * normal - 0.10), 0.6), wavelength
        )


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
    positions = [(0.5 + (number + 1) * step) % 1.0 for step in _R2]
    group = _choose(COLOUR_SHARES, positions[0])
    finish = _choose(FINISH_SHARES[group], positions[1])
    colour, pigments = _pigments(group, finish, rng)
    min_share, max_share = FLAKE_SHARES[group]
    share, flop = float(rng.uniform(min_share, max_share)), float(rng.uniform(*FLOPS))
    age = float(min(rng.gamma(2.0, _MEAN_AGE_YEARS / 2.0), 30.0))
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


def _pigments(group: str, finish: str, rng: np.random.Generator) -> tuple[str, Pigments]:
    film = (float(rng.uniform(180.0, 420.0)), float(rng.uniform(0.1, 0.4))) if finish == "pearl" else None
    if group == "coloured":
        hue = _choose(HUE_SHARES, rng.random())
        strength, floor = np.exp(rng.uniform(np.log(0.6), np.log(1.6))), np.exp(rng.uniform(-3.5, -1.2))
        return hue, Pigments(float(floor), absorbers_of(HUES[hue], float(strength), rng), film)
    if group == "black":
        family = "ir_black" if finish == "solid" and rng.random() < 0.2 else "carbon_black"
    else:
        family = "white" if group == "white" else "grey"
    base, _ = mix(family, "blue", rng)
    # greys are mixed with carbon, from light grey to anthracite; silver consists mostly of flakes
    ranges = {"grey": (0.3, 4.0), "silver": (0.08, 0.3)}
    absorption = float(np.exp(rng.uniform(*np.log(ranges[group])))) if group in ranges else base.absorption
    return group, Pigments(absorption, base.absorbers, film)
