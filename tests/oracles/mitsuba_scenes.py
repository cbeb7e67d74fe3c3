"""Scenes for Mitsuba 3: an independent renderer to check against, and a way to richer surfaces and media.

`to_mitsuba` returns the dictionary that ``mitsuba.load_dict`` takes. Every material of the scene is an entry
of its own, named as in the scene, so that it can be replaced by any of Mitsuba's surfaces before loading.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from hyperpaint.base.errors import MissingExtraError, PaintWarning, Problems, SchemaError
from hyperpaint.base.schema import Floats
from hyperpaint.simulation.camera import BandSet
from hyperpaint.simulation.rendering.materials import internal_reflectance
from hyperpaint.simulation.rendering.relighting import factor_spectra
from hyperpaint.simulation.rendering.scene import SceneRecord, sun_vectors

if TYPE_CHECKING:
    from hyperpaint.simulation.atmosphere import Atmosphere
    from hyperpaint.simulation.rendering.materials import Material
    from hyperpaint.simulation.rendering.scene import Scene

__all__ = ["FrameCamera", "to_mitsuba", "write_mesh"]


_SMOOTH = 0.02  # GGX alpha up to which a coat becomes a mirror
_REACH = 2.0  # full widths at half maximum; beyond them lies 2.5e-6 of a Gaussian's area
_STEPS = 24  # samples of a response in a full width
_SPECTRUM_STEP = 1.0  # nm between samples of reflectance
_RESERVED = {"type", "integrator", "sensor", "sun", "sky"}


@dataclass(frozen=True)
class FrameCamera:
    """A pinhole camera that takes a whole frame at once.

    Attributes
    ----------
    position, target
        Where it is and what it looks at: east, north, up [m].
    up
        What is up in the image; north for a camera that looks straight down.
    field_of_view
        Full angle across the columns [degree].
    rows, columns
        Size of the image; pixels are square.
    """

    position: tuple[float, float, float] = (0.0, 0.0, 50.0)
    target: tuple[float, float, float] = (0.0, 0.0, 0.0)
    up: tuple[float, float, float] = (0.0, 1.0, 0.0)
    field_of_view: float = 40.0
    rows: int = 256
    columns: int = 256


def to_mitsuba(
    scene: Scene,
    atmosphere: Atmosphere,
    folder: str | Path,
    *,
    wavelength: ArrayLike,
    fwhm: float = 6.0,
    camera: FrameCamera | None = None,
    paints: Mapping[str, Any] | None = None,
    spectra: Mapping[str, Any] | None = None,
    depth: int = 4,
    samples: int = 64,
) -> dict[str, Any]:
    """Return a scene as the dictionary that ``mitsuba.load_dict`` takes.

    Parameters
    ----------
    scene
        What is seen. Its triangles are written into `folder`, one PLY file a material.
    atmosphere
        The light: sun infinitely far away, sky equally bright everywhere.
    folder
        Where the meshes go; made where it is absent, and read when the dictionary is loaded.
    wavelength
        Centres of the bands, shape (band,) [nm].
    fwhm
        Full width of their Gaussian responses [nm].
    camera
        What looks at the scene; `FrameCamera` with its defaults unless given.
    paints, spectra
        Other spectra for paints, and spectra by name beside the built-in ones, as `relight` takes them.
    depth
        Number of scatterings.
    samples
        Paths a pixel.

    Returns
    -------
    dict
        ``integrator``, ``sensor``, ``sun`` and ``sky`` (where there is light), every material, and every mesh
        as "mesh of MATERIAL". ``mitsuba.render`` of it has shape (row, column, band): means over the bands of
        radiance [W m-2 sr-1 nm-1].

    Raises
    ------
    MissingExtraError
        Mitsuba is not installed.
    SchemaError
        No spectral variant of Mitsuba is set; bands, depth or samples are unusable; a spectrum is unknown, or
        does not cover the bands; a material has a name that Mitsuba cannot take. All are listed.

    Warns
    -----
    PaintWarning
        What Mitsuba cannot do as the scene has it: metal flakes, and a sky that is not uniform.

    Notes
    -----
    The same in both are Lambert surfaces, and a smooth coat over a Lambert base (Mitsuba's ``plastic``, for
    a roughness up to 0.02). A rougher coat becomes ``roughplastic``, which loses some per cent of the light.
    Metal flakes become a share of a rough conductor beside the coated base, not under it. The air is left
    out: from below a hundred metres it takes less than 2 %.

    Mitsuba draws four wavelengths a ray, for the whole film. Four bands are therefore free of colour noise;
    hundreds are better rendered four at a time.

    Examples
    --------
    >>> import mitsuba  # doctest: +SKIP
    >>> mitsuba.set_variant("scalar_spectral")  # doctest: +SKIP
    >>> described = to_mitsuba(park, noon, "meshes", wavelength=[450, 550, 650])  # doctest: +SKIP
    >>> described["glass"] = {"type": "roughdielectric", "alpha": 0.1}  # doctest: +SKIP
    >>> image = mitsuba.render(mitsuba.load_dict(described))  # doctest: +SKIP
    """
    mitsuba = _spectral_mitsuba()
    centres = np.atleast_1d(np.asarray(wavelength, np.float64))
    _check(scene, centres, fwhm, depth, samples)
    _warn(scene, atmosphere)
    bands = BandSet(centres, np.full(centres.shape, fwhm))
    low, high = centres[0] - _REACH * fwhm, centres[-1] + _REACH * fwhm
    grid = np.linspace(low, high, int((high - low) / _SPECTRUM_STEP) + 2)
    record = SceneRecord.of(scene)
    factors = factor_spectra(record, bands, paints, spectra)(grid)
    described: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": depth + 1, "rr_depth": 1000},
        "sensor": _sensor(mitsuba, camera or FrameCamera(), bands, samples),
        **_emitters(atmosphere, low, high),
    }
    for number, material in enumerate(scene.materials):
        of_flakes = [i for i, one in enumerate(record.factors) if one.material == number and one.flakes]
        flakes = _irregular(grid, factors[of_flakes[0]]) if of_flakes else None
        described[material.name] = _surface(material, grid, factors[number], flakes)
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for number in np.unique(scene.face_material):
        path = folder / f"material_{number:04d}.ply"
        write_mesh(scene, int(number), path)
        name = scene.materials[number].name
        described[f"mesh of {name}"] = {
            "type": "ply",
            "filename": str(path),
            "surface": {"type": "ref", "id": name},
        }
    return described


def _spectral_mitsuba() -> Any:
    # Return the module, with a variant in which spectra are spectra
    try:
        import mitsuba
    except ImportError as error:
        raise MissingExtraError.of("mitsuba", "oracles", "describing a scene to Mitsuba") from error
    variant = mitsuba.variant()
    if variant is None or "spectral" not in variant:
        raise SchemaError(
            f"the variant of Mitsuba is {variant}",
            expected="a spectral one",
            mend="call mitsuba.set_variant('scalar_spectral') first",
            code="variant-unsuitable",
        )
    return mitsuba


def _check(scene: Scene, centres: Floats, fwhm: float, depth: int, samples: int) -> None:
    problems = Problems(f"scene {scene.name!r} cannot be described to Mitsuba", SchemaError)
    if not (np.isfinite(centres).all() and (np.diff(centres) > 0).all()) or centres.ndim != 1:
        problems.add("wavelength is not finite and increasing", code="wavelength-unordered")
    if not 0.0 < fwhm < np.inf:
        problems.add(f"fwhm is {fwhm}", expected="a width above 0 nm", code="value-out-of-range")
    for name, value in (("depth", depth), ("samples", samples)):
        if value < 1:
            problems.add(f"{name}={value}", expected="at least 1", code="value-out-of-range")
    for material in scene.materials:
        if "." in material.name or material.name in _RESERVED:
            problems.add(
                f"Mitsuba reserves the name of material {material.name!r}",
                mend="rename it",
                code="name-reserved",
            )
    problems.raise_if_any()


def _warn(scene: Scene, atmosphere: Atmosphere) -> None:
    if (atmosphere.uniform < 1.0 - 1e-9).any():
        msg = (
            "Mitsuba's sky is uniform, this one is not; level surfaces get the same light from both, walls "
            "and mirrors do not"
        )
        warnings.warn(PaintWarning(msg, code="sky-uniform"), stacklevel=3)
    if any(material.flakes is not None for material in scene.materials):
        msg = "Mitsuba has no metal flakes under a coat; they become a share of rough metal beside it"
        warnings.warn(PaintWarning(msg, code="flakes-as-metal"), stacklevel=3)


def _emitters(atmosphere: Atmosphere, low: float, high: float) -> dict[str, Any]:
    # Return sun and sky between two wavelengths
    grid = atmosphere.wavelength
    here = slice(max(np.searchsorted(grid, low) - 1, 0), np.searchsorted(grid, high) + 1)
    (towards,) = sun_vectors([(atmosphere.sun_zenith, atmosphere.sun_azimuth)])
    emitters = {
        "sun": {
            "type": "directional",
            "direction": (-towards).tolist(),
            "irradiance": _irregular(grid[here], atmosphere.sun[here]),
        },
        "sky": {"type": "constant", "radiance": _irregular(grid[here], atmosphere.sky[here] / np.pi)},
    }
    # a spectrum without light is an error in Mitsuba
    lit = {"sun": atmosphere.sun[here].any(), "sky": atmosphere.sky[here].any()}
    return {name: emitter for name, emitter in emitters.items() if lit[name]}


def _irregular(wavelength: Floats, values: Floats) -> dict[str, str]:
    # Return a spectrum of samples, linear between them and zero outside
    return {
        "type": "irregular",
        "wavelengths": ", ".join(f"{x:.9g}" for x in wavelength),
        "values": ", ".join(f"{y:.9g}" for y in values),
    }


def _sensor(mitsuba: Any, camera: FrameCamera, bands: BandSet, samples: int) -> dict[str, Any]:
    film: dict[str, Any] = {
        "type": "specfilm",
        "width": camera.columns,
        "height": camera.rows,
        "component_format": "float32",
        "rfilter": {"type": "box"},
    }
    offset = np.linspace(-_REACH, _REACH, round(2 * _REACH * _STEPS) + 1)
    response = np.exp(-4.0 * np.log(2.0) * offset**2)
    response /= np.trapezoid(response, offset)
    for number, (centre, fwhm) in enumerate(zip(bands.wavelength, bands.fwhm, strict=True)):
        # the film sorts its bands by name, and integrates over responses: of area 1, it takes means
        film[f"band_{number:05d}"] = _irregular(centre + offset * fwhm, response / fwhm)
    return {
        "type": "perspective",
        "fov": camera.field_of_view,
        "fov_axis": "x",
        "near_clip": 1e-3,
        "far_clip": 1e6,
        "to_world": mitsuba.ScalarTransform4f().look_at(
            origin=list(camera.position), target=list(camera.target), up=list(camera.up)
        ),
        "film": film,
        "sampler": {"type": "independent", "sample_count": samples},
    }


def _surface(
    material: Material, grid: Floats, factor: Floats, flakes: dict[str, str] | None
) -> dict[str, Any]:
    # Return a material as one of Mitsuba's surfaces, seen from both sides
    if material.coat is None:
        return _two_sided({"type": "diffuse", "reflectance": _irregular(grid, factor)})
    index, roughness = material.coat.index, material.coat.roughness
    back = internal_reflectance(index)
    albedo = factor / (1.0 - back + factor * back)  # of the base under the coat
    coated: dict[str, Any] = {
        "type": "plastic",
        "int_ior": index,
        "ext_ior": 1.0,
        "nonlinear": True,
        "diffuse_reflectance": _irregular(grid, albedo),
    }
    if roughness > _SMOOTH:
        coated |= {"type": "roughplastic", "distribution": "ggx", "alpha": roughness}
    if material.flakes is None or flakes is None:
        return _two_sided(coated)
    metal = {
        "type": "roughconductor",
        "material": "none",
        "distribution": "ggx",
        "alpha": material.flakes.roughness,
        "specular_reflectance": flakes,
    }
    return _two_sided({"type": "blendbsdf", "weight": material.flakes.share, "base": coated, "flakes": metal})


def _two_sided(surface: dict[str, Any]) -> dict[str, Any]:
    return {"type": "twosided", "surface": surface}


def write_mesh(scene: Scene, number: int, path: Path) -> None:
    # Write the triangles of one material as a binary PLY file whose corners carry their own normals
    faces = scene.faces[scene.face_material == number]
    corners = scene.vertices[faces]
    normals = scene.normals[faces]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    # a flat corner makes the triangle flat
    smooth = (np.abs(normals).sum(axis=2) > 0.0).all(axis=1)
    normals = np.where(smooth[:, None, None], normals, flat[:, None, :])
    rows = np.concatenate([corners, normals], axis=2).reshape(-1, 6).astype("<f4")
    listed = np.zeros(len(faces), dtype=[("count", "u1"), ("corner", "<i4", 3)])
    listed["count"] = 3
    listed["corner"] = np.arange(3 * len(faces), dtype=np.int32).reshape(-1, 3)
    properties = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{properties}"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    path.write_bytes(header.encode() + rows.tobytes() + listed.tobytes())
