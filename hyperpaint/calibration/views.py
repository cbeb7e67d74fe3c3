"""What can be derived from a calibration: relative responsivity, external quantum efficiency."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from hyperpaint.base.errors import SchemaError
from hyperpaint.base.schema import BAND, CROSS_TRACK, label, require

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["PLANCK_TIMES_LIGHT", "quantum_efficiency", "relative_responsivity"]

PLANCK_TIMES_LIGHT = 6.62607015e-34 * 2.99792458e8
"""[J m]"""


def relative_responsivity(calibration: xr.Dataset) -> xr.DataArray:
    """Return the responsivity (band, cross_track) over its largest median of a band [1].

    Parameters
    ----------
    calibration
        With ``responsivity``, as `hyperpaint.calibrate` gives it.

    Returns
    -------
    xarray.DataArray

    Raises
    ------
    SchemaError
        There is no responsivity.

    Examples
    --------
    >>> import xarray as xr
    >>> values = (("band", "cross_track"), [[1e16], [4e16]], {"units": "count J-1"})
    >>> made = xr.Dataset({"responsivity": values})
    >>> relative_responsivity(made).values.ravel()
    array([0.25, 1.  ])
    """
    found = require(calibration, ["responsivity"], "a relative responsivity")["responsivity"]
    made = found / found.median(CROSS_TRACK).max()
    made.attrs = {"long_name": "Responsivity relative to the best band", "units": "1"}
    return made.rename("relative_responsivity")


def quantum_efficiency(
    calibration: xr.Dataset, electrons_per_count: float | xr.DataArray | None = None
) -> xr.DataArray:
    r"""Return the external quantum efficiency of every band: electrons out per photon that enters a pixel.

    :math:`\eta = R\,k\,hc/\lambda` with R the responsivity [count J-1] and k electrons per count: optics,
    grating and detector together.

    Parameters
    ----------
    calibration
        With ``responsivity`` and ``wavelength``.
    electrons_per_count
        [electron count-1]; None for that of the calibration.

    Returns
    -------
    xarray.DataArray
        ``quantum_efficiency`` (band) [1], the median over the columns.

    Raises
    ------
    SchemaError
        Something is missing, or the responsivity has no absolute scale.

    Examples
    --------
    >>> import xarray as xr
    >>> made = xr.Dataset(
    ...     {"responsivity": (("band", "cross_track"), [[5e16]], {"units": "count J-1"})},
    ...     {"wavelength": ("band", [550.0], {"units": "nm"})})
    >>> round(float(quantum_efficiency(made, 20.0)[0]), 4)
    0.3612
    """
    names = ["responsivity", "wavelength"]
    if calibration.attrs.get("absolute_scale") == "unknown":
        raise SchemaError(
            "a quantum efficiency needs an absolute scale, which this calibration has not (absolute_scale = "
            "'unknown'); give it one by hyperpaint.calibration.anchor_to_radiance"
        )
    if electrons_per_count is None:
        if "electrons_per_count" not in calibration.variables:
            raise SchemaError(
                "a quantum efficiency needs electrons_per_count [electron count-1]: give it, or estimate it"
            )
        names.append("electrons_per_count")
    found = require(calibration, names, "a quantum efficiency")
    electrons: Any = found.get("electrons_per_count", electrons_per_count)
    photon = PLANCK_TIMES_LIGHT / (found["wavelength"] * 1e-9)
    made = (found["responsivity"] * electrons * photon).median(CROSS_TRACK).transpose(BAND)
    return label(made.astype(np.float64), "quantum_efficiency")
