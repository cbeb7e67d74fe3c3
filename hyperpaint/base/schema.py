"""What datasets must hold, checked against the one table of variables (`hyperpaint.base.variables`).

A function takes its inputs through `require` and hands its outputs through `label`, which *replaces*
attributes, since xarray carries stale ones through arithmetic.
"""

from __future__ import annotations

import functools
import warnings
from collections.abc import Hashable, Iterable, Mapping
from enum import IntFlag
from typing import Any

import numpy as np
import xarray as xr

from .arrays import Floats
from .errors import PaintWarning, Problems, SchemaError
from .units import convert, plain, same_dimension
from .variables import (
    ADVICE,
    ALONG_TRACK,
    BAND,
    CROSS_TRACK,
    CUBE,
    FLAG,
    IRRADIANCE_TIME,
    IRRADIANCE_WAVELENGTH,
    LIBRARY_VARIABLES,
    MEMBER,
    PANEL,
    QUANTILE,
    SIGNATURE,
    SLOT,
    STEP,
    SUN,
    SWEEP_VARIABLES,
    VARIABLES,
    Variable,
)

__all__ = [
    "ALONG_TRACK",
    "BAND",
    "CHUNK_LINES",
    "CROSS_TRACK",
    "CUBE",
    "DIM_ALIASES",
    "FLAG",
    "FORMAT_VERSION",
    "IRRADIANCE_TIME",
    "IRRADIANCE_WAVELENGTH",
    "LIBRARY_VARIABLES",
    "MEMBER",
    "MONOCHROMATOR_SHAPES",
    "PANEL",
    "QUANTILE",
    "SIGNATURE",
    "SLOT",
    "SRF_SHAPES",
    "STEP",
    "SUN",
    "SWEEP_VARIABLES",
    "TIME_UNITS",
    "VARIABLES",
    "Quality",
    "Variable",
    "dtype_of",
    "find",
    "flag_names",
    "flag_shares",
    "flags_named",
    "label",
    "numbers_of",
    "quality_attrs",
    "rename_to_roles",
    "require",
    "with_numbers",
]  # fmt: skip

FORMAT_VERSION = 3
"""Version of the layout on disk, repeated in every group as ``hyperpaint_format``: 3 has one manifest; 2 (of
0.2) had a record in every array's folder and one in the root; 1 (of 0.1) had none in the root."""

CHUNK_LINES = 32
"""Lines in one storage chunk, and in one task on threads (see docs/explanation/design.md)."""

TIME_UNITS = "nanoseconds since 1970-01-01"

MONOCHROMATOR_SHAPES = ("gaussian", "triangle")
"""Line shapes of a monochromator, named by the attribute ``monochromator_shape`` of a sweep."""

SRF_SHAPES = ("gaussian", "slit", "tabulated")
"""Line shapes of a band, named by the dataset attribute ``srf_shape``."""

#: What the neighbours call our dims, in lower case.
DIM_ALIASES: Mapping[str, tuple[str, ...]] = {
    ALONG_TRACK: ("line", "lines", "downtrack", "y", "frame"),
    BAND: ("bands", "wavelength", "wavelengths", "channel"),
    CROSS_TRACK: ("sample", "samples", "crosstrack", "x", "column"),
}


class Quality(IntFlag):
    """Bits of ``quality``; a bit set early is still set in every later product.

    Examples
    --------
    >>> import numpy as np
    >>> quality = np.uint16([0, 64, 65])
    >>> (quality & Quality.GLINT) != 0
    array([False,  True,  True])
    >>> Quality(65)
    <Quality.SATURATED|GLINT: 65>
    """

    SATURATED = 1
    BELOW_DARK = 2
    BAD_DETECTOR = 4
    IRRADIANCE_GAP = 8
    ILLUMINATION_UNSTABLE = 16
    LOW_SUN = 32
    GLINT = 64
    SHADOW = 128
    ADJACENCY = 256
    MIXED_EDGE = 512
    OFF_SWATH = 1024
    NO_DATA = 2048
    TIMING_SENSITIVE = 4096


def flag_names(bits: int = -1) -> list[str]:
    """Return the names of the flags in some bits, of all by default, as attributes and messages have them.

    Examples
    --------
    >>> flag_names(Quality.GLINT | Quality.MIXED_EDGE)
    ['glint', 'mixed_edge']
    """
    return [str(flag.name).lower() for flag in Quality if flag & bits]


def flag_shares(quality: np.ndarray[Any, Any]) -> dict[Quality, float]:
    """Return the share of pixels under every flag that occurs.

    Examples
    --------
    >>> import numpy as np
    >>> flag_shares(np.array([[1, 0], [65, 0]], np.uint16))
    {<Quality.SATURATED: 1>: 0.5, <Quality.GLINT: 64>: 0.25}
    """
    counts = {flag: int(((quality & int(flag)) != 0).sum()) for flag in Quality}
    return {flag: count / quality.size for flag, count in counts.items() if count}


def flags_named(names: Iterable[str]) -> list[Quality]:
    """Return flags by their names, in any case.

    Raises
    ------
    SchemaError
        There is no such flag; all unknown names are listed.
    """
    by_name = dict(zip(flag_names(), Quality, strict=True))
    names = list(names)
    if unknown := [name for name in names if name.lower() not in by_name]:
        raise SchemaError(f"no flag {', '.join(map(repr, unknown))}; flags are {', '.join(by_name)}")
    return [by_name[name.lower()] for name in names]


def rename_to_roles(dataset: xr.Dataset, dims: Mapping[str, Hashable] | None = None) -> xr.Dataset:
    """Return ``dataset`` with its dims named by role: ``along_track``, ``band``, ``cross_track``.

    Quantities become numbers (`hyperpaint.base.units.plain`), and coordinates along one dim are in the units
    of the table from here on. What `where` and `concat` do to other variables is undone: dims that they gave
    to variables which do not vary along them, and flags that became floats.

    Parameters
    ----------
    dataset
        Any dataset with a cube.
    dims
        Role to dim name, for names that `DIM_ALIASES` does not know.

    Raises
    ------
    SchemaError
        ``dims`` names a role or a dim that does not exist; nothing is selected of a dim of the cube; or
        arrays are those of cubed or cupy.
    """
    _refuse_foreign_arrays(dataset)
    # cells of a map have lines and times of their own
    is_map = {"y", "x"} <= {*dataset.dims, *dataset.coords} or "spatial_ref" in dataset.variables
    dataset = _with_table_units(plain(dataset))
    names: dict[Hashable, Hashable] = {}
    for role, name in (dims or {}).items():
        if role not in CUBE or name not in dataset.dims:
            raise SchemaError(
                f"dims={{{role!r}: {name!r}}}: expected roles {list(CUBE)} "
                f"and dims of the dataset {list(map(str, dataset.dims))}"
            )
        names[name] = role
    for role, aliases in DIM_ALIASES.items():
        if role in dataset.dims or role in names.values():
            continue
        index = next(
            (dim for dim in dataset.dims if dim in VARIABLES and VARIABLES[str(dim)].dims == (role,)), None
        )
        if index is not None and role in dataset.coords:  # after swap_dims(along_track="time")
            dataset = dataset.swap_dims({index: role})
            continue
        names_of_role = (role, *aliases)
        alias = next((d for d in dataset.dims if str(d).lower() in names_of_role and d not in names), None)
        if alias is not None:
            names[alias] = role
    # a dim `wavelength` with a coordinate of that name becomes the coordinate wavelength(band)
    indexed = [name for name, role in names.items() if role == BAND and name in dataset.coords]
    if indexed:
        dataset = dataset.reset_index(indexed)
    names = {old: new for old, new in names.items() if old != new}
    dataset = dataset.rename_dims(names) if names else dataset
    for dim, thing in zip(CUBE, ("line", "band", "column"), strict=True):
        if dataset.sizes.get(dim) == 0:
            raise SchemaError(
                f"nothing is selected: {dim} has size 0",
                expected=f"one {thing} or more",
                mend="the slice, mask or wavelength range kept none",
            )
    return with_whole_numbers(dataset) if is_map else _as_in_table(dataset)


_OF_ELEMENTS = ("dark_counts", "radiance_gain")
_PICTURES = ("overview", "coarse_reflectance")


def _as_in_table(dataset: xr.Dataset) -> xr.Dataset:
    """Return variables with the dims and whole numbers of the table, where `where` or `concat` changed them.

    Nothing lazy is computed: what is taken for constant along a dim is checked when it is.
    """
    changed: dict[Hashable, xr.Variable] = {}
    dropped = []
    # after where() on counts, darks and gain have the dims of the cube: require refuses them, naming isel
    is_masked = "counts" in dataset.variables and dataset.variables["counts"].dtype.kind == "f"
    for name, variable in dataset.variables.items():
        row = VARIABLES.get(str(name))
        if row is None or not set(variable.dims) & set(CUBE) or (is_masked and name in _OF_ELEMENTS):
            continue
        if name not in _PICTURES:
            own = _without_added_dims(variable, row)
            changed |= {} if own is variable else {name: own}
        elif not set(variable.dims) <= set(row.dims):
            dropped.append(name)  # of the whole line, of which this is a part
    if "quality" in dataset.variables and _is_averaged(dataset):
        dropped.append("quality")
        text = (
            "flags of 'quality' are means over pixels, and are left out; choose pixels by their flags before "
            "they are averaged"
        )
        warnings.warn(text, PaintWarning, stacklevel=3)
    dataset = dataset.drop_vars(dropped) if dropped else dataset
    return with_whole_numbers(dataset.assign(changed) if changed else dataset)


def _is_averaged(dataset: xr.Dataset) -> bool:
    """Tell whether flags are means of several pixels', as coarsen and interp leave them."""
    quality = dataset.variables["quality"]
    if quality.dtype.kind != "f":
        return False
    if any(dim in dataset.coords and dataset[dim].dtype.kind == "f" for dim in (ALONG_TRACK, CROSS_TRACK)):
        return True
    return quality.chunks is None and bool((np.nan_to_num(quality.values) % 1.0 != 0.0).any())


def _without_added_dims(variable: xr.Variable, row: Variable) -> xr.Variable:
    """Return a variable without dims of a cube along which it is constant, missing values left out."""
    dims = set(variable.dims)
    fitting = [own for own in row.allowed_dims if set(own) < dims and dims - set(own) <= set(CUBE)]
    if not fitting or any(dims == set(own) for own in row.allowed_dims):
        return variable
    if variable.dtype == object and row.dtype == "bool":  # with gaps
        variable = variable.astype(np.float32)
    if variable.dtype.kind not in "biufmM":
        return variable
    added = [dim for dim in variable.dims if dim not in max(fitting, key=len)]
    low, high = variable.min(added), variable.max(added)
    if low._in_memory and high._in_memory:
        if not ((low == high) | low.isnull()).all():
            return variable
    else:
        import dask.array as da

        constant = da.map_blocks(
            _constant, low.data, high.data, name_of=row.name, dims=added, dtype=low.dtype, meta=low.data._meta
        )
        low = low.copy(data=constant)
    low.attrs = variable.attrs
    return low


def _constant(low: Any, high: Any, *, name_of: str, dims: list[str]) -> Any:
    """Return the least values where they are the highest too."""
    if not ((low == high) | (low != low)).all():
        raise SchemaError(
            f"{name_of!r} differs along {' and '.join(dims)}",
            mend="choose by .sel() or .isel() where where(..., drop=True) or xr.concat gave it that dim",
        )
    return low


def with_whole_numbers(dataset: xr.Dataset, table: Mapping[str, Variable] = VARIABLES) -> xr.Dataset:
    """Return flags, indices and classes as integers where `where` made them floats; lazy arrays stay lazy.

    Missing flags become `Quality.NO_DATA`, missing indices -1 or 0 as the table says. Counts stay floats, and
    so do index coordinates: both may be fractions.
    """
    changed = {}
    for name, row in table.items():
        variable = dataset.variables.get(name)
        if variable is None or variable.dtype.kind not in "fO" or row.dtype in ("str", "datetime64[ns]"):
            continue
        kind = np.dtype(row.dtype).kind
        if kind not in "iub" or name == "counts" or variable.dims == (name,):
            continue
        gap = -1 if "-1" in row.meaning or name == "sky_state" else 0
        gap = int(Quality.NO_DATA) if name == "quality" else gap
        integers = functools.partial(_integers, gap=gap, dtype=row.dtype)
        if variable.chunks is None:
            changed[name] = variable.copy(data=integers(variable.values))
        else:
            changed[name] = variable.copy(data=variable.data.map_blocks(integers, dtype=row.dtype))
    return dataset.assign(changed) if changed else dataset


def _integers(values: Any, *, gap: int, dtype: str) -> Any:
    numbers = np.asarray(values, np.float64)
    return np.where(np.isfinite(numbers), np.rint(numbers), gap).astype(dtype)


_FOREIGN_ARRAYS = {
    "cubed": "map hyperpaint.slab over its blocks (docs/howto/engines.md), or open with dask or chunks=None",
    "cupy": "take it from the GPU first, by dataset.as_numpy() or array.get(): the kernels run on processors",
}


def _refuse_foreign_arrays(dataset: xr.Dataset) -> None:
    """Refuse arrays that would be taken for numpy's or dask's; no package is imported to tell them."""
    for name, variable in dataset.variables.items():
        data = variable._data
        for each in (data, getattr(data, "_meta", None)):  # a dask array of such arrays
            package = type(each).__module__.partition(".")[0]
            if package in _FOREIGN_ARRAYS:
                raise SchemaError(
                    f"{name!r} is an array of {package}",
                    expected="numpy or dask",
                    mend=_FOREIGN_ARRAYS[package],
                )


BELONGS = "calibration_variables"
"""Attribute of ``radiance_gain``: what else the calibration holds that changes values where it is missing."""

_BELONGING = (
    "wavelength_shift", "good", "masked", "linear_counts", "stray_light", "band_shift_time", "srf",
)  # fmt: skip


def with_belongings(line: xr.Dataset) -> xr.Dataset:
    """Return a flight line whose gain names what belongs to it, so that its loss is noticed."""
    if "radiance_gain" not in line.variables:
        return line
    names = " ".join(name for name in _BELONGING if name in line.variables)
    return line.assign(radiance_gain=line["radiance_gain"].assign_attrs({BELONGS: names}))


def warn_of_lost_belongings(line: xr.Dataset, purpose: str) -> None:
    """Warn where variables are missing that belong to the gain of a line, as after ``drop_vars``."""
    gain = line.variables.get("radiance_gain")
    names = str(gain.attrs.get(BELONGS, "")).split() if gain is not None else []
    lost = [name for name in names if name in _BELONGING and name not in line.variables]
    if lost:
        text = (
            f"{purpose} is computed without {', '.join(map(repr, lost))}, which the calibration of this line "
            "has; keep them beside 'radiance_gain'"
        )
        smile = " (smile is not corrected)" if "wavelength_shift" in lost else ""
        warnings.warn(text + smile, PaintWarning, stacklevel=4)


def with_numbers(line: xr.Dataset) -> xr.Dataset:
    """Return a flight line whose lines and columns are numbered by index coordinates, where they were not.

    A crop keeps them, and so its place; ``band`` has none, since two cameras would be joined by number.
    """
    places = {dim: np.arange(line.sizes[dim]) for dim in (ALONG_TRACK, CROSS_TRACK) if dim in line.dims}
    return line.assign_coords(
        {dim: (dim, place, VARIABLES[dim].attrs) for dim, place in places.items() if dim not in line.coords}
    )


def numbers_of(line: xr.Dataset, dim: str) -> Floats:
    """Return the numbers of a flight line's lines or columns: its index coordinate, else 0, 1, 2 ...

    A crop keeps those of the whole line, and so regions of the whole line outline the same things on it.
    """
    if dim in line.coords and line[dim].dims == (dim,) and line[dim].dtype.kind in "iuf":
        return np.asarray(line[dim].values, np.float64)
    return np.arange(line.sizes[dim], dtype=np.float64)


def _with_table_units(dataset: xr.Dataset) -> xr.Dataset:
    converted = {}
    for name in (str(name) for name in dataset.coords if name in VARIABLES):
        variable, wanted = dataset.variables[name], VARIABLES[name].units
        units = variable.attrs.get("units", wanted)
        if wanted != units and variable.ndim < 2 and same_dimension(str(units), wanted):
            converted[name] = convert(dataset[name], wanted).variable
    return dataset.assign_coords(converted) if converted else dataset


def quality_attrs() -> dict[str, Any]:
    """Return the CF attributes of ``quality``."""
    return {
        **VARIABLES["quality"].attrs,
        "flag_masks": np.array([int(flag) for flag in Quality], dtype=np.uint16),
        "flag_meanings": " ".join(flag_names()),
    }


def label(array: xr.DataArray, name: str, **extra: Any) -> xr.DataArray:
    """Return ``array`` under the name and attributes of the table, which replace those it had."""
    attrs = quality_attrs() if name == "quality" else VARIABLES[name].attrs
    labelled = array.rename(name).copy(deep=False)  # renamed alone, it would share its attributes
    labelled.attrs = {**attrs, **extra}
    return labelled


def require(
    dataset: xr.Dataset, names: Iterable[str], purpose: str, table: Mapping[str, Variable] = VARIABLES
) -> dict[str, xr.DataArray]:
    """Return the named variables, in the units and dim order of the table.

    Reads dims, dtypes and attributes only, never values.

    Parameters
    ----------
    dataset
        Holds the variables.
    names
        Rows of the table that are needed.
    purpose
        Opens the message: what cannot be computed without them.
    table
        `VARIABLES`, `SWEEP_VARIABLES` for a lab sweep, or `LIBRARY_VARIABLES` for a paint library.

    Raises
    ------
    SchemaError
        Variables are missing, or have other dims or units than the table allows; all are listed.
    """
    arrays, faults = find(dataset, names, table)
    problems = Problems(f"cannot compute {purpose}", SchemaError)
    for fault in faults:
        problems.add(fault)
    problems.raise_if_any()
    return arrays


def find(
    dataset: xr.Dataset, names: Iterable[str], table: Mapping[str, Variable] = VARIABLES
) -> tuple[dict[str, xr.DataArray], list[str]]:
    """Return what `require` returns of the variables that are as they should be, and the others' problems."""
    problems: list[str] = []
    arrays: dict[str, xr.DataArray] = {}
    advice: set[str] = set()
    for name in names:
        spec = table[name]
        if name not in dataset.variables:
            shape = ", ".join(spec.dims) or "a scalar"
            problems.append(
                f"{name!r} is missing: {spec.meaning.lower()} ({shape}) [{spec.units or spec.dtype}]"
            )
            continue
        array = plain(dataset[name])
        wrong = spec.dim_problem(array) or spec.unit_problem(array)
        if wrong:
            # one call mends all that went wrong in one way: it is named once
            fault, _, mend = wrong.partition(ADVICE)
            problems.append(fault if mend in advice else wrong)
            advice.add(mend)
            continue
        order = next(dims for dims in spec.allowed_dims if set(dims) == set(array.dims))
        array = array.transpose(*order)
        arrays[name] = convert(array, spec.units) if spec.units else array
    return arrays, problems


def dtype_of(name: str) -> np.dtype[Any]:
    """Return the numpy dtype of a variable of the table."""
    return np.dtype(VARIABLES[name].dtype)


_STAMP = "means_of"
_MOST_HASHED_BYTES = 2**24
_NOT_INPUTS = {"coarse_reflectance", "reflectance", "overview", "quality", ALONG_TRACK, CROSS_TRACK}


def stamp_means(means: xr.DataArray | xr.Variable, line: xr.Dataset) -> None:
    """Note in the encoding of stored means which arrays they are of."""
    means.encoding[_STAMP] = {str(name): _identity(line[name].variable) for name in line.variables}


def has_own_means(line: xr.Dataset) -> bool:
    """Tell whether ``coarse_reflectance`` is of the reflectance that is there, or of all it follows from."""
    stamp = line["coarse_reflectance"].encoding.get(_STAMP)
    if stamp is None:
        return False
    if "reflectance" in line.variables:
        names = {"reflectance"}
    else:
        names = (set(stamp) | {str(name) for name in line.variables}) - _NOT_INPUTS
    now = {name: _identity(line[name].variable) for name in names if name in line.variables}
    return all(now.get(name) is not None and now[name] == stamp.get(name) for name in names)


def _identity(variable: xr.Variable) -> str | None:
    """Return a name that follows the values, None where more than a scalar would have to be read."""
    from dask.base import is_dask_collection, tokenize

    if is_dask_collection(variable):
        return str(tokenize(variable.data.name, variable.dims, variable.shape))
    # xarray leaves a scalar of a store lazy without dask
    if variable.nbytes > _MOST_HASHED_BYTES or (variable.ndim and not variable._in_memory):
        return None
    return str(tokenize(variable.dims, variable.values))
