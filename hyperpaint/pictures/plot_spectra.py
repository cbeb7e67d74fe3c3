"""Spectra of pixels, regions and paints with their spread; overview of a paint library."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.errors import Problem, Problems, SchemaError
from hyperpaint.base.facts import documented, one_of, takes_quantities
from hyperpaint.base.schema import (
    ALONG_TRACK,
    BAND,
    CROSS_TRACK,
    LIBRARY_VARIABLES,
    QUANTILE,
    SIGNATURE,
    Array,
    Quality,
    find,
    flag_names,
    rename_to_roles,
    require,
)
from hyperpaint.light.daylight_colours import ciede2000, lab_of, srgb
from hyperpaint.paints.colours import paint_colours
from hyperpaint.paints.signatures import extract_signatures
from hyperpaint.paints.signatures.pixel_statistics import QUANTILES, gather, summarise
from hyperpaint.radiometry.counts_to_reflectance import radiance, reflectance
from hyperpaint.regions import pixels_of, regions_from

from .figures import axes_or_new, ink_of, label_for, legend_below, new_figure, save_figure

SPREADS = ("quantiles", "sd", "none")
MAX_CURVES = 24  # maximum number of curves in a figure

_MIN_DIFFERENCE = 12.0  # CIEDE2000 difference of colours below which curves get different dashes
_DASHES = ("-", "--", "-.", ":", (0, (6, 1, 1, 1, 1, 1)))


@documented(path="picture", width="figure width")
def spectrum(
    dataset: xr.Dataset,
    regions: Any = None,
    path: str | Path | None = None,
    *,
    pixels: Sequence[int] | Sequence[Sequence[int]] | None = None,
    paints: str | Iterable[str] | None = None,
    spread: str = "quantiles",
    exclude: Quality | int | None = None,
    width: float = 8.0,
    axes: Any = None,
) -> Any:
    """Draw reflectance over wavelength: of regions or pixels of a flight line, or of paints of a library.

    Without irradiance the curves are radiance, and of a raw cube counts; the axis names quantity and unit.
    Curves have the colours of the paints in daylight, with a rim that is visible on light and dark
    backgrounds; curves of similar colours differ in dashes. Eager: of a flight line the blocks with the
    pixels are read.

    Parameters
    ----------
    dataset
        A flight line with reflectance, or with the variables to compute it; a raw cube; or a paint library.
    regions
        Regions of the flight line, see `hyperpaint.read_regions`; the centre of their pixels is drawn, as in
        `hyperpaint.extract_signatures`; of a raw cube the median of all their pixels.
    path
    pixels
        (along_track, cross_track) of a pixel, or several such pairs. A curve is drawn at the wavelengths of
        the pixel's column, with the standard uncertainty where known, and labelled with the flags.
    paints
        Names of paints of the library; by default all.
    spread
        For regions and paints: ``"quantiles"`` shades the middle half and 5 to 95 % of the pixels, ``"sd"``
        one standard deviation, ``"none"`` nothing.
    exclude
    width
    axes

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    FormatError
        The regions cannot be read.
    MissingExtraError
        matplotlib is not installed.
    SchemaError, UnitsError
        The dataset lacks the regions, pixels or paints, or there are more than 24 curves; all problems are
        listed.

    Examples
    --------
    >>> from hyperpaint.simulation import simulate_line
    >>> line = simulate_line(lines=32, bands=40, columns=24)
    >>> figure = spectrum(line, pixels=[(3, 4), (20, 10)])
    >>> [curve.get_label() for curve in figure.axes[0].lines]
    ['(3, 4)', '(20, 10)']
    """
    dataset = rename_to_roles(dataset)
    # a flight line may have the dim signature too, for variables such as the paint of a pixel
    is_library = "reflectance" in dataset and dataset["reflectance"].dims == (SIGNATURE, BAND)
    problems = Problems("spectra cannot be drawn", SchemaError)
    one_of(spread, SPREADS, "spread", problems=problems)
    problems.extend(
        Problem(found, mend=mend, code=code)
        for is_wrong, found, mend, code in (
            (
                is_library and (regions is not None or pixels is not None),
                "a paint library has neither regions nor pixels",
                "pass paints=, or a flight line",
                "option-conflict",
            ),
            (
                not is_library and paints is not None,
                "paints= needs a paint library",
                "pass regions= or pixels=",
                "option-conflict",
            ),
            (
                not is_library and (regions is None) == (pixels is None),
                "a flight line needs either regions or pixels=(along_track, cross_track)",
                "",
                "argument-missing",
            ),
        )
        if is_wrong
    )
    has_pixels = not is_library and pixels is not None
    places = checked_places(dataset, pixels, problems) if has_pixels else np.zeros((0, 2), int)
    problems.raise_if_any()
    axes = axes_or_new(axes, "a picture of spectra", figsize=(width, max(0.56 * width, 4.5)))
    shown, name = (dataset, "reflectance") if is_library else with_shown_cube(dataset)
    if pixels is not None:
        u_names = [f"reflectance_u_{kind}" for kind in ("random", "systematic")]
        names = [u_name for u_name in u_names if name == "reflectance" and u_name in shown]
        cubes = require(shown, [name, *names], "a picture of spectra")
        planes = {"quality": shown["quality"]} if "quality" in shown else {}
        spectra, values = gather(cubes, planes, places[:, 0], places[:, 1], slice(None), {})
        u = np.sqrt(sum(spectra[u_name].astype(np.float64) ** 2 for u_name in names)) if names else None
        draw_pixels([axes], shown, {name: spectra[name]}, values.get("quality"), places, u)
    elif name != "reflectance":
        library = _region_medians(shown, shown[name], regions)
        colours = _curve_colours(library["reflectance"].values, library["wavelength"].values, name)
        _draw_paints(axes, library, colours, None, spread)
    else:
        if not is_library:
            dataset = extract_signatures(dataset, regions, exclude=exclude, members=0, min_pixels=1)
        _draw_paints(axes, dataset, paint_colours(dataset), paints, spread)
    axes.set(xlabel="wavelength [nm]", ylabel=quantity_label(shown[name]))
    axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
    legend_below(axes)
    return save_figure(axes.figure, path)


def shown_quantity(dataset: xr.Dataset) -> str:
    # Return the name of the cube to show: reflectance, else radiance, else counts
    names = set(dataset.variables)
    if "reflectance" in names or not {"counts", "radiance", "values"} & names:
        return "reflectance"
    if not {"counts", "radiance"} & names:  # the header does not name the quantity
        return "values"
    if {"irradiance", "reflectance_gain"} & names:
        return "reflectance"
    return "radiance" if {"radiance", "dark_counts", "radiance_gain"} & names else "counts"


def with_shown_cube(dataset: xr.Dataset) -> tuple[xr.Dataset, str]:
    # Return a line with the cube to show, and its name
    name = shown_quantity(dataset)
    if name not in dataset.variables:
        dataset = {"reflectance": reflectance, "radiance": radiance}[name](dataset)
    return dataset, name


def quantity_label(cube: xr.DataArray) -> str:
    """Return the quantity of a cube with its unit, as the label of an axis.

    Examples
    --------
    >>> quantity_label(xr.DataArray(0, name="counts"))
    'raw counts [count]'
    """
    name = {"reflectance": "reflectance factor", "counts": "raw counts"}.get(str(cube.name), str(cube.name))
    unit = {"reflectance": "1", "counts": "count"}.get(str(cube.name), cube.attrs.get("units", ""))
    powers = unit if unit == "1" else re.sub(r"(-?\d+)", r"$^{\1}$", label_for(unit))
    return f"{label_for(name)} [{powers}]" if unit else label_for(name)


def _region_medians(dataset: xr.Dataset, cube: xr.DataArray, regions: Any) -> xr.Dataset:
    # Return median and spread of a cube over all pixels of regions, in the form of a paint library
    outlines = regions_from(regions)
    summaries, counts = [], []
    for region, (along, across) in zip(outlines, pixels_of(outlines, dataset), strict=True):
        SchemaError.raise_if(
            not along.size,
            f"region {region.name!r} holds no pixel of the line",
            mend="draw it larger, or elsewhere",
            code="region-empty",
        )
        values, _ = gather({"values": cube}, {}, along, across, slice(0, cube.sizes[BAND]), {})
        summaries.append(summarise(values["values"], "median"))
        counts.append(along.size)
    dims = {
        name: (SIGNATURE, *((QUANTILE,) if values.ndim == 2 else ()), BAND)
        for name, values in summaries[0].items()
    }
    variables = {name: (dims[name], np.stack([summary[name] for summary in summaries])) for name in dims}
    axes = {name: dataset[name].variable for name in ("wavelength", "good") if name in dataset.variables}
    coords = {SIGNATURE: list(outlines.names), QUANTILE: list(QUANTILES), "n": (SIGNATURE, counts), **axes}
    return xr.Dataset(variables, coords)


def _curve_colours(values: Array, wavelength: Array, name: str) -> Array:
    # Return colours (curve, rgb) in daylight, white at the highest value for other cubes than reflectance;
    # NaN for fewer than three visible bands
    order = np.argsort(wavelength, kind="stable")
    top = 1.0 if name == "reflectance" else max(1e-30, float(np.nanmax(values, initial=0.0)))
    try:
        return srgb(values[:, order] / top, wavelength[order])
    except SchemaError:
        return np.full((len(values), 3), np.nan)


def styles_of(colours: Array) -> list[dict[str, Any]]:
    # Return colour and dashes of curves from their colours (curve, rgb); similar colours differ in dashes.
    # A curve without a colour (NaN) takes a colour of matplotlib's cycle.
    lab = lab_of(colours)
    styles: list[dict[str, Any]] = []
    for number, colour in enumerate(colours):
        has_colour = bool(np.isfinite(colour).all())
        similar_count = (
            int((ciede2000(lab[:number], lab[number]) < _MIN_DIFFERENCE).sum()) if has_colour else 0
        )
        curve_colour = tuple(np.asarray(colour, np.float64).tolist()) if has_colour else f"C{number % 10}"
        styles.append({"color": curve_colour, "ls": _DASHES[similar_count % len(_DASHES)]})
    return styles


def draw_curve(axes: Any, x: Array, y: Array, style: dict[str, Any], label: str | None = None) -> Any:
    # Draw a curve with a rim that is visible on light and dark backgrounds; return its colour
    from matplotlib.patheffects import Normal, withStroke

    rim = withStroke(linewidth=2.8, foreground=ink_of(axes, 0.45))
    axes.plot(x, y, lw=1.7, label=label, path_effects=[rim, Normal()], **style)
    return style["color"]


# --- paints and regions ------------------------------------------------------------------------------------


def _draw_paints(
    axes: Any, library: xr.Dataset, colours: Array, paints: str | Iterable[str] | None, spread: str
) -> None:
    names = [str(name) for name in library[SIGNATURE].values]
    chosen = [paints] if isinstance(paints, str) else names if paints is None else list(paints)
    problems = Problems("paints cannot be drawn", SchemaError)
    problems.add_if(
        unknown := [name for name in chosen if name not in names],
        f"no paint {', '.join(map(repr, unknown))}",
        expected=", ".join(names),
        code="paint-unknown",
    )
    problems.add_if(
        len(chosen) > MAX_CURVES,
        f"{len(chosen)} curves",
        expected=f"at most {MAX_CURVES}",
        mend="pass fewer names as paints, or see library_overview",
        code="curve-number",
    )
    problems.raise_if_any()
    indices = [names.index(name) for name in chosen]
    for name, index, style in zip(chosen, indices, styles_of(colours[indices]), strict=True):
        paint = library.isel({SIGNATURE: index})
        wavelength = require(paint, ["wavelength"], "a picture of spectra")["wavelength"].values
        is_good = good_bands(paint)
        reflectance = np.where(is_good, paint["reflectance"].values, np.nan)
        count = f" (n = {int(paint['n'])})" if "n" in paint else ""
        draw_band(axes, paint, wavelength, is_good, spread, style["color"])
        draw_curve(axes, wavelength, reflectance, style, label_for(name) + count)


def draw_band(
    axes: Any, paint: xr.Dataset, wavelength: Array, is_good: Array, spread: str, colour: Any
) -> None:
    # Shade the spread of the pixels of one paint of a library; see `spectrum` for ``spread``.
    # ``wavelength`` and ``is_good`` (band,): wavelengths [nm], and the bands to show. A library without this
    # spread is not shaded.
    if spread == "quantiles" and "reflectance_quantiles" in paint:
        levels = paint[QUANTILE].values
        for lower_level, upper_level, shade in ((0.05, 0.95, 0.15), (0.25, 0.75, 0.25)):
            edges = [np.abs(levels - level).argmin() for level in (lower_level, upper_level)]
            if np.allclose(levels[edges], (lower_level, upper_level), atol=1e-6):
                lower, upper = paint["reflectance_quantiles"].values[edges]
                axes.fill_between(wavelength, lower, upper, where=is_good, color=colour, alpha=shade, lw=0)
    elif spread == "sd" and "reflectance_sd" in paint:
        centre, sd = paint["reflectance"].values, paint["reflectance_sd"].values
        axes.fill_between(wavelength, centre - sd, centre + sd, where=is_good, color=colour, alpha=0.25, lw=0)


def good_bands(dataset: xr.Dataset) -> Array:
    # Return which bands are good (band,): all bands for a dataset without ``good``
    good = dataset.variables.get("good")
    return np.ones(dataset.sizes[BAND], bool) if good is None else np.asarray(good.values, bool)


# --- pixels ------------------------------------------------------------------------------------------------


def checked_places(dataset: xr.Dataset, pixels: Any, problems: Problems) -> Array:
    # Return pixels as an array (pixel, 2), along and across the track; add faults to ``problems``
    places = np.atleast_2d(np.asarray(pixels))
    if places.ndim != 2 or places.shape[-1] != 2 or places.dtype.kind not in "iu":
        problems.add(
            f"pixels={pixels!r:.60}",
            expected="whole numbers (along_track, cross_track), or several such pairs",
            code="type-wrong",
        )
        return places
    problems.add_if(
        len(places) > MAX_CURVES,
        f"{len(places)} pixels",
        expected=f"at most {MAX_CURVES}",
        mend="outline them as a region",
        code="curve-number",
    )
    lines, columns = dataset.sizes.get(ALONG_TRACK, 0), dataset.sizes.get(CROSS_TRACK, 0)
    problems.extend(
        Problem(
            f"pixel ({along}, {across}) is outside the line of {lines} lines and {columns} columns",
            code="pixel-outside",
        )
        for along, across in places.tolist()
        if not (0 <= along < lines and 0 <= across < columns)
    )
    return places


def draw_pixels(
    plots: Sequence[Any],
    dataset: xr.Dataset,
    cubes: Mapping[str, Array],
    quality: Array | None,
    places: Array,
    u: Array | None = None,
) -> None:
    # Draw spectra of pixels in their colours, at the wavelengths of their columns, one plot a cube.
    # ``cubes`` (pixel, band) by name, with reflectance; ``quality`` (pixel,); ``u`` (pixel, band): standard
    # uncertainty, shaded.
    wavelength = require(dataset, ["wavelength"], "a picture of spectra")["wavelength"].values
    is_good = good_bands(dataset)
    shift = np.zeros((wavelength.size, dataset.sizes[CROSS_TRACK]))
    if "wavelength_shift" in dataset.variables:
        variable = require(dataset, ["wavelength_shift"], "a picture of spectra")["wavelength_shift"]
        shift = np.broadcast_to(variable.values, shift.shape)
    name = "reflectance" if "reflectance" in cubes else next(iter(cubes))
    styles = styles_of(_curve_colours(np.where(is_good, cubes[name], np.nan), wavelength, name))
    for axes, cube in zip(plots, cubes.values(), strict=True):
        for number, (along, across) in enumerate(places.tolist()):
            nm, values = wavelength + shift[:, across], np.where(is_good, cube[number], np.nan)
            label = pixel_label(along, across, 0 if quality is None else int(quality[number]))
            if u is not None:
                lower, upper = values - u[number], values + u[number]
                axes.fill_between(nm, lower, upper, color=styles[number]["color"], alpha=0.25, lw=0)
            draw_curve(axes, nm, values, styles[number], label)


def pixel_label(along: int, across: int, bits: int) -> str:
    """Return the position of a pixel and its flags as text.

    Examples
    --------
    >>> pixel_label(3, 4, Quality.GLINT | Quality.LOW_SUN)
    '(3, 4): low sun, glint'
    """
    flags = ", ".join(flag_names(bits)).replace("_", " ")
    return f"({along}, {across})" + (f": {flags}" if flags else "")


# --- paint libraries -----------------------------------------------------------------------------------


MAX_PAINTS = 48  # maximum number of paints in a figure

_AXES_INCH = (2.9, 2.1)
# numpy kinds accepted for a dtype of the schema
_ACCEPTED_KINDS = {"float32": "fiu", "float64": "fiu", "int64": "iu", "uint16": "iu", "bool": "b"}


@takes_quantities()
@documented(path="picture", paints="library")
def library_overview(
    paints: xr.Dataset, path: str | Path | None = None, *, columns: int = 4, spread: str = "quantiles"
) -> Any:
    """Draw every paint of a library: a swatch of its colour, its spectrum, and the spread of its pixels.

    Parameters
    ----------
    paints
    path
    columns
    spread
        See `hyperpaint.pictures.spectrum`.

    Returns
    -------
    matplotlib.figure.Figure
        At most 48 paints; if there are more, the title gives the count. All axes have the same scale. Spectra
        have the colours of their paints.

    Raises
    ------
    MissingExtraError
        matplotlib is not installed.
    SchemaError
        The dataset is no paint library, its variables have wrong dims, units or dtypes, or matplotlib cannot
        write this type of picture.

    Examples
    --------
    >>> from hyperpaint.paints import starter_library
    >>> figure = library_overview(starter_library(members=0).isel(signature=[0, 5]))
    >>> figure.axes[0].get_xlabel()
    'wavelength [nm]'
    """
    paints, faults = find_usable(paints)
    problems = Problems("a paint library cannot be drawn", SchemaError)
    problems.extend(Problem(problem, code="variable-unusable") for problem in faults)
    problems.raise_if_any()
    variables = require(paints, ["reflectance", "wavelength"], "an overview", LIBRARY_VARIABLES)
    SchemaError.raise_if(
        not (count := paints.sizes[SIGNATURE]), "the library has no paint to draw", code="library-empty"
    )
    shown_count = min(count, MAX_PAINTS)
    columns = max(1, min(columns, shown_count))
    rows = -(-shown_count // columns)
    size = (_AXES_INCH[0] * columns, _AXES_INCH[1] * rows + 0.4)
    figure = new_figure("a picture of a paint library", figsize=size, layout="constrained")
    from matplotlib.patches import Rectangle

    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    wavelength, is_good = variables["wavelength"].values, good_bands(paints)
    colours = paint_colours(paints)
    for number, axes in enumerate(grid.ravel()):
        if number < shown_count:
            # spread, curve, name, and a swatch of the colour above the axes
            paint, colour = paints.isel({SIGNATURE: number}), colours[number]
            has_colour = bool(np.isfinite(colour).all())
            draw_band(axes, paint, wavelength, is_good, spread, ink_of(axes, 0.6))
            values = np.where(is_good, paint["reflectance"].values, np.nan)
            draw_curve(axes, wavelength, values, styles_of(colour[np.newaxis])[0])
            title = label_for(paint[SIGNATURE].item())
            title += f"  n = {int(paint['n'])}" if "n" in paint else ""
            axes.set_title(title, fontsize="small", loc="left", pad=11 if has_colour else None)
            if has_colour:
                style = {"facecolor": colour.tolist(), "edgecolor": "0.5", "lw": 0.5, "clip_on": False}
                axes.add_patch(Rectangle((0.0, 1.0), 1.0, 0.05, transform=axes.transAxes, **style))
            axes.tick_params(labelsize="small")
        else:
            axes.set_axis_off()
    # the lowest plot of a column has the wavelength axis, also above an incomplete last row
    for number in range(max(0, shown_count - columns), shown_count):
        axes = grid.ravel()[number]
        axes.tick_params(labelbottom=True)
        axes.set_xlabel("wavelength [nm]", fontsize="small")
    grid[0, 0].set_ylim(bottom=min(0.0, grid[0, 0].get_ylim()[0]))
    for axes in grid[:, 0]:
        axes.set_ylabel("reflectance factor [1]", fontsize="small")
    if count > shown_count:
        figure.suptitle(f"the first {shown_count} of {count} paints")
    return save_figure(figure, path)


def find_usable(paints: xr.Dataset) -> tuple[xr.Dataset, list[str]]:
    # Return a library without variables that break the schema, and the problems of these variables.
    # Reads dims, dtypes and attributes only, never values.
    table = LIBRARY_VARIABLES
    names = [name for name in table if name in paints.variables]
    kinds = {name: _ACCEPTED_KINDS.get(table[name].dtype, paints[name].dtype.kind) for name in names}
    # units of variables with a wrong dtype cannot be checked
    numeric = [name for name in names if paints[name].dtype.kind in kinds[name]]
    problems = [
        f"{name!r} is {paints[name].dtype}, expected {table[name].dtype}"
        for name in names
        if name not in numeric
    ]
    usable, faults = find(paints, numeric, table)
    return paints.drop_vars([name for name in names if name not in usable]), [*problems, *map(str, faults)]


def draw_uncertainties(axes: Any, paints: xr.Dataset) -> None:
    # Draw the standard uncertainty of the mean of every paint, and its random part (dashed)
    names = [f"reflectance_u_{kind}" for kind in ("random", "systematic")]
    present = [name for name in names if name in paints.variables]
    first_paints = paints.isel({SIGNATURE: slice(MAX_CURVES)})
    values = require(first_paints, [*present, "wavelength"], "uncertainties", LIBRARY_VARIABLES)
    is_good, nm = good_bands(first_paints), values["wavelength"].values
    uncertainties = [np.where(is_good, values[name].values, np.nan).astype(np.float64) for name in present]
    total = np.sqrt(sum(np.nan_to_num(u) ** 2 for u in uncertainties))
    total[np.isnan(uncertainties).all(axis=0)] = np.nan
    for number, style in enumerate(styles_of(paint_colours(first_paints))):
        draw_curve(
            axes, nm, total[number], {**style, "ls": "-"}, label_for(first_paints[SIGNATURE].values[number])
        )
        if len(present) > 1:
            axes.plot(nm, uncertainties[0][number], ls="--", lw=0.9, color=style["color"])
    axes.set(xlabel="wavelength [nm]", ylabel="standard uncertainty [1]", ylim=(0, None))
    legend_below(axes)
