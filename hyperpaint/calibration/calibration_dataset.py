"""Assemble the calibration dataset from the fitted lamp lines, element by element, with uncertainties.

`calibrate`: all steps from a lab sweep to a calibration, in order, with the checks between them.

Absolute anchors: one gain for every element, from optics, a known source or a vendor's coefficients.
"""

import itertools
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.polynomial import chebyshev

from hyperpaint.base import (
    ALONG_TRACK,
    BAND,
    CROSS_TRACK,
    ELEMENT,
    MAX_STRAY_LIGHT_U,
    QUANTISATION_VARIANCE_COUNT2,
    SATURATION_MARGIN_COUNTS,
    STEP,
    VARIABLES,
    Bools,
    Floats,
    Ints,
    Problems,
    SchemaError,
    convert,
    documented,
    dtype_of,
    label,
    log_slope,
    one_of,
    require,
    same_dimension,
    takes_quantities,
    warn_if,
    warn_user,
)
from hyperpaint.base.schema import refuse_other_labels
from hyperpaint.io.flightline.side_files import check_calibration
from hyperpaint.kernels.line_fits import GAUSSIAN
from hyperpaint.light.clear_sky import ClearSky
from hyperpaint.light.responses import Responses
from hyperpaint.radiometry.stray_light import DARK_SUBTRACTED, RAW, Linearity, linearity_of

from .detector import (
    FROM_FRAMES,
    FROM_SCATTER,
    SHAPES,
    Fits,
    LabSweep,
    LampLines,
    NoiseModel,
    SweepData,
    WavelengthMap,
    Window,
    at_steps,
    band_widths,
    check_sweep,
    complete_edge_lines,
    deviant_darks,
    deviant_elements,
    element_differences,
    element_gain,
    find_line,
    fit_beam,
    fit_steps,
    fit_wavelength_map,
    line_profiles,
    line_wavelengths,
    listed,
    on_elements,
    placed_lines,
    read_lines,
    refuse_if,
    row_medians,
    second_order_factor,
    shape_variance,
    slope_shift_of_lines,
)

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
    with Problems("the etendue cannot be computed", SchemaError) as problems:
        for name, (value, high) in values.items():
            problems.add_if(
                not 0 < value < high,
                f"{name}={value!r}",
                expected=f"above 0 and below {high:g}, in metres and radians",
                code="value-out-of-range",
            )


@takes_quantities(reflectance="1")
def panel_radiance(irradiance: xr.DataArray, reflectance: float | xr.DataArray) -> xr.DataArray:
    """Return the spectral radiance of a level Lambertian panel [W m-2 sr-1 nm-1]: ``reflectance x E / pi``.

    Parameters
    ----------
    irradiance
        Irradiance on the panel, with units and a dim of wavelengths.
    reflectance
        Reflectance of the panel [1], up to 1.2; a spectrum is on the wavelengths of ``irradiance``.

    Returns
    -------
    xarray.DataArray

    Raises
    ------
    UnitsError
        ``irradiance`` has no units of irradiance.
    SchemaError
        ``reflectance`` is not from 0 to 1.2, or shares no wavelength with ``irradiance``.

    Examples
    --------
    >>> irradiance = xr.DataArray([1.0, 1.3], dims="wavelength", attrs={"units": "W m-2 nm-1"})
    >>> panel_radiance(irradiance, 0.5).values.round(4)
    array([0.1592, 0.2069])
    """
    highest = float(np.max(reflectance))
    SchemaError.raise_if(
        highest < 0 or highest > 1.2,
        f"reflectance up to {highest:g}",
        expected="0 to 1.2",
        mend="divide percent by 100",
        code="value-out-of-range",
    )
    radiance = convert(irradiance, VARIABLES["irradiance"].units, "irradiance") * reflectance / np.pi
    SchemaError.raise_if(
        irradiance.size and not radiance.size,
        "reflectance has no wavelength of irradiance",
        mend="interpolate it: reflectance.interp_like(irradiance)",
        code="grid-mismatch",
    )
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
        Variables are missing, or no element is covered; all problems are listed. The source has no
        wavelengths or no positive radiance; ``uncertainty`` is not from 0 to 1.

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
    _check_uncertainties(uncertainty=uncertainty)
    SchemaError.raise_if(
        not isinstance(radiance, xr.DataArray),
        f"radiance is {type(radiance).__name__}",
        expected="a DataArray with units, and a coordinate of wavelengths",
        code="type-wrong",
    )
    spectrum = convert(radiance, VARIABLES["radiance"].units, "radiance")
    # mean of the source's spectrum over the response of every element (band, cross_track)
    SchemaError.raise_if(
        spectrum.ndim != 1,
        f"the source's radiance has dims {tuple(map(str, spectrum.dims))}",
        expected="one, of wavelengths",
        code="dims-wrong",
    )
    names = [name for name in ("wavelength", spectrum.dims[0]) if name in spectrum.coords]
    SchemaError.raise_if(
        not names,
        "the source's radiance has no wavelengths",
        expected="a coordinate [nm]",
        code="wavelength-missing",
    )
    axis = spectrum[names[0]]
    units = axis.attrs.get("units", "nm")
    SchemaError.raise_if(
        not same_dimension(str(units), "nm"),
        f"wavelengths of the source have units {units!r}",
        expected="nm",
        code="units-not-convertible",
    )
    grid = convert(axis.assign_attrs(units=units), "nm", "wavelength").to_numpy().astype(np.float64)
    values = spectrum.to_numpy().astype(np.float64)
    SchemaError.raise_if(
        grid.size < 2 or not (np.diff(grid) > 0).all(),
        "wavelengths of the source's radiance do not increase",
        mend="sort them",
        code="wavelength-unordered",
    )
    SchemaError.raise_if(
        not (values > 0).any(),
        f"the source's radiance is {np.nanmax(values, initial=-np.inf):g} at most",
        expected="above 0",
        code="value-out-of-range",
    )
    ordered = calibration.transpose(*ELEMENT, ..., missing_dims="ignore")
    tables = {
        option: ordered[name].to_numpy()
        for option, name in {"spacing": "band_spacing", "offset": "srf_offset", "table": "srf"}.items()
        if name in calibration.variables
    }
    wavelength, fwhm = (
        require(calibration, ["wavelength", "fwhm"], "an anchor")[name].to_numpy()
        for name in ("wavelength", "fwhm")
    )
    if "radiance_gain" in calibration.variables:
        gain = calibration["radiance_gain"].transpose(*ELEMENT).to_numpy().astype(np.float64)
        tables["slope"] = log_slope(wavelength, 1.0 / row_medians(gain), 2.0 * fwhm)
    responses = Responses(wavelength, fwhm, str(calibration.attrs.get("srf_shape", "gaussian")), **tables)
    shifts = np.atleast_2d(ordered.get("wavelength_shift", xr.DataArray(0.0)).to_numpy())
    low, high = float(shifts.min()), float(shifts.max())
    nodes = np.linspace(low, high, max(int(np.ceil((high - low) / NODE_SPACING_NM)) + 1, 1))
    bands = responses.wavelength.size
    level = np.empty((bands, calibration.sizes.get(CROSS_TRACK, shifts.shape[1])))
    for band in range(bands):
        at_nodes = [_mean_over_response(responses.shifted(float(node)), band, grid, values) for node in nodes]
        level[band] = np.interp(shifts[band if len(shifts) > 1 else 0], nodes, at_nodes)
    # linear mean counts above dark (band, cross_track), NaN where saturated, and the exposure time [s]
    with Problems("these frames cannot be used as an anchor", SchemaError) as problems:
        for name in ("counts", "dark_counts", "exposure_time"):
            problems.add_if(
                name not in frames.variables,
                f"{name!r} is missing: {VARIABLES[name].meaning.lower()} [{VARIABLES[name].units}]",
                code="variable-missing",
            )
        problems.raise_if_any()
        exposures = np.unique(require(frames, ["exposure_time"], "an anchor")["exposure_time"].to_numpy())
        problems.add_if(
            not exposures.size
            or not (exposures > 0).all()
            or np.ptp(exposures) > SAME_EXPOSURE * exposures[0],
            f"'exposure_time' {listed(exposures.tolist(), 's')}",
            expected="one positive number",
            code="exposure-invalid",
        )
        exposure = exposures[:1] if exposures.size == 1 else np.array([exposures.mean()])
        counts, dark = frames["counts"], frames["dark_counts"]
        for array in (counts, dark):
            problems.add_if(
                not set(ELEMENT) <= set(array.dims) <= {*ELEMENT, ALONG_TRACK},
                f"{array.name!r} has dims {tuple(map(str, array.dims))}",
                expected="([along_track,] band, cross_track)",
                code="dims-wrong",
            )
            expected = {dim: calibration.sizes.get(dim, counts.sizes.get(dim)) for dim in ELEMENT}
            sizes = {dim: array.sizes.get(dim) for dim in ELEMENT}
            # one column stands for all
            problems.add_if(
                sizes[BAND] != expected[BAND] or sizes[CROSS_TRACK] not in (expected[CROSS_TRACK], 1),
                f"{array.name!r} has sizes {sizes}, the calibration {expected}",
                code="grid-mismatch",
            )
    refuse_other_labels(frames, calibration, "frames", ELEMENT, "the calibration")
    other_dims = [dim for dim in counts.dims if dim not in ELEMENT]
    mean = counts.astype(np.float64).mean(other_dims) if other_dims else counts.astype(np.float64)
    dark = dark.astype(np.float64)
    dark = dark.mean(ALONG_TRACK) if ALONG_TRACK in dark.dims else dark
    raw_counts, dark_counts = (np.asarray(a.transpose(*ELEMENT).to_numpy(), np.float64) for a in (mean, dark))
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
        saturated_elements = is_saturated.transpose(*ELEMENT).to_numpy()
        warn_if(
            saturated_elements.any(),
            f"{int(saturated_elements.sum())} elements are saturated in the anchor's frames",
            "elements-saturated",
        )
        signal = np.where(saturated_elements, np.nan, signal)
    first, last = calibration.attrs.get("lit_columns", (0, signal.shape[1] - 1))
    # the sweep gives no wavelengths for unlit columns
    signal[:, :first] = signal[:, last + 1 :] = np.nan
    with np.errstate(divide="ignore", invalid="ignore"):
        gain = np.where((signal > 0) & (level > 0), level * exposure / signal, np.nan)
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
        ratio = calibration["radiance_gain"].transpose(*ELEMENT).astype(np.float64) / gain
        rescaled["responsivity"] = label(calibration["responsivity"] * ratio, "responsivity")
    rescaled = rescaled.assign(
        radiance_gain=label(xr.DataArray(gain.astype(np.float32), dims=ELEMENT), "radiance_gain"),
        radiance_gain_u_systematic=label(xr.DataArray(systematic, dims=BAND), "radiance_gain_u_systematic"),
    )
    good = label(xr.DataArray(is_good, dims=BAND), "good")
    return rescaled.assign_coords(good=good).assign_attrs(absolute_anchor=anchor, absolute_scale="known")


def _check_uncertainties(**values: float) -> None:
    # Refuse relative standard uncertainties that are negative, or in percent.
    for name, value in values.items():
        SchemaError.raise_if(
            value < 0 or value >= 1,
            f"{name}={value:g}",
            expected="a relative standard uncertainty, from 0 to below 1",
            code="value-out-of-range",
        )


def _mean_over_response(responses: Responses, band: int, grid: Floats, values: Floats) -> float:
    reach = float(responses.reach()[band])
    step = min(float(responses.fwhm[band]) / 40.0, reach / 20.0)
    centre = float(responses.wavelength[band])
    fine_grid = np.arange(centre - reach - step, centre + reach + 1.5 * step, step)
    response = responses.on(fine_grid, band) * step
    is_inside = (fine_grid >= grid[0]) & (fine_grid <= grid[-1])
    return (
        float("nan")
        if response[is_inside].sum() < MIN_COVERAGE
        else float(
            (response[is_inside] * np.interp(fine_grid[is_inside], grid, values)).sum()
            / response[is_inside].sum()
        )
    )


@takes_quantities(wavelength="nm", fwhm="nm", exposure_time="s")
def calibration_from_coefficients(
    coefficients: xr.DataArray,
    wavelength: xr.DataArray | Floats,
    fwhm: xr.DataArray | Floats | float,
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
        Centre wavelengths and full widths at half maximum of the bands, with units or in nm; or one width.
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
        Coefficients have other units or dims; wavelengths, widths or ``srf_shape`` are impossible;
        ``uncertainty`` is not from 0 to 1.

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
    _check_uncertainties(uncertainty=uncertainty)
    units_of_gain = VARIABLES["radiance_gain"].units
    dims = coefficients.dims if isinstance(coefficients, xr.DataArray) else ()
    SchemaError.raise_if(
        set(dims) != set(ELEMENT),
        f"coefficients are {type(coefficients).__name__} of dims {tuple(map(str, dims))}",
        expected=f"a DataArray with units, of dims {ELEMENT}",
        code="dims-wrong",
    )
    gain = coefficients.astype(np.float64).transpose(*ELEMENT)
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
    coords = {}
    for name, axis in (("wavelength", wavelength), ("fwhm", fwhm)):
        numbers = np.asarray(axis, np.float64)
        SchemaError.raise_if(
            numbers.shape != (len(values),) and (name == "wavelength" or numbers.ndim > 0),
            f"{name} has shape {numbers.shape}",
            expected=f"one value for each of {len(values)} bands",
            code="length-mismatch",
        )
        coords[name] = label(xr.DataArray(np.broadcast_to(numbers, len(values)).copy(), dims=BAND), name)
    made = _with_gain(
        xr.Dataset(coords=coords, attrs={"srf_shape": srf_shape}),
        values,
        "coefficients of the vendor",
        uncertainty,
    )
    # a table of responses is added later
    has_table = srf_shape == "tabulated"
    check_calibration(made.assign_attrs(srf_shape="slit") if has_table else made, "these coefficients")
    return made


# --- anchors -----------------------------------------------------------------------------------------------

# -- Measure the camera's response from all lamp lines of a sweep, where neither line model fits.
# Every lamp line is the monochromator's line convolved with the camera's response, sampled at as many
# distances from its centre as columns and steps provide. In units of the width, all lamp lines follow one
# curve; the monochromator's line is deconvolved by least squares without negative response.


_SHAPE_FIT = SimpleNamespace(
    #: Half support of the table in widths; 2e-7 of a Gaussian's area lies beyond.
    reach=2.0,
    #: Weight of the table's second differences relative to the curve: suppresses ringing by noise of 1e-3
    #: where the monochromator is as wide as the camera's response.
    smoothing=1e-4,
    min_samples=4.0,  # mean number at a point of the curve
    #: Distance of curve and model, relative to the model, above which a table is used [1]: the right model
    #: gives 0.0006, a slit with a tail of a tenth of its width 0.024.
    max_model_misfit=0.012,
    #: Width of the monochromator over the camera's above which fwhm is ill-conditioned and the response is
    #: not resolved [1].
    max_slit_share=0.7,
    sun_zenith_deg=48.2,  # of the daylight in which the effect is stated
)
_TABLE_STEP = 0.04  # in widths


class MeasuredShape(NamedTuple):
    # The response in units of its width.
    offset: Floats  #: (place,): wavelength minus wavelength of the band, over the width
    response: Floats  #: (place,), of unit area
    misfit: float  #: Distance of the lamp lines from the best model, relative [1]
    effect: float  #: Largest relative change of matched daylight if the model replaces the response [1]
    is_resolved: bool  #: Whether the monochromator's line was narrow enough


def measured_shape(
    lab: LabSweep,
    sweep_data: SweepData,
    lamp_lines: LampLines,
    wavelength_map: WavelengthMap,
    is_placed: Bools,
    camera_width: Floats,
    shape: str,
) -> MeasuredShape | None:
    # Return the response measured from the lamp lines; None where they are too few.
    #
    # ``is_placed`` (step, cross_track): lamp lines that are used; ``camera_width`` (step,) [nm];
    # ``shape``: the best line model.
    from scipy.optimize import nnls

    edges = np.arange(-_SHAPE_FIT.reach - _TABLE_STEP / 2, _SHAPE_FIT.reach + _TABLE_STEP, _TABLE_STEP)
    # sums over the samples between two edges: area, area times distance, area times height
    sums, light, spacing, count = np.zeros((3, edges.size - 1)), [], [], 0
    for step, window in enumerate(sweep_data.windows):
        if window is None:
            continue
        is_used = is_placed[step, window.columns] & ~window.saturated
        columns = window.columns[is_used]
        if not columns.size:
            continue
        bands, centre = window.places[is_used], lamp_lines.centre[step, columns][:, None]
        distance = (
            wavelength_map.at(centre, columns[:, None]) - wavelength_map.at(bands, columns[:, None])
        ) / camera_width[step]
        pitch = wavelength_map.spacing(bands, columns[:, None]) / camera_width[step]
        density = window.values[is_used] / (lamp_lines.area[step, columns][:, None] * pitch)
        is_finite = np.isfinite(density)
        bins = np.digitize(distance[is_finite], edges) - 1
        is_inside = (bins >= 0) & (bins < edges.size - 1)
        # shot noise dominates, so a brighter lamp line has more weight
        area = np.broadcast_to(lamp_lines.area[step, columns][:, None], density.shape)[is_finite][is_inside]
        for row, value in zip(
            sums, (1.0, distance[is_finite][is_inside], density[is_finite][is_inside]), strict=True
        ):
            row += np.bincount(bins[is_inside], area * value, row.size)
        light.append(float(lab.width[step] / camera_width[step]))
        spacing.append(float(np.median(pitch)))
        count += int(is_inside.sum())
    if count < _SHAPE_FIT.min_samples * (edges.size - 1):
        return None
    # matrix from a response (offset,) to the curve, which is its convolution with a lamp line
    offset, width = 0.5 * (edges[1:] + edges[:-1]), float(np.median(light))
    # distances repeat between steps and bands: bins without samples are determined by their neighbours
    weight = sums[0, sums[0] > 0]
    place, observed = sums[1:, sums[0] > 0] / weight
    distance = place[:, None] - offset
    source = (
        np.clip(1.0 - np.abs(distance) / width, 0.0, None) / width
        if lab.triangular
        else np.exp(-4.0 * np.log(2.0) * (distance / width) ** 2) * np.sqrt(4.0 * np.log(2.0) / np.pi) / width
    ) * _TABLE_STEP
    # distance of the model from the curve
    model = Responses(np.zeros(1), np.ones(1), shape, spacing=np.array([np.median(spacing)])).on(offset, 0)
    model_curve, root_weight = source @ model, np.sqrt(weight)
    misfit = float(
        np.linalg.norm(root_weight * (observed - model_curve)) / np.linalg.norm(root_weight * model_curve)
    )
    # smooth response, not negative and of unit area, whose convolution fits the curve
    root_weight = np.sqrt(weight / weight.mean())
    smoothness = np.diff(np.eye(offset.size), 2, axis=0) * np.sqrt(_SHAPE_FIT.smoothing) / _TABLE_STEP
    response, _ = nnls(
        np.vstack([root_weight[:, None] * source, smoothness]),
        np.concatenate([root_weight * observed, np.zeros(offset.size - 2)]),
    )
    response = response / (response.sum() * _TABLE_STEP)
    # change of daylight in a band, 420 to 950 nm, if the model replaces the response
    nm = np.arange(380.0, 1001.0)
    daylight = sum(ClearSky(_SHAPE_FIT.sun_zenith_deg).irradiance(nm))
    width_nm = float(np.median(camera_width))
    daylight = np.interp(np.arange(420.0, 950.0)[:, None] + offset * width_nm, nm, daylight)
    change = daylight @ response / (daylight @ model) * model.sum() / response.sum() - 1.0
    return MeasuredShape(
        offset, response, misfit, float(np.abs(change).max()), is_resolved=width <= _SHAPE_FIT.max_slit_share
    )


# -- Light outside the lamp lines: wings of scattered light over all bands, and the second order of the
# grating. The bands outside a lamp line are a column of the stray-light matrix, one column per step. Between
# steps it is filled by quantities that hardly change from step to step: wings as a function of the distance
# from the lamp line, and the second order as a share of the lamp line at twice its wavelength.

OFF_LINE_LIMITS = SimpleNamespace(
    #: Minimum number of bands outside a lamp line for an estimate of scattered light.
    min_bands_outside=4,
    #: Number of nearest bins of distance from which a wing is extrapolated, exponentially, by at most a
    #: factor of e.
    nearest_bins=3,
    #: Relative standard uncertainty of the wing inside a line's window, extrapolated from outside [1].
    wing_u=0.25,
)


class OffLines(NamedTuple):
    # Light off the lamp lines of a sweep.
    second_order: Floats  #: (step,): counts at twice the wavelength over those of the lamp line [1]
    #: (band, source band): share of the counts of a source band that other bands receive [1]
    stray_light: Floats
    relative: float  #: Relative standard uncertainty of ``stray_light`` [1]
    wing: float  #: Share of the areas of lamp lines that is light scattered into their windows [1]
    counted: float  #: Measured areas of the lamp lines over their areas without scattered light [1]
    counted_u: float  #: Relative standard uncertainty of the areas by scattered light [1]


def light_off_lines(
    rows: Floats, centre: Floats, step_wavelength: Floats, wavelength: Floats, width: Floats,
    dark_check: dict[str, float],
) -> OffLines:  # fmt: skip
    # Return the light off the lamp lines, of which all steps have some.
    #
    # ``rows`` (step, band) are counts outside the lines relative to the lines' areas, 0 inside their windows;
    # ``centre`` (step,) are the bands of the lamp lines, ``step_wavelength`` (step,) and ``wavelength``
    # (band,) in nm; ``width`` (step,) is the measured full width at half maximum of the line [nm];
    # ``dark_check`` as of `dark_off_lines`.
    # counts at twice the wavelength over counts of the lamp line (step,) [1]; the second order is up to twice
    # as wide as the lamp line
    second_order = np.full(len(rows), np.nan)
    for step, (middle, fwhm) in enumerate(zip(2.0 * step_wavelength, width, strict=True)):
        distance = np.abs(wavelength - middle)
        is_near, is_ring = distance <= 2.0 * fwhm, (distance > 3.0 * fwhm) & (distance <= 6.0 * fwhm)
        is_covered = wavelength.min() + 2.0 * fwhm <= middle <= wavelength.max() - 2.0 * fwhm
        if is_covered and is_ring.sum() >= 4 and (rows[step][is_near] != 0).all():
            second_order[step] = (rows[step][is_near] - np.median(rows[step][is_ring])).sum()
    # share of the light of a source band that other bands receive (band, source_band) [1]
    band = np.arange(rows.shape[1])
    is_usable = (rows != 0) & (np.abs(wavelength - 2.0 * step_wavelength[:, None]) > 3.0 * width[:, None])
    matrix = _wings((band - centre[:, None])[is_usable], rows[is_usable], band[:, None] - band)
    has_second = np.isfinite(second_order)
    if has_second.any():
        is_covered = (2.0 * wavelength >= wavelength.min()) & (2.0 * wavelength <= wavelength.max())
        share = second_order[has_second]
        at_bands = np.interp(
            wavelength, step_wavelength[has_second], np.maximum(share, 0.0), left=share[0], right=share[-1]
        )
        level = np.where(is_covered, np.maximum(at_bands, 0.0), 0.0)
        distance = (wavelength[:, None] - 2.0 * wavelength) / (1.5 * float(np.median(width)))
        shape = np.exp(-4.0 * np.log(2.0) * distance**2)
        matrix += level * shape / np.maximum(shape.sum(axis=0), 1.0)
    source = np.clip(np.round(centre), 0, len(matrix) - 1).astype(np.int64)
    # relative uncertainty: difference of the matrix to the sums of single steps, and offset of the dark
    modelled = np.where(rows != 0, matrix[:, source].T, 0.0).sum(axis=1)
    scatter = 1.4826 * float(np.median(np.abs(rows.sum(axis=1) - modelled)))
    offset = abs(dark_check.get("dark_offset_count", 0.0)) * dark_check.get("out_of_band_of_one_count", 0.0)
    off_lines = float(np.median(modelled))
    relative = min(float(np.hypot(scatter, offset)) / off_lines, 1.0) if off_lines > 0 else 1.0
    # share of the areas that is light scattered into the windows, beyond the background
    shares = []
    for row, band in zip(rows, source, strict=True):
        is_outside = row != 0
        if is_outside.sum() >= OFF_LINE_LIMITS.min_bands_outside:
            # the background that is subtracted from a lamp line: clipped mean of the bands outside its window
            median = np.median(row[is_outside])
            spread = 1.4826 * np.median(np.abs(row[is_outside] - median))
            background = row[is_outside & (np.abs(row - median) <= 4.0 * spread)].mean()
            shares.append((matrix[~is_outside, band] - background).sum())
    wing = max(float(np.median(shares)), 0.0) if shares else 0.0
    # areas are corrected where stray light is accurate enough to be subtracted from a flight
    is_usable = relative < MAX_STRAY_LIGHT_U
    counted = 1.0 / (1.0 - wing) if is_usable else 1.0
    return OffLines(
        second_order,
        matrix * counted,
        relative,
        wing,
        counted,
        wing * (OFF_LINE_LIMITS.wing_u if is_usable else 1.0),
    )


def dark_off_lines(
    windows: Sequence[Window | None], area: Floats, is_placed: Bools, rows: Floats
) -> dict[str, float]:
    # Return the offset of the dark, and the effect of one count of it on the light off the lamp lines.
    #
    # The offset are counts off the lamp lines that are independent of their light. ``windows`` (step,);
    # ``area`` of the lines [count] and whether they are in place (step, column); ``rows`` (step, band) as of
    # `light_off_lines`. Empty where no step has a background.
    # medians of the lit columns: counts of a band off the line, and area of the line
    level, areas, bands = np.full(len(rows), np.nan), np.full(len(rows), np.nan), np.zeros(len(rows))
    for step, window in enumerate(windows):
        if window is not None and is_placed[step].any() and (window.background_variance > 0).any():
            level[step] = np.median(window.background[window.background_variance > 0])
            areas[step] = np.median(area[step, is_placed[step]])
            bands[step] = np.count_nonzero(rows[step])
    has_level = np.isfinite(level)
    if not has_level.any():
        return {}
    results = {"out_of_band_of_one_count": float(np.median(bands[has_level] / areas[has_level]))}
    is_usable = has_level & np.isfinite(areas) & (areas > 0)
    if is_usable.sum() >= 4 and np.ptp(areas[is_usable]) >= 0.2 * areas[is_usable].max():
        terms = np.column_stack([np.ones(int(is_usable.sum())), areas[is_usable]])
        results["dark_offset_count"] = float(np.linalg.lstsq(terms, level[is_usable], rcond=None)[0][0])
    return results


def _wings(distance: Floats, share: Floats, at: Ints) -> Floats:
    # Return the wing of a lamp line at distances (band, source_band) [band], from shares of counts at some
    # distances.
    # medians of bins that widen with distance
    edges = np.unique(np.round(np.geomspace(1.0, len(at), 25)))
    edges = np.concatenate([-edges[::-1], edges])
    bins = np.digitize(distance, edges)
    full_bins = [bins == index for index in range(1, len(edges)) if (bins == index).sum() >= 8]
    if not full_bins:
        return np.zeros(at.shape)
    centres = np.array([distance[is_inside].mean() for is_inside in full_bins])
    levels = np.array([np.median(share[is_inside]) for is_inside in full_bins])
    wing = np.interp(at, centres, levels)
    # inside the window of a lamp line the wing is hidden: extrapolate its rise from outside, on both sides
    reach = float(np.abs(distance).min())
    for sign in (-1.0, 1.0):
        order = np.argsort(np.where(sign * centres > 0, sign * centres, np.inf))[
            : OFF_LINE_LIMITS.nearest_bins
        ]
        nearest, level, rise = sign * centres[order], levels[order], 0.0
        if level.size == OFF_LINE_LIMITS.nearest_bins and ((nearest > 0) & (level > 0)).all():
            rise = np.clip(-np.polyfit(nearest, np.log(level), 1)[0], 0.0, 1.0 / nearest[0])
        exponent = np.maximum(reach - sign * at, 0.0) * (sign * at >= 0) * rise
        wing = np.where((np.abs(at) < reach) & (sign * at >= 0), max(level[0], 0.0) * np.exp(exponent), wing)
    return np.asarray(np.maximum(wing, 0.0))


# -- Structure of the responsivity between the lamp lines of a sweep: fringes and etalons that the steps miss.
# The areas of the lamp lines show a ripple, but not whether the steps resolve it: a fringe of 8 nm sampled
# every 10 nm looks like one of 40 nm. The centres of the lamp lines show it: light of variance v moves by v g
# where the responsivity rises by g per nanometre, at any distance of the next lamp line.


#: Relative error of the gain above which it is reported [1].
MIN_REPORTED_ERROR = 0.01
RESPONSIVITY = SimpleNamespace(
    #: Number of steps over which departures are averaged: structure may be local.
    window_steps=9,
    #: Degree of the polynomial of the log responsivity over the sweep, around which areas ripple: detectors
    #: and gratings change over some 60 nm and more.
    degree=9,
    #: Error between lamp lines over the root mean square of the ripple, where they are independent: root mean
    #: squares are as sqrt(0.82 + 1) = 1.35, a cubic's squared weights and the truth, over the residual of
    #: such a ripple after the polynomial, sqrt(1 - 10 / 61) = 0.91 for 61 lines. The largest error is up to
    #: twice that, less where bands average over fringes.
    ripple_spread=1.5,
)


def error_between_lines(
    wavelength: Floats, level: Floats, moved: Floats, source: Floats
) -> tuple[float, float] | None:
    # Return the largest error of the gain between lamp lines [1], and its wavelength [nm].
    #
    # None where lamp lines are too few.
    #
    # ``level`` (step,): responsivity by the lines' areas, any scale, NaN where unknown; ``moved``
    # (step,): distance of the lines from the wavelengths of their light [nm]; ``source`` (step,): variance of
    # the monochromator's line [nm2].
    #
    # With :math:`r` the ripple of the areas, :math:`r'` its slope and :math:`g` the difference of that slope
    # to the slope that moves lines, the error is :math:`s\,r \min(1, g^2 / r'^2)`, root mean squares over
    # some steps, with :math:`s` the constant ``RESPONSIVITY.ripple_spread``. A ripple that the steps resolve
    # has the slope that moves the lines; a ripple that they miss, or the scatter of a power meter, is
    # unrelated to it. Noise of places counts as such.
    from scipy.interpolate import CubicSpline

    usable = np.flatnonzero(np.isfinite(level) & (level > 0) & np.isfinite(moved))
    if usable.size < 2 * RESPONSIVITY.window_steps:
        return None
    wavelength_used, log_level = wavelength[usable], np.log(level[usable])
    position = 2.0 * (wavelength_used - wavelength_used[0]) / (wavelength_used[-1] - wavelength_used[0]) - 1.0
    ripple = log_level - np.polynomial.chebyshev.Chebyshev.fit(position, log_level, RESPONSIVITY.degree)(
        position
    )
    slope = CubicSpline(wavelength_used, ripple).derivative()(wavelength_used)
    slope_difference = moved[usable] / source[usable] - CubicSpline(wavelength_used, log_level).derivative()(
        wavelength_used
    )
    for values in (slope, slope_difference):  # slopes of a spline are unreliable at its ends
        values[:2], values[-2:] = np.nan, np.nan
    missed_share = (_running_rms(slope_difference) / np.maximum(_running_rms(slope), 1e-12)) ** 2
    error = RESPONSIVITY.ripple_spread * _running_rms(ripple) * np.minimum(1.0, missed_share)
    worst = int(error.argmax())
    return float(error[worst]), float(wavelength_used[worst])


def _running_rms(values: Floats) -> Floats:
    # Return the root mean square over some steps; near the ends over fewer steps.
    is_finite, window = np.isfinite(values), np.ones(RESPONSIVITY.window_steps)
    total = np.convolve(np.where(is_finite, values, 0.0) ** 2, window, "same")
    return np.asarray(np.sqrt(total / np.maximum(np.convolve(is_finite, window, "same"), 1.0)))


PLAUSIBLE_SWEEP = SimpleNamespace(
    #: Allowed distance of an element beyond the outer step, lower and upper limit [nm].
    edge_tolerance_nm=(0.01, 0.05),
    #: Offset of the dark above which it is reported [count].
    max_dark_offset=1.0,
    #: Electrons per count of any camera.
    electrons_range=(0.05, 2000.0),
)


def responses_of_lines(lamp_lines: LampLines, lab: LabSweep, spacing: Floats) -> Floats:
    # Return the integrated response at the lamp lines (step, cross_track) [count nm J-1].
    #
    # ``spacing`` (step, cross_track): spacing of the bands there [nm].
    with np.errstate(over="ignore"):  # of fits that are not trusted
        return np.asarray(lamp_lines.area * spacing / (lab.exposure[:, None] * lab.power))


@dataclass(eq=False)
class Result:
    # All results of a calibration, to be assembled into a Dataset.
    lab: LabSweep
    sweep_data: SweepData
    lamp_lines: LampLines
    wavelength_map: WavelengthMap
    line_slope: Floats  #: (step,): d ln responsivity / d wavelength [nm-1]
    slope_shift: Floats  #: (step,): shift of the lamp lines by that slope [nm]
    shape: str  #: Line shape of the camera
    misfit: dict[str, float]  #: Misfit of each line shape
    bad: Bools  #: (band, cross_track)
    #: Uncertainties that the sweep does not determine: relative ones of flux, capture and etendue by
    #: attribute, of the dial [nm], and of linear counts, relative
    scale_u: dict[str, float]
    dial_u: float
    linearity_u: float
    linearity: Linearity
    is_placed: Bools  #: (step, cross_track): valid fits whose centres agree with the map
    fwhm: Floats  #: (band,): width of every band [nm]
    fwhm_at_steps: Floats  #: (step,): width of the camera's line [nm]
    differences: float  #: Relative standard deviation of the elements about the lines
    is_shape_free: bool  #: Whether the response may be measured from the lamp lines

    def __post_init__(self) -> None:
        lab, lamp_lines, is_placed = self.lab, self.lamp_lines, self.is_placed
        # wavelength and spacing of bands at every element (band, cross_track), and at the centre column [nm]
        self.wavelength, self.spacing = self.wavelength_map.grid()
        self.centre_wavelength = self.wavelength[:, lab.shape[2] // 2]
        self.centre_spacing = self.spacing[:, lab.shape[2] // 2]
        # columns (cross_track,) beyond the outermost lit columns, where the map is constant
        first, last = self.wavelength_map.lit
        self.is_unlit = (np.arange(lab.shape[2]) < first) | (np.arange(lab.shape[2]) > last)
        # wavelength of the lamp lines, minus the slope shift, and spacing of bands there (step, cross_track)
        self.line_wavelength = line_wavelengths(lamp_lines, self.wavelength_map, self.slope_shift)
        self.line_spacing = self.wavelength_map.spacing(
            np.nan_to_num(lamp_lines.centre), np.arange(lab.shape[2])
        )
        # lamp lines whose area is used: placed lines, and lines completed at the edges of the array
        self.used = is_placed | lamp_lines.completed
        nodes = responses_of_lines(lamp_lines, lab, self.line_spacing)
        level = row_medians(nodes, self.used)
        # offset of the dark, and light off the lamp lines, from the steps with placed lamp lines
        rows, steps = self.sweep_data.rows, is_placed.any(axis=1)
        self.dark_check = dark_off_lines(self.sweep_data.windows, lamp_lines.area, is_placed, rows)
        self.off_lines = light_off_lines(
            rows[steps],
            row_medians(lamp_lines.centre, is_placed)[steps],
            lab.wavelength[steps],
            self.centre_wavelength,
            row_medians(lamp_lines.width * self.line_spacing, is_placed)[steps],
            self.dark_check,
        )
        # gain of every element [W m-2 sr-1 nm-1 s count-1], NaN where unknown
        spacing = at_steps(lab, self.wavelength_map, self.centre_spacing)
        source = shape_variance(lab.width, "triangle" if lab.triangular else "gaussian")
        own = shape_variance(self.fwhm_at_steps, self.shape, spacing)
        factor = second_order_factor(lab.wavelength, level, own, source)[:, None]
        low, high = PLAUSIBLE_SWEEP.edge_tolerance_nm
        # without light that is scattered into the window of a lamp line
        self.gain, has_gain = element_gain(
            lab.wavelength, nodes * (factor / self.off_lines.counted), self.used, self.wavelength,
            lab.etendue, min(max(low, 3.0 * self.wavelength_map.residual), high),
        )  # fmt: skip
        refuse_if(not has_gain.any(), "no column has four reliable lamp lines", code="lamp-lines-few")
        # response from all lamp lines together, and whether it fits neither model
        self.measured = measured_shape(
            lab, self.sweep_data, lamp_lines, self.wavelength_map, is_placed, self.fwhm_at_steps, self.shape
        )
        self.fits_no_model = self.measured is not None and self.measured.misfit > _SHAPE_FIT.max_model_misfit
        # error of the gain between lamp lines [1], 0 if negligible or explained by column differences
        distance = row_medians(self.line_wavelength - lab.wavelength[:, None], is_placed) + self.slope_shift
        self.between = error_between_lines(lab.wavelength, level, distance, source)
        self.error_between = 0.0
        if self.between is not None and not (self.fits_no_model and not self.is_shape_free):
            # Scatter of the columns' median ripples like missed structure; twice that is significant. It is
            # its relative uncertainty, from differences of columns (step, column) [1]; differences that a
            # column has at all steps are subtracted. Columns and steps that are all NaN would warn.
            with (
                np.errstate(invalid="ignore", divide="ignore"),
                warnings.catch_warnings(action="ignore", category=RuntimeWarning),
            ):
                deviation = np.log(np.where(self.used, nodes, np.nan))
                deviation = deviation - np.nanmedian(deviation, axis=0)
                deviation = deviation - np.nanmedian(deviation, axis=1, keepdims=True)
                number = np.maximum(np.isfinite(deviation).sum(axis=1), 1)
                scatter = 1.25 * 1.4826 * np.nanmedian(np.abs(deviation), axis=1) / np.sqrt(number)
            scatter = float(np.nan_to_num(np.nanmax(scatter, initial=0.0)))
            if self.between[0] > max(MIN_REPORTED_ERROR, 2.0 * RESPONSIVITY.ripple_spread * scatter):
                self.error_between = self.between[0]

    def dataset(self, flat: Floats | None) -> xr.Dataset:
        # Return the calibration.
        gain = self.gain
        if self.lab.absolute:
            # electrons out per photon in
            photons = PLANCK_TIMES_LIGHT / (self.wavelength * 1e-9)
            counts = photons / (gain * self.lab.etendue * self.spacing)
            max_counts = float(np.nanmax(np.nanmedian(counts[np.isfinite(counts).any(axis=1)], axis=1)))
            electrons = self.electrons_per_count
            low, high = (electrons, electrons) if electrons is not None else PLAUSIBLE_SWEEP.electrons_range
            is_small, is_large = max_counts * low > 1.05, max_counts * high < 1e-3
            share, size = (max_counts * low, "small") if is_small else (max_counts * high, "large")
            at = "" if electrons is None else f" at {electrons:.3g} electrons a count"
            refuse_if(
                is_small or is_large,
                f"{share:.3g} electrons out per photon in{at}, as flux x capture_fraction x "
                f"exposure_time is too {size}",
                expected="below 1" if is_small else "above 0.001",
                mend="check the units of flux (uW for W) and of exposure_time (ms for s), and "
                "capture_fraction; without an absolute scale, pass absolute=False",
                code="scale-implausible",
            )
        self._warn()
        # gains for raw counts: the fitted gains are for counts levelled by the flat field
        gain = gain.copy() if flat is None else np.asarray(row_medians(gain)[:, None] * flat)
        gain[:, self.is_unlit] = np.nan
        responsivity = 1.0 / (gain * self.lab.etendue * self.spacing)
        gain[self.bad] = np.nan
        is_good = np.isfinite(gain[:, np.isfinite(gain).any(axis=0)]).mean(axis=1) > 0.5
        # centre and width of the beam, and the second order, of every step
        lamp_lines, steps = self.lamp_lines, self.lab.shape[0]
        beam = np.full((steps, 2), np.nan)
        for step, window in enumerate(self.sweep_data.windows):
            if window is not None:
                beam[step] = fit_beam(window.beam)
        is_placed_step, second = self.is_placed.any(axis=1), np.full(steps, np.nan)
        second[is_placed_step] = self.off_lines.second_order
        values: dict[str, Any] = {
            "radiance_gain": gain,
            "responsivity": responsivity,
            "wavelength_u": np.hypot(self.wavelength_map.residual, self.dial_u),
            **self._uncertainties(gain, is_good),
            **self._dark(),
            "line_band": lamp_lines.centre,
            "line_centre": self.line_wavelength,
            "line_fwhm": lamp_lines.width * self.line_spacing,
            "line_own_fwhm": lamp_lines.camera_width * self.line_spacing,
            "line_amplitude": lamp_lines.amplitude,
            "line_area": lamp_lines.area,
            "line_covariance": lamp_lines.covariance,
            "line_trusted": self.used,
            "beam_centre": beam[:, 0],
            "beam_fwhm": beam[:, 1],
            "out_of_band": np.where(is_placed_step, self.sweep_data.rows.sum(axis=1), np.nan),
            "second_order": second,
            "stray_light": self.off_lines.stray_light,
            "stray_light_u": self.off_lines.relative,
        }
        values |= {} if flat is None else {"flat_field": flat}
        optional = {"band_shift_time": self.lab.band_shift_time, "linearity_u": self.linearity_u}
        values |= {name: value for name, value in optional.items() if value}
        table = self._table()
        coords = {
            "wavelength": self.centre_wavelength,
            "wavelength_shift": self.wavelength - self.centre_wavelength[:, None],
            "fwhm": self.fwhm,
            "band_spacing": self.centre_spacing,
            "good": is_good,
            "step_wavelength": self.lab.wavelength,
        }
        if table is not None:
            coords["srf_offset"], values["srf"] = table
        if self.linearity.measured is not None:
            coords["linearity_counts"] = self.linearity.measured
            values["linear_counts"] = self.linearity.linear
        if self.linearity.basis is not None:
            values |= {"linearity_basis": self.linearity.basis, "linearity_map": self.linearity.weights}
        variables = {name: _labelled(value, name) for name, value in values.items()}
        if "band_shift_time" in variables:
            variables["band_shift_time"].attrs["bands"] = self.lab.shape[1]
        return xr.Dataset(
            variables,
            {name: _labelled(value, name) for name, value in coords.items()},
            self._attrs(is_good) | ({} if table is None else {"srf_shape": "tabulated"}),
        )

    def _warn(self) -> None:
        is_wide = self.lab.width > _SHAPE_FIT.max_slit_share * self.fwhm_at_steps
        warn_if(
            is_wide.any(),
            f"the monochromator's line is up to {np.max(self.lab.width / self.fwhm_at_steps):.2g} of the "
            f"camera's FWHM wide (over {_SHAPE_FIT.max_slit_share:g} at {is_wide.sum()} of {is_wide.size} "
            "steps): fwhm is ill-conditioned there; narrow the slits",
            "slit-too-wide",
        )
        offset = self.dark_check.get("dark_offset_count", 0.0)
        warn_if(
            abs(offset) > PLAUSIBLE_SWEEP.max_dark_offset,
            f"the bands off the lamp lines hold {offset:+.2g} counts at any light, so the dark "
            "has this error: areas are corrected, but out_of_band and stray_light are not, in which "
            f"one count makes {self.dark_check.get('out_of_band_of_one_count', 0.0):.2%}; take the dark "
            "beside the sweep",
            "dark-offset",
        )
        if self.between is not None and self.error_between:
            error, wavelength = self.between
            step = float(np.median(np.abs(np.diff(self.lab.wavelength))))
            warn_user(
                f"steps of {step:.3g} nm do not follow the responsivity around {wavelength:.0f} "
                "nm, as with fringes, an etalon, or a noisy power meter: between lamp lines gain and "
                f"reflectance may be wrong by {error:.1%}; sweep there in steps of "
                f"{step / 4:.2g} nm",
                "steps-too-coarse",
            )
        first, last = self.wavelength_map.lit
        warn_if(
            self.is_unlit.any(),
            f"{int(self.is_unlit.sum())} of {self.is_unlit.size} columns are not lit, all but {first} to "
            f"{last}: they get no gain, and the wavelengths of the nearest lit column",
            "columns-unlit",
        )

    def _table(self) -> tuple[Floats, Floats] | None:
        measured = self.measured
        if measured is None or not self.fits_no_model:
            return None
        if self.is_shape_free and measured.is_resolved:
            # offsets (srf_offset,) [nm], and the response of every band there
            offset = measured.offset * float(self.fwhm.max())
            widened = [np.interp(offset, measured.offset * w, measured.response, 0.0, 0.0) for w in self.fwhm]
            return offset, np.stack(widened)
        reason = "srf_shape= is given" if measured.is_resolved else "the monochromator's line is too wide"
        warn_user(
            f"the measured response is {measured.misfit:.1%} off the model {self.shape!r}, and is not "
            f"tabulated, since {reason}: reflectance beside sharp solar lines may be wrong by "
            f"{measured.effect:.1%}",
            "response-shape-misfit",
        )
        return None

    def _uncertainties(self, gain: Floats, good: Bools) -> dict[str, Floats]:
        random = np.full(gain.shape, np.nan)
        for column in range(gain.shape[1]):
            node_steps = np.flatnonzero(self.used[:, column])
            if node_steps.size:
                random[:, column] = np.interp(
                    self.wavelength[:, column],
                    self.lab.wavelength[node_steps],
                    self.lamp_lines.area_u[node_steps, column],
                )
        slope = np.interp(self.centre_wavelength, self.lab.wavelength, self.line_slope)
        total = np.sqrt(
            sum(u**2 for u in self.scale_u.values())
            + (slope * self.wavelength_map.residual) ** 2
            + self.off_lines.counted_u**2
            + self.error_between**2
        )
        random = np.hypot(random, self.differences)
        return {
            "radiance_gain_u_random": np.where(np.isfinite(gain), random, np.nan),
            "radiance_gain_u_systematic": np.where(good, total, np.nan),
        }

    @property
    def electrons_per_count(self) -> float | None:
        # As stated, else of the noise between frames; None where unknown.
        is_measured = self.sweep_data.noise_source == FROM_FRAMES
        return self.lab.electrons_per_count or (1.0 / self.sweep_data.noise.slope if is_measured else None)

    def _dark(self) -> dict[str, Any]:
        lab = self.lab
        exposure, noise = float(np.median(lab.exposure)), self.sweep_data.noise
        variables: dict[str, Any] = {"dark_counts": lab.dark.at(exposure), "dark_exposure_time": exposure}
        if lab.dark.has_rate:
            variables |= {"dark_bias": lab.dark.bias, "dark_rate": lab.dark.rate}
        if lab.saturation is not None:
            variables["saturation_count"] = lab.saturation
        read_noise = lab.read_noise
        if read_noise is None and self.sweep_data.noise_source == FROM_FRAMES:
            read_noise = float(np.sqrt(max(noise.constant - QUANTISATION_VARIANCE_COUNT2, 0.0)))
        known = {"electrons_per_count": self.electrons_per_count, "read_noise": read_noise}
        return variables | {name: value for name, value in known.items() if value is not None}

    def _attrs(self, good: Bools) -> dict[str, Any]:
        lab = self.lab
        electrons_source = (
            "photon transfer of the sweep, to some per cent; see hyperpaint.radiometry.estimate_noise"
            if lab.electrons_per_count != self.electrons_per_count
            else "none"
            if self.electrons_per_count is None
            else "as stated"
        )
        # distance of the measured response from the better model, and its effect
        shape_attrs: dict[str, Any] = {}
        if self.measured is not None:
            numbers = (float(f"{value:.3g}") for value in (self.measured.misfit, self.measured.effect))
            shape_attrs = {
                "srf_model": self.shape,
                **dict(zip(("srf_model_misfit", "srf_model_effect"), numbers, strict=True)),
            }
        return {
            "srf_shape": self.shape,
            "source": "monochromator sweep, line-area method",
            "absolute_scale": "known" if lab.absolute else "unknown",
            "absolute_anchor": "flux, capture fraction and etendue" if lab.absolute else "none",
            **self.scale_u,
            "steps": len(lab.wavelength),
            "step_range_nm": [float(lab.wavelength[0]), float(lab.wavelength[-1])],
            "steps_left_out_nm": [float(w) for w in lab.wavelength[~self.used.any(axis=1)]],
            "bands_without_gain": int((~good).sum()),
            "bad_elements": int(self.bad.sum()),
            "monochromator_fwhm_nm": float(np.median(lab.width)),
            "monochromator_shape": "triangle" if lab.triangular else "gaussian",
            "column_light": "told per column" if lab.by_column else "taken as equal in all lit columns",
            "wavelength_residual_nm": self.wavelength_map.residual,
            "wavelength_uncertainty_nm": self.dial_u,
            "element_differences": self.differences,
            "stray_light_in_lines": self.off_lines.wing,
            "lit_columns": list(self.wavelength_map.lit),
            **self.dark_check,
            "smile_degree": self.wavelength_map.coefficients.shape[1] - 1,
            "linearity": [*self.linearity.coefficients] or ("table" if self.linearity else "identity"),
            "linearity_on": RAW if self.linearity.on_raw else DARK_SUBTRACTED,
            "noise_source": self.sweep_data.noise_source,
            "electrons_per_count_source": electrons_source,
            **{f"line_misfit_{name}": value for name, value in self.misfit.items()},
            **shape_attrs,
            **({} if self.between is None else {"gain_between_lines": float(f"{self.between[0]:.3g}")}),
        }


def _labelled(value: Any, name: str) -> xr.DataArray:
    spec = VARIABLES[name]
    array = np.asarray(value)
    dims = next(d for d in (spec.dims, *spec.alternatives) if len(d) == array.ndim)
    return label(xr.DataArray(array.astype(dtype_of(name)), dims=dims), name)


# --- quantities derived from a calibration: relative responsivity, quantum efficiency, fitted --------------


#: [J m]
PLANCK_TIMES_LIGHT = 6.62607015e-34 * 2.99792458e8


def relative_responsivity(calibration: xr.Dataset) -> xr.DataArray:
    """Return the responsivity (band, cross_track) over its largest median of a band [1].

    Parameters
    ----------
    calibration
        Calibration with ``responsivity``, see `hyperpaint.calibrate`.

    Returns
    -------
    xarray.DataArray

    Raises
    ------
    SchemaError
        There is no responsivity.

    Examples
    --------
    >>> import xarray as xr
    >>> values = (("band", "cross_track"), [[1e16], [4e16]], {"units": "count J-1"})
    >>> made = xr.Dataset({"responsivity": values})
    >>> relative_responsivity(made).values.ravel()
    array([0.25, 1.  ])
    """
    responsivity = require(calibration, ["responsivity"], "a relative responsivity")["responsivity"]
    relative = responsivity / responsivity.median(CROSS_TRACK).max()
    relative.attrs = {"long_name": "Responsivity relative to the best band", "units": "1"}
    return relative.rename("relative_responsivity")


@takes_quantities(electrons_per_count="electron count-1")
def quantum_efficiency(
    calibration: xr.Dataset, electrons_per_count: float | xr.DataArray | None = None
) -> xr.DataArray:
    r"""Return the external quantum efficiency of every band: electrons out per photon that enters a pixel.

    :math:`\eta = R\,k\,hc/\lambda` with R the responsivity [count J-1] and k electrons per count: optics,
    grating and detector together.

    Parameters
    ----------
    calibration
        Calibration with ``responsivity`` and ``wavelength``.
    electrons_per_count
        [electron count-1]; None for that of the calibration.

    Returns
    -------
    xarray.DataArray
        ``quantum_efficiency`` (band) [1], the median over the columns.

    Raises
    ------
    SchemaError
        Something is missing, or the responsivity has no absolute scale.

    Examples
    --------
    >>> import xarray as xr
    >>> made = xr.Dataset(
    ...     {"responsivity": (("band", "cross_track"), [[5e16]], {"units": "count J-1"})},
    ...     {"wavelength": ("band", [550.0], {"units": "nm"})})
    >>> round(float(quantum_efficiency(made, 20.0)[0]), 4)
    0.3612
    """
    SchemaError.raise_if(
        calibration.attrs.get("absolute_scale") == "unknown",
        "this calibration has no absolute scale for a quantum efficiency (absolute_scale = 'unknown')",
        mend="add one with hyperpaint.calibration.anchor_to_radiance",
        code="scale-unknown",
    )
    stored = ["electrons_per_count"] if electrons_per_count is None else []
    SchemaError.raise_if(
        not set(stored) <= set(calibration.variables),
        "'electrons_per_count' is missing for a quantum efficiency",
        mend="pass electrons_per_count=, or hyperpaint.radiometry.estimate_noise",
        code="variable-missing",
    )
    inputs = require(calibration, ["responsivity", "wavelength", *stored], "a quantum efficiency")
    electrons: Any = inputs.get("electrons_per_count", electrons_per_count)
    photon = PLANCK_TIMES_LIGHT / (inputs["wavelength"] * 1e-9)
    efficiency = (inputs["responsivity"] * electrons * photon).median(CROSS_TRACK).transpose(BAND)
    return label(efficiency.astype(np.float64), "quantum_efficiency")


_REACH = 1.6  # full widths plotted to either side
_POINTS = 201


@dataclass(frozen=True, eq=False)
class FittedLine:
    # One line in one column.
    wavelength: float  #: Wavelength of the monochromator [nm]
    #: distance, counts, residual (sample,) of the bands near the lamp line: distance from its centre [nm],
    #: counts above dark and background, and counts minus fit, relative to the lamp line's height. Empty
    #: without a sweep.
    distance: Floats
    counts: Floats
    residual: Floats
    #: curve_distance, curve (point,): the fit [nm], [count]
    curve_distance: Floats
    curve: Floats


def fitted_lines(
    calibration: xr.Dataset, sweep: xr.Dataset | None, steps: Sequence[int], column: int
) -> list[FittedLine]:
    """Return some lamp lines of one column with their fits.

    Parameters
    ----------
    calibration
        Result of `hyperpaint.calibrate`.
    sweep
        The sweep of the calibration, whose steps are read; None for the fits only.
    steps
        Numbers of steps that have a fit in this column.
    column
        Number of a column.

    Returns
    -------
    list of FittedLine

    Raises
    ------
    SchemaError
        The calibration contains no lamp lines, or the sweep is incomplete.

    Examples
    --------
    >>> from hyperpaint.calibration import calibrate
    >>> from hyperpaint.simulation import simulate_sweep
    >>> sweep = simulate_sweep(steps=13, bands=136, columns=2, noise=False, quantise=False)
    >>> (line,) = fitted_lines(calibrate(sweep), sweep, [6], 1)
    >>> line.wavelength, bool(abs(line.residual).max() < 0.01)
    (700.0, True)
    """
    variables = require(
        calibration,
        ("step_wavelength", "wavelength", "line_band", "line_own_fwhm", "line_amplitude"),
        "its fitted lines",
    )
    wavelength = variables["wavelength"].to_numpy()
    spacing = np.gradient(wavelength)
    lab = None if sweep is None else check_sweep(sweep, absolute=False)
    is_triangular = calibration.attrs["monochromator_shape"] == "triangle"
    results = []
    for step in steps:
        index = {STEP: step, CROSS_TRACK: column}
        centre = float(variables["line_band"].isel(index))
        amplitude = float(variables["line_amplitude"].isel(index))
        camera_width = float(variables["line_own_fwhm"].isel(index))
        spacing_at = float(np.interp(centre, np.arange(wavelength.size), spacing))
        source = calibration.attrs["monochromator_fwhm_nm"] if lab is None else lab.width[step]
        reach = _REACH * float(np.hypot(camera_width, source)) / abs(spacing_at)
        curve_distance = np.linspace(-reach, reach, _POINTS)
        distance, counts = np.empty(0), np.empty(0)
        if lab is not None:
            raw = lab.frame(step)
            dark = lab.dark.at(float(lab.exposure[step]))
            net = linearity_of(calibration).net(raw, dark)
            if "flat_field" in calibration.variables:
                net = net * calibration["flat_field"].transpose(BAND, CROSS_TRACK).to_numpy()
            window = find_line(net, raw, deviant_darks(dark, lab.saturation), lab.saturation)
            if window is not None and column in window.columns:
                line = int(np.flatnonzero(window.columns == column)[0])
                is_finite = np.isfinite(window.values[line])
                distance, counts = window.places[line, is_finite], window.values[line, is_finite]
            is_near = np.abs(distance - centre) <= reach
            distance, counts = distance[is_near] - centre, counts[is_near]
        # profile of the lamp line at its centre, which has unit height, at the samples and along the curve
        place = np.concatenate([[0.0], distance, curve_distance])[None]
        own, lamp = (float(width) / abs(spacing_at) for width in (camera_width, source))
        shape = SHAPES[str(calibration.attrs["srf_shape"])]
        profile = line_profiles(place, own, lamp, shape, is_triangular)[0]
        profile = profile[1:] / profile[0]
        results.append(
            FittedLine(
                float(variables["step_wavelength"][step]),
                distance * spacing_at,
                counts,
                counts / amplitude - profile[: distance.size],
                curve_distance * spacing_at,
                amplitude * profile[distance.size :],
            )
        )
    return results


# --- calibrating -------------------------------------------------------------------------------------------

MIN_LINES = 4
#: Allowed decrease of the beam over the columns: in flux uncertainties, and minimum [1].
MAX_FALL_PER_U, MIN_FALL = 0.75, 0.01
#: Minimum full width of a lamp line for a fit of centre and width [band].
MIN_WIDTH_BANDS = 1.2


@takes_quantities(wavelength_uncertainty="nm")
@documented()
def calibrate(
    sweep: xr.Dataset,
    *,
    absolute: bool = True,
    srf_shape: str | None = None,
    flux_uncertainty: float = 0.04,
    capture_uncertainty: float = 0.0,
    etendue_uncertainty: float = 0.0,
    wavelength_uncertainty: float = 0.1,
    linearity: Sequence[float] | xr.DataArray | xr.Dataset = (),
    linearity_on: str = DARK_SUBTRACTED,
    linearity_uncertainty: float = 0.0,
    flat_field: xr.DataArray | None = None,
    bad_elements: xr.DataArray | None = None,
    smile_degree: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> xr.Dataset:
    """Return the calibration of a camera from a monochromator sweep.

    Parameters
    ----------
    sweep
        Means of the frames of every step, dark not subtracted; the rows of
        `hyperpaint.base.schema.SWEEP_VARIABLES`. ``counts`` (step, band, cross_track), ``dark_counts``
        ([step,] band, cross_track) [count], ``step_wavelength`` (step), ``monochromator_fwhm`` [nm],
        ``exposure_time`` [s], ``flux`` [W] of the whole beam, ``capture_fraction`` [1] and ``etendue`` [m2
        sr]. ``flux`` per step is assumed equal in all lit columns, so that column differences are response;
        per step and column it is the flux of each column, not needed for unlit columns. Optional:
        ``counts_variance``, ``frame_count``, ``dark_frame_count``, ``dark_exposure_time``,
        ``saturation_count``, ``electrons_per_count``, ``read_noise``. Attribute
        ``monochromator_shape``: "gaussian" or "triangle". Lazy variables are read one step at a time.
    absolute
        False where capture fraction or etendue are unknown: the gain then has a relative
        scale only; `hyperpaint.calibration.anchor_to_radiance` sets the absolute scale.
    srf_shape
        "gaussian" or "slit"; None for the shape that fits the lamp lines better.
    flux_uncertainty, capture_uncertainty, etendue_uncertainty
        Relative standard uncertainties; 3 to 5 % is typical of power meters without a certificate.
    wavelength_uncertainty
        Standard uncertainty of the monochromator's dial [nm], which all lamp lines share.
    linearity
        Coefficients of `hyperpaint.calibration.linearity`; or a table: counts proportional to light over a
        coordinate ``linearity_counts`` of measured counts, linear between its nodes; or a Dataset of that
        table as ``linear_counts``, and of ``linearity_basis`` (linearity_term, linearity_counts) and
        ``linearity_map`` (linearity_term, band, cross_track) [1], by which elements differ. () for none. It
        is stored with the calibration; `radiance` and `reflectance` apply it to the counts of every flight.
    linearity_on
        "dark-subtracted": linear counts are L(C - D), with L the curve; "raw": L(C) - L(D).
    linearity_uncertainty
        Relative standard uncertainty of linear counts after the correction, at any level.
    flat_field
        Result of `hyperpaint.calibration.flat_field`: the gains of a band then have its column differences.
        Without it the gains follow the smooth fits, and differences of elements are in their random
        uncertainty.
    bad_elements
        (band, cross_track) bool: elements to leave out, in addition to those found in the sweep.
    smile_degree
        Degree over columns of the wavelength map; None for the lowest that the lamp lines need.
    progress

    Returns
    -------
    xarray.Dataset
        In memory: ``radiance_gain`` (band, cross_track), NaN where it would be extrapolated or the element
        is bad, with its uncertainties; coordinates ``wavelength``, ``fwhm``, ``good`` (band),
        ``wavelength_shift``; the dark; ``responsivity``; ``stray_light``, which `hyperpaint.reflectance`
        subtracts, with its uncertainty; and the fitted lamp lines. Attributes name the choices.

    Raises
    ------
    SchemaError
        The sweep cannot be calibrated; all problems are listed. One of them: the distance of bands exceeds
        the width of lamp lines in them, so that light between bands is not counted.

    Warns
    -----
    PaintWarning
        Steps were left out; the monochromator's line is too wide to determine the camera's width; the beam's
        profile enters the response; columns are not lit; lamp lines look clipped; the dark has an offset; the
        noise is unknown; the response fits neither model and cannot be tabulated; areas do not follow the
        responsivity, as with fringes.

    Notes
    -----
    ``radiance_gain = 1 / (spacing x etendue x R)`` with ``R = area / (exposure_time x flux x
    capture_fraction)`` at the lamp lines, dark-subtracted counts summed over bands, interpolated over
    wavelength: the line-area method, which needs neither the width nor the shape of lamp line and response.
    Width and shape come from fits of offset + area x profile, where the profile is the monochromator's line
    convolved with the camera's response. Where all lamp lines together show another response than the better
    model, such as an asymmetric one, ``srf_shape`` is ``"tabulated"``, ``srf`` (band, srf_offset) the
    measured response, and ``wavelength`` the centre of the better model fitted to it.

    Examples
    --------
    >>> from hyperpaint.simulation import simulate_sweep
    >>> sweep = simulate_sweep(steps=31, bands=136, columns=4, noise=False, quantise=False, nonuniformity=0)
    >>> made = calibrate(sweep)
    >>> error = made.radiance_gain / sweep.true_radiance_gain - 1
    >>> bool(abs(error.isel(band=slice(20, 116))).max() < 2e-3), made.srf_shape
    (True, 'gaussian')
    """
    SchemaError.raise_if(
        not isinstance(sweep, xr.Dataset),
        f"sweep is {type(sweep).__name__}",
        expected="a Dataset",
        mend="open its store with xarray.open_zarr",
        code="type-wrong",
    )
    if srf_shape is not None:
        one_of(srf_shape, SHAPES, "srf_shape")
    _check_uncertainties(
        flux_uncertainty=flux_uncertainty,
        capture_uncertainty=capture_uncertainty,
        etendue_uncertainty=etendue_uncertainty,
        linearity_uncertainty=linearity_uncertainty,
    )
    lab = check_sweep(sweep, absolute=absolute)
    total, done = lab.shape[0] * (3 if srf_shape else 4), itertools.count(1)

    def tick() -> None:
        if progress is not None:
            progress(next(done), total)

    # elements (band, cross_track) that are bad before any lamp line is fitted
    bad = deviant_darks(lab.dark.at(float(lab.exposure.min())), lab.saturation)
    if bad_elements is not None:
        bad = bad | on_elements(bad_elements, lab.counts, "bad_elements").to_numpy().astype(bool)
    refuse_if(bad.all(), "no element has a finite dark that is not saturated", code="dark-invalid")
    flat_factors = (
        None
        if flat_field is None
        else on_elements(flat_field, lab.counts, "flat_field").to_numpy().astype(np.float64)
    )
    # the linearity curve of the arguments
    with Problems("linearity= cannot be applied", SchemaError) as problems:
        if isinstance(linearity, xr.DataArray):
            SchemaError.raise_if(
                linearity.dims != ("linearity_counts",) or "linearity_counts" not in linearity.coords,
                f"the table linearity= has dims {tuple(map(str, linearity.dims))}",
                expected="one, linearity_counts, with a coordinate of measured counts",
                code="dims-wrong",
            )
            table = xr.Dataset({"linear_counts": label(linearity, "linear_counts")})
            table["linearity_counts"] = label(
                table["linearity_counts"].astype(np.float64), "linearity_counts"
            )
            curve = linearity_of(table.assign_attrs(linearity_on=linearity_on))
        elif isinstance(linearity, xr.Dataset):
            curve = linearity_of(linearity.assign_attrs(linearity_on=linearity_on))
            problems.add_if(
                curve.basis is not None and curve.weights.shape[1:] != lab.shape[1:],
                f"'linearity_map' has shape {np.shape(curve.weights)}",
                expected=f"(linearity_term, band, cross_track), the last two {lab.shape[1:]}",
                code="length-mismatch",
            )
        else:
            curve = linearity_of(xr.Dataset(attrs={"linearity": linearity, "linearity_on": linearity_on}))
        curve.check(problems, np.inf if lab.saturation is None else float(np.max(lab.saturation)))
    # first fits: centres of lamp lines, and a rough wavelength map
    sweep_data = read_lines(lab, bad, curve, flat_factors, tick)
    windows = sweep_data.windows
    dark = [float(w) for w, window in zip(lab.wavelength, windows, strict=True) if window is None]
    refuse_if(
        len(dark) > len(windows) - MIN_LINES,
        f"no lamp line above noise at {len(dark)} of {len(windows)} steps ({listed(dark, 'nm')})",
        mend="check the exposure of the dark, and the lamp",
        code="steps-dark",
    )
    warn_if(dark, f"no lamp line above the noise at {listed(dark, 'nm')}: left out", "steps-dark")
    first_lines, fits = fit_steps(lab, sweep_data, GAUSSIAN, tick)
    _check_trusted(sweep_data, first_lines, fits)
    rough_map = _map(first_lines, lab, lab.wavelength, smile_degree)
    # fits with every line shape; the best shape is fitted again without deviant elements
    shapes = {name: code for name, code in SHAPES.items() if srf_shape in (None, name)}
    by_shape = {
        name: fit_steps(lab, sweep_data, code, tick, (rough_map, fits))[0] for name, code in shapes.items()
    }
    common = np.logical_and.reduce([lines.trusted for lines in by_shape.values()])
    misfit = {
        name: float(np.log(np.maximum(lines.chi2[common] / lines.degrees[common], 1e-12)).mean())
        if common.any()
        else 0.0
        for name, lines in by_shape.items()
    }
    shape = min(misfit, key=lambda name: misfit[name])
    lamp_lines = by_shape[shape]
    is_deviant = deviant_elements(lab, sweep_data, lamp_lines, rough_map, SHAPES[shape])
    if is_deviant.any():
        bad |= is_deviant
        for window in windows:
            if window is not None:
                window.leave_out(bad)
        lamp_lines, _ = fit_steps(lab, sweep_data, SHAPES[shape], lambda: None, (rough_map, fits))
    # deviations of elements, and where noise is unknown the noise, with which lamp lines are fitted again
    has_noise = sweep_data.noise_source != FROM_SCATTER
    differences, noise_slope = element_differences(
        lab, sweep_data, lamp_lines, rough_map, SHAPES[shape], has_noise=has_noise
    )
    if not has_noise:
        warn_if(
            lab.variance is None,
            "neither counts_variance nor electrons_per_count is given: noise is estimated from residuals "
            "of the fits, and uncertainties of single elements are rough",
            "noise-missing",
        )
        sweep_data = replace(
            sweep_data, noise=replace(sweep_data.noise, slope=noise_slope * float(np.median(lab.frames)))
        )
        lamp_lines, _ = fit_steps(lab, sweep_data, SHAPES[shape], lambda: None, (rough_map, fits))
    saturated_steps = [
        f"{w:g} nm ({int(window.saturated.sum())} of {window.saturated.size} lit columns)"
        for w, window in zip(lab.wavelength, windows, strict=True)
        if window is not None and window.saturated.any()
    ]
    warn_if(
        saturated_steps, f"saturated lamp lines are left out: {listed(saturated_steps)}", "steps-saturated"
    )
    # wavelength map, widths of bands, and lamp lines cut off at the edges of the array
    slope, slope_shift = _slope_and_shift(lamp_lines, lab, sweep_data.noise, rough_map, shape)
    light_wavelength = lab.wavelength + slope_shift
    wavelength_map = _map(lamp_lines, lab, light_wavelength, smile_degree)
    is_placed = placed_lines(lab, lamp_lines, wavelength_map, slope_shift)
    if not lab.by_column and flat_factors is None:
        problem = beam_problem(
            lab.wavelength,
            np.where(is_placed, lamp_lines.area, np.nan),
            max(MAX_FALL_PER_U * flux_uncertainty, MIN_FALL),
        )
        warn_if(
            problem is not None,
            f"flux per step is assumed equal in all lit columns, but {problem}: the beam's profile "
            "enters the response; give flux or capture_fraction per step and column, or a flat_field",
            "flux-profile-missing",
        )
    fwhm = band_widths(lab, lamp_lines, wavelength_map, is_placed)
    # Light between bands farther apart than lamp lines are wide is not counted: the area of a lamp line,
    # counts summed over bands, depends on its position between bands. For Gaussian lamp lines the sum ripples
    # by 2 exp(-2 pi^2 s^2), s the standard deviation in bands: by 6 % at a full width of one band, some 1 %
    # in the mean of steps, and by 20 % at 0.8.
    spacing = wavelength_map.spacing(np.arange(lab.shape[1]), lab.shape[2] // 2)
    monochromator = float(np.median(lab.width))
    band_distance, band_width = float(np.median(spacing)), float(np.median(fwhm))
    needed_width = np.sqrt(max(band_distance**2 - band_width**2, 0.0))
    refuse_if(
        not float(np.median(np.hypot(fwhm, monochromator) / spacing)) >= 1.0,
        f"bands {band_distance:.3g} nm apart and {band_width:.2g} nm wide do not count the light between "
        f"them, of lamp lines {monochromator:.2g} nm wide",
        expected="bands that overlap",
        mend="sweep with the monochromator's line widened to "
        f"{1.2 * max(needed_width, band_distance):.2g} nm",
        code="bands-undersampled",
    )
    camera_width = at_steps(lab, wavelength_map, fwhm)
    complete_edge_lines(lab, sweep_data, lamp_lines, wavelength_map, light_wavelength, camera_width, shape)
    return Result(
        lab=lab,
        sweep_data=sweep_data,
        lamp_lines=lamp_lines,
        wavelength_map=wavelength_map,
        line_slope=slope,
        slope_shift=slope_shift,
        shape=shape,
        misfit=misfit,
        bad=bad,
        scale_u={
            "flux_uncertainty": flux_uncertainty,
            "capture_uncertainty": capture_uncertainty,
            "etendue_uncertainty": etendue_uncertainty,
        },
        dial_u=wavelength_uncertainty,
        linearity_u=linearity_uncertainty,
        linearity=curve,
        is_placed=is_placed,
        fwhm=fwhm,
        fwhm_at_steps=camera_width,
        differences=differences,
        is_shape_free=srf_shape is None,
    ).dataset(flat_factors)


def _check_trusted(sweep_data: SweepData, lamp_lines: LampLines, fits: Sequence[Fits | None]) -> None:
    trusted = int(lamp_lines.trusted.any(axis=1).sum())
    pairs = [(w, f) for w, f in zip(sweep_data.windows, fits, strict=True) if w is not None and f is not None]
    total = sum(window.columns.size for window, _ in pairs)
    n_saturated = sum(int(window.saturated.sum()) for window, _ in pairs)
    width = float(np.nanmedian(np.concatenate([fit.width for _, fit in pairs])))
    failed = sum(int((~fit.converged & ~window.saturated).sum()) for window, fit in pairs)
    reasons = (
        [f"shorten the exposure: {n_saturated} of {total} lamp lines are saturated"] if n_saturated else []
    )
    if width < MIN_WIDTH_BANDS or failed > 0.5 * total:
        reasons.append(
            f"widen the monochromator's line: {failed} of {total} fits fail, of lamp lines {width:.2g} bands "
            "wide, narrower than the spacing of bands"
        )
    refuse_if(
        trusted < MIN_LINES,
        f"{trusted} steps have reliable lamp lines",
        expected=f"{MIN_LINES} or more",
        mend="; ".join(reasons or ["give more steps: the rest lie at the edge of the array"]),
        code="lamp-lines-few",
    )


def _map(lamp_lines: LampLines, lab: LabSweep, wavelength: Floats, degree: int | None) -> WavelengthMap:
    # Fit the wavelength map through the reliable lamp lines at the wavelengths (step,) of their light.
    step, column = np.nonzero(lamp_lines.trusted)
    return fit_wavelength_map(
        lamp_lines.centre[step, column],
        column.astype(np.float64),
        wavelength[step],
        lab.shape[1:],
        column_degree=degree,
        uncertainty=lamp_lines.centre_u[step, column],
    )


def _slope_and_shift(
    lamp_lines: LampLines, lab: LabSweep, noise: NoiseModel, rough_map: WavelengthMap, shape: str
) -> tuple[Floats, Floats]:
    # Return the slope of the log responsivity (step,) [nm-1] and the shift of lamp lines by it [nm].
    lit_steps = np.flatnonzero(lamp_lines.trusted.any(axis=1))
    spacing = rough_map.spacing(np.nan_to_num(lamp_lines.centre), np.arange(lab.shape[2]))
    level = row_medians(responses_of_lines(lamp_lines, lab, spacing), lamp_lines.trusted)
    if lit_steps.size < MIN_LINES or not (level[lit_steps] > 0).all():
        return np.zeros(lab.shape[0]), np.zeros(lab.shape[0])
    lit_wavelength = lab.wavelength[lit_steps]

    slope = np.interp(lab.wavelength, lit_wavelength, np.gradient(np.log(level[lit_steps]), lit_wavelength))
    width, pitch, amplitude = (
        np.interp(lab.wavelength, lit_wavelength, row_medians(values, lamp_lines.trusted)[lit_steps])
        for values in (lamp_lines.camera_width * spacing, spacing, lamp_lines.amplitude)
    )
    return slope, slope_shift_of_lines(lab, noise, slope, width, pitch, amplitude, shape)


BEAM = SimpleNamespace(
    #: Degree of a beam's log profile over the columns.
    degree=4,
    #: A decrease must exceed this number of standard deviations of noise and element differences.
    sds=4.5,
    #: Allowed change of a profile from step to step, relative to the tolerance [1].
    max_change_share=1.0 / 3.0,
)


def beam_problem(wavelength: Floats, areas: Floats, tolerance: float) -> str | None:
    # Return a description of the fault if a beam lights the columns unevenly; None for an even beam.
    #
    # ``areas`` (step, cross_track) of the fitted lamp lines [count], without dead elements, NaN without a
    # lamp line; ``wavelength`` (step,) [nm]; ``tolerance`` is the allowed relative decrease over the columns.
    count = np.isfinite(areas).sum(axis=1)
    steps = np.flatnonzero(count >= max(4.0, 0.5 * count.max()))
    if steps.size < 4:
        return None
    level, uncertainty = _profiles(areas[steps])
    decrease = np.nanmax(level, axis=1) - np.nanmin(level, axis=1)
    significant_decrease = decrease - BEAM.sds * np.sqrt(2.0) * np.nanmax(uncertainty, axis=1)
    mean = np.nanmean(level, axis=0)
    mean_spread = np.nanmax(uncertainty / np.sqrt(np.isfinite(level).sum(axis=0)))
    if (
        np.ptp(mean) - BEAM.sds * np.sqrt(2.0) * mean_spread > tolerance
        or significant_decrease.max() > tolerance
    ):
        worst = int(np.argmax(significant_decrease))
        at = wavelength[steps[worst]]
        return f"lamp lines fall by {1.0 - np.exp(-decrease[worst]):.1%} over the columns (at {at:g} nm)"
    changes = np.nanmean((level - mean) ** 2, axis=0)
    noise = np.nanmean(uncertainty**2, axis=0)
    column = int(np.argmax(changes - noise))
    if float(np.sqrt(max(changes[column] - 2.0 * noise[column], 0.0))) > BEAM.max_change_share * tolerance:
        share = float(np.sqrt(changes[column]))
        worst_column = int(np.flatnonzero(np.isfinite(areas[steps]).any(axis=0))[column])
        return f"the share of light of column {worst_column} varies by {share:.1%} from step to step"
    return None


def _profiles(areas: Floats) -> tuple[Floats, Floats]:
    lit_columns = np.flatnonzero(np.isfinite(areas).any(axis=0))
    level = np.full((len(areas), lit_columns.size), np.nan)
    uncertainty = level.copy()
    position = np.linspace(-1.0, 1.0, lit_columns.size)
    for row, area in enumerate(areas[:, lit_columns]):
        is_lit = np.isfinite(area) & (area > 0)
        degree = min(BEAM.degree, int(is_lit.sum()) // 4)
        terms = np.asarray(chebyshev.chebvander(position[is_lit], degree), np.float64)
        log_area = np.log(area[is_lit])
        inverse = np.linalg.pinv(terms)
        fitted = terms @ (inverse @ log_area)
        rms = float(np.sqrt(((log_area - fitted) ** 2).sum() / max(int(is_lit.sum()) - degree - 1, 1)))
        level[row, is_lit] = fitted - np.median(fitted)
        uncertainty[row, is_lit] = rms * np.sqrt(np.einsum("ij,ji->i", terms, inverse))
    return level, uncertainty
