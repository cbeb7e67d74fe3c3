"""Maps of the flight lines of a store, and their files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import SchemaError, needs_extra
from hyperpaint.geometry.georeference import PinholeCamera
from hyperpaint.geometry.orthorectification import orthorectify

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["map_of_store", "write_map"]


def map_of_store(
    store: Path,
    line: str | None,
    *,
    ground: float | None = None,
    dem: Path | None = None,
    dem_heights: str | None = None,
    geoid: float | None = None,
    field_of_view: float | None = None,
    focal_length_mm: float | None = None,
    pixel_pitch_um: float | None = None,
    column_order: Any = None,
    boresight: tuple[float, float, float] | None = None,
    lever_arm: tuple[float, float, float] | None = None,
    clock_offset: float | None = None,
    crs: str | None = None,
    **options: Any,
) -> xr.Dataset:
    """Return the map of a flight line of a store, lazily; options as of `hyperpaint.geometry.locate`.

    Raises `SchemaError`: the store has no such line, or several and none is named; options are given for a
    line that is located, or an order of columns for one without a convention; a DEM does not say what its
    heights are above. Raises `MissingExtraError`: a DEM needs rioxarray (extra ``geo``).
    """
    flightline = _line_of(store, line)
    location: dict[str, Any] = {"ground": ground, "boresight": boresight, "lever_arm": lever_arm, "crs": crs}
    location["clock_offset_s"] = clock_offset
    location["dem"] = None if dem is None else _heights(dem, dem_heights, geoid)
    if (field_of_view, focal_length_mm, pixel_pitch_um) != (None, None, None):
        location["camera"] = PinholeCamera(
            flightline.sizes["cross_track"],
            pixel_pitch=None if pixel_pitch_um is None else 1e-6 * pixel_pitch_um,
            focal_length=None if focal_length_mm is None else 1e-3 * focal_length_mm,
            field_of_view=field_of_view,
            edges=None if field_of_view is None else "outer",
        )
    if column_order is not None:
        convention = Convention.from_attrs(flightline.attrs)
        if convention is None:
            raise SchemaError(
                f"{store} does not declare what the angles and heights of its line mean, and makers differ: "
                "--column-order does not say it; declare roll_positive, pitch_positive, heading_positive, "
                "heading_reference, euler_order and height_reference in the table [navigation] of "
                "collect.toml and process the collect again"
            )
        location["convention"] = convention.replace(column_order=column_order)
    given = {name: value for name, value in location.items() if value is not None}
    return orthorectify(flightline, **options, **given)


def write_map(orthomap: xr.Dataset, path: Path, *, overwrite: bool = False, progress: bool = False) -> None:
    """Write a map as GeoTIFF, or all of it as a Zarr store, by the end of its name.

    Raises `StoreError`: the place is taken; `MissingExtraError`: a GeoTIFF needs rasterio (extra ``geo``).
    """
    if path.suffix.lower() in (".tif", ".tiff"):
        from hyperpaint.io.maps.geotiff import write_geotiff

        write_geotiff(orthomap, path, overwrite=overwrite)
        return
    from hyperpaint.io.store import to_store

    to_store(orthomap, path, overwrite=overwrite, progress=progress)


def _line_of(store: Path, line: str | None) -> xr.Dataset:
    from hyperpaint.io.store import list_groups, open_store

    prefix = "flightlines/"
    lines = [group.removeprefix(prefix) for group in list_groups(store) if group.startswith(prefix)]
    if not lines and line is not None:
        raise SchemaError(f"{store} holds no named flight lines, and there is no {line!r}; leave out --line")
    name = lines[0] if line is None and len(lines) == 1 else line
    if lines and name not in lines:
        held = ", ".join(map(repr, lines))
        asked = "give --line" if line is None else f"there is no {line!r}"
        raise SchemaError(f"{store} holds the flight lines {held}; {asked}")
    flightline: xr.Dataset = open_store(store, f"{prefix}{name}") if lines else open_store(store)
    return flightline


def _heights(path: Path, reference: str | None, undulation: float | None) -> xr.DataArray:
    with needs_extra("rioxarray", "geo", "opening a DEM"):
        import rioxarray
    dem: Any = rioxarray.open_rasterio(path, masked=True)
    references = {"height_reference": reference, "geoid_undulation": undulation}
    heights: xr.DataArray = dem.assign_attrs(
        {name: value for name, value in references.items() if value is not None}
    )
    if "height_reference" not in heights.attrs:
        raise SchemaError(
            f"{path} does not say what its heights are above, and most DEMs are above the geoid; give "
            "--dem-heights ellipsoid, or --dem-heights geoid with --geoid, the height of the geoid there [m]"
        )
    return heights
