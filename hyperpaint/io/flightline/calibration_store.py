"""Calibration stores (`radiance_gain` and spectral axis of an imager), and lab sweeps.

Lab sweeps as tables in CSV: counts in the table, or in cubes that its rows name.
"""

import csv
import difflib
import functools
import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base import (
    ALONG_TRACK,
    BAND,
    CHUNK_LINES,
    CROSS_TRACK,
    MAX_STRAY_LIGHT_U,
    SRF_SHAPES,
    STEP,
    SWEEP_VARIABLES,
    VARIABLES,
    Floats,
    FormatError,
    PaintError,
    Problem,
    Problems,
    SchemaError,
    UnitsError,
    conversion_factor,
    convert,
    dtype_of,
    input_path,
    label,
    one_of,
    warn_user,
)
from hyperpaint.io.envi.envi_cubes import open_envi
from hyperpaint.io.files.reading import load_netcdf, number, read_limited_text
from hyperpaint.io.store import list_groups, load_group, open_unverified
from hyperpaint.io.store.reader import is_zarr

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
    problems.raise_if_any(
        (
            ("cube" in columns) == of_elements
            or "exposure_time" not in columns
            or len(columns) < len(headings),
            Problem(
                f"columns {', '.join(name for name, _ in headings)[:200]}",
                expected="each once: exposure_time; cube, or band, cross_track, counts, or band, column 0...",
                code="column-missing",
            ),
        ),
    )
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
    problems.raise_if_any(
        (
            len(shapes) > 1,
            Problem(
                f"steps of {' and '.join(map(str, sorted(shapes)))} bands and columns",
                expected="one size",
                code="shape-mismatch",
            ),
        ),
    )
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
    problems.raise_if_any(
        (
            not lit or not darks,
            Problem(
                f"{len(lit)} steps with light and {len(darks)} darks",
                expected=f"both; a dark has no {', '.join(names[k] for k in light)}",
                code="dark-missing",
            ),
        ),
    )
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


# --- tables of a sweep -------------------------------------------------------------------------------------

_ELEMENT = (BAND, CROSS_TRACK)
#: Required and optional variables of a calibration; `hyperpaint.base.schema` has their units and dims.
_REQUIRED = ("radiance_gain", "wavelength", "fwhm")
_OPTIONAL = (
    "wavelength_shift",
    "band_spacing",
    "good",
    "dark_counts",
    "dark_exposure_time",
    "saturation_count",
    "electrons_per_count",
    "read_noise",
    "look_angle",
    "masked",
)
#: Further variables of a lab calibration; only their units and dims are checked. In their names ``line`` is a
#: lamp line.
_SWEEP_RESULTS = (
    "radiance_gain_u_random",
    "radiance_gain_u_systematic",
    "wavelength_u",
    "irradiance_u_systematic",
    "dark_bias",
    "dark_rate",
    "flat_field",
    "responsivity",
    "quantum_efficiency",
    "linearity_counts",
    "linear_counts",
    "linearity_basis",
    "linearity_map",
    "linearity_u",
    "stray_light",
    "stray_light_across",
    "stray_light_u",
    "band_shift_time",
    "step_wavelength",
    "line_band",
    "line_centre",
    "line_fwhm",
    "line_own_fwhm",
    "line_amplitude",
    "line_area",
    "line_covariance",
    "line_trusted",
    "beam_centre",
    "beam_fwhm",
    "out_of_band",
    "second_order",
)
#: Variables of tabulated line shapes.
_TABULATED = ("srf_offset", "srf")


#: Rule of the values by variable: test of the array, fault, expected, and code of the error.
_VALUE_RULES: Mapping[str, tuple[Callable[[Floats], Any], str, str, str]] = {
    **dict.fromkeys(
        ("wavelength", "fwhm", "band_spacing", "saturation_count", "electrons_per_count"),
        (lambda v: np.isfinite(v).all() and (v > 0).all(), "is not finite and positive everywhere", "",
         "value-out-of-range"),
    ),
    "wavelength_shift": (
        lambda v: np.isfinite(v).all() and (np.abs(v) < 100.0).all(),
        "is not finite and below 100 nm everywhere", "", "value-out-of-range",
    ),
    "look_angle": (
        lambda v: np.isfinite(v).all() and (np.abs(v) < 90.0).all(),
        "is not finite and below 90 degrees everywhere", "", "value-out-of-range",
    ),
    **dict.fromkeys(
        (
            "radiance_gain_u_random", "radiance_gain_u_systematic", "wavelength_u", "irradiance_u_systematic",
        ),
        (lambda v: not (v < 0).any(), "has negative values", "a standard uncertainty", "value-out-of-range"),
    ),
    "read_noise": (
        lambda v: not np.isinf(v).any() and not (v < 0).any(),  # NaN where unknown
        "is not finite and at least zero everywhere", "", "value-out-of-range",
    ),
    "srf": (
        lambda v: np.isfinite(v).all() and (v >= 0).all(),
        "is not finite and at least zero everywhere", "", "value-out-of-range",
    ),
    "srf_offset": (
        lambda v: np.isfinite(v).all() and (np.diff(v) > 0).all(),
        "does not increase strictly", "", "axis-unordered",
    ),
}  # fmt: skip


def open_calibration(
    source: Any, *, group: str | None = None, bad_elements: str | os.PathLike[str] | None = None
) -> xr.Dataset:
    """Open a calibration and check it.

    Parameters
    ----------
    source
        A Zarr store (folder, zip file, URL or store object of zarr) or netCDF file with ``radiance_gain``
        (band, cross_track), ``wavelength`` (band) and ``fwhm`` (band) at its root, all with units; or such a
        Dataset.
    group
        Group of the calibration; by default the root, or ``calibration`` if the store is a collect.
    bad_elements
        List of bad elements, whose gain becomes NaN: a table in CSV, of band and column, both numbered from
        0, below a row of headings; or an ENVI file of one value an element, 0 for good elements.

    Returns
    -------
    xarray.Dataset
        In memory, in the units, dims and dtypes of `hyperpaint.base.schema`; attribute ``srf_shape``.
        Elements with a NaN gain are bad. Other variables on ``band`` and ``cross_track`` are kept.

    Raises
    ------
    FormatError
        The store or the list cannot be read, or the store differs from its manifest.
    SchemaError
        Variables, units or values are missing or impossible; all problems are listed. The list has other
        bands or columns.

    Warns
    -----
    PaintWarning
        The line shape is not declared; a Gaussian is assumed.

    Examples
    --------
    >>> import xarray as xr
    >>> gain = xr.DataArray([[1e-8, 1e-8]], dims=("band", "cross_track"))
    >>> gain.attrs["units"] = "uW cm-2 sr-1 nm-1 s count-1"
    >>> nm = {"units": "nm"}
    >>> calibration = open_calibration(xr.Dataset(
    ...     {"radiance_gain": gain},
    ...     {"wavelength": ("band", [550.0], nm), "fwhm": ("band", [6.0], nm)},
    ...     {"srf_shape": "slit"}))
    >>> float(calibration.radiance_gain[0, 0]), calibration.radiance_gain.units
    (1.00...e-10, 'W m-2 sr-1 nm-1 s count-1')
    """

    def load(source: Any, group: str | None) -> xr.Dataset:
        groups = {} if group is not None else {"", "calibration"}.intersection(list_groups(source))
        return load_group(source, "calibration" if groups == {"calibration"} else group)

    calibration = (
        check_calibration(source)
        if isinstance(source, xr.Dataset)
        else check_calibration(_read(source, group, "calibration", load), str(source))
    )
    if bad_elements is not None:
        gain = calibration["radiance_gain"]
        path = input_path(bad_elements, "a list of bad elements")
        shape = gain.shape
        # whether the elements (band, cross_track) are in the list
        if path.suffix.lower() == ".csv":
            rows = read_limited_text(path, _MAX_BYTES, "a table of bad elements").splitlines()
            try:
                places = np.loadtxt(rows, np.int64, delimiter=",", skiprows=1, usecols=(0, 1), ndmin=2)
            except ValueError as error:
                raise FormatError(
                    f"{path}: {error}", expected="numbers of band and column", code="file-unreadable"
                ) from error
            sizes, is_fitting = places.max(axis=0, initial=-1) + 1, ((places >= 0) & (places < shape)).all()
            bad = np.zeros(shape, bool)
            if is_fitting:
                bad[tuple(places.T)] = True
        else:
            bad = np.squeeze(open_envi(path, quantity="values")["values"].to_numpy()) != 0
            sizes, is_fitting = np.array(bad.shape), bad.shape == shape
        SchemaError.raise_if(
            not is_fitting,
            f"{path}: bad elements up to {tuple(sizes.tolist())}",
            expected=f"bands and columns of the calibration, {shape}",
            code="grid-mismatch",
        )
        calibration["radiance_gain"] = gain.copy(data=np.where(bad, np.float32(np.nan), gain.values))
    return calibration


def _read(
    source: Any, group: str | None, content: str, open_zarr: Callable[[Any, str | None], xr.Dataset]
) -> xr.Dataset:
    # Open a Zarr store, or load a netCDF file; `content` names it in messages
    zarr = is_zarr(source)
    is_path = isinstance(source, str | os.PathLike) and "://" not in os.fspath(source)
    FormatError.raise_if(
        is_path and not input_path(Path(source), f"a {content} in a Zarr store or netCDF file").exists(),
        f"{source}: no such {content}",
        expected="a Zarr store or a netCDF file",
        code="file-not-found",
    )
    try:
        return open_zarr(source, group) if zarr else load_netcdf(Path(source), group)
    except Exception as error:  # zarr and the netCDF engines raise errors of many classes
        raise FormatError(
            f"{source}: not a readable Zarr store or netCDF file ({type(error).__name__}: {error!s:.200})",
            mend="" if zarr else "install for netCDF-4: python -m pip install h5netcdf",
            code="file-unreadable",
        ) from error


def check_calibration(dataset: xr.Dataset, subject: str = "this Dataset") -> xr.Dataset:
    # Return a calibration in the units, dims and dtypes of the table of variables, with all faults listed.
    # ``dataset``: see `open_calibration`; ``subject``: its name in messages.
    # Raises `SchemaError`: Variables, units or values are missing or impossible; all problems are listed.
    # Warns `PaintWarning`: The line shape is not declared; a Gaussian is assumed.
    problems = Problems(f"{subject} cannot be used as calibration", SchemaError)
    shape = dataset.attrs.get("srf_shape")
    names = [*_REQUIRED, *(name for name in (*_OPTIONAL, *_SWEEP_RESULTS) if name in dataset.variables)]
    if shape == "tabulated" or "srf" in dataset.variables:
        names += _TABULATED
    arrays: dict[str, xr.DataArray] = {}
    for name in names:
        try:
            # A variable in the units, dims and dtype of the table, without coordinates
            spec = VARIABLES[name]
            SchemaError.raise_if(
                name not in dataset.variables,
                f"{name!r} is missing",
                expected=f"{spec.meaning.lower()} ({', '.join(spec.dims)}) [{spec.units}]",
                code="variable-missing",
            )
            array = dataset[name].reset_coords(drop=True)
            allowed = [dims for dims in (spec.dims, *spec.alternatives) if set(dims) == set(array.dims)]
            SchemaError.raise_if(
                not allowed,
                f"{name!r} has dims ({', '.join(map(str, array.dims))})",
                expected=" or ".join(f"({', '.join(dims)})" for dims in (spec.dims, *spec.alternatives)),
                code="dims-wrong",
            )
            SchemaError.raise_if(
                array.dtype.kind not in ("biu" if spec.dtype == "bool" else "fiu"),
                f"{name!r} has dtype {array.dtype}",
                expected=spec.dtype,
                code="type-wrong",
            )
            array = array.transpose(*allowed[0])
            if spec.units and spec.units != "1":
                # converted in float64, so that values are rounded once
                array = convert(array.astype(np.float64), spec.units, name)
            arrays[name] = label(array.astype(dtype_of(name)), name)
        except (SchemaError, UnitsError) as error:
            problems.add_error("", error)
    for name, array in arrays.items():
        test, fault, expected, code = _VALUE_RULES.get(name, (lambda _: True, "", "", ""))
        problems.add_if(not test(array.values), f"{name!r} {fault}", expected=expected, code=code)
    if "radiance_gain" in arrays:
        gains = arrays["radiance_gain"].values
        unusable = int((np.isinf(gains) | (gains <= 0)).sum())
        problems.add_if(
            np.isnan(gains).all(),
            "'radiance_gain' is NaN everywhere",
            expected="a gain for the elements that are not bad",
            code="not-finite",
        )
        problems.add_if(
            unusable,
            f"'radiance_gain' is zero, negative or infinite in {unusable} elements",
            expected="positive gains, and NaN for bad elements",
            code="value-out-of-range",
        )
    if shape is not None:
        one_of(shape, SRF_SHAPES, "attribute srf_shape", problems=problems)
    sizes = {name: size for name, size in dataset.sizes.items() if name in _ELEMENT}
    problems.raise_if_any(
        (
            any(size == 0 for size in sizes.values()),
            Problem(f"sizes {sizes}", expected="at least one element", code="empty-input"),
        ),
    )
    if shape is None:
        shape = "gaussian"
        warn_user(f"{subject}: no attribute srf_shape; a Gaussian line shape is assumed", "srf-shape-missing")
    # further variables of the elements are kept
    for key, array in dataset.data_vars.items():
        in_table = str(key) in VARIABLES
        if not in_table and array.ndim and set(array.dims) <= set(_ELEMENT) and array.dtype.kind in "fiu":
            arrays[str(key)] = array
    coords = {
        name: arrays.pop(name) for name in list(arrays) if name in VARIABLES and VARIABLES[name].coordinate
    }
    return xr.Dataset(arrays, coords, {**dataset.attrs, "srf_shape": shape})


def calibration_parts(calibration: xr.Dataset | None, is_counts: bool) -> dict[str, xr.DataArray]:
    # Return the variables of a calibration that a flight line needs.
    # A line of radiance needs only the line shape and the look angles.
    if calibration is None:
        return {}
    excluded = {
        "dark_counts",
        "dark_exposure_time",
        "dark_bias",
        "dark_rate",
        "responsivity",
        "saturation_count",
    }
    # variables of lamp lines and sweep steps have other dims
    line_dims = {
        BAND,
        CROSS_TRACK,
        "srf_offset",
        "irradiance_wavelength",
        "linearity_counts",
        "linearity_term",
        "source_band",
        "source_column",
    }
    names = [str(name) for name, array in calibration.data_vars.items() if set(array.dims) <= line_dims]
    if float(calibration.get("stray_light_u", 0.0)) >= MAX_STRAY_LIGHT_U:
        names = [name for name in names if not name.startswith("stray_light")]
    if not {"stray_light", "stray_light_across"} & set(names):
        excluded.add("flat_field")  # part of the gain; stray light needs the levels of elements
    names = [name for name in names if name not in excluded]
    if not is_counts:
        names = [name for name in names if name in ("srf", "look_angle")]
    return {name: calibration[name].reset_coords(drop=True) for name in names}


def scale_attrs(calibration: xr.Dataset | None) -> dict[str, Any]:
    # Return the attributes of a calibration on linearity and absolute scale.
    names = ("linearity", "linearity_on", "pedestal", "pedestal_statistic", "absolute_scale")
    return {} if calibration is None else {k: calibration.attrs[k] for k in names if k in calibration.attrs}


def open_sweep(path: Any, *, group: str | None = None) -> xr.Dataset:
    """Open a lab sweep, lazily from a store or cubes.

    Its content is checked by `hyperpaint.calibrate`. The documentation describes the format of tables and has
    example files (Formats, Lab sweeps).

    Parameters
    ----------
    path
        A Zarr store or netCDF file; a table in CSV with counts, or with a column ``cube`` of ENVI headers and
        the readings of a power meter; or a folder with such cubes and one table.
    group
        Group of the sweep in the store; by default the root.

    Returns
    -------
    xarray.Dataset
        The variables of `hyperpaint.base.schema.SWEEP_VARIABLES`, such as ``counts`` (step, band,
        cross_track) [count], ``exposure_time`` [s], ``flux`` [W]; others are dropped.

    Raises
    ------
    FormatError
        The file cannot be read, or has no counts of steps; faults of a table are listed with row, column and
        unit.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> table = pathlib.Path(tempfile.mkdtemp(), "sphere.csv")
    >>> rows = ["level [1],exposure_time [ms],band,column 0,column 1", ",5,0,101,102", "1,5,0,501,510"]
    >>> _ = table.write_text(chr(10).join(rows))
    >>> sphere = open_sweep(table)
    >>> (sphere.counts - sphere.dark_counts).values.tolist(), float(sphere.exposure_time)
    ([[[400.0, 408.0]]], 0.005)
    """
    # in chunks of steps: the calibration processes few steps at a time
    table = path if str(path).lower().endswith(".csv") else None
    if isinstance(path, str | os.PathLike) and os.path.isdir(path) and not is_zarr(path):
        tables = sorted(Path(path).glob("*.csv"))
        FormatError.raise_if(
            len(tables) > 1,
            f"{path}: {len(tables)} tables of a lab sweep",
            expected="one .csv, with a row for every cube",
            mend="name the table in place of its folder",
            code="sweep-missing",
        )
        table = tables[0] if tables else None
    if table is not None:
        return read_sweep_table(Path(table))
    opened = _read(path, group, "sweep", functools.partial(open_unverified, chunks={}))
    FormatError.raise_if(
        "counts" not in opened.variables or STEP not in opened["counts"].dims,
        f"{path}: holds {', '.join(sorted(map(str, opened.variables))[:8]) or 'nothing'}",
        expected="a lab sweep with 'counts' (step, band, cross_track)",
        code="counts-missing",
    )
    names = [name for name in SWEEP_VARIABLES if name in opened.variables]
    return opened[names].reset_coords(drop=True) if not set(names) & set(opened.coords) else opened[names]


def saturation_of(
    saturation_count: float | None, bit_depth: int, calibration: xr.Dataset | None
) -> xr.DataArray:
    # Return ``saturation_count``: the argument, else that of the calibration, else 2^bit_depth - 1.
    # Raises `SchemaError`: The count or the bit depth is out of range.
    if saturation_count is None and calibration is not None and "saturation_count" in calibration:
        return calibration["saturation_count"].reset_coords(drop=True)
    if saturation_count is None:
        SchemaError.raise_if(
            not 1 <= bit_depth <= 16, f"bit_depth {bit_depth}", expected="1 to 16", code="value-out-of-range"
        )
        saturation_count = 2**bit_depth - 1
    SchemaError.raise_if(
        not 0 < saturation_count <= 65535,
        f"saturation_count {saturation_count}",
        expected="a count up to 65535",
        code="value-out-of-range",
    )
    return label(xr.DataArray(np.float32(saturation_count)), "saturation_count")
