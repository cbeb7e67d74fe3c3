"""What a check has found, field by field, and what it could not find out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from hyperpaint.base.attitude_conventions import Convention

__all__ = ["ConventionCheck", "Finding", "Verdict"]

Verdict = Literal["right", "wrong", "undecided"]


@dataclass(frozen=True)
class Finding:
    """What a check says of one thing that is declared.

    Attributes
    ----------
    field
        Field of the `hyperpaint.Convention`; or ``"positions"``, ``"clock"``.
    declared
        What is declared.
    verdict
        ``"right"``, ``"wrong"``, or ``"undecided"``: neither the track nor the picture can tell.
    likely
        What it looks like instead; empty where it is right.
    evidence
        Why, in figures.
    """

    field: str
    declared: str
    verdict: Verdict
    likely: str
    evidence: str


@dataclass(frozen=True)
class ConventionCheck:
    """What track and picture say of a declared convention.

    Attributes
    ----------
    findings
        One for everything that is declared.
    suggested
        The convention declared, with what is wrong replaced where one alternative is left; it is not applied.
    lines
        First line looked at, and the one after the last.
    """

    findings: tuple[Finding, ...]
    suggested: Convention
    lines: tuple[int, int]

    @property
    def wrong(self) -> tuple[str, ...]:
        """Names of what looks wrong."""
        return tuple(one.field for one in self.findings if one.verdict == "wrong")

    @property
    def undecided(self) -> tuple[str, ...]:
        """Names of what could not be told."""
        return tuple(one.field for one in self.findings if one.verdict == "undecided")

    def __getitem__(self, field: str) -> Finding:
        """Return the finding on a field."""
        return next(one for one in self.findings if one.field == field)

    def table(self) -> str:
        """Return the findings as text."""
        rows = [("", "declared", "verdict", "looks like", "evidence")]
        rows += [(f.field, f.declared, f.verdict, f.likely, f.evidence) for f in self.findings]
        widths = [max(len(row[k]) for row in rows) for k in range(4)]
        return "\n".join(
            "  ".join([*(cell.ljust(n) for cell, n in zip(row, widths, strict=False)), row[4]]).rstrip()
            for row in rows
        )
