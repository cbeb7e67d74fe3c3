"""Survey of a flight line: its channels, segments, their spectra in full light, and neighbours.

Flags follow: glint, shadow, coloured light from neighbours and mixed pixels as layers, and bits by
thresholds. Every pixel is unmixed into the reflectance of its body in the scene model, under changed amounts
of sun and sky, plus mirrored sun and sky and the light of coloured neighbours.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import dask
import dask.array as da
import numpy as np
import numpy.typing as npt
import scipy.sparse
import xarray as xr
from scipy.ndimage import binary_dilation, find_objects, label

from hyperpaint.base import (
    ALONG_TRACK,
    BAND,
    CHUNK_LINES,
    CROSS_TRACK,
    Array,
    Bools,
    Fact,
    Floats,
    Floats32,
    Ints,
    Problems,
    Progress,
    Quality,
    SchemaError,
    as_progress,
    check_values,
    documented,
    flags_set_from,
    schema,
    takes_quantities,
    warn_user,
)
from hyperpaint.base.many_outputs import split_outputs
from hyperpaint.kernels import arguments
from hyperpaint.kernels.segmentation import boundary_distance, nearest_sources
from hyperpaint.kernels.unmixing import PARTS, average_bands, unmix_lines
from hyperpaint.radiometry.slabs import line_chunked
from hyperpaint.radiometry.spectral_axis import to_nominal

from .corrections import shadow_side_of, split_of
from .detection_rules import BODIES, DARK_COATS, FLAGS, GLINT, LOBES, MIRROR, SHADOWS, SURVEY, VEGETATION
from .model import CELL, LIT, SHADED, SceneModel, nearest_at
from .scratch import compute_into, gather, line_blocks, release, scratch_array, trim_memory
from .segments import (
    AS_GLINT,
    BRIGHT_IN_LOBE,
    SATURATED_IN_LOBE,
    Light,
    Matches,
    Mixtures,
    Picture,
    Segments,
    Touching,
    assign_bodies,
    beyond,
    border_steps,
    distance_to,
    distinct_pairs,
    divide,
    edge_distance,
    in_parts,
    least_amounts,
    match_segments,
    max_excesses,
    median_spectra,
    mirror_lobes,
    mixtures_of,
    padded,
    sample_pixels,
    senders_of,
    solve,
    touching,
    unmix_spectra,
    without_sun,
)

# --- leaves by their spectrum: lawns are ground with shadows, crowns of trees are not cars -----------------


def is_vegetation(spectrum: Floats, wavelength: Floats) -> Bools:
    # Return whether spectra (n, channel) [1] are of leaves (n,); ``wavelength`` (channel,) [nm].
    rules = VEGETATION
    means = []
    for span in (rules.blue_nm, rules.green_nm, rules.red_nm, rules.edge_nm, rules.infrared_nm):
        # mean over a range of wavelengths; over the nearest channel where it contains none
        inside = (wavelength >= span[0]) & (wavelength <= span[1])
        if not inside.any():
            inside[np.argmin(np.abs(wavelength - 0.5 * sum(span)))] = True
        means.append(np.nan_to_num(spectrum)[:, inside].mean(axis=1))
    blue, green, red, edge, infrared = means
    return np.asarray(
        (edge > rules.min_edge * red) & (infrared < rules.max_rise * edge) & (green > blue) & (red > 0.0)
    )


# --- cast shadows: surfaces of other segments that only sky and objects around light -----------------------

#: Directions (along, across) of the sides of `Touching`.
_STEPS = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])


class Scene(NamedTuple):
    """Segments as input to the search for shadows."""

    spectrum: Floats  #: (segment, channel): Reflectance [1].
    size: Ints  #: (segment,): Number of pixels.
    pairs: Touching  #: Pairs of segments that touch.
    border: Floats  #: (segment,): Number of pixel sides around it, including sides at the picture's edge.


def match_shade(
    number: npt.NDArray[np.int32],
    spectrum: Floats,
    size: Ints,
    pairs: Touching,
    light: Light,
    side: Array | None,
) -> tuple[Matches, Bools]:
    r"""Return the segments that lie in a cast shadow, and whether segments are ground (segment,).

    A segment may be a shadow on a body B where :math:`\rho_B (c f_{dir} + V f_{dif} + b \rho_n)`, the light
    of the sky and of one neighbour n, fits its spectrum with a small c. Dark glass and black paint fit, too;
    four steps of evidence distinguish them:

    1. Certain shadows: they see much of the sky, and touch their lit body on the side away from the sun, or
       all around.
    2. Shadows on the ground, which is the body of most certain shadows. They may be darker and more coloured.
    3. Segments that touch these shadows and are not part of an object in the sun.
    4. By spectrum alone: segments beside a body with the sky's part of its light to 2 % in all channels, and
       with more light than glass or black paint could mirror.

    Steps 2 to 4 exclude segments with the spectrum of a dark body in the sun under a coat that mirrors the
    sky.

    Where clear shadows fall to another side than predicted, a `PaintWarning` is given, and the observed side
    is used.

    Takes ``number`` (line, column): segment of every pixel, -1 without data; ``spectrum`` (segment, channel):
    reflectance [1]; ``size`` (segment,): number of pixels; ``pairs``: touching segments; ``light``: parts of
    the irradiance; ``side`` (2,): direction (along, across) in which shadows fall; if None, the clearest
    shadows determine it.
    """
    count = len(spectrum)
    state, body = np.full(count, LIT, np.int8), np.arange(count, dtype=np.int32)
    edges = (number[0], number[-1], number[:, 0], number[:, -1])
    border = np.bincount(pairs.one, pairs.length, count).astype(np.float64) + sum(
        np.bincount(edge[edge >= 0], minlength=count) for edge in edges
    )
    scene = Scene(spectrum, size, pairs, border)
    ground = np.arange(count) == (np.argmax(size) if count else -1)
    mixtures = _candidates(scene, senders_of(number, np.nan_to_num(spectrum), size), light)
    if not mixtures.segment.size:
        return Matches(state, body), ground
    sides = _lit_sides(mixtures, scene)
    observed_side, coherence = _side_of_shadows(mixtures, sides, scene) or (None, 0.0)
    agree = side is None or observed_side is None or observed_side @ side >= SHADOWS.min_agreement
    if not agree and coherence >= SHADOWS.min_coherence:
        warn_user(
            "shadows fall to another side than sun and heading of the line predict; the observed side "
            "is used. Check the heading, its convention and the clock",
            "shadow-side-contradictory",
        )
        side = observed_side
    side = observed_side if side is None else side
    if side is None:
        _assign(mixtures, _by_spectrum(mixtures, scene, number), state, body)
        return Matches(state, body), ground
    # step 1: certain shadows, clear ones that lie away from the sun beside their lit body, or are enclosed by
    # it. Contact with the lit body: pixel sides, and their sum along `side`
    length, away, segment_border = sides.sum(axis=1), sides @ (_STEPS @ side), border[mixtures.segment]
    touches = (length >= SHADOWS.min_contact_sides) & (length > SHADOWS.sure_border * segment_border)
    is_away = away >= SHADOWS.sure_direction * length
    enclosed = (length > SHADOWS.island_border * segment_border) & (away >= -SHADOWS.sideways * length)
    certain = _are_clear(mixtures) & (mixtures.sky > SHADOWS.min_clear_sky) & touches & (is_away | enclosed)
    _assign(mixtures, certain, state, body)
    ground = _ground(scene, state, body)
    possible = ~_coats_in_the_sun(mixtures, spectrum, light)
    mixtures, length, away = mixtures.subset(possible), length[possible], away[possible]
    # step 2: shadows on the ground
    on_ground, segment_border = ground[mixtures.body], border[mixtures.segment]
    has_contact = length >= SHADOWS.min_contact_sides
    touches = (
        has_contact
        & (length >= SHADOWS.on_ground_border * segment_border)
        & (away >= SHADOWS.on_ground_direction * length)
    )
    # more direct light is allowed with more contact
    max_direct = SHADOWS.sided_direct[0] + SHADOWS.sided_direct[1] * (SHADOWS.open_sky - mixtures.sky)
    sided = (
        (length >= SHADOWS.sided_border * segment_border)
        & (away >= SHADOWS.sided_direction * length)
        & (mixtures.direct < max_direct)
    )
    fits = (mixtures.misfit < SHADOWS.max_misfit) & (without_sun(mixtures) | sided)
    beside = has_contact & (away >= SHADOWS.beside_direction * length) & _are_clear(mixtures)
    # candidates whose misfit is close to that of the best candidate on the ground
    min_misfit = np.full(count, np.inf)
    np.minimum.at(min_misfit, mixtures.segment[on_ground], mixtures.misfit[on_ground])
    max_misfit = SHADOWS.worse_factor * min_misfit[mixtures.segment] + SHADOWS.worse_by
    best = np.asarray((mixtures.misfit < max_misfit) & ~ground[mixtures.segment])
    _assign(mixtures, on_ground & best & ((touches & fits) | beside), state, body)
    # step 3: sides turned away from the sun, and segments that touch shadows
    # candidates that are the side of a bright object that faces away from the sun; its lit side adjoins
    # on the sunward side
    level = np.nan_to_num(scene.spectrum).mean(axis=1)[mixtures.body]
    _assign(
        mixtures,
        (mixtures.misfit < SHADOWS.max_spectral_misfit)
        & (mixtures.direct < SHADOWS.max_turned_direct)
        & (mixtures.sky > SHADOWS.min_turned_ratio * mixtures.direct)
        & (level < SHADOWS.max_lit_level)
        & (mixtures.sent < SHADOWS.max_sent * (1.0 - mixtures.sky))
        & (mixtures.sky * level > DARK_COATS.max_mirrored)
        & (length >= SHADOWS.min_contact_sides)
        & (length > SHADOWS.sure_border * scene.border[mixtures.segment])
        & (away < -SHADOWS.sideways * length)
        & ~on_ground,
        state,
        body,
    )
    _extend(mixtures, ground, best, length, away, scene, state, body)
    # step 4: by spectrum alone
    _assign(mixtures, _by_spectrum(mixtures, scene, number), state, body)
    return Matches(state, body), ground


def _candidates(scene: Scene, senders: Ints, light: Light) -> Mixtures:
    # Pairs of a segment and a brighter body nearby, or one of the largest, with their amounts of light
    spectrum, size, count = scene.spectrum, scene.size, scene.size.size
    is_finite = np.asarray(np.isfinite(spectrum).all(axis=1))
    level = np.where(is_finite, np.nan_to_num(spectrum).mean(axis=1), 0.0)
    largest = np.argsort(-size, kind="stable")[: SHADOWS.large_segments]
    near_segment, near_body = beyond(scene.pairs, size)
    segment = np.concatenate([near_segment, np.repeat(np.arange(count), largest.size)])
    body = np.concatenate([near_body, np.tile(largest, count)])
    fits = (
        is_finite[segment]
        & is_finite[body]
        & (segment != body)
        & (level[segment] < SHADOWS.max_brightness * level[body])
        & (size[body] >= SHADOWS.min_body_share * size[segment])
        & (level[segment] > 0)
    )
    return mixtures_of(*distinct_pairs(segment[fits], body[fits], count), spectrum, senders, light)


def _lit_sides(mixtures: Mixtures, scene: Scene) -> Floats:
    # Number of sides (n, 4), by direction, on which candidates touch segments with the surface of their body
    # all touching pairs of every candidate's segment, one after another
    pairs = scene.pairs
    start, stop = np.searchsorted(pairs.one, [mixtures.segment, mixtures.segment + 1])
    counts = stop - start
    row = np.repeat(np.arange(counts.size), counts)
    pair = np.arange(row.size) - np.repeat(np.cumsum(counts) - counts, counts) + np.repeat(start, counts)
    same = _same_surface(scene.spectrum, pairs.other[pair], mixtures.body[row])
    return np.stack(
        [np.bincount(row[same], pairs.sides[pair[same], direction], counts.size) for direction in range(4)],
        axis=1,
    ).astype(np.float64)


def _same_surface(spectrum: Floats, one: Ints, other: Ints) -> Bools:
    # Whether two segments have spectra of similar brightness and shape (pair,)
    level = spectrum.mean(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        shape = spectrum / level[:, None]
        close = np.flatnonzero(np.abs(level[one] / level[other] - 1.0) < SHADOWS.max_level_difference)
    is_same = np.zeros(one.size, bool)
    for part in in_parts(close.size):  # a long line has millions of pairs
        pairs = close[part]
        difference = np.abs(shape[one[pairs]] - shape[other[pairs]]).max(axis=1)
        is_same[pairs] = difference < SHADOWS.max_shape_difference
    return is_same


def _side_of_shadows(mixtures: Mixtures, sides: Floats, scene: Scene) -> tuple[Floats, float] | None:
    # Direction (along, across) in which shadows fall, and the agreement of shadows [1]; None without shadows
    clear = _are_clear(mixtures) & (scene.size[mixtures.segment] >= SHADOWS.min_telling_px)
    # shadows on the ground take precedence: the shadow beside a dark car may seem to lie on its paint
    largest = np.argmax(scene.size)
    body = np.unique(mixtures.body)
    ground_bodies = body[_same_surface(scene.spectrum, body, np.full(body.size, largest))]
    on_ground = clear & np.isin(mixtures.body, ground_bodies)
    on_ground &= (mixtures.sky > SHADOWS.min_telling_sky) & sides.any(axis=1)
    clear = on_ground if on_ground.any() else clear & (mixtures.sky > SHADOWS.min_clear_sky)
    directions = sides[clear] @ _STEPS * scene.size[mixtures.segment[clear], None]
    total = directions.sum(axis=0)
    length, sum_of_lengths = float(np.hypot(*total)), float(np.hypot(*directions.T).sum())
    return (np.asarray(total / length), length / sum_of_lengths) if length > 0 else None


def _are_clear(mixtures: Mixtures, max_sent: float = SHADOWS.max_sent) -> Bools:
    # Whether candidates fit well and, unlike glass and black paint, get little light other than the sky's
    hidden = np.clip(SHADOWS.open_sky - mixtures.sky, 0.0, 1.0)
    return np.asarray(
        (mixtures.direct < SHADOWS.clear_direct[0] + SHADOWS.clear_direct[1] * hidden)
        & (mixtures.sent < max_sent * (1.0 - mixtures.sky))
        & (mixtures.misfit < SHADOWS.max_clear_misfit)
    )


def _coats_in_the_sun(mixtures: Mixtures, spectrum: Floats, light: Light) -> Bools:
    # Whether candidates are more likely a dark body in the sun whose coat mirrors the sky.
    # `\rho (f_{dir} + f_{dif}) + m f_{dif} l_z`, with `\rho` linear in wavelength and m the reflectance of a
    # clear coat, fitted with the zenith and with the mean sky as mirrored light.
    segments, row = np.unique(mixtures.segment, return_inverse=True)
    spectra = np.nan_to_num(spectrum[segments])
    ramp = DARK_COATS.slope * np.linspace(-1.0, 1.0, spectra.shape[1])
    amount, misfit = least_amounts(
        spectra,
        [
            np.broadcast_to(part, spectra.shape)
            for part in (1.0 + ramp, 1.0 - ramp, light.above, light.diffuse)
        ],
    )
    body, mirrored = amount[:, :2].sum(axis=1), amount[:, 2:].sum(axis=1)
    dark = (
        (body > DARK_COATS.min_body)
        & (spectra.mean(axis=1) < DARK_COATS.max_level)
        & (mirrored > DARK_COATS.min_mirrored)
        & (mirrored < DARK_COATS.max_mirrored)
        & (misfit < DARK_COATS.max_misfit)
        & (spectra > 0).all(axis=1)
    )
    return np.asarray(dark[row] & (DARK_COATS.worse_factor * misfit[row] < mixtures.misfit))


def _by_spectrum(mixtures: Mixtures, scene: Scene, number: npt.NDArray[np.int32]) -> Bools:
    # Whether candidates are shadows by their spectrum, beside their lit body on any side
    level = np.nan_to_num(scene.spectrum).mean(axis=1)
    fits = (
        (mixtures.misfit < SHADOWS.max_spectral_misfit)
        & (mixtures.direct < SHADOWS.max_spectral_direct)
        & (mixtures.sky > SHADOWS.min_clear_sky)
        & (mixtures.sent < SHADOWS.max_spectral_direct)
        & (level[mixtures.segment] < SHADOWS.max_brightness * level[mixtures.body])
        & (mixtures.sky * level[mixtures.body] > SHADOWS.min_spectral_level)
        & (scene.size[mixtures.segment] >= SHADOWS.min_telling_px)
    )
    boxes = find_objects(number + 1) if fits.any() else []
    for row in np.flatnonzero(fits):
        numbers = number[padded(boxes[mixtures.segment[row]], SHADOWS.beside_px)]
        near = binary_dilation(numbers == mixtures.segment[row], iterations=SHADOWS.beside_px)
        fits[row] = (numbers[near] == mixtures.body[row]).sum() >= SHADOWS.beside_px
    return np.asarray(fits)


def penumbrae(
    channels: Floats32, number: npt.NDArray[np.int32], matches: Matches, ground: Bools, light: Light
) -> npt.NDArray[np.int32]:
    # Return the segment of every pixel (line, column), with penumbrae on objects added to their shadows.
    #
    # Light fades over some pixels at the edge of a shadow; the division into segments gave these pixels to
    # any neighbour. Takes ``matches``, ``ground``: from `match_shade`; shadows on the ground are unchanged.
    result = number
    shadows = np.flatnonzero((matches.state == SHADED) & ~ground[matches.body])
    boxes = find_objects(number + 1) if shadows.size else []
    for segment in shadows:
        window = padded(boxes[segment], SHADOWS.penumbra_px)
        numbers, body = number[window], matches.body[segment]
        near = binary_dilation(numbers == segment, iterations=SHADOWS.penumbra_px)
        near &= (numbers >= 0) & (numbers != segment) & (numbers != body)
        lit_spectra = channels[window][numbers == body].astype(np.float64)
        lit_spectra = lit_spectra[np.isfinite(lit_spectra).all(axis=1)]
        if not near.any() or not lit_spectra.size:
            continue
        # near pixels that are the lit body with less direct light
        lit = np.median(lit_spectra, axis=0)
        spectra = channels[window][near].astype(np.float64)
        amount, misfit = solve(np.nan_to_num(spectra), np.broadcast_to(lit, spectra.shape), None, light)
        bluer = amount[:, 1] > amount[:, 0] + SHADOWS.min_pixel_sky_excess
        fades = (
            (amount[:, 0] < SHADOWS.max_pixel_direct)
            & (misfit < SHADOWS.max_misfit)
            & bluer
            & (amount[:, 1] < SHADOWS.max_penumbra_sky)
        )
        if result is number:
            result = number.copy()
        view = result[window]
        view[near] = np.where(fades, segment, view[near])
        release(channels)
    return result


def _ground(scene: Scene, state: Array, body: Array) -> Bools:
    # Whether segments are ground (segment,): the largest segment, and bodies with many shadows on them.
    # Too bright or too small bodies are white cars with shadows of other cars on them.
    count = scene.size.size
    shaded_px = np.bincount(body, np.where(state == SHADED, scene.size, 0), count)
    is_ground = np.zeros(count, bool)
    largest = scene.size == scene.size.max()
    bright = np.nan_to_num(scene.spectrum).mean(axis=1) > SHADOWS.max_ground_level
    has_shadows = shaded_px > SHADOWS.min_ground_share * shaded_px.sum()
    for candidate in np.flatnonzero(largest | (has_shadows & ~bright)):
        same = _same_surface(scene.spectrum, np.arange(count), np.full(count, candidate))
        if largest[candidate] or scene.size[same].sum() > SHADOWS.min_ground_size * scene.size.sum():
            is_ground |= same
    return is_ground


def _extend(
    mixtures: Mixtures,
    ground: Bools,
    best: Bools,
    length: Floats,
    away: Floats,
    scene: Scene,
    state: Array,
    body: Array,
) -> None:
    # Assign candidates that touch shadows, and are not in the sun, until none is added
    pairs, segment_border, on_ground = scene.pairs, scene.border[mixtures.segment], ground[mixtures.body]
    faces_sun = (away < -SHADOWS.sideways * length) & (length > SHADOWS.sure_border * segment_border)
    fits = best & ~faces_sun & without_sun(mixtures)
    in_limits = (mixtures.misfit < SHADOWS.max_misfit) & (mixtures.sky < SHADOWS.open_sky)
    ground_shadows = fits & on_ground & in_limits
    bright = mixtures.sky > SHADOWS.min_clear_sky
    max_misfit = np.where(bright, SHADOWS.max_dim_misfit, SHADOWS.max_dark_misfit)
    object_shadows = fits & ~on_ground & (mixtures.misfit < max_misfit)
    # shadows on bay lines and kerbs: dark glass compared with these gets less light of the sky
    enclosable = best & ~faces_sun & (mixtures.misfit < SHADOWS.max_dim_misfit)
    enclosable &= (mixtures.direct < SHADOWS.max_enclosed_direct) & (mixtures.sky > SHADOWS.min_enclosed_sky)
    # width of the rectangle with the size and the border of a segment
    quarter = scene.border / 4.0
    width = quarter - np.sqrt(np.maximum(quarter**2 - scene.size, 0.0))
    markings = (
        object_shadows
        & (mixtures.sky > SHADOWS.min_marking_sky)
        & (mixtures.direct < SHADOWS.max_marking_direct)
        & (width[mixtures.segment] <= SHADOWS.max_marking_width * width[mixtures.body])
    )
    clear = _are_clear(mixtures, max_sent=SHADOWS.max_sent_beside)
    for _ in range(SHADOWS.rounds):
        # share of the border that touches any shadow, and shadows on the ground
        shaded = state == SHADED
        beside_shadow, beside_ground_shadow = (
            np.bincount(pairs.one, pairs.length * mask[pairs.other], shaded.size)[mixtures.segment]
            / segment_border
            for mask in (shaded, shaded & ground[body])
        )
        enough = (
            (ground_shadows & (beside_shadow > np.where(clear, SHADOWS.next_clear, SHADOWS.next)))
            | (object_shadows & bright & (beside_shadow > SHADOWS.next))
            | (markings & (beside_ground_shadow > SHADOWS.next_marking))
            | (enclosable & (beside_shadow > SHADOWS.enclosed))
        )
        if not _assign(mixtures, enough, state, body):
            break


def _assign(mixtures: Mixtures, accepted: Bools, state: Array, body: Array) -> bool:
    # Put every segment into the shadow of the best fitting body of its accepted candidates
    chosen = mixtures.subset(accepted)
    return assign_bodies(chosen.segment, chosen.body, chosen.misfit, SHADED, state, body)


def shaded_pixels(
    channels: Floats32, number: npt.NDArray[np.int32], level: Bools, reference: Floats, light: Light
) -> Bools:
    # Return the pixels (line, column) of level ground that lack direct light: shadows of thin objects.
    #
    # Other surfaces are not tested: they also lack direct light where they lean away from the sun.
    #
    # Takes ``channels`` (line, column, channel): reflectance [1]; ``number`` (line, column): segment of every
    # pixel, -1 without data; ``level`` (segment,): true for ground in the sun; ``reference`` (segment,
    # channel): reflectance of bodies in full light [1]; ``light``: parts of the irradiance.
    shaded = np.zeros(number.shape, bool)
    lit_brightness = np.append(reference.mean(axis=1), 0.0)
    on_ground = np.append(level, False)[number]
    for lines, block in line_blocks(channels):
        segment = number[lines]
        tested = on_ground[lines] & (block.mean(axis=2) < SHADOWS.max_pixel_level * lit_brightness[segment])
        amount, misfit = solve(block[tested].astype(np.float64), reference[segment[tested]], None, light)
        bluer = amount[:, 1] > amount[:, 0] + SHADOWS.min_pixel_sky_excess
        missing = (amount[:, 0] < SHADOWS.max_pixel_direct) & bluer & (misfit < SHADOWS.max_pixel_misfit)
        shaded[lines][tested] = missing
    return shaded


def of_shadows(shaded: Bools, dark: Bools) -> Bools:
    # Return the pixels without direct light (line, column) that belong to a shadow, not to ground texture.
    #
    # They are connected sets that touch a segment in shadow, and long thin sets, such as the shadows of
    # posts. Takes ``shaded`` (line, column): pixels without direct light; ``dark`` (line, column): pixels of
    # segments in shadow.
    pieces, count = label(shaded, np.ones((3, 3)))
    belongs = np.zeros(count + 1, bool)
    belongs[np.unique(pieces[binary_dilation(dark, np.ones((3, 3))) & shaded])] = True
    # block by block: bincount converts its input to 64 bits
    size = np.sum(
        [np.bincount(block.ravel(), minlength=count + 1) for _, block in line_blocks(pieces)], axis=0
    )
    for number, window in enumerate(find_objects(pieces), 1):
        if belongs[number] or size[number] < SHADOWS.min_thin_px:
            continue
        positions = np.stack(np.nonzero(pieces[window] == number)).astype(np.float64)
        # variances across and along the set; 1/12 is the variance within a pixel
        across, along = np.linalg.eigvalsh(np.cov(positions))
        belongs[number] = along > SHADOWS.min_thinness**2 * max(across, 1.0 / 12.0)
    belongs[0] = False
    return np.asarray(belongs[pieces])


# --- bodies in full light: coloured bodies that light others, and reference spectra without glint ----------


def coloured(spectrum: Floats, light: Light) -> Floats:
    # Return the colour of spectra (segment,): rms residual of a fit of a constant and diffuse light [1].
    #
    # Channels without values are excluded; the colour is 0 where too few remain.
    basis = np.stack([np.ones_like(light.direct), light.diffuse], axis=1)
    is_finite = np.isfinite(spectrum)
    colour = np.zeros(len(spectrum))
    for pattern in np.unique(is_finite, axis=0):
        if pattern.sum() <= basis.shape[1]:
            continue
        rows = (is_finite == pattern).all(axis=1)
        spectra = spectrum[rows][:, pattern]
        amounts, *_ = np.linalg.lstsq(basis[pattern], spectra.T, rcond=None)
        colour[rows] = np.sqrt(np.mean((spectra - (basis[pattern] @ amounts).T) ** 2, axis=1))
    return colour


def coloured_bodies(spectrum: Floats, light: Light) -> Bools:
    # Return whether spectra are coloured enough to be distinguished from mirrored sunlight (segment,).
    return np.asarray(_relative_colour(spectrum, light) > BODIES.min_paint_colour)


def nearest_coloured(
    number: npt.NDArray[np.int32], size: Ints, spectrum: Floats, matches: Matches, light: Light, reach: int
) -> npt.NDArray[np.int32]:
    # Return the nearest coloured segments in full light of every cell (cell_along, cell_cross, rank).
    #
    # Takes ``number`` (line, column): segment of every pixel; ``size``, ``spectrum``, ``matches``: of the
    # segments; ``light``: parts of the irradiance; ``reach``: maximum distance of their light [pixel].
    sends = (
        (coloured(spectrum, light) > BODIES.min_sender_colour)
        & (matches.state == LIT)
        & (size >= BODIES.min_sender_px)
        & (np.nan_to_num(spectrum).mean(axis=1) < BODIES.max_sender_level)
        & coloured_bodies(spectrum, light)
    )
    centre = number[CELL // 2 :: CELL, CELL // 2 :: CELL]
    cells = tuple(-(-length // CELL) for length in number.shape)
    labels = np.full((*cells, BODIES.neighbours_of_cell), -1, np.int32)
    labels[: centre.shape[0], : centre.shape[1], 0] = np.where(np.append(sends, False)[centre], centre, -1)
    nearest_sources(labels, np.where(labels >= 0, 0.0, np.inf), reach / CELL)
    return labels


_NEIGHBOURS = 2 * [(0.0, 0.1), (0.0, 0.05)]
#: Prior of the amounts in a pixel: expected values and standard deviations (2, part).
_AS_PIXEL = np.transpose(
    [(1.0, 0.2), (1.0, 0.3), (BODIES.offset, 0.1), (BODIES.offset, 0.02), (0.0, 0.03), *_NEIGHBOURS]
)


def _relative_colour(spectrum: Floats, light: Light) -> Floats:
    # Colour of spectra relative to their brightness (segment,) [1]
    return np.asarray(coloured(spectrum, light) / np.maximum(np.nan_to_num(spectrum).mean(axis=1), 1e-6))


def same_paints(
    spectrum: Floats, size: Ints, pairs: Touching, matches: Matches, light: Light
) -> tuple[npt.NDArray[np.int32], tuple[Ints, Ints]]:
    r"""Return the first body with the paint of every segment (segment,), and pairs of bodies of one paint.

    The bodies of a pair (pair,) are near, such as the parts of one car; every pair occurs in both orders.

    Two bodies that touch, or have a small segment between them, have the same paint where :math:`\rho (c
    f_{dir} + V f_{dif}) + g f_{dir}`, the spectrum of the first in other light, fits the second to 2 %. Grey
    bodies are not joined: their paints cannot be distinguished.
    """
    near = beyond(pairs, size)
    one, other = matches.body[near[0]].astype(np.int64), matches.body[near[1]].astype(np.int64)
    is_coloured = np.isfinite(spectrum).all(axis=1) & coloured_bodies(spectrum, light)
    is_candidate = (one != other) & is_coloured[one] & is_coloured[other]
    one, other = distinct_pairs(one[is_candidate], other[is_candidate], size.size)
    finite_spectrum = np.nan_to_num(spectrum)
    _, misfit, _ = unmix_spectra(
        finite_spectrum[one], other, finite_spectrum, light, GLINT.tolerance, AS_GLINT
    )
    one, other = one[misfit < 1.0], other[misfit < 1.0]
    _, label = scipy.sparse.csgraph.connected_components(
        scipy.sparse.csr_array((np.ones(one.size), (one, other)), shape=(size.size, size.size)),
        directed=False,
    )
    _, first = np.unique(label, return_index=True)
    both_orders = np.concatenate([one, other]), np.concatenate([other, one])
    return first[label][matches.body].astype(np.int32), distinct_pairs(*both_orders, size.size)


def clean_references(
    channels: Floats32,
    samples: list[Ints],
    spectrum: Floats,
    matches: Matches,
    same_paint: tuple[Ints, Ints],
    light: Light,
    neighbours: Callable[[Ints], npt.NDArray[np.int32]],
    zenith: float,
) -> tuple[Floats, Floats]:
    # Return the spectra of bodies (segment, channel) without glint, and the lean of their parts (segment,).
    #
    # Glint and light of neighbours are added light. Where it differs from pixel to pixel by over 0.003, the
    # pixels with the least of it are averaged. On grey bodies glint cannot be separated; where brightness
    # differs by more than tilt towards the sun allows, the darkest pixels that see as much of the sky are
    # averaged. Glint that covers a whole body is estimated from another part with the same paint.
    #
    # Takes ``channels`` (line, column, channel): reflectance [1]; ``samples``: flat indices of pixels of
    # every segment; ``spectrum`` (segment, channel): median reflectance [1]; ``same_paint``: see
    # `same_paints`; ``neighbours``: function that returns the coloured segments beside pixels (pixel, 2);
    # ``zenith``: angle of the sun [degree]; NaN where unknown.
    finite_spectrum = np.nan_to_num(spectrum)
    reference, tilt = finite_spectrum.copy(), np.full(len(spectrum), BODIES.tilt)
    colour = _relative_colour(spectrum, light)
    # minimum brightness of glint relative to a body that leans away from the sun
    min_glint_ratio = BODIES.min_glint_brightness / max(
        np.cos(np.radians(np.nan_to_num(zenith, nan=60.0))), 0.2
    )
    flat = channels.reshape(-1, channels.shape[2])
    for segment, indices in enumerate(samples):
        if matches.body[segment] != segment or not np.isfinite(spectrum[segment]).all():
            continue
        values = gather(flat, indices).astype(np.float64)
        is_finite = np.isfinite(values).all(axis=1)
        indices, values = indices[is_finite], values[is_finite]
        if indices.size < BODIES.min_body_px:
            continue
        grey = colour[segment] < BODIES.max_grey_colour
        darkest = _darkest(values, light, min_glint_ratio) if grey else None
        if darkest is not None:
            reference[segment] = darkest
            median_ratio = np.median(values.mean(axis=1)) / darkest.mean()
            if darkest.mean() > BODIES.bright and median_ratio > BODIES.min_mostly_glint:
                tilt[segment] = BODIES.glint_tilt
            continue
        # Light added to pixels by glint and neighbours, up to a constant, and their direct light. Unmixing
        # returns no negative amounts: a constant amount of glint and neighbour light is added to all pixels,
        # so that deviations below the mean show, too.
        near = neighbours(indices)
        neighbour_spectra = np.where(near[:, :1] >= 0, finite_spectrum[near[:, 0]], 0.0)
        lifted = values + BODIES.offset * (light.direct + light.above) + BODIES.lift * neighbour_spectra
        amount, _, added_by_neighbours = unmix_spectra(
            lifted, np.full(len(values), segment), finite_spectrum, light, 0.01, _AS_PIXEL, near
        )
        glint = amount[:, 2] + amount[:, 4] + added_by_neighbours.sum(axis=1)
        added, direct = glint - BODIES.lift * neighbour_spectra.max(axis=1), amount[:, 0]
        low, median = np.quantile(added, [0.1, 0.5])
        if median - low > BODIES.min_difference:
            low, high = np.quantile(added, BODIES.clean_grey_quantiles if grey else BODIES.clean_quantiles)
            clean = (added >= low) & (added <= high) & (direct > 0.7)
            if clean.sum() >= BODIES.min_clean_px:
                # scaled to the median direct light of the body: the clean pixels may lean differently
                scale = 1.0 if grey else np.median(direct) / np.median(direct[clean])
                reference[segment] = values[clean].mean(axis=0) * scale
    # mirrored sun, and the sky around it, that cover a whole body (segment, 2), by comparison with other
    # parts of the same paint
    size = np.array([indices.size for indices in samples])
    one, other = same_paint
    large = size[other] >= BODIES.min_part_share * size[one]
    one, other = one[large], other[large]
    amount, misfit, _ = unmix_spectra(reference[one], other, reference, light, GLINT.tolerance, AS_GLINT)
    glint = np.zeros((len(reference), 2))
    np.maximum.at(glint, one[misfit < 1.0], amount[misfit < 1.0][:, [2, 4]])
    reference -= glint @ np.stack([light.direct, light.sunward])
    return np.ascontiguousarray(reference[matches.body]), tilt[matches.body]


def _darkest(values: Floats, light: Light, min_glint_ratio: float) -> Floats | None:
    # Mean spectrum of a grey body's darkest pixels; None where these may not be free of glint.
    # Three conditions: the brightest pixels exceed the usual ones by `min_glint_ratio`; the median is not
    # much brighter than the darkest pixels, as it is beside a shadow; the darkest pixels see as much of the
    # sky as the median pixel.
    if not light.direct.any():
        return None
    level = values @ light.direct / (light.direct @ light.direct)
    low, high, usual, median, brightest = np.quantile(
        level, [*BODIES.darkest_quantiles, BODIES.usual_quantile, 0.5, BODIES.brightest_quantile]
    )
    if low <= 0.0 or brightest <= min_glint_ratio * usual or median >= BODIES.max_even_ratio * low:
        return None
    clean_low, clean_high = np.quantile(level, BODIES.clean_grey_quantiles)
    if clean_high - clean_low < BODIES.max_plateau:  # mostly without glint: the darkest pixels lean away
        low, high = clean_low, clean_high
    darkest = values[(level >= low) & (level <= high)].mean(axis=0)
    split = np.stack([light.direct, light.diffuse], axis=1)
    spectra = np.stack([darkest, np.median(values, axis=0)], axis=1)
    (_, (darkest_sky, median_sky)), *_ = np.linalg.lstsq(split, spectra, rcond=None)
    return np.asarray(darkest) if darkest_sky > BODIES.min_sky * median_sky else None


def channel_numbers(wavelength: Array, good: Array) -> Ints:
    # Return the channel of every band; -1 for bands that are not good.
    #
    # Channels are runs of equally many good bands: 24 channels of a 400-1000 nm camera are 25 nm wide.
    order = np.flatnonzero(good)[np.argsort(wavelength[good], kind="stable")]
    numbers = np.full(wavelength.size, -1, np.int64)
    numbers[order] = np.arange(order.size) * min(SURVEY.channels, order.size) // max(order.size, 1)
    return numbers


def to_channels(block: Array, channel: Ints) -> Floats32:
    # Return the means (line, column, channel) of a block (line, band, column).
    channels = np.empty((block.shape[0], block.shape[2], int(channel.max()) + 1), np.float32)
    average_bands(np.ascontiguousarray(block, np.float32), channel, channels)
    return channels


def read_channels(
    cube: xr.DataArray, channel: Ints, layers: Sequence[Any] = (), progress: Progress | None = None
) -> list[Array]:
    # Return a complete line in channels (line, column, channel), float32, and its ``layers`` (line, column).
    #
    # All are read by one pass in blocks, into scratch arrays. Results have the same bits for any blocks, as
    # every mean is over the bands of one pixel.
    data = line_chunked(cube).data
    lines, _, columns = data.shape
    count = int(channel.max()) + 1
    blocks = da.map_blocks(
        to_channels,
        data,
        channel,
        dtype=np.float32,
        chunks=(data.chunks[0], (columns,), (count,)),
        meta=np.empty((0, 0, 0), np.float32),
    )
    lazy = [blocks, *(da.asarray(layer).rechunk((data.chunks[0], -1)) for layer in layers)]
    arrays = [scratch_array((lines, columns, *array.shape[2:]), array.dtype) for array in lazy]
    compute_into(lazy, arrays, progress)
    return arrays


def without_unknown(channels: Floats32, channel: Ints) -> tuple[Floats32, Ints]:
    # Return a line in channels, and the channel of every band, without channels that most pixels lack.
    #
    # A channel that is dead in all pixels would leave no segment with a complete spectrum. If no channel
    # would remain, all are retained.
    with_data, with_value = 0, np.zeros(channels.shape[2], np.int64)
    for _, block in line_blocks(channels):
        is_finite = np.isfinite(block)
        with_data += int(is_finite.any(axis=2).sum())
        with_value += is_finite.sum(axis=(0, 1))
    retained = 2 * with_value >= with_data
    if retained.all() or not retained.any():
        return channels, channel
    # new number of every channel; the last entry keeps -1
    numbers = np.append(np.where(retained, np.cumsum(retained) - 1, -1), -1)
    reduced = scratch_array((*channels.shape[:2], int(retained.sum())), np.float32)
    for lines, block in line_blocks(channels):
        reduced[lines] = block[..., retained]
        release(reduced)
    return reduced, numbers[channel]


def shift_of_channels(line: xr.Dataset, channel: Ints, columns: int) -> Floats:
    # Return true less nominal wavelength of the channels (channel, column) [nm].
    #
    # 0 where the line has no ``wavelength_shift``, or it is NaN.
    bands = (channel == np.arange(channel.max() + 1)[:, None]).astype(np.float64)
    bands /= bands.sum(axis=1, keepdims=True)
    if "wavelength_shift" not in line.variables:
        return np.zeros((len(bands), columns))
    variable = schema.require(line, ["wavelength_shift"], "smile")["wavelength_shift"].variable
    if variable.ndim > 1:
        variable = variable.transpose(BAND, CROSS_TRACK)
    shift = np.nan_to_num(np.asarray(variable.values, np.float64))
    return np.ascontiguousarray(bands @ np.broadcast_to(shift, (channel.size, columns)))


def to_nominal_channels(channels: Floats32, centre: Floats, shift: Floats) -> None:
    # Remove the smile from channels (line, column, channel) in place.
    #
    # Subtracts the spectral slope, from the channels on both sides, times the wavelength shift, which is much
    # smaller than a channel's width. Takes ``centre`` (channel,) [nm]; ``shift`` (channel, column) [nm].
    if len(centre) < 2 or not shift.any():
        return
    for _, lines in line_blocks(channels):
        for block in np.split(lines, range(CHUNK_LINES, len(lines), CHUNK_LINES)):
            slope = np.gradient(block.astype(np.float64), centre, axis=2)
            block -= np.nan_to_num(slope * shift.T).astype(np.float32)


def channel_noise(channels: Floats32, number: npt.NDArray[np.int32], inside: Bools) -> Floats:
    # Return the noise of channels (channel,), relative to the reflectance [1].
    #
    # The noise follows from differences between neighbouring pixels of a segment, and their second
    # differences over the channels: true differences are small and smooth over the channels. 0 where it
    # cannot be estimated.
    #
    # Takes ``channels`` (line, column, channel): reflectance [1]; ``number`` (line, column): segment of every
    # pixel; ``inside`` (line, column): whether a pixel lies away from the segment's border.
    count = channels.shape[2]
    is_pair = (number[:, 1:] == number[:, :-1]) & (number[:, 1:] >= 0) & inside[:, 1:] & inside[:, :-1]
    total, passed = int(np.count_nonzero(is_pair)), 0
    if count < 3 or not total:
        return np.zeros(count)
    # every step-th pair of the line, counted across blocks
    step = max(1, total // SURVEY.max_noise_pairs)
    pairs: list[list[Array]] = []
    for lines, block in line_blocks(channels):
        y, x = np.nonzero(is_pair[lines])
        sample = slice(-passed % step, None, step)
        passed += y.size
        pairs.append([block[y[sample], x[sample] + dx] for dx in (0, 1)])
    left, right = (np.concatenate(side).T for side in zip(*pairs, strict=True))
    noise = np.zeros(count - 2)
    for k in range(1, count - 1):
        # three channels at a time, to save memory
        left3, right3 = left[k - 1 : k + 2].astype(np.float64), right[k - 1 : k + 2].astype(np.float64)
        difference, level = left3 - right3, (left3[1] + right3[1]) / 2
        curvature = difference[1] - (difference[2] + difference[0]) / 2
        relative = curvature / np.maximum(level, SURVEY.min_noise_level)
        deviations = np.abs(relative[np.isfinite(relative)])
        # its variance is three times that of a channel: (1 + 1/4 + 1/4) for each of two pixels
        noise[k - 1] = 1.4826 * np.median(deviations) / np.sqrt(3.0) if deviations.size else 0.0
    return np.pad(noise, 1, mode="edge")


_OPTIONS = {
    "reach": Fact(doc="", kind="whole", least=1),
    "heading": Fact(doc="", kind="number", optional=True),
    "sun_azimuth": Fact(doc="", kind="number", optional=True),
}


@takes_quantities(sun_zenith="degree", sun_azimuth="degree", heading="degree")
@documented()
def survey(
    line: xr.Dataset,
    *,
    diffuse: Any = None,
    sun_zenith: float | None = None,
    sun_azimuth: float | None = None,
    heading: float | None = None,
    reach: int = 120,
    progress: Progress | bool | None = None,
) -> SceneModel:
    r"""Survey a flight line, and return the scene model that flags use.

    Eager. The line is read once, in blocks. During the survey its means over 24 channels take 96 bytes a
    pixel, in a temporary file for more than some 500 lines, and other arrays some 30 bytes a pixel of memory.
    Results have the same bits for any chunks and scheduler.

    Parameters
    ----------
    line
        A flight line with ``reflectance`` (along_track, band, cross_track) [1] and ``wavelength``. Time,
        latitude, longitude and heading, where present, determine the direction of the sun in the image.
    diffuse
        Source of the diffuse part of the irradiance. None: mean over lines of the line's
        ``diffuse_fraction``, or else of the split from its ``irradiance`` record; without either, as "model",
        with a warning. "model": the clear sky of `hyperpaint.light.sun`. "pvlib": SPECTRL2 (extra ``sim``).
        "shadow": a cast shadow on the ground in the image. Or a measured spectrum, an array (band,) or a
        DataArray with a coordinate ``wavelength``, such as a reading in the shade of a small disc over the
        reading in full light.
    sun_zenith
    sun_azimuth, heading
        Clockwise from north [degree]; by default from the line. Without them, the side of shadows is
        estimated from the most certain ones.
    reach
        Maximum distance at which light of a coloured object is considered [pixel].
    progress
        True for a bar on stderr, or a function called with (lines done, lines to do).

    Returns
    -------
    SceneModel

    Raises
    ------
    SchemaError, UnitsError
        Variables are missing or have other dims or units; the line has no pixel or no good band; the
        wavelength of a good band is missing; the position of the sun is unknown; ``diffuse`` has another
        value, or there is no shadow.
    MissingExtraError
        pvlib is not installed.

    Warns
    -----
    PaintWarning
        A clear sky is assumed, since the line has no record of its light.

    Notes
    -----
    1. Segments: neighbouring pixels are joined in ascending order of their difference [1]_; small or thin
       segments are joined to a neighbour, and are mixed pixels where they lie between two bodies. Where parts
       of one car differ by tilt, pixels between them are not mixed.
    2. Segments that are another segment's surface in shadow,
       :math:`\rho (c f_{dir} + V f_{dif} + b \rho_n)` with small c and the light b of one coloured neighbour,
       or that fade into another under the mirror image of the sun,
       :math:`\rho (c f_{dir} + V f_{dif}) + g f_{dir}`, get its spectrum. Dark glass and black paint can look
       like asphalt in shadow in every band: a shadow touches its lit body, on a side away from the sun, or
       another shadow. On the ground, single pixels are shadow where direct light is missing and light of the
       sky is not. Where the sky has over 95 % of the light there are no shadows, and no mirror images of the
       sun.
    3. A body's reference is the mean of the pixels with least glint and light from coloured neighbours, less
       glint that covers the whole body, estimated from other parts of the same coloured paint.
    4. The nearest coloured segments of every 4 x 4 pixels.

    Channels that most pixels lack, such as those of dead bands, are left out. A body that lies wholly in
    shadow or in glint, without a touching part outside, keeps its spectrum.

    References
    ----------
    .. [1] P. F. Felzenszwalb, D. P. Huttenlocher, "Efficient graph-based image segmentation", Int. J. Comput.
       Vis. 59, 167-181 (2004). doi:10.1023/B:VISI.0000022288.19776.77

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> nm = np.linspace(400.0, 1000.0, 48)
    >>> seen = np.full((16, 48, 16), 0.1, np.float32)
    >>> seen[:, :, 8:] = 0.5
    >>> line = xr.Dataset({"reflectance": (("along_track", "band", "cross_track"), seen, {"units": "1"})},
    ...                   {"wavelength": ("band", nm, {"units": "nm"})})
    >>> survey(line, sun_zenith=30.0, diffuse="model").segments
    2
    """
    line = schema.rename_to_roles(line)
    variables = schema.require(line, ["reflectance", "wavelength"], "a scene model")
    cube = variables["reflectance"]
    wavelength = variables["wavelength"].values.astype(np.float64)
    with Problems("this line cannot be surveyed", SchemaError) as problems:
        good = _good_bands(line, cube, wavelength, problems)
        values = {"reach": reach, "heading": heading, "sun_azimuth": sun_azimuth}
        check_values(_OPTIONS, values, problems)
    try:
        line_split = split_of(line, diffuse, sun_zenith, from_shadow=True).mean()
    except SchemaError as error:
        if not (isinstance(diffuse, str) and diffuse == "shadow"):
            raise
        raise SchemaError(
            "diffuse='shadow' starts from the light of a clear sky", problems=[error.problem]
        ) from error
    fraction, zenith = line_split.fraction.values, line_split.zenith
    channel = channel_numbers(wavelength, good)
    is_saturated: Any = np.zeros((cube.shape[0], cube.shape[2]), bool)
    if "quality" in line.variables:
        quality = schema.require(line, ["quality"], "a scene model")["quality"]
        bits = quality.transpose(ALONG_TRACK, CROSS_TRACK).data
        is_saturated = (bits & np.uint16(Quality.SATURATED)) > 0
    channels, saturated = read_channels(cube, channel, [is_saturated], as_progress(progress, "survey"))
    channels, channel = without_unknown(channels, channel)
    spectra = (wavelength, fraction, line_split.u.values, *line_split.mirrored())
    is_used = channel >= 0
    used, counts = channel[is_used], np.bincount(channel[is_used])
    centre, split, split_u, *sky = (np.bincount(used, values[is_used]) / counts for values in spectra)
    shift = shift_of_channels(line, channel, channels.shape[1])
    to_nominal_channels(channels, centre, shift)
    light = Light.under(split, *sky)
    segments = divide(channels)
    trim_memory()
    count = segments.size.size
    boundary_px = np.empty(segments.number.shape, np.uint8)
    boundary_distance(segments.number, segments.sure, 255, boundary_px)
    is_inside = boundary_px >= SURVEY.min_edge_distance_px
    samples = sample_pixels(segments.number, is_inside, count)
    del boundary_px
    spectrum = median_spectra(channels, samples)
    side = shadow_side_of(line, sun_azimuth, heading)
    pairs = touching(segments.number, count)
    steps = border_steps(channels, segments.number, pairs)

    def matched(light: Light) -> tuple[Matches, Bools]:
        # states and bodies of the segments, and whether segments are ground
        if light.direct.mean() < SURVEY.min_direct:
            lit = Matches(np.full(count, LIT, np.int8), np.arange(count, dtype=np.int32))
            return lit, np.zeros(count, bool)
        shade, ground = match_shade(segments.number, spectrum, segments.size, pairs, light, side)
        ground |= is_vegetation(spectrum, centre)
        return match_segments(spectrum, segments.size, pairs, light, shade, steps, zenith), ground

    matches, ground = matched(light)
    if isinstance(diffuse, str) and diffuse == "shadow":
        split = fraction_in_shadow(channels, samples, spectrum, segments.size, matches)
        light = Light.under(split, *sky)
        matches, ground = matched(light)
    trim_memory()
    number = penumbrae(channels, segments.number, matches, ground, light)
    if number is not segments.number:
        segments = Segments(
            number, segments.sure, np.bincount(number[number >= 0], minlength=count).astype(np.int64)
        )
    neighbour = nearest_coloured(segments.number, segments.size, spectrum, matches, light, reach)
    paint, same_paint = same_paints(spectrum, segments.size, pairs, matches, light)
    neighbours = partial(nearest_at, neighbour, matches.body, paint, segments.number)
    reference, tilt = clean_references(
        channels, samples, spectrum, matches, same_paint, light, neighbours, zenith
    )
    del samples
    is_coloured = coloured_bodies(reference, light)
    # ground without any cast shadow may be a bonnet that fills the picture
    uncoated = ground & ground[matches.body[matches.state == SHADED]].any()
    bodies = np.append(matches.body, np.int32(-1))
    lobe = (
        np.zeros(saturated.shape, np.uint8)
        if light.direct.mean() < SURVEY.min_direct
        else mirror_lobes(
            Picture(
                channels,
                saturated,
                lambda index: bodies[segments.number[index]],
                uncoated,
                reference,
                is_coloured,
                light,
            )
        )
    )
    noise = channel_noise(channels, segments.number, is_inside)
    del is_inside
    trim_memory()
    shade_distance = _shade_distance(channels, segments.number, matches, ground, reference, light)
    trim_memory()
    sun = f"sun at {line_split.zenith:.1f} degrees from the zenith"
    if line_split.source == "measured":
        source_text = "a measured spectrum"
    elif line_split.states:
        source_text = f"the lines' own record, sky {', '.join(line_split.states)}, {sun}"
    else:
        texts = {"pvlib": f"SPECTRL2 of pvlib, {sun}", "shadow": "cast shadow in the image"}
        source_text = texts.get(str(diffuse), f"clear sky of hyperpaint.light.sun, {sun}")
    return SceneModel(
        wavelength=wavelength,
        channel=channel,
        channel_wavelength=centre,
        diffuse_fraction=split,
        zenith_radiance=sky[0],
        sunward_radiance=sky[1],
        shift=shift,
        noise=noise,
        segment=segments.number,
        shade_distance=shade_distance,
        edge_distance=edge_distance(segments, matches.body, paint),
        lobe=lobe,
        neighbour=neighbour,
        size=segments.size,
        state=matches.state,
        body=matches.body,
        ground=ground[matches.body].astype(np.int8),
        paint=paint,
        tilt=tilt,
        spectrum=spectrum,
        reference=reference,
        attrs={
            "diffuse_fraction_from": source_text,
            "diffuse_fraction_u": split_u.tolist(),
            "sky_states": " ".join(line_split.states),
            "reach": reach,
            "sun_zenith": zenith,
            "labels": schema.label_digest(line),
        },
    )


def _shade_distance(
    channels: Floats32,
    number: npt.NDArray[np.int32],
    matches: Matches,
    ground: Bools,
    reference: Floats,
    light: Light,
) -> npt.NDArray[np.uint8]:
    # Distance of every pixel from the nearest shadow (line, column) [pixel]
    distance = distance_to(np.append(matches.state == SHADED, False)[number])
    shaded = shaded_pixels(channels, number, ground & (matches.state == LIT), reference, light)
    level = np.append(np.nan_to_num(reference).mean(axis=1), 0.0)
    deep = np.empty_like(shaded)
    for lines, block in line_blocks(channels):
        deep[lines] = shaded[lines] & (block.mean(axis=2) < SHADOWS.max_deep_level * level[number[lines]])
    distance[of_shadows(shaded, (distance == 0) | deep)] = 0
    return distance


def fraction_in_shadow(
    channels: Floats32, samples: list[Ints], spectrum: Floats, size: Ints, matches: Matches
) -> Floats:
    r"""Return the diffuse fraction (channel,) from the cast shadows on the largest body that has one.

    :math:`f_{dif} = \rho_{shadow} / \rho_{sun}`, from the pixels of the shadows that see most of the sky: the
    60th to 90th percentile of brightness in the bluest quarter of the channels. It is not corrected for the
    unknown sky that objects hide, and the unknown light that they send. Takes ``samples``: flat indices of
    pixels of every segment. Raises `SchemaError`: no cast shadow is large enough.
    """
    shaded = np.flatnonzero((matches.state == SHADED) & (size >= SHADOWS.min_shadow_px))
    SchemaError.raise_if(
        not shaded.size,
        f"diffuse='shadow': no cast shadow of at least {SHADOWS.min_shadow_px} pixels on ground that is "
        "also seen in full sun",
        mend="pass diffuse='model', or a measured spectrum",
        code="shadow-missing",
    )
    bodies = matches.body[shaded]
    largest = bodies[np.argmax(size[bodies])]
    values = gather(
        channels.reshape(-1, channels.shape[2]),
        np.concatenate([samples[segment] for segment in shaded[bodies == largest]]),
    ).astype(np.float64)
    values = values[np.isfinite(values).all(axis=1)]
    blue = values[:, : max(1, values.shape[1] // 4)].mean(axis=1)
    low, high = np.quantile(blue, SHADOWS.open_sky_quantiles)
    under_open_sky = values[(blue >= low) & (blue <= high)]
    return np.asarray(np.clip(under_open_sky.mean(axis=0) / spectrum[largest], 0.0, 1.0))


def _good_bands(line: xr.Dataset, cube: xr.DataArray, wavelength: Floats, problems: Problems) -> Bools:
    problems.add_if(
        not cube.size,
        f"reflectance has shape {cube.shape}",
        expected="at least one line, band and column",
        code="empty-input",
    )
    stated = line.get("good", xr.DataArray(np.ones(wavelength.size, bool), dims=BAND))
    has_dims = stated.dims == (BAND,)
    problems.add_if(
        not has_dims, f"'good' has dims {stated.dims}", expected=f"({BAND!r},)", code="dims-wrong"
    )
    good = stated.values.astype(bool) if has_dims else np.ones(wavelength.size, bool)
    problems.add_if(
        not good.any(),
        f"'good' is False in all {good.size} bands",
        mend="correct 'good', or drop it to use all bands",
        code="good-bands-missing",
    )
    missing = np.flatnonzero(good & ~np.isfinite(wavelength))
    if missing.size:
        problems.add(
            f"wavelength is missing in {missing.size} good bands, first in band {missing[0]}",
            mend="add the wavelengths, or set 'good' to False in these bands",
            code="wavelength-missing",
        )
    return good


#: Layers from which bits are set, and layers that explain them.
LAYERS = ("glint_fraction", "blocked_direct", "adjacency", "adjacency_segment", "mirrored_sky")


@takes_quantities(sun_zenith="degree", sun_azimuth="degree", heading="degree")
@documented(progress="survey progress")
def flag(
    line: xr.Dataset,
    model: SceneModel | xr.Dataset | None = None,
    *,
    glint: float = 0.04,
    shadow: float = 0.2,
    adjacency: float = 0.01,
    edge: int = 1,
    where: Any = None,
    progress: Progress | bool | None = None,
    **options: Any,
) -> xr.Dataset:
    r"""Set the bits of glint, shadow, adjacency and mixed edges, and add their layers.

    Lazy and pointwise given ``model``: one task a slab of lines. Without a model,
    `hyperpaint.surroundings.survey` is run first, which reads the line once.

    Parameters
    ----------
    line
    model
        From `hyperpaint.surroundings.survey` of the same line, or its stored Dataset.
    glint
        Reflectance added by the mirrored sun, relative to the rest, above which a pixel is in glint [1].
    shadow
        ``blocked_direct`` from which a pixel is in shadow [1], in and beside segments of the ground that the
        model holds as cast shadow, and in single pixels of it; on other objects in such segments only, and
        from 0.6 on: elsewhere missing light is tilt.
    adjacency
        ``adjacency`` above which a pixel is lit by a coloured neighbour [1].
    edge
        Distance from a boundary up to which a pixel is mixed [pixel], 0 for pixels in between only.
    where
        Pixels to search, bool (along_track, cross_track); others get no flags. For signatures of few regions,
        ``hyperpaint.regions.region_mask(regions, line) >= 0`` saves most of the time. By default all pixels.
    progress
    **options
        Options of `hyperpaint.surroundings.survey`, used without ``model``.

    Returns
    -------
    Dataset
        The same with ``quality``, in which bits set before stay set, and (along_track, cross_track), float32
        [1]: ``glint_fraction`` g, in units of reflectance under the sun alone; ``blocked_direct`` 1 - c, the
        part of the direct light that is missing, negative where a surface leans towards the sun;
        ``adjacency``, the largest reflectance in any channel that coloured neighbours add, and
        ``adjacency_segment``, int32, the segment of the model that adds most of it, -1 for none;
        ``mirrored_sky`` s, beyond that of the rest of the body. NaN without data.

    Raises
    ------
    SchemaError, UnitsError
        Variables are missing, thresholds are negative or not finite, or the model is of another line; all are
        listed.

    Notes
    -----
    With :math:`\rho` the body's reflectance in full light, :math:`\rho_n` those of the two nearest coloured
    neighbours and :math:`f_{dir} + f_{dif} = 1` the parts of the irradiance,

    .. math:: \rho_{obs} = \rho (c f_{dir} + V f_{dif}) + g f_{dir} + (s l_z + a l_\odot) f_{dif}
              + \textstyle\sum_n (b_n \rho \rho_n + c_n \rho_n)

    is solved exactly for amounts that are not negative, by least squares with priors of 1 for c and V and of
    0 for other amounts, after [1]_. Standard deviations are the noise that the survey measured, and 0.7 % of
    variation within bodies. g and the sum over neighbours are 0 unless leaving them out is worse by three
    standard deviations, of the misfit where that is more than noise (a likelihood ratio). A surface that
    mirrors the sun to a camera above faces halfway to it: with glint, c is expected to be
    cos(z/2) / cos(z), and is at least 0.7. Coats mirror the zenith, of radiance :math:`l_z` over the mean of
    the sky, and the sky around the sun, which is brighter by :math:`l_\odot` and redder; with glint, a is
    expected to be 0.04. Both are those of a clear sky where the split is.

    Only the sum over neighbours is well determined; light of a grey neighbour cannot be distinguished from
    tilt, and parts of one car are no neighbours of each other. On grey bodies a mirrored sun has the colour
    of their own light: there g is the brightness beyond the largest effect of tilt, or, on bodies of which
    more than half is brighter than their darkest parts, beyond their other parts. Smile is removed from the
    channels, which are some 25 nm wide, to first order.

    ``glint_fraction`` is all light that looks like direct light of another colour than the body, including
    light from flakes in a paint, and from leaning grey paint. The bit of glint is set only in a lobe of a
    coat, with a core that stands out (`hyperpaint.surroundings.segments`), and in saturated pixels that a
    lobe encloses. Around a core brighter than all lit surfaces, being 4 % brighter than the body around is
    enough, up to this threshold.

    Known limits: the wide lobe of a worn coat can be distinguished from flakes on coloured and on black paint
    only, and where the body part shows its core; dark glass is taken for asphalt in shadow, so that glint and
    shadow are unreliable on glass. Mixed pixels are detected less well than pixels of one material. For
    measured precision and recall see docs/figures.md.

    References
    ----------
    .. [1] P. Koirala, P. Pant, M. Hauta-Kasari, J. Parkkinen, "Highlight detection and removal from spectral
       image", J. Opt. Soc. Am. A 28, 2284-2291 (2011). doi:10.1364/JOSAA.28.002284

    Examples
    --------
    A grey plane, one pixel of it with 0.1 of the mirrored sun.

    >>> import numpy as np, xarray as xr
    >>> from hyperpaint.light.sun import diffuse_fraction
    >>> nm = np.linspace(400.0, 1000.0, 48)
    >>> seen = np.full((8, 48, 8), 0.3, np.float32)
    >>> seen[4, :, 4] += 0.7 * (1 - diffuse_fraction(nm, 30.0))
    >>> line = xr.Dataset({"reflectance": (("along_track", "band", "cross_track"), seen, {"units": "1"})},
    ...                   {"wavelength": ("band", nm, {"units": "nm"})})
    >>> flagged = flag(line, sun_zenith=30.0)
    >>> int((flagged.quality.values & 64).astype(bool).sum())
    1
    """
    line = schema.rename_to_roles(line)
    cube = schema.require(line, ["reflectance", "wavelength"], "flags")["reflectance"]
    limits = {"glint": glint, "shadow": shadow, "adjacency": adjacency, "edge": edge}
    with Problems("thresholds cannot be used", SchemaError) as problems:
        check_values({name: Fact(doc="", kind="number", least=0) for name in limits}, limits, problems)
    SchemaError.raise_if(
        model is not None and options,
        f"{', '.join(options)}= are options of the survey, which does not run with model=",
        mend="pass only one of them",
        code="option-conflict",
    )
    scene = model_of(line, survey(line, progress=progress, **options) if model is None else model)
    searched = dask.delayed(scene, traverse=False, pure=False)
    if where is not None:
        searched = dask.delayed(within)(searched, schema.pixel_mask(where, line, "where="))
    # Flags, computed by blocks of lines when asked for
    data = line_chunked(cube).data
    blocks = da.map_blocks(
        _flag_block,
        data,
        searched,
        starts=tuple(int(start) for start in np.cumsum((0, *data.chunks[0][:-1]))),
        limits=limits,
        dtype=object,
        name=None,
        meta=np.empty((0, 0, 0), object),
    )
    pixel = (ALONG_TRACK, CROSS_TRACK)
    layout = {name: ("lx", schema.dtype_of(name)) for name in (*LAYERS, "quality")}
    layers = {
        name: schema.label(xr.DataArray(array, dims=pixel), name)
        for name, array in split_outputs(blocks, "lbx", layout).items()
    }
    # the first three layers have a threshold
    for name, limit in zip(LAYERS, FLAG_LIMITS[:3], strict=False):
        layers[name].attrs["threshold"] = limits[limit]
    bits = layers["quality"]
    if "quality" in line.variables:
        line_bits = schema.require(line, ["quality"], "flags")["quality"].variable
        bits = bits.copy(data=(bits.variable | line_bits.transpose(*pixel)).data)
    origin = f"diffuse fraction: {scene.attrs.get('diffuse_fraction_from', 'unknown')}"
    layers["quality"] = schema.label(bits, "quality", flags_from=origin)
    return line.assign(layers)


def model_of(line: xr.Dataset, model: SceneModel | xr.Dataset) -> SceneModel:
    # Return the scene model of a line; raise for the model of a line with other pixels or bands.
    cube = schema.require(line, ["reflectance", "wavelength"], "flags")["reflectance"]
    scene = model if isinstance(model, SceneModel) else SceneModel.from_dataset(model)
    with Problems("the scene model belongs to another line", SchemaError) as problems:
        lines, bands, columns = cube.shape
        problems.add_if(
            scene.segment.shape != (lines, columns),
            f"the model has {scene.segment.shape} pixels",
            expected=f"({lines}, {columns}) as the line",
            code="grid-mismatch",
        )
        # lines without labels, and models of older versions, are compared by their size only
        problems.add_if(
            not schema.has_labels_of(scene, line),
            "the labels of lines or columns (along_track, cross_track) differ from those of the model",
            mend="survey the line that is flagged, or crop and sort the line before its survey",
            code="grid-mismatch",
        )
        # a lazy coordinate is not computed: only its size is compared
        wavelength = scene.wavelength if line["wavelength"].chunks is not None else line["wavelength"].values
        is_same_axis = np.array_equal(scene.wavelength, wavelength, equal_nan=True)
        problems.add_if(
            scene.wavelength.shape != (bands,) or not is_same_axis,
            f"the bands of the model differ from the {bands} bands of the line",
            mend="survey the line that is flagged",
            code="bands-differ",
        )
    return scene


def within(model: SceneModel, where: Bools) -> SceneModel:
    # Return a scene model without segments and lobes elsewhere, where nothing is flagged then.
    return replace(
        model, segment=np.where(where, model.segment, np.int32(-1)), lobe=model.lobe * np.asarray(where)
    )


def _flag_block(
    block: Array,
    model: SceneModel,
    starts: tuple[int, ...],
    limits: dict[str, float],
    block_id: tuple[int, ...] = (0,),
) -> dict[str, Array]:
    return flag_channels(to_channels(block, model.channel), model, starts[block_id[0]], limits)


def flag_channels(
    channels: Floats32, model: SceneModel, start: int, limits: dict[str, float]
) -> dict[str, Array]:
    # Return `LAYERS` and ``quality`` (line, column) of lines from ``start`` on.
    #
    # ``channels``: (line, column, channel), changed; ``limits``: thresholds of `flag`.
    lines = slice(start, start + len(channels))
    to_nominal_channels(channels, model.channel_wavelength, model.shift)
    shape = channels.shape[:2]
    neighbours = model.neighbours(lines.start, lines.stop)
    amount = np.empty((*shape, PARTS), np.float32)
    added = np.empty((*shape, 2), np.float32)
    together, misfit = np.empty((2, *shape), np.float32)
    # a surface that faces the sun gets the maximum of direct light
    max_amounts, lean = max_excesses(), 0.0
    zenith = float(model.attrs.get("sun_zenith", np.nan))
    if np.isfinite(zenith):
        max_amounts[0] = FLAGS.max_direct / max(np.cos(np.radians(zenith)), 0.2)
        # excess of direct light over level ground on a surface that mirrors the sun to the zenith
        angle = np.radians(min(zenith, 80.0))
        lean = float(np.cos(angle / 2) / np.cos(angle) - 1.0)
    unmix_lines(
        channels,
        arguments.Bodies(model.bodies(lines.start, lines.stop), model.reference, neighbours),
        arguments.LightParts(
            *Light.under(model.diffuse_fraction, model.zenith_radiance, model.sunward_radiance)
        ),
        arguments.ChannelErrors(np.hypot(model.noise, FLAGS.relative_error), FLAGS.floor),
        # the kernel takes the spread of direct light from the tilt of the body
        arguments.AmountPrior(
            np.array(FLAGS.expected), np.array([np.nan, *FLAGS.spread]), model.tilt, max_amounts
        ),
        FLAGS.evidence_sd2,
        arguments.Glinting(lean, MIRROR.coat),
        arguments.Unmixed(amount, added, together, misfit),
    )
    adjacency_segment = np.take_along_axis(neighbours, np.argmax(added, axis=2)[..., None], 2)[..., 0]
    layers = {
        "glint_fraction": amount[..., 2],
        "blocked_direct": 1.0 - amount[..., 0],
        "adjacency": together,
        "adjacency_segment": np.where(together > 0, adjacency_segment, -1),
        "mirrored_sky": amount[..., 3],
    }
    bits = np.zeros(shape, np.uint16)
    added_glint = layers["glint_fraction"] * (1.0 - model.diffuse_fraction).mean()
    without_glint = np.maximum(channels.mean(axis=2) - added_glint, 0.0)
    in_glint = added_glint > np.maximum(limits["glint"] * without_glint, FLAGS.min_glint)
    # beside a sharp core, brightness shows glint that has the colour of its body, or covers all of it
    lobe = model.lobe[lines]
    in_glint |= (lobe == BRIGHT_IN_LOBE) & (limits["glint"] <= LOBES.min_share)
    bits[in_glint & (lobe > 0)] |= np.uint16(Quality.GLINT)
    # missing direct light is that of a cast shadow near one on the ground, and in shaded segments of objects;
    # surfaces that lean away from the sun lack direct light, too: on objects more of it must be missing
    segment, missing = model.segment[lines], layers["blocked_direct"]
    on_ground = np.append(model.ground > 0, False)[segment]
    near = on_ground & (model.shade_distance[lines] <= FLAGS.penumbra_px)
    on_objects = ~on_ground & np.append(model.state == SHADED, False)[segment]
    object_limit = max(limits["shadow"], FLAGS.min_missing_on_objects)
    is_shaded = near & (missing >= limits["shadow"]) | on_objects & (missing >= object_limit)
    bits[is_shaded] |= np.uint16(Quality.SHADOW)
    bits[together > limits["adjacency"]] |= np.uint16(Quality.ADJACENCY)
    bits[model.edge_distance[lines] <= limits["edge"]] |= np.uint16(Quality.MIXED_EDGE)
    bits[segment < 0] = 0
    bits[lobe == SATURATED_IN_LOBE] |= np.uint16(Quality.GLINT)
    return {
        **{name: np.ascontiguousarray(layer, schema.dtype_of(name)) for name, layer in layers.items()},
        "quality": bits,
    }


_SURVEYED_FLAGS = flags_set_from("scene")
#: Arguments of `flag` that are thresholds.
FLAG_LIMITS = ("glint", "shadow", "adjacency", "edge")


@dataclass(frozen=True)
class Flagged:
    # A line with its flags.
    line: xr.Dataset  #: The line with ``quality`` and `LAYERS`, lazy.
    surveyed: xr.Dataset  #: The line as surveyed: at nominal wavelengths where it has smile.
    model: SceneModel  #: From `hyperpaint.surroundings.survey`.


def is_flagged(line: xr.Dataset) -> bool:
    # Return whether a line was searched for glint, shadow, adjacency or mixed edges.
    #
    # Reads the values of ``quality`` where its attributes do not record the search.
    if "quality" not in line.variables:
        return False
    quality = line["quality"]
    return "flags_from" in quality.attrs or bool((quality & np.uint16(_SURVEYED_FLAGS)).any())


def without_scene_flags(line: xr.Dataset) -> xr.Dataset:
    # Return a line without bits of glint, shadow, adjacency and mixed edges.
    return line.assign(
        {
            name: (line[name] & np.uint16(~_SURVEYED_FLAGS & 0xFFFF)).assign_attrs(line[name].attrs)
            for name in {"quality"} & set(line.variables)
        }
    )


def flag_line(
    line: xr.Dataset, *, progress: Callable[[int, int], None] | None = None, **options: Any
) -> Flagged:
    # Survey a line with ``reflectance``, and flag it; a line with smile above 1 nm at nominal wavelengths.
    #
    # ``options`` are thresholds of `flag` and options of `survey`; ``progress`` is called with the numbers of
    # surveyed lines and of all lines; flags are lazy. Raises as `flag` and `survey`.
    has_smile = (
        "wavelength_shift" in line.variables
        and (np.abs(line["wavelength_shift"].values) > FLAGS.max_smile_nm).any()
    )
    surveyed = to_nominal(line) if has_smile else line
    limits = {name: options.pop(name) for name in FLAG_LIMITS if name in options}
    model = survey(surveyed, progress=progress, **options)
    flagged = flag(surveyed, model, **limits)
    return Flagged(line.assign({name: flagged[name] for name in ("quality", *LAYERS)}), surveyed, model)
