"""A monochromator sweep of the simulated camera: what 61 lines do to every detector element.

At step k an element (band b, column x) counts

    n = dark(t) + t phi[k,x] INT m_k(lambda) R_b,x(lambda) d lambda,

m_k the monochromator's line of unit area, phi the power that enters slit width x one column, R the element's
absolute response (see `hyperpaint.simulation.camera`). The integral is done numerically for every element:
nothing is taken to vary slowly, nothing to be separable, and no calibration formula appears. Columns differ
by their smile and their own factor only, so that it is done on a table of shifts and interpolated.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hyperpaint.base.arrays import Floats, Floats32
from hyperpaint.base.errors import FormatError, Problems, SchemaError
from hyperpaint.base.input_files import read_limited
from hyperpaint.base.schema import MONOCHROMATOR_SHAPES
from hyperpaint.base.units import takes_quantities

from .camera import CAMERA_FIELDS, GAUSSIAN_REACH, Camera, cubic_weights
from .setting_checks import check_choice, check_flag, check_number, check_whole, is_number
from .settings import SimulationSettings

SWEEP_NAME = "simulated monochromator sweep"
_MOST_BYTES = 64 << 20


PerStep = float | Sequence[float] | Floats

# also known to flights: what the electronics do to a frame, in the lab as in the air
_FRAME_FIELDS = frozenset({"noise", "dark_noise", "quantise", "dark_frames"})


@takes_quantities(
    first_step_nm="nm", last_step_nm="nm", monochromator_fwhm_nm="nm", monochromator_offset_nm="nm",
    monochromator_jitter_nm="nm", beam_power_w="W", step_exposure_ms="ms", dark_exposure_ms="ms",
)  # fmt: skip
@dataclass(frozen=True, kw_only=True)
class SweepSettings:
    """Effects of a simulated monochromator sweep; every effect can be switched off.

    Attributes
    ----------
    camera
        Settings of the camera, with ``noise``, ``dark_noise``, ``quantise`` and ``dark_frames`` as in flight.
    steps
        Wavelengths of the sweep, evenly spaced.
    first_step_nm, last_step_nm
        What the monochromator's dial says at the outer steps [nm].
    monochromator_fwhm_nm
        Full width at half maximum of the monochromator's line [nm]; one, or one a step.
    monochromator_shape
        "gaussian", or "triangle" (equal slits).
    monochromator_offset_nm, monochromator_jitter_nm
        True wavelength minus what the dial says, and its spread from step to step [nm].
    beam_power_w
        Radiant flux of the whole beam where the lamp is brightest [W].
    capture_fraction
        Share of it that enters slit width x one column, all bands together [1].
    beam_fwhm_columns
        Full width at half maximum of a Gaussian beam along the slit [columns]; None lights all columns alike.
    beam_wander_columns
        How far the centre of that beam wanders to either side during the sweep [columns].
    beam_recorded
        Whether ``flux`` says what every column received; otherwise it says what the brightest one did.
    flux_bias, flux_noise
        Relative error of the power meter, common to the sweep, and its spread from step to step.
    step_exposure_ms
        Exposure [ms]; one, or one a step.
    dark_exposure_ms
        Exposure of the dark frames [ms]: one, several that steps take in turn, or None for the steps' own.
    frames
        Frames averaged in a step.
    variance
        Whether the variance of the frames is kept.
    second_order
        Light of the grating's second order, which falls where twice its wavelength belongs, relative to the
        first.
    nonlinearity
        Relative loss of a signal that would fill the converter; proportional to the signal.

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
      monochromator_shape='box', expected one of gaussian, triangle
      frames=0, expected a whole number from 1 to 100000
    """

    camera: SimulationSettings = field(default_factory=SimulationSettings)
    steps: int = 61
    first_step_nm: float = 400.0
    last_step_nm: float = 1000.0
    monochromator_fwhm_nm: PerStep = 2.0
    monochromator_shape: str = "gaussian"
    monochromator_offset_nm: float = 0.0
    monochromator_jitter_nm: float = 0.0
    beam_power_w: float = 3e-6
    capture_fraction: float = 1e-6
    beam_fwhm_columns: float | None = None
    beam_wander_columns: float = 0.0
    beam_recorded: bool = True
    flux_bias: float = 0.0
    flux_noise: float = 0.0
    step_exposure_ms: PerStep = 50.0
    dark_exposure_ms: PerStep | None = None
    frames: int = 50
    variance: bool = True
    second_order: float = 0.0
    nonlinearity: float = 0.0

    def __post_init__(self) -> None:
        problems = Problems("the sweep cannot be simulated", SchemaError)
        check_choice(problems, "monochromator_shape", self.monochromator_shape, MONOCHROMATOR_SHAPES)
        for name in ("steps", "frames"):
            check_whole(problems, name, getattr(self, name), 1, 100_000)
        for name, (low, high) in _RANGES.items():
            check_number(problems, name, getattr(self, name), low, high)
        for name in ("variance", "beam_recorded"):
            check_flag(problems, name, getattr(self, name))
        if self.beam_fwhm_columns is not None:
            check_number(problems, "beam_fwhm_columns", self.beam_fwhm_columns, 0.1, 1e6)
        for name, (low, high) in _PER_STEP.items():
            self._check_per_step(problems, name, low, high)
        problems.raise_if_any()

    def _check_per_step(self, problems: Problems, name: str, low: float, high: float) -> None:
        value = getattr(self, name)
        if name == "dark_exposure_ms" and value is None:
            return
        values = np.atleast_1d(np.asarray(value, dtype=object))
        within = (is_number(one) and low <= one <= high for one in values.tolist())
        if values.ndim != 1 or not len(values) or not all(within):
            problems.add(f"{name}={value!r}, expected one number from {low:g} to {high:g}, or one a step")
        elif name != "dark_exposure_ms" and np.ndim(value) and len(values) != self.steps:
            problems.add(
                f"{name} has {len(values)} values, expected one, or one for each of {self.steps} steps"
            )

    @classmethod
    def of(cls, values: Mapping[str, Any], camera: SimulationSettings | None = None) -> SweepSettings:
        """Return settings from keywords, of the sweep and of the camera.

        Parameters
        ----------
        values
            Fields of this class and, of `SimulationSettings`, those of camera and frames.
        camera
            A camera that is there already, of which ``values`` can only change what is done to frames.

        Raises
        ------
        SchemaError
            Keywords are unknown, or values out of range.
        """
        own = {one.name for one in fields(cls)} - {"camera"}
        theirs = _FRAME_FIELDS if camera is not None else _FRAME_FIELDS | CAMERA_FIELDS
        unknown = sorted(set(values) - own - theirs)
        if unknown:
            allowed = ", ".join(sorted(own | theirs))
            raise SchemaError(f"unknown settings {', '.join(unknown)}; expected some of {allowed}")
        changes = {name: value for name, value in values.items() if name in theirs}
        camera = SimulationSettings.of(changes) if camera is None else replace(camera, **changes)
        return cls(camera=camera, **{name: value for name, value in values.items() if name in own})

    @property
    def dial(self) -> Floats:
        """What the monochromator says, shape (step,) [nm]."""
        return np.linspace(self.first_step_nm, self.last_step_nm, self.steps)

    @property
    def exposure_time(self) -> Floats:
        """Exposure of every step, shape (step,) [s]."""
        return self._every_step(self.step_exposure_ms) / 1000.0

    @property
    def dark_exposure_time(self) -> Floats:
        """Exposure of every step's dark frames, shape (step,) [s]."""
        given = self.dark_exposure_ms
        if given is None:
            return self.exposure_time
        return np.asarray(np.resize(np.asarray(given, dtype=np.float64), self.steps)) / 1000.0

    @property
    def monochromator_fwhm(self) -> Floats:
        """Width of every step's line, shape (step,) [nm]."""
        return self._every_step(self.monochromator_fwhm_nm)

    def _every_step(self, value: PerStep) -> Floats:
        return np.array(np.broadcast_to(np.asarray(value, dtype=np.float64), self.steps))


_RANGES = {
    "first_step_nm": (300.0, 1200.0), "last_step_nm": (300.0, 1200.0),
    "monochromator_offset_nm": (-50.0, 50.0), "monochromator_jitter_nm": (0.0, 50.0),
    "beam_power_w": (1e-15, 1e3), "capture_fraction": (1e-15, 1.0), "beam_wander_columns": (0.0, 1e6),
    "flux_bias": (-0.9, 10.0), "flux_noise": (0.0, 0.3), "second_order": (0.0, 1.0),
    "nonlinearity": (-0.5, 0.5),
}  # fmt: skip

_PER_STEP = {
    "monochromator_fwhm_nm": (0.02, 100.0),
    "step_exposure_ms": (1e-3, 1e6),
    "dark_exposure_ms": (1e-3, 1e6),
}


# keys of the random streams: [seed, stream, step], so that nothing depends on which steps are made
_LINE_NOISE, _DARK_NOISE, _POWER_METER, _DIAL = 30, 31, 32, 33

_GRID_STEP = {"gaussian": 0.05, "triangle": 0.02}  # nm, coarsest allowed; corners want the finer one
_SHIFT_STEP = 0.1  # nm, coarsest allowed


class Frames(NamedTuple):
    """Frames of one step, reduced, shape (band, cross_track)."""

    mean: Floats32  # [count]
    variance: Floats32  # of one frame over the frames [count2]


def is_simulated_sweep(store: Path, truth: str) -> bool:
    """Tell whether a store is a simulated sweep, or its truth, which has the attribute ``truth``."""
    try:
        attributes = json.loads(read_limited(store / "zarr.json", _MOST_BYTES, "metadata"))["attributes"]
        return attributes.get("name") == SWEEP_NAME or truth in attributes
    except (FormatError, ValueError, KeyError, TypeError, AttributeError):
        return False


class Sweep:
    """A sweep, step by step."""

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

    def line_integrals(self, step: int) -> Floats:
        """Return INT m_k R_b,x d lambda without the elements' own factors, shape (band, cross_track)."""
        integrals = self._order(step, 1)
        if self.settings.second_order:
            integrals += self.settings.second_order * self._order(step, 2)
        if (optics := self.camera.optics) is not None and optics.has_stray_light:
            integrals += optics.stray_matrix @ integrals
        return integrals

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
        integrals = np.zeros((len(imager.wavelength), self.settings.camera.columns))
        cell = order * (offset[1] - offset[0])
        for band in np.flatnonzero(np.abs(imager.wavelength - order * centre) <= reach).tolist():
            distance = order * grid - (imager.wavelength[band] + self._shifts[:, None])
            at_shifts: Floats = imager.line_shape(band, distance, cell) @ weights
            integrals[band] = self._to_columns @ at_shifts
        return integrals

    def signal(self, step: int) -> Floats:
        """Return the noise-free counts above dark, shape (band, cross_track) [count]."""
        settings, imager = self.settings, self.camera.imager
        energy = settings.exposure_time[step] * settings.capture_fraction * self.power[step] * self.beam[step]
        # the beam is what enters the slit, which the fore optics have blurred already; behind it, a band's
        # image is displaced
        if self.camera.optics is not None:
            energy = self.camera.optics.displaced(energy)
        signal = energy * self.line_integrals(step) * imager.element_factor
        signal[self.camera.bad] = 0.0
        if settings.nonlinearity:
            full = self.camera.detector(0.0).saturation_count
            signal -= settings.nonlinearity * signal**2 / full
        return np.asarray(signal)

    def frames(self, step: int) -> Frames:
        """Return the frames of a step."""
        settings = self.settings
        dark = self.camera.detector(float(settings.exposure_time[step])).dark + self.camera.pedestal
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
    reach = parts if shape == "triangle" else int(np.ceil(GAUSSIAN_REACH * parts))
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
    weights = np.zeros((len(shifts), len(table)))
    np.put_along_axis(weights, left[:, None] + np.arange(-1, 3), cubic_weights(place - left), axis=1)
    return table, weights
