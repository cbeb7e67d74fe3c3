"""The grammar of ENVI headers, without the meaning of any key.

A header is text: a first line ``ENVI``, then ``key = value`` lines; a value that opens with a brace runs to
the next closing brace. Lines that open with a semicolon are comments, in which Headwall cameras keep their
metadata.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass, field

from hyperpaint.base.errors import Problems

__all__ = ["Findings", "Scanned", "bare", "scan", "shown"]

MAX_ENTRIES = 10_000
_MAX_SHOWN = 20


class Findings:
    """Problems, notes and warnings, the flood of a damaged file cut short."""

    def __init__(self, problems: Problems) -> None:
        self._problems = problems
        self.notes: list[str] = []
        self.warnings: list[str] = []

    def problem(self, text: str) -> None:
        """Add what makes the header unusable."""
        self._problems.add(text)

    @property
    def flooded(self) -> bool:
        """Whether there are so many problems that more would not help."""
        return len(self._problems) >= _MAX_SHOWN

    def note(self, text: str, *, warn: bool = False) -> None:
        """Add what was inferred or looks odd; `warn` where values may be wrong for it."""
        if len(self.warnings if warn else self.notes) < _MAX_SHOWN:
            self.notes.append(text)
            if warn:
                self.warnings.append(text)

    def raise_if_any(self) -> None:
        """Raise one error that lists the problems."""
        self._problems.raise_if_any()


@dataclass
class Scanned:
    """Keys in lower case with their raw values, and comment pairs, in the order of the file."""

    fields: dict[str, str] = field(default_factory=dict)
    comments: dict[str, str] = field(default_factory=dict)


def shown(text: str) -> str:
    """Return text as messages quote it."""
    return repr(text if len(text) <= 60 else text[:57] + "...")


def scan(text: str, findings: Findings) -> Scanned:
    """Split the text into keys with raw values, and comment pairs."""
    lines = enumerate(io.StringIO(text, newline=None), start=1)
    scanned = Scanned()
    _, first = next(lines, (1, ""))
    if first.split() != ["ENVI"]:
        findings.problem(f"first line is {shown(first.rstrip())}, expected 'ENVI'")
        return scanned
    entries = 0
    for number, line in lines:
        line = line.strip()
        if line.startswith(";"):
            key, equals, value = line.lstrip("; \t").partition("=")
            if equals:
                _store_comment(scanned.comments, key.strip(), value.strip(), findings)
        elif line:
            key, equals, value = line.partition("=")
            key, value = " ".join(key.lower().split()), value.strip()
            if not equals or not key:
                findings.problem(f"line {number} is {shown(line)}, expected 'key = value' or a comment (;)")
            else:
                if value.startswith("{"):
                    value = _braced(value, number, key, lines, findings)
                _store(scanned.fields, key, value, f"line {number}", findings)
        entries += bool(line)
        if entries > MAX_ENTRIES or findings.flooded:
            findings.problem(f"reading stopped at line {number}; is it the data file?")
            return Scanned()
    return scanned


def _braced(value: str, number: int, key: str, lines: Iterator[tuple[int, str]], findings: Findings) -> str:
    """Return a braced value whole, taking more lines until its brace closes."""
    parts: list[str] = []
    part = value
    while "}" not in part:
        parts.append(part)
        _, following = next(lines, (0, None))
        if following is None:
            findings.problem(f"{key!r}: the brace opened on line {number} is never closed")
            return "\n".join(parts) + "}"
        part = following.rstrip()
    inside, _, after = part.partition("}")
    if after.strip():
        findings.note(f"{key!r}: text after its closing brace is ignored: {shown(after.strip())}")
    return "\n".join([*parts, inside]) + "}"


def _store(into: dict[str, str], key: str, value: str, where: str, findings: Findings) -> None:
    if key not in into:
        into[key] = value
    elif into[key] == value:
        findings.note(f"{key!r} is given twice, with the same value")
    else:
        findings.problem(
            f"{where}: {key!r} is given again as {shown(value)}, before as {shown(into[key])}; "
            "delete the wrong one"
        )


def _store_comment(into: dict[str, str], key: str, value: str, findings: Findings) -> None:
    """Keep the first of two: a processing step repeats comments, and must not make the cube unreadable."""
    if into.setdefault(key, value) != value:
        findings.note(f"comment {shown(key)} is given twice: the first is kept", warn=True)


def bare(text: str) -> str:
    """Return a raw value without its braces."""
    return text[1:-1].strip() if text.startswith("{") and text.endswith("}") else text
