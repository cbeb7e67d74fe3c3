"""What a dataset holds, at a glance: as text in a terminal, as HTML in a notebook."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from hyperpaint.base import schema
from hyperpaint.base.schema import ALONG_TRACK, Quality
from hyperpaint.pictures.figures import data_uri, encode_png

from .facts import Facts, counted, facts_of_bands, facts_of_line, form_of, size_of
from .markup import Markup, element, joined, table_of_facts, void

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["stored_overview", "summary_html", "summary_text"]

_MOST_OVERVIEW_BYTES = 8 * 2**20
_MOST_NAMES = 40

# of the page it is shown on, so that it is at home in the light and in the dark
_STYLE = "font:13px/1.45 system-ui,sans-serif;max-width:72em"
_CELL = "text-align:left;vertical-align:top;padding:1px 10px 1px 0;white-space:pre-line"


def summary_text(dataset: xr.Dataset) -> str:
    """Return what a dataset holds, one fact a line.

    Nothing is computed; small variables of a store, such as its wavelengths, are read.

    Examples
    --------
    >>> from hyperpaint.simulation import simulate_line
    >>> print(summary_text(simulate_line(lines=32, bands=40, columns=24)))   # doctest: +ELLIPSIS
    flight line ...
      counts      32 along_track x 40 band x 24 cross_track, uint16 [count]
      ...
    """
    title, facts = _summary(dataset)
    width = max((len(name) for name, _ in facts), default=0)
    indent = "\n" + " " * (width + 4)
    title, facts = _printable(title), [(_printable(name), _printable(told)) for name, told in facts]
    return "\n".join(
        [title, *(f"  {name.ljust(width)}  {told.replace(chr(10), indent)}" for name, told in facts)]
    )


def summary_html(dataset: xr.Dataset) -> str:
    """Return what a dataset holds, as HTML for a notebook, with its stored picture.

    Nothing is computed; small variables of a store, such as its wavelengths and its overview, are read. Texts
    of the dataset are escaped.
    """
    title, facts = _summary(dataset)
    rows = table_of_facts(facts, style="border-collapse:collapse;border:0")
    rows = Markup(rows.replace("<th ", f'<th style="{_CELL}" ').replace("<td>", f'<td style="{_CELL}">'))
    parts: list[Markup] = [element("strong", title)]
    picture = _told(lambda: stored_overview(dataset), None)
    if picture is not None:
        step = max(1, -(-picture.shape[0] // 480))
        small = np.ascontiguousarray(picture[::step, :: max(1, step // 2)].swapaxes(0, 1))
        parts.append(
            void(
                "img", src=data_uri(encode_png(small)), alt="true colour, along_track to the right",
                style="display:block;margin:6px 0;width:100%;max-width:480px;max-height:240px;"
                "image-rendering:pixelated",
            )
        )  # fmt: skip
    return str(element("div", joined([*parts, rows]), style=_STYLE))


def stored_overview(dataset: xr.Dataset) -> npt.NDArray[np.uint8] | None:
    """Return the picture stored beside a flight line, (line, column, 3); None where it would be computed."""
    if "overview" not in dataset.variables:
        return None
    stored = dataset["overview"]
    row = schema.VARIABLES["overview"]
    # what came out of a store knows the chunks it had there
    at_hand = stored.chunks is None or "chunks" in stored.encoding
    fits = stored.dims == row.dims and stored.dtype == row.dtype and stored.shape[-1] == 3 and stored.size
    if not (at_hand and fits and stored.nbytes <= _MOST_OVERVIEW_BYTES):
        return None
    return np.asarray(stored.values)


def _printable(told: str) -> str:
    """Return a text that a terminal takes for nothing but text."""
    return "".join(sign if sign.isprintable() or sign == "\n" else "\ufffd" for sign in told)


# --- facts -------------------------------------------------------------------------------------------------


def _summary(dataset: xr.Dataset) -> tuple[str, list[tuple[str, str]]]:
    """Return a title and facts. A summary never raises: a dataset may be anything, and its store be gone."""
    dataset = _told(lambda: schema.rename_to_roles(dataset), dataset)
    kind, source = _kind(dataset)
    name = dataset.attrs.get("name") or dataset.attrs.get("title") or ""
    title = f"{kind} {name}".strip()
    facts = _told(lambda: list(source(dataset)), None)
    if facts is None:
        facts = [(str(key), form_of(array)) for key, array in dataset.data_vars.items()][:_MOST_NAMES]
    facts.append(("size", size_of(dataset.nbytes)))
    return title, [(name, told) for name, told in facts if told]


def _told(function: Any, otherwise: Any) -> Any:
    try:
        return function()
    except Exception:  # what cannot be told is left out
        return otherwise


def _kind(dataset: xr.Dataset) -> tuple[str, Any]:
    if "reflectance" in dataset.variables and schema.PAINT in dataset["reflectance"].dims:
        return "paint library", _library
    if ALONG_TRACK in dataset.dims:
        return "flight line", _line
    return "dataset", lambda made: [(str(k), form_of(v)) for k, v in made.data_vars.items()][:_MOST_NAMES]


def _line(line: xr.Dataset) -> Facts:
    yield from facts_of_line(line)
    yield "quality", _flags(line)
    shown = {"counts", "radiance", "reflectance", "irradiance", "exposure_time", "quality", "overview"}
    names = [str(name) for name in line.data_vars if name not in shown]
    yield "also holds", ", ".join(sorted(names)[:_MOST_NAMES])
    yield "can do", ", ".join(_abilities(line))


def _flags(line: xr.Dataset) -> str:
    """Return the share of pixels under every flag, where the flags are in memory."""
    if "quality" not in line.variables:
        return ""
    quality = line["quality"]
    if quality.chunks is not None:
        return "flags, in the store" if "chunks" in quality.encoding else "flags, not computed yet"
    values = quality.values
    if values.dtype.kind not in "ui" or not values.size:
        return ""
    shares = {flag: np.count_nonzero(values & int(flag)) / values.size for flag in Quality}
    told = (f"{str(f.name).lower()} {100 * share:.2g} %" for f, share in shares.items() if share)
    return ", ".join(told) or "no flag set"


def _abilities(line: xr.Dataset) -> Iterator[str]:
    """Yield what may be called, given the variables that are there."""
    names = set(line.variables)
    lit = "irradiance" in names
    if {"counts", "radiance_gain", "exposure_time"} <= names:
        yield ".radiance()"
        if lit:
            yield ".reflectance()"
    elif "radiance" in names and lit:
        yield ".reflectance()"
    if "reflectance" in names or lit:
        yield from (".rgb()", ".quicklook()", ".spectrum(regions)", ".signatures(regions)")


def _library(library: xr.Dataset) -> Facts:
    paints = [str(name) for name in library[schema.PAINT].values]
    more = f" and {len(paints) - _MOST_NAMES} more" if len(paints) > _MOST_NAMES else ""
    yield "paints", f"{counted(len(paints), 'paint')}: {', '.join(paints[:_MOST_NAMES])}{more}"
    yield "reflectance", form_of(library["reflectance"])
    yield from facts_of_bands(library)
    for name, label in (("n", "pixels"), ("n_eff", "independent")):
        if name in library.variables:
            values = np.atleast_1d(library[name].values)
            yield label, f"{values.min():.0f} to {values.max():.0f} a paint"
    for name in ("flightlines", "smoothing", "exclude"):
        found = library.attrs.get(name)
        yield name, ", ".join(map(str, found)) if isinstance(found, list) else str(found or "")
