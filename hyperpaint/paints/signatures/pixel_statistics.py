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

#: Distance from the centre beyond which a value is left out of the trimmed mean [spreads].
TRIM_SIGMAS = 3.0
#: Standard deviation of a normal distribution over its median absolute deviation.
_SIGMA_OF_DEVIATION = 1.482602218505602
MAX_ITERATIONS = 100

#: Change of reflectance at which the geometric median has converged [1].
CONVERGED_CHANGE = 1e-7


@dataclass(frozen=True)
class BandSummary:
    """Centre and spread of every band."""

    #: (band,), float64: Centre of the values, and their standard deviation; NaN where there are none (for sd,
    #: less than two).
    centre: Floats
    sd: Floats
    quantiles: Floats  #: (quantile, band), float64: At `QUANTILES`.


def summarise(values: Array, centre: str) -> BandSummary:
    """Return centre and spread of pixels, band by band.

    Takes ``values`` (pixel, band): reflectance, a value that is not finite is missing in that band only;
    ``centre``: one of `CENTRES`.

    Notes ----- The trimmed mean leaves out values farther from the centre than three spreads: first from the
    median, in median absolute deviations, then from the mean of the remaining values, in their standard
    deviations, until no more are left out.
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
    # Linear quantiles of ascending values; numpy's own function takes ten times as long
    place = np.array(QUANTILES) * (ordered.size - 1)
    below = place.astype(np.intp)
    above = np.minimum(below + 1, ordered.size - 1)
    return np.asarray(ordered[below] + (place - below) * (ordered[above] - ordered[below]))


def _median(ordered: Floats) -> float:
    return float(0.5 * (ordered[(ordered.size - 1) // 2] + ordered[ordered.size // 2]))


def _trimmed_mean(ordered: Floats) -> float:
    centre = _median(ordered)
    spread = _SIGMA_OF_DEVIATION * _median(np.sort(np.abs(ordered - centre)))
    retained = ordered
    for _ in range(MAX_ITERATIONS):
        reach = TRIM_SIGMAS * spread
        first = int(np.searchsorted(retained, centre - reach, "left"))
        last = int(np.searchsorted(retained, centre + reach, "right"))
        # rounding may remove all of several equal values
        if first >= last or (first == 0 and last == retained.size):
            break
        retained = retained[first:last]
        centre, spread = float(retained.mean()), float(retained.std())
    return float(retained.mean())


def geometric_median(values: Array) -> Floats:
    """Return the spectrum with the smallest sum of distances to all others (band,), by Weiszfeld's rule.

    Takes ``values`` (pixel, band): values that are not finite are missing; the distance of a spectrum is over
    the bands that it has.
    """
    has_value = np.isfinite(values)
    filled = np.where(has_value, values, 0.0).astype(np.float64)
    count = np.maximum(has_value.sum(axis=1), 1)
    band_has_value = has_value.any(axis=0)
    centre = np.array(
        [np.median(v[k]) if k.any() else 0.0 for v, k in zip(filled.T, has_value.T, strict=True)]
    )
    for _ in range(MAX_ITERATIONS):
        away = np.sqrt((np.where(has_value, filled - centre, 0.0) ** 2).sum(axis=1) / count)
        # a spectrum at the centre would have infinite weight
        weight = 1.0 / np.maximum(away, CONVERGED_CHANGE)
        total = (has_value * weight[:, None]).sum(axis=0)
        moved = (filled * weight[:, None]).sum(axis=0) / np.where(band_has_value, total, 1.0)
        change = np.abs(moved - centre).max(initial=0.0)
        centre = moved
        if change < CONVERGED_CHANGE:
            break
    return np.where(band_has_value, centre, np.nan)


def chosen_members(along: Array, across: Array, most: int, seed: int) -> npt.NDArray[np.intp]:
    """Return the pixels that represent all (member,), in order: those with the smallest hashes.

    The hash depends on a pixel's position and the seed only, so that the choice does not depend on chunks or
    the number of regions. Leaving out a pixel adds one other, and keeps all others.

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
    # Splitmix64 of every number (Steele, Lea and Flood, OOPSLA 2014); arithmetic is modulo 2**64
    mixed = state + np.uint64(0x9E3779B97F4A7C15)
    mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(mixed ^ (mixed >> np.uint64(31)))


#: Pixels that are worth one at least, whatever their values say: 1 + 2 c.
#: While a line is exposed the camera moves on by some 0.7 of a pixel. A pixel then sees a trapezium along the
#: track, and of the variance of a white scene neighbours share c = (0.7 / 6) / (0.3 + 2 * 0.7 / 3) = 0.15.
SMEAR = 1.3

#: Minimum number of pixels for an estimate of their correlation.
MIN_CORRELATED_PIXELS = 32

#: Maximum size of the grid on which correlation is computed [pixel]; of a larger region the first lines.
MAX_GRID_PIXELS = 2**18


def effective_pixels(values: Array, along: Array, across: Array) -> float:
    r"""Return the number of independent pixels whose mean is as certain as the mean of these pixels.

    Takes ``values`` (pixel, band): reflectance in some bands, NaN where missing; ``along``, ``across``
    (pixel,): positions in the line.

    Notes
    -----
    .. math:: n_{eff} = n^2 \Big/ \sum_{ij} \overline{c_{ij}}

    with :math:`c_{ij}` the autocorrelation of a band's values at the distance of two pixels, summed from the
    centre outwards until it cannot be distinguished from zero (as `hyperpaint.radiometry.mean_uncertainty`),
    averaged over bands: the harmonic mean of their numbers. Values are first clipped at three robust spreads
    from the median, since single outliers hide the correlation of their neighbours. At most n / 1.3, see
    `SMEAR`, and exactly that for fewer than 32 pixels, from which it cannot be estimated.
    """
    count = len(values)
    most = max(1.0, count / SMEAR)
    if count < MIN_CORRELATED_PIXELS:
        return most
    rows, columns = along - along.min(), across - across.min()
    width = int(columns.max()) + 1
    part = rows < max(1, MAX_GRID_PIXELS // width)
    rows, columns, values = rows[part], columns[part], values[part]
    shares = []
    for band in range(values.shape[1]):
        has_value = np.isfinite(values[:, band])
        if has_value.sum() >= MIN_CORRELATED_PIXELS:
            column = values[has_value, band].astype(np.float64)
            middle = np.median(column)
            reach = 3.0 * 1.4826 * np.median(np.abs(column - middle))
            plane = np.full((int(rows.max()) + 1, width), np.nan)
            plane[rows[has_value], columns[has_value]] = np.clip(column, middle - reach, middle + reach)
            shares.append(has_value.sum() / effective_number(plane))
    return float(np.clip(count / np.mean(shares), 1.0, most)) if shares else most


def excluded_of(region: Region, usual: int) -> int:
    """Return the flags whose pixels are left out of a region: ``usual``, unless the region names others."""
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
