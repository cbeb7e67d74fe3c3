"""Writers of the instruments' own files, independent of the package's readers.

ENVI header and BIL cube as the ENVI documentation describes them, with the side files of a Headwall
Nano-Hyperspec flight folder; ASD binary after "ASD File Format, version 8, revision B", written as version 7.

Files of an SVC HR-1024i are text: keys and values, then for every channel a row of wavelength, radiance of
the white panel, radiance of the target and their ratio in per cent. Its three detectors overlap, so that
wavelengths decrease at two joins; overlaps are not matched.
"""

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hyperpaint.base import Floats, Ints, Times

from .settings import SimulationSettings

#: Marker of simulated files: software version in headers of cubes, comment in files of field spectrometers,
#: generator of regions.
CAMERA_SOFTWARE = "hyperpaint simulation"

#: Wavelengths of the simulated spectrometer [nm].
ASD_WAVELENGTH = np.arange(350.0, 1076.0)

#: Integration time of a scan of the simulated spectrometer [ms], and number of scans in a spectrum.
ASD_INTEGRATION_MS, ASD_AVERAGES = 34, 20

_CALIBRATION_MS = 136
_GPS_EPOCH = np.datetime64("1980-01-06T00:00:00", "ns")
#: Days of leap seconds, from which GPS time is another second ahead of UTC (IERS Bulletin C).
_LEAPS = np.array(
    [
        *("1981-07-01", "1982-07-01", "1983-07-01", "1985-07-01", "1988-01-01", "1990-01-01", "1991-01-01"),
        *("1992-07-01", "1993-07-01", "1994-07-01", "1996-01-01", "1997-07-01", "1999-01-01", "2006-01-01"),
        *("2009-01-01", "2012-07-01", "2015-07-01", "2017-01-01"),
    ],
    "datetime64[ns]",
)
#: OLE automation dates are days since then.
_OLE_EPOCH = np.datetime64("1899-12-30T00:00:00", "s")


def write_bil_header(path: Path, wavelength: Floats, settings: SimulationSettings, lines: int) -> None:
    # write the header of a band-interleaved cube; ``path`` is the binary file, without an extension
    default_bands = ",".join(str(1 + int(np.abs(wavelength - nm).argmin())) for nm in (640.0, 550.0, 470.0))
    # Headwall headers have the comma at the start of the next line
    wavelengths = "\n,".join(f"{nm:.3f}" for nm in wavelength)
    # fields that Headwall software adds to an ENVI header
    comments = {
        "AOI width": settings.columns,
        "Array Pixel Pitch (um)": 7.4,
        "AverageDispersion": round(float(np.gradient(wavelength).mean()), 6),
        "Exposure (ms)": settings.exposure_time_ms,
        "HSIII_VERSION": CAMERA_SOFTWARE,
        "Lens EFL (mm)": 12,
        "Serial Number": "SIM-0001",
    }
    rows = "".join(f";{key} = {value}\n" for key, value in comments.items())
    path.with_name(path.name + ".hdr").write_text(
        "ENVI\n"
        "description = {[HEADWALL Hyperspec III]}\n"
        f"samples = {settings.columns}\nlines = {lines}\nbands = {len(wavelength)}\n"
        "header offset = 0\nfile type = ENVI Standard\ndata type = 12\ninterleave = bil\n"
        f"sensor type = Unknown\ndefault bands = {{{default_bands}}}\n"
        "byte order = 0\nwavelength units = nm\n"
        f"wavelength = {{\n{wavelengths}\n}}\n{rows}",
        encoding="ascii",
    )


def write_settings(path: Path, settings: SimulationSettings) -> None:
    rows = {"Exposure (ms)": settings.exposure_time_ms, "Frame Period (ms)": settings.frame_period_ms}
    path.write_text("".join(f"{key} = {value}\n" for key, value in rows.items()), encoding="ascii")


def write_frame_index(path: Path, frames: Ints, stamps: Ints) -> None:
    # write a ``frameIndex`` file (variant A) of frame numbers and microseconds of the instrument's clock
    rows = "".join(
        f"{frame}\t{stamp}\n" for frame, stamp in zip(frames.tolist(), stamps.tolist(), strict=True)
    )
    path.write_text(f"Frame#\tTimestamp\n{rows}", encoding="ascii")


def write_navigation(path: Path, pose: Mapping[str, Floats], stamps: Ints, utc: Times) -> None:
    # write ``imu_gps.txt`` (variant A)
    # pose: roll, pitch, heading, latitude, longitude [degree], altitude [m], each of shape (row,)
    # stamps: microseconds of the instrument's clock, shape (row,)
    # utc: the same instants in UTC, shape (row,)
    header = "Roll\tPitch\tYaw\tLat\tLon\tAlt\tTimestamp\tGps_UTC_Date&Time\tStatus\tHeading\n"
    columns = [
        pose[name].tolist() for name in ("roll", "pitch", "heading", "latitude", "longitude", "altitude")
    ]
    clock = [
        text.replace("-", "/").replace("T", " ") for text in np.datetime_as_string(utc, unit="us").tolist()
    ]
    rows = [
        f"{roll:.6f}\t{pitch:.6f}\t{heading:.6f}\t{lat:.9f}\t{lon:.9f}\t{alt:.4f}\t{stamp}\t{date}\t4\t{heading:.6f}\n"
        for roll, pitch, heading, lat, lon, alt, stamp, date in zip(
            *columns, stamps.tolist(), clock, strict=True
        )
    ]
    path.write_text(header + "".join(rows), encoding="ascii")


def write_sbet(path: Path, pose: Mapping[str, Floats], utc: Times) -> None:
    # write an SBET file: rows of 17 float64, angles in radians, seconds of the GPS week, zero velocities
    # pose: as for `write_navigation`; heights above the ellipsoid
    # utc: UTC of the rows, shape (row,)
    leap = np.searchsorted(_LEAPS, utc, side="right") * 10**9
    week = ((utc - _GPS_EPOCH).astype(np.int64) + leap) % (7 * 86_400 * 10**9)
    rows = np.zeros((len(utc), 17), "<f8")
    rows[:, 0] = week / 1e9
    for column, name in ((1, "latitude"), (2, "longitude"), (7, "roll"), (8, "pitch"), (9, "heading")):
        rows[:, column] = np.radians(pose[name])
    rows[:, 3] = pose["altitude"]
    rows.tofile(path)


_FILAMENT = ASD_WAVELENGTH**-5 / np.expm1(1.4388e7 / (ASD_WAVELENGTH * 3100.0))
#: Irradiance of a filament at 3100 K [W m-2 nm-1].
_LAMP = 0.3 * _FILAMENT / _FILAMENT.max()
#: Counts with the fore optic under this lamp, with ripple of the detector [count].
_LAMP_COUNTS = (
    9000.0
    * np.exp(-0.5 * ((ASD_WAVELENGTH - 700.0) / 190.0) ** 2)
    * (1.0 + 0.03 * np.sin(ASD_WAVELENGTH / 17.0))
    * _LAMP
    / 0.3
    + 40.0
)


def write_asd(path: Path, irradiance: Floats, *, stamp: int, utc_offset: int, reference_stamp: int) -> None:
    # write an irradiance spectrum as an ASD binary file, version 7.
    # The file holds raw counts and three calibration blocks; irradiance is LMP x counts / FO x (integration
    # time of FO / integration time).
    # irradiance: irradiance on `ASD_WAVELENGTH`, shape (726,) [W m-2 nm-1]
    # stamp: time by the clock of the logging computer, UTC as seconds since 1970
    # utc_offset: time zone of this computer [s]
    # reference_stamp: time of the reference by the same clock
    counts = irradiance * _LAMP_COUNTS / _LAMP * (ASD_INTEGRATION_MS / _CALIBRATION_MS)
    blocks = (
        (1, b"bse_sim.ref", np.full(len(ASD_WAVELENGTH), 0.99)),
        (2, b"lamp_sim.ill", _LAMP),
        (3, b"fo_sim.raw", _LAMP_COUNTS),
    )
    _write_asd(
        path, _IRRADIANCE, counts, np.ones(len(ASD_WAVELENGTH)), (stamp, utc_offset, reference_stamp), blocks
    )


def write_asd_reflectance(
    path: Path, radiance: Floats, white: Floats, *, stamp: int, utc_offset: int, reference_stamp: int
) -> None:
    # write a reflectance spectrum as an ASD binary file, version 7: counts of surface and white panel
    # radiance, white: radiance of the surface and of the panel, on `ASD_WAVELENGTH`, shape (726,) [W m-2 sr-1
    # nm-1]
    # stamp, utc_offset, reference_stamp: as for `write_asd`; ``reference_stamp`` is the time of the panel
    per_radiance = np.pi * _LAMP_COUNTS / _LAMP * (ASD_INTEGRATION_MS / _CALIBRATION_MS)
    times = stamp, utc_offset, reference_stamp
    _write_asd(path, _REFLECTANCE, radiance * per_radiance, white * per_radiance, times)


#: Settings of the operator: data type, fore optic, maximum of the plot, comment.
_IRRADIANCE = (4, 180, 65535.0, b"hyperpaint simulation, remote cosine receptor")
_REFLECTANCE = (1, 8, 1.25, b"hyperpaint simulation, white panel")


def _write_asd(
    path: Path,
    settings: tuple[int, int, float, bytes],
    counts: Floats,
    reference: Floats,
    times: tuple[int, int, int],
    blocks: Sequence[tuple[int, bytes, Floats]] = (),
) -> None:
    # ``times``: times of target and reference by the computer's clock [s since 1970 UTC], around its zone [s]
    (data_type, fore_optic, plot_maximum, comment), (stamp, zone, reference_stamp) = settings, times
    local = np.datetime64(stamp + zone, "s").item().timetuple()
    # fields of C's ``tm``: sec min hour mday mon year wday yday isdst, with Sunday as day 0
    clock = (local.tm_sec, local.tm_min, local.tm_hour, local.tm_mday, local.tm_mon - 1, local.tm_year - 1900)
    ole_times = (
        float((np.datetime64(moment + zone, "s") - _OLE_EPOCH).astype(np.int64)) / 86400.0
        for moment in (reference_stamp, stamp)
    )
    header = bytearray(484)
    for offset, layout, values in (
        (0, "3s", (b"as7",)),
        (3, "157s", (comment,)),
        (160, "9h", (*clock, (local.tm_wday + 1) % 7, local.tm_yday - 1, 0)),
        (178, "BBBB", (0x57, 0x70, 0, 1)),  # program 5.7, file 7.0, itime, dark subtracted
        (182, "i", (reference_stamp,)),
        (186, "B", (data_type,)),
        (187, "i", (reference_stamp,)),
        (191, "ff", (ASD_WAVELENGTH[0], 1.0)),
        (199, "B", (2,)),  # float64
        (204, "H", (len(counts),)),
        (390, "I", (ASD_INTEGRATION_MS,)),
        (394, "h", (fore_optic,)),  # 180: cosine receptor
        (398, "HH", (1, 18875)),
        (402, "4f", (0.0, plot_maximum, ASD_WAVELENGTH[0], ASD_WAVELENGTH[-1])),
        (418, "H", (16,)),
        (425, "3H", (ASD_AVERAGES, ASD_AVERAGES, ASD_AVERAGES)),
        (431, "B", (2,)),  # LSVNIR
        (444, "ff", (ASD_WAVELENGTH[-1], -1.0)),
    ):
        struct.pack_into("<" + layout, header, offset, *values)
    sections = [
        bytes(header),
        counts.astype("<f8").tobytes(),
        struct.pack("<Hdd", 0xFFFF, *ole_times),
        struct.pack("<H", 0),
        reference.astype("<f8").tobytes(),
        _EMPTY_CLASSIFIER,
        struct.pack("<hhHH", 0, 0, 0, 0),  # dependent variables: none
        struct.pack("<B", len(blocks)),
        *(struct.pack("<b20sihh", number, name, _CALIBRATION_MS, 0, 0) for number, name, _ in blocks),
        *(values.astype("<f8").tobytes() for _, _, values in blocks),
    ]
    path.write_bytes(b"".join(sections))


# classifier block: two codes, twenty empty strings, no constituents, an array without dims
_EMPTY_CLASSIFIER = struct.pack("<BB20HHH", 0, 0, *[0] * 20, 0, 0)


_UNIT = 1e-6  # W m-2 sr-1 nm-1 per unit of the files, 1e-10 W cm-2 sr-1 nm-1


# A detector of the SVC spectrometer
@dataclass(frozen=True)
class SvcDetector:
    channels: int  # number of channels
    # first, last: wavelengths of the outer channels [nm]
    first: float
    last: float
    # distance of the first two channels [nm]; the distance changes linearly with the channel
    first_step: float
    fwhm: float  # full width at half maximum of every channel [nm]

    @property
    def wavelength(self) -> Floats:
        """Wavelength of every channel as written to files, shape (channel,) [nm].

        Examples
        --------
        >>> SVC_DETECTORS[0].wavelength[[0, 1, -2, -1]]
        array([ 338.5,  340. , 1009.1, 1010.3])
        """
        channel = np.arange(self.channels)
        steps = self.channels - 1
        curvature = (self.first_step - (self.last - self.first) / steps) / steps
        return np.asarray(np.round(self.first + self.first_step * channel - curvature * channel**2, 1))


#: Detectors of the SVC spectrometer: silicon, and two of InGaAs.
SVC_DETECTORS = (
    SvcDetector(512, 338.5, 1010.3, 1.47, 3.5),
    SvcDetector(256, 963.9, 1912.0, 3.72, 9.5),
    SvcDetector(256, 1891.3, 2513.2, 2.85, 6.5),
)
#: Wavelengths of the rows of a file, shape (1024,) [nm]; they decrease at two joins.
SVC_WAVELENGTH = np.concatenate([detector.wavelength for detector in SVC_DETECTORS])


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
    # write a measurement of a white panel and a target
    # white, target: radiance on `SVC_WAVELENGTH`, shape (1024,) [W m-2 sr-1 nm-1]
    # stamps: UTC of panel and target [s since 1970]
    # utc_offset: zone of the instrument's clock [s]
    # position: latitude and longitude [degree]
    # sun: zenith angle and azimuth of the sun [degree]
    latitude = _degrees_and_minutes(position[0], 2, "NS")
    longitude = _degrees_and_minutes(position[1], 3, "EW")
    times, local = ([np.datetime64(stamp + zone, "s").item() for stamp in stamps] for zone in (0, utc_offset))
    clock = [f"{t.month}/{t.day}/{t.year} {t.hour % 12 or 12}:{t:%M:%S} {'AP'[t.hour >= 12]}M" for t in local]
    zeros = ",".join("0" * 32)
    header = {
        "name": path.name,
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
        "comm": CAMERA_SOFTWARE,
        "memory slot": "0, 0",
        "factors": "1.000, 1.000, 1.000 [Overlap: Preserve, Matching Type: None]",
        "inclinometer x offset": "0, 0",
        "inclinometer y offset": "0, 0",
        "sun zenith": f"{sun[0]:.0f}, {sun[0]:.0f}",
        "sun azimuth": f"{sun[1]:.0f}, {sun[1]:.0f}",
        "data": "",
    }
    rounded = np.round(np.stack([white, target]) / _UNIT, 2)
    rows = (
        f"{nm:.1f}  {panel:.2f}  {surface:.2f}  {100.0 * surface / panel if panel else 0.0:.2f}"
        for nm, panel, surface in zip(SVC_WAVELENGTH, *rounded, strict=True)
    )
    lines = ["/*** Spectra Vista SIG Data ***/", *(f"{key}= {value}" for key, value in header.items()), *rows]
    path.write_text("\r\n".join(lines) + "\r\n", encoding="ascii", newline="")


def _degrees_and_minutes(angle: float, width: int, letters: str) -> str:
    """Return an angle in the format of GPS receivers.

    Examples
    --------
    >>> _degrees_and_minutes(-77.6749, 3, "EW")
    '07740.4940W'
    """
    degrees, minutes = divmod(round(abs(angle) * 60.0, 4), 60.0)
    return f"{int(degrees):0{width}d}{minutes:07.4f}{letters[angle < 0]}"
