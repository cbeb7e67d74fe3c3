"""Means over pixels and their uncertainty: random errors average out, common errors do not."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from hyperpaint.base import schema
from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.schema import ALONG_TRACK, CROSS_TRACK
from hyperpaint.base.units import takes_quantities

from .error_sources import line_errors
from .mean_errors import MeanErrors, RegionSums, error_variables
from .propagation import NONE_KNOWN, UNCERTAINTIES


@takes_quantities()
def mean_uncertainty(region: xr.Dataset, dims: Sequence[str] | str | None = None) -> xr.Dataset:
    r"""Mean reflectance over pixels, and its uncertainty.

    Eager: reads the region.

    Parameters
    ----------
    region
        ``reflectance``, ``reflectance_u_random`` and ``reflectance_u_systematic``, as
        ``.paint.reflectance(uncertainty=True)`` adds them, cut to the pixels of interest; NaN in pixels to
        leave out.
    dims
        Dims to average over; by default along_track and cross_track. Their pixels must be next to each other
        in space, in order: the distance of pixels counts.

    Returns
    -------
    Dataset
        On the other dims (mostly band): ``mean`` [1], ``n`` pixels, ``n_eff`` of them independent,
        ``u_random`` and ``u_systematic`` [1], float64 and int64. The attribute ``components`` of both names
        the known components. ``u_systematic`` is NaN where that is "none known", which does not mean that
        there is no such error. Where sources of error can be separated, ``reflectance_errors`` (error_source,
        band) and ``error_correlation`` (lag, band) as well, see `hyperpaint.paints.covariance`.

    Raises
    ------
    SchemaError
        A variable or a dim is missing.

    Notes
    -----
    For a region of a line that still has its calibration, each source of error is propagated by itself. With
    :math:`m` reflectance per count, :math:`x` columns, :math:`l` lines, :math:`s` samples of irradiance, and
    :math:`w_{ls}` their weights,

    .. math:: n^2 u_r^2 = \sum_{lx} u_{r,lx}^2 + \sum_x u_{D,x}^2 \Big(\sum_l m_{lx}\Big)^2
              + \sum_x u_{g,x}^2 \Big(\sum_l \rho_{lx}\Big)^2
              + u_E^2 \sum_s \Big(\sum_{lx} w_{ls} \rho_{lx}\Big)^2

    band by band: noise is independent in every sample, the errors of mean dark and gain are common to an
    element, the noise of irradiance to a sample of it. Several darks enter by their weights; rounding is
    common to a column where noise is less than half a count. :math:`u_s` is the root of the sum of squares of
    the errors that all bands share: gain, irradiance, dark, wavelength, linearity or a panel, and the
    pedestal of each line. Elsewhere

    .. math:: u_r = \sqrt{\overline{u_{r,i}^2} / n_{eff}}, \qquad u_s = \overline{u_{s,i}}, \qquad
              n_{eff} = n^2 \Big/ \sum_{ij} c_{ij}

    with :math:`c_{ij}` the autocorrelation of the pixels at their distance, summed from the centre outwards
    until it is not above zero. A surface's texture counts as correlated noise in it: the region should be
    homogeneous, since a gradient over it leaves few independent pixels. The result is the uncertainty of the
    mean of *these* pixels, not the difference to another part of the surface.

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
    mean_dims = [dims] if isinstance(dims, str) else list(dims or (ALONG_TRACK, CROSS_TRACK))
    names = ("reflectance", *UNCERTAINTIES)
    problems = Problems("a mean with its uncertainty cannot be computed", SchemaError)
    for name in (name for name in names if name not in region.variables):
        problems.add(
            f"{name!r} is missing",
            mend="add it by .paint.reflectance(uncertainty=True)",
            code="variable-missing",
        )
    for dim in mean_dims:
        if dim not in region.dims:
            problems.add(
                f"the region has no dim {dim!r}",
                expected=f"some of {', '.join(map(str, region.dims))}",
                code="dim-missing",
            )
    problems.raise_if_any()
    other_dims = [dim for dim in region["reflectance"].dims if dim not in mean_dims]
    cubes = [region[name].transpose(*other_dims, *mean_dims).values.astype(np.float64) for name in names]
    shape = cubes[0].shape[: len(other_dims)]
    value, random, systematic = (cube.reshape(-1, *cube.shape[len(other_dims) :]) for cube in cubes)
    is_valid, pixels = np.isfinite(value), tuple(range(1, value.ndim))
    n = is_valid.sum(axis=pixels)
    divisor = np.where(n > 0, n, np.nan)
    mean, mean_square, mean_systematic = (
        np.where(is_valid, cube, 0.0).sum(axis=pixels) / divisor for cube in (value, random**2, systematic)
    )
    errors = _errors_of(region, mean_dims, cubes)
    # NaN without a known component; arithmetic of xarray may drop the attribute, then all values are zero
    if region[names[2]].attrs.get("components") == NONE_KNOWN or not np.nan_to_num(systematic).any():
        mean_systematic = np.full_like(mean_systematic, np.nan)
    n_effective = np.array([effective_number(plane) for plane in value])
    mean_random = np.sqrt(mean_square / np.where(n > 0, n_effective, np.nan))
    if errors is not None:
        mean_random, mean_systematic = np.where(n > 0, errors.u_random, np.nan), errors.u_systematic
    estimates = {
        "mean": (mean, "Mean reflectance"),
        "n": (n, "Pixels"),
        "n_eff": (n_effective, "Independent pixels"),
        "u_random": (mean_random, "Random uncertainty of the mean"),
        "u_systematic": (mean_systematic, "Systematic uncertainty of the mean"),
    }
    coords = {name: c for name, c in region["reflectance"].coords.items() if set(c.dims) <= set(other_dims)}
    result = xr.Dataset(
        {
            k: (other_dims, v.reshape(shape), {"units": "1", "long_name": text})
            for k, (v, text) in estimates.items()
        },
        coords,
    )
    if errors is not None:
        result["u_random"].attrs["components"], result["u_systematic"].attrs["components"] = errors.components
        return result.assign(
            {
                name: array.isel({schema.SIGNATURE: 0}, drop=True)
                if schema.SIGNATURE in array.dims
                else array
                for name, array in error_variables([errors]).items()
            }
        )
    for name, source in zip(("u_random", "u_systematic"), names[1:], strict=True):
        if "components" in region[source].attrs:
            result[name].attrs["components"] = region[source].attrs["components"]
    return result


def _errors_of(region: xr.Dataset, mean_dims: Sequence[str], cubes: Sequence[Floats]) -> MeanErrors | None:
    # Return the errors of the mean by source; None where they cannot be separated.
    if set(mean_dims) != {ALONG_TRACK, CROSS_TRACK} or set(region["reflectance"].dims) != set(schema.CUBE):
        return None
    if (line := line_errors(region)) is None:
        return None
    order = [mean_dims.index(dim) for dim in (ALONG_TRACK, CROSS_TRACK)]
    value, random = (cube.transpose(0, *(1 + axis for axis in order)) for cube in cubes[:2])
    along, across = (axis.ravel() for axis in np.indices(value.shape[1:]))
    sums = RegionSums(line, along, across)
    for band in range(len(value)):
        sums.add(band, value[band].ravel(), random[band].ravel())
    return sums.errors()


def effective_number(plane: Floats) -> float:
    """Return the number of independent values equivalent to the values of a grid; NaN is ignored."""
    is_valid = np.isfinite(plane)
    n = int(is_valid.sum())
    if n < 3:
        return float(n)
    departure = np.where(is_valid, plane - plane[is_valid].mean(), 0.0)
    if not departure.any():
        return float(n)
    size, axes = [2 * length for length in plane.shape], range(plane.ndim)

    def correlate(values: Floats) -> Floats:
        power = np.abs(np.fft.rfftn(values, size, axes)) ** 2
        return np.asarray(np.fft.irfftn(power, size, axes))

    # number and product of pairs by their distance in rings
    pairs, products = np.rint(correlate(is_valid.astype(np.float64))), correlate(departure)
    distances = [np.minimum(np.arange(length), length - np.arange(length)) for length in size]
    ring_of_pair = np.zeros(size, np.int64)
    for axis, distance in enumerate(distances):
        ring_of_pair = np.maximum(
            ring_of_pair, distance.reshape([-1 if a == axis else 1 for a in range(plane.ndim)])
        )
    count = np.bincount(ring_of_pair.ravel(), pairs.ravel())
    total = np.bincount(ring_of_pair.ravel(), products.ravel()) / (products.flat[0] / n)
    # subtracting the mean adds -1/n to every pair
    correlation = (total + count / n) / np.maximum(count, 1.0)
    # every pair is counted twice
    is_correlated = (correlation > 2.0 / np.sqrt(np.maximum(count / 2.0, 1.0))) & (count > 0)
    is_correlated[0] = True
    reach = int(np.argmin(is_correlated)) if not is_correlated.all() else is_correlated.size
    excess = float((correlation[1:reach] * count[1:reach]).sum()) / n
    return float(np.clip(n / (1.0 + excess), 1.0, n))
