"""Files by pattern, with a bound on the work: inside one folder, and through no link that ``**`` meets."""

from __future__ import annotations

import fnmatch
import os
import re
from collections.abc import Iterator
from pathlib import Path

__all__ = ["is_pattern", "matching_files"]

#: Folders and files looked at before a pattern is called too wide.
MOST_ENTRIES = 100_000
_LONGEST = 1000
_MAGIC = re.compile(r"[*?\[]")


def is_pattern(text: str) -> bool:
    """Tell whether a text is a pattern, and not a plain path."""
    return _MAGIC.search(text) is not None


def matching_files(folder: Path, pattern: str, most: int = MOST_ENTRIES) -> list[Path]:
    """Return the files and folders that a pattern matches, sorted.

    As `glob.glob`, but it cannot be made to walk the whole disk, nor around in links without end: at most
    ``most`` entries are looked at.

    Parameters
    ----------
    folder
        Patterns are relative to it.
    pattern
        Names between slashes with ``*``, ``?`` and ``[...]``; ``**`` stands for any folders, links left out.
        None of these matches a leading dot.
    most
        Bound on the entries.

    Raises
    ------
    ValueError
        The pattern leads out of the folder, is too long, or matches too much; with the reason.

    Examples
    --------
    >>> matching_files(Path("."), "/etc/*")
    Traceback (most recent call last):
    ValueError: expected a pattern inside the folder of the file
    """
    if len(pattern) > _LONGEST or "\0" in pattern:
        raise ValueError(f"expected a pattern of at most {_LONGEST} characters")
    parts = [part for part in pattern.replace(os.sep, "/").split("/") if part != "."]
    if os.path.isabs(pattern) or os.path.splitdrive(pattern)[0] or ".." in parts:
        raise ValueError("expected a pattern inside the folder of the file")
    work = _Work(most)
    found = [str(folder)]
    for part in filter(None, parts):
        found = list(dict.fromkeys(path for base in found for path in work.step(base, part)))
    return sorted(Path(path) for path in found)


class _Work:
    """One pattern's walk, which counts what it looks at."""

    def __init__(self, most: int) -> None:
        self.left = self.most = most

    def step(self, base: str, part: str) -> Iterator[str]:
        """Yield what a part of the pattern matches in a folder."""
        if part == "**":
            yield from self._folders(base)
        elif not is_pattern(part):
            self._count(1)
            path = os.path.join(base, part)
            if os.path.lexists(path):
                yield path
        else:
            names = [entry.name for entry in self._entries(base)]
            hidden = part.startswith(".")
            for name in fnmatch.filter(names, part):
                if hidden or not name.startswith("."):
                    yield os.path.join(base, name)

    def _folders(self, base: str) -> Iterator[str]:
        pending = [base]
        while pending:
            folder = pending.pop()
            yield folder
            pending += [
                entry.path
                for entry in self._entries(folder)
                if not entry.name.startswith(".") and entry.is_dir(follow_symlinks=False)
            ]

    def _entries(self, folder: str) -> list[os.DirEntry[str]]:
        found = []
        try:
            with os.scandir(folder) as entries:
                for entry in entries:
                    self._count(1)
                    found.append(entry)
        except OSError:  # no folder, or not ours to read: nothing in it matches
            return found
        self._count(1)
        return found

    def _count(self, number: int) -> None:
        self.left -= number
        if self.left < 0:
            raise ValueError(f"more than {self.most} files and folders to look at; name their folder")
