"""Flags of lines that nobody has looked at yet: one survey, then flags, before signatures and reports."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from hyperpaint.base.schema import Quality
from hyperpaint.radiometry.bands import to_nominal

from . import SceneModel, survey
from .flags import LAYERS, flag

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Flagged", "flag_line", "is_flagged"]

_LOOKED_FOR = Quality.GLINT | Quality.SHADOW | Quality.ADJACENCY | Quality.MIXED_EDGE
_LIMITS = ("glint", "shadow", "adjacency", "edge")
_SMILE = 1.0
"""Wavelength shift above which spectra are compared at nominal wavelengths [nm], see `hyperpaint.flag`."""


@dataclass(frozen=True)
class Flagged:
    """A line with its flags.

    Attributes
    ----------
    line
        The line with ``quality``, and the layers its bits are set from, lazy.
    seen
        The line as it was looked at, with the model that holds for it.
    model
        From `hyperpaint.survey`.
    """

    line: xr.Dataset
    seen: xr.Dataset
    model: SceneModel


def is_flagged(line: xr.Dataset) -> bool:
    """Tell whether somebody has looked for glint, shadow, adjacency or mixed edges.

    Reads ``quality``, where its attributes do not say so.
    """
    if "quality" not in line.variables:
        return False
    quality = line["quality"]
    return "flags_from" in quality.attrs or bool((quality & np.uint16(_LOOKED_FOR)).any())


def flag_line(
    line: xr.Dataset, *, progress: Callable[[int, int], None] | None = None, **options: Any
) -> Flagged:
    """Survey a line, and flag it.

    Parameters
    ----------
    line
        With ``reflectance``. Where its smile is above 1 nm, spectra are brought to nominal wavelengths first.
    progress
        Called with lines surveyed and to do; flags are lazy.
    **options
        Thresholds of `hyperpaint.flag`, and options of `hyperpaint.survey`.

    Raises
    ------
    MissingExtraError, SchemaError, UnitsError
        As `hyperpaint.flag` and `hyperpaint.survey`.
    """
    seen = to_nominal(line) if _has_smile(line) else line
    limits = {name: options.pop(name) for name in _LIMITS if name in options}
    model = survey(seen, progress=progress, **options)
    flagged = flag(seen, model, **limits)
    return Flagged(line.assign({name: flagged[name] for name in ("quality", *LAYERS)}), seen, model)


def _has_smile(line: xr.Dataset) -> bool:
    if "wavelength_shift" not in line.variables:
        return False
    return bool((np.abs(line["wavelength_shift"].values) > _SMILE).any())
