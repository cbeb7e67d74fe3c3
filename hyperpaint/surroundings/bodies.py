"""Bodies in full light: coloured bodies that light others, and reference spectra without glint."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.sparse

from hyperpaint.base.arrays import Bools, Floats, Floats32, Ints

from .detection_rules import BODIES, GLINT
from .full_light import AS_GLINT, Light, Matches, unmix_spectra
from .model import CELL, LIT
from .scratch import gather
from .segments import Touching, beyond, distinct_pairs


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
