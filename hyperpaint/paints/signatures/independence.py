"""How many independent pixels a region is worth."""

from __future__ import annotations

import numpy as np

from hyperpaint.base.arrays import Array
from hyperpaint.radiometry.uncertainty.averages import effective_number

__all__ = ["SMEAR", "effective_pixels"]


SMEAR = 1.3
"""Pixels that are worth one at least, whatever their values say: 1 + 2 c.

While a line is exposed the camera moves on by some 0.7 of a pixel. A pixel then sees a trapezium along the
track, and of the variance of a white scene neighbours share c = (0.7 / 6) / (0.3 + 2 * 0.7 / 3) = 0.15.
"""

FEWEST = 32
"""Pixels from which their correlation can be told."""

_MOST_CELLS = 2**18
"""Cells of the grid on which correlation is looked at; of a larger region its first lines are."""


def effective_pixels(values: Array, along: Array, across: Array) -> float:
    r"""Return the number of independent pixels that would fix the mean as well as these.

    Parameters
    ----------
    values : (pixel, band)
        Reflectance in some bands; NaN where it is missing.
    along, across : (pixel,)
        Positions in the line.

    Notes
    -----
    .. math:: n_{eff} = n^2 \Big/ \sum_{ij} \overline{c_{ij}}

    with :math:`c_{ij}` the autocorrelation of a band's values at the distance of two pixels, summed from the
    centre outwards until it is not told from zero (as `hyperpaint.mean_uncertainty`), averaged over bands:
    the harmonic mean of their numbers. Values are cut at three robust spreads from the median first, since
    single outliers hide what their neighbours have in common. It is n / 1.3 at most, see `SMEAR`, and just
    that of fewer than 32 pixels, of which it cannot be told.
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
