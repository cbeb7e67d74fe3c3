"""Ratio of measured to expected panel reflectance, band by band."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base import schema
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.facts import documented
from hyperpaint.radiometry.panel_judging import PANEL_STATES
from hyperpaint.radiometry.panels import CLOSURE

from .figures import ink_of, legend_below, new_figure, save_figure
from .plot_spectra import good_bands

MAX_PANELS = 12  # panels drawn in a figure, in order of time
_COLOURS = ("#3399DD", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#999999")
_DASHES = ("-", "--")


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
    >>> from hyperpaint.radiometry.example_pixel import worked_example
    >>> whole = hp.Panel(slice(None), slice(None), 0.4)
    >>> closure = hp.radiometry.panel_closure(worked_example(), whole)
    >>> figure = panel_figure(closure, "panels.png")                              # doctest: +SKIP
    >>> len(panel_figure(closure).axes[0].lines)  # one panel, and the line at 1
    2
    """
    if not set(CLOSURE) <= set(closure.variables):
        raise SchemaError(
            "the dataset has no panels: variable 'panel_factor' is missing",
            mend="see hyperpaint.radiometry.panel_closure, or scale by reflectance(panel=)",
            code="variable-missing",
        )
    figure = new_figure("a picture of panels", figsize=(width, 0.45 * width), layout="constrained")
    draw_panels(figure.add_subplot(), closure)
    save_figure(figure, path)
    return figure


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
    """Draw the factors over wavelength on axes; bad bands stay blank."""
    values = closure[list(CLOSURE)].isel({schema.PANEL: slice(MAX_PANELS)}).compute()
    nm, is_good = closure["wavelength"].values, good_bands(closure)
    order = np.argsort(nm, kind="stable")
    axes.axhline(1.0, color=ink_of(axes, 0.7), linewidth=0.8)
    for number in range(values.sizes[schema.PANEL]):
        panel = values.isel({schema.PANEL: number})
        factor, u = (np.where(is_good, panel[name].values, np.nan)[order] for name in CLOSURE[:2])
        colour = _COLOURS[number % len(_COLOURS)]
        time = np.datetime_as_string(panel["panel_time"].values, "s")
        label = f"panel {number}, {time}: {state_text(int(panel['panel_state']))}"
        dashes = _DASHES[number // len(_COLOURS) % len(_DASHES)]
        axes.plot(nm[order], factor, dashes, color=colour, linewidth=1.4, label=label)
        axes.fill_between(nm[order], factor - 2.0 * u, factor + 2.0 * u, color=colour, alpha=0.12, lw=0)
    axes.set(xlabel="wavelength [nm]", ylabel="panel: measured / expected reflectance [1]")
    legend_below(axes)
