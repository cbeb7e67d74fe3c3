"""Scene files: a ``scene.toml`` read and checked, its files located, and its parts built."""

import contextlib
import dataclasses
import hashlib
import json
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from hyperpaint.base.errors import FormatError, PaintError, Problem, Problems, SchemaError
from hyperpaint.base.facts import (
    Fact,
    Facts,
    Spelling,
    arguments_of,
    as_argument,
    by_key,
    fact,
    facts_of,
    filled,
    shown,
)
from hyperpaint.base.input_files import input_path, read_limited
from hyperpaint.io.dirsig.dirsig_files import read_materials
from hyperpaint.io.files.toml_tables import TableReader, load_tables, values
from hyperpaint.io.library import open_library
from hyperpaint.io.spectrometers.irradiance import open_irradiance
from hyperpaint.io.spectrometers.spectrum_csv import read_spectrum_csv
from hyperpaint.simulation.atmosphere import SKY
from hyperpaint.simulation.camera import Camera
from hyperpaint.simulation.rendering.car_parks import BAY, CAR_PARK, car_park, note_car_park_faults
from hyperpaint.simulation.rendering.four_curves import PRESETS, Atmosphere, preset_atmosphere
from hyperpaint.simulation.rendering.materials import KINDS, Coat, Flakes, Material, coat_of_gloss
from hyperpaint.simulation.rendering.mesh_files import read_mesh
from hyperpaint.simulation.rendering.platforms import PUSHBROOM, Platform, note_pushbroom_faults, pushbroom
from hyperpaint.simulation.rendering.relighting import PAINT_VARIABLES
from hyperpaint.simulation.rendering.scene import INSTANCE_KINDS, Instance, Scene, plane
from hyperpaint.simulation.rendering.scene_record import TraceSettings
from hyperpaint.simulation.settings import CAMERA_FIELDS, SimulationSettings
from hyperpaint.simulation.transport.path_codes import MAX_SUNS

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
    path = Path(path)
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
    scene_file = SceneFile(
        path=path, name=reader.one("scene").get("name", path.stem), scene=_scene(reader),
        meshes=_meshes(reader), platform=platform, camera=camera, atmospheres=_atmospheres(reader),
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
    problems.add_if(
        lines * columns * bands > _MAX_VALUES,
        f"{lines} lines x {columns} columns x {bands} bands are {lines * columns * bands:.1e} samples",
        expected=f"at most {_MAX_VALUES:.0e}",
        mend="cut the flight into several",
        code="cube-too-large",
    )
    problems.raise_if_any()
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


def _meshes(reader: TableReader) -> tuple[MeshEntry, ...]:
    entries, names = [], []
    for row, table in enumerate(reader.tables["meshes"]):
        place, name = reader.place("meshes", row), table.get("name", f"mesh_{row + 1}")
        for is_missing, key, mend in (
            ("path" not in table["?"], "path", "name the file of its triangles"),
            (
                not table["?"] & {"spectrum", "materials"},
                "spectrum",
                "name a spectrum, or materials, part by part",
            ),
        ):
            reader.problems.add_if(is_missing, f"{place} {key} is missing", mend=mend, code="key-missing")
        for part, material in table.get("materials", {}).items():
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
            for key, value in surface.items():
                if key in MATERIAL:
                    found = f"{where}.{key} = {shown(value)}"
                    MATERIAL[key].note(reader.problems, found, value, MATERIAL[key].mend)
                else:
                    found = f"{where} unknown key {key[:40]!r}"
                    reader.problems.add(found, mend=f"known are {', '.join(MATERIAL)}", code="key-unknown")
        path = reader.path(place, "path", table.get("path"))
        reader.problems.add_if(
            name in names,
            f"{place} name = {name!r} is the name of another mesh",
            mend="give each its own name",
            code="name-duplicate",
        )
        names.append(name)
        if path is not None:
            options = {key: value for key, value in values(table).items() if key not in ("path", "name")}
            entries.append(MeshEntry(path, name, options))
    return tuple(entries)


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
            entry = None
        else:
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
            entry = AtmosphereEntry(
                name, preset, reader.path(place, "table", table.get("table")), files, options
            )
        if entry is not None:
            entries.append(entry)
    names = [entry.name.lower() for entry in entries]
    for name in sorted({name for name in names if names.count(name) > 1}):
        reader.problems.add(
            f"[[atmospheres]] name {name!r} is given to {names.count(name)}",
            mend="give each its own name",
            code="name-duplicate",
        )
    suns = set()
    for entry in entries:
        zenith, azimuth = PRESETS.get(entry.preset or "", PRESETS["noon"])
        suns.add((entry.options.get("sun_zenith", zenith), entry.options.get("sun_azimuth", azimuth)))
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
    if input_path(path, "spectra").is_file() and path.suffix.lower() in _TABLE_SUFFIXES:
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
    if path.is_dir() and (path / _DIRSIG_MARKER).is_file() and (path / _MATERIALS).is_file():
        return _dirsig_paints(path / _MATERIALS)
    return open_library(path)


def _dirsig_paints(path: Path) -> dict[str, xr.Dataset]:

    records: dict[str, dict[str, Any]] = {}  # by material id; empty for material lists of other programs
    with contextlib.suppress(FormatError, OSError, ValueError, TypeError, KeyError):
        document = json.loads(read_limited(path.parent / _DIRSIG_MARKER, MAX_EXPORT_BYTES, "an export"))
        records = {str(record["id"]): dict(record) for record in document["paints"]}
    problems = Problems(f"{path} cannot be rendered", FormatError)
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
            centre = path.parent / str(record.get("reflectance_file", file))
            if centre.is_file():  # an emissivity file of many curves lacks the centre of the paint
                curve = open_library(centre)
                nm, centre_nm = paint["wavelength"].values, curve["wavelength"].values
                if nm.shape == centre_nm.shape and np.allclose(nm, centre_nm, rtol=0.0, atol=1e-3):
                    values = curve["reflectance"].values
                    paint = paint.assign(reflectance=(paint["reflectance"].dims, values, {"units": "1"}))
            paints[str(record.get("paint", material.name))] = paint
    problems.raise_if_any()
    return paints


def spectra_digest(spectra: Mapping[str, Any]) -> str:
    # Return a digest of all values of spectra, which shows whether a render was made from them.
    digest = hashlib.sha256()
    for name, value in spectra.items():
        digest.update(f"{name} ".encode())
        if isinstance(value, Mapping) and not hasattr(value, "data_vars"):
            digest.update(spectra_digest(value).encode())
        elif hasattr(value, "data_vars"):
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
            atmosphere = Atmosphere.from_table(entry.table, **options)
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
