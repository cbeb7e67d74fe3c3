"""Scene files: a ``scene.toml`` is read and checked, its parts are built, and its flight is rendered.

The tables of the file, each key with its unit in its name; `EXAMPLE` shows them all (``hyperpaint render
--example``):

``[scene]``
    ``kind``: "car_park" (arguments of `hyperpaint.simulation.rendering.car_parks.car_park`), "plane"
    (``size_m``, ``spectrum``) or "empty"; ``name``, ``seed``.
``[[meshes]]``
    ``path`` of an .obj, .glb or .ply file; ``spectrum``, or ``materials`` by the names of its parts;
    ``name``, ``kind``, ``class``, ``coat_index``, ``coat_roughness``, ``coat_gloss``, ``coat_waviness_deg``,
    ``flakes``; ``offset_m``, ``heading_deg``, ``unit_m``, ``up``.
``[platform]``
    ``lines`` and ``columns``, and arguments of `hyperpaint.simulation.rendering.platforms.pushbroom`.
``[camera]``
    Fields of `hyperpaint.simulation.SimulationSettings` that make a camera.
``[[atmospheres]]``
    ``name``, and a ``preset`` ("noon", "near_sunset", "cloudy"), a ``table`` of four curves, or the
    ``irradiance`` files of a spectrometer; ``sun_zenith_deg``, ``sun_azimuth_deg``, ``oktas`` and others.
``[sampling]``
    ``samples``, ``depth``, ``slots``, ``seed``, ``sun_radius_deg``.
``[spectra]``, ``[paints]``
    ``[spectra]``: a file with a spectrum, or a paint library, by name; paints of a library are "name/paint".
    ``[paints]``: the new spectrum, by the name of a spectrum, material or car.
``[output]``
    ``product``: "radiance" or "counts"; ``true_reflectance``; ``hold_edges``.
"""

import contextlib
import dataclasses
import hashlib
import json
import os
import shutil
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from hyperpaint.base import (
    CHUNK_LINES,
    CUBE,
    EXCLUDED,
    FORMAT_VERSION,
    IRRADIANCE_TIME,
    IRRADIANCE_WAVELENGTH,
    KEPT_BITS,
    NUMERICS_VERSION,
    VARIABLES,
    Fact,
    Facts,
    Floats,
    Floats32,
    FormatError,
    PaintError,
    Problem,
    Problems,
    SchemaError,
    Spelling,
    StoreError,
    arguments_of,
    as_argument,
    as_path,
    by_key,
    documented,
    fact,
    facts_of,
    filled,
    input_path,
    read_limited,
    round_bits,
    shown,
    url_of,
    warn_user,
)
from hyperpaint.io.dirsig import write_dirsig_scene
from hyperpaint.io.dirsig.dirsig_files import read_materials
from hyperpaint.io.files.reading import TableReader, digest_of_file, load_tables, values
from hyperpaint.io.library import open_library
from hyperpaint.io.skies import read_sky_csv
from hyperpaint.io.spectrometers.irradiance import open_irradiance
from hyperpaint.io.spectrometers.spectrum_csv import read_spectrum_csv
from hyperpaint.io.store import (
    INPUTS,
    SETTINGS,
    WholeRun,
    errors_of_the_cluster,
    list_groups,
    open_group,
    open_store,
    size_text,
)
from hyperpaint.pictures.figures import new_figure, save_figure
from hyperpaint.pictures.plot import overview
from hyperpaint.simulation.atmosphere import PRESETS, SKY, Atmosphere, preset_atmosphere
from hyperpaint.simulation.camera import BandSet, Camera
from hyperpaint.simulation.collect import labelled_variable
from hyperpaint.simulation.rendering.car_parks import BAY, CAR_PARK, car_park, note_car_park_faults
from hyperpaint.simulation.rendering.materials import KINDS, Coat, Flakes, Material, coat_of_gloss
from hyperpaint.simulation.rendering.mesh_files import read_mesh
from hyperpaint.simulation.rendering.platforms import PUSHBROOM, Platform, note_pushbroom_faults, pushbroom
from hyperpaint.simulation.rendering.relighting import (
    HELD_NM,
    PAINT_VARIABLES,
    assigned_paints,
    by_name,
    relight,
    trace,
)
from hyperpaint.simulation.rendering.scene import (
    INSTANCE_KINDS,
    Instance,
    Scene,
    SceneRecord,
    TraceSettings,
    plane,
)
from hyperpaint.simulation.rendering.scene_spectra import spectrum_of
from hyperpaint.simulation.settings import CAMERA_FIELDS, ORIGIN, SimulationSettings
from hyperpaint.simulation.transport.path_codes import MAX_SUNS

from .pipeline import (
    Outcome,
    computing_on,
    digest_of,
    refuse_to_write_over,
    write_groups,
)

#: Kinds of generated scenes; any of them may hold meshes as well.
SCENE_KINDS = ("car_park", "plane", "empty")

#: Quantities of a rendered cube.
PRODUCTS = ("radiance", "counts")

_MAX_TRIANGLES = 5_000_000  # of a car park: some 2000 cars and their trees
_MAX_VALUES = 10**11  # of a cube; a day's flying has a hundredth


@dataclass(frozen=True)
class MeshEntry:
    # One ``[[meshes]]``: a file, and its place in the scene.
    path: Path
    name: str
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class AtmosphereEntry:
    # One ``[[atmospheres]]``: its name, the source of its light, and changes to it.
    name: str
    preset: str | None = None
    table: Path | None = None
    irradiance: tuple[Path, ...] = ()
    options: Mapping[str, Any] = field(default_factory=dict)  #: ``time`` and numbers of `SKY`, by argument.


@dataclass(frozen=True)
class SceneFile:
    # Content of a ``scene.toml``; its paths are absolute and exist.
    path: Path
    name: str
    scene: Mapping[str, Any]  #: ``[scene]``: its ``kind`` and the keys of that kind.
    meshes: tuple[MeshEntry, ...]
    platform: Mapping[str, Any]  #: Arguments of `hyperpaint.simulation.rendering.platforms.pushbroom`.
    camera: Mapping[str, Any]  #: Fields of `hyperpaint.simulation.SimulationSettings`.
    atmospheres: tuple[AtmosphereEntry, ...]  #: At least one.
    sampling: Mapping[str, Any]  #: Every key of ``[sampling]``.
    spectra: Mapping[str, Path]
    paints: Mapping[str, str]  #: Name of a spectrum, material or instance: name of its new spectrum.
    product: str = fact("radiance", "physical quantity of the cube", choices=PRODUCTS)
    #: Whether the reflectance without noise is stored as well.
    true_reflectance: bool = fact(True, "whether to store the true reflectance, without noise, with the cube")
    #: Whether spectra are held beyond their ends, and over bands without values; None: over a short range.
    hold_edges: bool | None = fact(
        None,
        "whether to continue spectra with constant values beyond their first and last band, and to "
        "interpolate bands without values; without this key up to 25 nm at the ends, with a warning",
        kind="flag",
    )


#: Keys of a car park but for its coat.
PARK = by_key((CAR_PARK | {"fleet": dataclasses.replace(CAR_PARK["fleet"], default="real")}).values())

#: Keys of a clear coat; without any of them, a paint keeps its coat.
COAT = by_key([
    *(dataclasses.replace(declared, default=None) for declared in facts_of(Coat).values()),
    Fact(
        name="gloss", key="coat_gloss", kind="number", scale=1.0, least=1.0, most=100.0,
        doc="gloss of the clear coat at 20 degrees [gloss units]; an alternative to coat_roughness",
    ),
])  # fmt: skip

#: Keys of a material of a mesh.
MATERIAL = {
    **by_key(
        [
            Fact(name="spectrum", doc="name of the reflectance spectrum of the surface", example="red"),
            Fact(name="class", kind="choice", choices=KINDS, doc="class of the surface"),
            facts_of(Flakes)["share"],
        ]
    ),
    **COAT,
}

#: Fields of the camera's settings that are keys of ``[camera]``; ``[platform]`` has the columns.
_CAMERA_FIELDS = CAMERA_FIELDS - {"columns"} | {"noise", "dark_frames"}

#: Facts of every key of every table; the keys of `NAMED` are names.
SCHEMA: Mapping[str, Facts] = {
    "scene": by_key([
        Fact(name="name", doc="name of the scene; by default the name of the file"),
        Fact(name="kind", kind="choice", choices=SCENE_KINDS, default="car_park",
             doc="kind of scene: a car park, a level plane, or only the meshes"),
        Fact(
            name="size_m", kind="numbers", length=2, single=True, unit="m", least=0.0, above=True,
            default=1000.0, doc="length of the sides of a plane; one number for a square, or two",
        ),
        Fact(name="spectrum", default="asphalt", doc="name of the reflectance spectrum of a plane"),
        *PARK.values(),
        Fact(name="coat", kind="flag", default=True,
             doc="whether paints have a clear coat; without it they are Lambertian"),
        *COAT.values(),
    ]),
    "meshes": by_key([
        Fact(name="path", needed=True, doc="file of the mesh: .obj, or .glb and .ply with the extra mesh"),
        Fact(name="name", doc="name of the mesh; by default mesh_1, mesh_2 ..."),
        Fact(name="kind", kind="choice", choices=INSTANCE_KINDS, default="other", doc="kind of object"),
        *MATERIAL.values(),
        Fact(
            name="materials", kind="own", accepts=lambda value: isinstance(value, dict),
            phrase="a table: name of a part = spectrum",
            doc="materials of the parts of the mesh; a material is the name of a spectrum, or a table with "
            "the keys spectrum, class, flakes and coat_...",
        ),
        Fact(name="offset_m", kind="numbers", length=3, unit="m",
             doc="displacement of the mesh to east, north and up",
             default=[0.0, 0.0, 0.0]),
        Fact(
            name="heading_deg", kind="number", unit="degree", scale=1.0, least=-360.0, most=360.0,
            default=0.0, doc="rotation of the mesh, clockwise seen from above",
        ),
        Fact(
            name="unit_m", kind="number", unit="m", scale=1.0, least=0.0, above=True, default=1.0,
            doc="length of the unit in which the file states coordinates",
        ),
        Fact(name="up", kind="choice", choices=("x", "y", "z"),
             doc="axis of the file that points up; by default y in GLB files, z in others"),
    ]),
    "platform": by_key([
        dataclasses.replace(one, kind="time", accepts=None, phrase="", example="2021-07-20T17:10:00")
        if one.name == "start_time" else one
        for one in PUSHBROOM.values()
    ]),
    "camera": by_key(
        one for name, one in facts_of(SimulationSettings).items() if name in _CAMERA_FIELDS
    ),
    "atmospheres": by_key([
        Fact(name="name", doc="name of the group of the store for this light; by default the preset"),
        Fact(name="preset", kind="choice", choices=tuple(PRESETS),
             doc="name of a built-in sun and sky; an alternative to table and irradiance"),
        Fact(name="table",
             doc="file with wavelength, direct and diffuse irradiance; an alternative to preset"),
        Fact(name="irradiance", kind="texts",
             doc="files of an irradiance spectrometer; an alternative to preset"),
        Fact(name="time", kind="time",
             doc="UTC for which irradiance is read from the record; needed if it holds several spectra"),
        *SKY.values(),
    ]),
    "sampling": by_key(facts_of(TraceSettings).values()),
    "spectra": {},
    "paints": {},
    "output": by_key(facts_of(SceneFile).values()),
}  # fmt: skip

#: Tables whose keys are the user's names, each with a text.
NAMED = {
    "spectra": "your own spectrum: lines of wavelength [nm] and reflectance, or a paint library",
    "paints": "spectrum that repaints a car, a material or all that has a spectrum, without tracing again",
}

#: Tables that may occur several times.
LISTS = ("meshes", "atmospheres")

#: Sources of the light of an atmosphere: one of these keys.
_SOURCES = ("preset", "table", "irradiance")


def example_scene() -> str:
    # Return a commented ``scene.toml`` to begin with.
    return resources.files(__package__).joinpath("example_scene.toml").read_text(encoding="utf-8")


def read_scene_file(path: str | os.PathLike[str]) -> SceneFile:
    # Read and check a ``scene.toml``; the files that it names are located from its folder, not opened.
    #
    # Raises `FormatError`: not TOML (with the line), unknown keys, wrong types or values, missing keys or
    # files; all problems are listed.
    path = input_path(path, "a scene.toml")
    raw = load_tables(path, "a scene.toml")
    problems = Problems(f"{path} cannot be rendered", FormatError)
    named = {
        table: {name: Fact(doc=doc) for name in raw[table]}
        for table, doc in NAMED.items()
        if isinstance(raw.get(table), dict)
    }
    reader = TableReader(path, raw, {**SCHEMA, **named}, LISTS, problems)
    spectra = {
        name: reader.path("[spectra]", name, file) for name, file in values(reader.one("spectra")).items()
    }
    platform, camera = _flight(reader)
    scene: dict[str, Any] = _scene(reader)
    entries, names = [], []
    for row, mesh_table in enumerate(reader.tables["meshes"]):
        place, name = reader.place("meshes", row), mesh_table.get("name", f"mesh_{row + 1}")
        for is_missing, mesh_key, mend in (
            ("path" not in mesh_table["?"], "path", "name the file of its triangles"),
            (
                not mesh_table["?"] & {"spectrum", "materials"},
                "spectrum",
                "name a spectrum, or materials, part by part",
            ),
        ):
            reader.problems.add_if(
                is_missing, f"{place} {mesh_key} is missing", mend=mend, code="key-missing"
            )
        for part, material in mesh_table.get("materials", {}).items():
            where = f"{place} materials.{part:.40}"
            surface = {"spectrum": material} if isinstance(material, str) else material
            if not isinstance(surface, dict) or "spectrum" not in surface:
                reader.problems.add(
                    f"{where} = {shown(material)}",
                    expected="a spectrum, or a table with spectrum",
                    mend="name its spectrum",
                    code="type-wrong",
                )
                continue
            for mesh_key, value in surface.items():
                if mesh_key in MATERIAL:
                    found = f"{where}.{mesh_key} = {shown(value)}"
                    MATERIAL[mesh_key].note(reader.problems, found, value, MATERIAL[mesh_key].mend)
                else:
                    found = f"{where} unknown key {mesh_key[:40]!r}"
                    reader.problems.add(found, mend=f"known are {', '.join(MATERIAL)}", code="key-unknown")
        mesh_path = reader.path(place, "path", mesh_table.get("path"))
        reader.problems.add_if(
            name in names,
            f"{place} name = {name!r} is the name of another mesh",
            mend="give each its own name",
            code="name-duplicate",
        )
        names.append(name)
        if mesh_path is not None:
            options = {
                mesh_key: value
                for mesh_key, value in values(mesh_table).items()
                if mesh_key not in ("path", "name")
            }
            entries.append(MeshEntry(mesh_path, name, options))
    scene_file = SceneFile(
        path=path, name=reader.one("scene").get("name", path.stem), scene=scene,
        meshes=tuple(entries), platform=platform, camera=camera, atmospheres=_atmospheres(reader),
        sampling=filled(SCHEMA["sampling"], reader.one("sampling")),
        spectra={name: file for name, file in spectra.items() if file is not None},
        paints=values(reader.one("paints")), **values(reader.one("output")),
    )  # fmt: skip
    if scene_file.scene["kind"] == "car_park":
        # 1300 triangles a car, two a leaf
        park = park_arguments(scene_file.scene)
        bays = park["length"] / BAY[1] * (park["rows"] or park["width"] / 8.0)
        trees = park["length"] / 7.5 + bays / 10.0 if "trees" in park["neighbours"] else 0.0
        triangles = float(1300.0 * bays * park["occupancy"] + 2.0 * trees * park["leaves"])
        problems.add_if(
            triangles > _MAX_TRIANGLES,
            f"[scene] would have some {triangles:.1e} triangles",
            expected=f"at most {_MAX_TRIANGLES:.0e}",
            mend="make it shorter or narrower, or give its trees fewer leaves",
            code="scene-too-large",
        )
    lines, columns = (scene_file.platform.get(key, 1) for key in ("lines", "columns"))
    bands = scene_file.camera.get("bands", SimulationSettings.bands)
    problems.raise_if_any(
        (
            lines * columns * bands > _MAX_VALUES,
            Problem(
                f"{lines} lines x {columns} columns x {bands} bands are "
                f"{lines * columns * bands:.1e} samples",
                expected=f"at most {_MAX_VALUES:.0e}",
                mend="cut the flight into several",
                code="cube-too-large",
            ),
        )
    )
    return scene_file


#: Keys of [scene] for one kind of scene only.
_KEYS_OF_KIND = {
    "plane": {"size_m", "spectrum"},
    "car_park": {*PARK, "coat", *COAT} - {"seed"},
    "empty": set(),
}


def _scene(reader: TableReader) -> dict[str, Any]:
    table = reader.one("scene")
    kind = table.get("kind", "car_park")
    if "scene" not in reader.given and "meshes" not in reader.given:
        reader.problems.add("no [scene] and no [[meshes]]", mend="add one of them", code="scene-empty")
    elif kind == "empty" and not reader.tables["meshes"]:
        reader.problems.add(
            '[scene] kind = "empty"', expected="[[meshes]] beside it", mend="add a mesh", code="scene-empty"
        )
    allowed = _KEYS_OF_KIND[kind] | {"name", "kind", "seed"}
    kind_is_known = "kind" in table or "kind" not in table["?"]
    for key in sorted(table["?"] & set(SCHEMA["scene"]) - allowed) if kind_is_known else ():
        where = ", ".join(other for other, keys in _KEYS_OF_KIND.items() if key in keys)
        reader.problems.add(
            f"[scene] {key} with kind = {kind!r}",
            expected=f"kind = {where}",
            mend="remove the key, or change the kind",
            code="key-misplaced",
        )
    if "scene" not in reader.given:
        kind = "empty"
    if kind == "car_park" and set(values(table)) == table["?"]:
        note_car_park_faults(park_arguments(table), reader.problems, _spelled({"scene": table}, ["scene"]))
    return {**{key: value for key, value in values(table).items() if key != "name"}, "kind": kind}


def park_arguments(scene: Mapping[str, Any]) -> dict[str, Any]:
    # Return the arguments of `car_park` that a table ``[scene]`` gives, but for the coat.
    return arguments_of(PARK, filled(PARK, scene))


def _flight(reader: TableReader) -> tuple[dict[str, Any], dict[str, Any]]:
    # arguments of the platform and of the camera, checked together once each is in its range
    tables = {name: reader.one(name) for name in ("platform", "camera")}
    for key in ("lines", "columns"):
        reader.problems.add_if(
            key not in tables["platform"]["?"],
            f"[platform] {key} is missing",
            mend="state the size of the cube",
            code="key-missing",
        )
    platform, camera = (arguments_of(SCHEMA[name], values(table)) for name, table in tables.items())
    problems, before = reader.problems, len(reader.problems)
    # the tables are compared where each of them is right
    wrong = any(set(values(table)) != table["?"] for table in tables.values())
    if wrong or not {"lines", "columns"} <= set(platform):
        return platform, camera
    note_pushbroom_faults(platform, problems, _spelled(tables, ["platform"]))
    if len(problems) == before:
        SimulationSettings.note_faults(
            camera_fields(platform, camera), problems, _spelled(tables, ["camera", "platform"])
        )
    return platform, camera


def camera_fields(platform: Mapping[str, Any], camera: Mapping[str, Any]) -> dict[str, Any]:
    # Return the fields of `SimulationSettings` that the tables of a scene give.
    fields = {name: value for name, value in camera.items() if name != "noise"}
    times = [name for name in ("exposure_time", "frame_period") if name in platform]
    fields |= {f"{name}_ms": platform[name] * 1e3 for name in times}
    return {**fields, "columns": platform["columns"], "lines": max(2, platform["lines"])}


def _spelled(tables: Mapping[str, Mapping[str, Any]], places: Iterable[str]) -> Spelling:
    def spelled(name: str, value: Any) -> str:
        for place in places:
            for key, one in SCHEMA[place].items():
                if name in (one.name, key):
                    return f"[{place}] {key} = {shown(tables[place].get(key, one.default))}"
        return as_argument(name, value)

    return spelled


def _atmospheres(reader: TableReader) -> tuple[AtmosphereEntry, ...]:
    if not reader.tables["atmospheres"] and "atmospheres" not in reader.given:
        return (AtmosphereEntry("noon", "noon"),)
    entries = []
    for row, table in enumerate(reader.tables["atmospheres"]):
        # The entry of one table
        place = reader.place("atmospheres", row)
        problems, present = reader.problems, table["?"]
        sources = [key for key in _SOURCES if key in present]
        reader.exclude(place, table, *_SOURCES)
        name = table.get("name", table.get("preset"))
        if name is None:
            problems.add_if(
                not present & {"name", "preset"},
                f"{place} name is missing",
                mend="name its group in the store",
                code="key-missing",
            )
            continue
        reader.is_name(place, "name", name)
        measured = [source for source in sources if source != "preset"]
        needs_sun = sources[:1] not in ([], ["preset"]) and "sun_zenith_deg" not in present
        checks = (
            (
                not sources and name not in PRESETS,
                Problem(
                    f"{place} name = {shown(name)} without a source of light",
                    expected=f"a preset ({', '.join(PRESETS)}), table or irradiance",
                    mend="name one of them",
                    code="choice-unknown",
                ),
            ),
            (
                needs_sun,
                Problem(
                    f"{place} sun_zenith_deg is missing",
                    mend=f"state where the sun stands: {''.join(sources[:1])} does not contain it",
                    code="key-missing",
                ),
            ),
            *(
                (
                    key in present and sources != ["irradiance"],
                    Problem(
                        f"{place} {key} without irradiance",
                        mend="name files of a spectrometer",
                        code="key-misplaced",
                    ),
                )
                for key in ("direct_fraction", "time")
            ),
            *(
                (
                    key in present and measured != [],
                    Problem(
                        f"{place} {key} with {''.join(sources[-1:])}",
                        expected="a preset",
                        mend="remove the key",
                        code="key-misplaced",
                    ),
                )
                for key in ("aerosol", "water")
            ),
        )
        problems.extend(problem for is_wrong, problem in checks if is_wrong)
        files = reader.files(place, "irradiance", table["irradiance"]) if "irradiance" in table else ()
        options = arguments_of(
            SCHEMA["atmospheres"],
            {key: value for key, value in values(table).items() if key not in ("name", *_SOURCES)},
        )
        preset = table.get("preset", None if sources else name)
        table_path = reader.path(place, "table", table.get("table"))
        entries.append(AtmosphereEntry(name, preset, table_path, files, options))
    names = [entry.name.lower() for entry in entries]
    for name in sorted({name for name in names if names.count(name) > 1}):
        reader.problems.add(
            f"[[atmospheres]] name {name!r} is given to {names.count(name)}",
            mend="give each its own name",
            code="name-duplicate",
        )
    suns = {
        (entry.options.get("sun_zenith", zenith), entry.options.get("sun_azimuth", azimuth))
        for entry in entries
        for zenith, azimuth in [PRESETS.get(entry.preset or "", PRESETS["noon"])]
    }
    reader.problems.add_if(
        len(suns) > MAX_SUNS,
        f"[[atmospheres]] have {len(suns)} suns",
        expected=f"1 to {MAX_SUNS}",
        mend="render some of them into another store",
        code="sun-number",
    )
    return tuple(entries)


_TABLE_SUFFIXES = (".csv", ".txt", ".tsv", ".asc", "")
MAX_EXPORT_BYTES = 64 << 20
_DIRSIG_MARKER, _MATERIALS = "paints.json", "materials.mat"


def read_spectra(path: Path) -> Any:
    # Return the spectra of a file of ``[spectra]``, in the form that `hyperpaint.simulation.relight` takes.
    #
    # A file of two columns gives (wavelength [nm], reflectance) in double precision; other files are
    # libraries. Raises `FormatError` or `StoreError` as `read_paints`.
    path = input_path(path, "spectra")
    if path.is_file() and path.suffix.lower() in _TABLE_SUFFIXES:
        try:
            return read_spectrum_csv(path)
        except FormatError as plain:
            try:
                return read_paints(path)
            except FormatError:
                raise plain from None
    return read_paints(path)


def read_paints(path: Path) -> dict[str, xr.Dataset] | xr.Dataset:
    # Return the paints of a file or folder: a library, or libraries of one paint by name.
    #
    # Accepted are all files that `hyperpaint.open_library` opens, and exports of `hyperpaint.write_dirsig`:
    # their folder, their material list (``.mat``), or one of their ``.ems`` and ``.txt`` files.
    #
    # Raises `FormatError`: The file has another format, or a file of the material list is missing. Raises
    # `StoreError`: A Zarr store is unfinished or invalid.
    if path.suffix.lower() == ".mat":
        return _dirsig_paints(path)
    return (
        _dirsig_paints(path / _MATERIALS)
        if path.is_dir() and (path / _DIRSIG_MARKER).is_file() and (path / _MATERIALS).is_file()
        else open_library(path)
    )


def _dirsig_paints(path: Path) -> dict[str, xr.Dataset]:

    records: dict[str, dict[str, Any]] = {}  # by material id; empty for material lists of other programs
    with contextlib.suppress(FormatError, OSError, ValueError, TypeError, KeyError):
        document = json.loads(read_limited(path.parent / _DIRSIG_MARKER, MAX_EXPORT_BYTES, "an export"))
        records = {str(record["id"]): dict(record) for record in document["paints"]}
    with Problems(f"{path} cannot be rendered", FormatError) as problems:
        paints: dict[str, xr.Dataset] = {}
        for material in read_materials(path):
            file = material.emissivity_file or material.reflectance_file
            if file is None:
                problems.add(
                    f"material {material.name!r} without an emissivity or reflectance file",
                    code="material-without-file",
                )
            elif not (path.parent / file).is_file():
                problems.add(
                    f"material {material.name!r}: no file {file!r} beside the list", code="file-not-found"
                )
            else:
                paint, record = open_library(path.parent / file), records.get(str(material.id), {})
                if coat := record.get("coat_reflectance", 0.0):  # curves of a BRDF include its coat
                    body = {name: paint[name] - np.float32(coat) for name in paint.data_vars}
                    paint = paint.assign({name: body[name].assign_attrs(paint[name].attrs) for name in body})
                centre = path.parent / str(record.get("reflectance_file", file))
                if centre.is_file():  # an emissivity file of many curves lacks the centre of the paint
                    curve = open_library(centre)
                    nm, centre_nm = paint["wavelength"].values, curve["wavelength"].values
                    if nm.shape == centre_nm.shape and np.allclose(nm, centre_nm, rtol=0.0, atol=1e-3):
                        values = curve["reflectance"].values
                        paint = paint.assign(reflectance=(paint["reflectance"].dims, values, {"units": "1"}))
                paints[str(record.get("paint", material.name))] = paint
    return paints


def spectra_digest(spectra: Mapping[str, Any]) -> str:
    # Return a digest of all values of spectra, which shows whether a render was made from them.
    digest = hashlib.sha256()
    for name, value in spectra.items():
        digest.update(f"{name} ".encode())
        if hasattr(value, "data_vars"):
            stored_names = ("signature", "wavelength", "good", *PAINT_VARIABLES)
            for variable in (variable for variable in stored_names if variable in value.variables):
                values = np.asarray(value[variable].values)
                digest.update(
                    str(values.tolist()).encode() if values.dtype.kind in "OUT" else values.tobytes()
                )
        else:
            for array in value:
                digest.update(np.asarray(array).tobytes())
    return digest.hexdigest()


@dataclass(frozen=True)
class RenderParts:
    # All parts of a render.
    scene: Scene
    platform: Platform
    camera: Camera
    noise: bool  #: Whether the camera has noise.
    atmospheres: tuple[Atmosphere, ...]  #: Atmospheres of the file; all their suns are traced.
    spectra: Mapping[str, Any]  #: Spectra of the file: (wavelength [nm], reflectance), or a paint library.

    @property
    def suns(self) -> list[tuple[float, float]]:
        # Zenith and azimuth of every distinct sun [degree].
        return list(dict.fromkeys((light.sun_zenith, light.sun_azimuth) for light in self.atmospheres))

    @property
    def overcast(self) -> bool:
        # Whether an atmosphere has an overcast sky, brighter towards the zenith.
        return any(light.overcast_share > 0.0 for light in self.atmospheres)


def build_parts(file: SceneFile) -> RenderParts:
    # Return the parts that a scene file describes.
    #
    # Raises `FormatError` if the file, or one of its files, cannot be used; all problems are listed. Raises
    # `MissingExtraError` if a mesh needs a package that is not installed.
    parts: dict[str, Any] = {}
    builders: dict[str, Callable[[], Any]] = {
        "[scene]": lambda: _built_scene(file),
        "[camera]": lambda: Camera.of(SimulationSettings.of(camera_fields(file.platform, file.camera))),
        "[[atmospheres]]": lambda: _built_atmospheres(file),
        "[spectra]": lambda: _spectra(file),
        "[platform]": lambda: _platform(file, parts.get("[scene]")),
    }
    _built(builders, Problems(f"{file.path} cannot be rendered", FormatError), parts)
    return RenderParts(
        **{table.strip("[]"): part for table, part in parts.items()}, noise=file.camera.get("noise", True)
    )


def _built(
    builders: Mapping[str, Callable[[], Any]], problems: Problems, parts: dict[str, Any]
) -> dict[str, Any]:
    # add the results of all builders to ``parts``, so that the problems of all are listed
    for name, build in builders.items():
        try:
            parts[name] = build()
        except ImportError:
            raise
        except (PaintError, OSError) as error:
            problems.add_error(name, error)
    problems.raise_if_any()
    return parts


def chosen_atmospheres(parts: RenderParts, names: Sequence[str]) -> tuple[Atmosphere, ...]:
    # Return the atmospheres with these names, by default all; `SchemaError` for an unknown name.
    by_name = {light.name: light for light in parts.atmospheres}
    unknown = [name for name in names if name not in by_name]
    SchemaError.raise_if(
        unknown,
        f"there is no atmosphere {', '.join(map(repr, unknown))} in the scene file",
        expected=f"some of {', '.join(by_name)}",
        code="choice-unknown",
    )
    return tuple(by_name[name] for name in dict.fromkeys(names)) if names else parts.atmospheres


# --- the scene ---------------------------------------------------------------------------------------------


def _built_scene(file: SceneFile) -> Scene:
    kind, parts = file.scene["kind"], []
    if kind == "car_park":
        coat: Any = (_coat(file.scene) or "own") if file.scene.get("coat", True) else None
        parts.append(car_park(**park_arguments(file.scene), coat=coat))
    elif kind == "plane":
        ground = arguments_of(SCHEMA["scene"], filled(SCHEMA["scene"], file.scene))
        surface = "asphalt" if ground["spectrum"] == "asphalt" else "other"
        parts.append(plane(ground["size_m"], Material("ground", ground["spectrum"], surface)))
    parts += [_mesh(entry) for entry in file.meshes]
    return replace(parts[0], name=file.name) if len(parts) == 1 else Scene.join(parts, file.name)


def _mesh(entry: MeshEntry) -> Scene:
    facts = SCHEMA["meshes"]
    options = arguments_of(facts, filled(facts, entry.options))
    kind = options["kind"]
    surface = {key: value for key, value in entry.options.items() if key in MATERIAL}
    default = _material(entry.name, surface, kind) if "spectrum" in surface else None
    parts = {
        part: _material(f"{part} of {entry.name}", table, kind)
        for part, table in (options["materials"] or {}).items()
    }
    painted = [
        material.spectrum
        for material in (default, *parts.values())
        if material is not None and material.kind == "paint"
    ]
    mesh = read_mesh(
        entry.path,
        parts,
        default=default,
        instance=Instance(entry.name, kind, painted[0] if kind == "car" and painted else ""),
        unit=options["unit_m"],
        up=options["up"],
    )
    return mesh.moved(options["offset_m"], options["heading_deg"])


def _coat(table: Mapping[str, Any]) -> Coat | None:
    # None without keys of a coat; gloss takes precedence over roughness
    options = arguments_of(COAT, {key: table[key] for key in COAT if key in table})
    if "gloss" not in options:
        return Coat(**options) if options else None
    options.pop("roughness", None)
    return coat_of_gloss(options.pop("gloss"), **options)


def _material(name: str, table: str | Mapping[str, Any], kind: str) -> Material:
    # a material of a car is paint unless the table has another class
    table = {"spectrum": table} if isinstance(table, str) else table
    surface = table.get("class", "paint" if kind == "car" else "other")
    coat, share = _coat(table), float(table.get("flakes", 0.0))
    return Material(
        f"paint of {name}" if surface == "paint" else name,
        table["spectrum"],
        surface,
        Coat() if coat is None and (share or surface == "paint") else coat,
        Flakes(share) if share else None,
    )


# --- platform and camera -----------------------------------------------------------------------------------


def _platform(file: SceneFile, scene: Scene | None) -> Platform:
    options = dict(file.platform)
    if "centre" not in options and "start" not in options and scene is not None:
        # by default the flight is over the centre of the scene
        east, north = scene.bounds[:, :2].mean(axis=0)
        options["centre"] = float(east), float(north)
        if file.scene["kind"] == "car_park":
            # the park extends from y = 0 to the north; the ground around it extends further
            options["centre"] = 0.0, park_arguments(file.scene)["length"] / 2
    return pushbroom(**options)


# --- light -------------------------------------------------------------------------------------------------


def _built_atmospheres(file: SceneFile) -> tuple[Atmosphere, ...]:

    def built(entry: AtmosphereEntry) -> Atmosphere:
        options = dict(entry.options)
        oktas = options.pop("oktas", None)
        if entry.table is not None:
            atmosphere = Atmosphere.from_table(read_sky_csv(entry.table), **options)
        elif entry.irradiance:
            atmosphere = Atmosphere.from_irradiance(open_irradiance(entry.irradiance), **options)
        else:
            atmosphere = preset_atmosphere(entry.preset or entry.name)
            share = options.pop("overcast_share", None)
            if options or oktas is not None:
                oktas = 8.0 if oktas is None and atmosphere.overcast_share > 0.0 else oktas
                sun = {"sun_zenith": atmosphere.sun_zenith, "sun_azimuth": atmosphere.sun_azimuth}
                atmosphere = Atmosphere.clear(**{**sun, **options})
            if share is not None:
                atmosphere = replace(atmosphere, overcast_share=share)
        return replace(atmosphere.clouded(oktas) if oktas else atmosphere, name=entry.name)

    problems = Problems("the atmospheres cannot be used", SchemaError)
    return tuple(
        _built({entry.name: partial(built, entry) for entry in file.atmospheres}, problems, {}).values()
    )


def _spectra(file: SceneFile) -> dict[str, Any]:
    readers = {name: partial(read_spectra, path) for name, path in file.spectra.items()}
    spectra: dict[str, Any] = {}
    for name, value in _built(readers, Problems("spectra cannot be read", FormatError), {}).items():
        if isinstance(value, dict):  # paints on different wavelengths
            is_single = len(value) == 1
            spectra |= {name if is_single else f"{name}/{paint}": curve for paint, curve in value.items()}
        else:
            spectra[name] = value
    return spectra


_INTERVAL_S = 2  # time between samples of the spectrometer
_MARGIN_S = 6  # record before and after the flight
_DARK_FRAMES = 64  # number of frames averaged for a dark
# keys of the random streams, different from those of other simulators
_NOISE, _DARK = 20, 21


def flight_line(
    traced: xr.Dataset, atmosphere: Atmosphere, file: SceneFile, parts: RenderParts
) -> xr.Dataset:
    # Return the flight line of a traced scene under an atmosphere, lazily; see `hyperpaint.render_scene`.
    # Bands of counts are weighted by the responsivity of the detector. Bands of radiance are not: readers of
    # radiance do not know the responsivity, and resample the irradiance without it.
    bands = BandSet.of(parts.camera.imager)
    relit = relight(
        traced,
        bands if file.product == "counts" else dataclasses.replace(bands, responsivity=None),
        paints=dict(file.paints),
        atmosphere=atmosphere,
        spectra=dict(parts.spectra),
        hold_edges=file.hold_edges,
    )
    picture = overview(relit)
    line = relit.rename(reflectance="true_reflectance")
    if file.true_reflectance:
        # rounded to the mantissa bits of a stored reflectance, half to even
        rounded: xr.DataArray = xr.apply_ufunc(
            round_bits,
            line["true_reflectance"],
            KEPT_BITS,
            dask="parallelized",
            output_dtypes=[np.float32],
            keep_attrs=True,
        )
        rounded.attrs |= {"long_name": "Reflectance factor without noise", "keep_bits": KEPT_BITS}
        line["true_reflectance"] = rounded
    else:
        line = line.drop_vars("true_reflectance")
    if file.product == "counts":
        exposure_time, seed = parts.platform.exposure_time, file.sampling["seed"]
        line = line.drop_vars("radiance").merge(
            counts_of(line["radiance"], parts.camera, exposure_time, seed, atmosphere.name, noise=parts.noise)
        )
    # the irradiance that a spectrometer logs every 2 s, from before to after the flight
    first, last = (moment.astype("datetime64[s]") for moment in parts.platform.utc[[0, -1]])
    count = int((last - first).astype(np.int64) + 2 * _MARGIN_S) // _INTERVAL_S + 2
    seconds = _INTERVAL_S * np.arange(count) - _MARGIN_S
    time = (first + seconds.astype("timedelta64[s]")).astype("datetime64[ns]")
    spectrum = np.asarray(line["irradiance"][0].values)
    wavelength = line[IRRADIANCE_WAVELENGTH].variable
    line = line.drop_vars(("irradiance", IRRADIANCE_TIME, IRRADIANCE_WAVELENGTH)).assign(
        irradiance=labelled_variable("irradiance", np.broadcast_to(spectrum, (count, len(spectrum)))),
        irradiance_max_gap=labelled_variable("irradiance_max_gap", 2.5 * _INTERVAL_S),
        look_angle=look_angle_of(parts.platform),
    )
    coords = {IRRADIANCE_TIME: labelled_variable(IRRADIANCE_TIME, time), IRRADIANCE_WAVELENGTH: wavelength}
    line = line.assign_coords({**coords, **pose_of(parts.platform)})
    return line if picture is None else line.assign(overview=picture)


def pose_of(platform: Platform) -> dict[str, xr.Variable]:
    # Return the pose of the camera at mid-exposure of every line, as variables of a flight line.
    roll, pitch, heading = platform.attitude.T
    pose = {"altitude": platform.position[:, 2], "roll": roll, "pitch": pitch, "heading": heading}
    return {name: labelled_variable(name, values) for name, values in pose.items()}


def look_angle_of(platform: Platform) -> xr.Variable:
    # Return the angles of column centres from the camera's axis, positive to the right [degree].
    edges = platform.column_edges
    return labelled_variable("look_angle", np.degrees(np.arctan(0.5 * (edges[1:] + edges[:-1]))))


def counts_of(
    radiance: xr.DataArray, camera: Camera, exposure_time: float, seed: int, name: str, *, noise: bool = True
) -> xr.Dataset:
    # Return the counts of a camera under this radiance, with all variables that calibrate them.
    #
    # Lazy. The noise of a line is drawn from a generator keyed by seed, name of the render and number of the
    # line, so that counts do not depend on chunks or workers; without ``noise`` counts are still rounded. The
    # optics of the camera blur the radiance. ``radiance``: mean over the camera's responses (along_track,
    # band, cross_track) [W m-2 sr-1 nm-1]; ``exposure_time``: [s].
    import dask.array as da

    # a mean radiance of 1 gives (exposure time) x (etendue) x (integral of the response) counts; dead
    # elements 0
    scale, factor = exposure_time * camera.etendue * camera.response_area, np.where(camera.bad, 0.0, 1.0)
    if camera.optics is not None:  # optics act before the response of single elements
        scale, factor = scale / camera.imager.element_factor, factor * camera.imager.element_factor
    detector = camera.detector(exposure_time)
    key = (seed, _NOISE, zlib.crc32(name.encode()))
    cube = radiance.transpose(*CUBE).data
    reach = 0 if camera.optics is None else camera.optics.reach
    number, stops = cube.shape[0], np.cumsum(cube.chunks[0]).tolist()

    def exposed(block: Floats32, first: int, lines: range) -> NDArray[np.uint16]:
        # counts of ``lines`` in their order, because afterglow of a line adds to the next; the block starts
        # at the line ``first``
        block = np.nan_to_num(block, nan=0.0)  # beyond the scene there is no light
        counts = np.empty((len(lines), *block.shape[1:]), dtype=np.uint16)
        for line, row in zip(lines, counts, strict=True):
            rng = np.random.default_rng([*key, line]) if noise else None
            if camera.optics is None:
                signal = np.asarray(block[line - first] * (scale * factor))
            else:
                rows = camera.optics.rows_of(line, number)
                signal = camera.optics.image([block[row - first] * scale for row in rows]) * factor
            electrons = detector.read(signal, rng)
            if camera.pedestal:
                electrons += camera.pedestal
            row[...] = detector.convert(electrons[None])[0]
        return counts

    blocks = []
    for start, stop in zip([0, *stops], stops, strict=False):
        # include the lines around a block that blur into it
        window_start, window_end = max(start - reach, 0), min(stop + reach, number)
        window = cube[window_start:window_end].rechunk(-1)
        block = da.map_blocks(
            exposed,
            window,
            first=window_start,
            lines=range(start, stop),
            dtype=np.uint16,
            chunks=((stop - start,), *window.chunks[1:]),
            meta=np.empty((0, 0, 0), dtype=np.uint16),
        )
        blocks.append(block)
    dark = detector.dark
    if noise:  # the mean of frames has residual noise and rounding errors
        sd = np.sqrt((detector.read_noise**2 + 1.0 / 12.0) / _DARK_FRAMES)
        dark = np.asarray(dark + sd * np.random.default_rng([seed, _DARK]).standard_normal(dark.shape))
    variables = {
        "counts": xr.Variable(CUBE, da.concatenate(blocks), VARIABLES["counts"].attrs),
        "dark_counts": labelled_variable("dark_counts", dark),
        "radiance_gain": labelled_variable("radiance_gain", camera.radiance_gain()),
        "exposure_time": labelled_variable("exposure_time", exposure_time),
        "saturation_count": labelled_variable("saturation_count", detector.saturation_count),
        "electrons_per_count": labelled_variable("electrons_per_count", camera.electrons_per_count),
        "read_noise": labelled_variable("read_noise", camera.read_noise),
    }
    return xr.Dataset(variables)


#: Group of the traced scene.
TRANSPORT = "transport"

#: Prefix of the groups of renders.
RENDERS = "renders/"
_SETTINGS = {SETTINGS: f"numerics={NUMERICS_VERSION}"}

# lower bounds of the compressed size: hundreds of bytes for a pixel of a traced scene, two for a sample of a
# render
MIN_BYTES_PER_PIXEL, MIN_BYTES_PER_SAMPLE = 30, 1

#: Lines in a task on a cluster; tracing a line takes some tenths of a second.
CLUSTER_LINES = 64


@documented(overwrite="group overwrite", progress="stderr progress")
def render_scene(
    path: str | Path,
    out: str | Path,
    *,
    samples: int | None = None,
    to: Literal["radiance", "counts"] | None = None,
    atmospheres: Sequence[str] = (),
    library: str | Path | None = None,
    hold_edges: bool | None = None,
    scheduler: str | None = None,
    overwrite: bool = False,
    progress: bool = False,
) -> Path:
    """Render a scene into a Zarr store: cubes of hundreds of bands, with the truth of every pixel.

    The scene is traced once, without spectra, into the group ``transport``. From this group, each atmosphere
    gives a group ``renders/<name>``, a flight line: ``radiance``, or ``counts`` with all variables that
    calibrate them, and the irradiance of a spectrometer beside the scene, so that ``.paint.reflectance()``
    works. The group also has the truth of every pixel: material, instance, class, paint and car, with their
    names in ``flag_meanings`` or in the attributes; purity, shadow, the shares of sun, sky, glint and
    indirect light; and the reflectance without noise.

    All parts are built and checked before anything is written. The same call resumes an interrupted run, and
    does nothing for a finished store. A new atmosphere, paint or camera in the file needs no tracing, unless
    its sun has not been traced.

    Parameters
    ----------
    path
        A ``scene.toml``; see `hyperpaint.workflows.rendering`.
    out
        The store, a folder.
    samples
        Rays of a pixel; by default those of the file.
    to
        ``"radiance"`` or ``"counts"``; by default the product of the file.
    atmospheres
        Names of atmospheres of the file to render; all by default.
    library
        A paint library, such as signatures of a flight, in a format of `hyperpaint.write_library` or
        `hyperpaint.write_dirsig`. A paint with the name of a spectrum, material or instance of the scene
        replaces its spectrum; other paints are assigned in turn to the remaining cars; ``[paints]`` of the
        file takes precedence. The scene is not traced again.
    hold_edges
        Extend spectra by their first and last value, and interpolate bands without a value; by default as in
        the file, else over at most 25 nm at the ends, with a warning.
    scheduler
    overwrite
    progress

    Returns
    -------
    Path of the store.

    Raises
    ------
    FormatError
        The scene file, or one of its files, cannot be used; all problems are listed.
    SchemaError
        An argument is out of range, a name unknown, or spectra do not cover the bands or leave 0 to 1.
    StoreError
        The store holds other data, is being written by another process, or cannot be written; or memory or
        disk does not suffice, which is checked before anything is written.
    MissingExtraError
        A package is not installed that ``scheduler`` or a mesh needs.

    Examples
    --------
    >>> import tempfile, hyperpaint as hp
    >>> scene = Path(tempfile.mkdtemp(), "lawn.toml")
    >>> _ = scene.write_text('''[scene]
    ... kind = "plane"
    ... spectrum = "grass"
    ... [platform]
    ... lines = 2
    ... columns = 2
    ... ground_sample_m = 0.1
    ... altitude_m = 15.0
    ... ''')
    >>> path = render_scene(scene, scene.with_name("lawn.zarr"))
    >>> hp.open_store(path, "renders/noon").radiance.shape
    (2, 272, 2)
    """
    return run(
        path,
        out,
        samples=samples,
        to=to,
        atmospheres=atmospheres,
        library=library,
        hold_edges=hold_edges,
        scheduler=scheduler,
        overwrite=overwrite,
        progress=progress,
    ).path


def run(
    path: str | Path,
    out: str | Path,
    *,
    samples: int | None = None,
    to: Literal["radiance", "counts"] | None = None,
    atmospheres: Sequence[str] = (),
    library: str | Path | None = None,
    hold_edges: bool | None = None,
    scheduler: str | None = None,
    overwrite: bool = False,
    progress: bool = False,
) -> Outcome:
    # Render a scene, as `render_scene` does with the same arguments, and return the groups written.
    out = as_path(out)
    file, problems = read_scene_file(path), Problems("cannot render", SchemaError)
    if samples is not None:
        if SCHEMA["sampling"]["samples"].note(problems, as_argument("samples", samples), samples):
            samples = int(samples)  # a number of numpy would give another digest
        file = dataclasses.replace(file, sampling={**file.sampling, "samples": samples})
    if to is not None:
        SCHEMA["output"]["product"].note(problems, as_argument("to", to), to)
    problems.raise_if_any()
    changes: dict[str, Any] = {"product": to, "hold_edges": hold_edges}
    file = dataclasses.replace(file, **{name: value for name, value in changes.items() if value is not None})
    refuse_to_write_over(out, (file, library and as_path(library)), "render")
    # a rough check before the scene is built; `check_room` is exact
    folder = next(parent for parent in Path(out).absolute().parents if parent.exists())
    pixels = file.platform["lines"] * file.platform["columns"]
    min_bytes = pixels * (
        MIN_BYTES_PER_PIXEL + MIN_BYTES_PER_SAMPLE * file.camera.get("bands", SimulationSettings.bands)
    )
    free_bytes = shutil.disk_usage(folder).free if url_of(out) is None else min_bytes
    StoreError.raise_if(
        min_bytes > free_bytes,
        f"{file.path} needs at least {size_text(min_bytes)} of disk; {size_text(free_bytes)} are free in "
        f"{folder}",
        mend="reduce lines, columns or bands, or use another disk",
        code="disk-full",
    )
    parts = build_parts(file)
    if library is not None:
        # paints of the file take precedence over those of the library
        paints = by_name(read_paints(as_path(library)))
        file = dataclasses.replace(
            file, paints={**assigned_paints(SceneRecord.of(parts.scene), list(paints)), **file.paints}
        )
        parts = dataclasses.replace(parts, spectra={**paints, **parts.spectra})
    names = [light.name for light in chosen_atmospheres(parts, atmospheres)]
    with contextlib.ExitStack() as stack:
        client = stack.enter_context(computing_on(scheduler))
        stack.enter_context(errors_of_the_cluster(f"cannot render {path}"))
        traced = trace(
            parts.scene,
            parts.platform,
            parts.suns,
            **arguments_of(SCHEMA["sampling"], file.sampling),
            overcast=parts.overcast,
            chunk_lines=CHUNK_LINES if client is None else CLUSTER_LINES,
        )
        inputs = {
            "format": [FORMAT_VERSION, NUMERICS_VERSION],
            "scene": {**file.scene, "name": file.name},
            "meshes": [[digest_of_file(mesh.path), mesh.name, dict(mesh.options)] for mesh in file.meshes],
            "platform": dict(file.platform),
            "sampling": dict(file.sampling),
            "suns": parts.suns,
            "overcast": parts.overcast,
        }
        traced = traced.assign_coords(pose_of(parts.platform)).assign_attrs(
            {INPUTS: digest_of(inputs)[:32], **_SETTINGS}
        )
        planned = {TRANSPORT: traced, **_renders(traced, file, parts, names)}
        size = f"{file.platform['lines']} lines of {file.platform['columns']} columns"

        def pending_groups(pending: list[str]) -> dict[str, xr.Dataset]:
            # a new traced scene would not fit the renders that are kept
            stored = list_groups(out) if TRANSPORT in pending and out.exists() else []
            orphans = [name for name in stored if name.startswith(RENDERS) and name not in planned]
            StoreError.raise_if(
                orphans,
                f"{out} holds /{', /'.join(orphans)}, of a scene traced with other parameters",
                mend="render these atmospheres too, or choose another path",
                code="renders-outdated",
            )
            return {name: planned[name] for name in pending}

        def from_stored(name: str, turn: WholeRun) -> xr.Dataset:
            if name == TRANSPORT:
                return planned[name]
            turn.settle()
            return _renders(open_group(out, TRANSPORT), file, parts, [name.removeprefix(RENDERS)])[name]

        def announced(name: str) -> str:
            return (
                f"tracing {size}, {file.sampling['samples']} rays a pixel\n"
                if name == TRANSPORT
                else f"{name.removeprefix(RENDERS)}: {file.product} of {size}\n"
            )

        outcome = write_groups(
            out,
            planned,
            pending_groups,
            {"name": file.name, "scene_file": file.path.read_text(encoding="utf-8")},
            source=path,
            command="render",
            options={
                "--samples": samples,
                "--to": to,
                "--atmosphere": list(atmospheres),
                "--overwrite": overwrite,
                "--library": library and as_path(library).absolute(),
                "--hold-edges" if hold_edges else "--no-hold-edges": hold_edges is not None,
            },
            from_stored=from_stored,
            announce=announced if progress else None,
            overwrite=overwrite,
            client=client,
        )
    for name in outcome.written:
        picture = open_group(out, name).get("overview")
        if picture is not None and not picture.values.any():
            scene = parts.scene.bounds.tolist()
            camera = (np.round(parts.platform.position.mean(axis=0), 1) + 0.0).tolist()
            spans = ", ".join(f"{low:.4g} to {high:.4g}" for low, high in zip(*scene, strict=True))
            warn_user(
                f"{name} is black: no pixel sees a surface in light; the camera is about "
                f"{', '.join(map('{:.4g}'.format, camera))} m to east, north and up, the scene "
                f"spans {spans} m: check unit_m, up and offset_m of its meshes, and the flight",
                "ground-not-seen",
            )
    return outcome


# --- groups to write ---------------------------------------------------------------------------------------


def _renders(
    traced: xr.Dataset, file: SceneFile, parts: RenderParts, names: Sequence[str]
) -> dict[str, xr.Dataset]:
    renders = {}
    for atmosphere in parts.atmospheres:
        if atmosphere.name in names:
            light = hashlib.sha256()
            for field in dataclasses.fields(atmosphere):
                value = getattr(atmosphere, field.name)
                light.update(f"{field.name} ".encode())
                light.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
            inputs = {
                "transport": traced.attrs[INPUTS],
                "atmosphere": light.hexdigest(),
                "camera": dict(file.camera),
                "exposure_time": parts.platform.exposure_time,
                "spectra": spectra_digest(parts.spectra),
                "hold_edges": file.hold_edges,
                "paints": dict(file.paints),
                "product": [file.product, file.true_reflectance, file.sampling["seed"]],
            }
            renders[RENDERS + atmosphere.name] = flight_line(traced, atmosphere, file, parts).assign_attrs(
                {INPUTS: digest_of(inputs)[:32], **_SETTINGS}
            )
    return renders


_PICTURE_INCH, _DPI = 4.0, 150


def draw_renders(store: Path, groups: Sequence[str], path: Path) -> None:
    # Draw the stored overviews of renders (``groups`` of the store) side by side, north up.
    #
    # Raises `MissingExtraError` if matplotlib is not installed; `StoreError` if no group has an overview,
    # which needs three visible bands; `SchemaError` if matplotlib does not write this file type.
    datasets = {group: open_store(store, group) for group in groups}
    overviews = {group: dataset["overview"] for group, dataset in datasets.items() if "overview" in dataset}
    StoreError.raise_if(
        not overviews,
        f"{store} has no overview to draw, which needs three visible bands",
        code="overview-missing",
    )
    lines, columns = next(iter(overviews.values())).shape[:2]
    size = (_PICTURE_INCH * len(overviews), _PICTURE_INCH * min(lines / columns, 5.0) + 0.4)
    figure = new_figure("a picture", figsize=size, layout="constrained")
    for axes, (group, picture) in zip(
        figure.subplots(1, len(overviews), squeeze=False)[0], overviews.items(), strict=True
    ):
        # on a flight to the north the first line is in the south
        axes.imshow(picture.values, origin="lower", interpolation="nearest")
        axes.set_title(group.rpartition("/")[2].replace("_", " "))
        axes.set_axis_off()
    save_figure(figure, path, dpi=_DPI)


_GRID_NM = np.arange(380.0, 1051.0, 2.0)  # wavelengths on which built-in spectra are written


def export_dirsig_scene(
    scene_file: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    library: xr.Dataset | None = None,
    *,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
    **options: Any,
) -> xr.Dataset:
    r"""Write the scene of a ``scene.toml`` for DIRSIG.

    The materials cover the bands of the file's camera, to half a width. Where they are shorter, the file's
    ``hold_edges`` decides, as in a render: by default curves are held over up to 25 nm, with a warning.

    Parameters
    ----------
    scene_file
        A scene file of `hyperpaint.render_scene`; its ``[paints]`` repaint materials and cars.
    folder
        A folder, new or empty.
    library
        Measured paints, which take precedence over the file's ``[spectra]`` and over built-in spectra of the
        same name. Paints that are not named in the scene are assigned in turn to the cars without another
        repaint.
    overwrite, progress, **options
        As for `hyperpaint.io.dirsig.write_dirsig_scene`.

    Returns
    -------
    Dataset
        The written materials, as returned by `hyperpaint.io.dirsig.write_dirsig_scene`.

    Raises
    ------
    FormatError, SchemaError, StoreError
        As `hyperpaint.render_scene` and `hyperpaint.io.dirsig.write_dirsig_scene`; a material does not cover
        the bands of the camera.

    Warns
    -----
    PaintWarning
        Materials are held constant at the ends of the camera's bands.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder, "lawn.toml")
    ...     text = '[scene]\nkind = "plane"\nspectrum = "grass"\n[platform]\nlines = 2\ncolumns = 2\n'
    ...     _ = path.write_text(text + "ground_sample_m = 0.1\naltitude_m = 15.0\n")
    ...     export_dirsig_scene(path, Path(folder, "out")).material_id.values.tolist()
    ['grass']
    """
    file = read_scene_file(as_path(scene_file))
    parts = build_parts(file)
    repaint = dict(file.paints)
    libraries = [] if library is None else [library]
    if library is not None:
        repaint = painted_cars(parts.scene, list(map(str, library["signature"].values)), repaint)
    flakes = {
        material.spectrum: material.flakes
        for material in parts.scene.materials
        if material.flakes is not None
    }
    names = [material.spectrum for material in parts.scene.materials] + list(repaint.values())
    spectra: dict[str, Floats] = {}
    for name in dict.fromkeys(names):
        file_spectrum: Any = parts.spectra.get(name)
        if file_spectrum is not None and not hasattr(file_spectrum, "data_vars"):
            wavelength, values = file_spectrum
            spectra[name] = np.interp(_GRID_NM, wavelength, values, left=np.nan, right=np.nan)
            continue
        try:
            body = spectrum_of(name)(_GRID_NM)
        except SchemaError:
            continue  # a paint of the library; the writer reports unknown names
        flake = flakes.get(name)
        if flake is not None:
            body = (1.0 - flake.share) * body + flake.share * spectrum_of(flake.spectrum)(_GRID_NM)
        spectra[name] = body
    reflectance = np.array(list(spectra.values()), np.float32).reshape(-1, len(_GRID_NM))
    libraries += [
        *named_libraries(parts.spectra),
        xr.Dataset(
            {
                "reflectance": (
                    ("signature", "band"),
                    reflectance,
                    {"units": "1", "mirror_reflection": EXCLUDED},
                )
            },
            {
                "signature": np.array(list(spectra), object),
                "wavelength": ("band", _GRID_NM, {"units": "nm"}),
            },
        ),
    ]
    bands = BandSet.of(parts.camera.imager)
    half = 0.5 * np.broadcast_to(bands.fwhm, bands.wavelength.shape)
    wavelengths = float((bands.wavelength - half).min()), float((bands.wavelength + half).max())
    options = {
        "wavelength_range": wavelengths,
        "extrapolate": HELD_NM if file.hold_edges is None else file.hold_edges,
        **options,
    }
    summary = write_dirsig_scene(
        parts.scene,
        folder,
        libraries,
        repaint=repaint,
        origin=ORIGIN,
        overwrite=overwrite,
        progress=progress,
        **options,
    )
    held = summary["signature"].values[summary["extrapolated"].values != ""].tolist()
    if held and options["extrapolate"] is not True:
        low, high = options["wavelength_range"]
        warn_user(
            f"{len(held)} materials do not cover {low:g} to {high:g} nm, the range of the bands, and are "
            f"held constant at its ends: {', '.join(map(str, held[:4]))}",
            "edge-bands-held",
        )
    return summary


def painted_cars(scene: Any, names: Sequence[str], repaint: Mapping[str, str]) -> dict[str, str]:
    """Return new paints by instance: ``repaint``, and other ``names`` in turn for cars without a repaint.

    Examples
    --------
    >>> from hyperpaint.simulation.rendering.car_parks import car_park
    >>> scene = car_park(length=5.0, width=16.0, neighbours=(), seed=1)
    >>> [instance.paint for instance in scene.instances if instance.kind == "car"]
    ['light_blue', 'dark_red', 'yellow', 'white']
    >>> painted_cars(scene, ["yellow", "roof 7", "roof 8"], {"car_000": "roof 8"})
    {'car_000': 'roof 8', 'car_001': 'roof 7', 'car_003': 'roof 7'}
    """
    scene_names = {
        *(item.name for item in (*scene.materials, *scene.instances)),
        *(item.spectrum for item in scene.materials),
        *repaint.values(),
    }
    new_paints = [name for name in names if name not in scene_names]
    cars = [
        item.name
        for item in scene.instances
        if item.kind == "car" and item.name not in repaint and not {item.paint} & {*names, *repaint}
    ]
    return {
        **repaint,
        **{car: new_paints[number % len(new_paints)] for number, car in enumerate(cars) if new_paints},
    }


def named_libraries(spectra: Mapping[str, Any]) -> list[xr.Dataset]:
    # Return the paint libraries among spectra; paints are "<key>/<name>", a single paint also "<key>".
    return [
        value.assign_coords(signature=names)
        for key, value in spectra.items()
        if hasattr(value, "data_vars")
        for names in ([f"{key}/{name}" for name in value["signature"].values], [key])
        if len(names) == value.sizes["signature"]
    ]
