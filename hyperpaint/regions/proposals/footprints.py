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


class Joining(NamedTuple):
    """Rules for joining parts of a car; parts that touch are always joined."""

    cut_bridges: bool = False  #: Whether thin bridges, such as a mirror touching a bay line, separate parts.
    over_windows: bool = False  #: Whether parts with only dark pixels between them are joined.
    #: Whether far brighter or darker parts are of the same paint, such as flakes at another lean.
    wide_brightness: bool = False


JOININGS = tuple(
    Joining(cut_bridges, over_windows, wide_brightness)
    for wide_brightness in (False, True)
    for over_windows in (False, True)
    for cut_bridges in (False, True)
)


class Scene(NamedTuple):
    """The whole picture, prepared for footprints."""

    channels: Array  #: (line, column, channel): Reflectance [1].
    sky: Array  #: (channel,): Sky mirrored by a level clear coat, in reflectance [1].
    level: Array  #: (line, column): Mean reflectance over the channels [1].
    ground: Floats  #: (channel,): Reflectance of the ground, the largest body [1].

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

    origin: tuple[int, int]  #: Line and column of the first pixel of the masks.
    paint: Bools  #: (line, column): Pixels with the colour of its paint, also beside the car.
    area: Bools  #: (line, column): The car: its thick parts with this colour, and the area they enclose.
    brightness: Floats  #: (line, column): Brightness relative to the piece that the footprint began with.
    axis: Floats  #: (2,): Unit vector (line, column) along its longer side.
    centre: Floats  #: (2,): Line and column of its centre in the masks.
    length: float  #: [pixel]
    width: float  #: [pixel]
    cut: bool  #: Whether the edge of the picture cuts it off.

    @property
    def is_one_car(self) -> bool:
        """Whether it has the proportions of one car, and the picture shows all of it."""
        low, high = FOOTPRINTS.slenderness
        return not self.cut and low < self.length / self.width < high

    @property
    def window(self) -> tuple[slice, slice]:
        """Window of the masks in the picture."""
        return window_of(self.origin, self.area)


def footprints_of(
    inside: Bools, origin: tuple[int, int], colour: Floats, scene: Scene, joinings: Sequence[Joining]
) -> Iterator[Footprint]:
    """Yield the footprint of the car around a piece of paint, for each of the rules for joining parts.

    Rules with which the paint extends beyond the largest margin yield nothing. Takes ``inside`` (line,
    column): the piece; ``origin``: line and column of its first pixel; ``colour`` (channel,): its
    reflectance, less the mirrored sky [1]; ``scene``: the picture.
    """
    shape = np.array(scene.level.shape)
    matches: dict[tuple[int, bool], _ColourMatch] = {}
    for joining in joinings:
        pad = min(int(FOOTPRINTS.margin * max(inside.shape)), FOOTPRINTS.max_margin_px)
        for _ in range(FOOTPRINTS.rounds):
            low = np.maximum(np.array(origin) - pad, 0)
            high = np.minimum(np.array(origin) + inside.shape + pad, shape)
            key = pad, joining.wide_brightness
            if key not in matches:
                window = np.s_[low[0] : high[0], low[1] : high[1]]
                matches[key] = _matched_colour(colour, scene, window, joining.wide_brightness)
            match = matches[key]
            seed = np.zeros(match.paint.shape, bool)
            y, x = np.array(origin) - low
            seed[y : y + inside.shape[0], x : x + inside.shape[1]] = inside
            area = _car_area(match, seed, joining)
            if area is None:
                break
            # whether the car reaches the first line and column of the window, and the last ones
            sides = np.array([[area[0].any(), area[:, 0].any()], [area[-1].any(), area[:, -1].any()]])
            if not (sides & ~np.array([low == 0, high == shape])).any():
                window_origin = (int(low[0]), int(low[1]))
                paint, cut = match.paint | seed, bool(sides.any())
                yield Footprint(window_origin, paint, area, match.brightness, *_rectangle(area), cut)
                break
            pad = int(FOOTPRINTS.growth * pad) + 8


class _ColourMatch(NamedTuple):
    # Classes of the pixels in a window (line, column), and their brightness relative to the paint
    paint: Bools
    ground: Bools
    dark: Bools
    brightness: Floats


def _matched_colour(
    colour: Floats, scene: Scene, window: tuple[slice, slice], wide_brightness: bool
) -> _ColourMatch:
    spectra = scene.without_sky(window)
    length = np.maximum(np.linalg.norm(spectra, axis=2), 1e-9)
    colour_length, ground_length = float(np.linalg.norm(colour)), float(np.linalg.norm(scene.ground))
    brightness = (spectra @ colour) / colour_length**2
    paint_cosine = brightness * colour_length / length
    is_dark = float(colour.mean()) < SURFACES.dark
    low, high = (FOOTPRINTS.dark_brightness if is_dark else FOOTPRINTS.brightness)[wide_brightness]
    paint = (paint_cosine > FOOTPRINTS.min_cosine) & (brightness > low) & (brightness < high)
    # pixels as bright as the ground are paint only if their spectrum is closer to the paint's
    ground_cosine = (spectra @ scene.ground) / (length * ground_length)
    is_ground_bright = np.abs(np.log(length / ground_length)) < FOOTPRINTS.max_ground_log_ratio
    paint &= (paint_cosine > ground_cosine) | ~is_ground_bright
    return _ColourMatch(
        paint,
        ~paint & is_ground_bright & (ground_cosine > FOOTPRINTS.min_cosine),
        ~paint & (length < low * colour_length),
        brightness,
    )


def _car_area(match: _ColourMatch, seed: Bools, joining: Joining) -> Bools | None:
    # Area of the car around a seed: the hull of thick connected parts with the colour of its paint.
    # Bay lines and mirrors are thin. Parts with ground between them and the seed are not added.
    square = np.ones((3, 3), bool)
    gap = FOOTPRINTS.max_gap_px
    closed = binary_closing(np.pad(match.paint | seed, gap), square, iterations=gap)[gap:-gap, gap:-gap]
    if joining.cut_bridges:
        closed = binary_opening(closed, square, iterations=FOOTPRINTS.bridge_px) | seed
    parts, _ = label(closed | match.dark if joining.over_windows else closed, square)
    seed_parts = np.unique(parts[seed])
    filled = binary_fill_holes(closed & np.isin(parts, seed_parts[seed_parts > 0]))
    depth = distance_transform_edt(filled)
    # the depth at the seed counts: a wall that the car touches may be wider
    min_depth = max(FOOTPRINTS.min_half_width_px, FOOTPRINTS.thin * float(depth[seed].max()))
    cores, count = label(depth > min_depth, square)
    sizes = np.bincount(cores[seed & (cores > 0)], minlength=count + 1)
    if not sizes.any():
        return None
    return _joined_cores(cores, int(np.argmax(sizes)), min_depth, depth, filled, match)


def _joined_cores(
    cores: npt.NDArray[np.int32],
    seed_core: int,
    min_depth: float,
    depth: Floats,
    filled: Bools,
    match: _ColourMatch,
) -> Bools:
    # Hull of the seed's core and of further cores, added from the nearest on while their gap, the width of
    # the hull and the ground in it stay within the limits of a car
    car_cores = cores == seed_core
    area = hull_of(_grown_core(car_cores, min_depth, filled))
    sizes = np.bincount(cores.ravel())
    candidates = [
        int(core) for core in np.flatnonzero(sizes > min_depth * min_depth) if core not in (0, seed_core)
    ]
    gaps: dict[int, float] = {}
    while candidates:
        if not gaps:
            distance = distance_transform_edt(~car_cores)
            gaps = dict(zip(candidates, minimum(distance, cores, candidates).tolist(), strict=True))
        nearest = min(candidates, key=lambda core: (gaps[core], core))
        candidates.remove(nearest)
        larger_cores = car_cores | (cores == nearest)
        half_width = float(depth[larger_cores].max())
        if gaps[nearest] > FOOTPRINTS.max_gap * half_width:
            break
        hull = hull_of(_grown_core(larger_cores, min_depth, filled))
        is_narrow = _rectangle(hull).width < FOOTPRINTS.max_width * 2.0 * half_width
        if is_narrow and (hull & match.ground).sum() < FOOTPRINTS.max_ground_share * hull.sum():
            car_cores, area, gaps = larger_cores, hull, {}
    return area


def _grown_core(core: Bools, radius: float, filled: Bools) -> Bools:
    # Pixels of the mask `filled` within a distance [pixel] of a core
    pad = int(np.ceil(radius))
    lines, columns = (np.flatnonzero(core.any(axis=axis)) for axis in (1, 0))
    window = tuple(
        slice(max(int(indices[0]) - pad, 0), int(indices[-1]) + pad + 1) for indices in (lines, columns)
    )
    grown = np.zeros_like(core)
    grown[window] = (distance_transform_edt(~core[window]) <= radius) & filled[window]
    return grown


def hull_of(mask: Bools) -> Bools:
    """Return the convex hull of a mask (line, column)."""
    points = _border(mask)
    if np.linalg.matrix_rank(points - points[0]) < 2:
        return mask
    normal_y, normal_x, offset = ConvexHull(points).equations.T
    lines, columns = mask.shape
    # intersections of every line of the mask with the sides of the hull: the nearest side with its normal to
    # the right ends the line, the nearest with its normal to the left begins it
    offsets = -(np.arange(lines)[:, None] * normal_y + offset)
    steep = np.where(np.abs(normal_x) > _ROUNDING, normal_x, np.nan)
    last_x = np.where(normal_x > _ROUNDING, offsets / steep, np.inf).min(axis=1)
    first_x = np.where(normal_x < -_ROUNDING, offsets / steep, -np.inf).max(axis=1)
    crosses = np.where(np.abs(normal_x) > _ROUNDING, 0.0, offsets).min(axis=1) >= -_ROUNDING
    x = np.arange(columns)
    inside = (x >= first_x[:, None] - _ROUNDING) & (x <= last_x[:, None] + _ROUNDING)
    return np.asarray(inside & crosses[:, None])


def _border(mask: Bools) -> Floats:
    # Line and column (point, 2) of the first and the last pixel in every line of a mask
    rows = np.flatnonzero(mask.any(axis=1))
    row_masks = mask[rows]
    first, last = row_masks.argmax(axis=1), mask.shape[1] - 1 - row_masks[:, ::-1].argmax(axis=1)
    return np.stack([np.repeat(rows, 2), np.stack([first, last], axis=1).ravel()], axis=1).astype(np.float64)


class _Rectangle(NamedTuple):
    # Smallest rectangle around a mask; the axis is along its longer side
    axis: Floats
    centre: Floats
    length: float
    width: float


def _rectangle(mask: Bools) -> _Rectangle:
    # rectangle with the smallest area among directions in steps of `turn_deg`
    points = _border(mask)
    turn = np.radians(np.arange(0.0, 90.0, FOOTPRINTS.turn_deg))
    axes = np.stack([np.sin(turn), np.cos(turn)], axis=1)
    asides = np.stack([np.cos(turn), -np.sin(turn)], axis=1)
    u, v = points @ axes.T, points @ asides.T
    lengths, widths = np.ptp(u, axis=0) + 1.0, np.ptp(v, axis=0) + 1.0
    box_areas = lengths * widths
    best = int(np.flatnonzero(box_areas <= box_areas.min() + _ROUNDING)[0])
    along, aside = axes[best], asides[best]
    centre = 0.5 * (
        (u[:, best].min() + u[:, best].max()) * along + (v[:, best].min() + v[:, best].max()) * aside
    )
    length, width = float(lengths[best]), float(widths[best])
    if length >= width:
        return _Rectangle(along, centre, length, width)
    return _Rectangle(aside, centre, width, length)
