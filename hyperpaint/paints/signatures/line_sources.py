"""Flight lines prepared for signatures: nominal wavelengths, smoothed, lazy, with directions of view."""

from __future__ import annotations

import contextlib
import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import dask
import numpy as np
import xarray as xr

from hyperpaint.base import schema
from hyperpaint.base.arrays import Array, Bools, Floats, Ints
from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import MissingExtraError, PaintWarning, Problems, SchemaError
from hyperpaint.base.schema import ALONG_TRACK, BAND, CROSS_TRACK
from hyperpaint.geometry.georeference.attitude_rotations import matrices, quaternions
from hyperpaint.geometry.georeference.cameras import directions
from hyperpaint.geometry.georeference.geodesy import between_maps, crs_of, meridian_convergence
from hyperpaint.light.diffuse_record import SPLIT
from hyperpaint.radiometry.counts_to_reflectance import reflectance
from hyperpaint.radiometry.spectral_axis import (
    NominalAxis,
    nominal_axis,
    smooth,
    smoothing_matrix,
    to_nominal,
)
from hyperpaint.radiometry.uncertainty.error_sources import LineErrors, line_errors
from hyperpaint.radiometry.uncertainty.propagation import NONE_KNOWN, UNCERTAINTIES
from hyperpaint.regions import Regions
from hyperpaint.regions.pixels_in_regions import Pixels, lines_of_cells, located_for
from hyperpaint.surroundings.corrections import CORRECTIONS, remove_mirrored_sky
from hyperpaint.surroundings.light_split import has_split, split_of, warn_of_contradiction

# -- Cells of a map as pixels of the flight line that they show.
# Nearest resampling repeats some pixels and leaves others out; statistics count every pixel once.

_PLACES = ("nearest_line", "nearest_sample", "glt_line", "glt_sample")


class Shown(NamedTuple):
    """Pixels of a region: their cells, and their positions in the flight line."""

    cells: Pixels
    pixels: Pixels
    #: (pixel,): number of the flight line; of a map of several alone
    lines: Ints | None = None

    @property
    def size(self) -> int:
        """Number of pixels."""
        return int(self.cells[0].size)


def shown_pixels(line: xr.Dataset, places: Sequence[Pixels]) -> list[Shown]:
    """Return the pixels in regions, each once, from the cells of a map that lie in them (eager).

    ``line`` is a flight line or a map, its dims named by role; ``places`` are positions in it, by region. A
    pixel shown by several cells belongs to the region of the cell nearest to its centre, and is read there.
    Empty cells are no pixels. Positions in a flight line, or in a map without indices of its pixels, are
    returned unchanged.
    """
    if not set(_PLACES) <= set(line.variables):
        return [Shown(place, place) for place in places]
    # largest distance of the cell nearest to the centre of a pixel
    attrs = {"spacing_across": 1.0, "spacing_along": 1.0, "gsd": 1.0, **line.attrs}
    reach = 1 + math.ceil(max(attrs["spacing_across"], attrs["spacing_along"]) / attrs["gsd"])
    windows = [_window(place, reach) for place in places]
    names = [*_PLACES, *(["flightline"] if lines_of_cells(line) else [])]
    planes = [line[name].reset_coords(drop=True).transpose(ALONG_TRACK, CROSS_TRACK) for name in names]
    # computed together: cells shared by regions are read once
    tables = dask.compute(*([plane.isel(window).data for plane in planes] for window in windows))
    return [
        _once(place, window, *table) for place, window, table in zip(places, windows, tables, strict=True)
    ]


def _window(place: Pixels, reach: int) -> dict[str, slice]:
    if not place[0].size:
        return {ALONG_TRACK: slice(0, 0), CROSS_TRACK: slice(0, 0)}
    return {
        dim: slice(max(0, int(axis.min()) - reach), int(axis.max()) + reach + 1)
        for dim, axis in zip((ALONG_TRACK, CROSS_TRACK), place, strict=True)
    }


def _once(
    place: Pixels,
    window: dict[str, slice],
    line: np.ndarray,
    sample: np.ndarray,
    at_line: np.ndarray,
    at_sample: np.ndarray,
    of_line: np.ndarray | None = None,
) -> Shown:
    # Every pixel once, from the cells of a window (row, col) that lie in a region.
    # In a map of several flight lines, the same line and column are a different pixel of each flight line.
    corner = window[ALONG_TRACK].start, window[CROSS_TRACK].start
    inside = np.zeros(line.shape, bool)
    inside[place[0] - corner[0], place[1] - corner[1]] = True
    row, col = np.nonzero(line >= 0)
    along, across = line[row, col].astype(np.int64), sample[row, col].astype(np.int64)
    away = np.hypot(at_line[row, col] - along, at_sample[row, col] - across)
    # pixels in the order of the flight line, of each the nearest cell first
    keys = [across, along] if of_line is None else [across, along, of_line[row, col].astype(np.int64)]
    order = np.lexsort((away, *keys))
    pixel = np.stack([key[order] for key in keys])
    first = np.r_[True, (np.diff(pixel, axis=1) != 0).any(axis=0)] if order.size else np.zeros(0, bool)
    nearest = order[first]
    nearest = nearest[inside[row[nearest], col[nearest]]]
    cells = row[nearest] + corner[0], col[nearest] + corner[1]
    return Shown(cells, (along[nearest], across[nearest]), None if of_line is None else keys[2][nearest])


def middle_of_map(line: xr.Dataset) -> tuple[float, float] | None:
    """Return latitude and longitude of the middle of a map [degree]; None for a flight line, or unknown."""
    mapping = line["spatial_ref"].attrs if "spatial_ref" in line.variables else {}
    axes = [line.variables.get(name) for name in ("x", "y")]
    wkt = mapping.get("crs_wkt") or mapping.get("spatial_ref")
    if wkt is None or "GeoTransform" not in mapping:
        return None
    if all(axis is not None and axis.ndim == 1 for axis in axes):
        middle = [float(np.mean(axis.values)) for axis in axes if axis is not None]
    else:
        a, b, c, d, e, f = map(float, str(mapping["GeoTransform"]).split())
        col, row = line.sizes[CROSS_TRACK] / 2, line.sizes[ALONG_TRACK] / 2
        middle = [a + b * col + c * row, d + e * col + f * row]
    # only the position of the sun depends on it, which is then unknown
    with contextlib.suppress(MissingExtraError, SchemaError):
        ((longitude, latitude),) = between_maps(np.array([middle]), crs_of(wkt), "EPSG:4326").tolist()
        return latitude, longitude
    return None


#: Variables of a line that turn its camera.
ATTITUDE = ("roll", "pitch", "heading")

_PIXELS = ("view_zenith", "view_azimuth")
_LEVEL = (0.0, 0.0, 0.0)
#: Horizontal part of a direction below which it has no azimuth, 0.2 arc seconds.
MIN_HORIZONTAL_PART = 1e-6


class Viewing:
    """Directions of view of a flight line.

    ``view_zenith`` and ``view_azimuth`` of pixels (along_track, cross_track) take precedence over
    ``look_across``, or else ``look_angle`` (cross_track), with `ATTITUDE` (along_track) [degree], in the
    declared convention of the line and with its ``boresight``. ``planes`` and ``lines`` are the variables of
    pixels and lines, ``look`` and ``ahead`` (cross_track,) the look angles across and along the track
    [degree], None where not needed; ``description`` names the source of the directions, or why they are
    unknown, with unusable variables, which raise no error.
    """

    def __init__(self, line: xr.Dataset) -> None:
        look_names = ("look_across", "look_along", "look_angle")
        names = [name for name in (*_PIXELS, *look_names, *ATTITUDE) if name in line.variables]
        variables, faults = schema.find(line, names)
        problems = [fault.text() for fault in faults]
        self.planes: dict[str, xr.DataArray] = {}
        self.lines: dict[str, xr.DataArray] = {}
        self.look: Floats | None = None
        self.ahead: Floats | None = None
        self.boresight: tuple[float, ...] = tuple(map(float, line.attrs.get("boresight", _LEVEL)))
        #: Convention of roll, pitch and heading [degree]; None where they need no conversion
        self.convention = _declared(line, problems)
        look = next((name for name in ("look_across", "look_angle") if name in variables), None)
        if "view_zenith" in variables:
            self.planes = {name: variables[name] for name in _PIXELS if name in variables}
            self.description = " and ".join(self.planes) + " of the pixels"
        elif look is not None and {"roll", "pitch"} <= set(variables):
            self.look = variables[look].values.astype(np.float64)
            if "look_along" in variables:
                self.ahead = variables["look_along"].values.astype(np.float64)
            self.lines = {name: variables[name] for name in ATTITUDE if name in variables}
            turn = ", ".join(f"{angle:g}" for angle in self.boresight)
            mounting = f"boresight {turn}" if any(self.boresight) else "no angle between camera and platform"
            self.description = "; ".join([f"{look} with {', '.join(self.lines)}", mounting, *problems])
        else:
            missing = [name for name in ("look_angle", "roll", "pitch") if name not in variables]
            reason = f"not known: no view_zenith of the pixels, and no {', '.join(missing)}"
            self.description = "; ".join([reason, *problems])


def mean_view(
    viewing: Viewing, pixels: Mapping[str, Array], lines: Mapping[str, Array], across: Array
) -> tuple[float, float]:
    r"""Return zenith angle and azimuth of the mean direction to the camera [degree], NaN where unknown.

    Takes ``viewing`` of the line; ``pixels``, ``lines`` (pixel,): its variables at the pixels, and at their
    lines; ``across`` (pixel,): columns.

    Notes
    -----
    With roll :math:`\phi` (right side down), pitch :math:`\theta` (nose up) and heading (clockwise from
    north), a column of look angle :math:`\alpha` sees along

    .. math:: R_z(heading) \, R_y(\theta) \, R_x(\phi) \, (0, \sin\alpha, \cos\alpha)^T

    in north, east and down, with the turn by the boresight before :math:`R_x` where there is one; the camera
    is in the opposite direction. Directions are averaged as unit vectors, so that pixels on both sides of the
    nadir are seen from above. Without azimuths the zenith angle is the plain mean.
    """
    if viewing.planes:
        zenith = pixels["view_zenith"].astype(np.float64)
        azimuth = pixels.get("view_azimuth", np.full(zenith.shape, np.nan)).astype(np.float64)
    elif viewing.look is not None:
        attitude = _canonical(viewing.convention, lines)
        ahead = None if viewing.ahead is None else viewing.ahead[across]
        zenith, azimuth = _from_attitude(viewing.look[across], ahead, viewing.boresight, *attitude)
    else:
        return np.nan, np.nan
    is_finite = np.isfinite(zenith)
    zenith, azimuth = zenith[is_finite], azimuth[is_finite]
    if not zenith.size:
        return np.nan, np.nan
    away = np.sin(np.radians(zenith))
    if not (np.isfinite(azimuth) | (away < MIN_HORIZONTAL_PART)).all():
        return float(zenith.mean()), np.nan
    angle = np.radians(np.where(np.isfinite(azimuth), azimuth, 0.0))
    north, east = float((away * np.cos(angle)).mean()), float((away * np.sin(angle)).mean())
    level = np.hypot(north, east)
    mean_zenith = float(np.degrees(np.arctan2(level, np.cos(np.radians(zenith)).mean())))
    mean_azimuth = float(np.degrees(np.arctan2(east, north)) % 360.0)
    return mean_zenith, mean_azimuth if level > MIN_HORIZONTAL_PART else np.nan


def _declared(line: xr.Dataset, problems: list[str]) -> Convention | None:
    # Angle convention of a line, in degrees; None where it is canonical or undeclared
    try:
        declared = Convention.from_attrs(line.attrs)
    except SchemaError as error:
        problems.append(str(error))
        return None
    if declared is None:
        return None
    # the variables were converted to degrees before
    declared = declared.replace(angle_unit="degree", height_reference="ellipsoid", geoid_undulation=None)
    return None if declared == declared.of_canonical else declared


def _canonical(convention: Convention | None, lines: Mapping[str, Array]) -> list[Floats]:
    # Roll (right wing down), pitch (nose up) and heading from true north (pixel,) [degree].
    # Headings are NaN where their reference north is unknown.
    roll, pitch = lines["roll"], lines["pitch"]
    heading = lines.get("heading", np.full(roll.shape, np.nan))
    if convention is None:
        return [roll, pitch, heading]
    convergence = None
    if convention.heading_reference == "grid" and {"latitude", "longitude"} <= set(lines):
        convergence = _convergence(convention, lines)
    is_known = np.isfinite(heading) & (convention.heading_reference != "grid" or convergence is not None)
    is_known &= convention.heading_reference != "magnetic" or convention.declination is not None
    if not is_known.all():
        # the zenith angle does not depend on the heading where that is the first rotation
        unreferenced = convention.replace(heading_reference="true")
        first = convention.euler_order.startswith("Z")
        whole = unreferenced.canonical(
            roll, pitch, np.where(np.isfinite(heading), heading, 0.0 if first else np.nan)
        )
        return [whole[0], whole[1], np.full(roll.shape, np.nan)]
    return list(convention.canonical(roll, pitch, heading, convergence=convergence))


def _convergence(convention: Convention, lines: Mapping[str, Array]) -> Floats | None:
    # Grid north, east of true north (pixel,) [degree]; None where the map is unknown
    if convention.grid_crs is None:
        return None
    with contextlib.suppress(MissingExtraError, SchemaError):
        return meridian_convergence(lines["latitude"], lines["longitude"], convention.grid_crs)
    return None


def _from_attitude(
    look: Array,
    along: Array | None,
    boresight: tuple[float, ...],
    roll: Array,
    pitch: Array,
    heading: Array,
) -> tuple[Floats, Floats]:
    # Zenith angle and azimuth of the direction to the camera [degree]; see `mean_view`.
    # `look` and `along` are angles of the line of sight in the camera's frame, across and along the track.
    if along is not None or any(boresight):
        sight = directions(look, np.zeros(look.shape) if along is None else along)
        level = np.zeros(roll.shape)
        turn = matrices(quaternions(roll, pitch, level)) @ matrices(quaternions(*boresight))
        north, east, down = np.einsum("pij,pj->ip", turn, sight)
        zenith = np.degrees(np.arctan2(np.hypot(north, east), down))
        return zenith, (np.degrees(np.arctan2(-east, -north)) + heading) % 360.0
    # roll turns the line of sight within the plane that look angles are in
    side, tilt = np.radians(look.astype(np.float64) - roll), np.radians(pitch.astype(np.float64))
    ahead, right = np.sin(tilt) * np.cos(side), np.sin(side)
    down = np.cos(tilt) * np.cos(side)
    zenith = np.degrees(np.arctan2(np.hypot(ahead, right), down))
    return zenith, (np.degrees(np.arctan2(-right, -ahead)) + heading) % 360.0


def relative_azimuth(first: float, second: float) -> float:
    """Return the angle between two azimuths, 0 to 180 [degree].

    Examples
    --------
    >>> relative_azimuth(350.0, 20.0)
    30.0
    """
    return abs((first - second + 180.0) % 360.0 - 180.0)


#: Method of `hyperpaint.radiometry.smooth`, or its arguments by name; None smooths nothing.
Smoothing = str | Mapping[str, Any] | None

_NOISE_KNOWN = {"counts", "electrons_per_count", "read_noise"}
_SMALL = ("time", "latitude", "longitude", "irradiance_age")


class SplitOfLines(NamedTuple):
    """Division of the light of each line into direct and diffuse."""

    fraction: Floats  # (along_track, band), diffuse part [1]
    u: Floats  # (along_track, band), its standard uncertainty [1]
    state: Array  # (along_track,), number of the sky's word

    def mean(self, lines: Array) -> dict[str, Any]:
        """Return the mean over some lines, with the spread in its uncertainty, and the most frequent sky."""
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
    """Everything that signatures use of one flight line."""

    line: xr.Dataset  #: The line itself, dims named by role.
    #: ``reflectance`` at nominal wavelengths, and its uncertainties where known, lazy. With separate sources
    #: of error their sum is left out, and the original reflectance may follow as ``measured``.
    cubes: dict[str, xr.DataArray]
    #: Variables of pixels and of lines.
    planes: dict[str, xr.DataArray]
    small: dict[str, xr.DataArray]
    viewing: Viewing  #: Directions of view of its pixels.
    #: (band,), float64 [nm]; NaN where the width is unknown.
    wavelength: Floats
    fwhm: Floats
    good: Bools  #: (band,)
    light: SplitOfLines | None  #: Division of the light of each line; None where undeclared.
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
    """Return the data of a flight line that signatures use; no cube is computed.

    Raises `SchemaError`, `UnitsError`: reflectance is missing and cannot be computed; it is smoothed already,
    or the mirrored sky removed; or the position of the sun is unknown.
    """
    line = schema.rename_to_roles(line)
    middle = middle_of_map(line)
    if "reflectance" not in line.variables:
        line = reflectance(line, uncertainty=set(line.variables) >= _NOISE_KNOWN)
    names = ["reflectance", *(name for name in UNCERTAINTIES if name in line.variables)]
    # a map has values of every cell where a line has one a line
    of_cells = {
        name: line[stored_name].reset_coords(drop=True)
        for name, stored_name in (("time", "line_time"), ("irradiance_age", "irradiance_age"))
        if stored_name in line.variables and set(line[stored_name].dims) == {ALONG_TRACK, CROSS_TRACK}
    }
    optional = [
        name
        for name in ("quality", "fwhm", "good", *_SMALL)
        if name in line.variables and name not in of_cells
    ]
    variables = schema.require(line, [*names, "wavelength", *optional], "paint signatures")
    line = line.assign({name: variables[name] for name in names})
    before = variables["reflectance"].attrs.get("smoothing")
    # resampling to nominal wavelengths drops attributes; those of corrections are kept
    corrected = {
        key: variables["reflectance"].attrs[key]
        for key in CORRECTIONS
        if key in variables["reflectance"].attrs
    }
    declared = {
        key: str(variables["reflectance"].attrs[key])
        for key in ("mirror_reflection", "quantity")
        if key in variables["reflectance"].attrs
    }
    is_map = middle is not None or bool(of_cells) or "nearest_line" in line.variables
    errors = None if is_map or corrected or before is not None else line_errors(line)
    nominal = to_nominal(line)
    nominal = nominal.assign(reflectance=nominal["reflectance"].assign_attrs(corrected))
    if specular_sky:
        where = nominal.assign(
            {name: variables[name] for name in ("wavelength", *_SMALL) if name in variables}
            | {name: line[name].reset_coords(drop=True) for name in SPLIT if name in line.variables}
        )
        nominal = remove_mirrored_sky(where, sun_zenith=sun_zenith, diffuse=diffuse)
    light = _light_of(line, diffuse, sun_zenith, needed=specular_sky)
    filtering = None
    if smoothing is not None:
        if before is not None:
            raise SchemaError(
                f"the reflectance is smoothed already ({before})",
                mend="leave out smooth=",
                code="already-smoothed",
            )
        options = {"method": smoothing} if isinstance(smoothing, str) else dict(smoothing)
        nominal = smooth(nominal, **options)
        if errors is not None:
            good = variables["good"].values if "good" in variables else np.ones(line.sizes[BAND], bool)
            filtering = smoothing_matrix(good.astype(bool), options)
    cube = nominal["reflectance"]
    viewing = Viewing(line)
    size = cube.sizes[BAND]
    wavelength = variables["wavelength"].values.astype(np.float64)
    small = {**{name: variables[name] for name in _SMALL if name in variables}, **viewing.lines}
    if middle is not None:
        rows = np.ones(line.sizes[ALONG_TRACK])
        small |= {
            name: xr.DataArray(value * rows, dims=ALONG_TRACK)
            for name, value in zip(("latitude", "longitude"), middle, strict=True)
        }
    quality = {"quality": variables["quality"]} if "quality" in variables else {}
    axis = nominal_axis(line) if errors is not None and "wavelength_shift" in line.variables else None
    others = {name: variables[name] for name in names[1:] if errors is None or name != UNCERTAINTIES[1]}
    if errors is not None and (axis is not None or smoothing is not None or specular_sky):
        others["measured"] = variables["reflectance"]
    return Source(
        line=line,
        cubes={"reflectance": cube, **others},
        planes={**quality, **of_cells, **viewing.planes},
        small=small,
        viewing=viewing,
        wavelength=wavelength,
        fwhm=variables["fwhm"].values.astype(np.float64) if "fwhm" in variables else np.full(size, np.nan),
        good=variables["good"].values.astype(bool) if "good" in variables else np.ones(size, bool),
        light=light,
        smoothing=str(cube.attrs.get("smoothing", before or "none")),
        corrections={key: str(cube.attrs[key]) for key in CORRECTIONS if key in cube.attrs},
        components={name: str(line[name].attrs.get("components", NONE_KNOWN)) for name in names[1:]},
        errors=errors,
        axis=axis,
        filtering=filtering,
        declared=declared,
    )


def _light_of(
    line: xr.Dataset, diffuse: Any, sun_zenith: float | None, *, needed: bool
) -> SplitOfLines | None:
    # Division of the light of each line, in memory; None where the line does not declare it
    if not needed and (diffuse is None and not has_split(line)):
        return None
    with warnings.catch_warnings():  # remove_mirrored_sky has warned already
        warnings.simplefilter("ignore", PaintWarning)
        split = split_of(line, diffuse, sun_zenith)
    shape = {ALONG_TRACK: line.sizes[ALONG_TRACK], BAND: split.wavelength.size}
    state: Any = xr.DataArray(split.state, dims=()) if isinstance(split.state, int) else split.state
    parts = dask.compute(split.fraction.variable, split.u.variable, state.variable)
    fraction, u = (np.asarray(part.set_dims(shape).values, np.float64) for part in parts[:2])
    states = parts[2].set_dims({ALONG_TRACK: shape[ALONG_TRACK]}).values
    if needed and diffuse is None:
        warn_of_contradiction(states, split.zenith)
    return SplitOfLines(fraction, u, states.astype(np.int64))


def lines_of(line: Any, regions: Regions) -> dict[str, tuple[xr.Dataset, list[int]]]:
    """Return the flight lines that regions are on, located if needed, and the regions' positions on each.

    Raises `SchemaError`: a region names an unknown flight line, or none where there are several.
    """
    problems = Problems("regions cannot be found on their flight lines", SchemaError)
    lines_by_name = _by_name(line)
    only = next(iter(lines_by_name)) if len(lines_by_name) == 1 else None
    # a map of several lines may hold regions of each
    shown = () if only is None else lines_of_cells(schema.rename_to_roles(lines_by_name[only]))
    # a line without a name is taken for the one flight line of the regions
    nameless = only == "" and len(regions.flightlines) < 2 and not shown
    lines: dict[str, tuple[xr.Dataset, list[int]]] = {}
    for position, region in enumerate(regions):
        is_own = nameless or not region.flightline or region.flightline.replace(" ", "_") in shown
        wanted = only if only is not None and is_own else region.flightline
        if wanted in lines_by_name:
            if wanted not in lines:
                lines[wanted] = (located_for(regions, lines_by_name[wanted]), [])
            lines[wanted][1].append(position)
            continue
        names = " or ".join(map(repr, shown or lines_by_name)) or "no flight line"
        naming = f"is of flight line {region.flightline!r}" if region.flightline else "names no flight line"
        problems.add(f"region {region.name!r} {naming}", expected=names, code="flightline-unknown")
    problems.raise_if_any()
    return lines


def _by_name(line: Any) -> dict[str, xr.Dataset]:
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
        f"line is {type(line).__name__}",
        expected="a Dataset, several by name, or a DataTree of them",
        code="type-wrong",
    )
