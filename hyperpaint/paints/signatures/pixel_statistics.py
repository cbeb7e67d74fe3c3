"""Statistics of a region's pixels: centre, spread, members, and the number of independent pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Array, Floats
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.schema import Quality
from hyperpaint.radiometry.uncertainty.averages import effective_number
from hyperpaint.regions import Region

CENTRES = ("trimmed_mean", "geometric_median", "median")
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)

#: Spreads beyond which a value is not counted in the trimmed mean.
TRIM_SIGMAS = 3.0
#: Standard deviation of a normal distribution over its median absolute deviation.
_SIGMA_OF_DEVIATION = 1.482602218505602
_MOST_ROUNDS = 100

#: Change of reflectance at which the geometric median is found.
_SETTLED = 1e-7


@dataclass(frozen=True)
class BandSummary:
    """What is typical of every band."""

    #: (band,), float64: Centre of the values, and their standard deviation; NaN where there are none (for sd,
    #: less than two).
    centre: Floats
    sd: Floats
    quantiles: Floats  #: (quantile, band), float64: At `QUANTILES`.


def summarise(values: Array, centre: str) -> BandSummary:
    """Return what is typical of pixels, band by band.

    Takes ``values`` (pixel, band): reflectance; what is not finite is missing, in that band only; ``centre``:
    one of `CENTRES`.

    Notes
    -----
    The trimmed mean leaves out what is farther from the centre than three spreads: first from the median, in
    median absolute deviations, then from the mean of what is left, in its standard deviations, until nothing
    more is left out.
    """
    bands = values.shape[1]
    middle, spread = np.full(bands, np.nan), np.full(bands, np.nan)
    quantiles = np.full((len(QUANTILES), bands), np.nan)
    for band in range(bands):
        column = values[:, band]
        ordered = np.sort(column[np.isfinite(column)].astype(np.float64))
        if ordered.size:
            quantiles[:, band] = _quantiles(ordered)
            middle[band] = _trimmed_mean(ordered) if centre == "trimmed_mean" else _median(ordered)
        if ordered.size > 1:
            spread[band] = ordered.std(ddof=1)
    if centre == "geometric_median":
        middle = geometric_median(values)
    return BandSummary(middle, spread, quantiles)


def _quantiles(ordered: Floats) -> Floats:
    """Return the quantiles of ascending values, linear between them; numpy's own takes ten times as long."""
    place = np.array(QUANTILES) * (ordered.size - 1)
    below = place.astype(np.intp)
    above = np.minimum(below + 1, ordered.size - 1)
    return np.asarray(ordered[below] + (place - below) * (ordered[above] - ordered[below]))


def _median(ordered: Floats) -> float:
    return float(0.5 * (ordered[(ordered.size - 1) // 2] + ordered[ordered.size // 2]))


def _trimmed_mean(ordered: Floats) -> float:
    """Return the iterated trimmed mean of ascending values."""
    centre = _median(ordered)
    spread = _SIGMA_OF_DEVIATION * _median(np.sort(np.abs(ordered - centre)))
    retained = ordered
    for _ in range(_MOST_ROUNDS):
        reach = TRIM_SIGMAS * spread
        first = int(np.searchsorted(retained, centre - reach, "left"))
        last = int(np.searchsorted(retained, centre + reach, "right"))
        # rounding may leave nothing of values that are all the same
        if first >= last or (first == 0 and last == retained.size):
            break
        retained = retained[first:last]
        centre, spread = float(retained.mean()), float(retained.std())
    return float(retained.mean())


def geometric_median(values: Array) -> Floats:
    """Return the spectrum whose distances to all others have the smallest sum (band,), by Weiszfeld's rule.

    Takes ``values`` (pixel, band): what is not finite is missing; the distance of a spectrum is over the
    bands that it has.
    """
    there = np.isfinite(values)
    filled = np.where(there, values, 0.0).astype(np.float64)
    count = np.maximum(there.sum(axis=1), 1)
    seen = there.any(axis=0)
    centre = np.array([np.median(v[k]) if k.any() else 0.0 for v, k in zip(filled.T, there.T, strict=True)])
    for _ in range(_MOST_ROUNDS):
        away = np.sqrt((np.where(there, filled - centre, 0.0) ** 2).sum(axis=1) / count)
        # a spectrum that is the centre would weigh without end
        weight = 1.0 / np.maximum(away, _SETTLED)
        total = (there * weight[:, None]).sum(axis=0)
        moved = (filled * weight[:, None]).sum(axis=0) / np.where(seen, total, 1.0)
        change = np.abs(moved - centre).max(initial=0.0)
        centre = moved
        if change < _SETTLED:
            break
    return np.where(seen, centre, np.nan)


def chosen_members(along: Array, across: Array, most: int, seed: int) -> npt.NDArray[np.intp]:
    """Return which pixels stand for all (member,), in order: those whose hash is smallest.

    The hash is of a pixel's position and the seed, so that the choice is of the pixels alone: not of chunks,
    nor of how many regions there are. A pixel that is left out makes room for one more, and moves no other.

    Takes ``along``, ``across`` (pixel,): positions in the line; ``most``: how many are chosen; ``seed``:
    another seed, another choice.

    Examples
    --------
    >>> chosen_members(np.zeros(9, int), np.arange(9), most=3, seed=0).size
    3
    """
    mixed = _mix(np.full(1, seed & (2**64 - 1), np.uint64))
    hashed = _mix(_mix(along.astype(np.uint64) + mixed) + across.astype(np.uint64))
    return np.sort(np.argsort(hashed, kind="stable")[:most])


def _mix(state: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
    """Return splitmix64 of every number (Steele, Lea and Flood, OOPSLA 2014); arithmetic is modulo 2**64."""
    mixed = state + np.uint64(0x9E3779B97F4A7C15)
    mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(mixed ^ (mixed >> np.uint64(31)))


#: Pixels that are worth one at least, whatever their values say: 1 + 2 c.
#: While a line is exposed the camera moves on by some 0.7 of a pixel. A pixel then sees a trapezium along the
#: track, and of the variance of a white scene neighbours share c = (0.7 / 6) / (0.3 + 2 * 0.7 / 3) = 0.15.
SMEAR = 1.3

#: Pixels from which their correlation can be estimated.
FEWEST = 32

#: Cells of the grid on which correlation is looked at; of a larger region its first lines are.
_MOST_CELLS = 2**18


def effective_pixels(values: Array, along: Array, across: Array) -> float:
    r"""Return the number of independent pixels that would fix the mean as well as these.

    Takes ``values`` (pixel, band): reflectance in some bands; NaN where it is missing; ``along``, ``across``
    (pixel,): positions in the line.

    Notes
    -----
    .. math:: n_{eff} = n^2 \Big/ \sum_{ij} \overline{c_{ij}}

    with :math:`c_{ij}` the autocorrelation of a band's values at the distance of two pixels, summed from the
    centre outwards until it is not told from zero (as `hyperpaint.radiometry.mean_uncertainty`), averaged
    over bands: the harmonic mean of their numbers. Values are cut at three robust spreads from the median
    first, since single outliers hide what their neighbours have in common. It is n / 1.3 at most, see
    `SMEAR`, and just that of fewer than 32 pixels, of which it cannot be estimated.
    """
    count = len(values)
    most = max(1.0, count / SMEAR)
    if count < FEWEST:
        return most
    rows, columns = along - along.min(), across - across.min()
    width = int(columns.max()) + 1
    part = rows < max(1, _MOST_CELLS // width)
    rows, columns, values = rows[part], columns[part], values[part]
    shares = []
    for band in range(values.shape[1]):
        there = np.isfinite(values[:, band])
        if there.sum() >= FEWEST:
            column = values[there, band].astype(np.float64)
            middle = np.median(column)
            reach = 3.0 * 1.4826 * np.median(np.abs(column - middle))
            plane = np.full((int(rows.max()) + 1, width), np.nan)
            plane[rows[there], columns[there]] = np.clip(column, middle - reach, middle + reach)
            shares.append(there.sum() / effective_number(plane))
    return float(np.clip(count / np.mean(shares), 1.0, most)) if shares else most


def excluded_of(region: Region, usual: int) -> int:
    """Return the flags of the pixels of a region that are left out, which it may name itself."""
    names = region.properties.get("excluded_flags")
    if names is None:
        return usual
    flags = {flag.name.lower(): int(flag) for flag in Quality if flag.name}
    if not isinstance(names, list) or not set(names) <= set(flags):
        raise SchemaError(
            f"region {region.name!r}: excluded_flags is {names!r:.80}",
            expected=f"a list of {', '.join(flags)}",
            code="choice-unknown",
        )
    return sum(flags[name] for name in set(names))
