"""Orientation of pictures: not mirrored, and pixels with their aspect ratio on the ground.

A flight line is flown upwards, with columns in their order on the ground; a map has north up. On pages, where
an upright line would be too tall, it is flown to the right.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Array
from hyperpaint.base.schema import ALONG_TRACK, CROSS_TRACK, numbers_of

from .figures import label_for


@dataclass(frozen=True)
class Orientation:
    """Position of a picture's pixels on its axes."""

    extent: tuple[float, float, float, float]  # outer edges of first and last column, of first and last line
    is_mirrored: bool  # whether columns run to the left of the flight, so that their axis is reversed
    goes_down: bool  # whether the vertical axis grows downwards
    aspect: float  # length of a pixel along the vertical axis over its length along the horizontal axis
    labels: tuple[str, str]  # of the horizontal and of the vertical axis

    @property
    def limits(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Limits of the horizontal axis from left to right, and of the vertical axis upwards."""
        left, right, *vertical = self.extent
        horizontal = (right, left) if self.is_mirrored else (left, right)
        minimum, maximum = sorted(vertical)
        return horizontal, (maximum, minimum) if self.goes_down else (minimum, maximum)

    def height_of(self, width: float) -> float:
        """Return the height of a picture of a given width."""
        left, right, first_line, last_line = self.extent
        return width * self.aspect * abs((last_line - first_line) / (right - left))


def map_dims(cube: xr.DataArray | xr.Dataset) -> dict[str, str]:
    """Return "y" and "x" by role if a dataset has the coordinates of a map, otherwise an empty dict."""
    pairs = {ALONG_TRACK: "y", CROSS_TRACK: "x"}
    is_map = all(name in cube.coords and cube[name].dims == (role,) for role, name in pairs.items())
    return pairs if is_map else {}


def orientation_of(dataset: xr.Dataset) -> Orientation:
    """Return the orientation of a flight line or a map.

    Columns are reversed if they run to the left of the flight, by ``east`` and ``north`` of the pixels, else
    by ``look_across``, else by the declared column order. Pixels have the aspect ratio of their spacing on
    the ground where it is known, else they are square.
    """
    lines, columns = dataset.sizes[ALONG_TRACK], dataset.sizes[CROSS_TRACK]
    if map_dims(dataset) and lines > 1 and columns > 1:
        x, y = (np.asarray(dataset[name].values, np.float64) for name in ("x", "y"))
        half_x, half_y = (0.5 * float(values[-1] - values[0]) / (values.size - 1) for values in (x, y))
        extent = (float(x[0]) - half_x, float(x[-1]) + half_x, float(y[0]) - half_y, float(y[-1]) + half_y)
        attrs = [dataset[name].attrs for name in ("x", "y")]
        # rows of a grid along the flight count down from its corner
        is_flight_grid = any("along the flight" in f"{a.get('crs')} {a.get('long_name')}" for a in attrs)
        names = ("to the right in the grid", "down in the grid") if is_flight_grid else ("east", "north, up")
        units = [f" [{label_for(a['units'])}]" if a.get("units") else "" for a in attrs]
        labels = names[0] + units[0], names[1] + units[1]
        return Orientation(extent, half_x < 0, is_flight_grid, 1.0, labels)
    # centres of pixels are whole numbers; a crop keeps the line and column numbers of its flight line
    line_numbers, column_numbers = numbers_of(dataset, ALONG_TRACK), numbers_of(dataset, CROSS_TRACK)
    extent = (
        column_numbers[0] - 0.5,
        column_numbers[-1] + 0.5,
        line_numbers[0] - 0.5,
        line_numbers[-1] + 0.5,
    )
    labels = "cross_track [column]", "along_track [line], flown upwards"
    steps = _ground_steps(dataset)
    if steps is not None:
        forward, right = steps
        mirrored = right[0] * forward[1] - right[1] * forward[0] < 0.0
        aspect = float(np.hypot(*forward) / np.hypot(*right))
        return Orientation(extent, bool(mirrored), False, aspect, labels)
    # column order from the look angles, as in `locate`, else the declared column order
    slope = 0.0
    if "look_across" in dataset.variables and dataset["look_across"].dims == (CROSS_TRACK,):
        slope = _mean_step(dataset["look_across"].values)
    order = "left_to_right" if slope > 0.0 else "right_to_left" if slope < 0.0 else ""
    order = order or dataset.attrs.get("convention_column_order", "")
    assumed = "" if order in ("left_to_right", "right_to_left") else ", assumed to run to the right"
    return Orientation(extent, order == "right_to_left", False, 1.0, (labels[0] + assumed, labels[1]))


def _ground_steps(dataset: xr.Dataset) -> tuple[Array, Array] | None:
    # (east, north) of a step along and a step across the track [m]; None where unknown
    if not all(
        name in dataset.coords and set(dataset[name].dims) == {ALONG_TRACK, CROSS_TRACK}
        for name in ("east", "north")
    ):
        return None
    lines, columns = dataset.sizes[ALONG_TRACK], dataset.sizes[CROSS_TRACK]
    if lines < 2 or columns < 2:
        return None
    # computed along the central column and across the central line only
    central_column = dataset[["east", "north"]].isel({CROSS_TRACK: columns // 2}).compute()
    central_line = dataset[["east", "north"]].isel({ALONG_TRACK: lines // 2}).compute()
    steps = [
        np.array([_mean_step(positions[name].values) for name in ("east", "north")])
        for positions in (central_column, central_line)
    ]
    if not all(np.isfinite(step).all() and np.hypot(*step) > 0.0 for step in steps):
        return None
    return steps[0], steps[1]


def _mean_step(values: Array) -> float:
    # mean step between neighbours, from the first to the last finite value
    places = np.flatnonzero(np.isfinite(values))
    if places.size < 2:
        return float("nan")
    return float((values[places[-1]] - values[places[0]]) / (places[-1] - places[0]))


def flown_right(picture: Array, orientation: Orientation) -> Array:
    """Return a picture (line, column, ...) as (row, line, ...) with the flight to the right."""
    # the flight is to the right, so that columns on its right side are below
    return np.asarray((picture[:, ::-1] if orientation.is_mirrored else picture).swapaxes(0, 1))


def show_picture(axes: Any, picture: Array, orientation: Orientation, **options: Any) -> Any:
    """Show a picture (line, column, ...) on axes, in pixels of the line or metres of the map."""
    image = axes.imshow(
        picture,
        origin="lower",
        extent=orientation.extent,
        aspect=orientation.aspect,
        interpolation="nearest",
        **options,
    )
    horizontal, vertical = orientation.limits
    axes.set(xlim=horizontal, ylim=vertical, xlabel=orientation.labels[0], ylabel=orientation.labels[1])
    axes.ticklabel_format(useOffset=False, style="plain")
    axes.tick_params(labelsize="small")
    axes.locator_params(axis="x", nbins=4)  # easting has six digits
    return image
