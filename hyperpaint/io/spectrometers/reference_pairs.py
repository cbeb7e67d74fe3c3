"""Files that say which reference belongs to which paint."""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hyperpaint.base.errors import FormatError, Problems
from hyperpaint.io.files.reading import read_limited_text

__all__ = ["read_pairs"]

_MAX_BYTES = 4 << 20
_MOST_SHOWN = 5
_HEADINGS = ("paint", "name", "signature", "region")


def read_pairs(path: str | os.PathLike[str]) -> dict[str, tuple[str, ...]]:
    r"""Read which references belong to which paints.

    Parameters
    ----------
    path
        Lines of paint and reference, separated by a comma, under headings or none; a paint may have several
        lines. Or a JSON object of paints, each with one name or a list of them (``.json``).

    Returns
    -------
    dict
        Names of references by names of paints, in the order of the file.

    Raises
    ------
    FormatError
        The file is no such list; the first problems are told.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp(), "pairs.csv")
    >>> _ = path.write_text("paint,reference\nhood,svc_0012\nhood,svc_0013\n")
    >>> read_pairs(path)
    {'hood': ('svc_0012', 'svc_0013')}
    """
    path = Path(path)
    data = read_limited_text(path, _MAX_BYTES, "a list of paints and references")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FormatError(f"{path}: no UTF-8 text; save it as UTF-8") from error
    problems = Problems(f"{path} is no list of paints and references", FormatError)
    found = _of_json(text, problems) if path.suffix.lower() == ".json" else _of_lines(text, problems)
    made: dict[str, dict[str, None]] = {}
    for paint, reference in found:
        made.setdefault(paint, {})[reference] = None
    if not made and not problems:
        problems.add("it names no pair")
    problems.raise_if_any()
    return {paint: tuple(references) for paint, references in made.items()}


def _of_lines(text: str, problems: Problems) -> Iterator[tuple[str, str]]:
    rows = csv.reader(text.splitlines(), strict=True)
    number = 0
    try:
        for number, row in enumerate(rows, 1):
            cells = [cell.strip() for cell in row]
            if not any(cells) or cells[0].startswith("#"):
                continue
            if number == 1 and cells[0].lower() in _HEADINGS and cells[1:2] == ["reference"]:
                continue
            if len(cells) == 2 and all(cells):
                yield cells[0], cells[1]
            elif len(problems) < _MOST_SHOWN:
                problems.add(
                    f"line {number}: {','.join(row)[:60]!r}, expected a paint, a comma and a reference"
                )
    except csv.Error as error:
        problems.add(f"after line {number}: {error}")


def _of_json(text: str, problems: Problems) -> Iterator[tuple[str, str]]:
    try:
        document: Any = json.loads(text)
    except (ValueError, RecursionError) as error:
        problems.add(f"no JSON ({error!s:.80})")
        return
    if not isinstance(document, dict):
        problems.add("expected an object of paints, each with the name of its reference or a list of names")
        return
    for paint, names in document.items():
        several = [names] if isinstance(names, str) else names
        if isinstance(several, list) and several and all(isinstance(name, str) and name for name in several):
            yield from ((paint, name) for name in several)
        elif len(problems) < _MOST_SHOWN:
            problems.add(f"{paint!r:.60}: {names!r:.60}, expected a name or a list of names")
