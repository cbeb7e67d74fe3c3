"""Regions drawn by hand on the picture of a flight line, in a notebook (extra ``interactive``)."""

from __future__ import annotations

import html
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from hyperpaint.base import schema
from hyperpaint.base.arrays import Floats, Floats32
from hyperpaint.base.errors import PaintError, SchemaError, needs_extra
from hyperpaint.base.schema import ALONG_TRACK, CROSS_TRACK, Quality
from hyperpaint.paints.signatures import extract_signatures
from hyperpaint.regions import Region, Regions, regions_from, write_regions
from hyperpaint.regions.pixels_in_regions import renumbered

from .orientation import orientation_of
from .plot_flags import background

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["COLOURS", "PickerView", "RegionPicker", "corners_at", "pick_regions"]


def pick_regions(
    line: xr.Dataset,
    regions: Any = None,
    *,
    flightline: str = "",
    lines: int = 2000,
    exclude: Quality | int | None = None,
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
    >>> from hyperpaint.simulation import simulate_line
    >>> line = simulate_line(lines=32, bands=40, columns=24)
    >>> grass = Region("grass", [(0, 0), (0, 31), (0.4, 31), (0.4, 0)])
    >>> picker = pick_regions(line, [grass])  # the last line of a cell shows it   # doctest: +SKIP
    >>> line.paint.signatures(picker.regions).sizes["paint"]                       # doctest: +SKIP
    1
    """
    return RegionPicker(line, regions, flightline, lines, exclude)


def corners_at(along: Sequence[float], across: Sequence[float], shape: tuple[int, int]) -> Floats | None:
    """Return places on the picture as corners of a polygon: whole pixels of the line, no two alike in a row.

    ``along`` and ``across`` are places as they were clicked, ``shape`` lines and columns. Returns (vertex,
    2), x (cross_track) and y (along_track); None where the corners hold no area.

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

    ``view`` is the widget: a layout of panel, which ``panel serve`` shows as well.
    """

    def __init__(
        self, line: xr.Dataset, regions: Any, flightline: str, lines: int, exclude: Quality | int | None
    ) -> None:
        _need_extra()
        # places on the picture are positions; what is given and drawn has the numbers of the line
        self._numbered = schema.rename_to_roles(line)
        self._line = self._numbered.drop_vars((ALONG_TRACK, CROSS_TRACK), errors="ignore")
        self._shape = self._line.sizes[ALONG_TRACK], self._line.sizes[CROSS_TRACK]
        self._exclude = exclude
        self._flightline = flightline
        self._regions = renumbered(_on_sensor(regions), self._numbered, back=True)
        self._spectra: dict[bytes, tuple[Floats, Floats] | str] = {}
        step = max(1, -(-self._shape[0] // max(lines, 1)))
        is_mirrored = orientation_of(self._numbered).is_mirrored
        self._shown = PickerView(self, background(self._line, step), self._shape, is_mirrored=is_mirrored)
        self.view = self._shown.layout

    @property
    def regions(self) -> Regions:
        """What is drawn now, in sensor coordinates: x is cross_track, y along_track, whole pixels."""
        return renumbered(self._regions, self._numbered)

    @property
    def drawn(self) -> Regions:
        """The same in positions on the picture."""
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

    # --- the spectrum of a region ---------------------------------------------------------------------------

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
            library = extract_signatures(self._line, own, exclude=self._exclude, members=0, min_pixels=1)
        except PaintError as error:
            return str(error)
        parts = library["reflectance_quantiles"].sel({schema.QUANTILE: [0.05, 0.5, 0.95]}, method="nearest")
        values = parts.isel({schema.PAINT: 0}).values.astype(np.float64)
        values[:, ~library["good"].values] = np.nan
        return library["wavelength"].values, values

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> Any:
        return self.view._repr_mimebundle_(include, exclude)


def _need_extra() -> None:
    for package in ("panel", "bokeh"):
        with needs_extra(package, "interactive", "drawing regions with the mouse"):
            __import__(package)


def _on_sensor(regions: Any) -> Regions:
    outlines = Regions(()) if regions is None else regions_from(regions)
    if outlines.coordinates != "sensor":
        raise SchemaError(
            "regions to begin with are in map coordinates, expected those of the sensor (column and line)"
        )
    if holed := [region.name for region in outlines if region.holes]:
        raise SchemaError(f"regions with holes cannot be drawn: {', '.join(holed)}; leave them out")
    return outlines


# --- the widget ----------------------------------------------------------------------------------------


COLOURS = ("#e6550d", "#1f9ed1", "#31a354", "#c51b8a", "#a6761d", "#6a51a3", "#d7b600", "#17becf")
"""Of the regions, in turn."""

_HELP = (
    "<b>Draw</b>: click the corners, double-click the last one. "
    "<b>Mend</b>: choose a region, drag its corners. "
    "<b>Zoom</b>: mouse wheel; take the pan tool to move the picture."
)
_PICTURE_HEIGHT, _SPECTRA_HEIGHT = 460, 300


class PickerView:
    """The widget, ``layout``: calls the picker with what the mouse did, and shows the result."""

    def __init__(
        self, picker: RegionPicker, picture: Floats32, shape: tuple[int, int], *, is_mirrored: bool
    ) -> None:
        import panel
        from bokeh.models import ColumnDataSource

        panel.extension()  # loads what a notebook needs; nothing elsewhere
        self._picker = picker
        self._showing = False
        self._outlines = ColumnDataSource({"along": [], "across": [], "name": [], "colour": [], "width": []})
        self._draft = ColumnDataSource({"along": [], "across": []})
        self._corners = ColumnDataSource({"along": [], "across": []})
        self._curves = ColumnDataSource({"nm": [], "reflectance": [], "name": [], "colour": [], "width": []})
        self._shades = ColumnDataSource({"nm": [], "reflectance": [], "colour": []})
        widgets = panel.widgets
        self._chosen = widgets.Select(**_called(widgets.Select, "Region"), options=[], width=200)
        self._name = widgets.TextInput(**_called(widgets.TextInput, "Rename it"), width=200)
        self._undo = widgets.Button(**_called(widgets.Button, "Undo corner"), width=110, align="end")
        self._remove = widgets.Button(**_called(widgets.Button, "Remove region"), width=120, align="end")
        self._message = panel.pane.HTML("", sizing_mode="stretch_width", align="end")
        self.layout = panel.Column(
            panel.pane.HTML(_HELP, sizing_mode="stretch_width"),
            panel.pane.Bokeh(self._picture(picture, shape, is_mirrored), sizing_mode="stretch_width"),
            panel.Row(
                self._chosen, self._name, self._undo, self._remove, self._message, sizing_mode="stretch_width"
            ),
            panel.pane.Bokeh(self._spectra(), sizing_mode="stretch_width"),
            sizing_mode="stretch_width",
        )
        self._corners.on_change("data", self._dragged)
        self._chosen.param.watch(lambda _: self._show(), "value")
        self._name.param.watch(lambda event: self._rename(event.new), "value")
        self._undo.on_click(lambda _: self._draw_draft(-1))
        self._remove.on_click(lambda _: self._drop())
        self._show(picker.drawn.names[-1] if len(picker.drawn) else None)

    # --- figures -------------------------------------------------------------------------------------------

    def _picture(self, picture: Floats32, shape: tuple[int, int], is_mirrored: bool) -> Any:
        from bokeh.events import DoubleTap, Tap
        from bokeh.models import PointDrawTool, Range1d
        from bokeh.plotting import figure

        lines, columns = shape
        edges = (-0.5, columns - 0.5)
        # what taps would select is nothing: they draw
        plot = figure(
            name="picture", height=_PICTURE_HEIGHT, sizing_mode="stretch_width",
            tools="pan,wheel_zoom,reset", active_scroll="wheel_zoom",
            x_axis_label="along_track [line], flown to the right", y_axis_label="cross_track [column]",
            x_range=Range1d(-0.5, lines - 0.5, bounds=(-0.5, lines - 0.5)),
            # flown to the right, the columns to the right of the flight are the lower ones
            y_range=Range1d(*(edges if is_mirrored else edges[::-1]), bounds=edges),
        )  # fmt: skip
        plot.image_rgba([_rgba(picture)], x=-0.5, y=-0.5, dw=lines, dh=columns, level="image")
        plot.patches(
            "along", "across", source=self._outlines, fill_color="colour", line_color="colour",
            fill_alpha=0.25, line_width="width",
        )  # fmt: skip
        plot.line("along", "across", source=self._draft, line_color="white", line_width=2, line_dash="dashed")
        plot.scatter("along", "across", source=self._draft, size=7, fill_color="white", line_color="black")
        handles = plot.scatter(
            "along", "across", source=self._corners, size=9, fill_color="white", line_color="black"
        )
        drag = PointDrawTool(renderers=[handles], add=False, empty_value=0)
        plot.add_tools(drag)
        plot.toolbar.active_drag = drag
        plot.toolbar.logo = None
        plot.grid.visible = False
        plot.on_event(Tap, lambda event: self.tap(event.x, event.y))
        plot.on_event(DoubleTap, lambda event: self.close(event.x, event.y))
        return plot

    def _spectra(self) -> Any:
        from bokeh.models import HoverTool
        from bokeh.plotting import figure

        plot = figure(
            name="spectra", height=_SPECTRA_HEIGHT, sizing_mode="stretch_width", tools="pan,box_zoom,reset",
            x_axis_label="wavelength [nm]", y_axis_label="reflectance factor [1]",
            title="median, 5 to 95 % of the pixels",
        )  # fmt: skip
        plot.patches("nm", "reflectance", source=self._shades, color="colour", alpha=0.15, line_alpha=0.0)
        curves = plot.multi_line(
            "nm", "reflectance", source=self._curves, line_color="colour", line_width="width"
        )
        plot.add_tools(HoverTool(renderers=[curves], tooltips=[("", "@name")]))
        plot.toolbar.logo = None
        return plot

    # --- what the mouse did --------------------------------------------------------------------------------

    def tap(self, along: float, across: float) -> None:
        """Add a corner to the polygon that is being drawn."""
        self._draw_draft(None, (along, across))

    def close(self, along: float, across: float) -> None:
        """End the polygon that is being drawn with a last corner: it becomes a region."""
        self.tap(along, across)
        draft = self._draft.data
        name = self._picker.add(draft["along"], draft["across"])
        self._draft.data = {"along": [], "across": []}
        self._show(name)
        if name is None:
            self._message.object = "these corners hold no area: click three or more, double-click the last"

    def _draw_draft(self, stop: int | None, *more: tuple[float, float]) -> None:
        draft = self._draft.data
        self._draft.data = {
            name: [*draft[name][:stop], *(corner[axis] for corner in more)]
            for axis, name in enumerate(("along", "across"))
        }

    def _dragged(self, attr: str, old: Any, new: Any) -> None:  # noqa: ARG002 (bokeh asks for these names)
        name = self._chosen.value
        if not self._showing and name is not None:
            self._picker.move(name, list(new["along"]), list(new["across"]))
            self._show()

    def _rename(self, new: str) -> None:
        name = self._chosen.value
        if self._showing or name is None or new == name:
            return
        problem = self._picker.rename(name, new)
        self._show(new.strip() if problem is None else name)
        if problem is not None:
            self._message.object = html.escape(problem)

    def _drop(self) -> None:
        if self._chosen.value is not None:
            self._picker.drop(self._chosen.value)
            self._show()

    # --- what is shown -------------------------------------------------------------------------------------

    def _show(self, name: str | None = None) -> None:
        """Show all regions and their spectra, one of them in bold with its corners to be dragged."""
        if self._showing:
            return
        self._showing = True
        try:
            self._show_all(name)
        finally:
            self._showing = False

    def _show_all(self, name: str | None) -> None:
        regions = self._picker.drawn
        wanted = name or self._chosen.value
        chosen = wanted if wanted in regions.names else regions.names[-1] if len(regions) else None
        self._chosen.options = list(regions.names)
        self._chosen.value = chosen
        self._name.value = chosen or ""
        widths = [3 if region.name == chosen else 1.5 for region in regions]
        self._outlines.data = {
            "along": [region.polygon[:, 1].tolist() for region in regions],
            "across": [region.polygon[:, 0].tolist() for region in regions],
            "name": list(regions.names),
            "colour": [_colour(number) for number in range(len(regions))],
            "width": widths,
        }
        own = [region.polygon for region in regions if region.name == chosen]
        self._corners.data = {
            "along": own[0][:, 1].tolist() if own else [],
            "across": own[0][:, 0].tolist() if own else [],
        }
        problems = self._show_spectra(regions, widths)
        count = f"{len(regions)} region{'' if len(regions) == 1 else 's'}"
        self._message.object = "<br>".join(map(html.escape, problems)) or count

    def _show_spectra(self, regions: Regions, widths: list[float]) -> list[str]:
        """Show the spectrum of every region; return what is wrong with some."""
        curves: dict[str, list[Any]] = {name: [] for name in self._curves.data}
        shades: dict[str, list[Any]] = {name: [] for name in self._shades.data}
        problems = []
        for number, (region, width) in enumerate(zip(regions, widths, strict=True)):
            spectrum = self._picker.spectrum_of(region)
            if isinstance(spectrum, str):
                problems.append(spectrum)
                continue
            nm, (low, middle, high) = spectrum
            colour, is_finite = _colour(number), np.isfinite(low) & np.isfinite(high)
            _add(curves, nm=nm, reflectance=middle, name=region.name, colour=colour, width=width)
            band = np.concatenate([nm[is_finite], nm[is_finite][::-1]])
            edge = np.concatenate([low[is_finite], high[is_finite][::-1]])
            _add(shades, nm=band, reflectance=edge, colour=colour)
        self._curves.data, self._shades.data = curves, shades
        return problems


def _add(columns: dict[str, list[Any]], **row: Any) -> None:
    for name, value in row.items():
        columns[name].append(value)


def _called(widget: Any, text: str) -> dict[str, str]:
    """Return the argument that writes a text on a widget: panel is renaming it."""
    return {"label" if "label" in widget.param else "name": text}


def _colour(number: int) -> str:
    return COLOURS[number % len(COLOURS)]


def _rgba(picture: Floats32) -> npt.NDArray[np.uint32]:
    """Return a picture (line, column, 3) as bokeh draws it, columns as rows and lines to the right."""
    pixels = np.full((*picture.shape[:2], 4), 255, np.uint8)
    pixels[..., :3] = (picture.clip(0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
    return np.ascontiguousarray(pixels.swapaxes(0, 1)).view(np.uint32)[..., 0]
