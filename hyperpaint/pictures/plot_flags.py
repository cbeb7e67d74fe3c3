"""Flags, and continuous layers, on the picture of a flight line."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from hyperpaint.base import schema
from hyperpaint.base.arrays import Array
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.schema import ALONG_TRACK, CROSS_TRACK, Quality
from hyperpaint.radiometry.counts_to_reflectance import reflectance
from hyperpaint.regions import Region

from .figures import axes_or_new, label_for
from .plot import flags_of, rgb

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["FLAG_COLOURS", "background", "draw_outlines", "flag_overlay", "flag_shares"]


FLAG_COLOURS: Mapping[Quality, str] = {
    Quality.SATURATED: "#ff2d2d",
    Quality.BELOW_DARK: "#7b4fd6",
    Quality.BAD_DETECTOR: "#8a8a8a",
    Quality.IRRADIANCE_GAP: "#b08d00",
    Quality.ILLUMINATION_UNSTABLE: "#f0e442",
    Quality.LOW_SUN: "#8c510a",
    Quality.GLINT: "#00d5ff",
    Quality.SHADOW: "#2456d8",
    Quality.ADJACENCY: "#ff4fc3",
    Quality.MIXED_EDGE: "#17b978",
    Quality.OFF_SWATH: "#3d3d3d",
    Quality.NO_DATA: "#000000",
    Quality.TIMING_SENSITIVE: "#ff9a1f",
}
"""Colour of every flag, the same in all pictures."""


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

    Eager. Of a longer line a pixel of the picture stands for several: it has a flag where one of them has,
    and the largest value of a layer. Where a pixel has several flags, the rarest is shown. Shares are those
    of all pixels.

    Parameters
    ----------
    dataset
        A flight line with ``quality``, or with what it follows from.
    flags
        Which flags: `Quality`, or names such as ``"glint"``; by default all that occur, or none where a layer
        is drawn.
    layer
        Name of a variable (along_track, cross_track), such as a fraction of glint.
    lines
        Lines of the picture at the most.
    opacity
        From 0, nothing but the picture, to 1.
    axes
        matplotlib axes to draw on; new ones by default.

    Returns
    -------
    matplotlib.axes.Axes
        x is along_track, y is cross_track, in pixels of the flight line.

    Raises
    ------
    MissingExtraError
        matplotlib is not installed.
    SchemaError
        There is no such flag or layer, or neither quality nor what it follows from.
    """
    dataset = schema.rename_to_roles(dataset)
    wanted = _flags_named(flags)
    if layer is not None:
        _check_layer(dataset, layer)
    if "quality" not in dataset.variables and (layer is None or wanted):
        dataset = reflectance(dataset)
    axes = axes_or_new(axes, "a picture of flags", figsize=(11, 4.5))
    step = max(1, -(-dataset.sizes[ALONG_TRACK] // max(lines, 1)))
    _show(axes, background(dataset, step), dataset)
    axes.set(xlabel="along_track", ylabel="cross_track", title=_title(dataset))
    if layer is not None:
        _draw_layer(axes, dataset, layer, step, opacity)
    if layer is None or wanted:
        _draw_flags(axes, dataset, wanted, step, opacity)
    return axes


def flag_shares(quality: Array) -> dict[Quality, float]:
    """Return the share of pixels under every flag that occurs.

    Examples
    --------
    >>> flag_shares(np.array([[1, 0], [65, 0]], np.uint16))
    {<Quality.SATURATED: 1>: 0.5, <Quality.GLINT: 64>: 0.25}
    """
    shares = {flag: float(np.count_nonzero(quality & int(flag))) / max(quality.size, 1) for flag in Quality}
    return {flag: share for flag, share in shares.items() if share > 0}


def background(dataset: xr.Dataset, step: int) -> Array:
    """Return a picture of every ``step``-th line, (line, column, rgb), 0 to 1: the stored one if it fits."""
    if "overview" in dataset.variables:
        stored = dataset["overview"]
        lines, columns = dataset.sizes[ALONG_TRACK], dataset.sizes[CROSS_TRACK]
        every = [stored.attrs.get(name) for name in ("line_step", "column_step")]
        told = [int(number) if isinstance(number, int | np.integer) else 0 for number in every]
        # a part of a line still carries the picture of the whole
        whole = min(told) > 0 and stored.shape == (-(-lines // told[0]), -(-columns // told[1]), 3)
        if whole and told[0] <= step:
            kept = stored.values[:: step // told[0]]
            return np.asarray(kept, np.float32) / np.float32(255.0)
    return np.asarray(rgb(dataset.isel({ALONG_TRACK: slice(None, None, step)})).values)


def draw_outlines(axes: Any, regions: Iterable[Region]) -> None:
    """Draw the outlines of regions, with their names, over a picture made by `flag_overlay`.

    Parameters
    ----------
    axes
        matplotlib axes, x is along_track.
    regions
        In sensor coordinates.
    """
    from matplotlib.patheffects import withStroke

    seen = [withStroke(linewidth=2.5, foreground="black")]
    for region in regions:
        for ring in (region.polygon, *region.holes):
            x, y = np.vstack([ring, ring[:1]]).T
            axes.plot(y, x, color="white", lw=1.0, path_effects=seen)
        across, along = region.polygon.mean(axis=0)
        axes.text(
            along, across, label_for(region.name), color="white", fontsize="x-small", ha="center",
            va="center", clip_on=True, path_effects=seen,
        )  # fmt: skip


def _show(axes: Any, picture: Array, dataset: xr.Dataset, **options: Any) -> Any:
    """Show a picture (line, column, ...) so that whole numbers are pixel centres of the flight line."""
    edges = dataset.sizes[ALONG_TRACK] - 0.5, dataset.sizes[CROSS_TRACK] - 0.5
    return axes.imshow(
        picture.swapaxes(0, 1), aspect="auto", interpolation="nearest",
        extent=(-0.5, edges[0], edges[1], -0.5), **options,
    )  # fmt: skip


def _title(dataset: xr.Dataset) -> str:
    return label_for(dataset.attrs.get("name", "flight line"))


# --- flags -------------------------------------------------------------------------------------------------


def _flags_named(flags: Quality | str | Iterable[str] | None) -> tuple[Quality, ...]:
    """Return single flags; none where all are meant."""
    if flags is None:
        return ()
    if isinstance(flags, Quality):
        return tuple(flag for flag in Quality if flag & flags)
    names = [flags] if isinstance(flags, str) else [str(name) for name in flags]
    known = {str(flag.name).lower(): flag for flag in Quality}
    if unknown := [name for name in names if name.lower() not in known]:
        raise SchemaError(f"no flag {', '.join(map(repr, unknown))}; flags are {', '.join(known)}")
    return tuple(known[name.lower()] for name in names)


def _draw_flags(
    axes: Any, dataset: xr.Dataset, wanted: tuple[Quality, ...], step: int, opacity: float
) -> None:
    """Lay one colour a flag over the picture, the rarest on top, and name them with their shares."""
    from matplotlib.colors import to_rgb
    from matplotlib.patches import Patch

    quality = flags_of(dataset)
    shares = flag_shares(quality)
    shown = wanted or tuple(shares)
    bits = _blocks(quality, step, np.bitwise_or)
    drawn = np.zeros((*bits.shape, 4), np.float32)
    for flag in sorted(shown, key=lambda flag: -shares.get(flag, 0.0)):
        drawn[(bits & int(flag)) != 0] = (*to_rgb(FLAG_COLOURS[flag]), opacity)
    _show(axes, drawn, dataset)
    names = {flag: str(flag.name).lower().replace("_", " ") for flag in shown}
    handles = [
        Patch(facecolor=FLAG_COLOURS[flag], label=f"{name}  {_percent(shares.get(flag, 0.0))}")
        for flag, name in names.items()
    ]
    axes.legend(
        handles=handles or [Patch(facecolor="none", label="no flag set")], loc="upper left",
        bbox_to_anchor=(1.0, 1.0), fontsize="small", frameon=False, title="pixels",
    )  # fmt: skip


def _percent(share: float) -> str:
    """Return a share for reading; what is there never reads as nothing."""
    if 0 < share < 5e-6:
        return "< 0.001 %"
    return f"{100 * share:.3f}".rstrip("0").rstrip(".") + " %"


def _blocks(values: Array, step: int, combine: Any) -> Array:
    """Return what ``combine`` makes of every ``step`` lines."""
    if step == 1:
        return values
    return np.asarray(combine.reduceat(values, np.arange(0, len(values), step), axis=0))


# --- layers ------------------------------------------------------------------------------------------------


def _check_layer(dataset: xr.Dataset, layer: str) -> None:
    planes = [
        str(name)
        for name, array in dataset.variables.items()
        if set(array.dims) == {ALONG_TRACK, CROSS_TRACK} and array.dtype.kind in "fiub"
    ]
    if layer not in planes:
        raise SchemaError(
            f"no layer {layer!r} on (along_track, cross_track); there is {', '.join(planes) or 'none'}"
        )


def _draw_layer(axes: Any, dataset: xr.Dataset, layer: str, step: int, opacity: float) -> None:
    """Lay a layer over the picture: nothing at zero, opaque from a third of the range on."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    array = dataset[layer].transpose(ALONG_TRACK, CROSS_TRACK)
    values = _blocks(array.values.astype(np.float32), step, np.fmax)
    known = values[np.isfinite(values)]
    low, high = np.percentile(known, (0.2, 99.8)).tolist() if known.size else (0.0, 0.0)
    both = -low > 0.05 * max(high, 0.0) and low < 0  # what is a little below zero is noise
    size = max(abs(low), abs(high)) if both else high
    size = size if size > 0 else 1.0
    colours = ScalarMappable(Normalize(-size if both else 0.0, size), "PuOr_r" if both else "inferno")
    shown = _show(axes, np.ma.masked_invalid(values), dataset, cmap=colours.cmap, norm=colours.norm)
    part = np.abs(values) if both else np.maximum(values, 0.0)
    shown.set_alpha(np.nan_to_num(opacity * np.clip(3.0 * part / size, 0.0, 1.0)).swapaxes(0, 1))
    units = str(array.attrs.get("units", ""))
    told = label_for(layer) if units in ("", "1") else f"{label_for(layer)} [{label_for(units)}]"
    axes.figure.colorbar(colours, ax=axes, label=told, pad=0.01, fraction=0.04)
