"""Footprint of a car around a piece of its paint: all pixels of its colour, and the area they enclose."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.ndimage import (
    binary_closing,
    binary_fill_holes,
    binary_opening,
    distance_transform_edt,
    label,
    minimum,
)
from scipy.spatial import ConvexHull

from hyperpaint.base.arrays import Array, Bools, Floats
from hyperpaint.surroundings import SceneModel

from .candidates import largest_body, window_of
from .proposal_rules import FOOTPRINTS, SURFACES

_ROUNDING = 1e-6


class Way(NamedTuple):
    """Rules for joining parts of a car beyond those that touch."""

    apart: bool = False  #: Without parts joined by a thin bridge only, such as a mirror and a bay line.
    windows: bool = False  #: With all parts separated by dark pixels only.
    #: With far brighter or darker parts, such as flakes at another lean.
    wide: bool = False


WAYS = tuple(
    Way(apart, windows, wide)
    for wide in (False, True)
    for windows in (False, True)
    for apart in (False, True)
)


class Scene(NamedTuple):
    """The whole picture, prepared for footprints."""

    channels: Array  #: (line, column, channel): Reflectance [1].
    sky: Array  #: (channel,): Sky mirrored by a level clear coat, in reflectance [1].
    level: Array  #: (line, column): Mean reflectance [1].
    ground: Floats  #: (channel,): Reflectance of the largest body [1].

    @classmethod
    def of(cls, channels: Array, model: SceneModel) -> Scene:
        """Return the scene of a line's channels (line, column, channel) and its model."""
        sky = (FOOTPRINTS.mirrored * model.diffuse_fraction * model.zenith_radiance).astype(np.float32)
        ground = np.nan_to_num(model.reference[largest_body(model)])
        return cls(channels, sky, channels.mean(axis=2), ground)

    def without_sky(self, window: tuple[slice, slice]) -> Floats:
        """Return the reflectance in a window of the picture, less the mirrored sky [1]."""
        return np.asarray(self.channels[window] - self.sky, np.float64)


class Footprint(NamedTuple):
    """A car seen from above."""

    first: tuple[int, int]  #: Line and column of the first pixel of the masks.
    #: (line, column): Pixels of its colour; these and the area they enclose, without thin parts.
    paint: Bools
    whole: Bools
    brightness: Floats  #: (line, column): Relative to the piece it was found from.
    axis: Floats  #: (2,): Unit vector (line, column) along its longer side.
    middle: Floats  #: (2,): Line and column of its centre in the masks.
    #: [pixel]
    length: float
    width: float
    cut: bool  #: Whether it goes on beyond the picture.

    @property
    def is_one_car(self) -> bool:
        """Whether it has the proportions of a car, and lies wholly in the picture."""
        least, most = FOOTPRINTS.slenderness
        return not self.cut and least < self.length / self.width < most

    @property
    def window(self) -> tuple[slice, slice]:
        """Window of the masks in the picture."""
        return window_of(self.first, self.whole)


def footprints_of(
    inside: Bools, first: tuple[int, int], colour: Floats, scene: Scene, ways: Sequence[Way]
) -> Iterator[Footprint]:
    """Yield the footprint of the car of a piece of paint, for each way whose colour ends within the margin.

    Takes ``inside`` (line, column): the piece; ``first``: line and column of its first pixel; ``colour``
    (channel,): its reflectance, less the mirrored sky [1]; ``scene``: the picture; ``ways``: rules for
    joining parts.
    """
    shape = np.array(scene.level.shape)
    looks: dict[tuple[int, bool], _Like] = {}
    for way in ways:
        pad = min(int(FOOTPRINTS.around * max(inside.shape)), FOOTPRINTS.max_around_px)
        for _ in range(FOOTPRINTS.rounds):
            low = np.maximum(np.array(first) - pad, 0)
            high = np.minimum(np.array(first) + inside.shape + pad, shape)
            if (pad, way.wide) not in looks:
                window = np.s_[low[0] : high[0], low[1] : high[1]]
                looks[pad, way.wide] = _like(colour, scene, window, way.wide)
            like = looks[pad, way.wide]
            seed = np.zeros(like.paint.shape, bool)
            y, x = np.array(first) - low
            seed[y : y + inside.shape[0], x : x + inside.shape[1]] = inside
            whole = _whole(like, seed, way)
            if whole is None:
                break
            # at the edges of the window, in the order of low and high
            sides = np.array([[whole[0].any(), whole[:, 0].any()], [whole[-1].any(), whole[:, -1].any()]])
            if not (sides & ~np.array([low == 0, high == shape])).any():
                place = (int(low[0]), int(low[1]))
                paint, cut = like.paint | seed, bool(sides.any())
                yield Footprint(place, paint, whole, like.brightness, *_rectangle(whole), cut)
                break
            pad = int(FOOTPRINTS.growth * pad) + 8


class _Like(NamedTuple):
    paint: Bools
    ground: Bools
    dark: Bools
    brightness: Floats


def _like(colour: Floats, scene: Scene, window: tuple[slice, slice], wide: bool) -> _Like:
    seen = scene.without_sky(window)
    length = np.maximum(np.linalg.norm(seen, axis=2), 1e-9)
    colour_length, ground_length = float(np.linalg.norm(colour)), float(np.linalg.norm(scene.ground))
    brightness = (seen @ colour) / colour_length**2
    like = brightness * colour_length / length
    is_dark = float(colour.mean()) < SURFACES.dark
    least, most = (FOOTPRINTS.dark_brightness if is_dark else FOOTPRINTS.brightness)[wide]
    paint = (like > FOOTPRINTS.min_cosine) & (brightness > least) & (brightness < most)
    as_ground = (seen @ scene.ground) / (length * ground_length)
    near = np.abs(np.log(length / ground_length)) < FOOTPRINTS.max_ground_log_ratio
    paint &= (like > as_ground) | ~near
    return _Like(
        paint,
        ~paint & near & (as_ground > FOOTPRINTS.min_cosine),
        ~paint & (length < least * colour_length),
        brightness,
    )


def _whole(like: _Like, seed: Bools, way: Way) -> Bools | None:
    # Area between the thick parts of a connected colour that belong to a seed's car.
    # Bay lines and mirrors are thin. Where there is ground in between, only the area that the colour encloses
    # around the seed.
    square = np.ones((3, 3), bool)
    gap = FOOTPRINTS.max_gap_px
    closed = binary_closing(np.pad(like.paint | seed, gap), square, iterations=gap)[gap:-gap, gap:-gap]
    if way.apart:
        closed = binary_opening(closed, square, iterations=FOOTPRINTS.bridge_px) | seed
    parts, _ = label(closed | like.dark if way.windows else closed, square)
    seed_parts = np.unique(parts[seed])
    filled = binary_fill_holes(closed & np.isin(parts, seed_parts[seed_parts > 0]))
    depth = distance_transform_edt(filled)
    # depth at the seed: a wall that the car touches may be wider
    thick = max(FOOTPRINTS.min_half_width_px, FOOTPRINTS.thin * float(depth[seed].max()))
    cores, count = label(depth > thick, square)
    sizes = np.bincount(cores[seed & (cores > 0)], minlength=count + 1)
    return None if not sizes.any() else _gathered(cores, int(np.argmax(sizes)), thick, depth, filled, like)


def _gathered(
    cores: npt.NDArray[np.int32], first: int, thick: float, depth: Floats, filled: Bools, like: _Like
) -> Bools:
    whole = cores == first
    around = hull_of(_grown(whole, thick, filled))
    sizes = np.bincount(cores.ravel())
    remaining = [int(core) for core in np.flatnonzero(sizes > thick * thick) if core not in (0, first)]
    gaps: dict[int, float] = {}
    while remaining:
        if not gaps:
            away = distance_transform_edt(~whole)
            gaps = dict(zip(remaining, minimum(away, cores, remaining).tolist(), strict=True))
        nearest = min(remaining, key=lambda core: (gaps[core], core))
        remaining.remove(nearest)
        wider = whole | (cores == nearest)
        if gaps[nearest] > FOOTPRINTS.max_apart * float(depth[wider].max()):
            break
        hull = hull_of(_grown(wider, thick, filled))
        narrow = _rectangle(hull).width < FOOTPRINTS.max_width * 2.0 * float(depth[wider].max())
        if narrow and (hull & like.ground).sum() < FOOTPRINTS.max_ground_share * hull.sum():
            whole, around, gaps = wider, hull, {}
    return around


def _grown(core: Bools, thick: float, filled: Bools) -> Bools:
    # Pixels of a mask within a distance [pixel] of its core
    reach = int(np.ceil(thick))
    lines, columns = (np.flatnonzero(core.any(axis=axis)) for axis in (1, 0))
    near = tuple(
        slice(max(int(places[0]) - reach, 0), int(places[-1]) + reach + 1) for places in (lines, columns)
    )
    grown = np.zeros_like(core)
    grown[near] = (distance_transform_edt(~core[near]) <= thick) & filled[near]
    return grown


def hull_of(mask: Bools) -> Bools:
    """Return the convex hull of a mask (line, column)."""
    points = _border(mask)
    if np.linalg.matrix_rank(points - points[0]) < 2:
        return mask
    down, right, offset = ConvexHull(points).equations.T
    lines, columns = mask.shape
    # intersections of every line with the sides: sides on its right end it, those on its left begin it
    reach = -(np.arange(lines)[:, None] * down + offset)
    steep = np.where(np.abs(right) > _ROUNDING, right, np.nan)
    last = np.where(right > _ROUNDING, reach / steep, np.inf).min(axis=1)
    first = np.where(right < -_ROUNDING, reach / steep, -np.inf).max(axis=1)
    level = np.where(np.abs(right) > _ROUNDING, 0.0, reach).min(axis=1) >= -_ROUNDING
    x = np.arange(columns)
    inside = (x >= first[:, None] - _ROUNDING) & (x <= last[:, None] + _ROUNDING)
    return np.asarray(inside & level[:, None])


def _border(mask: Bools) -> Floats:
    # First and the last pixel of every line of a mask (point, 2)
    rows = np.flatnonzero(mask.any(axis=1))
    seen = mask[rows]
    first, last = seen.argmax(axis=1), mask.shape[1] - 1 - seen[:, ::-1].argmax(axis=1)
    return np.stack([np.repeat(rows, 2), np.stack([first, last], axis=1).ravel()], axis=1).astype(np.float64)


class _Rectangle(NamedTuple):
    # Axis, centre, length and width of a rectangle; the axis is along its longer side
    axis: Floats
    middle: Floats
    length: float
    width: float


def _rectangle(mask: Bools) -> _Rectangle:
    points = _border(mask)
    turn = np.radians(np.arange(0.0, 90.0, FOOTPRINTS.turn_deg))
    axes = np.stack([np.sin(turn), np.cos(turn)], axis=1)
    asides = np.stack([np.cos(turn), -np.sin(turn)], axis=1)
    u, v = points @ axes.T, points @ asides.T
    long, wide = np.ptp(u, axis=0) + 1.0, np.ptp(v, axis=0) + 1.0
    area = long * wide
    best = int(np.flatnonzero(area <= area.min() + _ROUNDING)[0])
    along, aside = axes[best], asides[best]
    middle = 0.5 * (
        (u[:, best].min() + u[:, best].max()) * along + (v[:, best].min() + v[:, best].max()) * aside
    )
    length, width = float(long[best]), float(wide[best])
    if length >= width:
        return _Rectangle(along, middle, length, width)
    return _Rectangle(aside, middle, width, length)
