"""Scenes of triangles as DIRSIG files: geometry, materials with populations, texture maps, lists."""

from __future__ import annotations

import json
import os
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from hyperpaint.base.arrays import Array
from hyperpaint.base.errors import Problem, Problems, SchemaError
from hyperpaint.base.facts import documented, is_number
from hyperpaint.base.mirrored_light import EXCLUDED, INCLUDED, mirror_reflection
from hyperpaint.base.schema import LIBRARY_VARIABLES, SIGNATURE, require
from hyperpaint.base.units import takes_quantities

from .dirsig_files import Material, Section, material_ids, materials_text, plain_name, read_emissivity
from .dirsig_writing import (
    EMISSIVITY,
    FORMAT,
    MARKER,
    REFLECTANCE,
    TEXTS,
    PaintCurves,
    export_folder,
    material_section,
    paint_records,
    summary_of,
    write_spectra,
    write_texts,
)

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
    scene: Any,
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
        A scene of `hyperpaint.simulation`, or an object with its ``name``; ``vertices`` (vertex, 3) [m], x
        east, y north, z up, and their ``normals`` (vertex, 3), zero for flat faces; ``faces`` (face, 3),
        ``face_material`` and ``face_instance`` (face,), indices of its ``materials`` and ``instances``.
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
    place = np.asarray(origin, np.float64)
    is_place = place.shape == (3,) and np.isfinite(place).all() and (abs(place[:2]) <= [90.0, 360.0]).all()
    problems.extend(
        Problem(found, expected=expected, code="value-out-of-range")
        for is_right, found, expected in (
            (
                isinstance(max_curves, int) and max_curves >= 1,
                f"max_curves={max_curves!r}",
                "a whole number above 0",
            ),
            (
                is_number(texture_m) and 1e-3 <= texture_m <= 1e4,
                f"texture_m={texture_m!r}",
                "0.001 to 10000 m",
            ),
            (is_place, f"origin={origin!r}", "latitude and longitude [degree] and height [m]"),
        )
        if not is_right
    )
    problems.raise_if_any()
    for library in libraries:
        require(library, ["reflectance", "wavelength"], "a DIRSIG scene", LIBRARY_VARIABLES)
    surfaces, face_surface = _surfaces(scene, dict(repaint or {}), with_roughness=coat_brdf)
    surfaces_of = _by_library(libraries, surfaces)
    options = {
        "wavelength_range": wavelength_range,
        "extrapolate": extrapolate,
        "gaps": gaps,
        "max_curves": max_curves,
    }
    title = scene.name or "scene"
    stem = material_ids([title])[0]
    with export_folder(folder, overwrite=overwrite, inside=_FOLDERS) as build:
        records = _write_materials(
            build / "materials",
            libraries,
            surfaces_of,
            surfaces,
            options,
            coat_brdf=coat_brdf,
            progress=progress,
        )
        records.sort(key=lambda record: record["surface"])
        for record in records:
            record["faces"] = int((face_surface == record.pop("surface")).sum())
        attrs = _attrs(scene, records, origin, texture_m)
        low, high = attrs["window_nm"]
        grid = np.linspace(low, high, 301)
        for record in records:
            record["texture"] = ""
            if record["curves"] > 1:
                # mean reflectance of every curve over the window
                curves = read_emissivity(build / "materials" / record["emissivity_file"]).curves
                levels = (np.interp(grid, one.wavelength * 1000.0, one.emissivity).mean() for one in curves)
                picture = texture_picture(np.array([float(1.0 - level) for level in levels]), record["id"])
                if picture is not None:
                    record["texture"] = f"{record['id']}.pgm"
                    head = f"P5\n{picture.shape[1]} {picture.shape[0]}\n255\n".encode()
                    (build / "maps" / record["texture"]).write_bytes(head + picture.tobytes())
        with open(build / f"geometry/objects/{stem}.obj", "w", encoding="ascii", newline="\n") as file:
            identifiers = [record["id"] for record in records]
            for line in obj_lines(scene, identifiers, face_surface, f"{stem}.mtl", texture_m):
                file.write(line + "\n")
        width = max(2, *(len(record["id"]) for record in records))
        content = {"title": title, "stem": stem, "paints": records, "about": attrs, "width": width}
        marker = {"format": FORMAT, "version": 1, **attrs, "paints": records}
        simulation = [{"scene_list": [{"inputs": f"./{stem}.scene"}], "plugin_list": []}]
        templates = {
            f"{stem}.scene": "scene.scene.j2",
            f"geometry/lists/{stem}.glist": "scene.glist.j2",
            f"geometry/objects/{stem}.mtl": "scene.mtl.j2",
            "README.txt": "scene_readme.txt.j2",
        }
        texts = {name: TEXTS.get_template(template).render(content) for name, template in templates.items()}
        texts[f"materials/{stem}.mat"] = materials_text(
            material_section(
                record,
                surface="ShellTarget" if record["fit_file"] else "ClassicEmissivity",
                rad_solver="Generic" if record["fit_file"] else "Classic",
                thermal=None,
                double_sided=True,
            )
            for record in records
        )
        # users add atmosphere and platform to the simulation
        texts[f"{stem}.jsim"] = json.dumps(simulation, indent=4) + "\n"
        texts[MARKER] = json.dumps(marker, indent=1) + "\n"
        write_texts(build, texts)
    numbers = dict.fromkeys(("curves", "complete", "thinned", "faces", "interpolated"), np.int64)
    attrs = {"name": title, **attrs, "folder": os.fspath(folder)}
    return summary_of(records, "DIRSIG scene", attrs, **numbers, texture=object)


_FOLDERS = (
    "geometry/lists",
    "geometry/objects",
    f"materials/{EMISSIVITY}",
    f"materials/{REFLECTANCE}",
    "materials/brdf",
    "maps",
)


def _surfaces(
    scene: Any, repaint: dict[str, str], *, with_roughness: bool
) -> tuple[list[_Surface], NDArray[np.int64]]:
    # Distinct surfaces, and the index of the surface of every face (face,)
    problems = Problems("the scene cannot be painted", SchemaError)
    materials, instances = scene.materials, scene.instances
    names = {item.name for item in (*materials, *instances)}
    names |= {material.spectrum for material in materials}
    problems.extend(
        Problem(
            f"repaint[{key!r}]: the scene has no instance, material or spectrum of this name",
            code="key-unknown",
        )
        for key in repaint.keys() - names
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
    options: Mapping[str, Any],
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
        specular = "library" if _SPECULAR in coated.variables else 0.0
        paint_curves = PaintCurves(coated, specular, curves=curves, **options)
        write_spectra(paint_curves, build, library_records, None)
        for record, number in zip(library_records, numbers, strict=True):
            record |= {
                "surface": number,
                "mirror_reflection": EXCLUDED if is_body else paint_curves.mirror_reflection,
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
    scene: Any, records: Sequence[Mapping[str, Any]], origin: Sequence[float], texture_m: float
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


#: Side of a texture's picture [pixel].
PICTURE_PX = 128

_GRAIN_PX = 3.0  # standard deviation of the Gaussian blur of the noise in a picture


def obj_lines(
    scene: Any, material_id: Sequence[str], face_id: NDArray[np.int64], library: str, texture_m: float
) -> Iterator[str]:
    # Yield the lines of a scene as Wavefront OBJ, one object per instance.
    # ``face_id`` (face,): index of the face's material in ``material_id``; ``library``: the ``.mtl`` file.
    # Texture coordinates are in units of ``texture_m``, in the coordinate plane that is most parallel to the
    # face, so that a picture has a similar size on all faces.
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
    # reflectance for unpolarised light
    cos_air, cos_coat = np.cos(tilt), np.sqrt(1.0 - (np.sin(tilt) / index) ** 2)
    s_wave = (cos_air - index * cos_coat) / (cos_air + index * cos_coat)
    p_wave = (index * cos_air - cos_coat) / (index * cos_air + cos_coat)
    fresnel = 0.5 * (s_wave**2 + p_wave**2)
    lobe = np.exp(-((tilt / sigma) ** 2)) * np.cos(tilt) ** 2 * shadow * fresnel / normal
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
