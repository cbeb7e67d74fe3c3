"""A simulated sweep as labelled arrays: the instrument's part, and the truth beside it."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
import zarr

from hyperpaint.base.arrays import Progress
from hyperpaint.base.errors import StoreError
from hyperpaint.base.schema import BAND, CROSS_TRACK, FORMAT_VERSION, STEP, SWEEP_VARIABLES, VARIABLES

from .stores import consolidate, create_array, labelled, write_small
from .sweep import Sweep, SweepSettings

__all__ = ["simulate_sweep", "store_sweep", "write_sweep"]

TRUTH = "true_"
"""Opens the names of what a real sweep would not know."""

_ELEMENT = (BAND, CROSS_TRACK)


def _scalar_or_step(values: Any) -> Any:
    """Return what does not change from step to step as one number."""
    return values[0] if np.all(values == values[0]) else values


def _is_one_dark(sweep: Sweep) -> bool:
    exposures = sweep.settings.dark_exposure_time
    return bool(np.all(exposures == exposures[0]))


def _without_cubes(sweep: Sweep) -> xr.Dataset:
    """Return all of a sweep but its counts."""
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
    attrs = {
        "name": "simulated monochromator sweep",
        "monochromator_shape": settings.monochromator_shape,
        "history": f"simulated by hyperpaint, seed {settings.camera.seed}",
    }
    return xr.Dataset(
        {name: labelled(SWEEP_VARIABLES[name], value) for name, value in values.items()},
        {"step_wavelength": labelled(SWEEP_VARIABLES["step_wavelength"], settings.dial)},
        attrs,
    )


def sweep_truth(sweep: Sweep) -> xr.Dataset:
    """Return what the calibration of a sweep should find; names open with `TRUTH`."""
    settings, camera = sweep.settings, sweep.camera
    imager = camera.imager
    seen = np.where(camera.bad, np.nan, camera.response_area / imager.spacing[:, None])
    values: dict[str, Any] = {
        "radiance_gain": camera.radiance_gain(), "responsivity": seen, "wavelength": imager.wavelength,
        "wavelength_shift": imager.wavelength_shift, "fwhm": imager.band_fwhm, "dark_bias": camera.dark_bias,
        "dark_rate": camera.dark_rate, "electrons_per_count": camera.electrons_per_count,
        "read_noise": camera.read_noise,
    }  # fmt: skip
    variables = {name: labelled(VARIABLES[name], value) for name, value in values.items()}
    # of the gain every digit: a calibration is to be compared with it to 1e-3 and better
    variables["radiance_gain"] = variables["radiance_gain"].copy(data=values["radiance_gain"])
    variables["step_wavelength"] = labelled(SWEEP_VARIABLES["step_wavelength"], sweep.wavelength)
    variables["bad"] = xr.Variable(_ELEMENT, camera.bad, {"long_name": "True at elements that see no light"})
    flux_attrs = {**SWEEP_VARIABLES["flux"].attrs, "long_name": "Radiant flux, as every column receives it"}
    variables["flux"] = xr.Variable((STEP, CROSS_TRACK), sweep.power[:, None] * sweep.beam, flux_attrs)
    if settings.stray_light:
        variables["stray_light"] = labelled(VARIABLES["stray_light"], sweep.stray_matrix)
    return xr.Dataset(
        {f"{TRUTH}{name}": variable for name, variable in variables.items()},
        attrs={f"{TRUTH}srf_shape": imager.shape},
    )


def simulate_sweep(
    *, steps: int = 61, bands: int = 272, columns: int = 640, seed: int = 0, **effects: Any
) -> xr.Dataset:
    """Simulate a monochromator sweep in memory, with its truth.

    Parameters
    ----------
    steps
        Wavelengths of the sweep, from ``first_step_nm`` to ``last_step_nm``.
    bands, columns, seed
        Of the camera. A collect with equal settings is flown with the same camera.
    **effects
        Fields of `hyperpaint.simulation.SweepSettings`: ``monochromator_fwhm_nm``, ``stray_light`` ...; and,
        of the camera, those of `hyperpaint.simulation.SimulationSettings`: ``smile_nm``, ``srf_shape``,
        ``noise`` ... ``quantise=False`` leaves counts that are not whole.

    Returns
    -------
    The sweep as the store holds one: ``counts`` (step, band, cross_track), float32 mean of the frames with
    the dark still in them, ``counts_variance``, ``dark_counts``, ``flux`` ... Beside it the truth, each
    variable named ``true_``: ``true_radiance_gain``, ``true_wavelength``, ``true_wavelength_shift``,
    ``true_fwhm``, ``true_responsivity``, ``true_dark_bias``, ``true_dark_rate``, ``true_bad`` ...

    Raises
    ------
    SchemaError
        An effect is unknown or out of range; all are listed.

    Examples
    --------
    The light of a line, summed over its bands, gives the responsivity where it falls.

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
    line, truth = _without_cubes(sweep), sweep_truth(sweep)
    line = line.assign({name: labelled(SWEEP_VARIABLES[name], values) for name, values in cubes.items()})
    return line.assign(truth.data_vars).assign_attrs(truth.attrs)


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
        write_small(sweep_truth(sweep).assign_attrs(hyperpaint_format=FORMAT_VERSION), _truth_beside(path))
        consolidate(_truth_beside(path))
    # xarray writes the small arrays; the cubes are filled step by step and never held whole
    head = _without_cubes(sweep)
    write_small(head.assign_attrs({"hyperpaint_format": FORMAT_VERSION, **head.attrs}), path)
    group, cubes = zarr.open_group(path, mode="r+"), {}
    for name, shape in _shapes(sweep).items():
        row = SWEEP_VARIABLES[name]
        dims = next(d for d in (row.dims, *row.alternatives) if len(d) == len(shape))
        # a step a chunk; one dark for all steps is one chunk
        length = 1 if len(shape) == 3 else shape[0]
        cubes[name] = create_array(
            group, name, shape, dims=dims, dtype=row.dtype, attrs=row.attrs, chunk_length=length
        )
    _fill(sweep, cubes, progress)
    consolidate(path)


def _truth_beside(path: Path) -> Path:
    return path.with_name(f"{path.stem}_truth{path.suffix}")


def _clear(target: Path, overwrite: bool) -> None:
    if not target.exists():
        return
    # an earlier sweep is a Zarr store; anything else is not ours to remove
    if not overwrite or not (target / "zarr.json").is_file():
        mend = "name another path, or replace an earlier sweep with {}"
        raise StoreError(
            f"{target} exists already",
            mend=mend.format("overwrite=True"), option=mend.format("--overwrite"),
        )  # fmt: skip
    shutil.rmtree(target)


def _shapes(sweep: Sweep) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the cubes of a sweep, by name."""
    settings, camera = sweep.settings, sweep.settings.camera
    shape = (settings.steps, camera.bands, camera.columns)
    shapes: dict[str, tuple[int, ...]] = {
        "counts": shape, "dark_counts": shape[1:] if _is_one_dark(sweep) else shape
    }  # fmt: skip
    return {**shapes, "counts_variance": shape} if settings.variance else shapes


def _fill(sweep: Sweep, cubes: Mapping[str, Any], progress: Progress | None = None) -> None:
    """Write the frames of every step into arrays of `_shapes`."""
    one_dark = _is_one_dark(sweep)
    if one_dark:
        cubes["dark_counts"][...] = sweep.dark(0).mean
    for step in range(sweep.settings.steps):
        frames = sweep.frames(step)
        cubes["counts"][step] = frames.mean
        if "counts_variance" in cubes:
            cubes["counts_variance"][step] = frames.variance
        if not one_dark:
            cubes["dark_counts"][step] = sweep.dark(step).mean
        if progress is not None:
            progress(step + 1, sweep.settings.steps)
