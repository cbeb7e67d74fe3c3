"""The result of a validation: statistics, spectra, and a table to read."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

RELATIVE, FLOOR = "relative", "floor"  # parts of a tolerance of RMSE that grows with the paint's level

# statistics and tolerances by name, in the order of a validation's table
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
# tolerance of RMSE over level of the paint, beyond which a part is not judged: a paint twice as bright passes
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
            bad = [self._failure(row, int(column)) for column in np.flatnonzero(~within)]
            if bad:
                failures.append(f"{paints[row]} against {self._texts('reference')[row]}: {', '.join(bad)}")
        return (*failures, *(f"{name}: its reference is not there" for name in self.missing))

    def _failure(self, row: int, column: int) -> str:
        # with the reason where the part cannot be judged
        one = self.statistics.isel(pair=row, part=column)
        count, left = int(one["bands"]), int(one["bands_left_out"])
        if one["judged"]:
            return str(one["part"].item())
        reason = f"{count} of {count + left} bands, too few to judge"
        if float(one["rmse_limit"]) > MAX_TOLERANCE_SHARE * float(one["level"]):
            level, limit = float(one["level"]), float(one["rmse_limit"])
            reason = f"level {level:.4f}, too dark for a tolerance of {limit:.4f}"
        return f"{one['part'].item()} ({reason})"

    @property
    def verdict(self) -> str:
        """One line: number of pairs within the tolerance, and of paints that have a reference."""
        named = dict(self.tolerance)
        texts = []
        if RELATIVE in named:
            texts = [f"RMSE {named.pop(FLOOR):g} + {100.0 * named.pop(RELATIVE):g} % of the paint's level"]
        limits = ", ".join([*texts, *(f"{name} {limit:g}" for name, limit in named.items())])
        count = self.statistics.sizes["pair"]
        good = int(self.statistics["passes"].all("part").sum())
        paints = len(set(self._texts("signature")))
        whole = paints + len(self.unpaired_signatures)
        return (
            f"{good} of {count} pair{'' if count == 1 else 's'} within tolerance ({limits}), "
            f"{paints} of {whole} paint{'' if whole == 1 else 's'} compared"
        )

    def table(self) -> str:
        """Return all statistics as a text table, with remarks on each pair."""
        rows = self._rows()
        lines = aligned([_HEAD, *rows, *(self.between._rows() if self.between else [])], names=3)
        parts = [lines[0], "-" * len(lines[0]), *lines[1 : len(rows) + 1]]
        if self.between:
            parts += ["", "references against one another, the first minus the second:"]
            parts += lines[len(rows) + 1 :]
        parts += ["", *_LEGEND, *self._remarks(), self.verdict]
        return "\n".join("".join(sign if sign.isprintable() else "\ufffd" for sign in line) for line in parts)

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
                one = statistics.isel(pair=row, part=column)
                count, left = int(one["bands"]), int(one["bands_left_out"])
                if not count:
                    continue
                cells = []
                for name in STATISTICS:
                    cells.append(_with_uncertainty(float(one[name]), float(one[f"{name}_u"])))
                    if name == "rmse":
                        cells.append(_plain(float(one["rmse_limit"]), 4))
                verdict = "FAIL" if not one["passes"] else "pass" if one["judged"] else "not judged"
                names = paint, f"{reference} ({instrument})", str(one["part"].values)
                rows.append((*names, f"{count}/{count + left}", *cells, oxygen, verdict))
                oxygen = ""  # once a pair
        return rows

    def _remarks(self) -> list[str]:
        rows: dict[str, list[int]] = {}
        for row, texts in enumerate(self.notes):
            for text in (f"overlap of detectors: {self._texts('overlap')[row]}", *texts):
                rows.setdefault(text, []).append(row)
        remarks = [f"{self._whom(which)}: {text}" for text, which in rows.items()]
        for text, names in (
            ("without a reference", self.unpaired_signatures),
            ("references without a paint", self.unpaired_references),
        ):
            if names:
                remarks.append(f"{text}: {', '.join(names)}")
        return remarks

    def _whom(self, rows: Sequence[int]) -> str:
        instruments = self._texts("instrument")
        named = {instruments[row] for row in rows}
        if len(rows) == len(instruments):
            return "all"
        if len(named) == 1 and len(rows) == sum(name in named for name in instruments):
            return named.pop()
        paints = [_short(self._texts("signature")[row]) for row in rows]
        rest = len(paints) - _MAX_NAMES
        return ", ".join(paints[:_MAX_NAMES]) + (f" and {rest} more" if rest > 0 else "")


def _with_uncertainty(value: float, u: float) -> str:
    """Return a number rounded to the digits that its uncertainty leaves.

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
    # no sign of a zero; a dash for NaN
    text = f"{value:.{digits}f}"
    return "-" if not np.isfinite(value) else text.lstrip("-") if float(text) == 0.0 else text


def _short(name: str) -> str:
    return name if len(name) <= _MAX_NAME_CHARS else name[: _MAX_NAME_CHARS - 3] + "..."


def aligned(rows: Sequence[Sequence[str]], names: int = 1) -> list[str]:
    """Return rows of cells as lines: the first columns, of names, left-aligned, numbers right-aligned.

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
