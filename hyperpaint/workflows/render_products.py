"""Stored products of a render: a flight line, and the truth of every pixel."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from hyperpaint.base.arrays import Floats, Floats32, round_bits
from hyperpaint.base.constants import KEPT_BITS
from hyperpaint.base.schema import CUBE, IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH, VARIABLES

if TYPE_CHECKING:
    from hyperpaint.simulation.camera import Camera, Detector, Optics
    from hyperpaint.simulation.rendering.camera_bands import BandSet
    from hyperpaint.simulation.rendering.four_curves import Atmosphere
    from hyperpaint.simulation.rendering.platforms import Platform

_INTERVAL_S = 2  # time between samples of the spectrometer
_MARGIN_S = 6  # record before and after the flight
_DARK_FRAMES = 64  # number of frames averaged for a dark
# keys of the random streams, different from those of other simulators
_NOISE, _DARK = 20, 21


@dataclass(frozen=True)
class Render:
    """Light, camera and paints, with which a traced scene becomes a flight line."""

    atmosphere: Atmosphere
    camera: Camera
    platform: Platform
    #: Spectra of the user by name: (wavelength [nm], reflectance), or a paint library.
    spectra: Mapping[str, Any]
    paints: Mapping[str, str]  #: New spectrum by the name of a spectrum, material or instance.
    hold_edges: bool = False  #: See `hyperpaint.simulation.relight`.

    def of(
        self, traced: xr.Dataset, *, product: str, true_reflectance: bool, seed: int, noise: bool
    ) -> xr.Dataset:
        """Return the flight line of a traced scene, lazily; see `hyperpaint.render_scene`.

        ``product`` is "radiance" or "counts"; ``true_reflectance``: whether to include it; ``seed`` and
        ``noise`` apply to the camera. Raises `SchemaError` as `relight`.
        """
        from hyperpaint.pictures.plot import overview
        from hyperpaint.simulation.rendering.relighting import relight

        relit = relight(
            traced,
            self._bands(product),
            paints=dict(self.paints),
            atmosphere=self.atmosphere,
            spectra=dict(self.spectra),
            hold_edges=self.hold_edges,
        )
        picture = overview(relit)
        line = relit.rename(reflectance="true_reflectance")
        line["true_reflectance"] = _rounded(line["true_reflectance"])
        if not true_reflectance:
            line = line.drop_vars("true_reflectance")
        if product == "counts":
            counts = counts_of(
                line["radiance"],
                self.camera,
                self.platform.exposure_time,
                seed,
                self.atmosphere.name,
                noise=noise,
            )
            line = line.drop_vars("radiance").merge(counts)
        line = irradiance_series(line, self.platform).assign_coords(pose_of(self.platform))
        line = line.assign(look_angle=_look_angle(self.platform))
        if picture is not None:
            line = line.assign(overview=picture)
        return line

    def _bands(self, product: str) -> BandSet:
        # Bands of counts are weighted by the responsivity of the detector. Bands of radiance are not: readers
        # of radiance do not know the responsivity, and resample the irradiance without it.
        from hyperpaint.simulation.rendering.camera_bands import BandSet

        bands = BandSet.of(self.camera.imager)
        return bands if product == "counts" else replace(bands, responsivity=None)


def _rounded(cube: xr.DataArray) -> xr.DataArray:
    # round to the mantissa bits of a stored reflectance, half to even
    rounded: xr.DataArray = xr.apply_ufunc(
        round_bits, cube, KEPT_BITS, dask="parallelized", output_dtypes=[np.float32], keep_attrs=True
    )
    rounded.attrs |= {"long_name": "Reflectance factor without noise", "keep_bits": KEPT_BITS}
    return rounded


def irradiance_series(relit: xr.Dataset, platform: Platform) -> xr.Dataset:
    """Return a render with the irradiance that a spectrometer logs during the flight, every 2 s.

    ``relit`` has the spectrum of its steady light; the record starts before and ends after the flight.
    """
    first, last = (moment.astype("datetime64[s]") for moment in platform.utc[[0, -1]])
    count = int((last - first).astype(np.int64) + 2 * _MARGIN_S) // _INTERVAL_S + 2
    seconds = _INTERVAL_S * np.arange(count) - _MARGIN_S
    time = (first + seconds.astype("timedelta64[s]")).astype("datetime64[ns]")
    spectrum = np.asarray(relit["irradiance"][0].values)
    wavelength = relit[IRRADIANCE_WAVELENGTH].variable
    return (
        relit.drop_vars(("irradiance", IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH))
        .assign(
            irradiance=_variable("irradiance", np.broadcast_to(spectrum, (count, len(spectrum)))),
            irradiance_max_gap=_variable("irradiance_max_gap", 2.5 * _INTERVAL_S),
        )
        .assign_coords({IRRADIANCE_TIME: _variable(IRRADIANCE_TIME, time), IRRADIANCE_WAVELENGTH: wavelength})
    )


def pose_of(platform: Platform) -> dict[str, xr.Variable]:
    """Return the pose of the camera at mid-exposure of every line, as variables of a flight line."""
    roll, pitch, heading = platform.attitude.T
    pose = {"altitude": platform.position[:, 2], "roll": roll, "pitch": pitch, "heading": heading}
    return {name: _variable(name, values) for name, values in pose.items()}


def _look_angle(platform: Platform) -> xr.Variable:
    # angles of column centres from the camera's axis, positive to the right
    edges = platform.column_edges
    return _variable("look_angle", np.degrees(np.arctan(0.5 * (edges[1:] + edges[:-1]))))


def counts_of(
    radiance: xr.DataArray, camera: Camera, exposure_time: float, seed: int, name: str, *, noise: bool = True
) -> xr.Dataset:
    """Return the counts of a camera under this radiance, with all variables that calibrate them.

    Lazy. The noise of a line is drawn from a generator keyed by seed, name of the render and number of the
    line, so that counts do not depend on chunks or workers; without ``noise`` counts are still rounded. The
    optics of the camera blur the radiance. ``radiance``: mean over the camera's responses (along_track, band,
    cross_track) [W m-2 sr-1 nm-1]; ``exposure_time``: [s].
    """
    import dask.array as da

    # a mean radiance of 1 gives (exposure time) x (etendue) x (integral of the response) counts; dead
    # elements 0
    scale, factor = exposure_time * camera.etendue * camera.response_area, np.where(camera.bad, 0.0, 1.0)
    if camera.optics is not None:  # optics act before the response of single elements
        scale, factor = scale / camera.imager.element_factor, factor * camera.imager.element_factor
    detector = camera.detector(exposure_time)
    key = (seed, _NOISE, zlib.crc32(name.encode()))
    cube = radiance.transpose(*CUBE).data
    reach = 0 if camera.optics is None else camera.optics.reach
    number, stops = cube.shape[0], np.cumsum(cube.chunks[0]).tolist()
    exposure = _Exposure(
        detector, camera.optics, scale, factor, camera.pedestal, key if noise else None, number
    )
    blocks = []
    for start, stop in zip([0, *stops], stops, strict=False):
        # include the lines around a block that blur into it
        window_start, window_end = max(start - reach, 0), min(stop + reach, number)
        window = cube[window_start:window_end].rechunk(-1)
        chunks = ((stop - start,), *window.chunks[1:])
        block = da.map_blocks(
            exposure.counts,
            window,
            first=window_start,
            lines=range(start, stop),
            dtype=np.uint16,
            chunks=chunks,
            meta=np.empty((0, 0, 0), dtype=np.uint16),
        )
        blocks.append(block)
    variables = {
        "counts": xr.Variable(CUBE, da.concatenate(blocks), VARIABLES["counts"].attrs),
        "dark_counts": _variable("dark_counts", _dark(detector, key) if noise else detector.dark),
        "radiance_gain": _variable("radiance_gain", camera.radiance_gain()),
        "exposure_time": _variable("exposure_time", exposure_time),
        "saturation_count": _variable("saturation_count", detector.saturation_count),
        "electrons_per_count": _variable("electrons_per_count", camera.electrons_per_count),
        "read_noise": _variable("read_noise", camera.read_noise),
    }
    return xr.Dataset(variables)


@dataclass(frozen=True)
class _Exposure:
    detector: Detector
    optics: Optics | None
    scale: Floats  # Counts at a mean radiance of 1, (band, cross_track)
    factor: Floats  # Relative response of the elements, 0 for dead elements, (band, cross_track)
    pedestal: float
    key: tuple[int, ...] | None  # Of the noise; None for none
    number: int  # Number of lines of the scene

    def counts(self, cube: Floats32, first: int, lines: range) -> NDArray[np.uint16]:
        # counts of ``lines`` in their order, because afterglow of a line adds to the next; the cube starts at
        # ``first``
        cube = np.nan_to_num(cube, nan=0.0)  # beyond the scene there is no light
        counts = np.empty((len(lines), *cube.shape[1:]), dtype=np.uint16)
        for line, row in zip(lines, counts, strict=True):
            rng = None if self.key is None else np.random.default_rng([*self.key, line])
            electrons = self.detector.read(self._signal(cube, first, line), rng)
            if self.pedestal:
                electrons += self.pedestal
            row[...] = self.detector.convert(electrons[None])[0]
        return counts

    def _signal(self, cube: Floats32, first: int, line: int) -> Floats:
        if self.optics is None:
            return np.asarray(cube[line - first] * (self.scale * self.factor))
        window = [cube[row - first] * self.scale for row in self.optics.rows_of(line, self.number)]
        return self.optics.image(window) * self.factor


def _dark(detector: Detector, key: tuple[int, ...]) -> Floats:
    # the mean of frames has residual noise and rounding errors
    rng = np.random.default_rng([key[0], _DARK])
    sd = np.sqrt((detector.read_noise**2 + 1.0 / 12.0) / _DARK_FRAMES)
    return np.asarray(detector.dark + sd * rng.standard_normal(detector.dark.shape))


def _variable(name: str, values: Any) -> xr.Variable:
    from hyperpaint.simulation.stores import labelled

    return labelled(VARIABLES[name], values)
