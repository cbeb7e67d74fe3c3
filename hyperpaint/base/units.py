"""Units: CF text in ``attrs``, pint at the boundary.

The registry is private, and in it the steradian, the count and the electron are dimensions: a forgotten
``pi sr`` between radiance and irradiance is then an error, where pint's own registry, like UDUNITS, lets it
pass. No Quantity ever enters an array, a graph or a store.
"""

from __future__ import annotations

import functools
import re
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from .errors import MissingExtraError, Problems, UnitsError

if TYPE_CHECKING:
    import pint

__all__ = ["canonical", "conversion_factor", "convert", "quantify", "registry", "same_dimension"]

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
count = [count] = _ = counts = digital_number = digital_numbers = DN = dn = adu = ADU
electron = [electron_count] = _ = electrons
radian = [] = rad
degree = 0.017453292519943295 = deg = degrees = arcdegree
percent = 0.01
permille = 0.001
minute = 60 * second = min
hour = 60 * minute = h = hr
day = 24 * hour = d
hertz = 1 / second = Hz
newton = kilogram * meter / second ** 2 = N
joule = newton * meter = J
watt = joule / second = W
angstrom = 1e-10 * meter
micron = 1e-6 * meter
foot = 0.3048 * meter = ft = feet
flick = 1e10 * watt / steradian / meter ** 3
"""

# m-2 -> m**-2, but neither 1e-3 nor nm_2 is touched
_CF_POWER = re.compile(r"(?<![0-9.A-Za-z_µμ])([A-Za-zµμ]+)\^?(-?[0-9]+)\b")
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
    "%": "percent",
}
# a power that may reach pint: of a name or a number, to a literal of one or two digits, never of a power
_POWER = re.compile(r"(?:\*\*|\^)")
_SAFE_POWER = re.compile(r"(?<=[A-Za-z0-9µμ .])(?:\*\*|\^)\s*[-+]?[0-9]{1,2}(?![0-9.]|\s*\*\*|\s*\^)")
# pint would turn raised digits into a power of its own, after the check above
_RAISED = re.compile("[⁺⁻]?[⁰¹²³⁴⁵⁶⁷⁸⁹]+")
_LOWERED = str.maketrans("⁺⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "+-0123456789")
_WORD = re.compile("|".join(rf"(?<![A-Za-z]){re.escape(word)}(?![A-Za-z])" for word in _WORDS), re.IGNORECASE)


def _plain_powers(text: str) -> str:
    """Return ``text`` with raised digits written as powers, which can then be judged."""
    return _RAISED.sub(lambda match: f"**{match[0].translate(_LOWERED)} ", text)


def _spell_for_pint(text: str) -> str:
    text = _WORD.sub(lambda match: _WORDS[match[0].lower()], text)
    text = _plain_powers(text).replace("·", " ")
    return _CF_POWER.sub(r"\1**\2", text)


@functools.cache
def registry(force_ndarray_like: bool = False) -> pint.UnitRegistry[Any]:
    """Return hyperpaint's private unit registry.

    It reads CF spelling (``W m-2 sr-1 nm-1``), the words of ENVI headers (``Nanometers``) and units with a
    scale (``1e-10 W cm-2 nm-1 sr-1``). It is never made pint's application registry. Only pint-xarray asks
    for ``force_ndarray_like``, under which a float32 Quantity times a number becomes float64.
    """
    import pint

    units: pint.UnitRegistry[Any] = pint.UnitRegistry(
        None, preprocessors=[_spell_for_pint], force_ndarray_like=force_ndarray_like
    )
    for line in _DEFINITIONS.strip().splitlines():
        units.define(line)
    return units


def _quantity(text: object) -> Any:
    if not isinstance(text, str):
        raise UnitsError(f"units must be text in CF spelling such as 'W m-2 sr-1 nm-1', found {text!r}")
    # pint evaluates powers, so that 9**9**9 or s1000000000000 would never return
    text = _plain_powers(text[:201])
    huge = any(len(power.lstrip("-")) > 2 for _, power in _CF_POWER.findall(text))
    if len(text) > 200 or huge or len(_POWER.findall(text)) != len(_SAFE_POWER.findall(text)):
        raise UnitsError(
            f"units {text[:60]!r} cannot be read; expected CF spelling such as 'W m-2 sr-1 nm-1'"
        )
    return _parse(text.strip() or "1")


@functools.lru_cache(maxsize=1024)
def _parse(text: str) -> Any:
    units = registry()
    try:
        quantity = units.Quantity(1.0, "") * units.parse_expression(text)
        if not 0.0 < quantity.to_base_units().magnitude < float("inf"):
            raise ValueError
        return quantity
    except Exception as error:  # pint leaks TypeError, tokenize errors and its own classes
        raise UnitsError(
            f"units {text!r} cannot be read; expected CF spelling such as 'W m-2 sr-1 nm-1'"
        ) from error


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
    source, target = _quantity(found), _quantity(wanted)
    if source.dimensionality != target.dimensionality:
        raise UnitsError(
            f"units {found!r} are not convertible to {wanted!r}; "
            "check the quantity, and whether a solid angle (sr) or an exposure (s) is missing"
        )
    # twelve digits: the factor of a decimal unit is then the decimal number itself
    return float(f"{(source / target).to_base_units().magnitude:.12g}")


def same_dimension(found: str, wanted: str) -> bool:
    """Tell whether two unit texts measure the same dimension; False where one cannot be read."""
    try:
        return bool(_quantity(found).dimensionality == _quantity(wanted).dimensionality)
    except UnitsError:
        return False


def canonical(text: str) -> str:
    """Return ``text`` if it can be read as units, else raise UnitsError."""
    _quantity(text)
    return text


def convert(array: xr.DataArray, wanted: str, name: str | None = None) -> xr.DataArray:
    """Return ``array`` in the units ``wanted``, lazily; floats keep their dtype, integers may become floats.

    Parameters
    ----------
    array
        Labelled values with a ``units`` attribute.
    wanted
        Units in CF spelling.
    name
        What messages call the array; its own name by default.

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
    name = name or str(array.name)
    units = array.attrs.get("units")
    if units is None:
        raise UnitsError(f"{name!r} has no units; set {name}.attrs['units'], for example to {wanted!r}")
    try:
        factor = conversion_factor(str(units), wanted)
    except UnitsError as error:
        raise UnitsError(f"{name!r}: {error}") from error
    if factor != 1.0:
        # as an integer, a factor of 0.001 would be 0
        kind = np.result_type(array.dtype, np.float16)
        array = array.copy(data=array.data * kind.type(factor))
    return array.assign_attrs(units=wanted)


def quantify(dataset: xr.Dataset) -> xr.Dataset:
    """Return ``dataset`` with its data variables as pint Quantities of hyperpaint's registry.

    Raises
    ------
    MissingExtraError
        pint-xarray is not installed.
    UnitsError
        Units cannot be read, or carry a scale, which a Quantity's unit cannot; all are listed.
    """
    try:
        import pint_xarray  # noqa: F401
    except ImportError as error:
        needed = MissingExtraError.of("pint-xarray", "units", "a Quantity view")
        raise needed from error

    units = registry(force_ndarray_like=True)
    problems = Problems("a Quantity view cannot be made", UnitsError)
    unit_of = {}
    for name, array in dataset.data_vars.items():
        if "units" not in array.attrs or array.dtype.kind not in "fiu":
            continue
        text = array.attrs["units"]
        try:
            unit_of[name] = units.Unit(_spell_for_pint(canonical(text)))
        except Exception:  # pint leaks its own classes
            problems.add(f"{str(name)!r} has units {text!r}; expected CF spelling without a scale")
    problems.raise_if_any()
    # coordinates are left alone: an index of Quantities can no longer be selected on
    plain = dict.fromkeys(dataset.coords)
    quantified: xr.Dataset = dataset.pint.quantify({**plain, **unit_of}, unit_registry=units)
    return quantified
