"""Layout of the text files of SVC field spectrometers (``.sig``, HR-512i to HR-1024i).

The first line contains the maker's name. Lines ``key= value`` follow up to ``data=``, then one row for each
channel: wavelength [nm], the scan of the white reference, the scan of the target, and their ratio in per
cent, rounded. Numbers follow the locale of the PC that saved the file, in rows and header: a comma may be a
decimal comma, and only a comma *and a blank* separate the items of a list.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import FormatError
from hyperpaint.io.files.reading import decoded_text, read_limited_text

_MAX_BYTES = 4 * 2**20  # a hundred times the size of usual files
_MAX_ROWS = 32_768
_MAX_HEADER_LINES = 1000
_MAX_DETECTORS = 3
_MAGIC = re.compile(rb"(?:\xef\xbb\xbf)?\s*/\*+[^\r\n]{0,80}Spectra Vista", re.IGNORECASE)
_NUMBER = re.compile(r"[-+]?(?:\d+(?:[.,]\d*)?|[.,]\d+)(?:[eE][-+]?\d{1,5})?", re.ASCII)
# NaN and infinity as Windows' software prints them, in several languages
_NON_FINITE_SPELLINGS = {
    **dict.fromkeys(("nan", "-nan", "n.def.", "1.#qnan", "-1.#ind"), math.nan),
    **dict.fromkeys(("infinity", "+unendlich", "\N{INFINITY}", "1.#inf"), math.inf),
    **dict.fromkeys(("-infinity", "-unendlich", "-\N{INFINITY}", "-1.#inf"), -math.inf),
}
_CHANNELS = re.compile(r"HR-(\d{3,4})(?!\d)")


@dataclass(frozen=True, eq=False)
class SvcFile:
    """Content of one ``.sig`` file; arrays are (wavelength), float64, read-only, in file order."""

    name: str  # file name without its folder
    header: Mapping[str, str]  # values by key (lower case), as text
    # Quantities of reference and target: ``radiance``, ``counts`` or ``irradiance``
    units: tuple[str, str]
    # Nanometres; they step back where the next detector begins, because detectors overlap
    wavelength: Floats
    reference: Floats  # scan of the white reference, in the file's units
    target: Floats  # scan of the target, in the file's units
    percent: Floats  # ratio of target and reference in the file, rounded
    # First row of each detector, found by the steps back in wavelength; the first is 0
    starts: tuple[int, ...]

    @property
    def has_reference(self) -> bool:
        """Whether a white reference was measured; without one, its column contains only 1, or only 0."""
        return not (np.all(self.reference == 1.0) or np.all(self.reference == 0.0))


def is_svc(head: bytes) -> bool:
    """Return whether the first bytes of a file are those of an SVC ``.sig`` file."""
    return _MAGIC.match(head) is not None


def read_svc(path: str | os.PathLike[str]) -> SvcFile:
    r"""Read one ``.sig`` file, of any firmware and locale.

    path: A file that an SVC spectrometer or its software saved.
    Returns SvcFile: Header and scans (wavelength).
    Raises FormatError: The file cannot be read, is not a ``.sig`` file, or is truncated, damaged or
        contradictory.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp(), "paint.sig")
    >>> text = "/*** Spectra Vista SIG Data ***/\nunits= Radiance, Radiance\ndata= \n"
    >>> _ = path.write_text(text + "550,1  8000,00  400,00  5,00\n551,5  8000,00  800,00  10,00\n")
    >>> read_svc(path).target
    array([400., 800.])
    """
    path = Path(path)
    data = read_limited_text(path, _MAX_BYTES, "an SVC spectrometer's file")
    if not is_svc(data[:200]):
        ger_hint = " (a GER file; SVC's software converts it)" if data[:6] == b"///GER" else ""
        raise FormatError(
            f"{path.name}: begins with {data[:24]!r}{ger_hint}",
            expected="'/*** Spectra Vista SIG Data ***/' of an SVC .sig file",
            code="format-unknown",
        )
    lines = decoded_text(data.replace(b"\0", b"")).replace("\r\n", "\n").replace("\r", "\n").split("\n")
    header, first_row = _header(path.name, lines)
    wavelength, reference, target, percent = _table(path.name, lines, first_row)
    # a file with preserved overlap has one row for each channel of its instrument
    model = _CHANNELS.search(header.get("instrument", ""))
    is_overlap_preserved = "overlap: preserve" in header.get("factors", "").partition("]")[0].lower()
    if model and is_overlap_preserved and len(wavelength) < int(model[1]):
        raise FormatError(
            f"{path.name}: {len(wavelength)} rows",
            expected=f"the {model[1]} channels of an HR-{model[1]} whose overlap is preserved",
            mend="copy the file again from the instrument",
            code="file-truncated",
        )
    unit_words = [word.strip().lower() for word in header.get("units", "").split(",")]
    allowed = ("radiance", "counts", "irradiance")
    if len(unit_words) == 1:
        unit_words *= 2
    if len(unit_words) != 2 or any(word not in allowed for word in unit_words):
        line = repr(header["units"][:60]) if "units" in header else "no line 'units='"
        raise FormatError(
            f"{path.name}: {line}",
            expected="units= Radiance, Radiance (or Counts, Irradiance)",
            code="units-unknown",
        )
    units = unit_words[0], unit_words[1]
    if not np.all((wavelength > 0.0) & (wavelength < 1e5)):
        raise FormatError(
            f"{path.name}: wavelengths are not all positive numbers of nanometres",
            mend="copy the file again",
            code="wavelength-range",
        )
    # wavelengths step back where the next detector begins
    starts = (0, *(int(step) + 1 for step in np.flatnonzero(np.diff(wavelength) <= 0.0)))
    if len(starts) > _MAX_DETECTORS:
        raise FormatError(
            f"{path.name}: the wavelengths step back {len(starts) - 1} times",
            expected=f"at most {_MAX_DETECTORS - 1} times, where detectors overlap",
            mend="copy the file again",
            code="wavelength-unordered",
        )
    return SvcFile(
        name=path.name,
        header=MappingProxyType(header),
        units=units,
        wavelength=wavelength,
        reference=reference,
        target=target,
        percent=percent,
        starts=starts,
    )


def _cell_number(text: str) -> float | None:
    """Return the number of a cell, with a point or a comma; None for other text.

    Examples
    --------
    >>> _cell_number("-5,1"), _cell_number("1.5E-02"), _cell_number("1,5,0")
    (-5.1, 0.015, None)
    """
    return (
        float(text.replace(",", ".")) if _NUMBER.fullmatch(text) else _NON_FINITE_SPELLINGS.get(text.lower())
    )


def _header(name: str, lines: list[str]) -> tuple[dict[str, str], int]:
    # Return the values by key, and the index of the line at which the table begins.
    header: dict[str, str] = {}
    last_key = ""
    for line_number, line in enumerate(lines[1 : _MAX_HEADER_LINES + 1], start=1):
        key, equals, value = line.partition("=")
        key = " ".join(key.lower().split())
        if key == "data" and equals and not value.strip():
            return header, line_number + 1
        if not equals:  # a comment may have several lines
            if last_key and line.strip():
                header[last_key] = f"{header[last_key]}\n{line.strip()}"
            continue
        if header.setdefault(key, value.strip()) != value.strip():
            raise FormatError(
                f"{name}: the header has {key!r} twice with different values",
                mend="copy the file again",
                code="key-duplicate",
            )
        last_key = key
    raise FormatError(
        f"{name}: no line 'data=' among the first {_MAX_HEADER_LINES}",
        mend="copy the file again from the instrument",
        code="file-truncated",
    )


def _table(name: str, lines: list[str], first_row: int) -> list[Floats]:
    rows: list[list[float]] = []
    if len(lines) - first_row > _MAX_ROWS:
        raise FormatError(
            f"{name}: {len(lines) - first_row} rows", expected=f"at most {_MAX_ROWS}", code="file-too-large"
        )
    for line_number, line in enumerate(lines[first_row:], start=first_row + 1):
        if not line.strip():
            continue
        cells = line.replace("n. def.", "n.def.").split(None, 5)
        values = [value for cell in cells if (value := _cell_number(cell)) is not None]
        if len(cells) != 4 or len(values) != 4:
            raise FormatError(
                f"{name}: line {line_number} holds {line.strip()[:60]!r}",
                expected="four numbers (wavelength, reference, target, percent)",
                mend="copy the file again",
                code="row-unreadable",
            )
        rows.append(values)
    if len(rows) < 2:
        raise FormatError(
            f"{name}: {len(rows)} rows",
            expected="a spectrum",
            mend="copy the file again",
            code="table-missing",
        )
    columns = [np.ascontiguousarray(column) for column in np.array(rows, np.float64).T]
    for column in columns:
        column.flags.writeable = False
    return columns


DETECTORS = ("VNIR", "SWIR1", "SWIR2")

_ITEM = re.compile(r",(?=\s|$)")
_RECORD = re.compile(r"([^\[\]]*)\[([^\[\]]*)\]?")
_REMOVED = re.compile(r"remove\s*@\s*(\d{3,4})(?:[.,]0)?\s*,\s*(\d{3,4})(?![\d])", re.IGNORECASE)
_MATCHING = re.compile(r"matching type:\s*([^\]]*)", re.IGNORECASE)
_ANGLE = re.compile(r"(\d{3,5})[.,](\d{1,8})\s*,?\s*([NSEW])", re.ASCII | re.IGNORECASE)
_MAX_FACTORS_CHARS = 2000  # leading characters that are parsed
_BITS = re.compile(r"[0-9]{1,9}")


@dataclass(frozen=True)
class SvcOverlap:
    """Treatment of overlapping detectors, from the header's ``factors``."""

    # True if all channels remain, False if channels were removed, None if unknown
    preserved: bool | None
    # Wavelengths [nm] at which the next detector begins, if channels were removed
    joins: tuple[float, float] | None
    # How detectors were matched (``Radiance @ 976 - 1010 / NIR-SWIR On``); ``None`` if they were not, empty
    # if unknown. Matching multiplies the first detector by a ramp, and fades it into the second up to the end
    # of this range
    matching: str
    # Ratio of VNIR to SWIR1 in the overlap, for reference and target; NaN if unknown
    factors: tuple[float, float]

    @property
    def matched(self) -> bool:
        """Whether the values were matched."""
        return self.matching.lower() not in ("", "none")

    @property
    def text(self) -> str:
        """Short description."""
        if self.joins is not None:
            return f"removed @ {self.joins[0]:g}, {self.joins[1]:g} nm"
        return {True: "preserved", False: "removed", None: "unknown"}[self.preserved]


def items(value: str) -> list[str]:
    """Return the items of a list in the header; a comma without a blank after it is a decimal comma.

    Examples
    --------
    >>> items("1000,0, 40,0, 10,0"), items("                ,                 ")
    (['1000,0', '40,0', '10,0'], ['', ''])
    """
    return [item.strip() for item in _ITEM.split(value)]


def pair(header: Mapping[str, str], key: str) -> tuple[str, str]:
    """Return the texts for reference and target, empty where missing."""
    entries = items(header.get(key, ""))
    return (entries[0], entries[1]) if len(entries) == 2 else ("", entries[0] if len(entries) == 1 else "")


def overlap_of(header: Mapping[str, str]) -> SvcOverlap:
    """Return the content of the header's ``factors``.

    Each processing of a file adds a record; the latest comes first.

    Examples
    --------
    >>> line = "0.795, 0.848, 1.000 [Overlap: Remove @ 970,1901, Matching Type: None]"
    >>> overlap_of({"factors": line})
    SvcOverlap(preserved=False, joins=(970.0, 1901.0), matching='None', factors=(0.795, 0.848))
    """
    factors_text = header.get("factors", "")[:_MAX_FACTORS_CHARS]
    records = _RECORD.findall(factors_text)
    numbers, latest = records[0] if records else (factors_text, "")
    values = [_cell_number(item) for item in items(numbers)]
    first, second = (math.nan if value is None else value for value in (*values, None, None)[:2])
    removal_match = _REMOVED.search(latest)
    text_lower = latest.lower()
    preserved = True if "preserve" in text_lower else False if "remove" in text_lower else None
    matchings = [match[1].strip() for _, record in records if (match := _MATCHING.search(record))]
    applied = [text for text in matchings if text.lower() != "none"]
    return SvcOverlap(
        preserved=preserved,
        joins=(float(removal_match[1]), float(removal_match[2])) if removal_match else None,
        matching=applied[0] if applied else matchings[0] if matchings else "",
        factors=(first, second),
    )


def error_bits(header: Mapping[str, str]) -> tuple[int, int]:
    """Return the instrument's error bits of reference and target, -1 where missing."""
    first, second = (int(text) if _BITS.fullmatch(text) else -1 for text in pair(header, "error"))
    return first, second


def position_of(header: Mapping[str, str], scan: int) -> tuple[float, float] | None:
    """Return latitude and longitude [degree], north and east positive, NaN without a fix.

    None if the header's texts are not positions.

    scan: 0 for the reference, 1 for the target.

    Examples
    --------
    >>> position_of({"latitude": "5230.0000N , 5215.0000S", "longitude": "01332.0665E, 01345.0000W"}, 1)
    (-52.25, -13.75)
    """
    try:
        latitude = _angle(header.get("latitude", ""), scan, "NS", 90.0)
        longitude = _angle(header.get("longitude", ""), scan, "EW", 180.0)
    except ValueError:
        return None
    has_no_fix = not math.isfinite(latitude + longitude) or latitude == longitude == 0.0
    return (math.nan, math.nan) if has_no_fix else (latitude, longitude)


def _angle(value: str, scan: int, letters: str, limit: float) -> float:
    entries = items(value)
    # old firmware puts a comma before the letter: 11121.2335,W, 11121.2324,W
    text = entries[scan] if len(entries) == 2 else ""
    if not text.strip(", "):
        return math.nan
    match = _ANGLE.fullmatch(text)
    if match is None or match[3].upper() not in letters:
        raise ValueError
    degrees, minutes = int(match[1]) // 100, int(match[1]) % 100 + float(f"0.{match[2]}")
    angle = degrees + minutes / 60.0
    if minutes >= 60.0 or angle > limit:
        raise ValueError
    return -angle if match[3].upper() == letters[1] else angle


def detectors_of(file: SvcFile, joins: tuple[float, float] | None) -> npt.NDArray[np.int64] | None:
    """Return the number of the detector of each channel, None where unknown."""
    if len(file.starts) > 1:
        number = np.zeros(len(file.wavelength), np.int64)
        for start in file.starts[1:]:
            number[start:] += 1
        return number
    return None if joins is None else np.searchsorted(np.array(sorted(joins)), file.wavelength)
