"""Measured or computed light: an irradiance series at one time, and tables of spectra."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import FormatError, PaintWarning, Problems, SchemaError, UnitsError
from hyperpaint.base.input_files import read_limited
from hyperpaint.base.schema import require
from hyperpaint.base.units import conversion_factor, convert
from hyperpaint.light.sky_functions import fit_sky
from hyperpaint.simulation.settings import moment_of

from .sky_models import Spread, check_curves, check_wavelengths

_MAX_BYTES = 16 * 2**20
_MAX_LINES = 200_000
_MAX_PROBLEMS = 10
_MAX_RESIDUAL = 0.25  # relative root mean square, reached by aerosol or thin cloud
_NOISE = 0.01  # maximum negative noise relative to the maximum irradiance
_HEADING = re.compile(r"([A-Za-z_]{1,40}) ?[\[(]([^\[\]()]{1,80})[\])]")
_UNITS = {
    "wavelength": "nm",
    "sun": "W m-2 nm-1",
    "sky": "W m-2 nm-1",
    "extinction": "m-1",
    "path_radiance": "W m-2 sr-1 nm-1 m-1",
}
_REQUIRED = ("wavelength", "sun", "sky")


def read_irradiance(series: xr.Dataset, time: Any = None) -> tuple[Floats, Floats]:
    """Return the wavelengths [nm] and the irradiance [W m-2 nm-1] of a series at one time.

    Arguments, errors and the warning are those of `Atmosphere.from_irradiance`.
    """
    arrays = require(
        series, ["irradiance", "irradiance_wavelength"], "the atmosphere of an irradiance series"
    )
    values = np.asarray(arrays["irradiance"].values, dtype=np.float64)
    grid = np.asarray(arrays["irradiance_wavelength"].values, dtype=np.float64)
    check_wavelengths(grid)
    if time is None:
        if len(values) != 1:
            raise SchemaError(
                f"the irradiance series has {len(values)} samples",
                expected="1 without time",
                mend="pass time= in UTC",
                code="argument-missing",
            )
        return grid, _without_noise(values[0])
    times = require(series, ["irradiance_time"], "the irradiance at one time")["irradiance_time"].values
    stamps = times.astype("datetime64[ns]").astype(np.int64)
    moment = moment_of(time)
    if np.isnat(moment):
        raise SchemaError(
            f"time is {time!r}", expected="UTC such as '2020-06-21T17:00:15'", code="time-unreadable"
        )
    time_ns = moment.astype(np.int64)
    if not len(stamps) or not stamps[0] <= time_ns <= stamps[-1]:
        raise SchemaError(
            f"time {moment} is outside the irradiance series",
            expected=f"from {times[0]} to {times[-1]}" if len(stamps) else "a series with samples",
            code="irradiance-coverage",
        )
    next_sample = (
        min(max(int(np.searchsorted(stamps, time_ns)), 1), len(stamps) - 1) if len(stamps) > 1 else 0
    )
    last_sample = max(next_sample - 1, 0)
    weight = (
        0.0
        if next_sample == last_sample
        else (time_ns - stamps[last_sample]) / (stamps[next_sample] - stamps[last_sample])
    )
    return grid, _without_noise(values[last_sample] + weight * (values[next_sample] - values[last_sample]))


def _without_noise(irradiance: Floats) -> Floats:
    # set small negative noise to 0; larger negative values are kept and refused later
    minimum, maximum = irradiance.min(), irradiance.max()
    if -_NOISE * maximum <= minimum < 0.0:
        count = int((irradiance < 0.0).sum())
        warnings.warn(
            PaintWarning(
                f"{count} of {irradiance.size} irradiances below zero, down to {minimum:.3g}, were set to 0",
                code="irradiance-negative",
            ),
            stacklevel=4,
        )
        return np.maximum(irradiance, 0.0)
    return irradiance


def read_table(table: str | Path | Mapping[str, npt.ArrayLike]) -> dict[str, Floats]:
    """Return the curves of a table by name, in the units of `Atmosphere`; see `Atmosphere.from_table`."""
    if isinstance(table, Mapping):
        subject, headings, columns = "table", list(table), list(table.values())
        problems = Problems("the table of an atmosphere cannot be used", FormatError)
        rows = _stack_columns(headings, columns, problems)
    else:
        subject = Path(table).name
        problems = Problems(f"{subject}: not the table of an atmosphere", FormatError)
        headings, rows = _read_rows(Path(table), problems)
    problems.raise_if_any()
    factors = _read_headings(headings, problems)
    problems.raise_if_any()
    curves = {name: rows[:, column] * factor for name, (column, factor) in factors.items()}
    check_curves(problems, curves)
    problems.raise_if_any()
    return curves


def read_sky(table: xr.Dataset, sun_zenith: float) -> tuple[dict[str, Floats], Spread | None]:
    """Return the curves of a table from `hyperpaint.io.skies`, and the distribution of its radiance, if any.

    Warns if the fit of the clear-sky functions has a residual above `_MAX_RESIDUAL`.
    """
    curves = {
        name: np.asarray(convert(table[variable].reset_coords(drop=True), _UNITS[name]).values, np.float64)
        for name, variable in (("wavelength", "wavelength"), ("sun", "direct_normal"), ("sky", "diffuse"))
    }
    if "sky_radiance" not in table:
        return curves, None
    fit = fit_sky(table, sun_zenith)
    max_residual = float(fit["misfit"].max())
    if max_residual > _MAX_RESIDUAL:
        source = table.attrs.get("source", "the table")
        warnings.warn(
            PaintWarning(
                f"clear-sky functions fit the radiance of {source} with a residual of {max_residual:.0%}",
                code="sky-fit-poor",
            ),
            stacklevel=3,
        )
    return curves, Spread(*(fit["share"].sel(function=name).values for name in Spread._fields))


def _stack_columns(headings: Sequence[Any], columns: Sequence[Any], problems: Problems) -> Floats:
    arrays = []
    for heading, column in zip(headings, columns, strict=True):
        try:
            arrays.append(np.asarray(column, dtype=np.float64))
        except (ValueError, TypeError):
            problems.add(f"column {heading!r} does not hold numbers", code="number-unreadable")
    shapes = {array.shape for array in arrays}
    if not problems and (len(shapes) != 1 or len(next(iter(shapes))) != 1):
        problems.add(
            f"columns have shapes {sorted(shapes)}",
            expected="one dim and the same length",
            code="length-mismatch",
        )
    return np.stack(arrays, axis=1) if not len(problems) else np.empty((0, 0))


def _read_rows(path: Path, problems: Problems) -> tuple[list[str], Floats]:
    # headings and numbers (row, column) of a text file
    content = read_limited(path, _MAX_BYTES, "the table of an atmosphere")
    if (count := max(content.count(b"\n"), content.count(b"\r"))) > _MAX_LINES:
        problems.add(f"{count} lines", expected=f"at most {_MAX_LINES}", code="file-too-large")
        problems.raise_if_any()
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        problems.add(f"it is not UTF-8 text (byte {error.start})", code="text-unreadable")
        problems.raise_if_any()
    lines = [
        (number, line)
        for number, line in enumerate(text.splitlines(), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not lines:
        problems.add(
            "it is empty",
            expected="headings such as 'wavelength [nm], sun [W m-2 nm-1], sky [W m-2 nm-1]'",
            code="empty-input",
        )
        problems.raise_if_any()
    headings = [heading.strip() for heading in lines[0][1].split(",")]
    rows = []
    for number, line in lines[1:]:
        cells = line.split(",")
        try:
            if len(cells) != len(headings) or "_" in line:  # Python reads 1_0 as 10
                raise ValueError
            rows.append([float(cell) for cell in cells])
        except ValueError:
            problems.add(
                f"line {number}: {line[:60]!r}",
                expected=f"{len(headings)} numbers",
                code="number-unreadable",
            )
            if len(problems) == _MAX_PROBLEMS:
                break
    return headings, np.array(rows, dtype=np.float64).reshape(len(rows), len(headings))


def _read_headings(headings: Sequence[Any], problems: Problems) -> dict[str, tuple[int, float]]:
    # column of every curve, and the factor to the units of `Atmosphere`
    curves: dict[str, tuple[int, float]] = {}
    for column, heading in enumerate(headings):
        match = _HEADING.fullmatch(str(heading).strip())
        if match is None:
            problems.add(
                f"heading {str(heading)[:60]!r}",
                expected="a name and units such as 'sun [W m-2 nm-1]'",
                code="heading-unreadable",
            )
            continue
        name, units = match[1].lower(), match[2].strip()
        if name not in _UNITS:
            problems.add(
                f"column {name!r} is unknown", expected=f"some of {', '.join(_UNITS)}", code="column-unknown"
            )
        elif name in curves:
            problems.add(f"column {name!r} appears twice", code="column-duplicate")
        else:
            try:
                curves[name] = (column, conversion_factor(units, _UNITS[name]))
            except UnitsError as error:
                problems.add_error(f"column {name!r}", error)
    absent = [name for name in _REQUIRED if name not in curves]
    if absent and not len(problems):
        problems.add(
            f"column {' and '.join(absent)} is missing",
            expected=", ".join(_REQUIRED),
            code="column-missing",
        )
    if ("extinction" in curves) != ("path_radiance" in curves):
        problems.add(
            "only one of extinction and path_radiance is present",
            mend="add the other, or remove it",
            code="column-missing",
        )
    return curves
