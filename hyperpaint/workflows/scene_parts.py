"""What a ``scene.toml`` describes, built: scene, flight, light, camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from hyperpaint.base.errors import FormatError, PaintError, Problems, SchemaError

from .render_libraries import read_spectra
from .scene_files import MATERIAL

if TYPE_CHECKING:
    from hyperpaint.simulation.camera import Camera
    from hyperpaint.simulation.rendering.four_curves import Atmosphere
    from hyperpaint.simulation.rendering.materials import Coat, Material
    from hyperpaint.simulation.rendering.platform_geometry import Platform
    from hyperpaint.simulation.rendering.scene import Scene

    from .scene_files import AtmosphereEntry, MeshEntry, SceneFile


@dataclass(frozen=True)
class Parts:
    """Everything that a render is made of."""

    scene: Scene
    platform: Platform
    camera: Camera
    noise: bool  #: Whether the camera has any.
    atmospheres: tuple[Atmosphere, ...]  #: All of them are traced.
    spectra: Mapping[str, Any]  #: Those of the file: (wavelength [nm], reflectance), or a paint library.

    @property
    def suns(self) -> list[tuple[float, float]]:
        """Zenith and azimuth of every sun, each once [degree]."""
        return list(dict.fromkeys((each.sun_zenith, each.sun_azimuth) for each in self.atmospheres))

    @property
    def overcast(self) -> bool:
        """Whether any sky is brighter overhead."""
        return any(each.overcast_share > 0.0 for each in self.atmospheres)


def build_parts(file: SceneFile) -> Parts:
    """Return what a scene file describes.

    Raises `FormatError`: something in the file, or in a file that it names, cannot be used; all problems are
    listed. Raises `MissingExtraError`: a mesh needs a package that is not installed.
    """
    problems = Problems(f"{file.path} cannot be rendered", FormatError)
    parts: dict[str, Any] = {}
    builders = {"scene": _scene, "camera": _camera, "atmospheres": _atmospheres, "spectra": _spectra}
    for name, build in builders.items():
        try:
            parts[name] = build(file)
        except ImportError:
            raise
        except (PaintError, OSError) as error:
            problems.add(str(error))
    try:
        parts["platform"] = _platform(file, parts.get("scene"))
    except PaintError as error:
        problems.add(str(error))
    problems.raise_if_any()
    noise = file.camera.get("noise", True)
    return Parts(**parts, noise=noise)


def chosen_atmospheres(parts: Parts, names: Sequence[str]) -> tuple[Atmosphere, ...]:
    """Return the atmospheres of these names, all without names; `SchemaError` where one is unknown."""
    by_name = {each.name: each for each in parts.atmospheres}
    unknown = [name for name in names if name not in by_name]
    if unknown:
        missing = ", ".join(map(repr, unknown))
        raise SchemaError(f"there is no atmosphere {missing} in the scene file; it has {', '.join(by_name)}")
    return tuple(by_name[name] for name in dict.fromkeys(names)) if names else parts.atmospheres


# --- what is seen ------------------------------------------------------------------------------------------

#: Keys of a car park with a unit, to arguments of `car_park`.
_IN_METRES = ("length_m", "width_m", "line_width_m", "margin_m")
_OF_COATS = {"index": "index", "roughness": "roughness", "gloss": "gloss", "waviness_deg": "waviness"}


def _scene(file: SceneFile) -> Scene:
    from hyperpaint.simulation.rendering.scene import Scene

    makers = {"car_park": _car_park, "plane": _plane}
    kind = file.scene["kind"]
    parts = [makers[kind](file)] if kind in makers else []
    parts += [_mesh(entry) for entry in file.meshes]
    return replace(parts[0], name=file.name) if len(parts) == 1 else Scene.join(parts, file.name)


def _car_park(file: SceneFile) -> Scene:
    from hyperpaint.simulation.rendering.car_parks import car_park

    options = {"fleet": "real", **{key: value for key, value in file.scene.items() if key != "kind"}}
    for key in _IN_METRES:
        if key in options:
            options[key.removesuffix("_m")] = float(options.pop(key))
    coat = {key: options.pop(f"coat_{key}") for key in _OF_COATS if f"coat_{key}" in options}
    if not options.pop("coat", True):
        options["coat"] = None
    elif coat:
        options["coat"] = _coat(coat)
    return car_park(**options)


def _plane(file: SceneFile) -> Scene:
    from hyperpaint.simulation.rendering.materials import Material
    from hyperpaint.simulation.rendering.scene import plane

    size = file.scene.get("size_m", 1000.0)
    spectrum = file.scene.get("spectrum", "asphalt")
    sides = (float(size), float(size)) if isinstance(size, int | float) else (float(size[0]), float(size[1]))
    return plane(sides, Material("ground", spectrum, "asphalt" if spectrum == "asphalt" else "other"))


def _mesh(entry: MeshEntry) -> Scene:
    from hyperpaint.simulation.rendering.mesh_files import read_mesh
    from hyperpaint.simulation.rendering.scene import Instance

    options = dict(entry.options)
    kind = options.get("kind", "other")
    own = {key: options[key] for key in MATERIAL if key in options}
    default = _material(entry.name, own, kind) if "spectrum" in own else None
    parts = {
        part: _material(
            f"{part} of {entry.name}", {"spectrum": said} if isinstance(said, str) else said, kind
        )
        for part, said in options.get("materials", {}).items()
    }
    painted = [one.spectrum for one in (default, *parts.values()) if one is not None and one.kind == "paint"]
    thing = Instance(entry.name, kind, painted[0] if kind == "car" and painted else "")
    mesh = read_mesh(
        entry.path, parts, default=default, instance=thing, unit=float(options.get("unit_m", 1.0)),
        up=options.get("up"),
    )  # fmt: skip
    return mesh.moved(options.get("offset_m", (0.0, 0.0, 0.0)), float(options.get("heading_deg", 0.0)))


def _coat(said: Mapping[str, Any]) -> Coat:
    """Return a clear coat of what is said of it; its gloss goes before its roughness."""
    from hyperpaint.simulation.rendering.appearance import coat_of_gloss
    from hyperpaint.simulation.rendering.materials import Coat

    own = {_OF_COATS[key]: float(value) for key, value in said.items() if key != "gloss"}
    if "gloss" in said:
        own.pop("roughness", None)
        return coat_of_gloss(float(said["gloss"]), **own)
    return Coat(**own)


def _material(name: str, said: Mapping[str, Any], kind: str) -> Material:
    """Return a material; what lies on a car is paint unless it is said to be something else."""
    from hyperpaint.simulation.rendering.materials import Flakes, Material

    surface = said.get("class", "paint" if kind == "car" else "other")
    coat = {key: said[f"coat_{key}"] for key in _OF_COATS if f"coat_{key}" in said}
    share = float(said.get("flakes", 0.0))
    over = _coat(coat) if coat or share or surface == "paint" else None
    return Material(
        f"paint of {name}" if surface == "paint" else name, said["spectrum"], surface, over,
        Flakes(share) if share else None,
    )  # fmt: skip


# --- where from, and by what -------------------------------------------------------------------------------


def _platform(file: SceneFile, scene: Scene | None) -> Platform:
    from hyperpaint.simulation.rendering.platforms import pushbroom

    options = dict(file.platform)
    if "centre" not in options and "start" not in options and scene is not None:
        options["centre"] = _middle(file, scene)
    return pushbroom(**options)


def _middle(file: SceneFile, scene: Scene) -> tuple[float, float]:
    """Return what is flown over unless the file says it: a car park, or whatever there is."""
    if file.scene["kind"] == "car_park":
        # the park lies from y = 0 northwards, in the middle of ground that goes on around it
        return 0.0, float(file.scene.get("length_m", 50.0)) / 2
    east, north = scene.bounds[:, :2].mean(axis=0)
    return float(east), float(north)


def _camera(file: SceneFile) -> Camera:
    from hyperpaint.simulation.camera import Camera
    from hyperpaint.simulation.settings import SimulationSettings

    options = {key: value for key, value in file.camera.items() if key != "noise"}
    size = {"columns": file.platform["columns"], "lines": max(2, file.platform["lines"])}
    times = [key for key in ("exposure_time", "frame_period") if key in file.platform]
    options |= {f"{key}_ms": file.platform[key] * 1e3 for key in times}
    return Camera.of(SimulationSettings.of({**options, **size}))


# --- in which light ----------------------------------------------------------------------------------------


def _atmospheres(file: SceneFile) -> tuple[Atmosphere, ...]:
    problems = Problems("the atmospheres cannot be used", SchemaError)
    atmospheres = []
    for entry in file.atmospheres:
        try:
            atmospheres.append(_atmosphere(entry))
        except (PaintError, OSError) as error:
            problems.add(f"{entry.name}: {error}")
    problems.raise_if_any()
    return tuple(atmospheres)


def _atmosphere(entry: AtmosphereEntry) -> Atmosphere:
    from hyperpaint.simulation.rendering.four_curves import Atmosphere, preset_atmosphere

    options = dict(entry.options)
    oktas, time = options.pop("oktas", None), options.pop("time", None)
    sun: dict[str, Any] = {
        key: float(options.pop(f"{key}_deg"))
        for key in ("sun_zenith", "sun_azimuth")
        if f"{key}_deg" in options
    }
    sky = {key: options.pop(key) for key in ("overcast_share", "direct_fraction") if key in options}
    clear = {key: options.pop(key) for key in ("aerosol", "water") if key in options}
    if clear and (entry.table is not None or entry.irradiance):
        raise SchemaError(
            f"{' and '.join(clear)} can be given with a preset only; the light is as the file has it"
        )
    if entry.table is not None:
        atmosphere = Atmosphere.from_table(entry.table, **sun, **sky)
    elif entry.irradiance:
        from hyperpaint.io.spectrometers.irradiance import open_irradiance

        moment = None if time is None else np.datetime64(str(time).replace(" ", "T"), "ns")
        atmosphere = Atmosphere.from_irradiance(open_irradiance(entry.irradiance), time=moment, **sun, **sky)
    else:
        atmosphere = preset_atmosphere(entry.preset or entry.name)
        if sun or clear or oktas is not None:
            oktas = 8.0 if oktas is None and atmosphere.overcast_share > 0.0 else oktas
            sun = {"sun_zenith": atmosphere.sun_zenith, "sun_azimuth": atmosphere.sun_azimuth} | sun
            atmosphere = Atmosphere.clear(**sun, **clear)
        if sky:
            atmosphere = replace(atmosphere, **sky)
    if oktas:
        atmosphere = atmosphere.clouded(float(oktas))
    return replace(atmosphere, name=entry.name)


def _spectra(file: SceneFile) -> dict[str, Any]:
    problems = Problems("spectra cannot be read", FormatError)
    spectra: dict[str, Any] = {}
    for name, path in file.spectra.items():
        try:
            value = read_spectra(path)
        except PaintError as error:
            problems.add(str(error))
            continue
        if isinstance(value, dict):  # paints with wavelengths of their own
            single = len(value) == 1
            spectra |= {name if single else f"{name}/{paint}": one for paint, one in value.items()}
        else:
            spectra[name] = value
    problems.raise_if_any()
    return spectra
