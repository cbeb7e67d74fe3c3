"""Errors with the observed value, the accepted values, a remedy and a stable code; all problems at once."""

import contextlib
import inspect
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, ParamSpec, Self, TypeVar

__all__ = [
    "CollectError",
    "Findings",
    "FormatError",
    "IncompleteStoreError",
    "MissingExtraError",
    "PaintError",
    "PaintWarning",
    "Problem",
    "Problems",
    "SchemaError",
    "StoreError",
    "TimeError",
    "Unavailable",
    "UnitsError",
    "needs_extra",
]

P = ParamSpec("P")
T = TypeVar("T")


@dataclass(frozen=True)
class Problem:
    """One fault of an input.

    Attributes
    ----------
    found
        Observed value or state.
    expected
        Accepted values; empty where ``found`` implies them.
    mend
        Remedy, for a caller in Python.
    option
        Remedy, for a caller of the command line, where it is spelled differently.
    code
        Stable name of the fault, such as "region-empty"; tests and scripts match it.
    inner
        Faults that make up this one.

    Examples
    --------
    >>> problem = Problem("lot.zarr exists", mend="pass overwrite=True", option="pass --overwrite")
    >>> str(problem), problem.text(on_command_line=True)
    ('lot.zarr exists; pass overwrite=True', 'lot.zarr exists; pass --overwrite')
    >>> print(Problem("the line has no pixel", code="line-empty"))
    the line has no pixel [line-empty]
    """

    found: str
    expected: str = ""
    mend: str = ""
    option: str = ""
    code: str = ""
    inner: "tuple[Problem, ...]" = ()

    @property
    def codes(self) -> tuple[str, ...]:
        """Codes of this fault and of its parts."""
        codes = (self.code,) if self.code else ()
        return codes + tuple(code for part in self.inner for code in part.codes)

    def text(self, *, on_command_line: bool = False) -> str:
        """Return the message, spelled for Python or for the command line; the code stands last."""
        found = f"{self.found}, expected {self.expected}" if self.expected else self.found
        mend = self.option if on_command_line and self.option else self.mend
        sentence = "; ".join(part for part in (found, mend) if part)
        if self.code:
            sentence += f" [{self.code}]"
        if not self.inner:
            return sentence
        parts = (part.text(on_command_line=on_command_line) for part in self.inner)
        return f"{sentence}:\n  " + "\n  ".join(part.replace("\n", "\n  ") for part in parts)

    def __str__(self) -> str:
        return self.text()


class PaintError(Exception):
    """Base class of all errors that hyperpaint raises on purpose.

    Parameters
    ----------
    found
        Observed value or state, or the subject of several problems.
    expected, mend, option, code
        See `Problem`.
    problems
        All faults of the subject.

    Attributes
    ----------
    problem
        The fault, its parts included.

    Examples
    --------
    >>> error = PaintError("2 lights", mend="pass light=", option="give --light", code="light-number")
    >>> print(error)
    2 lights; pass light= [light-number]
    >>> print(error.about("lot.zarr").text(on_command_line=True))
    lot.zarr: 2 lights; give --light [light-number]
    >>> error.codes
    ('light-number',)
    """

    def __init__(
        self,
        found: str = "",
        *,
        expected: str = "",
        mend: str = "",
        option: str = "",
        code: str = "",
        problems: Sequence[Problem] = (),
    ) -> None:
        self.problem = Problem(found, expected, mend, option, code, tuple(problems))
        super().__init__(self.text())

    @property
    def problems(self) -> tuple[Problem, ...]:
        """Faults of the subject, where there are several."""
        return self.problem.inner

    @property
    def codes(self) -> tuple[str, ...]:
        """Codes of all faults."""
        return self.problem.codes

    @classmethod
    def raise_if(
        cls,
        is_fault: Any,
        found: str,
        *,
        expected: str = "",
        mend: str = "",
        option: str = "",
        code: str = "",
    ) -> None:
        """Raise the error if the input has the fault; see `Problem`."""
        if is_fault:
            raise cls(found, expected=expected, mend=mend, option=option, code=code)

    @classmethod
    def raise_if_none(cls, value: T | None, found: str, **texts: Any) -> T:
        """Return the value, or raise the error if it is None; ``texts``: see `Problem`."""
        if value is None:
            raise cls(found, **texts)
        return value

    @classmethod
    @contextlib.contextmanager
    def instead_of(
        cls, errors: type[Exception] | tuple[type[Exception], ...], found: str, **texts: Any
    ) -> Iterator[None]:
        """Raise the error instead of ``errors`` of the block.

        ``$whole``, ``$error`` and ``$kind`` in ``found`` are the message of the original, its first 200
        characters, and its class; ``$reason`` is the message of the system for an OSError, else the whole;
        ``texts``: see `Problem`.

        Examples
        --------
        >>> with FormatError.instead_of(ValueError, "scale.txt: $error", code="number-unreadable"):
        ...     float("high")
        Traceback (most recent call last):
        hyperpaint.base.errors.FormatError: scale.txt: could not convert string to float: 'high' ...
        """
        try:
            yield
        except errors as error:
            words = {
                "$whole": str(error),
                "$error": f"{error!s:.200}",
                "$kind": type(error).__name__,
                "$reason": str(getattr(error, "strerror", None) or error),
            }
            message = re.sub("|".join(map(re.escape, words)), lambda match: words[match[0]], found)
            raise cls(message, **texts) from error

    def note(self, found: str, *, mend: str = "", option: str = "") -> None:
        """Add a remark; Python prints it below the message."""
        self._notes = (*getattr(self, "_notes", ()), Problem(found, mend=mend, option=option))
        self.add_note(str(self._notes[-1]))

    def notes(self, *, on_command_line: bool = False) -> list[str]:
        """Return the remarks, spelled for Python or for the command line."""
        texts = {
            str(note): note.text(on_command_line=on_command_line) for note in getattr(self, "_notes", ())
        }
        return [texts.get(note, note) for note in getattr(self, "__notes__", ())]

    def about(self, subject: str) -> Self:
        """Return the same error with the subject, such as the path of a file, before its message."""
        problem = self.problem
        return type(self)(
            f"{subject}: {problem.found}",
            expected=problem.expected,
            mend=problem.mend,
            option=problem.option,
            code=problem.code,
            problems=problem.inner,
        )

    def text(self, *, on_command_line: bool = False) -> str:
        """Return the message, spelled for Python or for the command line."""
        return self.problem.text(on_command_line=on_command_line)


class UnitsError(PaintError, ValueError):
    """Units are missing, unreadable, or of another dimension than the quantity needs.

    Examples
    --------
    >>> import xarray as xr
    >>> from hyperpaint.base.facts import convert
    >>> convert(xr.DataArray(1.0, attrs={"units": "m"}), "s", "exposure_time")
    Traceback (most recent call last):
    hyperpaint.base.errors.UnitsError: 'exposure_time': units 'm' are not convertible to 's'; ...
    """


class SchemaError(PaintError, ValueError):
    """A dataset lacks variables, dims, units or chunks that an operation needs, or an argument is invalid.

    Examples
    --------
    >>> import xarray as xr
    >>> xr.Dataset().paint.reflectance()
    Traceback (most recent call last):
    hyperpaint.base.errors.SchemaError: cannot compute reflectance from no variable, expected ...
    """


class FormatError(PaintError, ValueError):
    """A file violates its format: truncated, over-long, contradictory or of another format.

    Examples
    --------
    >>> import hyperpaint as hp
    >>> hp.regions.regions_from({"type": "Feature"})
    Traceback (most recent call last):
    hyperpaint.base.errors.FormatError: these regions cannot be read as regions:
      feature 0: no property 'name', which names the paint; ... [region-name-missing]
    """


class TimeError(PaintError, ValueError):
    """Time stamps are duplicate, unordered, without a time zone, or inconsistent with the lines.

    Examples
    --------
    >>> raise TimeError("stamps run backwards", mend="sort the record")
    Traceback (most recent call last):
    hyperpaint.base.errors.TimeError: stamps run backwards; sort the record
    """


class CollectError(PaintError, ValueError):
    """A ``collect.toml``, or a file that it names, cannot be processed.

    Examples
    --------
    >>> import tempfile
    >>> import hyperpaint as hp
    >>> from pathlib import Path
    >>> path = Path(tempfile.mkdtemp(), "collect.toml")
    >>> _ = path.write_text("flight = 7")
    >>> hp.open_collect(path)
    Traceback (most recent call last):
    hyperpaint.base.errors.CollectError: ... cannot be processed:
      unknown table or key 'flight'; did you mean 'flightlines'?
      ...
    """


class StoreError(PaintError, OSError):
    """A store cannot be written to the path, or its content must not be replaced.

    Examples
    --------
    >>> import hyperpaint as hp
    >>> hp.open_store("memory://nowhere.zarr")
    Traceback (most recent call last):
    hyperpaint.base.errors.StoreError: memory://nowhere.zarr is not a Zarr store ...
    """


class IncompleteStoreError(StoreError):
    """A store or group was never finished, or has been damaged since.

    Examples
    --------
    >>> import fsspec, hyperpaint as hp, xarray as xr
    >>> path = hp.to_store(xr.Dataset({"wavelength": ("band", [450.0, 550.0])}), "memory://damaged.zarr")
    >>> fsspec.filesystem("memory").rm("/damaged.zarr/wavelength", recursive=True)
    >>> hp.open_store(path)
    Traceback (most recent call last):
    hyperpaint.base.errors.IncompleteStoreError: group '/' of memory://damaged.zarr is not ...
    """


class MissingExtraError(PaintError, ImportError):
    """A feature needs a package that only an extra of hyperpaint installs.

    Examples
    --------
    >>> print(MissingExtraError.of("pyproj", "geo", "a map"))
    a map needs pyproj; install it with: python -m pip install 'hyperpaint[geo]' [extra-missing]
    """

    @classmethod
    def of(cls, package: str, extra: str, purpose: str) -> "MissingExtraError":
        """Return the error for ``package``, which ``pip install 'hyperpaint[extra]'`` brings."""
        return cls(
            f"{purpose} needs {package}",
            mend=f"install it with: python -m pip install 'hyperpaint[{extra}]'",
            code="extra-missing",
        )


@contextlib.contextmanager
def needs_extra(package: str, extra: str, purpose: str) -> Iterator[None]:
    """Turn the ImportError of a package that an extra installs into a `MissingExtraError`.

    Examples
    --------
    >>> with needs_extra("unheard_of", "geo", "a map"):
    ...     import unheard_of
    Traceback (most recent call last):
    hyperpaint.base.errors.MissingExtraError: a map needs unheard_of; install it with: ...
    """
    try:
        yield
    except ImportError as error:
        raise MissingExtraError.of(package, extra, purpose) from error


class PaintWarning(UserWarning):
    """A condition that the user can act on and that does not stop the computation.

    Parameters
    ----------
    found
        The condition, and what the user can do.
    code
        Stable name of the condition; scripts match it.

    Examples
    --------
    >>> import warnings
    >>> with warnings.catch_warnings(record=True) as noted:
    ...     warnings.simplefilter("always", PaintWarning)  # or "error", or "ignore"
    ...     warnings.warn(PaintWarning("3 lines have no light", code="light-missing"))
    >>> str(noted[0].message)
    '3 lines have no light [light-missing]'
    """

    def __init__(self, found: str, *, code: str = "") -> None:
        self.code = code
        super().__init__(f"{found} [{code}]" if code else found)


def warn_user(found: str, code: str) -> None:
    # Warn of a condition, at the line of the first caller outside of this package.
    package, frame, level = __name__.partition(".")[0], inspect.currentframe(), 1
    while frame is not None and str(frame.f_globals.get("__name__")).partition(".")[0] == package:
        frame, level = frame.f_back, level + 1
    warnings.warn(PaintWarning(found, code=code), stacklevel=level)


def warn_if(is_present: Any, found: str, code: str) -> None:
    if is_present:
        warn_user(found, code)


class Problems(contextlib.AbstractContextManager["Problems"]):
    """Collector of all problems of one input, to raise them together: at the end of a ``with`` block, if any.

    Parameters
    ----------
    subject
        Start of the message: the unusable input and its purpose.
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
    >>> with Problems("the map", SchemaError) as problems:
    ...     problems.add_if(True, "no crs")
    Traceback (most recent call last):
    hyperpaint.base.errors.SchemaError: the map:
      no crs
    """

    def __init__(self, subject: str, error: type[PaintError]) -> None:
        self._subject = subject
        self._error = error
        self._problems: list[Problem] = []

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        # another error that leaves the block takes precedence
        if kind is None:
            self.raise_if_any()

    def add(
        self, found: str, *, expected: str = "", mend: str = "", option: str = "", code: str = ""
    ) -> None:
        """Note one fault; see `Problem`."""
        self._problems.append(Problem(found, expected, mend, option, code))

    def add_if(
        self,
        is_fault: Any,
        found: str,
        *,
        expected: str = "",
        mend: str = "",
        option: str = "",
        code: str = "",
    ) -> None:
        """Note one fault if the input has it."""
        if is_fault:
            self.add(found, expected=expected, mend=mend, option=option, code=code)

    def extend(self, problems: Iterable[Problem]) -> None:
        """Note the faults of another input."""
        self._problems.extend(problems)

    def add_error(self, subject: str, error: Exception) -> None:
        """Note an error, with its parts, mends and codes; a subject stands before its message."""
        if isinstance(error, PaintError):
            self._problems.append((error.about(subject) if subject else error).problem)
        else:
            self.add(f"{subject}: {error}", code="input-unreadable")

    @contextlib.contextmanager
    def noting(
        self, errors: type[Exception] | tuple[type[Exception], ...], subject: str = ""
    ) -> Iterator[None]:
        """Note ``errors`` of the block instead of raising them; see `add_error`.

        Examples
        --------
        >>> with Problems("the map", SchemaError) as problems:
        ...     with problems.noting(FormatError, "grid"):
        ...         raise FormatError("no cells")
        Traceback (most recent call last):
        hyperpaint.base.errors.SchemaError: the map:
          grid: no cells
        """
        try:
            yield
        except errors as error:
            self.add_error(subject, error)

    def __len__(self) -> int:
        return len(self._problems)

    def __iter__(self) -> Iterator[str]:
        return map(str, self._problems)

    def raise_if_any(self, *checks: tuple[object, Problem]) -> None:
        """Note the problems of checks whose condition is true; raise one error that lists all, if any.

        Examples
        --------
        >>> Problems("the map", SchemaError).raise_if_any((0, Problem("no crs")), (1, Problem("no cells")))
        Traceback (most recent call last):
        hyperpaint.base.errors.SchemaError: the map:
          no cells
        """
        self.extend(problem for is_fault, problem in checks if is_fault)
        if self._problems:
            raise self._error(self._subject, problems=self._problems)


class Unavailable(Enum):
    """Placeholder of an input that failed to open and has been reported.

    Examples
    --------
    >>> record = Unavailable.REPORTED  # in place of a dataset
    >>> record is Unavailable.REPORTED
    True
    """

    REPORTED = "reported"


class Findings:
    """Errors of independent inputs, raised together; `Problems` lists the faults of one input.

    A single error is raised unchanged; several are listed in one.

    Examples
    --------
    >>> findings = Findings("lot.zarr")
    >>> for name in ("dark", "light"):
    ...     with findings.step():
    ...         raise FormatError(f"no {name}")
    >>> findings.raise_if_any()
    Traceback (most recent call last):
    hyperpaint.base.errors.FormatError: lot.zarr:
      no dark
      no light
    """

    def __init__(self, subject: str) -> None:
        self.subject = subject
        self.errors: list[Exception] = []

    @contextlib.contextmanager
    def step(self) -> Iterator[None]:
        """Catch and collect the errors of a step."""
        try:
            yield
        except (PaintError, OSError) as error:
            self.errors.append(error)

    def attempt(self, function: Callable[P, T], *arguments: P.args, **options: P.kwargs) -> T | None:
        """Return the result of a step; None after an error, which is collected."""
        try:
            return function(*arguments, **options)
        except (PaintError, OSError) as error:
            self.errors.append(error)
            return None

    def raise_if_any(self) -> None:
        """Raise a single error unchanged, or one error that lists all."""
        if not self.errors:
            return
        kinds = {type(error) for error in self.errors}
        if len(self.errors) == 1 and isinstance(self.errors[0], PaintError):
            raise self.errors[0]
        kind = kinds.pop() if len(kinds) == 1 else CollectError
        raise (kind if issubclass(kind, PaintError) else CollectError)(
            self.subject,
            problems=[
                error.problem
                if isinstance(error, PaintError)
                else Problem(str(error), code="input-unreadable")
                for error in self.errors
            ],
        )
