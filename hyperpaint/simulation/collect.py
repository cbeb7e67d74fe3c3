"""A simulated collect: files of the instruments, and calibration, truth and sweeps as Zarr stores.

Two field spectrometers measured the paints of the cars on the ground before the flight. The truth of their
files is the spectrum of the paint near normal, without mirrored sky. Beyond 1000 nm, where only the SVC
measures, the light has no absorption bands.

A region of a paint is a rectangle of neighbouring pixels that show only the paint of one car, in the sun,
without mirrored sun, and at nearly the same height. A paint gets its largest rectangle over all cars and
flight lines, minus a margin. Lines are processed once and in order, so that memory does not grow with the
flight.

A sweep has the response of every detector element to the lines of a monochromator. At step k an element
(band b, column x) counts

    n = dark(t) + t phi[k,x] INT m_k(lambda) R_b,x(lambda) d lambda,

with the spectrum m_k of the monochromator of unit area, the power phi into the area of slit width x one
column, and the absolute response R of the element (see `hyperpaint.simulation.camera`). The integral is
computed numerically for every element, without assuming slow variation or separability, and without a
calibration formula. Columns differ only in smile and element factor, so that it is computed for a table of
shifts and interpolated.
"""

import itertools
import json
import shutil
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple, Self

import numpy as np
import xarray as xr
import zarr
from zarr.codecs import BloscCodec

from hyperpaint.base import (
    CHUNK_LINES,
    CUBE,
    FORMAT_VERSION,
    MONOCHROMATOR_SHAPES,
    STEP,
    SWEEP_VARIABLES,
    TIME_UNITS,
    VARIABLES,
    Bools,
    Floats,
    Floats32,
    FormatError,
    Ints,
    Problems,
    Progress,
    SchemaError,
    StoreError,
    Variable,
    check_fields,
    declared,
    documented,
    fact,
    head_of,
    input_path,
    read_limited,
)

from .atmosphere import spectral_grid
from .camera import GAUSSIAN_REACH, Camera, convolve_gaussian, cubic_weights
from .flight import CheckerboardFlight, Flight, Lines, PlanFlight, RenderedFlight, sky_irradiance
from .instruments import (
    ASD_WAVELENGTH,
    CAMERA_SOFTWARE,
    SVC_DETECTORS,
    SVC_WAVELENGTH,
    write_asd,
    write_asd_reflectance,
    write_bil_header,
    write_frame_index,
    write_navigation,
    write_sbet,
    write_settings,
    write_svc,
)
from .rendering.platforms import CONVENTION
from .settings import CAMERA_FIELDS, ORIGIN, PIXEL_ANGLE_RAD, SimulationSettings

PerStep = float | Sequence[float] | Floats

_LAMP_LINE_NM = 2.0  # full width of the lamp lines of a sweep

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
        _LAMP_LINE_NM,
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
        with Problems("the sweep cannot be simulated", SchemaError) as problems:
            check_fields(self, problems)
            for name in ("monochromator_fwhm_nm", "step_exposure_ms"):
                number = np.size(getattr(self, name))
                problems.add_if(
                    np.ndim(getattr(self, name)) == 1 and number != self.steps,
                    f"{name} has {number} values",
                    expected=f"one, or one for each of {self.steps} steps",
                    code="length-mismatch",
                )

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

    @cached_property
    def wavelength(self) -> Floats:
        # true centre wavelength of every step, shape (step,) [nm]
        settings = self.settings
        rng = np.random.default_rng([settings.camera.seed, _DIAL])
        jitter = settings.monochromator_jitter_nm * rng.standard_normal(settings.steps)
        return np.asarray(settings.dial + settings.monochromator_offset_nm + jitter)

    @cached_property
    def beam(self) -> Floats:
        # power of the beam in a column relative to the brightest column, shape (step, cross_track)
        settings, columns = self.settings, self.settings.camera.columns
        centre = columns // 2 + settings.beam_wander_columns * np.sin(
            np.linspace(0.0, 2 * np.pi, settings.steps)
        )
        offset = (np.arange(columns) - centre[:, None]) / (settings.beam_fwhm_columns or np.inf)
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
        rng = np.random.default_rng([settings.camera.seed, _POWER_METER])
        error = settings.flux_noise * rng.standard_normal(settings.steps)
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
        seed = [settings.camera.seed, _LINE_NOISE, step]
        rng = np.random.default_rng(seed) if settings.camera.noise else None
        return self._average(self.signal(step), dark, settings.frames, rng)

    def dark(self, step: int) -> Frames:
        # dark frames of a step; a dark for all steps is that of step 0
        settings = self.settings.camera
        level = self.camera.detector(float(self.settings.dark_exposure_time[step])).dark
        is_noisy = settings.noise and settings.dark_noise
        rng = np.random.default_rng([settings.seed, _DARK_NOISE, step]) if is_noisy else None
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


# --- labelled arrays and stores -----------------------------------------------------------------------------

ALONG_TRACK, BAND, CROSS_TRACK = CUBE
_PLANE = (ALONG_TRACK, CROSS_TRACK)

#: Prefix of the names of truth variables.
TRUTH = "true_"

#: Name of a simulated sweep.
SWEEP_NAME = "simulated monochromator sweep"

_MAX_METADATA_BYTES = 64 << 20

_MASKS = {
    "saturated": "True where the converter was full in any band",
    "glint": "True where the pixel mirrors the sun",
}


def _surface_attrs(flight: Flight) -> dict[str, Any]:
    return {
        "long_name": "Class of the surface",
        "flag_values": list(range(len(flight.surfaces))),
        "flag_meanings": " ".join(flight.name_of(name).replace(" ", "_") for name in flight.surfaces),
    }


def labelled(row: Variable, values: Any, dims: tuple[str, ...] | None = None) -> xr.Variable:
    # values with the dims, dtype and attributes of a row of the table of variables
    values = np.asarray(values).astype(row.dtype)
    fitting = (d for d in (row.dims, *row.alternatives) if len(d) == values.ndim)
    return xr.Variable(next(fitting) if dims is None else dims, values, row.attrs)


def labelled_variable(name: str, values: Any, dims: tuple[str, ...] | None = None) -> xr.Variable:
    return labelled(VARIABLES[name], values, dims)


def _band_coords(flight: Flight) -> dict[str, xr.Variable]:
    return {
        "wavelength": labelled_variable("wavelength", flight.wavelength),
        "fwhm": labelled_variable("fwhm", flight.imager.fwhm),
        "good": labelled_variable("good", np.ones(flight.settings.bands)),
        "wavelength_shift": labelled_variable(
            "wavelength_shift", flight.imager.wavelength_shift, (CROSS_TRACK,)
        ),
    }


def _calibration(flight: Flight) -> dict[str, xr.Variable]:
    u = flight.settings.gain_u
    stated = (
        {"radiance_gain_u_systematic": labelled_variable("radiance_gain_u_systematic", u, ())} if u else {}
    )
    return stated | {
        "radiance_gain": labelled_variable(
            "radiance_gain", flight.camera.radiance_gain(flight.response_area)
        ),
        "electrons_per_count": labelled_variable("electrons_per_count", flight.settings.electrons_per_count),
        "read_noise": labelled_variable("read_noise", flight.settings.read_noise),
        "look_angle": labelled_variable("look_angle", flight.look_angle),
    }


def write_calibration(flight: Flight, path: Path) -> None:
    # write ``calibration.zarr``: the gain of every element, wavelengths, smile, line shape, noise
    optics = flight.camera.optics
    stray_light = (
        {} if optics is None else {"stray_light": labelled_variable("stray_light", optics.stray_matrix)}
    )
    calibration = xr.Dataset(
        _calibration(flight) | stray_light,
        coords=_band_coords(flight),
        attrs={
            "hyperpaint_format": FORMAT_VERSION,
            "name": "simulated calibration",
            "srf_shape": flight.settings.srf_shape,
            "etendue": flight.camera.etendue,
            "history": f"exact calibration of the simulated imager, seed {flight.settings.seed}",
        },
    )
    # every array is one chunk and written completely, so that a missing chunk is a fault
    chunks = {
        str(name): {"chunks": array.shape} for name, array in calibration.variables.items() if array.ndim
    }
    _write_small(calibration, path, **chunks)
    _consolidate(path)


def _write_small(dataset: xr.Dataset, path: Path, **encoding: dict[str, Any]) -> None:
    # write with a codec that hyperpaint reads, instead of zarr's default zstd
    codec = BloscCodec(typesize=1, cname="lz4", clevel=5, shuffle="bitshuffle")
    forms = {name: {"compressors": [codec], **encoding.get(str(name), {})} for name in dataset.variables}
    store = zarr.storage.LocalStore(path)  # xarray would take a path such as dask::x for a URL
    dataset.to_zarr(store, mode="w", zarr_format=3, consolidated=False, encoding=forms)


def _consolidate(path: Path) -> None:
    # consolidate metadata, which `xarray.open_zarr` reads first
    # zarr warns that the specification of version 3 does not have consolidated metadata
    with warnings.catch_warnings(action="ignore"):
        zarr.consolidate_metadata(path)


def _line_coords(flight: Flight, recorded: Bools | None = None) -> dict[str, xr.Variable]:
    stamps = (flight.start + flight.line_times).astype("datetime64[ns]")
    if recorded is not None:
        stamps[~recorded] = np.datetime64("NaT", "ns")
    lines, _, columns = (np.arange(size) for size in flight.settings.shape)
    values = {"time": stamps, "frame": lines, ALONG_TRACK: lines, CROSS_TRACK: columns}
    return {name: labelled_variable(name, column_values) for name, column_values in values.items()}


# ``truth.zarr`` of a flight, written in blocks of lines; replaces an existing store.
class TruthStore:
    def __init__(self, flight: Flight, path: Path) -> None:
        settings = flight.settings
        self._saturation_count = flight.detector.saturation_count
        head = xr.Dataset(
            {
                f"corner_{name}": xr.Variable(
                    "corner",
                    values,
                    {"long_name": f"{name.capitalize()} of a corner of four squares", "units": "m"},
                )
                for name, values in (flight.corners.items() if isinstance(flight, CheckerboardFlight) else ())
            },
            {**_band_coords(flight), **_line_coords(flight)},
            {
                "hyperpaint_format": FORMAT_VERSION,
                "name": "truth of a simulated collect",
                "srf_shape": settings.srf_shape,
                "irradiance_srf_shape": "gaussian",
                "crs": flight.plane.crs,
                "ground": flight.frame.height,
                "boresight": list(flight.trajectory.boresight),
                "lever_arm": list(flight.trajectory.lever_arm),
                "frame_clock_offset_s": float(settings.frame_clock_offset_s),
            },
        )
        _write_small(
            head, path, time={"dtype": "int64", "units": TIME_UNITS, "calendar": "proleptic_gregorian"}
        )
        group = zarr.open_group(path, mode="r+")
        layers: dict[str, tuple[tuple[str, ...], str, dict[str, Any]]] = {
            "reflectance": (CUBE, "float32", VARIABLES["reflectance"].attrs),
            "radiance": (CUBE, "float32", VARIABLES["radiance"].attrs),
            "surface": (_PLANE, "int16", _surface_attrs(flight)),
            "no_data": ((ALONG_TRACK,), "bool", {"long_name": "True where the frame was never recorded"}),
            **{name: (_PLANE, "bool", {"long_name": text}) for name, text in _MASKS.items()},
            **{name: (_PLANE, layer.dtype, dict(layer.attrs)) for name, layer in flight.layers.items()},
        }
        sizes = dict(zip(CUBE, settings.shape, strict=True))
        self._arrays = {
            name: _create_array(
                group, name, tuple(sizes[dim] for dim in dims), dims=dims, dtype=dtype, attrs=attrs
            )
            for name, (dims, dtype, attrs) in layers.items()
        }
        _consolidate(path)

    def write(self, start: int, lines: Lines, recorded: Bools) -> None:
        rows = slice(start, start + len(recorded))
        for name, values in {
            **{name: getattr(lines, name) for name in ("reflectance", "radiance", "surface", "glint")},
            "saturated": _saturated(lines, self._saturation_count),
            "no_data": ~recorded,
            **lines.layers,
        }.items():
            self._arrays[name][rows] = values


def _saturated(lines: Lines, saturation_count: int) -> Bools:
    return np.asarray((lines.counts >= saturation_count - 0.5).any(axis=1))


def _create_array(
    group: zarr.Group,
    name: str,
    shape: tuple[int, ...],
    *,
    dims: tuple[str, ...],
    dtype: str,
    attrs: dict[str, Any],
    chunk_length: int = CHUNK_LINES,
) -> Any:
    # array with chunks of ``chunk_length`` along its first dim, to be filled in blocks
    kind = np.dtype(dtype)
    return group.create_array(
        name,
        shape=shape,
        chunks=(min(chunk_length, shape[0]), *shape[1:]),
        dtype=dtype,
        compressors=[BloscCodec(typesize=kind.itemsize, cname="lz4", clevel=5, shuffle="bitshuffle")],
        fill_value=np.nan if kind.kind == "f" else kind.type(0),
        dimension_names=dims,
        attributes=attrs,
        config={"write_empty_chunks": True},
    )


def line_dataset(flight: Flight, block: Lines, *, matched: bool) -> xr.Dataset:
    settings, detector = flight.settings, flight.detector
    recorded = settings.recorded
    counts = detector.convert(block.counts) if settings.quantise else block.counts
    counts[~recorded] = 65535
    dark = flight.dark_frames().mean(axis=0) if settings.quantise else detector.dark
    samples = flight.sky_samples()
    line = xr.Dataset(
        {
            "counts": xr.Variable(CUBE, counts, VARIABLES["counts"].attrs),
            "dark_counts": labelled_variable("dark_counts", dark, (BAND, CROSS_TRACK)),
            **_calibration(flight),
            "exposure_time": labelled_variable("exposure_time", settings.exposure_time),
            "saturation_count": labelled_variable("saturation_count", detector.saturation_count),
            "irradiance": labelled_variable("irradiance", samples.irradiance),
            "irradiance_fwhm": labelled_variable("irradiance_fwhm", settings.irradiance_fwhm_nm),
            "irradiance_max_gap": labelled_variable(
                "irradiance_max_gap", 2.5 * settings.irradiance_interval_s
            ),
            "true_radiance": xr.Variable(CUBE, block.radiance, VARIABLES["radiance"].attrs),
            "true_reflectance": xr.Variable(CUBE, block.reflectance, VARIABLES["reflectance"].attrs),
            "surface": xr.Variable(_PLANE, block.surface, _surface_attrs(flight)),
            "true_saturated": xr.Variable(_PLANE, _saturated(block, detector.saturation_count)),
            **{
                f"true_{name}": xr.Variable(_PLANE, block.layers[name], dict(layer.attrs))
                for name, layer in flight.layers.items()
            },
        },
        coords={
            **_band_coords(flight),
            **_line_coords(flight, recorded),
            **{
                name: labelled_variable(name, values)
                for name, values in flight.trajectory.pose(flight.line_times / 1e9).items()
            },
            "irradiance_time": labelled_variable(
                "irradiance_time", (flight.start + samples.middle).astype("datetime64[ns]")
            ),
            "irradiance_wavelength": labelled_variable("irradiance_wavelength", ASD_WAVELENGTH),
        },
        attrs={
            "name": "simulated line",
            **{f"convention_{key}": value for key, value in CONVENTION.items()},
            "srf_shape": settings.srf_shape,
            "irradiance_srf_shape": "gaussian",
        },
    )
    if matched:
        # irradiance weighted by the response of each element, INT E R / INT R
        values = np.asarray(np.einsum("kt,kbx->tbx", samples.factors, flight.incident) / flight.response_area)
        line["matched_irradiance"] = xr.Variable(
            (("irradiance_time", BAND, CROSS_TRACK)), values, VARIABLES["irradiance"].attrs
        )
    return line


def _scalar_or_step(values: Any) -> Any:
    # one value if all steps have the same value
    return values[0] if np.all(values == values[0]) else values


def _sweep_dataset(sweep: Sweep) -> xr.Dataset:
    settings, camera = sweep.settings, sweep.camera
    values: dict[str, Any] = {
        "flux": sweep.recorded_flux,
        "capture_fraction": settings.capture_fraction,
        "exposure_time": _scalar_or_step(settings.exposure_time),
        "dark_exposure_time": _scalar_or_step(settings.dark_exposure_time),
        "monochromator_fwhm": _scalar_or_step(settings.monochromator_fwhm),
        "frame_count": settings.frames,
        "dark_frame_count": settings.camera.dark_frames,
        "etendue": camera.etendue,
        "saturation_count": camera.detector(0.0).saturation_count,
    }
    return xr.Dataset(
        {name: labelled(SWEEP_VARIABLES[name], value) for name, value in values.items()},
        {"step_wavelength": labelled(SWEEP_VARIABLES["step_wavelength"], settings.dial)},
        {
            "name": SWEEP_NAME,
            "monochromator_shape": settings.monochromator_shape,
            "history": f"simulated by hyperpaint, seed {settings.camera.seed}",
        },
    )


def sweep_truth(sweep: Sweep) -> xr.Dataset:
    # expected results of a sweep's calibration; names start with `TRUTH`
    camera = sweep.camera
    imager = camera.imager
    values: dict[str, Any] = {
        "radiance_gain": camera.radiance_gain(),
        "responsivity": np.where(camera.bad, np.nan, camera.response_area / imager.spacing[:, None]),
        "wavelength": imager.wavelength,
        "wavelength_shift": imager.wavelength_shift,
        "fwhm": imager.fwhm,
        "dark_bias": camera.dark_bias,
        "dark_rate": camera.dark_rate,
        "electrons_per_count": camera.electrons_per_count,
        "read_noise": camera.read_noise,
    }
    variables = {name: labelled(VARIABLES[name], value) for name, value in values.items()}
    # the gain keeps float64, because calibrations are compared with it to better than 1e-3
    variables["radiance_gain"] = variables["radiance_gain"].copy(data=values["radiance_gain"])
    variables["step_wavelength"] = labelled(SWEEP_VARIABLES["step_wavelength"], sweep.wavelength)
    variables["bad"] = xr.Variable(
        (BAND, CROSS_TRACK), camera.bad, {"long_name": "True at elements that see no light"}
    )
    variables["flux"] = xr.Variable(
        (STEP, CROSS_TRACK),
        sweep.power[:, None] * sweep.beam,
        {**SWEEP_VARIABLES["flux"].attrs, "long_name": "Radiant flux, as every column receives it"},
    )
    optics = camera.optics
    if optics is not None and optics.has_stray_light:
        row = VARIABLES["stray_light"]
        variables["stray_light"] = xr.Variable(row.dims, optics.stray_matrix, row.attrs)
    if optics is not None and optics.keystone.any():
        attrs = {"long_name": "Displacement of a band's image to the right", "units": "column"}
        variables["keystone"] = xr.Variable((BAND,), optics.keystone, attrs)
    if camera.pedestal:
        attrs = {"long_name": "Counts of a frame beyond its light and its dark", "units": "count"}
        variables["pedestal"] = xr.Variable((), np.asarray(camera.pedestal), attrs)
    return xr.Dataset(
        {f"{TRUTH}{name}": variable for name, variable in variables.items()},
        attrs={f"{TRUTH}srf_shape": imager.shape},
    )


@documented()
def simulate_sweep(
    *, steps: int = 61, bands: int = 272, columns: int = 640, seed: int = 0, **effects: Any
) -> xr.Dataset:
    """Simulate a monochromator sweep in memory, with its truth.

    Parameters
    ----------
    steps
        Wavelengths of the sweep, from ``first_step_nm`` to ``last_step_nm``.
    bands, columns, seed
        Settings of the camera; a collect with equal settings has the same camera.
    **effects

    Returns
    -------
    A sweep with the variables of a store: ``counts`` (step, band, cross_track), float32 mean of the frames
    including the dark, ``counts_variance``, ``dark_counts``, ``flux`` and others; and its truth:
    ``true_radiance_gain``, ``true_wavelength``, ``true_wavelength_shift``, ``true_fwhm``,
    ``true_responsivity``, ``true_dark_bias``, ``true_dark_rate``, ``true_bad``; for a camera with these
    effects also ``true_stray_light``, ``true_keystone`` and ``true_pedestal``.

    Raises
    ------
    SchemaError
        An effect is unknown or out of range; all are listed.

    Examples
    --------
    The light of a lamp line, summed over its bands, gives the responsivity at its wavelength.

    >>> sweep = simulate_sweep(steps=3, columns=2, smile_nm=0, nonuniformity=0, noise=False, quantise=False)
    >>> line = (sweep.counts - sweep.dark_counts).sum("band") / sweep.exposure_time
    >>> responsivity = (line / sweep.flux / sweep.capture_fraction).isel(step=1, cross_track=0)
    >>> truth = np.interp(700.0, sweep.true_wavelength, sweep.true_responsivity[:, 0])
    >>> round(float(responsivity / truth), 3)
    1.0
    """
    values = {"steps": steps, "bands": bands, "columns": columns, "seed": seed, **effects}
    sweep = Sweep(SweepSettings.of(values))
    cubes = {name: np.empty(shape, dtype=np.float32) for name, shape in _shapes(sweep).items()}
    _fill(sweep, cubes)
    line, truth = _sweep_dataset(sweep), sweep_truth(sweep)
    line = line.assign({name: labelled(SWEEP_VARIABLES[name], values) for name, values in cubes.items()})
    return line.assign(truth.data_vars).assign_attrs(truth.attrs)


@documented(overwrite="own overwrite")
def write_sweep(
    path: str | Path,
    *,
    steps: int = 61,
    bands: int = 272,
    columns: int = 640,
    seed: int = 0,
    truth: bool = True,
    overwrite: bool = False,
    progress: Progress | None = None,
    **effects: Any,
) -> Path:
    """Simulate a sweep and write it as a Zarr store, step by step.

    Parameters
    ----------
    path
        The store. The truth is a separate store beside it: for ``sweep.zarr``, ``sweep_truth.zarr``.
    steps, bands, columns, seed
        As for `hyperpaint.simulation.simulate_sweep`.
    truth
        Write the truth.
    overwrite
    progress
    **effects

    Returns
    -------
    ``path``.

    Raises
    ------
    SchemaError
        An effect is unknown or out of range; all are listed.
    StoreError
        The path exists, and ``overwrite`` is not set.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = write_sweep(f"{folder}/sweep.zarr", steps=3, bands=8, columns=4)
    ...     dict(xr.open_zarr(path).counts.sizes)
    {'step': 3, 'band': 8, 'cross_track': 4}
    """
    values = {"steps": steps, "bands": bands, "columns": columns, "seed": seed, **effects}
    path = input_path(path, "a folder for the sweep", StoreError, "simulate to a folder, and copy it")
    for target in filter(Path.exists, (path, _truth_beside(path))):
        # remove only an earlier simulated sweep, or its truth
        try:
            text = read_limited(target / "zarr.json", _MAX_METADATA_BYTES, "metadata")
            attributes = json.loads(text)["attributes"]
            is_earlier = attributes.get("name") == SWEEP_NAME or f"{TRUTH}srf_shape" in attributes
        except (FormatError, ValueError, KeyError, TypeError, AttributeError):
            is_earlier = False
        StoreError.raise_if(
            not (overwrite and is_earlier),
            f"{target} exists",
            mend="choose another path, or replace an earlier sweep with overwrite=True",
            option="choose another path, or replace an earlier sweep with --overwrite",
            code="store-exists",
        )
        shutil.rmtree(target)
    store_sweep(Sweep(SweepSettings.of(values)), path, truth=truth, progress=progress)
    return path


def store_sweep(sweep: Sweep, path: Path, *, truth: bool = True, progress: Progress | None = None) -> None:
    if truth:
        _write_small(sweep_truth(sweep).assign_attrs(hyperpaint_format=FORMAT_VERSION), _truth_beside(path))
        _consolidate(_truth_beside(path))
    # xarray writes the small arrays; cubes are written step by step and are never complete in memory
    head = _sweep_dataset(sweep)
    head.attrs = {"hyperpaint_format": FORMAT_VERSION, **head.attrs}
    _write_small(head, path)
    group, cubes = zarr.open_group(path, mode="r+"), {}
    for name, shape in _shapes(sweep).items():
        row = SWEEP_VARIABLES[name]
        dims = next(d for d in (row.dims, *row.alternatives) if len(d) == len(shape))
        # a chunk holds one step; a dark for all steps is one chunk
        length = 1 if len(shape) == 3 else shape[0]
        cubes[name] = _create_array(
            group, name, shape, dims=dims, dtype=row.dtype, attrs=row.attrs, chunk_length=length
        )
    _fill(sweep, cubes, progress)
    _consolidate(path)


def _truth_beside(path: Path) -> Path:
    return path.with_name(f"{path.stem}_truth{path.suffix}")


def _shapes(sweep: Sweep) -> dict[str, tuple[int, ...]]:
    settings, camera = sweep.settings, sweep.settings.camera
    shape = (settings.steps, camera.bands, camera.columns)
    has_one_dark = np.ndim(_scalar_or_step(settings.dark_exposure_time)) == 0
    shapes: dict[str, tuple[int, ...]] = {
        "counts": shape,
        "dark_counts": shape[1:] if has_one_dark else shape,
    }
    return {**shapes, "counts_variance": shape} if settings.variance else shapes


def _fill(sweep: Sweep, cubes: Mapping[str, Any], progress: Progress | None = None) -> None:
    has_one_dark = cubes["dark_counts"].ndim == 2
    if has_one_dark:
        cubes["dark_counts"][...] = sweep.dark(0).mean
    for step in range(sweep.settings.steps):
        frames = sweep.frames(step)
        cubes["counts"][step] = frames.mean
        if "counts_variance" in cubes:
            cubes["counts_variance"][step] = frames.variance
        if not has_one_dark:
            cubes["dark_counts"][step] = sweep.dark(step).mean
        if progress is not None:
            progress(step + 1, sweep.settings.steps)


# --- files of the instruments -------------------------------------------------------------------------------

SVC_FOLDER, ASD_FOLDER = "svc", "asd_reflectance"

_STEP_NM = 0.1
_LEAD_S, _PAINT_S, _PANEL_S = 3600, 60, 15  # times from first paint to flight, between paints, panel to paint
_FINE_AXIS = SimpleNamespace(
    margin_nm=40.0,  # beyond the outer channels, more than the reach of a line shape
    #: Maximum height difference of neighbouring pixels over their distance: includes roofs and bonnets, not
    #: doors.
    max_slope=0.1,
    margin_divisor=8,  # shorter side over the margin at every edge
)


#: Name of the file of regions.
REGIONS = "regions.geojson"

MIN_SIDE_PIXELS = 6  #: Minimum length of the shorter side.

#: First and last line, first and last column of a rectangle.
_Box = tuple[int, int, int, int]


class PaintedRectangles:
    """The largest rectangle of every paint, found scan line by scan line.

    Examples
    --------
    >>> import tempfile
    >>> flight = PlanFlight(SimulationSettings(lines=64, bands=2, columns=160, scene="plan"))
    >>> rectangles = PaintedRectangles(flight)
    >>> rectangles.begin("raw_0")
    >>> rectangles.add(flight.lines(0, 64), np.ones(64, bool))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     rectangles.write(Path(folder) / REGIONS, "an example")
    ...     regions = json.loads((Path(folder) / REGIONS).read_text())
    >>> [feature["properties"]["name"] for feature in regions["features"]]
    ['ir_black', 'red', 'green', 'yellow']
    """

    def __init__(self, flight: Flight) -> None:
        self._flight = flight
        self._step = _FINE_AXIS.max_slope * flight.ground_sample
        self._rectangles_by_paint: dict[int, tuple[str, _Box]] = {}
        self._areas: dict[int, int] = {}
        self.begin("")

    def begin(self, flightline: str) -> None:
        # start a flight line, since rectangles do not extend over two lines
        columns = self._flight.settings.columns
        self._flightline, self._line = flightline, 0
        self._label = np.full(columns, -1, np.int32)
        self._heights = np.zeros(columns)
        self._run_lengths = np.zeros(columns, np.int64)

    def add(self, lines: Lines, recorded: Bools) -> None:
        # add scan lines in order; only ``recorded`` lines (along_track,) are used
        labels = self._flight.clean_paint(lines)
        heights = np.asarray(lines.layers.get("up", np.zeros(labels.shape)), np.float64)
        for label, line_heights in zip(labels[recorded], heights[recorded], strict=True):
            continues = (label == self._label) & (np.abs(line_heights - self._heights) <= self._step)
            self._run_lengths = np.where(label < 0, 0, np.where(continues, self._run_lengths + 1, 1))
            self._label, self._heights = label, line_heights
            # keep rectangles that end at this scan line and are larger than those before
            for run_start, run_stop in self._runs():
                paint = int(label[run_start]) % len(self._flight.paints)
                for height, start, stop in _rectangles(self._run_lengths[run_start:run_stop].tolist()):
                    width = stop - start
                    if min(height, width) >= MIN_SIDE_PIXELS and height * width > self._areas.get(paint, 0):
                        self._areas[paint] = height * width
                        box = (self._line - height + 1, self._line, run_start + start, run_start + stop - 1)
                        self._rectangles_by_paint[paint] = self._flightline, box
            self._line += 1

    def _runs(self) -> Iterator[tuple[int, int]]:
        # ranges of columns with one label, similar heights, and enough lines for a rectangle
        enough = self._run_lengths >= MIN_SIDE_PIXELS
        if not enough.any():
            return
        is_joined = (
            enough[1:]
            & enough[:-1]
            & (np.diff(self._label) == 0)
            & (np.abs(np.diff(self._heights)) <= self._step)
        )
        edges = np.flatnonzero(np.diff(np.concatenate([[False], is_joined, [False]]).astype(np.int8)))
        for begin, end in edges.reshape(-1, 2).tolist():
            if end + 1 - begin >= MIN_SIDE_PIXELS:
                yield begin, end + 1

    def write(self, path: Path, generator: str) -> None:
        # write the regions as GeoJSON in coordinates of the sensor, in the order of the paints.
        # ``generator`` marks the file as simulated.
        features = []
        for number, (flightline, (top, bottom, left, right)) in sorted(self._rectangles_by_paint.items()):
            margin = max(1, min(bottom + 1 - top, right + 1 - left) // _FINE_AXIS.margin_divisor)
            top, bottom, left, right = top + margin, bottom - margin, left + margin, right - margin
            ring = [[left, top], [right, top], [right, bottom], [left, bottom], [left, top]]
            paint = self._flight.paints[number]
            name = self._flight.name_of(paint)
            feature = {
                "type": "Feature",
                "properties": {
                    "name": name,
                    "flightline": flightline,
                    "reference": name,
                    **self._flight.paint_properties(paint),
                },
                "geometry": {"type": "Polygon", "coordinates": [ring]},
            }
            features.append(json.dumps(feature))
        head = '"type": "FeatureCollection",\n"coordinates": "sensor",\n'
        rows = ",\n".join(features)
        path.write_text(
            f'{{\n{head}"generator": {json.dumps(generator)},\n"features": [\n{rows}\n]\n}}\n',
            encoding="utf-8",
        )


def _rectangles(heights: list[int]) -> Iterator[tuple[int, int, int]]:
    """Yield height, first column and end column of all maximal rectangles under a histogram of heights.

    Examples
    --------
    >>> list(_rectangles([2, 3, 1]))
    [(3, 1, 2), (2, 0, 2), (1, 0, 3)]
    """
    rising: list[tuple[int, int]] = []  # stack of increasing heights, with the first column of each
    for column, height in enumerate([*heights, 0]):
        begin = column
        while rising and rising[-1][0] >= height:
            top_height, begin = rising.pop()
            yield top_height, begin, column
        rising.append((height, begin))


#: File of surveyed points of the pavement, as from a GNSS receiver on a pole.
SURVEY = "survey.csv"

#: Files and folders of a simulated collect.
PARTS = (
    "flight",
    "dark",
    "asd",
    SVC_FOLDER,
    ASD_FOLDER,
    "lab",
    "calibration.zarr",
    "truth.zarr",
    REGIONS,
    SURVEY,
    "collect.toml",
)

#: First line of the ``collect.toml`` of a simulated collect.
MARKER = "# simulated by hyperpaint"

_UNFINISHED = f"{MARKER}: not finished\n"

_RECORDS = SimpleNamespace(
    boot=1_234_567_891_000,  # instrument's clock at the first line [ns]; it has no date
    navigation_margin_ns=2 * 10**9,  # navigation before and after the flight
    dark_lead_ns=60 * 10**9,  # time from the first dark frame to the first line
)


@documented(overwrite="own overwrite")
def simulate_collect(
    folder: str | Path,
    *,
    lines: int = 512,
    bands: int = 272,
    columns: int = 320,
    seed: int = 0,
    scene: str = "rendered",
    truth: bool = True,
    sweep: Mapping[str, Any] | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
    block_lines: int = CHUNK_LINES,
    **effects: Any,
) -> Path:
    """Simulate a flight over a car park and write it in the formats of the instruments.

    The files are a Headwall folder (``flight``: cubes, frame index, navigation, settings), a dark cube
    (``dark``), an irradiance series (``asd``), reflectance of the cars' paints from two field spectrometers
    (``svc``, ``asd_reflectance``), ``calibration.zarr``, ``truth.zarr``, ``regions.geojson`` with a rectangle
    of pure, sunlit pixels of every paint that has a level area of six by six pixels, and finally
    ``collect.toml``.

    Parameters
    ----------
    folder
        Folder of the collect; created if it does not exist.
    lines, bands, columns
        Shape of the cube.
    seed
        Random seed; the same seed gives the same bytes of every instrument file.
    scene
        "rendered": a ray-traced car park of triangles, with shadows, glint and mixed pixels. "plan": a flat
        picture in which a pixel shows one level surface, computed fast. "checkerboard": level squares with
        known map coordinates of their corners.
    truth
        Write ``truth.zarr``: radiance and reflectance of every sample, class and masks of every pixel; except
        for a plan also the ground position of every pixel, and the mounting of the camera; for a rendered
        scene also shadow, purity and car.
    sweep
        Also write a monochromator sweep of the same camera, ``lab/sweep.zarr``, with these effects (fields of
        `hyperpaint.simulation.SweepSettings`, ``{}`` for the defaults), and its truth,
        ``lab/sweep_truth.zarr``. ``collect.toml`` then names the sweep instead of ``calibration.zarr``. Lamp
        lines are wider than the default where the bands do not overlap.
    overwrite
    progress
    block_lines
        Lines computed together; limits memory and does not change values.
    **effects
        Fields of `hyperpaint.simulation.SimulationSettings`: ``noise``, ``smile_nm``, ``wobble`` ...

    Returns
    -------
    Path of ``collect.toml``.

    Raises
    ------
    SchemaError
        An effect, of the flight or of the sweep, is unknown or out of range; all are listed.
    StoreError
        The folder is not empty, and ``overwrite`` is not set.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = simulate_collect(folder, lines=8, bands=4, columns=6, scene="plan")
    ...     print(*sorted(entry.name for entry in path.parent.iterdir()))
    asd asd_reflectance calibration.zarr collect.toml dark flight regions.geojson survey.csv svc truth.zarr
    """
    root = input_path(folder, "a folder for the collect", StoreError, "simulate to a folder, and copy it")
    settings = SimulationSettings.of(
        {"lines": lines, "bands": bands, "columns": columns, "seed": seed, "scene": scene, **effects}
    )
    SchemaError.raise_if(
        not settings.quantise,
        "quantise=False, but files need whole counts",
        mend="use simulate_line for float32 counts in memory",
        code="option-conflict",
    )
    SchemaError.raise_if(
        block_lines < 1,
        f"block_lines={block_lines}",
        expected="a whole number above 0",
        code="value-out-of-range",
    )
    spacing = (settings.last_wavelength - settings.first_wavelength) / max(bands - 1, 1)
    if sweep is not None and np.hypot(settings.fwhm_nm, _LAMP_LINE_NM) < spacing:
        # bands apart count the light of wide lamp lines only; a sweep of narrow ones cannot be calibrated
        sweep = {"monochromator_fwhm_nm": min(1.2 * spacing, 100.0), **sweep}
    lab = None if sweep is None else Sweep(SweepSettings.of(sweep, settings))
    flight = flight_of(settings)
    StoreError.raise_if(
        root.exists() and not root.is_dir(),
        f"{root} is a file",
        mend="pass a folder for the simulated collect",
        code="folder-is-file",
    )
    if root.is_dir() and any(root.iterdir()):
        StoreError.raise_if(
            not overwrite,
            f"{root} is not empty",
            mend="choose another folder, or replace an earlier collect with overwrite=True",
            option="choose another folder, or replace an earlier collect with --overwrite",
            code="folder-not-empty",
        )
        # files of a collect that no simulation wrote are not replaced
        entries = [name for name in PARTS if (root / name).exists() or (root / name).is_symlink()]
        StoreError.raise_if(
            entries and head_of(root / "collect.toml", len(MARKER)) != MARKER.encode(),
            f"{root} holds {', '.join(entries[:3])}, and no collect.toml that begins with {MARKER!r}",
            expected="an earlier simulated collect",
            mend="choose another folder; nothing was removed",
            code="folder-foreign",
        )
        (root / "collect.toml").write_text(_UNFINISHED, encoding="utf-8")
        for name in PARTS[:-1]:
            part_path = root / name
            if part_path.is_dir() and not part_path.is_symlink():
                shutil.rmtree(part_path)
            else:
                part_path.unlink(missing_ok=True)
    for name in ("flight", "dark", "asd", SVC_FOLDER, ASD_FOLDER):
        (root / name).mkdir(parents=True)
    # mark the folder as simulated, also if this run is interrupted
    (root / "collect.toml").write_text(_UNFINISHED, encoding="utf-8")
    folder = root / "dark"
    dark = flight.dark_frames()
    dark.astype("<u2").tofile(folder / "raw_0")
    write_bil_header(folder / "raw_0", flight.wavelength, settings, len(dark))
    frames = np.arange(len(dark), dtype=np.int64)
    mid_times = np.rint(frames * settings.frame_period_ms * 1e6).astype(np.int64) - _RECORDS.dark_lead_ns
    write_frame_index(folder / "frameIndex_0.txt", frames, _frame_stamps(mid_times, settings))
    write_settings(folder / "settings.txt", settings)
    samples = flight.sky_samples()
    for index, (stamp, spectrum) in enumerate(zip(samples.stamp.tolist(), samples.irradiance, strict=True)):
        write_asd(
            root / "asd" / f"sky{index:05d}.asd",
            spectrum,
            stamp=stamp,
            utc_offset=round(settings.utc_offset_h * 3600),
            reference_stamp=int(samples.stamp[0]) - 600,  # taken ten minutes before the flight
        )
    # a file of both spectrometers for every paint of the cars in view, named after the paint
    svc, asd = root / SVC_FOLDER, root / ASD_FOLDER
    nm = SVC_WAVELENGTH
    grid = spectral_grid(nm.min() - _FINE_AXIS.margin_nm, nm.max() + _FINE_AXIS.margin_nm, _STEP_NM)
    light = sky_irradiance(settings.sky, settings.sun[0], grid).sum(axis=0) / np.pi
    # radiance of the white panel, then of the paints
    spectra = np.concatenate([light[None], light * flight.paint_reflectance(flight.measured_paints, grid)])
    svc_spectra = np.concatenate(
        [convolve_gaussian(spectra, grid, detector.wavelength, detector.fwhm) for detector in SVC_DETECTORS],
        axis=1,
    )
    asd_spectra = convolve_gaussian(spectra, grid, ASD_WAVELENGTH, settings.irradiance_fwhm_nm)
    zone, start = round(settings.utc_offset_h * 3600), flight.start // 10**9
    for index, paint in enumerate(map(flight.name_of, flight.measured_paints), 1):
        panel = start - _LEAD_S + _PAINT_S * index
        scan = panel + _PANEL_S
        write_svc(
            svc / f"{paint}.sig",
            svc_spectra[0],
            svc_spectra[index],
            stamps=(panel, scan),
            utc_offset=zone,
            position=ORIGIN[:2],
            sun=settings.sun,
        )
        write_asd_reflectance(
            asd / f"{paint}.asd",
            asd_spectra[index],
            asd_spectra[0],
            stamp=scan,
            utc_offset=zone,
            reference_stamp=panel,
        )
    write_calibration(flight, root / "calibration.zarr")
    if lab is not None:
        (root / "lab").mkdir()
        store_sweep(lab, root / "lab" / "sweep.zarr", truth=truth)
    _write_flight(flight, root, block_lines, progress, truth)
    # surveyed points on the ground under the first, middle and last scan line; heights above the ellipsoid
    pose = flight.trajectory.pose(np.array([0.0, 0.5, 1.0]) * flight.line_times[-1] / 1e9)
    ground = flight.frame.local(pose["latitude"], pose["longitude"], flight.frame.height)
    ground[:, 2] = 0.0
    rows = "".join(
        f"P{number},{latitude:.9f},{longitude:.9f},{height:.3f}\n"
        for number, latitude, longitude, height in zip(
            itertools.count(1), *flight.frame.geodetic(ground), strict=False
        )
    )
    (root / SURVEY).write_text(f"name,latitude,longitude,ellipsoidal_height_m\n{rows}", encoding="ascii")
    path = root / "collect.toml"
    # written last, so that a reader of this file finds all other files complete
    path.write_text(_collect_text(flight, lab is not None), encoding="utf-8")
    return path


#: Flights by scene; all other scenes are rendered.
_FLIGHTS: dict[str, type[Flight]] = {"plan": PlanFlight, "checkerboard": CheckerboardFlight}


def flight_of(settings: SimulationSettings) -> Flight:
    return _FLIGHTS.get(settings.scene, RenderedFlight)(settings)


def _instrument_stamps(since_start: Ints) -> Ints:
    return np.asarray((since_start + _RECORDS.boot) // 1000, dtype=np.int64)


def _frame_stamps(mid_times: Ints, settings: SimulationSettings) -> Ints:
    half_exposure = round(settings.exposure_time_ms * 1e6 / 2)
    return _instrument_stamps(
        mid_times
        + {"start": -half_exposure, "mid": 0, "end": half_exposure}[settings.stamp]
        - round(settings.frame_clock_offset_s * 1e9)
    )


def _write_flight(
    flight: Flight, root: Path, block_lines: int, progress: Progress | None, with_truth: bool
) -> None:
    settings, folder = flight.settings, root / "flight"
    truth = TruthStore(flight, root / "truth.zarr") if with_truth else None
    painted = PaintedRectangles(flight)
    recorded = settings.recorded
    reusable: Lines | None = None
    for first_frame, end_frame in itertools.pairwise(settings.cube_starts.tolist()):
        frames = first_frame + np.flatnonzero(recorded[first_frame:end_frame])
        name = f"{frames[0]}"
        painted.begin(f"raw_{name}")
        with (folder / f"raw_{name}").open("wb") as cube:
            for begin in range(first_frame, end_frame, block_lines):
                end = min(begin + block_lines, end_frame)
                block = flight.lines(begin, end, into=reusable)
                reusable = block if reusable is None or len(reusable.counts) < len(block.counts) else reusable
                is_recorded = recorded[begin:end]
                counts = block.counts if is_recorded.all() else block.counts[is_recorded]
                cube.write(np.ascontiguousarray(flight.detector.convert(counts), "<u2").data)
                if truth is not None:
                    truth.write(begin, block, is_recorded)
                painted.add(block, is_recorded)
                if progress is not None:
                    progress(end, settings.lines)
        write_bil_header(folder / f"raw_{name}", flight.wavelength, settings, len(frames))
        write_frame_index(
            folder / f"frameIndex_{name}.txt", frames, _frame_stamps(flight.line_times[frames], settings)
        )
    painted.write(root / REGIONS, CAMERA_SOFTWARE)
    write_settings(folder / "settings.txt", settings)
    since = np.arange(
        -_RECORDS.navigation_margin_ns,
        int(flight.line_times[-1]) + _RECORDS.navigation_margin_ns,
        10**9 // settings.navigation_rate,
        dtype=np.int64,
    )
    utc = (flight.start + since).astype("datetime64[ns]")
    pose = flight.trajectory.pose(since / 1e9)
    write_navigation(folder / "imu_gps.txt", pose, _instrument_stamps(since), utc)
    write_sbet(folder / "trajectory.sbet", pose, utc)


def _collect_text(flight: Flight, with_sweep: bool) -> str:
    settings = flight.settings
    recorded = np.flatnonzero(settings.recorded)
    flightlines = "".join(
        f"""
[[flightlines]]
id = "raw_{name}"
cube = "flight/raw_{name}.hdr"
frame_index = "flight/frameIndex_{name}.txt"
nav = "flight/imu_gps.txt"
"""
        for name in [int(recorded[recorded >= first][0]) for first in settings.cube_starts[:-1]]
    )
    navigation = "\n".join(f'{key} = "{value}"' for key, value in CONVENTION.items())
    half_width = settings.columns / 2 * PIXEL_ANGLE_RAD
    mounting = {"boresight_deg": flight.trajectory.boresight, "lever_arm_m": flight.trajectory.lever_arm}
    geometry = "\n".join(f"{key} = {[float(number) for number in three]}" for key, three in mounting.items())
    uncertainty_s = settings.clock_uncertainty_s
    calibration = 'sweep = "lab/sweep.zarr"' if with_sweep else 'path = "calibration.zarr"'
    clock = "" if uncertainty_s is None else f"clock_uncertainty_s = {float(uncertainty_s)!r}\n"
    return f"""{MARKER}: seed {settings.seed}, truth in truth.zarr

[collect]
name = "simulated car park"

[camera]
bit_depth = {settings.bit_depth}
exposure_time_ms = {float(settings.exposure_time_ms)!r}
frame_period_ms = {float(settings.frame_period_ms)!r}
stamp = "{settings.stamp}"

[calibration]
{calibration}

[dark]
cubes = ["dark/raw_0.hdr"]

[navigation]
{navigation}

[geometry]
ground = {flight.frame.height!r}
fov_deg = {2 * np.degrees(np.arctan(half_width)):.9f}
{geometry}

[irradiance]
files = "asd/*.asd"
quantity = "irradiance"
utc_offset_h = {float(settings.utc_offset_h)!r}
clock_offset_s = {float(settings.clock_offset_s)!r}
{clock}stamp = "{settings.irradiance_stamp}"
fwhm_nm = {float(settings.irradiance_fwhm_nm)!r}
{flightlines}
[[references]]
instrument = "svc"
files = "{SVC_FOLDER}/*.sig"

[[references]]
instrument = "asd"
files = "{ASD_FOLDER}/*.asd"
"""


def simulate_line(
    *,
    lines: int = 64,
    bands: int = 272,
    columns: int = 32,
    seed: int = 0,
    matched: bool = False,
    **effects: Any,
) -> xr.Dataset:
    """Simulate a flight line in memory, with its truth, for tests of single functions.

    Parameters
    ----------
    lines, bands, columns, seed
        As for `simulate_collect`; by default ``scene="plan"``.
    matched
        Add ``matched_irradiance``: irradiance samples weighted by the response of every element.
    **effects
        Fields of `hyperpaint.simulation.SimulationSettings`. ``quantise=False`` gives float32 counts.

    Returns
    -------
    A flight line with the variables of a store (``counts``, ``dark_counts``, ``radiance_gain``,
    ``irradiance`` ...), and ``true_radiance``, ``true_reflectance``, ``surface`` and ``true_saturated``.
    ``dark_counts`` is the mean of the dark frames with ``quantise``, else the dark itself.

    Raises
    ------
    SchemaError
        An effect is unknown or out of range; all are listed.

    Examples
    --------
    >>> line = simulate_line(lines=4, bands=5, columns=3, noise=False, quantise=False)
    >>> rate = (line.counts - line.dark_counts) / line.exposure_time
    >>> float(abs(line.radiance_gain * rate / line.true_radiance - 1).max()) < 1e-5
    True
    """
    settings = SimulationSettings.of(
        {"lines": lines, "bands": bands, "columns": columns, "seed": seed, **effects}
    )
    flight = flight_of(settings)
    return line_dataset(flight, flight.lines(0, settings.lines), matched=matched)
