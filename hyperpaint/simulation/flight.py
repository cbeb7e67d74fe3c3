"""One simulated flight: what the scene, the light and the camera do, line by line.

The light is a mix of two spectra and a pixel sees one of some twenty materials, so that every radiance
integral of a flight is in one table, INT rho_m E_k R_b,x (k direct or diffuse), made once.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from .atmosphere import Light, Sky, spectral_grid
from .camera import Camera
from .instruments import ASD_AVERAGES, ASD_INTEGRATION_MS, ASD_WAVELENGTH
from .paints import CAR_PAINTS, MATERIALS, reflectance
from .scenes import CarPark
from .sensor import convolve_gaussian, expected_counts
from .settings import SimulationSettings

__all__ = ["Flight", "Lines", "SkySamples"]

Floats = NDArray[np.float64]

# keys of the random streams: [seed, stream, line], so that nothing depends on how lines are grouped
_TEXTURE, _GLINT, _NOISE, _DARK_FRAMES, _SKY = 10, 11, 12, 16, 17

_CAR = np.array([name in CAR_PAINTS for name in MATERIALS])
_TEXTURED = np.array([not name.startswith("panel") for name in MATERIALS])
_PIXEL_ANGLE = 7.4e-6 / 12e-3  # rad: pixel pitch over focal length
_ORIGIN = (43.0845, -77.6749, 160.0)  # latitude, longitude [degree], ground [m]
_METRES_PER_DEGREE = 111_120.0


@dataclass(frozen=True)
class Lines:
    """Consecutive lines: what was seen, and what the converter was given.

    Attributes
    ----------
    surface
        Class of every pixel, shape (along_track, cross_track), int16.
    glint
        True where a pixel mirrors the sun, shape (along_track, cross_track).
    counts
        Before conversion, shape (along_track, band, cross_track), float32 [count].
    radiance, reflectance
        Response-weighted means, shape as counts, float32 [W m-2 sr-1 nm-1], [1].
    """

    surface: NDArray[np.int16]
    glint: NDArray[np.bool_]
    counts: NDArray[np.float32]
    radiance: NDArray[np.float32]
    reflectance: NDArray[np.float32]


@dataclass(frozen=True)
class SkySamples:
    """The irradiance record.

    Attributes
    ----------
    stamp
        Whole seconds since 1970 of the logging computer's idea of UTC, shape (irradiance_time,).
    middle
        Middle of each average, in nanoseconds after the first line, true time, int64.
    factors
        Of direct and diffuse light over each average, shape (2, irradiance_time).
    irradiance
        Shape (irradiance_time, irradiance_wavelength) [W m-2 nm-1].
    """

    stamp: NDArray[np.int64]
    middle: NDArray[np.int64]
    factors: Floats
    irradiance: Floats


class Flight:
    """A flight over the car park.

    Parameters
    ----------
    settings
        Size and effects.
    """

    def __init__(self, settings: SimulationSettings) -> None:
        self.settings = settings
        self.camera = Camera.of(settings)
        self.imager = self.camera.imager
        self.wavelength = self.imager.wavelength
        self.detector = self.camera.detector(settings.exposure_time)
        self.bad = self.camera.bad
        self.park = CarPark(settings.columns, settings.seed)
        self.light = Light(settings.drift_per_minute, settings.cloud)
        self._tabulate()

    def _rng(self, stream: int, *key: int) -> np.random.Generator:
        return np.random.default_rng([self.settings.seed, stream, *key])

    def _tabulate(self) -> None:
        reach, width = self.imager.reach, 4.0 * self.settings.irradiance_fwhm_nm
        self.grid = spectral_grid(
            min(self.wavelength[0] - reach, ASD_WAVELENGTH[0] - width) - 1.0,
            max(self.wavelength[-1] + reach, ASD_WAVELENGTH[-1] + width) + 1.0,
        )
        self.sky = np.stack(Sky(self.settings.sun_zenith).irradiance(self.grid))
        rho = reflectance(list(MATERIALS), self.grid)
        spectra = np.concatenate(
            [(light * rho) for light in self.sky] + [self.sky, np.ones((1, len(self.grid)))]
        )
        integrals = self.imager.integrals(spectra, self.grid)
        count = len(rho)
        #: INT rho_m E_k R, shape (light, band, material x cross_track), ready to be looked up
        self._reflected = np.stack(
            [
                integrals[part].transpose(1, 0, 2).reshape(self.settings.bands, -1)
                for part in (slice(0, count), slice(count, 2 * count))
            ]
        )
        self._incident = integrals[2 * count : 2 * count + 2]
        #: INT R of every element, shape (band, cross_track) [count nm J-1]
        self.response_area = integrals[-1]
        self._per_radiance = 1.0 / (np.pi * self.response_area)

    @property
    def etendue(self) -> float:
        """Etendue of an element [m2 sr]."""
        return self.camera.etendue

    @cached_property
    def start(self) -> int:
        """UTC at mid exposure of the first line [ns since 1970]."""
        return int(np.datetime64(self.settings.start_time, "ns").astype(np.int64))

    @cached_property
    def line_times(self) -> NDArray[np.int64]:
        """Mid exposure of every line, shape (along_track,) [ns after the first]."""
        period = self.settings.frame_period_ms * 1e6
        return np.asarray(np.rint(np.arange(self.settings.lines) * period), dtype=np.int64)

    @property
    def radiance_gain(self) -> Floats:
        """1 / (etendue INT R), NaN at bad elements, shape (band, cross_track) [W m-2 sr-1 nm-1 s count-1]."""
        return self.camera.radiance_gain(self.response_area)

    def matched_irradiance(self, factors: Floats) -> Floats:
        """Return the irradiance that each element would have seen, INT E R / INT R.

        Parameters
        ----------
        factors
            Of direct and diffuse light, shape (2, time).

        Returns
        -------
        Shape (time, band, cross_track) [W m-2 nm-1].
        """
        return np.asarray(np.einsum("kt,kbx->tbx", factors, self._incident) / self.response_area)

    def lines(self, start: int, stop: int, into: Lines | None = None) -> Lines:
        """Return lines ``start`` to ``stop``; the same whatever lines are asked for together.

        Parameters
        ----------
        start, stop
            Range of lines.
        into
            Lines no longer needed, whose memory is used again; fresh memory costs more than the arithmetic.
        """
        settings, number = self.settings, stop - start
        if into is None or len(into.counts) < number:
            shape = (number, settings.bands, settings.columns)
            cubes = [np.empty(shape, dtype=np.float32) for _ in range(3)]
        else:
            cubes = [cube[:number] for cube in (into.counts, into.radiance, into.reflectance)]
        surface = self.park.surface(start, stop)
        mirrored = np.stack([self._mirrored(start + row, surface[row]) for row in range(number)])
        made = Lines(surface, mirrored > 0, *cubes)
        factors = self.light.factors(self.line_times[start:stop] / 1e9)

        def expose(row: int) -> None:
            self._expose(made, row, start + row, factors[:, row], mirrored[row])

        # numpy lets go of the interpreter; each line has its own random numbers
        with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
            list(pool.map(expose, range(number)))
        return made

    def _expose(self, made: Lines, row: int, line: int, factors: Floats, mirrored: Floats) -> None:
        """Fill one line's counts, radiance and reflectance."""
        settings = self.settings
        direct, diffuse = factors
        index = made.surface[row].astype(np.intp) * settings.columns + np.arange(settings.columns)
        # INT L R x pi of every element
        seen = self._reflected[0].take(index, axis=1, mode="clip")
        seen *= direct
        term = self._reflected[1].take(index, axis=1, mode="clip")
        term *= diffuse
        seen += term
        if settings.texture:
            seen *= self._texture(line, made.surface[row])
        if mirrored.any():
            seen += mirrored * direct * self._incident[0]
        np.multiply(self._incident[0], direct, out=term)
        term += diffuse * self._incident[1]
        np.divide(seen, term, out=made.reflectance[row], casting="same_kind")
        np.multiply(seen, self._per_radiance, out=made.radiance[row], casting="same_kind")
        seen *= 1.0 / np.pi
        signal = expected_counts(seen, settings.exposure_time, self.etendue)
        signal[self.bad] = 0.0
        rng = self._rng(_NOISE, line) if settings.noise else None
        made.counts[row] = self.detector.read(signal, rng)

    def _texture(self, line: int, surface: NDArray[np.int16]) -> Floats:
        normal = np.clip(self._rng(_TEXTURE, line).standard_normal(surface.shape), -3.0, 3.0)
        return np.where(_TEXTURED[surface], 1.0 + self.settings.texture * normal, 1.0)

    def _mirrored(self, line: int, surface: NDArray[np.int16]) -> Floats:
        """Return the reflectance factor of the clear coat's mirror image of the sun, zero for most pixels."""
        rng = self._rng(_GLINT, line)
        chance, strength = rng.random(surface.shape), rng.uniform(2.0, 12.0, surface.shape)
        return np.where((chance < self.settings.glint) & _CAR[surface], strength, 0.0)

    def dark_frames(self) -> NDArray[np.uint16]:
        """Return the dark cube, shape (along_track, band, cross_track)."""
        dark = np.empty((self.settings.dark_frames, *self.detector.dark.shape), dtype=np.uint16)
        for frame in range(len(dark)):
            rng = self._rng(_DARK_FRAMES, frame) if self.settings.dark_noise else None
            dark[frame] = self.detector.convert(self.detector.read(np.zeros_like(self.detector.dark), rng))
        return dark

    def sky_samples(self) -> SkySamples:
        """Return the irradiance record from before the first line to after the last."""
        settings = self.settings
        second, offset = 10**9, round(settings.clock_offset_s * 1e9)
        margin = round(settings.irradiance_margin_s * 1e9) + second
        first = (self.start - margin - offset) // second
        last = -((-(self.start + int(self.line_times[-1]) + margin - offset)) // second)
        interval = settings.irradiance_interval_s
        stamp = np.arange(first, last + interval, interval, dtype=np.int64)
        length = ASD_INTEGRATION_MS * ASD_AVERAGES * 10**6
        begins = {"start": 0, "mid": length // 2, "end": length}[settings.irradiance_stamp]
        begin = stamp * second + offset - self.start - begins
        middle = begin + length // 2
        if settings.irradiance_gap is not None:
            low, high = (round(1e9 * edge) for edge in settings.irradiance_gap)
            kept = (middle < low) | (middle > high)
            stamp, begin, middle = stamp[kept], begin[kept], middle[kept]
        factors = self.light.mean_factors(begin / 1e9, (begin + length) / 1e9)
        spectra = convolve_gaussian(self.sky, self.grid, ASD_WAVELENGTH, settings.irradiance_fwhm_nm)
        irradiance = factors.T @ spectra
        if settings.irradiance_noise:
            for index, seconds in enumerate(stamp.tolist()):
                noise = self._rng(_SKY, seconds).standard_normal(irradiance.shape[1])
                irradiance[index] *= 1.0 + settings.irradiance_noise * noise
        return SkySamples(stamp, middle, factors, irradiance)

    def pose(self, seconds: Floats) -> dict[str, Floats]:
        """Return position and attitude at times from the first line [s]; the scene is not moved by them."""
        latitude, longitude, ground = _ORIGIN
        along = seconds * self.park.ground_sample / (self.settings.frame_period_ms / 1e3)
        return {
            "roll": 0.4 * np.sin(2 * np.pi * seconds / 3.1 + 0.3),
            "pitch": 0.3 * np.sin(2 * np.pi * seconds / 4.7 + 1.1),
            "heading": 0.2 * np.sin(2 * np.pi * seconds / 7.9) + 0.5,
            "latitude": latitude + along / _METRES_PER_DEGREE,
            "longitude": np.full_like(seconds, longitude),
            "altitude": ground
            + self.park.ground_sample / _PIXEL_ANGLE
            + 0.1 * np.sin(2 * np.pi * seconds / 11.0),
        }
