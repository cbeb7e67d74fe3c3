"""Candidate regions: surfaces by their spectra, connected pieces of one body, and measures of a piece."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_opening, find_objects, label, uniform_filter

from hyperpaint.base.arrays import Array, Bools, Floats
from hyperpaint.base.schema import Quality
from hyperpaint.surroundings import SceneModel
from hyperpaint.surroundings.model import SHADED
from hyperpaint.surroundings.surveying import is_vegetation

from .between_clouds import FreeSun
from .leans import HeightModel
from .proposal_rules import SURFACES


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Classes of the segments of a scene model by their spectra."""

    level: Floats  #: (segment,): Mean reflectance [1].
    ground: Bools  #: (segment,): Whether it has the spectrum of the largest body.
    vegetation: Bools  #: (segment,): Whether it has the spectrum of leaves.

    @classmethod
    def of(cls, model: SceneModel) -> Surfaces:
        """Return the surfaces of a scene model."""
        spectrum = np.nan_to_num(model.spectrum)
        reference = np.nan_to_num(model.reference)
        lengths = np.linalg.norm(reference, axis=1, keepdims=True)
        direction = reference / np.maximum(lengths, 1e-9)
        ground = np.zeros(0, bool)
        if model.segments:
            # ground: the largest body, and segments with its spectrum
            largest = largest_body(model)
            relative_length = lengths[:, 0] / max(float(lengths[largest, 0]), 1e-9)
            has_ground_spectrum = (direction @ direction[largest] > SURFACES.min_ground_cosine) & (
                np.abs(np.log(np.maximum(relative_length, 1e-9))) < SURFACES.max_ground_log_ratio
            )
            ground = np.asarray(has_ground_spectrum | (model.body == largest))
        return cls(spectrum.mean(axis=1), ground, is_vegetation(model.spectrum, model.channel_wavelength))


def largest_body(model: SceneModel) -> int:
    """Return the number of the body with most pixels, which is assumed to be the ground."""
    return int(np.argmax(np.bincount(model.body, weights=model.size, minlength=model.segments)))


#: Flags of pixels without a valid spectrum.
_INVALID = Quality.SATURATED | Quality.IRRADIANCE_GAP | Quality.NO_DATA | Quality.OFF_SWATH


@dataclass(frozen=True)
class Limits:
    """Limits for the pixels of a region: the arguments of `propose_regions`."""

    erode: int
    glint: float
    shadow: float
    adjacency: float
    brightness: float
    angle: float
    min_pixels: int


class Picture(NamedTuple):
    """A flight line prepared for proposals."""

    model: SceneModel  #: Its scene model.
    channels: Array  #: (line, column, channel): Reflectance in the model's channels [1].
    #: ``glint_fraction``, ``blocked_direct``, ``adjacency`` and ``quality`` (line, column).
    layers: Mapping[str, Array]
    zenith: float | None  #: Zenith angle of the sun [degree]; None where unknown.
    shadow_side: Floats | None = None  #: (2,): Direction (line, column) of shadows; None where unknown.
    heights: HeightModel | None = None  #: Heights of the line, if it has them.
    sun: FreeSun | None = None  #: Free sun between clouds in the record; None where clouds were not broken.


def window_of(origin: tuple[int, int], mask: Bools) -> tuple[slice, slice]:
    """Return the window of a mask in the picture, from the line and column of its first pixel."""
    (y, x), (lines, columns) = origin, mask.shape
    return slice(y, y + lines), slice(x, x + columns)


class Piece(NamedTuple):
    """A connected part of a body, away from other bodies."""

    body: int  #: Segment of the scene model.
    origin: tuple[int, int]  #: Line and column of the first pixel of ``inside``.
    inside: Bools  #: (line, column): Its pixels.

    @property
    def window(self) -> tuple[slice, slice]:
        """Window of the piece in the picture."""
        return window_of(self.origin, self.inside)

    @property
    def centre(self) -> Floats:
        """Line and column of its centre, (2,)."""
        return np.asarray(np.argwhere(self.inside).mean(axis=0) + np.array(self.origin, np.float64))


class Measures(NamedTuple):
    """Measures of a piece."""

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


def pieces(model: SceneModel, erode: int, min_pixels: int) -> Iterator[Piece]:
    """Yield the connected parts of bodies with at least ``min_pixels`` pixels, in order of bodies and lines.

    Pixels in shade or within ``erode`` pixels of an edge belong to no part.
    """
    body = np.append(model.body, np.int32(-1))[model.segment]
    shaded = np.append(model.state == SHADED, False)[model.segment]
    # numbers from 1 on, as scipy.ndimage expects them
    labels = np.where((model.edge_distance > erode) & ~shaded & (body >= 0), body + 1, 0)
    is_large = np.bincount(labels.ravel(), minlength=model.segments + 1) >= min_pixels
    for number, window in enumerate(find_objects(labels, max_label=model.segments)):
        if window is None or not is_large[number + 1]:
            continue
        piece_labels, count = label(labels[window] == number + 1)
        for piece_label, inner in zip(range(1, count + 1), find_objects(piece_labels), strict=True):
            mask = piece_labels[inner] == piece_label
            if mask.sum() >= min_pixels:
                y, x = (int(a.start + b.start) for a, b in zip(window, inner, strict=True))
                yield Piece(number, (y, x), mask)


def measured(piece: Piece, picture: Picture, limits: Limits, brightness: Floats | None = None) -> Measures:
    """Return the measures of a piece, with the pixels that a region can use.

    ``brightness`` (line, column): brightness in the piece's window, relative to the level part [1]; by
    default computed here, relative to its median.
    """
    layers = {name: layer[piece.window] for name, layer in picture.layers.items()}
    spectra = picture.channels[piece.window].astype(np.float64)
    inside = piece.inside & np.isfinite(spectra).all(axis=2)
    excluded: dict[str, Bools] = {
        "without data": ~inside,
        "flagged invalid": (layers["quality"] & np.uint16(_INVALID)) != 0,
        "glint": ~(layers["glint_fraction"] <= limits.glint),
        "shadow": ~(layers["blocked_direct"] < limits.shadow),
        "adjacency": ~(_smoothed(layers["adjacency"], inside) <= limits.adjacency),
    }
    lit = inside & ~excluded["shadow"]
    piece_brightness, max_reflectance = _brightness(spectra, lit)
    brightness = piece_brightness if brightness is None else _smoothed(brightness, lit)
    # on dark paint a tilt changes reflectance by little, and noise exceeds a relative limit
    allowed = max(limits.brightness, SURFACES.min_change / max(max_reflectance, 1e-6))
    excluded["another tilt"] = ~(np.abs(brightness - 1.0) <= allowed)
    usable = piece.inside.copy()
    lost = {}
    for reason, mask in excluded.items():
        lost[reason] = float((usable & mask).sum() / piece.inside.sum())
        usable &= ~mask
    usable = _largest(usable)
    lost = {name: share for name, share in lost.items() if share}
    count = int(usable.sum())
    if not count:
        return Measures(usable, np.full(spectra.shape[2], np.nan), lost)
    values = spectra[usable]
    median_spectrum = np.median(values, axis=0)
    length = np.linalg.norm(values, axis=1) * np.linalg.norm(median_spectrum)
    angles = np.degrees(np.arccos(np.clip(values @ median_spectrum / np.maximum(length, 1e-12), -1.0, 1.0)))
    low, high = np.quantile(brightness[usable], [0.05, 0.95])
    # steps between neighbouring pixels along both axes
    pairs = (usable[1:] & usable[:-1], usable[:, 1:] & usable[:, :-1])
    steps = np.concatenate([np.abs(np.diff(brightness, axis=axis))[pairs[axis]] for axis in (0, 1)])
    glint, shadow, adjacency = (
        float(layers[name][usable].mean()) for name in ("glint_fraction", "blocked_direct", "adjacency")
    )
    return Measures(
        usable,
        median_spectrum,
        lost,
        pixels=count,
        angle=float(np.median(angles)),
        spread=0.5 * float(high - low),
        slope=float(np.median(steps)) if steps.size else 0.0,
        glint=glint,
        shadow=shadow,
        adjacency=adjacency,
    )


def _smoothed(values: Array, valid: Bools) -> Floats:
    # Mean of the valid values in the square around every pixel (line, column); NaN without valid values
    valid = valid & np.isfinite(values)
    total = uniform_filter(
        np.where(valid, values, 0.0).astype(np.float64), SURFACES.square_px, mode="constant"
    )
    count = uniform_filter(valid.astype(np.float64), SURFACES.square_px, mode="constant")
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(valid, total / count, np.nan)


def _brightness(spectra: Floats, valid: Bools) -> tuple[Floats, float]:
    # Brightness of pixels relative to its median (line, column); largest reflectance of the median spectrum
    if not valid.any():
        return np.full(valid.shape, np.nan), np.nan
    median_spectrum = np.median(spectra[valid], axis=0)
    smoothed = _smoothed(
        spectra @ (median_spectrum / max(float(median_spectrum @ median_spectrum), 1e-12)), valid
    )
    return smoothed / float(np.median(smoothed[valid])), float(median_spectrum.max())


def _largest(mask: Bools) -> Bools:
    # Largest connected set of pixels, without parts narrower than three pixels
    opened = binary_opening(mask, np.ones((3, 3), bool))
    sets, count = label(opened)
    if not count:
        return np.zeros_like(mask)
    return np.asarray(sets == 1 + int(np.argmax(np.bincount(sets.ravel())[1:])))
