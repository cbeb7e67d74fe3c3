"""Flight lines prepared for signatures: nominal wavelengths, smoothed, lazy, with directions of view."""

import contextlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import dask
import numpy as np
import xarray as xr

from hyperpaint.base import (
    ALONG_TRACK,
    BAND,
    CROSS_TRACK,
    Array,
    Bools,
    Floats,
    Ints,
    MissingExtraError,
    Problems,
    SchemaError,
    grouped,
    schema,
)
from hyperpaint.geometry.georeference.locating import between_maps, crs_of
from hyperpaint.geometry.georeference.viewing import Viewing
from hyperpaint.radiometry.counts_to_reflectance import reflectance
from hyperpaint.radiometry.spectral_axis import (
    NominalAxis,
    nominal_axis,
    smooth,
    smoothing_matrix,
    to_nominal,
)
from hyperpaint.radiometry.uncertainty import NONE_KNOWN, UNCERTAINTIES, LineErrors, line_errors
from hyperpaint.regions import Regions
from hyperpaint.regions.polygons import Pixels, lines_of_cells, located_for
from hyperpaint.surroundings.corrections import (
    CORRECTIONS,
    has_split,
    split_of,
    warn_of_contradiction,
)

# --- cells of a map as pixels of the flight line -----------------------------------------------------------
# Nearest resampling repeats some pixels and omits others; statistics count every pixel once.

#: Variables of a map: position of the pixel that a cell shows, and exact position of the cell's centre in the
#: flight line.
_POSITIONS = ("nearest_line", "nearest_sample", "glt_line", "glt_sample")


class RegionPixels(NamedTuple):
    # Pixels of a region in the opened line or map, and in the flight line that a map shows.
    cells: Pixels  #: Positions in the line, or rows and columns of the map.
    pixels: Pixels  #: Positions in the flight line.
    lines: Ints | None = None  #: (pixel,): Number of the flight line, in a map of several flight lines.

    @property
    def size(self) -> int:
        # Number of pixels.
        return int(self.cells[0].size)


def distinct_pixels(line: xr.Dataset, regions: Sequence[Pixels]) -> list[RegionPixels]:
    # Return the pixels in regions, each pixel once, from the cells of a map in the regions (eager).
    #
    # ``line`` is a flight line or a map, its dims named by role; ``regions`` are positions in it, by region.
    # A pixel shown by several cells belongs to the region of the cell nearest to its centre, and is read
    # there. Empty cells are omitted. Positions in a flight line, or in a map without indices of its pixels,
    # are returned unchanged.
    if not set(_POSITIONS) <= set(line.variables):
        return [RegionPixels(cells, cells) for cells in regions]
    # maximum distance of the cell nearest to the centre of a pixel [cells]
    attrs = {"spacing_across": 1.0, "spacing_along": 1.0, "gsd": 1.0, **line.attrs}
    reach = 1 + math.ceil(max(attrs["spacing_across"], attrs["spacing_along"]) / attrs["gsd"])
    windows = [_window(cells, reach) for cells in regions]
    names = [*_POSITIONS, *(["flightline"] if lines_of_cells(line) else [])]
    planes = [line[name].reset_coords(drop=True).transpose(ALONG_TRACK, CROSS_TRACK) for name in names]
    # computed together: cells in several windows are read once
    tables = dask.compute(*([plane.isel(window).data for plane in planes] for window in windows))
    return [
        _distinct_in_window(cells, window, *table)
        for cells, window, table in zip(regions, windows, tables, strict=True)
    ]


def _window(cells: Pixels, reach: int) -> dict[str, slice]:
    # Bounding box of cells, wider by `reach`
    return {
        dim: slice(max(0, int(axis.min()) - reach), int(axis.max()) + reach + 1) if axis.size else slice(0)
        for dim, axis in zip((ALONG_TRACK, CROSS_TRACK), cells, strict=True)
    }


def _distinct_in_window(
    region_cells: Pixels,
    window: dict[str, slice],
    line: np.ndarray,
    sample: np.ndarray,
    exact_line: np.ndarray,
    exact_sample: np.ndarray,
    flightline: np.ndarray | None = None,
) -> RegionPixels:
    # The pixels whose nearest cell lies in a region, from the variables of a window of cells (row, col).
    # In a map of several flight lines, equal positions in different flight lines are different pixels.
    top, left = window[ALONG_TRACK].start, window[CROSS_TRACK].start
    inside = np.zeros(line.shape, bool)
    inside[region_cells[0] - top, region_cells[1] - left] = True
    row, col = np.nonzero(line >= 0)
    along, across = line[row, col].astype(np.int64), sample[row, col].astype(np.int64)
    distance = np.hypot(exact_line[row, col] - along, exact_sample[row, col] - across)
    # cells in the order of their pixels, the nearest cell of each pixel first
    keys = [across, along] if flightline is None else [across, along, flightline[row, col].astype(np.int64)]
    order = np.lexsort((distance, *keys))
    pixel = np.stack([key[order] for key in keys])
    is_first = np.r_[True, (np.diff(pixel, axis=1) != 0).any(axis=0)] if order.size else np.zeros(0, bool)
    nearest = order[is_first]
    nearest = nearest[inside[row[nearest], col[nearest]]]
    numbers = None if flightline is None else keys[2][nearest]
    return RegionPixels((row[nearest] + top, col[nearest] + left), (along[nearest], across[nearest]), numbers)


def centre_of_map(line: xr.Dataset) -> tuple[float, float] | None:
    # Return latitude and longitude of a map's centre [degree]; None for a flight line, or where unknown.
    mapping = line["spatial_ref"].attrs if "spatial_ref" in line.variables else {}
    axes = [line.variables[name] for name in ("x", "y") if name in line.variables]
    wkt = mapping.get("crs_wkt") or mapping.get("spatial_ref")
    if wkt is None or "GeoTransform" not in mapping:
        return None
    if [axis.ndim for axis in axes] == [1, 1]:
        centre = [float(np.mean(axis.values)) for axis in axes]
    else:
        a, b, c, d, e, f = map(float, str(mapping["GeoTransform"]).split())
        col, row = line.sizes[CROSS_TRACK] / 2, line.sizes[ALONG_TRACK] / 2
        centre = [a + b * col + c * row, d + e * col + f * row]
    # no error: without a centre only the position of the sun is unknown
    with contextlib.suppress(MissingExtraError, SchemaError):
        ((longitude, latitude),) = between_maps(np.array([centre]), crs_of(wkt), "EPSG:4326").tolist()
        return latitude, longitude
    return None


def relative_azimuth(first: float, second: float) -> float:
    """Return the angle between two azimuths, 0 to 180 [degree].

    Examples
    --------
    >>> relative_azimuth(350.0, 20.0)
    30.0
    """
    return abs((first - second + 180.0) % 360.0 - 180.0)


#: Method of `hyperpaint.radiometry.smooth`, or its arguments by name; None for no smoothing.
Smoothing = str | Mapping[str, Any] | None

#: Variables from which the noise of reflectance can be computed.
_NOISE_VARIABLES = {"counts", "electrons_per_count", "read_noise"}
#: Attributes of reflectance without corrections, smoothing or a panel.
_PLAIN_ATTRS = {"long_name", "units", "standard_name", "keep_bits", "white"}
#: Variables of lines that signatures use.
_LINE_VARIABLES = ("time", "latitude", "longitude", "irradiance_age")


class SplitOfLines(NamedTuple):
    # Division of the light of every line into direct and diffuse light.
    fraction: Floats  #: (along_track, band): Diffuse fraction [1].
    u: Floats  #: (along_track, band): Its standard uncertainty [1].
    state: Array  #: (along_track,): State of the sky, number in `SKY_STATES`.

    def mean(self, lines: Array) -> dict[str, Any]:
        # Return the mean over some lines, with the spread in its uncertainty, and the most frequent sky.
        rows = self.fraction[lines]
        has_value = np.isfinite(rows).any(axis=1)
        if not has_value.any():
            return {}
        rows, u = rows[has_value], self.u[lines][has_value]
        return {
            "diffuse_fraction": rows.mean(axis=0),
            "diffuse_fraction_u": np.sqrt((u**2).mean(axis=0) + rows.var(axis=0)),
            "sky_state": int(np.bincount(self.state[lines][has_value] + 1).argmax()) - 1,
        }


@dataclass(frozen=True)
class Source:
    """Data of a flight line from which signatures are computed."""

    line: xr.Dataset  #: The line, dims named by role.
    #: ``reflectance`` at nominal wavelengths and its uncertainties where known, lazy. With separate sources
    #: of error the systematic uncertainty is omitted, and ``measured`` may hold the reflectance before
    #: resampling, smoothing and corrections.
    cubes: dict[str, xr.DataArray]
    planes: dict[str, xr.DataArray]  #: Variables of pixels (along_track, cross_track).
    small: dict[str, xr.DataArray]  #: Variables of lines (along_track).
    viewing: Viewing  #: Directions of view of its pixels.
    wavelength: Floats  #: (band,), float64: Centre wavelength [nm].
    fwhm: Floats  #: (band,), float64: Width [nm]; NaN where unknown.
    good: Bools  #: (band,): Whether a band is good.
    light: SplitOfLines | None  #: Division of the light of every line; None where undeclared.
    smoothing: str  #: Method of smoothing, or "none".
    corrections: dict[str, str]  #: Corrections by name, see `CORRECTIONS`.
    components: dict[str, str]  #: Error sources in the uncertainties, by name.
    errors: LineErrors | None  #: Sources of error; None where only their sum is known.
    axis: NominalAxis | None  #: Resampling of columns to nominal wavelengths; None where not needed.
    filtering: Array | None  #: (band, band): Smoothing matrix of spectra.
    #: ``quantity`` and ``mirror_reflection`` of the line's reflectance, where declared.
    declared: dict[str, str]


def source_of(
    line: xr.Dataset,
    smoothing: Smoothing,
    specular_sky: bool = False,
    sun_zenith: float | None = None,
    diffuse: Any = None,
) -> Source:
    # Return the data of a flight line or map from which signatures are computed; no cube is computed.
    #
    # Raises `SchemaError`, `UnitsError`: reflectance is missing and cannot be computed; it is smoothed
    # already, or its mirrored sky removed; or the position of the sun is unknown.
    line = schema.rename_to_roles(line)
    map_centre = centre_of_map(line)
    has_noise = set(line.variables) >= _NOISE_VARIABLES
    if "reflectance" not in line.variables:
        line = reflectance(line, uncertainty=has_noise)
    elif has_noise and not set(UNCERTAINTIES) & set(line.variables):
        # reflectance of the line's own counts, without corrections, has the uncertainties of these counts
        attrs = line["reflectance"].attrs
        if attrs.get("long_name") == schema.VARIABLES["reflectance"].meaning and set(attrs) <= _PLAIN_ATTRS:
            # where(drop=True) gives the calibration the lines' dim: the uncertainty is unknown then
            with contextlib.suppress(SchemaError):
                again = reflectance(line.drop_vars("reflectance"), uncertainty=True)
                line = line.assign({name: again[name] for name in UNCERTAINTIES})
    names = ["reflectance", *(name for name in UNCERTAINTIES if name in line.variables)]
    # time and age of the irradiance belong to cells in a map, to lines in a flight line
    cell_variables = {
        name: line[stored_name].reset_coords(drop=True)
        for name, stored_name in (("time", "line_time"), ("irradiance_age", "irradiance_age"))
        if stored_name in line.variables and set(line[stored_name].dims) == {ALONG_TRACK, CROSS_TRACK}
    }
    optional = [
        name
        for name in ("quality", "fwhm", "good", *_LINE_VARIABLES)
        if name in line.variables and name not in cell_variables
    ]
    variables = schema.require(line, [*names, "wavelength", *optional], "paint signatures")
    line = line.assign({name: variables[name] for name in names})
    attrs = variables["reflectance"].attrs
    earlier_smoothing = attrs.get("smoothing")
    corrections = {key: attrs[key] for key in CORRECTIONS if key in attrs}
    declared = {key: str(attrs[key]) for key in ("mirror_reflection", "quantity") if key in attrs}
    is_map = map_centre is not None or bool(cell_variables) or "nearest_line" in line.variables
    errors = None if is_map or corrections or earlier_smoothing is not None else line_errors(line)
    # resampling to nominal wavelengths drops the attributes of corrections
    size, nominal = line.sizes[BAND], to_nominal(line)
    good = variables["good"].values.astype(bool) if "good" in variables else np.ones(size, bool)
    nominal = nominal.assign(reflectance=nominal["reflectance"].assign_attrs(corrections))
    # division of the light of every line, in memory; None where the line does not declare it
    if not specular_sky and diffuse is None and not has_split(line):
        light = None
    else:
        split = split_of(line, diffuse, sun_zenith)
        shape = {ALONG_TRACK: line.sizes[ALONG_TRACK], BAND: split.wavelength.size}
        state: Any = xr.DataArray(split.state, dims=()) if isinstance(split.state, int) else split.state
        *arrays, state = dask.compute(split.fraction.variable, split.u.variable, state.variable)
        fraction, u = (np.asarray(array.set_dims(shape).values, np.float64) for array in arrays)
        states = state.set_dims({ALONG_TRACK: shape[ALONG_TRACK]}).values
        if specular_sky and diffuse is None:
            warn_of_contradiction(states, split.zenith)
        light = SplitOfLines(fraction, u, states.astype(np.int64))
    filtering = None
    if smoothing is not None:
        SchemaError.raise_if(
            earlier_smoothing is not None,
            f"the reflectance is smoothed already ({earlier_smoothing})",
            mend="remove the argument smooth=",
            code="already-smoothed",
        )
        options = {"method": smoothing} if isinstance(smoothing, str) else dict(smoothing)
        nominal = smooth(nominal, **options)
        filtering = None if errors is None else smoothing_matrix(good, options)
    cube, viewing = nominal["reflectance"], Viewing(line)
    small = {**{name: variables[name] for name in _LINE_VARIABLES if name in variables}, **viewing.lines}
    if map_centre is not None:
        rows = np.ones(line.sizes[ALONG_TRACK])
        small |= {
            name: xr.DataArray(value * rows, dims=ALONG_TRACK)
            for name, value in zip(("latitude", "longitude"), map_centre, strict=True)
        }
    quality = {"quality": variables["quality"]} if "quality" in variables else {}
    axis = nominal_axis(line) if errors is not None and "wavelength_shift" in line.variables else None
    further = {name: variables[name] for name in names[1:] if errors is None or name != UNCERTAINTIES[1]}
    if errors is not None and (axis is not None or smoothing is not None):
        further["measured"] = variables["reflectance"]
    return Source(
        line=line,
        cubes={"reflectance": cube, **further},
        planes={**quality, **cell_variables, **viewing.planes},
        small=small,
        viewing=viewing,
        wavelength=variables["wavelength"].values.astype(np.float64),
        fwhm=variables["fwhm"].values.astype(np.float64) if "fwhm" in variables else np.full(size, np.nan),
        good=good,
        light=light,
        smoothing=str(cube.attrs.get("smoothing", earlier_smoothing or "none")),
        corrections={key: str(cube.attrs[key]) for key in CORRECTIONS if key in cube.attrs},
        components={name: str(line[name].attrs.get("components", NONE_KNOWN)) for name in names[1:]},
        errors=errors,
        axis=axis,
        filtering=filtering,
        declared=declared,
    )


def lines_of(line: Any, regions: Regions) -> dict[str, tuple[xr.Dataset, list[int]]]:
    # Return the flight lines of regions by name, located if needed, each with the numbers of its regions.
    #
    # Raises `SchemaError`: a region names an unknown flight line, or no flight line where there are several.
    with Problems("regions cannot be found on their flight lines", SchemaError) as problems:
        lines_by_name = _by_name(line)
        single = next(iter(lines_by_name)) if len(lines_by_name) == 1 else None
        # the flight lines in a map of several
        mapped = () if single is None else lines_of_cells(schema.rename_to_roles(lines_by_name[single]))
        # a single line without a name is the flight line of all regions if these name at most one
        is_nameless = single == "" and len(regions.flightlines) < 2 and not mapped
        known = " or ".join(map(repr, mapped or lines_by_name)) or "no flight line"
        names = []
        for region in regions:
            on_single = is_nameless or not region.flightline or region.flightline.replace(" ", "_") in mapped
            name = single if single is not None and on_single else region.flightline
            naming = (
                f"is of flight line {region.flightline!r}" if region.flightline else "names no flight line"
            )
            problems.add_if(
                name not in lines_by_name,
                f"region {region.name!r} {naming}",
                expected=known,
                code="flightline-unknown",
            )
            names.append(name)
    return {
        name: (located_for(regions, lines_by_name[name]), positions)
        for name, positions in grouped((name, position) for position, name in enumerate(names)).items()
    }


def _by_name(line: Any) -> dict[str, xr.Dataset]:
    if isinstance(line, xr.Dataset):
        return {str(line.attrs.get("name", "")): line}
    if isinstance(line, xr.DataTree):
        # a store, its group of flight lines, or a single line
        parent = line["flightlines"] if "flightlines" in line.children else line
        return (
            {str(parent.name or ""): parent.to_dataset()}
            if not parent.children
            else {name: child.to_dataset() for name, child in parent.children.items()}
        )
    if isinstance(line, Mapping):
        return dict(line)
    raise SchemaError(
        f"line is {type(line).__name__}",
        expected="a Dataset, several by name, or a DataTree of them",
        code="type-wrong",
    )
