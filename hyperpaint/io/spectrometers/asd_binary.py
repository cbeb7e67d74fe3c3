"""Layout of the binary files of ASD field spectrometers (``.asd``, versions 1 to 8).

The layout follows "ASD File Format, version 8, revision B" as corrected by reading real files to their last
byte: little-endian throughout, a fixed header, the spectrum, and from version 2 on the white reference and
blocks that later versions added. A file has no checksum, so that only its structure can be checked: every
declared count is compared with the number of bytes not yet read, and the last block must end at the file's
end.
"""

from __future__ import annotations

import datetime as dt
import math
import os
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import FormatError
from hyperpaint.base.input_files import read_limited

HEADER_BYTES = 484
_MAX_BYTES = 64 * 2**20  # ten times the size of 65,535 channels with every calibration block

# name and struct format of each header field, in file order;
# ``saved`` is the PC's local time as a C struct tm; ``averages`` counts dark, reference and sample spectra
_HEADER = (
    ("version", "3s"), ("comment", "157s"), ("saved", "9h"), ("program_version", "B"), ("file_version", "B"),
    ("unused_itime", "B"), ("dark_subtracted", "B"), ("dark_epoch", "i"), ("data_type", "B"),
    ("reference_epoch", "i"), ("first_wavelength", "f"), ("wavelength_step", "f"), ("data_format", "B"),
    ("old_averages", "3B"), ("application", "B"), ("channels", "H"), ("application_data", "128s"),
    ("gps", "56s"), ("integration_ms", "I"), ("fore_optic", "h"), ("dark_correction", "h"),
    ("calibration_series", "H"), ("instrument_number", "H"), ("display_range", "4f"), ("bits", "H"),
    ("x_mode", "B"), ("flags", "4B"), ("averages", "3H"), ("instrument", "B"), ("bulb", "I"),
    ("swir_gains_offsets", "4H"), ("splices", "2f"), ("smart_detector", "27s"), ("spare", "5s"),
)  # fmt: skip
_VERSIONS = {b"ASD": 1, b"asd": 1, **{f"as{n}".encode(): n for n in range(2, 9)}}
_DTYPES: dict[int, np.dtype[Any]] = {0: np.dtype("<f4"), 1: np.dtype("<i4"), 2: np.dtype("<f8")}
_DATA_TYPES = (
    "raw", "reflectance", "radiance", "no units", "irradiance", "quality index", "transmittance", "unknown",
    "absorbance",
)  # fmt: skip
_INSTRUMENTS = {
    1: "PSII", 2: "LSVNIR", 3: "FieldSpec VNIR", 4: "FieldSpec FR", 5: "FieldSpec NIR", 6: "CHEM",
    7: "LabSpec Pro", 10: "HandHeld",
}  # fmt: skip
_DETECTORS = {1: "VNIR", 2: "SWIR1", 4: "SWIR2"}
_OLE_EPOCH_DAYS = 25569  # 1970-01-01 in days since 1899-12-30


@dataclass(frozen=True, eq=False)
class AsdFile:
    """Content of one ``.asd`` file; arrays are (wavelength), float64 and read-only."""

    name: str  # file name without its folder
    version: int  # 1 to 8
    comment: str  # of the operator on the spectrum
    description: str  # of the white reference
    # Local time of the logging PC when it saved the spectrum, in whole seconds, without a zone
    local_time: dt.datetime
    # Local time minus UTC [h], derived from the white reference; None without one
    utc_offset_h: float | None
    dark_utc: dt.datetime | None  # UTC of the measurement of the dark current
    # Quantity displayed to the operator: ``raw``, ``reflectance``, ``radiance``, ``irradiance`` ...; it does
    # not describe ``spectrum``, which is always raw counts
    data_type: str
    wavelength: Floats  # nanometres
    spectrum: Floats  # counts
    reference: Floats | None  # counts of the white panel; None if it was not measured
    integration_ms: float  # integration time of the VNIR detector, see `nominal_integration_ms`
    sample_averages: int  # spectra averaged into this one
    gains: tuple[int, int]  # SWIR 1 and SWIR 2
    # Wavelengths [nm] at which VNIR and SWIR 1 end; -1 for a detector that the instrument lacks
    splices: tuple[float, float]
    gps: AsdGps | None  # None without a fix
    calibrations: Mapping[str, AsdCalibration]  # calibration blocks by kind
    instrument: str  # model and serial number
    instrument_number: int
    fore_optic: int  # field of view [degree]; 0 for no optic, 180 or more for a cosine receptor
    dark_subtracted: bool
    saturated: frozenset[str]  # detectors flagged as saturated: ``VNIR``, ``SWIR1``, ``SWIR2``


def is_asd(head: bytes) -> bool:
    """Return whether the first bytes of a file are those of a binary ``.asd`` file."""
    return head[:3] in _VERSIONS and b"\0" in head[:HEADER_BYTES]


def read_asd(path: str | os.PathLike[str]) -> AsdFile:
    """Read one binary ``.asd`` file, of any version, to its last byte.

    path: A file of an ASD FieldSpec, HandHeld or LabSpec; also their calibration files ``.ill``, ``.raw`` and
        ``.ref``, which have the same layout.
    Returns AsdFile: Header, spectrum (wavelength), white reference and calibration blocks.
    Raises FormatError: The file cannot be read, is not an ``.asd`` file, or is truncated, over-long or
        contradictory.
    """
    path = Path(path)
    data = read_limited(path, _MAX_BYTES, "an ASD spectrometer's file")
    cursor = Cursor(data, path.name)
    if data[:3] not in _VERSIONS:
        raise cursor.error(
            f"begins with {data[:3]!r}", expected="one of ASD, as2 to as8", code="format-unknown"
        )
    version = _VERSIONS[data[:3]]
    header = _header(cursor)
    channels: int = header["channels"]
    dtype = _DTYPES[header["data_format"]]
    spectrum = cursor.array(channels, dtype, "the spectrum")
    reference, reference_ole, description = None, math.nan, ""
    if version >= 2:
        flag, reference_ole, _ = cursor.values("Hdd", "the head of the white reference")
        if flag not in (0, 0xFFFF):
            raise cursor.error(
                f"white reference flag {flag:#06x}", expected="0x0000 or 0xffff", code="file-damaged"
            )
        description = cursor.text("the description of the white reference")
        # without a white reference, the file contains zeros or an outdated reference here
        values = cursor.array(channels, dtype, "the white reference")
        reference = values if flag and np.any(values != 0.0) else None
    calibrations = _read_later_blocks(cursor, version, channels)
    if not cursor.at_end:
        raise cursor.error(
            f"{cursor.remaining} bytes follow the last block of a version {version} file", code="file-damaged"
        )
    first, step, dark_s = header["first_wavelength"], header["wavelength_step"], header["dark_epoch"]
    local_time = _local_time(cursor, header["saved"])
    if not (0 < first < 1e5 and 0 < step < 1e4):
        raise cursor.error(
            f"first wavelength {first} nm, step {step} nm", expected="positive numbers", code="file-damaged"
        )
    wavelength: Floats = first + step * np.arange(channels, dtype=np.float64)
    wavelength.flags.writeable = False
    return AsdFile(
        name=path.name,
        version=version,
        comment=_text_of_bytes(header["comment"]),
        description=description,
        local_time=local_time,
        utc_offset_h=None if reference is None else _utc_offset_h(reference_ole, header["reference_epoch"]),
        dark_utc=dt.datetime(1970, 1, 1) + dt.timedelta(seconds=dark_s) if dark_s > 0 else None,
        data_type=_DATA_TYPES[header["data_type"]],
        wavelength=wavelength,
        spectrum=spectrum,
        reference=reference,
        integration_ms=nominal_integration_ms(header["integration_ms"]),
        sample_averages=header["averages"][2],
        gains=header["swir_gains_offsets"][:2],
        splices=header["splices"],
        gps=_gps_fix(cursor, header["gps"]),
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
        raise cursor.error(
            f"data format {header['data_format']}",
            expected="0 float, 1 integer or 2 double",
            code="file-damaged",
        )
    if header["data_type"] >= len(_DATA_TYPES):
        raise cursor.error(
            f"data type {header['data_type']}", expected=f"0 to {len(_DATA_TYPES) - 1}", code="file-damaged"
        )
    if header["channels"] == 0:
        raise cursor.error("the file has no channels", code="empty-input")
    return header


def _local_time(cursor: Cursor, tm: tuple[int, ...]) -> dt.datetime:
    second, minute, hour, day, month, year = tm[:6]
    try:
        if not (80 <= year < 250 and 0 <= second <= 61):
            raise ValueError
        # C's struct tm allows second 60, datetime does not
        return dt.datetime(year + 1900, month + 1, day, hour, minute) + dt.timedelta(seconds=second)
    except ValueError as error:
        raise cursor.error(f"time of the spectrum {tm[:6]} is not a date", code="time-unreadable") from error


def _utc_offset_h(ole_days: float, epoch_s: int) -> float | None:
    # Return local time minus UTC [h], from the two stamps of the white reference.
    if epoch_s <= 0 or not 0 < ole_days < 1e5:
        return None
    seconds = (ole_days - _OLE_EPOCH_DAYS) * 86400.0 - epoch_s
    hours = round(seconds / 900.0) / 4.0  # UTC offsets are multiples of a quarter of an hour
    return hours if abs(seconds - hours * 3600.0) < 60.0 and -12.0 <= hours <= 14.0 else None


_TRAILER = b"\xff\xfe\xfd"  # appended by newer software when it saves a file again
_CALIBRATION_KINDS = ("ABS", "BSE", "LMP", "FO")


@dataclass(frozen=True, eq=False)
class AsdGps:
    """Position of the spectrometer by its GPS."""

    latitude: float  # degrees, north positive
    longitude: float  # degrees, east positive (in the file, west is positive)
    altitude: float  # metres
    utc: dt.time  # time of day of the fix; the file has no date of it


@dataclass(frozen=True, eq=False)
class AsdCalibration:
    """One calibration block of a file."""

    # ABS: panel reflectance; BSE: panel reflectance for radiance; LMP: lamp irradiance [W m-2 nm-1]; FO: lamp
    # counts
    kind: str
    name: str  # name of the calibration file that the block was copied from
    integration_ms: float  # integration time of the calibration, see `nominal_integration_ms`
    gains: tuple[int, int]  # SWIR 1 and SWIR 2
    values: Floats  # (wavelength)


def nominal_integration_ms(milliseconds: int) -> float:
    """Return the integration time for a nominal whole number of milliseconds.

    The file contains 8 or 9 if the instrument integrates for 8.5 ms; longer times (17, 34, 68 ...) are
    exact.

    Examples
    --------
    >>> nominal_integration_ms(9), nominal_integration_ms(136)
    (8.5, 136.0)
    """
    return 8.5 if milliseconds in (8, 9) else float(milliseconds)


class Cursor:
    """Reads a file from front to back and refuses to read past its end."""

    def __init__(self, data: bytes, name: str) -> None:
        self._data = data
        self._name = name
        self._position = 0

    def error(self, found: str, *, expected: str = "", mend: str = "", code: str) -> FormatError:
        return FormatError(f"{self._name}: {found}", expected=expected, mend=mend, code=code)

    @property
    def remaining(self) -> int:
        """Number of bytes not read yet."""
        return len(self._data) - self._position

    @property
    def at_end(self) -> bool:
        """Whether nothing, or only the trailer of newer software, remains to be read."""
        return self.remaining == 0 or self._data[self._position :] == _TRAILER

    def bytes(self, count: int, part: str) -> bytes:
        """Read bytes; ``part`` names them in messages."""
        if count > self.remaining:
            raise self.error(
                f"{part} needs {count} bytes at offset {self._position}, {self.remaining} remain",
                mend="copy the file again from the instrument",
                code="file-truncated",
            )
        self._position += count
        return self._data[self._position - count : self._position]

    def values(self, fmt: str, part: str) -> tuple[Any, ...]:
        """Read the values of a struct format, little-endian."""
        return struct.unpack("<" + fmt, self.bytes(struct.calcsize("<" + fmt), part))

    def text(self, part: str) -> str:
        """Read a text, which is stored after its length."""
        (length,) = self.values("H", f"the length of {part}")
        return _text_of_bytes(self.bytes(length, part))

    def array(self, count: int, dtype: np.dtype[Any], part: str) -> Floats:
        """Read ``count`` numbers as read-only float64."""
        raw = np.frombuffer(self.bytes(count * dtype.itemsize, part), dtype)
        with np.errstate(invalid="ignore"):  # signalling NaN in a damaged file
            values = raw.astype(np.float64)
        values.flags.writeable = False
        return values

    def safe_array(self, item_bytes: int, part: str) -> int:
        """Read the head of an OLE SAFEARRAY and return the number of items that follow."""
        (dims,) = self.values("H", part)
        if dims * 8 > self.remaining or dims > 60:
            raise self.error(f"{part} has {dims} dimensions", code="file-damaged")
        count = 1 if dims else 0
        for _ in range(dims):
            count *= self.values("Ii", part)[0]
        if count * item_bytes > self.remaining:
            raise self.error(
                f"{part} declares {count} items, which do not fit into the remaining {self.remaining} bytes",
                code="file-damaged",
            )
        return count


def _read_later_blocks(cursor: Cursor, version: int, channels: int) -> dict[str, AsdCalibration]:
    # Read the blocks that versions 6, 7 and 8 added; return the calibration blocks by kind.
    blocks: dict[str, AsdCalibration] = {}
    if version < 6 or (version == 6 and cursor.at_end):
        return blocks
    # classifier
    cursor.values("BB", "the classifier block")
    for _ in range(20):
        cursor.text("the classifier block")
    cursor.values("H", "the constituent count")
    for _ in range(cursor.safe_array(96, "the constituents")):
        cursor.text("a constituent")
        cursor.text("a constituent")
        cursor.values("9di2d", "a constituent")
    if version >= 7:
        # dependent variables
        cursor.values("hh", "the dependent variables")
        for _ in range(cursor.safe_array(2, "the labels of the dependent variables")):
            cursor.text("the label of a dependent variable")
        count = cursor.safe_array(4, "the dependent variables")
        cursor.bytes(4 * count, "the dependent variables")
        # calibration blocks: the heads of all, then the values of all
        (count,) = cursor.values("B", "the number of calibration blocks")
        heads = [cursor.values("b20sihh", "the head of a calibration block") for _ in range(count)]
        for number, name, milliseconds, *gains in heads:
            if not 0 <= number < len(_CALIBRATION_KINDS):
                raise cursor.error(
                    f"calibration block of type {number}", expected="0 to 3", code="file-damaged"
                )
            kind = _CALIBRATION_KINDS[number]
            if kind in blocks:
                raise cursor.error(
                    f"two calibration blocks of kind {kind}", expected="one of each", code="file-damaged"
                )
            values = cursor.array(channels, np.dtype("<f8"), f"the {kind} calibration block")
            ms = nominal_integration_ms(milliseconds)
            blocks[kind] = AsdCalibration(kind, _text_of_bytes(name), ms, (gains[0], gains[1]), values)
    if version >= 8:
        # audit log and signature
        cursor.values("i", "the audit count")
        for _ in range(cursor.safe_array(2, "the audit log")):
            cursor.text("an audit event")
        cursor.values("Bq", "the signature")
        for _ in range(7):
            cursor.text("the signature")
        cursor.bytes(128, "the signature")
    return blocks


def _gps_fix(cursor: Cursor, block: bytes) -> AsdGps | None:
    # Return the position in the GPS block of the header; None if the GPS had no fix.
    values = struct.unpack("<5dhbbbbbh5sbb", block)
    _, _, latitude, longitude, altitude, _, _, second, minute, hour = values[:10]
    if latitude == longitude == altitude == 0.0:
        return None
    try:
        if not abs(altitude) < 1e5:
            raise ValueError
        utc_time = dt.time(hour, minute, second)
        # in the file, west is positive
        return AsdGps(_degrees(latitude, 90.0), -_degrees(longitude, 180.0), altitude, utc_time)
    except ValueError as error:
        raise cursor.error(
            f"GPS position {latitude}, {longitude}, {altitude} m at {hour}:{minute}:{second}",
            expected="ddmm.mmmm, dddmm.mmmm and metres",
            code="file-damaged",
        ) from error


def _degrees(ddmm: float, limit: float) -> float:
    if not abs(ddmm) <= limit * 100.0:
        raise ValueError
    degrees, minutes = divmod(abs(ddmm), 100.0)
    if minutes >= 60.0:
        raise ValueError
    return math.copysign(degrees + minutes / 60.0, ddmm)


def _text_of_bytes(raw: bytes) -> str:
    return raw.split(b"\0", 1)[0].decode("latin-1").strip()
