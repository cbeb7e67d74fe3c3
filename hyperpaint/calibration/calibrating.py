"""`calibrate`: all steps from a lab sweep to a calibration, in order, with the checks between them."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.polynomial import chebyshev

from hyperpaint.base.arrays import Bools, Floats
from hyperpaint.base.errors import PaintWarning, Problems, SchemaError
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

_FEWEST = 4
_UNEVEN = 0.75  # of the flux's uncertainty: a fall over the columns that is let pass
_LEAST_UNEVEN = 0.01
_UNDERSAMPLED = 1.2  # full widths in bands, below which place and width of a line are not determined


@takes_quantities(wavelength_uncertainty="nm")
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
    r"""Return the calibration of a camera from a monochromator sweep.

    Parameters
    ----------
    sweep
        Means of the frames of every step, dark not subtracted; the rows of
        `hyperpaint.base.schema.SWEEP_VARIABLES`. ``counts`` (step, band, cross_track), ``dark_counts``
        ([step,] band, cross_track) [count], ``step_wavelength`` (step), ``monochromator_fwhm`` [nm],
        ``exposure_time`` [s], ``flux`` [W] of the whole beam, ``capture_fraction`` [1] and ``etendue`` [m2
        sr]. ``flux`` per step is taken as equal in all lit columns, so that column differences are response;
        per step and column it is what each column gets, and unlit ones need none. Optional:
        ``counts_variance``, ``frame_count``, ``dark_frame_count``, ``dark_exposure_time``,
        ``saturation_count``, ``electrons_per_count``, ``read_noise``. Attribute
        ``monochromator_shape``: "gaussian" or "triangle". Lazy variables are read one step at a time.
    absolute
        False where capture fraction or etendue are not known: the gain then has the right shape and no
        scale, to be given by `hyperpaint.calibration.anchor_to_radiance`.
    srf_shape
        "gaussian" or "slit"; None for the one that the lines fit better.
    flux_uncertainty, capture_uncertainty, etendue_uncertainty
        Relative standard uncertainties; 3 to 5 % is typical of power meters without a certificate.
    wavelength_uncertainty
        Standard uncertainty of the monochromator's dial [nm], which all lines share.
    linearity
        Coefficients of `hyperpaint.calibration.linearity`; or a table: counts proportional to light over a
        coordinate ``linearity_counts`` of measured ones, straight between its nodes. () for none. It is kept
        with the calibration, and `radiance` and `reflectance` apply it to the counts of every flight.
    linearity_on
        "dark-subtracted": linear counts are L(C - D), with L the curve; "raw": L(C) - L(D).
    linearity_uncertainty
        Relative standard uncertainty of linear counts that the curve leaves, at any level.
    flat_field
        Of `hyperpaint.calibration.flat_field`: the gains of a band then have its column differences. Without
        it the gains are those of smooth lines, and what elements differ in is in their random uncertainty.
    bad_elements
        (band, cross_track) bool: elements to leave out, besides those that the sweep betrays.
    smile_degree
        Degree over columns of the wavelength map; None for the lowest that the lines need.
    progress
        Called with steps done and to do.

    Returns
    -------
    xarray.Dataset
        In memory: ``radiance_gain`` (band, cross_track), NaN where it would be extrapolated or the element
        is bad, with its uncertainties; coordinates ``wavelength``, ``fwhm``, ``good`` (band),
        ``wavelength_shift``; the dark; ``responsivity``; ``stray_light`` and how
        sure it is, which `hyperpaint.reflectance` subtracts; and the lines it was made from. Attributes name
        the choices.

    Raises
    ------
    SchemaError
        The sweep cannot be calibrated; all problems are listed. Among them: bands lie further apart than the
        lines that they see are wide, so that light between them is in no count.

    Warns
    -----
    PaintWarning
        Steps were left out; the monochromator's line is too wide to determine the camera's; the beam's own
        profile is taken for response; columns are not lit; lines look clipped; the dark is off; the noise is
        not known; lines show a response that is neither model, and no table of it can be made; steps do not
        follow the responsivity, as of fringes.

    Notes
    -----
    ``radiance_gain = 1 / (spacing x etendue x R)`` with ``R = area / (exposure_time x flux x
    capture_fraction)`` at the lines, dark-subtracted counts summed over bands, interpolated over wavelength:
    the line-area method, which needs neither the width nor the shape of line and response. Width and shape
    come from fits of offset + area x profile, the profile being the monochromator's line convolved with the
    camera's. Where all lines together show another response than the better model, such as a lopsided one,
    ``srf_shape`` is ``"tabulated"``, ``srf`` (band, srf_offset) the response that they show, and
    ``wavelength`` is where the better model stands on it.

    Examples
    --------
    >>> from hyperpaint.simulation import simulate_sweep
    >>> sweep = simulate_sweep(steps=31, bands=136, columns=4, noise=False, quantise=False, nonuniformity=0)
    >>> made = calibrate(sweep)
    >>> error = made.radiance_gain / sweep.true_radiance_gain - 1
    >>> bool(abs(error.isel(band=slice(20, 116))).max() < 2e-3), made.srf_shape
    (True, 'gaussian')
    """
    given: Any = sweep
    if not isinstance(given, xr.Dataset):
        raise SchemaError(
            f"sweep is {type(given).__name__}",
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
    read = read_lines(lab, bad, curve, flat, tick)
    _check_lines(lab, read)
    seen, fits = fit_as_seen(lab, read, tick)
    _need_trusted(read, seen, fits)
    rough = _map(seen, lab, lab.wavelength, smile_degree)
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
    surface, slope, pull = _map_through(lines, lab, read, rough, shape, smile_degree)
    placed = placed_lines(lab, lines, surface, pull)
    if not lab.by_column and flat is None:
        areas = np.where(placed, lines.area, np.nan)
        _warn_of_beam(lab, areas, max(_UNEVEN * flux_uncertainty, _LEAST_UNEVEN))
    fwhm = band_widths(lab, lines, surface, placed)
    _refuse_undersampled(lab, surface, fwhm)
    light, own = lab.wavelength + pull, at_steps(lab, surface, fwhm)
    complete_edge_lines(lab, read, lines, surface, light, own, shape)
    budget = Budget(
        flux_uncertainty, capture_uncertainty, etendue_uncertainty, wavelength_uncertainty,
        linearity_uncertainty,
    )  # fmt: skip
    result = Result(
        lab, read, lines, surface, slope, pull, shape, misfit, bad, budget, curve, placed, fwhm,
        differences.relative, srf_shape is None,
    )  # fmt: skip
    return result.dataset(flat)


def _curve(linearity: Sequence[float] | xr.DataArray, on: str, lab: LabSweep) -> Linearity:
    """Return the curve that the arguments state, or say what is wrong with it."""
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
    full = np.inf if lab.saturation is None else float(np.max(lab.saturation))
    curve.check(problems, full)
    problems.raise_if_any()
    return curve


def _with_differences(
    lab: LabSweep, read: Read, lines: Lines, surface: WavelengthMap, shape: int, fits: list[Fits | None]
) -> tuple[Read, Lines, Differences]:
    """Return how much elements differ, and fits whose noise is that of the lines where it was not known."""
    is_noise_known = read.noise_source != FROM_SCATTER
    differences = element_differences(lab, read, lines, surface, shape, known_noise=is_noise_known)
    if is_noise_known:
        return read, lines, differences
    if lab.variance is None:
        warnings.warn(
            PaintWarning(
                "neither counts_variance nor electrons_per_count is given: the noise of the lines is estimated "
                "from their distances to the fits, and uncertainties of single elements are rough",
                code="noise-missing",
            ),
            stacklevel=3,
        )
    noise = replace(read.noise, slope=differences.slope * float(np.median(lab.frames)))
    read = replace(read, noise=noise)
    return read, fit_through(lab, read, surface, shape, fits, lambda: None), differences


def _refuse_undersampled(lab: LabSweep, surface: WavelengthMap, fwhm: Floats) -> None:
    """Refuse bands further apart than a line that they see is wide: light between them is in no count.

    The area of a line, counts summed over bands, is then not its light times the response: of Gaussian lines
    the sum ripples by 2 exp(-2 pi^2 s^2) with their place, s the standard deviation in bands: by 6 % at a
    full width of one band, some 1 % in the mean of steps, and by 20 % at 0.8.
    """
    spacing = surface.spacing(np.arange(lab.shape[1]), lab.shape[2] // 2)
    monochromator = float(np.median(lab.width))
    if float(np.median(np.hypot(fwhm, monochromator) / spacing)) >= 1.0:
        return
    apart, width = float(np.median(spacing)), float(np.median(fwhm))
    wide = np.sqrt(max(apart**2 - width**2, 0.0))
    raise refused(
        f"bands lie {apart:.3g} nm apart and see {width:.2g} nm, of lines {monochromator:.2g} nm wide: light "
        "between bands is in no count, and a line's area is not its light. Bands must overlap; or sweep with "
        f"the monochromator's line widened to {1.2 * max(wide, apart):.2g} nm"
    )


def _warn_of_beam(lab: LabSweep, areas: Floats, tolerance: float) -> None:
    problem = beam_problem(lab.wavelength, areas, tolerance)
    if problem is not None:
        warnings.warn(
            PaintWarning(
                f"flux is told per step only and so taken as equal in all lit columns, yet {problem}: the beam's "
                "own profile would pass for response. Give flux or capture_fraction per step and cross_track, or "
                "a flat_field",
                code="flux-profile-missing",
            ),
            stacklevel=3,
        )


def _counter(progress: Callable[[int, int], None] | None, total: int) -> Callable[[], None]:
    done = itertools.count(1)

    def tick() -> None:
        if progress is not None:
            progress(next(done), total)

    return tick


def _bad_at_the_door(lab: LabSweep, given: xr.DataArray | None) -> Bools:
    """Return the elements (band, cross_track) that are known as bad before a line is looked at."""
    bad = deviant_darks(lab.dark.at(float(lab.exposure.min())), lab.saturation)
    if given is not None:
        if set(given.dims) != {BAND, CROSS_TRACK} or given.transpose(BAND, CROSS_TRACK).shape != bad.shape:
            expected = f"{BAND} and {CROSS_TRACK} of {bad.shape}"
            raise SchemaError(
                f"bad_elements has sizes {dict(given.sizes)}", expected=f"{expected}", code="grid-mismatch"
            )
        bad = bad | given.transpose(BAND, CROSS_TRACK).to_numpy().astype(bool)
    if bad.all():
        raise refused("no element has a finite dark that is not saturated")
    return bad


def _check_lines(lab: LabSweep, read: Read) -> None:
    """Refuse a sweep with too few lines above the noise, and warn of the steps that are left out."""
    dark = [float(w) for w, window in zip(lab.wavelength, read.windows, strict=True) if window is None]
    if len(dark) > len(read.windows) - _FEWEST:
        raise refused(
            f"no line above the noise at {len(dark)} of {len(read.windows)} steps ({listed(dark, 'nm')}); is "
            "the dark that of these exposures, and was the lamp on?"
        )
    if dark:
        warnings.warn(
            PaintWarning(f"no line above the noise at {listed(dark, 'nm')}: left out", code="steps-dark"),
            stacklevel=3,
        )


def _need_trusted(read: Read, lines: Lines, fits: Sequence[Fits | None]) -> None:
    """Refuse a sweep of too few lines that can be trusted, and say why they cannot."""
    trusted = int(lines.trusted.any(axis=1).sum())
    if trusted >= _FEWEST:
        return
    pairs = [(w, f) for w, f in zip(read.windows, fits, strict=True) if w is not None and f is not None]
    total = sum(window.columns.size for window, _ in pairs)
    full = sum(int(window.saturated.sum()) for window, _ in pairs)
    width = float(np.nanmedian(np.concatenate([fit.width for _, fit in pairs])))
    lost = sum(int((~fit.converged & ~window.saturated).sum()) for window, fit in pairs)
    reasons = [f"{full} of {total} lines are saturated: shorten the exposure"] if full else []
    if width < _UNDERSAMPLED or lost > 0.5 * total:
        reasons.append(
            f"{lost} of {total} fits fail, of lines {width:.2g} bands wide: bands that lie further apart "
            "than a line is wide do not show its place; widen the monochromator's line"
        )
    reasons = reasons or ["the others lie at the edge of the array: give more steps"]
    raise refused(
        f"{trusted} steps have lines that can be trusted, expected {_FEWEST} or more; {'; '.join(reasons)}"
    )


def _map(lines: Lines, lab: LabSweep, wavelength: Floats, degree: int | None) -> WavelengthMap:
    """Return the wavelength map through the trusted lines at the wavelengths (step,) of their light."""
    step, column = np.nonzero(lines.trusted)
    return fit_wavelength_map(
        lines.centre[step, column], column.astype(np.float64), wavelength[step], lab.shape[1:],
        column_degree=degree, uncertainty=lines.centre_u[step, column],
    )  # fmt: skip


def _misfits(by_shape: Mapping[str, Lines]) -> dict[str, float]:
    """Return the mean log of chi2 per degree of freedom of each shape, over lines that all of them fit."""
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
            PaintWarning(f"saturated lines are left out: {listed(full)}", code="steps-saturated"),
            stacklevel=3,
        )


def _map_through(
    lines: Lines, lab: LabSweep, read: Read, rough: WavelengthMap, shape: str, degree: int | None
) -> tuple[WavelengthMap, Floats, Floats]:
    """Return the wavelength map, the slope of the log responsivity [nm-1] and the pull [nm] at the steps."""
    nothing = np.zeros(lab.shape[0])
    lit_steps = np.flatnonzero(lines.trusted.any(axis=1))
    level = line_level(lines, lab, rough)
    if lit_steps.size < _FEWEST or not (level[lit_steps] > 0).all():
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


_DEGREE = 4  # of a beam's log profile over the columns
_SURE = 4.5  # standard deviations of noise and of the elements' differences
_CHANGING = 1.0 / 3.0  # of the tolerance, by which a profile may change from step to step


def beam_problem(wavelength: Floats, areas: Floats, tolerance: float) -> str | None:
    """Return what betrays a beam that does not light all columns alike, or None.

    ``areas`` (step, cross_track) are those of the fitted lines [count], which a dead element does not dim,
    NaN where there is none; ``wavelength`` (step,) [nm]; ``tolerance`` is the relative fall over the columns
    let pass.
    """
    count = np.isfinite(areas).sum(axis=1)
    steps = np.flatnonzero(count >= max(4.0, 0.5 * count.max()))
    if steps.size < 4:
        return None
    level, spread = _profiles(areas[steps])
    fall = np.nanmax(level, axis=1) - np.nanmin(level, axis=1)
    sure = fall - _SURE * np.sqrt(2.0) * np.nanmax(spread, axis=1)
    mean = np.nanmean(level, axis=0)
    mean_spread = np.nanmax(spread / np.sqrt(np.isfinite(level).sum(axis=0)))
    if np.ptp(mean) - _SURE * np.sqrt(2.0) * mean_spread > tolerance or sure.max() > tolerance:
        worst = int(np.argmax(sure))
        at = wavelength[steps[worst]]
        return f"lines fall by {1.0 - np.exp(-fall[worst]):.1%} over the columns (at {at:g} nm)"
    changes = np.nanmean((level - mean) ** 2, axis=0)
    noise = np.nanmean(spread**2, axis=0)
    column = int(np.argmax(changes - noise))
    excess = float(np.sqrt(max(changes[column] - 2.0 * noise[column], 0.0)))
    if excess > _CHANGING * tolerance:
        share = float(np.sqrt(changes[column]))
        where = int(np.flatnonzero(np.isfinite(areas[steps]).any(axis=0))[column])
        return f"the share of light of column {where} varies by {share:.1%} from step to step"
    return None


def _profiles(areas: Floats) -> tuple[Floats, Floats]:
    """Return smooth log profiles of areas over columns about their medians, and their standard deviations."""
    lit = np.flatnonzero(np.isfinite(areas).any(axis=0))
    level = np.full((len(areas), lit.size), np.nan)
    spread = level.copy()
    place = np.linspace(-1.0, 1.0, lit.size)
    for row, area in enumerate(areas[:, lit]):
        is_lit = np.isfinite(area) & (area > 0)
        degree = min(_DEGREE, int(is_lit.sum()) // 4)
        terms = np.asarray(chebyshev.chebvander(place[is_lit], degree), np.float64)
        log = np.log(area[is_lit])
        inverse = np.linalg.pinv(terms)
        fitted = terms @ (inverse @ log)
        free = max(int(is_lit.sum()) - degree - 1, 1)
        rms = float(np.sqrt(((log - fitted) ** 2).sum() / free))
        level[row, is_lit] = fitted - np.median(fitted)
        spread[row, is_lit] = rms * np.sqrt(np.einsum("ij,ji->i", terms, inverse))
    return level, spread
