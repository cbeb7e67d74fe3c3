"""What may be wrong with the inputs of a flight line: every kind with its name, weight and mend."""

from __future__ import annotations

from dataclasses import dataclass

from hyperpaint.base.errors import Problem

__all__ = ["KINDS", "Finding", "Kind"]


@dataclass(frozen=True)
class Kind:
    """A kind of finding.

    Attributes
    ----------
    name
        By which it is listed and accepted.
    meaning
        What the inputs show.
    mend
        What to look for.
    refused
        Whether processing stops: results would be wrong. Else it goes on with a warning.
    """

    name: str
    meaning: str
    mend: str
    refused: bool = True


KINDS = {
    kind.name: kind
    for kind in (
        Kind(
            "counts-over-range",
            "counts above the last that the converter gives",
            "set bit_depth in [camera], or shift left-justified counts down before",
        ),
        Kind(
            "dark-of-zeros",
            "elements of the dark that are exactly zero in every frame",
            'record the dark again; where the counts are dark-corrected, say cubes = "none" in [dark]',
        ),
    )
}
"""Every kind of finding, by its name."""


@dataclass(frozen=True)
class Finding:
    """One thing about a flight line that cannot be true, or is hardly so."""

    kind: Kind
    line: str  #: Flight line, or its cube
    found: str  #: With the figure
    expected: str

    def __str__(self) -> str:
        return str(self.problem())

    def problem(self, *, acceptable: bool = False) -> Problem:
        """Return it as a problem of an error; one that is ``acceptable`` says how it is accepted."""
        name, mend = self.kind.name, self.kind.mend
        ways = ("", "") if not acceptable else (f", or pass accept=[{name!r}]", f", or pass --accept {name}")
        found = f"{self.line}: {name}: {self.found}"
        return Problem(found, self.expected, *(f"{mend}{way}" for way in ways))
