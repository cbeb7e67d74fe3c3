"""The library that new paints make, which says of every paint what it was made from."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from hyperpaint.base.schema import BAND, LIBRARY_VARIABLES, MEMBER, PAINT, QUANTILE
from hyperpaint.base.units import convert

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["MEMBERS", "SPECULAR", "specular_of", "synthetic_library", "text_column"]

MEMBERS = "member_reflectance"
"""Single pixels of a paint, or variants (paint, member, band)."""

SPECULAR = "specular_reflectance"
"""What a coat mirrors (paint, band), which not every library has."""

_DIMS = {
    "reflectance": (PAINT, BAND),
    "reflectance_sd": (PAINT, BAND),
    "reflectance_quantiles": (PAINT, QUANTILE, BAND),
    SPECULAR: (PAINT, BAND),
    MEMBERS: (PAINT, MEMBER, BAND),
}
_MEANINGS = {
    "reflectance": "Reflectance of a synthetic paint",
    "reflectance_sd": "Standard deviation of reflectance over the members",
    "reflectance_quantiles": "Quantiles of reflectance over the members",
    SPECULAR: "Reflectance of the clear coat and of flakes, near the mirror direction",
    MEMBERS: "Reflectance of synthetic variants of a paint",
}
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
"""Those of signatures."""

_LASTING = ("mirror_reflection", "mirrored_sky_removed", "light_corrected", "tilt", "smoothing")
"""Attributes of reflectance that are as true of what is made from it."""


def text_column(texts: Sequence[str]) -> npt.NDArray[np.object_]:
    """Return texts of any length, as stores hold them."""
    made = np.empty(len(texts), object)
    made[:] = list(texts)
    return made


def specular_of(library: xr.Dataset) -> npt.NDArray[Any]:
    """Return what the coats of a library mirror (paint, band) [1].

    Raises
    ------
    UnitsError
        Its units are missing or cannot be read.
    """
    return np.asarray(convert(library[SPECULAR], "1").transpose(PAINT, BAND).values)


def synthetic_library(
    library: xr.Dataset,
    names: Sequence[str],
    values: Mapping[str, npt.NDArray[Any]],
    parents: Sequence[Mapping[str, float]],
    method: str,
    **attrs: Any,
) -> xr.Dataset:
    """Return new paints as a library.

    Parameters
    ----------
    library
        What they were made from; its bands are theirs.
    names
        Of the new paints.
    values
        Spectra by the name of their variable.
    parents
        What each was made from, and by which shares.
    method
        How.
    **attrs
        Of the library.
    """
    import xarray as xr

    made = xr.Dataset()
    if MEMBERS in values and values[MEMBERS].shape[1] > 1:
        values = {**values, **_spread(values[MEMBERS])}
        made = made.assign_coords(
            {QUANTILE: (QUANTILE, np.array(QUANTILES), LIBRARY_VARIABLES[QUANTILE].attrs)}
        )
    for name, array in values.items():
        told = {"long_name": _MEANINGS[name], "units": "1"}
        made[name] = (_DIMS[name], np.asarray(array, np.float32), told)
    before = library["reflectance"].attrs
    made["reflectance"].attrs |= {key: before[key] for key in _LASTING if key in before}
    bands = {name: array for name, array in library.coords.items() if array.dims == (BAND,)}
    made = made.assign_coords(bands).assign_coords(
        {
            PAINT: (PAINT, text_column(names), LIBRARY_VARIABLES[PAINT].attrs),
            **{
                name: (PAINT, text_column(column), {"long_name": meaning})
                for name, meaning, column in (
                    ("provenance", "Where the paint comes from", ["synthetic"] * len(names)),
                    ("parents", "Paints it was made from, as JSON", [_json(list(one)) for one in parents]),
                    ("weights", "Shares of the parents, as JSON", [_shares(one) for one in parents]),
                    ("method", "How it was made", [method] * len(names)),
                )
            },
        }
    )
    made.attrs = {
        "title": "Synthetic paints",
        "provenance": "synthetic",
        "made_from": str(library.attrs.get("title", "a paint library")),
        **attrs,
    }
    return made


def _spread(members: npt.NDArray[Any]) -> dict[str, npt.NDArray[Any]]:
    """Return how far members (paint, member, band) are apart; NaN of fewer than two, or one."""
    # one paint after the other: a copy of all members would double the memory
    made = [_spread_of_paint(one[np.isfinite(one).any(axis=1)]) for one in members]
    return {
        "reflectance_sd": np.stack([sd for sd, _ in made]),
        "reflectance_quantiles": np.stack([quantiles for _, quantiles in made]),
    }


def _spread_of_paint(members: npt.NDArray[Any]) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    """Return standard deviation (band,) and quantiles (quantile, band) of members, band by band."""
    known = np.isfinite(members).sum(axis=0)
    sd = np.full(known.size, np.nan)
    quantiles = np.full((len(QUANTILES), known.size), np.nan)
    # the variants of numpy that pass over NaN are slower by far
    whole = bool(known.size) and bool((known == len(members)).all())
    sd_of, quantile_of = (np.std, np.quantile) if whole else (np.nanstd, np.nanquantile)
    if (two := known > 1).any():
        sd[two] = sd_of(members[:, two], axis=0, ddof=1, dtype=np.float64)
    if (one := known > 0).any():
        quantiles[:, one] = quantile_of(members[:, one], QUANTILES, axis=0)
    return sd, quantiles


def _json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)


def _shares(parents: Mapping[str, float]) -> str:
    # twelve digits tell any recipe, without the last bits of a division
    return _json([float(f"{share:.12g}") for share in parents.values()])
