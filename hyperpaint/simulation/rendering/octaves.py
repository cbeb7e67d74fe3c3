"""Over which distances a population of spectra varies on a surface."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["MEASURED", "Octaves"]


@dataclass(frozen=True)
class Octaves:
    """How a population varies over a surface.

    Attributes
    ----------
    lengths
        Distances over which it does [m].
    shares
        Parts of its variance [1].
    is_averaged
        Whether what is smaller than a pixel averages out in it. Members that were pixels themselves have
        their spread whatever the size of a pixel.
    """

    lengths: tuple[float, ...]
    shares: tuple[float, ...]
    is_averaged: bool = True


MEASURED = Octaves((0.20, 0.05, 0.0125), (1 / 3, 1 / 3, 1 / 3), is_averaged=False)
"""Of the members of a library: a third each of dirt and curvature over a panel, of patches, and of noise."""
