"""Simulated flights: light and camera, scan line by scan line, over a scene.

The light is a sum of two spectra, direct and diffuse, which have separate factors in time.

`PlanFlight` flies over a flat picture of a car park, for tests of single functions and for huge cubes.
Across the track are grass, a kerb, a row of bays, the aisle with grey panels, and a second row of bays; bays
repeat every 2.5 m. The swath is always 16 m wide, so that few columns give a coarse picture of the same
scene. A pixel shows one of some twenty level Lambert materials, so that a table of INT rho_m E_k R_b,x (k
direct or diffuse), computed once, has all radiance integrals of a flight.

`CheckerboardFlight` flies over a checkerboard with known corners on the map, to test geolocation. The board
lies on ground of constant height above the ellipsoid, so that it is as curved as the earth. The radiance of
a pixel is the mean over its area and its exposure, along the moving line of sight of the camera.

`RenderedFlight` flies over a ray-traced car park of triangles, along the moving line of sight of the camera.
Paths of light are recorded without spectra; a table has the integrals INT E_k PROD rho R with the camera's
responses for every kind of path. The code of a path contains its source, so that direct and diffuse light
vary independently in time. The air between ground and camera neither absorbs nor scatters.
"""

import abc
import itertools
import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType, SimpleNamespace
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from hyperpaint.base import Floats, Floats32, SchemaError

from .atmosphere import (
    CIE_OVERCAST_SHARE,
    Atmosphere,
    Light,
    Sky,
    clear_spread,
    cloud_transmittance,
    spectral_grid,
)
from .camera import BandSet, Camera, convolve_gaussian, expected_counts
from .instruments import ASD_AVERAGES, ASD_INTEGRATION_MS, ASD_WAVELENGTH
from .rendering.car_parks import car_park
from .rendering.materials import reflectance_factor
from .rendering.platforms import LocalFrame, Platform, Trajectory, TransverseMercator, pixel_edges
from .rendering.relighting import (
    PreparedScene,
    ProductTable,
    factor_spectra,
    populations_of,
    prepare_scene,
    source_spectra,
    trace_block,
)
from .rendering.scene import SceneRecord, TraceSettings, label_layers
from .rendering.scene_spectra import CAR_PAINTS, MATERIALS, PANELS, paint_spec, reflectance, spectrum_of
from .settings import ORIGIN, PIXEL_ANGLE_RAD, SWATH_M, SimulationSettings
from .transport.mixing import member_rows
from .transport.path_codes import is_direct, is_indirect, is_mirrored
from .transport.paths import Block

_OVERCAST_OKTAS = 8.0


def sky_irradiance(sky: str, sun_zenith: float, wavelength: Floats) -> Floats:
    """Return direct and diffuse irradiance of a level surface, shape (2, wavelength) [W m-2 nm-1].

    Parameters
    ----------
    sky
        One of `hyperpaint.simulation.settings.SKIES`. An overcast sky transmits a quarter of the clear sky's
        light, slightly bluer (`atmosphere`), without direct sun.
    sun_zenith
        [degree]
    wavelength
        [nm]

    Examples
    --------
    >>> direct, diffuse = sky_irradiance("overcast", 25.0, np.array([550.0, 850.0]))
    >>> direct, diffuse.round(3)
    (array([0., 0.]), array([0.36, 0.17]))
    """
    clear_sky = np.stack(Sky(sun_zenith).irradiance(wavelength))
    if sky == "overcast":
        diffuse = clear_sky.sum(axis=0) * cloud_transmittance(wavelength, _OVERCAST_OKTAS)
        return np.stack([np.zeros_like(diffuse), diffuse])
    return clear_sky


# keys of the random streams [seed, stream, line], so that values do not depend on the grouping of lines
_TEXTURE, _GLINT, _NOISE, _DARK_FRAMES, _SKY = 10, 11, 12, 16, 17


# Description of a truth layer of shape (along_track, cross_track).
class Layer(NamedTuple):
    dtype: str
    attrs: Mapping[str, object]  # ``long_name``, ``units`` and the like


# Consecutive scan lines: scene radiance, and counts before conversion
@dataclass(frozen=True)
class Lines:
    surface: NDArray[np.int16]  # class of every pixel, shape (along_track, cross_track), int16
    glint: NDArray[np.bool_]  # true for pixels that mirror the sun, shape (along_track, cross_track)
    # counts before conversion, shape (along_track, band, cross_track), float32 [count]
    counts: NDArray[np.float32]
    # radiance, reflectance: means weighted by the response, shape as counts, float32 [W m-2 sr-1 nm-1], [1]
    radiance: NDArray[np.float32]
    reflectance: NDArray[np.float32]
    # further truth of every pixel, by the names of `Flight.layers`
    layers: Mapping[str, NDArray[np.generic]] = field(default_factory=dict)


#: Scan lines, and a function that returns pi INT L R of the elements (band, column) of a row.
LineView: TypeAlias = tuple[Lines, Callable[[int], Floats]]


# The simulated irradiance record
class SkySamples(NamedTuple):
    # UTC by the clock of the logging computer, in whole seconds since 1970, shape (irradiance_time,)
    stamp: NDArray[np.int64]
    # true time of the middle of every average, in nanoseconds after the first line, int64
    middle: NDArray[np.int64]
    factors: Floats  # mean factors of direct and diffuse light over every average, shape (2, irradiance_time)
    irradiance: Floats  # irradiance, shape (irradiance_time, irradiance_wavelength) [W m-2 nm-1]


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
        self.light = Light(settings.drift_per_minute, settings.cloud)
        reach, width = self.imager.whole_reach, 4.0 * settings.irradiance_fwhm_nm
        self.grid = spectral_grid(
            min(self.wavelength[0] - reach, ASD_WAVELENGTH[0] - width) - 1.0,
            max(self.wavelength[-1] + reach, ASD_WAVELENGTH[-1] + width) + 1.0,
        )
        self.sky = sky_irradiance(settings.sky, settings.sun[0], self.grid)
        incident = self.imager.integrals(np.concatenate([self.sky, np.ones((1, len(self.grid)))]), self.grid)
        #: INT E_k R of the direct and the diffuse light, shape (2, band, cross_track)
        self.incident = incident[:2]
        #: INT R of every element, shape (band, cross_track) [count nm J-1]
        self.response_area = incident[2]

    def paint_reflectance(self, names: Sequence[str], wavelength: Floats) -> Floats:
        # reflectance of paints, shape (name, wavelength)
        return reflectance(names, wavelength)

    def name_of(self, spectrum: str) -> str:
        # name of a surface in files and results
        return spectrum

    @property
    def measured_paints(self) -> tuple[str, ...]:
        # paints of which field spectrometers have readings
        return self.paints

    def paint_properties(self, _paint: str) -> Mapping[str, str]:
        return {}

    def clean_paint(self, lines: Lines) -> NDArray[np.int32]:
        # Return the paint of pixels that show only a car's paint, in the sun and without mirrored sun.
        #
        # Returns: Shape (along_track, cross_track): the index of the paint in ``paints``, plus the number of
        # paints times the number of the car, if cars have numbers; -1 for all other pixels.
        # index in ``paints`` of every surface; -1 for surfaces that are not paint
        numbers = {name: number for number, name in enumerate(self.paints)}
        paint = np.array([numbers.get(name, -1) for name in self.surfaces], np.int32)
        return np.where(lines.glint | self.camera.bad.all(axis=0), -1, paint[lines.surface]).astype(np.int32)

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

    def lines(self, start: int, stop: int, into: Lines | None = None) -> Lines:
        # Return scan lines ``start`` to ``stop``; values do not depend on the grouping of lines.
        #
        # Radiance and reflectance are those of the scene, before the camera's optics blur it.
        #
        # ``start``, ``stop``: Range of lines. ``into``: Lines no longer needed, whose memory is reused,
        # because allocation takes longer than the arithmetic.
        settings, optics, bad = self.settings, self.camera.optics, self.camera.bad
        reach = 0 if optics is None else optics.reach
        first_line = max(start - reach, 0)
        lines, element_light = self._view(first_line, min(stop + reach, settings.lines), into)
        factor = self.imager.element_factor

        def record(row: int) -> Floats:
            # store reflectance and radiance of a row; return pi INT L R of its elements (band, column)
            light, (direct, diffuse) = element_light(row), self._factors(first_line + row)[:, 0]
            incident = self.incident[0] * direct + diffuse * self.incident[1]
            np.divide(light, incident, out=lines.reflectance[row], casting="same_kind")
            np.divide(light, np.pi * self.response_area, out=lines.radiance[row], casting="same_kind")
            return light if optics is None else light / factor

        def count(row: int, light: Floats) -> None:
            # ``light`` is overwritten; the number of the line seeds the noise
            light *= 1.0 / np.pi
            signal = expected_counts(light, settings.exposure_time, self.camera.etendue)
            signal[bad] = 0.0
            rng = self._rng(_NOISE, first_line + row) if settings.noise else None
            counts = self.detector.read(signal, rng)
            if settings.pedestal:
                counts += settings.pedestal
            lines.counts[row] = counts

        # rows run in threads, because numpy releases the interpreter lock
        rows = range(len(lines.counts))
        with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
            if optics is None:
                list(pool.map(lambda row: count(row, record(row)), rows))
                return lines
            light = list(pool.map(record, rows))

            def blur(line: int) -> None:
                window = [light[row - first_line] for row in optics.rows_of(line, settings.lines)]
                count(line - first_line, optics.image(window) * factor)

            list(pool.map(blur, range(start, stop)))
        part = slice(start - first_line, stop - first_line)
        return Lines(
            lines.surface[part],
            lines.glint[part],
            lines.counts[part],
            lines.radiance[part],
            lines.reflectance[part],
            {name: values[part] for name, values in lines.layers.items()},
        )

    @abc.abstractmethod
    def _view(self, start: int, stop: int, into: Lines | None) -> LineView:
        """Return scan lines with empty counts, radiance and reflectance, and the radiance of elements."""

    def _cubes(self, number: int, into: Lines | None) -> tuple[Floats32, Floats32, Floats32]:
        # arrays for counts, radiance and reflectance of a number of lines
        if into is None or len(into.counts) < number:
            shape = (number, self.settings.bands, self.settings.columns)
            return np.empty(shape, np.float32), np.empty(shape, np.float32), np.empty(shape, np.float32)
        return into.counts[:number], into.radiance[:number], into.reflectance[:number]

    def _reflected_light(self, names: Sequence[str]) -> Floats:
        # INT rho_m E_k R of level materials, shape (light, material, band, cross_track)
        rho = reflectance(names, self.grid)
        integrals = self.imager.integrals(np.concatenate([light * rho for light in self.sky]), self.grid)
        return integrals.reshape(2, len(names), self.settings.bands, self.settings.columns)

    def _factors(self, start: int, stop: int | None = None) -> Floats:
        # factors of direct and diffuse light at mid exposure of lines, or of one line, shape (2, line)
        return self.light.factors(self.line_times[start : start + 1 if stop is None else stop] / 1e9)

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


_BAY_LENGTH, _BAY_WIDTH = 5.0, 2.5
_ROWS = (1.4, 10.9)  # positions across the track at which the two rows of bays begin [m]
_GRASS_END, _KERB_END = 1.0, 1.3
_LAYOUT = SimpleNamespace(
    line_half_width_m=0.07,
    #: Windows of a car: bounds along its length and half its width, as fractions of length and half width.
    windows=((0.27, 0.40, 0.0, 0.74), (0.74, 0.84, 0.0, 0.70), (0.42, 0.72, 0.76, 0.90)),
    #: Parts of the wheels outside the body, with the same bounds.
    wheels=((0.13, 0.25, 0.98, 1.03), (0.72, 0.84, 0.98, 1.03)),
)
_PANEL_SIZE, _PANEL_PERIOD, _PANEL_START = 0.90, 30.0, 1.4
_CLASS = {name: index for index, name in enumerate(MATERIALS)}


def surface_classes(start: int, stop: int, columns: int, seed: int = 0) -> NDArray[np.int16]:
    """Return the class of the pixels of lines ``start`` to ``stop``, shape (along_track, cross_track).

    ``columns`` cover the swath; ``seed`` chooses the occupied bays, and paints and positions of the cars.

    Examples
    --------
    >>> surface_classes(0, 2, columns=32).dtype
    dtype('int16')
    """
    sample = SWATH_M / columns  # side of a pixel on the ground [m]
    along = (np.arange(start, stop) + 0.5) * sample
    y, x = np.meshgrid(along, (np.arange(columns) + 0.5) * sample, indexing="ij")
    classes = np.full(y.shape, _CLASS["asphalt"], dtype=np.int16)
    classes[x < _KERB_END] = _CLASS["concrete"]
    classes[x < _GRASS_END] = _CLASS["grass"]
    # painted lines, at least a pixel wide, so that coarse pictures have them
    is_along = np.abs((y + _BAY_WIDTH / 2) % _BAY_WIDTH - _BAY_WIDTH / 2) <= max(
        _LAYOUT.line_half_width_m, sample / 2
    )
    for edge in _ROWS:
        classes[is_along & (x >= edge) & (x <= edge + _BAY_LENGTH)] = _CLASS["painted_line"]
    # panels in the aisle
    is_along = (y - _PANEL_START) % _PANEL_PERIOD <= _PANEL_SIZE
    pitch = (_ROWS[1] - _ROWS[0] - _BAY_LENGTH) / len(PANELS)
    for index, level in enumerate(PANELS):
        edge = _ROWS[0] + _BAY_LENGTH + (index + 0.5) * pitch - _PANEL_SIZE / 2
        is_panel = is_along & (x >= edge) & (x <= edge + _PANEL_SIZE)
        classes[is_panel] = _CLASS[f"panel_{round(100 * level):02d}"]
    # cars
    first_bay, last_bay = int(along[0] // _BAY_WIDTH) - 1, int(along[-1] // _BAY_WIDTH) + 1
    for bay, row in itertools.product(range(first_bay, last_bay + 1), range(len(_ROWS))):
        _park(classes, y, x, bay, row, seed)
    return classes


def _park(classes: NDArray[np.int16], y: Floats, x: Floats, bay: int, row: int, seed: int) -> None:
    rng = np.random.default_rng([seed, 1, bay + 2, row])
    if rng.random() > 0.85:
        return
    length, width = rng.uniform(4.0, 4.7), rng.uniform(1.7, 1.9)
    centre = (bay + 0.5) * _BAY_WIDTH + rng.normal(0.0, 0.08)
    nose = _ROWS[row] + rng.uniform(0.1, _BAY_LENGTH - length)
    turn, forward = rng.normal(0.0, 0.02), rng.random() < 0.7
    is_near = np.abs(y[:, 0] - centre) < _BAY_WIDTH
    if not is_near.any():
        return
    # twelve neighbouring bays have twelve different paints
    paints = list(CAR_PAINTS)
    group, index = divmod(2 * bay + row + 2 * len(paints), len(paints))
    paint = paints[int(np.random.default_rng([seed, 2, group]).permutation(len(paints))[index])]
    y, x, view = y[is_near], x[is_near], classes[is_near]
    # u is 0 at the nose and 1 at the tail, v is 0 on the centre line and 1 at the flank
    u = (x - nose + turn * (y - centre)) / length
    u = u if forward else 1.0 - u
    v = np.abs(y - centre - turn * (x - nose - length / 2)) / (width / 2)
    body = np.abs(2 * u - 1) ** 6 + v**5 <= 1.0
    wheels, windows = (
        np.any([(u >= a) & (u <= b) & (v >= c) & (v <= d) for a, b, c, d in boxes], axis=0)
        for boxes in (_LAYOUT.wheels, _LAYOUT.windows)
    )
    view[wheels] = _CLASS["tyre"]
    view[body] = _CLASS[paint]
    view[body & windows] = _CLASS["glass"]
    classes[is_near] = view


_CAR = np.array([name in CAR_PAINTS for name in MATERIALS])
_TEXTURED = np.array([not name.startswith("panel") for name in MATERIALS])


class PlanFlight(Flight):
    surfaces = tuple(MATERIALS)
    paints = tuple(CAR_PAINTS)

    def __init__(self, settings: SimulationSettings) -> None:
        super().__init__(settings)
        #: shape (light, band, material x cross_track), as a lookup table
        self._reflected = (
            self._reflected_light(list(MATERIALS)).transpose(0, 2, 1, 3).reshape(2, settings.bands, -1)
        )

    def _view(self, start: int, stop: int, into: Lines | None) -> LineView:
        number = stop - start
        surface = surface_classes(start, stop, self.settings.columns, self.settings.seed)
        # reflectance factor of the sun mirrored in clear coats, zero for most pixels
        mirrored = np.zeros(surface.shape)
        for row in range(number):
            rng = self._rng(_GLINT, start + row)
            chance, strength = rng.random(surface.shape[1]), rng.uniform(2.0, 12.0, surface.shape[1])
            mirrored[row] = np.where((chance < self.settings.glint) & _CAR[surface[row]], strength, 0.0)
        factors = self._factors(start, stop)

        def element_radiance(row: int) -> Floats:
            return self._element_radiance(start + row, surface[row], factors[:, row], mirrored[row])

        return Lines(surface, mirrored > 0, *self._cubes(number, into)), element_radiance

    def _element_radiance(
        self, line: int, surface: NDArray[np.int16], factors: Floats, mirrored: Floats
    ) -> Floats:
        # pi INT L R of every element, shape (band, cross_track)
        direct, diffuse = factors
        columns = self.settings.columns
        index = surface.astype(np.intp) * columns + np.arange(columns)
        radiance = self._reflected[0].take(index, axis=1, mode="clip")
        radiance *= direct
        diffuse_radiance = self._reflected[1].take(index, axis=1, mode="clip")
        diffuse_radiance *= diffuse
        radiance += diffuse_radiance
        if self.settings.texture:
            normal = np.clip(self._rng(_TEXTURE, line).standard_normal(surface.shape), -3.0, 3.0)
            radiance *= np.where(_TEXTURED[surface], 1.0 + self.settings.texture * normal, 1.0)
        if mirrored.any():
            radiance += mirrored * direct * self.incident[0]
        return np.asarray(radiance)


_SQUARES = ("panel_05", "panel_50")
_CACHED_LINES = 32  # lines of a slab that fits into the cache of a processor
_MARGIN_M = 1.0  # margin around the imaged area for the list of corners

#: Sample points of a pixel, as fractions of its width, length and exposure around their centre: a sequence
#: that fills a cube evenly (Roberts 2018, from the root of x**4 = x + 1), and its mirror image, so that the
#: mean point is the centre.
_ROOT = 1.2207440846057596
_HALF_OF_POINTS = (np.arange(1, 41)[:, None] * _ROOT ** -np.arange(1.0, 4.0) + 0.5) % 1.0 - 0.5
_POINTS = np.concatenate([_HALF_OF_POINTS, -_HALF_OF_POINTS])
_WEIGHTS = np.concatenate([_POINTS, _POINTS[:, 2:] ** 2], axis=1)


@dataclass(frozen=True)
class Checkerboard:
    """Squares that cover a map.

    Attributes
    ----------
    origin
        East and north of a corner [m].
    square
        Side of a square [m].
    turn
        Direction of one of its two axes, clockwise from the map's north [degree].

    Examples
    --------
    >>> board = Checkerboard((500.0, 800.0), 0.5, 90.0)
    >>> board.corners(np.array([1.0, 0.0]))
    array([500.5, 800. ])
    """

    origin: tuple[float, float]
    square: float
    turn: float

    @property
    def _axes(self) -> Floats:
        sine, cosine = np.sin(np.radians(self.turn)), np.cos(np.radians(self.turn))
        return np.array([[sine, cosine], [cosine, -sine]])

    def corners(self, numbers: Floats) -> Floats:
        # east and north (..., 2) [m] of corners, from their numbers along both axes
        return np.asarray(self.origin + self.square * (numbers @ self._axes))

    def numbers(self, east: Floats, north: Floats) -> Floats:
        # positions along both axes, in squares, shape (2, ...)
        first_axis, second_axis = self._axes / self.square
        x, y = east - self.origin[0], north - self.origin[1]
        return np.stack([first_axis[0] * x + first_axis[1] * y, second_axis[0] * x + second_axis[1] * y])

    def share(self, place: Floats, steps: Floats, weights: Floats) -> Floats:
        # share of the sample points of pixels that are on bright squares
        # place: east and north of pixel centres, shape (2, ...) [m]
        # steps: vectors along width, length and exposure of a pixel, shape (step, 2, ...) [m]
        # weights: weights of these vectors for every sample point, shape (point, step)
        centre = self.numbers(*place)
        vectors = np.moveaxis(np.tensordot(self._axes / self.square, steps, axes=(1, 1)), 1, 0)
        bright = np.zeros(centre.shape[1:])
        for step_weights in weights:
            moves = (weight * vector for weight, vector in zip(step_weights.tolist(), vectors, strict=True))
            half_sum = 0.5 * np.floor(sum(moves, centre)).sum(axis=0)
            bright += half_sum != np.floor(half_sum)  # a square with an odd sum of numbers
        return bright / len(weights)


class CheckerboardFlight(Flight):
    """A flight over a checkerboard.

    Examples
    --------
    >>> flight = CheckerboardFlight(SimulationSettings(lines=8, bands=4, columns=32, scene="checkerboard"))
    >>> block = flight.lines(0, 8)
    >>> block.counts.shape, sorted(block.layers)
    ((8, 4, 32), ['bright_share', 'east', 'height', 'north'])
    """

    surfaces = _SQUARES
    paints = _SQUARES

    def __init__(self, settings: SimulationSettings) -> None:
        super().__init__(settings)
        east, north = map(float, self.plane.project(self.frame.latitude, self.frame.longitude))
        self.board = Checkerboard((east, north), settings.square, settings.board_turn)
        place = f"of what the middle of the pixel shows at mid exposure, on {self.plane.crs}"
        metres = {
            "east": f"East {place}",
            "north": f"North {place}",
            "height": "Height above the ellipsoid of that place",
        }
        share = {"long_name": "Share of the pixel on bright squares", "units": "1"}
        self.layers = {
            "bright_share": Layer("float32", share),
            **{name: Layer("float64", {"long_name": text, "units": "m"}) for name, text in metres.items()},
        }
        self._reflected = self._reflected_light(_SQUARES)

    @cached_property
    def corners(self) -> dict[str, Floats]:
        # east and north of the corners in the imaged area and a margin around it [m]
        origin, rotation = self._cameras
        imaged = np.stack(
            self._map_coordinates(self._places(origin[:, 1], rotation[:, 1], self._tangents[[0, -1]]))[:2]
        ).reshape(2, -1)
        minimum, maximum = imaged.min(axis=1) - _MARGIN_M, imaged.max(axis=1) + _MARGIN_M
        box = np.stack([limits.ravel() for limits in np.meshgrid(*np.stack([minimum, maximum], axis=1))])
        ranges = (np.arange(np.floor(n.min()), np.ceil(n.max()) + 1) for n in self.board.numbers(*box))
        u, v = np.meshgrid(*ranges, indexing="ij")
        corners = self.board.corners(np.stack([u.ravel(), v.ravel()], axis=-1))
        east, north = corners[((corners >= minimum) & (corners <= maximum)).all(axis=1)].T
        return {"east": east, "north": north}

    def _view(self, start: int, stop: int, into: Lines | None) -> LineView:
        number, columns = stop - start, self.settings.columns
        starts = range(start, stop, _CACHED_LINES)
        slabs = [
            self._pixel_truth(start_line, min(start_line + _CACHED_LINES, stop)) for start_line in starts
        ]
        layers: dict[str, NDArray[Any]] = {
            name: np.concatenate([slab[name] for slab in slabs]).astype(layer.dtype)
            for name, layer in self.layers.items()
        }
        shares = layers["bright_share"]
        glint = np.zeros((number, columns), bool)
        block = Lines((shares > 0.5).astype(np.int16), glint, *self._cubes(number, into), layers)
        factors = self._factors(start, stop)

        def element_radiance(row: int) -> Floats:
            reflected = np.zeros((self.settings.bands, columns))
            for factor, (dark, bright) in zip(factors[:, row], self._reflected, strict=True):
                reflected += factor * (dark + shares[row] * (bright - dark))
            return reflected

        return block, element_radiance

    def clean_paint(self, lines: Lines) -> NDArray[np.int32]:
        # paint of pixels within a square, -1 for all others
        shares = lines.layers["bright_share"]
        return np.where((shares == 0.0) | (shares == 1.0), super().clean_paint(lines), np.int32(-1))

    @property
    def _tangents(self) -> Floats:
        # tangents of the look angles of columns, positive to the right
        return np.tan(np.radians(self.look_angle))

    @cached_property
    def _cameras(self) -> tuple[Floats, Floats]:
        # position and rotation of the camera at start, middle and end of every exposure
        return self.trajectory.camera(
            self.line_times[:, None] / 1e9 + (self.settings.exposure_time / 2) * np.array([-1.0, 0.0, 1.0])
        )

    def _pixel_truth(self, start: int, stop: int) -> dict[str, Floats]:
        origin, rotation = (pose[start:stop] for pose in self._cameras)
        tangents, half_pixel = self._tangents, 0.5 * PIXEL_ANGLE_RAD
        at_start, at_middle, at_end = (self._places(origin[:, k], rotation[:, k], tangents) for k in range(3))
        east, north, height = self._map_coordinates(at_middle)
        camera = origin[:, 1], rotation[:, 1]
        # within a pixel, positions are linear in width and length, and quadratic in time
        width = self._places(*camera, tangents + half_pixel) - self._places(*camera, tangents - half_pixel)
        length = self._places(*camera, tangents, half_pixel) - self._places(*camera, tangents, -half_pixel)
        steps = np.stack([width, length, at_end - at_start, 2.0 * (at_start + at_end - 2.0 * at_middle)])[
            ..., :2
        ]
        # steps on the map, from those east and north in the scene
        origin_and_units = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
        places = np.stack(self._map_coordinates(origin_and_units)[:2])
        steps = np.moveaxis(steps @ (places[:, 1:] - places[:, :1]).T, -1, 1)
        share = self.board.share(np.stack([east, north]), steps, _WEIGHTS)
        return {"bright_share": share, "east": east, "north": north, "height": height}

    def _places(self, origin: Floats, rotation: Floats, across: Floats, along: float = 0.0) -> Floats:
        # points on the ground in the axes of the scene (line, column, 3) [m]
        rays = np.stack([np.full_like(across, along), across, np.ones_like(across)])
        rays = (rotation @ rays).swapaxes(1, 2)
        reach = -origin[:, None, 2] / rays[..., 2]
        # the ground is 8 cm below the tangent plane at a kilometre; two steps of the iteration are exact
        for _ in range(2):
            level = origin[:, None] + reach[..., None] * rays
            level[..., 2] = 0.0
            _, _, height = self.frame.geodetic(level)
            reach = (self.frame.height - height - origin[:, None, 2]) / rays[..., 2]
        return np.asarray(origin[:, None] + reach[..., None] * rays)

    def _map_coordinates(self, places: Floats) -> tuple[Floats, Floats, Floats]:
        # east, north and height above the ellipsoid of points (..., 3) in the axes of the scene
        latitude, longitude, height = self.frame.geodetic(places)
        return *self.plane.project(latitude, longitude), height


#: Reflectance added by the sun mirrored in a clear coat, above which a pixel is glint [1].
GLINT = 0.02

_RENDERED = SimpleNamespace(
    max_length_m=2000.0,  # maximum length of the car park
    margin_before_m=3.0,  # minimum length of car park before and behind the imaged area
    panel_period_m=30.0,  # distance of repeated grey panels, with which a flight starts
    ground_margin_m=30.0,  # ground around the car park
    min_lean_deg=0.5,  # minimum angle assumed between camera axis and vertical
    sky_rings=12,  # parts of the sky that light a sample of a field spectrometer
    lines_at_once=4,  # lines traced by a thread at once
)


class RenderedFlight(Flight):
    """A flight over a car park of triangles.

    Raises
    ------
    SchemaError
        The flight is longer than the maximum length of a car park.

    Examples
    --------
    >>> flight = RenderedFlight(SimulationSettings(lines=8, bands=4, columns=32, samples=2))
    >>> block = flight.lines(0, 8)
    >>> block.counts.shape, block.layers["purity"].shape
    ((8, 4, 32), (8, 32))
    """

    def __init__(self, settings: SimulationSettings) -> None:
        super().__init__(settings)
        # the park starts before the view of the first line and ends behind that of the last line
        # maximum distance ahead at which the camera looks, and length of park before its view [m]
        path = self.trajectory
        lean = float(np.tan(np.radians(max(_RENDERED.min_lean_deg, path.steepest))))
        ahead = lean * self.ground_sample / PIXEL_ANGLE_RAD
        yaw_margin = float(np.sin(np.radians(path.max_yaw))) * SWATH_M / 2
        self._ahead = ahead + _RENDERED.margin_before_m
        before = ahead + max(_RENDERED.margin_before_m, yaw_margin + 1.0) + max(map(abs, path.lever_arm))
        start = np.ceil((before + ahead) / _RENDERED.panel_period_m) * _RENDERED.panel_period_m - ahead
        length = start + settings.lines * self.ground_sample + before
        SchemaError.raise_if(
            length > _RENDERED.max_length_m,
            f"{settings.lines} lines of {self.ground_sample:g} m need {length:.0f} m of car park",
            expected=f"at most {_RENDERED.max_length_m:g} m",
            mend="take fewer lines, more columns, or scene='plan'",
            code="flight-too-long",
        )
        scene = car_park(
            length=float(length),
            width=SWATH_M,
            seed=settings.seed,
            neighbours=("trees", "walls", "lamps") if settings.neighbours else (),
            coat="own" if settings.coat else None,
            fleet=settings.fleet,
            # flakes only for the real fleet: a metallic paint has no single reflectance for a field
            # spectrometer
            flakes=settings.fleet == "real",
            margin=float(_RENDERED.ground_margin_m + 2 * before),
            name="simulated car park",
        ).moved((0.0, -float(start), 0.0))
        record = SceneRecord.of(scene)
        overcast = settings.sky == "overcast"
        trace = TraceSettings(
            (settings.sun,),
            samples=settings.samples,
            seed=settings.seed,
            overcast=overcast,
            clear=not overcast,
        )
        self._scene: PreparedScene = prepare_scene(scene, trace)
        spectra = [material.spectrum for material in record.materials]
        self.surfaces = tuple(dict.fromkeys(spectra))
        self.paints = tuple(
            sorted({material.spectrum for material in record.materials if material.kind == "paint"})
        )
        meters = {
            "east": f"East of the mean place seen, on {self.plane.crs}",
            "north": f"North of the mean place seen, on {self.plane.crs}",
            "height": "Mean height above the ellipsoid of what is seen",
            "up": "Mean height above the ground, a plane that touches it under the first line",
        }
        layers: dict[str, tuple[str, str, dict[str, Any]]] = {
            "surface_class": ("int16", "Kind of the surface", self._scene.labels["surface_class"].attrs),
            "paint_id": ("int16", "Paint of the car; -1 off paint", self._scene.labels["paint_id"].attrs),
            "car_id": ("int32", "Number of the car; -1 where there is none", {}),
            "purity": ("float32", "Share of the pixel that shows this surface", {"units": "1"}),
            "shadow": ("float32", "Share of the pixel that does not see the sun", {"units": "1"}),
            **{name: ("float64", text, {"units": "m"}) for name, text in meters.items()},
        }
        # Names of a fleet's paints by spectrum: "white solid", "white solid 2" ... along the flight, paints
        # in view first.
        middle = scene.vertices[scene.faces].mean(axis=1)[:, 1]
        end = self.settings.lines * self.ground_sample
        seen: dict[str, tuple[bool, float]] = {}
        for number, item in enumerate(scene.instances):
            if item.kind == "car":
                north = float(middle[scene.face_instance == number].mean())
                seen[item.paint] = min((not 0.0 <= north < end, north), seen.get(item.paint, (True, np.inf)))
        self._names: dict[str, str] = {}
        counts: Counter[str] = Counter()
        for paint in sorted(seen, key=seen.__getitem__):
            words = f"{paint_spec(paint).colour} {paint_spec(paint).finish}"
            counts[words] += 1
            numbered = f"{words} {counts[words]}" if counts[words] > 1 else words
            self._names[paint] = numbered if self.settings.fleet == "real" else paint
        self._seen = tuple(name for name, (_, y) in seen.items() if -self._ahead <= y <= end + self._ahead)
        layers["paint_id"][2]["flag_meanings"] = " ".join(
            self.name_of(name).replace(" ", "_") for name in layers["paint_id"][2]["flag_meanings"].split()
        )
        # convert arrays to lists, because attributes are written as JSON
        self.layers = {
            name: Layer(dtype, {"long_name": text} | {k: np.asarray(v).tolist() for k, v in attrs.items()})
            for name, (dtype, text, attrs) in layers.items()
        }
        self._surface = np.array([self.surfaces.index(name) for name in spectra], np.int16)
        self._cosine = float(np.cos(np.radians(settings.sun[0])))
        bands = BandSet.of(self.imager)
        # light without path radiance and with unit transmittance
        direct, diffuse = self.sky
        atmosphere = Atmosphere(
            self.grid,
            direct / self._cosine,
            diffuse,
            0.0 * self.grid,
            0.0 * self.grid,
            *settings.sun,
            overcast_share=CIE_OVERCAST_SHARE if overcast else 0.0,
            **clear_spread(self.grid, direct, settings.sun[0]),
        )
        factors = factor_spectra(record, bands)
        self._populations = populations_of(record, factors, bands)
        self._products = ProductTable(
            bands, self._scene.codes, self.grid, source_spectra(atmosphere, trace), factors, normalise=False
        )

    def name_of(self, spectrum: str) -> str:
        return self._names.get(spectrum, spectrum)

    @property
    def measured_paints(self) -> tuple[str, ...]:
        return tuple(paint for paint in self._names if paint in self._seen)

    def paint_reflectance(self, names: Sequence[str], wavelength: Floats) -> Floats:
        # Reflectance factors of level paints, seen from the nadir under the flight's sun and sky, without
        # mirror reflection, shape (name, wavelength).
        direct, diffuse = (np.interp(wavelength, self.grid, light) for light in self.sky)
        # equal parts of the light of a uniform sky
        rings = np.degrees(
            np.arcsin(np.sqrt((np.arange(_RENDERED.sky_rings) + 0.5) / _RENDERED.sky_rings))
        ).tolist()
        factors = []
        for name in names:
            body, paint = spectrum_of(name)(wavelength), paint_spec(name).material()
            if not self._flake_share(name) or paint.flakes is None:
                factors.append(body)
                continue
            flakes = spectrum_of(paint.flakes.spectrum)(wavelength)
            turned = spectrum_of(paint.flakes.turned)(wavelength) if paint.flakes.turned else None
            sun, *sky = (
                reflectance_factor(paint, body, flakes, light=zenith, view=0.0, turned=turned)
                for zenith in (self.settings.sun[0], *rings)
            )
            factors.append((direct * sun + diffuse * np.mean(sky, axis=0)) / (direct + diffuse))
        return np.stack(factors)

    def paint_properties(self, paint: str) -> Mapping[str, str]:
        # paints of a solid fleet have no flakes, also if their catalogue entry has flakes
        finish = paint_spec(paint).finish if self._flake_share(paint) else "solid"
        return {"colour": paint_spec(paint).colour, "finish": finish}

    def _flake_share(self, paint: str) -> float:
        # share of flakes in a paint of this scene
        flakes = paint_spec(paint).flakes if self.settings.fleet == "real" and self.settings.coat else None
        return 0.0 if flakes is None else flakes.share

    def clean_paint(self, lines: Lines) -> NDArray[np.int32]:
        # paint and car of pixels that show only one car's paint, in full sun and without glint; else -1
        paint, car = super().clean_paint(lines), np.asarray(lines.layers["car_id"], np.int32)
        is_clean = (
            (paint >= 0) & (car >= 0) & (lines.layers["purity"] == 1.0) & (lines.layers["shadow"] == 0.0)
        )
        return np.where(is_clean, paint + len(self.paints) * car, -1).astype(np.int32)

    @cached_property
    def platform(self) -> Platform:
        # camera poses at start and end of every exposure
        settings = self.settings
        moment = self.line_times[:, None] / 1e9 + settings.exposure_time * np.array([-0.5, 0.5])
        edges = pixel_edges(settings.columns, PIXEL_ANGLE_RAD)
        return Platform(*self.trajectory.camera(moment), *edges, self.line_times, settings.exposure_time)

    def _view(self, start: int, stop: int, into: Lines | None) -> LineView:
        platform = self.platform

        def trace(begin: int) -> Block:
            return trace_block(self._scene, platform, begin, min(begin + _RENDERED.lines_at_once, stop))

        # threads run in parallel, because the kernel releases the interpreter lock
        with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
            blocks = list(pool.map(trace, range(start, stop, _RENDERED.lines_at_once)))
        block = Block(*map(np.concatenate, zip(*blocks, strict=True)))
        factors = self._factors(start, stop)
        latitude, longitude, height = self.frame.geodetic(np.moveaxis(block.position, 1, -1))
        east, north = self.plane.project(latitude, longitude)
        layers = {
            **label_layers(self._scene.labels, block.material, block.instance),
            "purity": block.purity,
            "shadow": 1.0 - block.sun_visibility[:, 0],
            "east": east,
            "north": north,
            "height": height,
            "up": block.position[:, 2],
        }
        # pixels in which mirrored sun adds more than `GLINT`, shape (line, column)
        mirrored = is_direct(block.code) & is_mirrored(block.code) & ~is_indirect(block.code)
        level = self.incident.mean(axis=(1, 2)) @ factors
        normal = self.incident[0].mean() / self._cosine * factors[0]
        glint = np.where(mirrored, block.weight, 0.0).sum(axis=1) * (normal / level)[:, None] > GLINT
        record = Lines(
            self._surface[block.material], np.asarray(glint), *self._cubes(stop - start, into), layers
        )
        # the array of radiance holds INT L R until counts are computed
        direct, diffuse = factors[:, :, None, None]
        weight = (block.weight * np.where(is_direct(block.code), direct, diffuse)).astype(np.float32)
        texture = None
        if self._populations is not None:
            members, (x, y, z) = self._populations, np.moveaxis(block.position, 1, 0)
            rows = member_rows(
                block.material, block.instance, x, y, z, block.incidence[:, 0],
                sun_zenith=self.settings.sun[0], grain=members.grain, seed=self.settings.seed,
            )  # fmt: skip
            texture = members.of_rows(rows)
        self._products.mix(weight, block.code, record.radiance, texture)
        per_element = np.pi * self.imager.element_factor
        return record, lambda row: record.radiance[row] * per_element
