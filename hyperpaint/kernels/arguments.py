"""What the kernels take, grouped by what belongs together; numba passes these tuples as they are.

Free of numba, so that callers can make and keep them without loading a compiler.

A kernel is compiled for the types of what it takes. What is None is neither compiled nor paid for: `given`
puts None in the place of empty arrays.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import numpy as np

from hyperpaint.base.arrays import Array

Group = TypeVar("Group", bound=tuple[Any, ...])


def given(group: Group) -> Group:
    """Return a group of arguments with None in the place of empty arrays.

    Examples
    --------
    >>> given(StrayLight(*[np.empty(0)] * 5, np.float32(0.1))).give is None
    True
    """
    empty = (isinstance(each, np.ndarray) and each.size == 0 for each in group)
    make: Callable[..., Group] = type(group)
    return make(*(None if gone else each for each, gone in zip(group, empty, strict=True)))


# --- counts to reflectance: `hyperpaint.kernels.radiometry`


class DetectorModel(NamedTuple):
    """What a detector does to counts beside its dark; None, in a plan empty, is what it does not do."""

    #: (0 or 4,) float32: a2 ... a5 of linear counts c + a2 c^2 + ... + a5 c^5
    polynomial: Array
    #: (0 or node,) float32: in its place, what linear counts have more than counts, evenly spaced
    table: Array
    #: first_node [count], nodes_per_count, float32: where its nodes lie
    first_node: Any
    nodes_per_count: Any
    #: (0 or n, 2) int64: band and column of elements that see no light; what they count on average beyond
    #: their dark is the pedestal of a line
    masked: Array
    on_raw: Any  #: bool: both are of raw counts and of the dark, each; not of their difference


class Calibration(NamedTuple):
    """What turns counts into radiance per exposure."""

    dark: Array  #: (n, band, column) float32
    #: dark_index, dark_weight (line,): the dark of a line lies between ``dark[i]`` and ``dark[i + 1]``, at
    #: this weight of the later; None where one dark serves every line
    dark_index: Array | None
    dark_weight: Array | None
    gain: Array  #: (band, column) float32: NaN marks a bad element
    detector: DetectorModel


class StrayLight(NamedTuple):
    """What linear counts above dark hold of other bands: ``smear`` of their sum, ``give @ take`` of the rest.

    Charge smears as it was counted. Light strays before it meets an element, whatever that makes of it.
    """

    give: Array  #: (band, term) float32; the terms are a multiple of four
    take: Array  #: (term, band) float32; the bands are filled up with zeros to a multiple of four
    smear: Array  #: (line,) float32: share of the sum of all bands [1]
    #: (n, 3) int64: column and band of elements whose own counts mean nothing, and the band whose counts are
    #: taken for theirs; -1 where no light falls on them
    stands_in: Array
    #: (band, column) float32: counts of an even detector over those of an element [1]; NaN of bad ones
    level: Array
    relative: Any  #: float32: relative standard uncertainty of what is subtracted [1]


class LightCells(NamedTuple):
    """What dark-subtracted counts times gain are multiplied or divided by, over the cells of the smile."""

    #: (line, band, cell, 1 or 4) float32: one: what counts are multiplied by. Four: a cubic in ``shift``, by
    #: which they are divided.
    coefficients: Array
    #: (1 or band, column) float32: position of a column inside its cell; None without a smile
    shift: Array | None
    #: edges (1 or band, run + 1), cells (1 or band, run) int64: columns where runs begin whose columns share
    #: a cell, and that cell; None without a smile
    edges: Any
    cells: Any


def light_cells(coefficients: Array, shift: Array, edges: Array, cells: Array) -> LightCells:
    """Return `LightCells`; the place of columns counts for cubics alone."""
    return LightCells(coefficients, *((shift, edges, cells) if coefficients.shape[3] > 1 else (None,) * 3))


class CountLimits(NamedTuple):
    """Counts beyond which a sample is flagged."""

    #: lowest, highest, like counts: of the counts from which samples are saturated
    lowest: Any
    highest: Any
    saturation: Array | None  #: (band, column), like counts: those of each element; None where all are one
    #: (band, column) float32: how far below the dark noise may take a sample; NaN for an element that sets no
    #: flag
    noise_margin: Array
    most_negative: Any  #: uint16: number of samples under the dark that a pixel may have
    whole: Any  #: bool: counts are integers


def count_limits(saturation: Array, noise_margin: Array, most_negative: Any, whole: Any) -> CountLimits:
    """Return `CountLimits`, ``saturation`` being (1, 1) or (band, column)."""
    each = saturation if saturation.size > 1 else None
    return CountLimits(saturation.min(), saturation.max(), each, noise_margin, most_negative, whole)


class Rounding(NamedTuple):
    """Rounding of float32 values to nearest-even, by their bits as uint32; as numcodecs' BitRound does."""

    last: Any  #: The lowest bit that is kept
    half: Any  #: Half of it
    mask: Any  #: The bits that are kept


def rounding(cleared_bits: int) -> Rounding | None:
    """Return the rounding that clears this many bits of the mantissa; None for none."""
    if not cleared_bits:
        return None
    last = 1 << int(cleared_bits)
    return Rounding(*(np.uint32(bits) for bits in (last, last >> 1, 2**32 - last)))


class LineCounts(NamedTuple):
    """What the values of a line are computed from."""

    counts: Array  #: (line, band, column)
    dark: Array  #: (band, column): that of the line
    gain: Array  #: (band, column)
    saturation_limit: Any  #: float32: counts from which a value is NaN
    rounding: Rounding | None


class FixedFlags(NamedTuple):
    """Bits of quality of whole lines (line,) and columns (column,), and that of a line without data."""

    lines: Array
    columns: Array
    no_data: Any


class ErrorTerms(NamedTuple):
    """Terms of the error budget, as the uncertainty of every sample is computed from them."""

    #: per_electron, noise_floor (1 or band, column) float32: counts per electron, and the variance that a
    #: count without light has afresh in every sample [count2]
    per_electron: Array
    noise_floor: Array
    #: (1 or band, column) float32: what is proportional to reflectance and common to the flight [1]
    relative: Array
    #: (0, 1 or band, column) float32: uncertainty of the dark that is subtracted [count]; None, in a plan
    #: empty, where it and wavelengths are certain
    offset: Array
    #: (0 or band, 4) float32: wavelength uncertainty over the distance to the neighbouring bands: what the
    #: rise to the band above is multiplied by with a band below, and without; what the rise from the band
    #: below is multiplied by with a band above, and without. None, in a plan empty, where wavelengths are
    #: certain.
    slope: Array


class SlabOutputs(NamedTuple):
    """What is written of a slab: quality and uncertainties where they are asked for, else empty."""

    cube: Array  #: (line, band, column) float32
    quality: Array  #: (line, column) or (0, 0) uint16
    #: u_random, u_systematic (line, band, column) or (0, 0, 0) float32
    u_random: Array
    u_systematic: Array


# --- what a pixel's light is made of: `hyperpaint.kernels.unmixing`


class Bodies(NamedTuple):
    """What pixels show."""

    body_of: Array  #: (line, column) int32: what each pixel shows, a row of ``reflectance``; -1 leaves it NaN
    reflectance: Array  #: (body, channel) float64: in full light [1]
    neighbours: Array  #: (line, column, 2) int32: rows of ``reflectance`` that light each pixel; -1 for none


class LightParts(NamedTuple):
    """Direct and diffuse part of the irradiance, and what a mirror shows of the sky (channel,), float64 [1].

    ``above``: the sky straight above; ``sunward``: by how much the sky around the sun is brighter than that,
    0 under a sky without such a side. Both as reflectance of a perfect mirror.
    """

    direct: Array
    diffuse: Array
    above: Array
    sunward: Array


class ChannelErrors(NamedTuple):
    """Standard deviation of channels: relative to what is seen (channel,) [1], and what is added [1]."""

    noise: Array
    floor: Any


class AmountPrior(NamedTuple):
    """What amounts are without evidence."""

    #: expected, spread (part,) float64: what they are, and how far from it they come to lie
    expected: Array
    spread: Array
    tilt: Array  #: (body,) float64: the spread of the amount of direct light, in place of that in ``spread``
    most: Array  #: (part,) float64: amounts are no larger


class Glinting(NamedTuple):
    """What is expected where the sun is mirrored, beyond what is elsewhere [1]."""

    direct: Any  #: Direct light: what mirrors the sun to a camera above faces halfway to it
    sunward: Any  #: Mirror image of the sky around the sun, which comes with the sun's


class Unmixed(NamedTuple):
    """What is written of a block of lines."""

    amount: Array  #: (line, column, part) float32
    added: Array  #: (line, column, 2) float32: largest reflectance over the channels that each neighbour adds
    #: (line, column) float32: largest reflectance over the channels that both add; less than the sum of
    #: ``added`` where they are of different colours
    together: Array
    misfit: Array  #: (line, column) float32: root mean square of what remains, in standard deviations


# --- monochromatic lines: `hyperpaint.kernels.line_fits`


class LineSamples(NamedTuple):
    """Samples of lines, row by row, or of one of them."""

    values: Array  #: (line, sample) float64
    weights: Array  #: (line, sample) float64: one over the variance; zero leaves a sample out
    first: Any  #: (line,) int64: place of the first sample of a row
    source: Any  #: (line,) float64: full width at half maximum of the light [samples]


class LineFits(NamedTuple):
    """What is fitted to lines."""

    #: (line, 4) float64: where to begin, and the result: see `hyperpaint.kernels.line_fits.CENTRE`
    parameters: Array
    covariance: Array  #: (line, 4, 4) float64: inverse of the normal matrix; NaN where it is singular
    chi2: Array  #: (line,) float64: weighted sum of squared residuals
    converged: Array  #: (line,) bool


# --- rays to the ground: `hyperpaint.kernels.rays`


class LineRays(NamedTuple):
    """Where the rays of a line camera begin, and where they go."""

    origin: Array  #: (line, 3) float64: projection centre in the line's frame [m]
    rotation: Array  #: (line, 3, 3) float64: turns directions of the camera into the line's frame
    look: Array  #: (column, 3) float64: directions of the columns in the camera's frame, of unit length


class LineFrames(NamedTuple):
    """What lies around a line."""

    #: x, y, height (line, 10) float64: coordinates of the map and height above the ellipsoid [m], as
    #: polynomials of the line's frame
    x: Array
    y: Array
    height: Array
    turn: Array  #: (line,) float64: how north turns with the way to the east [rad m-1]


BLOCK = 16
"""Cells of a raster along either axis whose highest point is known."""


class Raster(NamedTuple):
    """A raster of heights."""

    #: row, col (line, 10) float64: place in the raster, 0 at the centre of its first cells, as polynomials
    #: of the line's frame
    row: Array
    col: Array
    heights: Array  #: (row, col) float64: above the ellipsoid [m]; NaN in holes
    #: (ceil((row - 1) / `BLOCK`), ceil((col - 1) / `BLOCK`)) float64: highest point of every block; minus
    #: infinity where all of it is a hole
    tops: Array
    #: lowest, highest: of all heights [m]
    lowest: float
    highest: float


# --- maps: `hyperpaint.kernels.inverse_map` and `hyperpaint.kernels.gathering`


class LinePositions(NamedTuple):
    """Where the pixels of lines lie on the map."""

    #: east, north (line, column) float64: of lines that follow one another [m]; NaN where that is not known
    east: Array
    north: Array
    #: east_before, north_before (column,) float64: the same of the line before; NaN where there is none
    east_before: Array
    north_before: Array
    #: (line, column - 1) bool: whether four pixels, with those of the line before, span no patch; empty where
    #: all do
    hidden: Array


class MapCells(NamedTuple):
    """The cells of a tile, and which patch over a cell counts."""

    #: (6,) float64: east and north of the centre of the map's first cell [m]; then what turns metres from
    #: there into columns of cells, and into rows of cells, each by its part per metre east and north
    frame: Array
    corner: tuple[int, int]  #: Row and column of the tile's first cell on the map
    longest: float  #: Edge from which a patch is a gap, and covers nothing [cell]
    rule: int  #: `NADIR`, `FIRST` or `LAST` of `hyperpaint.kernels.inverse_map`


class InverseTile(NamedTuple):
    """What is written of a tile."""

    #: (2, row, col) float64: line and column of every cell, written where a patch covers one that has none
    #: yet or a worse one
    place: Array
    #: (2, row, col) int32: line and column of the one of the patch's four pixels that lies nearest to the
    #: cell
    nearest: Array
    #: (row, col) float64: what cells are compared by, the least wins; infinite where nothing has covered them
    rank: Array
    hits: Array  #: (row, col) uint16: patches over every cell, added to


class Places(NamedTuple):
    """Places between pixels, line by line, and the cells they go to."""

    #: lines, columns (place,) int64: pixel before each place
    lines: Array
    columns: Array
    #: along, across (place,), like what is written: way to the next line and column, 0 to 1; of what is 0
    #: away the next is not looked at
    along: Array
    across: Array
    cells: Array  #: (place,) int64: where each goes
