"""Small files read whole, after a look at their size."""

from __future__ import annotations

import os
import re
import stat
from pathlib import Path
from typing import TYPE_CHECKING

from hyperpaint.base.errors import FormatError

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["decoded_text", "load_netcdf", "read_limited", "read_limited_text"]

LONGEST_LINE = 2**20
"""Bytes of a line of text: spectra side by side have some 12 a cell."""

_LINE = re.compile(rb"[^\r\n]+")

MOST_NETCDF_BYTES = 2**30
"""Bytes of all variables of a netCDF file that is loaded at once."""


def read_limited(path: Path, limit: int, expected: str) -> bytes:
    """Return the bytes of a file that is read whole.

    Parameters
    ----------
    path
        The file.
    limit
        Most bytes that such a file has.
    expected
        Names the kind of file in messages.

    Raises
    ------
    FormatError
        The file cannot be read, or is larger than ``limit``.
    """
    try:
        found = path.stat()
        size = found.st_size
        if stat.S_ISREG(found.st_mode) and size <= limit:
            with open(path, "rb") as file:
                # read() sets aside all it is allowed to read
                return file.read(size)
    except OSError as error:
        raise FormatError(f"{path}: cannot be read ({error.strerror or error}); check the path") from error
    if not stat.S_ISREG(found.st_mode):
        raise FormatError(f"{path}: a folder, pipe or device, expected {expected}; check the path")
    raise FormatError(f"{path}: {size} bytes, expected {expected} of at most {limit} bytes; check the path")


def read_limited_text(path: Path, limit: int, expected: str) -> bytes:
    """Return the bytes of a text file, as `read_limited`; its lines are bounded too.

    A line is split into cells, each of which takes thirty times its bytes.

    Raises
    ------
    FormatError
        As `read_limited`; or a line is longer than `LONGEST_LINE`.
    """
    data = read_limited(path, limit, expected)
    if len(data) > LONGEST_LINE:
        longest = max((line.end() - line.start() for line in _LINE.finditer(data)), default=0)
        if longest > LONGEST_LINE:
            raise FormatError(
                f"{path}: a line of {longest} bytes, expected {expected}, lines of at most {LONGEST_LINE}"
            )
    return data


def decoded_text(data: bytes) -> str:
    """Return the bytes of a file as text: UTF-8, with or without a mark, else latin-1, which any bytes are.

    Examples
    --------
    >>> decoded_text("µm".encode("utf-8-sig")), decoded_text("µm".encode("latin-1"))
    ('µm', 'µm')
    """
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def load_netcdf(path: Path, group: str | None = None) -> xr.Dataset:
    """Load a small netCDF file whole.

    Raises
    ------
    FormatError
        It declares more than `MOST_NETCDF_BYTES`, or is no plain file.
    Exception
        Whatever the engine raises where the file is damaged.
    """
    import xarray as xr

    if not path.is_file():
        raise FormatError(f"{path}: expected a netCDF file; check the path")
    with xr.open_dataset(os.fspath(path), group=group) as dataset:
        if dataset.nbytes > MOST_NETCDF_BYTES:
            raise FormatError(f"{path} declares {dataset.nbytes} bytes, expected at most {MOST_NETCDF_BYTES}")
        return dataset.load()
