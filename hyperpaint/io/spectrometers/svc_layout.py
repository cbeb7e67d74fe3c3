"""Layout of the text files of SVC field spectrometers (``.sig``, HR-512i to HR-1024i).

A first line that names the maker, ``key= value`` lines up to ``data=``, then a row a channel: wavelength
[nm], the scan of the white reference, the scan of the target, and their ratio in per cent, rounded. Numbers
follow the locale of the PC that saved the file: a decimal comma stands in rows and in the header, where a
comma *and a blank* separate the items of a list.
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

_MAX_BYTES = 4 * 2**20  # a hundred times the size of instrument files
_MAX_ROWS = 32_768
_MAX_HEADER_LINES = 1000
_MAX_DETECTORS = 3
_MAGIC = re.compile(rb"(?:\xef\xbb\xbf)?\s*/\*+[^\r\n]{0,80}Spectra Vista", re.IGNORECASE)
_NUMBER = re.compile(r"[-+]?(?:\d+(?:[.,]\d*)?|[.,]\d+)(?:[eE][-+]?\d{1,5})?", re.ASCII)
# text of Windows for ratios that do not exist
_NO_NUMBERS = {
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
    # Quantity of the scans of reference and target: ``radiance``, ``counts`` or ``irradiance``
    units: tuple[str, str]
    # Nanometres; they step back where a detector ends and the next one, which overlaps it, begins
    wavelength: Floats
    reference: Floats  # the two scans, in the file's numbers
    target: Floats
    percent: Floats  # their ratio as the file rounds it
    # Row of the first channel of each detector, found by a step back in wavelength; the first is 0
    starts: tuple[int, ...]

    @property
    def has_reference(self) -> bool:
        """False where no white reference was taken: its column then holds only 1, or only 0."""
        return not (np.all(self.reference == 1.0) or np.all(self.reference == 0.0))


def is_svc(head: bytes) -> bool:
    """Return whether the first bytes of a file are those of an SVC ``.sig`` file."""
    return _MAGIC.match(head) is not None


def read_svc(path: str | os.PathLike[str]) -> SvcFile:
    r"""Read one ``.sig`` file, of any firmware and locale.

    path: A file that an SVC spectrometer or its software saved.
    Returns SvcFile: Header and scans (wavelength).
    Raises FormatError: The file cannot be read, is no ``.sig`` file, or is truncated, damaged or
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
        ger = " (a GER file; SVC's software converts it)" if data[:6] == b"///GER" else ""
        raise FormatError(
            f"{path.name}: begins with {data[:24]!r}{ger}",
            expected="'/*** Spectra Vista SIG Data ***/' of an SVC .sig file",
            code="format-unknown",
        )
    lines = decoded_text(data.replace(b"\0", b"")).replace("\r\n", "\n").replace("\r", "\n").split("\n")
    header, first = _header(path.name, lines)
    wavelength, reference, target, percent = _table(path.name, lines, first)
    # a file that keeps the overlap has a row for every channel of its instrument
    model = _CHANNELS.search(header.get("instrument", ""))
    overlap_preserved = "overlap: preserve" in header.get("factors", "").partition("]")[0].lower()
    if model and overlap_preserved and len(wavelength) < int(model[1]):
        raise FormatError(
            f"{path.name}: {len(wavelength)} rows",
            expected=f"the {model[1]} channels of an HR-{model[1]} whose overlap is preserved",
            mend="copy the file again from the instrument",
            code="file-truncated",
        )
    words = [word.strip().lower() for word in header.get("units", "").split(",")]
    allowed = ("radiance", "counts", "irradiance")
    if len(words) == 1:
        words *= 2
    if len(words) != 2 or any(word not in allowed for word in words):
        line = repr(header["units"][:60]) if "units" in header else "no line 'units='"
        raise FormatError(
            f"{path.name}: {line}",
            expected="units= Radiance, Radiance (or Counts, Irradiance)",
            code="units-unknown",
        )
    units = words[0], words[1]
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


def _svc_number(text: str) -> float | None:
    """Return the number of a cell, with a point or a comma; None for other text.

    Examples
    --------
    >>> _svc_number("-5,1"), _svc_number("1.5E-02"), _svc_number("1,5,0")
    (-5.1, 0.015, None)
    """
    return float(text.replace(",", ".")) if _NUMBER.fullmatch(text) else _NO_NUMBERS.get(text.lower())


def _header(name: str, lines: list[str]) -> tuple[dict[str, str], int]:
    # The values by key, and the index of the first row of the table.
    header: dict[str, str] = {}
    last = ""
    for number, line in enumerate(lines[1 : _MAX_HEADER_LINES + 1], start=1):
        key, equals, value = line.partition("=")
        key = " ".join(key.lower().split())
        if key == "data" and equals and not value.strip():
            return header, number + 1
        if not equals:  # a comment may run over several lines
            if last and line.strip():
                header[last] = f"{header[last]}\n{line.strip()}"
            continue
        if header.setdefault(key, value.strip()) != value.strip():
            raise FormatError(
                f"{name}: the header has {key!r} twice with different values",
                mend="copy the file again",
                code="key-duplicate",
            )
        last = key
    raise FormatError(
        f"{name}: no line 'data=' among the first {_MAX_HEADER_LINES}",
        mend="copy the file again from the instrument",
        code="file-truncated",
    )


def _table(name: str, lines: list[str], first: int) -> list[Floats]:
    rows: list[list[float]] = []
    if len(lines) - first > _MAX_ROWS:
        raise FormatError(
            f"{name}: {len(lines) - first} rows", expected=f"at most {_MAX_ROWS}", code="file-too-large"
        )
    for number, line in enumerate(lines[first:], start=first + 1):
        if not line.strip():
            continue
        cells = line.replace("n. def.", "n.def.").split(None, 5)
        values = [value for cell in cells if (value := _svc_number(cell)) is not None]
        if len(cells) != 4 or len(values) != 4:
            raise FormatError(
                f"{name}: line {number} holds {line.strip()[:60]!r}",
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

    # True where all channels are there, False where channels were removed, None where the file is silent
    preserved: bool | None
    # Wavelengths [nm] at which the next detector takes over, where channels were removed
    joins: tuple[float, float] | None
    # How detectors were matched (``Radiance @ 976 - 1010 / NIR-SWIR On``); ``None`` where they were not,
    # empty where the file is silent. Matching scales the first detector by a ramp, and fades it into the
    # second up to the end of the range that is named
    matching: str
    # VNIR over SWIR1 in the overlap, for reference and target; NaN where unknown
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
    """Return the items of a list in the header; a comma without a blank behind it is a decimal comma.

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

    A file that was processed again holds a record a time, the latest first.

    Examples
    --------
    >>> line = "0.795, 0.848, 1.000 [Overlap: Remove @ 970,1901, Matching Type: None]"
    >>> overlap_of({"factors": line})
    SvcOverlap(preserved=False, joins=(970.0, 1901.0), matching='None', factors=(0.795, 0.848))
    """
    line = header.get("factors", "")[:_MAX_FACTORS_CHARS]
    records = _RECORD.findall(line)
    numbers, latest = records[0] if records else (line, "")
    values = [_svc_number(item) for item in items(numbers)]
    first, second = (math.nan if value is None else value for value in (*values, None, None)[:2])
    removed = _REMOVED.search(latest)
    word = latest.lower()
    preserved = True if "preserve" in word else False if "remove" in word else None
    matchings = [match[1].strip() for _, record in records if (match := _MATCHING.search(record))]
    applied = [text for text in matchings if text.lower() != "none"]
    return SvcOverlap(
        preserved=preserved,
        joins=(float(removed[1]), float(removed[2])) if removed else None,
        matching=applied[0] if applied else matchings[0] if matchings else "",
        factors=(first, second),
    )


def error_bits(header: Mapping[str, str]) -> tuple[int, int]:
    """Return the instrument's error bits of reference and target, -1 where missing."""
    first, second = (int(text) if _BITS.fullmatch(text) else -1 for text in pair(header, "error"))
    return first, second


def position_of(header: Mapping[str, str], scan: int) -> tuple[float, float] | None:
    """Return latitude and longitude [degree], north and east positive, NaN without a fix.

    None where something else stands there.

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
    missing = not math.isfinite(latitude + longitude) or latitude == longitude == 0.0
    return (math.nan, math.nan) if missing else (latitude, longitude)


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
