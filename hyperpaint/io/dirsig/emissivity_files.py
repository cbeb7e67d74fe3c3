"""DIRSIG's spectral emissivity (``.ems``) files.

An ``.ems`` file is text: the number of curves, 91 weights for view angles of 0 to 90 degrees, then the
curves. In the new layout a curve begins with the line ``CURVE_BEGIN``, and its rows are wavelength [um],
ascending, and emissivity. In the old layout a curve begins with its number, from 0, and has the 396 rows of
wavenumbers 39850, 39750, ... 350 [cm-1] and emissivity.

Several curves are the variability within a material: DIRSIG's texture selects one for every point.

References
----------
.. [1] DIRSIG manual, "Emissivity Files", https://dirsig.cis.rit.edu/docs/new/ems.html
"""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import FormatError, Problems, SchemaError
from hyperpaint.base.schema import BAND, LIBRARY_VARIABLES, MEMBER, SIGNATURE
from hyperpaint.io.files.reading import read_limited_text

#: Line before every curve in the new layout of an ``.ems`` file.
CURVE_BEGIN = "CURVE_BEGIN"

#: Decimals of an emissivity or reflectance, as in files of DIRSIG's distribution.
DECIMALS = 6

#: Decimals of a wavelength [um]: a ten-thousandth of a nanometre.
WAVELENGTH_DECIMALS = 7

_ANGLES = 91


def emissivity_head(count: int) -> bytes:
    """Return the first lines of an ``.ems`` file: the number of curves, and a weight for every degree.

    All weights are 1, as in nearly all files, since an imager measures at one view angle only.

    Examples
    --------
    >>> emissivity_head(3).split()[:3], len(emissivity_head(3).split())
    ([b'3', b'1.0', b'1.0'], 92)
    """
    return f"{count}\n".encode() + b"1.0\n" * _ANGLES


class ColumnText:
    r"""Format of spectra with common wavelengths as two columns, wavelength [um] and value [1].

    The digits of the values of many spectra are computed together, by integer division, and inserted into
    copies of a template.

    ``wavelength``: ascending [nm]; ``title``: line before every spectrum, empty for none.

    Raises `SchemaError`: Wavelengths rounded to the written decimals are not ascending.

    Examples
    --------
    >>> ColumnText([400.0, 702.5]).text(np.array([[0.25, 1.0]]))
    b'0.4000000\t0.250000\n0.7025000\t1.000000\n'
    """

    def __init__(self, wavelength: Sequence[float] | npt.NDArray[Any], title: str = "") -> None:
        micrometres = [f"{nm / 1000.0:.{WAVELENGTH_DECIMALS}f}" for nm in np.asarray(wavelength, float)]
        pairs = itertools.pairwise(micrometres)
        if equal := next((text for text, following in pairs if float(following) <= float(text)), ""):
            raise SchemaError(
                f"two successive wavelengths at or below {equal} um",
                expected="ascending wavelengths",
                mend="keep one of them",
                code="wavelength-unordered",
            )
        head = f"{title}\n" if title else ""
        rows = [f"{text}\t0.{'0' * DECIMALS}\n" for text in micrometres]
        self._template = np.frombuffer((head + "".join(rows)).encode(), np.uint8)
        # Successive rows of equal width: their bytes, their indices, their width
        self._runs: list[tuple[slice, slice, int]] = []
        start, row = len(head), 0
        for width, group in itertools.groupby(map(len, rows)):
            count = len(list(group))
            self._runs.append((slice(start, start + count * width), slice(row, row + count), width))
            start, row = start + count * width, row + count

    def text(self, values: npt.NDArray[Any]) -> bytes:
        """Return the text of spectra (spectrum, wavelength) between 0 and 1."""
        digits_left = np.rint(np.asarray(values, np.float64) * 10**DECIMALS).astype(np.uint32)
        texts = np.repeat(self._template[np.newaxis], len(digits_left), axis=0)
        # views of shape (spectrum, row, character)
        tables = [
            (texts[:, text_slice].reshape(len(digits_left), -1, width), columns)
            for text_slice, columns, width in self._runs
        ]
        for digit in range(DECIMALS + 1):
            quotient = digits_left // np.uint32(10)
            characters = (digits_left - quotient * np.uint32(10)).astype(np.uint8) + np.uint8(ord("0"))
            # position from the end of the row, after the line feed; the point is before the decimals
            at = -2 - digit if digit < DECIMALS else -3 - digit
            for table, columns in tables:
                table[:, :, at] = characters[:, columns]
            digits_left = quotient
        return texts.tobytes()


#: Largest ``.ems`` file [bytes]: a thousand curves of 2000 wavelengths have some 36 MB.
MAX_BYTES = 128 * 2**20

MAX_CURVES = 100_000
_WAVENUMBERS = np.arange(39850.0, 349.0, -100.0)
_MAX_WAVELENGTH_UM = 100.0  # [um]
_MAX_SHOWN = 8

# possessive quantifiers, so that a long line is read once
_NUMBER = rb"[+-]?+(?:[0-9]{1,40}+(?:\.[0-9]{0,40}+)?+|\.[0-9]{1,40}+)(?:[eE][+-]?+[0-9]{1,4}+)?+"
_ROW = rb"[ \t]*+" + _NUMBER + rb"[ \t]++" + _NUMBER + rb"[ \t]*+"
_ONE_NUMBER = re.compile(rb"[ \t]*+" + _NUMBER + rb"[ \t]*+")
_COUNT = re.compile(rb"[ \t]*+([0-9]{1,9}+)[ \t]*+")
_ONE_ROW = re.compile(_ROW)
_ROWS = re.compile(rb"(?:" + _ROW + rb"\n)++(?:[ \t]*+\n)*+")
_NEW_MARK = re.compile(rb"^[ \t]*+CURVE_BEGIN[ \t]*+\n", re.MULTILINE)
_OLD_MARK = re.compile(rb"^[ \t]*+([0-9]{1,9}+)[ \t]*+\n", re.MULTILINE)


@dataclass(frozen=True, eq=False)
class Curve:
    """One spectrum."""

    wavelength: Floats  # Ascending (wavelength,) [um]
    emissivity: Floats  # (wavelength,) [1]


@dataclass(frozen=True, eq=False)
class Emissivity:
    """Content of an ``.ems`` file."""

    weights: Floats  # Factor on emissivity at 0, 1, ... 90 degrees from the normal (91,) [1]
    curves: tuple[Curve, ...]  # One or more
    layout: str  # ``new`` or ``old``


def read_emissivity(path: str | os.PathLike[str]) -> Emissivity:
    """Read a spectral emissivity file of the old or new layout.

    Raises
    ------
    FormatError
        The file cannot be read, or differs from the format in `hyperpaint.io.dirsig.emissivity_files`: the
        number of curves is not that of the first line, wavelengths do not ascend or are not in micrometres,
        emissivity is outside 0 to 1, or there is other text; all are listed.
    """
    return _parse(read_limited_text(Path(path), MAX_BYTES, "a DIRSIG emissivity file"), os.fspath(path))


def _parse(data: bytes, name: str) -> Emissivity:
    problems = Problems(f"{name} is not a DIRSIG emissivity file", FormatError)
    text = data.replace(b"\r\n", b"\n") if b"\r" in data else data
    if not text.endswith(b"\n"):
        text += b"\n"
    lines = text.split(b"\n", _ANGLES + 1)
    match = _COUNT.fullmatch(lines[0])
    count = int(match[1]) if match else 0
    if not 1 <= count <= MAX_CURVES:
        problems.add(
            f"line 1: {_shown(lines[0])}",
            expected=f"a number of curves, 1 to {MAX_CURVES}",
            code="number-unreadable",
        )
    if len(lines) < _ANGLES + 2:
        problems.add(
            f"{len(lines) - 1} lines",
            expected=f"the number of curves, {_ANGLES} weights and curves",
            code="file-truncated",
        )
        problems.raise_if_any()
    weights = _weights(lines[1:-1], problems)
    problems.raise_if_any()
    layout, curves = _curves(lines[-1], count, problems)
    problems.raise_if_any()
    return Emissivity(weights, tuple(curves), layout)


def _weights(lines: list[bytes], problems: Problems) -> Floats:
    unreadable = [angle for angle, line in enumerate(lines) if not _ONE_NUMBER.fullmatch(line)]
    for angle in unreadable[:_MAX_SHOWN]:
        problems.add(
            f"line {angle + 2}: {_shown(lines[angle])}",
            expected=f"the weight of {angle} degrees",
            code="number-unreadable",
        )
    if unreadable:
        return np.ones(_ANGLES)
    weights = np.array([float(line) for line in lines])
    if not (np.isfinite(weights).all() and weights.min() >= 0.0):
        problems.add(
            "a weight of a view angle is negative or not finite",
            expected="0 or more",
            code="value-out-of-range",
        )
    return weights


def _curves(body: bytes, count: int, problems: Problems) -> tuple[str, list[Curve]]:
    # Layout, and curves after the weights
    start = body.rfind(b"\n", 0, len(body) - len(body.lstrip(b" \t\n"))) + 1  # first line with text
    is_new = _NEW_MARK.match(body, start) is not None
    if not is_new and not _OLD_MARK.match(body, start):
        line = _ANGLES + 2 + body.count(b"\n", 0, start)
        row = body[start : body.find(b"\n", start)]
        problems.add(
            f"line {line}: {_shown(row)}",
            expected=f"{CURVE_BEGIN} or the number 0 of a curve",
            code="row-unreadable",
        )
        return "", []
    layout, mark = ("new", _NEW_MARK) if is_new else ("old", _OLD_MARK)
    marks = list(mark.finditer(body, start))
    if len(marks) != count:
        problems.add(
            f"{len(marks)} curves",
            expected=f"{count}, as line 1 says",
            mend="check whether the file is cut off",
            code="length-mismatch",
        )
        return layout, []
    curves = []
    ends = [mark.start() for mark in marks[1:]] + [len(body)]
    line = _ANGLES + 3 + body.count(b"\n", 0, start)
    for number, (heading, end) in enumerate(zip(marks, ends, strict=True)):
        if not is_new and int(heading[1]) != number:
            problems.add(
                f"line {line - 1}: curve {int(heading[1])}", expected=str(number), code="row-unreadable"
            )
        rows = body[heading.end() : end]
        if (table := _table(rows, line, problems)) is not None:
            axis, emissivity = table.T.copy()
            subject = f"curve {number}, from line {line}"
            if not is_new and not np.array_equal(axis, _WAVENUMBERS):
                problems.add(
                    f"{subject}: {len(axis)} rows",
                    expected=f"the {len(_WAVENUMBERS)} wavenumbers 39850, 39750, ... 350 [cm-1]",
                    code="grid-mismatch",
                )
            elif not np.isfinite(axis).all() or axis[0] <= 0.0 or (is_new and (np.diff(axis) <= 0.0).any()):
                problems.add(
                    f"{subject}: wavelengths do not ascend from above 0",
                    mend="sort the rows, and keep one per wavelength",
                    code="wavelength-unordered",
                )
            elif is_new and axis[-1] > _MAX_WAVELENGTH_UM:
                problems.add(
                    f"{subject}: wavelengths up to {axis[-1]:g}",
                    expected="micrometres",
                    mend="divide nanometres by 1000",
                    code="wavelength-range",
                )
            elif not (np.isfinite(emissivity).all() and emissivity.min() >= 0.0 and emissivity.max() <= 1.0):
                problems.add(
                    f"{subject}: emissivity from {emissivity.min():g} to {emissivity.max():g}",
                    expected="0 to 1",
                    mend="divide percent by 100",
                    code="value-out-of-range",
                )
            else:
                curves.append(Curve(axis if is_new else 1e4 / axis, emissivity))
        if len(problems) >= _MAX_SHOWN:
            break
        line += rows.count(b"\n") + 1
    return layout, curves


def _table(rows: bytes, line: int, problems: Problems) -> Floats | None:
    # Array of rows with two numbers (row, 2), None for other text
    if _ROWS.fullmatch(rows):
        return np.array(rows.split(), np.float64).reshape(-1, 2)
    if not rows.strip():
        problems.add(
            f"line {line}: a curve without rows", expected="wavelength and emissivity", code="table-missing"
        )
        return None
    lines = rows.rstrip(b" \t\n").split(b"\n")
    unreadable = next((number for number, row in enumerate(lines) if not _ONE_ROW.fullmatch(row)), 0)
    problems.add(
        f"line {line + unreadable}: {_shown(lines[unreadable])}",
        expected="two numbers",
        code="row-unreadable",
    )
    return None


def _shown(line: bytes) -> str:
    return repr(line[:60].decode("ascii", "replace"))


def open_emissivity(path: str | os.PathLike[str]) -> xr.Dataset:
    """Open an ``.ems`` file as a paint library of one opaque paint, with its curves as members.

    Returns
    -------
    Dataset
        ``member_reflectance`` (signature, member, band) = 1 - emissivity and ``reflectance`` (signature,
        band), their mean, float32 [1]; ``wavelength`` (band) [nm]. Weights of view angles are ignored.

    Raises
    ------
    FormatError
        As `read_emissivity`; or its curves have different wavelengths.
    """
    path = Path(path)
    file = read_emissivity(path)
    wavelength = file.curves[0].wavelength
    if not all(np.array_equal(curve.wavelength, wavelength) for curve in file.curves):
        raise FormatError(
            f"{path}: the curves have different wavelengths",
            expected="equal wavelengths",
            mend="read each curve with read_emissivity",
            code="grid-mismatch",
        )
    members = 1.0 - np.array([curve.emissivity for curve in file.curves])
    centre = members.mean(axis=0, dtype=np.float64)[np.newaxis].astype(np.float32)
    about_centre = {"units": "1", "long_name": "Reflectance, mean of the curves"}
    about_members = {"units": "1", "long_name": "Reflectance of a curve"}
    # nm rounded to the decimals that are written, so that reading and writing again gives the same text
    return xr.Dataset(
        {
            "reflectance": ((SIGNATURE, BAND), centre, about_centre),
            "member_reflectance": (
                (SIGNATURE, MEMBER, BAND),
                members[np.newaxis].astype(np.float32),
                about_members,
            ),
        },
        {
            SIGNATURE: np.array([path.stem], object),
            "wavelength": (BAND, np.round(wavelength * 1e3, 10), LIBRARY_VARIABLES["wavelength"].attrs),
        },
        {"source": path.name, "layout": f"DIRSIG emissivity, {file.layout}"},
    )
