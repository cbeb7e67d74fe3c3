"""Grammar of ENVI headers, without the meaning of keys.

A header is text: a first line ``ENVI``, then ``key = value`` lines; a value that begins with a brace extends
to the next closing brace. Lines that begin with a semicolon are comments, in which Headwall cameras store
their metadata.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from hyperpaint.base.errors import FormatError, Problems

#: Axes of an interleave, slowest first: line, band, sample.
FILE_AXES = {"bil": "lbs", "bip": "lsb", "bsq": "bls"}
MAX_ENTRIES = 10_000
_MAX_SHOWN = 20


class HeaderFindings(Problems):
    """Problems, notes and warnings of a header, limited in number."""

    def __init__(self, name: str) -> None:
        super().__init__(f"{name} cannot be used", FormatError)
        self.notes: list[str] = []
        self.warnings: list[str] = []

    def note(self, text: str, *, warn: bool = False) -> None:
        """Add an assumption or oddity; `warn` if it may make values wrong."""
        if len(self.warnings if warn else self.notes) < _MAX_SHOWN:
            self.notes.append(text)
            if warn:
                self.warnings.append(text)


@dataclass
class Scanned:
    """Keys in lower case with their raw values, and comment pairs, in the order of the file."""

    fields: dict[str, str] = field(default_factory=dict)
    comments: dict[str, str] = field(default_factory=dict)


def shown(text: str) -> str:
    """Return text shortened and quoted for messages."""
    return repr(text if len(text) <= 60 else text[:57] + "...")


def scan(text: str, findings: HeaderFindings) -> Scanned:
    """Split the text into keys with raw values, and comment pairs."""
    lines = enumerate(io.StringIO(text, newline=None), start=1)
    scanned = Scanned()
    _, first = next(lines, (1, ""))
    if first.split() != ["ENVI"]:
        findings.add(f"first line is {shown(first.rstrip())}", expected="'ENVI'", code="format-unknown")
        return scanned
    entries = 0
    for number, line in lines:
        line = line.strip()
        if line.startswith(";"):
            key, equals, value = line.lstrip("; \t").partition("=")
            # the first of two values stays: processing steps repeat comments, and the cube must stay readable
            if equals and scanned.comments.setdefault(key.strip(), value.strip()) != value.strip():
                findings.note(f"comment {shown(key.strip())} is given twice: the first is kept", warn=True)
        elif line:
            key, equals, value = line.partition("=")
            key, value = " ".join(key.lower().split()), value.strip()
            if not equals or not key:
                findings.add(
                    f"line {number} is {shown(line)}",
                    expected="'key = value' or a comment (;)",
                    code="text-unreadable",
                )
            else:
                if value.startswith("{"):
                    value = _closed(value, number, key, lines, findings)
                is_repeated = key in scanned.fields
                before = scanned.fields.setdefault(key, value)
                if before != value:
                    findings.add(
                        f"line {number}: {key!r} is given again as {shown(value)}, before as {shown(before)}",
                        mend="delete the wrong one",
                        code="key-repeated",
                    )
                elif is_repeated:
                    findings.note(f"{key!r} is given twice, with the same value")
        entries += bool(line)
        if entries > MAX_ENTRIES or len(findings) >= _MAX_SHOWN:
            findings.add(
                f"reading stopped at line {number}",
                mend="check that it is not the data file",
                code="header-too-long",
            )
            return Scanned()
    return scanned


def _closed(
    value: str, number: int, key: str, lines: Iterator[tuple[int, str]], findings: HeaderFindings
) -> str:
    # Return a braced value; lines are read until its brace closes.
    parts: list[str] = []
    part = value
    while "}" not in part:
        parts.append(part)
        _, following = next(lines, (0, None))
        if following is None:
            findings.add(f"{key!r}: the brace opened on line {number} is never closed", code="brace-open")
            return "\n".join(parts) + "}"
        part = following.rstrip()
    content, _, rest = part.partition("}")
    if rest.strip():
        findings.note(f"{key!r}: text after its closing brace is ignored: {shown(rest.strip())}")
    return "\n".join([*parts, content]) + "}"


def braced(values: Sequence[str]) -> str:
    """Return a list in ENVI's form, eight values per line."""
    return (
        "{\n " + ",\n ".join(", ".join(values[start : start + 8]) for start in range(0, len(values), 8)) + "}"
    )


def bare(text: str) -> str:
    """Return a raw value without its braces."""
    return text[1:-1].strip() if text.startswith("{") and text.endswith("}") else text
