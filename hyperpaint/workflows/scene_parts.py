"""Scene, flight, light and camera of a scene file."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from hyperpaint.base.errors import FormatError, PaintError, Problems, SchemaError
from hyperpaint.base.facts import arguments_of, filled
from hyperpaint.io.spectrometers.irradiance import open_irradiance
from hyperpaint.simulation.camera import Camera
from hyperpaint.simulation.rendering.appearance import coat_of_gloss
from hyperpaint.simulation.rendering.car_parks import car_park
from hyperpaint.simulation.rendering.four_curves import Atmosphere, preset_atmosphere
from hyperpaint.simulation.rendering.materials import Coat, Flakes, Material
from hyperpaint.simulation.rendering.mesh_files import read_mesh
from hyperpaint.simulation.rendering.platforms import Platform, pushbroom
from hyperpaint.simulation.rendering.scene import Instance, Scene, plane
from hyperpaint.simulation.settings import SimulationSettings

from .render_libraries import read_spectra
from .scene_files import (
    COAT,
    MATERIAL,
    SCHEMA,
    AtmosphereEntry,
    MeshEntry,
    SceneFile,
    camera_fields,
    park_arguments,
)


@dataclass(frozen=True)
class RenderParts:
    """All parts of a render."""

    scene: Scene
    platform: Platform
    camera: Camera
    noise: bool  #: Whether the camera has noise.
    atmospheres: tuple[Atmosphere, ...]  #: Atmospheres of the file; all their suns are traced.
    spectra: Mapping[str, Any]  #: Spectra of the file: (wavelength [nm], reflectance), or a paint library.

    @property
    def suns(self) -> list[tuple[float, float]]:
        """Zenith and azimuth of every distinct sun [degree]."""
        return list(dict.fromkeys((light.sun_zenith, light.sun_azimuth) for light in self.atmospheres))

    @property
    def overcast(self) -> bool:
        """Whether an atmosphere has an overcast sky, brighter towards the zenith."""
        return any(light.overcast_share > 0.0 for light in self.atmospheres)


def build_parts(file: SceneFile) -> RenderParts:
    """Return the parts that a scene file describes.

    Raises `FormatError` if the file, or one of its files, cannot be used; all problems are listed. Raises
    `MissingExtraError` if a mesh needs a package that is not installed.
    """
    problems = Problems(f"{file.path} cannot be rendered", FormatError)
    parts: dict[str, Any] = {}
    # build every part, so that all problems are listed
    builders: dict[str, tuple[str, Callable[[], Any]]] = {
        "scene": ("[scene]", lambda: _scene(file)),
        "camera": ("[camera]", lambda: _camera(file)),
        "atmospheres": ("[[atmospheres]]", lambda: _atmospheres(file)),
        "spectra": ("[spectra]", lambda: _spectra(file)),
        "platform": ("[platform]", lambda: _platform(file, parts.get("scene"))),
    }
    for name, (table, build) in builders.items():
        try:
            parts[name] = build()
        except ImportError:
            raise
        except (PaintError, OSError) as error:
            problems.add_error(table, error)
    problems.raise_if_any()
    return RenderParts(**parts, noise=file.camera.get("noise", True))


def chosen_atmospheres(parts: RenderParts, names: Sequence[str]) -> tuple[Atmosphere, ...]:
    """Return the atmospheres with these names, by default all; `SchemaError` for an unknown name."""
    by_name = {light.name: light for light in parts.atmospheres}
    unknown = [name for name in names if name not in by_name]
    if unknown:
        raise SchemaError(
            f"there is no atmosphere {', '.join(map(repr, unknown))} in the scene file",
            expected=f"some of {', '.join(by_name)}",
            code="choice-unknown",
        )
    return tuple(by_name[name] for name in dict.fromkeys(names)) if names else parts.atmospheres


# --- the scene ---------------------------------------------------------------------------------------------


def _scene(file: SceneFile) -> Scene:
    builders = {"car_park": _car_park, "plane": _plane}
    kind = file.scene["kind"]
    parts = [builders[kind](file)] if kind in builders else []
    parts += [_mesh(entry) for entry in file.meshes]
    return replace(parts[0], name=file.name) if len(parts) == 1 else Scene.join(parts, file.name)


def _car_park(file: SceneFile) -> Scene:
    options = park_arguments(file.scene)
    if not file.scene.get("coat", True):
        return car_park(**options, coat=None)
    return car_park(**options, coat=_coat(file.scene) or "own")


def _plane(file: SceneFile) -> Scene:
    facts = SCHEMA["scene"]
    ground = arguments_of(facts, filled(facts, file.scene))
    kind = "asphalt" if ground["spectrum"] == "asphalt" else "other"
    return plane(ground["size_m"], Material("ground", ground["spectrum"], kind))


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


def _camera(file: SceneFile) -> Camera:
    return Camera.of(SimulationSettings.of(camera_fields(file.platform, file.camera)))


# --- light -------------------------------------------------------------------------------------------------


def _atmospheres(file: SceneFile) -> tuple[Atmosphere, ...]:
    problems = Problems("the atmospheres cannot be used", SchemaError)
    atmospheres = []
    for entry in file.atmospheres:
        try:
            atmospheres.append(_atmosphere(entry))
        except (PaintError, OSError) as error:
            problems.add_error(entry.name, error)
    problems.raise_if_any()
    return tuple(atmospheres)


def _atmosphere(entry: AtmosphereEntry) -> Atmosphere:
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
    if oktas:
        atmosphere = atmosphere.clouded(oktas)
    return replace(atmosphere, name=entry.name)


def _spectra(file: SceneFile) -> dict[str, Any]:
    problems = Problems("spectra cannot be read", FormatError)
    spectra: dict[str, Any] = {}
    for name, path in file.spectra.items():
        try:
            value = read_spectra(path)
        except PaintError as error:
            problems.add_error(name, error)
            continue
        if isinstance(value, dict):  # paints on different wavelengths
            is_single = len(value) == 1
            spectra |= {name if is_single else f"{name}/{paint}": curve for paint, curve in value.items()}
        else:
            spectra[name] = value
    problems.raise_if_any()
    return spectra
