"""Coloured things whose light reaches others."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Floats

from .cells import CELL
from .model import LIT
from .references import Light, Matches

__all__ = ["coloured", "nearest_coloured"]


RANKS = 4
"""Neighbours of a cell that are kept; one or two of them may be its own body."""
_COLOUR = 0.04
"""How coloured a segment is whose light is looked for, see `coloured` [1]."""
_LEAST_PIXELS = 40
"""Pixels that it has, at least."""


def coloured(spectrum: Floats, light: Light) -> npt.NDArray[np.float64]:
    """Return how coloured spectra are (segment,): what neither light nor grey explains, rms [1].

    Of the channels that are known; 0 where those are too few to tell.
    """
    basis = np.stack([np.ones_like(light.direct), light.diffuse], axis=1)
    known = np.isfinite(spectrum)
    made = np.zeros(len(spectrum))
    for pattern in np.unique(known, axis=0):
        if pattern.sum() <= basis.shape[1]:
            continue
        same = (known == pattern).all(axis=1)
        seen = spectrum[same][:, pattern]
        amounts, *_ = np.linalg.lstsq(basis[pattern], seen.T, rcond=None)
        made[same] = np.sqrt(np.mean((seen - (basis[pattern] @ amounts).T) ** 2, axis=1))
    return made


def nearest_coloured(
    number: npt.NDArray[np.int32],
    size: npt.NDArray[np.int64],
    spectrum: Floats,
    matches: Matches,
    light: Light,
    reach: int,
) -> npt.NDArray[np.int32]:
    """Return the nearest coloured segments (cell_along, cell_cross, rank) that lie in full light.

    Parameters
    ----------
    number : (line, column)
        Segment of every pixel.
    size, spectrum, matches
        Of the segments.
    light
        Parts of the irradiance.
    reach
        How far light is followed [pixel].
    """
    from hyperpaint.kernels.segmentation import nearest_sources

    sends = (coloured(spectrum, light) > _COLOUR) & (matches.state == LIT) & (size >= _LEAST_PIXELS)
    centre = number[CELL // 2 :: CELL, CELL // 2 :: CELL]
    cells = tuple(-(-length // CELL) for length in number.shape)
    labels = np.full((*cells, RANKS), -1, np.int32)
    distances = np.full((*cells, RANKS), np.inf)
    found: Any = np.where(np.append(sends, False)[centre], centre, -1)
    labels[: centre.shape[0], : centre.shape[1], 0] = found
    distances[..., 0] = np.where(labels[..., 0] >= 0, 0.0, np.inf)
    nearest_sources(labels, distances, reach / CELL)
    return labels
