"""Cast shadows: segments that are another segment's surface, lit by the sky and by objects around only."""

from __future__ import annotations

import warnings
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Array, Bools, Floats, Floats32, Ints
from hyperpaint.base.errors import PaintWarning

from .detection_rules import DARK_COATS, SHADOWS
from .full_light import (
    Light,
    Matches,
    Mixtures,
    least_amounts,
    mixtures_of,
    senders_of,
    solve,
    without_sun,
)
from .lobes import padded
from .model import LIT, SHADED
from .scratch import line_parts, release
from .segments import Touching, beyond, distinct_pairs

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
