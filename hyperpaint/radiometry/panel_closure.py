"""What a panel says of the scale of a line: known over observed reflectance, band by band."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import PaintWarning, SchemaError

__all__ = ["panel_scale"]


def panel_scale(panel: Mapping[str, Any]) -> Floats:
    """Return known over observed reflectance of a panel, band by band."""
    observed = np.asarray(panel["observed"], np.float64)
    pixels = np.isfinite(observed)
    number = pixels.sum(axis=(0, 2))
    if not number.any():
        raise SchemaError(
            "the panel's region holds no valid pixel; it is saturated, in a gap, or outside the line"
        )
    share = number / (observed.shape[0] * observed.shape[2])
    if (share < 0.5).any():
        text = f"more than half of the panel's pixels are saturated or bad in {(share < 0.5).sum()} bands"
        warnings.warn(text, PaintWarning, stacklevel=2)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(panel["reflectance"] * number / np.where(pixels, observed, 0.0).sum(axis=(0, 2)))
