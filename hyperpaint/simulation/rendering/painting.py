"""Spectra of the factors of paths: defaults by name, spectra of a user, repainted cars, and populations.

Spectra of users are names, tables, functions, or paints of a library with their populations. A pixel shows a
member of the population of its dominant surface: in the products of its paths, the factor of this surface is
multiplied by member over mean, band by band. Paths are not traced again; light from other surfaces has their
mean spectra. Members are ranked by brightness, and a smooth random field over the surface gives the rank, so
that all members are equally likely and neighbours are similar (`Octaves`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Array, Bools, Floats, Floats32
from hyperpaint.base.errors import PaintError, Problems, SchemaError, warn_user
from hyperpaint.base.mirrored_light import INCLUDED, mirror_reflection
from hyperpaint.base.old_names import with_new_names
from hyperpaint.base.schema import BAND, MEMBER, SIGNATURE
from hyperpaint.base.units import convert
from hyperpaint.simulation.camera import BandSet
from hyperpaint.simulation.transport.mixing import Grain, Texture

from .materials import measured_factor
from .scene_record import SceneRecord
from .scene_spectra import MEASURED, Octaves, Spectrum, is_paint, paint_spec, spectrum_of

#: Maximum number of members of a population in a render; more would change its quantiles by less than 0.2 %.
MAX_MEMBERS = 512

#: Maximum excess of measured reflectance beyond 0 or 1 by noise [1]; more is an error of scale or light.
_NOISE = 0.05

_MAX_RANGES_SHOWN = 6

#: Minimum mean by which members are divided [1].
_MIN_MEAN = 1e-4

#: Maximum of member over mean [1], which limits noise for a mean near 0.
_MAX_RATIO = 50.0


# --- spectra of a user -------------------------------------------------------------------------------------


# A tabulated spectrum: linear between its points, constant beyond them
@dataclass(frozen=True, eq=False)
class Table:
    wavelength: Floats  # (point,): increasing wavelengths [nm]
    reflectance: Floats  # (point,): reflectance [1]
    members: Floats | None = None  # (member, point): population [1]; None without a population

    octaves = MEASURED

    def __call__(self, wavelength: Floats) -> Floats:
        return np.interp(wavelength, self.wavelength, self.reflectance)

    def population(self, wavelength: Floats) -> Floats | None:
        # members at ``wavelength`` [nm], (member, wavelength); None without a population
        if self.members is None:
            return None
        return np.stack([np.interp(wavelength, self.wavelength, row) for row in self.members])


def is_library(value: Any) -> bool:
    # whether a value is a dataset with ``reflectance`` (signature, band)
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
    reduced = reduced.assign_coords(
        {name: library[name].variable for name in (("wavelength", "good")) if name in library.variables}
    )
    reduced.attrs = dict(library.attrs)
    return {name: reduced.isel({SIGNATURE: number}) for number, name in enumerate(names)}


def by_name(spectra: Any) -> dict[str, Any]:
    # spectra by name: paints of a library, and paints ``name/paint`` of libraries in a mapping.
    # The paint of a library of one paint in a mapping has the library's name.
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
        self._given, self._bands, self._problems = given, bands, problems
        self._clip, self._hold_edges = clip, hold_edges
        self._clipped: list[str] = []
        self._mirroring: list[str] = []

    def read(self, name: str) -> Spectrum | None:
        # spectrum by name as a function of wavelength; None after a problem
        value, problems, bands = self._given.get(name, name), self._problems, self._bands
        spectrum: Spectrum | None = None
        if isinstance(value, str):
            try:
                spectrum = spectrum_of(value)
            except SchemaError as error:
                library_paints = [key for key in self._given if key.startswith(f"{value}/")]
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
        elif callable(value) and not hasattr(value, "dims"):
            spectrum = value
        if spectrum is not None:
            values = np.asarray(spectrum(np.arange(bands.limits[0], bands.limits[1] + 1.0)), np.float64)
        else:
            try:
                is_dataset = hasattr(value, "data_vars")
                table = self._library_table(value, name) if is_dataset else Table(*_columns(value))
            except (PaintError, TypeError, ValueError) as error:
                problems.add(
                    f"spectrum {name!r} cannot be read: {error}",
                    expected="a name, (wavelength [nm], reflectance), a DataArray with a coordinate "
                    "'wavelength', or a paint library",
                    code="spectrum-unreadable",
                )
                return None
            spectrum = cropped = self._cropped(table, name)
            if cropped is None:
                return None
            values = cropped.reflectance
        if not (values.size and np.isfinite(values).all()):
            problems.add(f"spectrum {name!r} is not finite", mend="fill the gaps", code="not-finite")
        elif not self._clip and (values.min() < 0.0 or values.max() > 1.0):
            problems.add(
                f"spectrum {name!r} ranges from {values.min():.4g} to {values.max():.4g}",
                expected="0 to 1",
                mend="divide per cent by 100, or pass clip=True",
                code="value-out-of-range",
            )
        return spectrum

    def warn(self) -> None:
        for code, names, found in (
            (
                "reflectance-clipped",
                self._clipped,
                f"reflectances of {{}} exceed 0 to 1 by noise, up to {_NOISE:g}; they are clipped for the "
                "render",
            ),
            (
                "mirror-counted-twice",
                self._mirroring,
                "{} contain the mirror reflection of the coat, which the renderer adds again; extract "
                "signatures with specular_sky=True (--specular-sky)",
            ),
        ):
            if names:
                warn_user(found.format(some_names(names)), code)

    def _cropped(self, table: Table, name: str) -> Table | None:
        # usable part of a table in the range of the bands, since gaps elsewhere do not matter
        nm, reflectance, bands, problems = table.wavelength, table.reflectance, self._bands, self._problems
        if nm.ndim != 1 or nm.shape != reflectance.shape or nm.size < 2:
            problems.add(
                f"spectrum {name!r} has wavelengths {nm.shape} and reflectances {reflectance.shape}",
                expected="two arrays of one length, at least 2",
                code="length-mismatch",
            )
            return None
        if not np.isfinite(nm).all() or not (np.diff(nm) > 0).all():
            problems.add(
                f"wavelengths of spectrum {name!r} do not increase",
                mend="sort them",
                code="wavelength-unordered",
            )
            return None
        # values may end up to half a width inside the centres of the outer bands
        first_centre, last_centre = bands.wavelength[[0, -1]]
        first_needed, last_needed = first_centre + bands.fwhm[0] / 2, last_centre - bands.fwhm[-1] / 2
        is_used = np.isfinite(reflectance)
        if not self._hold_edges:
            is_used |= (nm >= first_needed) & (nm <= last_needed)
        if is_used.sum() < 2:
            gaps = _ranges_text(nm, ~np.isfinite(reflectance))
            problems.add(
                f"spectrum {name!r} is not finite at {gaps} nm", mend="fill the gaps", code="not-finite"
            )
            return None
        nm, reflectance = nm[is_used], reflectance[is_used]
        if not self._hold_edges and (nm[0] > first_needed or nm[-1] < last_needed):
            problems.add(
                f"spectrum {name!r} covers {nm[0]:.1f} to {nm[-1]:.1f} nm",
                expected=f"the range of the bands, {first_centre:.1f} to {last_centre:.1f} nm",
                mend="pass hold_edges=True to extend it by its first and last value",
                option="pass --hold-edges to extend it by its first and last value",
                code="spectrum-coverage",
            )
        start = min(max(int(np.searchsorted(nm, bands.limits[0])) - 1, 0), nm.size - 1)
        points = slice(start, max(int(np.searchsorted(nm, bands.limits[1])) + 1, start + 1))
        is_missing = ~np.isfinite(reflectance[points])
        if is_missing.any():
            problems.add(
                f"spectrum {name!r} is not finite at {_ranges_text(nm[points], is_missing)} nm",
                mend="fill the gaps, or pass hold_edges=True to interpolate them",
                option="fill the gaps, or pass --hold-edges to interpolate them",
                code="not-finite",
            )
            return None
        # members without gaps, of which a population has at least two
        members = table.members
        if members is not None:
            members = members[:, is_used]
            members = members[np.isfinite(members).all(axis=1)][:, points]
            members = members if len(members) > 1 else None
        return Table(nm[points], reflectance[points], members)

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


# --- spectra of all factors --------------------------------------------------------------------------------


# All factors of a scene as functions of wavelength
@dataclass(frozen=True, eq=False)
class FactorSpectra:
    names: tuple[str, ...]  # name of the spectrum of every factor
    # refractive index of the coat over every factor; None for bare surfaces and for flakes
    coats: tuple[float | None, ...]
    spectra: Mapping[str, Spectrum]  # spectra by name
    # multiplier of every factor, for paints with another share of flakes than was traced
    scales: tuple[float, ...]
    clip: bool = False  # limit reflectances to 0 to 1

    def __call__(self, wavelength: Floats) -> Floats:
        """Return the factors ``rho'`` at wavelengths [nm], shape (factor, wavelength)."""
        limits = (0.0, 1.0) if self.clip else (-np.inf, np.inf)
        keys = list(zip(self.names, self.coats, strict=True))
        rows = {
            (name, coat): measured_factor(
                np.broadcast_to(self.spectra[name](wavelength), wavelength.shape).clip(*limits), coat
            )
            for name, coat in dict.fromkeys(keys)
        }
        return np.asarray(np.stack([rows[key] for key in keys]) * np.asarray(self.scales)[:, None])


def factor_spectra(
    record: SceneRecord,
    bands: BandSet,
    paints: Mapping[str, Any] | xr.Dataset | None = None,
    spectra: Mapping[str, Any] | xr.Dataset | None = None,
    *,
    clip: bool = False,
    hold_edges: bool = False,
) -> FactorSpectra:
    """Return the spectra of all factors of a scene.

    Parameters
    ----------
    record
        The scene without its geometry.
    bands
        Bands whose centres tabulated spectra must cover to half a width.
    paints, spectra, clip, hold_edges
        As for `relighting.relight`.

    Raises
    ------
    SchemaError
        Names are unknown, values cannot be read, leave 0 to 1, or do not cover the bands; all are listed.
    """
    problems = Problems("the scene cannot be painted", SchemaError)
    library = by_name(spectra)
    targets: Any = {} if paints is None else paints
    if is_library(paints):
        library_paints = by_name(paints)
        library |= library_paints
        targets = assigned_paints(record, list(library_paints))
    assigned, scales = _assign_spectra(record, dict(targets), library, problems)
    reader = SpectrumReader(library, bands, problems, clip=clip, hold_edges=hold_edges)
    spectra_or_none = {name: reader.read(name) for name in dict.fromkeys(assigned)}
    problems.raise_if_any()
    reader.warn()
    spectra_by_name = {name: spectrum for name, spectrum in spectra_or_none.items() if spectrum is not None}
    coats = []
    for factor in record.factors:
        coat = record.materials[factor.material].coat
        coats.append(None if coat is None or factor.flakes else coat.index)
    return FactorSpectra(tuple(assigned), tuple(coats), spectra_by_name, tuple(scales), clip)


def assigned_paints(record: SceneRecord, names: Sequence[str]) -> dict[str, str]:
    """Return the assignment of library paints to spectra, materials and instances of a scene.

    A paint with the name of a spectrum, material or instance of the scene is assigned to it. Other paints are
    assigned in turn, in their order, to the remaining cars.

    Parameters
    ----------
    record
        The scene without its geometry.
    names
        Names of the paints.

    Raises
    ------
    SchemaError
        No paint can be assigned: none has a name of the scene, and the scene has no car.

    Examples
    --------
    >>> from .car_parks import car_park
    >>> record = SceneRecord.of(car_park(length=5.0, width=16.0, neighbours=(), seed=1))
    >>> [instance.paint for instance in record.instances if instance.kind == "car"]
    ['light_blue', 'dark_red', 'yellow', 'white']
    >>> assigned_paints(record, ["yellow", "roof 7"])
    {'yellow': 'yellow', 'car_000': 'roof 7', 'car_001': 'roof 7', 'car_003': 'roof 7'}
    """
    labels = [{material.name, material.spectrum} for material in record.materials]
    cars = {instance.name for instance in record.instances}
    by_name = {name: name for name in names if name in cars.union(*labels)}
    other_paints = [name for name in names if name not in by_name]
    other_cars = [
        instance.name
        for instance, members in zip(record.instances, record.members, strict=True)
        if instance.kind == "car"
        and not by_name.keys() & {instance.name}.union(*(labels[n] for n in members))
    ]
    if other_paints and not other_cars and not by_name:
        raise SchemaError(
            f"the scene has no car for {some_names(other_paints)}",
            mend=f"pass the materials to paint: paints={{{record.materials[0].name!r}: ...}}",
            code="car-missing",
        )
    return by_name | {
        car: other_paints[number % len(other_paints)] for number, car in enumerate(other_cars) if other_paints
    }


def _assign_spectra(
    record: SceneRecord, paints: dict[str, Any], library: dict[str, Any], problems: Problems
) -> tuple[list[str], list[float]]:
    # name of the spectrum, and scale, of every factor; new spectra are added to ``library``
    original = []
    for factor in record.factors:
        material = record.materials[factor.material]
        flakes = material.flakes
        name = material.transmittance if factor.through else material.spectrum
        if factor.flakes and flakes is not None:
            name = flakes.turned if factor.turned else flakes.spectrum
        original.append(name)
    assigned, scales = list(original), [1.0] * len(original)
    instances = [instance.name for instance in record.instances]
    materials = [material.name for material in record.materials]
    rank = {**dict.fromkeys(original, 0), **dict.fromkeys(materials, 1), **dict.fromkeys(instances, 2)}
    for key in paints:
        if key not in rank:
            problems.add(
                f"paints[{key!r}] names no instance, material or spectrum of the scene",
                expected=f"a spectrum such as {some_names(original)}, or an instance such as "
                f"{some_names(instances)}",
                code="paint-target-unknown",
            )
    for key in sorted((key for key in paints if key in rank), key=rank.__getitem__):
        name = paints[key] if isinstance(paints[key], str) else key
        if not isinstance(paints[key], str):
            library[key] = paints[key]
        if rank[key] == 0:
            factor_numbers = [number for number, spectrum in enumerate(original) if spectrum == key]
        elif rank[key] == 1:
            factor_numbers = [materials.index(key)]
        else:
            factor_numbers = _paint_factor(record, instances.index(key), problems)
        # a repainted base gets the flakes of its new paint; scales correct the flake shares in the weights
        for number in factor_numbers:
            assigned[number] = name
            base = record.factors[number].material
            traced_flakes = record.materials[base].flakes
            if record.factors[number].flakes or traced_flakes is None:
                continue
            if traced_flakes.share >= 1.0:
                problems.add(
                    f"{record.materials[base].name!r} has flakes only and cannot be repainted",
                    code="paint-all-flakes",
                )
                continue
            new_flakes = (
                paint_spec(name).flakes if (isinstance(paints[key], str) and is_paint(name)) else None
            )
            scales[number] = (1.0 - (new_flakes.share if new_flakes else 0.0)) / (1.0 - traced_flakes.share)
            for other_number, factor in enumerate(record.factors):
                if factor.material == base and factor.flakes:
                    scales[other_number] = new_flakes.share / traced_flakes.share if new_flakes else 0.0
                    if new_flakes is not None:
                        assigned[other_number] = (
                            new_flakes.turned if factor.turned else ""
                        ) or new_flakes.spectrum
    return assigned, scales


def _paint_factor(record: SceneRecord, instance: int, problems: Problems) -> list[int]:
    # the paint factor of an instance, in a list; an empty list after a problem
    members, name = record.members[instance], record.instances[instance].name
    candidates = [number for number in members if record.materials[number].kind == "paint"] or list(members)
    if len(candidates) != 1:
        names = some_names([record.materials[number].name for number in candidates])
        problems.add(
            f"paints[{name!r}]: {len(candidates)} materials to paint",
            mend=f"choose one of {names}",
            code="paint-target-ambiguous",
        )
        return []
    shared = [
        record.instances[other_instance].name
        for other_instance, numbers in enumerate(record.members)
        if other_instance != instance and candidates[0] in numbers
    ]
    if shared:
        material = record.materials[candidates[0]].name
        problems.add(
            f"paints[{name!r}]: {some_names(shared)} would change too",
            mend=f"use the material, {material!r}",
            code="paint-target-shared",
        )
        return []
    return candidates


# --- populations -------------------------------------------------------------------------------------------


# Members of all populations of a scene, in the form that mixing of paths needs.
class Populations(NamedTuple):
    grain: Grain
    factor: Array  # (row,) number of the factor that a member changes
    ratio: Floats32  # (row, band) member over mean

    def of_rows(self, rows: Array) -> Texture:
        # members of pixels, from their rows (line, column)
        return Texture(rows, self.factor, self.ratio, np.zeros((0, 1), np.int64))


def populations_of(record: SceneRecord, painted: FactorSpectra, bands: BandSet) -> Populations | None:
    # populations of a scene's materials; None if no spectrum has one.
    # The mean over the members of a population is the spectrum itself, in every band.
    count = np.zeros((2, len(record.materials)), np.int64)
    members: list[tuple[Octaves, int, int, Floats]] = []
    for factor_number, (factor, name) in enumerate(zip(record.factors, painted.names, strict=True)):
        spectrum: Any = painted.spectra[name]
        if factor.flakes or factor.through or getattr(spectrum, "population", None) is None:
            continue
        rows = spectrum.population(bands.wavelength)
        if rows is not None:
            members.append((spectrum.octaves, factor.material, factor_number, rows))
    if not members:
        return None
    shape = len(record.materials), max(len(octaves.lengths) for octaves, *_ in members)
    lengths, shares, is_averaged = np.ones(shape), np.zeros(shape), np.zeros(shape[0], bool)
    ratios, factors, first_row = [], [], 0
    for octaves, material, factor_number, rows in members:
        # members over their mean, darkest first
        ratio = np.minimum(np.clip(rows, 0.0, 1.0) / np.maximum(rows.mean(axis=0), _MIN_MEAN), _MAX_RATIO)
        # clipping to 0 and 1 must not change the mean
        ratio /= np.maximum(ratio.mean(axis=0), _MIN_MEAN)
        ratios.append(ratio[np.argsort(rows.mean(axis=1), kind="stable")])
        factors.append(np.full(len(rows), factor_number, np.int64))
        count[:, material] = first_row, len(rows)
        first_row += len(rows)
        lengths[material, : len(octaves.lengths)] = octaves.lengths
        shares[material, : len(octaves.shares)] = octaves.shares
        is_averaged[material] = octaves.is_averaged
    grain = Grain(count[0], count[1], lengths, shares, is_averaged)
    return Populations(grain, np.concatenate(factors), np.concatenate(ratios).astype(np.float32))
