"""The dataset that a paint library is."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from hyperpaint.base.arrays import Array
from hyperpaint.base.schema import BAND, LIBRARY_VARIABLES, Quality, quality_attrs
from hyperpaint.radiometry.uncertainty.propagation import NONE_KNOWN, UNCERTAINTIES
from hyperpaint.regions import Regions

from .draft import Draft
from .reduction import QUANTILES
from .sources import Source

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["paint_library"]


_GEOMETRY = (
    "sun_zenith",
    "sun_azimuth",
    "view_zenith",
    "view_azimuth",
    "relative_azimuth",
    "irradiance_age",
    "time",
)
"""What is known of how and when a paint was seen."""

_MOST_PROPERTIES = 64
"""Properties that become coordinates; all are in the coordinate ``region`` as well."""


def paint_library(
    regions: Regions,
    drafts: Sequence[Draft],
    flightlines: Sequence[str],
    sources: Mapping[str, Source],
    notes: Mapping[str, Any],
) -> xr.Dataset:
    """Return finished signatures as a dataset.

    Parameters
    ----------
    regions, drafts, flightlines
        A region, its signature, and its flight line's name, in the same order.
    sources
        The flight lines, by name; their bands are the same.
    notes
        Attributes that say how it was made.
    """
    import xarray as xr

    first = next(iter(sources.values()))
    most = max(draft.member_place[0].size for draft in drafts)
    values: dict[str, Any] = {
        "n_eff": [draft.finish() for draft in drafts],
        "n": [draft.n for draft in drafts],
        "n_excluded": [draft.excluded for draft in drafts],
        "quality": [draft.flags for draft in drafts],
        "quality_share": [draft.share for draft in drafts],
    }
    for name in ("reflectance", "reflectance_sd", "reflectance_quantiles", *UNCERTAINTIES):
        values[name] = [draft.spectra[name] for draft in drafts]
    values["member_reflectance"] = [_padded(d.spectra["member_reflectance"], most, np.nan) for d in drafts]
    for axis, name in enumerate(("member_along_track", "member_cross_track")):
        values[name] = [_padded(draft.member_place[axis], most, -1) for draft in drafts]
    for name in _GEOMETRY:
        values[name] = [draft.at[name] for draft in drafts]
    values |= {
        "paint": list(regions.names),
        "quantile": list(QUANTILES),
        "flag": [str(flag.name).lower() for flag in Quality],
        "flightline": list(flightlines),
        "region": [json.dumps(region.feature(), ensure_ascii=False) for region in regions],
        "wavelength": first.wavelength,
        "fwhm": first.fwhm,
        "good": np.all([source.good for source in sources.values()], axis=0),
    }
    made = xr.Dataset()
    for name, row in LIBRARY_VARIABLES.items():
        flags = quality_attrs() if name == "quality" else {}
        attrs = {**flags, **row.attrs, **_told(name, sources)}
        made[name] = xr.DataArray(_typed(values[name], row.dtype), dims=row.dims, attrs=attrs)
    made = made.set_coords([name for name, row in LIBRARY_VARIABLES.items() if row.coordinate])
    properties = {
        name: ("paint", column, {"long_name": f"Property {name} of the regions"})
        for name, column in _properties(regions).items()
    }
    made = made.assign_coords(properties)
    made["reflectance"].attrs |= {
        "centre": notes["centre"],
        "mirror_reflection": _mirror_reflection(sources),
        **_corrections(sources),
    }
    made.attrs = {
        "title": "Paint signatures",
        "source": _sources(sources),
        "flightlines": list(sources),
        "regions": regions.digest,
        "coordinates_of_regions": regions.coordinates,
        "spectral_axis": "nominal wavelengths",
        "view_geometry": "; ".join(dict.fromkeys(source.viewing.told for source in sources.values())),
        "smoothing": "; ".join(dict.fromkeys(source.smoothing for source in sources.values())),
        "corrections": "; ".join(dict.fromkeys(_corrected(source) for source in sources.values())),
        **notes,
    }
    return made


def _padded(values: Array, size: int, fill: float) -> Array:
    made = np.full((size, *values.shape[1:]), fill, values.dtype)
    made[: len(values)] = values
    return made


def _typed(values: Any, dtype: str) -> Array:
    if dtype == "datetime64[ns]":
        return np.array(values, dtype)
    # text of any length, as stores hold it
    return np.array(values, object if dtype == "str" else dtype)


def _told(name: str, sources: Mapping[str, Source]) -> dict[str, Any]:
    """Return attributes of an uncertainty that say what entered it."""
    if name not in UNCERTAINTIES:
        return {}
    entered = [source.components.get(name, NONE_KNOWN) for source in sources.values()]
    return {"components": "; ".join(dict.fromkeys(entered))}


def _corrections(sources: Mapping[str, Source]) -> dict[str, str]:
    """Return attributes that say what was corrected, so that nothing is corrected again."""
    names = dict.fromkeys(name for source in sources.values() for name in source.corrections)
    return {
        name: "; ".join(dict.fromkeys(source.corrections.get(name, "none") for source in sources.values()))
        for name in names
    }


def _mirror_reflection(sources: Mapping[str, Source]) -> str:
    """Return whether spectra hold what a coat mirrors; one line that does decides."""
    removed = all("mirrored_sky_removed" in source.corrections for source in sources.values())
    return "excluded" if removed else "included"


def _corrected(source: Source) -> str:
    return "; ".join(f"{name}: {text}" for name, text in source.corrections.items()) or "none"


def _sources(sources: Mapping[str, Source]) -> str:
    """Return the names of the files that the flight lines were made from."""
    told = (str(source.line.attrs.get("source", "")) for source in sources.values())
    return ", ".join(dict.fromkeys(text for text in told if text))


def _properties(regions: Regions) -> dict[str, Array]:
    """Return every property of the regions that can be a coordinate (paint,): numbers, else text."""
    names = dict.fromkeys(name for region in regions for name in region.properties)
    taken = {*LIBRARY_VARIABLES, BAND, "member"}
    usable = [name for name in names if name.isidentifier() and name not in taken and name[:2] != "__"]
    return {
        name: _column([region.properties.get(name) for region in regions])
        for name in usable[:_MOST_PROPERTIES]
    }


def _column(values: Sequence[Any]) -> Array:
    known = [value for value in values if value is not None]
    numbers = [value for value in known if isinstance(value, int | float) and not isinstance(value, bool)]
    if known and len(numbers) == len(known) and all(abs(value) < 2**53 for value in numbers):
        if len(known) == len(values) and all(isinstance(value, int) for value in known):
            return np.array(values, np.int64)
        return np.array([np.nan if value is None else value for value in values], np.float64)
    return np.array([_text(value) for value in values], object)


def _text(value: Any) -> str:
    if value is None:
        return ""
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
