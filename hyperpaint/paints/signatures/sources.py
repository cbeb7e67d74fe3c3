"""Flight lines as signatures are drawn from them: nominal wavelengths, smoothed, lazy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from hyperpaint.base import schema
from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.schema import BAND
from hyperpaint.radiometry.bands import to_nominal
from hyperpaint.radiometry.counts_to_reflectance import reflectance
from hyperpaint.radiometry.smoothing import smooth
from hyperpaint.radiometry.uncertainty.propagation import NONE_KNOWN, UNCERTAINTIES
from hyperpaint.regions import Regions
from hyperpaint.surroundings.corrections import CORRECTIONS, remove_mirrored_sky

from .viewing import Viewing, viewing_of

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Smoothing", "Source", "lines_of", "source_of"]

Smoothing = str | Mapping[str, Any] | None
"""Method of `hyperpaint.smooth`, or its arguments by name; None smooths nothing."""

_NOISE_KNOWN = {"counts", "electrons_per_count", "read_noise"}
_SMALL = ("time", "latitude", "longitude", "irradiance_age")


@dataclass(frozen=True)
class Source:
    """What is drawn from one flight line.

    Attributes
    ----------
    line
        The line itself, dims named by role.
    cubes
        ``reflectance`` at nominal wavelengths, and its uncertainties where they are known, lazy.
    planes, small
        Variables of pixels and of lines.
    viewing
        From where its pixels are seen.
    wavelength, fwhm : (band,), float64
        [nm]; NaN where the width is not known.
    good : (band,), bool
    smoothing
        How spectra are smoothed; "none".
    corrections
        What was corrected, by name, see `CORRECTIONS`.
    components
        What enters the uncertainties, by name.
    """

    line: xr.Dataset
    cubes: dict[str, xr.DataArray]
    planes: dict[str, xr.DataArray]
    small: dict[str, xr.DataArray]
    viewing: Viewing
    wavelength: Floats
    fwhm: Floats
    good: npt.NDArray[np.bool_]
    smoothing: str
    corrections: dict[str, str]
    components: dict[str, str]


def source_of(
    line: xr.Dataset, smoothing: Smoothing, specular_sky: bool = False, sun_zenith: float | None = None
) -> Source:
    """Return what signatures need of a flight line; nothing of a cube is computed.

    Raises
    ------
    SchemaError, UnitsError
        There is no reflectance, and none can be computed; it is smoothed already, or the mirrored sky
        removed; or it is not known where the sun is.
    """
    line = schema.rename_to_roles(line)
    if "reflectance" not in line.variables:
        line = reflectance(line, uncertainty=set(line.variables) >= _NOISE_KNOWN)
    names = ["reflectance", *(name for name in UNCERTAINTIES if name in line.variables)]
    optional = [name for name in ("quality", "fwhm", "good", *_SMALL) if name in line.variables]
    found = schema.require(line, [*names, "wavelength", *optional], "paint signatures")
    line = line.assign({name: found[name] for name in names})
    before = found["reflectance"].attrs.get("smoothing")
    # nominal wavelengths come with new attributes; what was corrected stays so
    corrected = {
        key: found["reflectance"].attrs[key] for key in CORRECTIONS if key in found["reflectance"].attrs
    }
    nominal = to_nominal(line)
    nominal = nominal.assign(reflectance=nominal["reflectance"].assign_attrs(corrected))
    if specular_sky:
        where = nominal.assign({name: found[name] for name in ("wavelength", *_SMALL) if name in found})
        nominal = remove_mirrored_sky(where, sun_zenith=sun_zenith)
    if smoothing is not None:
        if before is not None:
            raise SchemaError(f"the reflectance is smoothed already ({before}); leave out smooth=")
        options = {"method": smoothing} if isinstance(smoothing, str) else dict(smoothing)
        nominal = smooth(nominal, **options)
    cube = nominal["reflectance"]
    viewing = viewing_of(line)
    size = cube.sizes[BAND]
    wavelength = found["wavelength"].values.astype(np.float64)
    return Source(
        line=line,
        cubes={"reflectance": cube, **{name: found[name] for name in names[1:]}},
        planes={**({"quality": found["quality"]} if "quality" in found else {}), **viewing.planes},
        small={**{name: found[name] for name in _SMALL if name in found}, **viewing.lines},
        viewing=viewing,
        wavelength=wavelength,
        fwhm=found["fwhm"].values.astype(np.float64) if "fwhm" in found else np.full(size, np.nan),
        good=found["good"].values.astype(bool) if "good" in found else np.ones(size, bool),
        smoothing=str(cube.attrs.get("smoothing", before or "none")),
        corrections={key: str(cube.attrs[key]) for key in CORRECTIONS if key in cube.attrs},
        components={name: str(line[name].attrs.get("components", NONE_KNOWN)) for name in names[1:]},
    )


def lines_of(line: Any, regions: Regions) -> dict[str, tuple[xr.Dataset, list[int]]]:
    """Return the flight lines that regions are on, and the positions of the regions on each.

    Raises
    ------
    SchemaError
        A region names another line than there is, or none where there are several; all are listed.
    """
    problems = Problems("regions cannot be found on their flight lines", SchemaError)
    given = _by_name(line)
    only = next(iter(given)) if len(given) == 1 else None
    # a line that does not say its name is taken to be the regions' one
    nameless = only == "" and len(regions.flightlines) < 2
    found: dict[str, tuple[xr.Dataset, list[int]]] = {}
    for position, region in enumerate(regions):
        wanted = only if only is not None and (nameless or not region.flightline) else region.flightline
        if wanted in given:
            found.setdefault(wanted, (given[wanted], []))[1].append(position)
            continue
        held = ", ".join(map(repr, given)) or "no flight line"
        told = f"is of flight line {region.flightline!r}" if region.flightline else "names no flight line"
        problems.add(f"region {region.name!r} {told}; there is {held}")
    problems.raise_if_any()
    return found


def _by_name(line: Any) -> dict[str, xr.Dataset]:
    import xarray as xr

    if isinstance(line, xr.Dataset):
        return {str(line.attrs.get("name", "")): line}
    if isinstance(line, xr.DataTree):
        # a store, its group of flight lines, or a line itself
        parent = line["flightlines"] if "flightlines" in line.children else line
        if not parent.children:
            return {str(parent.name or ""): parent.to_dataset()}
        return {name: child.to_dataset() for name, child in parent.children.items()}
    if isinstance(line, Mapping):
        return dict(line)
    raise SchemaError(
        f"line is {type(line).__name__}, expected a Dataset, several by name, or a DataTree of them"
    )
