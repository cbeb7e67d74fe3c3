"""A flight line during recording: its complete lines, and the line as if it ended with them.

Nothing that grows is opened by its reader: that would refuse a file that changes under it. Complete rows of
frame index and navigation are copied beside a header that counts so many lines, with a data file that is all
hole; the readers open these, and the counts are read from the cube itself.
"""

from __future__ import annotations

import bisect
import os
import re
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hyperpaint.base.errors import FormatError
from hyperpaint.base.input_files import open_input
from hyperpaint.io.envi.envi_cubes import DATA_SUFFIXES, find_pair
from hyperpaint.io.envi.envi_header import EnviHeader, read_header
from hyperpaint.io.files.reading import is_pattern

from .flightline_opening import FlightlineInputs
from .headwall import cube_number
from .timing import Timing

_LINES = re.compile(r"^[ \t]*lines[ \t]*=.*$", re.IGNORECASE | re.MULTILINE)
#: Axes of a line in the file, slowest first, as (line, band, column).
_AXES = {"bil": (0, 1, 2), "bip": (0, 2, 1)}


def growing_cubes(folder: Path, text: str) -> list[Path]:
    """Return the data files named by a ``cube`` of a collect, in order, with or without a header.

    ``text``: a file of the pair, a pattern, or a folder.
    """
    place = folder / text
    if place.is_dir():
        candidates = [*place.glob("*.hdr"), *place.glob("raw_*")]
    elif is_pattern(text):
        root, pattern = (
            (Path(place.anchor), place.relative_to(place.anchor)) if place.anchor else (Path(), place)
        )
        candidates = [*root.glob(str(pattern)), *root.glob(re.sub(r"(?i)\.hdr$", "", str(pattern)))]
    else:
        candidates = [place]
    files = dict.fromkeys(filter(None, map(_data_of, candidates)))
    return sorted(files, key=lambda path: (path.parent, cube_number(path) or 0, path.name))


def _data_of(path: Path) -> Path | None:
    if path.suffix.lower() != ".hdr":
        is_data = not path.suffix or path.suffix.lower() in DATA_SUFFIXES
        return path if is_data and path.is_file() else None
    whole = path.with_suffix("")
    return next(
        (candidate for s in ("", *DATA_SUFFIXES) if (candidate := Path(f"{whole}{s}")).is_file()), None
    )


class GrowingTable:
    """Complete rows of a text file that is appended to."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.head = b""
        self.rows: list[bytes] = []
        self._read = 0

    def grow(self) -> int:
        """Read appended rows; return the number of all rows."""
        try:
            with open_input(self.path, "a table") as file:
                file.seek(self._read)
                text = file.read()
        except FormatError:  # not there yet
            return 0
        whole = text[: text.rfind(b"\n") + 1]
        self._read += len(whole)
        rows = whole.splitlines(keepends=True)
        if rows and not self.head:
            self.head = rows.pop(0)
        self.rows += filter(bytes.strip, rows)
        return len(self.rows)

    def write(self, path: Path, first: int, stop: int | None = None) -> None:
        path.write_bytes(self.head + b"".join(self.rows[first:stop]))


class GrowingLine:
    """One flight line during recording, in one cube or in several successive ones.

    ``view`` is a folder for the files of the line as if it had ended.
    """

    def __init__(self, view: Path) -> None:
        self._view = view
        self._inputs: FlightlineInputs | None = None
        self._cubes: list[Path] = []
        self._starts = [0]
        self._header: EnviHeader | None = None
        self._header_text = ""
        self._indexes: dict[Path, GrowingTable] = {}
        self._timing = Timing()
        self._navigation: GrowingTable | None = None

    @property
    def poses(self) -> int:
        """Number of complete rows of the navigation."""
        return 0 if self._navigation is None else len(self._navigation.rows)

    @property
    def planned(self) -> int:
        """Number of lines in the header; 0 where it has none, or where another cube may follow."""
        header = self._own_header() if len(self._cubes) == 1 else None
        return 0 if header is None else read_header(header).lines if _counts_lines(header) else 0

    @property
    def header(self) -> EnviHeader:
        """Layout of the samples of the cubes."""
        if self._header is None:
            # header of a dark cube of this camera, until the line has a header
            dark = None if self._inputs is None else self._inputs.dark
            source = self._own_header() or (find_pair(dark[0])[0] if isinstance(dark, tuple) else None)
            if source is None:
                raise FormatError(
                    f"{self._cubes[0]}: no header yet, and no dark cube with one", code="header-missing"
                )
            with open_input(source, "an ENVI header") as file:
                text = file.read(4 * 2**20).decode("utf-8", "replace")
            self._header_text = _LINES.sub("", text)
            self._view.mkdir(parents=True, exist_ok=True)
            path = self._view / "layout.hdr"
            path.write_text(f"{self._header_text}\nlines = 1\n", encoding="utf-8")
            header = read_header(path)
            if header.interleave not in _AXES or header.dtype.kind != "u":
                raise FormatError(
                    f"{source}: {header.interleave} of {header.dtype}",
                    expected="unsigned raw counts stored line by line (bil or bip)",
                    code="type-wrong",
                )
            self._header = header
        return self._header

    def _own_header(self) -> Path | None:
        first = self._cubes[0]
        names = (Path(f"{first}.hdr"), first.with_suffix(".hdr"))
        return next((path for path in names if path.is_file()), None)

    def look(self, cubes: Sequence[Path], inputs: FlightlineInputs) -> int:
        """Return the number of lines that are complete in ``cubes``, and in the frame index if there is one.

        ``inputs``: of the line, as far as they are there.
        """
        self._cubes, self._inputs = list(cubes), inputs
        self._timing = inputs.timing if isinstance(inputs.timing, Timing) else Timing()
        header = self.header
        self._starts = [0]
        for path in cubes:
            whole = max(0, path.stat().st_size - header.header_offset) // header.line_bytes
            self._starts.append(self._starts[-1] + whole)
        if self._navigation is None and isinstance(self._timing.nav, Path):
            self._navigation = GrowingTable(self._timing.nav)
        if self._navigation is not None:
            self._navigation.grow()
        common = self._timing.frame_index
        if common is None:
            return self._starts[-1]
        # the frame index of each cube, or the common one
        by_cube = [path.with_name(f"frameIndex_{cube_number(path)}.txt") for path in self._cubes]
        of_cubes = common in by_cube and all(path.is_file() for path in by_cube)
        for path in by_cube if of_cubes else [common]:
            self._indexes.setdefault(path, GrowingTable(path)).grow()
        return min(self._starts[-1], len(list(self._rows())))

    def _rows(self) -> Iterator[bytes]:
        # The rows of all frame indexes from the first frame of the first cube on.
        first = cube_number(self._cubes[0]) or 0
        for table in self._indexes.values():
            common = len(self._indexes) == 1 and first
            skipped = bisect.bisect_left(table.rows, first, key=_frame) if common else 0
            yield from table.rows[skipped if skipped < len(table.rows) else 0 :]

    def counts(self, first: int, stop: int) -> NDArray[Any]:
        """Return the counts of complete lines (line, band, column), in native byte order."""
        header, parts = self.header, []
        sizes = {"l": -1, "b": header.bands, "s": header.samples}
        shape = [sizes[axis] for axis in {"bil": "lbs", "bip": "lsb"}[header.interleave]]
        for path, begin, end in zip(self._cubes, self._starts, self._starts[1:], strict=False):
            low, high = max(first, begin), min(stop, end)
            if low < high:
                offset = header.header_offset + (low - begin) * header.line_bytes
                count = (high - low) * header.bands * header.samples
                parts.append(np.fromfile(path, header.dtype, count, offset=offset).reshape(shape))
        whole = parts[0] if len(parts) == 1 else np.concatenate(parts)
        counts = whole.transpose(_AXES[header.interleave])
        return np.ascontiguousarray(counts, header.dtype.newbyteorder("="))

    def ended(self, first: int, stop: int, first_pose: int) -> tuple[FlightlineInputs, int]:
        """Return the inputs of a line of lines ``first`` to ``stop`` only, and its first line.

        ``first_pose``: the first row of the navigation that it needs.
        """
        assert self._inputs is not None  # set by `look`
        header = self.header
        timing = self._timing
        self._view.mkdir(parents=True, exist_ok=True)
        if timing.frame_index is None:
            first = 0  # its times count from the first line
        else:
            index = self._view / "frameIndex_0.txt"
            head = next(iter(self._indexes.values())).head
            index.write_bytes(head + b"".join(list(self._rows())[first:stop]))
            timing = replace(timing, frame_index=index)
        if self._navigation is not None:
            poses = self._view / "imu_gps.txt"
            self._navigation.write(poses, first_pose)
            timing = replace(timing, nav=poses)
        for path in self._cubes[0].parent.glob("*settings.txt"):
            shutil.copyfile(path, self._view / path.name)
        cube = self._view / f"{self._cubes[0].name.split('.')[0]}.hdr"
        cube.write_text(f"{self._header_text}\nlines = {stop - first}\n", encoding="utf-8")
        data = cube.with_suffix("")
        data.touch()
        os.truncate(data, header.header_offset + (stop - first) * header.line_bytes)
        return replace(self._inputs, cube=cube, timing=timing), first


def _counts_lines(header: Path) -> bool:
    with open_input(header, "an ENVI header") as file:
        match = _LINES.search(file.read(4 * 2**20).decode("utf-8", "replace"))
    digits = "" if match is None else match[0].partition("=")[2].strip()
    return digits.isdigit() and int(digits) > 0


def _frame(row: bytes) -> int:
    number = row.split()[0]
    return int(number) if number.isdigit() else 0
