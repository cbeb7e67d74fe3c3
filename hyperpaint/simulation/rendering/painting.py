"""Spectra of the factors of paths: defaults by name, spectra of a user, repainted cars."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import Problems, SchemaError

from .camera_bands import BandSet
from .given_spectra import SpectrumReader, by_name, is_library, some_names
from .materials import measured_factor
from .scene_record import SceneRecord
from .scene_spectra import Spectrum, paint_spec


@dataclass(frozen=True, eq=False)
class FactorSpectra:
    """All factors of a scene as functions of wavelength.

    Attributes
    ----------
    names
        Name of the spectrum of every factor.
    coats
        Refractive index of the coat over every factor; None for bare surfaces and for flakes.
    spectra
        Spectra by name.
    scales
        Multiplier of every factor, for paints with another share of flakes than was traced.
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
        for number in factor_numbers:
            assigned[number] = name
            _exchange_flakes(
                record, number, name if isinstance(paints[key], str) else "", assigned, scales, problems
            )
    return assigned, scales


def _exchange_flakes(
    record: SceneRecord,
    factor_number: int,
    name: str,
    assigned: list[str],
    scales: list[float],
    problems: Problems,
) -> None:
    # give a repainted base the flakes of its new paint; scales correct the flake shares in the path weights
    material = record.factors[factor_number].material
    traced_flakes = record.materials[material].flakes
    if record.factors[factor_number].flakes or traced_flakes is None:
        return
    try:
        new_flakes = paint_spec(name).flakes
    except SchemaError:
        new_flakes = None
    if traced_flakes.share >= 1.0:
        problems.add(
            f"{record.materials[material].name!r} has flakes only and cannot be repainted",
            code="paint-all-flakes",
        )
        return
    scales[factor_number] = (1.0 - (new_flakes.share if new_flakes else 0.0)) / (1.0 - traced_flakes.share)
    for other_number, factor in enumerate(record.factors):
        if factor.material == material and factor.flakes:
            scales[other_number] = new_flakes.share / traced_flakes.share if new_flakes else 0.0
            if new_flakes is not None:
                assigned[other_number] = (
                    new_flakes.turned if factor.turned and new_flakes.turned else new_flakes.spectrum
                )


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
