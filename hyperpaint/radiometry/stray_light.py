r"""Stray light and smear between the bands of a column, and their removal.

Counts above dark, made linear, are :math:`s = (1 + \epsilon 1 1^T)(1 + D)\,c`: scattered light, D (band,
source band) of a lab sweep, and the smear of a detector whose frames are shifted during exposure, where a
band receives :math:`\epsilon = t_{shift} / t` of each other band. Both are inverted as sums over all bands, D
by its largest singular values, because scattered light is smooth.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.schema import Array, Floats, Ints
from hyperpaint.kernels.arguments import StrayLight

#: Variables that declare stray light and smear.
STRAY_LIGHT = STRAY, STRAY_U, SHIFT_TIME = "stray_light", "stray_light_u", "band_shift_time"
#: Largest row sum of absolute values of the inverse [1]; above, most light would be stray.
MAX_ROW_SUM = 10.0
#: Largest share of a frame's light that is smear [1]: bands times shift time over exposure.
MAX_SMEAR_SHARE = 0.5
#: Largest row sum of absolute values of the truncated terms of D [1]. They alternate in sign, so that smooth
#: spectra lose a hundredth of that.
MAX_TRUNCATED = 3e-4
_PAD = 4


def inverse_of(matrix: Floats, name: str) -> Floats:
    # Return :math:`(1 + D)^{-1}` (band, source band).
    #
    # Raises `SchemaError`: D is not finite, not square, or so large that most light would be stray.
    SchemaError.raise_if(
        matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1] or not np.isfinite(matrix).all(),
        f"{name} has shape {matrix.shape}",
        expected="a finite square matrix over all bands",
        code="stray-matrix-shape",
    )
    try:
        inverse = np.linalg.inv(np.eye(len(matrix)) + matrix)
    except np.linalg.LinAlgError:
        inverse = np.full_like(matrix, np.inf)
    SchemaError.raise_if(
        not np.abs(inverse).sum(axis=1).max() < MAX_ROW_SUM,
        f"{name} cannot be inverted, since most light would be stray",
        expected="shares far below 1",
        code="stray-matrix-singular",
    )
    return np.asarray(inverse)


def check_stray_light(cube: Mapping[str, Any], bands: int, exposure: Floats, problems: Problems) -> None:
    # Add problems of stray light that does not fit the bands of a cube, or is too large to subtract.
    shape = np.shape(cube[STRAY]) if STRAY in cube else (bands, bands)
    shifted_bands = cube.get("shifted_bands") or bands
    for is_valid, found in (
        (shape == (bands, bands), f"{STRAY!r} has {shape[1]} bands, this line {bands}"),
        (shifted_bands == bands, f"{SHIFT_TIME!r} belongs to {shifted_bands} bands, this line has {bands}"),
    ):
        if not is_valid:
            mend = "select bands after computing reflectance, or drop the variable"
            problems.add(found, mend=mend, code="bands-selected")
    relative = float(cube.get(STRAY_U, 0.0))
    problems.add_if(
        not 0.0 <= relative < 1.0,
        f"{STRAY_U!r} is {relative:g}",
        expected="a fraction of 1, such as 0.1",
        code="value-out-of-range",
    )
    shift = float(cube.get(SHIFT_TIME, 0.0))
    problems.add_if(
        not 0.0 <= shift * bands <= MAX_SMEAR_SHARE * float(exposure.min()),
        f"{SHIFT_TIME!r} is {shift:g} s: times {bands} bands over {MAX_SMEAR_SHARE:.0%} of the "
        f"exposure of {exposure.min():g} s",
        expected="the time of one band, some microseconds",
        code="smear-implausible",
    )


def stray_light_of(cube: Mapping[str, Any], exposure: Floats, gain: Array, masked: Ints) -> StrayLight | None:
    # Return the terms of stray light to subtract from lines; None where the line declares none.
    #
    # ``exposure`` (line,) [s]; ``gain`` (band, column), NaN for bad elements, which are replaced by the
    # nearest good band of their column; ``masked`` (n, 2): band and column of elements that receive no light.
    if STRAY not in cube and SHIFT_TIME not in cube:
        return None
    bands = len(gain)
    band_terms, source_terms = np.zeros((bands, 0)), np.zeros((0, bands))
    if STRAY in cube:
        # `1 - (1 + D)^{-1}` as a product (band, term), (term, band), of the fewest sufficient terms
        residual = np.eye(bands) - inverse_of(np.asarray(cube[STRAY], np.float64), STRAY)
        left, size, right = np.linalg.svd(residual)
        for term in range(len(size) + 1):
            if np.abs(residual).sum(axis=1).max() <= MAX_TRUNCATED:
                break
            residual -= np.outer(left[:, term] * size[term], right[term])
        band_terms, source_terms = left[:, :term] * size[:term], right[:term]
    # column, band and replacement band of every bad element; -1 without a replacement
    is_bad, is_masked = np.isnan(gain), np.zeros(gain.shape, bool)
    is_masked[tuple(masked.T)] = True
    replacements = []
    for band, column in np.argwhere(is_bad):
        good_bands, nearest = np.flatnonzero(~is_bad[:, column]), -1
        if good_bands.size and not is_masked[band, column]:
            nearest = int(good_bands[np.argmin(np.abs(good_bands - band))])
        replacements.append((column, band, nearest))
    # gains relative to their trend along the columns, a parabola, which is caused by smile, and so belongs to
    # the light
    position = np.linspace(-1.0, 1.0, gain.shape[1])
    terms = np.stack([np.ones_like(position), position, position * position], axis=1)
    level = np.ones(gain.shape)
    for row, values in zip(level, gain.astype(np.float64), strict=True):
        is_finite = np.isfinite(values)
        if is_finite.sum() > terms.shape[1]:
            trend = terms @ np.linalg.lstsq(terms[is_finite], values[is_finite], rcond=None)[0]
            row[is_finite] = (values / trend)[is_finite]
    return StrayLight(
        _padded(band_terms, 1),
        _padded(_padded(source_terms, 0), 1),
        smear_of(float(cube.get(SHIFT_TIME, 0.0)), exposure, bands).astype(np.float32),
        np.array(replacements, np.int64).reshape(-1, 3),
        np.asarray(np.where(level > 0.0, level, 1.0), np.float32),
        np.float32(cube.get(STRAY_U, 0.0)),
    )


def smear_of(shift_time: float, exposure: Any, bands: int) -> Any:
    r"""Return the smear of each band as a share of the sum of all, :math:`\epsilon / (1 + n \epsilon)` [1].

    ``shift_time`` and ``exposure``, of any shape, in seconds.
    """
    share = shift_time / exposure
    return np.asarray(share / (1.0 + share * bands))


def described(cube: Mapping[Any, Any]) -> str | None:
    # Return the description of the subtracted light for an attribute; None for nothing.
    descriptions = {
        STRAY: "scattered light by the matrix of the calibration",
        SHIFT_TIME: "smear by the time in which a frame is shifted",
    }
    return ", ".join(text for name, text in descriptions.items() if name in cube) or None


def _padded(values: Array, axis: int) -> Array:
    pad = [(0, 0)] * values.ndim
    pad[axis] = (0, -values.shape[axis] % _PAD)
    return np.ascontiguousarray(np.pad(values, pad), np.float32)
