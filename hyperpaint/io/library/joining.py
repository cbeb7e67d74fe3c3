"""Libraries of several files made one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hyperpaint.base.arrays import Array
from hyperpaint.base.errors import FormatError, Problems
from hyperpaint.base.schema import BAND, PAINT

from .spectra import text_column, with_numbers_as_data

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["joined"]

_MOST_SHOWN = 10
_OF_BANDS = ("wavelength", "fwhm", "good")


def joined(opened: Sequence[tuple[Path, xr.Dataset]]) -> xr.Dataset:
    """Return one library of those that files hold, in their order; the coordinate `file` tells them apart.

    Raises
    ------
    FormatError
        Their wavelengths differ, or one has more than a spectrum for each paint; all are listed.
    """
    import xarray as xr

    opened = [(path, library.set_coords(_of_paints(library))) for path, library in opened]
    libraries = [library for _, library in opened]
    first_path, first = opened[0]
    problems = Problems("the files cannot be made one library", FormatError)
    for path, library in opened:
        if not np.array_equal(library["wavelength"].values, first["wavelength"].values):
            problems.add(
                f"{path.name} has {_grid(library)}, expected {_grid(first)} as {first_path.name} has"
            )
        if more := sorted(
            str(name) for name, array in library.data_vars.items() if array.dims != (PAINT, BAND)
        ):
            problems.add(f"{path.name} has {', '.join(more)}; open it by itself")
        if len(problems) >= _MOST_SHOWN:
            break
    problems.raise_if_any()
    notes = list(dict.fromkeys(text for library in libraries if (text := library.attrs.get("notes"))))
    made = xr.Dataset()
    for name in dict.fromkeys(name for library in libraries for name in library.data_vars):
        attrs = next(library[name].attrs for library in libraries if name in library)
        values = [library[name].values if name in library else _unknown(library) for library in libraries]
        made[name] = ((PAINT, BAND), np.concatenate(values), attrs)
    for name in _OF_BANDS:
        having = [library[name] for library in libraries if name in library.coords]
        if len(having) == len(libraries) and all(np.array_equal(a.values, having[0].values) for a in having):
            made = made.assign_coords({name: having[0]})
        elif having:
            notes.append(f"{name} differs from file to file and is left out")
    names = dict.fromkeys(
        name for library in libraries for name, array in library.coords.items() if array.dims == (PAINT,)
    )
    made = made.assign_coords({name: _column(name, libraries) for name in names})
    files = text_column([path.name for path, library in opened for _ in range(library.sizes[PAINT])])
    made = made.assign_coords(file=(PAINT, files, {"long_name": "File"}))
    forms = dict.fromkeys(str(library.attrs.get("format", "")) for library in libraries)
    made.attrs = {
        "title": "Spectral library",
        "source": f"{len(opened)} files, {first_path.name} to {opened[-1][0].name}",
        "format": ", ".join(filter(None, forms)),
    }
    if notes:
        made.attrs["notes"] = "; ".join(notes[:_MOST_SHOWN])
    return with_numbers_as_data(made)


def _of_paints(library: xr.Dataset) -> list[str]:
    return [str(name) for name, array in library.data_vars.items() if array.dims == (PAINT,)]


def _grid(library: xr.Dataset) -> str:
    nm = library["wavelength"].values
    return f"{nm.size} wavelengths from {nm[0]:g} to {nm[-1]:g} nm"


def _unknown(library: xr.Dataset) -> Array:
    return np.full((library.sizes[PAINT], library.sizes[BAND]), np.nan, np.float32)


def _column(name: Any, libraries: Sequence[xr.Dataset]) -> tuple[str, Array, dict[str, Any]]:
    """Return a coordinate of the paints, empty or NaN for those whose file does not say."""
    having = [library[name] for library in libraries if name in library.coords]
    kinds = {array.dtype.kind for array in having}
    if kinds <= set("OUT"):
        parts = [
            list(lib[name].values) if name in lib.coords else [""] * lib.sizes[PAINT] for lib in libraries
        ]
        return PAINT, text_column([value for part in parts for value in part]), having[0].attrs
    if len(kinds) == 1 and len(having) == len(libraries):
        return PAINT, np.concatenate([array.values for array in having]), having[0].attrs
    if kinds <= set("biuf"):
        numbers = [
            np.asarray(lib[name].values, np.float64)
            if name in lib.coords
            else np.full(lib.sizes[PAINT], np.nan)
            for lib in libraries
        ]
        return PAINT, np.concatenate(numbers), having[0].attrs
    texts = [
        [str(v) for v in lib[name].values] if name in lib.coords else [""] * lib.sizes[PAINT]
        for lib in libraries
    ]
    return PAINT, text_column([value for part in texts for value in part]), having[0].attrs
