"""Cars: the footprint around a piece of paint, its roof, the pieces of one car, and the part proposed.

A piece is a connected part of one body, with its measures, its light and its lean.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product
from typing import Any, NamedTuple

import dask
import numpy as np
import xarray as xr
from scipy.ndimage import (
    binary_closing,
    binary_fill_holes,
    binary_opening,
    distance_transform_edt,
    find_objects,
    label,
    map_coordinates,
    minimum,
    uniform_filter,
)
from scipy.spatial import ConvexHull

from hyperpaint.base import ALONG_TRACK, BAND, CROSS_TRACK, IRRADIANCE_TIME, Array, Bools, Floats, Quality
from hyperpaint.light.coat_transmission import interface_reflectance
from hyperpaint.light.sun import diffuse_fraction
from hyperpaint.surroundings import SceneModel
from hyperpaint.surroundings.corrections import MAX_SUN_ZENITH_DEG, split_of
from hyperpaint.surroundings.model import SHADED
from hyperpaint.surroundings.segments import padded
from hyperpaint.surroundings.surveying import is_vegetation

from .proposal_rules import CARS, FINISHES, FOOTPRINTS, GAPS, JUDGING, LEANS, LEVELS, ROOFS, SURFACES

#: Flags of pixels without a valid spectrum.
_INVALID = Quality.SATURATED | Quality.IRRADIANCE_GAP | Quality.NO_DATA | Quality.OFF_SWATH


#: Limits for the pixels of a region, by the names of the arguments of `propose_regions`.
Limits = Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Picture:
    """A flight line prepared for proposals."""

    model: SceneModel  #: Its scene model.
    channels: Array  #: (line, column, channel): Reflectance in the model's channels [1].
    #: ``glint_fraction``, ``blocked_direct``, ``adjacency`` and ``quality`` (line, column).
    layers: Mapping[str, Array]
    zenith: float | None  #: Zenith angle of the sun [degree]; None where unknown.
    shadow_side: Floats | None = None  #: (2,): Direction (line, column) of shadows; None where unknown.
    #: Height of the surface in every pixel (line, column) [m], and the distance between pixels [m].
    heights: tuple[Array, float] | None = None
    #: Free sun between clouds, see `sunny_lines`; None where clouds were not broken.
    sun: tuple[Bools, float] | None = None

    @cached_property
    def sky(self) -> Array:
        # Sky mirrored by a level clear coat, in reflectance (channel,), float32 [1].
        model = self.model
        return (FOOTPRINTS.mirrored * model.diffuse_fraction * model.zenith_radiance).astype(np.float32)

    @cached_property
    def direct_share(self) -> float:
        # Direct part of the light on level ground, mean over the channels [1].
        return 1.0 - float(self.model.diffuse_fraction.mean())

    @cached_property
    def level(self) -> Array:
        # Mean reflectance over the channels (line, column) [1].
        return np.asarray(self.channels.mean(axis=2))

    @cached_property
    def ground(self) -> Floats:
        # Reflectance of the ground, the largest body (channel,) [1].
        return np.asarray(np.nan_to_num(self.model.reference[largest_body(self.model)]))

    def without_sky(self, window: tuple[slice, slice]) -> Floats:
        # Return the reflectance in a window of the picture, less the mirrored sky [1].
        return np.asarray(self.channels[window] - self.sky, np.float64)


def largest_body(model: SceneModel) -> int:
    # Return the number of the body with most pixels, which is assumed to be the ground.
    return int(np.argmax(np.bincount(model.body, weights=model.size, minlength=model.segments)))


def window_of(origin: tuple[int, int], mask: Bools) -> tuple[slice, slice]:
    # Return the window of a mask in the picture, from the line and column of its first pixel.
    (y, x), (lines, columns) = origin, mask.shape
    return slice(y, y + lines), slice(x, x + columns)


class Piece(NamedTuple):
    # A connected part of a body, away from other bodies.
    body: int  #: Segment of the scene model.
    origin: tuple[int, int]  #: Line and column of the first pixel of ``inside``.
    inside: Bools  #: (line, column): Its pixels.

    @property
    def window(self) -> tuple[slice, slice]:
        # Window of the piece in the picture.
        return window_of(self.origin, self.inside)

    @property
    def centre(self) -> Floats:
        # Line and column of its centre, (2,).
        return np.asarray(np.argwhere(self.inside).mean(axis=0) + np.array(self.origin, np.float64))


class Measures(NamedTuple):
    # Measures of a piece.
    usable: Bools  #: (line, column): Largest connected set of pixels within the limits.
    spectrum: Floats  #: (channel,): Median over the usable pixels [1].
    lost: Mapping[str, float]  #: Excluded share of the piece, by reason.
    pixels: int = 0  #: Number of usable pixels; without any, the measures are NaN.
    angle: float = np.nan  #: Median spectral angle to the median spectrum [degree].
    spread: float = np.nan  #: Half the range of relative brightness from the 5th to the 95th percentile [1].
    slope: float = np.nan  #: Median change of relative brightness between neighbouring pixels [1].
    #: Means over the usable pixels [1].
    glint: float = np.nan
    shadow: float = np.nan
    adjacency: float = np.nan


def pieces(model: SceneModel, erode: int, min_pixels: int) -> Iterator[tuple[Piece, bool]]:
    # Yield connected parts of bodies that may be painted, and whether they have the spectrum of leaves.
    #
    # Parts have at least ``min_pixels`` pixels, and come in the order of bodies and lines. Pixels in shade or
    # within ``erode`` pixels of an edge belong to no part; dark bodies and the ground have none.
    spectrum, reference = np.nan_to_num(model.spectrum), np.nan_to_num(model.reference)
    # ground: the largest body, and segments with its spectrum
    largest = largest_body(model)
    lengths = np.linalg.norm(reference, axis=1, keepdims=True)
    direction = reference / np.maximum(lengths, 1e-9)
    relative_length = lengths[:, 0] / max(float(lengths[largest, 0]), 1e-9)
    has_ground_spectrum = (direction @ direction[largest] > SURFACES.min_ground_cosine) & (
        np.abs(np.log(np.maximum(relative_length, 1e-9))) < SURFACES.max_ground_log_ratio
    )
    is_ground = has_ground_spectrum | (model.body == largest)
    is_painted = ~is_ground & ~(spectrum.mean(axis=1) < SURFACES.min_level)
    leaves = is_vegetation(model.spectrum, model.channel_wavelength)
    body = np.append(model.body, np.int32(-1))[model.segment]
    shaded = np.append(model.state == SHADED, False)[model.segment]
    # numbers from 1 on, as scipy.ndimage expects them
    labels = np.where((model.edge_distance > erode) & ~shaded & (body >= 0), body + 1, 0)
    is_large = np.bincount(labels.ravel(), minlength=model.segments + 1) >= min_pixels
    for number, window in enumerate(find_objects(labels, max_label=model.segments)):
        if window is None or not is_large[number + 1] or not is_painted[number]:
            continue
        piece_labels, count = label(labels[window] == number + 1)
        for piece_label, inner in zip(range(1, count + 1), find_objects(piece_labels), strict=True):
            mask = piece_labels[inner] == piece_label
            if mask.sum() >= min_pixels:
                y, x = (int(a.start + b.start) for a, b in zip(window, inner, strict=True))
                yield Piece(number, (y, x), mask), bool(leaves[number])


def measured(piece: Piece, picture: Picture, limits: Limits, brightness: Floats | None = None) -> Measures:
    # Return the measures of a piece, with the pixels that a region can use.
    #
    # ``brightness`` (line, column): brightness in the piece's window, relative to the level part [1]; by
    # default computed here, relative to its median.
    layers = {name: layer[piece.window] for name, layer in picture.layers.items()}
    spectra = picture.channels[piece.window].astype(np.float64)
    inside = piece.inside & np.isfinite(spectra).all(axis=2)
    excluded: dict[str, Bools] = {
        "without data": ~inside,
        "flagged invalid": (layers["quality"] & np.uint16(_INVALID)) != 0,
        "glint": ~(layers["glint_fraction"] <= limits["glint"]),
        "shadow": ~(layers["blocked_direct"] < limits["shadow"]),
        "adjacency": ~(_smoothed(layers["adjacency"], inside) <= limits["adjacency"]),
    }
    lit = inside & ~excluded["shadow"]
    lit_spectrum = np.median(spectra[lit], axis=0) if lit.any() else np.full(spectra.shape[2], np.nan)
    if brightness is not None or not lit.any():
        brightness = _smoothed(np.full(lit.shape, np.nan) if brightness is None else brightness, lit)
    else:
        scaled = lit_spectrum / max(float(lit_spectrum @ lit_spectrum), 1e-12)
        brightness = _smoothed(spectra @ scaled, lit)
        brightness = brightness / float(np.median(brightness[lit]))
    # on dark paint a tilt changes reflectance by little, and noise exceeds a relative limit
    allowed = max(limits["brightness"], SURFACES.min_change / max(float(lit_spectrum.max()), 1e-6))
    excluded["another tilt"] = ~(np.abs(brightness - 1.0) <= allowed)
    usable = piece.inside.copy()
    lost = {}
    for reason, mask in excluded.items():
        lost[reason] = float((usable & mask).sum() / piece.inside.sum())
        usable &= ~mask
    # largest connected set of pixels, without parts narrower than three pixels
    sets, _ = label(binary_opening(usable, np.ones((3, 3), bool)))
    usable = np.asarray(sets == 1 + int(np.argmax(np.bincount(sets.ravel(), minlength=2)[1:])))
    lost = {name: share for name, share in lost.items() if share}
    if not usable.any():
        return Measures(usable, np.full(spectra.shape[2], np.nan), lost)
    values = spectra[usable]
    median_spectrum = np.median(values, axis=0)
    length = np.linalg.norm(values, axis=1) * np.linalg.norm(median_spectrum)
    angles = np.degrees(np.arccos(np.clip(values @ median_spectrum / np.maximum(length, 1e-12), -1.0, 1.0)))
    low, high = np.quantile(brightness[usable], [0.05, 0.95])
    # steps between neighbouring pixels along both axes
    pairs = (usable[1:] & usable[:-1], usable[:, 1:] & usable[:, :-1])
    steps = np.concatenate([np.abs(np.diff(brightness, axis=axis))[pairs[axis]] for axis in (0, 1)])
    return Measures(
        usable,
        median_spectrum,
        lost,
        pixels=int(usable.sum()),
        angle=float(np.median(angles)),
        spread=0.5 * float(high - low),
        slope=float(np.median(steps)) if steps.size else 0.0,
        glint=float(layers["glint_fraction"][usable].mean()),
        shadow=float(layers["blocked_direct"][usable].mean()),
        adjacency=float(layers["adjacency"][usable].mean()),
    )


def _smoothed(values: Array, valid: Bools) -> Floats:
    # Mean of the valid values in the square around every pixel (line, column); NaN without valid values
    valid = valid & np.isfinite(values)
    total, count = (
        uniform_filter(array.astype(np.float64), SURFACES.square_px, mode="constant")
        for array in (np.where(valid, values, 0.0), valid)
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(valid, total / count, np.nan)


# --- free sun under broken clouds, from the irradiance record and from a shadow beside a car ---------------


def sunny_lines(
    line: xr.Dataset, model: SceneModel, diffuse: Any, zenith: float | None
) -> tuple[Bools, float] | None:
    # Return the lines with free sun by the irradiance record, and the diffuse fraction of their infrared.
    #
    # (line,) and [1], NaN where no line had free sun; None where clouds were not broken.
    if "broken" not in str(model.attrs.get("sky_states", "")).split():
        return None
    no_sun = np.zeros(line.sizes[ALONG_TRACK], bool), np.nan
    if zenith is None or not {"irradiance", "time", IRRADIANCE_TIME} <= set(line.variables):
        return no_sun
    nm = line["wavelength"].values.astype(np.float64)
    infrared = np.flatnonzero(nm >= min(GAPS.infrared_nm, float(nm.max())))
    fraction = split_of(line, diffuse, zenith, from_shadow=True).fraction
    if ALONG_TRACK not in fraction.dims:
        return no_sun
    record = line["irradiance"]
    # NaN where a channel is missing: means over fewer channels do not compare
    level = record.mean([dim for dim in record.dims if dim != IRRADIANCE_TIME], skipna=False).values
    if not np.nanmin(level) < GAPS.max_dip * np.nanmax(level):
        return no_sun
    infrared_fraction = fraction.isel({BAND: infrared}).mean(BAND).values
    clear = float(diffuse_fraction(nm[infrared], zenith).mean())
    free = np.asarray(infrared_fraction < clear + GAPS.max_above_clear)
    if not free.any():
        return no_sun
    # free sun in all samples of the record from `around_s` before a line to `around_s` after it
    time, stamps = (
        line[name].values.astype("datetime64[ns]").astype(np.int64) for name in ("time", IRRADIANCE_TIME)
    )
    has_level = np.isfinite(level)
    stamps, level = stamps[has_level], level[has_level]
    dimmed = stamps[level <= GAPS.min_of_free * np.median(np.interp(time[free], stamps, level))]
    # time to the nearest dimmed sample or end of the record
    bounds = np.concatenate([[stamps[0]], dimmed, [stamps[-1]]])
    later = np.clip(np.searchsorted(bounds, time), 1, bounds.size - 1)
    free = free & (np.minimum(bounds[later] - time, time - bounds[later - 1]) > GAPS.around_s * 1e9)
    return (free, float(infrared_fraction[free].mean())) if free.any() else no_sun


def doubt_about_clouds(window: tuple[slice, slice], picture: Picture) -> str:
    # Return why the sun may not have been free over a car under broken clouds; empty where it was.
    #
    # Takes ``window``: the part of the picture with the car.
    if picture.sun is None:
        return ""
    model, (sunny, sunny_fraction) = picture.model, picture.sun
    advice = "take a line flown between clouds, or draw the region and check its level by hand"
    if not sunny[window[0]].all():
        return (
            "clouds were broken, and no irradiance record shows free sun from "
            f"{GAPS.around_s:g} s before this car was recorded to {GAPS.around_s:g} s after; {advice}"
        )
    near = padded(window, GAPS.around_px)
    infrared = model.channel_wavelength >= min(GAPS.infrared_nm, float(model.channel_wavelength.max()))
    brightness = picture.channels[near][..., infrared].mean(axis=2)
    segment = model.segment[near]
    body = np.append(model.body, np.int32(-1))[segment]
    # only shadows on the ground: the sides of cars that face away from the sun are shaded, too
    shaded = np.append((model.state == SHADED) & (model.ground > 0), False)[segment]
    recorded = max(sunny_fraction, GAPS.least_fraction)
    # the largest shadow, and sunlit ground of the same body
    inside = shaded & (body >= 0) & np.isfinite(brightness)
    ground = int(np.bincount(body[inside]).argmax()) if inside.any() else -1
    dark, lit = brightness[inside & (body == ground)], brightness[~shaded & (body == ground)]
    if min(dark.size, lit.size) < GAPS.min_px:
        return f"clouds were broken, and no shadow beside this car shows that the sun was free here; {advice}"
    fraction = float(np.median(dark) / np.median(lit))
    if not fraction <= GAPS.max_over_record * recorded:
        return (
            f"clouds were broken, and a shadow beside this car has {fraction:.0%} of the light, expected "
            f"{recorded:.0%} by the record: a cloud covered the sun here; {advice}"
        )
    return ""


# --- lean of a roof towards the sun: its prior uncertainty, and its estimate from a height model -----------


def height_model_of(line: xr.Dataset) -> tuple[Array, float] | None:
    # Return the height of the surface in every pixel, and the distance between pixels; None without heights.
    #
    # (line, column) [m] and [m], from ``east``, ``north`` and ``ground_height`` of
    # `hyperpaint.geometry.locate` with a ``dem`` of surfaces.
    names, dims = ("east", "north", "ground_height"), (ALONG_TRACK, CROSS_TRACK)
    if not all(name in line.variables and set(line[name].dims) == set(dims) for name in names):
        return None
    east, north, height = dask.compute(*(line[name].transpose(*dims).data for name in names))
    steps = [np.hypot(np.diff(east, axis=axis), np.diff(north, axis=axis)) for axis in (0, 1)]
    spacings = np.concatenate([step[np.isfinite(step)] for step in steps])
    return (
        None
        if not spacings.size or not float(np.median(spacings)) > 0.0
        else (np.asarray(height, np.float64), float(np.median(spacings)))
    )


def lean_to_sun(axis: Floats, shadow_side: Floats | None) -> float:
    # Return the standard deviation of the unknown lean of a roof towards the sun [degree].
    #
    # Takes ``axis`` (2,): unit vector (line, column) along the car; ``shadow_side`` (2,): direction of
    # shadows, or None where it is unknown.
    along = 1.0 if shadow_side is None else float(abs(axis @ shadow_side))
    return float(np.hypot(LEANS.rake_deg * along, LEANS.roll_deg * np.sqrt(max(1.0 - along**2, 0.0))))


def measured_lean(
    heights: tuple[Array, float] | None,
    window: tuple[slice, slice],
    inside: Bools,
    centre: tuple[float, float],
    prior: float,
    shadow_side: Floats | None,
) -> tuple[float, Floats, float]:
    r"""Return the lean of a roof from its heights; the prior where no height model shows the car.

    Standard deviation of its unknown part [degree]; lines and columns (2,) from the centre of the roof to
    where it is level along the sun's direction; and the lean in the centre, positive where the roof faces the
    sun [degree], NaN if not measured.

    A polynomial of second order through the heights of the roof,

    .. math:: z = z_0 + b \cdot p + p^T H p / 2,

    with p [pixel] from its centre, has the slope :math:`b \cdot s` towards the sun s, and is level
    :math:`- (b \cdot s) / (s^T H s)` pixels in that direction. The prior lean, 0 with the standard deviation
    ``prior``, and the fitted lean are weighted by their inverse variances.

    Takes ``heights``: see `height_model_of`; ``window``: the part of the picture with the roof; ``inside``
    (line, column): its pixels there; ``centre``: line and column in the window; ``prior`` [degree];
    ``shadow_side`` (2,): see `lean_to_sun`.
    """
    prior_lean = prior, np.zeros(2), np.nan
    if heights is None or shadow_side is None:
        return prior_lean
    surface, spacing = heights
    height = surface[window]
    valid = inside & np.isfinite(height)
    # a height model of bare ground does not show the car
    around = padded(window, LEANS.around_px)
    if (
        valid.sum() < LEANS.min_px
        or min(valid.any(axis=0).sum(), valid.any(axis=1).sum()) < LEANS.min_side_px
        or not np.median(height[valid]) - np.nanquantile(surface[around], 0.1) > LEANS.min_above_m
    ):
        return prior_lean
    rows, columns = np.nonzero(valid)
    y, x = rows - centre[0], columns - centre[1]
    terms = np.stack([np.ones(y.size), y, x, 0.5 * y * y, y * x, 0.5 * x * x], axis=1)
    fitted = np.linalg.lstsq(terms, height[valid], rcond=None)[0]
    residuals = height[valid] - terms @ fitted
    # the height errors within one patch are correlated
    patch_px = max(1.0, (LEANS.patch_m / spacing) ** 2)
    covariance = (
        np.linalg.pinv(terms.T @ terms) * float(residuals @ residuals) / (y.size - terms.shape[1]) * patch_px
    )
    sun = -shadow_side
    slope = float(fitted[1:3] @ sun) / spacing
    slope_sd = float(np.sqrt(sun @ covariance[1:3, 1:3] @ sun)) / spacing
    sd = float(np.hypot(np.degrees(np.arctan(slope_sd)), LEANS.floor_deg))
    if not sd < prior:
        return prior_lean
    weight = prior**2 / (prior**2 + sd**2)
    curvature = float(sun @ np.array([[fitted[3], fitted[4]], [fitted[4], fitted[5]]]) @ sun) / spacing**2
    # only a roof that curves down has a level position
    shift = weight * slope / -curvature / spacing * sun if curvature < 0.0 else np.full(2, np.inf)
    return prior * sd / float(np.hypot(prior, sd)), shift, -float(np.degrees(np.arctan(slope)))


# --- the footprint of a car: the area around a piece of its paint -----------------------------------------


_ROUNDING = 1e-6

#: Rules for joining parts of a car, from the strictest on; parts that touch are always joined. Each tells
#: whether far brighter or darker parts are of the same paint, such as flakes at another lean; whether parts
#: with only dark pixels between them are joined; and whether thin bridges, such as a mirror that touches a
#: bay line, separate parts.
JOININGS = tuple(product((False, True), (False, True), (False, True)))


class Footprint(NamedTuple):
    # A car seen from above.
    origin: tuple[int, int]  #: Line and column of the first pixel of the masks.
    paint: Bools  #: (line, column): Pixels with the colour of its paint, also beside the car.
    area: Bools  #: (line, column): The car: its thick parts with this colour, and the area they enclose.
    brightness: Floats  #: (line, column): Brightness relative to the piece that the footprint began with.
    axis: Floats  #: (2,): Unit vector (line, column) along its longer side.
    centre: Floats  #: (2,): Line and column of its centre in the masks.
    length: float  #: [pixel]
    width: float  #: [pixel]
    cut: bool  #: Whether the edge of the picture cuts it off.

    @property
    def is_one_car(self) -> bool:
        # Whether it has the proportions of one car, and the picture shows all of it.
        low, high = FOOTPRINTS.slenderness
        return not self.cut and low < self.length / self.width < high

    @property
    def window(self) -> tuple[slice, slice]:
        # Window of the masks in the picture.
        return window_of(self.origin, self.area)


def footprints_of(
    inside: Bools,
    origin: tuple[int, int],
    colour: Floats,
    picture: Picture,
    joinings: Sequence[tuple[bool, bool, bool]],
) -> Iterator[Footprint]:
    # Yield the footprint of the car around a piece of paint, for each of the rules for joining parts.
    #
    # Rules with which the paint extends beyond the largest margin yield nothing. Takes ``inside`` (line,
    # column): the piece; ``origin``: line and column of its first pixel; ``colour`` (channel,): its
    # reflectance, less the mirrored sky [1]; ``joinings``: see `JOININGS`.
    shape = np.array(picture.level.shape)
    matches: dict[tuple[int, bool], tuple[Bools, Bools, Bools, Floats]] = {}
    for wide_brightness, over_windows, cut_bridges in joinings:
        pad = min(int(FOOTPRINTS.margin * max(inside.shape)), FOOTPRINTS.max_margin_px)
        for _ in range(FOOTPRINTS.rounds):
            low = np.maximum(np.array(origin) - pad, 0)
            high = np.minimum(np.array(origin) + inside.shape + pad, shape)
            key = pad, wide_brightness
            if key not in matches:
                matches[key] = _matched_colour(
                    colour, picture, np.s_[low[0] : high[0], low[1] : high[1]], wide_brightness
                )
            paint, ground, dark, brightness = matches[key]
            seed = np.zeros(paint.shape, bool)
            seed[window_of((origin[0] - low[0], origin[1] - low[1]), inside)] = inside
            area = _car_area(seed, paint | seed, ground, dark if over_windows else None, cut_bridges)
            if area is None:
                break
            # whether the car reaches the first line and column of the window, and the last ones
            sides = np.array([[area[0].any(), area[:, 0].any()], [area[-1].any(), area[:, -1].any()]])
            if not (sides & ~np.array([low == 0, high == shape])).any():
                place = (int(low[0]), int(low[1])), paint | seed, area, brightness
                yield Footprint(*place, *_rectangle(area), bool(sides.any()))
                break
            pad = int(FOOTPRINTS.growth * pad) + 8


def _matched_colour(
    colour: Floats, picture: Picture, window: tuple[slice, slice], wide_brightness: bool
) -> tuple[Bools, Bools, Bools, Floats]:
    # Pixels (line, column) of paint, of ground, and darker than paint; brightness relative to the paint
    spectra = picture.without_sky(window)
    length = np.maximum(np.linalg.norm(spectra, axis=2), 1e-9)
    colour_length, ground_length = float(np.linalg.norm(colour)), float(np.linalg.norm(picture.ground))
    brightness = (spectra @ colour) / colour_length**2
    paint_cosine = brightness * colour_length / length
    is_dark = float(colour.mean()) < SURFACES.dark
    low, high = (FOOTPRINTS.dark_brightness if is_dark else FOOTPRINTS.brightness)[wide_brightness]
    # pixels as bright as the ground are paint only if their spectrum is closer to the paint's
    ground_cosine = (spectra @ picture.ground) / (length * ground_length)
    is_ground_bright = np.abs(np.log(length / ground_length)) < FOOTPRINTS.max_ground_log_ratio
    is_closer = (paint_cosine > ground_cosine) | ~is_ground_bright
    paint = (paint_cosine > FOOTPRINTS.min_cosine) & (brightness > low) & (brightness < high) & is_closer
    ground = ~paint & is_ground_bright & (ground_cosine > FOOTPRINTS.min_cosine)
    return paint, ground, ~paint & (length < low * colour_length), brightness


def _car_area(
    seed: Bools, paint: Bools, ground: Bools, dark: Bools | None, cut_bridges: bool
) -> Bools | None:
    # Area of the car around a seed: the hull of thick connected parts with the colour of its paint.
    # Bay lines and mirrors are thin. Parts with ground between them and the seed are not added. With `dark`,
    # parts with only dark pixels between them are connected.
    square, gap = np.ones((3, 3), bool), FOOTPRINTS.max_gap_px
    closed = binary_closing(np.pad(paint, gap), square, iterations=gap)[gap:-gap, gap:-gap]
    if cut_bridges:
        closed = binary_opening(closed, square, iterations=FOOTPRINTS.bridge_px) | seed
    parts, _ = label(closed if dark is None else closed | dark, square)
    seed_parts = np.unique(parts[seed])
    filled = binary_fill_holes(closed & np.isin(parts, seed_parts[seed_parts > 0]))
    depth = distance_transform_edt(filled)
    # the depth at the seed counts: a wall that the car touches may be wider
    min_depth = max(FOOTPRINTS.min_half_width_px, FOOTPRINTS.thin * float(depth[seed].max()))
    cores, count = label(depth > min_depth, square)
    seed_sizes = np.bincount(cores[seed & (cores > 0)], minlength=count + 1)
    if not seed_sizes.any():
        return None
    # hull of the seed's core and of further cores, added from the nearest on while their gap, the width of
    # the hull and the ground in it stay within the limits of a car
    seed_core = int(np.argmax(seed_sizes))
    car_cores = cores == seed_core
    area = _hull_around(car_cores, min_depth, filled)
    large_cores = np.flatnonzero(np.bincount(cores.ravel()) > min_depth * min_depth).tolist()
    candidates = [core for core in large_cores if core not in (0, seed_core)]
    gaps: dict[int, float] = {}
    while candidates:
        if not gaps:
            distance = distance_transform_edt(~car_cores)
            gaps = dict(zip(candidates, minimum(distance, cores, candidates).tolist(), strict=True))
        nearest = min(candidates, key=lambda core: (gaps[core], core))
        candidates.remove(nearest)
        larger_cores = car_cores | (cores == nearest)
        half_width = float(depth[larger_cores].max())
        if gaps[nearest] > FOOTPRINTS.max_gap * half_width:
            break
        hull = _hull_around(larger_cores, min_depth, filled)
        is_narrow = _rectangle(hull)[3] < FOOTPRINTS.max_width * 2.0 * half_width
        if is_narrow and (hull & ground).sum() < FOOTPRINTS.max_ground_share * hull.sum():
            car_cores, area, gaps = larger_cores, hull, {}
    return area


def _hull_around(core: Bools, radius: float, filled: Bools) -> Bools:
    # Convex hull of the pixels of the mask `filled` within a distance [pixel] of a core
    pad = int(np.ceil(radius))
    window = tuple(
        slice(max(int(indices[0]) - pad, 0), int(indices[-1]) + pad + 1)
        for indices in (np.flatnonzero(core.any(axis=axis)) for axis in (1, 0))
    )
    grown = np.zeros_like(core)
    grown[window] = (distance_transform_edt(~core[window]) <= radius) & filled[window]
    return hull_of(grown)


def hull_of(mask: Bools) -> Bools:
    # Return the convex hull of a mask (line, column).
    points = _border(mask)
    if np.linalg.matrix_rank(points - points[0]) < 2:
        return mask
    normal_y, normal_x, offset = ConvexHull(points).equations.T
    lines, columns = mask.shape
    # intersections of every line of the mask with the sides of the hull: the nearest side with its normal to
    # the right ends the line, the nearest with its normal to the left begins it
    offsets = -(np.arange(lines)[:, None] * normal_y + offset)
    steep = np.where(np.abs(normal_x) > _ROUNDING, normal_x, np.nan)
    last_x = np.where(normal_x > _ROUNDING, offsets / steep, np.inf).min(axis=1)
    first_x = np.where(normal_x < -_ROUNDING, offsets / steep, -np.inf).max(axis=1)
    crosses = np.where(np.abs(normal_x) > _ROUNDING, 0.0, offsets).min(axis=1) >= -_ROUNDING
    x = np.arange(columns)
    inside = (x >= first_x[:, None] - _ROUNDING) & (x <= last_x[:, None] + _ROUNDING)
    return np.asarray(inside & crosses[:, None])


def _border(mask: Bools) -> Floats:
    # Line and column (point, 2) of the first and the last pixel in every line of a mask
    rows = np.flatnonzero(mask.any(axis=1))
    row_masks = mask[rows]
    first, last = row_masks.argmax(axis=1), mask.shape[1] - 1 - row_masks[:, ::-1].argmax(axis=1)
    return np.stack([np.repeat(rows, 2), np.stack([first, last], axis=1).ravel()], axis=1).astype(np.float64)


def _rectangle(mask: Bools) -> tuple[Floats, Floats, float, float]:
    # Direction of the longer side, centre, length and width of the rectangle with the smallest area around a
    # mask, among directions in steps of `turn_deg`
    points = _border(mask)
    turn = np.radians(np.arange(0.0, 90.0, FOOTPRINTS.turn_deg))
    axes = np.stack([np.sin(turn), np.cos(turn)], axis=1)
    asides = np.stack([np.cos(turn), -np.sin(turn)], axis=1)
    u, v = points @ axes.T, points @ asides.T
    lengths, widths = np.ptp(u, axis=0) + 1.0, np.ptp(v, axis=0) + 1.0
    best = int(np.argmax(lengths * widths <= (lengths * widths).min() + _ROUNDING))
    along, aside = axes[best], asides[best]
    centre = 0.5 * (
        (u[:, best].min() + u[:, best].max()) * along + (v[:, best].min() + v[:, best].max()) * aside
    )
    length, width = float(lengths[best]), float(widths[best])
    return (along, centre, length, width) if length >= width else (aside, centre, width, length)


# --- the roof of a car -------------------------------------------------------------------------------------


class Roof(NamedTuple):
    # The roof of a car.
    inside: Bools  #: (line, column): Its pixels, in the footprint's window.
    centre: tuple[float, float]  #: Line and column of its level position in that window.
    axis: Floats  #: Unit vector (line, column) along the car.
    unsure: float  #: Maximum error of the level position along the car [pixel].
    unsure_across: float  #: The same across the car [pixel].
    reason: str  #: Evidence that it is a roof.
    worth: float  #: Weight of this evidence; the roof with the largest worth is chosen.
    complete: bool  #: Whether it lies between two windows with paint beyond both.
    sided: bool  #: Whether a window at its end has a bonnet beyond, and side windows run along it.
    window_level: float  #: Median mean reflectance of the windows at its ends [1].


class NoRoof(NamedTuple):
    # Reason why no roof is found, and whether it is still a car.
    reason: str
    is_car: bool


class _Run(NamedTuple):
    # A section of a car along its axis, of windows or of paint: tracks `start` to before `stop` [pixel]
    start: int
    stop: int
    is_window: bool

    @property
    def length(self) -> int:
        return self.stop - self.start


class _Tracks(NamedTuple):
    # Coordinates of the pixels of a car and its windows (line, column); a track is a row of pixels across it
    along: Floats  #: Distance from its end along its axis [pixel].
    across: Floats  #: Distance from its axis [half widths].
    glass: Bools  #: Pixels as dark as windows.
    level: Floats  #: Mean reflectance [1].

    def within(self, run: _Run) -> Bools:
        return (self.along >= run.start) & (self.along < run.stop)


def find_roof(car: Footprint, level: Floats) -> Roof | NoRoof:
    # Return the roof of a car, or the reason why none is found.
    #
    # Takes ``car``: its footprint; ``level`` (line, column): mean reflectance in its window [1].
    # pixels as dark as windows
    paint_level = float(np.median(level[car.paint & car.area]))
    limit = min(max(ROOFS.max_window_level, ROOFS.max_window_of_paint * paint_level), paint_level)
    glass = np.asarray(~car.paint & car.area & (level < limit))
    roof = _roof_along(car, glass, level)
    if isinstance(roof, Roof) or not car.cut:
        return roof
    # the longer side of a car cut off by the picture's edge may be its width
    turned_roof = _roof_along(
        car._replace(axis=_aside(car), length=car.width, width=car.length), glass, level
    )
    return roof if isinstance(turned_roof, NoRoof) else turned_roof


def _aside(car: Footprint) -> Floats:
    # Unit vector (line, column) across a car
    return np.array([car.axis[1], -car.axis[0]])


def _roof_along(car: Footprint, glass: Bools, level: Floats) -> Roof | NoRoof:
    y, x = np.indices(car.area.shape, np.float64)
    y, x = y - car.centre[0], x - car.centre[1]
    across = (y * car.axis[1] - x * car.axis[0]) / (0.5 * car.width)
    tracks = _Tracks(y * car.axis[0] + x * car.axis[1] + 0.5 * car.length, across, glass, level)
    runs = _runs(car, tracks)
    if not any(run.is_window for run in runs):
        return NoRoof("no window crosses it: it may not belong to a car", False)
    # Tracks with side windows (track,), on the side with more of them.
    # Beyond a window there is a lit door; beyond dark pixels of the car's shadow nothing is lit.
    count = round(car.length)
    track = np.floor(tracks.along).astype(np.int64).clip(0, count - 1)
    side_windows = []
    for sign in (-1, 1):
        aside = sign * tracks.across
        lit = car.area & ~tracks.glass & (aside > ROOFS.middle)
        outermost = np.zeros(count)
        np.maximum.at(outermost, track[lit], aside[lit])
        window = tracks.glass & (aside > ROOFS.middle) & (aside < outermost[track])
        side_windows.append(np.bincount(track[window], minlength=count) >= ROOFS.min_window_px)
    beside = max(side_windows, key=lambda windows: int(windows.sum()))

    def sided(run: _Run) -> float:
        # Share of a section with side windows
        return float(beside[run.start : run.stop].mean())

    best: Roof | None = None
    for number, run in enumerate(runs):
        if run.is_window or run.length < ROOFS.min_roof_px:
            continue
        # windows at the ends of the section, and the paint beyond them
        windows, beyond = (
            [runs[section] for section in (number - step, number + step) if 0 <= section < len(runs)]
            for step in (1, 2)
        )
        long = [section for section in beyond if section.length > ROOFS.min_bonnet * car.length]
        has_bonnet = any(sided(section) < ROOFS.sided for section in long)
        grounds = _judge_run(car, runs, number, sided(run), len(long) == 2)
        if grounds is None or (best is not None and best.worth >= grounds[1]):
            continue
        along, unsure = _level_place(car, runs, number)
        centre, half, unsure_across, are_visible = _sides(car, tracks, run)
        inside = car.area & tracks.within(run) & (np.abs(across - centre) < ROOFS.used_width * half)
        # the sides of a car at the picture's edge must be visible
        if not inside.any() or (car.cut and not are_visible):
            continue
        line, column = (
            car.centre + (along - 0.5 * car.length) * car.axis + 0.5 * car.width * centre * _aside(car)
        )
        is_between = len(long) == 2 or (has_bonnet and sided(run) > ROOFS.sided)
        of_windows = np.logical_or.reduce([tracks.within(window) for window in windows])
        of_windows &= glass & (np.abs(across) < ROOFS.middle)
        best = Roof(
            inside,
            (float(line), float(column)),
            car.axis,
            unsure,
            unsure_across,
            *grounds,
            1 < number < len(runs) - 2 and is_between,
            has_bonnet and sided(run) > ROOFS.surely_sided,
            float(np.median(level[of_windows])) if of_windows.any() else np.nan,
        )
    if best is not None:
        return best
    is_car = car.is_one_car and float(beside.mean()) > ROOFS.van_sided
    return NoRoof("no roof: no section lies between windows, or is longer than a bonnet", is_car)


def _judge_run(
    car: Footprint, runs: list[_Run], number: int, sided: float, is_between: bool
) -> tuple[str, float] | None:
    # Reason and worth of a section as the roof; None where it may be another body part.
    # `sided`: its share with side windows; `is_between`: whether paint lies beyond the windows at both ends.
    run = runs[number]
    share = run.length / car.length
    ends = int(number > 0) + int(number + 1 < len(runs))
    evidence = f"side windows along {sided:.0%} of it"
    # a bed has walls along it, too, but no paint beyond both ends
    worth = share + sided + (ROOFS.between_worth if is_between else 0.0)
    if car.cut:
        return (
            (f"a roof: windows end it on both sides, {evidence}", worth)
            if ends == 2 and sided > ROOFS.long_sided and run.length > ROOFS.min_roof_of_cut * car.width
            else None
        )
    # a section between a windscreen and the car's own shadow looks as if it ended at two windows
    min_slenderness = (
        ROOFS.min_slenderness if ends == 2 and sided > ROOFS.surely_sided else FOOTPRINTS.slenderness[0]
    )
    if (
        share < ROOFS.min_roof
        or not min_slenderness < car.length / car.width < FOOTPRINTS.slenderness[1]
        or (ends == 2 and not is_between and (share < ROOFS.short_roof or sided < ROOFS.van_sided))
    ):
        return None
    evidence = f"{share:.0%} of the car's length, {evidence}"
    centre = 0.5 * (run.start + run.stop) / car.length
    if ends == 2 and (sided > ROOFS.sided or ROOFS.central[0] < centre < ROOFS.central[1]):
        return f"a roof: windows end it on both sides, {evidence}", worth
    if ends == 1 and sided > ROOFS.surely_sided:
        return f"a roof: a window ends it, {evidence}", worth
    if ends != 1 or not share < ROOFS.max_van_roof:
        return None
    is_behind_bonnet = (
        len(runs) == 3
        and ROOFS.min_bonnet < runs[2 - number].length / car.length < ROOFS.max_bonnet
        and runs[1].length / car.length < ROOFS.max_windscreen
    )
    if share > ROOFS.min_van_roof and is_behind_bonnet:
        return f"a roof: it is all of the car behind a windscreen with a bonnet, {evidence}", worth
    min_sided = ROOFS.long_sided if share < ROOFS.min_van_roof else ROOFS.van_sided
    return (
        (f"a roof: a window ends it, and it is longer than any bonnet, {evidence}", share + sided)
        if share > ROOFS.max_bonnet and sided > min_sided
        else None
    )


def _level_place(car: Footprint, runs: list[_Run], number: int) -> tuple[float, float]:
    # Position along the car where a roof is level, and its maximum error [pixel].
    # A window longer than `min_sunroof` contains a sunroof: then the roof is level at this window's edge.
    # Where less than a tail follows, as behind the bed of a pickup, it is no sunroof.
    run, car_length = runs[number], car.length
    centre = 0.5 * (run.start + run.stop)
    for step in (-1, 1):
        if car.cut or not 0 <= number + step < len(runs) or run.length > ROOFS.max_bonnet * car_length:
            continue
        window = runs[number + step].length
        edge = float(run.start if step < 0 else run.stop)
        beyond = sum(section.length for section in (runs[: number - 1] if step < 0 else runs[number + 2 :]))
        if beyond < ROOFS.min_tail * car_length:
            continue
        if window > ROOFS.min_sunroof * car_length:
            return edge, ROOFS.unsure_beside * car_length
        if window > ROOFS.max_windscreen * car_length:
            return centre, abs(centre - edge)
    return centre, ROOFS.unsure * car_length


def _sides(car: Footprint, tracks: _Tracks, run: _Run) -> tuple[float, float, float, bool]:
    # Position halfway between the sides of a roof, and half their distance [half widths]; maximum error of
    # this position [pixel]; and whether both sides are visible.
    # A side is where brightness falls most steeply, else where side windows begin. A threshold would fail
    # under a low sun, where the side that leans away from it is darker than other paint. Paint as dark as
    # windows shows no fall.
    left_side, right_side = (_step(car, tracks.level, sign, run) for sign in (-1, 1))
    unsure = ROOFS.unsure_side_px
    if np.isnan(left_side) or np.isnan(right_side):
        left_side, right_side = (_window_edge(tracks, sign, run) for sign in (-1, 1))
        unsure = ROOFS.unsure_window_px
    are_visible = bool(np.isfinite(left_side) and np.isfinite(right_side))
    if not are_visible:
        unsure = ROOFS.unsure_width * (0.5 * car.width)
    if np.isnan(left_side) and np.isnan(right_side):
        left_side = right_side = ROOFS.roof_width
    left_side, right_side = (
        2 * ROOFS.roof_width - opposite if np.isnan(side) else side
        for side, opposite in ((left_side, right_side), (right_side, left_side))
    )
    return 0.5 * (right_side - left_side), 0.5 * (right_side + left_side), unsure, are_visible


def _step(car: Footprint, level: Floats, sign: int, run: _Run) -> float:
    # Distance from the axis to the first fall of brightness as at a window, on one side [half widths].
    # Median over the tracks of a section; NaN where too few tracks show such a fall.
    half_width = 0.5 * car.width
    distances = np.arange(ROOFS.side * half_width, ROOFS.beyond * half_width, ROOFS.step_px)
    along = np.arange(run.start + 0.5, run.stop) - 0.5 * car.length
    positions = (
        np.array(car.centre)[:, None, None]
        + car.axis[:, None, None] * along[None, :, None]
        + sign * _aside(car)[:, None, None] * distances[None, None, :]
    )
    profiles = map_coordinates(np.log(np.maximum(level, ROOFS.black)), positions, order=1, mode="nearest")
    span, stay = round(1.0 / ROOFS.step_px), round(max(1.0, ROOFS.window_width * half_width) / ROOFS.step_px)
    inner, outer = (
        profiles[:, : -span - stay],
        [profiles[:, span + n : profiles.shape[1] - stay + n] for n in range(stay)],
    )
    # at a window, unlike at a seam, all pixels beyond the fall are dark
    drop = inner - np.max(outer, axis=0)
    has_drop = (drop > ROOFS.min_step).any(axis=1)
    if has_drop.sum() < ROOFS.min_seen * has_drop.size:
        return np.nan
    fall_start = (drop[has_drop] > ROOFS.min_step).argmax(axis=1)
    steepest = [
        int((profile[at : at + span] - profile[at + span : at + 2 * span]).argmax())
        for profile, at in zip(profiles[has_drop], fall_start, strict=True)
    ]
    return float(np.median(distances[fall_start + steepest] + 0.5)) / half_width


def _window_edge(tracks: _Tracks, sign: int, run: _Run) -> float:
    # Distance from the axis where side windows begin, on one side [half widths].
    # Median over the tracks of a section; NaN without side windows.
    beside = tracks.within(run) & tracks.glass & (sign * tracks.across > ROOFS.side)
    nearest = np.full(run.length, np.inf)
    track = (np.floor(tracks.along[beside]).astype(np.int64) - run.start).clip(0, run.length - 1)
    np.minimum.at(nearest, track, sign * tracks.across[beside])
    edges = nearest[np.isfinite(nearest)]
    return float(np.median(edges)) if edges.size >= ROOFS.min_seen * nearest.size else np.nan


def _runs(car: Footprint, tracks: _Tracks) -> list[_Run]:
    # Sections of paint and of windows from one end of the car to the other.
    # Short strips of paint between windows, as before a sunroof, are merged with the windows.
    middle = car.area & (np.abs(tracks.across) < ROOFS.middle)
    count = round(car.length)
    track = np.floor(tracks.along[middle]).astype(np.int64).clip(0, count - 1)
    counts = np.bincount(track, minlength=count)
    crossed = np.bincount(track, tracks.glass[middle], count) / np.maximum(counts, 1) > ROOFS.min_crossed
    ends = np.flatnonzero(np.diff(crossed.astype(np.int8), prepend=2, append=2))
    stretches = [
        _Run(a, b, bool(crossed[a])) for a, b in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True)
    ]
    merged: list[_Run] = []
    for number, run in enumerate(stretches):
        is_strip = 0 < number < len(stretches) - 1 and not run.is_window
        min_length = ROOFS.max_strip * car.length if is_strip else ROOFS.min_window_px
        if merged and (run.length < min_length or merged[-1].is_window == run.is_window):
            merged[-1] = _Run(merged[-1].start, run.stop, merged[-1].is_window)
        else:
            merged.append(run)
    return merged


# --- verdict on a piece: kind, uncertainty of its level, score ---------------------------------------------


@dataclass
class Verdict:
    # A piece, its measures, and the verdict on it.
    piece: Piece
    measures: Measures
    kind: str = ""  #: "roof", "panel", "metallic"; empty where it may not belong to a car.
    score: float = 0.0  #: Score from 0 to 1; the equation is in `propose_regions`.
    reasons: list[str] = field(default_factory=list)  #: Reasons to propose the piece.
    objections: list[str] = field(default_factory=list)  #: Reasons to refuse it; any objection refuses it.
    finish: str = "unknown"  #: "solid" or "metallic" where brightness and colour of a roof show it.
    level_sd: float = np.nan  #: Relative standard uncertainty of its level [1].
    lean: float = np.nan  #: Standard deviation of its lean [degree].
    scenery: bool = False  #: Whether it looks like leaves, a shadow or a window, and is listed last.


class Level(NamedTuple):
    # Brightness of a part where it is level, its uncertainty, and its change with lean.
    brightness: float = 1.0  #: Brightness there, in the unit of the brightness passed.
    sd: float = 0.0  #: Its relative standard uncertainty from the fit and the position [1].
    along_change: float = 0.0  #: Its relative change with lean along the car [1/rad].
    across_change: float = 0.0  #: The same across it [1/rad].
    is_measured: bool = True  #: Whether the changes are measured on the crown of a roof, not assumed.

    @property
    def lean_change(self) -> float:
        # Largest relative change over lean in any direction [1/rad].
        return float(np.hypot(self.along_change, self.across_change))


def change_with_lean(zenith: float) -> float:
    # Return the relative change of the sunlight under a coat with lean towards the sun [1/rad].
    #
    # Takes ``zenith``: angle t of the sun to the normal of the body part [degree]. With the reflectance F of
    # the coat's interface, the change is -d ln(cos t (1 - F(t))) / dt: tan t, and a term for the larger
    # transmission of the coat at steeper incidence.
    angles = np.radians(min(zenith, MAX_SUN_ZENITH_DEG)) + np.array([-1e-3, 1e-3])
    light = np.log(np.cos(angles) * (1.0 - interface_reflectance(np.degrees(angles))))
    return float(light[0] - light[1]) / 2e-3


def judge_level(verdict: Verdict, picture: Picture, rake: float, level: Level) -> None:
    # Add the uncertainty of a part's level, and visible flakes, to its verdict; object if it is too large.
    #
    # A small lean b towards the sun changes the light of a solid body by about f_dir tan(zenith) b, with the
    # direct share f_dir of the light, and the light of flakes by more. The change of brightness over the
    # crown of a roof, which leans by known angles, shows how much more. Takes ``rake``: standard deviation of
    # the part's unknown lean [degree].
    measures = verdict.measures
    if not measures.pixels:
        return
    zenith, direct = 45.0 if picture.zenith is None else picture.zenith, picture.direct_share
    slope = direct * change_with_lean(zenith)
    # the signature excludes the mirrored sky, too
    model = picture.model
    mirrored = FOOTPRINTS.mirrored * float((model.diffuse_fraction * model.zenith_radiance).mean())
    brightness = max(float(measures.spectrum.mean()) - mirrored, 1e-3)
    # haze makes a sky brighter than a clear one, and uneven, mostly around the sun; an overcast sky is even
    haze = (1.0 - direct) / float(diffuse_fraction(picture.model.channel_wavelength, zenith).mean()) - 1.0
    clear_part = direct * float(np.hypot(JUDGING.mirror_share_sd, haze))
    mirror_share_sd = clear_part + (1.0 - direct) * JUDGING.covered_share_sd
    contributions = {
        "noise and dust": JUDGING.least_sd,
        f"an unknown lean of {rake:.1f} degrees": float(np.radians(rake)) * max(slope, level.lean_change),
        "the position where it is level": level.sd,
        "the sky mirrored by its coat": mirror_share_sd * mirrored / brightness,
        "its low reflectance": JUDGING.mirror_sd / brightness,
        "broken clouds": GAPS.sd if picture.sun is not None else 0.0,
    }
    verdict.level_sd, verdict.lean = float(np.hypot.reduce(list(contributions.values()))), rake
    has_lobe = direct > JUDGING.min_direct and level.lean_change > JUDGING.max_solid_gain * slope
    allowed = max(JUDGING.max_lobe_sd if has_lobe else JUDGING.max_level_sd, JUDGING.max_dark_sd / brightness)
    largest = max(contributions, key=contributions.__getitem__)
    text = f"the uncertainty of its level is {verdict.level_sd:.1%}, mainly from {largest}"
    if has_lobe and level.is_measured:
        text += (
            f"; its brightness changes by {np.radians(level.lean_change):.0%} a degree of lean, like flakes"
        )
    if verdict.level_sd <= allowed:
        verdict.reasons.append(text)
    else:
        advice = "fly under a higher sun, or draw a region on a level part"
        verdict.objections.append(f"{text}: at most {allowed:.1%} is allowed; {advice}")


def judge_pixels(verdict: Verdict, limits: Limits) -> None:
    # Add the measures and the score to a verdict; object to too few pixels, and to mixed colours.
    measures = verdict.measures
    lost = ", ".join(f"{share:.0%} {reason}" for reason, share in measures.lost.items() if share >= 0.01)
    excluded = f" (excluded: {lost})" if lost else ""
    if measures.pixels < limits["min_pixels"]:
        verdict.objections.append(
            f"{measures.pixels} usable pixels, expected at least {limits['min_pixels']}{excluded}"
        )
        return
    verdict.reasons.append(f"{measures.pixels} pixels{excluded}")
    if measures.angle > limits["angle"]:
        verdict.objections.append(f"not homogeneous: spectra differ by {measures.angle:.1f} degrees")
    verdict.reasons.append(
        f"homogeneous to {measures.angle:.1f} degrees, brightness to {measures.spread:.1%}; "
        f"glint {measures.glint:.3f}, light of neighbours {measures.adjacency:.3f}"
    )
    homogeneity = 1.0 / (1.0 + (measures.angle / JUDGING.half_angle_deg) ** 2)
    penalty = (
        measures.adjacency / JUDGING.half_adjacency
        + measures.glint / JUDGING.half_glint
        + measures.spread / JUDGING.half_spread
    )
    verdict.score = float(min(1.0, measures.pixels / JUDGING.enough_px) * homogeneity / (1.0 + penalty))


# --- brightness of a roof where it is level, with its uncertainty ------------------------------------------


class Place(NamedTuple):
    """Position on a roof where it is level."""

    line: float  #: Line in the window of the footprint.
    column: float  #: Column in the window of the footprint.
    along_sd: float  #: Standard deviation of the position along the car [pixel].
    across_sd: float  #: The same across it [pixel].
    half_width: float  #: Half of the width of the roof [pixel].
    half_length: float  #: Half of its length [pixel].

    @property
    def crown(self) -> Floats:
        # Lean half a width away, along and across the car (2,) [radian].
        along = 2.0 * LEVELS.drop * self.half_width / self.half_length
        limits = np.radians([LEVELS.max_crown_deg, LEVELS.crown_deg])
        return np.asarray([min(along, float(limits[0])), limits[1]])


def level_place(footprint: Footprint, roof: Roof) -> Place:
    # Return where a roof is level: along the car from its windows, across it from the roof's edges.
    #
    # A car is symmetric, so that its roof is level halfway between its edges. An edge lies where the
    # logarithm of brightness falls most steeply: shading changes brightness by factors, so that its plain
    # difference would shift the edge on the darker side inwards.
    along, across = _to_car(roof.centre, roof.axis, *np.nonzero(roof.inside))
    half_width = max(float(np.abs(across).max()) / ROOFS.used_width, 1.0)
    tracks = np.arange(np.ceil(along.min()), np.floor(along.max()) + 1.0)
    # median over all tracks at each distance across, robust against roof rails and antennas
    aside = np.arange(0.0, LEVELS.edge_span[1] * half_width + 2.0 * LEVELS.edge_px, 1.0 / LEVELS.steps_per_px)
    edges = []
    for sign in (-1.0, 1.0):
        positions = _to_picture(roof.centre, roof.axis, tracks[:, None], sign * aside)
        samples = map_coordinates(footprint.brightness, positions, order=1, mode="nearest")
        edges.append(sign * _edge(aside, np.nanmedian(samples, axis=0), half_width))
    shift = 0.5 * (edges[0] + edges[1])
    # standard deviation of a uniform distribution over the possible range
    along_sd, across_sd = (limit / float(np.sqrt(3.0)) for limit in (roof.unsure, roof.unsure_across))
    if np.isfinite(shift):
        half_width, across_sd = 0.5 * (edges[1] - edges[0]), LEVELS.edged_sd_px
    else:
        # an edge is not visible, or too far from the windows
        shift, across_sd = 0.0, max(across_sd, LEVELS.edged_sd_px)
    line, column = _to_picture(roof.centre, roof.axis, np.zeros(()), np.array(shift))
    return Place(
        float(line), float(column), along_sd, across_sd, half_width, max(0.5 * float(np.ptp(along)), 1.0)
    )


def _to_car(centre: tuple[float, float], axis: Floats, y: Array, x: Array) -> tuple[Floats, Floats]:
    # Distances from the centre of a car, along and across it [pixel]
    y, x = np.asarray(y - centre[0], np.float64), np.asarray(x - centre[1], np.float64)
    return y * axis[0] + x * axis[1], y * axis[1] - x * axis[0]


def _to_picture(
    centre: tuple[float, float], axis: Floats, along: Floats, across: Floats
) -> tuple[Floats, Floats]:
    # Line and column from distances along and across a car [pixel]
    return centre[0] + along * axis[0] + across * axis[1], centre[1] + along * axis[1] - across * axis[0]


def _edge(aside: Floats, profile: Floats, half: float) -> float:
    # Distance from the middle of a roof to the edge of the paint [pixel]; NaN without a visible edge.
    # `aside`, `profile` (sample,): distance from the middle [pixel], and brightness there.
    width = round(0.5 * LEVELS.edge_px * LEVELS.steps_per_px)
    logs = np.log(np.maximum(profile, 1e-3))
    fall = np.zeros(logs.size)
    fall[width:-width] = logs[: -2 * width] - logs[2 * width :]
    fall[(aside < LEVELS.edge_span[0] * half) | (aside > LEVELS.edge_span[1] * half)] = 0.0
    steepest = int(np.argmax(fall))
    if fall[steepest] < np.log(LEVELS.min_edge_ratio):
        return np.nan
    near = slice(max(steepest - width, 0), steepest + width + 1)
    # the centroid of the fall is more precise than a sample of the profile
    return float(np.average(aside[near], weights=np.maximum(fall[near], 0.0)))


def level_light(brightness: Floats, lit: Bools, place: Place, axis: Floats) -> Level | None:
    # Return the brightness of a roof where it is level; None where too little of it is visible.
    #
    # The lean of a crowned roof grows in proportion to the distance from its level position. The logarithm of
    # its brightness is therefore a smooth function of position: a plane for solid paint, curved by the lobe
    # of flakes. A surface of second order replaces the plane where it fits significantly better by the
    # Bayesian information criterion (Schwarz 1978). Glint lies above the surface; iterations exclude it.
    #
    # Takes ``brightness`` (line, column): brightness of the roof [1]; ``lit`` (line, column): the pixels
    # fitted; ``place``: its level position in the same window; ``axis`` (2,): direction (line, column) along
    # the car.
    y, x = np.nonzero(lit & (brightness > 0.0))
    along, across = _to_car((place.line, place.column), axis, y, x)
    u, v = along / place.half_width, across / place.half_width
    near = (np.abs(u) < LEVELS.fitted[0]) & (np.abs(v) < LEVELS.fitted[1])
    if near.sum() < LEVELS.min_fitted_px:
        return None
    u, v, logs = u[near], v[near], np.log(brightness[y[near], x[near]])
    terms = np.stack([np.ones(u.size), u, v, u * u, u * v, v * v], axis=1)
    plane, quadric = _fitted_surface(terms[:, :3], logs), _fitted_surface(terms, logs)
    independent_px = u.size / LEVELS.clump_px
    gain = independent_px * np.log(plane[1] ** 2 / quadric[1] ** 2)
    fitted, _, fit_sd = quadric if gain > 3.0 * np.log(max(independent_px, 2.0)) else plane
    slope = fitted[1:3]
    place_sd = np.hypot(*(slope * np.array([place.along_sd, place.across_sd]) / place.half_width))
    change = np.abs(slope) / place.crown
    sd = float(np.hypot(fit_sd, place_sd))
    return Level(float(np.exp(fitted[0])), sd, float(change[0]), float(change[1]))


def _fitted_surface(design: Floats, logs: Floats) -> tuple[Floats, float, float]:
    # Fit of logarithms of brightness (pixel,) with a design matrix (pixel, term): value at the origin, slopes
    # and curvatures (term,); root mean square of the residuals; standard error of the value at the origin [1]
    fitted = np.ones(logs.size, bool)
    for _ in range(LEVELS.rounds):
        terms = np.asarray(np.linalg.lstsq(design[fitted], logs[fitted], rcond=None)[0], np.float64)
        residuals = logs - design @ terms
        # standard deviation of a normal distribution from the median absolute residual
        spread = max(1.4826 * float(np.median(np.abs(residuals[fitted]))), LEVELS.min_sd)
        inliers = (residuals < LEVELS.max_above_sd * spread) & (residuals > -LEVELS.max_below_sd * spread)
        if inliers.sum() < LEVELS.min_fitted_px or np.array_equal(inliers, fitted):
            break
        fitted = inliers
    rms = max(float(np.sqrt(np.mean(residuals[fitted] ** 2))), LEVELS.min_sd)
    inverse = np.linalg.pinv(design[fitted].T @ design[fitted])
    return terms, rms, rms * float(np.sqrt(LEVELS.clump_px * inverse[0, 0]))


# --- finish of a roof, solid or with flakes, from the change of its light over its crown -------------------


def difference_of(piece: Piece, picture: Picture, relative: Floats) -> tuple[float, float] | None:
    # Return the difference of the brightest and darkest quarters of a roof; None with too few pixels.
    #
    # The share of its grey part, equal in all channels under direct light, and its contrast: the length of
    # the difference over the length of the mean spectrum [1].
    #
    # A lean b changes the direct light of a solid body r by d = f_dir (r s b + g), with a grey part g: the
    # sun mirrored by the coat. Flakes add their reflection to g. Takes ``relative`` (line, column):
    # brightness relative to the level position; values over 1.6 or under 0.5 are glint or another part.
    diffuse = picture.model.diffuse_fraction
    chosen = piece.inside & (np.abs(relative - 1.05) < 0.55)
    if chosen.sum() < FINISHES.min_px:
        return None
    sky = FOOTPRINTS.mirrored * diffuse * picture.model.zenith_radiance
    body, relative = picture.channels[piece.window][chosen].astype(np.float64) - sky, relative[chosen]
    low, high = np.quantile(relative, [0.25, 0.75])
    difference = body[relative >= high].mean(axis=0) - body[relative <= low].mean(axis=0)
    spectrum, direct = body.mean(axis=0), 1.0 - diffuse
    coloured, flat = np.linalg.lstsq(np.stack([spectrum * direct, direct], axis=1), difference, rcond=None)[0]
    coloured_mean, flat_mean = float(coloured * (spectrum * direct).mean()), float(flat * direct.mean())
    contrast = float(np.linalg.norm(difference)) / max(float(np.linalg.norm(spectrum)), 1e-9)
    return flat_mean / max(abs(coloured_mean + flat_mean), 1e-9), contrast


def judge_finish(
    verdict: Verdict, picture: Picture, level: Level, difference: tuple[float, float] | None
) -> None:
    # Add the finish of a roof and its evidence to the verdict; without evidence it stays unknown.
    spectrum, zenith = verdict.measures.spectrum, picture.zenith
    if (
        not verdict.measures.pixels
        or zenith is None
        or picture.direct_share < FINISHES.min_direct
        or zenith > FINISHES.max_zenith_deg
        or float(spectrum.mean()) < FINISHES.min_level
    ):
        return
    solid = picture.direct_share * change_with_lean(zenith)
    across, along = level.across_change, level.along_change
    low, high = FINISHES.solid_zenith_deg
    changes = f"its light changes by {np.radians(level.lean_change):.1%} a degree of lean"
    if across > FINISHES.metallic_across * solid + FINISHES.offset or (
        zenith >= high and along > FINISHES.metallic_along * solid + FINISHES.offset
    ):
        verdict.finish = "metallic"
        verdict.reasons.append(f"metallic: {changes}, that of solid paint by {np.radians(solid):.1%}")
    elif low <= zenith <= high and level.lean_change < FINISHES.max_solid_change:
        verdict.finish = "solid"
        verdict.reasons.append(f"solid: {changes}; flakes so near the sun's mirror image change more")
    elif difference is not None and spectrum.std() > FINISHES.min_colour * spectrum.mean():
        # coloured paint: by the difference of its bright and its dark part
        share, contrast = difference
        is_solid = (
            zenith <= FINISHES.max_coloured_zenith_deg
            and across < FINISHES.max_coloured[0] * solid
            and along < FINISHES.max_coloured[1] * solid
            and abs(share) < FINISHES.max_flat_share
        )
        text = f"{abs(share):.0%} of the difference between its bright and its dark part is grey"
        if contrast >= FINISHES.min_contrast and share > FINISHES.metallic_flat_share:
            verdict.finish = "metallic"
            verdict.reasons.append(f"metallic: {text}, and flakes mirror all colours")
        elif contrast >= FINISHES.min_contrast and is_solid:
            verdict.finish = "solid"
            verdict.reasons.append(f"solid: only {text}, and flakes would mirror all colours")


# --- cars and their parts ----------------------------------------------------------------------------------

#: Rank of a roof between windows, or behind a windscreen, on a footprint of one car.
_CERTAIN = 5


class Car(NamedTuple):
    # Pieces of the picture that belong to one car, its footprint and its roof.
    pieces: list[Piece]
    #: Footprint around one of the pieces; None where its colour extends farther than a car.
    footprint: Footprint | None = None
    roof: Roof | NoRoof = NoRoof("its colour extends farther than a car: it may not belong to one", False)

    @property
    def is_car(self) -> bool:
        # Whether windows show that the footprint is a car.
        return self.roof.is_car if isinstance(self.roof, NoRoof) else True

    @property
    def size(self) -> int:
        # Number of pixels.
        return 0 if self.footprint is None else int(self.footprint.area.sum())

    @property
    def rank(self) -> tuple[int, int]:
        # Certainty of the roof, `_CERTAIN` at most, and the size.
        if self.footprint is None or isinstance(self.roof, NoRoof):
            return int(self.footprint is not None) + int(self.is_car), self.size
        if not self.footprint.is_one_car:
            return 3, self.size
        return _CERTAIN - int(not (self.roof.complete or self.roof.sided)), self.size

    def unless_larger(self, max_size: float) -> Car:
        # Return the car, without a roof where it has more pixels than cars have.
        reason = "it is larger than other cars: several of one colour may touch; draw a region by hand"
        return self if self.size <= max_size else self._replace(roof=NoRoof(reason, False))


def find_cars(pieces: Iterable[Piece], picture: Picture) -> list[Car]:
    # Return the cars around pieces of paint, the most certain first.
    #
    # The largest pieces are examined first, those as dark as windows last. A piece with a certain roof is a
    # car. A piece with less evidence is a car only outside the certain cars.
    car_park = _CarPark(picture)

    def order(piece: Piece) -> tuple[bool, int, tuple[int, int], int]:
        level = float(np.median(picture.level[piece.window][piece.inside]))
        return level < SURFACES.dark, -int(piece.inside.sum()), piece.origin, piece.body

    # certain cars with paint of narrow brightness, then again without footprints larger than most cars
    narrow, wide = JOININGS[:4], JOININGS[4:]
    uncertain = car_park.add_certain([Car([piece]) for piece in sorted(pieces, key=order)], narrow, np.inf)
    sizes = [car.size for car in car_park.cars]
    max_size = CARS.max_size * float(np.median(sizes)) if len(sizes) >= CARS.min_sizes else np.inf
    uncertain += car_park.add_certain(
        [Car([piece]) for piece in car_park.remove_larger(max_size)], narrow, max_size
    )
    # certain cars with paint of wide brightness, then the best uncertain ones beside them
    uncertain = car_park.add_certain([car.unless_larger(max_size) for car in uncertain], wide, max_size)
    for car in sorted(uncertain, key=lambda car: car.rank, reverse=True):
        if not car_park.assign(car.pieces[0]):
            car_park.add(car)
    return car_park.cars


class _CarPark:
    # Cars of a picture, and maps of the car number of every pixel, -1 without a car
    def __init__(self, picture: Picture) -> None:
        self.cars: list[Car] = []
        self._picture = picture
        self._area = np.full(picture.level.shape, -1, np.int32)
        self._paint = self._area.copy()

    def add_certain(
        self, cars: list[Car], joinings: Sequence[tuple[bool, bool, bool]], max_size: float
    ) -> list[Car]:
        # Add the certain cars around pieces; return the best cars around the other pieces
        uncertain = []
        for best in cars:
            piece = best.pieces[0]
            if self.assign(piece):
                continue
            colour = np.median(self._picture.without_sky(piece.window)[piece.inside], axis=0)
            for footprint in footprints_of(piece.inside, piece.origin, colour, self._picture, joinings):
                car = Car(
                    [piece], footprint, find_roof(footprint, self._picture.level[footprint.window])
                ).unless_larger(max_size)
                best = max(best, car, key=lambda car: car.rank[0])
                if best.rank[0] == _CERTAIN:
                    break
            if best.rank[0] == _CERTAIN:
                self.add(best)
            else:
                uncertain.append(best)
        return uncertain

    def remove_larger(self, max_size: float) -> list[Piece]:
        # Remove cars with more pixels, which are several cars side by side; return their pieces
        is_kept = [car.size <= max_size for car in self.cars]
        # new number of every car; the last entry keeps -1
        numbers = np.append(np.where(is_kept, np.cumsum(is_kept) - 1, -1), -1).astype(np.int32)
        self._area, self._paint = numbers[self._area], numbers[self._paint]
        removed = [car for car, keep in zip(self.cars, is_kept, strict=True) if not keep]
        self.cars = [car for car, keep in zip(self.cars, is_kept, strict=True) if keep]
        return [piece for car in removed for piece in car.pieces]

    def assign(self, piece: Piece) -> bool:
        # Assign a piece to the car on whose paint or area it lies; return whether there is such a car
        for car_numbers, min_share in (
            (self._paint, CARS.min_piece_share),
            (self._area, CARS.min_window_share),
        ):
            numbers = car_numbers[piece.window][piece.inside]
            if (numbers >= 0).mean() > min_share:
                self.cars[int(np.bincount(numbers[numbers >= 0]).argmax())].pieces.append(piece)
                return True
        return False

    def add(self, car: Car) -> None:
        # Add a piece to the car that its footprint overlaps most, or as a new car
        footprint = car.footprint
        if footprint is not None:
            numbers = self._area[footprint.window][footprint.area]
            shared = np.bincount(numbers[numbers >= 0], minlength=1)
            overlapped = int(shared.argmax())
            smaller = min(car.size, self.cars[overlapped].size) if shared.any() else 0
            if shared[overlapped] > CARS.min_overlap * smaller:
                self.cars[overlapped].pieces.extend(car.pieces)
                return
        self.cars.append(car)
        if footprint is not None and car.is_car:
            # other footprints, such as unusual ground, get no further pieces
            for car_numbers, mask in (
                (self._area, footprint.area),
                (self._paint, footprint.area & footprint.paint),
            ):
                view = car_numbers[footprint.window]
                view[mask & (view < 0)] = len(self.cars) - 1


def judge_car(car: Car, picture: Picture, limits: Limits) -> list[Verdict]:
    # Return the verdicts on a car's roof and on the other pieces of its paint; at most one is proposed.
    roof = (
        _judge_roof(car.footprint, car.roof, picture, limits)
        if isinstance(car.roof, Roof) and car.footprint is not None
        else None
    )
    parts = [_judge_part(piece, car, picture, limits) for piece in car.pieces]
    verdicts = parts if roof is None else [roof, *parts]
    for verdict in verdicts:
        if doubt := doubt_about_clouds(verdict.piece.window, picture):
            verdict.objections.append(doubt)
    best = roof if roof is not None and not roof.objections else None
    if best is None and roof is not None and roof.measures.pixels:
        # an error of the level position affects the other parts, too
        for part in parts:
            part.objections.append("the roof of the same car is refused")
    elif best is None:
        best = max((part for part in parts if not part.objections), key=lambda part: part.score, default=None)
    if best is not None:
        y, x = best.piece.centre
        objection = f"another part of the same car is better: the one at line {y:.0f}, column {x:.0f}"
        for part in parts:
            if part is not best and not part.objections:
                part.objections.append(objection)
    return verdicts


def _judge_roof(footprint: Footprint, roof: Roof, picture: Picture, limits: Limits) -> Verdict | None:
    # Verdict on a roof; None where all its pixels are near edges
    #
    # Its pixels are away from other colours. Pixels brighter than the car's other paint count as paint: they
    # lie in the lobe of flakes, or in glint.
    paint = footprint.paint | (footprint.brightness >= FOOTPRINTS.brightness[0][1])
    inside = roof.inside & (distance_transform_edt(np.pad(paint, 1))[1:-1, 1:-1] > limits["erode"])
    lines, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    if not lines.size:
        piece = None
    else:
        origin = (int(lines[0]) + footprint.origin[0], int(columns[0]) + footprint.origin[1])
        piece = Piece(0, origin, inside[lines[0] : lines[-1] + 1, columns[0] : columns[-1] + 1])
        segment = picture.model.segment[piece.window][piece.inside]
        body = picture.model.body[segment[segment >= 0]]
        piece = piece._replace(body=int(np.bincount(body).argmax())) if body.size else None
    if piece is None:
        return None
    y, x = piece.origin[0] - footprint.origin[0], piece.origin[1] - footprint.origin[1]
    brightness = footprint.brightness[window_of((y, x), piece.inside)]
    prior = lean_to_sun(roof.axis, picture.shadow_side)
    lit = piece.inside & (picture.layers["blocked_direct"][piece.window] < limits["shadow"])
    # where it is level, by its edges, and by the height model
    place = level_place(footprint, roof)
    centre = (place.line - y, place.column - x)
    rake, shift, angle = measured_lean(
        picture.heights, piece.window, piece.inside, centre, prior, picture.shadow_side
    )
    place = place._replace(line=centre[0] + shift[0], column=centre[1] + shift[1])
    text = f"by the height model it leans by {angle:+.1f} degrees towards the sun"
    reasons = [roof.reason, *([text] if np.isfinite(angle) else [])]
    level, objection = None, f"{text}, and has no level position; draw a region on a level part"
    lines, columns = piece.inside.shape
    is_inside = -1.0 <= place.line <= lines and -1.0 <= place.column <= columns
    if is_inside or not np.isfinite(angle):
        level = level_light(brightness, lit, place, roof.axis)
        objection = "too few lit pixels near the level position of the roof for its brightness"
    if level is None:
        return Verdict(piece, measured(piece, picture, limits), "roof", 0.0, reasons, [objection])
    # pixels near the level brightness; a wider range where these are too few
    relative = brightness / level.brightness
    for factor in CARS.wider:
        widened = {"glint": np.inf, "adjacency": np.inf, "brightness": factor * limits["brightness"]}
        measures = measured(piece, picture, {**limits, **widened}, relative)
        if measures.pixels >= limits["min_pixels"]:
            break
    # mean difference of the usable pixels from the level position
    offset = float(relative[measures.usable].mean()) - 1.0 if measures.pixels else 0.0
    level = level._replace(sd=float(np.hypot(level.sd, offset)))
    verdict = Verdict(piece, measures, "roof", reasons=reasons)
    judge_pixels(verdict, limits)
    judge_level(verdict, picture, rake, level)
    judge_finish(verdict, picture, level, difference_of(piece, picture, relative))
    if verdict.finish == "metallic":
        verdict.kind = "metallic"
    _judge_windows(verdict, footprint, roof, picture)
    return verdict


def _judge_windows(verdict: Verdict, footprint: Footprint, roof: Roof, picture: Picture) -> None:
    level = picture.level[footprint.window]
    paint_level = float(np.nanmedian(level[footprint.paint & footprint.area]))
    step = paint_level - roof.window_level
    if step < max(JUDGING.min_window_step, JUDGING.min_window_contrast * paint_level):
        verdict.objections.append(
            f"the windows beside it are darker by only {step:.4f}: it may itself be a window; draw a region "
            "by hand"
        )
    if paint_level >= SURFACES.dark:
        return
    other_paint = level[footprint.paint & footprint.area & ~roof.inside]
    ratio = np.nanmedian(level[roof.inside]) / np.nanmedian(other_paint) if other_paint.size else np.nan
    if not ((roof.complete or roof.sided) and JUDGING.dark_roof[0] < ratio < JUDGING.dark_roof[1]):
        verdict.objections.append(
            "a dark roof needs the same paint beyond both its windows, or a bonnet before its windscreen and "
            "side windows: this may be a window or a bed; draw a region by hand"
        )


def _judge_part(piece: Piece, car: Car, picture: Picture, limits: Limits) -> Verdict:
    measures = measured(piece, picture, limits)
    spectrum, mean_level = measures.spectrum, float(measures.spectrum.mean()) if measures.pixels else 0.0
    if not car.is_car or car.footprint is None:
        return Verdict(piece, measures, objections=[car.roof.reason], scenery=mean_level < SURFACES.dark)
    verdict = Verdict(piece, measures, "panel")
    if car.rank[0] < _CERTAIN:
        verdict.objections.append(
            "its car has no certain roof: it may belong to another car, or be ground between cars; draw a "
            "region by hand"
        )
    verdict.reasons.append("part of a car with windows across it and along it")
    judge_pixels(verdict, limits)
    assumed = Level(along_change=JUDGING.unseen_change * picture.direct_share, is_measured=False)
    judge_level(verdict, picture, JUDGING.panel_deg, assumed)
    if measures.pixels:
        # colour and brightness like the car's other paint
        of_roof = car.roof.inside if isinstance(car.roof, Roof) else car.footprint.paint & car.footprint.area
        car_spectrum = np.nanmedian(picture.channels[car.footprint.window][of_roof], axis=0)
        slope = picture.direct_share * float(
            np.tan(np.radians(45.0 if picture.zenith is None else picture.zenith))
        )
        ratio = float(spectrum.mean() / car_spectrum.mean())
        allowed = max(CARS.max_step, CARS.max_lean * slope)
        if _cosine(spectrum, car_spectrum) < FOOTPRINTS.min_cosine:
            verdict.objections.append(
                "its colour differs from the car's paint: it may be a window, a bed or a load"
            )
        elif abs(ratio - 1.0) > allowed:
            verdict.objections.append(
                f"it is {ratio:.2f} times as bright as the car's other paint, while lean explains at most "
                f"{allowed:.0%}: it may be a shadow, a bed, or paint with flakes; draw a region on the roof"
            )
        # a spectrum like the ground's, lit or in shade
        max_length = float(np.exp(FOOTPRINTS.max_ground_log_ratio)) * float(np.linalg.norm(picture.ground))
        is_like_ground = _cosine(spectrum, picture.ground) > FOOTPRINTS.min_cosine
        if is_like_ground and float(np.linalg.norm(spectrum)) < max_length:
            verdict.objections.append(
                "it has the colour of the ground, and is no brighter; draw a region by hand"
            )
    if mean_level < SURFACES.dark:
        verdict.objections.append("it is as dark as a window, and not the roof")
    return verdict


def _cosine(first: Floats, second: Floats) -> float:
    return float(first @ second) / max(float(np.linalg.norm(first) * np.linalg.norm(second)), 1e-9)
