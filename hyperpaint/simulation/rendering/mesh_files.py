"""Scenes from mesh files: Wavefront OBJ, binary glTF (GLB) and PLY.

OBJ files are read here; GLB and PLY files through trimesh (``pip install 'hyperpaint[mesh]'``), after their
declared sizes have been held against the file. Nothing outside the file itself is opened, be it named inside.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import FormatError, SchemaError
from hyperpaint.base.input_files import read_limited

from .materials import Material
from .mesh_formats import RawTriangles, parse_obj, read_glb, read_ply
from .primitives import Mesh, smoothed
from .scene import Instance, Scene, has_area, warn_of_dropped

_MAX_BYTES = 2**30
_FARTHEST_M = 1e8
#: Turns the axis that points up into z, and keeps the axes right-handed.
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
    """Return a mesh file as a scene of one thing.

    Parameters
    ----------
    path
        A file that ends in .obj, .glb or .ply.
    materials
        What parts of the mesh are made of: by the name of the material in the file, else by the name of the
        mesh, object or group.
    default
        What all other parts are made of.
    instance
        What it is; the name of the file unless given.
    unit
        Metres that the file calls 1: 0.001 for millimetres.
    up
        Axis of the file that points up: "x", "y" or "z"; unless given y in GLB files, as glTF has it, else z.
    crease
        Normals are made smooth but where faces meet at more than this angle [degree]; None for flat faces.
        Those in the file are not read.

    Returns
    -------
    Scene
        In metres, z up. Triangles without area are dropped with a `PaintWarning`; a mesh may be open.

    Raises
    ------
    FormatError
        The file is empty, cut, damaged, too large (1 GiB, 50 million triangles), of another format, without
        triangles, or has coordinates that are not finite, or 100,000 km away.
    SchemaError
        Parts of the mesh have no material, or ``unit`` or ``up`` is not what it must be.
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
    raw = readers[suffix](_contents(file), file.name)
    _check(raw, file.name)
    farthest = float(np.abs(raw.vertices).max(initial=0.0))
    if not farthest < _FARTHEST_M / unit:
        raise FormatError(
            f"{file.name}: a vertex is {farthest:.3g} units of {unit:g} m from the origin",
            expected=f"at most {_FARTHEST_M:g} m",
            mend="mend the mesh, or pass unit=",
            code="vertex-too-far",
        )
    vertices = unit * raw.vertices @ upright.T
    with_area = has_area(vertices, raw.faces)
    warn_of_dropped(file.stem, with_area)
    thing = Instance(instance or file.stem) if isinstance(instance, str) else instance
    chosen, surface = _assigned(raw, materials or {}, default, file.name)
    faces, surface = raw.faces[with_area], surface[with_area]
    normals = np.zeros((0, 3))
    if crease is not None:
        vertices, faces = _welded(vertices, faces)
        mesh = smoothed(
            Mesh(vertices, faces, surface, tuple(one.name for one in chosen), 0 * surface), crease
        )
        vertices, faces, normals, surface = mesh.vertices, mesh.faces, mesh.normals, mesh.surface
    return Scene.from_arrays(
        vertices, faces, chosen, face_material=surface, normals=normals, instance=thing, name=file.stem
    )


def _contents(file: Path) -> bytes:
    data = read_limited(file, _MAX_BYTES, "a mesh")
    if not data.strip():
        raise FormatError(f"{file.name}: the file is empty", expected="a mesh", code="empty-input")
    return data


def _check(raw: RawTriangles, where: str) -> None:
    if not len(raw.faces):
        raise FormatError(f"{where}: no triangles", expected="a mesh with faces", code="mesh-empty")
    first, last, count = int(raw.faces.min()), int(raw.faces.max()), len(raw.vertices)
    if first < 0 or last >= count:
        wrong = last + 1 if last >= count else first
        raise FormatError(
            f"{where}: a face names vertex {wrong}",
            expected=f"one of {count} vertices",
            mend="export the mesh again",
            code="vertex-unknown",
        )
    bad = np.flatnonzero(~np.isfinite(raw.vertices).all(axis=1))
    if len(bad):
        raise FormatError(
            f"{where}: {len(bad)} of {len(raw.vertices)} vertices are not finite, the first is number "
            f"{bad[0]} counted from 0",
            mend="mend the mesh",
            code="not-finite",
        )


def _assigned(
    raw: RawTriangles, materials: Mapping[str, Material], default: Material | None, where: str
) -> tuple[tuple[Material, ...], NDArray[np.int64]]:
    """Return the materials, and the material number of every triangle."""
    chosen: dict[Material, int] = {}
    numbers = np.zeros(len(raw.groups), np.int64)
    missing = []
    for group in np.unique(raw.face_group):
        named = [name for name in raw.groups[group] if name in materials]
        material = materials[named[0]] if named else default
        if material is None:
            missing.append(next((repr(name) for name in raw.groups[group] if name), "a part without a name"))
            continue
        numbers[group] = chosen.setdefault(material, len(chosen))
    if missing:
        raise SchemaError(
            f"{where}: no material for {', '.join(missing[:20])}",
            mend="name them in materials=, or pass default=",
            code="material-missing",
        )
    return tuple(chosen), numbers[raw.face_group]


def _welded(vertices: Floats, faces: NDArray[np.int64]) -> tuple[Floats, NDArray[np.int64]]:
    """Return the mesh with coincident vertices merged, so that normals are smooth across seams."""
    order = np.lexsort(vertices.T)
    placed = vertices[order]
    new = np.concatenate([[True], (placed[1:] != placed[:-1]).any(axis=1)])
    number = np.empty(len(vertices), np.int64)
    number[order] = np.cumsum(new) - 1
    return placed[new], number[faces]
