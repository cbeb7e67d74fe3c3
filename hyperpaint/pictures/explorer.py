"""Figures of the explorer in bokeh, with their data sources."""

from __future__ import annotations

import html
import os
from pathlib import Path
from typing import Any

import numpy as np

from hyperpaint.base.arrays import Array
from hyperpaint.base.errors import PaintError
from hyperpaint.regions import Region, Regions
from hyperpaint.regions.pixels_in_regions import contains

from .explorer_state import INFRARED, TRUE_COLOUR, Explored, NearPaint, Picture, Place, Spectrum
from .plot import flag_label, percent

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


_IMAGE, _PLACES = ("image", "x", "y", "dw", "dh"), ("along", "across")
#: Data sources of the figures, with their columns.
_SOURCES = {
    # pictures of the complete line, of the lines in view, and of their flags
    **dict.fromkeys(("base", "detail", "flags"), _IMAGE),
    # regions, the polygon in progress, handles of the selected region, and the last click
    "outlines": (*_PLACES, "name", "colour", "width"),
    **dict.fromkeys(("draft", "corners", "spot"), _PLACES),
    "view": ("along", "size"),  # first and last line in view, and the size of the figure [pixel]
    "curves": ("nm", "reflectance", "name", "colour", "width", "dash"),
    # spread over the pixels of regions, and uncertainty of a curve
    **dict.fromkeys(("spreads", "uncertainty"), ("nm", "reflectance", "colour")),
}


def band_around(wavelength: Array, lower: Array, upper: Array) -> dict[str, Array]:
    # Return the outline of the area between two curves, over wavelengths where both are finite
    is_finite = np.isfinite(lower) & np.isfinite(upper)
    nm = wavelength[is_finite]
    outline = np.concatenate([lower[is_finite], upper[is_finite][::-1]])
    return {"nm": np.concatenate([nm, nm[::-1]]), "reflectance": outline}


# --- the widget, made with panel and bokeh (extra ``interactive``) ------------------------------------------


_MODES = {"Spectrum": "spectrum", "Draw": "draw", "Edit": "edit", "Move": "move"}
_HELP = {
    "spectrum": "Click for the spectrum of a pixel, drag for the median of a box; the wheel zooms",
    "draw": "Click the corners of a region, double-click the last one",
    "edit": "Click a region to select it, drag its corners",
    "move": "Drag to move the picture; the wheel or two fingers zoom",
}
_RECIPES = {"true colour": TRUE_COLOUR, "colour infrared": INFRARED}
_ONE_BAND = "one band"
_UNIT_SQUARE = ((0, 0), (1, 0), (1, 1), (0, 1))
FULL_WIDTH = {"sizing_mode": "stretch_width"}


class Explorer:
    """A widget that shows a flight line; see `explore`.

    ``view`` is the panel layout, which ``panel serve`` can show. With ``save_to`` regions are saved only to
    this file.
    """

    def __init__(self, state: Explored, *, theme: str = "light", save_to: Path | None = None) -> None:
        import panel
        from bokeh.models import ColumnDataSource

        panel.extension()  # loads scripts into a notebook
        self._state, self._theme, self._save_to = state, theme, save_to
        self._is_updating = False
        self._window: tuple[int, int] | None = None
        self._sources = {
            name: ColumnDataSource({column: [] for column in columns}) for name, columns in _SOURCES.items()
        }
        # the last clicked pixel or box, or the name of the selected region; at first the central column
        lines, columns = state.shape
        self._selected: Place | str | None = (min(lines, columns) // 2, columns // 2)
        self._make_picture()
        self._make_spectra()
        self._make_widgets()
        self._connect()
        self._update_pictures()
        self._select(state.drawn.names[-1] if len(state.drawn) else None)

    @property
    def regions(self) -> Regions:
        """Regions drawn, in sensor coordinates: x is cross_track, y is along_track, whole pixels."""
        return self._state.regions

    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
        """Write the regions as GeoJSON; see `hyperpaint.write_regions`."""
        return self._state.save(path, overwrite=overwrite)

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> Any:
        return self.view._repr_mimebundle_(include, exclude)

    # --- figures ------------------------------------------------------------------------------------------

    def _make_picture(self) -> None:
        # the picture of the line, flown to the right, and a small picture of the complete line below
        from bokeh.models import BoxSelectTool, CustomJS, PanTool, PointDrawTool, Range1d, RangeTool
        from bokeh.plotting import figure

        sources, (lines, columns) = self._sources, self._state.shape
        # the flight is to the right, so that columns on its right side are below
        edges = (-0.5, columns - 0.5)[:: 1 if self._state.orientation.is_mirrored else -1]
        self._plot = plot = figure(
            name="picture",
            height=PICTURE_HEIGHT,
            tools="wheel_zoom,reset",
            active_scroll="wheel_zoom",
            x_axis_label="line, flown to the right",
            y_axis_label="column",
            x_range=Range1d(-0.5, min(lines, 2 * columns) - 0.5),
            y_range=Range1d(*edges),
            **FULL_WIDTH,
        )
        for name in ("base", "detail", "flags"):
            plot.image_rgba(*_IMAGE, source=sources[name], level="image")
        plot.patches(
            *_PLACES,
            source=sources["outlines"],
            fill_color="colour",
            line_color="colour",
            fill_alpha=0.2,
            line_width="width",
        )
        for colour, width in (("black", 4), ("white", 2)):
            for name in ("draft", "spot"):
                plot.line(*_PLACES, source=sources[name], line_color=colour, line_width=width)
        style = {"fill_color": "white", "line_color": "black"}
        plot.scatter(*_PLACES, source=sources["draft"], size=7, **style)
        handles = plot.scatter(*_PLACES, source=sources["corners"], size=10, **style)
        # effects of dragging on the picture: select, edit or move
        pan = PanTool(visible=False)
        self._tools = {
            "spectrum": BoxSelectTool(renderers=[], visible=False),
            "draw": pan,
            "edit": PointDrawTool(renderers=[handles], add=False, empty_value=0, visible=False),
            "move": pan,
        }
        plot.add_tools(*dict.fromkeys(self._tools.values()))
        plot.toolbar.active_drag = self._tools["spectrum"]
        self._set_style(plot)
        plot.grid.visible = False
        watch = CustomJS(args={"plot": plot, "view": sources["view"]}, code=_WATCH)
        for name in ("start", "end"):
            plot.x_range.js_on_change(name, watch)
        plot.js_on_change("inner_width", watch)
        # the complete line, with a draggable frame around the lines in view
        self._navigator = small = figure(
            name="navigator",
            height=NAVIGATOR_HEIGHT,
            tools="",
            x_range=Range1d(-0.5, lines - 0.5),
            y_range=Range1d(*edges),
            toolbar_location=None,
            **FULL_WIDTH,
        )
        small.image_rgba(*_IMAGE, source=sources["base"], level="image")
        small.axis.visible = small.grid.visible = False
        small.min_border = 0
        tool = RangeTool(x_range=plot.x_range)
        tool.overlay.update(fill_color="white", fill_alpha=0.3, line_color="white", line_width=2)
        small.add_tools(tool)
        small.outline_line_color = small.border_fill_color = small.background_fill_color = None

    def _make_spectra(self) -> None:
        # curves of reflectance, the spread over pixels of regions, and the uncertainty of a curve
        from bokeh.models import HoverTool, Span
        from bokeh.plotting import figure

        self._spectra = plot = figure(
            name="spectra",
            height=SPECTRA_HEIGHT,
            tools="pan,box_zoom,reset",
            x_axis_label="wavelength [nm]",
            y_axis_label="reflectance factor [1]",
            **FULL_WIDTH,
        )
        axes = ("nm", "reflectance")
        for name, alpha in (("spreads", 0.12), ("uncertainty", 0.35)):
            plot.patches(
                *axes, source=self._sources[name], fill_color="colour", fill_alpha=alpha, line_alpha=0.0
            )
        style = {"line_color": "colour", "line_width": "width", "line_dash": "dash"}
        curves = plot.multi_line(*axes, source=self._sources["curves"], **style)
        # the wavelength of the band shown in the picture
        self._shown_band = Span(dimension="height", line_color=NEAR_COLOUR, line_dash="dotted", visible=False)
        plot.add_layout(self._shown_band)
        tips = [("", "@name"), ("nm", "$x{0.0}"), ("reflectance", "$y{0.000}")]
        plot.add_tools(HoverTool(renderers=[curves], tooltips=tips))
        self._set_style(plot)

    def _set_style(self, plot: Any) -> None:
        plot.toolbar.logo = None
        plot.border_fill_color = plot.background_fill_color = plot.outline_line_color = None
        for part in (
            "axis_label_text",
            "major_label_text",
            "axis_line",
            "major_tick_line",
            "minor_tick_line",
        ):
            setattr(plot.axis, f"{part}_color", INK[self._theme])
        plot.grid.grid_line_color, plot.grid.grid_line_alpha = NEAR_COLOUR, 0.3

    # --- widgets and layout -------------------------------------------------------------------------------

    def _make_widgets(self) -> None:
        import panel

        def make(kind: str, text: str, **options: Any) -> Any:
            widget = getattr(panel.widgets, kind)
            # panel is renaming the argument
            return widget(**{"label" if "label" in widget.param else "name": text}, **options, **FULL_WIDTH)

        state = self._state
        bands = sorted(set(np.round(state.wavelength[np.isfinite(state.wavelength)], 1).tolist()))
        recipes = [name for name, recipe in _RECIPES.items() if state.has_bands(recipe)]
        flags = {f"{flag_label(flag)}, {percent(share)}": flag for flag, share in state.flag_shares.items()}
        self._mode = make("RadioButtonGroup", "", options=_MODES, value="spectrum")
        self._recipe = make("Select", "Colours", options=[*recipes, _ONE_BAND])
        self._band = make(
            "DiscreteSlider",
            "Band [nm]",
            options=bands,
            value=_nearest_option(bands, 650.0),
            formatter="%.1f",
        )
        self._stretch = make("RangeSlider", "Black and white [percentile]", start=0, end=100, value=(2, 98))
        self._flag_boxes = make("CheckBoxGroup", "", options=flags)
        self._region_menu = make("Select", "Region", options=[])
        self._name = make("TextInput", "Name")
        self._box_button = make("Button", "Box to region", disabled=True)
        self._undo_button = make("Button", "Undo corner", disabled=True)
        self._remove_button = make("Button", "Remove")
        file = "regions.geojson" if self._save_to is None else str(self._save_to)
        self._file = make("TextInput", "File", value=file, disabled=self._save_to is not None)
        self._save_button = make("Button", "Save regions")
        self._paint_boxes = make("CheckBoxGroup", "", options={})
        self._spectrum_pane, self._message_pane, self._caption_pane = (
            panel.pane.HTML("", **FULL_WIDTH) for _ in range(3)
        )

        # layout of the widgets
        def pane(figure: Any) -> Any:
            return panel.pane.Bokeh(figure, **FULL_WIDTH)

        def column(flex: str, *parts: Any) -> Any:
            return panel.Column(*parts, styles={"flex": flex, "min-width": "0"}, **FULL_WIDTH)

        def card(title: str, *parts: Any) -> Any:
            return column("1 1 230px", panel.pane.HTML(f"<b>{title}</b>", **FULL_WIDTH), *parts)

        lines, columns = state.shape
        navigator = [pane(self._navigator)] if lines > 3 * columns else []
        flag_card = (
            self._flag_boxes if state.flag_shares else panel.pane.HTML("no flags stored", **FULL_WIDTH)
        )
        heading = panel.pane.HTML("<b>Nearest paints</b>: spectral angle, and scale factor", **FULL_WIDTH)
        buttons = panel.Row(self._box_button, self._undo_button, self._remove_button, **FULL_WIDTH)
        self.view = panel.Column(
            panel.FlexBox(
                column("3 1 340px", self._mode, pane(self._plot), *navigator, self._caption_pane),
                column("2 1 320px", self._spectrum_pane, pane(self._spectra), heading, self._paint_boxes),
                **FULL_WIDTH,
            ),
            panel.FlexBox(
                card("Picture", self._recipe, self._band, self._stretch),
                card("Flags", flag_card),
                card("Regions", self._region_menu, self._name, buttons),
                card("Save", self._file, self._save_button, self._message_pane),
                **FULL_WIDTH,
            ),
            **FULL_WIDTH,
        )

    def _connect(self) -> None:
        from bokeh.events import DoubleTap, SelectionGeometry, Tap

        plot = self._plot
        plot.on_event(Tap, lambda event: self.tap(event.x, event.y))
        plot.on_event(DoubleTap, lambda event: self.close(event.x, event.y))
        plot.on_event(SelectionGeometry, lambda event: self.drag(event.geometry) if event.final else None)
        self._spectra.on_event(Tap, lambda event: self.take_band(event.x))
        self._sources["corners"].on_change("data", self._corners_changed)
        self._sources["view"].on_change("data", self._view_changed)
        calls = (
            (self._mode, "value", lambda _: self._change_mode()),
            (self._recipe, "value", lambda _: self._update_pictures()),
            (self._stretch, "value_throttled", lambda _: self._update_pictures()),
            (self._band, "value_throttled", lambda event: self.take_band(event.new)),
            (self._flag_boxes, "value", lambda _: self._update_flags()),
            (self._region_menu, "value", lambda event: self._select(event.new)),
            (self._name, "value", lambda event: self._rename(event.new)),
            (self._paint_boxes, "value", lambda _: self._update_spectra()),
        )
        for widget, name, call in calls:
            widget.param.watch(self._unless_updating(call), name)
        clicks = (
            (self._box_button, self._box_to_region),
            (self._undo_button, lambda: self._change_draft(-1)),
            (self._remove_button, self._remove_region),
            (self._save_button, self._write_regions),
        )
        for button, press in clicks:
            button.on_click(self._unless_updating(lambda _, press=press: press()))

    def _unless_updating(self, call: Any) -> Any:
        # ignores events of widgets that this class is setting
        import panel

        def run(event: Any) -> None:
            if not self._is_updating:
                # panel runs the call when it holds the lock of the figures' document
                panel.state.execute(lambda: call(event), schedule=True)

        return run

    # --- events of the mouse -------------------------------------------------------------------------------

    def tap(self, along: float, across: float) -> None:
        """Handle a click on the picture: select a pixel, add a corner, or select a region to edit."""
        pixel = int(np.floor(along + 0.5)), int(np.floor(across + 0.5))
        mode = self._mode.value
        if mode == "draw":
            self._change_draft(None, (along, across))
        elif mode == "edit":
            spot = np.array([across]), np.array([along])
            names = [region.name for region in self._state.drawn if contains(region.polygon, (), *spot)[0]]
            self._select(names[-1] if names else self._region_menu.value)
        elif all(0 <= number < size for number, size in zip(pixel, self._state.shape, strict=True)):
            self._select_place(pixel)

    def drag(self, geometry: dict[str, Any]) -> None:
        """Show the median spectrum of a box dragged over the picture."""
        if self._mode.value != "spectrum" or geometry.get("type") != "rect":
            return
        ranges = []
        for axis, size in zip("xy", self._state.shape, strict=True):
            minimum, maximum = sorted((geometry[f"{axis}0"], geometry[f"{axis}1"]))
            ranges.append((max(0, int(np.ceil(minimum))), min(size - 1, int(np.floor(maximum)))))
        along, across = ranges
        if along[0] > along[1] or across[0] > across[1]:
            return
        # extend the box by a quarter of a pixel, so that a box of one line contains its pixel centres
        corners = [(across[a] + a / 2 - 0.25, along[b] + b / 2 - 0.25) for a, b in _UNIT_SQUARE]
        self._select_place(Region("box", np.array(corners)))

    def close(self, along: float, across: float) -> None:
        """Add the last corner of the polygon in progress, and make it a region."""
        if self._mode.value == "draw":
            self.tap(along, across)
            draft = self._sources["draft"].data
            # the polygon is not finished while its corners enclose no area
            if self._add_region(draft["along"], draft["across"]):
                self._clear_draft()

    def take_band(self, wavelength: float) -> None:
        """Show the band nearest to a wavelength [nm]."""
        self._is_updating = True
        self._band.value = _nearest_option(self._band.options, wavelength)
        self._recipe.value = _ONE_BAND
        self._is_updating = False
        self._update_pictures()

    def _select_place(self, clicked: Place) -> None:
        self._selected = clicked
        self._select(None)

    def _box_to_region(self) -> None:
        if isinstance(self._selected, Region):
            across, along = self._selected.polygon.T.tolist()
            self._add_region(along, across)

    def _add_region(self, along: list[float], across: list[float]) -> bool:
        name = self._state.add(along, across)
        self._select(name or self._region_menu.value)
        if name is None:
            self._show_message(
                "these corners enclose no area: a region needs three corners that are not on a line"
            )
        return name is not None

    def _change_draft(self, stop: int | None, *new_corners: tuple[float, float]) -> None:
        draft = self._sources["draft"].data
        self._sources["draft"].data = {
            name: [*draft[name][:stop], *(corner[axis] for corner in new_corners)]
            for axis, name in enumerate(("along", "across"))
        }
        self._undo_button.disabled = not self._sources["draft"].data["along"]

    def _clear_draft(self) -> None:
        self._sources["draft"].data = {"along": [], "across": []}
        self._undo_button.disabled = True

    def _change_mode(self) -> None:
        self._plot.toolbar.active_drag = self._tools[self._mode.value]
        self._clear_draft()
        self._update_caption()
        self._select(self._region_menu.value)

    def _corners_changed(self, attr: str, old: Any, new: Any) -> None:  # noqa: ARG002 (bokeh asks for these names)
        name = self._region_menu.value
        if not self._is_updating and name is not None:
            self._state.move(name, list(new["along"]), list(new["across"]))
            self._select(name)

    def _rename(self, new: str) -> None:
        name = self._region_menu.value
        if name is not None and new != name:
            problem = self._state.rename(name, new)
            self._select(new.strip() if problem is None else name)
            self._show_message(problem or self._region_count())

    def _remove_region(self) -> None:
        if self._region_menu.value is not None:
            self._state.drop(self._region_menu.value)
            self._select(None)

    def _write_regions(self) -> None:
        file = self._save_to or Path(self._file.value)
        try:
            saved_file = self._state.save_again(file)
        except PaintError as error:
            self._show_message(error.text(on_command_line=self._save_to is not None))
            return
        except OSError as error:
            self._show_message(str(error))
            return
        self._show_message(f"{self._region_count()} saved in {saved_file}")

    def _view_changed(self, attr: str, old: Any, new: Any) -> None:  # noqa: ARG002
        (first, last), (width, height) = new["along"], new["size"]
        if self._window is None and width and height:
            # the size of the picture is new: show as many lines as give pixels their aspect ratio on the
            # ground
            lines, columns = self._state.shape
            visible_lines = columns * width / height / self._state.orientation.aspect
            first = -0.5 - max(0.0, visible_lines - lines) / 2
            last = first + visible_lines
            self._plot.x_range.update(start=first, end=last)
        window = int(np.floor(first)), int(np.ceil(last)) + 1
        if window != self._window:
            self._window = window
            self._update_pictures(base=False)

    # --- display ----------------------------------------------------------------------------------------

    def _show_message(self, text: str) -> None:
        self._message_pane.object = html.escape(text)

    def _region_count(self) -> str:
        count = len(self._state.drawn)
        other_count = len(self._state.others)
        return f"{count} region{'' if count == 1 else 's'}" + f" (and {other_count} of other lines)" * bool(
            other_count
        )

    def _update_pictures(self, *, base: bool = True) -> None:
        # update the lines in view; with ``base`` also the picture of the complete line behind them
        recipe = _RECIPES.get(self._recipe.value) or ()
        if self._recipe.value == _ONE_BAND:
            recipe = (self._band.value,)
        try:
            if base:
                self._show_picture("base", self._state.picture(recipe, self._stretch.value))
            detail = self._state.picture(recipe, self._stretch.value, self._window)
        except PaintError as error:
            self._caption_pane.object = html.escape(str(error))
            return
        self._show_picture("detail", detail)
        self._caption = f"{recipe[0]:.1f} nm" if self._recipe.value == _ONE_BAND else self._recipe.value
        self._caption += f", lines {detail.first} to {detail.last - 1}" + f", {detail.text}" * bool(
            detail.text
        )
        self._update_caption()
        self._update_flags()
        is_one_band = len(recipe) == 1
        self._shown_band.update(visible=is_one_band, location=recipe[0] if is_one_band else 0.0)

    def _show_picture(self, name: str, picture: Picture | None) -> None:
        # put a picture into a data source; None empties the source
        values: list[Any] = []
        if picture is not None:
            columns, lines = picture.rgba.shape[0], picture.last - picture.first
            values = [picture.rgba, picture.first - 0.5, -0.5, lines, columns]
        self._sources[name].data = {column: values[at : at + 1] for at, column in enumerate(_IMAGE)}

    def _show_rows(self, name: str, rows: list[dict[str, Any]]) -> None:
        self._sources[name].data = {column: [row[column] for row in rows] for column in _SOURCES[name]}

    def _update_caption(self) -> None:
        self._caption_pane.object = (
            f"{html.escape(_HELP[self._mode.value])}.<br><small>{self._caption}</small>"
        )

    def _update_flags(self) -> None:
        flags = self._flag_boxes.value
        self._show_picture("flags", self._state.flag_picture(flags, self._window) if flags else None)

    def _select(self, name: str | None) -> None:
        # select a region, which is drawn bold, with handles in edit mode; None selects no region
        regions = self._state.drawn
        selected_name = name if name in regions.names else None
        if selected_name is not None or isinstance(self._selected, str):
            self._selected = selected_name
        edited = [
            region.polygon
            for region in regions
            if region.name == selected_name and self._mode.value == "edit"
        ]
        along, across = (edited[0][:, axis].tolist() if edited else [] for axis in (1, 0))
        self._is_updating = True
        try:
            self._region_menu.options = [None, *regions.names]
            self._region_menu.value = selected_name
            self._name.value = selected_name or ""
            self._sources["corners"].data = {"along": along, "across": across}
        finally:
            self._is_updating = False
        self._name.disabled = self._remove_button.disabled = selected_name is None
        self._box_button.disabled = not isinstance(self._selected, Region)
        self._sources["outlines"].data = {
            "along": [region.polygon[:, 1].tolist() for region in regions],
            "across": [region.polygon[:, 0].tolist() for region in regions],
            "name": list(regions.names),
            "colour": [_colour(number) for number in range(len(regions))],
            "width": [3 if region.name == selected_name else 1.5 for region in regions],
        }
        self._show_message(self._region_count() + ("" if self._state.is_saved else ", not saved"))
        self._update_spectra()

    @property
    def _selected_place(self) -> Place | None:
        if isinstance(self._selected, str):
            return next(region for region in self._state.drawn if region.name == self._selected)
        return self._selected

    def _update_spectra(self) -> None:
        import panel

        rows: list[tuple[Spectrum, str, str, float]] = []
        for number, region in enumerate(self._state.drawn):
            spectrum = self._state.spectrum_of(region)
            if isinstance(spectrum, Spectrum):
                rows.append(
                    (spectrum, region.name, _colour(number), 3 if region.name == self._selected else 1.5)
                )
        clicked = self._selected_place
        spectrum_now = None if clicked is None else self._state.spectrum_of(clicked)
        if isinstance(spectrum_now, Spectrum) and not isinstance(self._selected, str):
            rows.append((spectrum_now, "clicked", INK[self._theme], 2))
        spreads = [
            {**band_around(spectrum.wavelength, *spectrum.spread), "colour": colour}
            for spectrum, _, colour, _ in rows
            if spectrum.spread is not None
        ]
        curves = [_curve(spectrum, name, colour, width, "solid") for spectrum, name, colour, width in rows]
        # list the most similar paints, and draw the ticked ones
        near_paints = self._state.near_paints(spectrum_now) if isinstance(spectrum_now, Spectrum) else []
        self._is_updating = True
        self._paint_boxes.options = {
            f"{paint.name}: {paint.angle:.1f}°, x {paint.factor:.2f}": i
            for i, paint in enumerate(near_paints)
        }
        self._is_updating = False
        curves += [
            _curve(near_paints[i], near_paints[i].name, NEAR_COLOUR, 1.5, DASHES[i % len(DASHES)])
            for i in self._paint_boxes.value
            if i < len(near_paints)
        ]
        self._show_rows("spreads", spreads)
        self._show_rows("curves", curves)
        self._show_rows("uncertainty", [])
        name = f"{self._selected}: " if isinstance(self._selected, str) else ""
        text = (
            spectrum_now.text
            if isinstance(spectrum_now, Spectrum)
            else spectrum_now or "Click on the picture for a spectrum"
        )
        self._spectrum_pane.object = html.escape(name + text)
        # the last click, outlined by its corners
        corners = clicked.polygon if isinstance(clicked, Region) else np.zeros((0, 2))
        if isinstance(clicked, tuple):
            corners = np.array([(clicked[1] + a - 0.5, clicked[0] + b - 0.5) for a, b in _UNIT_SQUARE])
        across, along = np.vstack([corners, corners[:1]]).T.tolist()
        self._sources["spot"].data = {"along": along, "across": across}
        if isinstance(spectrum_now, Spectrum):
            # show the curve before its uncertainty is computed
            panel.state.execute(self._update_uncertainty, schedule=True)

    def _update_uncertainty(self) -> None:
        clicked = self._selected_place
        spectrum = None if clicked is None else self._state.spectrum_of(clicked)
        if clicked is None or not isinstance(spectrum, Spectrum):
            return
        uncertainty = self._state.uncertainty_of(clicked)
        name = f"{self._selected}: " if isinstance(self._selected, str) else ""
        if isinstance(uncertainty, str):
            text = f"uncertainty unknown: {uncertainty.splitlines()[-1].strip()}"
        else:
            colour = INK[self._theme]
            if isinstance(self._selected, str):
                colour = _colour(self._state.drawn.names.index(self._selected))
            lower, upper = spectrum.reflectance - uncertainty.u, spectrum.reflectance + uncertainty.u
            outline = band_around(spectrum.wavelength, lower, upper)
            self._show_rows("uncertainty", [{**outline, "colour": colour}])
            text = uncertainty.text
        self._spectrum_pane.object = (
            f"{html.escape(name + spectrum.text)}<br><small>{html.escape(text)}</small>"
        )


def _curve(spectrum: Spectrum | NearPaint, name: str, colour: str, width: float, dash: str) -> dict[str, Any]:
    axes = {"nm": spectrum.wavelength, "reflectance": spectrum.reflectance}
    return {**axes, "name": name, "colour": colour, "width": width, "dash": dash}


def _nearest_option(values: list[float], value: float) -> float:
    return min(values, key=lambda option: abs(option - value))


def _colour(number: int) -> str:
    return COLOURS[number % len(COLOURS)]
