"""What a ``scene.toml`` says: read, checked, and its files found, before anything is built."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

from hyperpaint.base.errors import FormatError, Problems
from hyperpaint.io.files.toml_tables import (
    Check,
    TableReader,
    flag,
    load_tables,
    number,
    one_of,
    positive,
    shown,
    text,
    texts,
    time,
    whole,
)
from hyperpaint.simulation.rendering.materials import KINDS
from hyperpaint.simulation.rendering.scene import INSTANCE_KINDS
from hyperpaint.simulation.settings import FLEETS, MOST_SAMPLES

SCENE_KINDS = ("car_park", "plane", "empty")
"""Scenes that are made; any of them may hold meshes as well."""


def _between(lowest: float, highest: float) -> Check:
    def check(value: Any) -> str | None:
        good = number(value) is None and lowest <= value <= highest
        return None if good else f"a number from {lowest:g} to {highest:g}"

    return check


def _numbers(length: int) -> Check:
    def check(value: Any) -> str | None:
        good = isinstance(value, list) and len(value) == length and all(number(one) is None for one in value)
        return None if good else f"a list of {length} numbers"

    return check


def _kernel(value: Any) -> str | None:
    good = isinstance(value, list) and all(isinstance(row, list) for row in value)
    return None if good else "a list of rows, each a list of numbers"


def _number_or(length: int) -> Check:
    several = _numbers(length)

    def check(value: Any) -> str | None:
        good = number(value) is None or several(value) is None
        return None if good else f"a number or {several(value)}"

    return check


def _words(value: Any) -> str | None:
    """Expect a list of texts, which may be empty."""
    good = isinstance(value, list) and all(text(one) is None for one in value)
    return None if good else "a list of texts"


_share = _between(0.0, 1.0)

MATERIAL: Mapping[str, Check] = {
    "spectrum": text, "class": one_of(*KINDS), "coat_index": _between(1.0, 3.0), "coat_roughness": _share,
    "coat_gloss": _between(1.0, 100.0), "coat_waviness_deg": _between(0.0, 5.0), "flakes": _share,
}  # fmt: skip
"""What a material of a mesh may say of itself."""


def _materials(value: Any) -> str | None:
    """Expect a table of spectra, or of tables of `MATERIAL`."""
    if not isinstance(value, dict):
        return "a table: name of a part = spectrum"
    for name, one in value.items():
        table = {"spectrum": one} if isinstance(one, str) else one
        if not isinstance(table, dict) or "spectrum" not in table:
            return f"for {name!r:.40} a spectrum, or a table with spectrum"
        for key, entry in table.items():
            unknown = f"none of that name; known are {', '.join(MATERIAL)}"
            wrong = MATERIAL[key](entry) if key in MATERIAL else unknown
            if wrong is not None:
                return f"for {name!r:.40}.{key:.40} {wrong}"
    return None


_seed = whole(0, 2**63 - 1)

SCHEMA: Mapping[str, Mapping[str, Check]] = {
    "scene": {
        "name": text,
        "kind": one_of(*SCENE_KINDS),
        "seed": _seed,
        # of a plane
        "size_m": _number_or(2),
        "spectrum": text,
        # of a car park
        "length_m": _between(1.0, 2000.0),
        "width_m": _between(1.0, 500.0),
        "rows": whole(1, 100),
        "occupancy": _share,
        "paints": _words,
        "fleet": one_of(*FLEETS),
        "types": _words,
        "neighbours": _words,
        "panels": flag,
        "islands": flag,
        "coat": flag,
        "coat_index": _between(1.0, 3.0),
        "coat_roughness": _share,
        "coat_gloss": _between(1.0, 100.0),
        "coat_waviness_deg": _between(0.0, 5.0),
        "line_width_m": _between(0.02, 1.0),
        "leaves": whole(0, 100_000),
        "margin_m": _between(0.0, 10_000.0),
    },
    "meshes": {
        "path": text, "name": text, "kind": one_of(*INSTANCE_KINDS), **MATERIAL, "materials": _materials,
        "offset_m": _numbers(3), "heading_deg": _between(-360.0, 360.0), "unit_m": positive,
        "up": one_of("x", "y", "z"),
    },
    "platform": {
        "lines": whole(1, 1_000_000), "columns": whole(1, 20_000), "altitude_m": positive,
        "ground_sample_m": positive, "ifov_mrad": positive, "speed_m_s": positive, "line_spacing_m": positive,
        "centre_m": _numbers(2), "start_m": _numbers(2), "heading_deg": _between(-360.0, 360.0),
        "exposure_time_ms": _between(0.0, 3.6e6), "frame_period_ms": positive, "wobble_deg": _number_or(3),
        "sway_m": _between(0.0, 100.0), "start_time": time, "seed": _seed,
    },
    "camera": {
        "bands": whole(2, 10_000), "first_wavelength_nm": positive, "last_wavelength_nm": positive,
        "dispersion_bow_nm": number, "fwhm_nm": positive, "fwhm_slope": number,
        "srf_shape": one_of("gaussian", "slit"), "smile_nm": number, "bit_depth": whole(1, 16),
        "electrons_per_count": positive, "read_noise": number, "dark_level": number, "dark_pattern": number,
        "dark_rate": number, "dark_frames": whole(1, 100_000), "nonuniformity": number,
        "column_nonuniformity": number, "bad_elements": whole(0, 2**40), "noise": flag, "seed": _seed,
        "psf_across_columns": number, "psf_along_lines": number, "psf_kernel": _kernel,
        "keystone_columns": number, "stray_light": number, "pedestal": number,
        "masked_columns": whole(0, 10_000),
    },
    "atmospheres": {
        "name": text, "preset": text, "table": text, "irradiance": texts, "time": time,
        "direct_fraction": _share, "sun_zenith_deg": _between(0.0, 89.0),
        "sun_azimuth_deg": _between(-360.0, 360.0), "aerosol": _between(0.0, 10.0),
        "water": _between(0.0, 100.0), "oktas": _between(0.0, 8.0), "overcast_share": _share,
    },
    "sampling": {
        "samples": whole(1, MOST_SAMPLES), "depth": whole(1, 16), "slots": whole(1, 1024), "seed": _seed,
        "sun_radius_deg": _between(0.0, 5.0),
    },
    "spectra": {},
    "paints": {},
    "output": {"product": one_of("radiance", "counts"), "true_reflectance": flag, "hold_edges": flag},
}  # fmt: skip
"""Check of every key of every table; the keys of `NAMED` are names."""

NAMED = ("spectra", "paints")
"""Tables whose keys are names of the user's, each with a text."""

LISTS = ("meshes", "atmospheres")
"""Tables that may be there several times."""


_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
_RESERVED = {"zarr.json", "c"}
#: Where the light of an atmosphere comes from: one of these keys.
_SOURCES = ("preset", "table", "irradiance")
_MOST_TRIANGLES = 5_000_000  # of a car park: some 2000 cars and their trees
_MOST_VALUES = 10**11  # of a cube; a day's flying has a hundredth


@dataclass(frozen=True)
class MeshEntry:
    """One ``[[meshes]]``: a file, and how it is put into the scene."""

    path: Path
    name: str
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class AtmosphereEntry:
    """One ``[[atmospheres]]``: its name, where its light comes from, and what is changed of it."""

    name: str
    preset: str | None = None
    table: Path | None = None
    irradiance: tuple[Path, ...] = ()
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Sampling:
    """``[sampling]``: rays of a pixel, scatterings of a ray, paths kept of a pixel, the seed of it all."""

    samples: int = 64
    depth: int = 4
    slots: int | None = None
    seed: int = 0
    sun_radius_deg: float = 0.267


@dataclass(frozen=True)
class SceneFile:
    """What a ``scene.toml`` says, its paths absolute and found."""

    path: Path
    name: str
    scene: Mapping[str, Any]  #: ``[scene]``: its ``kind`` and what that kind takes.
    meshes: tuple[MeshEntry, ...]
    platform: Mapping[str, Any]  #: Arguments of `hyperpaint.simulation.rendering.platforms.pushbroom`.
    camera: Mapping[str, Any]  #: Fields of `hyperpaint.simulation.SimulationSettings`.
    atmospheres: tuple[AtmosphereEntry, ...]  #: At least one.
    sampling: Sampling
    spectra: Mapping[str, Path]
    paints: Mapping[str, str]  #: Name of a spectrum, material or instance to that of its new spectrum.
    product: str = "radiance"
    true_reflectance: bool = True  #: Whether the reflectance without noise is stored as well.
    hold_edges: bool = False  #: Whether spectra go on where they end, and over bands without values.


def example_scene() -> str:
    """Return a commented ``scene.toml`` to begin with."""
    return resources.files(__package__).joinpath("example_scene.toml").read_text(encoding="utf-8")


def read_scene_file(path: str | os.PathLike[str]) -> SceneFile:
    """Read and check a ``scene.toml``; what it names is looked for from its folder, not opened.

    Raises `FormatError`: not TOML (with the line), unknown keys, wrong types or values, what is missing or
    not found; all problems are listed.
    """
    path = Path(path)
    raw = load_tables(path, "a scene.toml")
    problems = Problems(f"{path} cannot be rendered", FormatError)
    named = {name: dict.fromkeys(raw[name], text) for name in NAMED if isinstance(raw.get(name), dict)}
    reader = TableReader(path, raw, {**SCHEMA, **named}, LISTS, problems)
    meshes = _meshes(reader)
    scene_file = SceneFile(
        path=path, name=reader.one("scene").get("name", path.stem), scene=_scene(reader), meshes=meshes,
        platform=_platform(reader), camera=_camera(reader), atmospheres=_atmospheres(reader),
        sampling=Sampling(**_given(reader.one("sampling"))), spectra=_spectra(reader),
        paints=_given(reader.one("paints")), **_given(reader.one("output")),
    )  # fmt: skip
    _check_size(scene_file, problems)
    problems.raise_if_any()
    return scene_file


def _given(table: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in table.items() if key != "?"}


#: Keys of [scene] that one kind of scene alone takes.
_OF_KIND = {
    "plane": {"size_m", "spectrum"},
    "car_park": set(SCHEMA["scene"]) - {"name", "kind", "size_m", "spectrum"},
    "empty": set(),
}


def _scene(reader: TableReader) -> dict[str, Any]:
    table = reader.one("scene")
    kind = table.get("kind", "car_park")
    if "scene" not in reader.given and "meshes" not in reader.given:
        reader.problems.add("no [scene] and no [[meshes]]: there is nothing to be seen")
    elif kind == "empty" and not reader.tables["meshes"]:
        reader.problems.add('[scene] kind = "empty" without [[meshes]]: there is nothing to be seen')
    allowed = _OF_KIND[kind] | {"name", "kind", "seed"}
    for key in sorted(table["?"] & set(SCHEMA["scene"]) - allowed):
        where = ", ".join(each for each, keys in _OF_KIND.items() if key in keys)
        reader.problems.add(f"[scene] {key} is for kind {where}, found kind = {kind!r}")
    if "scene" not in reader.given:
        kind = "empty"
    return {**{key: value for key, value in _given(table).items() if key != "name"}, "kind": kind}


def _meshes(reader: TableReader) -> tuple[MeshEntry, ...]:
    entries, names = [], []
    for row, table in enumerate(reader.tables["meshes"]):
        place = reader.place("meshes", row)
        if "path" not in table["?"]:
            reader.problems.add(f"{place} path is missing: the file with its triangles")
        if not table["?"] & {"spectrum", "materials"}:
            reader.problems.add(
                f"{place} spectrum is missing: what it is made of (or materials, part by part)"
            )
        path = reader.path(place, "path", table.get("path"))
        name = table.get("name", f"mesh_{row + 1}")
        if name in names:
            reader.problems.add(f"{place} name = {name!r} is given to another mesh; each needs its own")
        names.append(name)
        if path is not None:
            options = {key: value for key, value in _given(table).items() if key not in ("path", "name")}
            entries.append(MeshEntry(path, name, options))
    return tuple(entries)


#: Keys of [platform] with a unit, to arguments of `pushbroom` and what they are multiplied by.
_PLATFORM = {
    "altitude_m": ("altitude", 1.0), "ground_sample_m": ("ground_sample", 1.0), "ifov_mrad": ("ifov", 1e-3),
    "speed_m_s": ("speed", 1.0), "line_spacing_m": ("line_spacing", 1.0), "heading_deg": ("heading", 1.0),
    "exposure_time_ms": ("exposure_time", 1e-3), "frame_period_ms": ("frame_period", 1e-3),
    "sway_m": ("sway", 1.0),
}  # fmt: skip


def _platform(reader: TableReader) -> dict[str, Any]:
    table = reader.one("platform")
    for key in ("lines", "columns"):
        if key not in table["?"]:
            reader.problems.add(f"[platform] {key} is missing: the size of the cube")
    arguments: dict[str, Any] = {}
    for key, value in _given(table).items():
        if key in _PLATFORM:
            name, factor = _PLATFORM[key]
            arguments[name] = float(f"{value * factor:.12g}")
        elif key in ("centre_m", "start_m"):
            arguments[key.removesuffix("_m")] = tuple(map(float, value))
        elif key == "wobble_deg":
            arguments["wobble"] = tuple(map(float, value)) if isinstance(value, list) else float(value)
        else:
            arguments[key] = value
    if "start_time" in arguments:
        # TOML's own times become text that numpy reads; a zone is not taken
        arguments["start_time"] = str(arguments["start_time"]).replace(" ", "T")
    return arguments


def _camera(reader: TableReader) -> dict[str, Any]:
    same = {"first_wavelength_nm": "first_wavelength", "last_wavelength_nm": "last_wavelength"}
    return {same.get(key, key): value for key, value in _given(reader.one("camera")).items()}


def _atmospheres(reader: TableReader) -> tuple[AtmosphereEntry, ...]:
    if not reader.tables["atmospheres"] and "atmospheres" not in reader.given:
        return (AtmosphereEntry("noon", "noon"),)
    entries = []
    for row, table in enumerate(reader.tables["atmospheres"]):
        entry = _atmosphere(reader, reader.place("atmospheres", row), table)
        if entry is not None:
            entries.append(entry)
    names = [entry.name.lower() for entry in entries]
    for name in sorted({name for name in names if names.count(name) > 1}):
        reader.problems.add(
            f"[[atmospheres]] name {name!r} is given to {names.count(name)}; each needs its own"
        )
    return tuple(entries)


def _atmosphere(reader: TableReader, place: str, table: Mapping[str, Any]) -> AtmosphereEntry | None:
    sources = [key for key in _SOURCES if key in table["?"]]
    if len(sources) > 1:
        reader.problems.add(f"{place} has {' and '.join(sources)}; keep the one that is to be used")
    name = table.get("name", table.get("preset"))
    if name is None:
        if "name" not in table["?"]:
            reader.problems.add(f"{place} name is missing: it names a group of the store")
        return None
    if not _NAME.fullmatch(name) or name in _RESERVED:
        expected = "letters, digits, '.', '_' and '-': it names a group of the store"
        reader.problems.add(f"{place} name = {shown(name)}, expected {expected}")
    if sources and sources[0] != "preset" and "sun_zenith_deg" not in table["?"]:
        reader.problems.add(f"{place} sun_zenith_deg is missing: {sources[0]} does not say where the sun is")
    for key in ("direct_fraction", "time"):
        if key in table["?"] and sources != ["irradiance"]:
            reader.problems.add(f"{place} {key} needs irradiance, the files of a spectrometer")
    files = reader.files(place, "irradiance", table["irradiance"]) if "irradiance" in table else ()
    skipped = {"?", "name", *_SOURCES}
    options = {key: value for key, value in table.items() if key not in skipped}
    preset = table.get("preset", None if sources else name)
    return AtmosphereEntry(name, preset, reader.path(place, "table", table.get("table")), files, options)


def _spectra(reader: TableReader) -> dict[str, Path]:
    paths = {
        name: reader.path("[spectra]", name, value) for name, value in _given(reader.one("spectra")).items()
    }
    return {name: path for name, path in paths.items() if path is not None}


def _check_size(scene_file: SceneFile, problems: Problems) -> None:
    if scene_file.scene["kind"] == "car_park":
        triangles = _triangles(scene_file.scene)
        if triangles > _MOST_TRIANGLES:
            problems.add(
                f"[scene] would have some {triangles:.1e} triangles, expected at most {_MOST_TRIANGLES:.0e}; "
                "make it shorter or narrower, or give its trees fewer leaves"
            )
    lines, columns = (scene_file.platform.get(key, 1) for key in ("lines", "columns"))
    bands = scene_file.camera.get("bands", 272)
    if lines * columns * bands > _MOST_VALUES:
        problems.add(
            f"{lines} lines x {columns} columns x {bands} bands are {lines * columns * bands:.1e} samples, "
            f"expected at most {_MOST_VALUES:.0e}; cut the flight into several"
        )


def _triangles(scene: Mapping[str, Any]) -> float:
    """Return about how many triangles a car park has: 1300 a car, two a leaf."""
    length, width = scene.get("length_m", 50.0), scene.get("width_m", 32.0)
    bays = length / 2.5 * scene.get("rows", width / 8.0)
    trees = length / 7.5 + bays / 10.0 if "trees" in scene.get("neighbours", ["trees"]) else 0.0
    return float(1300.0 * bays * scene.get("occupancy", 0.85) + 2.0 * trees * scene.get("leaves", 1500))
