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

    #: Unknown lean across a car at the place where its shape is level [degree]: a car is symmetric, and the
    #: ground leans. Parking areas are drained over slopes of 1 to 1.5 % (0.6 to 0.9 degrees), of whose two
    #: components one is towards the sun.
    roll_deg: float = 0.5
    #: Unknown lean along the car, where a roof of 6 m radius may also be highest 7 cm from its middle
    #: [degree].
    rake_deg: float = 0.8
    #: Minimum height of a roof above its surroundings in a height model that shows cars and not bare ground;
    #: cars are at least 1.4 m high [m].
    min_above_m: float = 0.7
    around_px: int = 25  #: Margin that contains ground [pixel].
    #: Correlation length of height errors: photogrammetry matches patches [m].
    alike_m: float = 0.15
    floor_deg: float = 0.3  #: Lean of the height model itself, standard deviation [degree].
    min_px: int = 40  #: Minimum number of pixels with a height.
    min_side_px: int = 4  #: Minimum number of lines, and of columns, with such pixels.


LEANS = LeanRules()


class HeightModel(NamedTuple):
    """Height of the surface in every pixel."""

    height: Array  #: (line, column) [m].
    spacing: float  #: Between pixels [m].


class Lean(NamedTuple):
    """Lean of a roof towards the sun."""

    sd: float  #: Standard deviation of its unknown part [degree].
    #: Lines and columns from its middle to where it is level along the sun's direction.
    shift: Floats
    angle: float = np.nan  #: In its middle, positive where it faces the sun [degree]; NaN if not measured.


def height_model_of(line: xr.Dataset) -> HeightModel | None:
    """Return the height model of a line; None without heights.

    Needs ``east``, ``north`` and ``ground_height`` as `hyperpaint.geometry.locate` writes them with a ``dem``
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
    middle: tuple[float, float],
    prior: float,
    shadow_side: Floats | None,
) -> Lean:
    r"""Return the lean of a roof from its heights; the prior where no height model shows the car.

    A polynomial of second order through the heights of the roof,

    .. math:: z = z_0 + b \cdot p + p^T H p / 2,

    with p [pixel] from its middle, has the slope :math:`b \cdot s` towards the sun s, and is level there
    after :math:`- (b \cdot s) / (s^T H s)` pixels. The prior lean, 0 with the standard deviation ``prior``,
    and the fitted one are weighted by their variances.

    Takes ``window`` and ``inside`` (line, column): the roof; ``middle``: line and column in the window;
    ``prior`` [degree]; ``shadow_side`` (2,): see `lean_to_sun`.
    """
    unknown = Lean(prior, np.zeros(2))
    if model is None or shadow_side is None:
        return unknown
    height = model.height[window]
    used = inside & np.isfinite(height)
    if used.sum() < LEANS.min_px or min(used.any(axis=0).sum(), used.any(axis=1).sum()) < LEANS.min_side_px:
        return unknown
    if not _stands_above_ground(model, window, height[used]):
        return unknown
    rows, columns = np.nonzero(used)
    y, x = rows - middle[0], columns - middle[1]
    terms = np.stack([np.ones(y.size), y, x, 0.5 * y * y, y * x, 0.5 * x * x], axis=1)
    fitted = np.linalg.lstsq(terms, height[used], rcond=None)[0]
    off = height[used] - terms @ fitted
    # pixels of one patch are correlated
    alike = max(1.0, (LEANS.alike_m / model.spacing) ** 2)
    covariance = np.linalg.pinv(terms.T @ terms) * float(off @ off) / (y.size - terms.shape[1]) * alike
    sun = -shadow_side
    slope = float(fitted[1:3] @ sun) / model.spacing
    u = float(np.sqrt(sun @ covariance[1:3, 1:3] @ sun)) / model.spacing
    sd = float(np.hypot(np.degrees(np.arctan(u)), LEANS.floor_deg))
    if not sd < prior:
        return unknown
    weight = prior**2 / (prior**2 + sd**2)
    hessian = np.array([[fitted[3], fitted[4]], [fitted[4], fitted[5]]])
    bend = float(sun @ hessian @ sun) / model.spacing**2
    # a crown bends down; any other shape is level nowhere
    shift = weight * slope / -bend / model.spacing * sun if bend < 0.0 else np.full(2, np.inf)
    return Lean(prior * sd / float(np.hypot(prior, sd)), shift, -float(np.degrees(np.arctan(slope))))


def _stands_above_ground(model: HeightModel, window: tuple[slice, slice], roof: Floats) -> bool:
    around = tuple(
        slice(max(part.start - LEANS.around_px, 0), part.stop + LEANS.around_px) for part in window
    )
    return bool(np.median(roof) - np.nanquantile(model.height[around], 0.1) > LEANS.min_above_m)
