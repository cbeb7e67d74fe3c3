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
    """Thresholds by which the numbers of a table are not reflectance.

    min_oxygen_depth
        Depth of the oxygen band at 760 nm, relative to its lower shoulder [1], from which values look like
        radiance or irradiance: sunlight has 0.5 to 0.9 at bandwidths of 1 to 5 nm and 0.2 at 15 nm; in
        thirty real libraries of reflectance the maximum is 0.023.
    oxygen_step_nm
        Maximum spacing of wavelengths at which this depth is judged [nm].
    max_spread_ratio
        Maximum median ratio of a third column to the second [1] by which a third column without a heading
        is a standard deviation. A real lawn has 0.2. Two paints below this ratio need headings.
    max_repeats
        Maximum share of wavelengths that occur again in rows that are not adjacent [1], by which they come
        from overlapping detectors: 0.002 in exports of SVC; two spectra, one below the other, have 0.5.
    """

    min_oxygen_depth: float = 0.1
    oxygen_step_nm: float = 6.0
    max_spread_ratio: float = 0.5
    max_repeats: float = 0.05


RULES = QuantityRules()
NO_SPREAD, IS_SPREAD = -1, -2
SAY_SO = "pass quantity='reflectance' if the values are reflectance"

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
    """Check that the headings and units of a table do not name another quantity than reflectance.

    preamble: Lines above the numbers; headings: names of all columns, or none.

    Raises FormatError: A heading names radiance, irradiance, counts, transmittance or a statistic; or the
        lines above name such a quantity and not reflectance.
    """
    foreign = [name.strip() for name in headings[1:] if _foreign(name) or _STATISTIC.fullmatch(name.strip())]
    if foreign:
        raise FormatError(
            f"{source}: column headings name {', '.join(map(repr, foreign[:5]))}",
            expected="reflectance",
            mend=f"remove these columns, or {SAY_SO}",
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
    # Word or unit of another quantity than reflectance, empty if there is none
    if word := other_quantity(text):
        return word
    if "reflect" in text.lower():
        return ""
    match = _OF_LIGHT.search(text) or _COUNTED.search(text)
    return match[0].strip() if match else ""


def spread_columns(headings: Sequence[str], values: Floats, source: str, *, is_reflectance: bool) -> Ints:
    """Return for each column the index of its standard deviation, `NO_SPREAD`, or `IS_SPREAD`.

    headings: Names of the columns, wavelengths first; empty for a file without headings.
    values: (column, band).
    is_reflectance: Whether columns without headings are reflectance, without a check of their values.

    Raises FormatError: The heading of the first spectrum is a standard deviation.
    Warns PaintWarning: There are three columns without headings, and the third looks like the standard
        deviation of the second.
    """
    roles = np.full(len(values), NO_SPREAD)
    if headings:
        paints = [_paint_name(heading) for heading in headings[1:]]
        names_spread = np.array([_SPREAD.search(heading) is not None for heading in headings[1:]])
        mean_paints = [paint for paint, spread in zip(paints, names_spread, strict=True) if not spread]
        # "White Std" may be the name of a paint: it is a spread only beside a column "White"
        in_words = [_IN_FULL.search(heading) is not None for heading in headings[1:]]
        is_spread = names_spread & np.array(
            [word or not paint or paint in mean_paints for word, paint in zip(in_words, paints, strict=True)]
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
            of_same_paint = [int(column) for column in spectra if paints[at] and paints[column] == paints[at]]
            mean = of_same_paint[0] if of_same_paint else spectra[spectra < at][-1]
            roles[mean] = at if roles[mean] == NO_SPREAD else roles[mean]
    elif len(values) == 2 and not is_reflectance and _looks_like_spread(*values):
        text = (
            f"{source}: three columns without headings; the third is taken for the standard deviation of the "
            "second; add headings, or pass quantity='reflectance' if the third is a paint"
        )
        warnings.warn(PaintWarning(text, code="spread-assumed"), stacklevel=6)
        roles[:] = 1, IS_SPREAD
    return roles


def _paint_name(heading: str) -> str:
    # Letters and digits of a heading without its words for mean and standard deviation
    return "".join(sign for sign in _MEAN.sub(" ", _SPREAD.sub(" ", heading.lower())) if sign.isalnum())


def _looks_like_spread(mean: Floats, spread: Floats) -> bool:
    comparable = np.isfinite(mean) & np.isfinite(spread) & (mean > 0)
    if not comparable.any() or (spread[comparable] < 0).any():
        return False
    return bool(np.median(spread[comparable] / mean[comparable]) <= RULES.max_spread_ratio)


def without_repeats(wavelength: Floats, values: Floats, source: str) -> tuple[Floats, Floats, list[str]]:
    """Return wavelengths and values (band, spectrum) with successive equal wavelengths merged, and notes.

    Of equal rows one is kept; different values are averaged.

    Raises FormatError: Many wavelengths occur again in rows that are not adjacent, as of two spectra one
        below the other.
    Warns PaintWarning: Values were averaged.
    """
    starts = np.flatnonzero(np.diff(wavelength, prepend=np.nan) != 0)  # first rows of equal wavelengths
    distant_share = 1.0 - np.unique(wavelength[starts]).size / starts.size
    adjacent = wavelength.size - starts.size
    if distant_share > RULES.max_repeats or 2 * adjacent >= wavelength.size:
        repeats = wavelength.size - np.unique(wavelength).size
        raise FormatError(
            f"{source}: {repeats} of {wavelength.size} wavelengths occur twice",
            expected="one row per wavelength, and one column per spectrum",
            mend="put spectra side by side, or write wavelengths with more digits",
            code="wavelength-duplicate",
        )
    if not adjacent:
        return wavelength, values, []
    counts = np.diff(np.append(starts, wavelength.size))
    means = np.add.reduceat(values, starts, axis=0) / counts[:, None]
    difference = 2.0 * float(np.nanmax(np.abs(values - np.repeat(means, counts, axis=0)), initial=0.0))
    example = wavelength[starts[counts > 1][0]]
    text = f"{adjacent} wavelengths are equal to that of the row before, such as {example:g}"
    if difference <= 1e-12 * float(np.nanmax(np.abs(values), initial=0.0)):
        return wavelength[starts], values[starts], [f"{text}: one of the equal rows is kept"]
    text = f"{text}: their values, which differ by up to {difference:.3g}, are averaged"
    warnings.warn(PaintWarning(f"{source}: {text}", code="wavelength-duplicate"), stacklevel=6)
    return wavelength[starts], means, [text]


def warn_of_light(wavelength: Floats, reflectance: Floats32, source: str) -> None:
    """Warn of spectra with the oxygen band of sunlight, which reflectance does not have.

    wavelength: (band,) [nm]; reflectance: (signature, band) [1].

    Warns PaintWarning: A spectrum has the band.
    """
    order = np.argsort(wavelength, kind="stable")
    nm, values = wavelength[order], reflectance[:, order].astype(np.float64)
    left, inside, right = ((nm >= lo) & (nm <= hi) for lo, hi in ((745, 755), (757, 767), (771, 781)))
    near = nm[(nm >= 745) & (nm <= 781)]
    if not (left.any() and inside.any() and right.any()) or np.diff(near).max() > RULES.oxygen_step_nm:
        return
    # the lower shoulder, since the reflectance of a paint that is black in the visible rises across the band
    shoulder = np.minimum(values[:, left].mean(axis=1), values[:, right].mean(axis=1))
    dip = shoulder - values[:, inside].min(axis=1)
    light = np.flatnonzero(dip > RULES.min_oxygen_depth * np.maximum(shoulder, 1e-6))
    if light.size:
        depth = dip[light[0]] / shoulder[light[0]] if shoulder[light[0]] > 0 else np.inf
        text = (
            f"{source}: {light.size} of {len(values)} spectra have the oxygen band of sunlight at 760 nm "
            f"({depth:.0%} deep), which reflectance does not have: are they radiance or irradiance? {SAY_SO}"
        )
        warnings.warn(PaintWarning(text, code="sunlight-in-reflectance"), stacklevel=6)
