"""ENVI headers: their grammar, and the meaning of keys: sizes, types, wavelengths, scale, map position.

A header is text: a first line ``ENVI``, then ``key = value`` lines; a value that begins with a brace extends
to the next closing brace. Lines that begin with a semicolon are comments, in which Headwall cameras store
their metadata. Reading is bounded and linear in the length of the file, and all problems are raised together.
"""

from __future__ import annotations

import io
import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import FormatError, Problems
from hyperpaint.base.input_files import open_input
from hyperpaint.io.files.reading import decoded_text

MAX_HEADER_BYTES = 4 * 2**20
# The header of a library names every spectrum: about 400,000 of them.
MAX_LIBRARY_HEADER_BYTES = 16 * 2**20
_MAX_ENTRIES = 10_000
_MAX_SHOWN = 20

#: Axes of an interleave, slowest first: line, band, sample.
FILE_AXES = {"bil": "lbs", "bip": "lsb", "bsq": "bls"}
#: Types of samples by the code ``data type``.
DTYPES = {
    "1": "u1", "2": "i2", "3": "i4", "4": "f4", "5": "f8", "6": "c8", "9": "c16", "12": "u2", "13": "u4",
    "14": "i8", "15": "u8",
}  # fmt: skip
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
    # Read an ENVI header file.
    # ``path``: the ``.hdr`` file; ``limit``: its maximum size [byte].
    # Raises `FormatError`: The file is not an ENVI header, is over the limit, or contradicts itself; all
    # problems are listed. Raises `OSError`: The file cannot be read.
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
    reader = _Reader(name)
    reader.scan(text)
    fields = reader.fields
    if not fields:
        reader.raise_if_any()
        raise FormatError(f"{name} cannot be used: it holds no 'key = value' line", code="empty-input")
    lines, samples, bands = (reader.integer(key, minimum=1) for key in ("lines", "samples", "bands"))
    offset = reader.integer("header offset", minimum=0, default=0)
    # type and order of the samples
    code, order = reader.choice("data type", DTYPES) or "u1", "<"
    if "byte order" in fields:
        order = reader.choice("byte order", _BYTE_ORDERS) or "<"
    elif np.dtype(code).itemsize > 1:
        reader.note(
            "no byte order: assumed little-endian; add 'byte order = 0' (big-endian: 1) to the header",
            warn=True,
        )
    interleave = reader.choice("interleave", {name: name for name in FILE_AXES})
    for key in ("major frame offsets", "minor frame offsets"):
        text = fields.get(key, "")
        if set(bare(text)) - set("0, \t\n"):
            reader.add(f"{key!r} is {shown(text)}: padded lines are not supported", code="layout-unsupported")
    if fields.get("file compression", "0") != "0":
        reader.add(
            "'file compression' is set",
            mend="unpack the data file and set it to 0",
            code="layout-unsupported",
        )
    # bands
    is_library = "spectral library" in fields.get("file type", "").lower()
    count, unit = (samples, "samples of a spectral library") if is_library else (bands, "bands")
    text = bare(fields.get("band names", "")).rstrip(", \t\n")
    name_count = text.count(",") + 1
    names: tuple[str, ...] = ()
    if text and name_count == bands:
        names = tuple(name.strip() for name in text.split(","))
    elif text and name_count > max(1000, 10 * bands):
        found = f"'band names' has {name_count} names for {bands} bands"
        reader.add(found, mend="delete the list", code="length-mismatch")
    elif text:
        reader.note(f"'band names' has {name_count} names for {bands} bands: names ignored")
    wavelength, fwhm = _spectral_axis(reader, count, unit, names)
    good = reader.numbers("bbl", count, unit)
    if good is not None and not np.isin(good, (0.0, 1.0)).all():
        reader.add("'bbl' holds values other than 0 (bad band) and 1 (good band)", code="value-out-of-range")
    scale = reader.number("reflectance scale factor")
    if scale is not None and not (math.isfinite(scale) and scale > 0):
        found = f"'reflectance scale factor' is {scale}"
        reader.add(found, expected="a number above 0", code="value-out-of-range")
    # integers stay integers: float64 cannot hold all 64-bit integers
    text = bare(fields.get("data ignore value", ""))
    is_whole = re.fullmatch(r"[-+]?[0-9]{1,20}", text) is not None
    ignore: int | float | None = int(text) if is_whole else reader.number("data ignore value")
    if isinstance(ignore, float) and ignore.is_integer() and abs(ignore) < 2**53:
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
        description=bare(fields.get("description", "")),
        fields=fields,
        comments=reader.comments,
        notes=tuple(reader.notes),
        warnings=tuple(reader.warnings),
    )
    reader.raise_if_any()
    return header


class _Reader(Problems):
    # Keys of a header with their raw values, and the problems, notes and warnings of reading, limited in
    # number. Conversions note a problem for a wrong value, and return None.
    def __init__(self, name: str) -> None:
        super().__init__(f"{name} cannot be used", FormatError)
        self.fields: dict[str, str] = {}  # keys in lower case, in the order of the file
        self.comments: dict[str, str] = {}
        self.notes: list[str] = []
        self.warnings: list[str] = []

    def note(self, text: str, *, warn: bool = False) -> None:
        # Add an assumption or oddity; `warn` if it may make values wrong.
        if len(self.warnings if warn else self.notes) < _MAX_SHOWN:
            self.notes.append(text)
            self.warnings += [text] if warn else []

    def scan(self, text: str) -> None:
        # Split the text into keys with raw values, and comment pairs.
        lines = enumerate(io.StringIO(text, newline=None), start=1)
        _, first = next(lines, (1, ""))
        if first.split() != ["ENVI"]:
            self.add(f"first line is {shown(first.rstrip())}", expected="'ENVI'", code="format-unknown")
            return
        entries = 0
        for number, line in lines:
            line = line.strip()
            key, equals, value = (part.strip() for part in line.lstrip("; \t").partition("="))
            if line.startswith(";"):
                # the first of two values stays: processing steps repeat comments, and the cube stays readable
                if equals and self.comments.setdefault(key, value) != value:
                    self.note(f"comment {shown(key)} is given twice: the first is kept", warn=True)
            elif line and not (equals and key):
                expected = "'key = value' or a comment (;)"
                self.add(f"line {number} is {shown(line)}", expected=expected, code="text-unreadable")
            elif line:
                key = " ".join(key.lower().split())
                value = self._closed(value, number, key, lines) if value.startswith("{") else value
                if (before := self.fields.get(key)) == value:
                    self.note(f"{key!r} is given twice, with the same value")
                elif before is not None:
                    self.add(
                        f"line {number}: {key!r} is given again as {shown(value)}, before as {shown(before)}",
                        mend="delete the wrong one",
                        code="key-repeated",
                    )
                self.fields.setdefault(key, value)
            entries += bool(line)
            if entries > _MAX_ENTRIES or len(self) >= _MAX_SHOWN:
                found = f"reading stopped at line {number}"
                self.add(found, mend="check that it is not the data file", code="header-too-long")
                self.fields.clear()
                return

    def _closed(self, value: str, number: int, key: str, lines: Iterator[tuple[int, str]]) -> str:
        # Return a braced value; lines are read until its brace closes.
        parts, part = [], value
        while "}" not in part:
            parts.append(part)
            _, following = next(lines, (0, None))
            if following is None:
                self.add(f"{key!r}: the brace opened on line {number} is never closed", code="brace-open")
                return "\n".join(parts) + "}"
            part = following.rstrip()
        content, _, rest = part.partition("}")
        if rest.strip():
            self.note(f"{key!r}: text after its closing brace is ignored: {shown(rest.strip())}")
        return "\n".join([*parts, content]) + "}"

    def integer(self, key: str, *, minimum: int, default: int | None = None) -> int:
        text = self.fields.get(key)
        kind = "a whole number above 0" if minimum else "a whole number, 0 or above"
        if text is None and default is None:
            self.add(f"{key!r} is missing", expected=kind, code="key-missing")
        if text is None:
            return default or 0
        if re.fullmatch(r"\+?[0-9]{1,30}", text) is None or int(text) < minimum:
            self.add(f"{key!r} is {shown(text)}", expected=kind, code="value-out-of-range")
            return 0
        return int(text)

    def choice(self, key: str, allowed: Mapping[str, str]) -> str | None:
        text = self.fields.get(key)
        value = allowed.get((text or "").lower())
        if value is None:
            found = f"{key!r} is {'missing' if text is None else shown(text)}"
            self.add(found, expected=f"one of {', '.join(allowed)}", code="choice-unknown")
        return value

    def number(self, key: str) -> float | None:
        text = self.fields.get(key, "")
        try:
            return _to_float(bare(text)) if bare(text) else None
        except ValueError:
            self.add(f"{key!r} is {shown(text)}", expected="one number", code="number-unreadable")
            return None

    def numbers(self, key: str, count: int, per: str) -> Floats | None:
        # Return a list with one finite number per band.
        text = bare(self.fields.get(key, ""))
        if not text or count < 1:  # no list, or a wrong count that is already noted
            return None
        # counted before it is split: millions of values become objects only for a cube of that size
        size = sum(1 for _ in _ITEM.finditer(text))
        if size != count:
            found, expected = f"{key!r} has {size} values for {count} {per}", "one for each, or no "
            self.add(found, expected=f"{expected}{key!r} at all", code="length-mismatch")
            return None
        try:
            values = np.array([_to_float(item) for item in _ITEM.findall(text)], dtype=np.float64)
        except ValueError as error:
            self.add(f"{key!r}: {error}", expected="numbers", code="number-unreadable")
            return None
        infinite = np.flatnonzero(~np.isfinite(values))
        if not infinite.size:
            return values
        found = f"{key!r}: value {infinite[0] + 1} is {values[infinite[0]]}"
        self.add(found, expected="finite numbers", code="not-finite")
        return None


def shown(text: str) -> str:
    """Return text shortened and quoted for messages."""
    return repr(text if len(text) <= 60 else text[:57] + "...")


def bare(text: str) -> str:
    """Return a raw value without its braces."""
    return text[1:-1].strip() if text.startswith("{") and text.endswith("}") else text


def braced(values: Sequence[str]) -> str:
    # Return a list in ENVI's form, eight values per line
    return (
        "{\n " + ",\n ".join(", ".join(values[start : start + 8]) for start in range(0, len(values), 8)) + "}"
    )


def _to_float(text: str) -> float:
    # Return a number; unlike float(), refuse underscores and digits of other scripts.
    if len(text) <= 64 and text.isascii() and "_" not in text:
        try:
            return float(text)
        except ValueError:
            pass
    raise ValueError(f"{shown(text)} is not a number")


def _spectral_axis(
    reader: _Reader, count: int, per: str, names: tuple[str, ...]
) -> tuple[Floats | None, Floats | None]:
    # Return wavelength and FWHM in nm.
    lists = {key: reader.numbers(key, count, per) for key in ("wavelength", "fwhm")}
    text, has_wavelengths = bare(reader.fields.get("wavelength units", "")), "wavelength" in reader.fields
    unit = text.lower()
    is_unknown, factor = unit in _UNKNOWN_UNITS, _NANOMETRES.get(unit, 1.0)
    if not has_wavelengths and lists["fwhm"] is None:
        return _wavelength_of_names(names, reader), None
    if unit in _NOT_WAVELENGTHS:
        reader.note(f"wavelength units are {text!r}: the lists are not read as wavelengths")
        return None, None
    if not is_unknown and unit not in _NANOMETRES:
        reader.add(
            f"'wavelength units' is {shown(text)}",
            expected="Nanometers, Micrometers, Angstroms, Millimeters, Centimeters, Meters, Wavenumber, "
            "GHz, MHz, Index or Unknown",
            code="choice-unknown",
        )
        return None, None
    if not has_wavelengths:
        if is_unknown:
            reader.note("no wavelength units: 'fwhm' taken as nanometres")
    elif lists["wavelength"] is not None:
        longest = float(lists["wavelength"].max())
        is_micrometres = longest < _MAX_MICROMETRES
        if is_unknown:
            taken = (
                "values below 100 taken as micrometres" if is_micrometres else "values taken as nanometres"
            )
            reader.note(f"no wavelength units: {taken}")
            factor = 1e3 if is_micrometres else 1.0
        elif factor == (1.0 if is_micrometres else 1e3):
            found = f"wavelength units are {unit!r} but the longest wavelength is {longest:g}: check the unit"
            reader.note(found, warn=True)
    nanometres: dict[str, Floats | None] = {}
    for key, values in lists.items():
        with np.errstate(over="ignore"):
            scaled = nanometres[key] = None if values is None else values * factor
        if values is None or scaled is None:
            continue
        if not np.isfinite(scaled).all():
            found = f"{key!r} holds values up to {values.max():.3g}, which is infinite in nanometres"
            reader.add(found, code="not-finite")
        is_wrong, limit = (values < 0, "below 0") if key == "fwhm" else (values <= 0, "that are not above 0")
        if is_wrong.any():
            reader.add(f"{key!r} holds values {limit}", code="value-out-of-range")
    if not has_wavelengths:
        nanometres["wavelength"] = _wavelength_of_names(names, reader)
    return nanometres["wavelength"], nanometres["fwhm"]


def _wavelength_of_names(names: tuple[str, ...], reader: _Reader) -> Floats | None:
    # Return the wavelengths that GDAL writes into band names, such as ``399.356 nm``.
    matches = [_NAMED_WAVELENGTH.search(name[:200]) for name in names]
    centres = [float(match[1]) * _NANOMETRES[match[2].lower()] for match in matches if match is not None]
    if not centres or len(centres) < len(names) or min(centres) <= 0:
        return None
    reader.note("no wavelength list: wavelengths taken from the band names")
    return np.array(centres, dtype=np.float64)


def _map_info(reader: _Reader) -> MapInfo | None:
    text = bare(reader.fields.get("map info", ""))
    items = [item.strip() for item in text[:10_000].split(",")]
    if items[0].lower() == "arbitrary":
        reader.note("map info is 'Arbitrary': taken as sensor geometry")
    if not text or items[0].lower() == "arbitrary":
        return None
    options = dict(item.lower().split("=", 1) for item in items if "=" in item)
    entries = [item for item in items if "=" not in item]
    try:
        column, row, x, y, width, height = map(_to_float, [*entries[1:7], *[""] * (7 - len(entries))])
        rotation = _to_float(options.get("rotation", "0").strip())
    except ValueError as error:
        reader.add(
            f"'map info' is {shown(text)} ({error})",
            expected="projection, reference column and row, x, y, pixel width and height, then zone, datum, "
            "units=..., rotation=...",
            code="number-unreadable",
        )
        return None
    if not all(map(math.isfinite, (column, row, x, y, width, height, rotation))) or min(width, height) <= 0:
        expected = "finite numbers and sizes above 0"
        reader.add(f"'map info' is {shown(text)}", expected=expected, code="value-out-of-range")
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
