"""Small files read completely after a check of their size, and files by pattern with a bound on the work.

A pattern stays inside one folder, and ``**`` follows no links.

Tables in text files: one header line, cells as text, line numbers kept for messages. TOML files are tables
checked by their facts: all problems are noted, named files are not opened.
"""

import codecs
import contextlib
import csv
import difflib
import fnmatch
import hashlib
import itertools
import os
import re
import tomllib
from array import array
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base import (
    Facts,
    FormatError,
    Ints,
    PaintError,
    Problem,
    Problems,
    as_path,
    discover,
    fetch,
    head_of,
    input_path,
    is_plain_file,
    mirrored,
    open_data,
    origin_of,
    pieces_of,
    read_limited,
    shown,
    url_of,
)

# Longest text line [byte]: tables of spectra have about 12 bytes per cell.
MAX_LINE_BYTES = 2**20

# Largest netCDF file that is loaded, by the size of its variables [byte].
MAX_NETCDF_BYTES = 2**30


def refuse(
    subject: str, *checks: tuple[object, Problem | None], error: type[PaintError] = FormatError
) -> None:
    """Raise the problem of the first check whose condition is true, with the subject before its message.

    A check without a problem, such as that of `foreign_format` for other files, passes.

    Examples
    --------
    >>> refuse("red.sig", (False, Problem("2 rows")), (True, Problem("no rows", code="table-missing")))
    Traceback (most recent call last):
    hyperpaint.base.errors.FormatError: red.sig: no rows [table-missing]
    """
    for is_wrong, problem in checks:
        if is_wrong and problem is not None:
            expected, mend, code = problem.expected, problem.mend, problem.code
            raise error(f"{subject}: {problem.found}", expected=expected, mend=mend, code=code)


# Maximum number of lines of a text whose rows are bands, points or samples: ten times the longest spectra.
MAX_TEXT_LINES = 200_000


def read_limited_text(
    path: Path, limit: int, expected: str, lines: int = MAX_TEXT_LINES, mend: str = "check the file"
) -> bytes:
    # Return the bytes of a text file, like `read_limited`; number and length of lines are limited too.
    #
    # Callers split lines into cells, which take thirty times their bytes in memory; so do empty lines.
    #
    # Raises `FormatError`: As `read_limited`; there are more than ``lines``; or a line is longer than
    # `MAX_LINE_BYTES`.
    data = read_limited(path, limit, expected)
    count = max(data.count(b"\n"), data.count(b"\r"))
    FormatError.raise_if(
        count > lines,
        f"{path}: {count} lines",
        expected=f"{expected} of at most {lines}",
        mend=mend,
        code="file-too-large",
    )
    start = 0
    while len(data) - start > MAX_LINE_BYTES:
        end = max(data.rfind(mark, start, start + MAX_LINE_BYTES + 1) for mark in (b"\n", b"\r"))
        FormatError.raise_if(
            end < 0,
            f"{path}: a line of over {MAX_LINE_BYTES} bytes",
            expected=f"{expected}, lines of at most that",
            code="line-too-long",
        )
        start = end + 1
    return data


def numbered_lines(text: str) -> Iterator[tuple[int, str]]:
    r"""Yield numbered lines of a text, one at a time: a list takes many times the memory of the text.

    Examples
    --------
    >>> list(numbered_lines("a\nb"))
    [(1, 'a'), (2, 'b')]
    """
    start = 0
    for number in itertools.count(1):
        end = text.find("\n", start)
        yield number, text[start:] if end < 0 else text[start:end]
        if end < 0:
            return
        start = end + 1


class PackedColumns(Mapping[str, list[str]]):
    # Cells by column, stored as a few long texts per column: single cells take several times the memory.
    def __init__(self, names: Sequence[str]) -> None:
        self._column_numbers = {name: column for column, name in enumerate(names)}
        self._packed: list[list[str]] = [[] for _ in names]

    def extend(self, columns: Iterable[Sequence[str]]) -> None:
        # Add the same number of cells to every column; cells must not contain line ends.
        for packed, cells in zip(self._packed, columns, strict=False):
            packed.append("\n".join(cells))

    def __getitem__(self, name: str) -> list[str]:
        return [cell for packed in self._packed[self._column_numbers[name]] for cell in packed.split("\n")]

    def __iter__(self) -> Iterator[str]:
        return iter(self._column_numbers)

    def __len__(self) -> int:
        return len(self._column_numbers)


_UTF_16_MARKS = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
#: First line by which spreadsheets state the separator; its line end stays, for the numbers of lines.
_SEPARATOR_LINE = re.compile(r"\"?sep=[^\r\n]{0,9}(?=[\r\n])", re.IGNORECASE)
#: Cells without a value, as R, pandas and spreadsheets write them, in lower case.
MISSING_WORDS = frozenset(("na", "n/a", "#n/a", "#nv", "nan", "null", "none"))


def decoded_text(data: bytes) -> str:
    """Return the bytes of a file as text: UTF-8 or, by its byte order mark, UTF-16, else latin-1.

    A first line ``sep=;`` becomes empty.

    Examples
    --------
    >>> [decoded_text("µm".encode(encoding)) for encoding in ("utf-8-sig", "latin-1", "utf-16")]
    ['µm', 'µm', 'µm']
    """
    try:
        text = data.decode("utf-16" if data.startswith(_UTF_16_MARKS) else "utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("latin-1").replace("\x85", "\u2026")  # in cp1252 no line end
    return text[line.end() :] if (line := _SEPARATOR_LINE.match(text)) else text


def cells_of(line: str, separator: str | None) -> list[str]:
    """Return the cells of a line without the quotes around them; none where the quotes cannot be read.

    separator: Between the cells; None or empty for blanks.

    Examples
    --------
    >>> cells_of("400, 0.2", ","), cells_of('"red; matt";0,2', ";"), cells_of('"red, matt"  0.2', None)
    (['400', ' 0.2'], ['red; matt', '0,2'], ['red, matt', '0.2'])
    """
    if '"' not in line:  # ten times as fast as the csv module
        return line.split(separator or None)
    text = line if separator else " ".join(line.split())
    try:
        return next(csv.reader([text], delimiter=separator or " ", skipinitialspace=True), [])
    except csv.Error:  # a cell of more than 128 kB
        return []


def number(text: str) -> float | None:
    # Return a number, NaN for an empty cell, None for other text.
    #
    # Unlike float(), it accepts no underscores, no digits of other scripts, and no infinities.
    text = text.strip()
    if not text:
        return float("nan")
    if len(text) > 64 or not text.isascii() or "_" in text:
        return None
    try:
        value = float(text)
    except ValueError:
        return None
    return None if value in (float("inf"), float("-inf")) else value


def numbers(cells: Iterable[str]) -> list[float] | None:
    # Return cells as numbers (`number`); None if a cell is other text.
    values = [number(cell) for cell in cells]
    return None if None in values else [value for value in values if value is not None]


#: Formats that are recognised and not read here: first bytes, name, and the way out.
_FOREIGN = tuple(
    (re.compile(pattern, re.IGNORECASE | re.DOTALL), name, mend)
    for pattern, name, mend in (
        (rb"\x89HDF\r\n|CDF[\x01\x02\x05]", "a netCDF or HDF5 file",
         "open it with xr.open_dataset, name its wavelengths by a coordinate 'wavelength' with units, pass "
         "the Dataset"),
        (rb"PK\x03\x04.{0,4000}(?:OOI|ps_\d|procspec)", "a ProcSpec file of Ocean Optics",
         "save it as text (tab delimited, with header) with its software"),
        (rb"PK\x03\x04|\xd0\xcf\x11\xe0", "an Excel sheet or another archive", "save the sheet as CSV"),
        (rb"\x1f\x8b\x08|BZh\d|\xfd7zXZ|7z\xbc\xaf|\x28\xb5\x2f\xfd", "a compressed file", "unpack it"),
        (rb"%PDF", "a PDF", "type or copy its table into a text: wavelength and value a line"),
        (rb"AVS8[24]", "a binary file of AvaSoft 8", "export it as text with AvaSoft"),
        (rb"///GER", "a GER file", "SVC's software converts it to .sig"),
        (rb"MATLAB [57]", "a MATLAB file", "load it with scipy.io.loadmat, and pass arrays as xarray"),
        (rb"##(?:TITLE|JCAMP)", "a JCAMP-DX file", "export two columns of wavelength and value"),
        (rb"II\*\x00|MM\x00\*|\x89PNG|\xff\xd8\xff", "a picture or GeoTIFF", "open it with rasterio"),
        (rb"PAR1", "a Parquet file", "open it with hp.open_library"),
        (rb"SIMPLE  =", "a FITS file", "open it with astropy, and pass arrays as xarray"),
        (rb"(?:asd|as[2-8])[^\n]{0,400}\x00", "an ASD file", "open it with hp.open_asd"),
        (rb"ENVI\b", "an ENVI header", "open it with hp.open_flightline or hp.open_library"),
        (rb"Irradiance\s*\[", "a series of PSI SpectraPen, one column a time", "write a row for each "
         "time, below 'time' and the wavelengths [nm]"),
        (rb"(?:<\?xml.{0,400}?)?<kml", "a KML file", "convert it to GeoJSON, as with ogr2ogr or QGIS"),
        (rb"; *ENVI Output of ROIs|(?:<\?xml.{0,400}?)?<RegionsOfInterest", "regions of interest of ENVI",
         "export them as a shapefile, and convert it to GeoJSON"),
        (rb"ENLIGHTEN|Wasatch", "a file of Wasatch ENLIGHTEN", "export two columns: wavelength and value"),
    )
)  # fmt: skip


def foreign_format(path: str | os.PathLike[str], *, is_binary: bool = False) -> Problem | None:
    # Return the problem of a file in a recognised format that the caller does not read, with the way out;
    # None for other files. ``is_binary``: whether the caller reads binary files without a mark.
    head = head_of(path, 8192).removeprefix(b"\xef\xbb\xbf").lstrip(b" \t\r\n")
    for pattern, name, mend in _FOREIGN:
        if pattern.match(head):
            return Problem(name, mend=mend, code="format-unknown")
    if not is_binary and b"\0" in head and not head.startswith(_UTF_16_MARKS):
        mend = "export it as text or CSV with the program that wrote it"
        return Problem(f"a binary file that begins with {head[:8]!r}", mend=mend, code="format-unknown")
    return None


#: Separators and decimal marks of tables, by preference; "" for blanks, True for decimal commas.
TABLE_DIALECTS = (
    ("\t", False), (";", False), (",", False), ("", False), ("\t", True), (";", True), ("", True)
)  # fmt: skip


def row_numbers(line: str, dialect: tuple[str, bool]) -> list[float] | None:
    # Return the numbers of a line; None for other lines, and for an empty first cell.
    separator, has_commas = dialect
    first, *others = cells_of(line.strip(" "), separator) or [""]
    texts = [first, *("" if cell.strip().lower() in MISSING_WORDS else cell for cell in others)]
    return (
        numbers(cell.replace(",", ".") if has_commas else cell for cell in texts)
        if first.strip() and others
        else None
    )


def first_row(lines: Sequence[str], limit: int = 500) -> tuple[int, tuple[str, bool]] | None:
    """Return the index of the first row of numbers, and the dialect of the table; None without a row.

    The dialect is that in which the next line has as many columns, or else the first that can be read.
    ``limit``: number of lines with text that may stand above.

    Examples
    --------
    >>> first_row(["nm;R", "", "400,0;0,98", "500,0;0,97"])
    (2, (';', True))
    """
    text_lines = [at for at, line in enumerate(lines) if line.strip()]
    for first, following in itertools.pairwise(text_lines[: limit + 1]):
        rows = {d: row for d in TABLE_DIALECTS if (row := row_numbers(lines[first], d)) is not None}
        fitting = (d for d, row in rows.items() if len(row_numbers(lines[following], d) or ()) == len(row))
        if rows:
            return first, next(fitting, next(iter(rows)))
    return None


def unique_names(
    names: Iterable[str],
    taken: Collection[str] = (),
    *,
    suffix: str = " ({})",
    fold: Callable[[str], str] = str,
) -> list[str]:
    """Return the names; repeated names get a number from 2 on.

    taken: names already in use; suffix: format of the number; fold: maps equivalent names to the same text.

    Examples
    --------
    >>> unique_names(["red", "Red", "blue"], ["blue"], suffix="_{}", fold=str.lower)
    ['red', 'Red_2', 'blue_2']
    """
    folded_names = set(map(fold, taken))
    last_numbers: dict[str, int] = {}
    unique: list[str] = []
    for name in names:
        candidate = name
        while fold(candidate) in folded_names:
            last_numbers[fold(name)] = last_numbers.get(fold(name), 1) + 1
            candidate = name + suffix.format(last_numbers[fold(name)])
        folded_names.add(fold(candidate))
        unique.append(candidate)
    return unique


def load_netcdf(path: Path, group: str | None = None) -> xr.Dataset:
    # Load a small netCDF file completely.
    #
    # Raises `FormatError`: It declares more than `MAX_NETCDF_BYTES`, or is not a plain file. A damaged file
    # raises the engine's error.
    path = input_path(path, "a netCDF file")
    FormatError.raise_if(
        not is_plain_file(path),
        f"{path}: no plain file",
        expected="a netCDF file",
        mend="check the path",
        code="file-not-plain",
    )
    with xr.open_dataset(os.fspath(path), group=group) as dataset:
        FormatError.raise_if(
            dataset.nbytes > MAX_NETCDF_BYTES,
            f"{path} declares {dataset.nbytes} bytes",
            expected=f"at most {MAX_NETCDF_BYTES}",
            code="file-too-large",
        )
        return dataset.load()


#: Maximum number of folders and files examined for a pattern.
MAX_ENTRIES = 100_000
MAX_PATTERN_CHARS = 1000
_MAGIC = re.compile(r"[*?\[]")


def is_pattern(text: str) -> bool:
    # Return whether a text contains wildcards.
    return _MAGIC.search(text) is not None


def matching_files(folder: Path, pattern: str, most: int = MAX_ENTRIES) -> list[Path]:
    """Return the files and folders that match a pattern, sorted.

    Like `glob.glob`, but without leaving the folder or following links in circles: at most
    ``most`` entries are examined. Between the slashes of a pattern are names with ``*``, ``?`` and
    ``[...]``; ``**`` matches any folders, without links. Wildcards do not match a leading dot.

    Raises `ValueError`: The pattern leads out of the folder, is too long, or matches too much; with the
    reason.

    Examples
    --------
    >>> matching_files(Path("."), "/etc/*")
    Traceback (most recent call last):
    ValueError: expected a pattern inside the folder of the file
    """
    if len(pattern) > MAX_PATTERN_CHARS or "\0" in pattern:
        raise ValueError(f"expected a pattern of at most {MAX_PATTERN_CHARS} characters")
    parts = [part for part in pattern.replace(os.sep, "/").split("/") if part != "."]
    if os.path.isabs(pattern) or os.path.splitdrive(pattern)[0] or ".." in parts:
        raise ValueError("expected a pattern inside the folder of the file")
    remaining = most

    def count_entries(number: int) -> None:
        nonlocal remaining
        remaining -= number
        if remaining < 0:
            raise ValueError(f"more than {most} files and folders to look at; name their folder")

    def entries(folder_path: str) -> list[os.DirEntry[str]]:
        count_entries(1)
        discover(folder_path)
        found: list[os.DirEntry[str]] = []
        # not a folder, or not readable: nothing in it matches
        with contextlib.suppress(OSError), os.scandir(folder_path) as listed:
            for entry in listed:
                count_entries(1)
                found.append(entry)
        return found

    def matches(base: str, part: str) -> Iterator[str]:
        if part == "**":
            pending = [base]
            while pending:
                yield (folder_path := pending.pop())
                visible = (entry for entry in entries(folder_path) if not entry.name.startswith("."))
                pending += [entry.path for entry in visible if entry.is_dir(follow_symlinks=False)]
        elif is_pattern(part):
            names = fnmatch.filter((entry.name for entry in entries(base)), part)
            yield from (os.path.join(base, n) for n in names if part.startswith(".") or not n.startswith("."))
        else:
            count_entries(1)
            if os.path.lexists(path := os.path.join(base, part)):
                yield path

    paths = [str(folder)]
    for part in filter(None, parts):
        paths = list(dict.fromkeys(path for base in paths for path in matches(base, part)))
    return sorted(Path(path) for path in paths)


# --- cells of tables that spreadsheets open --------------------------------------------------------------


#: Includes full-width signs, which spreadsheets treat like ASCII ones, and leading blanks, which they skip.
_FORMULA = re.compile("'*(?:[\\t\\r]|\\s*[=+\\-@\uff1d\uff0b\uff0d\uff20])")


def safe_cell(text: str) -> str:
    """Return a text for a table, with an apostrophe before formulas; numbers are unchanged.

    Examples
    --------
    >>> safe_cell("=cmd()"), safe_cell("-5.2"), safe_cell("- matt"), safe_cell("red")
    ("'=cmd()", '-5.2', "'- matt", 'red')
    """
    return text if (_FORMULA.match(text) is None or number(text) is not None) else f"'{text}"


def text_of_cell(cell: str) -> str:
    """Return the original text of a cell made by `safe_cell`.

    Examples
    --------
    >>> text_of_cell("'=cmd()"), text_of_cell("'red'"), text_of_cell(safe_cell("'=cmd()"))
    ('=cmd()', "'red'", "'=cmd()")
    """
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell) else cell


# --- digest of a cube ------------------------------------------------------------------------------------


# Number of blocks read from a large file; 4 MiB in all, some milliseconds.
SAMPLES = 256

SAMPLE_BYTES = 16 * 1024


def digest_of_file(path: Path, method: str = "sha256") -> str:
    # Return the digest of the content of a file, by the name of a method of hashlib.
    with path.open("rb") as file:
        return hashlib.file_digest(file, method).hexdigest()


def sampled_digest(path: Path) -> str:
    """Return a digest of a file's size and of blocks spread evenly over it, first and last block included.

    Files of up to `SAMPLES` blocks are read completely. In larger files rewritten content is detected, but a
    change of a few bytes may be missed: `hyperpaint verify --inputs` reads all bytes. Name and time are
    ignored: a copy has the same digest.

    Examples
    --------
    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> for name in ("cube", "copy"):
    ...     _ = (folder / name).write_bytes(bytes(1000))
    >>> sampled_digest(folder / "cube") == sampled_digest(folder / "copy")
    True
    """
    unreadable = FormatError.instead_of(OSError, f"{path}: $error", code="file-unreadable")
    with unreadable, open_data(input_path(path, "a cube", content=False)) as (file, size, _):
        digest = hashlib.sha256(f"{size} ".encode())
        if size <= SAMPLES * SAMPLE_BYTES:
            digest.update(file.read(SAMPLES * SAMPLE_BYTES))
        else:
            starts = [(size - SAMPLE_BYTES) * block // (SAMPLES - 1) for block in range(SAMPLES)]
            digest.update(b"".join(pieces_of(file, starts, SAMPLE_BYTES)))
    return digest.hexdigest()[:32]


# --- tables ------------------------------------------------------------------------------------------------

_MAX_SETTINGS = 16 << 20
_MAX_TABLE = 1 << 28
# Maximum rows of a record or index: 3 h 58 min of a camera at 140 Hz, 2 h 46 min of an inertial system at 200
# Hz. A row takes 170 bytes of memory (frame index) to 240 (record of nine columns), half a gigabyte in all.
MAX_TABLE_ROWS = 2_000_000


_BLOCK = 4096
_BLOCK_CHARACTERS = 1 << 18
_TAB, _LINE_END = 9, 10
_INTEGER = re.compile(r"[+-]?[0-9]{1,16}(?:\.0*)?")


def read_text(path: Path, limit: int = _MAX_SETTINGS, lines: int = MAX_TEXT_LINES) -> str:
    # Return the text of a side file, with Unix line ends.
    #
    # Raises `FormatError`: The file cannot be read, is larger than ``limit`` bytes, has more than ``lines``,
    # or is binary.
    mend = "cut it to the flight, or give an SBET file" if lines == MAX_TABLE_ROWS else "check the file"
    # one copy at a time: such files have a hundred megabytes
    text = decoded_text(read_limited_text(path, limit, "a text file", lines, mend))
    FormatError.raise_if(
        "\0" in text,
        f"{path}: binary",
        expected="text",
        mend="export it as text: some systems write binary logs under the same name",
        code="text-unreadable",
    )
    return text.replace("\r\n", "\n").replace("\r", "\n")


@dataclass(frozen=True)
class Table:
    # A text table with one header line, and cells as text.
    name: str  # File name, for messages
    rows: Ints  # Line number in the file of each row, the header being line 1
    columns: Mapping[str, list[str]]  # Column name in lower case to cells


def read_table(path: str | Path, kind: str, *, needs: Sequence[str]) -> Table:
    # Read a tab-separated table by its header names.
    #
    # ``path``: the file; blank lines are skipped; ``kind``: kind of file, for messages; ``needs``:
    # columns, in lower case, without which it is another kind of file.
    #
    # Raises `FormatError`: Unreadable, binary, without its header line or a needed column, without rows, or
    # with rows of another number of cells than the header.
    path = as_path(path)
    text = read_text(path, _MAX_TABLE, MAX_TABLE_ROWS)
    first = text.partition("\n")[0]
    # an older program separates the two columns of a frame index with blanks
    separator = "\t" if "\t" in first else None
    names = [cell.strip().lower() for cell in first.rstrip("\t").split(separator)]
    FormatError.raise_if(
        not set(needs) <= set(names) or len(set(names)) != len(names),
        f"{path}: first line {first[:120]!r}",
        expected=f"the header of a {kind}, which names {list(needs)} once",
        code="header-wrong",
    )

    if separator:
        table = _regular_table(path.name, names, text)
        if table is not None:
            return table

    def rows() -> Iterator[tuple[int, list[str]]]:
        for number, line in numbered_lines(text):
            if number > 1 and line.strip():
                row = line.split(separator, -1 if separator else len(names) - 1)
                while len(row) > len(names) and not row[-1].strip():
                    row.pop()  # a tab at the end of the line
                yield number, row

    return table_of(path, names, rows())


def _regular_table(name: str, names: Sequence[str], text: str) -> Table | None:
    # Return a table whose lines all have as many tabs as its header; None for blank lines or other counts.
    # It takes a third of the time of reading line by line.
    start, end = text.find("\n") + 1, len(text) - text.endswith("\n")
    columns, rows = PackedColumns(names), 0
    if not 0 < start < end:
        return None
    while start < end:
        stop = text.find("\n", min(start + _BLOCK_CHARACTERS, end), end)
        stop = end if stop < 0 else stop
        block = text[start:stop]
        codes = np.frombuffer(block.encode("latin-1", "replace"), np.uint8)
        separators = np.append(codes[(codes == _TAB) | (codes == _LINE_END)], np.uint8(_LINE_END))
        cells = block.replace("\n", "\t").split("\t")
        if separators.size % len(names) or not all(map(str.strip, cells[:: len(names)])):
            return None
        separators_by_line = separators.reshape(-1, len(names))
        if (separators_by_line[:, :-1] != _TAB).any() or (separators_by_line[:, -1] != _LINE_END).any():
            return None
        columns.extend([cells[column :: len(names)] for column in range(len(names))])
        rows, start = rows + len(separators_by_line), stop + 1
    return Table(name, np.arange(2, rows + 2), columns)


def table_of(path: Path, names: Sequence[str], rows: Iterable[tuple[int, list[str]]]) -> Table:
    # Return cells under the names of their columns.
    #
    # ``rows``: line number and cells of each row.
    #
    # Raises `FormatError`: There are no rows, or some have another number of cells than there are names.
    numbers, wrong_rows = array("q"), array("q")
    columns = PackedColumns(names)
    block: list[list[str]] = []
    for number, cells in rows:
        if len(cells) != len(names):
            wrong_rows.append(number)
            continue
        numbers.append(number)
        block.append(cells)
        if len(block) == _BLOCK:
            columns.extend(zip(*block, strict=True))
            block.clear()
    columns.extend(zip(*block, strict=True))
    FormatError.raise_if(
        wrong_rows,
        f"{path}: {name_rows(wrong_rows)} without {len(names)} cells",
        mend="correct or delete them",
        code="length-mismatch",
    )
    FormatError.raise_if(not numbers, f"{path}: no rows of {', '.join(names)[:80]}", code="empty-input")
    return Table(path.name, np.array(numbers, np.int64), columns)


def name_rows(rows: Sequence[int] | Ints, row: str = "line") -> str:
    # Return ``"line 7"`` or ``"lines 7, 9, 11 ... (40 in all)"`` for a message; ``row``: noun for a row.
    rows_text = ", ".join(str(int(number)) for number in rows[:5])
    if len(rows) == 1:
        return f"{row} {rows_text}"
    return f"{row}s {rows_text}" + (f" ... ({len(rows)} in all)" if len(rows) > 5 else "")


def to_integers(table: Table, name: str) -> Ints:
    # Return a column of whole numbers.
    #
    # Raises `FormatError`: Cells are not whole numbers; their lines are named.
    cells = [cell.strip() for cell in table.columns[name]]
    # the common case at a tenth of the time: digits only, none empty, none too long for int64
    if "".join(cells).isdecimal() and min(map(len, cells)) > 0 and max(map(len, cells)) <= 16:
        return np.array(list(map(int, cells)), np.int64)
    wrong_rows = [
        int(row) for row, cell in zip(table.rows, cells, strict=True) if not _INTEGER.fullmatch(cell)
    ]
    FormatError.raise_if(
        wrong_rows,
        f"{table.name}: column {name!r} is not a whole number in {name_rows(wrong_rows)}",
        code="number-unreadable",
    )
    return np.array([int(cell.partition(".")[0]) for cell in cells], np.int64)


#: Placeholder of a value that the user has to fill in.
UNKNOWN = "?"

_MAX_BYTES = 1 << 20
#: A key of 64 parts or more: the time of tomllib grows with the square of the number of parts.
_LONG_KEY = re.compile(rb"""(?:\.[ \t]*(?:[A-Za-z0-9_-]+|"[^"\n]{0,99}"|'[^'\n]{0,99}')[ \t]*){64}""")


def load_tables(path: Path, kind: str) -> dict[str, Any]:
    # Return the tables of a file; ``kind`` names the kind of file in messages.
    #
    # Raises `FormatError`: The file cannot be read, is too large, or is not TOML (with the place of the
    # mistake).
    raw = read_limited(path, _MAX_BYTES, kind)
    FormatError.raise_if(
        _LONG_KEY.search(raw),
        f"{path}: a key of more than 64 parts",
        expected=f"the keys of {kind}",
        code="key-too-long",
    )
    # TOMLDecodeError and UnicodeDecodeError are ValueErrors
    with FormatError.instead_of(
        (ValueError, RecursionError), f"{path}: not TOML: $error", code="toml-unreadable"
    ):
        return tomllib.loads(raw.decode("utf-8"))


def suggestion(key: str, allowed: Iterable[str]) -> str:
    # Return the mend for an unknown key: the nearest key, or all of them.
    allowed = list(allowed)
    close = difflib.get_close_matches(key[:100], allowed, n=1)
    return f"did you mean {close[0]!r}?" if close else f"known are {', '.join(allowed)}"


class TableReader:
    # Reads checked values from the tables of a file, and notes every problem.
    #
    # ``path``: the file; paths in it are relative to its folder; ``raw``: its tables; ``schema``: facts of
    # every key of every table; ``lists``: tables that may occur several times; ``problems``: receives the
    # faults.
    #
    # Attribute ``tables``: the valid keys of every table of the schema. In each, ``"?"`` is the set of keys
    # in the file, with wrong values too. ``given``: names of the tables in the file.
    #: Keys of files that are read by ranges of bytes, and not copied from URLs.
    by_ranges: Collection[str] = ()

    def __init__(
        self,
        path: Path,
        raw: Mapping[str, Any],
        schema: Mapping[str, Facts],
        lists: Collection[str],
        problems: Problems,
    ) -> None:
        self.folder = path.parent
        self.problems = problems
        self.schema = schema
        self.lists = lists
        self.given = set(raw)
        self.tables = {name: self.section(name, raw.get(name)) for name in schema}
        for key in raw:
            if key not in schema:
                problems.add(
                    f"unknown table or key {key!r}", mend=suggestion(key, schema), code="key-unknown"
                )

    def section(self, name: str, value: Any, extra: str = "") -> list[dict[str, Any]]:
        # Return the valid keys of the tables of this name; ``extra`` names another accepted value.
        if value is None:
            return []
        is_list = name in self.lists
        tables = value if isinstance(value, list) else [value]
        if isinstance(value, list) != is_list or not all(isinstance(table, dict) for table in tables):
            shape = f"[[{name}]]" if is_list else f"[{name}]"
            mend = f"write one table for each {name}" if is_list else "write it once"
            self.problems.add(
                f"{name!r} is {shown(value)}", expected=f"{shape}{extra}", mend=mend, code="table-shape"
            )
            return []
        return [self._checked(self.place(name, number), name, table) for number, table in enumerate(tables)]

    def place(self, name: str, number: int) -> str:
        # Return the name of a table in messages.
        return f"[[{name}]] {number + 1}" if name in self.lists else f"[{name}]"

    def _checked(self, table_place: str, name: str, table: Mapping[str, Any]) -> dict[str, Any]:
        valid: dict[str, Any] = {}
        facts = self.schema[name]
        for key, value in table.items():
            if key not in facts:
                self.problems.add(
                    f"{table_place} unknown key {key!r}", mend=suggestion(key, facts), code="key-unknown"
                )
            elif value == UNKNOWN:
                self.problems.add(
                    f"{table_place} {key} is still {UNKNOWN!r}",
                    mend=f"fill in {facts[key].expected}",
                    code="value-unfilled",
                )
            elif facts[key].note(
                self.problems, f"{table_place} {key} = {shown(value)}", value, facts[key].mend
            ):
                valid[key] = value
        valid["?"] = set(table)
        return valid

    def one(self, name: str) -> dict[str, Any]:
        # Return the single table of this name, empty where absent.
        return next(iter(self.tables[name]), {"?": set()})

    def exclude(self, place: str, table: Mapping[str, Any], *keys: str) -> None:
        # Note keys of a table that exclude each other.
        present = [key for key in keys if key in table["?"]]
        self.problems.add_if(
            len(present) > 1, f"{place} has {' and '.join(present)}", mend="keep one", code="option-conflict"
        )

    def is_name(self, place: str, key: str, name: str, blanks: str = "") -> bool:
        # Return whether a group of the store can have this name; otherwise note the fault.
        if _NAME.fullmatch(name) and name not in _ZARR_NAMES:
            return True
        self.problems.add(
            f"{place} {key} = {shown(name)}",
            expected=f"letters, digits, {blanks}'.', '_' and '-'; not zarr.json or c, names of Zarr's own",
            mend="choose a name that can name a group of the store",
            code="name-invalid",
        )
        return False

    def path(self, place: str, key: str, value: str | None) -> Path | None:
        # Return a path that exists, taken from the folder of the file; a Zarr store behind a URL is a URL.
        if value is None:
            return None
        path = self._place(value)
        if path is None or not os.path.lexists(path):
            self.problems.add(
                f"{place} {key} = {value!r}: no such file ({path})", mend=_RELATIVE, code="file-not-found"
            )
            return None
        if _is_special(path):
            self._note_special(f"{place} {key} = {value!r}")
            return None
        if (path / "zarr.json").is_file():
            return as_path(origin_of(path))
        self._fetch(key, [path])
        return path

    def _fetch(self, key: str, paths: Iterable[Path]) -> None:
        if key not in self.by_ranges:
            fetch(paths)

    def _place(self, text: str) -> Path | None:
        # None for a name that cannot exist, and for a file of this machine in a file behind a URL.
        if "\0" in text:
            return None
        url, is_remote = url_of(text), origin_of(self.folder) != os.fspath(self.folder)
        path = self.folder / text if url is None else mirrored(url)
        if url is None and is_remote:
            path = Path(os.path.normpath(path))
        discover(path)
        return None if is_remote and origin_of(path) == os.fspath(path) else path

    def files(self, place: str, key: str, value: str | list[str]) -> tuple[Path, ...]:
        # Return the files of paths and patterns, sorted by pattern; note patterns without a match.
        paths: list[Path] = []
        for text in value if isinstance(value, list) else [value]:
            if "\0" in text or not is_pattern(text) or os.path.lexists(self.folder / text):
                if (path := self.path(place, key, text)) is not None:
                    paths.append(path)
                continue
            # the folders before the first wildcard, such as ``../asd``, may leave the folder, as paths may
            parts = Path(text).parts
            folders = list(itertools.takewhile(lambda part: not is_pattern(part), parts))
            base, pattern = str(Path(*folders)), "/".join(parts[len(folders) :])
            folder = self._place(base)
            try:
                matches = [] if folder is None else matching_files(folder, pattern)
            except ValueError as error:
                self.problems.add(
                    f"{place} {key} = {shown(text)}: {error}",
                    mend="name the files, or their folder",
                    code="pattern-invalid",
                )
                continue
            for match in filter(_is_special, matches):  # reported, since a missing match would not be noticed
                self._note_special(f"{place} {key} = {text!r}: {match}")
            paths += matches
            self.problems.add_if(
                not matches,
                f"{place} {key} = {text!r} matches no file in {folder or base}",
                mend=_RELATIVE,
                code="file-not-found",
            )
        self._fetch(key, paths)
        return tuple(dict.fromkeys(paths))

    def _note_special(self, found: str) -> None:
        self.problems.add(
            f"{found} is a pipe or device",
            expected="a file or folder",
            mend="copy it into a file",
            code="file-special",
        )


_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
_ZARR_NAMES = {"zarr.json", "c"}
_RELATIVE = "paths count from the folder of this file"


def values(table: Mapping[str, Any]) -> dict[str, Any]:
    # Return the valid keys of a table of `TableReader`.
    return {key: value for key, value in table.items() if key != "?"}


def _is_special(path: Path) -> bool:
    # Return whether a path names a pipe or device: reading it would block or never end.
    return os.path.exists(path) and not (os.path.isfile(path) or os.path.isdir(path))
