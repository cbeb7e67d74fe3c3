"""Candidate regions: connected pieces of one body, their measures, and the light and lean of a piece."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import dask
import numpy as np
import xarray as xr
from scipy.ndimage import binary_opening, find_objects, label, uniform_filter

from hyperpaint.base.schema import (
    ALONG_TRACK,
    BAND,
    CROSS_TRACK,
    IRRADIANCE_TIME,
    Array,
    Bools,
    Floats,
    Quality,
)
from hyperpaint.light.sun import diffuse_fraction
from hyperpaint.surroundings import SceneModel
from hyperpaint.surroundings.light_split import split_of
from hyperpaint.surroundings.model import SHADED
from hyperpaint.surroundings.segments import padded
from hyperpaint.surroundings.surveying import is_vegetation

from .proposal_rules import FOOTPRINTS, GAPS, LEANS, SURFACES

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
