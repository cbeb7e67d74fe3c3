"""The chain in pictures: counts, radiance and reflectance; a line before and after straightening."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hyperpaint.base import schema
from hyperpaint.base.arrays import Array
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.schema import ALONG_TRACK, BAND, CROSS_TRACK, Quality
from hyperpaint.paints.signatures import EXCLUDED
from hyperpaint.paints.signatures.pixel_gathering import gather
from hyperpaint.paints.signatures.pixel_statistics import QUANTILES
from hyperpaint.radiometry.counts_to_reflectance import radiance, reflectance
from hyperpaint.regions import pixels_of, regions_from

from .figures import columns_for, ink_of, label_for, legend_below, new_figure, save_figure
from .orientation import orientation_of, show_picture
from .plot import known_quantiles, rgb
from .plot_spectra import MOST_CURVES, draw_curve, good_of, pixel_colours, pixel_label, styles_of

if TYPE_CHECKING:
    import xarray as xr

MOST_PIXELS = 4096
"""Pixels of a region that a triptych is drawn from; of a larger one every n-th."""

_LABELS = {
    "counts": "counts [count]",
    "radiance": "radiance [W m$^{-2}$ sr$^{-1}$ nm$^{-1}$]",
    "reflectance": "reflectance factor [1]",
}
_BLUE = "#3399DD"  # seen on light and on dark ground
_PANEL = (4.3, 4.4)  # [inch]


def triptych(
    dataset: xr.Dataset,
    region: Any = None,
    path: str | Path | None = None,
    *,
    pixels: Sequence[int] | Sequence[Sequence[int]] | None = None,
    exclude: Quality | int | None = None,
    width: float = 13.0,
) -> Any:
    r"""Draw one region, or single pixels, as counts, as radiance and as reflectance, side by side.

    Eager: the blocks of lines are read that hold the pixels. Of a region curves are medians over the pixels,
    shades the middle half and 5 to 95 % of them; of more than 4096 pixels every n-th is taken. Single pixels
    have a curve each in their own colour, whatever their flags, glint included: figure 2, b to d, of the
    paper.

    Parameters
    ----------
    dataset
        A flight line with ``counts`` and what calibrates them.
    region
        A `hyperpaint.Region`, or anything that `hyperpaint.read_regions` knows and that holds one.
    pixels
        In place of a region: (along_track, cross_track) of a pixel, or several such pairs.
    path
        Where to write a picture (PNG, PDF, ...); nowhere by default.
    exclude
        Flags of pixels of the region that are left out; by default as `hyperpaint.extract_signatures` does.
    width
        Of the figure [inch]; below 8.6 the panels stand one above the other.

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
        There is more than one region, none of its pixels are left, or pixels lie beside the line; or the
        flight line lacks what reflectance follows from.

    Examples
    --------
    >>> from hyperpaint.simulation import simulate_line
    >>> from hyperpaint.regions import Region
    >>> line = simulate_line(lines=32, bands=40, columns=24)
    >>> figure = triptych(line, Region("grass", [(0, 0), (0, 31), (0.4, 31), (0.4, 0)]))
    >>> [axes.get_title() for axes in figure.axes]
    ['counts', 'radiance', 'reflectance']
    """
    columns = columns_for(width, _PANEL[0], 3)
    columns = columns if columns == 3 else 1
    size = (width, _PANEL[1] * (3 // columns))
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
    panels = figure.subplots(3 // columns, columns, squeeze=False).ravel()
    wavelength = dataset["wavelength"].values
    if pixels is not None:
        along, across = _checked_pixels(dataset, pixels)
        spectra, values = gather(cubes, {"quality": calibrated["quality"]}, along, across, slice(None), {})
        _draw_pixels(panels, dataset, spectra, values["quality"], (along, across))
    else:
        along, across, spectra = _pixels_of_region(
            figure, dataset, cubes, calibrated["quality"], region, exclude
        )
        for axes, cube in zip(panels, spectra.values(), strict=True):
            _draw_quantiles(axes, wavelength, np.where(good_of(dataset), cube, np.nan))
    _draw_limits(panels[0], dataset, wavelength, across)
    _draw_white(panels[1], dataset, along)
    for axes, name in zip(panels, cubes, strict=True):
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
    """Return places along and across the track of a region's pixels, and their spectra (pixel, band)."""
    outlined = regions_from(region)
    if len(outlined) != 1:
        raise SchemaError(
            f"a triptych shows one region, found {len(outlined)}",
            mend="index them, such as regions[0]",
            code="region-number",
        )
    along, across = pixels_of(outlined, dataset)[0]
    step = max(1, -(-along.size // MOST_PIXELS))
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


def _checked_pixels(dataset: xr.Dataset, pixels: Any) -> tuple[Array, Array]:
    """Return places of pixels along and across the track, refused where they are no pixels of the line."""
    places = np.atleast_2d(np.asarray(pixels))
    problems = Problems("pixels cannot be drawn", SchemaError)
    if places.ndim != 2 or places.shape[-1] != 2 or places.dtype.kind not in "iu":
        problems.add(
            f"pixels={pixels!r:.60}",
            expected="one whole (along_track, cross_track), or several",
            code="type-wrong",
        )
        problems.raise_if_any()
    size = dataset.sizes[ALONG_TRACK], dataset.sizes[CROSS_TRACK]
    if len(places) > MOST_CURVES:
        problems.add(
            f"{len(places)} pixels",
            expected=f"at most {MOST_CURVES}",
            mend="outline them as a region",
            code="curve-number",
        )
    for along, across in places.tolist():
        if not (0 <= along < size[0] and 0 <= across < size[1]):
            problems.add(
                f"pixel ({along}, {across}) is outside of {size[0]} lines of {size[1]} columns",
                code="pixel-outside",
            )
    problems.raise_if_any()
    return places[:, 0], places[:, 1]


def _draw_pixels(
    panels: Any,
    dataset: xr.Dataset,
    spectra: dict[str, Array],
    quality: Array,
    places: tuple[Array, Array],
) -> None:
    """Draw single pixels in their own colours, at the wavelengths of their own columns."""
    wavelength, is_good = dataset["wavelength"].values, good_of(dataset)
    shift = np.zeros((wavelength.size, dataset.sizes[CROSS_TRACK]))
    if "wavelength_shift" in dataset.variables:
        own = schema.require(dataset, ["wavelength_shift"], "a triptych")["wavelength_shift"]
        shift = np.broadcast_to(own.values, shift.shape)
    styles = styles_of(pixel_colours(np.where(is_good, spectra["reflectance"], np.nan), wavelength))
    for axes, cube in zip(panels, spectra.values(), strict=True):
        for number, (along, across) in enumerate(zip(*(place.tolist() for place in places), strict=True)):
            label = pixel_label(along, across, int(quality[number]))
            shown = np.where(is_good, cube[number], np.nan)
            draw_curve(axes, wavelength + shift[:, across], shown, styles[number], label)


def _draw_quantiles(axes: Any, wavelength: Array, values: Array) -> None:
    """Draw the median of pixels (pixel, band) and their spread; bands without any value stay empty."""
    parts = known_quantiles(values, QUANTILES)
    axes.fill_between(wavelength, parts[0], parts[4], color=_BLUE, alpha=0.2, lw=0, label="5 to 95 %")
    axes.fill_between(wavelength, parts[1], parts[3], color=_BLUE, alpha=0.4, lw=0, label="middle half")
    axes.plot(wavelength, parts[2], color=_BLUE, lw=1.6, label="median")


def _draw_limits(axes: Any, dataset: xr.Dataset, wavelength: Array, across: Array) -> None:
    """Draw the dark counts of the region's columns, and the count at which the converter is full."""
    columns = np.unique(across)
    dark = dataset["dark_counts"] if "dark_counts" in dataset.variables else None
    if dark is not None and dark.dims == (BAND, CROSS_TRACK):
        own = np.median(dark.values[:, columns], axis=1)
        axes.plot(wavelength, own, color=ink_of(axes, 0.7), lw=1, ls="--", label="dark")
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
    axes.plot(samples[there], white, color=ink_of(axes, 0.7), lw=1, ls="--", label="white surface")


# --- before and after straightening ------------------------------------------------------------------------

_MOST_LINES = 1500  # of the raw picture, and rows of the map


def straightening(
    line: xr.Dataset,
    orthomap: xr.Dataset | None = None,
    path: str | Path | None = None,
    *,
    width: float = 11.0,
) -> Any:
    """Draw a flight line as it was recorded beside its map: figure 3 of the paper.

    Eager: the visible bands are read.

    Parameters
    ----------
    line
        A flight line with reflectance, or with what it follows from. Where ``orthomap`` is not given it is
        located, or declares its ``ground``, and is made a map here, north up.
    orthomap
        Its map, as of `hyperpaint.geometry.orthorectify`.
    path
        Where to write a picture (PNG, PDF, ...); nowhere by default.
    width
        Of the figure [inch]; below 6 the map stands below the line.

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
        orthomap = _map_of(line)
    columns = columns_for(width, 3.0, 2)
    shown = (("as recorded", line), ("straightened", schema.rename_to_roles(orthomap)))
    orientations = [orientation_of(dataset) for _, dataset in shown]
    heights = [min(0.8 * each.height_of(width / columns - 0.9), 9.0) + 1.1 for each in orientations]
    height = max(heights) if columns == 2 else sum(heights)
    figure = new_figure("a line before and after", figsize=(width, height + 0.3), layout="constrained")
    grid = figure.add_gridspec(2 // columns, columns, height_ratios=heights if columns == 1 else None)
    for number, (title, dataset) in enumerate(shown):
        axes = figure.add_subplot(grid[divmod(number, columns)])
        steps = {dim: max(1, dataset.sizes[dim] // _MOST_LINES) for dim in (ALONG_TRACK, CROSS_TRACK)}
        few = dataset.isel({dim: slice(None, None, step) for dim, step in steps.items()})
        show_picture(axes, rgb(few).values, orientations[number])
        axes.set_title(title)
    figure.suptitle(label_for(line.attrs.get("name", "flight line")))
    save_figure(figure, path)
    return figure


def _map_of(line: xr.Dataset) -> xr.Dataset:
    """Return the visible bands of a located line as a map, north up."""
    from hyperpaint.geometry.orthorectification import orthorectify

    if not {"east", "north"} <= set(line.coords) and "ground" not in line.attrs:
        raise SchemaError(
            "the line is not located and declares no ground height, so it has no map",
            mend="pass line.paint.locate(...), or its map",
            code="line-not-located",
        )
    wavelength = schema.require(line, ["wavelength"], "a map")["wavelength"].values
    visible = np.flatnonzero((wavelength > 380) & (wavelength < 780))
    return orthorectify(line.isel({BAND: visible}), grid="north", variables=["reflectance"])
