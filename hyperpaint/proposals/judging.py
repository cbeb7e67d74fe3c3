"""What a piece of the scene is, whether its signature would be right, and how good a region it makes."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from hyperpaint.scene_model import SceneModel

from .candidates import Limits, Measures, Piece
from .surroundings import DARK, ENDED, Flanks, Surfaces, flanks_of, is_between, ring_around

__all__ = ["Verdict", "judge", "judge_lean"]

Float = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

_LEANS = {"roof": 1.5, "panel": 12.0, "dark paint": 12.0}
"""Degrees by which the middle of a roof, or any panel, may lean."""
_TOLERANCE, _RELATIVE = 0.03, 0.06
_ENOUGH = 200
"""Pixels from which on more do not make a region better."""
_RING = 8
_BRIGHT_RING, _STANDING_RING = 0.35, 0.05
_BRIGHTER = 1.1
_MIRRORS = 1.1
_HALF_ANGLE, _HALF_ADJACENCY, _HALF_GLINT, _HALF_SPREAD = 2.0, 0.01, 0.02, 0.03


@dataclass
class Verdict:
    """What is thought of a piece.

    Attributes
    ----------
    kind
        "roof", "panel", "dark paint"; empty where nothing says that it is a car's.
    score
        0 to 1, from what is measured.
    reasons, objections
        What speaks for it, and what against; without objections it is proposed.
    flanks
        What lies around it, of what is not dark.
    scenery
        Whether it looks like leaves, a shadow or a window: refused, and told after all others.
    """

    kind: str = ""
    score: float = 0.0
    reasons: list[str] = field(default_factory=list)
    objections: list[str] = field(default_factory=list)
    flanks: Flanks | None = None
    scenery: bool = False


def judge(piece: Piece, found: Measures, model: SceneModel, surfaces: Surfaces, limits: Limits) -> Verdict:
    """Return what is thought of a piece."""
    verdict = Verdict()
    if surfaces.level[piece.body] < DARK:
        _judge_dark(verdict, piece, model, surfaces)
    else:
        _judge_bright(verdict, piece, model, surfaces)
    if verdict.kind:
        _judge_pixels(verdict, found, limits)
    return verdict


def _judge_bright(verdict: Verdict, piece: Piece, model: SceneModel, surfaces: Surfaces) -> None:
    if surfaces.vegetation[piece.body]:
        verdict.scenery = True
        verdict.objections.append("its red edge is that of leaves")
        return
    lines, columns = np.nonzero(piece.inside)
    flanks = flanks_of(lines + piece.first[0], columns + piece.first[1], model.segment, surfaces.window)
    more, less = flanks.ends
    along = f"along {flanks.axis:.0f} degrees"
    verdict.flanks = flanks
    if is_between(flanks.ends):
        verdict.kind = "roof"
        share = f"over {more:.0%} and {less:.0%} of its width"
        verdict.reasons.append(f"a roof: windows end it on both sides, {along}, {share}")
    elif more >= ENDED:
        verdict.kind = "panel"
        verdict.reasons.append(f"part of a car: a window ends it over {more:.0%} of its width, {along}")
    else:
        verdict.objections.append("no window ends it on any side: nothing says that it belongs to a car")


def _judge_dark(verdict: Verdict, piece: Piece, model: SceneModel, surfaces: Surfaces) -> None:
    """Tell dark paint from windows, shadows and dark ground by what is around it."""
    body = piece.body
    (y, x), (lines, columns) = piece.first, piece.inside.shape
    pad = 3 + _RING + 1
    top, left = max(y - pad, 0), max(x - pad, 0)
    around = model.segment[top : y + lines + pad, left : x + columns + pad]
    mask = np.zeros(around.shape, bool)
    mask[y - top : y - top + lines, x - left : x - left + columns] = piece.inside
    beside = around[ring_around(mask, _RING)]
    beside = beside[beside >= 0]
    beside = beside[model.body[beside] != body]
    if not surfaces.dark[body] or not beside.size:
        verdict.scenery = True
        verdict.objections.append("as dark as a shadow, and mirrors no sky as windows and clear coats do")
        return
    level, own = surfaces.level[beside], surfaces.level[body]
    things = ~surfaces.ground[beside] & ~surfaces.shade[beside]
    brighter = float((things & (level > _BRIGHTER * own)).mean())
    standing = float((things & (level < own / _BRIGHTER)).mean())
    if brighter > _BRIGHT_RING:
        verdict.scenery = True
        verdict.objections.append(
            f"as dark as glass, and {brighter:.0%} of what is around it is not: a window"
        )
    elif surfaces.blueness[body] < _MIRRORS:
        verdict.objections.append("dark, and mirrors no sky as a clear coat does: ground, rubber or trim")
    elif standing < _STANDING_RING:
        verdict.objections.append("dark, and no window is beside it: nothing says that it belongs to a car")
    else:
        verdict.kind = "dark paint"
        verdict.reasons.append(
            f"dark paint: windows, darker still, are {standing:.0%} of what is around it, "
            f"and brighter things {brighter:.0%}"
        )


def judge_lean(verdict: Verdict, found: Measures, zenith: float | None) -> None:
    """Object where a lean that nothing shows could make the signature wrong."""
    if not found.pixels:
        return
    most = float(found.spectrum.max())
    allowed = max(_TOLERANCE, _RELATIVE * most)
    lean = _LEANS[verdict.kind]
    if zenith is None:
        if verdict.kind == "panel":
            verdict.objections.append("not known to be a roof, and the sun's place is not known: it may lean")
        return
    error = most * float(np.tan(np.radians(zenith)) * np.radians(lean))
    text = f"it may lean by {lean:g} degrees, which under this sun changes its reflectance by {error:.3f}"
    (verdict.objections if error > allowed else verdict.reasons).append(f"{text}, {allowed:.3f} is allowed")


def _judge_pixels(verdict: Verdict, found: Measures, limits: Limits) -> None:
    lost = ", ".join(f"{share:.0%} {reason}" for reason, share in found.lost.items() if share >= 0.01)
    told = f" ({lost} left out)" if lost else ""
    if found.pixels < limits.min_pixels:
        verdict.objections.append(f"{found.pixels} pixels are left, expected {limits.min_pixels}{told}")
        return
    verdict.reasons.append(f"{found.pixels} pixels{told}")
    if found.angle > limits.angle:
        verdict.objections.append(f"not homogeneous: spectra differ by {found.angle:.1f} degrees")
    verdict.reasons.append(
        f"homogeneous to {found.angle:.1f} degrees, brightness to {found.spread:.1%}; "
        f"glint {found.glint:.3f}, light of neighbours {found.adjacency:.3f}"
    )
    verdict.score = score_of(found)


def score_of(found: Measures) -> float:
    """Return area x homogeneity / (1 + adjacency + glint + tilt), each over what halves the score."""
    area = min(1.0, found.pixels / _ENOUGH)
    homogeneity = 1.0 / (1.0 + (found.angle / _HALF_ANGLE) ** 2)
    against = found.adjacency / _HALF_ADJACENCY + found.glint / _HALF_GLINT + found.spread / _HALF_SPREAD
    return float(area * homogeneity / (1.0 + against))
