"""Texts of field and pocket spectrometers: a head, headings, and columns that have a quantity each.

`FORMS` has one row for each way to write such a file, `_COLUMNS` the quantity of a column by its heading.
Numbers have a decimal point or comma. A column without a heading is what the head of the file says, or is
declared by the caller.

Spectra of SVC field spectrometers as labelled arrays, and the layout of their text files (``.sig``).

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
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, NamedTuple, TypeVar, get_args

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
    TimeError,
    UnitsError,
    as_path,
    conversion_factor,
    discover,
    fetch,
    grouped,
    input_path,
    label,
    listed,
    one_of,
    same_dimension,
    warn_if,
)
from hyperpaint.io.files.reading import (
    decoded_text,
    first_row,
    is_pattern,
    matching_files,
    read_limited_text,
    refuse,
    row_numbers,
    unique_names,
)

# --- shared steps of the readers of field spectrometers: find files, list errors, name spectra --------------


QUANTITIES = ("counts", "radiance", "reflectance", "irradiance")

#: Headings of standard deviations, and of further statistics of spectra.
SPREAD = re.compile(
    r"(?<![a-z])(?:standard[ _.-]?(?:dev|abw)\w*|stabw|[ée]cart[ -]?type|desviaci[oó]n\w*|st\.? ?dev\w*|"
    r"std(?:ev|dev)?|s\.?d\.?|sigma|stdv|1s)(?![a-z])",
    re.I,
)
STATISTIC = re.compile(
    r"(?<![a-z])(?:variance|var|(?:[a-z]+[ _])?uncert\w*|[a-z]*unsicher\w*|unc|u(?= ?[(_])|"
    r"(?:(?:standard|std)[ _]?)?err(?:ors?)?|sem|cov|snr|(?:quality[ _-]?)?flags?|qc|weights?|"
    r"k ?= ?\d+|\+ ?/ ?-|\u00b1)(?![a-z])",
    re.I,
)
#: Headings of means, and what is a statistic beside its spectrum, and may be a name elsewhere.
MEAN = re.compile(r"(?<![a-z])(?:mean|average|avg|mittel(?:wert)?|moyenne|promedio|media)(?![a-z])", re.I)
_BESIDE = re.compile(
    r"(?<![a-z])(?:se|cv|u|min(?:imum)?|max(?:imum)?|median|[pq]\d\d|"
    r"(?:lower|upper|lcl|ucl|ci)(?:[ _-]?(?:lower|upper|low|high|lo|hi|\d+))*)(?![a-z])|"
    r"(?<![a-z])[d\u03b4](?:r|rho|refl\w*)(?![a-z])",
    re.I,
)
#: Statistics where nothing else stands in the heading: counts, and limits beside a mean.
_COUNT = re.compile(r"n ?(?:obs|spectra|samples)?|number", re.I)
_LIMIT = re.compile(r"(?:lo|hi|low|high)[ _-]?\d*|[pq]\d+", re.I)
#: Words that are left out when headings are compared.
_WORDS = re.compile(
    rf"{STATISTIC.pattern}|{SPREAD.pattern}|{_BESIDE.pattern}|"
    r"(?<![a-z])(?:reflectances?|reflectivity|refl|rho|r)(?![a-z])",
    re.I,
)

Paths = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]
_T = TypeVar("_T")
_R = TypeVar("_R")

_NUMBER = re.compile(r"[-+]?(?:\d+(?:[.,]\d*)?|[.,]\d+)(?:[eE][-+]?\d{1,5})?", re.ASCII)
# NaN and infinity as programs and Windows' C library print them, in several languages
_NON_FINITE_WORDS = {
    **dict.fromkeys(("nan", "n.def.", "1.#qnan", "1.#ind"), math.nan),
    **dict.fromkeys(("inf", "infinity", "unendlich", "\N{INFINITY}", "1.#inf"), math.inf),
}


def text_lines(data: bytes) -> list[str]:
    # Return the lines of a text, with any line ends; NULs are left out.
    return decoded_text(data).replace("\0", "").replace("\r\n", "\n").replace("\r", "\n").split("\n")


def cell_number(text: str) -> float | None:
    """Return the number of a cell, with a point or a comma; None for other text.

    Examples
    --------
    >>> cell_number("-5,1"), cell_number("1.5E-02"), cell_number("-Infinity"), cell_number("1,5,0")
    (-5.1, 0.015, -inf, None)
    """
    if _NUMBER.fullmatch(text):
        return float(text.replace(",", "."))
    value = _NON_FINITE_WORDS.get((text[1:] if text[:1] in "+-" else text).lower())
    return -value if value is not None and text[0] == "-" else value


def statistics_among(names: Sequence[str]) -> list[str]:
    """Return the names of columns that are statistics of other columns, not spectra.

    Examples
    --------
    >>> statistics_among(["red.asd", "red sd", "White Std", "Std", "variance"])
    ['red sd', 'Std', 'variance']
    >>> statistics_among(["mean", "SE", "max"]), statistics_among(["E", "SE", "max"])
    (['SE', 'max'], [])
    >>> statistics_among(["red", "red_err", "cherry", "mint", "median grey", "u(R)"])
    ['red_err', 'u(R)']
    """
    # names without the words for a mean, a spread, statistics, and without the suffix of a file
    rest = [MEAN.sub(" ", name.lower()).strip().removesuffix(".asd") for name in names]
    stems = ["".join(filter(str.isalnum, _WORDS.sub(" ", name).replace(".asd ", " "))) for name in rest]
    always = [bool(STATISTIC.search(name) or SPREAD.search(name)) for name in rest]
    worded = [known or bool(_BESIDE.search(name)) for known, name in zip(always, rest, strict=True)]
    spectra = {stem for stem, has_word in zip(stems, worded, strict=True) if not has_word}
    # a median is the spectrum of a paint that has no other
    medians = {s for s, name in zip(stems, rest, strict=True) if "median" in name and s not in spectra}
    return [
        name
        for stem, given, is_known, has_word, name in zip(stems, rest, always, worded, names, strict=True)
        if _COUNT.fullmatch(name)
        or (is_known and not stem)
        or (has_word and stem in spectra | medians and not ("median" in given and stem in medians))
        or (_LIMIT.fullmatch(name) and "" in spectra | medians)
    ]


def find_paths(
    paths: Paths,
    of_folder: Callable[[list[Path]], list[Path]],
    expected: str,
    of_pattern: Callable[[list[Path]], list[Path]] = list,
) -> list[Path]:
    # Return the files of ``paths``: a file, a glob, a folder, or a list of these.
    #
    # of_folder, of_pattern: Select the spectra among the files of a folder, and among the matches of a glob.
    # expected: Names the accepted files in messages.
    # Raises FormatError: No file is found, or a glob leads out of its folder or matches too many files.
    if isinstance(paths, str | os.PathLike):
        paths = [paths]
    with Problems("spectra cannot be opened", FormatError) as problems:
        files: list[Path] = []
        for entry in paths:
            path = input_path(entry, expected, content=False)
            if path.is_dir():
                discover(path)
                # pipes and broken links are kept, so that reading reports them
                folder_files = sorted(
                    p for p in path.iterdir() if not p.is_dir() and not p.name.startswith(".")
                )
                matches = of_folder(folder_files)
            elif os.path.lexists(path) or not is_pattern(str(path)):
                matches = [path]
            else:
                pattern_start = next(number for number, part in enumerate(path.parts) if is_pattern(part))
                try:
                    matches = of_pattern(
                        matching_files(
                            Path(*path.parts[:pattern_start]), "/".join(path.parts[pattern_start:])
                        )
                    )
                except ValueError as error:
                    problems.add(f"{path}: {error}", code="pattern-unusable")
                    continue
            problems.add_if(
                not matches, f"{path}: no spectra found", expected=expected, code="file-not-found"
            )
            files += matches
        problems.add_if(
            not files and not problems, "an empty list of files", mend="name at least one", code="empty-input"
        )
    fetch(files)
    return files


def for_all(items: Iterable[_T], function: Callable[[_T], _R]) -> list[_R]:
    # Return the results of a function for all items, in their order.
    # Raises FormatError: The function raised it for some items. One error lists each reason once, with its
    # items.
    outputs: list[_R] = []
    names_by_problem: dict[Problem, list[str]] = {}
    for item in items:
        try:
            outputs.append(function(item))
        except FormatError as error:
            name, _, found = error.problem.found.partition(": ")
            names_by_problem.setdefault(replace(error.problem, found=found), []).append(name)
    if names_by_problem:
        problems = [
            replace(problem, found=": ".join(filter(None, [", ".join(names), problem.found])))
            for problem, names in names_by_problem.items()
        ]
        raise FormatError("spectra cannot be used", problems=problems)
    return outputs


def same_grids(
    grids: Iterable[tuple[str, Floats]],
) -> list[tuple[Floats, list[str]]]:
    # Return each distinct set of wavelengths with the names of its spectra.
    groups = grouped((wavelength.tobytes(), (wavelength, name)) for name, wavelength in grids)
    return [(members[0][0], [name for _, name in members]) for members in groups.values()]


def require_one_grid(grids: Iterable[tuple[str, Floats]], advice: Callable[[], str] = str) -> None:
    # Refuse spectra on several sets of wavelengths; ``advice`` completes the message.
    # Raises FormatError: There are several sets; each is listed with the names of its spectra.
    groups = same_grids(grids)
    if len(groups) > 1:
        problems = [
            Problem(
                f"{len(grid)} from {grid[0]:g} to {grid[-1]:g} nm"
                f"{', overlap kept' if np.any(np.diff(grid) <= 0.0) else ''}: {', '.join(names)}",
                code="grid-mismatch",
            )
            for grid, names in groups
        ]
        raise FormatError(
            "spectra differ in their wavelengths",
            mend=f"open them separately{advice()}",
            problems=problems,
            code="grid-mismatch",
        )


def common_quantity(quantities: Iterable[tuple[str | None, str]]) -> str:
    # Return the quantity that all files hold.
    # quantities: Quantity, None where unknown, and name of each file.
    # Raises FormatError: A quantity is unknown, or they differ; all are listed.
    names_by_quantity = grouped(quantities)
    if len(names_by_quantity) > 1 or None in names_by_quantity:
        raise FormatError(
            "the spectra hold several or unknown quantities",
            mend="pass quantity=",
            problems=[
                Problem(f"{key or 'unknown'}: {', '.join(file_names)}", code="quantity-ambiguous")
                for key, file_names in names_by_quantity.items()
            ],
            code="quantity-ambiguous",
        )
    return next(str(quantity) for quantity in names_by_quantity)


def ratio(numerator: Floats, denominator: Floats) -> Floats:
    # Return the ratio, NaN where the denominator is zero or undefined.
    quotient = np.full(numerator.shape, np.nan)
    with np.errstate(all="ignore"):  # values of damaged files; non-finite results are reported later
        np.divide(numerator, denominator, out=quotient, where=denominator != 0.0)
    return quotient


def name_spectra(sources: Sequence[tuple[Path, str]]) -> list[str]:
    """Return a distinct name for each spectrum.

    sources: File and name of each spectrum. Repeated names get their folder as prefix; if they still repeat,
        a number as suffix.

    Examples
    --------
    >>> name_spectra([(Path("a/red.sig"), "red"), (Path("b/red.sig"), "red"), (Path("b/blue.sig"), "blue")])
    ['a/red', 'b/red', 'blue']
    """
    count = Counter(name for _, name in sources)
    return unique_names(
        f"{path.parent.name}/{name}" if count[name] > 1 and path.parent.name else name
        for path, name in sources
    )


def check_utc_offset(hours: float | None) -> None:
    # Refuse local time minus UTC [h] beyond the offsets of all zones.
    # Raises TimeError: It is outside -14 to 14.
    TimeError.raise_if(
        hours is not None and not -14.0 <= hours <= 14.0,
        f"utc_offset_h={hours}",
        expected="local time minus UTC in hours, within -14 to 14",
        code="value-out-of-range",
    )


def warn_of(problem: str, names: Sequence[str], code: str) -> None:
    # Warn of a problem of the named files, if there are any.
    warn_if(names, f"{problem}. Files: {listed(names)}", code)


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
    separator: str | None = None  # between the columns; None for blanks
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
    # Return the dialect of a file by its first bytes, of UTF-16 too; None for files of another kind.
    return next(
        (
            dialect
            for dialect in DIALECTS
            if dialect.magic.match(head.lstrip(b"\xff\xfe").replace(b"\0", b""))
        ),
        None,
    )


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
    path = as_path(path)
    data = read_limited_text(path, _MAX_BYTES, "an SVC spectrometer's file")
    ger_hint = " (a GER file; SVC's software converts it)" if data[:6] == b"///GER" else ""
    dialect = FormatError.raise_if_none(
        dialect_of(data[:200]),
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
            [
                cell_number(cell)
                for cell in line.replace("n. def.", "n.def.").split(dialect.separator, count + 1)
            ],
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
    joins = overlap_of(header).joins
    unit_words = [word.strip().lower() for word in header.get("units", "").split(",")]
    units = tuple(dialect.units.get(word, word) for word in (unit_words * 2)[: max(len(unit_words), 2)])
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
            joins is not None and wavelength.max(initial=0.0) < max(joins),
            Problem(
                f"the rows end before the header's joins of detectors at {joins} nm",
                mend="copy the file again from the instrument",
                code="file-truncated",
            ),
        ),
        (
            len(units) != 2 or not set(units) <= set(dialect.scale),
            Problem(
                repr(header["units"][:60]) if "units" in header else "no line 'units='",
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
    coords: dict[str, Any] = {
        "wavelength": (
            "wavelength",
            measurements[0].wavelength,
            {**VARIABLES["wavelength"].attrs, "long_name": "Wavelength of the spectrometer"},
        )
    }
    detector = measurements[0].detector
    if detector is not None and all(
        measurement.detector is not None and np.array_equal(measurement.detector, detector)
        for measurement in measurements
    ):
        names = np.array(DETECTORS, object)[detector]
        coords["detector"] = ("wavelength", names, {"long_name": "Detector of the channel"})
    scans = (1, 0) if is_ratio else (scan_number,)
    coords |= _coords_of_scans(contents, scans, dayfirst, utc_offset_h)
    # coordinates of the channels, and of the files' names, instruments, overlaps and errors.
    svc_files = [measurement.file for measurement in measurements]
    overlaps = [measurement.overlap for measurement in measurements]
    errors = np.array([error_bits(svc_file.header) for svc_file in svc_files], np.int64)
    factors = np.array([overlap.factors for overlap in overlaps], np.float64)
    # name: values along the spectra, meaning, units
    rows: dict[str, tuple[Any, ...]] = {
        "spectrum": (
            name_spectra([(path, path.name.removesuffix(path.suffix)) for path in files]),
            "Name of the spectrum",
        ),
        "source": ([svc_file.name for svc_file in svc_files], "File"),
        "instrument": ([svc_file.header.get("instrument", "") for svc_file in svc_files], "Instrument"),
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
            [svc_file.header.get("factors", "") for svc_file in svc_files],
            "Matching of the detectors as the file says it",
        ),
        "header": (
            [json.dumps(dict(svc_file.header), ensure_ascii=False) for svc_file in svc_files],
            "Header of the file as JSON",
        ),
    }
    for index, name in enumerate(SCANS):
        meaning = f"VNIR over SWIR 1 in their overlap, scan of the {name}"
        rows[f"factor_{name}"] = (factors[:, index], meaning, "1")
        meaning = f"Error bits of the instrument, scan of the {name}; -1 where unknown"
        rows[f"error_{name}"] = (errors[:, index], meaning)
    if is_ratio:
        meaning = "Largest distance of the file's own rounded reflectance from the recomputed"
        # difference of each file's fourth column from the ratio, with a warning if it exceeds rounding
        differences = np.full(len(svc_files), np.nan)
        contradictory = []
        for number, svc_file in enumerate(svc_files):
            with np.errstate(all="ignore"):
                scan_ratio = svc_file.target / svc_file.reference
                difference = np.abs(100.0 * scan_ratio - svc_file.percent)
                # the file rounds all numbers, of the scans and of the ratio
                limit = _HALF_DIGIT * (1.0 + 100.0 * (1.0 + np.abs(scan_ratio)) / np.abs(svc_file.reference))
                is_contradictory = (difference > limit * (1.0 + 1e-9) + 1e-9) | (
                    np.isfinite(scan_ratio) & ~np.isfinite(svc_file.percent)
                )
            differences[number] = max(difference[np.isfinite(difference)], default=np.nan) / 100.0
            if is_contradictory.any():
                contradictory.append(f"{svc_file.name} ({np.count_nonzero(is_contradictory)} channels)")
        warn_of(
            "the reflectance in the file contradicts its two scans (edited or resampled?); "
            "their ratio is used",
            contradictory,
            "reflectance-conflict",
        )
        rows["column_difference"] = (differences, meaning, "1")
    coords |= {
        name: (
            "spectrum",
            np.array(values, object) if isinstance(values, list) else values,
            {"long_name": meaning, **({"units": units[0]} if units else {})},
        )
        for name, (values, meaning, *units) in rows.items()
    }
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
    found: dict[tuple[tuple[str, str], str], None] = {}  # reason with its code, and file
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
            found |= {(reason, file.name): None for reason, applies in reasons.items() if applies}
    for (text, code), names in grouped(found).items():
        warn_of(text, names, code)
    coords: dict[str, Any] = {
        "time" if scan == scans[0] else "reference_time": (
            "spectrum",
            times[scan],
            {"long_name": f"UTC of the scan of the {'white reference' if scan == 0 else 'target'}"},
        )
        for scan in scans
    }
    # positions by the GPS
    positions = [position_of(file.header, scans[0]) for file in files]
    warn_of(
        "unreadable positions are NaN",
        [file.name for file, position in zip(files, positions, strict=True) if position is None],
        "position-unreadable",
    )
    columns = np.array([position or _NO_POSITION for position in positions], np.float64).T
    return coords | {
        name: (
            "spectrum",
            column,
            {**VARIABLES[name].attrs, "long_name": f"{name.capitalize()} of the spectrometer"},
        )
        for name, column in zip(("latitude", "longitude"), columns, strict=True)
    }


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
    orders_by_instrument = grouped(
        (instrument, order)
        for instrument, stamp in stamps
        if stamp.slashes and (order := stamp.order) is not None
    )
    return {
        instrument: orders[0] for instrument, orders in orders_by_instrument.items() if len(set(orders)) == 1
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


class Form(NamedTuple):
    # Form of a text that an instrument or its program writes.
    instrument: str
    # Up to the headings, or to the rows where there are none; of the first 16 kB of a file
    begins: re.Pattern[str]
    # Line after the rows; text below it is not read
    ends: re.Pattern[str] | None = None
    # Date and time of the spectrum in the head, and the order of a date with slashes
    stamp: str = r"^(?:Date|Time)[^:\t\n]*[:\t] *(?P<date>[\d/.-]{8,10})[ _,]+(?P<time>[\d:]{7,8})"
    dayfirst: bool | None = None
    units: str = ""  # of radiance or irradiance, where the file does not say
    quantity: str = ""  # of a column without a heading, where the head does not say


def _pattern(text: str) -> re.Pattern[str]:
    return re.compile(text, re.MULTILINE | re.IGNORECASE)


#: Layouts by files that users published: EnMAP-Box (DARWin), photobiologyInOut and lightr (the others).
FORMS = (
    Form(
        "Spectral Evolution",
        _pattern(r'^"?Data:"?[,;\t ]*\n(?="?(?:Chan\.?#"?[,;\t]"?)?Wvl\b)'),
        # of the reference, then of the target
        stamp=r"^Date: *(?:[^,\n]*, *)?(?P<date>[\d/.]{8,10})[^\n]*\n"
        r"Time: *(?:[^,\n]*, *)?(?P<time>[\d:]{7,8})(?P<fraction>\.\d{1,6})?",
        dayfirst=False,
    ),
    # in the languages of their software: "Begin Spectral Data", "Comienza Data"
    Form(
        "Ocean Optics",
        _pattern(r"^>{4,}[^\n]*\n"),
        re.compile(r">{4,}"),
        stamp=r"^(?:Date|Fecha|Datum): *(?:(?P<date>[\d-]{8,10}), *(?P<time>[\d:]{7,8})|"
        r"\w{3} (?P<month>[^\W\d]{3}) (?P<day>\d{1,2}) (?P<clock>[\d:]{8}) ?"
        r"(?P<zone>[A-Z]{3,4})? (?P<year>\d{4}))",
        units="uW cm-2 nm-1",
    ),
    Form("Avantes", _pattern(r"^(?=Wave[a-z]*\s*[;\t,][^\n]*\n\s*\[nm\])")),
    Form(
        "LI-180",
        _pattern(r"\AModel Name\tLI-180[^\n]*\n(?:\D[^\n]*\n){1,100}?(?=\d{3}nm\t)"),
        re.compile(r"\D"),
        units="mW m-2 nm-1",
        quantity="irradiance",
    ),
    Form("StellarNet", _pattern(r'\A" ?File:[^\n]*\n"[^\n]*Time:[^\n]*\n'), re.compile(r": ?\d")),
    Form("LI-1800", _pattern(r'\A"FILE:[^\n]*\n(?:"[^\n]*\n){2,20}')),
)
#: Suffixes of texts of spectra, in a folder.
SPECTRUM_SUFFIXES = (
    ".txt", ".tsv", ".csv", ".asc", ".sed", ".jaz", ".jazirrad",
    ".ssirrad", ".ovirrad", ".ttt", ".trt", ".irr"
)  # fmt: skip
#: Quantity and scan of a column by its heading: no quantity for numbers of channels, an empty one where the
#: head decides.
_COLUMNS = tuple(
    (re.compile(pattern, re.IGNORECASE), quantity, scan)
    for pattern, quantity, scan in (
        (r"chan|pixel", None, ""),
        (r"transm|absorb", "transmittance or absorbance", "target"),
        (r"reflect|tgt\.? ?/ ?ref|^r\b[^a-z]*%", "reflectance", "target"),
        (r"irrad.*\bref\b", "irradiance", "reference"),
        (r"irr(?:ad|\b)", "irradiance", "target"),
        (r"\brad.*\bref\b", "radiance", "reference"),
        (r"\brad", "radiance", "target"),
        (r"^(?:d|dark)\b", "counts", "dark"),
        (r"^(?:r|ref|reference)\b|dn \(ref", "counts", "reference"),
        (r"^(?:s|sample|scope)\b|\bdn\b|count|intensit", "counts", "target"),
        (r"", "", "target"),
    )
)
RATIO = "target / reference"
_WAVELENGTH = re.compile(r"w(?:vl|ave\w*|l)?\b", re.IGNORECASE)
#: What the head says of columns without a heading: words, and quantity.
_HEAD = (
    (_pattern(r'^"?rem:[^\n]*(?:\bqntm\b|photon|quant)'), "photons"),
    (_pattern(r"absolute ?irradiance|^\S*mode: *irradiance"), "irradiance"),
    (_pattern(r"^[^\n:]*mode: *reflect|^\"?rem: *refl"), "reflectance"),
    (_pattern(r"^[^\n:]*mode: *(?:transm|absorb)"), "transmittance or absorbance"),
    (_pattern(r"^[^\n:]*mode: *(?:scope|counts)"), "counts"),
)
_UNITS = _pattern(r'^"?(?:[yY] ?)?(?:units?|unidades|einheit(?:en)?) *[:=\t] *([^\n,"]{1,40})')
_IN_BRACKETS = re.compile(r"\[([^\[\]]{1,40})\]")
_OTHER_AXIS = _pattern(
    r"^x ?axis(?: mode)? *[:\t] *([^\n]*(?:wave ?number|raman|shift|freq|pixel|cm-1)[^\n]*)"
)
_INTEGRATION = _pattern(
    r"^(?:integration time|tiempo de integraci\S*|i-time)\s*(?:[(\[](usec|msec|sec|ms)[)\]])?\s*[:\t]\s*"
    r"(\d{1,9}(?:[.,]\d{1,9})?(?:E[+-]?\d{1,2})?)"
)
_SECONDS = {"usec": 1e-6, "sec": 1.0}
_AVERAGES = _pattern(r"^(?:spectra averaged|scans to average|average|averaging[^:\n]*) *: *(\d{1,6})\b")
#: Local time minus UTC [h] of the abbreviations that have one meaning.
_ZONES = {
    "UTC": 0, "GMT": 0, "WET": 0, "WEST": 1, "CET": 1, "CEST": 2, "EET": 2, "EEST": 3, "EST": -5, "EDT": -4,
    "CDT": -5, "MDT": -6, "PST": -8, "PDT": -7,
}  # fmt: skip
#: Fore optics of the reference and of the target.
_FORE_OPTIC = _pattern(r"^Foreoptic:([^\n]{0,200})")
_GPS = _pattern(
    r"^Latitude: *(-?\d{1,2}\.\d+)\s*\nLongitude: *(-?\d{1,3}\.\d+)\s*\nAltitude: *(-?\d{1,5}(?:\.\d+)?)\s*\n"
    r"GPS Time: *(\d\d):(\d\d):(\d\d)"
)
#: Quantities of a file, the derived ones first.
_PREFERRED = ("reflectance", "irradiance", "radiance", "counts")
_HEAD_BYTES = 16 * 1024
_MAX_TEXT_BYTES, _MAX_COLUMNS = 16 << 20, 32


class TextColumn(NamedTuple):
    # One spectrum of a file, in the units of the file.
    heading: str
    quantity: str  # empty where the file does not say
    scan: str
    units: str  # empty where the file does not say
    values: Floats


class SpectrumText(NamedTuple):
    # Content of one file.
    name: str
    instrument: str
    wavelength: Floats  # (wavelength) [nm]
    columns: tuple[TextColumn, ...]
    units: str  # of light by the head, or else the maker's; may be empty
    local_time: dt.datetime | None
    utc_offset_h: float | None
    averaging_s: float | None
    gps: tuple[float, float, float, dt.time] | None  # degrees north and east, metres, UTC
    fore_optic: str  # of the target; empty where the file does not say

    @property
    def quantity(self) -> str | None:
        # Quantity of the file, the derived one of several; None where it does not say.
        found = {column.quantity for column in self.columns if column.scan == "target"}
        return next((quantity for quantity in _PREFERRED if quantity in found), None)

    def column(self, quantity: str, units: str | None = None) -> TextColumn:
        # Return the target's spectrum of a quantity: in SI units, or reflectance as in the file.
        #
        # units: Of the values, where the file does not say.
        #
        # Raises FormatError: The file holds other quantities alone, or its units are unknown.
        targets = [column for column in self.columns if column.scan == "target"]
        known = [column for column in targets if column.quantity == quantity]
        unknown = [column for column in targets if not column.quantity]
        radiances = {column.scan: column.values for column in self.columns if column.quantity == "radiance"}
        if quantity == "reflectance" and not known and {"target", "reference"} <= set(radiances):
            values = ratio(radiances["target"], radiances["reference"])
            return TextColumn(RATIO, quantity, "target", "1", values)
        held = sorted({f"{c.quantity or 'an unnamed quantity'} of the {c.scan}" for c in self.columns})
        # the ratio of counts that a user may want to check by hand
        counts = {column.scan: column.values[0] for column in self.columns if column.quantity == "counts"}
        hint = ""
        if counts.get("reference") and "target" in counts:
            share = counts["target"] / counts["reference"]
            hint = f" (target / reference is {share:.3g} at {self.wavelength[0]:g} nm)"
        refuse(
            self.name,
            (
                not known and not unknown,
                Problem(
                    f"{self.instrument} text of {' and '.join(held)}, no {quantity}{hint}",
                    mend=_WAYS_OUT.get(self.quantity or "", "export it with the instrument's software"),
                    code="quantity-wrong",
                ),
            ),
        )
        column = (known or unknown)[-1]
        if quantity not in ("radiance", "irradiance"):
            return column._replace(quantity=quantity)
        target_units, file_units = VARIABLES[quantity].units, column.units or (self.units if known else "")
        refuse(
            self.name,
            (
                not (file_units or units),
                Problem(
                    f"{self.instrument} text without units of {quantity}",
                    mend=f"pass units=, for example {target_units!r}",
                    code="units-missing",
                ),
            ),
        )
        with FormatError.instead_of(
            UnitsError, f"{self.name}: units of {quantity}: $whole", code="units-unknown"
        ):
            factor = conversion_factor(file_units or str(units), target_units)
            is_conflict = bool(units) and conversion_factor(str(units), target_units) != factor
        refuse(
            self.name,
            (
                is_conflict,
                Problem(
                    f"units={units!r}, but the file has {file_units!r}",
                    mend="correct one of them",
                    code="units-conflict",
                ),
            ),
        )
        return column._replace(quantity=quantity, units=target_units, values=column.values * factor)


_WAYS_OUT = {
    "irradiance": "open it with hp.open_irradiance",
    "radiance": "open it with hp.open_asd(path, 'radiance')",
    "counts": "save reflectance with the instrument's software",
}


#: Heading of a column of times, and of a wavelength [nm], in the csv of a logger.
TIME_HEADING = re.compile(
    r"(?:(?:utc|local|unix|posix|epoch|sample|log|gps)[ _-]*)?"
    r"(?:time(?:[ _-]*stamp)?|date(?:[ _/-]*time)?|datum|(?:uhr)?zeit(?:stempel)?|utc)"
    r"[ _]*(?:utc|[(\[][^)\]]{0,20}[)\]])?",
    re.IGNORECASE,
)
NM_HEADING = re.compile(r"[xX]?(\d{1,5}(?:[.,]\d{1,6})?)\s*(?:[(\[]?nm[)\]]?)?", re.IGNORECASE)


def heading_cells(line: str) -> tuple[str, list[str]]:
    # Return the separator of a line of headings, and its cells without quotes.
    separator = max(";\t,", key=line.count)
    return separator, [cell.strip().strip('"').strip() for cell in line.strip(" \r\n").split(separator)]


def is_logger_csv(lines: Sequence[str]) -> bool:
    # Return whether a text begins as the csv of a logger: times, then wavelengths, below comments.
    first, row = [*(line for line in lines if line.strip() and not line.startswith("#")), "", ""][:2]
    _, (head, *cells) = heading_cells(first)
    if head.lower() == "time":
        return True
    if not head and cells:  # an index of pandas: the times, or numbers before them
        head, *cells = ["time", *cells] if re.match(r'"?\d{4}-\d\d-\d\d', row) else cells
    times = [cell for cell in cells[:1] if TIME_HEADING.fullmatch(cell)]
    is_wavelength = bool(cells[len(times) :]) and NM_HEADING.fullmatch(cells[len(times)]) is not None
    return is_wavelength and TIME_HEADING.fullmatch(head) is not None


def form_of(head: str) -> tuple[Form, re.Match[str]] | None:
    # Return the form of a text, and where its headings or rows begin; None for other files.
    found = ((form, form.begins.search(head[:_HEAD_BYTES])) for form in FORMS)
    return next(((form, match) for form, match in found if match is not None), None)


def read_spectrum_text(path: str | os.PathLike[str]) -> SpectrumText:
    r"""Read one text of an instrument in `FORMS`.

    Raises FormatError: The file cannot be read, is of another kind, or its table is damaged.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp(), "door.sed")
    >>> _ = path.write_text("Instrument: PSR\nData:\nWvl\tReflect. %\n550.0\t 6.7\n551.0\t 6.8\n")
    >>> read_spectrum_text(path).column("reflectance").values
    array([6.7, 6.8])
    """
    path = as_path(path)
    lines = text_lines(read_limited_text(path, _MAX_TEXT_BYTES, "a text of a spectrometer"))
    text = "\n".join(lines)
    found = FormatError.raise_if_none(
        form_of(text),
        f"{path.name}: no text of a spectrometer",
        expected=f"one of {', '.join(form.instrument for form in FORMS)}",
        code="format-unknown",
    )
    form, begins = found
    head, start = text[: begins.end()], text.count("\n", 0, begins.end())
    # LI-180 writes the unit behind each wavelength
    rows = [re.sub(r"^(\d+)nm\b", r"\1", line) for line in lines[start:]]
    at = first_row(rows)
    again = "copy the file again from the instrument"
    at = FormatError.raise_if_none(at, f"{path.name}: no table of numbers", mend=again, code="table-missing")
    first, dialect = at
    count = len(row_numbers(rows[first], dialect) or ())
    table: list[list[float]] = []
    for line_number, line in enumerate(rows[first:], start + first + 1):
        if form.ends is not None and form.ends.match(line) and table:
            break
        if not line.strip(" \t,;"):
            continue
        cells = row_numbers(line, dialect)
        FormatError.raise_if(
            cells is None or len(cells) != count,
            f"{path.name}: line {line_number} holds {line.strip()[:60]!r}",
            expected=f"{count} numbers",
            mend=again,
            code="row-unreadable",
        )
        table.append(cells or [])
    # headings, in one line or in two: names, then units
    separator = dialect[0] or None
    cells_of = [
        [cell.strip().strip('"') for cell in line.split(separator)] for line in rows[:first] if line.strip()
    ]
    lists = [cells for cells in cells_of if len(cells) == count][:2]
    headings = [" ".join(filter(None, cells)) for cells in zip(*lists, strict=True)] or [""] * count
    axis = next((i for i, heading in enumerate(headings) if _WAVELENGTH.match(heading)), 0)
    values = np.array(table, np.float64).T
    wavelength = values[axis]
    other_axis = _OTHER_AXIS.search(head)
    refuse(
        path.name,
        (
            other_axis,
            Problem(
                f"the first column is {other_axis and other_axis[1].strip()[:40]!r}",
                expected="wavelengths",
                mend="export it over wavelengths [nm]",
                code="units-unknown",
            ),
        ),
        (count > _MAX_COLUMNS, Problem(f"{count} columns", expected=f"{_MAX_COLUMNS}", code="file-damaged")),
        (len(table) < 2, Problem(f"{len(table)} rows", expected="a spectrum", code="table-missing")),
        (
            not (np.isfinite(wavelength).all() and wavelength[0] > 0 and (np.diff(wavelength) > 0).all()),
            Problem("the wavelengths do not increase", mend=again, code="wavelength-unordered"),
        ),
    )  # fmt: skip
    head_quantity = next((quantity for pattern, quantity in _HEAD if pattern.search(head)), form.quantity)
    unit_line = _UNITS.search(head)
    head_units = unit_line[1].strip() if unit_line is not None else ""
    columns = []
    for number, heading in enumerate(headings):
        quantity, scan = next((q, s) for pattern, q, s in _COLUMNS if pattern.search(heading))
        if number == axis or quantity is None:
            continue
        bracket = _IN_BRACKETS.search(heading if quantity else head if head_quantity == "reflectance" else "")
        units = bracket[1] if bracket is not None else "%" if "%" in heading else ""
        column = TextColumn(heading, quantity or head_quantity, scan, units, values[number])
        # a column without a heading has the quantity that the units of the head have
        if head_units and not (quantity or units):
            column = column._replace(units=head_units)
            for kind in ("radiance", "irradiance"):
                if same_dimension(head_units, VARIABLES[kind].units):
                    column = column._replace(quantity=kind)
        columns.append(column)
    # local time in the head, and local time minus UTC [h]; None where unknown or ambiguous
    match = re.search(form.stamp, head, re.MULTILINE)
    if match is None:
        local, offset = None, None
    else:
        parts: dict[str, Any] = {"fraction": None, "zone": None, "month": None} | match.groupdict()
        date = f"{parts['day']}-{parts['month']}-{parts['year']}" if parts["month"] else parts["date"]
        if form.dayfirst is None and not parts["month"]:
            # of an order that differs between versions: kept only where certain
            date = date.replace("-", "/")
        stamp = read_stamp(f"{date} {parts['clock'] if parts['month'] else parts['time']}")
        # the day comes first between dots
        local = None if stamp is None else stamp.read(None if "." in date else form.dayfirst)
        if local is not None and parts["fraction"]:
            local += dt.timedelta(seconds=float(parts["fraction"]))
        warn_if(
            local is None,
            f"{path.name}: {match[0].strip()!r} is no date, or one of two dates; its time is unknown",
            "time-unreadable",
        )
        offset = _ZONES.get(parts["zone"] or "")
    patterns = (_INTEGRATION, _AVERAGES, _GPS, _FORE_OPTIC)
    seconds, averages, fix, optic = (pattern.search(head) for pattern in patterns)
    gps = (
        (float(fix[1]), float(fix[2]), float(fix[3]), dt.time(int(fix[4]), int(fix[5]), int(fix[6])))
        if fix is not None and max(int(fix[5]), int(fix[6])) < 60 and int(fix[4]) < 24
        else None
    )
    window = None
    if seconds is not None:
        window = float(seconds[2].replace(",", ".")) * _SECONDS.get((seconds[1] or "").lower(), 1e-3)
        window *= max(int(averages[1]), 1) if averages is not None else 1
    units = head_units if head_units.lower() != "none" else ""
    return SpectrumText(
        path.name,
        form.instrument,
        wavelength,
        tuple(columns),
        units or form.units,
        local,
        offset,
        window,
        gps,
        optic[1].rpartition(",")[2].strip() if optic is not None else "",
    )
