"""Pictures of processing: counts, radiance and reflectance; a line before and after straightening."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base import schema
from hyperpaint.base.arrays import Array
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.facts import documented
from hyperpaint.base.schema import ALONG_TRACK, BAND, CROSS_TRACK, Quality
from hyperpaint.geometry.orthorectification.mapping import orthorectify
from hyperpaint.paints.signatures import EXCLUDED
from hyperpaint.paints.signatures.pixel_statistics import QUANTILES, gather
from hyperpaint.radiometry.counts_to_reflectance import radiance, reflectance
from hyperpaint.regions import pixels_of, regions_from

from .figures import (
    columns_for,
    ink_of,
    label_for,
    legend_below,
    new_figure,
    orientation_of,
    save_figure,
    show_picture,
)
from .plot import finite_quantiles, rgb
from .plot_spectra import checked_places, draw_pixels, good_bands

MAX_REGION_PIXELS = 4096  # pixels drawn in a triptych; larger regions are subsampled
_LABELS = {
    "counts": "counts [count]",
    "radiance": "radiance [W m$^{-2}$ sr$^{-1}$ nm$^{-1}$]",
    "reflectance": "reflectance factor [1]",
}
_BLUE = "#3399DD"  # visible on light and dark backgrounds
_AXES_INCH = (4.3, 4.4)


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
    size = (width, _AXES_INCH[1] * (3 // columns))
    figure = new_figure("a triptych", figsize=size, layout="constrained")
    dataset = schema.rename_to_roles(dataset)
    counts = schema.require(dataset, ["counts", "wavelength"], "a triptych")["counts"]
    if (region is None) == (pixels is None):
        raise SchemaError(
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
        problems = Problems("pixels cannot be drawn", SchemaError)
        places = checked_places(dataset, pixels, problems)
        problems.raise_if_any()
        line_indices, column_indices = places.T
        spectra, values = gather(
            cubes, {"quality": calibrated["quality"]}, line_indices, column_indices, slice(None), {}
        )
        draw_pixels(plots, dataset, spectra, values["quality"], places)
    else:
        line_indices, column_indices, spectra = _pixels_of_region(
            figure, dataset, cubes, calibrated["quality"], region, exclude
        )
        for axes, cube in zip(plots, spectra.values(), strict=True):
            quantiles = finite_quantiles(np.where(good_bands(dataset), cube, np.nan), QUANTILES)
            for lower, upper, alpha, label in ((0, 4, 0.2, "5 to 95 %"), (1, 3, 0.4, "middle half")):
                axes.fill_between(
                    wavelength,
                    quantiles[lower],
                    quantiles[upper],
                    color=_BLUE,
                    alpha=alpha,
                    lw=0,
                    label=label,
                )
            axes.plot(wavelength, quantiles[2], color=_BLUE, lw=1.6, label="median")
    # dark counts of these columns, and the saturation count
    dark, saturation = (dataset.variables.get(name) for name in ("dark_counts", "saturation_count"))
    if dark is not None and dark.dims == (BAND, CROSS_TRACK):
        level = np.median(dark.values[:, np.unique(column_indices)], axis=1)
        plots[0].plot(wavelength, level, color=ink_of(plots[0], 0.7), lw=1, ls="--", label="dark")
    if saturation is not None and saturation.ndim == 0:
        plots[0].axhline(float(saturation), color="#D55E00", lw=1, ls=":", label="saturation")
    _draw_white(plots[1], dataset, line_indices)
    for axes, name in zip(plots, cubes, strict=True):
        axes.set(title=name, xlabel="wavelength [nm]", ylabel=_LABELS[name])
        axes.set_ylim(bottom=0)
        legend_below(axes)
    save_figure(figure, path)
    return figure


def _pixels_of_region(
    figure: Any,
    dataset: xr.Dataset,
    cubes: dict[str, xr.DataArray],
    quality: xr.DataArray,
    region: Any,
    exclude: Quality | int | None,
) -> tuple[Array, Array, dict[str, Array]]:
    # line and column indices of the pixels used, and their spectra (pixel, band)
    outlined = regions_from(region)
    if len(outlined) != 1:
        raise SchemaError(
            f"a triptych shows one region, found {len(outlined)}",
            mend="choose one, such as regions[0]",
            code="region-number",
        )
    line_indices, column_indices = pixels_of(outlined, dataset)[0]
    step = max(1, -(-line_indices.size // MAX_REGION_PIXELS))
    line_indices, column_indices = line_indices[::step], column_indices[::step]
    spectra, values = gather(cubes, {"quality": quality}, line_indices, column_indices, slice(None), {})
    is_used = (values["quality"] & int(EXCLUDED if exclude is None else exclude)) == 0
    is_used &= np.isfinite(spectra["reflectance"]).any(axis=1)
    name = outlined[0].name
    if not is_used.any():
        raise SchemaError(
            f"region {name!r}: all {line_indices.size} pixels are flagged",
            mend="draw the region elsewhere, or pass fewer flags as exclude",
            code="region-empty",
        )
    figure.suptitle(f"{label_for(name)}: {int(is_used.sum())} of {line_indices.size} pixels")
    return (
        line_indices[is_used],
        column_indices[is_used],
        {key: cube[is_used] for key, cube in spectra.items()},
    )


def _draw_white(axes: Any, dataset: xr.Dataset, line_indices: Array) -> None:
    # radiance of a white surface at the median time of the pixels, in the camera's wavelength range
    if "irradiance" not in dataset.variables or "time" not in dataset.coords:
        return
    series = schema.require(dataset, ["irradiance"], "a triptych")["irradiance"]
    times = dataset["time"].values[line_indices]
    times = times[~np.isnat(times)]
    if not times.size:
        return
    sample = np.abs(series[schema.IRRADIANCE_TIME].values - np.sort(times)[times.size // 2]).argmin()
    nm = series[schema.IRRADIANCE_WAVELENGTH].values
    min_nm, max_nm = axes.get_xlim()
    is_shown = (nm >= min_nm) & (nm <= max_nm)
    white = series.isel({schema.IRRADIANCE_TIME: int(sample)}).values[is_shown] / np.pi
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
    line = schema.rename_to_roles(line)
    if "reflectance" not in line.variables:
        line = reflectance(line)
    if orthomap is None:
        if not {"east", "north"} <= set(line.coords) and "ground" not in line.attrs:
            raise SchemaError(
                "the line is not located and declares no ground height, so it has no map",
                mend="pass line.paint.locate(...), or its map as orthomap",
                code="line-not-located",
            )
        nm = schema.require(line, ["wavelength"], "a map")["wavelength"].values
        visible = line.isel({BAND: np.flatnonzero((nm > 380) & (nm < 780))})
        orthomap = orthorectify(visible, grid="north", variables=["reflectance"])
    columns = columns_for(width, 3.0, 2)
    datasets = (("as recorded", line), ("straightened", schema.rename_to_roles(orthomap)))
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
    save_figure(figure, path)
    return figure
