"""Calibration stores (`radiance_gain` and spectral axis of an imager), and the lab sweeps behind them."""

from __future__ import annotations

import functools
import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.constants import MAX_STRAY_LIGHT_U
from hyperpaint.base.errors import FormatError, PaintWarning, Problems, SchemaError, UnitsError
from hyperpaint.base.input_files import input_path
from hyperpaint.base.schema import (
    BAND,
    CROSS_TRACK,
    SRF_SHAPES,
    STEP,
    SWEEP_VARIABLES,
    VARIABLES,
    dtype_of,
    label,
)
from hyperpaint.base.units import convert
from hyperpaint.io.files.reading import load_netcdf
from hyperpaint.io.store import list_groups, load_group, open_unverified
from hyperpaint.io.store.reader import is_zarr

_ELEMENT = (BAND, CROSS_TRACK)
#: Variables of the table that a calibration may hold, those it must hold first.
_REQUIRED = ("radiance_gain", "wavelength", "fwhm")
_OPTIONAL = (
    "wavelength_shift",
    "band_spacing",
    "good",
    "dark_counts",
    "dark_exposure_time",
    "saturation_count",
    "electrons_per_count",
    "read_noise",
    "look_angle",
    "masked",
)
#: Further variables of a lab calibration; only their units and dims are checked.
_OF_A_SWEEP = (
    "radiance_gain_u_random",
    "radiance_gain_u_systematic",
    "wavelength_u",
    "irradiance_u_systematic",
    "dark_bias",
    "dark_rate",
    "flat_field",
    "responsivity",
    "quantum_efficiency",
    "linearity_counts",
    "linear_counts",
    "linearity_u",
    "stray_light",
    "stray_light_u",
    "band_shift_time",
    "step_wavelength",
    "line_band",
    "line_centre",
    "line_fwhm",
    "line_own_fwhm",
    "line_amplitude",
    "line_area",
    "line_covariance",
    "line_trusted",
    "beam_centre",
    "beam_fwhm",
    "out_of_band",
    "second_order",
)
_TABULATED = ("srf_offset", "srf")
_MAX_MAGNITUDES = {"wavelength_shift": (100.0, "nm"), "look_angle": (90.0, "degrees")}


def open_calibration(source: Any, *, group: str | None = None) -> xr.Dataset:
    """Open a calibration and check it.

    Parameters
    ----------
    source
        A Zarr store (folder, zip file, URL or store object of zarr) or netCDF file with ``radiance_gain``
        (band, cross_track), ``wavelength`` (band) and ``fwhm`` (band) at its root, all with units; or such a
        Dataset.
    group
        Group of the store that holds them; by default the root, or ``calibration`` where the root is a
        collect.

    Returns
    -------
    xarray.Dataset
        In memory, in the units, dims and dtypes of `hyperpaint.base.schema`; attribute ``srf_shape``.
        Elements with a NaN gain are bad. Other variables on ``band`` and ``cross_track`` are kept.

    Raises
    ------
    FormatError
        The store cannot be read, or is not what its manifest names.
    SchemaError
        Variables, units or values are missing or impossible; all problems are listed.

    Warns
    -----
    PaintWarning
        The line shape is not given, and taken to be Gaussian.

    Examples
    --------
    >>> import xarray as xr
    >>> gain = xr.DataArray([[1e-8, 1e-8]], dims=("band", "cross_track"))
    >>> gain.attrs["units"] = "uW cm-2 sr-1 nm-1 s count-1"
    >>> nm = {"units": "nm"}
    >>> made = open_calibration(xr.Dataset(
    ...     {"radiance_gain": gain},
    ...     {"wavelength": ("band", [550.0], nm), "fwhm": ("band", [6.0], nm)},
    ...     {"srf_shape": "slit"}))
    >>> float(made.radiance_gain[0, 0]), made.radiance_gain.units
    (1.00...e-10, 'W m-2 sr-1 nm-1 s count-1')
    """
    if isinstance(source, xr.Dataset):
        return check_calibration(source)

    def load(source: Any, group: str | None) -> xr.Dataset:
        groups = {} if group is not None else {"", "calibration"}.intersection(list_groups(source))
        return load_group(source, "calibration" if groups == {"calibration"} else group)

    return check_calibration(_read(source, group, "calibration", load), str(source))


def _read(
    source: Any, group: str | None, kind: str, open_zarr: Callable[[Any, str | None], xr.Dataset]
) -> xr.Dataset:
    # Open any Zarr, or load a netCDF file.
    zarr = is_zarr(source)
    is_path = isinstance(source, str | os.PathLike) and "://" not in os.fspath(source)
    if is_path and not input_path(Path(source), f"a {kind} in a Zarr store or netCDF file").exists():
        raise FormatError(
            f"{source}: no such {kind}", expected="a Zarr store or a netCDF file", code="file-not-found"
        )
    try:
        return open_zarr(source, group) if zarr else load_netcdf(Path(source), group)
    except Exception as error:  # numpy and the netCDF engines each have their own
        hint = "" if zarr else "install for netCDF-4: python -m pip install h5netcdf"
        raise FormatError(
            f"{source}: not a readable Zarr store or netCDF file ({type(error).__name__}: {error!s:.200})",
            mend=hint,
            code="file-unreadable",
        ) from error


def check_calibration(dataset: xr.Dataset, subject: str = "this Dataset") -> xr.Dataset:
    """Return a calibration in the units, dims and dtypes of the table of variables, with all faults listed.

    ``dataset``: see `open_calibration`; ``subject``: names it in messages.

    Raises `SchemaError`: Variables, units or values are missing or impossible; all problems are listed.

    Warns `PaintWarning`: The line shape is not given, and taken to be Gaussian.
    """
    problems = Problems(f"{subject} cannot be used as calibration", SchemaError)
    shape = dataset.attrs.get("srf_shape")
    wanted = [*_REQUIRED, *(name for name in (*_OPTIONAL, *_OF_A_SWEEP) if name in dataset.variables)]
    if shape == "tabulated" or "srf" in dataset.variables:
        wanted += _TABULATED
    arrays: dict[str, xr.DataArray] = {}
    for name in wanted:
        try:
            arrays[name] = _variable(dataset, name)
        except (SchemaError, UnitsError) as error:
            problems.add_error("", error)
    for name, array in arrays.items():
        finite = bool(np.isfinite(array.values).all())
        if name == "radiance_gain":
            gains = array.values[~np.isnan(array.values)]
            bad = int((~np.isfinite(gains) | (gains <= 0)).sum())
            if not gains.size:
                problems.add(
                    "'radiance_gain' is NaN everywhere",
                    expected="a gain for the elements that are not bad",
                    code="not-finite",
                )
            elif bad:
                problems.add(
                    f"'radiance_gain' is zero, negative or infinite in {bad} elements",
                    expected="positive gains, and NaN for bad elements",
                    code="value-out-of-range",
                )
        elif name in ("wavelength", "fwhm", "band_spacing", "saturation_count", "electrons_per_count"):
            if not (finite and (array.values > 0).all()):
                problems.add(f"{name!r} is not finite and positive everywhere", code="value-out-of-range")
        elif name in _MAX_MAGNITUDES:
            largest, unit = _MAX_MAGNITUDES[name]
            if not (finite and (np.abs(array.values) < largest).all()):
                problems.add(
                    f"{name!r} is not finite and below {largest:g} {unit} everywhere",
                    code="value-out-of-range",
                )
        elif name.startswith("radiance_gain_u_") or name in ("wavelength_u", "irradiance_u_systematic"):
            if (array.values < 0).any():
                problems.add(
                    f"{name!r} is negative in places",
                    expected="a standard uncertainty",
                    code="value-out-of-range",
                )
        elif name in ("read_noise", "srf"):
            levels = array.values[~np.isnan(array.values)] if name == "read_noise" else array.values
            if not (np.isfinite(levels).all() and (levels >= 0).all()):
                problems.add(
                    f"{name!r} is not finite and at least zero everywhere", code="value-out-of-range"
                )
        elif name == "srf_offset" and not (finite and (np.diff(array.values) > 0).all()):
            problems.add("'srf_offset' does not increase strictly", code="axis-unordered")
    if shape is not None and shape not in SRF_SHAPES:
        problems.add(
            f"attribute srf_shape {shape!r}",
            expected=f"one of {', '.join(SRF_SHAPES)}",
            code="choice-unknown",
        )
    sizes = {name: size for name, size in dataset.sizes.items() if name in _ELEMENT}
    if any(size == 0 for size in sizes.values()):
        problems.add(f"sizes {sizes}", expected="at least one element", code="empty-input")
    problems.raise_if_any()
    if shape is None:
        shape = "gaussian"
        warnings.warn(
            PaintWarning(
                f"{subject}: no attribute srf_shape; a Gaussian line shape is assumed",
                code="srf-shape-missing",
            ),
            stacklevel=2,
        )
    for other, array in dataset.data_vars.items():
        in_table = str(other) in VARIABLES
        if not in_table and array.ndim and set(array.dims) <= set(_ELEMENT) and array.dtype.kind in "fiu":
            arrays[str(other)] = array
    coords = {
        name: arrays.pop(name) for name in list(arrays) if name in VARIABLES and VARIABLES[name].coordinate
    }
    return xr.Dataset(arrays, coords, {**dataset.attrs, "srf_shape": shape})


def _variable(dataset: xr.Dataset, name: str) -> xr.DataArray:
    # A variable in the units, dims and dtype of the table, without coordinates.
    spec = VARIABLES[name]
    if name not in dataset.variables:
        raise SchemaError(
            f"{name!r} is missing",
            expected=f"{spec.meaning.lower()} ({', '.join(spec.dims)}) [{spec.units}]",
            code="variable-missing",
        )
    array = dataset[name].reset_coords(drop=True)
    allowed = [dims for dims in (spec.dims, *spec.alternatives) if set(dims) == set(array.dims)]
    if not allowed:
        expected = " or ".join(f"({', '.join(dims)})" for dims in (spec.dims, *spec.alternatives))
        raise SchemaError(
            f"{name!r} has dims ({', '.join(map(str, array.dims))})",
            expected=expected,
            code="dims-wrong",
        )
    kinds = "biu" if spec.dtype == "bool" else "fiu"
    if array.dtype.kind not in kinds:
        raise SchemaError(f"{name!r} has dtype {array.dtype}", expected=spec.dtype, code="type-wrong")
    array = array.transpose(*allowed[0])
    if spec.units and spec.units != "1":
        # float64 until the factor is in, rounded once
        array = convert(array.astype(np.float64), spec.units, name)
    return label(array.astype(dtype_of(name)), name)


def calibration_parts(calibration: xr.Dataset | None, is_counts: bool) -> dict[str, xr.DataArray]:
    """Return the variables of a calibration that a line keeps; for radiance, line shape and look angles."""
    if calibration is None:
        return {}
    dropped = {
        "dark_counts",
        "dark_exposure_time",
        "dark_bias",
        "dark_rate",
        "flat_field",  # in the gain already
        "responsivity",
        "saturation_count",
    }
    # the lines of a lab sweep stay with the calibration
    dims_of_line = {
        BAND,
        CROSS_TRACK,
        "srf_offset",
        "irradiance_wavelength",
        "linearity_counts",
        "source_band",
    }
    names = [
        str(name)
        for name, array in calibration.data_vars.items()
        if name not in dropped and set(array.dims) <= dims_of_line
    ]
    if float(calibration.get("stray_light_u", 0.0)) >= MAX_STRAY_LIGHT_U:
        names = [name for name in names if not name.startswith("stray_light")]
    if not is_counts:
        names = [name for name in names if name in ("srf", "look_angle")]
    return {name: calibration[name].reset_coords(drop=True) for name in names}


def scale_attrs(calibration: xr.Dataset | None) -> dict[str, Any]:
    """Return the attributes on linearity and absolute scale, for which the gain holds."""
    names = ("linearity", "linearity_on", "absolute_scale")
    return {} if calibration is None else {k: calibration.attrs[k] for k in names if k in calibration.attrs}


def open_sweep(path: Any, *, group: str | None = None) -> xr.Dataset:
    """Open a lab sweep, lazily from a Zarr store; its content is checked at calibration.

    Parameters
    ----------
    path
        A Zarr store, as of `open_calibration`, or netCDF file with the rows of
        `hyperpaint.base.schema.SWEEP_VARIABLES`.
    group
        Group of the store that holds them; by default the root.

    Returns
    -------
    xarray.Dataset
        Variables of the table; others, such as the truth of a simulated sweep, are left behind.

    Raises
    ------
    FormatError
        It cannot be read, or holds no counts of steps.
    """
    # counts change from step to step only along one dim: a chunk of steps is all that is in memory
    opened = _read(path, group, "sweep", functools.partial(open_unverified, chunks={}))
    if "counts" not in opened.variables or STEP not in opened["counts"].dims:
        held = ", ".join(sorted(map(str, opened.variables))[:8]) or "nothing"
        raise FormatError(
            f"{path}: holds {held}",
            expected="a lab sweep with 'counts' (step, band, cross_track)",
            code="counts-missing",
        )
    names = [name for name in SWEEP_VARIABLES if name in opened.variables]
    return opened[names].reset_coords(drop=True) if not set(names) & set(opened.coords) else opened[names]


def saturation_of(
    saturation_count: float | None, bit_depth: int, calibration: xr.Dataset | None
) -> xr.DataArray:
    """Return ``saturation_count``: the argument, else the calibration's, else the converter's last count.

    Raises `SchemaError`: The count or the converter's bits are out of range.
    """
    if saturation_count is None and calibration is not None and "saturation_count" in calibration:
        return calibration["saturation_count"].reset_coords(drop=True)
    if saturation_count is None:
        if not 1 <= bit_depth <= 16:
            raise SchemaError(f"bit_depth {bit_depth}", expected="1 to 16", code="value-out-of-range")
        saturation_count = 2**bit_depth - 1
    if not 0 < saturation_count <= 65535:
        raise SchemaError(
            f"saturation_count {saturation_count}", expected="a count up to 65535", code="value-out-of-range"
        )
    return label(xr.DataArray(np.float32(saturation_count)), "saturation_count")
