"""Small files of tests."""

from pathlib import Path


def write_file(
    path: Path,
    content: str | bytes,
    encoding: str = "utf-8",
    errors: str = "strict",
    newline: str | None = None,
) -> Path:
    # Write a text or bytes and return the path
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        path.write_text(content, encoding, errors, newline)
    return path
