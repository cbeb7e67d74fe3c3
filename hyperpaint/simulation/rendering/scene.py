"""A scene: triangles with their materials and instances."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hyperpaint.base.arrays import Floats
from hyperpaint.base.errors import PaintWarning, Problems, SchemaError
from hyperpaint.base.facts import one_of

from .materials import Material

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


@dataclass(frozen=True)
class Factor:
    """A spectrum by which a path of light can be multiplied.

    Attributes
    ----------
    material
        Number of the material.
    flakes
        False for the base of the material, True for its metal flakes.
    through
        True for the transmittance of a thin surface.
    turned
        True for the spectrum of flakes with light and view at right angles (`materials.Flakes.turned`).
    """

    material: int
    flakes: bool = False
    through: bool = False
    turned: bool = False


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
        problems = Problems(f"scene {self.name!r} cannot be used", SchemaError)
        vertices = _array(problems, "vertices", self.vertices, np.float64, (None, 3))
        faces = _array(problems, "faces", self.faces, np.int64, (None, 3))
        problems.raise_if_any()  # further checks need these two arrays
        count = len(faces)
        normals = _array(problems, "normals", self.normals, np.float64, (len(vertices), 3))
        material = _array(problems, "face_material", self.face_material, np.int32, (count,))
        instance = _array(problems, "face_instance", self.face_instance, np.int32, (count,))
        part = _array(problems, "face_part", self.face_part, np.int8, (count,))
        for name, values in (("vertices", vertices), ("normals", normals)):
            bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
            if len(bad):
                numbers = ", ".join(str(index) for index in bad[:5]) + (", ..." if len(bad) > 5 else "")
                problems.add(
                    f"{name} {numbers} ({len(bad)} of {len(values)}) are not finite",
                    mend="correct or remove them",
                    code="not-finite",
                )
        _check_range(problems, "faces", faces, len(vertices), "vertices")
        _check_range(problems, "face_material", material, len(self.materials), "materials")
        _check_range(problems, "face_instance", instance, len(self.instances), "instances")
        _check_range(problems, "face_part", part, len(PARTS), "PARTS")
        _check_names(problems, "material", [material.name for material in self.materials])
        _check_names(problems, "instance", [instance.name for instance in self.instances])
        for item in self.instances:
            one_of(item.kind, INSTANCE_KINDS, f"kind of instance {item.name!r}", problems=problems)
        problems.raise_if_any()
        keeps_area = has_area(vertices, faces)
        warn_of_dropped(self.name, keeps_area)
        checked: dict[str, Any] = {
            "vertices": vertices,
            "faces": faces[keeps_area],
            "normals": normals,
            "face_material": material[keeps_area].astype(np.int32),
            "face_instance": instance[keeps_area].astype(np.int32),
            "face_part": part[keeps_area].astype(np.int8),
            "materials": tuple(self.materials),
            "instances": tuple(self.instances),
        }
        for name, value in checked.items():
            object.__setattr__(self, name, value)

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
            if len(materials) != 1:
                raise SchemaError(
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
        materials: dict[Material, int] = {}
        instances: list[Instance] = []
        faces, face_material, face_instance = [], [], []
        first_vertex = 0
        for scene in scenes:
            numbers = [materials.setdefault(material, len(materials)) for material in scene.materials]
            faces.append(scene.faces + first_vertex)
            face_material.append(np.asarray(numbers, np.int32)[scene.face_material])
            face_instance.append(scene.face_instance + np.int32(len(instances)))
            instances.extend(scene.instances)
            first_vertex += len(scene.vertices)
        return cls(
            name,
            np.concatenate([np.zeros((0, 3)), *(scene.vertices for scene in scenes)]),
            np.concatenate([np.zeros((0, 3), np.int64), *faces]),
            np.concatenate([np.zeros((0, 3)), *(scene.normals for scene in scenes)]),
            np.concatenate([np.zeros(0, np.int32), *face_material]),
            np.concatenate([np.zeros(0, np.int32), *face_instance]),
            tuple(materials),
            tuple(instances),
            np.concatenate([np.zeros(0, np.int8), *(scene.face_part for scene in scenes)]),
        )

    @property
    def bounds(self) -> Floats:
        """Minimum and maximum coordinates of the triangles, shape (2, 3) [m]; NaN without triangles."""
        if not len(self.faces):
            return np.full((2, 3), np.nan)
        corners = self.vertices[self.faces.reshape(-1)]
        return np.stack([corners.min(axis=0), corners.max(axis=0)])

    @property
    def area(self) -> Floats:
        """Area of every triangle, shape (face,) [m2]."""
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
        bases = [Factor(number) for number in range(len(self.materials))]
        flakes = [Factor(i, True) for i, material in enumerate(self.materials) if material.flakes is not None]
        plates = [
            Factor(i, through=True) for i, material in enumerate(self.materials) if material.transmittance
        ]
        turned = [
            Factor(i, True, turned=True)
            for i, material in enumerate(self.materials)
            if material.flakes and material.flakes.turned
        ]
        return (*bases, *flakes, *plates, *turned)

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
        angle = np.radians(heading)
        turn = np.array(
            [[np.cos(angle), np.sin(angle), 0.0], [-np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]]
        )
        return replace(
            self,
            vertices=self.vertices @ turn.T + np.asarray(offset, np.float64),
            normals=self.normals @ turn.T,
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


def _array(
    problems: Problems, name: str, values: object, dtype: type, shape: tuple[int | None, ...]
) -> NDArray[Any]:
    # values as an array of this shape (None is any length); empty values become zeros; faults are noted
    array = np.asarray(values)
    if array.size == 0 and shape[0] is not None:
        return np.zeros([length or 0 for length in shape], dtype)
    expected_shape = " x ".join("any" if length is None else str(length) for length in shape)
    if array.ndim != len(shape) or any(
        expected is not None and expected != actual
        for expected, actual in zip(shape, array.shape, strict=True)
    ):
        problems.add(f"{name} has shape {array.shape}", expected=expected_shape, code="dims-wrong")
    elif array.dtype.kind not in ("iu" if np.issubdtype(dtype, np.integer) else "iuf"):
        problems.add(
            f"{name} is {array.dtype}", expected=f"numbers that fit {np.dtype(dtype)}", code="type-wrong"
        )
    else:
        # integers are narrowed after their range is checked
        return array.astype(np.int64 if np.issubdtype(dtype, np.integer) else np.float64)
    return np.zeros([length or 0 for length in shape], dtype)


def _check_range(problems: Problems, name: str, numbers: NDArray[Any], count: int, item_name: str) -> None:
    if numbers.size and (numbers.min() < 0 or numbers.max() >= count):
        problems.add(
            f"{name} has numbers from {numbers.min()} to {numbers.max()}",
            expected=f"numbers of {count} {item_name}, counted from 0",
            code="index-out-of-range",
        )


def _check_names(problems: Problems, kind: str, names: Sequence[str]) -> None:
    if "" in names:
        problems.add(f"{kind} {names.index('')} has an empty name", code="name-empty")
    if len(set(names)) < len(names):
        duplicates = sorted(name for name, count in Counter(names).items() if count > 1)
        problems.add(
            f"several {kind}s are named {', '.join(duplicates[:5])}",
            mend="rename them",
            code="name-duplicate",
        )


def _double_area_vectors(vertices: Floats, faces: NDArray[np.int64]) -> Floats:
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return np.asarray(np.cross(b - a, c - a))


def has_area(vertices: Floats, faces: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which triangles have an area, shape (face,); the normal of thinner triangles is undefined."""
    longest_squared = ((vertices[faces] - vertices[np.roll(faces, 1, axis=1)]) ** 2).sum(axis=2).max(axis=1)
    return np.asarray(
        np.linalg.norm(_double_area_vectors(vertices, faces), axis=1) > _MIN_SHAPE * longest_squared
    )


def warn_of_dropped(name: str, with_area: NDArray[np.bool_]) -> None:
    if not with_area.all():
        dropped = int((~with_area).sum())
        warnings.warn(
            PaintWarning(
                f"scene {name!r}: {dropped} of {len(with_area)} triangles have no area and were dropped",
                code="triangle-without-area",
            ),
            stacklevel=4,
        )
