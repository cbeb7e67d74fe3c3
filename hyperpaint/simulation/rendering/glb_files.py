"""A binary glTF file (GLB, version 2) stripped to its triangles, before another program reads it.

What remains is nodes, meshes, positions, indices and the numbers of materials; every size has been held
against the file's. Pictures, animations and references to other files are gone.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from typing import Any, NamedTuple

from hyperpaint.base.errors import FormatError

__all__ = ["Stripped", "strip_glb"]

_SIZES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}  # bytes of a component type
_COMPONENTS = {"SCALAR": 1, "VEC3": 3}
_DEEPEST = 256  # nodes below one another
_TRIANGLES = 4  # the mode of a primitive
_JSON, _BINARY = 0x4E4F534A, 0x004E4942  # types of a chunk: "JSON" and "BIN" in ASCII


class Stripped(NamedTuple):
    """What is left of a file.

    Attributes
    ----------
    data
        A GLB file whose meshes and materials are called "0", "1", ...
    materials, meshes
        Their names in the original.
    triangles
        How many there are when every node has its own.
    """

    data: bytes
    materials: tuple[str, ...]
    meshes: tuple[str, ...]
    triangles: int


def strip_glb(data: bytes, where: str) -> Stripped:
    """Return a GLB file with nothing but its triangles.

    Parameters
    ----------
    data
        The whole file.
    where
        Its name, for messages.

    Raises
    ------
    FormatError
        The file is no GLB of version 2, is cut, contradicts itself, refers to other files, or uses a
        compression or primitives that are not read.
    """
    header, body = _chunks(data, where)
    read = _Reader(header, len(body), where)
    views = [read.view(view) for view in read.many("bufferViews")]
    kept = _kept(read, views)
    text = json.dumps(kept).encode()
    text += b" " * (-len(text) % 4)
    body += b"\0" * (-len(body) % 4)
    whole = struct.pack("<II", len(text), _JSON) + text + struct.pack("<II", len(body), _BINARY) + body
    clean = struct.pack("<4sII", b"glTF", 2, 12 + len(whole)) + whole
    materials = tuple(_name(material) for material in read.many("materials"))
    meshes = tuple(_name(mesh) for mesh in read.many("meshes"))
    return Stripped(clean, materials, meshes, _triangles(kept))


def _chunks(data: bytes, where: str) -> tuple[dict[str, Any], bytes]:
    """Return the description and the numbers of a GLB file."""
    if len(data) < 20 or data[:4] != b"glTF":
        raise FormatError(
            f"{where}: it begins with {data[:4]!r}, expected a binary glTF file (b'glTF'); export it as .glb"
        )
    _, version, length, size, kind = struct.unpack("<4sIIII", data[:20])
    if version != 2 or kind != _JSON:
        raise FormatError(
            f"{where}: glTF version {version}, expected 2 with its JSON chunk first; export it anew"
        )
    if length > len(data) or 20 + size > length:
        raise FormatError(
            f"{where}: it declares {length} bytes with {size} of JSON, found {len(data)}; "
            "the file is cut or damaged"
        )
    try:
        header = json.loads(data[20 : 20 + size])
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{where}: its JSON chunk cannot be read ({error}); the file is damaged") from error
    if not isinstance(header, dict):
        raise FormatError(f"{where}: its JSON chunk holds {type(header).__name__}, expected an object")
    body = b""
    if length >= 28 + size:
        count, kind = struct.unpack("<II", data[20 + size : 28 + size])
        if kind == _BINARY:
            body = data[28 + size : 28 + size + count]
            if len(body) != count:
                raise FormatError(
                    f"{where}: its binary chunk declares {count} bytes, found {len(body)}; the file is cut"
                )
    return header, body


class _Reader:
    """Takes values out of the description, and fails in words where they are not what they must be."""

    def __init__(self, header: dict[str, Any], size: int, where: str) -> None:
        self.header, self.size, self.where = header, size, where
        for name in self.many("extensionsRequired", str):
            if not name.startswith("KHR_materials_") and name != "KHR_texture_transform":
                self.fail(
                    f"it needs the extension {name[:60]}, which is not read; export it without compression"
                )
        for buffer in self.many("buffers"):
            if "uri" in buffer:
                self.fail("it refers to another file for its numbers; export it as one .glb")
        if len(self.many("buffers")) > 1:
            self.fail("it has more than one buffer, expected the one inside the file")

    def fail(self, message: str) -> None:
        """Raise the error."""
        whole = f"{self.where}: {message}"
        raise FormatError(whole)

    def many(self, key: str, kind: type = dict, of: dict[str, Any] | None = None) -> list[Any]:
        """Return a list of ``kind`` under a key; empty where there is none."""
        found = (self.header if of is None else of).get(key, [])
        if not isinstance(found, list) or not all(isinstance(one, kind) for one in found):
            self.fail(f"{key} is not a list of {kind.__name__}")
        return list(found)

    def whole(self, of: dict[str, Any], key: str, most: int, default: int | None = None) -> int:
        """Return a whole number from 0 to ``most`` under a key."""
        found = of.get(key, default)
        if isinstance(found, bool) or not isinstance(found, int) or not 0 <= found <= most:
            self.fail(f"{key} is {str(found)[:40]}, expected a whole number from 0 to {most}")
        return int(found)  # type: ignore[arg-type]

    def view(self, view: dict[str, Any]) -> dict[str, int]:
        """Return a stretch of the numbers that lies within them."""
        begin = self.whole(view, "byteOffset", self.size, 0)
        length = self.whole(view, "byteLength", self.size - begin)
        self.whole(view, "buffer", 0)
        return {"buffer": 0, "byteOffset": begin, "byteLength": length} | (
            {"byteStride": self.whole(view, "byteStride", 252)} if "byteStride" in view else {}
        )

    def accessor(self, number: int, kind: str, views: list[dict[str, int]]) -> dict[str, Any]:
        """Return numbers of one type that lie within their stretch."""
        given = self.many("accessors")[number]
        if given.get("type") != kind or given.get("componentType") not in _SIZES or "sparse" in given:
            self.fail(
                f"accessor {number} is {given.get('type')!s:.20}, expected plain numbers of type {kind}"
            )
        if kind == "VEC3" and given["componentType"] != 5126:
            self.fail(
                f"accessor {number} has quantised positions, expected float; export it without compression"
            )
        view = views[self.whole(given, "bufferView", len(views) - 1)]
        size = _SIZES[given["componentType"]] * _COMPONENTS[kind]
        begin = self.whole(given, "byteOffset", view["byteLength"], 0)
        stride = view.get("byteStride") or size
        room = view["byteLength"] - begin
        most = (room - size) // stride + 1 if room >= size else 0
        count = self.whole(given, "count", most)
        return {
            "bufferView": given["bufferView"],
            "byteOffset": begin,
            "componentType": given["componentType"],
            "count": count,
            "type": kind,
        }


def _kept(read: _Reader, views: list[dict[str, int]]) -> dict[str, Any]:
    """Return the description of what remains."""
    accessors: list[dict[str, Any]] = []
    numbers: dict[tuple[int, str], int] = {}

    def number_of(key: int, kind: str) -> int:
        if (key, kind) not in numbers:
            numbers[key, kind] = len(accessors)
            accessors.append(read.accessor(key, kind, views))
        return numbers[key, kind]

    meshes = [_mesh(read, mesh, number, number_of) for number, mesh in enumerate(read.many("meshes"))]
    nodes = [_node(read, node, number) for number, node in enumerate(read.many("nodes"))]
    roots = _roots(read, nodes)
    return {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": roots}],
        "buffers": [{"byteLength": read.size}],
        "bufferViews": views,
        "accessors": accessors,
        "materials": [{"name": str(number)} for number in range(len(read.many("materials")))],
        "meshes": meshes,
        "nodes": nodes,
    }


def _mesh(
    read: _Reader, mesh: dict[str, Any], number: int, number_of: Callable[[int, str], int]
) -> dict[str, Any]:
    most = len(read.many("accessors")) - 1
    kept = []
    for primitive in read.many("primitives", of=mesh):
        mode = primitive.get("mode", _TRIANGLES)
        if mode != _TRIANGLES:
            read.fail(
                f"mesh {number} has a primitive of mode {mode!s:.20}, expected triangles ({_TRIANGLES})"
            )
        attributes = primitive.get("attributes")
        if not isinstance(attributes, dict):
            read.fail(f"mesh {number} has a primitive without attributes, expected POSITION")
        place = read.whole(attributes or {}, "POSITION", most)
        one: dict[str, Any] = {"attributes": {"POSITION": number_of(place, "VEC3")}, "mode": _TRIANGLES}
        if "indices" in primitive:
            one["indices"] = number_of(read.whole(primitive, "indices", most), "SCALAR")
        if "material" in primitive:
            one["material"] = read.whole(primitive, "material", len(read.many("materials")) - 1)
        kept.append(one)
    return {"name": str(number), "primitives": kept}


def _node(read: _Reader, node: dict[str, Any], number: int) -> dict[str, Any]:
    kept: dict[str, Any] = {"name": f"node {number}"}
    if "mesh" in node:
        kept["mesh"] = read.whole(node, "mesh", len(read.many("meshes")) - 1)
    for key, count in (("matrix", 16), ("translation", 3), ("rotation", 4), ("scale", 3)):
        if key in node:
            values = read.many(key, (int | float), of=node)  # type: ignore[arg-type]
            if len(values) != count:
                read.fail(f"node {number} has a {key} of {len(values)} numbers, expected {count}")
            kept[key] = [float(value) for value in values]
    children = read.many("children", int, of=node)
    if children:
        kept["children"] = children
    return kept


def _roots(read: _Reader, nodes: list[dict[str, Any]]) -> list[int]:
    """Return the nodes without a parent; every other node must have one, and none may be its own ancestor."""
    parent: dict[int, int] = {}
    for number, node in enumerate(nodes):
        for child in node.get("children", []):
            if not 0 <= child < len(nodes) or child in parent:
                read.fail(
                    f"node {number} has the child {child}, which does not exist or has a parent already"
                )
            parent[child] = number
    roots = [number for number in range(len(nodes)) if number not in parent]
    reached, level = 0, roots
    for _ in range(_DEEPEST):
        reached += len(level)
        level = [child for number in level for child in nodes[number].get("children", [])]
    if level or reached != len(nodes):
        read.fail(f"its nodes lie in a circle, or more than {_DEEPEST} below one another")
    return roots


def _triangles(kept: dict[str, Any]) -> int:
    """Return the number of triangles of all nodes."""
    own = []
    for mesh in kept["meshes"]:
        places = [one.get("indices", one["attributes"]["POSITION"]) for one in mesh["primitives"]]
        own.append(sum(kept["accessors"][place]["count"] // 3 for place in places))
    return sum(own[node["mesh"]] for node in kept["nodes"] if "mesh" in node)


def _name(thing: dict[str, Any]) -> str:
    found = thing.get("name", "")
    return found if isinstance(found, str) else ""
