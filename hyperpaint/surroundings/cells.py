"""Neighbours are kept by cells of some pixels, since nothing changes quickly with them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

__all__ = ["CELL", "two_nearest"]

Index = npt.NDArray[np.int32]

CELL = 4
"""Side of a cell [pixel]."""


def two_nearest(neighbour: Index, body: Index, paint: Index, number: Index, first: int) -> Index:
    """Return the two nearest coloured bodies, of other paint than its own, of the pixels of some lines.

    Parameters
    ----------
    neighbour : (cell_along, cell_cross, rank)
        Segments nearest to a cell, -1 for none.
    body : (segment,)
        Body of a segment.
    paint : (segment,)
        What is the same for all bodies of one paint.
    number : (line, column)
        Segment of every pixel of these lines, -1 without data.
    first
        Number of the first of these lines.

    Returns
    -------
    (line, column, 2), int32
        Numbers of segments, -1 for none.
    """
    lines, columns = number.shape
    cells = neighbour[(first + np.arange(lines)) // CELL][:, np.arange(columns) // CELL]
    bodies = np.append(body, np.int32(-1))
    paints = np.append(paint, np.int32(-2))
    own = paints[number]
    found = np.full((lines, columns, 2), -1, np.int32)
    for rank in range(cells.shape[-1]):
        here = bodies[cells[..., rank]]
        fresh = (here >= 0) & (paints[here] != own) & (here != found[..., 0])
        into_first = fresh & (found[..., 0] < 0)
        into_second = fresh & ~into_first & (found[..., 1] < 0)
        found[..., 0] = np.where(into_first, here, found[..., 0])
        found[..., 1] = np.where(into_second, here, found[..., 1])
    return found
