"""Absolute anchors: one gain for every element, from optics, a known source or a vendor's coefficients."""

from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.constants import SATURATION_MARGIN_COUNTS
from hyperpaint.base.errors import Problems, SchemaError, warn_user
from hyperpaint.base.facts import convert, one_of, same_dimension, takes_quantities
from hyperpaint.base.schema import ALONG_TRACK, BAND, CROSS_TRACK, VARIABLES, Floats, label, require
from hyperpaint.light.responses import Responses, log_slope
from hyperpaint.radiometry.stray_light import linearity_of

from .detector import row_medians

_ELEMENT = (BAND, CROSS_TRACK)
#: Distance of nodes [nm]; between them, the mean of a spectrum over a band is linear in wavelength.
NODE_SPACING_NM = 0.25
#: Minimum share of a response inside the source's spectrum [1].
MIN_COVERAGE = 0.999
#: Relative difference of exposure times that are taken as equal [1].
SAME_EXPOSURE = 0.01


@takes_quantities(pixel_pitch="m", slit_width="m")
def etendue_from_optics(f_number: float, pixel_pitch: float, slit_width: float) -> float:
    r"""Return the etendue of a detector element from the image side [m2 sr].

    :math:`A\Omega = p\,w\,\pi / (4 N^2)`, without transmission, which belongs to the responsivity.

    Parameters
    ----------
    f_number
        f-number of the fore optics.
    pixel_pitch
        Pixel pitch along the slit [m].
    slit_width
        [m]

    Returns
    -------
    float

    Raises
    ------
    SchemaError
        A number is not positive, or lengths are not in metres.

    Examples
    --------
    From the pupil's side, the result is equal, with a focal length of 12 mm (pupil 4.8 mm, fields of 0.617
    and 1.667 mrad):

    >>> f"{etendue_from_optics(2.5, 7.4e-6, 20e-6):.4e}"
    '1.8598e-11'
    >>> f"{etendue_from_pupil(4.8e-3, 7.4e-6 / 12e-3, 20e-6 / 12e-3):.4e}"
    '1.8598e-11'
    """
    lengths = {"pixel_pitch": (pixel_pitch, 1e-2), "slit_width": (slit_width, 1e-2)}
    _check_lengths({**lengths, "f_number": (f_number, 1e3)})
    return float(pixel_pitch * slit_width * np.pi / (4.0 * f_number**2))


@takes_quantities(diameter="m", field_along_slit="rad", field_across_slit="rad")
def etendue_from_pupil(diameter: float, field_along_slit: float, field_across_slit: float) -> float:
    """Return the etendue of a detector element from the pupil's side [m2 sr].

    Parameters
    ----------
    diameter
        Diameter of the entrance pupil [m].
    field_along_slit, field_across_slit
        Instantaneous fields of view [rad]: pixel pitch and slit width over the focal length.

    Returns
    -------
    float

    Raises
    ------
    SchemaError
        A number is not positive, or not in metres and radians.

    Examples
    --------
    >>> etendue = etendue_from_pupil(4.8e-3, 7.4e-6 / 12e-3, 20e-6 / 12e-3)
    >>> f"{etendue:.4e}"
    '1.8598e-11'
    """
    fields = {"field_along_slit": (field_along_slit, 1.0), "field_across_slit": (field_across_slit, 1.0)}
    _check_lengths({"diameter": (diameter, 10.0), **fields})
    return float(np.pi / 4.0 * diameter**2 * field_along_slit * field_across_slit)


def _check_lengths(values: dict[str, tuple[float, float]]) -> None:
    # Refuse values that are not positive, or above their limit.
    problems = Problems("the etendue cannot be computed", SchemaError)
    for name, (value, high) in values.items():
        problems.add_if(
            not 0 < value < high,
            f"{name}={value!r}",
            expected=f"above 0 and below {high:g}, in metres and radians",
            code="value-out-of-range",
        )
    problems.raise_if_any()


@takes_quantities(reflectance="1")
def panel_radiance(irradiance: xr.DataArray, reflectance: float | xr.DataArray) -> xr.DataArray:
    """Return the spectral radiance of a level Lambertian panel [W m-2 sr-1 nm-1]: ``reflectance x E / pi``.

    Parameters
    ----------
    irradiance
        Irradiance on the panel, with units and a dim of wavelengths.
    reflectance
        Reflectance of the panel [1]; a spectrum is on the wavelengths of ``irradiance``.

    Returns
    -------
    xarray.DataArray

    Raises
    ------
    UnitsError
        ``irradiance`` has no units of irradiance.

    Examples
    --------
    >>> irradiance = xr.DataArray([1.0, 1.3], dims="wavelength", attrs={"units": "W m-2 nm-1"})
    >>> panel_radiance(irradiance, 0.5).values.round(4)
    array([0.1592, 0.2069])
    """
    radiance = convert(irradiance, VARIABLES["irradiance"].units, "irradiance") * reflectance / np.pi
    return label(radiance, "radiance")


@takes_quantities()
def anchor_to_radiance(
    calibration: xr.Dataset,
    frames: xr.Dataset,
    radiance: xr.DataArray,
    *,
    scale: str = "element",
    uncertainty: float = 0.02,
) -> xr.Dataset:
    """Return a calibration whose gain reproduces the radiance of a known source from its frames.

    Parameters
    ----------
    calibration
        Wavelengths, widths and line shape of the camera, from `hyperpaint.calibrate` or a store. A
        gain is needed only for ``scale="common"``.
    frames
        ``counts`` ([along_track,] band, cross_track), ``dark_counts`` (band, cross_track) at the same
        exposure and ``exposure_time`` of a sphere or panel that fills the field. A dark with another
        ``dark_exposure_time`` needs ``dark_rate`` in the calibration. A ``linearity`` that the
        calibration declares is applied to these counts as well.
    radiance
        Spectral radiance of the source with units, on one dim with a coordinate of that name or
        ``wavelength`` [nm].
    scale
        "element": every element gets its own factor, which includes flat field and responsivity. "common":
        one factor for all elements, the median, which keeps the relative gains of the sweep.
    uncertainty
        Relative standard uncertainty of the radiance.

    Returns
    -------
    xarray.Dataset
        With another ``radiance_gain``: ``L_b,x x exposure_time / (counts - dark)``, L the mean radiance over
        the element's response; NaN where the spectrum does not cover the response, or without signal.

    Raises
    ------
    SchemaError, UnitsError
        Variables are missing, or no element is covered; all problems are listed.

    Warns
    -----
    PaintWarning
        Some frames are saturated; those elements keep no gain.

    Examples
    --------
    >>> from hyperpaint.radiometry.pixel_reading import worked_example
    >>> line = worked_example()
    >>> frames = line[["counts", "dark_counts", "exposure_time"]]
    >>> nm = xr.DataArray([400.0, 700.0], dims="wavelength", attrs={"units": "nm"})
    >>> sphere = xr.DataArray([0.05, 0.05], {"wavelength": nm}, attrs={"units": "W m-2 sr-1 nm-1"})
    >>> anchored = anchor_to_radiance(line.drop_vars("counts"), frames, sphere)
    >>> rate = (frames.counts - frames.dark_counts) / frames.exposure_time
    >>> float((anchored.radiance_gain * rate).mean().round(6))
    0.05
    """
    one_of(scale, ("element", "common"), "scale")
    response_inputs = require(calibration, ["wavelength", "fwhm"], "an anchor")
    spectrum = convert(radiance, VARIABLES["radiance"].units, "radiance")
    level = _band_means(calibration, response_inputs, spectrum)
    signal, exposure = _anchor_signal(frames, calibration)
    first, last = calibration.attrs.get("lit_columns", (0, signal.shape[1] - 1))
    # the sweep gives no wavelengths for unlit columns
    signal[:, :first] = signal[:, last + 1 :] = np.nan
    with np.errstate(divide="ignore", invalid="ignore"):
        gain = np.where(signal > 0, level * exposure / signal, np.nan)
    if scale == "common":
        relative_gain = require(calibration, ["radiance_gain"], "a common scale")["radiance_gain"].to_numpy()
        gain = relative_gain * float(np.nanmedian(gain / relative_gain))
    SchemaError.raise_if(
        not np.isfinite(gain).any(),
        "no element has a signal and a response inside the source's spectrum",
        mend="check wavelengths and dark",
        code="source-coverage",
    )
    return _with_gain(
        calibration,
        gain,
        f"radiance of a known source, {scale} scale",
        uncertainty,
        same_shape=scale == "common",
    )


def _with_gain(
    calibration: xr.Dataset, gain: Floats, anchor: str, uncertainty: float, *, same_shape: bool = False
) -> xr.Dataset:
    is_good = np.isfinite(gain).mean(axis=1) > 0.5
    systematic = np.where(is_good, np.float32(uncertainty), np.float32(np.nan)).astype(np.float32)
    outdated = ["radiance_gain_u_systematic", "quantum_efficiency", "responsivity"]
    outdated += [] if same_shape else ["radiance_gain_u_random"]
    rescaled = calibration.drop_vars(outdated, errors="ignore")
    if {"responsivity", "radiance_gain"} <= set(calibration.variables):
        ratio = calibration["radiance_gain"].transpose(*_ELEMENT).astype(np.float64) / gain
        rescaled["responsivity"] = label(calibration["responsivity"] * ratio, "responsivity")
    rescaled = rescaled.assign(
        radiance_gain=label(xr.DataArray(gain.astype(np.float32), dims=_ELEMENT), "radiance_gain"),
        radiance_gain_u_systematic=label(xr.DataArray(systematic, dims=BAND), "radiance_gain_u_systematic"),
    )
    good = label(xr.DataArray(is_good, dims=BAND), "good")
    return rescaled.assign_coords(good=good).assign_attrs(absolute_anchor=anchor, absolute_scale="known")


def _anchor_signal(frames: xr.Dataset, calibration: xr.Dataset) -> tuple[Floats, float]:
    # Return linear mean counts above dark (band, cross_track), NaN where saturated, and the exposure time
    # [s].
    problems = Problems("these frames cannot be used as an anchor", SchemaError)
    for name in ("counts", "dark_counts", "exposure_time"):
        problems.add_if(
            name not in frames.variables,
            f"{name!r} is missing: {VARIABLES[name].meaning.lower()} [{VARIABLES[name].units}]",
            code="variable-missing",
        )
    problems.raise_if_any()
    exposure = np.unique(require(frames, ["exposure_time"], "an anchor")["exposure_time"].to_numpy())
    problems.add_if(
        len(exposure) != 1 or not exposure[0] > 0,
        f"'exposure_time' {exposure.tolist()}",
        expected="one positive number",
        code="exposure-invalid",
    )
    counts, dark = frames["counts"], frames["dark_counts"]
    for array in (counts, dark):
        problems.add_if(
            not set(_ELEMENT) <= set(array.dims) <= {*_ELEMENT, ALONG_TRACK},
            f"{array.name!r} has dims {tuple(map(str, array.dims))}",
            expected="([along_track,] band, cross_track)",
            code="dims-wrong",
        )
        expected = {dim: calibration.sizes.get(dim, array.sizes.get(dim)) for dim in _ELEMENT}
        sizes = {dim: array.sizes.get(dim) for dim in _ELEMENT}
        problems.add_if(
            sizes != expected and sizes != {BAND: expected[BAND], CROSS_TRACK: sizes[CROSS_TRACK]},
            f"{array.name!r} has sizes {sizes}, the calibration {expected}",
            code="grid-mismatch",
        )
    problems.raise_if_any()
    other_dims = [dim for dim in counts.dims if dim not in _ELEMENT]
    mean = counts.astype(np.float64).mean(other_dims) if other_dims else counts.astype(np.float64)
    dark = dark.astype(np.float64)
    dark = dark.mean(ALONG_TRACK) if ALONG_TRACK in dark.dims else dark
    raw_counts, dark_counts = (
        np.asarray(a.transpose(*_ELEMENT).to_numpy(), np.float64) for a in (mean, dark)
    )
    # correction of the dark to the exposure of the frames
    if "dark_exposure_time" in frames.variables:
        dark_exposure = require(frames, ["dark_exposure_time"], "an anchor")["dark_exposure_time"].to_numpy()
        if (np.abs(dark_exposure - exposure[0]) > SAME_EXPOSURE * exposure[0]).any():
            dark_ms = ", ".join(f"{t * 1e3:g}" for t in np.unique(dark_exposure))
            SchemaError.raise_if(
                "dark_rate" not in calibration.variables,
                f"frames at {exposure[0] * 1e3:g} ms, dark at {dark_ms} ms, and dark_rate is missing",
                mend="take a dark at the exposure of the frames",
                code="dark-exposure-differs",
            )
            rate = require(calibration, ["dark_rate"], "an anchor")["dark_rate"].to_numpy()
            dark_counts = dark_counts + rate.astype(np.float64) * (
                exposure[0] - float(np.mean(dark_exposure))
            )
    signal = linearity_of(calibration).net(raw_counts, dark_counts)
    if "saturation_count" in {*frames.variables, *calibration.variables}:
        limit: Any = frames.get("saturation_count", calibration.get("saturation_count"))
        is_saturated = counts >= limit - float(SATURATION_MARGIN_COUNTS)
        is_saturated = is_saturated.any(other_dims) if other_dims else is_saturated
        saturated_elements = is_saturated.transpose(*_ELEMENT).to_numpy()
        if saturated_elements.any():
            warn_user(
                f"{int(saturated_elements.sum())} elements are saturated in the anchor's frames",
                "elements-saturated",
            )
            signal = np.where(saturated_elements, np.nan, signal)
    return signal, float(exposure[0])


def _band_means(calibration: xr.Dataset, response_inputs: dict[str, Any], spectrum: xr.DataArray) -> Floats:
    # Return the mean of a spectrum over the response of every element (band, cross_track).
    SchemaError.raise_if(
        spectrum.ndim != 1,
        f"the source's radiance has dims {tuple(map(str, spectrum.dims))}",
        expected="one, of wavelengths",
        code="dims-wrong",
    )
    axis = spectrum["wavelength"] if "wavelength" in spectrum.coords else spectrum[spectrum.dims[0]]
    if "units" in axis.attrs and not same_dimension(str(axis.attrs["units"]), "nm"):
        raise SchemaError(
            f"wavelengths of the source have units {axis.attrs['units']!r}",
            expected="nm",
            code="units-not-convertible",
        )
    grid = (
        (convert(axis, "nm", "wavelength") if "units" in axis.attrs else axis).to_numpy().astype(np.float64)
    )
    values = spectrum.to_numpy().astype(np.float64)
    SchemaError.raise_if(
        grid.size < 2 or not (np.diff(grid) > 0).all(),
        "wavelengths of the source's radiance do not increase",
        mend="sort them",
        code="wavelength-unordered",
    )
    tables = {
        option: calibration[name].to_numpy()
        for option, name in {"spacing": "band_spacing", "offset": "srf_offset", "table": "srf"}.items()
        if name in calibration.variables
    }
    wavelength, fwhm = (response_inputs[name].to_numpy() for name in ("wavelength", "fwhm"))
    if "radiance_gain" in calibration.variables:
        gain = calibration["radiance_gain"].transpose(*_ELEMENT).to_numpy().astype(np.float64)
        tables["slope"] = log_slope(wavelength, 1.0 / row_medians(gain), 2.0 * fwhm)
    responses = Responses(wavelength, fwhm, str(calibration.attrs.get("srf_shape", "gaussian")), **tables)
    shifts = np.atleast_2d(calibration.get("wavelength_shift", xr.DataArray(0.0)).to_numpy())
    low, high = float(shifts.min()), float(shifts.max())
    nodes = np.linspace(low, high, max(int(np.ceil((high - low) / NODE_SPACING_NM)) + 1, 1))
    bands = responses.wavelength.size
    means = np.empty((bands, calibration.sizes.get(CROSS_TRACK, shifts.shape[1])))
    for band in range(bands):
        at_nodes = [_mean_over_response(responses.shifted(float(node)), band, grid, values) for node in nodes]
        means[band] = np.interp(shifts[band if len(shifts) > 1 else 0], nodes, at_nodes)
    return means


def _mean_over_response(responses: Responses, band: int, grid: Floats, values: Floats) -> float:
    reach = float(responses.reach()[band])
    step = min(float(responses.fwhm[band]) / 40.0, reach / 20.0)
    centre = float(responses.wavelength[band])
    fine_grid = np.arange(centre - reach - step, centre + reach + 1.5 * step, step)
    response = responses.on(fine_grid, band) * step
    is_inside = (fine_grid >= grid[0]) & (fine_grid <= grid[-1])
    if response[is_inside].sum() < MIN_COVERAGE:
        return float("nan")
    return float(
        (response[is_inside] * np.interp(fine_grid[is_inside], grid, values)).sum()
        / response[is_inside].sum()
    )


@takes_quantities(exposure_time="s")
def calibration_from_coefficients(
    coefficients: xr.DataArray,
    wavelength: xr.DataArray,
    fwhm: xr.DataArray,
    *,
    exposure_time: float | None = None,
    srf_shape: str = "gaussian",
    uncertainty: float = 0.05,
) -> xr.Dataset:
    """Return a calibration from a vendor's coefficients of every element.

    Parameters
    ----------
    coefficients : (band, cross_track)
        Radiance x exposure per count, or radiance per count at one exposure, with units; zeros and values
        that are not finite mark bad elements.
    wavelength, fwhm : (band,)
        Centre wavelengths and full widths at half maximum of the bands, with units.
    exposure_time
        Exposure time [s] to which coefficients in radiance per count refer.
    srf_shape
        Line shape of the camera.
    uncertainty
        Relative standard uncertainty of the coefficients.

    Returns
    -------
    xarray.Dataset

    Raises
    ------
    SchemaError, UnitsError
        Coefficients have other units or dims.

    Examples
    --------
    >>> import xarray as xr
    >>> units = {"units": "mW cm-2 um-1 sr-1 count-1"}
    >>> gain = xr.DataArray([[2.0]], dims=("band", "cross_track"), attrs=units)
    >>> nm = {"units": "nm"}
    >>> made = calibration_from_coefficients(
    ...     gain, xr.DataArray([550.0], dims="band", attrs=nm), xr.DataArray([6.0], dims="band", attrs=nm),
    ...     exposure_time=5e-3)
    >>> round(float(made.radiance_gain[0, 0]), 9), made.radiance_gain.units
    (0.0001, 'W m-2 sr-1 nm-1 s count-1')
    """
    units_of_gain = VARIABLES["radiance_gain"].units
    SchemaError.raise_if(
        coefficients.ndim != 2 or set(coefficients.dims) != set(_ELEMENT),
        f"coefficients have dims {tuple(map(str, coefficients.dims))}",
        expected=f"{_ELEMENT}",
        code="dims-wrong",
    )
    gain = coefficients.astype(np.float64).transpose(*_ELEMENT)
    units = str(coefficients.attrs.get("units", ""))
    if same_dimension(units, "W m-2 sr-1 nm-1 count-1"):
        if exposure_time is None or not exposure_time > 0:
            raise SchemaError(
                f"coefficients in {units!r} refer to one exposure time",
                mend="pass exposure_time [s]",
                code="exposure-missing",
            )
        gain = convert(gain, "W m-2 sr-1 nm-1 count-1", "coefficients") * exposure_time
    else:
        gain = convert(gain, units_of_gain, "coefficients")
    values = gain.to_numpy()
    values = np.where(np.isfinite(values) & (values > 0), values, np.nan)
    calibration = xr.Dataset(
        coords={"wavelength": _axis(wavelength, "wavelength"), "fwhm": _axis(fwhm, "fwhm")},
        attrs={"srf_shape": srf_shape},
    )
    return _with_gain(calibration, values, "coefficients of the vendor", uncertainty)


def _axis(array: xr.DataArray, name: str) -> xr.DataArray:
    return label(convert(array.reset_coords(drop=True).astype(np.float64), "nm", name), name)
