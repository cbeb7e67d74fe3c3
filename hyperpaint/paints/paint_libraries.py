r"""Paint libraries: colours in daylight, search, mixtures, shades, variants, and the starter library.

Mixtures and shades follow Kubelka and Munk's thick layer, and Saunderson's interface above it.
An opaque layer with absorption K and scattering S per depth reflects

.. math:: R_\infty = 1 + q - \sqrt{q^2 + 2 q}, \qquad q = K / S = (1 - R_\infty)^2 / (2 R_\infty)

(Kubelka & Munk, Z. techn. Phys. 12, 593, 1931). An interface above it mirrors k1 of the light from outside
and k2 of the diffuse light from inside, so that light returns to the layer repeatedly. The sum over the
returns, :math:`(1 - k_1) R_\infty (1 - k_2) \sum_j (k_2 R_\infty)^j`, adds to the mirrored light:

.. math:: R = k_1 + \frac{(1 - k_1) (1 - k_2) R_\infty}{1 - k_2 R_\infty}

(Saunderson, J. Opt. Soc. Am. 32, 727, 1942). R rises from k1 to 1 with :math:`R_\infty`; the inverse is
:math:`R_\infty = (R - k_1) / ((1 - k_1) (1 - k_2) + k_2 (R - k_1))`. All quantities are pure numbers.

The starter library has forty synthetic car paints from a few parameters each.

``starter_paints.json`` has a row for every paint: absorption over scattering K/S of its pigments, a constant
plus edges and bumps (kind, centre [nm], width [nm], height), the roughness of its coat, and the share of the
light that meets flakes; ``interference`` is the optical thickness [nm] of the film on mica flakes and the
depth of its modulation. The paints are the catalogue of the simulator, and paints of its families.
"""

import difflib
import fnmatch
import functools
import json
import unicodedata
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base import (
    BAND,
    EXCLUDED,
    LIBRARY_VARIABLES,
    MEMBER,
    QUANTILE,
    SIGNATURE,
    Array,
    Floats,
    Floats32,
    Problems,
    SchemaError,
    convert,
    documented,
    mirror_reflection,
    one_of,
    schema,
    takes_quantities,
    warn_if,
)
from hyperpaint.light.daylight_colours import ciede2000, lab_of, parse_colour, srgb, srgb_hex
from hyperpaint.paints.signatures.pixel_statistics import QUANTILES


@takes_quantities()
def paint_colours(paints: xr.Dataset) -> Floats32:
    """Return the colour of every paint in daylight, (signature, 3), sRGB 0 to 1; NaN without visible bands.

    Bands that are not ``good`` are excluded.

    Examples
    --------
    >>> from hyperpaint.paints import starter_library
    >>> paints = starter_library(members=0)
    >>> red = paint_colours(paints.isel(signature=[5]))[0]
    >>> int(red.argmax()), red.shape
    (0, (3,))
    """
    variables = schema.require(paints, ["reflectance", "wavelength"], "colours", schema.LIBRARY_VARIABLES)
    values = np.where(schema.good_bands(paints), variables["reflectance"].values, np.nan)
    try:
        return np.asarray(srgb(values, variables["wavelength"].values), np.float32)
    except SchemaError:  # fewer than three visible bands
        return np.full((len(values), 3), np.nan, np.float32)


#: Minimum number of common bands of two spectra that are compared.
MIN_BANDS = 5
#: Maximum gap that is interpolated, in steps of the samples beside it.
MAX_GAP_STEPS = 4.0
_UMLAUTS = str.maketrans({"ä": "ae", "ö": "oe", "ü": "ue", "æ": "ae", "œ": "oe", "ø": "oe", "å": "aa"})


@takes_quantities(maximum_angle="rad")
@documented()
def search_library(
    library: xr.Dataset,
    *,
    name: str | None = None,
    colour: str | None = None,
    like: Any = None,
    maximum_colour_difference: float | None = None,
    maximum_angle: float | None = None,
    limit: int | None = None,
) -> xr.Dataset:
    r"""Find paints of a library, the best first.

    Parameters
    ----------
    library
    name
        Part of a paint's name, or a pattern for the full name with ``*``, ``?`` or ``[...]``. Case is
        ignored; "grun" and "gruen" find "Grün".
    colour
        A word such as "dark red", or sRGB as "#701a20". Paints are sorted by their colour difference from it
        in daylight.
    like
        A spectrum: the name of a paint of the library; a library with one paint; one spectrum from a
        spectrometer reader; a DataArray with a coordinate ``wavelength``, in nm where it has no units; or
        numbers, one per band. Paints are sorted by their spectral angle to it.
    maximum_colour_difference
        Largest CIEDE2000 difference from ``colour`` [1]; 1 is just visible, 10 is another shade. Needs
        ``colour``.
    maximum_angle
        Largest spectral angle to ``like`` [rad]. Needs ``like``.
    limit
        Maximum number of paints.

    Returns
    -------
    Dataset
        The paints that meet every condition, which may be none; sorted by the angle to ``like``, else by the
        difference from ``colour``, else in the order of the library. With the coordinates
        ``colour_difference`` [1] and ``spectral_angle`` [rad] (signature).

    Raises
    ------
    SchemaError
        The library lacks variables, an option is out of range, ``like`` is not one spectrum or has fewer than
        five bands in common with the library, or the library has too few visible bands for colours. All of a
        kind are listed.
    UnitsError
        Units cannot be read.

    Notes
    -----
    The spectral angle is

    .. math:: \theta = \arccos \frac{\sum_b x_b y_b}{\sqrt{\sum_b x_b^2 \sum_b y_b^2}}

    over the good bands in which both have a value (Kruse et al., Remote Sens. Environ. 44, 145, 1993); it
    does not depend on brightness. ``like`` is interpolated to the wavelengths of the library within its
    range, except across gaps of more than four of its steps. Colours outside of sRGB are clipped to it, as
    on a screen.

    Examples
    --------
    >>> from hyperpaint.paints import starter_library
    >>> paints = starter_library(members=0)
    >>> search_library(paints, colour="red", limit=2)["signature"].values.tolist()
    ['Synthetic Signal Red', 'Synthetic Lunar Red']
    >>> search_library(paints, name="*white")["signature"].values.tolist()
    ['Synthetic Polar White', 'Synthetic Solar White', 'Synthetic Lunar White']
    """
    with Problems("the library cannot be searched", SchemaError) as problems:
        for key, value, query, query_value in (
            ("maximum_colour_difference", maximum_colour_difference, "colour", colour),
            ("maximum_angle", maximum_angle, "like", like),
        ):
            problems.add_if(
                value is not None and query_value is None, f"{key}= needs {query}=", code="argument-missing"
            )
            problems.add_if(
                value is not None and not value >= 0.0,
                f"{key}={value!r}",
                expected="0 or more",
                code="value-out-of-range",
            )
        problems.add_if(
            limit is not None and limit < 1,
            f"limit={limit!r}",
            expected="1 or more",
            code="value-out-of-range",
        )
        problems.add_if(
            name is not None and not name.strip(),
            "name= is empty",
            expected="part of a name",
            code="empty-input",
        )
    variables = schema.require(
        library, [SIGNATURE, "reflectance", "wavelength"], "a search", LIBRARY_VARIABLES
    )
    is_match = np.ones(library.sizes[SIGNATURE], np.bool_)
    if name is not None:
        is_match &= [_matches_name(str(paint_name), name) for paint_name in variables[SIGNATURE].values]
    order = np.arange(is_match.size)
    coordinates: dict[str, Any] = {}
    if colour is not None:
        # CIEDE2000 of every paint (signature,) [1]; infinite for a paint without colour
        wavelength = np.asarray(library["wavelength"].values, np.float64)
        colours = paint_colours(library.isel({BAND: np.argsort(wavelength, kind="stable")}))
        SchemaError.raise_if(
            len(colours) and not np.isfinite(colours).any(),
            "no paint of the library has a colour",
            expected="at least 3 good bands between 380 and 780 nm",
            code="visible-bands-missing",
        )
        difference = ciede2000(lab_of(colours), lab_of(parse_colour(colour)))
        difference = np.where(np.isfinite(difference), difference, np.inf)
        is_match &= difference <= (np.inf if maximum_colour_difference is None else maximum_colour_difference)
        order = np.argsort(difference, kind="stable")
        attrs = {"long_name": f"CIEDE2000 difference from {colour}", "units": "1"}
        coordinates["colour_difference"] = (SIGNATURE, difference, attrs)
    if like is not None:
        # Spectral angle of every paint to a spectrum (signature,) [rad]; infinite with too few common bands
        nm = np.asarray(variables["wavelength"].values, np.float64)
        spectrum = np.where(schema.good_bands(library), one_spectrum(library, like, nm), np.nan)
        SchemaError.raise_if(
            np.isfinite(spectrum).sum() < MIN_BANDS,
            f"like= has values in {int(np.isfinite(spectrum).sum())} good bands of the library "
            f"({nm.min():g} to {nm.max():g} nm)",
            expected=f"at least {MIN_BANDS}",
            code="bands-not-shared",
        )
        paints = np.asarray(variables["reflectance"].values, np.float64)
        is_common = np.isfinite(paints) & np.isfinite(spectrum)
        x, y = np.where(is_common, paints, 0.0), np.where(is_common, spectrum, 0.0)
        usable = (is_common.sum(axis=1) >= MIN_BANDS) & (
            np.sqrt((x**2).sum(axis=1) * (y**2).sum(axis=1)) > 0.0
        )
        # tan(angle / 2) = |x - y| / |x + y| of unit vectors: precise for small angles, unlike the cosine
        unit_x = x / np.sqrt((x**2).sum(axis=1, keepdims=True)).clip(np.finfo(float).tiny)
        unit_y = y / np.sqrt((y**2).sum(axis=1, keepdims=True)).clip(np.finfo(float).tiny)
        difference, total = (np.sqrt(((unit_x + sign * unit_y) ** 2).sum(axis=1)) for sign in (-1.0, 1.0))
        angle = np.where(usable, 2.0 * np.arctan2(difference, total), np.inf)
        is_match &= angle <= (np.inf if maximum_angle is None else maximum_angle)
        order = np.argsort(angle, kind="stable")
        attrs = {"long_name": "Spectral angle to the spectrum searched for", "units": "rad"}
        coordinates["spectral_angle"] = (SIGNATURE, angle, attrs)
    order = order[is_match[order]][:limit]
    return library.assign_coords(coordinates).isel({SIGNATURE: order})


# --- names -------------------------------------------------------------------------------------------------


def _matches_name(name: str, query: str) -> bool:
    is_pattern = any(sign in query for sign in "*?[")
    plain, transcribed = _spellings(name)
    query_plain, query_transcribed = _spellings(query.strip())
    # with the last pair "gruen" finds a name written with an umlaut
    pairs = ((plain, query_plain), (transcribed, query_transcribed), (transcribed, query_plain))
    return any(fnmatch.fnmatchcase(text, part) if is_pattern else part in text for text, part in pairs)


def _spellings(text: str) -> tuple[str, str]:
    # Text in lower case without accents: umlauts as one letter ("grun"), and transcribed ("gruen")
    folded = unicodedata.normalize("NFC", text).casefold()
    plain, transcribed = (
        "".join(sign for sign in unicodedata.normalize("NFKD", form) if not unicodedata.combining(sign))
        for form in (folded, folded.translate(_UMLAUTS))
    )
    return plain, transcribed


# --- spectra -----------------------------------------------------------------------------------------------


def one_spectrum(library: xr.Dataset, like: Any, nm: Floats) -> Floats:
    # The spectrum `like` at the wavelengths of the library (band,); NaN outside its range
    if isinstance(like, str):
        names = [str(name) for name in library[SIGNATURE].values]
        SchemaError.raise_if(
            names.count(like) != 1,
            f"{names.count(like)} paints of the library are named like={like!r:.60}",
            expected="1",
            code="paint-ambiguous" if like in names else "paint-unknown",
        )
        like = library.isel({SIGNATURE: names.index(like)})
    if isinstance(like, xr.Dataset):
        SchemaError.raise_if(
            "reflectance" not in like.variables,
            f"like= holds {', '.join(map(str, like.data_vars)) or 'nothing'}",
            expected="reflectance",
            code="variable-missing",
        )
        like = like["reflectance"]
    if not isinstance(like, xr.DataArray):
        values = np.asarray(like, np.float64)
        SchemaError.raise_if(
            values.shape != nm.shape,
            f"like= has shape {values.shape}",
            expected=f"({nm.size},), or a DataArray with wavelengths",
            code="length-mismatch",
        )
        return values
    spectrum = like.squeeze()
    SchemaError.raise_if(
        spectrum.ndim != 1 or "wavelength" not in spectrum.coords,
        f"like= has dims {like.dims} of sizes {like.shape}",
        expected="one spectrum with its wavelength",
        code="dims-wrong",
    )
    axis = spectrum["wavelength"]
    # wavelengths without units are in nm
    axis = convert(axis, "nm") if "units" in axis.attrs else axis
    return interpolated(nm, np.asarray(axis.values, np.float64), np.asarray(spectrum.values, np.float64))


def interpolated(nm: Floats, wavelength: Floats, values: Floats) -> Floats:
    # Return a spectrum at the wavelengths ``nm``; NaN outside its range and within its gaps.
    order = np.argsort(wavelength, kind="stable")
    wavelength, values = wavelength[order], values[order]
    is_finite = np.isfinite(wavelength) & np.isfinite(values)
    samples, values = wavelength[is_finite], values[is_finite]
    if samples.size < 2:
        return np.full(nm.size, np.nan)
    interpolated = np.interp(nm, samples, values, left=np.nan, right=np.nan)
    # detectors differ in their steps: a gap is wide compared with the smaller of the two adjacent steps
    median_step = np.median(np.diff(wavelength[np.isfinite(wavelength)]))
    steps = np.diff(samples)
    # steps before the first and after the last sample are infinite
    padded = np.pad(steps, 1, constant_values=np.inf)
    adjacent = np.minimum(padded[:-2], padded[2:])
    adjacent = np.maximum(np.where(np.isfinite(adjacent), adjacent, 0.0), median_step)
    step = np.clip(np.searchsorted(samples, nm, side="left") - 1, 0, steps.size - 1)
    in_gap = (steps > MAX_GAP_STEPS * adjacent)[step] & (nm > samples[step]) & (nm < samples[step + 1])
    return np.where(in_gap, np.nan, interpolated)


# --- a layer of pigments, and the interface above it --------------------------------------------------------


def absorption_to_scattering(reflectance: npt.ArrayLike) -> Floats:
    """Return K/S [1] of a thick layer without an interface from its reflectance, above 0 and up to 1 [1].

    Examples
    --------
    >>> absorption_to_scattering([0.5, 1.0])
    array([0.25, 0.  ])
    """
    layer = np.asarray(reflectance, np.float64)
    return np.asarray((1.0 - layer) ** 2 / (2.0 * layer))


def thick_layer_reflectance(ratio: npt.ArrayLike) -> Floats:
    """Return the reflectance [1] of a thick layer from its K/S [1]; inverse of `absorption_to_scattering`.

    Examples
    --------
    >>> thick_layer_reflectance([0.25, 0.0])
    array([0.5, 1. ])
    """
    q = np.asarray(ratio, np.float64)
    # equal to 1 + q - sqrt(q^2 + 2 q), without cancellation where the layer is dark
    return np.asarray(1.0 / (1.0 + q + np.sqrt(q * (q + 2.0))))


@dataclass(frozen=True)
class Interface:
    """The surface of a paint, which reflects light on both sides.

    Attributes
    ----------
    k1
        Reflectance for light from outside [1]: ((n - 1) / (n + 1))^2 near normal, 0.04 for an index of 1.5.
    k2
        Reflectance for diffuse light from inside [1]: 0.60 for an index of 1.5; less where scattered light is
        no longer diffuse (0.4 to 0.5: Mudgett & Richards, Appl. Opt. 10, 1485, 1971).

    Raises
    ------
    SchemaError
        A value is negative, or 1 and more; all are listed.

    Examples
    --------
    >>> coat = Interface()
    >>> coat.outside([0.5]).round(4), coat.layer(coat.outside([0.5])).round(4)
    (array([0.2743]), array([0.5]))
    """

    k1: float = 0.04
    k2: float = 0.60

    def __post_init__(self) -> None:
        with Problems("the interface of a paint cannot have these values", SchemaError) as problems:
            for name, value in (("k1", self.k1), ("k2", self.k2)):
                problems.add_if(
                    not 0.0 <= value < 1.0,
                    f"{name}={value!r}",
                    expected="a reflectance from 0 to below 1",
                    code="value-out-of-range",
                )

    def outside(self, layer: npt.ArrayLike) -> Floats:
        # Return the reflectance outside the interface of a layer, without mirrored light: 0 to 1 - k1.
        inside = np.asarray(layer, np.float64)
        return np.asarray((1.0 - self.k1) * (1.0 - self.k2) * inside / (1.0 - self.k2 * inside))

    def layer(self, outside: npt.ArrayLike) -> Floats:
        # Return the reflectance of the layer; inverse of `outside`, above 1 for inputs above 1 - k1.
        body = np.asarray(outside, np.float64)
        return np.asarray(body / ((1.0 - self.k1) * (1.0 - self.k2) + self.k2 * body))


#: Minimum reflectance of a layer without an interface [1]: lower values are noise (soot in a binder has
#: 0.02), and their K/S would dominate any mixture.
MIN_LAYER_REFLECTANCE = 1e-3

#: Maximum share of a spectrum that noise may make darker than the mirrored light [1].
MAX_DARK_SHARE = 0.05


@dataclass(frozen=True, eq=False)
class Coating:
    # Interface and mirrored light between a layer of paint and its reflectance in the library.
    interface: Interface  #: Interface above the layer.
    mirrored: Floats  #: (band,) or (): Mirrored light in the reflectance [1].

    def ratio(self, reflectance: npt.ArrayLike, names: list[str]) -> Floats:
        # Return K/S [1] of spectra (signature, ..., band); NaN stays NaN.
        #
        # Raises `SchemaError`: more than 5 % of a paint's spectrum is darker than the light mirrored by the
        # coat; all such paints are listed. Warns of values that are impossible for such a layer; they are
        # replaced by the nearest possible value.
        values = np.asarray(reflectance, np.float64)
        layer = self.interface.layer(values - self.mirrored)
        # values far below 0, where the denominator changes its sign, are too low as well
        low = (layer < MIN_LAYER_REFLECTANCE) | (values < self.mirrored)
        high = ~low & (layer > 1.0)
        with Problems("the library's reflectance is lower than its mirrored light", SchemaError) as problems:
            for name, is_dark, has_value in zip(
                names, values < self.mirrored, np.isfinite(values), strict=True
            ):
                share = float(is_dark.sum() / max(int(has_value.sum()), 1))
                problems.add_if(
                    self.mirrored.any() and share > MAX_DARK_SHARE,
                    f"{share:.0%} of {name!r} is darker than {float(self.mirrored.max()):g}",
                    mend="pass as mirrored= the mirrored light in its reflectance (0 for none; outdoors "
                    "k1 times the diffuse fraction), or call remove_mirrored_sky first",
                    code="paint-too-dark",
                )
        warn_if(
            low.any() or high.any(),
            f"{int(low.sum())} of {int(np.isfinite(values).sum())} reflectances are darker than any paint "
            f"layer under an interface with k1 = {self.interface.k1:g}, {int(high.sum())} brighter; they "
            f"were replaced by the nearest possible values, of R_inf = {MIN_LAYER_REFLECTANCE:g} and 1",
            "reflectance-outside-model",
        )
        layer = np.where(low, MIN_LAYER_REFLECTANCE, np.minimum(layer, 1.0))
        return absorption_to_scattering(np.where(np.isfinite(values), layer, np.nan))

    def reflectance(self, ratio: npt.ArrayLike) -> Floats:
        # Return the reflectance of layers from their K/S [1], clipped to 0 to 1; inverse of `ratio`.
        reflectance = self.interface.outside(thick_layer_reflectance(ratio)) + self.mirrored
        return np.asarray(np.clip(reflectance, 0.0, 1.0))


def coating_of(library: xr.Dataset, k1: float, k2: float, mirrored: Any) -> Coating:
    # Return the coating between the layers of a library's paints and their reflectance.
    #
    # Takes ``library``: its reflectance may have the attribute ``mirror_reflection``; ``k1``, ``k2``: see
    # `Interface`; ``mirrored``: mirrored light in the reflectance [1], one number, or one per band; by
    # default 0 if the library declares mirrored light excluded, or has a ``specular_reflectance``; else k1.
    #
    # Raises `SchemaError`: a value is no reflectance, or the attribute is invalid; all are listed.
    interface = Interface(k1, k2)
    with Problems("the light mirrored by the coat is unknown", SchemaError) as problems:
        try:
            default = 0.0 if mirror_reflection(library) == EXCLUDED else k1
        except SchemaError as error:
            default = k1
            problems.add_error(str(library.attrs.get("title", "the library")), error)
        mirrored = default if mirrored is None else mirrored
        values = np.asarray(mirrored, np.float64)
        if values.shape not in ((), (library.sizes[BAND],)):
            problems.add(
                f"mirrored= has shape {values.shape}",
                expected="one number, or one per band",
                code="length-mismatch",
            )
        elif not ((values >= 0.0) & (values < 1.0)).all():
            problems.add(
                f"mirrored={mirrored!r:.40}", expected="values from 0 to below 1", code="value-out-of-range"
            )
    return Coating(interface, values)


# --- libraries of synthetic paints -------------------------------------------------------------------------

#: Variable of single pixels of a paint, or of its variants (signature, member, band).
MEMBERS = "member_reflectance"

#: Variable of the reflectance of the coat (signature, band), present in some libraries.
SPECULAR = "specular_reflectance"

_DIMS = {
    "reflectance": (SIGNATURE, BAND),
    "reflectance_sd": (SIGNATURE, BAND),
    "reflectance_quantiles": (SIGNATURE, QUANTILE, BAND),
    SPECULAR: (SIGNATURE, BAND),
    MEMBERS: (SIGNATURE, MEMBER, BAND),
}
_MEANINGS = {
    "reflectance": "Reflectance of a synthetic paint",
    "reflectance_sd": "Standard deviation of reflectance over the members",
    "reflectance_quantiles": "Quantiles of reflectance over the members",
    SPECULAR: "Reflectance of the clear coat and of flakes, near the mirror direction",
    MEMBERS: "Reflectance of synthetic variants of a paint",
}
#: Attributes of reflectance that also hold for paints computed from it.
_INHERITED_ATTRS = ("mirror_reflection", "mirrored_sky_removed", "light_corrected", "tilt", "smoothing")


def specular_of(library: xr.Dataset) -> Array:
    # Return the specular reflectance of the coats of a library (signature, band) [1].
    return np.asarray(convert(library[SPECULAR], "1").transpose(SIGNATURE, BAND).values)


def synthetic_library(
    library: xr.Dataset,
    names: Sequence[str],
    values: Mapping[str, Array],
    parents: Sequence[Mapping[str, float]],
    method: str,
    **attrs: Any,
) -> xr.Dataset:
    # Return new paints as a library.
    #
    # Takes ``library``: source of the bands and attributes; ``names`` of the new paints; ``values``: spectra
    # by the name of their variable; ``parents``: shares of the parents of each paint; ``method``: name of the
    # method; ``**attrs``: attributes of the library.
    paints = xr.Dataset()
    if MEMBERS in values and values[MEMBERS].shape[1] > 1:
        # paint by paint: a copy of all members would double the memory
        spreads = [_spread_of_paint(paint[np.isfinite(paint).any(axis=1)]) for paint in values[MEMBERS]]
        sds, quantiles = (np.stack(arrays) for arrays in zip(*spreads, strict=True))
        values = {**values, "reflectance_sd": sds, "reflectance_quantiles": quantiles}
        paints = paints.assign_coords(
            {QUANTILE: (QUANTILE, np.array(QUANTILES), LIBRARY_VARIABLES[QUANTILE].attrs)}
        )
    for name, array in values.items():
        variable_attrs = {"long_name": _MEANINGS[name], "units": "1"}
        paints[name] = (_DIMS[name], np.asarray(array, np.float32), variable_attrs)
    parent_attrs = library["reflectance"].attrs
    paints["reflectance"].attrs |= {key: parent_attrs[key] for key in _INHERITED_ATTRS if key in parent_attrs}
    bands = {name: array for name, array in library.coords.items() if array.dims == (BAND,)}
    paints = paints.assign_coords(bands).assign_coords(
        {
            SIGNATURE: (SIGNATURE, np.array(names, object), LIBRARY_VARIABLES[SIGNATURE].attrs),
            **{
                name: (SIGNATURE, np.array(column, object), {"long_name": meaning})
                for name, meaning, column in (
                    ("provenance", "Where the paint comes from", ["synthetic"] * len(names)),
                    (
                        "parents",
                        "Paints it was made from, as JSON",
                        [json.dumps(list(shares), ensure_ascii=False) for shares in parents],
                    ),
                    # twelve digits, so that the last bits of a division do not show
                    (
                        "weights",
                        "Shares of the parents, as JSON",
                        [
                            json.dumps([float(f"{part:.12g}") for part in shares.values()])
                            for shares in parents
                        ],
                    ),
                    ("method", "How it was made", [method] * len(names)),
                )
            },
        }
    )
    paints.attrs = {
        "title": "Synthetic paints",
        "provenance": "synthetic",
        "made_from": str(library.attrs.get("title", "a paint library")),
        **attrs,
    }
    return paints


def _spread_of_paint(members: Array) -> tuple[Array, Array]:
    # Standard deviation (band,) and quantiles (quantile, band) of members, band by band
    finite_count = np.isfinite(members).sum(axis=0)
    sd = np.full(finite_count.size, np.nan)
    quantiles = np.full((len(QUANTILES), finite_count.size), np.nan)
    # without NaN the plain functions are far faster
    is_complete = bool(finite_count.size) and bool((finite_count == len(members)).all())
    sd_of, quantile_of = (np.std, np.quantile) if is_complete else (np.nanstd, np.nanquantile)
    if (has_spread := finite_count > 1).any():
        sd[has_spread] = sd_of(members[:, has_spread], axis=0, ddof=1, dtype=np.float64)
    if (has_value := finite_count > 0).any():
        quantiles[:, has_value] = quantile_of(members[:, has_value], QUANTILES, axis=0)
    return sd, quantiles


Form = Literal["members", "paints"]

#: Minimum margin of the logit beyond 0 and 1 [1].
_MIN_MARGIN = 0.005

#: Minimum distance of a population's median from the ends of the logit, in robust standard deviations. The
#: logit is nearly linear there: at 4, noise as large as the reflectance would grow by 16 %; at 8, shade would
#: no longer act as a factor.
_MIN_DISTANCE_SD = 6.0

_METHOD = "smoothed bootstrap of principal components of logit reflectance"


@takes_quantities()
def sample_paints(
    library: xr.Dataset, count: int, *, seed: int = 0, form: Form = "members", bandwidth: float | None = None
) -> xr.Dataset:
    r"""Draw variants of every paint of a library from its population.

    Parameters
    ----------
    library
        A paint library with ``member_reflectance`` (signature, member, band) [1], such as single pixels.
    count
        Variants of each paint.
    seed
        Seed of the random numbers. A paint's variants do not depend on the other paints.
    form
        "members": one new paint for each paint, with the variants as members, as textures use them.
        "paints": every variant is a paint.
    bandwidth
        Distance of variants from single members, in standard deviations of the population [1]: 0 repeats
        members, and above 1 variants are nearly normally distributed. By default Silverman's rule.

    Returns
    -------
    Dataset
        A paint library: ``reflectance`` (signature, band), float32 [1], 0 to 1, with "members" their mean;
        with "members" also ``member_reflectance``, ``reflectance_sd`` and ``reflectance_quantiles``.
        Coordinates of the library's paints, such as make and colour, and ``provenance`` ("synthetic"),
        ``parents``, ``weights`` and ``method``. Names end in "(synthetic)", or "(synthetic 1)" and so on.

    Raises
    ------
    SchemaError
        The library has no members, or too few with all bands; or an option is out of range; all are listed.
    UnitsError
        Units cannot be read.

    Warns
    -----
    PaintWarning
        Members were left out for missing bands, or lie outside 0 to 1 by more than 0.005.

    Notes
    -----
    Members are transformed to an unbounded scale, :math:`z = \ln((R + m) / (1 + m' - R))`, and decomposed
    into principal components. The margins m and m' of a band are 0.005, or larger where the population is
    noise about 0 or 1: the median must be six robust standard deviations (1.4826 times the median absolute
    deviation) away from either end. A variant is a random member, moved at random along all components, and
    shrunk towards the mean, so that mean and covariance remain nearly those of the members (Silverman,
    Density Estimation, 1986, section 6.4.1):

    .. math:: z = \bar z + \frac{(z_I - \bar z) + h \epsilon}{\sqrt{1 + h^2}},
              \qquad \epsilon \sim N(0, \Sigma), \qquad h = \left(\frac{4}{n (d + 2)}\right)^{1 / (d + 4)}

    d is the effective number of components, :math:`(\sum \lambda)^2 / \sum \lambda^2`. Tails and groups of
    the population are blurred, but kept, unlike with a normal distribution. A variant is at most h standard
    deviations beyond the members of a band, and within 0 to 1: values below 0 become 0, which raises the
    mean of a black paint's variants. The standard deviation of noise as large as the reflectance grows by up
    to a tenth. Bands that half of the members lack are NaN.

    Examples
    --------
    >>> from hyperpaint.paints import starter_library
    >>> paints = starter_library(members=50)
    >>> drawn = sample_paints(paints.isel(signature=[0]), 200)
    >>> drawn["signature"].item(), dict(drawn.member_reflectance.sizes)
    ('Synthetic Polar White (synthetic)', {'signature': 1, 'member': 200, 'band': 272})
    """
    variables, faults = schema.find(
        library, [SIGNATURE, "reflectance", "member_reflectance", "wavelength"], schema.LIBRARY_VARIABLES
    )
    with Problems("variants cannot be drawn", SchemaError) as problems:
        problems.extend(faults)
        problems.add_if(count < 1, f"count={count!r}", expected="1 or more", code="value-out-of-range")
        one_of(form, ("members", "paints"), "form", problems=problems)
        problems.add_if(
            bandwidth is not None and not 0.0 <= bandwidth < np.inf,
            f"bandwidth={bandwidth!r}",
            expected="0 or more, or None",
            code="value-out-of-range",
        )
    members = np.asarray(variables["member_reflectance"].values)
    names = [str(name) for name in library[SIGNATURE].values]
    variants = np.full((len(names), count, library.sizes[BAND]), np.nan, np.float32)
    excluded = outside = 0
    with Problems("variants cannot be drawn", SchemaError) as problems:
        for number, (name, spectra) in enumerate(zip(names, members, strict=True)):
            # bands in which most members have a value (band,), and the members with values in all these bands
            present = np.asarray(spectra, np.float64)[np.isfinite(spectra).any(axis=1)]
            is_finite = np.isfinite(present)
            bands = is_finite.mean(axis=0) > 0.5 if len(is_finite) else np.zeros(present.shape[1], np.bool_)
            complete = present[is_finite[:, bands].all(axis=1)][:, bands]
            if len(complete) < 2:
                problems.add(
                    f"{name!r} has {len(complete)} members with values in all bands",
                    expected="at least 2",
                    mend="remove the paint from the library",
                    code="members-too-few",
                )
                continue
            excluded += int(np.isfinite(spectra).any(axis=1).sum()) - len(complete)
            outside += int(((complete <= -_MIN_MARGIN) | (complete >= 1.0 + _MIN_MARGIN)).sum())
            rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
            variants[number][:, bands] = draw_variants(complete, count, rng, bandwidth)
    warn_if(
        excluded or outside,
        f"{excluded} members lack bands and were excluded; {outside} values are outside 0 to 1 by more "
        f"than {_MIN_MARGIN:g}, the range of variants",
        "members-left-out",
    )
    # Variants (signature, member, band) as members of one new paint for each parent, or as paints
    parent_rows = np.repeat(np.arange(len(names)), 1 if form == "members" else count)
    parents = [names[row] for row in parent_rows]
    names = [f"{name} (synthetic)" for name in parents]
    values = {"reflectance": variants.mean(axis=1, dtype=np.float64), MEMBERS: variants}
    if form == "paints":
        names = [f"{name} (synthetic {row % count + 1})" for row, name in enumerate(parents)]
        values = {"reflectance": variants.reshape(-1, variants.shape[2])}
    if SPECULAR in library.variables:
        values[SPECULAR] = specular_of(library)[parent_rows]
    paints = synthetic_library(library, names, values, [{name: 1.0} for name in parents], _METHOD, seed=seed)
    properties = {
        name: (SIGNATURE, array.values[parent_rows], array.attrs)
        for name, array in library.coords.items()
        if array.dims == (SIGNATURE,) and name not in paints.coords
    }
    return paints.assign_coords(properties).drop_vars(MEMBER, errors="ignore")


def draw_variants(
    members: Floats, count: int, rng: np.random.Generator, bandwidth: float | None = None
) -> Floats:
    # Return variants (count, band) of at least two spectra (member, band) [1], 0 to 1.
    #
    # See `sample_paints`.
    # margins of the logit below 0 and above 1, from the robust standard deviation
    median = np.median(members, axis=0)
    deviation = 1.4826 * np.median(np.abs(members - median), axis=0)
    lower_margin, upper_margin = (
        np.maximum(_MIN_MARGIN, _MIN_DISTANCE_SD * deviation - distance)
        for distance in (median, 1.0 - median)
    )
    inside = np.clip(members, -0.8 * lower_margin, 1.0 + 0.8 * upper_margin)
    logit = np.log((inside + lower_margin) / (1.0 + upper_margin - inside))
    mean = logit.mean(axis=0)
    size = len(logit)
    _, singular_values, components = np.linalg.svd(logit - mean, full_matrices=False)
    variance = singular_values**2
    if bandwidth is None:
        effective = variance.sum() ** 2 / max(float((variance**2).sum()), np.finfo(float).tiny)
        bandwidth = (4.0 / (size * (effective + 2.0))) ** (1.0 / (effective + 4.0))
    # random members plus noise with their covariance
    noise = (
        rng.standard_normal((count, len(singular_values))) * (singular_values / np.sqrt(size)) @ components
    )
    deviations = logit[rng.integers(size, size=count)] - mean
    # size / (size - 1) corrects the covariance for the estimated mean
    varied = mean + np.sqrt(size / (size - 1.0) / (1.0 + bandwidth**2)) * (deviations + bandwidth * noise)
    share = 0.5 * (1.0 + np.tanh(0.5 * varied))  # the logistic function, without overflow
    variants = share * (1.0 + lower_margin + upper_margin) - lower_margin
    # near its ends a logit has longer tails than the measured values: limit the range of every band
    centre, blur, scale = inside.mean(axis=0), bandwidth * inside.std(axis=0), np.sqrt(size / (size - 1.0))
    low = centre + scale * (inside.min(axis=0) - centre) - blur
    high = centre + scale * (inside.max(axis=0) - centre) + blur
    return np.asarray(np.clip(np.clip(variants, low, high), 0.0, 1.0))


# --- mixtures and shades ---------------------------------------------------------------------------------

Method = Literal["kubelka-munk", "linear"]

#: How paints are mixed: as pigments in a pot, or as areas side by side.
METHODS = ("kubelka-munk", "linear")


@takes_quantities()
@documented(library="opaque library")
def mix_paints(
    library: xr.Dataset,
    recipes: Mapping[str, Mapping[str, float]],
    *,
    method: Method = "kubelka-munk",
    scattering: Mapping[str, float] | None = None,
    k1: float = 0.04,
    k2: float = 0.60,
    mirrored: Any = None,
) -> xr.Dataset:
    r"""Mix paints of a library into new ones.

    Parameters
    ----------
    library
    recipes
        Parts of each parent by its name, for every new paint by its name. Only the ratio of the parts
        matters.
    method
        "kubelka-munk" mixes pigments in a pot: absorption and scattering add up. "linear" mixes areas side by
        side, as a pixel does: reflectances add up.
    scattering
        Relative scattering of a part of a paint [1], by name; 1 by default. White (rutile) scatters several
        times more than coloured pigments.
    k1, k2
        Reflectance of the coat for light from outside, and for diffuse light from inside [1]; the defaults
        are for an index of 1.5. Not used by "linear".
    mirrored
        Part of the library's reflectance that the coat mirrors [1], one number, or one per band. By default 0
        where the library excludes it (attribute ``mirror_reflection``), else k1. Outdoors it is about k1
        times the diffuse fraction of the light.

    Returns
    -------
    Dataset
        A paint library with ``reflectance`` (signature, band), float32 [1], 0 to 1, including mirrored light
        where the library does. ``member_reflectance`` (signature, member, band), where all parents have
        members: the first members of all parents are mixed, then the second, up to the smallest number of
        members; NaN beyond; with ``reflectance_sd`` and ``reflectance_quantiles``. Coordinates ``provenance``
        ("synthetic"), ``parents``, ``weights`` (JSON, normalised to 1) and ``method`` (signature).

    Raises
    ------
    SchemaError
        The library lacks variables; recipes name unknown or ambiguous paints, or negative parts; an option is
        invalid; or paints are darker than the mirrored light in them. All are listed.
    UnitsError
        Units cannot be read.

    Warns
    -----
    PaintWarning
        Some reflectances are impossible for such a layer, or outside 0 to 1 with "linear"; they are replaced
        by the nearest possible value. Parents of a paint have different numbers of members.

    Notes
    -----
    With the shares c, scattering s and K/S of each parent q,

    .. math:: q_{mix} = \sum_i c_i s_i q_i \Big/ \sum_i c_i s_i

    (Duncan, Proc. Phys. Soc. 52, 390, 1940; with equal s the single-constant theory), where q follows from
    reflectance through Saunderson's correction, see `hyperpaint.paints.paint_libraries`. Absorption
    dominates: one part of black in nine of white darkens by far more than a tenth. The
    ``specular_reflectance`` of a library is averaged. A band that is NaN in one parent is NaN. Eager.

    Examples
    --------
    >>> from hyperpaint.paints import starter_library
    >>> paints = starter_library(members=0)
    >>> white, black = "Synthetic Polar White", "Synthetic Carbon Black"
    >>> grey = {"grey": {white: 9, black: 1}}
    >>> for method in ("kubelka-munk", "linear"):
    ...     mixed = mix_paints(paints, grey, method=method)
    ...     print(method, mixed.reflectance.mean().item().__round__(2))
    kubelka-munk 0.1
    linear 0.64
    >>> mixed.weights.item()
    '[0.9, 0.1]'
    """
    shares = _checked(library, recipes, method, scattering)
    parents = list(dict.fromkeys(name for recipe in shares.values() for name in recipe))
    names = [str(name) for name in library[SIGNATURE].values]
    values = _spectra(library.isel({SIGNATURE: [names.index(name) for name in parents]}))
    weights = np.array([[recipe.get(name, 0.0) for name in parents] for recipe in shares.values()])
    specular = {SPECULAR: _averaged(weights, values[SPECULAR])} if SPECULAR in values else {}
    settings: dict[str, Any] = {}
    if method == "linear":
        areas = {name: _averaged(weights, array) for name, array in values.items() if name != SPECULAR}
        for array in areas.values():
            outside, finite_count = ((array < 0.0) | (array > 1.0)).sum(), np.isfinite(array).sum()
            warn_if(
                outside,
                f"{outside} of {finite_count} reflectances clipped to 0 to 1; check the scale",
                "reflectance-clipped",
            )
        mix = {name: np.clip(array, 0.0, 1.0) for name, array in areas.items()}
    else:
        coating = coating_of(library, k1, k2, mirrored)
        scatter = np.array([(scattering or {}).get(name, 1.0) for name in parents])
        relative = weights * scatter / (weights @ scatter)[:, np.newaxis]
        mix = {
            name: coating.reflectance(_averaged(relative, coating.ratio(array, parents)))
            for name, array in values.items()
            if name != SPECULAR
        }
        factors = ", ".join(f"{name} {number:g}" for name, number in (scattering or {}).items())
        settings = {"k1": k1, "k2": k2, "scattering": factors if scattering is not None else "equal"}
    if MEMBERS in values:
        # members without a partner among the other parents
        counts = np.isfinite(values[MEMBERS]).any(axis=2).sum(axis=1)
        unpaired = np.array([int((counts[row] - counts[row].min()).sum()) for row in weights > 0.0])
        warn_if(
            unpaired.any(),
            f"{unpaired.sum()} members of the parents of {int((unpaired > 0).sum())} of {len(unpaired)} "
            "paints have no partner and were excluded; draw the same number of members of each parent "
            "with sample_paints first",
            "members-unpaired",
        )
    values = _trimmed(specular | mix)
    return synthetic_library(library, list(shares), values, list(shares.values()), method, **settings)


@takes_quantities()
@documented(library="opaque library")
def shade_paints(
    library: xr.Dataset, depths: Sequence[float], *, k1: float = 0.04, k2: float = 0.60, mirrored: Any = None
) -> xr.Dataset:
    r"""Make every paint of a library lighter and deeper: a ladder of depths of shade.

    Parameters
    ----------
    library
    depths
        Depths of shade relative to the paint [1]: pigment per scatterer. 0.1 is a tint, one part of the paint
        in nine of a white without absorption; 2 has twice the pigment. To darken with black, mix it in with
        `hyperpaint.paints.mix_paints`.
    k1, k2, mirrored
        See `hyperpaint.paints.mix_paints`.

    Returns
    -------
    Dataset
        A paint library as from `hyperpaint.paints.mix_paints`, every paint at every depth, named
        ``"<paint> x <depth>"``, with the coordinate ``depth`` (signature) [1].

    Raises
    ------
    SchemaError
        The library lacks variables, a depth is not above 0, an option is invalid, or paints are darker than
        the mirrored light in them. All of a kind are listed.
    UnitsError
        Units cannot be read.

    Warns
    -----
    PaintWarning
        Some reflectances are impossible for such a layer; they are replaced by the nearest possible value.

    Notes
    -----
    K/S is multiplied by the depth, see `hyperpaint.paints.paint_libraries`. Eager.

    Examples
    --------
    >>> from hyperpaint.paints import starter_library
    >>> red = starter_library(members=0).isel(signature=[5])
    >>> ladder = shade_paints(red, [0.1, 1.0])
    >>> ladder["signature"].values.tolist(), ladder.reflectance[:, :60].mean("band").values.round(2)
    (['Synthetic Signal Red x 0.1', 'Synthetic Signal Red x 1'], array([0.15, 0.02], dtype=float32))
    """
    factors = np.asarray(depths, np.float64)
    SchemaError.raise_if(
        factors.ndim != 1 or not factors.size or not ((factors > 0.0) & np.isfinite(factors)).all(),
        f"depths={depths!r:.60}",
        expected="numbers above 0, such as [0.1, 0.5, 2]",
        code="value-out-of-range",
    )
    originals = _spectra(library)
    names = [str(name) for name in library[SIGNATURE].values]
    coating, count = coating_of(library, k1, k2, mirrored), len(names)
    spectra: dict[str, Floats] = {}
    for name, array in originals.items():
        repeated = np.repeat(array if name == SPECULAR else coating.ratio(array, names), factors.size, axis=0)
        scale = np.tile(factors, count).reshape(-1, *[1] * (array.ndim - 1))
        spectra[name] = repeated if name == SPECULAR else coating.reflectance(repeated * scale)
    shades = [f"{name} x {depth:g}" for name in names for depth in factors.tolist()]
    parents = [{name: 1.0} for name in names for _ in factors]
    shaded = synthetic_library(
        library, shades, _trimmed(spectra), parents, "kubelka-munk shade", k1=k1, k2=k2
    )
    attrs = {"long_name": "Pigment relative to that of the parent", "units": "1"}
    return shaded.assign_coords(depth=(SIGNATURE, np.tile(factors, count), attrs))


def _averaged(weights: Floats, values: Floats) -> Floats:
    # Weighted sums (mixture, ..., band) of values (parent, ..., band); NaN with weight 0 does not count.
    # Takes `weights` (mixture, parent).
    sums = np.zeros((len(weights), *values.shape[1:]))
    for row, shares in zip(sums, weights, strict=True):
        for number in np.flatnonzero(shares):
            row += shares[number] * values[number]
    return sums


def _spectra(library: xr.Dataset) -> dict[str, Floats]:
    # Spectra of paints by variable, float64 [1]
    members = [name for name in (MEMBERS,) if name in library.variables]
    names = [SIGNATURE, "wavelength", "reflectance", *members]
    variables = schema.require(library, names, "new paints", schema.LIBRARY_VARIABLES)
    spectra = {name: np.asarray(variables[name].values, np.float64) for name in names[2:]}
    if SPECULAR in library.variables:
        spectra[SPECULAR] = np.asarray(specular_of(library), np.float64)
    if MEMBERS in spectra:
        # members of parents are mixed in pairs: missing members are sorted to the end
        absent = ~np.isfinite(spectra[MEMBERS]).any(axis=2)
        order = np.argsort(absent, axis=1, kind="stable")[:, :, np.newaxis]
        spectra[MEMBERS] = np.take_along_axis(spectra[MEMBERS], order, axis=1)
    return spectra


def _trimmed(values: dict[str, Floats]) -> dict[str, Floats]:
    # Spectra without the members that all paints lack
    members = values.get(MEMBERS, np.empty((0, 0, 0)))
    count = int(np.isfinite(members).any(axis=2).sum(axis=1).max(initial=0))
    result = {name: array for name, array in values.items() if name != MEMBERS}
    return {**result, MEMBERS: members[:, :count]} if count else result


def _checked(
    library: xr.Dataset,
    recipes: Mapping[str, Mapping[str, float]],
    method: str,
    scattering: Mapping[str, float] | None,
) -> dict[str, dict[str, float]]:
    schema.require(library, [SIGNATURE, "reflectance", "wavelength"], "new paints", schema.LIBRARY_VARIABLES)
    with Problems("paints cannot be mixed", SchemaError) as problems:
        paint_names = [str(name) for name in library[SIGNATURE].values]
        one_of(method, METHODS, "method", problems=problems)
        problems.add_if(
            not recipes,
            "recipes= is empty",
            mend='pass at least one recipe, such as {"grey": {"white": 9, "black": 1}}',
            code="empty-input",
        )
        shares = {}
        for name, recipe in recipes.items():
            for parent in recipe:
                _check_name(str(parent), f"{name!r}", paint_names, problems)
            parts = np.array([*recipe.values()], np.float64)
            if not (parts.size and np.isfinite(parts).all() and (parts >= 0.0).all() and parts.sum() > 0.0):
                problems.add(
                    f"{name!r}: parts are {list(recipe.values())}",
                    expected="0 or more, not all 0",
                    code="value-out-of-range",
                )
            elif not len(problems):
                shares[str(name)] = dict(zip(recipe, (parts / parts.sum()).tolist(), strict=True))
        for name, number in (scattering or {}).items():
            _check_name(name, "scattering", paint_names, problems)
            problems.add_if(
                not 0.0 < number < np.inf,
                f"scattering of {name!r} is {number!r}",
                expected="a number above 0",
                code="value-out-of-range",
            )
    return shares


def _check_name(name: str, subject: str, paint_names: list[str], problems: Problems) -> None:
    count = paint_names.count(name)
    if count > 1:
        problems.add(
            f"{subject}: {count} paints are named {name!r}",
            mend="give them different names, or select one of them with isel",
            code="paint-ambiguous",
        )
    elif not count:
        close = difflib.get_close_matches(name, paint_names, 1)
        mend = f"did you mean {close[0]!r}?" if close else ""
        problems.add(f"{subject}: there is no paint {name!r}", mend=mend, code="paint-unknown")


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
    with Problems("the starter library cannot be computed", SchemaError) as problems:
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
        name: (
            SIGNATURE,
            np.array(swatches if name == "srgb" else [spec[name] for spec in specs], object),
            attrs,
        )
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
    parts = (
        height
        * (
            0.5 * (1.0 + np.tanh((nm - centre) / (2 * width)))
            if kind == "edge"
            else np.exp(-0.5 * ((nm - centre) / width) ** 2)
        )
        for kind, centre, width, height in spec["absorbers"]
    )
    return sum(parts, np.full(nm.size, spec["absorption"]))


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
