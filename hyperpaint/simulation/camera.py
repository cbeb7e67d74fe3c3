"""The pushbroom camera of all simulations: equal settings give the same camera.

An element (band b, column x) responds to light of wavelength lambda with

    R_b,x(lambda) = f_b,x R0(lambda) s(lambda - lambda_b - shift_x)   counts per joule,

with the line shape s of unit area, the smooth responsivity R0 common to all elements (optics, grating,
quantum efficiency), and a factor f of the element near one. With etendue A Omega and exposure t its count is

    n = t A Omega INT L(lambda) R_b,x(lambda) d lambda + dark.

The fore optics blur the scene across and along the track, equally in all bands; behind the slit the
spectrograph displaces the image of a band along the slit (keystone) and scatters light into other bands. With
the integrals I = INT L R0 s d lambda of the scene, without element factors,

    I'[b, y, x] = SUM_ij k_ij I[b, y - i, x - j - keystone_b],    I'' = (1 + D) I',

where k has unit sum, so that no light is lost. The scene is constant within a column: an image displaced by a
fraction f of a column is f of one neighbour and 1 - f of the other, and its centre of mass moves by f. Beyond
its outer lines and columns the scene is mirrored. The smile changes so little between columns that the order
of blur and response does not matter.

Rendered scenes need exact integrals over the responses of bands:

INT E(lambda) rho(lambda) R_b(lambda) d lambda,   rho(lambda) = sum_k rho(lambda_k) phi_k(lambda)

The spectrum E of a source has absorption lines much narrower than a band. A product of reflectances rho is
smooth: cubic interpolation between points ``lambda_k`` 0.5 nm apart reproduces it to 1e-6. The integral INT E
phi_k R_b of every band and point is computed once for a source, on a grid that resolves its absorption lines;
the integral of a path is then a short sum.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hyperpaint.base import Floats, Problems, SchemaError, one_of

from .atmosphere import spectral_grid
from .settings import SHAPES, OpticsSettings, SimulationSettings, finite_floats

# --- bands, and exact integrals over their responses --------------------------------------------------------


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
    ramps = (
        sign * (np.maximum(upper + corner / 2, 0.0) ** 2 - np.maximum(lower + corner / 2, 0.0) ** 2)
        for sign, corner in corners
    )
    return sum(ramps, np.zeros_like(offset, dtype=np.float64)) / (2.0 * fwhm * spacing * step)


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
        with Problems("these bands cannot be rendered", SchemaError) as problems:
            wavelength, fwhm = (finite_floats(getattr(self, n), n, problems) for n in ("wavelength", "fwhm"))
            shift = self.wavelength_shift
            if shift is not None:
                shift = finite_floats(shift, "wavelength_shift", problems)
            has_axis = wavelength.ndim == 1 and wavelength.size > 0
            has_widths = fwhm.shape in ((), (1,), wavelength.shape)
            one_of(self.shape, SHAPES, "shape", problems=problems)
            for is_fault, found, expected, mend, code in (
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
            ):
                problems.add_if(is_fault, found, expected=expected, mend=mend, code=code)
        object.__setattr__(self, "wavelength", wavelength)
        object.__setattr__(self, "fwhm", np.broadcast_to(fwhm, wavelength.shape).copy())
        object.__setattr__(self, "wavelength_shift", shift)

    @classmethod
    def nano_hyperspec(cls) -> "BandSet":
        # Return the 272 bands of the simulator's Headwall Nano-Hyperspec, without smile.
        camera = SimulationSettings()
        wavelength = np.linspace(camera.first_wavelength, camera.last_wavelength, camera.bands)
        return cls(wavelength, np.full(camera.bands, camera.fwhm_nm), camera.srf_shape)

    @classmethod
    def of(cls, bands: Any = None) -> "BandSet":
        # Return the bands of an object with ``wavelength`` and ``fwhm``; None gives the Nano-Hyperspec.
        #
        # The line shape is the attribute ``srf_shape`` of a Dataset, or ``shape`` of other objects. Smile and
        # responsivity of a simulated imager are used, but not its element factors.
        #
        # Raises `SchemaError`: ``wavelength`` or ``fwhm`` are missing or invalid.
        if bands is None:
            return cls.nano_hyperspec()
        if type(bands) is cls:
            return bands
        with Problems("these bands cannot be rendered", SchemaError) as problems:
            for name in ("wavelength", "fwhm"):
                problems.add_if(
                    getattr(bands, name, None) is None,
                    f"{name!r} is missing",
                    mend="pass a BandSet, or a Dataset with wavelength and fwhm",
                    code="variable-missing",
                )
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
        # Distance between neighbouring bands, shape (band,) [nm].
        return np.gradient(self.wavelength) if self.wavelength.size > 1 else self.fwhm

    @cached_property
    def reach(self) -> float:
        # Distance from the centre of a band beyond which it does not respond [nm].
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
        # Shifts at which products are computed, shape (node,) [nm]: 0 without smile, else at least four.
        if self.wavelength_shift is None:
            return np.zeros(1)
        min_shift, max_shift = float(self.wavelength_shift.min()), float(self.wavelength_shift.max())
        step = self._node_step
        cells = max(1, int(np.ceil((max_shift - min_shift) / step)))
        return np.asarray(min_shift + step * np.arange(-1, cells + 2), np.float64)

    def between_nodes(self, columns: int) -> tuple[NDArray[np.int64], Floats]:
        # Return the position of columns among the nodes: first node, and the weights of the nodes from it.
        #
        # ``columns``: Number of columns of a camera without smile, which all have the only node.
        #
        # Returns: ``first`` (cross_track,); ``weight`` (cross_track, 4): weights of Lagrange's cubic, or
        # (cross_track, 1) without smile; rows sum to 1.
        if self.wavelength_shift is None:
            return np.zeros(columns, np.int64), np.ones((columns, 1))
        node_position = (self.wavelength_shift - self.nodes[0]) / self._node_step
        first = np.clip(np.floor(node_position).astype(np.int64) - 1, 0, self.nodes.size - 4)
        return first, cubic_weights(node_position - first - 1)

    @property
    def limits(self) -> tuple[float, float]:
        # Lowest and highest wavelength at which any element responds [nm].
        lowest = self.wavelength[0] + self.nodes.min() - self.reach
        return float(lowest), float(self.wavelength[-1] + self.nodes.max() + self.reach)


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
        first_point = int(np.floor(bands.limits[0] / _FACTOR_STEP_NM)) - 1
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
        # weights of the grid points in the bands, shape (source, node, grid, width)
        # sources : (source, fine): spectra of the sources; see `cell_means`
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
            band_means[:, node] = (responses * spectra[:, points]).sum(axis=2)
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


# --- the imager, its detector and optics --------------------------------------------------------------------

#: Distance from the centre of a Gaussian, in full widths, beyond which its area is below 1e-13.
GAUSSIAN_REACH = 3.2

_IMAGER = SimpleNamespace(
    # columns of a matrix product: for larger products BLAS uses threads, which are slow on a busy machine
    columns_at_once=16,
    planck_times_light=6.62607015e-34 * 2.99792458e8,
    dispersion_nm_per_px=2.2140,  # nm per detector pixel, independent of the number of bands
)


#: Etendue of an element of the simulated imager, slit width x pixel pitch x pi / (4 N^2), with an f-number N
#: of 2.5 [m2 sr].
ETENDUE = 20e-6 * 7.4e-6 * np.pi / (4.0 * 2.5**2)


def convolve_gaussian(spectra: Floats, grid: Floats, centres: Floats, fwhm: float) -> Floats:
    # spectra at the resolution of a spectrometer of Gaussian line shape
    # spectra: shape (spectrum, grid)
    # grid: even wavelength grid [nm]
    # centres: wavelengths of the spectrometer [nm]
    # fwhm: full width at half maximum [nm]
    # Shape (spectrum, centres), in the units of ``spectra``.
    step = grid[1] - grid[0]
    convolved = np.empty((len(spectra), len(centres)))
    for index, centre in enumerate(centres):
        start, stop = np.searchsorted(grid, (centre - GAUSSIAN_REACH * fwhm, centre + GAUSSIAN_REACH * fwhm))
        weights = line_shape(grid[start:stop] - centre, fwhm, 0.0, "gaussian", step)
        convolved[:, index] = spectra[:, start:stop] @ weights / weights.sum()
    return convolved


def smile(columns: int, nanometres: float) -> Floats:
    """Return the wavelength shift of every column [nm]: a parabola, zero at the centre column.

    Examples
    --------
    >>> smile(5, 0.4)
    array([0.4, 0.1, 0. , 0.1, 0.4])
    """
    centre = columns // 2
    return np.asarray(nanometres * ((np.arange(columns) - centre) / max(centre, 1)) ** 2)


def nominal_responsivity(electrons_per_count: float) -> Callable[[Floats], Floats]:
    # R0(lambda) of the simulated imager [count nm J-1].
    # Efficiency of optics, grating and silicon x photons per joule x nm per pixel / electrons per count. The
    # efficiency is 0.19 at 420 nm, 0.28 at 550, 0.13 at 850 and 0.03 at 980, so that a white panel at noon
    # nearly saturates twelve bits in 5 ms. R0 falls by 4 % over the 20 nm around the oxygen band.
    def responsivity(wavelength: Floats) -> Floats:
        blaze = np.exp(-0.5 * ((wavelength - 570.0) / 225.0) ** 2)
        silicon = (
            0.29 / (1.0 + np.exp((wavelength - 985.0) / 32.0)) / (1.0 + np.exp((375.0 - wavelength) / 30.0))
        )
        photons = wavelength * 1e-9 / _IMAGER.planck_times_light
        return np.asarray(
            (0.04 + 0.93 * blaze) * silicon * photons * _IMAGER.dispersion_nm_per_px / electrons_per_count
        )

    return responsivity


# Spectral side of a pushbroom imager: its bands, and the differences between its elements
@dataclass(frozen=True, eq=False, kw_only=True)
class Imager(BandSet):
    wavelength_shift: Floats
    responsivity: Callable[[Floats], Floats]
    element_factor: Floats  # f_b,x, shape (band, cross_track)

    @cached_property
    def whole_reach(self) -> float:
        # distance from the nominal centre of a band beyond which no column responds [nm]
        smile_reach = float(np.abs(self.wavelength_shift).max())
        return (
            GAUSSIAN_REACH * float(self.fwhm.max()) + smile_reach
            if self.shape == "gaussian"
            else float((self.fwhm + self.spacing).max()) / 2 + smile_reach + 0.1
        )

    def response(self, band: int, grid: Floats, shift: Floats) -> Floats:
        # R_b without element factors at wavelength shifts [nm], shape (grid, shift)
        offset = grid[:, None] - (self.wavelength[band] + shift)
        return np.asarray(self.responsivity(grid)[:, None] * self.line_shape(band, offset, grid[1] - grid[0]))

    def line_shape(self, band: int, offset: Floats, step: float) -> Floats:
        # line shape of a band [nm-1] at distances from its centre [nm], on a grid of ``step``
        return line_shape(offset, float(self.fwhm[band]), float(self.spacing[band]), self.shape, step)

    def integrals(self, spectra: Floats, grid: Floats) -> Floats:
        # Return INT S(lambda) R_b,x(lambda) d lambda of every spectrum and element.
        #
        # ``spectra``: Shape (spectrum, grid): radiance of a scene, light of a monochromator, or ones for INT
        # R. ``grid``: Even wavelength grid that covers the responses [nm].
        #
        # Returns: Shape (spectrum, band, cross_track), in the units of ``spectra`` x count J-1 nm.
        #
        # Raises `ValueError`: The grid ends inside a response.
        step = grid[1] - grid[0]
        min_nm, max_nm = self.wavelength.min() - self.whole_reach, self.wavelength.max() + self.whole_reach
        if grid[0] > min_nm or grid[-1] < max_nm:
            raise ValueError(
                f"grid covers {grid[0]:.1f} to {grid[-1]:.1f} nm, responses {min_nm:.1f} to {max_nm:.1f} nm"
            )
        shifts, column = np.unique(self.wavelength_shift, return_inverse=True)
        integrals = np.empty((len(spectra), len(self.wavelength), len(self.wavelength_shift)))
        responses = np.empty((len(spectra), len(shifts)))
        for band, centre in enumerate(self.wavelength):
            start, stop = np.searchsorted(grid, (centre - self.whole_reach, centre + self.whole_reach))
            response = self.response(band, grid[start:stop], shifts)
            for start_column in range(0, len(shifts), _IMAGER.columns_at_once):
                columns = slice(start_column, start_column + _IMAGER.columns_at_once)
                responses[:, columns] = spectra[:, start:stop] @ response[:, columns]
            integrals[:, band] = responses[:, column] * (step * self.element_factor[band])
        return integrals


def expected_counts(integral: Floats, exposure_time: float, etendue: float) -> Floats:
    """Return the counts above dark of a radiance integral INT L R d lambda.

    Parameters
    ----------
    integral
        INT L(lambda) R_b,x(lambda) d lambda [W m-2 sr-1 count J-1].
    exposure_time
        [s]
    etendue
        [m2 sr]

    Examples
    --------
    A panel of reflectance 0.40 under 1.30 W m-2 nm-1 sends L = rho E / pi; R peaks at 2e16 and is 6 nm wide.

    >>> area = 2.0e16 * np.sqrt(np.pi / (4 * np.log(2))) * 6.0  # INT R d lambda: peak x shape x FWHM
    >>> expected_counts(np.array([0.40 * 1.30 / np.pi * area]), 5e-3, 1.8598e-11).round(2)
    array([1966.09])
    """
    return exposure_time * etendue * integral


# Electrical side of the imager
@dataclass(frozen=True)
class Detector:
    dark: Floats  # counts with the lens capped, shape (band, cross_track) [count]
    electrons_per_count: float  # [electron count-1]
    read_noise: float  # standard deviation of a dark count [count]
    bit_depth: int  # bits of the converter, which saturates at 2**bit_depth - 1

    @property
    def saturation_count(self) -> int:
        return int(2**self.bit_depth - 1)

    def read(self, signal: Floats, rng: np.random.Generator | None) -> Floats:
        # input of the converter [count]: signal, dark and, with ``rng``, shot and read noise.
        # The variance is signal / electrons_per_count + read_noise^2; shot noise is approximated as Gaussian.
        counts = signal + self.dark
        if rng is not None:
            noise = np.maximum(signal, 0.0)
            noise *= 1.0 / self.electrons_per_count
            noise += self.read_noise**2
            np.sqrt(noise, out=noise)
            noise *= rng.standard_normal(signal.shape, dtype=np.float32)
            counts += noise
        return counts

    def convert(self, counts: Floats | NDArray[np.float32]) -> NDArray[np.uint16]:
        # whole counts between 0 and `saturation_count`
        converted = np.empty(counts.shape, dtype=np.uint16)
        for line, line_counts in zip(converted, counts, strict=True):
            rounded = np.rint(line_counts)
            np.clip(rounded, 0, self.saturation_count, out=rounded)
            line[...] = rounded
        return converted


_SIGMA_PER_FWHM = 1.0 / (2.0 * np.sqrt(2.0 * np.log(2.0)))
_SVD = SimpleNamespace(
    tail=1e-9,  # minimum weight of a neighbour in a point spread
    #: Minimum singular value of a kernel, relative to the largest; smaller values are rounding errors.
    rank=1e-12,
    #: Decay length of scattered light [nm], and its share; the rest is equal in all bands.
    wings=(60.0, 0.6),
)


def point_spread(fwhm: float) -> Floats:
    """Return an odd number of weights of a Gaussian blur, with unit sum.

    Parameters
    ----------
    fwhm
        Full width at half maximum [pixels].

    Notes
    -----
    The discrete analogue of a Gaussian, w_n = exp(-t) I_n(t) with the modified Bessel function I_n [1]_, has
    exactly the variance t = sigma^2; samples of a Gaussian narrower than a pixel have a smaller variance.

    References
    ----------
    .. [1] T. Lindeberg, "Scale-space for discrete signals", IEEE Trans. PAMI 12 (1990) 234-254,
       https://doi.org/10.1109/34.49051

    Examples
    --------
    >>> weights = point_spread(1.0)
    >>> place = np.arange(len(weights)) - len(weights) // 2
    >>> print(f"{weights.sum():.6f} {(weights * place**2).sum() * 8 * np.log(2):.6f}")
    1.000000 1.000000
    """
    from scipy.special import ive

    variance = (_SIGMA_PER_FWHM * fwhm) ** 2
    right_side = np.asarray(ive(np.arange(int(np.ceil(8.0 * _SIGMA_PER_FWHM * fwhm + 8.0)) + 1), variance))
    right_side = right_side[: int(np.flatnonzero(right_side > _SVD.tail).max()) + 1]
    weights = np.concatenate([right_side[:0:-1], right_side])
    return np.asarray(weights / weights.sum())


def keystone(bands: int, columns: float) -> Floats:
    """Return the displacement of the image of every band to the right, shape (band,) [columns].

    Examples
    --------
    >>> keystone(5, 0.4)
    array([-0.4, -0.2,  0. ,  0.2,  0.4])
    """
    return np.asarray(columns * np.linspace(-1.0, 1.0, bands))


def stray_light_wings(wavelength: Floats, share: float) -> Floats:
    """Return stray counts of a band per count of a source band, shape (band, source_band).

    Each column sums to ``share``: a part decreases with the distance in wavelength, the rest is equal in all
    bands.

    Examples
    --------
    >>> stray_light_wings(np.array([400.0, 700.0, 1000.0]), 0.02).sum(axis=0).round(6)
    array([0.02, 0.02, 0.02])
    """
    decay_nm, peaked_share = _SVD.wings
    wing = np.exp(-np.abs(wavelength[:, None] - wavelength) / decay_nm)
    wing = peaked_share * wing / wing.sum(axis=0) + (1.0 - peaked_share) / len(wavelength)
    return np.asarray(share * wing)


class Optics:
    """Blur, keystone and stray light of a camera; `image` applies them to a scene.

    Parameters
    ----------
    settings
        Blur, keystone and stray light.
    wavelength
        Centres of the bands, shape (band,) [nm].

    Attributes
    ----------
    reach
        Number of lines before and behind that contribute to a line.
    keystone
        Displacement of the bands' images, shape (band,) [columns].
    has_stray_light, stray_matrix
        Whether there is stray light, and its `stray_light_wings`.

    Examples
    --------
    >>> optics = Optics(OpticsSettings(keystone_columns=0.25), np.array([400.0, 1000.0]))
    >>> optics.image([np.array([[0.0, 1.0, 0.0], [0.0, 1.0, 0.0]])])
    array([[0.25, 0.75, 0.  ],
           [0.  , 0.75, 0.25]])
    """

    def __init__(self, settings: OpticsSettings, wavelength: Floats) -> None:
        self.keystone = keystone(len(wavelength), settings.keystone_columns)
        self.stray_matrix = stray_light_wings(wavelength, settings.stray_light)
        self.has_stray_light = settings.stray_light > 0
        if settings.psf_kernel is None:
            pairs = [(point_spread(settings.psf_along_lines), point_spread(settings.psf_across_columns))]
        else:
            # a kernel (line, column) as a sum of products of weights along and across the track
            kernel = np.asarray(settings.psf_kernel, np.float64)
            along, scales, across = np.linalg.svd(kernel / kernel.sum(), full_matrices=False)
            rank = int(np.count_nonzero(scales > _SVD.rank * scales[0]))
            pairs = [(along[:, k] * scales[k], across[k]) for k in range(rank)]
        # weights of lines (line,), and of columns in every band (band, column)
        self._terms = [(along, _displaced(across, self.keystone)) for along, across in pairs]
        self.reach = len(pairs[0][0]) // 2

    @classmethod
    def of(cls, settings: OpticsSettings, wavelength: Floats) -> "Optics | None":
        # optics with these settings, or None if all effects are off
        blurs = settings.psf_across_columns or settings.psf_along_lines or settings.psf_kernel is not None
        is_on = blurs or settings.keystone_columns or settings.stray_light
        return cls(settings, wavelength) if is_on else None

    def image(self, window: Sequence[Floats]) -> Floats:
        # signal of the elements of a line, shape (band, column)
        # window: ``2 * reach + 1`` lines around the line, each (band, column), without element factors
        total = np.zeros(window[0].shape)
        for along, across in self._terms:
            line = np.zeros_like(total)
            # a convolution: weights are applied in reversed order
            for weight, row in zip(along[::-1].tolist(), window, strict=True):
                line += weight * row
            total += _convolved(line, across)
        if self.has_stray_light:
            total += self.stray_matrix @ total
        return total

    def displaced(self, profile: Floats) -> Floats:
        # profile along the slit (column,) displaced by keystone, shape (band, column)
        return _convolved(np.broadcast_to(profile, (len(self.keystone), len(profile))),
                          _displaced(np.ones(1), self.keystone))  # fmt: skip

    def rows_of(self, line: int, lines: int) -> list[int]:
        """Return the line numbers of the window of `image`, mirrored at the first and last of ``lines``.

        Examples
        --------
        >>> Optics(OpticsSettings(psf_kernel=[[1], [1], [1]]), np.array([400.0, 500.0])).rows_of(0, 4)
        [0, 0, 1]
        """
        numbers = np.arange(line - self.reach, line + self.reach + 1) % (2 * lines)
        return [int(row) for row in np.minimum(numbers, 2 * lines - 1 - numbers)]


def _displaced(across: Floats, shift: Floats) -> Floats:
    # weights (column,) displaced by the shifts of the bands, shape (band, column), odd number of columns
    extra = int(np.ceil(np.abs(shift).max()))
    whole_columns = np.floor(shift).astype(int)
    weights = np.zeros((len(shift), len(across) + 2 * extra))
    for band, (start, fraction) in enumerate(
        zip((whole_columns + extra).tolist(), (shift - whole_columns).tolist(), strict=True)
    ):
        weights[band, start : start + len(across)] += (1.0 - fraction) * across
        if fraction:
            weights[band, start + 1 : start + 1 + len(across)] += fraction * across
    return weights


def _convolved(line: Floats, weights: Floats) -> Floats:
    # convolve ``line`` with ``weights``, both (band, column), along the columns
    reach, columns = weights.shape[1] // 2, line.shape[1]
    padded = np.pad(line, ((0, 0), (reach, reach)), mode="symmetric") if reach else line
    result = np.zeros(line.shape)
    for tap in range(weights.shape[1]):
        tap_weights = weights[:, tap, None]
        if tap_weights.any():
            start = 2 * reach - tap
            result += tap_weights * padded[:, start : start + columns]
    return result


# keys of the random streams; flights and sweeps define further keys
_DARK, _ELEMENTS, _BAD, _DARK_RATE, _COLUMNS = 13, 14, 15, 18, 19
_RATE_SPREAD = 0.2  # relative standard deviation of the dark current over elements


# The simulated camera
@dataclass(frozen=True)
class Camera:
    imager: Imager  # spectral response
    # dark_bias, dark_rate: counts at no exposure [count] and their growth [count s-1], shape (band,
    # cross_track)
    dark_bias: Floats
    dark_rate: Floats
    bad: NDArray[np.bool_]  # true at dead elements and in masked columns, shape (band, cross_track)
    # electrons_per_count, read_noise, bit_depth: as in `hyperpaint.simulation.camera.Detector`
    electrons_per_count: float
    read_noise: float
    bit_depth: int
    optics: Optics | None = None  # blur, keystone and stray light; None for a camera without these effects
    pedestal: float = 0.0  # counts added to the dark in all frames except dark frames [count]
    etendue: float = ETENDUE  # of an element [m2 sr]

    @classmethod
    def of(cls, settings: SimulationSettings) -> "Camera":
        """Return the camera of these settings.

        Examples
        --------
        >>> Camera.of(SimulationSettings(bands=4, columns=3, fwhm_nm=5.0)).imager.fwhm
        array([5., 5., 5., 5.])
        """
        shape = settings.bands, settings.columns

        def normal(stream: int, shape: tuple[int, ...] = shape) -> Floats:
            return np.clip(np.random.default_rng([settings.seed, stream]).standard_normal(shape), -3.0, 3.0)

        band_place = np.linspace(-1.0, 1.0, settings.bands)
        wavelength = np.linspace(settings.first_wavelength, settings.last_wavelength, settings.bands)
        imager = Imager(
            wavelength=wavelength + settings.dispersion_bow_nm * (1.0 - band_place**2),
            wavelength_shift=smile(settings.columns, settings.smile_nm),
            fwhm=settings.fwhm_nm * (1.0 + settings.fwhm_slope * band_place),
            shape=settings.srf_shape,
            responsivity=nominal_responsivity(settings.electrons_per_count),
            element_factor=(1.0 + settings.nonuniformity * normal(_ELEMENTS))
            * (1.0 + settings.column_nonuniformity * normal(_COLUMNS, shape[1:])),
        )
        bad = np.zeros(shape, dtype=bool)
        rng = np.random.default_rng([settings.seed, _BAD])
        bad.flat[rng.choice(bad.size, settings.bad_elements, replace=False)] = True
        if masked := settings.masked_columns:
            bad[:, :masked] = bad[:, -masked:] = True
        return cls(
            imager,
            np.maximum(settings.dark_level + settings.dark_pattern * normal(_DARK), 0.0),
            settings.dark_rate * (1.0 + _RATE_SPREAD * normal(_DARK_RATE)),
            bad,
            settings.electrons_per_count,
            settings.read_noise,
            settings.bit_depth,
            Optics.of(settings, imager.wavelength),
            settings.pedestal,
        )

    def detector(self, exposure_time: float) -> Detector:
        # detector with the dark of an exposure [s]
        dark = self.dark_bias + self.dark_rate * exposure_time
        return Detector(dark, self.electrons_per_count, self.read_noise, self.bit_depth)

    @cached_property
    def response_area(self) -> Floats:
        # INT R of every element, shape (band, cross_track) [count nm J-1]
        centres, reach = self.imager.wavelength, self.imager.whole_reach
        grid = spectral_grid(centres.min() - reach - 1.0, centres.max() + reach + 1.0)
        return np.asarray(self.imager.integrals(np.ones((1, len(grid))), grid)[0])

    def radiance_gain(self, response_area: Floats | None = None) -> Floats:
        # 1 / (etendue INT R), NaN at bad elements, shape (band, cross_track) [W m-2 sr-1 nm-1 s count-1]
        area = self.response_area if response_area is None else response_area
        return np.where(self.bad, np.nan, 1.0 / (self.etendue * area))
