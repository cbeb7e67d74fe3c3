"""What a piece of the scene is, whether its signature would be right, and how good a region it makes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from hyperpaint.surroundings import SceneModel

from .candidates import Limits, Measures, Picture, Piece, Surfaces, ring_around
from .proposal_rules import JUDGING, SURFACES

__all__ = ["Judged", "Verdict", "judge_change", "judge_dark", "judge_lean", "judge_pixels"]


_LEANS = {"roof": 1.5, "panel": 14.0, "dark paint": 12.0}
"""Degrees by which the middle of a roof, or any panel, may lean."""


@dataclass
class Verdict:
    """What is thought of a piece."""

    kind: str = ""  #: "roof", "panel", "dark paint"; empty where nothing says that it is a car's.
    score: float = 0.0  #: 0 to 1, from what is measured.
    #: What speaks for it, and what against; without objections it is proposed.
    reasons: list[str] = field(default_factory=list)
    objections: list[str] = field(default_factory=list)
    #: Whether it looks like leaves, a shadow or a window: refused, and listed after all others.
    scenery: bool = False


class Judged(NamedTuple):
    """A piece, what is measured of it, and what is thought of it."""

    piece: Piece
    measures: Measures
    verdict: Verdict


def judge_dark(
    piece: Piece, measures: Measures, picture: Picture, surfaces: Surfaces, limits: Limits
) -> Verdict:
    """Return what is thought of a piece that is as dark as glass, or like leaves."""
    verdict = Verdict()
    if surfaces.vegetation[piece.body] and surfaces.level[piece.body] >= SURFACES.dark:
        verdict.scenery = True
        verdict.objections.append("its red edge is that of leaves")
        return verdict
    _judge_dark(verdict, piece, picture.model, surfaces)
    if verdict.kind:
        judge_pixels(verdict, measures, limits)
        judge_lean(verdict, measures, picture.zenith, "dark paint")
        if measures.angle > JUDGING.max_dark_angle_deg:
            text = f"spectra differ by {measures.angle:.1f} degrees: windows, as dark, may be among them"
            verdict.objections.append(text)
    return verdict


def _judge_dark(verdict: Verdict, piece: Piece, model: SceneModel, surfaces: Surfaces) -> None:
    """Tell dark paint from windows, shadows and dark ground by what is around it."""
    body = piece.body
    (y, x), (lines, columns) = piece.first, piece.inside.shape
    pad = 3 + JUDGING.ring_px + 1
    top, left = max(y - pad, 0), max(x - pad, 0)
    around = model.segment[top : y + lines + pad, left : x + columns + pad]
    mask = np.zeros(around.shape, bool)
    mask[y - top : y - top + lines, x - left : x - left + columns] = piece.inside
    beside = around[ring_around(mask, JUDGING.ring_px)]
    beside = beside[beside >= 0]
    beside = beside[model.body[beside] != body]
    if not surfaces.dark[body] or not beside.size:
        verdict.scenery = True
        verdict.objections.append("as dark as a shadow, and mirrors no sky as windows and clear coats do")
        return
    level, own = surfaces.level[beside], surfaces.level[body]
    things = ~surfaces.ground[beside] & ~surfaces.shade[beside]
    brighter = float((things & (level > JUDGING.brighter * own)).mean())
    standing = float((things & (level < own / JUDGING.brighter)).mean())
    if brighter > JUDGING.max_brighter:
        verdict.scenery = True
        verdict.objections.append(
            f"as dark as glass, and {brighter:.0%} of what is around it is not: a window"
        )
    elif surfaces.blueness[body] < JUDGING.min_blueness:
        verdict.objections.append("dark, and mirrors no sky as a clear coat does: ground, rubber or trim")
    elif standing > JUDGING.darker[1]:
        verdict.scenery = True
        verdict.objections.append(
            f"dark, and {standing:.0%} of what is around it is darker: the edge of a shadow"
        )
    elif standing < JUDGING.darker[0]:
        verdict.objections.append("dark, and no window is beside it: nothing says that it belongs to a car")
    else:
        verdict.kind = "dark paint"
        verdict.reasons.append(
            f"dark paint: windows, darker still, are {standing:.0%} of what is around it, "
            f"and brighter things {brighter:.0%}"
        )


def judge_lean(
    verdict: Verdict, measures: Measures, zenith: float | None, part: str, unsure: float = 0.0
) -> None:
    """Object where a lean that nothing shows could make the signature wrong.

    Takes ``verdict``: gets the objection, or the reason; ``measures``: what is measured; ``zenith``: of the
    sun [degree]; None where it is not known; ``part``: what it is a part of; says how far it may lean;
    ``unsure``: what its brightness may be off beside, relative [1].
    """
    if not measures.pixels:
        return
    most = float(measures.spectrum.max())
    allowed = max(JUDGING.tolerance, JUDGING.relative_tolerance * most)
    lean = _LEANS[part]
    if zenith is None:
        if part == "panel":
            verdict.objections.append("not known to be a roof, and the sun's place is not known: it may lean")
        return
    error = most * float(np.hypot(np.tan(np.radians(zenith)) * np.radians(lean), unsure))
    text = f"it may lean by {lean:g} degrees, which under this sun changes its reflectance by {error:.3f}"
    (verdict.objections if error > allowed else verdict.reasons).append(f"{text}, {allowed:.3f} is allowed")


def judge_change(verdict: Verdict, change: float, zenith: float | None, part: float = 1.0) -> None:
    """Object where brightness changes more over a part of a car than its lean can change it.

    Metal flakes mirror the sun over a wide lobe: where it lies on a part of the roof, it lies on all of it.

    Takes ``verdict``: gets the objection; ``change``: half of what lies between the 10th and the 90th
    percentile of brightness, relative [1]; ``zenith``: of the sun [degree]; of 45 degrees where it is not
    known; ``part``: how much of what is allowed, where less than the whole is seen [1].
    """
    slope = float(np.tan(np.radians(45.0 if zenith is None else zenith)))
    allowed = part * (JUDGING.gloss_change + float(np.radians(JUDGING.crown_deg)) * slope)
    if change > allowed:
        verdict.objections.append(
            f"brightness changes by {change:.0%} from its middle, more than the {allowed:.0%} of a crowned "
            "part under gloss: metal flakes or wide glint may lie on all of it"
        )


def judge_pixels(verdict: Verdict, measures: Measures, limits: Limits) -> None:
    """Tell what is measured; object to too few pixels, and to what is not of one colour; give the score."""
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
    """Return area x homogeneity / (1 + adjacency + glint + tilt), each over what halves the score."""
    area = min(1.0, measures.pixels / JUDGING.enough_px)
    homogeneity = 1.0 / (1.0 + (measures.angle / JUDGING.half_angle_deg) ** 2)
    against = (
        measures.adjacency / JUDGING.half_adjacency
        + measures.glint / JUDGING.half_glint
        + measures.spread / JUDGING.half_spread
    )
    return float(area * homogeneity / (1.0 + against))
