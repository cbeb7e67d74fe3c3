"""Cars: which pieces of paint belong to the same one, which part is its roof, and which part is proposed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Bools, Floats
from hyperpaint.surroundings import SceneModel

from .between_clouds import doubt_about_clouds
from .candidates import Limits, Measures, Picture, Piece, measured
from .finishes import difference_of, judge_finish
from .footprints import WAYS, Footprint, Scene, footprint_of
from .judging import Judged, Level, Verdict, direct_share, judge_level, judge_pixels
from .leans import lean_to_sun, measured_lean
from .levels import level_light, level_place
from .proposal_rules import CARS, FOOTPRINTS, JUDGING, SURFACES
from .roofs import NoRoof, Roof, find_roof

__all__ = ["Car", "find_cars", "judge_car"]


@dataclass(eq=False)
class Car:
    """Pieces of paint that are of one car."""

    pieces: list[Piece]  #: Those of its paint.
    #: The car around its roof; None where it is not seen.
    footprint: Footprint | None = None
    roof: Roof | None = None
    #: Why there is no roof.
    reason: str = "its colour goes on beyond any car: nothing says that it belongs to one"
    is_car: bool = False  #: Whether windows show that it is one.
    size: int = 0  #: Pixels of its largest footprint.

    def add(self, piece: Piece, footprint: Footprint, roof: Roof | NoRoof) -> None:
        """Add a piece, and what is seen around it: of several footprints with a roof the largest counts."""
        self.pieces.append(piece)
        self.size = max(self.size, int(footprint.whole.sum()))
        if isinstance(roof, NoRoof):
            self.is_car |= roof.is_car
            self.reason = roof.reason
        elif self.footprint is None or footprint.whole.sum() > self.footprint.whole.sum():
            self.footprint, self.roof, self.is_car = footprint, roof, True


def find_cars(pieces: Iterable[Piece], scene: Scene) -> list[Car]:
    """Return the cars that pieces of paint are of, the largest piece's first; those dark as windows last."""
    cars: list[Car] = []
    owner = np.full(scene.level.shape, -1, np.int32)
    painted = owner.copy()

    def order(piece: Piece) -> tuple[bool, int, tuple[int, int], int]:
        level = float(np.median(scene.level[piece.window][piece.inside]))
        return level < SURFACES.dark, -int(piece.inside.sum()), piece.first, piece.body

    for piece in sorted(pieces, key=order):
        owners = painted[piece.window][piece.inside]
        if (owners >= 0).mean() > CARS.min_piece_share:
            car = cars[int(np.bincount(owners[owners >= 0]).argmax())]
            if car.roof is not None and car.roof.complete:
                car.pieces.append(piece)
                continue
        footprint, roof = _look_around(piece, scene)
        if footprint is None:
            cars.append(Car([piece]))
            continue
        number = _same(footprint, owner, cars)
        if number == len(cars):
            cars.append(Car([]))
        cars[number].add(piece, footprint, roof)
        if not cars[number].is_car:
            continue  # what is no car, such as ground that looks like no other, holds none
        for plane, mask in ((owner, footprint.whole), (painted, footprint.whole & footprint.paint)):
            view = plane[footprint.window]
            view[mask & (view < 0)] = number
    return cars


class _Seen(NamedTuple):
    """What is seen around a piece: the car, and its roof."""

    footprint: Footprint | None
    roof: Roof | NoRoof


def _look_around(piece: Piece, scene: Scene) -> _Seen:
    """Return the car around a piece, and its roof; what only windows join, too, where that shows a roof."""
    colour = np.median(scene.without_sky(piece.window)[piece.inside], axis=0)
    seen: list[_Seen] = []
    for way in WAYS:
        footprint = footprint_of(piece.inside, piece.first, colour, scene, way)
        if footprint is None:
            continue
        seen.append(_Seen(footprint, find_roof(footprint, scene.level[footprint.window])))
        if isinstance(seen[-1].roof, Roof):
            return seen[-1]
    return seen[0] if seen else _Seen(None, NoRoof("its colour goes on beyond any car", False))


def _same(footprint: Footprint, owner: npt.NDArray[np.int32], cars: list[Car]) -> int:
    """Return the number of the car that a footprint lies on, that of a new one if none."""
    there = owner[footprint.window][footprint.whole]
    there = there[there >= 0]
    if not there.size:
        return len(cars)
    shared = np.bincount(there)
    number = int(shared.argmax())
    least = min(int(footprint.whole.sum()), cars[number].size)
    return number if shared[number] > CARS.min_overlap * least else len(cars)


def judge_car(car: Car, picture: Picture, limits: Limits) -> list[Judged]:
    """Return the verdicts on a car's roof and of the other pieces of its paint; at most one is proposed."""
    judged = []
    if car.roof is not None and car.footprint is not None:
        one = _judge_roof(car.footprint, car.roof, picture, limits)
        if one is not None:
            judged.append(one)
    panels = [_judge_panel(piece, car, picture, limits) for piece in car.pieces]
    for one in judged + panels:
        doubt = doubt_about_clouds(one.piece.window, picture.channels, picture.model, picture.sun)
        if doubt:
            one.verdict.objections.append(doubt)
    best = next((one for one in judged if not one.verdict.objections), None)
    if best is None and judged and judged[0].measures.pixels:
        # what makes the level part wrong lies on the others, too
        for one in panels:
            one.verdict.objections.append("the roof of the same car is refused")
    elif best is None:
        good = [one for one in panels if not one.verdict.objections]
        best = max(good, key=lambda one: one.verdict.score, default=None)
    for one in panels:
        if best is not None and one is not best and not one.verdict.objections:
            one.verdict.objections.append(better_part(best))
    return judged + panels


def _judge_roof(footprint: Footprint, roof: Roof, picture: Picture, limits: Limits) -> Judged | None:
    """Return what is thought of a roof; None where nothing of it is away from edges."""
    piece = _piece_of(footprint, roof, picture.model, limits.erode)
    if piece is None:
        return None
    y, x = piece.first[0] - footprint.first[0], piece.first[1] - footprint.first[1]
    lines, columns = piece.inside.shape
    brightness = footprint.brightness[y : y + lines, x : x + columns]
    lit = piece.inside & (picture.layers["blocked_direct"][piece.window] < limits.shadow)
    place = level_place(footprint, roof)
    middle = (place.line - y, place.column - x)
    prior = lean_to_sun(roof.axis, picture.shadow_side)
    lean = measured_lean(picture.heights, piece.window, piece.inside, middle, prior, picture.shadow_side)
    middle = (middle[0] + lean.shift[0], middle[1] + lean.shift[1])
    verdict = Verdict("roof", reasons=[roof.reason])
    if np.isfinite(lean.angle):
        text = f"leans by {lean.angle:.1f} degrees towards the sun, says the height model"
        verdict.reasons.append(text)
        if not _holds(piece.inside, middle):
            verdict.objections.append(f"{text}, and is level nowhere; draw a region on a part that is level")
            return Judged(piece, measured(piece, picture, limits), verdict)
    place = place._replace(line=middle[0], column=middle[1])
    level = level_light(brightness, lit, place, roof.axis)
    if level is None:
        verdict.objections.append("too little of the roof is lit to tell how bright it is where it is level")
        return Judged(piece, measured(piece, picture, limits), verdict)
    relative = brightness / level.middle
    for times in CARS.wider:
        allowed = replace(limits, glint=np.inf, adjacency=np.inf, brightness=times * limits.brightness)
        measures = measured(piece, picture, allowed, relative)
        if measures.pixels >= limits.min_pixels:
            break
    # how far the pixels that are left are off what is level
    off = float(relative[measures.usable].mean()) - 1.0 if measures.pixels else 0.0
    judge_pixels(verdict, measures, limits)
    known = Level(float(np.hypot(level.sd, off)), level.along_change, level.across_change)
    judge_level(verdict, measures, picture, lean.sd, known)
    judge_finish(verdict, measures, picture, known, difference_of(piece, picture, relative))
    if verdict.finish == "metallic":
        verdict.kind = "metallic"
    _judge_windows(verdict, footprint, roof, picture)
    return Judged(piece, measures, verdict)


def _holds(mask: Bools, place: tuple[float, float]) -> bool:
    """Return whether a place (line, column) lies within the lines and columns of a mask."""
    lines, columns = mask.shape
    return bool(-1.0 <= place[0] <= lines and -1.0 <= place[1] <= columns)


def _judge_windows(verdict: Verdict, footprint: Footprint, roof: Roof, picture: Picture) -> None:
    """Object where a window, or a bed, may be taken for a black roof."""
    level = picture.channels[footprint.window].mean(axis=2)
    own = float(np.median(level[footprint.paint & footprint.whole]))
    step = own - roof.window_level
    if step < max(JUDGING.min_window_step, JUDGING.min_window_contrast * own):
        verdict.objections.append(
            f"windows beside it are darker by {step:.4f} only: it may be a window itself; draw a region "
            "by hand"
        )
    if own >= SURFACES.dark:
        return
    rest = footprint.paint & footprint.whole & ~roof.inside
    ratio = float(np.median(level[roof.inside]) / np.median(level[rest])) if rest.any() else np.nan
    if not ((roof.complete or roof.sided) and JUDGING.dark_roof[0] < ratio < JUDGING.dark_roof[1]):
        verdict.objections.append(
            "dark, and neither between two windows with the same paint beyond both, nor behind a windscreen "
            "with a bonnet before it and windows along it: it may be a window or a bed; draw a region by hand"
        )


def _piece_of(footprint: Footprint, roof: Roof, model: SceneModel, erode: int) -> Piece | None:
    """Return the pixels of a roof that are away from what has another colour.

    What is brighter than the paint is elsewhere is paint, too: in the lobe of flakes, or in glint.
    """
    from scipy.ndimage import distance_transform_edt

    paint = footprint.paint | (footprint.brightness >= FOOTPRINTS.max_brightness)
    inside = roof.inside & (distance_transform_edt(np.pad(paint, 1))[1:-1, 1:-1] > erode)
    lines, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    if not lines.size:
        return None
    first = (int(lines[0]) + footprint.first[0], int(columns[0]) + footprint.first[1])
    mask = inside[lines[0] : lines[-1] + 1, columns[0] : columns[-1] + 1]
    piece = Piece(0, first, mask)
    segment = model.segment[piece.window][mask]
    body = model.body[segment[segment >= 0]]
    return piece._replace(body=int(np.bincount(body).argmax())) if body.size else None


def _judge_panel(piece: Piece, car: Car, picture: Picture, limits: Limits) -> Judged:
    measures = measured(piece, picture, limits)
    verdict = Verdict()
    if not car.is_car:
        verdict.objections.append(car.reason)
        verdict.scenery = _mean_level(measures) < SURFACES.dark
        return Judged(piece, measures, verdict)
    verdict.kind = "panel"
    verdict.reasons.append("part of a car: windows cross it, and run along it")
    judge_pixels(verdict, measures, limits)
    unseen = Level(along_change=JUDGING.unseen_change * direct_share(picture))
    judge_level(verdict, measures, picture, JUDGING.panel_deg, unseen)
    if _mean_level(measures) < SURFACES.dark:
        verdict.objections.append("as dark as a window, and not known to be the roof")
    return Judged(piece, measures, verdict)


def _mean_level(measures: Measures) -> float:
    """Return the mean reflectance of a piece [1]; 0 of none."""
    spectrum: Floats = measures.spectrum
    return float(spectrum.mean()) if measures.pixels else 0.0


def better_part(best: Judged) -> str:
    """Return the objection to all other parts of a car."""
    y, x = best.piece.middle
    return f"another part of the same car is better: that at line {y:.0f}, column {x:.0f}"
