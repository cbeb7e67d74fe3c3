"""Mirror images of the sun in clear coats and glass: the pixels inside one.

A glossy coat reflects the sun's light into a few degrees: on a body part, into a spot much brighter than its
surroundings. Flakes in a paint, and leaning body parts, are brighter over the whole part, without such a
spot.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Array, Bools, Floats, Floats32, Ints

from .detection_rules import GLINT, LOBES
from .full_light import AS_GLINT, Light, unmix_spectra
from .scratch import line_parts, release, scratch_array

#: Pixel in a mirror image of the sun; and saturated pixel in one. 0 elsewhere.
IN_LOBE, SATURATED_IN_LOBE = 1, 2

#: Pixels three steps around one.
_RING = (
    (-3, -1), (-3, 0), (-3, 1), (-2, 2), (-1, 3), (0, 3), (1, 3), (2, 2),
    (3, 1), (3, 0), (3, -1), (2, -2), (1, -3), (0, -3), (-1, -3), (-2, -2),
)  # fmt: skip
_MARGIN, _LINES = 3, 128
#: Minimum number of ring pixels darker than its median allows; index of its third lowest.
_DARKER, _LOWEST = 9, 2


class Shown:
    """Body of every pixel, looked up on demand to save memory."""

    def __init__(self, number: npt.NDArray[np.int32], body: npt.NDArray[np.int32]) -> None:
        self._number, self._body = number, np.append(body, np.int32(-1))

    def __getitem__(self, where: Any) -> npt.NDArray[np.int32]:
        return np.asarray(self._body[self._number[where]])


class Picture(NamedTuple):
    """A flight line prepared for the search of lobes."""

    channels: Floats32  #: (line, column, channel): Reflectance [1].
    saturated: Bools  #: (line, column): Whether a sample is saturated.
    body: Shown  #: (line, column): Body of every pixel; -1 without data.
    ground: Bools  #: (segment,): Bodies without a coat.
    reference: Floats  #: (segment, channel): Reflectance of bodies in full light [1].
    coloured: Bools  #: (segment,): Bodies whose colour differs from the mirrored sun's.
    light: Light


def mirror_lobes(picture: Picture) -> npt.NDArray[np.uint8]:
    r"""Return the pixels that lie in a mirror image of the sun (line, column).

    0 outside, `IN_LOBE` or `SATURATED_IN_LOBE`. A lobe has a core. A sharp core is several times brighter
    than the pixels three steps around it, which show one surface in even light, and its excess has the colour
    of direct light. Pixels around it that exceed a surface :math:`\ln \rho` of second order through its
    surroundings, including flakes' broad lobe, by 4 %, belong to it. A wide core, of a worn coat, is as
    bright as a white surface in the sun over several pixels; it can be distinguished from flakes on coloured
    paint and on black.
    """
    level = scratch_array(picture.saturated.shape, np.float64)
    on_coat = np.empty(level.shape, bool)
    coated = ~np.append(picture.ground, True)
    for part, seen in line_parts(picture.channels):
        saturated, body = picture.saturated[part], picture.body[part]
        level[part] = np.where(saturated, np.nan, seen.mean(axis=2, dtype=np.float64))
        on_coat[part] = (body >= 0) & coated[body] | saturated
        release(level)
    spots = list(_components(picture.saturated))
    for spot, window in spots:
        if _half_width(spot) <= LOBES.max_spot_px:
            level[window][spot] = np.inf
    lobe = np.zeros(level.shape, bool)
    for core, window in _components(_sharp(level, on_coat)):
        _add_sharp(picture, level, core, window, lobe)
        release(picture.channels)
        release(level)
    for core, window in _components(_wide(picture, level, on_coat)):
        _add_wide(picture, level, core, window, lobe)
        release(picture.channels)
        release(level)
    layer = np.where(lobe, np.uint8(IN_LOBE), np.uint8(0))
    for spot, window in spots:
        rim = _distance(spot) < 1.5
        rim &= ~spot & ~picture.saturated[window] & (picture.body[window] >= 0)
        if (rim.any() and lobe[window][rim].mean() > LOBES.min_rim) or lobe[window][spot].any():
            layer[window][spot] = SATURATED_IN_LOBE
    return layer


def _components(chosen: Bools, pad: int = 2) -> Iterator[tuple[Bools, tuple[slice, slice]]]:
    from scipy.ndimage import find_objects, label

    pieces, _ = label(chosen, np.ones((3, 3)))
    for number, place in enumerate(find_objects(pieces), 1):
        window = padded(place, pad)
        yield pieces[window] == number, window


def padded(window: tuple[slice, ...], pad: int) -> tuple[slice, slice]:
    """Return a window that is some pixels wider on all sides."""
    rows, columns = (slice(max(part.start - pad, 0), part.stop + pad) for part in window)
    return rows, columns


def _placed(
    core: Bools, window: tuple[slice, slice], wide: tuple[slice, slice], shape: tuple[int, ...]
) -> Bools:
    inside = np.zeros(shape, bool)
    top, left = (part.start - other.start for part, other in zip(window, wide, strict=True))
    inside[top : top + core.shape[0], left : left + core.shape[1]] = core
    return inside


def _distance(chosen: Bools) -> Floats:
    # Distance of every pixel from a chosen one [pixel]
    from scipy.ndimage import distance_transform_edt

    return np.asarray(distance_transform_edt(~chosen))


def _half_width(core: Bools) -> float:
    # Largest distance of a core's pixels from its outside [pixel]
    return float(_distance(~np.pad(core, 1)).max())


def _sharp(level: Floats, on_coat: Bools) -> Bools:
    # Pixels that stand out from evenly bright surroundings (line, column)
    is_sharp = np.zeros(level.shape, bool)
    lines, columns = level.shape
    for first in range(0, lines, _LINES):
        here = level[first : first + _LINES]
        below = here / LOBES.min_contrast
        darker = np.zeros(here.shape, np.int8)
        # edge pixels are repeated beyond the edges
        rows = np.clip(np.arange(first - _MARGIN, first + len(here) + _MARGIN), 0, lines - 1)
        padded = np.pad(level[rows], ((0, 0), (_MARGIN, _MARGIN)), mode="edge")
        for down, right in _RING:
            top, left = _MARGIN + down, _MARGIN + right
            darker += padded[top : top + len(here), left : left + columns] < below
        is_sharp[first : first + _LINES] = darker >= _DARKER
        release(level)
    y, x = np.nonzero(is_sharp & on_coat)
    around = np.sort(
        [level[np.clip(y + down, 0, lines - 1), np.clip(x + right, 0, columns - 1)] for down, right in _RING],
        axis=0,
    )
    middle = 0.5 * (around[len(_RING) // 2 - 1] + around[len(_RING) // 2])
    fits = (level[y, x] > LOBES.min_contrast * middle) & (around[_LOWEST] > LOBES.min_evenness * middle)
    fits &= level[y, x] - middle > LOBES.min_excess
    is_sharp[:] = False
    is_sharp[y[fits], x[fits]] = True
    return is_sharp


def _add_sharp(
    picture: Picture, level: Floats, core: Bools, window: tuple[slice, slice], lobe: Bools
) -> None:
    # Set the pixels of `lobe` that belong to a sharp core, if it mirrors the sun
    from scipy.ndimage import label

    reach = LOBES.halo_px + LOBES.sharp_halo * _half_width(core)
    if reach > LOBES.max_sharp_px:
        return
    wide = padded(window, int(np.ceil(reach)) + LOBES.around_px)
    seen, body = level[wide], picture.body[wide]
    core = _placed(core, window, wide, seen.shape)
    far = _distance(core)
    surface_body = _body_around(body, (far > 2.5) & (far <= 4.5))
    if surface_body < 0 or picture.ground[surface_body]:
        return
    peak = np.unravel_index(np.argmax(np.where(core, seen, -np.inf)), core.shape)
    around = picture.channels[wide][(body == surface_body) & (far > 2.5) & (far <= 4.5)].astype(np.float64)
    if np.isfinite(seen[peak]):
        added = (picture.channels[wide][peak] - np.nanmedian(around, axis=0)) / np.maximum(
            picture.light.direct, 1e-6
        )
        if not added.std() < LOBES.max_colour * added.mean():
            return
    surface = (body == surface_body) & np.isfinite(seen) & (far > 1.5) & (far <= reach + LOBES.around_px)
    broad = _broad(seen, surface, surface & (far > max(2.0, 0.5 * reach)), reach + LOBES.around_px)
    if broad is None:
        lobe[wide] |= core
        return
    base, spread = broad
    with np.errstate(invalid="ignore"):
        more = seen - base > np.maximum(max(LOBES.min_share, LOBES.min_sd * spread) * base, LOBES.floor)
    halo = ((body == surface_body) | (far <= 2.5)) & (far <= reach) & more
    pieces, _ = label(halo | core, np.ones((3, 3)))
    lobe[wide] |= pieces == pieces[peak]


def _body_around(body: npt.NDArray[np.int32], ring: Bools) -> int:
    numbers, count = np.unique(body[ring & (body >= 0)], return_counts=True)
    if count.sum() < LOBES.min_ring_px or count.max() < LOBES.min_ring_share * count.sum():
        return -1
    return int(numbers[np.argmax(count)])


def _broad(seen: Floats, surface: Bools, start: Bools, scale: float) -> tuple[Floats, float] | None:
    # Brightness of a body part without a lobe (line, column), and its relative spread.
    # A surface of second order through the logarithm; brighter pixels are left out iteratively.
    y, x = np.nonzero(surface)
    if y.size < LOBES.min_ring_px:
        return None
    value, retained = np.log(np.maximum(seen[y, x], LOBES.floor)), start[y, x]
    if retained.sum() < LOBES.min_ring_px:
        retained = np.ones(y.size, bool)
    middle = y.mean(), x.mean()

    def terms(down: Array, right: Array) -> Floats:
        u, v = (down - middle[0]) / scale, (right - middle[1]) / scale
        return np.stack([np.ones(u.shape), u, v, u * u, u * v, v * v], axis=-1)

    design = terms(y, x)
    for _ in range(LOBES.rounds):
        shape, *_ = np.linalg.lstsq(design[retained], value[retained], rcond=None)
        rest = value - design @ shape
        spread = 1.4826 * float(np.median(np.abs(rest[retained]))) + LOBES.noise
        again = (rest < 2.0 * spread) & (rest > -3.0 * spread)
        if again.sum() < LOBES.min_ring_px or (again == retained).all():
            break
        retained = again
    whole = terms(*np.indices(seen.shape)) @ shape
    return np.exp(np.clip(whole, value.min(), value.max())), spread


def _distinct(picture: Picture) -> Bools:
    # Bodies on which a wide lobe can be distinguished from flakes (segment,)
    black = np.nan_to_num(picture.reference).mean(axis=1) < LOBES.max_black
    return np.asarray((picture.coloured | black) & ~picture.ground)


def _glint(picture: Picture, where: Bools, window: tuple[slice, slice]) -> Floats:
    # Mirrored sun in some pixels of a window, 0 elsewhere (line, column) [1]
    glint = np.zeros(where.shape)
    body: Ints = picture.body[window][where].astype(np.int64)
    seen = picture.channels[window][where].astype(np.float64)
    amount, _, _ = unmix_spectra(
        seen, body, np.nan_to_num(picture.reference), picture.light, GLINT.tolerance, AS_GLINT
    )
    glint[where] = np.nan_to_num(amount[:, 2])
    return glint


def _wide(picture: Picture, level: Floats, on_coat: Bools) -> Bools:
    # Pixels where the mirrored sun is as bright as a white surface (line, column)
    distinct = np.append(_distinct(picture), False)
    wide = np.zeros(level.shape, bool)
    for part, here in line_parts(level):
        asked = distinct[picture.body[part]] & on_coat[part] & np.isfinite(here)
        asked &= here > LOBES.min_wide_glint * picture.light.direct.mean()
        glint = _glint(picture, asked, (part, slice(0, level.shape[1])))
        wide[part] = glint >= LOBES.min_wide_glint
        release(picture.channels)
    return wide


def _add_wide(picture: Picture, level: Floats, core: Bools, window: tuple[slice, slice], lobe: Bools) -> None:
    from scipy.ndimage import label

    width = _half_width(core)
    if width < LOBES.min_wide_px:
        return
    surface_body = int(np.bincount(picture.body[window][core]).argmax())
    if not picture.coloured[surface_body] and lobe[window][core].any():
        return  # a sharp lobe inside the lobe of flakes
    reach = LOBES.max_wide_px if picture.coloured[surface_body] else 1.5 + LOBES.wide_halo * width
    wide = padded(window, int(np.ceil(reach)))
    inside = _placed(core, window, wide, level[wide].shape)
    body = picture.body[wide]
    asked = np.append(_distinct(picture), False)[body] & np.isfinite(level[wide])
    asked &= _distance(inside) <= reach
    added = _glint(picture, asked, wide) * picture.light.direct.mean()
    paint = np.append(np.nan_to_num(picture.reference).mean(axis=1), 0.0)[body]
    halo = asked & (added > np.maximum(LOBES.min_wide_share * paint, LOBES.floor))
    pieces, _ = label(halo | inside, np.ones((3, 3)))
    numbers = np.unique(pieces[inside])
    lobe[wide] |= np.isin(pieces, numbers[numbers > 0])
