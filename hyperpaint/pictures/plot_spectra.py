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
from hyperpaint.paints.colours import paint_colours
from hyperpaint.paints.signatures import EXCLUDED, extract_signatures
from hyperpaint.paints.signatures.extraction import gather
from hyperpaint.paints.signatures.pixel_statistics import QUANTILES
from hyperpaint.radiometry.counts_to_reflectance import radiance, reflectance
from hyperpaint.regions import pixels_of, regions_from

from .figures import axes_or_new, label_for, new_figure, save_figure
from .plot import known_quantiles

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["MOST_PAINTS", "find_usable", "library_overview", "spectrum", "triptych"]


SPREADS = ("quantiles", "sd", "none")
MOST_CURVES = 24
MOST_PIXELS = 4096
"""Pixels of a region that a triptych is drawn from; of a larger one every n-th."""

_LABELS = {
    "counts": "counts",
    "radiance": "radiance [W m$^{-2}$ sr$^{-1}$ nm$^{-1}$]",
    "reflectance": "reflectance factor",
}


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

    Eager: of a flight line the blocks of lines are read that hold the pixels.

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
    axes.set(xlabel="wavelength [nm]", ylabel=_LABELS["reflectance"])
    axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
    axes.legend(fontsize="small", frameon=False)
    return axes


def _is_library(dataset: xr.Dataset) -> bool:
    # a flight line may hold which paint each pixel has
    return "reflectance" in dataset.variables and dataset["reflectance"].dims == (schema.PAINT, BAND)


def _check(library: bool, regions: Any, pixels: Any, paints: Any, spread: str) -> None:
    problems = Problems("spectra cannot be drawn", SchemaError)
    if spread not in SPREADS:
        problems.add(f"spread={spread!r:.40}, expected one of {', '.join(SPREADS)}")
    if library and (regions is not None or pixels is not None):
        problems.add("a paint library has neither regions nor pixels; name paints=, or give a flight line")
    if not library:
        if paints is not None:
            problems.add("paints are those of a library; a flight line has regions= and pixels=")
        if (regions is None) == (pixels is None):
            problems.add("a flight line needs either regions or pixels=(along_track, cross_track)")
    if pixels is not None:
        places = np.asarray(pixels)
        if places.ndim not in (1, 2) or places.shape[-1:] != (2,) or places.dtype.kind not in "iu":
            problems.add(f"pixels={pixels!r:.60}, expected whole (along_track, cross_track), or several")
        elif places.ndim == 2 and len(places) > MOST_CURVES:
            problems.add(f"{len(places)} pixels, expected at most {MOST_CURVES}; outline them as a region")
    problems.raise_if_any()


# --- paints and regions ------------------------------------------------------------------------------------


def _draw_paints(axes: Any, library: xr.Dataset, paints: str | Iterable[str] | None, spread: str) -> None:
    names = [str(name) for name in library[schema.PAINT].values]
    wanted = [paints] if isinstance(paints, str) else names if paints is None else list(paints)
    problems = Problems("paints cannot be drawn", SchemaError)
    if unknown := [name for name in wanted if name not in names]:
        problems.add(f"no paint {', '.join(map(repr, unknown))}; there is {', '.join(names)}")
    if len(wanted) > MOST_CURVES:
        problems.add(
            f"{len(wanted)} curves, expected at most {MOST_CURVES}; name some, or see library_overview"
        )
    problems.raise_if_any()
    for name in wanted:
        own = library.isel({schema.PAINT: names.index(name)})
        wavelength, is_good = _wavelength_of(own)
        centre = np.where(is_good, own["reflectance"].values, np.nan)
        count = f" (n = {int(own['n'])})" if "n" in own else ""
        (curve,) = axes.plot(wavelength, centre, lw=1.6, label=label_for(name) + count)
        draw_band(axes, own, wavelength, is_good, spread, curve.get_color())


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
    return wavelength, _good_of(dataset)


def _good_of(dataset: xr.Dataset) -> Array:
    if "good" in dataset.variables:
        return np.asarray(dataset["good"].values, bool)
    return np.ones(dataset.sizes[BAND], bool)


# --- pixels ------------------------------------------------------------------------------------------------


def _draw_pixels(axes: Any, dataset: xr.Dataset, places: Array) -> None:
    problems = Problems("pixels cannot be drawn", SchemaError)
    size = dataset.sizes.get(ALONG_TRACK, 0), dataset.sizes.get(CROSS_TRACK, 0)
    for along, across in places.tolist():
        if not (0 <= along < size[0] and 0 <= across < size[1]):
            problems.add(f"pixel ({along}, {across}) is outside of {size[0]} lines of {size[1]} columns")
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
    for number, (along, across) in enumerate(places.tolist()):
        at = wavelength + shift[:, across]
        shown = np.where(is_good, spectra["reflectance"][number], np.nan)
        bits = int(values["quality"][number]) if planes else 0
        flags = ", ".join(schema.flag_names(bits)).replace("_", " ")
        label = f"({along}, {across})" + (f": {flags}" if flags else "")
        (curve,) = axes.plot(at, shown, lw=1.2, label=label)
        if names:
            u = np.sqrt(sum(spectra[name][number].astype(np.float64) ** 2 for name in names))
            axes.fill_between(at, shown - u, shown + u, color=curve.get_color(), alpha=0.25, lw=0)


# --- from counts to reflectance ----------------------------------------------------------------------------


def triptych(
    dataset: xr.Dataset, region: Any, path: str | Path | None = None, *, exclude: Quality | int | None = None
) -> Any:
    r"""Draw one region as counts, as radiance and as reflectance, side by side.

    Eager: the blocks of lines are read that hold the region. Curves are medians over the pixels, shades the
    middle half and 5 to 95 % of them; of a region of more than 4096 pixels every n-th is taken.

    Parameters
    ----------
    dataset
        A flight line with ``counts`` and what calibrates them.
    region
        A `hyperpaint.Region`, or anything that `hyperpaint.read_regions` knows and that holds one.
    path
        Where to write a picture (PNG, PDF, ...); nowhere by default.
    exclude
        Flags of pixels that are left out; by default as `hyperpaint.extract_signatures` does.

    Returns
    -------
    matplotlib.figure.Figure
        Of three axes. Beside the counts stand the dark ones and the saturation count; beside the radiance
        that of a white surface, :math:`\pi^{-1} E`, at the time nearest to the region.

    Raises
    ------
    FormatError
        The region cannot be read.
    MissingExtraError
        matplotlib is not installed.
    SchemaError, UnitsError
        There is more than one region, none of its pixels are left, or the flight line lacks what reflectance
        follows from.
    """
    figure = new_figure("a triptych", figsize=(13, 4.2), layout="constrained")
    dataset = schema.rename_to_roles(dataset)
    counts = schema.require(dataset, ["counts", "wavelength"], "a triptych")["counts"]
    outlined = regions_from(region)
    if len(outlined) != 1:
        raise SchemaError(
            f"a triptych shows one region, found {len(outlined)}; index them, such as regions[0]"
        )
    calibrated = reflectance(dataset)
    cubes = {
        "counts": counts,
        "radiance": radiance(dataset)["radiance"],
        "reflectance": calibrated["reflectance"],
    }
    along, across = pixels_of(outlined, dataset)[0]
    step = max(1, -(-along.size // MOST_PIXELS))
    planes = {"quality": calibrated["quality"]}
    along, across = along[::step], across[::step]
    spectra, values = gather(cubes, planes, along, across, slice(None), {})
    used = (values["quality"] & int(EXCLUDED if exclude is None else exclude)) == 0
    used &= np.isfinite(spectra["reflectance"]).any(axis=1)
    if not used.any():
        name = outlined[0].name
        raise SchemaError(
            f"region {name!r}: none of {along.size} pixels is left; draw it elsewhere, or exclude less"
        )
    figure.suptitle(f"{label_for(outlined[0].name)}: {int(used.sum())} of {along.size} pixels")
    wavelength, is_good = _wavelength_of(dataset)
    for axes, (name, cube) in zip(figure.subplots(1, 3), spectra.items(), strict=True):
        _draw_quantiles(axes, wavelength, np.where(is_good, cube[used], np.nan))
        axes.set(title=name, xlabel="wavelength [nm]", ylabel=_LABELS[name])
    _draw_limits(figure.axes[0], dataset, wavelength, across[used])
    _draw_white(figure.axes[1], dataset, along[used])
    for axes in figure.axes:
        axes.set_ylim(bottom=0)
        axes.legend(fontsize="small", frameon=False)
    save_figure(figure, path)
    return figure


def _draw_quantiles(axes: Any, wavelength: Array, values: Array) -> None:
    """Draw the median of pixels (pixel, band) and their spread; bands without any value stay empty."""
    parts = known_quantiles(values, QUANTILES)
    axes.fill_between(wavelength, parts[0], parts[4], color="#0072B2", alpha=0.15, lw=0, label="5 to 95 %")
    axes.fill_between(wavelength, parts[1], parts[3], color="#0072B2", alpha=0.3, lw=0, label="middle half")
    axes.plot(wavelength, parts[2], color="#0072B2", lw=1.6, label="median")


def _draw_limits(axes: Any, dataset: xr.Dataset, wavelength: Array, across: Array) -> None:
    """Draw the dark counts of the region's columns, and the count at which the converter is full."""
    columns = np.unique(across)
    dark = dataset["dark_counts"] if "dark_counts" in dataset.variables else None
    if dark is not None and dark.dims == (BAND, CROSS_TRACK):
        own = np.median(dark.values[:, columns], axis=1)
        axes.plot(wavelength, own, color="0.4", lw=1, ls="--", label="dark")
    full = dataset["saturation_count"] if "saturation_count" in dataset.variables else None
    if full is not None and full.ndim == 0:
        axes.axhline(float(full), color="#D55E00", lw=1, ls=":", label="saturation")


def _draw_white(axes: Any, dataset: xr.Dataset, along: Array) -> None:
    """Draw the radiance of a white surface under the irradiance of that moment, where the camera sees."""
    if "irradiance" not in dataset.variables or "time" not in dataset.coords:
        return
    series = schema.require(dataset, ["irradiance"], "a triptych")["irradiance"]
    times = dataset["time"].values[along]
    times = times[~np.isnat(times)]
    if not times.size:
        return
    moment = np.abs(series[schema.IRRADIANCE_TIME].values - np.sort(times)[times.size // 2]).argmin()
    samples = series[schema.IRRADIANCE_WAVELENGTH].values
    low, high = axes.get_xlim()
    there = (samples >= low) & (samples <= high)
    white = series.isel({schema.IRRADIANCE_TIME: int(moment)}).values[there] / np.pi
    axes.plot(samples[there], white, color="0.4", lw=1, ls="--", label="white surface")


# --- paint libraries -----------------------------------------------------------------------------------


MOST_PAINTS = 48
"""Paints of one figure at the most."""

_PANEL = (2.9, 2.1)  # [inch]
_CURVE = "#222222"
_KINDS = {"float32": "fiu", "float64": "fiu", "int64": "iu", "uint16": "iu", "bool": "b"}
"""Kinds of dtypes that serve for one of the table."""


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
        Of at most 48 paints; its title says how many more there are. All axes have the same scale.

    Raises
    ------
    MissingExtraError
        matplotlib is not installed.
    SchemaError
        It is no paint library, what it holds has other dims, units or dtypes than a library's, or matplotlib
        writes no such picture.
    """
    paints, wrong = find_usable(paints)
    problems = Problems("a paint library cannot be drawn", SchemaError)
    for problem in wrong:
        problems.add(problem)
    problems.raise_if_any()
    variables = schema.require(paints, ["reflectance", "wavelength"], "an overview", schema.LIBRARY_VARIABLES)
    count = paints.sizes[schema.PAINT]
    if not count:
        raise SchemaError("an overview needs paints, the library has none")
    shown = min(count, MOST_PAINTS)
    columns = max(1, min(columns, shown))
    rows = -(-shown // columns)
    size = (_PANEL[0] * columns, _PANEL[1] * rows + 0.4)
    figure = new_figure("a picture of a paint library", figsize=size, layout="constrained")
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    wavelength, good = variables["wavelength"].values, _good_of(paints)
    colours = paint_colours(paints)
    for number, axes in enumerate(grid.ravel()):
        if number < shown:
            _draw_paint(axes, paints.isel({schema.PAINT: number}), wavelength, good, spread, colours[number])
        else:
            axes.set_axis_off()
    # the last axes of a column carry its wavelengths, also where the row below is not full
    for number in range(max(0, shown - columns), shown):
        axes = grid.ravel()[number]
        axes.tick_params(labelbottom=True)
        axes.set_xlabel("wavelength [nm]", fontsize="small")
    grid[0, 0].set_ylim(bottom=min(0.0, grid[0, 0].get_ylim()[0]))
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

    draw_band(axes, paint, wavelength, good, spread, _CURVE)
    axes.plot(wavelength, np.where(good, paint["reflectance"].values, np.nan), color=_CURVE, lw=1.3)
    count = f"  n = {int(paint['n'])}" if "n" in paint else ""
    title = label_for(paint[schema.PAINT].item()) + count
    axes.set_title(title, fontsize="small", loc="left", pad=11 if np.isfinite(colour).all() else None)
    if np.isfinite(colour).all():
        swatch = Rectangle(
            (0.0, 1.0), 1.0, 0.05, transform=axes.transAxes, clip_on=False, facecolor=colour.tolist(),
            edgecolor="0.5", lw=0.5,
        )  # fmt: skip
        axes.add_patch(swatch)
    axes.tick_params(labelsize="small")
