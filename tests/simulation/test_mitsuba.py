"""Rendered scenes against Mitsuba 3, which shares no line of code with the tracer.

Mitsuba runs in a process of its own: its variant is global, and where it gives up it takes the process along.
"""

import importlib.util
import pickle
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from oracles.mitsuba_scenes import FrameCamera

import hyperpaint as hp
from hyperpaint.simulation.camera import BandSet
from hyperpaint.simulation.rendering.car_parks import car_park
from hyperpaint.simulation.rendering.four_curves import Atmosphere
from hyperpaint.simulation.rendering.materials import Coat, Material
from hyperpaint.simulation.rendering.platforms import Platform, matrices
from hyperpaint.simulation.rendering.scene import Scene, box, plane

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
