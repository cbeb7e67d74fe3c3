"""Candidate regions: surfaces by their spectra, connected pieces of one body, and measures of a piece."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_opening, find_objects, label, uniform_filter

from hyperpaint.base.arrays import Array, Bools, Floats
from hyperpaint.base.schema import Quality
from hyperpaint.surroundings import SceneModel
from hyperpaint.surroundings.model import SHADED
from hyperpaint.surroundings.surveying import is_vegetation

from .between_clouds import FreeSun
from .leans import HeightModel
from .proposal_rules import SURFACES


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Classes of the segments of a scene model by their spectra."""

    level: Floats  #: (segment,): Mean reflectance [1].
    #: (segment,): Whether it looks like the largest body, or like leaves.
    ground: Bools
    vegetation: Bools

    @classmethod
    def of(cls, model: SceneModel) -> Surfaces:
        """Return the surfaces of a scene model."""
        spectrum = np.nan_to_num(model.spectrum)
        reference = np.nan_to_num(model.reference)
        length = np.linalg.norm(reference, axis=1, keepdims=True)
        direction = reference / np.maximum(length, 1e-9)
        ground = np.zeros(0, bool)
        if model.segments:
            # ground: the largest body, and segments with its spectrum in any light
            largest = largest_body(model)
            level = length[:, 0] / max(float(length[largest, 0]), 1e-9)
            like = (direction @ direction[largest] > SURFACES.min_ground_cosine) & (
                np.abs(np.log(np.maximum(level, 1e-9))) < SURFACES.max_ground_log_ratio
            )
            ground = np.asarray(like | (model.body == largest))
        return cls(spectrum.mean(axis=1), ground, is_vegetation(model.spectrum, model.channel_wavelength))


def largest_body(model: SceneModel) -> int:
    """Return the number of the body with most pixels, which is taken for the ground."""
    return int(np.argmax(np.bincount(model.body, weights=model.size, minlength=model.segments)))


_WRONG = Quality.SATURATED | Quality.IRRADIANCE_GAP | Quality.NO_DATA | Quality.OFF_SWATH


@dataclass(frozen=True)
class Limits:
    """Limits for the pixels of a region; see `propose_regions`."""

    erode: int
    glint: float
    shadow: float
    adjacency: float
    brightness: float
    angle: float
    min_pixels: int


class Picture(NamedTuple):
    """A flight line prepared for proposals."""

    model: SceneModel  #: Its scene model.
    channels: Array  #: (line, column, channel): Reflectance in the model's channels [1].
    #: ``glint_fraction``, ``blocked_direct``, ``adjacency`` and ``quality`` (line, column).
    layers: Mapping[str, Array]
    zenith: float | None  #: Zenith angle of the sun [degree]; None where unknown.
    shadow_side: Floats | None = None  #: (2,): Direction (line, column) of shadows; None where unknown.
    heights: HeightModel | None = None  #: Heights of the line, if it has them.
    sun: FreeSun | None = None  #: Free sun between clouds in the record; None where clouds were not broken.


def window_of(first: tuple[int, int], mask: Bools) -> tuple[slice, slice]:
    """Return the window of a mask in the picture, from the line and column of its first pixel."""
    (y, x), (lines, columns) = first, mask.shape
    return slice(y, y + lines), slice(x, x + columns)


class Piece(NamedTuple):
    """A connected part of a body, away from other bodies."""

    body: int  #: Segment of the scene model.
    first: tuple[int, int]  #: Line and column of the first pixel of ``inside``.
    inside: Bools  #: (line, column): Its pixels.

    @property
    def window(self) -> tuple[slice, slice]:
        """Window of the piece in the picture."""
        return window_of(self.first, self.inside)

    @property
    def middle(self) -> Floats:
        """Line and column of its centre, (2,)."""
        return np.asarray(np.argwhere(self.inside).mean(axis=0) + np.array(self.first, np.float64))


class Measures(NamedTuple):
    """Measures of a piece."""

    usable: Bools  #: (line, column): Pixels that a region can use: the largest connected set of them.
    spectrum: Floats  #: (channel,): Median of these [1].
    lost: Mapping[str, float]  #: Share of the piece that is left out, by reason.
    pixels: int = 0  #: Number of usable pixels; without any, the measures are NaN.
    angle: float = np.nan  #: Median spectral angle to the median [degree].
    #: Brightness: half the range from the 5th to the 95th percentile, and the median change from pixel to
    #: pixel, relative [1].
    spread: float = np.nan
    slope: float = np.nan
    #: Means over the usable pixels [1].
    glint: float = np.nan
    shadow: float = np.nan
    adjacency: float = np.nan


def pieces(model: SceneModel, erode: int, least: int) -> Iterator[Piece]:
    """Yield the connected parts of bodies with at least ``least`` pixels, in order of bodies and lines."""
    body = np.append(model.body, np.int32(-1))[model.segment]
    shaded = np.append(model.state == SHADED, False)[model.segment]
    named = np.where((model.edge_distance > erode) & ~shaded & (body >= 0), body + 1, 0)
    large = np.bincount(named.ravel(), minlength=model.segments + 1) >= least
    for number, place in enumerate(find_objects(named, max_label=model.segments)):
        if place is None or not large[number + 1]:
            continue
        parts, count = label(named[place] == number + 1)
        for part, where in zip(range(1, count + 1), find_objects(parts), strict=True):
            mask = parts[where] == part
            if mask.sum() >= least:
                first = tuple(int(a.start + b.start) for a, b in zip(place, where, strict=True))
                yield Piece(number, (first[0], first[1]), mask)


def measured(piece: Piece, picture: Picture, limits: Limits, brightness: Floats | None = None) -> Measures:
    """Return the measures of a piece, with the pixels that a region can use.

    ``brightness`` (line, column): of the piece's window, relative to its level part [1]; by default relative
    to its median.
    """
    here = {name: layer[piece.window] for name, layer in picture.layers.items()}
    seen = picture.channels[piece.window].astype(np.float64)
    inside = piece.inside & np.isfinite(seen).all(axis=2)
    left_out: dict[str, Bools] = {
        "without data": ~inside,
        "wrong": (here["quality"] & np.uint16(_WRONG)) != 0,
        "glint": ~(here["glint_fraction"] <= limits.glint),
        "shadow": ~(here["blocked_direct"] < limits.shadow),
        "adjacency": ~(_smoothed(here["adjacency"], inside) <= limits.adjacency),
    }
    lit = inside & ~left_out["shadow"]
    own_brightness, most = _brightness(seen, lit)
    brightness = own_brightness if brightness is None else _smoothed(brightness, lit)
    # a tilt changes almost nothing on dark paint
    allowed = max(limits.brightness, SURFACES.min_change / max(most, 1e-6))
    left_out["another tilt"] = ~(np.abs(brightness - 1.0) <= allowed)
    usable = piece.inside.copy()
    lost = {}
    for reason, mask in left_out.items():
        lost[reason] = float((usable & mask).sum() / piece.inside.sum())
        usable &= ~mask
    usable = _largest(usable)
    lost = {name: share for name, share in lost.items() if share}
    count = int(usable.sum())
    if not count:
        return Measures(usable, np.full(seen.shape[2], np.nan), lost)
    values = seen[usable]
    middle = np.median(values, axis=0)
    length = np.linalg.norm(values, axis=1) * np.linalg.norm(middle)
    angles = np.degrees(np.arccos(np.clip(values @ middle / np.maximum(length, 1e-12), -1.0, 1.0)))
    low, high = np.quantile(brightness[usable], [0.05, 0.95])
    # steps between neighbouring pixels along both axes
    both = (usable[1:] & usable[:-1], usable[:, 1:] & usable[:, :-1])
    joined = np.concatenate([np.abs(np.diff(brightness, axis=axis))[both[axis]] for axis in (0, 1)])
    glint, shadow, adjacency = (
        float(here[name][usable].mean()) for name in ("glint_fraction", "blocked_direct", "adjacency")
    )
    return Measures(
        usable,
        middle,
        lost,
        pixels=count,
        angle=float(np.median(angles)),
        spread=0.5 * float(high - low),
        slope=float(np.median(joined)) if joined.size else 0.0,
        glint=glint,
        shadow=shadow,
        adjacency=adjacency,
    )


def _smoothed(values: Array, valid: Bools) -> Floats:
    # Means of valid values over a square (line, column); NaN without valid values
    valid = valid & np.isfinite(values)
    total = uniform_filter(
        np.where(valid, values, 0.0).astype(np.float64), SURFACES.square_px, mode="constant"
    )
    count = uniform_filter(valid.astype(np.float64), SURFACES.square_px, mode="constant")
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(valid, total / count, np.nan)


def _brightness(seen: Floats, valid: Bools) -> tuple[Floats, float]:
    # Brightness of pixels relative to the median (line, column), and its largest reflectance
    if not valid.any():
        return np.full(valid.shape, np.nan), np.nan
    middle = np.median(seen[valid], axis=0)
    smoothed = _smoothed(seen @ (middle / max(float(middle @ middle), 1e-12)), valid)
    return smoothed / float(np.median(smoothed[valid])), float(middle.max())


def _largest(mask: Bools) -> Bools:
    # without parts narrower than three pixels
    opened = binary_opening(mask, np.ones((3, 3), bool))
    parts, count = label(opened)
    if not count:
        return np.zeros_like(mask)
    return np.asarray(parts == 1 + int(np.argmax(np.bincount(parts.ravel())[1:])))
