"""Height above ground, swath and pixel aspect of a mapped line; a wrong ground height shows in them."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.errors import PaintWarning
from hyperpaint.base.schema import CROSS_TRACK

# camera above the ground; heights above the sea differ by up to 106 m from heights above the ellipsoid
MIN_HEIGHT_M, MAX_HEIGHT_M = 5.0, 10_000.0
MIN_SWATH_M, MAX_SWATH_M = 4.0, 10_000.0  # full swath of a camera: at least two cars side by side
MAX_ASPECT = 5.0  # longer over shorter side of a pixel; frame rates are set for square pixels
WHOLE_CAMERA_COLUMNS = 200  # narrower lines are crops or examples, whose swath is not checked


def swath_attrs(line: xr.Dataset, across: float, along: float) -> dict[str, float]:
    """Return attributes of a map: ``swath``, ``height_above_ground`` [m] and ``pixel_aspect``, if known.

    Takes a located line and the median distances of its columns and lines [m]. Warns (`PaintWarning`) about
    implausible values.
    """
    attrs = {"swath": across * line.sizes[CROSS_TRACK], "pixel_aspect": along / across}
    ground = line.attrs.get("ground")
    if isinstance(ground, float | int) and "altitude" in line.variables:
        altitude = line["altitude"].values
        attrs["height_above_ground"] = float(np.median(altitude[np.isfinite(altitude)])) - ground
    attrs = {name: float(value) for name, value in attrs.items() if np.isfinite(value)}
    is_complete = line.sizes[CROSS_TRACK] >= WHOLE_CAMERA_COLUMNS
    texts = []
    height = attrs.get("height_above_ground", MIN_HEIGHT_M)
    if not MIN_HEIGHT_M <= height <= MAX_HEIGHT_M:
        texts.append(
            f"the camera is {height:.4g} m above the ground, expected {MIN_HEIGHT_M:g} to {MAX_HEIGHT_M:g} m "
            "(ground is above the ellipsoid, not above the sea)"
        )
    swath = attrs.get("swath", MIN_SWATH_M)
    if is_complete and not MIN_SWATH_M <= swath <= MAX_SWATH_M:
        texts.append(f"the swath is {swath:.3g} m wide, expected {MIN_SWATH_M:g} to {MAX_SWATH_M:g} m")
    aspect = attrs.get("pixel_aspect", 1.0)
    if is_complete and not 1 / MAX_ASPECT <= aspect <= MAX_ASPECT:
        texts.append(
            f"pixels are {aspect:.3g} times as long as wide, expected {1 / MAX_ASPECT:g} to {MAX_ASPECT:g}"
        )
    if texts:
        name = line.attrs.get("name", "this line")
        warnings.warn(
            PaintWarning(f"{name}: {'; '.join(texts)}; check ground and camera", code="swath-implausible"),
            stacklevel=3,
        )
    return attrs


def describe_swath(attrs: dict[Any, Any]) -> str:
    """Return the attributes of `swath_attrs` as one line of text."""
    units = {"height_above_ground": "{:.1f} m above the ground", "swath": "swath {:.1f} m"}
    units["pixel_aspect"] = "pixels {:.2f} times as long as wide"
    return ", ".join(text.format(attrs[name]) for name, text in units.items() if name in attrs)
