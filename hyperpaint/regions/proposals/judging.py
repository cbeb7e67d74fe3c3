"""Kind of a piece of the scene, uncertainty of its signature, and its quality as a region."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from hyperpaint.light.coat_transmission import interface_reflectance
from hyperpaint.light.sun import diffuse_fraction
from hyperpaint.surroundings.sun_and_sky import MAX_SUN_ZENITH_DEG

from .between_clouds import GAPS
from .candidates import Limits, Measures, Picture, Piece
from .proposal_rules import FOOTPRINTS, JUDGING


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
