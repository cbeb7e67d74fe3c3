"""Small files read whole, after a look at their size."""

from __future__ import annotations

from pathlib import Path

from hyperpaint.errors import FormatError

__all__ = ["read_limited"]


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
        size = path.stat().st_size
        if size <= limit:
            return path.read_bytes()
    except OSError as error:
        msg = f"{path}: cannot be read ({error.strerror or error}); check the path"
        raise FormatError(msg) from error
    msg = f"{path}: {size} bytes, expected {expected} of at most {limit} bytes; check the path"
    raise FormatError(msg)
