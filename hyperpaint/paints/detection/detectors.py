"""Scores of spectra against paints, and distances of spectra from paints: plain arrays, float64."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from hyperpaint.base.arrays import Array, Floats

METHODS = ("ace", "matched_filter", "spectral_angle")


class Projection(NamedTuple):
    """Linear map of spectra in which they are compared: z = (x - offset) matrix."""

    offset: Floats  #: (band,)
    matrix: Floats  #: (band, band): whitens, and takes the mirrored sky away
    targets: Floats  #: (signature, band): the paints, projected


def projection(
    paints: Floats, sky: Floats | None, mean: Floats | None = None, covariance: Floats | None = None
) -> Projection:
    """Return the projection of a detector.

    Parameters
    ----------
    paints : (signature, band)
        Reflectance.
    sky : (band,), or None
        Spectrum of the mirrored sky, which is projected out; None to keep it.
    mean, covariance : (band,), (band, band)
        Statistics of the background; None for the spectral angle, which does not use them.
    """
    bands = paints.shape[1]
    offset = np.zeros(bands) if mean is None else mean
    # covariance = L L', z = L^-1 (x - mean) has unit covariance
    whitening = np.eye(bands)
    if covariance is not None:
        whitening = solve_triangular(np.linalg.cholesky(covariance), whitening, lower=True).T
    matrix = whitening
    if sky is not None:
        direction = sky @ whitening
        direction /= np.linalg.norm(direction)
        matrix = whitening - np.outer(whitening @ direction, direction)
    return Projection(offset, np.ascontiguousarray(matrix), (paints - offset) @ matrix)


def scores(spectra: Floats, project: Projection, method: str) -> Floats:
    """Return the scores (spectrum, signature) of spectra (spectrum, band), by one of `METHODS`.

    With z and t the projected spectrum and paint: ACE is (z't)^2 / (z'z t't) with the sign of z't, the
    matched filter z't / t't, the spectral angle's cosine z't / sqrt(z'z t't); 0 where z is zero.
    """
    z = (spectra - project.offset) @ project.matrix
    product = z @ project.targets.T
    target_square = np.einsum("kb,kb->k", project.targets, project.targets)
    if method == "matched_filter":
        return np.asarray(product / target_square)
    length = np.sqrt(np.einsum("nb,nb->n", z, z)[:, None] * target_square)
    cosine = np.divide(product, length, out=np.zeros_like(product), where=length > 0.0)
    return np.asarray(cosine * np.abs(cosine) if method == "ace" else cosine)


def distances(spectra: Floats, paints: Floats, sky: Floats | None) -> tuple[Array, Array]:
    r"""Return distance and level of spectra (spectrum, band) for each paint (signature, band).

    Least squares fit x = a t + m sky + rest; the level is a, the distance \|rest\| / \|a t\|, infinite where
    a is not positive. Both (spectrum, signature) [1].
    """
    product, square = spectra @ paints.T, np.einsum("nb,nb->n", spectra, spectra)
    paint_square = length = np.einsum("kb,kb->k", paints, paints)
    if sky is not None:
        unit = sky / np.linalg.norm(sky)
        of_sky = paints @ unit
        in_sky = spectra @ unit
        product = product - np.outer(in_sky, of_sky)
        square, paint_square = square - in_sky**2, paint_square - of_sky**2
    with np.errstate(invalid="ignore", divide="ignore"):
        level = product / paint_square
        rest = np.sqrt(np.maximum(square[:, None] - product * level, 0.0))
        distance = np.where(level > 0.0, rest / (level * np.sqrt(length)), np.inf)
    return distance, level
