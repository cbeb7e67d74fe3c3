"""Calibration and truth as labelled arrays: the only part of the simulator that knows xarray and zarr."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
import zarr
from numpy.typing import NDArray
from zarr.codecs import BloscCodec

from hyperpaint.base.schema import CHUNK_LINES, CUBE, FORMAT_VERSION, TIME_UNITS, VARIABLES, Variable

from .checkerboard_flight import CheckerboardFlight
from .flight import Flight, Lines
from .instruments import ASD_WAVELENGTH
from .trajectories import CONVENTION

__all__ = [
    "TruthStore",
    "consolidate",
    "create_array",
    "labelled",
    "line_dataset",
    "write_calibration",
    "write_small",
]

ALONG_TRACK, BAND, CROSS_TRACK = CUBE
_PLANE = (ALONG_TRACK, CROSS_TRACK)

_MASKS = {
    "saturated": "True where the converter was full in any band",
    "glint": "True where the pixel mirrors the sun",
}

_NO_DATA_ATTRS = {"long_name": "True where the frame was never recorded"}


def _surface_attrs(flight: Flight) -> dict[str, Any]:
    return {
        "long_name": "Class of the surface",
        "flag_values": list(range(len(flight.surfaces))),
        "flag_meanings": " ".join(flight.surfaces),
    }


def labelled(row: Variable, values: Any, dims: tuple[str, ...] | None = None) -> xr.Variable:
    """Return values under the dims, dtype and attributes of a row of the table of variables."""
    values = np.asarray(values).astype(row.dtype)
    if dims is None:
        dims = next(d for d in (row.dims, *row.alternatives) if len(d) == values.ndim)
    return xr.Variable(dims, values, row.attrs)


def _variable(name: str, values: Any, dims: tuple[str, ...] | None = None) -> xr.Variable:
    return labelled(VARIABLES[name], values, dims)


def _band_coords(flight: Flight) -> dict[str, xr.Variable]:
    bands = flight.settings.bands
    return {
        "wavelength": _variable("wavelength", flight.wavelength),
        "fwhm": _variable("fwhm", flight.imager.band_fwhm),
        "good": _variable("good", np.ones(bands)),
        "wavelength_shift": _variable("wavelength_shift", flight.imager.wavelength_shift, (CROSS_TRACK,)),
    }


def _calibration(flight: Flight) -> dict[str, xr.Variable]:
    return {
        "radiance_gain": _variable("radiance_gain", flight.radiance_gain),
        "electrons_per_count": _variable("electrons_per_count", flight.settings.electrons_per_count),
        "read_noise": _variable("read_noise", flight.settings.read_noise),
        "look_angle": _variable("look_angle", flight.look_angle),
    }


def write_calibration(flight: Flight, path: Path) -> None:
    """Write ``calibration.zarr``: the gain of every element, wavelengths, smile, line shape, noise."""
    calibration = xr.Dataset(
        _calibration(flight),
        coords=_band_coords(flight),
        attrs={
            "hyperpaint_format": FORMAT_VERSION,
            "name": "simulated calibration",
            "srf_shape": flight.settings.srf_shape,
            "etendue": flight.camera.etendue,
            "history": f"exact calibration of the simulated imager, seed {flight.settings.seed}",
        },
    )
    # one chunk each, and everything written: a missing chunk is then a fault
    chunks = {
        str(name): {"chunks": array.shape} for name, array in calibration.variables.items() if array.ndim
    }
    write_small(calibration, path, **chunks)
    consolidate(path)


def write_small(dataset: xr.Dataset, path: Path, **encoding: dict[str, Any]) -> None:
    """Write small arrays as a new store; zarr's own default, zstd, is no codec that hyperpaint reads."""
    codec = BloscCodec(typesize=1, cname="lz4", clevel=5, shuffle="bitshuffle")
    encodings = {name: {"compressors": [codec], **encoding.get(str(name), {})} for name in dataset.variables}
    dataset.to_zarr(path, mode="w", zarr_format=3, consolidated=False, encoding=encodings)


def consolidate(path: Path) -> None:
    """Gather the metadata at the root, where plain `xarray.open_zarr` looks first."""
    with warnings.catch_warnings():
        # zarr warns that consolidated metadata is not yet in the specification of version 3
        warnings.simplefilter("ignore")
        zarr.consolidate_metadata(path)


def _time(flight: Flight, recorded: NDArray[np.bool_] | None = None) -> xr.Variable:
    stamps = (flight.start + flight.line_times).astype("datetime64[ns]")
    if recorded is not None:
        stamps[~recorded] = np.datetime64("NaT", "ns")
    return _variable("time", stamps)


def _mounting(flight: Flight) -> dict[str, Any]:
    """Return how the camera was mounted, and the map that places are told on."""
    settings, path = flight.settings, flight.trajectory
    return {
        "crs": flight.plane.crs, "ground": flight.frame.height, "boresight": list(path.boresight),
        "lever_arm": list(path.lever_arm), "frame_clock_offset_s": float(settings.frame_clock_offset_s),
    }  # fmt: skip


def _corners(flight: Flight) -> dict[str, xr.Variable]:
    """Return the corners of a checkerboard, where that is flown over."""
    if not isinstance(flight, CheckerboardFlight):
        return {}
    return {
        f"corner_{name}": xr.Variable(
            "corner", values, {"long_name": f"{name.capitalize()} of a corner of four squares", "units": "m"}
        )
        for name, values in flight.corners.items()
    }


class TruthStore:
    """``truth.zarr`` of a flight, filled line block by line block; replaced where it exists."""

    def __init__(self, flight: Flight, path: Path) -> None:
        settings = flight.settings
        self._full = flight.detector.saturation_count
        coords = {
            **_band_coords(flight),
            "time": _time(flight),
            "frame": _variable("frame", np.arange(settings.lines)),
        }
        head = xr.Dataset(
            coords=coords,
            attrs={
                "hyperpaint_format": FORMAT_VERSION, "name": "truth of a simulated collect",
                "srf_shape": settings.srf_shape, "irradiance_srf_shape": "gaussian", **_mounting(flight),
            },
        )  # fmt: skip
        head = head.assign(_corners(flight))
        time = {"dtype": "int64", "units": TIME_UNITS, "calendar": "proleptic_gregorian"}
        write_small(head, path, time=time)
        group = zarr.open_group(path, mode="r+")
        layers: dict[str, tuple[tuple[str, ...], str, dict[str, Any]]] = {
            "reflectance": (CUBE, "float32", VARIABLES["reflectance"].attrs),
            "radiance": (CUBE, "float32", VARIABLES["radiance"].attrs),
            "surface": (_PLANE, "int16", _surface_attrs(flight)),
            "no_data": ((ALONG_TRACK,), "bool", _NO_DATA_ATTRS),
            **{name: (_PLANE, "bool", {"long_name": text}) for name, text in _MASKS.items()},
            **{name: (_PLANE, layer.dtype, dict(layer.attrs)) for name, layer in flight.layers.items()},
        }
        sizes = dict(zip(CUBE, settings.shape, strict=True))
        self._arrays = {
            name: create_array(
                group, name, tuple(sizes[dim] for dim in dims), dims=dims, dtype=dtype, attrs=attrs
            )
            for name, (dims, dtype, attrs) in layers.items()
        }
        consolidate(path)

    def write(self, start: int, lines: Lines, recorded: NDArray[np.bool_]) -> None:
        """Write the lines from ``start`` on."""
        here = slice(start, start + len(recorded))
        saturated = _saturated(lines, self._full)
        layers = {"glint": lines.glint, "saturated": saturated, "no_data": ~recorded, **lines.layers}
        for name in ("reflectance", "radiance", "surface"):
            self._arrays[name][here] = getattr(lines, name)
        for name, values in layers.items():
            self._arrays[name][here] = values


def _saturated(lines: Lines, full: int) -> NDArray[np.bool_]:
    return np.asarray((lines.counts >= full - 0.5).any(axis=1))


def create_array(
    group: zarr.Group, name: str, shape: tuple[int, ...], *, dims: tuple[str, ...], dtype: str,
    attrs: dict[str, Any], chunk_length: int = CHUNK_LINES,
) -> Any:  # fmt: skip
    """Create an array to be filled block by block, in chunks of ``chunk_length`` along its first dim."""
    kind = np.dtype(dtype)
    return group.create_array(
        name, shape=shape, chunks=(min(chunk_length, shape[0]), *shape[1:]), dtype=dtype,
        compressors=[BloscCodec(typesize=kind.itemsize, cname="lz4", clevel=5, shuffle="bitshuffle")],
        fill_value=np.nan if kind.kind == "f" else kind.type(0), dimension_names=dims, attributes=attrs,
        config={"write_empty_chunks": True},
    )  # fmt: skip


def line_dataset(flight: Flight, block: Lines, *, matched: bool) -> xr.Dataset:
    """Return all lines of a flight as a flight line Dataset with its truth."""
    settings, detector = flight.settings, flight.detector
    recorded = np.ones(settings.lines, dtype=bool)
    recorded[settings.dropped_frames] = False
    counts = detector.convert(block.counts) if settings.quantise else block.counts
    counts[~recorded] = 65535
    dark = flight.dark_frames().mean(axis=0) if settings.quantise else detector.dark
    samples = flight.sky_samples()
    dims = ("irradiance_time", BAND, CROSS_TRACK)
    line = xr.Dataset(
        {
            "counts": xr.Variable(CUBE, counts, VARIABLES["counts"].attrs),
            "dark_counts": _variable("dark_counts", dark, (BAND, CROSS_TRACK)),
            **_calibration(flight),
            "exposure_time": _variable("exposure_time", settings.exposure_time),
            "saturation_count": _variable("saturation_count", detector.saturation_count),
            "irradiance": _variable("irradiance", samples.irradiance),
            "irradiance_fwhm": _variable("irradiance_fwhm", settings.irradiance_fwhm_nm),
            "irradiance_max_gap": _variable("irradiance_max_gap", 2.5 * settings.irradiance_interval_s),
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
            "time": _time(flight, recorded),
            "frame": _variable("frame", np.arange(settings.lines)),
            **{
                name: _variable(name, values) for name, values in flight.pose(flight.line_times / 1e9).items()
            },
            "irradiance_time": _variable(
                "irradiance_time", (flight.start + samples.middle).astype("datetime64[ns]")
            ),
            "irradiance_wavelength": _variable("irradiance_wavelength", ASD_WAVELENGTH),
        },
        attrs={
            "name": "simulated line",
            **{f"convention_{key}": value for key, value in CONVENTION.items()},
            "srf_shape": settings.srf_shape,
            "irradiance_srf_shape": "gaussian",
        },
    )
    if matched:
        line["matched_irradiance"] = xr.Variable(
            dims, flight.matched_irradiance(samples.factors), VARIABLES["irradiance"].attrs
        )
    return line
