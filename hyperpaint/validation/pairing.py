"""Which reference a signature is compared with: by name, never by likeness."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hyperpaint.base.errors import Problems, SchemaError

from .spectra import Measured

__all__ = ["Pair", "Pairing", "paired"]

_MOST_NAMED = 12


@dataclass(frozen=True)
class Pair:
    """A signature, and its reference spectra of one instrument.

    Attributes
    ----------
    signature
    references
        Repeated readings, of which the mean is compared.
    """

    signature: Measured
    references: tuple[Measured, ...]


@dataclass(frozen=True)
class Pairing:
    """What is compared with what.

    Attributes
    ----------
    pairs
    signatures, references
        Names of those that have no counterpart, with the reason where there is one.
    missing
        Those of ``signatures`` that ask for a reference by name, which is not there.
    """

    pairs: tuple[Pair, ...]
    signatures: tuple[str, ...]
    references: tuple[str, ...]
    missing: tuple[str, ...]


def paired(signatures: Sequence[Measured], references: Sequence[Measured], pairs: Any = None) -> Pairing:
    """Return which references belong to which signatures.

    Parameters
    ----------
    signatures, references
        Spectra with their names.
    pairs
        Names of references by names of paints, one or several each. By default a signature's own property
        ``reference`` names them, and where it has none, its name.

    Raises
    ------
    SchemaError
        ``pairs`` names what is not there; a name is that of several paints, or of references of several
        folders or datasets; or nothing can be paired. All of a kind are listed.
    """
    wanted = _said(signatures, references, pairs) if pairs is not None else None
    problems = Problems("paints and references cannot be paired by name", SchemaError)
    counts = Counter(each.name for each in signatures)
    matched: list[Pair] = []
    alone: list[str] = []
    missed: list[str] = []
    used: set[int] = set()
    for signature in signatures:
        names = _names_for(signature) if wanted is None else wanted.get(signature.name, ())
        own = sorted({k for name in names for k in _called(name, references, problems)})
        if not own:
            asks = wanted is None and bool(signature.wanted)
            alone.append(signature.name + (f" (wants {signature.wanted!r})" if asks else ""))
            missed += alone[-1:] if asks else []
            continue
        if counts[signature.name] > 1 and (wanted is not None or not signature.wanted):
            problems.add(
                f"there are {counts[signature.name]} paints {signature.name!r}; give each a name of its own"
            )
        used.update(own)
        instruments = dict.fromkeys(references[k].instrument for k in own)
        for instrument in instruments:
            group = tuple(references[k] for k in own if references[k].instrument == instrument)
            matched.append(Pair(signature, group))
    problems.raise_if_any()
    left = tuple(f"{each.name} ({each.instrument})" for k, each in enumerate(references) if k not in used)
    if not matched:
        raise SchemaError(
            f"no paint has a reference of its name; paints are {_listed([s.name for s in signatures])}, "
            f"references {_listed(left)}; name them with pairs={{paint: reference}}, or give regions a "
            "property reference"
        )
    return Pairing(tuple(matched), tuple(alone), left, tuple(missed))


def _called(name: str, references: Sequence[Measured], problems: Problems) -> list[int]:
    """Return which references a name means: of each instrument those that own it, else a longer one.

    Files of one name in different folders are not repeated readings of one paint: that is noted.
    """
    matches: dict[str, list[int]] = {}
    for rank in range(3):
        hits: dict[str, list[int]] = {}
        for k, each in enumerate(references):
            if name in each.names.ranks[rank] and each.instrument not in matches:
                hits.setdefault(each.instrument, []).append(k)
        matches |= hits
    for instrument, own in matches.items():
        places = {references[k].names.place for k in own}
        if len(places) > 1:
            several = len({dataset for dataset, _ in places}) > 1
            held = _listed([_whereabouts(references[k]) if several else references[k].name for k in own])
            mend = "name one, or all that are repeated readings, with {}, or leave files out"
            problems.add(
                f"{name!r} may be any of {held} of {instrument}",
                mend=mend.format("pairs={paint: reference}"),
                option=mend.format("--pairs"),
            )
    return [k for own in matches.values() for k in own]


def _whereabouts(reference: Measured) -> str:
    return f"{reference.name} (dataset {reference.names.place[0]})"


def _names_for(signature: Measured) -> tuple[str, ...]:
    return (signature.wanted or signature.name,)


def _said(
    signatures: Sequence[Measured], references: Sequence[Measured], pairs: Any
) -> dict[str, tuple[str, ...]]:
    """Return the pairs that the caller named."""
    if not isinstance(pairs, Mapping):
        raise SchemaError(f"pairs is {type(pairs).__name__}, expected names of references by names of paints")
    problems = Problems("pairs= cannot be followed", SchemaError)
    paints = {each.name for each in signatures}
    names_there = frozenset[str]().union(*(each.names.every for each in references))
    wanted: dict[str, tuple[str, ...]] = {}
    for paint, names in pairs.items():
        several = (names,) if isinstance(names, str) else tuple(names)
        if paint not in paints:
            problems.add(f"there is no paint {paint!r}; there is {_listed(sorted(paints))}")
        for name in several:
            if name not in names_there:
                held = _listed([each.name for each in references])
                problems.add(f"there is no reference {name!r} for {paint!r}; there is {held}")
        wanted[str(paint)] = several
    problems.raise_if_any()
    return wanted


def _listed(names: Sequence[str]) -> str:
    shown = ", ".join(map(repr, names[:_MOST_NAMED]))
    return (shown or "none") + (f" and {len(names) - _MOST_NAMED} more" if len(names) > _MOST_NAMED else "")
