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
    middle: tuple[float, float]  #: Where it is level: line and column in that window.
    axis: Floats  #: Unit vector (line, column) along the car.
    unsure: float  #: How far along the car the level place may be elsewhere, at most [pixel].
    unsure_across: float  #: The same across it [pixel].
    reason: str  #: Why it is thought to be one.
    worth: float  #: How sure that is, to choose among several.
    complete: bool  #: Whether it lies between windows, and these between paint.
    #: Whether a window ends it beyond which there is a bonnet, and others run along it.
    sided: bool
    window_level: float  #: Mean reflectance of the windows that end it, the median [1].


class NoRoof(NamedTuple):
    """Reason why no roof is found, and whether it is still a car."""

    reason: str
    is_car: bool


class _Run(NamedTuple):
    # A section of a car along its axis [pixel], of windows or of paint
    first: int
    last: int
    window: bool

    @property
    def length(self) -> int:
        return self.last - self.first


class _Frame(NamedTuple):
    # Places along a car [pixel] from its end, and across it from its axis in half widths (line, column)
    along: Floats
    across: Floats
    length: float
    width: float
    axis: Floats  #: Unit vector (line, column) along it.


class _Around(NamedTuple):
    sided: float  #: Share with side windows.
    windows: list[_Run]  #: Those that end it.
    has_bonnet: bool  #: Whether one of them has a bonnet or a boot beyond.
    is_between: bool  #: Whether there is paint beyond both.


def find_roof(car: Footprint, level: Floats) -> Roof | NoRoof:
    """Return the roof of a car, or the reason why none is found.

    Takes ``car``: its footprint; ``level`` (line, column): mean reflectance in its window [1].
    """
    # pixels as dark as windows
    paint_level = float(np.median(level[car.paint & car.whole]))
    limit = min(max(ROOFS.max_window_level, ROOFS.max_window_of_paint * paint_level), paint_level)
    glass = np.asarray(~car.paint & car.whole & (level < limit))
    roof = _roof_along(car, glass, level, _frame(car, car.axis, car.length, car.width))
    if isinstance(roof, NoRoof) and car.cut:
        # of a car that is cut off, the longer side may be its width
        aside = np.array([car.axis[1], -car.axis[0]])
        other = _roof_along(car, glass, level, _frame(car, aside, car.width, car.length))
        return roof if isinstance(other, NoRoof) else other
    return roof


def _aside(frame: _Frame) -> Floats:
    # Unit vector (line, column) across a car
    return np.array([frame.axis[1], -frame.axis[0]])


def _frame(car: Footprint, axis: Floats, length: float, width: float) -> _Frame:
    y, x = np.indices(car.whole.shape, np.float64)
    y, x = y - car.middle[0], x - car.middle[1]
    across = (y * axis[1] - x * axis[0]) / (0.5 * width)
    return _Frame(y * axis[0] + x * axis[1] + 0.5 * length, across, length, width, axis)


def _roof_along(car: Footprint, glass: Bools, level: Floats, frame: _Frame) -> Roof | NoRoof:
    crossed = (
        _share_of_tracks(glass, car.whole & (np.abs(frame.across) < ROOFS.middle), frame) > ROOFS.min_crossed
    )
    runs = _runs(crossed, ROOFS.max_strip * frame.length)
    if not any(run.window for run in runs):
        return NoRoof("no window crosses it: nothing says that it belongs to a car", False)
    beside = _windows_beside(car, glass, frame)
    best: Roof | None = None
    for number, run in enumerate(runs):
        if run.window or run.length < ROOFS.min_roof_px:
            continue
        around = _around(runs, number, beside, frame)
        grounds = _judge_run(car, runs, number, around, frame)
        if grounds is None or (best is not None and best.worth >= grounds[1]):
            continue
        along, unsure = _level_place(car, runs, number, frame)
        sides = _sides(car, glass, level, frame, run)
        here = car.whole & (frame.along >= run.first) & (frame.along < run.last)
        inside = here & (np.abs(frame.across - sides.centre) < ROOFS.used_width * sides.half)
        # the sides of a car at the picture's edge must be visible
        if inside.any() and not (car.cut and not sides.seen):
            line, column = (
                car.middle
                + (along - 0.5 * frame.length) * frame.axis
                + 0.5 * frame.width * sides.centre * _aside(frame)
            )
            middle = float(line), float(column)
            complete = 1 < number < len(runs) - 2
            best = Roof(
                inside,
                middle,
                frame.axis,
                unsure,
                sides.unsure,
                *grounds,
                complete and (around.is_between or (around.has_bonnet and around.sided > ROOFS.sided)),
                around.has_bonnet and around.sided > ROOFS.surely_sided,
                _window_level(glass, around.windows, frame, level),
            )
    if best is not None:
        return best
    is_car = car.is_one_car and float(beside.mean()) > ROOFS.van_sided
    return NoRoof("no roof is seen: nothing lies between windows, or is longer than a bonnet", is_car)


def _around(runs: list[_Run], number: int, beside: Bools, frame: _Frame) -> _Around:
    def sided(run: _Run) -> float:
        return float(beside[run.first : run.last].mean())

    windows, beyond = (
        [runs[section] for section in (number - step, number + step) if 0 <= section < len(runs)]
        for step in (1, 2)
    )
    long = [section for section in beyond if section.length > ROOFS.min_bonnet * frame.length]
    has_bonnet = any(sided(section) < ROOFS.sided for section in long)
    return _Around(sided(runs[number]), windows, has_bonnet, len(long) == 2)


def _window_level(glass: Bools, windows: list[_Run], frame: _Frame, level: Floats) -> float:
    # Median level of the windows across some sections of a car [1]
    inside = np.zeros_like(glass)
    for run in windows:
        inside |= (frame.along >= run.first) & (frame.along < run.last)
    inside &= glass & (np.abs(frame.across) < ROOFS.middle)
    return float(np.median(level[inside])) if inside.any() else np.nan


def _judge_run(
    car: Footprint, runs: list[_Run], number: int, around: _Around, frame: _Frame
) -> tuple[str, float] | None:
    # Reason and worth of a section as the roof; None where it may be another part
    run, sided = runs[number], around.sided
    share = run.length / frame.length
    ends = int(number > 0) + int(number + 1 < len(runs))
    evidence = f"side windows along {sided:.0%} of it"
    # a bed has walls along it, too, but nothing behind it
    worth = share + sided + (ROOFS.between_worth if around.is_between else 0.0)
    if car.cut:
        if ends == 2 and sided > ROOFS.long_sided and run.length > ROOFS.min_roof_of_cut * frame.width:
            return f"a roof: windows end it on both sides, {evidence}", worth
        return None
    if share < ROOFS.min_roof:
        return None
    least = ROOFS.min_slenderness if ends == 2 and sided > ROOFS.surely_sided else FOOTPRINTS.slenderness[0]
    if not least < frame.length / frame.width < FOOTPRINTS.slenderness[1]:
        return None
    evidence = f"{share:.0%} of the car's length, {evidence}"
    middle = 0.5 * (run.first + run.last) / frame.length
    # a section before a windscreen may end at its own shadow, as if at a window
    if ends == 2 and not around.is_between and (share < ROOFS.short_roof or sided < ROOFS.van_sided):
        return None
    if ends == 2 and (sided > ROOFS.sided or ROOFS.central[0] < middle < ROOFS.central[1]):
        return f"a roof: windows end it on both sides, {evidence}", worth
    if ends == 1 and sided > ROOFS.surely_sided:
        return f"a roof: a window ends it, {evidence}", worth
    if ends == 1 and ROOFS.min_van_roof < share < ROOFS.max_van_roof and _has_face(runs, number, frame):
        reason = f"a roof: a windscreen with a bonnet before it ends it, and it is all the rest, {evidence}"
        return reason, worth
    if (
        ends == 1
        and ROOFS.max_bonnet < share < ROOFS.max_van_roof
        and sided > (ROOFS.long_sided if share < ROOFS.min_van_roof else ROOFS.van_sided)
    ):
        return f"a roof: a window ends it, and it is longer than any bonnet, {evidence}", share + sided
    return None


def _has_face(runs: list[_Run], number: int, frame: _Frame) -> bool:
    if len(runs) != 3 or number == 1:
        return False
    bonnet = runs[2 - number].length / frame.length
    window = runs[1].length / frame.length
    return ROOFS.min_bonnet < bonnet < ROOFS.max_bonnet and window < ROOFS.max_windscreen


def _level_place(car: Footprint, runs: list[_Run], number: int, frame: _Frame) -> tuple[float, float]:
    # Position along the car where a roof is level, and its possible error [pixel].
    # A window beside it that is longer than a windscreen has a sunroof in it, and the roof is level beside
    # it, except for a bed, behind which almost nothing is left.
    run, unit = runs[number], frame.length
    middle = 0.5 * (run.first + run.last)
    for step in (-1, 1):
        if car.cut or not 0 <= number + step < len(runs) or run.length > ROOFS.max_bonnet * unit:
            continue
        window = runs[number + step].length
        edge = float(run.first if step < 0 else run.last)
        beyond = sum(section.length for section in (runs[: number - 1] if step < 0 else runs[number + 2 :]))
        if beyond < ROOFS.min_tail * unit:
            continue
        if window > ROOFS.min_sunroof * unit:
            return edge, ROOFS.unsure_beside * unit
        if window > ROOFS.max_windscreen * unit:
            return middle, abs(middle - edge)
    return middle, ROOFS.unsure * unit


class _Sides(NamedTuple):
    centre: float
    half: float  #: Half width.
    unsure: float  #: How far the centre may be off [pixel].
    seen: bool  #: Whether both were.


def _sides(car: Footprint, glass: Bools, level: Floats, frame: _Frame, run: _Run) -> _Sides:
    # Sides of a roof.
    # They lie where brightness drops most: under a low sun the side that leans away is darker than paint
    # elsewhere, but no window yet. For paint no brighter than windows, where side windows begin.
    here = car.whole & (frame.along >= run.first) & (frame.along < run.last)
    left, right = (_step(level, car, sign, frame, run) for sign in (-1, 1))
    unsure = ROOFS.unsure_side_px
    half = 0.5 * frame.width
    if np.isnan(left) or np.isnan(right):
        left, right = (_edge(glass & here, sign, frame, run) for sign in (-1, 1))
        unsure = ROOFS.unsure_window_px
    seen = bool(np.isfinite(left) and np.isfinite(right))
    if not seen:
        unsure = ROOFS.unsure_width * half
    if np.isnan(left) and np.isnan(right):
        left = right = ROOFS.roof_width
    left, right = (
        2 * ROOFS.roof_width - opposite if np.isnan(side) else side
        for side, opposite in ((left, right), (right, left))
    )
    return _Sides(0.5 * (right - left), 0.5 * (right + left), unsure, seen)


def _step(level: Floats, car: Footprint, sign: int, frame: _Frame, run: _Run) -> float:
    # Where brightness first drops as at a window, to one side of the axis, median over the tracks.
    # In half widths; NaN where it drops by less in most tracks of a run.
    half = 0.5 * frame.width
    out = np.arange(ROOFS.side * half, ROOFS.beyond * half, ROOFS.step_px)
    along = np.arange(run.first + 0.5, run.last) - 0.5 * frame.length
    places = (
        np.array(car.middle)[:, None, None]
        + frame.axis[:, None, None] * along[None, :, None]
        + sign * _aside(frame)[:, None, None] * out[None, None, :]
    )
    seen = map_coordinates(np.log(np.maximum(level, ROOFS.black)), places, order=1, mode="nearest")
    span, stay = round(1.0 / ROOFS.step_px), round(max(1.0, ROOFS.window_width * half) / ROOFS.step_px)
    inner, outer = (
        seen[:, : -span - stay],
        [seen[:, span + n : seen.shape[1] - stay + n] for n in range(stay)],
    )
    # a window, and no seam: it stays dark
    drop = inner - np.max(outer, axis=0)
    has_drop = (drop > ROOFS.min_step).any(axis=1)
    if has_drop.sum() < ROOFS.min_seen * has_drop.size:
        return np.nan
    first = (drop[has_drop] > ROOFS.min_step).argmax(axis=1)
    steepest = [
        int((profile[at : at + span] - profile[at + span : at + 2 * span]).argmax())
        for profile, at in zip(seen[has_drop], first, strict=True)
    ]
    return float(np.median(out[first + steepest] + 0.5)) / half


def _edge(glass: Bools, sign: int, frame: _Frame, run: _Run) -> float:
    # Where side windows begin on one side of the axis, median over the tracks; NaN without them
    beside = glass & (sign * frame.across > ROOFS.side)
    nearest = np.full(run.length, np.inf)
    track = (np.floor(frame.along[beside]).astype(np.int64) - run.first).clip(0, run.length - 1)
    np.minimum.at(nearest, track, sign * frame.across[beside])
    edges = nearest[np.isfinite(nearest)]
    return float(np.median(edges)) if edges.size >= ROOFS.min_seen * nearest.size else np.nan


def _share_of_tracks(which: Bools, of: Bools, frame: _Frame) -> Floats:
    # Share of pixels of `which` in `of` for every track across a car (track,)
    count = round(frame.length)
    track = np.floor(frame.along[of]).astype(np.int64).clip(0, count - 1)
    whole = np.bincount(track, minlength=count)
    return np.asarray(np.bincount(track, which[of], count) / np.maximum(whole, 1))


def _windows_beside(car: Footprint, glass: Bools, frame: _Frame) -> Bools:
    # Tracks with side windows (track,), on the side with more of them.
    # Outside of a window there is a door; outside of pixels in the car's shadow nothing is lit.
    count = round(frame.length)
    track = np.floor(frame.along).astype(np.int64).clip(0, count - 1)
    side_windows = []
    for sign in (-1, 1):
        aside = sign * frame.across
        lit = car.whole & ~glass & (aside > ROOFS.middle)
        outermost = np.zeros(count)
        np.maximum.at(outermost, track[lit], aside[lit])
        of = glass & (aside > ROOFS.middle) & (aside < outermost[track])
        side_windows.append(np.bincount(track[of], minlength=count) >= ROOFS.min_window_px)
    return max(side_windows, key=lambda one: int(one.sum()))


def _runs(crossed: Bools, strip: float) -> list[_Run]:
    # Sections of paint and of windows, from end to end.
    # Paint shorter than a strip [pixel] between windows, as before a sunroof, belongs to them.
    ends = np.flatnonzero(np.diff(crossed.astype(np.int8), prepend=2, append=2))
    stretches = [
        _Run(a, b, bool(crossed[a])) for a, b in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True)
    ]
    merged: list[_Run] = []
    for number, run in enumerate(stretches):
        least = strip if 0 < number < len(stretches) - 1 and not run.window else ROOFS.min_window_px
        if merged and (run.length < least or merged[-1].window == run.window):
            merged[-1] = _Run(merged[-1].first, run.last, merged[-1].window)
        else:
            merged.append(run)
    return merged
