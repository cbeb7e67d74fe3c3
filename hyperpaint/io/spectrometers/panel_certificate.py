"""Certificates of white panels: reflectance against wavelength."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hyperpaint.base.errors import FormatError
from hyperpaint.base.schema import VARIABLES

from .spectrum_csv import read_spectrum_csv

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["read_certificate"]

_MOST_HEADINGS = 40
_LARGEST = 1.2  # of a diffuse panel, as a fraction


def read_certificate(path: str | os.PathLike[str]) -> xr.DataArray:
    r"""Read the certificate of a white panel: lines of wavelength [nm] and reflectance.

    Parameters
    ----------
    path
        Text of two columns, separated by a comma, semicolon, tab or blanks, below 40 lines of headings or
        less.

    Returns
    -------
    (wavelength,), float64
        Reflectance factor of the panel [1].

    Raises
    ------
    FormatError
        The file is no such table, or its values are no fractions; percent is refused rather than guessed.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp(), "panel.csv")
    >>> _ = path.write_text("Diffuse target;95 %\nnm;R\n400;0.981\n450;0.985\n")
    >>> read_certificate(path).values
    array([0.981, 0.985])
    """
    import xarray as xr

    path = Path(path)
    wavelength, values = read_spectrum_csv(path, headings=_MOST_HEADINGS)
    if not ((values > 0.0) & (values <= _LARGEST)).all():
        raise FormatError(
            f"{path}: values from {values.min():g} to {values.max():g}, expected reflectance as a fraction; "
            "divide percent by 100"
        )
    attrs = {**VARIABLES["wavelength"].attrs, "long_name": "Wavelength of the certificate"}
    return xr.DataArray(
        values.astype(np.float64),
        dims="wavelength",
        coords={"wavelength": ("wavelength", wavelength, attrs)},
        name="reflectance",
        attrs={"units": "1", "long_name": "Reflectance factor of the panel", "source": path.name},
    )
