"""Grey picture of a flight line, and its motion from row to row.

Roll of a line camera shifts its rows sideways. That shift can be measured wherever the ground has texture.
The distance of two rows along the track cannot be measured in this way, but the larger it is, the less alike
the rows are; likeness as a function of distance follows from the rows themselves, across the track.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Array, Floats, Floats32
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.schema import ALONG_TRACK, BAND, CROSS_TRACK

_CUBES = ("counts", "radiance", "reflectance")
#: Bands to average: more would not reduce the noise further.
_MAX_BANDS = 12
#: Range of high signal of a silicon camera, outside strong absorption of the atmosphere [nm].
_WAVELENGTHS = (500.0, 850.0)


def picture_of(line: xr.Dataset, image: xr.DataArray | None) -> Floats32:
    """Return a picture (along_track, cross_track) of a line's cube, or the ``image`` given, read once.

    Raises
    ------
    SchemaError
        There is no cube; the picture has other dims or sizes than the line.
    """
    if image is None:
        name = next((name for name in _CUBES if name in line.variables), None)
        if name is None:
            raise SchemaError(
                f"this line has no picture: {', '.join(_CUBES)}", mend="pass image=", code="picture-missing"
            )
        image = line[name]
        if BAND in image.dims:
            # the mean of some bands spread over the wavelengths
            bands = np.arange(line.sizes[BAND])
            if "wavelength" in line.variables:
                wavelength = np.asarray(line["wavelength"].values, np.float64)
                is_inside = (wavelength >= _WAVELENGTHS[0]) & (wavelength <= _WAVELENGTHS[1])
                if "good" in line.variables:
                    is_inside &= np.asarray(line["good"].values, bool)
                bands = np.flatnonzero(is_inside) if is_inside.any() else bands
            positions = np.linspace(0, bands.size - 1, min(_MAX_BANDS, bands.size))
            bands = bands[np.unique(np.round(positions).astype(np.int64))]
            image = image.isel({BAND: bands}).mean(BAND, dtype=np.float32)
    sizes = {dim: line.sizes[dim] for dim in (ALONG_TRACK, CROSS_TRACK) if dim in line.sizes}
    if set(image.dims) != {ALONG_TRACK, CROSS_TRACK} or any(image.sizes[d] != n for d, n in sizes.items()):
        raise SchemaError(
            f"the image is {dict(image.sizes)}", expected=f"{sizes}, as the line", code="grid-mismatch"
        )
    values: Any = image.transpose(ALONG_TRACK, CROSS_TRACK).values
    return np.asarray(values, np.float32)


@dataclass(frozen=True)
class Rules:
    """How rows of a picture are compared."""

    #: Number of zones, parts of a row with a shift of their own, and their width if there are enough columns.
    min_zones: int = 4
    max_zones: int = 12
    zone_columns: int = 64
    reach_px: int = 8  #: largest shift between rows in the search
    block_rows: int = 512  #: rows compared at a time
    min_columns: int = 12  #: minimum width of a zone
    level_columns: int = 5  #: width of the running mean that is subtracted from rows


RULES = Rules()
REACH = RULES.reach_px
_FLAT = 1e-12


@dataclass(frozen=True)
class RowMotion:
    """Motion of a picture from each row to the next."""

    #: (row - 1, zone): ground at column x of a row is at x + shift in the row before [pixel]; NaN where
    #: undetermined
    shift: Floats
    #: (row - 1, zone): mean square difference of the two rows after that shift, over the variance of either
    unlikeness: Floats
    structure: Floats  #: (`REACH` + 1,): unlikeness of a row with itself at a lag of 0, 1 ... columns
    centres: Floats  #: (zone,): column in the middle of every zone


def row_motion(picture: Array) -> RowMotion | None:
    """Return the motion of a picture (row, column); None where it is too narrow.

    Notes
    -----
    The gains of columns are divided out: their fixed pattern would suggest that nothing moves. The best
    integer shift is refined by the Gauss-Newton method. Both rows are moved by half the shift, so that both
    are smoothed equally.
    """
    from scipy.ndimage import uniform_filter1d

    rows, columns = picture.shape
    zones = int(np.clip(columns // RULES.zone_columns, RULES.min_zones, RULES.max_zones))
    width = (columns - 2 * REACH) // zones
    if width < RULES.min_columns or rows < 2:
        return None
    starts = REACH + width * np.arange(zones)
    # logarithms without the gains of columns
    values = np.asarray(picture, np.float64)
    is_positive = np.isfinite(values) & (values > 0.0)
    floor = np.quantile(values[is_positive], 0.001) if is_positive.any() else 1.0
    levelled = np.log(np.where(is_positive, np.maximum(values, floor), floor))
    levelled -= np.median(levelled, axis=0)
    # without slow changes: a long slanted edge looks like a shift between rows; small structures have edges
    # on every side
    fine = levelled - uniform_filter1d(levelled, RULES.level_columns, axis=1, mode="nearest")
    power = uniform_filter1d(fine**2, 2 * RULES.level_columns + 1, axis=1, mode="nearest")
    fine /= np.sqrt(np.maximum(power, 0.0)) + 0.1 * np.sqrt(power.mean()) + _FLAT
    shift, unlikeness = np.full((rows - 1, zones), np.nan), np.full((rows - 1, zones), np.nan)
    structure, weight = np.zeros(REACH + 1), 0.0
    for first in range(0, rows - 1, RULES.block_rows):
        stop = min(first + RULES.block_rows, rows - 1)
        block, next_block = slice(first, stop), slice(first + 1, stop + 1)
        for zone, start in enumerate(starts):
            window = slice(int(start), int(start) + width)
            variance = levelled[next_block, window].var(axis=1) + levelled[block, window].var(axis=1)
            has_contrast = variance > _FLAT
            if not has_contrast.any():
                continue
            variance = variance[has_contrast]
            before, after = (levelled[rows_of][has_contrast] for rows_of in (block, next_block))
            zone_shift = _shift(fine[block][has_contrast], fine[next_block][has_contrast], window)
            shift[block, zone][has_contrast] = zone_shift
            # mean square difference after moving both rows by half the shift
            half = np.where(np.isnan(zone_shift), 0.0, zone_shift) / 2
            square = ((_moved(after, window, -half) - _moved(before, window, half)) ** 2).mean(axis=1)
            unlikeness[block, zone][has_contrast] = np.where(np.isnan(zone_shift), np.nan, square) / variance
            # mean square difference of rows with themselves at lags of 0 to `REACH` columns (row, lag)
            at_lags = (before[:, window.start + lag : window.stop + lag] for lag in range(REACH + 1))
            squares = [((other - before[:, window]) ** 2).mean(axis=1) for other in at_lags]
            own_structure = np.stack(squares, axis=1) / variance[:, None]
            is_valid = np.isfinite(own_structure).all(axis=1)
            structure += own_structure[is_valid].sum(axis=0)
            weight += float(is_valid.sum())
    return RowMotion(shift, unlikeness, structure / weight, starts + (width - 1) / 2) if weight else None


def _shift(before: Floats, after: Floats, window: slice) -> Floats:
    # Return the shift (row,), NaN where it is not within `REACH`.
    target = after[:, window]
    lags = range(-REACH, REACH + 1)
    costs = np.stack(
        [((target - before[:, window.start + k : window.stop + k]) ** 2).mean(axis=1) for k in lags]
    )
    best = costs.argmin(axis=0)
    interior = np.clip(best, 1, 2 * REACH - 1)
    row = np.arange(best.size)
    low, middle, high = costs[interior - 1, row], costs[interior, row], costs[interior + 1, row]
    curvature = low + high - 2.0 * middle
    fraction = np.where(curvature > 0.0, 0.5 * (low - high) / np.where(curvature > 0.0, curvature, 1.0), 0.0)
    shift = interior - REACH + np.clip(fraction, -1.0, 1.0)
    for _ in range(2):
        first, second = _moved(before, window, shift / 2), _moved(after, window, -shift / 2)
        slope = (np.gradient(first, axis=1) + np.gradient(second, axis=1)) / 2
        step = (slope * (second - first)).sum(axis=1) / np.maximum((slope**2).sum(axis=1), _FLAT)
        shift = shift + np.clip(step, -0.5, 0.5)
    return np.where((best == 0) | (best == 2 * REACH) | (np.abs(shift) > REACH), np.nan, shift)


def _moved(rows: Floats, window: slice, shift: Floats) -> Floats:
    # Interpolate rows at columns + ``shift`` by cubic convolution (Keys, 1981).
    integer = np.floor(shift).astype(np.int64)
    t = (shift - integer)[:, None]
    weights = (
        ((-0.5 * t + 1.0) * t - 0.5) * t,
        (1.5 * t - 2.5) * t * t + 1.0,
        ((-1.5 * t + 2.0) * t + 0.5) * t,
        (0.5 * t - 0.5) * t * t,
    )
    columns = np.arange(window.start, window.stop)[None, :] + integer[:, None]
    last = rows.shape[1] - 1
    taps = (np.take_along_axis(rows, np.clip(columns + k - 1, 0, last), axis=1) for k in range(4))
    return np.asarray(sum(w * tap for w, tap in zip(weights, taps, strict=True)))
