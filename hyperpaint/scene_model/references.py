"""What a segment's surface looks like in full light, where the segment itself lies in shadow or glint."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from .model import GLINTED, LIT, SHADED
from .segments import Touching, beyond

__all__ = ["Light", "Matches", "clean_references", "match_segments", "median_spectra"]

Array = npt.NDArray[Any]
Float = npt.NDArray[np.float64]
Int = npt.NDArray[np.int64]

# spectra of segments are compared to so much of the reference, and so much reflectance [1]
_SHADE_TOLERANCE, _GLINT_TOLERANCE, _FLOOR = 0.08, 0.02, 0.0005
_WORST = 0.11
"""Misfit of a shadow, relative to what is seen, at most."""
_DARKER = 0.5
"""Brightness of a shadow, relative to its body, at most."""
_LEAST_DIFFUSE, _MOST_DIFFUSE = 0.2, 1.15
_STEPS = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
_SIDEWAYS, _SIDED = 0.35, 0.3
_GROUND = 0.05
"""Share of the line of what is taken for the ground."""
_FADING = 0.35
_LARGEST = 40
"""Segments that may be the body of any."""
_ALIKE = 0.05
_BODY_SHARE = 0.3
"""Size of the lit part of a body, relative to its shadow, at least."""
_LEAST_GLINT = 0.004
_ROUNDS = 6
_OFFSET, _LIFT = 0.1, 0.05
_FEW, _DIFFERS = 50, 0.003
_CLEAN = (0.05, 0.35)


class Light(NamedTuple):
    """The parts of the irradiance in channels (channel,) [1]; they add up to 1."""

    direct: Float
    diffuse: Float


class Matches(NamedTuple):
    """State and body of every segment, see `SceneModel`."""

    state: npt.NDArray[np.int8]
    body: npt.NDArray[np.int32]


def median_spectra(channels: npt.NDArray[np.float32], places: list[Int]) -> Float:
    """Return the median (segment, channel) of the pixels at places; NaN where nothing is known."""
    flat = channels.reshape(-1, channels.shape[2])
    made = np.full((len(places), channels.shape[2]), np.nan)
    for segment, here in enumerate(places):
        if here.size:
            made[segment] = _median(flat[here].astype(np.float64))
    return made


def _median(values: Float) -> Float:
    """Return the median of columns, of what is known; NaN where nothing is."""
    if not np.isnan(values).any():
        return np.asarray(np.median(values, axis=0))
    made = np.full(values.shape[1], np.nan)
    for column, known in enumerate(np.isfinite(values).T):
        if known.any():
            made[column] = np.median(values[known, column])
    return made


def _unmix(
    seen: Float,
    body: Int,
    bodies: Float,
    light: Light,
    noise: float,
    priors: Array,
    neighbours: npt.NDArray[np.int32] | None = None,
) -> tuple[Float, Float, Float]:
    """Return amounts (n, part), misfits (n,) and what neighbours add (n, 2) of spectra (n, channel)."""
    from hyperpaint.kernels.unmixing import PARTS, unmix_lines

    count = len(seen)
    amount = np.empty((1, count, PARTS), np.float32)
    added = np.empty((1, count, 2), np.float32)
    together, misfit = np.empty((2, 1, count), np.float32)
    expected, spread = np.ascontiguousarray(priors, np.float64)
    alone = np.full((count, 2), -1, np.int32) if neighbours is None else np.ascontiguousarray(neighbours)
    unmix_lines(
        np.ascontiguousarray(seen, np.float32)[None], body.astype(np.int32)[None], bodies, alone[None],
        light.direct, light.diffuse, noise, _FLOOR, expected, spread, np.full(PARTS, np.inf),
        amount, added, together, misfit,
    )  # fmt: skip
    return amount[0].astype(np.float64), misfit[0].astype(np.float64), added[0].astype(np.float64)


_NONE = (0.0, 1e-6)
_AS_SHADE = np.transpose([(0.05, 0.15), (0.7, 0.5), _NONE, (0.0, 0.002), *(4 * [_NONE])])
_AS_GLINT = np.transpose([(1.0, 0.1), (1.0, 0.15), (0.0, 10.0), (0.0, 0.01), *(4 * [_NONE])])
_BESIDE = 2 * [(0.0, 0.1), (0.0, 0.05)]
_AS_PIXEL = np.transpose([(1.0, 0.2), (1.0, 0.3), (_OFFSET, 0.1), (_OFFSET, 0.02), *_BESIDE])


def _with_largest(near: tuple[Int, Int], size: Int) -> tuple[Int, Int]:
    """Return the pairs, and every segment with the largest of all: the ground, its lines and kerbs."""
    largest = np.argsort(-size, kind="stable")[:_LARGEST]
    every = np.repeat(np.arange(size.size), largest.size)
    return np.concatenate([near[0], every]), np.concatenate([near[1], np.tile(largest, size.size)])


class Candidates(NamedTuple):
    """Segments that could be others' surfaces in shadow, each with one of these.

    Attributes
    ----------
    segment, body : (n,)
        The segment and the surface that it could be.
    amount : (n, part)
        What its light is made of, if so.
    misfit : (n,)
        What that leaves, relative to what is seen [1].
    """

    segment: Int
    body: Int
    amount: Float
    misfit: Float

    def only(self, which: Array) -> Candidates:
        """Return some of them."""
        return Candidates(self.segment[which], self.body[which], self.amount[which], self.misfit[which])


def match_segments(
    spectrum: Float, size: Int, pairs: Touching, light: Light, side: Array | None, step: Float
) -> Matches:
    r"""Find the segments that are others' surfaces in shadow or in glint.

    A segment may be in the shadow of a surface it touches where it is less than half as bright and
    :math:`\rho_B (c f_{dir} + V f_{dif})` fits it. Dark glass and black paint can fit as well as shadowed
    asphalt does; of a shadow, light that comes off other things is the less the more sky it sees, and it does
    not end in the light on the side of the sun. It is in glint where
    :math:`\rho_B (c f_{dir} + V f_{dif}) + g f_{dir}` fits to 2 % with c and V near 1.

    Parameters
    ----------
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
    step : (pair,)
        Mean difference of neighbouring pixels on the two sides of a border [1].
    """
    bridged = beyond(pairs, size)
    near = _with_largest(bridged, size)
    # a mirror image fades out, a body ends
    apart = np.abs(spectrum.mean(axis=1)[pairs.one] - spectrum.mean(axis=1)[pairs.other])
    fading = (pairs.length >= 3) & (step < _FADING * apart)
    touch = pairs.one[fading], pairs.other[fading]
    state = np.full(len(spectrum), LIT, np.int8)
    body = np.arange(len(spectrum), dtype=np.int32)
    for strict in (True, False):
        for _ in range(_ROUNDS):
            candidates = _shadow_candidates(spectrum, size, near, light, state, body)
            if strict:
                candidates = candidates.only(_beyond_doubt(candidates, size))
            if side is None:
                side = _shadow_side(candidates, pairs, spectrum, size)
            if side is None or not _match_shade(
                candidates, pairs, bridged, side, size, spectrum, state, body
            ):
                break
        if strict:
            for _ in range(_ROUNDS):
                if not _match_glint(spectrum, size, touch, light, state, body):
                    break
    return Matches(state, body)


def _pairs_of_bodies(near: tuple[Int, Int], state: Array, body: Array, spectrum: Float) -> tuple[Int, Int]:
    """Return the segments that are not matched yet, each with the bodies near it."""
    one, other = near[0], body[near[1]].astype(np.int64)
    known = np.asarray(np.isfinite(spectrum).all(axis=1))
    open_ = (state[one] == LIT) & (one != other) & known[one] & known[other]
    codes = np.unique(one[open_] * len(spectrum) + other[open_])
    return codes // max(len(spectrum), 1), codes % max(len(spectrum), 1)


def _match_glint(
    spectrum: Float, size: Int, near: tuple[Int, Int], light: Light, state: Array, body: Array
) -> bool:
    """Match segments to what they are with the sun's mirror image; tell whether any was."""
    lit = state[near[1]] != SHADED
    near = near[0][lit], near[1][lit]
    one, other = _pairs_of_bodies(near, state, body, spectrum)
    amount, misfit, _ = _unmix(
        spectrum[one], other, np.nan_to_num(spectrum), light, _GLINT_TOLERANCE, _AS_GLINT
    )
    fits = (amount[:, 2] > _LEAST_GLINT) & (misfit < 1.0) & (size[other] >= 0.2 * size[one])
    # where the darker one could be the shadow, the brighter is no glint
    one, other, misfit = one[fits], other[fits], misfit[fits]
    fits = ~_could_be_shade(spectrum, other, one, light)[2]
    return _assign(one[fits], other[fits], misfit[fits], GLINTED, state, body)


def _assign(one: Int, other: Int, misfit: Float, kind: int, state: Array, body: Array) -> bool:
    """Give segments, and those whose body they were, the body that fits best; tell whether any got one."""
    found = False
    for place in np.argsort(misfit, kind="stable"):
        segment, parent = one[place], other[place]
        if state[segment] == LIT and body[parent] != segment:
            state[segment] = kind
            body[body == segment] = body[parent]
            found = True
    return found


def _shadow_candidates(
    spectrum: Float, size: Int, near: tuple[Int, Int], light: Light, state: Array, body: Array
) -> Candidates:
    one, other = _pairs_of_bodies(near, state, body, spectrum)
    large = size[other] >= _BODY_SHARE * size[one]
    one, other = one[large], other[large]
    amount, misfit, fits = _could_be_shade(spectrum, one, other, light)
    return Candidates(one, other, amount, misfit).only(fits)


def _could_be_shade(
    spectrum: Float, one: Int, other: Int, light: Light
) -> tuple[Float, Float, npt.NDArray[np.bool_]]:
    """Return amounts, relative misfits, and whether ``one`` looks like ``other`` in shadow, pair by pair."""
    amount, misfit, _ = _unmix(
        spectrum[one], other, np.nan_to_num(spectrum), light, _SHADE_TOLERANCE, _AS_SHADE
    )
    misfit = misfit * _SHADE_TOLERANCE
    level = spectrum.mean(axis=1)
    fits = (level[one] < _DARKER * level[other]) & (misfit < _WORST) & (amount[:, 1] > _LEAST_DIFFUSE)
    # what hides the sky sends light instead, and never more than a bright wall in the sun
    fits &= amount[:, 1] < _MOST_DIFFUSE
    fits &= amount[:, 0] < 0.02 + 0.14 * np.clip(1.0 - amount[:, 1], 0.0, 1.0)
    return amount, misfit, np.asarray(fits)


def _lit_borders(
    candidates: Candidates, pairs: Touching, state: Array, body: Array, spectrum: Float
) -> npt.NDArray[np.int64]:
    """Return the sides (n, 4) on which candidates touch what in full light is like their body.

    Other parts of the same car are of its colour, if not of its brightness.
    """
    sides = np.zeros((candidates.segment.size, 4), np.int64)
    level = spectrum.mean(axis=1, keepdims=True)
    shape = spectrum / np.where(level == 0, np.nan, level)
    starts = np.searchsorted(pairs.one, [candidates.segment, candidates.segment + 1])
    for place, (first, last) in enumerate(starts.T):
        other = pairs.other[first:last]
        apart = np.abs(shape[other] - shape[candidates.body[place]]).max(axis=1)
        lit = (state[other] != SHADED) & ((body[other] == candidates.body[place]) | (apart < _ALIKE))
        sides[place] = pairs.sides[first:last][lit].sum(axis=0)
    return sides


def _contacts(
    candidates: Candidates, pairs: Touching, near: tuple[Int, Int], state: Array, body: Array
) -> tuple[Int, npt.NDArray[np.bool_]]:
    """Return how far candidates touch the lit part of their body (n,), and whether shadow of it is near."""
    count = state.size
    wanted = candidates.segment * count + candidates.body
    lit = state[pairs.other] != SHADED
    codes, place = np.unique(pairs.one[lit] * count + body[pairs.other[lit]], return_inverse=True)
    length = np.append(np.bincount(place, pairs.length[lit], codes.size).astype(np.int64), 0)
    spot = np.searchsorted(codes, wanted)
    found = np.append(codes, -1)[spot] == wanted
    shaded = state[near[1]] == SHADED
    same = np.isin(wanted, near[0][shaded] * count + body[near[1][shaded]])
    return np.where(found, length[spot], 0), same


def _beyond_doubt(candidates: Candidates, size: Int) -> npt.NDArray[np.bool_]:
    """Tell which get hardly any direct light and much of the sky's, unlike glass and black paint."""
    sure = (candidates.amount[:, 0] < 0.04) & (candidates.amount[:, 1] > 0.4) & (candidates.misfit < 0.06)
    return np.asarray(sure & (size[candidates.segment] >= 30))


def _shadow_side(candidates: Candidates, pairs: Touching, spectrum: Float, size: Int) -> Float | None:
    """Return the direction (along, across) in which shadows fall, None without any."""
    none = np.zeros(size.size, np.int8)
    sides = _lit_borders(candidates, pairs, none, np.arange(size.size), spectrum)
    total = (sides @ _STEPS * size[candidates.segment, None]).sum(axis=0)
    length = float(np.hypot(*total))
    return np.asarray(total / length) if length > 0 else None


def _match_shade(
    candidates: Candidates,
    pairs: Touching,
    near: tuple[Int, Int],
    side: Array,
    size: Int,
    spectrum: Float,
    state: Array,
    body: Array,
) -> bool:
    """Match segments to the surfaces that they are in shadow; tell whether any was.

    They touch its lit part, or other shadows, and not its lit part on the side of the sun.
    """
    sides = _lit_borders(candidates, pairs, state, body, spectrum)
    length, way = sides.sum(axis=1), sides @ _STEPS
    sided = (way @ side >= -_SIDEWAYS * length) & (np.hypot(*way.T) >= _SIDED * length)
    weight = pairs.length * (state[pairs.other] == SHADED)
    shaded = np.bincount(pairs.one, weights=weight, minlength=state.size)
    border = np.bincount(pairs.one, weights=pairs.length, minlength=state.size)
    beside = shaded[candidates.segment] > 0.15 * border[candidates.segment]
    direct, same = _contacts(candidates, pairs, near, state, body)
    open_sky = candidates.amount[:, 1] > 0.4
    ground = size[candidates.body] > _GROUND * size.sum()
    fits = sided & ((direct > 2) | (beside & (open_sky | same | ground)))
    chosen = candidates.only(fits)
    return _assign(chosen.segment, chosen.body, chosen.misfit, SHADED, state, body)


def clean_references(
    channels: npt.NDArray[np.float32],
    places: list[Int],
    spectrum: Float,
    matches: Matches,
    light: Light,
    neighbours: npt.NDArray[np.int32],
) -> Float:
    """Return the spectra of bodies (segment, channel), without what glint and neighbours add to some pixels.

    Where that differs from pixel to pixel by over 0.003, those from the 5th to the 35th percentile of it are
    averaged. Other rows are those of their segments.

    Parameters
    ----------
    channels : (line, column, channel)
        Reflectance [1].
    places
        Pixels of every segment.
    spectrum, matches, light
        Of the segments, and the irradiance.
    neighbours : (line x column, 2)
        Coloured segments beside every pixel.
    """
    known = np.nan_to_num(spectrum)
    reference = known.copy()
    flat = channels.reshape(-1, channels.shape[2])
    for segment in range(len(spectrum)):
        here = places[segment]
        if matches.body[segment] != segment or not np.isfinite(spectrum[segment]).all():
            continue
        here = here[np.isfinite(flat[here]).all(axis=1)]
        if here.size < _FEW:
            continue
        values = flat[here].astype(np.float64)
        extra, direct = _additions(values, segment, known, light, neighbours[here])
        low, high = np.quantile(extra, [0.1, 0.5])
        if high - low > _DIFFERS:
            first, last = np.quantile(extra, _CLEAN)
            chosen = (extra >= first) & (extra <= last) & (direct > 0.7)
            if chosen.sum() >= _FEW // 5:
                reference[segment] = values[chosen].mean(axis=0)
    return np.ascontiguousarray(reference[matches.body] if len(reference) else reference)


def _additions(
    values: Float, segment: int, known: Float, light: Light, neighbours: npt.NDArray[np.int32]
) -> tuple[Float, Float]:
    """Return what glint and neighbours add to pixels, up to a constant, and their amounts of direct light.

    An amount of each is added to all before, so that less than in the mean shows as well.
    """
    first = neighbours[:, 0]
    mirrored = np.where(first[:, None] >= 0, known[first], 0.0)
    lifted = values + _OFFSET + _LIFT * mirrored
    body = np.full(len(values), segment)
    amount, _, added = _unmix(lifted, body, known, light, 0.01, _AS_PIXEL, neighbours)
    return amount[:, 2] + added.sum(axis=1) - _LIFT * mirrored.max(axis=1), amount[:, 0]
