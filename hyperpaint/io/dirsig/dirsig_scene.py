"""Scenes of triangles as DIRSIG files: geometry, materials with populations, texture maps, lists."""

from __future__ import annotations

import json
import os
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, Protocol
from xml.sax.saxutils import escape, quoteattr

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from hyperpaint.base.arrays import Array, Floats
from hyperpaint.base.errors import Problems, SchemaError
from hyperpaint.base.facts import documented, is_number
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
from .material_list import Material, Section, material_ids, materials_text, plain_name
from .paint_curves import GAPS, Axis, Choices, coat_of

#: Default of the largest number of curves of a population.
MAX_CURVES = 64

_WINDOW_NM = (400.0, 700.0)  # wavelengths of which a texture's picture shows the mean reflectance
#: Features of a scene, by the wavelengths that all materials must cover [nm].
_FEATURES = {"vis": (410.0, 690.0), "nir": (710.0, 890.0)}
_SPECULAR = "specular_reflectance"


class _Surface(NamedTuple):
    # Material of faces: a spectrum, and a clear coat
    spectrum: str  # name
    coat_index: float  # refractive index, 0 without a coat
    roughness: float  # 0 if it is not written

    @property
    def mirrored(self) -> float:
        # Fresnel reflectance of the coat at normal incidence [1]
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

    The folder contains the geometry as OBJ with its MTL, a geometry list, the ``.scene``, a skeleton of a
    ``.jsim``, the materials with their spectra, a texture map of every population of curves, and a README on
    how to run it and which constructs were checked. The folder appears when all files are complete.

    Parameters
    ----------
    scene
        A scene of `hyperpaint.simulation`: ``vertices`` [m], ``faces``, ``materials`` ...
    folder
    paints
        A paint library, or several; a spectrum is taken from the first with its name. ``reflectance``
        (signature, band) [1] must have the names of the spectra in the scene's materials. Members become a
        population of curves.
    repaint
        New spectra by the name of an instance (its paint), of a material, or of a spectrum, in this order of
        priority.
    origin
        Latitude and longitude [degree] of the scene's origin, and its height [m].
    max_curves
        Maximum number of curves in a population. They are chosen at equal steps of their rank in brightness,
        complete curves first.
    wavelength_range, extrapolate, gaps
        As for `write_dirsig`.
    coat_brdf
        Write clear coats as the BRDF Shell Target, whose lobe has the colour of the light and the roughness
        of the coat; else as SPECULAR_FRACTION, whose lobe has the colour of the body.
    texture_m
        Side of the square that a picture of a texture covers [m].
    overwrite
    progress

    Returns
    -------
    Dataset
        Properties of the materials (signature): ``material_id``, ``curves``, ``complete``, ``thinned``,
        ``specular_fraction``, ``faces``, and ``texture``, empty without a texture map. Attributes: ``name``,
        ``features``, ``coverage_nm``.

    Raises
    ------
    SchemaError
        A spectrum of the scene is in no library, a name of ``repaint`` is not in the scene, an option is out
        of range, or paints have no values, or none at the ends of the range; all are listed.
    StoreError
        The folder contains other files, is being written by another process, or cannot be written.

    Notes
    -----
    A clear coat of refractive index n becomes a SPECULAR_FRACTION F_0 / (F_0 + R), with the coat's
    reflectance at normal incidence F_0 = ((n - 1) / (n + 1))^2 and the mean reflectance R of the body; or,
    with ``coat_brdf``, a Shell Target with F_0 in its first term. A coat is only written if the library
    declares its reflectance as free of mirrored light; else the coat would count twice. The README lists the
    constructs of Shell Target that were checked.

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
    if not is_number(texture_m) or not 1e-3 <= texture_m <= 1e4:
        problems.add(f"texture_m={texture_m!r}", expected="0.001 to 10000 m", code="value-out-of-range")
    position = np.asarray(origin, np.float64)
    if (
        position.shape != (3,)
        or not np.isfinite(position).all()
        or not (abs(position[:2]) <= [90.0, 360.0]).all()
    ):
        problems.add(
            f"origin={origin!r}",
            expected="latitude and longitude [degree] and height [m]",
            code="value-out-of-range",
        )
    problems.raise_if_any()
    for library in libraries:
        require(library, ["reflectance", "wavelength"], "a DIRSIG scene", LIBRARY_VARIABLES)
    surfaces, face_surface = _surfaces(scene, dict(repaint or {}), with_roughness=coat_brdf)
    surfaces_of = _by_library(libraries, surfaces)
    choices = Choices("centre", wavelength_range, extrapolate, gaps or GAPS[0], max_curves)
    stem = material_ids([scene.name or "scene"])[0]
    title = scene.name or "scene"
    with export_folder(folder, overwrite=overwrite, inside=_FOLDERS) as build:
        records = _write_materials(
            build / "materials",
            libraries,
            surfaces_of,
            surfaces,
            choices,
            coat_brdf=coat_brdf,
            progress=progress,
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
    # Distinct surfaces, and the index of the surface of every face (face,)
    problems = Problems("the scene cannot be painted", SchemaError)
    materials, instances = scene.materials, scene.instances
    names = {item.name for item in (*materials, *instances)}
    names |= {material.spectrum for material in materials}
    for key in repaint.keys() - names:
        problems.add(
            f"repaint[{key!r}]: the scene has no instance, material or spectrum of this name",
            code="key-unknown",
        )
    problems.raise_if_any()
    pair = scene.face_material.astype(np.int64) * len(instances) + scene.face_instance
    distinct, face_pair = np.unique(pair, return_inverse=True)
    numbers: dict[_Surface, int] = {}
    surface_of_pair = []
    for code in distinct.tolist():
        material, instance = materials[code // len(instances)], instances[code % len(instances)]
        spectrum = repaint.get(material.name, repaint.get(material.spectrum, material.spectrum))
        if material.kind == "paint":
            spectrum = repaint.get(instance.name, spectrum)
        index, roughness = (0.0, 0.0) if (coat := material.coat) is None else (coat.index, coat.roughness)
        surface = _Surface(spectrum, float(index), float(roughness) if with_roughness else 0.0)
        surface_of_pair.append(numbers.setdefault(surface, len(numbers)))
    return list(numbers), np.asarray(surface_of_pair, np.int64)[face_pair.ravel()]


def _by_library(libraries: Sequence[xr.Dataset], surfaces: Sequence[_Surface]) -> list[list[tuple[int, int]]]:
    # For every library the surfaces painted from it: pairs of their index and the index of their paint
    problems = Problems("the scene cannot be painted", SchemaError)
    surfaces_of: list[list[tuple[int, int]]] = [[] for _ in libraries]
    paint_indices = [
        {str(name): index for index, name in enumerate(library[SIGNATURE].values)} for library in libraries
    ]
    for number, surface in enumerate(surfaces):
        source = next((k for k, indices in enumerate(paint_indices) if surface.spectrum in indices), None)
        if source is None:
            problems.add(
                f"spectrum {surface.spectrum!r} of the scene is in no library", code="spectrum-missing"
            )
        else:
            surfaces_of[source].append((number, paint_indices[source][surface.spectrum]))
    problems.raise_if_any()
    return surfaces_of


def _write_materials(
    build: Path,
    libraries: Sequence[xr.Dataset],
    surfaces_of: Sequence[list[tuple[int, int]]],
    surfaces: Sequence[_Surface],
    choices: Choices,
    *,
    coat_brdf: bool,
    progress: Callable[[int, int], None] | None,
) -> list[dict[str, Any]]:
    # Write the spectra of all surfaces; return their records, with the index of their ``surface``
    records: list[dict[str, Any]] = []
    for library, pairs in zip(libraries, surfaces_of, strict=True):
        if not pairs:
            continue
        numbers, paints = zip(*pairs, strict=True)
        mirrored = np.array([surfaces[number].mirrored for number in numbers])
        is_body = mirror_reflection(library) == EXCLUDED
        coated = _with_coats(library.isel({SIGNATURE: list(paints)}), mirrored * is_body, as_brdf=coat_brdf)
        written = [Material(record["id"], record["name"], Section("")) for record in records]
        library_records = paint_records(coated, written)
        curves = "members" if "member_reflectance" in coated.variables else "centre"
        coat = coat_of(coated, "library" if _SPECULAR in coated.variables else 0.0)
        write_spectra(
            coated, build, Axis(coated), replace(choices, curves=curves), coat, library_records, None
        )
        for record, number in zip(library_records, numbers, strict=True):
            record |= {
                "surface": number,
                "mirror_reflection": EXCLUDED if is_body else coat.mirror_reflection,
            }
            record["fit_file"] = ""
            if coat_brdf and is_body and surfaces[number].coat_index:
                record["fit_file"] = f"brdf/{record['id']}.fit"
                # the file contains the reflectance of body and coat together
                micrometre, total = np.loadtxt(build / record["reflectance_file"], unpack=True)
                surface = surfaces[number]
                body = np.maximum(total - surface.mirrored, 0.0)
                text = fit_text(surface.coat_index, surface.roughness, micrometre * 1000.0, body)
                (build / record["fit_file"]).write_text(text)
        records += library_records
        if progress is not None:
            progress(len(records), len(surfaces))
    return records


def _with_coats(library: xr.Dataset, mirrored: Array, *, as_brdf: bool) -> xr.Dataset:
    # A library with coats of reflectance ``mirrored`` (signature,) [1]: in a variable of its own, or added to
    # the body for a BRDF
    plain = library.drop_vars(_SPECULAR, errors="ignore")
    if not mirrored.any():
        return plain
    level = xr.DataArray(mirrored.astype(np.float32), dims=SIGNATURE)
    if not as_brdf:
        specular = (xr.zeros_like(plain["reflectance"]) + level).assign_attrs(units="1")
        return plain.assign({_SPECULAR: specular.transpose(*plain["reflectance"].dims)})
    names = [name for name in ("reflectance", "member_reflectance") if name in plain.variables]
    totals = {
        name: (plain[name] + level).transpose(*plain[name].dims).assign_attrs(plain[name].attrs)
        for name in names
    }
    for values in totals.values():
        values.attrs["mirror_reflection"] = INCLUDED
    return plain.assign(totals)


def _attrs(
    scene: Triangles, records: Sequence[Mapping[str, Any]], origin: Sequence[float], texture_m: float
) -> dict[str, Any]:
    low = max(record["wavelength"][0] for record in records)
    high = min(record["wavelength"][1] for record in records)
    features = [name for name, (start, end) in _FEATURES.items() if low <= start and high >= end]
    window = max(low, _WINDOW_NM[0]), min(high, _WINDOW_NM[1])
    fractions = sum(record["specular_fraction"] > 0 for record in records)
    lobes = sum(bool(record["fit_file"]) for record in records)
    included = sum(record["mirror_reflection"] != EXCLUDED for record in records)
    advice = (
        f"{fractions} materials have a clear coat as SPECULAR_FRACTION, of the body's colour and mirror-like."
    )
    if lobes:
        advice = (
            f"{lobes} materials have a clear coat as the BRDF Shell Target; their curves include its "
            "reflectance\nat normal incidence."
        )
    if included:
        advice += (
            f"\nThe curves of {included} include light mirrored by a coat, or do not declare it: these "
            "materials\nhave no coat; do not add one, it would count twice."
        )
    return {
        "origin": [float(value) for value in origin],
        "faces": len(scene.faces),
        "texture_m": float(texture_m),
        "coverage_nm": [low, high],
        "features": ",".join(features),
        "window_nm": list(window if window[0] < window[1] else (low, high)),
        "coat_advice": advice,
    }


def _write_pictures(build: Path, records: Sequence[dict[str, Any]], window: Sequence[float]) -> None:
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


# --- texts of a DIRSIG scene: geometry, scene, simulation, texture pictures, README ------------------------


#: Side of a texture's picture [pixel].
PICTURE_PX = 128

_GRAIN_PX = 3.0  # standard deviation of the Gaussian blur of the noise in a picture


class Triangles(Protocol):
    """Attributes of `hyperpaint.simulation.rendering.scene.Scene` that are read."""

    @property
    def name(self) -> str:
        """Name of the scene."""

    @property
    def vertices(self) -> Floats:
        """Shape (vertex, 3) [m]: x east, y north, z up."""

    @property
    def faces(self) -> NDArray[np.int64]:
        """Vertices of every triangle (face, 3)."""

    @property
    def normals(self) -> Floats:
        """Normals at the vertices (vertex, 3), zero for flat faces."""

    @property
    def face_material(self) -> NDArray[np.int32]:
        """Index of the material of every triangle (face,)."""

    @property
    def face_instance(self) -> NDArray[np.int32]:
        """Index of the instance of every triangle (face,)."""

    @property
    def materials(self) -> Sequence[Any]:
        """Materials with ``name``, ``spectrum``, ``kind``, and ``coat`` (with its ``index``), or None."""

    @property
    def instances(self) -> Sequence[Any]:
        """Instances with a ``name``."""


def obj_lines(
    scene: Triangles, material_id: Sequence[str], face_id: NDArray[np.int64], library: str, texture_m: float
) -> Iterator[str]:
    """Yield the lines of a scene as Wavefront OBJ, one object per instance.

    ``face_id`` (face,): index of the face's material in ``material_id``; ``library``: the ``.mtl`` file.
    Texture coordinates are in units of ``texture_m``, in the coordinate plane that is most parallel to the
    face, so that a picture has a similar size on all faces.
    """
    yield f"mtllib {library}"
    yield from (f"v {x:.7f} {y:.7f} {z:.7f}" for x, y, z in scene.vertices.tolist())
    # distinct pairs of a vertex and the plane of its face: 0, 1 or 2 for the plane across x, y or z
    corners = scene.vertices[scene.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    plane: NDArray[np.int64] = np.argmax(np.abs(normals), axis=1, keepdims=True)
    projected, texture = np.unique(scene.faces + plane * len(scene.vertices), return_inverse=True)
    axes = np.array([(1, 2), (0, 2), (0, 1)])[projected // len(scene.vertices)]
    points = np.take_along_axis(scene.vertices[projected % len(scene.vertices)], axes, axis=1) / texture_m
    yield from (f"vt {a:.5f} {b:.5f}" for a, b in points.tolist())
    yield from (f"vn {x:.6f} {y:.6f} {z:.6f}" for x, y, z in scene.normals.tolist())
    smooth = (scene.normals != 0.0).any(axis=1)[scene.faces].all(axis=1).tolist()
    order = np.lexsort((face_id, scene.face_instance))
    instance, material = -1, -1
    # OBJ counts from 1
    vertices, textures = (scene.faces + 1).tolist(), (texture.reshape(scene.faces.shape) + 1).tolist()
    for face in order.tolist():
        previous = instance, material
        instance, material = int(scene.face_instance[face]), int(face_id[face])
        if instance != previous[0]:
            yield f"o {plain_name(scene.instances[instance].name)}"
        if (instance, material) != previous:
            yield f"usemtl {material_id[material]}"
        pairs = zip(vertices[face], textures[face], strict=True)
        # the normal of a vertex has the number of the vertex
        yield "f " + " ".join(f"{a}/{b}/{a}" if smooth[face] else f"{a}/{b}" for a, b in pairs)


def material_colours_text(records: Sequence[Mapping[str, Any]]) -> str:
    """Return an ``.mtl`` file: the colours of the materials, for programs that display the geometry."""
    rows = []
    for record in records:
        red, green, blue = record["editor_color"]
        rows += [f"newmtl {record['id']}", f"Kd {red:.3f} {green:.3f} {blue:.3f}", ""]
    return "\n".join(rows)


def geometry_list_text(geometry: str) -> str:
    """Return a geometry list of one OBJ file that names materials by their IDs."""
    return f"""<geometrylist enabled="true">

  <object>
    <basegeometry>
      <obj><filename>{escape(geometry)}</filename></obj>
    </basegeometry>
    <staticinstance/>
  </object>

</geometrylist>
"""


def texture_picture(means: Array, name: str) -> NDArray[np.uint8] | None:
    """Return a picture (row, column) by which DIRSIG uses every curve of a population equally often.

    DIRSIG compares standard scores: a pixel gets the curve whose mean over the picture's wavelengths, in
    standard deviations of the population, is nearest to the pixel's brightness in standard deviations of the
    picture. The pixels have the mean reflectances of the curves as brightness, and every curve has the same
    number of pixels, so that both scores are equal. Curves that differ by less than 1/255 of their range
    share pixels.

    ``means`` (curve,): mean reflectances of the curves over these wavelengths; ``name``: seed of the noise.
    None for one curve, or curves of equal means.

    Examples
    --------
    >>> np.unique(texture_picture(np.array([0.2, 0.4, 0.25, 0.32]), "red"), return_counts=True)
    (array([  0,  64, 153, 255], dtype=uint8), array([4096, 4096, 4096, 4096]))
    """
    spread = float(np.ptp(means))
    if not spread > 1e-6:
        return None
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    frequency = np.fft.fftfreq(PICTURE_PX)
    blur = np.exp(-2.0 * (np.pi * _GRAIN_PX) ** 2 * (frequency[:, None] ** 2 + frequency**2))
    grain = np.fft.ifft2(np.fft.fft2(rng.standard_normal((PICTURE_PX, PICTURE_PX))) * blur).real
    rank = np.empty(grain.size, np.int64)
    rank[np.argsort(grain.ravel(), kind="stable")] = np.arange(grain.size)
    level = np.rint(255.0 * (np.sort(means) - means.min()) / spread).astype(np.uint8)
    return np.asarray(level[rank * len(means) // grain.size].reshape(grain.shape))


_FIT_STEP_NM = 20.0
_SMOOTH_DEG = 90.0  # tau and omega of a coat with hardly any shadowing and obscuration


def fit_text(index: float, roughness: float, wavelength: Array, body: Array) -> str:
    r"""Return the ``.fit`` file of a clear coat over a Lambert body, for DIRSIG's Shell Target BRDF.

    That is the Beard-Maxwell model of the NEF database [1]_, equation 10,

    .. math:: f = \frac{F(\beta)}{F(0)} \frac{B e^{-(\theta_h / \sigma)^2} \cos^2 \theta_h}
                  {\cos \theta_i \cos \theta_r} S + \rho_d + \frac{2 \rho_v}{\cos \theta_i + \cos \theta_r}

    with B such that the first term reflects F(0) of light from the normal, :math:`\rho_d` the reflectance of
    the body over pi, and :math:`\rho_v` = 0. DHR is the total reflectance at normal incidence. Parameters are
    written at many wavelengths, so that the kind of interpolation between them has no influence.

    Parameters
    ----------
    index, roughness
        Refractive index of the coat, and GGX alpha of its surface; the Gaussian has the same peak.
    wavelength, body
        Wavelengths [nm], and reflectance of the body through the coat (wavelength,) [1].

    References
    ----------
    .. [1] H. B. Westlund, G. W. Meyer, "A BRDF database employing the Beard-Maxwell reflection model",
       Graphics Interface 2002, 189-200, https://doi.org/10.20380/GI2002.22

    Examples
    --------
    >>> text = fit_text(1.5, 0.05, np.array([400.0, 410.0]), np.array([0.1, 0.1]))
    >>> print(*text.splitlines()[:6], sep="\n")
    FIT_PARAMS {
        LAMBDA = 0.4
        N = 1.5
        K = 0
        DHR = 0.14
        BIAS = 1.28092
    """
    normal = ((index - 1.0) / (index + 1.0)) ** 2
    sigma = max(roughness, 1e-4)
    # light from the normal is reflected at twice the facet's tilt: d omega = 2 sin(2 theta) d theta d phi
    tilt = np.linspace(0.0, min(8.0 * sigma, np.pi / 4.0), 4001)
    shadow = np.degrees(tilt) / _SMOOTH_DEG
    shadow = (1.0 + shadow * np.exp(-2.0 * shadow)) / (1.0 + shadow)
    lobe = np.exp(-((tilt / sigma) ** 2)) * np.cos(tilt) ** 2 * shadow * _fresnel(tilt, index) / normal
    flux = float(np.trapezoid(2.0 * np.pi * lobe * 2.0 * np.sin(2.0 * tilt), tilt))
    number = max(2, int(np.ceil((wavelength[-1] - wavelength[0]) / _FIT_STEP_NM)) + 1)
    blocks = []
    for nm in np.linspace(wavelength[0], wavelength[-1], number).tolist():
        level = float(np.interp(nm, wavelength, body))
        values = {
            "LAMBDA": nm / 1000.0,
            "N": index,
            "K": 0.0,
            "DHR": normal + level,
            "BIAS": normal / flux,
            "SIGMA": sigma,
            "TAU": _SMOOTH_DEG,
            "OMEGA": _SMOOTH_DEG,
            "RHO_D": level / np.pi,
            "RHO_V": 0.0,
        }
        rows = "".join(f"    {key} = {value:.6g}\n" for key, value in values.items())
        blocks.append(f"FIT_PARAMS {{\n{rows}}}\n")
    return "".join(blocks)


def _fresnel(angle: Array, index: float) -> Array:
    # Reflectance for unpolarised light at an angle from the normal [rad]
    cos_air, cos_coat = np.cos(angle), np.sqrt(1.0 - (np.sin(angle) / index) ** 2)
    s_wave = (cos_air - index * cos_coat) / (cos_air + index * cos_coat)
    p_wave = (index * cos_air - cos_coat) / (index * cos_air + cos_coat)
    return np.asarray(0.5 * (s_wave**2 + p_wave**2))


_ORIGIN = ("latitude", "longitude", "altitude")


def scene_text(
    title: str,
    stem: str,
    records: Sequence[Mapping[str, Any]],
    origin: Sequence[float],
    features: str,
    window: tuple[float, float],
) -> str:
    """Return a ``.scene`` file.

    ``origin``: latitude, longitude [degree], height [m]; ``features``: spectral ranges that all materials
    cover; ``window``: wavelengths of the textures' pictures [nm]. A texture map is written for every record
    with a ``texture``.
    """
    location = "".join(
        f"      <{key}>{value:.10f}</{key}>\n" for key, value in zip(_ORIGIN, origin, strict=True)
    )
    maps = "".join(_texture_map(record, window) for record in records if record.get("texture"))
    return f"""<classicscene name={quoteattr(title)}>

  <metadata>
    <entry>
      <name>Description</name>
      <value>{escape(title)}, written by hyperpaint</value>
    </entry>
  </metadata>

  <sceneorigin>
    <location frame="geodetic">
{location}    </location>
  </sceneorigin>

  <properties features="{features}" mingsd="0" maxgsd="0"/>

  <odbdirectory>$SCENE_DIR/geometry</odbdirectory>
  <gdbdirectory>$SCENE_DIR/geometry</gdbdirectory>
  <geometrylist enabled="true">
    <geometrylistinclude name={quoteattr(title)} enabled="true">lists/{stem}.glist</geometrylistinclude>
  </geometrylist>

  <matfilename>$SCENE_DIR/materials/{stem}.mat</matfilename>
  <emsdirectory>$SCENE_DIR/materials/</emsdirectory>

  <mapdirectory>$SCENE_DIR/maps</mapdirectory>
  <maplist>
{maps}  </maplist>
</classicscene>
"""


def _texture_map(record: Mapping[str, Any], window: tuple[float, float]) -> str:
    low, high = (f"{nm / 1000.0:.4g}" for nm in window)
    return f"""    <texturemap name={quoteattr("population of " + record["name"])} enabled="true">
      <matidlist>
        <matid>{record["id"]}</matid>
      </matidlist>
      <projector origin="cartesian" flipx="false" flipy="false" extendx="mirror" extendy="mirror" >
        <uvprojector/>
      </projector>
      <bandlist>
        <band>
          <bandpass>
            <min>{low}</min>
            <max>{high}</max>
          </bandpass>
          <image>
            <filename>{record["texture"]}</filename>
          </image>
        </band>
      </bandlist>
    </texturemap>
"""


def simulation_text(stem: str) -> str:
    """Return a ``.jsim`` file of the scene, to which users add atmosphere and platform."""
    return json.dumps([{"scene_list": [{"inputs": f"./{stem}.scene"}], "plugin_list": []}], indent=4) + "\n"


def scene_readme_text(
    title: str, stem: str, records: Sequence[Mapping[str, Any]], attrs: Mapping[str, Any]
) -> str:
    """Return the README: the files, how to run them, and which constructs were checked."""
    (low, high), (window_start, window_end) = attrs["coverage_nm"], attrs["window_nm"]
    north, east, height = attrs["origin"]
    return f"""{title}: a scene for DIRSIG
{"=" * (len(title) + 20)}

Written by hyperpaint. Materials cover {low:g} to {high:g} nm in common: features "{attrs["features"]}".

Files
-----
{stem}.scene
    the scene: origin, directories, texture maps
{stem}.jsim
    a simulation of it, to be completed
geometry/lists/{stem}.glist
    the geometry list
geometry/objects/{stem}.obj, {stem}.mtl
    {attrs["faces"]} triangles in metres, x east, y north, z up; usemtl names IDs of materials;
    colours for other programs
materials/{stem}.mat
    {len(records)} materials
materials/emissivity/<ID>.ems, materials/reflectance/<ID>.txt
    their curves, and the centre of each
materials/brdf/<ID>.fit
    the coats, where they are a BRDF
maps/<ID>.pgm
    a picture of every population of several curves
paints.json
    names, ranges and counts

Running it
----------
1. scene2hdf {stem}.scene
2. Put a platform and an atmosphere into the "plugin_list" of {stem}.jsim, such as
   {{"name": "BasicAtmosphere", "inputs": {{"atmosphere_filename": "./my.atm"}}}}, and run dirsig5 with it.
   The sensor's bands must lie inside the range above.
3. The origin is latitude {north:g}, longitude {east:g}, height {height:g} m: change it in {stem}.scene.

Populations
-----------
A material of several curves has a texture map. Its picture holds every curve equally often, as far as its
256 levels tell them apart, and repeats, mirrored, every {attrs["texture_m"]:g} m. DIRSIG gives a pixel the
curve whose mean over {window_start:g} to {window_end:g} nm has the standard score of the pixel's brightness.

Clear coats
-----------
{attrs["coat_advice"]}
Flakes are not in these files.

Checked against
---------------
{_CHECKED}
Not checked
-----------
{_UNCHECKED}
Materials
---------
{_materials(records)}
"""


_CHECKED = """\
construct                                          manual page, or file of a real scene
.scene: classicscene, sceneorigin, properties,     docs/new/scene.html; tahoe.scene [1]
  directories, matfilename, geometrylistinclude
texturemap: matidlist, projector, uvprojector,     docs/new/maps.html; tahoe.scene [1]
  bandlist, bandpass [micrometre], image, .pgm
how a texture chooses curves (standard scores)     docs/manual/propertymapping-tutorial.html
.glist: geometrylist, object, basegeometry, obj,   docs/new/glist.html; terrain.glist [1]
  filename, staticinstance
.jsim: scene_list, plugin_list                     docs/new/jsim.html
scene2hdf                                          docs/new/scene2hdf.html
.mat: MATERIAL_ENTRY, Classic, ClassicEmissivity,  docs/new/mat.html; tahoe.mat [1]; anadirsig.mat [2]
  FILENAME, SPECULAR_FRACTION
.ems: CURVE_BEGIN, several curves                  docs/new/ems.html; ideal_mat_1.ems [2]
which models vary with wavelength                  docs/new/surface_props.html
OBJ: usemtl names IDs, vt, vn, triangles           docs/new/obj.html; dirsig.blogspot.com/2010/10 (using
                                                     OBJ for scene geometry); demo VertexNormals2
ShellTarget: EMISSIVITY_FILE, BRDF_FIT_FILE;       two readers of RIT's own files: scene_coverage.py [1], and
  FIT_PARAMS, LAMBDA [micrometre], N, K, DHR,        the car example of an fVDB toolbox, which renders the
  BIAS, SIGMA [rad], TAU, OMEGA [degree], RHO_D,     demo VertexNormals2 (loader.py, radiometry.py, after
  RHO_V                                              Westlund and Meyer 2002)
Generic solver and its keys                        hypersonic.mat [1]

Pages are those of https://dirsig.cis.rit.edu, docs/manual of http://www.dirsig.org.
[1] RIT's Lake Tahoe scene, as kept in github.com/KevinKearney/protoDIRSIG, config_repo and
manifold_config_repo. [2] github.com/Rendered-ai/dirsig-channel.
"""

_UNCHECKED = """\
* DIRSIG itself has not run these files.
* That SPECULAR_FRACTION is the specular share of reflectance: taken from its name.
* Shell Target: no .mat or .fit with it was at hand, only programs that read them, which say nothing of other
  keys it may need (demo Brdf1 speaks of an interpolation "method"), nor whether DHR is of the whole surface,
  as here, or of its first term alone.
* Other coats: the Ward BRDF is the same at all wavelengths (surface_props.html) and would take the paint its
  colour; no keys of PriestGermer were seen.
* Words of properties/features other than vis, nir, swir, sources, exoatm; what mingsd and maxgsd of 0 mean.
* Temperatures: there is no thermal solver, so that only reflected light means anything.
"""


def _materials(records: Sequence[Mapping[str, Any]]) -> str:
    width = max(2, *(len(record["id"]) for record in records))
    head = f"{'ID':<{width}}  {'range [nm]':>17}  curves  complete  thinned  specular  texture"
    rows = [
        f"{record['id']:<{width}}  {record['wavelength'][0]:8.2f} {record['wavelength'][1]:8.2f}  "
        f"{record['curves']:6d}  {record['complete']:8d}  {record['thinned']:7d}  "
        f"{record['specular_fraction']:8.4f}  {record.get('texture') or 'no'}"
        for record in records
    ]
    return "\n".join([head, *rows])
