"""What a flight line declares of its bands and of its light: the small variables, checked once."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from hyperpaint.base import schema
from hyperpaint.base.arrays import Array, Floats
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.schema import IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH
from hyperpaint.light.responses import Responses, log_slope

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Declared", "Light"]


_MOST_SHIFT = 20.0
"""Declared shift beyond which units are wrong [nm]."""


@dataclass(frozen=True, eq=False)
class Light:
    """The irradiance record.

    Attributes
    ----------
    spectra : (sample, channel)
        Irradiance, any unit.
    time : (sample,), wavelength : (channel,)
        Of the samples, and of the channels [nm].
    fwhm : () or (channel,)
        Full width at half maximum of the channels [nm].
    srf_shape
        Line shape of the spectrometer.
    max_gap
        Longest time without a sample [s], or None.
    """

    spectra: Floats
    time: Array
    wavelength: Floats
    fwhm: Floats
    srf_shape: str
    max_gap: float | None


@dataclass(frozen=True, eq=False)
class Declared:
    """The bands of a line and their light, in the units of the table.

    Attributes
    ----------
    time : (line,)
        At mid exposure.
    wavelength, fwhm : (band,)
        [nm].
    good : (band,), bool
        All where nothing is said.
    wavelength_shift : () or (column,) or (band, column)
        [nm]; 0 where nothing is said.
    imager
        Responses of all bands.
    light
        The irradiance record.
    """

    time: Array
    wavelength: Floats
    fwhm: Floats
    good: npt.NDArray[np.bool_]
    wavelength_shift: Floats
    imager: Responses
    light: Light

    @classmethod
    def by(cls, dataset: xr.Dataset) -> Declared:
        """Return what a dataset declares, or raise."""
        needed = ["time", "wavelength", "fwhm", "irradiance", "irradiance_fwhm"]
        needed += [IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH]
        optional = ["wavelength_shift", "good", "band_spacing", "radiance_gain", "irradiance_max_gap"]
        optional += ["srf", "srf_offset"]
        names = [*needed, *(name for name in optional if name in dataset.variables)]
        arrays = schema.require(dataset, names, "the alignment")
        values: dict[str, Array] = {name: np.asarray(array.values) for name, array in arrays.items()}
        wavelength = values["wavelength"]
        gap = values.get("irradiance_max_gap")
        return cls(
            time=values["time"],
            wavelength=wavelength,
            fwhm=values["fwhm"],
            good=np.asarray(values.get("good", np.ones(wavelength.size)), bool),
            wavelength_shift=np.asarray(values.get("wavelength_shift", 0.0), np.float64),
            imager=_imager(values, str(dataset.attrs.get("srf_shape", "gaussian"))),
            light=Light(
                spectra=np.asarray(values["irradiance"], np.float64),
                time=values[IRRADIANCE_TIME],
                wavelength=values[IRRADIANCE_WAVELENGTH],
                fwhm=np.asarray(values["irradiance_fwhm"], np.float64),
                srf_shape=str(dataset.attrs.get("irradiance_srf_shape", "gaussian")),
                max_gap=None if gap is None else float(gap),
            ),
        )

    def shift(self, columns: int) -> Floats:
        """Return the declared shift of every element (band, column) [nm]."""
        given = self.wavelength_shift
        if not (np.isfinite(given).all() and np.abs(given).max() <= _MOST_SHIFT):
            raise SchemaError(
                f"'wavelength_shift' must be finite and at most {_MOST_SHIFT:g} nm; check its units"
            )
        return np.broadcast_to(given, (self.wavelength.size, columns))

    def bands(self, inside: Array) -> Responses:
        """Return the declared responses of some bands."""
        names = ("wavelength", "fwhm", "spacing", "slope", "table")
        parts: dict[str, Any] = {
            name: np.asarray(values)[inside]
            for name in names
            if (values := getattr(self.imager, name)) is not None
        }
        return replace(self.imager, **parts)


def _imager(values: dict[str, Array], shape: str) -> Responses:
    """Return the declared responses of all bands."""
    wavelength, fwhm = values["wavelength"], values["fwhm"]
    slope = None
    if "radiance_gain" in values:
        gain = np.asarray(values["radiance_gain"], np.float64)
        usable = np.isfinite(gain) & (gain > 0)
        total = np.where(usable, 1.0 / np.where(usable, gain, 1.0), 0.0).sum(axis=1)
        with np.errstate(invalid="ignore"):
            slope = log_slope(wavelength, total / usable.sum(axis=1), 2.0 * fwhm)
    return Responses(
        wavelength,
        fwhm,
        shape,
        spacing=values.get("band_spacing"),
        slope=slope,
        offset=values.get("srf_offset"),
        table=values.get("srf"),
    )
