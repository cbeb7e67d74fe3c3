"""Mesh files: known boxes in three formats, names and axes; and files that are damaged or lie."""

import contextlib
import json
import struct
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st
from support.refusals import expect_error, expect_errors

from hyperpaint.base.errors import FormatError, MissingExtraError, PaintError, PaintWarning, SchemaError
from hyperpaint.simulation.rendering.materials import Material
from hyperpaint.simulation.rendering.mesh_files import check_ply, parse_obj, read_mesh, strip_glb
from hyperpaint.simulation.rendering.scene import MAX_FACES_AROUND, Mesh, smoothed

GREY = Material("grey", "panel_20", "panel")
RED = Material("red paint", "red", "paint")
CORNERS = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], float) * (1, 2, 3)
QUADS = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [1, 3, 7, 5], [3, 2, 6, 7], [2, 0, 4, 6]]
FACES = np.array([[quad[i] for i in corner] for quad in QUADS for corner in ((0, 1, 2), (0, 2, 3))])

OBJ = "\n".join(
    [
        "# a box", "mtllib ../../../../etc/passwd", "o lower",
        *(f"v {x} {y} {z}" for x, y, z in CORNERS), "vt 0 0", "vn 0 0 1", "usemtl red",
        *("f " + " ".join(f"{corner + 1}/1/1" for corner in quad) for quad in QUADS[:5]), "usemtl bl\u00fc",
        "f " + " ".join(str(corner - 8) for corner in QUADS[5]), "",
    ]
)  # fmt: skip


def glb(changes: dict[str, Any] | None = None, *, drop: int = 0) -> bytes:
    # Return a GLB file with two boxes, made by hand; ``drop`` bytes missing at its end
    indices, points = FACES.astype("<u2").tobytes(), CORNERS.astype("<f4").tobytes()
    body = indices + points
    header: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0, 1]}],
        "nodes": [
            {"mesh": 0, "name": "first"},
            {"translation": [10, 0, 0], "children": [2]},
            {"mesh": 1, "scale": [2, 2, 2]},
        ],
        "meshes": [
            {"name": "box", "primitives": [{"attributes": {"POSITION": 1}, "indices": 0, "material": 1}]},
            {"name": "other_box", "primitives": [{"attributes": {"POSITION": 1}, "indices": 0}]},
        ],
        "materials": [
            {"name": "unused"},
            {"name": "body", "pbrMetallicRoughness": {"baseColorTexture": {"index": 9}}},
        ],
        "images": [{"uri": "../../secret.png"}],
        "accessors": [
            {"bufferView": 0, "componentType": 5123, "count": 36, "type": "SCALAR"},
            {"bufferView": 1, "componentType": 5126, "count": 8, "type": "VEC3"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": len(indices)},
            {"buffer": 0, "byteOffset": len(indices), "byteLength": len(points)},
        ],
        "buffers": [{"byteLength": len(body)}],
    }
    text = json.dumps(header | (changes or {})).encode()
    text += b" " * (-len(text) % 4)
    chunks = (
        struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(body), 0x004E4942) + body
    )
    whole = struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
    return whole[: len(whole) - drop]


def ply(*, binary: bool = True, vertices: int = 8) -> bytes:
    # Return a box as a PLY file
    form = "binary_little_endian" if binary else "ascii"
    head = f"ply\nformat {form} 1.0\nelement vertex {vertices}\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz")
    head += f"element face {len(FACES)}\nproperty list uchar int vertex_indices\nend_header\n"
    if binary:
        rows = b"".join(b"\x03" + row.tobytes() for row in FACES.astype("<i4"))
        return head.encode() + CORNERS.astype("<f4").tobytes() + rows
    lines = [" ".join(map(str, row)) for row in CORNERS] + ["3 " + " ".join(map(str, row)) for row in FACES]
    return (head + "\n".join(lines) + "\n").encode()


def written(folder: Path, name: str, data: bytes | str) -> Path:
    path = folder / name
    path.write_bytes(data.encode() if isinstance(data, str) else data)
    return path


def volume(scene: Any) -> float:
    a, b, c = (scene.vertices[scene.faces[:, corner]] for corner in range(3))
    return float((np.cross(a, b) * c).sum() / 6)


@pytest.fixture
def trimesh() -> Any:
    return pytest.importorskip("trimesh", reason="trimesh (extra 'mesh') reads GLB and PLY")


def test_an_obj_box_by_material_and_by_object(tmp_path: Path) -> None:
    scene = read_mesh(written(tmp_path, "box.obj", OBJ), {"red": RED, "lower": GREY})
    assert (scene.name, scene.instances[0].name, len(scene.faces)) == ("box", "box", 12)
    assert volume(scene) == pytest.approx(6.0)  # faces look outwards, and the relative numbers were right
    assert [material.name for material in scene.materials] == ["red paint", "grey"]
    assert np.bincount(scene.face_material).tolist() == [10, 2]
    # a box has creases everywhere
    corners = scene.vertices[scene.faces]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    np.testing.assert_allclose(scene.normals[scene.faces], np.repeat(flat[:, None], 3, axis=1), atol=1e-12)


@pytest.mark.parametrize(
    ("text", "area"),
    [
        (
            "v 0 0 0\nv 4 0 0\nv 4 1 0\nv 1 1 0\nv 1 4 0\nv 0 4 0\nf 2 3 4 5 6 1\n",
            7.0,
        ),  # an L, from its inner corner
        ("v 0 0 0\nv 2 0 0\nv 2 2 0\nv 1 -1e-5 0\nf 1 2 3 4\n", 1.0),
        (
            "\ufeffv 0 0 0\rv 1 0 0\rv 1 1 0\rf 1 2 3 # roof\r",
            0.5,
        ),  # byte order mark, lines of old Macs, a remark
        (
            "v 0 0 0\nv 1 0 0\nv 2 1e-9 0\nv 3 0 0\nv 2 0 0\nv 0 9 0\nf 1 2 3 4 5\nf 1 2 6\n",
            4.5,
        ),  # a face without area
    ],
)
def test_faces_of_an_obj_keep_their_area(text: str, area: float) -> None:
    mesh = parse_obj(text.encode(), "roof.obj")
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 == pytest.approx(area, abs=1e-4)


def test_units_and_axes(tmp_path: Path) -> None:
    path = written(tmp_path, "box.obj", OBJ)
    sizes = {up: np.ptp(read_mesh(path, default=GREY, up=up, unit=0.1).bounds, axis=0) for up in "xyz"}
    np.testing.assert_allclose(sizes["z"], [0.1, 0.2, 0.3])
    np.testing.assert_allclose(sizes["y"], [0.1, 0.3, 0.2])
    np.testing.assert_allclose(sizes["x"], [0.2, 0.3, 0.1])
    assert all(volume(read_mesh(path, default=GREY, up=up)) == pytest.approx(6.0) for up in "xyz")
    for words, options in (
        ("up='w'", {"default": GREY, "up": "w"}),
        ("unit=0", {"default": GREY, "unit": 0}),
        ("'red', 'bl\u00fc'.*material-missing", {}),
        ("'read'.*paint-target-unknown", {"default": GREY, "materials": {"read": RED}}),
    ):
        with pytest.raises(SchemaError, match=words):
            read_mesh(path, **options)


def test_a_glb_box_with_its_nodes_and_names(tmp_path: Path, trimesh: Any) -> None:
    scene = read_mesh(written(tmp_path, "two.glb", glb()), {"body": RED, "other_box": GREY})
    assert sorted(np.bincount(scene.face_material).tolist()) == [12, 12]
    red = scene.vertices[scene.faces[scene.face_material == scene.materials.index(RED)]].reshape(-1, 3)
    grey = scene.vertices[scene.faces[scene.face_material == scene.materials.index(GREY)]].reshape(-1, 3)
    # y up: (x, y, z) becomes (x, -z, y)
    np.testing.assert_allclose([red.min(axis=0), red.max(axis=0)], [[0, -3, 0], [1, 0, 2]], atol=1e-6)
    np.testing.assert_allclose([grey.min(axis=0), grey.max(axis=0)], [[10, -6, 0], [12, 0, 4]], atol=1e-6)
    assert volume(scene) == pytest.approx(6.0 * 9, rel=1e-6)


@pytest.mark.parametrize("binary", [True, False])
def test_a_ply_box(tmp_path: Path, trimesh: Any, binary: bool) -> None:
    scene = read_mesh(written(tmp_path, "box.ply", ply(binary=binary)), default=GREY)
    assert (len(scene.faces), volume(scene)) == (12, pytest.approx(6.0))


def test_an_open_mesh_is_fine_and_triangles_without_area_are_dropped(tmp_path: Path) -> None:
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 2 0 0\nf 1 2 3\nf 1 2 4\nf 1 1 2\n"
    for crease in (40.0, None):
        with pytest.warns(PaintWarning, match="triangle-without-area"):
            scene = read_mesh(written(tmp_path, "open.obj", text), default=GREY, crease=crease)
        assert len(scene.faces) == 1
    # flat unless smooth
    assert not read_mesh(written(tmp_path, "box.obj", OBJ), default=GREY, crease=None).normals.any()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "empty-input"),
        ("  \n \n", "empty-input"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\n", "mesh-empty"),
        ("v 0 0\nf 1 2 3\n", "line 1 is 'v 0 0'.*number-unreadable"),
        ("v 0 zero 0\n", "line 1"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "vertex 4.*vertex-unknown"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 -4\n", "vertex -1.*vertex-unknown"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", "line 4"),
        ("v 0 0 0\nf 1 1\n", "line 2"),
        ("v 0 0 0\nf 1 1 " + "9" * 5000 + "\n", "line 2"),
        ("v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "1 of 3 vertices.*not-finite"),
        ("v 0 0 1e999\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "not-finite"),
        ("\x00\x01\x02", "mesh-empty"),
        # a roof in the form of a U: no corner sees all of it
        (
            "v 0 0 0\nv 3 0 0\nv 3 3 0\nv 2 3 0\nv 2 1 0\nv 1 1 0\nv 1 3 0\nv 0 3 0\nf 1 2 3 4 5 6 7 8\n",
            "mesh-unreadable",
        ),
    ],
)
def test_a_broken_obj_is_named(tmp_path: Path, text: str, words: str) -> None:
    expect_error(FormatError, words, lambda: read_mesh(written(tmp_path, "broken.obj", text), default=GREY))


INDICES = {"bufferView": 0, "componentType": 5123, "count": 36, "type": "SCALAR"}
POINTS = {"bufferView": 1, "componentType": 5126, "count": 8, "type": "VEC3"}
DRACO = "KHR_draco_mesh_compression"


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"accessors": [INDICES | {"count": 10**15}, POINTS]}, "count is 10+.*value-out-of-range"),
        ({"accessors": [INDICES, POINTS | {"count": 9}]}, "count is 9.*value-out-of-range"),
        ({"accessors": [INDICES, POINTS | {"bufferView": None}]}, "bufferView is None"),
        ({"accessors": [INDICES | {"sparse": {}}, POINTS]}, "accessor 0.*accessor-type"),
        ({"accessors": [INDICES, POINTS | {"componentType": 5122}]}, "accessor-type"),
        ({"accessors": [INDICES, POINTS | {"componentType": [5126]}]}, "accessor-type"),
        ({"bufferViews": [{"buffer": 0, "byteLength": 10**12}] * 2}, "byteLength is 1000000000000"),
        ({"bufferViews": [{"buffer": 0, "byteLength": -1}] * 2}, "byteLength is -1"),
        ({"buffers": [{"byteLength": 168, "uri": "../../../etc/passwd"}]}, "buffer-external"),
        ({"buffers": [{}, {}]}, "buffer-number"),
        ({"nodes": [{"children": [1]}, {"children": [0]}]}, "node-depth"),
        ({"nodes": [{"mesh": 0, "children": [0]}]}, "node-depth"),
        ({"nodes": [{"children": [1]}, {"mesh": 0}, {"children": [1]}]}, "node-parent"),
        ({"nodes": [{"mesh": 7}]}, "mesh is 7"),
        ({"nodes": [{"mesh": 0, "matrix": [1.0]}]}, "length-mismatch"),
        ({"nodes": [{"mesh": 0, "scale": [10**400, 1, 1]}]}, "not-finite"),
        ({"nodes": [{"children": [n + 1]} for n in range(600)] + [{"mesh": 0}]}, "node-depth"),
        ({"nodes": []}, "mesh-empty"),
        ({"meshes": [{"primitives": [{"attributes": {"POSITION": 1}, "mode": 1}]}] * 2}, "primitive-type"),
        ({"meshes": [{"primitives": [{}]}] * 2}, "primitive-type"),
        ({"meshes": 3}, "type-wrong"),
        ({"extensionsRequired": [DRACO]}, DRACO),
        ({"materials": []}, "material is 1"),
    ],
)  # fmt: skip
def test_a_glb_that_lies_is_refused(
    tmp_path: Path, trimesh: Any, changes: dict[str, Any], words: str
) -> None:
    expect_error(
        FormatError, words, lambda: read_mesh(written(tmp_path, "lies.glb", glb(changes)), default=GREY)
    )


def test_numbers_beyond_the_vertices_of_a_glb_are_refused(tmp_path: Path, trimesh: Any) -> None:
    indices = FACES.astype("<u2").tobytes()
    expect_error(
        FormatError,
        None,
        lambda: read_mesh(
            written(tmp_path, "beyond.glb", glb().replace(indices, b"\xff\x00" + indices[2:])), default=GREY
        ),
    )
    for drop in (1, 40, 150, 300, 900):
        with pytest.raises(FormatError, match="file-truncated"):
            read_mesh(written(tmp_path, "cut.glb", glb(drop=drop)), default=GREY)


def test_what_is_stripped_holds_no_names_of_files() -> None:
    stripped = strip_glb(glb(), "two.glb")
    assert not [word for word in (b"secret", b"uri") if word in stripped[0]]
    assert stripped[1:] == (("unused", "body"), ("box", "other_box"), 24)


NOT_FINITE = ply().replace(CORNERS.astype("<f4")[3].tobytes(), np.full(3, np.nan, "<f4").tobytes())
BEYOND = ply().replace(FACES[0].astype("<i4").tobytes(), np.array([0, 2, 99], "<i4").tobytes())


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (NOT_FINITE, "not-finite"),
        (BEYOND, "vertex-unknown|mesh-unreadable"),
        (ply(vertices=10**15), "12000000000000.*file-truncated"),
        (ply(binary=False, vertices=10**15), "6000000000000.*file-truncated"),
        (ply()[:120], "header-truncated"),
        (ply()[:-30], "file-truncated|mesh-unreadable"),
        (ply().replace(b"vertex 8", b"vertex -8"), "element vertex -8.*header-unreadable"),
        (ply().replace(b"float x", b"floof x"), "property floof x.*header-unreadable"),
        (ply().replace(b"uchar int", b"uint64 int"), "file-truncated|mesh-unreadable"),
        (b"plus", "format-unknown"),
        (b"obj\n", "format-unknown"),
    ],
)
def test_a_ply_that_lies_is_refused(tmp_path: Path, trimesh: Any, data: bytes, words: str) -> None:
    expect_error(FormatError, words, lambda: read_mesh(written(tmp_path, "lies.ply", data), default=GREY))


@given(st.integers(0, 3), st.binary(max_size=12), st.data())
def test_damage_raises_only_errors_in_words(
    tmp_path: Path, trimesh: Any, which: int, junk: bytes, data: Any
) -> None:
    name, whole = [
        ("a.glb", glb()), ("b.ply", ply()), ("c.ply", ply(binary=False)), ("d.obj", OBJ.encode()),
    ][which]  # fmt: skip
    at = data.draw(st.integers(0, len(whole)))
    skip = data.draw(st.integers(0, 40))
    with contextlib.suppress(PaintError, PaintWarning):  # warnings are errors: triangles without area
        assert np.isfinite(
            read_mesh(written(tmp_path, name, whole[:at] + junk + whole[at + skip :]), default=GREY).vertices
        ).all()


@pytest.mark.parametrize("parse", [parse_obj, check_ply, strip_glb])
@given(data=st.binary(max_size=200))
def test_parsers_are_total(parse: Any, data: bytes) -> None:
    with contextlib.suppress(FormatError):
        parse(data, "x")


def test_unknown_missing_and_too_large_files_are_refused(tmp_path: Path) -> None:
    expect_errors(
        (FormatError, r"\.stl.*format-unknown", lambda: read_mesh(tmp_path / "x.stl")),
        (FormatError, r"x\.obj", lambda: read_mesh(tmp_path / "x.obj")),
    )
    # too large to be read
    path = tmp_path / "large.obj"
    with path.open("wb") as file:
        file.truncate(2**30 + 1)  # sparse
    expect_error(FormatError, "1073741824", lambda: read_mesh(path))


@pytest.mark.parametrize(("name", "data"), [("a.glb", glb()), ("b.ply", ply())])
def test_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, data: bytes) -> None:
    monkeypatch.setitem(sys.modules, "trimesh", None)
    expect_error(
        MissingExtraError,
        r"hyperpaint\[mesh\]",
        lambda: read_mesh(written(tmp_path, name, data), default=GREY),
    )
    assert len(read_mesh(written(tmp_path, "c.obj", OBJ), default=GREY).faces) == 12


@pytest.mark.parametrize("options", [{}, {"unit": 1e300}, {"crease": None}])
def test_a_mesh_of_another_world_is_refused(tmp_path: Path, options: dict[str, Any]) -> None:
    path = written(tmp_path, "far.obj", "v 1e308 0 0\nv -1e308 0 0\nv 0 1e308 0\nv 0 0 1\nf 1 2 3\nf 2 3 4\n")
    expect_error(FormatError, "vertex-too-far", lambda: read_mesh(path, default=GREY, **options))


def test_normals_of_a_fan_take_time_with_its_triangles() -> None:
    count = 20_000  # held against one another they would take minutes
    around = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    rim = np.stack([np.cos(around), np.sin(around), 0.0 * around], axis=1)
    first = np.arange(count)
    faces = np.stack([0 * first, 1 + first, 1 + (first + 1) % count], axis=1)
    cone = Mesh(np.vstack([[[0.0, 0.0, 1.0]], rim]), faces, 0 * first, ("grey",), 0 * first)
    began = time.process_time()
    mesh = smoothed(cone)
    assert time.process_time() - began < 5.0
    assert count > MAX_FACES_AROUND
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0)
    # each triangle at the tip has its own, between those of its two neighbours
    np.testing.assert_allclose(mesh.normals[mesh.vertices[:, 2] == 1.0, 2], np.sqrt(0.5), atol=1e-6)
