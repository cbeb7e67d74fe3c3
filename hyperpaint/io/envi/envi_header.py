"""Meaning of the keys of an ENVI header: sizes, types, wavelengths, scale, map position.

Reading is bounded and linear in the length of the file, and all problems are raised together.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import FormatError
from hyperpaint.base.input_files import open_input
from hyperpaint.io.files.reading import decoded_text

from .envi_grammar import FILE_AXES, HeaderFindings, bare, scan, shown

MAX_HEADER_BYTES = 4 * 2**20
# The header of a library names every spectrum: about 400,000 of them.
MAX_LIBRARY_HEADER_BYTES = 16 * 2**20

_DTYPES = {
    "1": "u1",
    "2": "i2",
    "3": "i4",
    "4": "f4",
    "5": "f8",
    "6": "c8",
    "9": "c16",
    "12": "u2",
    "13": "u4",
    "14": "i8",
    "15": "u8",
}
_BYTE_ORDERS = {"0": "<", "1": ">"}

# nm per unit; ENVI's own words first
_NANOMETRES = {
    **dict.fromkeys(("nanometers", "nanometer", "nanometres", "nanometre", "nm"), 1.0),
    **dict.fromkeys(("micrometers", "micrometer", "micrometres", "micrometre", "microns", "micron"), 1e3),
    **dict.fromkeys(("um", "µm", "μm"), 1e3),
    **dict.fromkeys(("angstroms", "angstrom"), 0.1),
    **dict.fromkeys(("millimeters", "mm"), 1e6),
    **dict.fromkeys(("centimeters", "cm"), 1e7),
    **dict.fromkeys(("meters", "m"), 1e9),
}
_UNKNOWN_UNITS = ("", "unknown")
_NOT_WAVELENGTHS = ("wavenumber", "ghz", "mhz", "index")
_MAX_MICROMETRES = 100.0

_ITEM = re.compile(r"[^,\s]+")
_NAMED_WAVELENGTH = re.compile(
    r"(?<![0-9.])([0-9]{1,6}(?:\.[0-9]{1,9})?) ?(nm|um|[µμ]m|(?:nano|micro)met(?:er|re)s?|microns?)\b",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class MapInfo:
    """Map position of the pixels, from ``map info``."""

    projection: str  # Name of the projection, as written
    # Column and row of the reference point, counted from 1; (1, 1) is the outer upper-left corner of the
    # first pixel
    reference_pixel: tuple[float, float]
    reference: tuple[float, float]  # Map coordinates x, y of the reference
    pixel_size: tuple[float, float]  # Width and height of a pixel, both positive [map units]
    details: tuple[str, ...] = ()  # Zone, hemisphere and datum, as written
    units: str = ""  # Map units as written; empty if absent
    rotation: float = 0.0  # Angle of the grid [degree], as written


@dataclass(frozen=True, eq=False)
class EnviHeader:
    """Content of an ENVI header."""

    # lines, samples, bands: Size of the cube: along track, across track, spectral
    lines: int
    samples: int
    bands: int
    header_offset: int  # Bytes before the first sample of the data file
    dtype: np.dtype[Any]  # Type of a stored sample, byte order included
    # ``bil`` (line, band, sample), ``bip`` (line, sample, band) or ``bsq`` (band, line, sample)
    interleave: str
    # wavelength, fwhm: Values of the bands [nm], in the order of the file, which need not be monotonic; None
    # where unknown
    wavelength: Floats | None = None
    fwhm: Floats | None = None
    # False for bands that the header marks as bad; None without a bad band list
    good: npt.NDArray[np.bool_] | None = None
    band_names: tuple[str, ...] = ()  # As written; empty where absent
    data_ignore_value: int | float | None = None  # Stored value that means "no data"
    reflectance_scale_factor: float | None = None  # Stored value of a reflectance of 1
    # data_gain_values, data_offset_values: Per band: physical = stored * gain + offset
    data_gain_values: Floats | None = None
    data_offset_values: Floats | None = None
    map_info: MapInfo | None = None  # None for cubes in sensor geometry
    description: str = ""  # As written, without braces
    # Every key (lower case) and its raw text, in the order of the file, braces included
    fields: dict[str, str] = field(default_factory=dict)
    comments: dict[str, str] = field(default_factory=dict)  # ``;key = value`` lines, in the order of the file
    notes: tuple[str, ...] = ()  # Inferences and oddities
    warnings: tuple[str, ...] = ()  # Notes about possibly wrong values or wavelengths

    @property
    def line_bytes(self) -> int:
        """Bytes of one line, all bands."""
        return self.samples * self.bands * self.dtype.itemsize

    @property
    def file_type(self) -> str:
        """``file type`` in lower case; empty where absent."""
        return self.fields.get("file type", "").lower()

    @property
    def is_spectral_library(self) -> bool:
        """Whether each line is a spectrum and each sample a wavelength."""
        return "spectral library" in self.file_type


def read_header(path: str | os.PathLike[str], limit: int = MAX_HEADER_BYTES) -> EnviHeader:
    """Read an ENVI header file.

    ``path``: the ``.hdr`` file; ``limit``: its maximum size [byte].

    Raises `FormatError`: The file is not an ENVI header, is over the limit, or contradicts itself; all
    problems are listed. Raises `OSError`: The file cannot be read.
    """
    with open_input(path, "an ENVI header") as file:
        # read() allocates the requested size
        raw = file.read(min(os.fstat(file.fileno()).st_size, limit) + 1)
    name = f"ENVI header {os.fspath(path)!r}"
    if len(raw) > limit:
        raise FormatError(
            f"{name} cannot be read: it is over {limit >> 20} MB",
            mend="check that it is not the data file",
            code="file-too-large",
        )
    return parse_header(decoded_text(raw), name)


def parse_header(text: str, name: str = "ENVI header") -> EnviHeader:
    """Read the text of an ENVI header.

    ``text``: text from the line ``ENVI`` on; ``name``: its name in messages.

    Raises `FormatError`: The text is not an ENVI header or contradicts itself; all problems are listed.

    Examples
    --------
    >>> header = parse_header('''ENVI
    ... samples = 640
    ... lines = 2000
    ... bands = 3
    ... data type = 12
    ... interleave = bil
    ... byte order = 0
    ... wavelength = {0.45, 0.55, 0.65}
    ... ;Exposure (ms) = 5''')
    >>> header.wavelength
    array([450., 550., 650.])
    >>> header.notes
    ('no wavelength units: values below 100 taken as micrometres',)
    >>> header.comments["Exposure (ms)"]
    '5'
    """
    findings = HeaderFindings(name)
    scanned = scan(text, findings)
    if not scanned.fields:
        findings.raise_if_any()
        raise FormatError(f"{name} cannot be used: it holds no 'key = value' line", code="empty-input")
    reader = _Reader(scanned.fields, findings)
    lines, samples, bands = (reader.integer(key, minimum=1) for key in ("lines", "samples", "bands"))
    offset = reader.integer("header offset", minimum=0, default=0)
    # type and order of the samples
    code, order = reader.choice("data type", _DTYPES) or "u1", "<"
    if "byte order" in reader.fields:
        order = reader.choice("byte order", _BYTE_ORDERS) or "<"
    elif np.dtype(code).itemsize > 1:
        findings.note(
            "no byte order: assumed little-endian; add 'byte order = 0' (big-endian: 1) to the header",
            warn=True,
        )
    interleave = reader.choice("interleave", {name: name for name in FILE_AXES})
    for key in ("major frame offsets", "minor frame offsets"):
        text = reader.fields.get(key, "")
        if set(bare(text)) - set("0, \t\n"):
            findings.add(
                f"{key!r} is {shown(text)}: padded lines are not supported", code="layout-unsupported"
            )
    if reader.fields.get("file compression", "0") != "0":
        findings.add(
            "'file compression' is set",
            mend="unpack the data file and set it to 0",
            code="layout-unsupported",
        )
    # bands
    is_library = "spectral library" in scanned.fields.get("file type", "").lower()
    count, unit = (samples, "samples of a spectral library") if is_library else (bands, "bands")
    names = _band_names(reader, bands)
    wavelength, fwhm = _spectral_axis(reader, count, unit, names)
    good = reader.numbers("bbl", count, unit)
    if good is not None and not np.isin(good, (0.0, 1.0)).all():
        findings.add(
            "'bbl' holds values other than 0 (bad band) and 1 (good band)", code="value-out-of-range"
        )
    scale = reader.number("reflectance scale factor")
    if scale is not None and not (math.isfinite(scale) and scale > 0):
        findings.add(
            f"'reflectance scale factor' is {scale}", expected="a number above 0", code="value-out-of-range"
        )
    # integers stay integers: float64 cannot hold all 64-bit integers
    text = bare(reader.fields.get("data ignore value", ""))
    ignore: int | float | None
    if re.fullmatch(r"[-+]?[0-9]{1,20}", text):
        ignore = int(text)
    else:
        ignore = reader.number("data ignore value")
        if ignore is not None and ignore.is_integer() and abs(ignore) < 2**53:
            ignore = int(ignore)
    header = EnviHeader(
        lines=lines,
        samples=samples,
        bands=bands,
        header_offset=offset,
        dtype=np.dtype(order + code),
        interleave=interleave or "",
        wavelength=wavelength,
        fwhm=fwhm,
        good=None if good is None else good == 1.0,
        band_names=names,
        data_ignore_value=ignore,
        reflectance_scale_factor=scale,
        data_gain_values=reader.numbers("data gain values", bands, "bands"),
        data_offset_values=reader.numbers("data offset values", bands, "bands"),
        map_info=_map_info(reader),
        description=bare(scanned.fields.get("description", "")),
        fields=scanned.fields,
        comments=scanned.comments,
        notes=tuple(findings.notes),
        warnings=tuple(findings.warnings),
    )
    findings.raise_if_any()
    return header


class _Reader:
    # Converts and checks raw values; for a wrong value it notes a problem and returns None.
    def __init__(self, fields: Mapping[str, str], findings: HeaderFindings) -> None:
        self.fields = fields
        self.findings = findings

    def integer(self, key: str, *, minimum: int, default: int | None = None) -> int:
        text = self.fields.get(key)
        kind = "a whole number above 0" if minimum else "a whole number, 0 or above"
        if text is None:
            if default is None:
                self.findings.add(f"{key!r} is missing", expected=kind, code="key-missing")
            return default or 0
        if re.fullmatch(r"\+?[0-9]{1,30}", text) is None or int(text) < minimum:
            self.findings.add(f"{key!r} is {shown(text)}", expected=kind, code="value-out-of-range")
            return 0
        return int(text)

    def choice(self, key: str, allowed: Mapping[str, str]) -> str | None:
        text = self.fields.get(key)
        if text is not None and text.lower() in allowed:
            return allowed[text.lower()]
        stated = "missing" if text is None else shown(text)
        self.findings.add(
            f"{key!r} is {stated}", expected=f"one of {', '.join(allowed)}", code="choice-unknown"
        )
        return None

    def number(self, key: str) -> float | None:
        text = self.fields.get(key)
        if text is None or not bare(text):
            return None
        try:
            return _to_float(bare(text))
        except ValueError:
            self.findings.add(f"{key!r} is {shown(text)}", expected="one number", code="number-unreadable")
            return None

    def numbers(self, key: str, count: int, per: str) -> Floats | None:
        # Return a list with one finite number per band.
        text = bare(self.fields.get(key, ""))
        if not text or count < 1:  # no list, or a wrong count that is already noted
            return None
        # counted before it is split: millions of values become objects only for a cube of that size
        size = sum(1 for _ in _ITEM.finditer(text))
        if size != count:
            self.findings.add(
                f"{key!r} has {size} values for {count} {per}",
                expected=f"one for each, or no {key!r} at all",
                code="length-mismatch",
            )
            return None
        try:
            values = np.array([_to_float(item) for item in _ITEM.findall(text)], dtype=np.float64)
        except ValueError as error:
            self.findings.add(f"{key!r}: {error}", expected="numbers", code="number-unreadable")
            return None
        if not np.isfinite(values).all():
            position = int(np.flatnonzero(~np.isfinite(values))[0]) + 1
            self.findings.add(
                f"{key!r}: value {position} is {values[position - 1]}",
                expected="finite numbers",
                code="not-finite",
            )
            return None
        return values


def _to_float(text: str) -> float:
    # Return a number; unlike float(), refuse underscores and digits of other scripts.
    if len(text) <= 64 and text.isascii() and "_" not in text:
        try:
            return float(text)
        except ValueError:
            pass
    raise ValueError(f"{shown(text)} is not a number")


def _band_names(reader: _Reader, bands: int) -> tuple[str, ...]:
    text = bare(reader.fields.get("band names", "")).rstrip(", \t\n")
    count = text.count(",") + 1
    if text and count == bands:
        return tuple(name.strip() for name in text.split(","))
    if text and count > max(1000, 10 * bands):
        reader.findings.add(
            f"'band names' has {count} names for {bands} bands",
            mend="delete the list",
            code="length-mismatch",
        )
    elif text:
        reader.findings.note(f"'band names' has {count} names for {bands} bands: names ignored")
    return ()


def _spectral_axis(
    reader: _Reader, count: int, per: str, names: tuple[str, ...]
) -> tuple[Floats | None, Floats | None]:
    # Return wavelength and FWHM in nm.
    wavelength, fwhm = reader.numbers("wavelength", count, per), reader.numbers("fwhm", count, per)
    text = bare(reader.fields.get("wavelength units", ""))
    unit = text.lower()
    if wavelength is None and fwhm is None and "wavelength" not in reader.fields:
        return _wavelength_of_names(names, reader.findings), None
    if unit in _NOT_WAVELENGTHS:
        reader.findings.note(f"wavelength units are {text!r}: the lists are not read as wavelengths")
        return None, None
    if unit not in _UNKNOWN_UNITS and unit not in _NANOMETRES:
        reader.findings.add(
            f"'wavelength units' is {shown(text)}",
            expected="Nanometers, Micrometers, Angstroms, Millimeters, Centimeters, Meters, Wavenumber, "
            "GHz, MHz, Index or Unknown",
            code="choice-unknown",
        )
        return None, None
    if wavelength is None and "wavelength" not in reader.fields:
        wavelength = _wavelength_of_names(names, reader.findings)
        factor = _NANOMETRES.get(unit, 1.0)
        if unit in _UNKNOWN_UNITS:
            reader.findings.note("no wavelength units: 'fwhm' taken as nanometres")
    else:
        factor = _nanometres_per_unit(unit, wavelength, reader.findings)
        if wavelength is not None:
            wavelength = _in_nanometres(wavelength, factor, "wavelength", reader)
            if (wavelength <= 0).any():
                reader.findings.add(
                    "'wavelength' holds values that are not above 0", code="value-out-of-range"
                )
    if fwhm is not None and (fwhm < 0).any():
        reader.findings.add("'fwhm' holds values below 0", code="value-out-of-range")
    return wavelength, None if fwhm is None else _in_nanometres(fwhm, factor, "fwhm", reader)


def _in_nanometres(values: Floats, factor: float, name: str, reader: _Reader) -> Floats:
    with np.errstate(over="ignore"):
        nanometres: Floats = values * factor
    if not np.isfinite(nanometres).all():
        reader.findings.add(
            f"{name!r} holds values up to {values.max():.3g}, which is infinite in nanometres",
            code="not-finite",
        )
    return nanometres


def _nanometres_per_unit(unit: str, wavelength: Floats | None, findings: HeaderFindings) -> float:
    if wavelength is None or wavelength.size == 0:
        return _NANOMETRES.get(unit, 1.0)
    longest = float(wavelength.max())
    is_micrometres = longest < _MAX_MICROMETRES
    if unit in _UNKNOWN_UNITS:
        assumption = (
            "values below 100 taken as micrometres" if is_micrometres else "values taken as nanometres"
        )
        findings.note(f"no wavelength units: {assumption}")
        return 1e3 if is_micrometres else 1.0
    factor = _NANOMETRES[unit]
    if (factor == 1.0 and is_micrometres) or (factor == 1e3 and not is_micrometres):
        findings.note(
            f"wavelength units are {unit!r} but the longest wavelength is {longest:g}: check the unit",
            warn=True,
        )
    return factor


def _wavelength_of_names(names: tuple[str, ...], findings: HeaderFindings) -> Floats | None:
    # Return the wavelengths that GDAL writes into band names, such as ``399.356 nm``.
    centres = []
    for name in names:
        match = _NAMED_WAVELENGTH.search(name[:200])
        if match is None or float(match[1]) <= 0:
            return None
        centres.append(float(match[1]) * _NANOMETRES[match[2].lower()])
    if not centres:
        return None
    findings.note("no wavelength list: wavelengths taken from the band names")
    return np.array(centres, dtype=np.float64)


def _map_info(reader: _Reader) -> MapInfo | None:
    text = bare(reader.fields.get("map info", ""))
    if not text:
        return None
    items = [item.strip() for item in text[:10_000].split(",")]
    if items[0].lower() == "arbitrary":
        reader.findings.note("map info is 'Arbitrary': taken as sensor geometry")
        return None
    options = dict(item.lower().split("=", 1) for item in items if "=" in item)
    entries = [item for item in items if "=" not in item]
    try:
        column, row, x, y, width, height = map(_to_float, [*entries[1:7], *[""] * (7 - len(entries))])
        rotation = _to_float(options.get("rotation", "0").strip())
    except ValueError as error:
        reader.findings.add(
            f"'map info' is {shown(text)} ({error})",
            expected="projection, reference column and row, x, y, pixel width and height, then zone, datum, "
            "units=..., rotation=...",
            code="number-unreadable",
        )
        return None
    if not all(map(math.isfinite, (column, row, x, y, width, height, rotation))) or min(width, height) <= 0:
        reader.findings.add(
            f"'map info' is {shown(text)}",
            expected="finite numbers and sizes above 0",
            code="value-out-of-range",
        )
        return None
    return MapInfo(
        projection=entries[0],
        reference_pixel=(column, row),
        reference=(x, y),
        pixel_size=(width, height),
        details=tuple(entries[7:]),
        units=options.get("units", "").strip(),
        rotation=rotation,
    )
