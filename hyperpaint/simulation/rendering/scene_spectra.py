"""Named reflectance spectra of a scene: near normal, without the mirror reflection.

The renderer computes the first reflection of the clear coat over car paints, so that spectra exclude it:
Saunderson's k1 is subtracted from the paints of `hyperpaint.simulation.paint_spectra`. Spectra of surfaces
without a coat include all reflected light. The spectrum of glass is that of the surface behind it.

*Car paints* are computed from a few parameters: pigments in a binder, with or without flakes, under a clear
coat. The base is opaque. Its albedo follows from absorption over scattering of its pigments, R_inf = 1 + K/S
- sqrt((K/S)^2 + 2 K/S) (Kubelka & Munk 1931), and K/S from absorption edges and bands; its reflectance
through the clear coat, near normal and without the mirror reflection, is `materials.coated_reflectance`.
Families differ in absorption and mixture; a number always gives the same paint of a family. "fleet-<number>"
is a car of a real fleet, with age and dust. Weathered surfaces ("worn_asphalt") are populations, see
`weathering`.
"""

from __future__ import annotations

import difflib
import functools
import re
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.facts import one_of
from hyperpaint.simulation.paint_spectra import CAR_PAINTS, MATERIALS, Bump, Edge, Paint, PlainSurface

from .appearance import flakes_of_flop
from .base_coats import FAMILIES, HUES, Pigments, aluminium, mix
from .fleet import DIRT, FleetPaint, fleet_paint
from .materials import Coat, Flakes, Material, coated_reflectance
from .weathering import WEATHERED, Weathered, leaf_transmittance

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
_NAME = re.compile(r"pigment:([a-z_]{1,20}):([0-9]{1,9})(:flakes)?")
_FLEET = re.compile(r"fleet-([0-9]{1,9})(:flakes)?")
_TURNED_SUFFIX = ":turned"  # after the name of the spectrum of flakes
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
    """

    name: str
    finish: str
    colour: str
    trade_name: str
    coat: Coat = Coat()  # noqa: RUF009  (frozen)
    flakes: Flakes | None = None

    def reflectance(self, wavelength: Floats) -> Floats:
        """Return the near-normal reflectance, specular component excluded, at ``wavelength`` [nm].

        Reflectance of the pigment only: in a metallic or pearl paint it applies to the light that does not
        meet flakes; flakes add another lobe, mostly near the mirror direction.
        """
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
    fleet = _FLEET.fullmatch(name)
    if fleet is not None and fleet[2] is None:
        return _fleet_spec(int(fleet[1]))
    parsed = parse_name(name)
    if parsed is None or parsed[2]:
        raise SchemaError(
            f"there is no paint {name!r}",
            expected=f"one of {', '.join(FOURTEEN)}, pigment:<family>:<number> or fleet-<number>",
            code="paint-unknown",
        )
    return generate_paint(parsed[0], parsed[1])


def is_paint(name: str) -> bool:
    is_known = name in _CATALOGUE or parse_name(name) is not None or _FLEET.fullmatch(name) is not None
    return is_known and not name.endswith(":flakes")


def fleet_names(first: int, count: int) -> tuple[str, ...]:
    """Return the names of ``count`` cars of the fleet.

    Examples
    --------
    >>> fleet_names(7, 2)
    ('fleet-7', 'fleet-8')
    """
    return tuple(f"fleet-{number}" for number in range(first, first + count))


def _fleet_spec(number: int) -> PaintSpec:
    # paint of a car of the fleet; coats of older cars are rougher
    car, name = fleet_paint(number), f"fleet-{number}"
    flakes = (
        _with_flop(_create_flakes(name, car.finish, car.flake_share), car.flop, car.pigments)
        if car.flake_share
        else None
    )
    coat = Coat()
    coat = replace(coat, index=car.index, roughness=coat.roughness * (1.0 + _ROUGHENING * car.age))
    adjective = _ADJECTIVES[number % len(_ADJECTIVES)]
    return PaintSpec(name, car.finish, car.colour, f"{adjective} {car.colour.title()}", coat, flakes)


def _fleet_base(car: FleetPaint) -> Weathered:
    def members(wavelength: Floats) -> Floats:
        return car.weathered(coated_reflectance(car.pigments.albedo(wavelength), car.index), wavelength)

    return Weathered(members, DIRT)


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
    return _generate(family, number)[0]


def pigments_of(family: str, number: int) -> Pigments:
    return _generate(family, number)[1]


def parse_name(name: str) -> tuple[str, int, bool] | None:
    # family, number, and whether the name is that of flakes, of a generated spectrum; None for other names
    match = _NAME.fullmatch(name)
    if match is None or match[1] not in FAMILIES:
        return None
    return match[1], int(match[2]), match[3] is not None


@functools.lru_cache(maxsize=4096)
def _generate(family: str, number: int) -> tuple[PaintSpec, Pigments]:
    one_of(family, FAMILIES, "family")
    if not 0 <= number < 10**9:
        raise SchemaError(
            f"the number of a paint is {number!r}", expected="0 to 999999999", code="value-out-of-range"
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
        flakes = _with_flop(
            _create_flakes(name, finish, float(rng.uniform(min_share, max_share))), flop, pigments
        )
    return PaintSpec(
        name, finish, colour, f"{adjective} {colour.title()}", Coat(roughness=roughness), flakes
    ), pigments


def _create_flakes(name: str, finish: str, share: float) -> Flakes:
    spectrum = f"{name}:flakes"
    return Flakes(share, spectrum=spectrum, turned=spectrum + _TURNED_SUFFIX if finish == "pearl" else "")


def _with_flop(flakes: Flakes, flop: float, pigments: Pigments) -> Flakes:
    # flakes with the lobe that gives a paint this flop index, or the nearest possible one
    grid = np.linspace(380.0, 780.0, 41)
    paint = Material("paint", "body", "paint", Coat(), flakes)
    body = coated_reflectance(pigments.albedo(grid), Coat().index)
    return flakes_of_flop(flop, paint, grid, body, pigments.flakes(grid), nearest=True)


#: Reflectance factor, 0 to 1, by wavelength [nm].
Spectrum = Callable[[Floats], Floats]


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
    is_turned = name.endswith(":flakes" + _TURNED_SUFFIX)
    name = name.removesuffix(_TURNED_SUFFIX) if is_turned else name
    generated = parse_name(name)
    if generated is not None:
        family, number, flakes = generated
        pigments = pigments_of(family, number)
        if flakes:
            return _limited(functools.partial(pigments.flakes, turned=is_turned))
        # near normal, under the default clear coat, without the mirror reflection
        return _limited(lambda wavelength: coated_reflectance(pigments.albedo(wavelength), Coat().index))
    fleet = _FLEET.fullmatch(name)
    if fleet is not None:
        car = fleet_paint(int(fleet[1]))
        metal = functools.partial(car.pigments.flakes, turned=is_turned)
        return _limited(metal) if fleet[2] else _fleet_base(car)
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
    def limited(wavelength: Floats) -> Floats:
        return np.clip(spectrum(np.asarray(wavelength, dtype=np.float64)), 0.0, 1.0)

    return limited
