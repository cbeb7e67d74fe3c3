"""A simulated sweep as labelled arrays: the instrument's part, and the truth beside it."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
import zarr
from zarr.codecs import BloscCodec

from hyperpaint.base.arrays import Progress
from hyperpaint.base.errors import StoreError
from hyperpaint.base.schema import (
    BAND,
    CROSS_TRACK,
    FORMAT_VERSION,
    STEP,
    SWEEP_VARIABLES,
    VARIABLES,
    Variable,
)

from .stores import blosc_encoding, consolidate
from .sweep import Sweep
from .sweep_settings import SweepSettings

__all__ = ["TRUTH", "store_sweep", "sweep_dataset", "sweep_truth", "write_sweep"]

TRUTH = "true_"
"""Opens the names of what a real sweep would not know."""

_ELEMENT = (BAND, CROSS_TRACK)


def _labelled(row: Variable, values: Any, dims: tuple[str, ...] | None = None) -> xr.Variable:
    values = np.asarray(values).astype(row.dtype)
    if dims is None:
        dims = next(d for d in (row.dims, *row.alternatives) if len(d) == values.ndim)
    return xr.Variable(dims, values, row.attrs)


def _scalar_or_step(values: Any) -> Any:
    """Return what does not change from step to step as one number."""
    return values[0] if np.all(values == values[0]) else values


def _is_one_dark(sweep: Sweep) -> bool:
    exposures = sweep.settings.dark_exposure_time
    return bool(np.all(exposures == exposures[0]))


def _small_variables(sweep: Sweep) -> dict[str, xr.Variable]:
    """Return all but the counts."""
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
    return {name: _labelled(SWEEP_VARIABLES[name], value) for name, value in values.items()}


def _attrs(sweep: Sweep) -> dict[str, Any]:
    return {
        "name": "simulated monochromator sweep",
        "monochromator_shape": sweep.settings.monochromator_shape,
        "history": f"simulated by hyperpaint, seed {sweep.settings.camera.seed}",
    }


def _step_wavelength(sweep: Sweep) -> xr.Variable:
    return _labelled(SWEEP_VARIABLES["step_wavelength"], sweep.settings.dial)


def sweep_truth(sweep: Sweep) -> xr.Dataset:
    """Return what the calibration of a sweep should find; names open with `TRUTH`."""
    settings, camera = sweep.settings, sweep.camera
    imager = camera.imager
    seen = np.where(camera.bad, np.nan, camera.response_area / imager.spacing[:, None])
    values: dict[str, Any] = {
        "radiance_gain": camera.radiance_gain(),
        "responsivity": seen,
        "wavelength": imager.wavelength,
        "wavelength_shift": imager.wavelength_shift,
        "fwhm": imager.band_fwhm,
        "dark_bias": camera.dark_bias,
        "dark_rate": camera.dark_rate,
        "electrons_per_count": camera.electrons_per_count,
        "read_noise": camera.read_noise,
    }
    made = {name: _labelled(VARIABLES[name], value) for name, value in values.items()}
    # of the gain every digit: a calibration is to be compared with it to 1e-3 and better
    made["radiance_gain"] = made["radiance_gain"].copy(data=values["radiance_gain"])
    made["step_wavelength"] = _labelled(SWEEP_VARIABLES["step_wavelength"], sweep.wavelength)
    made["bad"] = xr.Variable(_ELEMENT, camera.bad, {"long_name": "True at elements that see no light"})
    flux_attrs = {**SWEEP_VARIABLES["flux"].attrs, "long_name": "Radiant flux, as every column receives it"}
    made["flux"] = xr.Variable((STEP, CROSS_TRACK), sweep.power[:, None] * sweep.beam, flux_attrs)
    if settings.stray_light:
        made["stray_light"] = _labelled(VARIABLES["stray_light"], sweep.stray_matrix)
    return xr.Dataset(
        {f"{TRUTH}{name}": variable for name, variable in made.items()},
        attrs={f"{TRUTH}srf_shape": imager.shape},
    )


def sweep_dataset(sweep: Sweep) -> xr.Dataset:
    """Return a whole sweep in memory, with its truth."""
    settings, camera = sweep.settings, sweep.settings.camera
    shape = (settings.steps, camera.bands, camera.columns)
    counts = np.empty(shape, dtype=np.float32)
    variance = np.empty(shape, dtype=np.float32) if settings.variance else None
    for step in range(settings.steps):
        frames = sweep.frames(step)
        counts[step] = frames.mean
        if variance is not None:
            variance[step] = frames.variance
    if _is_one_dark(sweep):
        dark = sweep.dark(0).mean
    else:
        dark = np.stack([sweep.dark(step).mean for step in range(settings.steps)])
    cubes = {"counts": counts, "dark_counts": dark}
    if variance is not None:
        cubes["counts_variance"] = variance
    truth = sweep_truth(sweep)
    return xr.Dataset(
        {
            **{name: _labelled(SWEEP_VARIABLES[name], values) for name, values in cubes.items()},
            **_small_variables(sweep),
            **truth.data_vars,
        },
        coords={"step_wavelength": _step_wavelength(sweep)},
        attrs={**_attrs(sweep), **truth.attrs},
    )


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
        The store. Its truth goes into a store of its own beside it: ``sweep.zarr`` has ``sweep_truth.zarr``.
    steps, bands, columns, seed
        As for `hyperpaint.simulation.simulate_sweep`.
    truth
        Write the truth.
    overwrite
        Replace an earlier sweep.
    progress
        Called with steps done and steps to do.
    **effects
        As for `hyperpaint.simulation.simulate_sweep`.

    Returns
    -------
    ``path``.

    Raises
    ------
    SchemaError
        An effect is unknown or out of range; all are listed.
    StoreError
        There is something at the path already, and ``overwrite`` is not set.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = write_sweep(f"{folder}/sweep.zarr", steps=3, bands=8, columns=4)
    ...     dict(xr.open_zarr(path).counts.sizes)
    {'step': 3, 'band': 8, 'cross_track': 4}
    """
    values = {"steps": steps, "bands": bands, "columns": columns, "seed": seed, **effects}
    sweep = Sweep(SweepSettings.of(values))
    path = Path(path)
    for target in (path, _truth_beside(path)):
        _clear(target, overwrite)
    store_sweep(sweep, path, truth=truth, progress=progress)
    return path


def store_sweep(sweep: Sweep, path: Path, *, truth: bool = True, progress: Progress | None = None) -> None:
    """Write a sweep where nothing stands yet, and its truth beside it."""
    if truth:
        known = sweep_truth(sweep).assign_attrs(hyperpaint_format=FORMAT_VERSION)
        known.to_zarr(
            _truth_beside(path), mode="w", zarr_format=3, consolidated=False, encoding=blosc_encoding(known)
        )
        consolidate(_truth_beside(path))
    # xarray writes the small arrays; the cubes are filled step by step and never held whole
    head = xr.Dataset(
        _small_variables(sweep),
        coords={"step_wavelength": _step_wavelength(sweep)},
        attrs={"hyperpaint_format": FORMAT_VERSION, **_attrs(sweep)},
    )
    head.to_zarr(path, mode="w", zarr_format=3, consolidated=False, encoding=blosc_encoding(head))
    _write_cubes(sweep, path, progress)
    consolidate(path)


def _truth_beside(path: Path) -> Path:
    return path.with_name(f"{path.stem}_truth{path.suffix}")


def _clear(target: Path, overwrite: bool) -> None:
    if not target.exists():
        return
    # an earlier sweep is a Zarr store; anything else is not ours to remove
    if not overwrite or not (target / "zarr.json").is_file():
        mend = "name another path, or replace an earlier sweep with {}"
        found = f"{target} exists already"
        raise StoreError(found, mend=mend.format("overwrite=True"), option=mend.format("--overwrite"))
    shutil.rmtree(target)


def _write_cubes(sweep: Sweep, path: Path, progress: Progress | None) -> None:
    settings, camera = sweep.settings, sweep.settings.camera
    shape = (settings.steps, camera.bands, camera.columns)
    group = zarr.open_group(path, mode="r+")
    counts = _create(group, "counts", shape)
    variance = _create(group, "counts_variance", shape) if settings.variance else None
    one_dark = _is_one_dark(sweep)
    dark = _create(group, "dark_counts", shape[1:] if one_dark else shape)
    if one_dark:
        dark[...] = sweep.dark(0).mean
    for step in range(settings.steps):
        frames = sweep.frames(step)
        counts[step] = frames.mean
        if variance is not None:
            variance[step] = frames.variance
        if not one_dark:
            dark[step] = sweep.dark(step).mean
        if progress is not None:
            progress(step + 1, settings.steps)


def _create(group: zarr.Group, name: str, shape: tuple[int, ...]) -> Any:
    row = SWEEP_VARIABLES[name]
    dims = next(d for d in (row.dims, *row.alternatives) if len(d) == len(shape))
    return group.create_array(
        name,
        shape=shape,
        chunks=(1, *shape[1:]) if len(shape) == 3 else shape,
        dtype=row.dtype,
        compressors=[BloscCodec(typesize=4, cname="lz4", clevel=5, shuffle="bitshuffle")],
        fill_value=np.nan,
        dimension_names=dims,
        attributes=row.attrs,
        config={"write_empty_chunks": True},
    )
