"""A simulated flight: light and camera, scan line by scan line, over any scene.

`plan_flight` flies over a flat picture, `rendered_flight` over triangles; both compute the radiance of every
element, and this module turns it into counts and truth. The light is a sum of two spectra, direct and
diffuse, which have separate factors in time.
"""

from __future__ import annotations

import abc
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hyperpaint.base.arrays import Floats, Floats32

from .atmosphere import Light, Sky, spectral_grid
from .camera import Camera, Optics, convolve_gaussian, expected_counts
from .instruments import ASD_AVERAGES, ASD_INTEGRATION_MS, ASD_WAVELENGTH
from .paint_spectra import reflectance
from .rendering.platforms import LocalFrame, Trajectory, TransverseMercator
from .rendering.sky_models import cloud_transmittance, relative_air_mass
from .settings import ORIGIN, PIXEL_ANGLE_RAD, SimulationSettings

_OVERCAST_OKTAS = 8.0


def sky_irradiance(sky: str, sun_zenith: float, wavelength: Floats) -> Floats:
    """Return direct and diffuse irradiance of a level surface, shape (2, wavelength) [W m-2 nm-1].

    Parameters
    ----------
    sky
        One of `hyperpaint.simulation.settings.SKIES`. An overcast sky transmits a quarter of the clear sky's
        light, slightly bluer (`rendering.sky_models`), without direct sun.
    sun_zenith
        [degree]
    wavelength
        [nm]

    Examples
    --------
    >>> direct, diffuse = sky_irradiance("overcast", 25.0, np.array([550.0, 850.0]))
    >>> direct, diffuse.round(3)
    (array([0., 0.]), array([0.362, 0.17 ]))
    """
    # for a low sun the air mass accounts for the curvature of the atmosphere
    airmass = relative_air_mass(sun_zenith) if sky == "near_sunset" else None
    clear_sky = np.stack(Sky(sun_zenith, airmass=airmass).irradiance(wavelength))
    if sky == "overcast":
        diffuse = clear_sky.sum(axis=0) * cloud_transmittance(wavelength, _OVERCAST_OKTAS)
        return np.stack([np.zeros_like(diffuse), diffuse])
    return clear_sky


# keys of the random streams [seed, stream, line], so that values do not depend on the grouping of lines;
# modules of single flights define further keys
_NOISE, _DARK_FRAMES, _SKY = 12, 16, 17


# Description of a truth layer of shape (along_track, cross_track).
class Layer(NamedTuple):
    dtype: str
    attrs: Mapping[str, object]  # ``long_name``, ``units`` and the like


@dataclass(frozen=True)
class Lines:
    """Consecutive scan lines: scene radiance, and counts before conversion.

    Attributes
    ----------
    surface
        Class of every pixel, shape (along_track, cross_track), int16.
    glint
        True for pixels that mirror the sun, shape (along_track, cross_track).
    counts
        Counts before conversion, shape (along_track, band, cross_track), float32 [count].
    radiance, reflectance
        Means weighted by the response, shape as counts, float32 [W m-2 sr-1 nm-1], [1].
    layers
        Further truth of every pixel, by the names of `Flight.layers`.
    """

    surface: NDArray[np.int16]
    glint: NDArray[np.bool_]
    counts: NDArray[np.float32]
    radiance: NDArray[np.float32]
    reflectance: NDArray[np.float32]
    layers: Mapping[str, NDArray[np.generic]] = field(default_factory=dict)

    def part(self, start: int, stop: int) -> Lines:
        rows = slice(start, stop)
        return Lines(
            self.surface[rows],
            self.glint[rows],
            self.counts[rows],
            self.radiance[rows],
            self.reflectance[rows],
            {name: values[rows] for name, values in self.layers.items()},
        )


# Scan lines, and a function that returns pi INT L R of the elements (band, column) of a row.
class LineView(NamedTuple):
    lines: Lines
    elements: Callable[[int], Floats]


@dataclass(frozen=True)
class SkySamples:
    """The simulated irradiance record.

    Attributes
    ----------
    stamp
        UTC by the clock of the logging computer, in whole seconds since 1970, shape (irradiance_time,).
    middle
        True time of the middle of every average, in nanoseconds after the first line, int64.
    factors
        Mean factors of direct and diffuse light over every average, shape (2, irradiance_time).
    irradiance
        Irradiance, shape (irradiance_time, irradiance_wavelength) [W m-2 nm-1].
    """

    stamp: NDArray[np.int64]
    middle: NDArray[np.int64]
    factors: Floats
    irradiance: Floats


class Flight(abc.ABC):
    """A flight over a car park.

    Parameters
    ----------
    settings
        Size and effects.

    Attributes
    ----------
    surfaces
        Names of the classes of surfaces, in the order of their numbers.
    paints
        Names of the paints of the cars.
    layers
        Further truth of every pixel.
    """

    surfaces: tuple[str, ...]
    paints: tuple[str, ...]
    layers: Mapping[str, Layer] = MappingProxyType({})

    def __init__(self, settings: SimulationSettings) -> None:
        self.settings = settings
        self.camera = Camera.of(settings)
        self.imager = self.camera.imager
        self.wavelength = self.imager.wavelength
        self.detector = self.camera.detector(settings.exposure_time)
        self.bad = self.camera.bad
        self.light = Light(settings.drift_per_minute, settings.cloud)
        reach, width = self.imager.reach, 4.0 * settings.irradiance_fwhm_nm
        self.grid = spectral_grid(
            min(self.wavelength[0] - reach, ASD_WAVELENGTH[0] - width) - 1.0,
            max(self.wavelength[-1] + reach, ASD_WAVELENGTH[-1] + width) + 1.0,
        )
        self.sky = sky_irradiance(settings.sky, settings.sun[0], self.grid)
        incident = self.imager.integrals(np.concatenate([self.sky, np.ones((1, len(self.grid)))]), self.grid)
        #: INT E_k R of the direct and the diffuse light, shape (2, band, cross_track)
        self._incident = incident[:2]
        #: INT R of every element, shape (band, cross_track) [count nm J-1]
        self.response_area = incident[2]

    def paint_reflectance(self, names: Sequence[str], wavelength: Floats) -> Floats:
        # reflectance of paints, shape (name, wavelength)
        return reflectance(names, wavelength)

    def paint_properties(self, _paint: str) -> Mapping[str, str]:
        return {}

    def clean_paint(self, lines: Lines) -> NDArray[np.int32]:
        """Return the paint of pixels that show only a car's paint, in the sun and without mirrored sun.

        Returns
        -------
        Shape (along_track, cross_track): the index of the paint in ``paints``, plus the number of paints
        times the number of the car, if cars have numbers; -1 for all other pixels.
        """
        is_hidden = lines.glint | self.bad.all(axis=0)
        return np.where(is_hidden, -1, self._paint_of_surface[lines.surface]).astype(np.int32)

    @cached_property
    def _paint_of_surface(self) -> NDArray[np.int32]:
        # index in ``paints`` of every surface; -1 for surfaces that are not paint
        paints = {name: number for number, name in enumerate(self.paints)}
        return np.array([paints.get(name, -1) for name in self.surfaces], np.int32)

    def _rng(self, stream: int, *key: int) -> np.random.Generator:
        return np.random.default_rng([self.settings.seed, stream, *key])

    @property
    def ground_sample(self) -> float:
        # side of a pixel on the ground [m]
        return self.settings.swath / self.settings.columns

    @property
    def look_angle(self) -> Floats:
        # look angle of every column, positive to the right, shape (column,) [degree]
        column = np.arange(self.settings.columns) - 0.5 * (self.settings.columns - 1)
        return np.asarray(np.degrees(np.arctan(column * PIXEL_ANGLE_RAD)))

    @cached_property
    def start(self) -> int:
        # UTC at mid-exposure of the first line [ns since 1970]
        return int(self.settings.start.astype(np.int64))

    @cached_property
    def line_times(self) -> NDArray[np.int64]:
        # mid-exposure of every line, shape (along_track,) [ns after the first line]
        period = self.settings.frame_period_ms * 1e6
        return np.asarray(np.rint(np.arange(self.settings.lines) * period), dtype=np.int64)

    @property
    def radiance_gain(self) -> Floats:
        # 1 / (etendue INT R), NaN at bad elements, shape (band, cross_track) [W m-2 sr-1 nm-1 s count-1].
        return self.camera.radiance_gain(self.response_area)

    def matched_irradiance(self, factors: Floats) -> Floats:
        """Return the irradiance weighted by the response of each element, INT E R / INT R.

        Parameters
        ----------
        factors
            Factors of direct and diffuse light, shape (2, time).

        Returns
        -------
        Shape (time, band, cross_track) [W m-2 nm-1].
        """
        return np.asarray(np.einsum("kt,kbx->tbx", factors, self._incident) / self.response_area)

    def lines(self, start: int, stop: int, into: Lines | None = None) -> Lines:
        """Return scan lines ``start`` to ``stop``; values do not depend on the grouping of lines.

        Radiance and reflectance are those of the scene, before the camera's optics blur it.

        Parameters
        ----------
        start, stop
            Range of lines.
        into
            Lines no longer needed, whose memory is reused, because allocation takes longer than the
            arithmetic.
        """
        optics = self.camera.optics
        if optics is None:
            view = self._view(start, stop, into)

            def expose(row: int) -> None:
                view.lines.counts[row] = self._count(self._record_truth(view, row, start + row), start + row)

            # rows run in threads, because numpy releases the interpreter lock; noise is keyed by line
            with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
                list(pool.map(expose, range(len(view.lines.counts))))
            return view.lines
        first_line, end_line = max(start - optics.reach, 0), min(stop + optics.reach, self.settings.lines)
        return self._expose_through(
            optics, self._view(first_line, end_line, into), first_line, range(start, stop)
        )

    @abc.abstractmethod
    def _view(self, start: int, stop: int, into: Lines | None) -> LineView:
        """Return scan lines with empty counts, radiance and reflectance, and the radiance of elements."""

    def _cubes(self, number: int, into: Lines | None) -> tuple[Floats32, Floats32, Floats32]:
        if into is None or len(into.counts) < number:
            shape = (number, self.settings.bands, self.settings.columns)
            return np.empty(shape, np.float32), np.empty(shape, np.float32), np.empty(shape, np.float32)
        return into.counts[:number], into.radiance[:number], into.reflectance[:number]

    def _record_truth(self, view: LineView, row: int, line: int) -> Floats:
        # store reflectance and radiance of a row; return pi INT L R of its elements (band, column)
        light = view.elements(row)
        factors = self._factors(line, line + 1)[:, 0]
        incident = self._incident[0] * factors[0]
        incident += factors[1] * self._incident[1]
        np.divide(light, incident, out=view.lines.reflectance[row], casting="same_kind")
        np.divide(light, np.pi * self.response_area, out=view.lines.radiance[row], casting="same_kind")
        return light

    def _count(self, light: Floats, line: int) -> Floats:
        # counts from pi INT L R (band, column), which is overwritten; the number of the line seeds the noise
        settings = self.settings
        light *= 1.0 / np.pi
        signal = expected_counts(light, settings.exposure_time, self.camera.etendue)
        signal[self.bad] = 0.0
        counts = self.detector.read(signal, self._rng(_NOISE, line) if settings.noise else None)
        if settings.pedestal:
            counts += settings.pedestal
        return counts

    def _expose_through(self, optics: Optics, view: LineView, first_line: int, lines: range) -> Lines:
        factor = self.imager.element_factor

        def light_without_factors(row: int) -> Floats:
            return self._record_truth(view, row, first_line + row) / factor

        with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
            light = list(pool.map(light_without_factors, range(len(view.lines.counts))))

            def expose(line: int) -> None:
                window = [light[row - first_line] for row in optics.rows_of(line, self.settings.lines)]
                view.lines.counts[line - first_line] = self._count(optics.image(window) * factor, line)

            list(pool.map(expose, lines))
        return view.lines.part(lines.start - first_line, lines.stop - first_line)

    def _factors(self, start: int, stop: int) -> Floats:
        return self.light.factors(self.line_times[start:stop] / 1e9)

    def dark_frames(self) -> NDArray[np.uint16]:
        # dark cube, shape (along_track, band, cross_track)
        dark = np.empty((self.settings.dark_frames, *self.detector.dark.shape), dtype=np.uint16)
        for frame in range(len(dark)):
            rng = self._rng(_DARK_FRAMES, frame) if self.settings.dark_noise else None
            dark[frame] = self.detector.convert(self.detector.read(np.zeros_like(self.detector.dark), rng))
        return dark

    def sky_samples(self) -> SkySamples:
        settings = self.settings
        second, offset = 10**9, round(settings.clock_offset_s * 1e9)
        margin = round(settings.irradiance_margin_s * 1e9) + second
        first_stamp = (self.start - margin - offset) // second
        last_stamp = -((-(self.start + int(self.line_times[-1]) + margin - offset)) // second)
        interval = settings.irradiance_interval_s
        stamp = np.arange(first_stamp, last_stamp + interval, interval, dtype=np.int64)
        length = ASD_INTEGRATION_MS * ASD_AVERAGES * 10**6
        stamp_delay = {"start": 0, "mid": length // 2, "end": length}[settings.irradiance_stamp]
        average_start = stamp * second + offset - self.start - stamp_delay
        middle = average_start + length // 2
        if settings.irradiance_gap is not None:
            gap_start, gap_end = (round(1e9 * edge) for edge in settings.irradiance_gap)
            is_logged = (middle < gap_start) | (middle > gap_end)
            stamp, average_start, middle = stamp[is_logged], average_start[is_logged], middle[is_logged]
        factors = self.light.mean_factors(average_start / 1e9, (average_start + length) / 1e9)
        spectra = convolve_gaussian(self.sky, self.grid, ASD_WAVELENGTH, settings.irradiance_fwhm_nm)
        irradiance = factors.T @ spectra
        if settings.irradiance_noise:
            for index, seconds in enumerate(stamp.tolist()):
                noise = self._rng(_SKY, seconds).standard_normal(irradiance.shape[1])
                irradiance[index] *= 1.0 + settings.irradiance_noise * noise
        return SkySamples(stamp, middle, factors, irradiance)

    @cached_property
    def frame(self) -> LocalFrame:
        # axes of the scene: x east, y north, z up, from `ORIGIN`
        return LocalFrame(*ORIGIN)

    @cached_property
    def plane(self) -> TransverseMercator:
        # map projection of the positions in the truth
        return TransverseMercator.of(*ORIGIN[:2])

    @cached_property
    def trajectory(self) -> Trajectory:
        speed = self.ground_sample / (self.settings.frame_period_ms / 1e3)
        return Trajectory.of(self.settings, self.frame, speed, self.ground_sample / PIXEL_ANGLE_RAD)

    def pose(self, seconds: Floats) -> dict[str, Floats]:
        # position and attitude of the navigation system at times after the first line [s]
        return self.trajectory.pose(seconds)
