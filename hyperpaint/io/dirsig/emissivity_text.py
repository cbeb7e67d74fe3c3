"""Spectra as text, fast: a curve's text is the same for all curves but for its digits."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from hyperpaint.base.errors import SchemaError

__all__ = ["CURVE_BEGIN", "DECIMALS", "WAVELENGTH_DECIMALS", "ColumnText", "emissivity_head"]

CURVE_BEGIN = "CURVE_BEGIN"
"""Line before every curve of a new ``.ems`` file."""

DECIMALS = 6
"""Of an emissivity or reflectance, as DIRSIG's own files have them."""

WAVELENGTH_DECIMALS = 7
"""Of a wavelength in micrometres: a ten-thousandth of a nanometre."""

_ANGLES = 91


def emissivity_head(count: int) -> bytes:
    """Return the first lines of an ``.ems`` file: the number of curves, and a weight for every degree.

    The weights are 1, as nearly all files have them: what an imager measured holds for its own view only.

    Examples
    --------
    >>> emissivity_head(3).split()[:3], len(emissivity_head(3).split())
    ([b'3', b'1.0', b'1.0'], 92)
    """
    return f"{count}\n".encode() + b"1.0\n" * _ANGLES


class ColumnText:
    r"""Writes spectra on one set of wavelengths as two columns, wavelength [um] and value [1].

    The digits of all values of many spectra are worked out at once, by whole-number division; the rest of the
    text is copied.

    Parameters
    ----------
    wavelength
        Ascending [nm].
    title
        Line before every spectrum; none by default.

    Raises
    ------
    SchemaError
        Wavelengths are not ascending as they are written.

    Examples
    --------
    >>> ColumnText([400.0, 702.5]).text(np.array([[0.25, 1.0]]))
    b'0.4000000\t0.250000\n0.7025000\t1.000000\n'
    """

    def __init__(self, wavelength: Sequence[float] | npt.NDArray[Any], title: str = "") -> None:
        written = [f"{value / 1000.0:.{WAVELENGTH_DECIMALS}f}" for value in np.asarray(wavelength, float)]
        steps = itertools.pairwise(zip(map(float, written), written, strict=True))
        if equal := next((one[1] for one, other in steps if other[0] <= one[0]), ""):
            raise SchemaError(
                f"two wavelengths at or below {equal} um in turn, expected them to ascend; keep one of them"
            )
        head = f"{title}\n" if title else ""
        rows = [f"{text}\t0.{'0' * DECIMALS}\n" for text in written]
        self._template = np.frombuffer((head + "".join(rows)).encode(), np.uint8)
        self._runs: list[tuple[slice, slice, int]] = []
        start, row = len(head), 0
        # rows of one width lie in memory like a table
        for width, group in itertools.groupby(map(len, rows)):
            count = len(list(group))
            self._runs.append((slice(start, start + count * width), slice(row, row + count), width))
            start, row = start + count * width, row + count

    def text(self, values: npt.NDArray[Any]) -> bytes:
        """Return the text of spectra (spectrum, wavelength) between 0 and 1."""
        left = np.rint(np.asarray(values, np.float64) * 10**DECIMALS).astype(np.uint32)
        texts = np.repeat(self._template[np.newaxis], len(left), axis=0)
        tables = [
            (texts[:, place].reshape(len(left), -1, width), columns) for place, columns, width in self._runs
        ]
        for digit in range(DECIMALS + 1):
            rest = left // np.uint32(10)
            shown = (left - rest * np.uint32(10)).astype(np.uint8) + np.uint8(ord("0"))
            # counted from the end of the row: the line feed, the decimals, the point, the whole number
            at = -2 - digit if digit < DECIMALS else -3 - digit
            for table, columns in tables:
                table[:, :, at] = shown[:, columns]
            left = rest
        return texts.tobytes()
