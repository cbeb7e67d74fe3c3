"""Survey of a whole line: its channels, segments, their spectra in full light, and neighbours."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import dask.array as da
import numpy as np
import numpy.typing as npt
import scipy.sparse
import xarray as xr

from hyperpaint.base import schema
from hyperpaint.base.arrays import Array, Bools, Floats, Floats32, Ints, Progress
from hyperpaint.base.errors import PaintWarning, Problems, SchemaError
from hyperpaint.base.facts import documented
from hyperpaint.base.progress_reports import as_progress
from hyperpaint.base.schema import ALONG_TRACK, BAND, CHUNK_LINES, CROSS_TRACK, Quality
from hyperpaint.base.units import takes_quantities
from hyperpaint.radiometry.slabs import line_chunked

from .detection_rules import BODIES, DARK_COATS, GLINT, SHADOWS, SURVEY
from .full_light import (
    AS_GLINT,
    Light,
    Matches,
    Mixtures,
    least_amounts,
    match_segments,
    median_spectra,
    mixtures_of,
    senders_of,
    solve,
    unmix_spectra,
    without_sun,
)
from .light_split import LightSplit, split_of
from .lobes import Picture, Shown, mirror_lobes, padded
from .model import CELL, LIT, SHADED, SceneModel, nearest_at
from .scratch import compute_into, gather, line_parts, release, scratch_array, trim_memory
from .segments import (
    Segments,
    Touching,
    beyond,
    border_steps,
    distance_to,
    distinct_pairs,
    divide,
    edge_distance,
    sample_pixels,
    touching,
)
from .sun_and_sky import fraction_in_shadow, shadow_side_of

# -- Leaves by their spectrum: lawns are ground and hold shadows; crowns of trees are no cars.


@dataclass(frozen=True)
class VegetationRules:
    """The red edge: leaves rise within 50 nm, no further; blue paints do, too, and are brighter in blue."""

    blue_nm: tuple[float, float] = (430.0, 490.0)  #: In which leaves are darker than in the green [nm].
    green_nm: tuple[float, float] = (535.0, 565.0)  #: In which they are brighter [nm].
    red_nm: tuple[float, float] = (660.0, 690.0)  #: Below the red edge [nm].
    edge_nm: tuple[float, float] = (735.0, 765.0)  #: End of the red edge [nm].
    infrared_nm: tuple[float, float] = (790.0, 900.0)  #: Beyond it [nm].
    min_edge: float = 3.0  #: Reflectance there over that in the red, at least [1].
    max_rise: float = 1.4  #: Reflectance beyond over that, at most [1].


VEGETATION = VegetationRules()


def is_vegetation(spectrum: Floats, wavelength: Floats) -> Bools:
    """Return whether spectra (n, channel) [1] are those of leaves (n,); ``wavelength`` (channel,) [nm]."""
    rules = VEGETATION
    spans = (rules.blue_nm, rules.green_nm, rules.red_nm, rules.edge_nm, rules.infrared_nm)
    blue, green, red, edge, infrared = (
        _mean_over(np.nan_to_num(spectrum), wavelength, span) for span in spans
    )
    return np.asarray(
        (edge > rules.min_edge * red) & (infrared < rules.max_rise * edge) & (green > blue) & (red > 0.0)
    )


def _mean_over(spectrum: Floats, wavelength: Floats, span: tuple[float, float]) -> Floats:
    chosen = (wavelength >= span[0]) & (wavelength <= span[1])
    if not chosen.any():
        chosen[np.argmin(np.abs(wavelength - 0.5 * sum(span)))] = True
    return np.asarray(spectrum[:, chosen].mean(axis=1))


# -- Cast shadows: segments that are another segment's surface, lit by the sky and by objects around only.

#: Directions (along, across) of the sides of `Touching`.
_STEPS = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])


class Scene(NamedTuple):
    """Segments before shadows are known."""

    spectrum: Floats  #: (segment, channel): Reflectance [1].
    size: Ints  #: (segment,): Pixels.
    pairs: Touching  #: Which segments touch.
    #: (segment,): Sides of pixels around a segment, those at the edge of the picture among them.
    border: Floats


def match_shade(
    number: npt.NDArray[np.int32],
    spectrum: Floats,
    size: Ints,
    pairs: Touching,
    light: Light,
    side: Array | None,
) -> tuple[Matches, Bools]:
    r"""Return the segments that lie in a cast shadow, and the segments that are ground (segment,).

    A segment can be in the shadow of a body where
    :math:`\rho_B (c f_{dir} + V f_{dif} + b \rho_n)`, the light of the sky and of one neighbour, fits it with
    little c. Dark glass and black paint fit as well, so that the surroundings decide:

    1. Certain are segments that see much of the sky, and touch their lit body on the side away from the sun,
       or all around.
    2. The ground is the body below most of these. On it, shadows may be darker and more coloured.
    3. From there shadows extend to touching segments that are not part of an object in the sun.
    4. Independent of the surroundings: segments with the sky's part of a body's light to 2 % in all channels,
       beside that body, and with more of it than glass or black paint could mirror.

    Segments with the spectrum of a dark body in the sun under a coat that mirrors the sky are excluded from 2
    to 4.

    Where clear shadows fall to another side than predicted, a `PaintWarning` is given, and the observed side
    is used.

    Takes ``number`` (line, column): segment of every pixel, -1 without data; ``spectrum`` (segment, channel):
    reflectance [1]; ``size`` (segment,): pixels; ``pairs``: touching segments; ``light``: parts of the
    irradiance; ``side`` (2,): direction (along, across) in which shadows fall; if None, from the clearest
    shadows.
    """
    count = len(spectrum)
    state, body = np.full(count, LIT, np.int8), np.arange(count, dtype=np.int32)
    border = np.bincount(pairs.one, pairs.length, count).astype(np.float64)
    for edge in (number[0], number[-1], number[:, 0], number[:, -1]):
        border += np.bincount(edge[edge >= 0], minlength=count)
    scene = Scene(spectrum, size, pairs, border)
    ground = np.arange(count) == (np.argmax(size) if count else -1)
    mixtures = _candidates(scene, senders_of(number, np.nan_to_num(spectrum), size), light)
    if not mixtures.segment.size:
        return Matches(state, body), ground
    sides = _lit_sides(mixtures, scene)
    seen_side, coherence = _side_of_shadows(mixtures, sides, scene) or (None, 0.0)
    agree = side is None or seen_side is None or seen_side @ side >= SHADOWS.min_agreement
    if not agree and coherence >= SHADOWS.min_coherence:
        warnings.warn(
            PaintWarning(
                "shadows fall to another side than sun and heading of the line predict; the observed side "
                "is used. Check the heading, its convention and the clock",
                code="shadow-side-contradictory",
            ),
            stacklevel=2,
        )
        side = seen_side
    side = seen_side if side is None else side
    if side is None:
        _assign(mixtures, _by_spectrum(mixtures, scene, number), state, body)
        return Matches(state, body), ground
    length, way = sides.sum(axis=1), sides @ (_STEPS @ side)
    _assign(mixtures, _beyond_doubt(mixtures, length, way, border), state, body)
    ground = _ground(scene, state, body)
    possible = ~_coats_in_the_sun(mixtures, spectrum, light)
    mixtures, length, way = mixtures.subset(possible), length[possible], way[possible]
    on_ground = ground[mixtures.body]
    around = border[mixtures.segment]
    touches = (length >= SHADOWS.on_ground.border * around) & (way >= SHADOWS.on_ground.way * length)
    touches &= length >= SHADOWS.min_contact_sides
    loose = (mixtures.misfit < SHADOWS.max_misfit) & without_sun(mixtures)
    sided = (
        (length >= SHADOWS.sided.border * around)
        & (way >= SHADOWS.sided.way * length)
        & (mixtures.misfit < SHADOWS.max_misfit)
    )
    loose |= sided & (
        mixtures.direct
        < SHADOWS.sided_direct.open + SHADOWS.sided_direct.hidden * (SHADOWS.open_sky - mixtures.sky)
    )
    beside = (length >= SHADOWS.min_contact_sides) & (way >= SHADOWS.beside_way * length) & _clear(mixtures)
    # candidates that fit about as well as the best on the ground
    least = np.full(count, np.inf)
    np.minimum.at(least, mixtures.segment[on_ground], mixtures.misfit[on_ground])
    best = np.asarray(mixtures.misfit < SHADOWS.worse_factor * least[mixtures.segment] + SHADOWS.worse_by)
    best &= ~ground[mixtures.segment]
    _assign(mixtures, on_ground & best & ((touches & loose) | beside), state, body)
    _assign(mixtures, _turned_away(mixtures, length, way, scene) & ~on_ground, state, body)
    _grow(mixtures, ground, best, length, way, scene, state, body)
    _assign(mixtures, _by_spectrum(mixtures, scene, number), state, body)
    return Matches(state, body), ground


def _candidates(scene: Scene, senders: Ints, light: Light) -> Mixtures:
    spectrum, size, pairs = scene.spectrum, scene.size, scene.pairs
    count = size.size
    is_finite = np.asarray(np.isfinite(spectrum).all(axis=1))
    level = np.where(is_finite, np.nan_to_num(spectrum).mean(axis=1), 0.0)
    largest = np.argsort(-size, kind="stable")[: SHADOWS.large_segments]
    near, bridged = beyond(pairs, size)
    segment = np.concatenate([near, np.repeat(np.arange(count), largest.size)])
    body = np.concatenate([bridged, np.tile(largest, count)])
    fits = (
        is_finite[segment]
        & is_finite[body]
        & (segment != body)
        & (level[segment] < SHADOWS.max_brightness * level[body])
    )
    fits &= (size[body] >= SHADOWS.min_body_share * size[segment]) & (level[segment] > 0)
    return mixtures_of(*distinct_pairs(segment[fits], body[fits], count), spectrum, senders, light)


def _lit_sides(mixtures: Mixtures, scene: Scene) -> Floats:
    # Sides (n, 4) on which candidates touch segments that look like their body
    pairs, spectrum = scene.pairs, scene.spectrum
    first, last = np.searchsorted(pairs.one, [mixtures.segment, mixtures.segment + 1])
    times = last - first
    row = np.repeat(np.arange(times.size), times)
    place = np.arange(row.size) - np.repeat(np.cumsum(times) - times, times) + np.repeat(first, times)
    alike = _alike(spectrum, pairs.other[place], mixtures.body[row])
    lit = np.zeros((times.size, 4))
    for way in range(4):
        lit[:, way] = np.bincount(row[alike], pairs.sides[place[alike], way], times.size)
    return lit


def _alike(spectrum: Floats, one: Ints, other: Ints) -> Bools:
    level = spectrum.mean(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        shape = spectrum / level[:, None]
        close = np.abs(level[one] / level[other] - 1.0) < SHADOWS.max_level_difference
    return np.asarray(close & (np.abs(shape[one] - shape[other]).max(axis=1) < SHADOWS.max_shape_difference))


def _side_of_shadows(mixtures: Mixtures, sides: Floats, scene: Scene) -> tuple[Floats, float] | None:
    # Side (along, across) to which shadows fall, and their agreement; None without any
    sure = _clear(mixtures) & (scene.size[mixtures.segment] >= SHADOWS.min_telling_px)
    # shadows on the ground take precedence: beside a dark car, its shadow looks like one on its paint
    largest = np.argmax(scene.size)
    body = np.unique(mixtures.body)
    alike = np.isin(mixtures.body, body[_alike(scene.spectrum, body, np.full(body.size, largest))])
    on_ground = sure & alike & (mixtures.sky > SHADOWS.min_telling_sky) & sides.any(axis=1)
    sure = on_ground if on_ground.any() else sure & (mixtures.sky > SHADOWS.min_clear_sky)
    towards = sides[sure] @ _STEPS * scene.size[mixtures.segment[sure], None]
    total = towards.sum(axis=0)
    length, whole = float(np.hypot(*total)), float(np.hypot(*towards.T).sum())
    return (np.asarray(total / length), length / whole) if length > 0 else None


def _clear(mixtures: Mixtures, most_sent: float = SHADOWS.max_sent) -> Bools:
    # Whether candidates see much sky and, unlike glass and black paint, almost no other light
    hidden = np.clip(SHADOWS.open_sky - mixtures.sky, 0.0, 1.0)
    little = mixtures.direct < SHADOWS.clear_direct.open + SHADOWS.clear_direct.hidden * hidden
    little &= mixtures.sent < most_sent * (1.0 - mixtures.sky)
    return np.asarray(little & (mixtures.misfit < SHADOWS.max_clear_misfit))


def _beyond_doubt(mixtures: Mixtures, length: Floats, way: Floats, border: Floats) -> Bools:
    # Whether candidates are clear, and touch their lit body away from the sun, or all around
    around = border[mixtures.segment]
    touches = (length >= SHADOWS.min_contact_sides) & (length > SHADOWS.sure.border * around)
    away = way >= SHADOWS.sure.way * length
    island = (length > SHADOWS.island_border * around) & (way >= -SHADOWS.sideways * length)
    return np.asarray(_clear(mixtures) & (mixtures.sky > SHADOWS.min_clear_sky) & touches & (away | island))


def _turned_away(mixtures: Mixtures, length: Floats, way: Floats, scene: Scene) -> Bools:
    # Whether candidates are a bright object's side without sun: its lit body is towards the sun
    level = np.nan_to_num(scene.spectrum).mean(axis=1)[mixtures.body]
    touches = length >= SHADOWS.min_contact_sides
    touches &= length > SHADOWS.sure.border * scene.border[mixtures.segment]
    fits = (mixtures.misfit < SHADOWS.max_spectral_misfit) & (mixtures.direct < SHADOWS.max_turned_direct)
    fits &= (mixtures.sky > SHADOWS.min_turned_ratio * mixtures.direct) & (level < SHADOWS.max_lit_level)
    return np.asarray(
        fits & touches & (way < -SHADOWS.sideways * length) & (mixtures.sky * level > DARK_COATS.max_mirrored)
    )


def _coats_in_the_sun(mixtures: Mixtures, spectrum: Floats, light: Light) -> Bools:
    # Whether candidates are more likely a dark body in the sun whose coat mirrors the sky.
    # `\rho (f_{dir} + f_{dif}) + m f_{dif} l_z`, with `\rho` linear in wavelength and m the reflectance of a
    # clear coat: for the zenith, or for the whole sky.
    segments, place = np.unique(mixtures.segment, return_inverse=True)
    seen = np.nan_to_num(spectrum[segments])
    ramp = DARK_COATS.slope * np.linspace(-1.0, 1.0, seen.shape[1])
    parts = [
        np.broadcast_to(part, seen.shape) for part in (1.0 + ramp, 1.0 - ramp, light.above, light.diffuse)
    ]
    amount, misfit = least_amounts(seen, parts)
    body, mirrored = amount[:, :2].sum(axis=1), amount[:, 2:].sum(axis=1)
    dark = (body > DARK_COATS.min_body) & (seen.mean(axis=1) < DARK_COATS.max_level)
    dark &= (mirrored > DARK_COATS.min_mirrored) & (mirrored < DARK_COATS.max_mirrored)
    dark &= misfit < DARK_COATS.max_misfit
    return np.asarray(
        (dark & (seen > 0).all(axis=1))[place] & (DARK_COATS.worse_factor * misfit[place] < mixtures.misfit)
    )


def _by_spectrum(mixtures: Mixtures, scene: Scene, number: npt.NDArray[np.int32]) -> Bools:
    from scipy.ndimage import binary_dilation, find_objects

    level = np.nan_to_num(scene.spectrum).mean(axis=1)
    fits = (mixtures.misfit < SHADOWS.max_spectral_misfit) & (mixtures.direct < SHADOWS.max_spectral_direct)
    fits &= (mixtures.sky > SHADOWS.min_clear_sky) & (mixtures.sent < SHADOWS.max_spectral_direct)
    fits &= level[mixtures.segment] < SHADOWS.max_brightness * level[mixtures.body]
    fits &= mixtures.sky * level[mixtures.body] > SHADOWS.min_spectral_level
    fits &= scene.size[mixtures.segment] >= SHADOWS.min_telling_px
    places = find_objects(number + 1) if fits.any() else []
    for row in np.flatnonzero(fits):
        window = padded(places[mixtures.segment[row]], SHADOWS.beside_px)
        here = number[window]
        near = binary_dilation(here == mixtures.segment[row], iterations=SHADOWS.beside_px)
        fits[row] = (here[near] == mixtures.body[row]).sum() >= SHADOWS.beside_px
    return np.asarray(fits)


def penumbrae(
    channels: Floats32, number: npt.NDArray[np.int32], matches: Matches, ground: Bools, light: Light
) -> npt.NDArray[np.int32]:
    """Return the segments of pixels (line, column), with the wide edges of shadows on objects included.

    Light fades there, so that pixels belong to neither side, and were assigned to any neighbour.
    Takes ``matches``, ``ground``: from `match_shade`; shadows on the ground are unchanged.
    """
    from scipy.ndimage import binary_dilation, find_objects

    numbers = number
    chosen = np.flatnonzero((matches.state == SHADED) & ~ground[matches.body])
    places = find_objects(number + 1) if chosen.size else []
    for segment in chosen:
        window = padded(places[segment], SHADOWS.penumbra_px)
        here, lit = number[window], matches.body[segment]
        near = binary_dilation(here == segment, iterations=SHADOWS.penumbra_px)
        near &= (here >= 0) & (here != segment) & (here != lit)
        beside = channels[window][here == lit].astype(np.float64)
        beside = beside[np.isfinite(beside).all(axis=1)]
        if not near.any() or not beside.size:
            continue
        bright = np.median(beside, axis=0)
        seen = channels[window][near].astype(np.float64)
        amount, misfit = solve(np.nan_to_num(seen), np.broadcast_to(bright, seen.shape), None, light)
        bluer = amount[:, 1] > amount[:, 0] + SHADOWS.min_pixel_sky_excess
        fades = (amount[:, 0] < SHADOWS.max_pixel_direct) & (misfit < SHADOWS.max_misfit) & bluer
        fades &= amount[:, 1] < SHADOWS.max_penumbra_sky
        if numbers is number:
            numbers = number.copy()
        part = numbers[window]
        part[near] = np.where(fades, segment, part[near])
        release(channels)
    return numbers


def _ground(scene: Scene, state: Array, body: Array) -> Bools:
    # Whether segments are ground (segment,): the largest, and the body of most shadows.
    # Except for too bright or too small bodies: white cars with shadows of others on them.
    count = scene.size.size
    area = np.bincount(body, np.where(state == SHADED, scene.size, 0), count)
    is_ground = np.zeros(count, bool)
    largest = scene.size == scene.size.max()
    bright = np.nan_to_num(scene.spectrum).mean(axis=1) > SHADOWS.max_ground_level
    for candidate in np.flatnonzero(largest | ((area > SHADOWS.min_ground_share * area.sum()) & ~bright)):
        alike = _alike(scene.spectrum, np.arange(count), np.full(count, candidate))
        if largest[candidate] or scene.size[alike].sum() > SHADOWS.min_ground_size * scene.size.sum():
            is_ground |= alike
    return is_ground


def _grow(
    mixtures: Mixtures,
    ground: Bools,
    best: Bools,
    length: Floats,
    way: Floats,
    scene: Scene,
    state: Array,
    body: Array,
) -> None:
    around, on_ground = scene.border[mixtures.segment], ground[mixtures.body]
    sunny = (way < -SHADOWS.sideways * length) & (length > SHADOWS.sure.border * around)
    fits = best & ~sunny & without_sun(mixtures)
    on = fits & on_ground & (mixtures.misfit < SHADOWS.max_misfit) & (mixtures.sky < SHADOWS.open_sky)
    bright = mixtures.sky > SHADOWS.min_clear_sky
    other = (
        fits
        & ~on_ground
        & (mixtures.misfit < np.where(bright, SHADOWS.max_dim_misfit, SHADOWS.max_dark_misfit))
    )
    dim = other & bright
    # dark glass against bay lines and kerbs has less of the sky
    markings = (
        other & (mixtures.sky > SHADOWS.min_marking_sky) & (mixtures.direct < SHADOWS.max_marking_direct)
    )
    clear = _clear(mixtures, most_sent=SHADOWS.max_sent_beside)
    for _ in range(SHADOWS.rounds):
        dark = state == SHADED
        shaded, below = (
            _touched(which, scene)[mixtures.segment] / around for which in (dark, dark & ground[body])
        )
        enough = on & (shaded > np.where(clear, SHADOWS.next_clear, SHADOWS.next))
        enough |= (dim & (shaded > SHADOWS.next)) | (markings & (below > SHADOWS.next_marking))
        enough |= (
            best & ~sunny & (mixtures.direct < SHADOWS.max_enclosed_direct) & (shaded > SHADOWS.enclosed)
        )
        if not _assign(mixtures, enough, state, body):
            break


def _touched(which: Bools, scene: Scene) -> Floats:
    # Number of sides of every segment that touch chosen segments (segment,)
    weight = scene.pairs.length * which[scene.pairs.other]
    return np.bincount(scene.pairs.one, weight, scene.size.size).astype(np.float64)


def _assign(mixtures: Mixtures, chosen: Bools, state: Array, body: Array) -> bool:
    # Assign the best fitting lit body to segments; return whether any changed
    any_assigned = False
    for place in np.flatnonzero(chosen)[np.argsort(mixtures.misfit[chosen], kind="stable")]:
        segment, parent = mixtures.segment[place], body[mixtures.body[place]]
        if state[segment] == LIT and state[parent] == LIT and parent != segment:
            state[segment] = SHADED
            body[body == segment] = parent
            any_assigned = True
    return any_assigned


def shaded_pixels(
    channels: Floats32, number: npt.NDArray[np.int32], level: Bools, reference: Floats, light: Light
) -> Bools:
    """Return the pixels (line, column) of level ground that lack direct light: shadows of thin objects.

    Surfaces that lean away from the sun lack it as well, so that only ground can be tested.

    Takes ``channels`` (line, column, channel): reflectance [1]; ``number`` (line, column): segment of every
    pixel, -1 without data; ``level`` (segment,): true for ground in the sun; ``reference`` (segment,
    channel): reflectance of bodies in full light [1]; ``light``: parts of the irradiance.
    """
    shaded = np.zeros(number.shape, bool)
    bright = reference.mean(axis=1)
    asked = np.append(level, False)[number]
    for part, seen in line_parts(channels):
        segment = number[part]
        here = asked[part] & (seen.mean(axis=2) < SHADOWS.max_pixel_level * np.append(bright, 0.0)[segment])
        amount, misfit = solve(seen[here].astype(np.float64), reference[segment[here]], None, light)
        bluer = amount[:, 1] > amount[:, 0] + SHADOWS.min_pixel_sky_excess
        missing = (amount[:, 0] < SHADOWS.max_pixel_direct) & bluer & (misfit < SHADOWS.max_pixel_misfit)
        shaded[part][here] = missing
    return shaded


def of_shadows(shaded: Bools, dark: Bools) -> Bools:
    """Return the single pixels in shadow (line, column) that belong to a shadow, not to ground texture.

    Pixels that touch a segment in shadow, and long thin pieces, such as the shadows of posts. Takes
    ``shaded``, ``dark`` (line, column): single pixels, and segments in shadow.
    """
    from scipy.ndimage import binary_dilation, find_objects, label

    pieces, count = label(shaded, np.ones((3, 3)))
    belongs = np.zeros(count + 1, bool)
    belongs[np.unique(pieces[binary_dilation(dark, np.ones((3, 3))) & shaded])] = True
    # in parts, since integers are counted in 64 bits
    size = np.sum([np.bincount(part.ravel(), minlength=count + 1) for _, part in line_parts(pieces)], axis=0)
    for number, window in enumerate(find_objects(pieces), 1):
        if belongs[number] or size[number] < SHADOWS.min_thin_px:
            continue
        places = np.stack(np.nonzero(pieces[window] == number)).astype(np.float64)
        narrow, wide = np.linalg.eigvalsh(np.cov(places))
        belongs[number] = wide > SHADOWS.min_thinness**2 * max(narrow, 1.0 / 12.0)
    belongs[0] = False
    return np.asarray(belongs[pieces])


# -- Bodies in full light: coloured bodies that light others, and reference spectra without glint.


def coloured(spectrum: Floats, light: Light) -> Floats:
    """Return the colour of spectra (segment,): rms residual of a fit of direct light and grey [1].

    Over the channels with values; 0 where these are too few.
    """
    basis = np.stack([np.ones_like(light.direct), light.diffuse], axis=1)
    is_finite = np.isfinite(spectrum)
    colour = np.zeros(len(spectrum))
    for pattern in np.unique(is_finite, axis=0):
        if pattern.sum() <= basis.shape[1]:
            continue
        same = (is_finite == pattern).all(axis=1)
        seen = spectrum[same][:, pattern]
        amounts, *_ = np.linalg.lstsq(basis[pattern], seen.T, rcond=None)
        colour[same] = np.sqrt(np.mean((seen - (basis[pattern] @ amounts).T) ** 2, axis=1))
    return colour


def coloured_bodies(spectrum: Floats, light: Light) -> Bools:
    """Return whether spectra are coloured enough to be distinguished from mirrored sunlight (segment,)."""
    return np.asarray(_relative_colour(spectrum, light) > BODIES.min_paint_colour)


def nearest_coloured(
    number: npt.NDArray[np.int32], size: Ints, spectrum: Floats, matches: Matches, light: Light, reach: int
) -> npt.NDArray[np.int32]:
    """Return the nearest coloured segments (cell_along, cell_cross, rank) in full light.

    Takes ``number`` (line, column): segment of every pixel; ``size``, ``spectrum``, ``matches``: of the
    segments; ``light``: parts of the irradiance; ``reach``: maximum distance of their light [pixel].
    """
    from hyperpaint.kernels.segmentation import nearest_sources

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
    distances = np.full((*cells, BODIES.neighbours_of_cell), np.inf)
    sources: Any = np.where(np.append(sends, False)[centre], centre, -1)
    labels[: centre.shape[0], : centre.shape[1], 0] = sources
    distances[..., 0] = np.where(labels[..., 0] >= 0, 0.0, np.inf)
    nearest_sources(labels, distances, reach / CELL)
    return labels


_BESIDE = 2 * [(0.0, 0.1), (0.0, 0.05)]
#: Prior of the amounts in a pixel: expected values and standard deviations (2, part).
_AS_PIXEL = np.transpose(
    [(1.0, 0.2), (1.0, 0.3), (BODIES.offset, 0.1), (BODIES.offset, 0.02), (0.0, 0.03), *_BESIDE]
)


class Paints(NamedTuple):
    """Bodies of one paint."""

    first: npt.NDArray[np.int32]  #: (segment,): First of the bodies with the same paint as a segment.
    #: (pair,): Bodies of the same paint near one another, in both orders.
    one: Ints
    other: Ints


def _relative_colour(spectrum: Floats, light: Light) -> Floats:
    # Colour of spectra relative to their brightness (segment,) [1]
    return np.asarray(coloured(spectrum, light) / np.maximum(np.nan_to_num(spectrum).mean(axis=1), 1e-6))


def same_paints(spectrum: Floats, size: Ints, pairs: Touching, matches: Matches, light: Light) -> Paints:
    r"""Return the bodies that are parts of one car: of the same colour, except for tilt and glint.

    For bodies that touch, or have a small segment between them, one is the other's paint where :math:`\rho (c
    f_{dir} + V f_{dif}) + g f_{dir}` fits it to 2 %. Grey bodies cannot be distinguished, and are not joined.
    """
    near = beyond(pairs, size)
    one, other = matches.body[near[0]].astype(np.int64), matches.body[near[1]].astype(np.int64)
    paint = np.isfinite(spectrum).all(axis=1) & (_relative_colour(spectrum, light) > BODIES.min_paint_colour)
    open_ = (one != other) & paint[one] & paint[other]
    one, other = distinct_pairs(one[open_], other[open_], size.size)
    finite_spectrum = np.nan_to_num(spectrum)
    _, misfit, _ = unmix_spectra(
        finite_spectrum[one], other, finite_spectrum, light, GLINT.tolerance, AS_GLINT
    )
    one, other = one[misfit < 1.0], other[misfit < 1.0]
    joined = scipy.sparse.csr_array((np.ones(one.size), (one, other)), shape=(size.size, size.size))
    _, label = scipy.sparse.csgraph.connected_components(joined, directed=False)
    _, first = np.unique(label, return_index=True)
    both_orders = np.concatenate([one, other]), np.concatenate([other, one])
    return Paints(first[label][matches.body].astype(np.int32), *distinct_pairs(*both_orders, size.size))


def clean_references(
    channels: Floats32,
    places: list[Ints],
    spectrum: Floats,
    matches: Matches,
    paints: Paints,
    light: Light,
    neighbours: Callable[[Ints], npt.NDArray[np.int32]],
    zenith: float,
) -> tuple[Floats, Floats]:
    """Return the spectra of bodies (segment, channel) without glint, and the lean of their parts (segment,).

    Where the light added by glint and neighbours differs from pixel to pixel by over 0.003, the pixels with
    least of it are averaged. On grey bodies its amount cannot be seen; where brightness differs by more than
    tilt towards the sun allows, the darkest pixels that see as much of the sky are used, and the rest is
    glint. For bodies wholly in glint another part of the car shows the paint.

    Takes ``channels`` (line, column, channel): reflectance [1]; ``places``: pixels of every segment;
    ``spectrum``, ``matches``, ``paints``, ``light``: of the segments, and the irradiance; ``neighbours``:
    returns the coloured segments beside pixels (pixel, 2); ``zenith``: of the sun [degree]; NaN where
    unknown.
    """
    finite_spectrum = np.nan_to_num(spectrum)
    reference, tilt = finite_spectrum.copy(), np.full(len(spectrum), BODIES.tilt)
    colour = _relative_colour(spectrum, light)
    most = BODIES.min_glint_brightness / max(np.cos(np.radians(np.nan_to_num(zenith, nan=60.0))), 0.2)
    flat = channels.reshape(-1, channels.shape[2])
    for segment, here in enumerate(places):
        if matches.body[segment] != segment or not np.isfinite(spectrum[segment]).all():
            continue
        values = gather(flat, here).astype(np.float64)
        is_finite = np.isfinite(values).all(axis=1)
        here, values = here[is_finite], values[is_finite]
        if here.size < BODIES.min_body_px:
            continue
        grey = colour[segment] < BODIES.max_grey_colour
        darkest = _darkest(values, light, most) if grey else None
        if darkest is not None:
            reference[segment] = darkest
            middle = np.median(values.mean(axis=1)) / darkest.mean()
            if darkest.mean() > BODIES.bright and middle > BODIES.min_mostly_glint:
                tilt[segment] = BODIES.glint_tilt
            continue
        extra, direct = _additions(values, segment, finite_spectrum, light, neighbours(here))
        low, high = np.quantile(extra, [0.1, 0.5])
        if high - low > BODIES.min_difference:
            first, last = np.quantile(extra, BODIES.clean_grey_quantiles if grey else BODIES.clean_quantiles)
            chosen = (extra >= first) & (extra <= last) & (direct > 0.7)
            if chosen.sum() >= BODIES.min_clean_px:
                # scaled to the usual lean of the body, which may differ from the lean of those pixels
                usual = 1.0 if grey else np.median(direct) / np.median(direct[chosen])
                reference[segment] = values[chosen].mean(axis=0) * usual
    reference -= _common_glint(reference, places, paints, light) @ np.stack([light.direct, light.sunward])
    return np.ascontiguousarray(reference[matches.body]), tilt[matches.body]


def _darkest(values: Floats, light: Light, most: float) -> Floats | None:
    # Mean of a grey body's darkest pixels; None where these may not be free of glint.
    # The brightest are brighter by `most` at least; half of the body is not much brighter, unlike beside a
    # shadow; and the darkest see as much of the sky as other pixels.
    if not light.direct.any():
        return None
    level = values @ light.direct / (light.direct @ light.direct)
    first, last, usual, middle, high = np.quantile(
        level, [*BODIES.darkest_quantiles, BODIES.usual_quantile, 0.5, BODIES.brightest_quantile]
    )
    if first <= 0.0 or high <= most * usual or middle >= BODIES.max_even_ratio * first:
        return None
    low, wide = np.quantile(level, BODIES.clean_grey_quantiles)
    if wide - low < BODIES.max_plateau:  # mostly without glint: the darkest lean away
        first, last = low, wide
    darkest = values[(level >= first) & (level <= last)].mean(axis=0)
    split = np.stack([light.direct, light.diffuse], axis=1)
    both = np.stack([darkest, np.median(values, axis=0)], axis=1)
    (_, (here, there)), *_ = np.linalg.lstsq(split, both, rcond=None)
    return np.asarray(darkest) if here > BODIES.min_sky * there else None


def _additions(
    values: Floats, segment: int, finite_spectrum: Floats, light: Light, neighbours: npt.NDArray[np.int32]
) -> tuple[Floats, Floats]:
    # Light added to pixels by glint and neighbours, up to a constant, and their direct light.
    # An amount of each is first added to all pixels, so that less than the mean shows as well.
    first = neighbours[:, 0]
    mirrored = np.where(first[:, None] >= 0, finite_spectrum[first], 0.0)
    lifted = values + BODIES.offset * (light.direct + light.above) + BODIES.lift * mirrored
    body = np.full(len(values), segment)
    amount, _, added = unmix_spectra(lifted, body, finite_spectrum, light, 0.01, _AS_PIXEL, neighbours)
    return amount[:, 2] + amount[:, 4] + added.sum(axis=1) - BODIES.lift * mirrored.max(axis=1), amount[:, 0]


def _common_glint(reference: Floats, places: list[Ints], paints: Paints, light: Light) -> Floats:
    # Mirrored sun, and sky around it, that covers a whole body (segment, 2).
    # From a comparison with other parts of the same paint.
    size = np.array([here.size for here in places])
    large = size[paints.other] >= BODIES.min_part_share * size[paints.one]
    one, other = paints.one[large], paints.other[large]
    amount, misfit, _ = unmix_spectra(reference[one], other, reference, light, GLINT.tolerance, AS_GLINT)
    glint = np.zeros((len(reference), 2))
    np.maximum.at(glint, one[misfit < 1.0], amount[misfit < 1.0][:, [2, 4]])
    return glint


def channel_numbers(wavelength: Array, good: Array) -> Ints:
    """Return the channel of every band: runs of equally many good bands; -1 for bands that are not good.

    The ends of the spectrum, where colours have their steepest edges, are treated like the rest: 24 channels
    of a 400-1000 nm camera are 25 nm wide.
    """
    order = np.flatnonzero(good)[np.argsort(wavelength[good], kind="stable")]
    numbers = np.full(wavelength.size, -1, np.int64)
    numbers[order] = np.arange(order.size) * min(SURVEY.channels, order.size) // max(order.size, 1)
    return numbers


def to_channels(block: Array, channel: Ints) -> Floats32:
    """Return the means (line, column, channel) of a block (line, band, column)."""
    from hyperpaint.kernels.unmixing import average_bands

    out = np.empty((block.shape[0], block.shape[2], int(channel.max()) + 1), np.float32)
    average_bands(np.ascontiguousarray(block, np.float32), channel, out)
    return out


def read_channels(
    cube: xr.DataArray, channel: Ints, progress: Progress | None, quality: xr.DataArray | None = None
) -> tuple[Floats32, Bools]:
    """Return the whole line in channels (line, column, channel), in scratch, read in blocks.

    Also returns whether pixels are saturated (line, column). A pixel's means depend on its own bands alone,
    so that results have the same bits for any blocks.
    """
    cube = line_chunked(cube)
    lines, columns = cube.sizes[ALONG_TRACK], cube.sizes[cube.dims[2]]
    count = int(channel.max()) + 1
    out, saturated = scratch_array((lines, columns, count), np.float32), np.zeros((lines, columns), bool)
    blocks = da.map_blocks(
        to_channels,
        cube.data,
        channel,
        dtype=np.float32,
        chunks=(cube.data.chunks[0], (columns,), (count,)),
        meta=np.empty((0, 0, 0), np.float32),
    )
    if quality is None:
        compute_into([blocks], [out], progress)
    else:
        bits = da.asarray(quality.data).rechunk((cube.data.chunks[0], -1))
        compute_into([blocks, (bits & np.uint16(Quality.SATURATED)) > 0], [out, saturated], progress)
    return out, saturated


def without_unknown(channels: Floats32, channel: Ints) -> tuple[Floats32, Ints]:
    """Return a line in channels, and the channel of every band, without channels that most pixels lack.

    Otherwise one channel that is dead for the whole line would leave no segment with all channels. If no
    channel would remain, all are kept.
    """
    data, finite_count = 0, np.zeros(channels.shape[2], np.int64)
    for _, part in line_parts(channels):
        is_finite = np.isfinite(part)
        data += int(is_finite.any(axis=2).sum())
        finite_count += is_finite.sum(axis=(0, 1))
    retained = 2 * finite_count >= data
    if retained.all() or not retained.any():
        return channels, channel
    numbers = np.append(np.where(retained, np.cumsum(retained) - 1, -1), -1)  # the last one is that of -1
    some = scratch_array((*channels.shape[:2], int(retained.sum())), np.float32)
    for lines, part in line_parts(channels):
        some[lines] = part[..., retained]
        release(some)
    return some, numbers[channel]


def shift_of_channels(line: xr.Dataset, channel: Ints, columns: int) -> Floats:
    """Return true less nominal wavelength of the channels (channel, column) [nm].

    0 where the line has no ``wavelength_shift``, or it is NaN.
    """
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
    """Remove the smile from channels (line, column, channel), in place: slope times shift.

    The slope is that between the channels on both sides, which are much wider than any smile.
    """
    if len(centre) < 2 or not shift.any():
        return
    for _, part in line_parts(channels):
        for block in np.split(part, range(CHUNK_LINES, len(part), CHUNK_LINES)):
            slope = np.gradient(block.astype(np.float64), centre, axis=2)
            block -= np.nan_to_num(slope * shift.T).astype(np.float32)


def channel_noise(channels: Floats32, number: npt.NDArray[np.int32], inside: Bools) -> Floats:
    """Return the noise of channels (channel,), relative to the reflectance [1].

    From second differences over the channels of the differences of neighbouring pixels of one segment: light
    and surface change little from pixel to pixel, and smoothly over the channels. 0 where it cannot be
    estimated.

    Takes ``channels`` (line, column, channel): reflectance [1]; ``number``, ``inside`` (line, column):
    segment of every pixel, and whether it lies inside.
    """
    count = channels.shape[2]
    same = (number[:, 1:] == number[:, :-1]) & (number[:, 1:] >= 0) & inside[:, 1:] & inside[:, :-1]
    total, first = int(np.count_nonzero(same)), 0
    if count < 3 or not total:
        return np.zeros(count)
    step = max(1, total // SURVEY.max_noise_pairs)
    pairs: list[list[Array]] = []
    for lines, part in line_parts(channels):
        line, x = np.nonzero(same[lines])
        some = slice(-first % step, None, step)  # every so many of all
        first += line.size
        pairs.append([part[line[some], x[some] + right] for right in (0, 1)])
    one, other = (np.concatenate(side).T for side in zip(*pairs, strict=True))
    noise = np.zeros(count - 2)
    for k in range(1, count - 1):
        # of three channels at a time, for memory
        here, beside = one[k - 1 : k + 2].astype(np.float64), other[k - 1 : k + 2].astype(np.float64)
        apart, level = here - beside, (here[1] + beside[1]) / 2
        bent = (apart[1] - (apart[2] + apart[0]) / 2) / np.maximum(level, SURVEY.min_noise_level)
        deviations = np.abs(bent[np.isfinite(bent)])
        # three variances of a channel: one and two halves, squared, of two pixels
        noise[k - 1] = 1.4826 * np.median(deviations) / np.sqrt(3.0) if deviations.size else 0.0
    return np.pad(noise, 1, mode="edge")


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
    r"""Survey a whole line, and return the scene model that flags use.

    Eager. The line is read once, some blocks at a time, and held as means over 24 channels (96 bytes a pixel,
    in a temporary file for more than some 500 lines) during the survey, beside some 30 bytes a pixel in
    memory. Results have the same bits for any chunks and scheduler.

    Parameters
    ----------
    line
        A flight line with ``reflectance`` (along_track, band, cross_track) [1] and ``wavelength``. Time,
        latitude, longitude and heading, where present, determine the direction of the sun in the image.
    diffuse
        Source of the diffuse part of the irradiance: None, the line's ``diffuse_fraction`` or else its record
        of ``irradiance``, mean over lines; "model", the clear sky of `hyperpaint.light.sun`, also assumed,
        with a warning, where the line has no record; "pvlib", SPECTRL2 (extra ``sim``); "shadow", a cast
        shadow on the ground in the image; or a measured spectrum (band,) or with a coordinate
        ``wavelength``, such as a reading in the shade of a small disc over the reading in full light.
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
    from hyperpaint.kernels.segmentation import boundary_distance

    line = schema.rename_to_roles(line)
    variables = schema.require(line, ["reflectance", "wavelength"], "a scene model")
    cube = variables["reflectance"]
    wavelength = variables["wavelength"].values.astype(np.float64)
    good = _good_bands(line, cube, wavelength)
    try:
        divided = split_of(line, diffuse, sun_zenith).mean()
    except SchemaError as error:
        if not (isinstance(diffuse, str) and diffuse == "shadow"):
            raise
        found = "diffuse='shadow' starts from the light of a clear sky"
        raise SchemaError(found, problems=[error.problem]) from error
    fraction, zenith = divided.fraction.values, divided.zenith
    channel = channel_numbers(wavelength, good)
    bits = None
    if "quality" in line.variables:
        bits = schema.require(line, ["quality"], "a scene model")["quality"].transpose(
            ALONG_TRACK, CROSS_TRACK
        )
    channels, saturated = read_channels(cube, channel, as_progress(progress, "survey"), bits)
    channels, channel = without_unknown(channels, channel)
    bands = (wavelength, fraction, divided.u.values, *divided.mirrored())
    centre, split, split_u, *sky = (_mean_of(values, channel) for values in bands)
    shift = shift_of_channels(line, channel, channels.shape[1])
    to_nominal_channels(channels, centre, shift)
    light = Light.under(split, *sky)
    segments = divide(channels)
    trim_memory()
    count = segments.size.size
    boundary_px = np.empty(segments.number.shape, np.uint8)
    boundary_distance(segments.number, segments.sure, 255, boundary_px)
    is_inside = boundary_px >= SURVEY.min_edge_distance_px
    places = sample_pixels(segments.number, is_inside, count)
    del boundary_px
    spectrum = median_spectra(channels, places)
    side = shadow_side_of(line, sun_azimuth, heading)
    pairs = touching(segments.number, count)
    steps = border_steps(channels, segments.number, pairs)

    def matched(light: Light) -> tuple[Matches, Bools]:
        if light.direct.mean() < SURVEY.min_direct:
            lit = Matches(np.full(count, LIT, np.int8), np.arange(count, dtype=np.int32))
            return lit, np.zeros(count, bool)
        shade, ground = match_shade(segments.number, spectrum, segments.size, pairs, light, side)
        ground |= is_vegetation(spectrum, centre)
        return match_segments(spectrum, segments.size, pairs, light, shade, steps, zenith), ground

    matches, ground = matched(light)
    if isinstance(diffuse, str) and diffuse == "shadow":
        split = fraction_in_shadow(channels, places, spectrum, segments.size, matches)
        light = Light.under(split, *sky)
        matches, ground = matched(light)
    trim_memory()
    number = penumbrae(channels, segments.number, matches, ground, light)
    if number is not segments.number:
        sizes = np.bincount(number[number >= 0], minlength=count).astype(np.int64)
        segments = Segments(number, segments.sure, sizes)
    neighbour = nearest_coloured(segments.number, segments.size, spectrum, matches, light, reach)
    paints = same_paints(spectrum, segments.size, pairs, matches, light)
    beside = partial(nearest_at, neighbour, matches.body, paints.first, segments.number)
    reference, tilt = clean_references(channels, places, spectrum, matches, paints, light, beside, zenith)
    del places
    coated = coloured_bodies(reference, light)
    # ground without any cast shadow may be a bonnet that fills the picture
    bare = ground & ground[matches.body[matches.state == SHADED]].any()
    lobe = (
        np.zeros(saturated.shape, np.uint8)
        if light.direct.mean() < SURVEY.min_direct
        else mirror_lobes(
            Picture(channels, saturated, Shown(segments.number, matches.body), bare, reference, coated, light)
        )
    )
    noise = channel_noise(channels, segments.number, is_inside)
    del is_inside
    trim_memory()
    shade_distance = _shade_distance(channels, segments.number, matches, ground, reference, light)
    trim_memory()
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
        edge_distance=edge_distance(segments, matches.body, paints.first),
        lobe=lobe,
        neighbour=neighbour,
        size=segments.size,
        state=matches.state,
        body=matches.body,
        ground=ground[matches.body].astype(np.int8),
        paint=paints.first,
        tilt=tilt,
        spectrum=spectrum,
        reference=reference,
        attrs={
            "diffuse_fraction_from": _source_text(diffuse, divided),
            "diffuse_fraction_u": split_u.tolist(),
            "sky_states": " ".join(divided.states),
            "reach": reach,
            "sun_zenith": zenith,
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
    # Distance of every pixel from any shadow (line, column) [pixel]
    distance = distance_to(np.append(matches.state == SHADED, False)[number])
    shaded = shaded_pixels(channels, number, ground & (matches.state == LIT), reference, light)
    level = np.append(np.nan_to_num(reference).mean(axis=1), 0.0)
    deep = np.empty_like(shaded)
    for part, seen in line_parts(channels):
        deep[part] = shaded[part] & (seen.mean(axis=2) < SHADOWS.max_deep_level * level[number[part]])
    distance[of_shadows(shaded, (distance == 0) | deep)] = 0
    return distance


def _good_bands(line: xr.Dataset, cube: xr.DataArray, wavelength: Floats) -> Bools:
    problems = Problems("this line cannot be surveyed", SchemaError)
    if not cube.size:
        problems.add(
            f"reflectance has shape {cube.shape}",
            expected="at least one line, band and column",
            code="empty-input",
        )
    good = np.ones(wavelength.size, bool)
    if "good" in line.variables:
        if line["good"].dims != (BAND,):
            problems.add(f"'good' has dims {line['good'].dims}", expected=f"({BAND!r},)", code="dims-wrong")
        else:
            good = line["good"].values.astype(bool)
    if not good.any():
        problems.add(
            f"'good' is False in all {good.size} bands",
            mend="correct 'good', or drop it to use all of them",
            code="good-bands-missing",
        )
    without = np.flatnonzero(good & ~np.isfinite(wavelength))
    if without.size:
        problems.add(
            f"wavelength is missing in {without.size} good bands, the first of them {without[0]}",
            mend="give it, or set 'good' to False there",
            code="wavelength-missing",
        )
    problems.raise_if_any()
    return good


def _source_text(diffuse: Any, split: LightSplit) -> str:
    place = f"sun at {split.zenith:.1f} degrees from the zenith"
    if split.source == "measured":
        return "a measured spectrum"
    if split.states:
        return f"the lines' own record, sky {', '.join(split.states)}, {place}"
    return {
        "pvlib": f"SPECTRL2 of pvlib, {place}",
        "shadow": "cast shadow in the image",
    }.get(str(diffuse), f"clear sky of hyperpaint.light.sun, {place}")


def _mean_of(values: Floats, channel: Ints) -> Floats:
    # Means of values (band,) over the bands of every channel (channel,)
    used = channel >= 0
    return np.asarray(np.bincount(channel[used], values[used]) / np.bincount(channel[used]))
