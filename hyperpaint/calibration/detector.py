"""Detector properties without a spectrum: dark at any exposure, flat field, linearity, bad elements.

Check a lab sweep, report all faults together, and read its frames one step at a time.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base import (
    BAND,
    CROSS_TRACK,
    MONOCHROMATOR_SHAPES,
    STEP,
    SWEEP_VARIABLES,
    Array,
    ArrayLike,
    Bools,
    Floats,
    Problem,
    Problems,
    SchemaError,
    find,
    label,
    one_of,
    require,
    takes_quantities,
)

_ELEMENT = (BAND, CROSS_TRACK)
#: Relative difference of exposure times that are taken as equal, by rounding of drivers [1].
SAME_EXPOSURE = 1e-3
#: Largest extrapolation of a dark model, as a factor on the shortest and longest exposure of its darks [1].
MAX_EXTRAPOLATION = 2.0
#: Largest uncertainty of a modelled dark [count].
MAX_DARK_U = 1.0


@dataclass(frozen=True, eq=False)
class DarkModel:
    # Dark counts as bias + rate x exposure.
    #: bias, rate (band, cross_track): [count], [count s-1]; from darks at one exposure the bias is the dark,
    #: and the rate is NaN
    bias: Floats
    rate: Floats
    exposures: tuple[float, ...]  #: Different exposure times of the darks [s]
    residual: float  #: Root mean square distance of the darks from the model [count]
    taken: Floats  #: (dark,): exposure of every dark [s]

    @property
    def has_rate(self) -> bool:
        # Whether the rate follows from darks at two exposures or more.
        return len(self.exposures) > 1

    def is_valid_at(self, exposure: float) -> bool:
        # Return whether the model is valid at an exposure [s]: near those of the darks, to one count.
        if not self.has_rate:
            return abs(exposure - self.exposures[0]) <= SAME_EXPOSURE * exposure
        is_near = self.exposures[0] / MAX_EXTRAPOLATION <= exposure <= self.exposures[-1] * MAX_EXTRAPOLATION
        return is_near and self.spread * np.sqrt(self.leverage(exposure)) <= MAX_DARK_U

    @property
    def spread(self) -> float:
        # Standard deviation of one dark about the model [count]; 0 where there are too few.
        freedom = len(self.taken) - (2 if self.has_rate else 1)
        return self.residual * float(np.sqrt(len(self.taken) / freedom)) if freedom > 0 else 0.0

    def leverage(self, exposure: float) -> float:
        # Return the variance of the dark at an exposure [s] relative to the variance of one dark.
        count = len(self.taken)
        if not self.has_rate:
            return 1.0 / count
        offset = self.taken - self.taken.mean()
        return float(1.0 / count + (exposure - self.taken.mean()) ** 2 / (offset**2).sum())

    def at(self, exposure: float) -> Floats:
        # Return the dark counts at an exposure [s]; of a single exposure, the mean dark.
        return self.bias + exposure * self.rate if self.has_rate else self.bias


def fit_dark_model(dark: Floats, exposure: Floats) -> DarkModel:
    # Return the least-squares model of darks (dark, band, cross_track) at exposures (dark,) [s].
    different = [float(exposure.min())]
    for value in np.sort(exposure):
        if value > different[-1] * (1.0 + SAME_EXPOSURE):
            different.append(float(value))
    mean = dark.mean(axis=0)
    if len(different) == 1:
        return DarkModel(
            mean,
            np.full_like(mean, np.nan),
            tuple(different),
            float(np.sqrt(np.nanmean((dark - mean) ** 2))),
            exposure,
        )
    offset = exposure - exposure.mean()
    rate = np.tensordot(offset, dark, axes=1) / (offset**2).sum()
    bias = mean - rate * exposure.mean()
    return DarkModel(
        bias,
        rate,
        tuple(different),
        float(np.sqrt(np.nanmean((dark - bias - exposure[:, None, None] * rate) ** 2))),
        exposure,
    )


def dark_model(darks: xr.Dataset | Sequence[xr.Dataset]) -> xr.Dataset:
    """Return dark counts as bias + rate x exposure, from darks at several exposures.

    Parameters
    ----------
    darks
        Each with ``dark_counts`` ([dark_time,] band, cross_track) [count] and ``dark_exposure_time``
        ([dark_time]) [s], as flight lines and calibrations hold them.

    Returns
    -------
    xarray.Dataset
        ``dark_bias`` [count], ``dark_rate`` [count s-1] (band, cross_track); attributes ``dark_exposures_s``,
        ``dark_residual_count`` (root mean square), and, for darks with times, ``dark_drift_count``:
        difference of the means of the last and the first dark, beyond the effect of their exposures.

    Raises
    ------
    SchemaError
        Variables are missing, shapes differ, or all darks have one exposure.

    Examples
    --------
    >>> import xarray as xr
    >>> def dark(seconds):
    ...     counts = xr.DataArray([[100 + 50 * seconds]], dims=("band", "cross_track"))
    ...     counts.attrs["units"] = "count"
    ...     exposure = xr.DataArray(seconds, attrs={"units": "s"})
    ...     return xr.Dataset({"dark_counts": counts, "dark_exposure_time": exposure})
    >>> model = dark_model([dark(0.01), dark(0.03)])
    >>> round(float(model.dark_bias[0, 0]), 6), round(float(model.dark_rate[0, 0]), 6)
    (100.0, 50.0)
    """
    problems = Problems("no dark model can be made", SchemaError)
    frames: list[Floats] = []
    exposures: list[float] = []
    for number, dark in enumerate([darks] if isinstance(darks, xr.Dataset) else darks):
        try:
            arrays = require(dark, ["dark_counts", "dark_exposure_time"], "a dark model")
        except SchemaError as error:
            problems.add_error(f"dark {number}", error)
            continue
        counts = np.asarray(arrays["dark_counts"].to_numpy(), np.float64)
        counts = counts if counts.ndim == 3 else counts[None]
        frames.extend(counts)
        exposures.extend(np.broadcast_to(arrays["dark_exposure_time"].to_numpy(), len(counts)).tolist())
    shapes = sorted({frame.shape for frame in frames})
    problems.raise_if_any(
        (len(shapes) > 1, Problem(f"darks of shapes {shapes}", expected="one shape", code="grid-mismatch")),
        (
            not all(0 < value < np.inf for value in exposures),
            Problem("'dark_exposure_time' is not finite and positive everywhere", code="exposure-invalid"),
        ),
    )
    model = fit_dark_model(np.stack(frames), np.array(exposures))
    SchemaError.raise_if(
        not model.has_rate,
        f"all darks have an exposure of {exposures[0] * 1e3:g} ms",
        expected="darks at two exposures, for a rate",
        code="dark-exposures-few",
    )
    drift = np.nanmean(frames[-1] - model.at(exposures[-1])) - np.nanmean(frames[0] - model.at(exposures[0]))
    return xr.Dataset(
        {
            "dark_bias": label(xr.DataArray(model.bias.astype(np.float32), dims=_ELEMENT), "dark_bias"),
            "dark_rate": label(xr.DataArray(model.rate.astype(np.float32), dims=_ELEMENT), "dark_rate"),
        },
        attrs={
            "dark_exposures_s": list(model.exposures),
            "dark_residual_count": model.residual,
            "dark_drift_count": float(drift),
        },
    )


@takes_quantities(exposure_time="s")
def dark_at(model: xr.Dataset, exposure_time: float) -> xr.DataArray:
    """Return the ``dark_counts`` (band, cross_track) [count] of a dark model at an exposure [s].

    Only the rate is scaled by the exposure, never the bias.

    Examples
    --------
    >>> import xarray as xr
    >>> element = ("band", "cross_track"), [[100.0]]
    >>> model = xr.Dataset({"dark_bias": element, "dark_rate": (element[0], [[50.0]])})
    >>> dark_at(model, 0.02).values
    array([[101.]], dtype=float32)
    """
    dark = model["dark_bias"] + np.float32(exposure_time) * model["dark_rate"]
    return label(dark.astype(np.float32), "dark_counts")


@takes_quantities()
def flat_field(frames: xr.DataArray, dark: xr.DataArray | None = None) -> xr.DataArray:
    """Return the factors that level the columns of each band, from evenly lit frames.

    Parameters
    ----------
    frames
        Counts (..., band, cross_track) [count] of a sphere or a diffuser; or many lines of a scene, over
        similar ground. The median over all other dims is taken.
    dark
        Dark counts (band, cross_track) [count] at the same exposure; None where they are already subtracted.

    Returns
    -------
    xarray.DataArray
        ``flat_field`` (band, cross_track) [1]: factor on dark-subtracted counts, of mean inverse 1 over the
        columns of a band; NaN where an element sees no light.

    Raises
    ------
    SchemaError
        ``frames`` lack band or cross_track.

    Examples
    --------
    >>> import xarray as xr
    >>> frames = xr.DataArray([[[90.0, 110.0]]], dims=("along_track", "band", "cross_track"))
    >>> flat_field(frames).round(4).values
    array([[1.1111, 0.9091]], dtype=float32)
    """
    SchemaError.raise_if(
        not set(_ELEMENT) <= set(frames.dims),
        f"flat-field frames have dims {tuple(map(str, frames.dims))}",
        expected=f"{BAND} and {CROSS_TRACK}",
        code="dims-wrong",
    )
    other_dims = [dim for dim in frames.dims if dim not in _ELEMENT]
    level = frames.astype(np.float64)
    if other_dims:
        level = level.chunk(dict.fromkeys(other_dims, -1)) if level.chunks is not None else level
        level = level.median(other_dims)
    level = level.transpose(*_ELEMENT)
    if dark is not None:
        level = level - dark.transpose(*_ELEMENT).astype(np.float64)
    level = level.where(level > 0)
    return label((level.mean(CROSS_TRACK) / level).transpose(*_ELEMENT).astype(np.float32), "flat_field")


def element_values(array: xr.DataArray, shape: tuple[int, ...], name: str) -> Array:
    # Return the values of an argument; SchemaError unless its ``shape`` (band, cross_track) fits.
    SchemaError.raise_if(
        set(array.dims) != set(_ELEMENT) or array.transpose(*_ELEMENT).shape != shape,
        f"{name} has sizes {dict(array.sizes)}",
        expected=f"{BAND} and {CROSS_TRACK} of {shape}",
        code="grid-mismatch",
    )
    return array.transpose(*_ELEMENT).to_numpy()


@takes_quantities()
def linearity(signal: ArrayLike, measured: ArrayLike, degree: int = 3) -> tuple[float, ...]:
    r"""Return the polynomial from measured counts to counts proportional to the light.

    Parameters
    ----------
    signal
        Light of each measurement, any unit: exposures [s] of one steady source, lamp levels ...
    measured
        Dark-subtracted counts.
    degree
        Degree of the polynomial.

    Returns
    -------
    Coefficients :math:`a_2, a_3 \dots` of :math:`c + a_2 c^2 + a_3 c^3 + \dots`, which leaves small counts
    unchanged; ``()`` is the identity.

    Raises
    ------
    SchemaError
        Fewer measurements than unknowns of the polynomial, or values that are not positive.

    Examples
    --------
    >>> import numpy as np
    >>> light = np.linspace(0.1, 1, 10)
    >>> measured = 1000 * light * (1 - 0.02 * light)
    >>> linear = measured + sum(a * measured**k for k, a in enumerate(linearity(light, measured), 2))
    >>> bool(np.ptp(linear / light) < 0.1)
    True
    """
    light, counts = np.asarray(signal, np.float64).ravel(), np.asarray(measured, np.float64).ravel()
    SchemaError.raise_if(
        light.size != counts.size or light.size < degree or not (light > 0).all() or not (counts > 0).all(),
        f"linearity of degree {degree} from {light.size} signals and {counts.size} counts",
        expected=f"{degree} or more, positive, in pairs",
        code="signals-too-few",
    )
    # s light = c + a2 c^2 + ...: linear in s and the a; divided by c, all measurements have equal weight
    scale = counts.max()
    columns = [light / counts, *(-((counts / scale) ** (power - 1)) for power in range(2, degree + 1))]
    solution = np.linalg.lstsq(np.column_stack(columns), np.ones_like(counts), rcond=None)[0]
    return tuple(
        float(a / scale ** (power - 1)) for power, a in zip(range(2, degree + 1), solution[1:], strict=True)
    )


def row_medians(values: Floats, used: Bools | None = None) -> Floats:
    # Return the median of every row over used values that are not NaN; NaN without any.
    values_used = values if used is None else np.where(used, values, np.nan)
    medians, rows = np.full(len(values_used), np.nan), ~np.isnan(values_used).all(axis=1)
    medians[rows] = np.nanmedian(values_used[rows], axis=1)
    return medians


def deviant_darks(dark: Floats, saturation: Floats | None) -> Bools:
    # Return whether the dark of elements (band, cross_track) is not finite, saturated or an outlier.
    is_finite = np.isfinite(dark)
    levels = np.where(is_finite, dark, np.nan)
    median = np.nanmedian(levels)
    # the limit is far above the camera's dark pattern
    is_outlier = np.abs(levels - median) > max(30.0 * (1.4826 * np.nanmedian(np.abs(levels - median))), 100.0)
    if saturation is not None:
        is_outlier |= levels > 0.5 * saturation
    return np.asarray(~is_finite | is_outlier)


# --- lab sweeps --------------------------------------------------------------------------------------------

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
