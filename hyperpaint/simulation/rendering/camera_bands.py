"""The bands of a camera that looks at a rendered scene, and exact integrals over their responses.

    INT E(lambda) rho(lambda) R_b(lambda) d lambda,   rho(lambda) = sum_k rho(lambda_k) phi_k(lambda)

The spectrum E of a source has absorption lines much narrower than a band. A product of reflectances rho is
smooth: cubic interpolation between points ``lambda_k`` 0.5 nm apart reproduces it to 1e-6. The integral INT E
phi_k R_b of every band and point is computed once for a source, on a grid that resolves its absorption lines;
the integral of a path is then a short sum.
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
from hyperpaint.simulation.settings import SHAPES, SimulationSettings, finite_floats

_GAUSSIAN_REACH = 2.5  # full widths, beyond which the area of a Gaussian is below 1e-8
#: Distance of the shifts at which products are computed: maximum [nm], and as a fraction 1 / n of the
#: narrowest band. Between them products are interpolated by cubics; line shapes of slits have corners and
#: need smaller steps.
_NODE_STEP = {"gaussian": (0.25, 24.0), "slit": (0.1, 60.0)}


def line_shape(
    offset: Floats, fwhm: Floats | float, spacing: Floats | float, shape: str, step: float
) -> Floats:
    """Return the line shape of a band [nm-1], of unit area on a grid of ``step`` nm.

    Parameters
    ----------
    offset
        Distance from the centre of the band [nm], any shape.
    fwhm
        Full width at half maximum [nm]; for "slit" the width of the slit's image. It and ``spacing`` are
        numbers, or arrays that broadcast with ``offset``.
    spacing
        Width of a pixel [nm], over which the slit's image is averaged.
    shape
        "gaussian", or "slit": a box ``fwhm`` wide convolved with a box ``spacing`` wide.
    step
        Grid step [nm]. The shape of a slit has corners and is averaged exactly over every grid cell.

    Examples
    --------
    >>> from hyperpaint.simulation.settings import SHAPES
    >>> offset = np.arange(-400, 401) * 0.05
    >>> [round(float(line_shape(offset, 6.0, 2.2, shape, 0.05).sum() * 0.05), 9) for shape in SHAPES]
    [1.0, 1.0]
    """
    if shape == "gaussian":
        height = 2.0 * np.sqrt(np.log(2.0) / np.pi) / fwhm
        return np.asarray(height * np.exp(-4.0 * np.log(2.0) * (offset / fwhm) ** 2))
    # The convolution of two boxes is a sum of four ramps. A ramp integrates to a square, whose difference
    # over a cell gives the mean.
    corners = [(1, fwhm + spacing), (-1, fwhm - spacing), (-1, spacing - fwhm), (1, -fwhm - spacing)]
    # both sides are computed as the rising one, because squares would not cancel exactly on the falling side
    rising = -np.abs(offset)
    upper, lower = rising + step / 2, rising - step / 2
    total = np.zeros_like(offset, dtype=np.float64)
    for sign, corner in corners:
        total += sign * (np.maximum(upper + corner / 2, 0.0) ** 2 - np.maximum(lower + corner / 2, 0.0) ** 2)
    return total / (2.0 * fwhm * spacing * step)


def cubic_weights(fraction: Floats) -> Floats:
    # Lagrange's cubic weights of points at -1, 0, 1 and 2 at fractions from 0 to 1, (..., 4)
    t = np.asarray(fraction, np.float64)
    return np.stack(
        [
            -t * (t - 1) * (t - 2) / 6,
            (t + 1) * (t - 1) * (t - 2) / 2,
            -(t + 1) * t * (t - 2) / 2,
            (t + 1) * t * (t - 1) / 6,
        ],
        axis=-1,
    )


@dataclass(frozen=True, eq=False)
class BandSet:
    """Responses of bands in all columns.

    Attributes
    ----------
    wavelength
        Centres at the centre column, shape (band,), increasing [nm].
    fwhm
        Full width at half maximum [nm], shape (band,), or of all bands.
    shape
        "gaussian", or "slit": a box ``fwhm`` wide convolved with a box one band wide.
    wavelength_shift
        Smile, shape (cross_track,) [nm]; None for a camera without smile.
    responsivity
        Function of wavelength [nm] that multiplies the line shapes; None for a constant.

    Raises
    ------
    SchemaError
        Shapes or values are invalid; all problems are listed.

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
        wavelength, fwhm = (finite_floats(getattr(self, n), n, problems) for n in ("wavelength", "fwhm"))
        shift = self.wavelength_shift
        if shift is not None:
            shift = finite_floats(shift, "wavelength_shift", problems)
        has_axis = wavelength.ndim == 1 and wavelength.size > 0
        has_widths = fwhm.shape in ((), (1,), wavelength.shape)
        one_of(self.shape, SHAPES, "shape", problems=problems)
        rows = (
            (not has_axis, f"wavelength has shape {wavelength.shape}", "(band,)", "", "dims-wrong"),
            (
                has_axis and not (np.all(np.diff(wavelength) > 0) and wavelength[0] > 0),
                "wavelength is not positive and increasing",
                "",
                "sort the bands",
                "wavelength-unordered",
            ),
            (
                not has_widths,
                f"fwhm has shape {fwhm.shape}",
                f"one value or {wavelength.shape}",
                "",
                "dims-wrong",
            ),
            (
                has_widths and not np.all(fwhm > 0),
                f"fwhm falls to {fwhm.min(initial=np.inf):g} nm",
                "a width above 0",
                "",
                "value-out-of-range",
            ),
            (
                shift is not None and (shift.ndim != 1 or not shift.size),
                f"wavelength_shift has shape {None if shift is None else shift.shape}",
                "(cross_track,)",
                "",
                "dims-wrong",
            ),
        )
        for is_fault, found, expected, mend, code in rows:
            if is_fault:
                problems.add(found, expected=expected, mend=mend, code=code)
        problems.raise_if_any()
        object.__setattr__(self, "wavelength", wavelength)
        object.__setattr__(self, "fwhm", np.broadcast_to(fwhm, wavelength.shape).copy())
        object.__setattr__(self, "wavelength_shift", shift)

    @classmethod
    def nano_hyperspec(cls) -> BandSet:
        """Return the 272 bands of the simulator's Headwall Nano-Hyperspec, without smile."""
        camera = SimulationSettings()
        wavelength = np.linspace(camera.first_wavelength, camera.last_wavelength, camera.bands)
        return cls(wavelength, np.full(camera.bands, camera.fwhm_nm), camera.srf_shape)

    @classmethod
    def of(cls, bands: Any = None) -> BandSet:
        """Return the bands of an object with ``wavelength`` and ``fwhm``; None gives the Nano-Hyperspec.

        The line shape is the attribute ``srf_shape`` of a Dataset, or ``shape`` of other objects. Smile and
        responsivity of a simulated imager are used, but not its element factors.

        Raises
        ------
        SchemaError
            ``wavelength`` or ``fwhm`` are missing or invalid.
        """
        if bands is None:
            return cls.nano_hyperspec()
        if type(bands) is cls:
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
        """Distance from the centre of a band beyond which it does not respond [nm]."""
        return (
            _GAUSSIAN_REACH * float(self.fwhm.max())
            if self.shape == "gaussian"
            else float((self.fwhm + self.spacing).max()) / 2 + 0.1
        )

    @property
    def _node_step(self) -> float:
        # distance of the nodes [nm]: products of sharper bands change faster with the shift
        max_step, divisor = _NODE_STEP[self.shape]
        pitch = 3.0 * float(self.spacing.min()) if self.shape == "slit" else np.inf
        return min(max_step, min(float(self.fwhm.min()), pitch) / divisor)

    @cached_property
    def nodes(self) -> Floats:
        """Shifts at which products are computed, shape (node,) [nm]: 0 without smile, else at least four."""
        if self.wavelength_shift is None:
            return np.zeros(1)
        min_shift, max_shift = float(self.wavelength_shift.min()), float(self.wavelength_shift.max())
        step = self._node_step
        cells = max(1, int(np.ceil((max_shift - min_shift) / step)))
        return np.asarray(min_shift + step * np.arange(-1, cells + 2), np.float64)

    def between_nodes(self) -> tuple[NDArray[np.int64], Floats]:
        """Return the position of columns among the nodes: first of four nodes, and the four weights.

        Returns
        -------
        first : (cross_track,)
        weight : (cross_track, 4)
            Weights of Lagrange's cubic; rows sum to 1.

        Raises
        ------
        SchemaError
            The bands have no smile, and therefore a single node.
        """
        if self.wavelength_shift is None:
            raise SchemaError(
                "bands without smile have one node",
                mend="use the products of this node",
                code="smile-missing",
            )
        node_position = (self.wavelength_shift - self.nodes[0]) / self._node_step
        first = np.clip(np.floor(node_position).astype(np.int64) - 1, 0, self.nodes.size - 4)
        return first, cubic_weights(node_position - first - 1)

    def lowest(self) -> float:
        """Return the lowest wavelength at which any element responds [nm]."""
        return float(self.wavelength[0] + self.nodes.min() - self.reach)

    def highest(self) -> float:
        """Return the highest wavelength at which any element responds [nm]."""
        return float(self.wavelength[-1] + self.nodes.max() + self.reach)


_FACTOR_STEP_NM = 0.5  # step of the grid for products of reflectances
_MAX_FINE_STEP_NM = 0.05  # maximum step of the grid for responses, else a hundredth of the narrowest band


class BandResponses:
    """Responses of bands on grids: a coarse one for factors, a fine one for sources.

    Parameters
    ----------
    bands
        Bands of the camera.
    covered
        First and last wavelength of the sources [nm]; responses are cut to this range.
    normalise
        Divide integrals by INT R d lambda, so that they are means over the response.

    Attributes
    ----------
    grid : (grid,)
        Wavelengths of factors [nm].
    fine : (fine,)
        Wavelengths of sources [nm].
    first_band : (grid,), int64
        First band to which a grid point contributes.
    width
        Number of bands to which a grid point contributes.
    """

    def __init__(
        self, bands: BandSet, covered: tuple[float, float] = (0.0, np.inf), *, normalise: bool = True
    ) -> None:
        self.bands, self._normalise = bands, normalise
        self._cell = max(1, round(_FACTOR_STEP_NM / min(_MAX_FINE_STEP_NM, float(bands.fwhm.min()) / 100.0)))
        self._fine_step = _FACTOR_STEP_NM / self._cell
        first_point = int(np.floor(bands.lowest() / _FACTOR_STEP_NM)) - 1
        nodes = bands.nodes
        starts = np.floor((bands.wavelength + nodes.min() - bands.reach) / _FACTOR_STEP_NM).astype(np.int64)
        self._starts = starts - first_point
        self._cells = int(np.ceil((2 * bands.reach + np.ptp(nodes)) / _FACTOR_STEP_NM)) + 1
        points = int(self._starts[-1]) + self._cells + 2
        self.grid: Floats = np.asarray((first_point + np.arange(points)) * _FACTOR_STEP_NM, np.float64)
        self.fine: Floats = np.asarray(
            first_point * _FACTOR_STEP_NM + np.arange(points * self._cell) * self._fine_step, np.float64
        )
        self._inside = (self.fine >= covered[0]) & (self.fine <= covered[1])
        # cubic interpolation in a cell uses one point before it and two points after it
        stops, point_numbers = self._starts + self._cells + 2, np.arange(points)
        first_band = np.searchsorted(stops, point_numbers, side="right")
        self.width = max(
            1, int((np.searchsorted(self._starts - 1, point_numbers, side="right") - first_band).max())
        )
        self.first_band = np.clip(first_band, 0, starts.size - self.width)

    def _responses(self, node: int) -> tuple[NDArray[np.int64], Floats]:
        # numbers of the fine points of every band, and response x step at them, both (band, point)
        bands = self.bands
        points = self._starts[:, None] * self._cell + np.arange(self._cells * self._cell)
        offset = self.fine[points] - (bands.wavelength + bands.nodes[node])[:, None]
        response = line_shape(
            offset, bands.fwhm[:, None], bands.spacing[:, None], bands.shape, self._fine_step
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
                weighted = (responses * spectrum[points]).reshape(len(points), self._cells, self._cell)
                band_weights = np.zeros(grid_points.shape)
                # einsum instead of a matrix product, whose bits depend on the threads of BLAS
                for offset, cell_weights in enumerate(np.einsum("bcp,pj->jbc", weighted, cubic)):
                    band_weights[:, offset : offset + self._cells] += cell_weights
                grid_weights[number, node, grid_points, band] = band_weights
        return grid_weights

    def means(self, spectra: Floats) -> Floats:
        # band means of spectra on the fine grid, shape (spectrum, node, band)
        band_means = np.empty((len(spectra), self.bands.nodes.size, self._starts.size))
        for node in range(band_means.shape[1]):
            points, responses = self._responses(node)
            for number, spectrum in enumerate(spectra):
                band_means[number, node] = (responses * spectrum[points]).sum(axis=1)
        return band_means


def cell_means(wavelength: Floats, spectrum: Floats, grid: Floats) -> Floats:
    """Return the mean of a spectrum over the cells of an even grid; zero outside the spectrum.

    The spectrum is linear between its points, which may be finer or coarser than the grid, and is integrated
    exactly.

    Parameters
    ----------
    wavelength, spectrum : (point,)
        Points of the spectrum [nm].
    grid : (grid,)
        Centres of the cells [nm].

    Examples
    --------
    >>> means = cell_means(np.array([0.0, 1.0, 1.01, 1.02, 5.0]), np.array([0, 0, 8.0, 0, 0]), np.arange(4.0))
    >>> means.round(6)
    array([0.  , 0.08, 0.  , 0.  ])
    """
    step = grid[1] - grid[0]
    steps = np.diff(wavelength)
    cumulative = np.concatenate([[0.0], np.cumsum(0.5 * (spectrum[1:] + spectrum[:-1]) * steps)])
    edges = np.concatenate([grid - step / 2, grid[-1:] + step / 2]).clip(wavelength[0], wavelength[-1])
    cell = np.clip(np.searchsorted(wavelength, edges, side="right") - 1, 0, wavelength.size - 2)
    distance = edges - wavelength[cell]
    slope = (spectrum[cell + 1] - spectrum[cell]) / steps[cell]
    integral = cumulative[cell] + distance * (spectrum[cell] + 0.5 * slope * distance)
    covered = np.diff(edges)
    return np.divide(np.diff(integral), covered, out=np.zeros_like(grid), where=covered > 1e-9 * step)
