"""A monochromator sweep of the simulated camera: what 61 lines do to every detector element.

At step k an element (band b, column x) counts

    n = dark(t) + t phi[k,x] INT m_k(lambda) R_b,x(lambda) d lambda,

m_k the monochromator's line of unit area, phi the power that enters slit width x one column, R the element's
absolute response (see `hyperpaint.simulation.sensor`). The integral is done numerically for every element:
nothing is taken to vary slowly, nothing to be separable, and no calibration formula appears. Columns differ
by their smile and their own factor only, so that it is done on a table of shifts and interpolated.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hyperpaint.base.arrays import Floats

from .camera import Camera
from .sweep_settings import SweepSettings

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Frames", "Sweep", "simulate_sweep"]


# keys of the random streams: [seed, stream, step], so that nothing depends on which steps are made
_LINE_NOISE, _DARK_NOISE, _POWER_METER, _DIAL = 30, 31, 32, 33

_GAUSSIAN_REACH = 3.2  # full widths; beyond them lies less than 1e-13 of a Gaussian's area
_GRID_STEP = {"gaussian": 0.05, "triangle": 0.02}  # nm, coarsest allowed; corners want the finer one
_SHIFT_STEP = 0.1  # nm, coarsest allowed
_WINGS = (
    60.0,
    0.6,
)  # spread of scattered light [nm], and the share of it that does not cover all bands alike


@dataclass(frozen=True)
class Frames:
    """Frames of one step, reduced.

    Attributes
    ----------
    mean
        Shape (band, cross_track), float32 [count].
    variance
        Of one frame over the frames, shape as mean, float32 [count2].
    """

    mean: NDArray[np.float32]
    variance: NDArray[np.float32]


class Sweep:
    """A sweep, step by step.

    Parameters
    ----------
    settings
        Camera and effects.
    """

    def __init__(self, settings: SweepSettings) -> None:
        self.settings = settings
        self.camera = Camera.of(settings.camera)
        self._shifts, self._to_columns = _shift_table(
            self.camera.imager.wavelength_shift, min(_SHIFT_STEP, settings.monochromator_fwhm.min() / 25)
        )

    def _rng(self, stream: int, *key: int) -> np.random.Generator:
        return np.random.default_rng([self.settings.camera.seed, stream, *key])

    @cached_property
    def wavelength(self) -> Floats:
        """True centre of every line, shape (step,) [nm]."""
        settings = self.settings
        jitter = settings.monochromator_jitter_nm * self._rng(_DIAL).standard_normal(settings.steps)
        return np.asarray(settings.dial + settings.monochromator_offset_nm + jitter)

    @cached_property
    def beam(self) -> Floats:
        """Power of the beam in a column relative to the brightest, shape (step, cross_track)."""
        settings, columns = self.settings, self.settings.camera.columns
        if settings.beam_fwhm_columns is None:
            return np.ones((settings.steps, columns))
        phase = np.linspace(0.0, 2 * np.pi, settings.steps)
        centre = columns // 2 + settings.beam_wander_columns * np.sin(phase)
        offset = (np.arange(columns) - centre[:, None]) / settings.beam_fwhm_columns
        return np.asarray(np.exp(-4.0 * np.log(2.0) * offset**2))

    @cached_property
    def power(self) -> Floats:
        """Power of the beam at every step, shape (step,) [W]: a halogen lamp behind a blazed grating."""
        lamp = 0.25 + 0.75 * np.exp(-0.5 * ((self.wavelength - 660.0) / 170.0) ** 2)
        return self.settings.beam_power_w * lamp

    @cached_property
    def recorded_flux(self) -> Floats:
        """What the power meter says, shape (step,) or (step, cross_track) [W]."""
        settings = self.settings
        error = settings.flux_noise * self._rng(_POWER_METER).standard_normal(settings.steps)
        reading = self.power * (1.0 + settings.flux_bias) * (1.0 + error)
        if settings.beam_fwhm_columns is None or not settings.beam_recorded:
            return np.asarray(reading)
        return np.asarray(reading[:, None] * self.beam)

    @cached_property
    def stray_matrix(self) -> Floats:
        """Counts that a band gains from light of another, per count of that, shape (band, source_band)."""
        wavelength = self.camera.imager.wavelength
        spread, peaked = _WINGS
        wing = np.exp(-np.abs(wavelength[:, None] - wavelength) / spread)
        wing = peaked * wing / wing.sum(axis=0) + (1.0 - peaked) / len(wavelength)
        return np.asarray(self.settings.stray_light * wing)

    def line_integrals(self, step: int) -> Floats:
        """Return INT m_k R_b,x d lambda without the elements' own factors, shape (band, cross_track)."""
        made = self._order(step, 1)
        if self.settings.second_order:
            made += self.settings.second_order * self._order(step, 2)
        if self.settings.stray_light:
            made += self.stray_matrix @ made
        return made

    def _order(self, step: int, order: int) -> Floats:
        """Return the integrals for one order of the grating: light falls at ``order`` x its wavelength."""
        imager, centre = self.camera.imager, self.wavelength[step]
        fwhm = float(self.settings.monochromator_fwhm[step])
        offset, weights = _line_quadrature(
            fwhm, self.settings.monochromator_shape, float(imager.band_fwhm.min()) / order
        )
        grid = centre + offset
        weights = weights * imager.responsivity(grid)
        reach = imager.reach + order * offset[-1]
        made = np.zeros((len(imager.wavelength), self.settings.camera.columns))
        cell = order * (offset[1] - offset[0])
        for band in np.flatnonzero(np.abs(imager.wavelength - order * centre) <= reach).tolist():
            distance = order * grid - (imager.wavelength[band] + self._shifts[:, None])
            at_shifts: Floats = imager.line_shape(band, distance, cell) @ weights
            made[band] = self._to_columns @ at_shifts
        return made

    def signal(self, step: int) -> Floats:
        """Return the noise-free counts above dark, shape (band, cross_track) [count]."""
        settings, imager = self.settings, self.camera.imager
        energy = settings.exposure_time[step] * settings.capture_fraction * self.power[step] * self.beam[step]
        signal = energy * self.line_integrals(step) * imager.element_factor
        signal[self.camera.bad] = 0.0
        if settings.nonlinearity:
            full = self.camera.detector(0.0).saturation_count
            signal -= settings.nonlinearity * signal**2 / full
        return np.asarray(signal)

    def frames(self, step: int) -> Frames:
        """Return the frames of a step."""
        settings = self.settings
        dark = self.camera.detector(float(settings.exposure_time[step])).dark
        rng = self._rng(_LINE_NOISE, step) if settings.camera.noise else None
        return self._average(self.signal(step), dark, settings.frames, rng)

    def dark(self, step: int) -> Frames:
        """Return the dark frames of a step, or, with one dark for all, that of step 0."""
        settings = self.settings.camera
        level = self.camera.detector(float(self.settings.dark_exposure_time[step])).dark
        rng = self._rng(_DARK_NOISE, step) if settings.noise and settings.dark_noise else None
        return self._average(np.zeros_like(level), level, settings.dark_frames, rng)

    def _average(self, signal: Floats, dark: Floats, frames: int, rng: np.random.Generator | None) -> Frames:
        """Return mean and variance of ``frames`` frames, drawn from their distributions.

        Whole counts average to multiples of 1 / frames. Rounding adds 1/12 to the variance of a frame, which
        holds for a noise above some 0.4 counts.
        """
        camera, settings = self.camera, self.settings.camera
        mean = signal + dark
        spread = np.zeros_like(mean)
        if rng is not None:
            spread = np.maximum(signal, 0.0) / camera.electrons_per_count + camera.read_noise**2
            rounded = (1.0 - 1.0 / frames) / 12.0 if settings.quantise else 0.0
            mean += np.sqrt((spread + rounded) / frames) * rng.standard_normal(mean.shape, dtype=np.float32)
            spread += 1.0 / 12.0 if settings.quantise else 0.0
            if frames > 1:
                half = (frames - 1) / 2.0
                spread *= rng.standard_gamma(half, mean.shape, dtype=np.float32) / half
            else:
                spread[:] = np.nan
        if settings.quantise:
            full = camera.detector(0.0).saturation_count
            spread[mean >= full] = 0.0
            np.clip(mean, 0.0, full, out=mean)
            parts = 1 if rng is None else frames
            mean = np.rint(mean * parts) / parts
        return Frames(mean.astype(np.float32), spread.astype(np.float32))


def _line_quadrature(fwhm: float, shape: str, other_width: float) -> tuple[Floats, Floats]:
    """Return distances from the centre of a line [nm] and weights whose sum over them is one.

    The grid is even, symmetric about the centre and, for a triangle, has the corners on its points: the sum
    is then as good as an integral, to 2e-5 of the peak.
    """
    parts = int(np.ceil(fwhm / min(_GRID_STEP[shape], fwhm / 40.0, other_width / 40.0)))
    step = fwhm / parts
    reach = parts if shape == "triangle" else int(np.ceil(_GAUSSIAN_REACH * parts))
    offset = np.asarray(np.arange(-reach, reach + 1) * step, dtype=np.float64)
    if shape == "triangle":
        height = np.asarray(1.0 - np.abs(offset) / fwhm)
    else:
        height = np.exp(-4.0 * np.log(2.0) * (offset / fwhm) ** 2)
    return offset, np.asarray(height / height.sum())


def _shift_table(shifts: Floats, step: float) -> tuple[Floats, Floats]:
    """Return wavelength shifts to compute at, and the matrix (cross_track, table) from there to the columns.

    The few shifts of a narrow camera are taken as they are; many lie close together, and four neighbours on
    an even table then give a column's value by Lagrange's cubic.
    """
    distinct, column = np.unique(shifts, return_inverse=True)
    parts = int(np.ceil((distinct[-1] - distinct[0]) / step))
    if len(distinct) <= parts + 3:
        return distinct, np.eye(len(distinct))[column]
    table = distinct[0] + step * np.arange(-1, parts + 2)
    place = (shifts - table[0]) / step
    left = np.clip(np.floor(place).astype(int), 1, len(table) - 3)
    u = place - left
    cubic = (
        -u * (u - 1) * (u - 2) / 6,
        (u + 1) * (u - 1) * (u - 2) / 2,
        -(u + 1) * u * (u - 2) / 2,
        (u + 1) * u * (u - 1) / 6,
    )
    weights = np.zeros((len(shifts), len(table)))
    for place_of, weight in zip(range(-1, 3), cubic, strict=True):
        weights[np.arange(len(shifts)), left + place_of] = weight
    return table, weights


def simulate_sweep(
    *, steps: int = 61, bands: int = 272, columns: int = 640, seed: int = 0, **effects: Any
) -> xr.Dataset:
    """Simulate a monochromator sweep in memory, with its truth.

    Parameters
    ----------
    steps
        Wavelengths of the sweep, from ``first_step_nm`` to ``last_step_nm``.
    bands, columns, seed
        Of the camera. A collect with equal settings is flown with the same camera.
    **effects
        Fields of `hyperpaint.simulation.SweepSettings`: ``monochromator_fwhm_nm``, ``stray_light`` ...; and,
        of the camera, those of `hyperpaint.simulation.SimulationSettings`: ``smile_nm``, ``srf_shape``,
        ``noise`` ... ``quantise=False`` leaves counts that are not whole.

    Returns
    -------
    The sweep as the store holds one: ``counts`` (step, band, cross_track), float32 mean of the frames with
    the dark still in them, ``counts_variance``, ``dark_counts``, ``flux`` ... Beside it the truth, each
    variable named ``true_``: ``true_radiance_gain``, ``true_wavelength``, ``true_wavelength_shift``,
    ``true_fwhm``, ``true_responsivity``, ``true_dark_bias``, ``true_dark_rate``, ``true_bad`` ...

    Raises
    ------
    SchemaError
        An effect is unknown or out of range; all are listed.

    Examples
    --------
    The light of a line, summed over its bands, gives the responsivity where it falls.

    >>> sweep = simulate_sweep(steps=3, columns=2, smile_nm=0, nonuniformity=0, noise=False, quantise=False)
    >>> line = (sweep.counts - sweep.dark_counts).sum("band") / sweep.exposure_time
    >>> responsivity = (line / sweep.flux / sweep.capture_fraction).isel(step=1, cross_track=0)
    >>> truth = np.interp(700.0, sweep.true_wavelength, sweep.true_responsivity[:, 0])
    >>> round(float(responsivity / truth), 3)
    1.0
    """
    from .sweep_stores import sweep_dataset

    return sweep_dataset(
        Sweep(SweepSettings.of({"steps": steps, "bands": bands, "columns": columns, "seed": seed, **effects}))
    )
