"""Regions of a simulated collect, found from the truth of its pixels instead of drawn by hand.

A rectangle is grown over neighbouring pixels that show one car's paint and nothing else, in the sun and
without its mirror image, and hardly differ in height. A paint gets the largest of all cars and flight lines,
drawn in from its edges. Lines pass once, so that memory does not grow with the flight.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .flight import Flight, Lines

#: The file.
REGIONS = "regions.geojson"

#: Rise over run between neighbouring pixels; roofs and bonnets are below, doors and flanks above.
_MAX_SLOPE = 0.1
_MIN_SIDE_PIXELS = 6  # pixels along the shorter side
_MARGIN = 8  # parts of the shorter side; one is left free at each edge

#: First and last line, first and last column.
_Box = tuple[int, int, int, int]


class PaintedRectangles:
    """The largest clean rectangle of every paint, found scan line by scan line.

    Examples
    --------
    >>> from .plan_flight import PlanFlight
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
        self._best: dict[int, tuple[str, _Box]] = {}
        self._areas: dict[int, int] = {}
        self.begin("")

    def begin(self, flightline: str) -> None:
        # Begin a flight line; no rectangle reaches from one to the next.
        columns = self._flight.settings.columns
        self._flightline, self._line = flightline, 0
        self._label = np.full(columns, -1, np.int32)
        self._up = np.zeros(columns)
        self._tall = np.zeros(columns, np.int64)

    def add(self, lines: Lines, recorded: NDArray[np.bool_]) -> None:
        # Add further scan lines in order; only ``recorded`` ones (along_track,) count.
        labels = self._flight.clean_paint(lines)
        ups = np.asarray(lines.layers.get("up", np.zeros(labels.shape)), np.float64)
        for label, up in zip(labels[recorded], ups[recorded], strict=True):
            same = (label == self._label) & (np.abs(up - self._up) <= self._step)
            self._tall = np.where(label < 0, 0, np.where(same, self._tall + 1, 1))
            self._label, self._up = label, up
            if (self._tall >= _MIN_SIDE_PIXELS).any():
                self._search()
            self._line += 1

    def _search(self) -> None:
        # Rectangles that end at this scan line and exceed the largest so far.
        for begin, end in self._runs():
            paint = int(self._label[begin]) % len(self._flight.paints)
            for tall, first, last in _rectangles(self._tall[begin:end].tolist()):
                wide = last - first
                if min(tall, wide) >= _MIN_SIDE_PIXELS and tall * wide > self._areas.get(paint, 0):
                    self._areas[paint] = tall * wide
                    box = (self._line - tall + 1, self._line, begin + first, begin + last - 1)
                    self._best[paint] = self._flightline, box

    def _runs(self) -> Iterator[tuple[int, int]]:
        # Columns that may hold a rectangle: one label, level, and tall enough.
        enough = self._tall >= _MIN_SIDE_PIXELS
        joined = enough[1:] & enough[:-1] & (np.diff(self._label) == 0)
        joined &= np.abs(np.diff(self._up)) <= self._step
        edges = np.flatnonzero(np.diff(np.concatenate([[False], joined, [False]]).astype(np.int8)))
        for begin, end in edges.reshape(-1, 2).tolist():
            if end + 1 - begin >= _MIN_SIDE_PIXELS:
                yield begin, end + 1

    def features(self) -> list[dict[str, Any]]:
        # A GeoJSON Feature of every paint with a rectangle, in the order of the paints.
        return [self._feature(self._flight.paints[paint], *self._best[paint]) for paint in sorted(self._best)]

    def _feature(self, paint: str, flightline: str, box: _Box) -> dict[str, Any]:
        first, last, left, right = box
        margin = max(1, min(last + 1 - first, right + 1 - left) // _MARGIN)
        first, last, left, right = first + margin, last - margin, left + margin, right - margin
        ring = [[left, first], [right, first], [right, last], [left, last], [left, first]]
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

        They name their ``generator``, which regions that were drawn by hand do not have.
        """
        features = ",\n".join(json.dumps(feature) for feature in self.features())
        head = '"type": "FeatureCollection",\n"coordinates": "sensor",\n'
        path.write_text(
            f'{{\n{head}"generator": {json.dumps(generator)},\n"features": [\n{features}\n]\n}}\n',
            encoding="utf-8",
        )


def _rectangles(heights: list[int]) -> Iterator[tuple[int, int, int]]:
    """Yield height, first column and column after the last of all maximal rectangles under a skyline.

    Examples
    --------
    >>> list(_rectangles([2, 3, 1]))
    [(3, 1, 2), (2, 0, 2), (1, 0, 3)]
    """
    rising: list[tuple[int, int]] = []  # height, and the first column that it holds from
    for column, height in enumerate([*heights, 0]):
        begin = column
        while rising and rising[-1][0] >= height:
            tall, begin = rising.pop()
            yield tall, begin, column
        rising.append((height, begin))
