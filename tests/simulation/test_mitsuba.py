"""Rendered scenes against Mitsuba 3, which shares no line of code with the tracer.

Mitsuba runs in a process of its own: its variant is global, and where it gives up it takes the process along.
"""

from __future__ import annotations

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
from hyperpaint.simulation.rendering.camera_bands import BandSet
from hyperpaint.simulation.rendering.car_parks import car_park
from hyperpaint.simulation.rendering.four_curves import Atmosphere
from hyperpaint.simulation.rendering.materials import Coat, Material
from hyperpaint.simulation.rendering.platform_geometry import Platform, matrices, quaternions
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
with open("scene.pickle", "rb") as file:
    arguments, options = pickle.load(file)
described = to_mitsuba(*arguments, "meshes", **options)
numpy.save("image.npy", mitsuba.render(mitsuba.load_dict(described), seed=1))
"""

Images = Callable[..., tuple[np.ndarray, np.ndarray]]


def light(sun: float = 1.0, zenith: float = 50.0) -> Atmosphere:
    """Return light without air, of spectra so smooth that means over a band cannot differ."""
    wavelength = np.linspace(400.0, 900.0, 51)
    slope = (wavelength - 400.0) / 500.0
    none = np.zeros_like(wavelength)
    return Atmosphere(wavelength, sun * (1.0 + 0.3 * slope), 0.5 - 0.3 * slope, none, none, zenith, 240.0)


def our_image(scene: Scene, sky: Atmosphere, camera: FrameCamera, samples: int, depth: int) -> np.ndarray:
    """Return radiance (strip, column, band) of a frame.

    Every strip of rows is the view of a camera that stands still for some lines of other random numbers.
    """
    half = np.tan(np.radians(camera.field_of_view / 2))
    across = np.linspace(-half, half, camera.columns + 1)
    along = np.linspace(half, -half, STRIPS + 1) * camera.rows / camera.columns
    origin = np.broadcast_to(np.array(camera.position), (LINES, 2, 3))
    down = np.broadcast_to(matrices(quaternions(0.0, 0.0, 0.0)), (LINES, 2, 3, 3))
    strips = []
    for strip in range(STRIPS):
        still = Platform(origin, down, across, along[[strip + 1, strip]], np.arange(LINES))
        traced = hp.simulation.trace(
            scene,
            still,
            [sky],
            samples=samples,
            depth=depth,
            seed=strip,
            slots=256,
            chunk_lines=1,
            sun_radius=0.0,
        )
        made = hp.simulation.relight(traced, BANDS, atmosphere=sky, truth=False).radiance.mean("along_track")
        strips.append(made.transpose("cross_track", "band").values)
    return np.stack(strips).astype(np.float64)


@pytest.fixture
def images(tmp_path: Path) -> Images:
    """Return a function that renders a scene with both, ours first, shape (strip, column, band)."""

    def rendered(
        scene: Scene, sky: Atmosphere, camera: FrameCamera, *, samples: int = 1024, depth: int = 4
    ) -> tuple[np.ndarray, np.ndarray]:
        options = {"wavelength": BANDS.wavelength, "fwhm": 6.0, "camera": camera, "depth": depth}
        with (tmp_path / "scene.pickle").open("wb") as file:
            pickle.dump(((scene, sky), options | {"samples": 4096}), file)
        command = [sys.executable, "-c", WORKER, str(Path(__file__).parents[1])]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
        theirs = np.load(tmp_path / "image.npy").astype(np.float64)
        theirs = theirs.reshape(STRIPS, -1, *theirs.shape[1:]).mean(axis=1)
        return our_image(scene, sky, camera, samples, depth), theirs

    return rendered


def assert_equal_means(ours: np.ndarray, theirs: np.ndarray, tolerance: float = 0.002) -> None:
    assert ours.shape == theirs.shape
    ratio = ours.mean(axis=(0, 1)) / theirs.mean(axis=(0, 1))
    np.testing.assert_allclose(ratio, 1.0, atol=tolerance)


GREY = Material("grey", "panel_20", "panel")
GROUND = Material("ground", "concrete", "concrete")
WALL = Material("red wall", "brick", "wall")


def test_a_lambert_plane(images: Images) -> None:
    ours, theirs = images(plane(200.0, GREY), light(), FrameCamera((0, 0, 10), rows=16, columns=16))
    sky = light()
    known = 0.2 * np.interp(BANDS.wavelength, sky.wavelength, sky.irradiance) / np.pi
    np.testing.assert_allclose(ours, np.broadcast_to(known, ours.shape), rtol=1e-5)
    assert_equal_means(ours, theirs)


def test_a_red_wall_beside_a_grey_panel(images: Images) -> None:
    scene = Scene.join(
        [
            plane(200.0, GROUND),
            plane(3.0, GREY, centre=(0.0, 0.0, 0.01), instance="panel"),
            box((0.2, 4.0, 2.0), WALL, centre=(1.0, 0.5, 0.0), instance="wall"),
        ],
        "adjacency",
    )
    ours, theirs = images(scene, light(), FrameCamera((0, 0, 10), field_of_view=25.0, rows=32, columns=32))
    assert_equal_means(ours, theirs)
    # shadow and reddening lie where they should: rows and columns agree too, and neither is turned about
    for axis in (0, 1):
        np.testing.assert_allclose(ours.mean(axis=axis), theirs.mean(axis=axis), rtol=0.04)
        flipped = np.flip(theirs.mean(axis=axis), axis=0)
        assert np.abs(ours.mean(axis=axis) / flipped - 1.0).max() > 0.2


#: Mitsuba's sky is below the horizon as well: the ground goes on until none of it is seen.
PARK = Scene.join(
    [
        car_park(length=10.0, width=16.0, neighbours=(), seed=1),
        plane(2e4, GROUND, centre=(0.0, 0.0, -0.02), instance="country"),
    ]
)
ABOVE = FrameCamera((0.0, 5.0, 15.0), (0.0, 5.0, 0.0), field_of_view=50.0, rows=32, columns=32)


def coated(scene: Scene, coat: Coat | None) -> Scene:
    """Return the scene with another coat on its paints and panes, and none elsewhere."""
    materials = (
        replace(one, coat=coat if one.kind in ("paint", "glass") else None, flakes=None)
        for one in scene.materials
    )
    return replace(scene, materials=tuple(materials))


def test_a_car_park_of_lambert_surfaces(images: Images) -> None:
    ours, theirs = images(coated(PARK, None), light(), ABOVE)
    assert_equal_means(ours, theirs)
    assert abs(np.median(ours / theirs) - 1.0) < 0.002


@pytest.mark.parametrize("depth", [1, 4])
def test_a_car_park_of_smooth_coats_under_the_sky(images: Images, depth: int) -> None:
    # Mitsuba's mirrors never show the sun, which is a point: the sky alone
    ours, theirs = images(coated(PARK, Coat(1.5, 0.0)), light(sun=0.0), ABOVE, samples=4096, depth=depth)
    assert_equal_means(ours, theirs)
