"""Names of earlier versions, and today's in their place, so that old files and datasets still open."""

from __future__ import annotations

import warnings
from typing import TypeVar

import xarray as xr

from .errors import PaintWarning

NEW_NAMES = {"paint": "signature", "signature": "paint"}
"""Dimension of a paint library: `paint` until 0.2, which the accessor hides. A property of regions that was
called `signature` then takes the place that is free."""

_OLD, _NEW, _BAND = "paint", "signature", "band"
_FREE = "property_signature"
VERSION_NAME = "paint_library_version"
"""Attribute of a library: the version of its specification (docs/paint-library.md)."""

_OF_LIBRARIES = ("reflectance", "score_threshold")  # the second: of detections

_Labelled = TypeVar("_Labelled", xr.Dataset, xr.DataArray)


def with_new_names(library: _Labelled) -> _Labelled:
    """Return a paint library, or detections, of hyperpaint 0.2 and before under today's names.

    Other datasets are returned unchanged; nothing is computed.

    Warns
    -----
    PaintWarning
        The dimension was renamed.

    Examples
    --------
    >>> import warnings
    >>> old = xr.Dataset({"reflectance": (("paint", "band"), [[0.1]])}, {"paint": ["red"]})
    >>> with warnings.catch_warnings(action="ignore"):
    ...     with_new_names(old)["signature"].item()
    'red'
    """
    if not _is_old(library):
        return library
    warn_of_old_names("the paint library")
    is_taken = _NEW in (library.variables if isinstance(library, xr.Dataset) else library.coords)
    if is_taken:  # in steps: swapped at once, the dimension would lose its index
        library = library.rename({_NEW: _FREE})
    renamed = library.rename({_OLD: _NEW})
    if is_taken:
        renamed = renamed.rename({_FREE: _OLD})
    if renamed.attrs.get(VERSION_NAME) == 1:  # all that version 2 changes
        renamed = renamed.assign_attrs({VERSION_NAME: 2})
    return renamed


def warn_of_old_names(source: str) -> None:
    """Warn that a library was renamed."""
    warnings.warn(
        f"{source} has the dimension {_OLD!r} of hyperpaint 0.2 and before: it is called {_NEW!r} now; write "
        "the library anew to keep the new name",
        PaintWarning,
        stacklevel=3,
    )


def _is_old(library: xr.Dataset | xr.DataArray) -> bool:
    """Return whether spectra, or thresholds of detections, are on the dim `paint`, or are of one paint."""
    if _NEW in library.dims or not (_OLD in library.dims or _OLD in library.coords):
        return False
    if isinstance(library, xr.DataArray):
        shapes = [library.dims]
    else:
        shapes = [library.variables[name].dims for name in _OF_LIBRARIES if name in library.variables]
    if any(_OLD in dims and set(dims) <= {_OLD, _BAND} for dims in shapes):
        return True
    one = library.coords.get(_OLD)  # as .isel(paint=0) leaves it
    return one is not None and one.ndim == 0 and one.dtype.kind in "OUT" and (_BAND,) in shapes
