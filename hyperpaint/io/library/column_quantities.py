"""Roles of the columns of a table of spectra: reflectance, its spread, or another quantity."""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hyperpaint.base.arrays import Floats, Floats32, Ints
from hyperpaint.base.errors import FormatError, PaintWarning

from .text_spectra import other_quantity


@dataclass(frozen=True)
class QuantityRules:
    """Thresholds above which numbers of a table do not pass as reflectance.

    min_oxygen_depth
        Depth of the band of oxygen at 760 nm [1], below the lower of both sides, from which on
        values look like light: sun through air has 0.5 to 0.9 at 1 to 5 nm and 0.2 at 15 nm; thirty real
        libraries of reflectance have 0.023 at the most.
    oxygen_step_nm
        Widest spacing of wavelengths at which that is judged [nm].
    max_spread_ratio
        Median of a third column over the second, up to which it is a spread where nothing names it [1]. Of a
        real lawn it is 0.2; a pair of paints that differ more than twice asks for headings.
    max_repeats
        Share of wavelengths that occur twice apart from each other, up to which these are detectors that
        overlap [1]: 0.002 in exports of SVC; two spectra one below the other have 0.5.
    """

    min_oxygen_depth: float = 0.1
    oxygen_step_nm: float = 6.0
    max_spread_ratio: float = 0.5
    max_repeats: float = 0.05


RULES = QuantityRules()
NO_SPREAD, IS_SPREAD = -1, -2
SAY_SO = "pass quantity='reflectance' if it is reflectance after all"

_SPREAD = re.compile(
    r"(?<![a-z])(?:standard[ _.-]?dev\w*|st\.? ?dev\w*|std(?:ev|dev)?|s\.?d\.?|sigma|stdv|1s)(?![a-z])", re.I
)
_STATISTIC = re.compile(
    r"(?<![a-z])(?:variance|var|uncertaint\w*|unc|errors?|std ?err\w*|sem|cov|snr|flags?|qc|weights?|"
    r"n ?(?:obs|spectra|samples)?|number)(?![a-z])",
    re.I,
)
_IN_FULL = re.compile(r"standard[ _.-]?dev|st\.? ?dev|std[ _.-]?dev", re.I)
_MEAN = re.compile(r"(?<![a-z])(?:mean|average|avg|reflectance|reflectivity|refl|of|the)(?![a-z])", re.I)
_OF_LIGHT = re.compile(
    r"(?<![a-z])[mµμun]?W(?:att)?s?[ */.·]*(?:c?m\^?-?\(?-?2|/ ?c?m)|/ ?sr\b|\bsr\^?-1", re.I
)
_COUNTED = re.compile(r"irrad|digital (?:number|count)s?|photons?\b|volts?\b", re.I)
_TITLE = re.compile(r"irradianc\w*|radianc\w*|transmittance|absorbance|emissivity", re.I)


def check_words(preamble: Sequence[str], headings: Sequence[str], source: str) -> None:
    """Refuse a table whose headings or units name another quantity.

    preamble: Lines above the numbers; headings: names of the columns, as many as there are, or none.

    Raises FormatError: A column is named after light, counts, transmittance or a statistic; or the lines
        above name such a quantity and do not name reflectance.
    """
    foreign = [name.strip() for name in headings[1:] if _foreign(name) or _STATISTIC.fullmatch(name.strip())]
    if foreign:
        raise FormatError(
            f"{source}: column headings name {', '.join(map(repr, foreign[:5]))}",
            expected="reflectance",
            mend=f"leave those columns out, or {SAY_SO}",
            code="quantity-wrong",
        )
    preamble_text = " ".join(preamble)
    word = _foreign(preamble[-1] if preamble else "")
    if (
        not word
        and "reflect" not in preamble_text.lower()
        and (title := _TITLE.search(preamble_text) or _OF_LIGHT.search(preamble_text))
    ):
        word = title[0]
    if word:
        raise FormatError(
            f"{source}: the heading names {word!r}",
            expected="reflectance",
            mend=SAY_SO,
            code="quantity-wrong",
        )


def _foreign(text: str) -> str:
    # The word or unit of another quantity than reflectance; empty without one.
    if word := other_quantity(text):
        return word
    if "reflect" in text.lower():
        return ""
    match = _OF_LIGHT.search(text) or _COUNTED.search(text)
    return match[0].strip() if match else ""


def spread_columns(headings: Sequence[str], values: Floats, source: str, *, is_reflectance: bool) -> Ints:
    """Return for each column the index of its standard deviation, `NO_SPREAD`, or `IS_SPREAD`.

    headings: Names of the columns, wavelengths first; none where the file has none. values: (column, band).
    is_reflectance: Columns without headings are reflectance without a check of their values.

    Raises FormatError: The first column is named a standard deviation.
    Warns PaintWarning: Nothing names three columns, and the last looks like the spread of the one before.
    """
    roles = np.full(len(values), NO_SPREAD)
    if headings:
        bare = [_bare(name) for name in headings[1:]]
        named = np.array([_SPREAD.search(name) is not None for name in headings[1:]])
        means = [name for name, spread in zip(bare, named, strict=True) if not spread]
        # "White Std" may be a paint: it is a spread only beside a column "White"
        in_full = [_IN_FULL.search(name) is not None for name in headings[1:]]
        is_spread = named & np.array(
            [full or not name or name in means for full, name in zip(in_full, bare, strict=True)]
        )
        if is_spread[0]:
            raise FormatError(
                f"{source}: the first spectrum is named {headings[1].strip()!r}",
                expected="reflectance before its standard deviation",
                code="column-order",
            )
        roles[is_spread] = IS_SPREAD
        for at in np.flatnonzero(is_spread):
            spectra = np.flatnonzero(~is_spread)
            alike = [int(other) for other in spectra if bare[at] and bare[other] == bare[at]]
            owner = alike[0] if alike else spectra[spectra < at][-1]
            roles[owner] = at if roles[owner] == NO_SPREAD else roles[owner]
    elif len(values) == 2 and not is_reflectance and _looks_like_spread(*values):
        text = (
            f"{source}: three columns without headings; the third is taken for the standard deviation of the "
            "second; name the columns, or pass quantity='reflectance' if it is a paint"
        )
        warnings.warn(PaintWarning(text, code="spread-assumed"), stacklevel=6)
        roles[:] = 1, IS_SPREAD
    return roles


def _bare(heading: str) -> str:
    return "".join(sign for sign in _MEAN.sub(" ", _SPREAD.sub(" ", heading.lower())) if sign.isalnum())


def _looks_like_spread(mean: Floats, spread: Floats) -> bool:
    comparable = np.isfinite(mean) & np.isfinite(spread) & (mean > 0)
    if not comparable.any() or (spread[comparable] < 0).any():
        return False
    return bool(np.median(spread[comparable] / mean[comparable]) <= RULES.max_spread_ratio)


def without_repeats(wavelength: Floats, values: Floats, source: str) -> tuple[Floats, Floats, list[str]]:
    """Return wavelengths and values (band, spectrum) with successive repeats merged, and notes on it.

    Rows that are the same count once; values that differ are averaged.

    Raises FormatError: Many wavelengths occur twice apart from each other, as of two spectra one below the
        other.
    Warns PaintWarning: Values were averaged.
    """
    starts = np.flatnonzero(np.diff(wavelength, prepend=np.nan) != 0)
    difference = 1.0 - np.unique(wavelength[starts]).size / starts.size
    doubled = wavelength.size - starts.size
    if difference > RULES.max_repeats or 2 * doubled >= wavelength.size:
        twice = wavelength.size - np.unique(wavelength).size
        raise FormatError(
            f"{source}: {twice} of {wavelength.size} wavelengths occur twice",
            expected="one row a wavelength, and one column a spectrum",
            mend="put spectra side by side, or write wavelengths with more digits",
            code="wavelength-duplicate",
        )
    if not doubled:
        return wavelength, values, []
    counts = np.diff(np.append(starts, wavelength.size))
    means = np.add.reduceat(values, starts, axis=0) / counts[:, None]
    difference = 2.0 * float(np.nanmax(np.abs(values - np.repeat(means, counts, axis=0)), initial=0.0))
    first = wavelength[starts[counts > 1][0]]
    text = f"{doubled} wavelengths stand twice in a row, such as {first:g}"
    if difference <= 1e-12 * float(np.nanmax(np.abs(values), initial=0.0)):
        return wavelength[starts], values[starts], [f"{text}: the same rows count once"]
    text = f"{text}: their values, up to {difference:.3g} apart, are averaged"
    warnings.warn(PaintWarning(f"{source}: {text}", code="wavelength-duplicate"), stacklevel=6)
    return wavelength[starts], means, [text]


def warn_of_light(wavelength: Floats, reflectance: Floats32, source: str) -> None:
    """Warn of spectra with the oxygen band of sunlight, which reflectance does not have.

    wavelength: (band,) [nm]; reflectance: (signature, band) [1].

    Warns PaintWarning: One has it.
    """
    order = np.argsort(wavelength, kind="stable")
    nm, values = wavelength[order], reflectance[:, order].astype(np.float64)
    below, inside, above = ((nm >= lo) & (nm <= hi) for lo, hi in ((745, 755), (757, 767), (771, 781)))
    near = nm[(nm >= 745) & (nm <= 781)]
    if not (below.any() and inside.any() and above.any()) or np.diff(near).max() > RULES.oxygen_step_nm:
        return
    # the lower shoulder, since paint that is black in the visible only rises across the band
    shoulder = np.minimum(values[:, below].mean(axis=1), values[:, above].mean(axis=1))
    dip = shoulder - values[:, inside].min(axis=1)
    light = np.flatnonzero(dip > RULES.min_oxygen_depth * np.maximum(shoulder, 1e-6))
    if light.size:
        depth = dip[light[0]] / shoulder[light[0]] if shoulder[light[0]] > 0 else np.inf
        text = (
            f"{source}: {light.size} of {len(values)} spectra have the oxygen band of sunlight at 760 nm "
            f"({depth:.0%} deep), which reflectance does not have: are they radiance or irradiance? {SAY_SO}"
        )
        warnings.warn(PaintWarning(text, code="sunlight-in-reflectance"), stacklevel=6)
