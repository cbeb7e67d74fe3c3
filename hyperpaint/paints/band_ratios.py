"""Covariance of the bands of a signature, and ratios of two bands."""

from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base import BAND, Floats, Problems, SchemaError, takes_quantities
from hyperpaint.radiometry.spectral_axis import at
from hyperpaint.radiometry.uncertainty import FORMS

OTHER_BAND = "other_band"


@takes_quantities()
def covariance(signatures: xr.Dataset) -> xr.DataArray:
    r"""Return the covariance of the bands of every signature.

    Parameters
    ----------
    signatures
        A paint library, of any number of paints, or a mean from `hyperpaint.radiometry.mean_uncertainty`.

    Returns
    -------
    DataArray
        (..., band, other_band), float64: covariance of the mean reflectance [1].

    Raises
    ------
    SchemaError
        The signatures have no uncertainty.

    Notes
    -----
    .. math:: C_{bc} = u_{r,b} u_{r,c} R_{bc} + \sum_k e_{kb} e_{kc}

    with :math:`R` the ``error_correlation`` of errors that bands do not share, and :math:`e_k` the
    ``reflectance_errors`` of each source that all bands share, with their signs: a wavelength error raises
    one flank of a peak and lowers the other. Without separate sources, random errors are assumed to be
    independent and the systematic error common to all bands. Random errors are also assumed to be independent
    where bands were selected, so that neighbours are unknown. The uncertainty of the coat correction is
    common to all bands.

    Examples
    --------
    >>> paint = xr.Dataset({
    ...     "reflectance_u_random": ("band", [0.01, 0.01]),
    ...     "reflectance_u_systematic": ("band", [0.02, 0.04])})
    >>> covariance(paint).values.round(4)
    array([[0.0005, 0.0008],
           [0.0008, 0.0017]])
    """
    prefix = "" if "u_random" in signatures.variables else "reflectance_"
    names = [f"{prefix}u_{kind}" for kind in ("random", "systematic")]
    with Problems("the covariance of bands cannot be computed", SchemaError) as problems:
        for name in names:
            problems.add_if(
                name not in signatures.variables,
                f"{name!r} is missing",
                mend="extract signatures of reflectance with uncertainty",
                code="variable-missing",
            )
    random, systematic = (_last(signatures[name]) for name in names)
    other_dims = [dim for dim in signatures[names[0]].dims if dim != BAND]
    lags, shared = np.ones((1, *random.shape)), [np.nan_to_num(systematic)]
    is_sum: Any = np.ones((*random.shape[:-1], 1), bool)
    if "reflectance_errors" in signatures.variables:
        errors = _last(signatures["reflectance_errors"].transpose("error_source", ...))
        lags = _last(signatures["error_correlation"].transpose("lag", ...))
        lags[0] = 1.0
        if signatures["error_correlation"].attrs.get("bands", random.shape[-1]) != random.shape[-1]:
            lags = lags[:1]  # bands were selected: neighbours are unknown
        # without separate sources of error only their sum is known
        is_sum = np.isfinite(errors).sum(axis=(0, -1))[..., None] == 0
        sources = [str(name) for name in signatures["error_source"].values]
        is_shared = [name not in FORMS or FORMS[name].band == "systematic" for name in sources]
        shared = [*np.nan_to_num(errors[is_shared]), np.where(is_sum, np.nan_to_num(systematic), 0.0)]
    if "reflectance_u_coat" in signatures.variables:
        coat = np.nan_to_num(_last(signatures["reflectance_u_coat"]))
        # the sum of systematic errors includes it already
        shared.append(np.where(is_sum & np.isfinite(systematic), 0.0, coat))
    total = np.zeros((*random.shape, random.shape[-1]))
    size = random.shape[-1]
    for lag, correlation in enumerate(np.nan_to_num(lags)):
        band = np.arange(size - lag)
        product = correlation[..., : size - lag] * random[..., : size - lag] * random[..., lag:]
        total[..., band, band + lag] = total[..., band + lag, band] = product
    for error in shared:
        total += error[..., :, None] * error[..., None, :]
    missing = np.isnan(random)
    total[missing[..., :, None] | missing[..., None, :]] = np.nan
    attrs = {"units": "1", "long_name": "Covariance of mean reflectance"}
    coords = {
        name: array for name, array in signatures.coords.items() if set(array.dims) <= {*other_dims, BAND}
    }
    return xr.DataArray(total, coords, (*other_dims, BAND, OTHER_BAND), attrs=attrs)


@takes_quantities(numerator="nm", denominator="nm")
def band_ratio(signatures: xr.Dataset, numerator: float, denominator: float) -> xr.Dataset:
    """Return the ratio of two bands of every signature, with its uncertainty.

    Errors that both bands share, such as the level of the irradiance, cancel in a ratio.

    Parameters
    ----------
    signatures
        See `covariance`.
    numerator, denominator
        Wavelengths of the two bands [nm].

    Returns
    -------
    Dataset
        ``ratio`` and ``ratio_u``, its standard uncertainty [1], on the dims without ``band``.

    Raises
    ------
    SchemaError
        There is no such band, or the signatures have no uncertainty.

    Examples
    --------
    >>> paint = xr.Dataset(
    ...     {"reflectance": ("band", [0.2, 0.4]), "reflectance_u_random": ("band", [0.0, 0.0]),
    ...      "reflectance_u_systematic": ("band", [0.02, 0.04])},
    ...     {"wavelength": ("band", [550.0, 850.0], {"units": "nm"})})
    >>> ratio = band_ratio(paint, 850.0, 550.0)
    >>> float(ratio.ratio), round(float(ratio.ratio_u), 12)
    (2.0, 0.0)
    """
    bands = covariance(signatures)
    numbers = xr.DataArray(np.arange(bands.sizes[BAND]), dims=BAND)
    axis = xr.Dataset({"number": numbers}, {"wavelength": signatures["wavelength"]})
    p, q = (int(at(axis, nm)["number"]) for nm in (numerator, denominator))
    level = signatures["mean" if "mean" in signatures.variables else "reflectance"]
    x, y = (level.isel({BAND: number}, drop=True).astype(np.float64) for number in (p, q))

    def covariance_of(row: int, column: int) -> Any:
        return bands.isel({BAND: row, OTHER_BAND: column}, drop=True)

    ratio = x / y
    variance = covariance_of(p, p) - 2.0 * ratio * covariance_of(p, q) + ratio**2 * covariance_of(q, q)
    # rounding may make the difference negative
    u = np.sqrt(variance.clip(min=0.0)) / abs(y)
    return xr.Dataset(
        {
            "ratio": ratio.assign_attrs(units="1", long_name="Ratio of two bands"),
            "ratio_u": u.assign_attrs(units="1", long_name="Standard uncertainty of the ratio"),
        }
    )


def _last(array: xr.DataArray) -> Floats:
    return np.array(array.transpose(..., BAND).values, np.float64)
