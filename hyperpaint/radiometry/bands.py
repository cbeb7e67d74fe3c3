"""Choosing bands by wavelength, and bringing every column to the nominal wavelengths."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from hyperpaint.base import schema
from hyperpaint.base.arrays import Array
from hyperpaint.base.errors import SchemaError
from hyperpaint.light.responses import band_spacing

from .slabs import line_chunked

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["at", "to_nominal"]


def at(dataset: xr.Dataset, wavelength: npt.ArrayLike) -> xr.Dataset:
    """Return the bands nearest to one or several wavelengths.

    Serves axes that are not sorted, as at the joins of detectors, where an index cannot.

    Parameters
    ----------
    dataset
        Has a coordinate ``wavelength`` (band) [nm].
    wavelength
        A number, which drops the dim ``band``, or several [nm].

    Raises
    ------
    SchemaError
        A wavelength lies more than one band spacing outside the bands.

    Examples
    --------
    >>> import xarray as xr
    >>> cube = xr.Dataset(coords={"wavelength": ("band", [550.0, 552.0, 551.0], {"units": "nm"})})
    >>> float(at(cube, 551.2).wavelength)
    551.0
    """
    dataset = schema.rename_to_roles(dataset)
    centres = schema.require(dataset, ["wavelength"], "the bands at a wavelength")["wavelength"].values
    wanted = np.asarray(wavelength, np.float64)
    nearest = np.abs(centres - wanted[..., None]).argmin(axis=-1)
    away = np.abs(centres[nearest] - wanted)
    if (away > band_spacing(np.sort(centres)).max()).any() or not np.isfinite(wanted).all():
        worst = np.atleast_1d(wanted)[np.atleast_1d(away).argmax()]
        raise SchemaError(
            f"no band at {worst:g} nm; bands reach from {centres.min():g} to {centres.max():g} nm"
        )
    return dataset.isel({schema.BAND: nearest.item() if nearest.ndim == 0 else nearest})


def to_nominal(dataset: xr.Dataset) -> xr.Dataset:
    """Return spectra at the nominal wavelengths: the smile taken out.

    Lazy: one task a slab of lines; only the wavelengths and their shifts are read.

    Parameters
    ----------
    dataset
        ``radiance`` or ``reflectance`` with ``wavelength`` (band) and ``wavelength_shift`` (cross_track) or
        (band, cross_track) [nm].

    Returns
    -------
    Dataset
        ``radiance``, ``reflectance`` and what does not depend on wavelength; counts and calibration, which
        hold for the columns' own wavelengths, are left out, and so is ``wavelength_shift``.

    Raises
    ------
    SchemaError
        There is no radiance or reflectance, or no wavelength; every problem is listed.

    Notes
    -----
    Cubic (Lagrange) over the four nearest bands. Nothing is extrapolated: the outermost bands are NaN in
    columns that do not reach the nominal wavelength, and so is a value one of whose four bands is missing.
    """
    import xarray as xr

    dataset = schema.rename_to_roles(dataset)
    products = [name for name in ("radiance", "reflectance") if name in dataset.variables]
    if not products:
        raise SchemaError(
            "neither 'radiance' nor 'reflectance' to bring to nominal wavelengths; compute one first"
        )
    if "wavelength_shift" not in dataset.variables:
        return dataset[[*products, *_without_bands(dataset)]]
    found = schema.require(dataset, ["wavelength", "wavelength_shift", *products], "nominal wavelengths")
    shift = found["wavelength_shift"].values
    first, weights = _lagrange_weights(found["wavelength"].values, np.atleast_2d(shift))
    made = dataset[_without_bands(dataset)].drop_vars("wavelength_shift", errors="ignore")
    for name in products:
        cube = line_chunked(found[name])
        flat = xr.apply_ufunc(
            _resample,
            cube,
            kwargs={"first": first, "weights": weights},
            input_core_dims=[[schema.BAND, schema.CROSS_TRACK]],
            output_core_dims=[[schema.BAND, schema.CROSS_TRACK]],
            dask="parallelized",
            output_dtypes=[np.float32],
        ).drop_vars("wavelength_shift", errors="ignore")
        made[name] = schema.label(flat, name, spectral_axis="nominal wavelengths")
    return made


def _without_bands(dataset: xr.Dataset) -> list[str]:
    return [str(name) for name, array in dataset.data_vars.items() if schema.BAND not in array.dims]


def _resample(values: Array, *, first: Array, weights: Array) -> Array:
    from hyperpaint.kernels.resampling import resample_slab

    out = np.empty(values.shape, np.float32)
    resample_slab(np.ascontiguousarray(values, np.float32), first, weights, out)
    return out


def _lagrange_weights(wavelength: Array, shift: Array) -> tuple[Array, Array]:
    """Return the first of four bands and their weights, (band, column[, 4])."""
    bands, columns = wavelength.size, shift.shape[1]
    if bands < 4:
        raise SchemaError(f"{bands} bands are too few to interpolate between; four are needed")
    own = wavelength[:, None] + np.broadcast_to(shift, (bands, columns))
    descending = wavelength[0] > wavelength[-1]
    axis = own[::-1] if descending else own
    if not (np.diff(axis, axis=0) > 0).all():
        raise SchemaError(
            "wavelengths must be in order to interpolate between bands; split the cube at detector joins"
        )
    wanted = wavelength[::-1] if descending else wavelength
    first = np.empty((bands, columns), np.int64)
    weights = np.empty((bands, columns, 4))
    for column in range(columns):
        nodes = axis[:, column]
        start = np.clip(np.searchsorted(nodes, wanted, side="right") - 2, 0, bands - 4)
        taps = nodes[start[:, None] + np.arange(4)]
        for k in range(4):
            others = [j for j in range(4) if j != k]
            weights[:, column, k] = np.prod(
                (wanted[:, None] - taps[:, others]) / (taps[:, [k]] - taps[:, others]), axis=1
            )
        first[:, column] = start
        weights[(wanted < nodes[0]) | (wanted > nodes[-1]), column] = np.nan
    if descending:
        first, weights = bands - 4 - first[::-1], weights[::-1, :, ::-1]
    return np.ascontiguousarray(first), np.ascontiguousarray(weights, np.float32)
