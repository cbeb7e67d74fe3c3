"""Errors that say what was found, what was expected and how to mend it, all problems at once."""

from __future__ import annotations

from collections.abc import Iterator

__all__ = [
    "CollectError",
    "FormatError",
    "IncompleteStoreError",
    "MissingExtraError",
    "PaintError",
    "PaintWarning",
    "Problems",
    "SchemaError",
    "StoreError",
    "TimeError",
    "UnitsError",
]


class PaintError(Exception):
    """Base of every error hyperpaint raises on purpose."""


class UnitsError(PaintError, ValueError):
    """Units are missing, unreadable, or of another dimension than the quantity needs."""


class SchemaError(PaintError, ValueError):
    """A dataset lacks variables, dims, units or chunks that an operation needs."""


class FormatError(PaintError, ValueError):
    """A file is not what its format says: truncated, over-long, contradictory or foreign."""


class TimeError(PaintError, ValueError):
    """Time stamps are duplicate, unordered, without a zone, or do not fit the lines."""


class CollectError(PaintError, ValueError):
    """A ``collect.toml``, or the files it names, cannot be processed as written."""


class StoreError(PaintError, OSError):
    """A store cannot be written where asked, or what it holds must not be touched."""


class IncompleteStoreError(StoreError):
    """A store or group was never finished, or has been damaged since."""


class MissingExtraError(PaintError, ImportError):
    """A feature needs a package that only an extra of hyperpaint installs."""

    @classmethod
    def of(cls, package: str, extra: str, purpose: str) -> MissingExtraError:
        """Return the error for ``package``, which ``pip install 'hyperpaint[extra]'`` brings."""
        return cls(f"{purpose} needs {package}; install it with: python -m pip install 'hyperpaint[{extra}]'")


class PaintWarning(UserWarning):
    """Something the user can act on, which does not stop the computation."""


class Problems:
    """Collects every problem of one input, to raise them together.

    Parameters
    ----------
    subject
        Opens the message: what cannot be used, and for what.
    error
        Class of the error raised.

    Examples
    --------
    >>> problems = Problems("array 'radiance' cannot be used as it is", SchemaError)
    >>> problems.add("units 'W m-2', expected something like 'W m-2 sr-1 nm-1'")
    >>> len(problems)
    1
    >>> problems.raise_if_any()
    Traceback (most recent call last):
    hyperpaint.base.errors.SchemaError: array 'radiance' cannot be used as it is:
      units 'W m-2', expected something like 'W m-2 sr-1 nm-1'
    """

    def __init__(self, subject: str, error: type[PaintError]) -> None:
        self._subject = subject
        self._error = error
        self._found: list[str] = []

    def add(self, problem: str) -> None:
        """Note one problem: what was found, what was expected, how to mend it."""
        self._found.append(problem)

    def __len__(self) -> int:
        return len(self._found)

    def __iter__(self) -> Iterator[str]:
        return iter(self._found)

    def raise_if_any(self) -> None:
        """Raise one error that lists every problem noted; do nothing where there is none."""
        if self._found:
            lines = "\n  ".join(problem.replace("\n", "\n  ") for problem in self._found)
            msg = f"{self._subject}:\n  {lines}"
            raise self._error(msg)
