"""Pictures of a flight line: spectra with their spread, colours, flags, layers, calibration."""

import json
import math
import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from hyperpaint.base import (
    ALONG_TRACK,
    BAND,
    CROSS_TRACK,
    IRRADIANCE_TIME,
    IRRADIANCE_WAVELENGTH,
    LIBRARY_VARIABLES,
    MEMBER,
    QUANTILE,
    SIGNATURE,
    STEP,
    VARIABLES,
    Array,
    Bools,
    Problem,
    Problems,
    Quality,
    SchemaError,
    as_path,
    documented,
    find,
    finite_mean,
    flag_names,
    flag_shares,
    flags_named,
    good_bands,
    grouped,
    has_own_overview,
    is_number,
    label_digest,
    numbers_of,
    one_of,
    rename_to_roles,
    require,
    schema,
    takes_quantities,
)
from hyperpaint.calibration.calibration_dataset import fitted_lines
from hyperpaint.geometry.orthorectification.mapping import orthorectify
from hyperpaint.kernels.overviews import mix_bands
from hyperpaint.light.daylight_colours import ciede2000, encode_srgb, lab_of, srgb, srgb_weights
from hyperpaint.paints.paint_libraries import paint_colours
from hyperpaint.paints.signatures import EXCLUDED, extract_signatures
from hyperpaint.paints.signatures.pixel_statistics import QUANTILES, excluded_of, gather, summarise
from hyperpaint.radiometry.counts_to_reflectance import radiance, reflectance
from hyperpaint.radiometry.panels import CLOSURE, PANEL_STATES
from hyperpaint.regions import Region, Regions, pixels_of, regions_from

from .figures import (
    BLUE,
    COLOURS,
    GREEN,
    ORANGE,
    PURPLE,
    VERMILION,
    axes_or_new,
    axes_width,
    check_picture,
    columns_for,
    ink_of,
    label_axes,
    label_for,
    legend_below,
    map_dims,
    new_figure,
    orientation_of,
    save_figure,
    show_picture,
)

if TYPE_CHECKING:
    from hyperpaint.validation import Validation


SPREADS = ("quantiles", "sd", "none")
MAX_CURVES = 24  # maximum number of curves in a figure

_MIN_DIFFERENCE = 12.0  # CIEDE2000 difference of colours below which curves get different dashes
_DASHES = ("-", "--", "-.", ":", (0, (6, 1, 1, 1, 1, 1)))


@takes_quantities()
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
    with Problems("spectra cannot be drawn", SchemaError) as problems:
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
        cube = shown[name]
        # median and spread of the cube over all pixels of regions, in the form of a paint library
        outlines = regions_from(regions)
        summaries, counts = [], []
        for region, (along, across) in zip(outlines, pixels_of(outlines, shown), strict=True):
            SchemaError.raise_if(
                not along.size,
                f"region {region.name!r} holds no pixel of the line",
                mend="draw it larger, or elsewhere",
                code="region-empty",
            )
            read, _ = gather({"values": cube}, {}, along, across, slice(0, cube.sizes[BAND]), {})
            summaries.append(summarise(read["values"], "median"))
            counts.append(along.size)
        dims = {
            key: (SIGNATURE, *((QUANTILE,) if summary.ndim == 2 else ()), BAND)
            for key, summary in summaries[0].items()
        }
        library = xr.Dataset(
            {key: (dims[key], np.stack([summary[key] for summary in summaries])) for key in dims},
            {
                SIGNATURE: list(outlines.names),
                QUANTILE: list(QUANTILES),
                "n": (SIGNATURE, counts),
                **{key: shown[key].variable for key in ("wavelength", "good") if key in shown.variables},
            },
        )
        colours = _curve_colours(library["reflectance"].values, library["wavelength"].values, name)
        _draw_paints(axes, library, colours, None, spread)
    else:
        if not is_library:
            dataset = extract_signatures(dataset, regions, exclude=exclude, members=0, min_pixels=1)
        _draw_paints(axes, dataset, paint_colours(dataset), paints, spread)
    label_axes(axes, ylabel=quantity_label(shown[name]), ylim=(min(0.0, axes.get_ylim()[0]), None))
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


def draw_curve(axes: Any, x: Array, y: Array, style: dict[str, Any], label: str | None = None) -> None:
    # Draw a curve with a rim that is visible on light and dark backgrounds
    from matplotlib.patheffects import Normal, withStroke

    rim = withStroke(linewidth=2.8, foreground=ink_of(axes, 0.45))
    axes.plot(x, y, lw=1.7, label=label, path_effects=[rim, Normal()], **style)


# --- paints and regions ------------------------------------------------------------------------------------


def _draw_paints(
    axes: Any, library: xr.Dataset, colours: Array, paints: str | Iterable[str] | None, spread: str
) -> None:
    names = [str(name) for name in library[SIGNATURE].values]
    chosen = [paints] if isinstance(paints, str) else names if paints is None else list(paints)
    with Problems("paints cannot be drawn", SchemaError) as problems:
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
    indices = [names.index(name) for name in chosen]
    for name, index, style in zip(chosen, indices, styles_of(colours[indices]), strict=True):
        paint = library.isel({SIGNATURE: index})
        count = f" (n = {int(paint['n'])})" if "n" in paint else ""
        _draw_paint(axes, paint, spread, style["color"], style, label_for(name) + count)


def _draw_paint(
    axes: Any, paint: xr.Dataset, spread: str, colour: Any, style: dict[str, Any], label: str | None = None
) -> None:
    # Draw the curve of one paint of a library above the spread of its pixels, shaded in ``colour``; see
    # `spectrum` for ``spread``. A library without this spread is not shaded.
    wavelength = require(paint, ["wavelength"], "a picture of spectra")["wavelength"].values
    is_good = good_bands(paint)
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
    draw_curve(axes, wavelength, np.where(is_good, paint["reflectance"].values, np.nan), style, label)


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
    if absent := [dim for dim in (ALONG_TRACK, CROSS_TRACK) if dim not in dataset.sizes]:
        problems.add(
            f"the line has no dim {' and '.join(absent)}, and its pixels have no positions",
            mend=f"select a list of one: isel({absent[0]}=[5])",
            code="dim-missing",
        )
        return places
    lines, columns = dataset.sizes[ALONG_TRACK], dataset.sizes[CROSS_TRACK]
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
    shift: Any = 0.0
    if "wavelength_shift" in dataset.variables:
        shift = require(dataset, ["wavelength_shift"], "a picture of spectra")["wavelength_shift"].values
    shift = np.broadcast_to(shift, (wavelength.size, dataset.sizes[CROSS_TRACK]))
    name = "reflectance" if "reflectance" in cubes else next(iter(cubes))
    styles = styles_of(_curve_colours(np.where(is_good, cubes[name], np.nan), wavelength, name))
    for axes, cube in zip(plots, cubes.values(), strict=True):
        for number, (along, across) in enumerate(places.tolist()):
            nm, values = wavelength + shift[:, across], np.where(is_good, cube[number], np.nan)
            bits = 0 if quality is None else int(quality[number])
            flags = ", ".join(flag_names(bits)).replace("_", " ")
            label = f"({along}, {across})" + (f": {flags}" if flags else "")
            if u is not None:
                lower, upper = values - u[number], values + u[number]
                axes.fill_between(nm, lower, upper, color=styles[number]["color"], alpha=0.25, lw=0)
            draw_curve(axes, nm, values, styles[number], label)


# --- paint libraries -----------------------------------------------------------------------------------


MAX_PAINTS = 48  # maximum number of paints in a figure

_CURVES_INCH = (2.9, 2.1)
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
    with Problems("a paint library cannot be drawn", SchemaError) as problems:
        problems.extend(Problem(problem, code="variable-unusable") for problem in faults)
    require(paints, ["reflectance", "wavelength"], "an overview", LIBRARY_VARIABLES)
    SchemaError.raise_if(
        not (count := paints.sizes[SIGNATURE]), "the library has no paint to draw", code="library-empty"
    )
    shown_count = min(count, MAX_PAINTS)
    columns = max(1, min(columns, shown_count))
    rows = -(-shown_count // columns)
    figure = new_figure(
        "a picture of a paint library",
        figsize=(_CURVES_INCH[0] * columns, _CURVES_INCH[1] * rows + 0.4),
        layout="constrained",
    )
    from matplotlib.patches import Rectangle

    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    colours = paint_colours(paints)
    for number, axes in enumerate(grid.ravel()):
        if number < shown_count:
            # spread, curve, name, and a swatch of the colour above the axes
            paint, colour = paints.isel({SIGNATURE: number}), colours[number]
            has_colour = bool(np.isfinite(colour).all())
            _draw_paint(axes, paint, spread, ink_of(axes, 0.6), styles_of(colour[np.newaxis])[0])
            title = label_for(paint[SIGNATURE].item()) + (f"  n = {int(paint['n'])}" if "n" in paint else "")
            axes.set_title(title, fontsize="small", loc="left", pad=11 if has_colour else None)
            if has_colour:
                axes.add_patch(
                    Rectangle(
                        (0.0, 1.0),
                        1.0,
                        0.05,
                        transform=axes.transAxes,
                        facecolor=colour.tolist(),
                        edgecolor="0.5",
                        lw=0.5,
                        clip_on=False,
                    )
                )
            axes.tick_params(labelsize="small")
            # the lowest plot of a column has the wavelength axis, also above an incomplete last row
            if number >= shown_count - columns:
                axes.tick_params(labelbottom=True)
                axes.set_xlabel("wavelength [nm]", fontsize="small")
        else:
            axes.set_axis_off()
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
    label_axes(axes, ylabel="standard uncertainty [1]", ylim=(0, None))


OVERVIEW_SHAPE = (1000, 640)  # maximum lines and columns of the stored picture
STRETCH = (2.0, 98.0)  # percentiles of brightness shown black and white


@takes_quantities()
def rgb(
    dataset: xr.Dataset, *, stretch: tuple[float, float] = STRETCH, lines: int | None = None
) -> xr.DataArray:
    """Return a true-colour picture: reflectance through the CIE 1931 observer to sRGB.

    Without irradiance the picture shows radiance, and of a raw cube the counts: only a preview, because these
    also have the colour of the light and of the camera. ``long_name`` of the picture names the quantity.

    Lazy; computing it reads every band between 380 and 780 nm.

    Parameters
    ----------
    dataset
        A flight line with ``reflectance``, or with the variables to compute it, or a raw cube, and
        ``wavelength`` (band).
    stretch
        Percentiles of brightness shown black and white, taken over about 64 lines; (0, 100) shows reflectance
        from 0 to 1, radiance and counts from minimum to maximum.
    lines
        Maximum picture height [lines]; longer flight lines are subsampled; all lines by default. With the
        default stretch, a stored overview with enough lines is read instead of the cube; the attribute
        ``level`` names the source. A dataset without a cube shows its overview.

    Returns
    -------
    (along_track, cross_track, rgb), float32
        sRGB from 0 to 1, with the coordinates of the pixels; for a map (y, x, rgb), with its ``spatial_ref``.
        Saturated pixels are white: some of their bands have no value, or no band has one and ``quality`` is
        saturated. Other pixels without a value are black. The array is named ``true_colour``; dim ``rgb`` has
        the labels ``red``, ``green``, ``blue``: ``picture.hvplot.rgb(x="x", y="y", bands="rgb")``,
        ``picture.transpose("rgb", "y", "x").rio.to_raster(...)``.

    Raises
    ------
    SchemaError
        There is no cube, there are fewer than three visible bands, or an option is out of range.

    Examples
    --------
    >>> from hyperpaint.simulation import simulate_line
    >>> line = simulate_line(lines=32, bands=40, columns=24)
    >>> picture = rgb(line)
    >>> picture.sizes["along_track"], picture["rgb"].values.tolist(), float(picture.max()) <= 1.0
    (32, ['red', 'green', 'blue'], True)
    """
    dataset = rename_to_roles(dataset)
    is_range = np.shape(stretch) == (2,) and all(map(is_number, stretch))
    for is_fault, found, expected in (
        (lines is not None and lines < 1, f"lines={lines}", "1 line of the picture or more"),
        (
            not is_range or not 0.0 <= stretch[0] < stretch[1] <= 100.0,
            f"stretch={stretch!r:.40}",
            "two percentiles from 0 to 100, such as (2, 98)",
        ),
    ):
        SchemaError.raise_if(is_fault, found, expected=expected, code="value-out-of-range")
    has_cube = bool({"reflectance", "counts", "radiance", "values"} & set(dataset.variables))
    if lines is not None or not has_cube:
        step = max(1, -(-dataset.sizes.get(ALONG_TRACK, 1) // lines)) if lines else None
        picture_of_store = stored_picture(dataset, step, at_most=True) if stretch == STRETCH else None
        if picture_of_store is not None:
            return picture_of_store
        if has_cube and step:
            subsample = dataset.isel({ALONG_TRACK: slice(None, None, step)}, missing_dims="ignore")
            return rgb(subsample, stretch=stretch).assign_attrs(
                level=f"cube, every {step}. line and 1. column"
            )
    dataset, shown_name = with_shown_cube(dataset)
    cube = dataset[shown_name]
    wavelength = require(dataset, ["wavelength"], "a true-colour picture")["wavelength"].values
    visible = visible_bands(wavelength)
    shift = None
    if "wavelength_shift" in dataset.variables:
        shifts = require(dataset, ["wavelength_shift"], "a true-colour picture")["wavelength_shift"]
        shift = (shifts.isel({BAND: visible}) if BAND in shifts.dims else shifts).values
    source = cube.isel({BAND: visible})
    if source.chunks is not None:
        source = source.chunk({BAND: -1, CROSS_TRACK: -1})
    source = source.transpose(..., BAND, CROSS_TRACK)
    linear = xr.apply_ufunc(
        linear_srgb,
        source,
        kwargs={"weights": srgb_weights(wavelength[visible], shift)},
        input_core_dims=[[BAND, CROSS_TRACK]],
        output_core_dims=[[CROSS_TRACK, "rgb"]],
        dask="parallelized",
        output_dtypes=[np.float32],
        dask_gufunc_kwargs={"output_sizes": {"rgb": 3}},
    ).drop_vars(["wavelength", "fwhm", "good", "wavelength_shift"], errors="ignore")
    renamed_dims = map_dims(cube)
    dims = [dim for dim in source.dims if dim != BAND]
    is_absolute = shown_name == "reflectance" and stretch == (0.0, 100.0)
    black, white = (np.float32(0.0), np.float32(1.0)) if is_absolute else _levels(linear, dims[0], stretch)
    scaled = ((linear - black) / np.maximum(white - black, np.float32(1e-6))).clip(0.0, 1.0)
    if "quality" in dataset.variables and set(dataset["quality"].dims) == set(dims):
        saturated = (dataset["quality"].reset_coords(drop=True) & Quality.SATURATED.value) != 0
        is_black = (linear == 0.0).all("rgb").reset_coords(drop=True)
        scaled = scaled.where(~(saturated & is_black), np.float32(1.0))
    picture: xr.DataArray = xr.apply_ufunc(
        encode_srgb, scaled, dask="parallelized", output_dtypes=[np.float32]
    )
    picture = picture.transpose(*dims, "rgb").rename("true_colour")
    axes = {name: (name, cube[name].values, cube[name].attrs) for name in renamed_dims.values()}
    coords = {**axes, "rgb": ("rgb", ["red", "green", "blue"])}
    picture = picture.drop_vars(list(axes)).rename(renamed_dims).assign_coords(coords)
    titles = {
        "reflectance": "True colour",
        "radiance": "Colours of radiance",
        "counts": "Colours of raw counts",
        "values": "Colours of values",
    }
    picture.attrs = {
        "long_name": f"{titles[shown_name]} (sRGB)",
        "stretch": f"{stretch[0]:g} to {stretch[1]:g} %",
        **{key: value for key, value in (cube.attrs | cube.encoding).items() if key == "grid_mapping"},
    }
    return picture


def visible_bands(wavelength: Array) -> Array:
    # Return the indices of the visible bands; SchemaError for fewer than three
    visible = np.flatnonzero((wavelength > 380) & (wavelength < 780))
    SchemaError.raise_if(
        visible.size < 3,
        f"{visible.size} bands between 380 and 780 nm",
        expected="three or more for a true-colour picture",
        code="band-missing",
    )
    return visible


def stored_picture(dataset: xr.Dataset, step: int | None, *, at_most: bool = False) -> xr.DataArray | None:
    # Return the stored overview, subsampled to about every ``step``-th line, in the form of `rgb`.
    # None without an overview; for a crop of a line, or a line in another order; where the cube has been
    # changed since; or if the overview has fewer lines than requested. With ``step`` None all lines are
    # returned. ``at_most``: the step is rounded up instead of down.
    row = VARIABLES["overview"]
    if "overview" not in dataset.variables or set(dataset["overview"].dims) != set(row.dims):
        return None
    overview = dataset["overview"].transpose(*row.dims)
    attrs = [overview.attrs.get(name) for name in ("line_step", "column_step")]
    steps = [int(number) if isinstance(number, int | np.integer) else 0 for number in attrs]
    # a crop keeps the overview of its complete line, whose shape differs
    sizes = [dataset.sizes.get(dim, 0) for dim in (ALONG_TRACK, CROSS_TRACK)]
    shape = [-(-size // number) for size, number in zip(sizes, steps, strict=True) if number > 0 and size]
    has_shape = min(steps) > 0 and not any(a != b for a, b in zip(shape, overview.shape, strict=False))
    if not has_shape or not has_own_overview(dataset) or (step is not None and steps[0] > step):
        return None
    stride = 1 if step is None else -(-step // steps[0]) if at_most else step // steps[0]
    values = overview[::stride].astype(np.float32) / np.float32(255.0)
    every_line, every_column = steps[0] * stride, steps[1]
    picture = xr.DataArray(
        values.data,
        {"rgb": ["red", "green", "blue"]},
        (ALONG_TRACK, CROSS_TRACK, "rgb"),
        "true_colour",
        {
            "long_name": "True colour (sRGB)",
            "stretch": f"{STRETCH[0]:g} to {STRETCH[1]:g} %",
            "level": f"overview, every {every_line}. line and {every_column}. column",
        },
    )
    for dim, number in {ALONG_TRACK: every_line, CROSS_TRACK: every_column}.items():
        axis = dataset.coords.get(dim)
        if axis is not None and axis.dims == (dim,):
            picture = picture.assign_coords({dim: axis[::number].variable})
    return picture


def linear_srgb(values: Array, *, weights: Array) -> Array:
    # Return linear sRGB (..., column, 3) of spectra (..., band, column); missing bands make pixels white
    *lines, bands, columns = values.shape
    colours = np.empty((math.prod(lines), columns, 3), np.float32)
    cube = np.ascontiguousarray(values, np.float32).reshape(-1, bands, columns)
    mix_bands(cube, np.array(np.broadcast_to(weights, (3, bands, columns)), order="C"), colours)
    return colours.reshape(*lines, columns, 3)


def _levels(linear: xr.DataArray, lines: Any, stretch: tuple[float, float]) -> tuple[Any, Any]:
    # brightness shown black and white (lazy), from about 64 lines
    sample = linear.isel({lines: slice(None, None, max(1, linear.sizes[lines] // 64))})
    if sample.chunks is not None:
        sample = sample.chunk(-1)
    levels = xr.apply_ufunc(
        _percentiles,
        sample.transpose(..., "rgb"),
        input_core_dims=[list(sample.dims)],
        kwargs={"stretch": stretch},
        output_core_dims=[["level"]],
        dask="parallelized",
        output_dtypes=[np.float32],
        dask_gufunc_kwargs={"output_sizes": {"level": 2}},
    )
    return levels.isel(level=0), levels.isel(level=1)


def _percentiles(picture: Array, *, stretch: tuple[float, float]) -> Array:
    brightness = picture.mean(axis=-1)[picture.any(axis=-1)]
    return np.asarray(np.percentile(brightness if brightness.size else [0.0], stretch), np.float32)


def overview(dataset: xr.Dataset) -> xr.DataArray | None:
    # Return a small true-colour picture of a flight line to be stored, (overview_y, overview_x, rgb).
    #
    # Lazy, computed from the slabs being written, so that a cube is read once. uint8, at most
    # `OVERVIEW_SHAPE`; None with fewer than three visible bands.
    dims = ALONG_TRACK, CROSS_TRACK
    steps = {dim: -(-dataset.sizes[dim] // size) for dim, size in zip(dims, OVERVIEW_SHAPE, strict=True)}
    subsample = dataset[[name for name in ("reflectance", "quality") if name in dataset.variables]].isel(
        {dim: slice(None, None, step) for dim, step in steps.items()}
    )
    try:
        picture = rgb(subsample)
    except SchemaError:  # fewer than three visible bands
        return None
    row = VARIABLES["overview"]
    pixels = (picture * np.float32(255.0) + np.float32(0.5)).astype(np.uint8).reset_coords(drop=True)
    pixels = pixels.drop_vars(list(pixels.coords)).rename(dict(zip(pixels.dims, row.dims, strict=True)))
    pixels.attrs = {
        **row.attrs,
        "line_step": steps[dims[0]],
        "column_step": steps[dims[1]],
        "labels": label_digest(dataset),
    }
    return pixels.rename("overview")


@takes_quantities()
@documented(path="picture")
def quicklook(
    dataset: xr.Dataset, path: str | Path | None = None, *, lines: int = 1000, width: float = 11.0
) -> Any:
    """Draw a flight line: true colour, flags, irradiance over time, spread of reflectance.

    Eager: computes a picture of at most ``lines`` lines.

    Parameters
    ----------
    dataset
        A flight line with reflectance, or with the variables to compute it; or a raw cube, see `rgb`.
    path
    lines
    width
        Width of the figure [inch]; below 8 the plots stand one above the other.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    MissingExtraError
        matplotlib is not installed.
    SchemaError
        Reflectance and the variables to compute it are missing; or matplotlib cannot write this type of
        picture.

    Examples
    --------
    >>> from hyperpaint.simulation import simulate_line
    >>> line = simulate_line(lines=32, bands=40, columns=24)
    >>> figure = quicklook(line)
    >>> [axes.get_title() for axes in figure.axes][:2]
    ['simulated line: true colour', 'flags']
    """
    is_wide = columns_for(width, 4.0, 2) > 1
    figure = new_figure("a quicklook", figsize=(width, 8.0 if is_wide else 15.0), layout="constrained")
    dataset = rename_to_roles(dataset)
    if "reflectance" in dataset.variables and "quality" not in dataset.variables:
        dataset = reflectance(dataset)
    dataset, cube_name = with_shown_cube(dataset)
    has_flags = "quality" in dataset.variables
    # a cube without a named quantity has no row of the table
    require(dataset, ["quality"] * has_flags + [cube_name] * (cube_name != "values"), "a quicklook")
    step = max(1, dataset.sizes[ALONG_TRACK] // lines)
    orientation = orientation_of(dataset)
    dataset = dataset.isel({ALONG_TRACK: slice(None, None, step)})
    names = ("flags", "light", "spectra")
    mosaic = [["picture", name] for name in names] if is_wide else [["picture"], *([name] for name in names)]
    plots = figure.subplot_mosaic(mosaic, height_ratios=(1.3, 1.0, 1.0) if is_wide else (2.0, 1.0, 1.0, 1.0))
    show_picture(plots["picture"], rgb(dataset).values, orientation)
    content = "true colour" if cube_name == "reflectance" else cube_name
    title = f"{label_for(dataset.attrs.get('name', 'flight line'))}: {content}"
    plots["picture"].set_title(title + (f", every {step}th line" if step > 1 else ""))
    # bars of the share of pixels with each flag
    axes = plots["flags"]
    if has_flags:
        shares = flag_shares(flags_of(dataset))
        labels = [name.replace("_", " ") for name in flag_names(sum(shares))] or ["no flag set"]
        lengths = [100 * share for share in shares.values()] or [0.0]
        bars = axes.barh(labels, lengths, height=0.6, color="#b5543c")
        axes.bar_label(bars, [f" {percent(share)}" for share in shares.values()] or [""], fontsize="small")
        axes.set(
            title="flags",
            xlabel="share of pixels [%]",
            xlim=(0, 1.3 * axes.get_xlim()[1]),
            ylim=(max(len(labels), 8) - 0.4, -0.6),
        )
    else:
        axes.set_axis_off()
    draw_irradiance(plots["light"], dataset)
    draw_spread(plots["spectra"], dataset, cube_name)
    return save_figure(figure, path)


def flags_of(dataset: xr.Dataset) -> Array:
    # Return the flags of all pixels (along_track, cross_track) as integers
    quality = require(dataset, ["quality"], "a picture of flags")["quality"]
    SchemaError.raise_if(
        quality.dtype.kind not in "iu",
        f"quality is {quality.dtype}",
        expected="uint16, one bit a flag",
        code="type-wrong",
    )
    return np.asarray(quality.values)


def flag_label(flag: Quality) -> str:
    # Return the name of a flag with spaces
    return str(flag.name).lower().replace("_", " ")


def percent(share: float) -> str:
    """Return a share as text in per cent; 0 % and 100 % stand only for exactly 0 and 1.

    Examples
    --------
    >>> percent(0.30756), percent(0.00065), percent(2e-6), percent(0.9999), percent(1.0)
    ('31 %', '0.065 %', '< 0.001 %', '> 99 %', '100 %')
    """
    if 0 < share < 1e-5:
        return "< 0.001 %"
    return "> 99 %" if 0.995 <= share < 1.0 else f"{float(f'{100 * share:.2g}'):g} %"


def draw_irradiance(axes: Any, dataset: xr.Dataset) -> None:
    # Draw irradiance over time at three wavelengths, and the time of the line, if known
    if "irradiance" not in dataset.variables:
        axes.set_axis_off()
        return
    series = require(dataset, ["irradiance"], "a picture of irradiance")["irradiance"]
    moments = series.coords.get(IRRADIANCE_TIME)
    SchemaError.raise_if(
        moments is None or not moments.size or moments.dtype.kind != "M",
        "a picture of irradiance needs the coordinate irradiance_time with at least one time",
        code="variable-missing",
    )
    series = series.compute()
    start = series[IRRADIANCE_TIME].values[0]
    seconds = (series[IRRADIANCE_TIME].values - start) / np.timedelta64(1, "s")
    samples = series[IRRADIANCE_WAVELENGTH].values
    for nm, colour in ((450.0, BLUE), (550.0, GREEN), (850.0, VERMILION)):
        if samples.min() <= nm <= samples.max():
            axes.plot(
                seconds, series.values[:, np.abs(samples - nm).argmin()], color=colour, label=f"{nm:.0f} nm"
            )
    times = dataset["time"].values if "time" in dataset.coords else np.empty(0, "datetime64[ns]")
    line_seconds = (times[~np.isnat(times)] - start) / np.timedelta64(1, "s")
    if line_seconds.size:
        axes.axvspan(line_seconds.min(), line_seconds.max(), color=ink_of(axes, 0.15), zorder=0, label="line")
    day, _, clock = str(start)[:19].partition("T")
    label_axes(
        axes,
        title=f"irradiance, {day}",
        xlabel=f"time after {clock} UTC [s]",
        ylabel="irradiance [W m$^{-2}$ nm$^{-1}$]",
        ylim=(0, 1.05 * axes.get_ylim()[1]),
    )


def draw_spread(axes: Any, dataset: xr.Dataset, name: str = "reflectance") -> None:
    # Draw the quantiles of a cube over the pixels, band by band
    sample = dataset[name].isel({ALONG_TRACK: slice(None, None, max(1, dataset.sizes[ALONG_TRACK] // 50))})
    values = sample.transpose(..., BAND).astype(np.float32).values.reshape(-1, sample.sizes[BAND])
    styles = [{"color": ink_of(axes, strength)} for strength in (0.12, 0.3, 0.9)]
    draw_quantiles(axes, dataset["wavelength"].values, values, styles)
    label_axes(axes, title=f"{name} of all pixels", ylabel=quantity_label(dataset[name]), ylim=(0, None))


def draw_quantiles(axes: Any, wavelength: Array, values: Array, styles: Sequence[dict[str, Any]]) -> None:
    # Draw median, middle half and 5 to 95 % of samples (sample, band).
    # ``styles``: of the 5 to 95 %, of the middle half, and of the median.
    quantiles = finite_quantiles(values, QUANTILES)
    for lower, label in enumerate(("5 to 95 %", "middle half")):
        axes.fill_between(wavelength, quantiles[lower], quantiles[4 - lower], label=label, **styles[lower])
    axes.plot(wavelength, quantiles[2], label="median", **styles[2])


def finite_quantiles(values: Array, levels: Sequence[float]) -> Array:
    """Return quantiles (level, band) of finite samples (sample, band); NaN in bands without a finite sample.

    Examples
    --------
    >>> finite_quantiles(np.array([[1.0, np.nan], [3.0, np.nan]]), [0.5])
    array([[ 2., nan]])
    """
    quantiles = np.full((len(levels), values.shape[1]), np.nan)
    has_value = np.isfinite(values).any(axis=0)
    quantiles[:, has_value] = np.nanquantile(values[:, has_value], levels, axis=0)
    return quantiles


# --- flags and layers --------------------------------------------------------------------------------------


@takes_quantities()
@documented(path="picture", width="figure width")
def flag_overlay(
    dataset: xr.Dataset,
    flags: Quality | int | str | Iterable[str] | None = None,
    path: str | Path | None = None,
    *,
    layer: str | None = None,
    lines: int = 1000,
    opacity: float = 0.75,
    width: float = 6.8,
    axes: Any = None,
) -> Any:
    """Draw flags, or a continuous layer, over the true-colour picture of a flight line.

    Eager. In a subsampled picture a pixel combines several pixels of the line: all their flags, and the
    maximum of a layer. Of several flags on a pixel the rarest is shown. Shares count all pixels of the line.

    Parameters
    ----------
    dataset
        A flight line with ``quality``, or with the variables to compute it.
    flags
        Flags to draw: `Quality`, its bits, or names such as ``"glint"``; by default all flags that occur, or
        with a layer no flags.
    path
    layer
        Name of a variable (along_track, cross_track), such as a fraction of glint.
    lines
    opacity
        Opacity of flags or layer, from 0 to 1.
    width
    axes

    Returns
    -------
    matplotlib.figure.Figure
        x is cross_track, y is along_track, flown upwards, in pixels of the flight line; for a map x and y of
        the map, north up. The picture is not mirrored; pixels have their aspect ratio on the ground where
        known.

    Raises
    ------
    MissingExtraError
        matplotlib is not installed.
    SchemaError
        A flag or the layer does not exist, or quality and the variables to compute it are missing.

    Examples
    --------
    >>> from hyperpaint.simulation import simulate_line
    >>> line = simulate_line(lines=32, bands=40, columns=24)
    >>> figure = flag_overlay(line, ["saturated", "shadow"])
    >>> figure.axes[0].get_xlabel()
    'cross_track [column]'
    """
    dataset = rename_to_roles(dataset)
    chosen: tuple[Quality, ...] = ()  # all flags
    if isinstance(flags, int):
        chosen = tuple(flag for flag in Quality if flag & flags)
    elif flags is not None:
        chosen = tuple(flags_named([flags] if isinstance(flags, str) else map(str, flags)))
    planes = [
        str(name)
        for name, array in dataset.variables.items()
        if set(array.dims) == {ALONG_TRACK, CROSS_TRACK} and array.dtype.kind in "fiub"
    ]
    SchemaError.raise_if(
        layer is not None and layer not in planes,
        f"no layer {layer!r} on (along_track, cross_track)",
        expected=", ".join(planes) or "a line with layers",
        code="variable-missing",
    )
    if "quality" not in dataset.variables and (layer is None or chosen):
        dataset = reflectance(dataset)
    require(dataset, ["quality"] if layer is None else [], "a picture of flags")
    step = max(1, -(-dataset.sizes[ALONG_TRACK] // max(lines, 1)))
    orientation = orientation_of(dataset)
    height = min(max(orientation.height_of(0.6 * width), 3.5), 12.0) + 1.0
    axes = axes_or_new(axes, "a picture of flags", figsize=(width, height))
    show_picture(axes, background(dataset, step), orientation)
    axes.set(title=label_for(dataset.attrs.get("name", "flight line")))
    if layer is not None:
        # draw a layer that is transparent at zero and has full opacity from a third of its range
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import Normalize

        array = dataset[layer].transpose(ALONG_TRACK, CROSS_TRACK)
        values = reduced_lines(array.values.astype(np.float32), step, np.fmax)
        finite = values[np.isfinite(values)]
        minimum, maximum = np.percentile(finite, (0.2, 99.8)).tolist() if finite.size else (0.0, 0.0)
        is_signed = (
            -minimum > 0.05 * max(maximum, 0.0) and minimum < 0
        )  # values slightly below zero are noise
        limit = max(abs(minimum), abs(maximum)) if is_signed else maximum
        limit = limit if limit > 0 else 1.0
        colours = ScalarMappable(
            Normalize(-limit if is_signed else 0.0, limit), "PuOr_r" if is_signed else "inferno"
        )
        image = show_picture(
            axes, np.ma.masked_invalid(values), orientation, cmap=colours.cmap, norm=colours.norm
        )
        magnitude = np.abs(values) if is_signed else np.maximum(values, 0.0)
        image.set_alpha(np.nan_to_num(opacity * np.clip(3.0 * magnitude / limit, 0.0, 1.0)))
        units = str(array.attrs.get("units", ""))
        caption = f"{label_for(layer)} [{label_for(units)}]" if units else label_for(layer)
        options = {"location": "bottom", "pad": 0.02} if axes_width(axes) < _NARROW_INCH else {"pad": 0.01}
        axes.figure.colorbar(colours, ax=axes, label=caption, fraction=0.04, **options)
    if layer is None or chosen:
        # draw flags in their colours, the rarest on top, with a legend of shares
        from matplotlib.colors import to_rgb
        from matplotlib.patches import Patch

        quality = flags_of(dataset)
        shares = flag_shares(quality)
        drawn = chosen or tuple(shares)
        bits = reduced_lines(quality, step, np.bitwise_or)
        picture = np.zeros((*bits.shape, 4), np.float32)
        for flag in sorted(drawn, key=lambda flag: -shares.get(flag, 0.0)):
            picture[(bits & int(flag)) != 0] = (*to_rgb(flag.colour), opacity)
        show_picture(axes, picture, orientation)
        labels = {flag: f"{flag_label(flag)}  {percent(shares.get(flag, 0.0))}" for flag in drawn}
        entries = {
            label: Patch(facecolor=flag.colour, edgecolor="0.5", lw=0.5) for flag, label in labels.items()
        } or {"no flag set": Patch(facecolor="none")}
        title = "share of pixels"
        if axes_width(axes) < _NARROW_INCH:
            legend_below(axes, entries=entries, title=title, alignment="left")
        else:
            axes.legend(
                entries.values(),
                entries.keys(),
                fontsize="small",
                frameon=False,
                title=title,
                loc="upper left",
                bbox_to_anchor=(1.0, 1.0),
            )
    return save_figure(axes.figure, path)


def background(dataset: xr.Dataset, step: int) -> Array:
    # Return a picture (line, column, rgb) of every ``step``-th line, 0 to 1, stored or computed.
    overview = stored_picture(dataset, step)
    if overview is None:
        overview = rgb(dataset.isel({ALONG_TRACK: slice(None, None, step)}))
    return np.asarray(overview.values)


def draw_outlines(
    axes: Any, regions: Iterable[Region], *, width: float = 1.0, colour: str = "white", named: bool = True
) -> None:
    # Outline regions (sensor coordinates) with their names on axes of `flag_overlay`
    from matplotlib.patheffects import withStroke

    rim = [withStroke(linewidth=2.5, foreground="black")]
    for region in regions:
        for ring in (region.polygon, *region.holes):
            x, y = np.vstack([ring, ring[:1]]).T
            axes.plot(x, y, color=colour, lw=width, path_effects=rim)
        if named:
            across, along = region.polygon.mean(axis=0)
            axes.text(
                across,
                along,
                label_for(region.name),
                path_effects=rim,
                color="white",
                fontsize="x-small",
                ha="center",
                va="center",
                clip_on=True,
            )


_NARROW_INCH = 5.0  # width of a picture below which its legend is below it


def reduced_lines(values: Array, step: int, combine: Any) -> Array:
    # Combine every ``step`` lines into one by the ufunc ``combine``
    return (
        values if step == 1 else np.asarray(combine.reduceat(values, np.arange(0, len(values), step), axis=0))
    )


# --- scenes above the spectra of their cars ----------------------------------------------------------------

#: Line styles of scenes that share a plot.
_STYLES = ("-", ":", "--", "-.")


@documented(path="picture")
def scenes_and_spectra(
    lines: Mapping[str, xr.Dataset],
    regions: Any,
    path: str | Path | None = None,
    *,
    variable: str | Mapping[str, str] = "radiance",
    together: bool = True,
    width: float = 11.0,
) -> Any:
    """Draw scenes side by side, and below them mean spectra of their regions.

    These are figures 1 and 6 of the paper, and S1 to S4 of its supplement. Eager: the pixels of the regions
    and the visible bands are read.

    Parameters
    ----------
    lines
        Flight lines or renders by name, such as the name of their light; at most four.
    regions
        Regions of all scenes, see `hyperpaint.read_regions`; or a mapping with the regions of every scene.
    path
    variable
        Variable (along_track, band, cross_track) whose mean over a region is drawn; or a mapping with the
        variable of every scene.
    together
        Draw all spectra in one plot, with a line style for every scene; False draws them below their scene.
    width
        Width of the figure [inch].

    Returns
    -------
    matplotlib.figure.Figure
        Regions have the colours of their spectra.

    Raises
    ------
    MissingExtraError
        matplotlib is not installed.
    SchemaError
        There is no scene, or more than four; a scene lacks its variable; a region contains no pixel; or
        matplotlib cannot write this type of picture.

    Examples
    --------
    >>> from hyperpaint.simulation import simulate_line
    >>> line = simulate_line(lines=32, bands=40, columns=24)
    >>> grass = Region("grass", [(0, 0), (0, 31), (0.4, 31), (0.4, 0)])
    >>> figure = scenes_and_spectra({"noon": line}, [grass], variable="counts")
    >>> [axes.get_ylabel() for axes in figure.axes][1]
    'counts [count]'
    """
    SchemaError.raise_if(
        not 1 <= len(lines) <= len(_STYLES),
        f"{len(lines)} scenes",
        expected=f"1 to {len(_STYLES)}",
        code="value-out-of-range",
    )
    figure = new_figure("a picture of scenes", figsize=(width, 0.75 * width), layout="constrained")
    grid, below = figure.add_gridspec(2, len(lines)), None
    for number, (name, scene) in enumerate(lines.items()):
        line = rename_to_roles(scene)
        quantity = variable if isinstance(variable, str) else variable[name]
        require(line, [quantity], "spectra of a scene")
        places = regions_from(regions[name] if isinstance(regions, Mapping) else regions)
        above = figure.add_subplot(grid[0, number])
        show_picture(above, np.asarray(rgb(line).values), orientation_of(line))
        above.set(title=label_for(name), xlabel="", ylabel="")
        if below is None or not together:
            below = figure.add_subplot(grid[1, :] if together else grid[1, number])
        for index, (region, (along, across)) in enumerate(zip(places, pixels_of(places, line), strict=True)):
            SchemaError.raise_if(
                not along.size, f"region {region.name!r} contains no pixel of {name!r}", code="region-empty"
            )
            colour = COLOURS[index % len(COLOURS)]
            draw_outlines(above, [region], colour=colour, named=False)
            style = _STYLES[number] if together else "-"
            label = label_for(region.name) if style == "-" else None
            mean = finite_mean(_spectra_at(line[quantity], along, across), axis=0)
            below.plot(line["wavelength"].values, mean, style, color=colour, label=label)
        if together:
            below.plot([], [], _STYLES[number], color=ink_of(below), label=label_for(name))
        label_axes(below, ylabel=f"{quantity} [{line[quantity].attrs.get('units', '')}]", ylim=(0.0, None))
    return save_figure(figure, path)


# --- light of neighbours -------------------------------------------------------------------------------


# colours of up to four bands by rising wavelength; more bands take matplotlib's colours
_COLOURS = (BLUE, GREEN, VERMILION, PURPLE)
_NEAR_COLOUR, _FAR_COLOUR = VERMILION, "#808080"
_QUARTILES = (0.25, 0.75)


@takes_quantities(wavelengths="nm")
@documented(path="picture")
def adjacency_figure(
    line: xr.Dataset,
    near: Any,
    far: Any,
    path: str | Path | None = None,
    *,
    without: xr.Dataset | None = None,
    wavelengths: Sequence[float] = (450.0, 550.0, 650.0, 850.0),
    width: int = 5,
    figure_width: float = 15.0,
) -> Any:
    r"""Draw the light that a coloured neighbour adds to a surface: picture, transect, spectra near and far.

    Eager: the blocks of lines are read that hold the pixels.

    Parameters
    ----------
    line
        A flight line with ``reflectance`` and ``wavelength``; ``adjacency``, from
        `hyperpaint.surroundings.flag`, is drawn along the transect as well.
    near, far
        Regions of the same surface, beside the neighbour and away from it, see
        `hyperpaint.regions.regions_from`. The transect leads from the centre of ``near`` to that of ``far``.
    path
    without
        The same scene without the neighbour's colour, such as another render, drawn dashed.
    wavelengths
        Wavelengths of the bands along the transect [nm].
    width
        Width of the transect, which is averaged [pixel].
    figure_width
        Width of the figure [inch]; below 10 the plots stand one above the other.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    MissingExtraError
        matplotlib is not installed.
    SchemaError, UnitsError
        Reflectance or wavelength is missing; ``without`` has another size; a region holds no pixel, or both
        regions have the same centre; ``width`` is not positive. All problems are listed.

    Notes
    -----
    A neighbour of reflectance :math:`\rho_n` adds :math:`F \rho_n` to the light of a surface, with F the part
    of its hemisphere that the lit neighbour fills, which increases towards the neighbour.

    Examples
    --------
    >>> from hyperpaint.simulation import simulate_line
    >>> from hyperpaint.regions import Region
    >>> line = simulate_line(lines=32, bands=40, columns=24).paint.reflectance()
    >>> near = Region("near", [(2, 2), (6, 2), (6, 6), (2, 6)])
    >>> far = Region("far", [(2, 20), (6, 20), (6, 24), (2, 24)])
    >>> len(adjacency_figure(line, [near], [far]).axes)
    4
    """
    is_wide = columns_for(figure_width, 5.0, 3) > 1
    figure = new_figure(
        "a figure of adjacency", figsize=(figure_width, 5.6 if is_wide else 14.0), layout="constrained"
    )
    line = rename_to_roles(line)
    variables = require(line, ["reflectance", "wavelength"], "a figure of adjacency")
    lines = {"": line} if without is None else {"": line, "without": rename_to_roles(without)}
    regions = _checked_regions(lines, near, far, width)
    places = pixels_of(regions, line)
    # pixels (step, width, 2) from the centre of the near region to that of the far one, and distances [pixel]
    start, stop = (np.array([np.mean(along), np.mean(across)]) for along, across in places)
    length = float(np.hypot(*(stop - start)))
    SchemaError.raise_if(
        length < 1.0,
        "adjacency cannot be drawn: both regions have the same centre",
        mend="choose regions at different distances from the neighbour",
        code="region-overlap",
    )
    direction = (stop - start) / length
    distance = np.arange(int(length) + 1, dtype=np.float64)
    offset = np.arange(width) - (width - 1) / 2
    positions = (
        start
        + distance[:, None, None] * direction
        + offset[None, :, None] * np.array([-direction[1], direction[0]])
    )
    last = (line.sizes[ALONG_TRACK] - 1, line.sizes[CROSS_TRACK] - 1)
    route = np.clip(np.floor(positions + 0.5).astype(np.intp), 0, last)
    nm = variables["wavelength"].values
    order = np.argsort(nm, kind="stable")
    plots = (
        figure.subplot_mosaic(
            [["picture", "along", "spectra"], ["picture", "added", "spectra"]],
            width_ratios=(0.9, 1.2, 1.2),
            height_ratios=(3, 2),
        )
        if is_wide
        else figure.subplot_mosaic([["picture"], ["along"], ["added"], ["spectra"]])
    )
    # picture with the outlines of both regions, and the transect as an arrow
    axes = plots["picture"]
    show_picture(axes, background(line, 1), orientation_of(line))
    for region, colour in zip(regions, (_NEAR_COLOUR, _FAR_COLOUR), strict=True):
        outline = np.vstack([region.polygon, region.polygon[:1]]).T
        axes.plot(*outline, color="white", linewidth=3.0)
        axes.plot(*outline, color=colour, linewidth=1.5)
    rows, columns = numbers_of(line, ALONG_TRACK), numbers_of(line, CROSS_TRACK)
    tail, head = ((columns[across], rows[along]) for along, across in route[[0, -1], width // 2])
    for thickness, colour in ((3.0, "white"), (1.2, "black")):
        axes.annotate(
            "", head, tail, arrowprops={"arrowstyle": "->", "color": colour, "linewidth": thickness}
        )
    transects = {}
    for name, dataset in lines.items():
        cube = require(dataset, ["reflectance"], "a figure of adjacency")["reflectance"]
        style, is_labelled = ("--", False) if name else ("-", True)
        transects[name] = finite_mean(
            _spectra_at(cube, *route.reshape(-1, 2).T).reshape(*route.shape[:2], -1), axis=1
        )
        _draw_bands(plots["along"], distance, transects[name], nm, wavelengths, style, is_labelled)
        for region, place, colour in zip(regions, places, (_NEAR_COLOUR, _FAR_COLOUR), strict=True):
            # mean of the region's pixels; for the line itself also their middle half
            spectra, axes = _spectra_at(cube, *place)[:, order], plots["spectra"]
            mean = finite_mean(spectra, axis=0)
            if is_labelled:
                is_finite = np.isfinite(mean)
                lower, upper = np.nanquantile(spectra[:, is_finite], _QUARTILES, axis=0)
                axes.fill_between(nm[order][is_finite], lower, upper, color=colour, alpha=0.15, linewidth=0)
            axes.plot(
                nm[order], mean, style, color=colour, label=label_for(region.name) if is_labelled else None
            )
    if without is not None:
        _draw_bands(
            plots["added"], distance, transects[""] - transects["without"], nm, wavelengths, "-", False
        )
    if "adjacency" in line.variables:
        layer = line["adjacency"].transpose(ALONG_TRACK, CROSS_TRACK).values
        adjacency = finite_mean(layer[route[..., 0], route[..., 1]], axis=1)
        ink = ink_of(plots["added"])
        plots["added"].plot(
            distance, adjacency, ":", color=ink, linewidth=1.8, label="adjacency, as flagged [1]"
        )
    # labels and legends
    plots["along"].set(ylabel="reflectance factor [1]")
    plots["added"].set(xlabel="distance from the near end [pixel]", ylabel="added [1]")
    plots["spectra"].set(xlabel="wavelength [nm]", ylabel="reflectance factor [1]", ylim=(0, None))
    plots["along"].tick_params(labelbottom=False)
    plots["along"].sharex(plots["added"])
    for name in ("along", "added", "spectra"):
        axes = plots[name]
        axes.spines[["top", "right"]].set_visible(False)
        if without is not None and name != "added":
            axes.plot([], [], "--", color="0.4", label="without the neighbour's colour")
    legend_below(plots["spectra"])
    if plots["added"].lines:
        legend_below(plots["added"], plots["along"])
    else:
        plots["added"].set_axis_off()
        plots["along"].tick_params(labelbottom=True)
        label_axes(plots["along"], xlabel=plots["added"].get_xlabel())
    return save_figure(figure, path)


def _checked_regions(lines: dict[str, xr.Dataset], near: Any, far: Any, width: int) -> Any:
    line, *comparisons = lines.values()
    shape = dict(line["reflectance"].sizes)
    with Problems("adjacency cannot be drawn", SchemaError) as problems:
        problems.extend(
            Problem(
                "without= has no reflectance of the line's size",
                expected=f"shape {shape}",
                code="grid-mismatch",
            )
            for comparison in comparisons
            if "reflectance" not in comparison.variables or dict(comparison["reflectance"].sizes) != shape
        )
        problems.add_if(width < 1, f"width={width}", expected="1 or more pixels", code="value-out-of-range")
        pairs = [regions_from(regions) for regions in (near, far)]
        problems.extend(
            Problem(f"{name}= holds {len(regions)} regions", expected="one", code="region-number")
            for name, regions in zip(("near", "far"), pairs, strict=True)
            if len(regions) != 1
        )
        problems.raise_if_any()
        pair = type(pairs[0])((pairs[0][0], pairs[1][0]), pairs[0].coordinates, pairs[0].crs)
        problems.extend(
            Problem(f"region {region.name!r} holds no pixel of the line", code="region-empty")
            for region, (along, _) in zip(pair, pixels_of(pair, line), strict=True)
            if not along.size
        )
    return pair


def _spectra_at(cube: xr.DataArray, along: Array, across: Array) -> Array:
    spectra, _ = gather({"reflectance": cube}, {}, along, across, slice(0, cube.sizes[BAND]), {})
    return spectra["reflectance"].astype(np.float64)


def _draw_bands(
    axes: Any,
    distance: Array,
    values: Array,
    nm: Array,
    wavelengths: Sequence[float],
    style: str,
    is_labelled: bool,
) -> None:
    bands = [int(np.nanargmin(np.abs(nm - nm_chosen))) for nm_chosen in wavelengths]
    colours = _COLOURS if len(bands) <= len(_COLOURS) else [f"C{number}" for number in range(len(bands))]
    for band, colour in zip(bands, colours, strict=False):
        name = f"{nm[band]:.0f} nm" if is_labelled else None
        axes.plot(
            distance, values[:, band], style, color=colour, linewidth=1.5 if is_labelled else 1.0, label=name
        )


# --- counts, radiance and reflectance ----------------------------------------------------------------------


MAX_REGION_PIXELS = 4096  # pixels drawn in a triptych; larger regions are subsampled
_LEAST_TERM = 0.002  # Minimum part of the uncertainty of a level that a card lists, relative.
_AXES_INCH = (4.3, 4.4)


@takes_quantities()
@documented(path="picture")
def triptych(
    dataset: xr.Dataset,
    region: Any = None,
    path: str | Path | None = None,
    *,
    pixels: Sequence[int] | Sequence[Sequence[int]] | None = None,
    exclude: Quality | int | None = None,
    width: float = 13.0,
) -> Any:
    r"""Draw a region, or single pixels, as counts, as radiance and as reflectance, side by side.

    Eager: the blocks of lines with the pixels are read. For a region, curves are medians over the pixels, and
    shades are their middle half and 5 to 95 %; regions of more than 4096 pixels are subsampled. Single pixels
    have a curve in the colour of the pixel, also if they are flagged: figure 2, b to d, of the paper.

    Parameters
    ----------
    dataset
        A flight line with ``counts`` and their calibration.
    region
        A `hyperpaint.Region`, or any input of `hyperpaint.read_regions` with one region.
    pixels
        Instead of a region: (along_track, cross_track) of a pixel, or several such pairs.
    path
    exclude
    width
        Width of the figure [inch]; below 8.6 the plots stand one above the other.

    Returns
    -------
    matplotlib.figure.Figure
        Three axes. Counts are drawn with dark counts and saturation count, radiance with the radiance of
        a white surface, :math:`\pi^{-1} E`, at the time nearest to the region.

    Raises
    ------
    FormatError
        The region cannot be read.
    MissingExtraError
        matplotlib is not installed.
    SchemaError, UnitsError
        There is more than one region, all of its pixels are excluded, or pixels lie outside the line; or the
        flight line lacks variables to compute reflectance.

    Examples
    --------
    >>> from hyperpaint.simulation import simulate_line
    >>> from hyperpaint.regions import Region
    >>> line = simulate_line(lines=32, bands=40, columns=24)
    >>> figure = triptych(line, Region("grass", [(0, 0), (0, 31), (0.4, 31), (0.4, 0)]))
    >>> [axes.get_title() for axes in figure.axes]
    ['counts', 'radiance', 'reflectance']
    """
    columns = 3 if columns_for(width, _AXES_INCH[0], 3) == 3 else 1
    figure = new_figure("a triptych", figsize=(width, _AXES_INCH[1] * (3 // columns)), layout="constrained")
    dataset = rename_to_roles(dataset)
    counts = require(dataset, ["counts", "wavelength"], "a triptych")["counts"]
    SchemaError.raise_if(
        (region is None) == (pixels is None),
        "a triptych shows either a region or pixels=(along_track, cross_track)",
        mend="pass one of the two",
        code="option-conflict",
    )
    calibrated = reflectance(dataset)
    cubes = {
        "counts": counts,
        "radiance": radiance(dataset)["radiance"],
        "reflectance": calibrated["reflectance"],
    }
    plots = figure.subplots(3 // columns, columns, squeeze=False).ravel()
    wavelength = dataset["wavelength"].values
    if pixels is not None:
        with Problems("pixels cannot be drawn", SchemaError) as problems:
            places = checked_places(dataset, pixels, problems)
        line_indices, column_indices = places.T
        spectra, values = gather(
            cubes, {"quality": calibrated["quality"]}, line_indices, column_indices, slice(None), {}
        )
        draw_pixels(plots, dataset, spectra, values["quality"], places)
    else:
        outlined = regions_from(region)
        SchemaError.raise_if(
            len(outlined) != 1,
            f"a triptych shows one region, found {len(outlined)}",
            mend="choose one, such as regions[0]",
            code="region-number",
        )
        line_indices, column_indices = pixels_of(outlined, dataset)[0]
        step = max(1, -(-line_indices.size // MAX_REGION_PIXELS))
        line_indices, column_indices = line_indices[::step], column_indices[::step]
        spectra, values = gather(
            cubes, {"quality": calibrated["quality"]}, line_indices, column_indices, slice(None), {}
        )
        # pixels without excluded flags that have a reflectance
        excluded = int(EXCLUDED if exclude is None else exclude)
        is_used = ((values["quality"] & excluded) == 0) & np.isfinite(spectra["reflectance"]).any(axis=1)
        name, count = outlined[0].name, line_indices.size
        SchemaError.raise_if(
            not is_used.any(),
            f"region {name!r}: all {count} pixels are flagged",
            mend="draw the region elsewhere, or pass fewer flags as exclude",
            code="region-empty",
        )
        figure.suptitle(f"{label_for(name)}: {int(is_used.sum())} of {count} pixels")
        line_indices, column_indices = line_indices[is_used], column_indices[is_used]
        for axes, cube in zip(plots, spectra.values(), strict=True):
            samples = np.where(good_bands(dataset), cube[is_used], np.nan)
            shades = [{"color": BLUE, "alpha": alpha, "lw": 0} for alpha in (0.2, 0.4)]
            draw_quantiles(axes, wavelength, samples, [*shades, {"color": BLUE, "lw": 1.6}])
    # dark counts of these columns, and the saturation count
    dark, saturation = (dataset.variables.get(name) for name in ("dark_counts", "saturation_count"))
    if dark is not None and dark.dims == (BAND, CROSS_TRACK):
        level = np.median(dark.values[:, np.unique(column_indices)], axis=1)
        plots[0].plot(wavelength, level, color=ink_of(plots[0], 0.7), lw=1, ls="--", label="dark")
    if saturation is not None and saturation.ndim == 0:
        plots[0].axhline(float(saturation), color=VERMILION, lw=1, ls=":", label="saturation")
    _draw_white(plots[1], dataset, line_indices)
    for axes, name in zip(plots, cubes, strict=True):
        label_axes(axes, title=name, ylabel=quantity_label(cubes[name]), ylim=(0, None))
    return save_figure(figure, path)


def _draw_white(axes: Any, dataset: xr.Dataset, line_indices: Array) -> None:
    # radiance of a white surface at the median time of the pixels, in the camera's wavelength range
    if "irradiance" not in dataset.variables or "time" not in dataset.coords:
        return
    series = require(dataset, ["irradiance"], "a triptych")["irradiance"]
    times = dataset["time"].values[line_indices]
    times = times[~np.isnat(times)]
    if not times.size:
        return
    sample = np.abs(series[IRRADIANCE_TIME].values - np.sort(times)[times.size // 2]).argmin()
    nm = series[IRRADIANCE_WAVELENGTH].values
    min_nm, max_nm = axes.get_xlim()
    is_shown = (nm >= min_nm) & (nm <= max_nm)
    white = series.isel({IRRADIANCE_TIME: int(sample)}).values[is_shown] / np.pi
    axes.plot(nm[is_shown], white, color=ink_of(axes, 0.7), lw=1, ls="--", label="white surface")


# --- before and after straightening ------------------------------------------------------------------------

_MAX_LINES = 1500  # maximum lines of the raw picture, and rows of the map


@documented(path="picture")
def straightening(
    line: xr.Dataset,
    orthomap: xr.Dataset | None = None,
    path: str | Path | None = None,
    *,
    width: float = 11.0,
) -> Any:
    """Draw a flight line as recorded beside its map: figure 3 of the paper.

    Eager: the visible bands are read.

    Parameters
    ----------
    line
        A flight line with reflectance, or with the variables to compute it. Without ``orthomap`` it must be
        located, or have the attribute ``ground``; it is then mapped north up.
    orthomap
        Its map from `hyperpaint.geometry.orthorectify`.
    path
    width
        Width of the figure [inch]; below 6 the map stands below the line.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    MissingExtraError
        matplotlib is not installed.
    SchemaError
        Reflectance is missing, or there are fewer than three visible bands; or without ``orthomap`` the line
        is not located.

    Examples
    --------
    >>> from hyperpaint.geometry import locate
    >>> from hyperpaint.simulation import simulate_line
    >>> line = locate(simulate_line(lines=64, bands=12, columns=48), ground=160.0)
    >>> figure = straightening(line)
    >>> len(figure.axes)
    2
    """
    line = rename_to_roles(line)
    if "reflectance" not in line.variables:
        line = reflectance(line)
    if orthomap is None:
        SchemaError.raise_if(
            not {"east", "north"} <= set(line.coords) and "ground" not in line.attrs,
            "the line is not located and declares no ground height, so it has no map",
            mend="pass line.paint.locate(...), or its map as orthomap",
            code="line-not-located",
        )
        nm = require(line, ["wavelength"], "a map")["wavelength"].values
        # quality tells saturated glint, which is white, from missing pixels, which are black
        orthomap = orthorectify(
            line.isel({BAND: np.flatnonzero((nm > 380) & (nm < 780))}),
            grid="north",
            variables=[name for name in ("reflectance", "quality") if name in line.variables],
        )
    columns = columns_for(width, 3.0, 2)
    datasets = (("as recorded", line), ("straightened", rename_to_roles(orthomap)))
    orientations = [orientation_of(dataset) for _, dataset in datasets]
    heights = [
        min(0.8 * orientation.height_of(width / columns - 0.9), 9.0) + 1.1 for orientation in orientations
    ]
    height = max(heights) if columns == 2 else sum(heights)
    figure = new_figure("a line before and after", figsize=(width, height + 0.3), layout="constrained")
    grid = figure.add_gridspec(2 // columns, columns, height_ratios=heights if columns == 1 else None)
    for number, (title, dataset) in enumerate(datasets):
        axes = figure.add_subplot(grid[divmod(number, columns)])
        steps = {dim: max(1, dataset.sizes[dim] // _MAX_LINES) for dim in (ALONG_TRACK, CROSS_TRACK)}
        subsample = dataset.isel({dim: slice(None, None, step) for dim, step in steps.items()})
        show_picture(axes, rgb(subsample).values, orientations[number])
        axes.set_title(title)
    figure.suptitle(label_for(line.attrs.get("name", "flight line")))
    return save_figure(figure, path)


Values = dict[str, Any]

_NARROW_GAIN_INCH = 4.4  # width of axes below which their colour bar is below them
_LAMP_LINES_SHOWN = 5
_MAX_COLUMNS = 200  # maximum number of columns drawn in one plot

_DIMS: dict[str, tuple[str, ...]] = {
    "wavelength": (BAND,),
    "fwhm": (BAND,),
    "good": (BAND,),
    "wavelength_shift": (BAND, CROSS_TRACK),
    "responsivity": (BAND, CROSS_TRACK),
    "radiance_gain_u_random": (BAND, CROSS_TRACK),
    "radiance_gain_u_systematic": (BAND, CROSS_TRACK),
    "step_wavelength": (STEP,),
    "line_centre": (STEP, CROSS_TRACK),
    "line_own_fwhm": (STEP, CROSS_TRACK),
    "line_trusted": (STEP, CROSS_TRACK),
}


@documented(path="picture")
def calibration_report(
    calibration: xr.Dataset,
    sweep: xr.Dataset | None = None,
    path: str | Path | None = None,
    *,
    column: int | None = None,
    width: float = 15.0,
) -> Any:
    """Draw the result of a lab sweep on one page.

    Fits of some lamp lines, residuals of the wavelength map, smile, width of the bands, responsivity, and
    uncertainty of the gain. Bands without a gain are shaded.

    Parameters
    ----------
    calibration
        Result of `hyperpaint.calibrate`.
    sweep
        The lab sweep of the calibration, for the counts of the lamp lines: five steps are read. Without it
        only the fits are drawn.
    path
    column
        Column whose lamp lines are shown and whose curve is highlighted; by default the central lit column.
    width
        Width of the figure [inch]; each of the six plots takes 4.5.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    MissingExtraError
        matplotlib is not installed.
    SchemaError
        The calibration does not come from a sweep, the sweep has other sizes than its calibration, ``column``
        is outside the camera, or matplotlib cannot write this type of picture.

    Examples
    --------
    >>> from hyperpaint.calibration import calibrate
    >>> from hyperpaint.simulation import simulate_sweep
    >>> sweep = simulate_sweep(steps=31, bands=136, columns=4)
    >>> figure = calibration_report(calibrate(sweep), sweep)
    """
    columns = columns_for(width, 4.5, 3)
    rows = -(-6 // columns)
    figure = new_figure("a calibration report", figsize=(width, 4.6 * rows), layout="constrained")
    if path is not None:
        check_picture(as_path(path))
    values = _values(calibration, sweep, column)
    figure.set_layout_engine("constrained", w_pad=0.08, h_pad=0.08)
    is_trusted, is_good = values["line_trusted"], values["good"]
    figure.suptitle(
        textwrap.fill(
            "   ·   ".join(
                [
                    str(calibration.attrs.get("sweep", "lab sweep")),
                    f"{int(is_trusted.any(axis=1).sum())} of {len(is_trusted)} steps used",
                    f"{int(is_good.sum())} of {is_good.size} bands have a gain",
                    f"line shape {calibration.attrs['srf_shape']}, "
                    f"FWHM {np.nanmedian(values['fwhm']):.2f} nm",
                    f"smile {np.ptp(values['wavelength_shift']):.2f} nm",
                ]
            ),
            max(30, int(11 * width)),
        ),
        fontsize="medium",
    )
    heights = (1.3,) + (1.0,) * (rows - 1)  # the first cell holds two axes
    cells = figure.add_gridspec(rows, columns, height_ratios=heights if columns == 1 else None)
    grid = [cells[divmod(number, columns)] for number in range(6)]
    fit_cells = grid[0].subgridspec(2, 1, height_ratios=(3, 1), hspace=0.05)
    lamp_axes = figure.add_subplot(fit_cells[0])
    residual_axes = figure.add_subplot(fit_cells[1], sharex=lamp_axes)
    from matplotlib import colormaps

    usable = np.flatnonzero(values["line_trusted"][:, values["column"]])
    # without the outermost lamp lines, some of whose light falls outside the detector
    positions = np.linspace(0, max(usable.size - 1, 0), _LAMP_LINES_SHOWN + 2)[1:-1].round().astype(int)
    steps = sorted(set(usable[positions].tolist())) if usable.size else []
    lamp_lines = fitted_lines(calibration, sweep, steps, values["column"])
    colours = colormaps["viridis"](np.linspace(0.3, 0.85, max(len(lamp_lines), 1)))
    for lamp_line, colour in zip(lamp_lines, colours, strict=False):
        lamp_axes.plot(
            lamp_line.curve_distance,
            lamp_line.curve,
            color=colour,
            lw=1.2,
            label=f"{lamp_line.wavelength:g} nm",
        )
        lamp_axes.plot(lamp_line.distance, lamp_line.counts, "o", color=colour, ms=4)
        residual_axes.plot(lamp_line.distance, 100 * lamp_line.residual, "o-", color=colour, ms=2.5, lw=0.6)
    lamp_axes.set(
        title=f"lamp lines and fits, column {values['column']}",
        ylabel="counts above dark [count]",
        ylim=(min(0.0, lamp_axes.get_ylim()[0]), None),
    )
    lamp_axes.tick_params(labelbottom=False)
    residual_axes.axhline(0, color="0.6", lw=0.8, zorder=0)
    residual_axes.set(xlabel="distance from the lamp line [nm]", ylabel="counts - fit\n[% of height]")
    max_residual = max(
        (float(np.abs(100 * lamp_line.residual).max(initial=0.0)) for lamp_line in lamp_lines), default=0.0
    )
    legend_below(residual_axes, lamp_axes)
    residual_axes.set_ylim(*(np.array([-1.15, 1.15]) * max(max_residual, 0.1)))
    for cell, draw in zip(
        grid[1:],
        (_draw_residuals, _draw_smile, _draw_widths, _draw_responsivity, _draw_uncertainty),
        strict=True,
    ):
        draw(figure.add_subplot(cell), values)
    for axes in figure.axes:
        axes.set_title(textwrap.fill(axes.get_title(), int(9 * width / columns)))
    return save_figure(figure, path)


def _values(calibration: xr.Dataset, sweep: xr.Dataset | None, column: int | None) -> Values:
    # variables in the units of the schema, and the highlighted column
    variables = require(calibration, list(_DIMS), "a calibration report")
    sizes = {dim: calibration.sizes[dim] for dim in (STEP, BAND, CROSS_TRACK)}
    with Problems("the calibration report cannot be drawn", SchemaError) as problems:
        if sweep is not None and any(sweep.sizes.get(dim) != size for dim, size in sizes.items()):
            sweep_sizes = {dim: sweep.sizes.get(dim) for dim in sizes}
            problems.add(
                f"the sweep has sizes {sweep_sizes}, its calibration {sizes}",
                expected="equal sizes",
                code="grid-mismatch",
            )
        problems.add_if(
            column is not None and not 0 <= column < sizes[CROSS_TRACK],
            f"column={column}",
            expected=f"0 to {sizes[CROSS_TRACK] - 1}",
            code="value-out-of-range",
        )
    values: Values = {}
    for name, dims in _DIMS.items():
        absent = {dim: sizes[dim] for dim in dims if dim not in variables[name].dims}
        values[name] = variables[name].expand_dims(absent).transpose(*dims).to_numpy()
    if column is None:
        lit_columns = np.flatnonzero(values["line_trusted"].any(axis=0))
        column = int(lit_columns[lit_columns.size // 2]) if lit_columns.size else sizes[CROSS_TRACK] // 2
    return values | {"column": column}


# --- lamp lines --------------------------------------------------------------------------------------------


def _edges(centres: Array) -> Array:
    if centres.size < 2:
        return np.asarray([centres[0] - 0.5, centres[0] + 0.5])
    inner = 0.5 * (centres[1:] + centres[:-1])
    return np.concatenate([[2 * centres[0] - inner[0]], inner, [2 * centres[-1] - inner[-1]]])


def _draw_map(axes: Any, wavelength: Array, values: Array, label: str, **style: Any) -> None:
    columns = np.arange(values.shape[1] + 1) - 0.5
    mesh = axes.pcolormesh(
        _edges(wavelength), columns, np.ma.masked_invalid(values.T), rasterized=True, **style
    )
    axes.set_facecolor(ink_of(axes, 0.15))
    # a colour bar beside narrow axes would shrink the plots above and below
    options = {"location": "bottom", "pad": 0.03} if axes_width(axes) < _NARROW_GAIN_INCH else {"pad": 0.02}
    axes.figure.colorbar(mesh, ax=axes, label=label, **options)
    axes.set(xlabel="wavelength [nm]", ylabel="cross_track [column]")


def _draw_residuals(axes: Any, values: Values) -> None:
    # wavelength from the calibration minus wavelength of the monochromator, for every lamp line
    residual = values["line_centre"] - values["step_wavelength"][:, None]
    residual = np.where(values["line_trusted"], residual, np.nan)
    finite = residual[np.isfinite(residual)]
    limit = max(float(np.percentile(np.abs(finite), 98)), 1e-6) if finite.size else 1.0
    rms = f"r.m.s. {np.sqrt(np.mean(finite**2)):.2g} nm" if finite.size else "no lamp line is used"
    _draw_map(
        axes,
        values["step_wavelength"],
        residual,
        "map - monochromator [nm]",
        cmap="PuOr",
        vmin=-limit,
        vmax=limit,
    )
    axes.set_title(f"wavelength residual, {rms}")


# --- detector elements -------------------------------------------------------------------------------------


def _draw_smile(axes: Any, values: Values) -> None:
    shift = values["wavelength_shift"]
    _draw_map(axes, values["wavelength"], shift, "wavelength shift [nm]", cmap="viridis")
    if min(shift.shape) > 1 and np.ptp(shift) > 0:
        levels = np.linspace(shift.min(), shift.max(), 6)[1:-1]
        curves = axes.contour(
            values["wavelength"],
            np.arange(shift.shape[1]),
            shift.T,
            levels=levels,
            colors="white",
            linewidths=0.8,
        )
        axes.clabel(curves, fmt="%.2g", fontsize="small")
    axes.set_title("smile")


def _shade_untrusted(axes: Any, values: Values) -> None:
    edges = _edges(values["wavelength"])
    # first band of every run of bands without a gain, and the band after the run
    runs = np.flatnonzero(np.diff(~values["good"], prepend=False, append=False)).reshape(-1, 2)
    for number, (start, stop) in enumerate(runs.tolist()):
        label = None if number else "no gain"
        axes.axvspan(edges[start], edges[stop], color=ORANGE, alpha=0.2, lw=0, zorder=0, label=label)
    axes.set(xlim=(edges.min(), edges.max()))


def _draw_widths(axes: Any, values: Values) -> None:
    is_trusted, step_nm = values["line_trusted"], values["step_wavelength"]
    widths = np.where(is_trusted, values["line_own_fwhm"], np.nan)
    is_used = is_trusted.any(axis=1)
    lower, median, upper = (
        np.nanpercentile(widths[is_used], (5, 50, 95), axis=1) if is_used.any() else np.empty((3, 0))
    )
    label = "lamp lines: median, 5 to 95 % of the columns"
    axes.errorbar(
        step_nm[is_used],
        median,
        (median - lower, upper - median),
        fmt="o",
        ms=3,
        lw=0.8,
        color=BLUE,
        label=label,
    )
    axes.plot(values["wavelength"], values["fwhm"], color=VERMILION, lw=1.8, zorder=3, label="calibration")
    if is_used.sum() > 4:  # lamp lines cut off at the edges of the detector do not set the scale
        inner = slice(2, -2)
        margin = 0.4 * float(upper[inner].max() - lower[inner].min()) + 1e-3
        axes.set_ylim(lower[inner].min() - margin, upper[inner].max() + margin)
    _shade_untrusted(axes, values)
    label_axes(axes, title="width of the bands, monochromator removed", ylabel="FWHM [nm]")


def _draw_responsivity(axes: Any, values: Values) -> None:
    from matplotlib.collections import LineCollection

    wavelength, responsivity = values["wavelength"], values["responsivity"]
    step = -(-responsivity.shape[1] // _MAX_COLUMNS)
    curves = [np.column_stack([wavelength, curve]) for curve in responsivity[:, ::step].T]
    label = "all columns" if step == 1 else f"every {step}th column"
    axes.add_collection(LineCollection(curves, colors=[ink_of(axes, 0.3)], linewidths=0.5, label=label))
    column = values["column"]
    axes.plot(wavelength, responsivity[:, column], color=BLUE, lw=1.8, label=f"column {column}")
    axes.autoscale_view()
    _shade_untrusted(axes, values)
    label_axes(
        axes, title="responsivity", ylabel="counts per joule in a pixel [count J$^{-1}$]", ylim=(0, None)
    )


def _draw_uncertainty(axes: Any, values: Values) -> None:
    from matplotlib.ticker import LogFormatter

    wavelength = values["wavelength"]
    random, systematic = (
        finite_quantiles(100 * values[f"radiance_gain_u_{kind}"].T, [0.5])[0]
        for kind in ("random", "systematic")
    )
    axes.semilogy(wavelength, np.hypot(random, systematic), color=ink_of(axes), lw=2.5, label="both")
    axes.semilogy(
        wavelength, systematic, "--", color=VERMILION, lw=1.5, label="systematic: power meter, optics"
    )
    axes.semilogy(wavelength, random, color=BLUE, lw=1.2, label="random: noise of the lamp lines")
    _shade_untrusted(axes, values)
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(LogFormatter(minor_thresholds=(1.5, 0.5)))  # otherwise labels overlap
    label_axes(
        axes,
        title="standard uncertainty of the gain",
        ylabel="relative to the gain [%]",
        ylim=(None, 2.0 * axes.get_ylim()[1]),
    )


def draw_gain(figure: Any, calibration: xr.Dataset) -> None:
    # Draw gain and band width over wavelength, and smile over columns
    names = ["radiance_gain", "wavelength", "fwhm", "wavelength_shift"]
    values = require(calibration, [n for n in names if n in calibration.variables], "a calibration")
    nm, gain = values["wavelength"].values, values["radiance_gain"].values
    plots = figure.subplots(1, 3)
    lowest, median, highest = finite_quantiles(gain.T, (0.05, 0.5, 0.95))
    plots[0].fill_between(nm, lowest, highest, color=BLUE, alpha=0.25, lw=0)
    plots[0].semilogy(nm, median, color=BLUE, lw=1.6)
    plots[0].set_ylabel(values["radiance_gain"].attrs.get("units", ""), fontsize="small")
    if "fwhm" in values:
        plots[1].plot(nm, values["fwhm"].values, color=VERMILION, lw=1.6)
    shift = values["wavelength_shift"].values if "wavelength_shift" in values else np.zeros(gain.shape[1])
    plots[2].plot(np.atleast_2d(shift)[:: max(1, len(np.atleast_2d(shift)) // 3)].T, lw=1.3)
    plots[1].set_ylabel("FWHM [nm]")
    plots[2].set_ylabel("wavelength shift [nm]")
    titles = ("gain, 5 to 95 % of the columns", "width of the bands", "smile")
    for axes, title, label in zip(plots, titles, (*["wavelength [nm]"] * 2, "column"), strict=True):
        axes.set_title(title, fontsize="medium")
        axes.set_xlabel(label)


# --- pictures of paints and panels: chips beside renders, cards, detection, comparisons with references -----


MAX_CHIPS = 60
_CHIP_PX = 16  # pixels along a chip's side; a pixel shows a member of the population
_CHIP_INCH, _RENDER_INCH = 0.85, 4.2  # widths


@takes_quantities()
@documented(path="picture")
def chips_and_renders(
    paints: xr.Dataset,
    renders: xr.Dataset | Mapping[str, xr.Dataset],
    path: str | Path | None = None,
    *,
    columns: int = 7,
    stretch: tuple[float, float] = (1.0, 99.0),
) -> Any:
    """Draw the paints of a library as chips above scenes rendered with them.

    Parameters
    ----------
    paints
        A paint library. The pixels of a chip show members of the paint's population, if the library has it.
    renders
        A render from `hyperpaint.simulation.relight` or a group of `hyperpaint.render_scene`; or several by
        the name of their light.
    path
    columns
        Chips side by side.
    stretch
        As for `hyperpaint.pictures.rgb`, for every render.

    Returns
    -------
    matplotlib.figure.Figure
        At most 60 chips.

    Raises
    ------
    MissingExtraError
        matplotlib is not installed.
    SchemaError
        The library is no paint library or has no paints; there is no render, or a render has fewer than three
        visible bands; or matplotlib cannot write this type of picture.

    Examples
    --------
    >>> from hyperpaint.paints import starter_library
    >>> from hyperpaint.simulation import simulate_line
    >>> paints, line = starter_library(members=0), simulate_line(lines=32, bands=40, columns=24)
    >>> figure = chips_and_renders(paints.isel(signature=[0, 5]), line)
    >>> [axes.get_title() for axes in figure.axes][:2]
    ['Synthetic Polar White', 'Synthetic Signal Red']
    """
    paints, problems = find_usable(paints)
    variables = require(paints, ["reflectance", "wavelength"], "chips", LIBRARY_VARIABLES)
    lines: dict[str, Any] = {"": renders}
    if isinstance(renders, Mapping) and not hasattr(renders, "dims"):
        lines = dict(renders)
    reason = "; ".join(problems) or f"{paints.sizes[SIGNATURE]} paints and {len(lines)} renders"
    SchemaError.raise_if(
        problems or not paints.sizes[SIGNATURE] or not lines,
        f"a collage needs a paint library and a render: {reason}",
        code="empty-input",
    )
    count, nm = min(paints.sizes[SIGNATURE], MAX_CHIPS), variables["wavelength"].values
    columns = max(1, min(columns, count))
    rows = -(-count // columns)
    orientations = {name: orientation_of(line) for name, line in lines.items()}
    tallest = max(
        min(orientation.height_of(_RENDER_INCH), 2.5 * _RENDER_INCH) for orientation in orientations.values()
    )
    chip_height = 1.25 * _CHIP_INCH * rows
    width = max(_RENDER_INCH * len(lines), (_CHIP_INCH + 0.2) * columns)
    figure = new_figure(
        "a collage of chips and renders", figsize=(width, chip_height + tallest + 0.6), layout="constrained"
    )
    chip_figure, render_figure = figure.subfigures(2, 1, height_ratios=(chip_height, tallest + 0.4))
    colours = paint_colours(paints)
    for number, axes in enumerate(chip_figure.subplots(rows, columns, squeeze=False).ravel()):
        axes.set_axis_off()
        if number < count:
            paint = paints.isel({SIGNATURE: number})
            axes.imshow(_chip(paint, nm, colours[number]), interpolation="nearest")
            axes.set_title(label_for(str(paint[SIGNATURE].values), 26), fontsize=6, pad=2)
    plots = render_figure.subplots(1, len(lines), squeeze=False)[0]
    for axes, (name, line) in zip(plots, lines.items(), strict=True):
        show_picture(axes, rgb(line, stretch=stretch).values, orientations[name])
        axes.set_axis_off()
        axes.set_title(label_for(name.replace("_", " ")), fontsize="small")
    return save_figure(figure, path, dpi=150)


def _chip(paint: xr.Dataset, wavelength: Array, colour: Array) -> Array:
    # (row, column, rgb), 0 to 1; pixels show random members of the population, else the colour of the paint
    uniform = np.broadcast_to(np.nan_to_num(colour), (_CHIP_PX, _CHIP_PX, 3))
    if "member_reflectance" not in paint.variables:
        return np.asarray(uniform)
    is_visible = good_bands(paint) & (wavelength > 380.0) & (wavelength < 780.0)
    members = np.asarray(paint["member_reflectance"].transpose(MEMBER, BAND).values)[:, is_visible]
    members = members[np.isfinite(members).all(axis=1)]
    if len(members) < 2 or is_visible.sum() < 3:
        return np.asarray(uniform)
    numbers = np.random.default_rng(0).integers(len(members), size=_CHIP_PX**2)
    return np.asarray(srgb(members, wavelength[is_visible])[numbers].reshape(_CHIP_PX, _CHIP_PX, 3)).clip(
        0.0, 1.0
    )


# --- the card of a paint -----------------------------------------------------------------------------------


MARGIN = 0.6  # margin drawn around a region, relative to the longer side of the region
MIN_MARGIN_PX = 14
COVERAGE = 1.96  # standard uncertainties in half of a 95 % interval
_CHARS_PER_INCH = 14.0  # of small text


@takes_quantities()
@documented(path="picture")
def paint_card(
    line: xr.Dataset, library: xr.Dataset, paint: str, path: str | Path | None = None, *, width: float = 12.0
) -> Any:
    r"""Draw one paint of a library on the flight line it was measured on.

    The card shows the surroundings in true colour with the region; flags of the surroundings, and the pixels
    used for the signature; the signature with the middle half of its pixels and its 95 % interval; its
    quantity, what makes its level uncertain, and the reasons stored with the region. Eager: only the lines
    around the region are read.

    Parameters
    ----------
    line
        The flight line, with ``reflectance`` and, to show flags, ``quality``.
    library
    paint
        Name of the paint.
    path
    width
        Width of the figure [inch]; below 9 the plots stand one above the other.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    MissingExtraError
        matplotlib is not installed.
    SchemaError
        The library is no paint library or lacks the paint; the paint has no region in sensor coordinates, or
        the region contains no pixel of this line; or matplotlib cannot write this type of picture.

    Notes
    -----
    The interval is :math:`\rho \pm 1.96 \sqrt{u_r^2 + u_s^2 + (u_l \rho)^2}` with the standard uncertainties
    of the library, and :math:`u_l` that of the level (``level_uncertainty``, relative), where it states one.

    Examples
    --------
    >>> from hyperpaint.paints import extract_signatures
    >>> from hyperpaint.regions import Region
    >>> from hyperpaint.simulation import simulate_line
    >>> line = simulate_line(lines=32, bands=40, columns=24)
    >>> paints = extract_signatures(line, [Region("grass", [(0, 0), (0, 31), (0.4, 31), (0.4, 0)])])
    >>> len(paint_card(line, paints, "grass").axes)
    4
    """
    # the paint, with the dim signature of length 1, and its region on the flight line
    usable, _ = find_usable(library)
    SchemaError.raise_if(
        "reflectance" not in usable.variables or SIGNATURE not in usable["reflectance"].dims,
        "the card of a paint needs a paint library",
        expected="reflectance (signature, band)",
        code="library-missing",
    )
    paints = [str(name) for name in usable[SIGNATURE].values]
    SchemaError.raise_if(
        paint not in paints,
        f"there is no paint {paint!r}",
        expected=", ".join(paints[:20]),
        code="paint-unknown",
    )
    signature = usable.isel({SIGNATURE: [paints.index(paint)]}).compute()
    SchemaError.raise_if(
        "region" not in signature.variables or not str(signature["region"].item()),
        f"paint {paint!r} has no region",
        expected="a library from a flight line",
        code="region-missing",
    )
    SchemaError.raise_if(
        signature.attrs.get("coordinates_of_regions", "sensor") != "sensor",
        f"the region of paint {paint!r} is on a map",
        mend="draw its card from the flight line",
        code="region-coordinates",
    )
    region = regions_from(json.loads(str(signature["region"].item())))[0]
    line = rename_to_roles(line)
    # crop of the line around the region, and which of its pixels (line, column) are in the region
    ((line_indices, column_indices),) = pixels_of(Regions((region,)), line)
    SchemaError.raise_if(
        not line_indices.size, f"region {region.name!r} contains no pixel of this line", code="region-empty"
    )
    margin = max(MIN_MARGIN_PX, int(MARGIN * (max(np.ptp(line_indices), np.ptp(column_indices)) + 1)))
    rows, columns = (
        slice(max(int(places.min()) - margin, 0), int(places.max()) + margin + 1)
        for places in (line_indices, column_indices)
    )
    cropped = line.isel({ALONG_TRACK: rows, CROSS_TRACK: columns})
    shape = cropped.sizes[ALONG_TRACK], cropped.sizes[CROSS_TRACK]
    in_region = np.zeros(shape, bool)
    in_region[line_indices - rows.start, column_indices - columns.start] = True
    # centres of pixels have their numbers in the line, also if the line has no coordinates
    numbers = {
        dim: np.arange(span.start, span.start + size)
        for dim, span, size in zip((ALONG_TRACK, CROSS_TRACK), (rows, columns), shape, strict=True)
        if dim not in cropped.coords
    }
    surroundings = cropped.assign_coords(numbers)
    is_wide = columns_for(width, 3.0, 3) == 3
    # name, kind and finish of the paint, and the reasons stored with its region
    properties = region.properties
    words = (properties[name] for name in ("kind", "finish") if properties.get(name))
    head = [label_for(word) for word in (signature[SIGNATURE].item(), *words)]
    reasons, chars = properties.get("reasons", ()), int(_CHARS_PER_INCH * (width - 0.3))
    reasons = reasons if isinstance(reasons, list | tuple) else ()
    text = label_for("; ".join(map(str, reasons)), longest=6 * chars)
    level_text = label_for(_level_text(signature), longest=6 * chars)
    lines_of_text = ["  |  ".join(head), *textwrap.wrap(level_text, chars), *textwrap.wrap(text, chars)]
    text_height, body = 0.2 * len(lines_of_text) + 0.1, 4.4 if is_wide else 11.0
    figure = new_figure("the card of a paint", figsize=(width, text_height + body), layout="constrained")
    if is_wide:
        ratios = {"width_ratios": (1.0, 1.0, 1.5), "height_ratios": (text_height, body)}
        mosaic = [["text"] * 3, ["place", "used", "signature"]]
    else:
        ratios = {"height_ratios": (text_height, *[body / 3] * 3)}
        mosaic = [["text"], ["place"], ["used"], ["signature"]]
    plots = figure.subplot_mosaic(mosaic, **ratios)
    plots["text"].set_axis_off()
    plots["text"].text(0.0, 1.0, "\n".join(lines_of_text), fontsize="small", va="top", in_layout=False)
    colours = np.asarray(rgb(surroundings).values)
    show_picture(plots["place"], colours, orientation_of(surroundings))
    draw_outlines(plots["place"], [region], width=1.2, named=False)
    plots["place"].set_title("region on the flight line", fontsize="small", loc="left")
    # flags that the library excluded
    names = set(str(library.attrs.get("exclude", "")).split())
    excluded = sum(int(flag) for flag in Quality if str(flag.name).lower() in names)
    _draw_exclusions(
        plots["used"],
        surroundings,
        colours,
        in_region,
        region,
        excluded_of(region, excluded if names else int(EXCLUDED)),
    )
    # the label of both pictures is wider than one, and a legend stands below the second
    label = plots["place"].get_xlabel()
    plots["place"].set_xlabel(label.replace(", ", ",\n"))
    plots["used"].set_xlabel(label.split(",")[0])
    _draw_signature(plots["signature"], signature)
    return save_figure(figure, path)


def _level_text(signature: xr.Dataset) -> str:
    # Quantity of a signature, and the parts of the uncertainty of its level, the largest first
    terms = json.loads(str(signature["level_terms"].item()) or "{}") if "level_terms" in signature else {}
    if "reflectance_u_coat" in signature:
        coat_u, mean = (float(signature[name].mean()) for name in ("reflectance_u_coat", "reflectance"))
        terms["the coat and the sky that it mirrors"] = coat_u / max(abs(mean), 1e-6)
    causes = [
        f"{cause} {share:.1%}"
        for cause, share in sorted(terms.items(), key=lambda term: -term[1])
        if share >= _LEAST_TERM
    ]
    words = [str(signature["quantity"].item())] if "quantity" in signature else []
    return "; ".join(words + (["standard uncertainty of its level: " + ", ".join(causes)] if causes else []))


def _draw_exclusions(
    axes: Any, around: xr.Dataset, colours: Array, in_region: Bools, region: Region, excluded: int
) -> None:
    from matplotlib.colors import to_rgb
    from matplotlib.patches import Patch

    orientation = orientation_of(around)
    grey = colours.mean(axis=2, keepdims=True)
    picture = np.broadcast_to(0.35 + 0.5 * np.nan_to_num(grey), (*in_region.shape, 3)).copy()
    bits = (
        around["quality"].transpose(ALONG_TRACK, CROSS_TRACK).values
        if "quality" in around.variables
        else np.zeros(in_region.shape, np.uint16)
    )
    is_used = in_region & ((bits & np.uint16(excluded)) == 0)
    picture[is_used] = colours[is_used]
    entries = {f"used  {is_used.sum()} px": Patch(facecolor="none", edgecolor="0.5", lw=0.5)}
    shares = {flag: float(((bits & int(flag)) != 0)[in_region].mean()) for flag in Quality if flag & excluded}
    for flag, share in sorted(shares.items(), key=lambda pair: -pair[1]):
        has_flag = (bits & int(flag)) != 0
        if has_flag.any():
            picture[has_flag] = to_rgb(flag.colour)
            name = f"{flag_label(flag)}  {percent(share) if share else 'outside only'}"
            entries[name] = Patch(facecolor=flag.colour, edgecolor="0.5", lw=0.5)
    show_picture(axes, picture, orientation)
    axes.set(ylabel="")
    draw_outlines(axes, [region], width=1.2, named=False)
    axes.set_title("pixels used, and excluded pixels by flag", fontsize="small", loc="left")
    legend_below(axes, entries=entries)


def _draw_signature(axes: Any, selection: xr.Dataset) -> None:
    (style,) = styles_of(paint_colours(selection))
    signature = selection.isel({SIGNATURE: 0})
    reflectance = np.where(good_bands(signature), signature["reflectance"].values, np.nan)
    # half width of the 95 % interval, if the library has uncertainties
    names = ["reflectance_u_random", "reflectance_u_systematic"]
    if "reflectance_u_coat" in signature.variables and not (
        names[1] in signature.variables and np.isfinite(signature[names[1]]).any()
    ):
        names[1] = "reflectance_u_coat"  # already a part of the systematic uncertainty if that is known
    uncertainties = [
        np.nan_to_num(signature[name].values.astype(np.float64))
        for name in names
        if name in signature.variables
    ]
    if "level_uncertainty" in signature.variables and np.isfinite(signature["level_uncertainty"].item()):
        uncertainties.append(
            float(signature["level_uncertainty"]) * signature["reflectance"].values.astype(np.float64)
        )
    if any(u.any() for u in uncertainties):
        interval = COVERAGE * np.sqrt(sum(u**2 for u in uncertainties))
        for edge, label in ((reflectance - interval, "95 % interval"), (reflectance + interval, None)):
            axes.plot(signature["wavelength"].values, edge, color=ink_of(axes), lw=0.8, ls=":", label=label)
    count = f", n = {int(signature['n'])}" if "n" in signature.variables else ""
    _draw_paint(axes, signature, "quantiles", style["color"], style, f"signature{count}")
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize="small")
    label_axes(axes, ylabel="reflectance factor [1]", ylim=(min(0.0, axes.get_ylim()[0]), None))


# --- receiver operating characteristics of paint detection -------------------------------------------------


@documented(path="picture")
def detection_curve(
    detections: xr.Dataset | Mapping[str, xr.Dataset],
    truth: Any,
    path: str | Path | None = None,
    *,
    width: float = 6.0,
) -> Any:
    """Draw the detection rate of paints against the false alarm rate, over all thresholds (ROC).

    Eager.

    Parameters
    ----------
    detections
        Result of `hyperpaint.paints.detect`, or several by name, such as one per method.
    truth
        Pixels that show one of the paints, (along_track, cross_track) bool.
    path
    width

    Returns
    -------
    matplotlib.figure.Figure
        One curve per result: along it the thresholds of all paints are shifted by the same amount. A dot
        marks the detections after rejection of unknown paints; the vertical line is the requested false alarm
        rate.

    Raises
    ------
    MissingExtraError
        matplotlib is not installed.
    SchemaError
        The input holds no detections, or ``truth`` has another shape, or is True or False everywhere.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> pixel, unit = ("along_track", "cross_track"), {"units": "1"}
    >>> result = xr.Dataset({"detection_score": (pixel, np.float32([[0.1, 0.9, 0.2, 0.8]]), unit),
    ...                     "best_paint": (pixel, np.int16([[0, 0, 0, 0]])),
    ...                     "score_threshold": ("signature", [0.5], unit),
    ...                     "detected": (pixel, [[False, True, False, True]])})
    >>> figure = detection_curve({"ACE": result}, [[False, True, False, False]])
    >>> figure.axes[0].lines[0].get_ydata().tolist()
    [1.0, 1.0, 1.0, 1.0]
    """
    by_name: Any = {"": detections} if "detected" in detections else detections
    is_target = np.asarray(getattr(truth, "values", truth), bool)
    figure = new_figure("a detection curve", figsize=(width, 0.8 * width), layout="constrained")
    axes = figure.add_subplot()
    for number, (name, result) in enumerate(dict[str, Any](by_name).items()):
        names = ("detection_score", "best_paint", "score_threshold", "detected")
        arrays = require(rename_to_roles(result), names, "a detection curve")
        score, paint, threshold, detected = (arrays[key].values for key in names)
        SchemaError.raise_if(
            is_target.shape != score.shape,
            f"truth has shape {is_target.shape}",
            expected=f"{score.shape}, as the detections",
            code="grid-mismatch",
        )
        has_score = paint >= 0
        is_hit = is_target[has_score]
        SchemaError.raise_if(
            not is_hit.any() or is_hit.all(),
            f"truth is {bool(is_hit.any())} everywhere",
            expected="True for pixels with a paint, False for all other pixels",
            code="truth-uniform",
        )
        # false alarm and detection rates over all thresholds, and the two rates of the stored detections
        order = np.argsort(-(score - threshold[paint])[has_score], kind="stable")
        hits, alarms = (np.cumsum(which[order]) / which.sum() for which in (is_hit, ~is_hit))
        alarms = np.maximum(alarms, 0.5 / (~is_hit).sum())
        dot = detected[has_score & ~is_target].mean(), detected[has_score & is_target].mean()
        colour = COLOURS[number % len(COLOURS)]
        axes.plot(alarms, hits, color=colour, label=name or str(result.attrs.get("method", "")))
        axes.plot(max(dot[0], alarms[0]), dot[1], "o", color=colour)
        rate = result.attrs.get("false_alarm_rate")
        if rate is not None:
            axes.axvline(rate, color=ink_of(axes, 0.5), linewidth=0.8, linestyle="--")
    label_axes(
        axes,
        xscale="log",
        ylim=(0.0, 1.02),
        xlabel="false alarm rate, share of other pixels [1]",
        ylabel="detection rate, share of the paint's pixels [1]",
    )
    return save_figure(figure, path)


# --- pictures of a validation, and of panels: signatures and references, measured and expected -------------


MAX_PAIRS = 24  # of one figure

_PAINT_AXES_INCH = (3.6, 3.9)
_FAILED = "#C0392B"  # title and frame of a paint outside the tolerance
# colours (of Okabe and Ito) and dashes of the references of one paint, one per instrument
_REFERENCES = ((VERMILION, "--"), (GREEN, "-."), (PURPLE, ":"), (ORANGE, (0, (6, 1, 1, 1))))
_MIN_SPAN = 0.005  # half range of the axis of differences [1]


@documented(path="picture")
def validation_figure(
    validation: "Validation", path: str | Path | None = None, *, columns: int = 3, limit: float | None = None
) -> Any:
    """Draw every signature with its references and their spread, and the differences below.

    References of several instruments share a plot.

    Parameters
    ----------
    validation
        Result of `hyperpaint.validate`.
    path
    columns
    limit
        Half range of all axes of differences [1]; by default it holds the largest difference and the limit of
        RMSE, which is shaded.

    Returns
    -------
    matplotlib.figure.Figure
        At most 24 paints, those with the largest RMSE, as the title notes. Shades are a standard deviation of
        pixels or readings; for differences, the standard uncertainty. Bands not compared are blank. A paint
        with a pair outside the tolerance has a red frame and "FAIL" in its title.

    Raises
    ------
    MissingExtraError
        matplotlib is not installed.
    SchemaError
        ``columns`` or ``limit`` is not positive, or matplotlib cannot write this type of picture.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> from hyperpaint.validation import validate
    >>> nm = np.linspace(400.0, 700.0, 61)
    >>> axis = {"wavelength": ("band", nm, {"units": "nm"}), "signature": ["hood"]}
    >>> level = 0.2 + 0.001 * (nm - 400.0)
    >>> field = xr.Dataset({"reflectance": (("signature", "band"), [level], {"units": "1"})}, axis)
    >>> library = field.assign(reflectance=field.reflectance + 0.002)
    >>> agreement = validate(library, field, reference_fwhm=5.0)
    >>> len(validation_figure(agreement).axes)
    2
    """
    SchemaError.raise_if(
        columns < 1 or (limit is not None and not limit > 0.0),
        f"columns={columns}, limit={limit}",
        expected="positive numbers",
        code="value-out-of-range",
    )
    # pairs by paint, of the `MAX_PAIRS` paints with the largest RMSE
    pairs_by_paint = grouped(
        (str(spectra.attrs["signature"]), number) for number, spectra in enumerate(validation.spectra)
    )
    paints, count = list(pairs_by_paint.values()), len(pairs_by_paint)
    if count > MAX_PAIRS:
        rmse = np.nan_to_num(validation.statistics["rmse"].max("part").values)
        paints = sorted(paints, key=lambda pairs: -max(rmse[pairs]))[:MAX_PAIRS]
    columns = min(columns, len(paints))
    rows = -(-len(paints) // columns)
    size = (_PAINT_AXES_INCH[0] * columns, _PAINT_AXES_INCH[1] * rows + 0.7)
    figure = new_figure("a picture of a validation", figsize=size, layout="constrained")
    grid = figure.add_gridspec(2 * rows, columns, height_ratios=[2.4, 1.0] * rows)
    if limit is None:
        drawn_pairs = [pair for pairs in paints for pair in pairs]
        max_differences = [
            float(np.abs(validation.spectra[pair]["difference"]).max()) for pair in drawn_pairs
        ]
        limits = float(np.nan_to_num(validation.statistics["rmse_limit"].values[drawn_pairs]).max())
        limit = 1.15 * max(
            _MIN_SPAN, limits, *(difference for difference in max_differences if np.isfinite(difference))
        )
    # in the order of wavelengths; NaN in bands not compared
    sorted_spectra = [each.where(each["used"]).sortby("wavelength") for each in validation.spectra]
    for panel, pairs in enumerate(paints):
        row, column = divmod(panel, columns)
        upper = figure.add_subplot(grid[2 * row, column])
        lower = figure.add_subplot(grid[2 * row + 1, column], sharex=upper)
        _draw_spectra(upper, validation, sorted_spectra, pairs)
        # differences below
        lower.axhline(0.0, color=ink_of(lower, 0.4), lw=0.8)
        for number, pair in enumerate(pairs):
            spectra = sorted_spectra[pair]
            colour, dashes = _REFERENCES[number % len(_REFERENCES)]
            nm, values = spectra["wavelength"].values, spectra["difference"].values
            edge = float(_largest_part(validation, pair)["rmse_limit"])
            if np.isfinite(edge) and not number:
                lower.axhspan(-edge, edge, color=GREEN, alpha=0.12, lw=0)
            lower.plot(nm, values, color=colour, ls=dashes, lw=1.2)
            uncertainties = [
                spectra[name].values for name in ("signature_u", "reference_u") if name in spectra
            ]
            if uncertainties:
                u = np.sqrt(sum(u_part**2 for u_part in uncertainties))
                lower.fill_between(nm, values - u, values + u, color=colour, alpha=0.2, lw=0)
        lower.set_ylim(-limit, limit)
        lower.tick_params(labelsize="small")
        if column == 0:
            lower.set_ylabel("difference [1]", fontsize="small")
        upper.tick_params(labelbottom=False)
        legend_below(lower, upper, fontsize="x-small")
        if column == 0:
            upper.set_ylabel("reflectance factor [1]", fontsize="small")
        lower.set_xlabel("wavelength [nm]", fontsize="small")
    ending = f", the {len(paints)} worst of {count} shown" if count > len(paints) else ""
    title = textwrap.fill(label_for(validation.verdict, longest=150) + ending, max(30, int(13 * size[0])))
    figure.suptitle(title, fontsize="small")
    return save_figure(figure, path)


def _draw_spectra(
    axes: Any, validation: "Validation", sorted_spectra: list[xr.Dataset], pairs: list[int]
) -> None:
    signature = sorted_spectra[pairs[0]]
    _draw_side(axes, signature, "signature", "signature", BLUE, "-")
    for number, pair in enumerate(pairs):
        spectra = sorted_spectra[pair]
        # agreement over the part of the spectrum with most bands
        part = _largest_part(validation, pair)
        limit = f" of {float(part['rmse_limit']):.4f}" if np.isfinite(part["rmse_limit"]) else ""
        agreement = f"RMSE {float(part['rmse']):.4f}{limit}, scale {float(part['scale']):.3f}"
        label = f"reference ({spectra.attrs['instrument']}): {agreement}"
        _draw_side(axes, spectra, "reference", label, *_REFERENCES[number % len(_REFERENCES)])
    title = label_for(
        " / ".join(
            dict.fromkeys(
                [
                    str(signature.attrs["signature"]),
                    *(str(sorted_spectra[pair].attrs["reference"]) for pair in pairs),
                ]
            )
        ),
        longest=34,
    )
    fails = not all(bool(validation.statistics["passes"].isel(pair=pair).all()) for pair in pairs)
    style = {"color": _FAILED, "fontweight": "bold"} if fails else {}
    axes.set_title(f"FAIL  {title}" if fails else title, fontsize="small", loc="left", **style)
    if fails:
        axes.spines[:].set(color=_FAILED, linewidth=2.0)
    axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
    axes.tick_params(labelsize="small")


def _draw_side(axes: Any, spectra: xr.Dataset, name: str, label: str, colour: str, dashes: Any) -> None:
    nm, values = spectra["wavelength"].values, spectra[name].values
    axes.plot(nm, values, color=colour, ls=dashes, lw=1.5, label=label_for(label, longest=120))
    if f"{name}_sd" in spectra:
        sd = spectra[f"{name}_sd"].values
        axes.fill_between(nm, values - sd, values + sd, color=colour, alpha=0.2, lw=0)


def _largest_part(validation: "Validation", pair: int) -> xr.Dataset:
    statistics = validation.statistics.isel(pair=pair)
    return statistics.isel(part=int(statistics["bands"].values.argmax()))


# --- ratio of measured to expected panel reflectance, band by band -----------------------------------------


MAX_PANELS = 12  # panels drawn in a figure, in order of time
_PAINT_DASHES = ("-", "--")


@documented(path="picture")
def panel_figure(closure: xr.Dataset, path: str | Path | None = None, *, width: float = 9.0) -> Any:
    """Draw the factor of every panel with its combined uncertainty and the findings on the panel.

    Eager in the panel factors; reads no cube.

    Parameters
    ----------
    closure
        Result of `hyperpaint.radiometry.panel_closure`, or a line scaled by panels.
    path
    width

    Returns
    -------
    matplotlib.figure.Figure
        One axes. Shades are twice the combined standard uncertainty: a factor that agrees has 1 in its shade.
        Of more than 12 panels the first 12 are drawn.

    Raises
    ------
    MissingExtraError
        matplotlib is not installed.
    SchemaError
        The dataset has no panel factors.

    Examples
    --------
    >>> import hyperpaint as hp
    >>> from hyperpaint.radiometry.pixel_reading import worked_example
    >>> whole = hp.Panel(slice(None), slice(None), 0.4)
    >>> closure = hp.radiometry.panel_closure(worked_example(), whole)
    >>> figure = panel_figure(closure, "panels.png")                              # doctest: +SKIP
    >>> len(panel_figure(closure).axes[0].lines)  # one panel, and the line at 1
    2
    """
    SchemaError.raise_if(
        not set(CLOSURE) <= set(closure.variables),
        "the dataset has no panels: variable 'panel_factor' is missing",
        mend="see hyperpaint.radiometry.panel_closure, or scale by reflectance(panel=)",
        code="variable-missing",
    )
    figure = new_figure("a picture of panels", figsize=(width, 0.45 * width), layout="constrained")
    draw_panels(figure.add_subplot(), closure)
    return save_figure(figure, path)


def state_text(state: int) -> str:
    """Return the bits of ``panel_state`` in words.

    Examples
    --------
    >>> state_text(0), state_text(3)
    ('as expected', 'saturated, partly other')
    """
    words = [name.replace("_", " ") for bit, name in enumerate(PANEL_STATES) if state >> bit & 1]
    return ", ".join(words) or "as expected"


def draw_panels(axes: Any, closure: xr.Dataset) -> None:
    # Draw the factors over wavelength on axes; bad bands stay blank
    values = closure[list(CLOSURE)].isel({schema.PANEL: slice(MAX_PANELS)}).compute()
    nm, is_good = closure["wavelength"].values, good_bands(closure)
    order = np.argsort(nm, kind="stable")
    axes.axhline(1.0, color=ink_of(axes, 0.7), linewidth=0.8)
    for number in range(values.sizes[schema.PANEL]):
        panel = values.isel({schema.PANEL: number})
        factor, u = (np.where(is_good, panel[name].values, np.nan)[order] for name in CLOSURE[:2])
        colour = COLOURS[number % len(COLOURS)]
        time = np.datetime_as_string(panel["panel_time"].values, "s")
        label = f"panel {number}, {time}: {state_text(int(panel['panel_state']))}"
        dashes = _PAINT_DASHES[number // len(COLOURS) % len(_PAINT_DASHES)]
        axes.plot(nm[order], factor, dashes, color=colour, linewidth=1.4, label=label)
        axes.fill_between(nm[order], factor - 2.0 * u, factor + 2.0 * u, color=colour, alpha=0.12, lw=0)
    label_axes(axes, ylabel="measured / expected reflectance [1]")
