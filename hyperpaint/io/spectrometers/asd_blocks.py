"""Blocks of an ``.asd`` file behind its spectra (calibration, classifier, audit log), and its GPS block."""

from __future__ import annotations

import datetime as dt
import math
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import FormatError

__all__ = [
    "AsdCalibration",
    "AsdGps",
    "Cursor",
    "nominal_integration_ms",
    "parse_gps",
    "plain_text",
    "read_later_blocks",
]


_TRAILER = b"\xff\xfe\xfd"  # newer software appends it to files that it saves again
_CALIBRATION_KINDS = ("ABS", "BSE", "LMP", "FO")


@dataclass(frozen=True, eq=False)
class AsdGps:
    """Position that the spectrometer's GPS gave.

    Attributes
    ----------
    latitude, longitude
        Degrees, north and east positive (the file itself counts west positive).
    altitude
        Metres.
    utc
        Time of day of the fix; the date is not in the file.
    """

    latitude: float
    longitude: float
    altitude: float
    utc: dt.time


@dataclass(frozen=True, eq=False)
class AsdCalibration:
    """One calibration block.

    Attributes
    ----------
    kind
        ABS panel reflectance, BSE panel for radiance, LMP lamp irradiance [W m-2 nm-1], FO lamp counts.
    name
        File the block was copied from.
    integration_ms
        Integration time of the calibration, see `nominal_integration_ms`.
    gains
        SWIR 1 and SWIR 2.
    values
        (wavelength).
    """

    kind: str
    name: str
    integration_ms: float
    gains: tuple[int, int]
    values: Floats


def nominal_integration_ms(milliseconds: int) -> float:
    """Return the integration time that a nominal whole number of milliseconds stands for.

    The file says 8 or 9 where the instrument integrates for 8.5 ms; the longer times (17, 34, 68 ...) are
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
        self._at = 0

    def error(self, problem: str) -> FormatError:
        """Return an error that names the file."""
        return FormatError(f"{self._name}: {problem}")

    @property
    def left(self) -> int:
        """Bytes not read yet."""
        return len(self._data) - self._at

    @property
    def at_end(self) -> bool:
        """True where nothing follows but what newer software appends."""
        return self.left == 0 or self._data[self._at :] == _TRAILER

    def bytes(self, count: int, what: str) -> bytes:
        """Read bytes; ``what`` names them in messages."""
        if count > self.left:
            raise self.error(
                f"{what} needs {count} bytes at offset {self._at}, {self.left} are left: "
                "the file is truncated or damaged; copy it again from the instrument"
            )
        self._at += count
        return self._data[self._at - count : self._at]

    def values(self, fmt: str, what: str) -> tuple[Any, ...]:
        """Read the values of a struct format, little-endian."""
        return struct.unpack("<" + fmt, self.bytes(struct.calcsize("<" + fmt), what))

    def text(self, what: str) -> str:
        """Read a text that its length precedes."""
        (length,) = self.values("H", f"the length of {what}")
        return plain_text(self.bytes(length, what))

    def array(self, count: int, dtype: np.dtype[Any], what: str) -> Floats:
        """Read ``count`` numbers as read-only float64."""
        raw = np.frombuffer(self.bytes(count * dtype.itemsize, what), dtype)
        with np.errstate(invalid="ignore"):  # signalling NaN in a damaged file
            made = raw.astype(np.float64)
        made.flags.writeable = False
        return made

    def safe_array(self, item_bytes: int, what: str) -> int:
        """Read the head of an OLE SAFEARRAY and return how many items follow."""
        (dims,) = self.values("H", what)
        if dims * 8 > self.left or dims > 60:
            raise self.error(f"{what} has {dims} dimensions: the file is damaged")
        count = 1 if dims else 0
        for _ in range(dims):
            count *= self.values("Ii", what)[0]
        if count * item_bytes > self.left:
            raise self.error(f"{what} declares {count} items, more than the {self.left} bytes left can hold")
        return count


def read_later_blocks(cursor: Cursor, version: int, channels: int) -> dict[str, AsdCalibration]:
    """Read what versions 6, 7 and 8 added, and return the calibration blocks by kind."""
    if version < 6 or (version == 6 and cursor.at_end):
        return {}
    _classifier(cursor)
    calibrations = {}
    if version >= 7:
        _dependent_variables(cursor)
        calibrations = _calibrations(cursor, channels)
    if version >= 8:
        cursor.values("i", "the audit count")
        for _ in range(cursor.safe_array(2, "the audit log")):
            cursor.text("an audit event")
        cursor.values("Bq", "the signature")
        for _ in range(7):
            cursor.text("the signature")
        cursor.bytes(128, "the signature")
    return calibrations


def _classifier(cursor: Cursor) -> None:
    cursor.values("BB", "the classifier block")
    for _ in range(20):
        cursor.text("the classifier block")
    cursor.values("H", "the constituent count")
    for _ in range(cursor.safe_array(96, "the constituents")):
        cursor.text("a constituent")
        cursor.text("a constituent")
        cursor.values("9di2d", "a constituent")


def _dependent_variables(cursor: Cursor) -> None:
    cursor.values("hh", "the dependent variables")
    for _ in range(cursor.safe_array(2, "the labels of the dependent variables")):
        cursor.text("the label of a dependent variable")
    count = cursor.safe_array(4, "the dependent variables")
    cursor.bytes(4 * count, "the dependent variables")


def _calibrations(cursor: Cursor, channels: int) -> dict[str, AsdCalibration]:
    (count,) = cursor.values("B", "the number of calibration blocks")
    heads = [cursor.values("b20sihh", "the head of a calibration block") for _ in range(count)]
    blocks: dict[str, AsdCalibration] = {}
    for code, name, milliseconds, *gains in heads:
        if not 0 <= code < len(_CALIBRATION_KINDS):
            raise cursor.error(f"calibration block of type {code}, expected 0 to 3: damaged")
        kind = _CALIBRATION_KINDS[code]
        if kind in blocks:
            raise cursor.error(f"two calibration blocks of kind {kind}, expected one of each: damaged")
        values = cursor.array(channels, np.dtype("<f8"), f"the {kind} calibration block")
        integration_ms = nominal_integration_ms(milliseconds)
        blocks[kind] = AsdCalibration(kind, plain_text(name), integration_ms, (gains[0], gains[1]), values)
    return blocks


def parse_gps(cursor: Cursor, block: bytes) -> AsdGps | None:
    """Return the fix in the header's GPS block, None where there is none."""
    values = struct.unpack("<5dhbbbbbh5sbb", block)
    _, _, latitude, longitude, altitude, _, _, second, minute, hour = values[:10]
    if latitude == longitude == altitude == 0.0:
        return None
    try:
        fix = dt.time(hour, minute, second)
        # west positive in the file
        return AsdGps(_degrees(latitude, 90.0), -_degrees(longitude, 180.0), _metres(altitude), fix)
    except ValueError as error:
        raise cursor.error(
            f"GPS position {latitude}, {longitude}, {altitude} m at {hour}:{minute}:{second}, "
            "expected ddmm.mmmm, dddmm.mmmm and metres: damaged"
        ) from error


def _degrees(ddmm: float, limit: float) -> float:
    if not abs(ddmm) <= limit * 100.0:
        raise ValueError
    degrees, minutes = divmod(abs(ddmm), 100.0)
    if minutes >= 60.0:
        raise ValueError
    return math.copysign(degrees + minutes / 60.0, ddmm)


def _metres(altitude: float) -> float:
    if not abs(altitude) < 1e5:
        raise ValueError
    return altitude


def plain_text(raw: bytes) -> str:
    """Return the text before the first NUL."""
    return raw.split(b"\0", 1)[0].decode("latin-1").strip()
