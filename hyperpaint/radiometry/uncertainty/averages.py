"""How sure a mean over pixels is: what is random averages out, what is common does not."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.schema import ALONG_TRACK, CROSS_TRACK

from .propagation import NONE_KNOWN, UNCERTAINTIES

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["effective_number", "mean_uncertainty"]


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
    until it is not told from zero. A surface's texture counts as correlated noise in it: the region should be
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
    >>> found = mean_uncertainty(region)
    >>> print(int(found.n), f"{float(found.u_random):.4f} {float(found.u_systematic):.4f}")
    600 0.0004 0.0060
    """
    import xarray as xr

    over = [dims] if isinstance(dims, str) else list(dims or (ALONG_TRACK, CROSS_TRACK))
    names = ("reflectance", *UNCERTAINTIES)
    problems = Problems("a mean with its uncertainty cannot be computed", SchemaError)
    problems_of = [name for name in names if name not in region.variables]
    for name in problems_of:
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
    made = {
        "mean": (mean, "Mean reflectance"),
        "n": (n, "Pixels"),
        "n_eff": (effective, "Independent pixels"),
        "u_random": (np.sqrt(square / np.where(n > 0, effective, np.nan)), "Random uncertainty of the mean"),
        "u_systematic": (common, "Systematic uncertainty of the mean"),
    }
    coords = {name: c for name, c in region["reflectance"].coords.items() if set(c.dims) <= set(rest)}
    result = xr.Dataset(
        {k: (rest, v.reshape(shape), {"units": "1", "long_name": text}) for k, (v, text) in made.items()},
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
    told = (correlation > 2.0 / np.sqrt(np.maximum(count / 2.0, 1.0))) & (count > 0)
    told[0] = True
    reach = int(np.argmin(told)) if not told.all() else told.size
    excess = float((correlation[1:reach] * count[1:reach]).sum()) / n
    return float(np.clip(n / (1.0 + excess), 1.0, n))
