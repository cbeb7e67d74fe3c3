"""One row of the table of variables: what a variable is, and what speaks against an array being it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from .units import same_dimension

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Variable"]


@dataclass(frozen=True)
class Variable:
    """One row of the table.

    Attributes
    ----------
    name
        Name in datasets and stores.
    dims
        Dims in storage order; `alternatives` lists the other shapes that are allowed.
    units
        CF spelling, as written to disk; empty for flags, names and time stamps.
    dtype
        numpy dtype name, before and after compute.
    meaning
        One line; becomes ``long_name``.
    alternatives
        Other dims that are allowed.
    standard_name
        Of the CF conventions, where there is one.
    coordinate
        Whether it is a coordinate rather than a data variable.
    """

    name: str
    dims: tuple[str, ...]
    units: str
    dtype: str
    meaning: str
    alternatives: tuple[tuple[str, ...], ...] = ()
    standard_name: str = ""
    coordinate: bool = False

    @property
    def attrs(self) -> dict[str, Any]:
        """Attributes written with the variable."""
        made: dict[str, Any] = {"long_name": self.meaning}
        if self.units:
            made["units"] = self.units
        if self.standard_name:
            made["standard_name"] = self.standard_name
        return made

    @property
    def allowed_dims(self) -> tuple[tuple[str, ...], ...]:
        """Dims in storage order, then the alternatives."""
        return (self.dims, *self.alternatives)

    def dim_problem(self, array: xr.DataArray) -> str | None:
        """Return what is wrong with an array's dims, in whatever order they are; None where nothing is."""
        if any(set(dims) == set(array.dims) and len(dims) == array.ndim for dims in self.allowed_dims):
            return None
        expected = " or ".join(f"({', '.join(dims)})" for dims in self.allowed_dims)
        return (
            f"{self.name!r} has dims ({', '.join(map(str, array.dims))}), expected {expected}; "
            "rename them, or name them with dims={...}"
        )

    def unit_problem(self, array: xr.DataArray) -> str | None:
        """Return what is wrong with an array's units; None where they can be converted, or there are none."""
        if not self.units:
            return None
        units = array.attrs.get("units")
        if units is None:
            return (
                f"{self.name!r} has no units; set {self.name}.attrs['units'], for example to {self.units!r}"
            )
        if not same_dimension(str(units), self.units):
            return f"{self.name!r} has units {str(units)!r}, expected something like {self.units!r}"
        return None
