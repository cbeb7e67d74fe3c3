"""Regions drawn by hand on the picture of a flight line, in a notebook (extra ``interactive``)."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hyperpaint.base import schema
from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import MissingExtraError, PaintError, SchemaError
from hyperpaint.base.schema import ALONG_TRACK, CROSS_TRACK
from hyperpaint.paints.signatures import extract_signatures
from hyperpaint.regions import Region, Regions, regions_from, write_regions

from .plot_flags import background

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["RegionPicker", "corners_at", "pick_regions"]


def pick_regions(
    line: xr.Dataset,
    regions: Any = None,
    *,
    flightline: str = "",
    lines: int = 2000,
    exclude: schema.Quality | int | None = None,
) -> RegionPicker:
    """Return a widget to draw regions on a flight line with the mouse.

    Shows the true-colour picture. Click the corners of a polygon and double-click the last: it becomes a
    region, whose spectrum is shown at once.

    Parameters
    ----------
    line
        A flight line with reflectance, or with what it follows from.
    regions
        To begin with, in sensor coordinates; see `hyperpaint.read_regions`.
    flightline
        Name of the flight line, which new regions get: needed where regions of several lines come together.
    lines
        Lines of the picture at the most; of a longer line every n-th is shown. Corners are those of the whole
        line all the same.
    exclude
        Flags of pixels that are left out of the spectra; by default as `hyperpaint.extract_signatures` does.

    Returns
    -------
    RegionPicker
        Show it as the last line of a cell; ``.regions`` holds what is drawn.

    Raises
    ------
    MissingExtraError
        panel or bokeh is not installed.
    SchemaError
        There is no reflectance, or the regions are not in sensor coordinates.

    Notes
    -----
    A notebook loads the widget's scripts from the internet, as panel does by default; where there is none,
    set ``PANEL_INLINE=True`` in the environment of the kernel, which puts them into the notebook.

    Examples
    --------
    >>> picker = pick_regions(line)                            # doctest: +SKIP
    >>> picker                                                 # doctest: +SKIP
    >>> line.paint.signatures(picker.regions)                  # doctest: +SKIP
    """
    return RegionPicker(line, regions, flightline=flightline, lines=lines, exclude=exclude)


def corners_at(along: Sequence[float], across: Sequence[float], shape: tuple[int, int]) -> Floats | None:
    """Return places on the picture as corners of a polygon: whole pixels of the line, no two alike in a row.

    Parameters
    ----------
    along, across
        Places, as they were clicked.
    shape
        Lines and columns.

    Returns
    -------
    (vertex, 2), float64, or None
        x (cross_track) and y (along_track); None where they hold no area.

    Examples
    --------
    >>> corners_at([1.2, 8.9, 5.0, 5.0], [-0.4, 0.4, 7.7, 7.8], (100, 50)).tolist()
    [[0.0, 1.0], [0.0, 9.0], [8.0, 5.0]]
    """
    corners = np.column_stack([np.asarray(across, np.float64), np.asarray(along, np.float64)])
    if not len(corners) or not np.isfinite(corners).all():
        return None
    corners = np.clip(np.floor(corners + 0.5), 0, [shape[1] - 1, shape[0] - 1])
    # a double click leaves its corner twice
    corners = corners[(corners != np.roll(corners, 1, axis=0)).any(axis=1)]
    if len(corners) < 3:
        return None
    x, y = corners.T
    return corners if x @ np.roll(y, -1) != y @ np.roll(x, -1) else None


class RegionPicker:
    """A picture of a flight line to draw regions on; see `pick_regions`.

    Attributes
    ----------
    view
        The widget: a layout of panel, which ``panel serve`` shows as well.
    """

    def __init__(
        self,
        line: xr.Dataset,
        regions: Any = None,
        *,
        flightline: str = "",
        lines: int = 2000,
        exclude: schema.Quality | int | None = None,
    ) -> None:
        _need_extra()
        from .picking_view import PickerView

        self._line = schema.rename_to_roles(line)
        self._shape = self._line.sizes[ALONG_TRACK], self._line.sizes[CROSS_TRACK]
        self._exclude = exclude
        self._flightline = flightline
        self._regions = _on_sensor(regions)
        self._spectra: dict[bytes, tuple[Floats, Floats] | str] = {}
        step = max(1, -(-self._shape[0] // max(lines, 1)))
        self._shown = PickerView(self, background(self._line, step), self._shape)
        self.view = self._shown.layout

    @property
    def regions(self) -> Regions:
        """What is drawn now, in sensor coordinates: x is cross_track, y along_track, whole pixels."""
        return self._regions

    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
        """Write what is drawn as GeoJSON; see `hyperpaint.write_regions`."""
        return write_regions(self.regions, path, overwrite=overwrite)

    # --- what the mouse does -------------------------------------------------------------------------------

    def add(self, along: Sequence[float], across: Sequence[float]) -> str | None:
        """Make a polygon a region; return its new name, None where it holds no area."""
        corners = corners_at(along, across, self._shape)
        if corners is None:
            return None
        number = 1
        while (name := f"region {number}") in self._regions.names:
            number += 1
        self._regions = Regions((*self._regions, Region(name, corners, flightline=self._flightline)))
        return name

    def move(self, name: str, along: Sequence[float], across: Sequence[float]) -> bool:
        """Give a region other corners; return whether it took them: they must hold an area."""
        corners = corners_at(along, across, self._shape)
        if corners is not None:
            self._replace(name, polygon=corners)
        return corners is not None

    def rename(self, name: str, new: str) -> str | None:
        """Give a region another name; return why it cannot have it, None where it has."""
        try:
            self._replace(name, name=new.strip())
        except PaintError as error:
            return str(error)
        return None

    def drop(self, name: str) -> None:
        """Remove a region."""
        self._regions = Regions(tuple(region for region in self._regions if region.name != name))

    def _replace(self, old: str, **changes: Any) -> None:
        self._regions = Regions(
            tuple(replace(region, **changes) if region.name == old else region for region in self._regions)
        )

    # --- what is told about a region -----------------------------------------------------------------------

    def spectrum_of(self, region: Region) -> tuple[Floats, Floats] | str:
        """Return wavelengths [nm] and quantiles of reflectance (5, 50, 95 %; band), or why there are none."""
        key = region.polygon.tobytes()
        if key not in self._spectra:
            self._spectra[key] = self._spectrum(region)
        return self._spectra[key]

    def _spectrum(self, region: Region) -> tuple[Floats, Floats] | str:
        # of this line, whatever the region calls it
        own = Regions((Region(region.name, region.polygon),))
        try:
            made = extract_signatures(self._line, own, exclude=self._exclude, members=0, min_pixels=1)
        except PaintError as error:
            return str(error)
        parts = made["reflectance_quantiles"].sel({schema.QUANTILE: [0.05, 0.5, 0.95]}, method="nearest")
        values = parts.isel({schema.PAINT: 0}).values.astype(np.float64)
        values[:, ~made["good"].values] = np.nan
        return made["wavelength"].values, values

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> Any:
        return self.view._repr_mimebundle_(include, exclude)


def _need_extra() -> None:
    for package in ("panel", "bokeh"):
        try:
            __import__(package)
        except ImportError as error:
            needed = MissingExtraError.of(package, "interactive", "drawing regions with the mouse")
            raise needed from error


def _on_sensor(regions: Any) -> Regions:
    found = Regions(()) if regions is None else regions_from(regions)
    if found.coordinates != "sensor":
        raise SchemaError(
            "regions to begin with are in map coordinates, expected those of the sensor (column and line)"
        )
    if holed := [region.name for region in found if region.holes]:
        raise SchemaError(f"regions with holes cannot be drawn: {', '.join(holed)}; leave them out")
    return found
