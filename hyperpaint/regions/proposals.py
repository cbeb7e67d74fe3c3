"""Proposed regions of car paint, ranked, each with its reasons.

A line and its scene model come in; `Proposals`, regions with reasons and the refused pieces, go out. For the
accessor and workflows. First the thresholds, chosen on simulated car parks unless a field states otherwise;
then pieces (connected parts of one body, with their measures, light and lean), the cars around them with
their roofs, and the part that is proposed; `propose_regions` is last.
"""

import contextlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, reduce
from inspect import signature
from itertools import product
from types import SimpleNamespace
from typing import Any, NamedTuple

import dask
import numpy as np
import xarray as xr
from scipy.ndimage import (
    binary_closing,
    binary_opening,
    find_objects,
    label,
    map_coordinates,
    uniform_filter,
)
from scipy.spatial import ConvexHull, QhullError

from hyperpaint.base import (
    ALONG_TRACK,
    BAND,
    CROSS_TRACK,
    IRRADIANCE_TIME,
    Array,
    Bools,
    Floats,
    Floats32,
    Ints,
    PaintError,
    Problems,
    Progress,
    Quality,
    SchemaError,
    as_progress,
    documented,
    flag_names,
    grouped,
    is_number,
    schema,
    takes_quantities,
)
from hyperpaint.geometry import locate
from hyperpaint.geometry.georeference.locating import between_maps, crs_of
from hyperpaint.geometry.georeference.viewing import pixel_view
from hyperpaint.light.coat_transmission import interface_reflectance
from hyperpaint.light.daylight_colours import colour_name
from hyperpaint.light.sun import diffuse_fraction, solar_position
from hyperpaint.surroundings import SceneModel, survey
from hyperpaint.surroundings.corrections import (
    MAX_SUN_ZENITH_DEG,
    MODEL_U,
    RECORDED,
    SUN_FROM,
    LightSplit,
    mirrored_sky,
    shadow_side_of,
    split_of,
    sun_zenith_of,
)
from hyperpaint.surroundings.model import SHADED
from hyperpaint.surroundings.scratch import line_blocks, release, scratch_array, trim_memory
from hyperpaint.surroundings.segments import depth_of, padded
from hyperpaint.surroundings.surveying import (
    FLAG_LIMITS,
    flag_channels,
    is_vegetation,
    model_of,
    read_channels,
    within,
)

from .polygons import (
    GEOGRAPHIC_CRS,
    Region,
    Regions,
    ground_of,
    renumbered,
)

#: Classes of segments by their spectra, and measures of a piece.
SURFACES = SimpleNamespace(
    # Mean reflectance below which a surface may be a window or a shadow [1]; it is examined and listed last.
    dark=0.05,
    # Minimum mean reflectance of an examined piece [1]: windows before a black interior mirror as much.
    min_level=0.010,
    # Minimum cosine of the spectral angle between a segment and the ground, for a segment of ground.
    min_ground_cosine=float(np.cos(np.radians(3.0))),
    # Maximum |ln(length of its spectrum / length of the ground's spectrum)| of such a segment.
    max_ground_log_ratio=0.2,
    min_change=0.005,  # Difference in reflectance that is always allowed between pixels [1].
    square_px=5,  # Side of the square that brightness and adjacency are averaged over [pixel].
)


#: The footprint of a car around a piece of its paint.
FOOTPRINTS = SimpleNamespace(
    # Minimum cosine of the spectral angle between a pixel of the car's paint and the piece.
    min_cosine=float(np.cos(np.radians(7.0))),
    # Range of the brightness of a car's paint relative to the piece [1]: first for solid paint, on parts
    # that lean by some ten degrees; then for paint with flakes, in their lobe or beside it.
    brightness=((0.4, 1.7), (0.2, 4.0)),
    # The same for dark paint: windows reflect at least half as much [1].
    dark_brightness=((0.7, 1.7), (0.7, 3.0)),
    # Maximum |ln(length of the spectrum / length of the ground's spectrum)| of a pixel of ground.
    max_ground_log_ratio=0.4,
    max_gap_px=2,  # Maximum gap over which paint is joined [pixel].
    # Half width of bridges that may join two cars, such as mirrors and bay lines [pixel].
    bridge_px=2,
    thin=0.25,  # Half width of removed thin parts, relative to the part around the piece [1].
    min_half_width_px=2.5,  # Minimum half width of the remaining parts [pixel].
    slenderness=(1.7, 3.3),  # Range of a car's length over its width [1].
    max_width=2.0,  # Maximum width of a car relative to its widest part [1].
    max_gap=4.5,  # Maximum gap between parts, relative to half the width of the widest part [1].
    max_ground_share=0.1,  # Maximum share of ground in a car [1].
    margin=2.5,  # Margin around the piece at first, relative to the size of the piece [1].
    max_margin_px=300,  # Maximum of the margin at first [pixel].
    growth=1.5,  # Factor by which the margin grows where the car reaches its edge [1].
    rounds=6,  # Maximum number of margins.
    turn_deg=2.0,  # Step of the directions of fitted rectangles [degree].
)


#: The roof between windows.
#:
#: Distances and widths across the car are in half widths of the car, lengths along it in car lengths. A track
#: is a row of pixels across the car.
ROOFS = SimpleNamespace(
    middle=0.4,  # Distance from the axis within which dark pixels show a window across the car.
    side=0.3,  # Distance from the axis from which on dark pixels show side windows.
    max_window_level=0.07,  # Maximum mean reflectance of a window [1].
    max_window_of_paint=0.5,  # Maximum of the same relative to bright paint [1].
    min_crossed=0.4,  # Minimum dark share of a track where a window crosses the car [1].
    min_window_px=2,  # Minimum number of tracks of a window [pixel].
    # Minimum length of the roof of a complete car: shorter sections lie between windows of several cars.
    min_roof=0.12,
    # The same without bonnet and boot beyond both windows: a bonnet between a windscreen and the car's own
    # shadow is shorter.
    short_roof=0.2,
    min_roof_px=5,  # Minimum number of tracks of a roof [pixel].
    max_strip=0.05,  # Maximum length of a strip of paint that is counted with the windows around it.
    min_bonnet=0.1,  # Minimum length of a bonnet or a boot.
    # Worth of a roof with bonnet and boot, or bed, beyond both windows: more than any length and share of
    # side windows add, as a bed has walls along it, too.
    between_worth=2.0,
    max_bonnet=0.38,  # Maximum length of a bonnet: a longer section is a roof.
    max_windscreen=0.2,  # Maximum length of a windscreen: a longer window may contain a sunroof.
    min_sunroof=0.24,  # Minimum length of a windscreen with a sunroof.
    min_tail=0.1,  # Minimum length beyond such a window: behind a bed there is less.
    unsure=0.015,  # Maximum distance of the level position from the middle of the roof.
    unsure_beside=0.03,  # Maximum of the same beside a sunroof.
    # Minimum length of the roof of a car at the picture's edge, relative to its width: less may be half a
    # roof [1].
    min_roof_of_cut=0.5,
    sided=0.3,  # Minimum share of side windows along a roof between two windows [1].
    long_sided=0.5,  # The same for a long section that ends at one window [1].
    surely_sided=0.6,  # The same for any section that ends at one window [1].
    # Range of positions along the car of the middle of a roof between two windows.
    central=(0.33, 0.75),
    min_van_roof=0.55,  # Minimum length of the roof of a van.
    max_van_roof=0.78,  # Maximum of the same: a bonnet and a windscreen lie before it.
    van_sided=0.15,  # Minimum share of side windows along the roof of a van [1].
    min_slenderness=1.2,  # Minimum length over width of a car whose windows prove its roof [1].
    # Range of the length of side windows of a dark car, whose windows may mirror as much as its paint does.
    cabin=(0.3, 0.8),
    cabin_roof=0.36,  # Length of the part of its roof that is used, relative to these windows [1].
    unsure_cabin=0.08,  # Maximum distance of its level position from the middle of these windows.
    used_width=0.75,  # Part of a roof's width that is used [1].
    roof_width=0.6,  # Width of a roof relative to its car's, where no window shows it [1].
    min_seen=0.2,  # Minimum share of a roof's tracks that show its side window [1].
    # Distance from the axis up to which the side of a roof is searched: the footprint may be too narrow.
    beyond=1.3,
    step_px=0.25,  # Step of this search [pixel].
    # Minimum fall of ln(reflectance) at the side of a roof within a pixel: shading at a rail makes 0.4 [1].
    min_step=0.7,
    window_width=0.08,  # Minimum width of the dark strip beyond the side; also at least a pixel.
    black=0.004,  # Reflectances below are set to this value before logarithms [1].
    # Maximum error of the middle between the sides: found by the fall of brightness [pixel], by the edges of
    # windows [pixel], and with a side missing (in half widths of the car).
    unsure_side_px=0.5,
    unsure_window_px=1.0,
    unsure_width=0.15,
)


#: Verdicts: uncertainty of the level, darker windows, flakes, and the score.
JUDGING = SimpleNamespace(
    coverage=1.96,  # Standard uncertainties in half of a 95 % interval [1].
    # Part of the limit of the level's interval that holds near the lobe of flakes [1].
    lobe_part=0.75,
    # Reflectance below which the limit of the level's interval stays the same in reflectance [1].
    dark=0.03,
    least_sd=0.008,  # Relative uncertainty of a level roof: noise, dust, light of neighbours [1].
    # Uncertainty of light added to any paint, such as by neighbours, in reflectance [1].
    mirror_sd=0.0007,
    # Uncertainty of the light that glint adds without a visible change of brightness, relative to the glint
    # in the pixels [1].
    glint_share_sd=0.33,
    panel_deg=7.0,  # Unknown lean of a body part other than a roof [degree].
    part_deg=2.0,  # The same of a part of a roof, or of a roof that may be a bonnet [degree].
    # Relative change of brightness with lean, in direct light, assumed for a part without a visible crown
    # [1/rad]: that of flakes 15 to 20 degrees from their mirror direction, where most of these parts are.
    unseen_change=3.0,
    # Change with lean relative to a solid body, in direct light, above which a reason names flakes [1].
    max_solid_gain=3.0,
    min_direct=0.5,  # Minimum direct share of the light for that reason, and for shade to be told [1].
    # Cosine of the spectral angle to the light of the sky above which a piece may lie in shade.
    sky_cosine=float(np.cos(np.radians(5.0))),
    white_from_nm=430.0,  # Wavelength below which white pigments absorb [nm].
    # Minimum difference between paint and windows, relative to the paint, that distinguishes them [1].
    min_window_contrast=0.25,
    min_window_step=0.0025,  # The same in reflectance [1].
    # Range of the brightness of a dark roof relative to the other paint of the car: a bed lies outside.
    dark_roof=(0.7, 1.4),
    enough_px=200,  # Number of pixels above which more do not raise the score.
    half_angle_deg=2.0,  # Spectral angle that halves a score [degree].
    half_adjacency=0.01,  # Adjacency that halves a score [1].
    half_glint=0.02,  # Glint that halves a score [1].
    half_spread=0.03,  # Spread of brightness that halves a score [1].
)


#: Pieces of one car.
CARS = SimpleNamespace(
    # Minimum share of a piece on the paint of a car that assigns the piece to this car [1].
    min_piece_share=0.5,
    min_window_share=0.8,  # The same on its complete area, for a piece of another colour [1].
    max_size=1.8,  # Maximum pixels of a car relative to the median over the cars of a line [1].
    min_sizes=3,  # Minimum number of cars for this median.
    # Maximum pixels of a car relative to a piece of it, for pieces that are examined before that.
    max_first_size=16.0,
    min_overlap=0.3,  # Minimum shared part of the smaller of two footprints of one car [1].
    # Maximum of |brightness of a part / brightness of the car's other paint - 1|: this step, or the effect
    # of a lean of `max_lean` under the sun where that is more [1].
    max_step=0.15,
    max_lean=float(np.radians(10.0)),  # Lean of a part against the car's other paint [radian].
    # Factors of the brightness limit, tried in order until enough pixels of a roof are within it [1].
    wider=(1.0, 2.0, 3.0, 4.0),
)


#: Thresholds of light between broken clouds.
GAPS = SimpleNamespace(
    # Wavelength from which sunlight and the light of the sky differ most [nm].
    infrared_nm=780.0,
    # Maximum excess of the diffuse fraction over that of a clear sky in free sun: a cloud that blocks half
    # of the sunlight raises it by at least 0.1 [1].
    max_above_clear=0.08,
    # Maximum ratio of the smallest to the largest irradiance of the record: thinner clouds do not show in a
    # shadow [1].
    max_dip=0.65,
    # Irradiance relative to free sun, below which a cloud begins [1].
    min_of_free=0.95,
    # Time of free sun required before and after a line [s]: a cloud's edge at 8 m/s moves 80 m.
    around_s=10.0,
    # Maximum diffuse fraction in a shadow beside the car relative to the record [1]: 0.6 to 1 of the sky
    # lights a shadow; under a cloud the ratio is 2 to 3.
    max_over_record=1.5,
    # Minimum diffuse fraction assumed for the record: light from neighbours reaches every shadow [1].
    least_fraction=0.06,
    min_px=40,  # Minimum number of pixels of the shadow, and of the sunlit ground beside it.
    sd=0.025,  # Standard uncertainty of the level between clouds, relative [1].
    around_px=60,  # Margin around a part of a car that may hold its shadow [pixel].
)


#: Thresholds of leans of roofs, and of height models.
LEANS = SimpleNamespace(
    # Unknown lean across a car, where its symmetric roof would be level on level ground [degree]. Parking
    # areas are drained over slopes of 1 to 1.5 % (0.6 to 0.9 degrees), of which one of two components is
    # towards the sun.
    roll_deg=0.5,
    # Unknown lean along the car, where a roof of 6 m radius may also be highest 7 cm from its middle
    # [degree].
    rake_deg=0.8,
    # Minimum height of a roof above its surroundings in a height model that shows cars and not bare ground;
    # cars are at least 1.4 m high [m].
    min_above_m=0.7,
    around_px=25,  # Margin around a roof that contains ground [pixel].
    # Correlation length of height errors [m]: photogrammetry matches patches.
    patch_m=0.15,
    floor_deg=0.3,  # Standard deviation of the tilt error of the height model itself [degree].
    min_px=40,  # Minimum number of pixels with a height.
    min_side_px=4,  # Minimum number of lines, and of columns, with such pixels.
)


#: The axis of a roof, and the surface through its brightness.
#:
#: Lengths are relative to half the width of the roof, which is 0.5 to 0.7 m of all cars.
LEVELS = SimpleNamespace(
    # Range in which its edges are searched, in half widths from its windows.
    edge_span=(0.7, 1.25),
    # Minimum factor by which brightness falls within `edge_px` at an edge: windows reflect less than half as
    # much as paint that is not dark [1].
    min_edge_ratio=1.2,
    edge_px=1.5,  # Distance over which an edge falls: a sampled edge is one to two wide [pixel].
    steps_per_px=4,  # Samples a pixel of a profile across a roof.
    # Standard deviation of the axis between two edges: mixed pixels shift either by half a pixel [pixel].
    edged_sd_px=0.4,
    # Half of the fitted range, along and across: within it the lean is proportional to the distance, and a
    # lobe adds a term of second order.
    fitted=(0.9, 0.5),
    rounds=30,  # Maximum number of iterations that exclude glint from the fit.
    # Maximum residual above the surface in the fit, in standard deviations: glint only adds.
    max_above_sd=2.5,
    max_below_sd=3.0,  # The same below it, in standard deviations.
    min_sd=0.003,  # Minimum of this standard deviation, relative to the brightness [1].
    min_fitted_px=25,  # Minimum number of pixels of the fit.
    # Number of pixels whose errors by dust, orange peel and point spread are correlated: 3 x 3.
    clump_px=9.0,
    # Lean across the car half a width from the middle of a roof [degree]: roofs have a radius of 2.5 to 3 m.
    crown_deg=12.0,
    # Drop of a roof from its middle to its end over its half length: 3 cm in 0.7 m, 7 cm in 1.4 m [1].
    drop=0.05,
    max_crown_deg=5.0,  # Maximum lean along the car, half a width from the middle [degree].
)


#: Thresholds of a finish. A change is that of ln(brightness) with lean over the crown of a roof [1/rad].
#:
#: Under a sun at the zenith angle t a solid body changes by s = f_dir d ln(cos t (1 - F(t))) / dt (see
#: `change_with_lean`). Simulated flakes (flop index 3 and more) change by 1 to 10 near the sun's mirror
#: direction, and by about s far from it.
FINISHES = SimpleNamespace(
    min_direct=0.5,  # Minimum direct share of the light for a visible lobe [1].
    # Maximum zenith angle of the sun: under a lower sun a roof shades itself [degree].
    max_zenith_deg=62.0,
    min_level=0.06,  # Minimum mean reflectance of a roof: below, dust and sky dominate [1].
    # Factor k of flakes across a roof: they change by more than k s + `offset`; the curvature of a roof is
    # known to a third.
    metallic_across=1.7,
    # The same along a roof, where the curvature of roofs varies by a factor of three; not used under a sun
    # nearer to the zenith than `solid_zenith_deg`, where the gloss of a rough coat may lie on a part of it.
    metallic_along=5.0,
    offset=0.5,  # Additional change by dust, glint and neighbours [1/rad].
    # Maximum change of a solid roof in any direction, with the sun within `solid_zenith_deg`: flakes change
    # by more than 2 there, and white pearl by 0.7 [1/rad].
    max_solid_change=0.45,
    # Maximum mean reflectance for this rule: white pearl may change as little as white solid paint [1].
    max_solid_level=0.5,
    # Range of zenith angles for this rule [degree]: nearer the zenith a lobe may peak at the level position.
    solid_zenith_deg=(20.0, 32.0),
    # Grey share of the difference between the bright and the dark part of a coloured roof [1]: maximum for
    # solid paint.
    max_flat_share=0.13,
    # The same, minimum for flakes, which mirror all colours; between both the finish is unknown [1].
    metallic_flat_share=0.33,
    # Maximum zenith angle of the sun for solid paint by its colour [degree]: under a lower sun most of the
    # change with lean comes from the body even with flakes.
    max_coloured_zenith_deg=45.0,
    min_colour=0.35,  # Minimum standard deviation over mean of a coloured spectrum [1].
    min_contrast=0.2,  # Minimum contrast of the bright and the dark part [1].
    # Maximum change across and along of solid paint by its colour, in s.
    max_coloured=(1.3, 2.0),
    min_px=60,  # Minimum number of pixels of a roof whose quarters are compared.
)


#: Cause of uncertainty that signatures state themselves (``reflectance_u_coat``).
MIRRORED_SKY = "the sky mirrored by its coat"

#: Flags of pixels without a valid spectrum.
_INVALID = Quality.SATURATED | Quality.IRRADIANCE_GAP | Quality.NO_DATA | Quality.OFF_SWATH


#: Limits for the pixels of a region, by the names of the arguments of `propose_regions`.
Limits = Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Picture:
    """A flight line prepared for proposals."""

    model: SceneModel  #: Its scene model.
    channels: Array  #: (line, column, channel): Reflectance in the model's channels [1].
    #: ``glint_fraction``, ``blocked_direct``, ``adjacency`` and ``quality`` (line, column).
    layers: dict[str, Array]
    zenith: float | None  #: Zenith angle of the sun [degree]; None where unknown.
    shadow_side: Floats | None = None  #: (2,): Direction (line, column) of shadows; None where unknown.
    #: (column, 2): Angle of the camera from the vertical, and its azimuth relative to the sun [degree].
    view: Floats | None = None
    #: Height of the surface in every pixel (line, column) [m], and the distance between pixels [m].
    heights: tuple[Array, float] | None = None
    #: Free sun between clouds, see `sunny_lines`; None where clouds were not broken.
    sun: tuple[Bools, float] | None = None

    @cached_property
    def sky(self) -> tuple[Array, Floats]:
        # Sky mirrored by a level clear coat, in reflectance (column, channel), float32, and the standard
        # uncertainty of its mean over the channels (column,) [1]; of one column where the view is unknown.
        model, zenith = self.model, 45.0 if self.zenith is None else self.zenith
        nm, fraction = model.channel_wavelength, np.asarray(model.diffuse_fraction, np.float64)
        u = model.attrs.get("diffuse_fraction_u", MODEL_U * fraction * (1.0 - fraction))
        states = set(str(model.attrs.get("sky_states", "")).split())
        # the excess over a clear sky at 550 nm is of clouds, unless the record shows haze
        green = np.array([int(np.abs(nm - 550.0).argmin())])
        clear = float(diffuse_fraction(nm[green], zenith)[0])
        cloud = float(np.clip((fraction[green[0]] - clear) / (1.0 - clear), 0.0, 1.0))
        if states and states <= {"clear", "hazy"}:
            cloud = 0.0
        elif states == {"overcast"}:
            cloud = 1.0
        shares = xr.DataArray(np.array([fraction, u], np.float64), dims=("part", BAND))
        split = LightSplit(nm, shares[0], shares[1], cloud, "of the scene model", RECORDED, zenith)
        views = np.full((1, 2), np.nan) if self.view is None else self.view
        nodes = np.unique(np.linspace(0, len(views) - 1, 9).astype(np.intp))
        skies = [mirrored_sky(split, *map(float, views[node])) for node in nodes]
        columns = np.arange(len(views))
        values = np.array([np.stack([sky.values, sky_u.values]) for sky, sky_u in skies])
        sky, sky_u = (
            np.stack([np.interp(columns, nodes, channel) for channel in part.T], axis=1)
            for part in values.transpose(1, 0, 2)
        )
        return sky.astype(np.float32), sky_u.mean(axis=1)

    @cached_property
    def direct_share(self) -> float:
        # Direct part of the light on level ground, mean over the channels [1].
        return 1.0 - float(self.model.diffuse_fraction.mean())

    @cached_property
    def level(self) -> Array:
        # Mean reflectance over the channels (line, column) [1].
        level = scratch_array(self.channels.shape[:2], np.float32)
        for lines, block in line_blocks(self.channels):
            level[lines] = block.mean(axis=2)
            release(level)
        return level

    @cached_property
    def ground(self) -> Floats:
        # Reflectance of the ground, the largest body (channel,) [1].
        return np.asarray(np.nan_to_num(self.model.reference[largest_body(self.model)]))

    def release(self) -> None:
        # Release the memory of its mapped arrays.
        for array in (self.channels, self.level, *self.layers.values()):
            release(array)

    def without_sky(self, window: tuple[slice, slice]) -> Array:
        # Return the reflectance in a window of the picture, less the mirrored sky, float32 [1].
        sky = self.sky[0]
        return self.channels[window] - (sky if self.view is None else sky[window[1]])


def largest_body(model: SceneModel) -> int:
    # Return the number of the body with most pixels, which is assumed to be the ground.
    return int(np.argmax(np.bincount(model.body, weights=model.size, minlength=model.segments)))


def window_of(origin: tuple[int, int], mask: Bools) -> tuple[slice, slice]:
    # Return the window of a mask in the picture, from the line and column of its first pixel.
    (y, x), (lines, columns) = origin, mask.shape
    return slice(y, y + lines), slice(x, x + columns)


class Piece(NamedTuple):
    # A connected part of a body, away from other bodies.
    body: int  #: Segment of the scene model.
    origin: tuple[int, int]  #: Line and column of the first pixel of ``inside``.
    inside: Bools  #: (line, column): Its pixels.

    @property
    def window(self) -> tuple[slice, slice]:
        # Window of the piece in the picture.
        return window_of(self.origin, self.inside)

    @property
    def centre(self) -> Floats:
        # Line and column of its centre, (2,).
        return np.asarray(np.argwhere(self.inside).mean(axis=0) + np.array(self.origin, np.float64))


class Measures(NamedTuple):
    # Measures of a piece.
    usable: Bools  #: (line, column): Largest connected set of pixels within the limits.
    spectrum: Floats  #: (channel,): Median over the usable pixels [1].
    lost: Mapping[str, float]  #: Excluded share of the piece, by reason.
    pixels: int = 0  #: Number of usable pixels; without any, the measures are NaN.
    angle: float = np.nan  #: Median spectral angle to the median spectrum [degree].
    spread: float = np.nan  #: Half the range of relative brightness from the 5th to the 95th percentile [1].
    slope: float = np.nan  #: Median change of relative brightness between neighbouring pixels [1].
    #: Means over the usable pixels [1].
    glint: float = np.nan
    shadow: float = np.nan
    adjacency: float = np.nan


def pieces(model: SceneModel, erode: int, min_pixels: int) -> Iterator[tuple[Piece, bool]]:
    # Yield connected parts of bodies that may be painted, and whether they have the spectrum of leaves.
    #
    # Parts have at least ``min_pixels`` pixels, and come in the order of bodies and lines. Pixels in shade or
    # within ``erode`` pixels of an edge belong to no part; dark bodies and the ground have none.
    spectrum, reference = np.nan_to_num(model.spectrum), np.nan_to_num(model.reference)
    # ground: the largest body, and segments with its spectrum
    largest = largest_body(model)
    lengths = np.linalg.norm(reference, axis=1, keepdims=True)
    direction = reference / np.maximum(lengths, 1e-9)
    relative_length = lengths[:, 0] / max(float(lengths[largest, 0]), 1e-9)
    has_ground_spectrum = (direction @ direction[largest] > SURFACES.min_ground_cosine) & (
        np.abs(np.log(np.maximum(relative_length, 1e-9))) < SURFACES.max_ground_log_ratio
    )
    is_ground = has_ground_spectrum | (model.body == largest)
    is_painted = ~is_ground & ~(spectrum.mean(axis=1) < SURFACES.min_level)
    leaves = is_vegetation(model.spectrum, model.channel_wavelength)
    body = np.append(model.body, np.int32(-1))[model.segment]
    shaded = np.append(model.state == SHADED, False)[model.segment]
    # numbers from 1 on, as scipy.ndimage expects them
    labels = np.where((model.edge_distance > erode) & ~shaded & (body >= 0), body + 1, 0)
    is_large = np.bincount(labels.ravel(), minlength=model.segments + 1) >= min_pixels
    for number, window in enumerate(find_objects(labels, max_label=model.segments)):
        if window is None or not is_large[number + 1] or not is_painted[number]:
            continue
        piece_labels, count = label(labels[window] == number + 1)
        for piece_label, inner in zip(range(1, count + 1), find_objects(piece_labels), strict=True):
            mask = piece_labels[inner] == piece_label
            if mask.sum() >= min_pixels:
                y, x = (int(a.start + b.start) for a, b in zip(window, inner, strict=True))
                yield Piece(number, (y, x), mask), bool(leaves[number])


def measured(piece: Piece, picture: Picture, limits: Limits, brightness: Floats | None = None) -> Measures:
    # Return the measures of a piece, with the pixels that a region can use.
    #
    # ``brightness`` (line, column): brightness in the piece's window, relative to the level part [1]; by
    # default computed here, relative to its median.
    layers = {name: layer[piece.window] for name, layer in picture.layers.items()}
    spectra = picture.channels[piece.window].astype(np.float64)
    inside = piece.inside & np.isfinite(spectra).all(axis=2)
    excluded: dict[str, Bools] = {
        "without data": ~inside,
        "flagged invalid": (layers["quality"] & np.uint16(_INVALID)) != 0,
        "glint": ~(layers["glint_fraction"] <= limits["glint"]),
        "shadow": ~(layers["blocked_direct"] < limits["shadow"]),
        "adjacency": ~(_smoothed(layers["adjacency"], inside) <= limits["adjacency"]),
    }
    lit = inside & ~excluded["shadow"]
    lit_spectrum = np.median(spectra[lit], axis=0) if lit.any() else np.full(spectra.shape[2], np.nan)
    if brightness is not None or not lit.any():
        brightness = _smoothed(np.full(lit.shape, np.nan) if brightness is None else brightness, lit)
    else:
        scaled = lit_spectrum / max(float(lit_spectrum @ lit_spectrum), 1e-12)
        brightness = _smoothed(spectra @ scaled, lit)
        brightness = brightness / float(np.median(brightness[lit]))
    # on dark paint a tilt changes reflectance by little, and noise exceeds a relative limit
    allowed = max(limits["brightness"], SURFACES.min_change / max(float(lit_spectrum.max()), 1e-6))
    excluded["another tilt"] = ~(np.abs(brightness - 1.0) <= allowed)
    usable = piece.inside.copy()
    lost = {}
    for reason, mask in excluded.items():
        lost[reason] = float((usable & mask).sum() / piece.inside.sum())
        usable &= ~mask
    # largest connected set of pixels, without parts narrower than three pixels
    sets, _ = label(binary_opening(usable, np.ones((3, 3), bool)))
    usable = np.asarray(sets == 1 + int(np.argmax(np.bincount(sets.ravel(), minlength=2)[1:])))
    lost = {name: share for name, share in lost.items() if share}
    if not usable.any():
        return Measures(usable, np.full(spectra.shape[2], np.nan), lost)
    values = spectra[usable]
    median_spectrum = np.median(values, axis=0)
    length = np.linalg.norm(values, axis=1) * np.linalg.norm(median_spectrum)
    angles = np.degrees(np.arccos(np.clip(values @ median_spectrum / np.maximum(length, 1e-12), -1.0, 1.0)))
    low, high = np.quantile(brightness[usable], [0.05, 0.95])
    # steps between neighbouring pixels along both axes
    pairs = (usable[1:] & usable[:-1], usable[:, 1:] & usable[:, :-1])
    steps = np.concatenate([np.abs(np.diff(brightness, axis=axis))[pairs[axis]] for axis in (0, 1)])
    return Measures(
        usable,
        median_spectrum,
        lost,
        pixels=int(usable.sum()),
        angle=float(np.median(angles)),
        spread=0.5 * float(high - low),
        slope=float(np.median(steps)) if steps.size else 0.0,
        glint=float(layers["glint_fraction"][usable].mean()),
        shadow=float(layers["blocked_direct"][usable].mean()),
        adjacency=float(layers["adjacency"][usable].mean()),
    )


def _smoothed(values: Array, valid: Bools) -> Floats:
    # Mean of the valid values in the square around every pixel (line, column); NaN without valid values
    valid = valid & np.isfinite(values)
    total, count = (
        uniform_filter(array.astype(np.float64), SURFACES.square_px, mode="constant")
        for array in (np.where(valid, values, 0.0), valid)
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(valid, total / count, np.nan)


# --- free sun under broken clouds, from the irradiance record and from a shadow beside a car ---------------


def sunny_lines(
    line: xr.Dataset, model: SceneModel, diffuse: Any, zenith: float | None
) -> tuple[Bools, float] | None:
    # Return the lines with free sun by the irradiance record, and the diffuse fraction of their infrared.
    #
    # (line,) and [1], NaN where no line had free sun; None where clouds were not broken.
    if "broken" not in str(model.attrs.get("sky_states", "")).split():
        return None
    no_sun = np.zeros(line.sizes[ALONG_TRACK], bool), np.nan
    if zenith is None or not {"irradiance", "time", IRRADIANCE_TIME} <= set(line.variables):
        return no_sun
    nm = line["wavelength"].values.astype(np.float64)
    infrared = np.flatnonzero(nm >= min(GAPS.infrared_nm, float(nm.max())))
    fraction = split_of(line, diffuse, zenith, from_shadow=True).fraction
    if ALONG_TRACK not in fraction.dims:
        return no_sun
    record = line["irradiance"]
    # NaN where a channel is missing: means over fewer channels do not compare
    level = record.mean([dim for dim in record.dims if dim != IRRADIANCE_TIME], skipna=False).values
    if not np.nanmin(level) < GAPS.max_dip * np.nanmax(level):
        return no_sun
    infrared_fraction = fraction.isel({BAND: infrared}).mean(BAND).values
    clear = float(diffuse_fraction(nm[infrared], zenith).mean())
    free = np.asarray(infrared_fraction < clear + GAPS.max_above_clear)
    if not free.any():
        return no_sun
    # free sun in all samples of the record from `around_s` before a line to `around_s` after it
    time, stamps = (
        line[name].values.astype("datetime64[ns]").astype(np.int64) for name in ("time", IRRADIANCE_TIME)
    )
    has_level = np.isfinite(level)
    stamps, level = stamps[has_level], level[has_level]
    dimmed = stamps[level <= GAPS.min_of_free * np.median(np.interp(time[free], stamps, level))]
    # time to the nearest dimmed sample or end of the record
    bounds = np.concatenate([[stamps[0]], dimmed, [stamps[-1]]])
    later = np.clip(np.searchsorted(bounds, time), 1, bounds.size - 1)
    free = free & (np.minimum(bounds[later] - time, time - bounds[later - 1]) > GAPS.around_s * 1e9)
    return (free, float(infrared_fraction[free].mean())) if free.any() else no_sun


def doubt_about_clouds(window: tuple[slice, slice], picture: Picture) -> str:
    # Return why the sun may not have been free over a car under broken clouds; empty where it was.
    #
    # Takes ``window``: the part of the picture with the car.
    if picture.sun is None:
        return ""
    model, (sunny, sunny_fraction) = picture.model, picture.sun
    advice = "take a line flown between clouds, or draw the region and check its level by hand"
    if not sunny[window[0]].all():
        return (
            "clouds were broken, and no irradiance record shows free sun from "
            f"{GAPS.around_s:g} s before this car was recorded to {GAPS.around_s:g} s after; {advice}"
        )
    near = padded(window, GAPS.around_px)
    infrared = model.channel_wavelength >= min(GAPS.infrared_nm, float(model.channel_wavelength.max()))
    brightness = picture.channels[near][..., infrared].mean(axis=2)
    segment = model.segment[near]
    body = np.append(model.body, np.int32(-1))[segment]
    # only shadows on the ground: the sides of cars that face away from the sun are shaded, too
    shaded = np.append((model.state == SHADED) & (model.ground > 0), False)[segment]
    recorded = max(sunny_fraction, GAPS.least_fraction)
    # the largest shadow, and sunlit ground of the same body
    inside = shaded & (body >= 0) & np.isfinite(brightness)
    ground = int(np.bincount(body[inside]).argmax()) if inside.any() else -1
    dark, lit = brightness[inside & (body == ground)], brightness[~shaded & (body == ground)]
    if min(dark.size, lit.size) < GAPS.min_px:
        return f"clouds were broken, and no shadow beside this car shows that the sun was free here; {advice}"
    fraction = float(np.median(dark) / np.median(lit))
    return (
        f"clouds were broken, and a shadow beside this car has {fraction:.0%} of the light, expected "
        f"{recorded:.0%} by the record: a cloud covered the sun here; {advice}"
        if not fraction <= GAPS.max_over_record * recorded
        else ""
    )


def view_of(line: xr.Dataset, sun_azimuth: float | None) -> Floats | None:
    # Return angle of the camera from the vertical and azimuth relative to the sun (column, 2) [degree].
    #
    # Mean over some lines; None where they are unknown. Takes ``sun_azimuth`` [degree]: by default from the
    # clock.
    rows = np.unique(np.linspace(0, line.sizes[ALONG_TRACK] - 1, 32).astype(np.intp))
    lines = line.isel({ALONG_TRACK: rows})
    view = pixel_view(lines)
    if view is None or (sun_azimuth is None and not set(SUN_FROM) <= set(line.variables)):
        return None
    sun = (
        np.full(rows.size, sun_azimuth)
        if sun_azimuth is not None
        else solar_position(*(lines[name].values for name in SUN_FROM))[1]
    )
    zenith, azimuth = (angle.transpose(*_DIMS).values for angle in view)
    direction = np.tan(np.radians(zenith)) * np.exp(1j * np.radians(azimuth - sun[:, None]))
    mean = direction.mean(axis=0)
    return np.asarray(np.degrees(np.stack([np.arctan(np.abs(mean)), np.angle(mean)], axis=1)))


# --- lean of a roof towards the sun: its prior uncertainty, and its estimate from a height model -----------


def height_model_of(line: xr.Dataset) -> tuple[Array, float] | None:
    # Return the height of the surface in every pixel, and the distance between pixels; None without heights.
    #
    # (line, column) [m] and [m], from ``east``, ``north`` and ``ground_height`` of
    # `hyperpaint.geometry.locate` with a ``dem`` of surfaces.
    names, dims = ("east", "north", "ground_height"), (ALONG_TRACK, CROSS_TRACK)
    if not all(name in line.variables and set(line[name].dims) == set(dims) for name in names):
        return None
    east, north, height = dask.compute(*(line[name].transpose(*dims).data for name in names))
    steps = [np.hypot(np.diff(east, axis=axis), np.diff(north, axis=axis)) for axis in (0, 1)]
    spacings = np.concatenate([step[np.isfinite(step)] for step in steps])
    return (
        None
        if not spacings.size or not float(np.median(spacings)) > 0.0
        else (np.asarray(height, np.float64), float(np.median(spacings)))
    )


def lean_to_sun(axis: Floats, shadow_side: Floats | None) -> float:
    # Return the standard deviation of the unknown lean of a roof towards the sun [degree].
    #
    # Takes ``axis`` (2,): unit vector (line, column) along the car; ``shadow_side`` (2,): direction of
    # shadows, or None where it is unknown.
    along = 1.0 if shadow_side is None else float(abs(axis @ shadow_side))
    return float(np.hypot(LEANS.rake_deg * along, LEANS.roll_deg * np.sqrt(max(1.0 - along**2, 0.0))))


def measured_lean(
    heights: tuple[Array, float] | None,
    window: tuple[slice, slice],
    inside: Bools,
    centre: tuple[float, float],
    prior: float,
    shadow_side: Floats | None,
) -> tuple[float, Floats, float]:
    r"""Return the lean of a roof from its heights; the prior where no height model shows the car.

    Standard deviation of its unknown part [degree]; lines and columns (2,) from the centre of the roof to
    where it is level along the sun's direction; and the lean in the centre, positive where the roof faces the
    sun [degree], NaN if not measured.

    A polynomial of second order through the heights of the roof,

    .. math:: z = z_0 + b \cdot p + p^T H p / 2,

    with p [pixel] from its centre, has the slope :math:`b \cdot s` towards the sun s, and is level
    :math:`- (b \cdot s) / (s^T H s)` pixels in that direction. The prior lean, 0 with the standard deviation
    ``prior``, and the fitted lean are weighted by their inverse variances.

    Takes ``heights``: see `height_model_of`; ``window``: the part of the picture with the roof; ``inside``
    (line, column): its pixels there; ``centre``: line and column in the window; ``prior`` [degree];
    ``shadow_side`` (2,): see `lean_to_sun`.
    """
    prior_lean = prior, np.zeros(2), np.nan
    if heights is None or shadow_side is None:
        return prior_lean
    surface, spacing = heights
    height = surface[window]
    valid = inside & np.isfinite(height)
    # a height model of bare ground does not show the car
    around = padded(window, LEANS.around_px)
    if (
        valid.sum() < LEANS.min_px
        or min(valid.any(axis=0).sum(), valid.any(axis=1).sum()) < LEANS.min_side_px
        or not np.median(height[valid]) - np.nanquantile(surface[around], 0.1) > LEANS.min_above_m
    ):
        return prior_lean
    rows, columns = np.nonzero(valid)
    y, x = rows - centre[0], columns - centre[1]
    terms = np.stack([np.ones(y.size), y, x, 0.5 * y * y, y * x, 0.5 * x * x], axis=1)
    fitted = np.linalg.lstsq(terms, height[valid], rcond=None)[0]
    residuals = height[valid] - terms @ fitted
    # the height errors within one patch are correlated
    patch_px = max(1.0, (LEANS.patch_m / spacing) ** 2)
    covariance = (
        np.linalg.pinv(terms.T @ terms) * float(residuals @ residuals) / (y.size - terms.shape[1]) * patch_px
    )
    sun = -shadow_side
    slope = float(fitted[1:3] @ sun) / spacing
    slope_sd = float(np.sqrt(sun @ covariance[1:3, 1:3] @ sun)) / spacing
    sd = float(np.hypot(np.degrees(np.arctan(slope_sd)), LEANS.floor_deg))
    if not sd < prior:
        return prior_lean
    weight = prior**2 / (prior**2 + sd**2)
    curvature = float(sun @ np.array([[fitted[3], fitted[4]], [fitted[4], fitted[5]]]) @ sun) / spacing**2
    # only a roof that curves down has a level position
    shift = weight * slope / -curvature / spacing * sun if curvature < 0.0 else np.full(2, np.inf)
    return prior * sd / float(np.hypot(prior, sd)), shift, -float(np.degrees(np.arctan(slope)))


# --- the footprint of a car: the area around a piece of its paint -----------------------------------------


_ROUNDING = 1e-6

#: Rules for joining parts of a car, from the strictest on; parts that touch are always joined. Each tells
#: whether far brighter or darker parts are of the same paint, such as flakes at another lean; whether parts
#: with only dark pixels between them are joined; and whether thin bridges, such as a mirror that touches a
#: bay line, separate parts.
JOININGS = tuple(product((False, True), (False, True), (False, True)))


class Footprint(NamedTuple):
    # A car seen from above.
    origin: tuple[int, int]  #: Line and column of the first pixel of the masks.
    paint: Bools  #: (line, column): Pixels with the colour of its paint, also beside the car.
    area: Bools  #: (line, column): The car: its thick parts with this colour, and the area they enclose.
    brightness: Floats32  #: (line, column): Brightness relative to the piece that the footprint began with.
    axis: Floats  #: (2,): Unit vector (line, column) along its longer side.
    centre: Floats  #: (2,): Line and column of its centre in the masks.
    length: float  #: [pixel]
    width: float  #: [pixel]
    cut: bool  #: Whether the edge of the picture cuts it off.

    @property
    def is_one_car(self) -> bool:
        # Whether it has the proportions of one car, and the picture shows all of it.
        low, high = FOOTPRINTS.slenderness
        return not self.cut and low < self.length / self.width < high

    @property
    def window(self) -> tuple[slice, slice]:
        # Window of the masks in the picture.
        return window_of(self.origin, self.area)


def footprints_of(
    inside: Bools,
    origin: tuple[int, int],
    colour: Floats,
    picture: Picture,
    joinings: Sequence[tuple[bool, bool, bool]],
    max_size: float = np.inf,
) -> Iterator[Footprint | None]:
    # Yield the footprint of the car around a piece of paint, for each of the rules for joining parts.
    #
    # Rules with which the paint extends farther than a car of ``max_size`` [pixel], or than the largest
    # margin, yield nothing. None, at the end: it does so although thin bridges are cut, and every further
    # rule would join more. Takes ``inside`` (line, column): the piece; ``origin``: line and column of its
    # first pixel; ``colour`` (channel,): its reflectance, less the mirrored sky [1]; ``joinings``: see
    # `JOININGS`.
    shape = np.array(picture.level.shape)
    longest = np.sqrt(max_size * FOOTPRINTS.slenderness[1])
    matches: dict[tuple[int, bool], tuple[Bools, Bools, Bools, Floats32]] = {}
    areas: dict[tuple[int, bool, bytes], tuple[Bools | None, bool]] = {}
    for wide_brightness, over_windows, cut_bridges in joinings:
        pad = min(int(FOOTPRINTS.margin * max(inside.shape)), FOOTPRINTS.max_margin_px)
        for _ in range(FOOTPRINTS.rounds):
            low = np.maximum(np.array(origin) - pad, 0)
            high = np.minimum(np.array(origin) + inside.shape + pad, shape)
            key = pad, wide_brightness
            if key not in matches:
                matches[key] = _matched_colour(
                    colour, picture, np.s_[low[0] : high[0], low[1] : high[1]], wide_brightness
                )
            paint, ground, dark, brightness = matches[key]
            # pixels at the sides of the window beyond which the picture goes on
            beyond = np.zeros(paint.shape, bool)
            beyond[0], beyond[-1] = low[0] > 0, high[0] < shape[0]
            beyond[:, 0] |= low[1] > 0
            beyond[:, -1] |= high[1] < shape[1]
            seed = np.zeros(paint.shape, bool)
            seed[window_of((origin[0] - low[0], origin[1] - low[1]), inside)] = inside
            parts = _parts_of_car(seed, paint | seed, dark if over_windows else None, cut_bridges)
            # most rules join the same parts
            content = (*key, parts.tobytes())
            is_new = content not in areas
            if is_new:
                areas[content] = _car_area(seed, parts, ground, beyond, max_size)
            area, is_endless = areas[content]
            if area is None:
                break
            is_endless = True
            if not (area & beyond).any():
                if is_new:
                    axis, centre, length, width = _rectangle(area)
                    # thousands are kept: only the car, and what profiles across its roof touch beside it
                    window = padded(find_objects(area.view(np.int8))[0], max(int(0.25 * width), 8))
                    first = np.array([side.start for side in window])
                    line, column = (low + first).tolist()
                    yield Footprint(
                        (line, column), (paint | seed)[window].copy(), area[window].copy(),
                        brightness[window].copy(), axis, centre - first, length, width,
                        bool(area[[0, -1]].any() or area[:, [0, -1]].any()),
                    )  # fmt: skip
                is_endless = False
                break
            if pad > longest:
                break
            pad = int(FOOTPRINTS.growth * pad) + 8
        if is_endless and cut_bridges:
            yield None
            return


def _matched_colour(
    colour: Floats, picture: Picture, window: tuple[slice, slice], wide_brightness: bool
) -> tuple[Bools, Bools, Bools, Floats32]:
    # Pixels (line, column) of paint, of ground, and darker than paint; brightness relative to the paint
    colour_length, ground_length = float(np.linalg.norm(colour)), float(np.linalg.norm(picture.ground))
    units = [
        (colour / colour_length**2).astype(np.float32),
        (picture.ground / ground_length).astype(np.float32),
    ]
    # by blocks of lines: the colour of a wall or of leaves extends over thousands
    seen, sky = picture.channels[window], picture.sky[0][slice(None) if picture.view is None else window[1]]
    sums = np.empty((3, *seen.shape[:2]), np.float32)
    for lines, block in line_blocks(seen):
        spectra = block - sky
        sums[0, lines] = np.einsum("ijk,ijk->ij", spectra, spectra)
        sums[1:, lines] = [spectra @ unit for unit in units]
    length = np.maximum(np.sqrt(sums[0]), np.float32(1e-9))
    brightness = sums[1].astype(np.float64)
    paint_cosine = brightness * colour_length / length
    is_dark = float(colour.mean()) < SURFACES.dark
    low, high = (FOOTPRINTS.dark_brightness if is_dark else FOOTPRINTS.brightness)[wide_brightness]
    # pixels as bright as the ground are paint only if their spectrum is closer to the paint's
    ground_cosine = sums[2] / length
    is_ground_bright = np.abs(np.log(length / ground_length)) < FOOTPRINTS.max_ground_log_ratio
    is_closer = (paint_cosine > ground_cosine) | ~is_ground_bright
    paint = (paint_cosine > FOOTPRINTS.min_cosine) & (brightness > low) & (brightness < high) & is_closer
    if is_dark:
        # a cast shadow may be as dark as the paint
        model = picture.model
        paint &= ~np.append(model.state == SHADED, False)[model.segment[window]]
    ground = ~paint & is_ground_bright & (ground_cosine > FOOTPRINTS.min_cosine)
    # brightness has the values of float32, and thousands of footprints keep it
    darker = ~paint & (length < low * colour_length)
    return paint, ground, darker, brightness.astype(np.float32)


def _parts_of_car(seed: Bools, paint: Bools, dark: Bools | None, cut_bridges: bool) -> Bools:
    # Paint with closed gaps that is connected with a seed. `cut_bridges` opens what is thinner than a bridge:
    # bay lines and mirrors are thin. With `dark`, parts with only dark pixels between them are connected.
    gap = FOOTPRINTS.max_gap_px
    dilated = _squares(np.pad(paint, gap), gap, grow=True)
    closed = _squares(dilated, gap, grow=False)[gap:-gap, gap:-gap]
    if cut_bridges:
        eroded = _squares(closed, FOOTPRINTS.bridge_px, grow=False)
        closed = _squares(eroded, FOOTPRINTS.bridge_px, grow=True) | seed
    parts, _ = label(closed if dark is None else closed | dark, np.ones((3, 3), bool))
    is_seed_part = np.zeros(int(parts.max()) + 1, bool)
    is_seed_part[parts[seed]] = True
    is_seed_part[0] = False
    return np.asarray(closed & is_seed_part[parts])


def _car_area(
    seed: Bools, closed: Bools, ground: Bools, beyond: Bools, max_size: float
) -> tuple[Bools | None, bool]:
    # Area of the car around a seed: the hull of thick connected parts with the colour of its paint.
    # Parts with ground between them and the seed are not added. None without a core, or for more pixels than
    # `max_size`; and whether the core around the seed alone has more. Only a part of the area, where it
    # contains pixels of `beyond`: a larger window is needed.
    square = np.ones((3, 3), bool)
    if not closed.any():
        return None, False
    # only the part of the window around the connected parts, with a pixel of background
    shape, window = closed.shape, padded(find_objects(closed.view(np.int8))[0], 1)
    seed, ground, beyond = seed[window], ground[window], beyond[window]
    # the first component of the background is outside; others are holes
    outside, _ = label(np.pad(~closed[window], 1, constant_values=True))
    filled = (outside != 1)[1:-1, 1:-1]
    depth = depth_of(filled)
    # the depth at the seed counts: a wall that the car touches may be wider
    min_depth = max(FOOTPRINTS.min_half_width_px, FOOTPRINTS.thin * float(depth[seed].max()))
    cores, count = label(depth > min_depth, square)
    seed_sizes = np.bincount(cores[seed & (cores > 0)], minlength=count + 1)
    if not seed_sizes.any():
        return None, False
    # hull of the seed's core and of further cores, added from the nearest on while their gap, the width of
    # the hull and the ground in it stay within the limits of a car
    seed_core = int(np.argmax(seed_sizes))
    car_cores = cores == seed_core
    if car_cores.sum() > max_size:
        return None, True
    area = car_cores if (car_cores & beyond).any() else _hull_around(car_cores, min_depth, filled)
    is_whole = not (area & beyond).any()
    large_cores = np.flatnonzero(np.bincount(cores.ravel()) > min_depth * min_depth).tolist()
    candidates = [core for core in large_cores if is_whole and core not in (0, seed_core)]
    gaps: dict[int, float] = {}
    while candidates:
        if not gaps:
            gap_of, others = np.full(count + 1, np.inf), cores > 0
            np.minimum.at(gap_of, cores[others], depth_of(~car_cores)[others])
            gaps = {core: float(gap_of[core]) for core in candidates}
        nearest = min(candidates, key=lambda core: (gaps[core], core))
        candidates.remove(nearest)
        larger_cores = car_cores | (cores == nearest)
        half_width = float(depth[larger_cores].max())
        if gaps[nearest] > FOOTPRINTS.max_gap * half_width:
            break
        hull = _hull_around(larger_cores, min_depth, filled)
        is_narrow = _rectangle(hull)[3] < FOOTPRINTS.max_width * 2.0 * half_width
        if is_narrow and (hull & ground).sum() < FOOTPRINTS.max_ground_share * hull.sum():
            car_cores, area, gaps = larger_cores, hull, {}
            if area.sum() > max_size:
                return None, False
    whole = np.zeros(shape, bool)
    whole[window] = area
    return whole, False


def _squares(mask: Bools, px: int, *, grow: bool) -> Bools:
    # Dilate or erode a mask by squares with half a side of some pixels; nothing lies outside the mask
    join = np.logical_or if grow else np.logical_and
    for _ in range(2):  # along one axis, then the other; scipy's filters take ten times as long
        wide = np.pad(mask, ((px, px), (0, 0)))
        mask = reduce(join, [wide[shift : shift + len(mask)] for shift in range(2 * px + 1)]).T
    return np.ascontiguousarray(mask)


def _hull_around(core: Bools, radius: float, filled: Bools) -> Bools:
    # Convex hull of the pixels of the mask `filled` within a distance [pixel] of a core
    pad = int(np.ceil(radius))
    window = tuple(
        slice(max(int(indices[0]) - pad, 0), int(indices[-1]) + pad + 1)
        for indices in (np.flatnonzero(core.any(axis=axis)) for axis in (1, 0))
    )
    hull = np.zeros_like(core)
    hull[window] = hull_of(_discs(core[window], radius) & filled[window])
    return hull


def _discs(mask: Bools, radius: float) -> Bools:
    # Dilate a mask by discs of a radius [pixel]; shifted copies take a tenth of a distance transform
    px, (lines, columns) = int(radius), mask.shape
    wide = np.pad(mask, px)
    grown, row, reach = np.zeros_like(mask), wide[:, px : px + columns], 0
    for step in range(px, -1, -1):  # from the disc's first and last line to the middle one, the widest
        while (reach + 1) ** 2 + step**2 <= radius**2:
            reach += 1
            row = row | wide[:, px - reach :][:, :columns] | wide[:, px + reach :][:, :columns]
        grown |= row[px - step :][:lines] | row[px + step :][:lines]
    return grown


def hull_of(mask: Bools) -> Bools:
    # Return the convex hull of a mask (line, column).
    try:
        normal_y, normal_x, offset = ConvexHull(_border(mask)).equations.T
    except QhullError:  # all pixels lie on a straight line
        return mask
    lines, columns = mask.shape
    # intersections of every line of the mask with the sides of the hull: the nearest side with its normal to
    # the right ends the line, the nearest with its normal to the left begins it
    offsets = -(np.arange(lines)[:, None] * normal_y + offset)
    steep = np.where(np.abs(normal_x) > _ROUNDING, normal_x, np.nan)
    last_x = np.where(normal_x > _ROUNDING, offsets / steep, np.inf).min(axis=1)
    first_x = np.where(normal_x < -_ROUNDING, offsets / steep, -np.inf).max(axis=1)
    crosses = np.where(np.abs(normal_x) > _ROUNDING, 0.0, offsets).min(axis=1) >= -_ROUNDING
    x = np.arange(columns)
    inside = (x >= first_x[:, None] - _ROUNDING) & (x <= last_x[:, None] + _ROUNDING)
    return np.asarray(inside & crosses[:, None])


def _border(mask: Bools) -> Floats:
    # Line and column (point, 2) of the first and the last pixel in every line of a mask
    rows = np.flatnonzero(mask.any(axis=1))
    row_masks = mask[rows]
    first, last = row_masks.argmax(axis=1), mask.shape[1] - 1 - row_masks[:, ::-1].argmax(axis=1)
    return np.stack([np.repeat(rows, 2), np.stack([first, last], axis=1).ravel()], axis=1).astype(np.float64)


def _rectangle(mask: Bools) -> tuple[Floats, Floats, float, float]:
    # Direction of the longer side, centre, length and width of the rectangle with the smallest area around a
    # mask, among directions in steps of `turn_deg`
    points = _border(mask)
    turn = np.radians(np.arange(0.0, 90.0, FOOTPRINTS.turn_deg))
    axes = np.stack([np.sin(turn), np.cos(turn)], axis=1)
    asides = np.stack([np.cos(turn), -np.sin(turn)], axis=1)
    u, v = points @ axes.T, points @ asides.T
    lengths, widths = np.ptp(u, axis=0) + 1.0, np.ptp(v, axis=0) + 1.0
    best = int(np.argmax(lengths * widths <= (lengths * widths).min() + _ROUNDING))
    along, aside = axes[best], asides[best]
    centre = 0.5 * (
        (u[:, best].min() + u[:, best].max()) * along + (v[:, best].min() + v[:, best].max()) * aside
    )
    length, width = float(lengths[best]), float(widths[best])
    return (along, centre, length, width) if length >= width else (aside, centre, width, length)


# --- the roof of a car -------------------------------------------------------------------------------------


class Roof(NamedTuple):
    # The roof of a car.
    inside: Bools  #: (line, column): Its pixels, in the footprint's window.
    centre: tuple[float, float]  #: Line and column of its level position in that window.
    axis: Floats  #: Unit vector (line, column) along the car.
    unsure: float  #: Maximum error of the level position along the car [pixel].
    unsure_across: float  #: The same across the car [pixel].
    reason: str  #: Evidence that it is a roof.
    worth: float  #: Weight of this evidence; the roof with the largest worth is chosen.
    complete: bool  #: Whether it lies between two windows with paint beyond both.
    sided: bool  #: Whether a window at its end has a bonnet beyond, and side windows run along it.
    window_level: float  #: Median mean reflectance of the windows at its ends [1].
    #: Whether it has side windows, which bonnets lack, no sunroof beside it, and all of its length is seen.
    is_whole: bool = True


class NoRoof(NamedTuple):
    # Reason why no roof is found, and whether it is still a car.
    reason: str
    is_car: bool


class _Run(NamedTuple):
    # A section of a car along its axis, of windows or of paint: tracks `start` to before `stop` [pixel]
    start: int
    stop: int
    is_window: bool

    @property
    def length(self) -> int:
        return self.stop - self.start


class _Tracks(NamedTuple):
    # Coordinates of the pixels of a car and its windows (line, column); a track is a row of pixels across it
    along: Floats  #: Distance from its end along its axis [pixel].
    number: Ints  #: Track, from 0 at that end; pixels beyond an end count to its track.
    across: Floats  #: Distance from its axis [half widths].
    glass: Bools  #: Pixels as dark as windows.
    level: Floats  #: Mean reflectance [1].

    def within(self, run: _Run) -> Bools:
        return (self.along >= run.start) & (self.along < run.stop)


def find_roof(car: Footprint, level: Floats) -> Roof | NoRoof:
    # Return the roof of a car, or the reason why none is found.
    #
    # Takes ``car``: its footprint; ``level`` (line, column): mean reflectance in its window [1].
    # pixels as dark as windows
    paint_level = float(np.median(level[car.paint & car.area]))
    limit = min(max(ROOFS.max_window_level, ROOFS.max_window_of_paint * paint_level), paint_level)
    glass = np.asarray(~car.paint & car.area & (level < limit))
    is_dark = paint_level < SURFACES.dark
    roof = _roof_along(car, glass, level, is_dark=is_dark)
    if isinstance(roof, Roof) or not car.cut:
        return roof
    # the longer side of a car cut off by the picture's edge may be its width
    turned_roof = _roof_along(
        car._replace(axis=np.array([car.axis[1], -car.axis[0]]), length=car.width, width=car.length),
        glass,
        level,
        is_dark=is_dark,
    )
    return roof if isinstance(turned_roof, NoRoof) else turned_roof


def _roof_along(car: Footprint, glass: Bools, level: Floats, *, is_dark: bool) -> Roof | NoRoof:
    count = round(car.length)
    ahead, across = _to_car(car.centre, car.axis, *np.indices(car.area.shape))
    from_end, across = ahead + 0.5 * car.length, across / (0.5 * car.width)
    track = np.floor(from_end).astype(np.int64).clip(0, count - 1)
    tracks = _Tracks(from_end, track, across, glass, level)
    # Tracks with side windows (track,), on the side with more of them.
    # Beyond a window there is a lit door; beyond dark pixels of the car's shadow nothing is lit.
    side_windows = []
    for aside in (-across, across):
        lit = car.area & ~glass & (aside > ROOFS.middle)
        outermost = np.zeros(count)
        np.maximum.at(outermost, track[lit], aside[lit])
        window = glass & (aside > ROOFS.middle) & (aside < outermost[track])
        side_windows.append(np.bincount(track[window], minlength=count) >= ROOFS.min_window_px)
    beside = max(side_windows, key=lambda windows: int(windows.sum()))
    runs = _runs(car, tracks)
    cabin = _cabin_roof(car, tracks, beside) if is_dark else None
    if cabin is None and not any(run.is_window for run in runs):
        return NoRoof("no window crosses it: it may not belong to a car", False)

    def sided(run: _Run) -> float:
        # Share of a section with side windows
        return float(beside[run.start : run.stop].mean())

    best: Roof | None = None
    for number, run in enumerate(runs):
        if run.is_window or run.length < ROOFS.min_roof_px:
            continue
        # windows at the ends of the section, and the paint beyond them
        windows, beyond = (
            [runs[section] for section in (number - step, number + step) if 0 <= section < len(runs)]
            for step in (1, 2)
        )
        long = [section for section in beyond if section.length > ROOFS.min_bonnet * car.length]
        has_bonnet = any(sided(section) < ROOFS.sided for section in long)
        grounds = _judge_run(car, runs, number, sided(run), len(long) == 2)
        if grounds is None or (best is not None and best.worth >= grounds[1]):
            continue
        along, unsure = _level_place(car, runs, number)
        centre, half, unsure_across, are_visible = _sides(car, tracks, run)
        inside = car.area & tracks.within(run) & (np.abs(across - centre) < ROOFS.used_width * half)
        # the sides of a car at the picture's edge must be visible
        if not inside.any() or (car.cut and not are_visible):
            continue
        line, column = _to_picture(car.centre, car.axis, along - 0.5 * car.length, 0.5 * car.width * centre)
        is_between = len(long) == 2 or (has_bonnet and sided(run) > ROOFS.sided)
        # the roof of a pickup, or a part of one behind a glass roof, ends at one window, too, and may slope
        share = run.length / car.length
        is_long = share > (ROOFS.max_bonnet if sided(run) > ROOFS.surely_sided else ROOFS.min_van_roof)
        is_whole = sided(run) > ROOFS.van_sided if len(windows) == 2 else is_long or car.cut
        is_whole = is_whole and unsure <= ROOFS.unsure * car.length
        in_windows = np.logical_or.reduce([tracks.within(window) for window in windows])
        of_windows = in_windows & glass & (np.abs(across) < ROOFS.middle)
        best = Roof(
            inside,
            (float(line), float(column)),
            car.axis,
            unsure,
            unsure_across,
            *grounds,
            1 < number < len(runs) - 2 and is_between,
            has_bonnet and sided(run) > ROOFS.surely_sided,
            float(np.median(level[of_windows])) if of_windows.any() else np.nan,
            is_whole,
        )
    if cabin is not None and not (best is not None and (best.complete or best.sided)):
        return cabin
    if best is not None:
        return best
    is_car = car.is_one_car and float(beside.mean()) > ROOFS.van_sided
    return NoRoof("no roof: no section lies between windows, or is longer than a bonnet", is_car)


def _cabin_roof(car: Footprint, tracks: _Tracks, beside: Bools) -> Roof | None:
    # Roof of a car as dark as its windows: the middle of the section (track,) with windows beside it.
    # Its windscreen shows the same sky as its paint, and may show the sun; side windows lean, and are darker.
    pillars = np.ones(2 * round(0.5 * ROOFS.max_strip * car.length) + 1, bool)
    joined = binary_opening(binary_closing(beside, pillars), pillars)
    cabins, count = label(joined)
    if not car.is_one_car or not count:
        return None
    longest = int(np.argmax(np.bincount(cabins)[1:])) + 1
    (tracks_of_cabin,) = find_objects(cabins)[longest - 1]
    start, stop = tracks_of_cabin.start, tracks_of_cabin.stop
    share = (stop - start) / car.length
    if not ROOFS.cabin[0] < share < ROOFS.cabin[1]:
        return None
    middle, half = 0.5 * (start + stop), 0.5 * ROOFS.cabin_roof * (stop - start)
    run = _Run(round(middle - half), round(middle + half), False)
    centre, half_width, unsure_across, _ = _sides(car, tracks, run)
    inside = car.area & tracks.within(run) & (np.abs(tracks.across - centre) < ROOFS.used_width * half_width)
    windows = car.area & tracks.glass & tracks.within(run) & ~inside
    if not inside.any() or not windows.any():
        return None
    line, column = _to_picture(car.centre, car.axis, middle - 0.5 * car.length, 0.5 * car.width * centre)
    return Roof(
        inside,
        (float(line), float(column)),
        car.axis,
        ROOFS.unsure_cabin * car.length,
        unsure_across,
        f"a roof: the middle of a cabin with side windows along {share:.0%} of the car",
        share,
        False,
        True,
        float(np.median(tracks.level[windows])),
    )


def _judge_run(
    car: Footprint, runs: list[_Run], number: int, sided: float, is_between: bool
) -> tuple[str, float] | None:
    # Reason and worth of a section as the roof; None where it may be another body part.
    # `sided`: its share with side windows; `is_between`: whether paint lies beyond the windows at both ends.
    run = runs[number]
    share = run.length / car.length
    ends = int(number > 0) + int(number + 1 < len(runs))
    evidence = f"side windows along {sided:.0%} of it"
    # a bed has walls along it, too, but no paint beyond both ends
    worth = share + sided + (ROOFS.between_worth if is_between else 0.0)
    if car.cut:
        return (
            (f"a roof: windows end it on both sides, {evidence}", worth)
            if ends == 2 and sided > ROOFS.long_sided and run.length > ROOFS.min_roof_of_cut * car.width
            else None
        )
    # a section between a windscreen and the car's own shadow looks as if it ended at two windows
    min_slenderness = (
        ROOFS.min_slenderness if ends == 2 and sided > ROOFS.surely_sided else FOOTPRINTS.slenderness[0]
    )
    if (
        share < ROOFS.min_roof
        or not min_slenderness < car.length / car.width < FOOTPRINTS.slenderness[1]
        or (ends == 2 and not is_between and (share < ROOFS.short_roof or sided < ROOFS.van_sided))
    ):
        return None
    evidence = f"{share:.0%} of the car's length, {evidence}"
    centre = 0.5 * (run.start + run.stop) / car.length
    if ends == 2 and (sided > ROOFS.sided or ROOFS.central[0] < centre < ROOFS.central[1]):
        return f"a roof: windows end it on both sides, {evidence}", worth
    if ends == 1 and sided > ROOFS.surely_sided:
        return f"a roof: a window ends it, {evidence}", worth
    if ends != 1 or not share < ROOFS.max_van_roof:
        return None
    is_behind_bonnet = (
        len(runs) == 3
        and ROOFS.min_bonnet < runs[2 - number].length / car.length < ROOFS.max_bonnet
        and runs[1].length / car.length < ROOFS.max_windscreen
    )
    if share > ROOFS.min_van_roof and is_behind_bonnet:
        return f"a roof: it is all of the car behind a windscreen with a bonnet, {evidence}", worth
    min_sided = ROOFS.long_sided if share < ROOFS.min_van_roof else ROOFS.van_sided
    return (
        (f"a roof: a window ends it, and it is longer than any bonnet, {evidence}", share + sided)
        if share > ROOFS.max_bonnet and sided > min_sided
        else None
    )


def _level_place(car: Footprint, runs: list[_Run], number: int) -> tuple[float, float]:
    # Position along the car where a roof is level, and its maximum error [pixel].
    # A window longer than `min_sunroof` contains a sunroof: then the roof is level at this window's edge.
    # Where less than a tail follows, as behind the bed of a pickup, it is no sunroof.
    run, car_length = runs[number], car.length
    centre = 0.5 * (run.start + run.stop)
    for step in (-1, 1):
        if car.cut or not 0 <= number + step < len(runs) or run.length > ROOFS.max_bonnet * car_length:
            continue
        window = runs[number + step].length
        edge = float(run.start if step < 0 else run.stop)
        beyond = sum(section.length for section in (runs[: number - 1] if step < 0 else runs[number + 2 :]))
        if beyond < ROOFS.min_tail * car_length:
            continue
        if window > ROOFS.min_sunroof * car_length:
            return edge, ROOFS.unsure_beside * car_length
        if window > ROOFS.max_windscreen * car_length:
            return centre, abs(centre - edge)
    return centre, ROOFS.unsure * car_length


def _sides(car: Footprint, tracks: _Tracks, run: _Run) -> tuple[float, float, float, bool]:
    # Position halfway between the sides of a roof, and half their distance [half widths]; maximum error of
    # this position [pixel]; and whether both sides are visible.
    # A side is where brightness falls most steeply, else where side windows begin. A threshold would fail
    # under a low sun, where the side that leans away from it is darker than other paint. Paint as dark as
    # windows shows no fall.
    left_side, right_side = (_step(car, tracks.level, sign, run) for sign in (-1, 1))
    unsure = ROOFS.unsure_side_px
    if np.isnan(left_side) or np.isnan(right_side):
        left_side, right_side = (_window_edge(tracks, sign, run) for sign in (-1, 1))
        unsure = ROOFS.unsure_window_px
    are_visible = bool(np.isfinite(left_side) and np.isfinite(right_side))
    if not are_visible:
        unsure = ROOFS.unsure_width * (0.5 * car.width)
    if np.isnan(left_side) and np.isnan(right_side):
        left_side = right_side = ROOFS.roof_width
    left_side, right_side = (
        2 * ROOFS.roof_width - opposite if np.isnan(side) else side
        for side, opposite in ((left_side, right_side), (right_side, left_side))
    )
    return 0.5 * (right_side - left_side), 0.5 * (right_side + left_side), unsure, are_visible


def _step(car: Footprint, level: Floats, sign: int, run: _Run) -> float:
    # Distance from the axis to the first fall of brightness as at a window, on one side [half widths].
    # Median over the tracks of a section; NaN where too few tracks show such a fall.
    half_width = 0.5 * car.width
    distances = np.arange(ROOFS.side * half_width, ROOFS.beyond * half_width, ROOFS.step_px)
    along = np.arange(run.start + 0.5, run.stop) - 0.5 * car.length
    positions = _to_picture(car.centre, car.axis, along[:, None], sign * distances)
    profiles = map_coordinates(np.log(np.maximum(level, ROOFS.black)), positions, order=1, mode="nearest")
    span, stay = round(1.0 / ROOFS.step_px), round(max(1.0, ROOFS.window_width * half_width) / ROOFS.step_px)
    inner, outer = (
        profiles[:, : -span - stay],
        [profiles[:, span + n : profiles.shape[1] - stay + n] for n in range(stay)],
    )
    # at a window, unlike at a seam, all pixels beyond the fall are dark
    drop = inner - np.max(outer, axis=0)
    has_drop = (drop > ROOFS.min_step).any(axis=1)
    if has_drop.sum() < ROOFS.min_seen * has_drop.size:
        return np.nan
    fall_start = (drop[has_drop] > ROOFS.min_step).argmax(axis=1)
    steepest = [
        int((profile[at : at + span] - profile[at + span : at + 2 * span]).argmax())
        for profile, at in zip(profiles[has_drop], fall_start, strict=True)
    ]
    return float(np.median(distances[fall_start + steepest] + 0.5)) / half_width


def _window_edge(tracks: _Tracks, sign: int, run: _Run) -> float:
    # Distance from the axis where side windows begin, on one side [half widths].
    # Median over the tracks of a section; NaN without side windows.
    beside = tracks.within(run) & tracks.glass & (sign * tracks.across > ROOFS.side)
    nearest = np.full(run.length, np.inf)
    np.minimum.at(nearest, tracks.number[beside] - run.start, sign * tracks.across[beside])
    edges = nearest[np.isfinite(nearest)]
    return float(np.median(edges)) if edges.size >= ROOFS.min_seen * nearest.size else np.nan


def _runs(car: Footprint, tracks: _Tracks) -> list[_Run]:
    # Sections of paint and of windows from one end of the car to the other.
    # Short strips of paint between windows, as before a sunroof, are merged with the windows.
    middle = car.area & (np.abs(tracks.across) < ROOFS.middle)
    count, track = round(car.length), tracks.number[middle]
    counts = np.bincount(track, minlength=count)
    crossed = np.bincount(track, tracks.glass[middle], count) / np.maximum(counts, 1) > ROOFS.min_crossed
    ends = np.flatnonzero(np.diff(crossed.astype(np.int8), prepend=2, append=2))
    stretches = [
        _Run(a, b, bool(crossed[a])) for a, b in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True)
    ]
    merged: list[_Run] = []
    for number, run in enumerate(stretches):
        is_strip = 0 < number < len(stretches) - 1 and not run.is_window
        min_length = ROOFS.max_strip * car.length if is_strip else ROOFS.min_window_px
        if merged and (run.length < min_length or merged[-1].is_window == run.is_window):
            merged[-1] = _Run(merged[-1].start, run.stop, merged[-1].is_window)
        else:
            merged.append(run)
    return merged


# --- verdict on a piece: kind, uncertainty of its level, score ---------------------------------------------


@dataclass
class Verdict:
    # A piece, its measures, and the verdict on it.
    piece: Piece
    measures: Measures
    kind: str = ""  #: "roof", "panel", "metallic"; empty where it may not belong to a car.
    score: float = 0.0  #: Score from 0 to 1; the equation is in `propose_regions`.
    reasons: list[str] = field(default_factory=list)  #: Reasons to propose the piece.
    objections: list[str] = field(default_factory=list)  #: Reasons to refuse it; any objection refuses it.
    finish: str = "unknown"  #: "solid" or "metallic" where brightness and colour of a roof show it.
    #: Contributions to the relative standard uncertainty of its level, by their causes [1].
    level_terms: Mapping[str, float] = field(default_factory=dict)
    lean: float = np.nan  #: Standard deviation of its lean [degree].
    scenery: bool = False  #: Whether it looks like leaves, a shadow or a window, and is listed last.

    @property
    def level_sd(self) -> float:
        # Relative standard uncertainty of its level [1]; NaN without contributions.
        return float(np.hypot.reduce(list(self.level_terms.values()))) if self.level_terms else np.nan


class Level(NamedTuple):
    # Brightness of a part where it is level, its uncertainty, and its change with lean.
    brightness: float = 1.0  #: Brightness there, in the unit of the brightness passed.
    sd: float = 0.0  #: Its relative standard uncertainty from the fit and the position [1].
    along_change: float = 0.0  #: Its relative change with lean along the car [1/rad].
    across_change: float = 0.0  #: The same across it [1/rad].
    is_measured: bool = True  #: Whether the changes are measured on the crown of a roof, not assumed.

    @property
    def lean_change(self) -> float:
        # Largest relative change over lean in any direction [1/rad].
        return float(np.hypot(self.along_change, self.across_change))


def change_with_lean(zenith: float) -> float:
    # Return the relative change of the sunlight under a coat with lean towards the sun [1/rad].
    #
    # Takes ``zenith``: angle t of the sun to the normal of the body part [degree]. With the reflectance F of
    # the coat's interface, the change is -d ln(cos t (1 - F(t))) / dt: tan t, and a term for the larger
    # transmission of the coat at steeper incidence.
    angles = np.radians(min(zenith, MAX_SUN_ZENITH_DEG)) + np.array([-1e-3, 1e-3])
    light = np.log(np.cos(angles) * (1.0 - interface_reflectance(np.degrees(angles))))
    return float(light[0] - light[1]) / 2e-3


def judge_level(verdict: Verdict, picture: Picture, rake: float, level: Level, limits: Limits) -> None:
    # Add the uncertainty of a part's level, and visible flakes, to its verdict; object if it is too large.
    #
    # A small lean b towards the sun changes the light of a solid body by about f_dir tan(zenith) b, with the
    # direct share f_dir of the light, and the light of flakes by more. The change of brightness over the
    # crown of a roof, which leans by known angles, shows how much more. Takes ``rake``: standard deviation of
    # the part's unknown lean [degree].
    measures = verdict.measures
    if not measures.pixels:
        return
    zenith, direct = 45.0 if picture.zenith is None else picture.zenith, picture.direct_share
    slope = direct * change_with_lean(zenith)
    # the signature excludes the mirrored sky, too
    columns = slice(None) if picture.view is None else verdict.piece.window[1]
    mirrored, mirrored_u = (float(part[columns].mean()) for part in picture.sky)
    brightness = max(float(measures.spectrum.mean()) - mirrored, 1e-3)
    has_lobe = direct > JUDGING.min_direct and level.lean_change > JUDGING.max_solid_gain * slope
    contributions = {
        "noise and dust": JUDGING.least_sd,
        f"an unknown lean of {rake:.1f} degrees": float(np.radians(rake)) * max(slope, level.lean_change),
        "the position where it is level": level.sd,
        MIRRORED_SKY: mirrored_u / brightness,
        "glint in its pixels": 0.0 if has_lobe else JUDGING.glint_share_sd * measures.glint,
        "its low reflectance": JUDGING.mirror_sd / brightness,
        "broken clouds": GAPS.sd if picture.sun is not None else 0.0,
    }
    verdict.level_terms, verdict.lean = contributions, rake
    allowed = limits["max_level_u"] * max(1.0, JUDGING.dark / brightness)
    if has_lobe:  # over an uncertain lean, the slope of a lobe changes, too
        allowed *= JUDGING.lobe_part
    half_width = JUDGING.coverage * verdict.level_sd
    largest = max(contributions, key=contributions.__getitem__)
    text = f"its level is within {half_width:.1%} (95 %), mainly for {largest}"
    if has_lobe and level.is_measured:
        text += (
            f"; its brightness changes by {np.radians(level.lean_change):.0%} a degree of lean, like flakes"
        )
    if half_width <= allowed:
        verdict.reasons.append(text)
    else:
        advice = "raise max_level_u, fly under a higher sun, or draw a region on a level part"
        verdict.objections.append(f"{text}, expected at most {allowed:.1%}; {advice}")


def judge_pixels(verdict: Verdict, picture: Picture, limits: Limits) -> None:
    # Add the measures and the score to a verdict; object to too few pixels, to mixed colours, and to shade.
    measures = verdict.measures
    lost = ", ".join(f"{share:.0%} {reason}" for reason, share in measures.lost.items() if share >= 0.01)
    excluded = f" (excluded: {lost})" if lost else ""
    if measures.pixels < limits["min_pixels"]:
        verdict.objections.append(
            f"{measures.pixels} usable pixels, expected at least {limits['min_pixels']}{excluded}"
        )
        return
    verdict.reasons.append(f"{measures.pixels} pixels{excluded}")
    if measures.angle > limits["angle"]:
        verdict.objections.append(f"not homogeneous: spectra differ by {measures.angle:.1f} degrees")
    # white, grey and black paint in the shade of a wall has the colour of the sky; no edge of the shade shows
    # where it covers a whole car
    beyond = picture.model.channel_wavelength > JUDGING.white_from_nm
    sky_light = picture.model.diffuse_fraction[beyond]
    is_shaded = _cosine(measures.spectrum[beyond], sky_light) > JUDGING.sky_cosine
    if picture.direct_share > JUDGING.min_direct and is_shaded:
        verdict.objections.append(
            "it has the colour of the light of the sky: it may lie in shade; draw a region by hand"
        )
    verdict.reasons.append(
        f"homogeneous to {measures.angle:.1f} degrees, brightness to {measures.spread:.1%}; "
        f"glint {measures.glint:.3f}, light of neighbours {measures.adjacency:.3f}"
    )
    homogeneity = 1.0 / (1.0 + (measures.angle / JUDGING.half_angle_deg) ** 2)
    penalty = (
        measures.adjacency / JUDGING.half_adjacency
        + measures.glint / JUDGING.half_glint
        + measures.spread / JUDGING.half_spread
    )
    verdict.score = float(min(1.0, measures.pixels / JUDGING.enough_px) * homogeneity / (1.0 + penalty))


# --- brightness of a roof where it is level, with its uncertainty ------------------------------------------


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
        # Lean half a width away, along and across the car (2,) [radian].
        along = 2.0 * LEVELS.drop * self.half_width / self.half_length
        limits = np.radians([LEVELS.max_crown_deg, LEVELS.crown_deg])
        return np.asarray([min(along, float(limits[0])), limits[1]])


def level_place(footprint: Footprint, roof: Roof) -> Place:
    # Return where a roof is level: along the car from its windows, across it from the roof's edges.
    #
    # A car is symmetric, so that its roof is level halfway between its edges. An edge lies where the
    # logarithm of brightness falls most steeply: shading changes brightness by factors, so that its plain
    # difference would shift the edge on the darker side inwards.
    along, across = _to_car(roof.centre, roof.axis, *np.nonzero(roof.inside))
    half_width = max(float(np.abs(across).max()) / ROOFS.used_width, 1.0)
    tracks = np.arange(np.ceil(along.min()), np.floor(along.max()) + 1.0)
    # median over all tracks at each distance across, robust against roof rails and antennas
    aside = np.arange(0.0, LEVELS.edge_span[1] * half_width + 2.0 * LEVELS.edge_px, 1.0 / LEVELS.steps_per_px)
    edges = []
    for sign in (-1.0, 1.0):
        positions = _to_picture(roof.centre, roof.axis, tracks[:, None], sign * aside)
        samples = map_coordinates(footprint.brightness, positions, np.float64, order=1, mode="nearest")
        edges.append(sign * _edge(aside, np.nanmedian(samples, axis=0), half_width))
    shift = 0.5 * (edges[0] + edges[1])
    # standard deviation of a uniform distribution over the possible range
    along_sd, across_sd = (limit / float(np.sqrt(3.0)) for limit in (roof.unsure, roof.unsure_across))
    if np.isfinite(shift):
        half_width, across_sd = 0.5 * (edges[1] - edges[0]), LEVELS.edged_sd_px
    else:
        # an edge is not visible, or too far from the windows
        shift, across_sd = 0.0, max(across_sd, LEVELS.edged_sd_px)
    line, column = _to_picture(roof.centre, roof.axis, 0.0, shift)
    return Place(
        float(line), float(column), along_sd, across_sd, half_width, max(0.5 * float(np.ptp(along)), 1.0)
    )


def _to_car(centre: tuple[float, float] | Floats, axis: Floats, y: Array, x: Array) -> tuple[Floats, Floats]:
    # Distances from the centre of a car, along and across it [pixel]
    y, x = np.asarray(y - centre[0], np.float64), np.asarray(x - centre[1], np.float64)
    return y * axis[0] + x * axis[1], y * axis[1] - x * axis[0]


def _to_picture(
    centre: tuple[float, float] | Floats, axis: Floats, along: Any, across: Any
) -> tuple[Any, Any]:
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


def level_light(brightness: Floats, lit: Bools, place: Place, axis: Floats) -> Level | None:
    # Return the brightness of a roof where it is level; None where too little of it is visible.
    #
    # The lean of a crowned roof grows in proportion to the distance from its level position. The logarithm of
    # its brightness is therefore a smooth function of position: a plane for solid paint, curved by the lobe
    # of flakes. A surface of second order replaces the plane where it fits significantly better by the
    # Bayesian information criterion (Schwarz 1978). Glint lies above the surface; iterations exclude it.
    #
    # Takes ``brightness`` (line, column): brightness of the roof [1]; ``lit`` (line, column): the pixels
    # fitted; ``place``: its level position in the same window; ``axis`` (2,): direction (line, column) along
    # the car.
    y, x = np.nonzero(lit & (brightness > 0.0))
    along, across = _to_car((place.line, place.column), axis, y, x)
    u, v = along / place.half_width, across / place.half_width
    near = (np.abs(u) < LEVELS.fitted[0]) & (np.abs(v) < LEVELS.fitted[1])
    if near.sum() < LEVELS.min_fitted_px:
        return None
    u, v, logs = u[near], v[near], np.log(brightness[y[near], x[near]])
    terms = np.stack([np.ones(u.size), u, v, u * u, u * v, v * v], axis=1)
    plane, quadric = fitted_surface(terms[:, :3], logs), fitted_surface(terms, logs)
    independent_px = u.size / LEVELS.clump_px
    gain = independent_px * np.log(plane[1] ** 2 / quadric[1] ** 2)
    fitted, _, fit_sd = quadric if gain > 3.0 * np.log(max(independent_px, 2.0)) else plane
    slope = fitted[1:3]
    place_sd = np.hypot(*(slope * np.array([place.along_sd, place.across_sd]) / place.half_width))
    change = np.abs(slope) / place.crown
    sd = float(np.hypot(fit_sd, place_sd))
    return Level(float(np.exp(fitted[0])), sd, float(change[0]), float(change[1]))


def fitted_surface(design: Floats, logs: Floats) -> tuple[Floats, float, float]:
    # Fit of logarithms of brightness (pixel,) with a design matrix (pixel, term): value at the origin, slopes
    # and curvatures (term,); root mean square of the residuals; standard error of the value at the origin [1]
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
    return terms, rms, rms * float(np.sqrt(LEVELS.clump_px * inverse[0, 0]))


# --- finish of a roof, solid or with flakes, from the change of its light over its crown -------------------


def difference_of(piece: Piece, picture: Picture, relative: Floats) -> tuple[float, float] | None:
    # Return the difference of the brightest and darkest quarters of a roof; None with too few pixels.
    #
    # The share of its grey part, equal in all channels under direct light, and its contrast: the length of
    # the difference over the length of the mean spectrum [1].
    #
    # A lean b changes the direct light of a solid body r by d = f_dir (r s b + g), with a grey part g: the
    # sun mirrored by the coat. Flakes add their reflection to g. Takes ``relative`` (line, column):
    # brightness relative to the level position; values over 1.6 or under 0.5 are glint or another part.
    diffuse = picture.model.diffuse_fraction
    chosen = piece.inside & (np.abs(relative - 1.05) < 0.55)
    if chosen.sum() < FINISHES.min_px:
        return None
    body, relative = picture.without_sky(piece.window)[chosen].astype(np.float64), relative[chosen]
    low, high = np.quantile(relative, [0.25, 0.75])
    difference = body[relative >= high].mean(axis=0) - body[relative <= low].mean(axis=0)
    spectrum, direct = body.mean(axis=0), 1.0 - diffuse
    coloured, flat = np.linalg.lstsq(np.stack([spectrum * direct, direct], axis=1), difference, rcond=None)[0]
    coloured_mean, flat_mean = float(coloured * (spectrum * direct).mean()), float(flat * direct.mean())
    contrast = float(np.linalg.norm(difference)) / max(float(np.linalg.norm(spectrum)), 1e-9)
    return flat_mean / max(abs(coloured_mean + flat_mean), 1e-9), contrast


def judge_finish(
    verdict: Verdict, picture: Picture, level: Level, difference: tuple[float, float] | None
) -> None:
    # Add the finish of a roof and its evidence to the verdict; without evidence it stays unknown.
    spectrum, zenith = verdict.measures.spectrum, picture.zenith
    if (
        not verdict.measures.pixels
        or zenith is None
        or picture.direct_share < FINISHES.min_direct
        or zenith > FINISHES.max_zenith_deg
        or float(spectrum.mean()) < FINISHES.min_level
    ):
        return
    solid = picture.direct_share * change_with_lean(zenith)
    across, along = level.across_change, level.along_change
    low, high = FINISHES.solid_zenith_deg
    changes = f"its light changes by {np.radians(level.lean_change):.1%} a degree of lean"
    if across > FINISHES.metallic_across * solid + FINISHES.offset or (
        zenith >= high and along > FINISHES.metallic_along * solid + FINISHES.offset
    ):
        verdict.finish = "metallic"
        verdict.reasons.append(f"metallic: {changes}, that of solid paint by {np.radians(solid):.1%}")
    elif (
        low <= zenith <= high
        and level.lean_change < FINISHES.max_solid_change
        and float(spectrum.mean()) < FINISHES.max_solid_level
    ):
        verdict.finish = "solid"
        verdict.reasons.append(f"solid: {changes}; flakes so near the sun's mirror image change more")
    elif difference is not None and spectrum.std() > FINISHES.min_colour * spectrum.mean():
        # coloured paint: by the difference of its bright and its dark part
        share, contrast = difference
        is_solid = (
            zenith <= FINISHES.max_coloured_zenith_deg
            and across < FINISHES.max_coloured[0] * solid
            and along < FINISHES.max_coloured[1] * solid
            and abs(share) < FINISHES.max_flat_share
        )
        text = f"{abs(share):.0%} of the difference between its bright and its dark part is grey"
        if contrast >= FINISHES.min_contrast and share > FINISHES.metallic_flat_share:
            verdict.finish = "metallic"
            verdict.reasons.append(f"metallic: {text}, and flakes mirror all colours")
        elif contrast >= FINISHES.min_contrast and is_solid:
            verdict.finish = "solid"
            verdict.reasons.append(f"solid: only {text}, and flakes would mirror all colours")


# --- cars and their parts ----------------------------------------------------------------------------------

#: Number of pieces after which memory is returned to the system.
_PIECES = 8
#: Rank of a roof between windows, or behind a windscreen, on a footprint of one car.
_CERTAIN = 5


class Car(NamedTuple):
    # Pieces of the picture that belong to one car, its footprint and its roof.
    pieces: list[Piece]
    #: Footprint around one of the pieces; None where its colour extends farther than a car.
    footprint: Footprint | None = None
    roof: Roof | NoRoof = NoRoof("its colour extends farther than a car: it may not belong to one", False)
    #: Whether its colour extends farther than a car whatever else is joined.
    is_endless: bool = False

    @property
    def is_car(self) -> bool:
        # Whether windows show that the footprint is a car.
        return self.roof.is_car if isinstance(self.roof, NoRoof) else True

    @property
    def size(self) -> int:
        # Number of pixels.
        return 0 if self.footprint is None else int(self.footprint.area.sum())

    @property
    def rank(self) -> tuple[int, int]:
        # Certainty of the roof, `_CERTAIN` at most, and the size.
        if self.footprint is None or isinstance(self.roof, NoRoof):
            return int(self.footprint is not None) + int(self.is_car), self.size
        return (
            (3, self.size)
            if not self.footprint.is_one_car
            else (_CERTAIN - int(not (self.roof.complete or self.roof.sided)), self.size)
        )

    def unless_larger(self, max_size: float) -> "Car":
        # Return the car, without a roof where it has more pixels than cars have.
        reason = "it is larger than other cars: several of one colour may touch; draw a region by hand"
        return self if self.size <= max_size else self._replace(roof=NoRoof(reason, False))


def find_cars(pieces: Iterable[Piece], picture: Picture, progress: Progress | None = None) -> list[Car]:
    # Return the cars around pieces of paint, the most certain first.
    #
    # ``progress`` counts the pieces of the first round, which takes longest, as a share of the lines.
    # The largest pieces are examined first, those as dark as windows last. A piece with a certain roof is a
    # car. A piece with less evidence is a car only outside the certain cars.
    car_park = CarPark(picture)

    def order(piece: Piece) -> tuple[bool, int, tuple[int, int], int]:
        level = float(np.median(picture.level[piece.window][piece.inside]))
        return level < SURFACES.dark, -int(piece.inside.sum()), piece.origin, piece.body

    # certain cars with paint of narrow brightness, then again without footprints larger than most cars
    narrow, wide = JOININGS[:4], JOININGS[4:]
    singles = [Car([piece]) for piece in sorted(pieces, key=order)]
    uncertain = car_park.add_certain(singles, narrow, np.inf, progress)
    max_size = car_park.max_size
    uncertain += car_park.add_certain(
        [Car([piece]) for piece in car_park.remove_larger(max_size)], narrow, max_size
    )
    # certain cars with paint of wide brightness, then the best uncertain ones beside them
    uncertain = car_park.add_certain([car.unless_larger(max_size) for car in uncertain], wide, max_size)
    for car in sorted(uncertain, key=lambda car: car.rank, reverse=True):
        if not car_park.assign(car.pieces[0]):
            car_park.add(car)
    return car_park.cars


class CarPark:
    # Cars of a picture, and maps of the car number of every pixel, -1 without a car
    def __init__(self, picture: Picture) -> None:
        self.cars: list[Car] = []
        self._sizes: list[int] = []
        self._picture = picture
        self._area = np.full(picture.level.shape, -1, np.int32)
        self._paint = self._area.copy()

    @property
    def max_size(self) -> float:
        # Maximum size of a car, from the sizes of the cars [pixel]
        known = len(self._sizes) >= CARS.min_sizes
        return CARS.max_size * float(np.median(self._sizes)) if known else np.inf

    def add_certain(
        self,
        cars: list[Car],
        joinings: Sequence[tuple[bool, bool, bool]],
        max_size: float,
        progress: Progress | None = None,
    ) -> list[Car]:
        # Add the certain cars around pieces; return the best cars around the other pieces
        # Pieces that show no car before sizes of cars are known wait for these: without a limit, colour that
        # extends over the line would be followed to its end.
        uncertain, lines, queue = [], len(self._area), list(cars)
        for done, best in enumerate(queue, start=1):
            if progress is not None:
                progress(lines * done // len(queue), lines)
            if done % _PIECES == 0:
                trim_memory()
            piece = best.pieces[0]
            if self.assign(piece):
                continue
            if best.is_endless:
                uncertain.append(best)
                continue
            colour = np.median(self._picture.without_sky(piece.window)[piece.inside], axis=0)
            limit = min(max_size, self.max_size)
            waits = np.isinf(limit) and done <= len(cars)
            if waits:
                limit = CARS.max_first_size * piece.inside.sum()
            for footprint in footprints_of(
                piece.inside, piece.origin, colour, self._picture, joinings, limit
            ):
                if footprint is None:
                    best = best._replace(is_endless=True)
                    break
                car = Car(
                    [piece], footprint, find_roof(footprint, self._picture.level[footprint.window])
                ).unless_larger(max_size)
                best = max(best, car, key=lambda car: car.rank[0])
                if best.rank[0] == _CERTAIN:
                    break
            if best.rank[0] == _CERTAIN:
                self.add(best)
            elif waits:
                queue.append(cars[done - 1])
            else:
                if best.footprint is not None and not best.is_car:
                    area = best.footprint.area
                    only_area = best.footprint._replace(paint=area, brightness=np.empty(0, np.float32))
                    best = best._replace(footprint=only_area)
                uncertain.append(best)
        return uncertain

    def remove_larger(self, max_size: float) -> list[Piece]:
        # Remove cars with more pixels, which are several cars side by side; return their pieces
        is_kept = [size <= max_size for size in self._sizes]
        # new number of every car; the last entry keeps -1
        numbers = np.append(np.where(is_kept, np.cumsum(is_kept) - 1, -1), -1).astype(np.int32)
        self._area, self._paint = numbers[self._area], numbers[self._paint]
        removed = [car for car, keep in zip(self.cars, is_kept, strict=True) if not keep]
        self.cars = [car for car, keep in zip(self.cars, is_kept, strict=True) if keep]
        self._sizes = [size for size in self._sizes if size <= max_size]
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

    def add(self, car: Car) -> None:
        # Add a piece to the car that its footprint overlaps most, or as a new car
        footprint = car.footprint
        if footprint is not None:
            numbers = self._area[footprint.window][footprint.area]
            shared = np.bincount(numbers[numbers >= 0], minlength=1)
            overlapped = int(shared.argmax())
            smaller = min(car.size, self._sizes[overlapped]) if shared.any() else 0
            if shared[overlapped] > CARS.min_overlap * smaller:
                self.cars[overlapped].pieces.extend(car.pieces)
                return
        self.cars.append(car)
        self._sizes.append(car.size)
        if footprint is not None and car.is_car:
            # other footprints, such as unusual ground, get no further pieces
            for car_numbers, mask in (
                (self._area, footprint.area),
                (self._paint, footprint.area & footprint.paint),
            ):
                view = car_numbers[footprint.window]
                view[mask & (view < 0)] = len(self.cars) - 1


def judge_car(car: Car, picture: Picture, limits: Limits) -> list[Verdict]:
    # Return the verdicts on a car's roof and on the other pieces of its paint; at most one is proposed.
    roof = (
        _judge_roof(car.footprint, car.roof, picture, limits)
        if isinstance(car.roof, Roof) and car.footprint is not None
        else None
    )
    parts = [_judge_part(piece, car, picture, limits) for piece in car.pieces]
    verdicts = parts if roof is None else [roof, *parts]
    for verdict in verdicts:
        if doubt := doubt_about_clouds(verdict.piece.window, picture):
            verdict.objections.append(doubt)
    best = roof if roof is not None and not roof.objections else None
    if best is None and roof is not None and roof.measures.pixels:
        # an error of the level position affects the other parts, too
        for part in parts:
            part.objections.append("the roof of the same car is refused")
    elif best is None:
        best = max((part for part in parts if not part.objections), key=lambda part: part.score, default=None)
    if best is not None:
        y, x = best.piece.centre
        objection = f"another part of the same car is better: the one at line {y:.0f}, column {x:.0f}"
        for part in parts:
            if part is not best and not part.objections:
                part.objections.append(objection)
    return verdicts


def _judge_roof(footprint: Footprint, roof: Roof, picture: Picture, limits: Limits) -> Verdict | None:
    # Verdict on a roof; None where all its pixels are near edges
    #
    # Its pixels are away from other colours. Pixels brighter than the car's other paint count as paint: they
    # lie in the lobe of flakes, or in glint.
    paint = footprint.paint | (footprint.brightness >= FOOTPRINTS.brightness[0][1])
    inside = roof.inside & (depth_of(np.pad(paint, 1))[1:-1, 1:-1] > limits["erode"])
    segment = picture.model.segment[footprint.window][inside]
    bodies = picture.model.body[segment[segment >= 0]]
    if not bodies.size:
        return None
    window = find_objects(inside.view(np.int8))[0]
    y, x = (side.start for side in window)
    origin = footprint.origin[0] + y, footprint.origin[1] + x
    piece = Piece(int(np.bincount(bodies).argmax()), origin, inside[window])
    brightness = footprint.brightness[window_of((y, x), piece.inside)].astype(np.float64)
    prior = lean_to_sun(roof.axis, picture.shadow_side)
    if not roof.is_whole:
        prior = float(np.hypot(prior, JUDGING.part_deg))
    lit = piece.inside & (picture.layers["blocked_direct"][piece.window] < limits["shadow"])
    # where it is level, by its edges, and by the height model
    place = level_place(footprint, roof)
    centre = (place.line - y, place.column - x)
    rake, shift, angle = measured_lean(
        picture.heights, piece.window, piece.inside, centre, prior, picture.shadow_side
    )
    place = place._replace(line=centre[0] + shift[0], column=centre[1] + shift[1])
    text = f"by the height model it leans by {angle:+.1f} degrees towards the sun"
    reasons = [roof.reason, *([text] if np.isfinite(angle) else [])]
    level, objection = None, f"{text}, and has no level position; draw a region on a level part"
    lines, columns = piece.inside.shape
    is_inside = -1.0 <= place.line <= lines and -1.0 <= place.column <= columns
    if is_inside or not np.isfinite(angle):
        level = level_light(brightness, lit, place, roof.axis)
        objection = "too few lit pixels near the level position of the roof for its brightness"
    if level is None:
        return Verdict(piece, measured(piece, picture, limits), "roof", 0.0, reasons, [objection])
    # pixels near the level brightness; a wider range where these are too few
    relative = brightness / level.brightness
    for factor in CARS.wider:
        widened = {"glint": np.inf, "adjacency": np.inf, "brightness": factor * limits["brightness"]}
        measures = measured(piece, picture, {**limits, **widened}, relative)
        if measures.pixels >= limits["min_pixels"]:
            break
    # mean difference of the usable pixels from the level position
    offset = float(relative[measures.usable].mean()) - 1.0 if measures.pixels else 0.0
    level = level._replace(sd=float(np.hypot(level.sd, offset)))
    verdict = Verdict(piece, measures, "roof", reasons=reasons)
    judge_pixels(verdict, picture, limits)
    judge_level(verdict, picture, rake, level, limits)
    judge_finish(verdict, picture, level, difference_of(piece, picture, relative))
    if verdict.finish == "metallic":
        verdict.kind = "metallic"
    _judge_windows(verdict, footprint, roof, picture)
    slenderness = footprint.length / footprint.width
    if not (footprint.is_one_car or footprint.cut):
        verdict.objections.append(
            f"the paint around it is {slenderness:.1f} times as long as wide, unlike one car: its level "
            "position is unknown; draw a region by hand"
        )
    return verdict


def _judge_windows(verdict: Verdict, footprint: Footprint, roof: Roof, picture: Picture) -> None:
    level = picture.level[footprint.window]
    paint_level = float(np.nanmedian(level[footprint.paint & footprint.area]))
    step = paint_level - roof.window_level
    if step < max(JUDGING.min_window_step, JUDGING.min_window_contrast * paint_level):
        verdict.objections.append(
            f"the windows beside it are darker by only {step:.4f}: it may itself be a window; draw a region "
            "by hand"
        )
    if paint_level >= SURFACES.dark:
        return
    other_paint = level[footprint.paint & footprint.area & ~roof.inside]
    ratio = np.nanmedian(level[roof.inside]) / np.nanmedian(other_paint) if other_paint.size else np.nan
    if not ((roof.complete or roof.sided) and JUDGING.dark_roof[0] < ratio < JUDGING.dark_roof[1]):
        verdict.objections.append(
            "a dark roof needs the same paint beyond both its windows, or a bonnet before its windscreen and "
            "side windows: this may be a window or a bed; draw a region by hand"
        )


def _judge_part(piece: Piece, car: Car, picture: Picture, limits: Limits) -> Verdict:
    measures = measured(piece, picture, limits)
    spectrum, mean_level = measures.spectrum, float(measures.spectrum.mean()) if measures.pixels else 0.0
    if not car.is_car or car.footprint is None:
        return Verdict(piece, measures, objections=[car.roof.reason], scenery=mean_level < SURFACES.dark)
    verdict = Verdict(piece, measures, "panel")
    if car.rank[0] < _CERTAIN:
        verdict.objections.append(
            "its car has no certain roof: it may belong to another car, or be ground between cars; draw a "
            "region by hand"
        )
    verdict.reasons.append("part of a car with windows across it and along it")
    judge_pixels(verdict, picture, limits)
    assumed = Level(along_change=JUDGING.unseen_change * picture.direct_share, is_measured=False)
    judge_level(verdict, picture, JUDGING.panel_deg, assumed, limits)
    if measures.pixels:
        # colour and brightness like the car's other paint
        of_roof = car.roof.inside if isinstance(car.roof, Roof) else car.footprint.paint & car.footprint.area
        car_spectrum = np.nanmedian(picture.channels[car.footprint.window][of_roof], axis=0)
        slope = picture.direct_share * float(
            np.tan(np.radians(45.0 if picture.zenith is None else picture.zenith))
        )
        ratio = float(spectrum.mean() / car_spectrum.mean())
        allowed = max(CARS.max_step, CARS.max_lean * slope)
        if _cosine(spectrum, car_spectrum) < FOOTPRINTS.min_cosine:
            verdict.objections.append(
                "its colour differs from the car's paint: it may be a window, a bed or a load"
            )
        elif abs(ratio - 1.0) > allowed:
            verdict.objections.append(
                f"it is {ratio:.2f} times as bright as the car's other paint, while lean explains at most "
                f"{allowed:.0%}: it may be a shadow, a bed, or paint with flakes; draw a region on the roof"
            )
        # a spectrum like the ground's, lit or in shade
        max_length = float(np.exp(FOOTPRINTS.max_ground_log_ratio)) * float(np.linalg.norm(picture.ground))
        is_like_ground = _cosine(spectrum, picture.ground) > FOOTPRINTS.min_cosine
        if is_like_ground and float(np.linalg.norm(spectrum)) < max_length:
            verdict.objections.append(
                "it has the colour of the ground, and is no brighter; draw a region by hand"
            )
    if mean_level < SURFACES.dark:
        verdict.objections.append("it is as dark as a window, and not the roof")
    return verdict


def _cosine(first: Floats, second: Floats) -> float:
    return float(first @ second) / max(float(np.linalg.norm(first) * np.linalg.norm(second)), 1e-9)


#: Steps (line, column) right, down, left, up, clockwise: a right turn is the next step.
_STEPS = ((0, 1), (1, 0), (0, -1), (-1, 0))


def outline(mask: Bools, origin: tuple[int, int] = (0, 0)) -> tuple[Floats, tuple[Floats, ...]]:
    """Return the ring around a connected set of pixels, and those around its holes.

    Takes ``mask`` (line, column): the pixels; neighbours share a side; ``first``: line and column of the
    first pixel of ``mask`` in the flight line. Rings are x (column) and y (line) of corners (vertex, 2),
    halfway between pixel centres.

    Examples
    --------
    >>> outline(np.ones((1, 2), bool), (4, 10))[0].tolist()
    [[9.5, 3.5], [11.5, 3.5], [11.5, 4.5], [9.5, 4.5]]
    """
    # sides of the mask that begin at every corner, as indices into `_STEPS`; the mask is on their right
    padded = np.pad(mask, 1)
    neighbours = (padded[:-2, 1:-1], padded[1:-1, 2:], padded[2:, 1:-1], padded[1:-1, :-2])
    # corner of a pixel where its upper, right, lower, left side begins
    corners = ((0, 0), (0, 1), (1, 1), (1, 0))
    sides: dict[tuple[int, int], list[int]] = grouped(
        ((line + dy, column + dx), direction)
        for direction, (neighbour, (dy, dx)) in enumerate(zip(neighbours, corners, strict=True))
        for line, column in np.argwhere(mask & ~neighbour).tolist()
    )
    rings = []
    while sides:
        # start at the first corner in line order: the first ring then is the outer ring
        corner = start = min(sides)
        direction, previous = min(sides[start]), -1
        ring: list[tuple[int, int]] = []
        rings.append(ring)
        while corner in sides and not (ring and corner == start):
            directions = sides[corner]
            if ring:
                # where two pixels touch only at this corner, the right turn stays with the current pixel
                direction = min(directions, key=lambda candidate: (candidate - previous - 1) % 4)
            directions.remove(direction)
            if not directions:
                del sides[corner]
            if direction != previous:
                ring.append(corner)
            corner = (corner[0] + _STEPS[direction][0], corner[1] + _STEPS[direction][1])
            previous = direction
    offset = np.array([origin[1] - 0.5, origin[0] - 0.5])
    outlines = [np.array([(x, y) for y, x in ring], np.float64) + offset for ring in rings]
    return outlines[0], tuple(outlines[1:])


#: Flags that a signature of a proposed region excludes; brightness has already excluded glint and adjacency.
_EXCLUDED_FLAGS = Quality.SATURATED | Quality.IRRADIANCE_GAP | Quality.NO_DATA | Quality.SHADOW

_DIMS = (schema.ALONG_TRACK, schema.CROSS_TRACK)
#: Variables of a flagged line that proposals use.
_LAYERS = ("glint_fraction", "blocked_direct", "adjacency", "quality")


@dataclass(frozen=True)
class Proposals(Regions):
    """Proposed regions, best first, and the refused pieces.

    Attributes
    ----------
    refused
        Every examined piece with an objection, those that look like windows, shadows or leaves last; the
        property ``refused`` lists the objections. Writing the proposals does not write these pieces. Three
        kinds of pieces are not examined: bodies with the colour of the ground, pixels in cast shadow, and
        pieces with fewer than a quarter of ``min_pixels`` pixels away from edges. So a car with the colour of
        the ground is in neither list; nor are regions that exceed ``most``.

    Examples
    --------
    >>> from hyperpaint.regions import Region, Regions
    >>> pane = Region("refused_01", [(6, 0), (9, 0), (9, 3)], properties={"refused": "a window"})
    >>> proposals = Proposals((Region("red-01", [(0, 0), (4, 0), (4, 3)]),), refused=Regions((pane,)))
    >>> len(proposals), proposals.refused[0].properties["refused"]
    (1, 'a window')
    """

    refused: Regions = field(default_factory=lambda: Regions(()))

    def table(self) -> str:
        """Return a line of text for every proposed and every refused region."""
        proposed = (
            f"{region.name}  at {region.properties['place']}  score {region.properties['score']:.2f}  "
            f"{'; '.join(region.properties['reasons'])}"
            for region in self.regions
        )
        refused = (f"{region.name}  {'; '.join(region.properties['refused'])}" for region in self.refused)
        return "\n".join([*proposed, *refused])


@takes_quantities(angle="degree", sun_zenith="degree", sun_azimuth="degree", heading="degree")
@documented()
def propose_regions(
    line: xr.Dataset,
    model: SceneModel | xr.Dataset | None = None,
    *,
    most: int | None = None,
    min_pixels: int = 40,
    erode: int = 3,
    glint: float = 0.02,
    shadow: float = 0.2,
    adjacency: float = 0.02,
    brightness: float = 0.03,
    angle: float = 5.0,
    max_level_u: float = 0.15,
    flightline: str = "",
    name: str = "",
    progress: Progress | bool | None = None,
    **options: Any,
) -> Proposals:
    r"""Propose regions of car paint, best first, each with its reasons, and list the refused pieces.

    Eager: reads the line once, and once more for the scene model without ``model``. Layers of
    `hyperpaint.surroundings.flag` that the line has are used. Results have the same
    bits for any chunking. The rules use only the common proportions of cars:

    * Pieces are connected parts of a body of the scene model, away from its edges, not in cast shadow,
      and neither like the ground (the largest body) nor like leaves (steep red edge, then flat).
    * A car is the area between the thick parts of a piece's colour, pixel by pixel: parts that are connected
      or, where these show no roof, separated by dark pixels only, or as bright as flakes at another lean. It
      contains no lit ground. Cars whose roof is certain from proportions and windows come first; a car 1.8
      times larger than most of them is several cars of one colour.
    * Windows are dark and cross the car. The roof lies between two of them, or has one at an end and others
      along its sides, or is longer than any bonnet. It is level in its middle; a window longer than any
      windscreen contains a sunroof, and the roof is level beside it.
    * Across, the roof is level halfway between its edges. Its brightness there is the value of a smooth
      surface through the logarithm of its brightness nearby; glint lies above the surface. The largest
      connected set of pixels with a brightness within 3 % of this value is used, or within 6 to 12 % if that
      is too small. ``glint`` and ``adjacency`` do not apply to a roof: brightness shows glint, and
      no neighbour is higher.
    * The uncertainty of its level follows from the uncertainty of that place and from an unknown lean of 0.5
      degrees across the car and 0.8 along it (parking areas are drained), times the change of light over its
      crown: roofs curve by 12 degrees over half their width, and by up to 5 over the same length. A roof
      without side windows may be a bonnet; it, a strip beside a sunroof, and a short roof behind one window,
      such as a pickup's, lean by 2 degrees more. A third
      of the glint in its pixels, and the sky that the coat mirrors to the camera, are uncertain, too. A
      region is refused if 1.96 times the result exceeds ``max_level_u``, near the lobe of flakes 3/4 of it.
      The property ``level_terms`` holds the contributions, and ``level_uncertainty`` their sum without the
      mirrored sky, which signatures state themselves.
      Where the line has the heights of surfaces, as `hyperpaint.geometry.locate` adds them from a ``dem``
      that shows cars, lean and level place are also estimated from them.
    * Under broken clouds a car is judged only where the record had free sun for 10 s before and after, and a
      shadow beside the car shows free sun, too.
    * ``finish`` is "metallic" where its light changes with lean more than for any solid paint, or where the
      change is grey on coloured paint, and so is ``kind``; "solid" where the sun is 20 to 32 degrees from the
      zenith and almost nothing changes on paint that is not white, or where coloured paint changes as a solid
      paint does, under a sun up to 45 degrees, and the change has its own colour. Else it is "unknown": far
      from the sun's mirror image flakes look like solid paint. A signature of paint with flakes holds for
      this sun and view only.
    * Another part of a car may lean by 7 degrees or more, and is used only where the car's roof is certain
      but has no usable pixels, and the part's level is certain enough. Pixels without glint, shadow or light
      from coloured neighbours are used, with a brightness within 3 % of the part's median. Its colour and
      brightness must agree with the roof, and differ from the ground.
    * Paint within 5 degrees of the colour of the light of the sky is refused: it may lie in the shade of a
      wall, which covers a whole car without an edge.
    * Black paint is distinguished from windows by still darker windows, and from cast shadows by those of the
      scene model. A black roof lies between windows with paint beyond both, or has a bonnet before its
      windscreen and windows along it. Else it is the middle of the side windows, which are darker as they
      lean: windscreens mirror as much sky as the paint.
    * Each car gives one region.

    Parameters
    ----------
    line
    model
        From `hyperpaint.surroundings.survey` of the same line; by default surveyed with ``options``.
    most
        Maximum number of regions; by default all.
    min_pixels
        Minimum number of pixels of a region.
    erode
        Distance from the edge of a body within which pixels are left out [pixel].
    glint, shadow, adjacency
        Largest ``glint_fraction``, ``blocked_direct`` and, as a mean over 5 x 5 pixels, ``adjacency`` of a
        pixel, see `hyperpaint.surroundings.flag` [1]; for a roof only ``blocked_direct``.
    brightness
        Largest relative difference of a pixel, as a mean over 5 x 5, from the middle of a roof or the median
        of another piece; for dark paint at least 0.005 in reflectance [1].
    angle
        Largest median spectral angle to the median [degree].
    max_level_u
        Largest half width of the 95 % interval of the level, relative to the level, and of paint with a
        reflectance below 0.03 relative to 0.03 [1].
    flightline
        Name of the flight line, stored in the regions.
    name
        Prefix of the names of the regions, which are a colour and a number along the line: ``red-02`` is the
        second red paint from the start, whatever ``most`` is; `hyperpaint.light.daylight_colours.COLOURS`
        lists the words.
    progress
        See `hyperpaint.surroundings.survey`, which reports first without ``model``; then the search for cars.
    **options
        Options of `hyperpaint.surroundings.survey`; ``sun_zenith`` also applies with ``model``.

    Returns
    -------
    Proposals
        `Regions` with properties ``rank``, ``score``, ``kind`` ("roof", "panel", "metallic"), ``finish``
        ("solid", "metallic", "unknown"), ``place`` (line and column of its centre, and position),
        ``latitude``, ``longitude`` [degree, WGS 84] where the line has ground positions, or poses and the
        height of the ground, as `hyperpaint.geometry.locate` takes them, ``level_uncertainty`` (standard,
        relative, without that of the mirrored sky) [1], ``level_terms`` (standard contributions to the
        uncertainty of the level by cause, relative) [1], ``lean`` (standard deviation) [degree],
        ``pixels``, ``spectral_angle`` [degree], ``brightness_spread``, ``brightness_slope``, ``glint``,
        ``blocked_direct``, ``adjacency`` [1],
        ``excluded_flags`` (see `hyperpaint.extract_signatures`) and ``reasons``; its attribute ``refused``
        holds the refused pieces, with objections in the property ``refused``; see `Proposals` for pieces in
        neither.

    Raises
    ------
    SchemaError, UnitsError
        Variables are missing, limits are negative or not finite, or the model is of another line.

    Notes
    -----
    With n pixels, the spectral angle :math:`\alpha`, adjacency a, glint g and spread of brightness t,

    .. math:: score = \min(1, n/200) \; \frac{1}{1 + (\alpha/2°)^2} \;
              \frac{1}{1 + a/0.01 + g/0.02 + t/0.03}.

    A proposal can be wrong, more often for metallic and black paints. For measured rates see
    ``benchmarks/fleet.py``.

    The spectra still include the sky mirrored by the clear coat; see
    `hyperpaint.surroundings.corrections.remove_mirrored_sky`.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> from hyperpaint.light.sun import diffuse_fraction
    >>> nm = np.linspace(400.0, 1000.0, 24)
    >>> sky = 0.04 * diffuse_fraction(nm, 30.0)[:, None]
    >>> seen = np.full((60, 24, 100), 0.1)  # ground
    >>> seen[15:45, :, 5:95] = np.where(nm > 600.0, 0.6, 0.04)[:, None] + sky  # a red car
    >>> seen[19:41, :, 25:40] = seen[19:41, :, 70:80] = 0.012 + sky  # two windows
    >>> cube = ("along_track", "band", "cross_track"), seen.astype("float32"), {"units": "1"}
    >>> line = xr.Dataset({"reflectance": cube}, {"wavelength": ("band", nm, {"units": "nm"})})
    >>> found = propose_regions(line, sun_zenith=30.0)
    >>> [(region.name, region.properties["kind"]) for region in found]
    [('red-01', 'roof')]
    """
    line = schema.rename_to_roles(line)
    limits: dict[str, Any] = {
        "erode": erode,
        "glint": glint,
        "shadow": shadow,
        "adjacency": adjacency,
        "brightness": brightness,
        "angle": angle,
        "max_level_u": max_level_u,
    }
    with Problems("regions cannot be proposed", SchemaError) as problems:
        for key, value in limits.items():
            problems.add_if(
                not is_number(value) or value < 0,
                f"{key}={value!r}",
                expected="a number from 0 on",
                code="value-out-of-range",
            )
        for key, count in (("min_pixels", min_pixels), ("most", most)):
            problems.add_if(
                count is not None and count < 1,
                f"{key}={count!r}",
                expected="1 or more",
                code="value-out-of-range",
            )
    limits["min_pixels"] = min_pixels
    unknown = sorted(set(options) - set(signature(survey).parameters))
    if unknown:
        raise TypeError(f"propose_regions() got unexpected keyword arguments {', '.join(unknown)}")
    scene = model_of(line, survey(line, progress=progress, **options) if model is None else model)
    if not scene.segments:
        return Proposals(())
    zenith = options.get("sun_zenith", scene.attrs.get("sun_zenith"))
    try:
        zenith = sun_zenith_of(line, zenith)
    except SchemaError:  # unknown
        if zenith is not None:
            raise
    side = shadow_side_of(line, options.get("sun_azimuth"), options.get("heading"))
    sun = sunny_lines(line, scene, options.get("diffuse"), zenith)
    view = view_of(line, options.get("sun_azimuth"))
    picture = Picture(scene, *_read(line, scene), zenith, side, view, height_model_of(line), sun)
    found = list(pieces(scene, erode, max(min_pixels // 4, 1)))
    painted, leaves = ([piece for piece, is_leaves in found if is_leaves is kind] for kind in (False, True))
    cars = find_cars(painted, picture, as_progress(progress, "cars"))
    _add_flags(picture, painted, cars)
    unmeasured = np.full(len(scene.channel_wavelength), np.nan)
    judged = [
        Verdict(
            piece, Measures(piece.inside, unmeasured, {}, int(piece.inside.sum())),
            objections=["its red edge is that of leaves"], scenery=True,
        )
        for piece in leaves
    ]  # fmt: skip
    for car in cars:
        judged += judge_car(car, picture, limits)
        picture.release()
    # Accepted pieces by score, and refused pieces with their objections
    accepted = [verdict for verdict in judged if not verdict.objections]
    accepted.sort(key=lambda verdict: (-verdict.score, verdict.piece.origin, verdict.piece.body))
    named = _names_and_places(accepted, line, scene.channel_wavelength, name)
    refused = [verdict for verdict in judged if verdict.objections]
    refused.sort(key=lambda verdict: verdict.scenery)
    digits = len(str(max(len(refused), 10)))
    proposed = [
        region_of(verdict, name, flightline, {"rank": rank, "score": round(verdict.score, 4), **place})
        for rank, (verdict, (name, place)) in enumerate(zip(accepted, named, strict=True), start=1)
    ][:most]
    others = [
        region_of(verdict, f"refused_{rank:0{digits}}", flightline, {"refused": verdict.objections})
        for rank, verdict in enumerate(refused, start=1)
    ]
    proposals = Proposals(tuple(proposed), refused=Regions(tuple(others)))
    return replace(renumbered(proposals, line), refused=renumbered(proposals.refused, line))


def _names_and_places(
    verdicts: list[Verdict], line: xr.Dataset, wavelength: Floats, prefix: str
) -> list[tuple[str, dict[str, Any]]]:
    # Name of every verdict, by the colour of its paint and its order along the line, and its place.
    # the usable pixel that is nearest to the mean of the usable pixels: line and column
    usable = [np.argwhere(each.measures.usable) + np.array(each.piece.origin) for each in verdicts]
    centres = np.array(
        [pixels[((pixels - pixels.mean(axis=0)) ** 2).sum(axis=1).argmin()] for pixels in usable], np.int64
    ).reshape(-1, 2)
    lines, columns = (schema.numbers_of(line, dim)[k] for dim, k in zip(_DIMS, centres.T, strict=True))
    places: list[dict[str, Any]] = [
        {"place": f"line {along:.0f}, column {across:.0f}"}
        for along, across in zip(lines, columns, strict=True)
    ]
    # longitude and latitude, with the geometry of the line
    with contextlib.suppress(PaintError):
        x, y, crs = ground_of(
            line if {"east", "north"} <= set(line.variables) else locate(line), GEOGRAPHIC_CRS
        )
        at = {dim: xr.DataArray(k, dims="place") for dim, k in zip(_DIMS, centres.T, strict=True)}
        ground = np.stack(dask.compute(x.isel(at).data, y.isel(at).data), axis=1)
        if crs is not None or x.name in ("longitude", "lon"):
            ground = between_maps(ground, crs_of(crs or GEOGRAPHIC_CRS), GEOGRAPHIC_CRS)
            for place, (longitude, latitude) in zip(places, ground.tolist(), strict=True):
                if np.isfinite(latitude + longitude):
                    place["place"] += f", {latitude:.6f}, {longitude:.6f}"
                    place |= {"latitude": round(latitude, 7), "longitude": round(longitude, 7)}
    colours = [colour_name(each.measures.spectrum, wavelength).replace(" ", "-") for each in verdicts]
    names, counts = [""] * len(verdicts), Counter[str]()
    for k in np.lexsort(centres.T[::-1]):
        counts[colours[k]] += 1
        names[k] = f"{prefix}{'_' * bool(prefix)}{colours[k]}-{counts[colours[k]]:02}"
    return list(zip(names, places, strict=True))


def _read(line: xr.Dataset, model: SceneModel) -> tuple[Array, dict[str, Array]]:
    # The line in the model's channels (line, column, channel), and those variables `_LAYERS` that it has, by
    # one pass
    names = _LAYERS[:3] if set(_LAYERS[:3]) <= set(line.variables) else ()
    cube = schema.require(line, ["reflectance"], "regions")["reflectance"]
    channels, *arrays = read_channels(cube, model.channel, [line[name].data for name in names])
    layers = dict(zip(names, arrays, strict=True))
    quality = line.get("quality")
    layers["quality"] = np.zeros(channels.shape[:2], np.uint16) if quality is None else quality.values
    return channels, layers


def _add_flags(picture: Picture, pieces: list[Piece], cars: list[Car]) -> None:
    # Add the flags of the pixels in pieces and roofs, which alone are judged, where the line has none
    if len(picture.layers) == len(_LAYERS):
        return
    judged = np.zeros(picture.model.segment.shape, bool)
    roofs = [
        (car.footprint.origin, car.roof.inside)
        for car in cars
        if car.footprint is not None and isinstance(car.roof, Roof)
    ]
    for origin, inside in (*((piece.origin, piece.inside) for piece in pieces), *roofs):
        judged[window_of(origin, inside)] |= inside
    model = within(picture.model, judged)
    layers = {name: scratch_array(judged.shape, np.float32) for name in _LAYERS[:3]}
    for lines, block in line_blocks(picture.channels):
        # thresholds are for bits of quality, which are those of the line
        flags = flag_channels(block.copy(), model, lines.start, dict.fromkeys(FLAG_LIMITS, np.inf))
        for name, layer in layers.items():
            layer[lines] = flags[name]
            release(layer)
    picture.layers.update(layers)


def region_of(verdict: Verdict, name: str, flightline: str, ranking: Mapping[str, Any]) -> Region:
    piece, measures = verdict.piece, verdict.measures
    ring, holes = outline(measures.usable if measures.pixels else piece.inside, piece.origin)
    numbers = {
        "spectral_angle": measures.angle,
        "brightness_spread": measures.spread,
        "brightness_slope": measures.slope,
        "glint": measures.glint,
        "blocked_direct": measures.shadow,
        "adjacency": measures.adjacency,
        "level_uncertainty": float(
            np.hypot.reduce(
                [sd for cause, sd in verdict.level_terms.items() if cause != MIRRORED_SKY] or [np.nan]
            )
        ),
        "lean": verdict.lean,
    }
    return Region(
        name,
        ring,
        holes,
        flightline,
        {
            **ranking,
            "kind": verdict.kind or "unknown",
            "finish": verdict.finish,
            "pixels": measures.pixels,
            "excluded_flags": flag_names(_EXCLUDED_FLAGS),
            **{key: round(value, 5) for key, value in numbers.items() if np.isfinite(value)},
            "level_terms": {cause: round(sd, 5) for cause, sd in verdict.level_terms.items() if sd},
            "reasons": verdict.reasons,
        },
    )
