"""Check a lab sweep, report all faults together, and read its frames one step at a time."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.errors import Problem, Problems, SchemaError
from hyperpaint.base.facts import one_of
from hyperpaint.base.schema import CROSS_TRACK, MONOCHROMATOR_SHAPES, STEP, SWEEP_VARIABLES, Floats, find

from .detector import DarkModel, fit_dark_model

_REFUSAL = "this lab sweep cannot be calibrated"
MIN_STEPS = 4
_REQUIRED = ("counts", "dark_counts", "step_wavelength", "exposure_time", "monochromator_fwhm")
_ABSOLUTE = ("flux", "capture_fraction", "etendue")
_OPTIONAL = (
    "counts_variance",
    "dark_exposure_time",
    "frame_count",
    "dark_frame_count",
    "saturation_count",
    "electrons_per_count",
    "read_noise",
    "band_shift_time",
)
_POSITIVE = (
    "flux",
    "exposure_time",
    "etendue",
    "capture_fraction",
    "monochromator_fwhm",
    "frame_count",
    "dark_frame_count",
    "saturation_count",
    "electrons_per_count",
)


@dataclass(frozen=True, eq=False)
class LabSweep:
    # A checked sweep, in the units of the table, its small variables in memory.
    #: counts, variance (step, band, cross_track): lazy if the sweep is lazy; ``variance`` is None where
    #: unknown
    counts: xr.DataArray
    variance: xr.DataArray | None
    dark: DarkModel  #: Dark counts at the exposure of any step
    wavelength: Floats  #: (step,): wavelength of the monochromator [nm]
    width: Floats  #: (step,): full width at half maximum of the monochromator's line [nm]
    triangular: bool  #: Whether the monochromator's line is a triangle, otherwise a Gaussian
    exposure: Floats  #: (step,): exposure time [s]
    frames: Floats  #: (step,): frames averaged
    dark_frames: float | None  #: Frames averaged in a dark; None where unknown
    #: (step, cross_track): radiant flux that enters slit width x one column, all bands together [W]; ones
    #: without absolute scale, NaN in columns without flux
    power: Floats
    etendue: Floats  #: (cross_track,): etendue [m2 sr]
    saturation: Floats | None  #: Count at which the converter is full, or None; scalar or (band, cross_track)
    #: electrons_per_count, read_noise: median of the elements; None where unknown
    electrons_per_count: float | None
    read_noise: float | None
    absolute: bool  #: Whether the sweep has flux, capture fraction and etendue
    by_column: bool  #: Whether the sweep has the light of every column, not only of the beam
    #: Time in which a frame is shifted by one band under the light [s]; 0 without smear
    band_shift_time: float

    @property
    def shape(self) -> tuple[int, int, int]:
        # Steps, bands and columns.
        steps, bands, columns = self.counts.shape
        return steps, bands, columns

    def frame(self, step: int) -> Floats:
        # Return the mean counts of one step, dark not subtracted (band, cross_track).
        return np.asarray(self.counts.isel({STEP: step}).to_numpy(), np.float64)


def listed(values: Any, unit: str = "", limit: int = 6) -> str:
    # Return some values as text, and the number of further ones.
    values = list(values)
    text = ", ".join(f"{value:g}" if isinstance(value, float) else str(value) for value in values[:limit])
    more = f" and {len(values) - limit} more" if len(values) > limit else ""
    return f"{text}{f' {unit}' if unit else ''}{more}"


def refused(found: str, *, expected: str = "", mend: str = "", code: str) -> SchemaError:
    # Return the error for one problem of a sweep.
    return SchemaError(_REFUSAL, problems=[Problem(found, expected, mend, code=code)])


def check_sweep(sweep: xr.Dataset, *, absolute: bool = True) -> LabSweep:
    # Return a sweep in the units of the table; SchemaError with all its faults.
    #
    # ``sweep``: See `hyperpaint.calibrate`. ``absolute``: False where an anchor gives the absolute scale:
    # flux may then be in any unit of power, and capture fraction and etendue are not needed.
    #
    # Raises `SchemaError`: Variables, dims, units or values are missing or impossible; all problems are
    # listed.
    problems = Problems(_REFUSAL, SchemaError)
    needed = [*_REQUIRED, *(_ABSOLUTE if absolute else _ABSOLUTE[:1])]
    optional = [n for n in (*_ABSOLUTE, *_OPTIONAL) if n in sweep.variables and n not in needed]
    arrays, faults = find(sweep, [*needed, *optional], SWEEP_VARIABLES)
    problems.extend(faults)
    for name in [name for name, array in arrays.items() if array.dtype.kind not in "iuf"]:
        problems.add(
            f"{name!r} has dtype {arrays.pop(name).dtype}",
            expected=f"{SWEEP_VARIABLES[name].dtype}",
            code="type-wrong",
        )
    steps, columns = sweep.sizes.get(STEP, 0), sweep.sizes.get(CROSS_TRACK, 0)
    problems.add_if(
        sweep.sizes and steps < MIN_STEPS,
        f"{steps} steps",
        expected=f"at least {MIN_STEPS}",
        code="steps-too-few",
    )
    values = {
        name: np.asarray(array.to_numpy(), np.float64)
        for name, array in arrays.items()
        if name not in ("counts", "counts_variance", "dark_counts")
    }
    _check_order(values, problems)
    for name in (name for name in _POSITIVE if name in values):
        high, wavelength = 1.0 if name == "capture_fraction" else np.inf, values.get("step_wavelength")
        _check_positive(name, arrays[name].dims, values[name], high, wavelength, problems)
    for name, where, expected in (
        ("band_shift_time", " s", "the time of one band, some microseconds"),
        ("read_noise", " in places", "finite and at least zero"),
    ):
        value = values.get(name, np.zeros(()))
        problems.add_if(
            not (np.isfinite(value) & (value >= 0)).all(),
            f"{name!r} is {value.min(initial=np.inf):g}{where}",
            expected=expected,
            code="value-out-of-range",
        )
    shape = sweep.attrs.get("monochromator_shape", "gaussian")
    one_of(shape, MONOCHROMATOR_SHAPES, "attribute monochromator_shape", problems=problems)
    dark = _dark(arrays, values, problems)
    problems.raise_if_any()
    assert dark is not None  # otherwise there is a problem
    return _assembled(arrays, values, dark, (steps, columns), shape == "triangle")


def _check_order(values: dict[str, Floats], problems: Problems) -> None:
    if "step_wavelength" not in values:
        return
    wavelength = values["step_wavelength"]
    if not np.isfinite(wavelength).all() or (wavelength <= 0).any():
        problems.add("'step_wavelength' is not finite and positive everywhere", code="value-out-of-range")
        return
    unordered = np.flatnonzero(np.diff(wavelength) <= 0)
    if unordered.size:
        listed_steps = listed(
            [f"{wavelength[k + 1]:g} after {wavelength[k]:g} nm (step {k + 1})" for k in unordered], "", 3
        )
        problems.add(
            f"steps are out of order: {listed_steps}",
            mend="sort with sweep.sortby('step_wavelength') and drop repeated ones",
            code="steps-unordered",
        )


def _check_positive(
    name: str,
    dims: tuple[Any, ...],
    values: Floats,
    high: float,
    wavelength: Floats | None,
    problems: Problems,
) -> None:
    is_invalid = ~(np.isfinite(values) & (values > 0) & (values <= high))
    if dims == (STEP, CROSS_TRACK):
        # a step may have columns without flux, which are unlit, but not only such columns
        is_invalid &= ~(is_invalid & ((values == 0) | np.isnan(values))) | is_invalid.all(
            axis=1, keepdims=True
        )
    if not is_invalid.any():
        return
    expected = "positive and finite" if high == np.inf else f"above 0 and at most {high:g}"
    steps_text, mend = "", ""
    if STEP in dims:
        steps = np.flatnonzero(is_invalid.any(axis=tuple(range(1, values.ndim))))
        wavelengths_text = "" if wavelength is None else f" ({listed(wavelength[steps], 'nm')})"
        steps_text = f" at {steps.size} of {len(values)} steps{wavelengths_text}"
        mend = "measure it, or leave these steps out with sweep.isel(step=...)"
    problems.add(
        f"{name!r} is {values[is_invalid].ravel()[0]:g}{steps_text}",
        expected=expected,
        mend=mend,
        code="value-out-of-range",
    )


def _dark(arrays: dict[str, xr.DataArray], values: dict[str, Floats], problems: Problems) -> DarkModel | None:
    if "dark_counts" not in arrays:
        return None
    dark, exposure = arrays["dark_counts"], values.get("exposure_time")
    dark_exposure = values.get("dark_exposure_time", exposure)
    if exposure is None or dark_exposure is None:
        return None
    is_by_step = STEP in dark.dims
    if is_by_step:
        dark_exposure = np.broadcast_to(dark_exposure, dark.sizes[STEP])
    elif dark_exposure.ndim:
        # one dark for all steps: it needs a single exposure time
        if np.ptp(dark_exposure) > 1e-6 * dark_exposure.max():
            varying_name = "dark_exposure_time" if "dark_exposure_time" in values else "exposure_time"
            problems.add(
                f"{varying_name} varies from step to step, but there is one dark_counts",
                mend="pass dark_counts per step",
                code="dark-per-step",
            )
            return None
        dark_exposure = dark_exposure[0]
    array = np.asarray(dark.to_numpy(), np.float64)
    if not is_by_step:
        array, dark_exposure = array[None], np.atleast_1d(dark_exposure)
    model = fit_dark_model(array, np.asarray(dark_exposure, np.float64))
    exposures_outside = [e for e in np.unique(exposure) if not model.is_valid_at(float(e))]
    if exposures_outside:
        problems.add(
            f"steps at {listed([e * 1e3 for e in exposures_outside], 'ms')}, dark at "
            f"{listed([e * 1e3 for e in model.exposures], 'ms')}",
            mend="take a dark at the exposure of the steps, or darks at two exposures around it",
            code="dark-exposure-differs",
        )
        return None
    return model


def _assembled(
    arrays: dict[str, xr.DataArray],
    values: dict[str, Floats],
    dark: DarkModel,
    sizes: tuple[int, int],
    triangular: bool,
) -> LabSweep:
    steps, columns = sizes

    def per_step(name: str, default: float) -> Floats:
        return np.broadcast_to(values.get(name, np.float64(default)), (steps,)).astype(np.float64)

    def per_line(name: str) -> Floats:
        value = values.get(name, np.ones(()))
        value = np.where(value > 0, value, np.nan)
        return np.broadcast_to(value[:, None] if value.ndim == 1 else value, (steps, columns))

    def scalar(name: str) -> float | None:
        return float(np.nanmedian(values[name])) if name in values else None

    return LabSweep(
        counts=arrays["counts"],
        variance=arrays.get("counts_variance"),
        dark=dark,
        wavelength=values["step_wavelength"],
        width=per_step("monochromator_fwhm", 0.0),
        triangular=triangular,
        exposure=per_step("exposure_time", np.nan),
        frames=per_step("frame_count", 1.0),
        dark_frames=scalar("dark_frame_count"),
        power=np.asarray(per_line("flux") * per_line("capture_fraction")),
        etendue=np.broadcast_to(values.get("etendue", np.float64(1.0)), (columns,)).astype(np.float64),
        saturation=values.get("saturation_count"),
        electrons_per_count=scalar("electrons_per_count"),
        read_noise=scalar("read_noise"),
        absolute=all(name in arrays for name in _ABSOLUTE),
        by_column=any(
            name in arrays and CROSS_TRACK in arrays[name].dims for name in ("flux", "capture_fraction")
        ),
        band_shift_time=scalar("band_shift_time") or 0.0,
    )
