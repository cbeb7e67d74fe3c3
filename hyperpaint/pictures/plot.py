"""Pictures of a flight line."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base import schema
from hyperpaint.base.arrays import Array
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.facts import documented
from hyperpaint.kernels.overviews import mix_bands
from hyperpaint.paints.colours import encode_srgb, srgb_weights
from hyperpaint.paints.signatures.pixel_statistics import QUANTILES
from hyperpaint.radiometry.counts_to_reflectance import radiance, reflectance

from .figures import (
    columns_for,
    ink_of,
    label_for,
    legend_below,
    map_dims,
    new_figure,
    orientation_of,
    save_figure,
    show_picture,
)

OVERVIEW_SHAPE = (1000, 640)  # maximum lines and columns of the stored picture
STRETCH = (2.0, 98.0)  # percentiles of brightness shown black and white


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
        There is no cube, or there are fewer than three visible bands.

    Examples
    --------
    >>> from hyperpaint.simulation import simulate_line
    >>> line = simulate_line(lines=32, bands=40, columns=24)
    >>> picture = rgb(line)
    >>> picture.sizes["along_track"], picture["rgb"].values.tolist(), float(picture.max()) <= 1.0
    (32, ['red', 'green', 'blue'], True)
    """
    dataset = schema.rename_to_roles(dataset)
    if lines is not None and lines < 1:
        raise SchemaError(
            f"lines={lines}", expected="1 line of the picture or more", code="value-out-of-range"
        )
    has_cube = bool({"reflectance", "counts", "radiance", "values"} & set(dataset.variables))
    if lines is not None or not has_cube:
        step = max(1, -(-dataset.sizes.get(schema.ALONG_TRACK, 1) // lines)) if lines else None
        picture_of_store = stored_picture(dataset, step, at_most=True) if stretch == STRETCH else None
        if picture_of_store is not None:
            return picture_of_store
        if has_cube and step:
            subsample = dataset.isel({schema.ALONG_TRACK: slice(None, None, step)})
            return rgb(subsample, stretch=stretch).assign_attrs(level=_level_text("cube", step, 1))
    dataset, shown_name = with_shown_cube(dataset)
    cube = dataset[shown_name]
    wavelength = schema.require(dataset, ["wavelength"], "a true-colour picture")["wavelength"].values
    visible = visible_bands(wavelength)
    shift = None
    if "wavelength_shift" in dataset.variables:
        shifts = schema.require(dataset, ["wavelength_shift"], "a true-colour picture")["wavelength_shift"]
        shift = (shifts.isel({schema.BAND: visible}) if schema.BAND in shifts.dims else shifts).values
    source = cube.isel({schema.BAND: visible})
    if source.chunks is not None:
        source = source.chunk({schema.BAND: -1, schema.CROSS_TRACK: -1})
    source = source.transpose(..., schema.BAND, schema.CROSS_TRACK)
    linear = xr.apply_ufunc(
        linear_srgb,
        source,
        kwargs={"weights": srgb_weights(wavelength[visible], shift)},
        input_core_dims=[[schema.BAND, schema.CROSS_TRACK]],
        output_core_dims=[[schema.CROSS_TRACK, "rgb"]],
        dask="parallelized",
        output_dtypes=[np.float32],
        dask_gufunc_kwargs={"output_sizes": {"rgb": 3}},
    ).drop_vars(["wavelength", "fwhm", "good", "wavelength_shift"], errors="ignore")
    renamed_dims = map_dims(cube)
    dims = [dim for dim in source.dims if dim != schema.BAND]
    is_absolute = shown_name == "reflectance" and stretch == (0.0, 100.0)
    black, white = (np.float32(0.0), np.float32(1.0)) if is_absolute else _levels(linear, dims[0], stretch)
    scaled = ((linear - black) / np.maximum(white - black, np.float32(1e-6))).clip(0.0, 1.0)
    if "quality" in dataset.variables and set(dataset["quality"].dims) == set(dims):
        saturated = (dataset["quality"].reset_coords(drop=True) & schema.Quality.SATURATED.value) != 0
        is_black = (linear == 0.0).all("rgb").reset_coords(drop=True)
        scaled = scaled.where(~(saturated & is_black), np.float32(1.0))
    picture: xr.DataArray = xr.apply_ufunc(
        encode_srgb, scaled, dask="parallelized", output_dtypes=[np.float32]
    )
    picture = picture.transpose(*dims, "rgb").rename("true_colour")
    axes = {name: (name, cube[name].values, cube[name].attrs) for name in renamed_dims.values()}
    picture = picture.drop_vars(list(axes)).rename(renamed_dims).assign_coords(axes)
    picture = picture.assign_coords(rgb=("rgb", ["red", "green", "blue"]))
    titles = {
        "reflectance": "True colour",
        "radiance": "Colours of radiance",
        "counts": "Colours of raw counts",
        "values": "Colours of values",
    }
    picture.attrs = {
        "long_name": f"{titles[shown_name]} (sRGB)",
        "stretch": f"{stretch[0]:g} to {stretch[1]:g} %",
    }
    for entries in (cube.attrs, cube.encoding):
        if "grid_mapping" in entries:
            picture.attrs["grid_mapping"] = entries["grid_mapping"]
    return picture


def visible_bands(wavelength: Array) -> Array:
    # Return the indices of the visible bands; SchemaError for fewer than three
    visible = np.flatnonzero((wavelength > 380) & (wavelength < 780))
    if visible.size < 3:
        raise SchemaError(
            f"{visible.size} bands between 380 and 780 nm",
            expected="three or more for a true-colour picture",
            code="band-missing",
        )
    return visible


def with_shown_cube(dataset: xr.Dataset) -> tuple[xr.Dataset, str]:
    # Return a line with the cube to show, and its name: reflectance, else radiance, else counts
    names = set(dataset.variables)
    if "reflectance" in names:
        return dataset, "reflectance"
    if "values" in names and not {"counts", "radiance"} & names:  # the header does not name the quantity
        return dataset, "values"
    if "irradiance" in names or not {"counts", "radiance"} & names:
        return reflectance(dataset), "reflectance"
    has_radiance = bool({"radiance", "dark_counts", "radiance_gain"} & names)
    return (radiance(dataset), "radiance") if has_radiance else (dataset, "counts")


def stored_picture(dataset: xr.Dataset, step: int | None, *, at_most: bool = False) -> xr.DataArray | None:
    # Return the stored overview, subsampled to about every ``step``-th line, in the form of `rgb`.
    # None without an overview, for a crop of a line, or if the overview has fewer lines than requested. With
    # ``step`` None all lines are returned. ``at_most``: the step is rounded up instead of down.
    row = schema.VARIABLES["overview"]
    if "overview" not in dataset.variables or set(dataset["overview"].dims) != set(row.dims):
        return None
    overview = dataset["overview"].transpose(*row.dims)
    attrs = [overview.attrs.get(name) for name in ("line_step", "column_step")]
    steps = [int(number) if isinstance(number, int | np.integer) else 0 for number in attrs]
    # a crop keeps the overview of its complete line, whose shape differs
    sizes = [dataset.sizes.get(dim, 0) for dim in (schema.ALONG_TRACK, schema.CROSS_TRACK)]
    shape = [-(-size // number) for size, number in zip(sizes, steps, strict=True) if number > 0 and size]
    if min(steps) < 1 or any(a != b for a, b in zip(shape, overview.shape, strict=False)):
        return None
    if step is not None and steps[0] > step:
        return None
    stride = 1 if step is None else -(-step // steps[0]) if at_most else step // steps[0]
    values = overview[::stride].astype(np.float32) / np.float32(255.0)
    every_line, every_column = steps[0] * stride, steps[1]
    picture = xr.DataArray(
        values.data,
        {"rgb": ["red", "green", "blue"]},
        (schema.ALONG_TRACK, schema.CROSS_TRACK, "rgb"),
        "true_colour",
        {
            "long_name": "True colour (sRGB)",
            "stretch": f"{STRETCH[0]:g} to {STRETCH[1]:g} %",
            "level": _level_text("overview", every_line, every_column),
        },
    )
    for dim, number in {schema.ALONG_TRACK: every_line, schema.CROSS_TRACK: every_column}.items():
        axis = dataset.coords.get(dim)
        if axis is not None and axis.dims == (dim,):
            picture = picture.assign_coords({dim: axis[::number].variable})
    return picture


def _level_text(source: str, lines: int, columns: int) -> str:
    return f"{source}, every {lines}. line and {columns}. column"


def linear_srgb(values: Array, *, weights: Array) -> Array:
    # Return linear sRGB (..., column, 3) of spectra (..., band, column); missing bands make pixels white
    *lines, bands, columns = values.shape
    colours = np.empty((math.prod(lines), columns, 3), np.float32)
    cube = np.ascontiguousarray(values, np.float32).reshape(-1, bands, columns)
    mix_bands(cube, np.ascontiguousarray(np.broadcast_to(weights, (3, bands, columns))), colours)
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
    """Return a small true-colour picture of a flight line to be stored, (overview_y, overview_x, rgb).

    Lazy, computed from the slabs being written, so that a cube is read once. uint8, at most `OVERVIEW_SHAPE`;
    None with fewer than three visible bands.
    """
    dims = schema.ALONG_TRACK, schema.CROSS_TRACK
    steps = {dim: -(-dataset.sizes[dim] // size) for dim, size in zip(dims, OVERVIEW_SHAPE, strict=True)}
    names = [name for name in ("reflectance", "quality") if name in dataset.variables]
    subsample = dataset[names].isel({dim: slice(None, None, step) for dim, step in steps.items()})
    try:
        picture = rgb(subsample)
    except SchemaError:  # fewer than three visible bands
        return None
    row = schema.VARIABLES["overview"]
    pixels = (picture * np.float32(255.0) + np.float32(0.5)).astype(np.uint8).reset_coords(drop=True)
    pixels = pixels.drop_vars(list(pixels.coords)).rename(dict(zip(pixels.dims, row.dims, strict=True)))
    pixels.attrs = {**row.attrs, "line_step": steps[dims[0]], "column_step": steps[dims[1]]}
    return pixels.rename("overview")


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
    dataset = schema.rename_to_roles(dataset)
    if "reflectance" in dataset.variables and "quality" not in dataset.variables:
        dataset = reflectance(dataset)
    dataset, cube_name = with_shown_cube(dataset)
    has_flags = "quality" in dataset.variables
    schema.require(dataset, [cube_name, *(["quality"] if has_flags else [])], "a quicklook")
    step = max(1, dataset.sizes[schema.ALONG_TRACK] // lines)
    orientation = orientation_of(dataset)
    dataset = dataset.isel({schema.ALONG_TRACK: slice(None, None, step)})
    names = ("flags", "light", "spectra")
    mosaic = [["picture", name] for name in names] if is_wide else [["picture"], *([name] for name in names)]
    heights = (1.3, 1.0, 1.0) if is_wide else (2.0, 1.0, 1.0, 1.0)
    plots = figure.subplot_mosaic(mosaic, height_ratios=heights)
    show_picture(plots["picture"], rgb(dataset).values, orientation)
    title = f"{label_for(dataset.attrs.get('name', 'flight line'))}: "
    title += "true colour" if cube_name == "reflectance" else cube_name
    plots["picture"].set_title(title + (f", every {step}th line" if step > 1 else ""))
    # bars of the share of pixels with each flag
    axes = plots["flags"]
    if has_flags:
        shares = schema.flag_shares(flags_of(dataset))
        labels = [name.replace("_", " ") for name in schema.flag_names(sum(shares))] or ["no flag set"]
        lengths = [100 * share for share in shares.values()] or [0.0]
        bars = axes.barh(labels, lengths, height=0.6, color="#b5543c")
        axes.bar_label(bars, [f" {percent(share)}" for share in shares.values()] or [""], fontsize="small")
        axes.set(title="flags", xlabel="share of pixels [%]", ylim=(max(len(labels), 8) - 0.4, -0.6))
        axes.set_xlim(0, 1.3 * axes.get_xlim()[1])
    else:
        axes.set_axis_off()
    draw_irradiance(plots["light"], dataset)
    draw_spread(plots["spectra"], dataset, cube_name)
    return save_figure(figure, path)


def flags_of(dataset: xr.Dataset) -> Array:
    # Return the flags of all pixels (along_track, cross_track) as integers
    quality = schema.require(dataset, ["quality"], "a picture of flags")["quality"]
    if quality.dtype.kind not in "iu":
        raise SchemaError(f"quality is {quality.dtype}", expected="uint16, one bit a flag", code="type-wrong")
    return np.asarray(quality.values)


def flag_label(flag: schema.Quality) -> str:
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
    if 0.995 <= share < 1.0:
        return "> 99 %"
    return f"{float(f'{100 * share:.2g}'):g} %"


def draw_irradiance(axes: Any, dataset: xr.Dataset) -> None:
    # Draw irradiance over time at three wavelengths, and the time of the line, if known
    if "irradiance" not in dataset.variables:
        axes.set_axis_off()
        return
    series = schema.require(dataset, ["irradiance"], "a picture of irradiance")["irradiance"]
    moments = series.coords.get(schema.IRRADIANCE_TIME)
    if moments is None or not moments.size or moments.dtype.kind != "M":
        raise SchemaError(
            "a picture of irradiance needs the coordinate irradiance_time with at least one time",
            code="variable-missing",
        )
    series = series.compute()
    start = series[schema.IRRADIANCE_TIME].values[0]
    seconds = (series[schema.IRRADIANCE_TIME].values - start) / np.timedelta64(1, "s")
    samples = series[schema.IRRADIANCE_WAVELENGTH].values
    for nm, colour in ((450.0, "#3399DD"), (550.0, "#009E73"), (850.0, "#D55E00")):
        if samples.min() <= nm <= samples.max():
            axes.plot(
                seconds, series.values[:, np.abs(samples - nm).argmin()], color=colour, label=f"{nm:.0f} nm"
            )
    times = dataset["time"].values if "time" in dataset.coords else np.empty(0, "datetime64[ns]")
    line_seconds = (times[~np.isnat(times)] - start) / np.timedelta64(1, "s")
    if line_seconds.size:
        axes.axvspan(line_seconds.min(), line_seconds.max(), color=ink_of(axes, 0.15), zorder=0, label="line")
    day, _, clock = str(start)[:19].partition("T")
    axes.set(title=f"irradiance, {day}", xlabel=f"time after {clock} UTC [s]")
    axes.set(ylabel="irradiance [W m$^{-2}$ nm$^{-1}$]", ylim=(0, 1.05 * axes.get_ylim()[1]))
    legend_below(axes)


def draw_spread(axes: Any, dataset: xr.Dataset, name: str = "reflectance") -> None:
    # Draw the quantiles of a cube over the pixels, band by band
    sample = dataset[name].isel(
        {schema.ALONG_TRACK: slice(None, None, max(1, dataset.sizes[schema.ALONG_TRACK] // 50))}
    )
    values = (
        sample.transpose(..., schema.BAND).astype(np.float32).values.reshape(-1, sample.sizes[schema.BAND])
    )
    draw_quantiles(axes, dataset["wavelength"].values, values, [ink_of(axes, s) for s in (0.12, 0.3, 0.9)])
    units = label_for(dataset[name].attrs.get("units", "count"))
    unit = "reflectance factor [1]" if name == "reflectance" else f"{name} [{units}]"
    axes.set(title=f"{name} of all pixels", xlabel="wavelength [nm]", ylabel=unit, ylim=(0, None))
    legend_below(axes)


def draw_quantiles(axes: Any, wavelength: Array, values: Array, colours: Sequence[Any]) -> None:
    # Draw median, middle half and 5 to 95 % of samples (sample, band).
    # ``colours``: of the 5 to 95 %, of the middle half, and of the median.
    quantiles = finite_quantiles(values, QUANTILES)
    for lower, label in enumerate(("5 to 95 %", "middle half")):
        edges = quantiles[lower], quantiles[4 - lower]
        axes.fill_between(wavelength, *edges, color=colours[lower], lw=0, label=label)
    axes.plot(wavelength, quantiles[2], color=colours[2], lw=1.6, label="median")


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
