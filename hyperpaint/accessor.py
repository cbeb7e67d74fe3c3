"""The ``.paint`` accessors: hyperpaint's functions as methods of a Dataset or DataArray, without logic.

Each method is the function in `METHODS` with the dataset as its first argument: same arguments, same
docstring (``line.paint.reflectance?``). ``accessor.pyi`` declares the methods for type checkers and editors;
``python tests/support/accessor_stub.py`` writes it from the same functions.
"""

import difflib
import importlib
import inspect
from collections.abc import Callable, Hashable, Mapping
from typing import TYPE_CHECKING, Any

import xarray as xr

if TYPE_CHECKING:
    import pint

    from .io.store import StoreReport

__all__ = ["ARRAY_METHODS", "METHODS", "METHOD_GROUPS", "PaintAccessor", "PaintArrayAccessor"]

METHOD_GROUPS = {
    "look": {
        "rgb": "pictures",
        "quicklook": "pictures",
        "spectrum": "pictures",
        "triptych": "pictures",
        "flag_overlay": "pictures",
        "explore": "pictures",
    },
    "radiance and reflectance": {
        "radiance": "radiometry",
        "reflectance": "radiometry",
        "white_reference": "radiometry",
        "pixels": "radiometry",
        "coarse": "radiometry",
    },
    "wavelengths": {
        "smooth": "radiometry",
        "at": "radiometry",
        "to_nominal": "radiometry",
        "align_to_irradiance": "alignment",
        "apply_alignment": "alignment",
        "oxygen_residual": "alignment",
    },
    "flags and corrections": {
        "survey": "surroundings",
        "flag": "surroundings",
        "remove_mirrored_sky": "surroundings",
        "correct_coat": "surroundings",
        "correct_light": "surroundings",
    },
    "maps": {"locate": "geometry", "orthorectify": "geometry"},
    "paints": {
        "propose_regions": "regions",
        "signatures": "paints:extract_signatures",
        "detect": "paints",
        "relight": "simulation",
    },
}
"""Methods by task: the room of each method's function, and the name of the function where it differs."""

METHODS = {name: home for group in METHOD_GROUPS.values() for name, home in group.items()}

ARRAY_METHODS = ("smooth", "at", "to_nominal", "rgb", "spectrum")
"""Methods of a DataArray: they need only a cube or a spectrum with its coordinates."""

_DIMS_DOC = """

The method passes the dataset as the first argument, and accepts ``dims``, a mapping such as
``{"along_track": "my_dim"}``, for dims with other names.
"""

Dims = Mapping[str, Hashable]


class _Method:
    # Descriptor of a function of a room, which is loaded on first use; unbound on the class.

    def __init__(self, name: str, home: str, accessor: Any = None) -> None:
        self.__name__ = name
        self.__qualname__ = f"PaintAccessor.{name}"
        self._home = home
        self._accessor = accessor

    def __get__(self, accessor: Any, owner: type[Any]) -> "_Method":
        return type(self)(self.__name__, self._home, accessor)

    @property
    def _function(self) -> Callable[..., Any]:
        room, _, name = self._home.partition(":")
        function: Callable[..., Any] = getattr(
            importlib.import_module(f"hyperpaint.{room}"), name or self.__name__
        )
        return function

    @property
    def __doc__(self) -> str:  # type: ignore[override]
        return inspect.cleandoc(self._function.__doc__ or "") + _DIMS_DOC

    @property
    def __signature__(self) -> inspect.Signature:
        signature = inspect.signature(self._function)
        dataset_parameter, *parameters = signature.parameters.values()
        dims = inspect.Parameter(
            "dims", inspect.Parameter.KEYWORD_ONLY, default=None, annotation="Dims | None"
        )
        place = len(parameters) - any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters)
        parameters.insert(place, dims)
        if self._accessor is None:
            parameters.insert(0, dataset_parameter.replace(name="self", annotation=inspect.Parameter.empty))
        return signature.replace(parameters=parameters)

    def __call__(self, *arguments: Any, dims: Dims | None = None, **options: Any) -> Any:
        from .base.schema import rename_to_roles

        if self._accessor is None:  # PaintAccessor.rgb(accessor)
            accessor, *method_arguments = arguments
            return type(self)(self.__name__, self._home, accessor)(*method_arguments, dims=dims, **options)
        return self._function(rename_to_roles(self._accessor._dataset, dims), *arguments, **options)


class _Accessor:
    # Errors for users who expect a variable named paint, which is hidden by the accessor.

    def __getattr__(self, name: str) -> Any:
        text = f"the accessor .paint has no attribute {name!r}"
        if not name.startswith("_"):  # copy, pickle and IPython ask for private names
            if matches := difflib.get_close_matches(
                name, [method for method in dir(self) if method[0] != "_"], 1
            ):
                text += f"; the nearest is .paint.{matches[0]}"
            text += f". {_ACCESS_HINT}"
        raise AttributeError(text, name=name, obj=self)

    def __eq__(self, other: object) -> bool:
        if isinstance(other, _Accessor):
            return self is other
        raise TypeError(f"the accessor .paint cannot be compared with {type(other).__name__}. {_ACCESS_HINT}")

    __hash__ = object.__hash__


_METHODS_BY_TASK = "\n".join(
    f"{task}: {', '.join(methods)}"
    for task, methods in (METHOD_GROUPS | {"store": ["verify", "quantify"]}).items()
)
_ACCESS_HINT = (
    'Names of a paint library are library["signature"]; a variable of your own that is called paint is '
    'dataset["paint"]'
)


@xr.register_dataset_accessor("paint")
class PaintAccessor(_Accessor):
    """Methods on a flight line. They return new objects, lazily unless their documentation says "eager".

    Dims are found by role. Names of other programs (downtrack, crosstrack, bands, y, x, ...) are recognised;
    declare others with ``dims={"along_track": "my_dim"}``.
    """

    def __init__(self, dataset: xr.Dataset) -> None:
        self._dataset = dataset

    def __repr__(self) -> str:
        from .report.summaries import summary_text

        return summary_text(self._dataset, _METHODS_BY_TASK)

    def _repr_html_(self) -> str:
        from .report.summaries import summary_html

        return summary_html(self._dataset, _METHODS_BY_TASK)

    def verify(self) -> "StoreReport":
        """Read every chunk of the store that the dataset was opened from (eager); see `hyperpaint.verify`.

        Raises
        ------
        StoreError
            The source of the dataset is unknown, or is not a Zarr store.

        Examples
        --------
        >>> from hyperpaint.io.store import to_store
        >>> light = xr.Dataset({"wavelength": ("band", [450.0, 550.0])})
        >>> path = to_store(light, "memory://whole.zarr", "flightlines/raw_0")
        >>> xr.open_zarr(path, group="flightlines/raw_0").paint.verify().ok
        True
        """
        from .base.errors import StoreError
        from .io.store import verify

        source = self._dataset.encoding.get("source")
        StoreError.raise_if(
            not isinstance(source, str),
            "the dataset has no path or URL of its store in encoding['source']",
            expected="a dataset of xarray.open_zarr(path)",
            mend="call hyperpaint.verify(path), or load all of a store of icechunk",
            code="store-unknown",
        )
        return verify(source)

    def quantify(self, registry: "pint.UnitRegistry[Any] | None" = None) -> xr.Dataset:
        """Return a view for pint-xarray users: data variables as Quantities (extra ``units``).

        Coordinates stay plain, for selection. hyperpaint's functions accept such a view and return plain
        datasets, as does ``.pint.dequantify()``.

        Parameters
        ----------
        registry
            A pint registry, such as ``pint.UnitRegistry(force_ndarray_like=True)``. Default: the registry of
            hyperpaint, in which sr, count and electron are dimensions.

        Raises
        ------
        UnitsError
            Units are unreadable, or unknown to the registry; all are listed.

        Examples
        --------
        >>> width = xr.Dataset({"fwhm": ("band", [6.0], {"units": "nm"})})
        >>> width.paint.quantify().fwhm.pint.to("um").pint.magnitude  # needs pint-xarray
        array([0.006])
        """
        from .base.facts import quantify

        return quantify(self._dataset, registry)


class _ArrayMethod(_Method):
    # A method of a DataArray: returns its own variable of the resulting dataset.

    def __call__(self, *arguments: Any, dims: Dims | None = None, **options: Any) -> Any:
        from .base.schema import VARIABLES

        if self._accessor is None:
            return super().__call__(*arguments, dims=dims, **options)
        # functions find a cube by its name; a picture also shows values of an undeclared quantity
        array, own_name = self._accessor._array, self._accessor._name
        name = own_name if own_name in VARIABLES else "values" if self.__name__ == "rgb" else "reflectance"
        method = _Method(self.__name__, self._home, PaintArrayAccessor(array.rename(name)))
        result = method(*arguments, dims=dims, **options)
        return result[name].rename(array.name) if isinstance(result, xr.Dataset) else result


@xr.register_dataarray_accessor("paint")
class PaintArrayAccessor(_Accessor):
    """Methods on a cube, such as ``line.reflectance.paint.rgb()``. They return new objects.

    A cube with another name than those of the schema, or without one, is taken for reflectance; ``rgb`` shows
    it as values of an undeclared quantity.
    """

    def __init__(self, array: xr.DataArray) -> None:
        self._array = array

    @property
    def _name(self) -> Hashable:
        name = self._array.name
        return "values" if name is None or name in self._array.coords else name

    @property
    def _dataset(self) -> xr.Dataset:
        return self._array.to_dataset(name=self._name)

    def quantify(self, registry: "pint.UnitRegistry[Any] | None" = None) -> xr.DataArray:
        """Return a view for pint-xarray users, a Quantity; see `PaintAccessor.quantify`."""
        from .base.facts import quantify

        return quantify(self._dataset, registry)[self._name].rename(self._array.name)


for _name, _home in METHODS.items():
    setattr(PaintAccessor, _name, _Method(_name, _home))
for _name in ARRAY_METHODS:
    setattr(PaintArrayAccessor, _name, _ArrayMethod(_name, METHODS[_name]))
