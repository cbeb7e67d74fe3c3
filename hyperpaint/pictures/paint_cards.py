"""The card of a paint: where it was measured, what was left out, and the signature with its interval."""

from __future__ import annotations

import json
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hyperpaint.base import schema
from hyperpaint.base.arrays import Array, Bools
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.schema import ALONG_TRACK, CROSS_TRACK, SIGNATURE, Quality
from hyperpaint.base.units import takes_quantities
from hyperpaint.paints.colours import paint_colours
from hyperpaint.paints.signatures.extraction import EXCLUDED
from hyperpaint.paints.signatures.pixel_statistics import excluded_of
from hyperpaint.regions import Region, Regions, pixels_of, regions_from

from .figures import columns_for, ink_of, label_for, legend_below, new_figure, save_figure
from .orientation import orientation_of, show_picture
from .plot import percent, rgb
from .plot_flags import FLAG_COLOURS
from .plot_spectra import draw_band, draw_curve, find_usable, good_of, styles_of

if TYPE_CHECKING:
    import xarray as xr

MARGIN = 0.6
"""What is shown around a region, relative to its longer side."""

MIN_MARGIN_PX = 14
"""The same at least [pixel]."""

COVERAGE = 1.96
"""Standard uncertainties in half of an interval of 95 %."""

_LETTERS = 14.0  # of small text in an inch


@takes_quantities()
def paint_card(
    line: xr.Dataset, library: xr.Dataset, paint: str, path: str | Path | None = None, *, width: float = 12.0
) -> Any:
    r"""Draw one paint of a library on the flight line it was measured on: the picture a user can judge it by.

    The surroundings in true colour with the region; the flags there, with the pixels that the signature was
    made of; the signature with its middle half of pixels and its interval of 95 %; and what was said for
    the region, and against its pixels. Eager: only the lines around the region are read.

    Parameters
    ----------
    line
        The flight line, with ``reflectance`` and, where flags are to be shown, ``quality``.
    library
        From `hyperpaint.extract_signatures`, or a store of it.
    paint
        Name of the paint.
    path
        Where to write a picture (PNG, PDF, ...); nowhere by default.
    width
        Of the figure [inch]; below 9 the panels stand one above the other.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    MissingExtraError
        matplotlib is not installed.
    SchemaError
        It is no paint library or holds no such paint; the paint has no region in coordinates of the sensor,
        or the region no pixel of this line; or matplotlib writes no such picture.

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
    line, (own, colour) = schema.rename_to_roles(line), _paint_of(library, paint)
    region = region_of_paint(own)
    around, inside = _surroundings(line, region)
    is_wide = columns_for(width, 3.0, 3) == 3
    lines_of_text = _caption(own, region, int(_LETTERS * (width - 0.3)))
    head = 0.2 * len(lines_of_text) + 0.1
    body = 4.4 if is_wide else 11.0
    figure = new_figure("the card of a paint", figsize=(width, head + body), layout="constrained")
    if is_wide:
        ratios = {"width_ratios": (1.0, 1.0, 1.5), "height_ratios": (head, body)}
        mosaic = [["text"] * 3, ["place", "used", "signature"]]
    else:
        ratios = {"height_ratios": (head, *[body / 3] * 3)}
        mosaic = [["text"], ["place"], ["used"], ["signature"]]
    panels = figure.subplot_mosaic(mosaic, **ratios)
    panels["text"].set_axis_off()
    panels["text"].text(0.0, 1.0, "\n".join(lines_of_text), fontsize="small", va="top", in_layout=False)
    _draw_place(panels["place"], around, region)
    _draw_exclusions(panels["used"], around, inside, region, excluded_of(region, _usually_excluded(library)))
    _draw_signature(panels["signature"], own, colour)
    save_figure(figure, path)
    return figure


def region_of_paint(paint: xr.Dataset) -> Region:
    """Return the region that a paint was made of; `SchemaError` where it is on no flight line."""
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


def _paint_of(library: xr.Dataset, paint: str) -> tuple[xr.Dataset, Array]:
    """Return one paint of a library, and its colour in daylight."""
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
    own = usable.isel({SIGNATURE: [names.index(paint)]}).compute()
    return own.isel({SIGNATURE: 0}), np.asarray(paint_colours(own)[0])


# --- where -------------------------------------------------------------------------------------------------


def _surroundings(line: xr.Dataset, region: Region) -> tuple[xr.Dataset, Bools]:
    """Return the lines and columns around a region, in memory, and which pixels lie inside (line, column)."""
    ((along, across),) = pixels_of(Regions((region,)), line)
    if not along.size:
        raise SchemaError(f"region {region.name!r} holds no pixel of this line", code="region-empty")
    longer = max(np.ptp(along), np.ptp(across)) + 1
    margin = max(MIN_MARGIN_PX, int(MARGIN * longer))
    rows, columns = (
        slice(max(int(places.min()) - margin, 0), int(places.max()) + margin + 1)
        for places in (along, across)
    )
    cropped = line.isel({ALONG_TRACK: rows, CROSS_TRACK: columns})
    shape = cropped.sizes[ALONG_TRACK], cropped.sizes[CROSS_TRACK]
    inside = np.zeros(shape, bool)
    inside[along - rows.start, across - columns.start] = True
    # whole numbers are centres of pixels, also of a line without coordinates
    numbers = {
        dim: np.arange(span.start, span.start + size)
        for dim, span, size in zip((ALONG_TRACK, CROSS_TRACK), (rows, columns), shape, strict=True)
        if dim not in cropped.coords
    }
    return cropped.assign_coords(numbers), inside


def _draw_place(axes: Any, around: xr.Dataset, region: Region) -> None:
    show_picture(axes, np.asarray(rgb(around).values), orientation_of(around))
    _draw_outline(axes, region)
    axes.set_title("where it was measured", fontsize="small", loc="left")


def _draw_outline(axes: Any, region: Region) -> None:
    from matplotlib.patheffects import withStroke

    for ring in (region.polygon, *region.holes):
        x, y = np.vstack([ring, ring[:1]]).T
        axes.plot(x, y, color="white", lw=1.2, path_effects=[withStroke(linewidth=2.5, foreground="black")])


# --- what was left out -------------------------------------------------------------------------------------


def _draw_exclusions(axes: Any, around: xr.Dataset, inside: Bools, region: Region, excluded: int) -> None:
    """Draw the pixels that were used, and the flags of those inside and around that were not."""
    from matplotlib.colors import to_rgb
    from matplotlib.patches import Patch

    orientation = orientation_of(around)
    grey = np.asarray(rgb(around).values).mean(axis=2, keepdims=True)
    drawn = np.broadcast_to(0.35 + 0.5 * np.nan_to_num(grey), (*inside.shape, 3)).copy()
    bits = np.zeros(inside.shape, np.uint16)
    if "quality" in around.variables:
        bits = around["quality"].transpose(ALONG_TRACK, CROSS_TRACK).values
    used = inside & ((bits & np.uint16(excluded)) == 0)
    drawn[used] = np.asarray(rgb(around).values)[used]
    entries = {f"used  {used.sum()} px": Patch(facecolor="none", edgecolor="0.5", lw=0.5)}
    shares = {flag: float(((bits & int(flag)) != 0)[inside].mean()) for flag in Quality if flag & excluded}
    for flag, share in sorted(shares.items(), key=lambda pair: -pair[1]):
        here = (bits & int(flag)) != 0
        if not here.any():
            continue
        drawn[here] = to_rgb(FLAG_COLOURS[flag])
        name = f"{str(flag.name).lower().replace('_', ' ')}  {percent(share) if share else 'beside it only'}"
        entries[name] = Patch(facecolor=FLAG_COLOURS[flag], edgecolor="0.5", lw=0.5)
    show_picture(axes, drawn, orientation)
    axes.set(ylabel="")
    _draw_outline(axes, region)
    axes.set_title("what was used, and left out of the region", fontsize="small", loc="left")
    legend_below(axes, entries=entries)


def _usually_excluded(library: xr.Dataset) -> int:
    """Return the flags of pixels that a library says it left out."""
    names = str(library.attrs.get("exclude", "")).split()
    known = {str(flag.name).lower(): int(flag) for flag in Quality}
    return sum(known[name] for name in set(names) & set(known)) if names else int(EXCLUDED)


# --- the signature -----------------------------------------------------------------------------------------


def _draw_signature(axes: Any, own: xr.Dataset, colour: Array) -> None:
    wavelength, is_good = np.asarray(own["wavelength"].values), good_of(own)
    centre = np.where(is_good, own["reflectance"].values, np.nan)
    interval = _interval(own)
    (style,) = styles_of(colour[np.newaxis])
    if interval is not None:
        for sign, label in ((-1, "interval of 95 %"), (1, None)):
            axes.plot(wavelength, centre + sign * interval, color=ink_of(axes), lw=0.8, ls=":", label=label)
    draw_band(axes, own, wavelength, is_good, "quantiles", style["color"])
    count = f", n = {int(own['n'])}" if "n" in own.variables else ""
    draw_curve(axes, wavelength, centre, style, f"signature{count}")
    axes.set(xlabel="wavelength [nm]", ylabel="reflectance factor [1]")
    axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize="small")
    legend_below(axes)


def _interval(own: xr.Dataset) -> Array | None:
    """Return half of the interval of 95 % (band,) [1]; None where the library states no uncertainty."""
    names = ["reflectance_u_random", "reflectance_u_systematic"]
    if "reflectance_u_coat" in own.variables and not (
        names[1] in own.variables and np.isfinite(own[names[1]]).any()
    ):
        names[1] = "reflectance_u_coat"  # which is part of the systematic one where that is known
    parts = [np.nan_to_num(own[name].values.astype(np.float64)) for name in names if name in own.variables]
    if "level_uncertainty" in own.variables and np.isfinite(own["level_uncertainty"].item()):
        parts.append(float(own["level_uncertainty"]) * own["reflectance"].values.astype(np.float64))
    if not parts or not any(part.any() for part in parts):
        return None
    return np.asarray(COVERAGE * np.sqrt(sum(part**2 for part in parts)))


def _caption(own: xr.Dataset, region: Region, letters: int) -> list[str]:
    """Return lines of text: the name of a paint, and what its region says of itself."""
    said = region.properties
    head = [label_for(own[SIGNATURE].item())]
    head += [label_for(said[name]) for name in ("kind", "finish") if said.get(name)]
    reasons = said.get("reasons", ())
    if not isinstance(reasons, list | tuple):
        reasons = ()
    text = label_for("; ".join(map(str, reasons)), longest=6 * letters)
    return ["  |  ".join(head), *textwrap.wrap(text, letters)]
