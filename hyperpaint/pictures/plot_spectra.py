"""Spectra of pixels, regions and paints, with their spread; a paint library at a glance."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hyperpaint.base import schema
from hyperpaint.base.arrays import Array, Floats32
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.schema import ALONG_TRACK, BAND, CROSS_TRACK, Quality
from hyperpaint.base.units import takes_quantities
from hyperpaint.paints.colours import ciede2000, lab_of, paint_colours, srgb
from hyperpaint.paints.signatures import extract_signatures
from hyperpaint.paints.signatures.pixel_gathering import gather
from hyperpaint.radiometry.counts_to_reflectance import reflectance

from .figures import axes_or_new, ink_of, label_for, legend_below, new_figure, save_figure

if TYPE_CHECKING:
    import xarray as xr

SPREADS = ("quantiles", "sd", "none")
MOST_CURVES = 24
"""Curves of one figure at the most."""

_ALIKE = 12.0  # CIEDE2000, below which colours of curves are told apart by their dashes
_DASHES = ("-", "--", "-.", ":", (0, (6, 1, 1, 1, 1, 1)))


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
    """Draw reflectance over wavelength: of regions or pixels of a flight line, or of the paints of a library.

    Each curve has the colour of its paint in daylight, with a rim that shows on light and dark ground; those
    of colours that are hard to tell apart differ in their dashes. Eager: of a flight line the blocks of lines
    are read that hold the pixels.

    Parameters
    ----------
    dataset
        A flight line with reflectance, or with what it follows from; or a paint library.
    regions
        Regions of the flight line, see `hyperpaint.read_regions`; drawn is the centre of their pixels, as
        `hyperpaint.extract_signatures` finds it.
    pixels
        (along_track, cross_track) of a pixel, or several such pairs. Each is drawn at the wavelengths of its
        own column, with its standard uncertainty where that is known, and named with its flags.
    paints
        Names of paints of the library; by default all.
    spread
        Of regions and paints: ``"quantiles"`` shades the middle half and 5 to 95 % of the pixels, ``"sd"``
        one standard deviation, ``"none"`` nothing.
    exclude
        Flags of pixels of regions that are left out; by default as `hyperpaint.extract_signatures` does.
    axes
        matplotlib axes to draw on; new ones by default.

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
        The dataset has none of what is asked for, or there are more than 24 curves; all problems are listed.

    Examples
    --------
    >>> from hyperpaint.simulation import simulate_line
    >>> line = simulate_line(lines=32, bands=40, columns=24)
    >>> axes = spectrum(line, pixels=[(3, 4), (20, 10)])
    >>> [curve.get_label() for curve in axes.lines]
    ['(3, 4)', '(20, 10)']
    """
    dataset = schema.rename_to_roles(dataset)
    library = _is_library(dataset)
    _check(library, regions, pixels, paints, spread)
    axes = axes_or_new(axes, "a picture of spectra", figsize=(8, 4.5))
    if pixels is not None:
        _draw_pixels(axes, dataset, np.atleast_2d(np.asarray(pixels)))
    else:
        if not library:
            dataset = extract_signatures(dataset, regions, exclude=exclude, members=0, min_pixels=1)
        _draw_paints(axes, dataset, paints, spread)
    axes.set(xlabel="wavelength [nm]", ylabel="reflectance factor [1]")
    axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
    legend_below(axes)
    return axes


def styles_of(colours: Array) -> list[dict[str, Any]]:
    """Return how curves of these colours (curve, rgb) are drawn: with dashes that tell like ones apart.

    A curve without a colour, NaN, takes one of matplotlib's.
    """
    lab = lab_of(colours)
    styles: list[dict[str, Any]] = []
    for number, colour in enumerate(colours):
        known = bool(np.isfinite(colour).all())
        alike = int((ciede2000(lab[:number], lab[number]) < _ALIKE).sum()) if known else 0
        shown = tuple(np.asarray(colour, np.float64).tolist()) if known else f"C{number % 10}"
        styles.append({"color": shown, "ls": _DASHES[alike % len(_DASHES)]})
    return styles


def draw_curve(axes: Any, x: Array, y: Array, style: dict[str, Any], label: str | None = None) -> Any:
    """Draw a curve in a colour of its own, with a rim that shows on any ground; return that colour."""
    from matplotlib.patheffects import Normal, withStroke

    rim = withStroke(linewidth=2.8, foreground=ink_of(axes, 0.45))
    axes.plot(x, y, lw=1.7, label=label, path_effects=[rim, Normal()], **style)
    return style["color"]


def _is_library(dataset: xr.Dataset) -> bool:
    # a flight line may hold which paint each pixel has
    return "reflectance" in dataset.variables and dataset["reflectance"].dims == (schema.SIGNATURE, BAND)


def _check(library: bool, regions: Any, pixels: Any, paints: Any, spread: str) -> None:
    problems = Problems("spectra cannot be drawn", SchemaError)
    if spread not in SPREADS:
        problems.add(f"spread={spread!r:.40}", expected=f"one of {', '.join(SPREADS)}", code="choice-unknown")
    if library and (regions is not None or pixels is not None):
        problems.add(
            "a paint library has neither regions nor pixels",
            mend="name paints=, or give a flight line",
            code="option-conflict",
        )
    if not library:
        if paints is not None:
            problems.add(
                "paints= names paints of a library", mend="give regions= or pixels=", code="option-conflict"
            )
        if (regions is None) == (pixels is None):
            problems.add(
                "a flight line needs either regions or pixels=(along_track, cross_track)",
                code="argument-missing",
            )
    if pixels is not None:
        places = np.asarray(pixels)
        if places.ndim not in (1, 2) or places.shape[-1:] != (2,) or places.dtype.kind not in "iu":
            problems.add(
                f"pixels={pixels!r:.60}",
                expected="one whole (along_track, cross_track), or several",
                code="type-wrong",
            )
        elif places.ndim == 2 and len(places) > MOST_CURVES:
            problems.add(
                f"{len(places)} pixels",
                expected=f"at most {MOST_CURVES}",
                mend="outline them as a region",
                code="curve-number",
            )
    problems.raise_if_any()


# --- paints and regions ------------------------------------------------------------------------------------


def _draw_paints(axes: Any, library: xr.Dataset, paints: str | Iterable[str] | None, spread: str) -> None:
    names = [str(name) for name in library[schema.SIGNATURE].values]
    wanted = [paints] if isinstance(paints, str) else names if paints is None else list(paints)
    problems = Problems("paints cannot be drawn", SchemaError)
    if unknown := [name for name in wanted if name not in names]:
        problems.add(
            f"no paint {', '.join(map(repr, unknown))}", expected=", ".join(names), code="paint-unknown"
        )
    if len(wanted) > MOST_CURVES:
        problems.add(
            f"{len(wanted)} curves",
            expected=f"at most {MOST_CURVES}",
            mend="name some, or see library_overview",
            code="curve-number",
        )
    problems.raise_if_any()
    places = [names.index(name) for name in wanted]
    styles = styles_of(paint_colours(library)[places])
    for name, place, style in zip(wanted, places, styles, strict=True):
        own = library.isel({schema.SIGNATURE: place})
        wavelength, is_good = _wavelength_of(own)
        centre = np.where(is_good, own["reflectance"].values, np.nan)
        count = f" (n = {int(own['n'])})" if "n" in own else ""
        draw_band(axes, own, wavelength, is_good, spread, style["color"])
        draw_curve(axes, wavelength, centre, style, label_for(name) + count)


def draw_band(
    axes: Any, paint: xr.Dataset, wavelength: Array, is_good: Array, spread: str, colour: Any
) -> None:
    """Shade how far the pixels of one paint of a library are spread; see `spectrum` for ``spread``.

    ``wavelength`` and ``is_good`` (band,): of the bands, and which of them may be shown. What the library
    does not hold is not drawn.
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


def _wavelength_of(dataset: xr.Dataset) -> tuple[Array, Array]:
    """Return wavelengths [nm], and which bands are to be used."""
    wavelength = schema.require(dataset, ["wavelength"], "a picture of spectra")["wavelength"].values
    return wavelength, good_of(dataset)


def good_of(dataset: xr.Dataset) -> Array:
    """Return which bands are to be used (band,)."""
    if "good" in dataset.variables:
        return np.asarray(dataset["good"].values, bool)
    return np.ones(dataset.sizes[BAND], bool)


# --- pixels ------------------------------------------------------------------------------------------------


def _draw_pixels(axes: Any, dataset: xr.Dataset, places: Array) -> None:
    problems = Problems("pixels cannot be drawn", SchemaError)
    size = dataset.sizes.get(ALONG_TRACK, 0), dataset.sizes.get(CROSS_TRACK, 0)
    for along, across in places.tolist():
        if not (0 <= along < size[0] and 0 <= across < size[1]):
            problems.add(
                f"pixel ({along}, {across}) is outside of {size[0]} lines of {size[1]} columns",
                code="pixel-outside",
            )
    problems.raise_if_any()
    if "reflectance" not in dataset.variables:
        dataset = reflectance(dataset)
    names = [name for name in ("reflectance_u_random", "reflectance_u_systematic") if name in dataset]
    cubes = schema.require(dataset, ["reflectance", *names], "a picture of spectra")
    planes = {"quality": dataset["quality"]} if "quality" in dataset else {}
    spectra, values = gather(cubes, planes, places[:, 0], places[:, 1], slice(None), {})
    wavelength, is_good = _wavelength_of(dataset)
    shift = np.zeros((wavelength.size, size[1]))
    if "wavelength_shift" in dataset.variables:
        own = schema.require(dataset, ["wavelength_shift"], "a picture of spectra")["wavelength_shift"]
        shift = np.broadcast_to(own.values, shift.shape)
    shown = np.where(is_good, spectra["reflectance"], np.nan)
    styles = styles_of(pixel_colours(shown, wavelength))
    for number, (along, across) in enumerate(places.tolist()):
        at = wavelength + shift[:, across]
        label = pixel_label(along, across, int(values["quality"][number]) if planes else 0)
        if names:
            u = np.sqrt(sum(spectra[name][number].astype(np.float64) ** 2 for name in names))
            below, above = shown[number] - u, shown[number] + u
            axes.fill_between(at, below, above, color=styles[number]["color"], alpha=0.25, lw=0)
        draw_curve(axes, at, shown[number], styles[number], label)


def pixel_colours(reflectance: Array, wavelength: Array) -> Array:
    """Return the colours of pixels (pixel, rgb) in daylight; NaN without three visible bands."""
    order = np.argsort(wavelength, kind="stable")
    try:
        return srgb(reflectance[:, order], wavelength[order])
    except SchemaError:
        return np.full((len(reflectance), 3), np.nan)


def pixel_label(along: int, across: int, bits: int) -> str:
    """Return a pixel's place, and its flags.

    Examples
    --------
    >>> pixel_label(3, 4, Quality.GLINT | Quality.LOW_SUN)
    '(3, 4): low sun, glint'
    """
    flags = ", ".join(schema.flag_names(bits)).replace("_", " ")
    return f"({along}, {across})" + (f": {flags}" if flags else "")


# --- paint libraries -----------------------------------------------------------------------------------


MOST_PAINTS = 48
"""Paints of one figure at the most."""

_PANEL = (2.9, 2.1)  # [inch]
_KINDS = {"float32": "fiu", "float64": "fiu", "int64": "iu", "uint16": "iu", "bool": "b"}
"""Kinds of dtypes that serve for one of the table."""


@takes_quantities()
def library_overview(
    paints: xr.Dataset, path: str | Path | None = None, *, columns: int = 4, spread: str = "quantiles"
) -> Any:
    """Draw every paint of a library: a swatch of its colour, its spectrum and how far its pixels are spread.

    Parameters
    ----------
    paints
        A paint library, as of `hyperpaint.extract_signatures`.
    path
        Where to write a picture (PNG, PDF, ...); nowhere by default.
    columns
        Paints side by side.
    spread
        See `hyperpaint.pictures.spectrum`.

    Returns
    -------
    matplotlib.figure.Figure
        Of at most 48 paints; its title says how many more there are. All axes have the same scale. Spectra
        are in the paints' own colours.

    Raises
    ------
    MissingExtraError
        matplotlib is not installed.
    SchemaError
        It is no paint library, what it holds has other dims, units or dtypes than a library's, or matplotlib
        writes no such picture.

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
    shown = min(count, MOST_PAINTS)
    columns = max(1, min(columns, shown))
    rows = -(-shown // columns)
    size = (_PANEL[0] * columns, _PANEL[1] * rows + 0.4)
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
    """Return a library without what is not as the table says, and what is wrong with that.

    Reads dims, dtypes and attributes only, never values.
    """
    table = schema.LIBRARY_VARIABLES
    names = [name for name in table if name in paints.variables]
    kinds = {name: _KINDS.get(table[name].dtype, paints[name].dtype.kind) for name in names}
    # only numbers can be brought to other units
    alike = [name for name in names if paints[name].dtype.kind in kinds[name]]
    problems = [
        f"{name!r} is {paints[name].dtype}, expected {table[name].dtype}"
        for name in names
        if name not in alike
    ]
    usable, wrong = schema.find(paints, alike, table)
    return paints.drop_vars([name for name in names if name not in usable]), [*problems, *wrong]


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
        swatch = Rectangle(
            (0.0, 1.0), 1.0, 0.05, transform=axes.transAxes, clip_on=False, facecolor=colour.tolist(),
            edgecolor="0.5", lw=0.5,
        )  # fmt: skip
        axes.add_patch(swatch)
    axes.tick_params(labelsize="small")


def draw_uncertainties(axes: Any, paints: xr.Dataset) -> None:
    """Draw how sure the mean of each paint is, and its random part; of at most `MOST_CURVES` paints."""
    names = [f"reflectance_u_{kind}" for kind in ("random", "systematic")]
    held = [name for name in names if name in paints.variables]
    few = paints.isel({schema.SIGNATURE: slice(MOST_CURVES)})
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
