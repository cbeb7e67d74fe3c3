"""Quantities derived from a calibration: relative responsivity, quantum efficiency, fitted lamp lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.schema import BAND, CROSS_TRACK, STEP, label, require
from hyperpaint.base.units import takes_quantities
from hyperpaint.kernels.line_fits import profiles
from hyperpaint.radiometry.linear_counts import linearity_of

from .detector import deviant_darks
from .lab_sweep import LabSweep, check_sweep
from .line_fits import SHAPES, find_line

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
    names = ["responsivity", "wavelength"]
    if calibration.attrs.get("absolute_scale") == "unknown":
        raise SchemaError(
            "this calibration has no absolute scale for a quantum efficiency (absolute_scale = 'unknown')",
            mend="add one with hyperpaint.calibration.anchor_to_radiance",
            code="scale-unknown",
        )
    if electrons_per_count is None:
        if "electrons_per_count" not in calibration.variables:
            raise SchemaError(
                "'electrons_per_count' is missing for a quantum efficiency",
                mend="pass electrons_per_count=, or hyperpaint.radiometry.estimate_noise",
                code="variable-missing",
            )
        names.append("electrons_per_count")
    inputs = require(calibration, names, "a quantum efficiency")
    electrons: Any = inputs.get("electrons_per_count", electrons_per_count)
    photon = PLANCK_TIMES_LIGHT / (inputs["wavelength"] * 1e-9)
    efficiency = (inputs["responsivity"] * electrons * photon).median(CROSS_TRACK).transpose(BAND)
    return label(efficiency.astype(np.float64), "quantum_efficiency")


_REACH = 1.6  # full widths plotted to either side
_POINTS = 201


@dataclass(frozen=True, eq=False)
class FittedLine:
    """One line in one column."""

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
    names = ("step_wavelength", "wavelength", "line_band", "line_own_fwhm", "line_amplitude")
    variables = require(calibration, names, "its fitted lines")
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
            distance, counts = _samples(lab, calibration, step, column)
            is_near = np.abs(distance - centre) <= reach
            distance, counts = distance[is_near] - centre, counts[is_near]
        # profile of the lamp line at its centre, which has unit height, at the samples and along the curve
        place = np.concatenate([[0.0], distance, curve_distance])[None]
        profile: Floats = np.empty(place.shape)
        own, lamp = (np.array([float(width) / abs(spacing_at)]) for width in (camera_width, source))
        profiles(place, own, lamp, SHAPES[str(calibration.attrs["srf_shape"])], is_triangular, profile)
        profile = profile[0, 1:] / profile[0, 0]
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


def _samples(lab: LabSweep, calibration: xr.Dataset, step: int, column: int) -> tuple[Floats, Floats]:
    raw = lab.frame(step)
    dark = lab.dark.at(float(lab.exposure[step]))
    net = linearity_of(calibration).net(raw, dark)
    if "flat_field" in calibration.variables:
        net = net * calibration["flat_field"].transpose(BAND, CROSS_TRACK).to_numpy()
    window = find_line(net, raw, deviant_darks(dark, lab.saturation), lab.saturation)
    if window is None or column not in window.columns:
        return np.empty(0), np.empty(0)
    line = int(np.flatnonzero(window.columns == column)[0])
    is_finite = np.isfinite(window.values[line])
    return window.places[line, is_finite], window.values[line, is_finite]
