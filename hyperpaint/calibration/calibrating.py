"""`calibrate`: all steps from a lab sweep to a calibration, in order, with the checks between them."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import xarray as xr
from numpy.polynomial import chebyshev

from hyperpaint.base.errors import Problems, SchemaError, warn_user
from hyperpaint.base.facts import documented, one_of, takes_quantities
from hyperpaint.base.schema import Bools, Floats, label
from hyperpaint.kernels.line_fits import GAUSSIAN
from hyperpaint.radiometry.linear_counts import DARK_SUBTRACTED, Linearity, linearity_of

from .calibration_dataset import Result, responses_of_lines
from .detector import deviant_darks, element_values, row_medians
from .elements import (
    FROM_SCATTER,
    LampLines,
    SweepData,
    at_steps,
    band_widths,
    complete_edge_lines,
    deviant_elements,
    element_differences,
    fit_steps,
    placed_lines,
    read_lines,
    slope_shift_of_lines,
)
from .lab_sweep import LabSweep, check_sweep, listed, refused
from .line_fits import SHAPES, Fits, NoiseModel, WavelengthMap, fit_wavelength_map

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
    linearity: Sequence[float] | xr.DataArray = (),
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
        coordinate ``linearity_counts`` of measured counts, linear between its nodes. () for none. It is
        stored with the calibration, and `radiance` and `reflectance` apply it to the counts of every flight.
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
    lab = check_sweep(sweep, absolute=absolute)
    total, done = lab.shape[0] * (3 if srf_shape else 4), itertools.count(1)

    def tick() -> None:
        if progress is not None:
            progress(next(done), total)

    bad = _initial_bad_elements(lab, bad_elements)
    flat_factors = (
        None if flat_field is None else element_values(flat_field, bad.shape, "flat_field").astype(np.float64)
    )
    curve = _linearity_curve(linearity, linearity_on, lab)
    # first fits: centres of lamp lines, and a rough wavelength map
    sweep_data = read_lines(lab, bad, curve, flat_factors, tick)
    windows = sweep_data.windows
    dark = [float(w) for w, window in zip(lab.wavelength, windows, strict=True) if window is None]
    if len(dark) > len(windows) - MIN_LINES:
        raise refused(
            f"no lamp line above noise at {len(dark)} of {len(windows)} steps ({listed(dark, 'nm')})",
            mend="check the exposure of the dark, and the lamp",
            code="steps-dark",
        )
    if dark:
        warn_user(f"no lamp line above the noise at {listed(dark, 'nm')}: left out", "steps-dark")
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
        if lab.variance is None:
            warn_user(
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
    if saturated_steps:
        warn_user(f"saturated lamp lines are left out: {listed(saturated_steps)}", "steps-saturated")
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
        if problem is not None:
            warn_user(
                f"flux per step is assumed equal in all lit columns, but {problem}: the beam's profile "
                "enters the response; give flux or capture_fraction per step and column, or a flat_field",
                "flux-profile-missing",
            )
    fwhm = band_widths(lab, lamp_lines, wavelength_map, is_placed)
    _refuse_undersampled(lab, wavelength_map, fwhm)
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


def _linearity_curve(linearity: Sequence[float] | xr.DataArray, on: str, lab: LabSweep) -> Linearity:
    # Return the linearity curve of the arguments; SchemaError for an invalid one.
    problems = Problems("linearity= cannot be applied", SchemaError)
    if isinstance(linearity, xr.DataArray):
        SchemaError.raise_if(
            linearity.dims != ("linearity_counts",) or "linearity_counts" not in linearity.coords,
            f"the table linearity= has dims {tuple(map(str, linearity.dims))}",
            expected="one, linearity_counts, with a coordinate of measured counts",
            code="dims-wrong",
        )
        table = xr.Dataset({"linear_counts": label(linearity, "linear_counts")})
        table["linearity_counts"] = label(table["linearity_counts"].astype(np.float64), "linearity_counts")
        curve = linearity_of(table.assign_attrs(linearity_on=on))
    else:
        curve = linearity_of(xr.Dataset(attrs={"linearity": linearity, "linearity_on": on}))
    curve.check(problems, np.inf if lab.saturation is None else float(np.max(lab.saturation)))
    problems.raise_if_any()
    return curve


def _refuse_undersampled(lab: LabSweep, wavelength_map: WavelengthMap, fwhm: Floats) -> None:
    # Refuse bands farther apart than lamp lines are wide: light between such bands is not counted.
    #
    # The area of a lamp line, counts summed over bands, then depends on its position between bands: for
    # Gaussian lamp lines the sum ripples by 2 exp(-2 pi^2 s^2), s the standard deviation in bands: by 6 % at
    # a full width of one band, some 1 % in the mean of steps, and by 20 % at 0.8.
    spacing = wavelength_map.spacing(np.arange(lab.shape[1]), lab.shape[2] // 2)
    monochromator = float(np.median(lab.width))
    if float(np.median(np.hypot(fwhm, monochromator) / spacing)) >= 1.0:
        return
    distance, width = float(np.median(spacing)), float(np.median(fwhm))
    needed_width = np.sqrt(max(distance**2 - width**2, 0.0))
    raise refused(
        f"bands {distance:.3g} nm apart and {width:.2g} nm wide do not count the light between them, of lamp "
        f"lines {monochromator:.2g} nm wide",
        expected="bands that overlap",
        mend=f"sweep with the monochromator's line widened to {1.2 * max(needed_width, distance):.2g} nm",
        code="bands-undersampled",
    )


def _initial_bad_elements(lab: LabSweep, declared: xr.DataArray | None) -> Bools:
    # Return the elements (band, cross_track) that are bad before any lamp line is fitted.
    bad = deviant_darks(lab.dark.at(float(lab.exposure.min())), lab.saturation)
    if declared is not None:
        bad = bad | element_values(declared, bad.shape, "bad_elements").astype(bool)
    if bad.all():
        raise refused("no element has a finite dark that is not saturated", code="dark-invalid")
    return bad


def _check_trusted(sweep_data: SweepData, lamp_lines: LampLines, fits: Sequence[Fits | None]) -> None:
    trusted = int(lamp_lines.trusted.any(axis=1).sum())
    if trusted >= MIN_LINES:
        return
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
    raise refused(
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

    def over_steps(values: Floats) -> Floats:
        return np.interp(lab.wavelength, lit_wavelength, values)

    slope = over_steps(np.gradient(np.log(level[lit_steps]), lit_wavelength))
    width, pitch, amplitude = (
        over_steps(row_medians(values, lamp_lines.trusted)[lit_steps])
        for values in (lamp_lines.camera_width * spacing, spacing, lamp_lines.amplitude)
    )
    return slope, slope_shift_of_lines(lab, noise, slope, width, pitch, amplitude, shape)


#: Degree of a beam's log profile over the columns.
BEAM_DEGREE = 4
#: A decrease must exceed this number of standard deviations of noise and element differences.
BEAM_SDS = 4.5
#: Allowed change of a profile from step to step, relative to the tolerance [1].
MAX_CHANGE_SHARE = 1.0 / 3.0


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
    significant_decrease = decrease - BEAM_SDS * np.sqrt(2.0) * np.nanmax(uncertainty, axis=1)
    mean = np.nanmean(level, axis=0)
    mean_spread = np.nanmax(uncertainty / np.sqrt(np.isfinite(level).sum(axis=0)))
    if (
        np.ptp(mean) - BEAM_SDS * np.sqrt(2.0) * mean_spread > tolerance
        or significant_decrease.max() > tolerance
    ):
        worst = int(np.argmax(significant_decrease))
        at = wavelength[steps[worst]]
        return f"lamp lines fall by {1.0 - np.exp(-decrease[worst]):.1%} over the columns (at {at:g} nm)"
    changes = np.nanmean((level - mean) ** 2, axis=0)
    noise = np.nanmean(uncertainty**2, axis=0)
    column = int(np.argmax(changes - noise))
    if float(np.sqrt(max(changes[column] - 2.0 * noise[column], 0.0))) > MAX_CHANGE_SHARE * tolerance:
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
        degree = min(BEAM_DEGREE, int(is_lit.sum()) // 4)
        terms = np.asarray(chebyshev.chebvander(position[is_lit], degree), np.float64)
        log_area = np.log(area[is_lit])
        inverse = np.linalg.pinv(terms)
        fitted = terms @ (inverse @ log_area)
        rms = float(np.sqrt(((log_area - fitted) ** 2).sum() / max(int(is_lit.sum()) - degree - 1, 1)))
        level[row, is_lit] = fitted - np.median(fitted)
        uncertainty[row, is_lit] = rms * np.sqrt(np.einsum("ij,ji->i", terms, inverse))
    return level, uncertainty
