"""What a folder holds, to be compared."""

from pathlib import Path


def contents(folder: Path) -> dict[str, bytes]:
    # Return the bytes of every file below a folder
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}
