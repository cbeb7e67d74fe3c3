"""Scenes of triangles as DIRSIG files: geometry, materials with populations, texture maps, lists."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from hyperpaint.base.arrays import Array
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.facts import documented
from hyperpaint.base.mirrored_light import EXCLUDED, INCLUDED, mirror_reflection
from hyperpaint.base.schema import LIBRARY_VARIABLES, SIGNATURE, require
from hyperpaint.base.units import takes_quantities

from .dirsig_writing import (
    EMISSIVITY,
    FORMAT,
    MARKER,
    REFLECTANCE,
    export_folder,
    paint_records,
    write_spectra,
)
from .emissivity_files import read_emissivity
from .instructions import material_section
from .material_list import Material, Section, material_ids, materials_text
from .paint_curves import GAPS, Axis, Choices, coat_of
from .scene_texts import (
    Triangles,
    fit_text,
    geometry_list_text,
    material_colours_text,
    obj_lines,
    scene_readme_text,
    scene_text,
    simulation_text,
    texture_picture,
)

#: Default of the largest number of curves of a population.
MAX_CURVES = 64

_WINDOW_NM = (400.0, 700.0)  # of a texture's picture
#: Wavelengths that materials must cover [nm] for a scene to have the feature.
_FEATURES = {"vis": (410.0, 690.0), "nir": (710.0, 890.0)}
_SPECULAR = "specular_reflectance"


class _Surface(NamedTuple):
    """Material of faces: a spectrum, under a coat of a refractive index (0 for none) and roughness."""

    spectrum: str
    coat_index: float
    roughness: float  # 0 where not written

    @property
    def mirrored(self) -> float:
        """Reflectance of the coat for light from the normal [1]."""
        return ((self.coat_index - 1.0) / (self.coat_index + 1.0)) ** 2 if self.coat_index else 0.0


@takes_quantities(wavelength_range="nm")
@documented(overwrite="own overwrite")
def write_dirsig_scene(
    scene: Triangles,
    folder: str | os.PathLike[str],
    paints: xr.Dataset | Sequence[xr.Dataset],
    *,
    repaint: Mapping[str, str] | None = None,
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
    max_curves: int = MAX_CURVES,
    wavelength_range: tuple[float, float] | None = None,
    extrapolate: bool = False,
    gaps: str | None = None,
    coat_brdf: bool = False,
    texture_m: float = 2.0,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> xr.Dataset:
    r"""Write a scene of triangles as files of the simulator DIRSIG.

    Written are the geometry as OBJ with its MTL, a geometry list, the ``.scene``, a skeleton of a ``.jsim``,
    the materials with their spectra, a texture map of every population, and a README that says how to run
    it, and which constructs were checked. The folder appears when all is written, or not at all.

    Parameters
    ----------
    scene
        As `hyperpaint.simulation` makes it: ``vertices`` [m], ``faces``, ``materials`` ...
    folder
    paints
        A paint library, or several of which the first that has a name counts: ``reflectance`` (signature,
        band) [1] under the names of the spectra that the scene's materials have. Members become a population.
    repaint
        New spectra by the name of an instance (its paint), of a material, or of a spectrum; the first counts
        most.
    origin
        Latitude and longitude [degree] of the scene's origin, and its height [m].
    max_curves
        Curves of a population at the most, at even ranks of their brightness, complete ones first.
    wavelength_range, extrapolate, gaps
        As for `write_dirsig`.
    coat_brdf
        Write clear coats as the BRDF Shell Target, which mirrors white light into a lobe of the coat's
        roughness; else as SPECULAR_FRACTION, which has the body's colour.
    texture_m
        What one picture of a texture covers [m].
    overwrite
    progress

    Returns
    -------
    Dataset
        What was written (signature): ``material_id``, ``curves``, ``complete``, ``thinned``,
        ``specular_fraction``, ``faces``, and ``texture`` where there is one. Attributes: ``name``,
        ``features``, ``coverage_nm``.

    Raises
    ------
    SchemaError
        A spectrum of the scene is in no library, a name of ``repaint`` is not in the scene, an option is out
        of range, or paints have no values or holes at the ends; all are listed.
    StoreError
        The folder holds something, is being written by another, or cannot be written.

    Notes
    -----
    A clear coat of index n becomes a SPECULAR_FRACTION: the coat's reflectance at normal incidence, F_0 =
    ((n - 1) / (n + 1))^2, as a share of itself and the body's mean; or, with ``coat_brdf``, a Shell Target
    with F_0 in its first term. Either is only written where a library declares its reflectance free of
    mirrored light; otherwise the coat would count twice. The README says what of Shell Target was checked.

    Examples
    --------
    >>> import tempfile, xarray as xr
    >>> from hyperpaint.simulation.rendering.materials import Material
    >>> from hyperpaint.simulation.rendering.scene import plane
    >>> grey = xr.DataArray([[0.2, 0.2]], dims=("signature", "band"), attrs={"units": "1"})
    >>> nm = ("band", [400.0, 1000.0], {"units": "nm"})
    >>> paints = xr.Dataset({"reflectance": grey}, {"signature": ["panel_20"], "wavelength": nm})
    >>> scene = plane(2.0, Material("grey", "panel_20", "panel"))
    >>> with tempfile.TemporaryDirectory() as out:
    ...     summary = write_dirsig_scene(scene, out, paints)
    ...     print(summary.features, *sorted(path.name for path in Path(out).iterdir()))
    vis,nir README.txt geometry ground.jsim ground.scene maps materials paints.json
    """
    libraries = list(paints) if isinstance(paints, Sequence) else [paints]
    problems = Problems("no DIRSIG scene can be written", SchemaError)
    if not isinstance(max_curves, int) or max_curves < 1:
        problems.add(
            f"max_curves={max_curves!r}", expected="a whole number above 0", code="value-out-of-range"
        )
    if not isinstance(texture_m, int | float) or not 1e-3 <= texture_m <= 1e4:
        problems.add(f"texture_m={texture_m!r}", expected="0.001 to 10000 m", code="value-out-of-range")
    place = np.asarray(origin, np.float64)
    if place.shape != (3,) or not np.isfinite(place).all() or not (abs(place[:2]) <= [90.0, 360.0]).all():
        problems.add(
            f"origin={origin!r}",
            expected="latitude and longitude [degree] and height [m]",
            code="value-out-of-range",
        )
    problems.raise_if_any()
    for library in libraries:
        require(library, ["reflectance", "wavelength"], "a DIRSIG scene", LIBRARY_VARIABLES)
    surfaces, face_surface = _surfaces(scene, dict(repaint or {}), with_roughness=coat_brdf)
    shares = _by_library(libraries, surfaces)
    choices = Choices("centre", wavelength_range, extrapolate, gaps or GAPS[0], max_curves)
    stem = material_ids([scene.name or "scene"])[0]
    title = scene.name or "scene"
    with export_folder(folder, overwrite=overwrite, inside=_FOLDERS) as build:
        records = _write_materials(
            build / "materials", libraries, shares, surfaces, choices, coat_brdf=coat_brdf, progress=progress
        )
        by_surface = {record.pop("surface"): record for record in records}
        ordered = [by_surface[number] for number in range(len(surfaces))]
        counts = np.bincount(face_surface, minlength=len(surfaces))
        for record, count in zip(ordered, counts.tolist(), strict=True):
            record["faces"] = count
        attrs = _attrs(scene, ordered, origin, texture_m)
        _write_pictures(build, ordered, attrs["window_nm"])
        _write_geometry(build / "geometry", scene, stem, ordered, face_surface, texture_m)
        entries = (
            material_section(
                record,
                surface="ShellTarget" if record["fit_file"] else "ClassicEmissivity",
                rad_solver="Generic" if record["fit_file"] else "Classic",
                thermal=None,
                double_sided=True,
            )
            for record in ordered
        )
        window = attrs["window_nm"]
        texts = {
            f"materials/{stem}.mat": materials_text(entries),
            f"{stem}.scene": scene_text(title, stem, ordered, origin, attrs["features"], window),
            f"{stem}.jsim": simulation_text(stem),
            "README.txt": scene_readme_text(title, stem, ordered, attrs),
            MARKER: json.dumps({"format": FORMAT, "version": 1, **attrs, "paints": ordered}, indent=1) + "\n",
        }
        for name, text in texts.items():
            (build / name).write_bytes(text.encode("utf-8", "backslashreplace"))
    return _summary(ordered, {"name": title, **attrs, "folder": os.fspath(folder)})


_FOLDERS = (
    "geometry/lists",
    "geometry/objects",
    f"materials/{EMISSIVITY}",
    f"materials/{REFLECTANCE}",
    "materials/brdf",
    "maps",
)


def _surfaces(
    scene: Triangles, repaint: dict[str, str], *, with_roughness: bool
) -> tuple[list[_Surface], NDArray[np.int64]]:
    """Return the distinct surfaces, and the surface of every face (face,)."""
    problems = Problems("the scene cannot be painted", SchemaError)
    materials, instances = scene.materials, scene.instances
    names = {each.name for each in (*materials, *instances)} | {each.spectrum for each in materials}
    for key in repaint.keys() - names:
        problems.add(
            f"repaint[{key!r}] names no instance, material or spectrum of the scene", code="key-unknown"
        )
    problems.raise_if_any()
    pair = scene.face_material.astype(np.int64) * len(instances) + scene.face_instance
    distinct, face_pair = np.unique(pair, return_inverse=True)
    numbers: dict[_Surface, int] = {}
    surface_of_pair = []
    for each in distinct.tolist():
        material, instance = materials[each // len(instances)], instances[each % len(instances)]
        spectrum = repaint.get(material.name, repaint.get(material.spectrum, material.spectrum))
        if material.kind == "paint":
            spectrum = repaint.get(instance.name, spectrum)
        surface = _Surface(spectrum, 0.0, 0.0)
        if (coat := material.coat) is not None:
            surface = _Surface(spectrum, float(coat.index), float(coat.roughness) if with_roughness else 0.0)
        surface_of_pair.append(numbers.setdefault(surface, len(numbers)))
    return list(numbers), np.asarray(surface_of_pair, np.int64)[face_pair.ravel()]


def _by_library(libraries: Sequence[xr.Dataset], surfaces: Sequence[_Surface]) -> list[list[tuple[int, int]]]:
    """Return for every library its surfaces: their numbers, and the places of their paints."""
    problems = Problems("the scene cannot be painted", SchemaError)
    shares: list[list[tuple[int, int]]] = [[] for _ in libraries]
    places = [
        {str(name): place for place, name in enumerate(library[SIGNATURE].values)} for library in libraries
    ]
    for number, surface in enumerate(surfaces):
        owner = next((k for k, names in enumerate(places) if surface.spectrum in names), None)
        if owner is None:
            problems.add(
                f"spectrum {surface.spectrum!r} of the scene is in no library", code="spectrum-missing"
            )
        else:
            shares[owner].append((number, places[owner][surface.spectrum]))
    problems.raise_if_any()
    return shares


def _write_materials(
    build: Path,
    libraries: Sequence[xr.Dataset],
    shares: Sequence[list[tuple[int, int]]],
    surfaces: Sequence[_Surface],
    choices: Choices,
    *,
    coat_brdf: bool,
    progress: Callable[[int, int], None] | None,
) -> list[dict[str, Any]]:
    """Write the spectra of all surfaces; return their records, with the number of their ``surface``."""
    records: list[dict[str, Any]] = []
    for library, share in zip(libraries, shares, strict=True):
        if not share:
            continue
        numbers, places = zip(*share, strict=True)
        mirrored = np.array([surfaces[number].mirrored for number in numbers])
        is_body = mirror_reflection(library) == EXCLUDED
        part = _with_coats(library.isel({SIGNATURE: list(places)}), mirrored * is_body, as_brdf=coat_brdf)
        taken = [Material(record["id"], record["name"], Section("")) for record in records]
        library_records = paint_records(part, taken)
        kind = "members" if "member_reflectance" in part.variables else "centre"
        coat = coat_of(part, "library" if _SPECULAR in part.variables else 0.0)
        write_spectra(part, build, Axis(part), replace(choices, curves=kind), coat, library_records, None)
        for record, number in zip(library_records, numbers, strict=True):
            record |= {
                "surface": number,
                "mirror_reflection": EXCLUDED if is_body else coat.mirror_reflection,
            }
            record["fit_file"] = ""
            if coat_brdf and is_body and surfaces[number].coat_index:
                record["fit_file"] = f"brdf/{record['id']}.fit"
                # the written centre includes the coat
                micrometre, whole = np.loadtxt(build / record["reflectance_file"], unpack=True)
                surface = surfaces[number]
                body = np.maximum(whole - surface.mirrored, 0.0)
                text = fit_text(surface.coat_index, surface.roughness, micrometre * 1000.0, body)
                (build / record["fit_file"]).write_text(text)
        records += library_records
        if progress is not None:
            progress(len(records), len(surfaces))
    return records


def _with_coats(library: xr.Dataset, mirrored: Array, *, as_brdf: bool) -> xr.Dataset:
    """Return a library with coats of reflectance ``mirrored`` (signature,) [1], apart or within a BRDF."""
    plain = library.drop_vars(_SPECULAR, errors="ignore")
    if not mirrored.any():
        return plain
    level = xr.DataArray(mirrored.astype(np.float32), dims=SIGNATURE)
    if not as_brdf:
        specular = (xr.zeros_like(plain["reflectance"]) + level).assign_attrs(units="1")
        return plain.assign({_SPECULAR: specular.transpose(*plain["reflectance"].dims)})
    names = [name for name in ("reflectance", "member_reflectance") if name in plain.variables]
    whole = {
        name: (plain[name] + level).transpose(*plain[name].dims).assign_attrs(plain[name].attrs)
        for name in names
    }
    for values in whole.values():
        values.attrs["mirror_reflection"] = INCLUDED
    return plain.assign(whole)


def _attrs(
    scene: Triangles, records: Sequence[Mapping[str, Any]], origin: Sequence[float], texture_m: float
) -> dict[str, Any]:
    low = max(record["wavelength"][0] for record in records)
    high = min(record["wavelength"][1] for record in records)
    has = [name for name, (first, last) in _FEATURES.items() if low <= first and high >= last]
    window = max(low, _WINDOW_NM[0]), min(high, _WINDOW_NM[1])
    shares = sum(record["specular_fraction"] > 0 for record in records)
    lobes = sum(bool(record["fit_file"]) for record in records)
    included = sum(record["mirror_reflection"] != EXCLUDED for record in records)
    advice = (
        f"{shares} materials have a clear coat as SPECULAR_FRACTION, of the body's colour and mirror-like."
    )
    if lobes:
        advice = (
            f"{lobes} materials have a clear coat as the BRDF Shell Target; their curves hold what it "
            "mirrors of\nlight from the normal."
        )
    if included:
        advice += (
            f"\nThe curves of {included} hold what a coat mirrored when they were measured, or do not say: "
            "these\nhave none; do not add one, it would count twice."
        )
    return {
        "origin": [float(value) for value in origin],
        "faces": len(scene.faces),
        "texture_m": float(texture_m),
        "coverage_nm": [low, high],
        "features": ",".join(has),
        "window_nm": list(window if window[0] < window[1] else (low, high)),
        "coat_advice": advice,
    }


def _write_pictures(build: Path, records: Sequence[dict[str, Any]], window: Sequence[float]) -> None:
    """Write a texture picture for every population, and name it in the record."""
    grid = np.linspace(window[0], window[1], 301)
    for record in records:
        record["texture"] = ""
        if record["curves"] < 2:
            continue
        # mean reflectance of every curve over the window
        curves = read_emissivity(build / "materials" / record["emissivity_file"]).curves
        means = [
            float(1.0 - np.interp(grid, curve.wavelength * 1000.0, curve.emissivity).mean())
            for curve in curves
        ]
        picture = texture_picture(np.array(means), record["id"])
        if picture is not None:
            record["texture"] = f"{record['id']}.pgm"
            head = f"P5\n{picture.shape[1]} {picture.shape[0]}\n255\n".encode()
            (build / "maps" / record["texture"]).write_bytes(head + picture.tobytes())


def _write_geometry(
    build: Path,
    scene: Triangles,
    stem: str,
    records: Sequence[Mapping[str, Any]],
    face_surface: NDArray[np.int64],
    texture_m: float,
) -> None:
    identifiers = [record["id"] for record in records]
    with open(build / "objects" / f"{stem}.obj", "w", encoding="ascii", newline="\n") as file:
        for line in obj_lines(scene, identifiers, face_surface, f"{stem}.mtl", texture_m):
            file.write(line + "\n")
    (build / "objects" / f"{stem}.mtl").write_text(material_colours_text(records), encoding="ascii")
    (build / "lists" / f"{stem}.glist").write_text(
        geometry_list_text(f"objects/{stem}.obj"), encoding="ascii"
    )


def _summary(records: Sequence[Mapping[str, Any]], attrs: Mapping[str, Any]) -> xr.Dataset:
    def column(key: str, dtype: Any) -> tuple[str, Array]:
        return SIGNATURE, np.array([record[key] for record in records], dtype)

    values: dict[str, Any] = {
        key: column(key, np.int64) for key in ("curves", "complete", "thinned", "faces", "interpolated")
    }
    values |= {
        "specular_fraction": column("specular_fraction", np.float64),
        "texture": column("texture", object),
    }
    coords = {SIGNATURE: column("paint", object), "material_id": column("id", object)}
    return xr.Dataset(values, coords, {"title": "DIRSIG scene", **attrs})
