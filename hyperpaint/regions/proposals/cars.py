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
from hyperpaint.surroundings.sun_and_sky import MAX_SUN_ZENITH_DEG

from .between_clouds import GAPS, doubt_about_clouds
from .candidates import Limits, Measures, Picture, Piece, largest_body, measured
from .footprints import WAYS, Footprint, Scene, Way, footprints_of
from .leans import lean_to_sun, measured_lean
from .proposal_rules import CARS, FOOTPRINTS, JUDGING, ROOFS, SURFACES
from .roofs import NoRoof, Roof, find_roof

# -- Kind of a piece of the scene, uncertainty of its signature, and its quality as a region.


@dataclass
class Verdict:
    """Verdict on a piece."""

    kind: str = ""  #: "roof", "panel", "metallic"; empty where it may not belong to a car.
    score: float = 0.0  #: 0 to 1, from the measures.
    #: Reasons for it and objections against it; without objections it is proposed.
    reasons: list[str] = field(default_factory=list)
    objections: list[str] = field(default_factory=list)
    finish: str = "unknown"  #: "solid" or "metallic" where brightness and colour of a roof show it.
    level_sd: float = np.nan  #: Standard uncertainty of its level, relative [1].
    lean: float = np.nan  #: Standard deviation of its lean [degree].
    #: Whether it looks like leaves, a shadow or a window: refused, and listed after all others.
    scenery: bool = False


class Judged(NamedTuple):
    """A piece, its measures and the verdict on it."""

    piece: Piece
    measures: Measures
    verdict: Verdict


class Level(NamedTuple):
    """Brightness of a part where it is level, relative [1]."""

    sd: float = 0.0  #: Standard uncertainty of its pixels' offset from it.
    #: Its change a radian of lean along and across the car, estimated from the crown of a roof.
    along_change: float = 0.0
    across_change: float = 0.0
    is_seen: bool = True  #: Whether this change is measured, not assumed.

    @property
    def lean_change(self) -> float:
        """Largest relative change over lean in any direction [1/rad]."""
        return float(np.hypot(self.along_change, self.across_change))


def direct_share(picture: Picture) -> float:
    """Return the direct part of the light on level ground, mean over the channels [1]."""
    return 1.0 - float(picture.model.diffuse_fraction.mean())


def change_with_lean(zenith: float) -> float:
    """Return the relative change of the sun's light in a body under a coat for a lean towards it [1/rad].

    Takes ``zenith``: angle of the sun to the normal of the body part [degree]. The change is
    -d ln(cos t (1 - F(t))) / dt: tan t, and the larger transmission of the coat for steeper light.
    """
    angles = np.radians(min(zenith, MAX_SUN_ZENITH_DEG)) + np.array([-1e-3, 1e-3])
    light = np.log(np.cos(angles) * (1.0 - interface_reflectance(np.degrees(angles))))
    return float(light[0] - light[1]) / 2e-3


def judge_level(verdict: Verdict, measures: Measures, picture: Picture, rake: float, level: Level) -> None:
    """State the uncertainty of the level of a part, and visible flakes; object where it is too uncertain.

    A small lean b towards the sun changes a body's light by some f_dir tan(zenith) b, and the light of flakes
    by more. The change of brightness over a roof, whose crown leans by known angles, shows by how much more.
    Takes ``rake``: standard deviation of a lean that no brightness shows [degree].
    """
    if not measures.pixels:
        return
    zenith = 45.0 if picture.zenith is None else picture.zenith
    direct = direct_share(picture)
    slope = direct * change_with_lean(zenith)
    mirrored = mirrored_sky(picture)
    # brightness of the paint without the mirrored sky, as in its signature
    brightness = max(float(measures.spectrum.mean()) - mirrored, 1e-3)
    parts = {
        "noise and dust": JUDGING.least_sd,
        f"a lean of {rake:.1f} degrees that no picture shows": float(np.radians(rake))
        * max(slope, level.lean_change),
        "the place where it is level": level.sd,
        "the sky that its coat mirrors": _mirror_share_sd(picture, zenith) * mirrored / brightness,
        "its darkness": JUDGING.mirror_sd / brightness,
        "broken clouds": GAPS.sd if picture.sun is not None else 0.0,
    }
    verdict.level_sd, verdict.lean = float(np.hypot.reduce(list(parts.values()))), rake
    has_lobe = direct > JUDGING.min_direct and level.lean_change > JUDGING.max_solid_gain * slope
    most = JUDGING.max_lobe_sd if has_lobe else JUDGING.max_level_sd
    allowed = max(most, JUDGING.max_dark_sd / brightness)
    largest = max(parts, key=parts.__getitem__)
    text = f"its level is uncertain by {verdict.level_sd:.1%}, most of all by {largest}"
    if has_lobe and level.is_seen:
        text += f", and its light changes by {np.radians(level.lean_change):.0%} a degree, as that of flakes"
    if not verdict.level_sd <= allowed:
        advice = "fly under a higher sun, or draw a region that is known to be level"
        verdict.objections.append(f"{text}: {allowed:.1%} is allowed; {advice}")
    else:
        verdict.reasons.append(text)


def mirrored_sky(picture: Picture) -> float:
    """Return the sky mirrored by a level coat, in reflectance, mean over the channels [1]."""
    model = picture.model
    return FOOTPRINTS.mirrored * float((model.diffuse_fraction * model.zenith_radiance).mean())


def _mirror_share_sd(picture: Picture, zenith: float) -> float:
    # Relative standard uncertainty of the mirrored sky [1].
    # Skies brighter than a clear one, by haze, are uneven, most of all around the sun; a covered sky is
    # equally bright everywhere.
    direct = direct_share(picture)
    haze = (1.0 - direct) / float(diffuse_fraction(picture.model.channel_wavelength, zenith).mean()) - 1.0
    uneven = direct * float(np.hypot(JUDGING.mirror_share_sd, haze))
    return uneven + (1.0 - direct) * JUDGING.covered_share_sd


def judge_pixels(verdict: Verdict, measures: Measures, limits: Limits) -> None:
    """State the measures; object to too few pixels, and to mixed colours; set the score."""
    lost = ", ".join(f"{share:.0%} {reason}" for reason, share in measures.lost.items() if share >= 0.01)
    left_out = f" ({lost} left out)" if lost else ""
    if measures.pixels < limits.min_pixels:
        verdict.objections.append(
            f"{measures.pixels} pixels are left, expected {limits.min_pixels}{left_out}"
        )
        return
    verdict.reasons.append(f"{measures.pixels} pixels{left_out}")
    if measures.angle > limits.angle:
        verdict.objections.append(f"not homogeneous: spectra differ by {measures.angle:.1f} degrees")
    verdict.reasons.append(
        f"homogeneous to {measures.angle:.1f} degrees, brightness to {measures.spread:.1%}; "
        f"glint {measures.glint:.3f}, light of neighbours {measures.adjacency:.3f}"
    )
    verdict.score = score_of(measures)


def score_of(measures: Measures) -> float:
    """Return area x homogeneity / (1 + adjacency + glint + tilt), each over the value that halves it."""
    homogeneity = 1.0 / (1.0 + (measures.angle / JUDGING.half_angle_deg) ** 2)
    against = (
        measures.adjacency / JUDGING.half_adjacency
        + measures.glint / JUDGING.half_glint
        + measures.spread / JUDGING.half_spread
    )
    return float(min(1.0, measures.pixels / JUDGING.enough_px) * homogeneity / (1.0 + against))


# -- Brightness of the roof of a car where it is level, with its uncertainty.


@dataclass(frozen=True)
class LevelRules:
    """The axis of a roof, and the surface through its brightness.

    Lengths are relative to half the width of the roof, which is 0.5 to 0.7 m of all cars.
    """

    #: Range in which its edges are searched, in half widths from its windows.
    edge_span: tuple[float, float] = (0.7, 1.25)
    #: Factor by which brightness falls at an edge within `edge_px`, at least: windows reflect less than half
    #: as much as paint that is not dark [1].
    min_edge_ratio: float = 1.2
    edge_px: float = 1.5  #: Distance over which an edge falls: a sampled edge is one to two wide [pixel].
    steps_per_px: int = 4  #: Samples a pixel of a profile across a roof: a tenth of the error of its place.
    #: Largest shift of the middle of two edges from the middle of the windows; beyond, one is no roof edge.
    max_shift: float = 0.3
    #: Standard deviation of the axis between two edges: each errs by a half where its pixel is mixed [pixel].
    edged_sd_px: float = 0.4
    #: Half of the fitted range, along and across: within it, slopes are proportional to the distance, and a
    #: lobe adds a term of second order.
    fitted: tuple[float, float] = (0.9, 0.5)
    rounds: int = 30  #: Maximum number of iterations that leave glint out of the surface.
    #: Largest residual above the surface in the fit: glint only adds [standard deviation].
    max_above_sd: float = 2.5
    max_below_sd: float = 3.0  #: The same below it [standard deviation].
    min_sd: float = 0.003  #: Smallest value of this standard deviation, relative to the brightness [1].
    min_fitted_px: int = 25  #: Minimum number of pixels of the fit.
    #: Number of pixels with correlated errors by dust, orange peel and point spread: squares of three.
    clump_px: float = 9.0
    #: Lean half a width across from the middle of a roof [degree]: roofs have a radius of 2.5 to 3 m.
    crown_deg: float = 12.0
    #: Drop of a roof over its half length, relative to it: 3 cm of 0.7 m, 7 cm of 1.4 m, a parabola [1]; and
    #: the largest lean of short roofs half a width from their middle [degree].
    drop: float = 0.05
    max_crown_deg: float = 5.0


LEVELS = LevelRules()


class Place(NamedTuple):
    """Position on a roof where it is level."""

    line: float  #: In the window of the footprint, as `column` is.
    column: float
    along_sd: float  #: How far that may be off along the car, standard deviation [pixel].
    across_sd: float  #: The same across it [pixel].
    half_width: float  #: Half of the width of the roof [pixel].
    half_length: float  #: Half of its length [pixel].

    @property
    def crown(self) -> Floats:
        """Lean half a width from here along the car, and across it (2,) [radian]."""
        along = 2.0 * LEVELS.drop * self.half_width / self.half_length
        limits = np.radians([LEVELS.max_crown_deg, LEVELS.crown_deg])
        return np.asarray([min(along, float(limits[0])), limits[1]])


class Levelled(NamedTuple):
    """Brightness of a roof where it is level."""

    middle: float  #: Brightness there, in the unit of the brightness passed [1].
    sd: float  #: Its relative standard uncertainty from the fit and the place [1].
    #: Its relative change a radian of lean along and across the car, as far as the roof's crown shows it [1].
    along_change: float
    across_change: float


def level_place(footprint: Footprint, roof: Roof) -> Place:
    """Return where a roof is level: along the car from its windows, across it from the roof's edges.

    A car is symmetric, so that its roof is level across halfway between its edges. An edge is where
    brightness falls most steeply as a ratio: shading changes brightness over a roof by factors, and a
    difference would put the edge of the darker side too far in.
    """
    along, across = _from(roof.middle, roof.axis, *np.nonzero(roof.inside))
    half = max(float(np.abs(across).max()) / ROOFS.used_width, 1.0)
    tracks = np.arange(np.ceil(along.min()), np.floor(along.max()) + 1.0)
    # median over all tracks at each distance across, robust against roof rails and antennas
    aside = np.arange(0.0, LEVELS.edge_span[1] * half + 2.0 * LEVELS.edge_px, 1.0 / LEVELS.steps_per_px)
    edges = []
    for sign in (-1.0, 1.0):
        places = _to(roof.middle, roof.axis, tracks[:, None], sign * aside)
        profile = np.nanmedian(map_coordinates(footprint.brightness, places, order=1, mode="nearest"), axis=0)
        edges.append(sign * _edge(aside, profile, half))
    shift = 0.5 * (edges[0] + edges[1])
    seen = bool(abs(shift) < LEVELS.max_shift * half)
    if seen:
        half = 0.5 * (edges[1] - edges[0])
    line, column = _to(roof.middle, roof.axis, np.zeros(()), np.array(shift if seen else 0.0))
    # the middle is equally likely anywhere within its range
    along_sd, across_sd = (part / float(np.sqrt(3.0)) for part in (roof.unsure, roof.unsure_across))
    if seen:
        across_sd = LEVELS.edged_sd_px
    elif np.isfinite(shift):  # edges that contradict the windows
        across_sd = max(across_sd, abs(shift))
    across_sd = max(across_sd, LEVELS.edged_sd_px)
    length = 0.5 * float(np.ptp(along))
    return Place(float(line), float(column), along_sd, across_sd, half, max(length, 1.0))


def _from(middle: tuple[float, float], axis: Floats, y: Array, x: Array) -> tuple[Floats, Floats]:
    # Distances of places from a middle, along and across a car [pixel]
    y, x = np.asarray(y - middle[0], np.float64), np.asarray(x - middle[1], np.float64)
    return y * axis[0] + x * axis[1], y * axis[1] - x * axis[0]


def _to(middle: tuple[float, float], axis: Floats, along: Floats, across: Floats) -> tuple[Floats, Floats]:
    # Line and column of places along and across a car [pixel]
    return middle[0] + along * axis[0] + across * axis[1], middle[1] + along * axis[1] - across * axis[0]


def _edge(aside: Floats, profile: Floats, half: float) -> float:
    # Distance from the middle to the edge of the paint [pixel]; NaN without a visible edge.
    # Takes `aside`, `profile` (sample,): distance from the middle [pixel], and brightness there.
    width = round(0.5 * LEVELS.edge_px * LEVELS.steps_per_px)
    logs = np.log(np.maximum(profile, 1e-3))
    fall = np.zeros(logs.size)
    fall[width:-width] = logs[: -2 * width] - logs[2 * width :]
    fall[(aside < LEVELS.edge_span[0] * half) | (aside > LEVELS.edge_span[1] * half)] = 0.0
    at = int(np.argmax(fall))
    if fall[at] < np.log(LEVELS.min_edge_ratio):
        return np.nan
    near = slice(max(at - width, 0), at + width + 1)
    # the centroid of the fall: less than a sample of the profile
    return float(np.average(aside[near], weights=np.maximum(fall[near], 0.0)))


def level_light(brightness: Floats, lit: Bools, place: Place, axis: Floats) -> Levelled | None:
    """Return the brightness of a roof where it is level; None where too little of it is visible.

    A crowned roof leans in proportion to the distance from there, so that the logarithm of its brightness is
    a smooth function of place: a plane for solid paint, curved by the lobe of flakes. Near the middle a
    surface of second order is sufficient, and is used where it is significantly better than the plane
    (Schwarz 1978). Glint lies above the surface, and is left out in several iterations.

    Takes ``brightness`` (line, column): of the roof [1]; ``lit`` (line, column): the pixels fitted;
    ``place``: where it is level, in the same window; ``axis`` (2,): direction (line, column) along the car.
    """
    y, x = np.nonzero(lit & (brightness > 0.0))
    along, across = _from((place.line, place.column), axis, y, x)
    u, v = along / place.half_width, across / place.half_width
    near = (np.abs(u) < LEVELS.fitted[0]) & (np.abs(v) < LEVELS.fitted[1])
    if near.sum() < LEVELS.min_fitted_px:
        return None
    u, v, logs = u[near], v[near], np.log(brightness[y[near], x[near]])
    plane = _Surface.through(np.stack([np.ones(u.size), u, v], axis=1), logs)
    bent = _Surface.through(np.stack([np.ones(u.size), u, v, u * u, u * v, v * v], axis=1), logs)
    independent = u.size / LEVELS.clump_px
    gain = independent * np.log(plane.rms**2 / bent.rms**2)
    best = bent if gain > 3.0 * np.log(max(independent, 2.0)) else plane
    slope = best.terms[1:3]
    place_sd = np.hypot(*(slope * np.array([place.along_sd, place.across_sd]) / place.half_width))
    change = np.abs(slope) / place.crown
    sd = float(np.hypot(best.sd, place_sd))
    return Levelled(float(np.exp(best.terms[0])), sd, float(change[0]), float(change[1]))


class _Surface(NamedTuple):
    terms: Floats  #: (term,): Its value in the middle, its slopes and curvatures.
    rms: float  #: Root mean square of the residuals of the fit [1].
    sd: float  #: Standard error of its value in the middle [1].

    @classmethod
    def through(cls, place: Floats, logs: Floats) -> _Surface:
        # Surface through logarithms of brightness (pixel,) at places (pixel, term)
        fitted = np.ones(logs.size, bool)
        for _ in range(LEVELS.rounds):
            terms = np.asarray(np.linalg.lstsq(place[fitted], logs[fitted], rcond=None)[0], np.float64)
            off = logs - place @ terms
            spread = max(1.4826 * float(np.median(np.abs(off[fitted]))), LEVELS.min_sd)
            chosen = (off < LEVELS.max_above_sd * spread) & (off > -LEVELS.max_below_sd * spread)
            if chosen.sum() < LEVELS.min_fitted_px or np.array_equal(chosen, fitted):
                break
            fitted = chosen
        rms = max(float(np.sqrt(np.mean(off[fitted] ** 2))), LEVELS.min_sd)
        inverse = np.linalg.pinv(place[fitted].T @ place[fitted])
        return cls(terms, rms, rms * float(np.sqrt(LEVELS.clump_px * inverse[0, 0])))


# -- Finish of a roof, solid or with flakes, from the change of its light over its crown.


@dataclass(frozen=True)
class FinishRules:
    """Thresholds of a finish. Changes are relative to lean, 1/rad, as the crown of a roof shows them.

    A solid body changes by f_dir d ln(cos t (1 - F(t))) / dt =: s under a sun at t; flakes of the fleet's
    kinds (flop index 3 and more) change by 1 to 10 near the sun's mirror direction, and by some s far off it.
    """

    min_direct: float = 0.5  #: Minimum direct share of the light for a visible lobe [1].
    #: Largest zenith angle of the sun: under a lower sun a roof shades itself [degree].
    max_zenith_deg: float = 62.0
    min_level: float = 0.06  #: Minimum mean reflectance of a roof: below, dust and sky dominate [1].
    #: Change across a roof, in s and beyond `offset`, above which it has flakes: its crown is known to a
    #: third.
    metallic_across: float = 1.7
    #: The same along it, where roofs of one length are bent unlike by a factor of three, and under a sun from
    #: `solid_zenith_deg` on, where no gloss of a rough coat lies on part of it.
    metallic_along: float = 5.0
    offset: float = 0.5  #: Additional change by dust, glint and neighbours [1/rad].
    #: Largest change in any direction of a solid roof, with the sun between the two angles below: flakes
    #: change by more than 2 there, and white pearl by 0.7 [1/rad].
    max_solid_change: float = 0.45
    solid_zenith_deg: tuple[float, float] = (
        20.0,
        32.0,
    )  #: These angles [degree]; nearer, a lobe's peak may be level.
    #: Flat (grey) part of the difference between the bright and the dark part of a coloured roof: largest for
    #: solid paint, and smallest for flakes, which mirror all colours; in between the finish is unknown [1].
    max_flat_share: float = 0.13
    metallic_flat_share: float = 0.33
    #: Largest zenith angle of the sun at which this shows solid paint [degree]: beyond, most of the change
    #: with lean comes from the body even with flakes.
    max_coloured_zenith_deg: float = 45.0
    min_colour: float = 0.35  #: Minimum standard deviation over mean of a coloured spectrum [1].
    min_contrast: float = 0.2  #: Minimum contrast of the bright and the dark part [1].
    #: Largest change across and along at which colour alone shows solid paint, in s.
    max_coloured: tuple[float, float] = (1.3, 2.0)
    min_px: int = 60  #: Minimum number of pixels of a roof whose quarters are compared.


FINISHES = FinishRules()


class Difference(NamedTuple):
    """Difference of the bright and the dark part of a roof."""

    flat_share: float  #: Flat part of the difference over the whole difference [1].
    contrast: float  #: Length of the difference over the length of the mean spectrum [1].


def difference_of(piece: Piece, picture: Picture, relative: Floats) -> Difference | None:
    """Return the difference of the brightest and darkest quarters of a roof; None with too few pixels.

    For a solid body r under a lean b the direct light changes, d = f_dir (r s b + g), with a flat part g: the
    sun in the coat. Flakes add their reflection to g. Takes ``relative`` (line, column): brightness over that
    of the level part; values over 1.6 or under 0.5 are glint or another part.
    """
    diffuse = picture.model.diffuse_fraction
    chosen = piece.inside & (np.abs(relative - 1.05) < 0.55)
    if chosen.sum() < FINISHES.min_px:
        return None
    sky = FOOTPRINTS.mirrored * diffuse * picture.model.zenith_radiance
    seen = picture.channels[piece.window][chosen].astype(np.float64) - sky
    low, high = np.quantile(relative[chosen], [0.25, 0.75])
    difference = seen[relative[chosen] >= high].mean(axis=0) - seen[relative[chosen] <= low].mean(axis=0)
    spectrum, direct = seen.mean(axis=0), 1.0 - diffuse
    coloured, flat = np.linalg.lstsq(np.stack([spectrum * direct, direct], axis=1), difference, rcond=None)[0]
    parts = float(coloured * (spectrum * direct).mean()), float(flat * direct.mean())
    contrast = float(np.linalg.norm(difference)) / max(float(np.linalg.norm(spectrum)), 1e-9)
    return Difference(parts[1] / max(abs(sum(parts)), 1e-9), contrast)


def judge_finish(
    verdict: Verdict, measures: Measures, picture: Picture, level: Level, difference: Difference | None
) -> None:
    """State the finish where there is evidence, with the evidence."""
    if not measures.pixels or picture.zenith is None or direct_share(picture) < FINISHES.min_direct:
        return
    if picture.zenith > FINISHES.max_zenith_deg or float(measures.spectrum.mean()) < FINISHES.min_level:
        return
    solid = direct_share(picture) * change_with_lean(picture.zenith)
    across, along = level.across_change, level.along_change
    low, high = FINISHES.solid_zenith_deg
    changes = f"its light changes by {np.radians(level.lean_change):.1%} a degree of lean"
    if across > FINISHES.metallic_across * solid + FINISHES.offset or (
        picture.zenith >= high and along > FINISHES.metallic_along * solid + FINISHES.offset
    ):
        verdict.finish = "metallic"
        verdict.reasons.append(f"metallic: {changes}, a solid paint's by {np.radians(solid):.1%}")
    elif low <= picture.zenith <= high and level.lean_change < FINISHES.max_solid_change:
        verdict.finish = "solid"
        verdict.reasons.append(f"solid: {changes}; flakes' would by more so near the sun's mirror image")
    elif difference is not None and measures.spectrum.std() > FINISHES.min_colour * measures.spectrum.mean():
        steady = across < FINISHES.max_coloured[0] * solid and along < FINISHES.max_coloured[1] * solid
        _judge_colours(verdict, difference, picture.zenith <= FINISHES.max_coloured_zenith_deg and steady)


def _judge_colours(verdict: Verdict, difference: Difference, steady: bool) -> None:
    # State the finish of coloured paint from the difference of its bright and its dark part.
    # Takes `steady`: whether its change with lean is no larger than for a solid paint.
    if difference.contrast < FINISHES.min_contrast:
        return
    share = difference.flat_share
    text = f"its bright and its dark part differ by {abs(share):.0%} in what has no colour"
    if share > FINISHES.metallic_flat_share:
        verdict.finish = "metallic"
        verdict.reasons.append(f"metallic: {text}, as flakes mirror")
    elif steady and abs(share) < FINISHES.max_flat_share:
        verdict.finish = "solid"
        verdict.reasons.append(f"solid: {text} only; flakes would mirror all colours")


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
