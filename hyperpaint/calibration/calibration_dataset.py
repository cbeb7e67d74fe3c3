"""Assemble the calibration dataset from the fitted lamp lines, element by element, with uncertainties."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base.arrays import Bools, Floats
from hyperpaint.base.constants import QUANTISATION_VARIANCE_COUNT2
from hyperpaint.base.errors import PaintWarning
from hyperpaint.base.schema import VARIABLES, dtype_of, label
from hyperpaint.radiometry.linear_counts import DARK_SUBTRACTED, RAW, Linearity

from .detector import row_medians
from .elements import at_steps, line_wavelengths
from .fringes import FRINGES, Between, error_between_lines, level_scatter
from .lab_sweep import LabSweep, refused
from .line_fits import fit_beam
from .out_of_band import OffLines, dark_off_lines, light_off_lines
from .response_tables import MeasuredShape, measured_shape
from .responsivity import element_gain, second_order_factor, shape_variance
from .steps import FROM_FRAMES, Lines, Read
from .views import PLANCK_TIMES_LIGHT
from .wavelength_map import WavelengthMap

#: Width of the monochromator over the camera's above which fwhm is ill-conditioned [1].
MAX_SLIT_SHARE = 0.7
#: Distance of an element beyond the outer step that is allowed, at least and at most [nm].
EDGE_TOLERANCE_NM = (0.01, 0.05)
#: Offset of the dark that is reported [count].
MAX_DARK_OFFSET = 1.0
#: Electrons per count of any camera.
ELECTRONS_RANGE = (0.05, 2000.0)


@dataclass(frozen=True)
class Budget:
    """Standard uncertainties that the sweep does not determine: relative, and of the dial [nm]."""

    flux: float
    capture: float
    etendue: float
    wavelength: float
    linearity: float

    @property
    def total(self) -> float:
        """Root sum of squares of the relative ones."""
        return float(np.sqrt(self.flux**2 + self.capture**2 + self.etendue**2))


def line_level(lines: Lines, lab: LabSweep, surface: WavelengthMap, used: Bools | None = None) -> Floats:
    """Return the integrated response at the lamp lines (step,) [count nm J-1], median of the columns."""
    return row_medians(_nodes(lines, lab, surface), lines.trusted if used is None else used)


def _nodes(lines: Lines, lab: LabSweep, surface: WavelengthMap) -> Floats:
    column = np.broadcast_to(np.arange(lines.centre.shape[1]), lines.centre.shape)
    spacing = surface.spacing(np.nan_to_num(lines.centre), column)
    with np.errstate(over="ignore"):  # of fits that are not trusted
        return np.asarray(lines.area * spacing / (lab.exposure[:, None] * lab.power))


@dataclass(frozen=True, eq=False)
class Result:
    """All results of a calibration, to be assembled into a Dataset."""

    #: lab, read, lines, surface: sweep, its windows, the fits, and the wavelength map
    lab: LabSweep
    read: Read
    lines: Lines
    surface: WavelengthMap
    line_slope: Floats  #: (step,): d ln responsivity / d wavelength [nm-1]
    pull: Floats  #: (step,): shift of the lamp lines by that slope [nm]
    #: shape, misfit: line shape of the camera, and the misfit of each shape
    shape: str
    misfit: dict[str, float]
    bad: Bools  #: (band, cross_track)
    #: budget, linearity: as given
    budget: Budget
    linearity: Linearity
    placed: Bools  #: (step, cross_track): good fits where the map says they should be
    fwhm: Floats  #: (band,): width of every band [nm]
    differences: float  #: Relative standard deviation of the elements about the lines
    is_shape_free: bool  #: Whether the response may be measured from the lamp lines

    @cached_property
    def wavelength(self) -> Floats:
        """Of every element (band, cross_track) [nm]."""
        return self.surface.grid()[0]

    @cached_property
    def spacing(self) -> Floats:
        """Of the bands, element by element (band, cross_track) [nm]."""
        return self.surface.grid()[1]

    @cached_property
    def centre_wavelength(self) -> Floats:
        """Of the bands at the centre column (band,) [nm]."""
        return np.asarray(self.wavelength[:, self.lab.shape[2] // 2])

    @cached_property
    def columns(self) -> npt.NDArray[np.int64]:
        """Column of every line (step, cross_track)."""
        return np.broadcast_to(np.arange(self.lab.shape[2]), self.lines.centre.shape)

    @cached_property
    def line_wavelength(self) -> Floats:
        """Wavelength of the lamp lines' centres in the map (step, cross_track) [nm], less the pull."""
        return line_wavelengths(self.lines, self.surface, self.pull)

    @cached_property
    def line_spacing(self) -> Floats:
        """Spacing of bands at the lines (step, cross_track) [nm]."""
        return self.surface.spacing(np.nan_to_num(self.lines.centre), self.columns)

    @cached_property
    def used(self) -> Bools:
        """Lamp lines whose area is used: those in place, and those at the edges completed from them."""
        return np.asarray(self.placed | self.lines.completed)

    @cached_property
    def fwhm_at_steps(self) -> Floats:
        """Width of the camera's line at every step (step,) [nm]."""
        return at_steps(self.lab, self.surface, self.fwhm)

    @cached_property
    def gain(self) -> tuple[Floats, Bools]:
        """Gain of every element [W m-2 sr-1 nm-1 s count-1], NaN where unknown; and whether it is known."""
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
        # without light scattered into the window of a lamp line
        nodes = _nodes(self.lines, lab, self.surface) * (factor[:, None] / self.off_lines.counted)
        low, high = EDGE_TOLERANCE_NM
        tolerance = min(max(low, 3.0 * self.surface.residual), high)
        return element_gain(lab.wavelength, nodes, used, self.wavelength, lab.etendue, tolerance)

    def dataset(self, flat: Floats | None) -> xr.Dataset:
        """Return the calibration."""
        gain, has_gain = self.gain
        if not has_gain.any():
            raise refused("no column has four reliable lamp lines", code="lamp-lines-few")
        if self.lab.absolute:
            self._check_plausible(gain)
        for text, code in self._warnings():
            warnings.warn(PaintWarning(text, code=code), stacklevel=3)
        # gains of raw counts: a flat field has levelled the fitted ones
        gain = gain.copy() if flat is None else np.asarray(row_medians(gain)[:, None] * flat)
        gain[:, self._unlit] = np.nan
        responsivity = 1.0 / (gain * self.lab.etendue * self.spacing)
        gain[self.bad] = np.nan
        good = np.isfinite(gain[:, np.isfinite(gain).any(axis=0)]).mean(axis=1) > 0.5
        values: dict[str, Any] = {
            "radiance_gain": gain,
            "responsivity": responsivity,
            "wavelength_u": np.hypot(self.surface.residual, self.budget.wavelength),
            **self._uncertainties(gain, good),
            **self._dark(),
            **self._line_variables(),
        }
        if flat is not None:
            values["flat_field"] = flat
        if self.lab.band_shift_time:
            values["band_shift_time"] = self.lab.band_shift_time
        if self.budget.linearity:
            values["linearity_u"] = self.budget.linearity
        table = self._table()
        coords = {
            "wavelength": self.centre_wavelength,
            "wavelength_shift": self.wavelength - self.centre_wavelength[:, None],
            "fwhm": self.fwhm,
            "band_spacing": self.spacing[:, self.lab.shape[2] // 2],
            "good": good,
            "step_wavelength": self.lab.wavelength,
        }
        if table is not None:
            coords["srf_offset"], values["srf"] = table
        if self.linearity.measured is not None:
            coords["linearity_counts"] = self.linearity.measured
            values["linear_counts"] = self.linearity.linear
        variables = {name: _labelled(value, name) for name, value in values.items()}
        if "band_shift_time" in variables:
            variables["band_shift_time"].attrs["bands"] = self.lab.shape[1]
        return xr.Dataset(
            variables,
            {name: _labelled(value, name) for name, value in coords.items()},
            self._attrs(good) | ({} if table is None else {"srf_shape": "tabulated"}),
        )

    @cached_property
    def measured(self) -> MeasuredShape | None:
        """Response measured from all lamp lines together; None where they are too few."""
        return measured_shape(
            self.lab, self.read, self.lines, self.surface, self.placed, self.fwhm_at_steps, self.shape
        )

    @cached_property
    def between(self) -> Between | None:
        """Error of the gain between the lamp lines; None where they are too few."""
        lab = self.lab
        return error_between_lines(
            lab.wavelength,
            line_level(self.lines, lab, self.surface, self.used),
            row_medians(self.line_wavelength - lab.wavelength[:, None], self.placed) + self.pull,
            shape_variance(lab.width, "triangle" if lab.triangular else "gaussian"),
        )

    @cached_property
    def _missed(self) -> float:
        # Error of the gain between lamp lines [1]; 0 if negligible, or explained by column differences
        shape_is_off = self.measured is not None and self.measured.is_another and not self.is_shape_free
        if self.between is None or shape_is_off:
            return 0.0
        nodes = np.where(self.used, _nodes(self.lines, self.lab, self.surface), np.nan)
        least = max(FRINGES.least_error, FRINGES.scatters * level_scatter(nodes))
        return self.between.error if self.between.error > least else 0.0

    def _warnings(self) -> Iterator[tuple[str, str]]:
        wide = self.lab.width > MAX_SLIT_SHARE * self.fwhm_at_steps
        if wide.any():
            share = float(np.max(self.lab.width / self.fwhm_at_steps))
            yield (
                f"the monochromator's line is up to {share:.2g} of the camera's FWHM wide (over "
                f"{MAX_SLIT_SHARE:g} at {int(wide.sum())} of {wide.size} steps): fwhm is ill-conditioned "
                "there; narrow the slits",
                "slit-too-wide",
            )
        offset = self.dark_check.get("dark_offset_count", 0.0)
        if abs(offset) > MAX_DARK_OFFSET:
            yield (
                f"the bands off the lamp lines hold {offset:+.2g} counts whatever their light, so the dark "
                "is off by as much: areas are corrected, but out_of_band and stray_light are not, in which "
                f"one count makes {self.dark_check['out_of_band_of_one_count']:.2%}; take the dark beside "
                "the sweep",
                "dark-offset",
            )
        if self.between is not None and self._missed:
            step = float(np.median(np.abs(np.diff(self.lab.wavelength))))
            yield (
                f"steps of {step:.3g} nm do not follow the responsivity around {self.between.wavelength:.0f} "
                "nm, as with fringes, an etalon, or a noisy power meter: between lamp lines gain and "
                f"reflectance may be wrong by {self.between.error:.1%}; sweep there in steps of "
                f"{step / 4:.2g} nm",
                "steps-too-coarse",
            )
        if self._unlit.any():
            first, last = self.surface.lit
            yield (
                f"{int(self._unlit.sum())} of {self._unlit.size} columns are not lit, all but {first} to "
                f"{last}: they get no gain, and the wavelengths of the nearest lit column",
                "columns-unlit",
            )

    def _table(self) -> tuple[Floats, Floats] | None:
        measured = self.measured
        if measured is None or not measured.is_another:
            return None
        if self.is_shape_free and measured.is_resolved:
            return measured.table(self.fwhm)
        reason = "srf_shape= is given" if measured.is_resolved else "the monochromator's line is too wide"
        warnings.warn(
            PaintWarning(
                f"the measured response is {measured.misfit:.1%} off the model {self.shape!r}, and is not "
                f"tabulated, since {reason}: reflectance beside sharp solar lines may be wrong by "
                f"{measured.effect:.1%}",
                code="response-shape-misfit",
            ),
            stacklevel=4,
        )
        return None

    def _uncertainties(self, gain: Floats, good: Bools) -> dict[str, Floats]:
        random = np.full(gain.shape, np.nan)
        for column in range(gain.shape[1]):
            used = np.flatnonzero(self.used[:, column])
            if used.size:
                random[:, column] = np.interp(
                    self.wavelength[:, column], self.lab.wavelength[used], self.lines.area_u[used, column]
                )
        slope = np.interp(self.centre_wavelength, self.lab.wavelength, self.line_slope)
        missed = self._missed
        total = np.sqrt(
            self.budget.total**2
            + (slope * self.surface.residual) ** 2
            + self.off_lines.counted_u**2
            + missed**2
        )
        random = np.hypot(random, self.differences)
        return {
            "radiance_gain_u_random": np.where(np.isfinite(gain), random, np.nan),
            "radiance_gain_u_systematic": np.where(good, total, np.nan),
        }

    def _dark(self) -> dict[str, Any]:
        lab = self.lab
        exposure = float(np.median(lab.exposure))
        variables: dict[str, Any] = {"dark_counts": lab.dark.at(exposure), "dark_exposure_time": exposure}
        if lab.dark.known_rate:
            variables |= {"dark_bias": lab.dark.bias, "dark_rate": lab.dark.rate}
        if lab.saturation is not None:
            variables["saturation_count"] = lab.saturation
        noise = self.read.noise
        electrons, read_noise = lab.electrons_per_count, lab.read_noise
        if self.read.noise_source == FROM_FRAMES:
            electrons = electrons or 1.0 / noise.slope
            if read_noise is None:
                read_noise = float(np.sqrt(max(noise.constant - QUANTISATION_VARIANCE_COUNT2, 0.0)))
        if electrons is not None:
            variables["electrons_per_count"] = electrons
        if read_noise is not None:
            variables["read_noise"] = read_noise
        return variables

    def _line_variables(self) -> dict[str, Any]:
        lines, steps = self.lines, self.lab.shape[0]
        beam = np.full((steps, 2), np.nan)
        for step, window in enumerate(self.read.windows):
            if window is not None:
                beam[step] = fit_beam(window.beam)
        used = self.placed.any(axis=1)
        second = np.full(steps, np.nan)
        second[used] = self.off_lines.second_order
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
            "stray_light": self.off_lines.stray_light * self.off_lines.counted,
            "stray_light_u": self.off_lines.relative,
        }

    def _check_plausible(self, gain: Floats) -> None:
        counts = PLANCK_TIMES_LIGHT / (self.wavelength * 1e-9) / (gain * self.lab.etendue * self.spacing)
        best = float(np.nanmax(np.nanmedian(counts[np.isfinite(counts).any(axis=1)], axis=1)))
        electrons = self.lab.electrons_per_count
        if electrons is None and self.read.noise_source == FROM_FRAMES:
            electrons = 1.0 / self.read.noise.slope
        low, high = (electrons, electrons) if electrons is not None else ELECTRONS_RANGE
        at = "" if electrons is None else f" at {electrons:.3g} electrons a count"
        if best * low > 1.05:
            share, expected, size = best * low, "below 1", "small"
        elif best * high < 1e-3:
            share, expected, size = best * high, "above 0.001", "large"
        else:
            return
        raise refused(
            f"{share:.3g} electrons out per photon in{at}, as flux x capture_fraction x exposure_time is too "
            f"{size}",
            expected=expected,
            mend="check the units of flux (uW for W) and of exposure_time (ms for s), and capture_fraction; "
            "without an absolute scale, pass absolute=False",
            code="scale-implausible",
        )

    @cached_property
    def _unlit(self) -> Bools:
        # Columns (cross_track,) beyond the outer lit ones, where the map is held constant
        first, last = self.surface.lit
        column = np.arange(self.lab.shape[2])
        return np.asarray((column < first) | (column > last))

    @cached_property
    def off_lines(self) -> OffLines:
        """Light off the lamp lines, of the steps in place."""
        used = self.placed.any(axis=1)
        return light_off_lines(
            self.read.rows[used],
            row_medians(self.lines.centre, self.placed)[used],
            self.lab.wavelength[used],
            self.centre_wavelength,
            row_medians(self.lines.width * self.line_spacing, self.placed)[used],
            self.dark_check,
        )

    @cached_property
    def dark_check(self) -> dict[str, float]:
        """Offset of the dark, and effect of one count of it on the light off the lamp lines."""
        return dark_off_lines(self.read.windows, self.lines.area, self.placed, self.read.rows)

    def _attrs(self, good: Bools) -> dict[str, Any]:
        lab = self.lab
        left_out = [float(w) for w in lab.wavelength[~self.used.any(axis=1)]]
        electrons_source = "none"
        if lab.electrons_per_count is not None:
            electrons_source = "as stated"
        elif self.read.noise_source == FROM_FRAMES:
            electrons_source = (
                "photon transfer of the sweep, to some per cent; see hyperpaint.radiometry.estimate_noise"
            )
        linearity: str | list[float] = "table" if self.linearity else "identity"
        if self.linearity.coefficients:
            linearity = list(self.linearity.coefficients)
        # distance of the measured response from the better model, and its effect
        shape_attrs: dict[str, Any] = {}
        if self.measured is not None:
            numbers = (float(f"{value:.3g}") for value in (self.measured.misfit, self.measured.effect))
            names = ("srf_model_misfit", "srf_model_effect")
            shape_attrs = {"srf_model": self.shape, **dict(zip(names, numbers, strict=True))}
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
            "wavelength_uncertainty_nm": self.budget.wavelength,
            "element_differences": self.differences,
            "stray_light_in_lines": self.off_lines.wing,
            "lit_columns": list(self.surface.lit),
            **self.dark_check,
            "smile_degree": self.surface.coefficients.shape[1] - 1,
            "linearity": linearity,
            "linearity_on": RAW if self.linearity.on_raw else DARK_SUBTRACTED,
            "noise_source": self.read.noise_source,
            "electrons_per_count_source": electrons_source,
            **{f"line_misfit_{name}": value for name, value in self.misfit.items()},
            **shape_attrs,
            **({} if self.between is None else {"gain_between_lines": float(f"{self.between.error:.3g}")}),
        }


def _labelled(value: Any, name: str) -> xr.DataArray:
    spec = VARIABLES[name]
    array = np.asarray(value)
    dims = next(d for d in (spec.dims, *spec.alternatives) if len(d) == array.ndim)
    return label(xr.DataArray(array.astype(dtype_of(name)), dims=dims), name)
