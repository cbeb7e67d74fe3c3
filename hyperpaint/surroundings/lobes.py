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
from .scratch import line_blocks, release, scratch_array

#: Values of a lobe layer: pixels in a mirror image of the sun, and saturated pixels in one; 0 elsewhere.
IN_LOBE, SATURATED_IN_LOBE = 1, 2

#: Steps (line, column) to the ring of pixels three steps around a pixel.
_RING = (
    (-3, -1), (-3, 0), (-3, 1), (-2, 2), (-1, 3), (0, 3), (1, 3), (2, 2),
    (3, 1), (3, 0), (3, -1), (2, -2), (1, -3), (0, -3), (-1, -3), (-2, -2),
)  # fmt: skip
#: Radius of the ring [pixel]; number of lines processed together.
_RADIUS, _LINES = 3, 128
#: Number of darker ring pixels with which the median of the ring is darker; index of the third darkest pixel.
_MIN_DARKER, _THIRD_DARKEST = 9, 2


class PixelBodies:
    """Body of every pixel (line, column), looked up by index to save memory."""

    def __init__(self, number: npt.NDArray[np.int32], body: npt.NDArray[np.int32]) -> None:
        self._number, self._body = number, np.append(body, np.int32(-1))

    def __getitem__(self, index: Any) -> npt.NDArray[np.int32]:
        return np.asarray(self._body[self._number[index]])


class Picture(NamedTuple):
    """A flight line prepared for the search of lobes."""

    channels: Floats32  #: (line, column, channel): Reflectance [1].
    saturated: Bools  #: (line, column): Whether a sample is saturated.
    body: PixelBodies  #: (line, column): Body of every pixel; -1 without data.
    ground: Bools  #: (segment,): Bodies without a coat.
    reference: Floats  #: (segment, channel): Reflectance of bodies in full light [1].
    coloured: Bools  #: (segment,): Bodies whose colour differs from the mirrored sun's.
    light: Light


def mirror_lobes(picture: Picture) -> npt.NDArray[np.uint8]:
    r"""Return the pixels that lie in a mirror image of the sun (line, column).

    0 outside, `IN_LOBE` or `SATURATED_IN_LOBE`. A lobe has a sharp or a wide core.

    A sharp core is several times brighter than the ring of pixels three steps around it, the ring shows one
    surface in even light, and the excess of the core has the colour of direct light. Its lobe consists of the
    pixels around it that are 4 % brighter than a surface of second order, fitted to :math:`\ln \rho` of the
    surroundings. This surface includes the broad lobe of flakes.

    A wide core, of a worn coat, is as bright as a white surface in the sun over several pixels. It can be
    distinguished from flakes on coloured paint and on black paint.
    """
    level = scratch_array(picture.saturated.shape, np.float64)
    on_coat = np.empty(level.shape, bool)
    coated = ~np.append(picture.ground, True)
    for lines, block in line_blocks(picture.channels):
        saturated, body = picture.saturated[lines], picture.body[lines]
        level[lines] = np.where(saturated, np.nan, block.mean(axis=2, dtype=np.float64))
        on_coat[lines] = (body >= 0) & coated[body] | saturated
        release(level)
    spots = list(_components(picture.saturated))
    for spot, window in spots:
        if _half_width(spot) <= LOBES.max_spot_px:
            level[window][spot] = np.inf
    lobe = np.zeros(level.shape, bool)
    for core, window in _components(_sharp_cores(level, on_coat)):
        _add_sharp(picture, level, core, window, lobe)
        release(picture.channels)
        release(level)
    for core, window in _components(_wide_cores(picture, level, on_coat)):
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


def _components(mask: Bools, pad: int = 2) -> Iterator[tuple[Bools, tuple[slice, slice]]]:
    # Yield the connected sets of a mask, each as a mask in its window, with the window
    from scipy.ndimage import find_objects, label

    pieces, _ = label(mask, np.ones((3, 3)))
    for number, box in enumerate(find_objects(pieces), 1):
        window = padded(box, pad)
        yield pieces[window] == number, window


def padded(window: tuple[slice, ...], pad: int) -> tuple[slice, slice]:
    """Return a window that is some pixels wider on all sides."""
    rows, columns = (slice(max(axis.start - pad, 0), axis.stop + pad) for axis in window)
    return rows, columns


def _in_larger_window(
    core: Bools, window: tuple[slice, slice], larger: tuple[slice, slice], shape: tuple[int, ...]
) -> Bools:
    inside = np.zeros(shape, bool)
    top, left = (inner.start - outer.start for inner, outer in zip(window, larger, strict=True))
    inside[top : top + core.shape[0], left : left + core.shape[1]] = core
    return inside


def _distance(mask: Bools) -> Floats:
    # Distance of every pixel from the nearest pixel of a mask [pixel]
    from scipy.ndimage import distance_transform_edt

    return np.asarray(distance_transform_edt(~mask))


def _half_width(core: Bools) -> float:
    # Maximum distance of a pixel of a core from the core's outside [pixel]
    return float(_distance(~np.pad(core, 1)).max())


def _sharp_cores(level: Floats, on_coat: Bools) -> Bools:
    # Pixels much brighter than evenly bright surroundings (line, column).
    # First, in blocks of lines, pixels for which most of the ring is darker than the contrast demands.
    is_sharp = np.zeros(level.shape, bool)
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
        release(level)
    # then the exact conditions for these few pixels
    y, x = np.nonzero(is_sharp & on_coat)
    ring = np.sort(
        [level[np.clip(y + dy, 0, lines - 1), np.clip(x + dx, 0, columns - 1)] for dy, dx in _RING], axis=0
    )
    median = 0.5 * (ring[len(_RING) // 2 - 1] + ring[len(_RING) // 2])
    fits = (level[y, x] > LOBES.min_contrast * median) & (ring[_THIRD_DARKEST] > LOBES.min_evenness * median)
    fits &= level[y, x] - median > LOBES.min_excess
    is_sharp[:] = False
    is_sharp[y[fits], x[fits]] = True
    return is_sharp


def _add_sharp(
    picture: Picture, level: Floats, core: Bools, window: tuple[slice, slice], lobe: Bools
) -> None:
    # Set the pixels of `lobe` around a sharp core, if the core mirrors the sun
    from scipy.ndimage import label

    reach = LOBES.halo_px + LOBES.sharp_halo * _half_width(core)
    if reach > LOBES.max_sharp_px:
        return
    larger = padded(window, int(np.ceil(reach)) + LOBES.around_px)
    brightness, body = level[larger], picture.body[larger]
    core = _in_larger_window(core, window, larger, brightness.shape)
    distance = _distance(core)
    ring = (distance > 2.5) & (distance <= 4.5)
    surface_body = _main_body(body, ring)
    if surface_body < 0 or picture.ground[surface_body]:
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
    # pixels brighter than the broad lobe of the same body, connected to the peak
    fit_radius = reach + LOBES.around_px
    surface = (body == surface_body) & np.isfinite(brightness) & (distance > 1.5) & (distance <= fit_radius)
    broad = _broad_lobe(brightness, surface, surface & (distance > max(2.0, 0.5 * reach)), fit_radius)
    if broad is None:
        lobe[larger] |= core
        return
    base, spread = broad
    with np.errstate(invalid="ignore"):
        min_excess = np.maximum(max(LOBES.min_share, LOBES.min_sd * spread) * base, LOBES.floor)
        is_brighter = brightness - base > min_excess
    halo = ((body == surface_body) | (distance <= 2.5)) & (distance <= reach) & is_brighter
    pieces, _ = label(halo | core, np.ones((3, 3)))
    lobe[larger] |= pieces == pieces[peak]


def _main_body(body: npt.NDArray[np.int32], ring: Bools) -> int:
    # Body with most pixels of a ring; -1 where no body has enough of them
    numbers, count = np.unique(body[ring & (body >= 0)], return_counts=True)
    if count.sum() < LOBES.min_ring_px or count.max() < LOBES.min_ring_share * count.sum():
        return -1
    return int(numbers[np.argmax(count)])


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


def _mirrored_sun(picture: Picture, mask: Bools, window: tuple[slice, slice]) -> Floats:
    # Amount of mirrored sun in the pixels of a mask in a window, 0 elsewhere (line, column) [1]
    glint = np.zeros(mask.shape)
    body: Ints = picture.body[window][mask].astype(np.int64)
    spectra = picture.channels[window][mask].astype(np.float64)
    amount, _, _ = unmix_spectra(
        spectra, body, np.nan_to_num(picture.reference), picture.light, GLINT.tolerance, AS_GLINT
    )
    glint[mask] = np.nan_to_num(amount[:, 2])
    return glint


def _wide_cores(picture: Picture, level: Floats, on_coat: Bools) -> Bools:
    # Pixels where the mirrored sun is as bright as a white surface (line, column)
    distinguishable = np.append(_distinguishable(picture), False)
    is_wide = np.zeros(level.shape, bool)
    for lines, block in line_blocks(level):
        bright = distinguishable[picture.body[lines]] & on_coat[lines] & np.isfinite(block)
        bright &= block > LOBES.min_wide_glint * picture.light.direct.mean()
        glint = _mirrored_sun(picture, bright, (lines, slice(0, level.shape[1])))
        is_wide[lines] = glint >= LOBES.min_wide_glint
        release(picture.channels)
    return is_wide


def _add_wide(picture: Picture, level: Floats, core: Bools, window: tuple[slice, slice], lobe: Bools) -> None:
    # Set the pixels of `lobe` around a wide core: connected pixels with mirrored sun
    from scipy.ndimage import label

    half_width = _half_width(core)
    if half_width < LOBES.min_wide_px:
        return
    surface_body = int(np.bincount(picture.body[window][core]).argmax())
    if not picture.coloured[surface_body] and lobe[window][core].any():
        return  # a sharp lobe inside the lobe of flakes
    reach = LOBES.max_wide_px if picture.coloured[surface_body] else 1.5 + LOBES.wide_halo * half_width
    larger = padded(window, int(np.ceil(reach)))
    core = _in_larger_window(core, window, larger, level[larger].shape)
    body = picture.body[larger]
    near = np.append(_distinguishable(picture), False)[body] & np.isfinite(level[larger])
    near &= _distance(core) <= reach
    glint = _mirrored_sun(picture, near, larger) * picture.light.direct.mean()
    paint = np.append(np.nan_to_num(picture.reference).mean(axis=1), 0.0)[body]
    halo = near & (glint > np.maximum(LOBES.min_wide_share * paint, LOBES.floor))
    pieces, _ = label(halo | core, np.ones((3, 3)))
    numbers = np.unique(pieces[core])
    lobe[larger] |= np.isin(pieces, numbers[numbers > 0])
