"""Footprint of a car around a piece of its paint, and its roof: between windows, or too long for a bonnet."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.ndimage import (
    binary_closing,
    binary_fill_holes,
    binary_opening,
    distance_transform_edt,
    label,
    map_coordinates,
    minimum,
)
from scipy.spatial import ConvexHull

from hyperpaint.base.arrays import Bools, Floats

from .candidates import Picture, window_of
from .proposal_rules import FOOTPRINTS, ROOFS, SURFACES

_ROUNDING = 1e-6

#: Rules for joining parts of a car, from the strictest on; parts that touch are always joined. Each tells
#: whether far brighter or darker parts are of the same paint, such as flakes at another lean; whether parts
#: with only dark pixels between them are joined; and whether thin bridges, such as a mirror that touches a
#: bay line, separate parts.
JOININGS = tuple(product((False, True), (False, True), (False, True)))


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
    inside: Bools,
    origin: tuple[int, int],
    colour: Floats,
    picture: Picture,
    joinings: Sequence[tuple[bool, bool, bool]],
) -> Iterator[Footprint]:
    """Yield the footprint of the car around a piece of paint, for each of the rules for joining parts.

    Rules with which the paint extends beyond the largest margin yield nothing. Takes ``inside`` (line,
    column): the piece; ``origin``: line and column of its first pixel; ``colour`` (channel,): its
    reflectance, less the mirrored sky [1]; ``joinings``: see `JOININGS`.
    """
    shape = np.array(picture.level.shape)
    matches: dict[tuple[int, bool], tuple[Bools, Bools, Bools, Floats]] = {}
    for wide_brightness, over_windows, cut_bridges in joinings:
        pad = min(int(FOOTPRINTS.margin * max(inside.shape)), FOOTPRINTS.max_margin_px)
        for _ in range(FOOTPRINTS.rounds):
            low = np.maximum(np.array(origin) - pad, 0)
            high = np.minimum(np.array(origin) + inside.shape + pad, shape)
            key = pad, wide_brightness
            if key not in matches:
                window = np.s_[low[0] : high[0], low[1] : high[1]]
                matches[key] = _matched_colour(colour, picture, window, wide_brightness)
            paint, ground, dark, brightness = matches[key]
            seed = np.zeros(paint.shape, bool)
            y, x = np.array(origin) - low
            seed[y : y + inside.shape[0], x : x + inside.shape[1]] = inside
            area = _car_area(seed, paint | seed, ground, dark if over_windows else None, cut_bridges)
            if area is None:
                break
            # whether the car reaches the first line and column of the window, and the last ones
            sides = np.array([[area[0].any(), area[:, 0].any()], [area[-1].any(), area[:, -1].any()]])
            if not (sides & ~np.array([low == 0, high == shape])).any():
                window_origin = (int(low[0]), int(low[1]))
                cut = bool(sides.any())
                yield Footprint(window_origin, paint | seed, area, brightness, *_rectangle(area), cut)
                break
            pad = int(FOOTPRINTS.growth * pad) + 8


def _matched_colour(
    colour: Floats, picture: Picture, window: tuple[slice, slice], wide_brightness: bool
) -> tuple[Bools, Bools, Bools, Floats]:
    # Pixels (line, column) of paint, of ground, and darker than paint; brightness relative to the paint
    spectra = picture.without_sky(window)
    length = np.maximum(np.linalg.norm(spectra, axis=2), 1e-9)
    colour_length, ground_length = float(np.linalg.norm(colour)), float(np.linalg.norm(picture.ground))
    brightness = (spectra @ colour) / colour_length**2
    paint_cosine = brightness * colour_length / length
    is_dark = float(colour.mean()) < SURFACES.dark
    low, high = (FOOTPRINTS.dark_brightness if is_dark else FOOTPRINTS.brightness)[wide_brightness]
    paint = (paint_cosine > FOOTPRINTS.min_cosine) & (brightness > low) & (brightness < high)
    # pixels as bright as the ground are paint only if their spectrum is closer to the paint's
    ground_cosine = (spectra @ picture.ground) / (length * ground_length)
    is_ground_bright = np.abs(np.log(length / ground_length)) < FOOTPRINTS.max_ground_log_ratio
    paint &= (paint_cosine > ground_cosine) | ~is_ground_bright
    ground = ~paint & is_ground_bright & (ground_cosine > FOOTPRINTS.min_cosine)
    return paint, ground, ~paint & (length < low * colour_length), brightness


def _car_area(
    seed: Bools, paint: Bools, ground: Bools, dark: Bools | None, cut_bridges: bool
) -> Bools | None:
    # Area of the car around a seed: the hull of thick connected parts with the colour of its paint.
    # Bay lines and mirrors are thin. Parts with ground between them and the seed are not added. With `dark`,
    # parts with only dark pixels between them are connected.
    square = np.ones((3, 3), bool)
    gap = FOOTPRINTS.max_gap_px
    closed = binary_closing(np.pad(paint, gap), square, iterations=gap)[gap:-gap, gap:-gap]
    if cut_bridges:
        closed = binary_opening(closed, square, iterations=FOOTPRINTS.bridge_px) | seed
    parts, _ = label(closed if dark is None else closed | dark, square)
    seed_parts = np.unique(parts[seed])
    filled = binary_fill_holes(closed & np.isin(parts, seed_parts[seed_parts > 0]))
    depth = distance_transform_edt(filled)
    # the depth at the seed counts: a wall that the car touches may be wider
    min_depth = max(FOOTPRINTS.min_half_width_px, FOOTPRINTS.thin * float(depth[seed].max()))
    cores, count = label(depth > min_depth, square)
    seed_sizes = np.bincount(cores[seed & (cores > 0)], minlength=count + 1)
    if not seed_sizes.any():
        return None
    # hull of the seed's core and of further cores, added from the nearest on while their gap, the width of
    # the hull and the ground in it stay within the limits of a car
    seed_core = int(np.argmax(seed_sizes))
    car_cores = cores == seed_core
    area = _hull_around(car_cores, min_depth, filled)
    large_cores = np.flatnonzero(np.bincount(cores.ravel()) > min_depth * min_depth).tolist()
    candidates = [core for core in large_cores if core not in (0, seed_core)]
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
        hull = _hull_around(larger_cores, min_depth, filled)
        is_narrow = _rectangle(hull)[3] < FOOTPRINTS.max_width * 2.0 * half_width
        if is_narrow and (hull & ground).sum() < FOOTPRINTS.max_ground_share * hull.sum():
            car_cores, area, gaps = larger_cores, hull, {}
    return area


def _hull_around(core: Bools, radius: float, filled: Bools) -> Bools:
    # Convex hull of the pixels of the mask `filled` within a distance [pixel] of a core
    pad = int(np.ceil(radius))
    window = tuple(
        slice(max(int(indices[0]) - pad, 0), int(indices[-1]) + pad + 1)
        for indices in (np.flatnonzero(core.any(axis=axis)) for axis in (1, 0))
    )
    grown = np.zeros_like(core)
    grown[window] = (distance_transform_edt(~core[window]) <= radius) & filled[window]
    return hull_of(grown)


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


def _rectangle(mask: Bools) -> tuple[Floats, Floats, float, float]:
    # Direction of the longer side, centre, length and width of the rectangle with the smallest area around a
    # mask, among directions in steps of `turn_deg`
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
    return (along, centre, length, width) if length >= width else (aside, centre, width, length)


# --- the roof of a car -------------------------------------------------------------------------------------


class Roof(NamedTuple):
    """The roof of a car."""

    inside: Bools  #: (line, column): Its pixels, in the footprint's window.
    centre: tuple[float, float]  #: Line and column of its level position in that window.
    axis: Floats  #: Unit vector (line, column) along the car.
    unsure: float  #: Maximum error of the level position along the car [pixel].
    unsure_across: float  #: The same across the car [pixel].
    reason: str  #: Evidence that it is a roof.
    worth: float  #: Weight of this evidence; the roof with the largest worth is chosen.
    complete: bool  #: Whether it lies between two windows with paint beyond both.
    sided: bool  #: Whether a window at its end has a bonnet beyond, and side windows run along it.
    window_level: float  #: Median mean reflectance of the windows at its ends [1].


class NoRoof(NamedTuple):
    """Reason why no roof is found, and whether it is still a car."""

    reason: str
    is_car: bool


class _Run(NamedTuple):
    # A section of a car along its axis, of windows or of paint: tracks `start` to before `stop` [pixel]
    start: int
    stop: int
    is_window: bool

    @property
    def length(self) -> int:
        return self.stop - self.start


class _Tracks(NamedTuple):
    # Coordinates of the pixels of a car and its windows (line, column); a track is a row of pixels across it
    along: Floats  #: Distance from its end along its axis [pixel].
    across: Floats  #: Distance from its axis [half widths].
    glass: Bools  #: Pixels as dark as windows.
    level: Floats  #: Mean reflectance [1].

    def within(self, run: _Run) -> Bools:
        return (self.along >= run.start) & (self.along < run.stop)


def find_roof(car: Footprint, level: Floats) -> Roof | NoRoof:
    """Return the roof of a car, or the reason why none is found.

    Takes ``car``: its footprint; ``level`` (line, column): mean reflectance in its window [1].
    """
    # pixels as dark as windows
    paint_level = float(np.median(level[car.paint & car.area]))
    limit = min(max(ROOFS.max_window_level, ROOFS.max_window_of_paint * paint_level), paint_level)
    glass = np.asarray(~car.paint & car.area & (level < limit))
    roof = _roof_along(car, glass, level)
    if isinstance(roof, NoRoof) and car.cut:
        # the longer side of a car cut off by the picture's edge may be its width
        turned = car._replace(axis=_aside(car), length=car.width, width=car.length)
        turned_roof = _roof_along(turned, glass, level)
        return roof if isinstance(turned_roof, NoRoof) else turned_roof
    return roof


def _aside(car: Footprint) -> Floats:
    # Unit vector (line, column) across a car
    return np.array([car.axis[1], -car.axis[0]])


def _roof_along(car: Footprint, glass: Bools, level: Floats) -> Roof | NoRoof:
    y, x = np.indices(car.area.shape, np.float64)
    y, x = y - car.centre[0], x - car.centre[1]
    across = (y * car.axis[1] - x * car.axis[0]) / (0.5 * car.width)
    tracks = _Tracks(y * car.axis[0] + x * car.axis[1] + 0.5 * car.length, across, glass, level)
    runs = _runs(car, tracks)
    if not any(run.is_window for run in runs):
        return NoRoof("no window crosses it: it may not belong to a car", False)
    beside = _windows_beside(car, tracks)

    def sided(run: _Run) -> float:
        # Share of a section with side windows
        return float(beside[run.start : run.stop].mean())

    best: Roof | None = None
    for number, run in enumerate(runs):
        if run.is_window or run.length < ROOFS.min_roof_px:
            continue
        # windows at the ends of the section, and the paint beyond them
        windows, beyond = (
            [runs[section] for section in (number - step, number + step) if 0 <= section < len(runs)]
            for step in (1, 2)
        )
        long = [section for section in beyond if section.length > ROOFS.min_bonnet * car.length]
        has_bonnet = any(sided(section) < ROOFS.sided for section in long)
        grounds = _judge_run(car, runs, number, sided(run), len(long) == 2)
        if grounds is None or (best is not None and best.worth >= grounds[1]):
            continue
        along, unsure = _level_place(car, runs, number)
        centre, half, unsure_across, are_visible = _sides(car, tracks, run)
        inside = car.area & tracks.within(run) & (np.abs(across - centre) < ROOFS.used_width * half)
        # the sides of a car at the picture's edge must be visible
        if not inside.any() or (car.cut and not are_visible):
            continue
        line, column = (
            car.centre + (along - 0.5 * car.length) * car.axis + 0.5 * car.width * centre * _aside(car)
        )
        is_between = len(long) == 2 or (has_bonnet and sided(run) > ROOFS.sided)
        of_windows = np.logical_or.reduce([tracks.within(window) for window in windows])
        of_windows &= glass & (np.abs(across) < ROOFS.middle)
        best = Roof(
            inside,
            (float(line), float(column)),
            car.axis,
            unsure,
            unsure_across,
            *grounds,
            1 < number < len(runs) - 2 and is_between,
            has_bonnet and sided(run) > ROOFS.surely_sided,
            float(np.median(level[of_windows])) if of_windows.any() else np.nan,
        )
    if best is not None:
        return best
    is_car = car.is_one_car and float(beside.mean()) > ROOFS.van_sided
    return NoRoof("no roof: no section lies between windows, or is longer than a bonnet", is_car)


def _judge_run(
    car: Footprint, runs: list[_Run], number: int, sided: float, is_between: bool
) -> tuple[str, float] | None:
    # Reason and worth of a section as the roof; None where it may be another body part.
    # `sided`: its share with side windows; `is_between`: whether paint lies beyond the windows at both ends.
    run = runs[number]
    share = run.length / car.length
    ends = int(number > 0) + int(number + 1 < len(runs))
    evidence = f"side windows along {sided:.0%} of it"
    # a bed has walls along it, too, but no paint beyond both ends
    worth = share + sided + (ROOFS.between_worth if is_between else 0.0)
    if car.cut:
        if ends == 2 and sided > ROOFS.long_sided and run.length > ROOFS.min_roof_of_cut * car.width:
            return f"a roof: windows end it on both sides, {evidence}", worth
        return None
    # a section between a windscreen and the car's own shadow looks as if it ended at two windows
    min_slenderness = (
        ROOFS.min_slenderness if ends == 2 and sided > ROOFS.surely_sided else FOOTPRINTS.slenderness[0]
    )
    if (
        share < ROOFS.min_roof
        or not min_slenderness < car.length / car.width < FOOTPRINTS.slenderness[1]
        or (ends == 2 and not is_between and (share < ROOFS.short_roof or sided < ROOFS.van_sided))
    ):
        return None
    evidence = f"{share:.0%} of the car's length, {evidence}"
    centre = 0.5 * (run.start + run.stop) / car.length
    if ends == 2 and (sided > ROOFS.sided or ROOFS.central[0] < centre < ROOFS.central[1]):
        return f"a roof: windows end it on both sides, {evidence}", worth
    if ends == 1 and sided > ROOFS.surely_sided:
        return f"a roof: a window ends it, {evidence}", worth
    if ends != 1 or not share < ROOFS.max_van_roof:
        return None
    is_behind_bonnet = (
        len(runs) == 3
        and ROOFS.min_bonnet < runs[2 - number].length / car.length < ROOFS.max_bonnet
        and runs[1].length / car.length < ROOFS.max_windscreen
    )
    if share > ROOFS.min_van_roof and is_behind_bonnet:
        return f"a roof: it is all of the car behind a windscreen with a bonnet, {evidence}", worth
    min_sided = ROOFS.long_sided if share < ROOFS.min_van_roof else ROOFS.van_sided
    if share > ROOFS.max_bonnet and sided > min_sided:
        return f"a roof: a window ends it, and it is longer than any bonnet, {evidence}", share + sided
    return None


def _level_place(car: Footprint, runs: list[_Run], number: int) -> tuple[float, float]:
    # Position along the car where a roof is level, and its maximum error [pixel].
    # A window longer than `min_sunroof` contains a sunroof: then the roof is level at this window's edge.
    # Where less than a tail follows, as behind the bed of a pickup, it is no sunroof.
    run, car_length = runs[number], car.length
    centre = 0.5 * (run.start + run.stop)
    for step in (-1, 1):
        if car.cut or not 0 <= number + step < len(runs) or run.length > ROOFS.max_bonnet * car_length:
            continue
        window = runs[number + step].length
        edge = float(run.start if step < 0 else run.stop)
        beyond = sum(section.length for section in (runs[: number - 1] if step < 0 else runs[number + 2 :]))
        if beyond < ROOFS.min_tail * car_length:
            continue
        if window > ROOFS.min_sunroof * car_length:
            return edge, ROOFS.unsure_beside * car_length
        if window > ROOFS.max_windscreen * car_length:
            return centre, abs(centre - edge)
    return centre, ROOFS.unsure * car_length


def _sides(car: Footprint, tracks: _Tracks, run: _Run) -> tuple[float, float, float, bool]:
    # Position halfway between the sides of a roof, and half their distance [half widths]; maximum error of
    # this position [pixel]; and whether both sides are visible.
    # A side is where brightness falls most steeply, else where side windows begin. A threshold would fail
    # under a low sun, where the side that leans away from it is darker than other paint. Paint as dark as
    # windows shows no fall.
    left_side, right_side = (_step(car, tracks.level, sign, run) for sign in (-1, 1))
    unsure = ROOFS.unsure_side_px
    if np.isnan(left_side) or np.isnan(right_side):
        left_side, right_side = (_edge(tracks, sign, run) for sign in (-1, 1))
        unsure = ROOFS.unsure_window_px
    are_visible = bool(np.isfinite(left_side) and np.isfinite(right_side))
    if not are_visible:
        unsure = ROOFS.unsure_width * (0.5 * car.width)
    if np.isnan(left_side) and np.isnan(right_side):
        left_side = right_side = ROOFS.roof_width
    left_side, right_side = (
        2 * ROOFS.roof_width - opposite if np.isnan(side) else side
        for side, opposite in ((left_side, right_side), (right_side, left_side))
    )
    return 0.5 * (right_side - left_side), 0.5 * (right_side + left_side), unsure, are_visible


def _step(car: Footprint, level: Floats, sign: int, run: _Run) -> float:
    # Distance from the axis to the first fall of brightness as at a window, on one side [half widths].
    # Median over the tracks of a section; NaN where too few tracks show such a fall.
    half_width = 0.5 * car.width
    distances = np.arange(ROOFS.side * half_width, ROOFS.beyond * half_width, ROOFS.step_px)
    along = np.arange(run.start + 0.5, run.stop) - 0.5 * car.length
    positions = (
        np.array(car.centre)[:, None, None]
        + car.axis[:, None, None] * along[None, :, None]
        + sign * _aside(car)[:, None, None] * distances[None, None, :]
    )
    profiles = map_coordinates(np.log(np.maximum(level, ROOFS.black)), positions, order=1, mode="nearest")
    span, stay = round(1.0 / ROOFS.step_px), round(max(1.0, ROOFS.window_width * half_width) / ROOFS.step_px)
    inner, outer = (
        profiles[:, : -span - stay],
        [profiles[:, span + n : profiles.shape[1] - stay + n] for n in range(stay)],
    )
    # at a window, unlike at a seam, all pixels beyond the fall are dark
    drop = inner - np.max(outer, axis=0)
    has_drop = (drop > ROOFS.min_step).any(axis=1)
    if has_drop.sum() < ROOFS.min_seen * has_drop.size:
        return np.nan
    fall_start = (drop[has_drop] > ROOFS.min_step).argmax(axis=1)
    steepest = [
        int((profile[at : at + span] - profile[at + span : at + 2 * span]).argmax())
        for profile, at in zip(profiles[has_drop], fall_start, strict=True)
    ]
    return float(np.median(distances[fall_start + steepest] + 0.5)) / half_width


def _edge(tracks: _Tracks, sign: int, run: _Run) -> float:
    # Distance from the axis where side windows begin, on one side [half widths].
    # Median over the tracks of a section; NaN without side windows.
    beside = tracks.within(run) & tracks.glass & (sign * tracks.across > ROOFS.side)
    nearest = np.full(run.length, np.inf)
    track = (np.floor(tracks.along[beside]).astype(np.int64) - run.start).clip(0, run.length - 1)
    np.minimum.at(nearest, track, sign * tracks.across[beside])
    edges = nearest[np.isfinite(nearest)]
    return float(np.median(edges)) if edges.size >= ROOFS.min_seen * nearest.size else np.nan


def _windows_beside(car: Footprint, tracks: _Tracks) -> Bools:
    # Tracks with side windows (track,), on the side with more of them.
    # Beyond a window there is a lit door; beyond dark pixels of the car's shadow nothing is lit.
    count = round(car.length)
    track = np.floor(tracks.along).astype(np.int64).clip(0, count - 1)
    side_windows = []
    for sign in (-1, 1):
        aside = sign * tracks.across
        lit = car.area & ~tracks.glass & (aside > ROOFS.middle)
        outermost = np.zeros(count)
        np.maximum.at(outermost, track[lit], aside[lit])
        window = tracks.glass & (aside > ROOFS.middle) & (aside < outermost[track])
        side_windows.append(np.bincount(track[window], minlength=count) >= ROOFS.min_window_px)
    return max(side_windows, key=lambda windows: int(windows.sum()))


def _runs(car: Footprint, tracks: _Tracks) -> list[_Run]:
    # Sections of paint and of windows from one end of the car to the other.
    # Short strips of paint between windows, as before a sunroof, are merged with the windows.
    middle = car.area & (np.abs(tracks.across) < ROOFS.middle)
    count = round(car.length)
    track = np.floor(tracks.along[middle]).astype(np.int64).clip(0, count - 1)
    counts = np.bincount(track, minlength=count)
    crossed = np.bincount(track, tracks.glass[middle], count) / np.maximum(counts, 1) > ROOFS.min_crossed
    ends = np.flatnonzero(np.diff(crossed.astype(np.int8), prepend=2, append=2))
    stretches = [
        _Run(a, b, bool(crossed[a])) for a, b in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True)
    ]
    merged: list[_Run] = []
    for number, run in enumerate(stretches):
        is_strip = 0 < number < len(stretches) - 1 and not run.is_window
        min_length = ROOFS.max_strip * car.length if is_strip else ROOFS.min_window_px
        if merged and (run.length < min_length or merged[-1].is_window == run.is_window):
            merged[-1] = _Run(merged[-1].start, run.stop, merged[-1].is_window)
        else:
            merged.append(run)
    return merged
