"""Populations of spectra behind the factors of a scene: their members, and how they vary in space.

A pixel shows a member of the population of its dominant surface: in the products of its paths, the factor of
this surface is multiplied by member over mean, band by band. Paths are not traced again; light from other
surfaces has their mean spectra. Members are ranked by brightness, and a smooth random field over the surface
gives the rank, so that all members are equally likely and neighbours are similar (`Octaves`).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from hyperpaint.base.arrays import Array, Floats, Floats32
from hyperpaint.simulation.transport.texturing import Grain, Texture, member_rows

from .camera_bands import BandSet
from .painting import FactorSpectra
from .scene_record import SceneRecord
from .scene_spectra import Octaves

#: Minimum mean by which members are divided [1].
_MIN_MEAN = 1e-4

#: Maximum of member over mean [1], which limits noise for a mean near 0.
_MAX_RATIO = 50.0


# Members of all populations of a scene, in the form that mixing of paths needs.
class Populations(NamedTuple):
    grain: Grain
    factor: Array  # (row,) number of the factor that a member changes
    ratio: Floats32  # (row, band) member over mean

    def texture(self, material: Array, instance: Array, position: Array, seed: int) -> Texture:
        # members of pixels at positions (3, line, column) [m]; see `texturing.member_rows`
        return self.of_rows(member_rows(material, instance, position, self.grain, seed))

    def of_rows(self, rows: Array) -> Texture:
        # members of pixels, from their rows (line, column)
        return Texture(rows, self.factor, self.ratio, np.zeros((0, 1), np.int64))


def populations_of(record: SceneRecord, painted: FactorSpectra, bands: BandSet) -> Populations | None:
    """Return the populations of a scene's materials; None if no spectrum has one.

    The mean over the members of a population is the spectrum itself, in every band.
    """
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


def rows_of_pixels(
    material: Array, instance: Array, east: Array, north: Array, up: Array, *, grain: Grain, seed: int
) -> Array:
    """Return the member rows of pixels, (line, column); see `texturing.member_rows`."""
    return member_rows(material, instance, np.stack([east, north, up]), grain, seed)
