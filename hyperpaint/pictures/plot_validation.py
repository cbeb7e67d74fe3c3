"""Signatures over their references, and what is between them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hyperpaint.base.errors import SchemaError

from .figures import label_for, new_figure, save_figure

if TYPE_CHECKING:
    import xarray as xr

    from hyperpaint.validation import Validation

__all__ = ["MOST_PAIRS", "validation_figure"]

MOST_PAIRS = 24
"""Pairs of one figure at the most."""

_PANEL = (4.3, 3.3)  # [inch]
_SIGNATURE, _REFERENCE, _DIFFERENCE = "#0072B2", "#D55E00", "#222222"
_LEAST_SPAN = 0.005  # of the axis of differences


def validation_figure(
    validation: Validation, path: str | Path | None = None, *, columns: int = 3, limit: float | None = None
) -> Any:
    """Draw every signature over its reference, with their spread, and the difference below.

    Parameters
    ----------
    validation
        As of `hyperpaint.validate`.
    path
        Where to write a picture (PNG, PDF, ...); nowhere by default.
    columns
        Pairs side by side.
    limit
        Half range of all axes of differences [1]; by default that of the largest, or the tolerance of RMSE.

    Returns
    -------
    matplotlib.figure.Figure
        Of at most 24 pairs, the worst first where there are more; its title says so. Shades are a standard
        deviation of pixels or readings; of the difference, its standard uncertainty. Bands that were not
        compared are left blank.

    Raises
    ------
    MissingExtraError
        matplotlib is not installed.
    SchemaError
        ``columns`` or ``limit`` is not positive, or matplotlib writes no such picture.
    """
    if columns < 1 or (limit is not None and not limit > 0.0):
        raise SchemaError(f"columns={columns}, limit={limit}: expected positive numbers")
    shown = _chosen(validation)
    columns = min(columns, len(shown))
    rows = -(-len(shown) // columns)
    size = (_PANEL[0] * columns, _PANEL[1] * rows + 0.5)
    figure = new_figure("a picture of a validation", figsize=size, layout="constrained")
    grid = figure.add_gridspec(2 * rows, columns, height_ratios=[2.4, 1.0] * rows)
    limit = limit or _half_range(validation, shown)
    for place, pair in enumerate(shown):
        row, column = divmod(place, columns)
        upper = figure.add_subplot(grid[2 * row, column])
        lower = figure.add_subplot(grid[2 * row + 1, column], sharex=upper)
        _draw_spectra(upper, validation, pair)
        _draw_difference(lower, validation, pair, limit, labelled=column == 0)
        upper.tick_params(labelbottom=False)
        if column == 0:
            upper.set_ylabel("reflectance factor", fontsize="small")
        if place + columns >= len(shown):
            lower.set_xlabel("wavelength [nm]", fontsize="small")
    count = len(validation.spectra)
    cut = f", the {len(shown)} worst of {count} shown" if count > len(shown) else ""
    figure.suptitle(label_for(validation.verdict, longest=120) + cut, fontsize="medium")
    save_figure(figure, path)
    return figure


def _chosen(validation: Validation) -> list[int]:
    """Return the pairs that are drawn: all, or those of the largest RMSE."""
    count = len(validation.spectra)
    if count <= MOST_PAIRS:
        return list(range(count))
    worst = validation.statistics["rmse"].max("part").values
    return [int(pair) for pair in np.argsort(-np.nan_to_num(worst), kind="stable")[:MOST_PAIRS]]


def _half_range(validation: Validation, shown: list[int]) -> float:
    largest = [float(np.abs(validation.spectra[pair]["difference"]).max()) for pair in shown]
    tolerance = validation.tolerance.get("rmse", 0.0)
    return 1.15 * max(_LEAST_SPAN, tolerance, *(each for each in largest if np.isfinite(each)))


def _draw_spectra(axes: Any, validation: Validation, pair: int) -> None:
    spectra = validation.spectra[pair]
    for name, colour, dash in (("signature", _SIGNATURE, "-"), ("reference", _REFERENCE, "--")):
        at, values = _whole(spectra, spectra[name])
        legend = "signature" if name == "signature" else f"reference ({spectra.attrs['instrument']})"
        axes.plot(at, values, color=colour, ls=dash, lw=1.5, label=label_for(legend))
        if f"{name}_sd" in spectra:
            _, sd = _whole(spectra, spectra[f"{name}_sd"])
            axes.fill_between(at, values - sd, values + sd, color=colour, alpha=0.2, lw=0)
    names = [str(spectra.attrs[key]) for key in ("paint", "reference")]
    title = names[0] if names[0] == names[1] else f"{names[0]} / {names[1]}"
    axes.set_title(label_for(title), fontsize="small", loc="left")
    axes.set_title(_figures_of(validation, pair), fontsize="x-small", loc="right", color="0.35")
    axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
    axes.tick_params(labelsize="small")
    axes.legend(fontsize="x-small", frameon=False)


def _figures_of(validation: Validation, pair: int) -> str:
    """Return RMSE and scale over the part with most bands."""
    one = validation.statistics.isel(pair=pair)
    whole = one.isel(part=int(one["bands"].values.argmax()))
    return f"RMSE {float(whole['rmse']):.4f}, scale {float(whole['scale']):.3f}"


def _draw_difference(axes: Any, validation: Validation, pair: int, limit: float, *, labelled: bool) -> None:
    spectra = validation.spectra[pair]
    at, values = _whole(spectra, spectra["difference"])
    axes.axhline(0.0, color="0.7", lw=0.8)
    if "rmse" in validation.tolerance:
        edge = validation.tolerance["rmse"]
        axes.axhspan(-edge, edge, color="#009E73", alpha=0.08, lw=0)
    axes.plot(at, values, color=_DIFFERENCE, lw=1.0)
    uncertainties = [
        _whole(spectra, spectra[name])[1] for name in ("signature_u", "reference_u") if name in spectra
    ]
    if uncertainties:
        u = np.sqrt(sum(each**2 for each in uncertainties))
        axes.fill_between(at, values - u, values + u, color=_DIFFERENCE, alpha=0.2, lw=0)
    axes.set_ylim(-limit, limit)
    axes.tick_params(labelsize="small")
    if labelled:
        axes.set_ylabel("difference", fontsize="small")


def _whole(spectra: xr.Dataset, array: xr.DataArray) -> tuple[Any, Any]:
    """Return wavelengths in their order [nm], and values, NaN in bands that were not compared."""
    order = np.argsort(spectra["wavelength"].values, kind="stable")
    values = np.where(spectra["used"].values, array.values, np.nan)
    return spectra["wavelength"].values[order], values[order]
