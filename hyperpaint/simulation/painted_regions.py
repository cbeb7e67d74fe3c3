"""Regions of paints in a simulated collect, found from the truth of its pixels.

A region is a rectangle of neighbouring pixels that show only the paint of one car, in the sun, without
mirrored sun, and at nearly the same height. A paint gets its largest rectangle over all cars and flight
lines, minus a margin. Lines are processed once and in order, so that memory does not grow with the flight.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .flight import Flight, Lines

#: Name of the file.
REGIONS = "regions.geojson"

#: Maximum height difference of neighbouring pixels over their distance: includes roofs and bonnets, not
#: doors.
_MAX_SLOPE = 0.1
_MIN_SIDE_PIXELS = 6  # minimum length of the shorter side
_MARGIN_DIVISOR = 8  # shorter side over the margin at every edge

#: First and last line, first and last column of a rectangle.
_Box = tuple[int, int, int, int]


class PaintedRectangles:
    """The largest rectangle of every paint, found scan line by scan line.

    Examples
    --------
    >>> from .flight import PlanFlight
    >>> from .settings import SimulationSettings
    >>> flight = PlanFlight(SimulationSettings(lines=64, bands=2, columns=160, scene="plan"))
    >>> rectangles = PaintedRectangles(flight)
    >>> rectangles.begin("raw_0")
    >>> rectangles.add(flight.lines(0, 64), np.ones(64, bool))
    >>> [feature["properties"]["name"] for feature in rectangles.features()]
    ['ir_black', 'red', 'green', 'yellow']
    """

    def __init__(self, flight: Flight) -> None:
        self._flight = flight
        self._step = _MAX_SLOPE * flight.ground_sample
        self._rectangles_by_paint: dict[int, tuple[str, _Box]] = {}
        self._areas: dict[int, int] = {}
        self.begin("")

    def begin(self, flightline: str) -> None:
        # start a flight line, since rectangles do not extend over two lines
        columns = self._flight.settings.columns
        self._flightline, self._line = flightline, 0
        self._label = np.full(columns, -1, np.int32)
        self._heights = np.zeros(columns)
        self._run_lengths = np.zeros(columns, np.int64)

    def add(self, lines: Lines, recorded: NDArray[np.bool_]) -> None:
        # add scan lines in order; only ``recorded`` lines (along_track,) are used
        labels = self._flight.clean_paint(lines)
        heights = np.asarray(lines.layers.get("up", np.zeros(labels.shape)), np.float64)
        for label, line_heights in zip(labels[recorded], heights[recorded], strict=True):
            continues = (label == self._label) & (np.abs(line_heights - self._heights) <= self._step)
            self._run_lengths = np.where(label < 0, 0, np.where(continues, self._run_lengths + 1, 1))
            self._label, self._heights = label, line_heights
            if (self._run_lengths >= _MIN_SIDE_PIXELS).any():
                self._search()
            self._line += 1

    def _search(self) -> None:
        # keep rectangles that end at this scan line and are larger than those before
        for run_start, run_stop in self._runs():
            paint = int(self._label[run_start]) % len(self._flight.paints)
            for height, start, stop in _rectangles(self._run_lengths[run_start:run_stop].tolist()):
                width = stop - start
                if min(height, width) >= _MIN_SIDE_PIXELS and height * width > self._areas.get(paint, 0):
                    self._areas[paint] = height * width
                    box = (self._line - height + 1, self._line, run_start + start, run_start + stop - 1)
                    self._rectangles_by_paint[paint] = self._flightline, box

    def _runs(self) -> Iterator[tuple[int, int]]:
        # ranges of columns with one label, similar heights, and enough lines for a rectangle
        enough = self._run_lengths >= _MIN_SIDE_PIXELS
        is_joined = enough[1:] & enough[:-1] & (np.diff(self._label) == 0)
        is_joined &= np.abs(np.diff(self._heights)) <= self._step
        edges = np.flatnonzero(np.diff(np.concatenate([[False], is_joined, [False]]).astype(np.int8)))
        for begin, end in edges.reshape(-1, 2).tolist():
            if end + 1 - begin >= _MIN_SIDE_PIXELS:
                yield begin, end + 1

    def features(self) -> list[dict[str, Any]]:
        # GeoJSON features of the paints with a rectangle, in the order of the paints
        return [
            self._feature(self._flight.paints[paint], *self._rectangles_by_paint[paint])
            for paint in sorted(self._rectangles_by_paint)
        ]

    def _feature(self, paint: str, flightline: str, box: _Box) -> dict[str, Any]:
        top, bottom, left, right = box
        margin = max(1, min(bottom + 1 - top, right + 1 - left) // _MARGIN_DIVISOR)
        top, bottom, left, right = top + margin, bottom - margin, left + margin, right - margin
        ring = [[left, top], [right, top], [right, bottom], [left, bottom], [left, top]]
        properties: Mapping[str, str] = {
            "name": paint,
            "flightline": flightline,
            "reference": paint,
            **self._flight.paint_properties(paint),
        }
        return {
            "type": "Feature",
            "properties": dict(properties),
            "geometry": {"type": "Polygon", "coordinates": [ring]},
        }

    def write(self, path: Path, generator: str) -> None:
        """Write the regions as GeoJSON in coordinates of the sensor.

        ``generator`` marks the file as simulated.
        """
        features = ",\n".join(json.dumps(feature) for feature in self.features())
        head = '"type": "FeatureCollection",\n"coordinates": "sensor",\n'
        path.write_text(
            f'{{\n{head}"generator": {json.dumps(generator)},\n"features": [\n{features}\n]\n}}\n',
            encoding="utf-8",
        )


def _rectangles(heights: list[int]) -> Iterator[tuple[int, int, int]]:
    """Yield height, first column and end column of all maximal rectangles under a histogram of heights.

    Examples
    --------
    >>> list(_rectangles([2, 3, 1]))
    [(3, 1, 2), (2, 0, 2), (1, 0, 3)]
    """
    rising: list[tuple[int, int]] = []  # stack of increasing heights, with the first column of each
    for column, height in enumerate([*heights, 0]):
        begin = column
        while rising and rising[-1][0] >= height:
            top_height, begin = rising.pop()
            yield top_height, begin, column
        rising.append((height, begin))
