"""Finish of a roof, solid or with flakes, from the change of its light over its crown."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hyperpaint.base.arrays import Floats

from .candidates import Measures, Picture, Piece
from .judging import Level, Verdict, change_with_lean, direct_share
from .proposal_rules import FOOTPRINTS


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
