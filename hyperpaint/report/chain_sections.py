"""Parts of a report: counts to reflectance, map, alignment, agreement with references."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from hyperpaint.base.errors import PaintError, PaintWarning, SchemaError
from hyperpaint.base.schema import ALONG_TRACK, BAND, CROSS_TRACK, rename_to_roles
from hyperpaint.geometry.orthorectification.mapping import orthorectify
from hyperpaint.pictures.figures import data_uri, encode_png, png_of
from hyperpaint.pictures.plot import rgb
from hyperpaint.pictures.plot_chain import triptych
from hyperpaint.pictures.plot_validation import validation_figure
from hyperpaint.validation import validate

from .pages import Part, page_part

if TYPE_CHECKING:
    from markupsafe import Markup

    from hyperpaint.regions import Region

_DPI = 100
_MAX_MAP_CELLS = 800  # rows or columns
_MAX_MAP_BANDS = 24
_POSE = {"latitude", "longitude", "altitude", "roll", "pitch", "heading"}

# results of the comparison of camera and record in the attributes, see `hyperpaint.alignment.align`
_COMPARED = {
    "state": "state",
    "shift": "wavelength shift, camera minus record, at 600 nm [nm]",
    "shift_slope": "change of the shift over 100 nm [nm]",
    "width": "band width over declared width [1]",
    "departure": "departure from no shift [standard uncertainties]",
    "effect": "largest change of irradiance [1]",
    "residual": "residual of solar lines, aligned [1]",
    "residual_declared": "residual of solar lines, as declared [1]",
    "record_shift": "shift of the record against solar lines [nm]",
    "camera_shift": "shift of the camera against solar lines [nm]",
    "record_fwhm": "width of the record's bands [nm]",
    "camera_width": "width of the camera's bands over declared width [1]",
}


def trust_parts(line: xr.Dataset, regions: Sequence[Region]) -> Iterator[Part]:
    """Yield counts to reflectance, map and alignment of a flight line, those whose inputs exist."""
    names = set(line.variables)
    if {"counts", "radiance_gain", "exposure_time", "irradiance", "wavelength"} <= names:
        yield "counts to reflectance", partial(_triptych, line, regions)
    if "reflectance" in names and (
        ({"east", "north"} <= names) or (names >= _POSE and "ground" in line.attrs)
    ):
        yield "map", partial(_map, line)
    if "alignment_state" in line.attrs:
        yield "alignment", partial(_alignment, line.attrs)


def _triptych(line: xr.Dataset, regions: Sequence[Region]) -> Markup:
    heading = "From counts to reflectance"
    for region in regions:
        try:
            caption = f"{region.name}: median of its pixels, the middle half and 5 to 95 % of them."
            return figure_part(triptych(line, region, width=13.0), caption, heading)
        except SchemaError:  # all pixels of the region are flagged, or it lies outside the line
            continue
    centre = (line.sizes[ALONG_TRACK] // 2, line.sizes[CROSS_TRACK] // 2)
    caption = f"The pixel in the middle of the line: line {centre[0]}, column {centre[1]} of the store."
    return figure_part(triptych(line, pixels=centre, width=13.0), caption, heading)


def _map(line: xr.Dataset) -> Markup:
    # few visible bands, and cells large enough for the size of the page
    nm = line["wavelength"].values
    visible = np.flatnonzero((nm > 400) & (nm < 700))
    bands = visible[
        np.unique(np.linspace(0, visible.size - 1, min(visible.size, _MAX_MAP_BANDS)).astype(int))
    ]
    names = ["reflectance", *(name for name in ("east", "north") if name in line.variables)]
    coords = line.coords if BAND not in line.dims else line.isel({BAND: bands}).coords
    selection = line.isel({BAND: bands})[[*names, *(n for n in _POSE if n in line.data_vars)]].assign_coords(
        coords
    )
    try:
        orthomap = orthorectify(selection, variables=["reflectance"])
        cells = max(orthomap.sizes["y"], orthomap.sizes["x"])
        if cells > _MAX_MAP_CELLS:
            gsd = float(abs(orthomap["x"][1] - orthomap["x"][0])) * cells / _MAX_MAP_CELLS
            orthomap = orthorectify(selection, gsd, variables=["reflectance"])
    except PaintError as error:  # camera or heights are missing, which is not a fault of the store
        return page_part("paragraph", text=f"There is no map: {error}", heading="Map")
    x, y = orthomap["x"].values, orthomap["y"].values
    caption = (
        f"North up, cells of {abs(x[1] - x[0]):.2g} m; easting {x.min():.0f} to {x.max():.0f}, northing "
        f"{y.min():.0f} to {y.max():.0f} m."
    )
    picture = picture_bytes(rgb(rename_to_roles(orthomap)))
    return page_part("true_colour", src=data_uri(encode_png(picture)), caption=caption, heading="Map")


def figure_part(figure: Any, caption: str, heading: str = "", kind: str = "wide") -> Markup:
    """Return a figure for a page; a figure of kind ``chart`` may be inverted in dark themes."""
    src = data_uri(png_of(figure, dpi=_DPI))
    return page_part("picture", src=src, caption=caption, heading=heading, kind=kind)


def picture_bytes(picture: xr.DataArray) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Return a picture from 0 to 1 as bytes; pixels without a value are black."""
    values = np.nan_to_num(np.asarray(picture)).clip(0.0, 1.0)
    return np.ascontiguousarray((values * 255.0 + 0.5).astype(np.uint8))


def _alignment(attrs: Mapping[Any, Any]) -> Markup:
    rows = []
    for name, label in _COMPARED.items():
        value, u = (attrs.get(f"alignment_{name}{suffix}") for suffix in ("", "_u"))
        if isinstance(value, int | float):
            has_u = isinstance(u, int | float)
            rows.append((label, f"{value:.4g} \u00b1 {u:.2g}" if has_u else f"{value:.4g}"))
        elif value is not None:
            rows.append((label, value))
    return page_part("facts", pairs=rows, heading="Alignment of camera and irradiance record")


def validation_section(
    libraries: Mapping[str, xr.Dataset], references: Sequence[xr.Dataset]
) -> Iterator[Part]:
    """Yield the agreement of each library with the field spectra in the store."""
    for name, library in libraries.items():
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", PaintWarning)
            try:
                agreement = validate(library, list(references))
            except SchemaError as error:
                yield name, partial(page_part, "paragraph", text=f"{name} cannot be compared: {error}")
                continue
        yield "verdict", partial(page_part, "paragraph", text=agreement.verdict, heading=name)
        yield "agreement", partial(_agreement, agreement)
        yield "statistics", partial(page_part, "preformatted", lines=agreement.table().splitlines())
        for message in dict.fromkeys(str(warning.message) for warning in caught):
            yield "remark", partial(page_part, "paragraph", text=message)


def _agreement(agreement: Any) -> Markup:
    caption = "Signatures over their references, and the differences with their standard uncertainty."
    return figure_part(validation_figure(agreement), caption)
