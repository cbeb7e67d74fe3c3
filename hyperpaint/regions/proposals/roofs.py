"""The roof of a car: between windows, or too long for a bonnet."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import map_coordinates

from hyperpaint.base.arrays import Bools, Floats

from .footprints import Footprint
from .proposal_rules import FOOTPRINTS, ROOFS


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


class _Frame(NamedTuple):
    # Coordinates of pixels on a car
    along: Floats  #: (line, column): Distance from its end along its axis [pixel].
    across: Floats  #: (line, column): Distance from its axis [half widths].
    length: float
    width: float
    axis: Floats  #: Unit vector (line, column) along it.


class _Neighbours(NamedTuple):
    # Windows and paint beside a section of paint
    sided: float  #: Share of the section with side windows.
    windows: list[_Run]  #: Windows at its ends.
    has_bonnet: bool  #: Whether a bonnet or a boot lies beyond one of these windows.
    is_between: bool  #: Whether paint lies beyond both.


def find_roof(car: Footprint, level: Floats) -> Roof | NoRoof:
    """Return the roof of a car, or the reason why none is found.

    Takes ``car``: its footprint; ``level`` (line, column): mean reflectance in its window [1].
    """
    # pixels as dark as windows
    paint_level = float(np.median(level[car.paint & car.area]))
    limit = min(max(ROOFS.max_window_level, ROOFS.max_window_of_paint * paint_level), paint_level)
    glass = np.asarray(~car.paint & car.area & (level < limit))
    roof = _roof_along(car, glass, level, _frame(car, car.axis, car.length, car.width))
    if isinstance(roof, NoRoof) and car.cut:
        # the longer side of a car cut off by the picture's edge may be its width
        aside = np.array([car.axis[1], -car.axis[0]])
        turned_roof = _roof_along(car, glass, level, _frame(car, aside, car.width, car.length))
        return roof if isinstance(turned_roof, NoRoof) else turned_roof
    return roof


def _aside(frame: _Frame) -> Floats:
    # Unit vector (line, column) across a car
    return np.array([frame.axis[1], -frame.axis[0]])


def _frame(car: Footprint, axis: Floats, length: float, width: float) -> _Frame:
    y, x = np.indices(car.area.shape, np.float64)
    y, x = y - car.centre[0], x - car.centre[1]
    across = (y * axis[1] - x * axis[0]) / (0.5 * width)
    return _Frame(y * axis[0] + x * axis[1] + 0.5 * length, across, length, width, axis)


def _roof_along(car: Footprint, glass: Bools, level: Floats, frame: _Frame) -> Roof | NoRoof:
    crossed = (
        _share_of_tracks(glass, car.area & (np.abs(frame.across) < ROOFS.middle), frame) > ROOFS.min_crossed
    )
    runs = _runs(crossed, ROOFS.max_strip * frame.length)
    if not any(run.is_window for run in runs):
        return NoRoof("no window crosses it: it may not belong to a car", False)
    beside = _windows_beside(car, glass, frame)
    best: Roof | None = None
    for number, run in enumerate(runs):
        if run.is_window or run.length < ROOFS.min_roof_px:
            continue
        neighbours = _neighbours(runs, number, beside, frame)
        grounds = _judge_run(car, runs, number, neighbours, frame)
        if grounds is None or (best is not None and best.worth >= grounds[1]):
            continue
        along, unsure = _level_place(car, runs, number, frame)
        sides = _sides(car, glass, level, frame, run)
        section = car.area & (frame.along >= run.start) & (frame.along < run.stop)
        inside = section & (np.abs(frame.across - sides.centre) < ROOFS.used_width * sides.half)
        # the sides of a car at the picture's edge must be visible
        if inside.any() and not (car.cut and not sides.are_visible):
            line, column = (
                car.centre
                + (along - 0.5 * frame.length) * frame.axis
                + 0.5 * frame.width * sides.centre * _aside(frame)
            )
            centre = float(line), float(column)
            complete = 1 < number < len(runs) - 2
            best = Roof(
                inside,
                centre,
                frame.axis,
                unsure,
                sides.unsure,
                *grounds,
                complete
                and (neighbours.is_between or (neighbours.has_bonnet and neighbours.sided > ROOFS.sided)),
                neighbours.has_bonnet and neighbours.sided > ROOFS.surely_sided,
                _window_level(glass, neighbours.windows, frame, level),
            )
    if best is not None:
        return best
    is_car = car.is_one_car and float(beside.mean()) > ROOFS.van_sided
    return NoRoof("no roof: no section lies between windows, or is longer than a bonnet", is_car)


def _neighbours(runs: list[_Run], number: int, beside: Bools, frame: _Frame) -> _Neighbours:
    def sided(run: _Run) -> float:
        return float(beside[run.start : run.stop].mean())

    windows, beyond = (
        [runs[section] for section in (number - step, number + step) if 0 <= section < len(runs)]
        for step in (1, 2)
    )
    long = [section for section in beyond if section.length > ROOFS.min_bonnet * frame.length]
    has_bonnet = any(sided(section) < ROOFS.sided for section in long)
    return _Neighbours(sided(runs[number]), windows, has_bonnet, len(long) == 2)


def _window_level(glass: Bools, windows: list[_Run], frame: _Frame, level: Floats) -> float:
    # Median mean reflectance of windows across a car [1]
    inside = np.zeros_like(glass)
    for run in windows:
        inside |= (frame.along >= run.start) & (frame.along < run.stop)
    inside &= glass & (np.abs(frame.across) < ROOFS.middle)
    return float(np.median(level[inside])) if inside.any() else np.nan


def _judge_run(
    car: Footprint, runs: list[_Run], number: int, neighbours: _Neighbours, frame: _Frame
) -> tuple[str, float] | None:
    # Reason and worth of a section as the roof; None where it may be another body part
    run, sided = runs[number], neighbours.sided
    share = run.length / frame.length
    ends = int(number > 0) + int(number + 1 < len(runs))
    evidence = f"side windows along {sided:.0%} of it"
    # a bed has walls along it, too, but no paint beyond both ends
    worth = share + sided + (ROOFS.between_worth if neighbours.is_between else 0.0)
    if car.cut:
        if ends == 2 and sided > ROOFS.long_sided and run.length > ROOFS.min_roof_of_cut * frame.width:
            return f"a roof: windows end it on both sides, {evidence}", worth
        return None
    if share < ROOFS.min_roof:
        return None
    min_slenderness = (
        ROOFS.min_slenderness if ends == 2 and sided > ROOFS.surely_sided else FOOTPRINTS.slenderness[0]
    )
    if not min_slenderness < frame.length / frame.width < FOOTPRINTS.slenderness[1]:
        return None
    evidence = f"{share:.0%} of the car's length, {evidence}"
    centre = 0.5 * (run.start + run.stop) / frame.length
    # a section between a windscreen and the car's own shadow looks as if it ended at two windows
    if ends == 2 and not neighbours.is_between and (share < ROOFS.short_roof or sided < ROOFS.van_sided):
        return None
    if ends == 2 and (sided > ROOFS.sided or ROOFS.central[0] < centre < ROOFS.central[1]):
        return f"a roof: windows end it on both sides, {evidence}", worth
    if ends == 1 and sided > ROOFS.surely_sided:
        return f"a roof: a window ends it, {evidence}", worth
    if (
        ends == 1
        and ROOFS.min_van_roof < share < ROOFS.max_van_roof
        and _is_behind_bonnet(runs, number, frame)
    ):
        reason = f"a roof: it is all of the car behind a windscreen with a bonnet, {evidence}"
        return reason, worth
    if (
        ends == 1
        and ROOFS.max_bonnet < share < ROOFS.max_van_roof
        and sided > (ROOFS.long_sided if share < ROOFS.min_van_roof else ROOFS.van_sided)
    ):
        return f"a roof: a window ends it, and it is longer than any bonnet, {evidence}", share + sided
    return None


def _is_behind_bonnet(runs: list[_Run], number: int, frame: _Frame) -> bool:
    if len(runs) != 3 or number == 1:
        return False
    bonnet = runs[2 - number].length / frame.length
    window = runs[1].length / frame.length
    return ROOFS.min_bonnet < bonnet < ROOFS.max_bonnet and window < ROOFS.max_windscreen


def _level_place(car: Footprint, runs: list[_Run], number: int, frame: _Frame) -> tuple[float, float]:
    # Position along the car where a roof is level, and its maximum error [pixel].
    # A window longer than `min_sunroof` contains a sunroof: then the roof is level at this window's edge.
    # Where less than a tail follows, as behind the bed of a pickup, it is no sunroof.
    run, car_length = runs[number], frame.length
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


class _Sides(NamedTuple):
    # Sides of a roof across the car [half widths]
    centre: float  #: Position halfway between them.
    half: float  #: Half the distance between them.
    unsure: float  #: Maximum error of the centre [pixel].
    are_visible: bool  #: Whether both sides are visible.


def _sides(car: Footprint, glass: Bools, level: Floats, frame: _Frame, run: _Run) -> _Sides:
    # Sides of a roof: where brightness falls most steeply, else where side windows begin.
    # A threshold would fail under a low sun, where the side that leans away from it is darker than other
    # paint. Paint as dark as windows shows no fall.
    section = car.area & (frame.along >= run.start) & (frame.along < run.stop)
    left_side, right_side = (_step(level, car, sign, frame, run) for sign in (-1, 1))
    unsure = ROOFS.unsure_side_px
    half_width = 0.5 * frame.width
    if np.isnan(left_side) or np.isnan(right_side):
        left_side, right_side = (_edge(glass & section, sign, frame, run) for sign in (-1, 1))
        unsure = ROOFS.unsure_window_px
    are_visible = bool(np.isfinite(left_side) and np.isfinite(right_side))
    if not are_visible:
        unsure = ROOFS.unsure_width * half_width
    if np.isnan(left_side) and np.isnan(right_side):
        left_side = right_side = ROOFS.roof_width
    left_side, right_side = (
        2 * ROOFS.roof_width - opposite if np.isnan(side) else side
        for side, opposite in ((left_side, right_side), (right_side, left_side))
    )
    return _Sides(0.5 * (right_side - left_side), 0.5 * (right_side + left_side), unsure, are_visible)


def _step(level: Floats, car: Footprint, sign: int, frame: _Frame, run: _Run) -> float:
    # Distance from the axis to the first fall of brightness as at a window, on one side [half widths].
    # Median over the tracks of a section; NaN where too few tracks show such a fall.
    half_width = 0.5 * frame.width
    distances = np.arange(ROOFS.side * half_width, ROOFS.beyond * half_width, ROOFS.step_px)
    along = np.arange(run.start + 0.5, run.stop) - 0.5 * frame.length
    positions = (
        np.array(car.centre)[:, None, None]
        + frame.axis[:, None, None] * along[None, :, None]
        + sign * _aside(frame)[:, None, None] * distances[None, None, :]
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


def _edge(glass: Bools, sign: int, frame: _Frame, run: _Run) -> float:
    # Distance from the axis where side windows begin, on one side [half widths].
    # Median over the tracks of a section; NaN without side windows.
    beside = glass & (sign * frame.across > ROOFS.side)
    nearest = np.full(run.length, np.inf)
    track = (np.floor(frame.along[beside]).astype(np.int64) - run.start).clip(0, run.length - 1)
    np.minimum.at(nearest, track, sign * frame.across[beside])
    edges = nearest[np.isfinite(nearest)]
    return float(np.median(edges)) if edges.size >= ROOFS.min_seen * nearest.size else np.nan


def _share_of_tracks(mask: Bools, domain: Bools, frame: _Frame) -> Floats:
    # Share of the pixels of `domain` that are in `mask`, for every track across a car (track,)
    count = round(frame.length)
    track = np.floor(frame.along[domain]).astype(np.int64).clip(0, count - 1)
    counts = np.bincount(track, minlength=count)
    return np.asarray(np.bincount(track, mask[domain], count) / np.maximum(counts, 1))


def _windows_beside(car: Footprint, glass: Bools, frame: _Frame) -> Bools:
    # Tracks with side windows (track,), on the side with more of them.
    # Beyond a window there is a lit door; beyond dark pixels of the car's shadow nothing is lit.
    count = round(frame.length)
    track = np.floor(frame.along).astype(np.int64).clip(0, count - 1)
    side_windows = []
    for sign in (-1, 1):
        aside = sign * frame.across
        lit = car.area & ~glass & (aside > ROOFS.middle)
        outermost = np.zeros(count)
        np.maximum.at(outermost, track[lit], aside[lit])
        window = glass & (aside > ROOFS.middle) & (aside < outermost[track])
        side_windows.append(np.bincount(track[window], minlength=count) >= ROOFS.min_window_px)
    return max(side_windows, key=lambda tracks: int(tracks.sum()))


def _runs(crossed: Bools, strip: float) -> list[_Run]:
    # Sections of paint and of windows from one end of the car to the other.
    # Paint shorter than `strip` [pixel] between windows, as before a sunroof, is merged with the windows.
    ends = np.flatnonzero(np.diff(crossed.astype(np.int8), prepend=2, append=2))
    stretches = [
        _Run(a, b, bool(crossed[a])) for a, b in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True)
    ]
    merged: list[_Run] = []
    for number, run in enumerate(stretches):
        min_length = strip if 0 < number < len(stretches) - 1 and not run.is_window else ROOFS.min_window_px
        if merged and (run.length < min_length or merged[-1].is_window == run.is_window):
            merged[-1] = _Run(merged[-1].start, run.stop, merged[-1].is_window)
        else:
            merged.append(run)
    return merged
