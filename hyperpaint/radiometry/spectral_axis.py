"""Operations along the spectral axis: bands by wavelength, removal of smile, smoothing.

The paper smooths with a box. It is available, but not the default: it shifts a red edge much more than a
Savitzky-Golay filter of the same width (see docs/figures.md).
"""

import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from hyperpaint.base import (
    BAND,
    CROSS_TRACK,
    CUBE,
    VARIABLES,
    Array,
    ArrayLike,
    Problems,
    SchemaError,
    convert,
    has_own_means,
    label,
    one_of,
    rename_to_roles,
    require,
    stamp_means,
    takes_quantities,
    warn_of_lost_calibration,
)
from hyperpaint.light.responses import band_spacing, spectral_parts

from .slabs import line_chunked

METHODS = ("savitzky-golay", "box")


class NominalAxis(NamedTuple):
    # Interpolation of columns to nominal wavelengths.
    first: Array  #: (band, column) int64: first of the four bands that a band is interpolated from
    weights: (
        Array  #: (band, column, tap): weights of the four bands; NaN where a column does not cover the band
    )


@takes_quantities(wavelength="nm")
def at(dataset: xr.Dataset, wavelength: ArrayLike) -> xr.Dataset:
    """Return the bands nearest to one or several wavelengths.

    Also for axes that are not sorted, as at detector joins, where an index fails.

    Parameters
    ----------
    dataset
        Has a coordinate ``wavelength`` (band) [nm].
    wavelength
        A number, which drops the dim ``band``, or several [nm].

    Raises
    ------
    SchemaError
        A wavelength lies more than one band spacing outside the bands.

    Examples
    --------
    >>> import xarray as xr
    >>> cube = xr.Dataset(coords={"wavelength": ("band", [550.0, 552.0, 551.0], {"units": "nm"})})
    >>> float(at(cube, 551.2).wavelength)
    551.0
    """
    dataset = rename_to_roles(dataset)
    selected = dataset.isel({BAND: bands_at(dataset, wavelength)})
    if "coarse_reflectance" in dataset.variables and has_own_means(dataset):
        stamp_means(selected["coarse_reflectance"], selected)  # of the same bands
    return selected


def bands_at(dataset: xr.Dataset, wavelength: ArrayLike) -> Any:
    # Return the index of the band nearest to a wavelength [nm], or of the bands nearest to several.
    #
    # Raises `SchemaError`: As `at`.
    centres = require(dataset, ["wavelength"], "the bands at a wavelength")["wavelength"].values
    is_list = np.ndim(wavelength) < 2 and not isinstance(wavelength, slice)
    SchemaError.raise_if(
        not is_list or np.size(wavelength) == 0,
        f"wavelength={wavelength!r:.60}",
        expected="a number, or a list of numbers [nm]",
        mend="for a range: line.isel(band=(line.wavelength > 500) & (line.wavelength < 600))",
        code="selection-empty" if is_list else "type-wrong",
    )
    targets = np.asarray(wavelength, np.float64)
    nearest = np.abs(centres - targets[..., None]).argmin(axis=-1)
    distances = np.abs(centres[nearest] - targets)
    ordered = np.sort(centres)
    spacing = max(float(band_spacing(ordered[part]).max()) for part in spectral_parts(ordered))
    SchemaError.raise_if(
        (distances > spacing).any() or not np.isfinite(targets).all(),
        f"no band at {targets.flat[distances.argmax()]:g} nm",
        expected=f"{centres.min():g} to {centres.max():g} nm",
        code="band-missing",
    )
    return nearest.item() if nearest.ndim == 0 else nearest


def to_nominal(dataset: xr.Dataset) -> xr.Dataset:
    """Return spectra interpolated to the nominal wavelengths: the smile is removed.

    Lazy: one task a slab of lines; only the wavelengths and their shifts are read.

    Parameters
    ----------
    dataset
        ``radiance`` or ``reflectance`` with ``wavelength`` (band) and ``wavelength_shift`` (cross_track) or
        (band, cross_track) [nm].

    Returns
    -------
    Dataset
        ``radiance``, ``reflectance`` and variables without bands; counts and calibration, which hold for the
        columns' own wavelengths, are left out, and so is ``wavelength_shift``.

    Raises
    ------
    SchemaError
        There is no radiance or reflectance, or no wavelength; every problem is listed.

    Notes
    -----
    Cubic (Lagrange) over the four nearest bands of the same part of the axis: a join, an overlap of detectors
    or a gap separates parts, as in `smooth`. Nothing is extrapolated: the outermost bands of a part are NaN
    in columns that do not cover the nominal wavelength, and so is a value if one of its bands is missing.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> nm = np.array([540.0, 545.0, 550.0, 555.0, 560.0])
    >>> shift = np.array([0.0, 1.0])  # the second column is 1 nm towards the red
    >>> seen = (nm[:, None] + shift)[None] / 1000.0
    >>> line = xr.Dataset(
    ...     {"reflectance": (("along_track", "band", "cross_track"), seen.astype("float32"), {"units": "1"})},
    ...     {"wavelength": ("band", nm, {"units": "nm"}),
    ...      "wavelength_shift": ("cross_track", shift, {"units": "nm"})})
    >>> to_nominal(line).reflectance[0, 2].values.round(4)
    array([0.55, 0.55], dtype=float32)
    """
    dataset = rename_to_roles(dataset)
    products = [name for name in ("radiance", "reflectance") if name in dataset.variables]
    SchemaError.raise_if(
        not products,
        "the dataset has neither 'radiance' nor 'reflectance'",
        mend="compute one before to_nominal",
        code="variable-missing",
    )
    if "wavelength_shift" not in dataset.variables:
        warn_of_lost_calibration(dataset, "the spectrum at nominal wavelengths")
        return dataset[[*products, *_without_bands(dataset)]]
    arrays = require(dataset, products, "nominal wavelengths")
    first, weights = nominal_axis(dataset)
    nominal = dataset[_without_bands(dataset)].drop_vars("wavelength_shift", errors="ignore")
    for name in products:
        resampled = xr.apply_ufunc(
            _resample,
            line_chunked(arrays[name]),
            kwargs={"first": first, "weights": weights},
            input_core_dims=[[BAND, CROSS_TRACK]],
            output_core_dims=[[BAND, CROSS_TRACK]],
            dask="parallelized",
            output_dtypes=[np.float32],
        ).drop_vars("wavelength_shift", errors="ignore")
        nominal[name] = label(resampled, name, spectral_axis="nominal wavelengths")
    return nominal


def nominal_axis(dataset: xr.Dataset) -> NominalAxis:
    # Return the interpolation of a line's columns to nominal wavelengths; reads wavelengths and shifts.
    #
    # Raises `SchemaError`: ``wavelength`` or ``wavelength_shift`` is missing, or not in order.
    arrays = require(dataset, ["wavelength", "wavelength_shift"], "nominal wavelengths")
    return NominalAxis(
        *lagrange_weights(arrays["wavelength"].values, np.atleast_2d(arrays["wavelength_shift"].values))
    )


def _without_bands(dataset: xr.Dataset) -> list[str]:
    return [str(name) for name, array in dataset.data_vars.items() if BAND not in array.dims]


def _resample(values: Array, *, first: Array, weights: Array) -> Array:
    from hyperpaint.kernels.radiometry import resample_slab

    out = np.empty(values.shape, np.float32)
    resample_slab(np.ascontiguousarray(values, np.float32), first, weights, out)
    return out


def lagrange_weights(wavelength: Array, shift: Array) -> tuple[Array, Array]:
    # Return the first of four bands and their weights, (band, column[, 4]).
    bands, columns = wavelength.size, shift.shape[1]
    SchemaError.raise_if(
        bands < 4, f"{bands} bands to interpolate between", expected="4 or more", code="bands-too-few"
    )
    axis = wavelength[:, None] + np.broadcast_to(shift, (bands, columns))
    first = np.empty((bands, columns), np.int64)
    weights = np.zeros((bands, columns, 4))
    for part in ordered_parts(wavelength):
        # descending wavelengths increase with the other sign; the weights do not depend on it
        sign = -1.0 if wavelength[part][0] > wavelength[part][-1] else 1.0
        part_axis, nominal = sign * axis[part], sign * wavelength[part]
        SchemaError.raise_if(
            not (np.diff(part_axis, axis=0) > 0).all(),
            "wavelengths are not in order in every column",
            mend="correct wavelength_shift",
            code="wavelength-unordered",
        )
        taps = min(4, nominal.size)
        for column, nodes in enumerate(part_axis.T):
            start = np.clip(np.searchsorted(nodes, nominal, side="right") - 2, 0, nominal.size - taps)
            tap_nodes = nodes[start[:, None] + np.arange(taps)]
            first[part, column] = np.minimum(part.start + start, bands - 4)
            # a short part at the end has its bands among the last of four
            skipped = part.start + start - first[part, column]
            for k in range(taps):
                other_taps = [j for j in range(taps) if j != k]
                weights[np.arange(part.start, part.stop), column, skipped + k] = np.prod(
                    (nominal[:, None] - tap_nodes[:, other_taps])
                    / (tap_nodes[:, [k]] - tap_nodes[:, other_taps]),
                    axis=1,
                )
            weights[part, column][(nominal < nodes[0]) | (nominal > nodes[-1])] = np.nan
    return np.ascontiguousarray(first), np.ascontiguousarray(weights, np.float32)


def ordered_parts(wavelength: Array) -> list[slice]:
    # Return the parts of an axis between joins, overlaps and gaps; raises SchemaError for bands in no order.
    steps = np.diff(wavelength)
    reversals = int(min((steps <= 0).sum(), (steps >= 0).sum()))
    SchemaError.raise_if(
        reversals > max(4, wavelength.size // 20),
        f"wavelengths run back in {reversals} places",
        expected="bands in the order of their wavelengths",
        mend="sort them: .sortby('wavelength')",
        code="wavelength-unordered",
    )
    return spectral_parts(wavelength)


@takes_quantities()
def smooth(
    dataset: xr.Dataset, method: str = "savitzky-golay", window: int = 11, *, order: int = 2
) -> xr.Dataset:
    """Smooth ``reflectance`` over the bands.

    Lazy: one task a slab of lines.

    Parameters
    ----------
    dataset
        Holds ``reflectance`` with a dim ``band``.
    method
        ``"savitzky-golay"``: the least-squares polynomial of each window; ``"box"``: its mean.
    window
        Number of bands, odd. At the ends the window keeps its width for the polynomial, and is cut for the
        box.
    order
        Degree of the polynomial.

    Returns
    -------
    Dataset
        The dataset with ``reflectance`` replaced, float32 [1], and its attribute ``smoothing`` set; without
        ``reflectance_u_random``, which is not valid for filtered noise.

    Raises
    ------
    SchemaError
        There is no reflectance, or the window does not fit; every problem is listed.

    Notes
    -----
    No window reaches over a detector join, an overlap of detectors or a gap: where wavelengths run back, or
    step by more than four times their neighbours. A missing band stays missing, and changes only the bands
    whose window contains it. Bands that are not ``good`` are left unchanged, and out of their neighbours'
    windows. Quality flags are left unchanged.

    References
    ----------
    .. [1] A. Savitzky, M. J. E. Golay, Anal. Chem. 36, 1627-1639 (1964). doi:10.1021/ac60214a047

    Examples
    --------
    >>> import xarray as xr
    >>> step = xr.Dataset({"reflectance": ("band", np.float32([0, 0, 0, 1, 1, 1]), {"units": "1"})})
    >>> print(smooth(step, "box", 3).reflectance.values.round(2))
    [0.   0.   0.33 0.67 1.   1.  ]
    """
    if BAND not in dataset.dims:
        dataset = rename_to_roles(dataset)
    with Problems("cannot smooth", SchemaError) as problems:
        sizes = dict(dataset["reflectance"].sizes) if "reflectance" in dataset else {BAND: window}
        bands, orders = sizes.get(BAND, window), f"0 to {window - 2} for a window of {window}"
        problems.add_if(
            "reflectance" not in dataset.variables,
            "'reflectance' is missing",
            mend="call .paint.reflectance() first",
            code="variable-missing",
        )
        one_of(method, METHODS, "method", problems=problems)
        for is_valid, found, expected, code in (
            (
                window >= 3 and window % 2 == 1,
                f"window {window}",
                "an odd number of bands, 3 or more",
                "value-out-of-range",
            ),
            (BAND in sizes, f"'reflectance' has dims {tuple(sizes)}", "a dim 'band'", "dim-missing"),
            (window <= bands, f"window {window} is wider than the {bands} bands", "", "value-out-of-range"),
            (method == "box" or 0 <= order < window - 1, f"order {order}", orders, "value-out-of-range"),
        ):
            problems.add_if(not is_valid, found, expected=expected, code=code)
    array = convert(dataset["reflectance"], "1")
    is_cube = set(CUBE) == set(array.dims)
    source = line_chunked(array) if is_cube else array
    core = [BAND, CROSS_TRACK] if is_cube else [BAND]
    axis = (
        dataset["wavelength"]
        if "wavelength" in dataset.variables and dataset["wavelength"].dims == (BAND,)
        else xr.DataArray(np.arange(float(bands)), dims=BAND)
    )
    inputs = (
        source,
        dataset.get("good", xr.DataArray(np.ones(bands, bool), dims=BAND)).reset_coords(drop=True),
        axis.reset_coords(drop=True),
    )
    filtered = xr.apply_ufunc(
        _filter,
        *[each.chunk({BAND: -1}) if each.chunks else each for each in inputs],
        kwargs={"is_cube": is_cube, "method": method, "window": window, "order": order},
        input_core_dims=[core, [BAND], [BAND]],
        output_core_dims=[core],
        dask="parallelized",
        output_dtypes=[np.float32],
        keep_attrs=True,
    ).transpose(*array.dims)
    text = f"box, {window} bands" if method == "box" else f"Savitzky-Golay, {window} bands, order {order}"
    attrs = {**array.attrs, **VARIABLES["reflectance"].attrs, "smoothing": text}
    if "unc_comps" in attrs:
        # filtered noise is smaller, and correlated from band to band
        attrs["unc_comps"] = [name for name in attrs["unc_comps"] if name != "reflectance_u_random"]
        dataset = dataset.drop_vars("reflectance_u_random", errors="ignore")
    return dataset.assign(reflectance=filtered.assign_attrs(attrs))


def smoothing_matrix(good: Array, options: Mapping[str, Any]) -> Array:
    # Return the matrix of `smooth` for spectra without gaps (band, band), for its ``options``.
    single = xr.DataArray(np.eye(good.size, dtype=np.float32), dims=("of", BAND), attrs={"units": "1"})
    filtered = smooth(xr.Dataset({"reflectance": single, "good": (BAND, good)}), **options)
    return np.asarray(filtered["reflectance"].values.T)


def _filter(
    values: Array, good: Array, wavelength: Array, *, is_cube: bool, method: str, window: int, order: int
) -> Array:
    from hyperpaint.kernels.radiometry import average_slab, filter_slab

    parts = ordered_parts(wavelength)
    spectra = values.astype(np.float32, copy=False)
    # the kernels take cubes: without a cross-track dim, each spectrum becomes a line of one column
    if not is_cube:
        spectra = spectra.reshape(-1, values.shape[-1], 1)
    out = spectra.copy()
    usable = spectra if good.all() else np.where(good[:, None], spectra, np.float32(np.nan))
    for part in parts:
        # no window reaches over a detector join; it shrinks to a short part
        size = part.stop - part.start
        width = min(window, size - 1 + size % 2)
        if width < 3 or (method != "box" and order >= width - 1):
            continue
        piece = np.ascontiguousarray(usable[:, part])
        filtered = np.empty(piece.shape, np.float32)
        if method == "box":
            average_slab(piece, width, filtered)
        else:
            first, weights, fallback = window_polynomials(width, order, size)
            filter_slab(piece, weights, first, fallback, filtered)
        out[:, part] = filtered
    out[:, ~good] = spectra[:, ~good]
    return out.reshape(values.shape)


@functools.cache
def window_polynomials(window: int, order: int, bands: int) -> tuple[Array, Array, Array]:
    # Return the first band of each band's window (band,) int64, the weights of its values (band, width)
    # float32, and (band, width, width) float32, whose row k has the weights without the k-th value.
    first = np.clip(np.arange(bands) - window // 2, 0, bands - window)
    centres = np.arange(bands) - first
    position = np.arange(window)
    complete_weights = np.stack([_polynomial_weights(position - centre, order) for centre in position])
    gap_weights = np.zeros((window, window, window))
    for centre in position:
        for gap in position:
            is_used = position != gap
            gap_weights[centre, gap, is_used] = _polynomial_weights(position[is_used] - centre, order)
    return first, complete_weights[centres].astype(np.float32), gap_weights[centres].astype(np.float32)


def _polynomial_weights(distance: Array, order: int) -> Array:
    # Return the weights of values at `distance` in their least-squares polynomial at 0.
    return np.asarray(np.linalg.pinv(np.vander(distance.astype(np.float64), order + 1, increasing=True))[0])
