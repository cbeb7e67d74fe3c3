"""Whether a roof is painted in a solid colour or with flakes, by how its light changes over its crown."""

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
    """When a finish is stated. Changes are those with lean, 1/rad, as the crown of a roof shows them.

    A solid body changes by f_dir d ln(cos t (1 - F(t))) / dt =: s under a sun at t; flakes of the fleet's
    kinds (flop index 3 and more) change by 1 to 10 near the sun's mirror direction, and by some s far off it.
    """

    min_direct: float = 0.5  #: Direct share of the light from which on its lobe shows [1].
    max_zenith_deg: float = 62.0  #: Of the sun; below, the shade of a roof on itself changes its light, too.
    min_level: float = 0.06  #: Mean reflectance of a roof whose brightness is not that of dust and sky [1].
    #: Flakes are certain beyond this many s and `offset`, across a roof: its crown is known to a third.
    metallic_across: float = 1.7
    #: The same along it, where roofs of one length are bent unlike by a factor of three, and under a sun from
    #: `solid_zenith_deg` on, where no gloss of a rough coat lies on part of it.
    metallic_along: float = 5.0
    offset: float = 0.5  #: What dust, glint and neighbours change in a radian, beside that [1].
    #: A roof that changes by less in every direction, with the sun between both angles, is solid: flakes
    #: change by more than 2 there, and white pearl by 0.7.
    max_solid_change: float = 0.45
    solid_zenith_deg: tuple[float, float] = (20.0, 32.0)  #: Those angles; nearer, a lobe's peak may be level.
    #: What is coloured shows its finish where bright and dark part differ: flat part of the difference of a
    #: solid paint, at most, and of flakes, which mirror all colours, at least; in between it is either.
    max_flat_share: float = 0.13
    metallic_flat_share: float = 0.33
    #: Sun's zenith angle up to which that says solid [degree]: beyond, most of the light that changes with
    #: lean is the body's, whatever flakes there are.
    max_coloured_zenith_deg: float = 45.0
    min_colour: float = 0.35  #: Standard deviation of a spectrum over its mean from which it is coloured [1].
    min_contrast: float = 0.2  #: Of the bright and the dark part: less does not show the difference [1].
    #: Change across and along beyond which colour alone does not say solid, in s.
    max_coloured: tuple[float, float] = (1.3, 2.0)
    min_px: int = 60  #: Pixels of a roof of which quarters are compared.


FINISHES = FinishRules()


class Difference(NamedTuple):
    """How the bright part of a panel differs from its dark one."""

    flat_share: float  #: Flat part of the difference over the mean of what has the panel's own colour [1].
    contrast: float  #: Length of the difference over that of the panel's spectrum [1].


def difference_of(piece: Piece, picture: Picture, relative: Floats) -> Difference | None:
    """Return how the brightest quarter of a roof differs from its darkest; None where too little is seen.

    Of a solid body r under a lean b the direct light changes, d = f_dir (r s b + g), g being flat: the sun in
    the coat. Flakes add to g what they mirror. Takes ``relative`` (line, column): brightness over that of the
    level part; what is over 1.6 or under 0.5 of it is glint or another part.
    """
    diffuse = picture.model.diffuse_fraction
    chosen = piece.inside & (np.abs(relative - 1.05) < 0.55)
    if chosen.sum() < FINISHES.min_px:
        return None
    sky = FOOTPRINTS.mirrored * diffuse * picture.model.zenith_radiance
    seen = picture.channels[piece.window][chosen].astype(np.float64) - sky
    low, high = np.quantile(relative[chosen], [0.25, 0.75])
    difference = seen[relative[chosen] >= high].mean(axis=0) - seen[relative[chosen] <= low].mean(axis=0)
    own, direct = seen.mean(axis=0), 1.0 - diffuse
    coloured, flat = np.linalg.lstsq(np.stack([own * direct, direct], axis=1), difference, rcond=None)[0]
    parts = float(coloured * (own * direct).mean()), float(flat * direct.mean())
    contrast = float(np.linalg.norm(difference)) / max(float(np.linalg.norm(own)), 1e-9)
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
        near = picture.zenith <= FINISHES.max_coloured_zenith_deg
        _judge_colours(verdict, difference, near and steady)


def _judge_colours(verdict: Verdict, difference: Difference, steady: bool) -> None:
    """State the finish of coloured paint, by how its bright and its dark part differ.

    Takes ``steady``: whether it changes with lean no more than a solid paint does, where flakes would.
    """
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
