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
from .footprints import JOININGS, Footprint, Joining, Scene, footprints_of
from .leans import lean_to_sun, measured_lean
from .proposal_rules import CARS, FOOTPRINTS, JUDGING, ROOFS, SURFACES
from .roofs import NoRoof, Roof, find_roof

# --- verdict on a piece: kind, uncertainty of its level, score ---------------------------------------------


@dataclass
class Verdict:
    """Verdict on a piece."""

    kind: str = ""  #: "roof", "panel", "metallic"; empty where it may not belong to a car.
    score: float = 0.0  #: Score from 0 to 1, see `score_of`.
    reasons: list[str] = field(default_factory=list)  #: Reasons to propose the piece.
    objections: list[str] = field(default_factory=list)  #: Reasons to refuse it; any objection refuses it.
    finish: str = "unknown"  #: "solid" or "metallic" where brightness and colour of a roof show it.
    level_sd: float = np.nan  #: Relative standard uncertainty of its level [1].
    lean: float = np.nan  #: Standard deviation of its lean [degree].
    scenery: bool = False  #: Whether it looks like leaves, a shadow or a window, and is listed last.


class Judged(NamedTuple):
    """A piece, its measures and the verdict on it."""

    piece: Piece
    measures: Measures
    verdict: Verdict


class Level(NamedTuple):
    """Uncertainty of a part's brightness against its level position, and change of brightness with lean."""

    sd: float = 0.0  #: Relative standard uncertainty of the difference from the level position [1].
    along_change: float = 0.0  #: Relative change with lean along the car [1/rad].
    across_change: float = 0.0  #: Relative change with lean across the car [1/rad].
    is_measured: bool = True  #: Whether the changes are measured on the crown of a roof, not assumed.

    @property
    def lean_change(self) -> float:
        """Largest relative change over lean in any direction [1/rad]."""
        return float(np.hypot(self.along_change, self.across_change))


def direct_share(picture: Picture) -> float:
    """Return the direct part of the light on level ground, mean over the channels [1]."""
    return 1.0 - float(picture.model.diffuse_fraction.mean())


def change_with_lean(zenith: float) -> float:
    """Return the relative change of the sunlight under a coat with lean towards the sun [1/rad].

    Takes ``zenith``: angle t of the sun to the normal of the body part [degree]. With the reflectance F of
    the coat's interface, the change is -d ln(cos t (1 - F(t))) / dt: tan t, and a term for the larger
    transmission of the coat at steeper incidence.
    """
    angles = np.radians(min(zenith, MAX_SUN_ZENITH_DEG)) + np.array([-1e-3, 1e-3])
    light = np.log(np.cos(angles) * (1.0 - interface_reflectance(np.degrees(angles))))
    return float(light[0] - light[1]) / 2e-3


def judge_level(verdict: Verdict, measures: Measures, picture: Picture, rake: float, level: Level) -> None:
    """Add the uncertainty of a part's level, and visible flakes, to its verdict; object if it is too large.

    A small lean b towards the sun changes the light of a solid body by about f_dir tan(zenith) b, with the
    direct share f_dir of the light, and the light of flakes by more. The change of brightness over the crown
    of a roof, which leans by known angles, shows how much more. Takes ``rake``: standard deviation of the
    part's unknown lean [degree].
    """
    if not measures.pixels:
        return
    zenith = 45.0 if picture.zenith is None else picture.zenith
    direct = direct_share(picture)
    slope = direct * change_with_lean(zenith)
    mirrored = mirrored_sky(picture)
    # the signature excludes the mirrored sky, too
    brightness = max(float(measures.spectrum.mean()) - mirrored, 1e-3)
    contributions = {
        "noise and dust": JUDGING.least_sd,
        f"an unknown lean of {rake:.1f} degrees": float(np.radians(rake)) * max(slope, level.lean_change),
        "the position where it is level": level.sd,
        "the sky mirrored by its coat": _mirror_share_sd(picture, zenith) * mirrored / brightness,
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


def mirrored_sky(picture: Picture) -> float:
    """Return the sky mirrored by a level coat, in reflectance, mean over the channels [1]."""
    model = picture.model
    return FOOTPRINTS.mirrored * float((model.diffuse_fraction * model.zenith_radiance).mean())


def _mirror_share_sd(picture: Picture, zenith: float) -> float:
    # Relative standard uncertainty of the mirrored sky [1].
    # Haze makes a sky brighter than a clear one, and uneven, mostly around the sun; an overcast sky is even.
    direct = direct_share(picture)
    haze = (1.0 - direct) / float(diffuse_fraction(picture.model.channel_wavelength, zenith).mean()) - 1.0
    clear_part = direct * float(np.hypot(JUDGING.mirror_share_sd, haze))
    return clear_part + (1.0 - direct) * JUDGING.covered_share_sd


def judge_pixels(verdict: Verdict, measures: Measures, limits: Limits) -> None:
    """Add the measures and the score to a verdict; object to too few pixels, and to mixed colours."""
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
    verdict.score = score_of(measures)


def score_of(measures: Measures) -> float:
    """Return the score of a piece; the equation is in `propose_regions`."""
    homogeneity = 1.0 / (1.0 + (measures.angle / JUDGING.half_angle_deg) ** 2)
    penalty = (
        measures.adjacency / JUDGING.half_adjacency
        + measures.glint / JUDGING.half_glint
        + measures.spread / JUDGING.half_spread
    )
    return float(min(1.0, measures.pixels / JUDGING.enough_px) * homogeneity / (1.0 + penalty))


# --- brightness of a roof where it is level, with its uncertainty ------------------------------------------


@dataclass(frozen=True)
class LevelRules:
    """The axis of a roof, and the surface through its brightness.

    Lengths are relative to half the width of the roof, which is 0.5 to 0.7 m of all cars.
    """

    #: Range in which its edges are searched, in half widths from its windows.
    edge_span: tuple[float, float] = (0.7, 1.25)
    #: Minimum factor by which brightness falls within `edge_px` at an edge: windows reflect less than half as
    #: much as paint that is not dark [1].
    min_edge_ratio: float = 1.2
    edge_px: float = 1.5  #: Distance over which an edge falls: a sampled edge is one to two wide [pixel].
    steps_per_px: int = 4  #: Samples a pixel of a profile across a roof.
    #: Maximum distance between the middle of two edges and the middle of the windows: beyond, one of them is
    #: not the edge of the roof.
    max_shift: float = 0.3
    #: Standard deviation of the axis between two edges: mixed pixels shift either by half a pixel [pixel].
    edged_sd_px: float = 0.4
    #: Half of the fitted range, along and across: within it the lean is proportional to the distance, and a
    #: lobe adds a term of second order.
    fitted: tuple[float, float] = (0.9, 0.5)
    rounds: int = 30  #: Maximum number of iterations that exclude glint from the fit.
    #: Maximum residual above the surface in the fit, in standard deviations: glint only adds.
    max_above_sd: float = 2.5
    max_below_sd: float = 3.0  #: The same below it, in standard deviations.
    min_sd: float = 0.003  #: Minimum of this standard deviation, relative to the brightness [1].
    min_fitted_px: int = 25  #: Minimum number of pixels of the fit.
    #: Number of pixels whose errors by dust, orange peel and point spread are correlated: 3 x 3.
    clump_px: float = 9.0
    #: Lean across the car half a width from the middle of a roof [degree]: roofs have a radius of 2.5 to 3 m.
    crown_deg: float = 12.0
    #: Drop of a roof from its middle to its end over its half length: 3 cm in 0.7 m, 7 cm in 1.4 m [1].
    drop: float = 0.05
    max_crown_deg: float = 5.0  #: Maximum lean along the car, half a width from the middle [degree].


LEVELS = LevelRules()


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


class Levelled(NamedTuple):
    """Brightness of a roof where it is level."""

    brightness: float  #: Brightness there, in the unit of the brightness passed.
    sd: float  #: Its relative standard uncertainty from the fit and the position [1].
    along_change: float  #: Its relative change with lean along the car, from the crown of the roof [1/rad].
    across_change: float  #: The same across it [1/rad].


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


def level_light(brightness: Floats, lit: Bools, place: Place, axis: Floats) -> Levelled | None:
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
    plane = _Surface.through(np.stack([np.ones(u.size), u, v], axis=1), logs)
    quadric = _Surface.through(np.stack([np.ones(u.size), u, v, u * u, u * v, v * v], axis=1), logs)
    independent_px = u.size / LEVELS.clump_px
    gain = independent_px * np.log(plane.rms**2 / quadric.rms**2)
    best = quadric if gain > 3.0 * np.log(max(independent_px, 2.0)) else plane
    slope = best.terms[1:3]
    place_sd = np.hypot(*(slope * np.array([place.along_sd, place.across_sd]) / place.half_width))
    change = np.abs(slope) / place.crown
    sd = float(np.hypot(best.sd, place_sd))
    return Levelled(float(np.exp(best.terms[0])), sd, float(change[0]), float(change[1]))


class _Surface(NamedTuple):
    terms: Floats  #: (term,): Value at the origin, slopes and curvatures.
    rms: float  #: Root mean square of the residuals of the fit [1].
    sd: float  #: Standard error of the value at the origin [1].

    @classmethod
    def through(cls, design: Floats, logs: Floats) -> _Surface:
        # Fit of logarithms of brightness (pixel,) with a design matrix (pixel, term)
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
        return cls(terms, rms, rms * float(np.sqrt(LEVELS.clump_px * inverse[0, 0])))


# --- finish of a roof, solid or with flakes, from the change of its light over its crown -------------------


@dataclass(frozen=True)
class FinishRules:
    """Thresholds of a finish. A change is that of ln(brightness) with lean over the crown of a roof [1/rad].

    Under a sun at the zenith angle t a solid body changes by s = f_dir d ln(cos t (1 - F(t))) / dt (see
    `change_with_lean`). Simulated flakes (flop index 3 and more) change by 1 to 10 near the sun's mirror
    direction, and by about s far from it.
    """

    min_direct: float = 0.5  #: Minimum direct share of the light for a visible lobe [1].
    #: Maximum zenith angle of the sun: under a lower sun a roof shades itself [degree].
    max_zenith_deg: float = 62.0
    min_level: float = 0.06  #: Minimum mean reflectance of a roof: below, dust and sky dominate [1].
    #: Factor k of flakes across a roof: they change by more than k s + `offset`; the curvature of a roof is
    #: known to a third.
    metallic_across: float = 1.7
    #: The same along a roof, where the curvature of roofs varies by a factor of three; not used under a sun
    #: nearer to the zenith than `solid_zenith_deg`, where the gloss of a rough coat may lie on a part of it.
    metallic_along: float = 5.0
    offset: float = 0.5  #: Additional change by dust, glint and neighbours [1/rad].
    #: Maximum change of a solid roof in any direction, with the sun within `solid_zenith_deg`: flakes change
    #: by more than 2 there, and white pearl by 0.7 [1/rad].
    max_solid_change: float = 0.45
    #: Range of zenith angles for this rule [degree]: nearer the zenith a lobe may peak at the level position.
    solid_zenith_deg: tuple[float, float] = (20.0, 32.0)
    #: Grey share of the difference between the bright and the dark part of a coloured roof [1]: maximum for
    #: solid paint.
    max_flat_share: float = 0.13
    #: The same, minimum for flakes, which mirror all colours; between both the finish is unknown [1].
    metallic_flat_share: float = 0.33
    #: Maximum zenith angle of the sun for solid paint by its colour [degree]: under a lower sun most of the
    #: change with lean comes from the body even with flakes.
    max_coloured_zenith_deg: float = 45.0
    min_colour: float = 0.35  #: Minimum standard deviation over mean of a coloured spectrum [1].
    min_contrast: float = 0.2  #: Minimum contrast of the bright and the dark part [1].
    #: Maximum change across and along of solid paint by its colour, in s.
    max_coloured: tuple[float, float] = (1.3, 2.0)
    min_px: int = 60  #: Minimum number of pixels of a roof whose quarters are compared.


FINISHES = FinishRules()


class Difference(NamedTuple):
    """Difference of the bright and the dark part of a roof."""

    flat_share: float  #: Share of its grey part, which is equal in all channels under direct light [1].
    contrast: float  #: Length of the difference over the length of the mean spectrum [1].


def difference_of(piece: Piece, picture: Picture, relative: Floats) -> Difference | None:
    """Return the difference of the brightest and darkest quarters of a roof; None with too few pixels.

    A lean b changes the direct light of a solid body r by d = f_dir (r s b + g), with a grey part g: the sun
    mirrored by the coat. Flakes add their reflection to g. Takes ``relative`` (line, column): brightness
    relative to the level position; values over 1.6 or under 0.5 are glint or another part.
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
    coloured_mean, flat_mean = float(coloured * (spectrum * direct).mean()), float(flat * direct.mean())
    contrast = float(np.linalg.norm(difference)) / max(float(np.linalg.norm(spectrum)), 1e-9)
    return Difference(flat_mean / max(abs(coloured_mean + flat_mean), 1e-9), contrast)


def judge_finish(
    verdict: Verdict, measures: Measures, picture: Picture, level: Level, difference: Difference | None
) -> None:
    """Add the finish of a roof and its evidence to the verdict; without evidence it stays unknown."""
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
        verdict.reasons.append(f"metallic: {changes}, that of solid paint by {np.radians(solid):.1%}")
    elif low <= picture.zenith <= high and level.lean_change < FINISHES.max_solid_change:
        verdict.finish = "solid"
        verdict.reasons.append(f"solid: {changes}; flakes so near the sun's mirror image change more")
    elif difference is not None and measures.spectrum.std() > FINISHES.min_colour * measures.spectrum.mean():
        steady = across < FINISHES.max_coloured[0] * solid and along < FINISHES.max_coloured[1] * solid
        _judge_colours(verdict, difference, picture.zenith <= FINISHES.max_coloured_zenith_deg and steady)


def _judge_colours(verdict: Verdict, difference: Difference, steady: bool) -> None:
    # Add the finish of coloured paint, from the difference of its bright and its dark part, to the verdict.
    # `steady`: whether its change with lean is within that of solid paint.
    if difference.contrast < FINISHES.min_contrast:
        return
    share = difference.flat_share
    text = f"{abs(share):.0%} of the difference between its bright and its dark part is grey"
    if share > FINISHES.metallic_flat_share:
        verdict.finish = "metallic"
        verdict.reasons.append(f"metallic: {text}, and flakes mirror all colours")
    elif steady and abs(share) < FINISHES.max_flat_share:
        verdict.finish = "solid"
        verdict.reasons.append(f"solid: only {text}, and flakes would mirror all colours")


@dataclass(eq=False)
class Car:
    """Pieces of the picture that belong to one car."""

    pieces: list[Piece]
    #: Footprint around one of the pieces; None where its colour extends farther than a car.
    footprint: Footprint | None = None
    roof: Roof | None = None
    #: Reason why no roof was found.
    reason: str = "its colour extends farther than a car: it may not belong to one"
    is_car: bool = False  #: Whether windows show that the footprint is a car.


def _is_certain(footprint: Footprint, roof: Roof) -> bool:
    # Whether a footprint has the shape of one car, and its roof lies between windows or behind a windscreen
    return footprint.is_one_car and (roof.complete or roof.sided)


def find_cars(pieces: Iterable[Piece], scene: Scene) -> list[Car]:
    """Return the cars around pieces of paint, the most certain first.

    The largest pieces are examined first, those as dark as windows last. A piece with a certain roof is a
    car. A piece with less evidence is a car only outside the certain cars.
    """
    car_park = _CarPark(scene)

    def order(piece: Piece) -> tuple[bool, int, tuple[int, int], int]:
        level = float(np.median(scene.level[piece.window][piece.inside]))
        return level < SURFACES.dark, -int(piece.inside.sum()), piece.origin, piece.body

    # certain cars with paint of narrow brightness, then again without footprints larger than most cars
    narrow, wide = JOININGS[:4], JOININGS[4:]
    candidates = [_Candidate(piece) for piece in sorted(pieces, key=order)]
    uncertain = car_park.add_certain(candidates, narrow, np.inf)
    sizes = [car.size for car in car_park.certain]
    max_size = CARS.max_size * float(np.median(sizes)) if len(sizes) >= CARS.min_sizes else np.inf
    candidates = [_Candidate(piece) for piece in car_park.remove_larger(max_size)]
    uncertain += car_park.add_certain(candidates, narrow, max_size)
    # certain cars with paint of wide brightness, then the best uncertain ones beside them
    candidates = [candidate.unless_larger(max_size) for candidate in uncertain]
    uncertain = car_park.add_certain(candidates, wide, max_size)
    for candidate in sorted(uncertain, key=lambda candidate: candidate.rank, reverse=True):
        if not car_park.assign(candidate.piece):
            car_park.add(candidate)
    return car_park.cars


#: Rank of a roof between windows, or behind a windscreen, on a footprint of one car.
_CERTAIN = 5


class _Candidate(NamedTuple):
    # A piece with the best footprint and roof around it so far
    piece: Piece
    footprint: Footprint | None = None
    roof: Roof | NoRoof = NoRoof(Car.reason, False)

    @property
    def size(self) -> int:
        return 0 if self.footprint is None else int(self.footprint.area.sum())

    @property
    def rank(self) -> tuple[int, int]:
        if self.footprint is None:
            return 0, 0
        if isinstance(self.roof, NoRoof):
            return 1 + int(self.roof.is_car), self.size
        if not self.footprint.is_one_car:
            return 3, self.size
        return _CERTAIN - int(not _is_certain(self.footprint, self.roof)), self.size

    def unless_larger(self, max_size: float) -> _Candidate:
        if self.size <= max_size:
            return self
        reason = "it is larger than other cars: several of one colour may touch; draw a region by hand"
        return self._replace(roof=NoRoof(reason, False))


class _CarPark:
    # Cars of a scene, and maps of the car number of every pixel, -1 without a car
    def __init__(self, scene: Scene) -> None:
        self.cars: list[Car] = []
        self.certain: list[_Candidate] = []  #: Candidates of the certain cars, which come first in `cars`.
        self._scene = scene
        self._area = np.full(scene.level.shape, -1, np.int32)
        self._paint = self._area.copy()

    def add_certain(
        self, candidates: list[_Candidate], joinings: Sequence[Joining], max_size: float
    ) -> list[_Candidate]:
        # Add the certain cars; return the best candidates around the other pieces
        uncertain = []
        for candidate in candidates:
            if self.assign(candidate.piece):
                continue
            best = _best_candidate(candidate, self._scene, joinings, max_size)
            if best.rank[0] < _CERTAIN:
                uncertain.append(best)
            elif self.add(best):
                self.certain.append(best)
        return uncertain

    def remove_larger(self, max_size: float) -> list[Piece]:
        # Remove cars with more pixels, which are several cars side by side; return their pieces
        is_kept = [candidate.size <= max_size for candidate in self.certain]
        # new number of every car; the last entry keeps -1
        numbers = np.append(np.where(is_kept, np.cumsum(is_kept) - 1, -1), -1).astype(np.int32)
        self._area, self._paint = numbers[self._area], numbers[self._paint]
        removed = [car for car, keep in zip(self.cars, is_kept, strict=True) if not keep]
        self.cars = [car for car, keep in zip(self.cars, is_kept, strict=True) if keep]
        self.certain = [candidate for candidate, keep in zip(self.certain, is_kept, strict=True) if keep]
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

    def add(self, candidate: _Candidate) -> bool:
        # Add a piece to the car that its footprint overlaps, or as a new car; return whether the car is new
        footprint, roof = candidate.footprint, candidate.roof
        number = len(self.cars) if footprint is None else self._overlapped_car(footprint)
        if number < len(self.cars):
            self.cars[number].pieces.append(candidate.piece)
            return False
        if isinstance(roof, NoRoof):
            self.cars.append(Car([candidate.piece], footprint, None, roof.reason, roof.is_car))
        else:
            self.cars.append(Car([candidate.piece], footprint, roof, is_car=True))
        if footprint is not None and self.cars[-1].is_car:
            # other footprints, such as unusual ground, get no further pieces
            for car_numbers, mask in (
                (self._area, footprint.area),
                (self._paint, footprint.area & footprint.paint),
            ):
                view = car_numbers[footprint.window]
                view[mask & (view < 0)] = number
        return True

    def _overlapped_car(self, footprint: Footprint) -> int:
        # Number of the car that a footprint overlaps most; the number of a new car without enough overlap
        numbers = self._area[footprint.window][footprint.area]
        numbers = numbers[numbers >= 0]
        if not numbers.size:
            return len(self.cars)
        shared = np.bincount(numbers)
        number = int(shared.argmax())
        car_footprint = self.cars[number].footprint
        smaller = min(int(item.area.sum()) for item in (footprint, car_footprint) if item is not None)
        return number if shared[number] > CARS.min_overlap * smaller else len(self.cars)


def _best_candidate(
    best: _Candidate, scene: Scene, joinings: Sequence[Joining], max_size: float
) -> _Candidate:
    # Best car and roof around a piece; the first certain one ends the search
    piece = best.piece
    colour = np.median(scene.without_sky(piece.window)[piece.inside], axis=0)
    for footprint in footprints_of(piece.inside, piece.origin, colour, scene, joinings):
        roof = find_roof(footprint, scene.level[footprint.window])
        candidate = _Candidate(piece, footprint, roof).unless_larger(max_size)
        best = max(best, candidate, key=lambda car: car.rank[0])
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
        # an error of the level position affects the other parts, too
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
    # Verdict on a roof; None where all its pixels are near edges
    piece = _piece_of(footprint, roof, picture.model, limits.erode)
    if piece is None:
        return None
    y, x = piece.origin[0] - footprint.origin[0], piece.origin[1] - footprint.origin[1]
    lines, columns = piece.inside.shape
    brightness = footprint.brightness[y : y + lines, x : x + columns]
    lit = piece.inside & (picture.layers["blocked_direct"][piece.window] < limits.shadow)
    place = level_place(footprint, roof)
    centre = (place.line - y, place.column - x)
    prior = lean_to_sun(roof.axis, picture.shadow_side)
    lean = measured_lean(picture.heights, piece.window, piece.inside, centre, prior, picture.shadow_side)
    centre = (centre[0] + lean.shift[0], centre[1] + lean.shift[1])
    verdict = Verdict("roof", reasons=[roof.reason])
    if np.isfinite(lean.angle):
        text = f"by the height model it leans by {lean.angle:+.1f} degrees towards the sun"
        verdict.reasons.append(text)
        lines, columns = piece.inside.shape
        if not (-1.0 <= centre[0] <= lines and -1.0 <= centre[1] <= columns):
            verdict.objections.append(f"{text}, and has no level position; draw a region on a level part")
            return Judged(piece, measured(piece, picture, limits), verdict)
    place = place._replace(line=centre[0], column=centre[1])
    level = level_light(brightness, lit, place, roof.axis)
    if level is None:
        verdict.objections.append("too few lit pixels near the level position of the roof for its brightness")
        return Judged(piece, measured(piece, picture, limits), verdict)
    relative = brightness / level.brightness
    for factor in CARS.wider:
        roof_limits = replace(limits, glint=np.inf, adjacency=np.inf, brightness=factor * limits.brightness)
        measures = measured(piece, picture, roof_limits, relative)
        if measures.pixels >= limits.min_pixels:
            break
    # mean difference of the usable pixels from the level position
    offset = float(relative[measures.usable].mean()) - 1.0 if measures.pixels else 0.0
    judge_pixels(verdict, measures, limits)
    roof_level = Level(float(np.hypot(level.sd, offset)), level.along_change, level.across_change)
    judge_level(verdict, measures, picture, lean.sd, roof_level)
    judge_finish(verdict, measures, picture, roof_level, difference_of(piece, picture, relative))
    if verdict.finish == "metallic":
        verdict.kind = "metallic"
    _judge_windows(verdict, footprint, roof, picture)
    return Judged(piece, measures, verdict)


def _judge_windows(verdict: Verdict, footprint: Footprint, roof: Roof, picture: Picture) -> None:
    level = picture.channels[footprint.window].mean(axis=2)
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
            "its car has no certain roof: it may belong to another car, or be ground between cars; draw a "
            "region by hand"
        )
    verdict.reasons.append("part of a car with windows across it and along it")
    judge_pixels(verdict, measures, limits)
    assumed = Level(along_change=JUDGING.unseen_change * direct_share(picture), is_measured=False)
    judge_level(verdict, measures, picture, JUDGING.panel_deg, assumed)
    _compare_with_car(verdict, measures, car, picture)
    # a spectrum like the ground's, lit or in shade
    ground = np.nan_to_num(picture.model.reference[largest_body(picture.model)])
    length, ground_length = float(np.linalg.norm(measures.spectrum)), float(np.linalg.norm(ground))
    cosine = float(measures.spectrum @ ground) / max(length * ground_length, 1e-9)
    max_length = float(np.exp(FOOTPRINTS.max_ground_log_ratio)) * ground_length
    if measures.pixels and cosine > FOOTPRINTS.min_cosine and length < max_length:
        verdict.objections.append(
            "it has the colour of the ground, and is no brighter; draw a region by hand"
        )
    if _mean_level(measures) < SURFACES.dark:
        verdict.objections.append("it is as dark as a window, and not the roof")
    return Judged(piece, measures, verdict)


def _compare_with_car(verdict: Verdict, measures: Measures, car: Car, picture: Picture) -> None:
    footprint = car.footprint
    if footprint is None or not measures.pixels:
        return
    compared = footprint.paint & footprint.area if car.roof is None else car.roof.inside
    car_spectrum = np.nanmedian(picture.channels[footprint.window][compared], axis=0)
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
            "its colour differs from the car's paint: it may be a window, a bed or a load"
        )
    elif abs(ratio - 1.0) > allowed:
        verdict.objections.append(
            f"it is {ratio:.2f} times as bright as the car's other paint, while lean explains at most "
            f"{allowed:.0%}: it may be a shadow, a bed, or paint with flakes; draw a region on the roof"
        )


def _mean_level(measures: Measures) -> float:
    spectrum: Floats = measures.spectrum
    return float(spectrum.mean()) if measures.pixels else 0.0


def better_part(best: Judged) -> str:
    """Return the objection to all other parts of a car."""
    y, x = best.piece.centre
    return f"another part of the same car is better: the one at line {y:.0f}, column {x:.0f}"
