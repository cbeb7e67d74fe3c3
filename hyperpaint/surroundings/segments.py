"""Segments of one surface in one light: division of a picture, spectra as bodies in other light, lobes."""

from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.sparse
from scipy.ndimage import find_objects, label

from hyperpaint.base import Array, Bools, Floats, Floats32, Ints
from hyperpaint.kernels import arguments, segmentation as kernels
from hyperpaint.kernels.segmentation import (
    boundary_distance,
    count_pixels,
    nearest_sources,
    pick_steps,
    sample_places,
    sort_steps,
    squared_depth,
)
from hyperpaint.kernels.unmixing import PARTS, unmix_lines

from .detection_rules import GLINT, LOBES, MIRROR, MIXTURES, SEGMENTS
from .model import CELL, GLINTED, LIT, SHADED
from .scratch import gather, line_blocks, release, scratch_array, trim_memory


class Segments(NamedTuple):
    """Segments of a line."""

    number: npt.NDArray[np.int32]  #: (line, column), int32: Segment of every pixel; -1 without data.
    sure: Bools  #: (line, column), bool: False in small or thin segments that joined a neighbour.
    size: Ints  #: (segment,), int64: Number of pixels.


class Touching(NamedTuple):
    # Pairs of segments that touch, sorted; every pair occurs in both orders.
    one: Ints  #: (pair,): First segment.
    other: Ints  #: (pair,): Second segment.
    length: Ints  #: (pair,): Number of pixel sides between them.
    #: (pair, 4): Number of these sides where the second segment lies along the track, against it, to the
    #: right, to the left.
    sides: Ints


def divide(channels: Floats32) -> Segments:
    # Return the segments of a line (line, column, channel).
    #
    # The steps between neighbouring pixels are visited in ascending order. A step joins its two segments
    # unless it is larger than the steps inside them allow (Felzenszwalb & Huttenlocher, Int. J. Comput. Vis.
    # 59, 2004). The result does not depend on chunks.
    lines, columns, _ = channels.shape
    has_data = np.empty((lines, columns), np.bool_)
    steps = scratch_array((lines, columns, 2), np.float32)  # to the right, and to the next line
    counts = np.zeros(1 << 15, np.int64)
    for rows, block in line_blocks(channels, overlap=1):
        block_steps = steps[rows]
        kernels.step_sizes(block, SEGMENTS.step_floor, block_steps[..., 0], block_steps[..., 1])
        kernels.count_steps(block_steps.ravel(), block_steps.ravel().view(np.uint32), counts)
        release(steps)
        has_data[rows] = np.isfinite(block[: rows.stop - rows.start]).mean(axis=2) > 0.5
    # segments as trees: parent of every pixel, and size and largest inner step of every root
    parent = np.arange(lines * columns, dtype=np.int32)
    size, inner_step = np.ones(parent.size, np.int32), np.zeros(parent.size, np.float32)
    order = scratch_array((int(counts.sum()),), np.int32)
    ends = [0]
    for indices, values in sorted_steps(steps, counts):
        kernels.join_segments(indices, values, columns, SEGMENTS.granularity, parent, size, inner_step)
        ends.append(ends[-1] + indices.size)
        order[ends[-2] : ends[-1]] = indices
        release(order)
    del inner_step, steps
    # small and thin segments join a neighbour, over the smallest steps first
    large, sure = np.empty((2, parent.size), np.bool_)
    kernels.mark_large(parent, size, columns, SEGMENTS.min_pixels, SEGMENTS.min_core_px, large)
    kernels.to_pixels(parent, large, sure)
    for start, stop in pairwise(ends):
        kernels.absorb(order[start:stop], columns, large, parent, size)
        release(order)
    del order, size, large
    number = np.empty(parent.size, np.int32)
    count = kernels.number_segments(parent, has_data.ravel(), number)
    shape = lines, columns
    del parent
    return Segments(
        number.reshape(shape),
        sure.reshape(shape),
        np.bincount(number[number >= 0], minlength=count).astype(np.int64),
    )


#: Number of groups of steps, in ascending ranges of size, that are sorted one after another.
_GROUPS = 8


def sorted_steps(steps: Floats32, counts: Ints) -> Iterator[tuple[Array, Array]]:
    # Yield flat indices and sizes of the finite steps (line, column, direction), ascending, in groups.
    # `counts` is the histogram of the sizes, in bins of the upper bits of float32.
    total = np.concatenate([[0], np.cumsum(counts)])
    # last bin of every group; steps that are not finite lie beyond the last group
    edges = np.unique(
        np.concatenate([[0], np.searchsorted(total, np.linspace(0, total[-1], _GROUPS + 1)[1:])])
    )
    max_count = np.diff(total[edges]).max(initial=0)
    # allocated once: repeated allocation would not reuse all memory
    indices, values = np.empty((2, max_count), np.int32), np.empty((2, max_count), np.uint32)
    for start, stop in pairwise(edges):
        count = 0
        for rows, block in line_blocks(steps):
            bits, offset = block.ravel().view(np.uint32), rows.start * steps.shape[1] * 2
            count = pick_steps(bits, offset, start, stop, indices[0], values[0], count)
        group = indices[0, :count], values[0, :count]
        sorted_group = indices[1, :count], values[1, :count]
        sort_steps(*group, *sorted_group)
        yield sorted_group[0], sorted_group[1].view(np.float32)


def sample_pixels(number: npt.NDArray[np.int32], inside: Bools, count: int) -> list[Ints]:
    # Return flat indices of at most `max_sample_px` pixels of every segment, evenly spread in line order.
    #
    # Pixels of the mask ``inside`` are sampled; all pixels of segments without such a pixel.
    counts = np.zeros((2, count), np.int64)
    count_pixels(number, inside, counts)
    has_inside = counts[1] > 0
    available = np.where(has_inside, counts[1], counts[0])
    step = np.maximum(1, -(-available // SEGMENTS.max_sample_px))
    sizes = -(-available // step)
    ends = np.cumsum(sizes)
    samples = np.empty(ends[-1] if count else 0, np.int64)
    sample_places(number, inside, has_inside, step, ends - sizes, np.zeros(count, np.int64), samples)
    return np.split(samples, ends[:-1]) if count else []


def touching(number: npt.NDArray[np.int32], count: int) -> Touching:
    # Return the touching segments, with the number and direction of their common sides.
    # a pair of segments is coded as one number
    codes, directions = [], []
    for axis, (before, after) in enumerate(_NEIGHBOURS):
        for _, block in line_blocks(number, overlap=1 - axis):
            first, second = block[before].ravel(), block[after].ravel()
            differ = np.flatnonzero((first != second) & (first >= 0) & (second >= 0))
            one, other = first[differ].astype(np.int64), second[differ].astype(np.int64)
            codes += [one * count + other, other * count + one]
            directions += [np.full(one.size, 2 * axis, np.int8), np.full(one.size, 2 * axis + 1, np.int8)]
    pairs, pair = np.unique(np.concatenate(codes), return_inverse=True)
    sides = np.bincount(4 * pair + np.concatenate(directions), minlength=4 * pairs.size).reshape(-1, 4)
    del codes, directions, pair
    trim_memory()
    return Touching(*np.divmod(pairs, max(count, 1)), sides.sum(axis=1), sides)


def beyond(pairs: Touching, size: Ints) -> tuple[Ints, Ints]:
    # Return pairs of segments that touch, or have a small segment between them that touches both.
    #
    # Large segments do not link others: everything in a car park touches the asphalt.
    count = size.size
    near = pairs.length >= SEGMENTS.min_border_sides
    one, other = pairs.one[near], pairs.other[near]
    touch = scipy.sparse.csr_array((np.ones(one.size), (one, other)), shape=(count, count))
    small = scipy.sparse.diags_array((size < SEGMENTS.max_bridge_px).astype(np.float64))
    linked = (touch + touch @ small @ touch).tocoo()
    row, column = (axis.astype(np.int64) for axis in linked.coords)
    differ = row != column
    order = np.lexsort((column[differ], row[differ]))
    return row[differ][order], column[differ][order]


def distinct_pairs(one: Ints, other: Ints, count: int) -> tuple[Ints, Ints]:
    # Return the distinct pairs of numbers below ``count``, sorted.
    first, second = np.divmod(np.unique(one * count + other), max(count, 1))
    return first, second


def border_steps(channels: Floats32, number: npt.NDArray[np.int32], pairs: Touching) -> Array:
    # Return the mean difference in brightness of neighbouring pixels across a border (pair,) [1].
    count = int(number.max()) + 1
    codes = pairs.one * count + pairs.other
    # sums by axis and by order of the pair
    sums = np.zeros((2, 2, codes.size))
    for axis, (before, after) in enumerate(_NEIGHBOURS):
        for lines, block in line_blocks(channels, overlap=1 - axis):
            numbers, level = number[lines.start : lines.start + len(block)], block.mean(axis=2)
            first, second = numbers[before].ravel(), numbers[after].ravel()
            differ = np.flatnonzero((first != second) & (first >= 0) & (second >= 0))
            step = np.abs(level[before] - level[after]).ravel()[differ].astype(np.float64)
            one, other = first[differ].astype(np.int64), second[differ].astype(np.int64)
            for row, code in zip(sums[axis], (one * count + other, other * count + one), strict=True):
                # sequential sums: the same bits for any blocks
                np.add.at(row, np.searchsorted(codes, code), np.nan_to_num(step))
    return np.asarray((sums[0, 0] + sums[0, 1] + sums[1, 0] + sums[1, 1]) / pairs.length)


#: Slices of pixels and their neighbours, first in the next line, then in the next column.
_NEIGHBOURS: tuple[Any, Any] = (np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])


def edge_distance(
    segments: Segments, body: npt.NDArray[np.int32], surface: npt.NDArray[np.int32]
) -> npt.NDArray[np.uint8]:
    # Return the distance of every pixel from another surface (line, column) [pixel]; 0 in mixed pixels.
    #
    # Takes ``body``, ``surface`` (segment,): body and surface of every segment. Bodies of one surface differ
    # by light and tilt only, so that pixels between them are not mixed; small or thin segments there still
    # are.
    to_surface = np.empty(segments.number.shape, np.uint8)
    to_body = np.empty_like(to_surface)
    for labels, distance in ((surface, to_surface), (body, to_body)):
        boundary_distance(
            np.append(labels, np.int32(-1))[segments.number].astype(np.int32), segments.sure, 255, distance
        )
    to_surface[to_body == 0] = 0
    return to_surface


def distance_to(mask: Bools) -> npt.NDArray[np.uint8]:
    # Return the distance of every pixel from a mask (line, column) [pixel], 0 inside; at most 255.
    distance = np.empty(mask.shape, np.uint8)
    boundary_distance(mask.astype(np.int32), np.ones(mask.shape, bool), 255, distance)
    distance[mask] = 0
    return distance


# --- spectra of segments as bodies in other light ----------------------------------------------------------


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
    def under(cls, diffuse: Floats, zenith: Floats | float = 1.0, sunward: Floats | float = 0.0) -> "Light":
        # Return the light of a diffuse fraction (channel,) and a sky's radiances over its mean [1].
        return cls(1.0 - diffuse, diffuse, diffuse * zenith, diffuse * sunward)


class Matches(NamedTuple):
    # State and body of every segment, see `SceneModel`.
    state: npt.NDArray[np.int8]
    body: npt.NDArray[np.int32]


def median_spectra(channels: Floats32, samples: list[Ints]) -> Floats:
    # Return medians (segment, channel) of the pixels with flat indices ``samples``; NaN without values.
    flat = channels.reshape(-1, channels.shape[2])
    medians = np.full((len(samples), channels.shape[2]), np.nan)
    for median, indices in zip(medians, samples, strict=True):
        values = gather(flat, indices).astype(np.float64)
        if indices.size and not np.isnan(values).any():
            median[:] = np.median(values, axis=0)
            continue
        for column, is_finite in enumerate(np.isfinite(values).T):
            if is_finite.any():
                median[column] = np.median(values[is_finite, column])
    return medians


def unmix_spectra(
    spectra: Floats,
    body: Ints,
    bodies: Floats,
    light: Light,
    noise: float,
    priors: Array,
    neighbours: npt.NDArray[np.int32] | None = None,
) -> tuple[Floats, Floats, Floats]:
    # Return amounts (n, part), misfits (n,) and light of neighbours (n, 2) in spectra (n, channel).
    #
    # Takes ``spectra`` (n, channel): reflectance [1]; ``body`` (n,): row of ``bodies`` for every spectrum;
    # ``bodies`` (segment, channel): reflectance in full light [1]; ``light``: parts of the irradiance;
    # ``noise``: standard deviation relative to ``spectra`` [1], the unit of misfits; ``priors`` (2, part):
    # expected amounts and their standard deviations; ``neighbours`` (n, 2): rows of ``bodies`` that may send
    # light, -1 for none; by default no neighbour sends light.
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
    # Return the maximum physical excess of amounts over the expected amounts (part,) [1]; inf for none.
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
    is_candidate = (
        (state[segment] == LIT) & (segment != body_near) & is_finite[segment] & is_finite[body_near]
    )
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
    # whether the body nearby may be the surface of the segment in shadow (pair,)
    as_shade, shade_misfit, _ = unmix_spectra(
        spectrum[body_near], segment, np.nan_to_num(spectrum), light, GLINT.shade_tolerance, _AS_SHADE
    )
    direct, sky, level = as_shade[:, 0], as_shade[:, 1], spectrum.mean(axis=1)
    # objects that hide the sky send light instead, at most as much as a bright wall in the sun
    fits = ~(
        (sky > GLINT.min_shade_sky)
        & (sky < GLINT.max_shade_sky)
        & (shade_misfit * GLINT.shade_tolerance < GLINT.max_shade_misfit)
        & (level[body_near] < GLINT.max_shade_brightness * level[segment])
        & (direct < 0.02 + 0.14 * np.clip(1.0 - sky, 0.0, 1.0))
    )
    segment, body_near, misfit = segment[fits], body_near[fits], misfit[fits]
    # no glint where a lean towards the sun explains the brightness
    tilt, tilt_misfit, _ = unmix_spectra(
        spectrum[segment], body_near, np.nan_to_num(spectrum), light, GLINT.tolerance, _AS_TILT
    )
    fits = ~((tilt_misfit < 1.0) & (tilt[:, 0] < max_direct))
    return assign_bodies(segment[fits], body_near[fits], misfit[fits], GLINTED, state, body)


def assign_bodies(
    segments: Ints, bodies: Ints, misfit: Floats, new_state: int, state: Array, body: Array
) -> bool:
    # Assign to every lit segment, and to the segments assigned to it before, the best fitting of its bodies;
    # return whether any segment changed.
    #
    # Takes candidate pairs (pair,) with their ``misfit``; changes ``state`` and ``body`` (segment,).
    any_assigned = False
    for pair in np.argsort(misfit, kind="stable"):
        segment, parent = segments[pair], body[bodies[pair]]
        if state[segment] == LIT and parent != segment:
            state[segment] = new_state
            body[body == segment] = parent
            any_assigned = True
    return any_assigned


#: Number of pairs solved together, to limit memory.
PAIRS_AT_ONCE = 20_000


class Mixtures(NamedTuple):
    # Pairs of a segment and a body whose surface it may show in other light; see `mixtures_of`.
    segment: Ints  #: (n,): Number of the segment.
    body: Ints  #: (n,): Number of the body.
    direct: Floats  #: (n,): Amount c of direct light [1].
    sky: Floats  #: (n,): Amount V of the sky's light [1].
    sent: Floats  #: (n,): Amount b of light sent by a neighbour [1].
    misfit: Floats  #: (n,): Root mean square of the residual, relative to the reflectance [1].

    def subset(self, mask: Bools) -> "Mixtures":
        return Mixtures._make(values[mask] for values in self)


def without_sun(mixtures: Mixtures) -> Bools:
    # Return whether grey objects that hide a part of the sky may send all the direct light (n,).
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
        rows = np.flatnonzero((sender >= 0) & (sender != body) & (sender != segment))
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


def in_parts(count: int) -> list[slice]:
    # Return the slices that divide ``count`` items into parts of at most `PAIRS_AT_ONCE`.
    return [slice(start, start + PAIRS_AT_ONCE) for start in range(0, count, PAIRS_AT_ONCE)]


def senders_of(number: npt.NDArray[np.int32], spectrum: Floats, size: Ints) -> Ints:
    # Return the coloured neighbours that may light every segment (segment, rank); -1 for none.
    #
    # Neighbours that are nearest to more pixels of the segment come first. Light of grey neighbours cannot be
    # distinguished from direct light. Takes ``number`` (line, column): segment of every pixel.
    level = spectrum.mean(axis=1)
    sends = (
        (level > MIXTURES.min_sender_level)
        & (size >= MIXTURES.min_sender_px)
        & (spectrum.std(axis=1) > MIXTURES.min_sender_colour * level)
    )
    centre = number[::CELL, ::CELL]
    labels = np.full((*centre.shape, MIXTURES.neighbours_of_cell), -1, np.int32)
    labels[..., 0] = np.where(np.append(sends, False)[centre], centre, -1)
    nearest_sources(labels, np.where(labels >= 0, 0.0, np.inf), MIXTURES.reach_px / CELL)
    # number of cells of every segment to which a sender is nearest
    cell_segment = np.repeat(centre.ravel().astype(np.int64), MIXTURES.neighbours_of_cell)
    nearest = labels.ravel().astype(np.int64)
    pairs, cells = np.unique(
        (cell_segment * size.size + nearest)[(cell_segment >= 0) & (nearest >= 0)], return_counts=True
    )
    segment, sender = np.divmod(pairs, max(size.size, 1))
    order = np.lexsort((sender, -cells, segment))
    segment, sender = segment[order], sender[order]
    rank = np.arange(segment.size) - np.searchsorted(segment, segment)
    senders = np.full((size.size, MIXTURES.neighbours), -1, np.int64)
    is_stored = rank < MIXTURES.neighbours
    senders[segment[is_stored], rank[is_stored]] = sender[is_stored]
    return senders


def solve(spectra: Floats, body: Floats, sender: Floats | None, light: Light) -> tuple[Floats, Floats]:
    # Return amounts (n, 2 or 3) of sun, sky and sender, and relative misfits (n,), of spectra (n, channel).
    #
    # An object that casts a shadow first hides the sky around the sun, so that the visible sky may be as blue
    # as the zenith. The sky is therefore any sum of diffuse and zenith light; its amount is that of the
    # irradiance. See `least_amounts`.
    parts = [body * light.direct, body * light.diffuse, body * light.above]
    if sender is not None:
        parts.append(body * sender)
    amounts, misfit = least_amounts(spectra, parts)
    diffuse = light.diffuse.sum()
    amounts[:, 1] += amounts[:, 2] * (light.above.sum() / diffuse if diffuse > 0 else 0.0)
    return np.delete(amounts, 2, axis=1), misfit


def least_amounts(spectra: Floats, parts: list[Floats]) -> tuple[Floats, Floats]:
    # Return non-negative least-squares amounts (n, part) and relative misfits (n,) of spectra (n, channel).
    #
    # The minimum is exact: every subset of the parts, (channel,) or (n, channel), is solved, and the solution
    # with the smallest residual and no negative amount is returned.
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


# --- mirror images of the sun: the pixels inside one ------------------------------------------------------
# A glossy coat reflects the sun's light into a few degrees: on a body part, into a spot much brighter than
# its surroundings. Flakes in a paint, and leaning body parts, are brighter over all of it, without a spot.

#: Values of a lobe layer: pixels that may be in a mirror image of the sun, saturated pixels in one, and
#: pixels that are brighter than their body around by the mirrored sun; 0 elsewhere.
IN_LOBE, SATURATED_IN_LOBE, BRIGHT_IN_LOBE = 1, 2, 3

#: Steps (line, column) to the ring of pixels three steps around a pixel.
_RING = (
    (-3, -1), (-3, 0), (-3, 1), (-2, 2), (-1, 3), (0, 3), (1, 3), (2, 2),
    (3, 1), (3, 0), (3, -1), (2, -2), (1, -3), (0, -3), (-1, -3), (-2, -2),
)  # fmt: skip
#: Radius of the ring [pixel]; number of lines processed together.
_RADIUS, _LINES = 3, 128
#: Number of darker ring pixels with which the median of the ring is darker; index of the third darkest pixel.
_MIN_DARKER, _THIRD_DARKEST = 9, 2


class Picture(NamedTuple):
    """A flight line prepared for the search of lobes."""

    channels: Floats32  #: (line, column, channel): Reflectance [1].
    saturated: Bools  #: (line, column): Whether a sample is saturated.
    #: Function that returns the body of the pixels of an index (line, column); -1 without data.
    body: Callable[[Any], npt.NDArray[np.int32]]
    ground: Bools  #: (segment,): Bodies without a coat.
    reference: Floats  #: (segment, channel): Reflectance of bodies in full light [1].
    coloured: Bools  #: (segment,): Bodies whose colour differs from the mirrored sun's.
    light: Light


def mirror_lobes(picture: Picture) -> npt.NDArray[np.uint8]:
    r"""Return the pixels that lie in a mirror image of the sun (line, column).

    0 outside, `BRIGHT_IN_LOBE` around a sharp core, `IN_LOBE` around a wide one, or `SATURATED_IN_LOBE`.

    A sharp core is several times brighter than the ring of pixels three steps around it, the ring shows one
    surface in even light, and the excess of the core has the colour of direct light. Its lobe consists of the
    pixels around it that are 4 % brighter than a surface of second order, fitted to :math:`\ln \rho` of the
    surroundings. This surface includes the broad lobe of flakes. A pixel brighter than all lit surfaces and
    flakes is a core, too, whatever is around it; its lobe reaches on along a streak, and into segments that
    show the same body under the mirrored sun.

    A wide core, of a worn coat, is as bright as a white surface in the sun over several pixels. It can be
    distinguished from flakes on coloured paint and on black paint.
    """
    level = scratch_array(picture.saturated.shape, np.float64)
    on_coat = np.empty(level.shape, bool)
    coated = ~np.append(picture.ground, True)
    for lines, block in line_blocks(picture.channels):
        saturated, body = picture.saturated[lines], picture.body(lines)
        level[lines] = np.where(saturated, np.nan, block.mean(axis=2, dtype=np.float64))
        on_coat[lines] = (body >= 0) & coated[body] | saturated
        release(level)
    spots = list(_components(picture.saturated))
    for spot, window in spots:
        if _half_width(spot) <= LOBES.max_spot_px:
            level[window][spot] = np.inf
    lobe, surely = np.zeros((2, *level.shape), bool)
    # Pixels much brighter than evenly bright surroundings (line, column).
    # First, in blocks of lines, pixels for which most of the ring is darker than the contrast demands.
    is_sharp, is_mirrored = np.zeros((2, *level.shape), bool)
    lines, columns = level.shape
    for start in range(0, lines, _LINES):
        block = level[start : start + _LINES]
        max_ring_level = block / LOBES.min_contrast
        darker = np.zeros(block.shape, np.int8)
        # edge pixels are repeated beyond the edges
        rows = np.clip(np.arange(start - _RADIUS, start + len(block) + _RADIUS), 0, lines - 1)
        padded = np.pad(level[rows], ((0, 0), (_RADIUS, _RADIUS)), mode="edge")
        for dy, dx in _RING:
            top, left = _RADIUS + dy, _RADIUS + dx
            darker += padded[top : top + len(block), left : left + columns] < max_ring_level
        is_sharp[start : start + _LINES] = darker >= _MIN_DARKER
        is_mirrored[start : start + _LINES] = (block > LOBES.min_mirrored) & np.isfinite(block)
        release(level)
    # then the exact conditions for these few pixels
    y, x = np.nonzero(is_sharp & on_coat)
    ring = np.sort(
        [level[np.clip(y + dy, 0, lines - 1), np.clip(x + dx, 0, columns - 1)] for dy, dx in _RING], axis=0
    )
    median = 0.5 * (ring[len(_RING) // 2 - 1] + ring[len(_RING) // 2])
    fits = (
        (level[y, x] > LOBES.min_contrast * median)
        & (ring[_THIRD_DARKEST] > LOBES.min_evenness * median)
        & (level[y, x] - median > LOBES.min_excess)
    )
    is_sharp[:] = False
    is_sharp[y[fits], x[fits]] = True
    for cores, lobes, beyond_lit in ((is_sharp, lobe, False), (is_mirrored & on_coat, surely, True)):
        for core, window in _components(cores):
            _add_sharp(picture, level, core, window, lobes, is_mirrored=beyond_lit)
            release(picture.channels)
            release(level)
    # wide cores: the mirrored sun is as bright as a white surface (line, column)
    distinguishable = np.append(_distinguishable(picture), False)
    is_wide = np.zeros(level.shape, bool)
    for lines, block in line_blocks(level):
        bright = distinguishable[picture.body(lines)] & on_coat[lines] & np.isfinite(block)
        bright &= block > LOBES.min_wide_glint * picture.light.direct.mean()
        glint = _mirrored_sun(picture, bright, (lines, slice(0, level.shape[1])))
        is_wide[lines] = glint >= LOBES.min_wide_glint
        release(picture.channels)
    for core, window in _components(is_wide):
        _add_wide(picture, level, core, window, lobe)
        release(picture.channels)
        release(level)
    layer = np.where(surely, np.uint8(BRIGHT_IN_LOBE), lobe.view(np.uint8))
    lobe |= surely
    for spot, window in spots:
        beside = ~spot & ~picture.saturated[window] & (picture.body(window) >= 0)
        rim = beside & (depth_of(~spot) < 1.5)
        if (rim.any() and lobe[window][rim].mean() > LOBES.min_rim) or lobe[window][spot].any():
            layer[window][spot] = SATURATED_IN_LOBE
    return layer


def _components(mask: Bools) -> Iterator[tuple[Bools, tuple[slice, slice]]]:
    # Yield the connected sets of a mask, each as a mask in its window, with the window
    pieces, _ = label(mask, np.ones((3, 3)))
    for number, box in enumerate(find_objects(pieces), 1):
        window = padded(box, 2)
        yield pieces[window] == number, window


def padded(window: tuple[slice, ...], pad: int) -> tuple[slice, slice]:
    # Return a window that is some pixels wider on all sides.
    rows, columns = (slice(max(axis.start - pad, 0), axis.stop + pad) for axis in window)
    return rows, columns


def _in_larger_window(
    core: Bools, window: tuple[slice, slice], larger: tuple[slice, slice], shape: tuple[int, ...]
) -> Bools:
    inside = np.zeros(shape, bool)
    top, left = (inner.start - outer.start for inner, outer in zip(window, larger, strict=True))
    inside[top : top + core.shape[0], left : left + core.shape[1]] = core
    return inside


def depth_of(mask: Bools) -> Floats:
    # Return the distance of every pixel of a mask from the nearest pixel outside it [pixel].
    squared = np.empty(mask.shape, np.int64)
    squared_depth(mask, squared)
    return np.sqrt(squared)


def _half_width(core: Bools) -> float:
    # Maximum distance of a pixel of a core from the core's outside [pixel]
    return float(depth_of(np.pad(core, 1)).max())


def _add_sharp(
    picture: Picture,
    level: Floats,
    core: Bools,
    window: tuple[slice, slice],
    lobe: Bools,
    *,
    is_mirrored: bool,
) -> None:
    # Set the pixels of `lobe` around a sharp core, if the core mirrors the sun; ``is_mirrored`` where it is
    # brighter than lit surfaces
    reach = LOBES.halo_px + LOBES.sharp_halo * _half_width(core)
    is_wide = reach > LOBES.max_sharp_px
    if is_wide and not is_mirrored:
        return
    reach = min(reach, LOBES.max_sharp_px)
    larger = padded(window, LOBES.growths * int(np.ceil(reach)) + LOBES.around_px)
    brightness, body = level[larger], picture.body(larger)
    core = _in_larger_window(core, window, larger, brightness.shape)
    distance = depth_of(~core)
    near, far = (reach, reach + LOBES.around_px) if is_mirrored else (2.5, 4.5)
    ring = (distance > near) & (distance <= far)
    # body with most pixels of the ring, if it has enough of them; beyond the brightness of lit surfaces, of
    # those with a coat
    coated = ~np.append(picture.ground, True)[body]
    numbers, count = np.unique(body[ring & (coated if is_mirrored else body >= 0)], return_counts=True)
    min_share = 0.0 if is_mirrored else LOBES.min_ring_share
    if count.sum() < LOBES.min_ring_px or count.max() < min_share * count.sum():
        return
    surface_body = int(numbers[np.argmax(count)])
    if picture.ground[surface_body]:
        return
    # the excess at the peak over the ring must have the colour of direct light
    peak = np.unravel_index(np.argmax(np.where(core, brightness, -np.inf)), core.shape)
    ring_spectra = picture.channels[larger][(body == surface_body) & ring].astype(np.float64)
    if np.isfinite(brightness[peak]):
        glint = (picture.channels[larger][peak] - np.nanmedian(ring_spectra, axis=0)) / np.maximum(
            picture.light.direct, 1e-6
        )
        if not glint.std() < LOBES.max_colour * glint.mean():
            return
    # pixels brighter than the broad lobe of the same body, connected to the peak; along a streak the lobe
    # reaches on from pixels that no lean explains
    lobe_here, fit_radius = core, reach + LOBES.around_px
    on_body = (body == surface_body) & np.isfinite(brightness)
    for _ in range(1 + is_mirrored * min(int(core.sum()) // LOBES.growth_px, LOBES.growths)):
        distance = depth_of(~core)
        surface = on_body & (distance > 1.5) & (distance <= fit_radius)
        broad = _broad_lobe(brightness, surface, surface & (distance > max(2.0, 0.5 * reach)), fit_radius)
        if broad is None:
            break
        base, spread = broad
        with np.errstate(invalid="ignore"):
            min_excess = np.maximum(max(LOBES.min_share, LOBES.min_sd * spread) * base, LOBES.floor)
            is_brighter = brightness - base > min_excess
        if is_mirrored and not is_wide:
            is_brighter &= _stands_out(brightness, on_body, distance)
        halo = (distance <= reach) & is_brighter
        others = halo & (body != surface_body) & (distance > 2.5)
        if is_mirrored:  # segments of the lobe itself are their own bodies
            glint = _mirrored_sun(picture, others, larger, surface_body) * picture.light.direct.mean()
            others &= glint <= min_excess
        pieces, _ = label(halo & ~others | lobe_here, np.ones((3, 3)))
        lobe_here = pieces == pieces[peak]
        before, core = core, core | lobe_here & (brightness > LOBES.beyond_lean * base)
        if (core == before).all():
            break
    lobe[larger] |= lobe_here


def _stands_out(brightness: Floats, on_body: Bools, distance: Floats) -> Bools:
    # Whether pixels are brighter than their body beside them (line, column), in any of four directions.
    #
    # Pixels nearer to the core do not count. Where only one side counts, the pixel must be brighter by twice
    # as much: a body that leans to the sun is brighter on one side of the mirrored sun.
    pad = LOBES.beside_px
    rows, columns = brightness.shape
    values = np.pad(np.where(on_body, brightness, -np.inf), pad, constant_values=-np.inf)
    distances = np.pad(distance, pad)
    stands_out = np.zeros(brightness.shape, bool)
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        sides = np.full((2, *brightness.shape), -np.inf)
        for side, sign in zip(sides, (-1, 1), strict=True):
            for step in range(sign, sign * (pad + 1), sign):
                top, left = pad + step * dy, pad + step * dx
                there = slice(top, top + rows), slice(left, left + columns)
                np.maximum(side, np.where(distances[there] >= distance, values[there], -np.inf), out=side)
        count = np.isfinite(sides).sum(axis=0)
        share = np.where(count == 2, LOBES.min_share, 2.0 * LOBES.min_share)
        stands_out |= (count > 0) & (brightness > (1.0 + share) * sides.max(axis=0))
    return stands_out


def _broad_lobe(
    brightness: Floats, surface: Bools, start: Bools, scale: float
) -> tuple[Floats, float] | None:
    # Brightness of a body part without a sharp lobe (line, column), and its relative spread.
    # A surface of second order, fitted to the logarithm in `surface`, at first only in `start`; iterations
    # exclude brighter pixels. None with too few pixels.
    y, x = np.nonzero(surface)
    if y.size < LOBES.min_ring_px:
        return None
    logs, fitted = np.log(np.maximum(brightness[y, x], LOBES.floor)), start[y, x]
    if fitted.sum() < LOBES.min_ring_px:
        fitted = np.ones(y.size, bool)
    centre_y, centre_x = y.mean(), x.mean()

    def terms(y: Array, x: Array) -> Floats:
        u, v = (y - centre_y) / scale, (x - centre_x) / scale
        return np.stack([np.ones(u.shape), u, v, u * u, u * v, v * v], axis=-1)

    design = terms(y, x)
    for _ in range(LOBES.rounds):
        coefficients, *_ = np.linalg.lstsq(design[fitted], logs[fitted], rcond=None)
        residuals = logs - design @ coefficients
        # standard deviation of a normal distribution from the median absolute residual
        spread = 1.4826 * float(np.median(np.abs(residuals[fitted]))) + LOBES.noise
        inliers = (residuals < 2.0 * spread) & (residuals > -3.0 * spread)
        if inliers.sum() < LOBES.min_ring_px or (inliers == fitted).all():
            break
        fitted = inliers
    fit = terms(*np.indices(brightness.shape)) @ coefficients
    return np.exp(np.clip(fit, logs.min(), logs.max())), spread


def _distinguishable(picture: Picture) -> Bools:
    # Bodies on which a wide lobe can be distinguished from flakes (segment,)
    black = np.nan_to_num(picture.reference).mean(axis=1) < LOBES.max_black
    return np.asarray((picture.coloured | black) & ~picture.ground)


def _mirrored_sun(
    picture: Picture, mask: Bools, window: tuple[slice, slice], surface: int | None = None
) -> Floats:
    # Amount of mirrored sun in the pixels of a mask in a window, 0 elsewhere (line, column) [1]; on a body
    # ``surface``, 0 where its spectrum does not fit, or on the body of every pixel.
    glint = np.zeros(mask.shape)
    body: Ints = picture.body(window)[mask].astype(np.int64)
    if surface is not None:
        body[:] = surface
    spectra = picture.channels[window][mask].astype(np.float64)
    amount, misfit, _ = unmix_spectra(
        spectra, body, np.nan_to_num(picture.reference), picture.light, GLINT.tolerance, AS_GLINT
    )
    fits = (misfit < 1.0) | (surface is None)
    glint[mask] = np.where(fits, np.nan_to_num(amount[:, 2]), 0.0)
    return glint


def _add_wide(picture: Picture, level: Floats, core: Bools, window: tuple[slice, slice], lobe: Bools) -> None:
    # Set the pixels of `lobe` around a wide core: connected pixels with mirrored sun
    half_width = _half_width(core)
    if half_width < LOBES.min_wide_px:
        return
    surface_body = int(np.bincount(picture.body(window)[core]).argmax())
    if not picture.coloured[surface_body] and lobe[window][core].any():
        return  # a sharp lobe inside the lobe of flakes
    reach = LOBES.max_wide_px if picture.coloured[surface_body] else 1.5 + LOBES.wide_halo * half_width
    larger = padded(window, int(np.ceil(reach)))
    core = _in_larger_window(core, window, larger, level[larger].shape)
    body = picture.body(larger)
    is_coat = np.append(_distinguishable(picture), False)[body]
    near = is_coat & np.isfinite(level[larger]) & (depth_of(~core) <= reach)
    glint = _mirrored_sun(picture, near, larger) * picture.light.direct.mean()
    paint = np.append(np.nan_to_num(picture.reference).mean(axis=1), 0.0)[body]
    halo = near & (glint > np.maximum(LOBES.min_wide_share * paint, LOBES.floor))
    pieces, _ = label(halo | core, np.ones((3, 3)))
    lobe[larger] |= np.isin(pieces, pieces[core])
