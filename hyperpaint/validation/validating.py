"""Validation of paint signatures: pairs with references by name, on common bands, and their agreement.

Spectra of paint libraries and spectrometer datasets are prepared: names, values, uncertainties and channels
on one axis of wavelengths; readings outside of a clear coat and of the body under it are distinguished, and
converted where possible.

The result has statistics, spectra, and a text table.
"""

import functools
import html
import itertools
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePath
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from hyperpaint.alignment import oxygen_depth
from hyperpaint.base import (
    BAND,
    BODY,
    EXCLUDED,
    FLAKE_PAINTS,
    INCLUDED,
    LIBRARY_VARIABLES,
    OUTSIDE,
    SIGNATURE,
    THROUGH_COAT,
    Bools,
    Floats,
    Indices,
    Problem,
    Problems,
    SchemaError,
    UnitsError,
    convert,
    documented,
    find,
    grouped,
    listed,
    mirror_reflection,
    one_of,
    require,
    takes_quantities,
    warn_user,
    with_band_dim,
)
from hyperpaint.light.coat_transmission import (
    COAT_INDEX,
    COAT_INDEX_U,
    interface_reflectance,
    sky_reflectance,
)
from hyperpaint.light.diffuse_record import SKY_STATES
from hyperpaint.light.responses import Responses, matching_operator
from hyperpaint.light.sun import diffuse_fraction, solar_position
from hyperpaint.paints.band_ratios import covariance
from hyperpaint.radiometry.panels import LAMBERTIAN, check_surface, is_lambertian, panel_factor

#: Metres in a degree of latitude.
_METRES_PER_DEGREE = 111_195.0

#: Latitude and longitude [degree]; None where unknown.
Place = tuple[float, float] | None


class PlaceMatch(NamedTuple):
    # The paint at the place of a reference, or the reason why there is none.
    paint: int | None  #: Key of the paint.
    text: str
    near: frozenset[int]  #: Keys of paints within the accuracy.


def match_places(
    paints: Mapping[int, tuple[float, float]],
    names: Mapping[int, str],
    references: Sequence[Place],
    instruments: Sequence[str],
    accuracy_m: float,
) -> dict[int, PlaceMatch]:
    """Return the nearest paint of every reference, by the number of the reference.

    ``paints``: latitude and longitude [degree] by key; ``names``: names of paints; ``accuracy_m``: a paint
    beyond this distance is no match, nor is a paint where the next one is less than this farther away [m].
    Several references of one of the ``instruments`` at one paint may be readings of it or of other paints:
    none is a match.

    Examples
    --------
    >>> paints = {0: (43.0, -77.0), 1: (43.0, -76.9999)}
    >>> places = [(43.00001, -77.0), (43.0, -76.99995), (43.001, -77.0)]
    >>> for match in match_places(paints, {0: "red-01", 1: "red-02"}, places, ["SVC"] * 3, 5.0).values():
    ...     print(match.paint, match.text)
    0 1.1 m from red-01, 8.2 m from the next paint
    None ambiguous: 4.1 m from red-01, 4.1 m from red-02, with an accuracy of 5 m
    None 111.2 m from the nearest paint red-01, beyond 5 m
    """
    keys = list(paints)
    at = np.array(list(paints.values()), np.float64).reshape(-1, 2)
    matches = {}
    for number, place in enumerate(references):
        if place is None or not keys:
            continue
        steps = (at - place) * _METRES_PER_DEGREE
        distances = np.hypot(steps[:, 0], steps[:, 1] * np.cos(np.radians(place[0])))
        first, *others = np.argsort(distances, kind="stable")
        name, distance, paint = names[keys[first]], distances[first], None
        if distance > accuracy_m:
            text = f"{distance:.1f} m from the nearest paint {name}, beyond {accuracy_m:g} m"
        elif others and distances[others[0]] - distance < accuracy_m:
            further = f"{distances[others[0]]:.1f} m from {names[keys[others[0]]]}"
            text = f"ambiguous: {distance:.1f} m from {name}, {further}, with an accuracy of {accuracy_m:g} m"
        else:
            further = f", {distances[others[0]]:.1f} m from the next paint" if others else ""
            paint, text = keys[first], f"{distance:.1f} m from {name}{further}"
        matches[number] = PlaceMatch(
            paint, text, frozenset(keys[k] for k in np.flatnonzero(distances <= accuracy_m))
        )
    counts = Counter((match.paint, instruments[number]) for number, match in matches.items())
    for number, match in matches.items():
        count = counts[match.paint, instruments[number]]
        if match.paint is not None and count > 1:
            text = f"{match.text}, as {count - 1} more of its instrument: readings of it, or of other paints"
            matches[number] = match._replace(paint=None, text=text)
    return matches


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
    "uncertainty": "Unknown parts of the signature's uncertainty; empty where all parts are known",
    "exclusion": "Reason why a pair cannot be judged; empty without one",
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

#: Accuracy of positions by default [m]: of a handheld GPS receiver, beside a car whose roof is measured.
PLACE_ACCURACY_M = 5.0

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
    remarks
        Texts of the warnings of the comparison.

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
    between: "Validation | None" = None
    remarks: tuple[str, ...] = ()

    @property
    def passed(self) -> bool:
        """Whether every pair is judged and within the tolerance, and no reference is missing."""
        return bool(self.statistics["passes"].all()) and not self.missing

    @property
    def problems(self) -> tuple[str, ...]:
        """Pairs outside of the tolerance or impossible to judge, and missing references, one text each."""
        failures = (
            ", ".join(self._failure(row, int(column)) for column in np.flatnonzero(~within))
            for row, within in enumerate(self.statistics["passes"].values)
        )
        names = map(self._texts, ("signature", "reference", "instrument"))
        return (
            *(
                f"{paint} against {reference} of {instrument}: {failure}"
                for paint, reference, instrument, failure in zip(*names, failures, strict=True)
                if failure
            ),
            *(f"{name}: its reference is missing" for name in self.missing),
        )

    def _failure(self, row: int, column: int) -> str:
        # Name of a part, with the reason where it cannot be judged
        cell = self.statistics.isel(pair=row, part=column)
        count, excluded = int(cell["bands"]), int(cell["bands_left_out"])
        if cell["judged"]:
            return str(cell["part"].item())
        level, limit = float(cell["level"]), float(cell["rmse_limit"])
        reason = cell["exclusion"].item() or (
            f"level {level:.4f}, too dark for a tolerance of {limit:.4f}, above "
            f"{MAX_TOLERANCE_SHARE:.0%} of it"
            if limit > MAX_TOLERANCE_SHARE * level
            else f"{count} of {count + excluded} bands, too few to judge"
        )
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
        is_judged = self.statistics["exclusion"] == ""
        pairs = int(is_judged.sum())
        excluded = is_judged.size - pairs
        passed = int((self.statistics["passes"].all("part") & is_judged).sum())
        compared = len(set(self._texts("signature")))
        paints = compared + len(self.unpaired_signatures)
        return (
            f"{passed} of {pairs} pair{'' if pairs == 1 else 's'} within tolerance ({limits}), "
            f"{compared} of {paints} paint{'' if paints == 1 else 's'} compared"
            + (f", {excluded} pair{'' if excluded == 1 else 's'} not judged" if excluded else "")
        )

    def table(self) -> str:
        """Return all statistics as a text table, with remarks on each pair."""
        rows = self._rows()
        lines = aligned([_HEAD, *rows, *(self.between._rows() if self.between else [])], names=3)
        text = [lines[0], "-" * len(lines[0]), *lines[1 : len(rows) + 1]]
        if self.between:
            title = "references against one another, the first minus the second:"
            text += ["", title, *lines[len(rows) + 1 :]]
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
                    # no digits in brackets where a part of the signature's uncertainty is unknown
                    u = float(part[f"{name}_u"]) if part["uncertainty"].item() == "" else np.nan
                    cells.append(_with_uncertainty(float(part[name]), u))
                    if name == "rmse":
                        cells.append(_plain(float(part["rmse_limit"]), 4))
                limits = {name: limit for name, limit in self.tolerance.items() if name in STATISTICS}
                limits["rmse"] = float(part["rmse_limit"])
                is_outside = any(abs(float(part[n]) - (n == "scale")) > limit for n, limit in limits.items())
                verdict = "pass" if part["passes"] else "FAIL"
                if not part["judged"] and not is_outside:
                    verdict = "not judged"
                names = paint, f"{reference} ({instrument})", str(part["part"].values)
                rows.append((*names, f"{count}/{count + excluded}", *cells, oxygen, verdict))
                oxygen = ""  # only in the first row of a pair
        return rows

    def _remarks(self) -> list[str]:
        # notes of the pairs, each once with the pairs it is about, and unpaired names
        def unjudged(row: int) -> list[str]:
            failing = (~self.statistics["passes"] & ~self.statistics["judged"]).values[row]
            failures = [self._failure(row, int(column)) for column in np.flatnonzero(failing)]
            return [f"not judged: {', '.join(failures)}"] if failures else []

        rows_of_text = grouped(
            (text, row)
            for row, texts in enumerate(self.notes)
            for text in (f"overlap of detectors: {self._texts('overlap')[row]}", *texts, *unjudged(row))
        )
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
        return listed([_short(self._texts("signature")[row]) for row in rows], _MAX_NAMES)


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


# --- names and spectra -------------------------------------------------------------------------------------


_SUFFIXES = (".asd", ".sig", ".txt", ".tsv", ".csv")


def names_of_spectrum(spectrum: str, source: str, further: str, number: int, dataset: int) -> dict[str, Any]:
    """Return the names of a spectrum of a field spectrometer, by the fields of `Measured`.

    ``spectrum``: its name, preceded by the folder where names repeat; ``source``: its file; ``further``: a
    further name; any of these may be empty. ``number``: number of the spectrum in its dataset; ``dataset``:
    number of the dataset.

    Examples
    --------
    >>> names = names_of_spectrum("site1/red", "red.sig", "", 0, 1)
    >>> [sorted(rank) for rank in names["ranks"]], names["origin"]
    ([['site1/red', 'site1/red.sig'], [], ['red', 'red.sig']], (1, 'site1/'))
    """
    base = PurePath(spectrum).name
    folder = spectrum[: len(spectrum) - len(base)] if spectrum.endswith(base) else ""
    full = frozenset(text for text in (spectrum, further, source and folder + source) if text)
    no_suffix = frozenset(name for text in full for name in _without_suffix(text)) - full
    aliases = frozenset(alias for text in (spectrum, source, further) for alias in _aliases(text))
    # readers number equal names in one folder, such as "red (1)" of red.sig: these are not repeats either
    numbered = base if source and base not in set(_aliases(source)) else ""
    shown = spectrum or source or further or f"spectrum {number}"
    ranks = (full, no_suffix, aliases - full - no_suffix)
    return {"name": shown, "ranks": ranks, "origin": (dataset, folder + numbered)}


def _aliases(text: str) -> Iterator[str]:
    """Yield the names of a file, or of a column in it: with and without folder and suffixes.

    Examples
    --------
    >>> sorted(set(_aliases("svc/red.asd.txt")))
    ['red', 'red.asd', 'red.asd.txt', 'svc/red.asd.txt']
    """
    if not text:
        return
    yield text
    for path in (text, text.rpartition(":")[2]):
        name = PurePath(path).name
        yield name
        yield from _without_suffix(name)


def _without_suffix(name: str) -> Iterator[str]:
    while name.lower().endswith(_SUFFIXES):
        name = name[: name.rindex(".")]
        yield name


@dataclass(frozen=True, eq=False)
class Measured:
    # One spectrum of reflectance with its origin and uncertainty.
    name: str  #: Name in results.
    #: Names for pairing, by rank: full names; names without suffix; names without folder, which spectra of
    #: other folders may share. A match of one rank excludes matches of later ranks.
    ranks: tuple[frozenset[str], frozenset[str], frozenset[str]]
    #: Number of the dataset, and folder in it: only readings of one origin are repeats of one another.
    origin: tuple[int, str]
    reference_name: str  #: Name of the reference in the properties of a signature; empty without it.
    instrument: str  #: Make of the instrument.
    serial: str  #: Serial number of the instrument, or a similar text; may be empty.
    wavelength: Floats  #: (channel,), float64: Increasing centre wavelengths [nm].
    fwhm: Floats  #: (channel,), float64: Widths [nm].
    values: Floats  #: (channel,), float64: Reflectance [1]; NaN without a value.
    u_random: Floats | None  #: (channel,): Standard uncertainty independent from channel to channel [1].
    u_systematic: Floats | None  #: (channel,): Standard uncertainty common to all channels [1].
    sd: Floats | None  #: (channel,): Standard deviation of the averaged readings or pixels [1].
    count: float  #: Number of averaged readings or independent pixels; 1 where unknown.
    overlap: str  #: Treatment of overlapping detectors by the reader: preserved, removed or unknown.
    matched: bool  #: Whether values were changed there to make detectors meet.
    mirror: str  #: Whether the mirror image of sky and surroundings is included, excluded, or unknown.
    absolute: bool  #: Whether reflectance is relative to a perfect diffuser, not to a panel.
    notes: tuple[str, ...]  #: Remarks for the reader of results.
    quantity: str = ""  #: Body under a coat or outside of the coat, see base.mirrored_light.
    geometry: str = ""  #: Measurement geometry of the instrument, such as d/8.
    coat_index: float = 1.5  #: Refractive index of the coat.
    finish: str = ""  #: Finish of a paint with flakes, "metallic" or "pearl"; empty for others.
    #: Angle between the view and the mirror direction of the light on a level surface [degree]; NaN if
    #: unknown.
    aspecular: float = np.nan
    covariance: Floats | None = (
        None  #: (channel, channel): Covariance of both uncertainties [1]; None if unknown.
    )
    place: Place = None  #: Latitude and longitude of the measured surface [degree]; None if unknown.
    sun_zenith: float = np.nan  #: Zenith angle of the sun [degree]; NaN if unknown.

    @property
    def has_uncertainty(self) -> bool:
        # Whether any part of the uncertainty is known.
        return any(component is not None for component in (self.u_random, self.u_systematic, self.sd))

    def times(self, factor: Floats | float, **changes: Any) -> "Measured":
        # Return the spectrum with values and spreads multiplied by a factor, and other changed fields.
        spreads = {"u_random": self.u_random, "u_systematic": self.u_systematic, "sd": self.sd}
        scaled = {name: None if spread is None else spread * factor for name, spread in spreads.items()}
        return replace(self, **{"values": self.values * factor, **scaled, **changes})

    def gaps(self) -> list[str]:
        # Return the unknown parts of the uncertainty, for the reader of the result.
        if self.u_random is None and self.u_systematic is None:
            return []
        gaps, has_value = [], np.isfinite(self.values)
        for name, u, counterpart in (
            ("random", self.u_random, "systematic"),
            ("systematic", self.u_systematic, "random"),
        ):
            if u is None:
                gaps.append(f"{counterpart} part only, the {name} part is unknown")
            elif not np.isfinite(u[has_value]).all():
                count = int(np.isfinite(u[has_value]).sum())
                gaps.append(
                    f"{name} part known in {count} of {int(has_value.sum())} channels; no uncertainty "
                    "elsewhere"
                )
        return gaps

    def errors(self, rng: np.random.Generator, draws: int) -> Floats:
        # Return random draws of the errors of the values (draw, channel).
        #
        # They follow the covariance where it is known; else random errors are independent and systematic
        # errors common to all channels. Where neither is known, the standard deviation of the mean counts as
        # systematic: readings of a surface differ in level more than in shape. NaN in channels without an
        # uncertainty that other channels have.
        if self.covariance is not None:
            errors = rng.standard_normal((draws, self.values.size)) @ self._components.T
            return np.asarray(np.where(np.isnan(np.diagonal(self.covariance)), np.nan, errors))
        errors = np.zeros((draws, self.values.size))
        if self.u_random is not None:
            errors += self.u_random * rng.standard_normal(errors.shape)
        systematic = self.u_systematic
        if systematic is None and self.u_random is None and self.sd is not None:
            systematic = self.sd / np.sqrt(self.count)
        if systematic is not None:
            errors += systematic * rng.standard_normal((draws, 1))
        return errors

    @functools.cached_property
    def _components(self) -> Floats:
        # Principal components of the covariance (channel, component), once for all pairs of a spectrum.
        # Truncated correlations cause eigenvalues slightly below zero.
        variances, vectors = np.linalg.eigh(np.nan_to_num(np.asarray(self.covariance)))
        return np.asarray(vectors * np.sqrt(np.maximum(variances, 0.0)))


def scaled_by_panel(spectra: list[Measured], panel: Any, surface: Any = LAMBERTIAN) -> list[Measured]:
    # Return references multiplied by the reflectance of their white panel.
    # ``spectra``: references relative to the panel; ``panel``: reflectance of the panel on ``wavelength``: a
    # DataArray, or a Dataset with ``reflectance``. It is interpolated linearly; beyond its wavelengths the
    # result is NaN. ``surface`` as in `panel_factor`: a panel that is seen from the nadir under a clear sky.
    # Raises `SchemaError, UnitsError`: A reference is absolute already, or has no sun for the surface, or the
    # panel is not a certificate; all problems are listed.
    array = panel["reflectance"] if hasattr(panel, "data_vars") and "reflectance" in panel else panel
    SchemaError.raise_if(
        not hasattr(array, "dims")
        or tuple(array.dims) != ("wavelength",)
        or "wavelength" not in array.coords,
        f"panel= is {type(panel).__name__}",
        expected="a DataArray of reflectance on wavelength",
        mend="see read_certificate",
        code="type-wrong",
    )
    with Problems("references cannot be scaled by the panel", SchemaError) as problems:
        wavelength = convert(array["wavelength"], "nm").values.astype(np.float64)
        values = convert(array, "1", "panel").values.astype(np.float64)
        order = np.argsort(wavelength)
        wavelength, values = wavelength[order], values[order]
        if not (
            np.isfinite(wavelength).all() and np.isfinite(values).all() and (np.diff(wavelength) > 0).all()
        ):
            problems.add("panel= has wavelengths twice, or values that are not finite", code="not-finite")
        elif not ((values > 0.0) & (values <= 1.2)).all():
            limits = f"{values.min():g} to {values.max():g}"
            problems.add(
                f"panel= has values from {limits}",
                expected="above 0, at most 1.2",
                mend="divide percent by 100",
                code="value-out-of-range",
            )
        problems.extend(
            Problem(
                f"reference {spectrum.name!r} is absolute already, or from a library",
                mend="remove the argument panel=",
                code="option-conflict",
            )
            for spectrum in spectra
            if spectrum.absolute
        )
        problems.extend(
            Problem(
                f"reference {spectrum.name!r} has no time and place, so that the sun on its panel is unknown",
                expected="time, latitude and longitude, for panel_surface=",
                mend="add them to the references, or remove the argument panel_surface=",
                code="panel-light-unknown",
            )
            for spectrum in spectra
            if np.isnan(spectrum.sun_zenith) and not is_lambertian(surface)
        )
    check_surface(surface, values)
    scaled = []
    for spectrum in spectra:
        factor = np.interp(spectrum.wavelength, wavelength, values, np.nan, np.nan)
        note, surface_u = "scaled by the panel's certificate", np.zeros(factor.shape)
        if not is_lambertian(surface):
            zenith = spectrum.sun_zenith
            direct_share = 1.0 - diffuse_fraction(spectrum.wavelength, zenith)
            directional = panel_factor(
                spectrum.wavelength, zenith, surface=surface, direct_share=direct_share
            )
            factor, surface_u = np.asarray(factor * directional.factor), directional.u
            note += f" and its surface, for a sun at {zenith:.0f} degrees and a clear sky"
        result = spectrum.times(factor, absolute=True, notes=(*spectrum.notes, note))
        # the error by the surface is common to all channels
        own = result.values * surface_u
        if result.u_systematic is not None:
            result = replace(result, u_systematic=np.hypot(result.u_systematic, own))
        if spectrum.covariance is not None:
            covariance = spectrum.covariance * np.outer(factor, factor) + np.outer(own, own)
            result = replace(result, covariance=covariance)
        scaled.append(result)
    return scaled


# --- clear coats -------------------------------------------------------------------------------------------

#: Zenith angle of the sun above which a degree of lean changes the direct light by more than the usual
#: tolerance, 5 % [degree].
_LOW_SUN_DEG = 70.0


def coat_of(attrs: Any) -> dict[str, Any]:
    # Return quantity, instrument geometry and index of the coat, by the attributes of a dataset.
    # ``quantity`` is one of the words of `hyperpaint.base.mirrored_light`; without it, ``specular_component``
    # determines the quantity.
    declared, index = attrs.get("quantity"), attrs.get("coat_index", COAT_INDEX)
    implied = OUTSIDE if attrs.get("specular_component") == INCLUDED else ""
    usable = isinstance(index, int | float) and 1.0 <= float(index) <= 3.0
    return {
        "quantity": declared if declared in (BODY, OUTSIDE, THROUGH_COAT) else implied,
        "geometry": str(attrs.get("measurement_geometry", "")),
        "coat_index": float(index) if usable else COAT_INDEX,
    }


def as_body(reference: Measured, signature: Measured) -> Measured:
    r"""Return a reading outside of a coat converted to the body under it, if the signature is of the body.

    The attribute ``measurement_geometry`` of the reference must be "0/0", "0/45", "45/0", or that of an
    integrating sphere, such as "d/8". Without it, or for a reading of the body, the reference is returned
    unchanged.

    Notes
    -----
    .. math:: R_{body} = (R - s F(0)) \frac{1 - F(0)}{1 - F_{in}}

    with s = 1 where the mirror image is included, and the interface's reflectance :math:`F_{in}` of the
    instrument's light.
    """
    if signature.quantity != BODY or reference.quantity != OUTSIDE:
        return reference
    # reflectance of the coat for the light of the instrument [1]
    index, angles = reference.coat_index, {"0/0": 0.0, "0/45": 45.0, "45/0": 45.0}
    if reference.geometry in angles:
        incident = float(interface_reflectance(angles[reference.geometry], index))
    elif reference.geometry in ("d/0", "0/d", "d/8", "8/d"):
        incident = float(sky_reflectance([550.0], None, index=index)[0])
    else:
        return reference
    normal = float(interface_reflectance(0.0, index))
    mirrored = normal if reference.mirror == INCLUDED and reference.geometry not in ("0/45", "45/0") else 0.0
    factor = (1.0 - normal) / (1.0 - incident)

    # uncertainty of the subtracted reflectance from that of the index, the largest part for black paint
    normal_u = float(mirrored > 0.0) * 4.0 * (index - 1.0) / (index + 1.0) ** 3 * COAT_INDEX_U
    known_u = 0.0 if reference.u_systematic is None else reference.u_systematic

    return reference.times(
        factor,
        values=(reference.values - mirrored) * factor,
        u_systematic=factor * np.hypot(known_u, normal_u) * np.ones_like(reference.values),
        covariance=None,  # it lacks the uncertainty of the index
        mirror=EXCLUDED,
        quantity=BODY,
        notes=(
            *reference.notes,
            f"the reference, a reading of the coat's outside in {reference.geometry}, was converted to the "
            f"body under it: less {mirrored:.3f}, times {factor:.3f}",
        ),
    )


# --- datasets ----------------------------------------------------------------------------------------------

_MAX_DETECTORS = 8

#: Channel widths of the three detectors of FieldSpec 3/4 and HR-1024i, as their makers state them [nm].
_WIDTHS_NM: dict[str, tuple[float, ...]] = {"asd": (3.0, 10.0, 10.0), "svc": (3.5, 9.5, 6.5)}
_NAMES = {"asd": ("asd", "fieldspec", "handheld"), "svc": ("svc", "spectra vista", "hr-1024", "hr-768")}
#: Wavelengths between detectors, for files without gaps or overlaps at these [nm].
_DETECTOR_EDGES_NM = (1000.0, 1900.0)


def join_detectors(
    wavelength: Floats,
) -> tuple[Indices, Indices, tuple[float, ...]]:
    """Return the channels that form one increasing axis of wavelengths.

    Their positions in the file (channel,), the number of every channel's detector (channel,), and the
    wavelengths at which the next detector begins [nm].

    Where wavelengths fall, another detector begins. Two overlapping detectors are joined in the middle of
    their overlap: samples of different detectors are not averaged, since scale and resolution differ.

    ``wavelength`` (channel,): wavelengths in the order of the file [nm]; descending files are reversed.

    Raises `SchemaError`: Wavelengths are not finite, or in an order that no set of detectors has.

    Examples
    --------
    >>> order, _, joins = join_detectors(np.array([980.0, 990.0, 1000.0, 970.0, 988.0, 1006.0]))
    >>> order.tolist(), joins
    ([0, 4, 5], (985.0,))
    """
    SchemaError.raise_if(
        not (wavelength.size and np.isfinite(wavelength).all()),
        "wavelengths must be finite, and at least one [nm]",
        code="not-finite",
    )
    is_falling = (np.diff(wavelength) < 0).sum() > wavelength.size // 2
    order = np.arange(wavelength.size)[:: -1 if is_falling else 1]
    begins = np.flatnonzero(np.diff(wavelength[order]) <= 0) + 1
    detectors = np.split(order, begins)
    SchemaError.raise_if(
        len(detectors) > _MAX_DETECTORS,
        f"wavelengths fall {len(begins)} times",
        expected="an increasing axis, except where detectors join",
        mend="sort the spectrum",
        code="wavelengths-unordered",
    )
    channels, number, joins = detectors[0], np.zeros(detectors[0].size, np.intp), []
    for index, following in enumerate(detectors[1:], 1):
        join = float(0.5 * (wavelength[channels[-1]] + wavelength[following[0]]))
        below_join = wavelength[channels] <= join
        above_join = following[wavelength[following] > join]
        SchemaError.raise_if(
            not (below_join.any() and above_join.size),
            f"one detector's wavelengths lie within another's near {join:g} nm",
            mend="open the detectors as separate datasets",
            code="detectors-overlap",
        )
        channels = np.concatenate([channels[below_join], above_join])
        number = np.concatenate([number[below_join], np.full(above_join.size, index)])
        joins.append(join)
    return channels, number, tuple(joins)


UNKNOWN = "unknown"
_SPREADS = ("reflectance_u_random", "reflectance_u_systematic", "reflectance_sd")
#: Range of plausible channel widths: minimum [nm], and maximum in distances of channels.
_MIN_WIDTH_NM, _MAX_WIDTH_SPACINGS = 0.05, 100.0


def _dataset_spectra(dataset: Any, number: int, fwhm: float | None) -> Iterator[Measured]:
    SchemaError.raise_if(
        not hasattr(dataset, "data_vars"),
        f"{type(dataset).__name__}",
        expected="a Dataset",
        code="type-wrong",
    )
    SchemaError.raise_if(
        "reflectance" not in dataset.data_vars,
        f"holds {', '.join(map(str, dataset.data_vars)) or 'nothing'}",
        expected="reflectance",
        mend="open it with quantity='reflectance'",
        code="variable-missing",
    )
    dataset = with_band_dim(dataset)
    dims = set(dataset["reflectance"].dims)
    if BAND in dims:
        return _library_spectra(dataset, number, fwhm, "library")
    if "wavelength" in dims and dims <= {"spectrum", "wavelength"}:
        return _spectrometer_spectra(dataset, number, fwhm)
    raise SchemaError(
        f"'reflectance' has dims ({', '.join(map(str, dataset['reflectance'].dims))})",
        expected="(spectrum, wavelength) of a spectrometer or (signature, band) of a library",
        code="dim-missing",
    )


# --- paint libraries ---------------------------------------------------------------------------------------


def _library_spectra(
    dataset: xr.Dataset, dataset_number: int, fwhm: float | None, default_instrument: str
) -> Iterator[Measured]:
    if SIGNATURE not in dataset.dims and BAND in dataset.dims:
        # a single paint, as isel returns it
        if SIGNATURE not in dataset.coords:
            label = f"reference {dataset_number}" if dataset_number else "signatures"
            dataset = dataset.assign_coords({SIGNATURE: label})
        dataset = dataset.expand_dims(SIGNATURE)
    optional = [name for name in (*_SPREADS, "fwhm", "n", "n_eff") if name in dataset.variables]
    required = require(dataset, [SIGNATURE, "reflectance", "wavelength"], "a validation", LIBRARY_VARIABLES)
    arrays = {**required, **find(dataset, optional, LIBRARY_VARIABLES)[0]}
    attrs = {**dataset.attrs, **dataset["reflectance"].attrs}
    values = arrays["reflectance"].values.astype(np.float64)
    if "good" in dataset.variables and dataset["good"].dims == (BAND,):
        values = np.where(dataset["good"].values.astype(bool), values, np.nan)
    channels = _Channels.of(
        arrays["wavelength"].values, arrays.get("fwhm"), fwhm, str(attrs.get("instrument", ""))
    )
    has_sources = {"reflectance_errors", *_SPREADS[:2]} <= set(dataset.variables)
    covariances = covariance(dataset).transpose(SIGNATURE, ...).values if has_sources else None
    for number, name in enumerate(arrays[SIGNATURE].values):
        spreads = {key: arrays[key].values[number] for key in _SPREADS if key in arrays}
        # the number of independent pixels if it is known: neighbours share errors
        counts = (float(arrays[key].values[number]) for key in ("n_eff", "n") if key in arrays)
        words = [_text_of(dataset, key, number, SIGNATURE).lower() for key in ("finish", "material", "kind")]
        # reasons why the level of a signature is uncertain, for the reader of the result
        light = {
            name: dataset[name].isel({SIGNATURE: number}).values[()]
            for name in ("sun_zenith", "sky_state")
            if name in dataset.variables and dataset[name].dims == (SIGNATURE,)
        }
        has_split = (
            "diffuse_fraction" in dataset.variables
            and SIGNATURE in dataset["diffuse_fraction"].dims
            and bool(np.isfinite(dataset["diffuse_fraction"].isel({SIGNATURE: number})).all())
        )
        notes, sun_zenith = [], float(light.get("sun_zenith", np.nan))
        if sun_zenith > _LOW_SUN_DEG:
            change = 100.0 * np.tan(np.radians(min(sun_zenith, 89.0))) * np.pi / 180.0
            notes.append(
                f"the sun stood {sun_zenith:.0f} degrees from the zenith: one degree of lean changes its "
                f"light by {change:.0f} %; judge the shape of the signature rather than its level"
            )
        if has_split and light.get("sky_state") == SKY_STATES.index("contradictory"):
            notes.append(
                "the irradiance record contradicted every sky at that time, so the level is uncertain: check "
                "clocks and the receiver's calibration, or give sun_zenith= to signatures"
            )
        yield channels.spectrum(
            values[number],
            spreads,
            next((count for count in counts if np.isfinite(count)), None),
            name=str(name),
            ranks=(frozenset({str(name)}), frozenset(), frozenset()),
            origin=(dataset_number, ""),
            reference_name=_text_of(dataset, "reference", number, SIGNATURE),
            instrument=str(attrs.get("instrument", "")) or default_instrument,
            serial="",
            **_overlap_of(attrs.get("overlap"), attrs.get("overlap_matched", False)),
            mirror=mirror_reflection(dataset) or UNKNOWN,
            absolute=attrs.get("reflectance_scale", "absolute") == "absolute",
            covariance=None
            if covariances is None
            else covariances[number][np.ix_(channels.order, channels.order)],
            notes=(*channels.notes, *notes),
            finish=next((word for word in words if word in FLAKE_PAINTS), ""),
            aspecular=_aspecular_of(dataset, number, attrs, is_level=False),
            place=_place_of(dataset, number, SIGNATURE),
            **(coat_of(attrs) | _uncorrected_coat(dataset, number, attrs)),
        )


def _uncorrected_coat(dataset: xr.Dataset, number: int, attrs: Mapping[str, Any]) -> dict[str, str]:
    # The quantity of a paint without correction for its coat, in a library of corrected paints
    if attrs.get("quantity") != BODY or "coat_transmission" not in dataset.variables:
        return {}
    shares = [
        dataset[name].values for name in ("coat_transmission", "coat_transmission_u") if name in dataset
    ]
    if any(share.ndim != 2 for share in shares):
        return {}
    is_uncorrected = (shares[0][number] == 1.0).all() and all((u[number] == 0.0).all() for u in shares[1:])
    return {"quantity": THROUGH_COAT} if is_uncorrected else {}


# --- spectrometers -----------------------------------------------------------------------------------------


def _spectrometer_spectra(dataset: xr.Dataset, dataset_number: int, fwhm: float | None) -> Iterator[Measured]:
    if "spectrum" not in dataset["reflectance"].dims:
        dataset = dataset.expand_dims("spectrum")
    SchemaError.raise_if(
        "wavelength" not in dataset.coords,
        "the coordinate 'wavelength' of reflectance is missing [nm]",
        code="variable-missing",
    )
    order = ("spectrum", "wavelength")
    values = convert(dataset["reflectance"], "1").transpose(*order).values.astype(np.float64)
    wavelength = convert(dataset["wavelength"], "nm").values.astype(np.float64)
    spreads = {
        name: convert(dataset[name], "1").transpose(*order).values.astype(np.float64)
        for name in _SPREADS
        if name in dataset.variables and set(dataset[name].dims) == set(order)
    }
    has_widths = "fwhm" in dataset.variables and dataset["fwhm"].dims == ("wavelength",)
    widths = dataset["fwhm"] if has_widths else None
    attrs = {**dataset.attrs, **dataset["reflectance"].attrs}
    # number of every channel's detector, in the order of the file; None where it is not stated
    detectors = None
    if "detector" in dataset.variables and dataset["detector"].dims == ("wavelength",):
        names = [str(name) for name in dataset["detector"].values]
        numbers = {name: number for number, name in enumerate(dict.fromkeys(names))}
        detectors = np.array([numbers[name] for name in names], np.intp)
    channels = _Channels.of(wavelength, widths, fwhm, str(attrs.get("instrument", "")), detectors)
    for number, spectrum in enumerate(values):
        texts = [_text_of(dataset, key, number, "spectrum") for key in ("spectrum", "source", "name")]
        attributes = {
            key: _text_of(dataset, key, number, "spectrum") or attrs.get(key)
            for key in ("overlap", "mirror_reflection", "specular_component", "instrument")
        }
        matched = dataset.get("overlap_matched", xr.DataArray(attrs.get("overlap_matched", False)))
        is_matched = bool((matched[number] if matched.dims == ("spectrum",) else matched).any())
        mirror = attributes["mirror_reflection"] or attributes["specular_component"]
        count = dataset["n"].values[number] if "n" in dataset.variables and dataset["n"].dims else None
        # Error bits of the scans, as the instrument recorded them
        errors = []
        for scan in ("target", "reference"):
            key = f"error_{scan}"
            if key in dataset.variables and dataset[key].dims in (("spectrum",), ()):
                bits = int(np.ravel(dataset[key].values)[number if dataset[key].dims else 0])
                if bits > 0:
                    panel = " of the white panel" if scan == "reference" else ""
                    errors.append(f"the instrument set error bits {bits} in the {scan} scan{panel}")
        yield channels.spectrum(
            spectrum,
            {name: array[number] for name, array in spreads.items()},
            None if count is None else float(count),
            **names_of_spectrum(texts[0], texts[1], texts[2], number, dataset_number),
            reference_name="",
            instrument=str(attrs.get("instrument") or attributes["instrument"] or "spectrometer"),
            serial=_text_of(dataset, "instrument", number, "spectrum"),
            notes=(*channels.notes, *errors),
            **_overlap_of(attributes["overlap"], is_matched),
            mirror=mirror if mirror in (INCLUDED, EXCLUDED) else UNKNOWN,
            absolute=attrs.get("reflectance_scale", "relative") == "absolute",
            aspecular=_aspecular_of(dataset, number, attrs, is_level=True),
            place=_place_of(dataset, number, "spectrum"),
            sun_zenith=_sun_zenith_of(dataset, number, attrs),
            **coat_of(attrs),
        )


def _text_of(dataset: xr.Dataset, key: str, number: int, dim: str) -> str:
    # Text of a variable for one spectrum; empty without such a text
    if key not in dataset.variables:
        return ""
    array = dataset[key]
    if array.dims not in ((dim,), ()) or array.dtype.kind not in "OUST":
        return ""
    value = array.values[number] if array.dims else array.values.item()
    return value if isinstance(value, str) else ""


def _aspecular_of(dataset: xr.Dataset, number: int, attrs: Mapping[Any, Any], *, is_level: bool) -> float:
    # Aspecular angle of a spectrum [degree]: as stated, or of the sun on a level sample seen from the nadir,
    # as a field spectrometer sees it (``is_level``); the view of a camera is not assumed
    stated = float(_value_of(dataset, number, attrs, "aspecular_angle"))
    if np.isfinite(stated) or attrs.get("measurement_geometry") in ("0/45", "45/0"):
        return stated if np.isfinite(stated) else 45.0
    is_unknown = not is_level or "measurement_geometry" in attrs
    return float("nan") if is_unknown else _sun_zenith_of(dataset, number, attrs)


def _sun_zenith_of(dataset: xr.Dataset, number: int, attrs: Mapping[Any, Any]) -> float:
    # Zenith angle of the sun on a spectrum [degree]; NaN without its time and place
    place = [float(_value_of(dataset, number, attrs, name)) for name in ("latitude", "longitude")]
    time = _value_of(dataset, number, {}, "time") if "time" in dataset.variables else np.datetime64("NaT")
    is_unknown = np.isnat(time) or not np.isfinite(place).all()
    return float("nan") if is_unknown else float(solar_position(time, *place)[0])


def _value_of(dataset: xr.Dataset, number: int, attrs: Mapping[Any, Any], name: str) -> Any:
    # Value of a variable or an attribute for one spectrum; NaN without it
    array = dataset[name] if name in dataset.variables else xr.DataArray(attrs.get(name, np.nan))
    return array.values[number] if array.ndim == 1 else array.values if array.ndim == 0 else np.nan


def _place_of(dataset: xr.Dataset, number: int, dim: str) -> Place:
    names = ("latitude", "longitude")
    if any(name not in dataset.variables or dataset[name].dims != (dim,) for name in names):
        return None
    latitude, longitude = (float(dataset[name].values[number]) for name in names)
    return (latitude, longitude) if np.isfinite(latitude + longitude) else None


def _overlap_of(text: Any, matched: Any) -> dict[str, Any]:
    overlap = text if isinstance(text, str) and text else UNKNOWN
    return {"overlap": overlap, "matched": bool(matched) or overlap == "matched"}


# --- channels ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Channels:
    # Channels on one increasing axis of wavelengths
    order: Indices  # (channel,): Positions in the data
    wavelength: Floats
    fwhm: Floats
    notes: tuple[str, ...]  # Joins of detectors, and the source of the widths

    @classmethod
    def of(
        cls, wavelength: Any, data_fwhm: Any, user_fwhm: float | None, instrument: str, detector: Any = None
    ) -> "_Channels":
        # `data_fwhm`: widths in the data; `user_fwhm`: width that the user states
        wavelength = np.asarray(wavelength, np.float64)
        order, number, joins = join_detectors(wavelength)
        nm_sorted = wavelength[order]
        text = ", ".join(f"{nm:.4g}" for nm in joins)
        notes = [f"detectors joined at {text} nm"] if joins else []
        if user_fwhm is not None:
            _check_widths(np.array([user_fwhm]), nm_sorted)
            notes.append(f"widths of channels {user_fwhm:g} nm, as given")
            return cls(order, nm_sorted, np.full(nm_sorted.size, user_fwhm), tuple(notes))
        if data_fwhm is not None:
            fwhm = convert(data_fwhm, "nm").values.astype(np.float64)[order]
            if np.isfinite(fwhm).all() and (fwhm > 0).all():
                _check_widths(fwhm, nm_sorted)
                return cls(order, nm_sorted, fwhm, tuple(notes))
        # usual widths for data that do not state them, and their source
        number = number if detector is None else detector[order]
        lowered = instrument.lower()
        make = next((make for make, names in _NAMES.items() if any(name in lowered for name in names)), "")
        if make:
            has_detectors = number.max() > 0 and nm_sorted[0] < _DETECTOR_EDGES_NM[0]
            number = number if has_detectors else np.searchsorted(_DETECTOR_EDGES_NM, nm_sorted, "right")
            fwhm = np.array(_WIDTHS_NM[make])[np.minimum(number, len(_DETECTOR_EDGES_NM))]
            source = f"widths of channels as usual for {make.upper()}"
        elif nm_sorted.size < 2:
            fwhm, source = np.ones(nm_sorted.size), "widths of channels assumed, 1 nm"
        else:
            fwhm, source = 2.0 * np.gradient(nm_sorted), "widths of channels assumed, twice their distance"
        return cls(order, nm_sorted, fwhm, (*notes, source))

    def spectrum(
        self, values: Floats, spreads: Mapping[str, Any], count: float | None, **description: Any
    ) -> Measured:
        # spreads in the order of wavelength; None without finite values
        u_random, u_systematic, sd = (
            np.asarray(spread, np.float64)[self.order]
            if (spread := spreads.get(name)) is not None and np.isfinite(spread[self.order]).any()
            else None
            for name in _SPREADS
        )
        return Measured(
            wavelength=self.wavelength,
            fwhm=self.fwhm,
            values=np.asarray(values, np.float64)[self.order],
            u_random=u_random,
            u_systematic=u_systematic,
            sd=sd,
            count=max(count, 1.0) if count is not None and np.isfinite(count) else 1.0,
            **{"notes": self.notes, **description},
        )


def _check_widths(fwhm: Floats, wavelength: Floats) -> None:
    # A single wrong width would determine the step of all responses
    spacing = float(np.median(np.diff(wavelength))) if wavelength.size > 1 else np.inf
    SchemaError.raise_if(
        not ((fwhm >= _MIN_WIDTH_NM) & (fwhm <= _MAX_WIDTH_SPACINGS * spacing)).all(),
        f"'fwhm' is {np.min(fwhm):g} to {np.max(fwhm):g} nm",
        expected=f"{_MIN_WIDTH_NM:g} to {_MAX_WIDTH_SPACINGS * spacing:g} nm, {_MAX_WIDTH_SPACINGS:g} "
        "distances of channels",
        mend="correct it, or pass reference_fwhm=",
        code="value-out-of-range",
    )


# --- statistics of agreement, and resampling of both spectra onto common bands ----------------------------

#: Minimum number of bands for the shape of a spectrum: with one band, angle and scale-free error are 0.
_MIN_SHAPE_BANDS = 3


def statistics_of(signature: Floats, reference: Floats) -> dict[str, Floats]:
    r"""Return the statistics of agreement over the last axis.

    Takes ``signature``, ``reference`` (..., band): reflectance [1] without missing values. The result has the
    names in `STATISTICS`, in units of 1, the angle in degree. All are NaN without bands; angle, scale and
    scale-free error also where a spectrum is zero, angle and scale-free error also with fewer than three
    bands.

    Notes
    -----
    With :math:`d = s - r` over n bands,

    .. math:: bias = \bar d, \quad RMSE = \sqrt{\overline{d^2}}, \quad MAE = \overline{|d|}, \quad
              \theta = \angle(s, r), \quad k = \frac{s \cdot r}{r \cdot r}, \quad
              e = \sqrt{\overline{(s / k - r)^2}} .

    k is the scale factor of the least-squares fit of the reference to the signature, e the RMS difference
    after the signature is divided by k; e over the RMS of the reference is :math:`\tan\theta`. The angle is
    computed as :math:`2 \arctan(|\hat s - \hat r| / |\hat s + \hat r|)` of the unit vectors [1]_, since the
    cosine is imprecise for small angles.

    References
    ----------
    .. [1] W. Kahan, "How futile are mindless assessments of roundoff in floating-point computation?" (2006),
       section 12, "Mangled angles".

    Examples
    --------
    >>> found = statistics_of(np.array([0.11, 0.22, 0.33]), np.array([0.1, 0.2, 0.3]))
    >>> round(float(found["scale"]), 6), round(float(found["bias"]), 6)
    (1.1, 0.02)
    """
    shape = np.broadcast_shapes(signature.shape, reference.shape)
    if shape[-1] == 0:
        return {name: np.full(shape[:-1], np.nan) for name in STATISTICS}
    difference = signature - reference
    signature_length, reference_length = (
        np.sqrt((spectrum**2).sum(axis=-1, keepdims=True)) for spectrum in (signature, reference)
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        # both scaled to the same length
        s, r = signature * reference_length, reference * signature_length
        angle = 2.0 * np.arctan2(np.linalg.norm(s - r, axis=-1), np.linalg.norm(s + r, axis=-1))
        scale = (signature * reference).sum(axis=-1, keepdims=True) / reference_length**2
        residual = signature / np.where(scale > 0.0, scale, np.nan) - reference
    has_shape = shape[-1] >= _MIN_SHAPE_BANDS
    has_angle = has_shape & ((signature_length * reference_length)[..., 0] > 0.0)
    return {
        "bias": difference.mean(axis=-1),
        "rmse": np.sqrt((difference**2).mean(axis=-1)),
        "mae": np.abs(difference).mean(axis=-1),
        "spectral_angle": np.where(has_angle, np.degrees(angle), np.nan),
        "scale": scale[..., 0],
        "scale_free_error": np.where(has_shape, np.sqrt((residual**2).mean(axis=-1)), np.nan),
    }


def uncertainty_of(
    signature: Floats, reference: Floats, signature_errors: Floats, reference_errors: Floats
) -> dict[str, Floats]:
    r"""Return the standard uncertainty of every statistic of `statistics_of`.

    Takes ``signature``, ``reference`` (band,): reflectance [1]; ``signature_errors``, ``reference_errors``
    (draw, band): random draws of their errors [1].

    Notes
    -----
    By propagation of distributions (JCGM 101:2008): with f the statistic,

    .. math:: u_f = \sqrt{\overline{\big(f(s + \delta s, r + \delta r) - f(s, r)\big)^2}} .

    The deviations are from the statistic of the exact spectra, not from the mean of the draws: noise only
    increases RMSE, MAE and angle, so that the spread about their mean would be too small for equal spectra.
    """
    exact = statistics_of(signature, reference)
    draws = statistics_of(signature + signature_errors, reference + reference_errors)
    return {name: np.asarray(np.sqrt(((draws[name] - exact[name]) ** 2).mean())) for name in STATISTICS}


_SAME_AXIS = SimpleNamespace(
    #: Maximum difference of equal wavelengths [nm].
    max_equal_nm=1e-3,
    #: Maximum ratio of equal widths [1].
    max_equal_width_ratio=1.02,
    #: Maximum factor by which resampling may multiply noise; channels much wider than a band exceed it.
    max_noise_gain=3.0,
)


@dataclass(frozen=True, eq=False)
class Operator:
    # Linear resampling of the channels of a spectrum to bands
    weights: (
        Floats | None
    )  #: (band, channel): Weights, rows sum to 1; None where channels and bands are equal.
    #: (band,): Whether a band is covered completely, and not too narrow for the channels.
    is_covered: Bools
    #: (band,): Part of a band's response covered by the channels [1]; 0 where channels within are missing.
    coverage: Floats
    misfit: Floats  #: (band,): See `hyperpaint.light.responses.Matching`.
    noise_gain: Floats  #: (band,): See `hyperpaint.light.responses.Matching`.

    def __call__(self, values: Floats) -> Floats:
        # Return values (..., channel) on the bands (..., band); NaN in bands that are not covered
        on_bands = np.full((*values.shape[:-1], self.is_covered.size), np.nan)
        if self.weights is None:
            on_bands[..., self.is_covered] = values[..., self.is_covered]
            return on_bands
        # channels without weight may be missing
        channels = np.flatnonzero(self.weights[self.is_covered].any(axis=0))
        on_bands[..., self.is_covered] = (
            values[..., channels] @ self.weights[np.ix_(self.is_covered, channels)].T
        )
        return on_bands


def operator_onto(bands: Measured, spectrum: Measured) -> Operator:
    # Return the operator that resamples a spectrum to the channels of the spectrum ``bands``.
    # Equal channels need no weights. Missing samples of ``spectrum`` count as not covered; missing samples of
    # ``bands`` are ignored.
    is_finite = np.isfinite(spectrum.values)
    if (
        bands.wavelength.shape == spectrum.wavelength.shape
        and (np.abs(bands.wavelength - spectrum.wavelength) <= _SAME_AXIS.max_equal_nm).all()
        and np.allclose(bands.fwhm, spectrum.fwhm, rtol=_SAME_AXIS.max_equal_width_ratio - 1.0)
    ):
        zero = np.where(is_finite, 0.0, np.nan)
        return Operator(None, is_finite, is_finite.astype(np.float64), zero, zero + 1.0)
    size = bands.wavelength.size
    reach = 3.0 * (bands.fwhm.max() + spectrum.fwhm.max())
    near = spectrum.wavelength >= bands.wavelength.min() - reach
    channels = np.flatnonzero(is_finite & near & (spectrum.wavelength <= bands.wavelength.max() + reach))
    weights = np.zeros((size, spectrum.wavelength.size))
    if channels.size < 2:
        zeros, unknown = np.zeros(size), np.full(size, np.nan)
        return Operator(weights, zeros.astype(bool), zeros, unknown, unknown)
    centre, width = spectrum.wavelength[channels], spectrum.fwhm[channels]
    matching = matching_operator(Responses(centre, width), Responses(bands.wavelength, bands.fwhm))
    # bands over gaps: channels farther from one another than two of their widths
    is_gap = np.diff(centre) > 2.0 * np.maximum(width[1:], width[:-1])
    has_gap = np.zeros(size, bool)
    for start, stop in zip(centre[:-1][is_gap], centre[1:][is_gap], strict=True):
        has_gap |= (bands.wavelength + bands.fwhm > start) & (bands.wavelength - bands.fwhm < stop)
    # False for an unknown noise gain, NaN
    is_covered = ~has_gap & (matching.noise_gain[0] <= _SAME_AXIS.max_noise_gain)
    weights[np.ix_(is_covered, channels)] = matching.weights[0][is_covered]
    return Operator(
        weights,
        is_covered,
        np.where(has_gap, 0.0, matching.coverage[0]),
        matching.misfit[0],
        matching.noise_gain[0],
    )


# --- pairs ------------------------------------------------------------------------------------------------

_MAX_LISTED_NAMES = 12
_MAX_LISTED_REASONS = 3
#: Names that readers give to spectra without a name; they pair only where ``pairs`` names them.
_NUMBERED = re.compile(r"(?:column|spectrum) \d+(?: \(\d+\))?")


@dataclass(frozen=True)
class Pair:
    # A signature and its reference spectra from one instrument
    signature: Measured
    references: tuple[Measured, ...]  #: Repeated readings; their mean is compared.
    between: bool = False  #: Whether ``signature`` is a reference, from another instrument.


def paired(
    signatures: Sequence[Measured],
    references: Sequence[Measured],
    pairs: Any = None,
    place_accuracy: float = PLACE_ACCURACY_M,
) -> tuple[list[Pair], tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
    # Return the pairs of signatures and references, and the names of those without a counterpart.
    #
    # Names of signatures without a reference; names of references without a signature, with their instrument;
    # and signatures whose property names an absent reference.
    #
    # ``signatures``, ``references``: spectra with their names; ``pairs``: one or several names of references
    # by name of a paint. By default a signature's property ``reference`` names them, and without this
    # property the signature's name. Where positions contradict the name, or no name matches, the position
    # decides: see `match_places`.
    #
    # Raises `SchemaError`: ``pairs`` has unknown names; several paints, or references of several folders or
    # datasets, share a name; or nothing can be paired. All problems of a kind are listed.
    names_of_paint: dict[str, tuple[str, ...]] | None = None
    if pairs is not None:
        SchemaError.raise_if(
            not isinstance(pairs, Mapping),
            f"pairs is {type(pairs).__name__}",
            expected="a mapping from names of paints to names of references",
            code="type-wrong",
        )
        with Problems("pairs= cannot be used", SchemaError) as pair_problems:
            paints = {signature.name for signature in signatures}
            known_names = frozenset[str]().union(
                *(rank for reference in references for rank in reference.ranks)
            )
            names_of_paint = {}
            for paint, value in pairs.items():
                reference_names = (value,) if isinstance(value, str) else tuple(value)
                pair_problems.add_if(
                    paint not in paints,
                    f"there is no paint {paint!r}",
                    expected=_listed(sorted(paints)),
                    code="paint-unknown",
                )
                pair_problems.extend(
                    Problem(
                        f"there is no reference {name!r} for {paint!r}",
                        expected=_listed([reference.name for reference in references]),
                        code="reference-unknown",
                    )
                    for name in reference_names
                    if name not in known_names
                )
                names_of_paint[str(paint)] = reference_names
    with Problems("paints and references cannot be paired by name", SchemaError) as problems:
        counts = Counter(signature.name for signature in signatures)
        places = {k: s.place for k, s in enumerate(signatures) if s.place and not s.reference_name}
        by_place = match_places(
            places if names_of_paint is None else {},
            {k: signature.name for k, signature in enumerate(signatures)},
            [reference.place for reference in references],
            [reference.instrument for reference in references],
            place_accuracy,
        )
        matched: list[Pair] = []
        unpaired: list[str] = []
        missing: list[str] = []
        paired_references: set[int] = set()
        for key, signature in enumerate(signatures):
            requested = signature.reference_name
            is_numbered = (
                names_of_paint is None and not requested and bool(_NUMBERED.fullmatch(signature.name))
            )
            names = (
                ()
                if is_numbered
                else (requested or signature.name,)
                if names_of_paint is None
                else names_of_paint.get(signature.name, ())
            )
            matching = sorted({k for name in names for k in _references_of_name(name, references, problems)})
            if key in places and by_place:
                # a place confirms a name, and replaces it where no name matches
                here = {k: match.text for k, match in by_place.items() if match.paint == key}
                matching = [k for k in matching if k not in by_place or key in by_place[k].near] or list(here)
                here = {k: text for k, text in here.items() if k in matching}
                texts = (f"matched by place: {references[k].name} is {text}" for k, text in here.items())
                signature = replace(signature, notes=(*signature.notes, *texts))
            if not matching:
                is_missing = names_of_paint is None and bool(requested)
                reason = f" (no reference {requested!r})" if is_missing else ""
                unpaired.append(signature.name + (" (numbered by its reader)" if is_numbered else reason))
                missing += unpaired[-1:] if is_missing else []
                continue
            problems.add_if(
                counts[signature.name] > 1 and (names_of_paint is not None or not requested),
                f"{counts[signature.name]} paints have the name {signature.name!r}",
                mend="give each paint a unique name",
                code="paint-duplicate",
            )
            paired_references.update(matching)
            for instrument in dict.fromkeys(references[k].instrument for k in matching):
                group = tuple(references[k] for k in matching if references[k].instrument == instrument)
                matched.append(Pair(signature, group))
    reasons = {k: f": {match.text}" for k, match in by_place.items() if match.paint is None}
    unpaired_references = tuple(
        f"{reference.name} ({reference.instrument}{reasons.get(k, '')})"
        for k, reference in enumerate(references)
        if k not in paired_references
    )
    distinct = list(dict.fromkeys(match.text for match in by_place.values()))
    at = f"; by place: {'; '.join(distinct[:_MAX_LISTED_REASONS])}" if distinct else ""
    SchemaError.raise_if(
        not matched,
        "no paint has a reference of its name or place; paints are "
        f"{_listed([s.name for s in signatures])}, references "
        f"{_listed([f'{reference.name} ({reference.instrument})' for reference in references])}{at}",
        mend="name them with pairs={paint: reference}, or give regions a property reference",
        option="name them with --pairs, or give regions a property reference",
        code="reference-unmatched",
    )
    return matched, tuple(unpaired), unpaired_references, tuple(missing)


def _references_of_name(name: str, references: Sequence[Measured], problems: Problems) -> list[int]:
    # Numbers of the references that a name matches, of every instrument those of the first rank that matches.
    # Files of one name in different folders are not repeated readings of one paint: a problem.
    matches: dict[str, list[int]] = {}
    for rank in range(3):
        matches |= grouped(
            (reference.instrument, k)
            for k, reference in enumerate(references)
            if name in reference.ranks[rank] and reference.instrument not in matches
        )
    for instrument, numbers in matches.items():
        origins = {references[k].origin for k in numbers}
        if len(origins) > 1:
            in_datasets = len({dataset for dataset, _ in origins}) > 1
            candidates = _listed(
                [
                    references[k].name + (f" (dataset {references[k].origin[0]})" if in_datasets else "")
                    for k in numbers
                ]
            )
            problems.add(
                f"{name!r} may be any of {candidates} of {instrument}",
                mend="name one reference, or all repeated readings, with pairs={paint: reference}, or "
                "remove files",
                option="name one reference, or all repeated readings, with --pairs, or remove files",
                code="reference-ambiguous",
            )
    return [k for numbers in matches.values() for k in numbers]


def _listed(names: Sequence[str]) -> str:
    return listed(list(map(repr, names)), _MAX_LISTED_NAMES) or "none"


def _mean_reference(pair: Pair) -> Measured:
    # Mean of the readings of a pair, on the channels of the first reading, under the name of the paint
    first = pair.references[0]
    renamed = replace(first, name=pair.signature.name)
    if len(pair.references) == 1:
        return renamed
    operators = [operator_onto(first, reading) for reading in pair.references]
    values = np.stack(
        [resample(reading.values) for resample, reading in zip(operators, pair.references, strict=True)]
    )
    sd = values.std(axis=0, ddof=1)
    systematic = np.zeros(sd.shape) if first.u_systematic is None else first.u_systematic
    return replace(
        renamed,
        values=values.mean(axis=0),
        sd=sd,
        count=len(values),
        u_random=None,
        u_systematic=np.hypot(sd / np.sqrt(len(values)), systematic),
        covariance=None,
    )


#: Minimum angle from the mirror direction at which flakes of a leaning roof are compared [degree]: nearer, a
#: degree changes the light of a metallic by 2 to 10 %, beyond by about 1 %.
_MIN_ASPECULAR_DEG = 40.0
#: Maximum difference of this angle between a signature and its references [degree].
_MAX_ASPECULAR_CHANGE_DEG = 5.0

#: Number of random draws of errors; it determines their standard deviation to 2 %.
DRAWS = 1000


@dataclass(frozen=True, eq=False)
class Compared:
    # A pair on common bands
    pair: Pair
    bands: Measured  #: The spectrum whose channels are the common bands.
    signature: Floats  #: (band,): Reflectance [1]; NaN where unknown.
    reference: Floats  #: (band,): Mean reflectance of the readings [1]; NaN where unknown.
    operators: tuple[Operator, ...]  #: Resampling of the references, and last of the signature.
    #: Draws of the errors of signature and reference (draw, band); None where both are unknown.
    errors: tuple[Floats, Floats] | None

    @property
    def names(self) -> str:
        # Names of the references
        return ", ".join(reference.name for reference in self.pair.references)

    @property
    def instrument(self) -> str:
        # Instrument of the references
        instrument = self.pair.references[0].instrument
        return f"{self.pair.signature.instrument} against {instrument}" if self.pair.between else instrument

    @property
    def used(self) -> Bools:
        # Bands that are compared (band,)
        return np.isfinite(self.signature) & np.isfinite(self.reference)

    @property
    def coverage(self) -> Floats:
        # Part of each band's response covered by the channels of all spectra (band,)
        return np.asarray(np.min([operator.coverage for operator in self.operators], axis=0))

    @property
    def exclusion(self) -> str:
        # Reason why the spectra cannot be judged, although they can be compared; empty without one.
        signature = self.pair.signature
        if self.pair.between or not signature.finish:
            return ""
        text = f"{signature.finish} paint, whose level holds for one geometry only"
        angles = np.array([signature.aspecular, *(reading.aspecular for reading in self.pair.references)])
        reasons = (
            (np.isnan(angles[0]), ", and the signature states none: aspecular_angle is missing"),
            (
                np.isnan(angles).any(),
                ", and the reference states none: give it aspecular_angle [degree], "
                'measurement_geometry such as "45/0", or time, latitude and longitude',
            ),
            (
                np.ptp(angles) > _MAX_ASPECULAR_CHANGE_DEG,
                f": seen {angles[0]:.0f} degrees from the mirror direction, the reference "
                f"{', '.join(f'{angle:.0f}' for angle in angles[1:])}",
            ),
            (
                angles.min() < _MIN_ASPECULAR_DEG,
                f": {angles.min():.0f} degrees from the mirror direction, a degree of lean changes it by "
                f"several per cent; compare it at {_MIN_ASPECULAR_DEG:.0f} degrees or more",
            ),
        )
        return next((text + reason for applies, reason in reasons if applies), "")

    @property
    def matched(self) -> bool:
        # Whether values of any reference were changed to join detectors
        return any(reference.matched for reference in self.pair.references)

    def common(self, name: str) -> str:
        # Return the word in a field of the references; "mixed" where they differ
        words = {getattr(reference, name) for reference in self.pair.references}
        return words.pop() if len(words) == 1 else "mixed"

    def warnings(self) -> list[tuple[str, str]]:
        # Return code and text of each condition that the user can mend
        signature, reference_mirror = self.pair.signature, self.common("mirror")
        name, mirror, quantity = signature.name, signature.mirror, signature.quantity
        # how to mend a difference in quantity
        mends = {
            BODY: "give the reference the attributes measurement_geometry and specular_component, or extract "
            "signatures with coat=False",
            OUTSIDE: "extract signatures without the mirrored sky (specular_sky=True, or --specular-sky)",
            THROUGH_COAT: "extract signatures with coat=True, or call correct_coat",
        }
        quantities = dict.fromkeys(reference.quantity for reference in self.pair.references)
        if quantity and (others := [other for other in quantities if other and other != quantity]):
            return [
                (
                    "coats-differ",
                    f"{name}: the signature is a {quantity}, the reference a {other}: {mends[quantity]}",
                )
                for other in others
            ]
        if mirror == reference_mirror or not {mirror, reference_mirror} <= {"included", "excluded", "mixed"}:
            return []
        return [
            (
                "mirrored-sky-differs",
                f"{name}: the mirror image of the sky is {mirror} in the signature, {reference_mirror} in "
                "the reference; a clear coat mirrors 0.04 times the share of skylight; see "
                "remove_mirrored_sky",
            )
        ]

    def notes(self) -> tuple[str, ...]:
        # Return remarks for the reader of the result
        signature, references = self.pair.signature, self.pair.references
        has_flakes = bool(signature.finish) and not self.pair.between
        remarks = (
            (self.exclusion, f"not judged: {self.exclusion}"),
            (
                has_flakes and not self.exclusion,
                f"{signature.finish} paint, compared at its geometry: {signature.aspecular:.0f} degrees from "
                f"the mirror direction, the reference {references[0].aspecular:.0f}; the result holds for it "
                "only",
            ),
            (
                self.matched,
                "the reference is overlap-matched: its values were scaled below the join of its detectors",
            ),
            (self.bands is not signature, "the signature was resampled to the reference's bands"),
        )
        narrow = np.any(
            [~operator.is_covered & np.isfinite(operator.noise_gain) for operator in self.operators], axis=0
        )
        reasons = {
            "not covered completely, or without a value": ~self.used & ~narrow,
            "narrower than the other spectrum resolves": ~self.used & narrow,
        }
        notes = [
            *(note for reference in references for note in reference.notes),
            *(f"signature: {note}" for note in signature.notes),
            *(text for applies, text in remarks if applies),
            *(
                f"excluded of {self.used.size} bands: {int(excluded.sum())} {reason}"
                for reason, excluded in reasons.items()
                if excluded.any()
            ),
        ]
        is_absolute = signature.absolute
        if any(reference.absolute != is_absolute for reference in references):
            sides = ("reference", "signature") if is_absolute else ("signature", "reference")
            notes.append(
                f"the {sides[0]} is relative to a white panel, the {sides[1]} is absolute: the panel's own "
                f"reflectance is in the difference{'; pass panel=' if is_absolute else ''}"
            )
        has_uncertainty = {
            "signature": signature.has_uncertainty,
            "reference": len(references) > 1 or references[0].has_uncertainty,
        }
        if unknown := [side for side, is_known in has_uncertainty.items() if not is_known]:
            notes.append(f"the uncertainty of the {' and the '.join(unknown)} is unknown and not included")
        of_signature = (f"uncertainty of the signature: {text}" for text in signature.gaps())
        of_references = (
            f"uncertainty of the reference: {text}" for spectrum in references for text in spectrum.gaps()
        )
        return tuple(dict.fromkeys([*notes, *of_signature, *of_references]))

    @property
    def scatter(self) -> float:
        # Standard deviation of repeated readings, RMS over the bands compared [1]
        return (
            0.0
            if len(self.pair.references) < 2 or not self.used.any()
            else float(np.sqrt((self._spreads()["reference_sd"][self.used] ** 2).mean()))
        )

    def dataset(self) -> xr.Dataset:
        # Return both spectra on the common bands
        columns = {
            "signature": self.signature,
            "reference": self.reference,
            "difference": self.signature - self.reference,
            "coverage": self.coverage,
            **self._spreads(),
        }
        if self.errors is not None:
            for name, errors in zip(("signature_u", "reference_u"), self.errors, strict=True):
                columns[name] = np.sqrt((errors**2).mean(axis=0))
        meanings = dict(MEANINGS) | {
            name: f"Reflectance of the {name} on common bands" for name in ("signature", "reference")
        }
        variables = {
            name: (BAND, values, {"units": "1", "long_name": meanings[name]})
            for name, values in columns.items()
        }
        wavelength = (BAND, self.bands.wavelength, {"units": "nm", "long_name": "Centre of the common bands"})
        fwhm = (BAND, self.bands.fwhm, {"units": "nm", "long_name": "Width of the common bands"})
        return xr.Dataset(
            variables,
            {"wavelength": wavelength, "fwhm": fwhm, "used": (BAND, self.used)},
            {"signature": self.pair.signature.name, "reference": self.names, "instrument": self.instrument},
        )

    def _spreads(self) -> dict[str, Floats]:
        spreads = {}
        signature_sd, references = self.pair.signature.sd, self.pair.references
        if signature_sd is not None:
            spreads["signature_sd"] = self.operators[-1](signature_sd)
        if len(references) > 1:
            readings = [
                resample(reading.values)
                for resample, reading in zip(self.operators[:-1], references, strict=True)
            ]
            spreads["reference_sd"] = np.std(readings, axis=0, ddof=1)
        elif references[0].sd is not None:
            spreads["reference_sd"] = self.operators[0](references[0].sd)
        return spreads


def compare(pair: Pair, seed: int) -> Compared:
    # Resample a pair to common bands, and draw its errors there. Every pair has its own generator of the same
    # seed: the draws do not depend on the order of pairs.
    if not pair.between:
        pair = replace(
            pair, references=tuple(as_body(reference, pair.signature) for reference in pair.references)
        )
    references = list(pair.references)
    # The common bands are the channels of the coarser spectrum.
    # This is the signature, unless every reference is coarser in the common range.
    low, high = pair.signature.wavelength[[0, -1]]
    common_widths = (
        reference.fwhm[(reference.wavelength >= low) & (reference.wavelength <= high)]
        for reference in references
    )
    widths = [np.median(fwhm) if fwhm.size else 0.0 for fwhm in common_widths]
    is_coarser = min(widths) > _SAME_AXIS.max_equal_width_ratio * np.median(pair.signature.fwhm)
    bands = references[0] if is_coarser else pair.signature
    operators = tuple(operator_onto(bands, spectrum) for spectrum in (*pair.references, pair.signature))
    resampled = list(zip(operators[:-1], pair.references, strict=True))
    readings = np.stack([resample(reading.values) for resample, reading in resampled])
    rng, count = np.random.default_rng(seed), len(readings)
    errors = None
    if pair.signature.has_uncertainty or count > 1 or pair.references[0].has_uncertainty:
        of_signature = operators[-1](pair.signature.errors(rng, DRAWS))
        if count == 1:
            of_mean = operators[0](pair.references[0].errors(rng, DRAWS))
        else:
            # draws of the errors of the mean of readings (draw, band); the equation is in `validate`
            deviations = readings - readings.mean(axis=0)
            of_mean = rng.standard_normal((DRAWS, count)) @ deviations / np.sqrt(count * (count - 1.0))
            # readings of one instrument share its systematic error, which their scatter does not show
            systematic = [
                resample(reading.u_systematic)
                for resample, reading in resampled
                if reading.u_systematic is not None
            ]
            if systematic:
                of_mean += np.mean(systematic, axis=0) * rng.standard_normal((DRAWS, 1))
            # a few readings may agree by chance: their random uncertainty is added
            for resample, reading in resampled:
                if reading.u_random is not None:
                    noise = reading.u_random * rng.standard_normal((DRAWS, reading.u_random.size))
                    of_mean += resample(noise) / count
        errors = of_signature, np.asarray(of_mean)
    return Compared(
        pair, bands, operators[-1](pair.signature.values), readings.mean(axis=0), operators, errors
    )


# --- validation, band by band and in parts of the spectrum -------------------------------------------------


#: Parts of the spectrum [nm]: first wavelength, and end, exclusive.
PARTS: Mapping[str, tuple[float, float]] = {
    "VIS": (400.0, 700.0),
    "NIR": (700.0, 1000.0),
    "all": (0.0, np.inf),
}

#: Maximum RMSE between signature and reference: a share of the paint's level plus a floor [1]. These are the
#: values of the specification for surface reflectance of MODIS and Landsat, +-(0.005 + 0.05 rho): Vermote and
#: Kotchenova, J. Geophys. Res. 113, D23S90 (2008).
TOLERANCE: Mapping[str, float] = {RELATIVE: 0.05, FLOOR: 0.005}

#: Minimum number of compared bands of a part that is judged, and their minimum share of its bands.
_MIN_BANDS, _MIN_SHARE = 3, 0.5


@takes_quantities(reference_fwhm="nm", parts="nm")
@documented(signatures="library")
def validate(
    signatures: xr.Dataset,
    references: Any,
    pairs: Mapping[str, str | Sequence[str]] | None = None,
    *,
    tolerance: float | Mapping[str, float] | None = None,
    panel: xr.DataArray | xr.Dataset | None = None,
    panel_surface: Any = LAMBERTIAN,
    parts: Mapping[str, tuple[float, float]] | None = None,
    reference_fwhm: float | None = None,
    require_all: bool = False,
    place_accuracy: float = PLACE_ACCURACY_M,
    seed: int = 0,
) -> Validation:
    r"""Compare paint signatures with reference measurements of the same paints.

    Eager.

    Parameters
    ----------
    signatures
    references
        Datasets of reflectance, one or several: spectra of a field spectrometer (spectrum, wavelength), as of
        `hyperpaint.open_asd` and ``open_svc``, or a paint library (signature, band).
    pairs
        One or several names of references by name of a paint. By default the region property ``reference``
        names the reference of a paint; without it, the paint's name does, else its place if both have one
        (proposed regions of a line with navigation; files with GPS). Names of files match with and
        without folder and suffix; full names take precedence. Similar names do not match. Several readings of
        one instrument are averaged if they come from one folder and dataset, or if ``pairs`` names them all.
    tolerance
        By default the maximum RMSE is 0.005 + 5 % of the paint's level, the mean of the reference in a part:
        0.0065 for a black of 0.03, 0.045 for a white of 0.8, as in the specification for surface reflectance
        of MODIS and Landsat [1]_. A number is the maximum RMSE at any level [1]. A mapping has limits by
        name: ``relative`` (a share of the level) and ``floor`` (added to it, 0.005 by default), and
        statistics: ``bias``, ``rmse``, ``mae``, ``spectral_angle`` [degree], ``scale`` (its distance from 1),
        ``scale_free_error``. All limits hold in every part with bands; uncertainty does not widen them. A
        part with fewer than 3 compared bands, with less than half of its bands, or with a limit above half of
        its level, is not judged: it can fail, but not pass. If ``parts`` names such a part, or no part of a
        pair is judged, the pair fails.
    panel
        Certified reflectance of the white panel on ``wavelength`` [1], which multiplies references that are
        relative to it.
    panel_surface
        Surface of this panel, for its reflectance under the sun at the time and place of each reference and a
        clear sky, seen from the nadir: ``lambertian``, ``sintered-ptfe``, or a table of its factors or its
        file, see `hyperpaint.radiometry.panel_factor`.
    parts
        Parts of the spectrum by name: first wavelength, and end, exclusive [nm]. By default `PARTS`.
    reference_fwhm
        Width of the references' channels [nm]. By default ``fwhm`` of the data, else the usual width of the
        instrument, else twice the distance of channels; the result names the source.
    require_all
        Whether every paint must have a reference; by default only those whose region names one.
    place_accuracy
        Accuracy of the positions of paints and references [m]. A reference belongs to the nearest paint
        within this distance. A tie is no match: the next paint is less than this farther away, or several
        references of one instrument are there. The notes of a pair state its distances, and
        ``unpaired_references`` the reasons.
    seed
        Seed of the random draws for uncertainties.

    Returns
    -------
    Validation
        Statistics of every pair and part with uncertainties, spectra on common bands, unpaired names, and
        whether all pairs are within tolerance. Where several instruments measured a paint, ``between``
        compares their references in the same way.

    Raises
    ------
    SchemaError, UnitsError
        An input is not a library, has no reflectance or is not a certificate; a reference is absolute while
        ``panel`` is given, or has no time and place while ``panel_surface`` is; widths of channels are
        implausible; a pair has no band in common; ``pairs`` has unknown names; several paints, or references
        of several folders or datasets, share a name; or nothing can be paired. All problems of a kind are
        listed.

    Warns
    -----
    PaintWarning
        Only one of a pair includes the mirror image of the sky, or one is of the body under a coat and the
        other of the coat's outside (``quantity``); repeated readings, or readings of two instruments, differ
        by more than the tolerance; two paints agree with the references of one another, not with their own.

    Notes
    -----
    The finer spectrum is resampled to the bands of the coarser one, mostly the signature's: weights on its
    channels, with their widths, reproduce the response of each band
    (`hyperpaint.light.responses.matching_operator`; Gaussian line shapes). Bands covered by less than 99.9 %
    are excluded and counted, as are bands so narrow that resampling would multiply noise by more than 3. Two
    overlapping detectors, where wavelengths fall, are joined in the middle of the overlap, 987 nm for an SVC;
    ``open_svc(..., overlap="trim", joins=)`` joins them elsewhere. Reflectance is weighted by the response
    only: variation of the light within a band matters little.

    A metallic or pearl paint (``finish`` of the signature) has a level for one geometry only. It is judged
    where the reference states this geometry (``aspecular_angle``, ``measurement_geometry`` "45/0", or time,
    latitude and longitude of a sample that lay level under the sun and was seen from the nadir), if both were
    seen at 40 degrees or more from the mirror direction, and within 5 degrees of one another. Other pairs are
    shown and not judged, and the result notes the reason; they do not fail unless all pairs are such.

    Equal quantities are compared: where the signature is of the body under a clear coat, and the attributes
    of a reference declare a reading of the coat's outside (``quantity``, or ``specular_component``
    "included") and its geometry (``measurement_geometry`` such as "d/8", ``coat_index``), the reference is
    converted to the body, see `hyperpaint.validation.validating.as_body`; the result notes it.

    Statistics are plain means over bands, see `statistics_of`. Their uncertainty comes from propagated draws
    (JCGM 101): random errors independent from channel to channel, systematic errors common to all. The
    standard deviation of a single reference counts as systematic. Of n readings :math:`r_k` of one paint and
    one instrument the mean is compared, with errors drawn as

    .. math:: \delta r = \sum_k g_k (r_k - \bar r) / \sqrt{n (n - 1)}, \qquad g_k \sim N(0, 1),

    whose covariance over bands is the covariance of the mean. The systematic uncertainty of the readings,
    common to all, and their random uncertainty over :math:`\sqrt n` are added, since a few readings may agree
    by chance. Unknown components are not included, and the result notes it; uncertainties are NaN in bands
    without a component that other bands have.

    References
    ----------
    .. [1] E. F. Vermote, S. Kotchenova, "Atmospheric correction for the monitoring of land surfaces",
       J. Geophys. Res. 113, D23S90 (2008).

    Examples
    --------
    >>> import xarray as xr
    >>> nm = np.linspace(400.0, 700.0, 301)
    >>> field = xr.Dataset(
    ...     {"reflectance": (("spectrum", "wavelength"), [0.2 + 0.001 * (nm - 400.0)], {"units": "1"})},
    ...     {"wavelength": ("wavelength", nm, {"units": "nm"}), "spectrum": ["hood"]},
    ... )
    >>> at = np.linspace(430.0, 670.0, 25)
    >>> paints = xr.Dataset(
    ...     {"reflectance": (("signature", "band"), [0.21 + 0.001 * (at - 400.0)], {"units": "1"})},
    ...     {"signature": ["hood"], "wavelength": ("band", at, {"units": "nm"})},
    ... )
    >>> found = validate(paints, field, reference_fwhm=3.0)  # 0.01 of 0.35: less than 0.005 + 5 %
    >>> found.passed, round(float(found.statistics.bias.sel(part="VIS").item()), 4)
    (True, 0.01)
    """
    limits = _limits(tolerance)
    user_parts = parts is not None
    parts = PARTS if parts is None else parts
    problems = Problems("parts= cannot be used", SchemaError)
    of_all = Problem(
        f"{parts!r:.60}", expected="names with first and last wavelength [nm]", code="type-wrong"
    )
    problems.raise_if_any((not isinstance(parts, Mapping) or not parts, of_all))
    expected = "first and last wavelength [nm], in order"
    problems.raise_if_any(
        *(
            (
                len(tuple(edges)) != 2 or not edges[0] < edges[1],
                Problem(f"{name!r}: {edges!r:.60}", expected=expected, code="type-wrong"),
            )
            for name, edges in parts.items()
        )
    )
    # spectra of spectrometer datasets and paint libraries
    datasets = [references] if hasattr(references, "data_vars") else references
    if isinstance(datasets, Mapping):
        datasets = list(datasets.values())
    SchemaError.raise_if(
        not isinstance(datasets, Iterable) or isinstance(datasets, str),
        f"references are {type(references).__name__}",
        expected="a Dataset, or several",
        mend="see open_svc",
        code="type-wrong",
    )
    problems = Problems("references cannot be used", SchemaError)
    spectra: list[Measured] = []
    for number, dataset in enumerate(datasets, 1):
        with problems.noting((SchemaError, UnitsError), f"reference {number}"):
            spectra += _dataset_spectra(dataset, number, reference_fwhm)
    problems.raise_if_any(
        (
            not spectra and not problems,
            Problem(
                "references= is empty",
                mend="open references with open_svc, open_asd or open_library",
                code="empty-input",
            ),
        )
    )
    # serial numbers distinguish several instruments of one make
    serials = grouped((spectrum.instrument, spectrum.serial) for spectrum in spectra)
    reference_spectra = [
        replace(spectrum, instrument=f"{spectrum.instrument} {spectrum.serial}")
        if spectrum.serial and len(set(serials[spectrum.instrument])) > 1
        else spectrum
        for spectrum in spectra
    ]
    if panel is not None:
        reference_spectra = scaled_by_panel(reference_spectra, panel, panel_surface)
    SchemaError.raise_if(
        not hasattr(signatures, "data_vars"),
        f"signatures are {type(signatures).__name__}",
        expected="a paint library (xarray.Dataset)",
        code="type-wrong",
    )
    paints = list(_library_spectra(with_band_dim(signatures), 0, None, "band"))
    matched, unpaired_signatures, unpaired_references, missing = paired(
        paints, reference_spectra, pairs, place_accuracy
    )
    compared = [compare(pair, seed) for pair in matched]
    # references of one paint, measured by two instruments, against one another
    between = [
        compare(Pair(_mean_reference(first), second.references, between=True), seed)
        for _, same_paint in itertools.groupby(matched, key=lambda pair: id(pair.signature))
        for first, second in itertools.combinations(same_paint, 2)
    ]
    between = [comparison for comparison in between if comparison.used.any()]
    with Problems("pairs have no band in common", SchemaError) as problems:
        for comparison in (comparison for comparison in compared if not comparison.used.any()):
            ranges = ", ".join(
                f"{spectrum.name} {spectrum.wavelength[0]:g} to {spectrum.wavelength[-1]:g} nm"
                for spectrum in (comparison.pair.signature, *comparison.pair.references)
            )
            problems.add(
                f"{comparison.pair.signature.name!r}: paint and reference share no complete band ({ranges})",
                code="range-disjoint",
            )
    # a text where repeated readings scatter by more than the tolerance of their mean
    scatters: list[list[str]] = []
    for comparison in compared:
        level = np.asarray(comparison.reference[comparison.used].mean())
        limit = float(np.fmin(_rmse_limit(limits, level), limits.get("mae", np.nan)))
        text = (
            f"readings of the reference scatter by {comparison.scatter:.2g}, more than the tolerance of "
            f"{limit:.2g}; check whether they show one paint"
        )
        scatters.append([text] if comparison.scatter > limit else [])
    messages = [
        *(message for comparison in compared for message in comparison.warnings()),
        *(
            ("reference-scatter", f"{comparison.pair.signature.name}: {text}")
            for comparison, texts in zip(compared, scatters, strict=True)
            for text in texts
        ),
        *(("references-exchanged", text) for text in _exchanged(compared)),
    ]
    between_instruments = None
    if between:
        between_instruments = Validation(
            statistics=_statistics(between, parts, limits, user_parts=user_parts),
            spectra=tuple(comparison.dataset() for comparison in between),
            notes=((),) * len(between),
            unpaired_signatures=(),
            unpaired_references=(),
            missing=(),
            tolerance=limits,
        )
        found = between_instruments.statistics
        outside = (found["judged"] & ~found["passes"]).values
        messages += [
            (
                "references-disagree",
                f"{found['signature'].values[row]}: {found['instrument'].values[row]} is beyond the "
                f"tolerance in {', '.join(found['part'].values[outside[row]])}; check both references",
            )
            for row in np.flatnonzero(outside.any(axis=1))
        ]
    unique_messages = dict.fromkeys(messages)
    for code, text in unique_messages:
        warn_user(text, code)
    return Validation(
        statistics=_statistics(compared, parts, limits, user_parts=user_parts),
        spectra=tuple(comparison.dataset() for comparison in compared),
        notes=tuple(
            (*comparison.notes(), *texts) for comparison, texts in zip(compared, scatters, strict=True)
        ),
        unpaired_signatures=unpaired_signatures,
        unpaired_references=unpaired_references,
        missing=unpaired_signatures if require_all else missing,
        tolerance=limits,
        between=between_instruments,
        remarks=tuple(f"{text} [{code}]" for code, text in unique_messages),
    )


_EXCHANGE = SimpleNamespace(
    #: Two paints seem exchanged where their RMSE with the references of one another over the RMSE with their
    #: own references is below this share [1]: samples that laboratories exchanged have 0.15 to 0.45.
    share=0.6,
    #: Minimum RMSE of a paint with its own reference that may be exchanged [1].
    min_rmse=0.01,
    #: Maximum number of paints in this search: those farthest from their references.
    max_paints=200,
)


def _exchanged(compared: Sequence[Compared]) -> list[str]:
    # Texts about pairs of paints that agree with the references of one another better than with their own
    def rmse(signature_side: Compared, reference_side: Compared) -> float:
        used = signature_side.used & reference_side.used
        difference = (signature_side.signature - reference_side.reference)[used]
        return float(np.sqrt((difference**2).mean())) if used.any() else np.nan

    compared = [comparison for comparison in compared if not comparison.exclusion]
    own_rmse = np.array([rmse(comparison, comparison) for comparison in compared])
    candidates = np.flatnonzero(own_rmse > _EXCHANGE.min_rmse)
    farthest = np.sort(candidates[np.argsort(-own_rmse[candidates])][: _EXCHANGE.max_paints]).tolist()
    texts = []
    for i, j in itertools.combinations(farthest, 2):
        first, second = compared[i], compared[j]
        names = first.pair.signature.name, second.pair.signature.name
        comparable = first.instrument == second.instrument and names[0] != names[1]
        if not (comparable and np.array_equal(first.bands.wavelength, second.bands.wavelength)):
            continue
        crossed = rmse(first, second), rmse(second, first)
        limit = _EXCHANGE.share * (own_rmse[i] + own_rmse[j])
        # both must agree: of three paints exchanged in turn, only one of two does
        both_agree = (np.array(crossed) < own_rmse[[i, j]]).all() and max(crossed) < 0.5 * limit
        if sum(crossed) < limit and both_agree:
            texts.append(
                f"{names[0]} and {names[1]}: each agrees with the reference of the other (RMSE "
                f"{crossed[0]:.3f} and {crossed[1]:.3f}, with its own {own_rmse[i]:.3f} and "
                f"{own_rmse[j]:.3f}); check whether the samples, or their names, were exchanged"
            )
    return texts


def _rmse_limit(limits: Mapping[str, float], level: Floats) -> Floats:
    # Maximum RMSE at levels of paints; NaN without a limit
    of_level = limits[FLOOR] + limits[RELATIVE] * np.abs(level) if RELATIVE in limits else np.inf
    limit = np.fmin(np.full(np.shape(level), limits.get("rmse", np.inf)), of_level)
    return np.where(np.isfinite(limit), limit, np.nan)


def _limits(tolerance: Any) -> dict[str, float]:
    limits = {"rmse": tolerance} if tolerance is not None else TOLERANCE
    limits = dict(tolerance) if isinstance(tolerance, Mapping) else dict(limits)
    with Problems("tolerance= cannot be used", SchemaError) as problems:
        for name, limit in limits.items():
            one_of(name, (RELATIVE, FLOOR, *STATISTICS), "statistic", problems=problems)
            problems.add_if(
                isinstance(limit, bool) or not isinstance(limit, int | float) or not limit >= 0.0,
                f"{name}: {limit!r}",
                expected="a number from 0 on",
                code="value-out-of-range",
            )
        problems.add_if(
            not limits, "no limit", mend="pass at least one limit, such as rmse 0.02", code="argument-missing"
        )
        if RELATIVE in limits:
            limits.setdefault(FLOOR, TOLERANCE[FLOOR])
        elif FLOOR in limits:
            problems.add(
                "floor is added to a share of the paint's level",
                mend="pass relative as well, such as 0.05",
                code="option-conflict",
            )
    return {name: float(limit) for name, limit in limits.items()}


def _statistics(
    compared: Sequence[Compared],
    parts: Mapping[str, tuple[float, float]],
    limits: Mapping[str, float],
    *,
    user_parts: bool,
) -> xr.Dataset:
    # Statistics of every pair and part; `user_parts`: whether the user named the parts
    shape = len(compared), len(parts)
    names = (*STATISTICS, *(f"{name}_u" for name in STATISTICS), "coverage", "level")
    statistics = {name: np.full(shape, np.nan) for name in names}
    bands, excluded_bands = np.zeros(shape, np.int64), np.zeros(shape, np.int64)
    for row, comparison in enumerate(compared):
        for column, edges in enumerate(parts.values()):
            nm = comparison.bands.wavelength
            in_part = (nm >= edges[0]) & (nm < edges[1])
            used = in_part & comparison.used
            bands[row, column], excluded_bands[row, column] = used.sum(), (in_part & ~used).sum()
            if not used.any():
                continue
            spectra = comparison.signature[used], comparison.reference[used]
            of_part = statistics_of(*spectra)
            of_part |= {"coverage": comparison.coverage[used].min(), "level": spectra[1].mean()}
            if comparison.errors is not None:
                uncertainties = uncertainty_of(*spectra, *(errors[:, used] for errors in comparison.errors))
                of_part |= {f"{name}_u": value for name, value in uncertainties.items()}
            for name, value in of_part.items():
                statistics[name][row, column] = value
    statistics["rmse_limit"] = _rmse_limit(limits, statistics["level"])
    dims = ("pair", "part")
    arrays = {**statistics, "bands": bands, "bands_left_out": excluded_bands}
    variables: dict[str, Any] = {name: (dims, values, _attrs(name)) for name, values in arrays.items()}
    too_dark = (
        statistics["rmse_limit"] > MAX_TOLERANCE_SHARE * statistics["level"] if RELATIVE in limits else False
    )
    judged = (bands >= _MIN_BANDS) & (bands >= _MIN_SHARE * (bands + excluded_bands)) & ~np.asarray(too_dark)
    # Whether pairs pass in parts (pair, part). A part that is not judged fails outside of a limit, if the
    # user named it, or if no part of the pair is judged.
    within, outside = np.ones(judged.shape, bool), np.zeros(judged.shape, bool)
    statistic_limits: dict[str, Any] = {
        name: limit for name, limit in limits.items() if name in STATISTICS and name != "rmse"
    }
    if "rmse" in limits or RELATIVE in limits:
        statistic_limits["rmse"] = statistics["rmse_limit"]
    for name, limit in statistic_limits.items():
        deviation = np.abs(statistics[name] - 1.0 if name == "scale" else statistics[name])
        # NaN is neither within nor outside
        within &= deviation <= limit
        outside |= deviation > limit
    may_pass = judged | ~np.logical_or(user_parts, ~judged.any(axis=1, keepdims=True))
    passes = np.asarray(~outside & may_pass & (within | ~judged))
    # a pair that cannot be judged does not fail, if another one is judged
    reasons = [comparison.exclusion for comparison in compared]
    excluded = np.array([bool(reason) for reason in reasons])[:, None]
    judged &= ~excluded
    passes = np.where(excluded, not excluded.all(), passes)
    for name, flags in (("judged", judged), ("passes", passes)):
        variables[name] = (dims, flags, {"long_name": MEANINGS[name]})
    for name, side in (("oxygen_residual", "signature"), ("reference_oxygen_residual", "reference")):
        depth = [
            oxygen_depth(comparison.bands.wavelength, getattr(comparison, side)) for comparison in compared
        ]
        variables[name] = ("pair", np.array(depth, np.float64), _attrs(name))
    texts = {
        "signature": [comparison.pair.signature.name for comparison in compared],
        "reference": [comparison.names for comparison in compared],
        "instrument": [comparison.instrument for comparison in compared],
        "overlap": [comparison.common("overlap") for comparison in compared],
        "mirror_reflection": [comparison.common("mirror") for comparison in compared],
        "exclusion": reasons,
        "uncertainty": ["; ".join(comparison.pair.signature.gaps()) for comparison in compared],
    }
    matched = np.array([comparison.matched for comparison in compared], bool)
    coords: dict[str, Any] = {
        name: ("pair", np.array(column, object), {"long_name": MEANINGS[name]})
        for name, column in texts.items()
    } | {
        "overlap_matched": ("pair", matched, {"long_name": MEANINGS["overlap_matched"]}),
        "part": np.array(list(parts), object),
    }
    for name, end in (("first_wavelength", 0), ("last_wavelength", 1)):
        coords[name] = ("part", np.array([edges[end] for edges in parts.values()], np.float64), _attrs(name))
    return xr.Dataset(variables, coords, {"title": "Agreement of paint signatures with references"})


def _attrs(name: str) -> dict[str, str]:
    units = "degree" if name.startswith("spectral_angle") else "nm" if name.endswith("wavelength") else "1"
    meaning = MEANINGS[name] if name in MEANINGS else f"Standard uncertainty of {name.removesuffix('_u')}"
    return {"units": units, "long_name": meaning}
