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
from .scene_spectra import Spectrum, spectrum_of
from .weathering import MEASURED

#: Members of a population that are kept for a render: more would change its quantiles by less than 0.2 %.
MAX_MEMBERS = 512

#: How far noise may take a measured reflectance beyond 0 or 1 [1]; more is an error of scale or of light.
_NOISE = 0.05

_MAX_RANGES_SHOWN = 6


@dataclass(frozen=True, eq=False)
class Table:
    """A tabulated spectrum: linear between its points, constant beyond them.

    Attributes
    ----------
    wavelength : (point,)
        Increasing [nm].
    reflectance : (point,)
        [1]
    members : (member, point)
        Its population; None without [1].
    """

    wavelength: Floats
    reflectance: Floats
    members: Floats | None = None

    octaves = MEASURED

    def __call__(self, wavelength: Floats) -> Floats:
        return np.interp(wavelength, self.wavelength, self.reflectance)

    def population(self, wavelength: Floats) -> Floats | None:
        # Members at ``wavelength`` [nm], (member, wavelength); None without.
        if self.members is None:
            return None
        return np.stack([np.interp(wavelength, self.wavelength, row) for row in self.members])


def is_library(value: Any) -> bool:
    """Return whether a value is a dataset with ``reflectance`` (signature, band)."""
    if not hasattr(value, "data_vars") or "reflectance" not in value:
        return False
    return SIGNATURE in value["reflectance"].dims or "paint" in value["reflectance"].dims  # of 0.2


def _paints_of(library: xr.Dataset) -> dict[str, xr.Dataset]:
    # Each paint has the variables that the renderer needs, lazily. SchemaError: not a library, paints without
    # names, or two that share a name.
    library = with_new_names(library) if is_library(library) else library
    if not is_library(library) or SIGNATURE not in library.variables:
        raise SchemaError(
            f"spectra is {type(library).__name__}",
            expected="a mapping of names to spectra, or a paint library with reflectance (signature, band)",
            code="type-wrong",
        )
    names = [str(name) for name in library[SIGNATURE].values]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise SchemaError(
            f"the library has several paints named {', '.join(map(repr, twice))}",
            mend="rename them, or select one with library.isel(signature=...)",
            code="paint-ambiguous",
        )
    wanted = [name for name in ("reflectance", "member_reflectance") if name in library.variables]
    slim = library[wanted].reset_coords(drop=True)
    about = ("wavelength", "good")
    slim = slim.assign_coords({name: library[name].variable for name in about if name in library.variables})
    slim.attrs = dict(library.attrs)
    return {name: slim.isel({SIGNATURE: place}) for place, name in enumerate(names)}


def by_name(spectra: Any) -> dict[str, Any]:
    """Return spectra by name: paints of a library; a library inside a mapping as ``name/paint``.

    One of a single paint keeps the mapping's name.
    """
    if spectra is None:
        return {}
    if is_library(spectra) or not isinstance(spectra, Mapping):
        library: Any = spectra
        return dict(_paints_of(library))
    named: dict[str, Any] = {}
    for name, value in spectra.items():
        if not is_library(value):
            named[str(name)] = value
            continue
        paints = _paints_of(value)
        single = len(paints) == 1
        named |= {str(name) if single else f"{name}/{paint}": one for paint, one in paints.items()}
    return named


class SpectrumReader:
    """Turns user spectra into functions of wavelength, and collects their problems.

    Parameters
    ----------
    given
        Spectra by name, as `by_name` returns them.
    bands
        That the spectra must cover.
    problems
        Where to add what is wrong.
    clip
        Limit reflectances to 0 to 1 where they would be an error.
    hold_edges
        Hold spectra constant beyond their last good band, and bridge bands without values by straight lines.
    """

    def __init__(
        self, given: Mapping[str, Any], bands: BandSet, problems: Problems, *, clip: bool, hold_edges: bool
    ) -> None:
        self._given, self._bands, self._problems = given, bands, problems
        self._clip, self._hold = clip, hold_edges
        self._clipped: list[str] = []
        self._mirroring: list[str] = []

    def read(self, name: str) -> Spectrum | None:
        # A spectrum by name as a function; None after a problem.
        spectrum = self._spectrum(self._given.get(name, name), name)
        if spectrum is not None:
            self._check_values(name, spectrum)
            return _near_bands(spectrum, self._bands)
        return None

    def warn(self) -> None:
        if self._clipped:
            warnings.warn(
                PaintWarning(
                    f"noise takes reflectances of {some_names(self._clipped)} up to {_NOISE:g} beyond 0 to 1"
                    "; they are clipped for the render",
                    code="reflectance-clipped",
                ),
                stacklevel=4,
            )
        if self._mirroring:
            warnings.warn(
                PaintWarning(
                    f"{some_names(self._mirroring)} contain the mirror reflection of the coat, which the "
                    "renderer adds once more; extract signatures with specular_sky=True (--specular-sky)",
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
                inside = [key for key in self._given if key.startswith(f"{value}/")]
                hint = (
                    f"name one of {some_names(inside)}" if inside else f"or pass spectra={{{value!r}: ...}}"
                )
                problems.add(
                    error.problem.found,
                    mend="; ".join(filter(None, (error.problem.mend, hint))),
                    code="spectrum-unknown",
                )
                return None
        try:
            table = self._measured(value, name) if hasattr(value, "data_vars") else Table(*_columns(value))
        except (PaintError, TypeError, ValueError) as error:
            problems.add(
                f"spectrum {name!r} cannot be read: {error}",
                expected="a name, (wavelength [nm], reflectance), a DataArray with a coordinate "
                "'wavelength', or a paint library",
                code="spectrum-unreadable",
            )
            return None
        return self._checked(table, name)

    def _checked(self, table: Table, name: str) -> Table | None:
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
        used = np.isfinite(reflectance)
        if not self._hold:  # values may end half a width inside of the outer bands' centres
            low, high = self._bands.wavelength[[0, -1]]
            used |= (nm >= low + self._bands.fwhm[0] / 2) & (nm <= high - self._bands.fwhm[-1] / 2)
        if used.sum() < 2:
            where = _runs(nm, ~np.isfinite(reflectance))
            self._problems.add(
                f"spectrum {name!r} is not finite at {where} nm", mend="fill the gaps", code="not-finite"
            )
            return None
        members = None if table.members is None else _whole(table.members[:, used])
        return Table(nm[used], reflectance[used], members)

    def _measured(self, paint: xr.Dataset, name: str) -> Table:
        # Bands in order, NaN in bands that are not good.
        nm, reflectance = _columns(paint["reflectance"])
        order = np.argsort(nm, kind="stable")
        good = np.asarray(paint["good"].values, bool) if "good" in paint.coords else np.ones(nm.size, bool)
        values = np.where(good, reflectance, np.nan)[order]
        members = None
        if "member_reflectance" in paint:
            population = paint["member_reflectance"].transpose(MEMBER, BAND)
            rows = np.asarray(
                (convert(population, "1") if "units" in population.attrs else population).values
            )
            members = np.where(good, rows, np.nan)[:, order].astype(np.float64)
            members = members[np.isfinite(members).any(axis=1)]
            if len(members) > MAX_MEMBERS:  # evenly spaced ones are kept
                members = members[np.linspace(0, len(members) - 1, MAX_MEMBERS).round().astype(np.int64)]
        if mirror_reflection(paint) == INCLUDED:
            self._mirroring.append(name)
        outside = (values < 0.0) | (values > 1.0)
        if outside.any() and bool((np.abs(values[outside] - 0.5) <= 0.5 + _NOISE).all()):
            self._clipped.append(name)
            values = np.clip(values, 0.0, 1.0)
        return Table(nm[order], values, members)

    def _check_values(self, name: str, spectrum: Spectrum) -> None:
        bands, problems = self._bands, self._problems
        near = _near_bands(spectrum, bands)
        if isinstance(spectrum, Table) and isinstance(near, Table):
            first, last = spectrum.wavelength[[0, -1]]
            low, high = bands.wavelength[[0, -1]]
            if not self._hold and (first > low + bands.fwhm[0] / 2 or last < high - bands.fwhm[-1] / 2):
                problems.add(
                    f"spectrum {name!r} covers {first:.1f} to {last:.1f} nm",
                    expected=f"the range of the bands, {low:.1f} to {high:.1f} nm",
                    mend="pass hold_edges=True to hold it constant beyond its ends",
                    option="pass --hold-edges to hold it constant beyond its ends",
                    code="spectrum-coverage",
                )
            values = near.reflectance
            missing = ~np.isfinite(values)
            if missing.any():
                where = _runs(near.wavelength, missing)
                problems.add(
                    f"spectrum {name!r} is not finite at {where} nm",
                    mend="fill the gaps, or pass hold_edges=True to bridge them",
                    option="fill the gaps, or pass --hold-edges to bridge them",
                    code="not-finite",
                )
                return
        else:
            values = np.asarray(spectrum(np.arange(bands.lowest(), bands.highest() + 1.0)), np.float64)
        if not (values.size and np.isfinite(values).all()):
            problems.add(f"spectrum {name!r} is not finite", mend="fill the gaps", code="not-finite")
        elif not self._clip and (values.min() < 0.0 or values.max() > 1.0):
            problems.add(
                f"spectrum {name!r} goes from {values.min():.4g} to {values.max():.4g}",
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


def _near_bands(spectrum: Spectrum, bands: BandSet) -> Spectrum:
    # Gaps out of reach of the bands do not matter.
    if not isinstance(spectrum, Table):
        return spectrum
    last = spectrum.wavelength.size - 1
    start = min(max(int(np.searchsorted(spectrum.wavelength, bands.lowest())) - 1, 0), last)
    near = slice(start, max(int(np.searchsorted(spectrum.wavelength, bands.highest())) + 1, start + 1))
    members = None if spectrum.members is None else _whole(spectrum.members[:, near])
    return Table(spectrum.wavelength[near], spectrum.reflectance[near], members)


def _whole(members: Floats) -> Floats | None:
    # Members without gaps; None for fewer than two.
    whole = members[np.isfinite(members).all(axis=1)]
    return whole if len(whole) > 1 else None


def _runs(wavelength: Floats, missing: Bools) -> str:
    # Wavelengths of missing values, neighbours as ranges.
    edges = np.flatnonzero(np.diff(np.concatenate([[False], missing, [False]]).astype(np.int8)))
    runs = [(wavelength[begin], wavelength[end - 1]) for begin, end in edges.reshape(-1, 2)]
    texts = [f"{low:.1f}" if low == high else f"{low:.1f} to {high:.1f}" for low, high in runs]
    return ", ".join(texts[:_MAX_RANGES_SHOWN]) + (", ..." if len(texts) > _MAX_RANGES_SHOWN else "")


def some_names(names: Iterable[str]) -> str:
    different = list(dict.fromkeys(names))
    return ", ".join(map(repr, different[:12])) + (", ..." if len(different) > 12 else "")
