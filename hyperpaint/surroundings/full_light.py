"""Segments as bodies in other light: least-squares amounts of sun, sky, glint and one neighbour's light."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Array, Bools, Floats, Floats32, Ints

from .detection_rules import GLINT, MIRROR, MIXTURES
from .model import CELL, GLINTED, LIT, SHADED
from .scratch import gather
from .segments import Touching, distinct_pairs

_NONE = (0.0, 1e-6)
#: Priors of the amounts of a body in shadow, of a leaning body and of a body in glint: expected values and
#: standard deviations (2, part); parts as in `hyperpaint.kernels.unmixing`.
_AS_SHADE = np.transpose([(0.05, 0.15), (0.7, 0.5), _NONE, (0.0, 0.002), *(5 * [_NONE])])
_AS_TILT = np.transpose([(1.0, 0.3), (1.0, 0.3), _NONE, (0.0, 0.01), *(5 * [_NONE])])
AS_GLINT = np.transpose([(1.0, 0.1), (1.0, 0.15), (0.0, 10.0), (0.0, 0.01), (0.0, 0.03), *(4 * [_NONE])])


class Light(NamedTuple):
    """The light of sun and sky in channels (channel,) [1]."""

    #: Parts of the irradiance with sum 1.
    direct: Floats
    diffuse: Floats
    #: Light in a perfect mirror: the sky above, and the excess of the sky around the sun.
    above: Floats
    sunward: Floats

    @classmethod
    def under(cls, diffuse: Floats, zenith: Floats | float = 1.0, sunward: Floats | float = 0.0) -> Light:
        """Return the light of a diffuse fraction (channel,) and a sky's radiances over its mean [1]."""
        return cls(1.0 - diffuse, diffuse, diffuse * zenith, diffuse * sunward)


class Matches(NamedTuple):
    """State and body of every segment, see `SceneModel`."""

    state: npt.NDArray[np.int8]
    body: npt.NDArray[np.int32]


def median_spectra(channels: Floats32, places: list[Ints]) -> Floats:
    """Return the median (segment, channel) of the pixels at places; NaN without values."""
    flat = channels.reshape(-1, channels.shape[2])
    medians = np.full((len(places), channels.shape[2]), np.nan)
    for segment, here in enumerate(places):
        if here.size:
            medians[segment] = _median(gather(flat, here).astype(np.float64))
    return medians


def _median(values: Floats) -> Floats:
    # Median of the finite values of every column; NaN without any
    if not np.isnan(values).any():
        return np.asarray(np.median(values, axis=0))
    median = np.full(values.shape[1], np.nan)
    for column, is_finite in enumerate(np.isfinite(values).T):
        if is_finite.any():
            median[column] = np.median(values[is_finite, column])
    return median


def unmix_spectra(
    seen: Floats,
    body: Ints,
    bodies: Floats,
    light: Light,
    noise: float,
    priors: Array,
    neighbours: npt.NDArray[np.int32] | None = None,
) -> tuple[Floats, Floats, Floats]:
    """Return amounts (n, part), misfits (n,) and light of neighbours (n, 2) in spectra (n, channel).

    Takes ``seen`` (n, channel): reflectance [1]; ``body`` (n,): body of each, a row of ``bodies``; ``bodies``
    (segment, channel): reflectance in full light [1]; ``light``: parts of the irradiance; ``noise``: standard
    deviation relative to ``seen`` [1], the unit of misfits; ``priors`` (2, part): expected amounts and their
    standard deviations; ``neighbours`` (n, 2): rows of ``bodies`` that may send light, -1 for none; by
    default none do.
    """
    from hyperpaint.kernels import arguments
    from hyperpaint.kernels.unmixing import PARTS, unmix_lines

    count = len(seen)
    amount = np.empty((1, count, PARTS), np.float32)
    added = np.empty((1, count, 2), np.float32)
    together, misfit = np.empty((2, 1, count), np.float32)
    expected, spread = np.ascontiguousarray(priors, np.float64)
    alone = np.full((count, 2), -1, np.int32) if neighbours is None else np.ascontiguousarray(neighbours)
    unmix_lines(
        np.ascontiguousarray(seen, np.float32)[None],
        arguments.Bodies(body.astype(np.int32)[None], bodies, alone[None]),
        arguments.LightParts(*light),
        arguments.ChannelErrors(np.full(light.direct.size, noise), GLINT.floor),
        arguments.AmountPrior(expected, spread, np.full(len(bodies), spread[0]), expected + most_amounts()),
        0.0,
        arguments.Glinting(0.0, 0.0),
        arguments.Unmixed(amount, added, together, misfit),
    )
    return amount[0].astype(np.float64), misfit[0].astype(np.float64), added[0].astype(np.float64)


def most_amounts() -> Floats:
    """Return the largest physical excess of amounts over the expected ones (part,) [1]; inf if unlimited."""
    from hyperpaint.kernels.unmixing import PARTS

    most = np.full(PARTS, np.inf)
    most[3:5] = MIRROR.max_above, MIRROR.max_sunward
    return most


def match_segments(
    spectrum: Floats, size: Ints, pairs: Touching, light: Light, shade: Matches, step: Floats, zenith: float
) -> Matches:
    r"""Return the segments that are other segments' surfaces in glint, and those in shadow.

    A segment is in glint where
    :math:`\rho_B (c f_{dir} + V f_{dif}) + g f_{dir}` fits to 2 % with c and V near 1.

    Takes ``spectrum`` (segment, channel): reflectance [1]; ``size`` (segment,): pixels; ``pairs``: touching
    segments; ``light``: parts of the irradiance; ``shade``: segments in shadow, from
    `hyperpaint.surroundings.surveying.match_shade`; ``step`` (pair,): mean difference of neighbouring
    pixels on the two sides of a border [1]; ``zenith``: of the sun [degree]; NaN where unknown.
    """
    most = GLINT.max_tilt / max(np.cos(np.radians(np.nan_to_num(zenith, nan=45.0))), 0.2)
    # a mirror image fades out, a body has an edge
    apart = np.abs(spectrum.mean(axis=1)[pairs.one] - spectrum.mean(axis=1)[pairs.other])
    fading = (pairs.length >= 3) & (step < GLINT.max_fading_step * apart)
    touch = pairs.one[fading], pairs.other[fading]
    state, body = shade.state.copy(), shade.body.copy()
    for _ in range(GLINT.rounds):
        if not _match_glint(spectrum, size, touch, light, state, body, most):
            break
    return Matches(state, body)


def _match_glint(
    spectrum: Floats,
    size: Ints,
    near: tuple[Ints, Ints],
    light: Light,
    state: Array,
    body: Array,
    most: float,
) -> bool:
    # Match segments to bodies under the mirror image of the sun; return whether any matched
    # the segments that are not matched yet, each with the bodies near it
    lit = state[near[1]] != SHADED
    segment, body_near = near[0][lit], body[near[1][lit]].astype(np.int64)
    is_finite = np.asarray(np.isfinite(spectrum).all(axis=1))
    open_ = (state[segment] == LIT) & (segment != body_near) & is_finite[segment] & is_finite[body_near]
    segment, body_near = distinct_pairs(segment[open_], body_near[open_], len(spectrum))
    amount, misfit, _ = unmix_spectra(
        spectrum[segment], body_near, np.nan_to_num(spectrum), light, GLINT.tolerance, AS_GLINT
    )
    fits = (
        (amount[:, 2] + amount[:, 4] > GLINT.min_glint)
        & (misfit < 1.0)
        & (size[body_near] >= GLINT.min_body_share * size[segment])
    )
    # no glint where the darker segment could be the brighter one in shadow
    segment, body_near, misfit = segment[fits], body_near[fits], misfit[fits]
    fits = ~_could_be_shade(spectrum, body_near, segment, light)
    segment, body_near, misfit = segment[fits], body_near[fits], misfit[fits]
    # surfaces that lean towards the sun are brighter as well
    tilt, left, _ = unmix_spectra(
        spectrum[segment], body_near, np.nan_to_num(spectrum), light, GLINT.tolerance, _AS_TILT
    )
    tilted = (left < 1.0) & (tilt[:, 0] < most)
    return _assign(segment[~tilted], body_near[~tilted], misfit[~tilted], state, body)


def _assign(one: Ints, other: Ints, misfit: Floats, state: Array, body: Array) -> bool:
    # Assign the best fitting bodies to segments and the segments on these; return whether any changed
    any_assigned = False
    for place in np.argsort(misfit, kind="stable"):
        segment, parent = one[place], other[place]
        if state[segment] == LIT and body[parent] != segment:
            state[segment] = GLINTED
            body[body == segment] = body[parent]
            any_assigned = True
    return any_assigned


def _could_be_shade(spectrum: Floats, one: Ints, other: Ints, light: Light) -> Bools:
    # Whether `one` looks like `other` in shadow, pair by pair
    amount, misfit, _ = unmix_spectra(
        spectrum[one], other, np.nan_to_num(spectrum), light, GLINT.shade_tolerance, _AS_SHADE
    )
    direct, sky, level = amount[:, 0], amount[:, 1], spectrum.mean(axis=1)
    fits = (sky > GLINT.min_shade_sky) & (misfit * GLINT.shade_tolerance < GLINT.max_shade_misfit)
    fits &= level[one] < GLINT.max_shade_brightness * level[other]
    # objects that hide the sky send light instead, at most as much as a bright wall in the sun
    fits &= (sky < GLINT.max_shade_sky) & (direct < 0.02 + 0.14 * np.clip(1.0 - sky, 0.0, 1.0))
    return np.asarray(fits)


#: Pairs solved together, to limit memory.
PAIRS_AT_ONCE = 20_000


class Mixtures(NamedTuple):
    """Pairs of a segment and a body whose surface it may show in other light."""

    #: (n,): Numbers of segments.
    segment: Ints
    body: Ints
    #: (n,): Amounts c, V and b [1].
    direct: Floats
    sky: Floats
    sent: Floats
    misfit: Floats  #: (n,): Root mean square of the residual, relative to the reflectance [1].

    def subset(self, chosen: Bools) -> Mixtures:
        return Mixtures(
            self.segment[chosen],
            self.body[chosen],
            self.direct[chosen],
            self.sky[chosen],
            self.sent[chosen],
            self.misfit[chosen],
        )


def without_sun(mixtures: Mixtures) -> Bools:
    """Return whether direct light is so low that, for the visible sky, grey objects may send it (n,)."""
    return np.asarray(mixtures.direct < 0.02 + 0.2 * np.clip(0.75 - mixtures.sky, 0.0, 1.0))


def mixtures_of(segment: Ints, body: Ints, spectrum: Floats, senders: Ints, light: Light) -> Mixtures:
    r"""Return segments as bodies in little sun, with the neighbour whose light leaves the smallest misfit.

    :math:`\rho_B (c f_{dir} + V f_{dif} + b \rho_n)` with c, V, b not negative; the neighbour's light comes
    from where the sky is hidden, b < 1 - V. Pairs without such amounts are left out.

    Takes ``segment``, ``body`` (n,): candidate pairs; ``spectrum`` (segment, channel): reflectance [1];
    ``senders`` (segment, rank): segments that may light one, -1 for none; ``light``: parts of the irradiance.
    """
    finite_spectrum = np.nan_to_num(spectrum)
    alone = [
        solve(finite_spectrum[segment[part]], finite_spectrum[body[part]], None, light)
        for part in in_parts(segment.size)
    ]
    if not alone:
        empty = np.empty(0)
        return Mixtures(segment, body, empty, empty, empty, empty)
    amount, misfit = (np.concatenate(values) for values in zip(*alone, strict=True))
    possible = (amount[:, 0] < MIXTURES.max_direct) & (amount[:, 1] < MIXTURES.max_sky + 0.4) & (misfit < 0.6)
    segment, body, misfit = segment[possible], body[possible], misfit[possible]
    amount = np.pad(amount[possible], ((0, 0), (0, 1)))
    for rank in range(senders.shape[1]):
        sender = senders[segment, rank]
        rows = np.flatnonzero((sender >= 0) & (sender != body))
        for part in in_parts(rows.size):
            here = rows[part]
            more, rest = solve(
                finite_spectrum[segment[here]],
                finite_spectrum[body[here]],
                finite_spectrum[sender[here]],
                light,
            )
            better = (rest < misfit[here]) & (more[:, 2] < 1.0 - more[:, 1])
            amount[here[better]], misfit[here[better]] = more[better], rest[better]
    fits = (amount[:, 1] < MIXTURES.max_sky) & (misfit < MIXTURES.max_misfit)
    direct, sky, sent = amount[fits].T
    return Mixtures(segment[fits], body[fits], direct, sky, sent, misfit[fits])


def in_parts(count: int, together: int = PAIRS_AT_ONCE) -> list[slice]:
    """Return slices of at most ``together`` items each."""
    return [slice(first, first + together) for first in range(0, count, together)]


def senders_of(number: npt.NDArray[np.int32], spectrum: Floats, size: Ints) -> Ints:
    """Return the coloured segments nearest to most of each segment's pixels (segment, rank); -1 for none.

    Light of grey segments cannot be distinguished from direct light.
    """
    from hyperpaint.kernels.segmentation import nearest_sources

    level = spectrum.mean(axis=1)
    sends = (level > MIXTURES.min_sender_level) & (size >= MIXTURES.min_sender_px)
    sends &= spectrum.std(axis=1) > MIXTURES.min_sender_colour * level
    centre = number[::CELL, ::CELL]
    labels = np.full((*centre.shape, MIXTURES.neighbours_of_cell), -1, np.int32)
    labels[..., 0] = np.where(np.append(sends, False)[centre], centre, -1)
    distances = np.full(labels.shape, np.inf)
    distances[..., 0][labels[..., 0] >= 0] = 0.0
    nearest_sources(labels, distances, MIXTURES.reach_px / CELL)
    here = np.repeat(centre.ravel().astype(np.int64), MIXTURES.neighbours_of_cell)
    nearest = labels.ravel().astype(np.int64)
    pairs, times = np.unique((here * size.size + nearest)[(here >= 0) & (nearest >= 0)], return_counts=True)
    segment, sender = pairs // max(size.size, 1), pairs % max(size.size, 1)
    order = np.lexsort((sender, -times, segment))
    segment, sender = segment[order], sender[order]
    rank = np.arange(segment.size) - np.searchsorted(segment, segment)
    senders = np.full((size.size, MIXTURES.neighbours), -1, np.int64)
    first = rank < MIXTURES.neighbours
    senders[segment[first], rank[first]] = sender[first]
    return senders


def solve(seen: Floats, body: Floats, sender: Floats | None, light: Light) -> tuple[Floats, Floats]:
    """Return amounts (n, 2 or 3) of sun, sky and sender, and relative misfits (n,), of spectra (n, channel).

    An object that casts a shadow first hides the sky around the sun, so that the rest may be as blue as the
    zenith: the sky is any sum of both, and its amount that of the irradiance. See `least_amounts`.
    """
    parts = [body * light.direct, body * light.diffuse, body * light.above]
    if sender is not None:
        parts.append(body * sender)
    amounts, misfit = least_amounts(seen, parts)
    whole = light.diffuse.sum()
    amounts[:, 1] += amounts[:, 2] * (light.above.sum() / whole if whole > 0 else 0.0)
    return np.delete(amounts, 2, axis=1), misfit


def least_amounts(seen: Floats, parts: list[Floats]) -> tuple[Floats, Floats]:
    """Return amounts (n, part) that are not negative and relative misfits (n,), of spectra (n, channel).

    The exact minimum: the set of parts (channel,) or (n, channel) with the smallest residual and no negative
    amount.
    """
    sigma = MIXTURES.tolerance * np.abs(seen) + MIXTURES.floor
    design = np.stack([part / sigma for part in parts], axis=2)
    target = seen / sigma
    gram = np.einsum("nki,nkj->nij", design, design)
    right = np.einsum("nki,nk->ni", design, target)
    square = (target * target).sum(axis=1)
    count, used = right.shape
    best, amounts = square.copy(), np.zeros((count, used))
    small = 1e-9 * np.trace(gram, axis1=1, axis2=2)[:, None, None]
    for subset in range(1, 2**used):
        which = [part for part in range(used) if subset >> part & 1]
        block = gram[:, which][:, :, which] + small * np.eye(len(which))
        amount = np.linalg.solve(block, right[:, which, None])[..., 0]
        cost = square - (amount * right[:, which]).sum(axis=1)
        better = (amount >= 0).all(axis=1) & (cost < best)
        best[better] = cost[better]
        amounts[better] = 0.0
        amounts[np.flatnonzero(better)[:, None], which] = amount[better]
    return amounts, np.sqrt(np.maximum(best, 0.0) / seen.shape[1]) * MIXTURES.tolerance
