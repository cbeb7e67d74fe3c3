"""Pictures of a validation, and of panels: signatures and references, measured and expected reflectance."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from hyperpaint.base import schema
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.facts import documented
from hyperpaint.radiometry.panel_judging import PANEL_STATES
from hyperpaint.radiometry.panels import CLOSURE

from .figures import COLOURS, ink_of, label_for, legend_below, new_figure, save_figure
from .plot_spectra import good_bands

if TYPE_CHECKING:
    from hyperpaint.validation import Validation

MAX_PAIRS = 24  # of one figure

_AXES_INCH = (3.6, 3.9)
_SIGNATURE = "#3399DD"
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
        pixels or readings; for differences, the standard uncertainty. Bands not compared are blank.

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
    if columns < 1 or (limit is not None and not limit > 0.0):
        raise SchemaError(
            f"columns={columns}, limit={limit}", expected="positive numbers", code="value-out-of-range"
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
    axes.set_title(label_for(" / ".join(dict.fromkeys(names)), longest=34), fontsize="small", loc="left")
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
    >>> from hyperpaint.radiometry.example_pixel import worked_example
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
    axes.set(xlabel="wavelength [nm]", ylabel="panel: measured / expected reflectance [1]")
    legend_below(axes)
