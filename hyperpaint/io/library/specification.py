"""The specification of a paint library (docs/paint-library.md), and the check of a library against it.

What a library must say is said, or said to be unknown: a reader who finds nothing cannot tell which.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Array
from hyperpaint.base.facts import one_of
from hyperpaint.base.mirrored_light import BODY, EXCLUDED, INCLUDED, OUTSIDE, THROUGH_COAT
from hyperpaint.base.old_names import VERSION_NAME, with_new_names
from hyperpaint.base.schema import BAND, LIBRARY_VARIABLES, SIGNATURE

from .spectra_files import CENTRE

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
    findings: list[LibraryFinding] = []
    for rules in (_structure, _paints, _populations, _declarations):
        if findings and rules is _paints:
            break  # the other rules need the structure
        findings += [LibraryFinding(*row) for is_wrong, *row in rules(dataset) if is_wrong]
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
    # Return the declaration of each term: a list with a word for every paint, a word for all, or None.
    attrs = {**library.attrs, **library[CENTRE].attrs}
    return {
        term.name: list(map(str, library[term.name].values.tolist()))
        if term.name in library.variables and library[term.name].dims == (SIGNATURE,)
        else attrs.get(term.name)
        for term in TERMS
    }


# --- the rules ---------------------------------------------------------------------------------------------

#: Whether a library departs from a rule; the name of the rule, the observed and the expected state.
_Row = tuple[bool, str, str, str]


def _structure(library: xr.Dataset) -> Iterator[_Row]:
    for name in (CENTRE, "wavelength", SIGNATURE):
        row = LIBRARY_VARIABLES[name]
        problem = row.dim_problem(library[name]) if name in library.variables else None
        is_missing = name not in library.variables
        found = problem.found if problem else f"{name!r} is missing"
        expected = f"a variable {name} ({', '.join(row.dims)})"
        yield is_missing or problem is not None, "structure", found, expected
    for name, row in LIBRARY_VARIABLES.items():
        if name in library.variables and name not in (CENTRE, "wavelength", SIGNATURE):
            dims = library[name].dims
            is_wrong = row.dim_problem(library[name]) is not None and dims != (SIGNATURE, *row.dims)
            yield is_wrong, "dims", f"{name} has dims {dims}", " or ".join(map(str, row.allowed_dims))


def _paints(library: xr.Dataset) -> Iterator[_Row]:
    # names, bands and reflectance of the paints
    names = library[SIGNATURE].values.tolist()
    invalid = [name for name in names if not isinstance(name, str) or not name.strip()]
    duplicates = sorted({str(name) for name in names if names.count(name) > 1})
    nm = np.asarray(library["wavelength"].values, np.float64)
    nm_units, (low_nm, high_nm) = library["wavelength"].attrs.get("units"), _WAVELENGTH_RANGE_NM
    is_in_range = (
        np.isfinite(nm).all() and nm.min(initial=low_nm) >= low_nm and nm.max(initial=high_nm) <= high_nm
    )
    steps = np.diff(nm)
    yield from (
        (not names, "paint-names", "there is no paint", "at least one"),
        (
            bool(invalid),
            "paint-names",
            f"{len(invalid)} names are empty or not text",
            "a text for every paint",
        ),
        (
            bool(duplicates),
            "paint-names",
            f"{_listed(duplicates)} occur twice",
            "a unique name for every paint",
        ),
        (nm_units != "nm", "wavelength-units", f"units are {nm_units!r}", "'nm'"),
        (not is_in_range, "wavelength-range", _extremes(nm), f"{low_nm:g} to {high_nm:g} nm"),
        (
            not ((steps > 0).all() or (steps < 0).all()),
            "wavelength-order",
            f"{int((steps == 0).sum())} occur twice, or the direction changes",
            "ascending or descending",
        ),
    )
    if "fwhm" in library.variables:
        fwhm, units = np.asarray(library["fwhm"].values, np.float64), library["fwhm"].attrs.get("units")
        is_positive = bool((fwhm[np.isfinite(fwhm)] > 0).all())
        yield units != "nm" or not is_positive, "fwhm", f"{_extremes(fwhm)} {units}", "positive, in nm"
    is_good = np.ones(nm.size, bool)
    if "good" in library.variables:
        dtype, is_good = library["good"].dtype, library["good"].values.astype(bool)
        yield dtype.kind != "b", "good", f"dtype {dtype}", "bool: whether a band is usable"
    reflectance, (low, high) = library[CENTRE], _REFLECTANCE_RANGE
    units = reflectance.attrs.get("units")
    yield units != "1", "reflectance-units", f"units are {units!r}", "'1', a fraction"
    yield reflectance.dtype.kind != "f", "reflectance-dtype", str(reflectance.dtype), "float32 or float64"
    if reflectance.dtype.kind == "f":
        values = reflectance.transpose(SIGNATURE, BAND).values
        with np.errstate(invalid="ignore"):
            outside = ((values < low) | (values > high) | np.isinf(values)) & is_good
        empty = ~np.isfinite(values).any(axis=1)
        outside_paints, empty_paints = (
            _listed([str(name) for name in library[SIGNATURE].values[mask]])
            for mask in (outside.any(axis=1), empty)
        )
        yield (
            bool(outside.any()),
            "reflectance-range",
            f"{_extremes(values[outside])} in {outside_paints}",
            f"{low:g} to {high:g} in good bands",
        )
        yield (
            bool(empty.any()),
            "reflectance-empty",
            f"no value in {empty_paints}",
            "a value in at least one band",
        )


def _populations(library: xr.Dataset) -> Iterator[_Row]:
    # uncertainty, members, and the geometry of light and view
    spreads = {name: library[name] for name in _SPREADS if name in library.variables}
    for name, spread in spreads.items():
        units = spread.attrs.get("units")
        yield bool((spread.values < 0).any()), "uncertainty-sign", f"{name} is negative", "0 or more"
        yield units != "1", "uncertainty-units", f"{name} has units {units!r}", "'1'"
    has_spread = any(np.isfinite(spread.values).any() for spread in spreads.values())
    yield (
        not has_spread and library.attrs.get("uncertainty") != UNKNOWN,
        "uncertainty",
        "neither spread nor uncertainty",
        f"reflectance_u_random, reflectance_u_systematic or reflectance_sd, or uncertainty = {UNKNOWN!r}",
    )
    if "reflectance_quantiles" in library.variables and "quantile" in library.variables:
        levels = library["quantile"].values
        values = library["reflectance_quantiles"].transpose(SIGNATURE, "quantile", BAND).values
        is_wrong = bool((np.diff(levels) <= 0).any() or ((levels < 0) | (levels > 1)).any())
        is_falling = bool((np.diff(values, axis=1) < 0).any()) and not is_wrong
        yield is_wrong, "quantiles", f"levels {levels.tolist()}", "ascending, from 0 to 1"
        yield is_falling, "quantiles", "quantiles decrease with their level", "quantiles that increase"
    counts = {name: library[name].values for name in ("n", "n_eff") if name in library.variables}
    if "n" in counts:
        number = counts["n"]
        yield bool((number < 1).any()), "n", f"{number.min(initial=1)} pixels", "1 or more"
        is_more = bool((counts.get("n_eff", 0) > number * (1 + 1e-6)).any())
        yield is_more, "n", "more independent pixels than pixels", "n_eff at most n"
    if "member_reflectance" in library.variables:
        members = library["member_reflectance"]
        is_empty = bool(members.sizes["member"]) and not np.isfinite(members.values).any()
        expected = "spectra of single pixels, or no such variable"
        yield is_empty, "members", "no member has a value", expected
    for name, (low, high) in _ANGLES_DEG.items():
        if name in library.variables:
            values, units = np.asarray(library[name].values, np.float64), library[name].attrs.get("units")
            finite = values[np.isfinite(values)]
            is_wrong = units != "degree" or bool(((finite < low) | (finite > high)).any())
            yield is_wrong, "angles", f"{name} {_extremes(finite)} {units}", f"{low:g} to {high:g} degree"
    if "time" in library.variables:
        dtype = library["time"].dtype
        yield dtype.kind != "M", "time", f"dtype {dtype}", "datetime64[ns], UTC"
    if "diffuse_fraction" in library.variables:
        share = library["diffuse_fraction"].values
        yield bool(((share < 0) | (share > 1)).any()), "diffuse-fraction", _extremes(share), "0 to 1"


def _declarations(library: xr.Dataset) -> Iterator[_Row]:
    def is_text(word: Any) -> bool:
        return isinstance(word, str) and len(word.strip()) > 0 and len(word) <= _MAX_TEXT_CHARS

    version, title = library.attrs.get(VERSION_NAME), library.attrs.get("title")
    is_version = version == VERSION and not isinstance(version, bool)
    yield (
        not is_version,
        "version",
        f"{VERSION_NAME} is {version!r}",
        f"{VERSION}; hp.io.declare_library sets it",
    )
    yield not is_text(title), "title", f"title is {title!r:.40}", "a text"
    declared = library_terms(library)
    for term in TERMS:
        words = declared[term.name] if isinstance(declared[term.name], list) else [declared[term.name]]
        invalid = {
            str(word) for word in words if not is_text(word) or (term.words and word not in term.words)
        }
        found = "not declared" if declared[term.name] is None else _listed(sorted(invalid))
        expected = f"one of {', '.join(term.words)}" if term.words else f"a text, or {UNKNOWN!r}"
        yield bool(invalid), term.name, found, expected
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
    pairs = [pair for pair in zip(*lists, strict=False) if contradictions.get(str(pair[0])) == str(pair[1])]
    found = "".join(f"{quantity}, specular component {component}" for quantity, component in pairs[:1])
    yield bool(pairs), "contradiction", found, "terms that agree"


def _listed(names: list[str]) -> str:
    text = ", ".join(f"{name!r:.60}" for name in names[:_MAX_NAMES])
    return text if len(names) <= _MAX_NAMES else f"{text} and {len(names) - _MAX_NAMES} more"


def _extremes(values: Array) -> str:
    known = values[~np.isnan(values)]
    return f"{known.min():.4g} to {known.max():.4g}" if known.size else "none"
