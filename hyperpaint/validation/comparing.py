"""Pairs of signatures and references by name, and both on common bands with draws of their errors."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.schema import BAND

from .agreement import Operator, bands_of, operator_onto
from .coat_readings import as_body, difference
from .measured_spectra import Measured
from .validation_result import MEANINGS

_MAX_LISTED_NAMES = 12


@dataclass(frozen=True)
class Pair:
    """A signature and its reference spectra of one instrument."""

    signature: Measured
    references: tuple[Measured, ...]  # Repeated readings, of which the mean is compared
    between: bool = False  # Whether the signature is a reference too, of another instrument


@dataclass(frozen=True)
class Pairing:
    """All pairs, and the signatures and references without a counterpart."""

    pairs: tuple[Pair, ...]
    # names without a counterpart, with the reason where there is one
    signatures: tuple[str, ...]
    references: tuple[str, ...]
    missing: tuple[str, ...]  # names in ``signatures`` whose wanted reference is absent


def paired(signatures: Sequence[Measured], references: Sequence[Measured], pairs: Any = None) -> Pairing:
    """Return the pairs of signatures and references.

    ``signatures``, ``references``: spectra with their names; ``pairs``: names of references by names of
    paints, one or several each. By default a signature's own property ``reference`` names them, and where it
    has none, its name.

    Raises `SchemaError`: ``pairs`` has unknown names; several paints, or references of several folders or
    datasets, share a name; or nothing can be paired. All problems of a kind are listed.
    """
    wanted = _named_pairs(signatures, references, pairs) if pairs is not None else None
    problems = Problems("paints and references cannot be paired by name", SchemaError)
    counts = Counter(each.name for each in signatures)
    matched: list[Pair] = []
    alone: list[str] = []
    missed: list[str] = []
    used: set[int] = set()
    for signature in signatures:
        named = (signature.wanted or signature.name,)
        names = named if wanted is None else wanted.get(signature.name, ())
        matching = sorted({k for name in names for k in _called(name, references, problems)})
        if not matching:
            asks = wanted is None and bool(signature.wanted)
            alone.append(signature.name + (f" (wants {signature.wanted!r})" if asks else ""))
            missed += alone[-1:] if asks else []
            continue
        if counts[signature.name] > 1 and (wanted is not None or not signature.wanted):
            problems.add(
                f"there are {counts[signature.name]} paints {signature.name!r}",
                mend="give each a unique name",
                code="paint-duplicate",
            )
        used.update(matching)
        for instrument in dict.fromkeys(references[k].instrument for k in matching):
            group = tuple(references[k] for k in matching if references[k].instrument == instrument)
            matched.append(Pair(signature, group))
    problems.raise_if_any()
    left = tuple(f"{each.name} ({each.instrument})" for k, each in enumerate(references) if k not in used)
    if not matched:
        mend = "name them with {}, or give regions a property reference"
        raise SchemaError(
            f"no paint has a reference of its name; paints are {_listed([s.name for s in signatures])}, "
            f"references {_listed(left)}",
            mend=mend.format("pairs={paint: reference}"),
            option=mend.format("--pairs"),
            code="reference-unmatched",
        )
    return Pairing(tuple(matched), tuple(alone), left, tuple(missed))


def _called(name: str, references: Sequence[Measured], problems: Problems) -> list[int]:
    # of each instrument the references that own the name, else a longer one; files of one name in different
    # folders are no repeated readings of one paint: a problem
    matches: dict[str, list[int]] = {}
    for rank in range(3):
        hits: dict[str, list[int]] = {}
        for k, each in enumerate(references):
            if name in each.names.ranks[rank] and each.instrument not in matches:
                hits.setdefault(each.instrument, []).append(k)
        matches |= hits
    for instrument, numbers in matches.items():
        places = {references[k].names.place for k in numbers}
        if len(places) > 1:
            several = len({dataset for dataset, _ in places}) > 1
            held = _listed(
                [
                    references[k].name + (f" (dataset {references[k].names.place[0]})" if several else "")
                    for k in numbers
                ]
            )
            mend = "name one, or all that are repeated readings, with {}, or leave files out"
            problems.add(
                f"{name!r} may be any of {held} of {instrument}",
                mend=mend.format("pairs={paint: reference}"),
                option=mend.format("--pairs"),
                code="reference-ambiguous",
            )
    return [k for numbers in matches.values() for k in numbers]


def _named_pairs(
    signatures: Sequence[Measured], references: Sequence[Measured], pairs: Any
) -> dict[str, tuple[str, ...]]:
    if not isinstance(pairs, Mapping):
        raise SchemaError(
            f"pairs is {type(pairs).__name__}",
            expected="a mapping from names of paints to names of references",
            code="type-wrong",
        )
    problems = Problems("pairs= cannot be followed", SchemaError)
    paints = {each.name for each in signatures}
    names_there = frozenset[str]().union(*(each.names.every for each in references))
    wanted: dict[str, tuple[str, ...]] = {}
    for paint, names in pairs.items():
        several = (names,) if isinstance(names, str) else tuple(names)
        if paint not in paints:
            problems.add(
                f"there is no paint {paint!r}", expected=_listed(sorted(paints)), code="paint-unknown"
            )
        for name in several:
            if name not in names_there:
                held = _listed([each.name for each in references])
                problems.add(
                    f"there is no reference {name!r} for {paint!r}", expected=held, code="reference-unknown"
                )
        wanted[str(paint)] = several
    problems.raise_if_any()
    return wanted


def _listed(names: Sequence[str]) -> str:
    shown = ", ".join(map(repr, names[:_MAX_LISTED_NAMES])) or "none"
    rest = len(names) - _MAX_LISTED_NAMES
    return f"{shown} and {rest} more" if rest > 0 else shown


def between_references(pairs: Sequence[Pair]) -> list[Pair]:
    """Return pairs of references of one paint, measured by two instruments."""
    of_paint: dict[int, list[Pair]] = {}
    for pair in pairs:
        of_paint.setdefault(id(pair.signature), []).append(pair)
    return [
        Pair(_mean_of(first), second.references, between=True)
        for same_paint in of_paint.values()
        for first, second in itertools.combinations(same_paint, 2)
    ]


def _mean_of(pair: Pair) -> Measured:
    # on the channels of the first reading
    first = pair.references[0]
    named = replace(first, names=replace(first.names, shown=pair.signature.name))
    if len(pair.references) == 1:
        return named
    onto = [operator_onto(first, each) for each in pair.references]
    values = np.stack([use(each.values) for use, each in zip(onto, pair.references, strict=True)])
    sd = values.std(axis=0, ddof=1)
    systematic = np.zeros(sd.shape) if first.u_systematic is None else first.u_systematic
    return replace(
        named,
        values=values.mean(axis=0),
        sd=sd,
        count=len(values),
        u_random=None,
        u_systematic=np.hypot(sd / np.sqrt(len(values)), systematic),
        covariance=None,
    )


DRAWS = 1000  # their standard deviation is known to 2 %


@dataclass(frozen=True, eq=False)
class Compared:
    """A pair on common bands."""

    pair: Pair
    bands: Measured  # The spectrum whose channels are the common bands
    # signature, reference (band,): Reflectance [1]; NaN where not known
    signature: Floats
    reference: Floats
    onto: tuple[Operator, ...]  # operators of the references, and last of the signature
    # draws of the errors of both (draw, band); None where both are unknown
    errors: tuple[Floats, Floats] | None

    @property
    def names(self) -> str:
        """Names of the references."""
        return ", ".join(each.name for each in self.pair.references)

    @property
    def instrument(self) -> str:
        """Instrument of the references."""
        make = self.pair.references[0].instrument
        return f"{self.pair.signature.instrument} against {make}" if self.pair.between else make

    @property
    def used(self) -> npt.NDArray[np.bool_]:
        """Bands that are compared (band,)."""
        return np.isfinite(self.signature) & np.isfinite(self.reference)

    @property
    def coverage(self) -> Floats:
        """Part of each band's response covered by the channels of all spectra (band,)."""
        return np.asarray(np.min([each.coverage for each in self.onto], axis=0))

    @property
    def ranges(self) -> str:
        """Wavelength ranges of all spectra, as text."""
        return ", ".join(
            f"{each.name} {each.wavelength[0]:g} to {each.wavelength[-1]:g} nm"
            for each in (self.pair.signature, *self.pair.references)
        )

    def part(self, edges: tuple[float, float]) -> npt.NDArray[np.bool_]:
        """Return the bands in a part of the spectrum (band,)."""
        return (self.bands.wavelength >= edges[0]) & (self.bands.wavelength < edges[1])

    @property
    def overlap(self) -> str:
        """Treatment of overlapping detectors in the references."""
        return _common([each.overlap for each in self.pair.references])

    @property
    def matched(self) -> bool:
        """Whether values of any reference were changed to join detectors."""
        return any(each.matched for each in self.pair.references)

    @property
    def mirror(self) -> str:
        """Whether the references include the mirror image of the sky."""
        return _common([each.mirror for each in self.pair.references])

    def warnings(self) -> list[tuple[str, str]]:
        """Return code and text of each condition that the user can act on."""
        name, mirror, reference_mirror = self.pair.signature.name, self.pair.signature.mirror, self.mirror
        texts = dict.fromkeys(difference(self.pair.signature, each) for each in self.pair.references)
        if apart := [("coats-differ", f"{name}: {text}") for text in texts if text]:
            return apart
        if mirror == reference_mirror or not {mirror, reference_mirror} <= {"included", "excluded", "mixed"}:
            return []
        text = (
            f"{name}: the mirror image of the sky is {mirror} in the signature, {reference_mirror} in the "
            "reference; a clear coat mirrors 0.04 times the share of skylight; see remove_mirrored_sky"
        )
        return [("mirrored-sky-differs", text)]

    def notes(self) -> tuple[str, ...]:
        """Return remarks for the reader of the result."""
        notes = [note for each in self.pair.references for note in each.notes]
        notes += [f"signature: {note}" for note in self.pair.signature.notes]
        if self.matched:
            notes.append(
                "the reference was overlap-matched: below the join of detectors its values were scaled"
            )
        if self.bands is not self.pair.signature:
            notes.append("the signature was brought onto the reference's bands")
        # bands left out, with the reason
        narrow = np.any([~each.seen & np.isfinite(each.noise_gain) for each in self.onto], axis=0)
        reasons = {
            "not covered completely, or without a value": ~self.used & ~narrow,
            "narrower than the other side can resolve": ~self.used & narrow,
        }
        notes += [
            f"left out of {self.used.size} bands: {int(which.sum())} {reason}"
            for reason, which in reasons.items()
            if which.any()
        ]
        is_absolute = self.pair.signature.absolute
        if any(each.absolute != is_absolute for each in self.pair.references):
            sides = ("reference", "signature") if is_absolute else ("signature", "reference")
            notes.append(
                f"the {sides[0]} is relative to a white panel, the {sides[1]} is absolute: the panel's own "
                f"reflectance is in the difference{'; pass panel=' if is_absolute else ''}"
            )
        return tuple(dict.fromkeys([*notes, *self._uncertainty()]))

    def _uncertainty(self) -> list[str]:
        signature, references = self.pair.signature, self.pair.references
        has_uncertainty = {
            "signature": signature.has_uncertainty,
            "reference": len(references) > 1 or references[0].has_uncertainty,
        }
        unknown = [side for side, has in has_uncertainty.items() if not has]
        notes = []
        if unknown:
            notes.append(f"the uncertainty of the {' and the '.join(unknown)} is unknown and not included")
        for side, spectra in (("signature", (signature,)), ("reference", references)):
            notes += [f"uncertainty of the {side}: {text}" for each in spectra for text in each.gaps()]
        return notes

    @property
    def scatter(self) -> float:
        """Standard deviation of repeated readings, RMS over the bands compared [1]."""
        spreads = self._spreads()
        if len(self.pair.references) < 2 or not self.used.any():
            return 0.0
        return float(np.sqrt((spreads["reference_sd"][self.used] ** 2).mean()))

    def dataset(self) -> xr.Dataset:
        """Return both spectra on the common bands."""
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
        sides = ("signature", "reference")
        meanings = dict(MEANINGS) | {name: f"Reflectance of the {name} on common bands" for name in sides}
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
            spreads["signature_sd"] = self.onto[-1](signature_sd)
        if len(references) > 1:
            readings = [use(each.values) for use, each in zip(self.onto[:-1], references, strict=True)]
            spreads["reference_sd"] = np.std(readings, axis=0, ddof=1)
        elif references[0].sd is not None:
            spreads["reference_sd"] = self.onto[0](references[0].sd)
        return spreads


def compare(pair: Pair, seed: int) -> Compared:
    """Bring a pair onto common bands, and draw its errors there.

    The draws are the same for every pair, in whatever order they come.
    """
    if not pair.between:
        pair = replace(pair, references=tuple(as_body(each, pair.signature) for each in pair.references))
    bands = bands_of(pair.signature, list(pair.references))
    onto = tuple(operator_onto(bands, each) for each in (*pair.references, pair.signature))
    readings = np.stack([use(each.values) for use, each in zip(onto[:-1], pair.references, strict=True)])
    rng = np.random.default_rng(seed)
    has_uncertainty = (
        pair.signature.has_uncertainty or len(readings) > 1 or pair.references[0].has_uncertainty
    )
    errors = None
    if has_uncertainty:
        signature_errors = onto[-1](pair.signature.errors(rng, DRAWS))
        errors = signature_errors, _errors_of_mean(pair.references, onto[:-1], readings, rng)
    return Compared(pair, bands, onto[-1](pair.signature.values), readings.mean(axis=0), onto, errors)


def _errors_of_mean(
    references: Sequence[Measured], onto: Sequence[Operator], readings: Floats, rng: np.random.Generator
) -> Floats:
    count = len(readings)
    if count == 1:
        return onto[0](references[0].errors(rng, DRAWS))
    away = readings - readings.mean(axis=0)
    errors = np.asarray(rng.standard_normal((DRAWS, count)) @ away / np.sqrt(count * (count - 1.0)))
    # readings of one instrument share its systematic error, which repetition does not show
    common = [
        use(each.u_systematic)
        for use, each in zip(onto, references, strict=True)
        if each.u_systematic is not None
    ]
    if common:
        errors += np.mean(common, axis=0) * rng.standard_normal((DRAWS, 1))
    # a few readings may agree by chance
    for use, each in zip(onto, references, strict=True):
        if each.u_random is not None:
            errors += use(each.u_random * rng.standard_normal((DRAWS, each.u_random.size))) / count
    return errors


def _common(words: Sequence[str]) -> str:
    return words[0] if len(set(words)) == 1 else "mixed"
