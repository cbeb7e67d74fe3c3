"""Rendered scenes against Mitsuba 3, which shares no line of code with the tracer.

Mitsuba runs in a process of its own: its variant is global, and where it gives up it takes the process along.
The bonnet has a coat, and above it a sun with a disc and a sky that is not even, overcast or clear. Mitsuba's
sky is an environment map there, its sun a disc far away. Its coat is ``plastic`` (a smooth dielectric over a
diffuse base, light within summed up as here) or, where the size of a glint counts, ``roughplastic`` with the
GGX alpha of the coat. Three wavelengths are the three channels of its colours, which nothing mixes."""

import functools
import importlib.util
import json
import pickle
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from oracles.mitsuba_scenes import FrameCamera, write_mesh

import hyperpaint as hp
from hyperpaint.light.sky_functions import functions_towards
from hyperpaint.simulation.atmosphere import Atmosphere
from hyperpaint.simulation.camera import BandSet
from hyperpaint.simulation.rendering.car_parks import car_park
from hyperpaint.simulation.rendering.materials import Coat, Material, base_albedo, gloss_units
from hyperpaint.simulation.rendering.platforms import Platform, matrices
from hyperpaint.simulation.rendering.scene import Scene, box, plane, sun_vectors

# --- mitsuba ---

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("mitsuba") is None, reason="Mitsuba is not installed (extra oracles)"
)

BANDS = BandSet(np.array([450.0, 550.0, 650.0, 850.0]), np.array(6.0))
STRIPS, LINES = 8, 4
WORKER = """
import pickle, sys
sys.path.insert(0, sys.argv[1])
import mitsuba, numpy
mitsuba.set_variant("scalar_spectral")
from oracles.mitsuba_scenes import to_mitsuba
with open("scenes.pickle", "rb") as file:
    scenes = pickle.load(file)
images = {}
for name, (arguments, options) in scenes.items():
    described = to_mitsuba(*arguments, "meshes of " + name, **options)
    images[name] = numpy.array(mitsuba.render(mitsuba.load_dict(described), seed=1))
numpy.savez("images.npz", **images)
"""


def light(sun: float = 1.0, zenith: float = 50.0) -> Atmosphere:
    # Return light without air, of spectra so smooth that means over a band cannot differ
    wavelength = np.linspace(400.0, 900.0, 51)
    slope = (wavelength - 400.0) / 500.0
    none = np.zeros_like(wavelength)
    return Atmosphere(wavelength, sun * (1.0 + 0.3 * slope), 0.5 - 0.3 * slope, none, none, zenith, 240.0)


def our_image(scene: Scene, sky: Atmosphere, camera: FrameCamera, samples: int, depth: int) -> np.ndarray:
    # Return radiance (strip, column, band) of a frame
    # Every strip of rows is the view of a camera that stands still for some lines of other random numbers
    half = np.tan(np.radians(camera.field_of_view / 2))
    across = np.linspace(-half, half, camera.columns + 1)
    along = np.linspace(half, -half, STRIPS + 1) * camera.rows / camera.columns
    origin = np.broadcast_to(np.array(camera.position), (LINES, 2, 3))
    down = np.broadcast_to(matrices(0.0, 0.0, 0.0), (LINES, 2, 3, 3))
    options = {"samples": samples, "depth": depth, "slots": 256, "chunk_lines": 1, "sun_radius": 0.0}
    strips = []
    for strip in range(STRIPS):
        still = Platform(origin, down, across, along[[strip + 1, strip]], np.arange(LINES))
        traced = hp.simulation.trace(scene, still, [sky], seed=strip, **options)
        made = hp.simulation.relight(traced, BANDS, atmosphere=sky, truth=False).radiance.mean("along_track")
        strips.append(made.transpose("cross_track", "band").values)
    return np.stack(strips).astype(np.float64)


GREY = Material("grey", "panel_20", "panel")
GROUND = Material("ground", "concrete", "concrete")
WALL = Material("red wall", "brick", "wall")
ADJACENCY = Scene.join(
    [
        plane(200.0, GROUND),
        plane(3.0, GREY, centre=(0.0, 0.0, 0.01), instance="panel"),
        box((0.2, 4.0, 2.0), WALL, centre=(1.0, 0.5, 0.0), instance="wall"),
    ],
    "adjacency",
)
BESIDE = FrameCamera((0, 0, 10), field_of_view=25.0, rows=32, columns=32)
ABOVE = FrameCamera((0.0, 5.0, 15.0), (0.0, 5.0, 0.0), field_of_view=50.0, rows=32, columns=32)


def car_park_with(coat: Coat | None) -> Scene:
    # Return a car park with another coat on its paints and panes, and none elsewhere
    # Mitsuba's sky is below the horizon as well: the ground goes on until none of it is seen
    country = plane(2e4, GROUND, centre=(0.0, 0.0, -0.02), instance="country")
    park = Scene.join([car_park(length=10.0, width=16.0, neighbours=(), seed=1), country])
    materials = (
        replace(one, coat=coat if one.kind in ("paint", "glass") else None, flakes=None)
        for one in park.materials
    )
    return replace(park, materials=tuple(materials))


#: By name: how to make scene and light, camera, samples of ours and of Mitsuba, bounces. Our plane
#: has no noise; the samples of the others leave less than 0.1 % in a mean. Mitsuba's mirrors never show the
#: sun, which is a point: smooth coats see the sky alone.
SCENES: dict[str, tuple[Callable[[], tuple[Scene, Atmosphere]], FrameCamera, int, int, int]] = {
    "plane": (
        lambda: (plane(200.0, GREY), light()),
        FrameCamera((0, 0, 10), rows=16, columns=16),
        64,
        2048,
        4,
    ),
    "adjacency": (lambda: (ADJACENCY, light()), BESIDE, 256, 1024, 4),
    "lambert park": (lambda: (car_park_with(None), light()), ABOVE, 512, 2048, 4),
    "coated park": (lambda: (car_park_with(Coat(1.5, 0.0)), light(sun=0.0)), ABOVE, 512, 1024, 4),
    "one bounce": (lambda: (car_park_with(Coat(1.5, 0.0)), light(sun=0.0)), ABOVE, 1024, 2048, 1),
}


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    # Return every scene by both renderers, ours first, shape (strip, column, band)
    folder = tmp_path_factory.mktemp("mitsuba")
    made = {name: make() for name, (make, *_) in SCENES.items()}
    jobs = {}
    for name, (_, camera, _, samples, depth) in SCENES.items():
        options = {"wavelength": BANDS.wavelength, "fwhm": 6.0, "camera": camera, "depth": depth}
        jobs[name] = made[name], options | {"samples": samples}
    (folder / "scenes.pickle").write_bytes(pickle.dumps(jobs))
    command = [sys.executable, "-c", WORKER, str(Path(__file__).parents[1])]
    with subprocess.Popen(
        command, cwd=folder, stderr=subprocess.PIPE, text=True
    ) as process:  # meanwhile ours
        ours = {
            name: our_image(*made[name], camera, samples, depth)
            for name, (_, camera, samples, _, depth) in SCENES.items()
        }
        _, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors
    with np.load(folder / "images.npz") as file:
        theirs = {name: image.astype(np.float64) for name, image in file.items()}
    return {
        name: (ours[name], image.reshape(STRIPS, -1, *image.shape[1:]).mean(axis=1))
        for name, image in theirs.items()
    }


@pytest.mark.parametrize("name", SCENES)
def test_means_of_bands_agree(images: dict[str, tuple[np.ndarray, np.ndarray]], name: str) -> None:
    ours, theirs = images[name]
    assert ours.shape == theirs.shape
    np.testing.assert_allclose(ours.mean(axis=(0, 1)) / theirs.mean(axis=(0, 1)), 1.0, atol=0.002)


def test_pixels_agree(images: dict[str, tuple[np.ndarray, np.ndarray]]) -> None:
    ours, _ = images["plane"]
    sky = light()
    known = 0.2 * np.interp(BANDS.wavelength, sky.wavelength, sky.irradiance) / np.pi
    np.testing.assert_allclose(ours, np.broadcast_to(known, ours.shape), rtol=1e-5)
    ours, theirs = images["adjacency"]
    # shadow and reddening lie where they should: rows and columns agree too, and neither is turned about
    for axis in (0, 1):
        np.testing.assert_allclose(ours.mean(axis=axis), theirs.mean(axis=axis), rtol=0.04)
        assert np.abs(ours.mean(axis=axis) / np.flip(theirs.mean(axis=axis), axis=0) - 1.0).max() > 0.2
    ours, theirs = images["lambert park"]
    assert abs(np.median(ours / theirs) - 1.0) < 0.002


# --- mitsuba bonnet ---

SUN_RADIUS_DEG = 0.267
ZENITH, AZIMUTH = 60.0, 232.0  # no symmetry of the bonnet
NM = np.array([455.0, 555.0, 855.0])  # between two points of the light's grid, where it is a straight line
HEIGHT, FIELD_DEG, PIXELS = 8.0, 12.0, 40
PAINT, GROUND_LEVEL = 0.2, 0.3
CROWN, HALF, STEPS = 2.0, 0.8, 48  # radius of the bonnet, half of its sides [m], cells

BONNET_WORKER = """
import json, sys
import mitsuba, numpy
mitsuba.set_variant("scalar_rgb")
T = mitsuba.ScalarTransform4f
with open("scene.json") as file:
    said = json.load(file)
towards = numpy.array(said["towards"])
distance, radius = 1e4, numpy.radians(said["radius"])
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
                 "component_format": "float32", "pixel_format": "rgb", "rfilter": {"type": "box"}},
        "sampler": {"type": "independent", "sample_count": said["samples"]},
    },
    "sky": {"type": "envmap", "bitmap": mitsuba.Bitmap(numpy.load("sky.npy")),
            "to_world": T().rotate([1, 0, 0], 90)},
    "sun": {
        "type": "disk",
        "to_world": T().look_at(origin=list(distance * towards), target=[0, 0, 0], up=[0, 0.1, 1])
        @ T().scale([float(distance * numpy.tan(radius))] * 3),
        "emitter": {"type": "area", "radiance": {
            "type": "rgb", "value": [one / (numpy.pi * numpy.sin(radius) ** 2) for one in said["sun"]]}},
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
    # Return a panel with a crown, and the ground below
    side = np.linspace(-HALF, HALF, STEPS + 1)
    x, y = np.meshgrid(side, side, indexing="ij")
    points = np.stack([x, y, np.sqrt(CROWN**2 - x**2 - y**2) - CROWN], axis=-1).reshape(-1, 3)
    k = np.arange(STEPS)
    cells = np.array([[0, STEPS + 1, STEPS + 2], [0, STEPS + 2, 1]])
    faces = ((k[:, None] * (STEPS + 1) + k).reshape(-1, 1)[:, None] + cells).reshape(-1, 3)
    normals = (points + np.array([0.0, 0.0, CROWN])) / CROWN
    paint = Material("paint", "paint", "paint", coat)
    return Scene.join(
        [
            Scene.from_arrays(points, faces, paint, normals=normals, instance="bonnet"),
            plane(1e3, Material("ground", "ground", "concrete"), centre=(0.0, 0.0, -0.8)),
        ],
        "bonnet",
    )


def overcast_sky() -> Atmosphere:
    # Return a sun in a sky of radiance that goes with the cosine of the zenith angle
    none = np.zeros(3)
    light = np.linspace(400.0, 900.0, 3), none + 1.0, none + 0.35, none, none
    return Atmosphere(*light, ZENITH, AZIMUTH, overcast_share=1.0, name="overcast")


def clear_sky() -> Atmosphere:
    return Atmosphere.clear(ZENITH, AZIMUTH, haze=None, wavelength=np.arange(400.0, 901.0, 10.0))


SKIES = {"overcast": overcast_sky, "clear": clear_sky}


def at_bands(sky: Atmosphere, curve: np.ndarray) -> np.ndarray:
    return np.interp(NM, sky.wavelength, curve)


@functools.cache
def sky_parts() -> tuple[np.ndarray, ...]:
    # Return the sky functions and the overcast one over a uniform sky (row, column), down to the horizon
    # The first row is the zenith, the centres of columns are halves of a step clockwise from north. The last
    # row lies on the horizon, where light ends.
    rows, columns = 257, 1024
    zenith = np.linspace(0.0, 0.5 * np.pi, rows)[:, None]
    azimuth = (np.arange(columns) + 0.5) / columns * 2.0 * np.pi - np.radians(AZIMUTH)
    cosine = np.cos(zenith) + 0.0 * azimuth
    uniform, *clear = functions_towards(ZENITH, np.maximum(cosine, 1e-6), azimuth + 0.0 * zenith)
    return uniform, 1.5 * cosine, *clear


def environment(sky: Atmosphere) -> np.ndarray:
    # Return the radiance of a sky (row, column, band) as Mitsuba lays it out, from the zenith to the nadir
    shares = sky.uniform, sky.overcast_share + 0.0 * sky.sky, *sky.clear_shares
    even = [at_bands(sky, sky.sky * share) / np.pi for share in shares]
    radiance = sum(part[..., None] * level for part, level in zip(sky_parts(), even, strict=True))
    return np.pad(radiance, ((0, 256), (0, 0), (0, 0))).astype(np.float32)


Window = tuple[tuple[int, int], int]
WHOLE: Window = ((0, 0), PIXELS)


def our_bonnet(scene: Scene, sky: Atmosphere, samples: int, depth: int, window: Window = WHOLE) -> np.ndarray:
    # Return radiance (row, column, band) of a window (first row and column, size), north up
    half = np.tan(np.radians(FIELD_DEG / 2))
    edges = np.linspace(-half, half, PIXELS + 1)
    down = np.broadcast_to(matrices(0.0, 0.0, 0.0), (1, 2, 3, 3))
    origin = np.broadcast_to(np.array([0.0, 0.0, HEIGHT]), (1, 2, 3))
    bands = BandSet(NM, np.array(2.0))
    spectra = {
        name: ([400.0, 900.0], [level] * 2) for name, level in (("paint", PAINT), ("ground", GROUND_LEVEL))
    }
    rows = []
    (top, left), size = window
    for row in range(top, top + size):
        still = Platform(
            origin, down, edges[left : left + size + 1], edges[[PIXELS - 1 - row, PIXELS - row]], np.arange(1)
        )
        traced = hp.simulation.trace(
            scene, still, [sky], samples=samples, depth=depth, seed=row, slots=64, sun_radius=SUN_RADIUS_DEG
        )
        line = hp.simulation.relight(traced, bands, atmosphere=sky, spectra=spectra, truth=False)
        rows.append(line.radiance.isel(along_track=0).transpose("cross_track", "band").values)
    return np.array(rows, np.float64)


def both_images(
    scene: Scene, sky: Atmosphere, surface: dict[str, Any], folder: Path, samples: tuple[int, int],
    depth: int, window: Window = WHOLE,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    # Return our image and what Mitsuba makes of the same triangles meanwhile, (row, column, band)
    for number, material in enumerate(scene.materials):
        write_mesh(scene, number, folder / f"{material.name}.ply")
    (towards,) = sun_vectors([(ZENITH, AZIMUTH)])
    said = {
        "towards": towards.tolist(), "sun": at_bands(sky, sky.sun).tolist(), "radius": SUN_RADIUS_DEG,
        "height": HEIGHT, "field": FIELD_DEG, "pixels": PIXELS, "samples": samples[1], "depth": depth,
        "first": window[0], "size": window[1],
        "surfaces": {"paint": surface, "ground": {"type": "diffuse", "reflectance": GROUND_LEVEL}},
    }  # fmt: skip
    np.save(folder / "sky.npy", environment(sky))
    (folder / "scene.json").write_text(json.dumps(said))
    command = [sys.executable, "-c", BONNET_WORKER]
    with subprocess.Popen(command, cwd=folder, stderr=subprocess.PIPE, text=True) as process:
        ours = our_bonnet(scene, sky, samples[0], depth, window)
        _, errors = process.communicate(timeout=500)
    assert process.returncode == 0, errors
    return ours, np.load(folder / "image.npy").astype(np.float64)


def plastic(coat: Coat, **more: Any) -> dict[str, Any]:
    return {
        "type": "plastic", "int_ior": coat.index, "ext_ior": 1.0, "nonlinear": True,
        "diffuse_reflectance": float(base_albedo(PAINT, coat.index)), **more,
    }  # fmt: skip


def on_panel() -> np.ndarray:
    # Return which pixels see the bonnet and nothing else
    place = (np.arange(PIXELS) + 0.5 - PIXELS / 2) * 2 * HEIGHT * np.tan(np.radians(FIELD_DEG / 2)) / PIXELS
    return (np.abs(place)[:, None] < HALF - 0.1) & (np.abs(place)[None] < HALF - 0.1)


def assert_same_means(ours: np.ndarray, theirs: np.ndarray, tolerance: float) -> None:
    # Of every band
    ratio = ours.reshape(-1, NM.size).mean(axis=0) / theirs.reshape(-1, NM.size).mean(axis=0)
    np.testing.assert_allclose(ratio, 1.0, atol=tolerance)


@pytest.mark.slow
@pytest.mark.parametrize("name", SKIES)
def test_a_solid_bonnet(name: str, tmp_path: Path) -> None:
    scene, sky = bonnet(None), SKIES[name]()
    ours, theirs = both_images(scene, sky, {"type": "diffuse", "reflectance": PAINT}, tmp_path, (128, 512), 3)
    assert_same_means(ours, theirs, 0.01)
    panel = on_panel()
    assert_same_means(ours[panel], theirs[panel], 0.005)
    # nothing is turned about: rows and columns agree, and vary
    for axis in (0, 1):
        np.testing.assert_allclose(ours.mean(axis=axis), theirs.mean(axis=axis), rtol=0.03)


def around_the_glint(image: np.ndarray, size: int) -> Window:
    row, column = np.unravel_index(image.mean(axis=-1).argmax(), image.shape[:2])
    return (int(row) - size // 2, int(column) - size // 2), size


@pytest.mark.slow
@pytest.mark.parametrize("name", SKIES)
def test_a_coated_bonnet(name: str, tmp_path: Path) -> None:
    # The sky in the coat, the paint below; of the glint next
    coat, sky = Coat(1.5, 0.0, 0.0), SKIES[name]()
    ours, theirs = both_images(bonnet(coat), sky, plastic(coat), tmp_path, (256, 1024), 3)
    (top, left), size = around_the_glint(ours, 7)
    rest = np.ones(ours.shape[:2], bool)
    rest[top : top + size, left : left + size] = False  # Mitsuba's mirrors meet the sun by chance alone
    for away in (rest, rest & on_panel()):
        assert_same_means(ours[away], theirs[away], 0.01)


@pytest.mark.slow
def test_the_glint_of_a_coat_of_80_units(tmp_path: Path) -> None:
    coat, sky = Coat(1.5, 1e-3, 0.0), clear_sky()
    assert gloss_units(coat) >= 80.0
    scene = bonnet(coat)
    rough = plastic(coat, type="roughplastic", distribution="ggx", alpha=coat.roughness)
    samples = 4096, 2**18  # Mitsuba keeps 1 % of noise
    ours, theirs = both_images(
        scene, sky, rough, tmp_path, samples, 1, around_the_glint(our_bonnet(scene, sky, 16, 1), 3)
    )
    assert (theirs[1, 1] == theirs.max(axis=(0, 1))).all()
    assert (theirs[1, 1] > 20 * np.median(theirs)).all()
    np.testing.assert_allclose(ours[1, 1] / theirs[1, 1], 1.0, atol=0.03)
    assert_same_means(ours, theirs, 0.03)
