"""Cars: pieces of paint that belong to the same car, its roof, and the part that is proposed."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.ndimage import distance_transform_edt

from hyperpaint.base.arrays import Bools, Floats
from hyperpaint.surroundings import SceneModel

from .between_clouds import doubt_about_clouds
from .candidates import Limits, Measures, Picture, Piece, largest_body, measured
from .finishes import difference_of, judge_finish
from .footprints import WAYS, Footprint, Scene, Way, footprints_of
from .judging import Judged, Level, Verdict, direct_share, judge_level, judge_pixels
from .leans import lean_to_sun, measured_lean
from .levels import level_light, level_place
from .proposal_rules import CARS, FOOTPRINTS, JUDGING, SURFACES
from .roofs import NoRoof, Roof, find_roof


@dataclass(eq=False)
class Car:
    """Pieces of the picture that belong to one car."""

    pieces: list[Piece]
    #: Footprint around one of the pieces, with or without visible windows; None where its colour extends
    #: beyond any car.
    footprint: Footprint | None = None
    roof: Roof | None = None
    #: Reason why there is no roof.
    reason: str = "its colour goes on beyond any car: nothing says that it belongs to one"
    is_car: bool = False  #: Whether windows show that it is one.


def _is_certain(footprint: Footprint, roof: Roof) -> bool:
    # Whether a roof lies between windows, or behind a windscreen, on a footprint of one car
    return footprint.is_one_car and (roof.complete or roof.sided)


def find_cars(pieces: Iterable[Piece], scene: Scene) -> list[Car]:
    """Return the cars of pieces of paint, the most certain first.

    The largest pieces are examined first, those as dark as windows last. A piece with a certain roof is a
    car; a piece with less evidence is one only where no certain car is.
    """
    lot = _Lot(scene)

    def order(piece: Piece) -> tuple[bool, int, tuple[int, int], int]:
        level = float(np.median(scene.level[piece.window][piece.inside]))
        return level < SURFACES.dark, -int(piece.inside.sum()), piece.first, piece.body

    best = lot.look([_Seen(piece) for piece in sorted(pieces, key=order)], WAYS[:4], np.inf)
    sizes = [seen.size for seen in lot.certain]
    largest = CARS.max_size * float(np.median(sizes)) if len(sizes) >= CARS.min_sizes else np.inf
    again = lot.look([_Seen(piece) for piece in lot.drop(largest)], WAYS[:4], largest)
    best = lot.look([candidate.unless_larger(largest) for candidate in best + again], WAYS[4:], largest)
    for seen in sorted(best, key=lambda candidate: candidate.rank, reverse=True):
        if not lot.has(seen.piece):
            lot.add(seen)
    return lot.cars


#: Rank of a roof between windows, or behind a windscreen, on a footprint of one car.
_CERTAIN = 5


class _Seen(NamedTuple):
    piece: Piece
    footprint: Footprint | None = None
    roof: Roof | NoRoof = NoRoof(Car.reason, False)

    @property
    def size(self) -> int:
        return 0 if self.footprint is None else int(self.footprint.whole.sum())

    @property
    def rank(self) -> tuple[int, int]:
        if self.footprint is None:
            return 0, 0
        if isinstance(self.roof, NoRoof):
            return 1 + int(self.roof.is_car), self.size
        if not self.footprint.is_one_car:
            return 3, self.size
        return _CERTAIN - int(not _is_certain(self.footprint, self.roof)), self.size

    def unless_larger(self, largest: float) -> _Seen:
        if self.size <= largest:
            return self
        reason = "it is larger than other cars: several of one colour may touch; draw a region by hand"
        return self._replace(roof=NoRoof(reason, False))


class _Lot:
    def __init__(self, scene: Scene) -> None:
        self.cars: list[Car] = []
        self.certain: list[_Seen] = []  #: Certain cars, the first of `cars`.
        self._scene = scene
        self._whole = np.full(scene.level.shape, -1, np.int32)
        self._paint = self._whole.copy()

    def look(self, waiting: list[_Seen], ways: Sequence[Way], largest: float) -> list[_Seen]:
        # Add the cars that are certain; return the best candidates around all other pieces
        unsure = []
        for best in waiting:
            if self.has(best.piece):
                continue
            seen = _look_around(best, self._scene, ways, largest)
            if seen.rank[0] < _CERTAIN:
                unsure.append(seen)
            elif not self.add(seen):
                continue
            else:
                self.certain.append(seen)
        return unsure

    def drop(self, largest: float) -> list[Piece]:
        # Remove the cars with more pixels, which are several side by side; return their pieces
        is_kept = [seen.size <= largest for seen in self.certain]
        numbers = np.append(np.where(is_kept, np.cumsum(is_kept) - 1, -1), -1).astype(np.int32)
        self._whole, self._paint = numbers[self._whole], numbers[self._paint]
        dropped = [car for car, keep in zip(self.cars, is_kept, strict=True) if not keep]
        self.cars = [car for car, keep in zip(self.cars, is_kept, strict=True) if keep]
        self.certain = [seen for seen, keep in zip(self.certain, is_kept, strict=True) if keep]
        return [piece for car in dropped for piece in car.pieces]

    def has(self, piece: Piece) -> bool:
        # Assign a piece to the car whose paint or windows it lies on; return whether there is one
        for plane, least in ((self._paint, CARS.min_piece_share), (self._whole, CARS.min_window_share)):
            numbers = plane[piece.window][piece.inside]
            if (numbers >= 0).mean() > least:
                self.cars[int(np.bincount(numbers[numbers >= 0]).argmax())].pieces.append(piece)
                return True
        return False

    def add(self, seen: _Seen) -> bool:
        # Add a piece to the car at its place, or as a new car; return whether it is new
        footprint, roof = seen.footprint, seen.roof
        number = len(self.cars) if footprint is None else self._same(footprint)
        if number < len(self.cars):
            self.cars[number].pieces.append(seen.piece)
            return False
        if isinstance(roof, NoRoof):
            self.cars.append(Car([seen.piece], footprint, None, roof.reason, roof.is_car))
        else:
            self.cars.append(Car([seen.piece], footprint, roof, is_car=True))
        if footprint is not None and self.cars[-1].is_car:
            # only cars hold pieces: other footprints, such as unusual ground, do not
            for plane, mask in (
                (self._whole, footprint.whole),
                (self._paint, footprint.whole & footprint.paint),
            ):
                view = plane[footprint.window]
                view[mask & (view < 0)] = number
        return True

    def _same(self, footprint: Footprint) -> int:
        numbers = self._whole[footprint.window][footprint.whole]
        numbers = numbers[numbers >= 0]
        if not numbers.size:
            return len(self.cars)
        shared = np.bincount(numbers)
        number = int(shared.argmax())
        other = self.cars[number].footprint
        least = min(int(item.whole.sum()) for item in (footprint, other) if item is not None)
        return number if shared[number] > CARS.min_overlap * least else len(self.cars)


def _look_around(best: _Seen, scene: Scene, ways: Sequence[Way], largest: float) -> _Seen:
    # Best car and roof around a piece: the first certain one among all ways to join its parts
    piece = best.piece
    colour = np.median(scene.without_sky(piece.window)[piece.inside], axis=0)
    for footprint in footprints_of(piece.inside, piece.first, colour, scene, ways):
        roof = find_roof(footprint, scene.level[footprint.window])
        seen = _Seen(piece, footprint, roof).unless_larger(largest)
        best = max(best, seen, key=lambda one: one.rank[0])
        if best.rank[0] == _CERTAIN:
            break
    return best


def judge_car(car: Car, picture: Picture, limits: Limits) -> list[Judged]:
    """Return the verdicts on a car's roof and on the other pieces of its paint; at most one is proposed."""
    roofs = []
    if car.roof is not None and car.footprint is not None:
        judged_piece = _judge_roof(car.footprint, car.roof, picture, limits)
        if judged_piece is not None:
            roofs.append(judged_piece)
    parts = [_judge_part(piece, car, picture, limits) for piece in car.pieces]
    for judged_piece in roofs + parts:
        doubt = doubt_about_clouds(judged_piece.piece.window, picture.channels, picture.model, picture.sun)
        if doubt:
            judged_piece.verdict.objections.append(doubt)
    best = next((judged_piece for judged_piece in roofs if not judged_piece.verdict.objections), None)
    if best is None and roofs and roofs[0].measures.pixels:
        # an error of the level part affects the others, too
        for judged_piece in parts:
            judged_piece.verdict.objections.append("the roof of the same car is refused")
    elif best is None:
        acceptable = [judged_piece for judged_piece in parts if not judged_piece.verdict.objections]
        best = max(acceptable, key=lambda judged_piece: judged_piece.verdict.score, default=None)
    for judged_piece in parts:
        if best is not None and judged_piece is not best and not judged_piece.verdict.objections:
            judged_piece.verdict.objections.append(better_part(best))
    return roofs + parts


def _judge_roof(footprint: Footprint, roof: Roof, picture: Picture, limits: Limits) -> Judged | None:
    # Verdict on a roof; None where all of it is near edges
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
        text = f"leans by {lean.angle:+.1f} degrees towards the sun, says the height model"
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
    # offset of the used pixels from the level part
    off = float(relative[measures.usable].mean()) - 1.0 if measures.pixels else 0.0
    judge_pixels(verdict, measures, limits)
    roof_level = Level(float(np.hypot(level.sd, off)), level.along_change, level.across_change)
    judge_level(verdict, measures, picture, lean.sd, roof_level)
    judge_finish(verdict, measures, picture, roof_level, difference_of(piece, picture, relative))
    if verdict.finish == "metallic":
        verdict.kind = "metallic"
    _judge_windows(verdict, footprint, roof, picture)
    return Judged(piece, measures, verdict)


def _holds(mask: Bools, place: tuple[float, float]) -> bool:
    # Whether a place (line, column) lies within the lines and columns of a mask
    lines, columns = mask.shape
    return bool(-1.0 <= place[0] <= lines and -1.0 <= place[1] <= columns)


def _judge_windows(verdict: Verdict, footprint: Footprint, roof: Roof, picture: Picture) -> None:
    level = picture.channels[footprint.window].mean(axis=2)
    paint_level = float(np.nanmedian(level[footprint.paint & footprint.whole]))
    step = paint_level - roof.window_level
    if step < max(JUDGING.min_window_step, JUDGING.min_window_contrast * paint_level):
        verdict.objections.append(
            f"windows beside it are darker by {step:.4f} only: it may be a window itself; draw a region "
            "by hand"
        )
    if paint_level >= SURFACES.dark:
        return
    rest = footprint.paint & footprint.whole & ~roof.inside
    ratio = float(np.nanmedian(level[roof.inside]) / np.nanmedian(level[rest])) if rest.any() else np.nan
    if not ((roof.complete or roof.sided) and JUDGING.dark_roof[0] < ratio < JUDGING.dark_roof[1]):
        verdict.objections.append(
            "dark, and neither between two windows with the same paint beyond both, nor behind a windscreen "
            "with a bonnet before it and windows along it: it may be a window or a bed; draw a region by hand"
        )


def _piece_of(footprint: Footprint, roof: Roof, model: SceneModel, erode: int) -> Piece | None:
    # Pixels of a roof that are away from other colours.
    # Pixels brighter than the paint elsewhere count as paint: they lie in the lobe of flakes, or in glint.
    paint = footprint.paint | (footprint.brightness >= FOOTPRINTS.brightness[0][1])
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


def _judge_part(piece: Piece, car: Car, picture: Picture, limits: Limits) -> Judged:
    measures = measured(piece, picture, limits)
    verdict = Verdict()
    if not car.is_car:
        verdict.objections.append(car.reason)
        verdict.scenery = _mean_level(measures) < SURFACES.dark
        return Judged(piece, measures, verdict)
    verdict.kind = "panel"
    if car.footprint is None or car.roof is None or not _is_certain(car.footprint, car.roof):
        verdict.objections.append(
            "no roof of it is seen for certain: it may be another car's, or ground between cars; draw a "
            "region by hand"
        )
    verdict.reasons.append("part of a car: windows cross it, and run along it")
    judge_pixels(verdict, measures, limits)
    unseen = Level(along_change=JUDGING.unseen_change * direct_share(picture), is_seen=False)
    judge_level(verdict, measures, picture, JUDGING.panel_deg, unseen)
    _compare_with_car(verdict, measures, car, picture)
    # a spectrum like the ground's, lit or in shade
    ground = np.nan_to_num(picture.model.reference[largest_body(picture.model)])
    length, ground_length = float(np.linalg.norm(measures.spectrum)), float(np.linalg.norm(ground))
    cosine = float(measures.spectrum @ ground) / max(length * ground_length, 1e-9)
    max_length = float(np.exp(FOOTPRINTS.max_ground_log_ratio)) * ground_length
    if measures.pixels and cosine > FOOTPRINTS.min_cosine and length < max_length:
        verdict.objections.append(
            "its colour is that of the ground, and it is no brighter; draw a region by hand"
        )
    if _mean_level(measures) < SURFACES.dark:
        verdict.objections.append("as dark as a window, and not known to be the roof")
    return Judged(piece, measures, verdict)


def _compare_with_car(verdict: Verdict, measures: Measures, car: Car, picture: Picture) -> None:
    footprint = car.footprint
    if footprint is None or not measures.pixels:
        return
    of = footprint.paint & footprint.whole if car.roof is None else car.roof.inside
    car_spectrum = np.nanmedian(picture.channels[footprint.window][of], axis=0)
    spectrum = measures.spectrum
    cosine = float(spectrum @ car_spectrum) / max(
        float(np.linalg.norm(spectrum) * np.linalg.norm(car_spectrum)), 1e-9
    )
    zenith = 45.0 if picture.zenith is None else picture.zenith
    slope = direct_share(picture) * float(np.tan(np.radians(zenith)))
    ratio = float(spectrum.mean() / car_spectrum.mean())
    allowed = max(CARS.max_step, CARS.max_lean * slope)
    if cosine < FOOTPRINTS.min_cosine:
        verdict.objections.append(
            "its colour is not that of the car's paint: a window, a bed, or what lies in it"
        )
    elif abs(ratio - 1.0) > allowed:
        verdict.objections.append(
            f"it is {ratio:.2f} times as bright as other paint of the car, where a lean makes {allowed:.0%} "
            "at most: a shadow, a bed, or metal flakes; draw a region on the roof"
        )


def _mean_level(measures: Measures) -> float:
    spectrum: Floats = measures.spectrum
    return float(spectrum.mean()) if measures.pixels else 0.0


def better_part(best: Judged) -> str:
    """Return the objection to all other parts of a car."""
    y, x = best.piece.middle
    return f"another part of the same car is better: that at line {y:.0f}, column {x:.0f}"
