"""A monochromator sweep of the simulated camera: the response of every detector element to 61 wavelengths.

At step k an element (band b, column x) counts

    n = dark(t) + t phi[k,x] INT m_k(lambda) R_b,x(lambda) d lambda,

with the spectrum m_k of the monochromator of unit area, the power phi into the area of slit width x one
column, and the absolute response R of the element (see `hyperpaint.simulation.camera`). The integral is
computed numerically for every element, without assuming slow variation or separability, and without a
calibration formula. Columns differ only in smile and element factor, so that it is computed for a table of
shifts and interpolated.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np

from hyperpaint.base import (
    MONOCHROMATOR_SHAPES,
    Floats,
    Floats32,
    Problems,
    SchemaError,
    check_fields,
    declared,
    fact,
)

from .camera import GAUSSIAN_REACH, Camera, cubic_weights
from .settings import CAMERA_FIELDS, SimulationSettings

PerStep = float | Sequence[float] | Floats

# effects of the electronics on a frame, in the lab and in flight
_FRAME_FIELDS = frozenset({"noise", "dark_noise", "quantise", "dark_frames"})


@declared
@dataclass(frozen=True, kw_only=True)
class SweepSettings:
    """Effects of a simulated monochromator sweep; every effect can be switched off.

    Attributes
    ----------
    camera
        Settings of the camera, with ``noise``, ``dark_noise``, ``quantise`` and ``dark_frames`` as in flight.

    Raises
    ------
    SchemaError
        A value is out of its range; all are listed.

    Examples
    --------
    >>> SweepSettings(steps=3).dial
    array([ 400.,  700., 1000.])
    >>> SweepSettings(monochromator_shape="box", frames=0)
    Traceback (most recent call last):
    hyperpaint.base.errors.SchemaError: the sweep cannot be simulated:
      monochromator_shape='box', expected one of gaussian, triangle [choice-unknown]
      frames=0, expected a whole number from 1 to 100000 [value-out-of-range]
    """

    camera: SimulationSettings = field(default_factory=SimulationSettings)
    steps: int = fact(61, "wavelengths of the sweep, evenly spaced", least=1, most=100_000)
    first_step_nm: float = fact(
        400.0, "dial of the monochromator at the first step", unit="nm", least=300.0, most=1200.0
    )
    last_step_nm: float = fact(
        1000.0, "dial of the monochromator at the last step", unit="nm", least=300.0, most=1200.0
    )
    monochromator_fwhm_nm: PerStep = fact(
        2.0,
        "full width at half maximum of the light of the monochromator; one, or one for each step",
        kind="numbers",
        single=True,
        unit="nm",
        least=0.02,
        most=100.0,
    )
    monochromator_shape: str = fact(
        "gaussian", 'spectral shape of that light; "triangle" for equal slits', choices=MONOCHROMATOR_SHAPES
    )
    monochromator_offset_nm: float = fact(
        0.0, "true wavelength minus the dial", unit="nm", least=-50.0, most=50.0
    )
    monochromator_jitter_nm: float = fact(
        0.0, "spread of that offset from step to step", unit="nm", least=0.0, most=50.0
    )
    beam_power_w: float = fact(
        3e-6, "radiant flux of the whole beam where the lamp is brightest", unit="W", least=1e-15, most=1e3
    )
    capture_fraction: float = fact(
        1e-6, "share of it that enters slit width x one column, all bands together", least=1e-15, most=1.0
    )
    beam_fwhm_columns: float | None = fact(
        None,
        "full width at half maximum of a Gaussian beam along the slit [columns]; None lights all alike",
        kind="number",
        least=0.1,
        most=1e6,
    )
    beam_wander_columns: float = fact(
        0.0,
        "amplitude of the motion of the centre of that beam during the sweep [columns]",
        least=0.0,
        most=1e6,
    )
    beam_recorded: bool = fact(
        True, "``flux`` is the power of every column; otherwise the power of the brightest one"
    )
    flux_bias: float = fact(
        0.0, "relative error of the power meter, common to the sweep", least=-0.9, most=10.0
    )
    flux_noise: float = fact(0.0, "spread of that error from step to step", least=0.0, most=0.3)
    step_exposure_ms: PerStep = fact(
        50.0,
        "exposure; one, or one for each step",
        kind="numbers",
        single=True,
        unit="ms",
        least=1e-3,
        most=1e6,
    )
    dark_exposure_ms: PerStep | None = fact(
        None,
        "exposure of the dark frames; steps take several in turn; None for the exposures of the steps",
        kind="numbers",
        single=True,
        unit="ms",
        least=1e-3,
        most=1e6,
    )
    frames: int = fact(50, "frames averaged in a step", least=1, most=100_000)
    variance: bool = fact(True, "the variance of the frames is kept")
    second_order: float = fact(
        0.0,
        "light of the second order of the grating, at twice its wavelength, relative to the first",
        least=0.0,
        most=1.0,
    )
    nonlinearity: float = fact(
        0.0,
        "relative loss of a signal that would fill the converter; proportional to the signal",
        least=-0.5,
        most=0.5,
    )

    def __post_init__(self) -> None:
        problems = Problems("the sweep cannot be simulated", SchemaError)
        check_fields(self, problems)
        for name in ("monochromator_fwhm_nm", "step_exposure_ms"):
            number = np.size(getattr(self, name))
            problems.add_if(
                np.ndim(getattr(self, name)) == 1 and number != self.steps,
                f"{name} has {number} values",
                expected=f"one, or one for each of {self.steps} steps",
                code="length-mismatch",
            )
        problems.raise_if_any()

    @classmethod
    def of(cls, values: Mapping[str, Any], camera: SimulationSettings | None = None) -> Self:
        """Return settings from keywords, of the sweep and of the camera.

        Parameters
        ----------
        values
            Fields of this class, and the fields of `SimulationSettings` for camera and frames.
        camera
            Settings of an existing camera, of which ``values`` may only change the fields for frames.

        Raises
        ------
        SchemaError
            Keywords are unknown, or values out of range.
        """
        sweep_fields = {field.name for field in fields(cls)} - {"camera"}
        camera_fields = _FRAME_FIELDS if camera is not None else _FRAME_FIELDS | CAMERA_FIELDS
        unknown = sorted(set(values) - sweep_fields - camera_fields)
        SchemaError.raise_if(
            unknown,
            f"unknown settings {', '.join(unknown)}",
            expected=f"some of {', '.join(sorted(sweep_fields | camera_fields))}",
            code="key-unknown",
        )
        changes = {name: value for name, value in values.items() if name in camera_fields}
        camera = SimulationSettings.of(changes) if camera is None else replace(camera, **changes)
        return cls(camera=camera, **{name: value for name, value in values.items() if name in sweep_fields})

    @property
    def dial(self) -> Floats:
        """Dial of the monochromator, shape (step,) [nm]."""
        return np.linspace(self.first_step_nm, self.last_step_nm, self.steps)

    @property
    def exposure_time(self) -> Floats:
        """Exposure of every step, shape (step,) [s]."""
        return self._every_step(self.step_exposure_ms) / 1000.0

    @property
    def dark_exposure_time(self) -> Floats:
        """Exposure of every step's dark frames, shape (step,) [s]."""
        exposures = self.step_exposure_ms if self.dark_exposure_ms is None else self.dark_exposure_ms
        return self._every_step(exposures) / 1000.0

    @property
    def monochromator_fwhm(self) -> Floats:
        """Spectral width of every step, shape (step,) [nm]."""
        return self._every_step(self.monochromator_fwhm_nm)

    def _every_step(self, value: PerStep) -> Floats:
        return np.resize(np.asarray(value, dtype=np.float64), self.steps)


# keys of the random streams [seed, stream, step], so that values do not depend on other steps
_LINE_NOISE, _DARK_NOISE, _POWER_METER, _DIAL = 30, 31, 32, 33

_MAX_GRID_STEP_NM = {"gaussian": 0.05, "triangle": 0.02}  # finer for the corners of triangles
_MAX_SHIFT_STEP_NM = 0.1


# Mean and variance over the frames of a step, shape (band, cross_track).
class Frames(NamedTuple):
    mean: Floats32  # [count]
    variance: Floats32  # variance of a frame [count2]


class Sweep:
    def __init__(self, settings: SweepSettings) -> None:
        self.settings = settings
        self.camera = Camera.of(settings.camera)
        # Shifts at which integrals are computed, and the matrix (cross_track, shift) that interpolates them
        # to columns. Few distinct shifts are used directly; many are interpolated by Lagrange's cubic from
        # an even table.
        shifts = self.camera.imager.wavelength_shift
        distinct, column = np.unique(shifts, return_inverse=True)
        step = min(_MAX_SHIFT_STEP_NM, settings.monochromator_fwhm.min() / 25)
        cells = int(np.ceil((distinct[-1] - distinct[0]) / step))
        self._shifts, self._to_columns = distinct, np.eye(len(distinct))[column]
        if len(distinct) > cells + 3:
            self._shifts = distinct[0] + step * np.arange(-1, cells + 2)
            place = (shifts - self._shifts[0]) / step
            lower = np.clip(np.floor(place).astype(int), 1, len(self._shifts) - 3)
            self._to_columns = np.zeros((len(shifts), len(self._shifts)))
            np.put_along_axis(
                self._to_columns, lower[:, None] + np.arange(-1, 3), cubic_weights(place - lower), axis=1
            )

    def _rng(self, stream: int, *key: int) -> np.random.Generator:
        return np.random.default_rng([self.settings.camera.seed, stream, *key])

    @cached_property
    def wavelength(self) -> Floats:
        # true centre wavelength of every step, shape (step,) [nm]
        settings = self.settings
        jitter = settings.monochromator_jitter_nm * self._rng(_DIAL).standard_normal(settings.steps)
        return np.asarray(settings.dial + settings.monochromator_offset_nm + jitter)

    @cached_property
    def beam(self) -> Floats:
        # power of the beam in a column relative to the brightest column, shape (step, cross_track)
        settings, columns = self.settings, self.settings.camera.columns
        if settings.beam_fwhm_columns is None:
            return np.ones((settings.steps, columns))
        centre = columns // 2 + settings.beam_wander_columns * np.sin(
            np.linspace(0.0, 2 * np.pi, settings.steps)
        )
        offset = (np.arange(columns) - centre[:, None]) / settings.beam_fwhm_columns
        return np.asarray(np.exp(-4.0 * np.log(2.0) * offset**2))

    @cached_property
    def power(self) -> Floats:
        # power of the beam at every step, shape (step,) [W]: a halogen lamp with a blazed grating
        lamp = 0.25 + 0.75 * np.exp(-0.5 * ((self.wavelength - 660.0) / 170.0) ** 2)
        return self.settings.beam_power_w * lamp

    @cached_property
    def recorded_flux(self) -> Floats:
        # reading of the power meter, shape (step,) or (step, cross_track) [W]
        settings = self.settings
        error = settings.flux_noise * self._rng(_POWER_METER).standard_normal(settings.steps)
        reading = self.power * (1.0 + settings.flux_bias) * (1.0 + error)
        return (
            np.asarray(reading)
            if settings.beam_fwhm_columns is None or not settings.beam_recorded
            else np.asarray(reading[:, None] * self.beam)
        )

    def _order_integrals(self, step: int, order: int) -> Floats:
        # integrals of a diffraction order, whose light appears at ``order`` x its wavelength
        imager, centre = self.camera.imager, self.wavelength[step]
        # The grid is even and symmetric around the centre and includes the corners of a triangle, so that a
        # sum equals the integral to 2e-5 of the peak. Weights have unit sum.
        fwhm, shape = float(self.settings.monochromator_fwhm[step]), self.settings.monochromator_shape
        finest = min(_MAX_GRID_STEP_NM[shape], fwhm / 40.0, float(imager.fwhm.min()) / order / 40.0)
        divisions = int(np.ceil(fwhm / finest))
        side = divisions if shape == "triangle" else int(np.ceil(GAUSSIAN_REACH * divisions))
        offset: Floats = np.asarray(np.arange(-side, side + 1) * (fwhm / divisions), dtype=np.float64)
        height = (
            np.asarray(1.0 - np.abs(offset) / fwhm)
            if shape == "triangle"
            else np.exp(-4.0 * np.log(2.0) * (offset / fwhm) ** 2)
        )
        weights = height / height.sum()
        grid = centre + offset
        weights = weights * imager.responsivity(grid)
        integrals = np.zeros((len(imager.wavelength), self.settings.camera.columns))
        cell = order * (offset[1] - offset[0])
        for band in np.flatnonzero(
            np.abs(imager.wavelength - order * centre) <= (imager.whole_reach + order * offset[-1])
        ).tolist():
            distance = order * grid - (imager.wavelength[band] + self._shifts[:, None])
            integrals[band] = self._to_columns @ (imager.line_shape(band, distance, cell) @ weights)
        return integrals

    def signal(self, step: int) -> Floats:
        # noise-free counts above the dark, shape (band, cross_track) [count]
        settings, imager = self.settings, self.camera.imager
        energy = settings.exposure_time[step] * settings.capture_fraction * self.power[step] * self.beam[step]
        # the beam is measured at the slit, after the blur of the fore optics; the spectrograph displaces the
        # images of bands
        if self.camera.optics is not None:
            energy = self.camera.optics.displaced(energy)
        # INT m_k R_b,x d lambda without element factors, shape (band, cross_track)
        integrals = self._order_integrals(step, 1)
        if self.settings.second_order:
            integrals += self.settings.second_order * self._order_integrals(step, 2)
        if (optics := self.camera.optics) is not None and optics.has_stray_light:
            integrals += optics.stray_matrix @ integrals
        signal = energy * integrals * imager.element_factor
        signal[self.camera.bad] = 0.0
        if settings.nonlinearity:
            signal -= settings.nonlinearity * signal**2 / self.camera.detector(0.0).saturation_count
        return np.asarray(signal)

    def frames(self, step: int) -> Frames:
        settings = self.settings
        dark = self.camera.detector(float(settings.exposure_time[step])).dark + self.camera.pedestal
        rng = self._rng(_LINE_NOISE, step) if settings.camera.noise else None
        return self._average(self.signal(step), dark, settings.frames, rng)

    def dark(self, step: int) -> Frames:
        # dark frames of a step; a dark for all steps is that of step 0
        settings = self.settings.camera
        level = self.camera.detector(float(self.settings.dark_exposure_time[step])).dark
        rng = self._rng(_DARK_NOISE, step) if settings.noise and settings.dark_noise else None
        return self._average(np.zeros_like(level), level, settings.dark_frames, rng)

    def _average(self, signal: Floats, dark: Floats, frames: int, rng: np.random.Generator | None) -> Frames:
        # mean and variance of ``frames`` frames, drawn from their distributions: means of whole counts are
        # multiples of 1 / frames, and rounding adds 1/12 to the variance of a frame (valid for noise above
        # some 0.4 counts)
        camera, settings = self.camera, self.settings.camera
        mean = signal + dark
        variance = np.zeros_like(mean)
        if rng is not None:
            variance = np.maximum(signal, 0.0) / camera.electrons_per_count + camera.read_noise**2
            rounded = (1.0 - 1.0 / frames) / 12.0 if settings.quantise else 0.0
            mean += np.sqrt((variance + rounded) / frames) * rng.standard_normal(mean.shape, dtype=np.float32)
            variance += 1.0 / 12.0 if settings.quantise else 0.0
            if frames > 1:
                shape = (frames - 1) / 2.0
                variance *= rng.standard_gamma(shape, mean.shape, dtype=np.float32) / shape
            else:
                variance[:] = np.nan
        if settings.quantise:
            saturation = camera.detector(0.0).saturation_count
            variance[mean >= saturation] = 0.0
            np.clip(mean, 0.0, saturation, out=mean)
            divisor = 1 if rng is None else frames
            mean = np.rint(mean * divisor) / divisor
        return Frames(mean.astype(np.float32), variance.astype(np.float32))
