"""Wavelengths and width of the irradiance record alone, from solar lines and those of oxygen.

The reference is the sunlight of ASTM G173 at 1 nm (`hyperpaint.light.clear_sky`). It is coarse relative to a
spectrometer of 3 nm, so that only tenths of a nanometre are resolved. The difference of camera and record
(`comparison`) is ten times more accurate, and this module divides it between the two.
"""

from __future__ import annotations

import functools
import itertools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hyperpaint.base.arrays import Floats
from hyperpaint.light.clear_sky import sunlight_table


@dataclass(frozen=True)
class SunLineRules:
    """Settings of the comparison of a record with solar lines.

    Attributes
    ----------
    windows
        Compared intervals [nm]: magnesium b and iron, H-alpha, the oxygen A band; the blue, where cells of 1
        nm hold many solar lines, gave widths twice too large of a real spectrometer.
    degree
        Degree of the polynomial that models the unknown colour of the light in a window.
    shifts_nm, widths_nm
        Trials: shifts [nm] and full widths at half maximum [nm], both even.
    cell_nm
        Width of the table's cells, which widens every solar line [nm].
    least_shift_u_nm, least_width_u_nm
        Lower limits of reported uncertainties: three windows of a real record agreed to 0.06 nm and
        0.9 nm (0.3 nm without the narrowest solar lines).
    record_prior_nm, camera_prior_nm, camera_width_prior
        Standard deviations of the prior: of the wavelengths of a field spectrometer
        (its makers specify 0.5 nm at most) and of a calibrated camera [nm], and of the camera's width [1].
    """

    windows: tuple[tuple[float, float], ...] = ((475.0, 540.0), (610.0, 680.0), (745.0, 775.0))
    degree: int = 5
    shifts_nm: tuple[float, float, float] = (-2.0, 2.0, 0.1)
    widths_nm: tuple[float, float, float] = (1.0, 12.0, 0.25)
    cell_nm: float = 1.0
    least_shift_u_nm: float = 0.06
    least_width_u_nm: float = 0.3
    record_prior_nm: float = 0.3
    camera_prior_nm: float = 0.2
    camera_width_prior: float = 0.02


SUN_LINES = SunLineRules()


class RecordAgainstSun(NamedTuple):
    """True minus declared wavelength of the record's channels, and their width, with uncertainties [nm]."""

    shift: float
    shift_u: float
    width: float
    width_u: float


class Instruments(NamedTuple):
    """Shares of record and camera in their difference, each with its standard uncertainty.

    Shifts: true minus declared wavelength [nm]; ``record_fwhm`` [nm]; ``camera_width``: over the declared one
    [1].
    """

    record_shift: float
    record_shift_u: float
    camera_shift: float
    camera_shift_u: float
    record_fwhm: float
    record_fwhm_u: float
    camera_width: float
    camera_width_u: float


def divided(
    shift: tuple[float, float],
    width: tuple[float, float],
    sun: RecordAgainstSun | None,
    declared_fwhm: tuple[float, float],
    rules: SunLineRules = SUN_LINES,
) -> Instruments:
    """Return the shares of both instruments in their difference.

    ``shift``: camera minus record [nm] and its uncertainty; ``width``: width of the record over the declared
    one, if the camera is as declared, and its uncertainty; ``declared_fwhm``: of record and camera [nm].

    Least squares of two unknowns for shifts, and two for widths: record and camera. Their difference is
    measured, the record is measured by the sun, and both have priors. Widths add as squares: :math:`w^2 -
    (W^2 - W_0^2)` is measured.
    """
    record, camera = declared_fwhm
    rows = [
        (-1.0, 1.0, *shift),
        (1.0, 0.0, 0.0, rules.record_prior_nm),
        (0.0, 1.0, 0.0, rules.camera_prior_nm),
    ]
    squares = [
        (1.0, -1.0, (record * width[0]) ** 2, 2.0 * record**2 * width[0] * width[1]),
        (0.0, 1.0, 0.0, 2.0 * camera**2 * rules.camera_width_prior),
    ]
    if sun is not None:
        rows.append((1.0, 0.0, sun.shift, sun.shift_u))
        squares.append((1.0, 0.0, sun.width**2, 2.0 * sun.width * sun.width_u))
    (record_shift, camera_shift), (u_record, u_camera) = _least_squares(rows)
    (record_square, camera_square), (v_record, v_camera) = _least_squares(squares)
    record_fwhm = np.sqrt(max(record_square, 0.01))
    camera_fwhm = np.sqrt(max(camera**2 + camera_square, 0.01))
    return Instruments(
        record_shift,
        u_record,
        camera_shift,
        u_camera,
        float(record_fwhm),
        float(v_record / (2.0 * record_fwhm)),
        float(camera_fwhm / camera),
        float(v_camera / (2.0 * camera_fwhm * camera)),
    )


def _least_squares(rows: list[tuple[float, float, float, float]]) -> tuple[list[float], list[float]]:
    table = np.array(rows)
    weighted = table[:, :3] / table[:, 3:]
    inverse = np.linalg.inv(weighted[:, :2].T @ weighted[:, :2])
    return (inverse @ weighted[:, :2].T @ weighted[:, 2]).tolist(), np.sqrt(np.diag(inverse)).tolist()


def record_against_sun(
    channels: Floats, spectrum: Floats, rules: SunLineRules = SUN_LINES
) -> RecordAgainstSun | None:
    """Return shift and width of a record (channel,) of daylight; None where it has too few channels.

    In every window the logarithm of the table at a shift and a width, with free strengths of oxygen and water
    and plus a polynomial, is fitted to the logarithm of the record. Windows are weighted by the inverse of
    their variance; where they disagree by more than their uncertainty, the uncertainty of the result is
    increased.
    """
    windows = [_window(channels, spectrum, low, high, rules) for low, high in rules.windows]
    fits = np.array([fit for fit in windows if fit is not None])
    if not len(fits):
        return None
    numbers = []
    for value, uncertainty, min_uncertainty in (
        (fits[:, 0], fits[:, 1], rules.least_shift_u_nm),
        (fits[:, 2], fits[:, 3], rules.least_width_u_nm),
    ):
        weight = 1.0 / (uncertainty**2 + min_uncertainty**2)
        mean = float(weight @ value / weight.sum())
        chi2 = float(weight @ (value - mean) ** 2) / max(len(value) - 1, 1)
        numbers += [mean, float(np.sqrt(max(chi2, 1.0) / weight.sum() + min_uncertainty**2))]
    return RecordAgainstSun(*numbers)


def _window(
    channels: Floats, spectrum: Floats, low: float, high: float, rules: SunLineRules
) -> tuple[float, float, float, float] | None:
    # Return shift and width of a window, each with its uncertainty [nm]; None without a minimum.
    is_used = (channels >= low) & (channels <= high) & (spectrum > 0)
    if is_used.sum() < rules.degree + 1 + 12:
        return None
    wavelength, log = channels[is_used], np.log(spectrum[is_used])
    shifts, widths, log_sun, basis = _trials(tuple(wavelength.tolist()), rules)
    residual = log - log_sun
    residual = residual - np.einsum("swck,swk->swc", basis, np.einsum("swck,swc->swk", basis, residual))
    costs = np.einsum("swc,swc->sw", residual, residual)
    i, j = divmod(int(costs.argmin()), widths.size)
    if i in (0, shifts.size - 1) or j in (0, widths.size - 1):
        return None
    # minimum of the paraboloid around the best trial, with its uncertainties
    costs_around = costs[i - 1 : i + 2, j - 1 : j + 2]
    gradient = (
        np.array([costs_around[2, 1] - costs_around[0, 1], costs_around[1, 2] - costs_around[1, 0]]) / 2.0
    )
    mixed = (costs_around[2, 2] - costs_around[2, 0] - costs_around[0, 2] + costs_around[0, 0]) / 4.0
    curvature = np.array(
        [
            costs_around[2, 1] - 2 * costs_around[1, 1] + costs_around[0, 1],
            costs_around[1, 2] - 2 * costs_around[1, 1] + costs_around[1, 0],
        ]
    )
    hessian = np.array([[curvature[0], mixed], [mixed, curvature[1]]])
    step = np.clip(-np.linalg.solve(hessian, gradient), -1.0, 1.0)
    freedom = wavelength.size - (rules.degree + 1) - 4
    variance = 2.0 * np.diag(np.linalg.inv(hessian)) * costs_around[1, 1] / max(freedom, 1)
    steps = np.array([shifts[1] - shifts[0], widths[1] - widths[0]])
    uncertainty = np.sqrt(np.maximum(variance, 0.0)) * steps
    shift, width = shifts[i] + step[0] * steps[0], widths[j] + step[1] * steps[1]
    return shift, uncertainty[0], width, uncertainty[1]


@functools.lru_cache(maxsize=4)  # the lines of a collect have the same channels
def _trials(channels: tuple[float, ...], rules: SunLineRules) -> tuple[Floats, Floats, Floats, Floats]:
    # Return trial shifts (shift,) and widths (width,) [nm], logarithms of the sun above the air (shift,
    # width, channel), and an orthonormal basis (shift, width, channel, term): polynomial, then gases, 0 for
    # missing gases.
    wavelength = np.array(channels)
    smooth = np.polynomial.legendre.legvander(
        (wavelength - wavelength.mean()) / (np.ptp(wavelength) / 2.0), rules.degree
    )
    first, last, step = rules.shifts_nm
    shifts = np.arange(first, last + step / 2, step)
    first, last, step = rules.widths_nm
    widths = np.arange(first, last + step / 2, step)
    log_sun = np.empty((shifts.size, widths.size, wavelength.size))
    basis = np.zeros((*log_sun.shape, smooth.shape[1] + 2))
    for j, width in enumerate(widths):
        log_sun[:, j], gases = _log_light(wavelength + shifts[:, None], float(width), rules)
        has_lines = np.ptp(gases, axis=2) > 1e-4  # (gas, shift)
        for group in itertools.product((False, True), repeat=len(gases)):
            shifts_of_group = np.flatnonzero((has_lines == np.array(group)[:, None]).all(axis=0))
            terms = np.moveaxis(gases[np.flatnonzero(group)][:, shifts_of_group], 0, -1)
            terms_of_group = np.concatenate(
                [np.broadcast_to(smooth, (shifts_of_group.size, *smooth.shape)), terms], axis=-1
            )
            basis[shifts_of_group, j, :, : terms_of_group.shape[-1]] = np.linalg.qr(terms_of_group)[0]
    return shifts, widths, log_sun, basis


def _log_light(wavelengths: Floats, width: float, rules: SunLineRules) -> tuple[Floats, Floats]:
    # Return logarithms of the table (shift, channel) at wavelengths (shift, channel) and a width:
    # of the sun above the air, and the changes by two gases (gas, shift, channel).
    table = sunlight_table()
    from_mean = np.abs(table.wavelength - wavelengths.mean(axis=1, keepdims=True))
    is_near = from_mean < np.ptp(wavelengths, axis=1, keepdims=True) / 2.0 + 3.0 * width  # (shift, cell)
    cells = is_near.any(axis=0)
    squared_width = max(width**2 - 8.0 * np.log(2.0) * rules.cell_nm**2 / 12.0, 0.25)
    offset = table.wavelength[cells] - wavelengths[..., None]
    response = np.exp(-4.0 * np.log(2.0) / squared_width * offset**2) * is_near[:, None, cells]
    response /= response.sum(axis=2, keepdims=True)
    sun = table.extraterrestrial[cells]
    lights = np.stack([sun, sun * np.exp(-table.mixed[cells]), sun * np.exp(-table.water[cells])], axis=-1)
    logs = np.moveaxis(np.log(response @ lights), -1, 0)
    return logs[0], logs[1:] - logs[0]
