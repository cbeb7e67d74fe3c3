"""Regions: named polygons with properties, their files, and their pixels in a flight line.

Files are GeoJSON (RFC 7946), one Feature a line. GeoPackage, Shapefile and FlatGeobuf are read through
pyogrio, else fiona.

Two members beyond GeoJSON define the coordinates: ``"coordinates": "sensor"`` or ``"map"``, and ``"crs"``
as in GeoJSON before 2016. Without either they are sensor coordinates.

Pixels inside regions are found by an exact test of points in a polygon. A point on an edge is inside. The
sign of a cross product tells on which side of an edge a point lies. Where its float64 value is within its
rounding error bound [1]_, it is computed again in rational numbers. shapely is not used: GEOS takes points
very close to an edge for points on it (tests/regions/test_regions.py, corners divided by three).

References
----------
.. [1] J. R. Shewchuk, "Adaptive Precision Floating-Point Arithmetic and Fast Robust Geometric Predicates",
   Discrete Comput. Geom. 18, 305-363 (1997), section 4.1.
"""

import hashlib
import html
import importlib.util
import json
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any, TypeVar, overload

import numpy as np
import numpy.typing as npt
import xarray as xr

from hyperpaint.base import (
    ALONG_TRACK,
    CROSS_TRACK,
    VECTOR_FILES,
    Bools,
    Floats,
    FormatError,
    Indices,
    Ints,
    MissingExtraError,
    PaintError,
    Problems,
    SchemaError,
    as_path,
    documented,
    fetch,
    head_of,
    input_path,
    is_number,
    is_plain_file,
    json_of,
    numbers_of,
    one_of,
    open_input,
    read_limited,
    refuse_constant,
    schema,
    warn_if,
)
from hyperpaint.geometry.georeference.locating import POSE, between_maps, crs_of, locate
from hyperpaint.io.files.publishing import publish_file
from hyperpaint.io.files.reading import foreign_format

#: Maximum size of a regions file [byte]; a thousand regions with a hundred corners take 4 MB.
MAX_FILE_BYTES = 16 * 2**20

MAX_REGIONS = 10_000

LIMITS = SimpleNamespace(
    #: Maximum numbers of JSON lists and objects, and of commas; they bound the memory of the parsed document.
    max_containers=500_000,
    max_separators=1_500_000,
    max_listed_features=20,
    #: Maximum number of corners of a ring.
    max_vertices=10_000,
    #: Largest absolute coordinate; no pixel and no place on a map has a larger one.
    max_coordinate=1e9,
    max_name_chars=200,
    max_drawn_regions=60,
    max_listed_regions=10,
)

#: Coordinate systems of regions: column and line of the cube, or map coordinates on the ground.
COORDINATES = ("sensor", "map")


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
        with Problems(f"region {str(self.name)[:80]!r} cannot be used", SchemaError) as problems:
            for label in ("name", "flightline"):
                value = getattr(self, label)
                subject = f"{label} {str(value)[:80]!r}"
                if not isinstance(value, str):
                    problems.add(f"{subject} is {type(value).__name__}", expected="text", code="type-wrong")
                elif not value and label == "name":
                    problems.add(f"{subject} is empty", expected="text", code="region-name-missing")
                elif len(value) > LIMITS.max_name_chars:
                    problems.add(
                        f"{subject} has {len(value)} characters",
                        expected=f"at most {LIMITS.max_name_chars}",
                        code="name-too-long",
                    )
                elif not value.isprintable() or value.strip() != value:
                    problems.add(
                        f"{subject} has blanks at an end, or characters that cannot be printed",
                        code="name-unprintable",
                    )
            rings = [_ring(ring, index, problems) for index, ring in enumerate((self.polygon, *self.holes))]
            properties = _plain(self.properties, problems)
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
        with Problems("these regions cannot be used together", SchemaError) as problems:
            for name, count in Counter(region.name for region in self.regions).items():
                problems.add_if(
                    count > 1,
                    f"the name {name!r} occurs {'twice' if count == 2 else f'{count} times'}",
                    mend="give each region its own name",
                    code="region-name-duplicate",
                )
            one_of(self.coordinates, COORDINATES, "coordinates", problems=problems)
            crs: object = self.crs
            if crs is not None and not isinstance(crs, str):
                problems.add(
                    f"the crs is {type(crs).__name__}",
                    expected="text such as 'EPSG:32618'",
                    code="type-wrong",
                )
            elif crs is not None and self.coordinates == "sensor":
                problems.add(
                    f"sensor coordinates have the crs {crs[:80]!r}",
                    expected="none",
                    mend='pass coordinates="map" or no crs',
                    code="option-conflict",
                )

    def __repr__(self) -> str:
        system = self.crs or self.coordinates
        lines = [f"  {region!r}" for region in self.regions[: LIMITS.max_listed_regions]]
        if len(self) > LIMITS.max_listed_regions:
            lines.append(f"  ... and {len(self) - LIMITS.max_listed_regions} more")
        return "\n".join([f"<Regions: {len(self)} ({str(system)[:40]})>", *lines])

    def __len__(self) -> int:
        return len(self.regions)

    def __iter__(self) -> Iterator[Region]:
        return iter(self.regions)

    @overload
    def __getitem__(self, index: int) -> Region: ...
    @overload
    def __getitem__(self, index: slice) -> "Regions": ...
    def __getitem__(self, index: int | slice) -> "Region | Regions":
        return (
            Regions(self.regions[index], self.coordinates, self.crs)
            if isinstance(index, slice)
            else self.regions[index]
        )

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
        limit_note = (
            f", of which {LIMITS.max_drawn_regions} are shown" if len(self) > LIMITS.max_drawn_regions else ""
        )
        outlines = "".join(
            _drawn(region, self.coordinates) for region in self.regions[: LIMITS.max_drawn_regions]
        )
        return (
            '<div style="font:13px/1.45 system-ui,sans-serif">'
            f"<strong>{len(self)} regions ({html.escape(system)}){limit_note}</strong>"
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
        not 3 <= len(corners) <= LIMITS.max_vertices,
        f"the {ring_name} has {len(corners)} corners",
        expected=f"3 to {LIMITS.max_vertices}",
        code="corner-count",
    )
    problems.add_if(
        not (np.abs(corners) <= LIMITS.max_coordinate).all(),
        f"the {ring_name} has missing or too large coordinates",
        expected=f"numbers from {-LIMITS.max_coordinate:g} to {LIMITS.max_coordinate:g}",
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
    file = as_path(path)
    FormatError.raise_if(
        "\0" in str(file),
        f"the path {file!s:.200} holds a NUL character",
        mend="check the path",
        code="path-invalid",
    )
    if file.suffix.lower() in VECTOR_FILES:
        local = input_path(file)
        fetch(local.parent.glob(f"{local.stem}.*"))  # a shapefile has companions
        # the polygons of a vector file as a FeatureCollection in coordinates of a map; one feature more than
        # allowed is read, so that `_collection` can tell that there are too many
        magic = VECTOR_FILES[local.suffix.lower()]
        with open_input(local, "regions", MAX_VECTOR_FILE_BYTES) as opened:
            FormatError.raise_if(
                opened.read(len(magic)) != magic,
                f"{local}: not a {local.suffix[1:]} file",
                mend="check what the file is",
                code="file-kind-wrong",
            )
        readers = {"pyogrio": _by_pyogrio, "fiona": _by_fiona}
        library = MissingExtraError.raise_if_none(
            next((name for name in readers if importlib.util.find_spec(name)), None),
            f"{local.suffix} files need pyogrio or fiona",
            mend="install it with: python -m pip install pyogrio, or save the layer as GeoJSON in QGIS",
            code="dependency-missing",
        )
        try:
            crs, features = readers[library](local, MAX_REGIONS)
        except (FormatError, MissingExtraError):
            raise
        except Exception as error:  # every driver of both libraries has its own errors
            raise FormatError(
                f"{local}: {library} cannot read it: {error!s:.200}", code="file-unreadable"
            ) from error
        FormatError.raise_if(
            not crs, f"{local}: the layer has no crs", mend="set the crs of the layer", code="crs-missing"
        )
        return _collection(
            {"type": "FeatureCollection", "coordinates": "map", "crs": crs, "features": features}, str(file)
        )
    raw = read_limited(file, MAX_FILE_BYTES, "GeoJSON")
    FormatError.raise_if(
        raw.count(b"[") + raw.count(b"{") > LIMITS.max_containers or raw.count(b",") > LIMITS.max_separators,
        f"{file}: more values than {MAX_REGIONS} regions have",
        expected="GeoJSON of regions",
        code="file-too-large",
    )
    try:
        document = json.loads(
            raw.decode("utf-8-sig"), object_pairs_hook=_object, parse_constant=refuse_constant
        )
    except (ValueError, RecursionError) as error:
        reason = "nested too deep" if isinstance(error, RecursionError) else str(error)
        foreign = foreign_format(file, is_binary=True)
        if not foreign and re.match(rb'\s*\x1e?\{[^\n]*"Feature"[^\n]*\}\s*\n', raw):
            reason = "GeoJSONSeq, a feature a line"
        raise FormatError(
            f"{file}: {foreign.found if foreign else f'not GeoJSON ({reason:.200})'}",
            expected="a FeatureCollection of polygons in UTF-8",
            mend=foreign.mend if foreign else "convert it to GeoJSON, as with ogr2ogr or QGIS",
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
    file = as_path(path)
    document = regions_from(regions).__geo_interface__
    features = document.pop("features")
    head = [f"{json_of(key)}: {json_of(value)}," for key, value in document.items()]
    lines = [",\n".join(map(json_of, features))] if features else []
    content = "\n".join(["{", *head, '"features": [', *lines, "]", "}", ""]).encode()
    is_same = is_plain_file(file) and head_of(file, len(content) + 1) == content
    publish_file(file, content, overwrite=overwrite or is_same)
    return file


_NAME_POLYGONS = 'name every polygon: hyperpaint.Region("hood", polygon.exterior.coords)'


_TRACE_MASK = (
    "trace the outlines of a mask: rasterio.features.shapes(mask.astype('uint8'), mask, "
    "transform=rasterio.Affine.translation(-0.5, -0.5)), since whole numbers are centres of pixels"
)


def regions_from(source: Any) -> Regions:
    """Return regions from any of their forms.

    Parameters
    ----------
    source
        `Regions`, several `Region`, a path of a GeoJSON file, its content as a mapping, an object with
        ``__geo_interface__``, as of geopandas, whose attribute ``crs`` is read; polygons of shapely, or
        polygons by name: a mapping, or pairs (name, polygon). Regions are named by the
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
    members: Any = source
    if isinstance(source, Mapping) and "type" not in source:  # {name: polygon}
        members = tuple(source.items())
    elif getattr(source, "geom_type", None) in ("Polygon", "MultiPolygon"):  # of shapely
        members = tuple(getattr(source, "geoms", (source,)))
    elif isinstance(source, Mapping) or hasattr(source, "__geo_interface__"):
        document = source if isinstance(source, Mapping) else source.__geo_interface__
        crs = None if isinstance(source, Mapping) else getattr(source, "crs", None)
        return _collection(document, "these regions", crs)
    is_image = len(getattr(source, "shape", ())) == 2 and not hasattr(source, "columns")
    if isinstance(members, Iterable) and not is_image:
        members = tuple(members)
        named = [_named(member, number) for number, member in enumerate(members, 1)]
        if None not in named:
            return Regions(tuple(region for region in named if region))
    raise SchemaError(
        f"regions are {type(source).__name__}",
        expected="hyperpaint.Regions, the path of a GeoJSON file, or its content",
        mend=_TRACE_MASK if is_image else _NAME_POLYGONS,
        code="type-wrong",
    )


def _named(member: Any, number: int) -> Region | None:
    # A region of a list: as it is; (name, polygon); or a polygon of shapely, named by its number
    if isinstance(member, Region):
        return member
    is_pair = isinstance(member, tuple) and len(member) == 2 and isinstance(member[0], str)
    name, polygon = member if is_pair else (f"region {number}", member)
    if hasattr(polygon, "__geo_interface__"):
        geometry = polygon.__geo_interface__
        return _region({"type": "Feature", "properties": {"name": name}, "geometry": geometry})
    return Region(name, polygon) if is_pair else None


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    mapping = dict(pairs)
    if len(mapping) < len(pairs):
        raise ValueError("a member occurs twice in the same object")
    return mapping


# --- content of a document ---------------------------------------------------------------------------------


def _collection(document: Any, subject: str, object_crs: Any = None) -> Regions:
    # ``object_crs``: crs of an object whose GeoJSON the document is, as geopandas states it beside
    problems = Problems(f"{subject} cannot be read as regions", FormatError)
    members = document if isinstance(document, Mapping) else {}
    geojson_type = members.get("type")
    features = {"FeatureCollection": members.get("features"), "Feature": [document]}.get(str(geojson_type))
    if not isinstance(features, list | tuple):
        description = (
            f"type {geojson_type!r:.80}" if isinstance(document, Mapping) else type(document).__name__
        )
        problems.add(
            description,
            expected="a FeatureCollection with a list of features",
            mend=_NAME_POLYGONS,
            code="type-wrong",
        )
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
    declared = members.get("coordinates") if features is not None else None  # not those of a geometry
    coordinates = ("sensor" if crs is None else "map") if declared is None else declared
    one_of(coordinates, COORDINATES, "coordinates", problems=problems)
    problems.raise_if_any()
    regions, invalid_features = [], 0
    features = list(features or ())
    # QGIS writes rows without a drawing
    empty = [isinstance(feature, Mapping) and feature.get("geometry", 0) is None for feature in features]
    for number, feature in enumerate(features):
        if empty[number] and not all(empty):
            continue
        try:
            regions.append(_region(feature))
        except PaintError as error:
            invalid_features += 1
            if invalid_features <= LIMITS.max_listed_features:
                problems.add_error(f"feature {number}", error)
    problems.add_if(
        invalid_features > LIMITS.max_listed_features,
        f"{invalid_features - LIMITS.max_listed_features} more features are invalid",
        code="features-invalid",
    )
    problems.raise_if_any()
    warn_if(
        any(empty),
        f"{subject}: {sum(empty)} features have no geometry and are left out",
        "geometry-missing",
    )
    try:
        return Regions(tuple(regions), coordinates, crs)
    except SchemaError as error:
        raise FormatError(subject, problems=[error.problem]) from error


#: Properties that name a region, by preference, in any case.
_NAMES = ("name", "label", "paint", "signature", "title")


def _region(feature: Any) -> Region:
    SchemaError.raise_if(
        not isinstance(feature, Mapping) or feature.get("type") != "Feature",
        type(feature).__name__,
        expected="a Feature",
        code="type-wrong",
    )
    properties = feature.get("properties")
    properties = dict(properties) if isinstance(properties, Mapping) else {}
    # the name, else the first label of another program that has a value
    found = {str(key).lower(): key for key, value in reversed(properties.items()) if value is not None}
    key = "name" if properties.get("name") is not None else next(filter(None, map(found.get, _NAMES)), None)
    fields = ", ".join(map(repr, list(properties)[:10])) or "none"
    key = SchemaError.raise_if_none(
        key,
        f"no property 'name', which names the paint; properties: {fields:.200}",
        mend="rename one of them 'name'",
        code="region-name-missing",
    )
    name, flightline = properties.pop(key), properties.pop("flightline", None)
    if is_number(name) and float(name).is_integer():  # a column of numbers
        name = str(int(name))
    name = name.strip() if isinstance(name, str) else name
    properties.pop("name", None)  # without a value
    geometry = feature.get("geometry")
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
    SchemaError.raise_if(geometry_type != "Polygon", subject, expected="a Polygon", code="geometry-wrong")
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
    polygon, *holes = [np.array([corner[:2] for corner in ring], np.float64).reshape(-1, 2) for ring in rings]
    return Region(name, polygon, tuple(holes), "" if flightline is None else flightline, properties)


# --- polygons of GeoPackage, Shapefile and FlatGeobuf, as GeoJSON ------------------------------------------


MAX_VECTOR_FILE_BYTES = 256 * 2**20


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
    FormatError.raise_if(
        len(layers) != 1,
        f"{path}: layers {', '.join(map(repr, layers)) or 'none'}",
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


_EPSILON = 2.0**-53
_ROUNDING = (3.0 + 16.0 * _EPSILON) * _EPSILON
_TINIEST = float(np.finfo(np.float64).tiny)

_EDGES = SimpleNamespace(
    #: Maximum mean number of edges whose y range contains the y of a pixel: few for an outline, thousands for
    #: a zigzag.
    max_edges_per_pixel=100,
    #: Number of comparisons of an edge with a point below which no polygon is refused.
    free_comparisons=10_000_000,
)

RegionsT = TypeVar("RegionsT", bound=Regions)
#: Positions along and across the track, line by line.
Pixels = tuple[Ints, Ints]

#: Number of pixels that are tested together.
_BLOCK_PIXELS = 2**20

#: Pairs of variables that hold x and y of the pixels on the ground.
_GROUND = (("east", "north"), ("easting", "northing"), ("longitude", "latitude"), ("lon", "lat"), ("x", "y"))
_GEOGRAPHIC = ("longitude", "lon")
GEOGRAPHIC_CRS = "EPSG:4326"
#: Variables of a map: column and line of the pixel that a cell shows; -1 in empty cells.
_SOURCE_PIXEL = ("nearest_sample", "nearest_line")
#: Variable of a map of several flight lines: the flight line that a cell shows.
_SOURCE_LINE = "flightline"


def pixels(
    region: Region, line: xr.Dataset, *, coordinates: str = "sensor", crs: str | None = None
) -> Pixels:
    """Return the pixels of a flight line that lie in a region.

    Parameters
    ----------
    region
        A polygon.
    line
        A flight line, or a map. Coordinates of a map need the place of every pixel on the ground, as
        ``longitude`` and ``latitude``, ``east`` and ``north`` (along_track, cross_track), or ``x`` and ``y``
        of a map; a line with poses and the attribute ``ground`` only is located first. Sensor coordinates in
        a map are the coordinates of the pixels that its cells show (``nearest_line`` and ``nearest_sample``,
        where present); in a map of several flight lines, of the region's own flight line.
    coordinates, crs
        Coordinate system of the region, see `Regions`.

    Returns
    -------
    along_track, cross_track : (pixel,), int64
        Positions, line by line; rows and columns of a map. A pixel belongs to the region where its centre
        lies in the polygon or on its edge.

    Raises
    ------
    SchemaError
        The line has no along_track and cross_track; it has no place of its pixels in the region's reference
        system; a region in sensor coordinates names none of a map's several flight lines; or the polygon has
        too many long edges.

    Examples
    --------
    >>> import xarray as xr
    >>> line = xr.Dataset({"quality": (("along_track", "cross_track"), np.zeros((9, 9), "u2"))})
    >>> along, across = pixels(Region("corner", [(0, 0), (1.5, 0), (0, 1.5)]), line)
    >>> along.tolist(), across.tolist()
    ([0, 0, 1], [0, 1, 0])
    """
    return pixels_of(Regions((region,), coordinates, crs), line)[0]


def region_mask(regions: Any, line: xr.Dataset) -> xr.DataArray:
    """Return the region of every pixel of a flight line.

    Parameters
    ----------
    regions
        See `regions_from`.
    line
        See `pixels`.

    Returns
    -------
    (along_track, cross_track), of a map (y, x), int16
        Position of the region among ``regions``, the later one where several overlap; -1 elsewhere. The
        attributes ``flag_values`` and ``flag_meanings`` name them.

    Raises
    ------
    FormatError, SchemaError
        As `regions_from` and `pixels`.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> from hyperpaint.regions import Region
    >>> line = xr.Dataset({"counts": (("along_track", "band", "cross_track"), np.zeros((3, 2, 4)))})
    >>> left = Region("left", [(-0.5, -0.5), (1.5, -0.5), (1.5, 1.5), (-0.5, 1.5)])
    >>> region_mask([left], line).values
    array([[ 0,  0, -1, -1],
           [ 0,  0, -1, -1],
           [-1, -1, -1, -1]], dtype=int16)
    """
    region_list = regions_from(regions)
    dims = "yx" if {"y", "x"} <= set(line.dims) else (ALONG_TRACK, CROSS_TRACK)
    line = schema.rename_to_roles(line)
    region_pixels = pixels_of(region_list, line)
    mask = np.full((line.sizes[ALONG_TRACK], line.sizes[CROSS_TRACK]), -1, np.int16)
    for number, positions in enumerate(region_pixels):
        mask[positions] = number
    return xr.DataArray(
        mask,
        dims=tuple(dims),
        name="region",
        attrs={
            "long_name": "Region that a pixel lies in",
            "flag_values": np.arange(-1, len(region_list), dtype=np.int16),
            "flag_meanings": " ".join(["none", *(name.replace(" ", "_") for name in region_list.names)]),
        },
    )


def pixels_of(regions: Regions, line: xr.Dataset) -> list[Pixels]:
    """Return the pixels of every region; see `pixels`.

    Regions in sensor coordinates read nothing; for regions on a map the ground coordinates of the pixels are
    read once, in blocks of lines.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> from hyperpaint.regions import Region, Regions
    >>> line = xr.Dataset({"counts": (("along_track", "band", "cross_track"), np.zeros((3, 2, 4)))})
    >>> left = Region("left", [(-0.5, -0.5), (1.5, -0.5), (1.5, 1.5), (-0.5, 1.5)])
    >>> ((lines, columns),) = pixels_of(Regions((left,)), line)
    >>> lines, columns
    (array([0, 0, 1, 1]), array([0, 1, 0, 1]))
    """
    line = schema.rename_to_roles(line)
    problems = Problems("pixels of regions cannot be found in this line", SchemaError)
    for dim in (ALONG_TRACK, CROSS_TRACK):
        problems.add_if(
            dim not in line.dims,
            f"dims {', '.join(map(str, line.dims))}",
            expected=f"the dim {dim!r}",
            mend=f"select with isel({dim}=[5]) to keep it, or name it with dims=",
            code="dim-missing",
        )
    problems.raise_if_any()
    crossing = [region.name for region in regions if _crosses_itself(region.polygon)]
    warn_if(
        crossing,
        f"the outlines of {', '.join(map(repr, crossing[:5]))} cross themselves and hold less than their "
        "corners enclose; draw the corners in order",
        "polygon-crossing",
    )
    shape = line.sizes[ALONG_TRACK], line.sizes[CROSS_TRACK]
    if regions.coordinates == "map":
        line = located_for(regions, line)
        x, y, crs = ground_of(line, regions.crs)
        if crs is not None and regions.crs is not None:
            regions = _transformed(regions, crs)
        return _by_coordinates(regions, x, y, shape)
    if set(_SOURCE_PIXEL) <= set(line.variables):
        # a cell of a map has the sensor coordinates of the pixel that it shows
        across, along = (line[name].reset_coords(drop=True) for name in _SOURCE_PIXEL)
        coordinates = across.where(across >= 0), along.where(along >= 0)
        names = lines_of_cells(line)
        if not names:
            return _by_coordinates(regions, *coordinates, shape)
        # number of the flight line of every region
        with Problems(
            "pixels of regions cannot be found in this map of several flight lines", SchemaError
        ) as problems:
            lines = [region.flightline.replace(" ", "_") for region in regions]
            for region, name in zip(regions, lines, strict=True):
                if name not in names:
                    source = f"is of flight line {region.flightline!r}" if name else "names no flight line"
                    problems.add(
                        f"region {region.name!r} in sensor coordinates {source}",
                        expected=f"one of {', '.join(names)}",
                        mend="give it the property flightline, or draw it in map coordinates",
                        code="flightline-unknown",
                    )
        return _by_coordinates(
            regions, *coordinates, shape, (line[_SOURCE_LINE], [names[name] for name in lines])
        )
    columns, rows = numbers_of(line, CROSS_TRACK), numbers_of(line, ALONG_TRACK)
    found = [_on_axes(region, columns, rows) for region in regions]
    # lines that occur twice, as after xr.concat of overlapping crops, would count twice
    for axis, (dim, numbers) in enumerate({ALONG_TRACK: rows, CROSS_TRACK: columns}.items()):
        unique, counts = np.unique(numbers, return_counts=True)
        repeated = unique[counts > 1]
        doubled = [
            region.name
            for region, pixel in zip(regions, found, strict=True)
            if np.isin(numbers[pixel[axis]], repeated).any()
        ]
        problems.add_if(
            doubled,
            f"{repeated.size} labels of {dim!r} occur more than once, in regions {', '.join(doubled[:5])}",
            expected="every line and column once",
            mend=f"drop_duplicates({dim!r}), or number the lines of several flights anew by assign_coords",
            code="label-duplicate",
        )
    problems.raise_if_any()
    return found


def _crosses_itself(ring: Floats) -> bool:
    # Whether edges of a ring cross within both; long outlines, which programs trace, are not searched
    if not 3 < len(ring) <= 1000:
        return False
    start, edge = ring, np.roll(ring, -1, axis=0) - ring
    x, y = (start[None, :, axis] - start[:, None, axis] for axis in (0, 1))  # [k, m]: from start k to start m
    side = edge[:, None, 0] * y - edge[:, None, 1] * x  # on which side of edge k is start m
    is_split = side * np.roll(side, -1, axis=1) < 0.0
    return bool((is_split & is_split.T).any())


def lines_of_cells(line: xr.Dataset) -> dict[str, int]:
    # Return the numbers of the flight lines in a map by name; empty for a map of one line.
    if _SOURCE_LINE not in line.variables or set(line[_SOURCE_LINE].dims) != {ALONG_TRACK, CROSS_TRACK}:
        return {}
    attrs = line[_SOURCE_LINE].attrs
    numbers = np.atleast_1d(attrs.get("flag_values", ())).astype(int).tolist()
    names = dict(zip(str(attrs.get("flag_meanings", "")).split(), numbers, strict=False))
    return names if len(names) > 1 else {}


def located_for(regions: Regions, line: xr.Dataset) -> xr.Dataset:
    # Return a flight line with ground coordinates for regions on a map; it is located if it has only poses.
    #
    # Raises `SchemaError`: the height of the ground is unknown; or as `hyperpaint.geometry.locate`.
    renamed = schema.rename_to_roles(line)
    is_placed = any(_has_pair(renamed, pair) for pair in _GROUND)
    if regions.coordinates != "map" or is_placed or not set(POSE) <= set(renamed.variables):
        return line
    SchemaError.raise_if(
        not isinstance(renamed.attrs.get("ground"), int | float),
        "the flight line has no height of the ground to locate regions in map coordinates",
        mend="pass the height above the ellipsoid: locate(line, ground=...) or dem=, or the attribute "
        "ground [m] of the line",
        option="give --ground or --dem, or [geometry] ground in collect.toml and process again",
        code="ground-height-missing",
    )
    return locate(renamed)


def renumbered(regions: RegionsT, line: xr.Dataset, *, back: bool = False) -> RegionsT:
    # Return regions with array positions changed to index coordinates of the line; ``back`` reverses it.
    numbers = [numbers_of(line, dim) for dim in (CROSS_TRACK, ALONG_TRACK)]
    first = np.array([values[0] for values in numbers])
    step = np.array([(values[-1] - values[0]) / max(values.size - 1, 1) or 1.0 for values in numbers])
    return (
        regions
        if not first.any() and (step == 1.0).all()
        else _with_rings(
            regions, lambda ring: np.asarray((ring - first) / step if back else ring * step + first)
        )
    )


def _with_rings(regions: RegionsT, move: Callable[[Floats], Floats], **changes: Any) -> RegionsT:
    members = (
        replace(region, polygon=move(region.polygon), holes=tuple(move(hole) for hole in region.holes))
        for region in regions
    )
    return replace(regions, regions=tuple(members), **changes)


def _by_coordinates(
    regions: Regions,
    x: xr.DataArray,
    y: xr.DataArray,
    shape: tuple[int, int],
    sources: tuple[xr.DataArray, Sequence[int]] | None = None,
) -> list[Pixels]:
    # Pixels of every region, from x and y of all pixels, in blocks of lines.
    # `sources`, for a map of several flight lines: the flight line numbers of its cells, and of the regions.
    if x.dims == (CROSS_TRACK,) and y.dims == (ALONG_TRACK,):
        return [_on_axes(region, x.values.astype(float), y.values.astype(float)) for region in regions]
    blocks: list[list[Pixels]] = [[] for _ in regions]
    for lines in _blocks(*shape):
        block_x, block_y, *numbers = (
            _values(axis, lines, shape[1]) for axis in (x, y, *([] if sources is None else sources[:1]))
        )
        for number, (region, pieces) in enumerate(zip(regions, blocks, strict=True)):
            is_in = _inside(region, block_x, block_y)
            if sources is not None:
                is_in &= numbers[0] == sources[1][number]
            along, across = np.divmod(np.flatnonzero(is_in), shape[1])
            pieces.append((along + lines.start, across))
    return [_joined(pieces) for pieces in blocks]


def _on_axes(region: Region, x: Floats, y: Floats) -> Pixels:
    # Pixels of a region where x depends on the column only and y on the row only.
    # Only pixels in the bounding box of the region are tested.
    low, high = region.polygon.min(axis=0), region.polygon.max(axis=0)
    across, along = (np.flatnonzero((axis >= low[k]) & (axis <= high[k])) for k, axis in enumerate((x, y)))
    blocks = []
    for lines in _blocks(along.size, across.size):
        row, col = (axis.ravel() for axis in np.meshgrid(along[lines], across, indexing="ij"))
        inside = _inside(region, x[col], y[row])
        blocks.append((row[inside], col[inside]))
    return _joined(blocks)


def _inside(region: Region, x: Floats, y: Floats) -> Bools:
    try:
        return contains(region.polygon, region.holes, x, y)
    except SchemaError as error:
        raise SchemaError(
            f"the pixels of region {region.name!r} cannot be found", problems=[error.problem]
        ) from error


def _values(axis: xr.DataArray, lines: slice, columns: int) -> Floats:
    # A coordinate of all pixels in a block of lines, line by line (pixel,)
    block = axis.isel({ALONG_TRACK: lines}, missing_dims="ignore")
    block = block.expand_dims([dim for dim in (ALONG_TRACK, CROSS_TRACK) if dim not in block.dims])
    values = block.transpose(ALONG_TRACK, CROSS_TRACK).values.astype(np.float64)
    return np.broadcast_to(values, (lines.stop - lines.start, columns)).ravel()


def _blocks(lines: int, columns: int) -> list[slice]:
    step = max(1, _BLOCK_PIXELS // max(columns, 1))
    return [slice(start, min(start + step, lines)) for start in range(0, lines, step)]


def _joined(blocks: Sequence[Pixels]) -> Pixels:
    empty = np.empty(0, np.int64)
    along, across = (
        np.concatenate([empty, *(block[axis] for block in blocks)]).astype(np.int64) for axis in (0, 1)
    )
    return along, across


# --- places on the ground ----------------------------------------------------------------------------------


def _transformed(regions: Regions, crs: str) -> Regions:
    # Regions with their corners transformed to another reference system; edges stay straight.
    # GeoJSON has longitude first in every reference system.
    source, target = crs_of(_canonical(str(regions.crs))), crs_of(crs)

    def transformed(ring: Any) -> Floats:
        corners = between_maps(np.asarray(ring, np.float64), source, target)
        SchemaError.raise_if(
            not np.isfinite(corners).all(),
            f"the corner {ring[0][0]:g}, {ring[0][1]:g} lies outside {regions.crs!r:.60}",
            mend="name the crs of the regions",
            code="corner-outside-crs",
        )
        return corners

    return _with_rings(regions, transformed, crs=crs)


def ground_of(line: xr.Dataset, crs: str | None) -> tuple[xr.DataArray, xr.DataArray, str | None]:
    # x and y of every pixel on the ground, and the reference system to transform regions to.
    # The latter is None where x and y are in the reference system of the regions.
    systems = {pair: _crs_of(line, pair) for pair in _GROUND if _has_pair(line, pair)}
    SchemaError.raise_if(
        not systems,
        "the line has no ground coordinates of its pixels",
        expected="east and north, or longitude and latitude (along_track, cross_track), or x and y of a map",
        mend="draw the regions in sensor coordinates, or locate the line first",
        code="pixel-places-missing",
    )
    region_crs = None if crs is None else _canonical(crs)
    fitting = [pair for pair, system in systems.items() if region_crs is None or system in (None, region_crs)]
    declared = [pair for pair, system in systems.items() if system is not None]
    if (region_crs is None and len(fitting) > 1) or not (fitting or declared):
        pairs = ", ".join(f"{x} and {y} ({system or 'unknown'})" for (x, y), system in systems.items())
        stated = "name no crs" if crs is None else f"are in {crs!r:.80}"
        raise SchemaError(
            f"the regions {stated}, the line has {pairs}",
            mend="write the regions in one of these reference systems, and name it as crs",
            code="crs-missing" if crs is None else "crs-mismatch",
        )
    # pairs with a declared crs take precedence
    x, y = pair = min(fitting, key=lambda pair: systems[pair] is None) if fitting else declared[0]
    system = None if fitting else systems[pair]
    return line[x].reset_coords(drop=True), line[y].reset_coords(drop=True), system


def _has_pair(line: xr.Dataset, pair: tuple[str, str]) -> bool:
    # latitude and longitude of the camera have the dim along_track only
    dims = {dim for name in pair if name in line.variables for dim in line[name].dims}
    return set(pair) <= set(line.variables) and dims == {ALONG_TRACK, CROSS_TRACK}


def _crs_of(line: xr.Dataset, pair: tuple[str, str]) -> str | None:
    if pair[0] in _GEOGRAPHIC:
        return GEOGRAPHIC_CRS
    stated = line[pair[0]].attrs.get("crs", line.attrs.get("crs"))
    if stated is None and "spatial_ref" in line.variables:
        # rioxarray stores the crs of a GeoTIFF there
        mapping = line["spatial_ref"].attrs
        wkt = mapping.get("crs_wkt") or mapping.get("spatial_ref")
        stated = None if wkt is None else crs_of(wkt)
    return _canonical(stated) if isinstance(stated, str) else None


def _canonical(crs: str) -> str:
    # Unique spelling of the name of a reference system; CRS84 and EPSG:4326 are equal, as GeoJSON has
    # longitude first
    text = crs.strip()
    if text.lower().startswith("urn:ogc:def:crs:"):
        fields = text.split(":")
        text = f"{fields[4]}:{fields[-1]}"
    if text.upper() in ("OGC:CRS84", GEOGRAPHIC_CRS, "WGS84"):
        return GEOGRAPHIC_CRS
    return text if "[" in text else text.upper()  # names within WKT are case-sensitive


# --- points in polygons ------------------------------------------------------------------------------------


def contains(polygon: Floats, holes: Sequence[Floats], x: Floats, y: Floats) -> Bools:
    """Return whether points lie in a polygon or on one of its edges (point,).

    ``polygon`` (vertex, 2): x and y of its corners, in order, the last joined to the first; ``holes``: rings
    cut out of it, whose edges belong to the polygon; ``x``, ``y`` (point,): the points; NaN are in no
    polygon. Where a ring crosses itself, areas that it winds around an even number of times are outside
    (even-odd rule).

    Raises `SchemaError`: too many long edges; the test would take minutes.

    Examples
    --------
    >>> square = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]])
    >>> contains(square, [], np.array([1.0, 2.0, 2.1]), np.array([1.0, 0.5, 0.5])).tolist()
    [True, True, False]
    """
    low, high = polygon.min(axis=0), polygon.max(axis=0)
    near = np.flatnonzero((x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1]))
    # sorted by y, the points within the y range of an edge are one run
    near = near[np.argsort(y[near], kind="stable")]
    near_x, near_y = x[near], y[near]
    rings = [polygon, *holes]
    runs = [_runs(ring, near_y) for ring in rings]
    comparisons = sum(int((last - first).clip(0).sum()) for first, last in runs)
    if comparisons > _EDGES.free_comparisons + _EDGES.max_edges_per_pixel * near.size:
        raise SchemaError(
            f"on average {comparisons / near.size:.0f} edges lie beside each of {near.size} pixels",
            expected=f"at most {_EDGES.max_edges_per_pixel}",
            mend="split the polygon, or give it fewer corners",
            code="polygon-too-complex",
        )
    inside = np.ones(near.size, bool)
    for number, (ring, (first, last)) in enumerate(zip(rings, runs, strict=True)):
        # only points within the y range of a hole can lie in it
        run = slice(int(first.min()), int(last.max())) if number else slice(0, near.size)
        if run.start < run.stop:
            within, edge = _inside_ring(ring, near_x[run], near_y[run], first - run.start, last - run.start)
            inside[run] &= ~within | edge if number else within | edge
    belongs: Bools = np.zeros(x.size, bool)
    belongs[near] = inside
    return belongs


def _runs(ring: Floats, y: Floats) -> tuple[Indices, Indices]:
    # Start and stop (edge,) of the points whose y lies within an edge's y range; y ascends
    closed = np.concatenate([ring, ring[:1]])[:, 1]
    first = np.searchsorted(y, np.minimum(closed[:-1], closed[1:]), "left")
    return first, np.searchsorted(y, np.maximum(closed[:-1], closed[1:]), "right")


def _inside_ring(ring: Floats, x: Floats, y: Floats, first: Indices, last: Indices) -> tuple[Bools, Bools]:
    # Masks of the points that a ring winds around an odd number of times, and of those on the ring
    within, edge = np.zeros((2, x.size), bool)
    closed = np.concatenate([ring, ring[:1]])
    low, high = np.minimum(closed[:-1], closed[1:]), np.maximum(closed[:-1], closed[1:])
    for k in np.flatnonzero(first < last):
        run = slice(first[k], last[k])
        start, stop = closed[k], closed[k + 1]
        xs, ys = x[run], y[run]
        # 1 for points left of a directed edge, -1 right of it, 0 on its line
        along_x, along_y = stop[0] - start[0], stop[1] - start[1]
        off_x, off_y = xs - start[0], ys - start[1]
        product_xy, product_yx = along_x * off_y, along_y * off_x
        cross = product_xy - product_yx
        side: npt.NDArray[np.int8] = np.sign(cross).astype(np.int8)
        doubtful = (np.abs(cross) <= _ROUNDING * (np.abs(product_xy) + np.abs(product_yx)) + _TINIEST) & (
            # products with a zero difference are exact
            ((along_x != 0) & (off_y != 0)) | ((along_y != 0) & (off_x != 0))
        )
        # the sign in exact rational arithmetic
        x0, y0, x1, y1 = (Fraction(float(value)) for value in (*start, *stop))
        for point in np.flatnonzero(doubtful).tolist():
            exact = (x1 - x0) * (Fraction(float(ys[point])) - y0) - (y1 - y0) * (
                Fraction(float(xs[point])) - x0
            )
            side[point] = (exact > 0) - (exact < 0)
        edge[run] |= (side == 0) & (x[run] >= low[k, 0]) & (x[run] <= high[k, 0])
        # a ray from the point in +x crosses rising edges left of them, falling edges right of them;
        # half-open y ranges count a corner once
        rises = (start[1] <= y[run]) & (y[run] < stop[1]) & (side > 0)
        within[run] ^= rises | (stop[1] <= y[run]) & (y[run] < start[1]) & (side < 0)
    return within, edge
