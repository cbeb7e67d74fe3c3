"""Writer of the files of an SVC HR-1024i field spectrometer, independent of the package's readers.

Text: keys and values, then a row a channel of wavelength, radiance of the white panel, radiance of the target
and their ratio in per cent. Three detectors overlap, so that wavelengths fall twice; nothing is matched.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hyperpaint.base.arrays import Floats

__all__ = ["SVC_DETECTORS", "SvcDetector", "svc_wavelengths", "write_svc"]


_UNIT = 1e-6  # W m-2 sr-1 nm-1: the files count radiance in 1e-10 W cm-2 sr-1 nm-1


@dataclass(frozen=True)
class SvcDetector:
    """One of the three detectors.

    Attributes
    ----------
    channels
        Their number.
    first, last
        Wavelengths of the outer channels [nm].
    first_step
        Distance of the first two channels [nm]; it changes evenly to the last.
    fwhm
        Full width at half maximum of every channel [nm].
    """

    channels: int
    first: float
    last: float
    first_step: float
    fwhm: float

    @property
    def wavelength(self) -> Floats:
        """Of every channel as the files say it, shape (channel,) [nm].

        Examples
        --------
        >>> SVC_DETECTORS[0].wavelength[[0, 1, -2, -1]]
        array([ 338.5,  340. , 1009.1, 1010.3])
        """
        place = np.arange(self.channels)
        steps = self.channels - 1
        bend = (self.first_step - (self.last - self.first) / steps) / steps
        return np.asarray(np.round(self.first + self.first_step * place - bend * place**2, 1))


SVC_DETECTORS = (
    SvcDetector(512, 338.5, 1010.3, 1.47, 3.5),
    SvcDetector(256, 963.9, 1912.0, 3.72, 9.5),
    SvcDetector(256, 1891.3, 2513.2, 2.85, 6.5),
)
"""Silicon and two of InGaAs."""


def svc_wavelengths() -> Floats:
    """Return the wavelengths of a file's rows, shape (1024,) [nm]; they step back at two joins."""
    return np.concatenate([detector.wavelength for detector in SVC_DETECTORS])


def write_svc(
    path: Path,
    white: Floats,
    target: Floats,
    *,
    stamps: tuple[int, int],
    utc_offset: int,
    position: tuple[float, float],
    sun: tuple[float, float],
) -> None:
    """Write one measurement, a white panel first and the target second.

    Parameters
    ----------
    path
        The file.
    white, target
        Radiance on `svc_wavelengths`, shape (1024,) [W m-2 sr-1 nm-1].
    stamps
        UTC of panel and target [s since 1970].
    utc_offset
        Zone of the instrument's clock [s].
    position
        Latitude and longitude [degree].
    sun
        Zenith angle and azimuth [degree].
    """
    header = _header(path.name, stamps, utc_offset, position, sun)
    shown = np.round(np.stack([white, target]) / _UNIT, 2)
    percent = 100.0 * shown[1] / shown[0]
    rows = (
        f"{nm:.1f}  {panel:.2f}  {surface:.2f}  {share:.2f}"
        for nm, panel, surface, share in zip(svc_wavelengths(), *shown, percent, strict=True)
    )
    lines = ["/*** Spectra Vista SIG Data ***/", *(f"{key}= {value}" for key, value in header.items()), *rows]
    path.write_text("\r\n".join(lines) + "\r\n", encoding="ascii", newline="")


def _header(
    name: str,
    stamps: tuple[int, int],
    utc_offset: int,
    position: tuple[float, float],
    sun: tuple[float, float],
) -> dict[str, str]:
    latitude = _degrees_and_minutes(position[0], 2, "NS")
    longitude = _degrees_and_minutes(position[1], 3, "EW")
    times = [np.datetime64(stamp, "s").item() for stamp in stamps]
    local = [np.datetime64(stamp + utc_offset, "s").item() for stamp in stamps]
    clock = [f"{t.month}/{t.day}/{t.year} {t.hour % 12 or 12}:{t:%M:%S} {'AP'[t.hour >= 12]}M" for t in local]
    zeros = ",".join("0" * 32)
    return {
        "name": name,
        "instrument": "HI: 0000001 (HR-1024i)",
        "integration": "20.0, 20.0, 10.0, 40.0, 40.0, 10.0",
        "scan method": "Time-based, Time-based",
        "scan coadds": "50, 50, 100, 25, 25, 100",
        "scan time": "1, 1",
        "scan settings": "AI, AI",
        "external data set1": zeros,
        "external data set2": zeros,
        "external data dark": zeros[: 2 * 16 - 1],
        "external data mask": "0",
        "optic": "LENS 4(1), LENS 4(1)",
        "temp": "31.2, -5.0, -9.8, 31.3, -5.0, -9.9",
        "vis detector temp": "31.2, 31.3",
        "battery": "7.49, 7.49",
        "error": "0, 0",
        "units": "Radiance, Radiance",
        "time": ", ".join(clock),
        "longitude": f"{longitude:<16}, {longitude:<16}",
        "latitude": f"{latitude:<16}, {latitude:<16}",
        "gpstime": ", ".join(f"{f'{t:%H%M%S}.000':<16}" for t in times),
        "comm": "hyperpaint simulation",
        "memory slot": "0, 0",
        "factors": "1.000, 1.000, 1.000 [Overlap: Preserve, Matching Type: None]",
        "inclinometer x offset": "0, 0",
        "inclinometer y offset": "0, 0",
        "sun zenith": f"{sun[0]:.0f}, {sun[0]:.0f}",
        "sun azimuth": f"{sun[1]:.0f}, {sun[1]:.0f}",
        "data": "",
    }


def _degrees_and_minutes(angle: float, width: int, letters: str) -> str:
    """Return an angle the way GPS receivers write it.

    Examples
    --------
    >>> _degrees_and_minutes(-77.6749, 3, "EW")
    '07740.4940W'
    """
    whole, minutes = divmod(round(abs(angle) * 60.0, 4), 60.0)
    return f"{int(whole):0{width}d}{minutes:07.4f}{letters[angle < 0]}"
