"""Layout of the text files of SVC field spectrometers (``.sig``, HR-512i to HR-1024i).

A first line that names the maker, ``key= value`` lines up to ``data=``, then a row a channel: wavelength
[nm], the scan of the white reference, the scan of the target, and their ratio in per cent, rounded. Numbers
follow the locale of the PC that saved the file: a decimal comma stands in rows and in the header, where a
comma *and a blank* separate the items of a list. What each key means is read in `svc_fields`.
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

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import FormatError
from hyperpaint.io.files.reading import decoded_text, read_limited_text

__all__ = ["SvcFile", "is_svc", "read_svc", "svc_number"]


_LARGEST_FILE = 4 * 2**20  # a hundred times what the instruments write
_MOST_ROWS = 32_768
_MOST_HEADER_LINES = 1000
_MOST_DETECTORS = 3
_MAGIC = re.compile(rb"(?:\xef\xbb\xbf)?\s*/\*+[^\r\n]{0,80}Spectra Vista", re.IGNORECASE)
_NUMBER = re.compile(r"[-+]?(?:\d+(?:[.,]\d*)?|[.,]\d+)(?:[eE][-+]?\d{1,5})?", re.ASCII)
# what Windows writes where a ratio does not exist
_NO_NUMBERS = {
    "nan": math.nan,
    "-nan": math.nan,
    "n.def.": math.nan,
    "1.#qnan": math.nan,
    "-1.#ind": math.nan,
    "infinity": math.inf,
    "-infinity": -math.inf,
    "+unendlich": math.inf,
    "-unendlich": -math.inf,
    "\N{INFINITY}": math.inf,
    "-\N{INFINITY}": -math.inf,
    "1.#inf": math.inf,
    "-1.#inf": -math.inf,
}
_CHANNELS = re.compile(r"HR-(\d{3,4})(?!\d)")


@dataclass(frozen=True, eq=False)
class SvcFile:
    """What one ``.sig`` file holds; arrays are (wavelength), float64 and read-only, in the file's order.

    Attributes
    ----------
    name
        File name without its folder.
    header
        Values by key (lower case), as text.
    units
        What the scans of reference and target are in: ``radiance``, ``counts`` or ``irradiance``.
    wavelength
        Nanometres; they step back where a detector ends and the next one, which overlaps it, begins.
    reference, target
        The two scans, in the file's numbers.
    percent
        Their ratio as the file rounds it.
    starts
        Row of the first channel of each detector that is told by a step back; the first is 0.
    """

    name: str
    header: Mapping[str, str]
    units: tuple[str, str]
    wavelength: Floats
    reference: Floats
    target: Floats
    percent: Floats
    starts: tuple[int, ...]

    @property
    def has_reference(self) -> bool:
        """False where no white reference was taken: its column then holds nothing but 1, or 0."""
        return not (np.all(self.reference == 1.0) or np.all(self.reference == 0.0))


def is_svc(head: bytes) -> bool:
    """Tell from its first bytes whether a file is a ``.sig`` file of an SVC spectrometer."""
    return _MAGIC.match(head) is not None


def read_svc(path: str | os.PathLike[str]) -> SvcFile:
    r"""Read one ``.sig`` file, of any firmware and locale.

    Parameters
    ----------
    path
        A file that an SVC spectrometer or its software saved.

    Returns
    -------
    SvcFile
        Header and scans (wavelength).

    Raises
    ------
    FormatError
        The file cannot be read, is no ``.sig`` file, or is truncated, damaged or contradictory.

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
    data = read_limited_text(path, _LARGEST_FILE, "an SVC spectrometer's file")
    if not is_svc(data[:200]):
        ger = " (a GER file; SVC's software converts it)" if data[:6] == b"///GER" else ""
        raise FormatError(
            f"{path.name}: begins with {data[:24]!r}{ger}, expected '/*** Spectra Vista SIG Data ***/': "
            "not an SVC .sig file"
        )
    lines = decoded_text(data.replace(b"\0", b"")).replace("\r\n", "\n").replace("\r", "\n").split("\n")
    header, first = _header(path.name, lines)
    wavelength, reference, target, percent = _table(path.name, lines, first)
    _refuse_truncated(path.name, header, len(wavelength))
    return SvcFile(
        name=path.name,
        header=MappingProxyType(header),
        units=_units(path.name, header),
        wavelength=wavelength,
        reference=reference,
        target=target,
        percent=percent,
        starts=_detector_starts(path.name, wavelength),
    )


def svc_number(text: str) -> float | None:
    """Return the number that a cell holds, with a point or a comma; None where it is none.

    Examples
    --------
    >>> svc_number("-5,1"), svc_number("1.5E-02"), svc_number("1,5,0")
    (-5.1, 0.015, None)
    """
    if _NUMBER.fullmatch(text):
        return float(text.replace(",", "."))
    return _NO_NUMBERS.get(text.lower())


def _header(name: str, lines: list[str]) -> tuple[dict[str, str], int]:
    """Return the values by key, and the number of the first row of the table."""
    header: dict[str, str] = {}
    last = ""
    for number, line in enumerate(lines[1 : _MOST_HEADER_LINES + 1], start=1):
        key, equals, value = line.partition("=")
        key = " ".join(key.lower().split())
        if key == "data" and equals and not value.strip():
            return header, number + 1
        if not equals:  # a comment may run over several lines
            if last and line.strip():
                header[last] = f"{header[last]}\n{line.strip()}"
            continue
        if header.setdefault(key, value.strip()) != value.strip():
            raise FormatError(f"{name}: {key!r} stands twice in the header and differs; the file is damaged")
        last = key
    raise FormatError(
        f"{name}: no line 'data=' among the first {_MOST_HEADER_LINES}, so no spectrum: the file is "
        "truncated; copy it again from the instrument"
    )


def _table(name: str, lines: list[str], first: int) -> list[Floats]:
    rows: list[list[float]] = []
    if len(lines) - first > _MOST_ROWS:
        raise FormatError(
            f"{name}: {len(lines) - first} rows, expected at most {_MOST_ROWS}; the file is damaged"
        )
    for number, line in enumerate(lines[first:], start=first + 1):
        if not line.strip():
            continue
        cells = line.replace("n. def.", "n.def.").split(None, 5)
        values = [value for cell in cells if (value := svc_number(cell)) is not None]
        if len(cells) != 4 or len(values) != 4:
            raise FormatError(
                f"{name}: line {number} holds {line.strip()[:60]!r}, expected four numbers (wavelength, "
                "reference, target, per cent): the file is truncated or damaged; copy it again"
            )
        rows.append(values)
    if len(rows) < 2:
        raise FormatError(
            f"{name}: {len(rows)} rows, expected a spectrum; copy the file again from the instrument"
        )
    made = [np.ascontiguousarray(column) for column in np.array(rows, np.float64).T]
    for column in made:
        column.flags.writeable = False
    return made


def _detector_starts(name: str, wavelength: Floats) -> tuple[int, ...]:
    if not np.all((wavelength > 0.0) & (wavelength < 1e5)):
        raise FormatError(
            f"{name}: wavelengths that are not positive numbers of nanometres; the file is damaged"
        )
    starts = (0, *(int(step) + 1 for step in np.flatnonzero(np.diff(wavelength) <= 0.0)))
    if len(starts) > _MOST_DETECTORS:
        raise FormatError(
            f"{name}: the wavelengths step back {len(starts) - 1} times, expected at most "
            f"{_MOST_DETECTORS - 1} (where detectors overlap); the file is damaged"
        )
    return starts


def _refuse_truncated(name: str, header: Mapping[str, str], rows: int) -> None:
    """Refuse a file that keeps the overlap and still has fewer rows than its instrument has channels."""
    found = _CHANNELS.search(header.get("instrument", ""))
    kept = "overlap: preserve" in header.get("factors", "").partition("]")[0].lower()
    if found and kept and rows < int(found[1]):
        raise FormatError(
            f"{name}: {rows} rows, expected the {found[1]} channels of an HR-{found[1]} whose overlap is "
            "preserved: the file is truncated; copy it again from the instrument"
        )


def _units(name: str, header: Mapping[str, str]) -> tuple[str, str]:
    words = [word.strip().lower() for word in header.get("units", "").split(",")]
    known = ("radiance", "counts", "irradiance")
    if len(words) == 1:
        words *= 2
    if len(words) != 2 or any(word not in known for word in words):
        found = repr(header["units"][:60]) if "units" in header else "no line 'units='"
        raise FormatError(
            f"{name}: {found}, expected units= Radiance, Radiance (or Counts, or Irradiance): damaged"
        )
    return words[0], words[1]
