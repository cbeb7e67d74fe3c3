"""Spectra prepared for validation: names, origin, values and uncertainties."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import PurePath
from typing import Any

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.units import convert

_SUFFIXES = (".asd", ".sig", ".txt", ".tsv", ".csv")


@dataclass(frozen=True)
class Names:
    """Names of one spectrum."""

    shown: str  #: Name in results.
    #: Names for pairing, by rank: full names; names without suffix; names without folder, which spectra of
    #: other folders may share. A match of one rank excludes matches of later ranks.
    ranks: tuple[frozenset[str], frozenset[str], frozenset[str]]
    #: Number of the dataset, and folder in it: only readings of one origin are repeats of one another.
    origin: tuple[int, str]

    @property
    def every(self) -> frozenset[str]:
        """Names of all ranks."""
        return frozenset[str]().union(*self.ranks)


def names_of_paint(name: str, dataset: int) -> Names:
    """Return the names of a paint of a library."""
    return Names(name, (frozenset({name}), frozenset(), frozenset()), (dataset, ""))


def names_of_spectrum(spectrum: str, source: str, further: str, number: int, dataset: int) -> Names:
    """Return the names of a spectrum of a field spectrometer.

    ``spectrum``: its name, preceded by the folder where names repeat; ``source``: its file; ``further``: a
    further name; any of these may be empty. ``number``: number of the spectrum in its dataset; ``dataset``:
    number of the dataset.

    Examples
    --------
    >>> names = names_of_spectrum("site1/red", "red.sig", "", 0, 1)
    >>> [sorted(rank) for rank in names.ranks], names.origin
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
    return Names(shown, (full, no_suffix, aliases - full - no_suffix), (dataset, folder + numbered))


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
    """One spectrum of reflectance with its origin and uncertainty."""

    names: Names  #: Names for pairing, and the origin.
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
    covariance: Floats | None = (
        None  #: (channel, channel): Covariance of both uncertainties [1]; None if unknown.
    )

    @property
    def name(self) -> str:
        """Name in results."""
        return self.names.shown

    @property
    def has_uncertainty(self) -> bool:
        """Whether any part of the uncertainty is known."""
        return any(component is not None for component in (self.u_random, self.u_systematic, self.sd))

    def gaps(self) -> list[str]:
        """Return the unknown parts of the uncertainty, for the reader of the result."""
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
        """Return random draws of the errors of the values (draw, channel).

        They follow the covariance where it is known; else random errors are independent and systematic errors
        common to all channels. Where neither is known, the standard deviation of the mean counts as
        systematic: readings of a surface differ in level more than in shape. NaN in channels without an
        uncertainty that other channels have.
        """
        if self.covariance is not None:
            missing = np.isnan(np.diagonal(self.covariance))
            # truncated correlations cause eigenvalues slightly below zero
            variances, vectors = np.linalg.eigh(np.nan_to_num(self.covariance))
            components = vectors * np.sqrt(np.maximum(variances, 0.0))
            errors = rng.standard_normal((draws, variances.size)) @ components.T
            return np.asarray(np.where(missing, np.nan, errors))
        errors = np.zeros((draws, self.values.size))
        if self.u_random is not None:
            errors += self.u_random * rng.standard_normal(errors.shape)
        systematic = self.u_systematic
        if systematic is None and self.u_random is None and self.sd is not None:
            systematic = self.sd / np.sqrt(self.count)
        if systematic is not None:
            errors += systematic * rng.standard_normal((draws, 1))
        return errors


def scaled_by_panel(spectra: list[Measured], panel: Any) -> list[Measured]:
    """Return references multiplied by the reflectance of their white panel.

    ``spectra``: references relative to the panel; ``panel``: reflectance of the panel on ``wavelength``: a
    DataArray, or a Dataset with ``reflectance``. It is interpolated linearly; beyond its wavelengths the
    result is NaN.

    Raises `SchemaError, UnitsError`: A reference is absolute already, or the panel is not a certificate; all
    problems are listed.
    """
    array = panel["reflectance"] if hasattr(panel, "data_vars") and "reflectance" in panel else panel
    if not hasattr(array, "dims") or tuple(array.dims) != ("wavelength",) or "wavelength" not in array.coords:
        raise SchemaError(
            f"panel= is {type(panel).__name__}",
            expected="a DataArray of reflectance on wavelength",
            mend="see read_certificate",
            code="type-wrong",
        )
    problems = Problems("references cannot be scaled by the panel", SchemaError)
    wavelength = convert(array["wavelength"], "nm").values.astype(np.float64)
    values = convert(array, "1", "panel").values.astype(np.float64)
    order = np.argsort(wavelength)
    wavelength, values = wavelength[order], values[order]
    if not (np.isfinite(wavelength).all() and np.isfinite(values).all() and (np.diff(wavelength) > 0).all()):
        problems.add("panel= has wavelengths twice, or values that are not finite", code="not-finite")
    elif not ((values > 0.0) & (values <= 1.2)).all():
        limits = f"{values.min():g} to {values.max():g}"
        problems.add(
            f"panel= has values from {limits}",
            expected="above 0, at most 1.2",
            mend="divide percent by 100",
            code="value-out-of-range",
        )
    for spectrum in spectra:
        if spectrum.absolute:
            problems.add(
                f"reference {spectrum.name!r} is absolute already, or from a library",
                mend="remove the argument panel=",
                code="option-conflict",
            )
    problems.raise_if_any()
    return [_scaled(spectrum, wavelength, values) for spectrum in spectra]


def _scaled(spectrum: Measured, wavelength: Floats, values: Floats) -> Measured:
    factor = np.interp(spectrum.wavelength, wavelength, values, np.nan, np.nan)

    def times(spread: Floats | None) -> Floats | None:
        return None if spread is None else spread * factor

    return replace(
        spectrum,
        values=spectrum.values * factor,
        u_random=times(spectrum.u_random),
        u_systematic=times(spectrum.u_systematic),
        sd=times(spectrum.sd),
        covariance=None if spectrum.covariance is None else spectrum.covariance * np.outer(factor, factor),
        absolute=True,
        notes=(*spectrum.notes, "scaled by the panel's certificate"),
    )
