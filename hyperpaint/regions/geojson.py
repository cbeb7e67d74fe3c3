"""Regions in GeoJSON (RFC 7946): a FeatureCollection of polygons, one Feature a line of text.

Two members beyond the format define the coordinates: ``"coordinates": "sensor"`` or ``"map"``, and ``"crs"``
as in GeoJSON before 2016. Without either they are sensor coordinates.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hyperpaint.base.errors import FormatError, PaintError, Problems, SchemaError
from hyperpaint.base.facts import documented, is_number, one_of
from hyperpaint.base.input_files import is_plain_file, read_limited
from hyperpaint.io.files.publishing import publish_file

from .outlines import COORDINATES, Region, Regions
from .vector_files import VECTOR_FILES, features_of

#: Maximum size of a regions file [byte]; a thousand regions with a hundred corners take 4 MB.
MAX_FILE_BYTES = 16 * 2**20

MAX_REGIONS = 10_000

#: Maximum numbers of JSON lists and objects, and of commas; they bound the memory of the parsed document.
MAX_CONTAINERS = 500_000
MAX_SEPARATORS = 1_500_000
MAX_LISTED_FEATURES = 20


def read_regions(path: str | os.PathLike[str]) -> Regions:
    """Return the regions of a GeoJSON file, or of a GeoPackage, Shapefile or FlatGeobuf.

    Parameters
    ----------
    path
        The file; formats other than GeoJSON need pyogrio or fiona, and are in coordinates of a map. Features
        are polygons with a property ``name``, and ``flightline`` where the collect has several; all other
        properties are kept, other members of features are not.

    Returns
    -------
    Regions

    Raises
    ------
    FormatError
        The file is not GeoJSON, or some features are no regions; all of these are listed.
    MissingExtraError
        Neither pyogrio nor fiona is installed.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "regions.geojson"
    >>> path = write_regions(Regions((Region("hood", [(0, 0), (9, 0), (9, 5)]),)), path)
    >>> read_regions(path).names
    ('hood',)
    """
    file = Path(path)
    if "\0" in str(file):
        raise FormatError(
            f"the path {file!s:.200} holds a NUL character", mend="check the path", code="path-invalid"
        )
    if file.suffix.lower() in VECTOR_FILES:
        return _collection(features_of(file, MAX_REGIONS), str(file))
    raw = read_limited(file, MAX_FILE_BYTES, "GeoJSON")
    if raw.count(b"[") + raw.count(b"{") > MAX_CONTAINERS or raw.count(b",") > MAX_SEPARATORS:
        raise FormatError(
            f"{file}: more values than {MAX_REGIONS} regions have",
            expected="GeoJSON of regions",
            code="file-too-large",
        )
    try:
        text = raw.decode("utf-8-sig")
        document = json.loads(text, object_pairs_hook=_object, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        reason = "nested too deep" if isinstance(error, RecursionError) else str(error)
        raise FormatError(
            f"{file}: not GeoJSON ({reason:.200})",
            expected="a FeatureCollection of polygons in UTF-8",
            code="text-unreadable",
        ) from error
    return _collection(document, str(file))


@documented()
def write_regions(
    regions: Regions | Iterable[Region], path: str | os.PathLike[str], *, overwrite: bool = False
) -> Path:
    """Write regions as GeoJSON.

    Equal regions give equal bytes, and `read_regions` returns equal regions.

    Parameters
    ----------
    regions
        Regions to write.
    path
    overwrite
        Replace a file with other content.

    Returns
    -------
    Path of the file.

    Raises
    ------
    StoreError
        The file has other content, or cannot be written. It is unchanged.

    Examples
    --------
    >>> import tempfile
    >>> from hyperpaint.regions import Region
    >>> hood = Region("hood", [(0, 0), (4, 0), (4, 3), (0, 3)])
    >>> path = write_regions([hood], Path(tempfile.mkdtemp(), "regions.geojson"))
    >>> [region.name for region in read_regions(path)]
    ['hood']
    """
    file = Path(path)
    document = regions_from(regions).__geo_interface__
    features = document.pop("features")
    head = [f"{_json(key)}: {_json(value)}," for key, value in document.items()]
    lines = ",\n".join(_json(feature) for feature in features)
    content = "\n".join(["{", *head, '"features": [', *([lines] if lines else []), "]", "}", ""]).encode()
    is_same = is_plain_file(file) and file.stat().st_size == len(content) and file.read_bytes() == content
    publish_file(file, content, overwrite=overwrite or is_same)
    return file


def regions_from(source: Any) -> Regions:
    """Return regions from any of their forms.

    Parameters
    ----------
    source
        `Regions`, several `Region`, a path of a GeoJSON file, its content as a mapping, or an object with
        ``__geo_interface__``, as of geopandas.

    Returns
    -------
    Regions

    Raises
    ------
    FormatError
        A file or mapping is not GeoJSON of regions.
    SchemaError
        The object has another type, or names occur twice.

    Examples
    --------
    >>> from hyperpaint.regions import Region
    >>> hood = Region("hood", [(0, 0), (4, 0), (4, 3), (0, 3)])
    >>> regions_from([hood]).coordinates
    'sensor'
    """
    if isinstance(source, Regions):
        return source
    if isinstance(source, str | os.PathLike):
        return read_regions(source)
    if isinstance(source, Region):
        return Regions((source,))
    if isinstance(source, Mapping) or hasattr(source, "__geo_interface__"):
        document = source if isinstance(source, Mapping) else source.__geo_interface__
        return _collection(document, "these regions")
    if isinstance(source, Iterable):
        members = tuple(source)
        if all(isinstance(member, Region) for member in members):
            return Regions(members)
    raise SchemaError(
        f"regions are {type(source).__name__}",
        expected="hyperpaint.Regions, the path of a GeoJSON file, or its content",
        code="type-wrong",
    )


def _json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    mapping = dict(pairs)
    if len(mapping) < len(pairs):
        raise ValueError("a member occurs twice in the same object")
    return mapping


def _no_constant(text: str) -> None:
    raise ValueError(f"{text} is not a JSON number")


# --- content of a document ---------------------------------------------------------------------------------


def _collection(document: Any, subject: str) -> Regions:
    problems = Problems(f"{subject} cannot be read as regions", FormatError)
    features = _features(document, problems)
    crs = _crs(document, problems) if isinstance(document, Mapping) else None
    declared = document.get("coordinates") if isinstance(document, Mapping) else None
    coordinates = ("sensor" if crs is None else "map") if declared is None else declared
    one_of(coordinates, COORDINATES, "coordinates", problems=problems)
    problems.raise_if_any()
    regions, invalid_features = [], 0
    for number, feature in enumerate(features):
        try:
            regions.append(_region(feature))
        except PaintError as error:
            invalid_features += 1
            if invalid_features <= MAX_LISTED_FEATURES:
                problems.add_error(f"feature {number}", error)
    if invalid_features > MAX_LISTED_FEATURES:
        problems.add(
            f"{invalid_features - MAX_LISTED_FEATURES} more features are invalid", code="features-invalid"
        )
    problems.raise_if_any()
    try:
        return Regions(tuple(regions), coordinates, crs)
    except SchemaError as error:
        raise FormatError(subject, problems=[error.problem]) from error


def _features(document: Any, problems: Problems) -> list[Any]:
    geojson_type = document.get("type") if isinstance(document, Mapping) else None
    if geojson_type == "Feature":
        return [document]
    features = document.get("features") if geojson_type == "FeatureCollection" else None
    if not isinstance(features, list | tuple):
        description = (
            f"type {geojson_type!r:.80}" if isinstance(document, Mapping) else type(document).__name__
        )
        problems.add(description, expected="a FeatureCollection with a list of features", code="type-wrong")
        return []
    if len(features) > MAX_REGIONS:
        problems.add(
            f"{len(features)} features",
            expected=f"at most {MAX_REGIONS}",
            mend="split the file",
            code="regions-too-many",
        )
        return []
    return list(features)


def _crs(document: Mapping[str, Any], problems: Problems) -> str | None:
    crs = document.get("crs")
    if isinstance(crs, Mapping):
        inner = crs.get("properties")
        crs = inner.get("name") if isinstance(inner, Mapping) else None
    elif crs is None:
        return None
    if isinstance(crs, str) and 0 < len(crs) <= 10_000 and crs.isprintable():
        return crs
    problems.add(
        "the crs has no name",
        expected="text such as 'EPSG:32618', or an object with properties.name",
        code="crs-missing",
    )
    return None


def _region(feature: Any) -> Region:
    if not isinstance(feature, Mapping) or feature.get("type") != "Feature":
        raise SchemaError(type(feature).__name__, expected="a Feature", code="type-wrong")
    properties = feature.get("properties")
    properties = dict(properties) if isinstance(properties, Mapping) else {}
    name, flightline = properties.pop("name", None), properties.pop("flightline", None)
    if name is None:
        raise SchemaError("no property 'name', which names the paint", code="region-name-missing")
    polygon, *holes = _rings(feature.get("geometry"), name)
    return Region(name, polygon, tuple(holes), "" if flightline is None else flightline, properties)


def _rings(geometry: Any, name: Any) -> list[Any]:
    geometry_type = geometry.get("type") if isinstance(geometry, Mapping) else None
    rings = geometry.get("coordinates") if isinstance(geometry, Mapping) else None
    subject = f"region {str(name)[:80]!r} has a geometry of type {str(geometry_type)[:40]!r}"
    # many programs write a single polygon as a MultiPolygon
    if geometry_type == "MultiPolygon" and isinstance(rings, list | tuple):
        if len(rings) != 1:
            raise SchemaError(
                f"{subject} with {len(rings)} polygons",
                expected="one",
                mend="make each a region with its own name",
                code="geometry-wrong",
            )
        geometry_type, rings = "Polygon", rings[0]
    if geometry_type != "Polygon":
        raise SchemaError(subject, expected="a Polygon", code="geometry-wrong")
    if not isinstance(rings, list | tuple) or not rings:
        raise SchemaError(f"{subject} without a list of rings", code="geometry-wrong")
    for position in (
        corner for ring in rings for corner in (ring if isinstance(ring, list | tuple) else [ring])
    ):
        if (
            not isinstance(position, list | tuple)
            or len(position) < 2
            or not all(map(is_number, position[:2]))
        ):
            raise SchemaError(
                f"{subject} with a corner {position!r:.60}", expected="[x, y]", code="corner-wrong"
            )
    # a third coordinate, the height, is ignored
    return [np.array([corner[:2] for corner in ring], np.float64).reshape(-1, 2) for ring in rings]
