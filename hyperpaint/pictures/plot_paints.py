"""Pictures of paints and panels: chips beside renders, cards, detection, comparisons with references."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from hyperpaint.base import (
    ALONG_TRACK,
    BAND,
    CROSS_TRACK,
    LIBRARY_VARIABLES,
    MEMBER,
    SIGNATURE,
    Array,
    Bools,
    Quality,
    SchemaError,
    documented,
    rename_to_roles,
    require,
    schema,
    takes_quantities,
)
from hyperpaint.light.daylight_colours import srgb
from hyperpaint.paints.paint_libraries import paint_colours
from hyperpaint.paints.signatures.extraction import EXCLUDED
from hyperpaint.paints.signatures.pixel_statistics import excluded_of
from hyperpaint.radiometry.panels import CLOSURE, PANEL_STATES
from hyperpaint.regions import Region, Regions, pixels_of, regions_from

from .figures import (
    COLOURS,
    columns_for,
    ink_of,
    label_for,
    legend_below,
    new_figure,
    orientation_of,
    save_figure,
    show_picture,
)
from .plot import (
    draw_band,
    draw_curve,
    draw_outlines,
    find_usable,
    flag_label,
    good_bands,
    percent,
    rgb,
    styles_of,
)

if TYPE_CHECKING:
    from hyperpaint.validation import Validation

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
    variables = require(paints, ["reflectance", "wavelength"], "chips", LIBRARY_VARIABLES)
    lines: dict[str, Any] = {"": renders}
    if isinstance(renders, Mapping) and not hasattr(renders, "dims"):
        lines = dict(renders)
    if problems or not paints.sizes[SIGNATURE] or not lines:
        reason = "; ".join(problems) or f"{paints.sizes[SIGNATURE]} paints and {len(lines)} renders"
        raise SchemaError(f"a collage needs a paint library and a render: {reason}", code="empty-input")
    count, nm = min(paints.sizes[SIGNATURE], MAX_CHIPS), variables["wavelength"].values
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
            axes.imshow(_chip(paint, nm, colours[number]), interpolation="nearest")
            axes.set_title(label_for(str(paint[SIGNATURE].values), 26), fontsize=6, pad=2)
    plots = render_figure.subplots(1, len(lines), squeeze=False)[0]
    for axes, (name, line) in zip(plots, lines.items(), strict=True):
        show_picture(axes, rgb(line, stretch=stretch).values, orientations[name])
        axes.set_axis_off()
        axes.set_title(label_for(name.replace("_", " ")), fontsize="small")
    return save_figure(figure, path, dpi=150)


def _chip(paint: xr.Dataset, wavelength: Array, colour: Array) -> Array:
    # (row, column, rgb), 0 to 1; pixels show random members of the population, else the colour of the paint
    uniform = np.broadcast_to(np.nan_to_num(colour), (_CHIP_PX, _CHIP_PX, 3))
    if "member_reflectance" not in paint.variables:
        return np.asarray(uniform)
    is_visible = good_bands(paint) & (wavelength > 380.0) & (wavelength < 780.0)
    members = np.asarray(paint["member_reflectance"].transpose(MEMBER, BAND).values)[:, is_visible]
    members = members[np.isfinite(members).all(axis=1)]
    if len(members) < 2 or is_visible.sum() < 3:
        return np.asarray(uniform)
    numbers = np.random.default_rng(0).integers(len(members), size=_CHIP_PX**2)
    return np.asarray(srgb(members, wavelength[is_visible])[numbers].reshape(_CHIP_PX, _CHIP_PX, 3)).clip(
        0.0, 1.0
    )


# --- the card of a paint -----------------------------------------------------------------------------------


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
    # the paint, with the dim signature of length 1, and its region on the flight line
    usable, _ = find_usable(library)
    SchemaError.raise_if(
        "reflectance" not in usable.variables or SIGNATURE not in usable["reflectance"].dims,
        "the card of a paint needs a paint library",
        expected="reflectance (signature, band)",
        code="library-missing",
    )
    paints = [str(name) for name in usable[SIGNATURE].values]
    SchemaError.raise_if(
        paint not in paints,
        f"there is no paint {paint!r}",
        expected=", ".join(paints[:20]),
        code="paint-unknown",
    )
    signature = usable.isel({SIGNATURE: [paints.index(paint)]}).compute()
    SchemaError.raise_if(
        "region" not in signature.variables or not str(signature["region"].item()),
        f"paint {paint!r} has no region",
        expected="a library from a flight line",
        code="region-missing",
    )
    SchemaError.raise_if(
        signature.attrs.get("coordinates_of_regions", "sensor") != "sensor",
        f"the region of paint {paint!r} is on a map",
        mend="draw its card from the flight line",
        code="region-coordinates",
    )
    region = regions_from(json.loads(str(signature["region"].item())))[0]
    line = rename_to_roles(line)
    # crop of the line around the region, and which of its pixels (line, column) are in the region
    ((line_indices, column_indices),) = pixels_of(Regions((region,)), line)
    SchemaError.raise_if(
        not line_indices.size, f"region {region.name!r} contains no pixel of this line", code="region-empty"
    )
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
    surroundings = cropped.assign_coords(numbers)
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
    colours = np.asarray(rgb(surroundings).values)
    show_picture(plots["place"], colours, orientation_of(surroundings))
    draw_outlines(plots["place"], [region], width=1.2, named=False)
    plots["place"].set_title("region on the flight line", fontsize="small", loc="left")
    # flags that the library excluded
    names = set(str(library.attrs.get("exclude", "")).split())
    excluded = sum(int(flag) for flag in Quality if str(flag.name).lower() in names)
    _draw_exclusions(
        plots["used"],
        surroundings,
        colours,
        in_region,
        region,
        excluded_of(region, excluded if names else int(EXCLUDED)),
    )
    _draw_signature(plots["signature"], signature)
    return save_figure(figure, path)


def _draw_exclusions(
    axes: Any, around: xr.Dataset, colours: Array, in_region: Bools, region: Region, excluded: int
) -> None:
    from matplotlib.colors import to_rgb
    from matplotlib.patches import Patch

    orientation = orientation_of(around)
    grey = colours.mean(axis=2, keepdims=True)
    picture = np.broadcast_to(0.35 + 0.5 * np.nan_to_num(grey), (*in_region.shape, 3)).copy()
    bits = (
        around["quality"].transpose(ALONG_TRACK, CROSS_TRACK).values
        if "quality" in around.variables
        else np.zeros(in_region.shape, np.uint16)
    )
    is_used = in_region & ((bits & np.uint16(excluded)) == 0)
    picture[is_used] = colours[is_used]
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


def _draw_signature(axes: Any, selection: xr.Dataset) -> None:
    (style,) = styles_of(paint_colours(selection))
    signature = selection.isel({SIGNATURE: 0})
    wavelength, is_good = np.asarray(signature["wavelength"].values), good_bands(signature)
    reflectance = np.where(is_good, signature["reflectance"].values, np.nan)
    # half width of the 95 % interval, if the library has uncertainties
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
    if any(u.any() for u in uncertainties):
        interval = COVERAGE * np.sqrt(sum(u**2 for u in uncertainties))
        for edge, label in ((reflectance - interval, "95 % interval"), (reflectance + interval, None)):
            axes.plot(wavelength, edge, color=ink_of(axes), lw=0.8, ls=":", label=label)
    draw_band(axes, signature, wavelength, is_good, "quantiles", style["color"])
    count = f", n = {int(signature['n'])}" if "n" in signature.variables else ""
    draw_curve(axes, wavelength, reflectance, style, f"signature{count}")
    axes.set(xlabel="wavelength [nm]", ylabel="reflectance factor [1]")
    axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize="small")
    legend_below(axes)


# --- receiver operating characteristics of paint detection -------------------------------------------------


@documented(path="picture")
def detection_curve(
    detections: xr.Dataset | Mapping[str, xr.Dataset],
    truth: Any,
    path: str | Path | None = None,
    *,
    width: float = 6.0,
) -> Any:
    """Draw the detection rate of paints against the false alarm rate, over all thresholds (ROC).

    Eager.

    Parameters
    ----------
    detections
        Result of `hyperpaint.paints.detect`, or several by name, such as one per method.
    truth
        Pixels that show one of the paints, (along_track, cross_track) bool.
    path
    width

    Returns
    -------
    matplotlib.figure.Figure
        One curve per result: along it the thresholds of all paints are shifted by the same amount. A dot
        marks the detections after rejection of unknown paints; the vertical line is the requested false alarm
        rate.

    Raises
    ------
    MissingExtraError
        matplotlib is not installed.
    SchemaError
        The input holds no detections, or ``truth`` has another shape, or is True or False everywhere.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> pixel, unit = ("along_track", "cross_track"), {"units": "1"}
    >>> result = xr.Dataset({"detection_score": (pixel, np.float32([[0.1, 0.9, 0.2, 0.8]]), unit),
    ...                     "best_paint": (pixel, np.int16([[0, 0, 0, 0]])),
    ...                     "score_threshold": ("signature", [0.5], unit),
    ...                     "detected": (pixel, [[False, True, False, True]])})
    >>> figure = detection_curve({"ACE": result}, [[False, True, False, False]])
    >>> figure.axes[0].lines[0].get_ydata().tolist()
    [1.0, 1.0, 1.0, 1.0]
    """
    by_name: Any = {"": detections} if "detected" in detections else detections
    is_target = np.asarray(getattr(truth, "values", truth), bool)
    figure = new_figure("a detection curve", figsize=(width, 0.8 * width), layout="constrained")
    axes = figure.add_subplot()
    for number, (name, result) in enumerate(dict[str, Any](by_name).items()):
        names = ("detection_score", "best_paint", "score_threshold", "detected")
        arrays = require(rename_to_roles(result), names, "a detection curve")
        score, paint, threshold, detected = (arrays[key].values for key in names)
        SchemaError.raise_if(
            is_target.shape != score.shape,
            f"truth has shape {is_target.shape}",
            expected=f"{score.shape}, as the detections",
            code="grid-mismatch",
        )
        has_score = paint >= 0
        is_hit = is_target[has_score]
        SchemaError.raise_if(
            not is_hit.any() or is_hit.all(),
            f"truth is {bool(is_hit.any())} everywhere",
            expected="True for pixels with a paint, False for all other pixels",
            code="truth-uniform",
        )
        # false alarm and detection rates over all thresholds, and the two rates of the stored detections
        order = np.argsort(-(score - threshold[paint])[has_score], kind="stable")
        hits, alarms = (np.cumsum(which[order]) / which.sum() for which in (is_hit, ~is_hit))
        alarms = np.maximum(alarms, 0.5 / (~is_hit).sum())
        dot = detected[has_score & ~is_target].mean(), detected[has_score & is_target].mean()
        colour = COLOURS[number % len(COLOURS)]
        axes.plot(alarms, hits, color=colour, label=name or str(result.attrs.get("method", "")))
        axes.plot(max(dot[0], alarms[0]), dot[1], "o", color=colour)
        rate = result.attrs.get("false_alarm_rate")
        if rate is not None:
            axes.axvline(rate, color=ink_of(axes, 0.5), linewidth=0.8, linestyle="--")
    labels = "false alarm rate, share of other pixels [1]", "detection rate, share of the paint's pixels [1]"
    axes.set(xscale="log", ylim=(0.0, 1.02), xlabel=labels[0], ylabel=labels[1])
    legend_below(axes)
    return save_figure(figure, path)


# --- pictures of a validation, and of panels: signatures and references, measured and expected -------------


MAX_PAIRS = 24  # of one figure

_AXES_INCH = (3.6, 3.9)
_SIGNATURE = "#3399DD"
_FAILED = "#C0392B"  # title and frame of a paint outside the tolerance
# colours (of Okabe and Ito) and dashes of the references of one paint, one per instrument
_REFERENCES = (("#D55E00", "--"), ("#009E73", "-."), ("#CC79A7", ":"), ("#E69F00", (0, (6, 1, 1, 1))))
_MIN_SPAN = 0.005  # half range of the axis of differences [1]


@documented(path="picture")
def validation_figure(
    validation: Validation, path: str | Path | None = None, *, columns: int = 3, limit: float | None = None
) -> Any:
    """Draw every signature with its references and their spread, and the differences below.

    References of several instruments share a plot.

    Parameters
    ----------
    validation
        Result of `hyperpaint.validate`.
    path
    columns
    limit
        Half range of all axes of differences [1]; by default it holds the largest difference and the limit of
        RMSE, which is shaded.

    Returns
    -------
    matplotlib.figure.Figure
        At most 24 paints, those with the largest RMSE, as the title notes. Shades are a standard deviation of
        pixels or readings; for differences, the standard uncertainty. Bands not compared are blank. A paint
        with a pair outside the tolerance has a red frame and "FAIL" in its title.

    Raises
    ------
    MissingExtraError
        matplotlib is not installed.
    SchemaError
        ``columns`` or ``limit`` is not positive, or matplotlib cannot write this type of picture.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> from hyperpaint.validation import validate
    >>> nm = np.linspace(400.0, 700.0, 61)
    >>> axis = {"wavelength": ("band", nm, {"units": "nm"}), "signature": ["hood"]}
    >>> level = 0.2 + 0.001 * (nm - 400.0)
    >>> field = xr.Dataset({"reflectance": (("signature", "band"), [level], {"units": "1"})}, axis)
    >>> library = field.assign(reflectance=field.reflectance + 0.002)
    >>> agreement = validate(library, field, reference_fwhm=5.0)
    >>> len(validation_figure(agreement).axes)
    2
    """
    SchemaError.raise_if(
        columns < 1 or (limit is not None and not limit > 0.0),
        f"columns={columns}, limit={limit}",
        expected="positive numbers",
        code="value-out-of-range",
    )
    # pairs by paint, of the `MAX_PAIRS` paints with the largest RMSE
    pairs_by_paint: dict[str, list[int]] = {}
    for number, spectra in enumerate(validation.spectra):
        pairs_by_paint.setdefault(str(spectra.attrs["signature"]), []).append(number)
    paints, count = list(pairs_by_paint.values()), len(pairs_by_paint)
    if count > MAX_PAIRS:
        rmse = np.nan_to_num(validation.statistics["rmse"].max("part").values)
        paints = sorted(paints, key=lambda pairs: -max(rmse[pairs]))[:MAX_PAIRS]
    columns = min(columns, len(paints))
    rows = -(-len(paints) // columns)
    size = (_AXES_INCH[0] * columns, _AXES_INCH[1] * rows + 0.7)
    figure = new_figure("a picture of a validation", figsize=size, layout="constrained")
    grid = figure.add_gridspec(2 * rows, columns, height_ratios=[2.4, 1.0] * rows)
    if limit is None:
        drawn_pairs = [pair for pairs in paints for pair in pairs]
        max_differences = [
            float(np.abs(validation.spectra[pair]["difference"]).max()) for pair in drawn_pairs
        ]
        limits = float(np.nan_to_num(validation.statistics["rmse_limit"].values[drawn_pairs]).max())
        limit = 1.15 * max(
            _MIN_SPAN, limits, *(difference for difference in max_differences if np.isfinite(difference))
        )
    for panel, pairs in enumerate(paints):
        row, column = divmod(panel, columns)
        upper = figure.add_subplot(grid[2 * row, column])
        lower = figure.add_subplot(grid[2 * row + 1, column], sharex=upper)
        _draw_spectra(upper, validation, pairs)
        # differences below
        lower.axhline(0.0, color=ink_of(lower, 0.4), lw=0.8)
        for number, pair in enumerate(pairs):
            spectra = validation.spectra[pair]
            colour, dashes = _REFERENCES[number % len(_REFERENCES)]
            nm, values = _values_on_wavelengths(spectra, spectra["difference"])
            edge = float(_largest_part(validation, pair)["rmse_limit"])
            if np.isfinite(edge) and not number:
                lower.axhspan(-edge, edge, color="#009E73", alpha=0.12, lw=0)
            lower.plot(nm, values, color=colour, ls=dashes, lw=1.2)
            uncertainties = [
                _values_on_wavelengths(spectra, spectra[name])[1]
                for name in ("signature_u", "reference_u")
                if name in spectra
            ]
            if uncertainties:
                u = np.sqrt(sum(u_part**2 for u_part in uncertainties))
                lower.fill_between(nm, values - u, values + u, color=colour, alpha=0.2, lw=0)
        lower.set_ylim(-limit, limit)
        lower.tick_params(labelsize="small")
        if column == 0:
            lower.set_ylabel("difference [1]", fontsize="small")
        upper.tick_params(labelbottom=False)
        legend_below(lower, upper, fontsize="x-small")
        if column == 0:
            upper.set_ylabel("reflectance factor [1]", fontsize="small")
        lower.set_xlabel("wavelength [nm]", fontsize="small")
    ending = f", the {len(paints)} worst of {count} shown" if count > len(paints) else ""
    title = textwrap.fill(label_for(validation.verdict, longest=150) + ending, max(30, int(13 * size[0])))
    figure.suptitle(title, fontsize="small")
    return save_figure(figure, path)


def _draw_spectra(axes: Any, validation: Validation, pairs: list[int]) -> None:
    signature = validation.spectra[pairs[0]]
    _draw_side(axes, signature, "signature", "signature", _SIGNATURE, "-")
    for number, pair in enumerate(pairs):
        spectra = validation.spectra[pair]
        # agreement over the part of the spectrum with most bands
        part = _largest_part(validation, pair)
        limit = f" of {float(part['rmse_limit']):.4f}" if np.isfinite(part["rmse_limit"]) else ""
        agreement = f"RMSE {float(part['rmse']):.4f}{limit}, scale {float(part['scale']):.3f}"
        label = f"reference ({spectra.attrs['instrument']}): {agreement}"
        _draw_side(axes, spectra, "reference", label, *_REFERENCES[number % len(_REFERENCES)])
    names = [
        str(signature.attrs["signature"]),
        *(str(validation.spectra[pair].attrs["reference"]) for pair in pairs),
    ]
    title = label_for(" / ".join(dict.fromkeys(names)), longest=34)
    fails = not all(bool(validation.statistics["passes"].isel(pair=pair).all()) for pair in pairs)
    style = {"color": _FAILED, "fontweight": "bold"} if fails else {}
    axes.set_title(f"FAIL  {title}" if fails else title, fontsize="small", loc="left", **style)
    if fails:
        axes.spines[:].set(color=_FAILED, linewidth=2.0)
    axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
    axes.tick_params(labelsize="small")


def _draw_side(axes: Any, spectra: xr.Dataset, name: str, label: str, colour: str, dashes: Any) -> None:
    nm, values = _values_on_wavelengths(spectra, spectra[name])
    axes.plot(nm, values, color=colour, ls=dashes, lw=1.5, label=label_for(label, longest=120))
    if f"{name}_sd" in spectra:
        _, sd = _values_on_wavelengths(spectra, spectra[f"{name}_sd"])
        axes.fill_between(nm, values - sd, values + sd, color=colour, alpha=0.2, lw=0)


def _largest_part(validation: Validation, pair: int) -> xr.Dataset:
    statistics = validation.statistics.isel(pair=pair)
    return statistics.isel(part=int(statistics["bands"].values.argmax()))


def _values_on_wavelengths(spectra: xr.Dataset, array: xr.DataArray) -> tuple[Any, Any]:
    # sorted wavelengths [nm], and values; NaN in bands not compared
    order = np.argsort(spectra["wavelength"].values, kind="stable")
    return spectra["wavelength"].values[order], np.where(spectra["used"].values, array.values, np.nan)[order]


# --- ratio of measured to expected panel reflectance, band by band -----------------------------------------


MAX_PANELS = 12  # panels drawn in a figure, in order of time
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
    >>> from hyperpaint.radiometry.pixel_reading import worked_example
    >>> whole = hp.Panel(slice(None), slice(None), 0.4)
    >>> closure = hp.radiometry.panel_closure(worked_example(), whole)
    >>> figure = panel_figure(closure, "panels.png")                              # doctest: +SKIP
    >>> len(panel_figure(closure).axes[0].lines)  # one panel, and the line at 1
    2
    """
    SchemaError.raise_if(
        not set(CLOSURE) <= set(closure.variables),
        "the dataset has no panels: variable 'panel_factor' is missing",
        mend="see hyperpaint.radiometry.panel_closure, or scale by reflectance(panel=)",
        code="variable-missing",
    )
    figure = new_figure("a picture of panels", figsize=(width, 0.45 * width), layout="constrained")
    draw_panels(figure.add_subplot(), closure)
    return save_figure(figure, path)


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
    # Draw the factors over wavelength on axes; bad bands stay blank
    values = closure[list(CLOSURE)].isel({schema.PANEL: slice(MAX_PANELS)}).compute()
    nm, is_good = closure["wavelength"].values, good_bands(closure)
    order = np.argsort(nm, kind="stable")
    axes.axhline(1.0, color=ink_of(axes, 0.7), linewidth=0.8)
    for number in range(values.sizes[schema.PANEL]):
        panel = values.isel({schema.PANEL: number})
        factor, u = (np.where(is_good, panel[name].values, np.nan)[order] for name in CLOSURE[:2])
        colour = COLOURS[number % len(COLOURS)]
        time = np.datetime_as_string(panel["panel_time"].values, "s")
        label = f"panel {number}, {time}: {state_text(int(panel['panel_state']))}"
        dashes = _DASHES[number // len(COLOURS) % len(_DASHES)]
        axes.plot(nm[order], factor, dashes, color=colour, linewidth=1.4, label=label)
        axes.fill_between(nm[order], factor - 2.0 * u, factor + 2.0 * u, color=colour, alpha=0.12, lw=0)
    axes.set(xlabel="wavelength [nm]", ylabel="measured / expected reflectance [1]")
    legend_below(axes)
