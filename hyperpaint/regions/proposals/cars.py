"""Cars: pieces of paint that belong to the same car, its roof, and the part that is proposed."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from scipy.ndimage import distance_transform_edt, map_coordinates

from hyperpaint.base.arrays import Array, Bools, Floats
from hyperpaint.light.coat_transmission import interface_reflectance
from hyperpaint.light.sun import diffuse_fraction
from hyperpaint.surroundings import SceneModel
from hyperpaint.surroundings.light_split import MAX_SUN_ZENITH_DEG

from .candidates import (
    Limits,
    Measures,
    Picture,
    Piece,
    doubt_about_clouds,
    lean_to_sun,
    measured,
    measured_lean,
)
from .footprints import JOININGS, Footprint, NoRoof, Roof, find_roof, footprints_of
from .proposal_rules import CARS, FINISHES, FOOTPRINTS, GAPS, JUDGING, LEVELS, ROOFS, SURFACES

# --- verdict on a piece: kind, uncertainty of its level, score ---------------------------------------------


@dataclass
class Verdict:
    """A piece, its measures, and the verdict on it."""

    piece: Piece
    measures: Measures
    kind: str = ""  #: "roof", "panel", "metallic"; empty where it may not belong to a car.
    score: float = 0.0  #: Score from 0 to 1; the equation is in `propose_regions`.
    reasons: list[str] = field(default_factory=list)  #: Reasons to propose the piece.
    objections: list[str] = field(default_factory=list)  #: Reasons to refuse it; any objection refuses it.
    finish: str = "unknown"  #: "solid" or "metallic" where brightness and colour of a roof show it.
    level_sd: float = np.nan  #: Relative standard uncertainty of its level [1].
    lean: float = np.nan  #: Standard deviation of its lean [degree].
    scenery: bool = False  #: Whether it looks like leaves, a shadow or a window, and is listed last.


class Level(NamedTuple):
    """Brightness of a part where it is level, its uncertainty, and its change with lean."""

    brightness: float = 1.0  #: Brightness there, in the unit of the brightness passed.
    sd: float = 0.0  #: Its relative standard uncertainty from the fit and the position [1].
    along_change: float = 0.0  #: Its relative change with lean along the car [1/rad].
    across_change: float = 0.0  #: The same across it [1/rad].
    is_measured: bool = True  #: Whether the changes are measured on the crown of a roof, not assumed.

    @property
    def lean_change(self) -> float:
        """Largest relative change over lean in any direction [1/rad]."""
        return float(np.hypot(self.along_change, self.across_change))


def change_with_lean(zenith: float) -> float:
    """Return the relative change of the sunlight under a coat with lean towards the sun [1/rad].

    Takes ``zenith``: angle t of the sun to the normal of the body part [degree]. With the reflectance F of
    the coat's interface, the change is -d ln(cos t (1 - F(t))) / dt: tan t, and a term for the larger
    transmission of the coat at steeper incidence.
    """
    angles = np.radians(min(zenith, MAX_SUN_ZENITH_DEG)) + np.array([-1e-3, 1e-3])
    light = np.log(np.cos(angles) * (1.0 - interface_reflectance(np.degrees(angles))))
    return float(light[0] - light[1]) / 2e-3


def judge_level(verdict: Verdict, picture: Picture, rake: float, level: Level) -> None:
    """Add the uncertainty of a part's level, and visible flakes, to its verdict; object if it is too large.

    A small lean b towards the sun changes the light of a solid body by about f_dir tan(zenith) b, with the
    direct share f_dir of the light, and the light of flakes by more. The change of brightness over the crown
    of a roof, which leans by known angles, shows how much more. Takes ``rake``: standard deviation of the
    part's unknown lean [degree].
    """
    measures = verdict.measures
    if not measures.pixels:
        return
    zenith = 45.0 if picture.zenith is None else picture.zenith
    direct = picture.direct_share
    slope = direct * change_with_lean(zenith)
    # the signature excludes the mirrored sky, too
    mirrored = picture.mirrored_sky
    brightness = max(float(measures.spectrum.mean()) - mirrored, 1e-3)
    # haze makes a sky brighter than a clear one, and uneven, mostly around the sun; an overcast sky is even
    haze = (1.0 - direct) / float(diffuse_fraction(picture.model.channel_wavelength, zenith).mean()) - 1.0
    clear_part = direct * float(np.hypot(JUDGING.mirror_share_sd, haze))
    mirror_share_sd = clear_part + (1.0 - direct) * JUDGING.covered_share_sd
    contributions = {
        "noise and dust": JUDGING.least_sd,
        f"an unknown lean of {rake:.1f} degrees": float(np.radians(rake)) * max(slope, level.lean_change),
        "the position where it is level": level.sd,
        "the sky mirrored by its coat": mirror_share_sd * mirrored / brightness,
        "its low reflectance": JUDGING.mirror_sd / brightness,
        "broken clouds": GAPS.sd if picture.sun is not None else 0.0,
    }
    verdict.level_sd, verdict.lean = float(np.hypot.reduce(list(contributions.values()))), rake
    has_lobe = direct > JUDGING.min_direct and level.lean_change > JUDGING.max_solid_gain * slope
    max_sd = JUDGING.max_lobe_sd if has_lobe else JUDGING.max_level_sd
    allowed = max(max_sd, JUDGING.max_dark_sd / brightness)
    largest = max(contributions, key=contributions.__getitem__)
    text = f"the uncertainty of its level is {verdict.level_sd:.1%}, mainly from {largest}"
    if has_lobe and level.is_measured:
        text += (
            f"; its brightness changes by {np.radians(level.lean_change):.0%} a degree of lean, like flakes"
        )
    if not verdict.level_sd <= allowed:
        advice = "fly under a higher sun, or draw a region on a level part"
        verdict.objections.append(f"{text}: at most {allowed:.1%} is allowed; {advice}")
    else:
        verdict.reasons.append(text)


def _judge_pixels(verdict: Verdict, limits: Limits) -> None:
    # Add the measures and the score to a verdict; object to too few pixels, and to mixed colours
    measures = verdict.measures
    lost = ", ".join(f"{share:.0%} {reason}" for reason, share in measures.lost.items() if share >= 0.01)
    excluded = f" (excluded: {lost})" if lost else ""
    if measures.pixels < limits.min_pixels:
        verdict.objections.append(
            f"{measures.pixels} usable pixels, expected at least {limits.min_pixels}{excluded}"
        )
        return
    verdict.reasons.append(f"{measures.pixels} pixels{excluded}")
    if measures.angle > limits.angle:
        verdict.objections.append(f"not homogeneous: spectra differ by {measures.angle:.1f} degrees")
    verdict.reasons.append(
        f"homogeneous to {measures.angle:.1f} degrees, brightness to {measures.spread:.1%}; "
        f"glint {measures.glint:.3f}, light of neighbours {measures.adjacency:.3f}"
    )
    homogeneity = 1.0 / (1.0 + (measures.angle / JUDGING.half_angle_deg) ** 2)
    penalty = (
        measures.adjacency / JUDGING.half_adjacency
        + measures.glint / JUDGING.half_glint
        + measures.spread / JUDGING.half_spread
    )
    verdict.score = float(min(1.0, measures.pixels / JUDGING.enough_px) * homogeneity / (1.0 + penalty))


# --- brightness of a roof where it is level, with its uncertainty ------------------------------------------


class Place(NamedTuple):
    """Position on a roof where it is level."""

    line: float  #: Line in the window of the footprint.
    column: float  #: Column in the window of the footprint.
    along_sd: float  #: Standard deviation of the position along the car [pixel].
    across_sd: float  #: The same across it [pixel].
    half_width: float  #: Half of the width of the roof [pixel].
    half_length: float  #: Half of its length [pixel].

    @property
    def crown(self) -> Floats:
        """Lean half a width away, along and across the car (2,) [radian]."""
        along = 2.0 * LEVELS.drop * self.half_width / self.half_length
        limits = np.radians([LEVELS.max_crown_deg, LEVELS.crown_deg])
        return np.asarray([min(along, float(limits[0])), limits[1]])


def level_place(footprint: Footprint, roof: Roof) -> Place:
    """Return where a roof is level: along the car from its windows, across it from the roof's edges.

    A car is symmetric, so that its roof is level halfway between its edges. An edge lies where the logarithm
    of brightness falls most steeply: shading changes brightness by factors, so that its plain difference
    would shift the edge on the darker side inwards.
    """
    along, across = _to_car(roof.centre, roof.axis, *np.nonzero(roof.inside))
    half_width = max(float(np.abs(across).max()) / ROOFS.used_width, 1.0)
    tracks = np.arange(np.ceil(along.min()), np.floor(along.max()) + 1.0)
    # median over all tracks at each distance across, robust against roof rails and antennas
    aside = np.arange(0.0, LEVELS.edge_span[1] * half_width + 2.0 * LEVELS.edge_px, 1.0 / LEVELS.steps_per_px)
    edges = []
    for sign in (-1.0, 1.0):
        positions = _to_picture(roof.centre, roof.axis, tracks[:, None], sign * aside)
        samples = map_coordinates(footprint.brightness, positions, order=1, mode="nearest")
        edges.append(sign * _edge(aside, np.nanmedian(samples, axis=0), half_width))
    shift = 0.5 * (edges[0] + edges[1])
    has_edges = bool(abs(shift) < LEVELS.max_shift * half_width)
    if has_edges:
        half_width = 0.5 * (edges[1] - edges[0])
    line, column = _to_picture(roof.centre, roof.axis, np.zeros(()), np.array(shift if has_edges else 0.0))
    # standard deviation of a uniform distribution over the possible range
    along_sd, across_sd = (limit / float(np.sqrt(3.0)) for limit in (roof.unsure, roof.unsure_across))
    if has_edges:
        across_sd = LEVELS.edged_sd_px
    elif np.isfinite(shift):  # the edges contradict the windows
        across_sd = max(across_sd, abs(shift))
    across_sd = max(across_sd, LEVELS.edged_sd_px)
    half_length = 0.5 * float(np.ptp(along))
    return Place(float(line), float(column), along_sd, across_sd, half_width, max(half_length, 1.0))


def _to_car(centre: tuple[float, float], axis: Floats, y: Array, x: Array) -> tuple[Floats, Floats]:
    # Distances from the centre of a car, along and across it [pixel]
    y, x = np.asarray(y - centre[0], np.float64), np.asarray(x - centre[1], np.float64)
    return y * axis[0] + x * axis[1], y * axis[1] - x * axis[0]


def _to_picture(
    centre: tuple[float, float], axis: Floats, along: Floats, across: Floats
) -> tuple[Floats, Floats]:
    # Line and column from distances along and across a car [pixel]
    return centre[0] + along * axis[0] + across * axis[1], centre[1] + along * axis[1] - across * axis[0]


def _edge(aside: Floats, profile: Floats, half: float) -> float:
    # Distance from the middle of a roof to the edge of the paint [pixel]; NaN without a visible edge.
    # `aside`, `profile` (sample,): distance from the middle [pixel], and brightness there.
    width = round(0.5 * LEVELS.edge_px * LEVELS.steps_per_px)
    logs = np.log(np.maximum(profile, 1e-3))
    fall = np.zeros(logs.size)
    fall[width:-width] = logs[: -2 * width] - logs[2 * width :]
    fall[(aside < LEVELS.edge_span[0] * half) | (aside > LEVELS.edge_span[1] * half)] = 0.0
    steepest = int(np.argmax(fall))
    if fall[steepest] < np.log(LEVELS.min_edge_ratio):
        return np.nan
    near = slice(max(steepest - width, 0), steepest + width + 1)
    # the centroid of the fall is more precise than a sample of the profile
    return float(np.average(aside[near], weights=np.maximum(fall[near], 0.0)))


def level_light(brightness: Floats, lit: Bools, place: Place, axis: Floats) -> Level | None:
    """Return the brightness of a roof where it is level; None where too little of it is visible.

    The lean of a crowned roof grows in proportion to the distance from its level position. The logarithm of
    its brightness is therefore a smooth function of position: a plane for solid paint, curved by the lobe of
    flakes. A surface of second order replaces the plane where it fits significantly better by the Bayesian
    information criterion (Schwarz 1978). Glint lies above the surface; iterations exclude it.

    Takes ``brightness`` (line, column): brightness of the roof [1]; ``lit`` (line, column): the pixels
    fitted; ``place``: its level position in the same window; ``axis`` (2,): direction (line, column) along
    the car.
    """
    y, x = np.nonzero(lit & (brightness > 0.0))
    along, across = _to_car((place.line, place.column), axis, y, x)
    u, v = along / place.half_width, across / place.half_width
    near = (np.abs(u) < LEVELS.fitted[0]) & (np.abs(v) < LEVELS.fitted[1])
    if near.sum() < LEVELS.min_fitted_px:
        return None
    u, v, logs = u[near], v[near], np.log(brightness[y[near], x[near]])
    terms = np.stack([np.ones(u.size), u, v, u * u, u * v, v * v], axis=1)
    plane, quadric = _fitted_surface(terms[:, :3], logs), _fitted_surface(terms, logs)
    independent_px = u.size / LEVELS.clump_px
    gain = independent_px * np.log(plane[1] ** 2 / quadric[1] ** 2)
    fitted, _, fit_sd = quadric if gain > 3.0 * np.log(max(independent_px, 2.0)) else plane
    slope = fitted[1:3]
    place_sd = np.hypot(*(slope * np.array([place.along_sd, place.across_sd]) / place.half_width))
    change = np.abs(slope) / place.crown
    sd = float(np.hypot(fit_sd, place_sd))
    return Level(float(np.exp(fitted[0])), sd, float(change[0]), float(change[1]))


def _fitted_surface(design: Floats, logs: Floats) -> tuple[Floats, float, float]:
    # Fit of logarithms of brightness (pixel,) with a design matrix (pixel, term): value at the origin, slopes
    # and curvatures (term,); root mean square of the residuals; standard error of the value at the origin [1]
    fitted = np.ones(logs.size, bool)
    for _ in range(LEVELS.rounds):
        terms = np.asarray(np.linalg.lstsq(design[fitted], logs[fitted], rcond=None)[0], np.float64)
        residuals = logs - design @ terms
        # standard deviation of a normal distribution from the median absolute residual
        spread = max(1.4826 * float(np.median(np.abs(residuals[fitted]))), LEVELS.min_sd)
        inliers = (residuals < LEVELS.max_above_sd * spread) & (residuals > -LEVELS.max_below_sd * spread)
        if inliers.sum() < LEVELS.min_fitted_px or np.array_equal(inliers, fitted):
            break
        fitted = inliers
    rms = max(float(np.sqrt(np.mean(residuals[fitted] ** 2))), LEVELS.min_sd)
    inverse = np.linalg.pinv(design[fitted].T @ design[fitted])
    return terms, rms, rms * float(np.sqrt(LEVELS.clump_px * inverse[0, 0]))


# --- finish of a roof, solid or with flakes, from the change of its light over its crown -------------------


def difference_of(piece: Piece, picture: Picture, relative: Floats) -> tuple[float, float] | None:
    """Return the difference of the brightest and darkest quarters of a roof; None with too few pixels.

    The share of its grey part, equal in all channels under direct light, and its contrast: the length of the
    difference over the length of the mean spectrum [1].

    A lean b changes the direct light of a solid body r by d = f_dir (r s b + g), with a grey part g: the sun
    mirrored by the coat. Flakes add their reflection to g. Takes ``relative`` (line, column): brightness
    relative to the level position; values over 1.6 or under 0.5 are glint or another part.
    """
    diffuse = picture.model.diffuse_fraction
    chosen = piece.inside & (np.abs(relative - 1.05) < 0.55)
    if chosen.sum() < FINISHES.min_px:
        return None
    sky = FOOTPRINTS.mirrored * diffuse * picture.model.zenith_radiance
    body = picture.channels[piece.window][chosen].astype(np.float64) - sky
    low, high = np.quantile(relative[chosen], [0.25, 0.75])
    difference = body[relative[chosen] >= high].mean(axis=0) - body[relative[chosen] <= low].mean(axis=0)
    spectrum, direct = body.mean(axis=0), 1.0 - diffuse
    coloured, flat = np.linalg.lstsq(np.stack([spectrum * direct, direct], axis=1), difference, rcond=None)[0]
    coloured_mean, flat_mean = float(coloured * (spectrum * direct).mean()), float(flat * direct.mean())
    contrast = float(np.linalg.norm(difference)) / max(float(np.linalg.norm(spectrum)), 1e-9)
    return flat_mean / max(abs(coloured_mean + flat_mean), 1e-9), contrast


def judge_finish(
    verdict: Verdict, picture: Picture, level: Level, difference: tuple[float, float] | None
) -> None:
    """Add the finish of a roof and its evidence to the verdict; without evidence it stays unknown."""
    spectrum = verdict.measures.spectrum
    if (
        not verdict.measures.pixels
        or picture.zenith is None
        or picture.direct_share < FINISHES.min_direct
        or picture.zenith > FINISHES.max_zenith_deg
        or float(spectrum.mean()) < FINISHES.min_level
    ):
        return
    solid = picture.direct_share * change_with_lean(picture.zenith)
    across, along = level.across_change, level.along_change
    low, high = FINISHES.solid_zenith_deg
    changes = f"its light changes by {np.radians(level.lean_change):.1%} a degree of lean"
    if across > FINISHES.metallic_across * solid + FINISHES.offset or (
        picture.zenith >= high and along > FINISHES.metallic_along * solid + FINISHES.offset
    ):
        verdict.finish = "metallic"
        verdict.reasons.append(f"metallic: {changes}, that of solid paint by {np.radians(solid):.1%}")
    elif low <= picture.zenith <= high and level.lean_change < FINISHES.max_solid_change:
        verdict.finish = "solid"
        verdict.reasons.append(f"solid: {changes}; flakes so near the sun's mirror image change more")
    elif difference is not None and spectrum.std() > FINISHES.min_colour * spectrum.mean():
        # coloured paint: by the difference of its bright and its dark part
        share, contrast = difference
        is_solid = (
            picture.zenith <= FINISHES.max_coloured_zenith_deg
            and across < FINISHES.max_coloured[0] * solid
            and along < FINISHES.max_coloured[1] * solid
            and abs(share) < FINISHES.max_flat_share
        )
        text = f"{abs(share):.0%} of the difference between its bright and its dark part is grey"
        if contrast >= FINISHES.min_contrast and share > FINISHES.metallic_flat_share:
            verdict.finish = "metallic"
            verdict.reasons.append(f"metallic: {text}, and flakes mirror all colours")
        elif contrast >= FINISHES.min_contrast and is_solid:
            verdict.finish = "solid"
            verdict.reasons.append(f"solid: only {text}, and flakes would mirror all colours")


# --- cars and their parts ----------------------------------------------------------------------------------

#: Rank of a roof between windows, or behind a windscreen, on a footprint of one car.
_CERTAIN = 5


class Car(NamedTuple):
    """Pieces of the picture that belong to one car, its footprint and its roof."""

    pieces: list[Piece]
    #: Footprint around one of the pieces; None where its colour extends farther than a car.
    footprint: Footprint | None = None
    roof: Roof | NoRoof = NoRoof("its colour extends farther than a car: it may not belong to one", False)

    @property
    def is_car(self) -> bool:
        """Whether windows show that the footprint is a car."""
        return self.roof.is_car if isinstance(self.roof, NoRoof) else True

    @property
    def size(self) -> int:
        """Number of pixels."""
        return 0 if self.footprint is None else int(self.footprint.area.sum())

    @property
    def rank(self) -> tuple[int, int]:
        """Certainty of the roof, `_CERTAIN` at most, and the size."""
        if self.footprint is None:
            return 0, 0
        if isinstance(self.roof, NoRoof):
            return 1 + int(self.roof.is_car), self.size
        if not self.footprint.is_one_car:
            return 3, self.size
        return _CERTAIN - int(not (self.roof.complete or self.roof.sided)), self.size

    def unless_larger(self, max_size: float) -> Car:
        """Return the car, without a roof where it has more pixels than cars have."""
        if self.size <= max_size:
            return self
        reason = "it is larger than other cars: several of one colour may touch; draw a region by hand"
        return self._replace(roof=NoRoof(reason, False))


def find_cars(pieces: Iterable[Piece], picture: Picture) -> list[Car]:
    """Return the cars around pieces of paint, the most certain first.

    The largest pieces are examined first, those as dark as windows last. A piece with a certain roof is a
    car. A piece with less evidence is a car only outside the certain cars.
    """
    car_park = _CarPark(picture)

    def order(piece: Piece) -> tuple[bool, int, tuple[int, int], int]:
        level = float(np.median(picture.level[piece.window][piece.inside]))
        return level < SURFACES.dark, -int(piece.inside.sum()), piece.origin, piece.body

    # certain cars with paint of narrow brightness, then again without footprints larger than most cars
    narrow, wide = JOININGS[:4], JOININGS[4:]
    uncertain = car_park.add_certain([Car([piece]) for piece in sorted(pieces, key=order)], narrow, np.inf)
    sizes = [car.size for car in car_park.cars]
    max_size = CARS.max_size * float(np.median(sizes)) if len(sizes) >= CARS.min_sizes else np.inf
    removed = [Car([piece]) for piece in car_park.remove_larger(max_size)]
    uncertain += car_park.add_certain(removed, narrow, max_size)
    # certain cars with paint of wide brightness, then the best uncertain ones beside them
    uncertain = car_park.add_certain([car.unless_larger(max_size) for car in uncertain], wide, max_size)
    for car in sorted(uncertain, key=lambda car: car.rank, reverse=True):
        if not car_park.assign(car.pieces[0]):
            car_park.add(car)
    return car_park.cars


class _CarPark:
    # Cars of a picture, and maps of the car number of every pixel, -1 without a car
    def __init__(self, picture: Picture) -> None:
        self.cars: list[Car] = []
        self._picture = picture
        self._area = np.full(picture.level.shape, -1, np.int32)
        self._paint = self._area.copy()

    def add_certain(
        self, cars: list[Car], joinings: Sequence[tuple[bool, bool, bool]], max_size: float
    ) -> list[Car]:
        # Add the certain cars around pieces; return the best cars around the other pieces
        uncertain = []
        for best in cars:
            piece = best.pieces[0]
            if self.assign(piece):
                continue
            colour = np.median(self._picture.without_sky(piece.window)[piece.inside], axis=0)
            for footprint in footprints_of(piece.inside, piece.origin, colour, self._picture, joinings):
                roof = find_roof(footprint, self._picture.level[footprint.window])
                car = Car([piece], footprint, roof).unless_larger(max_size)
                best = max(best, car, key=lambda car: car.rank[0])
                if best.rank[0] == _CERTAIN:
                    break
            if best.rank[0] == _CERTAIN:
                self.add(best)
            else:
                uncertain.append(best)
        return uncertain

    def remove_larger(self, max_size: float) -> list[Piece]:
        # Remove cars with more pixels, which are several cars side by side; return their pieces
        is_kept = [car.size <= max_size for car in self.cars]
        # new number of every car; the last entry keeps -1
        numbers = np.append(np.where(is_kept, np.cumsum(is_kept) - 1, -1), -1).astype(np.int32)
        self._area, self._paint = numbers[self._area], numbers[self._paint]
        removed = [car for car, keep in zip(self.cars, is_kept, strict=True) if not keep]
        self.cars = [car for car, keep in zip(self.cars, is_kept, strict=True) if keep]
        return [piece for car in removed for piece in car.pieces]

    def assign(self, piece: Piece) -> bool:
        # Assign a piece to the car on whose paint or area it lies; return whether there is such a car
        for car_numbers, min_share in (
            (self._paint, CARS.min_piece_share),
            (self._area, CARS.min_window_share),
        ):
            numbers = car_numbers[piece.window][piece.inside]
            if (numbers >= 0).mean() > min_share:
                self.cars[int(np.bincount(numbers[numbers >= 0]).argmax())].pieces.append(piece)
                return True
        return False

    def add(self, car: Car) -> None:
        # Add a piece to the car that its footprint overlaps most, or as a new car
        footprint = car.footprint
        if footprint is not None:
            numbers = self._area[footprint.window][footprint.area]
            shared = np.bincount(numbers[numbers >= 0], minlength=1)
            overlapped = int(shared.argmax())
            smaller = min(car.size, self.cars[overlapped].size) if shared.any() else 0
            if shared[overlapped] > CARS.min_overlap * smaller:
                self.cars[overlapped].pieces.extend(car.pieces)
                return
        self.cars.append(car)
        if footprint is not None and car.is_car:
            # other footprints, such as unusual ground, get no further pieces
            for car_numbers, mask in (
                (self._area, footprint.area),
                (self._paint, footprint.area & footprint.paint),
            ):
                view = car_numbers[footprint.window]
                view[mask & (view < 0)] = len(self.cars) - 1


def judge_car(car: Car, picture: Picture, limits: Limits) -> list[Verdict]:
    """Return the verdicts on a car's roof and on the other pieces of its paint; at most one is proposed."""
    roof = None
    if isinstance(car.roof, Roof) and car.footprint is not None:
        roof = _judge_roof(car.footprint, car.roof, picture, limits)
    parts = [_judge_part(piece, car, picture, limits) for piece in car.pieces]
    verdicts = parts if roof is None else [roof, *parts]
    for verdict in verdicts:
        if doubt := doubt_about_clouds(verdict.piece.window, picture):
            verdict.objections.append(doubt)
    best = roof if roof is not None and not roof.objections else None
    if best is None and roof is not None and roof.measures.pixels:
        # an error of the level position affects the other parts, too
        for part in parts:
            part.objections.append("the roof of the same car is refused")
    elif best is None:
        best = max((part for part in parts if not part.objections), key=lambda part: part.score, default=None)
    if best is not None:
        y, x = best.piece.centre
        objection = f"another part of the same car is better: the one at line {y:.0f}, column {x:.0f}"
        for part in parts:
            if part is not best and not part.objections:
                part.objections.append(objection)
    return verdicts


def _judge_roof(footprint: Footprint, roof: Roof, picture: Picture, limits: Limits) -> Verdict | None:
    # Verdict on a roof; None where all its pixels are near edges
    piece = _piece_of(footprint, roof, picture.model, limits.erode)
    if piece is None:
        return None
    y, x = piece.origin[0] - footprint.origin[0], piece.origin[1] - footprint.origin[1]
    lines, columns = piece.inside.shape
    brightness = footprint.brightness[y : y + lines, x : x + columns]
    lit = piece.inside & (picture.layers["blocked_direct"][piece.window] < limits.shadow)
    # where it is level, by its edges, and by the height model
    place = level_place(footprint, roof)
    centre = (place.line - y, place.column - x)
    prior = lean_to_sun(roof.axis, picture.shadow_side)
    lean = measured_lean(picture.heights, piece.window, piece.inside, centre, prior, picture.shadow_side)
    centre = (centre[0] + lean.shift[0], centre[1] + lean.shift[1])
    text = f"by the height model it leans by {lean.angle:+.1f} degrees towards the sun"
    reasons = [roof.reason, *([text] if np.isfinite(lean.angle) else [])]
    level, objection = None, f"{text}, and has no level position; draw a region on a level part"
    is_off = not (-1.0 <= centre[0] <= lines and -1.0 <= centre[1] <= columns)
    if not (np.isfinite(lean.angle) and is_off):
        level = level_light(brightness, lit, place._replace(line=centre[0], column=centre[1]), roof.axis)
        objection = "too few lit pixels near the level position of the roof for its brightness"
    if level is None:
        return Verdict(piece, measured(piece, picture, limits), "roof", 0.0, reasons, [objection])
    # pixels near the level brightness; a wider range where these are too few
    relative = brightness / level.brightness
    for factor in CARS.wider:
        roof_limits = replace(limits, glint=np.inf, adjacency=np.inf, brightness=factor * limits.brightness)
        measures = measured(piece, picture, roof_limits, relative)
        if measures.pixels >= limits.min_pixels:
            break
    # mean difference of the usable pixels from the level position
    offset = float(relative[measures.usable].mean()) - 1.0 if measures.pixels else 0.0
    level = level._replace(sd=float(np.hypot(level.sd, offset)))
    verdict = Verdict(piece, measures, "roof", reasons=reasons)
    _judge_pixels(verdict, limits)
    judge_level(verdict, picture, lean.sd, level)
    judge_finish(verdict, picture, level, difference_of(piece, picture, relative))
    if verdict.finish == "metallic":
        verdict.kind = "metallic"
    _judge_windows(verdict, footprint, roof, picture)
    return verdict


def _judge_windows(verdict: Verdict, footprint: Footprint, roof: Roof, picture: Picture) -> None:
    level = picture.level[footprint.window]
    paint_level = float(np.nanmedian(level[footprint.paint & footprint.area]))
    step = paint_level - roof.window_level
    if step < max(JUDGING.min_window_step, JUDGING.min_window_contrast * paint_level):
        verdict.objections.append(
            f"the windows beside it are darker by only {step:.4f}: it may itself be a window; draw a region "
            "by hand"
        )
    if paint_level >= SURFACES.dark:
        return
    other_paint = footprint.paint & footprint.area & ~roof.inside
    ratio = np.nan
    if other_paint.any():
        ratio = float(np.nanmedian(level[roof.inside]) / np.nanmedian(level[other_paint]))
    if not ((roof.complete or roof.sided) and JUDGING.dark_roof[0] < ratio < JUDGING.dark_roof[1]):
        verdict.objections.append(
            "a dark roof needs the same paint beyond both its windows, or a bonnet before its windscreen and "
            "side windows: this may be a window or a bed; draw a region by hand"
        )


def _piece_of(footprint: Footprint, roof: Roof, model: SceneModel, erode: int) -> Piece | None:
    # Pixels of a roof away from other colours.
    # Pixels brighter than the car's other paint count as paint: they lie in the lobe of flakes, or in glint.
    paint = footprint.paint | (footprint.brightness >= FOOTPRINTS.brightness[0][1])
    inside = roof.inside & (distance_transform_edt(np.pad(paint, 1))[1:-1, 1:-1] > erode)
    lines, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    if not lines.size:
        return None
    origin = (int(lines[0]) + footprint.origin[0], int(columns[0]) + footprint.origin[1])
    mask = inside[lines[0] : lines[-1] + 1, columns[0] : columns[-1] + 1]
    piece = Piece(0, origin, mask)
    segment = model.segment[piece.window][mask]
    body = model.body[segment[segment >= 0]]
    return piece._replace(body=int(np.bincount(body).argmax())) if body.size else None


def _judge_part(piece: Piece, car: Car, picture: Picture, limits: Limits) -> Verdict:
    measures = measured(piece, picture, limits)
    spectrum, mean_level = measures.spectrum, float(measures.spectrum.mean()) if measures.pixels else 0.0
    if not car.is_car or car.footprint is None:
        return Verdict(piece, measures, objections=[car.roof.reason], scenery=mean_level < SURFACES.dark)
    verdict = Verdict(piece, measures, "panel")
    if car.rank[0] < _CERTAIN:
        verdict.objections.append(
            "its car has no certain roof: it may belong to another car, or be ground between cars; draw a "
            "region by hand"
        )
    verdict.reasons.append("part of a car with windows across it and along it")
    _judge_pixels(verdict, limits)
    assumed = Level(along_change=JUDGING.unseen_change * picture.direct_share, is_measured=False)
    judge_level(verdict, picture, JUDGING.panel_deg, assumed)
    if measures.pixels:
        # colour and brightness like the car's other paint
        of_roof = car.roof.inside if isinstance(car.roof, Roof) else car.footprint.paint & car.footprint.area
        car_spectrum = np.nanmedian(picture.channels[car.footprint.window][of_roof], axis=0)
        zenith = 45.0 if picture.zenith is None else picture.zenith
        slope = picture.direct_share * float(np.tan(np.radians(zenith)))
        ratio = float(spectrum.mean() / car_spectrum.mean())
        allowed = max(CARS.max_step, CARS.max_lean * slope)
        if _cosine(spectrum, car_spectrum) < FOOTPRINTS.min_cosine:
            verdict.objections.append(
                "its colour differs from the car's paint: it may be a window, a bed or a load"
            )
        elif abs(ratio - 1.0) > allowed:
            verdict.objections.append(
                f"it is {ratio:.2f} times as bright as the car's other paint, while lean explains at most "
                f"{allowed:.0%}: it may be a shadow, a bed, or paint with flakes; draw a region on the roof"
            )
        # a spectrum like the ground's, lit or in shade
        max_length = float(np.exp(FOOTPRINTS.max_ground_log_ratio)) * float(np.linalg.norm(picture.ground))
        is_like_ground = _cosine(spectrum, picture.ground) > FOOTPRINTS.min_cosine
        if is_like_ground and float(np.linalg.norm(spectrum)) < max_length:
            verdict.objections.append(
                "it has the colour of the ground, and is no brighter; draw a region by hand"
            )
    if mean_level < SURFACES.dark:
        verdict.objections.append("it is as dark as a window, and not the roof")
    return verdict


def _cosine(first: Floats, second: Floats) -> float:
    lengths = float(np.linalg.norm(first) * np.linalg.norm(second))
    return float(first @ second) / max(lengths, 1e-9)
