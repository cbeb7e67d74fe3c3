"""Light that a coloured neighbour throws on a surface: along a transect, and as spectra near and far."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hyperpaint.base import schema
from hyperpaint.base.arrays import Array
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.schema import ALONG_TRACK, BAND, CROSS_TRACK
from hyperpaint.paints.signatures.extraction import gather
from hyperpaint.regions import Region, pixels_of, regions_from

from .figures import label_for, new_figure, save_figure
from .plot_flags import background

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["adjacency_figure"]


_COLOURS = ("#2456d8", "#17a05f", "#d62728", "#7a3b12")
"""Of bands by rising wavelength, as long as there are no more; then those of matplotlib."""
_NEAR, _FAR = "#d62728", "#5c5c5c"
_QUARTILES = (0.25, 0.75)


def adjacency_figure(
    line: xr.Dataset,
    near: Any,
    far: Any,
    path: str | Path | None = None,
    *,
    without: xr.Dataset | None = None,
    wavelengths: Sequence[float] = (450.0, 550.0, 650.0, 850.0),
    width: int = 5,
) -> Any:
    r"""Draw what a coloured neighbour adds to a surface: the picture, a transect, and spectra near and far.

    Eager: the blocks of lines are read that hold the pixels.

    Parameters
    ----------
    line
        A flight line with ``reflectance`` and ``wavelength``; with ``adjacency``, as `hyperpaint.flag` makes
        it, that is drawn along the transect as well.
    near, far
        Regions of one surface, beside the neighbour and away from it, see `hyperpaint.regions_from`. The
        transect leads from the middle of the first to that of the second.
    path
        Where the picture is written.
    without
        The same place without the neighbour's colour, such as another render of it: drawn dashed.
    wavelengths
        Of the bands along the transect [nm].
    width
        Pixels across the transect that are averaged.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    MissingExtraError
        matplotlib is not installed.
    SchemaError, UnitsError
        There is no reflectance or wavelength; ``without`` is of another place; a region holds no pixel, or
        both have one middle; ``width`` is not positive. All are listed.

    Notes
    -----
    A neighbour of reflectance :math:`\rho_n` adds :math:`F \rho_n` to the light of a surface, with F the part
    of its hemisphere that the lit neighbour fills: the nearer, the more, and only in the neighbour's colour.
    """
    figure = new_figure("a figure of adjacency", figsize=(15, 4.6), layout="constrained")
    line = schema.rename_to_roles(line)
    known = schema.require(line, ["reflectance", "wavelength"], "a figure of adjacency")
    lines = {"": line} if without is None else {"": line, "without": schema.rename_to_roles(without)}
    pair = _checked(lines, near, far, width)
    places = pixels_of(pair, line)
    route, away = _transect(places, line.sizes[ALONG_TRACK], line.sizes[CROSS_TRACK], width)
    nm = known["wavelength"].values
    panels = figure.subplot_mosaic(
        [["picture", "along", "spectra"], ["picture", "added", "spectra"]],
        width_ratios=(0.9, 1.2, 1.2), height_ratios=(3, 2),
    )  # fmt: skip
    _draw_picture(panels["picture"], line, pair, route[:, width // 2])
    seen = {}
    for name, each in lines.items():
        cube = schema.require(each, ["reflectance"], "a figure of adjacency")["reflectance"]
        style, told = ("--", False) if name else ("-", True)
        values = _gathered(cube, *route.reshape(-1, 2).T).reshape(*route.shape[:2], -1)
        seen[name] = _mean(values, axis=1)
        _draw_bands(panels["along"], away, seen[name], nm, wavelengths, style, told)
        for region, place, colour in zip(pair, places, (_NEAR, _FAR), strict=True):
            own = _gathered(cube, *place)
            _draw_spectrum(panels["spectra"], nm, own, colour, style, region.name if told else None)
    if without is not None:
        _draw_bands(panels["added"], away, seen[""] - seen["without"], nm, wavelengths, "-", False)
    if "adjacency" in line.variables:
        layer = line["adjacency"].transpose(ALONG_TRACK, CROSS_TRACK).values
        flagged = _mean(layer[route[..., 0], route[..., 1]], axis=1)
        panels["added"].plot(away, flagged, ":", color="black", linewidth=1.8, label="adjacency, as flagged")
    _finish(panels, without is not None)
    save_figure(figure, path)
    return figure


def _finish(panels: dict[str, Any], compared: bool) -> None:
    """Name axes and curves."""
    panels["along"].set(ylabel="reflectance")
    panels["added"].set(xlabel="distance from the near end [pixel]", ylabel="added")
    panels["spectra"].set(xlabel="wavelength [nm]", ylabel="reflectance", ylim=(0, None))
    panels["along"].tick_params(labelbottom=False)
    panels["along"].sharex(panels["added"])
    for name in ("along", "added", "spectra"):
        axes = panels[name]
        axes.spines[["top", "right"]].set_visible(False)
        if compared and name != "added":
            axes.plot([], [], "--", color="0.4", label="without the neighbour's colour")
        if axes.get_legend_handles_labels()[0]:
            axes.legend(frameon=False, fontsize="small")
    if not panels["added"].lines:
        panels["added"].set_axis_off()
        panels["along"].tick_params(labelbottom=True)
        panels["along"].set(xlabel=panels["added"].get_xlabel())


def _checked(lines: dict[str, xr.Dataset], near: Any, far: Any, width: int) -> Any:
    """Return both regions, of lines that fit."""
    problems = Problems("adjacency cannot be drawn", SchemaError)
    first, *others = lines.values()
    shape = dict(first["reflectance"].sizes)
    for other in others:
        if "reflectance" not in other.variables or dict(other["reflectance"].sizes) != shape:
            problems.add(f"without= has no reflectance of the line's shape {shape}")
    if width < 1:
        problems.add(f"width={width}, expected 1 or more pixels")
    pairs = [regions_from(given) for given in (near, far)]
    for name, given in zip(("near", "far"), pairs, strict=True):
        if len(given) != 1:
            problems.add(f"{name}= holds {len(given)} regions, expected one")
    problems.raise_if_any()
    pair = type(pairs[0])((pairs[0][0], pairs[1][0]), pairs[0].coordinates, pairs[0].crs)
    for region, (along, _) in zip(pair, pixels_of(pair, first), strict=True):
        if not along.size:
            problems.add(f"region {region.name!r} holds no pixel of the line")
    problems.raise_if_any()
    return pair


def _transect(places: Sequence[Any], lines: int, columns: int, width: int) -> tuple[Array, Array]:
    """Return pixels (step, across, 2) from one region's middle to the other's, and how far they are."""
    start, stop = (np.array([np.mean(along), np.mean(across)]) for along, across in places)
    length = float(np.hypot(*(stop - start)))
    if length < 1.0:
        raise SchemaError("adjacency cannot be drawn: both regions have the same middle; choose them apart")
    ahead = (stop - start) / length
    away = np.arange(int(length) + 1, dtype=np.float64)
    aside = np.arange(width) - (width - 1) / 2
    exact = start + away[:, None, None] * ahead + aside[None, :, None] * np.array([-ahead[1], ahead[0]])
    return np.clip(np.floor(exact + 0.5).astype(np.intp), 0, (lines - 1, columns - 1)), away


def _gathered(cube: xr.DataArray, along: Array, across: Array) -> Array:
    """Return spectra of pixels (pixel, band)."""
    spectra, _ = gather({"reflectance": cube}, {}, along, across, slice(0, cube.sizes[BAND]), {})
    return spectra["reflectance"].astype(np.float64)


def _mean(values: Array, axis: int) -> Array:
    """Return the mean of what is known, NaN where nothing is."""
    there = np.isfinite(values)
    count = there.sum(axis=axis)
    made = np.where(there, values, 0.0).sum(axis=axis) / np.maximum(count, 1)
    return np.asarray(np.where(count > 0, made, np.nan))


def _draw_picture(axes: Any, line: xr.Dataset, pair: Sequence[Region], route: Array) -> None:
    edges = line.sizes[ALONG_TRACK] - 0.5, line.sizes[CROSS_TRACK] - 0.5
    axes.imshow(
        background(line, 1).swapaxes(0, 1), interpolation="nearest", extent=(-0.5, edges[0], edges[1], -0.5)
    )
    for region, colour in zip(pair, (_NEAR, _FAR), strict=True):
        across, along = np.vstack([region.polygon, region.polygon[:1]]).T
        axes.plot(along, across, color="white", linewidth=3.0)
        axes.plot(along, across, color=colour, linewidth=1.5)
    axes.annotate("", route[-1], route[0], arrowprops={"arrowstyle": "->", "color": "black"})
    axes.set(xlabel="along_track", ylabel="cross_track")


def _draw_bands(
    axes: Any, away: Array, values: Array, nm: Array, wavelengths: Sequence[float], style: str, told: bool
) -> None:
    bands = [int(np.nanargmin(np.abs(nm - wanted))) for wanted in wavelengths]
    colours = _COLOURS if len(bands) <= len(_COLOURS) else [f"C{number}" for number in range(len(bands))]
    for band, colour in zip(bands, colours, strict=False):
        name = f"{nm[band]:.0f} nm" if told else None
        axes.plot(away, values[:, band], style, color=colour, linewidth=1.5 if told else 1.0, label=name)


def _draw_spectrum(axes: Any, nm: Array, values: Array, colour: str, style: str, name: str | None) -> None:
    """Draw the mean of pixels, and the middle half of them where they have a name."""
    order = np.argsort(nm, kind="stable")
    nm, mean = nm[order], _mean(values, axis=0)[order]
    if name is not None:
        known = np.isfinite(mean)  # nobody knows anything of the other bands
        low, high = np.nanquantile(values[:, order][:, known], _QUARTILES, axis=0)
        axes.fill_between(nm[known], low, high, color=colour, alpha=0.15, linewidth=0)
    axes.plot(nm, mean, style, color=colour, label=None if name is None else label_for(name))
