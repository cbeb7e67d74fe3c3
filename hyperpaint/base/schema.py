"""Checks of datasets against the one table of variables (`hyperpaint.base.variables`).

Functions take their inputs through `require` and label their outputs through `label`, which *replaces*
attributes, since xarray carries stale ones through arithmetic.
"""

from __future__ import annotations

import functools
from collections.abc import Hashable, Iterable, Mapping
from dataclasses import replace
from enum import IntFlag
from typing import Any, Literal

import numpy as np
import xarray as xr

from .arrays import Floats
from .errors import Problem, SchemaError, warn_user
from .units import convert, plain, same_dimension
from .variables import (
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
    "flags_set_from",
    "label",
    "numbers_of",
    "quality_attrs",
    "rename_to_roles",
    "require",
    "with_numbers",
]  # fmt: skip

#: Version of the layout on disk, repeated in every group as ``hyperpaint_format``: 3 has one manifest; 2 (of
#: 0.2) had a record in every array's folder and one in the root; 1 (of 0.1) had none in the root.
FORMAT_VERSION = 3

#: Lines in one storage chunk, and in one task on threads (see docs/explanation/design.md).
CHUNK_LINES = 32

TIME_UNITS = "nanoseconds since 1970-01-01"

#: Line shapes of a monochromator, named by the attribute ``monochromator_shape`` of a sweep.
MONOCHROMATOR_SHAPES = ("gaussian", "triangle")

#: Line shapes of a band, named by the dataset attribute ``srf_shape``.
SRF_SHAPES = ("gaussian", "slit", "tabulated")

#: Names of our dims in other packages, in lower case.
DIM_ALIASES: Mapping[str, tuple[str, ...]] = {
    ALONG_TRACK: ("line", "lines", "downtrack", "y", "frame"),
    BAND: ("bands", "wavelength", "wavelengths", "channel"),
    CROSS_TRACK: ("sample", "samples", "crosstrack", "x", "column"),
}


# Rooms that set flags: radiometry, light, surroundings, geometry.
_Source = Literal["counts", "light", "scene", "map"]


class Quality(IntFlag):
    """Bits of ``quality``; a bit set early is still set in every later product.

    A flag declares its ``source``, ``colour`` in pictures, ``condition``, and the fate of its ``samples``.

    Examples
    --------
    >>> import numpy as np
    >>> quality = np.uint16([0, 64, 65])
    >>> (quality & Quality.GLINT) != 0
    array([False,  True,  True])
    >>> Quality(65)
    <Quality.SATURATED|GLINT: 65>
    """

    source: _Source
    # The same in all pictures. Palettes for colour-blind readers have 8 colours (Okabe and Ito) or 10 (Tol),
    # flags are 13: these were searched so that any two differ by 15 or more in CIEDE2000, also as protanopes
    # and deuteranopes see them (Machado et al., IEEE Trans. Vis. Comput. Graph. 15, 1291, 2009).
    colour: str
    condition: str
    samples: str  # fate of the samples of a flagged pixel

    # Type checkers want the defaults in Quality(65).
    def __new__(
        cls,
        bit: int,
        source: _Source = "counts",
        colour: str = "",
        condition: str = "",
        samples: str = "kept",
    ) -> Quality:
        flag = int.__new__(cls, bit)
        flag._value_ = bit
        flag.source, flag.colour, flag.condition, flag.samples = source, colour, condition, samples
        return flag

    SATURATED = 1, "counts", "#ff3300", "a band within 16 counts of the converter's maximum", "the band NaN"
    BELOW_DARK = 2, "counts", "#330080", "counts below the dark, by 5 sigma of noise or in over 10 % of bands"
    BAD_DETECTOR = 4, "counts", "#808080", "over 5 % of the good bands have a bad element", "bad elements NaN"
    IRRADIANCE_GAP = 8, "light", "#80334d", "outside the record, or in a gap over `irradiance_max_gap`", "NaN"
    ILLUMINATION_UNSTABLE = 16, "light", "#e6ffb3", "irradiance changes by over 2 % between two samples"
    LOW_SUN = 32, "light", "#990000", "sun more than 75 degrees from the zenith"
    GLINT = 64, "scene", "#4de6cc", "the sun mirrored by the clear coat adds over 4 % to the other light"
    SHADOW = 128, "scene", "#0033ff", "over 20 % of direct sunlight blocked on the ground, 60 % on objects"
    ADJACENCY = 256, "scene", "#9980ff", "light of neighbours adds over 0.01 to the reflectance of a band"
    MIXED_EDGE = 512, "scene", "#66b380", "the pixel contains an edge between surfaces"
    OFF_SWATH = 1024, "map", "#99ccff", "no pixel covers this cell of a map", "NaN"
    NO_DATA = 2048, "counts", "#000000", "a dropped frame, or NaN counts", "NaN"
    TIMING_SENSITIVE = 4096, "light", "#e6cc00", "irradiance changes by over 1 % within the clock uncertainty"


def flag_names(bits: int = -1) -> list[str]:
    """Return the lower-case names of the flags that are set in ``bits``; by default of all flags.

    Examples
    --------
    >>> flag_names(Quality.GLINT | Quality.MIXED_EDGE)
    ['glint', 'mixed_edge']
    """
    return [str(flag.name).lower() for flag in Quality if flag & bits]


def flags_set_from(*sources: _Source) -> Quality:
    """Return the bits of all flags from some sources.

    Examples
    --------
    >>> flag_names(flags_set_from("scene"))
    ['glint', 'shadow', 'adjacency', 'mixed_edge']
    """
    return Quality(sum(flag for flag in Quality if flag.source in sources))


def flag_shares(quality: np.ndarray[Any, Any]) -> dict[Quality, float]:
    """Return the share of pixels with every flag that occurs.

    Examples
    --------
    >>> import numpy as np
    >>> flag_shares(np.array([[1, 0], [65, 0]], np.uint16))
    {<Quality.SATURATED: 1>: 0.5, <Quality.GLINT: 64>: 0.25}
    """
    counts = {flag: int(((quality & int(flag)) != 0).sum()) for flag in Quality}
    return {flag: count / quality.size for flag, count in counts.items() if count}


def flags_named(names: Iterable[str]) -> list[Quality]:
    # Return flags by their names, in any case.
    #
    # Raises `SchemaError`: There is no such flag; all unknown names are listed.
    by_name = dict(zip(flag_names(), Quality, strict=True))
    names = list(names)
    SchemaError.raise_if(
        unknown := [name for name in names if name.lower() not in by_name],
        f"no flag {', '.join(map(repr, unknown))}",
        expected=f"some of {', '.join(by_name)}",
        code="choice-unknown",
    )
    return [by_name[name.lower()] for name in names]


def rename_to_roles(dataset: xr.Dataset, dims: Mapping[str, Hashable] | None = None) -> xr.Dataset:
    # Return ``dataset`` with its dims named by role: ``along_track``, ``band``, ``cross_track``.
    #
    # Quantities become numbers (`hyperpaint.base.units.plain`), and coordinates along one dim are converted
    # to the units of the table. Side effects of `where` and `concat` are undone: dims that they added to
    # variables which do not vary along them, and flags that became floats.
    #
    # ``dataset``: Any dataset with a cube. ``dims``: Role to dim name, for names that `DIM_ALIASES` does not
    # know.
    #
    # Raises `SchemaError`: ``dims`` names a role or a dim that does not exist; a dim of the cube has size 0;
    # or arrays are of cubed or cupy.
    # arrays of other packages look like numpy's or dask's; none of the packages is imported here
    for array_name, variable in dataset.variables.items():
        data = variable._data
        for array in (data, getattr(data, "_meta", None)):  # a dask array of such arrays
            package = type(array).__module__.partition(".")[0]
            if package in _FOREIGN_ARRAYS:
                raise SchemaError(
                    f"{array_name!r} is an array of {package}",
                    expected="numpy or dask",
                    mend=_FOREIGN_ARRAYS[package],
                    code="array-foreign",
                )
    # maps in degrees, such as those of EMIT-tools
    for north, east in (("latitude", "longitude"), ("lat", "lon")):
        if {north, east} <= set(dataset.dims):
            dataset = dataset.rename({north: "y", east: "x"})
    # lines and times vary from cell to cell of a map
    is_map = {"y", "x"} <= {*dataset.dims, *dataset.coords} or "spatial_ref" in dataset.variables
    dataset = _with_table_units(plain(dataset))
    names: dict[Hashable, Hashable] = {}
    for role, name in (dims or {}).items():
        SchemaError.raise_if(
            role not in CUBE or name not in dataset.dims,
            f"dims={{{role!r}: {name!r}}}",
            expected=f"roles {list(CUBE)} and dims of the dataset {list(map(str, dataset.dims))}",
            code="dim-missing",
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
    if "wavelength" not in dataset.variables:  # the only axis of wavelengths of another name
        axes = [
            name
            for name, variable in dataset.variables.items()
            if variable.dims == (BAND,)
            and (
                str(name).lower() in _WAVELENGTH_NAMES
                or variable.attrs.get("standard_name") == "radiation_wavelength"
            )
        ]
        if len(axes) == 1:
            renamed = _with_table_units(dataset.rename({axes[0]: "wavelength"}).set_coords("wavelength"))
            dataset = renamed.drop_indexes("wavelength", errors="ignore")
    for dim, item in zip(CUBE, ("line", "band", "column"), strict=True):
        SchemaError.raise_if(
            dataset.sizes.get(dim) == 0,
            f"nothing is selected: {dim} has size 0",
            expected=f"one {item} or more",
            mend="widen the slice, mask or wavelength range",
            code="selection-empty",
        )
    return with_integer_dtypes(dataset) if is_map else _with_table_dims(dataset)


#: Names of wavelengths in cubes of other programs, in lower case.
_WAVELENGTH_NAMES = (
    "wavelengths",
    "wavelength",
    "wvl",
    "wl",
    "wave",
    "center_wavelength",
    "centre_wavelength",
)
_ELEMENT_VARIABLES = ("dark_counts", "radiance_gain")
_WHOLE_LINE_VARIABLES = ("overview", "coarse_reflectance")


def _with_table_dims(dataset: xr.Dataset) -> xr.Dataset:
    # `where` and `concat` change dims and integers. Lazy arrays stay lazy: that they are constant along a
    # removed dim is checked when they are computed.
    changed: dict[Hashable, xr.Variable] = {}
    dropped = []
    # after where() on counts, darks and gain have the dims of the cube: `require` refuses them and names isel
    is_masked = "counts" in dataset.variables and dataset.variables["counts"].dtype.kind == "f"
    for name, variable in dataset.variables.items():
        row = VARIABLES.get(str(name))
        if row is None or not set(variable.dims) & set(CUBE) or (is_masked and name in _ELEMENT_VARIABLES):
            continue
        if name not in _WHOLE_LINE_VARIABLES:
            reduced = _without_added_dims(variable, row)
            changed |= {} if reduced is variable else {name: reduced}
        elif not set(variable.dims) <= set(row.dims):
            dropped.append(name)  # it describes the whole line, not this selection
    if "quality" in dataset.variables and _is_averaged(dataset):
        dropped.append("quality")
        warn_user(
            "flags of 'quality' are means over pixels, and are left out; choose pixels by their flags "
            "before averaging",
            "flags-averaged",
        )
    dataset = dataset.drop_vars(dropped) if dropped else dataset
    return with_integer_dtypes(dataset.assign(changed) if changed else dataset)


def _is_averaged(dataset: xr.Dataset) -> bool:
    # coarsen and interp average flags over pixels.
    quality = dataset.variables["quality"]
    if quality.dtype.kind != "f":
        return False
    if any(dim in dataset.coords and dataset[dim].dtype.kind == "f" for dim in (ALONG_TRACK, CROSS_TRACK)):
        return True
    return quality.chunks is None and bool((np.nan_to_num(quality.values) % 1.0 != 0.0).any())


def _without_added_dims(variable: xr.Variable, row: Variable) -> xr.Variable:
    # Drop the dims of a cube along which a variable is constant; missing values are ignored.
    dims = set(variable.dims)
    fitting = [shape for shape in row.allowed_dims if set(shape) < dims and dims - set(shape) <= set(CUBE)]
    if not fitting or any(dims == set(shape) for shape in row.allowed_dims):
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
    # Return the minima, which must equal the maxima.
    SchemaError.raise_if(
        not ((low == high) | (low != low)).all(),
        f"{name_of!r} differs along {' and '.join(dims)}",
        mend="choose by .sel() or .isel() where where(..., drop=True) or xr.concat gave it that dim",
        code="dims-wrong",
    )
    return low


def with_integer_dtypes(dataset: xr.Dataset, table: Mapping[str, Variable] = VARIABLES) -> xr.Dataset:
    # Return flags, indices and classes as integers where `where` made them floats; lazy arrays stay lazy.
    #
    # Missing values become the ``gap`` of the table: `Quality.NO_DATA` in flags, -1 or 0 in indices. Counts
    # and index coordinates stay floats: both may be fractions.
    changed = {}
    for name, row in table.items():
        variable = dataset.variables.get(name)
        if (
            variable is None
            or variable.dtype.kind not in "fO"
            or row.dtype in ("str", "datetime64[ns]")
            or np.dtype(row.dtype).kind not in "iub"
            or name == "counts"
            or variable.dims == (name,)
        ):
            continue
        integers = functools.partial(_integers, gap=row.gap, dtype=row.dtype)
        changed[name] = (
            variable.copy(data=integers(variable.values))
            if variable.chunks is None
            else variable.copy(data=variable.data.map_blocks(integers, dtype=row.dtype))
        )
    return dataset.assign(changed) if changed else dataset


def _integers(values: Any, *, gap: int, dtype: str) -> Any:
    numbers = np.asarray(values, np.float64)
    return np.where(np.isfinite(numbers), np.rint(numbers), gap).astype(dtype)


_FOREIGN_ARRAYS = {
    "cubed": "map hyperpaint.slab over its blocks (docs/howto/engines.md), or open with dask or chunks=None",
    "cupy": "take it from the GPU first, by dataset.as_numpy() or array.get(): the kernels run on the CPU",
}


#: Attribute of ``radiance_gain``: names of the other variables of the calibration that change values.
CALIBRATION_NAMES = "calibration_variables"

_CALIBRATION_VARIABLES = (
    "wavelength_shift",
    "good",
    "masked",
    "linear_counts",
    "stray_light",
    "band_shift_time",
    "srf",
)


def with_calibration_names(line: xr.Dataset) -> xr.Dataset:
    # Return a flight line whose gain lists the other calibration variables, so that a loss is noticed.
    if "radiance_gain" not in line.variables:
        return line
    names = " ".join(name for name in _CALIBRATION_VARIABLES if name in line.variables)
    return line.assign(radiance_gain=line["radiance_gain"].assign_attrs({CALIBRATION_NAMES: names}))


def warn_of_lost_calibration(line: xr.Dataset, purpose: str) -> None:
    # Warn of calibration variables that the gain names and the line lacks, as after ``drop_vars``.
    gain = line.variables.get("radiance_gain")
    names = str(gain.attrs.get(CALIBRATION_NAMES, "")).split() if gain is not None else []
    missing_names = [name for name in names if name in _CALIBRATION_VARIABLES and name not in line.variables]
    if missing_names:
        smile = " (smile is not corrected)" if "wavelength_shift" in missing_names else ""
        warn_user(
            f"{purpose} is computed without {', '.join(map(repr, missing_names))}, which the calibration "
            f"of this line has; keep them beside 'radiance_gain'{smile}",
            "calibration-incomplete",
        )


def with_numbers(line: xr.Dataset) -> xr.Dataset:
    # Return a flight line with index coordinates that number its lines and columns.
    #
    # A crop keeps its numbers; ``band`` has no numbers, since xarray would align two cameras by them.
    numbers = {dim: np.arange(line.sizes[dim]) for dim in (ALONG_TRACK, CROSS_TRACK) if dim in line.dims}
    return line.assign_coords(
        {
            dim: (dim, values, VARIABLES[dim].attrs)
            for dim, values in numbers.items()
            if dim not in line.coords
        }
    )


def numbers_of(line: xr.Dataset, dim: str) -> Floats:
    # Return the numbers of a flight line's lines or columns: its index coordinate, else 0, 1, 2 ...
    #
    # A crop keeps the numbers of the whole line, so that regions of the whole line fit it.
    return (
        np.asarray(line[dim].values, np.float64)
        if dim in line.coords and line[dim].dims == (dim,) and line[dim].dtype.kind in "iuf"
        else np.arange(line.sizes[dim], dtype=np.float64)
    )


def _with_table_units(dataset: xr.Dataset) -> xr.Dataset:
    converted = {}
    for name in (str(name) for name in dataset.coords if name in VARIABLES):
        variable, table_units = dataset.variables[name], VARIABLES[name].units
        units = variable.attrs.get("units", table_units)
        if table_units != units and variable.ndim < 2 and same_dimension(str(units), table_units):
            converted[name] = convert(dataset[name], table_units).variable
    return dataset.assign_coords(converted) if converted else dataset


def quality_attrs() -> dict[str, Any]:
    return {
        **VARIABLES["quality"].attrs,
        "flag_masks": np.array([int(flag) for flag in Quality], dtype=np.uint16),
        "flag_meanings": " ".join(flag_names()),
    }


def label(array: xr.DataArray, name: str, **extra: Any) -> xr.DataArray:
    # Return ``array`` with the name and attributes of the table, which replace its old ones.
    attrs = quality_attrs() if name == "quality" else VARIABLES[name].attrs
    labelled = array.rename(name).copy(deep=False)  # rename alone would share the attributes
    labelled.attrs = {**attrs, **extra}
    return labelled


def require(
    dataset: xr.Dataset, names: Iterable[str], purpose: str, table: Mapping[str, Variable] = VARIABLES
) -> dict[str, xr.DataArray]:
    # Return the named variables, in the units and dim order of the table.
    #
    # Reads dims, dtypes and attributes only, never values.
    #
    # ``dataset``: Holds the variables. ``names``: Rows of the table that are needed. ``purpose``: Product
    # that cannot be computed without them; opens the message. ``table``: `VARIABLES`, `SWEEP_VARIABLES` for a
    # lab sweep, or `LIBRARY_VARIABLES` for a paint library.
    #
    # Raises `SchemaError`: Variables are missing, or have dims or units that the table does not allow; all
    # are listed.
    arrays, faults = find(dataset, names, table)
    if faults:
        raise SchemaError(f"cannot compute {purpose}", problems=faults)
    return arrays


def find(
    dataset: xr.Dataset, names: Iterable[str], table: Mapping[str, Variable] = VARIABLES
) -> tuple[dict[str, xr.DataArray], list[Problem]]:
    # Return the variables that the table accepts, as `require` does, and the faults of the rest.
    problems: list[Problem] = []
    arrays: dict[str, xr.DataArray] = {}
    for name in names:
        row = table[name]
        if name not in dataset.variables:
            shape = ", ".join(row.dims) or "a scalar"
            problems.append(
                Problem(
                    f"{name!r} is missing: {row.meaning.lower()} ({shape}) [{row.units or row.dtype}]",
                    code="variable-missing",
                )
            )
            continue
        array = plain(dataset[name])
        fault = row.dim_problem(array) or row.unit_problem(array)
        if not fault and name == "reflectance" and array.dtype.kind in "iu":
            fault = Problem(
                f"{name!r} is {array.dtype} without scale_factor",
                expected="reflectance as a fraction",
                mend="divide it by the stored value of a reflectance of one, such as 10000",
                code="scale-missing",
            )
        if fault:
            # one call mends all variables with the same fault: the message names it once
            is_repeated = any(fault.mend == other.mend for other in problems)
            problems.append(replace(fault, mend="") if is_repeated else fault)
            continue
        array = array.transpose(*next(dims for dims in row.allowed_dims if set(dims) == set(array.dims)))
        arrays[name] = convert(array, row.units) if row.units else array
    return arrays, problems


def dtype_of(name: str) -> np.dtype[Any]:
    return np.dtype(VARIABLES[name].dtype)


_MEANS_STAMP = "means_of"
MAX_HASHED_BYTES = 2**24
_NOT_INPUTS = {"coarse_reflectance", "reflectance", "overview", "quality", ALONG_TRACK, CROSS_TRACK}


def stamp_means(means: xr.DataArray | xr.Variable, line: xr.Dataset) -> None:
    # Store the identities of the arrays of the line in the encoding of means computed from them.
    means.encoding[_MEANS_STAMP] = {str(name): _identity(line[name].variable) for name in line.variables}


def has_own_means(line: xr.Dataset) -> bool:
    # Return whether ``coarse_reflectance`` follows from the arrays of this line.
    stamp = line["coarse_reflectance"].encoding.get(_MEANS_STAMP)
    if stamp is None:
        return False
    names = (
        {"reflectance"}
        if "reflectance" in line.variables
        else (set(stamp) | {str(name) for name in line.variables}) - _NOT_INPUTS
    )
    identities = {name: _identity(line[name].variable) for name in names if name in line.variables}
    return all(identities.get(name) is not None and identities[name] == stamp.get(name) for name in names)


def _identity(variable: xr.Variable) -> str | None:
    # Return None where a hash would have to read an array from a file.
    from dask.base import is_dask_collection, tokenize

    if is_dask_collection(variable):
        return str(tokenize(variable.data.name, variable.dims, variable.shape))
    # without dask, xarray opens a scalar of a store lazily
    if variable.nbytes > MAX_HASHED_BYTES or (variable.ndim and not variable._in_memory):
        return None
    return str(tokenize(variable.dims, variable.values))
