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

#: Parts of a car; the place in this tuple is the number in `Scene.face_part`, and 0 is no part.
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

_MIN_SHAPE = 1e-12  # a triangle whose area is less than this times its longest edge squared is a line


@dataclass(frozen=True)
class Instance:
    """One thing in a scene.

    Attributes
    ----------
    name
        "ground", "car_007", "tree_02".
    kind
        One of `INSTANCE_KINDS`.
    paint
        Name of a car's paint spectrum; empty for what has no paint.
    """

    name: str
    kind: str = "other"
    paint: str = ""


@dataclass(frozen=True)
class Factor:
    """One spectrum that a path of light can be multiplied by.

    Attributes
    ----------
    material
        Number of the material.
    flakes
        False for the base of the material, True for its metal flakes.
    through
        True for what a thin surface passes.
    turned
        True for flakes with another spectrum where light and view are at right angles, and that spectrum.
    """

    material: int
    flakes: bool = False
    through: bool = False
    turned: bool = False


@dataclass(frozen=True, eq=False)
class Scene:
    """Triangles in a local frame: x east, y north, z up [m].

    A scene that exists can be traced: making one checks everything, and drops triangles without area.

    Attributes
    ----------
    name
        Of the scene.
    vertices
        Shape (vertex, 3) [m].
    faces
        Vertices of every triangle, shape (face, 3), int64.
    normals
        Normals at the vertices for smooth shading, shape (vertex, 3); zero where a face is flat. Given empty,
        all are zero.
    face_material, face_instance
        Number of the material and of the instance of every triangle, shape (face,), int32.
    materials, instances
        What the numbers mean.
    face_part
        Which part of a car every triangle is, a number into `PARTS`, shape (face,), int8. Given empty, all
        are 0.

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
        problems.raise_if_any()  # without these two, the rest has no meaning
        count = len(faces)
        normals = _array(problems, "normals", self.normals, np.float64, (len(vertices), 3))
        material = _array(problems, "face_material", self.face_material, np.int32, (count,))
        instance = _array(problems, "face_instance", self.face_instance, np.int32, (count,))
        part = _array(problems, "face_part", self.face_part, np.int8, (count,))
        for name, values in (("vertices", vertices), ("normals", normals)):
            bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
            if len(bad):
                where = ", ".join(str(index) for index in bad[:5]) + (", ..." if len(bad) > 5 else "")
                problems.add(
                    f"{name} {where} ({len(bad)} of {len(values)}) are not finite",
                    mend="mend or remove them",
                    code="not-finite",
                )
        _check_range(problems, "faces", faces, len(vertices), "vertices")
        _check_range(problems, "face_material", material, len(self.materials), "materials")
        _check_range(problems, "face_instance", instance, len(self.instances), "instances")
        _check_range(problems, "face_part", part, len(PARTS), "PARTS")
        _check_names(problems, "material", [material.name for material in self.materials])
        _check_names(problems, "instance", [instance.name for instance in self.instances])
        for thing in self.instances:
            one_of(thing.kind, INSTANCE_KINDS, f"kind of instance {thing.name!r}", problems=problems)
        problems.raise_if_any()
        with_area = has_area(vertices, faces)
        warn_of_dropped(self.name, with_area)
        checked: dict[str, Any] = {
            "vertices": vertices,
            "faces": faces[with_area],
            "normals": normals,
            "face_material": material[with_area].astype(np.int32),
            "face_instance": instance[with_area].astype(np.int32),
            "face_part": part[with_area].astype(np.int8),
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
        """Return a scene of one thing.

        Parameters
        ----------
        vertices, faces, normals
            As `Scene` has them; flat faces without ``normals``.
        material
            What all of it is made of, or the materials that ``face_material`` counts.
        face_material
            Number of the material of every triangle, shape (face,); needed with more than one material.
        instance
            What it is; a mere name makes an "other".
        name
            Of the scene; the name of the thing where it is empty.

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
        thing = Instance(instance) if isinstance(instance, str) else instance
        materials = (material,) if isinstance(material, Material) else tuple(material)
        count = len(np.atleast_1d(np.asarray(faces)))
        if face_material is None:
            if len(materials) != 1:
                raise SchemaError(
                    f"scene of {thing.name!r} has {len(materials)} materials and no face_material",
                    expected="the number of the material of every triangle",
                    mend="pass face_material=",
                    code="argument-missing",
                )
            face_material = np.zeros(count, np.int32)
        return cls(
            name or thing.name,
            np.asarray(vertices),
            np.asarray(faces),
            np.zeros((0, 3)) if normals is None else np.asarray(normals),
            np.asarray(face_material),
            np.zeros(count, np.int32),
            materials,
            (thing,),
        )

    @classmethod
    def join(cls, scenes: Sequence[Scene], name: str = "scene") -> Scene:
        """Return one scene with the content of several; equal materials become one.

        Parameters
        ----------
        scenes
            Their instances must have different names: see `prefixed`.
        name
            Of the new scene.

        Raises
        ------
        SchemaError
            Two different materials, or two instances, have the same name.

        Examples
        --------
        >>> grey = Material("grey", "panel_20", "panel")
        >>> low, high = plane(2.0, grey, instance="low"), plane(1.0, grey, instance="high")
        >>> both = Scene.join([low, high.moved((0, 0, 1))], "steps")
        >>> len(both.faces), len(both.materials), [one.name for one in both.instances]
        (4, 1, ['low', 'high'])
        """
        materials: dict[Material, int] = {}
        instances: list[Instance] = []
        faces, face_material, face_instance = [], [], []
        first = 0
        for scene in scenes:
            numbers = [materials.setdefault(material, len(materials)) for material in scene.materials]
            faces.append(scene.faces + first)
            face_material.append(np.asarray(numbers, np.int32)[scene.face_material])
            face_instance.append(scene.face_instance + np.int32(len(instances)))
            instances.extend(scene.instances)
            first += len(scene.vertices)
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
        """Lowest and highest corner of its triangles, shape (2, 3) [m]; NaN where there are none."""
        if not len(self.faces):
            return np.full((2, 3), np.nan)
        used = self.vertices[self.faces.reshape(-1)]
        return np.stack([used.min(axis=0), used.max(axis=0)])

    @property
    def area(self) -> Floats:
        """Area of every triangle, shape (face,) [m2]."""
        return np.asarray(0.5 * np.linalg.norm(_crossed(self.vertices, self.faces), axis=1))

    @property
    def factors(self) -> tuple[Factor, ...]:
        """Every spectrum of the scene in the order of path codes: bases, flakes, plates, turned flakes.

        Examples
        --------
        >>> from hyperpaint.simulation.rendering.materials import Coat, Flakes
        >>> paint = Material("paint", "silver", "paint", Coat(), Flakes(0.3))
        >>> [factor.flakes for factor in plane(1.0, paint).factors]
        [False, True]
        """
        bases = [Factor(number) for number in range(len(self.materials))]
        flakes = [Factor(i, True) for i, material in enumerate(self.materials) if material.flakes is not None]
        plates = [Factor(i, through=True) for i, one in enumerate(self.materials) if one.transmittance]
        turned = [
            Factor(i, True, turned=True)
            for i, one in enumerate(self.materials)
            if one.flakes and one.flakes.turned
        ]
        return (*bases, *flakes, *plates, *turned)

    def moved(self, offset: Sequence[float] = (0.0, 0.0, 0.0), heading: float = 0.0) -> Scene:
        """Return the scene turned about the vertical through its origin, then shifted.

        Parameters
        ----------
        offset
            East, north and up [m].
        heading
            Where its y axis points then, clockwise from north [degree].

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
    """Return a level rectangle that looks up, of two triangles.

    Parameters
    ----------
    size
        Along east and north [m].
    material
        Asphalt unless given.
    centre
        East, north and up [m].
    instance
        What it is.

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
    made_of = material or Material("asphalt", "asphalt", "asphalt")
    return Scene.from_arrays(vertices, [[0, 1, 2], [0, 2, 3]], made_of, instance=instance)


def _array(
    problems: Problems, name: str, values: object, dtype: type, shape: tuple[int | None, ...]
) -> NDArray[Any]:
    # Empty values become zeros of the known length.
    array = np.asarray(values)
    if array.size == 0 and shape[0] is not None:
        return np.zeros([length or 0 for length in shape], dtype)
    wanted = " x ".join("any" if length is None else str(length) for length in shape)
    if array.ndim != len(shape) or any(
        w is not None and w != f for w, f in zip(shape, array.shape, strict=True)
    ):
        problems.add(f"{name} has shape {array.shape}", expected=wanted, code="dims-wrong")
    elif array.dtype.kind not in ("iu" if np.issubdtype(dtype, np.integer) else "iuf"):
        problems.add(
            f"{name} is {array.dtype}", expected=f"numbers that fit {np.dtype(dtype)}", code="type-wrong"
        )
    else:
        # whole numbers stay wide until their range has been looked at
        return array.astype(np.int64 if np.issubdtype(dtype, np.integer) else np.float64)
    return np.zeros([length or 0 for length in shape], dtype)


def _check_range(problems: Problems, name: str, numbers: NDArray[Any], count: int, of: str) -> None:
    if numbers.size and (numbers.min() < 0 or numbers.max() >= count):
        problems.add(
            f"{name} has numbers from {numbers.min()} to {numbers.max()}",
            expected=f"numbers of {count} {of}, counted from 0",
            code="index-out-of-range",
        )


def _check_names(problems: Problems, what: str, names: Sequence[str]) -> None:
    if "" in names:
        problems.add(f"{what} {names.index('')} has an empty name", code="name-empty")
    if len(set(names)) < len(names):
        twice = sorted(name for name, count in Counter(names).items() if count > 1)
        problems.add(
            f"several {what}s are named {', '.join(twice[:5])}", mend="rename them", code="name-duplicate"
        )


def _crossed(vertices: Floats, faces: NDArray[np.int64]) -> Floats:
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return np.asarray(np.cross(b - a, c - a))


def has_area(vertices: Floats, faces: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which triangles have an area, shape (face,); thinner ones have no direction."""
    longest = ((vertices[faces] - vertices[np.roll(faces, 1, axis=1)]) ** 2).sum(axis=2).max(axis=1)
    return np.asarray(np.linalg.norm(_crossed(vertices, faces), axis=1) > _MIN_SHAPE * longest)


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
