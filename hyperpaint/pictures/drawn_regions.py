"""Regions drawn on a flight line: corners of polygons, regions by flight line, and region files."""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import SchemaError, StoreError
from hyperpaint.base.input_files import is_plain_file
from hyperpaint.regions import Region, Regions, regions_from


def corners_at(along: Sequence[float], across: Sequence[float], shape: tuple[int, int]) -> Floats | None:
    """Return clicked places as corners of a polygon: pixel centres inside the line, without repeated corners.

    ``along`` and ``across`` are the clicked positions, ``shape`` is lines and columns. Returns (vertex, 2),
    x (cross_track) and y (along_track); None if the corners enclose no area.

    Examples
    --------
    >>> corners_at([1.2, 8.9, 5.0, 5.0], [-0.4, 0.4, 7.7, 7.8], (100, 50)).tolist()
    [[0.0, 1.0], [0.0, 9.0], [8.0, 5.0]]
    """
    corners = np.column_stack([np.asarray(across, np.float64), np.asarray(along, np.float64)])
    if not len(corners) or not np.isfinite(corners).all():
        return None
    corners = np.clip(np.floor(corners + 0.5), 0, [shape[1] - 1, shape[0] - 1])
    # a double click adds its corner twice
    corners = corners[(corners != np.roll(corners, 1, axis=0)).any(axis=1)]
    if len(corners) < 3:
        return None
    x, y = corners.T
    return corners if x @ np.roll(y, -1) != y @ np.roll(x, -1) else None


def regions_on(regions: Any, flightline: str) -> tuple[Regions, tuple[Region, ...]]:
    """Return the regions of one flight line, and the regions of other lines.

    An empty ``flightline`` takes all regions as its own. Raises `SchemaError` for regions in map coordinates
    or with holes.

    Examples
    --------
    >>> corners = [(0, 0), (4, 0), (4, 3)]
    >>> given = [Region("a", corners), Region("b", corners, flightline="raw_1")]
    >>> outlines, others = regions_on(given, "raw_0")
    >>> outlines.names, [region.name for region in others]
    (('a',), ['b'])
    """
    outlines = Regions(()) if regions is None else regions_from(regions)
    if outlines.coordinates != "sensor":
        raise SchemaError(
            "the regions passed to the explorer are in map coordinates",
            expected="coordinates of the sensor (column and line)",
            code="region-coordinates",
        )
    lines = {"", flightline.replace(" ", "_")}
    others = [
        region for region in outlines if flightline and region.flightline.replace(" ", "_") not in lines
    ]
    if others:
        names = {region.name for region in others}
        outlines = Regions(tuple(region for region in outlines if region.name not in names))
    if holed := [region.name for region in outlines if region.holes]:
        raise SchemaError(
            f"regions with holes cannot be drawn: {', '.join(holed)}",
            mend="leave them out",
            code="region-holes",
        )
    return outlines, tuple(others)


class RegionFiles:
    """Checksums of region files, so that changes by other programs are not overwritten."""

    def __init__(self, regions: Any) -> None:
        self._digests: dict[str, str] = {}
        if isinstance(regions, str | os.PathLike) and is_plain_file(regions):
            with contextlib.suppress(OSError):  # reading the regions reports an unreadable file
                self.remember(Path(regions))

    def remember(self, path: Path) -> None:
        """Store the checksum of a file that was read or saved by this object's owner."""
        self._digests[os.path.realpath(path)] = _digest(path)

    def may_replace(self, path: Path) -> bool:
        """Return whether a file exists and may be replaced; `StoreError` if another program changed it."""
        if not is_plain_file(path):
            return False
        digest = self._digests.get(os.path.realpath(path))
        if digest != _digest(path):
            raise StoreError(
                f"{path} was {'not read or saved here' if digest is None else 'changed by another program'}, "
                "so regions are not saved to it",
                mend="move it away or choose another file, and save again",
                option="move it away and save again, or begin anew with --regions and another file",
                code="file-changed",
            )
        return True


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
