"""Arguments of the kernels, grouped in NamedTuples, which numba passes as plain values.

The module does not import numba, so that callers can build and keep the groups without loading a compiler.

A kernel is compiled for the types of its arguments: a member that is None removes its branch from the
compiled code. `without_empty_arrays` replaces empty arrays by None.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import numpy as np

from hyperpaint.base import Array

Group = TypeVar("Group", bound=tuple[Any, ...])


def without_empty_arrays(group: Group) -> Group:
    """Return a group of arguments with empty arrays replaced by None.

    Examples
    --------
    >>> without_empty_arrays(StrayTerms(np.empty(0), np.ones((4, 4)))).out is None
    True
    """
    is_empty = (isinstance(member, np.ndarray) and member.size == 0 for member in group)
    make: Callable[..., Group] = type(group)
    return make(*(None if drop else member for member, drop in zip(group, is_empty, strict=True)))


# --- counts to reflectance: `hyperpaint.kernels.radiometry`


# Detector effects other than dark counts; None (in a plan: empty) where absent.
class DetectorModel(NamedTuple):
    #: (0 or 4,) float32: a2 ... a5 of linear counts c + a2 c^2 + ... + a5 c^5
    polynomial: Array
    #: (0 or 1 + term, node) float32: linear counts minus counts at evenly spaced nodes, used instead of
    #: `polynomial`; then the functions by which those of elements differ
    table: Array
    weights: Array  #: (0 or term, band, column) float32: weights of these functions
    #: first_node [count], nodes_per_count, float32: position of the nodes
    first_node: Any
    nodes_per_count: Any
    #: (0 or n, 2) int64: band and column of elements without light, group by group
    masked: Array
    #: (0 or n, 4) int64: of each group, whose counts above dark are a pedestal: first and last-plus-one
    #: element in `masked`; 0 for the pedestal of a band, 1 of a column, -1 of a line; its band or column
    groups: Array
    is_median: Any  #: bool: pedestals are medians, not means
    on_raw: Any  #: bool: the curve applies to raw counts and to the dark, not to their difference


# Dark, gain and detector model: radiance times exposure is gain x linear counts above dark.
class Calibration(NamedTuple):
    dark: Array  #: (n, band, column) float32
    #: dark_index i, dark_weight w (line,): the dark of a line is (1 - w) dark[i] + w dark[i + 1]; None for
    #: one dark of all lines
    dark_index: Array | None
    dark_weight: Array | None
    gain: Array  #: (band, column) float32; NaN for bad elements
    detector: DetectorModel


class StrayTerms(NamedTuple):
    # Scattered light per light of its sources, the matrix product ``out @ source``, or ``source`` alone.
    out: Array | None  #: (band or column, term) float32; a multiple of four terms
    source: Array  #: (term, band or column) float32; sources padded with zeros to a multiple of four


class StrayLight(NamedTuple):
    # Light of other bands and columns in linear counts above dark: smear and scattered light.
    #
    # Smear is proportional to counts as read. Scattered light is that of the counts without smear, and is
    # proportional to the light before the detector, hence the ``level`` of each element.
    bands: StrayTerms  #: from band to band; no terms without
    columns: StrayTerms | None  #: from column to column, before that from band to band; None without
    smear: Array  #: (line,) float32: share of the sum of all bands [1]
    #: (n, 3) int64: column and band of a bad element, and the band whose counts it gets; -1 to set it to 0
    replacements: Array
    #: (band, column) float32: counts of a uniform detector over counts of an element [1]; NaN if bad
    level: Array
    relative: Any  #: float32: relative standard uncertainty of the subtracted light [1]


# Factors that turn dark-subtracted counts times gain into values, by smile cell.
class LightCells(NamedTuple):
    #: (line, band, cell, 1 or 4) float32: a factor, or the coefficients of a cubic in ``shift`` that is the
    #: divisor
    coefficients: Array
    #: (1 or band, column) float32: position of a column inside its cell; None without smile
    shift: Array | None
    #: edges (1 or band, run + 1), cells (1 or band, run) int64: a run is a range of columns of the same cell;
    #: its first column and its cell. None without smile
    edges: Any
    cells: Any


def light_cells(coefficients: Array, shift: Array, edges: Array, cells: Array) -> LightCells:
    # Return `LightCells`; column positions are stored only for cubic coefficients.
    return LightCells(coefficients, *((shift, edges, cells) if coefficients.shape[3] > 1 else (None,) * 3))


# Counts beyond which a sample is flagged.
class CountLimits(NamedTuple):
    #: lowest, highest saturation count of all elements, dtype of the counts
    lowest: Any
    highest: Any
    saturation: Array | None  #: (band, column), dtype of the counts: by element; None where uniform
    #: (band, column) float32: noise margin below the dark [count]; NaN for an element that sets no flag
    noise_margin: Array
    max_negative_bands: Any  #: uint16: samples below the dark that a pixel may have
    is_integer: Any  #: bool: counts are integers


def count_limits(
    saturation: Array, noise_margin: Array, max_negative_bands: Any, is_integer: Any
) -> CountLimits:
    # ``saturation`` has shape (1, 1) or (band, column)
    by_element = saturation if saturation.size > 1 else None
    return CountLimits(
        saturation.min(), saturation.max(), by_element, noise_margin, max_negative_bands, is_integer
    )


# Bit masks that round float32 values to nearest-even, as numcodecs' BitRound does.
class Rounding(NamedTuple):
    last: Any  #: Lowest kept bit
    half: Any  #: Half of ``last``
    mask: Any  #: All kept bits


def rounding(cleared_bits: int) -> Rounding | None:
    # Return the masks that clear this number of mantissa bits; None for 0.
    if not cleared_bits:
        return None
    last = 1 << int(cleared_bits)
    return Rounding(*(np.uint32(bits) for bits in (last, last >> 1, 2**32 - last)))


# Inputs of the values of a line.
class LineCounts(NamedTuple):
    counts: Array  #: (line, band, column)
    dark: Array  #: (band, column)
    gain: Array  #: (band, column)
    saturation_limit: Any  #: float32: counts from which a value is NaN
    rounding: Rounding | None


# Quality bits of whole lines (line,) and columns (column,), and the bit of a line without data.
class FixedFlags(NamedTuple):
    lines: Array
    columns: Array
    no_data: Any


# Terms of the error budget from which the uncertainties of a sample are computed.
class ErrorTerms(NamedTuple):
    #: per_electron, noise_floor (1 or band, column) float32: counts per electron, and the variance of a count
    #: without light [count2]
    per_electron: Array
    noise_floor: Array
    #: (1 or band, column) float32: relative uncertainty common to the flight [1]
    relative: Array
    #: (0, 1 or band, column) float32: uncertainty of the dark [count]; None (in a plan: empty) where dark and
    #: wavelengths are exact
    offset: Array
    #: (0 or band, 4) float32: wavelength uncertainty over the distance to the neighbouring bands: factors of
    #: the rise to the band above, with and without a band below; of the rise from the band below, with and
    #: without a band above. None (in a plan: empty) where wavelengths are exact.
    slope: Array


# Output arrays of a slab; quality and uncertainties are empty where not requested.
class SlabOutputs(NamedTuple):
    cube: Array  #: (line, band, column) float32
    quality: Array  #: (line, column) or (0, 0) uint16
    #: u_random, u_systematic (line, band, column) or (0, 0, 0) float32
    u_random: Array
    u_systematic: Array


# --- unmixing of pixels: `hyperpaint.kernels.unmixing`


# Body and neighbouring bodies of every pixel, with their reflectances.
class Bodies(NamedTuple):
    body_of: Array  #: (line, column) int32: row of ``reflectance``; -1 for none: results are NaN
    reflectance: Array  #: (body, channel) float64: reflectance in full light [1]
    #: (line, column, 2) int32: rows of ``reflectance`` of the bodies that light each pixel; -1 for none
    neighbours: Array


class LightParts(NamedTuple):
    # Direct and diffuse share of the irradiance, and the sky as a perfect mirror shows it (channel,) [1].
    #
    # ``above`` is the sky at the zenith; ``sunward`` is the sky around the sun minus ``above``, 0
    # for a uniform sky. Both are reflectances of a perfect mirror, float64.
    direct: Array
    diffuse: Array
    above: Array
    sunward: Array


# Standard deviation of channels: ``noise`` relative to reflectance (channel,) [1], and ``floor`` [1].
class ChannelErrors(NamedTuple):
    noise: Array
    floor: Any


# Prior of the amounts: mean, spread and upper bound.
class AmountPrior(NamedTuple):
    #: expected, spread (part,) float64: mean and standard deviation
    expected: Array
    spread: Array
    tilt: Array  #: (body,) float64: spread of the amount of direct light; replaces that in ``spread``
    most: Array  #: (part,) float64: upper bounds


# Additional amounts expected where the sun is mirrored [1].
class Glinting(NamedTuple):
    direct: Any  #: Direct light: a surface that mirrors the sun to a camera above faces halfway to the sun
    sunward: Any  #: Mirror image of the sky around the sun


# Output arrays of `unmix_lines` for a block of lines.
class Unmixed(NamedTuple):
    amount: Array  #: (line, column, part) float32
    added: Array  #: (line, column, 2) float32: largest reflectance over the channels added by each neighbour
    #: (line, column) float32: largest reflectance over the channels added by both; less than the sum of
    #: ``added`` where their colours differ
    together: Array
    misfit: Array  #: (line, column) float32: root mean square residual, in standard deviations


# --- lamp lines: `hyperpaint.kernels.line_fits`


# Samples of lamp lines, one row per lamp line; or the samples of a single lamp line.
class LineSamples(NamedTuple):
    values: Array  #: (line, sample) float64
    weights: Array  #: (line, sample) float64: 1 / variance; 0 excludes a sample
    first: Any  #: (line,) int64: position of the first sample of a row
    source: Any  #: (line,) float64: full width at half maximum of the light [samples]


# Fitted parameters of lamp lines, with covariance and chi2.
class LineFits(NamedTuple):
    #: (line, 4) float64: start values, then the result: see `hyperpaint.kernels.line_fits.CENTRE`
    parameters: Array
    covariance: Array  #: (line, 4, 4) float64: inverse of the normal matrix; NaN where it is singular
    chi2: Array  #: (line,) float64: weighted sum of squared residuals
    converged: Array  #: (line,) bool


# --- rays to the ground: `hyperpaint.kernels.rays`


# Origins and directions of the rays of a line camera.
class LineRays(NamedTuple):
    origin: Array  #: (line, 3) float64: projection centre in the line's frame [m]
    rotation: Array  #: (line, 3, 3) float64: rotates camera directions into the line's frame
    look: Array  #: (column, 3) float64: directions of the columns in the camera's frame, of unit length


# Map coordinates and ellipsoidal height as polynomials of each line's local frame.
class LineFrames(NamedTuple):
    #: x, y, height (line, 10) float64: map coordinates and height above the ellipsoid [m], as polynomials of
    #: the line's frame
    x: Array
    y: Array
    height: Array
    convergence: Array  #: (line,) float64: change of the direction of north with east [rad m-1]


# Side of the blocks of a raster whose highest point is stored [cell].
BLOCK = 16


# Height raster with block maxima, and its position as polynomials of each line's local frame.
class Raster(NamedTuple):
    #: row, col (line, 10) float64: raster coordinates, 0 at the centre of the first cell, as polynomials of
    #: the line's frame
    row: Array
    col: Array
    heights: Array  #: (row, col) float64: above the ellipsoid [m]; NaN in holes
    #: (ceil((row - 1) / `BLOCK`), ceil((col - 1) / `BLOCK`)) float64: highest point of every block; minus
    #: infinity where all of it is a hole
    block_max: Array
    #: lowest, highest height [m]
    lowest: float
    highest: float


# --- maps: `hyperpaint.kernels.rays` and `hyperpaint.kernels.rays`


# Map coordinates of the pixels of lines, and of the line before them.
class LinePositions(NamedTuple):
    #: east, north (line, column) float64: of successive lines [m]; NaN where unknown
    east: Array
    north: Array
    #: east_before, north_before (column,) float64: of the line before; NaN for the first line
    east_before: Array
    north_before: Array
    #: (line, column - 1) bool: whether two pixels and the two of the line before span no patch; empty where
    #: all span one
    hidden: Array


# Cells of a tile, and the rule that selects one of several patches over a cell.
class MapCells(NamedTuple):
    #: (6,) float64: east and north of the centre of the map's first cell [m]; columns per metre east and
    #: north; rows per metre east and north
    frame: Array
    corner: tuple[int, int]  #: Row and column of the tile's first cell on the map
    longest: float  #: Longest edge of a patch; longer ones are gaps [cell]
    rule: int  #: `NADIR`, `FIRST` or `LAST` of `hyperpaint.kernels.rays`


# Output arrays of `invert_lines` for a tile.
class InverseTile(NamedTuple):
    #: (2, row, col) float64: line and column at every cell, written where a patch has a lower rank
    place: Array
    #: (2, row, col) int32: line and column of the nearest of the patch's four pixels
    nearest: Array
    #: (row, col) float64: rank of the patch over a cell, lowest first; infinite without a patch
    rank: Array
    hits: Array  #: (row, col) uint16: number of patches over every cell


# Fractional positions between pixels, line by line, and the cells that receive their spectra.
class Places(NamedTuple):
    #: lines, columns (place,) int64: line and column, rounded down
    lines: Array
    columns: Array
    #: along, across (place,), dtype of the output: fraction towards the next line and column, 0 to 1; at 0
    #: the next line or column is not read
    along: Array
    across: Array
    cells: Array  #: (place,) int64: target cell
