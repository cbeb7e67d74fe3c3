"""`calibrate`: all steps from a lab sweep to a calibration, in order, with the checks between them."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import xarray as xr
from numpy.polynomial import chebyshev

from hyperpaint.base.arrays import Bools, Floats
from hyperpaint.base.errors import PaintWarning, Problems, SchemaError
from hyperpaint.base.facts import documented
from hyperpaint.base.schema import BAND, CROSS_TRACK, label
from hyperpaint.base.units import takes_quantities
from hyperpaint.radiometry.linear_counts import DARK_SUBTRACTED, Linearity, linearity_of

from .calibration_dataset import Budget, Result, line_level
from .detector import deviant_darks, factors_of, row_medians
from .elements import (
    Differences,
    at_steps,
    band_widths,
    complete_edge_lines,
    deviant_elements,
    element_differences,
    placed_lines,
)
from .lab_sweep import LabSweep, check_sweep, listed, refused
from .line_fits import SHAPES, Fits
from .responsivity import line_pull
from .steps import FROM_SCATTER, Lines, Read, fit_as_seen, fit_through, read_lines
from .wavelength_map import WavelengthMap, fit_wavelength_map

MIN_LINES = 4
#: Allowed fall of the beam over the columns: in flux uncertainties, and at least [1].
MAX_FALL_PER_U, MIN_FALL = 0.75, 0.01
#: Full width in bands below which place and width of a lamp line are not determined.
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
        sr]. ``flux`` per step is equal in all lit columns, so that column differences are response;
        per step and column it is the flux of each column, and unlit ones need none. Optional:
        ``counts_variance``, ``frame_count``, ``dark_frame_count``, ``dark_exposure_time``,
        ``saturation_count``, ``electrons_per_count``, ``read_noise``. Attribute
        ``monochromator_shape``: "gaussian" or "triangle". Lazy variables are read one step at a time.
    absolute
        False where capture fraction or etendue are unknown: the gain then has the right shape and no
        scale, to be set by `hyperpaint.calibration.anchor_to_radiance`.
    srf_shape
        "gaussian" or "slit"; None for the one that fits the lamp lines better.
    flux_uncertainty, capture_uncertainty, etendue_uncertainty
        Relative standard uncertainties; 3 to 5 % is typical of power meters without a certificate.
    wavelength_uncertainty
        Standard uncertainty of the monochromator's dial [nm], which all lamp lines share.
    linearity
        Coefficients of `hyperpaint.calibration.linearity`; or a table: counts proportional to light over a
        coordinate ``linearity_counts`` of measured ones, straight between its nodes. () for none. It is
        stored with the calibration, and `radiance` and `reflectance` apply it to the counts of every flight.
    linearity_on
        "dark-subtracted": linear counts are L(C - D), with L the curve; "raw": L(C) - L(D).
    linearity_uncertainty
        Relative standard uncertainty of linear counts after the correction, at any level.
    flat_field
        Of `hyperpaint.calibration.flat_field`: the gains of a band then have its column differences. Without
        it the gains follow the smooth fits, and differences of elements are in their random uncertainty.
    bad_elements
        (band, cross_track) bool: elements to leave out, besides those that the sweep shows to be bad.
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
        The sweep cannot be calibrated; all problems are listed. Among them: bands lie further apart than the
        lamp lines in them are wide, so that light between bands is not counted.

    Warns
    -----
    PaintWarning
        Steps were left out; the monochromator's line is too wide to determine the camera's; the beam's own
        profile counts as response; columns are not lit; lamp lines look clipped; the dark is off; the noise
        is unknown; the response fits neither model, and no table of it can be made; steps do not follow the
        responsivity, as of fringes.

    Notes
    -----
    ``radiance_gain = 1 / (spacing x etendue x R)`` with ``R = area / (exposure_time x flux x
    capture_fraction)`` at the lamp lines, dark-subtracted counts summed over bands, interpolated over
    wavelength: the line-area method, which needs neither the width nor the shape of lamp line and response.
    Width and shape come from fits of offset + area x profile, the profile being the monochromator's line
    convolved with the camera's. Where all lamp lines together show another response than the better model,
    such as a lopsided one, ``srf_shape`` is ``"tabulated"``, ``srf`` (band, srf_offset) the measured
    response, and ``wavelength`` is the centre of the better model on it.

    Examples
    --------
    >>> from hyperpaint.simulation import simulate_sweep
    >>> sweep = simulate_sweep(steps=31, bands=136, columns=4, noise=False, quantise=False, nonuniformity=0)
    >>> made = calibrate(sweep)
    >>> error = made.radiance_gain / sweep.true_radiance_gain - 1
    >>> bool(abs(error.isel(band=slice(20, 116))).max() < 2e-3), made.srf_shape
    (True, 'gaussian')
    """
    if not isinstance(sweep, xr.Dataset):
        raise SchemaError(
            f"sweep is {type(sweep).__name__}",
            expected="a Dataset",
            mend="open its store with xarray.open_zarr",
            code="type-wrong",
        )
    if srf_shape is not None and srf_shape not in SHAPES:
        raise SchemaError(
            f"srf_shape {srf_shape!r}", expected=f"one of {', '.join(SHAPES)}, or None", code="choice-unknown"
        )
    lab = check_sweep(sweep, absolute=absolute)
    tick = _counter(progress, lab.shape[0] * (3 if srf_shape else 4))
    bad = _bad_at_the_door(lab, bad_elements)
    flat = None if flat_field is None else factors_of(flat_field, bad.shape)
    curve = _curve(linearity, linearity_on, lab)
    # first fits give places, and a rough wavelength map
    read = read_lines(lab, bad, curve, flat, tick)
    _check_lines(lab, read)
    first, fits = fit_as_seen(lab, read, tick)
    _need_trusted(read, first, fits)
    rough = _map(first, lab, lab.wavelength, smile_degree)
    # fits of every line model, of which the best is used, without deviant elements
    shapes = {name: code for name, code in SHAPES.items() if srf_shape in (None, name)}
    by_shape = {name: fit_through(lab, read, rough, code, fits, tick) for name, code in shapes.items()}
    misfit = _misfits(by_shape)
    shape = min(misfit, key=lambda name: misfit[name])
    lines = by_shape[shape]
    dead = deviant_elements(lab, read, lines, rough, SHAPES[shape])
    if dead.any():
        bad |= dead
        for window in read.windows:
            if window is not None:
                window.leave_out(bad)
        lines = fit_through(lab, read, rough, SHAPES[shape], fits, lambda: None)
    read, lines, differences = _with_differences(lab, read, lines, rough, SHAPES[shape], fits)
    _warn_of_saturation(lab, read)
    # wavelength map, widths of bands, and lines cut off by the edges
    surface, slope, pull = _map_through(lines, lab, read, rough, shape, smile_degree)
    placed = placed_lines(lab, lines, surface, pull)
    if not lab.by_column and flat is None:
        areas = np.where(placed, lines.area, np.nan)
        problem = beam_problem(lab.wavelength, areas, max(MAX_FALL_PER_U * flux_uncertainty, MIN_FALL))
        if problem is not None:
            warning = PaintWarning(
                f"flux per step is assumed equal in all lit columns, but {problem}: the beam's own profile "
                "counts as response; give flux or capture_fraction per step and cross_track, or a flat_field",
                code="flux-profile-missing",
            )
            warnings.warn(warning, stacklevel=2)
    fwhm = band_widths(lab, lines, surface, placed)
    _refuse_undersampled(lab, surface, fwhm)
    light, own = lab.wavelength + pull, at_steps(lab, surface, fwhm)
    complete_edge_lines(lab, read, lines, surface, light, own, shape)
    budget = Budget(
        flux_uncertainty,
        capture_uncertainty,
        etendue_uncertainty,
        wavelength_uncertainty,
        linearity_uncertainty,
    )
    result = Result(
        lab,
        read,
        lines,
        surface,
        slope,
        pull,
        shape,
        misfit,
        bad,
        budget,
        curve,
        placed,
        fwhm,
        differences.relative,
        srf_shape is None,
    )
    return result.dataset(flat)


def _curve(linearity: Sequence[float] | xr.DataArray, on: str, lab: LabSweep) -> Linearity:
    # Linearity curve of the arguments; SchemaError for an invalid one
    problems = Problems("linearity= cannot be applied", SchemaError)
    if isinstance(linearity, xr.DataArray):
        if linearity.dims != ("linearity_counts",) or "linearity_counts" not in linearity.coords:
            raise SchemaError(
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


def _with_differences(
    lab: LabSweep, read: Read, lines: Lines, surface: WavelengthMap, shape: int, fits: list[Fits | None]
) -> tuple[Read, Lines, Differences]:
    is_noise_known = read.noise_source != FROM_SCATTER
    differences = element_differences(lab, read, lines, surface, shape, known_noise=is_noise_known)
    if is_noise_known:
        return read, lines, differences
    if lab.variance is None:
        warnings.warn(
            PaintWarning(
                "neither counts_variance nor electrons_per_count is given: noise is estimated from residuals "
                "of the fits, and uncertainties of single elements are rough",
                code="noise-missing",
            ),
            stacklevel=3,
        )
    noise = replace(read.noise, slope=differences.slope * float(np.median(lab.frames)))
    read = replace(read, noise=noise)
    return read, fit_through(lab, read, surface, shape, fits, lambda: None), differences


def _refuse_undersampled(lab: LabSweep, surface: WavelengthMap, fwhm: Floats) -> None:
    """Refuse bands further apart than the lamp lines in them are wide: light between bands is not counted.

    The area of a lamp line, counts summed over bands, is then not its light times the response: for Gaussian
    lines the sum ripples by 2 exp(-2 pi^2 s^2) with their place, s the standard deviation in bands: by 6 % at
    a full width of one band, some 1 % in the mean of steps, and by 20 % at 0.8.
    """
    spacing = surface.spacing(np.arange(lab.shape[1]), lab.shape[2] // 2)
    monochromator = float(np.median(lab.width))
    if float(np.median(np.hypot(fwhm, monochromator) / spacing)) >= 1.0:
        return
    apart, width = float(np.median(spacing)), float(np.median(fwhm))
    wide = np.sqrt(max(apart**2 - width**2, 0.0))
    raise refused(
        f"bands {apart:.3g} nm apart and {width:.2g} nm wide do not count the light between them, of lamp "
        f"lines {monochromator:.2g} nm wide",
        expected="bands that overlap",
        mend=f"sweep with the monochromator's line widened to {1.2 * max(wide, apart):.2g} nm",
        code="bands-undersampled",
    )


def _counter(progress: Callable[[int, int], None] | None, total: int) -> Callable[[], None]:
    done = itertools.count(1)

    def tick() -> None:
        if progress is not None:
            progress(next(done), total)

    return tick


def _bad_at_the_door(lab: LabSweep, declared: xr.DataArray | None) -> Bools:
    # Elements (band, cross_track) that are bad before any lamp line is fitted
    bad = deviant_darks(lab.dark.at(float(lab.exposure.min())), lab.saturation)
    if declared is not None:
        is_whole = set(declared.dims) == {BAND, CROSS_TRACK}
        if not is_whole or declared.transpose(BAND, CROSS_TRACK).shape != bad.shape:
            raise SchemaError(
                f"bad_elements has sizes {dict(declared.sizes)}",
                expected=f"{BAND} and {CROSS_TRACK} of {bad.shape}",
                code="grid-mismatch",
            )
        bad = bad | declared.transpose(BAND, CROSS_TRACK).to_numpy().astype(bool)
    if bad.all():
        raise refused("no element has a finite dark that is not saturated", code="dark-invalid")
    return bad


def _check_lines(lab: LabSweep, read: Read) -> None:
    dark = [float(w) for w, window in zip(lab.wavelength, read.windows, strict=True) if window is None]
    if len(dark) > len(read.windows) - MIN_LINES:
        raise refused(
            f"no lamp line above noise at {len(dark)} of {len(read.windows)} steps ({listed(dark, 'nm')})",
            mend="check the exposure of the dark, and the lamp",
            code="steps-dark",
        )
    if dark:
        warnings.warn(
            PaintWarning(
                f"no lamp line above the noise at {listed(dark, 'nm')}: left out", code="steps-dark"
            ),
            stacklevel=3,
        )


def _need_trusted(read: Read, lines: Lines, fits: Sequence[Fits | None]) -> None:
    trusted = int(lines.trusted.any(axis=1).sum())
    if trusted >= MIN_LINES:
        return
    pairs = [(w, f) for w, f in zip(read.windows, fits, strict=True) if w is not None and f is not None]
    total = sum(window.columns.size for window, _ in pairs)
    full = sum(int(window.saturated.sum()) for window, _ in pairs)
    width = float(np.nanmedian(np.concatenate([fit.width for _, fit in pairs])))
    lost = sum(int((~fit.converged & ~window.saturated).sum()) for window, fit in pairs)
    reasons = [f"shorten the exposure: {full} of {total} lamp lines are saturated"] if full else []
    if width < MIN_WIDTH_BANDS or lost > 0.5 * total:
        reasons.append(
            f"widen the monochromator's line: {lost} of {total} fits fail, of lamp lines {width:.2g} bands "
            "wide, narrower than the spacing of bands"
        )
    raise refused(
        f"{trusted} steps have reliable lamp lines",
        expected=f"{MIN_LINES} or more",
        mend="; ".join(reasons or ["give more steps: the others lie at the edge of the array"]),
        code="lamp-lines-few",
    )


def _map(lines: Lines, lab: LabSweep, wavelength: Floats, degree: int | None) -> WavelengthMap:
    # Wavelength map through the reliable lamp lines at the wavelengths (step,) of their light
    step, column = np.nonzero(lines.trusted)
    return fit_wavelength_map(
        lines.centre[step, column],
        column.astype(np.float64),
        wavelength[step],
        lab.shape[1:],
        column_degree=degree,
        uncertainty=lines.centre_u[step, column],
    )


def _misfits(by_shape: Mapping[str, Lines]) -> dict[str, float]:
    common = np.logical_and.reduce([lines.trusted for lines in by_shape.values()])
    if not common.any():
        return dict.fromkeys(by_shape, 0.0)
    return {
        name: float(np.log(np.maximum(lines.chi2[common] / lines.degrees[common], 1e-12)).mean())
        for name, lines in by_shape.items()
    }


def _warn_of_saturation(lab: LabSweep, read: Read) -> None:
    full = [
        f"{w:g} nm ({int(window.saturated.sum())} of {window.saturated.size} lit columns)"
        for w, window in zip(lab.wavelength, read.windows, strict=True)
        if window is not None and window.saturated.any()
    ]
    if full:
        warnings.warn(
            PaintWarning(f"saturated lamp lines are left out: {listed(full)}", code="steps-saturated"),
            stacklevel=3,
        )


def _map_through(
    lines: Lines, lab: LabSweep, read: Read, rough: WavelengthMap, shape: str, degree: int | None
) -> tuple[WavelengthMap, Floats, Floats]:
    # Wavelength map, the slope of the log responsivity [nm-1] and the pull [nm] at the steps
    nothing = np.zeros(lab.shape[0])
    lit_steps = np.flatnonzero(lines.trusted.any(axis=1))
    level = line_level(lines, lab, rough)
    if lit_steps.size < MIN_LINES or not (level[lit_steps] > 0).all():
        return _map(lines, lab, lab.wavelength, degree), nothing, nothing
    at = lab.wavelength[lit_steps]

    def at_all_steps(values: Floats) -> Floats:
        return np.interp(lab.wavelength, at, values)

    def middle(values: Floats) -> Floats:
        return at_all_steps(row_medians(values, lines.trusted)[lit_steps])

    slope = at_all_steps(np.gradient(np.log(level[lit_steps]), at))
    spacing = rough.spacing(np.nan_to_num(lines.centre), np.arange(lab.shape[2]))
    own = middle(lines.own_width * spacing)
    pull = line_pull(lab, read.noise, slope, own, middle(spacing), middle(lines.amplitude), shape)
    return _map(lines, lab, lab.wavelength + pull, degree), slope, pull


#: Degree of a beam's log profile over the columns.
BEAM_DEGREE = 4
#: Standard deviations of noise and of the elements' differences that a fall has to exceed.
BEAM_SDS = 4.5
#: Share of the tolerance by which a profile may change from step to step [1].
MAX_CHANGE_SHARE = 1.0 / 3.0


def beam_problem(wavelength: Floats, areas: Floats, tolerance: float) -> str | None:
    """Return a description of a beam that lights the columns unevenly; None for an even one.

    ``areas`` (step, cross_track) of the fitted lamp lines [count], to which dead elements contribute nothing,
    NaN without one; ``wavelength`` (step,) [nm]; ``tolerance`` is the allowed relative fall over the columns.
    """
    count = np.isfinite(areas).sum(axis=1)
    steps = np.flatnonzero(count >= max(4.0, 0.5 * count.max()))
    if steps.size < 4:
        return None
    level, spread = _profiles(areas[steps])
    fall = np.nanmax(level, axis=1) - np.nanmin(level, axis=1)
    sure = fall - BEAM_SDS * np.sqrt(2.0) * np.nanmax(spread, axis=1)
    mean = np.nanmean(level, axis=0)
    mean_spread = np.nanmax(spread / np.sqrt(np.isfinite(level).sum(axis=0)))
    if np.ptp(mean) - BEAM_SDS * np.sqrt(2.0) * mean_spread > tolerance or sure.max() > tolerance:
        worst = int(np.argmax(sure))
        at = wavelength[steps[worst]]
        return f"lamp lines fall by {1.0 - np.exp(-fall[worst]):.1%} over the columns (at {at:g} nm)"
    changes = np.nanmean((level - mean) ** 2, axis=0)
    noise = np.nanmean(spread**2, axis=0)
    column = int(np.argmax(changes - noise))
    excess = float(np.sqrt(max(changes[column] - 2.0 * noise[column], 0.0)))
    if excess > MAX_CHANGE_SHARE * tolerance:
        share = float(np.sqrt(changes[column]))
        where = int(np.flatnonzero(np.isfinite(areas[steps]).any(axis=0))[column])
        return f"the share of light of column {where} varies by {share:.1%} from step to step"
    return None


def _profiles(areas: Floats) -> tuple[Floats, Floats]:
    lit = np.flatnonzero(np.isfinite(areas).any(axis=0))
    level = np.full((len(areas), lit.size), np.nan)
    spread = level.copy()
    place = np.linspace(-1.0, 1.0, lit.size)
    for row, area in enumerate(areas[:, lit]):
        is_lit = np.isfinite(area) & (area > 0)
        degree = min(BEAM_DEGREE, int(is_lit.sum()) // 4)
        terms = np.asarray(chebyshev.chebvander(place[is_lit], degree), np.float64)
        log = np.log(area[is_lit])
        inverse = np.linalg.pinv(terms)
        fitted = terms @ (inverse @ log)
        free = max(int(is_lit.sum()) - degree - 1, 1)
        rms = float(np.sqrt(((log - fitted) ** 2).sum() / free))
        level[row, is_lit] = fitted - np.median(fitted)
        spread[row, is_lit] = rms * np.sqrt(np.einsum("ij,ji->i", terms, inverse))
    return level, spread
