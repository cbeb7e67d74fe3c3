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

    #: Mean reflectance below which a surface may be a window or a shadow [1]; it is examined and listed last.
    dark: float = 0.05
    #: Minimum mean reflectance of an examined piece [1]: windows before a black interior mirror as much.
    min_level: float = 0.010
    #: Minimum cosine of the spectral angle between a segment and the ground, for a segment of ground.
    min_ground_cosine: float = float(np.cos(np.radians(3.0)))
    #: Maximum |ln(length of its spectrum / length of the ground's spectrum)| of such a segment.
    max_ground_log_ratio: float = 0.2
    min_change: float = 0.005  #: Difference in reflectance that is always allowed between pixels [1].
    square_px: int = 5  #: Side of the square that brightness and adjacency are averaged over [pixel].


@dataclass(frozen=True)
class FootprintRules:
    """The footprint of a car around a piece of its paint."""

    mirrored: float = 0.04  #: Reflectance of a clear coat of index 1.5, ((n - 1) / (n + 1))^2 [1].
    #: Minimum cosine of the spectral angle between a pixel of the car's paint and the piece.
    min_cosine: float = float(np.cos(np.radians(7.0)))
    #: Range of the brightness of a car's paint relative to the piece [1]: first for solid paint, on parts
    #: that lean by some ten degrees; then for paint with flakes, in their lobe or beside it.
    brightness: tuple[tuple[float, float], tuple[float, float]] = ((0.4, 1.7), (0.2, 4.0))
    #: The same for dark paint: windows reflect at least half as much [1].
    dark_brightness: tuple[tuple[float, float], tuple[float, float]] = ((0.7, 1.7), (0.7, 3.0))
    #: Maximum |ln(length of the spectrum / length of the ground's spectrum)| of a pixel of ground.
    max_ground_log_ratio: float = 0.4
    max_gap_px: int = 2  #: Maximum gap over which paint is joined [pixel].
    #: Half width of bridges that may join two cars, such as mirrors and bay lines [pixel].
    bridge_px: int = 2
    thin: float = 0.25  #: Half width of removed thin parts, relative to the part around the piece [1].
    min_half_width_px: float = 2.5  #: Minimum half width of the remaining parts [pixel].
    slenderness: tuple[float, float] = (1.7, 3.3)  #: Range of a car's length over its width [1].
    max_width: float = 2.0  #: Maximum width of a car relative to its widest part [1].
    max_gap: float = 4.5  #: Maximum gap between parts, relative to half the width of the widest part [1].
    max_ground_share: float = 0.1  #: Maximum share of ground in a car [1].
    margin: float = 2.5  #: Margin around the piece at first, relative to the size of the piece [1].
    max_margin_px: int = 300  #: Maximum of the margin at first [pixel].
    growth: float = 1.5  #: Factor by which the margin grows where the car reaches its edge [1].
    rounds: int = 6  #: Maximum number of margins.
    turn_deg: float = 2.0  #: Step of the directions of fitted rectangles [degree].


@dataclass(frozen=True)
class RoofRules:
    """The roof between windows.

    Distances and widths across the car are in half widths of the car, lengths along it in car lengths. A
    track is a row of pixels across the car.
    """

    middle: float = 0.4  #: Distance from the axis within which dark pixels show a window across the car.
    side: float = 0.3  #: Distance from the axis from which on dark pixels show side windows.
    max_window_level: float = 0.07  #: Maximum mean reflectance of a window [1].
    max_window_of_paint: float = 0.5  #: Maximum of the same relative to bright paint [1].
    min_crossed: float = 0.4  #: Minimum dark share of a track where a window crosses the car [1].
    min_window_px: int = 2  #: Minimum number of tracks of a window [pixel].
    #: Minimum length of the roof of a complete car: shorter sections lie between windows of several cars.
    min_roof: float = 0.12
    #: The same without bonnet and boot beyond both windows: a bonnet between a windscreen and the car's own
    #: shadow is shorter.
    short_roof: float = 0.2
    min_roof_px: int = 5  #: Minimum number of tracks of a roof [pixel].
    max_strip: float = 0.05  #: Maximum length of a strip of paint that is counted with the windows around it.
    min_bonnet: float = 0.1  #: Minimum length of a bonnet or a boot.
    #: Worth of a roof with bonnet and boot, or bed, beyond both windows: more than any length and share of
    #: side windows add, as a bed has walls along it, too.
    between_worth: float = 2.0
    max_bonnet: float = 0.38  #: Maximum length of a bonnet: a longer section is a roof.
    max_windscreen: float = 0.2  #: Maximum length of a windscreen: a longer window may contain a sunroof.
    min_sunroof: float = 0.24  #: Minimum length of a windscreen with a sunroof.
    min_tail: float = 0.1  #: Minimum length beyond such a window: behind a bed there is less.
    unsure: float = 0.015  #: Maximum distance of the level position from the middle of the roof.
    unsure_beside: float = 0.03  #: Maximum of the same beside a sunroof.
    #: Minimum length of the roof of a car at the picture's edge, relative to its width: less may be half a
    #: roof [1].
    min_roof_of_cut: float = 0.5
    sided: float = 0.3  #: Minimum share of side windows along a roof between two windows [1].
    long_sided: float = 0.5  #: The same for a long section that ends at one window [1].
    surely_sided: float = 0.6  #: The same for any section that ends at one window [1].
    #: Range of positions along the car of the middle of a roof between two windows.
    central: tuple[float, float] = (0.33, 0.75)
    min_van_roof: float = 0.55  #: Minimum length of the roof of a van.
    max_van_roof: float = 0.78  #: Maximum of the same: a bonnet and a windscreen lie before it.
    van_sided: float = 0.15  #: Minimum share of side windows along the roof of a van [1].
    min_slenderness: float = 1.2  #: Minimum length over width of a car whose windows prove its roof [1].
    used_width: float = 0.75  #: Part of a roof's width that is used [1].
    roof_width: float = 0.6  #: Width of a roof relative to its car's, where no window shows it [1].
    min_seen: float = 0.2  #: Minimum share of a roof's tracks that show its side window [1].
    #: Distance from the axis up to which the side of a roof is searched: the footprint may be too narrow.
    beyond: float = 1.3
    step_px: float = 0.25  #: Step of this search [pixel].
    #: Minimum fall of ln(reflectance) at the side of a roof within a pixel: shading at a rail makes 0.4 [1].
    min_step: float = 0.7
    window_width: float = 0.08  #: Minimum width of the dark strip beyond the side; also at least a pixel.
    black: float = 0.004  #: Reflectances below are set to this value before logarithms [1].
    #: Maximum error of the middle between the sides: found by the fall of brightness [pixel], by the edges of
    #: windows [pixel], and with a side missing (in half widths of the car).
    unsure_side_px: float = 0.5
    unsure_window_px: float = 1.0
    unsure_width: float = 0.15


@dataclass(frozen=True)
class JudgingRules:
    """Verdicts: uncertainty of the level, darker windows, flakes, and the score."""

    #: Maximum relative standard uncertainty of the level; a signature may be wrong by 6 % [1].
    max_level_sd: float = 0.042
    #: The same for flakes near their lobe: the level holds for one geometry only, where a degree of aspecular
    #: angle changes it by 5 %; the shape of the spectrum is right at any level [1].
    max_lobe_sd: float = 0.055
    max_dark_sd: float = 0.0026  #: The same in reflectance, for dark paint, where that allows more [1].
    least_sd: float = 0.008  #: Relative uncertainty of a level roof: noise, dust, light of neighbours [1].
    #: Uncertainty of light added to any paint, such as by neighbours, in reflectance [1].
    mirror_sd: float = 0.0012
    #: Relative uncertainty of the mirrored clear sky; the light added by haze has an uncertainty of 1 [1].
    mirror_share_sd: float = 0.25
    covered_share_sd: float = 0.03  #: The same for an overcast sky (CIE type 1) at its zenith [1].
    panel_deg: float = 7.0  #: Unknown lean of a body part other than a roof [degree].
    #: Relative change of brightness with lean, in direct light, assumed for a part without a visible crown
    #: [1/rad]: that of flakes 15 to 20 degrees from their mirror direction, where most of these parts are.
    unseen_change: float = 3.0
    #: Change with lean relative to a solid body, in direct light, above which a reason names flakes [1].
    max_solid_gain: float = 3.0
    min_direct: float = 0.5  #: Minimum direct share of the light for that reason [1].
    #: Minimum difference between paint and windows, relative to the paint, that distinguishes them [1].
    min_window_contrast: float = 0.25
    min_window_step: float = 0.0025  #: The same in reflectance [1].
    #: Range of the brightness of a dark roof relative to the other paint of the car: a bed lies outside.
    dark_roof: tuple[float, float] = (0.7, 1.4)
    enough_px: int = 200  #: Number of pixels above which more do not raise the score.
    half_angle_deg: float = 2.0  #: Spectral angle that halves a score [degree].
    half_adjacency: float = 0.01  #: Adjacency that halves a score [1].
    half_glint: float = 0.02  #: Glint that halves a score [1].
    half_spread: float = 0.03  #: Spread of brightness that halves a score [1].


@dataclass(frozen=True)
class CarRules:
    """Pieces of one car."""

    #: Minimum share of a piece on the paint of a car that assigns the piece to this car [1].
    min_piece_share: float = 0.5
    min_window_share: float = 0.8  #: The same on its complete area, for a piece of another colour [1].
    max_size: float = 1.8  #: Maximum pixels of a car relative to the median over the cars of a line [1].
    min_sizes: int = 3  #: Minimum number of cars for this median.
    min_overlap: float = 0.3  #: Minimum shared part of the smaller of two footprints of one car [1].
    #: Maximum of |brightness of a part / brightness of the car's other paint - 1|: this step, or the effect
    #: of a lean of `max_lean` under the sun where that is more [1].
    max_step: float = 0.15
    max_lean: float = float(np.radians(10.0))  #: Lean of a part against the car's other paint [radian].
    #: Factors of the brightness limit, tried in order until enough pixels of a roof are within it [1].
    wider: tuple[float, ...] = (1.0, 2.0, 3.0, 4.0)


SURFACES = SurfaceRules()
FOOTPRINTS = FootprintRules()
ROOFS = RoofRules()
JUDGING = JudgingRules()
CARS = CarRules()
