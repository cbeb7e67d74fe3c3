"""What the kernels take, grouped by what belongs together; numba passes these tuples as they are.

Free of numba, so that callers can make and keep them without loading a compiler.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from hyperpaint.base.arrays import Array

__all__ = [
    "AmountPrior", "Bodies", "Calibration", "ChannelErrors", "CountLimits", "ErrorTerms", "FixedFlags",
    "InverseTile", "LightCells", "LightParts", "LineFits", "LineFrames", "LinePositions", "LineRays",
    "LineSamples", "MapCells", "Places", "Raster", "SlabOutputs", "Unmixed",
]  # fmt: skip


# --- counts to reflectance: `hyperpaint.kernels.radiometry`


class Calibration(NamedTuple):
    """What turns counts into radiance per exposure.

    Attributes
    ----------
    dark : (n, band, column), float32
    dark_index, dark_weight : (line,)
        The dark of a line lies between ``dark[i]`` and ``dark[i + 1]``, at this weight of the later; one dark
        alone serves every line.
    gain : (band, column), float32
        NaN marks a bad element.
    """

    dark: Array
    dark_index: Array
    dark_weight: Array
    gain: Array


class LightCells(NamedTuple):
    """What dark-subtracted counts times gain are multiplied or divided by, over the cells of the smile.

    Attributes
    ----------
    coefficients : (line, band, cell, 1 or 4), float32
        One: what counts are multiplied by. Four: a cubic in ``shift``, by which they are divided.
    shift : (1 or band, column), float32
        Position of a column inside its cell.
    edges : (1 or band, run + 1), cells : (1 or band, run), int64
        Columns where runs begin whose columns share a cell, and that cell.
    """

    coefficients: Array
    shift: Array
    edges: Array
    cells: Array


class CountLimits(NamedTuple):
    """Counts beyond which a sample is flagged.

    Attributes
    ----------
    saturation : (1, 1) or (band, column), like counts
        Counts from which a sample is saturated.
    noise_margin : (band, column), float32
        How far below the dark noise may take a sample; NaN for an element that sets no flag.
    most_negative : uint16
        Number of samples under the dark that a pixel may have.
    whole : bool
        Counts are integers.
    """

    saturation: Array
    noise_margin: Array
    most_negative: Any
    whole: Any


class FixedFlags(NamedTuple):
    """Bits of quality of whole lines (line,) and columns (column,), and that of a line without data."""

    lines: Array
    columns: Array
    no_data: Any


class ErrorTerms(NamedTuple):
    """Terms of the error budget, as the uncertainty of every sample is computed from them.

    Attributes
    ----------
    per_electron, noise_floor : (1 or band, column), float32
        Counts per electron, and the variance of a count without light [count2].
    relative : (1 or band, column), float32
        What is proportional to reflectance and common to the flight [1].
    offset : (1 or band, column), float32
        Systematic uncertainty of the dark [count].
    slope : (0 or band, 4), float32
        Wavelength uncertainty over the distance to the neighbouring bands: what the rise to the band above is
        multiplied by with a band below, and without; what the rise from the band below is multiplied by
        with a band above, and without. Empty where neither wavelengths nor the dark are uncertain.
    """

    per_electron: Array
    noise_floor: Array
    relative: Array
    offset: Array
    slope: Array


class SlabOutputs(NamedTuple):
    """What is written of a slab; quality and uncertainties unless they are empty.

    Attributes
    ----------
    cube : (line, band, column), float32
    quality : (line, column) or (0, 0), uint16
    u_random, u_systematic : (line, band, column) or (0, 0, 0), float32
    """

    cube: Array
    quality: Array
    u_random: Array
    u_systematic: Array


# --- what a pixel's light is made of: `hyperpaint.kernels.unmixing`


class Bodies(NamedTuple):
    """What pixels show.

    Attributes
    ----------
    body_of : (line, column), int32
        What each pixel shows, a row of ``reflectance``; -1 leaves it NaN.
    reflectance : (body, channel), float64
        In full light [1].
    neighbours : (line, column, 2), int32
        Rows of ``reflectance`` that light each pixel; -1 for none.
    """

    body_of: Array
    reflectance: Array
    neighbours: Array


class LightParts(NamedTuple):
    """Direct and diffuse part of the irradiance (channel,), float64 [1]."""

    direct: Array
    diffuse: Array


class ChannelErrors(NamedTuple):
    """Standard deviation of channels: relative to what is seen (channel,) [1], and what is added [1]."""

    noise: Array
    floor: Any


class AmountPrior(NamedTuple):
    """What amounts are without evidence.

    Attributes
    ----------
    expected, spread : (part,), float64
        What they are, and how far from it they come to lie.
    tilt : (body,), float64
        The spread of the amount of direct light, in place of that in ``spread``.
    most : (part,), float64
        Amounts are no larger.
    """

    expected: Array
    spread: Array
    tilt: Array
    most: Array


class Unmixed(NamedTuple):
    """What is written of a block of lines.

    Attributes
    ----------
    amount : (line, column, part), float32
    added : (line, column, 2), float32
        Largest reflectance over the channels that each neighbour adds.
    together : (line, column), float32
        Largest reflectance over the channels that both add; less than the sum of ``added`` where they are of
        different colours.
    misfit : (line, column), float32
        Root mean square of what remains, in standard deviations.
    """

    amount: Array
    added: Array
    together: Array
    misfit: Array


# --- monochromatic lines: `hyperpaint.kernels.line_fits`


class LineSamples(NamedTuple):
    """Samples of lines, row by row, or of one of them.

    Attributes
    ----------
    values : (line, sample), float64
    weights : (line, sample), float64
        One over the variance; zero leaves a sample out.
    first : (line,), int64
        Place of the first sample of a row.
    source : (line,), float64
        Full width at half maximum of the light [samples].
    """

    values: Array
    weights: Array
    first: Any
    source: Any


class LineFits(NamedTuple):
    """What is fitted to lines.

    Attributes
    ----------
    parameters : (line, 4), float64
        Where to begin, and the result: see `hyperpaint.kernels.line_fits.CENTRE`.
    covariance : (line, 4, 4), float64
        Inverse of the normal matrix; NaN where it is singular.
    chi2 : (line,), float64
        Weighted sum of squared residuals.
    converged : (line,), bool
    """

    parameters: Array
    covariance: Array
    chi2: Array
    converged: Array


# --- rays to the ground: `hyperpaint.kernels.rays`


class LineRays(NamedTuple):
    """Where the rays of a line camera begin, and where they go.

    Attributes
    ----------
    origin : (line, 3), float64
        Projection centre in the line's frame [m].
    rotation : (line, 3, 3), float64
        Turns directions of the camera into the line's frame.
    look : (column, 3), float64
        Directions of the columns in the camera's frame, of unit length.
    """

    origin: Array
    rotation: Array
    look: Array


class LineFrames(NamedTuple):
    """What lies around a line.

    Attributes
    ----------
    x, y, height : (line, 10), float64
        Coordinates of the map and height above the ellipsoid [m], as polynomials of the line's frame.
    turn : (line,), float64
        How north turns with the way to the east [rad m-1].
    """

    x: Array
    y: Array
    height: Array
    turn: Array


class Raster(NamedTuple):
    """A raster of heights.

    Attributes
    ----------
    row, col : (line, 10), float64
        Place in the raster, 0 at the centre of its first cells, as polynomials of the line's frame.
    heights : (row, col), float64
        Above the ellipsoid [m]; NaN in holes.
    tops : (ceil((row - 1) / `BLOCK`), ceil((col - 1) / `BLOCK`)), float64
        Highest point of every block; minus infinity where all of it is a hole.
    lowest, highest
        Of all heights [m].
    """

    row: Array
    col: Array
    heights: Array
    tops: Array
    lowest: float
    highest: float


# --- maps: `hyperpaint.kernels.inverse_map` and `hyperpaint.kernels.gathering`


class LinePositions(NamedTuple):
    """Where the pixels of lines lie on the map.

    Attributes
    ----------
    east, north : (line, column), float64
        Of lines that follow one another [m]; NaN where that is not known.
    east_before, north_before : (column,), float64
        The same of the line before; NaN where there is none.
    """

    east: Array
    north: Array
    east_before: Array
    north_before: Array


class MapCells(NamedTuple):
    """The cells of a tile, and which patch over a cell counts.

    Attributes
    ----------
    frame : (6,), float64
        East and north of the centre of the map's first cell [m]; then what turns metres from there into
        columns of cells, and into rows of cells, each by its part per metre east and north.
    corner
        Row and column of the tile's first cell on the map.
    longest
        Edge from which a patch is a gap, and covers nothing [cell].
    rule
        `NADIR`, `FIRST` or `LAST` of `hyperpaint.kernels.inverse_map`.
    """

    frame: Array
    corner: tuple[int, int]
    longest: float
    rule: int


class InverseTile(NamedTuple):
    """What is written of a tile.

    Attributes
    ----------
    place : (2, row, col), float64
        Line and column of every cell, written where a patch covers one that has none yet or a worse one.
    nearest : (2, row, col), int32
        Line and column of the one of the patch's four pixels that lies nearest to the cell.
    rank : (row, col), float64
        What cells are compared by, the least wins; infinite where nothing has covered them.
    hits : (row, col), uint16
        Patches over every cell, added to.
    """

    place: Array
    nearest: Array
    rank: Array
    hits: Array


class Places(NamedTuple):
    """Places between pixels, line by line, and the cells they go to.

    Attributes
    ----------
    lines, columns : (place,), int64
        Pixel before each place.
    along, across : (place,), like what is written
        Way to the next line and column, 0 to 1; of what is 0 away the next is not looked at.
    cells : (place,), int64
        Where each goes.
    """

    lines: Array
    columns: Array
    along: Array
    across: Array
    cells: Array
