"""What `hyperpaint.pictures.picking` shows: a picture to draw on, and the spectra of what is drawn."""

from __future__ import annotations

import html
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from hyperpaint.regions import Region, Regions

__all__ = ["COLOURS", "Drawn", "PickerView"]

COLOURS = ("#e6550d", "#1f9ed1", "#31a354", "#c51b8a", "#a6761d", "#6a51a3", "#d7b600", "#17becf")
"""Of the regions, in turn."""

_HELP = (
    "<b>Draw</b>: click the corners, double-click the last one. "
    "<b>Mend</b>: choose a region, drag its corners. "
    "<b>Zoom</b>: mouse wheel; take the pan tool to move the picture."
)
_PICTURE_HEIGHT, _SPECTRA_HEIGHT = 460, 300


class Drawn(Protocol):
    """What is told what the mouse did, and asked for what came of it; see `hyperpaint.pictures.picking`."""

    @property
    def regions(self) -> Regions: ...  # noqa: D102
    def add(self, along: list[float], across: list[float]) -> str | None: ...  # noqa: D102
    def move(self, name: str, along: list[float], across: list[float]) -> bool: ...  # noqa: D102
    def rename(self, name: str, new: str) -> str | None: ...  # noqa: D102
    def drop(self, name: str) -> None: ...  # noqa: D102
    def spectrum_of(self, region: Region) -> tuple[Any, Any] | str: ...  # noqa: D102


class PickerView:
    """The widget: tells the picker what the mouse did, and shows what came of it.

    Attributes
    ----------
    layout
        A column of panel.
    """

    def __init__(self, picker: Drawn, picture: npt.NDArray[np.float32], shape: tuple[int, int]) -> None:
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
        self._told = panel.pane.HTML("", sizing_mode="stretch_width", align="end")
        self.layout = panel.Column(
            panel.pane.HTML(_HELP, sizing_mode="stretch_width"),
            panel.pane.Bokeh(self._picture(picture, shape), sizing_mode="stretch_width"),
            panel.Row(
                self._chosen, self._name, self._undo, self._remove, self._told, sizing_mode="stretch_width"
            ),
            panel.pane.Bokeh(self._spectra(), sizing_mode="stretch_width"),
            sizing_mode="stretch_width",
        )
        self._corners.on_change("data", self._dragged)
        self._chosen.param.watch(lambda _: self._show(), "value")
        self._name.param.watch(lambda event: self._rename(event.new), "value")
        self._undo.on_click(lambda _: self._draw_draft(-1))
        self._remove.on_click(lambda _: self._drop())
        self._show(picker.regions.names[-1] if len(picker.regions) else None)

    # --- figures -------------------------------------------------------------------------------------------

    def _picture(self, picture: npt.NDArray[np.float32], shape: tuple[int, int]) -> Any:
        from bokeh.events import DoubleTap, Tap
        from bokeh.models import PointDrawTool, Range1d
        from bokeh.plotting import figure

        lines, columns = shape
        # what taps would select is nothing: they draw
        plot = figure(
            name="picture", height=_PICTURE_HEIGHT, sizing_mode="stretch_width",
            tools="pan,wheel_zoom,reset", active_scroll="wheel_zoom",
            x_axis_label="along_track", y_axis_label="cross_track",
            x_range=Range1d(-0.5, lines - 0.5, bounds=(-0.5, lines - 0.5)),
            # the first column on top, as in every other picture
            y_range=Range1d(columns - 0.5, -0.5, bounds=(-0.5, columns - 0.5)),
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
            x_axis_label="wavelength [nm]", y_axis_label="reflectance factor",
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
            self._told.object = "these corners hold no area: click three or more, double-click the last"

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
            self._told.object = html.escape(problem)

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
        regions = self._picker.regions
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
        self._told.object = "<br>".join(map(html.escape, problems)) or count

    def _show_spectra(self, regions: Regions, widths: list[float]) -> list[str]:
        """Show the spectrum of every region; return what is wrong with some."""
        curves: dict[str, list[Any]] = {name: [] for name in self._curves.data}
        shades: dict[str, list[Any]] = {name: [] for name in self._shades.data}
        problems = []
        for number, (region, width) in enumerate(zip(regions, widths, strict=True)):
            found = self._picker.spectrum_of(region)
            if isinstance(found, str):
                problems.append(found)
                continue
            nm, (low, middle, high) = found
            colour, known = _colour(number), np.isfinite(low) & np.isfinite(high)
            _add(curves, nm=nm, reflectance=middle, name=region.name, colour=colour, width=width)
            band = np.concatenate([nm[known], nm[known][::-1]])
            edge = np.concatenate([low[known], high[known][::-1]])
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


def _rgba(picture: npt.NDArray[np.float32]) -> npt.NDArray[np.uint32]:
    """Return a picture (line, column, 3) as bokeh draws it, columns down and lines to the right."""
    made = np.full((*picture.shape[:2], 4), 255, np.uint8)
    made[..., :3] = (picture.clip(0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
    return np.ascontiguousarray(made.swapaxes(0, 1)).view(np.uint32)[..., 0]
