"""Problems of independent inputs, gathered so that one message lists them all.

`hyperpaint.base.errors.Problems` lists the faults of one input as texts; `Findings` catches the errors that
several inputs raise, keeps a lone one as it is, and lists more than one through `Problems`.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from enum import Enum

from .errors import CollectError, PaintError, Problems

__all__ = ["Findings", "Unavailable"]


class Unavailable(Enum):
    """Stands for an input that failed to open and has been reported."""

    REPORTED = "reported"


class Findings:
    """Problems of independent steps, raised together."""

    def __init__(self, subject: str) -> None:
        self.subject = subject
        self.errors: list[Exception] = []

    @contextlib.contextmanager
    def step(self) -> Iterator[None]:
        """Note what a step raises on purpose, and go on after it."""
        try:
            yield
        except (PaintError, OSError) as error:
            self.errors.append(error)

    def raise_if_any(self) -> None:
        """Raise the one error as it is, or one that lists them all."""
        if not self.errors:
            return
        kinds = {type(error) for error in self.errors}
        if len(self.errors) == 1 and isinstance(self.errors[0], PaintError):
            raise self.errors[0]
        kind = kinds.pop() if len(kinds) == 1 else CollectError
        problems = Problems(self.subject, kind if issubclass(kind, PaintError) else CollectError)
        for error in self.errors:
            problems.add(str(error))
        problems.raise_if_any()
