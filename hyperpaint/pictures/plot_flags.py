"""Flags, continuous layers, and the light of a coloured neighbour, drawn over a flight line."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base import schema
from hyperpaint.base.arrays import Array
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.facts import documented
from hyperpaint.base.schema import ALONG_TRACK, BAND, CROSS_TRACK, Quality, numbers_of
from hyperpaint.base.units import takes_quantities
from hyperpaint.paints.signatures.pixel_statistics import gather
from hyperpaint.radiometry.counts_to_reflectance import reflectance
from hyperpaint.regions import Region, pixels_of, regions_from

from .figures import (
    Orientation,
    axes_or_new,
    axes_width,
    columns_for,
    ink_of,
    label_for,
    legend_below,
    new_figure,
    orientation_of,
    save_figure,
    show_picture,
)
from .plot import flag_label, flags_of, percent, rgb, stored_picture


@documented()
def flag_overlay(
    dataset: xr.Dataset,
    flags: Quality | str | Iterable[str] | None = None,
    *,
    layer: str | None = None,
    lines: int = 1000,
    opacity: float = 0.75,
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
        Flags to draw: `Quality`, or names such as ``"glint"``; by default all flags that occur, or with a
        layer no flags.
    layer
        Name of a variable (along_track, cross_track), such as a fraction of glint.
    lines
    opacity
        Opacity of flags or layer, from 0 to 1.
    axes

    Returns
    -------
    matplotlib.axes.Axes
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
    >>> axes = flag_overlay(line, ["saturated", "shadow"])
    >>> axes.get_xlabel()
    'cross_track [column]'
    """
    dataset = schema.rename_to_roles(dataset)
    chosen: tuple[Quality, ...] = ()  # all flags
    if isinstance(flags, Quality):
        chosen = tuple(flag for flag in Quality if flag & flags)
    elif flags is not None:
        chosen = tuple(schema.flags_named([flags] if isinstance(flags, str) else map(str, flags)))
    planes = [
        str(name)
        for name, array in dataset.variables.items()
        if set(array.dims) == {ALONG_TRACK, CROSS_TRACK} and array.dtype.kind in "fiub"
    ]
    if layer is not None and layer not in planes:
        raise SchemaError(
            f"no layer {layer!r} on (along_track, cross_track)",
            expected=", ".join(planes) or "a line with layers",
            code="variable-missing",
        )
    if "quality" not in dataset.variables and (layer is None or chosen):
        dataset = reflectance(dataset)
    schema.require(dataset, ["quality"] if layer is None else [], "a picture of flags")
    step = max(1, -(-dataset.sizes[ALONG_TRACK] // max(lines, 1)))
    orientation = orientation_of(dataset)
    height = min(max(orientation.height_of(4.0), 3.5), 12.0) + 1.0
    axes = axes_or_new(axes, "a picture of flags", figsize=(6.8, height))
    show_picture(axes, background(dataset, step), orientation)
    axes.set(title=label_for(dataset.attrs.get("name", "flight line")))
    if layer is not None:
        _draw_layer(axes, dataset, orientation, layer, step, opacity)
    if layer is None or chosen:
        _draw_flags(axes, dataset, orientation, chosen, step, opacity)
    return axes


def background(dataset: xr.Dataset, step: int) -> Array:
    """Return a picture (line, column, rgb) of every ``step``-th line, 0 to 1, stored or computed."""
    overview = stored_picture(dataset, step)
    if overview is not None:
        return np.asarray(overview.values)
    return np.asarray(rgb(dataset.isel({ALONG_TRACK: slice(None, None, step)})).values)


def draw_outlines(axes: Any, regions: Iterable[Region], *, width: float = 1.0, named: bool = True) -> None:
    """Outline regions (sensor coordinates) with their names on axes of `flag_overlay`."""
    from matplotlib.patheffects import withStroke

    rim = [withStroke(linewidth=2.5, foreground="black")]
    for region in regions:
        for ring in (region.polygon, *region.holes):
            x, y = np.vstack([ring, ring[:1]]).T
            axes.plot(x, y, color="white", lw=width, path_effects=rim)
        if named:
            across, along = region.polygon.mean(axis=0)
            style = {"color": "white", "fontsize": "x-small", "ha": "center", "va": "center", "clip_on": True}
            axes.text(across, along, label_for(region.name), path_effects=rim, **style)


_NARROW_INCH = 5.0  # width of a picture below which its legend is below it


# --- flags -------------------------------------------------------------------------------------------------


def _draw_flags(
    axes: Any,
    dataset: xr.Dataset,
    orientation: Orientation,
    chosen: tuple[Quality, ...],
    step: int,
    opacity: float,
) -> None:
    # draw flags in their colours, the rarest on top, with a legend of shares
    from matplotlib.colors import to_rgb
    from matplotlib.patches import Patch

    quality = flags_of(dataset)
    shares = schema.flag_shares(quality)
    flags = chosen or tuple(shares)
    bits = reduced_lines(quality, step, np.bitwise_or)
    picture = np.zeros((*bits.shape, 4), np.float32)
    for flag in sorted(flags, key=lambda flag: -shares.get(flag, 0.0)):
        picture[(bits & int(flag)) != 0] = (*to_rgb(flag.colour), opacity)
    show_picture(axes, picture, orientation)
    entries = {}
    for flag in flags:
        label = f"{flag_label(flag)}  {percent(shares.get(flag, 0.0))}"
        entries[label] = Patch(facecolor=flag.colour, edgecolor="0.5", lw=0.5)
    entries = entries or {"no flag set": Patch(facecolor="none")}
    title = "share of pixels"
    if axes_width(axes) < _NARROW_INCH:
        legend_below(axes, entries=entries, title=title, alignment="left")
    else:
        options = {"loc": "upper left", "bbox_to_anchor": (1.0, 1.0)}
        axes.legend(entries.values(), entries.keys(), fontsize="small", frameon=False, title=title, **options)


def reduced_lines(values: Array, step: int, combine: Any) -> Array:
    """Combine every ``step`` lines into one by the ufunc ``combine``."""
    if step == 1:
        return values
    return np.asarray(combine.reduceat(values, np.arange(0, len(values), step), axis=0))


# --- layers ------------------------------------------------------------------------------------------------


def _draw_layer(
    axes: Any, dataset: xr.Dataset, orientation: Orientation, layer: str, step: int, opacity: float
) -> None:
    # draw a layer that is transparent at zero and has full opacity from a third of its range
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    array = dataset[layer].transpose(ALONG_TRACK, CROSS_TRACK)
    values = reduced_lines(array.values.astype(np.float32), step, np.fmax)
    finite = values[np.isfinite(values)]
    minimum, maximum = np.percentile(finite, (0.2, 99.8)).tolist() if finite.size else (0.0, 0.0)
    is_signed = -minimum > 0.05 * max(maximum, 0.0) and minimum < 0  # values slightly below zero are noise
    limit = max(abs(minimum), abs(maximum)) if is_signed else maximum
    limit = limit if limit > 0 else 1.0
    colours = ScalarMappable(
        Normalize(-limit if is_signed else 0.0, limit), "PuOr_r" if is_signed else "inferno"
    )
    masked = np.ma.masked_invalid(values)
    image = show_picture(axes, masked, orientation, cmap=colours.cmap, norm=colours.norm)
    magnitude = np.abs(values) if is_signed else np.maximum(values, 0.0)
    image.set_alpha(np.nan_to_num(opacity * np.clip(3.0 * magnitude / limit, 0.0, 1.0)))
    units = str(array.attrs.get("units", ""))
    caption = f"{label_for(layer)} [{label_for(units)}]" if units else label_for(layer)
    options = {"location": "bottom", "pad": 0.02} if axes_width(axes) < _NARROW_INCH else {"pad": 0.01}
    axes.figure.colorbar(colours, ax=axes, label=caption, fraction=0.04, **options)


# --- light of neighbours -------------------------------------------------------------------------------


# colours of up to four bands by rising wavelength; more bands take matplotlib's colours
_COLOURS = ("#3399DD", "#009E73", "#D55E00", "#CC79A7")
_NEAR_COLOUR, _FAR_COLOUR = "#D55E00", "#808080"
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
    size = (figure_width, 5.6 if is_wide else 14.0)
    figure = new_figure("a figure of adjacency", figsize=size, layout="constrained")
    line = schema.rename_to_roles(line)
    variables = schema.require(line, ["reflectance", "wavelength"], "a figure of adjacency")
    lines = {"": line} if without is None else {"": line, "without": schema.rename_to_roles(without)}
    regions = _checked_regions(lines, near, far, width)
    places = pixels_of(regions, line)
    route, distance = _transect(places, line.sizes[ALONG_TRACK], line.sizes[CROSS_TRACK], width)
    nm = variables["wavelength"].values
    order = np.argsort(nm, kind="stable")
    ratios = {"width_ratios": (0.9, 1.2, 1.2), "height_ratios": (3, 2)}
    plots = (
        figure.subplot_mosaic([["picture", "along", "spectra"], ["picture", "added", "spectra"]], **ratios)
        if is_wide
        else figure.subplot_mosaic([["picture"], ["along"], ["added"], ["spectra"]])
    )
    _draw_picture(plots["picture"], line, regions, route[:, width // 2])
    transects = {}
    for name, dataset in lines.items():
        cube = schema.require(dataset, ["reflectance"], "a figure of adjacency")["reflectance"]
        style, is_labelled = ("--", False) if name else ("-", True)
        values = _spectra_at(cube, *route.reshape(-1, 2).T).reshape(*route.shape[:2], -1)
        transects[name] = _mean(values, axis=1)
        _draw_bands(plots["along"], distance, transects[name], nm, wavelengths, style, is_labelled)
        for region, place, colour in zip(regions, places, (_NEAR_COLOUR, _FAR_COLOUR), strict=True):
            # mean of the region's pixels; for the line itself also their middle half
            spectra, axes = _spectra_at(cube, *place)[:, order], plots["spectra"]
            mean = _mean(spectra, axis=0)
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
        adjacency = _mean(layer[route[..., 0], route[..., 1]], axis=1)
        ink = ink_of(plots["added"])
        plots["added"].plot(
            distance, adjacency, ":", color=ink, linewidth=1.8, label="adjacency, as flagged [1]"
        )
    _label_adjacency(plots, without is not None)
    save_figure(figure, path)
    return figure


def _label_adjacency(plots: dict[str, Any], compared: bool) -> None:
    plots["along"].set(ylabel="reflectance factor [1]")
    plots["added"].set(xlabel="distance from the near end [pixel]", ylabel="added [1]")
    plots["spectra"].set(xlabel="wavelength [nm]", ylabel="reflectance factor [1]", ylim=(0, None))
    plots["along"].tick_params(labelbottom=False)
    plots["along"].sharex(plots["added"])
    for name in ("along", "added", "spectra"):
        axes = plots[name]
        axes.spines[["top", "right"]].set_visible(False)
        if compared and name != "added":
            axes.plot([], [], "--", color="0.4", label="without the neighbour's colour")
    legend_below(plots["spectra"])
    if plots["added"].lines:
        legend_below(plots["added"], plots["along"])
    else:
        plots["added"].set_axis_off()
        plots["along"].tick_params(labelbottom=True)
        plots["along"].set(xlabel=plots["added"].get_xlabel())
        legend_below(plots["along"])


def _checked_regions(lines: dict[str, xr.Dataset], near: Any, far: Any, width: int) -> Any:
    problems = Problems("adjacency cannot be drawn", SchemaError)
    line, *comparisons = lines.values()
    shape = dict(line["reflectance"].sizes)
    for comparison in comparisons:
        if "reflectance" not in comparison.variables or dict(comparison["reflectance"].sizes) != shape:
            problems.add(
                "without= has no reflectance of the line's size",
                expected=f"shape {shape}",
                code="grid-mismatch",
            )
    if width < 1:
        problems.add(f"width={width}", expected="1 or more pixels", code="value-out-of-range")
    pairs = [regions_from(regions) for regions in (near, far)]
    for name, regions in zip(("near", "far"), pairs, strict=True):
        if len(regions) != 1:
            problems.add(f"{name}= holds {len(regions)} regions", expected="one", code="region-number")
    problems.raise_if_any()
    pair = type(pairs[0])((pairs[0][0], pairs[1][0]), pairs[0].coordinates, pairs[0].crs)
    for region, (along, _) in zip(pair, pixels_of(pair, line), strict=True):
        if not along.size:
            problems.add(f"region {region.name!r} holds no pixel of the line", code="region-empty")
    problems.raise_if_any()
    return pair


def _transect(places: Sequence[Any], lines: int, columns: int, width: int) -> tuple[Array, Array]:
    # pixels (step, width, 2) from the centre of the near region to that of the far one, and distances [pixel]
    start, stop = (np.array([np.mean(along), np.mean(across)]) for along, across in places)
    length = float(np.hypot(*(stop - start)))
    if length < 1.0:
        raise SchemaError(
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
    return np.clip(np.floor(positions + 0.5).astype(np.intp), 0, (lines - 1, columns - 1)), distance


def _spectra_at(cube: xr.DataArray, along: Array, across: Array) -> Array:
    spectra, _ = gather({"reflectance": cube}, {}, along, across, slice(0, cube.sizes[BAND]), {})
    return spectra["reflectance"].astype(np.float64)


def _mean(values: Array, axis: int) -> Array:
    # mean of finite values; NaN where all are missing
    is_finite = np.isfinite(values)
    count = is_finite.sum(axis=axis)
    mean = np.where(is_finite, values, 0.0).sum(axis=axis) / np.maximum(count, 1)
    return np.asarray(np.where(count > 0, mean, np.nan))


def _draw_picture(axes: Any, line: xr.Dataset, regions: Sequence[Region], route: Array) -> None:
    show_picture(axes, background(line, 1), orientation_of(line))
    for region, colour in zip(regions, (_NEAR_COLOUR, _FAR_COLOUR), strict=True):
        across, along = np.vstack([region.polygon, region.polygon[:1]]).T
        axes.plot(across, along, color="white", linewidth=3.0)
        axes.plot(across, along, color=colour, linewidth=1.5)
    rows, columns = numbers_of(line, ALONG_TRACK), numbers_of(line, CROSS_TRACK)
    start, stop = ((columns[across], rows[along]) for along, across in route[[0, -1]])
    for thickness, colour in ((3.0, "white"), (1.2, "black")):
        arrow = {"arrowstyle": "->", "color": colour, "linewidth": thickness}
        axes.annotate("", stop, start, arrowprops=arrow)


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
