"""The starter library: forty synthetic car paints from a few parameters each.

``starter_paints.json`` has a row for every paint: absorption over scattering K/S of its pigments, a constant
plus edges and bumps (kind, centre [nm], width [nm], height), the roughness of its coat, and the share of the
light that meets flakes; ``interference`` is the optical thickness [nm] of the film on mica flakes and the
depth of its modulation. The paints are the catalogue of the simulator, and paints of its families.
"""

from __future__ import annotations

import functools
import json
from importlib import resources
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.facts import takes_quantities
from hyperpaint.base.schema import BAND, LIBRARY_VARIABLES, SIGNATURE, Array, Floats, Floats32
from hyperpaint.light.daylight_colours import srgb_hex

from .colours import paint_colours
from .mixing.synthetic_paints import (
    SPECULAR,
    Interface,
    absorption_to_scattering,
    synthetic_library,
    text_column,
    thick_layer_reflectance,
)

#: First and last wavelength [nm], and number of bands of a pushbroom camera for the visible and near
#: infrared.
FIRST_NM, LAST_NM, BANDS = 400.0, 1000.0, 272

MAX_MEMBERS = 10_000

#: Transmittance of a coat in both directions near normal, over that of diffuse light, and its reflectance for
#: diffuse light from inside: for the paints of the catalogue, and exactly for an index of 1.5.
_CATALOGUE_COAT, _FAMILY_COAT = (0.384, 0.6), (0.4096, 0.5963457597077115)

#: Optical depth of the tinted binder above a flake, over K/S [1].
_FLAKE_DEPTH = 0.05

#: Mirror reflection of a coat of index 1.5 near normal [1].
_MIRROR = 0.2**2

#: Standard deviations of the members: amount of pigment (relative), wavelengths of its absorption [nm], and
#: light on a pixel (relative).
_PIGMENT_SD, _WAVELENGTH_SD_NM, _LIGHT_SD = 0.08, 0.8, 0.02


@takes_quantities(wavelength="nm")
def starter_library(
    *, members: int = 24, seed: int = 0, wavelength: npt.ArrayLike | None = None
) -> xr.Dataset:
    r"""Return a library of forty synthetic car paints.

    Parameters
    ----------
    members
        Variants of each paint; 0 for none.
    seed
        Seed of the variants. The paints themselves are always the same.
    wavelength
        Wavelengths of the bands, ascending, 300 to 2500 nm; by default 272 bands from 400 to 1000 nm.

    Returns
    -------
    Dataset
        A paint library: ``reflectance`` (signature, band) of the body of the paint, float32 [1], without
        mirrored light (attribute ``mirror_reflection`` "excluded"); ``specular_reflectance`` (signature,
        band) of clear coat and flakes around the mirror direction; ``member_reflectance`` (signature,
        member, band) with ``reflectance_sd`` and ``reflectance_quantiles``. Coordinates of the paints:
        ``finish``, ``colour`` in words, ``srgb`` of the body in daylight, ``family``, ``roughness`` of the
        coat [1], ``provenance`` ("synthetic"), ``parents`` (the spectrum's name in the simulator) and
        ``method``.

    Raises
    ------
    SchemaError
        ``members`` or ``wavelength`` is out of range; all are listed.

    Notes
    -----
    The spectra are synthetic and the names invented: no paint is the colour of a manufacturer. K/S of a paint
    consists of a few edges and absorption bands (see `hyperpaint.simulation`); its reflectance follows as
    that of Kubelka and Munk's thick layer under a coat of index 1.5. In metallic and pearl paints a share of
    the light meets flakes; their reflectance around the mirror direction belongs to the specular part, so
    that the body has their dark "flop" colour. Members differ in the amount of pigment, in the wavelengths of
    its absorption, and in light: standard deviations 8 %, 0.8 nm and 2 %.

    Examples
    --------
    >>> paints = starter_library(members=5)
    >>> paints.member_reflectance.shape, paints.provenance.values[0]
    ((40, 5, 272), 'synthetic')
    """
    nm = np.linspace(FIRST_NM, LAST_NM, BANDS) if wavelength is None else np.asarray(wavelength, np.float64)
    problems = Problems("the starter library cannot be computed", SchemaError)
    problems.add_if(
        not 0 <= members <= MAX_MEMBERS,
        f"members={members!r}",
        expected=f"0 to {MAX_MEMBERS}",
        code="value-out-of-range",
    )
    if nm.ndim != 1 or not nm.size or not ((nm >= 300.0) & (nm <= 2500.0)).all():
        problems.add(
            f"wavelength={wavelength!r:.40}",
            expected="one number a band, from 300 to 2500 nm",
            code="value-out-of-range",
        )
    elif not (np.diff(nm) > 0.0).all():
        problems.add("wavelength= does not ascend", mend="sort it", code="order-wrong")
    problems.raise_if_any()
    specs = _specs()
    values: dict[str, Array] = {
        # reflectance of the body between the flakes, without mirrored light
        "reflectance": np.stack([_reflectance(spec, nm) * (1.0 - spec["flakes"]) for spec in specs]),
        SPECULAR: np.stack([_specular(spec, nm) for spec in specs]),
    }
    if members:
        values["member_reflectance"] = np.stack(
            [_variants(spec, nm, members, [seed, number]) for number, spec in enumerate(specs)]
        )
    bands = xr.Dataset(
        {"reflectance": ((BAND,), np.zeros(nm.size), {"mirror_reflection": "excluded"})},
        {"wavelength": (BAND, nm, LIBRARY_VARIABLES["wavelength"].attrs)},
        {"title": "parameters of pigments, hyperpaint.simulation"},
    )
    names = [f"Synthetic {spec['trade_name']}" for spec in specs]
    parents = [{str(spec["spectrum"]): 1.0} for spec in specs]
    paints = synthetic_library(bands, names, values, parents, "Kubelka-Munk from parametric K/S", seed=seed)
    paints.attrs["title"] = "Starter library: synthetic car paints, none of them measured"
    swatches = [srgb_hex(colour) for colour in paint_colours(paints)]
    texts = {
        name: (SIGNATURE, text_column(swatches if name == "srgb" else [spec[name] for spec in specs]), attrs)
        for name, attrs in (
            ("finish", {"long_name": "Finish"}),
            ("colour", {"long_name": "Colour in words"}),
            ("srgb", {"long_name": "sRGB of the body in daylight"}),
            ("family", {"long_name": "Family of pigments"}),
        )
    }
    roughness = np.array([spec["roughness"] for spec in specs])
    attrs = {"long_name": "GGX alpha of the clear coat", "units": "1"}
    return paints.assign_coords({**texts, "roughness": (SIGNATURE, roughness, attrs)})


@functools.cache
def _specs() -> list[dict[str, Any]]:
    specs: list[dict[str, Any]] = json.loads(
        resources.files(__package__).joinpath("starter_paints.json").read_text(encoding="utf-8")
    )
    return specs


def _absorption(spec: dict[str, Any], nm: Floats) -> Floats:
    # K/S (band,) [1]
    ratio = np.full(nm.size, spec["absorption"])
    for kind, centre, width, height in spec["absorbers"]:
        ratio += height * (
            0.5 * (1.0 + np.tanh((nm - centre) / (2 * width)))
            if kind == "edge"
            else np.exp(-0.5 * ((nm - centre) / width) ** 2)
        )
    return ratio


def _reflectance(spec: dict[str, Any], nm: Floats) -> Floats:
    # Reflectance of the body between the flakes, without mirrored light (band,) [1]
    base = thick_layer_reflectance(_absorption(spec, nm))
    through, inside = _CATALOGUE_COAT if spec["family"] == "catalogue" else _FAMILY_COAT
    return np.clip(through * base / (1.0 - inside * base), 0.0, 1.0)


def _specular(spec: dict[str, Any], nm: Floats) -> Floats:
    # Reflectance of coat and flakes around the mirror direction (band,) [1]: aluminium with the dip of its
    # interband transition, in paints of the families seen through the tinted binder
    metal = 0.92 - 0.01 * (nm - 550.0) / 1000.0 - 0.045 * np.exp(-0.5 * ((nm - 825.0) / 65.0) ** 2)
    if spec["interference"] is not None:
        thickness, depth = spec["interference"]
        metal = metal * (1.0 - depth * np.cos(2.0 * np.pi * thickness / nm) ** 2)
    if spec["family"] != "catalogue":
        metal = metal * np.exp(-2.0 * _FLAKE_DEPTH * _absorption(spec, nm))
    return np.asarray(_MIRROR + (1.0 - _MIRROR) ** 2 * spec["flakes"] * np.clip(metal, 0.0, 1.0))


def _variants(spec: dict[str, Any], nm: Floats, count: int, seed: list[int]) -> Floats32:
    # Variants of a paint (member, band) with other pigment, wavelengths and light
    interface, draws = Interface(), np.random.default_rng(seed).standard_normal((3, count))
    pigments, shifts, lights = np.exp(_PIGMENT_SD * draws[0]), draws[1], np.exp(_LIGHT_SD * draws[2])
    variants = np.empty((count, nm.size), np.float32)
    for row, pigment, shift, light in zip(
        variants, pigments, _WAVELENGTH_SD_NM * shifts, lights, strict=True
    ):
        layer = np.clip(interface.layer(_reflectance(spec, nm - shift)), 1e-4, 1.0)
        varied_layer = thick_layer_reflectance(pigment * absorption_to_scattering(layer))
        row[:] = np.clip(light * interface.outside(varied_layer) * (1.0 - spec["flakes"]), 0.0, 1.0)
    return variants
