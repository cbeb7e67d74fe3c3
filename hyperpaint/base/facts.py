"""Facts declared once: name, unit, kind, range, default and meaning of a value; and conversion of units.

From the same declarations come the checks of settings and of TOML files with their messages, the comments of
templates, the Attributes section of docstrings and the tables of keys in the documentation.

Units are CF text in ``attrs``, and pint at the boundary. The registry is private. Its steradian, count and
electron are dimensions: a forgotten ``pi sr`` between radiance and irradiance is then an error, where pint's
own registry, like UDUNITS, lets it pass. No Quantity ever enters an array, a graph or a store:
`takes_quantities` and `plain` turn those of any registry into numbers with text beside them as they come in.
"""

import contextlib
import dataclasses
import datetime
import enum
import functools
import inspect
import os
import re
import textwrap
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeGuard, TypeVar, get_args

import numpy as np
import xarray as xr

from .errors import PaintError, Problems, SchemaError, UnitsError, needs_extra
from .old_names import with_new_names

if TYPE_CHECKING:
    import pint


_Public = TypeVar("_Public", bound=Callable[..., Any])

_DEFINITIONS = """
nano- = 1e-9 = n-
micro- = 1e-6 = u- = µ- = μ-
milli- = 1e-3 = m-
centi- = 1e-2 = c-
deci- = 1e-1 = d-
hecto- = 1e2 = h-
kilo- = 1e3 = k-
mega- = 1e6 = M-
giga- = 1e9 = G-
meter = [length] = m = metre
second = [time] = s = sec
gram = [mass] = g
kelvin = [temperature] = K
steradian = [solid_angle] = sr
count = [count] = _ = counts = digital_number = digital_numbers = DN = dn = adu = ADU = ct
electron = [electron_count] = _ = electrons
radian = [] = rad
degree = 0.017453292519943295 = deg = degrees = arcdegree
# latitude, longitude and heading of CF
@alias degree = degree_north = degrees_north = degreeN = degreesN = degree_N = degrees_N
@alias degree = degree_east = degrees_east = degreeE = degreesE = degree_E = degrees_E
@alias degree = degree_true = degrees_true
percent = 0.01
permille = 0.001
minute = 60 * second = min
hour = 60 * minute = h = hr
day = 24 * hour = d
hertz = 1 / second = Hz
newton = kilogram * meter / second ** 2 = N
joule = newton * meter = J
watt = joule / second = W
angstrom = 1e-10 * meter = Å
micron = 1e-6 * meter
foot = 0.3048 * meter = ft = feet
survey_foot = 1200 / 3937 * meter = ftUS = survey_feet = US_survey_foot
flick = 1e10 * watt / steradian / meter ** 3
"""

# m-2 -> m**-2, but neither 1e-3 nor nm_2 is touched
_CF_POWER = re.compile(r"(?<![0-9.A-Za-z_µμ])([A-Za-zµμ]+)\^?(-?[0-9]+)\b")
# the dot of UDUNITS between units, as in W.m-2; not that of 1.e-3
_DOT = re.compile(r"([A-Za-zµμ]-?[0-9]*)\.(?=[A-Za-zµμ])")
# ENVI writes words where CF writes symbols
_WORDS = {
    "nanometers": "nm",
    "nanometres": "nm",
    "nanometer": "nm",
    "micrometers": "um",
    "micrometres": "um",
    "micrometer": "um",
    "microns": "um",
    "millimeters": "mm",
    "centimeters": "cm",
    "meters": "m",
    "metres": "m",
    "watt": "W",
    "mwatt": "mW",
    "uwatt": "uW",
    # names of EPSG, Esri, PROJ and survey software
    **dict.fromkeys(("us survey foot", "us survey feet", "us_survey_foot", "foot_us"), "survey_foot"),
    **dict.fromkeys(("us foot", "us feet", "us-ft"), "survey_foot"),
    **dict.fromkeys(("international foot", "international feet", "foot", "feet", "ft"), "foot"),
    "%": "percent",
    "unitless": "1",
}
#: Factors of common units in headers; they save the import of pint, which takes 0.1 s.
USUAL_FACTORS = {("ms", "s"): 1e-3, ("us", "s"): 1e-6, ("um", "nm"): 1e3}
_CF_SPELLING = "CF spelling such as 'W m-2 sr-1 nm-1'"
# powers allowed for pint: a name or number, raised to a literal of one or two digits; no power of a power
_POWER = re.compile(r"(?:\*\*|\^)")
_SAFE_POWER = re.compile(r"(?<=[A-Za-z0-9µμ .])(?:\*\*|\^)\s*[-+]?[0-9]{1,2}(?![0-9.]|\s*\*\*|\s*\^)")
# superscript digits: pint would expand them to powers after the check above
_RAISED = re.compile("[⁺⁻]?[⁰¹²³⁴⁵⁶⁷⁸⁹]+")
_LOWERED = str.maketrans("⁺⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "+-0123456789")
# pint's parser skips unknown characters, such as a question mark
_READABLE = re.compile(r"[A-Za-z0-9µμ°ÅÅ%_*/^()+\-.\s]*")
_WORD = re.compile(
    "|".join(rf"(?<![A-Za-z_]){re.escape(word)}(?![A-Za-z_])" for word in _WORDS), re.IGNORECASE
)


def _plain_powers(text: str) -> str:
    # Superscript digits become powers, which are checked later, and dots become spaces.
    text = _DOT.sub(r"\1 ", text.replace("·", " "))
    return _RAISED.sub(lambda match: f"**{match[0].translate(_LOWERED)} ", text)


def _spell_for_pint(text: str) -> str:
    text = _WORD.sub(lambda match: _WORDS[match[0].lower()], text)
    return _CF_POWER.sub(r"\1**\2", _plain_powers(text))


@functools.cache
def registry(force_ndarray_like: bool = False) -> "pint.UnitRegistry[Any]":
    # Return hyperpaint's private unit registry.
    #
    # It reads CF spelling (``W m-2 sr-1 nm-1``), the words of ENVI headers (``Nanometers``) and units with a
    # scale (``1e-10 W cm-2 nm-1 sr-1``). It never becomes pint's application registry. Only pint-xarray needs
    # ``force_ndarray_like``, under which a float32 Quantity times a number becomes float64.
    import pint

    units: pint.UnitRegistry[Any] = pint.UnitRegistry(
        None, preprocessors=[_spell_for_pint], force_ndarray_like=force_ndarray_like
    )
    units.load_definitions(_DEFINITIONS.splitlines())
    return units


def _quantity(text: object) -> Any:
    if not isinstance(text, str):
        raise UnitsError(f"units {text!r:.60}", expected=_CF_SPELLING, code="type-wrong")
    # pint evaluates powers: 9**9**9 or s1000000000000 would never return
    text = _plain_powers(text[:201])
    is_huge = any(len(power.lstrip("-")) > 2 for _, power in _CF_POWER.findall(text))
    is_unsafe = len(_POWER.findall(text)) != len(_SAFE_POWER.findall(text))
    UnitsError.raise_if(
        len(text) > 200 or is_huge or is_unsafe or not _READABLE.fullmatch(text),
        f"units {text[:60]!r} cannot be read",
        expected=_CF_SPELLING,
        code="units-unreadable",
    )
    return _parse(text.strip() or "1")


@functools.lru_cache(maxsize=1024)
def _parse(text: str) -> Any:
    units = registry()
    # pint leaks TypeError, tokenize errors and its own classes
    with UnitsError.instead_of(
        Exception, f"units {text!r} cannot be read", expected=_CF_SPELLING, code="units-unreadable"
    ):
        quantity = units.Quantity(1.0, "") * units.parse_expression(text)
        if not 0.0 < quantity.to_base_units().magnitude < float("inf"):
            raise ValueError
        return quantity


def conversion_factor(found: str, wanted: str) -> float:
    """Return the number that turns a value in ``found`` into one in ``wanted``.

    Parameters
    ----------
    found, wanted
        Units in CF spelling; ``found`` may carry a scale.

    Raises
    ------
    UnitsError
        A unit cannot be read, or the two have different dimensions.

    Examples
    --------
    >>> conversion_factor("uW cm-2 sr-1 nm-1", "W m-2 sr-1 nm-1")
    0.01
    >>> conversion_factor("W m-2 sr-1 nm-1", "W m-2 nm-1")
    Traceback (most recent call last):
    hyperpaint.base.errors.UnitsError: units 'W m-2 sr-1 nm-1' are not convertible to 'W m-2 nm-1'; ...
    """
    if found == wanted:
        return 1.0
    if (found, wanted) in USUAL_FACTORS:
        return USUAL_FACTORS[found, wanted]
    source, target = _quantity(found), _quantity(wanted)
    UnitsError.raise_if(
        source.dimensionality != target.dimensionality,
        f"units {found!r} are not convertible to {wanted!r}",
        mend="check the quantity, and whether a solid angle (sr) or an exposure (s) is missing",
        code="units-not-convertible",
    )
    # twelve digits: the factor of a decimal unit is then the decimal number itself
    return float(f"{(source / target).to_base_units().magnitude:.12g}")


def same_dimension(found: str, wanted: str) -> bool:
    # Return whether two unit texts have the same dimension; False where one cannot be read.
    try:
        return bool(_quantity(found).dimensionality == _quantity(wanted).dimensionality)
    except UnitsError:
        return False


def is_unit(text: str) -> bool:
    # Return whether the brackets of a heading hold a unit, not a label such as ``8/h`` or ``N``.
    # a single letter is usually a symbol, and a unit does not begin with a number
    plain_text = text if len(text) > 1 else {"s": "s", "K": "K", "m": "m", "°": "degree"}.get(text, "")
    return bool(plain_text) and not plain_text[0].isdigit() and same_dimension(plain_text, plain_text)


def canonical(text: str) -> str:
    # Return ``text`` if it can be read as units, else raise UnitsError.
    _quantity(text)
    return text


def convert(array: xr.DataArray, wanted: str, name: str | None = None) -> xr.DataArray:
    """Return ``array`` in the units ``wanted``, lazily; floats keep their dtype, integers may become floats.

    Parameters
    ----------
    array
        Labelled values with a ``units`` attribute, or Quantities, whose own unit counts.
    wanted
        Units in CF spelling.
    name
        Name of the array in messages; by default its own.

    Raises
    ------
    UnitsError
        The ``units`` attribute is missing, unreadable, or of another dimension.

    Examples
    --------
    >>> import xarray as xr
    >>> width = xr.DataArray([0.006], dims="band", attrs={"units": "um"}, name="fwhm")
    >>> convert(width, "nm").values
    array([6.])
    """
    array = plain(array)
    name = name or str(array.name or "array")
    units = UnitsError.raise_if_none(
        array.attrs.get("units"),
        f"{name!r} has no units",
        mend=f"set {name}.attrs['units'], for example to {wanted!r}",
        code="units-missing",
    )
    try:
        factor = conversion_factor(str(units), wanted)
    except UnitsError as error:
        raise error.about(repr(name)) from error
    if factor != 1.0:
        # an integer factor of 0.001 would be 0
        kind = np.result_type(array.dtype, np.float16 if array.dtype.kind == "f" else np.float32)
        array = array.copy(data=array.data * kind.type(factor))
    return array.assign_attrs(units=wanted)


# --- Quantities of any registry ----------------------------------------------------------------------------


def _is_quantity(value: object) -> bool:
    # A Quantity of pint, astropy or unyt.
    if isinstance(value, xr.DataArray):  # its attributes can have these names
        return False
    is_pint = hasattr(value, "magnitude") and hasattr(value, "units")
    return is_pint or (hasattr(value, "to_value") and (hasattr(value, "unit") or hasattr(value, "units")))


def _magnitude(quantity: Any) -> Any:
    number = quantity.magnitude if hasattr(quantity, "magnitude") else quantity.value
    return number.item() if isinstance(number, np.ndarray) and number.ndim == 0 else number


def _unit_text(quantity: Any) -> str:
    # Symbols differ between registries, so parts are read by their full names; a part that our registry does
    # not define is resolved by the registry of the Quantity.
    if not hasattr(quantity, "unit_items"):  # astropy and unyt
        return str(getattr(quantity, "unit", None) or quantity.units)
    scale, powers = 1.0, []
    for name, power in quantity.unit_items():
        parts = [(name, 1)]
        if not same_dimension(name, name):
            scale_unit, offset_unit = (type(quantity)(number, name).to_root_units() for number in (1.0, 0.0))
            UnitsError.raise_if(
                offset_unit.magnitude,
                f"units {name!r} have an offset zero",
                expected="multiples of a unit",
                code="units-offset",
            )
            scale *= scale_unit.magnitude**power
            parts = list(scale_unit.unit_items())
        for part, exponent in parts:
            symbol = part
            with contextlib.suppress(Exception):  # pint's own class; the parser then refuses the text
                symbol = str(registry().get_symbol(part))
            powers.append((symbol, exponent * power))
    text = " ".join(symbol if power == 1 else f"{symbol}{power:g}" for symbol, power in powers)
    return f"{scale:.15g} {text}".strip() if scale != 1.0 else text or "1"


def plain(labelled: Any) -> Any:
    """Return a Dataset, DataArray or DataTree whose Quantities are numbers with ``units`` attributes.

    The unit of a Quantity replaces the attribute, and the attributes ``scale_factor`` and ``add_offset`` are
    applied. Objects without a Quantity are returned unchanged; nothing
    is computed. Variables of paint libraries of hyperpaint 0.2 are renamed (`with_new_names`).

    Raises
    ------
    UnitsError
        A unit cannot be written in CF spelling, or Quantities are inside the blocks of a dask array.

    Examples
    --------
    >>> import pint, xarray as xr
    >>> width = xr.DataArray(pint.Quantity([6.0, 7.0], "nm"), dims="band", attrs={"units": "um"})
    >>> plain(width).attrs, plain(width).values
    ({'units': 'nm'}, array([6., 7.]))
    """
    if isinstance(labelled, xr.DataTree):
        datasets = {path: node.to_dataset(inherit=False) for path, node in labelled.subtree_with_keys}
        numbers = {path: plain(dataset) for path, dataset in datasets.items()}
        changed = any(numbers[path] is not dataset for path, dataset in datasets.items())
        return xr.DataTree.from_dict(numbers, name=labelled.name) if changed else labelled
    labelled = with_new_names(labelled)
    # the public `data` would read a lazily opened variable
    variables = labelled.variables if isinstance(labelled, xr.Dataset) else labelled.coords.variables
    arrays = {name: variable._data for name, variable in variables.items()}
    array_values = labelled.variable._data if isinstance(labelled, xr.DataArray) else None
    for name, data in [*arrays.items(), (getattr(labelled, "name", None), array_values)]:
        UnitsError.raise_if(
            _is_quantity(getattr(data, "_meta", None)),
            f"{name!r} is a dask array of Quantities",
            mend=f"make it a Quantity of a dask array, such as pint.Quantity({name}.data, unit)",
            code="array-foreign",
        )
    if _is_quantity(array_values):
        labelled = labelled.copy(data=_magnitude(array_values)).assign_attrs(units=_unit_text(array_values))
    labelled = _unpacked(labelled)
    coords = {name: data for name, data in arrays.items() if _is_quantity(data)}
    if not coords:
        return labelled
    values = {
        name: (variables[name].dims, _magnitude(data), {**variables[name].attrs, "units": _unit_text(data)})
        for name, data in coords.items()
    }
    return labelled.assign(values) if isinstance(labelled, xr.Dataset) else labelled.assign_coords(values)


_PACKING = ("scale_factor", "add_offset")


def _unpacked(labelled: Any) -> Any:
    # Apply, lazily, what a reader without mask_and_scale left in the attributes of a dataset or array
    is_dataset = isinstance(labelled, xr.Dataset)
    variables = labelled.variables if is_dataset else {labelled.name: labelled.variable}
    values = {}
    for name, variable in variables.items():
        # a mark of missing values alone: integers keep their type, as counts and flags have to
        is_marked = variable.dtype.kind == "f" and (
            "_FillValue" in variable.attrs or "nodata" in variable.attrs
        )
        if not is_marked and not any(key in variable.attrs for key in _PACKING):
            continue
        attrs = dict(variable.attrs)
        for key in _PACKING:
            number = attrs.get(key, 1.0)
            is_number = isinstance(number, (int, float, np.number)) and np.isfinite(number)
            UnitsError.raise_if(
                not is_number or (key == "scale_factor" and number == 0),
                f"{name!r} has the attribute {key} {number!r:.40}",
                expected="a finite number, no scale of 0",
                mend="open the file with mask_and_scale=True",
                code="scale-wrong",
            )
        if "nodata" in attrs:
            attrs.setdefault("_FillValue", attrs.pop("nodata"))
        packed = xr.Variable(variable.dims, variable._data, attrs, fastpath=True)
        values[name] = xr.conventions.decode_cf_variable(str(name), packed, decode_times=False)
        values[name].encoding = variable.encoding
    if not values:
        return labelled
    return labelled.assign(values) if is_dataset else labelled._replace(variable=values[labelled.name])


def in_units(value: Any, wanted: str, name: str) -> Any:
    """Return an argument as plain numbers in the units ``wanted``.

    Parameters
    ----------
    value
        Plain numbers, which are in these units already and are returned unchanged; a Quantity of any
        registry; a DataArray, which needs units unless ``wanted`` is 1; a timedelta; or a sequence of these.
    wanted
        Units in CF spelling.
    name
        Name of the argument in messages.

    Raises
    ------
    UnitsError
        The unit is missing, unreadable, or of another dimension.

    Examples
    --------
    >>> import pint
    >>> in_units(pint.Quantity(525, "ft"), "m", "ground"), in_units(160.02, "m", "ground")
    (160.02, 160.02)
    """
    if isinstance(value, xr.DataArray):
        value = plain(value)
        return value if wanted == "1" and "units" not in value.attrs else convert(value, wanted, name)
    if isinstance(value, list | tuple):  # nested to any depth; the decorated function refuses text
        numbers = [item if isinstance(item, str) else in_units(item, wanted, name) for item in value]
        changed = any(number is not item for number, item in zip(numbers, value, strict=True))
        return type(value)(numbers) if changed else value
    if isinstance(value, str) or (hasattr(value, "dimensionality") and not _is_quantity(value)):
        raise UnitsError(
            f"{name}={str(value)!r}", expected=f"a number [{wanted}] or a Quantity", code="type-wrong"
        )
    is_duration = getattr(getattr(value, "dtype", None), "kind", "") == "m"
    if not (is_duration or isinstance(value, datetime.timedelta | xr.DataArray) or _is_quantity(value)):
        return value
    try:
        number, factor = (
            (_magnitude(value), conversion_factor(_unit_text(value), wanted))
            if _is_quantity(value)
            else (value / np.timedelta64(1, "s"), conversion_factor("s", wanted))
        )
    except UnitsError as error:
        raise error.about(name) from error
    return number if factor == 1.0 else number * factor


def takes_quantities(**units: str) -> Callable[[_Public], _Public]:
    """Return a decorator that converts pint quantities in the arguments of a function or dataclass.

    Quantities in datasets become numbers with a ``units`` attribute (`plain`), arguments numbers in ``units``
    (`in_units`); an argument without an entry in ``units`` is a pure number.

    Examples
    --------
    >>> import pint
    >>> @takes_quantities(ground="m")
    ... def height(ground: float, share: float = 0.0) -> tuple[float, float]:
    ...     return ground, share
    >>> height(pint.Quantity(2.0, "km"), share=pint.Quantity(50.0, "percent"))
    (2000.0, 0.5)
    >>> height(pint.Quantity(2.0, "s"))
    Traceback (most recent call last):
    hyperpaint.base.errors.UnitsError: ground: units 's' are not convertible to 'm'; ...
    """

    def decorated(target: Any) -> Any:
        function = vars(target)["__init__"] if isinstance(target, type) else target
        parameters = inspect.signature(function, eval_str=True).parameters
        names = list(parameters)
        kinds = {
            name: {*(get_args(parameter.annotation) or [parameter.annotation])} - {type(None)}
            for name, parameter in parameters.items()
        }

        def number(value: Any, name: str) -> Any:
            # integers of few bits overflow, and a check for int or float would refuse numbers of numpy
            if isinstance(value, np.generic | np.ndarray) and value.dtype != np.float64:
                value = value.item() if value.ndim == 0 and value.dtype.kind in "biuf" else value
            if isinstance(target, type):  # a class lists all faults of its fields, text among them
                return value if isinstance(value, str) else _number(value, units, name)
            return _of_kind(_number(value, units, name), kinds.get(name, set()), name)

        @functools.wraps(function)
        def with_numbers(*arguments: Any, **options: Any) -> Any:
            numbers = [number(value, name) for name, value in zip(names, arguments, strict=False)]
            numbers += arguments[len(names) :]  # the function refuses surplus arguments
            return function(*numbers, **{name: number(value, name) for name, value in options.items()})

        if not isinstance(target, type):
            return with_numbers
        setattr(target, "__init__", with_numbers)  # noqa: B010 (mypy takes a plain assignment for unsound)
        return target

    return decorated


def _number(value: Any, units: Mapping[str, str], name: str) -> Any:
    if name in units:
        number = in_units(value, units[name], name)
        return number.item() if isinstance(number, xr.DataArray) and number.ndim == 0 else number
    if isinstance(value, xr.Dataset | xr.DataArray | xr.DataTree):
        return plain(value)
    if isinstance(value, Mapping):
        numbers = {key: _number(item, units, str(key)) for key, item in value.items()}
        return numbers if any(numbers[key] is not item for key, item in value.items()) else value
    if isinstance(value, list | tuple):
        members = [_number(item, units, name) for item in value]
        return type(value)(members) if any(a is not b for a, b in zip(members, value, strict=True)) else value
    return in_units(value, "1", name) if _is_quantity(value) else value


#: What a parameter accepts, by a class of its annotation.
_ACCEPTED = {
    xr.Dataset: "a Dataset, such as xarray.open_zarr or hyperpaint.open_library returns",
    int: "a whole number",
    float: "a number",
    slice: "a slice, such as slice(10, 90)",
}
_STRICT = ({int}, {slice}, {xr.Dataset, xr.DataTree})


def _of_kind(value: Any, kinds: set[Any], name: str) -> Any:
    # Return an argument, 4.0 as 4 where the annotation is int; SchemaError for text where the annotation has
    # none, nor flags of an Enum, and for another object than a whole number, slice or Dataset.
    accepted = next((text for kind, text in _ACCEPTED.items() if kind in kinds), "")
    if kinds == {int} and isinstance(value, float) and value.is_integer():
        return int(value)
    has_words = any(kind is str or isinstance(kind, enum.EnumMeta) for kind in kinds)
    is_text = isinstance(value, str | os.PathLike) and not has_words
    is_other = value is not None and any(kinds <= strict for strict in _STRICT)
    SchemaError.raise_if(
        accepted and (is_text or (is_other and not isinstance(value, tuple(kinds)))),
        f"{name}={' '.join(shown(value).split())}",
        expected=accepted,
        code="type-wrong",
    )
    return value


# --- a view in Quantities ----------------------------------------------------------------------------------


def quantify(dataset: xr.Dataset, units: "pint.UnitRegistry[Any] | None" = None) -> xr.Dataset:
    # Return ``dataset`` with its data variables as pint Quantities of a registry, hyperpaint's by default.
    #
    # Raises `MissingExtraError`: pint-xarray is not installed. Raises `UnitsError`: Units cannot be read,
    # carry a scale, which the unit of a Quantity cannot, or are unknown to the registry; all are listed.
    with needs_extra("pint-xarray", "units", "a Quantity view"):
        import pint_xarray  # noqa: F401

    units = units or registry(force_ndarray_like=True)
    UnitsError.raise_if(
        not (units.force_ndarray_like or units.force_ndarray),
        "the registry turns 0-d arrays into plain numbers",
        mend="make it by pint.UnitRegistry(force_ndarray_like=True)",
        code="registry-scalars",
    )
    with Problems("a Quantity view cannot be made", UnitsError) as problems:
        unit_of = {}
        dataset = plain(dataset)
        for name, array in dataset.data_vars.items():
            if "units" not in array.attrs or array.dtype.kind not in "fiu":
                continue
            text = array.attrs["units"]
            try:
                full_names = f"{registry().Unit(_spell_for_pint(canonical(text))):C}"
            except Exception:  # pint leaks its own classes
                problems.add(
                    f"{str(name)!r} has units {text!r}",
                    expected="CF spelling without a scale",
                    code="units-unreadable",
                )
                continue
            try:
                unit_of[name] = units.Unit(full_names)
            except Exception as error:
                problems.add(
                    f"{str(name)!r} has units {text!r}; {error!s:.100}",
                    mend="define it, as by registry.define('electron = [electron_count]'), or drop the "
                    "variable",
                    code="units-unknown",
                )
    # coordinates stay plain: xarray cannot select by an index of Quantities
    variables = dataset[list(unit_of)].drop_vars(dataset.coords, errors="ignore")
    return dataset.assign(variables.pint.quantify(unit_of, unit_registry=units).data_vars)


#: Smallest magnitude that counts as infinite.
MAX_NUMBER = 1e300

#: Maximum length of a value in a message.
MAX_SHOWN_CHARS = 60

_Class = TypeVar("_Class", bound=type)
_Function = TypeVar("_Function", bound=Callable[..., Any])


# --- checks of single values -------------------------------------------------------------------------------


def is_number(value: object) -> TypeGuard[float]:
    """Return whether a value is a finite number, or an array of one without dims; bool and NaN are not.

    Examples
    --------
    >>> is_number(3), is_number(True), is_number("3"), is_number(float("nan")), is_number(10**400)
    (True, False, False, False, False)
    """
    if isinstance(value, np.ndarray | xr.DataArray) and value.ndim == 0:
        value = value.item()
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        return False
    try:
        return abs(float(value)) < MAX_NUMBER
    except OverflowError:  # a whole number that no float can hold
        return False


def is_text(value: object) -> TypeGuard[str]:
    # Return whether a value is text with at least one visible character.
    return isinstance(value, str) and bool(value.strip())


def one_of(
    value: object,
    allowed: Collection[str],
    name: str,
    *,
    problems: Problems | None = None,
    error: type[PaintError] = SchemaError,
) -> bool:
    """Return whether a value is one of the allowed words; otherwise note it in ``problems``, or raise.

    Parameters
    ----------
    value
        The word.
    allowed
        All words that are accepted.
    name
        The argument or key, as the user spells it.
    problems
        List that receives the fault; None raises it.
    error
        Class of the error raised.

    Examples
    --------
    >>> one_of("cubic", ("linear", "cubic"), "method")
    True
    >>> one_of("cube", ("linear", "cubic"), "method")
    Traceback (most recent call last):
    hyperpaint.base.errors.SchemaError: method='cube', expected one of linear, cubic [choice-unknown]
    """
    if isinstance(value, str) and value in allowed:
        return True
    found, expected = f"{name}={shown(value)}", f"one of {', '.join(allowed)}"
    if problems is None:
        raise error(found, expected=expected, code="choice-unknown")
    problems.add(found, expected=expected, code="choice-unknown")
    return False


def shown(value: object) -> str:
    try:
        text = str(value) if isinstance(value, datetime.date | datetime.time) else repr(value)
    except ValueError:  # Python prints no integer of over 4300 digits; a hexadecimal number can have more
        text = "a number of thousands of digits"
    return text if len(text) <= MAX_SHOWN_CHARS else f"{text[: MAX_SHOWN_CHARS - 3]}..."


# --- declarations ------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Fact:
    """Declaration of one value: an argument in Python, and a key of a TOML file.

    Attributes
    ----------
    doc
        Meaning, as one clause without unit and full stop.
    kind
        "number", "whole" (a whole number), "numbers" (a list), "flag", "choice", "text", "texts" (a text or a
        list of them), "words" (a list of texts, also empty), "time", "table" or "own" (see ``accepts``).
    unit
        CF spelling; empty for pure numbers and words.
    default
        Value of an absent key or argument; None for no default.
    least, most
        Range of numbers, both included; None is open.
    above, below
        Whether ``least`` and ``most`` themselves are excluded.
    choices
        Accepted words.
    length
        Length of "numbers"; 0 accepts any from 1 on.
    single
        Whether "numbers" also accepts a single number.
    optional
        Whether None is accepted.
    needed
        Whether the key must be present.
    name, key
        Spelling in Python, and in a TOML file where it differs (with the unit as suffix).
    scale
        Factor from the number in the file to the argument; None takes numbers unchanged.
    accepts, phrase
        Check of an "own" value, and the accepted values in words; ``phrase`` replaces the text made from
        range and choices for other kinds as well.
    example
        Value that the mend shows where there is no default.

    Examples
    --------
    >>> share = Fact(doc="share of taken bays", kind="number", least=0.0, most=1.0, default=0.85)
    >>> share.fault(0.5), share.fault(2.0), share.fault("much"), share.expected
    (None, 'value-out-of-range', 'type-wrong', 'a number from 0 to 1')
    """

    doc: str
    kind: str = "text"
    unit: str = ""
    default: Any = None
    least: float | None = None
    most: float | None = None
    above: bool = False
    below: bool = False
    choices: tuple[str, ...] = ()
    length: int = 0
    single: bool = False
    optional: bool = False
    needed: bool = False
    name: str = ""
    key: str = ""
    scale: float | None = None
    accepts: Callable[[Any], bool] | None = None
    phrase: str = ""
    example: Any = None

    @property
    def expected(self) -> str:
        if self.phrase:
            return self.phrase
        phrases = {
            "number": f"a number{self._range()}",
            "whole": f"a whole number{self._range()}",
            "numbers": f"{self.length} numbers{self._range()}",
            "flag": "true or false",
            "choice": f"one of {', '.join(self.choices)}",
            "text": "a text",
            "texts": "a text or a list of texts",
            "words": f"a list of some of {', '.join(self.choices)}" if self.choices else "a list of texts",
            "time": "a date or time",
            "table": "a table of texts",
        }
        return (
            f"{phrases['number']}, or a list of {self.length or 'such'} numbers"
            if self.single
            else phrases[self.kind]
        )

    def _range(self) -> str:
        low, high = (f"{end:g}" if isinstance(end, float) else str(end) for end in (self.least, self.most))
        lower = "" if self.least is None else f" {'above' if self.above else 'from'} {low}"
        if self.most is None:
            return lower
        upper = "and below" if self.above and self.below else "and at most" if self.above else "to"
        return f"{lower} {upper} {'below ' if self.below and not self.above else ''}{high}"

    def fault(self, value: Any) -> str | None:
        # Return the code of the fault of a value, or None for an accepted one.
        if value is None and self.optional:
            return None
        if isinstance(value, np.ndarray) and self.kind == "numbers":
            value = value.tolist()
        if self.kind == "number" or (self.single and not isinstance(value, list | tuple)):
            return self._number_fault(value)
        if self.kind == "whole":
            is_whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
            return "type-wrong" if not is_whole else None if self._inside(value) else "value-out-of-range"
        if self.kind == "numbers":
            if not isinstance(value, list | tuple):
                return "type-wrong"
            if len(value) != self.length if self.length else not value:
                return "length-mismatch"
            return next(filter(None, map(self._number_fault, value)), None)
        if self.kind == "choice":
            return None if value in self.choices else "choice-unknown"
        if self.kind == "words" and self.choices and isinstance(value, list | tuple):
            return None if all(word in self.choices for word in value) else "choice-unknown"
        tests: Mapping[str, Callable[[Any], bool]] = {
            "flag": lambda value: isinstance(value, bool),
            "text": is_text,
            "texts": lambda value: all(map(is_text, value if isinstance(value, list) and value else [value])),
            "words": lambda value: isinstance(value, list | tuple) and all(map(is_text, value)),
            "time": lambda value: isinstance(value, str | datetime.date),
            "table": lambda value: isinstance(value, dict),
        }
        return None if (self.accepts or tests[self.kind])(value) else "type-wrong"

    def _number_fault(self, value: Any) -> str | None:
        if is_number(value):
            return None if self._inside(value) else "value-out-of-range"
        is_infinite = isinstance(value, int | float | np.number) and not isinstance(value, bool)
        return "not-finite" if is_infinite else "type-wrong"

    def _inside(self, value: Any) -> bool:
        is_low = self.least is not None and (value < self.least or (self.above and value == self.least))
        is_high = self.most is not None and (value > self.most or (self.below and value == self.most))
        return not is_low and not is_high

    @property
    def mend(self) -> str:
        # Remedy for a wrong value in a file.
        if self.default is not None:
            return f"leave the key out for {toml_text(self.default)}"
        if self.example is not None:
            return f"for example {self.key or self.name} = {toml_text(self.example)}"
        return "correct it" if self.needed else "correct it, or leave the key out"

    def note(self, problems: Problems, found: str, value: Any, mend: str = "") -> bool:
        # Return whether a value is accepted; otherwise note it, with ``found`` as the user wrote it.
        code = self.fault(value)
        if code is not None:
            problems.add(found, expected=self.expected, mend=mend, code=code)
        return code is None

    def in_file(self) -> "Fact":
        # Return the declaration of the key: range and default in the unit of the file.
        if self.scale is None or self.scale == 1.0:
            return self
        ends: dict[str, Any] = {
            name: float(f"{end / self.scale:.12g}")
            for name in ("least", "most", "default")
            if (end := getattr(self, name)) is not None
        }
        return dataclasses.replace(self, **ends)

    def argument(self, value: Any) -> Any:
        # Return the argument in Python for a checked value of the file; None stays.
        if value is None:
            return None
        if isinstance(value, list) and self.kind == "numbers":
            return tuple(map(float, value))
        if self.kind == "numbers":
            return float(value)
        if self.kind == "time":  # TOML's own times as text that numpy reads
            return str(value).replace(" ", "T")
        if self.scale == 1.0:
            return float(value)
        return value if self.scale is None else float(f"{value * self.scale:.12g}")


#: Declarations by name, or by key of a TOML table.
Facts = Mapping[str, Fact]


def toml_text(value: Any) -> str:
    # Return a value as a TOML file spells it.
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        escaped = value.replace("\\", "\\\\").replace('"', '\\"')
        return f'"{escaped}"'
    return f"[{', '.join(map(toml_text, value))}]" if isinstance(value, list | tuple) else f"{value!r}"


def fact(default: Any, doc: str, kind: str = "", **options: Any) -> Any:
    """Return a dataclass field with its declaration; the kind follows from the default unless given.

    A field with `dataclasses.MISSING` as its default must be given.

    Examples
    --------
    >>> @dataclass
    ... class Light:
    ...     zenith: float = fact(25.0, "zenith angle of the sun", unit="degree", least=0.0, most=89.0)
    >>> problems = Problems("the light cannot be used", SchemaError)
    >>> check_fields(Light(-1.0), problems)
    >>> print(*problems)
    zenith=-1.0, expected a number from 0 to 89 [value-out-of-range]
    """
    if not kind:
        kinds = {bool: "flag", int: "whole", float: "number", tuple: "numbers"}
        kind = "choice" if options.get("choices") else kinds.get(type(default), "text")
    known = None if default is dataclasses.MISSING else default
    return dataclasses.field(
        default=default,
        metadata={"fact": Fact(doc=doc, kind=kind, default=known, optional=default is None, **options)},
    )


def facts_of(owner: Any) -> dict[str, Fact]:
    return {
        field.name: dataclasses.replace(field.metadata["fact"], name=field.name)
        for field in dataclasses.fields(owner)
        if "fact" in field.metadata
    }


def by_key(facts: Iterable[Fact]) -> dict[str, Fact]:
    # Return declarations by the keys of a TOML table, in the units of the file.
    return {declaration.key or declaration.name: declaration.in_file() for declaration in facts}


def argument_facts(function: Callable[..., Any], facts: Iterable[Fact]) -> dict[str, Fact]:
    # Return declarations by argument, with the defaults of a function; they complete its docstring.
    parameters = inspect.signature(function).parameters
    complete = {}
    for entry in facts:
        default = parameters[entry.name].default
        complete[entry.name] = dataclasses.replace(entry, default=default, optional=default is None)
    documented(**{name: described(entry) for name, entry in complete.items()})(function)
    return complete


def filled(facts: Facts, values: Mapping[str, Any]) -> dict[str, Any]:
    # Return the value of every key: that of a file, or the default.
    return {key: values.get(key, declared.default) for key, declared in facts.items()}


def arguments_of(facts: Facts, values: Mapping[str, Any]) -> dict[str, Any]:
    # Return the arguments in Python for checked values of a file by key.
    return {facts[key].name: facts[key].argument(value) for key, value in values.items()}


#: Returns a name and its value as the user wrote them.
Spelling = Callable[[str, Any], str]


def as_argument(name: str, value: Any) -> str:
    # Return an argument as Python spells it.
    return f"{name}={shown(value)}"


def check_values(
    facts: Facts, values: Mapping[str, Any], problems: Problems, spelled: Spelling = as_argument
) -> None:
    # Note every value that the declaration of its name does not accept.
    for name, value in values.items():
        facts[name].note(problems, spelled(name, value), value)


def check_fields(settings: Any, problems: Problems, spelled: Spelling = as_argument) -> None:
    # Note every field of a dataclass whose value its declaration does not accept.
    facts = facts_of(settings)
    check_values(facts, {name: getattr(settings, name) for name in facts}, problems, spelled)


# --- docstrings and tables ---------------------------------------------------------------------------------


def declared(cls: _Class) -> _Class:
    # Complete a dataclass from its facts: docstring section Attributes, and pint quantities as arguments.
    #
    # Fields without a fact are described in the class's own section Attributes, which is continued.
    facts = facts_of(cls)
    entries = "".join(f"{name}\n    {described(fact)}\n" for name, fact in facts.items())
    doc = inspect.cleandoc(cls.__doc__ or "")
    section = re.search(r"^Attributes\n-+\n(?:.+\n)*", doc, re.MULTILINE)
    following = re.search(r"^(?:Raises|Notes|References|Examples)\n-+$", doc, re.MULTILINE)
    end = section.end() if section else following.start() if following else len(doc)
    heading = "" if section else "Attributes\n----------\n"
    before, after = doc[:end].rstrip("\n"), doc[end:].lstrip("\n")
    cls.__doc__ = f"{before}{'' if section else chr(10)}\n{heading}{entries}\n{after}"
    return takes_quantities(**{name: fact.unit for name, fact in facts.items() if fact.unit})(cls)


def described(declaration: Fact) -> str:
    # Return the meaning, unit and accepted values of a declaration as one line.
    unit = f" [{declaration.unit}]" if declaration.unit else ""
    accepted = (
        "" if declaration.kind in ("flag", "text") and not declaration.phrase else f"; {declaration.expected}"
    )
    optional = ", or None" if declaration.optional and accepted else ""
    return f"{declaration.doc[:1].upper()}{declaration.doc[1:]}{unit}{accepted}{optional}."


def key_line(facts: Facts, key: str, value: Any = None, note: str = "") -> str:
    """Return the line of a TOML file for a key, with its meaning, or ``note``, as the comment.

    Without a value it is an optional key: commented out, with its default or an example.

    Examples
    --------
    >>> facts = {"gap_s": Fact(doc="longest gap", kind="number", unit="s", default=2.0)}
    >>> key_line(facts, "gap_s", 3.0), key_line(facts, "gap_s")
    ('gap_s = 3.0  # longest gap [s]', '# gap_s = 2.0  # longest gap [s]')
    """
    declaration = facts[key]
    unit = f" [{declaration.unit}]" if declaration.unit else ""
    choices = f"; one of {', '.join(declaration.choices)}" if declaration.choices else ""
    hint = declaration.example if declaration.default is None else declaration.default
    text = toml_text(hint if value is None else value)
    return f"{'# ' if value is None else ''}{key} = {text}  # {note or f'{declaration.doc}{unit}{choices}'}"


#: Descriptions of the parameters that many functions share, by parameter or by a name of the meaning.
PARAMETERS = {
    "axes": "matplotlib axes to draw on, whose figure is returned; a new figure by default.",
    "clock_offset_s": "Added to ``time`` to have the time of the navigation's clock [s].",
    "codec": (
        '``"compact"`` shuffles bits before lz4; ``"fast"`` shuffles bytes, which takes half the processor '
        "time for a seventh (counts) to two fifths (rounded reflectance) more space. Values and content are "
        "equal: a complete group is not rewritten for another codec."
    ),
    "columns": "Number of paints side by side.",
    "crs": 'Map whose north ``"grid"`` headings count from, where the convention names none.',
    "dataset": (
        "A flight line with ``reflectance``, or with the variables that `hyperpaint.reflectance` needs."
    ),
    "diffuse, sun_zenith": "Direct/diffuse split, see `hyperpaint.surroundings.survey`.",
    "effects": (
        "Fields of `hyperpaint.simulation.SweepSettings`: ``monochromator_fwhm_nm``, ``stray_light`` ...; "
        "and, of the camera, those of `hyperpaint.simulation.SimulationSettings`: ``smile_nm``, "
        "``srf_shape``, ``noise`` ... ``quantise=False`` leaves counts that are not whole."
    ),
    "exclude": "Flags of pixels of regions to exclude; by default as in `hyperpaint.extract_signatures`.",
    "flightlines": 'Names of the flight lines shown, such as ``["raw_0"]``; by default the first 64.',
    "folder": "A folder, new or empty.",
    "kwargs": 'Passed to `xarray.open_zarr`, such as ``chunks={"along_track": 256}``.',
    "latitude, longitude": "Place, north and east positive [degree].",
    "library": (
        "A paint library: ``reflectance`` (signature, band) [1], ``wavelength`` (band) [nm], such as from "
        "`hyperpaint.extract_signatures` or `hyperpaint.open_library`."
    ),
    "line": "A flight line with ``reflectance`` (along_track, band, cross_track) [1] and ``wavelength``.",
    "lines": "Maximum picture height [lines]; longer flight lines are subsampled.",
    "located": "Result of `hyperpaint.geometry.locate`.",
    "location": "Options of `hyperpaint.geometry.locate`, for lines that are not located.",
    "material": "Material of the surface, with its coat and flakes.",
    "overwrite": "Replace the output where it exists.",
    "path": "The file.",
    "picture": "File for the picture (PNG, PDF, ...); none by default.",
    "figure width": "Width of a new figure [inch].",
    "progress": "Called with the number of steps (lines, paints, slabs ...) done, and of all.",
    "rules": "Thresholds of the comparison.",
    "scheduler": (
        "Address of a dask.distributed scheduler, whose workers see the same files. By default the client "
        "that is active, else threads."
    ),
    "spectra": (
        "Holds ``reflectance`` [1], on ``band`` and any other dims, and ``wavelength``; a paint library too."
    ),
    "store": "A finished store, as `hyperpaint.process` or `hyperpaint.render_scene` writes it, or of a map.",
    "sun_zenith": "Zenith angle of the sun [degree]; by default from time and position of each line.",
    "tile": "Rows and columns of a task.",
    "variable": "Name; by default the first of ``reflectance``, ``radiance``, ``counts``, ``values``.",
    "width": "Width of the figure [inch].",
    # descriptions that decorators name
    "group overwrite": "Replace groups that were made from other inputs or parameters.",
    "library page": (
        "A paint library beside the store, as ``hyperpaint signatures`` writes it; libraries in the store "
        "are always shown."
    ),
    "opaque library": "A paint library: ``reflectance`` (signature, band) [1], of opaque paints.",
    "own overwrite": "Replace an earlier output of the same kind; never anything else.",
    "progress bar": "Show a progress bar.",
    "stderr progress": "Show on stderr what is being done, and how far it is.",
    "survey progress": "See `hyperpaint.surroundings.survey`; used without ``model``.",
}


def documented(**descriptions: str) -> Callable[[_Function], _Function]:
    """Return a decorator that fills in parameters of a numpydoc docstring that have no description.

    Parameters
    ----------
    **descriptions
        Description of a parameter, or a key of `PARAMETERS`; takes precedence over `PARAMETERS`.

    Examples
    --------
    >>> @documented()
    ... def save(overwrite: bool = False) -> None:
    ...     \"\"\"Save.
    ...
    ...     Parameters
    ...     ----------
    ...     overwrite
    ...     \"\"\"
    >>> save.__doc__.splitlines()[-1].strip()
    'Replace the output where it exists.'
    """
    texts = PARAMETERS | {name: PARAMETERS.get(text, text) for name, text in descriptions.items()}

    filler = textwrap.TextWrapper(
        106, initial_indent="    ", subsequent_indent="    ", break_on_hyphens=False
    )

    def decorated(function: _Function) -> _Function:
        before, heading, after = inspect.cleandoc(function.__doc__ or "").partition(
            "\nParameters\n----------\n"
        )
        if heading:
            end = re.search(r"^\S.*\n---", after, re.MULTILINE)
            section, rest = (after[: end.start()], after[end.start() :]) if end else (after, "")
            # the line after an entry without description is not indented
            filled = re.sub(
                r"^(\S.*)$(?!\n )",
                lambda entry: f"{entry[1]}\n{filler.fill(texts[entry[1].lstrip('*')])}",
                section,
                flags=re.MULTILINE,
            )
            function.__doc__ = f"{before}{heading}{filled}{rest}"
        return function

    return decorated
