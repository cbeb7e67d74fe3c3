"""Lab sweeps as tables in CSV: counts in the table, or in cubes that its rows name."""

import csv
import difflib
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.errors import FormatError, PaintError, Problems, UnitsError
from hyperpaint.base.facts import conversion_factor
from hyperpaint.base.schema import ALONG_TRACK, BAND, CHUNK_LINES, CROSS_TRACK, STEP, SWEEP_VARIABLES
from hyperpaint.io.envi.envi_cubes import open_envi
from hyperpaint.io.files.reading import number, read_limited_text

#: Maximum size of a table [byte]; larger sweeps are cubes, or a Zarr store.
_MAX_BYTES = 64 << 20
_MAX_SHOWN = 8
_HEADING = re.compile(r"^\s*(.*?)\s*(?:\[([^\]]*)\])?\s*$")
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
    numbered = [
        (n, line)
        for n, line in enumerate(text.decode("utf-8-sig", "replace").splitlines(), 1)
        if line.strip() and not line.startswith("#")
    ]
    cells = list(csv.reader(line for _, line in numbered)) or [[]]
    headings = [_HEADING.findall(cell.replace("\n", " "))[0] for cell in cells[0]]
    columns = {name: k for k, (name, _) in enumerate(headings)}
    wide = [name for name in columns if _WIDE.fullmatch(name)]
    factors = _factors(headings, problems)
    of_elements = BAND in columns and (bool(wide) or {"counts", CROSS_TRACK} <= set(columns))
    problems.add_if(
        ("cube" in columns) == of_elements or "exposure_time" not in columns or len(columns) < len(headings),
        f"columns {', '.join(name for name, _ in headings)[:200]}",
        expected="each once: exposure_time; cube, or band, cross_track, counts, or band, column 0, ...",
        code="column-missing",
    )
    problems.raise_if_any()
    # counts, or cubes, by the values of a step: all rows with these values are of one step
    steps: dict[tuple[float, ...], dict[tuple[float, float], Any]] = {}
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
            counts = steps.setdefault(key, {})
            # the only element of a cube is its name
            across: list[tuple[float, Any]] = [(float(name[7:]), values[name]) for name in wide]
            if not wide:
                across = [
                    (values.get(CROSS_TRACK, 0.0), values.get("counts", row[columns.get("cube", 0)].strip()))
                ]
            for column, value in across:
                at = (values.get(BAND, 0.0), column)
                problems.add_if(
                    not all(n == n and n >= 0 and n == int(n) for n in at) or at in counts,
                    f"row {line}: band {at[0]:g}, column {at[1]:g}{' again' * (at in counts)}",
                    expected="whole numbers from 0, each element, or one cube, once a step",
                    code="row-duplicate",
                )
                counts[at] = value
        if len(problems) >= _MAX_SHOWN:
            problems.raise_if_any()
    problems.raise_if_any()
    arrays = {}
    for key, counts in steps.items():
        stated = (f"{name} {value:g}" for name, value in zip(of_step, key, strict=True) if value >= 0)
        try:
            is_cube = "cube" in columns
            arrays[key] = _cube(path.parent / counts[0, 0]) if is_cube else _array(", ".join(stated), counts)
        except FormatError as error:
            problems.add_error("", error)
    shapes = {array.shape[1:] for array in arrays.values()}
    problems.add_if(
        len(shapes) > 1,
        f"steps of {' and '.join(map(str, sorted(shapes)))} bands and columns",
        expected="one size",
        code="shape-mismatch",
    )
    problems.raise_if_any()
    return _sweep(of_step, arrays, problems, has_frames="cube" in columns)


def _factors(headings: list[tuple[str, str]], problems: Problems) -> dict[str, float]:
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


def _cube(path: Path) -> xr.DataArray:
    # frames (frame, band, cross_track) of a cube
    try:
        counts = open_envi(path, unsaid="counts")["counts"].reset_coords(drop=True).drop_attrs()
    except (PaintError, OSError, KeyError) as error:
        raise FormatError(
            f"cube {path.name!r}: {error}", expected="an ENVI cube of counts", code="cube-missing"
        ) from error
    return counts.chunk({ALONG_TRACK: CHUNK_LINES}).rename({ALONG_TRACK: "frame"})


def _array(step: str, counts: Mapping[tuple[float, float], float]) -> xr.DataArray:
    # counts (frame, band, cross_track) of a step, by band and column
    bands, columns = (int(max(at[axis] for at in counts)) + 1 for axis in (0, 1))
    FormatError.raise_if(
        len(counts) != bands * columns,
        f"the step with {step} has {len(counts)} counts",
        expected=f"{bands} bands times {columns} columns",
        code="shape-mismatch",
    )
    values = [[[counts[band, column] for column in range(columns)] for band in range(bands)]]
    return xr.DataArray(np.array(values, np.float32), dims=("frame", *_INDICES))


def _sweep(
    names: list[str],
    arrays: Mapping[tuple[float, ...], xr.DataArray],
    problems: Problems,
    *,
    has_frames: bool,
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
    sweep = xr.Dataset()
    for name, values in zip(names, np.where(np.array(lit) < 0, np.nan, lit).T, strict=True):
        is_constant = name not in _LIGHT and (values == values[0]).all()
        sweep[name] = ((), values[0]) if is_constant else (STEP, values)
    # of every step the dark at the nearest exposure; a single dark is that of all steps
    nearest = [min(darks, key=lambda dark: abs(dark[exposure] - key[exposure])) for key in lit]
    shared = {STEP: 0} if len(set(nearest)) == 1 else {}
    for prefix, keys in (("", lit), ("dark_", nearest)):
        frames = [arrays[key].astype(np.float32) for key in keys]
        sweep[f"{prefix}counts"] = xr.concat([cube.mean("frame") for cube in frames], STEP)
        if has_frames:
            sweep[f"{prefix}frame_count"] = STEP, [cube.sizes["frame"] for cube in frames]
            if not prefix and min(cube.sizes["frame"] for cube in frames) > 1:
                sweep["counts_variance"] = xr.concat([cube.var("frame", ddof=1) for cube in frames], STEP)
    sweep["dark_exposure_time"] = STEP, [dark[exposure] for dark in nearest]
    for name in ("dark_counts", "dark_exposure_time"):
        sweep[name] = sweep[name].isel(shared)
    for name in map(str, sweep.variables):
        sweep[name].attrs = {"units": SWEEP_VARIABLES[name].units}
    return sweep.transpose(*_DIMS, missing_dims="ignore")
