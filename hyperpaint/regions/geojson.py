"""Regions: named polygons with properties, and their files in GeoJSON (RFC 7946), one Feature a line.

GeoPackage, Shapefile and FlatGeobuf are read through pyogrio, else fiona.

Two members beyond GeoJSON define the coordinates: ``"coordinates": "sensor"`` or ``"map"``, and ``"crs"``
as in GeoJSON before 2016. Without either they are sensor coordinates.
"""

from __future__ import annotations

import hashlib
import html
import importlib.util
import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, overload

import numpy as np

from hyperpaint.base.errors import FormatError, MissingExtraError, PaintError, Problems, SchemaError
from hyperpaint.base.facts import documented, is_number, one_of
from hyperpaint.base.input_files import is_plain_file, open_input, read_limited
from hyperpaint.base.schema import Floats
from hyperpaint.geometry.georeference.geodesy import crs_of
from hyperpaint.io.files.publishing import publish_file

#: Maximum size of a regions file [byte]; a thousand regions with a hundred corners take 4 MB.
MAX_FILE_BYTES = 16 * 2**20

MAX_REGIONS = 10_000

#: Maximum numbers of JSON lists and objects, and of commas; they bound the memory of the parsed document.
MAX_CONTAINERS = 500_000
MAX_SEPARATORS = 1_500_000
MAX_LISTED_FEATURES = 20

#: Coordinate systems of regions: column and line of the cube, or map coordinates on the ground.
COORDINATES = ("sensor", "map")

#: Maximum number of corners of a ring.
MAX_VERTICES = 10_000

#: Largest absolute coordinate; no pixel and no place on a map has a larger one.
MAX_COORDINATE = 1e9

MAX_NAME_CHARS = 200
MAX_DRAWN_REGIONS = 60
MAX_LISTED_REGIONS = 10
_COLOUR = re.compile("#[0-9a-fA-F]{6}")


@dataclass(frozen=True, eq=False)
class Region:
    """A named polygon.

    Attributes
    ----------
    name
        Name of the region, and of its paint.
    polygon : (vertex, 2), float64
        x (cross_track) and y (along_track) of its corners, whole numbers at pixel centres; or x and y on the
        map. The last corner is joined to the first.
    holes
        Rings cut out of it, as ``polygon``.
    flightline
        The flight line of the coordinates; empty where there is only one.
    properties
        Other facts about it: make, model, year, colour, finish, reference ... as JSON values.

    Raises
    ------
    SchemaError
        A name, ring or property cannot be used; all are listed.

    Examples
    --------
    >>> hood = Region("hood", [(10, 4), (20, 4), (20, 9), (10, 9)], properties={"colour": "red"})
    >>> hood.polygon.shape, hood.properties["colour"]
    ((4, 2), 'red')
    """

    name: str
    polygon: Floats
    holes: tuple[Floats, ...] = ()
    flightline: str = ""
    properties: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        problems = Problems(f"region {str(self.name)[:80]!r} cannot be used", SchemaError)
        for label in ("name", "flightline"):
            value = getattr(self, label)
            subject = f"{label} {str(value)[:80]!r}"
            if not isinstance(value, str):
                problems.add(f"{subject} is {type(value).__name__}", expected="text", code="type-wrong")
            elif not value and label == "name":
                problems.add(f"{subject} is empty", expected="text", code="region-name-missing")
            elif len(value) > MAX_NAME_CHARS:
                problems.add(
                    f"{subject} has {len(value)} characters",
                    expected=f"at most {MAX_NAME_CHARS}",
                    code="name-too-long",
                )
            elif not value.isprintable() or value.strip() != value:
                problems.add(
                    f"{subject} has blanks at an end, or characters that cannot be printed",
                    code="name-unprintable",
                )
        rings = [_ring(ring, index, problems) for index, ring in enumerate((self.polygon, *self.holes))]
        properties = _plain(self.properties, problems)
        problems.raise_if_any()
        object.__setattr__(self, "polygon", rings[0])
        object.__setattr__(self, "holes", tuple(rings[1:]))
        object.__setattr__(self, "properties", properties)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Region) and self.feature() == other.feature()

    def __hash__(self) -> int:
        return hash((self.name, self.flightline, self.polygon.tobytes()))

    def __repr__(self) -> str:
        line = f" on {self.flightline}" if self.flightline else ""
        holes = f", {len(self.holes)} holes" if self.holes else ""
        properties = "".join(
            f", {key}={str(value)[:40]!r}" for key, value in list(self.properties.items())[:4]
        )
        (left, low), (right, high) = self.polygon.min(axis=0), self.polygon.max(axis=0)
        box = f"x {left:.10g} to {right:.10g}, y {low:.10g} to {high:.10g}"
        return f"<Region {self.name!r}{line}: {len(self.polygon)} corners{holes}, {box}{properties}>"

    def feature(self) -> dict[str, Any]:
        """Return the region as a Feature of GeoJSON."""
        identity = {"name": self.name, **({"flightline": self.flightline} if self.flightline else {})}
        rings = [
            [[_number(x), _number(y)] for x, y in (*ring, ring[0])] for ring in (self.polygon, *self.holes)
        ]
        return {
            "type": "Feature",
            "properties": {**identity, **self.properties},
            "geometry": {"type": "Polygon", "coordinates": rings},
        }


@dataclass(frozen=True)
class Regions(Sequence[Region]):
    """An immutable sequence of regions with their coordinate system.

    Attributes
    ----------
    regions
        The regions; no two have the same name.
    coordinates
        "sensor": x is cross_track and y along_track, by their index coordinates where a line has them, which
        survive a crop, else counted from 0; or "map".
    crs
        Coordinate reference system of a map, such as ``"EPSG:32618"``; None where it is undeclared.

    Raises
    ------
    SchemaError
        Names occur twice, ``coordinates`` is unknown, or ``crs`` is no text or given for a sensor; all are
        listed.

    Examples
    --------
    >>> hood = Region("hood", [(0, 0), (4, 0), (4, 3), (0, 3)])
    >>> roof = Region("roof", [(6, 0), (9, 0), (9, 3), (6, 3)])
    >>> regions = Regions((hood, roof))
    >>> len(regions), [region.name for region in regions]
    (2, ['hood', 'roof'])
    """

    regions: tuple[Region, ...]
    coordinates: str = "sensor"
    crs: str | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "regions", tuple(self.regions))
        problems = Problems("these regions cannot be used together", SchemaError)
        names: set[str] = set()
        for name in (region.name for region in self.regions):
            problems.add_if(
                name in names,
                f"the name {name!r} occurs twice",
                mend="give each region its own name",
                code="region-name-duplicate",
            )
            names.add(name)
        one_of(self.coordinates, COORDINATES, "coordinates", problems=problems)
        crs: object = self.crs
        if crs is not None and not isinstance(crs, str):
            problems.add(
                f"the crs is {type(crs).__name__}", expected="text such as 'EPSG:32618'", code="type-wrong"
            )
        elif crs is not None and self.coordinates == "sensor":
            problems.add(
                f"sensor coordinates have the crs {crs[:80]!r}",
                expected="none",
                mend='pass coordinates="map" or no crs',
                code="option-conflict",
            )
        problems.raise_if_any()

    def __repr__(self) -> str:
        system = self.crs or self.coordinates
        lines = [f"  {region!r}" for region in self.regions[:MAX_LISTED_REGIONS]]
        if len(self) > MAX_LISTED_REGIONS:
            lines.append(f"  ... and {len(self) - MAX_LISTED_REGIONS} more")
        return "\n".join([f"<Regions: {len(self)} ({str(system)[:40]})>", *lines])

    def __len__(self) -> int:
        return len(self.regions)

    def __iter__(self) -> Iterator[Region]:
        return iter(self.regions)

    @overload
    def __getitem__(self, index: int) -> Region: ...
    @overload
    def __getitem__(self, index: slice) -> Regions: ...
    def __getitem__(self, index: int | slice) -> Region | Regions:
        if isinstance(index, slice):
            return Regions(self.regions[index], self.coordinates, self.crs)
        return self.regions[index]

    @property
    def names(self) -> tuple[str, ...]:
        """Name of every region, in order."""
        return tuple(region.name for region in self.regions)

    @property
    def flightlines(self) -> tuple[str, ...]:
        """Flight lines that the regions name, each once, in order."""
        return tuple(dict.fromkeys(region.flightline for region in self.regions if region.flightline))

    @property
    def __geo_interface__(self) -> dict[str, Any]:
        """The regions as a FeatureCollection of GeoJSON, as shapely and geopandas take it."""
        collection: dict[str, Any] = {"type": "FeatureCollection", "coordinates": self.coordinates}
        if self.crs is not None:
            collection["crs"] = {"type": "name", "properties": {"name": self.crs}}
        return {**collection, "features": [region.feature() for region in self.regions]}

    def _repr_html_(self) -> str:
        """Return the outlines with their names, for a notebook of either theme; texts are escaped."""
        system = self.crs or self.coordinates
        limit_note = f", of which {MAX_DRAWN_REGIONS} are shown" if len(self) > MAX_DRAWN_REGIONS else ""
        outlines = "".join(_drawn(region, self.coordinates) for region in self.regions[:MAX_DRAWN_REGIONS])
        title = f"{len(self)} regions ({system}){limit_note}"
        return (
            f'<div style="font:13px/1.45 system-ui,sans-serif"><strong>{html.escape(title)}</strong>'
            f'<div style="display:flex;flex-wrap:wrap;gap:2px 14px">{outlines}</div></div>'
        )

    @property
    def digest(self) -> str:
        """Digest of the content: equal digests mean equal regions."""
        return hashlib.sha256(json.dumps(self.__geo_interface__, sort_keys=True).encode()).hexdigest()[:32]


def _drawn(region: Region, coordinates: str) -> str:
    # HTML of a region: outline filled with its property `colour`, name, flight line
    rings = [np.asarray(ring, np.float64) for ring in (region.polygon, *region.holes)]
    low, high = rings[0].min(axis=0), rings[0].max(axis=0)
    scale = 20.0 / max((high - low).max(), 1e-12)
    # y of SVG points down, as sensor lines do; north of a map points up
    screen_signs = np.array([1.0, 1.0 if coordinates == "sensor" else -1.0])
    corners = [((ring - (low + high) / 2.0) * scale * screen_signs + 12.0).round(1) for ring in rings]
    step = max(1, len(corners[0]) // 100)
    path = "".join(f"M{' L'.join(f'{x:g},{y:g}' for x, y in ring[::step].tolist())}Z" for ring in corners)
    colour = str(region.properties.get("colour") or region.properties.get("color") or "none")
    fill = colour if _COLOUR.fullmatch(colour) else "none"
    title = " ".join(text for text in (region.name, region.flightline and f"({region.flightline})") if text)
    style = "width:24px;height:24px;vertical-align:middle"
    return (
        f'<span><svg viewBox="0 0 24 24" aria-hidden="true" style="{style}">'
        f'<path d="{path}" fill="{fill}" fill-rule="evenodd" stroke="currentColor"/></svg> '
        f"{html.escape(title)}</span>"
    )


def _number(value: float) -> int | float:
    integer = int(value)
    return integer if integer == value else float(value)


def _ring(ring: Any, index: int, problems: Problems) -> Floats:
    ring_name = "polygon" if index == 0 else f"hole {index}"
    try:
        corners = np.array(ring, np.float64)
    except (TypeError, ValueError):
        corners = np.empty((0,))
    if corners.ndim != 2 or corners.shape[1] != 2:
        problems.add(
            f"the {ring_name} has shape {corners.shape}",
            expected="(vertex, 2): x and y of its corners",
            code="dims-wrong",
        )
        return corners
    if len(corners) > 1 and (corners[0] == corners[-1]).all():
        corners = corners[:-1]
    problems.add_if(
        not 3 <= len(corners) <= MAX_VERTICES,
        f"the {ring_name} has {len(corners)} corners",
        expected=f"3 to {MAX_VERTICES}",
        code="corner-count",
    )
    problems.add_if(
        not (np.abs(corners) <= MAX_COORDINATE).all(),
        f"the {ring_name} has missing or too large coordinates",
        expected=f"numbers from {-MAX_COORDINATE:g} to {MAX_COORDINATE:g}",
        code="corner-wrong",
    )
    corners = corners + 0.0  # no negative zero
    corners.flags.writeable = False
    return corners


def _plain(properties: Any, problems: Problems) -> dict[str, Any]:
    if not isinstance(properties, Mapping):
        problems.add(f"properties are {type(properties).__name__}", expected="a mapping", code="type-wrong")
        return {}
    problems.add_if(
        reserved := {"name", "flightline"} & set(properties),
        f"properties hold {', '.join(sorted(reserved))}",
        mend="pass them as arguments of Region",
        code="property-reserved",
    )
    if odd := [key for key in properties if not isinstance(key, str)]:
        problems.add(f"properties have the names {odd[:3]!r:.80}", expected="text", code="type-wrong")
        return {}
    try:
        text = json.dumps(dict(properties), allow_nan=False, ensure_ascii=False)
        text.encode()
    except (TypeError, ValueError, RecursionError) as error:
        problems.add(
            f"properties cannot be written as JSON ({error!s:.80})",
            expected="text, finite numbers, lists or mappings of them",
            code="property-not-json",
        )
        return {}
    copied: dict[str, Any] = json.loads(text)
    return copied


# --- files and other forms of regions ----------------------------------------------------------------------


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
    FormatError.raise_if(
        "\0" in str(file),
        f"the path {file!s:.200} holds a NUL character",
        mend="check the path",
        code="path-invalid",
    )
    if file.suffix.lower() in VECTOR_FILES:
        return _collection(features_of(file, MAX_REGIONS), str(file))
    raw = read_limited(file, MAX_FILE_BYTES, "GeoJSON")
    FormatError.raise_if(
        raw.count(b"[") + raw.count(b"{") > MAX_CONTAINERS or raw.count(b",") > MAX_SEPARATORS,
        f"{file}: more values than {MAX_REGIONS} regions have",
        expected="GeoJSON of regions",
        code="file-too-large",
    )
    try:
        document = json.loads(raw.decode("utf-8-sig"), object_pairs_hook=_object, parse_constant=_no_constant)
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
    lines = [",\n".join(map(_json, features))] if features else []
    content = "\n".join(["{", *head, '"features": [', *lines, "]", "}", ""]).encode()
    is_same = is_plain_file(file) and file.stat().st_size == len(content) and file.read_bytes() == content
    publish_file(file, content, overwrite=overwrite or is_same)
    return file


def regions_from(source: Any) -> Regions:
    """Return regions from any of their forms.

    Parameters
    ----------
    source
        `Regions`, several `Region`, a path of a GeoJSON file, its content as a mapping, or an object with
        ``__geo_interface__``, as of geopandas, whose attribute ``crs`` is read. Regions are named by the
        property ``name``, else by ``label``, ``paint``, ``signature`` or ``title``, in any case.

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
        crs = None if isinstance(source, Mapping) else getattr(source, "crs", None)
        return _collection(document, "these regions", crs)
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


def _collection(document: Any, subject: str, object_crs: Any = None) -> Regions:
    # ``object_crs``: crs of an object whose GeoJSON the document is, as geopandas states it beside
    problems = Problems(f"{subject} cannot be read as regions", FormatError)
    members = document if isinstance(document, Mapping) else {}
    geojson_type = members.get("type")
    features = members.get("features") if geojson_type == "FeatureCollection" else None
    if geojson_type == "Feature":
        features = [document]
    if not isinstance(features, list | tuple):
        description = (
            f"type {geojson_type!r:.80}" if isinstance(document, Mapping) else type(document).__name__
        )
        problems.add(description, expected="a FeatureCollection with a list of features", code="type-wrong")
    elif len(features) > MAX_REGIONS:
        problems.add(
            f"{len(features)} features",
            expected=f"at most {MAX_REGIONS}",
            mend="split the file",
            code="regions-too-many",
        )
    crs = members.get("crs")
    if isinstance(crs, Mapping):
        inner = crs.get("properties")
        crs = (inner.get("name") if isinstance(inner, Mapping) else None) or ""  # an empty name is refused
    if crs is not None and not (isinstance(crs, str) and 0 < len(crs) <= 10_000 and crs.isprintable()):
        problems.add(
            "the crs has no name",
            expected="text such as 'EPSG:32618', or an object with properties.name",
            code="crs-missing",
        )
    elif object_crs is not None:
        text = object_crs if isinstance(object_crs, str) else object_crs.to_string()
        problems.add_if(
            crs is not None and crs_of(crs) != crs_of(text),
            f"the crs is {text:.80}, but the GeoJSON states {crs!r:.80}",
            mend="correct one of them",
            code="crs-conflict",
        )
        crs = text
    declared = members.get("coordinates")
    coordinates = ("sensor" if crs is None else "map") if declared is None else declared
    one_of(coordinates, COORDINATES, "coordinates", problems=problems)
    problems.raise_if_any()
    regions, invalid_features = [], 0
    for number, feature in enumerate(features or ()):
        try:
            regions.append(_region(feature))
        except PaintError as error:
            invalid_features += 1
            if invalid_features <= MAX_LISTED_FEATURES:
                problems.add_error(f"feature {number}", error)
    problems.add_if(
        invalid_features > MAX_LISTED_FEATURES,
        f"{invalid_features - MAX_LISTED_FEATURES} more features are invalid",
        code="features-invalid",
    )
    problems.raise_if_any()
    try:
        return Regions(tuple(regions), coordinates, crs)
    except SchemaError as error:
        raise FormatError(subject, problems=[error.problem]) from error


#: Properties that name a region, by preference, in any case.
_NAMES = ("name", "label", "paint", "signature", "title")


def _region(feature: Any) -> Region:
    if not isinstance(feature, Mapping) or feature.get("type") != "Feature":
        raise SchemaError(type(feature).__name__, expected="a Feature", code="type-wrong")
    properties = feature.get("properties")
    properties = dict(properties) if isinstance(properties, Mapping) else {}
    # the name, else the first label of another program that has a value
    found = {str(key).lower(): key for key, value in reversed(properties.items()) if value is not None}
    key = "name" if properties.get("name") is not None else next(filter(None, map(found.get, _NAMES)), None)
    if key is None:
        fields = ", ".join(map(repr, list(properties)[:10])) or "none"
        raise SchemaError(
            f"no property 'name', which names the paint; properties: {fields:.200}",
            mend="rename one of them 'name'",
            code="region-name-missing",
        )
    name, flightline = properties.pop(key), properties.pop("flightline", None)
    properties.pop("name", None)  # without a value
    polygon, *holes = _rings(feature.get("geometry"), name)
    return Region(name, polygon, tuple(holes), "" if flightline is None else flightline, properties)


def _rings(geometry: Any, name: Any) -> list[Any]:
    members = geometry if isinstance(geometry, Mapping) else {}
    geometry_type, rings = members.get("type"), members.get("coordinates")
    subject = f"region {str(name)[:80]!r} has a geometry of type {str(geometry_type)[:40]!r}"
    # many programs write a single polygon as a MultiPolygon
    if geometry_type == "MultiPolygon" and isinstance(rings, list | tuple):
        SchemaError.raise_if(
            len(rings) != 1,
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


# --- polygons of GeoPackage, Shapefile and FlatGeobuf, as GeoJSON ------------------------------------------


#: First bytes of a file by suffix. They are checked because pyogrio and fiona ignore the suffix, and some
#: formats of theirs open further files.
VECTOR_FILES = {".gpkg": b"SQLite format 3\0", ".shp": b"\0\0\x27\x0a", ".fgb": b"fgb"}

MAX_VECTOR_FILE_BYTES = 256 * 2**20


def features_of(path: Path, max_features: int) -> dict[str, Any]:
    # Return the polygons of a vector file as a FeatureCollection in coordinates of a map.
    #
    # At most ``max_features`` + 1 features are read, so that the caller can tell that there are too many.
    #
    # Raises `FormatError`: the file is damaged, of another format, without a crs, or has several layers of
    # polygons; `MissingExtraError`: neither pyogrio nor fiona is installed.
    magic = VECTOR_FILES[path.suffix.lower()]
    with open_input(path, "regions", MAX_VECTOR_FILE_BYTES) as file:
        if file.read(len(magic)) != magic:
            raise FormatError(
                f"{path}: not a {path.suffix[1:]} file", mend="check what the file is", code="file-kind-wrong"
            )
    readers = {"pyogrio": _by_pyogrio, "fiona": _by_fiona}
    library = next((name for name in readers if importlib.util.find_spec(name)), None)
    if library is None:
        raise MissingExtraError(
            f"{path.suffix} files need pyogrio or fiona",
            mend="install it with: python -m pip install pyogrio, or save the layer as GeoJSON in QGIS",
            code="dependency-missing",
        )
    try:
        crs, features = readers[library](path, max_features)
    except (FormatError, MissingExtraError):
        raise
    except Exception as error:  # every driver of both libraries has its own errors
        raise FormatError(
            f"{path}: {library} cannot read it: {error!s:.200}", code="file-unreadable"
        ) from error
    FormatError.raise_if(
        not crs, f"{path}: the layer has no crs", mend="set the crs of the layer", code="crs-missing"
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
            "properties": {name: _json_value(value) for name, value in zip(names, row, strict=True)},
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
                "properties": {name: _json_value(value) for name, value in feature.properties.items()},
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


def _json_value(value: Any) -> Any:
    # JSON value of a property; NaN becomes None
    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, float) and value != value:
        return None
    return value if value is None or isinstance(value, str | int | float | bool) else str(value)
