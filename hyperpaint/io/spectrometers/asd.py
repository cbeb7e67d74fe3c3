"""Spectra of ASD field spectrometers as labelled arrays, and the layout of their files.

Binary files (``.asd``, versions 1 to 8) follow "ASD File Format, version 8, revision B" as corrected by
reading real files to their last byte: little-endian throughout, a fixed header, the spectrum, and from
version 2 on the white reference and blocks that later versions added. A file has no checksum, so that only
its structure can be checked: every declared count is compared with the number of bytes not yet read, and the
last block must end at the file's end.

Text exports of ViewSpec are a table ``Wavelength;name.asd`` whose cells are separated by semicolons, tabs or
commas, with one column or (exported by rows) one row for each spectrum, with or without a preamble of
sentences. The preamble may contain the comment field as NUL bytes, a blank first line and undocumented
sentences. No export contains the quantity, its units, or the UTC offset of the time stamp.
"""

import datetime as dt
import math
import os
import re
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import numpy as np
import xarray as xr

from hyperpaint.base import (
    VARIABLES,
    Bools,
    Floats,
    FormatError,
    Problem,
    SchemaError,
    TimeError,
    as_path,
    grouped,
    head_of,
    label,
    listed,
    one_of,
    read_limited,
    warn_if,
    warn_user,
)
from hyperpaint.io.files.reading import foreign_format, read_limited_text, refuse
from hyperpaint.io.library.spectra_files import (
    PERCENT,
    PERCENT_LINE,
    foreign_quantity,
    in_nanometres,
    reflectances,
)

from .record_faults import clipped_top
from .spectrum_texts import (
    QUANTITIES,
    SPECTRUM_SUFFIXES,
    Paths,
    SpectrumText,
    cell_number,
    check_utc_offset,
    common_quantity,
    dialect_of,
    find_paths,
    for_all,
    form_of,
    is_logger_csv,
    name_spectra,
    ratio,
    read_spectrum_text,
    require_one_grid,
    statistics_among,
    text_lines,
    warn_of,
)

Kind = Literal["binary", "text", "table", "scans", "instrument", "csv", "unknown"]

_ENDINGS = re.compile(r"(\.(asd|txt|tsv|csv))+\Z", re.I)
_AGAIN = "copy the file again from the instrument"


# --- layout of binary files --------------------------------------------------------------------------------


_HEADER_BYTES = 484
_MAX_BINARY_BYTES = 64 * 2**20  # ten times the size of 65,535 channels with every calibration block

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
# Blocks after the white reference: the version that added each, its name, and its parts: struct formats,
# "text" for a text after its length, or an OLE SAFEARRAY as the least bytes of an item and the item's parts
_BLOCKS: tuple[tuple[int, str, tuple[Any, ...]], ...] = (
    (6, "the classifier block", ("BB", *["text"] * 20, "H", (96, "text", "text", "9di2d"))),
    (7, "the dependent variables", ("hh", (2, "text"), (4,))),
    (7, "the calibration blocks", ()),
    (8, "the audit log", ("i", (2, "text"))),
    (8, "the signature", ("Bq", *["text"] * 7, "128s")),
)
_CALIBRATION_KINDS = ("ABS", "BSE", "LMP", "FO")
_TRAILER = b"\xff\xfe\xfd"  # appended by newer software when it saves a file again
_OLE_EPOCH_DAYS = 25569  # 1970-01-01 in days since 1899-12-30


class AsdGps(NamedTuple):
    # Position of the spectrometer by its GPS.

    latitude: float  # degrees, north positive
    longitude: float  # degrees, east positive (in the file, west is positive)
    altitude: float  # metres
    utc: dt.time  # time of day of the fix; the file has no date of it


class AsdCalibration(NamedTuple):
    # One calibration block of a file.
    # By kind: ABS, panel reflectance; BSE, panel reflectance for radiance; LMP, lamp irradiance [W m-2 nm-1];
    # FO, lamp counts.

    name: str  # name of the calibration file that the block was copied from
    integration_ms: float  # integration time of the calibration, see `nominal_integration_ms`
    values: Floats  # (wavelength)


@dataclass(frozen=True, eq=False)
class AsdFile:
    # Content of one ``.asd`` file; arrays are (wavelength), float64 and read-only.

    name: str  # file name without its folder
    version: int  # 1 to 8
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
    # Wavelengths [nm] at which VNIR and SWIR 1 end; -1 for a detector that the instrument lacks
    splices: tuple[float, float]
    gps: AsdGps | None  # None without a fix
    calibrations: Mapping[str, AsdCalibration]  # calibration blocks by kind
    instrument: str  # model and serial number
    instrument_number: int
    fore_optic: int  # field of view [degree]; 0 for no optic, 180 or more for a cosine receptor
    dark_subtracted: bool
    saturated: frozenset[str]  # detectors flagged as saturated: ``VNIR``, ``SWIR1``, ``SWIR2``


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
    # Reads a file from front to back and refuses to read past its end.

    def __init__(self, data: bytes, name: str) -> None:
        self.data, self.name, self.position = data, name, 0

    @property
    def remaining(self) -> int:
        # Number of bytes not read yet.
        return len(self.data) - self.position

    @property
    def at_end(self) -> bool:
        # Whether nothing, or only the trailer of newer software, remains to be read.
        return self.data[self.position :] in (b"", _TRAILER)

    def bytes(self, count: int, part: str) -> bytes:
        # Read ``count`` bytes; the name of the ``part`` appears in messages.
        FormatError.raise_if(
            count > self.remaining,
            f"{self.name}: {part} needs {count} bytes at offset {self.position}, {self.remaining} remain",
            mend=_AGAIN,
            code="file-truncated",
        )
        self.position += count
        return self.data[self.position - count : self.position]

    def values(self, fmt: str, part: str) -> tuple[Any, ...]:
        # Read the values of a struct format, little-endian.
        return struct.unpack("<" + fmt, self.bytes(struct.calcsize("<" + fmt), part))

    def text(self, part: str) -> str:
        # Read a text, which is stored after its length.
        (length,) = self.values("H", f"the length of a text in {part}")
        return _text_of_bytes(self.bytes(length, part))

    def array(self, count: int, dtype: np.dtype[Any], part: str) -> Floats:
        # Read ``count`` numbers as read-only float64.
        raw = np.frombuffer(self.bytes(count * dtype.itemsize, part), dtype)
        with np.errstate(invalid="ignore"):  # signalling NaN in a damaged file
            values = raw.astype(np.float64)
        values.flags.writeable = False
        return values

    def skip(self, layout: tuple[Any, ...], part: str) -> None:
        # Read the parts of a block of `_BLOCKS` without keeping them.
        for piece in layout:
            if piece == "text":
                self.text(part)
            elif isinstance(piece, str):
                self.values(piece, part)
            else:
                # a SAFEARRAY: its number of dimensions, and count and lower bound of each
                item_bytes, *items = piece
                (dims,) = self.values("H", part)
                refuse(
                    self.name,
                    (
                        dims * 8 > self.remaining or dims > 60,
                        Problem(f"{part} has an array of {dims} dimensions", code="file-damaged"),
                    ),
                )
                count = math.prod(self.values("Ii", part)[0] for _ in range(dims)) if dims else 0
                size = f"{part} declares {count} items, which do not fit into the remaining"
                refuse(
                    self.name,
                    (
                        count * item_bytes > self.remaining,
                        Problem(f"{size} {self.remaining} bytes", code="file-damaged"),
                    ),
                )
                if not items:
                    self.bytes(item_bytes * count, part)
                for _ in range(count if items else 0):
                    self.skip(tuple(items), part)


def read_asd(path: str | os.PathLike[str]) -> AsdFile:
    # Read one binary ``.asd`` file, of any version, to its last byte.
    #
    # path: A file of an ASD FieldSpec, HandHeld or LabSpec; also their calibration files ``.ill``, ``.raw``
    # and
    #     ``.ref``, which have the same layout.
    # Returns AsdFile: Header, spectrum (wavelength), white reference and calibration blocks.
    # Raises FormatError: The file cannot be read, is not an ``.asd`` file, or is truncated, over-long or
    #     contradictory.
    path = as_path(path)
    data = read_limited(path, _MAX_BINARY_BYTES, "an ASD spectrometer's file")
    version = _VERSIONS.get(data[:3], 0)
    refuse(
        path.name,
        (
            version == 0,
            Problem(f"begins with {data[:3]!r}", expected="one of ASD, as2 to as8", code="format-unknown"),
        ),
    )
    cursor = Cursor(data, path.name)
    header: dict[str, Any] = {}
    for name, fmt in _HEADER:
        values = cursor.values(fmt, f"the header ({name})")
        header[name] = values[0] if len(values) == 1 else values
    first, step, channels = header["first_wavelength"], header["wavelength_step"], header["channels"]
    refuse(
        path.name,
        (
            header["data_format"] not in _DTYPES,
            Problem(
                f"data format {header['data_format']}",
                expected="0 float, 1 integer or 2 double",
                code="file-damaged",
            ),
        ),
        (
            header["data_type"] >= len(_DATA_TYPES),
            Problem(
                f"data type {header['data_type']}",
                expected=f"0 to {len(_DATA_TYPES) - 1}",
                code="file-damaged",
            ),
        ),
        (channels == 0, Problem("the file has no channels", code="empty-input")),
        (
            not (0 < first < 1e5 and 0 < step < 1e4),
            Problem(
                f"first wavelength {first} nm, step {step} nm",
                expected="positive numbers",
                code="file-damaged",
            ),
        ),
    )
    dtype = _DTYPES[header["data_format"]]
    spectrum = cursor.array(channels, dtype, "the spectrum")
    reference, utc_offset_h, description = None, None, ""
    if version >= 2:
        flag, ole_days, _ = cursor.values("Hdd", "the head of the white reference")
        refuse(
            path.name,
            (
                flag not in (0, 0xFFFF),
                Problem(
                    f"white reference flag {flag:#06x}", expected="0x0000 or 0xffff", code="file-damaged"
                ),
            ),
        )
        description = cursor.text("the description of the white reference")
        # without a white reference, the file contains zeros or an outdated reference here
        counts = cursor.array(channels, dtype, "the white reference")
        reference = counts if flag and np.any(counts != 0.0) else None
        # local time minus UTC [h], a multiple of a quarter of an hour, from the two stamps of the reference
        if reference is not None and header["reference_epoch"] > 0 and 0 < ole_days < 1e5:
            seconds = (ole_days - _OLE_EPOCH_DAYS) * 86400.0 - header["reference_epoch"]
            hours = round(seconds / 900.0) / 4.0
            is_zone = abs(seconds - hours * 3600.0) < 60.0 and -12.0 <= hours <= 14.0
            utc_offset_h = hours if is_zone else None
    calibrations: dict[str, AsdCalibration] = {}
    for first_version, part, layout in _BLOCKS:
        if version < first_version or (version == 6 and cursor.at_end):
            continue
        cursor.skip(layout, part)
        if part != "the calibration blocks":
            continue
        # the heads of all calibration blocks, then the values of all
        (count,) = cursor.values("B", "the number of calibration blocks")
        heads = [cursor.values("b20sihh", "the head of a calibration block") for _ in range(count)]
        numbers = [head[0] for head in heads]
        found = f"calibration blocks of types {numbers[:8]}"
        refuse(
            path.name,
            (not {*numbers} <= {0, 1, 2, 3}, Problem(found, expected="0 to 3", code="file-damaged")),
            (len({*numbers}) < count, Problem(found, expected="one of each", code="file-damaged")),
        )
        for number, name, milliseconds, *_ in heads:
            kind = _CALIBRATION_KINDS[number]
            calibrations[kind] = AsdCalibration(
                _text_of_bytes(name),
                nominal_integration_ms(milliseconds),
                cursor.array(channels, np.dtype("<f8"), f"the {kind} calibration block"),
            )
    refuse(
        path.name,
        (
            not cursor.at_end,
            Problem(
                f"{cursor.remaining} bytes follow the last block of a version {version} file",
                code="file-damaged",
            ),
        ),
    )
    second, minute, hour, day, month, year = header["saved"][:6]
    with FormatError.instead_of(
        ValueError,
        f"{path.name}: time of the spectrum {header['saved'][:6]} is not a date",
        code="time-unreadable",
    ):
        if not (80 <= year < 250 and 0 <= second <= 61):
            raise ValueError
        # C's struct tm allows second 60, datetime does not
        local_time = dt.datetime(year + 1900, month + 1, day, hour, minute) + dt.timedelta(seconds=second)
    wavelength: Floats = first + step * np.arange(channels, dtype=np.float64)
    wavelength.flags.writeable = False
    dark_s = header["dark_epoch"]
    return AsdFile(
        name=path.name,
        version=version,
        description=description,
        local_time=local_time,
        utc_offset_h=utc_offset_h,
        dark_utc=dt.datetime(1970, 1, 1) + dt.timedelta(seconds=dark_s) if dark_s > 0 else None,
        data_type=_DATA_TYPES[header["data_type"]],
        wavelength=wavelength,
        spectrum=spectrum,
        reference=reference,
        integration_ms=nominal_integration_ms(header["integration_ms"]),
        sample_averages=header["averages"][2],
        splices=header["splices"],
        gps=_gps_fix(path.name, header["gps"]),
        calibrations=MappingProxyType(calibrations),
        instrument=_INSTRUMENTS.get(header["instrument"], f"unknown ({header['instrument']})"),
        instrument_number=header["instrument_number"],
        fore_optic=header["fore_optic"],
        dark_subtracted=bool(header["dark_subtracted"]),
        saturated=frozenset(d for bit, d in _DETECTORS.items() if header["flags"][1] & bit),
    )


def _gps_fix(name: str, block: bytes) -> AsdGps | None:
    # Return the position in the GPS block of the header; None if the GPS had no fix.
    values = struct.unpack("<5dhbbbbbh5sbb", block)
    _, _, latitude, longitude, altitude, _, _, second, minute, hour = values[:10]
    if latitude == longitude == altitude == 0.0:
        return None
    with FormatError.instead_of(
        ValueError,
        f"{name}: GPS position {latitude}, {longitude}, {altitude} m at {hour}:{minute}:{second}",
        expected="ddmm.mmmm, dddmm.mmmm and metres",
        code="file-damaged",
    ):
        degrees = []
        for ddmm, limit in ((latitude, 90.0), (longitude, 180.0)):
            whole, minutes = divmod(abs(ddmm), 100.0)
            if not (abs(ddmm) <= limit * 100.0 and minutes < 60.0 and abs(altitude) < 1e5):
                raise ValueError
            degrees.append(math.copysign(whole + minutes / 60.0, ddmm))
        # in the file, west is positive
        return AsdGps(degrees[0], -degrees[1], altitude, dt.time(hour, minute, second))


def _text_of_bytes(raw: bytes) -> str:
    return raw.split(b"\0", 1)[0].decode("latin-1").strip()


# --- layout of text exports --------------------------------------------------------------------------------


class Export(NamedTuple):
    # Form of a text of spectra that the software of a spectrometer exports.
    instrument: str
    heading: re.Pattern[str]  # of the line of names, from which cells are separated by `_SEPARATORS`
    # Facts in the sentences above: a pattern of the sentence, and its meaning (None takes the first group)
    preamble: Mapping[str, tuple[str, Callable[[re.Match[str]], Any]]]


def _export_time(match: re.Match[str]) -> dt.datetime:
    month, day, year, hour, minute, second = (int(match[i]) for i in range(1, 7))
    if match[7]:
        hour = hour % 12 + (12 if match[7].upper() == "PM" else 0)
    # older programs write years since 1900
    stamp = dt.datetime(year + 1900 if year < 1000 else year, month, day, hour, minute, second)
    if not 1980 <= stamp.year < 2150:
        raise ValueError
    return stamp


_NUMBER = r"([-+]?[0-9]+(?:\.[0-9]*)?(?:[Ee][-+]?[0-9]+)?)"
_SEPARATORS = (";", "\t", ",")
EXPORTS = (
    Export(
        instrument="ASD",
        heading=re.compile(r'"?wavelengths?"?\s*[;,\t]', re.IGNORECASE),
        preamble={
            # local time of the logging PC when it saved the spectrum
            "local_time": (
                r"spectrum saved:?\s*(\d{1,2})/(\d{1,2})/(\d{1,4})\s+at\s+(\d{1,2}):(\d\d):(\d\d)\s*([AP]M)?",
                _export_time,
            ),
            "instrument_number": (r"instrument number(?: was|:)\s*(\S{1,40})", lambda match: match[1]),
            "integration_ms": (
                r"VNIR integration time\s*:\s*(\d{1,9})(?!\d)",
                lambda match: nominal_integration_ms(int(match[1])),
            ),
            "sample_averages": (
                r"\b(\d{1,6}|one) samples? per data value",
                lambda match: 1 if match[1].lower() == "one" else int(match[1]),
            ),
            # upper end of the operator's plot, the only hint at the quantity
            "ymax": (rf"ymax\s*=\s*{_NUMBER}", lambda match: float(match[1])),
            # range of the operator's plot [nm]
            "plotted": (
                rf"xmin\s*=\s*{_NUMBER}\s*xmax\s*=\s*{_NUMBER}",
                lambda match: (float(match[1]), float(match[2])),
            ),
            "splices": (
                rf"join between VNIR and SWIR1 was {_NUMBER} nm(?s:.){{0,200}}?"
                rf"SWIR1 and SWIR2 was {_NUMBER} nm",
                lambda match: (float(match[1]), float(match[2])),
            ),
            # whether a cosine receptor was attached, and whether a white reference was measured
            "cosine_receptor": (
                r"there was (.{0,80}?) attached",
                lambda match: "cosine receptor" in match[1].lower(),
            ),
            "white_reference": (
                r"data is (not )?compared to a white reference",
                lambda match: match[1] is None,
            ),
        },
    ),
)
_QUANTITY_BY_YMAX = {1.25: "reflectance", 2.5: "irradiance", 65535.0: "counts"}
_MAX_TEXT_BYTES = 512 * 2**20
#: Number of rows from which a table that begins with the plot should end with it.
_MIN_PLOTTED = 50


class AsdText(NamedTuple):
    # Content of one text export; arrays are float64 and read-only.

    name: str  # file name without its folder
    instrument: str
    spectra: tuple[str, ...]  # names of the spectra
    wavelength: Floats  # (wavelength) [nm]
    values: Floats  # (spectrum, wavelength), in the exported quantity
    preamble: Mapping[str, Any]  # facts of `Export.preamble`; None where the export does not state them
    is_plain: bool  # whether any program may have written the table
    is_percent: bool  # whether a line above the table states percent

    @property
    def likely_quantity(self) -> str | None:
        # Quantity guessed from the upper end of the operator's plot.
        return _QUANTITY_BY_YMAX.get(self.preamble.get("ymax") or 0.0)


def _export_at(lines: Sequence[str]) -> tuple[Export, int] | None:
    # Return the form of an export, and the number of its heading among the lines.
    return next(((e, i) for i, line in enumerate(lines) for e in EXPORTS if e.heading.match(line)), None)


def _is_plain(head: str) -> bool:
    # Return whether a table has no sentence and no name of ViewSpec: any program may have written it.
    facts = (pattern for export in EXPORTS for pattern, _ in export.preamble.values())
    return not any(re.search(pattern, head, re.IGNORECASE) for pattern in (r"\.asd\b", *facts))


def read_asd_text(path: str | os.PathLike[str]) -> AsdText:
    r"""Read one text export of ASD spectra.

    path: A file that ViewSpec exported, of any of its variants.
    Returns AsdText: Spectra (spectrum, wavelength) and the fields of the preamble.
    Raises FormatError: The file cannot be read, or has no table ``Wavelength``, or its table is damaged.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp(), "sky.txt")
    >>> _ = path.write_text("Wavelength;sky.asd\n550; 0.89 \n551; 9.1E-01 \n")
    >>> read_asd_text(path).values
    array([[0.89, 0.91]])
    """
    path = as_path(path)
    name, again = path.name, "export the spectra again"
    lines = text_lines(read_limited_text(path, _MAX_TEXT_BYTES, "a text export of spectra"))
    found = FormatError.raise_if_none(
        _export_at(lines),
        f"{name}: no line begins with 'Wavelength' and a separator",
        expected="a text export of ASD spectra",
        code="format-unknown",
    )
    export, start = found
    # the preamble
    text = "\n".join(lines[:start])
    preamble: dict[str, Any] = {}
    for key, (pattern, meaning) in export.preamble.items():
        match = re.search(pattern, text, re.IGNORECASE)
        with FormatError.instead_of(
            ValueError,
            f"{name}: {match[0] if match else ''!r} is not a date",
            expected="month/day/year",
            code="time-unreadable",
        ):
            preamble[key] = None if match is None else meaning(match)
    # the heading: names of the spectra, or their wavelengths if each row is a spectrum
    separator = max(_SEPARATORS, key=lines[start].count)
    names = [cell.strip().strip('"') for cell in lines[start].split(separator)]
    while names and not names[-1]:  # a separator at the end of the line
        names.pop()
    is_spectrum_per_row = all(cell_number(cell) is not None for cell in names[1:])
    refuse(
        name,
        (
            len(names) < 2,
            Problem("the table has no column beside 'Wavelength'", mend=again, code="column-missing"),
        ),
    )
    # the rows: lines of another kind, such as ``x2bar``, may precede and follow, but not interrupt them
    labels: list[str] = []
    rows: list[list[float | None]] = []
    is_ended = False
    for line_number, line in enumerate(lines[start + 1 :], start=2):
        cells = [cell.strip() for cell in line.rstrip().rstrip(separator).split(separator)]
        if not (line.strip() and (is_spectrum_per_row or cell_number(cells[0]) is not None)):
            is_ended = is_ended or bool(labels and line.strip())
            continue
        row = [cell_number(cell) for cell in cells[1:]]
        FormatError.raise_if(
            len(cells) != len(names) or None in row or is_ended,
            f"{name}: line {line_number} of the table holds {line.strip()[:60]!r}",
            expected=f"{len(names)} cells separated by {separator!r}",
            mend=again,
            code="row-unreadable",
        )
        labels.append(cells[0])
        rows.append(row)
    spectra, nanometres = (labels, names[1:]) if is_spectrum_per_row else (names[1:], labels)
    wavelength = np.array([cell_number(cell) for cell in nanometres], np.float64)
    is_ordered = np.all(np.isfinite(wavelength) & (wavelength > 0)) and np.all(np.diff(wavelength) > 0)
    refuse(
        name,
        (not labels, Problem("the table is empty", mend=again, code="table-missing")),
        (not is_ordered, Problem("the wavelengths do not increase", mend=again, code="wavelength-unordered")),
    )
    wavelength, _ = in_nanometres("", wavelength, name)
    table = np.array(rows, np.float64)
    values = np.ascontiguousarray(table if is_spectrum_per_row else table.T)
    statistics = [] if is_spectrum_per_row else statistics_among(spectra)
    kept = [number for number, spectrum in enumerate(spectra) if spectrum not in statistics]
    first, last = preamble.get("plotted") or (math.inf, 0.0)
    if len(wavelength) >= _MIN_PLOTTED and wavelength[0] <= first and wavelength[-1] < last - 1.0:
        warn_of(
            f"the table ends at {wavelength[-1]:g} nm, its plot at {last:g} nm: copy a truncated file again",
            [name],
            "file-truncated",
        )
    if statistics and kept:
        warn_of(
            f"columns {', '.join(map(repr, statistics))} are statistics, not spectra, and are left out",
            [name],
            "columns-left-out",
        )
        spectra, values = [spectra[number] for number in kept], values[kept]
    wavelength.flags.writeable = values.flags.writeable = False
    return AsdText(
        name,
        export.instrument,
        tuple(spectra),
        wavelength,
        values,
        preamble,
        is_plain=_is_plain("\n".join(lines[: start + 100])[:_HEAD_BYTES]),
        is_percent=any(map(PERCENT_LINE.match, lines[:start])),
    )


# --- files of any kind -------------------------------------------------------------------------------------


_HEAD_BYTES = 16 * 1024
NETCDF_NAME = re.compile(r"\.(?:nc4?|h5)$", re.IGNORECASE)


def find_files(paths: Paths) -> list[Path]:
    # Return the files of ``paths``: a file, a glob, a folder of spectra, or a list of these.
    # From a folder, the ``.asd`` files (of old software: ``.000`` and other numbers), or else its text
    # files, or else its netCDF files.
    # Raises FormatError: No such file is found.

    def of_folder(files: list[Path]) -> list[Path]:
        binaries = [path for path in files if path.suffix.lower() == ".asd" or path.suffix[1:].isdigit()]
        texts = [path for path in files if path.suffix.lower() in SPECTRUM_SUFFIXES]
        return binaries or texts or [path for path in files if NETCDF_NAME.search(path.name)]

    return find_paths(paths, of_folder, ".asd files, texts of spectrometers, a csv or netCDF files")


def sniff(path: Path) -> Kind:
    # Return the kind of spectra in a file, by its first bytes; ``unknown`` also for a missing file.
    head = head_of(path, _HEAD_BYTES)
    if head[:3] in _VERSIONS and b"\0" in head[:_HEADER_BYTES]:
        return "binary"
    lines = text_lines(head)
    if dialect_of(head) is not None:
        return "scans"
    if form_of("\n".join(lines)) is not None:
        return "instrument"
    if _export_at(lines) is not None:
        return "table" if _is_plain("\n".join(lines)) else "text"
    return "csv" if is_logger_csv(lines) else "unknown"


def _read_file(path: Path) -> AsdFile | AsdText | SpectrumText:
    kind = sniff(path)
    if kind not in ("binary", "text", "table", "instrument"):
        is_file, exists = path.is_file(), os.path.lexists(path)
        unknown = Problem(
            "no file of a field spectrometer",
            expected="a binary .asd file, a text of a spectrometer, or a csv 'time,350,351,...'",
            mend="write such a csv, or pass an xarray object with the dims time and wavelength",
            code="format-unknown",
        )
        refuse(
            path.name,
            (
                kind == "scans",
                Problem(
                    "a file of an SVC spectrometer",
                    mend="open it with hp.open_svc, and pass its irradiance with .swap_dims(spectrum='time')",
                    code="format-unknown",
                ),
            ),
            (is_file, (foreign_format(path) if is_file else None) or unknown),
            (exists, Problem("a pipe, a device or a broken link", code="file-not-plain")),
            (True, Problem("no such file", code="file-not-found")),
        )
    return (
        read_asd(path)
        if kind == "binary"
        else (read_spectrum_text if kind == "instrument" else read_asd_text)(path)
    )


# --- from counts to quantities -----------------------------------------------------------------------------


_QUANTITY_OF_DATA_TYPE = {"raw": "counts", **{name: name for name in QUANTITIES[1:]}}
#: Kind of the block that a calibration file replaces, by its key in ``calibration``.
_CALIBRATION_KEYS = {"lamp": "LMP", "fore_optic": "FO", "panel": "BSE", "absolute": "ABS"}
#: Blocks that a quantity needs, and its name in messages.
_BLOCKS_BY_QUANTITY = {
    "irradiance": ("LMP", "FO"), "radiance": ("LMP", "FO", "BSE"), "absolute reflectance": ("ABS",)
}  # fmt: skip


def _receptor_conflict(content: AsdFile | AsdText | SpectrumText, quantity: str) -> str:
    # Return the setting of the instrument that contradicts a quantity; empty without one.
    if isinstance(content, SpectrumText):  # its columns name their quantity
        is_conflict = quantity == "irradiance" and re.search(r"\{radiance\}", content.fore_optic, re.I)
        return f"fore optic {content.fore_optic[:40]!r}" if is_conflict else ""
    if isinstance(content, AsdText):
        has_cosine = content.preamble.get("cosine_receptor")
        if quantity == "irradiance" and has_cosine is False:
            return "no cosine receptor attached"
        return "a cosine receptor attached" if quantity == "radiance" and has_cosine else ""
    if quantity == "irradiance" and 0 < content.fore_optic < 180:
        return f"fore optic of {content.fore_optic} degree"
    if quantity == "irradiance" and content.data_type == "radiance":
        return "calibration for radiance, by its data type"
    return "cosine receptor as fore optic" if quantity == "radiance" and content.fore_optic >= 180 else ""


@dataclass(frozen=True, eq=False)
class Spectrum:
    # A spectrum of one quantity (such as radiance), from a binary or text file.
    source: str  # file name, with the column if the file holds several spectra
    wavelength: Floats  # (wavelength) [nm], float64
    values: Floats
    # Local time of the logging PC, its UTC offset [h], and the averaging window [s]; None if not in the file
    local_time: dt.datetime | None = None
    utc_offset_h: float | None = None
    averaging_s: float | None = None
    dark_utc: dt.datetime | None = None  # UTC of the last dark measurement
    gps: AsdGps | None = None
    # (wavelength), True at channels of a detector that the file flags as saturated
    saturated: Bools | None = None
    # (wavelength), True at channels whose raw counts were clipped although no flag says so
    clipped: Bools | None = None
    path: Path | None = None
    # Name of the white panel whose known reflectance scales the spectrum; empty for relative reflectance
    panel: str = ""
    instrument: str = "ASD"
    conflict: str = ""  # Setting of the instrument that contradicts the quantity


def read_spectra(
    files: Sequence[Path],
    quantity: str | None,
    *,
    absolute: bool = False,
    calibration: Mapping[str, str | os.PathLike[str]] | None = None,
    is_declared: bool = True,
    units: str | None = None,
) -> tuple[list[Spectrum], str]:
    # Read binary files and text exports into spectra of one quantity on one set of wavelengths.
    #
    # is_declared: Whether ``quantity`` is from the user, whose word counts more than that of the files.
    # units: Of texts of other instruments than ASD that do not say.
    # Returns spectra : list of Spectrum: In the order of ``files``.
    # Returns quantity : str: Their quantity.
    # Raises FormatError: See `open_asd`.
    # Raises SchemaError: See `open_asd`.
    if quantity is not None:
        one_of(quantity, QUANTITIES, "quantity")
    # calibration files of the caller, by kind of block
    calibration = calibration or {}
    SchemaError.raise_if(
        unknown := sorted(set(calibration) - set(_CALIBRATION_KEYS)),
        f"calibration keys {unknown}",
        expected=f"some of {', '.join(_CALIBRATION_KEYS)}",
        code="key-unknown",
    )
    external_files = {
        _CALIBRATION_KEYS[key]: file
        for key, file in zip(calibration, for_all(calibration.values(), read_asd), strict=True)
    }
    contents = for_all(files, _read_file)
    texts = [content.name for content in contents if isinstance(content, AsdText)]
    target_quantity = quantity or common_quantity(
        (
            _QUANTITY_OF_DATA_TYPE.get(content.data_type)
            if isinstance(content, AsdFile)
            else content.quantity
            if isinstance(content, SpectrumText)
            else content.likely_quantity,
            content.name,
        )
        for content in contents
    )
    warn_if(
        quantity is None and texts,
        f"text exports do not state their quantity; {target_quantity} is a guess from the range of the "
        f"plot. Pass quantity={target_quantity!r} if it is right. Files: {', '.join(texts)}",
        "quantity-assumed",
    )
    names_by_conflict = grouped(
        (conflict, content.name)
        for content in contents
        if (conflict := _receptor_conflict(content, target_quantity))
    )
    # pass by the user's word, and are listed by `check`
    for conflict, names in names_by_conflict.items():
        FormatError.raise_if(
            quantity is None or not is_declared,
            f"{listed(names)}: {conflict}",
            expected="a cosine receptor" if target_quantity == "irradiance" else "a fore optic",
            mend=f"pass quantity={target_quantity!r} if the files are wrong",
            code="fore-optic-wrong",
        )
        warn_of(f"{target_quantity} of spectra whose files have: {conflict}", names, "fore-optic-wrong")
    SchemaError.raise_if(
        absolute and target_quantity != "reflectance",
        f"absolute=True with quantity {target_quantity!r}",
        expected="reflectance",
        mend="omit absolute=, or pass quantity='reflectance'",
        code="option-conflict",
    )

    def spectra_of(content: AsdFile | AsdText | SpectrumText) -> list[Spectrum]:
        if isinstance(content, AsdFile):
            return [_spectrum_of(content, target_quantity, external_files, absolute=absolute)]
        if isinstance(content, SpectrumText):
            column = content.column(target_quantity, units)
            return [
                Spectrum(
                    content.name,
                    content.wavelength,
                    column.values / (100.0 if column.units == "%" else 1.0),
                    content.local_time,
                    content.utc_offset_h,
                    averaging_s=content.averaging_s,
                    gps=None if content.gps is None else AsdGps(*content.gps),
                    instrument=content.instrument,
                )
            ]
        refuse(
            content.name,
            (
                absolute,
                Problem(
                    "a text export does not contain the panel's reflectance, which absolute= needs",
                    mend="open the binary file",
                    code="option-conflict",
                ),
            ),
        )
        values = content.values
        if target_quantity == "reflectance" and content.is_plain:
            values = _checked_reflectance(content)
        integration_ms, averages = (
            content.preamble.get(key) for key in ("integration_ms", "sample_averages")
        )
        return [
            Spectrum(
                f"{content.name}:{column}" if len(content.spectra) > 1 else content.name,
                content.wavelength,
                spectrum,
                content.preamble.get("local_time"),
                averaging_s=None if integration_ms is None else integration_ms * 1e-3 * max(averages or 1, 1),
                instrument=content.instrument,
            )
            for column, spectrum in zip(content.spectra, values, strict=True)
        ]

    spectra = [
        replace(spectrum, path=path, conflict=_receptor_conflict(content, target_quantity))
        for path, content, file_spectra in zip(files, contents, for_all(contents, spectra_of), strict=True)
        for spectrum in file_spectra
    ]
    require_one_grid((spectrum.source, spectrum.wavelength) for spectrum in spectra)
    names_with_dark = [
        content.name for content in contents if isinstance(content, AsdFile) and not content.dark_subtracted
    ]
    warn_if(
        names_with_dark and target_quantity != "counts",
        f"{target_quantity} is biased: dark current not subtracted in {listed(names_with_dark)}",
        "dark-not-subtracted",
    )
    return mask_undefined(spectra, target_quantity), target_quantity


def _checked_reflectance(content: AsdText) -> Floats:
    # Return the values of a table of any program as fractions, by its headings and with the checks of
    # `hyperpaint.open_library`; NaN for fill values.
    named = [name for name in content.spectra if foreign_quantity(name)]
    refuse(
        content.name,
        (
            named,
            Problem(
                f"column headings name {', '.join(map(repr, named[:5]))}",
                expected="reflectance",
                mend="remove these columns, or pass their quantity=",
                code="quantity-wrong",
            ),
        ),
    )
    is_percent = np.array([PERCENT.search(name) is not None for name in content.spectra])
    is_percent |= content.is_percent
    values = content.values / np.where(is_percent, 100.0, 1.0)[:, None]
    finite = np.where(np.isfinite(content.values), content.values, np.nan)
    for percent in {*is_percent.tolist()}:
        rows = is_percent == percent
        checked = reflectances(finite[rows], content.name, file_scale=100.0 if percent else None, scale=None)
        values[rows] = np.where(np.isnan(checked), np.nan, values[rows])
    return values


def _spectrum_of(
    file: AsdFile, quantity: str, external_files: Mapping[str, AsdFile], *, absolute: bool
) -> Spectrum:
    # Return the spectrum of a binary file; see the notes of `open_asd` for the formulas. ``external_files``
    # are calibration files by kind, used instead of the blocks in the file.
    wavelength, name, reference = file.wavelength, file.name, file.reference
    purpose = f"absolute {quantity}" if absolute else quantity
    kinds = _BLOCKS_BY_QUANTITY.get(purpose, ())
    refuse(
        name,
        (
            quantity == "reflectance" and reference is None,
            Problem(
                "no white reference in the file, so no reflectance",
                mend="pass quantity='counts', or give files saved after the white reference was taken",
                code="reference-missing",
            ),
        ),
    )
    blocks = dict(file.calibrations)
    for kind, other in external_files.items():
        refuse(
            name,
            (
                kind in kinds and not np.array_equal(other.wavelength, wavelength),
                Problem(f"wavelengths differ from calibration file {other.name}", code="grid-mismatch"),
            ),
        )
        blocks[kind] = AsdCalibration(other.name, other.integration_ms, other.spectrum)
    missing = [kind for kind in kinds if kind not in blocks]
    keys = (f"{key!r}: path" for key, kind in _CALIBRATION_KEYS.items() if kind in missing)
    refuse(
        name,
        (
            missing,
            Problem(
                f"no calibration block {' and '.join(missing)} in the file, so no {purpose}",
                mend=(
                    f"pass calibration={{{', '.join(keys)}}} with the files of the instrument (.ill, .raw, "
                    ".ref), or export the spectra as text with the vendor's software"
                ),
                code="calibration-missing",
            ),
        ),
    )
    # saturation flags of the detectors VNIR, SWIR 1 and SWIR 2, whose ends are infinite if they are the last
    ends = [splice if splice > 0 else np.inf for splice in file.splices]
    detector = np.searchsorted([ends[0], max(ends)], wavelength)
    is_saturated = np.array([flag in file.saturated for flag in _DETECTORS.values()])[detector]
    values, is_used = file.spectrum, np.ones(wavelength.shape, bool)
    with np.errstate(all="ignore"):  # damaged values; those not finite are reported later
        if quantity == "reflectance" and reference is not None:
            values = ratio(file.spectrum, reference)
            if absolute:
                values = values * blocks["ABS"].values
        elif kinds:
            _, lamp_ms, lamp_counts = blocks["FO"]
            is_used = wavelength <= ends[0]  # the formula is proven for the first detector alone
            refuse(
                name,
                (
                    file.integration_ms <= 0 or lamp_ms <= 0,
                    Problem(
                        f"integration times {file.integration_ms:g} ms, calibration {lamp_ms:g} ms",
                        expected="positive numbers",
                        code="value-out-of-range",
                    ),
                ),
                (
                    not is_used.any(),
                    Problem(
                        "all wavelengths lie beyond the first splice",
                        mend="copy the file again",
                        code="wavelength-range",
                    ),
                ),
            )
            per_count = ratio(blocks["LMP"].values, lamp_counts) * (lamp_ms / file.integration_ms)
            if quantity == "radiance":
                per_count = per_count * blocks["BSE"].values / np.pi
            values = file.spectrum * per_count
    return Spectrum(
        name,
        wavelength[is_used],
        values[is_used],
        file.local_time,
        file.utc_offset_h,
        averaging_s=file.integration_ms * 1e-3 * max(file.sample_averages, 1),
        dark_utc=file.dark_utc,
        gps=file.gps,
        saturated=is_saturated[is_used],
        clipped=clipped_top(file.spectrum[None, is_used])[0],
        panel=blocks["ABS"].name if absolute else "",
    )


def mask_undefined(spectra: Sequence[Spectrum], quantity: str) -> list[Spectrum]:
    # Replace saturated and undefined samples, and spectra of only zeros, by NaN, with a warning.
    found: list[tuple[str, str]] = []  # reason and source
    masked = []
    for spectrum in spectra:
        values, is_counts = spectrum.values, quantity == "counts"
        is_undefined, nowhere = ~np.isfinite(values), np.zeros(values.shape, bool)
        # saturated counts are kept: users examine them for saturation
        faults = {
            "undefined (not finite)": is_undefined,
            "zero throughout": nowhere if is_counts or values.any() else ~nowhere,
            "saturated": nowhere if is_counts or spectrum.saturated is None else spectrum.saturated,
        }
        found += [(reason, spectrum.source) for reason, is_faulty in faults.items() if is_faulty.any()]
        is_masked = np.logical_or.reduce(list(faults.values()))
        masked.append(replace(spectrum, values=np.where(is_masked, np.nan, values)))
    for reason, names in grouped(found).items():
        warn_user(
            f"samples that are {reason} become NaN in {len(names)} of {len(spectra)} spectra: "
            f"{listed(names)}",
            "samples-undefined",
        )
    return masked


def utc_offsets(
    spectra: Sequence[Spectrum], utc_offset_h: float | None, *, one_clock: bool = False
) -> list[float]:
    # Return local time minus UTC [h] of each spectrum.
    # spectra: With the zone of the logging PC, where the file holds it.
    # utc_offset_h: Given by the user. It takes precedence over the files' offsets; a difference is warned of.
    # one_clock: Whether one PC stamped all spectra. Files without an offset then get that of the other files,
    #     which must agree.
    # Raises TimeError: An offset is unknown or impossible, or the offsets of one PC differ.
    sources_by_offset = grouped(
        (spectrum.utc_offset_h, spectrum.source) for spectrum in spectra if spectrum.utc_offset_h is not None
    )
    offsets_text = "; ".join(
        f"{hours:+g} h in {listed(names, 3)}" for hours, names in sources_by_offset.items()
    )
    if utc_offset_h is not None:
        check_utc_offset(utc_offset_h)
        warn_if(
            set(sources_by_offset) - {utc_offset_h},
            f"utc_offset_h={utc_offset_h:+g} is used, although the files have {offsets_text}",
            "utc-offset-conflict",
        )
        return [utc_offset_h] * len(spectra)
    TimeError.raise_if(
        one_clock and len(sources_by_offset) > 1,
        f"UTC offsets differ within one series: {offsets_text}",
        mend="pass utc_offset_h=",
        code="utc-offset-conflict",
    )
    if one_clock and sources_by_offset:
        return [next(iter(sources_by_offset))] * len(spectra)
    without_zone = [spectrum for spectrum in spectra if spectrum.utc_offset_h is None]
    TimeError.raise_if(
        without_zone,
        f"the time stamps are local, and {_missing_zone_text(without_zone)}",
        code="zone-missing",
    )
    return [spectrum.utc_offset_h for spectrum in spectra if spectrum.utc_offset_h is not None]


def _missing_zone_text(without_zone: Sequence[Spectrum]) -> str:
    # The message names a hint at the UTC offset from the GPS time, or from the UTC stamp of the dark current.
    hint = ""
    for spectrum in without_zone:
        local, gps, hour = spectrum.local_time, spectrum.gps, dt.timedelta(hours=1)
        if local is None or hint:
            continue
        if gps is not None:
            hours = round((local - dt.datetime.combine(local.date(), gps.utc)) / hour)
            hint = f", perhaps {(hours + 11) % 24 - 11:+d} by the GPS"
        elif spectrum.dark_utc is not None:
            hours = (local - spectrum.dark_utc) // hour
            hint = f", perhaps {hours:+d} by the stamp of the dark current" if -12 <= hours <= 14 else ""
    files = listed([spectrum.source for spectrum in without_zone])
    return (
        "the files contain no UTC offset; pass utc_offset_h= (local time minus UTC in hours)"
        f"{hint}. Files: {files}"
    )


# --- labelled spectra --------------------------------------------------------------------------------------


def open_asd(
    paths: Paths,
    quantity: str | None = None,
    *,
    absolute: bool = False,
    utc_offset_h: float | None = None,
    calibration: Mapping[str, str | os.PathLike[str]] | None = None,
) -> xr.Dataset:
    r"""Open spectra of an ASD field spectrometer.

    Parameters
    ----------
    paths
        A file, a glob, a folder, or a list of files: binary ``.asd`` files of any version, text exports, or
        texts of other field spectrometers (Spectral Evolution, Ocean Optics, Avantes).
    quantity
        ``counts``, ``reflectance`` (spectrum / white reference), ``radiance`` or ``irradiance``. By default
        the quantity displayed to the operator, which binary files hold; for a text export it is guessed
        from the range of the operator's plot, with a warning. ``reflectance`` of a table without a sentence
        or an ``.asd`` name of the vendor's software is checked as by `hyperpaint.open_library`: its headings
        may state percent and no other quantity.
    absolute
        Multiply reflectance, which is relative to the white panel, by the panel's own (the block ABS).
    utc_offset_h
        Local time of the logging PC minus UTC [h]. By default each file's own, which files with a white
        reference hold.
    calibration
        Files of the instrument's calibration, for files without calibration blocks: by ``lamp`` (``.ill``),
        ``fore_optic`` (``.raw``) and ``panel`` (``.ref``) for radiance and irradiance, by ``absolute``
        (``.ref``) for absolute reflectance.

    Returns
    -------
    xarray.Dataset
        One variable, named by its quantity, on (spectrum, wavelength), float64, ordered by time; coordinates
        ``spectrum`` (names of the files without ``.asd``, or of the columns of an export), ``wavelength``
        [nm], ``time`` (UTC, NaT without a stamp or its zone), ``source``, ``latitude``, ``longitude`` and
        ``altitude`` (NaN without a GPS fix). Stamps are whole seconds, as in the files. Attributes of
        reflectance: ``reflectance_scale``, relative (to the white panel) or absolute, and the ``panel``.

    Raises
    ------
    FormatError
        Files are missing or damaged, lack the reference or the calibration blocks the quantity needs, have a
        fore optic that contradicts it, or differ in wavelengths; all are named.
    TimeError
        ``utc_offset_h`` is the offset of no zone.
    SchemaError
        ``quantity`` or ``calibration`` is not one of those above, or ``absolute`` is set for another
        quantity than reflectance.

    Warns
    -----
    PaintWarning
        Saturated or undefined samples, which become NaN; a guessed quantity; spectra whose dark current was
        not subtracted; a UTC offset that contradicts the files; local times whose zone is unknown, which are
        NaT.

    Notes
    -----
    A file always holds raw counts, from which, after the vendor's software,

        E = LMP * (DN / FO) * (t_cal / t),  L = E * BSE / pi

    with the lamp's irradiance LMP, the counts FO that it gave in t_cal, and the panel's reflectance BSE. The
    formula is proven for the VNIR detector alone, so that radiance and irradiance end at the first splice
    (1000 nm). Text exports come as the vendor's software computed them, to their last wavelength.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp(), "paint.asd.txt")
    >>> _ = path.write_text("Wavelength;paint.asd\n550; 0.0669 \n551; 0.0671 \n")
    >>> open_asd(path, "reflectance")["reflectance"].values
    array([[0.0669, 0.0671]])
    """
    spectra, quantity = read_spectra(find_files(paths), quantity, absolute=absolute, calibration=calibration)
    # UTC of the spectra whose zone is known
    has_stamp = np.array([s.local_time is not None for s in spectra])
    has_zone = np.array([utc_offset_h is not None or s.utc_offset_h is not None for s in spectra])
    warn_if(
        unknown := [spectra[i] for i in np.flatnonzero(has_stamp & ~has_zone)],
        f"local times are NaT, since {_missing_zone_text(unknown)}",
        "zone-missing",
    )
    dated = [spectra[i] for i in np.flatnonzero(has_stamp & has_zone)]
    offsets = np.rint(np.array(utc_offsets(dated, utc_offset_h)) * 3600e9).astype("timedelta64[ns]")
    times = np.full(len(spectra), np.datetime64("NaT", "ns"))
    times[has_stamp & has_zone] = np.array([s.local_time for s in dated], "datetime64[ns]") - offsets
    order = np.argsort(times, kind="stable")  # NaT last
    spectra = [spectra[i] for i in order]
    # names: columns of a text export, or else file names; ViewSpec adds endings: paint.asd.txt
    names = [
        (spectrum.path or Path(spectrum.source), _ENDINGS.sub("", spectrum.source.rpartition(":")[2]))
        for spectrum in spectra
    ]
    coords: dict[str, Any] = {
        "spectrum": (
            "spectrum",
            np.array(name_spectra(names), object),
            {"long_name": "Name of the spectrum"},
        ),
        "wavelength": (
            "wavelength",
            spectra[0].wavelength,
            {**VARIABLES["wavelength"].attrs, "long_name": "Wavelength of the spectrometer"},
        ),
        "time": ("spectrum", times[order], {"long_name": "UTC at which the spectrum was saved"}),
        "source": ("spectrum", np.array([s.source for s in spectra], object), {"long_name": "File"}),
    } | {
        name: (
            "spectrum",
            np.array([np.nan if s.gps is None else getattr(s.gps, name) for s in spectra], np.float64),
            {**VARIABLES[name].attrs, "long_name": f"{name.capitalize()} of the spectrometer"},
        )
        for name in ("latitude", "longitude", "altitude")
    }
    extra = {}
    if quantity == "reflectance":
        panels = sorted({spectrum.panel for spectrum in spectra} - {""})
        extra = {"reflectance_scale": "absolute" if panels else "relative"}
        extra |= {"panel": listed(panels)} if panels else {}
    values = xr.DataArray(np.stack([s.values for s in spectra]), dims=("spectrum", "wavelength"))
    return xr.Dataset(
        {quantity: label(values, quantity, **extra)},
        coords=coords,
        attrs={"instrument": listed(sorted({spectrum.instrument for spectrum in spectra}))},
    )
