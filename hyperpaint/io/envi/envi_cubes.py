"""ENVI headers, and lazy opening of ENVI cubes: raw counts, radiance or reflectance of any length.

A header is text: a first line ``ENVI``, then ``key = value`` lines; a value that begins with a brace extends
to the next closing brace. Lines that begin with a semicolon are comments, in which Headwall cameras store
their metadata. Reading is bounded and linear in the length of the file, and all problems are raised together.

The data file is read in slabs when values are needed. Sensor geometry becomes
``(along_track, band, cross_track)`` for any interleave, map geometry ``(y, x, band)``.

A data file may be a link to another folder, as raw cubes on a large disk often are: the user placed it beside
the header. Paths written inside a header are never followed.

A memory map passed to dask is copied into memory, and pickled with the graph. `EnviArray` takes a few hundred
bytes instead: the path and the layout. Each read opens the file, so that threads and processes share nothing.

`slab_lines` and `slab_offsets` give slabs of whole lines as byte ranges of the data file, to refer to cubes
without copying them; `EnviParser` is a parser of VirtualiZarr.

`write_envi` fills the data file block by block as dask computes them, so that a cube of any length needs the
memory of a few blocks. Header and data are published together, the header last.
"""

import errno
import filecmp
import io
import itertools
import json
import math
import os
import re
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import xarray as xr
from xarray.backends import BackendArray
from xarray.core import indexing

from hyperpaint.base import (
    ALONG_TRACK,
    BAND,
    CHUNK_LINES,
    CROSS_TRACK,
    CUBE,
    VARIABLES,
    Array,
    Bools,
    Floats,
    FormatError,
    Ints,
    Problem,
    Problems,
    RemoteData,
    SchemaError,
    as_path,
    documented,
    input_path,
    is_plain_file,
    needs_extra,
    one_of,
    open_data,
    open_input,
    origin_of,
    same_dimension,
    takes_quantities,
    warn_if,
)
from hyperpaint.io.files.publishing import published_files
from hyperpaint.io.files.reading import decoded_text, foreign_format, refuse
from hyperpaint.io.maps.map_grids import (
    RGB_WAVELENGTHS,
    Grid,
    envi_map_info,
    grid_of,
    nearest_bands,
    product_of,
    storable,
)

if TYPE_CHECKING:
    from virtualizarr.manifests import ManifestStore

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
#: Wavelength [nm] times the value, of units that are reciprocal to wavelength
_RECIPROCAL = {
    **dict.fromkeys(("wavenumber", "wavenumbers", "cm-1", "cm^-1", "1/cm"), 1e7),
    "ghz": 299_792_458.0,
    "mhz": 299_792_458e3,
}
_MAX_MICROMETRES = 100.0
#: Ratios of width and wavelength, outside which a width is in another unit, and the factor to the unit of the
#: wavelengths: resolving powers are above 2, and below 20,000.
_OTHER_WIDTHS = ((0.5, np.inf, 1e-3), (0.0, 5e-5, 1e3))
#: Maximum ratio of width and spacing of bands in micrometres.
_MAX_BANDS_A_WIDTH = 100.0

#: Keys that change the meaning of samples and are not applied.
_NOT_APPLIED = (
    "data reflectance gain values",
    "data reflectance offset values",
    "radiance scale factor",
    "data scale factor",
    "scale factor",
    "scale offset",
)

_ITEM = re.compile(r"[^,\s]+")
_NAMED_WAVELENGTH = re.compile(
    r"(?<![0-9.])([0-9]{1,6}(?:\.[0-9]{1,9})?) ?(nm|um|[µμ]m|(?:nano|micro)met(?:er|re)s?|microns?)\b",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class MapInfo:
    # Map position of the pixels, from ``map info``
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
    # Content of an ENVI header
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
    good: Bools | None = None
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
        # Bytes of one line, all bands
        return self.samples * self.bands * self.dtype.itemsize

    @property
    def file_type(self) -> str:
        # ``file type`` in lower case; empty where absent
        return self.fields.get("file type", "").lower()

    @property
    def is_spectral_library(self) -> bool:
        # Whether each line is a spectrum and each sample a wavelength
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
    FormatError.raise_if(
        len(raw) > limit,
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
        reader.add_if(
            set(bare(text)) - set("0, \t\n"),
            f"{key!r} is {shown(text)}: padded lines are not supported",
            code="layout-unsupported",
        )
    reader.add_if(
        fields.get("file compression", "0") != "0",
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
        reader.add(
            f"'band names' has {name_count} names for {bands} bands",
            mend="delete the list",
            code="length-mismatch",
        )
    elif text:
        reader.note(f"'band names' has {name_count} names for {bands} bands: names ignored")
    wavelength, fwhm = _spectral_axis(reader, count, unit, names)
    good = reader.numbers("bbl", count, unit)
    reader.add_if(
        good is not None and not np.isin(good, (0.0, 1.0)).all(),
        "'bbl' holds values other than 0 (bad band) and 1 (good band)",
        code="value-out-of-range",
    )
    scale = reader.number("reflectance scale factor")
    reader.add_if(
        scale is not None and not 1.0 <= scale < math.inf,
        f"'reflectance scale factor' is {scale}",
        expected="the stored value of a reflectance of 1, such as 10000",
        mend="write its inverse, if it is a factor of the samples",
        code="value-out-of-range",
    )
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
                self.add(
                    f"line {number} is {shown(line)}",
                    expected="'key = value' or a comment (;)",
                    code="text-unreadable",
                )
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
                self.add(
                    f"reading stopped at line {number}",
                    mend="check that it is not the data file",
                    code="header-too-long",
                )
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
        self.add_if(
            text is None and default is None, f"{key!r} is missing", expected=kind, code="key-missing"
        )
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
            self.add(
                f"{key!r} is {'missing' if text is None else shown(text)}",
                expected=f"one of {', '.join(allowed)}",
                code="choice-unknown",
            )
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
            self.add(
                f"{key!r} has {size} values for {count} {per}",
                expected=f"one for each, or no {key!r} at all",
                code="length-mismatch",
            )
            return None
        try:
            values = np.array([_to_float(item) for item in _ITEM.findall(text)], dtype=np.float64)
        except ValueError as error:
            self.add(f"{key!r}: {error}", expected="numbers", code="number-unreadable")
            return None
        infinite = np.flatnonzero(~np.isfinite(values))
        for n in infinite[:1]:
            self.add(f"{key!r}: value {n + 1} is {values[n]}", expected="finite numbers", code="not-finite")
        return None if infinite.size else values


def shown(text: str) -> str:
    # Return text shortened and quoted for messages.
    return repr(text if len(text) <= 60 else text[:57] + "...")


def bare(text: str) -> str:
    # Return a raw value without its braces.
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
    values, widths = lists["wavelength"], lists["fwhm"]
    if unit in _RECIPROCAL and values is not None:
        with np.errstate(divide="ignore", invalid="ignore"):
            wavelength = _RECIPROCAL[unit] / values
            lists["wavelength"] = wavelength
            lists["fwhm"] = None if widths is None else widths * wavelength / values
        unit = "nm"
    if unit == "index" or unit in _RECIPROCAL:
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
            reader.note(
                f"wavelength units are {unit!r} but the longest wavelength is {longest:g}: check the unit",
                warn=True,
            )
    nanometres = dict(lists)
    for key, values in ((key, values) for key, values in lists.items() if values is not None):
        with np.errstate(over="ignore"):
            nanometres[key] = scaled = values * factor
        reader.add_if(
            not np.isfinite(scaled).all(),
            f"{key!r} holds values up to {values.max():.3g}, which is infinite in nanometres",
            code="not-finite",
        )
        is_wrong, limit = (values < 0, "below 0") if key == "fwhm" else (values <= 0, "that are not above 0")
        reader.add_if(is_wrong.any(), f"{key!r} holds values {limit}", code="value-out-of-range")
    if not has_wavelengths:
        nanometres["wavelength"] = _wavelength_of_names(names, reader)
    fwhm = nanometres["fwhm"]
    if nanometres["wavelength"] is not None and fwhm is not None:
        centre, width = float(np.median(nanometres["wavelength"])), float(np.median(fwhm))
        spacing = np.median(np.diff(np.sort(nanometres["wavelength"]))) if fwhm.size > 1 else np.inf
        for low, high, correction in _OTHER_WIDTHS:
            # nanometres beside micrometres: fine bands have widths below half the wavelength, too
            is_many = correction < 1.0 < factor and width > _MAX_BANDS_A_WIDTH * spacing > 0.0
            is_other = is_many or (centre > 0 and low < width / centre < high)
            if is_other and 5e-5 < width * correction / centre < 0.5:
                nanometres["fwhm"] = fwhm * correction
                reader.note(
                    f"'fwhm' of {width:g} nm at {centre:g} nm: taken as {width * correction:g} nm, in "
                    "another unit than the wavelengths",
                    warn=True,
                )
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
    options = {
        key.strip(): value.strip() for key, _, value in (i.lower().partition("=") for i in items if "=" in i)
    }
    entries = [item for item in items if "=" not in item]
    try:
        column, row, x, y, width, height = map(_to_float, [*entries[1:7], *[""] * (7 - len(entries))])
        rotation = _to_float(options.get("rotation", "0"))
    except ValueError as error:
        reader.add(
            f"'map info' is {shown(text)} ({error})",
            expected="projection, reference column and row, x, y, pixel width and height, then zone, datum, "
            "units=..., rotation=...",
            code="number-unreadable",
        )
        return None
    if not all(map(math.isfinite, (column, row, x, y, width, height, rotation))) or min(width, height) <= 0:
        reader.add(
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
        units=options.get("units", ""),
        rotation=rotation,
    )


_DATA_SUFFIXES = (".img", ".dat", ".raw", ".bil", ".bip", ".bsq", ".bin", ".sli")
# of cameras and programs, looked for where none of the others is there
_RARE_SUFFIXES = (".hyspex", ".float", ".cube", ".rad", ".ref", ".rfl")
_LEVEL = re.compile(r"(?:^|,)\s*(radiance|reflectance|counts)\s*(?=$|[\],\[])", re.IGNORECASE)
# Headwall's recorder writes its name; its software adds the processing level
_RAW = re.compile(r"\[headwall\b|\braw\b|\bdigital (?:numbers?|counts?)\b|\bcounts\b|\bdn\b", re.IGNORECASE)
# Words of a product, which may name the raw data that it comes from
_PRODUCT = re.compile(r"\b(?:radiance|reflectance|albedo)\b|\bnot (?:raw|counts|dn)\b", re.IGNORECASE)
_COUNT_UNITS = ("count", "counts", "dn", "digital number", "digital numbers", "digital counts", "adu")
_QUANTITIES = ("counts", "radiance", "reflectance", "values")


# --- samples of a data file ------------------------------------------------------------------------------


# gaps up to this size are read and dropped, which is faster than another system call [byte]
_MAX_GAP_BYTES = 32 * 2**10
# largest piece read at once if not all of it is kept [byte]
_MAX_BOX_BYTES = 8 * 2**20


@dataclass(frozen=True, eq=False)
class Scaling:
    # From stored samples to values: ``(stored * gain + offset) / divisor``, `ignore` becomes NaN
    dtype: np.dtype[Any]  # Type of the values, floating or complex
    ignore: int | float | None = None  # Compared with stored samples, before scaling
    divisor: float | None = None  # The reflectance scale factor
    # gain, offset: One value per band
    gain: Floats | None = None
    offset: Floats | None = None

    def apply(self, stored: Array, per_band: Callable[[Array], Array]) -> Array:
        # Return values of `stored`; `per_band` selects and reshapes a band vector to match it
        # float32 holds 16 bits exactly; wider integers pass through float64
        values = stored.astype(np.result_type(stored.dtype, np.float32))
        if self.gain is not None:
            values *= per_band(self.gain)
        if self.offset is not None:
            values += per_band(self.offset)
        if self.divisor is not None:
            values /= self.divisor
        if self.ignore is not None:
            values[stored == self.ignore] = np.nan
        return values.astype(self.dtype, copy=False)


@dataclass(frozen=True, eq=False)
class EnviArray(BackendArray):
    # Samples of an ENVI data file, in any order of dims, in native byte order
    path: str  # Absolute path of the data file, or its URL
    # file_size, version: Of the file when it was opened (see `open_data`); a read refuses a file that has
    # changed since. dask names an array by its fields: a changed file gets another name.
    file_size: int
    version: int
    offset: int  # Bytes before the first sample
    stored: np.dtype[Any]  # Type of a stored sample, byte order included
    file_shape: tuple[int, int, int]  # Slowest axis of the file first
    axes: tuple[int, int, int]  # Axis of the file of each dim
    band_axis: int  # The dim that counts bands
    scaling: Scaling | None = None  # None for stored samples

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(self.file_shape[axis] for axis in self.axes)

    @property
    def dtype(self) -> np.dtype[Any]:
        # Type of the values, in native byte order
        return self.stored.newbyteorder("=") if self.scaling is None else self.scaling.dtype

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        return indexing.explicit_indexing_adapter(
            key, self.shape, indexing.IndexingSupport.OUTER, self._outer
        )

    def _outer(self, key: tuple[Any, ...]) -> Array:
        # Return the samples at the crossings of an index, slice or sorted index array per dim.
        positions = [_positions(index, size) for index, size in zip(key, self.shape, strict=True)]
        values = self._read(positions)
        if self.scaling is not None:
            vector_shape = tuple(-1 if axis == self.band_axis else 1 for axis in range(3))
            bands = positions[self.band_axis]
            values = self.scaling.apply(values, lambda vector: vector[bands].reshape(vector_shape))
        shape = [
            size
            for size, index in zip(values.shape, key, strict=True)
            if not isinstance(index, int | np.integer)
        ]
        return values.reshape(shape)

    def _read(self, positions: list[Ints]) -> Array:
        samples = np.empty(tuple(len(index) for index in positions), self.stored.newbyteorder("="))
        if samples.size == 0:
            return samples
        # a view of the same memory, axes in the order of the file
        in_file_order = samples.transpose(np.argsort(self.axes))
        with open_data(self.path) as (file, size, version):
            # Raise FormatError if the file has changed since it was opened: its layout may differ.
            FormatError.raise_if(
                (size, version) != (self.file_size, self.version),
                f"ENVI data file {self.path!r} has changed since it was opened: {size} bytes",
                expected=f"{self.file_size} bytes, not written since",
                mend="open it again",
                code="file-changed",
            )
            planes, rows, columns = (positions[axis] for axis in np.argsort(self.axes))
            _, height, width = self.file_shape
            if (
                self.axes == (0, 1, 2)
                and (np.diff(planes) == 1).all()
                and np.array_equal(rows, np.arange(height))
                and np.array_equal(columns, np.arange(width))
            ):
                # complete successive planes of the file are read in one piece
                self.fill_samples(file, int(planes[0]) * height * width, samples.reshape(-1))
                if not self.stored.isnative:
                    samples.byteswap(inplace=True)
            else:
                # read blocks of file lines around the requested samples, and keep these samples; lines of
                # the file are counted through all planes
                lines = (planes[:, np.newaxis] * height + rows).ravel()
                first, last = int(columns[0]), int(columns[-1])
                gap_bytes = (np.diff(lines) * width - (last - first + 1)) * self.stored.itemsize
                lines_per_box = max(1, _MAX_BOX_BYTES // (width * self.stored.itemsize))
                is_break = (
                    (gap_bytes > _MAX_GAP_BYTES)
                    | (np.diff((lines - lines[0]) // lines_per_box) != 0)
                    | (np.diff(lines) < 0)  # a plane that is repeated
                )
                edges = [0, *(np.flatnonzero(is_break) + 1).tolist(), len(lines)]
                plane, row = np.unravel_index(np.arange(len(lines)), in_file_order.shape[:2])
                kept = _selector(columns)
                blocks: Iterator[bytes] | None = None
                if isinstance(file, RemoteData):  # all requests run at once
                    starts = lines[edges[:-1]] * width + first
                    stops = lines[np.array(edges[1:]) - 1] * width + last + 1
                    places = (self.offset + limits * self.stored.itemsize for limits in (starts, stops))
                    blocks = iter(file.pieces(*(limits.tolist() for limits in places)))
                for start, stop in itertools.pairwise(edges):
                    first_line = int(lines[start])
                    buffer = np.empty((int(lines[stop - 1]) - first_line + 1, width), self.stored)
                    buffer_part = buffer.reshape(-1)[first : (len(buffer) - 1) * width + last + 1]
                    if blocks is None:
                        self.fill_samples(file, first_line * width + first, buffer_part)
                    else:
                        buffer_part[:] = np.frombuffer(next(blocks), self.stored)
                    block = buffer if stop - start == 1 else buffer[_selector(lines[start:stop] - first_line)]
                    in_file_order[plane[start:stop], row[start:stop]] = block[:, kept]
        return samples

    def fill_samples(self, file: io.RawIOBase, first: int, out: Array) -> None:
        # Read samples from number `first` on into contiguous memory, without conversion.
        view = out.view(np.uint8).data
        file.seek(self.offset + first * self.stored.itemsize)
        done = 0
        while done < len(view):
            count = file.readinto(view[done:])
            FormatError.raise_if(
                not count,
                f"ENVI data file {self.path!r} ends {len(view) - done} bytes early",
                expected=f"{self.file_size} bytes, as when it was opened",
                mend="open it again",
                code="file-truncated",
            )
            done += count


def _positions(index: Any, size: int) -> Ints:
    numbers = np.arange(*index.indices(size)) if isinstance(index, slice) else index
    return np.atleast_1d(np.asarray(numbers, dtype=np.int64))


def _selector(positions: Ints) -> slice | Ints:
    # Return a slice for evenly spaced positions, which avoids a copy; a single position has a step of 1.
    steps = np.diff(positions, append=positions[-1] + 1)[: max(1, len(positions) - 1)]
    is_even = steps[0] > 0 and (steps == steps[0]).all()
    return slice(int(positions[0]), int(positions[-1]) + 1, int(steps[0])) if is_even else positions


# --- cubes -------------------------------------------------------------------------------------------------


def find_pair(path: str | os.PathLike[str]) -> tuple[Path, Path]:
    # Return the header and the data file that belong together.
    # ``path``: header or data file. A header ``raw_0.hdr`` belongs to ``raw_0``, or to that name with one of
    # the suffixes .img .dat .raw .bil .bip .bsq .bin .sli, or a rarer one; a data file belongs to its name
    # and ``.hdr``, with its suffix or without.
    # Returns header, data: paths in the spelling of the caller.
    # Raises `FormatError`: The other file is missing or ambiguous. Raises `FileNotFoundError`: There is no
    # such file.
    path = input_path(path, "an ENVI header, or the data file beside it", content=False)
    if not path.is_file() and not path.is_dir():
        raise FileNotFoundError(f"no such file: {str(path)!r}")
    FormatError.raise_if(
        path.is_dir(),
        f"{str(path)!r} is a folder",
        expected="an ENVI header, or the data file beside it",
        mend="open a Zarr store with hp.open_store or xr.open_zarr; of other folders name a cube",
        code="path-is-folder",
    )

    def existing(suffixes: Iterable[str], *stems: Path) -> list[Path]:
        # the files among the names; two spellings of one file count once
        names = (Path(f"{stem}{suffix}") for stem in stems for suffix in suffixes)
        files = [name for name in names if is_plain_file(name)]
        return [name for n, name in enumerate(files) if not any(map(name.samefile, files[:n]))]

    bare_path = path.with_suffix("")
    if path.suffix.lower() != ".hdr":
        headers = existing((".hdr", ".HDR"), path, bare_path)
        refuse(str(path), (True, None if headers else foreign_format(path, is_binary=True)))
        FormatError.raise_if(
            not headers,
            f"ENVI data file {str(path)!r} has no header beside it",
            expected=f"{path.name + '.hdr'!r} or {path.stem + '.hdr'!r}",
            code="header-missing",
        )
        warn_if(
            not filecmp.cmp(headers[0], headers[-1], shallow=False),
            f"{path.name}: {headers[0].name} is used, and {headers[-1].name} differs from it; open the "
            "header that you mean, or delete the other",
            "header-doubtful",
        )
        return headers[0], path
    candidates: list[Path] = []
    for suffixes in ([""], _DATA_SUFFIXES, _RARE_SUFFIXES):
        spellings = [suffix for lower in suffixes for suffix in (lower, lower.upper())]
        candidates = candidates or existing(spellings, bare_path)
    FormatError.raise_if(
        not candidates,
        f"ENVI header {str(path)!r} has no data file beside it",
        expected=f"{bare_path.name!r}, with no suffix or with one of "
        f"{' '.join(_DATA_SUFFIXES + _RARE_SUFFIXES)}",
        code="data-file-missing",
    )
    FormatError.raise_if(
        len(candidates) > 1,
        f"ENVI header {str(path)!r} could belong to {', '.join(repr(file.name) for file in candidates)}",
        mend="open the data file you mean",
        code="data-file-ambiguous",
    )
    return path, candidates[0]


def open_envi(
    path: str | os.PathLike[str],
    *,
    keep_whole_lines: bool = False,
    quantity: str | None = None,
    unsaid: str = "values",
    dark_lines: bool = False,
) -> xr.Dataset:
    """Open an ENVI cube lazily.

    Parameters
    ----------
    path
        The header or the data file.
    keep_whole_lines
        Use the number of lines from the size of the data file instead of the header, for recordings that
        were cut short (power loss, or a header written before the last line). An incomplete line at the end
        of a short file is dropped; a file longer than declared must hold complete lines, since a remainder
        means that the header describes another cube. Not possible for ``bsq``: a short file lacks bands.
    quantity
        ``counts``, ``radiance``, ``reflectance`` or ``values``: quantity of the samples, where the header
        does not state it. A header that contradicts it is refused.
    unsaid
        Quantity of integers, used where neither the header nor ``quantity`` states one; for readers of darks.
    dark_lines
        Return the dark lines that a line scanner appended to the cube, from ``autodarkstartline`` of the
        header on, instead of the lines of the scene.

    Returns
    -------
    xarray.Dataset
        One variable: ``counts`` (integers), ``radiance`` or ``reflectance``, where the header or ``quantity``
        says so, else ``values``; dims (along_track, band, cross_track), or (y, x, band) with map info.
        Radiance and reflectance are float32, with reflectance scale factor or band gains and offsets applied,
        and NaN where the stored sample equals the ignore value. Integers without a scale keep their type, and
        the attribute ``data_ignore_value``. Coordinates ``wavelength`` [nm], ``fwhm`` [nm] and ``good`` on
        ``band``, without an index; ``y`` and ``x`` [map units] at pixel centres where the grid is not
        rotated, with the attribute ``crs`` where the header states it (a rotated one has the attribute
        ``map_info`` alone). Attributes ``envi_header`` and ``envi_comments`` hold the whole header, as JSON
        text.

    Raises
    ------
    FormatError
        The header is damaged, contradicts itself or ``quantity``, or does not fit the size of the data file.
    FileNotFoundError
        There is no such file.

    Warns
    -----
    PaintWarning
        An assumption may make values or wavelengths wrong, or lines were kept or dropped.

    Notes
    -----
    A level in the description (``,RADIANCE``, ``,REFLECTANCE``: the last one counts) takes precedence over
    Headwall's ``;Units`` comment, which sets the units of radiance and is known to stay behind in reflectance
    products. Integers called reflectance without a scale are ``values``. Integers are ``counts`` by the word
    raw, counts or DN in a description that names no product such as reflectance, by units of counts, or by a
    description of Headwall's recorder without a level; maps only by units of counts. Scaled products of other
    software without such a word are ``values``.

    Examples
    --------
    >>> import tempfile
    >>> scratch = tempfile.TemporaryDirectory()
    >>> folder = Path(scratch.name)
    >>> np.arange(24, dtype="u2").tofile(folder / "raw_0")
    >>> _ = (folder / "raw_0.hdr").write_text('''ENVI
    ... samples = 4
    ... description = {raw}
    ... lines = 3
    ... bands = 2
    ... data type = 12
    ... interleave = bil
    ... byte order = 0
    ... wavelength units = nm
    ... wavelength = {450, 550}''')
    >>> line = open_envi(folder / "raw_0.hdr")
    >>> dict(line.sizes)
    {'along_track': 3, 'band': 2, 'cross_track': 4}
    >>> line.counts.isel(along_track=1, cross_track=0).values
    array([ 8, 12], dtype=uint16)
    >>> scratch.cleanup()
    """
    header_path, data_path = find_pair(path)
    header = read_header(header_path)
    problems = Problems(f"ENVI header {str(header_path)!r} cannot be used", FormatError)
    has_scale = header.reflectance_scale_factor not in (None, 1.0)
    has_procedures = "read procedures" in header.fields
    problems.raise_if_any(
        (
            header.is_spectral_library,
            Problem(
                f"file type is {header.fields.get('file type')!r}: a spectral library",
                expected="a cube",
                code="file-type-wrong",
            ),
        ),
        (
            (header.file_type and not header.file_type.startswith("envi")) or has_procedures,
            Problem(
                f"file type is {header.fields.get('file type', 'none')!r}"
                f"{', with read procedures' * has_procedures}",
                expected="ENVI Standard",
                mend="open it with GDAL, or export it as an ENVI file",
                code="file-type-wrong",
            ),
        ),
        (
            has_scale and _has_gain(header),
            Problem(
                "both 'reflectance scale factor' and band gains or offsets are given",
                mend="delete those that do not belong to the stored samples",
                code="scale-conflict",
            ),
        ),
        (
            has_scale and _level(header) == "radiance",
            Problem(
                "the description says RADIANCE but a 'reflectance scale factor' is given",
                mend="delete one",
                code="scale-conflict",
            ),
        ),
    )
    with open_data(data_path) as (_, file_size, version):
        lines = _lines_in_file(header, data_path, file_size, keep_whole_lines)
    # doubts that may make values wrong
    doubts = list(header.warnings)
    if _is_unscaled(header):
        doubts.append(
            "the description says REFLECTANCE but integers are stored and no scale is given: opened as "
            "'values'; add for example 'reflectance scale factor = 10000' to the header"
        )
    is_undeclared = quantity is None and declared_quantity(header)[0] is None
    if (
        is_undeclared
        and header.map_info is None
        and header.dtype.kind in "iu"
        and _is_of_raw(header) is False
    ):
        doubts.append(
            f"the description {shown(header.description)} names raw counts and a product: the integers are "
            f"opened as {unsaid!r}; pass quantity=, or state the quantity in the header"
        )
    if lines != header.lines:
        doubts.append(f"{lines} whole lines are kept where the header says {header.lines}")
    if keys := [key for key in _NOT_APPLIED if header.fields.get(key, "") not in ("", "1", "1.0")]:
        doubts.append(f"{', '.join(map(repr, keys))} of the header are not applied to the values")
    # dark lines at the end of the scene
    recorded, offset = lines, header.header_offset
    start = header.fields.get("autodarkstartline", "")
    has_dark = start.isdecimal() and 0 < int(start) < lines and header.interleave != "bsq"
    if start and not has_dark and not (start.isdecimal() and int(start) in (0, lines)):
        doubts.append(
            f"'autodarkstartline' is {shown(start)}: dark lines at the end are kept as lines of the scene"
        )
    if has_dark:
        lines = recorded - int(start) if dark_lines else int(start)
        offset += int(start) * header.line_bytes if dark_lines else 0
    warn_if(doubts, f"{data_path.name}: {'; '.join(doubts)}", "header-doubtful")
    FormatError.raise_if(
        dark_lines and not has_dark,
        f"{data_path.name}: no dark lines",
        expected="autodarkstartline below the number of lines, in a cube of lines (bil, bip)",
        code="dark-missing",
    )
    # axes of the file, and of the array
    name, attrs = _quantity(header, quantity, unsaid, data_path)
    sizes = {"l": lines, "b": header.bands, "s": header.samples}
    file_axes = FILE_AXES[header.interleave]
    order = "lbs" if header.map_info is None else "lsb"
    dims = CUBE if header.map_info is None else ("y", "x", "band")
    array = EnviArray(
        path=origin_of(os.path.abspath(data_path)),
        file_size=file_size,
        version=version,
        offset=offset,
        stored=header.dtype,
        file_shape=(sizes[file_axes[0]], sizes[file_axes[1]], sizes[file_axes[2]]),
        axes=(file_axes.index(order[0]), file_axes.index(order[1]), file_axes.index(order[2])),
        band_axis=order.index("b"),
        scaling=_scaling(header, name),
    )
    if array.scaling is None and header.data_ignore_value is not None:
        attrs["data_ignore_value"] = header.data_ignore_value
    variable = xr.Variable(
        dims,
        indexing.LazilyIndexedArray(array),
        attrs,
        encoding={
            "preferred_chunks": {
                **dict(zip(dims, array.shape, strict=True)),
                dims[0]: min(CHUNK_LINES, lines),
            }
        },
    )
    # fastpath: otherwise xarray imports dask to check the type of the values, which takes longer than the
    # rest
    coords: dict[str, Any] = {
        name: xr.Variable("band", values, VARIABLES[name].attrs, fastpath=True)
        for name, values in (
            ("wavelength", header.wavelength),
            ("fwhm", header.fwhm),
            ("good", header.good),
        )
        if values is not None
    }
    if header.map_info is not None and header.map_info.rotation == 0:
        # pixel centres of an unrotated grid; the reference pixel (1, 1) is an outer corner
        info = header.map_info
        column, row = info.reference_pixel
        x = info.reference[0] + (np.arange(header.samples) + 1.5 - column) * info.pixel_size[0]
        y = info.reference[1] - (np.arange(lines) + 1.5 - row) * info.pixel_size[1]
        if info.projection.lower().startswith("geographic"):
            x_attrs = {"standard_name": "longitude", "units": "degrees_east"}
            y_attrs = {"standard_name": "latitude", "units": "degrees_north"}
        else:
            unit = {"meters": "m", "metres": "m", "feet": "ft", "degrees": "degree"}.get(info.units.lower())
            x_attrs, y_attrs = (
                {"standard_name": f"projection_{axis}_coordinate", **({"units": unit} if unit else {})}
                for axis in "xy"
            )
        # the reference system: of WGS-84 its code, else the header's text
        system = bare(header.fields.get("coordinate system string", ""))
        words = ",".join((info.projection, *info.details[:3])).lower()
        place = re.match(r"utm,0?([0-9]{1,2}),(n|s)(?:orth|outh),wgs-?84", words)
        if place and (not system or f"wgs_1984_utm_zone_{place[1]}{place[2]}" in system.lower()):
            system = f"EPSG:{'326' if place[2] == 'n' else '327'}{int(place[1]):02d}"
        elif not system and re.match(r"geographic lat/lon,wgs-?84", words):
            system = "EPSG:4326"
        crs_attrs = {"crs": system} if system else {}
        coords |= {"y": ("y", y, y_attrs | crs_attrs), "x": ("x", x, x_attrs | crs_attrs)}
    map_keys = ("map info", "coordinate system string") if header.map_info is not None else ()
    line_attrs: dict[str, Any] = {
        "source": data_path.name,
        "envi_header": json.dumps(header.fields),
        "envi_comments": json.dumps(header.comments) if header.comments else "",
        "envi_notes": "; ".join(header.notes),
        "lines_declared": header.lines if recorded != header.lines else "",
        "dark_lines": f"{start} to {recorded - 1}" if has_dark else "",
        **{key.replace(" ", "_"): header.fields.get(key, "") for key in map_keys},
    }
    stated = {key: value for key, value in line_attrs.items() if value != ""}
    return xr.Dataset({name: variable}, coords=coords, attrs=stated)


def _has_gain(header: EnviHeader) -> bool:
    gain, offset = header.data_gain_values, header.data_offset_values
    return bool((gain is not None and (gain != 1).any()) or (offset is not None and (offset != 0).any()))


def _lines_in_file(header: EnviHeader, path: Path, size: int, keep_whole_lines: bool) -> int:
    # Return the number of lines; FormatError if the size of the file contradicts the header.
    expected = header.header_offset + header.lines * header.line_bytes
    if size == expected:
        return header.lines
    # a netCDF file, for instance, beside the header of another file with its name
    refuse(str(path), (header.header_offset == 0, foreign_format(path, is_binary=True)))
    n_complete, remainder = divmod(max(0, size - header.header_offset), header.line_bytes)
    has_line_order = header.interleave != "bsq"
    can_keep = has_line_order and n_complete >= 1 and (size < expected or remainder == 0)
    if keep_whole_lines and can_keep:
        return n_complete
    relation = "shorter" if size < expected else "longer"
    found = (
        f"found {size} bytes, expected {expected} ({header.header_offset} + {header.lines} lines x "
        f"{header.bands} bands x {header.samples} samples x {header.dtype.itemsize} bytes): the file is "
        f"{abs(expected - size)} bytes {relation} than its header says"
    )
    if has_line_order:
        found += f"\nit holds {n_complete} whole lines and {remainder} bytes more"
    mend = (
        f"keep_whole_lines=True (keep_whole_lines = true in collect.toml) opens those {n_complete} lines"
        if can_keep
        else "check samples, bands, lines and data type, or copy the file again"
    )
    raise FormatError(
        f"ENVI data file {str(path)!r} does not fit its header",
        problems=[Problem(found, mend=mend, code="file-size")],
    )


def _level(header: EnviHeader) -> str | None:
    levels = _LEVEL.findall(header.description[:10_000])
    return str(levels[-1]).lower() if levels else None


def _is_of_raw(header: EnviHeader) -> bool | None:
    # Return whether words of the description name raw counts; False where they name a product, too.
    text = header.description[:10_000]
    return None if _RAW.search(text) is None else _PRODUCT.search(text) is None


def _is_unscaled(header: EnviHeader) -> bool:
    # Return whether the header declares integers as reflectance without a scale.
    return (
        _level(header) == "reflectance"
        and header.dtype.kind in "iu"
        and (header.reflectance_scale_factor in (None, 1.0) and not _has_gain(header))
    )


_CUBE_TYPES = ("", "envi", "envi standard")


def _quantity(
    header: EnviHeader, quantity: str | None, unsaid: str, path: Path
) -> tuple[str, dict[str, Any]]:
    # Return the quantity of the samples, and its attributes; refuse a contradicting ``quantity``.
    declared, radiance_units = declared_quantity(header)
    is_integer, has_gain = header.dtype.kind in "iu", _has_gain(header)
    if quantity is not None:
        one_of(quantity, _QUANTITIES, "quantity", error=FormatError)
    but = f"quantity={quantity!r}, but"
    refuse(
        path.name,
        (
            quantity is not None and declared not in (None, quantity),
            Problem(
                f"{but} its header says {declared}",
                mend="correct the header, or leave quantity= out",
                code="quantity-conflict",
            ),
        ),
        (
            quantity == "counts" and (not is_integer or has_gain),
            Problem(
                f"{but} samples are {header.dtype.name}{', with gains' if has_gain else ''}, no counts",
                code="quantity-conflict",
            ),
        ),
        (
            quantity == "reflectance" and is_integer and not (declared or has_gain),
            Problem(
                f"{but} integers are stored without a scale",
                mend="add for example 'reflectance scale factor = 10000' to its header",
                code="quantity-conflict",
            ),
        ),
    )
    is_raw_form = header.file_type in _CUBE_TYPES and header.map_info is None
    if quantity is None and is_integer and not has_gain and is_raw_form:
        quantity = unsaid
    name = declared or quantity or "values"
    attrs = {} if name == "values" else dict(VARIABLES[name].attrs)
    if name == "radiance":
        del attrs["units"]
        attrs |= {"units": radiance_units} if radiance_units else {}
    return name, attrs


def declared_quantity(header: EnviHeader) -> tuple[str | None, str | None]:
    # Return the quantity that the header declares, and its units of radiance; None if undeclared.
    if _is_unscaled(header):
        return "values", None
    # Headwall's comment on units, or ENVI's key, if it can be read as units of radiance
    comment = next((text for key, text in header.comments.items() if key.lower() == "units"), "")
    stated = header.fields.get("data units", comment)
    texts = [text.replace("^", "").strip() for text in (comment, bare(stated))]
    of_radiance = (text for text in texts if text and same_dimension(text, VARIABLES["radiance"].units))
    radiance_units = next(of_radiance, None)
    level, scale, is_integer = _level(header), header.reflectance_scale_factor, header.dtype.kind in "iu"
    if level is None and scale is not None and (scale != 1.0 or not is_integer):
        level = "reflectance"
    if level is None and radiance_units is not None:
        level = "radiance"
    if level in ("reflectance", "radiance"):
        return level, radiance_units
    # raw counts, by units, description or level
    has_count_units = bare(stated).strip().lower() in _COUNT_UNITS
    # a map is a product of other software, whose description still names the recorder
    in_words = level == "counts" or _is_of_raw(header)
    is_raw = has_count_units or (in_words and header.map_info is None)
    is_cube = is_integer and not _has_gain(header) and header.file_type in _CUBE_TYPES
    return "counts" if is_cube and is_raw else None, None


def _scaling(header: EnviHeader, name: str) -> Scaling | None:
    has_gain, ignore = _has_gain(header), header.data_ignore_value
    divisor = None if header.reflectance_scale_factor == 1.0 else header.reflectance_scale_factor
    stored = header.dtype.newbyteorder("=")
    changes_values = has_gain or divisor is not None
    is_float32 = (changes_values or name in ("radiance", "reflectance")) and stored.kind != "c"
    dtype = np.dtype(np.float32) if is_float32 else stored
    if dtype == stored and not changes_values and (ignore is None or stored.kind in "iu"):
        return None
    return Scaling(
        dtype=dtype,
        ignore=ignore,
        divisor=divisor,
        gain=header.data_gain_values if has_gain else None,
        offset=header.data_offset_values if has_gain else None,
    )


# --- references without copying ----------------------------------------------------------------------------


# Dims in the order of the file, slowest first.
FILE_DIMS = {
    name: tuple({"l": ALONG_TRACK, "b": BAND, "s": CROSS_TRACK}[axis] for axis in axes)
    for name, axes in FILE_AXES.items()
}

# Range of the lines of a slab: with fewer lines, overhead dominates a task; more lines take much memory.
MIN_SLAB_LINES, MAX_SLAB_LINES = 8, 64


def slab_lines(ends: Sequence[int]) -> int:
    """Return the lines of a slab for successive cubes.

    ``ends``: the line after the last line of each cube. The result gives the fewest slabs that are short or
    span two cubes; among equal sizes, the one nearest to that of stored chunks.

    Examples
    --------
    >>> slab_lines([2000]), slab_lines([2000, 4000, 5100]), slab_lines([2003])
    (40, 25, 32)
    """
    return min(
        range(MIN_SLAB_LINES, MAX_SLAB_LINES + 1),
        key=lambda lines: (
            len({end // lines for end in ends if end % lines}),
            abs(math.log(lines / CHUNK_LINES)),
        ),
    )


def slab_offsets(lines: int, first: int, count: int, header_offset: int, line_bytes: int) -> Ints:
    """Return the byte offsets of ``count`` slabs of ``lines`` lines in a file, from line ``first`` on.

    Examples
    --------
    >>> slab_offsets(32, 0, 3, header_offset=512, line_bytes=10).tolist()
    [512, 832, 1152]
    """
    return header_offset + (first + lines * np.arange(count, dtype=np.int64)) * line_bytes


@dataclass(frozen=True)
class EnviParser:
    """A parser of VirtualiZarr for ENVI cubes, such as those of Headwall's recorders.

    Samples are referenced in place: slabs of whole lines of a ``bil`` or ``bip`` file, parts of the
    planes of a ``bsq`` file. Sizes, type, byte order and offset come from the header beside the data file.

    Parameters
    ----------
    variable
        Name of the array.
    lines
        Lines of a chunk, a divisor of the lines of the cube, since chunk grids are regular; by default the
        divisor nearest to 32.

    Examples
    --------
    >>> parser = EnviParser("counts", lines=32)
    >>> parser.variable, parser.lines
    ('counts', 32)
    >>> from virtualizarr import open_virtual_dataset                             # doctest: +SKIP
    >>> cube = open_virtual_dataset(url, registry=registry, parser=parser)        # doctest: +SKIP
    """

    variable: str = "counts"
    lines: int | None = None

    def __call__(self, url: str, registry: Any) -> "ManifestStore":
        """Return the cube as a store of references.

        ``url``: of the data file or of its header; ``registry``: an
        ``obspec_utils.registry.ObjectStoreRegistry`` with a store that reaches both.

        Raises `FormatError`: the header is damaged, or does not fit the size of the data file, or the lines
        of a chunk do not divide the lines of the cube; `MissingExtraError`: VirtualiZarr is not installed.
        """
        with needs_extra("virtualizarr", "virtual", "parsing for VirtualiZarr"):
            from virtualizarr.manifests import ChunkManifest, ManifestArray, ManifestGroup, ManifestStore
            from virtualizarr.manifests.utils import create_v3_array_metadata

        data_url = url.removesuffix(".hdr")
        store, data = registry.resolve(data_url)
        _, header_path = registry.resolve(f"{data_url}.hdr")
        header = parse_header(decoded_text(bytes(store.get(str(header_path)).buffer())), f"{data_url}.hdr")
        size = int(store.head(str(data))["size"])
        expected = header.header_offset + header.lines * header.line_bytes
        # by default the divisor nearest to the lines of stored chunks
        divisors = (n for n in range(1, MAX_SLAB_LINES + 1) if header.lines % n == 0)
        lines = self.lines or min(divisors, key=lambda n: abs(n - CHUNK_LINES))
        refuse(
            data_url,
            (
                size != expected,
                Problem(
                    f"{size} bytes",
                    expected=f"{expected} by its header",
                    mend="copy it again",
                    code="file-size",
                ),
            ),
            (
                header.lines % lines,
                Problem(
                    f"{header.lines} lines in chunks of {lines}",
                    expected="a divisor of the lines",
                    code="length-mismatch",
                ),
            ),
        )
        dims = FILE_DIMS[header.interleave]
        sizes = {ALONG_TRACK: header.lines, BAND: header.bands, CROSS_TRACK: header.samples}
        planes = header.bands if header.interleave == "bsq" else 1
        chunks = tuple({ALONG_TRACK: lines, BAND: sizes[BAND] // planes}.get(dim, sizes[dim]) for dim in dims)
        # slabs of all planes in file order; line numbers continue from plane to plane
        row = header.line_bytes // planes
        offsets = slab_offsets(lines, 0, planes * header.lines // lines, header.header_offset, row)
        grid = tuple(sizes[dim] // chunk for dim, chunk in zip(dims, chunks, strict=True))
        manifest = ChunkManifest.from_arrays(
            paths=np.full(grid, data_url, np.dtypes.StringDType()),
            offsets=offsets.astype(np.uint64).reshape(grid),
            lengths=np.full(grid, lines * row, np.uint64),
        )
        metadata = create_v3_array_metadata(
            shape=tuple(sizes[dim] for dim in dims),
            data_type=header.dtype,
            chunk_shape=chunks,
            dimension_names=dims,
        )
        spectral = {"wavelength": header.wavelength, "fwhm": header.fwhm}
        attributes = {name: values.tolist() for name, values in spectral.items() if values is not None}
        group = ManifestGroup(
            arrays={self.variable: ManifestArray(metadata, manifest)},
            attributes={**attributes, "envi_header": json.dumps(header.fields)},
        )
        return ManifestStore(group=group, registry=registry)


Interleave = Literal["bil", "bip", "bsq"]

_WRITTEN_SUFFIXES = (".img", ".dat", ".raw", ".bil", ".bip", ".bsq")
_CODES = {np.dtype(name).name: code for code, name in DTYPES.items()}
_SCALE = 10_000
_IGNORE = 65_535
# Size of the pieces in which an array in memory is written [byte].
_BLOCK_BYTES = 64 * 2**20


@takes_quantities()
@documented()
def write_envi(
    dataset: xr.Dataset,
    path: str | os.PathLike[str],
    *,
    variable: str | None = None,
    interleave: Interleave | None = None,
    dtype: Literal["float32", "uint16"] | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write a cube of a flight line or of a map as ENVI.

    Parameters
    ----------
    dataset
        A flight line, (along_track, band, cross_track), or a map, (y, x, band), in any order of dims; or a
        plane, (along_track, cross_track) or (y, x). The position of a map comes from ``spatial_ref`` with
        ``GeoTransform`` (which may be rotated), or from ``x`` and ``y``.
    path
        The data file or the header; without a known suffix, ``.img`` is added.
    variable
    interleave
        By default ``"bil"`` for flight lines and ``"bip"`` for maps, the order of computation.
    dtype
        ``"float32"``; or ``"uint16"``, for reflectance times 10,000 (clipped to 0 to 6.5534), unknown
        samples 65535. By default floats are float32 (positions such as ``east`` and ``glt_line`` float64),
        and integers keep their type.
    overwrite
    progress

    Returns
    -------
    pathlib.Path
        The header.

    Raises
    ------
    SchemaError
        The variable is missing, its dims or type are wrong, or ENVI cannot describe its grid; all are
        listed.
    StoreError
        A file exists, or cannot be written. An existing file stays.
    MissingExtraError
        The map has a reference system, and pyproj is not installed.

    Notes
    -----
    ENVI describes rotated grids of square pixels. A grid whose rows count in the other direction (a
    mirrored one) is written from its last row on. `open_envi` reads float32 and integers back bit for bit.

    Examples
    --------
    >>> import tempfile, xarray as xr
    >>> from hyperpaint.io.envi.envi_cubes import open_envi
    >>> scratch = tempfile.TemporaryDirectory()
    >>> cube = xr.DataArray(np.ones((2, 3, 4), "f4"), dims=("along_track", "band", "cross_track"))
    >>> line = cube.assign_attrs(units="1").to_dataset(name="reflectance")
    >>> header = write_envi(line, Path(scratch.name) / "line")
    >>> header.name, dict(open_envi(header).sizes)
    ('line.hdr', {'along_track': 2, 'band': 3, 'cross_track': 4})
    >>> scratch.cleanup()
    """
    # the array (line, sample, band) in its stored dtype, still lazy
    cube = product_of(dataset, variable)
    name = str(cube.name)
    if dtype is not None:
        one_of(str(dtype), ("float32", "uint16"), "dtype")
    if dtype == "uint16" and cube.dtype.kind == "f":
        SchemaError.raise_if(
            name != "reflectance",
            f"{name!r} is {cube.dtype}",
            expected="reflectance, the only variable of floats that is written as uint16",
            mend="pass dtype='float32'",
            code="type-wrong",
        )
        scaled = (cube * np.float32(_SCALE)).round().clip(0, _IGNORE - 1).fillna(_IGNORE)
        cube = scaled.astype(np.uint16).assign_attrs(cube.attrs)
    else:
        cube = cube.astype(np.float32, copy=False) if dtype == "float32" else storable(cube)
    grid = grid_of(dataset) if "y" in cube.dims else None
    if grid is not None and grid.mirrored:
        # with the order of rows reversed
        a, b, c, d, e, f = grid.transform
        grid = replace(grid, transform=(a + cube.sizes["y"] * c, b, -c, d + cube.sizes["y"] * f, e, -f))
        cube = cube.isel(y=slice(None, None, -1))
    order = interleave or ("bil" if grid is None and "y" not in cube.dims else "bip")
    one_of(order, FILE_AXES, "interleave")
    stored = cube.transpose(*[dict(zip("lsb", cube.dims, strict=True))[axis] for axis in FILE_AXES[order]])
    header = _header(dataset, cube, order, grid)
    # names of data file and header
    data_path = header_path = as_path(path)
    if data_path.suffix.lower() == ".hdr":
        data_path = header_path.with_suffix(".img")
    elif data_path.suffix.lower() in _WRITTEN_SUFFIXES:
        header_path = data_path.with_suffix(".hdr")
    else:
        data_path, header_path = (data_path.with_name(data_path.name + suffix) for suffix in (".img", ".hdr"))
    with published_files([data_path, header_path], overwrite=overwrite) as (data_file, header_file):
        _fill_file(data_file, stored, progress)
        header_file.write_bytes(header.encode())
    return header_path


# --- array and header --------------------------------------------------------------------------------------


def _header(dataset: xr.Dataset, cube: xr.DataArray, interleave: str, grid: Grid | None) -> str:
    lines, samples, bands = cube.shape
    name = str(cube.name)
    is_scaled = name == "reflectance" and cube.dtype.kind == "u"
    title = _printable(str(dataset.attrs.get("title") or dataset.attrs.get("source") or "hyperpaint"))
    # readers take the last processing level in a description as the quantity
    quantity_text = f", {name.upper()}" if name in ("radiance", "reflectance") else f", {name}"
    units = cube.attrs.get("units")
    ignore = "nan" if cube.dtype.kind == "f" else cube.attrs.get("data_ignore_value")
    # keys and values in the order of the header; those of None are left out
    fields: dict[str, Any] = {
        "description": f"{{{title}{quantity_text}}}",
        "samples": samples,
        "lines": lines,
        "bands": bands,
        "header offset": 0,
        "file type": "ENVI Standard",
        "data type": _CODES[cube.dtype.name],
        "interleave": interleave,
        "byte order": 0,
        ";Units": _printable(str(units)) if units else None,
        "reflectance scale factor": _SCALE if is_scaled else None,
        "data ignore value": _IGNORE if is_scaled else ignore,
    }
    axis = dataset.variables.get("wavelength")
    if BAND not in dataset[name].dims:
        fields["band names"] = f"{{{_printable(name)}}}"
    elif axis is not None and axis.dims == (BAND,):
        # lists of the bands, where all of their values are finite
        for key, variable_name, kind in (
            ("wavelength", "wavelength", np.float64),
            ("fwhm", "fwhm", np.float64),
            ("bbl", "good", int),
        ):
            variable = dataset.variables.get(variable_name)
            if variable is None or variable.dims != (BAND,) or not np.isfinite(variable.values).all():
                continue
            values = variable.values.astype(np.float64)
            if key == "wavelength":
                fields["wavelength units"] = "Nanometers"
            fields[key] = braced(list(map(repr, variable.values.astype(kind).tolist())))
            if key == "wavelength" and (rgb_bands := nearest_bands(values, RGB_WAVELENGTHS)) is not None:
                fields["default bands"] = f"{{{', '.join(str(band + 1) for band in rgb_bands)}}}"
    if grid is not None:
        fields |= {key: f"{{{value}}}" for key, value in envi_map_info(grid).items()}
    return "\n".join(
        ["ENVI", *(f"{key} = {value}" for key, value in fields.items() if value is not None), ""]
    )


def _printable(text: str) -> str:
    # Return text without braces and line ends.
    return "".join(mark if mark.isprintable() and mark not in "{}" else " " for mark in text)[:500]


# --- the data file -----------------------------------------------------------------------------------------


@dataclass(eq=False)
class _Target:
    # File to which blocks of an array are written at their positions, by any thread, in any order.
    # Blocks go through `os.pwrite`: a memory map would hold written pages in memory.
    path: str
    shape: tuple[int, int, int]
    dtype: np.dtype[Any]
    progress: Callable[[int, int], None] | None = None
    done: int = 0
    lock: Any = field(default_factory=threading.Lock)

    def __getstate__(self) -> dict[str, Any]:
        # progress is not reported from another machine
        return {**self.__dict__, "progress": None, "lock": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, lock=threading.Lock())

    def __setitem__(self, region: tuple[slice, slice, slice], block: Array) -> None:
        block = np.ascontiguousarray(block, self.dtype.newbyteorder("<"))
        starts = [part.indices(size)[0] for part, size in zip(region, self.shape, strict=True)]
        _, rows, columns = self.shape
        has_full_rows = block.shape[2] == columns
        descriptor = os.open(self.path, os.O_WRONLY)
        try:
            for plane in range(block.shape[0]):
                first = ((starts[0] + plane) * rows + starts[1]) * columns + starts[2]
                for row, piece in enumerate([block[plane]] if has_full_rows else block[plane]):
                    view = piece.reshape(-1).view(np.uint8).data
                    offset = (first + row * columns) * self.dtype.itemsize
                    while len(view):
                        count = os.pwrite(descriptor, view, offset)
                        view, offset = view[count:], offset + count
            if block.shape[1:] == self.shape[1:] and hasattr(os, "posix_fadvise"):
                # Linux starts to write these pages, so that the final flush is short
                first_byte, size = starts[0] * rows * columns * self.dtype.itemsize, block.nbytes
                os.posix_fadvise(descriptor, first_byte, size, os.POSIX_FADV_DONTNEED)
        finally:
            os.close(descriptor)
        with self.lock:
            self.done += block.size
            if self.progress is not None:
                self.progress(self.done, int(np.prod(self.shape)))


def _fill_file(path: Path, stored: xr.DataArray, progress: Callable[[int, int], None] | None) -> None:
    # Write an array in the order of its dims.
    shape = (stored.shape[0], stored.shape[1], stored.shape[2])
    with open(path, "wb") as file:
        size = stored.size * stored.dtype.itemsize
        file.truncate(size)
        if size and hasattr(os, "posix_fallocate"):
            try:
                os.posix_fallocate(file.fileno(), 0, size)
            except OSError as error:
                # a full disk is reported before anything is computed; some file systems do not support this
                if error.errno == errno.ENOSPC:
                    raise
    target = _Target(os.path.abspath(path), shape, stored.dtype, progress)
    if stored.chunks is not None:
        import dask.array as da

        da.store(stored.data, target, lock=False)
        return
    step = max(1, _BLOCK_BYTES // max(1, int(np.prod(shape[1:])) * stored.dtype.itemsize))
    for first in range(0, shape[0], step):
        part = slice(first, min(first + step, shape[0]))
        target[part, slice(None), slice(None)] = stored[part].values
