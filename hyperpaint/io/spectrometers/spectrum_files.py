"""Shared steps of the readers of field spectrometers: find files, list errors, name spectra."""

import math
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from hyperpaint.base import FormatError, Problem, Problems, TimeError, input_path, warn_if
from hyperpaint.io.files.reading import decoded_text, is_pattern, matching_files, unique_names

QUANTITIES = ("counts", "radiance", "reflectance", "irradiance")

#: Headings of standard deviations, and of further statistics of spectra.
SPREAD = re.compile(
    r"(?<![a-z])(?:standard[ _.-]?dev\w*|st\.? ?dev\w*|std(?:ev|dev)?|s\.?d\.?|sigma|stdv|1s)(?![a-z])", re.I
)
STATISTIC = re.compile(
    r"(?<![a-z])(?:variance|var|uncertaint\w*|unc|errors?|std ?err\w*|sem|cov|snr|flags?|qc|weights?|"
    r"n ?(?:obs|spectra|samples)?|number)(?![a-z])",
    re.I,
)

Paths = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]
_T = TypeVar("_T")
_R = TypeVar("_R")

_NUMBER = re.compile(r"[-+]?(?:\d+(?:[.,]\d*)?|[.,]\d+)(?:[eE][-+]?\d{1,5})?", re.ASCII)
# NaN and infinity as programs and Windows' C library print them, in several languages
_NON_FINITE_WORDS = {
    **dict.fromkeys(("nan", "n.def.", "1.#qnan", "1.#ind"), math.nan),
    **dict.fromkeys(("inf", "infinity", "unendlich", "\N{INFINITY}", "1.#inf"), math.inf),
}


def text_lines(data: bytes) -> list[str]:
    # Return the lines of a text in UTF-8 or latin-1, with any line ends; NULs are left out.
    return decoded_text(data.replace(b"\0", b"")).replace("\r\n", "\n").replace("\r", "\n").split("\n")


def cell_number(text: str) -> float | None:
    """Return the number of a cell, with a point or a comma; None for other text.

    Examples
    --------
    >>> cell_number("-5,1"), cell_number("1.5E-02"), cell_number("-Infinity"), cell_number("1,5,0")
    (-5.1, 0.015, -inf, None)
    """
    if _NUMBER.fullmatch(text):
        return float(text.replace(",", "."))
    value = _NON_FINITE_WORDS.get((text[1:] if text[:1] in "+-" else text).lower())
    return -value if value is not None and text[0] == "-" else value


def statistics_among(names: Sequence[str]) -> list[str]:
    """Return the names of columns that are statistics of other columns, not spectra.

    Examples
    --------
    >>> statistics_among(["red.asd", "red sd", "White Std", "Std", "variance"])
    ['red sd', 'Std', 'variance']
    """
    stems = ["".join(filter(str.isalnum, SPREAD.sub(" ", _stem(name)))) for name in names]
    spectra = {stem for stem, name in zip(stems, names, strict=True) if not SPREAD.search(_stem(name))}
    return [
        name
        for stem, name in zip(stems, names, strict=True)
        if STATISTIC.fullmatch(name) or (SPREAD.search(_stem(name)) and (not stem or stem in spectra))
    ]


def _stem(name: str) -> str:
    return name.lower().removesuffix(".asd")


def find_paths(
    paths: Paths,
    of_folder: Callable[[list[Path]], list[Path]],
    expected: str,
    of_pattern: Callable[[list[Path]], list[Path]] = list,
) -> list[Path]:
    # Return the files of ``paths``: a file, a glob, a folder, or a list of these.
    #
    # of_folder, of_pattern: Select the spectra among the files of a folder, and among the matches of a glob.
    # expected: Names the accepted files in messages.
    # Raises FormatError: No file is found, or a glob leads out of its folder or matches too many files.
    if isinstance(paths, str | os.PathLike):
        paths = [paths]
    problems = Problems("spectra cannot be opened", FormatError)
    files: list[Path] = []
    for entry in paths:
        path = input_path(entry, expected)
        if path.is_dir():
            # pipes and broken links are kept, so that reading reports them
            folder_files = sorted(p for p in path.iterdir() if not p.is_dir() and not p.name.startswith("."))
            matches = of_folder(folder_files)
        elif os.path.lexists(path) or not is_pattern(str(path)):
            matches = [path]
        else:
            pattern_start = next(number for number, part in enumerate(path.parts) if is_pattern(part))
            try:
                matches = of_pattern(
                    matching_files(Path(*path.parts[:pattern_start]), "/".join(path.parts[pattern_start:]))
                )
            except ValueError as error:
                problems.add(f"{path}: {error}", code="pattern-unusable")
                continue
        problems.add_if(not matches, f"{path}: no spectra found", expected=expected, code="file-not-found")
        files += matches
    problems.add_if(
        not files and not problems, "an empty list of files", mend="name at least one", code="empty-input"
    )
    problems.raise_if_any()
    return files


def for_all(items: Iterable[_T], function: Callable[[_T], _R]) -> list[_R]:
    # Return the results of a function for all items, in their order.
    # Raises FormatError: The function raised it for some items. One error lists each reason once, with its
    # items.
    outputs: list[_R] = []
    names_by_problem: dict[Problem, list[str]] = {}
    for item in items:
        try:
            outputs.append(function(item))
        except FormatError as error:
            name, _, found = error.problem.found.partition(": ")
            names_by_problem.setdefault(replace(error.problem, found=found), []).append(name)
    if names_by_problem:
        problems = [
            replace(problem, found=": ".join(filter(None, [", ".join(names), problem.found])))
            for problem, names in names_by_problem.items()
        ]
        raise FormatError("spectra cannot be used", problems=problems)
    return outputs


def same_grids(
    grids: Iterable[tuple[str, npt.NDArray[np.float64]]],
) -> list[tuple[npt.NDArray[np.float64], list[str]]]:
    # Return each distinct set of wavelengths with the names of its spectra.
    groups: dict[bytes, tuple[npt.NDArray[np.float64], list[str]]] = {}
    for name, wavelength in grids:
        groups.setdefault(wavelength.tobytes(), (wavelength, []))[1].append(name)
    return list(groups.values())


def require_one_grid(
    grids: Iterable[tuple[str, npt.NDArray[np.float64]]], advice: Callable[[], str] = str
) -> None:
    # Refuse spectra on several sets of wavelengths; ``advice`` completes the message.
    # Raises FormatError: There are several sets; each is listed with the names of its spectra.
    groups = same_grids(grids)
    if len(groups) > 1:
        problems = [
            Problem(
                f"{len(grid)} from {grid[0]:g} to {grid[-1]:g} nm"
                f"{', overlap kept' if np.any(np.diff(grid) <= 0.0) else ''}: {', '.join(names)}",
                code="grid-mismatch",
            )
            for grid, names in groups
        ]
        raise FormatError(
            "spectra differ in their wavelengths",
            mend=f"open them separately{advice()}",
            problems=problems,
            code="grid-mismatch",
        )


def common_quantity(quantities: Iterable[tuple[str | None, str]]) -> str:
    # Return the quantity that all files hold.
    # quantities: Quantity, None where unknown, and name of each file.
    # Raises FormatError: A quantity is unknown, or they differ; all are listed.
    names_by_quantity: dict[str | None, list[str]] = {}
    for quantity, name in quantities:
        names_by_quantity.setdefault(quantity, []).append(name)
    if len(names_by_quantity) > 1 or None in names_by_quantity:
        raise FormatError(
            "the spectra hold several or unknown quantities",
            mend="pass quantity=",
            problems=[
                Problem(f"{key or 'unknown'}: {', '.join(file_names)}", code="quantity-ambiguous")
                for key, file_names in names_by_quantity.items()
            ],
            code="quantity-ambiguous",
        )
    return next(str(quantity) for quantity in names_by_quantity)


def ratio(
    numerator: npt.NDArray[np.float64], denominator: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    # Return the ratio, NaN where the denominator is zero or undefined.
    quotient = np.full(numerator.shape, np.nan)
    with np.errstate(all="ignore"):  # values of damaged files; non-finite results are reported later
        np.divide(numerator, denominator, out=quotient, where=denominator != 0.0)
    return quotient


def name_spectra(sources: Sequence[tuple[Path, str]]) -> list[str]:
    """Return a distinct name for each spectrum.

    sources: File and name of each spectrum. Repeated names get their folder as prefix; if they still repeat,
        a number as suffix.

    Examples
    --------
    >>> name_spectra([(Path("a/red.sig"), "red"), (Path("b/red.sig"), "red"), (Path("b/blue.sig"), "blue")])
    ['a/red', 'b/red', 'blue']
    """
    count = Counter(name for _, name in sources)
    return unique_names(
        f"{path.parent.name}/{name}" if count[name] > 1 and path.parent.name else name
        for path, name in sources
    )


def check_utc_offset(hours: float) -> None:
    # Refuse local time minus UTC [h] beyond the offsets of all zones.
    # Raises TimeError: It is outside -14 to 14.
    TimeError.raise_if(
        not -14.0 <= hours <= 14.0,
        f"utc_offset_h={hours}",
        expected="local time minus UTC in hours, within -14 to 14",
        code="value-out-of-range",
    )


def listed(names: Sequence[str], max_names: int = 20) -> str:
    # Return the names as text, shortened to the first ``max_names``.
    remainder = f" and {len(names) - max_names} more" if len(names) > max_names else ""
    return ", ".join(names[:max_names]) + remainder


def warn_of(problem: str, names: Sequence[str], code: str) -> None:
    # Warn of a problem of the named files, if there are any.
    warn_if(names, f"{problem}. Files: {listed(names)}", code)
