"""Figures of the explorer in bokeh, with their data sources."""

from __future__ import annotations

from typing import Any

import numpy as np

from hyperpaint.base.arrays import Array

from .explorer_state import Explored, Picture

# colours of the regions, in turn
COLOURS = ("#e6550d", "#1f9ed1", "#31a354", "#c51b8a", "#a6761d", "#6a51a3", "#d7b600", "#17becf")
INK = {"light": "#1a1a1a", "dark": "#f2f2f2"}  # text colour of each theme
NEAR_COLOUR = "#8c8c8c"
DASHES = ("dashed", "dotted", "dotdash", "dashdot", "solid")
PICTURE_HEIGHT, NAVIGATOR_HEIGHT, SPECTRA_HEIGHT = 380, 60, 330

# reports the lines in view 120 ms after the last change
_WATCH = """
const timers = (window.hyperpaint_timers = window.hyperpaint_timers || {});
clearTimeout(timers[plot.id]);
timers[plot.id] = setTimeout(() => {
  view.data = {along: [plot.x_range.start, plot.x_range.end], size: [plot.inner_width, plot.inner_height]};
}, 120);
"""


def empty_source(*names: str) -> Any:
    """Return a bokeh data source with empty columns."""
    from bokeh.models import ColumnDataSource

    return ColumnDataSource({name: [] for name in names})


class PictureFigure:
    """The picture of a flight line, flown to the right, and a small picture of the complete line below.

    ``view`` holds the first and last line in view, and the size of the figure [pixel].
    """

    def __init__(self, state: Explored, theme: str) -> None:
        from bokeh.models import BoxSelectTool, CustomJS, PanTool, PointDrawTool, Range1d
        from bokeh.plotting import figure

        self.base, self.detail, self.flags = (empty_source("image", "x", "y", "dw", "dh") for _ in range(3))
        self.outlines = empty_source("along", "across", "name", "colour", "width")
        self.draft, self.corners, self.spot = (empty_source("along", "across") for _ in range(3))
        self.view = empty_source("along", "size")
        self._lines, columns = state.shape
        edges = (-0.5, columns - 0.5)
        # the flight is to the right, so that columns on its right side are below
        self._edges = edges if state.orientation.is_mirrored else edges[::-1]
        self.plot = plot = figure(
            name="picture",
            height=PICTURE_HEIGHT,
            sizing_mode="stretch_width",
            tools="wheel_zoom,reset",
            active_scroll="wheel_zoom",
            x_axis_label="line, flown to the right",
            y_axis_label="column",
            x_range=Range1d(-0.5, min(self._lines, 2 * columns) - 0.5),
            y_range=Range1d(*self._edges),
        )
        for pictures in (self.base, self.detail, self.flags):
            plot.image_rgba("image", "x", "y", "dw", "dh", source=pictures, level="image")
        plot.patches(
            "along",
            "across",
            source=self.outlines,
            fill_color="colour",
            line_color="colour",
            fill_alpha=0.2,
            line_width="width",
        )
        for colour, width in (("black", 4), ("white", 2)):
            plot.line("along", "across", source=self.draft, line_color=colour, line_width=width)
            plot.line("along", "across", source=self.spot, line_color=colour, line_width=width)
        plot.scatter("along", "across", source=self.draft, size=7, fill_color="white", line_color="black")
        handles = plot.scatter(
            "along", "across", source=self.corners, size=10, fill_color="white", line_color="black"
        )
        box = BoxSelectTool(renderers=[], visible=False)
        corners = PointDrawTool(renderers=[handles], add=False, empty_value=0, visible=False)
        pan = PanTool(visible=False)
        plot.add_tools(box, corners, pan)
        self._tools = {"spectrum": box, "draw": pan, "edit": corners, "move": pan}
        self.take_mode("spectrum")
        _set_style(plot, theme)
        plot.grid.visible = False
        watch = CustomJS(args={"plot": plot, "view": self.view}, code=_WATCH)
        for name in ("start", "end"):
            plot.x_range.js_on_change(name, watch)
        plot.js_on_change("inner_width", watch)

    def take_mode(self, mode: str) -> None:
        """Set the effect of dragging on the picture: select, edit or move."""
        self.plot.toolbar.active_drag = self._tools[mode]

    def navigator(self) -> Any:
        """Return a figure of the complete line with a draggable frame around the lines in view."""
        from bokeh.models import Range1d, RangeTool
        from bokeh.plotting import figure

        plot = figure(
            name="navigator",
            height=NAVIGATOR_HEIGHT,
            sizing_mode="stretch_width",
            tools="",
            x_range=Range1d(-0.5, self._lines - 0.5),
            y_range=Range1d(*self._edges),
            toolbar_location=None,
        )
        plot.image_rgba("image", "x", "y", "dw", "dh", source=self.base, level="image")
        plot.axis.visible = plot.grid.visible = False
        plot.min_border = 0
        tool = RangeTool(x_range=self.plot.x_range)
        tool.overlay.update(fill_color="white", fill_alpha=0.3, line_color="white", line_width=2)
        plot.add_tools(tool)
        plot.outline_line_color = plot.border_fill_color = plot.background_fill_color = None
        return plot

    def show_lines(self, first: float, last: float) -> None:
        """Bring lines ``first`` to ``last`` into view."""
        self.plot.x_range.update(start=first, end=last)

    def mark(self, corners: Array) -> None:
        """Outline the last click by its corners (vertex, 2), x across and y along the track."""
        outline = np.vstack([corners, corners[:1]])
        self.spot.data = {"along": outline[:, 1].tolist(), "across": outline[:, 0].tolist()}


class SpectraFigure:
    """Curves of reflectance, the spread over pixels of regions, and the uncertainty of a curve."""

    def __init__(self, theme: str) -> None:
        from bokeh.models import HoverTool, Span
        from bokeh.plotting import figure

        self.curves = empty_source("nm", "reflectance", "name", "colour", "width", "dash")
        self.spreads, self.uncertainty = (empty_source("nm", "reflectance", "colour") for _ in range(2))
        self.plot = plot = figure(
            name="spectra",
            height=SPECTRA_HEIGHT,
            sizing_mode="stretch_width",
            tools="pan,box_zoom,reset",
            x_axis_label="wavelength [nm]",
            y_axis_label="reflectance factor [1]",
        )
        for shades, alpha in ((self.spreads, 0.12), (self.uncertainty, 0.35)):
            plot.patches(
                "nm", "reflectance", source=shades, fill_color="colour", fill_alpha=alpha, line_alpha=0.0
            )
        curves = plot.multi_line(
            "nm", "reflectance", source=self.curves, line_color="colour", line_width="width", line_dash="dash"
        )
        self._band = Span(dimension="height", line_color=NEAR_COLOUR, line_dash="dotted", visible=False)
        plot.add_layout(self._band)
        tips = [("", "@name"), ("nm", "$x{0.0}"), ("reflectance", "$y{0.000}")]
        plot.add_tools(HoverTool(renderers=[curves], tooltips=tips))
        _set_style(plot, theme)

    def mark(self, wavelength: float | None) -> None:
        """Mark the wavelength [nm] of the band shown in the picture."""
        self._band.update(visible=wavelength is not None, location=wavelength or 0.0)


def show_picture(source: Any, picture: Picture | None) -> None:
    """Put a picture into a data source; None empties the source."""
    names = ("image", "x", "y", "dw", "dh")
    if picture is None:
        source.data = {name: [] for name in names}
        return
    columns, lines = picture.rgba.shape[0], picture.last - picture.first
    values = (picture.rgba, picture.first - 0.5, -0.5, lines, columns)
    source.data = {name: [value] for name, value in zip(names, values, strict=True)}


def band_around(wavelength: Array, lower: Array, upper: Array) -> dict[str, Array]:
    """Return the outline of the area between two curves, over wavelengths where both are finite."""
    is_finite = np.isfinite(lower) & np.isfinite(upper)
    nm = wavelength[is_finite]
    outline = np.concatenate([lower[is_finite], upper[is_finite][::-1]])
    return {"nm": np.concatenate([nm, nm[::-1]]), "reflectance": outline}


def _set_style(plot: Any, theme: str) -> None:
    plot.toolbar.logo = None
    plot.border_fill_color = plot.background_fill_color = plot.outline_line_color = None
    colour = INK[theme]
    plot.axis.axis_label_text_color = plot.axis.major_label_text_color = colour
    plot.axis.axis_line_color = plot.axis.major_tick_line_color = plot.axis.minor_tick_line_color = colour
    plot.grid.grid_line_color = NEAR_COLOUR
    plot.grid.grid_line_alpha = 0.3
