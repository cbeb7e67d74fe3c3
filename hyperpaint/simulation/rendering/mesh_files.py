"""Scenes from mesh files: Wavefront OBJ, binary glTF (GLB) and PLY.

OBJ files are read here; GLB and PLY files through trimesh (``pip install 'hyperpaint[mesh]'``), after their
declared sizes were compared with the file. Files that a mesh refers to are never opened.

Of OBJ only ``v``, ``f`` and the names after ``usemtl``, ``o`` and ``g`` are read. A GLB file is first
stripped to nodes, meshes, positions, indices and numbers of materials, so that trimesh gets no pictures,
animations or references to other files.
"""

import functools
import importlib
import io
import json
import re
import struct
import warnings
from array import array
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hyperpaint.base import (
    Floats,
    FormatError,
    Ints,
    SchemaError,
    is_number,
    needs_extra,
    read_limited,
)

from .materials import Material
from .scene import Instance, Mesh, Scene, has_area, smoothed, warn_of_dropped

_MAX_TRIANGLES = 50_000_000
_MAX_VERTEX_INDEX = 2**40
_OBJ_LINE = re.compile(r"[^\n]*\n?")
_MAX_LINE_CHARS = 2**20
#: Largest share of a polygon's area that its triangles may cover twice; corners on an edge are rounded.
_MAX_OVERLAP = 1e-3
_MAX_CONCAVE_CORNERS = 200  # of which fans from every corner are tried
#: Lines of numbers in an OBJ file: their type, minimum count, and form.
_OBJ_NUMBERS: dict[str, tuple[Callable[[str], Any], int, str]] = {
    "v": (float, 3, "'v' and three numbers"),
    "f": (int, 3, "'f' and three or more numbers of vertices, counted from 1"),
}


# Triangles of a file
class RawTriangles(NamedTuple):
    vertices: Floats  # (vertex, 3) float64: positions in the units and axes of the file
    faces: Ints  # (face, 3) int64: vertices of every triangle, not checked yet
    face_group: Ints  # (face,) int64: number of the group of every triangle
    # names of the material and of the object of every group; empty if missing
    groups: tuple[tuple[str, ...], ...]


# --- OBJ ---------------------------------------------------------------------------------------------------


def parse_obj(data: bytes, where: str) -> RawTriangles:
    r"""Return the triangles of an OBJ file; polygons become fans. ``where`` names the file in messages.

    The fan of a polygon begins at its first corner, or at the corner where its triangles overlap least if
    they do at the first.

    Raises
    ------
    FormatError
        A line cannot be read, or triangles of a polygon of more than four corners overlap in every fan.

    Examples
    --------
    >>> quad = parse_obj(b"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nusemtl red\nf 1 2 3 -1\n", "quad.obj")
    >>> quad.faces.tolist(), quad.groups
    ([[0, 1, 2], [0, 2, 3]], (('red', ''),))
    """
    text = data.decode("utf-8-sig", errors="replace").replace("\r\n", "\n").replace("\r", "\n")
    text = text.replace("\\\n", " ")
    # arrays instead of lists, and line by line, because large meshes have millions of lines
    coordinates, corners, face_group, face_polygon = array("d"), array("q"), array("q"), array("q")
    polygons = 0
    groups: dict[tuple[str, str], int] = {}
    material, object_name = "", ""
    group = -1
    for number, match in enumerate(_OBJ_LINE.finditer(text), 1):
        line = match[0]
        FormatError.raise_if(
            len(line) > _MAX_LINE_CHARS,
            f"{where}: line {number} is too long",
            expected=f"at most {_MAX_LINE_CHARS} characters",
            code="line-too-long",
        )
        words = line.split()
        keyword = words[0] if words else ""
        if keyword in _OBJ_NUMBERS:
            kind, least, expected = _OBJ_NUMBERS[keyword]
            words = line.partition("#")[0].split()
            texts = words[1:4] if keyword == "v" else [word.partition("/")[0] for word in words[1:]]
            try:
                numbers = [kind(text) for text in texts]
            except ValueError:
                numbers = []
            is_vertex = keyword == "v" or all(0 < abs(index) < _MAX_VERTEX_INDEX for index in numbers)
            if len(numbers) < least or not is_vertex:
                raise FormatError(
                    f"{where}: line {number} is {' '.join(words)[:60]!r}",
                    expected=expected,
                    code="number-unreadable",
                )
        if keyword == "v":
            coordinates.extend(numbers)
        elif keyword == "f":
            if group < 0:
                group = groups.setdefault((material, object_name), len(groups))
            vertex_count = len(coordinates) // 3  # negative numbers count back from the last vertex
            fan = [index - 1 if index > 0 else vertex_count + index for index in numbers]
            for corner in range(1, len(fan) - 1):
                corners.extend((fan[0], fan[corner], fan[corner + 1]))
                face_group.append(group)
                face_polygon.append(polygons)
            polygons += 1
        elif keyword in ("usemtl", "o", "g"):
            name = line.strip()[len(keyword) :].strip()
            material, object_name = (name, object_name) if keyword == "usemtl" else (material, name)
            group = -1
    vertices = np.asarray(coordinates, np.float64).reshape(-1, 3)
    faces = np.asarray(corners, np.int64).reshape(-1, 3)
    polygon = np.asarray(face_polygon, np.int64)
    # fans from the first corner fold over in polygons that are not convex: another corner may see the whole
    several = np.flatnonzero(np.bincount(polygon)[polygon] > 1)
    if several.size and faces[several].min() >= 0 and faces[several].max() < len(vertices):
        overlaps = _overlaps(vertices, faces[several], polygon[several])
        for concave in np.flatnonzero(overlaps > _MAX_OVERLAP):
            rows = slice(*np.searchsorted(polygon, (concave, concave + 1)))
            outline = np.concatenate([faces[rows][0, :2], faces[rows][:, 2]])
            first = np.arange(len(outline) if len(outline) <= _MAX_CONCAVE_CORNERS else 1)[:, None, None]
            steps = np.arange(len(outline) - 2)[:, None] + [0, 1, 2]
            steps[:, 0] = 0
            fans = outline[(first + steps) % len(outline)]  # (corner, triangle, 3)
            shares = _overlaps(vertices, fans.reshape(-1, 3), np.repeat(first, len(steps)))
            faces[rows] = fans[shares.argmin()]
            FormatError.raise_if(
                shares.min() > _MAX_OVERLAP and len(outline) > 4,  # four corners that cross or fold stay
                f"{where}: face {concave + 1} is not convex, and triangles from any of its {len(outline)} "
                "corners overlap",
                mend="export the mesh with triangles as faces",
                code="mesh-unreadable",
            )
    return RawTriangles(vertices, faces, np.asarray(face_group, np.int64), tuple(groups))


def _overlaps(vertices: Floats, faces: Ints, polygon: Ints) -> Floats:
    # Return the area of every polygon's triangles that face away from the polygon, as a share of its area;
    # small for polygons without area.
    with np.errstate(all="ignore"):  # vertices that are not finite are refused later
        edges = vertices[faces[:, 1:]] - vertices[faces[:, :1]]
        normals = np.cross(edges[:, 0], edges[:, 1])
        sums = np.stack([np.bincount(polygon, column) for column in normals.T], axis=-1)
        area = np.linalg.norm(sums, axis=1)
        facing = (normals * sums[polygon]).sum(axis=1) / area[polygon]
        rounding = 1e-6 * np.bincount(polygon, (edges**2).sum(axis=(1, 2)))
        return np.asarray(np.bincount(polygon, np.maximum(-facing, 0.0)) / (area + rounding))


# --- PLY ---------------------------------------------------------------------------------------------------

_PLY_BYTES = {
    "char": 1, "int8": 1, "uchar": 1, "uint8": 1, "short": 2, "int16": 2, "ushort": 2, "uint16": 2, "int": 4,
    "int32": 4, "uint": 4, "uint32": 4, "float": 4, "float16": 2, "float32": 4, "double": 8, "float64": 8,
    "int64": 8, "uint64": 8,
}  # fmt: skip
_MAX_HEADER_BYTES = 65536


def check_ply(data: bytes, where: str) -> None:
    # Refuse a PLY file whose header declares more data than the file has, before memory is allocated.
    #
    # Raises `FormatError`: The PLY header is missing, or declares more data than the file has.
    found = f"{where}: it begins with {data[:4]!r}"
    FormatError.raise_if(not data.startswith(b"ply"), found, expected="b'ply'", code="format-unknown")
    head, separator, _ = data[:_MAX_HEADER_BYTES].partition(b"end_header")
    FormatError.raise_if(
        not separator,
        f"{where}: no end_header in its first {_MAX_HEADER_BYTES} bytes",
        code="header-truncated",
    )
    body_bytes = len(data) - len(head) - len(separator)
    lines = head.decode("latin-1").split("\n")
    binary = any("binary" in line for line in lines[:3])
    # minimum bytes of the kinds so far; number of elements of the present kind, and minimum bytes of an
    # element
    min_bytes, count, row = 0, 0, 0
    for line in [*lines, "element end 0"]:
        keyword, *words = line.split() or [""]
        found = f"{where}: the header has {line.strip()[:60]!r}"
        if keyword == "element":
            is_count = len(words) == 2 and re.fullmatch("[0-9]{1,18}", words[1])
            FormatError.raise_if(
                not is_count, found, expected="'element NAME COUNT'", code="header-unreadable"
            )
            min_bytes += count * row
            count, row = int(words[1]), 0
        elif keyword == "property":
            types = words[1:3] if words[:1] == ["list"] else words[:1]
            is_known = len(words) == len(types) + (2 if len(types) > 1 else 1) and {*types} <= {*_PLY_BYTES}
            FormatError.raise_if(
                not is_known, found, expected="'property TYPE NAME' or a list", code="header-unreadable"
            )
            row += _PLY_BYTES[types[0]] if binary else 2  # in text a digit and a separator
    FormatError.raise_if(
        min_bytes > body_bytes + 2,
        f"{where}: {body_bytes} bytes",
        expected=f"{min_bytes} or more, as its header declares",
        code="file-truncated",
    )


# --- GLB ---------------------------------------------------------------------------------------------------

_GLB_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}  # by component type
_COMPONENTS = {"SCALAR": 1, "VEC3": 3}
_MAX_NODE_DEPTH = 256
_TRIANGLES = 4  # primitive mode of triangles
_JSON, _BINARY = 0x4E4F534A, 0x004E4942  # types of chunks: "JSON" and "BIN" in ASCII


def strip_glb(data: bytes, where: str) -> tuple[bytes, tuple[str, ...], tuple[str, ...], int]:
    # Return a GLB file with only its triangles; ``where`` names the file in messages.
    #
    # Its meshes and materials are named "0", "1", ...; their names in the file and the number of triangles of
    # all nodes follow.
    #
    # Raises `FormatError`: The file is not a GLB file of version 2, is truncated or inconsistent, refers to
    # other files, or uses an unsupported compression or primitive.
    header, body = _chunks(data, where)
    entries = functools.partial(_entries, where=where)
    number = functools.partial(_whole_number, where=where)
    for name in entries(header, "extensionsRequired", str):
        FormatError.raise_if(
            not (name.startswith("KHR_materials_") or name == "KHR_texture_transform"),
            f"{where}: it requires the extension {name[:60]}",
            mend="export it without compression",
            code="extension-unsupported",
        )
    buffers, materials, meshes = (entries(header, key) for key in ("buffers", "materials", "meshes"))
    FormatError.raise_if(
        any("uri" in buffer for buffer in buffers),
        f"{where}: its buffer is in another file",
        mend="export it as one .glb",
        code="buffer-external",
    )
    FormatError.raise_if(
        len(buffers) > 1,
        f"{where}: it has more than one buffer",
        expected="the buffer inside the file",
        code="buffer-number",
    )
    # buffer views must be within the binary chunk
    views: list[dict[str, int]] = []
    for view in entries(header, "bufferViews"):
        begin = number(view, "byteOffset", len(body), 0)
        size = number(view, "byteLength", len(body) - begin)
        views.append({"buffer": number(view, "buffer", 0), "byteOffset": begin, "byteLength": size})
        if "byteStride" in view:
            views[-1]["byteStride"] = number(view, "byteStride", 252)
    originals, accessors = entries(header, "accessors"), []

    def accessor(of: dict[str, Any], key: str, kind: str) -> int:
        # new number of an accessor, which must be within its buffer view
        place = number(of, key, len(originals) - 1)
        original = originals[place]
        component = original.get("componentType")
        FormatError.raise_if(
            not (
                original.get("type") == kind
                and isinstance(component, int | float)
                and component in _GLB_BYTES
                and "sparse" not in original
            ),
            f"{where}: accessor {place} is {original.get('type')!s:.20}",
            expected=f"plain numbers of type {kind}",
            code="accessor-type",
        )
        FormatError.raise_if(
            kind != "SCALAR" and component != 5126,
            f"{where}: accessor {place} has quantised positions",
            expected="float",
            mend="export it without compression",
            code="accessor-type",
        )
        view_number = number(original, "bufferView", len(views) - 1)
        view, size = views[view_number], _GLB_BYTES[component] * _COMPONENTS[kind]
        begin = number(original, "byteOffset", view["byteLength"], 0)
        available = view["byteLength"] - begin
        most = (available - size) // (view.get("byteStride") or size) + 1 if available >= size else 0
        copied = {"bufferView": view_number, "byteOffset": begin, "componentType": component, "type": kind}
        accessors.append(copied | {"count": number(original, "count", most)})
        return len(accessors) - 1

    # meshes of triangles, with numbers for names
    stripped_meshes, triangle_counts = [], []
    for place, mesh in enumerate(meshes):
        primitives = []
        for primitive in entries(mesh, "primitives"):
            mode, attributes = primitive.get("mode", _TRIANGLES), primitive.get("attributes")
            FormatError.raise_if(
                mode != _TRIANGLES or not isinstance(attributes, dict),
                f"{where}: mesh {place} has a primitive of mode {mode!s:.20}, attributes {attributes!s:.20}",
                expected=f"triangles ({_TRIANGLES}) with POSITION",
                code="primitive-type",
            )
            kept = {"attributes": {"POSITION": accessor(attributes, "POSITION", "VEC3")}, "mode": mode}
            if "indices" in primitive:
                kept["indices"] = accessor(primitive, "indices", "SCALAR")
            if "material" in primitive:
                kept["material"] = number(primitive, "material", len(materials) - 1)
            primitives.append(kept)
        corners = [accessors[kept.get("indices", kept["attributes"]["POSITION"])] for kept in primitives]
        triangle_counts.append(sum(corner["count"] // 3 for corner in corners))
        stripped_meshes.append({"name": str(place), "primitives": primitives})
    nodes, roots = _nodes(entries(header, "nodes"), len(meshes), where)
    remaining = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": roots}],
        "buffers": [{"byteLength": len(body)}],
        "bufferViews": views,
        "accessors": accessors,
        "materials": [{"name": str(place)} for place in range(len(materials))],
        "meshes": stripped_meshes,
        "nodes": nodes,
    }
    text = json.dumps(remaining).encode()
    text += b" " * (-len(text) % 4)
    body += b"\0" * (-len(body) % 4)
    chunks = struct.pack("<II", len(text), _JSON) + text + struct.pack("<II", len(body), _BINARY) + body
    material_names, mesh_names = (
        tuple(name if isinstance(name := entry.get("name"), str) else "" for entry in part)
        for part in (materials, meshes)
    )
    triangles = sum(triangle_counts[node["mesh"]] for node in nodes if "mesh" in node)
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks, material_names, mesh_names, triangles


def _chunks(data: bytes, where: str) -> tuple[dict[str, Any], bytes]:
    # content of the JSON chunk, and the binary chunk
    FormatError.raise_if(
        len(data) < 20 or data[:4] != b"glTF",
        f"{where}: it begins with {data[:4]!r}",
        expected="a binary glTF file (b'glTF')",
        mend="export it as .glb",
        code="format-unknown",
    )
    _, version, length, size, kind = struct.unpack("<4sIIII", data[:20])
    FormatError.raise_if(
        version != 2 or kind != _JSON,
        f"{where}: glTF version {version}",
        expected="2 with its JSON chunk first",
        mend="export it again",
        code="format-version",
    )
    FormatError.raise_if(
        not 20 + size <= length <= len(data),
        f"{where}: {len(data)} bytes",
        expected=f"{length} with {size} of JSON, as its header declares",
        code="file-truncated",
    )
    with FormatError.instead_of(
        (ValueError, RecursionError),
        f"{where}: its JSON chunk cannot be read ($whole)",
        code="json-unreadable",
    ):
        header = json.loads(data[20 : 20 + size])
    FormatError.raise_if(
        not isinstance(header, dict),
        f"{where}: its JSON chunk holds {type(header).__name__}",
        expected="an object",
        code="type-wrong",
    )
    if length < 28 + size:
        return header, b""
    count, kind = struct.unpack("<II", data[20 + size : 28 + size])
    body = data[28 + size : 28 + size + count] if kind == _BINARY else b""
    FormatError.raise_if(
        kind == _BINARY and len(body) != count,
        f"{where}: its binary chunk has {len(body)} bytes",
        expected=f"{count}, as it declares",
        code="file-truncated",
    )
    return header, body


def _nodes(
    originals: list[dict[str, Any]], meshes: int, where: str
) -> tuple[list[dict[str, Any]], list[int]]:
    # nodes with mesh, transform and children only, and the numbers of those without a parent; nodes with
    # several parents, and circles, are refused
    nodes: list[dict[str, Any]] = []
    child_nodes: set[int] = set()
    for place, original in enumerate(originals):
        node: dict[str, Any] = {"name": f"node {place}"}
        if "mesh" in original:
            node["mesh"] = _whole_number(original, "mesh", meshes - 1, where=where)
        for key, count in (("matrix", 16), ("translation", 3), ("rotation", 4), ("scale", 3)):
            if key in original:
                node[key] = _entries(original, key, int | float, where=where)
                is_finite = all(map(is_number, node[key]))
                FormatError.raise_if(
                    not is_finite or len(node[key]) != count,
                    f"{where}: node {place} has a {key} of {len(node[key])} numbers",
                    expected=f"{count} finite numbers",
                    code="length-mismatch" if is_finite else "not-finite",
                )
                node[key] = list(map(float, node[key]))
        if children := _entries(original, "children", int, where=where):
            node["children"] = children
        for child in children:
            FormatError.raise_if(
                not 0 <= child < len(originals) or child in child_nodes,
                f"{where}: node {place} has the child {child}, which does not exist or has another parent",
                code="node-parent",
            )
            child_nodes.add(child)
        nodes.append(node)
    roots = [place for place in range(len(nodes)) if place not in child_nodes]
    reached, level = 0, roots
    for _ in range(_MAX_NODE_DEPTH):
        reached += len(level)
        level = [child for place in level for child in nodes[place].get("children", [])]
    FormatError.raise_if(
        level or reached != len(nodes),
        f"{where}: its nodes form a circle or too deep a tree",
        expected=f"at most {_MAX_NODE_DEPTH} levels",
        code="node-depth",
    )
    return nodes, roots


def _entries(of: dict[str, Any], key: str, kind: Any = dict, *, where: str) -> list[Any]:
    # list of a glTF object whose entries have a type
    entries = of.get(key, [])
    found = f"{where}: {key} is not a list of {getattr(kind, '__name__', 'numbers')}"
    is_right = isinstance(entries, list) and all(isinstance(entry, kind) for entry in entries)
    FormatError.raise_if(not is_right, found, code="type-wrong")
    return list(entries)


def _whole_number(of: dict[str, Any], key: str, most: int, default: int | None = None, *, where: str) -> int:
    number = of.get(key, default)
    FormatError.raise_if(
        not isinstance(number, int) or isinstance(number, bool) or not 0 <= number <= most,
        f"{where}: {key} is {str(number)[:40]}",
        expected=f"a whole number from 0 to {most}",
        code="value-out-of-range",
    )
    return int(number or 0)


# --- all ---------------------------------------------------------------------------------------------------


def _by_trimesh(data: bytes, where: str) -> RawTriangles:
    # triangles of a PLY or GLB file, after its sizes were checked
    with needs_extra("trimesh", "mesh", f"reading {where}"):
        trimesh: Any = importlib.import_module("trimesh")
    materials: Sequence[str] = ()
    meshes: Sequence[str] = ()
    kind = "ply"
    if where.lower().endswith(".glb"):
        kind = "glb"
        data, materials, meshes, triangles = strip_glb(data, where)
        FormatError.raise_if(
            triangles > _MAX_TRIANGLES,
            f"{where}: {triangles} triangles",
            expected=f"at most {_MAX_TRIANGLES}",
            mend="simplify the mesh",
            code="mesh-too-large",
        )
        if not triangles:
            return RawTriangles(np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros(0, np.int64), ())
    else:
        check_ply(data, where)
    # trimesh may raise any error
    with (
        FormatError.instead_of(
            Exception, f"{where}: trimesh cannot read it ($kind: $whole)", code="mesh-unreadable"
        ),
        warnings.catch_warnings(action="ignore"),  # numpy warns of trimesh's parsers
    ):
        options = {"skip_materials": True} if kind == "ply" else {}
        scene = trimesh.load_scene(io.BytesIO(data), file_type=kind, process=False, **options)
    vertices, faces, face_group = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], [np.zeros(0, np.int64)]
    groups: list[tuple[str, ...]] = []
    for node in sorted(scene.graph.nodes_geometry):
        transform, name = scene.graph[node]
        mesh = scene.geometry[name]
        corners = np.asarray(getattr(mesh, "faces", np.zeros((0, 3))), np.int64).reshape(-1, 3)
        faces.append(corners + sum(map(len, vertices)))
        face_group.append(np.full(len(corners), len(groups)))
        with np.errstate(all="ignore"):  # vertices that are not finite are refused later
            vertices.append(
                np.asarray(mesh.vertices, np.float64).reshape(-1, 3) @ transform[:3, :3].T + transform[:3, 3]
            )
        # names in the file, of which the stripped file has the numbers
        numbers = getattr(getattr(mesh.visual, "material", None), "name", None), name.partition("_")[0]
        groups.append(
            tuple(
                names[int(number)] if (number or "").isdecimal() and int(number) < len(names) else ""
                for names, number in zip((materials, meshes), numbers, strict=True)
            )
        )
    return RawTriangles(
        np.concatenate(vertices), np.concatenate(faces), np.concatenate(face_group), tuple(groups)
    )


_MAX_BYTES = 2**30
_MAX_DISTANCE_M = 1e8
#: Rotations of the upward axis of a file to z.
_UPRIGHT = {
    "x": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "z": np.eye(3),
}
#: Readers by suffix.
_READERS: dict[str, Callable[[bytes, str], RawTriangles]] = {
    ".obj": parse_obj,
    ".glb": _by_trimesh,
    ".ply": _by_trimesh,
}


def read_mesh(
    path: str | Path,
    materials: Mapping[str, Material] | None = None,
    *,
    default: Material | None = None,
    instance: Instance | str = "",
    unit: float = 1.0,
    up: str | None = None,
    crease: float | None = 40.0,
) -> Scene:
    # Return a mesh file as a scene of one instance.
    #
    # ``path``: A file that ends in .obj, .glb or .ply. ``materials``: Materials of parts of the mesh, by the
    # name of the material in the file, else by the name of the mesh, object or group. ``default``: Material
    # of all other parts. ``instance``: The instance, or its name; by default the name of the file. ``unit``:
    # Length unit of the file [m]: 0.001 for millimetres. ``up``: Upward axis of the file: "x", "y" or "z"; by
    # default y in GLB files (the glTF standard), else z. ``crease``: Normals are smoothed except at edges of
    # more than this angle [degree]; None for flat faces. Normals of the file are not read.
    #
    # Returns: Scene in metres, z up. Triangles without area are dropped with a `PaintWarning`; a mesh may be
    # open.
    #
    # Raises `FormatError`: The file is empty, truncated, damaged, too large (1 GiB, 50 million triangles), of
    # another format, without triangles, or has coordinates that are not finite or beyond 100,000 km. Raises
    # `SchemaError`: Parts of the mesh have no material, or ``unit`` or ``up`` is invalid. Raises
    # `MissingExtraError`: trimesh is not installed, for GLB and PLY.
    file, materials = Path(path), materials or {}
    suffix = file.suffix.lower()
    FormatError.raise_if(
        suffix not in _READERS,
        f"{file.name}: the suffix {suffix!r} is unknown",
        expected=f"one of {', '.join(_READERS)}",
        code="format-unknown",
    )
    upright = _UPRIGHT.get(("y" if suffix == ".glb" else "z") if up is None else up)
    if upright is None or not (np.isfinite(unit) and unit > 0):
        raise SchemaError(
            f"up={up!r} and unit={unit!r}",
            expected="one of x, y, z and a number of metres above 0",
            code="value-out-of-range",
        )
    data = read_limited(file, _MAX_BYTES, "a mesh")
    FormatError.raise_if(
        not data.strip(), f"{file.name}: the file is empty", expected="a mesh", code="empty-input"
    )
    raw = _READERS[suffix](data, file.name)
    FormatError.raise_if(
        not len(raw.faces), f"{file.name}: no triangles", expected="a mesh with faces", code="mesh-empty"
    )
    min_index, max_index, count = int(raw.faces.min()), int(raw.faces.max()), len(raw.vertices)
    FormatError.raise_if(
        min_index < 0 or max_index >= count,
        f"{file.name}: a face names vertex {max_index + 1 if max_index >= count else min_index}",
        expected=f"one of {count} vertices",
        mend="export the mesh again",
        code="vertex-unknown",
    )
    bad = np.flatnonzero(~np.isfinite(raw.vertices).all(axis=1))
    FormatError.raise_if(
        len(bad),
        f"{file.name}: {len(bad)} of {count} vertices are not finite, the first is number "
        f"{bad[0] if len(bad) else ''} counted from 0",
        mend="correct the mesh",
        code="not-finite",
    )
    max_distance = float(np.abs(raw.vertices).max(initial=0.0))
    FormatError.raise_if(
        not max_distance < _MAX_DISTANCE_M / unit,
        f"{file.name}: a vertex is {max_distance:.3g} units of {unit:g} m from the origin",
        expected=f"at most {_MAX_DISTANCE_M:g} m",
        mend="correct the mesh, or pass unit=",
        code="vertex-too-far",
    )
    vertices = unit * raw.vertices @ upright.T
    keeps_area = has_area(vertices, raw.faces)
    warn_of_dropped(file.stem, keeps_area)
    mesh_instance = Instance(instance or file.stem) if isinstance(instance, str) else instance
    # material of every group
    number_of_material: dict[Material, int] = {}
    numbers, unassigned = np.zeros(len(raw.groups), np.int64), []
    for group in np.unique(raw.face_group):
        names = raw.groups[group]
        material = next((materials[name] for name in names if name in materials), default)
        if material is None:
            unassigned.append(next((repr(name) for name in names if name), "a part without a name"))
        else:
            numbers[group] = number_of_material.setdefault(material, len(number_of_material))
    parts = list(dict.fromkeys(name for names in raw.groups for name in names if name))
    unknown = [name for name in materials if name not in parts]
    SchemaError.raise_if(
        unknown,
        f"{file.name} has no part named {', '.join(map(repr, unknown[:20]))}",
        expected=", ".join(map(repr, parts[:20])) or "none, since its parts have no names",
        code="paint-target-unknown",
    )
    SchemaError.raise_if(
        unassigned,
        f"{file.name}: no material for {', '.join(unassigned[:20])}",
        mend="name them in materials=, or pass default=",
        code="material-missing",
    )
    faces, surface = raw.faces[keeps_area], numbers[raw.face_group][keeps_area]
    scene_materials = tuple(number_of_material)
    normals = np.zeros((0, 3))
    if crease is not None:
        # merge coincident vertices, so that normals are smooth across seams
        order = np.lexsort(vertices.T)
        ordered = vertices[order]
        is_new = np.concatenate([[True], (ordered[1:] != ordered[:-1]).any(axis=1)])
        number = np.empty(len(vertices), np.int64)
        number[order] = np.cumsum(is_new) - 1
        vertices, faces = ordered[is_new], number[faces]
        mesh = smoothed(
            Mesh(vertices, faces, surface, tuple(material.name for material in scene_materials), 0 * surface),
            crease,
        )
        vertices, faces, normals, surface = mesh.vertices, mesh.faces, mesh.normals, mesh.surface
    return Scene.from_arrays(
        vertices,
        faces,
        scene_materials,
        face_material=surface,
        normals=normals,
        instance=mesh_instance,
        name=file.stem,
    )
