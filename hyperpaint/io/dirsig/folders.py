"""An export's folder, and how it is known for one."""

from __future__ import annotations

import contextlib
import json
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from hyperpaint.base.errors import FormatError, StoreError
from hyperpaint.io.files.publishing import published_folder
from hyperpaint.io.files.reading import read_limited

__all__ = ["EMISSIVITY", "REFLECTANCE", "export_folder", "write_marker"]

EMISSIVITY, REFLECTANCE = "emissivity", "reflectance"

_MARKER = "paints.json"
_FORMAT = "hyperpaint DIRSIG export"
_MOST_BYTES = 256 * 2**20
_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/|.*::")


@contextlib.contextmanager
def export_folder(folder: str | os.PathLike[str], *, overwrite: bool) -> Iterator[Path]:
    """Yield a folder to write an export to, which gets its place when the block ends well.

    Parameters
    ----------
    folder
        The place: new, empty, or an earlier export.
    overwrite
        Whether that may be replaced.

    Raises
    ------
    StoreError
        The place holds anything else, or an export that may not be replaced; another writes there; or it
        cannot be written. Also for whatever the disk refuses inside.
    """
    if _URL.match(os.fspath(folder)):
        raise StoreError(f"{os.fspath(folder)!r} is a URL, expected a folder; write to a folder and copy it")
    place = Path(os.path.abspath(folder))
    with published_folder(place, overwrite=overwrite, foreign=_foreign) as build:
        for name in (EMISSIVITY, REFLECTANCE):
            (build / name).mkdir()
        yield build


def write_marker(build: Path, content: Mapping[str, Any]) -> None:
    """Write what an export says of itself, by which it is known for one."""
    document = {"format": _FORMAT, "version": 1, **content}
    text = json.dumps(document, indent=1, ensure_ascii=False) + "\n"
    (build / _MARKER).write_bytes(text.encode("utf-8", "backslashreplace"))


def _foreign(folder: Path) -> str:
    try:
        document = json.loads(read_limited(folder / _MARKER, _MOST_BYTES, "an export"))
    except (FormatError, ValueError, RecursionError):
        document = None
    ours = isinstance(document, dict) and document.get("format") == _FORMAT
    return "" if ours else "other files"
