"""Fit the functions of the clear sky to a table of sky radiance, measured or modelled."""

from __future__ import annotations

import numpy as np
import xarray as xr
from scipy.optimize import nnls

from hyperpaint.base.errors import SchemaError
from hyperpaint.base.units import convert, takes_quantities

from .sky_functions import function_shapes, relative_radiance, scattering_cosine

FUNCTIONS = ("uniform", "molecular", "aureole")
MIN_DIRECTIONS = 6


@takes_quantities(sun_zenith="degree")
def fit_sky(table: xr.Dataset, sun_zenith: float) -> xr.Dataset:
    r"""Return the shares of the sky functions that fit a table of sky radiance best.

    Parameters
    ----------
    table
        Has ``sky_radiance`` (wavelength, sky_zenith, sky_azimuth) [W m-2 sr-1 nm-1], azimuth from the sun
        [degree], as the readers of `hyperpaint.io.skies` return it; directions below the horizon are ignored.
    sun_zenith
        [degree]

    Returns
    -------
    Dataset
        ``share`` (wavelength, function) of the level irradiance, not negative, of sum 1; ``misfit``
        (wavelength), the relative residual, root mean square over directions as level ground weights them.

    Raises
    ------
    SchemaError
        There is no radiance, or fewer than 6 directions above the horizon.

    Notes
    -----
    :math:`\min_{s \ge 0} \sum_j w_j (\sum_k s_k f_k(j) / L_j - 1)^2` with :math:`w_j = \cos \theta_j
    \Delta \Omega_j` (C. L. Lawson and R. J. Hanson, Solving Least Squares Problems, 1974).

    Examples
    --------
    >>> import xarray as xr
    >>> dims, degree = ("wavelength", "sky_zenith", "sky_azimuth"), {"units": "degree"}
    >>> even = np.full((1, 4, 4), 0.1)
    >>> table = xr.Dataset(
    ...     {"sky_radiance": (dims, even, {"units": "W m-2 sr-1 nm-1"})},
    ...     {"wavelength": ("wavelength", [550.0], {"units": "nm"}),
    ...      "sky_zenith": ("sky_zenith", [10.0, 30.0, 50.0, 70.0], degree),
    ...      "sky_azimuth": ("sky_azimuth", [0.0, 60.0, 120.0, 180.0], degree)},
    ... )
    >>> fit_sky(table, 40.0).share.values.round(6)
    array([[1., 0., 0.]])
    """
    if "sky_radiance" not in table.variables:
        raise SchemaError(
            "the table of the sky has no sky_radiance (wavelength, sky_zenith, sky_azimuth)",
            code="variable-missing",
        )
    sky = convert(table["sky_radiance"], "W m-2 sr-1 nm-1").transpose(
        "wavelength", "sky_zenith", "sky_azimuth"
    )
    angles = [
        np.radians(convert(table[name].reset_coords(drop=True), "degree").values) for name in sky.dims[1:]
    ]
    zenith, azimuth = np.meshgrid(*angles, indexing="ij")
    cosine = np.cos(zenith)
    is_above_horizon = (cosine > 1e-3) & (sky.values > 0.0).all(axis=0)
    if is_above_horizon.sum() < MIN_DIRECTIONS:
        raise SchemaError(
            f"sky_radiance has {int(is_above_horizon.sum())} directions above the horizon",
            expected=f"{MIN_DIRECTIONS} or more",
            code="sky-directions-few",
        )
    zenith_step = np.abs(np.gradient(angles[0]))[:, None] if angles[0].size > 1 else np.ones((1, 1))
    weight = (cosine * np.maximum(np.sin(zenith), 1e-3) * zenith_step)[is_above_horizon]
    from_sun = scattering_cosine(cosine[is_above_horizon], azimuth[is_above_horizon], sun_zenith)
    parts = [
        relative_radiance(shape, cosine[is_above_horizon], from_sun)
        for shape in function_shapes(float(sun_zenith))
    ]
    functions = np.stack([np.ones_like(from_sun), *parts], axis=1)
    scale = np.sqrt(weight / weight.sum())
    shares, misfit = [], []
    for radiance in sky.values[:, is_above_horizon]:
        sums, residual = nnls(functions * (scale / radiance)[:, None], scale)
        shares.append(sums / sums.sum())
        misfit.append(residual)
    return xr.Dataset(
        {
            "share": (("wavelength", "function"), np.array(shares), {"units": "1"}),
            "misfit": ("wavelength", np.array(misfit), {"units": "1"}),
        },
        {"wavelength": table["wavelength"].variable, "function": list(FUNCTIONS)},
    )
