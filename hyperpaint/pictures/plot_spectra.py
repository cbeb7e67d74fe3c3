"""Spectra of pixels, regions and paints with their spread; overview of a paint library."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base import schema
from hyperpaint.base.arrays import Array, Floats32
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.facts import documented
from hyperpaint.base.schema import ALONG_TRACK, BAND, CROSS_TRACK, Quality
from hyperpaint.base.units import takes_quantities
from hyperpaint.paints.colours import ciede2000, lab_of, paint_colours, srgb
from hyperpaint.paints.signatures import extract_signatures
from hyperpaint.paints.signatures.pixel_gathering import gather
from hyperpaint.radiometry.counts_to_reflectance import reflectance

from .figures import axes_or_new, ink_of, label_for, legend_below, new_figure, save_figure

SPREADS = ("quantiles", "sd", "none")
MAX_CURVES = 24  # of one figure

_MIN_DIFFERENCE = 12.0  # CIEDE2000 between colours of curves, below which their dashes differ
_DASHES = ("-", "--", "-.", ":", (0, (6, 1, 1, 1, 1, 1)))


@documented()
def spectrum(
    dataset: xr.Dataset,
    regions: Any = None,
    *,
    pixels: Sequence[int] | Sequence[Sequence[int]] | None = None,
    paints: str | Iterable[str] | None = None,
    spread: str = "quantiles",
    exclude: Quality | int | None = None,
    axes: Any = None,
) -> Any:
    """Draw reflectance over wavelength: of regions or pixels of a flight line, or of paints of a library.

    Each curve has the colour of its paint in daylight, with a rim that shows on light and dark ground; curves
    of similar colours differ in their dashes. Eager: of a flight line the blocks with the pixels are read.

    Parameters
    ----------
    dataset
        A flight line with reflectance, or with the variables to compute it; or a paint library.
    regions
        Regions of the flight line, see `hyperpaint.read_regions`; the centre of their pixels is drawn, as in
        `hyperpaint.extract_signatures`.
    pixels
        (along_track, cross_track) of a pixel, or several such pairs. Each is drawn at the wavelengths of its
        column, with its standard uncertainty where known, and labelled with its flags.
    paints
        Names of paints of the library; by default all.
    spread
        For regions and paints: ``"quantiles"`` shades the middle half and 5 to 95 % of the pixels, ``"sd"``
        one standard deviation, ``"none"`` nothing.
    exclude
    axes

    Returns
    -------
    matplotlib.axes.Axes

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
    >>> axes = spectrum(line, pixels=[(3, 4), (20, 10)])
    >>> [curve.get_label() for curve in axes.lines]
    ['(3, 4)', '(20, 10)']
    """
    dataset = schema.rename_to_roles(dataset)
    # a flight line may have the dim of paints too: the paint of each pixel
    is_library = "reflectance" in dataset and dataset["reflectance"].dims == (schema.SIGNATURE, BAND)
    problems = Problems("spectra cannot be drawn", SchemaError)
    if spread not in SPREADS:
        problems.add(f"spread={spread!r:.40}", expected=f"one of {', '.join(SPREADS)}", code="choice-unknown")
    if is_library and (regions is not None or pixels is not None):
        problems.add(
            "a paint library has neither regions nor pixels",
            mend="name paints=, or give a flight line",
            code="option-conflict",
        )
    if not is_library and paints is not None:
        problems.add(
            "paints= names paints of a library", mend="give regions= or pixels=", code="option-conflict"
        )
    if not is_library and (regions is None) == (pixels is None):
        problems.add(
            "a flight line needs either regions or pixels=(along_track, cross_track)", code="argument-missing"
        )
    places = np.zeros((0, 2), int)
    if not is_library and pixels is not None:
        places = checked_places(dataset, pixels, problems)
    problems.raise_if_any()
    axes = axes_or_new(axes, "a picture of spectra", figsize=(8, 4.5))
    if pixels is not None:
        if "reflectance" not in dataset.variables:
            dataset = reflectance(dataset)
        names = [name for name in ("reflectance_u_random", "reflectance_u_systematic") if name in dataset]
        cubes = schema.require(dataset, ["reflectance", *names], "a picture of spectra")
        planes = {"quality": dataset["quality"]} if "quality" in dataset else {}
        spectra, values = gather(cubes, planes, places[:, 0], places[:, 1], slice(None), {})
        u = np.sqrt(sum(spectra[name].astype(np.float64) ** 2 for name in names)) if names else None
        cube = {"reflectance": spectra["reflectance"]}
        draw_pixels([axes], dataset, cube, values.get("quality"), places, u)
    else:
        if not is_library:
            dataset = extract_signatures(dataset, regions, exclude=exclude, members=0, min_pixels=1)
        _draw_paints(axes, dataset, paints, spread)
    axes.set(xlabel="wavelength [nm]", ylabel="reflectance factor [1]")
    axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
    legend_below(axes)
    return axes


def styles_of(colours: Array) -> list[dict[str, Any]]:
    """Return colour and dashes for curves of these colours (curve, rgb); similar colours get other dashes.

    A curve without a colour, NaN, takes one of matplotlib's.
    """
    lab = lab_of(colours)
    styles: list[dict[str, Any]] = []
    for number, colour in enumerate(colours):
        known = bool(np.isfinite(colour).all())
        alike = int((ciede2000(lab[:number], lab[number]) < _MIN_DIFFERENCE).sum()) if known else 0
        shown = tuple(np.asarray(colour, np.float64).tolist()) if known else f"C{number % 10}"
        styles.append({"color": shown, "ls": _DASHES[alike % len(_DASHES)]})
    return styles


def draw_curve(axes: Any, x: Array, y: Array, style: dict[str, Any], label: str | None = None) -> Any:
    """Draw a curve with a rim that shows on light and dark ground; return its colour."""
    from matplotlib.patheffects import Normal, withStroke

    rim = withStroke(linewidth=2.8, foreground=ink_of(axes, 0.45))
    axes.plot(x, y, lw=1.7, label=label, path_effects=[rim, Normal()], **style)
    return style["color"]


# --- paints and regions ------------------------------------------------------------------------------------


def _draw_paints(axes: Any, library: xr.Dataset, paints: str | Iterable[str] | None, spread: str) -> None:
    names = [str(name) for name in library[schema.SIGNATURE].values]
    wanted = [paints] if isinstance(paints, str) else names if paints is None else list(paints)
    problems = Problems("paints cannot be drawn", SchemaError)
    if unknown := [name for name in wanted if name not in names]:
        problems.add(
            f"no paint {', '.join(map(repr, unknown))}", expected=", ".join(names), code="paint-unknown"
        )
    if len(wanted) > MAX_CURVES:
        problems.add(
            f"{len(wanted)} curves",
            expected=f"at most {MAX_CURVES}",
            mend="name some, or see library_overview",
            code="curve-number",
        )
    problems.raise_if_any()
    places = [names.index(name) for name in wanted]
    for name, place, style in zip(wanted, places, styles_of(paint_colours(library)[places]), strict=True):
        paint = library.isel({schema.SIGNATURE: place})
        wavelength = schema.require(paint, ["wavelength"], "a picture of spectra")["wavelength"].values
        is_good = good_of(paint)
        centre = np.where(is_good, paint["reflectance"].values, np.nan)
        count = f" (n = {int(paint['n'])})" if "n" in paint else ""
        draw_band(axes, paint, wavelength, is_good, spread, style["color"])
        draw_curve(axes, wavelength, centre, style, label_for(name) + count)


def draw_band(
    axes: Any, paint: xr.Dataset, wavelength: Array, is_good: Array, spread: str, colour: Any
) -> None:
    """Shade the spread of the pixels of one paint of a library; see `spectrum` for ``spread``.

    ``wavelength`` and ``is_good`` (band,): wavelengths [nm], and the bands to show. Nothing is drawn if the
    library has no such spread.
    """
    if spread == "quantiles" and "reflectance_quantiles" in paint:
        levels = paint[schema.QUANTILE].values
        for low, high, shade in ((0.05, 0.95, 0.15), (0.25, 0.75, 0.25)):
            edges = [np.abs(levels - level).argmin() for level in (low, high)]
            if np.allclose(levels[edges], (low, high), atol=1e-6):
                below, above = paint["reflectance_quantiles"].values[edges]
                axes.fill_between(wavelength, below, above, where=is_good, color=colour, alpha=shade, lw=0)
    elif spread == "sd" and "reflectance_sd" in paint:
        centre, sd = paint["reflectance"].values, paint["reflectance_sd"].values
        axes.fill_between(wavelength, centre - sd, centre + sd, where=is_good, color=colour, alpha=0.25, lw=0)


def good_of(dataset: xr.Dataset) -> Array:
    """Return the good bands (band,), all where the dataset does not say."""
    if "good" in dataset.variables:
        return np.asarray(dataset["good"].values, bool)
    return np.ones(dataset.sizes[BAND], bool)


# --- pixels ------------------------------------------------------------------------------------------------


def checked_places(dataset: xr.Dataset, pixels: Any, problems: Problems) -> Array:
    """Return places (pixel, 2) along and across the track; problems are noted."""
    places = np.atleast_2d(np.asarray(pixels))
    if places.ndim != 2 or places.shape[-1] != 2 or places.dtype.kind not in "iu":
        problems.add(
            f"pixels={pixels!r:.60}",
            expected="one whole (along_track, cross_track), or several",
            code="type-wrong",
        )
        return places
    if len(places) > MAX_CURVES:
        problems.add(
            f"{len(places)} pixels",
            expected=f"at most {MAX_CURVES}",
            mend="outline them as a region",
            code="curve-number",
        )
    lines, columns = dataset.sizes.get(ALONG_TRACK, 0), dataset.sizes.get(CROSS_TRACK, 0)
    for along, across in places.tolist():
        if not (0 <= along < lines and 0 <= across < columns):
            problems.add(
                f"pixel ({along}, {across}) is outside of {lines} lines of {columns} columns",
                code="pixel-outside",
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
    """Draw spectra of pixels in their own colours at the wavelengths of their columns, one cube an axes.

    ``cubes`` (pixel, band) by name, with reflectance; ``quality`` (pixel,); ``u`` (pixel, band): standard
    uncertainty, shaded.
    """
    wavelength = schema.require(dataset, ["wavelength"], "a picture of spectra")["wavelength"].values
    is_good = good_of(dataset)
    shift = np.zeros((wavelength.size, dataset.sizes[CROSS_TRACK]))
    if "wavelength_shift" in dataset.variables:
        stored = schema.require(dataset, ["wavelength_shift"], "a picture of spectra")["wavelength_shift"]
        shift = np.broadcast_to(stored.values, shift.shape)
    # colours in daylight; matplotlib's without three visible bands
    order = np.argsort(wavelength, kind="stable")
    try:
        colours = srgb(np.where(is_good, cubes["reflectance"], np.nan)[:, order], wavelength[order])
    except SchemaError:
        colours = np.full((len(places), 3), np.nan)
    styles = styles_of(colours)
    for axes, cube in zip(plots, cubes.values(), strict=True):
        for number, (along, across) in enumerate(places.tolist()):
            nm, shown = wavelength + shift[:, across], np.where(is_good, cube[number], np.nan)
            label = pixel_label(along, across, 0 if quality is None else int(quality[number]))
            if u is not None:
                below, above = shown - u[number], shown + u[number]
                axes.fill_between(nm, below, above, color=styles[number]["color"], alpha=0.25, lw=0)
            draw_curve(axes, nm, shown, styles[number], label)


def pixel_label(along: int, across: int, bits: int) -> str:
    """Return the place of a pixel and its flags as text.

    Examples
    --------
    >>> pixel_label(3, 4, Quality.GLINT | Quality.LOW_SUN)
    '(3, 4): low sun, glint'
    """
    flags = ", ".join(schema.flag_names(bits)).replace("_", " ")
    return f"({along}, {across})" + (f": {flags}" if flags else "")


# --- paint libraries -----------------------------------------------------------------------------------


MAX_PAINTS = 48  # of one figure

_AXES_INCH = (2.9, 2.1)
# kinds of dtypes accepted for a dtype of the schema
_KINDS = {"float32": "fiu", "float64": "fiu", "int64": "iu", "uint16": "iu", "bool": "b"}


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
        At most 48 paints; the title counts the others. All axes have the same scale. Spectra have the colours
        of their paints.

    Raises
    ------
    MissingExtraError
        matplotlib is not installed.
    SchemaError
        It is no paint library, variables have other dims, units or dtypes than in a library, or matplotlib
        cannot write this type of picture.

    Examples
    --------
    >>> from hyperpaint.paints import starter_library
    >>> figure = library_overview(starter_library(members=0).isel(signature=[0, 5]))
    >>> figure.axes[0].get_xlabel()
    'wavelength [nm]'
    """
    paints, wrong = find_usable(paints)
    problems = Problems("a paint library cannot be drawn", SchemaError)
    for problem in wrong:
        problems.add(problem, code="variable-unusable")
    problems.raise_if_any()
    variables = schema.require(paints, ["reflectance", "wavelength"], "an overview", schema.LIBRARY_VARIABLES)
    count = paints.sizes[schema.SIGNATURE]
    if not count:
        raise SchemaError("the library has no paint to draw", code="library-empty")
    shown = min(count, MAX_PAINTS)
    columns = max(1, min(columns, shown))
    rows = -(-shown // columns)
    size = (_AXES_INCH[0] * columns, _AXES_INCH[1] * rows + 0.4)
    figure = new_figure("a picture of a paint library", figsize=size, layout="constrained")
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    wavelength, good = variables["wavelength"].values, good_of(paints)
    colours = paint_colours(paints)
    for number, axes in enumerate(grid.ravel()):
        if number < shown:
            _draw_paint(
                axes, paints.isel({schema.SIGNATURE: number}), wavelength, good, spread, colours[number]
            )
        else:
            axes.set_axis_off()
    # the last axes of a column carry its wavelengths, also where the row below is not full
    for number in range(max(0, shown - columns), shown):
        axes = grid.ravel()[number]
        axes.tick_params(labelbottom=True)
        axes.set_xlabel("wavelength [nm]", fontsize="small")
    grid[0, 0].set_ylim(bottom=min(0.0, grid[0, 0].get_ylim()[0]))
    for axes in grid[:, 0]:
        axes.set_ylabel("reflectance factor [1]", fontsize="small")
    if count > shown:
        figure.suptitle(f"the first {shown} of {count} paints")
    save_figure(figure, path)
    return figure


def find_usable(paints: xr.Dataset) -> tuple[xr.Dataset, list[str]]:
    """Return a library without variables that break the schema, and the problems of these.

    Reads dims, dtypes and attributes only, never values.
    """
    table = schema.LIBRARY_VARIABLES
    names = [name for name in table if name in paints.variables]
    kinds = {name: _KINDS.get(table[name].dtype, paints[name].dtype.kind) for name in names}
    # only numbers can be converted to other units
    alike = [name for name in names if paints[name].dtype.kind in kinds[name]]
    problems = [
        f"{name!r} is {paints[name].dtype}, expected {table[name].dtype}"
        for name in names
        if name not in alike
    ]
    usable, wrong = schema.find(paints, alike, table)
    return paints.drop_vars([name for name in names if name not in usable]), [*problems, *map(str, wrong)]


def _draw_paint(
    axes: Any, paint: xr.Dataset, wavelength: Any, good: Any, spread: str, colour: Floats32
) -> None:
    from matplotlib.patches import Rectangle

    (style,) = styles_of(colour[np.newaxis])
    draw_band(axes, paint, wavelength, good, spread, ink_of(axes, 0.6))
    draw_curve(axes, wavelength, np.where(good, paint["reflectance"].values, np.nan), style)
    count = f"  n = {int(paint['n'])}" if "n" in paint else ""
    title = label_for(paint[schema.SIGNATURE].item()) + count
    axes.set_title(title, fontsize="small", loc="left", pad=11 if np.isfinite(colour).all() else None)
    if np.isfinite(colour).all():
        style = {"facecolor": colour.tolist(), "edgecolor": "0.5", "lw": 0.5, "clip_on": False}
        axes.add_patch(Rectangle((0.0, 1.0), 1.0, 0.05, transform=axes.transAxes, **style))
    axes.tick_params(labelsize="small")


def draw_uncertainties(axes: Any, paints: xr.Dataset) -> None:
    """Draw the standard uncertainty of each paint's mean, and its random part."""
    names = [f"reflectance_u_{kind}" for kind in ("random", "systematic")]
    held = [name for name in names if name in paints.variables]
    few = paints.isel({schema.SIGNATURE: slice(MAX_CURVES)})
    values = schema.require(few, [*held, "wavelength"], "uncertainties", schema.LIBRARY_VARIABLES)
    is_good, nm = good_of(few), values["wavelength"].values
    parts = [np.where(is_good, values[name].values, np.nan).astype(np.float64) for name in held]
    total = np.sqrt(sum(np.nan_to_num(part) ** 2 for part in parts))
    total[np.isnan(parts).all(axis=0)] = np.nan
    for number, style in enumerate(styles_of(paint_colours(few))):
        label = label_for(few[schema.SIGNATURE].values[number])
        draw_curve(axes, nm, total[number], {**style, "ls": "-"}, label)
        if len(held) > 1:
            axes.plot(nm, parts[0][number], ls="--", lw=0.9, color=style["color"])
    axes.set(xlabel="wavelength [nm]", ylabel="standard uncertainty [1]")
    axes.set_ylim(bottom=0)
    legend_below(axes)
