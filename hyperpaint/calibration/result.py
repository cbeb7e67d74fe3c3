"""The calibration dataset: what the lines of a sweep come to, element by element, with its uncertainties."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from hyperpaint.errors import PaintWarning, SchemaError
from hyperpaint.schema import VARIABLES, dtype_of, label

from .edge_lines import complete_edge_lines
from .lab_sweep import LabSweep
from .line_fits import fit_beam
from .out_of_band import second_order_share, stray_light_matrix
from .responsivity import element_gain, second_order_factor, shape_variance
from .steps import Lines, Read
from .views import PLANCK_TIMES_LIGHT
from .wavelength_map import WavelengthMap, fit_width

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Budget", "Result", "line_level"]

Float = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]

_ILL_CONDITIONED = 0.7  # width of the monochromator over that of the camera
_MISPLACED = 0.5  # nm from the wavelength map, beyond which a line's wavelength is not what is said
_TOLERANCE = 0.01  # nm by which an element may lie beyond the outer step
_ELECTRONS = (0.05, 2000.0)  # a count, of any camera


@dataclass(frozen=True)
class Budget:
    """Relative standard uncertainties that the sweep itself cannot tell."""

    flux: float
    capture: float
    etendue: float

    @property
    def total(self) -> float:
        """Root sum of squares."""
        return float(np.sqrt(self.flux**2 + self.capture**2 + self.etendue**2))


def line_level(lines: Lines, lab: LabSweep, surface: WavelengthMap, used: Bool | None = None) -> Float:
    """Return the integrated response that the lines saw (step,) [count nm J-1], median of the columns."""
    nodes = _nodes(lines, lab, surface)
    known = lines.trusted if used is None else used
    made = np.full(len(nodes), np.nan)
    rows = known.any(axis=1)
    made[rows] = np.nanmedian(np.where(known, nodes, np.nan)[rows], axis=1)
    return made


def _nodes(lines: Lines, lab: LabSweep, surface: WavelengthMap) -> Float:
    column = np.broadcast_to(np.arange(lines.centre.shape[1]), lines.centre.shape)
    spacing = surface.spacing(np.nan_to_num(lines.centre), column)
    return np.asarray(lines.area * spacing / (lab.exposure[:, None] * lab.power))


@dataclass(frozen=True, eq=False)
class Result:
    """Everything that has been found, on its way into a Dataset.

    Attributes
    ----------
    lab, read, lines, surface
        Sweep, its windows, the fits, and the wavelength map.
    line_slope : (step,)
        d ln responsivity / d wavelength [nm-1].
    pull : (step,)
        How far that slope moves the lines [nm].
    shape, misfit
        Line shape of the camera, and how badly each shape fits.
    bad : (band, cross_track)
    budget, linearity
        As given.
    """

    lab: LabSweep
    read: Read
    lines: Lines
    surface: WavelengthMap
    line_slope: Float
    pull: Float
    shape: str
    misfit: dict[str, float]
    bad: Bool
    budget: Budget
    linearity: tuple[float, ...]

    @cached_property
    def wavelength(self) -> Float:
        """Of every element (band, cross_track) [nm]."""
        return self.surface.grid()[0]

    @cached_property
    def spacing(self) -> Float:
        """Of the bands, element by element (band, cross_track) [nm]."""
        return self.surface.grid()[1]

    @cached_property
    def centre_wavelength(self) -> Float:
        """Of the bands at the centre column (band,) [nm]."""
        return np.asarray(self.wavelength[:, self.lab.shape[2] // 2])

    @cached_property
    def columns(self) -> npt.NDArray[np.int64]:
        """Column of every line (step, cross_track)."""
        return np.broadcast_to(np.arange(self.lab.shape[2]), self.lines.centre.shape)

    @cached_property
    def line_wavelength(self) -> Float:
        """Where the map puts the centres of the lines (step, cross_track) [nm], less the slope's pull."""
        there = self.surface.at(np.nan_to_num(self.lines.centre), self.columns)
        pulled = there - self.pull[:, None]
        return np.asarray(np.where(np.isfinite(self.lines.centre), pulled, np.nan))

    @cached_property
    def line_spacing(self) -> Float:
        """Spacing of bands at the lines (step, cross_track) [nm]."""
        return self.surface.spacing(np.nan_to_num(self.lines.centre), self.columns)

    @cached_property
    def trusted(self) -> Bool:
        """Lines that are used: good fits, where the map says they should be."""
        apart = np.abs(self.line_wavelength - self.lab.wavelength[:, None])
        with np.errstate(invalid="ignore"):
            return np.asarray(self.lines.trusted & (apart < max(_MISPLACED, 6.0 * self.surface.residual)))

    @cached_property
    def used(self) -> Bool:
        """Lines whose area is used: the trusted, and those at the edges completed from them."""
        lab = self.lab
        light = lab.wavelength + self.pull
        lines = self.lines
        complete_edge_lines(lab, self.read, lines, self.surface, light, self.fwhm_at_steps, self.shape)
        return np.asarray(self.trusted | lines.completed)

    @cached_property
    def fwhm_at_steps(self) -> Float:
        """Width of the camera's line at every step (step,) [nm]."""
        order = np.argsort(self.centre_wavelength)
        return np.interp(self.lab.wavelength, self.centre_wavelength[order], self.fwhm[order])

    @cached_property
    def fwhm(self) -> Float:
        """Width of every band (band,) [nm]."""
        used = np.flatnonzero(self.trusted.any(axis=1))
        widths = np.where(self.trusted, self.lines.own_width * self.line_spacing, np.nan)[used]
        spread = np.where(self.trusted, self.lines.own_width_u * self.line_spacing, np.nan)[used]
        lines = self.trusted[used].sum(axis=1)
        return fit_width(
            self.lab.wavelength[used],
            np.nanmedian(widths, axis=1),
            np.nanmedian(spread, axis=1) / np.sqrt(lines),
            self.centre_wavelength,
        )

    @cached_property
    def gain(self) -> tuple[Float, Bool]:
        """Gain of every element [W m-2 sr-1 nm-1 s count-1], NaN where not known; and whether it is."""
        lab = self.lab
        used = self.used
        order = np.argsort(self.centre_wavelength)
        spacing = np.interp(
            lab.wavelength, self.centre_wavelength[order], self.spacing[order, lab.shape[2] // 2]
        )
        factor = second_order_factor(
            lab.wavelength,
            line_level(self.lines, lab, self.surface, used),
            shape_variance(self.fwhm_at_steps, self.shape, spacing),
            shape_variance(lab.width, "triangle" if lab.triangular else "gaussian"),
        )
        nodes = _nodes(self.lines, lab, self.surface) * factor[:, None]
        return element_gain(lab.wavelength, nodes, used, self.wavelength, lab.etendue, self._tolerance)

    @property
    def _tolerance(self) -> float:
        return max(_TOLERANCE, 3.0 * self.surface.residual)

    def dataset(self, flat: Float | None) -> xr.Dataset:
        """Return the calibration."""
        import xarray as xr

        gain, known = self.gain
        if not known.any():
            msg = "this lab sweep cannot be calibrated:\n  no column has four lines that can be trusted"
            raise SchemaError(msg)
        if self.lab.absolute:
            self._check_plausible(gain)
        self._warn_of_width()
        gain = _levelled(gain, flat)
        responsivity = 1.0 / (gain * self.lab.etendue * self.spacing)
        gain[self.bad] = np.nan
        lit = np.isfinite(gain).any(axis=0)
        good = np.isfinite(gain[:, lit]).mean(axis=1) > 0.5
        values: dict[str, Any] = {
            "radiance_gain": gain,
            "responsivity": responsivity,
            "wavelength_u": self.surface.residual,
            **self._uncertainties(gain, good),
            **self._dark(),
            **self._line_variables(),
        }
        if flat is not None:
            values["flat_field"] = flat
        coords = {
            "wavelength": self.centre_wavelength,
            "wavelength_shift": self.wavelength - self.centre_wavelength[:, None],
            "fwhm": self.fwhm,
            "band_spacing": self.spacing[:, self.lab.shape[2] // 2],
            "good": good,
            "step_wavelength": self.lab.wavelength,
        }
        return xr.Dataset(
            {name: _labelled(value, name) for name, value in values.items()},
            {name: _labelled(value, name) for name, value in coords.items()},
            self._attrs(good),
        )

    def _uncertainties(self, gain: Float, good: Bool) -> dict[str, Float]:
        random = np.full(gain.shape, np.nan)
        for column in range(gain.shape[1]):
            used = np.flatnonzero(self.used[:, column])
            if used.size:
                random[:, column] = np.interp(
                    self.wavelength[:, column], self.lab.wavelength[used], self.lines.area_u[used, column]
                )
        slope = np.interp(self.centre_wavelength, self.lab.wavelength, self.line_slope)
        total = np.hypot(self.budget.total, slope * self.surface.residual)
        return {
            "radiance_gain_u_random": np.where(np.isfinite(gain), random, np.nan),
            "radiance_gain_u_systematic": np.where(good, total, np.nan),
        }

    def _dark(self) -> dict[str, Any]:
        lab = self.lab
        exposure = float(np.median(lab.exposure))
        made: dict[str, Any] = {"dark_counts": lab.dark.at(exposure), "dark_exposure_time": exposure}
        if lab.dark.known_rate:
            made |= {"dark_bias": lab.dark.bias, "dark_rate": lab.dark.rate}
        if lab.saturation is not None:
            made["saturation_count"] = lab.saturation
        noise = self.read.noise
        electrons = lab.electrons_per_count or (1.0 / noise.slope if noise.slope > 0 else None)
        if electrons is not None:
            made["electrons_per_count"] = electrons
        read_noise = lab.read_noise
        if read_noise is None and noise.slope > 0:
            read_noise = float(np.sqrt(max(noise.constant - 1.0 / 12.0, 0.0)))
        if read_noise is not None:
            made["read_noise"] = read_noise
        return made

    def _line_variables(self) -> dict[str, Any]:
        lines, steps = self.lines, self.lab.shape[0]
        beam = np.full((steps, 2), np.nan)
        for step, window in enumerate(self.read.windows):
            if window is not None:
                beam[step] = fit_beam(window.beam)
        centre = np.full(steps, np.nan)
        width = np.full(steps, np.nan)
        used = self.trusted.any(axis=1)
        centre[used] = np.nanmedian(np.where(self.trusted, lines.centre, np.nan)[used], axis=1)
        width[used] = np.nanmedian(
            np.where(self.trusted, lines.width * self.line_spacing, np.nan)[used], axis=1
        )
        rows, at = self.read.rows[used], self.lab.wavelength[used]
        second = np.full(steps, np.nan)
        second[used] = second_order_share(rows, at, self.centre_wavelength, width[used])
        matrix = stray_light_matrix(rows, centre[used], at, self.centre_wavelength, width[used], second[used])
        out_of_band = np.where(used, self.read.rows.sum(axis=1), np.nan)
        return {
            "line_band": lines.centre,
            "line_centre": self.line_wavelength,
            "line_fwhm": lines.width * self.line_spacing,
            "line_own_fwhm": lines.own_width * self.line_spacing,
            "line_amplitude": lines.amplitude,
            "line_area": lines.area,
            "line_covariance": lines.covariance,
            "line_trusted": self.used,
            "beam_centre": beam[:, 0],
            "beam_fwhm": beam[:, 1],
            "out_of_band": out_of_band,
            "second_order": second,
            "stray_light": matrix,
        }

    def _check_plausible(self, gain: Float) -> None:
        """Refuse a scale at which a photon would free more than an electron, or next to none at all."""
        photon = PLANCK_TIMES_LIGHT / (self.wavelength * 1e-9)
        counts = photon / (gain * self.lab.etendue * self.spacing)
        best = float(np.nanmax(np.nanmedian(counts[np.isfinite(counts).any(axis=1)], axis=1)))
        known = self.lab.electrons_per_count
        if known is None and self.read.noise_source == "variance of the frames":
            known = 1.0 / self.read.noise.slope
        low, high = (known, known) if known is not None else _ELECTRONS
        at = "" if known is None else f" at {known:.3g} electrons a count"
        if best * low > 1.05:
            problem = (
                f"{best * low:.3g} electrons out per photon in{at}, expected below 1: flux x capture_fraction"
            )
            problem += " x exposure_time is too small"
        elif best * high < 1e-3:
            problem = f"{best * high:.3g} electrons out per photon in{at}, expected above 0.001: flux x"
            problem += " capture_fraction x exposure_time is too large"
        else:
            return
        msg = (
            f"this lab sweep cannot be calibrated:\n  {problem}; check the units of flux (uW said to be W?) "
            "and of exposure_time (ms said to be s?), and capture_fraction; without an absolute scale, pass "
            "absolute=False"
        )
        raise SchemaError(msg)

    def _warn_of_width(self) -> None:
        own = self.fwhm_at_steps
        wide = self.lab.width > _ILL_CONDITIONED * own
        if wide.any():
            share = float(np.max(self.lab.width / own))
            warnings.warn(
                f"the monochromator's line is up to {share:.2g} of the camera's FWHM wide (over "
                f"{_ILL_CONDITIONED:g} at {int(wide.sum())} of {wide.size} steps): fwhm is "
                "ill-conditioned there; narrow the slits",
                PaintWarning,
                stacklevel=4,
            )

    def _attrs(self, good: Bool) -> dict[str, Any]:
        lab = self.lab
        left_out = [float(w) for w in lab.wavelength[~self.used.any(axis=1)]]
        return {
            "srf_shape": self.shape,
            "source": "monochromator sweep, line-area method",
            "absolute_scale": "known" if lab.absolute else "unknown",
            "absolute_anchor": "flux, capture fraction and etendue" if lab.absolute else "none",
            "flux_uncertainty": self.budget.flux,
            "capture_uncertainty": self.budget.capture,
            "etendue_uncertainty": self.budget.etendue,
            "steps": len(lab.wavelength),
            "step_range_nm": [float(lab.wavelength[0]), float(lab.wavelength[-1])],
            "steps_left_out_nm": left_out,
            "bands_without_gain": int((~good).sum()),
            "bad_elements": int(self.bad.sum()),
            "monochromator_fwhm_nm": float(np.median(lab.width)),
            "monochromator_shape": "triangle" if lab.triangular else "gaussian",
            "column_light": "told per column" if lab.by_column else "taken as equal in all lit columns",
            "wavelength_residual_nm": self.surface.residual,
            "smile_degree": self.surface.coefficients.shape[1] - 1,
            "linearity": list(self.linearity) or "identity",
            "noise_source": self.read.noise_source,
            "stray_light_applied": "no",
            **{f"line_misfit_{name}": value for name, value in self.misfit.items()},
        }


def _levelled(gain: Float, flat: Float | None) -> Float:
    """Return gains on counts as they are, from those on counts that a flat field has levelled."""
    if flat is None:
        return gain.copy()
    common = np.full(len(gain), np.nan)
    rows = np.isfinite(gain).any(axis=1)
    common[rows] = np.nanmedian(gain[rows], axis=1)
    return np.asarray(common[:, None] * flat)


def _labelled(value: Any, name: str) -> xr.DataArray:
    import xarray as xr

    spec = VARIABLES[name]
    array = np.asarray(value)
    dims = next(d for d in (spec.dims, *spec.alternatives) if len(d) == array.ndim)
    return label(xr.DataArray(array.astype(dtype_of(name)), dims=dims), name)
