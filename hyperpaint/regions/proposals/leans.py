"""Lean of a roof towards the sun: its prior uncertainty, and its estimate from a height model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import dask
import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Array, Bools, Floats
from hyperpaint.base.schema import ALONG_TRACK, CROSS_TRACK


@dataclass(frozen=True)
class LeanRules:
    """Thresholds of leans of roofs, and of height models."""

    #: Unknown lean across a car, where its symmetric roof would be level on level ground [degree]. Parking
    #: areas are drained over slopes of 1 to 1.5 % (0.6 to 0.9 degrees), of which one of two components is
    #: towards the sun.
    roll_deg: float = 0.5
    #: Unknown lean along the car, where a roof of 6 m radius may also be highest 7 cm from its middle
    #: [degree].
    rake_deg: float = 0.8
    #: Minimum height of a roof above its surroundings in a height model that shows cars and not bare ground;
    #: cars are at least 1.4 m high [m].
    min_above_m: float = 0.7
    around_px: int = 25  #: Margin around a roof that contains ground [pixel].
    #: Correlation length of height errors [m]: photogrammetry matches patches.
    patch_m: float = 0.15
    floor_deg: float = 0.3  #: Standard deviation of the tilt error of the height model itself [degree].
    min_px: int = 40  #: Minimum number of pixels with a height.
    min_side_px: int = 4  #: Minimum number of lines, and of columns, with such pixels.


LEANS = LeanRules()


class HeightModel(NamedTuple):
    """Height of the surface in every pixel."""

    height: Array  #: (line, column) [m].
    spacing: float  #: Distance between neighbouring pixels [m].


class Lean(NamedTuple):
    """Lean of a roof towards the sun."""

    sd: float  #: Standard deviation of its unknown part [degree].
    #: (2,): Lines and columns from the centre of the roof to where it is level along the sun's direction.
    shift: Floats
    #: Lean in the centre, positive where the roof faces the sun [degree]; NaN if not measured.
    angle: float = np.nan


def height_model_of(line: xr.Dataset) -> HeightModel | None:
    """Return the height model of a line; None without heights.

    The heights are ``east``, ``north`` and ``ground_height`` from `hyperpaint.geometry.locate` with a ``dem``
    of surfaces.
    """
    names, dims = ("east", "north", "ground_height"), (ALONG_TRACK, CROSS_TRACK)
    if not all(name in line.variables and set(line[name].dims) == set(dims) for name in names):
        return None
    east, north, height = dask.compute(*(line[name].transpose(*dims).data for name in names))
    steps = [np.hypot(np.diff(east, axis=axis), np.diff(north, axis=axis)) for axis in (0, 1)]
    spacings = np.concatenate([step[np.isfinite(step)] for step in steps])
    if not spacings.size or not float(np.median(spacings)) > 0.0:
        return None
    return HeightModel(np.asarray(height, np.float64), float(np.median(spacings)))


def lean_to_sun(axis: Floats, shadow_side: Floats | None) -> float:
    """Return the standard deviation of the unknown lean of a roof towards the sun [degree].

    Takes ``axis`` (2,): unit vector (line, column) along the car; ``shadow_side`` (2,): direction of shadows,
    or None where it is unknown.
    """
    along = 1.0 if shadow_side is None else float(abs(axis @ shadow_side))
    return float(np.hypot(LEANS.rake_deg * along, LEANS.roll_deg * np.sqrt(max(1.0 - along**2, 0.0))))


def measured_lean(
    model: HeightModel | None,
    window: tuple[slice, slice],
    inside: Bools,
    centre: tuple[float, float],
    prior: float,
    shadow_side: Floats | None,
) -> Lean:
    r"""Return the lean of a roof from its heights; the prior where no height model shows the car.

    A polynomial of second order through the heights of the roof,

    .. math:: z = z_0 + b \cdot p + p^T H p / 2,

    with p [pixel] from its centre, has the slope :math:`b \cdot s` towards the sun s, and is level
    :math:`- (b \cdot s) / (s^T H s)` pixels in that direction. The prior lean, 0 with the standard deviation
    ``prior``, and the fitted lean are weighted by their inverse variances.

    Takes ``window``: the part of the picture with the roof; ``inside`` (line, column): its pixels there;
    ``centre``: line and column in the window; ``prior`` [degree]; ``shadow_side`` (2,): see `lean_to_sun`.
    """
    prior_lean = Lean(prior, np.zeros(2))
    if model is None or shadow_side is None:
        return prior_lean
    height = model.height[window]
    valid = inside & np.isfinite(height)
    if (
        valid.sum() < LEANS.min_px
        or min(valid.any(axis=0).sum(), valid.any(axis=1).sum()) < LEANS.min_side_px
    ):
        return prior_lean
    if not _stands_above_ground(model, window, height[valid]):
        return prior_lean
    rows, columns = np.nonzero(valid)
    y, x = rows - centre[0], columns - centre[1]
    terms = np.stack([np.ones(y.size), y, x, 0.5 * y * y, y * x, 0.5 * x * x], axis=1)
    fitted = np.linalg.lstsq(terms, height[valid], rcond=None)[0]
    residuals = height[valid] - terms @ fitted
    # the height errors within one patch are correlated
    patch_px = max(1.0, (LEANS.patch_m / model.spacing) ** 2)
    covariance = (
        np.linalg.pinv(terms.T @ terms) * float(residuals @ residuals) / (y.size - terms.shape[1]) * patch_px
    )
    sun = -shadow_side
    slope = float(fitted[1:3] @ sun) / model.spacing
    slope_sd = float(np.sqrt(sun @ covariance[1:3, 1:3] @ sun)) / model.spacing
    sd = float(np.hypot(np.degrees(np.arctan(slope_sd)), LEANS.floor_deg))
    if not sd < prior:
        return prior_lean
    weight = prior**2 / (prior**2 + sd**2)
    hessian = np.array([[fitted[3], fitted[4]], [fitted[4], fitted[5]]])
    curvature = float(sun @ hessian @ sun) / model.spacing**2
    # only a roof that curves down has a level position
    shift = weight * slope / -curvature / model.spacing * sun if curvature < 0.0 else np.full(2, np.inf)
    return Lean(prior * sd / float(np.hypot(prior, sd)), shift, -float(np.degrees(np.arctan(slope))))


def _stands_above_ground(model: HeightModel, window: tuple[slice, slice], roof: Floats) -> bool:
    surroundings = tuple(
        slice(max(axis.start - LEANS.around_px, 0), axis.stop + LEANS.around_px) for axis in window
    )
    return bool(np.median(roof) - np.nanquantile(model.height[surroundings], 0.1) > LEANS.min_above_m)
