"""Thresholds of the proposals for paint, cars, roofs and proposed regions.

Each field states its meaning and unit. Numbers were chosen on simulated car parks unless the field states
otherwise.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class SurfaceRules:
    # Classes of segments by their spectra, and measures of a piece.
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
    # The footprint of a car around a piece of its paint.
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
    # The roof between windows.
    #
    # Distances and widths across the car are in half widths of the car, lengths along it in car lengths. A
    # track is a row of pixels across the car.
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
    # Verdicts: uncertainty of the level, darker windows, flakes, and the score.
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
    # Pieces of one car.
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


@dataclass(frozen=True)
class GapRules:
    # Thresholds of light between broken clouds.
    #: Wavelength from which sunlight and the light of the sky differ most [nm].
    infrared_nm: float = 780.0
    #: Maximum excess of the diffuse fraction over that of a clear sky in free sun: a cloud that blocks half
    #: of the sunlight raises it by at least 0.1 [1].
    max_above_clear: float = 0.08
    #: Maximum ratio of the smallest to the largest irradiance of the record: thinner clouds do not show in a
    #: shadow [1].
    max_dip: float = 0.65
    #: Irradiance relative to free sun, below which a cloud begins [1].
    min_of_free: float = 0.95
    #: Time of free sun required before and after a line [s]: a cloud's edge at 8 m/s moves 80 m.
    around_s: float = 10.0
    #: Maximum diffuse fraction in a shadow beside the car relative to the record [1]: 0.6 to 1 of the sky
    #: lights a shadow; under a cloud the ratio is 2 to 3.
    max_over_record: float = 1.5
    #: Minimum diffuse fraction assumed for the record: light from neighbours reaches every shadow [1].
    least_fraction: float = 0.06
    min_px: int = 40  #: Minimum number of pixels of the shadow, and of the sunlit ground beside it.
    sd: float = 0.025  #: Standard uncertainty of the level between clouds, relative [1].
    around_px: int = 60  #: Margin around a part of a car that may hold its shadow [pixel].


@dataclass(frozen=True)
class LeanRules:
    # Thresholds of leans of roofs, and of height models.
    #: Unknown lean across a car, where its symmetric roof would be level on level ground [degree]. Parking
    #: areas are drained over slopes of 1 to 1.5 % (0.6 to 0.9 degrees), of which one of two components is
    #: towards the sun.
    roll_deg: float = 0.5
    #: Unknown lean along the car, where a roof of 6 m radius may also be highest 7 cm from its middle
    #: [degree].
    rake_deg: float = 0.8
    #: Minimum height of a roof above its surroundings in a height model that shows cars and not bare ground;
    #: cars are at least 1.4 m high [m].
    min_above_m: float = 0.7
    around_px: int = 25  #: Margin around a roof that contains ground [pixel].
    #: Correlation length of height errors [m]: photogrammetry matches patches.
    patch_m: float = 0.15
    floor_deg: float = 0.3  #: Standard deviation of the tilt error of the height model itself [degree].
    min_px: int = 40  #: Minimum number of pixels with a height.
    min_side_px: int = 4  #: Minimum number of lines, and of columns, with such pixels.


@dataclass(frozen=True)
class LevelRules:
    # The axis of a roof, and the surface through its brightness.
    #
    # Lengths are relative to half the width of the roof, which is 0.5 to 0.7 m of all cars.
    #: Range in which its edges are searched, in half widths from its windows.
    edge_span: tuple[float, float] = (0.7, 1.25)
    #: Minimum factor by which brightness falls within `edge_px` at an edge: windows reflect less than half as
    #: much as paint that is not dark [1].
    min_edge_ratio: float = 1.2
    edge_px: float = 1.5  #: Distance over which an edge falls: a sampled edge is one to two wide [pixel].
    steps_per_px: int = 4  #: Samples a pixel of a profile across a roof.
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


@dataclass(frozen=True)
class FinishRules:
    # Thresholds of a finish. A change is that of ln(brightness) with lean over the crown of a roof [1/rad].
    #
    # Under a sun at the zenith angle t a solid body changes by s = f_dir d ln(cos t (1 - F(t))) / dt (see
    # `change_with_lean`). Simulated flakes (flop index 3 and more) change by 1 to 10 near the sun's mirror
    # direction, and by about s far from it.
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


SURFACES = SurfaceRules()
FOOTPRINTS = FootprintRules()
ROOFS = RoofRules()
JUDGING = JudgingRules()
CARS = CarRules()
GAPS = GapRules()
LEANS = LeanRules()
LEVELS = LevelRules()
FINISHES = FinishRules()
