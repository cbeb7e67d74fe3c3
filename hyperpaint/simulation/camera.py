"""One camera for everything that is simulated: equal settings are the same camera, in lab and flight."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from hyperpaint.base.arrays import Floats

from .atmosphere import spectral_grid
from .sensor import ETENDUE, Detector, Imager, nominal_responsivity, smile
from .settings import SimulationSettings

__all__ = ["CAMERA_FIELDS", "Camera"]


CAMERA_FIELDS = frozenset(
    {
        "bands", "columns", "seed", "first_wavelength", "last_wavelength", "dispersion_bow_nm", "srf_shape",
        "fwhm_nm", "fwhm_slope", "smile_nm", "bit_depth", "electrons_per_count", "read_noise", "dark_level",
        "dark_pattern", "dark_rate", "nonuniformity", "column_nonuniformity", "bad_elements",
    }
)  # fmt: skip
"""Fields of `hyperpaint.simulation.SimulationSettings` that make the camera."""

# keys of the random streams; those of flights and sweeps stand in their own modules
_DARK, _ELEMENTS, _BAD, _DARK_RATE, _COLUMNS = 13, 14, 15, 18, 19
_RATE_SPREAD = 0.2  # of the dark current from element to element, relative


@dataclass(frozen=True)
class Camera:
    """The simulated camera.

    Attributes
    ----------
    imager
        Its spectral side.
    dark_bias, dark_rate
        Counts at no exposure [count] and their growth [count s-1], shape (band, cross_track).
    bad
        True at elements that see no light, shape (band, cross_track).
    electrons_per_count, read_noise, bit_depth
        As in `hyperpaint.simulation.sensor.Detector`.
    """

    imager: Imager
    dark_bias: Floats
    dark_rate: Floats
    bad: NDArray[np.bool_]
    electrons_per_count: float
    read_noise: float
    bit_depth: int

    @classmethod
    def of(cls, settings: SimulationSettings) -> Camera:
        """Return the camera of these settings.

        Examples
        --------
        >>> Camera.of(SimulationSettings(bands=4, columns=3, fwhm_nm=5.0)).imager.band_fwhm
        array([5., 5., 5., 5.])
        """
        shape = settings.bands, settings.columns

        def normal(stream: int, shape: tuple[int, ...] = shape) -> Floats:
            drawn = np.random.default_rng([settings.seed, stream]).standard_normal(shape)
            return np.clip(drawn, -3.0, 3.0)

        place = np.linspace(-1.0, 1.0, settings.bands)
        wavelength = np.linspace(settings.first_wavelength, settings.last_wavelength, settings.bands)
        imager = Imager(
            wavelength + settings.dispersion_bow_nm * (1.0 - place**2),
            smile(settings.columns, settings.smile_nm),
            settings.fwhm_nm * (1.0 + settings.fwhm_slope * place),
            settings.srf_shape,
            nominal_responsivity(settings.electrons_per_count),
            (1.0 + settings.nonuniformity * normal(_ELEMENTS))
            * (1.0 + settings.column_nonuniformity * normal(_COLUMNS, shape[1:])),
        )
        bad = np.zeros(shape, dtype=bool)
        rng = np.random.default_rng([settings.seed, _BAD])
        bad.flat[rng.choice(bad.size, settings.bad_elements, replace=False)] = True
        return cls(
            imager,
            np.maximum(settings.dark_level + settings.dark_pattern * normal(_DARK), 0.0),
            settings.dark_rate * (1.0 + _RATE_SPREAD * normal(_DARK_RATE)),
            bad,
            settings.electrons_per_count,
            settings.read_noise,
            settings.bit_depth,
        )

    def detector(self, exposure_time: float) -> Detector:
        """Return the detector with the dark of an exposure [s]."""
        dark = self.dark_bias + self.dark_rate * exposure_time
        return Detector(dark, self.electrons_per_count, self.read_noise, self.bit_depth)

    @property
    def etendue(self) -> float:
        """Etendue of an element [m2 sr]."""
        return ETENDUE

    @cached_property
    def response_area(self) -> Floats:
        """INT R of every element, shape (band, cross_track) [count nm J-1]."""
        centres, reach = self.imager.wavelength, self.imager.reach
        grid = spectral_grid(centres.min() - reach - 1.0, centres.max() + reach + 1.0)
        return np.asarray(self.imager.integrals(np.ones((1, len(grid))), grid)[0])

    def radiance_gain(self, response_area: Floats | None = None) -> Floats:
        """1 / (etendue INT R), NaN at bad elements, shape (band, cross_track) [W m-2 sr-1 nm-1 s count-1]."""
        area = self.response_area if response_area is None else response_area
        return np.where(self.bad, np.nan, 1.0 / (self.etendue * area))
