"""Paint libraries and spectrometer datasets of spectra that are known at any wavelength."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

import hyperpaint as hp

NM = np.linspace(410.0, 990.0, 117)


def smooth(nm: Any) -> Any:
    # Return a reflectance that has an edge and a slope
    return 0.1 + 0.3 / (1.0 + np.exp(-(np.asarray(nm) - 620.0) / 15.0)) + 1e-4 * (np.asarray(nm) - 700.0)


def seen(nm: Any, fwhm: float, spectrum: Any = smooth) -> Any:
    # Return a spectrum as channels of a Gaussian shape see it, integrated the plain way
    made = []
    for centre in np.atleast_1d(nm):
        grid = np.linspace(centre - 3.0 * fwhm, centre + 3.0 * fwhm, 2001)
        weight = np.exp(-4.0 * np.log(2.0) * ((grid - centre) / fwhm) ** 2)
        made.append((weight * spectrum(grid)).sum() / weight.sum())
    return np.array(made)


def library(
    spectra: Any, names: Sequence[str] = ("hood",), nm: Any = NM, fwhm: float | None = 6.0, **more: Any
) -> xr.Dataset:
    # Return a paint library
    values = np.atleast_2d(np.asarray(spectra, np.float32))
    made = xr.Dataset(
        {"reflectance": (("signature", "band"), values, {"units": "1"})},
        {"signature": list(names), "wavelength": ("band", np.asarray(nm, float), {"units": "nm"})},
    )
    if fwhm is not None:
        made = made.assign_coords(fwhm=("band", np.full(len(nm), fwhm), {"units": "nm"}))
    return made.assign(
        {key: (("signature", "band"), np.atleast_2d(value), {"units": "1"}) for key, value in more.items()}
    )


def field(
    spectra: Any, names: Sequence[str] = ("hood",), nm: Any = None, fwhm: float | None = 3.0, **attrs: Any
) -> xr.Dataset:
    # Return spectra of a field spectrometer
    nm = np.arange(380.0, 1021.0) if nm is None else np.asarray(nm, float)
    made = xr.Dataset(
        {"reflectance": (("spectrum", "wavelength"), np.atleast_2d(spectra), {"units": "1"})},
        {"spectrum": np.array(names, object), "wavelength": ("wavelength", nm, {"units": "nm"})},
        {"instrument": "ASD", **attrs},
    )
    if fwhm is not None:
        made = made.assign_coords(fwhm=("wavelength", np.full(nm.size, fwhm), {"units": "nm"}))
    return made


def agreeing() -> tuple[xr.Dataset, xr.Dataset]:
    # Return one paint as two instruments see it
    nm = np.arange(380.0, 1021.0)
    return library(seen(NM, 6.0)), field(seen(nm, 3.0))


def value_of(found: hp.validation.Validation, name: str, part: str = "all", pair: int = 0) -> float:
    # Return one statistic of one pair
    return float(found.statistics[name].isel(pair=pair).sel(part=part))
