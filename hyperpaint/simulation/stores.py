"""Calibration, truth and sweeps of the simulator as labelled arrays and Zarr stores."""

from __future__ import annotations

import json
import shutil
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
import zarr
from numpy.typing import NDArray
from zarr.codecs import BloscCodec

from hyperpaint.base.arrays import Progress
from hyperpaint.base.errors import FormatError, StoreError
from hyperpaint.base.facts import documented
from hyperpaint.base.input_files import input_path, read_limited
from hyperpaint.base.schema import (
    CHUNK_LINES,
    CUBE,
    FORMAT_VERSION,
    STEP,
    SWEEP_VARIABLES,
    TIME_UNITS,
    VARIABLES,
    Variable,
)

from .flight import CheckerboardFlight, Flight, Lines
from .instruments import ASD_WAVELENGTH
from .rendering.platforms import CONVENTION
from .sweep import Sweep, SweepSettings

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
        "flag_meanings": " ".join(flight.surfaces),
    }


def labelled(row: Variable, values: Any, dims: tuple[str, ...] | None = None) -> xr.Variable:
    # values with the dims, dtype and attributes of a row of the table of variables
    values = np.asarray(values).astype(row.dtype)
    if dims is None:
        dims = next(d for d in (row.dims, *row.alternatives) if len(d) == values.ndim)
    return xr.Variable(dims, values, row.attrs)


def _variable(name: str, values: Any, dims: tuple[str, ...] | None = None) -> xr.Variable:
    return labelled(VARIABLES[name], values, dims)


def _band_coords(flight: Flight) -> dict[str, xr.Variable]:
    return {
        "wavelength": _variable("wavelength", flight.wavelength),
        "fwhm": _variable("fwhm", flight.imager.fwhm),
        "good": _variable("good", np.ones(flight.settings.bands)),
        "wavelength_shift": _variable("wavelength_shift", flight.imager.wavelength_shift, (CROSS_TRACK,)),
    }


def _calibration(flight: Flight) -> dict[str, xr.Variable]:
    return {
        "radiance_gain": _variable("radiance_gain", flight.camera.radiance_gain(flight.response_area)),
        "electrons_per_count": _variable("electrons_per_count", flight.settings.electrons_per_count),
        "read_noise": _variable("read_noise", flight.settings.read_noise),
        "look_angle": _variable("look_angle", flight.look_angle),
    }


def write_calibration(flight: Flight, path: Path) -> None:
    # write ``calibration.zarr``: the gain of every element, wavelengths, smile, line shape, noise
    optics = flight.camera.optics
    stray_light = {} if optics is None else {"stray_light": _variable("stray_light", optics.stray_matrix)}
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
    with warnings.catch_warnings():
        # zarr warns that the specification of version 3 does not have consolidated metadata
        warnings.simplefilter("ignore")
        zarr.consolidate_metadata(path)


def _line_coords(flight: Flight, recorded: NDArray[np.bool_] | None = None) -> dict[str, xr.Variable]:
    stamps = (flight.start + flight.line_times).astype("datetime64[ns]")
    if recorded is not None:
        stamps[~recorded] = np.datetime64("NaT", "ns")
    lines, _, columns = (np.arange(size) for size in flight.settings.shape)
    values = {"time": stamps, "frame": lines, ALONG_TRACK: lines, CROSS_TRACK: columns}
    return {name: _variable(name, column_values) for name, column_values in values.items()}


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

    def write(self, start: int, lines: Lines, recorded: NDArray[np.bool_]) -> None:
        rows = slice(start, start + len(recorded))
        for name, values in {
            **{name: getattr(lines, name) for name in ("reflectance", "radiance", "surface", "glint")},
            "saturated": _saturated(lines, self._saturation_count),
            "no_data": ~recorded,
            **lines.layers,
        }.items():
            self._arrays[name][rows] = values


def _saturated(lines: Lines, saturation_count: int) -> NDArray[np.bool_]:
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
            **_line_coords(flight, recorded),
            **{
                name: _variable(name, values)
                for name, values in flight.trajectory.pose(flight.line_times / 1e9).items()
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
        if not (overwrite and is_earlier):
            mend = "choose another path, or replace an earlier sweep with {}"
            raise StoreError(
                f"{target} exists",
                mend=mend.format("overwrite=True"),
                option=mend.format("--overwrite"),
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
