"""What a simulated lab sweep is made of: every effect is one field, with its unit and its default."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.schema import MONOCHROMATOR_SHAPES

from .camera import CAMERA_FIELDS
from .settings import SimulationSettings

__all__ = ["SweepSettings"]

PerStep = float | Sequence[float] | Floats

# also known to flights: what the electronics do to a frame, in the lab as in the air
_FRAME_FIELDS = frozenset({"noise", "dark_noise", "quantise", "dark_frames"})


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
    stray_light
        Light scattered into broad wings over all bands, relative to the line.
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
    stray_light: float = 0.0
    second_order: float = 0.0
    nonlinearity: float = 0.0

    def __post_init__(self) -> None:
        problems = Problems("the sweep cannot be simulated", SchemaError)
        if self.monochromator_shape not in MONOCHROMATOR_SHAPES:
            allowed = ", ".join(MONOCHROMATOR_SHAPES)
            problems.add(f"monochromator_shape={self.monochromator_shape!r}, expected one of {allowed}")
        for name, (lowest, highest) in _WHOLE.items():
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or not lowest <= value <= highest:
                problems.add(f"{name}={value!r}, expected a whole number from {lowest} to {highest}")
        for name, (low, high) in _RANGES.items():
            if not _inside(getattr(self, name), low, high):
                problems.add(f"{name}={getattr(self, name)!r}, expected a number from {low:g} to {high:g}")
        for name in ("variance", "beam_recorded"):
            if not isinstance(getattr(self, name), bool):
                problems.add(f"{name}={getattr(self, name)!r}, expected True or False")
        if self.beam_fwhm_columns is not None and not _inside(self.beam_fwhm_columns, 0.1, 1e6):
            problems.add(f"beam_fwhm_columns={self.beam_fwhm_columns!r}, expected a number from 0.1, or None")
        for name, (low, high) in _PER_STEP.items():
            self._check_per_step(problems, name, low, high)
        problems.raise_if_any()

    def _check_per_step(self, problems: Problems, name: str, low: float, high: float) -> None:
        value = getattr(self, name)
        if name == "dark_exposure_ms" and value is None:
            return
        values = np.atleast_1d(np.asarray(value, dtype=object))
        if values.ndim != 1 or not len(values) or not all(_inside(one, low, high) for one in values.tolist()):
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
            known = ", ".join(sorted(own | theirs))
            raise SchemaError(f"unknown settings {', '.join(unknown)}; expected some of {known}")
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


def _inside(value: object, low: float, high: float) -> bool:
    kinds = int | float | np.integer | np.floating
    return isinstance(value, kinds) and not isinstance(value, bool) and bool(low <= value <= high)


_WHOLE = {"steps": (1, 100_000), "frames": (1, 100_000)}

_RANGES = {
    "first_step_nm": (300.0, 1200.0),
    "last_step_nm": (300.0, 1200.0),
    "monochromator_offset_nm": (-50.0, 50.0),
    "monochromator_jitter_nm": (0.0, 50.0),
    "beam_power_w": (1e-15, 1e3),
    "capture_fraction": (1e-15, 1.0),
    "beam_wander_columns": (0.0, 1e6),
    "flux_bias": (-0.9, 10.0),
    "flux_noise": (0.0, 0.3),
    "stray_light": (0.0, 0.5),
    "second_order": (0.0, 1.0),
    "nonlinearity": (-0.5, 0.5),
}

_PER_STEP = {
    "monochromator_fwhm_nm": (0.02, 100.0),
    "step_exposure_ms": (1e-3, 1e6),
    "dark_exposure_ms": (1e-3, 1e6),
}
