"""Pictures of a calibration."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.facts import documented
from hyperpaint.base.schema import BAND, CROSS_TRACK, STEP, Array, require
from hyperpaint.calibration.calibration_dataset import fitted_lines

from .figures import axes_width, check_picture, columns_for, ink_of, legend_below, new_figure, save_figure
from .plot import finite_quantiles

Values = dict[str, Any]

# colours of Okabe and Ito for colour-blind readers
_BLUE, _VERMILION = "#3399DD", "#D55E00"
_UNTRUSTED = "#E69F00"

_NARROW_INCH = 4.4  # width of axes below which their colour bar is below them
_LAMP_LINES_SHOWN = 5
_UNCERTAINTIES = ("random", "systematic")
_MAX_CURVES = 200  # maximum number of columns drawn in one plot

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
        check_picture(Path(path))
    values = _values(calibration, sweep, column)
    figure.set_layout_engine("constrained", w_pad=0.08, h_pad=0.08)
    is_trusted, is_good = values["line_trusted"], values["good"]
    facts = [
        str(calibration.attrs.get("sweep", "lab sweep")),
        f"{int(is_trusted.any(axis=1).sum())} of {len(is_trusted)} steps used",
        f"{int(is_good.sum())} of {is_good.size} bands have a gain",
        f"line shape {calibration.attrs['srf_shape']}, FWHM {np.nanmedian(values['fwhm']):.2f} nm",
        f"smile {np.ptp(values['wavelength_shift']):.2f} nm",
    ]
    figure.suptitle(textwrap.fill("   ·   ".join(facts), max(30, int(11 * width))), fontsize="medium")
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
    lamp_axes.set(title=f"lamp lines and fits, column {values['column']}", ylabel="counts above dark [count]")
    lamp_axes.tick_params(labelbottom=False)
    lamp_axes.set_ylim(bottom=min(0.0, lamp_axes.get_ylim()[0]))
    residual_axes.axhline(0, color="0.6", lw=0.8, zorder=0)
    residual_axes.set(xlabel="distance from the lamp line [nm]", ylabel="counts - fit\n[% of height]")
    max_residual = max(
        (float(np.abs(100 * lamp_line.residual).max(initial=0.0)) for lamp_line in lamp_lines), default=0.0
    )
    legend_below(residual_axes, lamp_axes)
    residual_axes.set_ylim(*(np.array([-1.15, 1.15]) * max(max_residual, 0.1)))
    drawers = (_draw_residuals, _draw_smile, _draw_widths, _draw_responsivity, _draw_uncertainty)
    for cell, draw in zip(grid[1:], drawers, strict=True):
        draw(figure.add_subplot(cell), values)
    for axes in figure.axes:
        axes.set_title(textwrap.fill(axes.get_title(), int(9 * width / columns)))
    return save_figure(figure, path)


def _values(calibration: xr.Dataset, sweep: xr.Dataset | None, column: int | None) -> Values:
    # variables in the units of the schema, and the highlighted column
    variables = require(calibration, list(_DIMS), "a calibration report")
    sizes = {dim: calibration.sizes[dim] for dim in (STEP, BAND, CROSS_TRACK)}
    problems = Problems("the calibration report cannot be drawn", SchemaError)
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
    problems.raise_if_any()
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


def _draw_map(axes: Any, wavelength: Array, values: Array, label: str, **style: Any) -> Any:
    columns = np.arange(values.shape[1] + 1) - 0.5
    mesh = axes.pcolormesh(
        _edges(wavelength), columns, np.ma.masked_invalid(values.T), rasterized=True, **style
    )
    axes.set_facecolor(ink_of(axes, 0.15))
    # a colour bar beside narrow axes would shrink the plots above and below
    options = {"location": "bottom", "pad": 0.03} if axes_width(axes) < _NARROW_INCH else {"pad": 0.02}
    axes.figure.colorbar(mesh, ax=axes, label=label, **options)
    axes.set(xlabel="wavelength [nm]", ylabel="cross_track [column]")
    return mesh


def _draw_residuals(axes: Any, values: Values) -> None:
    # wavelength from the calibration minus wavelength of the monochromator, for every lamp line
    residual = values["line_centre"] - values["step_wavelength"][:, None]
    residual = np.where(values["line_trusted"], residual, np.nan)
    finite = residual[np.isfinite(residual)]
    limit = max(float(np.percentile(np.abs(finite), 98)), 1e-6) if finite.size else 1.0
    rms = f"r.m.s. {np.sqrt(np.mean(finite**2)):.2g} nm" if finite.size else "no lamp line is used"
    colours = {"cmap": "PuOr", "vmin": -limit, "vmax": limit}
    _draw_map(axes, values["step_wavelength"], residual, "map - monochromator [nm]", **colours)
    axes.set_title(f"wavelength residual, {rms}")


# --- detector elements -------------------------------------------------------------------------------------


def _draw_smile(axes: Any, values: Values) -> None:
    shift = values["wavelength_shift"]
    _draw_map(axes, values["wavelength"], shift, "wavelength shift [nm]", cmap="viridis")
    if min(shift.shape) > 1 and np.ptp(shift) > 0:
        levels = np.linspace(shift.min(), shift.max(), 6)[1:-1]
        columns = np.arange(shift.shape[1])
        curves = axes.contour(
            values["wavelength"], columns, shift.T, levels=levels, colors="white", linewidths=0.8
        )
        axes.clabel(curves, fmt="%.2g", fontsize="small")
    axes.set_title("smile")


def _shade_untrusted(axes: Any, values: Values) -> None:
    edges = _edges(values["wavelength"])
    # first band of every run of bands without a gain, and the band after the run
    runs = np.flatnonzero(np.diff(~values["good"], prepend=False, append=False)).reshape(-1, 2)
    for number, (start, stop) in enumerate(runs.tolist()):
        label = None if number else "no gain"
        axes.axvspan(edges[start], edges[stop], color=_UNTRUSTED, alpha=0.2, lw=0, zorder=0, label=label)
    axes.set_xlim(edges.min(), edges.max())
    axes.set_xlabel("wavelength [nm]")


def _draw_widths(axes: Any, values: Values) -> None:
    is_trusted, step_nm = values["line_trusted"], values["step_wavelength"]
    widths = np.where(is_trusted, values["line_own_fwhm"], np.nan)
    is_used = is_trusted.any(axis=1)
    lower, median, upper = (
        np.nanpercentile(widths[is_used], (5, 50, 95), axis=1) if is_used.any() else np.empty((3, 0))
    )
    label = "lamp lines: median, 5 to 95 % of the columns"
    intervals = (median - lower, upper - median)
    axes.errorbar(step_nm[is_used], median, intervals, fmt="o", ms=3, lw=0.8, color=_BLUE, label=label)
    axes.plot(values["wavelength"], values["fwhm"], color=_VERMILION, lw=1.8, zorder=3, label="calibration")
    if is_used.sum() > 4:  # lamp lines cut off at the edges of the detector do not set the scale
        inner = slice(2, -2)
        margin = 0.4 * float(upper[inner].max() - lower[inner].min()) + 1e-3
        axes.set_ylim(lower[inner].min() - margin, upper[inner].max() + margin)
    _shade_untrusted(axes, values)
    axes.set(title="width of the bands, monochromator removed", ylabel="FWHM [nm]")
    legend_below(axes)


def _draw_responsivity(axes: Any, values: Values) -> None:
    from matplotlib.collections import LineCollection

    wavelength, responsivity = values["wavelength"], values["responsivity"]
    step = -(-responsivity.shape[1] // _MAX_CURVES)
    curves = [np.column_stack([wavelength, curve]) for curve in responsivity[:, ::step].T]
    label = "all columns" if step == 1 else f"every {step}th column"
    axes.add_collection(LineCollection(curves, colors=[ink_of(axes, 0.3)], linewidths=0.5, label=label))
    column = values["column"]
    axes.plot(wavelength, responsivity[:, column], color=_BLUE, lw=1.8, label=f"column {column}")
    axes.autoscale_view()
    _shade_untrusted(axes, values)
    axes.set(title="responsivity", ylabel="counts per joule in a pixel [count J$^{-1}$]", ylim=(0, None))
    legend_below(axes)


def _draw_uncertainty(axes: Any, values: Values) -> None:
    from matplotlib.ticker import LogFormatter

    wavelength = values["wavelength"]
    random, systematic = (
        finite_quantiles(100 * values[f"radiance_gain_u_{kind}"].T, [0.5])[0] for kind in _UNCERTAINTIES
    )
    axes.semilogy(wavelength, np.hypot(random, systematic), color=ink_of(axes), lw=2.5, label="both")
    axes.semilogy(
        wavelength, systematic, "--", color=_VERMILION, lw=1.5, label="systematic: power meter, optics"
    )
    axes.semilogy(wavelength, random, color=_BLUE, lw=1.2, label="random: noise of the lamp lines")
    _shade_untrusted(axes, values)
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(LogFormatter(minor_thresholds=(1.5, 0.5)))  # otherwise labels overlap
    axes.set(title="standard uncertainty of the gain", ylabel="relative to the gain [%]")
    axes.set_ylim(top=2.0 * axes.get_ylim()[1])
    legend_below(axes)


def draw_gain(figure: Any, calibration: xr.Dataset) -> None:
    # Draw gain and band width over wavelength, and smile over columns
    names = ["radiance_gain", "wavelength", "fwhm", "wavelength_shift"]
    values = require(calibration, [n for n in names if n in calibration.variables], "a calibration")
    nm, gain = values["wavelength"].values, values["radiance_gain"].values
    plots = figure.subplots(1, 3)
    lowest, median, highest = finite_quantiles(gain.T, (0.05, 0.5, 0.95))
    plots[0].fill_between(nm, lowest, highest, color=_BLUE, alpha=0.25, lw=0)
    plots[0].semilogy(nm, median, color=_BLUE, lw=1.6)
    plots[0].set_ylabel(values["radiance_gain"].attrs.get("units", ""), fontsize="small")
    if "fwhm" in values:
        plots[1].plot(nm, values["fwhm"].values, color=_VERMILION, lw=1.6)
    shift = values["wavelength_shift"].values if "wavelength_shift" in values else np.zeros(gain.shape[1])
    plots[2].plot(np.atleast_2d(shift)[:: max(1, len(np.atleast_2d(shift)) // 3)].T, lw=1.3)
    plots[1].set_ylabel("FWHM [nm]")
    plots[2].set_ylabel("wavelength shift [nm]")
    titles = ("gain, 5 to 95 % of the columns", "width of the bands", "smile")
    for axes, title, label in zip(plots, titles, (*["wavelength [nm]"] * 2, "column"), strict=True):
        axes.set_title(title, fontsize="medium")
        axes.set_xlabel(label)
