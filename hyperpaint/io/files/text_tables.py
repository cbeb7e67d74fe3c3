"""Tables in text files: one header line, cells as text, line numbers kept for messages."""

import re
from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hyperpaint.base.errors import FormatError

from .reading import MAX_TEXT_LINES, PackedColumns, numbered_lines, read_limited_text

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
    data = read_limited_text(path, limit, "a text file", lines, mend)
    FormatError.raise_if(
        b"\0" in data,
        f"{path}: binary",
        expected="text",
        mend="export it: some systems write binary logs under the same name",
        code="text-unreadable",
    )
    # as bytes, one copy at a time: such files have a hundred megabytes
    data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n").removeprefix(b"\xef\xbb\xbf")
    return data.decode("latin-1")


@dataclass(frozen=True)
class Table:
    """A text table with one header line, and cells as text."""

    name: str  # File name, for messages
    rows: NDArray[np.int64]  # Line number in the file of each row, the header being line 1
    columns: Mapping[str, list[str]]  # Column name in lower case to cells


def read_table(path: str | Path, kind: str, *, needs: Sequence[str]) -> Table:
    # Read a tab-separated table by its header names.
    #
    # ``path``: the file; blank lines are skipped; ``kind``: kind of file, for messages; ``needs``:
    # columns, in lower case, without which it is another kind of file.
    #
    # Raises `FormatError`: Unreadable, binary, without its header line or a needed column, without rows, or
    # with rows of another number of cells than the header.
    path = Path(path)
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
        codes = np.frombuffer(block.encode("latin-1"), np.uint8)
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


def name_rows(rows: Sequence[int] | NDArray[np.int64], row: str = "line") -> str:
    # Return ``"line 7"`` or ``"lines 7, 9, 11 ... (40 in all)"`` for a message; ``row``: noun for a row.
    rows_text = ", ".join(str(int(number)) for number in rows[:5])
    if len(rows) == 1:
        return f"{row} {rows_text}"
    return f"{row}s {rows_text}" + (f" ... ({len(rows)} in all)" if len(rows) > 5 else "")


def to_integers(table: Table, name: str) -> NDArray[np.int64]:
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
