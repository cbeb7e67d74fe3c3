"""Which spectrum every factor of a path has: defaults by name, spectra of a user, repainted cars."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import PaintError, Problems, SchemaError
from hyperpaint.base.units import convert

from .camera_bands import BandSet
from .materials import Flakes, measured_factor
from .scene_record import SceneRecord
from .scene_spectra import Spectrum, paint_spec, spectrum_of

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["FactorSpectra", "Table", "factor_spectra"]


@dataclass(frozen=True, eq=False)
class Table:
    """A tabulated spectrum: linear between its points, constant beyond them.

    Attributes
    ----------
    wavelength : (point,)
        Increasing [nm].
    reflectance : (point,)
        [1]
    """

    wavelength: Floats
    reflectance: Floats

    def __call__(self, wavelength: Floats) -> Floats:
        """Return the reflectance at ``wavelength`` [nm]."""
        return np.interp(wavelength, self.wavelength, self.reflectance)


@dataclass(frozen=True, eq=False)
class FactorSpectra:
    """All factors of a scene as functions of wavelength.

    Attributes
    ----------
    names
        Name of the spectrum of every factor.
    coats
        Refractive index of the coat over it; None for bare surfaces and for flakes.
    spectra
        Spectrum by name.
    scales
        What every factor is multiplied by: a paint with more or fewer flakes than was traced.
    clip
        Limit reflectances to 0 to 1.
    """

    names: tuple[str, ...]
    coats: tuple[float | None, ...]
    spectra: Mapping[str, Spectrum]
    scales: tuple[float, ...]
    clip: bool = False

    def __call__(self, wavelength: Floats) -> Floats:
        """Return the factors ``rho'`` at wavelengths [nm], shape (factor, wavelength)."""
        rows_by_key: dict[tuple[str, float | None], Floats] = {}
        for key in zip(self.names, self.coats, strict=True):
            if key not in rows_by_key:
                reflectance = np.broadcast_to(self.spectra[key[0]](wavelength), wavelength.shape)
                rows_by_key[key] = measured_factor(
                    reflectance.clip(0, 1) if self.clip else reflectance, key[1]
                )
        rows = [rows_by_key[key] for key in zip(self.names, self.coats, strict=True)]
        return np.asarray(np.stack(rows) * np.asarray(self.scales)[:, None])


def factor_spectra(
    record: SceneRecord,
    bands: BandSet,
    paints: Mapping[str, Any] | None = None,
    spectra: Mapping[str, Any] | xr.Dataset | None = None,
    *,
    clip: bool = False,
) -> FactorSpectra:
    """Return the spectra of all factors of a scene.

    Parameters
    ----------
    record
        What is known of the scene.
    bands
        Tabulated spectra must cover their centres to half a width; they are constant beyond their ends.
    paints, spectra, clip
        As for `relighting.relight`.

    Raises
    ------
    SchemaError
        Names are unknown, values cannot be read, leave 0 to 1, or do not cover the bands; all are listed.
    """
    problems = Problems("the scene cannot be painted", SchemaError)
    library = {str(name): value for name, value in _library(spectra).items()}
    assigned, scales = _painted(record, dict(paints or {}), library, problems)
    by_name: dict[str, Spectrum] = {}
    for name in dict.fromkeys(assigned):
        spectrum = _spectrum(library.get(name, name), name, problems)
        if spectrum is not None:
            _check_values(name, spectrum, bands, problems, clip=clip)
            by_name[name] = _near_bands(spectrum, bands)
    problems.raise_if_any()
    coats = []
    for factor in record.factors:
        coat = record.materials[factor.material].coat
        coats.append(None if coat is None or factor.flakes else coat.index)
    return FactorSpectra(tuple(assigned), tuple(coats), by_name, tuple(scales), clip)


def _painted(
    record: SceneRecord, paints: dict[str, Any], library: dict[str, Any], problems: Problems
) -> tuple[list[str], list[float]]:
    """Return spectrum and scale of every factor; new spectra are added to ``library``."""
    original = []
    for factor in record.factors:
        material = record.materials[factor.material]
        flakes = material.flakes
        original.append(flakes.spectrum if factor.flakes and flakes is not None else material.spectrum)
    assigned, scales = list(original), [1.0] * len(original)
    instances = [instance.name for instance in record.instances]
    materials = [material.name for material in record.materials]
    rank = {**dict.fromkeys(original, 0), **dict.fromkeys(materials, 1), **dict.fromkeys(instances, 2)}
    for key in paints:
        if key not in rank:
            problems.add(
                f"paints[{key!r}] names no instance, material or spectrum of the scene; "
                f"spectra are {_some(original)}, instances {_some(instances)}"
            )
    for key in sorted((key for key in paints if key in rank), key=rank.__getitem__):
        name = paints[key] if isinstance(paints[key], str) else key
        if not isinstance(paints[key], str):
            library[key] = paints[key]
        if rank[key] == 0:
            chosen = [place for place, spectrum in enumerate(original) if spectrum == key]
        elif rank[key] == 1:
            chosen = [materials.index(key)]
        else:
            chosen = _paint_of(record, instances.index(key), problems)
        for place in chosen:
            assigned[place] = name
            _exchange_flakes(
                record, place, name if isinstance(paints[key], str) else "", assigned, scales, problems
            )
    return assigned, scales


def _exchange_flakes(
    record: SceneRecord, place: int, name: str, assigned: list[str], scales: list[float], problems: Problems
) -> None:
    """Give a repainted base the flakes of its new paint; weights carry the shares that were traced."""
    material = record.factors[place].material
    old = record.materials[material].flakes
    if record.factors[place].flakes or old is None:
        return
    new = _flakes_of(name)
    if old.share >= 1.0:
        problems.add(f"{record.materials[material].name!r} is all flakes and cannot be repainted")
        return
    scales[place] = (1.0 - (new.share if new else 0.0)) / (1.0 - old.share)
    for other, factor in enumerate(record.factors):
        if factor.material == material and factor.flakes:
            scales[other] = new.share / old.share if new else 0.0
            assigned[other] = new.spectrum if new else assigned[other]


def _flakes_of(name: str) -> Flakes | None:
    """Return the flakes of a built-in paint; None for what has none, and for any other spectrum."""
    try:
        return paint_spec(name).flakes
    except SchemaError:
        return None


def _paint_of(record: SceneRecord, instance: int, problems: Problems) -> list[int]:
    """Return the factor that is the paint of an instance."""
    members, name = record.members[instance], record.instances[instance].name
    painted = [number for number in members if record.materials[number].kind == "paint"]
    chosen = painted or list(members)
    if len(chosen) != 1:
        names = _some([record.materials[number].name for number in chosen])
        problems.add(f"paints[{name!r}]: it has {len(chosen)} materials to paint; name one of them: {names}")
        return []
    shared = [
        record.instances[other].name
        for other, numbers in enumerate(record.members)
        if other != instance and chosen[0] in numbers
    ]
    if shared:
        material = record.materials[chosen[0]].name
        problems.add(f"paints[{name!r}]: {_some(shared)} would change too; name the material, {material!r}")
        return []
    return chosen


def _some(names: list[str]) -> str:
    different = list(dict.fromkeys(names))
    return ", ".join(map(repr, different[:12])) + (", ..." if len(different) > 12 else "")


def _library(spectra: Any) -> Mapping[Any, Any]:
    if spectra is None:
        return {}
    if isinstance(spectra, Mapping) and not hasattr(spectra, "data_vars"):
        return spectra
    reflectance = getattr(spectra, "reflectance", None)
    if (
        reflectance is None
        or "paint" not in getattr(reflectance, "dims", ())
        or "paint" not in spectra.coords
    ):
        raise SchemaError(
            "spectra is no mapping of names to spectra, and no library with reflectance(paint, band)"
        )
    return {str(name): reflectance.isel(paint=place) for place, name in enumerate(spectra["paint"].values)}


def _spectrum(value: Any, name: str, problems: Problems) -> Spectrum | None:
    """Return what a user gave for a spectrum as a function."""
    if callable(value) and not hasattr(value, "dims"):
        spectrum: Spectrum = value
        return spectrum
    if isinstance(value, str):
        try:
            return spectrum_of(value)
        except SchemaError as error:
            problems.add(f"{error}; or give it with spectra={{{value!r}: ...}}")
            return None
    try:
        wavelength, reflectance = _columns(value)
    except (PaintError, TypeError, ValueError) as error:
        problems.add(
            f"spectrum {name!r} cannot be read ({error}); expected a name, (wavelength [nm], reflectance), "
            "or a DataArray with a coordinate 'wavelength'"
        )
        return None
    if wavelength.ndim != 1 or wavelength.shape != reflectance.shape or wavelength.size < 2:
        problems.add(
            f"spectrum {name!r} has wavelengths {wavelength.shape} and reflectances {reflectance.shape}, "
            "expected two of the same length, at least 2"
        )
        return None
    if not np.isfinite(wavelength).all() or not (np.diff(wavelength) > 0).all():
        problems.add(f"spectrum {name!r}: wavelengths do not increase; sort them")
        return None
    return Table(wavelength, reflectance)


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
    """Return the part of a table that bands see: what is missing at 1900 nm need not bother them."""
    if not isinstance(spectrum, Table):
        return spectrum
    start = max(int(np.searchsorted(spectrum.wavelength, bands.lowest())) - 1, 0)
    stop = int(np.searchsorted(spectrum.wavelength, bands.highest())) + 1
    return Table(spectrum.wavelength[start:stop], spectrum.reflectance[start:stop])


def _check_values(name: str, spectrum: Spectrum, bands: BandSet, problems: Problems, *, clip: bool) -> None:
    near = _near_bands(spectrum, bands)
    if isinstance(spectrum, Table) and isinstance(near, Table):
        first, last = spectrum.wavelength[[0, -1]]
        low, high = bands.wavelength[[0, -1]]
        if first > low + bands.fwhm[0] / 2 or last < high - bands.fwhm[-1] / 2:
            problems.add(
                f"spectrum {name!r} covers {first:.1f} to {last:.1f} nm, expected the bands, "
                f"{low:.1f} to {high:.1f} nm"
            )
        values = near.reflectance
    else:
        values = np.asarray(spectrum(np.arange(bands.lowest(), bands.highest() + 1.0)), np.float64)
    if not (values.size and np.isfinite(values).all()):
        problems.add(f"spectrum {name!r} holds values that are not finite; cut or fill them first")
    elif not clip and (values.min() < 0.0 or values.max() > 1.0):
        problems.add(
            f"spectrum {name!r} goes from {values.min():.4g} to {values.max():.4g}, expected 0 to 1; "
            "divide per cent by 100, or pass clip=True"
        )
