"""The sections of a report: a flight line, a paint library, a calibration.

A section yields its parts undrawn, each with its name, so that one that fails does not keep the others from
the page.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from hyperpaint.base import schema
from hyperpaint.base.errors import PaintError, SchemaError
from hyperpaint.base.schema import ALONG_TRACK, CROSS_TRACK, PAINT, Quality
from hyperpaint.paints.colours import paint_colours
from hyperpaint.pictures.figures import data_uri, encode_png, new_figure, png_of
from hyperpaint.pictures.plot import draw_irradiance, draw_reflectance, flags_of
from hyperpaint.pictures.plot_calibration import calibration_report
from hyperpaint.pictures.plot_flags import background, draw_outlines, flag_overlay, flag_shares
from hyperpaint.pictures.plot_library import find_usable, library_overview
from hyperpaint.radiometry.counts_to_reflectance import reflectance
from hyperpaint.regions import Region, regions_from

from .facts import facts_of_bands, facts_of_line
from .markup import Markup, element, joined, table_of_facts, void

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Part", "calibration_section", "library_section", "line_section", "regions_of"]

MOST_ROWS = 500
"""Paints of a table at the most."""

LAYERS = ("glint_fraction", "blocked_direct", "adjacency")
"""Continuous layers that are drawn where the store holds them."""

_DPI = 100


Part = tuple[str, Callable[[], Markup]]
"""What a part shows, and what draws it."""


def line_section(
    line: xr.Dataset, lines: int, regions: Sequence[Region] = (), note: str = ""
) -> Iterator[Part]:
    """Yield the parts of a flight line's section; each is to be drawn before the next is asked for.

    Parameters
    ----------
    line
        The flight line.
    lines
        Lines of a picture at the most.
    regions
        Outlined on the picture, in sensor coordinates.
    note
        What is said of the flags.
    """
    yield "facts", lambda: table_of_facts(list(facts_of_line(line)))
    yield from _pictures(line, lines, regions)
    if note:
        yield "where flags are from", lambda: element("p", note, class_="note")
    if "irradiance" in line.variables:
        yield "irradiance", partial(_irradiance, line)
    if "reflectance" in line.variables or "irradiance" in line.variables:
        yield "reflectance", partial(_reflectance, line)
    yield "provenance", lambda: _provenance(line.attrs)


def _pictures(line: xr.Dataset, lines: int, regions: Sequence[Region]) -> Iterator[Part]:
    """Yield true colour, flags on it, and their shares."""
    drawn: list[bool] = []
    yield "true colour", partial(_true_colour, line, lines, drawn)
    # without a picture there is nothing to draw flags on; why is told already
    if "quality" in line.variables:
        heading = element("h3", "Flags and regions" if regions else "Flags")
        if drawn:
            yield "flags", lambda: joined([heading, _flags(line, lines, regions)])
        yield "shares of flags", lambda: joined(["" if drawn else heading, _table_of_flags(flags_of(line))])
    for layer in (name for name in LAYERS if drawn and name in line.variables):
        yield layer, partial(_layer, line, lines, layer)


def _true_colour(line: xr.Dataset, lines: int, drawn: list[bool]) -> Markup:
    """Return the picture, and note in ``drawn`` that there is one."""
    if not line.sizes[ALONG_TRACK] or not line.sizes[CROSS_TRACK]:
        raise SchemaError(
            f"the line has no pixels: {line.sizes[ALONG_TRACK]} lines of {line.sizes[CROSS_TRACK]} columns"
        )
    heading = element("h3", "True colour")
    try:
        picture = background(line, max(1, -(-line.sizes[ALONG_TRACK] // lines)))
    except SchemaError as error:  # no reflectance, no visible bands
        return joined([heading, element("p", f"There is no picture: {error}", class_="note")])
    bytes_ = np.ascontiguousarray((picture.clip(0.0, 1.0) * 255.0 + 0.5).astype(np.uint8).swapaxes(0, 1))
    image = void("img", class_="pixels", src=data_uri(encode_png(bytes_)), alt="true colour")
    size = f"{line.sizes[ALONG_TRACK]} lines to the right, {line.sizes[CROSS_TRACK]} columns down"
    drawn.append(True)
    return joined([heading, element("figure", image, element("figcaption", f"{size}."))])


def _flags(line: xr.Dataset, lines: int, regions: Sequence[Region]) -> Markup:
    figure = new_figure("a report", figsize=(10, 3.8), layout="constrained")
    axes = flag_overlay(line, lines=lines, axes=figure.add_subplot())
    draw_outlines(axes, regions)
    return _figure(figure, "Pixels with a flag; where several are set, the rarest is shown.")


def _layer(line: xr.Dataset, lines: int, layer: str) -> Markup:
    figure = new_figure("a report", figsize=(10, 3.4), layout="constrained")
    flag_overlay(line, layer=layer, lines=lines, axes=figure.add_subplot())
    return _figure(figure, f"{schema.VARIABLES[layer].meaning}.")


def _irradiance(line: xr.Dataset) -> Markup:
    figure = new_figure("a report", figsize=(10, 3.2), layout="constrained")
    draw_irradiance(figure.add_subplot(), line)
    caption = "Downwelling irradiance around the line, and when the line was flown."
    return joined([element("h3", "Irradiance over time"), _figure(figure, caption)])


def _reflectance(line: xr.Dataset) -> Markup:
    figure = new_figure("a report", figsize=(10, 3.6), layout="constrained")
    few = max(1, line.sizes[ALONG_TRACK] // 50)
    some = line.isel({ALONG_TRACK: slice(None, None, few)})
    draw_reflectance(figure.add_subplot(), some if "reflectance" in some else reflectance(some))
    every = "all lines" if few == 1 else f"one line in {few}"
    caption = f"How reflectance is spread over the pixels of {every}, band by band."
    return joined([element("h3", "Reflectance"), _figure(figure, caption)])


def _table_of_flags(quality: npt.NDArray[Any]) -> Markup:
    shares = flag_shares(quality)
    if not shares:
        return element("p", "No flag is set on any pixel.", class_="note")
    rows = (
        element(
            "tr",
            element("th", str(flag.name).lower().replace("_", " "), scope="row"),
            element("td", f"{np.count_nonzero(quality & int(flag))}", class_="number"),
            element("td", f"{100 * share:.3f} %", class_="number"),
            element("td", element("span", class_="bar", style=f"width:{20 * share:.2f}em")),
        )
        for flag, share in shares.items()
    )
    free = float((quality == 0).mean())
    head = _heads("flag", "", numbers=("pixels", "share"))
    note = element("p", f"{100 * free:.2f} % of {quality.size} pixels have no flag.", class_="note")
    return joined([element("table", head, joined(rows)), note])


def library_section(library: xr.Dataset) -> Iterator[Part]:
    """Yield the parts of a paint library's section; what is not a library's is named and left out."""
    usable, wrong = find_usable(library)
    yield "facts", lambda: table_of_facts([("paints", usable.sizes[PAINT]), *facts_of_bands(usable)])
    for problem in wrong:
        yield "variables", partial(_refuse, problem)
    caption = "Colour in daylight, centre, middle half and 5 to 95 % of the pixels of every paint."
    yield "spectra", lambda: _figure(library_overview(usable), caption)
    yield "paints", lambda: _table_of_paints(usable)
    yield "provenance", lambda: _provenance(library.attrs)


def _refuse(problem: str) -> Markup:
    raise SchemaError(problem)


def _table_of_paints(library: xr.Dataset) -> Markup:
    """Return a row for every paint: its colour, pixels, flags and what is known of it."""
    shown = library.isel({PAINT: slice(0, MOST_ROWS)})
    columns = [name for name in ("n", "n_eff", "n_excluded") if name in shown.variables]
    known = {"time", "region", *schema.LIBRARY_VARIABLES}
    told = [str(name) for name in shown.coords if shown[name].dims == (PAINT,) and name not in known][:12]
    values = {name: shown[name].values for name in (PAINT, *columns, *told)}
    quality = shown["quality"].values if "quality" in shown.variables else np.zeros(len(values[PAINT]), int)
    rows = []
    for number, colour in enumerate(paint_colours(shown)):
        flags = ", ".join(str(f.name).lower() for f in Quality if int(quality[number]) & int(f))
        rows.append(
            element(
                "tr",
                element("td", _swatch(colour)),
                element("th", values[PAINT][number], scope="row"),
                *(element("td", f"{values[name][number]:.0f}", class_="number") for name in columns),
                element("td", flags),
                *(element("td", values[name][number]) for name in told),
            )
        )
    numbers = [name.replace("_", " ") for name in columns]
    head = _heads("", "paint", "flags of the pixels used", *told, numbers=numbers, first=2)
    more = library.sizes[PAINT] - len(rows)
    note = element("p", f"and {more} paints more", class_="note") if more > 0 else ""
    return joined([element("table", head, joined(rows)), note])


def _heads(*names: str, numbers: Sequence[str], first: int = 1) -> Markup:
    """Return the heads of columns: the first names, then those of numbers, then the other names."""
    plain = [element("th", name, scope="col") for name in names]
    right = [element("th", name, scope="col", class_="number") for name in numbers]
    return element("tr", *plain[:first], *right, *plain[first:])


def regions_of(library: xr.Dataset) -> Iterator[tuple[str, Region]]:
    """Yield the regions that paints were found in, with the names of their flight lines.

    Those on a map are left out, and what is no region: a library may have been made by anyone.
    """
    if not {"region", "flightline"} <= set(library.variables):
        return
    if library.attrs.get("coordinates_of_regions", "sensor") != "sensor":
        return
    pairs = zip(library["region"].values, library["flightline"].values, strict=True)
    for told, flightline in list(pairs)[:MOST_ROWS]:
        with contextlib.suppress(PaintError, ValueError, RecursionError):
            yield str(flightline), regions_from(json.loads(str(told)))[0]


def _swatch(colour: npt.NDArray[np.float32]) -> Markup:
    if not np.isfinite(colour).all():
        return Markup("")
    red, green, blue = (255 * colour + 0.5).astype(int).tolist()
    return element("span", class_="swatch", style=f"background:rgb({red},{green},{blue})")


def calibration_section(calibration: xr.Dataset) -> Iterator[Part]:
    """Yield the parts of the calibration's section; pictures where it comes from a lab sweep."""
    yield "facts", lambda: table_of_facts(list(facts_of_bands(calibration)))
    # a calibration that was given as files has no lines of a sweep to show
    if "line_centre" in calibration.variables:
        caption = "Lines of the lab sweep and what they came to."
        yield "lab sweep", lambda: _figure(calibration_report(calibration), caption)
    yield "provenance", lambda: _provenance(calibration.attrs)


def _figure(figure: Any, caption: str) -> Markup:
    image = void("img", src=data_uri(png_of(figure, dpi=_DPI)), alt=caption)
    return element("figure", image, element("figcaption", caption))


def _provenance(attrs: Mapping[Any, Any]) -> Markup:
    """Return everything that a group says of itself, to be opened."""
    table = table_of_facts([(str(name), told) for name, told in attrs.items()])
    return element("details", element("summary", "Provenance"), table)
