"""Names of dims, and the dims of other programs by the role they play."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from typing import TYPE_CHECKING

from .errors import SchemaError

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "ALONG_TRACK",
    "BAND",
    "CROSS_TRACK",
    "CUBE",
    "DIM_ALIASES",
    "IRRADIANCE_TIME",
    "IRRADIANCE_WAVELENGTH",
    "SLOT",
    "STEP",
    "SUN",
    "rename_to_roles",
]

ALONG_TRACK, BAND, CROSS_TRACK = "along_track", "band", "cross_track"
CUBE = (ALONG_TRACK, BAND, CROSS_TRACK)
"""Dims of a cube in sensor geometry, in the instrument's own order: band-interleaved by line."""

IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH = "irradiance_time", "irradiance_wavelength"
STEP = "step"
"""Dim of a lab sweep: one wavelength of the monochromator after the other."""

SUN, SLOT = "sun", "slot"
"""Dims of a traced scene: its suns, and the different paths of light that a pixel holds."""

#: What the neighbours call our dims, in lower case.
DIM_ALIASES: Mapping[str, tuple[str, ...]] = {
    ALONG_TRACK: ("line", "lines", "downtrack", "y", "frame"),
    BAND: ("bands", "wavelength", "wavelengths", "channel"),
    CROSS_TRACK: ("sample", "samples", "crosstrack", "x", "column"),
}


def rename_to_roles(dataset: xr.Dataset, dims: Mapping[str, Hashable] | None = None) -> xr.Dataset:
    """Return ``dataset`` with its dims named by role: ``along_track``, ``band``, ``cross_track``.

    Parameters
    ----------
    dataset
        Any dataset with a cube.
    dims
        Role to dim name, for names that `DIM_ALIASES` does not know.

    Raises
    ------
    SchemaError
        ``dims`` names a role or a dim that does not exist.
    """
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
        known = (role, *aliases)
        alias = next((d for d in dataset.dims if str(d).lower() in known and d not in names), None)
        if alias is not None:
            names[alias] = role
    # a dim `wavelength` with a coordinate of that name becomes the coordinate wavelength(band)
    indexed = [name for name, role in names.items() if role == BAND and name in dataset.coords]
    if indexed:
        dataset = dataset.reset_index(indexed)
    names = {old: new for old, new in names.items() if old != new}
    return dataset.rename_dims(names) if names else dataset
