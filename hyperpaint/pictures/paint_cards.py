"""The card of a paint: its region, the excluded pixels, and its signature with the 95 % interval."""

from __future__ import annotations

import json
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base import schema
from hyperpaint.base.arrays import Array, Bools
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.facts import documented
from hyperpaint.base.schema import ALONG_TRACK, CROSS_TRACK, SIGNATURE, Quality
from hyperpaint.base.units import takes_quantities
from hyperpaint.paints.colours import paint_colours
from hyperpaint.paints.signatures.extraction import EXCLUDED
from hyperpaint.paints.signatures.pixel_statistics import excluded_of
from hyperpaint.regions import Region, Regions, pixels_of, regions_from

from .figures import columns_for, ink_of, label_for, legend_below, new_figure, save_figure
from .orientation import orientation_of, show_picture
from .plot import flag_label, percent, rgb
from .plot_flags import draw_outlines
from .plot_spectra import draw_band, draw_curve, find_usable, good_bands, styles_of

MARGIN = 0.6  # margin drawn around a region, relative to the longer side of the region
MIN_MARGIN_PX = 14
COVERAGE = 1.96  # standard uncertainties in half of a 95 % interval
_CHARS_PER_INCH = 14.0  # of small text


@takes_quantities()
@documented(path="picture")
def paint_card(
    line: xr.Dataset, library: xr.Dataset, paint: str, path: str | Path | None = None, *, width: float = 12.0
) -> Any:
    r"""Draw one paint of a library on the flight line it was measured on.

    The card shows the surroundings in true colour with the region; flags of the surroundings, and the pixels
    used for the signature; the signature with the middle half of its pixels and its 95 % interval; and the
    reasons stored with the region. Eager: only the lines around the region are read.

    Parameters
    ----------
    line
        The flight line, with ``reflectance`` and, to show flags, ``quality``.
    library
    paint
        Name of the paint.
    path
    width
        Width of the figure [inch]; below 9 the plots stand one above the other.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    MissingExtraError
        matplotlib is not installed.
    SchemaError
        The library is no paint library or lacks the paint; the paint has no region in sensor coordinates, or
        the region contains no pixel of this line; or matplotlib cannot write this type of picture.

    Notes
    -----
    The interval is :math:`\rho \pm 1.96 \sqrt{u_r^2 + u_s^2 + (u_l \rho)^2}` with the standard uncertainties
    of the library, and :math:`u_l` that of the level (``level_uncertainty``, relative), where it states one.

    Examples
    --------
    >>> from hyperpaint.paints import extract_signatures
    >>> from hyperpaint.regions import Region
    >>> from hyperpaint.simulation import simulate_line
    >>> line = simulate_line(lines=32, bands=40, columns=24)
    >>> paints = extract_signatures(line, [Region("grass", [(0, 0), (0, 31), (0.4, 31), (0.4, 0)])])
    >>> len(paint_card(line, paints, "grass").axes)
    4
    """
    line, (signature, colour) = schema.rename_to_roles(line), _find_paint(library, paint)
    region = _paint_region(signature)
    surroundings, in_region = _surroundings(line, region)
    is_wide = columns_for(width, 3.0, 3) == 3
    # name, kind and finish of the paint, and the reasons stored with its region
    properties = region.properties
    head = [label_for(signature[SIGNATURE].item())]
    head += [label_for(properties[name]) for name in ("kind", "finish") if properties.get(name)]
    reasons, chars = properties.get("reasons", ()), int(_CHARS_PER_INCH * (width - 0.3))
    reasons = reasons if isinstance(reasons, list | tuple) else ()
    text = label_for("; ".join(map(str, reasons)), longest=6 * chars)
    lines_of_text = ["  |  ".join(head), *textwrap.wrap(text, chars)]
    text_height, body = 0.2 * len(lines_of_text) + 0.1, 4.4 if is_wide else 11.0
    figure = new_figure("the card of a paint", figsize=(width, text_height + body), layout="constrained")
    if is_wide:
        ratios = {"width_ratios": (1.0, 1.0, 1.5), "height_ratios": (text_height, body)}
        mosaic = [["text"] * 3, ["place", "used", "signature"]]
    else:
        ratios = {"height_ratios": (text_height, *[body / 3] * 3)}
        mosaic = [["text"], ["place"], ["used"], ["signature"]]
    plots = figure.subplot_mosaic(mosaic, **ratios)
    plots["text"].set_axis_off()
    plots["text"].text(0.0, 1.0, "\n".join(lines_of_text), fontsize="small", va="top", in_layout=False)
    show_picture(plots["place"], np.asarray(rgb(surroundings).values), orientation_of(surroundings))
    draw_outlines(plots["place"], [region], width=1.2, named=False)
    plots["place"].set_title("region on the flight line", fontsize="small", loc="left")
    # flags that the library excluded
    names = set(str(library.attrs.get("exclude", "")).split())
    excluded = sum(int(flag) for flag in Quality if str(flag.name).lower() in names)
    _draw_exclusions(
        plots["used"],
        surroundings,
        in_region,
        region,
        excluded_of(region, excluded if names else int(EXCLUDED)),
    )
    _draw_signature(plots["signature"], signature, colour)
    save_figure(figure, path)
    return figure


def _paint_region(paint: xr.Dataset) -> Region:
    name = str(paint[SIGNATURE].item())
    if "region" not in paint.variables or not str(paint["region"].item()):
        raise SchemaError(
            f"paint {name!r} has no region", expected="a library from a flight line", code="region-missing"
        )
    if paint.attrs.get("coordinates_of_regions", "sensor") != "sensor":
        raise SchemaError(
            f"the region of paint {name!r} is on a map",
            mend="draw its card from the flight line",
            code="region-coordinates",
        )
    return regions_from(json.loads(str(paint["region"].item())))[0]


def _find_paint(library: xr.Dataset, paint: str) -> tuple[xr.Dataset, Array]:
    usable, _ = find_usable(library)
    if "reflectance" not in usable.variables or SIGNATURE not in usable["reflectance"].dims:
        raise SchemaError(
            "the card of a paint needs a paint library",
            expected="reflectance (signature, band)",
            code="library-missing",
        )
    names = [str(name) for name in usable[SIGNATURE].values]
    if paint not in names:
        raise SchemaError(
            f"there is no paint {paint!r}", expected=", ".join(names[:20]), code="paint-unknown"
        )
    selection = usable.isel({SIGNATURE: [names.index(paint)]}).compute()
    return selection.isel({SIGNATURE: 0}), np.asarray(paint_colours(selection)[0])


def _surroundings(line: xr.Dataset, region: Region) -> tuple[xr.Dataset, Bools]:
    # crop of the line around the region, and which of its pixels (line, column) are in the region
    ((line_indices, column_indices),) = pixels_of(Regions((region,)), line)
    if not line_indices.size:
        raise SchemaError(f"region {region.name!r} contains no pixel of this line", code="region-empty")
    margin = max(MIN_MARGIN_PX, int(MARGIN * (max(np.ptp(line_indices), np.ptp(column_indices)) + 1)))
    rows, columns = (
        slice(max(int(places.min()) - margin, 0), int(places.max()) + margin + 1)
        for places in (line_indices, column_indices)
    )
    cropped = line.isel({ALONG_TRACK: rows, CROSS_TRACK: columns})
    shape = cropped.sizes[ALONG_TRACK], cropped.sizes[CROSS_TRACK]
    in_region = np.zeros(shape, bool)
    in_region[line_indices - rows.start, column_indices - columns.start] = True
    # centres of pixels have their numbers in the line, also if the line has no coordinates
    numbers = {
        dim: np.arange(span.start, span.start + size)
        for dim, span, size in zip((ALONG_TRACK, CROSS_TRACK), (rows, columns), shape, strict=True)
        if dim not in cropped.coords
    }
    return cropped.assign_coords(numbers), in_region


def _draw_exclusions(axes: Any, around: xr.Dataset, in_region: Bools, region: Region, excluded: int) -> None:
    from matplotlib.colors import to_rgb
    from matplotlib.patches import Patch

    orientation = orientation_of(around)
    grey = np.asarray(rgb(around).values).mean(axis=2, keepdims=True)
    picture = np.broadcast_to(0.35 + 0.5 * np.nan_to_num(grey), (*in_region.shape, 3)).copy()
    bits = np.zeros(in_region.shape, np.uint16)
    if "quality" in around.variables:
        bits = around["quality"].transpose(ALONG_TRACK, CROSS_TRACK).values
    is_used = in_region & ((bits & np.uint16(excluded)) == 0)
    picture[is_used] = np.asarray(rgb(around).values)[is_used]
    entries = {f"used  {is_used.sum()} px": Patch(facecolor="none", edgecolor="0.5", lw=0.5)}
    shares = {flag: float(((bits & int(flag)) != 0)[in_region].mean()) for flag in Quality if flag & excluded}
    for flag, share in sorted(shares.items(), key=lambda pair: -pair[1]):
        has_flag = (bits & int(flag)) != 0
        if not has_flag.any():
            continue
        picture[has_flag] = to_rgb(flag.colour)
        name = f"{flag_label(flag)}  {percent(share) if share else 'outside only'}"
        entries[name] = Patch(facecolor=flag.colour, edgecolor="0.5", lw=0.5)
    show_picture(axes, picture, orientation)
    axes.set(ylabel="")
    draw_outlines(axes, [region], width=1.2, named=False)
    axes.set_title("pixels used, and excluded pixels by flag", fontsize="small", loc="left")
    legend_below(axes, entries=entries)


def _draw_signature(axes: Any, signature: xr.Dataset, colour: Array) -> None:
    wavelength, is_good = np.asarray(signature["wavelength"].values), good_bands(signature)
    reflectance = np.where(is_good, signature["reflectance"].values, np.nan)
    interval = _interval(signature)
    (style,) = styles_of(colour[np.newaxis])
    if interval is not None:
        for sign, label in ((-1, "95 % interval"), (1, None)):
            axes.plot(
                wavelength, reflectance + sign * interval, color=ink_of(axes), lw=0.8, ls=":", label=label
            )
    draw_band(axes, signature, wavelength, is_good, "quantiles", style["color"])
    count = f", n = {int(signature['n'])}" if "n" in signature.variables else ""
    draw_curve(axes, wavelength, reflectance, style, f"signature{count}")
    axes.set(xlabel="wavelength [nm]", ylabel="reflectance factor [1]")
    axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize="small")
    legend_below(axes)


def _interval(signature: xr.Dataset) -> Array | None:
    # half width of the 95 % interval (band,) [1]; None if the library has no uncertainty
    names = ["reflectance_u_random", "reflectance_u_systematic"]
    if "reflectance_u_coat" in signature.variables and not (
        names[1] in signature.variables and np.isfinite(signature[names[1]]).any()
    ):
        names[1] = "reflectance_u_coat"  # already a part of the systematic uncertainty if that is known
    uncertainties = [
        np.nan_to_num(signature[name].values.astype(np.float64))
        for name in names
        if name in signature.variables
    ]
    if "level_uncertainty" in signature.variables and np.isfinite(signature["level_uncertainty"].item()):
        uncertainties.append(
            float(signature["level_uncertainty"]) * signature["reflectance"].values.astype(np.float64)
        )
    if not uncertainties or not any(u.any() for u in uncertainties):
        return None
    return np.asarray(COVERAGE * np.sqrt(sum(u**2 for u in uncertainties)))
