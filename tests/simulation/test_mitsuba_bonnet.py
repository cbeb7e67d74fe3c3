"""A bonnet under a sun with a disc and a sky that is brighter at the zenith, against Mitsuba 3.

Mitsuba's sky is an environment map, its sun a disc far away; it sees no other part of the package than the
triangles. Its coat is ``plastic`` (a smooth dielectric over a diffuse base, light within summed up as here)
or, where the size of a glint counts, ``roughplastic`` with the GGX alpha of the coat.
"""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hyperpaint as hp
from hyperpaint.simulation.rendering.appearance import gloss_units
from hyperpaint.simulation.rendering.camera_bands import BandSet
from hyperpaint.simulation.rendering.four_curves import Atmosphere
from hyperpaint.simulation.rendering.materials import Coat, Material, base_albedo
from hyperpaint.simulation.rendering.platform_geometry import matrices, quaternions
from hyperpaint.simulation.rendering.platforms import Platform
from hyperpaint.simulation.rendering.scene import Scene, plane
from hyperpaint.simulation.rendering.scene_record import sun_vectors

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        importlib.util.find_spec("mitsuba") is None, reason="Mitsuba is not installed (extra oracles)"
    ),
]

SUN, SKY, SUN_RADIUS_DEG = 1.0, 0.35, 0.267
ZENITH, AZIMUTH = 40.0, 240.0
HEIGHT, FIELD_DEG, PIXELS = 8.0, 12.0, 40
PAINT, GROUND = 0.2, 0.3
CROWN, HALF, STEPS = 2.0, 0.8, 96  # radius of the bonnet, half of its sides [m], cells

WORKER = """
import json, sys
import mitsuba, numpy
mitsuba.set_variant("scalar_rgb")
T = mitsuba.ScalarTransform4f
with open("scene.json") as file:
    said = json.load(file)
towards = numpy.array(said["towards"])
distance, radius = 1e4, numpy.radians(said["radius"])
sky = numpy.zeros((256, 8, 3), numpy.float32)
zenith = (numpy.arange(256) + 0.5) / 256 * numpy.pi
sky[:] = (said["sky"] / numpy.pi * 1.5 * numpy.clip(numpy.cos(zenith), 0, None))[:, None, None]
grey = lambda value: {"type": "rgb", "value": [value] * 3}
scene = {
    "type": "scene",
    "integrator": {"type": "path", "max_depth": said["depth"] + 1, "rr_depth": 1000},
    "sensor": {
        "type": "perspective", "fov": said["field"], "fov_axis": "x", "near_clip": 1e-3, "far_clip": 1e6,
        "to_world": T().look_at(origin=[0, 0, said["height"]], target=[0, 0, 0], up=[0, 1, 0]),
        "film": {"type": "hdrfilm", "width": said["pixels"], "height": said["pixels"],
                 "crop_offset_x": said["first"][1], "crop_offset_y": said["first"][0],
                 "crop_width": said["size"], "crop_height": said["size"],
                 "component_format": "float32", "pixel_format": "luminance", "rfilter": {"type": "box"}},
        "sampler": {"type": "independent", "sample_count": said["samples"]},
    },
    "sky": {"type": "envmap", "bitmap": mitsuba.Bitmap(sky), "to_world": T().rotate([1, 0, 0], 90)},
    "sun": {
        "type": "disk",
        "to_world": T().look_at(origin=list(distance * towards), target=[0, 0, 0], up=[0, 0.1, 1])
        @ T().scale([float(distance * numpy.tan(radius))] * 3),
        "emitter": {"type": "area",
                    "radiance": grey(said["sun"] / (numpy.pi * numpy.sin(radius) ** 2))},
    },
}
for name, surface in said["surfaces"].items():
    for key in ("reflectance", "diffuse_reflectance"):
        if key in surface:
            surface[key] = grey(surface[key])
    scene["mesh of " + name] = {
        "type": "ply", "filename": name + ".ply", "surface": {"type": "twosided", "inner": surface}
    }
numpy.save("image.npy", mitsuba.render(mitsuba.load_dict(scene), seed=1))
"""


def bonnet(coat: Coat | None) -> Scene:
    """Return a panel with a crown, and the ground below."""
    side = np.linspace(-HALF, HALF, STEPS + 1)
    x, y = np.meshgrid(side, side, indexing="ij")
    z = np.sqrt(CROWN**2 - x**2 - y**2) - CROWN
    points = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    k = np.arange(STEPS)
    first = (k[:, None] * (STEPS + 1) + k).reshape(-1, 1)
    cells = np.array([[0, STEPS + 1, STEPS + 2], [0, STEPS + 2, 1]])
    faces = (first[:, None] + cells).reshape(-1, 3)
    normals = (points + np.array([0.0, 0.0, CROWN])) / CROWN
    paint = Material("paint", "paint", "paint", coat)
    return Scene.join(
        [
            Scene.from_arrays(points, faces, paint, normals=normals, instance="bonnet"),
            plane(1e3, Material("ground", "ground", "concrete"), centre=(0.0, 0.0, -0.8)),
        ],
        "bonnet",
    )


Window = tuple[tuple[int, int], int]
WHOLE: Window = ((0, 0), PIXELS)


def our_image(scene: Scene, samples: int, depth: int, window: Window = WHOLE) -> np.ndarray:
    """Return radiance (row, column) of a window (first row and column, size), north up."""
    wavelength = np.linspace(400.0, 900.0, 3)
    none = np.zeros(3)
    sky = Atmosphere(
        wavelength, none + SUN, none + SKY, none, none, ZENITH, AZIMUTH, overcast_share=1.0, name="both"
    )
    half = np.tan(np.radians(FIELD_DEG / 2))
    edges = np.linspace(-half, half, PIXELS + 1)
    down = np.broadcast_to(matrices(quaternions(0.0, 0.0, 0.0)), (1, 2, 3, 3))
    origin = np.broadcast_to(np.array([0.0, 0.0, HEIGHT]), (1, 2, 3))
    bands = BandSet(np.array([650.0]), np.array(6.0))
    spectra = {name: ([400.0, 900.0], [level] * 2) for name, level in (("paint", PAINT), ("ground", GROUND))}
    rows = []
    (top, left), size = window
    for row in range(top, top + size):
        columns = edges[left : left + size + 1]
        still = Platform(origin, down, columns, edges[[PIXELS - 1 - row, PIXELS - row]], np.arange(1))
        traced = hp.simulation.trace(
            scene, still, [sky], samples=samples, depth=depth, seed=row, slots=64, sun_radius=SUN_RADIUS_DEG
        )
        line = hp.simulation.relight(traced, bands, atmosphere=sky, spectra=spectra, truth=False)
        rows.append(line.radiance.values[0, 0])
    return np.array(rows, np.float64)


def their_image(
    scene: Scene, surface: dict[str, Any], folder: Path, samples: int, depth: int, window: Window = WHOLE
) -> np.ndarray:
    """Return what Mitsuba makes of the same triangles, (row, column)."""
    from oracles.mitsuba_scenes import write_mesh

    for number, material in enumerate(scene.materials):
        write_mesh(scene, number, folder / f"{material.name}.ply")
    (towards,) = sun_vectors([(ZENITH, AZIMUTH)])
    said = {
        "towards": towards.tolist(), "sun": SUN, "sky": SKY, "radius": SUN_RADIUS_DEG, "height": HEIGHT,
        "field": FIELD_DEG, "pixels": PIXELS, "samples": samples, "depth": depth,
        "first": window[0], "size": window[1],
        "surfaces": {"paint": surface, "ground": {"type": "diffuse", "reflectance": GROUND}},
    }  # fmt: skip
    (folder / "scene.json").write_text(json.dumps(said))
    done = subprocess.run(
        [sys.executable, "-c", WORKER], cwd=folder, capture_output=True, text=True, timeout=500, check=False
    )
    assert done.returncode == 0, done.stderr
    return np.load(folder / "image.npy").astype(np.float64)[..., 0]


def plastic(coat: Coat, **more: Any) -> dict[str, Any]:
    albedo = float(base_albedo(PAINT, coat.index))
    return {
        "type": "plastic", "int_ior": coat.index, "ext_ior": 1.0, "nonlinear": True,
        "diffuse_reflectance": albedo, **more,
    }  # fmt: skip


def on_panel() -> np.ndarray:
    """Return which pixels see the bonnet and nothing else."""
    place = (np.arange(PIXELS) + 0.5 - PIXELS / 2) * 2 * HEIGHT * np.tan(np.radians(FIELD_DEG / 2)) / PIXELS
    return (np.abs(place)[:, None] < HALF - 0.1) & (np.abs(place)[None] < HALF - 0.1)


def test_a_solid_bonnet(tmp_path: Path) -> None:
    scene = bonnet(None)
    ours = our_image(scene, 256, 3)
    theirs = their_image(scene, {"type": "diffuse", "reflectance": PAINT}, tmp_path, 1024, 3)
    assert ours.mean() / theirs.mean() == pytest.approx(1.0, abs=0.01)
    panel = on_panel()
    assert ours[panel].mean() / theirs[panel].mean() == pytest.approx(1.0, abs=0.005)
    # nothing is turned about: rows and columns agree, and vary
    for axis in (0, 1):
        np.testing.assert_allclose(ours.mean(axis=axis), theirs.mean(axis=axis), rtol=0.03)


def around_the_glint(image: np.ndarray, size: int) -> Window:
    row, column = np.unravel_index(image.argmax(), image.shape)
    return (int(row) - size // 2, int(column) - size // 2), size


def test_a_coated_bonnet(tmp_path: Path) -> None:
    """The sky in the coat, the paint below; of the glint next."""
    coat = Coat(1.5, 0.0, 0.0)
    scene = bonnet(coat)
    ours, theirs = our_image(scene, 512, 3), their_image(scene, plastic(coat), tmp_path, 2048, 3)
    (top, left), size = around_the_glint(ours, 7)
    rest = np.ones(ours.shape, bool)
    rest[top : top + size, left : left + size] = False  # Mitsuba's mirrors meet the sun by chance alone
    for away in (rest, rest & on_panel()):
        assert ours[away].mean() / theirs[away].mean() == pytest.approx(1.0, abs=0.01)


def test_the_glint_of_a_coat_of_80_units(tmp_path: Path) -> None:
    coat = Coat(1.5, 1e-3, 0.0)
    assert gloss_units(coat) >= 80.0
    scene = bonnet(coat)
    rough = plastic(coat, type="roughplastic", distribution="ggx", alpha=coat.roughness)
    window = around_the_glint(our_image(scene, 64, 1), 3)
    ours = our_image(scene, 16384, 1, window)
    theirs = their_image(scene, rough, tmp_path, 2**20, 1, window)  # fewer leave more than 3 % of noise
    assert theirs[1, 1] == theirs.max() > 100 * np.median(theirs)
    assert ours[1, 1] / theirs[1, 1] == pytest.approx(1.0, abs=0.03)
    assert ours.mean() / theirs.mean() == pytest.approx(1.0, abs=0.03)
