"""Thresholds of the survey and of the flags: one table a detector.

Each entry states its meaning and unit. Numbers were chosen on simulated scenes (analytic and
ray-traced car parks) unless the entry states otherwise.
"""

from types import SimpleNamespace

#: Channels of a line, and the pixels that represent a segment.
SURVEY = SimpleNamespace(
    channels=24,  # Channels of a cube with more bands: 25 nm wide for a 400-1000 nm camera.
    min_edge_distance_px=2,  # Minimum distance from a boundary of the pixels used for spectra [pixel].
    # Maximum number of pairs of neighbouring pixels for the estimate of noise.
    max_noise_pairs=100_000,
    min_noise_level=0.01,  # Minimum reflectance that noise is divided by [1].
    # Minimum direct part of the light [1]: with less, no shadow is visible and no sun is mirrored.
    min_direct=0.05,
)

#: Division of a line into segments of one surface in one light.
SEGMENTS = SimpleNamespace(
    step_floor=0.01,  # Reflectance below which steps between pixels count for less [1].
    # Scale k of Felzenszwalb & Huttenlocher (2004): segments of n pixels are joined over steps up to k/n
    # above the largest step inside them.
    granularity=1.0,
    min_pixels=12,  # Minimum size of a segment [pixel]; smaller ones join a neighbour.
    min_core_px=3,  # Minimum number of inner pixels: a thinner segment is a boundary.
    max_sample_px=2048,  # Maximum number of pixels of a segment that are used.
    # Minimum number of common pixel sides of touching segments: fewer are a corner.
    min_border_sides=3,
    max_bridge_px=3000,  # Maximum pixels of a segment that links two other segments.
)

#: Sky mirrored by clear coats and glass to a camera above; from Fresnel's equations, not tuned.
#:
#: A body part that leans by b mirrors the sky 2 b from the zenith. At b = 40 degrees an index of 1.55
#: reflects 0.05, and the sky at 80 degrees, away from the sun, is at most 3.3 times as bright as the zenith
#: (sun at 60 degrees): beyond the 0.04 of the zenith that a level body shows, 0.12 of the zenith's light.
MIRROR = SimpleNamespace(
    max_above=0.12,  # Maximum amount of mirrored zenith light beyond that of the level body [1].
    # Distance from the sun at which the bright sky around it is evaluated [degree].
    from_sun_deg=5.0,
    # Amount of mirrored light of the sky around the sun where a coat of index 1.5 mirrors the sun,
    # ((n-1)/(n+1))^2 [1].
    coat=0.04,
    # Maximum amount of that light [1]: 0.05 of a sky that is up to 1.3 times brighter at the sun.
    max_sunward=0.065,
)

#: Segments with the surface of another segment under the mirror image of the sun.
GLINT = SimpleNamespace(
    shade_tolerance=0.08,  # Tolerance of spectra in shadow, relative to the reflectance [1].
    tolerance=0.02,  # Tolerance of spectra in glint, relative to the reflectance [1].
    floor=0.0005,  # Tolerance of every spectrum, in reflectance [1].
    # Maximum misfit of a possible shadow, relative to the reflectance [1].
    max_shade_misfit=0.11,
    # Maximum brightness of a possible shadow, relative to its body [1].
    max_shade_brightness=0.5,
    min_shade_sky=0.2,  # Minimum amount of the sky's light in a possible shadow [1].
    max_shade_sky=1.15,  # Maximum amount of the sky's light in a possible shadow [1].
    # Maximum step of pixels over a border, relative to the difference of both sides, at which light fades
    # out gradually [1].
    max_fading_step=0.35,
    min_glint=0.004,  # Minimum glint of a segment [1].
    min_body_share=1.0,  # Minimum number of pixels of the body relative to the segment [1].
    # Maximum direct light on a surface that faces the sun, relative to a body that leans away a little [1].
    max_tilt=1.1,
    rounds=6,  # Maximum number of iterations that extend glint.
)

#: Mirror images of the sun as spots on a body part.
#:
#: Set on ray-traced car parks of the real fleet, whose coats of 70 gloss units and more mirror the sun as
#: spots of some pixels in the middle of the flakes' broad lobe, and on coats of roughness 0.05.
LOBES = SimpleNamespace(
    # Minimum brightness of a sharp core, relative to the median of the ring of pixels three steps around it
    # [1].
    min_contrast=3.0,
    # Minimum of the third darkest ring pixel, relative to the median of the ring: with darker pixels it lies
    # beside an edge [1].
    min_evenness=0.7,
    # Reflectance above which a pixel is a sharp core, whatever is around it [1]: flakes reach 2.5.
    min_mirrored=3.0,
    min_excess=0.02,  # Minimum reflectance that a sharp core adds [1].
    # Maximum standard deviation over the channels of a core's excess over direct light, relative to its mean
    # [1].
    max_colour=0.3,
    halo_px=2.0,  # Distance from the core up to which its lobe reaches, constant part [pixel].
    sharp_halo=2.0,  # The same, part proportional to the half width of the core [1].
    max_sharp_px=14.0,  # Maximum distance that the lobe of a sharp core reaches [pixel].
    # Number of times that a lobe reaches on from its end, along a streak: one for so many pixels of core,
    # and the maximum.
    growth_px=8,
    growths=5,
    # Minimum brightness of such an end, relative to the broad lobe [1]: a lean to the sun adds less.
    beyond_lean=1.3,
    around_px=4,  # Width of the surroundings beyond the lobe for the fit of the broad lobe [pixel].
    min_ring_px=9,  # Minimum number of pixels of the surroundings.
    min_ring_share=0.5,  # Minimum share of the surroundings that belongs to one body [1].
    beside_px=3,  # Distance within which a lobe is brighter than its body on both sides [pixel].
    rounds=8,  # Maximum number of iterations that exclude pixels brighter than the broad lobe.
    noise=0.002,  # Relative noise of brightness, added to the spread of the surroundings [1].
    min_share=0.04,  # Minimum excess of a lobe over the broad lobe, relative to the broad lobe [1].
    min_sd=4.0,  # Minimum of the excess in standard deviations.
    floor=0.003,  # Minimum of the excess in reflectance [1].
    # Minimum amount of mirrored sun in a wide core: a lobe of roughness 0.1 has its peak there [1].
    min_wide_glint=1.0,
    min_wide_px=2.0,  # Minimum half width of a wide core [pixel].
    # Distance from a wide core on black up to which its lobe reaches, by its half width [1]: a GGX lobe
    # falls from 4 to 0.01 over six times the distance at which it falls to 1.
    wide_halo=6.0,
    # Distance from a wide core on coloured paint up to which its lobe is searched [pixel].
    max_wide_px=120.0,
    min_wide_share=0.02,  # Minimum excess of a wide lobe, relative to the paint's level [1].
    # Maximum reflectance of black bodies, on which wide lobes can be distinguished from flakes [1].
    max_black=0.05,
    max_spot_px=4.0,  # Maximum half width of saturated pixels that may be a sharp core [pixel].
    # Minimum share of the pixels around saturated ones that lie in a lobe, for these to be in the lobe [1].
    min_rim=0.5,
)

#: Segments as bodies in the light of sun, sky and one neighbour.
MIXTURES = SimpleNamespace(
    tolerance=0.05,  # Tolerance of spectra, relative to the reflectance [1].
    floor=0.0005,  # Tolerance of every spectrum, in reflectance [1].
    neighbours=6,  # Maximum number of coloured segments around that may send light to a segment.
    neighbours_of_cell=4,  # Number of nearest coloured segments stored for a cell.
    reach_px=60,  # Maximum distance of these segments from the cell [pixel].
    min_sender_level=0.04,  # Minimum mean reflectance of a segment that sends light [1].
    # Minimum standard deviation over the channels of a segment that sends light, relative to its mean [1].
    min_sender_colour=0.3,
    min_sender_px=150,  # Minimum number of pixels of a segment that sends light.
    max_direct=0.4,  # Maximum amount of direct light in a possible shadow [1].
    max_sky=1.1,  # Maximum amount of the sky's light in a possible shadow [1].
    max_misfit=0.3,  # Maximum misfit of a possible shadow, relative to the reflectance [1].
)

#: Cast shadows; contact rules in the order of their use, later ones with fewer conditions.
#:
#: A contact of a segment with its lit body is the share of the segment's border that touches the body, and
#: the mean direction of this border: 1 if the segment lies away from the sun, -1 if towards it. The maximum
#: of direct light in a shadow is a value under the open sky, and an additional one for each unit of hidden
#: sky: grey objects that hide sky send light that looks direct.
#:
#: Tuned on ray-traced car parks so that glass and black paint are excluded.
SHADOWS = SimpleNamespace(
    max_brightness=0.5,  # Maximum brightness of a shadow, relative to its body [1].
    large_segments=40,  # Number of the largest segments, each of which may be the body of any shadow.
    min_body_share=0.2,  # Minimum size of the lit part of a body, relative to its shadow [1].
    # Maximum difference of spectra with mean 1 for segments of the same surface [1].
    max_shape_difference=0.08,
    # Maximum relative difference of brightness for segments of the same surface [1].
    max_level_difference=0.35,
    min_contact_sides=4,  # Minimum number of pixel sides over which a shadow touches its lit body.
    # Amount of the sky's light below which objects that hide the sky may send light [1].
    open_sky=0.75,
    min_clear_sky=0.45,  # Minimum amount of the sky's light in a clear shadow [1].
    max_clear_misfit=0.035,  # Maximum misfit of a clear shadow, relative to the reflectance [1].
    # Maximum misfit of a shadow that touches its lit body, relative to the reflectance [1].
    max_misfit=0.065,
    min_ground_share=0.1,  # Minimum share of all shadows on a body that is ground [1].
    # Maximum mean reflectance of ground other than the largest segment: brighter are white cars [1].
    max_ground_level=0.5,
    # Minimum share of all pixels with the surface of ground other than the largest segment [1].
    min_ground_size=0.03,
    # Mean direction of a border beyond which the border faces the sun [1].
    sideways=0.35,
    rounds=12,  # Maximum number of iterations that extend shadows to touching segments.
    max_pixel_level=0.9,  # Maximum brightness of examined single pixels, relative to their body [1].
    max_pixel_direct=0.8,  # Maximum direct light of single pixels in shadow [1].
    max_pixel_misfit=0.2,  # Maximum misfit of single pixels in shadow [1].
    # Minimum excess of the sky's light over direct light in single pixels in shadow [1].
    min_pixel_sky_excess=0.05,
    # Minimum number of pixels of a clear shadow that shows to which side shadows fall.
    min_telling_px=30,
    min_telling_sky=0.3,  # Minimum amount of the sky's light in such a shadow on the ground [1].
    # Maximum direct light of clear shadows, under the open sky and for hidden sky [1].
    clear_direct=(0.015, 0.12),
    max_sent=0.5,  # Maximum light of a neighbour in a clear shadow, relative to the hidden sky [1].
    max_sent_beside=1.0,  # The same in a shadow beside another shadow [1].
    sure_border=0.1,  # Minimum contact of certain shadows, share of the border [1].
    sure_direction=0.2,  # Minimum contact of certain shadows, direction [1].
    # Minimum share of the border that touches the lit body for a shadow enclosed by it, on any side [1].
    island_border=0.6,
    on_ground_border=0.04,  # Minimum contact of shadows on the ground, share of the border [1].
    on_ground_direction=0.1,  # Minimum contact of shadows on the ground, direction [1].
    # Minimum contact with which a shadow on the ground may have more direct light, share of the border [1].
    sided_border=0.15,
    sided_direction=0.25,  # The same, direction [1].
    # Maximum direct light of such shadows, under the open sky and for hidden sky [1].
    sided_direct=(0.05, 0.25),
    # Minimum mean direction of the contact of clear shadows on the ground, at any share of contact [1].
    beside_direction=-0.2,
    worse_factor=1.5,  # Maximum misfit relative to that of the best shadow on the ground [1].
    worse_by=0.004,  # Additional misfit allowed [1].
    # Maximum misfit on other bodies, beside shadows, with at least `min_clear_sky` of the sky's light [1].
    max_dim_misfit=0.18,
    max_dark_misfit=0.08,  # The same with less of the sky's light [1].
    min_marking_sky=0.22,  # Minimum amount of the sky's light in shadows on bay lines and kerbs [1].
    max_marking_direct=0.04,  # Maximum direct light in shadows on bay lines and kerbs [1].
    # Maximum width of such shadows, relative to that of the lit line or kerb [1]: a black roof is wider.
    max_marking_width=1.05,
    # Minimum share of the border that touches other shadows, for a clear shadow [1].
    next_clear=0.04,
    next=0.4,  # The same for a shadow that is not clear [1].
    next_marking=0.3,  # The same for shadows on bay lines and kerbs [1].
    # Minimum share of the border that touches shadows for a shadow with more direct light [1].
    enclosed=0.7,
    max_enclosed_direct=0.25,  # Maximum direct light of such a shadow [1].
    min_enclosed_sky=0.1,  # Minimum amount of the sky's light in such a shadow [1].
    # Maximum brightness of single pixels deep in a shadow, relative to their body [1]: no texture is that
    # dark.
    max_deep_level=0.4,
    min_thin_px=16,  # Minimum number of single pixels in the shadow of a thin object.
    min_thinness=5.0,  # Minimum length of such a shadow over its width [1].
    # Minimum cosine between the observed and the predicted side of shadows [1]: below, heading or clock is
    # wrong.
    min_agreement=-0.3,
    min_coherence=0.6,  # Minimum agreement of borders on the observed side of shadows [1].
    # Maximum misfit of a shadow that is found by its spectrum alone, relative to the reflectance [1].
    max_spectral_misfit=0.02,
    # Maximum direct light, and maximum light of a neighbour, in such a shadow [1].
    max_spectral_direct=0.02,
    # Minimum of the sky's light in such a shadow times the body's reflectance [1]: a coat on black paint
    # mirrors 0.04 of the sky, with the sky's spectrum, at up to twice its mean brightness, and the darkest
    # bodies send 0.01.
    min_spectral_level=0.09,
    # Maximum direct light, sent by ground and cars around, of sides that face away from the sun [1].
    max_turned_direct=0.1,
    # Maximum reflectance of the lit body of such sides: brighter bodies are in glint [1].
    max_lit_level=1.0,
    # Minimum ratio of the sky's light to direct light of such sides [1]: a darker paint has 1.
    min_turned_ratio=2.5,
    # Distance within which the lit body of a shadow found by its spectrum must have as many pixels [pixel].
    beside_px=8,
    penumbra_px=8,  # Maximum distance from a shadow over which light fades [pixel].
    max_penumbra_sky=1.3,  # Maximum amount of the sky's light in fading light [1].
    min_shadow_px=60,  # Minimum number of pixels of a cast shadow for the diffuse fraction.
    # Quantiles of brightness in the blue, between which the pixels of a shadow see most of the sky.
    open_sky_quantiles=(0.6, 0.9),
)

#: Black paint in the sun, whose coat mirrors the sky: blue and dark as a shadow, but no shadow.
#:
#: A level coat of index 1.5 mirrors 0.04 of the zenith, see `MIRROR`. The misfits are from 28 ray-traced car
#: parks of the real fleet: black roofs fit to 0.001 to 0.004, shadows on asphalt worse.
DARK_COATS = SimpleNamespace(
    # Maximum relative change of the body's reflectance from the middle to an end of the spectrum [1].
    slope=0.6,
    # Minimum reflectance of the body [1]: with less, its light does not show the sun.
    min_body=0.003,
    max_level=0.05,  # Maximum observed reflectance [1].
    min_mirrored=0.03,  # Minimum amount of mirrored sky light [1].
    max_mirrored=0.13,  # Maximum amount of mirrored sky light [1].
    max_misfit=0.004,  # Maximum misfit, relative to the reflectance [1].
    # Minimum misfit of a shadow relative to the misfit of black paint, for black paint [1].
    worse_factor=1.3,
)

#: Coloured neighbours, paints, and the spectra of bodies without glint.
BODIES = SimpleNamespace(
    # Number of nearest coloured segments stored for a cell; one or two may be its own body.
    neighbours_of_cell=4,
    min_sender_colour=0.04,  # Minimum colour of a segment that lights others, see `coloured` [1].
    min_sender_px=40,  # Minimum number of pixels of a segment that lights others.
    # Maximum mean reflectance of a segment that lights others: brighter ones mirror the sun [1].
    max_sender_level=1.0,
    tilt=0.1,  # Spread of the amount of direct light within a body, by the lean of its parts [1].
    # The same in a body that is mostly in glint, where larger differences are certainly glint [1].
    glint_tilt=0.03,
    # Minimum reflectance of such a body [1]: tilt of a bright body exceeds the threshold of glint.
    bright=0.1,
    # Colour relative to brightness below which mirrored sun is not distinguished from direct light [1].
    max_grey_colour=0.08,
    # Minimum colour relative to brightness of paints that are distinguished by colour [1].
    min_paint_colour=0.1,
    min_body_px=50,  # Minimum number of pixels of an examined body.
    min_clean_px=5,  # Minimum number of pixels whose mean is the reference.
    min_difference=0.003,  # Minimum range of the light added to pixels that exceeds noise [1].
    # Quantiles of the light added to pixels, between which a coloured body is free of glint.
    clean_quantiles=(0.01, 0.1),
    # The same for a grey body.
    clean_grey_quantiles=(0.05, 0.35),  # The same of a grey body.
    # Minimum brightness of glint, relative to a surface that faces the sun [1].
    min_glint_brightness=1.3,
    # Minimum median brightness, relative to the darkest parts, of a body that is mostly in glint [1].
    min_mostly_glint=1.08,
    # Quantiles of a grey body's brightness without glint.
    darkest_quantiles=(0.02, 0.1),
    # Quantile of a grey body's brightness that represents the body without glint.
    usual_quantile=0.15,
    brightest_quantile=0.98,  # Quantile of a grey body's brightness in glint.
    # Maximum median brightness of a body, relative to its darkest parts [1]: beyond, it lies beside a
    # shadow.
    max_even_ratio=3.5,
    # Maximum range of brightness between `clean_grey_quantiles` of a body that is mostly free of glint [1].
    max_plateau=0.02,
    min_sky=0.8,  # Minimum light of the sky on a body's darkest parts, relative to its median [1].
    # Minimum size of another part of the same paint, relative to the body, that shows it without glint [1].
    min_part_share=0.1,
    # Direct light and zenith light added to every pixel before unmixing, so that negative amounts show [1].
    offset=0.1,
    lift=0.05,  # Part of a neighbour's reflectance added for the same reason [1].
)

#: Unmixing of single pixels.
FLAGS = SimpleNamespace(
    # Relative standard deviation of a channel beside its noise [1]: bodies differ from pixel to pixel.
    relative_error=0.007,
    floor=0.001,  # Standard deviation of a channel, in reflectance [1].
    # Minimum increase of the squared misfit, in squared standard deviations, by which glint or neighbours
    # are detected: three sigma.
    evidence_sd2=9.0,
    # Expected amounts; parts as in `hyperpaint.kernels.unmixing` [1].
    expected=(1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    # Standard deviations of the expected amounts after the first, direct light, which has `tilt` [1].
    spread=(0.3, 10.0, 0.02, 0.03, 0.2, 0.1, 0.2, 0.1),
    # Maximum direct light on a surface that faces the sun, relative to a body that leans away a little [1].
    max_direct=1.1,
    min_glint=0.004,  # Minimum reflectance that glint adds, on any paint [1].
    # Maximum distance from a cast shadow of missing light that belongs to it; elsewhere it is tilt [pixel].
    penumbra_px=1,
    # Minimum of the missing direct light on objects in shadow [1]: leaning surfaces lack up to half.
    min_missing_on_objects=0.6,
    # Wavelength shift above which spectra are compared at nominal wavelengths [nm].
    max_smile_nm=1.0,
)

#: The red edge of leaves: a rise within 50 nm, then a plateau.
#:
#: Blue paints have such a rise, too; leaves are brighter in the green than in the blue.
VEGETATION = SimpleNamespace(
    blue_nm=(430.0, 490.0),  # Range of the blue [nm].
    green_nm=(535.0, 565.0),  # Range of the green [nm].
    red_nm=(660.0, 690.0),  # Range before the red edge [nm].
    edge_nm=(735.0, 765.0),  # End of the red edge [nm].
    infrared_nm=(790.0, 900.0),  # Plateau beyond the red edge [nm].
    min_edge=3.0,  # Minimum reflectance at the end of the red edge over that in the red [1].
    max_rise=1.4,  # Maximum reflectance of the plateau over that at the end of the red edge [1].
)
