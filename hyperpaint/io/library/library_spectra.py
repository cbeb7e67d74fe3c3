"""Spectra of one file, and the paint library made from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base.arrays import Floats, Floats32
from hyperpaint.base.errors import FormatError, warn_user
from hyperpaint.base.schema import BAND, LIBRARY_VARIABLES, SIGNATURE, quality_attrs

#: Wavelength range of spectral libraries [nm]: far ultraviolet to far infrared (USGS libraries end at 216
#: um). Visible wavelengths in nanometres, read as micrometres, are larger.
MIN_NM, MAX_NM = 100.0, 3e5

#: Message for options that replace data of a library of hyperpaint.
OWN_AXES = (
    "{} is a library of hyperpaint with its own axes and scale: leave wavelength=, fwhm= and scale= out"
)

#: Maximum median of reflectance as a fraction: a white panel has 1.
_MAX_MEDIAN = 1.1

_BRIGHT = 1.2
#: Maximum share of values above `_BRIGHT` in reflectance: noise in opaque bands of air has 0.05, the
#: brightest of the 2457 spectra of splib07 has 0.01, radiance of a lawn in uW cm-2 sr-1 nm-1 has 0.5.
_MAX_BRIGHT_SHARE = 0.1

#: Minimum of the largest value of a file; below it the scale is doubtful: black coats reach 0.02 to 0.05.
_MIN_BRIGHTEST = 0.01

#: Stored values that mark missing samples.
_MISSING_VALUES = (-999.0, -9999.0, -99999.0, -32768.0)

#: Minimum reflectance with noise [1]: lower values mark missing samples.
_MIN_REFLECTANCE = -0.5

#: Maximum of fill values: deleted points of USGS spectra are -1.23e34, and fractions of it in spectra
#: convolved to another spectrometer.
_MAX_FILL_VALUE = -1e20


@dataclass(frozen=True, eq=False)
class Spectra:
    # Spectra of one file with common wavelengths.
    source: str  # file name
    form: str  # name of the format
    names: Sequence[str]  # of the spectra, as in the file
    wavelength: Floats  # (band) [nm], in the order of the file
    reflectance: Floats32  # (signature, band) as a fraction; NaN for missing samples
    fwhm: Floats | None = None  # (band) [nm]; None if not in the file
    good: npt.NDArray[np.bool_] | None = None
    # Further variables (signature, band) by their names in `LIBRARY_VARIABLES`
    others: Mapping[str, Floats32] = field(default_factory=dict)
    # Further variables with one value per spectrum
    columns: Mapping[str, Sequence[Any] | npt.NDArray[Any]] = field(default_factory=dict)
    notes: Sequence[str] = ()  # inferred or doubtful properties


def library_of(spectra: Spectra) -> xr.Dataset:
    # Return spectra as a paint library.
    # Raises FormatError: Wavelengths are not finite or outside 100 nm to 300 um, or their number is not that
    # of the bands.
    check_wavelengths(spectra.wavelength, spectra.source)
    bands = spectra.reflectance.shape[1]
    for name, axis in (("wavelength", spectra.wavelength), ("fwhm", spectra.fwhm)):
        if axis is not None and axis.shape != (bands,):
            raise FormatError(
                f"{spectra.source}: {axis.size} values of {name} for {bands} bands",
                mend="pass one value per band",
                code="length-mismatch",
            )
    rows = LIBRARY_VARIABLES
    data = {"reflectance": spectra.reflectance, **spectra.others}
    variables = {name: ((SIGNATURE, BAND), values, dict(rows[name].attrs)) for name, values in data.items()}
    variables["reflectance"][2]["long_name"] = "Reflectance, as the library gives it"
    axes = {"wavelength": spectra.wavelength, "fwhm": spectra.fwhm, "good": spectra.good}
    coords: dict[str, Any] = {SIGNATURE: (SIGNATURE, text_column(spectra.names), rows[SIGNATURE].attrs)}
    coords |= {name: (BAND, values, rows[name].attrs) for name, values in axes.items() if values is not None}
    for name, column in spectra.columns.items():
        row_attrs = rows[name].attrs if name in rows else {"long_name": name.replace("_", " ").capitalize()}
        flags = quality_attrs() if name == "quality" else {}
        coords[name] = (SIGNATURE, np.asarray(column), {**row_attrs, **flags})
    attrs: dict[str, Any] = {"title": "Spectral library", "source": spectra.source, "format": spectra.form}
    if spectra.notes:
        attrs["notes"] = "; ".join(spectra.notes)
    return with_numbers_as_data(xr.Dataset(variables, coords=coords, attrs=attrs))


def with_numbers_as_data(library: xr.Dataset) -> xr.Dataset:
    # Return a library with counts, flags and angles as data variables, not coordinates.
    rows = LIBRARY_VARIABLES
    return library.reset_coords([str(n) for n in library.coords if n in rows and not rows[str(n)].coordinate])


def text_column(texts: Sequence[str]) -> npt.NDArray[np.object_]:
    # Return texts as an array of objects, as stores hold them.
    column = np.empty(len(texts), object)
    column[:] = list(texts)
    return column


def check_wavelengths(wavelength: Floats, source: str) -> None:
    # Check that there are wavelengths [nm], within the range and without duplicates.
    # Raises FormatError: There are none; they are not finite, outside 100 nm to 300 um, or duplicate.
    description = f"{wavelength.size} wavelengths, not all of them finite"
    if wavelength.size and np.isfinite(wavelength).all():
        low, high = float(wavelength.min()), float(wavelength.max())
        if low >= MIN_NM and high <= MAX_NM:
            values, counts = np.unique(wavelength, return_counts=True)
            if not (counts > 1).any():
                return
            raise FormatError(
                f"{source}: {int((counts > 1).sum())} wavelengths occur twice, such as "
                f"{values[counts > 1][0]:g} nm",
                expected="distinct wavelengths",
                mend="drop one of the two bands",
                code="wavelength-duplicate",
            )
        description = f"wavelengths from {low:g} to {high:g} nm"
        if low >= MIN_NM * 1e3 and high <= MAX_NM * 1e3:
            description += " (nanometres declared as micrometres?)"
    raise FormatError(
        f"{source}: {description}",
        expected=f"{MIN_NM:g} nm to {MAX_NM:g} nm",
        mend="check their units, or pass wavelength= [nm]",
        code="wavelength-range",
    )


def reflectances(
    stored: npt.NDArray[Any],
    source: str,
    *,
    file_scale: float | None,
    scale: float | None,
    ignore: Any = None,
    is_reflectance: bool = False,
) -> Floats32:
    """Return stored values as reflectance.

    file_scale, scale: Stored value of a reflectance of one, from the file and from the caller; that of the
        caller is preferred.
    ignore: Stored value of missing samples, besides the fill values of the USGS.
    is_reflectance: Whether values above 1 are accepted.
    Returns numpy.ndarray: float32; a fraction.
    Raises FormatError: The scale is unknown and the values are not fractions; or they do not fit float32.
    Warns PaintWarning: Values far below 0 were taken for missing; or the scale is doubtful.
    """
    with np.errstate(all="ignore"):  # signalling NaNs of a damaged file
        values = stored.astype(np.float64)
        is_fill = values < _MAX_FILL_VALUE
    if ignore is not None:
        # compared in the stored dtype: a float32 file holds the float32 nearest to the number in its header
        with np.errstate(over="ignore"):
            is_fill |= stored == (stored.dtype.type(ignore) if stored.dtype.kind == "f" else ignore)
    values[is_fill] = np.nan
    divisor = scale if scale is not None else file_scale
    with np.errstate(over="ignore"):
        far_below = np.isfinite(values) & (values < _MIN_REFLECTANCE * (divisor or 1.0))
        is_missing = np.isin(values, _MISSING_VALUES) | far_below
    if is_missing.any():
        count, example = int(is_missing.sum()), float(values[is_missing][0])
        msg = f"{source}: {count} value{'s'[: count - 1]} far below 0, such as {example:g}, taken for missing"
        warn_user(msg, "values-far-below-zero")
        values[is_missing] = np.nan
    if divisor is None:
        _judge_fractions(values, source, _MAX_BRIGHT_SHARE if not is_reflectance else 1.0)
    elif divisor != 1.0:
        values /= divisor
        finite = values[np.isfinite(values)]
        # the scale is doubtful if many values exceed `_BRIGHT`, or all are near 0
        if finite.any() and ((finite > _BRIGHT).mean() > _MAX_BRIGHT_SHARE or finite.max() < _MIN_BRIGHTEST):
            msg = f"{source}: reflectance up to {finite.max():.3g} with a scale of {divisor:g}; pass scale="
            warn_user(msg, "scale-doubtful")
    with np.errstate(over="ignore"):
        reflectance = values.astype(np.float32)
    if not np.isfinite(reflectance[np.isfinite(values)]).all() or np.isinf(values).any():
        largest = np.abs(values[~np.isnan(values)]).max()
        raise FormatError(
            f"{source}: values up to {largest:g}", expected="finite reflectance", code="not-finite"
        )
    return reflectance


def _judge_fractions(values: Floats, source: str, max_bright_share: float) -> None:
    # Raise if values without a scale are not fractions; warn if only few spectra are not
    finite = np.isfinite(values)
    magnitudes = np.abs(values[finite])
    advice = (
        "pass scale=100 for percent, 10000 for hundredths of a percent, or scale=1 if values are fractions"
    )
    if magnitudes.size and float(np.median(magnitudes)) > _MAX_MEDIAN:
        raise FormatError(
            f"{source}: values up to {magnitudes.max():g}, half of them above "
            f"{np.median(magnitudes):g}, and no scale (radiance or counts?)",
            expected="reflectance as a fraction",
            mend=advice,
            code="scale-missing",
        )
    with np.errstate(invalid="ignore"):
        is_bright = (np.abs(values) > _BRIGHT).sum(axis=1) > max_bright_share * np.maximum(
            finite.sum(axis=1), 1
        )
    if 2 * is_bright.sum() > len(values):
        raise FormatError(
            f"{source}: values up to {magnitudes.max():g}, more than a tenth above {_BRIGHT:g} (radiance?)",
            expected="reflectance as a fraction",
            mend=f"{advice} (for a text: quantity='reflectance')",
            code="scale-missing",
        )
    is_bright = is_bright | [
        bool(is_finite.any()) and float(np.median(spectrum[is_finite])) > _MAX_MEDIAN
        for spectrum, is_finite in zip(values, finite, strict=True)
    ]
    if is_bright.any():
        msg = (
            f"{source}: {is_bright.sum()} of {len(values)} spectra have many values above "
            f"{_MAX_MEDIAN:g}, up to {magnitudes.max():g}, and no scale; {advice}"
        )
        warn_user(msg, "scale-missing")
