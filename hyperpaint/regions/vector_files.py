"""Polygons of GeoPackage, Shapefile and FlatGeobuf as GeoJSON, through pyogrio, else fiona."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np

from hyperpaint.base.errors import FormatError, MissingExtraError
from hyperpaint.base.input_files import open_input

#: First bytes of a file by suffix. They are checked because pyogrio and fiona ignore the suffix, and some
#: formats of theirs open further files.
VECTOR_FILES = {".gpkg": b"SQLite format 3\0", ".shp": b"\0\0\x27\x0a", ".fgb": b"fgb"}

MAX_VECTOR_FILE_BYTES = 256 * 2**20


def features_of(path: Path, max_features: int) -> dict[str, Any]:
    """Return the polygons of a vector file as a FeatureCollection in coordinates of a map.

    At most ``max_features`` + 1 features are read, so that the caller can tell that there are too many.

    Raises `FormatError`: the file is damaged, of another format, without a crs, or has several layers of
    polygons; `MissingExtraError`: neither pyogrio nor fiona is installed.
    """
    magic = VECTOR_FILES[path.suffix.lower()]
    with open_input(path, "regions", MAX_VECTOR_FILE_BYTES) as file:
        if file.read(len(magic)) != magic:
            raise FormatError(
                f"{path}: not a {path.suffix[1:]} file", mend="check what the file is", code="file-kind-wrong"
            )
    installed = [name for name in ("pyogrio", "fiona") if importlib.util.find_spec(name)]
    if not installed:
        raise MissingExtraError(
            f"{path.suffix} files need pyogrio or fiona",
            mend="install it with: python -m pip install pyogrio, or save the layer as GeoJSON in QGIS",
            code="dependency-missing",
        )
    reader = _by_pyogrio if installed[0] == "pyogrio" else _by_fiona
    try:
        crs, features = reader(path, max_features)
    except (FormatError, MissingExtraError):
        raise
    except Exception as error:  # every driver of both libraries has its own errors
        raise FormatError(
            f"{path}: {installed[0]} cannot read it: {error!s:.200}", code="file-unreadable"
        ) from error
    if not crs:
        raise FormatError(
            f"{path}: the layer has no crs", mend="set the crs of the layer", code="crs-missing"
        )
    return {"type": "FeatureCollection", "coordinates": "map", "crs": crs, "features": features}


def _by_pyogrio(path: Path, max_features: int) -> tuple[str | None, list[dict[str, Any]]]:
    import pyogrio

    try:
        import shapely
    except ImportError as error:
        raise MissingExtraError(
            "polygons read by pyogrio need shapely",
            mend="install it with: python -m pip install shapely",
            code="dependency-missing",
        ) from error
    layers = [str(name) for name, geometry in pyogrio.list_layers(path) if geometry is not None]
    meta, _, shapes, columns = pyogrio.raw.read(
        path, layer=_single_layer(path, layers), max_features=max_features + 1
    )
    names = [str(name) for name in meta["fields"]]
    features = [
        {
            "type": "Feature",
            "geometry": None if shape is None else shapely.from_wkb(shape).__geo_interface__,
            "properties": {name: _plain(value) for name, value in zip(names, row, strict=True)},
        }
        for shape, *row in zip(shapes, *columns, strict=True)
    ]
    return meta["crs"], features


def _by_fiona(path: Path, max_features: int) -> tuple[str | None, list[dict[str, Any]]]:
    import fiona

    with fiona.open(path, layer=_single_layer(path, fiona.listlayers(path))) as layer:
        features = [
            {
                "type": "Feature",
                "geometry": feature.geometry and feature.geometry.__geo_interface__,
                "properties": {name: _plain(value) for name, value in feature.properties.items()},
            }
            for _, feature in zip(range(max_features + 1), layer, strict=False)
        ]
        return layer.crs.to_wkt() or None, features


def _single_layer(path: Path, layers: list[str]) -> str:
    # QGIS adds a layer with styles
    layers = [name for name in layers if name != "layer_styles"]
    if len(layers) != 1:
        names = ", ".join(map(repr, layers)) or "none"
        raise FormatError(
            f"{path}: layers {names}",
            expected="one",
            mend="save the layer with the regions alone",
            code="layer-ambiguous",
        )
    return layers[0]


def _plain(value: Any) -> Any:
    # JSON value of a property; NaN becomes None
    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, float) and value != value:
        return None
    return value if value is None or isinstance(value, str | int | float | bool) else str(value)
