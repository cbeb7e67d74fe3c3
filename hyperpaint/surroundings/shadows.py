"""Cast shadows: which segments are another's surface, lit by the sky and by things around only."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Array, Bools, Floats, Ints

from .full_light import Light, Matches, Mixtures, in_parts, mixtures_of, senders_of, solve, without_sun
from .model import LIT, SHADED
from .segments import Touching, beyond, distinct_pairs

__all__ = ["match_shade", "shaded_pixels"]


_STEPS = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
"""Directions (along, across) of the sides of `Touching`."""
_DARKER = 0.5
"""Brightness of a shadow, relative to its body, at most."""
_LARGEST = 40
"""Segments that may be the body of any."""
_BODY_SHARE = 0.2
"""Size of the lit part of a body, relative to its shadow, at least."""
_ALIKE, _AS_BRIGHT = 0.08, 0.35
"""Largest difference of spectra of mean 1, and of brightness, relative, of segments that look the same."""
_LEAST_CONTACT = 4
"""Sides of pixels over which a shadow touches its lit body, at least."""
_OPEN_SKY, _LEAST_SKY = 0.75, 0.45
"""Amount of the sky's light below which what hides it may send light; that of a clear shadow, at least."""
_TIGHT, _LOOSE = 0.035, 0.045
"""Misfits, relative to what is seen, of shadows beyond doubt and of those that the surroundings speak for."""
_GROUND_SHARE = 0.1
"""Share of all shadows that lie on a body that is ground, at least."""
_SIDEWAYS = 0.35
"""Mean direction of a border's sides against that of shadows, beyond which it faces the sun."""
_ROUNDS = 12
"""Turns in which shadows go on to what touches them, at most."""
_LINES = 128
"""Lines that are looked at together, for memory."""
_DIMMER, _MISSING, _PATCHY = 0.9, 0.8, 0.2
"""Brightness of pixels that are looked at, direct light of those in shadow, and their misfit, at most."""


class _Contact(NamedTuple):
    """How a segment touches its lit body, at least: a share of its border, and which side that is on.

    ``way`` is the mean direction of the sides in touch, 1 where all are away from the sun, -1 towards it.
    """

    border: float
    way: float


class _Direct(NamedTuple):
    """Direct light, at most: what grey things send passes for it, the more of it the more sky they hide."""

    open: float
    hidden: float


# What the rules of `match_shade` ask for, in the order of use: less where more speaks for a shadow already.
# Set on rendered car parks, to what keeps glass and black paint out.
_TELLING = 30
"""Pixels of a clear shadow that tells to which side they fall, at least."""
_CLEAR_DIRECT = _Direct(0.015, 0.12)
"""Of clear shadows."""
_SENT, _SENT_BESIDE = 0.5, 1.0
"""Light of a neighbour in a clear shadow, relative to the hidden sky, at most: alone; beside another."""
_SURE = _Contact(0.1, 0.2)
"""Contact of shadows beyond doubt."""
_ISLAND = 0.6
"""Share of the border in touch with the lit body, from which on a shadow lies in it, on whatever side."""
_ON_GROUND = _Contact(0.04, 0.1)
"""Contact of shadows on the ground."""
_SIDED, _SIDED_DIRECT = _Contact(0.15, 0.25), _Direct(0.05, 0.25)
"""Those whose contact is plain, for which they may have more direct light."""
_BESIDE = -0.2
"""Side of clear shadows on the ground, whatever their share of contact."""
_WORSE, _WORSE_BY = 1.5, 0.004
"""Misfit as a shadow on the ground, times and more than that of the best on it, at most."""
_DIM_MISFIT, _DARK_MISFIT = 0.18, 0.08
"""Misfits of shadows on other bodies, in contact with shadows: with much of the sky's light; with little."""
_MARKING_SKY, _MARKING_DIRECT = 0.22, 0.04
"""Light of shadows on bay lines and kerbs: the sky's, at least; direct, at most."""
_NEXT_CLEAR, _NEXT, _NEXT_MARKING = 0.04, 0.4, 0.3
"""Share of the border in contact with shadows, at least: of clear ones, of others, and of markings."""
_ENCLOSED, _ENCLOSED_DIRECT = 0.7, 0.25
"""Share of it from which on a segment lies in shadow with more direct light; that, at most."""
_SKY_OVER_SUN = 0.05
"""Amount by which the sky's light exceeds direct light in single pixels in shadow, at least."""


class Scene(NamedTuple):
    """What is known of segments before shadows are.

    Attributes
    ----------
    spectrum : (segment, channel)
        Reflectance [1].
    size : (segment,)
        Pixels.
    pairs
        Which segments touch.
    border : (segment,)
        Sides of pixels around a segment, those at the edge of the picture among them.
    """

    spectrum: Floats
    size: Ints
    pairs: Touching
    border: Floats


def match_shade(
    number: npt.NDArray[np.int32],
    spectrum: Floats,
    size: Ints,
    pairs: Touching,
    light: Light,
    side: Array | None,
) -> tuple[Matches, Bools]:
    r"""Find the segments that lie in a cast shadow, and those that are ground (segment,).

    A segment can be in the shadow of a body where
    :math:`\rho_B (c f_{dir} + V f_{dif} + b \rho_n)`, the light of the sky and of one neighbour, fits it with
    little c. Dark glass and black paint fit as well, so that the surroundings decide:

    1. Beyond doubt is what sees much of the sky, and touches its lit body on the far side of the sun, or all
       around.
    2. The ground is what most of these lie on. On it, shadows may be darker and more coloured.
    3. From there they go on to segments that touch them, and are no part of what stands in the sun.

    Parameters
    ----------
    number : (line, column)
        Segment of every pixel, -1 without data.
    spectrum : (segment, channel)
        Reflectance [1].
    size : (segment,)
        Pixels.
    pairs
        Which segments touch.
    light
        Parts of the irradiance.
    side : (2,)
        Direction (along, across) in which shadows fall; found from the clearest of them if None.
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
    if side is None:
        side = _side_of_shadows(mixtures, sides, scene)
        if side is None:
            return Matches(state, body), ground
    length, way = sides.sum(axis=1), sides @ (_STEPS @ side)
    _assign(mixtures, _beyond_doubt(mixtures, length, way, border), state, body)
    ground = _ground(scene, state, body)
    on_ground = ground[mixtures.body]
    around = border[mixtures.segment]
    touches = (length >= _ON_GROUND.border * around) & (way >= _ON_GROUND.way * length)
    touches &= length >= _LEAST_CONTACT
    loose = (mixtures.misfit < _LOOSE) & without_sun(mixtures)
    sided = (length >= _SIDED.border * around) & (way >= _SIDED.way * length) & (mixtures.misfit < _LOOSE)
    loose |= sided & (
        mixtures.direct < _SIDED_DIRECT.open + _SIDED_DIRECT.hidden * (_OPEN_SKY - mixtures.sky)
    )
    beside = (length >= _LEAST_CONTACT) & (way >= _BESIDE * length) & _clear(mixtures)
    best = _best_on_ground(mixtures, on_ground, count) & ~ground[mixtures.segment]
    _assign(mixtures, on_ground & best & ((touches & loose) | beside), state, body)
    _grow(mixtures, ground, best, length, way, scene, state, body)
    return Matches(state, body), ground


def _candidates(scene: Scene, senders: Ints, light: Light) -> Mixtures:
    """Return the segments that could be in shadow, with the bodies that they touch, and the largest."""
    spectrum, size, pairs = scene.spectrum, scene.size, scene.pairs
    count = size.size
    is_finite = np.asarray(np.isfinite(spectrum).all(axis=1))
    level = np.where(is_finite, np.nan_to_num(spectrum).mean(axis=1), 0.0)
    largest = np.argsort(-size, kind="stable")[:_LARGEST]
    near, bridged = beyond(pairs, size)
    one = np.concatenate([near, np.repeat(np.arange(count), largest.size)])
    other = np.concatenate([bridged, np.tile(largest, count)])
    fits = is_finite[one] & is_finite[other] & (one != other) & (level[one] < _DARKER * level[other])
    fits &= (size[other] >= _BODY_SHARE * size[one]) & (level[one] > 0)
    return mixtures_of(*distinct_pairs(one[fits], other[fits], count), spectrum, senders, light)


def _lit_sides(mixtures: Mixtures, scene: Scene) -> Floats:
    """Return the sides (n, 4) on which candidates touch what looks like their body."""
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
    """Tell which segments are of about the same colour and brightness, pair by pair."""
    level = spectrum.mean(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        shape = spectrum / level[:, None]
        close = np.abs(level[one] / level[other] - 1.0) < _AS_BRIGHT
    return np.asarray(close & (np.abs(shape[one] - shape[other]).max(axis=1) < _ALIKE))


def _side_of_shadows(mixtures: Mixtures, sides: Floats, scene: Scene) -> Floats | None:
    """Return the direction (along, across) in which shadows fall, None without any."""
    sure = _clear(mixtures) & (mixtures.sky > _LEAST_SKY) & (scene.size[mixtures.segment] >= _TELLING)
    total = (sides[sure] @ _STEPS * scene.size[mixtures.segment[sure], None]).sum(axis=0)
    length = float(np.hypot(*total))
    return np.asarray(total / length) if length > 0 else None


def _clear(mixtures: Mixtures, most_sent: float = _SENT) -> Bools:
    """Tell which see much of the sky and, unlike glass and black paint, hardly anything else."""
    hidden = np.clip(_OPEN_SKY - mixtures.sky, 0.0, 1.0)
    little = mixtures.direct < _CLEAR_DIRECT.open + _CLEAR_DIRECT.hidden * hidden
    little &= mixtures.sent < most_sent * (1.0 - mixtures.sky)
    return np.asarray(little & (mixtures.misfit < _TIGHT))


def _beyond_doubt(mixtures: Mixtures, length: Floats, way: Floats, border: Floats) -> Bools:
    """Tell which are clear, and touch their lit body away from the sun, or all around."""
    around = border[mixtures.segment]
    touches = (length >= _LEAST_CONTACT) & (length > _SURE.border * around)
    away = way >= _SURE.way * length
    island = (length > _ISLAND * around) & (way >= -_SIDEWAYS * length)
    return np.asarray(_clear(mixtures) & (mixtures.sky > _LEAST_SKY) & touches & (away | island))


def _ground(scene: Scene, state: Array, body: Array) -> Bools:
    """Return which segments are ground (segment,): the largest, and what most shadows lie on."""
    count = scene.size.size
    area = np.bincount(body, np.where(state == SHADED, scene.size, 0), count)
    is_ground = np.zeros(count, bool)
    for one in np.flatnonzero((area > _GROUND_SHARE * area.sum()) | (scene.size == scene.size.max())):
        is_ground |= _alike(scene.spectrum, np.arange(count), np.full(count, one))
    return is_ground


def _best_on_ground(mixtures: Mixtures, on_ground: Bools, count: int) -> Bools:
    """Tell which fit their segments about as well as any of the ground does."""
    least = np.full(count, np.inf)
    np.minimum.at(least, mixtures.segment[on_ground], mixtures.misfit[on_ground])
    return np.asarray(mixtures.misfit < _WORSE * least[mixtures.segment] + _WORSE_BY)


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
    """Let shadows go on to what touches them."""
    around, on_ground = scene.border[mixtures.segment], ground[mixtures.body]
    sunny = (way < -_SIDEWAYS * length) & (length > _SURE.border * around)
    fits = best & ~sunny & without_sun(mixtures)
    on = fits & on_ground & (mixtures.misfit < _LOOSE) & (mixtures.sky < _OPEN_SKY)
    bright = mixtures.sky > _LEAST_SKY
    other = fits & ~on_ground & (mixtures.misfit < np.where(bright, _DIM_MISFIT, _DARK_MISFIT))
    dim = other & bright
    # dark glass against bay lines and kerbs has less of the sky
    markings = other & (mixtures.sky > _MARKING_SKY) & (mixtures.direct < _MARKING_DIRECT)
    clear = _clear(mixtures, most_sent=_SENT_BESIDE)
    for _ in range(_ROUNDS):
        dark = state == SHADED
        shaded, below = (
            _touched(which, scene)[mixtures.segment] / around for which in (dark, dark & ground[body])
        )
        enough = on & (shaded > np.where(clear, _NEXT_CLEAR, _NEXT))
        enough |= (dim & (shaded > _NEXT)) | (markings & (below > _NEXT_MARKING))
        enough |= best & ~sunny & (mixtures.direct < _ENCLOSED_DIRECT) & (shaded > _ENCLOSED)
        if not _assign(mixtures, enough, state, body):
            break


def _touched(which: Bools, scene: Scene) -> Floats:
    """Return how many sides of every segment lie at some others (segment,)."""
    weight = scene.pairs.length * which[scene.pairs.other]
    return np.bincount(scene.pairs.one, weight, scene.size.size).astype(np.float64)


def _assign(mixtures: Mixtures, chosen: Bools, state: Array, body: Array) -> bool:
    """Give segments the body, itself lit, that fits best; tell whether any got one."""
    any_ = False
    for place in np.flatnonzero(chosen)[np.argsort(mixtures.misfit[chosen], kind="stable")]:
        segment, parent = mixtures.segment[place], body[mixtures.body[place]]
        if state[segment] == LIT and state[parent] == LIT and parent != segment:
            state[segment] = SHADED
            body[body == segment] = parent
            any_ = True
    return any_


def shaded_pixels(
    channels: npt.NDArray[np.float32],
    number: npt.NDArray[np.int32],
    level: Bools,
    reference: Floats,
    light: Light,
) -> Bools:
    """Return the pixels (line, column) of level ground that lack direct light: shadows of thin things.

    What leans away from the sun lacks it as well, so that nothing but the ground can be asked.

    Parameters
    ----------
    channels : (line, column, channel)
        Reflectance [1].
    number : (line, column)
        Segment of every pixel, -1 without data.
    level : (segment,)
        True for ground in the sun.
    reference : (segment, channel)
        Reflectance of bodies in full light [1].
    light
        Parts of the irradiance.
    """
    shaded = np.zeros(number.shape, bool)
    bright = reference.mean(axis=1)
    asked = np.append(level, False)[number]
    for part in in_parts(len(number), _LINES):
        seen, segment = channels[part], number[part]
        here = asked[part] & (seen.mean(axis=2) < _DIMMER * np.append(bright, 0.0)[segment])
        body = reference[segment[here]]
        amount, misfit = solve(seen[here].astype(np.float64), body, None, light)
        bluer = amount[:, 1] > amount[:, 0] + _SKY_OVER_SUN
        missing = (amount[:, 0] < _MISSING) & bluer & (misfit < _PATCHY)
        shaded[part][here] = missing
    return shaded
