"""Check interleave and byte order of a cube by the smoothness of its spectra."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hyperpaint.base.arrays import Floats, Ints
from hyperpaint.io.envi.envi_cubes import find_pair
from hyperpaint.io.envi.envi_header import EnviHeader, read_header

from .finding import KINDS, Finding


@dataclass(frozen=True)
class LayoutRules:
    """Thresholds at which another layout explains a cube better.

    bands, pixels
        Random bands, and pixels in each, that are read: some thousand places of the file.
    rough, smoother
        Mean squared difference of neighbouring bands over twice the variance [1]: value above which other
        layouts are tried, and ratio by which one has to be smoother: 30 times in another interleave, 1000
        times with bytes exchanged.
    unlike
        The same [1] above which bands have nothing in common in the other layout either (1: noise): one band
        of status words makes a cube rougher than noise, and every other layout smoother.
    separate, separation
        Share of the variance that bands explain in the better interleave, and over that share in the declared
        one [1]: light and camera give every band a level of its own, and a wrong order mixes them. Without
        it, neighbouring columns of an even field would look like bands of a camera that has few.
    """

    bands: int = 24
    pixels: int = 64
    rough: float = 0.1
    smoother: float = 10.0
    unlike: float = 0.5
    separate: float = 0.06
    separation: float = 0.5


RULES = LayoutRules()


class _View(NamedTuple):
    # Counts read in one interleave, both (band, pixel)
    values: Floats
    neighbours: Floats  # Of the next band

    @property
    def roughness(self) -> float:
        # squared difference of neighbouring bands, over twice the variance
        spread = 2.0 * float(self.values.var())
        return float(np.mean((self.values - self.neighbours) ** 2)) / spread if spread else 0.0

    @property
    def separation(self) -> float:
        # share of the variance between bands, less its expectation by chance
        bands, pixels = self.values.shape
        within = float(self.values.var(axis=1).mean()) * pixels / (pixels - 1)
        between = max(float(self.values.mean(axis=1).var()) * bands / (bands - 1) - within / pixels, 0.0)
        return between / (between + within) if within else 0.0


def judge_layout(name: str, path: Path, lines: int) -> Iterator[Finding]:
    """Judge the file of a cube of so many lines against its header."""
    header_path, data_path = find_pair(path)
    header = read_header(header_path)
    if header.bands < 4 or header.dtype.kind not in "iu" or lines * header.samples < RULES.pixels:
        return
    with open(data_path, "rb", buffering=0) as file:
        views = {order: _view(file, header, lines, order) for order in ("bil", "bip", "bsq")}
    declared = views.pop(header.interleave)
    if declared.roughness <= RULES.rough:
        return
    smooth = min(declared.roughness / RULES.smoother, RULES.unlike)
    if header.dtype.itemsize == 2:
        swapped = _View(*(part.astype(header.dtype).byteswap().astype(np.float64) for part in declared))
        if swapped.roughness < smooth:
            other = "0 (little)" if header.dtype.newbyteorder("<") != header.dtype else "1 (big)"
            yield Finding(
                KINDS["byte-order"],
                name,
                f"neighbouring bands differ by {declared.roughness:.2g} of the variance, by "
                f"{swapped.roughness:.2g} with bytes exchanged",
                f"byte order = {other}",
            )
            return
    order, best = min(views.items(), key=lambda item: item[1].roughness)
    least = max(RULES.separate, RULES.separation * declared.separation)
    if best.roughness < smooth and best.separation > least:
        yield Finding(
            KINDS["interleave"],
            name,
            f"neighbouring bands differ by {declared.roughness:.2g} of the variance as {header.interleave}, "
            f"by {best.roughness:.2g} as {order}",
            f"interleave = {order}",
        )


def _view(file: io.FileIO, header: EnviHeader, lines: int, order: str) -> _View:
    # Read random pixels, the same in every band, with the file's samples in the given interleave
    rng = np.random.default_rng(0)
    count = min(RULES.bands, header.bands - 1)
    bands = np.linspace(0, header.bands - 2, count).astype(np.int64)[:, None]
    shape = (count, RULES.pixels)
    line, column = rng.integers(lines, size=shape), rng.integers(header.samples, size=shape)

    def at(band: Ints) -> Floats:
        places = {
            "bil": (line * header.bands + band) * header.samples + column,
            "bip": (line * header.samples + column) * header.bands + band,
            "bsq": (band * lines + line) * header.samples + column,
        }[order]
        size = header.dtype.itemsize
        # single reads: mapping the file would take its size in address space
        starts = (header.header_offset + size * places.ravel()).tolist()
        samples = bytearray()
        for start in starts:
            file.seek(start)
            samples += file.read(size)
        return np.frombuffer(samples, header.dtype).astype(np.float64).reshape(places.shape)

    return _View(at(bands), at(bands + 1))
