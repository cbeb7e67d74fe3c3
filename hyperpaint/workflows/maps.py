"""Maps and mosaics of the flight lines of a store, and their files."""

import inspect
import json
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import xarray as xr

from hyperpaint.base import Convention, PaintError, Progress, SchemaError, part_of, warn_user
from hyperpaint.geometry.georeference.locating import PinholeCamera
from hyperpaint.geometry.mosaicking.composing import mosaic, seamlines
from hyperpaint.geometry.orthorectification.mapping import orthorectify
from hyperpaint.io.files.publishing import check_place, published_files
from hyperpaint.io.maps.map_grids import (
    CACHE_BYTES,
    RASTER_FORMATS,
    RGB_WAVELENGTHS,
    draw_geotiff,
    geozarr_attrs,
    nearest_bands,
    read_heights,
    stac_item,
    with_own_transform,
)
from hyperpaint.io.store import budget, list_groups, open_store, to_store
from hyperpaint.surroundings.scratch import survey_planned
from hyperpaint.surroundings.surveying import flag_line, is_flagged

#: Prefix of the groups of flight lines.
LINES = "flightlines/"


def lines_of_store(store: str | os.PathLike[str]) -> list[str]:
    # Return the names of the flight lines of a store.
    return [group.removeprefix(LINES) for group in list_groups(store) if group.startswith(LINES)]


def map_of_store(
    store: Path,
    line: str | None,
    *,
    flags: bool | None = False,
    progress: Progress | None = None,
    **options: Any,
) -> xr.Dataset:
    # Return the map of a flight line of a store, lazily.
    #
    # ``flags``: whether glint, shadow, light of neighbours and mixed edges of an unflagged line are flagged
    # first; with None, a line that cannot be flagged is mapped with a warning. ``options`` are those of
    # `location_of`, and of `hyperpaint.geometry.orthorectify`.
    #
    # Raises `SchemaError` if the store lacks the line, or has several and ``line`` is None; if options are
    # passed for a line that is located; or as `location_of`.
    flightline = line_of_store(store, line)
    location = location_of(flightline, **{name: options.pop(name) for name in LOCATION & set(options)})
    if flags is not False and not is_flagged(flightline):
        try:
            with survey_planned(flightline, "the survey of the line"):
                flightline = flag_line(flightline, progress=part_of(progress, 0, 2)).line
        except PaintError as error:
            if flags:
                raise
            warn_user(f"glint and shadow are not flagged on the map: {error}", "flags-not-searched")
        progress = part_of(progress, 1, 2)
    return orthorectify(flightline, progress=progress, **options, **location)


def location_of(
    flightline: xr.Dataset,
    *,
    ground: float | None = None,
    dem: Path | None = None,
    dem_heights: Literal["ellipsoid", "geoid"] | None = None,
    geoid: float | None = None,
    field_of_view: float | None = None,
    focal_length_mm: float | None = None,
    pixel_pitch_um: float | None = None,
    column_order: Literal["left_to_right", "right_to_left"] | None = None,
    boresight: tuple[float, float, float] | None = None,
    lever_arm: tuple[float, float, float] | None = None,
    clock_offset: float | None = None,
    crs: str | None = None,
) -> dict[str, Any]:
    """Return arguments of `hyperpaint.geometry.locate` from numbers and paths of the command line.

    Parameters
    ----------
    flightline
        The line to be located.
    ground
        Height of level ground above the ellipsoid [m].
    dem
        Raster of heights, instead of ``ground``.
    dem_heights
        Surface that the heights of ``dem`` are above.
    geoid
        Height of the geoid above the ellipsoid at the site [m].
    field_of_view
        Angle between the outer edges of the columns [degree].
    focal_length_mm
        Focal length [mm]; with ``pixel_pitch_um`` instead of ``field_of_view``.
    pixel_pitch_um
        Distance of the columns on the detector [um].
    column_order
        Order of the columns, looking along the flight.
    boresight
        Roll, pitch and heading of the camera in the body [degree].
    lever_arm
        Position of the camera from the antenna: forward, right, down [m].
    clock_offset
        Time added to the line times [s].
    crs
        CRS of the map, such as EPSG:32618; by default the UTM zone of the line.

    Raises
    ------
    SchemaError
        ``column_order`` for a line without a convention; or the height reference of ``dem`` is unknown.
    FormatError
        ``dem`` cannot be read.
    MissingExtraError
        ``dem`` needs rasterio (extra ``geo``).
    """
    location: dict[str, Any] = {
        "ground": ground,
        "boresight": boresight,
        "lever_arm": lever_arm,
        "crs": crs,
        "clock_offset_s": clock_offset,
    }
    if dem is not None:
        names = ("longitude", "latitude", "altitude")
        is_flown = set(names) <= set(flightline.variables)
        track: Any = tuple(flightline[name].values for name in names) if is_flown else None
        references = {"height_reference": dem_heights, "geoid_undulation": geoid}
        heights = read_heights(dem, track).assign_attrs(
            {name: value for name, value in references.items() if value is not None}
        )
        SchemaError.raise_if(
            "height_reference" not in heights.attrs,
            f"the height reference of {dem} is unknown (most DEMs are above the geoid)",
            mend="pass dem_heights='ellipsoid', or dem_heights='geoid' with geoid=, its height there [m]",
            option="pass --set dem_heights=ellipsoid, or --set dem_heights=geoid with --set geoid=METRES",
            code="height-reference-missing",
        )
        location["dem"] = heights
    if (field_of_view, focal_length_mm, pixel_pitch_um) != (None, None, None):
        location["camera"] = PinholeCamera(
            flightline.sizes["cross_track"],
            pixel_pitch=None if pixel_pitch_um is None else 1e-6 * pixel_pitch_um,
            focal_length=None if focal_length_mm is None else 1e-3 * focal_length_mm,
            field_of_view=field_of_view,
            edges=None if field_of_view is None else "outer",
        )
    if column_order is not None:
        convention = SchemaError.raise_if_none(
            Convention.from_attrs(flightline.attrs),
            "the store does not declare the signs of angles and the height reference of its line",
            mend=(
                "declare roll_positive, pitch_positive, heading_positive, heading_reference, "
                "euler_order and height_reference in [navigation] of collect.toml and process again"
            ),
            code="convention-missing",
        )
        location["convention"] = convention.replace(column_order=column_order)
    return {name: value for name, value in location.items() if value is not None}


#: Names of the options of `location_of`.
LOCATION = frozenset(inspect.signature(location_of).parameters) - {"flightline"}


def mosaic_of_store(store: Path, names: Sequence[str], **options: Any) -> xr.Dataset:
    # Return the mosaic of flight lines of a store, by default of all; options as of `mosaic`.
    #
    # Raises `SchemaError` if the store has no named flight lines, or lacks one of ``names``.
    stored = lines_of_store(store)
    absent = [name for name in names if name not in stored]
    SchemaError.raise_if(
        absent or not stored,
        f"{store} has no {', '.join(absent) or 'named line'}",
        expected=f"flight lines {', '.join(stored) or 'none'}",
        code="flightline-unknown",
    )
    lines = {name: open_store(store, f"{LINES}{name}") for name in names or stored}
    location = {name: options.pop(name) for name in LOCATION & set(options)}
    # all lines were flown with the same camera
    return mosaic(lines, **options, **location_of(next(iter(lines.values())), **location))


def write_map(
    orthomap: xr.Dataset,
    path: Path,
    *,
    stac: bool = False,
    seams: Path | None = None,
    colours: Path | None = None,
    geozarr: bool = False,
    overwrite: bool = False,
    progress: bool = False,
) -> str:
    """Write a map as GeoTIFF with overviews, or with all its variables as a Zarr store, by the suffix.

    Parameters
    ----------
    orthomap
        A map or mosaic.
    path
        File (.tif) or store (.zarr).
    stac
        Write a STAC item beside the map, ``<name>.json``.
    seams
        GeoJSON file for the area that each line of a mosaic shows.
    colours
        GeoTIFF for a picture of the map in true colours, 8 bits with transparency, beside a GeoTIFF of all
        bands; a map without visible bands has none.
    geozarr
        Write the attributes of GeoZarr into the store.
    overwrite
        Replace an existing map.
    progress
        Show a progress bar.

    Returns
    -------
    Text about overviews and the files beside the map.

    Raises
    ------
    SchemaError
        The map has no time or place for a STAC item.
    StoreError
        ``path`` exists.
    MissingExtraError
        A GeoTIFF needs rasterio (extra ``geo``).
    """
    nm = orthomap["wavelength"].values if "wavelength" in orthomap.variables else ()
    if colours is not None and nearest_bands(nm, RGB_WAVELENGTHS) is None:
        colours = None
    item, is_file = path.with_suffix(".json"), path.suffix.lower() in RASTER_FORMATS
    companions = ([item] if stac else []) + [place for place in (seams, colours) if place is not None]
    if stac:
        check_place(item, "the STAC item", example="map.json", overwrite=overwrite)
    # A context in which the tiles of a map are computed within the memory limit.
    #
    # A thread holds the spectra of a tile, rotated and encoded. All threads share the flight lines' lines
    # below a row of tiles: for a flight to the north or east those of the row, for an oblique flight up to as
    # many as the map has columns. A file (``is_file``) is written through the cache of GDAL.
    #
    # Entering the context raises `StoreError` if memory does not suffice for one thread.
    cubes = [array for array in orthomap.data_vars.values() if array.chunks and "band" in array.dims]
    tile = max((math.prod(map(max, cube.chunks or ())) * cube.dtype.itemsize for cube in cubes), default=0)
    rows, cols = orthomap.sizes["y"], orthomap.sizes["x"]
    obliqueness = min(rows, cols) / max(rows, cols, 1)
    # a line is about a cell wide; computing its slab from counts takes twice the bytes
    shared = int(tile * (1.0 + obliqueness * min(rows, cols) / 256.0) * 2)
    cache = min(CACHE_BYTES, sum(cube.nbytes for cube in cubes)) if is_file else 0
    plan = budget.planned(str(path), a_thread=3 * tile, fixed=budget.LOADED + shared + cache)
    orthomap = with_own_transform(orthomap)
    if geozarr and not is_file:
        orthomap = orthomap.assign_attrs(geozarr_attrs(orthomap))
    if not is_file and not companions:
        with plan:
            to_store(orthomap, path, overwrite=overwrite, progress=progress)
        return ""
    notes = []

    def foreign(folder: Path) -> str:
        # empty for a store of one map, which may be replaced
        return "" if list_groups(folder) == [""] else "something other than a map"

    product = published_files([*companions, path], overwrite=overwrite, foreign=None if is_file else foreign)
    with plan, product as (*companion_paths, target):
        texts = [] if seams is None else [json.dumps(seamlines(orthomap))]
        if is_file:
            picture = None if colours is None else companion_paths.pop()
            reductions = draw_geotiff(orthomap, target, path, picture=picture)
            factors = ", ".join(f"1:{factor}" for factor in reductions)
            notes.append(f"overviews {factors}" if factors else "too small for overviews")
        else:
            to_store(orthomap, target, progress=progress)
            orthomap = open_store(target)
        if stac:
            texts.insert(0, json.dumps(stac_item(orthomap, path), indent=1, allow_nan=False))
            notes.append(f"STAC item {item}")
        for companion_path, text in zip(companion_paths, texts, strict=True):
            companion_path.write_text(text, encoding="utf-8")
    return ", ".join(notes)


def line_of_store(store: Path, line: str | None) -> xr.Dataset:
    # Return a flight line of a store by its name, by default the only one; or the map of a store.
    lines = lines_of_store(store)
    SchemaError.raise_if(
        not lines and line is not None,
        f"{store} has no flight line {line!r}, and no named flight lines",
        mend="pass line=None",
        option="leave out --line",
        code="flightline-unknown",
    )
    name = lines[0] if line is None and len(lines) == 1 else line
    SchemaError.raise_if(
        lines and name not in lines,
        f"{store} has {'several flight lines' if line is None else f'no flight line {line!r}'}",
        expected=f"one of {', '.join(map(repr, lines))}",
        mend="pass line=",
        option="pass --line",
        code="flightline-unknown",
    )
    return open_store(store, f"{LINES}{name}" if lines else "")
