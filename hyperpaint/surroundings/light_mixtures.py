"""Spectra of segments as a body's in the light of sun, sky and one neighbour: least squares, exactly."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Bools, Floats, Ints

from .cells import CELL
from .references import Light

__all__ = ["Mixtures", "in_parts", "mixtures_of", "senders_of", "solve", "without_sun"]


_TOLERANCE, _FLOOR = 0.05, 0.0005
"""What spectra are compared to: relative, and in reflectance [1]."""
_NEIGHBOURS = 6
"""Coloured segments around that may send light."""
_RANKS, _REACH = 4, 60
"""Segments that are kept of a cell, and how far from it they are [pixel]."""
_LEAST_BRIGHT, _LEAST_COLOUR, _LEAST_PIXELS = 0.04, 0.3, 150
"""Of a segment that sends light: mean reflectance [1], standard deviation over channels relative to that, and
pixels."""
_MOST_DIRECT, _MOST_SKY, _MOST_MISFIT = 0.4, 1.1, 0.3
"""Of a segment that may lie in shadow: amounts of direct light and of the sky's, and misfit, at most."""
_TOGETHER = 20_000
"""Pairs that are solved for together, for memory."""


class Mixtures(NamedTuple):
    """Segments as bodies in other light, each with one body.

    Attributes
    ----------
    segment, body : (n,)
        Numbers of segments.
    direct, sky, sent : (n,)
        Amounts c, V and b [1].
    misfit : (n,)
        Root mean square of what remains, relative to what is seen [1].
    """

    segment: Ints
    body: Ints
    direct: Floats
    sky: Floats
    sent: Floats
    misfit: Floats


def without_sun(found: Mixtures) -> Bools:
    """Tell which get so little direct light that, for the sky they see, grey things may send it."""
    return np.asarray(found.direct < 0.02 + 0.2 * np.clip(0.75 - found.sky, 0.0, 1.0))


def mixtures_of(segment: Ints, body: Ints, spectrum: Floats, senders: Ints, light: Light) -> Mixtures:
    r"""Return segments as bodies in little sun, with the neighbour's light that leaves least.

    :math:`\rho_B (c f_{dir} + V f_{dif} + b \rho_n)` with c, V, b not negative; what a neighbour sends comes
    from where the sky is hidden, b < 1 - V. Pairs that cannot be are left out.

    Parameters
    ----------
    segment, body : (n,)
        Pairs to look at.
    spectrum : (segment, channel)
        Reflectance [1].
    senders : (segment, rank)
        Segments that may light one; -1 for none.
    light
        Parts of the irradiance.
    """
    known = np.nan_to_num(spectrum)
    alone = [solve(known[segment[part]], known[body[part]], None, light) for part in in_parts(segment.size)]
    if not alone:
        none = np.empty(0)
        return Mixtures(segment, body, none, none, none, none)
    amount, misfit = (np.concatenate(values) for values in zip(*alone, strict=True))
    possible = (amount[:, 0] < _MOST_DIRECT) & (amount[:, 1] < _MOST_SKY + 0.4) & (misfit < 0.6)
    segment, body, misfit = segment[possible], body[possible], misfit[possible]
    amount = np.pad(amount[possible], ((0, 0), (0, 1)))
    for rank in range(senders.shape[1]):
        sender = senders[segment, rank]
        rows = np.flatnonzero((sender >= 0) & (sender != body))
        for part in in_parts(rows.size):
            here = rows[part]
            more, rest = solve(known[segment[here]], known[body[here]], known[sender[here]], light)
            better = (rest < misfit[here]) & (more[:, 2] < 1.0 - more[:, 1])
            amount[here[better]], misfit[here[better]] = more[better], rest[better]
    fits = (amount[:, 1] < _MOST_SKY) & (misfit < _MOST_MISFIT)
    direct, sky, sent = amount[fits].T
    return Mixtures(segment[fits], body[fits], direct, sky, sent, misfit[fits])


def in_parts(count: int, together: int = _TOGETHER) -> list[slice]:
    """Return slices of some of so many things: what is computed of them at a time."""
    return [slice(first, first + together) for first in range(0, count, together)]


def senders_of(number: npt.NDArray[np.int32], spectrum: Floats, size: Ints) -> npt.NDArray[np.int64]:
    """Return the coloured segments nearest to most of each segment's pixels (segment, rank); -1 for none.

    What grey ones send cannot be told from direct light.
    """
    from hyperpaint.kernels.segmentation import nearest_sources

    level = spectrum.mean(axis=1)
    sends = (level > _LEAST_BRIGHT) & (size >= _LEAST_PIXELS)
    sends &= spectrum.std(axis=1) > _LEAST_COLOUR * level
    centre = number[::CELL, ::CELL]
    labels = np.full((*centre.shape, _RANKS), -1, np.int32)
    labels[..., 0] = np.where(np.append(sends, False)[centre], centre, -1)
    distances = np.full(labels.shape, np.inf)
    distances[..., 0][labels[..., 0] >= 0] = 0.0
    nearest_sources(labels, distances, _REACH / CELL)
    here = np.repeat(centre.ravel().astype(np.int64), _RANKS)
    found = labels.ravel().astype(np.int64)
    pairs, times = np.unique((here * size.size + found)[(here >= 0) & (found >= 0)], return_counts=True)
    one, other = pairs // max(size.size, 1), pairs % max(size.size, 1)
    order = np.lexsort((other, -times, one))
    one, other = one[order], other[order]
    rank = np.arange(one.size) - np.searchsorted(one, one)
    made = np.full((size.size, _NEIGHBOURS), -1, np.int64)
    first = rank < _NEIGHBOURS
    made[one[first], rank[first]] = other[first]
    return made


def solve(seen: Floats, body: Floats, sender: Floats | None, light: Light) -> tuple[Floats, Floats]:
    """Return amounts (n, 2 or 3) that are not negative and relative misfits (n,), of spectra (n, channel).

    The exact minimum: of all sets of parts, that which leaves least without any negative amount.
    """
    sigma = _TOLERANCE * np.abs(seen) + _FLOOR
    parts = [body * light.direct, body * light.diffuse]
    if sender is not None:
        parts.append(body * sender)
    design = np.stack([part / sigma for part in parts], axis=2)
    target = seen / sigma
    gram = np.einsum("nki,nkj->nij", design, design)
    right = np.einsum("nki,nk->ni", design, target)
    square = (target * target).sum(axis=1)
    count, used = right.shape
    best, made = square.copy(), np.zeros((count, used))
    small = 1e-9 * np.trace(gram, axis1=1, axis2=2)[:, None, None]
    for subset in range(1, 2**used):
        which = [part for part in range(used) if subset >> part & 1]
        block = gram[:, which][:, :, which] + small * np.eye(len(which))
        amount = np.linalg.solve(block, right[:, which, None])[..., 0]
        cost = square - (amount * right[:, which]).sum(axis=1)
        better = (amount >= 0).all(axis=1) & (cost < best)
        best[better] = cost[better]
        made[better] = 0.0
        made[np.flatnonzero(better)[:, None], which] = amount[better]
    return made, np.sqrt(np.maximum(best, 0.0) / seen.shape[1]) * _TOLERANCE
