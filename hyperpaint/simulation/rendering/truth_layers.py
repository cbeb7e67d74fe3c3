"""What is known of every pixel of a rendered scene: what it shows, and where its light came from.

Shares are those of the light that the scene sends to the camera, before the air between: of radiance, mean
over all bands at the wavelengths of the centre column. Light of the sun and of the sky add up to 1; glint,
the mirrored sky and indirect light are parts of them that exclude one another.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hyperpaint.base.arrays import Array, Ints
from hyperpaint.simulation.transport.path_codes import is_direct, is_indirect, is_mirrored

from .materials import KINDS
from .scene_record import SceneRecord
from .scene_spectra import FOURTEEN

__all__ = ["SHARES", "LabelTables", "light_shares", "share_weights"]


SHARES = ("sun_share", "sky_share", "glint_share", "mirrored_sky_share", "indirect_share")
"""Layers that say where the light of a pixel came from."""


@dataclass(frozen=True, eq=False)
class LabelTables:
    """Labels that follow from the material or the instance of a pixel.

    Attributes
    ----------
    surface_class : (material + 1,), int16
        Number of the semantic class; the last entry serves the sky.
    paint_id : (material + 1,), int16
        Number of the paint spectrum; -1 for what is no paint.
    car_id : (instance + 1,), int32
        The instance itself where it is a car, else -1.
    paints
        Names of the paint spectra.
    """

    surface_class: NDArray[np.int16]
    paint_id: NDArray[np.int16]
    car_id: NDArray[np.int32]
    paints: tuple[str, ...]

    @classmethod
    def of(cls, record: SceneRecord, names: Sequence[str] | None = None) -> LabelTables:
        """Return the tables of a scene.

        Parameters
        ----------
        record
            The scene.
        names
            Spectrum of every material, where it is not that of the scene.
        """
        given = [material.spectrum for material in record.materials] if names is None else list(names)
        is_paint = [material.kind == "paint" for material in record.materials]
        # built-in paints first, all of them: a number means the same paint in every scene of a training set
        others = {name for name, paint in zip(given, is_paint, strict=True) if paint}.difference(FOURTEEN)
        paints = (*FOURTEEN, *sorted(others))
        number = [paints.index(name) if paint else -1 for name, paint in zip(given, is_paint, strict=True)]
        cars = np.where(record.is_car, np.arange(len(record.instances)), -1)
        return cls(
            np.append(record.kinds, -1).astype(np.int16),
            np.array([*number, -1], np.int16),
            np.append(cars, -1).astype(np.int32),
            paints,
        )

    def layers(self, material: Array, instance: Array) -> dict[str, Array]:
        """Return the label layers of pixels; -1, the sky, takes the last entry of each table."""
        return {
            "surface_class": self.surface_class[material],
            "paint_id": self.paint_id[material],
            "car_id": self.car_id[instance],
        }

    def attrs(self, name: str) -> dict[str, Any]:
        """Return the CF attributes that say what the numbers of a label layer mean."""
        meanings: Sequence[str]
        if name == "surface_class":
            meanings = KINDS
        elif name == "paint_id":
            meanings = [paint.replace(" ", "_") for paint in self.paints]
        else:
            return {}
        if not meanings:
            return {}
        numbers = np.arange(len(meanings), dtype=np.int16)
        return {"flag_values": numbers, "flag_meanings": " ".join(meanings)}


def share_weights(codes: Ints, level: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return what a path's weight counts for in the whole light and in every share.

    Parameters
    ----------
    codes : (path,)
        Paths.
    level : (path,)
        Mean product of every path over the bands.

    Returns
    -------
    (path, 1 + share), float32
        All light first, then the order of `SHARES`.
    """
    sun, mirrored, indirect = is_direct(codes), is_mirrored(codes), is_indirect(codes)
    mirror_image = mirrored & ~indirect
    parts = [np.ones(codes.shape, bool), sun, ~sun, mirror_image & sun, mirror_image & ~sun, indirect]
    return np.stack([np.where(part, level, 0.0) for part in parts], axis=1).astype(np.float32)


def light_shares(sums: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return shares (line, share, column) of sums (line, 1 + share, column); NaN where there is no light."""
    whole = sums[:, :1]
    return np.divide(sums[:, 1:], whole, out=np.full_like(sums[:, 1:], np.nan), where=whole > 0)
