"""Colours of reflectance spectra in daylight: CIE 1931 matching functions, and sRGB."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from hyperpaint.base import schema
from hyperpaint.base.arrays import Array
from hyperpaint.base.errors import SchemaError
from hyperpaint.light.responses import band_spacing

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["colour_matching", "encode_srgb", "paint_colours", "srgb", "srgb_weights"]


# XYZ of an equal-energy white, adapted to D65 (Bradford), to linear sRGB (IEC 61966-2-1)
_BRADFORD_E_TO_D65 = np.array(
    [
        [0.9531874, -0.0265906, 0.0238731],
        [-0.0382467, 1.0288406, 0.0094060],
        [0.0026068, -0.0030332, 1.0892565],
    ]
)
_XYZ_TO_SRGB = np.array(
    [
        [3.2404542, -1.5371385, -0.4985314],
        [-0.9692660, 1.8760108, 0.0415560],
        [0.0556434, -0.2040259, 1.0572252],
    ]
)


def colour_matching(wavelength: npt.ArrayLike) -> Array:
    """Return the CIE 1931 colour-matching functions x, y, z (3, band) at wavelengths [nm].

    The multi-lobe fit of [1]_, within 1 % of the tables.

    References
    ----------
    .. [1] C. Wyman, P.-P. Sloan, P. Shirley, "Simple Analytic Approximations to the CIE XYZ Color Matching
       Functions", J. Computer Graphics Techniques 2(2), 1-11 (2013).

    Examples
    --------
    >>> print(colour_matching([555.0]).round(2).ravel())
    [0.52 1.   0.01]
    """
    nm = np.asarray(wavelength, np.float64)

    def lobe(centre: float, below: float, above: float) -> Array:
        return np.asarray(np.exp(-0.5 * ((nm - centre) / np.where(nm < centre, below, above)) ** 2))

    x = 1.056 * lobe(599.8, 37.9, 31.0) + 0.362 * lobe(442.0, 16.0, 26.7) - 0.065 * lobe(501.1, 20.4, 26.2)
    y = 0.821 * lobe(568.8, 46.9, 40.5) + 0.286 * lobe(530.9, 16.3, 31.1)
    z = 1.217 * lobe(437.0, 11.8, 36.0) + 0.681 * lobe(459.0, 26.0, 13.8)
    return np.stack([x, y, z])


def srgb(spectra: npt.ArrayLike, wavelength: npt.ArrayLike) -> Array:
    """Return the colours of reflectance spectra in daylight.

    Parameters
    ----------
    spectra : (..., band)
        Reflectance [1]; where it is NaN the neighbours stand in.
    wavelength : (band,)
        Increasing [nm].

    Returns
    -------
    (..., 3), float32
        sRGB from 0 to 1, white being a reflectance of 1; NaN where no visible band has a value.

    Raises
    ------
    SchemaError
        There are fewer than three bands between 380 and 780 nm.

    Examples
    --------
    >>> nm = np.arange(400.0, 700.0, 5.0)
    >>> srgb(np.where(nm > 600.0, 0.8, 0.05), nm).argmax()
    np.int64(0)
    """
    nm = np.asarray(wavelength, np.float64)
    visible = np.flatnonzero((nm > 380) & (nm < 780))
    if visible.size < 3:
        raise SchemaError(f"a colour needs three bands between 380 and 780 nm, found {visible.size}")
    nm = nm[visible]
    values = np.asarray(spectra, np.float64)[..., visible]
    flat = values.reshape(-1, visible.size)
    filled = np.full_like(flat, np.nan)
    for own, spectrum in zip(filled, flat, strict=True):
        known = np.isfinite(spectrum)
        if known.any():
            own[:] = np.interp(nm, nm[known], spectrum[known])
    linear = filled @ srgb_weights(nm, None)[..., 0].T.astype(np.float64)
    return encode_srgb(linear.clip(0.0, 1.0)).reshape(*values.shape[:-1], 3)


def paint_colours(paints: xr.Dataset) -> npt.NDArray[np.float32]:
    """Return the colour of every paint in daylight, (paint, 3), sRGB from 0 to 1; NaN where it has none.

    Bands that are not ``good`` are left out.
    """
    found = schema.require(paints, ["reflectance", "wavelength"], "colours", schema.LIBRARY_VARIABLES)
    values = found["reflectance"].values
    if "good" in paints.variables:
        values = np.where(paints["good"].values.astype(bool), values, np.nan)
    try:
        return np.asarray(srgb(values, found["wavelength"].values), np.float32)
    except SchemaError:  # fewer than three visible bands
        return np.full((len(values), 3), np.nan, np.float32)


def encode_srgb(linear: Array) -> Array:
    """Return linear values 0 to 1 as the sRGB standard encodes them."""
    curved = 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055
    return np.asarray(np.where(linear <= 0.0031308, 12.92 * linear, curved), np.float32)


def srgb_weights(wavelength: Array, shift: Array | None) -> Array:
    """Return what turns reflectance into linear sRGB, (rgb, band, 1 or column): each column its own smile."""
    own = wavelength[:, None]
    if shift is not None:
        own = own + np.atleast_2d(shift)
    matching = colour_matching(own) * band_spacing(wavelength)[:, None]
    matching = matching / matching.sum(axis=1, keepdims=True)
    return np.asarray(np.tensordot(_XYZ_TO_SRGB @ _BRADFORD_E_TO_D65, matching, 1), np.float32)
