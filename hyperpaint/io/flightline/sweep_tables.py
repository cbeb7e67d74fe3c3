"""Lab sweeps as tables in CSV: counts in the table, or in cubes that its rows name."""

from __future__ import annotations

import csv
import difflib
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.errors import FormatError, PaintError, Problems, UnitsError
from hyperpaint.base.schema import ALONG_TRACK, BAND, CHUNK_LINES, CROSS_TRACK, STEP, SWEEP_VARIABLES
from hyperpaint.base.units import conversion_factor
from hyperpaint.io.envi.envi_cubes import open_envi
from hyperpaint.io.files.reading import number, read_limited_text

#: Maximum size of a table [byte]; larger sweeps are cubes, or a Zarr store.
_MAX_BYTES = 64 << 20
_MAX_SHOWN = 8
_HEADING = re.compile(r"\s*(.*?)\s*(?:\[([^\]]*)\])?\s*")
_WIDE = re.compile(r"column (\d+)")
#: Columns of a step; a row without any of `_LIGHT` is of a dark.
_LIGHT = ("step_wavelength", "flux", "level")
_OF_STEP = (
    *_LIGHT, "exposure_time", "monochromator_fwhm", "capture_fraction", "etendue", "frame_count",
    "dark_frame_count", "saturation_count", "electrons_per_count", "read_noise",
)  # fmt: skip
#: Units of columns without one.
_ASSUMED = {unit: unit for unit in ("1", "count", "electron count-1")}
_INDICES = (BAND, CROSS_TRACK)
_DIMS = (STEP, *_INDICES)


def read_sweep_table(path: Path) -> xr.Dataset:
    # Return a lab sweep from a table in CSV, see docs/formats/lab_sweep.md; lazily from cubes.
    #
    # Raises `FormatError`: Headings, units or cells cannot be read, or elements are missing; all are listed
    # with row and column.
    problems = Problems(f"{path} is not a table of a lab sweep", FormatError)
    text = read_limited_text(path, _MAX_BYTES, "a table of a lab sweep", mend="name cubes in a column 'cube'")
    lines = text.decode("utf-8-sig", "replace").splitlines()
    numbered = [(n, line) for n, line in enumerate(lines, 1) if line.strip() and not line.startswith("#")]
    cells = list(csv.reader(line for _, line in numbered)) or [[]]
    headings = [_heading(cell) for cell in cells[0]]
    columns = {name: k for k, (name, _) in enumerate(headings)}
    wide = {int(match[1]): k for name, k in columns.items() if (match := _WIDE.fullmatch(name))}
    factors = _factors(headings, problems)
    for names in ((BAND, "counts", CROSS_TRACK), (BAND,), ("cube",)):
        is_complete = set(names) <= set(columns) and (names != (BAND,) or bool(wide))
        if is_complete:
            break
    problems.add_if(
        not is_complete or "exposure_time" not in columns or len(columns) < len(headings),
        f"columns {', '.join(name for name, _ in headings)[:200]}",
        expected="each once: exposure_time; cube, or band, cross_track, counts, or band, column 0, ...",
        code="column-missing",
    )
    problems.raise_if_any()
    # counts, or cubes, by the values of a step: all rows with these values are of one step
    steps: dict[tuple[float, ...], dict[tuple[int, int], float] | str] = {}
    of_step = [name for name in _OF_STEP if name in columns]
    for (line, _), row in zip(numbered[1:], cells[1:], strict=True):
        problems.add_if(
            len(row) != len(headings),
            f"row {line}: {len(row)} cells",
            expected=f"{len(headings)}, as in the heading",
            code="row-unreadable",
        )
        if len(row) == len(headings):
            values = {
                name: _cell(row, k, line, cells[0], problems) * factors.get(name, 1.0)
                for name, k in columns.items()
                if name != "cube"
            }
            key = tuple(values[name] if values[name] == values[name] else -1.0 for name in of_step)
            if "cube" in columns:
                problems.add_if(
                    key in steps, f"row {line}: this step again", mend="remove it", code="row-duplicate"
                )
                steps[key] = row[columns["cube"]].strip()
            else:
                counts: Any = steps.setdefault(key, {})
                across = [(float(c), values[f"column {c}"]) for c in wide]
                for column, value in across or [(values[CROSS_TRACK], values["counts"])]:
                    at = (values[BAND], column)
                    is_number = all(n == n and n >= 0 and n == int(n) for n in at)
                    problems.add_if(
                        not is_number or at in counts,
                        f"row {line}: band {at[0]:g}, column {at[1]:g}" + " again" * (at in counts),
                        expected="whole numbers from 0, each element once a step",
                        code="row-duplicate",
                    )
                    counts[at] = value
        if len(problems) >= _MAX_SHOWN:
            problems.raise_if_any()
    problems.raise_if_any()
    arrays = {key: _array(path, key, of_step, value, problems) for key, value in steps.items()}
    shapes = {array.shape[1:] for array, _ in arrays.values() if array.size}
    problems.add_if(
        len(shapes) != 1 and not problems,
        f"steps of {' and '.join(map(str, sorted(shapes))) or 'no'} bands and columns",
        expected="one size",
        code="shape-mismatch",
    )
    problems.raise_if_any()
    return _sweep(of_step, arrays, problems)


def _heading(cell: str) -> tuple[str, str | None]:
    match = _HEADING.fullmatch(cell)
    return (cell, None) if match is None else (match[1], match[2])


def _factors(headings: list[tuple[str, str | None]], problems: Problems) -> dict[str, float]:
    # factors from the units of the columns to those of the variables of a sweep
    factors = {}
    known = (*_OF_STEP, "counts", *_INDICES, "cube")
    for name, unit in headings:
        if name in SWEEP_VARIABLES:
            wanted = SWEEP_VARIABLES[name].units
            try:
                factors[name] = conversion_factor(unit or _ASSUMED.get(wanted, ""), wanted)
            except UnitsError:
                problems.add(
                    f"column {name!r} has {f'the unit {unit!r}' if unit else 'no unit'}",
                    expected=f"a unit such as [{wanted}]",
                    mend=f"write {name} [{wanted}]",
                    code="units-unknown",
                )
        elif name not in known and not _WIDE.fullmatch(name):
            close = difflib.get_close_matches(name, known, 1)
            problems.add(
                f"unknown column {name!r}",
                expected=", ".join((*known, "column 0 ...")),
                mend=f"did you mean {close[0]!r}?" if close else "",
                code="column-unknown",
            )
    return factors


def _cell(row: list[str], k: int, line: int, heading: list[str], problems: Problems) -> float:
    value = number(row[k])
    problems.add_if(
        value is None,
        f"row {line}, column {heading[k].strip()!r}: {row[k][:40]!r}",
        expected="a number, or an empty cell",
        code="number-unreadable",
    )
    return np.nan if value is None else value


def _array(
    path: Path, key: tuple[float, ...], names: list[str], value: Any, problems: Problems
) -> tuple[xr.DataArray, float]:
    # frames (frame, band, cross_track) of a step, and their number, NaN where unknown
    empty = xr.DataArray(np.empty((0, 0, 0), np.float32), dims=("frame", *_INDICES))
    if isinstance(value, str):
        try:
            cube = open_envi(path.parent / value, unsaid="counts")
            counts = cube["counts"].reset_coords(drop=True).drop_attrs()
            frames = counts.chunk({ALONG_TRACK: CHUNK_LINES}).rename({ALONG_TRACK: "frame"})
        except (PaintError, OSError, KeyError) as error:
            problems.add(f"cube {value!r}: {error}", expected="an ENVI cube of counts", code="cube-missing")
            return empty, np.nan
        return frames, float(frames.sizes["frame"])
    bands, columns = (int(max(at[axis] for at in value)) + 1 for axis in (0, 1))
    if len(value) != bands * columns:
        step = ", ".join(f"{name} {number:g}" for name, number in zip(names, key, strict=True) if number >= 0)
        problems.add(
            f"the step with {step} has {len(value)} counts",
            expected=f"{bands} bands times {columns} columns",
            code="shape-mismatch",
        )
        return empty, np.nan
    values = np.empty((1, bands, columns), np.float32)
    for (band, column), count in value.items():
        values[0, int(band), int(column)] = count
    return xr.DataArray(values, dims=("frame", *_INDICES)), np.nan


def _sweep(
    names: list[str], arrays: Mapping[tuple[float, ...], tuple[xr.DataArray, float]], problems: Problems
) -> xr.Dataset:
    # light and darks by their keys, in the order of wavelengths
    light = [k for k, name in enumerate(names) if name in _LIGHT]
    exposure = names.index("exposure_time")
    lit = sorted(key for key in arrays if any(key[k] > 0 for k in light))
    darks = [key for key in arrays if key not in set(lit)]
    problems.add_if(
        not lit or not darks,
        f"{len(lit)} steps with light and {len(darks)} darks",
        expected=f"both; a dark has no {', '.join(names[k] for k in light)}",
        code="dark-missing",
    )
    problems.raise_if_any()
    table = np.array(lit).T
    sweep = xr.Dataset()
    for name, values in zip(names, table, strict=True):
        values = np.where(values < 0, np.nan, values)
        is_constant = name not in _LIGHT and (values == values[0]).all()
        sweep[name] = ((), values[0]) if is_constant else (STEP, values)
        sweep[name].attrs["units"] = SWEEP_VARIABLES[name].units

    def means(keys: list[tuple[float, ...]]) -> xr.DataArray:
        frames = [arrays[key][0].astype(np.float32).mean("frame") for key in keys]
        return xr.concat(frames, STEP).assign_attrs(units="count")

    sweep["counts"] = means(lit)
    # of every step the dark at the nearest exposure; a single dark is that of all steps
    nearest = [min(darks, key=lambda dark: abs(dark[exposure] - key[exposure])) for key in lit]
    dark_counts, at = means(nearest), [dark[exposure] for dark in nearest]
    is_single = len(set(nearest)) == 1
    sweep["dark_counts"] = dark_counts[0] if is_single else dark_counts
    sweep["dark_exposure_time"] = ((), at[0], {"units": "s"}) if is_single else (STEP, at, {"units": "s"})
    counts = np.array([arrays[key][1] for key in lit])
    if np.isfinite(counts).all():
        frames = [arrays[key][0].astype(np.float32) for key in lit]
        if (counts > 1).all():
            variance = xr.concat([cube.var("frame", ddof=1) for cube in frames], STEP)
            sweep["counts_variance"] = variance.assign_attrs(units="count2")
        sweep["frame_count"] = STEP, counts.astype(np.int64), {"units": "1"}
        sweep["dark_frame_count"] = STEP, np.array([arrays[key][1] for key in nearest], int), {"units": "1"}
    return sweep.transpose(*_DIMS, missing_dims="ignore")
