"""A scene: triangles with their materials and instances, and shapes of which scenes are built.

A `Mesh` has names of surfaces where a `Scene` has materials. A shape is a table of `Part` rows; `built` makes
a mesh of them.

A traced dataset has the scene and the settings of the trace in its attributes.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hyperpaint.base import (
    Array,
    Floats,
    Ints,
    Problems,
    SchemaError,
    check_fields,
    declared,
    fact,
    one_of,
    warn_if,
)
from hyperpaint.light.sky_functions import FUNCTIONS
from hyperpaint.simulation.settings import MAX_SEED, MOST_SAMPLES
from hyperpaint.simulation.transport.path_codes import (
    CLEAR_SKY_FUNCTIONS,
    MAX_SUNS,
    SOURCE_BITS,
    PathCodes,
)

from .materials import KINDS, Coat, Flakes, Material
from .scene_spectra import FOURTEEN

#: Kinds of instances of a scene.
INSTANCE_KINDS = ("ground", "car", "tree", "wall", "panel", "other")

#: Parts of a car; the index in this tuple is the number in `Scene.face_part`, 0 is no part.
PARTS = (
    "",
    "roof",
    "bonnet",
    "boot",
    "door",
    "wing",
    "bumper",
    "pillar",
    "windscreen",
    "rear_window",
    "side_window",
    "bed",
    "seam",
    "wheel",
    "lamp",
    "mirror",
    "plate",
    "underbody",
)

_MIN_SHAPE = 1e-12  # twice the area of a triangle over its longest edge squared; thinner ones have no area


@dataclass(frozen=True)
class Instance:
    """An object in a scene.

    Attributes
    ----------
    name
        "ground", "car_007", "tree_02".
    kind
        One of `INSTANCE_KINDS`.
    paint
        Name of the paint spectrum of a car; empty for other instances.
    """

    name: str
    kind: str = "other"
    paint: str = ""


# A spectrum by which a path of light can be multiplied
@dataclass(frozen=True)
class Factor:
    material: int  # number of the material
    flakes: bool = False  # false for the base of the material, True for its metal flakes
    through: bool = False  # true for the transmittance of a thin surface
    # true for the spectrum of flakes with light and view at right angles (`materials.Flakes.turned`)
    turned: bool = False


#: Arrays of a scene: attribute, dtype, attribute of equal length, shape of a row, and the items that its
#: numbers count.
_ARRAYS: tuple[tuple[str, type, str, tuple[int, ...], str], ...] = (
    ("vertices", np.float64, "", (3,), ""),
    ("faces", np.int64, "", (3,), "vertices"),
    ("normals", np.float64, "vertices", (3,), ""),
    ("face_material", np.int32, "faces", (), "materials"),
    ("face_instance", np.int32, "faces", (), "instances"),
    ("face_part", np.int8, "faces", (), "PARTS"),
)


@dataclass(frozen=True, eq=False)
class Scene:
    """Triangles in a local frame: x east, y north, z up [m].

    Creating a scene checks all its arrays and drops triangles without area.

    Attributes
    ----------
    name
        Name of the scene.
    vertices
        Shape (vertex, 3) [m].
    faces
        Vertices of every triangle, shape (face, 3), int64.
    normals
        Normals at the vertices for smooth shading, shape (vertex, 3), zero for flat faces; empty for zeros.
    face_material, face_instance
        Number of the material and of the instance of every triangle, shape (face,), int32.
    materials, instances
        Materials and instances by number.
    face_part
        Part of a car of every triangle, an index of `PARTS`, shape (face,), int8; empty for zeros.

    Raises
    ------
    SchemaError
        Shapes do not fit, a vertex or normal is not finite, an index or number is out of range, a name is
        empty or used twice, or the kind of an instance is unknown; all problems are listed.

    Warns
    -----
    PaintWarning
        Triangles without area were dropped.

    Examples
    --------
    >>> grey = Material("grey", "panel_20", "panel")
    >>> scene = plane(2.0, grey)
    >>> len(scene.faces), scene.bounds.tolist()
    (2, [[-1.0, -1.0, 0.0], [1.0, 1.0, 0.0]])
    """

    name: str
    vertices: Floats
    faces: NDArray[np.int64]
    normals: Floats
    face_material: NDArray[np.int32]
    face_instance: NDArray[np.int32]
    materials: tuple[Material, ...]
    instances: tuple[Instance, ...]
    face_part: NDArray[np.int8] = field(default_factory=lambda: np.zeros(0, np.int8))

    def __post_init__(self) -> None:
        with Problems(f"scene {self.name!r} cannot be used", SchemaError) as problems:
            # form and type of every array; empty ones become zeros
            arrays: dict[str, NDArray[Any]] = {}
            for name, dtype, like, columns, _ in _ARRAYS:
                array = np.asarray(getattr(self, name))
                shape = (len(arrays[like]) if like else None, *columns)
                is_whole = np.issubdtype(dtype, np.integer)
                arrays[name] = np.zeros((shape[0] or 0, *columns), dtype)
                if array.size == 0 and like:
                    continue
                if array.ndim != len(shape) or any(
                    length not in (None, found) for length, found in zip(shape, array.shape, strict=True)
                ):
                    text = " x ".join("any" if length is None else str(length) for length in shape)
                    problems.add(f"{name} has shape {array.shape}", expected=text, code="dims-wrong")
                elif array.dtype.kind not in ("iu" if is_whole else "iuf"):
                    problems.add(
                        f"{name} is {array.dtype}",
                        expected=f"numbers that fit {np.dtype(dtype)}",
                        code="type-wrong",
                    )
                else:  # integers are narrowed after their range is checked
                    arrays[name] = array.astype(np.int64 if is_whole else np.float64)
                if name == "faces":
                    problems.raise_if_any()  # the form of the other arrays follows from vertices and faces
            # values: finite, or numbers of existing vertices, materials, instances and parts
            counts = {
                "vertices": len(arrays["vertices"]),
                "PARTS": len(PARTS),
                "materials": len(self.materials),
                "instances": len(self.instances),
            }
            for name, _, _, _, numbered in _ARRAYS:
                values = arrays[name]
                bad: Any = [] if numbered else np.flatnonzero(~np.isfinite(values).all(axis=1))
                if len(bad):
                    numbers = ", ".join(str(index) for index in bad[:5]) + (", ..." if len(bad) > 5 else "")
                    problems.add(
                        f"{name} {numbers} ({len(bad)} of {len(values)}) are not finite",
                        mend="correct or remove them",
                        code="not-finite",
                    )
                if numbered and values.size and (values.min() < 0 or values.max() >= counts[numbered]):
                    problems.add(
                        f"{name} has numbers from {values.min()} to {values.max()}",
                        expected=f"numbers of {counts[numbered]} {numbered}, counted from 0",
                        code="index-out-of-range",
                    )
            for kind, items in (("material", self.materials), ("instance", self.instances)):
                names = Counter(item.name for item in items)
                if "" in names:
                    place = [item.name for item in items].index("")
                    problems.add(f"{kind} {place} has an empty name", code="name-empty")
                problems.add_if(
                    duplicates := sorted(name for name, count in names.items() if count > 1),
                    f"several {kind}s are named {', '.join(duplicates[:5])}",
                    mend="rename them",
                    code="name-duplicate",
                )
            for instance in self.instances:
                one_of(
                    instance.kind, INSTANCE_KINDS, f"kind of instance {instance.name!r}", problems=problems
                )
        keeps_area = has_area(arrays["vertices"], arrays["faces"])
        warn_of_dropped(self.name, keeps_area)
        for name, dtype, like, *_ in _ARRAYS:
            kept = arrays[name][keeps_area] if ("faces" in (name, like)) else arrays[name]
            object.__setattr__(self, name, kept.astype(dtype))
        object.__setattr__(self, "materials", tuple(self.materials))
        object.__setattr__(self, "instances", tuple(self.instances))

    @classmethod
    def from_arrays(
        cls,
        vertices: ArrayLike,
        faces: ArrayLike,
        material: Material | Sequence[Material],
        *,
        face_material: ArrayLike | None = None,
        normals: ArrayLike | None = None,
        instance: Instance | str = "thing",
        name: str = "",
    ) -> Scene:
        """Return a scene of one instance.

        Parameters
        ----------
        vertices, faces, normals
            As for `Scene`; flat faces without ``normals``.
        material
            The material, or several materials that ``face_material`` numbers.
        face_material
            Number of the material of every triangle, shape (face,); needed with more than one material.
        instance
            The instance; a name creates an instance of the kind "other".
        name
            Name of the scene; by default that of the instance.

        Raises
        ------
        SchemaError
            As for `Scene`, or ``face_material`` is missing.

        Examples
        --------
        >>> corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
        >>> Scene.from_arrays(corners, [[0, 1, 2]], Material("grey", "panel_20", "panel")).area.round(3)
        array([0.5])
        """
        scene_instance = Instance(instance) if isinstance(instance, str) else instance
        materials = (material,) if isinstance(material, Material) else tuple(material)
        count = len(np.atleast_1d(np.asarray(faces)))
        if face_material is None:
            SchemaError.raise_if(
                len(materials) != 1,
                f"scene of {scene_instance.name!r} has {len(materials)} materials and no face_material",
                expected="the number of the material of every triangle",
                mend="pass face_material=",
                code="argument-missing",
            )
            face_material = np.zeros(count, np.int32)
        return cls(
            name or scene_instance.name,
            np.asarray(vertices),
            np.asarray(faces),
            np.zeros((0, 3)) if normals is None else np.asarray(normals),
            np.asarray(face_material),
            np.zeros(count, np.int32),
            materials,
            (scene_instance,),
        )

    @classmethod
    def join(cls, scenes: Sequence[Scene], name: str = "scene") -> Scene:
        """Return a scene with the content of several scenes; equal materials are merged.

        Parameters
        ----------
        scenes
            Scenes whose instances have different names.
        name
            Name of the new scene.

        Raises
        ------
        SchemaError
            Two different materials, or two instances, have the same name.

        Examples
        --------
        >>> grey = Material("grey", "panel_20", "panel")
        >>> low, high = plane(2.0, grey, instance="low"), plane(1.0, grey, instance="high")
        >>> joined = Scene.join([low, high.moved((0, 0, 1))], "steps")
        >>> len(joined.faces), len(joined.materials), [instance.name for instance in joined.instances]
        (4, 1, ['low', 'high'])
        """
        counts = np.cumsum([0, *(len(scene.instances) for scene in scenes)])
        vertices, faces, materials, face_material = _joined(
            [(scene.vertices, scene.faces, scene.materials, scene.face_material) for scene in scenes]
        )
        instances = [scene.face_instance + first for scene, first in zip(scenes, counts, strict=False)]
        return cls(
            name,
            vertices,
            faces,
            np.concatenate([np.zeros((0, 3)), *(scene.normals for scene in scenes)]),
            face_material,
            np.concatenate([np.zeros(0, np.int64), *instances]),
            materials,
            tuple(instance for scene in scenes for instance in scene.instances),
            np.concatenate([np.zeros(0, np.int8), *(scene.face_part for scene in scenes)]),
        )

    @property
    def bounds(self) -> Floats:
        # Minimum and maximum coordinates of the triangles, shape (2, 3) [m]; NaN without triangles.
        if not len(self.faces):
            return np.full((2, 3), np.nan)
        corners = self.vertices[self.faces.reshape(-1)]
        return np.stack([corners.min(axis=0), corners.max(axis=0)])

    @property
    def area(self) -> Floats:
        # Area of every triangle, shape (face,) [m2].
        return np.asarray(0.5 * np.linalg.norm(_double_area_vectors(self.vertices, self.faces), axis=1))

    @property
    def factors(self) -> tuple[Factor, ...]:
        """All spectra of the scene in the order of path codes: bases, flakes, transmittances, turned flakes.

        Examples
        --------
        >>> from hyperpaint.simulation.rendering.materials import Coat, Flakes
        >>> paint = Material("paint", "silver", "paint", Coat(), Flakes(0.3))
        >>> [factor.flakes for factor in plane(1.0, paint).factors]
        [False, True]
        """
        kinds: tuple[tuple[Factor, Callable[[Material], Any]], ...] = (
            (Factor(0), lambda _: True),
            (Factor(0, flakes=True), lambda material: material.flakes),
            (Factor(0, through=True), lambda material: material.transmittance),
            (
                Factor(0, flakes=True, turned=True),
                lambda material: material.flakes and material.flakes.turned,
            ),
        )
        return tuple(
            replace(factor, material=number)
            for factor, has in kinds
            for number, material in enumerate(self.materials)
            if has(material)
        )

    def moved(self, offset: Sequence[float] = (0.0, 0.0, 0.0), heading: float = 0.0) -> Scene:
        """Return the scene rotated around the vertical through its origin, then shifted.

        Parameters
        ----------
        offset
            Shift to the east, north and up [m].
        heading
            New direction of its y axis, clockwise from north [degree].

        Examples
        --------
        >>> arrow = Scene.from_arrays([[0, 0, 0], [0, 2, 0], [-1, 0, 0]], [[0, 1, 2]], Material("m", "grey"))
        >>> arrow.moved((0, 0, 5), heading=90).vertices[1].round(6).tolist()
        [2.0, 0.0, 5.0]
        """
        sine, cosine = np.sin(np.radians(heading)), np.cos(np.radians(heading))
        turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        return replace(
            self, vertices=self.vertices @ turn + np.asarray(offset, np.float64), normals=self.normals @ turn
        )


def plane(
    size: float | tuple[float, float] = 20.0,
    material: Material | None = None,
    *,
    centre: Sequence[float] = (0.0, 0.0, 0.0),
    instance: Instance | str = "ground",
) -> Scene:
    """Return a level rectangle of two triangles that face upwards.

    Parameters
    ----------
    size
        Size along east and north [m].
    material
        Material; by default asphalt.
    centre
        East, north and up of the centre [m].
    instance
        The instance, or its name.

    Raises
    ------
    SchemaError
        The size or centre is not finite, or the name of the instance is empty.

    Examples
    --------
    >>> plane((4.0, 2.0)).area.sum()
    np.float64(8.0)
    """
    east, north = (size, size) if isinstance(size, int | float) else size
    corners = np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])
    vertices = corners * (east, north, 1.0) + np.asarray(centre, np.float64)
    if isinstance(instance, str):
        instance = Instance(instance, "ground" if instance == "ground" else "other")
    ground_material = material or Material("asphalt", "asphalt", "asphalt")
    return Scene.from_arrays(vertices, [[0, 1, 2], [0, 2, 3]], ground_material, instance=instance)


def _double_area_vectors(vertices: Floats, faces: NDArray[np.int64]) -> Floats:
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return np.asarray(np.cross(b - a, c - a))


def has_area(vertices: Floats, faces: NDArray[np.int64]) -> NDArray[np.bool_]:
    # which triangles have an area, shape (face,); the normal of thinner triangles is undefined
    longest_squared = ((vertices[faces] - vertices[np.roll(faces, 1, axis=1)]) ** 2).sum(axis=2).max(axis=1)
    return np.asarray(
        np.linalg.norm(_double_area_vectors(vertices, faces), axis=1) > _MIN_SHAPE * longest_squared
    )


def warn_of_dropped(name: str, with_area: NDArray[np.bool_]) -> None:
    dropped = int((~with_area).sum())
    warn_if(
        dropped,
        f"scene {name!r}: {dropped} of {len(with_area)} triangles have no area and were dropped",
        "triangle-without-area",
    )


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
        Number of the part of every triangle, shape (face,), into `PARTS`.
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
        # Return the mesh moved by ``offset``: east, north and up [m].
        return replace(self, vertices=self.vertices + np.asarray(offset, np.float64))

    def scene(self, materials: dict[str, Material], instance: Instance) -> Scene:
        # Return the mesh as a scene of one instance; ``materials``: material by name of the surface.
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
    vertices, faces, surfaces, numbers = _joined(
        [(mesh.vertices, mesh.faces, mesh.surfaces, mesh.surface) for mesh in meshes]
    )
    return Mesh(
        vertices,
        faces,
        numbers,
        surfaces,
        np.concatenate([mesh.part for mesh in meshes]),
        np.concatenate([mesh.normals for mesh in meshes]),
    )


def _joined(pieces: Sequence[tuple[Floats, Ints, Sequence[Any], NDArray[Any]]]) -> tuple[Any, ...]:
    # vertices, faces, distinct names and their number for every face, of several pieces
    numbers: dict[Any, int] = {}
    first_vertex = np.cumsum([0, *(len(vertices) for vertices, *_ in pieces)])
    shifted = [faces + first for (_, faces, _, _), first in zip(pieces, first_vertex, strict=False)]
    numbered = [
        np.array([numbers.setdefault(name, len(numbers)) for name in names], np.int64)[number]
        for _, _, names, number in pieces
    ]
    return (
        np.concatenate([np.zeros((0, 3)), *(vertices for vertices, *_ in pieces)]),
        np.concatenate([np.zeros((0, 3), np.int64), *shifted]),
        tuple(numbers),
        np.concatenate([np.zeros(0, np.int64), *numbered]),
    )


# A row of a shape
class Part(NamedTuple):
    form: Callable[..., Mesh]  # `cuboid`, `tube`, `polygon` or `lattice`, or a function that returns a mesh
    arguments: tuple[Any, ...]  # arguments of the form: dimensions [m], surface, part of a car
    at: tuple[float, float, float] = (0.0, 0.0, 0.0)  # shift to the east, north and up [m]
    crease: float = 0.0  # angle above which edges stay sharp [degree]; 0 for flat faces


def built(parts: Iterable[Part]) -> Mesh:
    """Return the mesh of a shape.

    Examples
    --------
    >>> table = [Part(cuboid, ((2, 1, 0.1), "wood"), (0, 0, 0.7)), Part(cuboid, ((0.2, 0.2, 0.7), "steel"))]
    >>> built(table).surfaces
    ('wood', 'steel')
    """
    meshes = []
    for part in parts:
        mesh = part.form(*part.arguments)
        mesh = smoothed(mesh, part.crease) if part.crease else mesh
        meshes.append(mesh.shifted(part.at) if any(part.at) else mesh)
    return put_together(meshes)


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
    return uniform(points, [[0, corner, corner + 1] for corner in range(1, len(points) - 1)], surface, part)


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
    part: str = "",
    sides: int = 10,
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


def lattice(points: ArrayLike, surface: ArrayLike, part: ArrayLike) -> Mesh:
    """Return a sheet of four-sided cells, split into two triangles.

    Parameters
    ----------
    points
        Shape (row, column, 3) [m]; from outside, columns increase to the left of the direction of rows.
    surface, part
        Names for every cell, shape (row - 1, column - 1); or one name for all cells.

    Examples
    --------
    >>> points = [[[0, 0, 0], [0, 1, 0]], [[1, 0, 0], [1, 1, 0]]]
    >>> lattice(points, "paint", "roof").faces.tolist()
    [[0, 2, 3], [0, 3, 1]]
    """
    grid = np.asarray(points, np.float64)
    rows, columns = grid.shape[:2]
    corner = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]
    faces = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
    words, part_words = (np.broadcast_to(word, a.shape).ravel().tolist() for word in (surface, part))
    surfaces = sorted(set(words))
    numbers, parts = np.array(
        [[surfaces.index(word) for word in words], [PARTS.index(word) for word in part_words]], np.int64
    ).repeat(2, axis=1)
    return Mesh(grid.reshape(-1, 3), faces, numbers, tuple(surfaces), parts)


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
    # number every distinct pair of vertex and normal; normals are packed into one integer with 21 bits per
    # axis, because sorting dominates the time for a large mesh
    steps = np.rint((normals + 1.0) * 1e6).astype(np.int64)
    code = (steps[:, 0] << 42) | (steps[:, 1] << 21) | steps[:, 2]
    order = np.lexsort((code, vertex))
    is_new = np.ones(len(order), bool)
    is_new[1:] = (vertex[order[1:]] != vertex[order[:-1]]) | (code[order[1:]] != code[order[:-1]])
    first_corner, corner = order[is_new], np.empty(len(order), np.int64)
    corner[order] = np.cumsum(is_new) - 1
    return replace(
        mesh,
        vertices=mesh.vertices[vertex[first_corner]],
        faces=corner.reshape(-1, 3).astype(np.int64),
        surface=mesh.surface[keeps_area],
        part=mesh.part[keeps_area],
        normals=normals[first_corner],
    )


_MAX_SLOTS = 4096


@declared
@dataclass(frozen=True)
class TraceSettings:
    """Settings of a trace.

    Attributes
    ----------
    suns
        Zenith and azimuth, clockwise from north, of every sun [degree].
    overcast, clear
        As for `relighting.trace`.

    Raises
    ------
    SchemaError
        Something is out of range; all problems are listed.
    """

    suns: tuple[tuple[float, float], ...]
    samples: int = fact(
        64,
        "number of rays per pixel; noise falls with the square root of this number",
        least=1,
        most=MOST_SAMPLES,
    )
    depth: int = fact(4, "maximum number of reflections of a ray", least=1, most=32)
    seed: int = fact(0, "seed of the random numbers for the rays", least=0, most=MAX_SEED)
    slots: int | None = fact(
        None,
        "maximum number of light paths that are stored per pixel; by default from the number of suns, skies "
        "and samples",
        kind="whole",
        least=1,
        most=_MAX_SLOTS,
    )
    overcast: bool = False
    clear: bool = True
    sun_radius: float = fact(
        0.267,
        "angular radius of the sun",
        unit="degree",
        key="sun_radius_deg",
        scale=1.0,
        least=0.0,
        most=45.0,
    )

    def __post_init__(self) -> None:
        try:
            directions = tuple(tuple(float(angle) for angle in sun) for sun in self.suns)
        except (TypeError, ValueError):
            raise SchemaError(
                f"suns={self.suns!r}",
                expected="a list of (zenith, azimuth) in degrees",
                code="sun-unreadable",
            ) from None
        object.__setattr__(self, "suns", directions)
        with Problems("the scene cannot be traced", SchemaError) as problems:
            problems.add_if(
                not 1 <= len(self.suns) <= MAX_SUNS,
                f"{len(self.suns)} suns",
                expected=f"1 to {MAX_SUNS}",
                code="sun-number",
            )
            for number, sun in enumerate(self.suns):
                if len(sun) != 2 or not all(np.isfinite(sun)):
                    problems.add(
                        f"sun {number} is {sun!r}",
                        expected="(zenith, azimuth) in degrees",
                        code="sun-unreadable",
                    )
                elif not 0.0 <= sun[0] < 90.0:
                    problems.add(
                        f"sun {number} has zenith {sun[0]:g}",
                        expected="0 to below 90 degrees",
                        code="value-out-of-range",
                    )
            check_fields(self, problems)

    @property
    def slot_count(self) -> int:
        # Slots of a pixel: 24 for each source, times the square root of samples / 64, unless given.
        if self.slots is not None:
            return self.slots
        sources = (
            len(self.suns) + 1 + self.overcast + (CLEAR_SKY_FUNCTIONS * len(self.suns) if self.clear else 0)
        )
        return min(_MAX_SLOTS, max(16, 8 * math.ceil(3 * sources * math.sqrt(self.samples / 64))))


def sun_vectors(suns: Any) -> Floats:
    """Return unit vectors (sun, 3) towards suns given by zenith and azimuth [degree]: east, north, up.

    Examples
    --------
    >>> sun_vectors([(90.0, 90.0), (0.0, 0.0)]).round(12)
    array([[1., 0., 0.],
           [0., 0., 1.]])
    """
    zenith, azimuth = np.radians(np.asarray(suns, np.float64).reshape(-1, 2)).T
    return np.stack(
        [np.sin(zenith) * np.sin(azimuth), np.sin(zenith) * np.cos(azimuth), np.cos(zenith)], axis=1
    )


# A scene without its geometry
@dataclass(frozen=True)
class SceneRecord:
    name: str  # name of the scene
    # materials, instances: materials and instances by the numbers of the label layers
    materials: tuple[Material, ...]
    instances: tuple[Instance, ...]
    members: tuple[tuple[int, ...], ...]  # numbers of the materials of every instance
    factors: tuple[Factor, ...]  # spectra by the digits of path codes

    @classmethod
    def of(cls, scene: Scene) -> SceneRecord:
        count = len(scene.materials)
        pairs = np.unique(scene.face_instance.astype(np.int64) * count + scene.face_material)
        members: list[list[int]] = [[] for _ in scene.instances]
        for pair in pairs.tolist():
            members[pair // count].append(pair % count)
        return cls(scene.name, scene.materials, scene.instances, tuple(map(tuple, members)), scene.factors)

    def to_attrs(self, settings: TraceSettings) -> dict[str, Any]:
        instances = [
            {**asdict(instance), "materials": list(members)}
            for instance, members in zip(self.instances, self.members, strict=True)
        ]
        return {
            "scene": self.name,
            "materials": json.dumps([asdict(material) for material in self.materials]),
            "instances": json.dumps(instances),
            "factors": json.dumps([asdict(factor) for factor in self.factors]),
            "suns": json.dumps(settings.suns),
            "samples": int(settings.samples),
            "depth": int(settings.depth),
            "seed": int(settings.seed),
            "overcast": int(settings.overcast),
            "clear": int(settings.clear),
            "source_bits": SOURCE_BITS,
            "clear_sky_functions": ", ".join(FUNCTIONS[1:]),
            "sun_radius": float(settings.sun_radius),
        }

    @classmethod
    def from_attrs(cls, attrs: Mapping[Any, Any]) -> tuple[SceneRecord, TraceSettings]:
        # Return the record and settings from attributes that `to_attrs` wrote.
        #
        # Raises `SchemaError`: Attributes are missing or damaged; all are listed.
        SchemaError.raise_if(
            "factors" in attrs and attrs.get("source_bits", 3) != SOURCE_BITS,
            "the scene was traced by an older hyperpaint, with 3 bits for the source of a path",
            expected=f"{SOURCE_BITS} bits",
            mend="trace the scene again",
            code="trace-outdated",
        )
        SchemaError.raise_if(
            attrs.get("clear") and attrs.get("clear_sky_functions") != ", ".join(FUNCTIONS[1:]),
            "the scene was traced by another hyperpaint, with other functions of the clear sky",
            expected=f"functions {', '.join(FUNCTIONS[1:])}",
            mend="trace the scene again",
            code="trace-outdated",
        )
        with Problems("not a dataset from hyperpaint.simulation.trace", SchemaError) as problems:
            texts: dict[str, list[Any]] = {}
            for name in ("materials", "instances", "factors", "suns"):
                try:
                    texts[name] = json.loads(attrs[name])
                except KeyError:
                    problems.add(f"attribute {name!r} is missing", code="metadata-missing")
                except (TypeError, ValueError, RecursionError):
                    problems.add(f"attribute {name!r} is not JSON text", code="metadata-damaged")
                else:
                    problems.add_if(
                        not isinstance(texts[name], list) or not texts[name],
                        f"attribute {name!r} is not a list with entries",
                        code="metadata-damaged",
                    )
            for name in ("samples", "depth", "seed", "overcast", "clear"):
                problems.add_if(
                    not isinstance(attrs.get(name), int | np.integer),
                    f"attribute {name!r} is {attrs.get(name)!r}",
                    expected="a whole number",
                    code="metadata-damaged",
                )
        with SchemaError.instead_of(
            (TypeError, KeyError, IndexError, AttributeError, ValueError),
            "not a dataset from hyperpaint.simulation.trace: its attributes are damaged ($whole)",
            code="metadata-damaged",
        ):
            parts = {"coat": Coat, "flakes": Flakes}
            materials = tuple(
                Material(
                    **{
                        key: parts[key](**value) if key in parts and value is not None else value
                        for key, value in fields.items()
                    }
                )
                for fields in texts["materials"]
            )
            members = tuple(tuple(map(int, fields.pop("materials"))) for fields in texts["instances"])
            instances = tuple(Instance(**fields) for fields in texts["instances"])
            factors = tuple(Factor(**fields) for fields in texts["factors"])
            record = cls(str(attrs.get("scene", "")), materials, instances, members, factors)
            for number in (*(factor.material for factor in factors), *(n for part in members for n in part)):
                materials[number]  # an IndexError is damage
            settings = TraceSettings(
                tuple(texts["suns"]),
                samples=int(attrs["samples"]),
                depth=int(attrs["depth"]),
                seed=int(attrs["seed"]),
                overcast=bool(attrs["overcast"]),
                clear=bool(attrs["clear"]),
                sun_radius=float(attrs.get("sun_radius", 0.0)),
            )
        return record, settings

    def codes(self, settings: TraceSettings) -> PathCodes:
        return PathCodes.of(len(self.factors), settings.depth)

    def labels(self, names: Sequence[str] | None = None) -> dict[str, LabelTable]:
        # label layers that follow from the material or the instance of a pixel, by name.
        # ``names``: spectrum of every material; None for the spectra of the scene.
        kinds = [material.kind for material in self.materials]
        spectra = [material.spectrum for material in self.materials] if names is None else list(names)
        # all built-in paints come first, so that their numbers are equal in all scenes of a training set
        own = {name for name, kind in zip(spectra, kinds, strict=True) if kind == "paint"}
        paints = (*FOURTEEN, *sorted(own.difference(FOURTEEN)))
        paint_id = [
            paints.index(name) if kind == "paint" else -1 for name, kind in zip(spectra, kinds, strict=True)
        ]
        cars = [number if item.kind == "car" else -1 for number, item in enumerate(self.instances)]

        def flags(words: Sequence[str]) -> dict[str, Any]:
            meanings = " ".join(word.replace(" ", "_") for word in words)
            return {"flag_values": np.arange(len(words), dtype=np.int16), "flag_meanings": meanings}

        # the last entry is for the sky, whose material and instance are -1
        return {
            "surface_class": LabelTable(np.array([*map(KINDS.index, kinds), -1], np.int16), flags(KINDS)),
            "paint_id": LabelTable(np.array([*paint_id, -1], np.int16), flags(paints)),
            "car_id": LabelTable(np.array([*cars, -1], np.int32), {}),
        }


# Label by the number of the material, or for cars of the instance, and the attributes of the layer.
class LabelTable(NamedTuple):
    table: NDArray[Any]
    attrs: dict[str, Any]


def label_layers(labels: Mapping[str, LabelTable], material: Array, instance: Array) -> dict[str, Array]:
    # label layers of pixels
    return {name: row.table[instance if name == "car_id" else material] for name, row in labels.items()}
