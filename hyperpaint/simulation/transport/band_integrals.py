"""Integrals of a source's spectrum times the factors of a path over the responses of bands."""

from __future__ import annotations

import numpy as np

from hyperpaint.base.arrays import Array
from hyperpaint.base.jit import kernel

__all__ = ["integrate_bands"]


@kernel
def integrate_bands(
    factors: Array, chosen: Array, source: Array, weights: Array, first_band: Array, out: Array
) -> None:
    """Integrate the products of paths over bands.

    Each path is done by itself and in the order of the wavelengths, so that its result does not depend on
    the paths it comes with.

    Parameters
    ----------
    factors : (factor, grid), float64
        Spectra.
    chosen : (path, digit), int64
        Factors of every path; -1 for none.
    source : (path,), int64
        Row of ``weights``; -1 for a source without light.
    weights : (source, node, grid, width), float64
        Integral of response x source x the basis function of a grid point, for the bands from ``first_band``.
    first_band : (grid,), int64
        First of the ``width`` bands that a grid point counts for.
    out : (node, path, band), float32
        Written.
    """
    grid, width = weights.shape[2], weights.shape[3]
    nodes, bands = out.shape[0], out.shape[2]
    product = np.empty(grid, np.float64)
    total = np.empty(bands, np.float64)
    for path in range(chosen.shape[0]):
        product[:] = 1.0
        for digit in range(chosen.shape[1]):
            factor = chosen[path, digit]
            if factor >= 0:
                for point in range(grid):
                    product[point] *= factors[factor, point]
        for node in range(nodes):
            total[:] = 0.0
            if source[path] >= 0:
                row = weights[source[path], node]
                for point in range(grid):
                    first, value = first_band[point], product[point]
                    for band in range(width):
                        total[first + band] += row[point, band] * value
            for band in range(bands):
                out[node, path, band] = total[band]
