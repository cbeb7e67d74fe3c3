"""Inputs and outputs of the trace of a block of lines."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hyperpaint.base.arrays import Array

from .hierarchy import Geometry
from .path_codes import CLEAR_SKY_FUNCTIONS, FIRST_DIGIT, MAX_SUNS, USABLE_BITS
from .surfaces import Surfaces


class Rays(NamedTuple):
    """Camera position and view for the lines of a block.

    Attributes
    ----------
    origin : (line, 2, 3) float64
        Positions at start and end of the exposure [m].
    rotation : (line, 2, 3, 3) float64
        Rotations from the camera's axes (forward, right, down) to the scene's, at start and end.
    column_edges : (column + 1,) float64
        Tangents of the edges of columns, across the track.
    along_edges : (2,) float64
        Tangents of the rear and front edge of a line, along the track.
    """

    origin: Array
    rotation: Array
    column_edges: Array
    along_edges: Array


class Sources(NamedTuple):
    """Light sources besides the uniform sky.

    Attributes
    ----------
    suns : (sun, 3) float64
        Unit vectors towards the suns.
    sun_radius : (sun,) float64
        Angular radius [rad]; 0 for a point.
    overcast : bool
        Whether to record the overcast sky besides the uniform sky.
    shapes : (sun, function, 8) float64
        Coefficients of the functions of clear skies, see `hyperpaint.light.sky_functions`; empty without
        clear skies.
    """

    suns: Array
    sun_radius: Array
    overcast: bool
    shapes: Array = np.zeros((0, CLEAR_SKY_FUNCTIONS, 8))


class Block(NamedTuple):
    """Recorded paths and labels, allocated by the caller. NaN (labels: -1) if all samples show the sky.

    Attributes
    ----------
    weight : (line, slot, column) float32
        Weights w [1]; 0 in empty slots.
    code : (line, slot, column) int64
        Codes, ascending; -1 in empty slots, which are the last.
    material, instance : (line, column) int32
        Labels of the pair that most samples hit first; the smaller numbers if several pairs have as many
        samples.
    purity : (line, column) float32
        Share of the samples that hit this pair first [1].
    distance : (line, column) float32
        Mean distance of the first hits [m].
    position : (line, 3, column) float64
        Mean position of the first hits [m].
    sun_visibility : (line, sun, column) float32
        Share of the first hits that face a sun which is not occluded [1].
    incidence : (line, sun, column) float32
        Mean over the first hits of the cosine between normal and sun, 0 for hits that face away [1].
    """

    weight: Array
    code: Array
    material: Array
    instance: Array
    purity: Array
    distance: Array
    position: Array
    sun_visibility: Array
    incidence: Array

    @classmethod
    def empty(cls, lines: int, slots: int, columns: int, suns: int) -> Block:
        """Return an uninitialised block.

        Examples
        --------
        >>> Block.empty(2, 48, 640, 1).weight.shape
        (2, 48, 640)
        """
        return cls(*(np.empty(shape, kind) for shape, kind in _layout(lines, slots, columns, suns)))


class Settings(NamedTuple):
    """Plain numbers of a trace.

    Attributes
    ----------
    first_line
        Number of the block's first line in the flight line, so that random numbers do not depend on blocks.
    samples
        Number of paths of a pixel.
    depth
        Maximum number of scatterings.
    digit_bits
        Bits of a factor in a code.
    seed
        Non-negative integer.
    """

    first_line: int
    samples: int
    depth: int
    digit_bits: int
    seed: int


def _layout(lines: int, slots: int, columns: int, suns: int) -> list[tuple[tuple[int, ...], type]]:
    by_pixel, by_slot, by_sun = (lines, columns), (lines, slots, columns), (lines, suns, columns)
    return [
        (by_slot, np.float32),
        (by_slot, np.int64),
        (by_pixel, np.int32),
        (by_pixel, np.int32),
        (by_pixel, np.float32),
        (by_pixel, np.float32),
        ((lines, 3, columns), np.float64),
        (by_sun, np.float32),
        (by_sun, np.float32),
    ]


def check(
    geometry: Geometry, surfaces: Surfaces, sources: Sources, rays: Rays, settings: Settings, block: Block
) -> None:
    """Refuse inputs that compiled loops cannot handle.

    Raises
    ------
    ValueError
        Inputs are inconsistent; the message lists all faults.
    """
    faults = []
    first_line, samples, depth, digit_bits, seed = settings
    if FIRST_DIGIT + depth * digit_bits > USABLE_BITS:
        faults.append(f"{depth} factors of {digit_bits} bits do not fit a code of {USABLE_BITS} bits")
    if min(samples, depth, digit_bits) < 1 or min(seed, first_line) < 0:
        faults.append("samples, depth and digit_bits must be positive, seed and first_line not negative")
    if seed >= 2**63 or max(first_line + len(rays.origin), samples) > 2**32:
        faults.append("seed must fit 63 bits, the numbers of lines and samples 32")
    suns = len(sources.suns)
    if suns > MAX_SUNS or np.shape(sources.sun_radius) != (suns,) or np.shape(sources.suns) != (suns, 3):
        faults.append(
            f"suns {np.shape(sources.suns)} with radii {np.shape(sources.sun_radius)}; at most {MAX_SUNS}"
        )
    elif np.size(sources.shapes) and np.shape(sources.shapes) != (suns, CLEAR_SKY_FUNCTIONS, 8):
        faults.append(f"shapes {np.shape(sources.shapes)} of clear skies for {suns} suns")
    elif not np.allclose(np.linalg.norm(sources.suns, axis=1), 1.0, atol=1e-6):
        faults.append("directions to suns must be unit vectors")
    if len({len(array) for array in surfaces}) > 1:
        faults.append("surfaces have parts of unequal length")
    index, shares = surfaces.numbers[:, 0], surfaces.numbers[:, 1:6]
    if not (np.isfinite(index).all() and ((shares >= 0) & (shares <= 1)).all() and (shares[:, 4] > 0).all()):
        faults.append("refractive indices must be finite, roughness, slopes and shares from 0 to 1")
    factors = int(max(factor.max(initial=-1) for factor in surfaces[1:])) + 1
    if factors >= 1 << digit_bits:
        faults.append(f"{factors} factors need more than {digit_bits} bits")
    if surfaces.base_factor.min(initial=0) < 0:
        faults.append("every surface needs a base factor")
    if geometry.face_instance.min(initial=0) < 0:
        faults.append("instances must not be negative: -1 is the sky")
    material = geometry.face_material
    if material.size and not (material.min() >= 0 and material.max() < len(surfaces.base_factor)):
        faults.append(
            f"faces name materials {material.min()} to {material.max()} of {surfaces.base_factor.size}"
        )
    lines, columns = len(rays.origin), len(rays.column_edges) - 1
    if rays.origin.shape != (lines, 2, 3) or rays.rotation.shape != (lines, 2, 3, 3):
        faults.append(f"origins {rays.origin.shape} and rotations {rays.rotation.shape} do not fit")
    if not all(np.isfinite(array).all() for array in rays):
        faults.append("positions, rotations and edges of the camera must be finite")
    layout = _layout(lines, block.weight.shape[1], columns, suns)
    for name, array, (shape, kind) in zip(block._fields, block, layout, strict=True):
        if array.shape != shape or array.dtype != kind or not array.flags.c_contiguous:
            faults.append(
                f"block.{name} must be contiguous {shape} {kind.__name__}, not {array.shape} {array.dtype}"
            )
    if faults:
        raise ValueError("; ".join(faults))
