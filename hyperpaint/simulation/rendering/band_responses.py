"""Exact band integrals of a source with sharp lines times factors that change slowly.

    INT E(lambda) rho(lambda) R_b(lambda) d lambda,   rho(lambda) = sum_k rho(lambda_k) phi_k(lambda)

A source has lines far narrower than any band, a product of reflectances has not: on points ``lambda_k``
0.5 nm apart it is its own cubic interpolation to 1e-6 and better. What is left of the integral for each band
and point, INT E phi_k R_b, is made once for a source, on a grid as fine as its lines; after that a path costs
a short sum for each point.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hyperpaint.base.arrays import Floats

from .bands import BandSet, cubic_weights

__all__ = ["BandResponses", "cell_means"]


_FACTOR_STEP = 0.5  # nm between the points at which products of reflectances are taken
_FINEST_STEP = 0.05  # nm at which responses are taken, or a hundredth of the sharpest


class BandResponses:
    """Responses of bands on grids: a coarse one for factors, a fine one for sources.

    Parameters
    ----------
    bands
        Of the camera.
    covered
        First and last wavelength at which sources are known [nm]; responses end there.
    normalise
        Integrals become means over the response; else they are INT L R d lambda as it is.

    Attributes
    ----------
    grid : (grid,)
        Where factors are taken [nm].
    fine : (fine,)
        Where sources are taken [nm].
    first_band : (grid,), int64
        First of the bands that a grid point counts for.
    width
        How many they are.
    """

    def __init__(
        self, bands: BandSet, covered: tuple[float, float] = (0.0, np.inf), *, normalise: bool = True
    ) -> None:
        self.bands, self._normalise = bands, normalise
        finest = min(_FINEST_STEP, float(bands.fwhm.min()) / 100.0)
        self._cell = max(1, round(_FACTOR_STEP / finest))
        self._fine_step = _FACTOR_STEP / self._cell
        low = int(np.floor(bands.lowest() / _FACTOR_STEP)) - 1
        nodes = bands.nodes
        starts = np.floor((bands.wavelength + nodes.min() - bands.reach) / _FACTOR_STEP).astype(np.int64)
        self._starts = starts - low
        self._cells = int(np.ceil((2 * bands.reach + np.ptp(nodes)) / _FACTOR_STEP)) + 1
        points = int(self._starts[-1]) + self._cells + 2
        self.grid: Floats = np.asarray((low + np.arange(points)) * _FACTOR_STEP, np.float64)
        fine = low * _FACTOR_STEP + np.arange(points * self._cell) * self._fine_step
        self.fine: Floats = np.asarray(fine, np.float64)
        self._inside = (self.fine >= covered[0]) & (self.fine <= covered[1])
        # cells reach one point back and two points on, by the cubic
        stops, places = self._starts + self._cells + 2, np.arange(points)
        first = np.searchsorted(stops, places, side="right")
        self.width = max(1, int((np.searchsorted(self._starts - 1, places, side="right") - first).max()))
        self.first_band = np.clip(first, 0, starts.size - self.width)

    def _responses(self, node: int) -> tuple[NDArray[np.int64], Floats]:
        """Return where a band's fine points lie, and its response x step there, both (band, point)."""
        bands = self.bands
        points = self._starts[:, None] * self._cell + np.arange(self._cells * self._cell)
        offset = self.fine[points] - (bands.wavelength + bands.nodes[node])[:, None]
        made = bands.line_shapes(offset, self._fine_step)
        if bands.responsivity is not None:
            made = made * np.asarray(bands.responsivity(self.fine))[points]
        made = made * (self._inside[points] * self._fine_step)
        if self._normalise:
            made /= made.sum(axis=1, keepdims=True)
        return points, made

    def weights(self, sources: Floats) -> Floats:
        """Return what grid points count for in the bands, shape (source, node, grid, width).

        Parameters
        ----------
        sources : (source, fine)
            Spectra of the sources; see `cell_means`.
        """
        shape = (len(sources), self.bands.nodes.size, self.grid.size, self.width)
        made = np.zeros(shape)
        grid_points = self._starts[:, None] - 1 + np.arange(self._cells + 3)
        band = np.arange(self._starts.size)[:, None] - self.first_band[grid_points]
        cubic = cubic_weights(np.arange(self._cell, dtype=np.float64) / self._cell)
        for node in range(shape[1]):
            points, responses = self._responses(node)
            for number, spectrum in enumerate(sources):
                lit = (responses * spectrum[points]).reshape(len(points), self._cells, self._cell)
                spread = np.zeros(grid_points.shape)
                # not a matrix product: the same bits whatever the threads of a BLAS
                for place, part in enumerate(np.einsum("bcp,pj->jbc", lit, cubic)):
                    spread[:, place : place + self._cells] += part
                made[number, node, grid_points, band] = spread
        return made

    def means(self, spectra: Floats) -> Floats:
        """Return what bands see of spectra on the fine grid, shape (spectrum, node, band)."""
        made = np.empty((len(spectra), self.bands.nodes.size, self._starts.size))
        for node in range(made.shape[1]):
            points, responses = self._responses(node)
            for number, spectrum in enumerate(spectra):
                made[number, node] = (responses * spectrum[points]).sum(axis=1)
        return made


def cell_means(wavelength: Floats, spectrum: Floats, grid: Floats) -> Floats:
    """Return the mean of a spectrum over the cells of an even grid; zero where it is not known.

    The spectrum is taken as linear between its points, however finer or coarser than the grid they are, and
    integrated exactly.

    Parameters
    ----------
    wavelength, spectrum : (point,)
        Points of the spectrum [nm].
    grid : (grid,)
        Centres of the cells [nm].

    Examples
    --------
    >>> line = cell_means(np.array([0.0, 1.0, 1.01, 1.02, 5.0]), np.array([0, 0, 8.0, 0, 0]), np.arange(4.0))
    >>> line.round(6)
    array([0.  , 0.08, 0.  , 0.  ])
    """
    step = grid[1] - grid[0]
    steps = np.diff(wavelength)
    whole = np.concatenate([[0.0], np.cumsum(0.5 * (spectrum[1:] + spectrum[:-1]) * steps)])
    edges = np.concatenate([grid - step / 2, grid[-1:] + step / 2]).clip(wavelength[0], wavelength[-1])
    cell = np.clip(np.searchsorted(wavelength, edges, side="right") - 1, 0, wavelength.size - 2)
    into = edges - wavelength[cell]
    slope = (spectrum[cell + 1] - spectrum[cell]) / steps[cell]
    integral = whole[cell] + into * (spectrum[cell] + 0.5 * slope * into)
    covered = np.diff(edges)
    return np.divide(np.diff(integral), covered, out=np.zeros_like(grid), where=covered > 1e-9 * step)
