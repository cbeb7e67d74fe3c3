"""Colours of paints in daylight, and search of paints by name, colour, or shape of spectrum."""

from __future__ import annotations

import fnmatch
import unicodedata
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base import schema
from hyperpaint.base.arrays import Floats, Floats32
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.facts import documented
from hyperpaint.base.schema import BAND, LIBRARY_VARIABLES, SIGNATURE
from hyperpaint.base.units import convert, takes_quantities
from hyperpaint.light.daylight_colours import ciede2000, lab_of, parse_colour, srgb


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
    values = variables["reflectance"].values
    if "good" in paints.variables:
        values = np.where(paints["good"].values.astype(bool), values, np.nan)
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
    problems = Problems("the library cannot be searched", SchemaError)
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
        limit is not None and limit < 1, f"limit={limit!r}", expected="1 or more", code="value-out-of-range"
    )
    problems.add_if(
        name is not None and not name.strip(), "name= is empty", expected="part of a name", code="empty-input"
    )
    problems.raise_if_any()
    variables = schema.require(
        library, [SIGNATURE, "reflectance", "wavelength"], "a search", LIBRARY_VARIABLES
    )
    is_match = np.ones(library.sizes[SIGNATURE], np.bool_)
    if name is not None:
        is_match &= [_matches_name(str(paint_name), name) for paint_name in variables[SIGNATURE].values]
    order = np.arange(is_match.size)
    coordinates: dict[str, Any] = {}
    if colour is not None:
        difference = _colour_differences(library, colour)
        is_match &= difference <= (np.inf if maximum_colour_difference is None else maximum_colour_difference)
        order = np.argsort(difference, kind="stable")
        attrs = {"long_name": f"CIEDE2000 difference from {colour}", "units": "1"}
        coordinates["colour_difference"] = (SIGNATURE, difference, attrs)
    if like is not None:
        angle = _angles(library, variables["reflectance"], variables["wavelength"], like)
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


# --- colours -----------------------------------------------------------------------------------------------


def _colour_differences(library: xr.Dataset, colour: str) -> Floats:
    # CIEDE2000 of every paint (signature,) [1]; infinite for a paint without colour
    query = lab_of(parse_colour(colour))
    wavelength = np.asarray(library["wavelength"].values, np.float64)
    colours = paint_colours(library.isel({BAND: np.argsort(wavelength, kind="stable")}))
    SchemaError.raise_if(
        len(colours) and not np.isfinite(colours).any(),
        "no paint of the library has a colour",
        expected="at least 3 good bands between 380 and 780 nm",
        code="visible-bands-missing",
    )
    difference = ciede2000(lab_of(colours), query)
    return np.where(np.isfinite(difference), difference, np.inf)


# --- spectra -----------------------------------------------------------------------------------------------


def _angles(library: xr.Dataset, reflectance: xr.DataArray, wavelength: xr.DataArray, like: Any) -> Floats:
    # Spectral angle of every paint to a spectrum (signature,) [rad]; infinite with too few common bands
    nm = np.asarray(wavelength.values, np.float64)
    spectrum = _one_spectrum(library, like, nm)
    if "good" in library.variables:
        spectrum = np.where(library["good"].values.astype(bool), spectrum, np.nan)
    SchemaError.raise_if(
        np.isfinite(spectrum).sum() < MIN_BANDS,
        f"like= has values in {int(np.isfinite(spectrum).sum())} good bands of the library "
        f"({nm.min():g} to {nm.max():g} nm)",
        expected=f"at least {MIN_BANDS}",
        code="bands-not-shared",
    )
    paints = np.asarray(reflectance.values, np.float64)
    is_common = np.isfinite(paints) & np.isfinite(spectrum)
    x, y = np.where(is_common, paints, 0.0), np.where(is_common, spectrum, 0.0)
    usable = (is_common.sum(axis=1) >= MIN_BANDS) & (np.sqrt((x**2).sum(axis=1) * (y**2).sum(axis=1)) > 0.0)
    # tan(angle / 2) = |x - y| / |x + y| of unit vectors: precise for small angles, unlike the cosine
    unit_x = x / np.sqrt((x**2).sum(axis=1, keepdims=True)).clip(np.finfo(float).tiny)
    unit_y = y / np.sqrt((y**2).sum(axis=1, keepdims=True)).clip(np.finfo(float).tiny)
    difference, total = (np.sqrt(((unit_x + sign * unit_y) ** 2).sum(axis=1)) for sign in (-1.0, 1.0))
    return np.where(usable, 2.0 * np.arctan2(difference, total), np.inf)


def _one_spectrum(library: xr.Dataset, like: Any, nm: Floats) -> Floats:
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
