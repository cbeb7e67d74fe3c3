"""The bands of a camera that looks at a rendered scene, and exact integrals over their responses.

    INT E(lambda) rho(lambda) R_b(lambda) d lambda,   rho(lambda) = sum_k rho(lambda_k) phi_k(lambda)

The spectrum E of a source has absorption lines far narrower than any band. A product of reflectances rho is
smooth: cubic interpolation between points ``lambda_k`` 0.5 nm apart reproduces it to 1e-6. The integral
INT E phi_k R_b of every band and point is computed once for a source, on a grid as fine as its absorption
lines; after that a path costs a short sum.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.facts import one_of
from hyperpaint.simulation.camera import cubic_weights, line_shape
from hyperpaint.simulation.setting_checks import finite_floats
from hyperpaint.simulation.settings import SHAPES, SimulationSettings

_GAUSSIAN_REACH = 2.5  # full widths; beyond them lies 1e-8 of a Gaussian's area
#: Distance of the shifts at which products are made: at the most [nm], and in parts of the narrowest band.
#: Between them products are cubic; a slit's image has corners.
_NODE_STEP = {"gaussian": (0.25, 24.0), "slit": (0.1, 60.0)}


@dataclass(frozen=True, eq=False)
class BandSet:
    """Responses of bands, as they differ from column to column.

    Attributes
    ----------
    wavelength
        Centres at the centre column, shape (band,), increasing [nm].
    fwhm
        Full width at half maximum, shape (band,), or one for all [nm].
    shape
        "gaussian", or "slit": a box ``fwhm`` wide convolved with a box one band wide.
    wavelength_shift
        Smile, shape (cross_track,) [nm]; None for a camera without.
    responsivity
        Function of wavelength [nm] that multiplies the line shapes; None for a constant.

    Raises
    ------
    SchemaError
        Shapes or values that no camera has; all problems are listed.

    Examples
    --------
    >>> bands = BandSet.nano_hyperspec()
    >>> len(bands.wavelength), float(bands.wavelength[0]), float(bands.fwhm[0])
    (272, 399.356, 6.0)
    """

    wavelength: Floats
    fwhm: Floats
    shape: str = "gaussian"
    wavelength_shift: Floats | None = None
    responsivity: Callable[[Floats], Floats] | None = None

    def __post_init__(self) -> None:
        problems = Problems("these bands cannot be rendered", SchemaError)
        wavelength = finite_floats(self.wavelength, "wavelength", problems)
        if wavelength.ndim != 1 or not wavelength.size:
            problems.add(f"wavelength has shape {wavelength.shape}", expected="(band,)", code="dims-wrong")
        elif not (np.all(np.diff(wavelength) > 0) and wavelength[0] > 0):
            problems.add(
                "wavelength is not positive and increasing",
                mend="sort the bands",
                code="wavelength-unordered",
            )
        fwhm = finite_floats(self.fwhm, "fwhm", problems)
        if fwhm.shape not in ((), (1,), wavelength.shape):
            problems.add(
                f"fwhm has shape {fwhm.shape}", expected=f"one value or {wavelength.shape}", code="dims-wrong"
            )
        elif not np.all(fwhm > 0):
            problems.add(
                f"fwhm falls to {fwhm.min():g} nm", expected="a width above 0", code="value-out-of-range"
            )
        one_of(self.shape, SHAPES, "shape", problems=problems)
        shift = None
        if self.wavelength_shift is not None:
            shift = finite_floats(self.wavelength_shift, "wavelength_shift", problems)
            if shift.ndim != 1 or not shift.size:
                problems.add(
                    f"wavelength_shift has shape {shift.shape}", expected="(cross_track,)", code="dims-wrong"
                )
        problems.raise_if_any()
        object.__setattr__(self, "wavelength", wavelength)
        object.__setattr__(self, "fwhm", np.broadcast_to(fwhm, wavelength.shape).copy())
        object.__setattr__(self, "wavelength_shift", shift)

    @classmethod
    def nano_hyperspec(cls) -> BandSet:
        """Return the 272 bands of a Headwall Nano-Hyperspec as the simulator has it, without smile."""
        camera = SimulationSettings()
        wavelength = np.linspace(camera.first_wavelength, camera.last_wavelength, camera.bands)
        return cls(wavelength, np.full(camera.bands, camera.fwhm_nm), camera.srf_shape)

    @classmethod
    def of(cls, bands: Any = None) -> BandSet:
        """Return anything with ``wavelength`` and ``fwhm`` as bands; None is the Nano-Hyperspec.

        A Dataset says the shape in its attribute ``srf_shape``, anything else in ``shape``. Of a simulated
        imager come the smile and the slope of its responsivity, and not the elements' own factors.

        Raises
        ------
        SchemaError
            ``wavelength`` or ``fwhm`` are missing, or no camera can have them.
        """
        if bands is None:
            return cls.nano_hyperspec()
        if isinstance(bands, cls):
            return bands
        problems = Problems("these bands cannot be rendered", SchemaError)
        for name in ("wavelength", "fwhm"):
            if getattr(bands, name, None) is None:
                problems.add(
                    f"{name!r} is missing",
                    mend="pass a BandSet, or a Dataset with wavelength and fwhm",
                    code="variable-missing",
                )
        problems.raise_if_any()
        attrs = getattr(bands, "attrs", {})
        shape = attrs.get("srf_shape", "gaussian") if attrs else getattr(bands, "shape", "gaussian")
        shift = getattr(bands, "wavelength_shift", None)
        return cls(
            np.asarray(bands.wavelength),
            np.asarray(bands.fwhm),
            shape if isinstance(shape, str) else "gaussian",
            None if shift is None or not np.any(shift) else np.asarray(shift),
            getattr(bands, "responsivity", None) if not attrs else None,
        )

    @cached_property
    def spacing(self) -> Floats:
        """Distance between neighbouring bands, shape (band,) [nm]."""
        return np.gradient(self.wavelength) if self.wavelength.size > 1 else self.fwhm

    @cached_property
    def reach(self) -> float:
        """Distance from a band's own centre beyond which it does not respond [nm]."""
        return (
            _GAUSSIAN_REACH * float(self.fwhm.max())
            if self.shape == "gaussian"
            else float((self.fwhm + self.spacing).max()) / 2 + 0.1
        )

    @property
    def _node_step(self) -> float:
        # Distance of the nodes [nm]: sharper bands change faster with the shift.
        widest, parts = _NODE_STEP[self.shape]
        narrowest = float(self.fwhm.min())
        if self.shape == "slit":
            narrowest = min(narrowest, float(self.spacing.min()) * 3.0)
        return min(widest, narrowest / parts)

    @cached_property
    def nodes(self) -> Floats:
        """Shifts at which products are made, shape (node,) [nm]: one without smile, at least four with it."""
        if self.wavelength_shift is None:
            return np.zeros(1)
        low, high = float(self.wavelength_shift.min()), float(self.wavelength_shift.max())
        step = self._node_step
        cells = max(1, int(np.ceil((high - low) / step)))
        return np.asarray(low + step * np.arange(-1, cells + 2), np.float64)

    def between_nodes(self) -> tuple[NDArray[np.int64], Floats]:
        """Return the position of columns among the nodes: first of four nodes, and the four weights.

        Returns
        -------
        first : (cross_track,)
        weight : (cross_track, 4)
            Of Lagrange's cubic; each row sums to 1.

        Raises
        ------
        SchemaError
            The bands have no smile, and so one node.
        """
        if self.wavelength_shift is None:
            raise SchemaError(
                "bands without smile have one node",
                mend="use the products of that node",
                code="smile-missing",
            )
        place = (self.wavelength_shift - self.nodes[0]) / self._node_step
        first = np.clip(np.floor(place).astype(np.int64) - 1, 0, self.nodes.size - 4)
        return first, cubic_weights(place - first - 1)

    def lowest(self) -> float:
        """Return the lowest wavelength at which any element responds [nm]."""
        return float(self.wavelength[0] + self.nodes.min() - self.reach)

    def highest(self) -> float:
        """Return the highest wavelength at which any element responds [nm]."""
        return float(self.wavelength[-1] + self.nodes.max() + self.reach)


_FACTOR_STEP_NM = 0.5  # nm between the points at which products of reflectances are taken
_MAX_FINE_STEP_NM = 0.05  # nm at which responses are taken, or a hundredth of the sharpest


class BandResponses:
    """Responses of bands on grids: a coarse one for factors, a fine one for sources.

    Parameters
    ----------
    bands
        Of the camera.
    covered
        First and last wavelength at which sources are known [nm]; responses end there.
    normalise
        Divide integrals by INT R d lambda, so that they are means over the response.

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
        finest = min(_MAX_FINE_STEP_NM, float(bands.fwhm.min()) / 100.0)
        self._cell = max(1, round(_FACTOR_STEP_NM / finest))
        self._fine_step = _FACTOR_STEP_NM / self._cell
        low = int(np.floor(bands.lowest() / _FACTOR_STEP_NM)) - 1
        nodes = bands.nodes
        starts = np.floor((bands.wavelength + nodes.min() - bands.reach) / _FACTOR_STEP_NM).astype(np.int64)
        self._starts = starts - low
        self._cells = int(np.ceil((2 * bands.reach + np.ptp(nodes)) / _FACTOR_STEP_NM)) + 1
        points = int(self._starts[-1]) + self._cells + 2
        self.grid: Floats = np.asarray((low + np.arange(points)) * _FACTOR_STEP_NM, np.float64)
        self.fine: Floats = np.asarray(
            low * _FACTOR_STEP_NM + np.arange(points * self._cell) * self._fine_step, np.float64
        )
        self._inside = (self.fine >= covered[0]) & (self.fine <= covered[1])
        # cells reach one point back and two points on, by the cubic
        stops, places = self._starts + self._cells + 2, np.arange(points)
        first = np.searchsorted(stops, places, side="right")
        self.width = max(1, int((np.searchsorted(self._starts - 1, places, side="right") - first).max()))
        self.first_band = np.clip(first, 0, starts.size - self.width)

    def _responses(self, node: int) -> tuple[NDArray[np.int64], Floats]:
        # Fine points of every band, and response x step there, both (band, point).
        bands = self.bands
        points = self._starts[:, None] * self._cell + np.arange(self._cells * self._cell)
        offset = self.fine[points] - (bands.wavelength + bands.nodes[node])[:, None]
        response = np.stack(
            [
                line_shape(row, float(fwhm), float(spacing), bands.shape, self._fine_step)
                for row, fwhm, spacing in zip(offset, bands.fwhm, bands.spacing, strict=True)
            ]
        )
        if bands.responsivity is not None:
            response = response * np.asarray(bands.responsivity(self.fine))[points]
        response = response * (self._inside[points] * self._fine_step)
        if self._normalise:
            response /= response.sum(axis=1, keepdims=True)
        return points, response

    def weights(self, sources: Floats) -> Floats:
        """Return the weights of the grid points in the bands, shape (source, node, grid, width).

        Parameters
        ----------
        sources : (source, fine)
            Spectra of the sources; see `cell_means`.
        """
        shape = (len(sources), self.bands.nodes.size, self.grid.size, self.width)
        grid_weights = np.zeros(shape)
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
                grid_weights[number, node, grid_points, band] = spread
        return grid_weights

    def means(self, spectra: Floats) -> Floats:
        # Band means of spectra on the fine grid, shape (spectrum, node, band).
        band_means = np.empty((len(spectra), self.bands.nodes.size, self._starts.size))
        for node in range(band_means.shape[1]):
            points, responses = self._responses(node)
            for number, spectrum in enumerate(spectra):
                band_means[number, node] = (responses * spectrum[points]).sum(axis=1)
        return band_means


def cell_means(wavelength: Floats, spectrum: Floats, grid: Floats) -> Floats:
    """Return the mean of a spectrum over the cells of an even grid; zero outside the spectrum.

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
