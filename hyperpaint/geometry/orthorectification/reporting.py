"""What a map covers, in numbers."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hyperpaint.base.errors import SchemaError

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["map_report"]


def map_report(made: xr.Dataset) -> dict[str, float]:
    """Return how many cells of a map are covered, several times or not at all (eager, a tile at a time).

    Parameters
    ----------
    made
        What `hyperpaint.orthorectify` has returned.

    Returns
    -------
    dict
        ``cells``: of the whole rectangle; ``covered``: that at least one patch of four pixels shows;
        ``gaps``: that none shows, between the ends of the lines; ``multiple``: that several show, where the
        line goes back over itself; ``most_hits``: the most that show one cell.

    Raises
    ------
    SchemaError
        This is no map: it has no ``hits`` or ``gap``.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> made = xr.Dataset({"hits": (("y", "x"), np.uint16([[0, 2], [1, 0]]))})
    >>> map_report(made.assign(gap=made.hits == np.array([[0, 9], [9, 9]])))
    {'cells': 4, 'covered': 2, 'gaps': 1, 'multiple': 1, 'most_hits': 2}
    """
    import dask

    missing = [name for name in ("hits", "gap") if name not in made.variables]
    if missing:
        raise SchemaError(
            f"this is no map: {' and '.join(map(repr, missing))} missing; orthorectify a flight line first"
        )
    hits, gap = made["hits"], made["gap"]
    lazy = ((hits > 0).sum(), gap.sum(), (hits > 1).sum(), hits.max())
    covered, gaps, multiple, most = dask.compute(*(part.data for part in lazy))
    return {
        "cells": int(np.prod(hits.shape)),
        "covered": int(covered),
        "gaps": int(gaps),
        "multiple": int(multiple),
        "most_hits": int(most),
    }
