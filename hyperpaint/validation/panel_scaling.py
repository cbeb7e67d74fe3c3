"""References relative to a white panel, made absolute by its certificate."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.units import convert

from .spectra import Measured

__all__ = ["scaled_by_panel"]


def scaled_by_panel(spectra: list[Measured], panel: Any) -> list[Measured]:
    """Return references multiplied by the reflectance of the panel that they are relative to.

    Parameters
    ----------
    spectra
        References relative to the panel.
    panel
        Reflectance of the panel on ``wavelength``: a DataArray, or a Dataset with ``reflectance``. Linear
        between its wavelengths; outside of them it is not known, and neither is the reference.

    Raises
    ------
    SchemaError, UnitsError
        A reference is absolute already, or the panel is no certificate; all problems are listed.
    """
    array = panel["reflectance"] if hasattr(panel, "data_vars") and "reflectance" in panel else panel
    if not hasattr(array, "dims") or tuple(array.dims) != ("wavelength",) or "wavelength" not in array.coords:
        raise SchemaError("panel= must be a DataArray of reflectance on wavelength; see read_certificate")
    problems = Problems("references cannot be scaled by the panel", SchemaError)
    wavelength = convert(array["wavelength"], "nm").values.astype(np.float64)
    values = convert(array, "1", "panel").values.astype(np.float64)
    order = np.argsort(wavelength)
    wavelength, values = wavelength[order], values[order]
    if not (np.isfinite(wavelength).all() and np.isfinite(values).all() and (np.diff(wavelength) > 0).all()):
        problems.add("panel= has wavelengths twice, or values that are not finite")
    elif not ((values > 0.0) & (values <= 1.2)).all():
        limits = f"{values.min():g} to {values.max():g}"
        problems.add(f"panel= reaches from {limits}, expected more than 0, at most 1.2; is it in percent?")
    for each in spectra:
        if each.absolute:
            problems.add(f"reference {each.name!r} is absolute already, or of a library; leave out panel=")
    problems.raise_if_any()
    return [_scaled(each, wavelength, values) for each in spectra]


def _scaled(spectrum: Measured, wavelength: Floats, values: Floats) -> Measured:
    factor = np.interp(spectrum.wavelength, wavelength, values, np.nan, np.nan)

    def times(spread: Floats | None) -> Floats | None:
        return None if spread is None else spread * factor

    return replace(
        spectrum,
        values=spectrum.values * factor,
        u_random=times(spectrum.u_random),
        u_systematic=times(spectrum.u_systematic),
        sd=times(spectrum.sd),
        absolute=True,
        notes=(*spectrum.notes, "scaled by the panel's certificate"),
    )
