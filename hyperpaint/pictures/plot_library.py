"""A paint library at a glance: every paint's colour, spectrum and spread."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from hyperpaint.base import schema
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.paints.colours import paint_colours

from .figures import label_for, new_figure, save_figure
from .plot_spectra import draw_band

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["MOST_PAINTS", "find_usable", "library_overview"]

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
        See `hyperpaint.spectrum`.

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
    found = schema.require(paints, ["reflectance", "wavelength"], "an overview", schema.LIBRARY_VARIABLES)
    count = paints.sizes[schema.PAINT]
    if not count:
        raise SchemaError("an overview needs paints, the library has none")
    shown = min(count, MOST_PAINTS)
    columns = max(1, min(columns, shown))
    rows = -(-shown // columns)
    size = (_PANEL[0] * columns, _PANEL[1] * rows + 0.4)
    figure = new_figure("a picture of a paint library", figsize=size, layout="constrained")
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    wavelength = found["wavelength"].values
    good = (
        paints["good"].values.astype(bool) if "good" in paints.variables else np.ones(wavelength.size, bool)
    )
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
    found, wrong = schema.find(paints, alike, table)
    return paints.drop_vars([name for name in names if name not in found]), [*problems, *wrong]


def _draw_paint(
    axes: Any, paint: xr.Dataset, wavelength: Any, good: Any, spread: str, colour: npt.NDArray[np.float32]
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
