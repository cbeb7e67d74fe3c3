"""Scenes from mesh files: Wavefront OBJ, binary glTF (GLB) and PLY.

OBJ files are read here; GLB and PLY files through trimesh (``pip install 'hyperpaint[mesh]'``), after their
declared sizes were compared with the file. Files that a mesh refers to are never opened.

Of OBJ only ``v``, ``f`` and the names after ``usemtl``, ``o`` and ``g`` are read. A GLB file is first
stripped to nodes, meshes, positions, indices and numbers of materials, so that trimesh gets no pictures,
animations or references to other files.
"""

from __future__ import annotations

import importlib
import io
import json
import re
import struct
import warnings
from array import array
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import FormatError, SchemaError, needs_extra
from hyperpaint.base.input_files import read_limited

from .materials import Material
from .scene import Instance, Mesh, Scene, has_area, smoothed, warn_of_dropped

_MAX_TRIANGLES = 50_000_000
_MAX_VERTEX_INDEX = 2**40
_OBJ_LINE = re.compile(r"[^\n]*\n?")
_MAX_LINE_CHARS = 2**20


class RawTriangles(NamedTuple):
    """Triangles of a file.

    Attributes
    ----------
    vertices : (vertex, 3) float64
        Positions in the units and axes of the file.
    faces : (face, 3) int64
        Vertices of every triangle, not checked yet.
    face_group : (face,) int64
        Number of the group of every triangle.
    groups : tuple of (str, str)
        Names of the material and of the object of every group; empty if missing.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    face_group: NDArray[np.int64]
    groups: tuple[tuple[str, str], ...]


# --- OBJ ---------------------------------------------------------------------------------------------------


def parse_obj(data: bytes, where: str) -> RawTriangles:
    r"""Return the triangles of an OBJ file; polygons become fans. ``where`` names the file in messages.

    Raises
    ------
    FormatError
        A line cannot be read.

    Examples
    --------
    >>> quad = parse_obj(b"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nusemtl red\nf 1 2 3 -1\n", "quad.obj")
    >>> quad.faces.tolist(), quad.groups
    ([[0, 1, 2], [0, 2, 3]], (('red', ''),))
    """
    text = data.decode("utf-8", errors="replace").replace("\\\n", " ").replace("\\\r\n", " ")
    # arrays instead of lists, and line by line, because large meshes have millions of lines
    coordinates, corners, face_group = array("d"), array("q"), array("q")
    groups: dict[tuple[str, str], int] = {}
    material, object_name = "", ""
    group = -1
    for number, match in enumerate(_OBJ_LINE.finditer(text), 1):
        if match.end() - match.start() > _MAX_LINE_CHARS:
            raise FormatError(
                f"{where}: line {number} is too long",
                expected=f"at most {_MAX_LINE_CHARS} characters",
                code="line-too-long",
            )
        line = match[0]
        words = line.split()
        keyword = words[0] if words else ""
        if keyword == "v":
            position = _parse_numbers(float, words[1:4])
            if len(position) != 3:
                raise FormatError(
                    f"{where}: {_line(number, words)}",
                    expected="'v' and three numbers",
                    code="number-unreadable",
                )
            coordinates.extend(position)
        elif keyword == "f":
            if group < 0:
                group = groups.setdefault((material, object_name), len(groups))
            indices = _parse_numbers(int, [word.partition("/")[0] for word in words[1:]])
            if len(indices) < 3 or not all(0 < abs(index) < _MAX_VERTEX_INDEX for index in indices):
                raise FormatError(
                    f"{where}: {_line(number, words)}",
                    expected="'f' and three or more numbers of vertices, counted from 1",
                    code="number-unreadable",
                )
            vertex_count = len(coordinates) // 3  # negative numbers count back from the last vertex
            fan = [index - 1 if index > 0 else vertex_count + index for index in indices]
            for corner in range(1, len(fan) - 1):
                corners.extend((fan[0], fan[corner], fan[corner + 1]))
                face_group.append(group)
        elif keyword in ("usemtl", "o", "g"):
            name = line.strip()[len(keyword) :].strip()
            material, object_name = (name, object_name) if keyword == "usemtl" else (material, name)
            group = -1
    vertices = np.asarray(coordinates, np.float64).reshape(-1, 3)
    return RawTriangles(
        vertices,
        np.asarray(corners, np.int64).reshape(-1, 3),
        np.asarray(face_group, np.int64),
        tuple(groups),
    )


def _parse_numbers(kind: Callable[[str], Any], words: list[str]) -> list[Any]:
    # numbers of words; an empty list if a word is not a number
    try:
        return [kind(word) for word in words]
    except ValueError:
        return []


def _line(number: int, words: list[str]) -> str:
    return f"line {number} is {' '.join(words)[:60]!r}"


# --- PLY ---------------------------------------------------------------------------------------------------

_PLY_BYTES = {
    "char": 1, "int8": 1, "uchar": 1, "uint8": 1, "short": 2, "int16": 2, "ushort": 2, "uint16": 2, "int": 4,
    "int32": 4, "uint": 4, "uint32": 4, "float": 4, "float16": 2, "float32": 4, "double": 8, "float64": 8,
    "int64": 8, "uint64": 8,
}  # fmt: skip
_MAX_HEADER_BYTES = 65536


def read_ply(data: bytes, where: str) -> RawTriangles:
    # triangles of a PLY file; raises as `check_ply`, and for files that trimesh cannot read
    trimesh = _trimesh(where)
    check_ply(data, where)
    mesh = _load(trimesh.load_mesh, data, "ply", where, skip_materials=True)
    faces = _faces(mesh)
    vertices = np.asarray(mesh.vertices, np.float64).reshape(-1, 3)
    return RawTriangles(vertices, faces, np.zeros(len(faces), np.int64), (("", ""),))


def check_ply(data: bytes, where: str) -> None:
    """Refuse a PLY file whose header declares more data than the file has, before memory is allocated.

    Raises
    ------
    FormatError
        The PLY header is missing, or declares more data than the file has.
    """
    if not data.startswith(b"ply"):
        raise FormatError(f"{where}: it begins with {data[:4]!r}", expected="b'ply'", code="format-unknown")
    head, separator, _ = data[:_MAX_HEADER_BYTES].partition(b"end_header")
    if not separator:
        raise FormatError(
            f"{where}: no end_header in its first {_MAX_HEADER_BYTES} bytes", code="header-truncated"
        )
    body_bytes = len(data) - len(head) - len(separator)
    lines = head.decode("latin-1").split("\n")
    binary = any("binary" in line for line in lines[:3])
    # minimum bytes of the kinds so far; number of elements of the present kind, and minimum bytes of an
    # element
    min_bytes, count, row = 0, 0, 0
    for line in [*lines, "element end 0"]:
        words = line.split()
        found = f"{where}: the header has {line.strip()[:60]!r}"
        if words[:1] == ["element"]:
            min_bytes += count * row
            if len(words) != 3 or not words[2].isascii() or not words[2].isdigit() or len(words[2]) > 18:
                raise FormatError(found, expected="'element NAME COUNT'", code="header-unreadable")
            count, row = int(words[2]), 0
        elif words[:1] == ["property"]:
            is_list = words[1:2] == ["list"]
            kinds = words[2:4] if is_list else words[1:2]
            if len(words) != (5 if is_list else 3) or any(kind not in _PLY_BYTES for kind in kinds):
                raise FormatError(found, expected="'property TYPE NAME' or a list", code="header-unreadable")
            row += _PLY_BYTES[kinds[0]] if binary else 2  # in text a digit and a separator
    if min_bytes > body_bytes + 2:
        raise FormatError(
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


class Stripped(NamedTuple):
    """A GLB file reduced to its triangles.

    Attributes
    ----------
    data
        A GLB file whose meshes and materials are named "0", "1", ...
    materials, meshes
        Names in the original file.
    triangles
        Number of triangles of all nodes.
    """

    data: bytes
    materials: tuple[str, ...]
    meshes: tuple[str, ...]
    triangles: int


def read_glb(data: bytes, where: str) -> RawTriangles:
    # triangles of a GLB file; raises as `strip_glb`, and for files that trimesh cannot read
    trimesh = _trimesh(where)
    stripped = strip_glb(data, where)
    if stripped.triangles > _MAX_TRIANGLES:
        raise FormatError(
            f"{where}: {stripped.triangles} triangles",
            expected=f"at most {_MAX_TRIANGLES}",
            mend="simplify the mesh",
            code="mesh-too-large",
        )
    if not stripped.triangles:
        return RawTriangles(np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros(0, np.int64), ())
    scene = _load(trimesh.load_scene, stripped.data, "glb", where)
    vertices, faces, face_group = [], [], []
    groups: list[tuple[str, str]] = []
    first_vertex = 0
    for node in sorted(scene.graph.nodes_geometry):
        transform, name = scene.graph[node]
        mesh = scene.geometry[name]
        with np.errstate(all="ignore"):  # vertices that are not finite are refused later
            points = np.asarray(mesh.vertices, np.float64) @ transform[:3, :3].T + transform[:3, 3]
        material = getattr(getattr(mesh.visual, "material", None), "name", None)
        vertices.append(points)
        faces.append(_faces(mesh) + first_vertex)
        face_group.append(np.full(len(faces[-1]), len(groups)))
        groups.append(
            (
                _original_name(stripped.materials, material),
                _original_name(stripped.meshes, name.partition("_")[0]),
            )
        )
        first_vertex += len(points)
    return RawTriangles(
        np.concatenate(vertices), np.concatenate(faces), np.concatenate(face_group), tuple(groups)
    )


def strip_glb(data: bytes, where: str) -> Stripped:
    """Return a GLB file with only its triangles; ``where`` names the file in messages.

    Raises
    ------
    FormatError
        The file is not a GLB file of version 2, is truncated or inconsistent, refers to other files, or uses
        an unsupported compression or primitive.
    """
    header, body = _chunks(data, where)
    check = _GlbCheck(header, len(body), where)
    remaining, triangles = check.stripped()
    text = json.dumps(remaining).encode()
    text += b" " * (-len(text) % 4)
    body += b"\0" * (-len(body) % 4)
    chunks = struct.pack("<II", len(text), _JSON) + text + struct.pack("<II", len(body), _BINARY) + body
    glb = struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
    return Stripped(glb, check.names("materials"), check.names("meshes"), triangles)


def _chunks(data: bytes, where: str) -> tuple[dict[str, Any], bytes]:
    if len(data) < 20 or data[:4] != b"glTF":
        raise FormatError(
            f"{where}: it begins with {data[:4]!r}",
            expected="a binary glTF file (b'glTF')",
            mend="export it as .glb",
            code="format-unknown",
        )
    _, version, length, size, kind = struct.unpack("<4sIIII", data[:20])
    if version != 2 or kind != _JSON:
        raise FormatError(
            f"{where}: glTF version {version}",
            expected="2 with its JSON chunk first",
            mend="export it again",
            code="format-version",
        )
    if length > len(data) or 20 + size > length:
        raise FormatError(
            f"{where}: {len(data)} bytes",
            expected=f"{length} with {size} of JSON, as its header declares",
            code="file-truncated",
        )
    try:
        header = json.loads(data[20 : 20 + size])
    except (ValueError, RecursionError) as error:
        raise FormatError(
            f"{where}: its JSON chunk cannot be read ({error})", code="json-unreadable"
        ) from error
    if not isinstance(header, dict):
        raise FormatError(
            f"{where}: its JSON chunk holds {type(header).__name__}", expected="an object", code="type-wrong"
        )
    if length < 28 + size:
        return header, b""
    count, kind = struct.unpack("<II", data[20 + size : 28 + size])
    body = data[28 + size : 28 + size + count] if kind == _BINARY else b""
    if kind == _BINARY and len(body) != count:
        raise FormatError(
            f"{where}: its binary chunk has {len(body)} bytes",
            expected=f"{count}, as it declares",
            code="file-truncated",
        )
    return header, body


# Extracts the parts of a glTF header that triangles need; refuses references to other files.
class _GlbCheck:
    def __init__(self, header: dict[str, Any], size: int, where: str) -> None:
        self.header, self.size, self.where = header, size, where
        for name in self.entries("extensionsRequired", str):
            if not name.startswith("KHR_materials_") and name != "KHR_texture_transform":
                self.fail(
                    f"it requires the extension {name[:60]}",
                    mend="export it without compression",
                    code="extension-unsupported",
                )
        if any("uri" in buffer for buffer in self.entries("buffers")):
            self.fail("its buffer is in another file", mend="export it as one .glb", code="buffer-external")
        if len(self.entries("buffers")) > 1:
            self.fail(
                "it has more than one buffer", expected="the buffer inside the file", code="buffer-number"
            )
        self.views = [self.view(view) for view in self.entries("bufferViews")]
        self.original_accessors = self.entries("accessors")
        self.accessor_numbers: dict[tuple[int, str], int] = {}
        self.accessors: list[dict[str, Any]] = []

    def fail(self, found: str, *, expected: str = "", mend: str = "", code: str) -> NoReturn:
        raise FormatError(f"{self.where}: {found}", expected=expected, mend=mend, code=code)

    def entries(self, key: str, kind: Any = dict, of: dict[str, Any] | None = None) -> list[Any]:
        entries = (self.header if of is None else of).get(key, [])
        if not isinstance(entries, list) or not all(isinstance(entry, kind) for entry in entries):
            self.fail(f"{key} is not a list of {getattr(kind, '__name__', 'numbers')}", code="type-wrong")
        return list(entries)

    def names(self, key: str) -> tuple[str, ...]:
        names = [entry.get("name") for entry in self.entries(key)]
        return tuple(name if isinstance(name, str) else "" for name in names)

    def whole_number(self, of: dict[str, Any], key: str, most: int, default: int | None = None) -> int:
        number = of.get(key, default)
        if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number <= most:
            self.fail(
                f"{key} is {str(number)[:40]}",
                expected=f"a whole number from 0 to {most}",
                code="value-out-of-range",
            )
        return number

    def view(self, view: dict[str, Any]) -> dict[str, int]:
        # buffer view, which must be within the binary chunk
        begin = self.whole_number(view, "byteOffset", self.size, 0)
        length = self.whole_number(view, "byteLength", self.size - begin)
        self.whole_number(view, "buffer", 0)
        stride = {"byteStride": self.whole_number(view, "byteStride", 252)} if "byteStride" in view else {}
        return {"buffer": 0, "byteOffset": begin, "byteLength": length} | stride

    def accessor(self, of: dict[str, Any], key: str, kind: str) -> int:
        # new number of an accessor, which must be within its buffer view
        number = self.whole_number(of, key, len(self.original_accessors) - 1)
        if (number, kind) in self.accessor_numbers:
            return self.accessor_numbers[number, kind]
        original = self.original_accessors[number]
        component = original.get("componentType")
        if original.get("type") != kind or component not in _GLB_BYTES or "sparse" in original:
            self.fail(
                f"accessor {number} is {original.get('type')!s:.20}",
                expected=f"plain numbers of type {kind}",
                code="accessor-type",
            )
        if kind == "VEC3" and component != 5126:
            self.fail(
                f"accessor {number} has quantised positions",
                expected="float",
                mend="export it without compression",
                code="accessor-type",
            )
        view_number = self.whole_number(original, "bufferView", len(self.views) - 1)
        view, size = self.views[view_number], _GLB_BYTES[component] * _COMPONENTS[kind]
        begin = self.whole_number(original, "byteOffset", view["byteLength"], 0)
        available = view["byteLength"] - begin
        max_count = (available - size) // (view.get("byteStride") or size) + 1 if available >= size else 0
        self.accessor_numbers[number, kind] = len(self.accessors)
        self.accessors.append(
            {
                "bufferView": view_number,
                "byteOffset": begin,
                "componentType": component,
                "count": self.whole_number(original, "count", max_count),
                "type": kind,
            }
        )
        return self.accessor_numbers[number, kind]

    def stripped(self) -> tuple[dict[str, Any], int]:
        meshes = [self.mesh(mesh, number) for number, mesh in enumerate(self.entries("meshes"))]
        nodes = [self.node(node, number) for number, node in enumerate(self.entries("nodes"))]
        roots = self.roots(nodes)
        triangle_counts = [
            sum(
                self.accessors[primitive.get("indices", primitive["attributes"]["POSITION"])]["count"] // 3
                for primitive in mesh["primitives"]
            )
            for mesh in meshes
        ]
        return {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": roots}],
            "buffers": [{"byteLength": self.size}],
            "bufferViews": self.views,
            "accessors": self.accessors,
            "materials": [{"name": str(number)} for number in range(len(self.entries("materials")))],
            "meshes": meshes,
            "nodes": nodes,
        }, sum(triangle_counts[node["mesh"]] for node in nodes if "mesh" in node)

    def mesh(self, mesh: dict[str, Any], number: int) -> dict[str, Any]:
        primitives = []
        for primitive in self.entries("primitives", of=mesh):
            mode, attributes = primitive.get("mode", _TRIANGLES), primitive.get("attributes")
            if mode != _TRIANGLES:
                self.fail(
                    f"mesh {number} has a primitive of mode {mode!s:.20}",
                    expected=f"triangles ({_TRIANGLES})",
                    code="primitive-type",
                )
            if not isinstance(attributes, dict):
                self.fail(
                    f"mesh {number} has a primitive without attributes",
                    expected="POSITION",
                    code="primitive-type",
                )
            position = self.accessor(attributes, "POSITION", "VEC3")
            stripped: dict[str, Any] = {"attributes": {"POSITION": position}, "mode": _TRIANGLES}
            if "indices" in primitive:
                stripped["indices"] = self.accessor(primitive, "indices", "SCALAR")
            if "material" in primitive:
                stripped["material"] = self.whole_number(
                    primitive, "material", len(self.entries("materials")) - 1
                )
            primitives.append(stripped)
        return {"name": str(number), "primitives": primitives}

    def node(self, node: dict[str, Any], number: int) -> dict[str, Any]:
        stripped: dict[str, Any] = {"name": f"node {number}"}
        if "mesh" in node:
            stripped["mesh"] = self.whole_number(node, "mesh", len(self.entries("meshes")) - 1)
        for key, count in (("matrix", 16), ("translation", 3), ("rotation", 4), ("scale", 3)):
            if key in node:
                values = self.entries(key, int | float, of=node)
                if len(values) != count:
                    self.fail(
                        f"node {number} has a {key} of {len(values)} numbers",
                        expected=f"{count}",
                        code="length-mismatch",
                    )
                stripped[key] = [float(value) for value in values]
        children = self.entries("children", int, of=node)
        return stripped | ({"children": children} if children else {})

    def roots(self, nodes: list[dict[str, Any]]) -> list[int]:
        # nodes without a parent; nodes with several parents, and circles, are refused
        child_nodes: set[int] = set()
        for number, node in enumerate(nodes):
            for child in node.get("children", []):
                if not 0 <= child < len(nodes) or child in child_nodes:
                    self.fail(
                        f"node {number} has the child {child}, which does not exist or has another parent",
                        code="node-parent",
                    )
                child_nodes.add(child)
        roots = [number for number in range(len(nodes)) if number not in child_nodes]
        reached, level = 0, roots
        for _ in range(_MAX_NODE_DEPTH):
            reached += len(level)
            level = [child for number in level for child in nodes[number].get("children", [])]
        if level or reached != len(nodes):
            self.fail(
                "its nodes form a circle or too deep a tree",
                expected=f"at most {_MAX_NODE_DEPTH} levels",
                code="node-depth",
            )
        return roots


def _trimesh(where: str) -> Any:
    with needs_extra("trimesh", "mesh", f"reading {where}"):
        return importlib.import_module("trimesh")


def _load(load: Callable[..., Any], data: bytes, kind: str, where: str, **options: Any) -> Any:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numpy warns of trimesh's parsers
            return load(io.BytesIO(data), file_type=kind, process=False, **options)
    except Exception as error:  # trimesh may raise any error
        raise FormatError(
            f"{where}: trimesh cannot read it ({type(error).__name__}: {error})", code="mesh-unreadable"
        ) from error


def _faces(mesh: Any) -> NDArray[np.int64]:
    return np.asarray(getattr(mesh, "faces", np.zeros((0, 3))), np.int64).reshape(-1, 3)


def _original_name(names: tuple[str, ...], number: str | None) -> str:
    return "" if number is None or not number.isdecimal() or int(number) >= len(names) else names[int(number)]


_MAX_BYTES = 2**30
_MAX_DISTANCE_M = 1e8
#: Rotations of the upward axis of a file to z.
_UPRIGHT = {
    "x": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "z": np.eye(3),
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
    """Return a mesh file as a scene of one instance.

    Parameters
    ----------
    path
        A file that ends in .obj, .glb or .ply.
    materials
        Materials of parts of the mesh, by the name of the material in the file, else by the name of the mesh,
        object or group.
    default
        Material of all other parts.
    instance
        The instance, or its name; by default the name of the file.
    unit
        Length unit of the file [m]: 0.001 for millimetres.
    up
        Upward axis of the file: "x", "y" or "z"; by default y in GLB files (the glTF standard), else z.
    crease
        Normals are smoothed except at edges of more than this angle [degree]; None for flat faces. Normals of
        the file are not read.

    Returns
    -------
    Scene
        Scene in metres, z up. Triangles without area are dropped with a `PaintWarning`; a mesh may be open.

    Raises
    ------
    FormatError
        The file is empty, truncated, damaged, too large (1 GiB, 50 million triangles), of another format,
        without triangles, or has coordinates that are not finite or beyond 100,000 km.
    SchemaError
        Parts of the mesh have no material, or ``unit`` or ``up`` is invalid.
    MissingExtraError
        trimesh is not installed, for GLB and PLY.
    """
    file = Path(path)
    readers: dict[str, Callable[[bytes, str], RawTriangles]] = {
        ".obj": parse_obj,
        ".glb": read_glb,
        ".ply": read_ply,
    }
    suffix = file.suffix.lower()
    if suffix not in readers:
        raise FormatError(
            f"{file.name}: the suffix {suffix!r} is unknown",
            expected=f"one of {', '.join(readers)}",
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
    if not data.strip():
        raise FormatError(f"{file.name}: the file is empty", expected="a mesh", code="empty-input")
    raw = readers[suffix](data, file.name)
    _check(raw, file.name)
    max_distance = float(np.abs(raw.vertices).max(initial=0.0))
    if not max_distance < _MAX_DISTANCE_M / unit:
        raise FormatError(
            f"{file.name}: a vertex is {max_distance:.3g} units of {unit:g} m from the origin",
            expected=f"at most {_MAX_DISTANCE_M:g} m",
            mend="correct the mesh, or pass unit=",
            code="vertex-too-far",
        )
    vertices = unit * raw.vertices @ upright.T
    keeps_area = has_area(vertices, raw.faces)
    warn_of_dropped(file.stem, keeps_area)
    mesh_instance = Instance(instance or file.stem) if isinstance(instance, str) else instance
    scene_materials, surface = _assign_materials(raw, materials or {}, default, file.name)
    faces, surface = raw.faces[keeps_area], surface[keeps_area]
    normals = np.zeros((0, 3))
    if crease is not None:
        vertices, faces = _welded(vertices, faces)
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


def _check(raw: RawTriangles, where: str) -> None:
    if not len(raw.faces):
        raise FormatError(f"{where}: no triangles", expected="a mesh with faces", code="mesh-empty")
    min_index, max_index, count = int(raw.faces.min()), int(raw.faces.max()), len(raw.vertices)
    if min_index < 0 or max_index >= count:
        wrong_index = max_index + 1 if max_index >= count else min_index
        raise FormatError(
            f"{where}: a face names vertex {wrong_index}",
            expected=f"one of {count} vertices",
            mend="export the mesh again",
            code="vertex-unknown",
        )
    bad = np.flatnonzero(~np.isfinite(raw.vertices).all(axis=1))
    if len(bad):
        raise FormatError(
            f"{where}: {len(bad)} of {len(raw.vertices)} vertices are not finite, the first is number "
            f"{bad[0]} counted from 0",
            mend="correct the mesh",
            code="not-finite",
        )


def _assign_materials(
    raw: RawTriangles, materials: Mapping[str, Material], default: Material | None, where: str
) -> tuple[tuple[Material, ...], NDArray[np.int64]]:
    number_of_material: dict[Material, int] = {}
    numbers = np.zeros(len(raw.groups), np.int64)
    unassigned = []
    for group in np.unique(raw.face_group):
        known_names = [name for name in raw.groups[group] if name in materials]
        material = materials[known_names[0]] if known_names else default
        if material is None:
            unassigned.append(
                next((repr(name) for name in raw.groups[group] if name), "a part without a name")
            )
            continue
        numbers[group] = number_of_material.setdefault(material, len(number_of_material))
    if unassigned:
        raise SchemaError(
            f"{where}: no material for {', '.join(unassigned[:20])}",
            mend="name them in materials=, or pass default=",
            code="material-missing",
        )
    return tuple(number_of_material), numbers[raw.face_group]


def _welded(vertices: Floats, faces: NDArray[np.int64]) -> tuple[Floats, NDArray[np.int64]]:
    # merge coincident vertices, so that normals are smooth across seams
    order = np.lexsort(vertices.T)
    sorted_vertices = vertices[order]
    is_new = np.concatenate([[True], (sorted_vertices[1:] != sorted_vertices[:-1]).any(axis=1)])
    number = np.empty(len(vertices), np.int64)
    number[order] = np.cumsum(is_new) - 1
    return sorted_vertices[is_new], number[faces]
