"""Reflectance of the cars' paints as two field spectrometers saw it on the ground before the flight.

The truth of these files is the paint's own spectrum: what it reflects near normal, without the mirror image
of the sky. Beyond 1000 nm, where only the SVC sees, the light has no bands.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .atmosphere import spectral_grid
from .flight import ORIGIN, Flight
from .instruments import ASD_WAVELENGTH, write_asd_reflectance
from .sensor import convolve_gaussian
from .skies import sky_irradiance
from .svc_files import SVC_DETECTORS, svc_wavelengths, write_svc

__all__ = ["ASD_FOLDER", "SVC_FOLDER", "write_references"]


SVC_FOLDER, ASD_FOLDER = "svc", "asd_reflectance"

_STEP = 0.1  # nm
_LEAD, _EACH, _PANEL = 3600, 60, 15  # s from the first paint to the flight, to the next paint, from the panel
_MARGIN = 40.0  # nm beyond the outer channels, more than a line shape reaches


def write_references(flight: Flight, folder: Path) -> None:
    """Write a file of each spectrometer for every paint of the cars.

    Parameters
    ----------
    flight
        Knows the paints and the light.
    folder
        Of the collect; receives the folders `SVC_FOLDER` and `ASD_FOLDER`, with files named by paint.
    """
    settings = flight.settings
    svc, asd = folder / SVC_FOLDER, folder / ASD_FOLDER
    for made in (svc, asd):
        made.mkdir()
    seen = svc_wavelengths()
    grid = spectral_grid(seen.min() - _MARGIN, seen.max() + _MARGIN, _STEP)
    light = sky_irradiance(settings.sky, settings.sun[0], grid).sum(axis=0) / np.pi
    # the white panel first
    spectra = np.concatenate([light[None], light * flight.paint_reflectance(flight.paints, grid)])
    by_svc = np.concatenate(
        [convolve_gaussian(spectra, grid, each.wavelength, each.fwhm) for each in SVC_DETECTORS], axis=1
    )
    by_asd = convolve_gaussian(spectra, grid, ASD_WAVELENGTH, settings.irradiance_fwhm_nm)
    zone, start = round(settings.utc_offset_h * 3600), flight.start // 10**9
    for index, paint in enumerate(flight.paints, 1):
        panel = start - _LEAD + _EACH * index
        target = panel + _PANEL
        write_svc(
            svc / f"{paint}.sig",
            by_svc[0],
            by_svc[index],
            stamps=(panel, target),
            utc_offset=zone,
            position=ORIGIN[:2],
            sun=settings.sun,
        )
        write_asd_reflectance(
            asd / f"{paint}.asd",
            by_asd[index],
            by_asd[0],
            stamp=target,
            utc_offset=zone,
            reference_stamp=panel,
        )
