"""The sections of a report: a flight line, a paint library, a calibration."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from . import schema
from .errors import PaintError, SchemaError
from .facts import facts_of_bands, facts_of_line
from .figures import data_uri, encode_png, new_figure, png_of
from .markup import Markup, element, joined, table_of_facts, void
from .plot import draw_irradiance, draw_reflectance
from .plot_calibration import calibration_report
from .plot_flags import background, draw_outlines, flag_overlay, flag_shares
from .plot_library import library_overview, paint_colours
from .radiometry import reflectance
from .regions import Region, regions_from
from .schema import ALONG_TRACK, CROSS_TRACK, PAINT, Quality

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["calibration_section", "library_section", "line_section", "regions_of"]

MOST_ROWS = 500
"""Paints of a table at the most."""

LAYERS = ("glint_fraction", "blocked_direct", "adjacency")
"""Continuous layers that are drawn where the store holds them."""

_DPI = 100


def line_section(line: xr.Dataset, lines: int, regions: Sequence[Region] = ()) -> Iterator[Markup]:
    """Yield the parts of a flight line's section.

    Parameters
    ----------
    line
        The flight line.
    lines
        Lines of a picture at the most.
    regions
        Outlined on the picture, in sensor coordinates.
    """
    yield table_of_facts(list(facts_of_line(line)))
    yield from _pictures(line, lines, regions)
    if "irradiance" in line.variables:
        yield element("h3", "Irradiance over time")
        figure = new_figure("a report", figsize=(10, 3.2), layout="constrained")
        draw_irradiance(figure.add_subplot(), line)
        yield _figure(figure, "Downwelling irradiance around the line, and when the line was flown.")
    if "reflectance" in line.variables or "irradiance" in line.variables:
        yield element("h3", "Reflectance")
        figure = new_figure("a report", figsize=(10, 3.6), layout="constrained")
        few = max(1, line.sizes[ALONG_TRACK] // 50)
        some = line.isel({ALONG_TRACK: slice(None, None, few)})
        draw_reflectance(figure.add_subplot(), some if "reflectance" in some else reflectance(some))
        every = "all lines" if few == 1 else f"one line in {few}"
        yield _figure(figure, f"How reflectance is spread over the pixels of {every}, band by band.")
    yield _provenance(line.attrs)


def _pictures(line: xr.Dataset, lines: int, regions: Sequence[Region]) -> Iterator[Markup]:
    """Yield true colour, flags on it, and their shares."""
    step = max(1, -(-line.sizes[ALONG_TRACK] // lines))
    yield element("h3", "True colour")
    try:
        picture = background(line, step)
    except SchemaError as error:  # no reflectance, no visible bands
        yield element("p", f"There is no picture: {error}", class_="note")
        picture = None
    if picture is not None:
        bytes_ = np.ascontiguousarray((picture.clip(0.0, 1.0) * 255.0 + 0.5).astype(np.uint8).swapaxes(0, 1))
        image = void("img", class_="pixels", src=data_uri(encode_png(bytes_)), alt="true colour")
        size = f"{line.sizes[ALONG_TRACK]} lines to the right, {line.sizes[CROSS_TRACK]} columns down"
        yield element("figure", image, element("figcaption", f"{size}."))
    if "quality" not in line.variables:
        return
    yield element("h3", "Flags and regions" if regions else "Flags")
    if picture is not None:
        figure = new_figure("a report", figsize=(10, 3.8), layout="constrained")
        axes = flag_overlay(line, lines=lines, axes=figure.add_subplot())
        draw_outlines(axes, regions)
        yield _figure(figure, "Pixels with a flag; where several are set, the rarest is shown.")
    quality = schema.require(line, ["quality"], "a report")["quality"].values
    yield _table_of_flags(quality)
    for layer in (name for name in LAYERS if picture is not None and name in line.variables):
        figure = new_figure("a report", figsize=(10, 3.4), layout="constrained")
        flag_overlay(line, layer=layer, lines=lines, axes=figure.add_subplot())
        yield _figure(figure, f"{schema.VARIABLES[layer].meaning}.")


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


def library_section(library: xr.Dataset) -> Iterator[Markup]:
    """Yield the parts of a paint library's section."""
    yield table_of_facts([("paints", library.sizes[PAINT]), *facts_of_bands(library)])
    yield _figure(
        library_overview(library),
        "Colour in daylight, centre, middle half and 5 to 95 % of the pixels of every paint.",
    )
    yield _table_of_paints(library)
    yield _provenance(library.attrs)


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


def calibration_section(calibration: xr.Dataset) -> Iterator[Markup]:
    """Yield the parts of the calibration's section; pictures where it comes from a lab sweep."""
    yield table_of_facts(list(facts_of_bands(calibration)))
    # a calibration that was given as files has no lines of a sweep to show
    if "line_centre" in calibration.variables:
        yield _figure(calibration_report(calibration), "Lines of the lab sweep and what they came to.")
    yield _provenance(calibration.attrs)


def _figure(figure: Any, caption: str) -> Markup:
    image = void("img", src=data_uri(png_of(figure, dpi=_DPI)), alt=caption)
    return element("figure", image, element("figcaption", caption))


def _provenance(attrs: Mapping[Any, Any]) -> Markup:
    """Return everything that a group says of itself, to be opened."""
    table = table_of_facts([(str(name), told) for name, told in attrs.items()])
    return element("details", element("summary", "Provenance"), table)
