"""The result of a validation: statistics, spectra, and a text table."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

#: Names of the two terms of a maximum RMSE that grows with the paint's level.
RELATIVE, FLOOR = "relative", "floor"

#: Names of statistics, in the order of a validation's table.
STATISTICS = ("bias", "rmse", "mae", "spectral_angle", "scale", "scale_free_error")

MEANINGS: Mapping[str, str] = {
    "bias": "Mean of signature minus reference",
    "rmse": "Root mean square of signature minus reference",
    "mae": "Mean of the absolute difference of signature and reference",
    "spectral_angle": "Angle between signature and reference",
    "scale": "Factor that brings the reference nearest to the signature",
    "scale_free_error": "Root mean square difference after the signature is divided by scale",
    "level": "Mean of the reference",
    "rmse_limit": "Largest RMSE that passes",
    "coverage": "Part of a band's response covered by both sides, the smallest of the bands used",
    "bands": "Bands that were compared",
    "bands_left_out": "Bands of the part that one side covers incompletely or has no value in",
    "passes": "Whether all limits are met, and the part is judged where it has to be",
    "judged": "Whether a part can be judged: enough bands, and a level well above the tolerance",
    "oxygen_residual": "Depth of the oxygen A band left in the signature; negative where overcorrected",
    "reference_oxygen_residual": "Depth of the oxygen A band left in the reference",
    "signature": "Name of the signature",
    "reference": "Names of the references",
    "instrument": "Instrument of the references",
    "overlap": "Treatment of overlapping detectors of the reference",
    "overlap_matched": "Whether the reference's values were changed to make detectors meet",
    "mirror_reflection": "Whether the reference includes the mirror image of sky and surroundings",
    "first_wavelength": "Wavelength that a part begins at",
    "last_wavelength": "Wavelength that a part ends before",
    "difference": "Signature minus reference",
    "signature_sd": "Standard deviation of the pixels averaged in the signature",
    "reference_sd": "Standard deviation of the readings averaged in the reference",
    "signature_u": "Standard uncertainty of the signature",
    "reference_u": "Standard uncertainty of the reference",
}

_HEAD = (
    "paint",
    "reference",
    "part",
    "bands",
    "bias",
    "RMSE",
    "limit",
    "MAE",
    "angle",
    "scale",
    "scale-free",
    "oxygen",
    "",
)
_LEGEND = (
    "differences of reflectance, signature minus reference; uncertainty of the last digits in brackets",
    "limit: largest RMSE that passes; angle in degrees; scale-free: RMSE after division by scale;",
    "oxygen: residual of signature / reference.",
)
#: Maximum tolerance of RMSE over the level of the paint for a part that is judged [1]: beyond, a paint with
#: half the reflectance would pass.
MAX_TOLERANCE_SHARE = 0.5

_MAX_NAMES = 6
_MAX_NAME_CHARS = 40


@dataclass(frozen=True, eq=False, repr=False)
class Validation:
    """Agreement of paint signatures with references, as returned by `hyperpaint.validate`.

    Attributes
    ----------
    statistics
        Dataset on (pair, part): ``bias``, ``rmse``, ``mae``, ``scale``, ``scale_free_error`` [1] and
        ``spectral_angle`` [degree], each with its standard uncertainty ``<name>_u`` (NaN where unknown);
        ``level``, ``rmse_limit``, ``bands``, ``bands_left_out``, ``coverage``, ``judged`` and ``passes``; on
        (pair,) ``oxygen_residual`` and ``reference_oxygen_residual``, and the pair compared: ``signature``,
        ``reference``, ``instrument``, ``overlap``, ``overlap_matched``.
    spectra
        A Dataset (band) per pair: ``signature``, ``reference``, ``difference``, their uncertainties where
        known, and the ``coverage`` of every band, used or not.
    notes
        Remarks on every pair.
    unpaired_signatures, unpaired_references
        Names without a counterpart.
    missing
        Names of signatures whose required reference is absent.
    tolerance
        Limits by name of a statistic, and ``relative`` and ``floor``.
    between
        Agreement of the references of one paint where several instruments measured it, one pair for two
        instruments. It does not decide whether signatures pass.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> from hyperpaint.validation import validate
    >>> nm = np.linspace(400.0, 700.0, 61)
    >>> axis = {"wavelength": ("band", nm, {"units": "nm"}), "signature": ["hood"]}
    >>> level = 0.2 + 0.001 * (nm - 400.0)
    >>> field = xr.Dataset({"reflectance": (("signature", "band"), [level], {"units": "1"})}, axis)
    >>> paints = field.assign(reflectance=field.reflectance + 0.002)
    >>> agreement = validate(paints, field, reference_fwhm=5.0)
    >>> agreement.passed, agreement.statistics.bias.sel(part="VIS").values.round(3)
    (True, array([0.002]))
    """

    statistics: xr.Dataset
    spectra: tuple[xr.Dataset, ...]
    notes: tuple[tuple[str, ...], ...]
    unpaired_signatures: tuple[str, ...]
    unpaired_references: tuple[str, ...]
    missing: tuple[str, ...]
    tolerance: Mapping[str, float]
    between: Validation | None = None

    @property
    def passed(self) -> bool:
        """Whether every pair is judged and within the tolerance, and no reference is missing."""
        return bool(self.statistics["passes"].all()) and not self.missing

    @property
    def problems(self) -> tuple[str, ...]:
        """Pairs outside of the tolerance or impossible to judge, and missing references, one text each."""
        failures = []
        paints = self._texts("signature")
        for row, within in enumerate(self.statistics["passes"].values):
            texts = [self._failure(row, int(column)) for column in np.flatnonzero(~within)]
            if texts:
                failures.append(f"{paints[row]} against {self._texts('reference')[row]}: {', '.join(texts)}")
        return (*failures, *(f"{name}: its reference is missing" for name in self.missing))

    def _failure(self, row: int, column: int) -> str:
        # Name of a part, with the reason where it cannot be judged
        cell = self.statistics.isel(pair=row, part=column)
        count, excluded = int(cell["bands"]), int(cell["bands_left_out"])
        if cell["judged"]:
            return str(cell["part"].item())
        reason = f"{count} of {count + excluded} bands, too few to judge"
        if float(cell["rmse_limit"]) > MAX_TOLERANCE_SHARE * float(cell["level"]):
            level, limit = float(cell["level"]), float(cell["rmse_limit"])
            reason = f"level {level:.4f}, too dark for a tolerance of {limit:.4f}"
        return f"{cell['part'].item()} ({reason})"

    @property
    def verdict(self) -> str:
        """One line: number of pairs within the tolerance, and of paints with a reference."""
        tolerance = dict(self.tolerance)
        texts = []
        if RELATIVE in tolerance:
            floor, share = tolerance.pop(FLOOR), tolerance.pop(RELATIVE)
            texts = [f"RMSE {floor:g} + {100.0 * share:g} % of the paint's level"]
        limits = ", ".join([*texts, *(f"{name} {limit:g}" for name, limit in tolerance.items())])
        pairs = self.statistics.sizes["pair"]
        passed = int(self.statistics["passes"].all("part").sum())
        compared = len(set(self._texts("signature")))
        paints = compared + len(self.unpaired_signatures)
        return (
            f"{passed} of {pairs} pair{'' if pairs == 1 else 's'} within tolerance ({limits}), "
            f"{compared} of {paints} paint{'' if paints == 1 else 's'} compared"
        )

    def table(self) -> str:
        """Return all statistics as a text table, with remarks on each pair."""
        rows = self._rows()
        lines = aligned([_HEAD, *rows, *(self.between._rows() if self.between else [])], names=3)
        text = [lines[0], "-" * len(lines[0]), *lines[1 : len(rows) + 1]]
        if self.between:
            text += ["", "references against one another, the first minus the second:"]
            text += lines[len(rows) + 1 :]
        text += ["", *_LEGEND, *self._remarks(), self.verdict]
        return "\n".join("".join(sign if sign.isprintable() else "\ufffd" for sign in line) for line in text)

    def __repr__(self) -> str:
        return f"<Validation>\n{self.table()}"

    def _repr_html_(self) -> str:
        cell = "padding:1px 10px 1px 0;text-align:right"
        table_rows = [*self._rows(), *(self.between._rows() if self.between else [])]
        rows = "".join(
            "<tr>" + "".join(f'<{tag} style="{cell}">{html.escape(text)}</{tag}>' for text in row) + "</tr>"
            for tag, row in [("th", _HEAD), *(("td", row) for row in table_rows)]
        )
        remarks = "".join(f"<li>{html.escape(text)}</li>" for text in (*self._remarks(), *_LEGEND))
        return (
            f'<div style="font:13px/1.45 system-ui,sans-serif"><strong>{html.escape(self.verdict)}</strong>'
            f'<table style="border-collapse:collapse">{rows}</table><ul>{remarks}</ul></div>'
        )

    def _texts(self, name: str) -> list[str]:
        return [str(text) for text in self.statistics[name].values]

    def _rows(self) -> list[tuple[str, ...]]:
        statistics = self.statistics
        rows: list[tuple[str, ...]] = []
        for row in range(statistics.sizes["pair"]):
            paint, reference, instrument = (
                _short(self._texts(name)[row]) for name in ("signature", "reference", "instrument")
            )
            oxygen = " / ".join(
                _plain(float(self.statistics[name][row]), 3)
                for name in ("oxygen_residual", "reference_oxygen_residual")
            )
            for column in range(statistics.sizes["part"]):
                part = statistics.isel(pair=row, part=column)
                count, excluded = int(part["bands"]), int(part["bands_left_out"])
                if not count:
                    continue
                cells = []
                for name in STATISTICS:
                    cells.append(_with_uncertainty(float(part[name]), float(part[f"{name}_u"])))
                    if name == "rmse":
                        cells.append(_plain(float(part["rmse_limit"]), 4))
                verdict = "FAIL" if not part["passes"] else "pass" if part["judged"] else "not judged"
                names = paint, f"{reference} ({instrument})", str(part["part"].values)
                rows.append((*names, f"{count}/{count + excluded}", *cells, oxygen, verdict))
                oxygen = ""  # only in the first row of a pair
        return rows

    def _remarks(self) -> list[str]:
        # notes of the pairs, each once with the pairs it is about, and unpaired names
        rows_of_text: dict[str, list[int]] = {}
        for row, texts in enumerate(self.notes):
            for text in (f"overlap of detectors: {self._texts('overlap')[row]}", *texts):
                rows_of_text.setdefault(text, []).append(row)
        remarks = [f"{self._pair_names(rows)}: {text}" for text, rows in rows_of_text.items()]
        unpaired = {
            "without a reference": self.unpaired_signatures,
            "references without a paint": self.unpaired_references,
        }
        return [*remarks, *(f"{text}: {', '.join(names)}" for text, names in unpaired.items() if names)]

    def _pair_names(self, rows: Sequence[int]) -> str:
        # "all", the instrument that all these pairs and no others share, or the paints
        instruments = self._texts("instrument")
        instruments_of_rows = {instruments[row] for row in rows}
        if len(rows) == len(instruments):
            return "all"
        if len(instruments_of_rows) == 1 and len(rows) == sum(
            name in instruments_of_rows for name in instruments
        ):
            return instruments_of_rows.pop()
        paints = [_short(self._texts("signature")[row]) for row in rows]
        more = len(paints) - _MAX_NAMES
        return ", ".join(paints[:_MAX_NAMES]) + (f" and {more} more" if more > 0 else "")


def _with_uncertainty(value: float, u: float) -> str:
    """Return a number rounded to two digits of its uncertainty, which follow in brackets.

    Examples
    --------
    >>> _with_uncertainty(0.01234, 0.0021), _with_uncertainty(-0.5, float("nan"))
    ('0.0123(21)', '-0.5000')
    """
    if not (np.isfinite(value) and np.isfinite(u) and u > 0.0):
        return _plain(value, 4)
    digits = min(max(1 - int(np.floor(np.log10(u))), 0), 5)
    return f"{_plain(value, digits)}({round(u * 10**digits)})"


def _plain(value: float, digits: int) -> str:
    # Number without the sign of a zero; a dash for NaN
    text = f"{value:.{digits}f}"
    return "-" if not np.isfinite(value) else text.lstrip("-") if float(text) == 0.0 else text


def _short(name: str) -> str:
    return name if len(name) <= _MAX_NAME_CHARS else name[: _MAX_NAME_CHARS - 3] + "..."


def aligned(rows: Sequence[Sequence[str]], names: int = 1) -> list[str]:
    """Return rows of cells as lines of text: the first ``names`` columns left-aligned, others right-aligned.

    Examples
    --------
    >>> aligned([("paint", "pixels"), ("red", "9")])
    ['paint  pixels', 'red         9']
    """
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return [
        "  ".join(
            cell.ljust(width) if column < names else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]
