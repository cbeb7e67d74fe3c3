r"""Light that a band counts of others, as an operator on the bands of a column.

Counts above dark, made linear, are :math:`s = (1 + \epsilon 1 1^T)(1 + D)\,c`: scattered light, D (band,
source band) of a lab sweep, and the smear of a detector whose frames are shifted under the light, where a
band takes :math:`\epsilon = t_{shift} / t` of each. Both are undone as sums over all bands, D by its largest
singular values, since what scatters is smooth.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Array, Bools, Floats
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.kernels.arguments import StrayLight

#: What a calibration or a line says of it.
STRAY_LIGHT = STRAY, STRAY_U, SHIFT_TIME = "stray_light", "stray_light_u", "band_shift_time"
#: Sum of a row of the inverse [1], beyond which most light would be stray.
MAX_AMPLIFIED = 10.0
#: Share of a frame's light that may be smear [1]: bands times shift time over exposure.
MAX_SMEAR_SHARE = 0.5
#: Sum of a row of D, whatever its signs, that is left out [1]. Real spectra are smooth, and what is left out
#: alternates in sign: of them it is a hundredth of that.
MAX_LEFT = 3e-4
_PAD = 4


def inverse_of(matrix: Floats, name: str) -> Floats:
    r"""Return :math:`(1 + D)^{-1}` (band, source band).

    Raises
    ------
    SchemaError
        D is not finite, not square, or says that most light is stray.
    """
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1] or not np.isfinite(matrix).all():
        raise SchemaError(
            f"{name} has shape {matrix.shape}",
            expected="a finite square matrix over all bands",
            code="stray-matrix-shape",
        )
    try:
        inverse = np.linalg.inv(np.eye(len(matrix)) + matrix)
    except np.linalg.LinAlgError:
        inverse = np.full_like(matrix, np.inf)
    if not np.abs(inverse).sum(axis=1).max() < MAX_AMPLIFIED:
        raise SchemaError(
            f"{name} cannot be inverted: it says that most light is stray",
            mend="expected shares far below 1",
            code="stray-matrix-singular",
        )
    return np.asarray(inverse)


def check_stray_light(cube: Mapping[str, Any], bands: int, exposure: Floats, problems: Problems) -> None:
    """Note stray light that is not that of all bands of a cube, or more than can be taken off."""
    if STRAY in cube and np.shape(cube[STRAY]) != (bands, bands):
        problems.add(
            (
                f"{STRAY!r} is of {np.shape(cube[STRAY])[1]} bands, and {bands} are here: what "
                "they count of the others needs all of them"
            ),
            mend="choose bands of the reflectance, or drop the variable",
            code="bands-selected",
        )
    shifted = cube.get("shifted_bands") or bands
    if shifted != bands:
        problems.add(
            (
                f"{SHIFT_TIME!r} is that of {shifted} bands, and {bands} are here: what smears "
                "into them needs all"
            ),
            mend="choose bands of the reflectance, or drop the variable",
            code="bands-selected",
        )
    relative = float(cube.get(STRAY_U, 0.0))
    if not 0.0 <= relative < 1.0:
        problems.add(
            f"{STRAY_U!r} is {relative:g}", expected="a fraction of 1, such as 0.1", code="value-out-of-range"
        )
    shift = float(cube.get(SHIFT_TIME, 0.0))
    if not 0.0 <= shift * bands <= MAX_SMEAR_SHARE * float(exposure.min()):
        problems.add(
            (
                f"{SHIFT_TIME!r} is {shift:g} s, {bands} times of which are over "
                f"{MAX_SMEAR_SHARE:.0%} of the exposure of {exposure.min():g} s"
            ),
            mend="expected that of one band, some microseconds",
            code="smear-implausible",
        )


def stray_light_of(
    cube: Mapping[str, Any], exposure: Floats, gain: Array, masked: npt.NDArray[np.int64]
) -> StrayLight | None:
    """Return what is to be subtracted from lines, None where nothing is known of it.

    ``exposure`` (line,) [s]; ``gain`` (band, column), NaN of elements whose counts mean nothing, for which
    those of the nearest good band of their column are taken; ``masked`` (n, 2): band and column of those that
    see no light.
    """
    if STRAY not in cube and SHIFT_TIME not in cube:
        return None
    bands = len(gain)
    give, take = np.zeros((bands, 0)), np.zeros((0, bands))
    if STRAY in cube:
        give, take = _terms(np.asarray(cube[STRAY], np.float64))
    return StrayLight(
        _filled(give, 1),
        _filled(_filled(take, 0), 1),
        smear_of(float(cube.get(SHIFT_TIME, 0.0)), exposure, bands).astype(np.float32),
        _stand_ins(np.isnan(gain), masked),
        _levels(gain),
        np.float32(cube.get(STRAY_U, 0.0)),
    )


def smear_of(shift_time: float, exposure: Any, bands: int) -> Any:
    r"""Return how much of the sum of all bands is smear in each, :math:`\epsilon / (1 + n \epsilon)` [1].

    ``shift_time`` and ``exposure``, of any shape, in seconds.
    """
    share = shift_time / exposure
    return np.asarray(share / (1.0 + share * bands))


def described(cube: Mapping[Any, Any]) -> str | None:
    """Return what an attribute says of what is subtracted; None for nothing."""
    parts = []
    if STRAY in cube:
        parts.append("scattered light by the matrix of the calibration")
    if SHIFT_TIME in cube:
        parts.append("smear by the time in which a frame is shifted")
    return ", ".join(parts) or None


def _terms(matrix: Floats) -> tuple[Array, Array]:
    r"""Return :math:`1 - (1 + D)^{-1}` as a product (band, term), (term, band), of as few terms as do."""
    wanted = np.eye(len(matrix)) - inverse_of(matrix, STRAY)
    left, size, right = np.linalg.svd(wanted)
    rest = wanted.copy()
    for term in range(len(size) + 1):
        if np.abs(rest).sum(axis=1).max() <= MAX_LEFT:
            break
        rest -= np.outer(left[:, term] * size[term], right[term])
    return left[:, :term] * size[:term], right[:term]


def _filled(values: Array, axis: int) -> Array:
    """Return float32 values with zeros up to a whole multiple of four along an axis."""
    pad = [(0, 0)] * values.ndim
    pad[axis] = (0, -values.shape[axis] % _PAD)
    return np.ascontiguousarray(np.pad(values, pad), np.float32)


def _stand_ins(bad: Bools, masked: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return column, band and standing-in band of every bad element (n, 3)."""
    lit = ~bad
    dark = np.zeros(bad.shape, bool)
    dark[tuple(masked.T)] = True
    rows = []
    for band, column in np.argwhere(bad):
        good = np.flatnonzero(lit[:, column])
        nearest = int(good[np.argmin(np.abs(good - band))]) if good.size and not dark[band, column] else -1
        rows.append((column, band, nearest))
    return np.array(rows, np.int64).reshape(-1, 3)


def _levels(gain: Array) -> Array:
    """Return gains over their trend along the columns, by which elements of one band differ (band, column).

    The trend, a parabola, is that of smile, which belongs to the light.
    """
    place = np.linspace(-1.0, 1.0, gain.shape[1])
    terms = np.stack([np.ones_like(place), place, place * place], axis=1)
    level = np.ones(gain.shape)
    for row, own in zip(level, gain.astype(np.float64), strict=True):
        good = np.isfinite(own)
        if good.sum() > terms.shape[1]:
            row[good] = (own / (terms @ np.linalg.lstsq(terms[good], own[good], rcond=None)[0]))[good]
    return np.asarray(np.where(level > 0.0, level, 1.0), np.float32)
