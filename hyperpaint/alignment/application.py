"""Apply wavelengths and widths measured in flight to a flight line."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import xarray as xr

from hyperpaint.base import schema
from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.schema import BAND, CROSS_TRACK

#: Variables of an alignment that are used.
_VARIABLES = (
    "flag",
    "shift_correction",
    "wavelength_shift_u",
    "fwhm_factor",
    "fwhm_u",
    "column",
    "window_centre",
)
_WINDOW = "window"


def apply_alignment(
    line: xr.Dataset, alignment: xr.Dataset, *, degree: int = 2, fwhm: bool = True
) -> xr.Dataset:
    """Return the line with wavelengths and widths from `hyperpaint.alignment.align_to_irradiance`.

    Parameters
    ----------
    line
        The flight line that was measured.
    alignment
        Result of `hyperpaint.alignment.align_to_irradiance`, whole or in groups of columns; flagged columns
        are not used.
    degree
        Degree of the polynomial over columns that smooths the shift.
    fwhm
        Whether widths are replaced too.

    Returns
    -------
    Dataset
        The line with ``wavelength_shift`` (cross_track), or (band, cross_track) with several windows or where
        the line has these dims, float64 [nm]; ``fwhm`` (band), float64 [nm], times the mean factor, since the
        table has no width of a column. Between windows both are linear in wavelength, beyond them constant.
        The attribute ``alignment`` describes the correction; attributes of an earlier comparison
        (``alignment_shift`` ..., see `align`), and reflectance, which belongs to other wavelengths, are
        removed. ``wavelength`` is unchanged, so that flight lines keep one axis: the shift at the centre
        column need not be zero.

    Raises
    ------
    SchemaError
        ``line`` or ``alignment`` lacks variables or dims, the alignment belongs to another line, or too few
        columns are reliable. All problems of a kind are listed.

    Notes
    -----
    Columns are weighted by the inverse of their variance, and less the farther they lie from the curve
    (Huber's weights, at 1.5 times the scatter), so that a column with a bad element does not change its
    neighbours.

    Examples
    --------
    >>> from hyperpaint.alignment import align_to_irradiance
    >>> from hyperpaint.simulation import simulate_line
    >>> line = simulate_line(lines=16, bands=272, columns=3, smile_nm=0.0)
    >>> moved = line.assign_coords(wavelength=line.wavelength - 0.4)
    >>> mended = apply_alignment(moved, align_to_irradiance(moved), degree=1)
    >>> bool((abs(mended.wavelength_shift - 0.4) < 0.1).all())
    True
    """
    dataset = schema.rename_to_roles(line)
    declared = schema.require(
        dataset,
        ["wavelength", "fwhm", *(n for n in ("wavelength_shift",) if n in dataset.variables)],
        "the alignment",
    )
    SchemaError.raise_if(
        CROSS_TRACK not in dataset.dims,
        f"the line has dims {', '.join(map(str, dataset.dims))}",
        expected=f"a dim {CROSS_TRACK!r}",
        code="dim-missing",
    )
    columns = dataset.sizes[CROSS_TRACK]
    windows = _with_windows(alignment)
    is_reliable = windows["flag"].values == 0
    problems = Problems("the alignment cannot be applied", SchemaError)
    if windows.sizes[BAND] != dataset.sizes[BAND] or not -0.5 < float(windows["column"].max()) <= columns - 1:
        problems.add("it belongs to a line with other bands or columns", code="grid-mismatch")
    problems.add_if(degree < 0, f"degree={degree}", expected="0 or more", code="value-out-of-range")
    for centre, number in zip(np.ravel(windows["window_centre"]), is_reliable.sum(axis=1), strict=True):
        problems.add_if(
            number < degree + 1,
            f"{number} of {is_reliable.shape[1]} columns are reliable at {centre:.0f} nm",
            expected=f"at least {degree + 1} for a polynomial of degree {degree}",
            mend="see 'flag', or average groups of columns",
            code="columns-too-few",
        )
    problems.raise_if_any()
    # correction of the shift (window, column) [nm], and mean width factor (window,)
    smoothed = [
        _smoothed(windows.isel(window=w, **{CROSS_TRACK: is_reliable[w]}), columns, degree)
        for w in range(len(is_reliable))
    ]
    correction, factor = (np.array(values) for values in zip(*smoothed, strict=True))
    centres, wavelength = np.atleast_1d(windows["window_centre"].values), declared["wavelength"].values
    order = np.argsort(centres)

    def over_bands(values: Floats) -> Floats:
        return np.asarray(np.interp(wavelength, centres[order], values[order]))

    shift = (
        xr.DataArray(correction[0], dims=CROSS_TRACK)
        if len(order) == 1
        else xr.DataArray(np.apply_along_axis(over_bands, 0, correction), dims=(BAND, CROSS_TRACK))
    )
    if "wavelength_shift" in declared:
        shift = shift + xr.DataArray(
            declared["wavelength_shift"].values, dims=declared["wavelength_shift"].dims
        )
    order_of_dims = [dim for dim in (BAND, CROSS_TRACK) if dim in shift.dims]
    aligned = without_products(dataset).assign_coords(
        wavelength_shift=schema.label(shift.transpose(*order_of_dims), "wavelength_shift")
    )
    sentence = (
        f"wavelength_shift corrected in flight against the irradiance record at {windows.attrs[_WINDOW]}, "
        f"mean {correction.mean():+.3f} nm"
    )
    if fwhm:
        width = xr.DataArray(declared["fwhm"].values * over_bands(factor), dims=BAND)
        aligned = aligned.assign_coords(fwhm=schema.label(width, "fwhm"))
        sentence += f"; fwhm times {', '.join(f'{value:.4f}' for value in factor)}"
    return restated(aligned, sentence)


def _with_windows(alignment: xr.Dataset) -> xr.Dataset:
    # Return the alignment with a leading dim of windows; SchemaError for another dataset.
    problems = Problems("this dataset is not a result of align_to_irradiance", SchemaError)
    for kind, names, present, code in (
        ("", _VARIABLES, alignment.variables, "variable-missing"),
        ("dim ", (BAND, CROSS_TRACK), alignment.dims, "dim-missing"),
    ):
        for name in (name for name in names if name not in present):
            problems.add(f"{kind}{name!r} is missing", code=code)
    if _WINDOW not in alignment.attrs:
        problems.add(f"attribute {_WINDOW!r} is missing", code="attribute-missing")
    problems.raise_if_any()
    windows = alignment if _WINDOW in alignment.dims else alignment.expand_dims(_WINDOW)
    for name in _VARIABLES[:5]:
        if set(windows[name].dims) != {_WINDOW, CROSS_TRACK}:
            dims = ", ".join(map(str, alignment[name].dims)) or "no dim"
            problems.add(f"{name!r} is on {dims}", expected=CROSS_TRACK, code="dims-wrong")
    problems.raise_if_any()
    return windows.transpose(_WINDOW, ...)


def _smoothed(window: xr.Dataset, columns: int, degree: int) -> tuple[Floats, float]:
    # Return the correction of the shift (column,) [nm] and the mean width factor of a window.
    scale = max((columns - 1) / 2.0, 1.0)
    basis = np.polynomial.legendre.legvander(window["column"].values / scale - 1.0, degree)
    shift, spread = window["shift_correction"].values, np.maximum(window["wavelength_shift_u"].values, 1e-6)
    weight = 1.0 / spread
    for _ in range(20):
        coefficients = np.linalg.lstsq(basis * weight[:, None], shift * weight, rcond=None)[0]
        deviation = np.abs(shift - basis @ coefficients) / spread
        scatter = max(1.4826 * float(np.median(deviation)), 1e-3)
        # square roots: a weight multiplies the residual, which is then squared
        weight = np.sqrt(np.minimum(1.0, 1.5 * scatter / np.maximum(deviation, 1e-12))) / spread
    basis_of_columns = np.polynomial.legendre.legvander(np.arange(columns) / scale - 1.0, degree)
    factor, inverse_variance = (
        window["fwhm_factor"].values,
        1.0 / np.maximum(window["fwhm_u"].values, 1e-6) ** 2,
    )
    is_inlier = np.abs(factor - np.median(factor)) <= 3.0 * 1.4826 * np.median(
        np.abs(factor - np.median(factor))
    )
    return basis_of_columns @ coefficients, float(
        (factor * inverse_variance)[is_inlier].sum() / inverse_variance[is_inlier].sum()
    )


def without_products(dataset: xr.Dataset) -> xr.Dataset:
    # Return a line without products that depend on wavelengths: reflectance and panel results.
    uncertainties = ("reflectance_u_random", "reflectance_u_systematic")
    names = ("reflectance", "coarse_reflectance", *uncertainties, "irradiance_misfit")
    return dataset.drop_vars(
        [name for name in dataset.variables if name in names or str(name).startswith("panel_")]
    )


def restated(
    line: xr.Dataset, sentence: str, *, numbers: Mapping[str, float] | None = None, state: str | None = None
) -> xr.Dataset:
    # Return a line whose attribute ``alignment`` ends with ``sentence``.
    #
    # ``numbers`` and ``state`` replace those of an earlier comparison.
    earlier = line.attrs.get("alignment")
    attrs = {name: value for name, value in line.attrs.items() if not str(name).startswith("alignment_")}
    attrs |= numbers or {}
    attrs["alignment"] = f"{earlier}; then {sentence}" if earlier else sentence
    if state is not None:
        attrs["alignment_state"] = state
    return line.drop_attrs(deep=False).assign_attrs(attrs)
