"""Spectra of segments as bodies in other light: amounts of sun, sky, glint and light of one neighbour."""

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
    """The light of sun and sky in channels (channel,) [1], relative to the irradiance."""

    direct: Floats  #: Direct part of the irradiance.
    diffuse: Floats  #: Diffuse part; both sum to 1.
    above: Floats  #: Zenith sky in a perfect mirror.
    sunward: Floats  #: Excess of the sky around the sun over the zenith, in a perfect mirror.

    @classmethod
    def under(cls, diffuse: Floats, zenith: Floats | float = 1.0, sunward: Floats | float = 0.0) -> Light:
        """Return the light of a diffuse fraction (channel,) and a sky's radiances over its mean [1]."""
        return cls(1.0 - diffuse, diffuse, diffuse * zenith, diffuse * sunward)


class Matches(NamedTuple):
    """State and body of every segment, see `SceneModel`."""

    state: npt.NDArray[np.int8]
    body: npt.NDArray[np.int32]


def median_spectra(channels: Floats32, samples: list[Ints]) -> Floats:
    """Return medians (segment, channel) of the pixels with flat indices ``samples``; NaN without values."""
    flat = channels.reshape(-1, channels.shape[2])
    medians = np.full((len(samples), channels.shape[2]), np.nan)
    for segment, indices in enumerate(samples):
        if indices.size:
            medians[segment] = _median(gather(flat, indices).astype(np.float64))
    return medians


def _median(values: Floats) -> Floats:
    # Median of the finite values in every column; NaN without finite values
    if not np.isnan(values).any():
        return np.asarray(np.median(values, axis=0))
    median = np.full(values.shape[1], np.nan)
    for column, is_finite in enumerate(np.isfinite(values).T):
        if is_finite.any():
            median[column] = np.median(values[is_finite, column])
    return median


def unmix_spectra(
    spectra: Floats,
    body: Ints,
    bodies: Floats,
    light: Light,
    noise: float,
    priors: Array,
    neighbours: npt.NDArray[np.int32] | None = None,
) -> tuple[Floats, Floats, Floats]:
    """Return amounts (n, part), misfits (n,) and light of neighbours (n, 2) in spectra (n, channel).

    Takes ``spectra`` (n, channel): reflectance [1]; ``body`` (n,): row of ``bodies`` for every spectrum;
    ``bodies`` (segment, channel): reflectance in full light [1]; ``light``: parts of the irradiance;
    ``noise``: standard deviation relative to ``spectra`` [1], the unit of misfits; ``priors`` (2, part):
    expected amounts and their standard deviations; ``neighbours`` (n, 2): rows of ``bodies`` that may send
    light, -1 for none; by default no neighbour sends light.
    """
    from hyperpaint.kernels import arguments
    from hyperpaint.kernels.unmixing import PARTS, unmix_lines

    # the kernel takes lines of pixels: the spectra are one line
    count = len(spectra)
    amount = np.empty((1, count, PARTS), np.float32)
    added = np.empty((1, count, 2), np.float32)
    together, misfit = np.empty((2, 1, count), np.float32)
    expected, spread = np.ascontiguousarray(priors, np.float64)
    senders = np.full((count, 2), -1, np.int32) if neighbours is None else np.ascontiguousarray(neighbours)
    unmix_lines(
        np.ascontiguousarray(spectra, np.float32)[None],
        arguments.Bodies(body.astype(np.int32)[None], bodies, senders[None]),
        arguments.LightParts(*light),
        arguments.ChannelErrors(np.full(light.direct.size, noise), GLINT.floor),
        arguments.AmountPrior(expected, spread, np.full(len(bodies), spread[0]), expected + max_excesses()),
        0.0,
        arguments.Glinting(0.0, 0.0),
        arguments.Unmixed(amount, added, together, misfit),
    )
    return amount[0].astype(np.float64), misfit[0].astype(np.float64), added[0].astype(np.float64)


def max_excesses() -> Floats:
    """Return the maximum physical excess of amounts over the expected amounts (part,) [1]; inf for none."""
    from hyperpaint.kernels.unmixing import PARTS

    excesses = np.full(PARTS, np.inf)
    excesses[3:5] = MIRROR.max_above, MIRROR.max_sunward
    return excesses


def match_segments(
    spectrum: Floats, size: Ints, pairs: Touching, light: Light, shade: Matches, step: Floats, zenith: float
) -> Matches:
    r"""Return the state and body of every segment: ``shade``, and the segments in glint.

    A segment is a body :math:`\rho_B` in glint g where
    :math:`\rho_B (c f_{dir} + V f_{dif}) + g f_{dir}` fits its spectrum to 2 % with c and V near 1.

    Takes ``spectrum`` (segment, channel): reflectance [1]; ``size`` (segment,): pixels; ``pairs``: touching
    segments; ``light``: parts of the irradiance; ``shade``: segments in shadow, from
    `hyperpaint.surroundings.surveying.match_shade`; ``step`` (pair,): mean difference of neighbouring
    pixels on the two sides of a border [1]; ``zenith``: of the sun [degree]; NaN where unknown.
    """
    # maximum direct light on a body part that leans towards the sun
    max_direct = GLINT.max_tilt / max(np.cos(np.radians(np.nan_to_num(zenith, nan=45.0))), 0.2)
    # the border of a mirror image is gradual, the border of a body is sharp
    contrast = np.abs(spectrum.mean(axis=1)[pairs.one] - spectrum.mean(axis=1)[pairs.other])
    is_gradual = (pairs.length >= 3) & (step < GLINT.max_fading_step * contrast)
    touch = pairs.one[is_gradual], pairs.other[is_gradual]
    state, body = shade.state.copy(), shade.body.copy()
    for _ in range(GLINT.rounds):
        if not _match_glint(spectrum, size, touch, light, state, body, max_direct):
            break
    return Matches(state, body)


def _match_glint(
    spectrum: Floats,
    size: Ints,
    near: tuple[Ints, Ints],
    light: Light,
    state: Array,
    body: Array,
    max_direct: float,
) -> bool:
    # Match segments to bodies under the mirror image of the sun; return whether any matched.
    # Candidates: lit segments with the bodies of their lit neighbours.
    lit = state[near[1]] != SHADED
    segment, body_near = near[0][lit], body[near[1][lit]].astype(np.int64)
    is_finite = np.asarray(np.isfinite(spectrum).all(axis=1))
    is_candidate = (state[segment] == LIT) & (segment != body_near)
    is_candidate &= is_finite[segment] & is_finite[body_near]
    segment, body_near = distinct_pairs(segment[is_candidate], body_near[is_candidate], len(spectrum))
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
    # no glint where a lean towards the sun explains the brightness
    tilt, tilt_misfit, _ = unmix_spectra(
        spectrum[segment], body_near, np.nan_to_num(spectrum), light, GLINT.tolerance, _AS_TILT
    )
    tilted = (tilt_misfit < 1.0) & (tilt[:, 0] < max_direct)
    return _assign(segment[~tilted], body_near[~tilted], misfit[~tilted], state, body)


def _assign(segments: Ints, bodies: Ints, misfit: Floats, state: Array, body: Array) -> bool:
    # Assign to every segment, and to the segments assigned to it before, the best fitting body.
    # Return whether any segment changed.
    any_assigned = False
    for pair in np.argsort(misfit, kind="stable"):
        segment, parent = segments[pair], bodies[pair]
        if state[segment] == LIT and body[parent] != segment:
            state[segment] = GLINTED
            body[body == segment] = body[parent]
            any_assigned = True
    return any_assigned


def _could_be_shade(spectrum: Floats, dark: Ints, bright: Ints, light: Light) -> Bools:
    # Whether the segment `dark` may be the surface of the segment `bright` in shadow (pair,)
    amount, misfit, _ = unmix_spectra(
        spectrum[dark], bright, np.nan_to_num(spectrum), light, GLINT.shade_tolerance, _AS_SHADE
    )
    direct, sky, level = amount[:, 0], amount[:, 1], spectrum.mean(axis=1)
    fits = (sky > GLINT.min_shade_sky) & (misfit * GLINT.shade_tolerance < GLINT.max_shade_misfit)
    fits &= level[dark] < GLINT.max_shade_brightness * level[bright]
    # objects that hide the sky send light instead, at most as much as a bright wall in the sun
    fits &= (sky < GLINT.max_shade_sky) & (direct < 0.02 + 0.14 * np.clip(1.0 - sky, 0.0, 1.0))
    return np.asarray(fits)


#: Number of pairs solved together, to limit memory.
PAIRS_AT_ONCE = 20_000


class Mixtures(NamedTuple):
    """Pairs of a segment and a body whose surface it may show in other light; see `mixtures_of`."""

    segment: Ints  #: (n,): Number of the segment.
    body: Ints  #: (n,): Number of the body.
    direct: Floats  #: (n,): Amount c of direct light [1].
    sky: Floats  #: (n,): Amount V of the sky's light [1].
    sent: Floats  #: (n,): Amount b of light sent by a neighbour [1].
    misfit: Floats  #: (n,): Root mean square of the residual, relative to the reflectance [1].

    def subset(self, mask: Bools) -> Mixtures:
        return Mixtures._make(values[mask] for values in self)


def without_sun(mixtures: Mixtures) -> Bools:
    """Return whether grey objects that hide a part of the sky may send all the direct light (n,)."""
    return np.asarray(mixtures.direct < 0.02 + 0.2 * np.clip(0.75 - mixtures.sky, 0.0, 1.0))


def mixtures_of(segment: Ints, body: Ints, spectrum: Floats, senders: Ints, light: Light) -> Mixtures:
    r"""Return the pairs whose segment may be the body in little sun, with their amounts of light.

    A pair fits where :math:`\rho_B (c f_{dir} + V f_{dif} + b \rho_n)`, with c, V, b not negative, fits the
    segment's spectrum. Of all neighbours n the one with the smallest misfit is used; its light comes from
    directions where the sky is hidden, b < 1 - V.

    Takes ``segment``, ``body`` (n,): candidate pairs; ``spectrum`` (segment, channel): reflectance [1];
    ``senders`` (segment, rank): neighbours that may light a segment, -1 for none; ``light``: parts of the
    irradiance.
    """
    # first without a neighbour, then with every neighbour where it lowers the misfit
    finite_spectrum = np.nan_to_num(spectrum)
    solutions = [
        solve(finite_spectrum[segment[pairs]], finite_spectrum[body[pairs]], None, light)
        for pairs in in_parts(segment.size)
    ]
    if not solutions:
        empty = np.empty(0)
        return Mixtures(segment, body, empty, empty, empty, empty)
    amount, misfit = (np.concatenate(values) for values in zip(*solutions, strict=True))
    possible = (amount[:, 0] < MIXTURES.max_direct) & (amount[:, 1] < MIXTURES.max_sky + 0.4) & (misfit < 0.6)
    segment, body, misfit = segment[possible], body[possible], misfit[possible]
    amount = np.pad(amount[possible], ((0, 0), (0, 1)))
    for rank in range(senders.shape[1]):
        sender = senders[segment, rank]
        rows = np.flatnonzero((sender >= 0) & (sender != body))
        for part in in_parts(rows.size):
            pairs = rows[part]
            sender_amount, sender_misfit = solve(
                finite_spectrum[segment[pairs]],
                finite_spectrum[body[pairs]],
                finite_spectrum[sender[pairs]],
                light,
            )
            better = (sender_misfit < misfit[pairs]) & (sender_amount[:, 2] < 1.0 - sender_amount[:, 1])
            amount[pairs[better]], misfit[pairs[better]] = sender_amount[better], sender_misfit[better]
    fits = (amount[:, 1] < MIXTURES.max_sky) & (misfit < MIXTURES.max_misfit)
    direct, sky, sent = amount[fits].T
    return Mixtures(segment[fits], body[fits], direct, sky, sent, misfit[fits])


def in_parts(count: int, max_items: int = PAIRS_AT_ONCE) -> list[slice]:
    """Return the slices that divide ``count`` items into parts of at most ``max_items``."""
    return [slice(start, start + max_items) for start in range(0, count, max_items)]


def senders_of(number: npt.NDArray[np.int32], spectrum: Floats, size: Ints) -> Ints:
    """Return the coloured neighbours that may light every segment (segment, rank); -1 for none.

    Neighbours that are nearest to more pixels of the segment come first. Light of grey neighbours cannot be
    distinguished from direct light. Takes ``number`` (line, column): segment of every pixel.
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
    # number of cells of every segment to which a sender is nearest
    cell_segment = np.repeat(centre.ravel().astype(np.int64), MIXTURES.neighbours_of_cell)
    nearest = labels.ravel().astype(np.int64)
    codes = (cell_segment * size.size + nearest)[(cell_segment >= 0) & (nearest >= 0)]
    pairs, cells = np.unique(codes, return_counts=True)
    segment, sender = pairs // max(size.size, 1), pairs % max(size.size, 1)
    order = np.lexsort((sender, -cells, segment))
    segment, sender = segment[order], sender[order]
    rank = np.arange(segment.size) - np.searchsorted(segment, segment)
    senders = np.full((size.size, MIXTURES.neighbours), -1, np.int64)
    is_stored = rank < MIXTURES.neighbours
    senders[segment[is_stored], rank[is_stored]] = sender[is_stored]
    return senders


def solve(spectra: Floats, body: Floats, sender: Floats | None, light: Light) -> tuple[Floats, Floats]:
    """Return amounts (n, 2 or 3) of sun, sky and sender, and relative misfits (n,), of spectra (n, channel).

    An object that casts a shadow first hides the sky around the sun, so that the visible sky may be as blue
    as the zenith. The sky is therefore any sum of diffuse and zenith light; its amount is that of the
    irradiance. See `least_amounts`.
    """
    parts = [body * light.direct, body * light.diffuse, body * light.above]
    if sender is not None:
        parts.append(body * sender)
    amounts, misfit = least_amounts(spectra, parts)
    diffuse = light.diffuse.sum()
    amounts[:, 1] += amounts[:, 2] * (light.above.sum() / diffuse if diffuse > 0 else 0.0)
    return np.delete(amounts, 2, axis=1), misfit


def least_amounts(spectra: Floats, parts: list[Floats]) -> tuple[Floats, Floats]:
    """Return least-squares amounts (n, part) from 0 on, and relative misfits (n,), of spectra (n, channel).

    The minimum is exact: every subset of the parts, (channel,) or (n, channel), is solved, and the one with
    the smallest residual and no negative amount is returned.
    """
    sigma = MIXTURES.tolerance * np.abs(spectra) + MIXTURES.floor
    design = np.stack([part / sigma for part in parts], axis=2)
    target = spectra / sigma
    # normal equations
    gram = np.einsum("nki,nkj->nij", design, design)
    moments = np.einsum("nki,nk->ni", design, target)
    square = (target * target).sum(axis=1)
    count, part_count = moments.shape
    best, amounts = square.copy(), np.zeros((count, part_count))
    ridge = 1e-9 * np.trace(gram, axis1=1, axis2=2)[:, None, None]
    for bits in range(1, 2**part_count):
        subset = [part for part in range(part_count) if bits >> part & 1]
        block = gram[:, subset][:, :, subset] + ridge * np.eye(len(subset))
        amount = np.linalg.solve(block, moments[:, subset, None])[..., 0]
        cost = square - (amount * moments[:, subset]).sum(axis=1)
        better = (amount >= 0).all(axis=1) & (cost < best)
        best[better] = cost[better]
        amounts[better] = 0.0
        amounts[np.flatnonzero(better)[:, None], subset] = amount[better]
    return amounts, np.sqrt(np.maximum(best, 0.0) / spectra.shape[1]) * MIXTURES.tolerance
