"""Shapes for objects of a scene: plates, boxes, tubes, lofts, with smooth normals."""

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
    """Triangles with names of surfaces instead of materials.

    Attributes
    ----------
    vertices
        Shape (vertex, 3) [m].
    faces
        Shape (face, 3).
    surface
        Number of the surface of every triangle, shape (face,), into ``surfaces``.
    surfaces
        Names of surfaces, to which materials are assigned later: "paint", "glass".
    part
        Number of the part of every triangle, shape (face,), into `scene.PARTS`.
    normals
        Normals at the vertices, zero for flat faces, shape (vertex, 3).
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
        """Return the mesh as a scene of one instance; ``materials``: material by name of the surface."""
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
    """Return a mesh of several meshes; surfaces with equal names are merged.

    Examples
    --------
    >>> joined = put_together([cuboid((1, 1, 1), "wood"), cuboid((1, 1, 1), "wood").shifted((2, 0, 0))])
    >>> len(joined.faces), joined.surfaces
    (24, ('wood',))
    """
    surfaces: dict[str, int] = {}
    numbers, faces, first_vertex = [], [], 0
    for mesh in meshes:
        surface_numbers = [surfaces.setdefault(name, len(surfaces)) for name in mesh.surfaces]
        numbers.append(np.asarray(surface_numbers, np.int64)[mesh.surface])
        faces.append(mesh.faces + first_vertex)
        first_vertex += len(mesh.vertices)
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
    zeros = np.zeros(len(triangles), np.int64)
    return Mesh(np.asarray(vertices, np.float64), triangles, zeros, (surface,), zeros + PARTS.index(part))


def polygon(corners: ArrayLike, surface: str, part: str = "") -> Mesh:
    """Return a convex polygon as a fan of triangles; ``corners`` (corner, 3) [m] are anticlockwise.

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
    """Return a closed box of one material as a scene, with the centre of its base at ``centre`` [m].

    Examples
    --------
    >>> box((1.0, 2.0, 3.0), Material("brick", "brick", "wall")).area.sum()
    np.float64(22.0)
    """
    box_instance = Instance(instance) if isinstance(instance, str) else instance
    return cuboid(size, "all").shifted(centre).scene({"all": material}, box_instance)


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
    """Return a (conical) tube from ``foot`` to ``head`` [m].

    Parameters
    ----------
    foot, head
        Centres of the ends: east, north and up [m].
    radii
        Radii at foot and head [m].
    surface, part
        Names of the surface and of the part.
    sides
        Number of sides.
    closed
        Whether discs close the ends.

    Examples
    --------
    >>> tube((0, 0, 0), (0, 0, 2), (1.0, 1.0), "bark", sides=6).faces.shape
    (24, 3)
    """
    begin, end = np.asarray(foot, np.float64), np.asarray(head, np.float64)
    axis = (end - begin) / np.linalg.norm(end - begin)
    normal = np.cross(axis, (0.0, 0.0, 1.0) if abs(axis[2]) < 0.9 else (0.0, 1.0, 0.0))
    normal /= np.linalg.norm(normal)
    angle = 2 * np.pi * np.arange(sides) / sides
    rim = np.outer(np.cos(angle), normal) + np.outer(np.sin(angle), np.cross(axis, normal))
    vertices = np.concatenate([begin + radii[0] * rim, end + radii[1] * rim, [begin], [end]])
    corner = np.arange(sides)
    next_corner = (corner + 1) % sides
    faces = [
        np.stack([corner, next_corner, next_corner + sides], 1),
        np.stack([corner, next_corner + sides, corner + sides], 1),
    ]
    if closed:
        faces.append(np.stack([next_corner, corner, np.full(sides, 2 * sides)], 1))
        faces.append(np.stack([corner + sides, next_corner + sides, np.full(sides, 2 * sides + 1)], 1))
    return uniform(vertices, np.concatenate(faces), surface, part)


def lattice(points: ArrayLike, surface: NDArray[np.object_], part: NDArray[np.object_]) -> Mesh:
    """Return a sheet of four-sided cells, split into two triangles.

    Parameters
    ----------
    points
        Shape (row, column, 3) [m]; from outside, columns increase to the left of the direction of rows.
    surface, part
        Names for every cell, shape (row - 1, column - 1).

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


#: Maximum number of triangles around a vertex whose normals are smoothed; a pole of a fine sphere has a
#: hundred.
MAX_FACES_AROUND = 256


def smoothed(mesh: Mesh, crease: float = 40.0) -> Mesh:
    """Return the mesh with smooth normals, except at edges of more than ``crease`` [degree].

    The normal at a corner of a triangle is the mean of the normals of those triangles around the vertex that
    differ by less than ``crease``, weighted by their angles at the vertex, so that it does not depend on the
    triangulation (Thuermer & Wuethrich, J. Graphics Tools 3, 1998). A vertex with several normals becomes
    several vertices. Triangles must share vertices, as in `lattice`. Triangles without area are dropped.
    Around vertices with more than `MAX_FACES_AROUND` triangles, normals are not smoothed, because comparing
    all pairs would take long.

    Examples
    --------
    >>> cube = smoothed(cuboid((1, 1, 1), "brick"))
    >>> len(cube.vertices), len(np.unique(cube.normals.round(6), axis=0))
    (24, 6)
    """
    keeps_area = has_area(mesh.vertices, mesh.faces)
    faces = mesh.faces[keeps_area]
    # unit normals of the triangles, and the angles at their corners
    corners = mesh.vertices[faces]
    next_edge = np.roll(corners, -1, axis=1) - corners
    last_edge = -np.roll(next_edge, 1, axis=1)
    cross_products = np.cross(next_edge, last_edge)
    sine = np.linalg.norm(cross_products, axis=2)
    angle = np.arctan2(sine, (next_edge * last_edge).sum(axis=2)).reshape(-1)
    unit = cross_products[:, 0] / sine[:, :1]
    vertex = faces.reshape(-1)
    order = np.argsort(vertex, kind="stable")
    counts = np.bincount(vertex, minlength=len(mesh.vertices))
    starts = (np.cumsum(counts) - counts)[vertex[order]]
    sizes = counts[vertex[order]]
    rank_at_vertex = np.arange(len(order)) - starts
    own_normals = unit[order // 3]
    total = np.zeros((len(order), 3))
    crowded = sizes > MAX_FACES_AROUND
    total[crowded] = own_normals[crowded]
    active = np.flatnonzero(~crowded)
    # compare every corner with the step-th next corner around its vertex
    for step in range(int(sizes[active].max(initial=0))):
        active = active[sizes[active] > step]
        other_corner = order[starts[active] + (rank_at_vertex[active] + step) % sizes[active]]
        is_similar = (own_normals[active] * unit[other_corner // 3]).sum(axis=1) >= np.cos(np.radians(crease))
        total[active] += np.where(is_similar, angle[other_corner], 0.0)[:, None] * unit[other_corner // 3]
    normals = np.empty_like(total)
    normals[order] = total / np.linalg.norm(total, axis=1, keepdims=True)
    first_corner, corner = _distinct(vertex, normals)
    return replace(
        mesh,
        vertices=mesh.vertices[vertex[first_corner]],
        faces=corner.reshape(-1, 3).astype(np.int64),
        surface=mesh.surface[keeps_area],
        part=mesh.part[keeps_area],
        normals=normals[first_corner],
    )


def _distinct(vertex: Ints, normals: Floats) -> tuple[Ints, Ints]:
    # first corner of every distinct pair of vertex and normal, and for every corner the number of its pair;
    # normals are packed into one integer with 21 bits per axis, because sorting dominates the time for a
    # large mesh
    steps = np.rint((normals + 1.0) * 1e6).astype(np.int64)
    code = (steps[:, 0] << 42) | (steps[:, 1] << 21) | steps[:, 2]
    order = np.lexsort((code, vertex))
    is_new = np.ones(len(order), bool)
    is_new[1:] = (vertex[order[1:]] != vertex[order[:-1]]) | (code[order[1:]] != code[order[:-1]])
    corner = np.empty(len(order), np.int64)
    corner[order] = np.cumsum(is_new) - 1
    return order[is_new], corner
