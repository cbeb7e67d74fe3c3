"""What lies around a piece of a surface: windows say that it is a car's, and which part of the car."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from hyperpaint.scene_model import SceneModel
from hyperpaint.scene_model.model import SHADED
from hyperpaint.scene_model.segments import touching

__all__ = ["Flanks", "Surfaces", "extent", "flanks_of", "is_between", "ring_around"]

Float = npt.NDArray[np.float64]
Int = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]

DARK = 0.05
"""Mean reflectance below which a surface is a window, or a dark paint [1]."""
_DARKEST, _SURE = 0.002, 0.0125
_BLUENESS = (0.65, 2.5)
"""Of windows, which mirror the sky, and send a little of what is behind them."""
_BLUE, _RED, _EDGE_OF_RED, _INFRARED = (430.0, 490.0), (660.0, 690.0), (735.0, 765.0), (790.0, 900.0)
_AXES = 12
_EDGE = 3  # pixels that pieces keep away from edges
_NEAR, _NEAR_SHARE, _SIDE_SHARE = 6, 0.12, 0.2
_LEAST_WINDOW = 2
_AS_CLEAR = 0.05
_BORDER, _WITHIN = 0.15, 0.6
ENDED, ENDED_WHOLLY = 0.45, 0.8
"""Share of a piece's width that ends at windows, at one end and at the other, at least."""
_SAME_GROUND, _LEVELS = np.cos(np.radians(3.0)), 0.2


class Flanks(NamedTuple):
    """What lies at the ends and along the sides of a piece.

    Attributes
    ----------
    axis
        Angle of the axis at whose ends most windows are, from the columns' direction towards later lines
        [degree].
    ends
        Share of its width that ends at a window, at both ends [1]; the larger first.
    sides
        Share of its length along which windows run, on the side where it is larger [1].
    length, width
        Along the axis, median over its width; and across it [pixel].
    """

    axis: float
    ends: tuple[float, float]
    sides: float
    length: float
    width: float


@dataclass(frozen=True, eq=False)
class Surfaces:
    """What segments of a scene model are by their spectra.

    Attributes
    ----------
    level, blueness : (segment,)
        Mean reflectance [1]; ratio of blue to near infrared.
    dark, window, ground, vegetation, shade : (segment,)
        Whether it is dark as glass, such and not beside the ground, like the largest body, green as leaves,
        in another body's shadow.
    """

    level: Float
    blueness: Float
    dark: Mask
    window: Mask
    ground: Mask
    vegetation: Mask
    shade: Mask

    @classmethod
    def of(cls, model: SceneModel) -> Surfaces:
        """Return those of a scene model."""
        spectrum = np.nan_to_num(model.spectrum)
        level = spectrum.mean(axis=1)
        blue, red, edge, infrared = (
            _mean_over(spectrum, model.channel_wavelength, span)
            for span in (_BLUE, _RED, _EDGE_OF_RED, _INFRARED)
        )
        blueness = blue / np.maximum(infrared, 1e-4)
        reference = np.nan_to_num(model.reference)
        length = np.linalg.norm(reference, axis=1, keepdims=True)
        direction = reference / np.maximum(length, 1e-9)
        ground = _like_the_largest(model, direction, length[:, 0])
        shade = model.state == SHADED
        beside, within = _borders(model, ground, level)
        dark = (level > _DARKEST) & (level < DARK)
        glassy = (blueness > _BLUENESS[0]) & (blueness < _BLUENESS[1]) & ~(shade & ground & (level < _SURE))
        window = dark & (beside <= _BORDER) & (glassy | (within >= _WITHIN))
        dark &= glassy
        # leaves rise within 50 nm, and no further; pigments take their time
        leaves = (edge > 3.0 * red) & (infrared < 1.4 * edge)
        return cls(level, blueness, dark, window, ground, leaves, shade)


def _like_the_largest(model: SceneModel, direction: Float, length: Float) -> Mask:
    """Return which segments are the largest body, or look like it, whatever their light (segment,)."""
    if not model.segments:
        return np.zeros(0, bool)
    largest = int(np.argmax(np.bincount(model.body, weights=model.size, minlength=model.segments)))
    level = length / max(float(length[largest]), 1e-9)
    like = (direction @ direction[largest] > _SAME_GROUND) & (
        np.abs(np.log(np.maximum(level, 1e-9))) < _LEVELS
    )
    return np.asarray(like | (model.body == largest))


def _borders(model: SceneModel, ground: Mask, level: Float) -> tuple[Float, Float]:
    """Return the shares of segments' borders with lit ground, as of shadows on it, and with bright things."""
    pairs = touching(model.segment, model.segments)
    whole = np.maximum(np.bincount(pairs.one, weights=pairs.length, minlength=model.segments), 1.0)
    lit = ground & (model.state != SHADED)
    bright = (level >= DARK) & ~ground
    beside, within = (
        np.bincount(pairs.one, weights=pairs.length * which[pairs.other], minlength=model.segments) / whole
        for which in (lit, bright)
    )
    return beside, within


def _mean_over(spectrum: Float, wavelength: Float, span: tuple[float, float]) -> Float:
    """Return the mean of channels in a span [nm], or of the nearest one."""
    chosen = (wavelength >= span[0]) & (wavelength <= span[1])
    if not chosen.any():
        chosen[np.argmin(np.abs(wavelength - 0.5 * sum(span)))] = True
    return np.asarray(spectrum[:, chosen].mean(axis=1))


def flanks_of(lines: Int, columns: Int, segment: npt.NDArray[np.int32], window: Mask) -> Flanks:
    """Return what ends a piece along the axis at whose end the clearest window is.

    Parameters
    ----------
    lines, columns : (pixel,)
        The piece.
    segment : (line, column)
        Segment of every pixel; -1 for none.
    window : (segment,)
        Which segments are windows.
    """
    seen = np.append(window, False)[segment]
    shares = [
        _shares(lines, columns, np.pi * number / _AXES, seen, _NEAR, _NEAR_SHARE) for number in range(_AXES)
    ]
    # the axis of the clearest window; the other end decides among those that are as clear
    clearest = max(max(one) for one in shares) - _AS_CLEAR
    best = max(
        range(_AXES), key=lambda number: (max(shares[number]) >= clearest, min(shares[number]), -number)
    )
    aside = np.pi * (best / _AXES + 0.5)
    sides = _shares(lines, columns, aside, seen, _NEAR, _SIDE_SHARE)
    first, last = shares[best]
    axis = 180.0 * best / _AXES
    size = extent(lines, columns, axis)
    return Flanks(axis, (max(first, last), min(first, last)), max(sides), *size)


def extent(lines: Int, columns: Int, axis: float) -> tuple[float, float]:
    """Return the length of a piece along an axis [degree], median over its width, and its width [pixel]."""
    angle = np.radians(axis)
    lengths = _ends(lines, columns, np.array([np.sin(angle), np.cos(angle)])).length
    return float(np.median(lengths)), float(lengths.size)


def is_between(ends: tuple[float, float]) -> bool:
    """Tell whether windows lie at both ends, by their shares of the width."""
    return min(ends) >= ENDED and max(ends) >= ENDED_WHOLLY


def _shares(
    lines: Int, columns: Int, angle: float, seen: Mask, near: int, share: float
) -> tuple[float, float]:
    """Return the share of a piece's width that ends at windows, at its first pixels and at its last."""
    step = np.array([np.sin(angle), np.cos(angle)])
    ends = _ends(lines, columns, step)
    reach = _EDGE + max(near, round(share * float(np.median(ends.length))))
    made = []
    for place, way in ((ends.first, -step), (ends.last, step)):
        made.append(float((_look(place, way, seen, reach).sum(axis=1) >= _LEAST_WINDOW).mean()))
    return made[0], made[1]


class _Ends(NamedTuple):
    first: Float
    last: Float
    length: Float


def _ends(lines: Int, columns: Int, step: Float) -> _Ends:
    """Return where a piece begins and ends along a direction (track, 2), in tracks one pixel wide."""
    along = lines * step[0] + columns * step[1]
    across = np.rint(columns * step[0] - lines * step[1]).astype(np.int64)
    tracks, place = np.unique(across, return_inverse=True)
    low, high = np.full(tracks.size, np.inf), np.full(tracks.size, -np.inf)
    np.minimum.at(low, place, along)
    np.maximum.at(high, place, along)
    aside = np.array([-step[1], step[0]])
    side = tracks[:, None] * aside
    return _Ends(low[:, None] * step + side, high[:, None] * step + side, high - low + 1.0)


def _look(start: Float, step: Float, seen: Mask, reach: int) -> Mask:
    """Return what is seen on the way from places (track, reach); False beyond the picture."""
    way = start[:, None] + step * np.arange(1, reach + 1)[:, None]
    y, x = np.rint(way[..., 0]).astype(np.int64), np.rint(way[..., 1]).astype(np.int64)
    lines, columns = seen.shape
    inside = (y >= 0) & (y < lines) & (x >= 0) & (x < columns)
    return np.asarray(inside & seen[y.clip(0, lines - 1), x.clip(0, columns - 1)])


def ring_around(mask: Mask, width: int) -> Mask:
    """Return the pixels around a mask (line, column), from 3 to 3 + width away."""
    from scipy.ndimage import binary_dilation

    square = np.ones((3, 3), bool)
    inner = binary_dilation(mask, square, iterations=3)
    return np.asarray(binary_dilation(inner, square, iterations=width) & ~inner)
