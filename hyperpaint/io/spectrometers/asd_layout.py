"""Layout of the binary files of ASD field spectrometers (``.asd``, versions 1 to 8).

The layout follows "ASD File Format, version 8, revision B" as corrected by reading real files to their last
byte: little-endian throughout, a fixed header, the spectrum, and from version 2 on the white reference and
blocks that each version added. A file carries no checksum, so that the structure is all there is to check:
every declared count is held against the bytes that are left, and the last block must end where the file ends.
"""

from __future__ import annotations

import datetime as dt
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.io.files.reading import read_limited

from .asd_blocks import (
    AsdCalibration,
    AsdGps,
    Cursor,
    nominal_integration_ms,
    parse_gps,
    plain_text,
    read_later_blocks,
)

__all__ = ["AsdFile", "is_asd", "read_asd"]


HEADER_BYTES = 484
_LARGEST_FILE = 64 * 2**20  # ten times what 65,535 channels with every calibration block would need

# name and struct format of each field of the header, in file order
_HEADER = (
    ("version", "3s"),
    ("comment", "157s"),
    ("saved", "9h"),  # C struct tm, the PC's local time
    ("program_version", "B"),
    ("file_version", "B"),
    ("unused_itime", "B"),
    ("dark_subtracted", "B"),
    ("dark_epoch", "i"),
    ("data_type", "B"),
    ("reference_epoch", "i"),
    ("first_wavelength", "f"),
    ("wavelength_step", "f"),
    ("data_format", "B"),
    ("old_averages", "3B"),
    ("application", "B"),
    ("channels", "H"),
    ("application_data", "128s"),
    ("gps", "56s"),
    ("integration_ms", "I"),
    ("fore_optic", "h"),
    ("dark_correction", "h"),
    ("calibration_series", "H"),
    ("instrument_number", "H"),
    ("display_range", "4f"),
    ("bits", "H"),
    ("x_mode", "B"),
    ("flags", "4B"),
    ("averages", "3H"),  # dark, reference, sample
    ("instrument", "B"),
    ("bulb", "I"),
    ("swir_gains_offsets", "4H"),
    ("splices", "2f"),
    ("smart_detector", "27s"),
    ("spare", "5s"),
)
_VERSIONS = {b"ASD": 1, b"asd": 1, **{f"as{n}".encode(): n for n in range(2, 9)}}
_DTYPES: dict[int, np.dtype[Any]] = {0: np.dtype("<f4"), 1: np.dtype("<i4"), 2: np.dtype("<f8")}
_DATA_TYPES = (
    "raw",
    "reflectance",
    "radiance",
    "no units",
    "irradiance",
    "quality index",
    "transmittance",
    "unknown",
    "absorbance",
)
_INSTRUMENTS = {
    1: "PSII",
    2: "LSVNIR",
    3: "FieldSpec VNIR",
    4: "FieldSpec FR",
    5: "FieldSpec NIR",
    6: "CHEM",
    7: "LabSpec Pro",
    10: "HandHeld",
}
_DETECTORS = {1: "VNIR", 2: "SWIR1", 4: "SWIR2"}
_OLE_EPOCH_DAYS = 25569  # 1970-01-01 in days since 1899-12-30


@dataclass(frozen=True, eq=False)
class AsdFile:
    """What one ``.asd`` file holds; arrays are (wavelength), float64 and read-only.

    Attributes
    ----------
    name
        File name without its folder.
    version
        1 to 8.
    comment, description
        What the operator wrote; of the spectrum and of the white reference.
    local_time
        When the spectrum was saved, by the clock of the logging PC, in whole seconds, without a zone.
    utc_offset_h
        Local time minus UTC [h], or None where the file has no white reference to take it from.
    dark_utc
        When the dark current was measured, or None.
    data_type
        ``raw``, ``reflectance``, ``radiance``, ``irradiance`` ...: what the operator looked at. The spectrum
        is in raw counts in any case.
    wavelength
        Nanometres.
    spectrum
        Counts.
    reference
        Counts over the white panel, or None where none was taken.
    integration_ms
        Integration time of the VNIR detector, see `nominal_integration_ms`.
    sample_averages
        Spectra averaged into this one.
    gains
        SWIR 1 and SWIR 2.
    splices
        Wavelengths [nm] where VNIR ends and where SWIR 1 ends; -1 where there is no such detector.
    gps
        None without a fix.
    calibrations
        Calibration blocks by kind.
    instrument, instrument_number
        Model and serial number.
    fore_optic
        Field of view [degree], 0 none, 180 and more a cosine receptor.
    dark_subtracted
        Whether the dark current was taken off.
    saturated
        Detectors that the instrument found saturated: ``VNIR``, ``SWIR1``, ``SWIR2``.
    """

    name: str
    version: int
    comment: str
    description: str
    local_time: dt.datetime
    utc_offset_h: float | None
    dark_utc: dt.datetime | None
    data_type: str
    wavelength: Floats
    spectrum: Floats
    reference: Floats | None
    integration_ms: float
    sample_averages: int
    gains: tuple[int, int]
    splices: tuple[float, float]
    gps: AsdGps | None
    calibrations: Mapping[str, AsdCalibration]
    instrument: str
    instrument_number: int
    fore_optic: int
    dark_subtracted: bool
    saturated: frozenset[str]


def is_asd(head: bytes) -> bool:
    """Tell from its first bytes whether a file is a binary ``.asd`` file."""
    return head[:3] in _VERSIONS and b"\0" in head[:HEADER_BYTES]


def read_asd(path: str | os.PathLike[str]) -> AsdFile:
    """Read one binary ``.asd`` file, of any version, to its last byte.

    Parameters
    ----------
    path
        A file of an ASD FieldSpec, HandHeld or LabSpec; also their calibration files ``.ill``, ``.raw`` and
        ``.ref``, which have the same layout.

    Returns
    -------
    AsdFile
        Header, spectrum (wavelength), white reference and calibration blocks.

    Raises
    ------
    FormatError
        The file cannot be read, is not an ``.asd`` file, or is truncated, over-long or contradictory.
    """
    path = Path(path)
    return _parse(read_limited(path, _LARGEST_FILE, "an ASD spectrometer's file"), path.name)


def _parse(data: bytes, name: str) -> AsdFile:
    cursor = Cursor(data, name)
    if data[:3] not in _VERSIONS:
        raise cursor.error(f"begins with {data[:3]!r}, expected one of ASD, as2 to as8: not an .asd file")
    version = _VERSIONS[data[:3]]
    header = _header(cursor)
    channels: int = header["channels"]
    dtype = _DTYPES[header["data_format"]]
    spectrum = cursor.array(channels, dtype, "the spectrum")
    reference, reference_ole, description = None, math.nan, ""
    if version >= 2:
        flag, reference_ole, _ = cursor.values("Hdd", "the head of the white reference")
        if flag not in (0, 0xFFFF):
            raise cursor.error(f"white reference flag {flag:#06x}, expected 0x0000 or 0xffff: damaged")
        description = cursor.text("the description of the white reference")
        # a file without a reference holds zeros or an old one in its place
        values = cursor.array(channels, dtype, "the white reference")
        reference = values if flag and np.any(values != 0.0) else None
    calibrations = read_later_blocks(cursor, version, channels)
    if not cursor.at_end:
        raise cursor.error(f"{cursor.left} bytes follow the last block of a version {version} file: damaged")
    return AsdFile(
        name=name,
        version=version,
        comment=plain_text(header["comment"]),
        description=description,
        local_time=_local_time(cursor, header["saved"]),
        utc_offset_h=None if reference is None else _utc_offset_h(reference_ole, header["reference_epoch"]),
        dark_utc=_epoch(header["dark_epoch"]),
        data_type=_DATA_TYPES[header["data_type"]],
        wavelength=_wavelength(cursor, header),
        spectrum=spectrum,
        reference=reference,
        integration_ms=nominal_integration_ms(header["integration_ms"]),
        sample_averages=header["averages"][2],
        gains=header["swir_gains_offsets"][:2],
        splices=header["splices"],
        gps=parse_gps(cursor, header["gps"]),
        calibrations=MappingProxyType(calibrations),
        instrument=_INSTRUMENTS.get(header["instrument"], f"unknown ({header['instrument']})"),
        instrument_number=header["instrument_number"],
        fore_optic=header["fore_optic"],
        dark_subtracted=bool(header["dark_subtracted"]),
        saturated=frozenset(d for bit, d in _DETECTORS.items() if header["flags"][1] & bit),
    )


def _header(cursor: Cursor) -> dict[str, Any]:
    header: dict[str, Any] = {}
    for name, fmt in _HEADER:
        values = cursor.values(fmt, f"the header ({name})")
        header[name] = values[0] if len(values) == 1 else values
    if header["data_format"] not in _DTYPES:
        raise cursor.error(f"data format {header['data_format']}, expected 0 float, 1 integer or 2 double")
    if header["data_type"] >= len(_DATA_TYPES):
        raise cursor.error(f"data type {header['data_type']}, expected 0 to {len(_DATA_TYPES) - 1}: damaged")
    if header["channels"] == 0:
        raise cursor.error("no channels: the file holds no spectrum")
    return header


def _wavelength(cursor: Cursor, header: Mapping[str, Any]) -> Floats:
    first, step = header["first_wavelength"], header["wavelength_step"]
    if not (0 < first < 1e5 and 0 < step < 1e4):
        raise cursor.error(f"first wavelength {first} nm, step {step} nm, expected positive numbers: damaged")
    made: Floats = first + step * np.arange(header["channels"], dtype=np.float64)
    made.flags.writeable = False
    return made


def _local_time(cursor: Cursor, tm: tuple[int, ...]) -> dt.datetime:
    second, minute, hour, day, month, year = tm[:6]
    try:
        if not (80 <= year < 250 and 0 <= second <= 61):
            raise ValueError
        # C allows the second 60
        return dt.datetime(year + 1900, month + 1, day, hour, minute) + dt.timedelta(seconds=second)
    except ValueError as error:
        raise cursor.error(f"time of the spectrum {tm[:6]} is not a date: damaged") from error


def _utc_offset_h(ole_days: float, epoch_s: int) -> float | None:
    """Return local time minus UTC of the white reference, which a file holds in both."""
    if epoch_s <= 0 or not 0 < ole_days < 1e5:
        return None
    seconds = (ole_days - _OLE_EPOCH_DAYS) * 86400.0 - epoch_s
    hours = round(seconds / 900.0) / 4.0  # zones differ by quarters of an hour
    return hours if abs(seconds - hours * 3600.0) < 60.0 and -12.0 <= hours <= 14.0 else None


def _epoch(seconds: int) -> dt.datetime | None:
    return dt.datetime(1970, 1, 1) + dt.timedelta(seconds=seconds) if seconds > 0 else None
