"""Brightness of the roof of a car where it is level, with its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.ndimage import map_coordinates

from hyperpaint.base.arrays import Array, Bools, Floats

from .footprints import Footprint
from .proposal_rules import ROOFS
from .roofs import Roof


@dataclass(frozen=True)
class LevelRules:
    """The axis of a roof, and the surface through its brightness.

    Lengths are relative to half the width of the roof, which is 0.5 to 0.7 m of all cars.
    """

    #: Range in which its edges are searched, in half widths from its windows.
    edge_span: tuple[float, float] = (0.7, 1.25)
    #: Factor by which brightness falls at an edge within `edge_px`, at least: windows reflect less than half
    #: of what paint does, unless that is dark [1].
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
