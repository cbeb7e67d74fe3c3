"""Pictures of the chain: counts, radiance and reflectance; a line before and after straightening."""

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
from hyperpaint.paints.signatures.pixel_gathering import gather
from hyperpaint.paints.signatures.pixel_statistics import QUANTILES
from hyperpaint.radiometry.counts_to_reflectance import radiance, reflectance
from hyperpaint.regions import pixels_of, regions_from

from .figures import columns_for, ink_of, label_for, legend_below, new_figure, save_figure
from .orientation import orientation_of, show_picture
from .plot import known_quantiles, rgb
from .plot_spectra import checked_places, draw_pixels, good_of

MAX_PIXELS = 4096  # of a region in a triptych; of a larger region every n-th pixel is used
_LABELS = {
    "counts": "counts [count]",
    "radiance": "radiance [W m$^{-2}$ sr$^{-1}$ nm$^{-1}$]",
    "reflectance": "reflectance factor [1]",
}
_BLUE = "#3399DD"  # seen on light and on dark ground
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

    Eager: the blocks of lines with the pixels are read. For a region curves are medians over the pixels,
    shades the middle half and 5 to 95 % of them; of more than 4096 pixels every n-th is used. Single pixels
    have a curve each in their own colour, whatever their flags, glint included: figure 2, b to d, of the
    paper.

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
        Three axes. The counts come with dark counts and saturation count; the radiance with the radiance of
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
            "a triptych shows a region or pixels=(along_track, cross_track)",
            mend="give one of them",
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
        along, across = places.T
        spectra, values = gather(cubes, {"quality": calibrated["quality"]}, along, across, slice(None), {})
        draw_pixels(plots, dataset, spectra, values["quality"], places)
    else:
        along, across, spectra = _pixels_of_region(
            figure, dataset, cubes, calibrated["quality"], region, exclude
        )
        for axes, cube in zip(plots, spectra.values(), strict=True):
            parts = known_quantiles(np.where(good_of(dataset), cube, np.nan), QUANTILES)
            for low, high, alpha, label in ((0, 4, 0.2, "5 to 95 %"), (1, 3, 0.4, "middle half")):
                axes.fill_between(
                    wavelength, parts[low], parts[high], color=_BLUE, alpha=alpha, lw=0, label=label
                )
            axes.plot(wavelength, parts[2], color=_BLUE, lw=1.6, label="median")
    # dark counts of these columns, and the saturation count
    dark, full = (dataset.variables.get(name) for name in ("dark_counts", "saturation_count"))
    if dark is not None and dark.dims == (BAND, CROSS_TRACK):
        level = np.median(dark.values[:, np.unique(across)], axis=1)
        plots[0].plot(wavelength, level, color=ink_of(plots[0], 0.7), lw=1, ls="--", label="dark")
    if full is not None and full.ndim == 0:
        plots[0].axhline(float(full), color="#D55E00", lw=1, ls=":", label="saturation")
    _draw_white(plots[1], dataset, along)
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
    # places along and across the track, and spectra (pixel, band)
    outlined = regions_from(region)
    if len(outlined) != 1:
        raise SchemaError(
            f"a triptych shows one region, found {len(outlined)}",
            mend="index them, such as regions[0]",
            code="region-number",
        )
    along, across = pixels_of(outlined, dataset)[0]
    step = max(1, -(-along.size // MAX_PIXELS))
    along, across = along[::step], across[::step]
    spectra, values = gather(cubes, {"quality": quality}, along, across, slice(None), {})
    used = (values["quality"] & int(EXCLUDED if exclude is None else exclude)) == 0
    used &= np.isfinite(spectra["reflectance"]).any(axis=1)
    name = outlined[0].name
    if not used.any():
        raise SchemaError(
            f"region {name!r}: all {along.size} pixels are flagged",
            mend="draw it elsewhere, or exclude less",
            code="region-empty",
        )
    figure.suptitle(f"{label_for(name)}: {int(used.sum())} of {along.size} pixels")
    return along[used], across[used], {key: cube[used] for key, cube in spectra.items()}


def _draw_white(axes: Any, dataset: xr.Dataset, along: Array) -> None:
    # radiance of a white surface under the irradiance of that moment, in the camera's range
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
    axes.plot(samples[there], white, color=ink_of(axes, 0.7), lw=1, ls="--", label="white surface")


# --- before and after straightening ------------------------------------------------------------------------

_MAX_LINES = 1500  # of the raw picture, and rows of the map


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
        located, or declare its ``ground``, and is mapped here, north up.
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
        There is no reflectance, or fewer than three visible bands; or there is no map, and the line is not
        located.

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
                mend="pass line.paint.locate(...), or its map",
                code="line-not-located",
            )
        nm = schema.require(line, ["wavelength"], "a map")["wavelength"].values
        visible = line.isel({BAND: np.flatnonzero((nm > 380) & (nm < 780))})
        orthomap = orthorectify(visible, grid="north", variables=["reflectance"])
    columns = columns_for(width, 3.0, 2)
    shown = (("as recorded", line), ("straightened", schema.rename_to_roles(orthomap)))
    orientations = [orientation_of(dataset) for _, dataset in shown]
    heights = [min(0.8 * each.height_of(width / columns - 0.9), 9.0) + 1.1 for each in orientations]
    height = max(heights) if columns == 2 else sum(heights)
    figure = new_figure("a line before and after", figsize=(width, height + 0.3), layout="constrained")
    grid = figure.add_gridspec(2 // columns, columns, height_ratios=heights if columns == 1 else None)
    for number, (title, dataset) in enumerate(shown):
        axes = figure.add_subplot(grid[divmod(number, columns)])
        steps = {dim: max(1, dataset.sizes[dim] // _MAX_LINES) for dim in (ALONG_TRACK, CROSS_TRACK)}
        few = dataset.isel({dim: slice(None, None, step) for dim, step in steps.items()})
        show_picture(axes, rgb(few).values, orientations[number])
        axes.set_title(title)
    figure.suptitle(label_for(line.attrs.get("name", "flight line")))
    save_figure(figure, path)
    return figure
