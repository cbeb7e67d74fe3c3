"""Attributes of a traced dataset: its scene and trace settings, and the labels that follow from them."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.facts import check_fields, declared, fact
from hyperpaint.base.schema import Array, Floats
from hyperpaint.simulation.settings import MAX_SEED, MOST_SAMPLES
from hyperpaint.simulation.transport.path_codes import (
    CLEAR_SKY_FUNCTIONS,
    MAX_SUNS,
    SOURCE_BITS,
    PathCodes,
)

from .materials import KINDS, Coat, Flakes, Material
from .scene import Factor, Instance, Scene
from .scene_spectra import FOURTEEN

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
        problems = Problems("the scene cannot be traced", SchemaError)
        problems.add_if(
            not 1 <= len(self.suns) <= MAX_SUNS,
            f"{len(self.suns)} suns",
            expected=f"1 to {MAX_SUNS}",
            code="sun-number",
        )
        for number, sun in enumerate(self.suns):
            if len(sun) != 2 or not all(np.isfinite(sun)):
                problems.add(
                    f"sun {number} is {sun!r}", expected="(zenith, azimuth) in degrees", code="sun-unreadable"
                )
            elif not 0.0 <= sun[0] < 90.0:
                problems.add(
                    f"sun {number} has zenith {sun[0]:g}",
                    expected="0 to below 90 degrees",
                    code="value-out-of-range",
                )
        check_fields(self, problems)
        problems.raise_if_any()

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
        problems = Problems("not a dataset from hyperpaint.simulation.trace", SchemaError)
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
        problems.raise_if_any()
        try:
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
        except (TypeError, KeyError, IndexError, AttributeError, ValueError) as error:
            raise SchemaError(
                f"not a dataset from hyperpaint.simulation.trace: its attributes are damaged ({error})",
                code="metadata-damaged",
            ) from error
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
