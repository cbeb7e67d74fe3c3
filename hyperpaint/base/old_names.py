"""Names of earlier versions and their replacements, so that old files and datasets still open."""

from typing import TypeVar

import xarray as xr

from .errors import warn_user

#: Dimension of a paint library: `paint` until 0.2, a name that the accessor shadows. A property of regions
#: called `signature` becomes `paint`, which is then free.
NEW_NAMES = {"paint": "signature", "signature": "paint"}

_OLD_DIM, _NEW_DIM, _BAND = "paint", "signature", "band"
_FREE_NAME = "property_signature"
#: Attribute of a library: the version of its specification (docs/paint-library.md).
VERSION_NAME = "paint_library_version"

_LIBRARY_VARIABLES = ("reflectance", "score_threshold")  # the second: of detections

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
    is_taken = _NEW_DIM in (library.variables if isinstance(library, xr.Dataset) else library.coords)
    if is_taken:  # in two steps: a swap in one step drops the index of the dimension
        library = library.rename({_NEW_DIM: _FREE_NAME})
    renamed = library.rename({_OLD_DIM: _NEW_DIM})
    if is_taken:
        renamed = renamed.rename({_FREE_NAME: _OLD_DIM})
    if renamed.attrs.get(VERSION_NAME) == 1:  # version 2 changes nothing else
        renamed = renamed.assign_attrs({VERSION_NAME: 2})
    return renamed


def warn_of_old_names(source: str) -> None:
    warn_user(
        f"{source} has the dimension {_OLD_DIM!r} of hyperpaint 0.2 and before, which is now "
        f"{_NEW_DIM!r}; write the library again to store the new name",
        "dim-renamed",
    )


def _is_old(library: xr.Dataset | xr.DataArray) -> bool:
    # Spectra and thresholds of detections had the dim `paint`, or `paint` as a scalar coordinate.
    if _NEW_DIM in library.dims or not (_OLD_DIM in library.dims or _OLD_DIM in library.coords):
        return False
    shapes = (
        [library.dims]
        if isinstance(library, xr.DataArray)
        else [library.variables[name].dims for name in _LIBRARY_VARIABLES if name in library.variables]
    )
    if any(_OLD_DIM in dims and set(dims) <= {_OLD_DIM, _BAND} for dims in shapes):
        return True
    name = library.coords.get(_OLD_DIM)  # as .isel(paint=0) leaves it
    return name is not None and name.ndim == 0 and name.dtype.kind in "OUT" and (_BAND,) in shapes
