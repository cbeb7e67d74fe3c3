"""Shapes that things in a scene are built from: plates, boxes, tubes, lofts, with smooth normals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hyperpaint.base.arrays import Floats, Ints

from .materials import Material
from .scene import PARTS, Instance, Scene, has_area


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles whose materials are named by words.

    Attributes
    ----------
    vertices
        Shape (vertex, 3) [m].
    faces
        Shape (face, 3).
    surface
        Number of the surface of every triangle, shape (face,), into ``surfaces``.
    surfaces
        What the things that use the mesh call their materials: "paint", "glass".
    part
        Number of the part of every triangle, shape (face,), into `scene.PARTS`.
    normals
        At the vertices, zero where a face is flat, shape (vertex, 3).
    """

    vertices: Floats
    faces: Ints
    surface: Ints
    surfaces: tuple[str, ...]
    part: Ints
    normals: Floats = field(default_factory=lambda: np.zeros((0, 3)))

    def __post_init__(self) -> None:
        if not len(self.normals):
            object.__setattr__(self, "normals", np.zeros_like(self.vertices))

    def shifted(self, offset: Sequence[float]) -> Mesh:
        """Return the mesh moved by ``offset``: east, north and up [m]."""
        return replace(self, vertices=self.vertices + np.asarray(offset, np.float64))

    def scene(self, materials: dict[str, Material], instance: Instance) -> Scene:
        """Return the mesh as one thing; ``materials`` gives the material of each of its surfaces."""
        return Scene(
            instance.name,
            self.vertices,
            self.faces,
            self.normals,
            self.surface.astype(np.int32),
            np.zeros(len(self.faces), np.int32),
            tuple(materials[name] for name in self.surfaces),
            (instance,),
            self.part.astype(np.int8),
        )


def put_together(meshes: Sequence[Mesh]) -> Mesh:
    """Return one mesh of several; surfaces with one name become one.

    Examples
    --------
    >>> both = put_together([cuboid((1, 1, 1), "wood"), cuboid((1, 1, 1), "wood").shifted((2, 0, 0))])
    >>> len(both.faces), both.surfaces
    (24, ('wood',))
    """
    surfaces: dict[str, int] = {}
    numbers, faces, first = [], [], 0
    for mesh in meshes:
        own = [surfaces.setdefault(name, len(surfaces)) for name in mesh.surfaces]
        numbers.append(np.asarray(own, np.int64)[mesh.surface])
        faces.append(mesh.faces + first)
        first += len(mesh.vertices)
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate(faces),
        np.concatenate(numbers),
        tuple(surfaces),
        np.concatenate([mesh.part for mesh in meshes]),
        np.concatenate([mesh.normals for mesh in meshes]),
    )


def uniform(vertices: ArrayLike, faces: ArrayLike, surface: str, part: str = "") -> Mesh:
    triangles = np.asarray(faces, np.int64).reshape(-1, 3)
    same = np.zeros(len(triangles), np.int64)
    return Mesh(np.asarray(vertices, np.float64), triangles, same, (surface,), same + PARTS.index(part))


def polygon(corners: ArrayLike, surface: str, part: str = "") -> Mesh:
    """Return a convex polygon as a fan of triangles; ``corners`` (corner, 3) [m] run anticlockwise.

    Examples
    --------
    >>> polygon([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], "paint").faces.tolist()
    [[0, 1, 2], [0, 2, 3]]
    """
    points = np.asarray(corners, np.float64)
    fan = [[0, corner, corner + 1] for corner in range(1, len(points) - 1)]
    return uniform(points, fan, surface, part)


def cuboid(size: Sequence[float], surface: str, part: str = "") -> Mesh:
    """Return a closed box that stands on the ground around the origin; ``size`` east, north and up [m].

    Examples
    --------
    >>> cuboid((1.0, 2.0, 3.0), "brick").vertices.max(axis=0).tolist()
    [0.5, 1.0, 3.0]
    """
    corners = np.array([[x, y, z] for z in (0.0, 1.0) for y in (-0.5, 0.5) for x in (-0.5, 0.5)])
    quads = np.array([[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [1, 3, 7, 5], [3, 2, 6, 7], [2, 0, 4, 6]])
    return uniform(corners * np.asarray(size, np.float64), quads[:, [0, 1, 2, 0, 2, 3]], surface, part)


def box(
    size: Sequence[float],
    material: Material,
    *,
    centre: Sequence[float] = (0.0, 0.0, 0.0),
    instance: Instance | str = "box",
) -> Scene:
    """Return a closed box of one material as a scene, the middle of its foot at ``centre`` [m].

    Examples
    --------
    >>> box((1.0, 2.0, 3.0), Material("brick", "brick", "wall")).area.sum()
    np.float64(22.0)
    """
    thing = Instance(instance) if isinstance(instance, str) else instance
    return cuboid(size, "all").shifted(centre).scene({"all": material}, thing)


def tube(
    foot: ArrayLike,
    head: ArrayLike,
    radii: tuple[float, float],
    surface: str,
    *,
    sides: int = 10,
    part: str = "",
    closed: bool = True,
) -> Mesh:
    """Return a (conical) tube from ``foot`` to ``head`` [m], its ends closed by discs.

    Parameters
    ----------
    foot, head
        Middles of its ends: east, north and up [m].
    radii
        At the foot and at the head [m].
    surface, part
        What it is.
    sides
        Of its outline.
    closed
        Whether the ends are.

    Examples
    --------
    >>> tube((0, 0, 0), (0, 0, 2), (1.0, 1.0), "bark", sides=6).faces.shape
    (24, 3)
    """
    begin, end = np.asarray(foot, np.float64), np.asarray(head, np.float64)
    axis = (end - begin) / np.linalg.norm(end - begin)
    aside = np.cross(axis, (0.0, 0.0, 1.0) if abs(axis[2]) < 0.9 else (0.0, 1.0, 0.0))
    aside /= np.linalg.norm(aside)
    angle = 2 * np.pi * np.arange(sides) / sides
    rim = np.outer(np.cos(angle), aside) + np.outer(np.sin(angle), np.cross(axis, aside))
    vertices = np.concatenate([begin + radii[0] * rim, end + radii[1] * rim, [begin], [end]])
    here = np.arange(sides)
    after = (here + 1) % sides
    faces = [np.stack([here, after, after + sides], 1), np.stack([here, after + sides, here + sides], 1)]
    if closed:
        faces.append(np.stack([after, here, np.full(sides, 2 * sides)], 1))
        faces.append(np.stack([here + sides, after + sides, np.full(sides, 2 * sides + 1)], 1))
    return uniform(vertices, np.concatenate(faces), surface, part)


def lattice(points: ArrayLike, surface: NDArray[np.object_], part: NDArray[np.object_]) -> Mesh:
    """Return a sheet of four-sided cells, each split in two.

    Parameters
    ----------
    points
        Shape (row, column, 3) [m]; seen from outside, columns run to the left of the way rows run.
    surface, part
        Word for every cell, shape (row - 1, column - 1).

    Examples
    --------
    >>> points = [[[0, 0, 0], [0, 1, 0]], [[1, 0, 0], [1, 1, 0]]]
    >>> lattice(points, np.array([["paint"]], object), np.array([["roof"]], object)).faces.tolist()
    [[0, 2, 3], [0, 3, 1]]
    """
    grid = np.asarray(points, np.float64)
    rows, columns = grid.shape[:2]
    corner = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]
    faces = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
    words = sorted(set(surface.ravel().tolist()))
    numbers = np.array([words.index(word) for word in surface.ravel()], np.int64)
    parts = np.array([PARTS.index(word) for word in part.ravel()], np.int64)
    return Mesh(grid.reshape(-1, 3), faces, numbers.repeat(2), tuple(words), parts.repeat(2))


#: Triangles around one vertex whose normals are made smooth; a pole of a fine sphere has a hundred.
MAX_FACES_AROUND = 256


def smoothed(mesh: Mesh, crease: float = 40.0) -> Mesh:
    """Return the mesh with smooth normals except where it bends by more than ``crease`` [degree].

    The normal at a corner of a triangle is the mean of the normals of the triangles around its vertex that
    lie within ``crease`` of its own, weighted by their angles there, so that it does not matter how a
    surface is cut into triangles (Thuermer & Wuethrich, J. Graphics Tools 3, 1998). A vertex with several
    normals becomes several vertices. Vertices must be shared, as `lattice` shares them. Triangles without
    area are dropped. Where more than `MAX_FACES_AROUND` triangles meet, each keeps its own normal: they bend
    little from one to the next, and comparing all pairs would take long.

    Examples
    --------
    >>> cube = smoothed(cuboid((1, 1, 1), "brick"))
    >>> len(cube.vertices), len(np.unique(cube.normals.round(6), axis=0))
    (24, 6)
    """
    with_area = has_area(mesh.vertices, mesh.faces)
    faces = mesh.faces[with_area]
    # unit normals of the triangles, and the angles at their corners
    corners = mesh.vertices[faces]
    to_next = np.roll(corners, -1, axis=1) - corners
    to_last = -np.roll(to_next, 1, axis=1)
    turned = np.cross(to_next, to_last)
    sine = np.linalg.norm(turned, axis=2)
    angle = np.arctan2(sine, (to_next * to_last).sum(axis=2)).reshape(-1)
    unit = turned[:, 0] / sine[:, :1]
    vertex = faces.reshape(-1)
    order = np.argsort(vertex, kind="stable")
    counts = np.bincount(vertex, minlength=len(mesh.vertices))
    starts = (np.cumsum(counts) - counts)[vertex[order]]
    sizes = counts[vertex[order]]
    place = np.arange(len(order)) - starts
    own = unit[order // 3]
    total = np.zeros((len(order), 3))
    crowded = sizes > MAX_FACES_AROUND
    total[crowded] = own[crowded]
    left = np.flatnonzero(~crowded)
    for step in range(int(sizes[left].max(initial=0))):  # corner against the step-th next around its vertex
        left = left[sizes[left] > step]
        other = order[starts[left] + (place[left] + step) % sizes[left]]
        near = (own[left] * unit[other // 3]).sum(axis=1) >= np.cos(np.radians(crease))
        total[left] += np.where(near, angle[other], 0.0)[:, None] * unit[other // 3]
    normals = np.empty_like(total)
    normals[order] = total / np.linalg.norm(total, axis=1, keepdims=True)
    first, corner = _distinct(vertex, normals)
    return replace(
        mesh,
        vertices=mesh.vertices[vertex[first]],
        faces=corner.reshape(-1, 3).astype(np.int64),
        surface=mesh.surface[with_area],
        part=mesh.part[with_area],
        normals=normals[first],
    )


def _distinct(vertex: Ints, normals: Floats) -> tuple[Ints, Ints]:
    # First corner of every distinct vertex and normal, and for every corner its distinct one.
    # normals to 21 bits an axis, in one number: sorting is what takes time in a large mesh
    steps = np.rint((normals + 1.0) * 1e6).astype(np.int64)
    code = (steps[:, 0] << 42) | (steps[:, 1] << 21) | steps[:, 2]
    order = np.lexsort((code, vertex))
    new = np.ones(len(order), bool)
    new[1:] = (vertex[order[1:]] != vertex[order[:-1]]) | (code[order[1:]] != code[order[:-1]])
    corner = np.empty(len(order), np.int64)
    corner[order] = np.cumsum(new) - 1
    return order[new], corner
