"""Summary of a dataset: pairs of names and texts, text for a terminal, HTML for a notebook.

HTML comes from macros of ``page.html.j2``: jinja2 escapes every text. A page loads nothing from elsewhere.
"""

import functools
from collections.abc import Callable, Collection, Iterator
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base import (
    ALONG_TRACK,
    BAND,
    IRRADIANCE_TIME,
    IRRADIANCE_WAVELENGTH,
    TIME_UNITS,
    listed,
    schema,
)
from hyperpaint.io.maps.map_grids import Grid, grid_of
from hyperpaint.io.store.budget import counted
from hyperpaint.light.daylight_colours import srgb_hex
from hyperpaint.pictures.figures import data_uri, encode_png, flown_right, orientation_of

if TYPE_CHECKING:
    from markupsafe import Markup

Facts = Iterator[tuple[str, str]]  # names and texts


def facts_of_line(line: xr.Dataset) -> Facts:
    # Yield the facts of a flight line, opened or stored.
    exposure = ""
    if "exposure_time" in line.variables:
        source = line.attrs.get("exposure_source", "")
        text = range_of(np.unique(line["exposure_time"].values) * 1e3, "ms")
        exposure = f"{text} ({source})" if source else text
    samples = counted(line.sizes[IRRADIANCE_TIME], "sample") if "irradiance" in line else ""
    whites = [line.attrs["white_source"]] if "white_tile" in line.attrs else []
    yield from (
        *((name, form_of(line[name])) for name in ("counts", "radiance", "reflectance") if name in line),
        *facts_of_bands(line),
        ("times", times_of(line["time"].values) if "time" in line.coords else ""),
        ("exposure", exposure),
        ("dark", str(line.attrs.get("dark_source", ""))),
        *(("white", f"{source}; tile {line.attrs['white_tile']}") for source in whites),
        ("irradiance", samples and f"{samples} around the line"),
        ("alignment", str(line.attrs.get("alignment", ""))),
    )


def facts_of_map(dataset: xr.Dataset) -> Facts:
    # Yield the facts of a map (y, x): cells, extent, cubes, other variables.
    grid, shape = grid_of(dataset), (dataset.sizes["y"], dataset.sizes["x"])
    arrays = dataset.data_vars.items()
    yield from (
        ("map", f"{shape[0]} x {shape[1]} cells"),
        *(() if grid is None else facts_of_grid(grid, shape)),
        *((str(name), form_of(array)) for name, array in arrays if BAND in array.dims),
        *facts_of_bands(dataset),
        ("resampling", str(dataset.attrs.get("resampling", ""))),
        ("multi hit", str(dataset.attrs.get("multi_hit", ""))),
        ("also holds", ", ".join(sorted(str(name) for name, array in arrays if BAND not in array.dims))),
    )


def facts_of_grid(grid: Grid, shape: tuple[int, int]) -> Facts:
    # Yield cell size, bounds and CRS of a grid (row, col).
    a, b, c, d, e, f = grid.transform
    rows, cols = shape
    x, y = ([p + q * j + r * i for i in (0, rows) for j in (0, cols)] for p, q, r in ((a, b, c), (d, e, f)))
    heading = np.degrees(np.arctan2(-c, -f)) % 360.0
    orientation = "north up" if c == e == 0.0 and f < 0.0 < b else f"up is {heading:.1f} degrees from north"
    yield from (
        ("cells", f"{np.hypot(b, e):.6g} x {np.hypot(c, f):.6g} map units, {orientation}"),
        ("bounds", f"x {min(x):.10g} to {max(x):.10g}, y {min(y):.10g} to {max(y):.10g}"),
        ("crs", "unknown" if grid.wkt is None else f'{grid.wkt}""'.split('"')[1] or grid.wkt),
    )


def facts_of_irradiance(dataset: xr.Dataset) -> Facts:
    # Yield the facts of a series of irradiance.
    yield from (
        ("irradiance", form_of(dataset["irradiance"])),
        ("wavelength", range_of(dataset[IRRADIANCE_WAVELENGTH].values, "nm")),
        ("times", times_of(dataset[IRRADIANCE_TIME].values)),
    )


def form_of(array: xr.DataArray) -> str:
    # Return dims, dtype and units of an array as text.
    shape = " x ".join(f"{size} {dim}" for dim, size in array.sizes.items()) or "scalar"
    units = array.attrs.get("units")
    return f"{shape}, {array.dtype}" + (f" [{units}]" if units else "")


def facts_of_bands(dataset: xr.Dataset) -> Facts:
    # Yield the wavelengths of the bands, and the number of bad ones.
    if "wavelength" not in dataset.coords:
        yield "wavelength", "unknown" if BAND in dataset.dims else ""
        return
    text = range_of(dataset["wavelength"].values, "nm")
    if "fwhm" in dataset.coords:
        text += f", fwhm {range_of(dataset['fwhm'].values, 'nm')}"
    if "good" in dataset.coords and not dataset["good"].values.all():
        text += f", {counted(int((~dataset['good'].values).sum()), 'bad band')}"
    yield "wavelength", text


def range_of(values: Any, units: str, digits: int = 3) -> str:
    # Return the smallest and the largest of numbers, with their unit.
    finite = np.asarray(values, np.float64)
    finite = finite[np.isfinite(finite)]
    if not finite.size:
        return "unknown"
    minimum, maximum = (
        f"{value:.{digits}f}".rstrip("0").rstrip(".") for value in (finite.min(), finite.max())
    )
    return f"{minimum} {units}" if minimum == maximum else f"{minimum} to {maximum} {units}"


def times_of(times: Any) -> str:
    # Return the first and the last of times.
    if times.dtype.kind != "M":
        return f"no times ({times.dtype})"
    dated = times[~np.isnat(times)]
    if not dated.size:
        return "times unknown"
    start, end = (np.datetime_as_string(time, unit="ms") for time in (dated.min(), dated.max()))
    undated = f", {times.size - dated.size} without a time" if dated.size < times.size else ""
    return f"{start} to {end} UTC{undated}"


def with_times(dataset: xr.Dataset) -> xr.Dataset:
    # Return a dataset opened with ``decode_times=False`` with decoded times.
    #
    # Stores of hyperpaint hold times as 64-bit counts of nanoseconds. Times of other programs are decoded by
    # xarray, which imports dask and pint and takes longer than the rest of a summary.
    coded = {name: var for name, var in dataset.variables.items() if " since " in str(var.attrs.get("units"))}
    if any(var.attrs["units"] != TIME_UNITS or var.dtype != np.int64 for var in coded.values()):
        return xr.decode_cf(dataset, mask_and_scale=False)
    times = {
        name: xr.Variable(var.dims, var.values.view("M8[ns]"), fastpath=True) for name, var in coded.items()
    }
    return dataset.assign({name: times[name] for name in times if name in dataset.data_vars}).assign_coords(
        xr.Coordinates({name: times[name] for name in times if name in dataset.coords}, indexes={})
    )


def size_of(count: int) -> str:
    # Return a number of bytes as text.
    units = {1000**3: "GB", 1000**2: "MB", 1000: "kB"}
    size = next((size for size in units if count >= size), None)
    return f"{count} bytes" if size is None else f"{count / size:.1f} {units[size]}"


_MAX_READ_BYTES = 8 * 2**20
_MAX_NAMES = 40

# colours are inherited from the page, in light and in dark themes
_STYLE = "font:13px/1.45 system-ui,sans-serif;max-width:72em"
_CELL = "text-align:left;vertical-align:top;padding:1px 10px 1px 0;white-space:pre-line"


def summary_text(dataset: xr.Dataset, methods: str) -> str:
    """Return a summary of a dataset as text, one fact a line, and the methods of its accessor.

    Nothing is computed; only small variables of a store, such as its wavelengths, are read.

    Examples
    --------
    >>> from hyperpaint.simulation import simulate_line
    >>> print(summary_text(simulate_line(lines=32, bands=40, columns=24), "look: rgb"))   # doctest: +ELLIPSIS
    flight line ...
      counts      32 along_track x 40 band x 24 cross_track, uint16 [count]
      ...
    """
    title, facts = _summary(dataset, methods)
    return table_of_facts(_printable(title), [tuple(map(_printable, pair)) for pair in facts])


def table_of_facts(title: str, facts: Collection[tuple[str, ...]]) -> str:
    # Return the facts with a text below a title, aligned by their names.
    width = max((len(name) for name, _ in facts), default=0)
    indent = "\n" + " " * (width + 4)
    rows = (f"  {name.ljust(width)}  {text.replace(chr(10), indent)}" for name, text in facts if text)
    return "\n".join([title, *rows])


def summary_html(dataset: xr.Dataset, methods: str) -> str:
    # Return a summary of a dataset as HTML for a notebook, with its stored picture.
    #
    # Nothing is computed; only small variables of a store, such as its wavelengths and its overview, are
    # read. Texts of the dataset are escaped.
    title, facts = _summary(dataset, methods)
    src = _attempt(lambda: _picture_of(dataset), "")  # empty for a dataset without lines or columns
    return str(
        page_part(
            "summary",
            title=title,
            pairs=facts,
            src=src,
            style=_STYLE,
            cell_style=_CELL,
            paints=_attempt(lambda: _swatches(dataset), []),
        )
    )


def _picture_of(dataset: xr.Dataset) -> str:
    picture = stored_overview(dataset)
    if picture is None:
        return ""
    step = max(1, -(-picture.shape[0] // 480))
    # without ground positions, which would have to be computed: the declared order of columns is used
    oriented = flown_right(
        picture[::step, :: max(1, step // 2)],
        orientation_of(dataset.drop_vars(["east", "north"], errors="ignore")),
    )
    return data_uri(encode_png(np.ascontiguousarray(oriented)))


def _swatches(dataset: xr.Dataset) -> list[tuple[str, str, str]]:
    # colour, name and number of pixels of the first paints; empty if reading takes long
    if _kind(dataset)[0] != "paint library":
        return []
    library = dataset.isel({schema.SIGNATURE: slice(_MAX_NAMES)})
    if not _is_small_and_stored(dataset["reflectance"]):
        return []
    # loads scipy, which `info` of a cube does not need
    from hyperpaint.paints.paint_libraries import paint_colours

    colours = [srgb_hex(colour) for colour in paint_colours(library)]
    counts = [f"n = {count}" for count in library["n"].values] if "n" in library else [""] * len(colours)
    return list(zip(colours, map(str, library[schema.SIGNATURE].values), counts, strict=True))


def _is_small_and_stored(array: xr.DataArray) -> bool:
    # arrays from a store have its chunks in their encoding; other dask arrays would have to be computed
    return (array.chunks is None or "chunks" in array.encoding) and array.nbytes <= _MAX_READ_BYTES


def stored_overview(dataset: xr.Dataset) -> npt.NDArray[np.uint8] | None:
    # Return the picture stored beside a flight line (line, column, 3); None where it would be computed.
    if "overview" not in dataset.variables:
        return None
    overview = dataset["overview"]
    row = schema.VARIABLES["overview"]
    is_valid = (
        overview.dims == row.dims
        and overview.dtype == row.dtype
        and overview.shape[-1] == 3
        and overview.size
    )
    return np.asarray(overview.values) if is_valid and _is_small_and_stored(overview) else None


def _printable(text: str) -> str:
    return "".join(sign if sign.isprintable() or sign == "\n" else "\ufffd" for sign in text)


# --- facts -------------------------------------------------------------------------------------------------


def _summary(dataset: xr.Dataset, methods: str) -> tuple[str, list[tuple[str, str]]]:
    # a summary leaves out unreadable parts and never raises
    dataset = _attempt(lambda: schema.rename_to_roles(dataset), dataset)
    kind, source = _kind(dataset)
    name = dataset.attrs.get("name") or dataset.attrs.get("title") or ""
    title = f"{kind} {name}".strip()
    facts = _attempt(lambda: list(source(dataset)), None)
    if facts is None:
        facts = list(_forms(dataset))
    facts += [("size", size_of(dataset.nbytes)), ("methods", methods)]
    return title, [(name, fact) for name, fact in facts if fact]


def _attempt(function: Any, otherwise: Any) -> Any:
    try:
        return function()
    except Exception:  # unreadable parts are left out
        return otherwise


def _kind(dataset: xr.Dataset) -> tuple[str, Any]:
    if "reflectance" in dataset.variables and schema.SIGNATURE in dataset["reflectance"].dims:
        return "paint library", _library
    return ("flight line", _line) if ALONG_TRACK in dataset.dims else ("dataset", _forms)


def _forms(dataset: xr.Dataset) -> Facts:
    yield from ((str(name), form_of(dataset[name])) for name in list(dataset.data_vars)[:_MAX_NAMES])


def _line(line: xr.Dataset) -> Facts:
    named_above = {"counts", "radiance", "reflectance", "irradiance", "exposure_time", "quality", "overview"}
    names = [str(name) for name in line.data_vars if name not in named_above]
    yield from (
        *facts_of_line(line),
        ("quality", _flags(line)),
        ("also holds", ", ".join(sorted(names)[:_MAX_NAMES])),
        ("can do", ", ".join(_abilities(line))),
    )


def _flags(line: xr.Dataset) -> str:
    if "quality" not in line.variables:
        return ""
    quality = line["quality"]
    if quality.chunks is not None:
        return "flags, in the store" if "chunks" in quality.encoding else "flags, not computed yet"
    values = quality.values
    if values.dtype.kind not in "ui" or not values.size:
        return ""
    texts = (f"{str(f.name).lower()} {100 * share:.2g} %" for f, share in schema.flag_shares(values).items())
    return ", ".join(texts) or "no flag set"


def _abilities(line: xr.Dataset) -> Iterator[str]:
    names = set(line.variables)
    has_light = bool({"irradiance", "reflectance_gain"} & names)
    has_radiance = {"counts", "radiance_gain", "exposure_time"} <= names
    if has_radiance:
        yield ".radiance()"
    if has_light and (has_radiance or {"radiance", "reflectance_gain"} & names):
        yield ".reflectance()"
    if "reflectance" in names or has_light:
        yield from (".rgb()", ".quicklook()", ".spectrum(regions)", ".signatures(regions)")
    elif {"counts", "radiance"} & names:
        yield from (".rgb()", ".quicklook()")


def _library(library: xr.Dataset) -> Facts:
    paints = [str(name) for name in library[schema.SIGNATURE].values]
    yield from (
        ("paints", f"{counted(len(paints), 'paint')}: {listed(paints, _MAX_NAMES)}"),
        ("reflectance", form_of(library["reflectance"])),
        *facts_of_bands(library),
    )
    for name, label in (("n", "pixels"), ("n_eff", "independent")):
        if name in library.variables:
            values = np.atleast_1d(library[name].values)
            yield label, f"{values.min():.0f} to {values.max():.0f} a paint"
    for name in ("flightlines", "smoothing", "exclude"):
        entry = library.attrs.get(name)
        yield name, ", ".join(map(str, entry)) if isinstance(entry, list) else str(entry or "")


Part: TypeAlias = "tuple[str, Callable[[], Markup]]"  # name of a part, and the function that draws it

MAX_TEXT_CHARS = 2000

_LAYOUT = frozenset("\n\t")
# characters that change the writing direction of the text around them
_BIDIRECTIONAL = frozenset("\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069\u200e\u200f\u061c")


def page_part(name: str, **content: object) -> "Markup":
    """Return a part of a page, made by a macro of ``page.html.j2`` from cleaned and escaped texts.

    Examples
    --------
    >>> print(page_part("paragraph", text="1 < 2"))
    <p class="note">1 &lt; 2</p>
    """
    part: Markup = getattr(_macros(), name)(**content)
    return part


@functools.cache
def _macros() -> Any:
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("hyperpaint", "report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        finalize=plain_text,
    )
    return environment.get_template("page.html.j2").module


def plain_text(value: object) -> object:
    """Return a text without control characters, cut to `MAX_TEXT_CHARS`; finished markup stays unchanged.

    Examples
    --------
    >>> plain_text("one" + chr(7))
    'one\ufffd'
    """
    if hasattr(value, "__html__"):
        return value
    text = str(value)
    printable = "".join(
        char if char in _LAYOUT or (char.isprintable() and char not in _BIDIRECTIONAL) else "\ufffd"
        for char in text[:MAX_TEXT_CHARS]
    )
    return printable + ("..." if len(text) > MAX_TEXT_CHARS else "")
