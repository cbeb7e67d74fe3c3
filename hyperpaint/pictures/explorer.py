"""The widget to explore a flight line, made with panel and bokeh (extra ``interactive``)."""

from __future__ import annotations

import html
import os
from pathlib import Path
from typing import Any

import numpy as np

from hyperpaint.base.errors import PaintError
from hyperpaint.regions import Region, Regions
from hyperpaint.regions.polygons import contains

from .explorer_figures import (
    COLOURS,
    DASHES,
    INK,
    NEAR_COLOUR,
    PictureFigure,
    SpectraFigure,
    band_around,
    place,
)
from .explorer_state import INFRARED, TRUE_COLOUR, Explored, NearPaint, Place, Spectrum
from .plot import flag_label, percent

_MODES = {"Spectrum": "spectrum", "Draw": "draw", "Edit": "edit", "Move": "move"}
_HELP = {
    "spectrum": "Click for the spectrum of a pixel, drag for the median of a box; the wheel zooms",
    "draw": "Click the corners of a region, double-click the last one",
    "edit": "Click a region to choose it, drag its corners",
    "move": "Drag to move the picture; the wheel or two fingers zoom",
}
_RECIPES = {"true colour": TRUE_COLOUR, "colour infrared": INFRARED}
_ONE_BAND = "one band"
_BOX = ((0, 0), (1, 0), (1, 1), (0, 1))
WIDE = {"sizing_mode": "stretch_width"}


class Explorer:
    """A widget that shows a flight line; see `explore`.

    ``view`` is the layout of panel, which ``panel serve`` shows as well. With ``save_to`` regions are saved
    to that file only.
    """

    def __init__(self, state: Explored, *, theme: str = "light", save_to: Path | None = None) -> None:
        import panel

        panel.extension()  # loads scripts into a notebook
        self._state, self._theme, self._save_to = state, theme, save_to
        self._is_showing = False
        self._window: tuple[int, int] | None = None
        self._picture, self._spectra = PictureFigure(state, theme), SpectraFigure(theme)
        # the last click, or the name of the chosen region; at first the middle of the line
        lines, columns = state.shape
        self._current: Place | str | None = (min(lines, columns) // 2, columns // 2)
        self._make_widgets()
        self.view = self._layout()
        self._connect()
        self._show_pictures()
        self._show(state.drawn.names[-1] if len(state.drawn) else None)

    @property
    def regions(self) -> Regions:
        """Regions drawn, in sensor coordinates: x is cross_track, y is along_track, whole pixels."""
        return self._state.regions

    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
        """Write the regions as GeoJSON; see `hyperpaint.write_regions`."""
        return self._state.save(path, overwrite=overwrite)

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> Any:
        return self.view._repr_mimebundle_(include, exclude)

    # --- widgets and layout -------------------------------------------------------------------------------

    def _make_widgets(self) -> None:
        import panel

        def make(kind: str, text: str, **options: Any) -> Any:
            widget = getattr(panel.widgets, kind)
            # panel is renaming the argument
            return widget(**{"label" if "label" in widget.param else "name": text}, **options, **WIDE)

        state = self._state
        bands = sorted(set(np.round(state.wavelength[np.isfinite(state.wavelength)], 1).tolist()))
        recipes = [name for name, recipe in _RECIPES.items() if state.has_bands(recipe)]
        flags = {f"{flag_label(flag)}, {percent(share)}": flag for flag, share in state.flag_shares.items()}
        self._mode = make("RadioButtonGroup", "", options=_MODES, value="spectrum")
        self._recipe = make("Select", "Colours", options=[*recipes, _ONE_BAND])
        self._band = make(
            "DiscreteSlider", "Band [nm]", options=bands, value=_nearest(bands, 650.0), formatter="%.1f"
        )
        self._stretch = make("RangeSlider", "Black and white [percentile]", start=0, end=100, value=(2, 98))
        self._layers = make("CheckBoxGroup", "", options=flags)
        self._chosen = make("Select", "Region", options=[])
        self._name = make("TextInput", "Name")
        self._keep = make("Button", "Box to region", disabled=True)
        self._undo = make("Button", "Undo corner", disabled=True)
        self._remove = make("Button", "Remove")
        file = "regions.geojson" if self._save_to is None else str(self._save_to)
        self._file = make("TextInput", "File", value=file, disabled=self._save_to is not None)
        self._save = make("Button", "Save regions")
        self._paints = make("CheckBoxGroup", "", options={})
        self._text, self._message, self._level = (panel.pane.HTML("", **WIDE) for _ in range(3))

    def _layout(self) -> Any:
        import panel

        def shown(plot: Any) -> Any:
            return panel.pane.Bokeh(plot, **WIDE)

        def column(flex: str, *parts: Any) -> Any:
            return panel.Column(*parts, styles={"flex": flex, "min-width": "0"}, **WIDE)

        def card(title: str, *parts: Any) -> Any:
            return column("1 1 230px", panel.pane.HTML(f"<b>{title}</b>", **WIDE), *parts)

        lines, columns = self._state.shape
        navigator = [shown(self._picture.navigator())] if lines > 3 * columns else []
        flags = self._layers if self._state.flag_shares else panel.pane.HTML("no flags stored", **WIDE)
        near = panel.pane.HTML("<b>Nearest paints</b>: spectral angle, and scale factor", **WIDE)
        buttons = panel.Row(self._keep, self._undo, self._remove, **WIDE)
        return panel.Column(
            panel.FlexBox(
                column("3 1 340px", self._mode, shown(self._picture.plot), *navigator, self._level),
                column("2 1 320px", self._text, shown(self._spectra.plot), near, self._paints),
                **WIDE,
            ),
            panel.FlexBox(
                card("Picture", self._recipe, self._band, self._stretch),
                card("Flags", flags),
                card("Regions", self._chosen, self._name, buttons),
                card("Save", self._file, self._save, self._message),
                **WIDE,
            ),
            **WIDE,
        )

    def _connect(self) -> None:
        from bokeh.events import DoubleTap, SelectionGeometry, Tap

        plot = self._picture.plot
        plot.on_event(Tap, lambda event: self.tap(event.x, event.y))
        plot.on_event(DoubleTap, lambda event: self.close(event.x, event.y))
        plot.on_event(SelectionGeometry, lambda event: self.drag(event.geometry) if event.final else None)
        self._spectra.plot.on_event(Tap, lambda event: self.take_band(event.x))
        self._picture.corners.on_change("data", self._dragged)
        self._picture.view.on_change("data", self._looked)
        calls = (
            (self._mode, "value", lambda _: self._take_mode()),
            (self._recipe, "value", lambda _: self._show_pictures()),
            (self._stretch, "value_throttled", lambda _: self._show_pictures()),
            (self._band, "value_throttled", lambda event: self.take_band(event.new)),
            (self._layers, "value", lambda _: self._show_flags()),
            (self._chosen, "value", lambda event: self._show(event.new)),
            (self._name, "value", lambda event: self._rename(event.new)),
            (self._paints, "value", lambda _: self._show_spectra()),
        )
        for widget, name, call in calls:
            widget.param.watch(self._unless_showing(call), name)
        clicks = (
            (self._keep, self._keep_box),
            (self._undo, lambda: self._draw_draft(-1)),
            (self._remove, self._drop),
            (self._save, self._write),
        )
        for button, press in clicks:
            button.on_click(self._unless_showing(lambda _, press=press: press()))

    def _unless_showing(self, call: Any) -> Any:
        # does nothing while the program itself sets widgets
        import panel

        def run(event: Any) -> None:
            if not self._is_showing:
                # figures may be changed once their document is locked
                panel.state.execute(lambda: call(event), schedule=True)

        return run

    # --- events of the mouse -------------------------------------------------------------------------------

    def tap(self, along: float, across: float) -> None:
        """Handle a click on the picture: show a pixel, add a corner, or choose the region to edit."""
        pixel = int(np.floor(along + 0.5)), int(np.floor(across + 0.5))
        mode = self._mode.value
        if mode == "draw":
            self._draw_draft(None, (along, across))
        elif mode == "edit":
            spot = np.array([across]), np.array([along])
            names = [region.name for region in self._state.drawn if contains(region.polygon, (), *spot)[0]]
            self._show(names[-1] if names else self._chosen.value)
        elif all(0 <= number < size for number, size in zip(pixel, self._state.shape, strict=True)):
            self._look_at(pixel)

    def drag(self, geometry: dict[str, Any]) -> None:
        """Show the median spectrum of a box dragged over the picture."""
        if self._mode.value != "spectrum" or geometry.get("type") != "rect":
            return
        ends = []
        for axis, size in zip("xy", self._state.shape, strict=True):
            low, high = sorted((geometry[f"{axis}0"], geometry[f"{axis}1"]))
            ends.append((max(0, int(np.ceil(low))), min(size - 1, int(np.floor(high)))))
        along, across = ends
        if along[0] > along[1] or across[0] > across[1]:
            return
        # a quarter of a pixel more, so that a box of one line holds its pixels
        corners = [(across[a] + a / 2 - 0.25, along[b] + b / 2 - 0.25) for a, b in _BOX]
        self._look_at(Region("box", np.array(corners)))

    def close(self, along: float, across: float) -> None:
        """Add the last corner of the polygon in progress, and make it a region."""
        if self._mode.value == "draw":
            self.tap(along, across)
            draft = self._picture.draft.data
            # a double click that encloses no area does not end the polygon
            if self._add(draft["along"], draft["across"]):
                self._clear_draft()

    def take_band(self, wavelength: float) -> None:
        """Show the band nearest to a wavelength [nm]."""
        self._is_showing = True
        self._band.value = _nearest(self._band.options, wavelength)
        self._recipe.value = _ONE_BAND
        self._is_showing = False
        self._show_pictures()

    def _look_at(self, clicked: Place) -> None:
        self._current = clicked
        self._show(None)

    def _keep_box(self) -> None:
        if isinstance(self._current, Region):
            across, along = self._current.polygon.T.tolist()
            self._add(along, across)

    def _add(self, along: list[float], across: list[float]) -> bool:
        name = self._state.add(along, across)
        self._show(name or self._chosen.value)
        if name is None:
            self._say("these corners enclose no area: a region needs three that are not in a row")
        return name is not None

    def _draw_draft(self, stop: int | None, *more: tuple[float, float]) -> None:
        draft = self._picture.draft.data
        self._picture.draft.data = {
            name: [*draft[name][:stop], *(corner[axis] for corner in more)]
            for axis, name in enumerate(("along", "across"))
        }
        self._undo.disabled = not self._picture.draft.data["along"]

    def _clear_draft(self) -> None:
        self._picture.draft.data = {"along": [], "across": []}
        self._undo.disabled = True

    def _take_mode(self) -> None:
        self._picture.take_mode(self._mode.value)
        self._clear_draft()
        self._show_level()
        self._show(self._chosen.value)

    def _dragged(self, attr: str, old: Any, new: Any) -> None:  # noqa: ARG002 (bokeh asks for these names)
        name = self._chosen.value
        if not self._is_showing and name is not None:
            self._state.move(name, list(new["along"]), list(new["across"]))
            self._show(name)

    def _rename(self, new: str) -> None:
        name = self._chosen.value
        if name is not None and new != name:
            problem = self._state.rename(name, new)
            self._show(new.strip() if problem is None else name)
            self._say(problem or self._count())

    def _drop(self) -> None:
        if self._chosen.value is not None:
            self._state.drop(self._chosen.value)
            self._show(None)

    def _write(self) -> None:
        file = self._save_to or Path(self._file.value)
        try:
            written = self._state.save_again(file)
        except PaintError as error:
            self._say(error.text(on_command_line=self._save_to is not None))
            return
        except OSError as error:
            self._say(str(error))
            return
        self._say(f"{self._count()} saved in {written}")

    def _looked(self, attr: str, old: Any, new: Any) -> None:  # noqa: ARG002
        (first, last), (width, height) = new["along"], new["size"]
        if self._window is None and width and height:
            # pixels with the aspect ratio on the ground, the first time that the size is known
            lines, columns = self._state.shape
            shown = columns * width / height / self._state.orientation.aspect
            first = -0.5 - max(0.0, shown - lines) / 2
            last = first + shown
            self._picture.show_lines(first, last)
        window = int(np.floor(first)), int(np.ceil(last)) + 1
        if window != self._window:
            self._window = window
            self._show_pictures(base=False)

    # --- display ----------------------------------------------------------------------------------------

    def _say(self, text: str) -> None:
        self._message.object = html.escape(text)

    def _count(self) -> str:
        count = len(self._state.drawn)
        others = len(self._state.others)
        return f"{count} region{'' if count == 1 else 's'}" + f" (and {others} of other lines)" * bool(others)

    def _show_pictures(self, *, base: bool = True) -> None:
        # ``base`` also shows the whole line behind the lines in view
        recipe = _RECIPES.get(self._recipe.value) or ()
        if self._recipe.value == _ONE_BAND:
            recipe = (self._band.value,)
        try:
            if base:
                place(self._picture.base, self._state.picture(recipe, self._stretch.value))
            detail = self._state.picture(recipe, self._stretch.value, self._window)
        except PaintError as error:
            self._level.object = html.escape(str(error))
            return
        place(self._picture.detail, detail)
        self._shown = f"{recipe[0]:.1f} nm" if self._recipe.value == _ONE_BAND else self._recipe.value
        self._shown += f", lines {detail.first} to {detail.last - 1}" + f", {detail.text}" * bool(detail.text)
        self._show_level()
        self._show_flags()
        self._spectra.mark(recipe[0] if len(recipe) == 1 else None)

    def _show_level(self) -> None:
        self._level.object = f"{html.escape(_HELP[self._mode.value])}.<br><small>{self._shown}</small>"

    def _show_flags(self) -> None:
        flags = self._layers.value
        place(self._picture.flags, self._state.flag_picture(flags, self._window) if flags else None)

    def _show(self, name: str | None) -> None:
        # region ``name`` is bold, with handles in edit mode
        regions, picture = self._state.drawn, self._picture
        chosen = name if name in regions.names else None
        if chosen is not None or isinstance(self._current, str):
            self._current = chosen
        edited = [one.polygon for one in regions if one.name == chosen and self._mode.value == "edit"]
        along, across = (edited[0][:, axis].tolist() if edited else [] for axis in (1, 0))
        self._is_showing = True
        try:
            self._chosen.options = [None, *regions.names]
            self._chosen.value = chosen
            self._name.value = chosen or ""
            picture.corners.data = {"along": along, "across": across}
        finally:
            self._is_showing = False
        self._name.disabled = self._remove.disabled = chosen is None
        self._keep.disabled = not isinstance(self._current, Region)
        picture.outlines.data = {
            "along": [region.polygon[:, 1].tolist() for region in regions],
            "across": [region.polygon[:, 0].tolist() for region in regions],
            "name": list(regions.names),
            "colour": [_colour(number) for number in range(len(regions))],
            "width": [3 if region.name == chosen else 1.5 for region in regions],
        }
        self._say(self._count() + ("" if self._state.is_saved else ", not saved"))
        self._show_spectra()

    @property
    def _looked_at(self) -> Place | None:
        if isinstance(self._current, str):
            return next(one for one in self._state.drawn if one.name == self._current)
        return self._current

    def _show_spectra(self) -> None:
        import panel

        rows: list[tuple[Spectrum, str, str, float]] = []
        for number, region in enumerate(self._state.drawn):
            spectrum = self._state.spectrum_of(region)
            if isinstance(spectrum, Spectrum):
                rows.append(
                    (spectrum, region.name, _colour(number), 3 if region.name == self._current else 1.5)
                )
        clicked = self._looked_at
        now = None if clicked is None else self._state.spectrum_of(clicked)
        if isinstance(now, Spectrum) and not isinstance(self._current, str):
            rows.append((now, "clicked", INK[self._theme], 2))
        spreads = [
            {**band_around(spectrum.wavelength, *spectrum.spread), "colour": colour}
            for spectrum, _, colour, _ in rows
            if spectrum.spread is not None
        ]
        curves = [_curve(spectrum, name, colour, width, "solid") for spectrum, name, colour, width in rows]
        # the paints most similar to the last click; ticked paints are drawn
        near = self._state.near_paints(now) if isinstance(now, Spectrum) else []
        self._is_showing = True
        self._paints.options = {
            f"{paint.name}: {paint.angle:.1f}°, x {paint.factor:.2f}": i for i, paint in enumerate(near)
        }
        self._is_showing = False
        curves += [
            _curve(near[i], near[i].name, NEAR_COLOUR, 1.5, DASHES[i % len(DASHES)])
            for i in self._paints.value
            if i < len(near)
        ]
        _fill(self._spectra.spreads, spreads)
        _fill(self._spectra.curves, curves)
        _fill(self._spectra.uncertainty, [])
        name = f"{self._current}: " if isinstance(self._current, str) else ""
        text = now.text if isinstance(now, Spectrum) else now or "Click on the picture for a spectrum"
        self._text.object = html.escape(name + text)
        if isinstance(clicked, tuple):
            self._picture.mark(np.array([(clicked[1] + a - 0.5, clicked[0] + b - 0.5) for a, b in _BOX]))
        else:
            self._picture.mark(clicked.polygon if isinstance(clicked, Region) else np.zeros((0, 2)))
        if isinstance(now, Spectrum):
            # the curve appears before its uncertainty is computed
            panel.state.execute(self._show_uncertainty, schedule=True)

    def _show_uncertainty(self) -> None:
        clicked = self._looked_at
        now = None if clicked is None else self._state.spectrum_of(clicked)
        if clicked is None or not isinstance(now, Spectrum):
            return
        uncertainty = self._state.uncertainty_of(clicked)
        name = f"{self._current}: " if isinstance(self._current, str) else ""
        if isinstance(uncertainty, str):
            text = f"uncertainty unknown: {uncertainty.splitlines()[-1].strip()}"
        else:
            colour = INK[self._theme]
            if isinstance(self._current, str):
                colour = _colour(self._state.drawn.names.index(self._current))
            low, high = now.reflectance - uncertainty.u, now.reflectance + uncertainty.u
            _fill(self._spectra.uncertainty, [{**band_around(now.wavelength, low, high), "colour": colour}])
            text = uncertainty.text
        self._text.object = f"{html.escape(name + now.text)}<br><small>{html.escape(text)}</small>"


def _curve(spectrum: Spectrum | NearPaint, name: str, colour: str, width: float, dash: str) -> dict[str, Any]:
    axes = {"nm": spectrum.wavelength, "reflectance": spectrum.reflectance}
    return {**axes, "name": name, "colour": colour, "width": width, "dash": dash}


def _fill(source: Any, rows: list[dict[str, Any]]) -> None:
    source.data = {name: [row[name] for row in rows] for name in source.data}


def _nearest(values: list[float], value: float) -> float:
    return min(values, key=lambda one: abs(one - value))


def _colour(number: int) -> str:
    return COLOURS[number % len(COLOURS)]
