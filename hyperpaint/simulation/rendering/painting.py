"""Which spectrum every factor of a path has: defaults by name, spectra of a user, repainted cars."""

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
        What is known of the scene.
    bands
        Tabulated spectra must cover their centres to half a width; they are constant beyond their ends.
    paints, spectra, clip, hold_edges
        As for `relighting.relight`.

    Raises
    ------
    SchemaError
        Names are unknown, values cannot be read, leave 0 to 1, or do not cover the bands; all are listed.
    """
    problems = Problems("the scene cannot be painted", SchemaError)
    library = by_name(spectra)
    wanted: Any = {} if paints is None else paints
    if is_library(paints):
        dealt = by_name(paints)
        library |= dealt
        wanted = dealt_paints(record, list(dealt))
    assigned, scales = _painted(record, dict(wanted), library, problems)
    reader = SpectrumReader(library, bands, problems, clip=clip, hold_edges=hold_edges)
    read = {name: reader.read(name) for name in dict.fromkeys(assigned)}
    problems.raise_if_any()
    reader.warn()
    spectra_by_name = {name: spectrum for name, spectrum in read.items() if spectrum is not None}
    coats = []
    for factor in record.factors:
        coat = record.materials[factor.material].coat
        coats.append(None if coat is None or factor.flakes else coat.index)
    return FactorSpectra(tuple(assigned), tuple(coats), spectra_by_name, tuple(scales), clip)


def dealt_paints(record: SceneRecord, names: Sequence[str]) -> dict[str, str]:
    """Return the assignment of library paints to spectra, materials and instances of a scene.

    A paint that is called like a spectrum, a material or a thing of the scene goes there. The others are
    dealt in turn, in their order, to the cars that none has gone to.

    Parameters
    ----------
    record
        What is known of the scene.
    names
        Of the paints.

    Raises
    ------
    SchemaError
        No paint goes anywhere: none has a name of the scene, which has no car.

    Examples
    --------
    >>> from .car_parks import car_park
    >>> record = SceneRecord.of(car_park(length=5.0, width=16.0, neighbours=(), seed=1))
    >>> [one.paint for one in record.instances if one.kind == "car"]
    ['light_blue', 'dark_red', 'yellow', 'white']
    >>> dealt_paints(record, ["yellow", "roof 7"])
    {'yellow': 'yellow', 'car_000': 'roof 7', 'car_001': 'roof 7', 'car_003': 'roof 7'}
    """
    labels = [{material.name, material.spectrum} for material in record.materials]
    cars = {instance.name for instance in record.instances}
    dealt = {name: name for name in names if name in cars.union(*labels)}
    rest = [name for name in names if name not in dealt]
    free = [
        instance.name
        for instance, members in zip(record.instances, record.members, strict=True)
        if instance.kind == "car" and not dealt.keys() & {instance.name}.union(*(labels[n] for n in members))
    ]
    if rest and not free and not dealt:
        raise SchemaError(
            f"the scene has no car for {some_names(rest)}",
            mend=f"name the materials to paint: paints={{{record.materials[0].name!r}: ...}}",
            code="car-missing",
        )
    return dealt | {car: rest[number % len(rest)] for number, car in enumerate(free) if rest}


def _painted(
    record: SceneRecord, paints: dict[str, Any], library: dict[str, Any], problems: Problems
) -> tuple[list[str], list[float]]:
    # Spectrum and scale of every factor; new spectra are added to ``library``.
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
    # A repainted base gets the flakes of its new paint; path weights contain the traced flake shares.
    material = record.factors[place].material
    old = record.materials[material].flakes
    if record.factors[place].flakes or old is None:
        return
    try:
        new = paint_spec(name).flakes
    except SchemaError:
        new = None
    if old.share >= 1.0:
        problems.add(
            f"{record.materials[material].name!r} has flakes only and cannot be repainted",
            code="paint-all-flakes",
        )
        return
    scales[place] = (1.0 - (new.share if new else 0.0)) / (1.0 - old.share)
    for other, factor in enumerate(record.factors):
        if factor.material == material and factor.flakes:
            scales[other] = new.share / old.share if new else 0.0
            if new is not None:
                assigned[other] = new.turned if factor.turned and new.turned else new.spectrum


def _paint_of(record: SceneRecord, instance: int, problems: Problems) -> list[int]:
    # The paint factor in a list; an empty one after a problem.
    members, name = record.members[instance], record.instances[instance].name
    chosen = [number for number in members if record.materials[number].kind == "paint"] or list(members)
    if len(chosen) != 1:
        names = some_names([record.materials[number].name for number in chosen])
        problems.add(
            f"paints[{name!r}]: {len(chosen)} materials to paint",
            mend=f"name one of {names}",
            code="paint-target-ambiguous",
        )
        return []
    shared = [
        record.instances[other].name
        for other, numbers in enumerate(record.members)
        if other != instance and chosen[0] in numbers
    ]
    if shared:
        material = record.materials[chosen[0]].name
        problems.add(
            f"paints[{name!r}]: {some_names(shared)} would change too",
            mend=f"name the material, {material!r}",
            code="paint-target-shared",
        )
        return []
    return chosen
