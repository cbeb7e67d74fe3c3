"""The specification of a paint library (docs/paint-library.md), and the check of a library against it.

What a library must say is said, or said to be unknown: a reader who finds nothing cannot tell which.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Array
from hyperpaint.base.facts import one_of
from hyperpaint.base.mirrored_light import BODY, EXCLUDED, INCLUDED, OUTSIDE, THROUGH_COAT
from hyperpaint.base.old_names import VERSION_NAME, with_new_names
from hyperpaint.base.schema import BAND, LIBRARY_VARIABLES, SIGNATURE

from .records import CENTRE

#: Version of the specification, the attribute `VERSION_NAME` of a library. 1 had the dim `paint`.
VERSION = 2
UNKNOWN = "unknown"
_MAX_TEXT_CHARS = 4000
_MAX_NAMES = 5


class Term(NamedTuple):
    """A declaration that every library makes, for all its paints or for each."""

    name: str
    words: tuple[str, ...]  #: allowed words; () for any text
    meaning: str


#: Declarations of every library; a word may be ``unknown``.
TERMS = (
    Term(
        "quantity",
        ("HCRF", "BRF", "8/d SCI", "8/d SCE", BODY, THROUGH_COAT, OUTSIDE, UNKNOWN),
        "A reflectance factor, or the reflectance of a sphere with or without the mirror image",
    ),
    Term("specular_component", (INCLUDED, EXCLUDED, UNKNOWN), "Whether the coat's mirror image is in it"),
    Term("measurement_geometry", (), "From where light came and to where it was seen, such as 45/0 or d/8"),
    Term("finish", ("solid", "metallic", "pearl", "matt", UNKNOWN), "What the paint is like"),
    Term("provenance", ("measured", "synthetic", "derived", UNKNOWN), "Where the spectra come from"),
    Term("licence", (), "Under which terms it may be used: an SPDX identifier, or a text"),
)

#: Reflectance beyond which units are doubtful: noise of a black panel, glint beside a panel.
_REFLECTANCE_RANGE = (-0.1, 2.0)
#: Sunlight to thermal infrared [nm]: micrometres lie below, wavenumbers and picometres above.
_WAVELENGTH_RANGE_NM = (150.0, 50_000.0)
_ANGLES_DEG = {
    "sun_zenith": (0.0, 90.0),
    "view_zenith": (0.0, 90.0),
    "sun_azimuth": (-180.0, 360.0),
    "view_azimuth": (-180.0, 360.0),
    "aspecular_angle": (0.0, 180.0),
    "relative_azimuth": (0.0, 360.0),
}
_SPREADS = (
    "reflectance_sd",
    "reflectance_u_random",
    "reflectance_u_systematic",
    "reflectance_u_coat",
)


@dataclass(frozen=True)
class LibraryFinding:
    """One departure from the specification."""

    rule: str  #: Name of the rule in docs/paint-library.md.
    found: str
    expected: str

    def __str__(self) -> str:
        return f"{self.rule}: {self.found}; expected {self.expected}"


@dataclass(frozen=True)
class LibraryReport:
    """Result of comparing a library with the specification."""

    source: str
    paints: int
    bands: int
    findings: tuple[LibraryFinding, ...]

    @property
    def ok(self) -> bool:
        """Whether there is no finding."""
        return not self.findings

    def __str__(self) -> str:
        size = f"{self.source}: {self.paints} paints, {self.bands} bands"
        if self.ok:
            return f"{size}: a paint library of version {VERSION}"
        lines = (f"  {finding}" for finding in self.findings)
        return "\n".join([f"{size}: {len(self.findings)} findings", *lines])


def check_library(library: str | os.PathLike[str] | xr.Dataset) -> LibraryReport:
    """Compare a library with the specification (eager: reads its spectra).

    Parameters
    ----------
    library
        A file or store that `hyperpaint.open_library` opens, or a dataset.

    Returns
    -------
    LibraryReport
        All findings; ``ok`` is True without findings.

    Raises
    ------
    FormatError, StoreError
        The file cannot be opened.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> paints = xr.Dataset(
    ...     {"reflectance": (("signature", "band"), np.float32([[5.0, 40.0]]), {"units": "1"})},
    ...     coords={"signature": ["red"], "wavelength": ("band", [450.0, 650.0], {"units": "nm"})},
    ... )
    >>> [finding.rule for finding in check_library(declare_library(paints)).findings]
    ['reflectance-range', 'uncertainty']
    """
    if isinstance(library, str | os.PathLike):
        from .library_formats import open_library

        source, dataset = os.fspath(library), open_library(library)
    else:
        source, dataset = str(library.attrs.get("source", "the library")), with_new_names(library)
    findings = list(_structure(dataset))
    if not findings:  # the other rules need the structure
        rules: tuple[Callable[[xr.Dataset], Iterator[LibraryFinding]], ...] = (
            _names,
            _wavelengths,
            _reflectances,
            _spreads,
            _populations,
            _geometry,
            _declarations,
        )
        for rule in rules:
            findings.extend(rule(dataset))
    return LibraryReport(source, dataset.sizes.get(SIGNATURE, 0), dataset.sizes.get(BAND, 0), tuple(findings))


def declare_library(library: xr.Dataset, **words: str) -> xr.Dataset:
    """Return a library with all declarations of the specification; missing ones become ``unknown``.

    Parameters
    ----------
    library
        A paint library.
    **words
        Terms by their names (`TERMS`), such as ``licence="CC-BY-4.0"``, and ``title``.

    Raises
    ------
    SchemaError
        A term is unknown, or its word is not allowed.

    Examples
    --------
    >>> from hyperpaint.paints import starter_library
    >>> declared = declare_library(starter_library(members=2), licence="CC0-1.0", quantity="HCRF")
    >>> declared.attrs["licence"], declared.attrs["measurement_geometry"]
    ('CC0-1.0', 'unknown')
    """
    terms = {term.name: term for term in TERMS}
    for name, word in words.items():
        one_of(name, (*terms, "title"), "term")
        if name in terms and terms[name].words:
            one_of(word, terms[name].words, name)
    library = with_new_names(library)
    declared = library_terms(library)
    attrs = {name: UNKNOWN for name in terms if declared[name] is None}
    title = {} if library.attrs.get("title") else {"title": "Paint library"}
    return library.assign_attrs({VERSION_NAME: VERSION, **title, **attrs, **words})


def library_terms(library: xr.Dataset) -> dict[str, Any]:
    """Return the declaration of each term: a list with a word for every paint, a word for all, or None."""
    attrs = {**library.attrs, **library[CENTRE].attrs}
    return {
        term.name: list(map(str, library[term.name].values.tolist()))
        if term.name in library.variables and library[term.name].dims == (SIGNATURE,)
        else attrs.get(term.name)
        for term in TERMS
    }


# --- the rules ---------------------------------------------------------------------------------------------


def _structure(library: xr.Dataset) -> Iterator[LibraryFinding]:
    for name in (CENTRE, "wavelength", SIGNATURE):
        row = LIBRARY_VARIABLES[name]
        expected = f"a variable {name} ({', '.join(row.dims)})"
        if name not in library.variables:
            yield LibraryFinding("structure", f"{name!r} is missing", expected)
        elif problem := row.dim_problem(library[name]):
            yield LibraryFinding("structure", problem.found, expected)
    for key, array in library.variables.items():
        row_of = LIBRARY_VARIABLES.get(str(key))
        if (
            row_of is not None
            and key not in (CENTRE, "wavelength", SIGNATURE)
            and row_of.dim_problem(library[key])
            and array.dims != (SIGNATURE, *row_of.dims)
        ):
            yield LibraryFinding(
                "dims", f"{key} has dims {array.dims}", " or ".join(map(str, row_of.allowed_dims))
            )


def _names(library: xr.Dataset) -> Iterator[LibraryFinding]:
    names = library[SIGNATURE].values.tolist()
    if not names:
        yield LibraryFinding("paint-names", "there is no paint", "at least one")
    if invalid := [name for name in names if not isinstance(name, str) or not name.strip()]:
        yield LibraryFinding(
            "paint-names", f"{len(invalid)} names are empty or not text", "a text for every paint"
        )
    if duplicates := sorted({str(name) for name in names if names.count(name) > 1}):
        yield LibraryFinding(
            "paint-names", f"{_listed(duplicates)} occur twice", "a unique name for every paint"
        )


def _wavelengths(library: xr.Dataset) -> Iterator[LibraryFinding]:
    wavelength = library["wavelength"]
    values = np.asarray(wavelength.values, np.float64)
    if wavelength.attrs.get("units") != "nm":
        yield LibraryFinding("wavelength-units", f"units are {wavelength.attrs.get('units')!r}", "'nm'")
    low, high = _WAVELENGTH_RANGE_NM
    if not np.isfinite(values).all() or values.min(initial=low) < low or values.max(initial=high) > high:
        yield LibraryFinding(
            "wavelength-range", f"{values.min():g} to {values.max():g}", f"{low:g} to {high:g} nm"
        )
    steps = np.diff(values)
    if not ((steps > 0).all() or (steps < 0).all()):
        yield LibraryFinding(
            "wavelength-order",
            f"{int((steps == 0).sum())} occur twice, or the direction changes",
            "ascending or descending",
        )
    if "fwhm" in library.variables:
        fwhm = np.asarray(library["fwhm"].values, np.float64)
        if library["fwhm"].attrs.get("units") != "nm" or not (fwhm[np.isfinite(fwhm)] > 0).all():
            yield LibraryFinding(
                "fwhm", f"{np.nanmin(fwhm):g} {library['fwhm'].attrs.get('units')}", "positive, in nm"
            )
    if "good" in library.variables and library["good"].dtype != bool:
        yield LibraryFinding("good", f"dtype {library['good'].dtype}", "bool: whether a band is usable")


def _reflectances(library: xr.Dataset) -> Iterator[LibraryFinding]:
    reflectance = library[CENTRE]
    if reflectance.attrs.get("units") != "1":
        yield LibraryFinding(
            "reflectance-units", f"units are {reflectance.attrs.get('units')!r}", "'1', a fraction"
        )
    if reflectance.dtype.kind != "f":
        yield LibraryFinding("reflectance-dtype", str(reflectance.dtype), "float32 or float64")
        return
    values = reflectance.transpose(SIGNATURE, BAND).values
    low, high = _REFLECTANCE_RANGE
    is_good = (
        library["good"].values.astype(bool) if "good" in library.variables else np.ones(values.shape[1], bool)
    )
    with np.errstate(invalid="ignore"):
        outside = ((values < low) | (values > high) | np.isinf(values)) & is_good
    if outside.any():
        paints = _paints_of(library, outside.any(axis=1))
        yield LibraryFinding(
            "reflectance-range",
            f"{_extremes(values[outside])} in {paints}",
            f"{low:g} to {high:g} in good bands",
        )
    if (empty := ~np.isfinite(values).any(axis=1)).any():
        yield LibraryFinding(
            "reflectance-empty", f"no value in {_paints_of(library, empty)}", "a value in at least one band"
        )


def _spreads(library: xr.Dataset) -> Iterator[LibraryFinding]:
    has_spread = False
    for name in _SPREADS:
        if name in library.variables:
            values = library[name].values
            has_spread |= bool(np.isfinite(values).any())
            if (values < 0).any():
                yield LibraryFinding("uncertainty-sign", f"{name} is negative", "0 or more")
            if library[name].attrs.get("units") != "1":
                yield LibraryFinding(
                    "uncertainty-units", f"{name} has units {library[name].attrs.get('units')!r}", "'1'"
                )
    if not has_spread and library.attrs.get("uncertainty") != UNKNOWN:
        yield LibraryFinding(
            "uncertainty",
            "neither spread nor uncertainty",
            f"reflectance_u_random, reflectance_u_systematic or reflectance_sd, or uncertainty = {UNKNOWN!r}",
        )
    if "reflectance_quantiles" in library.variables and "quantile" in library.variables:
        levels = library["quantile"].values
        values = library["reflectance_quantiles"].transpose(SIGNATURE, "quantile", BAND).values
        if (np.diff(levels) <= 0).any() or levels.min() < 0 or levels.max() > 1:
            yield LibraryFinding("quantiles", f"levels {levels.tolist()}", "ascending, from 0 to 1")
        elif (np.diff(values, axis=1) < 0).any():
            yield LibraryFinding(
                "quantiles", "quantiles decrease with their level", "quantiles that increase"
            )


def _populations(library: xr.Dataset) -> Iterator[LibraryFinding]:
    counts: dict[str, Array] = {
        name: library[name].values for name in ("n", "n_eff") if name in library.variables
    }
    if "n" in counts and (counts["n"] < 1).any():
        yield LibraryFinding("n", f"{counts['n'].min()} pixels", "1 or more")
    if len(counts) == 2 and (counts["n_eff"] > counts["n"] * (1 + 1e-6)).any():
        yield LibraryFinding("n", "more independent pixels than pixels", "n_eff at most n")
    if "member_reflectance" in library.variables:
        members = library["member_reflectance"].transpose(SIGNATURE, "member", BAND)
        if members.sizes["member"] and not np.isfinite(members.values).any():
            yield LibraryFinding(
                "members", "no member has a value", "spectra of single pixels, or no such variable"
            )


def _geometry(library: xr.Dataset) -> Iterator[LibraryFinding]:
    for name, (low, high) in _ANGLES_DEG.items():
        if name in library.variables:
            values = np.asarray(library[name].values, np.float64)
            finite = values[np.isfinite(values)]
            if library[name].attrs.get("units") != "degree" or ((finite < low) | (finite > high)).any():
                found = f"{name} {_extremes(finite)} {library[name].attrs.get('units')}"
                yield LibraryFinding("angles", found, f"{low:g} to {high:g} degree")
    if "time" in library.variables and library["time"].dtype.kind != "M":
        yield LibraryFinding("time", f"dtype {library['time'].dtype}", "datetime64[ns], UTC")
    if "diffuse_fraction" in library.variables:
        share = library["diffuse_fraction"].values
        if ((share < 0) | (share > 1)).any():
            yield LibraryFinding("diffuse-fraction", _extremes(share), "0 to 1")


def _declarations(library: xr.Dataset) -> Iterator[LibraryFinding]:
    version = library.attrs.get(VERSION_NAME)
    if version != VERSION or isinstance(version, bool):
        yield LibraryFinding(
            "version", f"{VERSION_NAME} is {version!r}", f"{VERSION}; hp.io.declare_library sets it"
        )
    title = library.attrs.get("title")
    if not isinstance(title, str) or not title.strip() or len(title) > _MAX_TEXT_CHARS:
        yield LibraryFinding("title", f"title is {title!r:.40}", "a text")
    declared = library_terms(library)
    for term in TERMS:
        words = declared[term.name] if isinstance(declared[term.name], list) else [declared[term.name]]
        expected = f"one of {', '.join(term.words)}" if term.words else f"a text, or {UNKNOWN!r}"
        invalid = {
            str(word)
            for word in words
            if not (isinstance(word, str) and word.strip() and len(word) <= _MAX_TEXT_CHARS)
            or (term.words and word not in term.words)
        }
        if declared[term.name] is None:
            yield LibraryFinding(term.name, "not declared", expected)
        elif invalid:
            yield LibraryFinding(term.name, _listed(sorted(invalid)), expected)
    # specular component that contradicts a quantity
    contradictions = {
        BODY: INCLUDED,
        THROUGH_COAT: INCLUDED,
        OUTSIDE: EXCLUDED,
        "8/d SCI": EXCLUDED,
        "8/d SCE": INCLUDED,
    }
    # both words for every paint: a term is declared for all paints, or has a list
    terms = (declared["quantity"], declared["specular_component"])
    size = max(len(words) if isinstance(words, list) else 1 for words in terms)
    lists = (words if isinstance(words, list) else [words] * size for words in terms)
    for quantity, component in zip(*lists, strict=False):
        if contradictions.get(str(quantity)) == str(component):
            yield LibraryFinding(
                "contradiction", f"{quantity}, specular component {component}", "terms that agree"
            )
            break


def _listed(names: list[str]) -> str:
    text = ", ".join(f"{name!r:.60}" for name in names[:_MAX_NAMES])
    return text if len(names) <= _MAX_NAMES else f"{text} and {len(names) - _MAX_NAMES} more"


def _paints_of(library: xr.Dataset, mask: Array) -> str:
    return _listed([str(name) for name in library[SIGNATURE].values[mask]])


def _extremes(values: Array) -> str:
    with np.errstate(invalid="ignore"):
        return f"{np.nanmin(values):.4g} to {np.nanmax(values):.4g}" if values.size else "none"
