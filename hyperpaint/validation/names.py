"""Names that a spectrum may be called by, and the place that it comes from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import PurePath

__all__ = ["Names", "names_of_paint", "names_of_spectrum"]

_SUFFIXES = (".asd", ".sig", ".txt", ".tsv", ".csv")


@dataclass(frozen=True)
class Names:
    """How one spectrum is called.

    Attributes
    ----------
    shown
        As results tell it.
    ranks
        What it may be called by: its own names; these without suffix; those without folder too, which spectra
        of other folders may share. Where one is meant, none of a later rank counts.
    place
        Number of the dataset, and folder in it: only readings of one place are repeats of each other.
    """

    shown: str
    ranks: tuple[frozenset[str], frozenset[str], frozenset[str]]
    place: tuple[int, str]

    @property
    def every(self) -> frozenset[str]:
        """Names of all ranks."""
        return frozenset[str]().union(*self.ranks)


def names_of_paint(name: str, dataset: int) -> Names:
    """Return how a paint of a library is called: by its name."""
    return Names(name, (frozenset({name}), frozenset(), frozenset()), (dataset, ""))


def names_of_spectrum(spectrum: str, source: str, other: str, number: int, dataset: int) -> Names:
    """Return how a spectrum of a field spectrometer is called.

    Parameters
    ----------
    spectrum, source, other
        Its name, which readers put the folder before where names repeat; its file; another name. Any may be
        empty.
    number, dataset
        Of the spectrum in its dataset, and of the dataset.

    Examples
    --------
    >>> one = names_of_spectrum("site1/red", "red.sig", "", 0, 1)
    >>> [sorted(rank) for rank in one.ranks], one.place
    ([['site1/red', 'site1/red.sig'], [], ['red', 'red.sig']], (1, 'site1/'))
    """
    base = PurePath(spectrum).name
    folder = spectrum[: len(spectrum) - len(base)] if spectrum.endswith(base) else ""
    full = frozenset(text for text in (spectrum, other, source and folder + source) if text)
    bare = frozenset(name for text in full for name in _without_suffix(text)) - full
    short = frozenset(alias for text in (spectrum, source, other) for alias in _aliases(text)) - full - bare
    # readers number what folders do not tell apart: "red (1)" of red.sig; these are no repeats either
    numbered = base if source and base not in set(_aliases(source)) else ""
    shown = spectrum or source or other or f"spectrum {number}"
    return Names(shown, (full, bare, short), (dataset, folder + numbered))


def _aliases(text: str) -> Iterator[str]:
    """Yield the names that a file, or a column of one, may be called by.

    Examples
    --------
    >>> sorted(set(_aliases("svc/red.asd.txt")))
    ['red', 'red.asd', 'red.asd.txt', 'svc/red.asd.txt']
    """
    if not text:
        return
    yield text
    for part in (text, text.rpartition(":")[2]):
        name = PurePath(part).name
        yield name
        yield from _without_suffix(name)


def _without_suffix(name: str) -> Iterator[str]:
    while name.lower().endswith(_SUFFIXES):
        name = name[: name.rindex(".")]
        yield name
