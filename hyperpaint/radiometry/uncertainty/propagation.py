"""From what is known of the instrument's errors to the uncertainty of every reflectance, and of means.

Errors are of two kinds. Random ones are made afresh in every sample. Systematic ones are shared: by a flight,
or by the lines of a column, as the noise of the mean dark and of a calibration is, whatever it came from.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base import schema
from hyperpaint.base.arrays import Array, Floats
from hyperpaint.base.constants import QUANTISATION_VARIANCE_COUNT2
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.schema import ALONG_TRACK, CROSS_TRACK
from hyperpaint.base.units import takes_quantities
from hyperpaint.kernels.arguments import ErrorTerms
from hyperpaint.radiometry import slabs

__all__ = [
    "NONE_KNOWN", "UNCERTAINTIES", "effective_number", "error_terms", "mean_uncertainty",
    "uncertainty_inputs", "with_uncertainty",
]  # fmt: skip


_NOISE = ("electrons_per_count", "read_noise")
_SYSTEMATIC = (
    "dark_counts_u_random",
    "radiance_gain_u_random",
    "radiance_gain_u_systematic",
    "irradiance_u_systematic",
    "wavelength_u",
    "dark_counts_u_systematic",
    "linearity_u",
)
UNCERTAINTIES = ("reflectance_u_random", "reflectance_u_systematic")
NONE_KNOWN = "none known"
"""Attribute ``components`` of an uncertainty that nothing known enters: it is zero for want of knowledge."""
_ABSOLUTE = (
    "electrons_per_count",
    "read_noise",
    "wavelength_u",
    "dark_counts_u_random",
    "dark_counts_u_systematic",
)


def uncertainty_inputs(dataset: xr.Dataset, panel: float | None) -> dict[str, Any]:
    """Return what is known of a line's noise and systematic errors, by name; ``panel`` is a panel's [1].

    Raises
    ------
    SchemaError, UnitsError
        What noise follows from is missing, or has other dims or units; all problems are listed.
    """
    problems = Problems("cannot compute uncertainties of reflectance", SchemaError)
    if "counts" not in dataset.variables:
        problems.add("'counts' is missing: noise follows from counts, not from radiance alone")
    for name in _NOISE:
        if name not in dataset.variables:
            problems.add(
                f"{name!r} is missing: {schema.VARIABLES[name].meaning.lower()}; it comes with a "
                "calibration, or from line.assign(hp.estimate_noise(line))"
            )
    problems.raise_if_any()
    names = [name for name in (*_NOISE, *_SYSTEMATIC) if name in dataset.variables]
    arrays = schema.require(dataset, names, "uncertainties of reflectance")
    values = {name: slabs.small(array) for name, array in arrays.items()}
    return values if panel is None else {**values, "panel_u": panel}


def with_uncertainty(result: xr.Dataset, cubes: tuple[Any, ...], uncertain: dict[str, Any]) -> xr.Dataset:
    """Return the dataset with both uncertainties, in obsarray's terms.

    obsarray knows errors that are independent and errors that are common along a dim. What an element's gain
    and dark have of their own is common to all lines only; taken as common to all samples it is never
    underrated. `hyperpaint.radiometry.mean_uncertainty` takes each for what it is.
    """
    systematic = [name for name in _SYSTEMATIC if name in uncertain]
    if "panel_u" in uncertain:
        systematic = [
            n for n in systematic if n not in ("radiance_gain_u_systematic", "irradiance_u_systematic")
        ]
        systematic.append("panel")
    entered = {
        "reflectance_u_random": [name for name in _NOISE if name in uncertain],
        "reflectance_u_systematic": systematic,
    }
    for name, cube in zip(UNCERTAINTIES, cubes, strict=True):
        attrs = {
            "pdf_shape": "gaussian",
            "err_corr_1_dim": list(schema.CUBE),
            "err_corr_1_form": name.rpartition("_")[2],
            "err_corr_1_units": [],
            "err_corr_1_params": [],
            "components": ", ".join(entered[name]) or NONE_KNOWN,
        }
        result[name] = schema.label(xr.DataArray(cube, dims=schema.CUBE), name, **attrs)
    result["reflectance"].attrs["unc_comps"] = list(UNCERTAINTIES)
    return result


def error_terms(
    uncertain: Mapping[str, Any],
    cube: Mapping[str, Any],
    light: Mapping[str, Any] | None,
    dtype: str,
    bad: Array,
    masked: int = 0,
) -> ErrorTerms:
    """Return what the uncertainty of every sample follows from; what is not known is zero.

    ``uncertain`` is that of `uncertainty_inputs`; ``cube`` and ``light`` are the small variables of the line,
    by name; ``bad`` (band, column) are elements without a gain; ``masked`` is the number of elements whose
    mean is the pedestal of a line, and so has a noise that all of the line shares.

    Raises
    ------
    SchemaError
        Values that no uncertainty can have; all are listed.
    """
    _check_uncertainties(uncertain, bad)

    def of(name: str) -> Floats:
        return _rows(uncertain.get(name, 0.0), bad.shape)

    whole = np.issubdtype(np.dtype(dtype), np.integer)
    floor = of("read_noise") ** 2 + (QUANTISATION_VARIANCE_COUNT2 if whole else 0.0)
    own_dark = of("dark_counts_u_random") ** 2
    dark_variance = of("dark_counts_u_systematic") ** 2 + own_dark
    if masked:
        dark_variance = dark_variance + float(np.nanmean(floor + own_dark)) / masked
    squares = [of("radiance_gain_u_random") ** 2, of("linearity_u") ** 2]
    if "panel_u" in uncertain:
        # scaled to a panel, reflectance has the panel's uncertainty in place of what all elements share
        squares.append(of("panel_u") ** 2)
    else:
        squares += [of("radiance_gain_u_systematic") ** 2, _irradiance_u(uncertain, cube, light) ** 2]
    offset = np.sqrt(dark_variance)
    wavelength_u = np.broadcast_to(np.asarray(uncertain.get("wavelength_u", 0.0), np.float64), len(bad))
    slope = np.empty((0, 4), np.float32)
    if wavelength_u.any():
        steps = _band_steps(np.asarray(cube["wavelength"], np.float64))
        slope = (wavelength_u[:, None] * steps).astype(np.float32)
    elif not offset.any():
        offset = offset[:0]
    terms = (1.0 / of("electrons_per_count"), floor, np.sqrt(sum(squares[1:], squares[0])), offset)
    per_electron, noise, relative, dark = (np.ascontiguousarray(values, np.float32) for values in terms)
    return ErrorTerms(per_electron, noise, relative, dark, slope)


def _rows(values: Any, shape: tuple[int, ...]) -> Floats:
    """Return a value, one a band, or one an element as (1 or band, column)."""
    array = np.asarray(values, np.float64)
    if array.ndim == 1:
        array = array[:, None]
    return np.broadcast_to(array, shape if array.ndim else (1, shape[1]))


def _irradiance_u(
    uncertain: Mapping[str, Any], cube: Mapping[str, Any], light: Mapping[str, Any] | None
) -> Floats:
    """Return the relative uncertainty of the irradiance of every band (1 or band, 1)."""
    relative = np.asarray(uncertain.get("irradiance_u_systematic", 0.0), np.float64)
    if relative.ndim == 0 or light is None:
        return relative.reshape(1, 1)
    channels = np.asarray(light["irradiance_wavelength"], np.float64)
    order = np.argsort(channels, kind="stable")
    at = np.interp(np.asarray(cube["wavelength"]), channels[order], relative[order])
    return np.asarray(at[:, None])


def _band_steps(wavelength: Floats) -> Floats:
    """Return weights of the rise to the band above, and of that from the band below (band, 4) [nm-1].

    With both neighbours they give the slope between these, with one that to it. A neighbour across a join of
    two detectors, where wavelengths turn back, stand still or leap, is none.
    """
    step = np.diff(wavelength)
    usual = np.median(step) if step.size else 1.0
    with np.errstate(divide="ignore", invalid="ignore"):
        joined = (step / usual > 0.0) & (step / usual < 3.0)
        alone = np.where(joined, 1.0 / step, 0.0)
    up, down = np.append(alone, 0.0), np.insert(alone, 0, 0.0)
    both = np.zeros_like(wavelength)
    inside = (up != 0.0) & (down != 0.0)
    both[inside] = 1.0 / (1.0 / up[inside] + 1.0 / down[inside])
    return np.stack([np.where(inside, both, up), up, np.where(inside, both, down), down], axis=1)


def _check_uncertainties(uncertain: Mapping[str, Any], bad: Array) -> None:
    """Refuse what no uncertainty can be; NaN is not known, and gives NaN."""
    problems = Problems("uncertainties cannot be computed", SchemaError)
    for name, value in uncertain.items():
        array = np.asarray(value, np.float64)
        used = array[~bad] if array.shape == bad.shape else array
        used = used[~np.isnan(used)]
        if used.size == 0:
            problems.add(f"{name!r} holds no value")
            continue
        positive = name == "electrons_per_count"
        if not np.isfinite(used).all() or used.min() < 0 or (positive and used.min() == 0):
            wanted = "positive" if positive else "0 or more"
            problems.add(f"{name!r} must be finite and {wanted}, found {used.min():g} to {used.max():g}")
        elif name not in _ABSOLUTE and used.max() > 1.0:
            problems.add(
                f"{name!r} is {used.max():g}; it is relative, expected a fraction of 1, such as 0.02"
            )
    problems.raise_if_any()


# --- means over pixels: what is random averages out, what is common does not


@takes_quantities()
def mean_uncertainty(region: xr.Dataset, dims: Sequence[str] | str | None = None) -> xr.Dataset:
    r"""Mean reflectance over pixels, and how sure it is.

    Eager: reads the region.

    Parameters
    ----------
    region
        ``reflectance``, ``reflectance_u_random`` and ``reflectance_u_systematic``, as
        ``.paint.reflectance(uncertainty=True)`` adds them, cut to the pixels of interest; NaN where one is
        not.
    dims
        What is averaged; by default along_track and cross_track. They must be next to each other in space, in
        order: the distance of pixels counts.

    Returns
    -------
    Dataset
        On the other dims (mostly band): ``mean`` [1], ``n`` pixels, ``n_eff`` of them independent,
        ``u_random`` and ``u_systematic`` [1], float64 and int64. The attribute ``components`` of both says
        what entered. ``u_systematic`` is NaN where that is "none known", which is not to say that there is no
        such error.

    Raises
    ------
    SchemaError
        A variable or a dim is missing.

    Notes
    -----
    .. math:: u_r = \sqrt{\overline{u_{r,i}^2} / n_{eff}}, \qquad u_s = \overline{u_{s,i}}, \qquad
              n_{eff} = n^2 \Big/ \sum_{ij} c_{ij}

    with :math:`c_{ij}` the autocorrelation of the pixels at their distance, summed from the centre outwards
    until it is not above zero. A surface's texture counts as correlated noise in it: the region should be
    homogeneous, since a gradient over it leaves few independent pixels. A common error is common to the mean
    as well: only the random part shrinks. What is here is how sure the mean of *these* pixels is, not how far
    another part of the surface may differ.

    Examples
    --------
    >>> import xarray as xr
    >>> rng = np.random.default_rng(0)
    >>> pixels = ("along_track", "cross_track")
    >>> region = xr.Dataset({
    ...     "reflectance": (pixels, rng.normal(0.3, 0.01, (20, 30))),
    ...     "reflectance_u_random": (pixels, np.full((20, 30), 0.01)),
    ...     "reflectance_u_systematic": (pixels, np.full((20, 30), 0.006))})
    >>> mean = mean_uncertainty(region)
    >>> print(int(mean.n), f"{float(mean.u_random):.4f} {float(mean.u_systematic):.4f}")
    600 0.0004 0.0060
    """
    over = [dims] if isinstance(dims, str) else list(dims or (ALONG_TRACK, CROSS_TRACK))
    names = ("reflectance", *UNCERTAINTIES)
    problems = Problems("a mean with its uncertainty cannot be computed", SchemaError)
    for name in (name for name in names if name not in region.variables):
        problems.add(f"{name!r} is missing; make it with .paint.reflectance(uncertainty=True)")
    for dim in over:
        if dim not in region.dims:
            problems.add(f"{dim!r} is no dim of the region, which has {', '.join(map(str, region.dims))}")
    problems.raise_if_any()
    rest = [dim for dim in region["reflectance"].dims if dim not in over]
    cubes = [region[name].transpose(*rest, *over).values.astype(np.float64) for name in names]
    shape = cubes[0].shape[: len(rest)]
    value, random, systematic = (cube.reshape(-1, *cube.shape[len(rest) :]) for cube in cubes)
    pixels = tuple(range(1, value.ndim))
    there = np.isfinite(value)
    n = there.sum(axis=pixels)
    divisor = np.where(n > 0, n, np.nan)
    mean, square, common = (
        np.where(there, cube, 0.0).sum(axis=pixels) / divisor for cube in (value, random**2, systematic)
    )
    if _nothing_known(region[names[2]], systematic):
        common = np.full_like(common, np.nan)
    effective = np.array([effective_number(plane) for plane in value])
    estimates = {
        "mean": (mean, "Mean reflectance"),
        "n": (n, "Pixels"),
        "n_eff": (effective, "Independent pixels"),
        "u_random": (np.sqrt(square / np.where(n > 0, effective, np.nan)), "Random uncertainty of the mean"),
        "u_systematic": (common, "Systematic uncertainty of the mean"),
    }
    coords = {name: c for name, c in region["reflectance"].coords.items() if set(c.dims) <= set(rest)}
    result = xr.Dataset(
        {
            k: (rest, v.reshape(shape), {"units": "1", "long_name": text})
            for k, (v, text) in estimates.items()
        },
        coords,
    )
    for name, source in zip(("u_random", "u_systematic"), names[1:], strict=True):
        if "components" in region[source].attrs:
            result[name].attrs["components"] = region[source].attrs["components"]
    return result


def _nothing_known(array: xr.DataArray, values: Floats) -> bool:
    """Return whether no component of the uncertainty is known; its cube is then zero throughout.

    Arithmetic of xarray may have dropped the attribute, so that the zeros are asked as well.
    """
    return array.attrs.get("components") == NONE_KNOWN or not np.nan_to_num(values).any()


def effective_number(plane: Floats) -> float:
    """Return how many independent values are as good as these, which lie on a grid; NaN are left out."""
    there = np.isfinite(plane)
    n = int(there.sum())
    if n < 3:
        return float(n)
    departure = np.where(there, plane - plane[there].mean(), 0.0)
    if not departure.any():
        return float(n)
    size, axes = [2 * length for length in plane.shape], range(plane.ndim)

    def correlate(values: Floats) -> Floats:
        power = np.abs(np.fft.rfftn(values, size, axes)) ** 2
        return np.asarray(np.fft.irfftn(power, size, axes))

    pairs, products = np.rint(correlate(there.astype(np.float64))), correlate(departure)
    places = [np.minimum(np.arange(length), length - np.arange(length)) for length in size]
    ring = np.zeros(size, np.int64)
    for axis, place in enumerate(places):
        ring = np.maximum(ring, place.reshape([-1 if a == axis else 1 for a in range(plane.ndim)]))
    count = np.bincount(ring.ravel(), pairs.ravel())
    total = np.bincount(ring.ravel(), products.ravel()) / (products.flat[0] / n)
    # a mean that was subtracted leaves -1/n in every pair
    correlation = (total + count / n) / np.maximum(count, 1.0)
    # every pair is counted from either end
    correlated = (correlation > 2.0 / np.sqrt(np.maximum(count / 2.0, 1.0))) & (count > 0)
    correlated[0] = True
    reach = int(np.argmin(correlated)) if not correlated.all() else correlated.size
    excess = float((correlation[1:reach] * count[1:reach]).sum()) / n
    return float(np.clip(n / (1.0 + excess), 1.0, n))
