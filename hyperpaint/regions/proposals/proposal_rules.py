"""Thresholds of the proposals for paint, cars, roofs and proposed regions.

Each field states its meaning and unit. Numbers were chosen on simulated car parks unless the field states
otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class SurfaceRules:
    """Classes of segments by their spectra, and measures of a piece."""

    #: Mean reflectance below which a surface may be a window or a shadow, and is listed last if refused [1].
    dark: float = 0.05
    #: Mean reflectance from which something is looked at [1]: windows, black inside, mirror as much.
    min_level: float = 0.010
    #: Cosine of the spectral angle of segments like the ground, at least: 3 degrees.
    min_ground_cosine: float = float(np.cos(np.radians(3.0)))
    #: Difference of the logarithm of its length from the ground's, at most.
    max_ground_log_ratio: float = 0.2
    min_change: float = 0.005  #: Reflectance by which pixels may differ in any case [1].
    square_px: int = 5  #: Side of the square that brightness and adjacency are averaged over [pixel].


@dataclass(frozen=True)
class FootprintRules:
    """The footprint of a car around a piece of its paint."""

    mirrored: float = 0.04  #: Reflectance of a clear coat of index 1.5, ((n - 1) / (n + 1))^2 [1].
    #: Cosine of the spectral angle to the piece, at least: 7 degrees.
    min_cosine: float = float(np.cos(np.radians(7.0)))
    #: Brightness of a car's paint relative to the piece, least and most [1]: first of a paint without
    #: flakes, whose parts lean by some ten degrees; then of one with flakes, beside their lobe or in it.
    brightness: tuple[tuple[float, float], tuple[float, float]] = ((0.4, 1.7), (0.2, 4.0))
    #: The same of paint that is dark itself, whose windows reflect half as much and more [1].
    dark_brightness: tuple[tuple[float, float], tuple[float, float]] = ((0.7, 1.7), (0.7, 3.0))
    #: Difference of the logarithm of reflectance up to which something may be ground.
    max_ground_log_ratio: float = 0.4
    max_gap_px: int = 2  #: Gap over which paint is joined [pixel].
    #: Half width of bridges that may join two cars, such as mirrors and bay lines [pixel].
    bridge_px: int = 2
    thin: float = 0.25  #: Half width of thin parts that are left out, relative to the examined part [1].
    min_half_width_px: float = 2.5  #: Half width of the remaining parts, at least [pixel].
    slenderness: tuple[float, float] = (1.7, 3.3)  #: Length of a car relative to its width [1].
    max_width: float = 2.0  #: Width of a car relative to its widest part, at most [1].
    max_apart: float = 4.5  #: Gaps between its parts relative to half of that, at most [1].
    max_ground_share: float = 0.1  #: Share of ground in it, at most [1].
    around: float = 2.5  #: Margin that is looked at first, relative to the size of the piece [1].
    max_around_px: int = 300  #: That margin, at most [pixel].
    growth: float = 1.5  #: Factor by which the margin grows where the car reaches its edge [1].
    rounds: int = 6  #: How often the margin grows, at most.
    turn_deg: float = 2.0  #: Steps in which rectangles are turned [degree].


@dataclass(frozen=True)
class RoofRules:
    """The roof between windows: across in half widths of the car, along in car lengths."""

    middle: float = 0.4  #: Half width within which windows cross the car.
    side: float = 0.3  #: Half width from which on windows run along it.
    max_window_level: float = 0.07  #: Mean reflectance of a window, at most [1].
    max_window_of_paint: float = 0.5  #: The same relative to the paint, where this is bright [1].
    min_crossed: float = 0.4  #: Dark share of a track across the car where a window crosses it, at least [1].
    min_window_px: int = 2  #: Tracks of a window, at least [pixel].
    #: Length of the roof of a whole car, at least: shorter sections lie between windows of several cars.
    min_roof: float = 0.12
    #: The same where no bonnet and boot lie beyond both windows: a bonnet between a windscreen and its own
    #: shadow is shorter.
    short_roof: float = 0.2
    min_roof_px: int = 5  #: Tracks of a roof, at least [pixel].
    max_strip: float = 0.05  #: Length of a strip of paint between windows that goes with them, at most.
    min_bonnet: float = 0.1  #: Length of a bonnet or a boot, at least.
    #: What counts more where bonnet and boot, or bed, lie beyond both windows than any length and share of
    #: side windows: of two parts with walls along them, the roof is that one.
    between_worth: float = 2.0
    max_bonnet: float = 0.38  #: Length of a bonnet, at most: a longer section is a roof.
    max_windscreen: float = 0.2  #: Length of a windscreen, at most: a longer window may contain a sunroof.
    min_sunroof: float = 0.24  #: Length of a windscreen with a sunroof, at least.
    min_tail: float = 0.1  #: Length beyond such a window, at least: less is left behind a bed.
    unsure: float = 0.015  #: Distance of the level place from the middle of the roof, at most.
    unsure_beside: float = 0.03  #: The same beside a sunroof.
    #: Length of the roof of a car at the picture's edge relative to its width: less may be half of one
    #: [1].
    min_roof_of_cut: float = 0.5
    sided: float = 0.3  #: Share with side windows of a roof that windows end on both sides, at least [1].
    long_sided: float = 0.5  #: The same of a long part that one window ends [1].
    surely_sided: float = 0.6  #: The same of any part that one window ends [1].
    #: Where the middle of a roof lies along the car that windows end on both sides.
    central: tuple[float, float] = (0.33, 0.75)
    min_van_roof: float = 0.55  #: Length of the roof of a van, at least.
    max_van_roof: float = 0.78  #: The same at most: before it are a bonnet and a windscreen.
    van_sided: float = 0.15  #: Share of it with side windows, at least [1].
    min_slenderness: float = 1.2  #: The same where windows show its roof for certain, at least [1].
    used_width: float = 0.75  #: Part of a roof's width that is used [1].
    roof_width: float = 0.6  #: Width of a roof relative to its car's, where no window shows it [1].
    min_seen: float = 0.2  #: Share of a roof's tracks in which its side window is seen, at least [1].
    beyond: float = 1.3  #: Half width up to which a roof's side is looked for: beyond a car seen too narrow.
    step_px: float = 0.25  #: Steps in which it is [pixel].
    #: Natural logarithm of how much darker it becomes there within a pixel: shading at a rail makes 0.4 [1].
    min_step: float = 0.7
    window_width: float = 0.08  #: Half widths over which it stays dark, at least; and a pixel.
    black: float = 0.004  #: Reflectance below which everything is as dark [1].
    unsure_side_px: float = 0.5  #: Distance of their middle from where it truly is, at most [pixel].
    unsure_window_px: float = 1.0  #: The same of windows' edges [pixel].
    unsure_width: float = 0.15  #: The same where a side is not seen, in half widths of the car.


@dataclass(frozen=True)
class JudgingRules:
    """Verdicts: uncertainty of the level, darker windows, flakes, and the score."""

    #: Standard uncertainty of the level, relative, at most: half of the 6 % that a signature may be off [1].
    max_level_sd: float = 0.042
    #: The same of flakes near their lobe: it is a level at one geometry, which a degree of aspecular angle
    #: changes by 5 %, and its shape is right whatever it is [1].
    max_lobe_sd: float = 0.055
    max_dark_sd: float = 0.0026  #: The same in reflectance, where that is more: of dark paint [1].
    least_sd: float = 0.008  #: Relative uncertainty of a level roof: noise, dust, light of neighbours [1].
    mirror_sd: float = (
        0.0012  #: Uncertainty of light added to any paint, such as by neighbours, in reflectance [1].
    )
    #: Relative uncertainty of the mirrored sky where it is clear; light added by haze is wholly uncertain
    #: [1].
    mirror_share_sd: float = 0.25
    covered_share_sd: float = 0.03  #: The same of a covered sky: CIE's (type 1) at its zenith [1].
    panel_deg: float = 7.0  #: Lean of a part that is no roof, which nothing shows [degree].
    #: Change of brightness with lean of a part whose crown is not seen, in direct light [1/rad]: that of
    #: flakes 15 to 20 degrees from their mirror direction, where most of these parts are seen.
    unseen_change: float = 3.0
    #: Change with lean relative to a solid body, from which a reason names flakes, in direct light [1].
    max_solid_gain: float = 3.0
    min_direct: float = 0.5  #: Direct share of such light, at least [1].
    #: Darkness of the windows relative to the paint from which on they are told from it [1].
    min_window_contrast: float = 0.25
    min_window_step: float = 0.0025  #: The same in reflectance [1].
    #: Brightness of a dark roof relative to the rest of the car, at least and at most: a bed has another.
    dark_roof: tuple[float, float] = (0.7, 1.4)
    enough_px: int = 200  #: Pixels from which on more do not make a region better.
    half_angle_deg: float = 2.0  #: Spectral angle that halves a score [degree].
    half_adjacency: float = 0.01  #: Adjacency that does [1].
    half_glint: float = 0.02  #: Glint that does [1].
    half_spread: float = 0.03  #: Spread of brightness that does [1].


@dataclass(frozen=True)
class CarRules:
    """Pieces of one car."""

    min_piece_share: float = 0.5  #: Share of a piece from which on it lies on a car seen before [1].
    max_size: float = 1.8  #: Pixels of a car relative to the median of all in a line, at most [1].
    min_sizes: int = 3  #: Cars that this median is of, at least.
    min_window_share: float = 0.8  #: The same of a piece that is not of its paint [1].
    min_overlap: float = 0.3  #: Share of the smaller footprint from which on two are of one car [1].
    #: Brightness of a part relative to other paint of its car, less 1, at most: 0.15, or the effect of a lean
    #: of 10 degrees under the sun, if that is more [1].
    max_step: float = 0.15
    max_lean: float = float(np.radians(10.0))  #: That lean [radian].
    #: Factors of the brightness limit, the next where too few pixels of a roof are within [1].
    wider: tuple[float, ...] = (1.0, 2.0, 3.0, 4.0)


SURFACES = SurfaceRules()
FOOTPRINTS = FootprintRules()
ROOFS = RoofRules()
JUDGING = JudgingRules()
CARS = CarRules()
