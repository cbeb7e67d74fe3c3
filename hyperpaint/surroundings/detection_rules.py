"""Thresholds of the survey and of the flags: one frozen dataclass a detector.

Each field states its meaning and unit. Numbers were chosen on simulated scenes (analytic and
ray-traced car parks) unless the field states otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple


class Contact(NamedTuple):
    """Minimum contact of a segment with its lit body: a share of its border, and its mean direction.

    ``way`` is the mean direction of the sides in touch, 1 where all are away from the sun, -1 towards it.
    """

    border: float
    way: float


class Direct(NamedTuple):
    """Maximum direct light: grey objects send light that looks direct, more of it the more sky they hide."""

    open: float
    hidden: float


@dataclass(frozen=True)
class SurveyRules:
    """Channels of a line, and the pixels that represent a segment."""

    channels: int = 24  #: Channels of a cube with more bands: 25 nm wide for a 400-1000 nm camera.
    min_edge_distance_px: int = 2  #: Distance from a boundary from which on spectra count [pixel].
    max_noise_pairs: int = 100_000  #: Pairs of neighbouring pixels that noise is estimated from, at most.
    min_noise_level: float = 0.01  #: Reflectance that noise is relative to, at least [1].
    #: Direct part of the light, at least: with less, no shadow is visible, and no sun is
    #: mirrored; darker segments may be anything [1].
    min_direct: float = 0.05


@dataclass(frozen=True)
class SegmentRules:
    """Division of a line into segments of one surface in one light."""

    step_floor: float = 0.01  #: Reflectance below which steps between pixels count for less [1].
    #: Scale k of Felzenszwalb & Huttenlocher (2004): n pixels are joined over steps k/n above their
    #: own.
    granularity: float = 1.0
    min_pixels: int = 12  #: Minimum size of a segment [pixel]; smaller ones join a neighbour.
    min_core_px: int = 3  #: Minimum number of inner pixels: a thinner segment is a boundary.
    max_sample_px: int = 2048  #: Maximum number of pixels of a segment that are used.
    min_border_sides: int = 3  #: Sides of pixels from which on segments touch by more than a corner.
    max_bridge_px: int = 3000  #: Pixels of a segment that links two others, at most.


@dataclass(frozen=True)
class MirrorRules:
    """Sky mirrored by clear coats and glass to a camera above; from Fresnel's equations, not tuned.

    A body part that leans by b mirrors the sky 2 b from the zenith. At b = 40 degrees an index of 1.55
    reflects 0.05, and the sky at 80 degrees, away from the sun, is at most 3.3 times as bright as the zenith
    (sun at 60 degrees): beyond the 0.04 of the zenith that a level body shows, 0.12 of the zenith's light.
    """

    max_above: float = 0.12  #: Amount of the zenith's light beyond that of the rest of the body, at most [1].
    #: Distance from the sun at which the sky around it is looked at [degree].
    from_sun_deg: float = 5.0
    coat: float = (
        0.04  #: Amount of that sky's light where the sun is mirrored: a coat of 1.5, ((n-1)/(n+1))^2 [1].
    )
    #: Amount of that sky's light, at most: 0.05, of a sky that is up to 1.3 times brighter at the sun [1].
    max_sunward: float = 0.065


@dataclass(frozen=True)
class GlintRules:
    """Segments that are another segment's surface under the mirror image of the sun."""

    shade_tolerance: float = 0.08  #: Tolerance of spectra in shadow, relative to the reflectance [1].
    tolerance: float = 0.02  #: Tolerance of spectra in glint, relative to the reflectance [1].
    floor: float = 0.0005  #: Tolerance of any spectrum, in reflectance [1].
    #: Misfit of a possible shadow, relative to the reflectance, at most [1].
    max_shade_misfit: float = 0.11
    #: Brightness of a possible shadow, relative to its body, at most [1].
    max_shade_brightness: float = 0.5
    min_shade_sky: float = 0.2  #: Amount of the sky's light in a possible shadow, at least [1].
    max_shade_sky: float = 1.15  #: The same, at most [1].
    #: Step of pixels over a border, relative to the difference of both sides, below which light fades
    #: out [1].
    max_fading_step: float = 0.35
    min_glint: float = 0.004  #: Glint of a segment, at least [1].
    min_body_share: float = 1.0  #: Pixels of the body relative to those of the segment, at least [1].
    #: Direct light on a surface that faces the sun, relative to a body that leans away a little, at most [1].
    max_tilt: float = 1.1
    rounds: int = 6  #: Maximum number of iterations that extend glint.


@dataclass(frozen=True)
class LobeRules:
    """Mirror images of the sun as spots on a body part.

    Set on ray-traced car parks of the real fleet, whose coats of 70 gloss units and more mirror the sun as
    spots of some pixels in the middle of the flakes' broad lobe, and on coats of roughness 0.05.
    """

    #: Brightness of a sharp core, relative to the median of the pixels three steps around it, at least [1].
    min_contrast: float = 3.0
    #: Third darkest of those, relative to their median, at least: others lie beside an edge [1].
    min_evenness: float = 0.7
    min_excess: float = 0.02  #: Reflectance that a sharp core adds, at least [1].
    #: Standard deviation over channels of a core's excess over direct light, relative to its mean, at most
    #: [1].
    max_colour: float = 0.3
    halo_px: float = 2.0  #: Distance from the core up to which a lobe reaches, of a core of nothing [pixel].
    sharp_halo: float = 2.0  #: The same, by the core's half width [1].
    max_sharp_px: float = 14.0  #: That distance, at most: others are no sharp ones [pixel].
    around_px: int = 4  #: Surroundings beyond, through which the broad lobe is found [pixel].
    min_ring_px: int = 9  #: Pixels of those, at least.
    min_ring_share: float = 0.5  #: Share of them that one body has, at least [1].
    rounds: int = 8  #: Maximum number of iterations that leave out pixels brighter than the broad lobe.
    noise: float = 0.002  #: Relative noise of brightness, added to that of the surroundings [1].
    min_share: float = 0.04  #: Smallest excess of a lobe over the broad one, relative to it [1].
    min_sd: float = 4.0  #: The same, in standard deviations.
    floor: float = 0.003  #: The same, in reflectance [1].
    #: Mirror image of the sun of a wide core, at least: a lobe of roughness 0.1 has its peak there [1].
    min_wide_glint: float = 1.0
    min_wide_px: float = 2.0  #: Half width of a wide core, at least [pixel].
    #: Distance from a wide core on black up to which its lobe reaches, by its half width: GGX falls from 4
    #: to 0.01 over six times the distance to 1 [1].
    wide_halo: float = 6.0
    max_wide_px: float = 120.0  #: The same on coloured paint, where the spectrum tells [pixel].
    min_wide_share: float = 0.02  #: Smallest excess of a wide lobe, relative to the paint's level [1].
    max_black: float = 0.05  #: Reflectance of black bodies, where wide lobes are told from flakes [1].
    max_spot_px: float = 4.0  #: Half width of saturated pixels that may be a sharp core, at most [pixel].
    #: Share of the pixels around saturated ones that lie in a lobe, from which on these do, at least [1].
    min_rim: float = 0.5


@dataclass(frozen=True)
class MixtureRules:
    """Segments as bodies in the light of sun, sky and one neighbour."""

    tolerance: float = 0.05  #: Tolerance of spectra, relative to the reflectance [1].
    floor: float = 0.0005  #: Tolerance of any spectrum, in reflectance [1].
    neighbours: int = 6  #: Coloured segments around that may send light.
    neighbours_of_cell: int = 4  #: Segments that are kept of a cell.
    reach_px: int = 60  #: Distance of those from the cell, at most [pixel].
    min_sender_level: float = 0.04  #: Mean reflectance of a segment that sends light, at least [1].
    #: Standard deviation over channels of one, relative to its mean, at least [1].
    min_sender_colour: float = 0.3
    min_sender_px: int = 150  #: Pixels of one, at least.
    max_direct: float = 0.4  #: Amount of direct light in a possible shadow, at most [1].
    max_sky: float = 1.1  #: Amount of the sky's light of the same, at most [1].
    max_misfit: float = 0.3  #: Misfit of the same, relative to the reflectance, at most [1].


@dataclass(frozen=True)
class ShadowRules:
    """Cast shadows; contact rules in the order of use: fewer conditions where more evidence exists.

    Set on ray-traced car parks, such that glass and black paint are excluded.
    """

    max_brightness: float = 0.5  #: Brightness of a shadow, relative to its body, at most [1].
    large_segments: int = 40  #: Largest segments, which may be the body of any.
    min_body_share: float = 0.2  #: Size of the lit part of a body, relative to its shadow, at least [1].
    #: Difference of spectra of mean 1 of segments that look the same, at most [1].
    max_shape_difference: float = 0.08
    max_level_difference: float = 0.35  #: Relative difference of their brightness, at most [1].
    min_contact_sides: int = 4  #: Sides of pixels over which a shadow touches its lit body, at least.
    open_sky: float = (
        0.75  #: Amount of the sky's light below which objects that hide the sky may send light [1].
    )
    min_clear_sky: float = 0.45  #: Amount of the sky's light in a clear shadow, at least [1].
    max_clear_misfit: float = 0.035  #: Misfit of a clear shadow, relative to the reflectance, at most [1].
    max_misfit: float = 0.045  #: Misfit of a shadow that its surroundings speak for, at most [1].
    min_ground_share: float = 0.1  #: Share of all shadows that lie on a body that is ground, at least [1].
    #: Mean reflectance of ground, at most, but for the largest segment: above stand white cars [1].
    max_ground_level: float = 0.5
    #: Share of all pixels that look like ground, at least, but for the largest segment [1].
    min_ground_size: float = 0.03
    #: Mean direction of a border's sides against that of shadows, beyond which it faces the sun [1].
    sideways: float = 0.35
    rounds: int = 12  #: Maximum number of iterations that extend shadows to touching segments.
    #: Brightness of single pixels that are looked at, relative to their body, at most [1].
    max_pixel_level: float = 0.9
    max_pixel_direct: float = 0.8  #: Direct light of single pixels in shadow, at most [1].
    max_pixel_misfit: float = 0.2  #: Misfit of single pixels in shadow, at most [1].
    #: Sky's light less direct light of single pixels in shadow, at least [1].
    min_pixel_sky_excess: float = 0.05
    min_telling_px: int = 30  #: Pixels of a clear shadow that shows to which side shadows fall, at least.
    min_telling_sky: float = 0.3  #: Amount of the sky's light in such a one on the ground, at least [1].
    #: Direct light of clear shadows, at most.
    clear_direct: Direct = Direct(0.015, 0.12)  # noqa: RUF009
    max_sent: float = 0.5  #: Light of a neighbour in a clear shadow, relative to the hidden sky, at most [1].
    max_sent_beside: float = 1.0  #: The same beside another shadow [1].
    #: Contact of shadows beyond doubt, at least.
    sure: Contact = Contact(0.1, 0.2)  # noqa: RUF009
    #: Share of the border in touch with the lit body, from which on a shadow lies in it, on whatever
    #: side [1].
    island_border: float = 0.6
    #: Contact of shadows on the ground, at least.
    on_ground: Contact = Contact(0.04, 0.1)  # noqa: RUF009
    #: Plain contact, with which a shadow on the ground may have more direct light.
    sided: Contact = Contact(0.15, 0.25)  # noqa: RUF009
    #: Direct light of those, at most.
    sided_direct: Direct = Direct(0.05, 0.25)  # noqa: RUF009
    #: Mean side of clear shadows on the ground, whatever their share of contact, at least [1].
    beside_way: float = -0.2
    worse_factor: float = 1.5  #: Misfit relative to that of the best shadow on the ground, at most [1].
    worse_by: float = 0.004  #: Additional misfit allowed [1].
    #: Misfit on other bodies, beside shadows, with much of the sky's light, at most [1].
    max_dim_misfit: float = 0.18
    max_dark_misfit: float = 0.08  #: The same with little of it [1].
    min_marking_sky: float = 0.22  #: Sky's light of shadows on bay lines and kerbs, at least [1].
    max_marking_direct: float = 0.04  #: Direct light of the same, at most [1].
    next_clear: float = 0.04  #: Share of the border in contact with shadows of a clear one, at least [1].
    next: float = 0.4  #: The same of any other [1].
    next_marking: float = 0.3  #: The same of markings [1].
    #: Share of the border from which on a segment lies in shadow with more direct light [1].
    enclosed: float = 0.7
    max_enclosed_direct: float = 0.25  #: That direct light, at most [1].
    #: Brightness of single pixels deep in a shadow, relative to their body, at most: no texture is that
    #: dark [1].
    max_deep_level: float = 0.4
    min_thin_px: int = 16  #: Single pixels of a thin thing's shadow, at least.
    min_thinness: float = 5.0  #: Length of such a shadow over its width, at least [1].
    #: Cosine between the side to which shadows are seen to fall and that they are said to, at least: beyond,
    #: heading or clock is wrong [1].
    min_agreement: float = -0.3
    #: Share of borders that lie on the side to which shadows are seen to fall, at least [1].
    min_coherence: float = 0.6
    #: Misfit of a shadow by its spectrum alone, relative to the reflectance, at most [1].
    max_spectral_misfit: float = 0.02
    max_spectral_direct: float = 0.02  #: Direct light of the same, and that of a neighbour, at most [1].
    #: Sky's light of the same times the body's reflectance, at least: a coat on black mirrors 0.04 of the
    #: sky, whose spectrum that is, up to twice as bright as its mean, and the darkest bodies send 0.01 [1].
    min_spectral_level: float = 0.09
    #: Direct light, as the ground and cars around send it, of sides that are turned away from the sun, at
    #: most [1].
    max_turned_direct: float = 0.1
    max_lit_level: float = 1.0  #: Reflectance of their lit body, at most: brighter bodies are in glint [1].
    #: Sky's light of the same over its direct light, at least: of a darker paint it would be 1 [1].
    min_turned_ratio: float = 2.5
    beside_px: int = 8  #: Distance of the lit body from the same, and its pixels there, at least [pixel].
    penumbra_px: int = 8  #: Distance from a shadow over which light fades, at most [pixel].
    max_penumbra_sky: float = 1.3  #: Amount of the sky's light there, at most [1].


@dataclass(frozen=True)
class DarkCoatRules:
    """Black paint in the sun, whose coat mirrors the sky: blue and dark as a shadow, but no shadow.

    A level coat of index 1.5 mirrors 0.04 of the zenith, see `MirrorRules`. The misfits are from 28
    ray-traced car parks of the real fleet: black roofs fit to 0.001 to 0.004, shadows on asphalt worse.
    """

    slope: float = (
        0.6  #: Most that the body's reflectance rises or falls from the middle to an end, relative [1].
    )
    min_body: float = 0.003  #: Reflectance of the body, at least: with less nothing tells of the sun [1].
    max_level: float = 0.05  #: Observed reflectance, at most [1].
    min_mirrored: float = 0.03  #: Amount of the sky's light that is mirrored, at least [1].
    max_mirrored: float = 0.13  #: The same, at most [1].
    max_misfit: float = 0.004  #: Misfit, relative to the reflectance, at most [1].
    worse_factor: float = 1.3  #: Misfit of a shadow relative to it, at least [1].


@dataclass(frozen=True)
class BodyRules:
    """Coloured neighbours, paints, and the spectra of bodies without glint."""

    #: Neighbours of a cell that are kept; one or two of them may be its own body.
    neighbours_of_cell: int = 4
    #: Colour of a segment whose light is looked for, see `coloured`, at least [1].
    min_sender_colour: float = 0.04
    min_sender_px: int = 40  #: Pixels of that, at least.
    max_sender_level: float = (
        1.0  #: Mean reflectance of such a segment, at most: brighter ones mirror the sun [1].
    )
    tilt: float = 0.1  #: Spread of the amount of direct light within a body: how far its parts lean [1].
    glint_tilt: float = 0.03  #: The same where all that differs by more is glint for certain [1].
    bright: float = 0.1  #: Reflectance from which tilt looks like glint above the usual threshold [1].
    #: Colour relative to brightness below which a mirrored sun looks like more of the sun's light [1].
    max_grey_colour: float = 0.08
    #: Colour relative to brightness from which paints are told apart by it [1].
    min_paint_colour: float = 0.1
    min_body_px: int = 50  #: Pixels of a body that is looked at, at least.
    min_clean_px: int = 5  #: Pixels that its reference is the mean of, at least.
    #: Smallest range of the light added to pixels that is no noise [1].
    min_difference: float = 0.003
    #: Quantiles of the light added to pixels, between which a body is free of glint.
    clean_quantiles: tuple[float, float] = (0.01, 0.1)
    clean_grey_quantiles: tuple[float, float] = (0.05, 0.35)  #: The same of a grey body.
    min_glint_brightness: float = (
        1.3  #: Brightness of glint, relative to a surface that faces the sun, at least [1].
    )
    #: Brightness of half of a body, relative to its darkest parts, from which most of it is in glint
    #: [1].
    min_mostly_glint: float = 1.08
    #: Quantiles of a grey body's brightness without glint.
    darkest_quantiles: tuple[float, float] = (0.02, 0.1)
    usual_quantile: float = 0.15  #: Quantile of the same as it mostly is without glint.
    brightest_quantile: float = 0.98  #: Quantile of the same in glint.
    #: Brightness of half of a body, relative to its darkest parts, at most: more is beside a shadow
    #: [1].
    max_even_ratio: float = 3.5
    #: Range of `clean_grey_quantiles` where most of a body is without glint, at most [1].
    max_plateau: float = 0.02
    min_sky: float = 0.8  #: Light of the sky on a body's darkest parts, relative to its median, at least [1].
    #: Size of another part of the same paint that shows it without glint, relative to the body, at
    #: least [1].
    min_part_share: float = 0.1
    #: Reflectance added to every channel before pixels are unmixed, so that amounts below 0 show [1].
    offset: float = 0.1
    lift: float = 0.05  #: Part of each neighbour's reflectance added for the same reason [1].


@dataclass(frozen=True)
class DiffuseRules:
    """The diffuse fraction from a cast shadow in the image."""

    min_shadow_px: int = 60  #: Pixels of a shadow that the diffuse fraction is taken from, at least.
    #: Quantiles of brightness in the blue, between which its pixels see most of the sky.
    open_sky_quantiles: tuple[float, float] = (0.6, 0.9)


@dataclass(frozen=True)
class FlagRules:
    """Unmixing of single pixels."""

    #: Standard deviation of a channel beside its noise, relative: bodies differ from place to place
    #: [1].
    relative_error: float = 0.007
    floor: float = 0.001  #: Standard deviation of a channel, in reflectance [1].
    #: Squared standard deviations by which leaving glint or neighbours out is worse: three sigma.
    evidence_sd2: float = 9.0
    #: Amounts without evidence; parts as in `hyperpaint.kernels.unmixing` [1].
    expected: tuple[float, ...] = (1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    #: Standard deviations of the amounts from that: weak beside a channel's noise [1].
    spread: tuple[float, ...] = (0.1, 0.3, 10.0, 0.02, 0.03, 0.2, 0.1, 0.2, 0.1)
    #: Direct light on a surface that faces the sun, relative to a body that leans away a little, at most [1].
    max_direct: float = 1.1
    min_glint: float = 0.004  #: Reflectance that glint adds, at least, however dark the paint is [1].
    #: Distance from a cast shadow up to which missing light is part of it; elsewhere it is tilt
    #: [pixel].
    penumbra_px: int = 1
    #: Missing direct light on objects in shadow, at least: leaning surfaces lack up to half [1].
    min_missing_on_things: float = 0.6
    #: Wavelength shift above which spectra are compared at nominal wavelengths [nm].
    max_smile_nm: float = 1.0


SURVEY = SurveyRules()
SEGMENTS = SegmentRules()
GLINT = GlintRules()
MIXTURES = MixtureRules()
SHADOWS = ShadowRules()
LOBES = LobeRules()
MIRROR = MirrorRules()
DARK_COATS = DarkCoatRules()
BODIES = BodyRules()
DIFFUSE = DiffuseRules()
FLAGS = FlagRules()
