"""Spectra from users: names, tables, functions, and paints of a library with their populations."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Bools, Floats
from hyperpaint.base.errors import PaintError, PaintWarning, Problems, SchemaError
from hyperpaint.base.mirrored_light import INCLUDED, mirror_reflection
from hyperpaint.base.old_names import with_new_names
from hyperpaint.base.schema import BAND, MEMBER, SIGNATURE
from hyperpaint.base.units import convert

from .camera_bands import BandSet
from .scene_spectra import MEASURED, Spectrum, spectrum_of

#: Maximum number of members of a population in a render; more would change its quantiles by less than 0.2 %.
MAX_MEMBERS = 512

#: Maximum excess of measured reflectance beyond 0 or 1 by noise [1]; more is an error of scale or light.
_NOISE = 0.05

_MAX_RANGES_SHOWN = 6


@dataclass(frozen=True, eq=False)
class Table:
    """A tabulated spectrum: linear between its points, constant beyond them.

    Attributes
    ----------
    wavelength : (point,)
        Increasing wavelengths [nm].
    reflectance : (point,)
        Reflectance [1].
    members : (member, point)
        Population [1]; None without a population.
    """

    wavelength: Floats
    reflectance: Floats
    members: Floats | None = None

    octaves = MEASURED

    def __call__(self, wavelength: Floats) -> Floats:
        return np.interp(wavelength, self.wavelength, self.reflectance)

    def population(self, wavelength: Floats) -> Floats | None:
        # members at ``wavelength`` [nm], (member, wavelength); None without a population
        if self.members is None:
            return None
        return np.stack([np.interp(wavelength, self.wavelength, row) for row in self.members])


def is_library(value: Any) -> bool:
    """Return whether a value is a dataset with ``reflectance`` (signature, band)."""
    if not hasattr(value, "data_vars") or "reflectance" not in value:
        return False
    # "paint" is the dim in libraries of version 0.2
    return SIGNATURE in value["reflectance"].dims or "paint" in value["reflectance"].dims


def _paints_by_name(library: xr.Dataset) -> dict[str, xr.Dataset]:
    # paints of a library by name, lazily, with the variables that the renderer needs; SchemaError for other
    # datasets, and for paints without or with equal names
    library = with_new_names(library) if is_library(library) else library
    if not is_library(library) or SIGNATURE not in library.variables:
        raise SchemaError(
            f"spectra is {type(library).__name__}",
            expected="a mapping of names to spectra, or a paint library with reflectance (signature, band)",
            code="type-wrong",
        )
    names = [str(name) for name in library[SIGNATURE].values]
    if duplicates := sorted({name for name in names if names.count(name) > 1}):
        raise SchemaError(
            f"the library has several paints named {', '.join(map(repr, duplicates))}",
            mend="rename them, or select one with library.isel(signature=...)",
            code="paint-ambiguous",
        )
    variables = [name for name in ("reflectance", "member_reflectance") if name in library.variables]
    reduced = library[variables].reset_coords(drop=True)
    coords = ("wavelength", "good")
    reduced = reduced.assign_coords(
        {name: library[name].variable for name in coords if name in library.variables}
    )
    reduced.attrs = dict(library.attrs)
    return {name: reduced.isel({SIGNATURE: number}) for number, name in enumerate(names)}


def by_name(spectra: Any) -> dict[str, Any]:
    """Return spectra by name: paints of a library, and paints ``name/paint`` of libraries in a mapping.

    The paint of a library of one paint in a mapping has the library's name.
    """
    if spectra is None:
        return {}
    if is_library(spectra) or not isinstance(spectra, Mapping):
        library: Any = spectra
        return dict(_paints_by_name(library))
    by_key: dict[str, Any] = {}
    for name, value in spectra.items():
        if not is_library(value):
            by_key[str(name)] = value
            continue
        paints = _paints_by_name(value)
        is_single = len(paints) == 1
        by_key |= {
            str(name) if is_single else f"{name}/{paint}": spectrum for paint, spectrum in paints.items()
        }
    return by_key


class SpectrumReader:
    """Turns user spectra into functions of wavelength, and collects their problems.

    Parameters
    ----------
    given
        Spectra by name, from `by_name`.
    bands
        Bands that the spectra must cover.
    problems
        List to which problems are added.
    clip
        Limit reflectances to 0 to 1 instead of an error.
    hold_edges
        Extend spectra by their first and last good value, and interpolate bands without a value.
    """

    def __init__(
        self, given: Mapping[str, Any], bands: BandSet, problems: Problems, *, clip: bool, hold_edges: bool
    ) -> None:
        self._spectra_by_name, self._bands, self._problems = given, bands, problems
        self._clip, self._hold_edges = clip, hold_edges
        self._clipped: list[str] = []
        self._mirroring: list[str] = []

    def read(self, name: str) -> Spectrum | None:
        # spectrum by name as a function of wavelength; None after a problem
        spectrum = self._spectrum(self._spectra_by_name.get(name, name), name)
        if spectrum is not None:
            self._check_values(name, spectrum)
            return _crop_to_bands(spectrum, self._bands)
        return None

    def warn(self) -> None:
        if self._clipped:
            warnings.warn(
                PaintWarning(
                    f"reflectances of {some_names(self._clipped)} exceed 0 to 1 by noise, up to {_NOISE:g}; "
                    "they are clipped for the render",
                    code="reflectance-clipped",
                ),
                stacklevel=4,
            )
        if self._mirroring:
            warnings.warn(
                PaintWarning(
                    f"{some_names(self._mirroring)} contain the mirror reflection of the coat, which the "
                    "renderer adds again; extract signatures with specular_sky=True (--specular-sky)",
                    code="mirror-counted-twice",
                ),
                stacklevel=4,
            )

    def _spectrum(self, value: Any, name: str) -> Spectrum | None:
        problems = self._problems
        if callable(value) and not hasattr(value, "dims"):
            spectrum: Spectrum = value
            return spectrum
        if isinstance(value, str):
            try:
                return spectrum_of(value)
            except SchemaError as error:
                library_paints = [key for key in self._spectra_by_name if key.startswith(f"{value}/")]
                hint = (
                    f"choose one of {some_names(library_paints)}"
                    if library_paints
                    else f"or pass spectra={{{value!r}: ...}}"
                )
                problems.add(
                    error.problem.found,
                    mend="; ".join(filter(None, (error.problem.mend, hint))),
                    code="spectrum-unknown",
                )
                return None
        try:
            table = (
                self._library_table(value, name) if hasattr(value, "data_vars") else Table(*_columns(value))
            )
        except (PaintError, TypeError, ValueError) as error:
            problems.add(
                f"spectrum {name!r} cannot be read: {error}",
                expected="a name, (wavelength [nm], reflectance), a DataArray with a coordinate "
                "'wavelength', or a paint library",
                code="spectrum-unreadable",
            )
            return None
        return self._check_table(table, name)

    def _check_table(self, table: Table, name: str) -> Table | None:
        nm, reflectance = table.wavelength, table.reflectance
        if nm.ndim != 1 or nm.shape != reflectance.shape or nm.size < 2:
            self._problems.add(
                f"spectrum {name!r} has wavelengths {nm.shape} and reflectances {reflectance.shape}",
                expected="two arrays of one length, at least 2",
                code="length-mismatch",
            )
            return None
        if not np.isfinite(nm).all() or not (np.diff(nm) > 0).all():
            self._problems.add(
                f"wavelengths of spectrum {name!r} do not increase",
                mend="sort them",
                code="wavelength-unordered",
            )
            return None
        is_used = np.isfinite(reflectance)
        if not self._hold_edges:  # values may end up to half a width inside the centres of the outer bands
            first_centre, last_centre = self._bands.wavelength[[0, -1]]
            is_used |= (nm >= first_centre + self._bands.fwhm[0] / 2) & (
                nm <= last_centre - self._bands.fwhm[-1] / 2
            )
        if is_used.sum() < 2:
            gaps = _ranges_text(nm, ~np.isfinite(reflectance))
            self._problems.add(
                f"spectrum {name!r} is not finite at {gaps} nm", mend="fill the gaps", code="not-finite"
            )
            return None
        members = None if table.members is None else _complete_members(table.members[:, is_used])
        return Table(nm[is_used], reflectance[is_used], members)

    def _library_table(self, paint: xr.Dataset, name: str) -> Table:
        # table of a library paint: bands by wavelength, NaN in bands that are not good
        nm, reflectance = _columns(paint["reflectance"])
        order = np.argsort(nm, kind="stable")
        is_good = np.asarray(paint["good"].values, bool) if "good" in paint.coords else np.ones(nm.size, bool)
        values = np.where(is_good, reflectance, np.nan)[order]
        members = None
        if "member_reflectance" in paint:
            population = paint["member_reflectance"].transpose(MEMBER, BAND)
            rows = np.asarray(
                (convert(population, "1") if "units" in population.attrs else population).values
            )
            members = np.where(is_good, rows, np.nan)[:, order].astype(np.float64)
            members = members[np.isfinite(members).any(axis=1)]
            if len(members) > MAX_MEMBERS:  # keep evenly spaced members
                members = members[np.linspace(0, len(members) - 1, MAX_MEMBERS).round().astype(np.int64)]
        if mirror_reflection(paint) == INCLUDED:
            self._mirroring.append(name)
        is_outside = (values < 0.0) | (values > 1.0)
        if is_outside.any() and bool((np.abs(values[is_outside] - 0.5) <= 0.5 + _NOISE).all()):
            self._clipped.append(name)
            values = np.clip(values, 0.0, 1.0)
        return Table(nm[order], values, members)

    def _check_values(self, name: str, spectrum: Spectrum) -> None:
        bands, problems = self._bands, self._problems
        cropped = _crop_to_bands(spectrum, bands)
        if isinstance(spectrum, Table) and isinstance(cropped, Table):
            first_nm, last_nm = spectrum.wavelength[[0, -1]]
            first_centre, last_centre = bands.wavelength[[0, -1]]
            if not self._hold_edges and (
                first_nm > first_centre + bands.fwhm[0] / 2 or last_nm < last_centre - bands.fwhm[-1] / 2
            ):
                problems.add(
                    f"spectrum {name!r} covers {first_nm:.1f} to {last_nm:.1f} nm",
                    expected=f"the range of the bands, {first_centre:.1f} to {last_centre:.1f} nm",
                    mend="pass hold_edges=True to extend it by its first and last value",
                    option="pass --hold-edges to extend it by its first and last value",
                    code="spectrum-coverage",
                )
            values = cropped.reflectance
            is_missing = ~np.isfinite(values)
            if is_missing.any():
                gaps = _ranges_text(cropped.wavelength, is_missing)
                problems.add(
                    f"spectrum {name!r} is not finite at {gaps} nm",
                    mend="fill the gaps, or pass hold_edges=True to interpolate them",
                    option="fill the gaps, or pass --hold-edges to interpolate them",
                    code="not-finite",
                )
                return
        else:
            values = np.asarray(spectrum(np.arange(bands.lowest(), bands.highest() + 1.0)), np.float64)
        if not (values.size and np.isfinite(values).all()):
            problems.add(f"spectrum {name!r} is not finite", mend="fill the gaps", code="not-finite")
        elif not self._clip and (values.min() < 0.0 or values.max() > 1.0):
            problems.add(
                f"spectrum {name!r} ranges from {values.min():.4g} to {values.max():.4g}",
                expected="0 to 1",
                mend="divide per cent by 100, or pass clip=True",
                code="value-out-of-range",
            )


def _columns(value: Any) -> tuple[Floats, Floats]:
    if hasattr(value, "dims"):
        if "wavelength" not in value.coords:
            raise ValueError("it has no coordinate 'wavelength'")
        axis = value["wavelength"]
        axis = convert(axis, "nm") if "units" in axis.attrs else axis
        values = convert(value, "1") if "units" in value.attrs else value
        return np.asarray(axis.values, np.float64), np.asarray(values.values, np.float64)
    wavelength, reflectance = value
    return np.asarray(wavelength, np.float64), np.asarray(reflectance, np.float64)


def _crop_to_bands(spectrum: Spectrum, bands: BandSet) -> Spectrum:
    # crop a table to the range of the bands, since gaps elsewhere do not matter
    if not isinstance(spectrum, Table):
        return spectrum
    last_point = spectrum.wavelength.size - 1
    start = min(max(int(np.searchsorted(spectrum.wavelength, bands.lowest())) - 1, 0), last_point)
    points = slice(start, max(int(np.searchsorted(spectrum.wavelength, bands.highest())) + 1, start + 1))
    members = None if spectrum.members is None else _complete_members(spectrum.members[:, points])
    return Table(spectrum.wavelength[points], spectrum.reflectance[points], members)


def _complete_members(members: Floats) -> Floats | None:
    # members without gaps; None for fewer than two
    complete = members[np.isfinite(members).all(axis=1)]
    return complete if len(complete) > 1 else None


def _ranges_text(wavelength: Floats, is_missing: Bools) -> str:
    # wavelengths of missing values as text, with ranges of neighbours
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_missing, [False]]).astype(np.int8)))
    runs = [(wavelength[begin], wavelength[end - 1]) for begin, end in edges.reshape(-1, 2)]
    texts = [
        f"{first_nm:.1f}" if first_nm == last_nm else f"{first_nm:.1f} to {last_nm:.1f}"
        for first_nm, last_nm in runs
    ]
    return ", ".join(texts[:_MAX_RANGES_SHOWN]) + (", ..." if len(texts) > _MAX_RANGES_SHOWN else "")


def some_names(names: Iterable[str]) -> str:
    different = list(dict.fromkeys(names))
    return ", ".join(map(repr, different[:12])) + (", ..." if len(different) > 12 else "")
