"""The detector: dark at any exposure, flat field, linearity, bad elements, and lamp lines on it.

Check a lab sweep, report all faults together, and read its frames one step at a time.

Lamp lines of sweep steps: their fits, their agreement with the wavelength map, and deviant elements.

Centre, lit columns, width and area are fitted separately over bands and columns: over bands, light of one
wavelength shows the response of the camera; over columns, it shows the profile of the beam, which is not a
property of the camera.

Four parameters cannot be fitted to half a lamp line. For a lamp line at the edge of the array the wavelength
map gives the centre and the neighbours give the width; only the height is fitted, and the area follows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from types import SimpleNamespace
from typing import Any

import numpy as np
import xarray as xr
from numpy.polynomial import chebyshev

from hyperpaint.base import (
    ALONG_TRACK,
    BAND,
    CROSS_TRACK,
    ELEMENT,
    MONOCHROMATOR_SHAPES,
    QUANTISATION_VARIANCE_COUNT2,
    SATURATION_MARGIN_COUNTS,
    STEP,
    SWEEP_VARIABLES,
    ArrayLike,
    Bools,
    Floats,
    Ints,
    Problem,
    Problems,
    SchemaError,
    find,
    finite_mean,
    label,
    one_of,
    require,
    takes_quantities,
    warn_if,
    warn_user,
)
from hyperpaint.base.schema import refuse_other_labels, with_steps
from hyperpaint.kernels.arguments import LineFits, LineSamples
from hyperpaint.kernels.line_fits import (
    AREA,
    CENTRE,
    GAUSSIAN,
    OFFSET,
    SLIT,
    WIDTH,
    fit_lines,
    full_widths,
    profiles,
)
from hyperpaint.radiometry.stray_light import Linearity, smear_of

#: Relative difference of exposure times that are taken as equal, by rounding of drivers [1].
SAME_EXPOSURE = 1e-3
#: Largest extrapolation of a dark model, as a factor on the shortest and longest exposure of its darks [1].
MAX_EXTRAPOLATION = 2.0
#: Largest uncertainty of a modelled dark [count].
MAX_DARK_U = 1.0
#: Counts that rise by less than the tolerance, relative, over a larger relative span of light are of a full
#: detector [1]; with a loss of 30 % at the highest count, they rise by 3 % over this span.
FULL = SimpleNamespace(counts_tolerance=0.002, min_light_span=0.05)


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
    datasets: Sequence[Any] = [darks] if isinstance(darks, xr.Dataset) else darks
    for number, dark in enumerate(datasets):
        if not isinstance(dark, xr.Dataset):
            problems.add(f"dark {number} is {type(dark).__name__}", expected="a Dataset", code="type-wrong")
            continue
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
        (not frames and not len(problems), Problem("no dark", expected="two or more", code="empty-input")),
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
            "dark_bias": label(xr.DataArray(model.bias.astype(np.float32), dims=ELEMENT), "dark_bias"),
            "dark_rate": label(xr.DataArray(model.rate.astype(np.float32), dims=ELEMENT), "dark_rate"),
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

    Raises
    ------
    SchemaError
        The model has no ``dark_bias`` or ``dark_rate``, as calibrations from darks at one exposure.

    Examples
    --------
    >>> import xarray as xr
    >>> element = ("band", "cross_track"), [[100.0]]
    >>> model = xr.Dataset({"dark_bias": element, "dark_rate": (element[0], [[50.0]])})
    >>> dark_at(model, 0.02).values
    array([[101.]], dtype=float32)
    """
    missing = [name for name in ("dark_bias", "dark_rate") if name not in model.variables]
    SchemaError.raise_if(
        missing,
        f"{', '.join(map(repr, missing))} missing",
        mend="make the model by dark_model, from darks at two exposures",
        code="variable-missing",
    )
    dark = model["dark_bias"] + np.float32(exposure_time) * model["dark_rate"]
    return label(dark.astype(np.float32), "dark_counts")


@takes_quantities()
def flat_field(frames: xr.DataArray, dark: xr.DataArray | float | None = None) -> xr.DataArray:
    """Return the factors that level the columns of each band, from evenly lit frames.

    Parameters
    ----------
    frames
        Counts (..., band, cross_track) [count] of a sphere or a diffuser; or many lines of a scene, over
        similar ground. The median over all other dims is taken. Saturated frames are left out by the caller.
    dark
        Dark counts ([along_track,] band, cross_track) [count] at the same exposure, or one number; None where
        they are already subtracted.

    Returns
    -------
    xarray.DataArray
        ``flat_field`` (band, cross_track) [1]: factor on dark-subtracted counts, of mean inverse 1 over the
        columns of a band; NaN where an element sees no light.

    Raises
    ------
    SchemaError
        ``frames`` lack band or cross_track, or ``dark`` is of other elements.

    Examples
    --------
    >>> import xarray as xr
    >>> frames = xr.DataArray([[[90.0, 110.0]]], dims=("along_track", "band", "cross_track"))
    >>> flat_field(frames).round(4).values
    array([[1.1111, 0.9091]], dtype=float32)
    """
    dims = frames.dims if isinstance(frames, xr.DataArray) else ()
    SchemaError.raise_if(
        not set(ELEMENT) <= set(dims),
        f"flat-field frames are {type(frames).__name__} of dims {tuple(map(str, dims))}",
        expected=f"a DataArray with {BAND} and {CROSS_TRACK}",
        code="dims-wrong",
    )
    other_dims = [dim for dim in frames.dims if dim not in ELEMENT]
    level = frames.astype(np.float64)
    if other_dims:
        level = level.chunk(dict.fromkeys(other_dims, -1)) if level.chunks is not None else level
        level = level.median(other_dims)
    level = level.transpose(*ELEMENT)
    if isinstance(dark, xr.DataArray) and ALONG_TRACK in dark.dims:
        dark = dark.mean(ALONG_TRACK)
    if dark is not None:
        is_number = isinstance(dark, float | int) or (isinstance(dark, xr.DataArray) and not dark.ndim)
        level = level - (float(dark) if is_number else on_elements(dark, level, "dark").astype(np.float64))
    level = level.where(level > 0)
    return label((level.mean(CROSS_TRACK) / level).transpose(*ELEMENT).astype(np.float32), "flat_field")


def on_elements(value: Any, like: xr.DataArray, name: str) -> xr.DataArray:
    # Return an argument (band, cross_track), labelled or a plain array, for the elements of ``like``, which
    # has these dims; SchemaError where sizes or labels differ.
    shape = tuple(like.sizes[dim] for dim in ELEMENT)
    if isinstance(value, np.ndarray) and value.shape == shape:
        value = xr.DataArray(value, dims=ELEMENT)
    sizes = dict(value.sizes) if isinstance(value, xr.DataArray) else getattr(value, "shape", "unknown")
    SchemaError.raise_if(
        sizes != dict(zip(ELEMENT, shape, strict=True)),
        f"{name} is {type(value).__name__} of sizes {sizes}",
        expected=f"a DataArray with {BAND} and {CROSS_TRACK} of {shape}",
        code="grid-mismatch",
    )
    refuse_other_labels(value, like, name, ELEMENT, "the frames")
    unlabelled: xr.DataArray = value.drop_vars(value.coords).transpose(*ELEMENT)
    return unlabelled


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

    Warns
    -----
    PaintWarning
        The highest counts are of a full detector; they are left out.

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
    for name, values in (("signal", light), ("measured", counts)):
        invalid = np.flatnonzero(~((values > 0) & np.isfinite(values)))
        SchemaError.raise_if(
            invalid.size,
            f"{name} is {listed(values[invalid].tolist())} at number {listed(invalid.tolist())}",
            expected="positive and finite",
            mend="leave these measurements out",
            code="value-out-of-range",
        )
    # a full detector gives the same counts for more light
    if light.size == counts.size > 0:
        brightest = light[counts >= (1.0 - FULL.counts_tolerance) * counts.max()]
        if np.ptp(brightest) > FULL.min_light_span * brightest.min():
            is_used = light < brightest.min()
            warn_user(
                f"counts end at {counts.max():g} from signal {brightest.min():g} on: the detector is full; "
                f"{light.size - int(is_used.sum())} of {light.size} measurements are left out",
                "elements-saturated",
            )
            light, counts = light[is_used], counts[is_used]
    SchemaError.raise_if(
        light.size != counts.size or light.size < max(degree, 1),
        f"linearity of degree {degree} from {light.size} signals and {counts.size} counts",
        expected=f"{degree} or more, in pairs",
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


def refuse_if(is_fault: Any, found: str, *, expected: str = "", mend: str = "", code: str) -> None:
    # Raise the error for one problem of a sweep.
    Problems(_REFUSAL, SchemaError).raise_if_any((is_fault, Problem(found, expected, mend, code=code)))


def check_sweep(sweep: xr.Dataset, *, absolute: bool = True) -> LabSweep:
    # Return a sweep in the units of the table; SchemaError with all its faults.
    #
    # ``sweep``: See `hyperpaint.calibrate`. ``absolute``: False where an anchor gives the absolute scale:
    # flux may then be in any unit of power, and capture fraction and etendue are not needed.
    #
    # Raises `SchemaError`: Variables, dims, units or values are missing or impossible; all problems are
    # listed.
    sweep = with_steps(sweep)
    with Problems(_REFUSAL, SchemaError) as problems:
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
        sweep_nm = values.get("step_wavelength", np.ones(1))
        if not np.isfinite(sweep_nm).all() or (sweep_nm <= 0).any():
            problems.add("'step_wavelength' is not finite and positive everywhere", code="value-out-of-range")
        elif (unordered := np.flatnonzero(np.diff(sweep_nm) <= 0)).size:
            texts = [f"{sweep_nm[k + 1]:g} after {sweep_nm[k]:g} nm (step {k + 1})" for k in unordered]
            problems.add(
                f"steps are out of order: {listed(texts, '', 3)}",
                mend="sort with sweep.sortby('step_wavelength') and drop repeated ones",
                code="steps-unordered",
            )
        for name in (name for name in _POSITIVE if name in values):
            high, wavelength = 1.0 if name == "capture_fraction" else np.inf, values.get("step_wavelength")
            dims, value = arrays[name].dims, values[name]
            is_invalid = ~(np.isfinite(value) & (value > 0) & (value <= high))
            if dims == (STEP, CROSS_TRACK):
                # a step may have columns without flux, which are unlit, but not only such columns
                is_unlit = is_invalid & ((value == 0) | np.isnan(value))
                is_invalid &= ~is_unlit | is_invalid.all(axis=1, keepdims=True)
            steps_text, mend = "", ""
            if STEP in dims:
                faulty = np.flatnonzero(is_invalid.any(axis=tuple(range(1, value.ndim))))
                wavelengths_text = "" if wavelength is None else f" ({listed(wavelength[faulty], 'nm')})"
                steps_text = f" at {faulty.size} of {len(value)} steps{wavelengths_text}"
                mend = "measure it, or leave these steps out with sweep.isel(step=...)"
            if is_invalid.any():
                problems.add(
                    f"{name!r} is {value[is_invalid].ravel()[0]:g}{steps_text}",
                    expected="positive and finite" if high == np.inf else f"above 0 and at most {high:g}",
                    mend=mend,
                    code="value-out-of-range",
                )
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
    assert dark is not None  # otherwise there is a problem

    def per_step(name: str, default: float) -> Floats:
        return np.broadcast_to(values.get(name, np.float64(default)), (steps,)).astype(np.float64)

    def per_line(name: str) -> Floats:
        stated = values.get(name, np.ones(()))
        stated = np.where(stated > 0, stated, np.nan)
        return np.broadcast_to(stated[:, None] if stated.ndim == 1 else stated, (steps, columns))

    def scalar(name: str) -> float | None:
        return float(np.nanmedian(values[name])) if name in values else None

    return LabSweep(
        counts=arrays["counts"],
        variance=arrays.get("counts_variance"),
        dark=dark,
        wavelength=values["step_wavelength"],
        width=per_step("monochromator_fwhm", 0.0),
        triangular=shape == "triangle",
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


def _dark(arrays: dict[str, xr.DataArray], values: dict[str, Floats], problems: Problems) -> DarkModel | None:
    if "dark_counts" not in arrays:
        return None
    dark, exposure = arrays["dark_counts"], values.get("exposure_time")
    dark_exposure = values.get("dark_exposure_time", exposure)
    if exposure is None or dark_exposure is None:
        return None
    array = np.asarray(dark.to_numpy(), np.float64)
    if STEP in dark.dims:
        dark_exposure = np.broadcast_to(dark_exposure, dark.sizes[STEP])
    else:
        # one dark for all steps: it needs a single exposure time
        array, dark_exposure = array[None], np.atleast_1d(dark_exposure)
        if np.ptp(dark_exposure) > 1e-6 * np.abs(dark_exposure).max():
            varying_name = "dark_exposure_time" if "dark_exposure_time" in values else "exposure_time"
            problems.add(
                f"{varying_name} varies from step to step, but there is one dark_counts",
                mend="pass dark_counts per step",
                code="dark-per-step",
            )
            return None
        dark_exposure = dark_exposure[:1]
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


#: Line shapes that a sweep distinguishes, with their numbers in the kernel.
SHAPES = {"gaussian": GAUSSIAN, "slit": SLIT}

#: Minimum light of a lit column, relative to the brightest column.
LIT = 0.2

#: Half width of the window of a lamp line in full widths at half maximum; 2e-7 of a Gaussian's area lies
#: beyond.
REACH = 2.2

_MAX_DEVIATION_SHARE = 0.15  # of a lamp line's height; a larger deviation from the fit is not noise
_MIN_BACKGROUND_BANDS = 12  # minimum number of bands outside a window for an estimate of its background
_GAUSSIAN_AREA = np.sqrt(np.pi / (4.0 * np.log(2.0)))  # area of a Gaussian of unit height and full width


@dataclass(frozen=True)
class NoiseModel:
    # Variance of one frame, constant + slope x signal, and of the subtracted dark [count2].
    constant: float
    slope: float
    dark: float = 0.0

    def variance(self, signal: Floats, frames: float) -> Floats:
        # Return the variance of the mean of some frames less the dark.
        return np.asarray((self.constant + self.slope * np.maximum(signal, 0.0)) / frames + self.dark)


@dataclass(frozen=True, eq=False)
class Window:
    """The bands around the lamp line of one step, column by column."""

    columns: Ints  #: (line,): lit columns
    #: (line,): band of the first sample; negative where the window begins before the array
    first: Ints
    #: (line, sample): counts less dark and background; NaN outside the array and at bad elements
    values: Floats
    #: background, background_variance (line,): subtracted background [count], and its variance in units
    #: of the variance of one band
    background: Floats
    background_variance: Floats
    saturated: Bools  #: (line,): whether a sample is at the converter's end
    #: (cross_track,): light of every column relative to the brightest; NaN without valid elements
    beam: Floats
    #: (band,): counts of the bands outside the window relative to the area, mean of the lit columns; 0 inside
    out_of_band: Floats
    band: int  #: Band of the peak

    @property
    def places(self) -> Floats:
        # Band of every sample (line, sample).
        return np.asarray(self.first[:, None] + np.arange(self.values.shape[1]), np.float64)

    def leave_out(self, bad: Bools) -> None:
        # Blank the samples of bad elements (band, cross_track).
        band_numbers = self.first[:, None] + np.arange(self.values.shape[1])
        self.values[bad[np.clip(band_numbers, 0, len(bad) - 1), self.columns[:, None]]] = np.nan


@dataclass(frozen=True, eq=False)
class Fits:
    # Fits of one step's lines; widths and centres in bands.
    #: (line, 4): centre [band], full width at half maximum of the camera [band], area [count], offset
    #: [count]
    parameters: Floats
    covariance: Floats  #: (line, 4, 4): of the parameters
    width: Floats  #: (line,): full width at half maximum of the measured lamp line [band]
    amplitude: Floats  #: (line,): height [count]
    #: area, area_variance (line,): sum over bands [count]: as measured, with the unseen part taken from
    #: the fit
    area: Floats
    area_variance: Floats
    #: chi2, degrees (line,): weighted sum of squared residuals and degrees of freedom
    chi2: Floats
    degrees: Floats
    converged: Bools  #: (line,): whether the fit converged to finite numbers


def find_line(net: Floats, raw: Floats, bad: Bools, saturation: Floats | None) -> Window | None:
    # Return the window around the lamp line of one step; None without a line.
    #
    # ``net`` (band, cross_track) are counts less dark, ``raw`` counts as read; ``bad`` elements are left
    # out; ``saturation`` is the count at which the converter is full, or None.
    bands, columns = net.shape
    valid_net = np.where(bad | ~np.isfinite(net), np.nan, net)
    spectrum = finite_mean(valid_net, axis=1)
    is_valid = np.isfinite(spectrum)
    if not is_valid.any():
        return None
    spectrum = np.where(is_valid, spectrum - np.median(spectrum[is_valid]), 0.0)
    smooth = np.convolve(spectrum, np.ones(3) / 3.0, mode="same")
    peak = int(np.argmax(smooth))
    is_far = np.abs(np.arange(bands) - peak) > 0.1 * bands
    scatter = 1.4826 * float(np.median(np.abs(spectrum[is_far]))) if is_far.any() else 0.0
    if not smooth[peak] > max(8.0 * scatter, 1e-9):
        return None
    # full width of a peak from area over height, at least one band [band].
    half_width = 3
    for _ in range(6):
        samples = spectrum[max(peak - half_width, 0) : peak + half_width + 1]
        # at the edge of the array, a lamp line has only one side
        share = 1.0 + min(peak, len(spectrum) - 1 - peak, half_width) / half_width
        width = max(2.0 * samples.sum() / share / (samples.max() * _GAUSSIAN_AREA), 1.0)
        needed_half = int(np.ceil(2.0 * width + 1.0))
        if needed_half <= half_width:
            break
        half_width = min(needed_half, len(spectrum))
    width = float(min(width, len(spectrum) / 4.0))
    half_width = int(np.ceil(REACH * width + 2.0))
    # peak of the lamp line in each column, which moves by smile
    margin = int(np.ceil(width)) + 3
    near_bands = np.arange(max(peak - margin, 0), min(peak + margin + 1, bands))
    strip = np.where(np.isfinite(valid_net[near_bands]), valid_net[near_bands], 0.0)
    strip = strip[:-2] + strip[1:-1] + strip[2:] if len(near_bands) > 4 else strip
    peak_bands = near_bands[np.argmax(strip, axis=0) + (1 if len(near_bands) > 4 else 0)]
    first = (peak_bands - half_width).astype(np.int64)
    band_numbers = first[:, None] + np.arange(2 * half_width + 1)
    is_inside = (band_numbers >= 0) & (band_numbers < bands)
    clipped = np.clip(band_numbers, 0, bands - 1)
    column_index = np.arange(columns)[:, None]
    values = np.where(is_inside, valid_net[clipped, column_index], np.nan)
    outside = valid_net.copy()
    outside[clipped, column_index] = np.nan
    # background: clipped mean of each column outside its window, and its variance relative to that of a band
    # A drift of the dark shifts all bands equally; uncorrected, it would add to the area band by band.
    background, variance = np.zeros((2, columns))
    covered = np.flatnonzero(np.isfinite(outside).sum(axis=0) >= _MIN_BACKGROUND_BANDS)
    if covered.size:
        bands_outside = outside[:, covered]
        distance = np.abs(bands_outside - np.nanmedian(bands_outside, axis=0))
        is_background = np.isfinite(distance) & (distance <= 4.0 * 1.4826 * np.nanmedian(distance, axis=0))
        count = np.maximum(is_background.sum(axis=0), 1)
        background[covered] = np.where(is_background, bands_outside, 0.0).sum(axis=0) / count
        variance[covered] = 1.0 / count
    values = values - background[:, None]
    is_saturated = np.zeros(columns, np.bool_)
    if saturation is not None:
        limit = np.broadcast_to(saturation, net.shape) - float(SATURATION_MARGIN_COUNTS)
        is_saturated = ((raw >= limit)[clipped, column_index] & is_inside & np.isfinite(values)).any(axis=1)
    light = np.where(np.isfinite(values).sum(axis=1) >= min(6, bands), np.nansum(values, axis=1), np.nan)
    # light of the brightest columns, insensitive to a single column
    levels = np.where(np.isfinite(light), light, 0.0)
    if columns >= 5:
        levels = np.median(np.lib.stride_tricks.sliding_window_view(levels, 5), axis=1)
    brightest = float(levels.max(initial=0.0))
    lit_columns = np.flatnonzero(light > LIT * brightest)
    if not brightest > 0 or not lit_columns.size:
        return None
    out_of_band = finite_mean(
        np.where(np.isfinite(outside), outside, np.nan)[:, lit_columns] / light[lit_columns], axis=1
    )
    return Window(
        columns=lit_columns,
        first=first[lit_columns],
        values=values[lit_columns],
        background=background[lit_columns],
        background_variance=variance[lit_columns],
        saturated=is_saturated[lit_columns],
        beam=light / brightest,
        out_of_band=np.where(np.isfinite(out_of_band), out_of_band, 0.0),
        band=peak,
    )


def fitted(samples: LineSamples, shape: int, triangular: bool, parameters: Floats) -> LineFits:
    # Improve ``parameters`` (line, 4) in place, and return them with the statistics of the fits.
    lamp_lines = len(parameters)
    fits = LineFits(
        parameters, np.empty((lamp_lines, 4, 4)), np.empty(lamp_lines), np.zeros(lamp_lines, np.bool_)
    )
    fit_lines(samples, shape, triangular, fits)
    return fits


def fit_beam(beam: Floats) -> tuple[float, float]:
    # Return centre and full width at half maximum of the beam over columns; NaN without a peak.
    is_finite = np.isfinite(beam)
    columns = np.arange(beam.size, dtype=np.float64)
    weights = np.where(is_finite, 1.0, 0.0)[None]
    values = np.where(is_finite, beam, 0.0)
    total = np.maximum(values, 0.0).sum()
    if is_finite.sum() < 8 or not total > 0:
        return np.nan, np.nan
    centre = float((np.maximum(values, 0.0) * columns).sum() / total)
    fits = fitted(
        LineSamples(values[None], weights, np.zeros(1, np.int64), np.zeros(1)),
        GAUSSIAN,
        False,
        np.array([[centre, total / _GAUSSIAN_AREA, total, 0.0]]),
    )
    beam_centre, width, area, offset = fits.parameters[0]
    is_peak = fits.converged[0] and width < 3.0 * beam.size and -width < beam_centre < beam.size + width
    return (
        (float(beam_centre), float(width))
        if is_peak and abs(offset) < 0.5 * area / (width * _GAUSSIAN_AREA)
        else (np.nan, np.nan)
    )


def line_profiles(
    distance: Floats, width: Floats | float, source: Floats | float, shape: int, triangular: bool
) -> Floats:
    # Return lamp lines of unit area at distances (line, sample) from their centres [band].
    #
    # ``width`` and ``source`` (line,) are the full widths at half maximum of the camera's response and of the
    # light [band]; ``triangular``: whether the light is a triangle, otherwise a Gaussian.
    out = np.empty(distance.shape)
    widths, sources = (np.full(len(distance), values, np.float64) for values in (width, source))
    profiles(distance, widths, sources, shape, triangular, out)
    return out


def fit_window(
    window: Window,
    noise: NoiseModel,
    frames: float,
    shape: int,
    source: Floats,
    triangular: bool,
    start: Fits | None = None,
) -> Fits:
    # Return the fits of all lamp lines of a window, weighted by ``noise`` of ``frames`` frames.
    #
    # ``shape`` is a value of `SHAPES`. ``source`` (line,) and ``triangular`` are width [band] and shape of
    # the light, of zero width in the first fit, which is a fit without deconvolution. ``start`` are fits with
    # start values.
    def profiles_at(distance: Floats) -> Floats:
        return line_profiles(distance, parameters[:, WIDTH], source, shape, triangular)

    is_finite = np.isfinite(window.values)
    values = np.where(is_finite, window.values, 0.0)
    if start is None:
        positive = np.maximum(values, 0.0)
        peak, height = np.argmax(positive, axis=1), positive.max(axis=1)
        side = np.arange(positive.shape[1]) - peak[:, None]
        is_near = np.abs(side) <= positive.shape[1] / 4
        # the larger half is doubled, for lamp lines cut off at the edge of the array
        halves = [np.where(is_near & (sign * side > 0), positive, 0.0).sum(axis=1) for sign in (1, -1)]
        area = height + 2.0 * np.maximum(*halves)
        observed = np.maximum(area / (height * _GAUSSIAN_AREA), 1.0)
        width = np.sqrt(np.maximum(observed**2 - source**2, (0.3 * observed) ** 2))
        columns = [window.first + peak, width, area, np.zeros_like(area)]
        parameters, model = np.column_stack(columns).astype(np.float64), values
    else:
        parameters, width = start.parameters.copy(), start.width
        parameters[:, WIDTH] = np.sqrt(np.maximum(width**2 - source**2, (0.3 * width) ** 2))
        model = start.parameters[:, AREA, None] * profiles_at(window.places - parameters[:, CENTRE, None])
    height = np.max(np.where(is_finite, values, -np.inf), axis=1, keepdims=True)
    # weights from the noise of single counts favour low counts: weights follow the model if there is one
    min_variance = (1e-4 * height) ** 2 if start is not None else (3e-2 * height) ** 2
    variance = noise.variance(model, frames) + min_variance
    # fit in place, and again without the worst outlier
    at_centre = np.zeros((len(values), 1))
    is_used, start_values = is_finite.copy(), parameters.copy()
    for is_last in (False, True):
        parameters[:] = np.where(np.isfinite(parameters), parameters, start_values)
        samples = LineSamples(values, np.where(is_used, 1.0 / variance, 0.0), window.first, source)
        fits = fitted(samples, shape, triangular, parameters)
        if is_last:
            break
        model = parameters[:, AREA, None] * profiles_at(window.places - parameters[:, CENTRE, None])
        residual = np.where(is_used, np.abs(values - model - parameters[:, OFFSET, None]), 0.0)
        amplitude = np.abs(parameters[:, AREA, None] * profiles_at(at_centre))
        # a dead element distorts the fit of its neighbours, so only the worst sample is left out
        is_outlier = residual > np.maximum(8.0 * np.sqrt(variance), _MAX_DEVIATION_SHARE * amplitude)
        is_outlier &= residual >= residual.max(axis=1, keepdims=True)
        if not is_outlier.any():
            break
        is_used &= ~is_outlier
    # sum over all bands, of which the part beyond the edge of the array or on bad elements is taken from the
    # fit. Where bands are more than half a lamp line's width apart, their sum is a little more or less than
    # the light, depending on its position between them; the profile corrects this.
    unit = profiles_at(window.places - parameters[:, CENTRE, None])
    total = np.maximum(unit.sum(axis=1), 1e-300)
    unseen = np.clip(1.0 - np.where(is_used, unit, 0.0).sum(axis=1) / total, 0.0, 1.0)
    area = np.where(is_used, window.values, 0.0).sum(axis=1) / total + unseen * parameters[:, AREA]
    area_variance = (
        np.where(is_used, noise.variance(np.where(is_used, values, 0.0), frames), 0.0).sum(axis=1)
        + is_used.sum(axis=1) ** 2 * window.background_variance * noise.variance(np.zeros(1), frames)
        + unseen**2 * fits.covariance[:, AREA, AREA]
    )
    width = np.empty(len(values))
    full_widths(parameters[:, WIDTH].copy(), source, shape, triangular, width)
    return Fits(
        parameters=parameters,
        covariance=fits.covariance,
        width=width,
        amplitude=parameters[:, AREA] * profiles_at(at_centre)[:, 0],
        area=area,
        area_variance=area_variance,
        chi2=fits.chi2,
        degrees=np.maximum(is_used.sum(axis=1) - 4.0, 1.0),
        converged=fits.converged & np.isfinite(area) & (parameters[:, AREA] > 0),
    )


# --- fit the wavelength of every element to lamp lines: a smooth surface over bands and columns ------------


_MAP_FIT = SimpleNamespace(
    band_degree=3,
    column_degrees=(0, 1, 2, 3, 4),
    tukey_sd=4.685,  # standard deviations beyond which Tukey's biweight gives no weight
    halvings=40,
)
_ROUNDS = 20


@dataclass(frozen=True, eq=False)
class WavelengthMap:
    # Wavelength as a tensor of Chebyshev polynomials in band and column.
    coefficients: Floats  #: (band degree + 1, column degree + 1): [nm]
    #: bands, columns: sizes of the array
    bands: int
    columns: int
    #: First and last column with lamp lines; beyond them the surface is constant
    lit: tuple[int, int]
    residual: float  #: Robust standard deviation of the lines about the surface [nm]

    def at(self, band: ArrayLike, column: ArrayLike) -> Floats:
        # Return the wavelength at fractional bands and columns [nm].
        u, v = self._scaled(np.asarray(band, np.float64), np.asarray(column, np.float64))
        return np.asarray(chebyshev.chebval2d(u, v, self.coefficients))

    def spacing(self, band: ArrayLike, column: ArrayLike) -> Floats:
        # Return ``|d wavelength / d band|`` [nm].
        u, v = self._scaled(np.asarray(band, np.float64), np.asarray(column, np.float64))
        slope = chebyshev.chebder(self.coefficients, axis=0) * (2.0 / max(self.bands - 1, 1))
        return np.asarray(np.abs(chebyshev.chebval2d(u, v, slope)))

    def band_of(self, wavelength: float | Floats, column: Ints) -> Floats:
        # Return the fractional bands of wavelengths [nm] in some columns, to a little beyond the array.
        shape = np.broadcast_shapes(np.shape(wavelength), column.shape)
        low, high = np.full(shape, -0.05 * self.bands - 2.0), np.full(shape, 1.05 * self.bands + 1.0)
        is_rising = self.at(self.bands - 1.0, column) > self.at(0.0, column)
        for _ in range(_MAP_FIT.halvings):
            middle = 0.5 * (low + high)
            is_below = (self.at(middle, column) < wavelength) == is_rising
            low, high = np.where(is_below, middle, low), np.where(is_below, high, middle)
        return np.asarray(0.5 * (low + high))

    def grid(self) -> tuple[Floats, Floats]:
        # Return wavelength and spacing of every element (band, cross_track) [nm].
        band, column = np.meshgrid(np.arange(self.bands), np.arange(self.columns), indexing="ij")
        return self.at(band, column), self.spacing(band, column)

    def _scaled(self, band: Floats, column: Floats) -> tuple[Floats, Floats]:
        band, column = np.broadcast_arrays(band, np.clip(column, *self.lit))
        return 2.0 * band / max(self.bands - 1, 1) - 1.0, 2.0 * column / max(self.columns - 1, 1) - 1.0


def fit_wavelength_map(
    band: Floats, column: Floats, wavelength: Floats, sizes: tuple[int, int], *,
    column_degree: int | None = None, uncertainty: Floats | None = None,
) -> WavelengthMap:  # fmt: skip
    # Return the robust low-order surface through centres of lamp lines; SchemaError if they are too few.
    #
    # ``band`` and ``column`` (line,) are the position of each lamp line, in fractional bands, ``wavelength``
    # (line,) the wavelength of its light [nm], ``uncertainty`` (line,) the standard deviation of its centre
    # [band]; ``sizes`` are bands and columns of the array. ``column_degree`` is the degree of the smile; None
    # for the lowest of 0 to 4 that suffices.
    n_wavelengths = len(np.unique(np.round(wavelength, 6)))
    n_columns = len(np.unique(column))
    degree = min(_MAP_FIT.band_degree, n_wavelengths - 2)
    SchemaError.raise_if(
        degree < 1,
        f"lamp lines of {n_wavelengths} wavelengths",
        expected="3 or more for a wavelength map",
        code="lamp-lines-few",
    )
    degrees = (
        [column_degree]
        if column_degree is not None
        else [d for d in _MAP_FIT.column_degrees if d < n_columns]
    )
    weight = np.ones_like(band)
    if uncertainty is not None:
        # the monochromator's dial limits the accuracy of bright lamp lines, so their weight is limited
        weight = 1.0 / (uncertainty**2 + max(float(np.median(uncertainty)), 1e-9) ** 2)
        weight /= weight.mean()

    bands, columns = sizes
    u, v = 2.0 * band / max(bands - 1, 1) - 1.0, 2.0 * column / max(columns - 1, 1) - 1.0
    lit = (int(column.min()), int(column.max()))
    candidates: list[tuple[float, WavelengthMap]] = []
    for trial in degrees:
        shape = (degree + 1, min(trial, max(n_columns - 1, 0)) + 1)
        terms = np.asarray(chebyshev.chebvander2d(u, v, [size - 1 for size in shape]), np.float64)
        coefficients, is_inlier = _robust_fit(terms, wavelength, weight, tolerance=1e-7)
        freedom = max(is_inlier.sum() - terms.shape[1], 1)
        rms = float(np.sqrt(((wavelength - terms @ coefficients)[is_inlier] ** 2).sum() / freedom))
        # Bayesian information criterion, with a lower limit for rounding of counts
        criterion = band.size * 2.0 * np.log(rms + 1e-6) + coefficients.size * np.log(band.size)
        fitted_map = WavelengthMap(coefficients.reshape(shape), bands, columns, lit, rms)
        candidates.append((criterion, fitted_map))
    return min(candidates, key=lambda candidate: candidate[0])[1]


def _robust_fit(terms: Floats, values: Floats, prior: Floats, tolerance: float) -> tuple[Floats, Bools]:
    # Return the coefficients of terms (line, term), and which values have weight: least squares, reweighted
    # by Tukey's biweight until the coefficients change by less than a tolerance.
    tukey, coefficients = np.ones_like(values), np.zeros(terms.shape[1])
    for _ in range(_ROUNDS):
        normal = np.einsum("ni,n,nj->ij", terms, prior * tukey, terms, optimize=True)
        previous, right = coefficients, terms.T @ (prior * tukey * values)
        coefficients = np.linalg.lstsq(normal, right, rcond=None)[0]
        residual = values - terms @ coefficients
        sigma = 1.4826 * float(np.median(np.abs(residual)))
        if sigma < 1e-9 or np.abs(coefficients - previous).max() < tolerance:
            break
        z = residual / (_MAP_FIT.tukey_sd * sigma)
        tukey = np.where(np.abs(z) < 1.0, (1.0 - z**2) ** 2, 0.0)
    return coefficients, tukey > 0


_SEARCH = SimpleNamespace(
    min_bright_share=0.12,  # share of a lamp line's height above which a dead element is visible
    min_deviation_share=0.5,  # deviation of a dead element, as a share of its lamp line
    min_bin_samples=20,
    centre_step_bands=0.01,  # [band], step of a derivative
)


def _camera_widths(lab: LabSweep, lamp_lines: LampLines, wavelength_map: WavelengthMap) -> Floats:
    # Return the width of the camera at every step (step,) [nm]; interpolated over steps without valid lamp
    # lines.
    widths = lamp_lines.camera_width * wavelength_map.spacing(
        np.nan_to_num(lamp_lines.centre), np.arange(lab.shape[2])
    )
    count = lamp_lines.trusted.sum(axis=1)
    fitted_steps = np.flatnonzero(
        count >= max(0.5 * count.max(), 1)
    )  # a few lamp lines at the edge may all be wrong
    return np.asarray(
        np.interp(
            lab.wavelength,
            lab.wavelength[fitted_steps],
            row_medians(widths, lamp_lines.trusted)[fitted_steps],
        )
    )


def _unit_lines(
    lab: LabSweep,
    window: Window,
    step: int,
    wavelength_map: WavelengthMap,
    centre: Floats,
    width: float,
    shape: int,
) -> Floats:
    # Return lamp lines of unit area (line, sample) at centres (line,) [band].
    spacing = wavelength_map.spacing(centre, window.columns)
    return line_profiles(
        window.places - centre[:, None], width / spacing, lab.width[step] / spacing, shape, lab.triangular
    )


def deviant_elements(
    lab: LabSweep, sweep_data: SweepData, lamp_lines: LampLines, wavelength_map: WavelengthMap, shape: int
) -> Bools:
    # Return the elements (band, cross_track) whose counts do not fit the lamp lines that cover them.
    #
    # Centre and width of a lamp line follow from all other lamp lines, which one dead element does not
    # affect; its height is the median over its bands. One side suffices for lamp lines at the edge of the
    # array.
    _, bands, columns = lab.shape
    suspect, tested = np.zeros((bands, columns), np.int64), np.zeros((bands, columns), np.int64)
    widths = _camera_widths(lab, lamp_lines, wavelength_map)
    centres = wavelength_map.band_of(lab.wavelength[:, None], np.arange(columns))
    for step, window in enumerate(sweep_data.windows):
        if window is None:
            continue
        centre = centres[step, window.columns]
        is_cut = (window.first < 0) | (window.first + window.values.shape[1] > bands)
        reach = widths[step] / float(np.median(wavelength_map.spacing(centre, window.columns))) + 2.0
        is_at_edge = is_cut.any() and abs(float(np.median(centre)) - window.band) < reach
        if not (lamp_lines.trusted[step].any() or is_at_edge):
            continue
        unit = _unit_lines(lab, window, step, wavelength_map, centre, float(widths[step]), shape)
        is_bright = np.isfinite(window.values) & (
            unit > _SEARCH.min_bright_share * unit.max(axis=1, keepdims=True)
        )
        is_bright &= (~window.saturated & (is_bright.sum(axis=1) >= 3))[:, None]
        rows = is_bright.any(axis=1)
        if not rows.any():
            continue
        ratio = np.full(unit.shape, np.nan)
        np.divide(window.values, unit, out=ratio, where=is_bright)
        height = np.zeros((len(unit), 1))
        height[rows, 0] = np.nanmedian(ratio[rows], axis=1)
        noise = 8.0 * np.sqrt(sweep_data.noise.variance(height * unit, float(lab.frames[step])))
        deviation = np.abs(np.where(is_bright, window.values, 0.0) - height * unit)
        is_bright &= noise < np.abs(height) * unit  # elsewhere noise hides a dead element
        is_deviant = is_bright & (
            deviation > np.maximum(noise, _SEARCH.min_deviation_share * np.abs(height) * unit)
        )
        band = window.places.astype(np.int64)
        column = np.broadcast_to(window.columns[:, None], band.shape)
        for mask, counter in ((is_deviant, suspect), (is_bright, tested)):
            np.add.at(counter, (band[mask], column[mask]), 1)
    return np.asarray((suspect > 0) & (2 * suspect > tested))


def element_differences(
    lab: LabSweep,
    sweep_data: SweepData,
    lamp_lines: LampLines,
    wavelength_map: WavelengthMap,
    shape: int,
    *,
    has_noise: bool,
) -> tuple[float, float]:
    # Return the standard deviation of the factors of elements [1], beyond noise, and a slope of noise.
    #
    # The slope is that of the variance of a step's mean over the signal [count], 0 with ``has_noise``.
    # A fit of four parameters hides most of them, since a lamp line is a few bands wide. So centre and width
    # are taken from the map, and only height and a small shift are fitted. Without ``has_noise``,
    # ``sweep_data.noise`` is not valid for bright samples, and their noise is determined too.
    from scipy.optimize import nnls

    widths = _camera_widths(lab, lamp_lines, wavelength_map)
    centres = wavelength_map.band_of(lab.wavelength[:, None], np.arange(lab.shape[2]))
    tally, shares = np.zeros((4, SIGNAL_BINS)), []
    for step, window in enumerate(sweep_data.windows):
        if window is None or not lamp_lines.trusted[step].any():
            continue
        is_usable = np.isfinite(window.values).all(axis=1) & lamp_lines.trusted[step, window.columns]
        if not is_usable.any():
            continue
        # error of the dial and slope shift are common to the columns
        centre = centres[step, window.columns]
        centre = centre + np.median((lamp_lines.centre[step, window.columns] - centre)[is_usable])
        unit_before, unit, unit_after = (
            _unit_lines(lab, window, step, wavelength_map, centre + centre_shift, float(widths[step]), shape)[
                is_usable
            ]
            for centre_shift in (-_SEARCH.centre_step_bands, 0.0, _SEARCH.centre_step_bands)
        )
        values = window.values[is_usable]
        slope = unit_after - unit_before
        # Lamp lines of fitted height, residuals after a small shift, and the freedom of each sample.
        # For independent scatter of variances d, the expected sum of squared residuals is sum(d x freedom).
        first = unit / np.sqrt((unit**2).sum(axis=1, keepdims=True))
        second = slope - (slope * first).sum(axis=1, keepdims=True) * first
        second /= np.sqrt(np.maximum((second**2).sum(axis=1, keepdims=True), 1e-300))
        model = np.maximum((values * first).sum(axis=1, keepdims=True), 1e-300) * first
        residual = values - model
        residual -= (residual * second).sum(axis=1, keepdims=True) * second
        freedom = 1.0 - first**2 - second**2
        excess = residual**2 - sweep_data.noise.variance(model, float(lab.frames[step])) * freedom
        # samples that are not bright contain scattered light
        is_bright = model > _SEARCH.min_bright_share * model.max(axis=1, keepdims=True)
        shares.append(excess[is_bright].sum() / (model**2 * freedom)[is_bright].sum())
        tally += binned(
            model[is_bright], *(weight[is_bright] for weight in (model * freedom, model**2 * freedom, excess))
        )
    is_used = tally[0] >= _SEARCH.min_bin_samples
    if has_noise:
        return float(np.sqrt(max(float(np.median(shares)), 0.0))) if shares else 0.0, 0.0
    if is_used.sum() < 2:
        return 0.0, 0.0
    # excess variance = slope x signal + (relative x signal)^2
    signal, square, excess = (row[is_used] / tally[0][is_used] for row in tally[1:])
    weight = np.sqrt(tally[0][is_used]) / np.maximum(np.abs(excess), 1e-12)
    slope, relative = nnls(np.column_stack([signal, square]) * weight[:, None], excess * weight)[0]
    return float(np.sqrt(relative)), float(slope)


PLACED_LINES = SimpleNamespace(
    #: Largest distance of a lamp line from the wavelength map [nm].
    max_misplacement_nm=0.5,
    #: Largest chi2 relative to the step's median; above, a lamp line contains several dead elements.
    max_relative_chi2=20.0,
    #: Largest deviation of a width from the step's median [1].
    max_width_deviation=0.3,
)


def line_wavelengths(lamp_lines: LampLines, wavelength_map: WavelengthMap, slope_shift: Floats) -> Floats:
    # Return mapped wavelengths of lamp line centres (step, cross_track) [nm], less the slope shift.
    wavelength = (
        wavelength_map.at(np.nan_to_num(lamp_lines.centre), np.arange(lamp_lines.centre.shape[1]))
        - slope_shift[:, None]
    )
    return np.asarray(np.where(np.isfinite(lamp_lines.centre), wavelength, np.nan))


def placed_lines(
    lab: LabSweep, lamp_lines: LampLines, wavelength_map: WavelengthMap, slope_shift: Floats
) -> Bools:
    # Return the valid fits (step, cross_track) with typical width and chi2 that agree with the map.
    distance = np.abs(line_wavelengths(lamp_lines, wavelength_map, slope_shift) - lab.wavelength[:, None])
    misfit = np.where(lamp_lines.trusted, lamp_lines.chi2 / lamp_lines.degrees, np.nan)
    width = np.where(lamp_lines.trusted, lamp_lines.camera_width, np.nan)
    median, median_width = np.maximum(row_medians(misfit), 1.0)[:, None], row_medians(width)[:, None]
    with np.errstate(invalid="ignore"):
        return np.asarray(
            (misfit < PLACED_LINES.max_relative_chi2 * median)
            & (np.abs(width / median_width - 1.0) < PLACED_LINES.max_width_deviation)
            & (distance < max(PLACED_LINES.max_misplacement_nm, 6.0 * wavelength_map.residual))
        )


def band_widths(
    lab: LabSweep, lamp_lines: LampLines, wavelength_map: WavelengthMap, is_placed: Bools
) -> Floats:
    # Return the camera's width of every band (band,) [nm] from the placed lamp lines.
    steps = np.flatnonzero(is_placed.any(axis=1))
    spacing = wavelength_map.spacing(np.nan_to_num(lamp_lines.centre), np.arange(lab.shape[2]))
    widths = np.where(is_placed, lamp_lines.camera_width * spacing, np.nan)[steps]
    uncertainties = np.where(is_placed, lamp_lines.camera_width_u * spacing, np.nan)[steps]
    # medians over the columns, (step,)
    width = np.nanmedian(widths, axis=1)
    width_u = np.nanmedian(uncertainties, axis=1) / np.sqrt(is_placed[steps].sum(axis=1))
    # robust fit of a parabola, or less, to the steps; constant beyond them
    low, high = float(lab.wavelength[steps].min()), float(lab.wavelength[steps].max())
    scale, degree = max(high - low, 1.0), max(min(2, steps.size - 2), 0)
    terms = chebyshev.chebvander(2.0 * (lab.wavelength[steps] - low) / scale - 1.0, degree)
    prior = 1.0 / (width_u**2 + max(float(np.median(width_u)), 1e-9) ** 2)
    coefficients, _ = _robust_fit(np.asarray(terms, np.float64), width, prior / prior.mean(), tolerance=0.0)
    at = np.clip(wavelength_map.at(np.arange(lab.shape[1]), lab.shape[2] // 2), low, high)
    return np.asarray(chebyshev.chebval(2.0 * (at - low) / scale - 1.0, coefficients))


def at_steps(lab: LabSweep, wavelength_map: WavelengthMap, values: Floats) -> Floats:
    # Return a property of the bands (band,) at the wavelengths of the steps (step,).
    centre = wavelength_map.at(np.arange(lab.shape[1]), lab.shape[2] // 2)
    order = np.argsort(centre)
    return np.interp(lab.wavelength, centre[order], values[order])


EDGES = SimpleNamespace(
    #: Minimum visible share of a lamp line's area at the edge [1].
    min_visible_area=0.3,
    max_edge_residual=0.15,  # share of a lamp line's height; a larger residual belongs to another lamp line
    edge_width_u=0.005,  # relative uncertainty of the width at the edge, where it is extrapolated
)


def complete_edge_lines(
    lab: LabSweep,
    sweep_data: SweepData,
    lamp_lines: LampLines,
    wavelength_map: WavelengthMap,
    light: Floats,
    fwhm: Floats,
    shape: str,
) -> None:
    # Fit the heights of lamp lines that are cut off by the edge of the array, and mark them as completed.
    #
    # ``lamp_lines`` is changed. ``light`` (step,) are the wavelengths of the lamp lines in the camera [nm],
    # ``fwhm`` (step,) the width of the camera [nm], ``shape`` its line shape.
    for step, window in enumerate(sweep_data.windows):
        if window is None:
            continue
        is_beyond = (window.first < 0) | (window.first + window.values.shape[1] > lab.shape[1])
        is_cut = is_beyond & ~lamp_lines.trusted[step, window.columns] & ~window.saturated
        if is_cut.any():
            _complete_step(
                lab, sweep_data.noise, lamp_lines, wavelength_map, step, window,
                is_cut=is_cut, centre=wavelength_map.band_of(float(light[step]), window.columns),
                fwhm=float(fwhm[step]), shape=shape,
            )  # fmt: skip


def _complete_step(
    lab: LabSweep, noise: NoiseModel, lamp_lines: LampLines, wavelength_map: WavelengthMap, step: int,
    window: Window, *,
    is_cut: Bools, centre: Floats, fwhm: float, shape: str,
) -> None:  # fmt: skip
    spacing = wavelength_map.spacing(centre, window.columns)
    width, source = fwhm / spacing, lab.width[step] / spacing
    frames = float(lab.frames[step])

    def profile(shift: float, width_factor: float) -> Floats:
        distance = window.places - (centre + shift)[:, None]
        return line_profiles(distance, width * width_factor, source, SHAPES[shape], lab.triangular)

    is_finite = np.isfinite(window.values)
    values = np.where(is_finite, window.values, 0.0)
    unit_profile = np.where(is_finite, profile(0.0, 1.0), 0.0)
    variance = noise.variance(values, frames) + (1e-4 * values.max(axis=1, keepdims=True)) ** 2
    weight = np.where(is_finite, 1.0 / np.maximum(variance, 1e-300), 0.0)
    norm = np.maximum((weight * unit_profile**2).sum(axis=1), 1e-300)

    def area_of(line_profile: Floats) -> Floats:
        line_profile = np.where(is_finite, line_profile, 0.0)
        height = (weight * line_profile * values).sum(axis=1)
        return np.asarray(height / np.maximum((weight * line_profile**2).sum(axis=1), 1e-300))

    fitted = area_of(unit_profile)
    visible = unit_profile.sum(axis=1)
    area = values.sum(axis=1) + (1.0 - visible) * fitted
    # uncertainty of the area by centre, width and noise
    change_by_centre, change_by_width = (
        (1.0 - visible) * (area_of(changed_profile) - fitted) / 1e-3
        - (changed_profile * is_finite - unit_profile).sum(axis=1) * fitted / 1e-3
        for changed_profile in (profile(1e-3, 1.0), profile(0.0, 1.0 + 1e-3))
    )
    variance_by_noise = np.where(is_finite, noise.variance(values, frames), 0.0).sum(axis=1)
    variance_by_noise = variance_by_noise + (1.0 - visible) ** 2 / norm
    area_variance = (
        variance_by_noise
        + (change_by_centre * wavelength_map.residual / spacing) ** 2
        + (change_by_width * EDGES.edge_width_u) ** 2
    )
    residual = np.abs(np.where(is_finite, values - fitted[:, None] * unit_profile, 0.0))
    height = np.abs(fitted) * profile(0.0, 1.0).max(axis=1)
    # one free parameter: residuals above noise are dead elements, or another lamp line
    is_complete = (
        is_cut
        & (visible >= EDGES.min_visible_area)
        & (fitted > 0)
        & np.isfinite(area_variance)
        & ~(residual > np.maximum(8.0 * np.sqrt(variance), EDGES.max_edge_residual * height[:, None])).any(
            axis=1
        )
    )
    index = (step, window.columns[is_complete])
    lamp_lines.area[index] = area[is_complete]
    lamp_lines.area_u[index] = np.sqrt(area_variance[is_complete]) / area[is_complete]
    lamp_lines.centre[index] = centre[is_complete]
    lamp_lines.completed[index] = True
    lamp_lines.covariance[(*index, AREA, AREA)] = area_variance[is_complete]


# --- from the areas of lamp lines to the gain of every element ---------------------------------------------


_MAX_GAP_STEPS = 3.0  # median steps; wider gaps are not interpolated


def shape_variance(fwhm: Floats, shape: str, spacing: Floats | float = 0.0) -> Floats:
    # Return the variance of a line shape [nm2]: "gaussian", "triangle" (of equal slits) or "slit".
    if shape == "gaussian":
        return np.asarray(fwhm**2 / (8.0 * np.log(2.0)))
    return np.asarray(fwhm**2 / 6.0 if shape == "triangle" else (fwhm**2 + np.square(spacing)) / 12.0)


def second_order_factor(
    wavelength: Floats, level: Floats, camera_variance: Floats, source_variance: Floats
) -> Floats:
    # Return the factor from the responsivity in a lamp line to that of a band at the same wavelength.
    #
    # ``wavelength`` (step,) [nm]; ``level`` (step,) is the responsivity from the lamp lines' areas at any
    # scale, median of the columns, NaN where unknown; ``camera_variance`` and ``source_variance`` (step,) are
    # those of the camera's line shape and of the monochromator's [nm2].
    factor = np.ones_like(level)
    positive = np.flatnonzero(np.isfinite(level) & (level > 0))
    if positive.size < 5:
        return factor
    x, y = wavelength[positive], level[positive]
    step_before, step_after = np.diff(x)[:-1], np.diff(x)[1:]
    curvature = (
        2.0 * ((y[2:] - y[1:-1]) / step_after - (y[1:-1] - y[:-2]) / step_before) / (step_before + step_after)
    )
    relative_curvature = np.empty_like(y)
    relative_curvature[1:-1] = curvature / y[1:-1]
    relative_curvature[0], relative_curvature[-1] = relative_curvature[1], relative_curvature[-2]
    # smoothed, since noise of a second difference is six times that of the values
    factor[positive] = 1.0 + 0.5 * (camera_variance - source_variance)[positive] * np.convolve(
        np.pad(relative_curvature, 1, mode="edge"), [0.25, 0.5, 0.25], mode="valid"
    )
    return np.clip(factor, 0.9, 1.1)


def monotone_slopes(x: Floats, y: Floats) -> Floats:
    # Return slopes at nodes ``x`` (node,) for interpolation of ``y`` (node, column) without ringing.
    #
    # Slopes of a cubic spline, of fourth order. Where curvature changes sign, they are limited
    # as by Fritsch and Carlson (Hyman 1983), which keeps monotone pieces monotone.
    from scipy.interpolate import CubicSpline

    if len(x) < 3:
        return np.repeat(np.diff(y, axis=0) / np.diff(x)[:, None], len(x), axis=0)
    slope = np.asarray(CubicSpline(x, y, axis=0).derivative()(x))
    secant = np.diff(y, axis=0) / np.diff(x)[:, None]
    secant_before, secant_after = np.vstack([secant[:1], secant]), np.vstack([secant, secant[-1:]])
    limit = 3.0 * np.minimum(np.abs(secant_before), np.abs(secant_after))
    limited = np.clip(slope, -limit, limit)
    limited = np.where((secant_before * secant_after > 0) & (limited * secant_before < 0), 0.0, limited)
    curvature = np.sign(np.diff(secant, axis=0))
    # concave or convex at a node and both its neighbours: a smooth extremum, not the foot of a step
    padded = np.vstack([curvature[:1], curvature[:1], curvature, curvature[-1:], curvature[-1:]])
    is_smooth = (padded[:-2] == padded[1:-1]) & (padded[1:-1] == padded[2:]) & (padded[1:-1] != 0)
    return np.asarray(np.where(is_smooth, slope, limited))


def interpolate_nodes(
    x: Floats, y: Floats, used: Bools, at: Floats, tolerance: float = 0.0
) -> tuple[Floats, Bools]:
    # Return each column's values (place, column) between its used nodes, and where they are finite.
    #
    # ``x`` (node,) increases; ``y`` and ``used`` (node, column): columns with fewer than four used nodes get
    # nothing; ``at`` (place, column) may lie ``tolerance`` beyond the outer nodes. NaN beyond them and in
    # gaps of over three steps.
    values = np.full(at.shape, np.nan)
    patterns, member = np.unique(used, axis=1, return_inverse=True)
    max_gap = _MAX_GAP_STEPS * float(np.median(np.diff(x)))
    for index in range(patterns.shape[1]):
        nodes = np.flatnonzero(patterns[:, index])
        columns = np.flatnonzero(member.ravel() == index)
        if nodes.size < 4:
            continue
        x_used, y_used, place = x[nodes], y[np.ix_(nodes, columns)], at[:, columns]
        place = np.where((place < x_used[0]) & (place >= x_used[0] - tolerance), x_used[0], place)
        place = np.where((place > x_used[-1]) & (place <= x_used[-1] + tolerance), x_used[-1], place)
        # cubic Hermite polynomials between the nodes
        left = np.clip(np.searchsorted(x_used, place, side="right") - 1, 0, len(x_used) - 2)
        width = np.diff(x_used)[left]
        u = (place - x_used[left]) / width
        slope, column = monotone_slopes(x_used, y_used), np.arange(columns.size)
        y0, y1 = y_used[left, column], y_used[left + 1, column]
        m0, m1 = slope[left, column] * width, slope[left + 1, column] * width
        cubic = y0 * (1 + 2 * u) * (1 - u) ** 2 + m0 * u * (1 - u) ** 2
        cubic += y1 * u**2 * (3 - 2 * u) + m1 * u**2 * (u - 1)
        values[:, columns] = np.where((u >= 0) & (u <= 1) & (width <= max_gap), cubic, np.nan)
    return values, np.isfinite(values)


def element_gain(
    step_wavelength: Floats,
    node: Floats,
    used: Bools,
    wavelength: Floats,
    etendue: Floats,
    tolerance: float = 0.0,
) -> tuple[Floats, Bools]:
    # Return the gain of every element [W m-2 sr-1 nm-1 s count-1], and whether it is known.
    #
    # NaN where it would be extrapolated. ``node`` (step, cross_track) is the responsivity of a band times
    # spacing, the integral of its response [count nm J-1], of the steps ``used`` there; ``step_wavelength``
    # (step,) and ``wavelength`` (band, cross_track) of the elements [nm]; ``etendue`` (cross_track,) [m2 sr].
    # Within the ``tolerance``, the uncertainty of the wavelengths [nm], an element counts as on the outer
    # step.
    log = np.log(np.where(used & (node > 0), node, 1.0))
    log_gain, finite = interpolate_nodes(step_wavelength, log, used & (node > 0), wavelength, tolerance)
    return np.asarray(np.exp(-log_gain) / etendue), finite


_PARTS = 161  # points of the monochromator's line
_REACH = {True: 1.0, False: 2.2}  # half support of a triangle and of a Gaussian in full widths


def slope_shift_of_lines(
    lab: LabSweep,
    noise: NoiseModel,
    slope: Floats,
    camera_width: Floats,
    spacing: Floats,
    amplitude: Floats,
    shape: str,
) -> Floats:
    # Return by how much a sloping responsivity shifts the centres of the lamp lines (step,) [nm].
    #
    # ``slope`` (step,) is d ln responsivity / d wavelength [nm-1]; ``camera_width``, ``spacing`` and
    # ``amplitude`` (step,) are the width of the camera's line [nm], the spacing of the bands [nm] and the
    # height of the line [count]; ``shape`` is the camera's line shape, ``noise`` weights the fits.
    curvature = np.gradient(slope, lab.wavelength)
    shifts = np.zeros(len(slope))
    for step, source in enumerate(lab.width):
        offset = np.linspace(-1.0, 1.0, _PARTS) * _REACH[lab.triangular] * source
        light = (
            np.maximum(1.0 - np.abs(offset) / source, 0.0)
            if lab.triangular
            else np.exp(-4.0 * np.log(2.0) * (offset / source) ** 2)
        )
        light *= np.exp(slope[step] * offset + 0.5 * curvature[step] * offset**2)
        # a lamp line of this light in units of bands, and the shift of its fitted centre
        place, width, slit = (nm / spacing[step] for nm in (offset, camera_width[step], source))
        half = int(np.ceil(2.2 * np.hypot(width, slit) + 2.0))
        bands = np.arange(-half, half + 1, dtype=np.float64)
        line = (light / light.sum()) @ line_profiles(
            bands - place[:, None], width, 0.0, SHAPES[shape], triangular=False
        )
        line *= amplitude[step] / line.max()
        variance = noise.variance(line, float(lab.frames[step])) + (1e-4 * amplitude[step]) ** 2
        samples = LineSamples(line[None], 1.0 / variance[None], np.array([-half]), np.array([slit]))
        fits = fitted(samples, SHAPES[shape], lab.triangular, np.array([[0.0, width, line.sum(), 0.0]]))
        shifts[step] = spacing[step] * (fits.parameters[0, CENTRE] if fits.converged[0] else 0.0)
    return shifts


# --- read all steps of a sweep once, one after the other, and fit their lamp lines -------------------------


Tick = Callable[[], None]

#: Sources of a noise model; the third source is the sweep's own statement.
FROM_FRAMES, FROM_SCATTER = "variance of the frames", "scatter of the bands off the lines"

CLIPPING = SimpleNamespace(
    #: Bands of a column at the highest count of the sweep; a lamp line that is not clipped has one or two.
    min_clipped_bands=3,
    count_tolerance=0.25,
    min_edge_distance=0.5,  # of a lamp line's centre from the edge of the array [full widths]
)
_SIGNAL_EDGES = np.concatenate([[-np.inf], np.geomspace(2.0, 65536.0, 40), [np.inf]])
SIGNAL_BINS = len(_SIGNAL_EDGES) - 1


@dataclass(frozen=True, eq=False)
class SweepData:
    # Data of a sweep that are kept after reading.
    windows: list[Window | None]  #: Window of every step; None without a lamp line
    rows: Floats  #: (step, band): counts outside the lines relative to the lines' areas
    noise: NoiseModel  #: Noise of one frame
    noise_source: str  #: Source of the noise model


@dataclass(eq=False)
class LampLines:
    # Fitted lamp lines of all steps, (step, cross_track) except where noted; NaN without a line.
    centre: Floats
    camera_width: Floats
    width: Floats
    amplitude: Floats
    area: Floats
    area_u: Floats
    centre_u: Floats
    camera_width_u: Floats
    covariance: Floats
    chi2: Floats
    degrees: Floats
    trusted: Bools
    completed: Bools

    @classmethod
    def empty(cls, steps: int, columns: int) -> LampLines:
        # Return lines without any fit.
        lamp_lines = cls(*(np.full((steps, columns), np.nan) for _ in fields(cls)))
        lamp_lines.covariance = np.full((steps, columns, 4, 4), np.nan)
        lamp_lines.trusted, lamp_lines.completed = np.zeros((2, steps, columns), np.bool_)
        return lamp_lines

    def store(self, step: int, window: Window, fits: Fits, bands: int) -> None:
        # Store the fits of one step.
        index = (step, window.columns)
        self.centre[index] = fits.parameters[:, CENTRE]
        self.camera_width[index] = fits.parameters[:, WIDTH]
        for name in ("width", "amplitude", "area", "covariance", "chi2", "degrees"):
            getattr(self, name)[index] = getattr(fits, name)
        centre, margin = fits.parameters[:, CENTRE], CLIPPING.min_edge_distance * fits.width
        with np.errstate(invalid="ignore"):
            self.area_u[index] = np.sqrt(fits.area_variance) / fits.area
            self.centre_u[index] = np.sqrt(fits.covariance[:, CENTRE, CENTRE])
            self.camera_width_u[index] = np.sqrt(fits.covariance[:, WIDTH, WIDTH])
            is_inside = (centre >= margin) & (centre <= bands - 1 - margin)
        self.trusted[index] = fits.converged & is_inside & ~window.saturated & np.isfinite(self.area_u[index])


def read_lines(lab: LabSweep, bad: Bools, curve: Linearity, flat: Floats | None, tick: Tick) -> SweepData:
    # Read every step once and keep the windows around its lamp lines.
    #
    # SchemaError if the lamp lines do not move along the array with the wavelengths, or columns without flux
    # are lit; a warning if lamp lines look clipped below ``saturation_count``, or without it.
    steps, bands, _ = lab.shape
    windows: list[Window | None] = []
    rows = np.zeros((steps, bands))
    tally = np.zeros((3, SIGNAL_BINS))
    scatter = []
    highest = np.full(bad.shape, -np.inf)
    for step in range(steps):
        raw = lab.frame(step)
        highest = np.fmax(highest, raw)
        net = curve.net(raw, lab.dark.at(float(lab.exposure[step])))
        if lab.band_shift_time:
            smear = smear_of(lab.band_shift_time, float(lab.exposure[step]), bands)
            net = net - smear * np.nansum(net, axis=0)
        if lab.variance is not None:
            variance = np.asarray(lab.variance.isel({STEP: step}).to_numpy(), np.float64)
            is_saturated = lab.saturation is not None and raw >= lab.saturation - float(
                SATURATION_MARGIN_COUNTS
            )
            is_counted = np.isfinite(net) & np.isfinite(variance) & ~(bad | is_saturated)
            tally += binned(net[is_counted], net[is_counted], variance[is_counted])
        if flat is not None:
            net = net * flat
        window = find_line(net, raw, bad, lab.saturation)
        if window is not None:
            rows[step] = window.out_of_band
            far_counts = net[np.abs(np.arange(bands) - window.band) > 0.25 * bands]
            scatter.append(
                1.4826**2 * np.nanmedian((far_counts - np.nanmedian(far_counts)) ** 2) * lab.frames[step]
            )
        windows.append(window)
        tick()
    # lamp lines must move along the array as the wavelengths do
    peaks = [(step, window.band) for step, window in enumerate(windows) if window is not None]
    peak_bands = np.array([band for _, band in peaks])
    steps_of_peaks = np.diff(peak_bands)
    reversed_steps = (
        np.flatnonzero(steps_of_peaks * np.sign(np.median(steps_of_peaks)) < -2)
        if len(peaks) > 2
        else np.zeros(0, np.intp)
    )
    listed_peaks = listed(
        f"{lab.wavelength[peaks[k + 1][0]]:g} nm at band {peak_bands[k + 1]}, after {peak_bands[k]}"
        for k in reversed_steps
    )
    refuse_if(
        reversed_steps.size,
        f"lamp lines do not move along the array as the wavelengths do: {listed_peaks}",
        mend="check that counts and step_wavelength belong together, in order",
        code="steps-unordered",
    )
    # lit columns without flux or capture fraction
    missing_flux = [
        f"{lab.wavelength[step]:g} nm ({missing} of {window.columns.size} lit columns)"
        for step, window in enumerate(windows)
        if window is not None and (missing := int((~np.isfinite(lab.power[step, window.columns])).sum()))
    ]
    refuse_if(
        missing_flux,
        f"flux x capture_fraction is zero or NaN in lit columns: {listed(missing_flux)}",
        mend="measure it there",
        code="flux-missing",
    )
    # one highest count that repeats along a column; a full well may lie below the end of the converter
    highest = np.where(bad, -np.inf, highest)
    limit = np.inf if lab.saturation is None else lab.saturation - float(SATURATION_MARGIN_COUNTS)
    if not (highest >= limit).any():
        is_highest = highest >= highest.max() - CLIPPING.count_tolerance
        stated = "missing, and" if lab.saturation is None else f"{np.max(lab.saturation):g}, but"
        warn_if(
            (is_highest.sum(axis=0) >= CLIPPING.min_clipped_bands).any(),
            f"saturation_count is {stated} the highest count {highest.max():g} repeats in "
            f"{int(is_highest.sum())} elements: clipped lamp lines are not recognised; "
            "give the count at which the camera is full as saturation_count",
            "saturation-missing",
        )
    return SweepData(windows, rows, *_noise_model(lab, tally, scatter))


def binned(signal: Floats, *values: Floats) -> Floats:
    # Return, for bins of the signal [count], the number of samples and the sums of values (row, bin).
    bins = np.searchsorted(_SIGNAL_EDGES, signal, side="right") - 1
    return np.stack([np.bincount(bins, weight, SIGNAL_BINS) for weight in (None, *values)])


def _noise_model(lab: LabSweep, tally: Floats, scatter: list[float]) -> tuple[NoiseModel, str]:
    # Return the noise by photon transfer of the sweep, else as stated, else by scatter off the lamp lines.
    dark_variance = lab.dark.spread**2 * lab.dark.leverage(float(np.median(lab.exposure)))
    dark_share = lab.dark.leverage(float(np.median(lab.exposure))) / (
        lab.dark_frames or np.median(lab.frames)
    )
    is_used = tally[0] > 50
    if is_used.sum() >= 3 and tally[2][is_used].any():
        count, (signal, variance) = tally[0][is_used], tally[1:, is_used] / tally[0][is_used]
        weight = np.sqrt(count) / np.maximum(variance, 1e-6)
        constant, slope = np.linalg.lstsq(
            np.column_stack([np.ones_like(signal), signal]) * weight[:, None], variance * weight, rcond=None
        )[0]
        if slope > 0:
            constant = max(float(constant), 0.0)
            return NoiseModel(
                constant, float(slope), dark_variance or constant * float(dark_share)
            ), FROM_FRAMES
    if lab.electrons_per_count is not None:
        constant = (lab.read_noise or 0.0) ** 2 + QUANTISATION_VARIANCE_COUNT2
        return NoiseModel(
            constant, 1.0 / lab.electrons_per_count, dark_variance or constant * float(dark_share)
        ), "as stated"
    # scatter includes the noise of the dark
    return NoiseModel(float(np.median(scatter)) if scatter else 0.0, 0.0), FROM_SCATTER


def fit_steps(
    lab: LabSweep,
    sweep_data: SweepData,
    shape: int,
    tick: Tick,
    first: tuple[WavelengthMap, list[Fits | None]] | None = None,
) -> tuple[LampLines, list[Fits | None]]:
    # Return the lamp lines of all steps, and the fits of every step (None for a step without a line).
    #
    # Without ``first``, the monochromator's line is not deconvolved: such fits give the centres. With a
    # wavelength map and first fits, they are fits of the camera's response convolved with that line.
    lamp_lines = LampLines.empty(lab.shape[0], lab.shape[2])
    fits_of_steps: list[Fits | None] = [None] * lab.shape[0]
    for step, window in enumerate(sweep_data.windows):
        if window is not None:
            source, triangular, start = np.zeros(len(window.columns)), False, None
            if first is not None and (start := first[1][step]) is not None:
                spacing = first[0].spacing(start.parameters[:, CENTRE], window.columns)
                source, triangular = np.asarray(lab.width[step] / spacing), lab.triangular
            fits = fit_window(
                window, sweep_data.noise, float(lab.frames[step]), shape, source, triangular, start
            )
            lamp_lines.store(step, window, fits, lab.shape[1])
            fits_of_steps[step] = fits
        tick()
    return lamp_lines, fits_of_steps
