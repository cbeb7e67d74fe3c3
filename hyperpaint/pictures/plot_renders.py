"""Paints as chips beside the scenes rendered with them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base import schema
from hyperpaint.base.arrays import Array
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.facts import documented
from hyperpaint.base.schema import SIGNATURE
from hyperpaint.base.units import takes_quantities
from hyperpaint.paints.colours import paint_colours, srgb

from .figures import label_for, new_figure, save_figure
from .orientation import orientation_of, show_picture
from .plot import rgb
from .plot_spectra import find_usable, good_bands

MAX_CHIPS = 60
_CHIP_PX = 16  # pixels along a chip's side; a pixel shows a member of the population
_CHIP_INCH, _RENDER_INCH = 0.85, 4.2  # widths


@takes_quantities()
@documented(path="picture")
def chips_and_renders(
    paints: xr.Dataset,
    renders: xr.Dataset | Mapping[str, xr.Dataset],
    path: str | Path | None = None,
    *,
    columns: int = 7,
    stretch: tuple[float, float] = (1.0, 99.0),
) -> Any:
    """Draw the paints of a library as chips above scenes rendered with them.

    Parameters
    ----------
    paints
        A paint library. The pixels of a chip show members of the paint's population, if the library has it.
    renders
        A render from `hyperpaint.simulation.relight` or a group of `hyperpaint.render_scene`; or several by
        the name of their light.
    path
    columns
        Chips side by side.
    stretch
        As for `hyperpaint.pictures.rgb`, for every render.

    Returns
    -------
    matplotlib.figure.Figure
        At most 60 chips.

    Raises
    ------
    MissingExtraError
        matplotlib is not installed.
    SchemaError
        The library is no paint library or has no paints; there is no render, or a render has fewer than three
        visible bands; or matplotlib cannot write this type of picture.

    Examples
    --------
    >>> from hyperpaint.paints import starter_library
    >>> from hyperpaint.simulation import simulate_line
    >>> paints, line = starter_library(members=0), simulate_line(lines=32, bands=40, columns=24)
    >>> figure = chips_and_renders(paints.isel(signature=[0, 5]), line)
    >>> [axes.get_title() for axes in figure.axes][:2]
    ['Synthetic Polar White', 'Synthetic Signal Red']
    """
    paints, problems = find_usable(paints)
    variables = schema.require(paints, ["reflectance", "wavelength"], "chips", schema.LIBRARY_VARIABLES)
    lines: dict[str, Any] = {"": renders}
    if isinstance(renders, Mapping) and not hasattr(renders, "dims"):
        lines = dict(renders)
    if problems or not paints.sizes[SIGNATURE] or not lines:
        reason = "; ".join(problems) or f"{paints.sizes[SIGNATURE]} paints and {len(lines)} renders"
        raise SchemaError(f"a collage needs a paint library and a render: {reason}", code="empty-input")
    count = min(paints.sizes[SIGNATURE], MAX_CHIPS)
    columns = max(1, min(columns, count))
    rows = -(-count // columns)
    orientations = {name: orientation_of(line) for name, line in lines.items()}
    tallest = max(
        min(orientation.height_of(_RENDER_INCH), 2.5 * _RENDER_INCH) for orientation in orientations.values()
    )
    chip_height = 1.25 * _CHIP_INCH * rows
    width = max(_RENDER_INCH * len(lines), (_CHIP_INCH + 0.2) * columns)
    figure = new_figure(
        "a collage of chips and renders", figsize=(width, chip_height + tallest + 0.6), layout="constrained"
    )
    chip_figure, render_figure = figure.subfigures(2, 1, height_ratios=(chip_height, tallest + 0.4))
    colours = paint_colours(paints)
    for number, axes in enumerate(chip_figure.subplots(rows, columns, squeeze=False).ravel()):
        axes.set_axis_off()
        if number < count:
            paint = paints.isel({SIGNATURE: number})
            axes.imshow(
                _chip(paint, variables["wavelength"].values, colours[number]), interpolation="nearest"
            )
            axes.set_title(label_for(str(paint[SIGNATURE].values), 26), fontsize=6, pad=2)
    plots = render_figure.subplots(1, len(lines), squeeze=False)[0]
    for axes, (name, line) in zip(plots, lines.items(), strict=True):
        show_picture(axes, rgb(line, stretch=stretch).values, orientations[name])
        axes.set_axis_off()
        axes.set_title(label_for(name.replace("_", " ")), fontsize="small")
    save_figure(figure, path, dpi=150)
    return figure


def _chip(paint: xr.Dataset, wavelength: Array, colour: Array) -> Array:
    # (row, column, rgb), 0 to 1; pixels show random members of the population, else the colour of the paint
    uniform = np.broadcast_to(np.nan_to_num(colour), (_CHIP_PX, _CHIP_PX, 3))
    if "member_reflectance" not in paint.variables:
        return np.asarray(uniform)
    is_visible = good_bands(paint) & (wavelength > 380.0) & (wavelength < 780.0)
    members = np.asarray(paint["member_reflectance"].transpose(schema.MEMBER, schema.BAND).values)[
        :, is_visible
    ]
    members = members[np.isfinite(members).all(axis=1)]
    if len(members) < 2 or is_visible.sum() < 3:
        return np.asarray(uniform)
    numbers = np.random.default_rng(0).integers(len(members), size=_CHIP_PX**2)
    return np.asarray(srgb(members, wavelength[is_visible])[numbers].reshape(_CHIP_PX, _CHIP_PX, 3)).clip(
        0.0, 1.0
    )
