"""Spectra of SVC field spectrometers as labelled arrays, and the layout of their text files (``.sig``).

The first line contains the maker's name. Lines ``key= value`` follow up to ``data=``, then one row for each
channel: wavelength [nm], the scan of the white reference, the scan of the target, and their ratio in per
cent, rounded. Numbers follow the locale of the PC that saved the file, in rows and header: a comma may be a
decimal comma, and only a comma *and a blank* separate the items of a list. `DIALECTS` has one row for each
way to write such a file.
"""

import datetime as dt
import json
import math
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import xarray as xr

from hyperpaint.base import (
    VARIABLES,
    Bools,
    Floats,
    FormatError,
    Ints,
    Problem,
    Problems,
    SchemaError,
    label,
    one_of,
)
from hyperpaint.io.files.reading import read_limited_text, refuse

from .spectrum_files import (
    QUANTITIES,
    Paths,
    cell_number,
    check_utc_offset,
    common_quantity,
    find_paths,
    for_all,
    listed,
    name_spectra,
    ratio,
    require_one_grid,
    same_grids,
    text_lines,
    warn_of,
)

Scan = Literal["reference", "target"]
Overlap = Literal["keep", "trim"]

#: The two scans of a file, in the order of its columns.
SCANS = ("reference", "target")
DETECTORS = ("VNIR", "SWIR1", "SWIR2")
#: Wavelengths [nm] at which the vendor's software changes detectors by default.
SVC_JOINS = (990.0, 1900.0)

_HALF_DIGIT = 0.005  # rounding error of numbers with two decimals
_NAT = np.datetime64("NaT", "ns")
_NO_POSITION = (math.nan, math.nan)


# --- layout of files ---------------------------------------------------------------------------------------


class Dialect(NamedTuple):
    # Form of a text of two scans, which differs between makers and programs.

    instrument: str
    magic: re.Pattern[bytes]  # first bytes of a file
    begins: str  # the same in words, for messages
    suffix: str = ".sig"
    assigns: str = "="  # between key and value of a line of the header
    data: str = "data"  # key of the line before the rows
    headings: int = 0  # lines of headings between that line and the rows
    # Keys of the header in lower case that have another name here, such as ``instrument``
    keys: Mapping[str, str] = {}
    units: Mapping[str, str] = {}  # quantities by the words of the file that differ from ours
    # Columns of wavelength [nm], reference, target, and their ratio in per cent
    columns: tuple[int, int, int, int] = (0, 1, 2, 3)
    # Factors of values to SI by quantity; the vendor's unit is 1e-10 W cm-2 [sr-1] nm-1
    scale: Mapping[str, float] = {"radiance": 1e-6, "irradiance": 1e-6, "counts": 1.0}


DIALECTS = (
    # HR-512i to HR-1024i
    Dialect(
        "SVC",
        re.compile(rb"(?:\xef\xbb\xbf)?\s*/\*+[^\r\n]{0,80}Spectra Vista", re.IGNORECASE),
        "'/*** Spectra Vista SIG Data ***/' of an SVC .sig file",
    ),
)

_MAX_BYTES = 4 * 2**20  # a hundred times the size of usual files
_MAX_ROWS = 32_768
_MAX_HEADER_LINES = 1000
_MAX_DETECTORS = 3
_CHANNELS = re.compile(r"HR-(\d{3,4})(?!\d)")


@dataclass(frozen=True, eq=False)
class SvcFile:
    # Content of one ``.sig`` file; arrays are (wavelength), float64, read-only, in file order.

    name: str  # file name without its folder
    header: Mapping[str, str]  # values by key (lower case), as text
    # Quantities of reference and target: ``radiance``, ``counts`` or ``irradiance``
    units: tuple[str, ...]
    # Nanometres; they step back where the next detector begins, because detectors overlap
    wavelength: Floats
    reference: Floats  # scan of the white reference, in the file's units
    target: Floats  # scan of the target, in the file's units
    percent: Floats  # ratio of target and reference in the file, rounded
    # First row of each detector, found by the steps back in wavelength; the first is 0
    starts: tuple[int, ...]
    dialect: Dialect

    @property
    def has_reference(self) -> bool:
        # Whether a white reference was measured; without one, its column contains only 1, or only 0.
        return not (np.all(self.reference == 1.0) or np.all(self.reference == 0.0))


def dialect_of(head: bytes) -> Dialect | None:
    # Return the dialect of a file by its first bytes; None for files of another kind.
    return next((dialect for dialect in DIALECTS if dialect.magic.match(head)), None)


def is_named_as_scans(path: Path) -> bool:
    # Return whether the suffix of a file is that of a dialect.
    return path.suffix.lower() in [dialect.suffix for dialect in DIALECTS]


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
    if (dialect := dialect_of(data[:200])) is None:
        ger_hint = " (a GER file; SVC's software converts it)" if data[:6] == b"///GER" else ""
        raise FormatError(
            f"{path.name}: begins with {data[:24]!r}{ger_hint}",
            expected=" or ".join(dialect.begins for dialect in DIALECTS),
            code="format-unknown",
        )
    lines = text_lines(data)
    # the header: values by key, up to the line before the rows
    header: dict[str, str] = {}
    last_key, first_row = "", 0
    for line_number, line in enumerate(lines[1 : _MAX_HEADER_LINES + 1], start=2):
        key, assigns, value = line.partition(dialect.assigns)
        key, value = " ".join(key.lower().split()), value.strip()
        if key == dialect.data and assigns and not value:
            first_row = line_number + dialect.headings
            break
        if not assigns:  # a comment may have several lines
            if last_key and line.strip():
                header[last_key] += f"\n{line.strip()}"
            continue
        last_key = dialect.keys.get(key, key)
        FormatError.raise_if(
            header.setdefault(last_key, value) != value,
            f"{path.name}: the header has {key!r} twice with different values",
            mend="copy the file again",
            code="key-duplicate",
        )
    else:
        raise FormatError(
            f"{path.name}: no line '{dialect.data}{dialect.assigns}' among the first {_MAX_HEADER_LINES}",
            mend="copy the file again from the instrument",
            code="file-truncated",
        )
    # the table: numbers in the columns of the dialect
    size = len(lines) - first_row
    refuse(
        path.name,
        (size > _MAX_ROWS, Problem(f"{size} rows", expected=f"at most {_MAX_ROWS}", code="file-too-large")),
    )
    count = max(dialect.columns) + 1
    rows = [
        (
            number,
            line,
            [cell_number(cell) for cell in line.replace("n. def.", "n.def.").split(None, count + 1)],
        )
        for number, line in enumerate(lines[first_row:], start=first_row + 1)
        if line.strip()
    ]
    for number, line, cells in rows:
        FormatError.raise_if(
            len(cells) != count or None in cells,
            f"{path.name}: line {number} holds {line.strip()[:60]!r}",
            expected="four numbers (wavelength, reference, target, percent)",
            mend="copy the file again",
            code="row-unreadable",
        )
    table = np.array([cells for *_, cells in rows], np.float64).reshape(-1, count).T
    columns = np.ascontiguousarray(table[list(dialect.columns)])
    columns.flags.writeable = False
    wavelength, reference, target, percent = columns
    # a file with preserved overlap has one row for each channel of its instrument
    model = _CHANNELS.search(header.get("instrument", ""))
    is_overlap_preserved = "overlap: preserve" in header.get("factors", "").partition("]")[0].lower()
    channels = int(model[1]) if model and is_overlap_preserved else 0
    unit_words = [word.strip().lower() for word in header.get("units", "").split(",")]
    units = tuple(dialect.units.get(word, word) for word in (unit_words * 2)[: max(len(unit_words), 2)])
    units_text = repr(header["units"][:60]) if "units" in header else "no line 'units='"
    # wavelengths step back where the next detector begins
    starts = (0, *(int(step) + 1 for step in np.flatnonzero(wavelength[1:] <= wavelength[:-1])))
    again = "copy the file again"
    refuse(
        path.name,
        (
            len(rows) < 2,
            Problem(f"{len(rows)} rows", expected="a spectrum", mend=again, code="table-missing"),
        ),
        (
            len(wavelength) < channels,
            Problem(
                f"{len(wavelength)} rows",
                expected=f"the {channels} channels of an HR-{channels} whose overlap is preserved",
                mend="copy the file again from the instrument",
                code="file-truncated",
            ),
        ),
        (
            len(units) != 2 or not set(units) <= set(dialect.scale),
            Problem(
                units_text,
                expected="units= Radiance, Radiance (or Counts, Irradiance)",
                code="units-unknown",
            ),
        ),
        (
            not np.all((wavelength > 0.0) & (wavelength < 1e5)),
            Problem(
                "wavelengths are not all positive numbers of nanometres",
                mend=again,
                code="wavelength-range",
            ),
        ),
        (
            len(starts) > _MAX_DETECTORS,
            Problem(
                f"the wavelengths step back {len(starts) - 1} times",
                expected=f"at most {_MAX_DETECTORS - 1} times, where detectors overlap",
                mend=again,
                code="wavelength-unordered",
            ),
        ),
    )
    return SvcFile(
        path.name,
        MappingProxyType(header),
        units,
        wavelength,
        reference,
        target,
        percent,
        starts,
        dialect,
    )


# --- meaning of the header ---------------------------------------------------------------------------------


_ITEM = re.compile(r",(?=\s|$)")
_RECORD = re.compile(r"([^\[\]]*)\[([^\[\]]*)\]?")
_REMOVED = re.compile(r"remove\s*@\s*(\d{3,4})(?:[.,]0)?\s*,\s*(\d{3,4})(?![\d])", re.IGNORECASE)
_MATCHING = re.compile(r"matching type:\s*([^\]]*)", re.IGNORECASE)
_ANGLE = re.compile(r"(\d{3,5})[.,](\d{1,8})\s*,?\s*([NSEW])", re.ASCII | re.IGNORECASE)
_MAX_FACTORS_CHARS = 2000  # leading characters that are parsed
_BITS = re.compile(r"[0-9]{1,9}")


class SvcOverlap(NamedTuple):
    # Treatment of overlapping detectors, from the header's ``factors``.

    text: str  # short description: preserved, removed (and where), or unknown
    # Wavelengths [nm] at which the next detector begins, if channels were removed
    joins: tuple[float, float] | None
    # How detectors were matched (``Radiance @ 976 - 1010 / NIR-SWIR On``); ``None`` if they were not, empty
    # if unknown. Matching multiplies the first detector by a ramp, and fades it into the second up to the end
    # of this range
    matching: str
    # Ratio of VNIR to SWIR1 in the overlap, for reference and target; NaN if unknown
    factors: tuple[float, float]


def items(value: str) -> list[str]:
    """Return the items of a list in the header; a comma without a blank after it is a decimal comma.

    Examples
    --------
    >>> items("1000,0, 40,0, 10,0"), items("                ,                 ")
    (['1000,0', '40,0', '10,0'], ['', ''])
    """
    return [item.strip() for item in _ITEM.split(value)]


def pair(header: Mapping[str, str], key: str) -> tuple[str, str]:
    # Return the texts for reference and target, empty where missing.
    entries = items(header.get(key, ""))
    return (entries[0], entries[1]) if len(entries) == 2 else ("", entries[0] if len(entries) == 1 else "")


def overlap_of(header: Mapping[str, str]) -> SvcOverlap:
    """Return the content of the header's ``factors``.

    Each processing of a file adds a record; the latest comes first.

    Examples
    --------
    >>> line = "0.795, 0.848, 1.000 [Overlap: Remove @ 970,1901, Matching Type: None]"
    >>> overlap_of({"factors": line}).text
    'removed @ 970, 1901 nm'
    """
    factors_text = header.get("factors", "")[:_MAX_FACTORS_CHARS]
    records = _RECORD.findall(factors_text)
    numbers, latest = records[0] if records else (factors_text, "")
    values = [cell_number(item) for item in items(numbers)]
    first, second = (math.nan if value is None else value for value in (*values, None, None)[:2])
    removal = _REMOVED.search(latest)
    joins = (float(removal[1]), float(removal[2])) if removal else None
    words = {"preserve": "preserved", "remove": "removed", "": "unknown"}
    text = next(text for word, text in words.items() if word in latest.lower())
    matchings = [match[1].strip() for _, record in records if (match := _MATCHING.search(record))]
    applied = [matching for matching in matchings if matching.lower() != "none"]
    return SvcOverlap(
        text=text if joins is None else f"removed @ {joins[0]:g}, {joins[1]:g} nm",
        joins=joins,
        matching=[*applied, *matchings, ""][0],
        factors=(first, second),
    )


def error_bits(header: Mapping[str, str]) -> tuple[int, int]:
    # Return the instrument's error bits of reference and target, -1 where missing.
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
    angles = []
    for key, letters, limit in (("latitude", "NS", 90.0), ("longitude", "EW", 180.0)):
        entries = items(header.get(key, ""))
        # old firmware puts a comma before the letter: 11121.2335,W, 11121.2324,W
        text = entries[scan] if len(entries) == 2 else ""
        if not text.strip(", "):
            angles.append(math.nan)
            continue
        match = _ANGLE.fullmatch(text)
        if match is None or match[3].upper() not in letters:
            return None
        degrees, minutes = int(match[1]) // 100, int(match[1]) % 100 + float(f"0.{match[2]}")
        if minutes >= 60.0 or degrees + minutes / 60.0 > limit:
            return None
        angles.append((degrees + minutes / 60.0) * (-1.0 if match[3].upper() == letters[1] else 1.0))
    latitude, longitude = angles
    has_no_fix = not math.isfinite(latitude + longitude) or latitude == longitude == 0.0
    return _NO_POSITION if has_no_fix else (latitude, longitude)


# --- spectra -----------------------------------------------------------------------------------------------


def open_svc(
    paths: Paths,
    quantity: str | None = None,
    *,
    scan: Scan = "target",
    overlap: Overlap = "keep",
    joins: tuple[float, float] | None = None,
    dayfirst: bool | None = None,
    utc_offset_h: float | None = None,
) -> xr.Dataset:
    r"""Open spectra of an SVC (Spectra Vista) field spectrometer, as ``.sig`` files hold them.

    Parameters
    ----------
    paths
        A file, a glob, a folder, or a list of these.
    quantity
        ``reflectance`` (target / white reference), ``radiance``, ``counts`` or ``irradiance``. By default
        reflectance from two scans in radiance, else the quantity of the scan.
    scan
        Scan to return as radiance, counts or irradiance: of the ``target`` or of the white ``reference``.
    overlap
        ``keep`` returns all channels in the file's order: where detectors overlap, wavelengths step
        back, and a range of them occurs twice. ``trim`` keeps one detector's channels, so that they increase.
    joins
        Wavelengths [nm] at which ``trim`` changes from VNIR to SWIR 1 and from SWIR 1 to SWIR 2: a channel at
        the join is the lower detector's, the next one the higher's. By default 990 and 1900, as in the
        vendor's software, or the nearest end of the overlap. No value changes; the attribute
        ``overlap_trimmed_at_nm`` contains the wavelengths.
    dayfirst
        Whether dates with slashes that are valid in both orders begin with the day. By default as in files of
        the same instrument whose order is unambiguous; else their time is NaT, with a warning.
    utc_offset_h
        Local time minus UTC [h], for files without GPS time; with GPS time it is not needed.

    Returns
    -------
    xarray.Dataset
        One variable, named by its quantity, on (spectrum, wavelength), float64, in the order of the files,
        and ``spectrum``, the names of the files without ``.sig``. Coordinates of each spectrum: ``time``
        and, for reflectance, ``reference_time`` (UTC, NaT where it cannot be known); ``latitude`` and
        ``longitude`` (NaN without a fix); ``overlap_matched``, whether the software changed values to make
        detectors meet, and ``overlap``, the treatment of the channels there; the file's ``factors`` as text
        and as ``factor_reference`` and ``factor_target``; ``error_reference`` and ``error_target``, the bits
        that the instrument set; ``column_difference``, how far the file's own rounded reflectance is from
        the one returned; ``instrument``, ``source``, and ``header``, all of the file's header as JSON.
        Coordinate of each channel, where the files tell: ``detector``.

    Raises
    ------
    FormatError
        Files are missing or damaged, lack what the quantity needs, or differ in wavelengths; all are named.
    SchemaError
        An argument is not one of those above.
    TimeError
        ``utc_offset_h`` is the offset of no zone.

    Warns
    -----
    PaintWarning
        Undefined samples, which become NaN; a rounded reflectance in the file that contradicts its scans;
        times or positions that cannot be known or read; a ``utc_offset_h`` that contradicts the GPS.

    Notes
    -----
    Reflectance is the ratio of the two scans, which has more digits than the file's fourth column, and is
    relative to the white panel. Radiance is scaled by 1e-6 W m-2 sr-1 nm-1 (the vendor's 1e-10 W cm-2 sr-1
    nm-1), which the files do not say. The ``factors`` are VNIR over SWIR 1 in their overlap, of the reference
    and of the target; they are applied only where ``overlap_matched``: the first detector is then divided by
    a ramp from 1 in the blue to them, and faded into the second over the range that ``factors`` name.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp(), "red.sig")
    >>> times = "time= 27.05.2025 09:39:32, 27.05.2025 09:42:59\n"
    >>> text = f"/*** Spectra Vista SIG Data ***/\nunits= Radiance, Radiance\n{times}data= \n"
    >>> _ = path.write_text(text + "550,1  8000,00  401,00  5,01\n551,5  8000,00  800,00  10,00\n")
    >>> opened = open_svc(path, utc_offset_h=2)
    >>> opened["reflectance"].values
    array([[0.050125, 0.1     ]])
    >>> opened["spectrum"].values.tolist(), opened["time"].values
    (['red'], array(['2025-05-27T07:42:59.000000000'], dtype='datetime64[ns]'))
    """
    problems = Problems("SVC files cannot be opened with these arguments", SchemaError)
    if quantity is not None:
        one_of(quantity, QUANTITIES, "quantity", problems=problems)
    one_of(scan, SCANS, "scan", problems=problems)
    problems.add_if(
        scan == "reference" and quantity == "reflectance",
        "scan='reference' with quantity='reflectance', which is a ratio of both scans",
        mend="omit scan, or pass quantity='radiance'",
        code="option-conflict",
    )
    one_of(overlap, get_args(Overlap), "overlap", problems=problems)
    problems.raise_if_any(
        (
            joins is not None and not (np.size(joins) == 2 and 0.0 < joins[0] < joins[1] < math.inf),
            Problem(
                f"joins={joins!r}", expected="two increasing wavelengths in nm", code="value-out-of-range"
            ),
        ),
    )
    if utc_offset_h is not None:
        check_utc_offset(utc_offset_h)
    files = find_paths(
        paths,
        lambda folder_files: list(filter(is_named_as_scans, folder_files)),
        f"{' or '.join(dict.fromkeys(dialect.suffix for dialect in DIALECTS))} files",
    )
    contents = for_all(files, read_svc)
    scan_number = SCANS.index(scan)
    # by default, reflectance of targets whose two scans are in radiance
    target_quantity = quantity or common_quantity(
        (
            "reflectance"
            if scan_number == 1 and file.units == ("radiance", "radiance") and file.has_reference
            else file.units[scan_number],
            file.name,
        )
        for file in contents
    )
    is_trimmed = overlap == "trim"
    measurements = for_all(
        contents, lambda file: _measure(file, target_quantity, scan_number, joins, trim=is_trimmed)
    )
    require_one_grid(
        ((measurement.file.name, measurement.wavelength) for measurement in measurements),
        lambda: _joins_advice(measurements),
    )
    values = np.stack([measurement.values for measurement in measurements])
    values[~np.isfinite(values)] = np.nan
    warn_of(
        "samples that are undefined (not finite) become NaN",
        [file.name for file, row in zip(contents, values, strict=True) if np.isnan(row).any()],
        "samples-undefined",
    )
    is_ratio = target_quantity == "reflectance"
    # the wavelengths, and the detectors if these are the same in all files
    wavelength_attrs = {**VARIABLES["wavelength"].attrs, "long_name": "Wavelength of the spectrometer"}
    coords: dict[str, Any] = {"wavelength": ("wavelength", measurements[0].wavelength, wavelength_attrs)}
    detector = measurements[0].detector
    if detector is not None and all(
        measurement.detector is not None and np.array_equal(measurement.detector, detector)
        for measurement in measurements
    ):
        names = np.array(DETECTORS, object)[detector]
        coords["detector"] = ("wavelength", names, {"long_name": "Detector of the channel"})
    coords |= _coords_of_scans(contents, (1, 0) if is_ratio else (scan_number,), dayfirst, utc_offset_h)
    coords |= _coords_of_files(files, measurements, is_ratio=is_ratio)
    instruments = listed(sorted({file.dialect.instrument for file in contents}))
    attrs: dict[str, Any] = {"instrument": instruments} | ({} if is_ratio else {"scan": scan})
    trimmed_at = [measurement.trimmed_at for measurement in measurements if measurement.trimmed_at]
    if trimmed_at:
        attrs["overlap_trimmed_at_nm"] = list(trimmed_at[0])
    data = xr.DataArray(values, dims=("spectrum", "wavelength"))
    extra = {"reflectance_scale": "relative"} if is_ratio else {}
    return xr.Dataset({target_quantity: label(data, target_quantity, **extra)}, coords=coords, attrs=attrs)


class _Measurement(NamedTuple):
    # One file in one quantity, on the channels that remain.
    file: SvcFile
    overlap: SvcOverlap
    wavelength: Floats
    values: Floats
    detector: Ints | None
    trimmed_at: tuple[float, ...]


def _measure(
    file: SvcFile, quantity: str, scan_number: int, joins: tuple[float, float] | None, *, trim: bool
) -> _Measurement:
    overlap, is_ratio, units = overlap_of(file.header), quantity == "reflectance", file.units[scan_number]
    # the scans of a ratio must have the same units and, in counts, the same integration times
    times = items(file.header.get("integration", ""))
    half = len(times) // 2
    are_counts = file.units[1] == "counts"
    refuse(
        file.name,
        (
            (is_ratio or scan_number == 0) and not file.has_reference,
            Problem(
                "no white reference was taken",
                mend="pass quantity='radiance'" if is_ratio else "pass scan='target'",
                code="reference-missing",
            ),
        ),
        (
            not is_ratio and units != quantity,
            Problem(
                f"the scan of the {SCANS[scan_number]} is in {units}",
                expected=quantity,
                mend=f"pass quantity={units!r}, or save the file in {quantity} with the vendor's software",
                code="quantity-wrong",
            ),
        ),
        (
            is_ratio and file.units[0] != file.units[1],
            Problem(
                f"its reference is in {file.units[0]} and its target in {file.units[1]}",
                mend=f"pass quantity={file.units[1]!r}",
                code="units-conflict",
            ),
        ),
        (
            is_ratio and are_counts and times[:half] != times[half:],
            Problem(
                "reference and target are counts of different or unknown integration times",
                mend="save the file in radiance with the vendor's software, or pass quantity='counts'",
                code="integration-time-conflict",
            ),
        ),
    )
    values = (
        ratio(file.target, file.reference)
        if is_ratio
        else (file.reference, file.target)[scan_number] * file.dialect.scale[quantity]
    )
    handovers = _handovers(file, joins) if trim else ()
    is_used = _trimmed_channels(file, handovers)
    refuse(
        file.name,
        (
            not is_used.any(),
            Problem(
                "no channel remains after trimming; detectors are not in order of wavelength",
                mend="copy the file again",
                code="wavelength-unordered",
            ),
        ),
    )
    # number of the detector of each channel: by the steps back in wavelength, or by the joins of the header
    detector = None
    if len(file.starts) > 1:
        detector = np.searchsorted(file.starts[1:], np.arange(len(file.wavelength)), side="right")[is_used]
    elif overlap.joins is not None:
        detector = np.searchsorted(sorted(overlap.joins), file.wavelength)[is_used]
    return _Measurement(file, overlap, file.wavelength[is_used], values[is_used], detector, handovers)


def _handovers(file: SvcFile, joins: tuple[float, float] | None) -> tuple[float, ...]:
    # Return the wavelength [nm] at which each detector but the last ends.
    handovers = []
    for start, join in zip(file.starts[1:], joins or SVC_JOINS, strict=False):
        first, last = float(file.wavelength[start]), float(file.wavelength[start - 1])
        # the vendor's software may begin the next detector at its first channel, one step above the join
        low = first - float(np.ptp(file.wavelength[start : start + 2]))
        high = last + float(np.ptp(file.wavelength[max(start - 2, 0) : start]))
        refuse(
            file.name,
            (
                joins is not None and not low <= join <= high,
                Problem(
                    f"the join at {join:g} nm is outside the overlap of detectors",
                    expected=f"{first:g} to {last:g} nm",
                    mend="pass joins= within the overlaps",
                    code="join-outside-overlap",
                ),
            ),
        )
        handovers.append(min(max(join, low), high))
    return tuple(handovers)


def _trimmed_channels(file: SvcFile, handovers: Sequence[float]) -> Bools:
    # Return which channels remain: below a join those of the lower detector, above it those of the next.
    is_used = np.ones(len(file.wavelength), bool)
    for start, join in zip(file.starts[1:], handovers, strict=False):
        is_used[:start] &= file.wavelength[:start] <= join
        is_used[start:] &= file.wavelength[start:] > join
    return is_used


def _joins_advice(measurements: Sequence[_Measurement]) -> str:
    # Return the advice to trim, if trimming gives all files the same wavelengths; or an empty text.
    files = [measurement.file for measurement in measurements]
    overlaps = [measurement.overlap for measurement in measurements]
    for joins in sorted({overlap.joins for overlap in overlaps if overlap.joins is not None}):
        try:
            used = [_trimmed_channels(file, _handovers(file, joins)) for file in files]
        except FormatError:
            continue
        grids = [(file.name, file.wavelength[is_used]) for file, is_used in zip(files, used, strict=True)]
        if len(same_grids(grids)) == 1:
            return f", or pass overlap='trim', joins=({joins[0]:g}, {joins[1]:g}), which makes them equal"
    return ""


# --- coordinates -------------------------------------------------------------------------------------------


def _coords_of_files(
    paths: Sequence[Path], measurements: Sequence[_Measurement], *, is_ratio: bool
) -> dict[str, Any]:
    # Return the coordinates of the channels, and of the files' names, instruments, overlaps and errors.
    files = [measurement.file for measurement in measurements]
    overlaps = [measurement.overlap for measurement in measurements]
    errors = np.array([error_bits(file.header) for file in files], np.int64)
    factors = np.array([overlap.factors for overlap in overlaps], np.float64)
    # name: values along the spectra, meaning, units
    rows: dict[str, tuple[Any, ...]] = {
        "spectrum": (
            name_spectra([(path, path.name.removesuffix(path.suffix)) for path in paths]),
            "Name of the spectrum",
        ),
        "source": ([file.name for file in files], "File"),
        "instrument": ([file.header.get("instrument", "") for file in files], "Instrument"),
        "overlap": (
            [
                f"trimmed @ {', '.join(f'{join:g}' for join in measurement.trimmed_at)} nm"
                if measurement.trimmed_at
                else measurement.overlap.text
                for measurement in measurements
            ],
            "What became of channels where detectors overlap",
        ),
        "overlap_matched": (
            np.array([overlap.matching.lower() not in ("", "none") for overlap in overlaps], bool),
            "Whether values were changed to make detectors meet",
        ),
        "factors": (
            [file.header.get("factors", "") for file in files],
            "Matching of the detectors as the file says it",
        ),
        "header": (
            [json.dumps(dict(file.header), ensure_ascii=False) for file in files],
            "Header of the file as JSON",
        ),
    }
    for scan, name in enumerate(SCANS):
        meaning = f"VNIR over SWIR 1 in their overlap, scan of the {name}"
        rows[f"factor_{name}"] = (factors[:, scan], meaning, "1")
        meaning = f"Error bits of the instrument, scan of the {name}; -1 where unknown"
        rows[f"error_{name}"] = (errors[:, scan], meaning)
    if is_ratio:
        meaning = "Largest distance of the file's own rounded reflectance from the recomputed"
        # difference of each file's fourth column from the ratio, with a warning if it exceeds rounding
        differences = np.full(len(files), np.nan)
        contradictory = []
        for number, file in enumerate(files):
            with np.errstate(all="ignore"):
                scan_ratio = file.target / file.reference
                difference = np.abs(100.0 * scan_ratio - file.percent)
                # the file rounds all numbers, of the scans and of the ratio
                limit = _HALF_DIGIT * (1.0 + 100.0 * (1.0 + np.abs(scan_ratio)) / np.abs(file.reference))
                is_contradictory = (difference > limit * (1.0 + 1e-9) + 1e-9) | (
                    np.isfinite(scan_ratio) & ~np.isfinite(file.percent)
                )
            differences[number] = max(difference[np.isfinite(difference)], default=np.nan) / 100.0
            if is_contradictory.any():
                contradictory.append(f"{file.name} ({np.count_nonzero(is_contradictory)} channels)")
        warn_of(
            "the reflectance in the file contradicts its two scans (edited or resampled?); "
            "their ratio is used",
            contradictory,
            "reflectance-conflict",
        )
        rows["column_difference"] = (differences, meaning, "1")
    return {
        name: (
            "spectrum",
            np.array(values, object) if isinstance(values, list) else values,
            {"long_name": meaning, **({"units": units[0]} if units else {})},
        )
        for name, (values, meaning, *units) in rows.items()
    }


def _coords_of_scans(
    files: Sequence[SvcFile], scans: Sequence[int], dayfirst: bool | None, utc_offset_h: float | None
) -> dict[str, Any]:
    # Return UTC of each of the scans, and the position of the first of them.
    stamps = [[read_stamp(text) for text in pair(file.header, "time")] for file in files]
    instruments = [file.header.get("instrument", "") for file in files]
    orders = orders_of(
        (instrument, stamp)
        for instrument, stamps_of_file in zip(instruments, stamps, strict=True)
        for stamp in stamps_of_file
        if stamp is not None
    )
    files_by_reason: dict[tuple[str, str], dict[str, None]] = {}
    times = {scan: np.full(len(files), _NAT) for scan in scans}
    for number, file in enumerate(files):
        order = orders.get(instruments[number])
        for scan in scans:
            stamp, position = stamps[number][scan], position_of(file.header, scan)
            gps, has_bad_gps = None, False
            try:
                gps = read_gps_time(pair(file.header, "gpstime")[scan])
            except ValueError:
                has_bad_gps = True
            # a stamp with slashes takes the order of other files of its instrument
            local = utc = None
            if stamp is not None:
                local = stamp.read(order if dayfirst is None and stamp.slashes else dayfirst)
            if local is not None:
                utc = utc_of(local, gps, (position or _NO_POSITION)[1], utc_offset_h)
            if utc is not None:
                times[scan][number] = np.datetime64(utc, "ns")
            is_conflict = (
                local is not None
                and utc is not None
                and not (utc_offset_h is None or gps is None)
                and abs((local - utc).total_seconds() / 3600.0 - utc_offset_h) > 0.25
            )
            reasons = {
                ("missing or unreadable times are NaT", "time-unreadable"): stamp is None,
                ("dates of unknown order are NaT; pass dayfirst=", "date-ambiguous"): stamp and not local,
                ("unreadable GPS times are ignored", "gps-time-unreadable"): local and has_bad_gps,
                ("local times without GPS time are NaT; pass utc_offset_h=", "zone-missing"): local
                and not utc,
                (
                    f"utc_offset_h={utc_offset_h or 0.0:+g} contradicts GPS time, which is used",
                    "utc-offset-conflict",
                ): is_conflict,
            }
            for key in (key for key, applies in reasons.items() if applies):
                files_by_reason.setdefault(key, {})[file.name] = None
    for (reason, code), names in files_by_reason.items():
        warn_of(reason, list(names), code)
    coords: dict[str, Any] = {}
    for scan in scans:
        meaning = f"UTC of the scan of the {'white reference' if scan == 0 else 'target'}"
        name = "time" if scan == scans[0] else "reference_time"
        coords[name] = ("spectrum", times[scan], {"long_name": meaning})
    # positions by the GPS
    positions = [position_of(file.header, scans[0]) for file in files]
    warn_of(
        "unreadable positions are NaN",
        [file.name for file, position in zip(files, positions, strict=True) if position is None],
        "position-unreadable",
    )
    columns = np.array([position or _NO_POSITION for position in positions], np.float64).T
    for name, column in zip(("latitude", "longitude"), columns, strict=True):
        attrs = {**VARIABLES[name].attrs, "long_name": f"{name.capitalize()} of the spectrometer"}
        coords[name] = ("spectrum", column, attrs)
    return coords


# --- clocks ------------------------------------------------------------------------------------------------


_STAMP = re.compile(
    r"(\d{1,4})([/.-])(\d{1,2}|[^\W\d_]{3,9})\.?\2(\d{1,4})"
    r"(?:\s+|T)(\d{1,2})[:.](\d{2})(?:[:.](\d{2}))?(?:[.,]\d{1,9})?"
    r"\s*(?:([AP])\.?\s?M\.?)?",
    re.IGNORECASE,
)
# abbreviated months in English, German, Italian, French, Spanish and Portuguese
_MONTHS = (
    ("jan", "gen", "ene", "jän"),
    ("feb", "fev", "fév"),
    ("mar", "mär", "mrz"),
    ("apr", "avr", "abr"),
    ("may", "mai", "mag"),
    ("jun", "giu", "juin"),
    ("jul", "lug", "juil"),
    ("aug", "ago", "aoû", "aou"),
    ("sep", "set"),
    ("oct", "okt", "ott", "out"),
    ("nov",),
    ("dec", "dez", "dic", "déc"),
)
_GPS_TIME = re.compile(r"(\d{1,2})(\d\d)(\d\d)(?:[.,](\d{1,6})\d{0,3})?", re.ASCII)
_DAY = dt.timedelta(days=1)


@dataclass(frozen=True)
class LocalStamp:
    # Date and time of a local clock, without a zone.

    day_first: dt.datetime | None  # date read in this order; None if there is no such date
    month_first: dt.datetime | None
    slashes: bool  # whether slashes separate the numbers; only then do both orders occur

    @property
    def order(self) -> bool | None:
        # True if the day comes first, False if the month does, None if both are possible.
        if self.day_first == self.month_first:
            return None
        if self.day_first is None or self.month_first is None:
            return self.month_first is None
        return None if self.slashes else True

    def read(self, dayfirst: bool | None) -> dt.datetime | None:
        # Return the date in the given or the only possible order; None if it is ambiguous.
        if None in (self.day_first, self.month_first) or self.day_first == self.month_first:
            return self.day_first or self.month_first
        order = self.order if dayfirst is None else dayfirst
        return None if order is None else self.day_first if order else self.month_first


def read_stamp(text: str) -> LocalStamp | None:
    """Return a time stamp, None where it is unreadable.

    Examples
    --------
    >>> read_stamp("02/08/2024 10:07:36AM").read(None) is None  # 2 August or 8 February
    True
    >>> read_stamp("16/10/2024 10:47:58").read(None), read_stamp("11-lug-15 13.08.32").read(None)
    (datetime.datetime(2024, 10, 16, 10, 47, 58), datetime.datetime(2015, 7, 11, 13, 8, 32))
    """
    match = _STAMP.fullmatch(text.strip()) if len(text) <= 80 else None
    if match is None:
        return None
    first, separator, second, third, hour, minute, seconds, am_pm = match.groups()
    year = first if len(first) == 4 else third
    if len(year) not in (2, 4) or (am_pm is not None and not 1 <= int(hour) <= 12):
        return None
    hours = int(hour) if am_pm is None else int(hour) % 12 + 12 * (am_pm.upper() == "P")

    def date(month: int | None, day: str | int) -> dt.datetime | None:
        full_year = int(year) + 2000 if int(year) < 100 else int(year)
        try:
            stamp = dt.datetime(full_year, month or 0, int(day), hours, int(minute), int(seconds or 0))
        except ValueError:
            return None
        return stamp if 1990 <= stamp.year < 2200 else None

    # the order is certain if the year comes first, or the month is a word
    is_word = not second.isdecimal()
    if is_word or len(first) == 4:
        word = second.lower()
        names = (number for number, prefixes in enumerate(_MONTHS, 1) if word.startswith(prefixes))
        certain = date(next(names, None) if is_word else int(second), third if len(first) == 4 else first)
        return None if certain is None else LocalStamp(certain, certain, slashes=False)
    day_first, month_first = date(int(second), first), date(int(first), second)
    return (
        None
        if day_first is None and month_first is None
        else LocalStamp(day_first, month_first, slashes=separator == "/")
    )


def orders_of(stamps: Iterable[tuple[str, LocalStamp]]) -> dict[str, bool]:
    """Return the order of dates of each instrument whose unambiguous dates agree: True for day first.

    stamps: Instrument and stamp of every scan.

    Examples
    --------
    >>> dates = ("6/5/2024 9:00:00", "6/30/2024 9:00:00")
    >>> orders_of(("HI: 1152050", read_stamp(text)) for text in dates)
    {'HI: 1152050': False}
    """
    orders_by_instrument: dict[str, set[bool]] = {}
    for instrument, stamp in stamps:
        if stamp.slashes and stamp.order is not None:
            orders_by_instrument.setdefault(instrument, set()).add(stamp.order)
    return {
        instrument: next(iter(orders))
        for instrument, orders in orders_by_instrument.items()
        if len(orders) == 1
    }


def read_gps_time(text: str) -> dt.timedelta | None:
    """Return the time of day in UTC from ``HHMMSS.sss``; None if the text is empty, as without a fix.

    Raises ValueError: The text is not a time of day.

    Examples
    --------
    >>> read_gps_time("090724.786")
    datetime.timedelta(seconds=32844, microseconds=786000)
    """
    if not text:
        return None
    match = _GPS_TIME.fullmatch(text)
    if match is None or int(match[1]) > 23 or int(match[2]) > 59 or int(match[3]) > 60:
        raise ValueError(f"{text[:20]!r}: expected a time of day, HHMMSS.sss")
    return dt.timedelta(
        hours=int(match[1]),
        minutes=int(match[2]),
        seconds=int(match[3]),
        microseconds=int((match[4] or "0").ljust(6, "0")),
    )


def utc_of(
    local: dt.datetime, gps: dt.timedelta | None, longitude: float, utc_offset_h: float | None
) -> dt.datetime | None:
    """Return UTC of a scan: the GPS time of day on the nearest date of the local clock.

    local: Time of the local clock.
    gps: Time of day in UTC, used instead of the local clock's.
    longitude: Degrees east; gives the UTC offset to within hours, which suffices to find the date.
    utc_offset_h: Local time minus UTC [h], needed without GPS time.

    Examples
    --------
    >>> utc_of(dt.datetime(2024, 2, 8, 20, 30), dt.timedelta(hours=1, minutes=30, seconds=4), -75.0, None)
    datetime.datetime(2024, 2, 9, 1, 30, 4)
    """
    if gps is None:
        return None if utc_offset_h is None else local - dt.timedelta(hours=utc_offset_h)
    if utc_offset_h is None:
        utc_offset_h = longitude / 15.0 if math.isfinite(longitude) else 0.0
    approximate_utc = local - dt.timedelta(hours=utc_offset_h)
    midnight = approximate_utc.replace(hour=0, minute=0, second=0, microsecond=0)
    return min(
        (midnight + days * _DAY + gps for days in (-1, 0, 1)), key=lambda utc: abs(utc - approximate_utc)
    )
