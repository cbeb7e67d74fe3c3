"""Rendered scenes against closed forms, from scene to reflectance; and scenes that nobody should render."""

from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.refusals import refusal

import hyperpaint as hp
from hyperpaint.base.errors import PaintWarning, SchemaError
from hyperpaint.simulation.camera import BandSet
from hyperpaint.simulation.rendering.four_curves import Atmosphere
from hyperpaint.simulation.rendering.materials import Coat, Material, fresnel_reflectance, measured_factor
from hyperpaint.simulation.rendering.platforms import Platform, matrices
from hyperpaint.simulation.rendering.scene import Scene, box, plane
from hyperpaint.simulation.rendering.scene_spectra import spectrum_of

BANDS = BandSet(np.array([450.0, 550.0, 650.0, 850.0]), np.array(6.0))
GREY = Material("grey", "panel_20", "panel")


def light(sun: float, sky: float, zenith: float, azimuth: float) -> Atmosphere:
    # Return light of the same irradiance at all wavelengths, without air
    none = np.zeros(2)
    return Atmosphere(np.array([300.0, 1100.0]), none + sun, none + sky, none, none, zenith, azimuth)


def looking(
    at: tuple[float, float, float] = (0.0, 0.0, 0.0),
    zenith: float = 0.0,
    *,
    lines: int = 1,
    columns: int = 1,
    ifov: float = 1e-4,
    distance: float = 10.0,
) -> Platform:
    # Return a camera that stands still north of a point, and sees it from a zenith angle [degree]
    angle = np.radians(zenith)
    place = np.array(at) + distance * np.array([0.0, np.sin(angle), np.cos(angle)])
    turned = matrices(0.0, -zenith, 0.0)  # nose down: the view goes back to the south
    edges = ifov * (np.arange(columns + 1) - 0.5 * columns)
    return Platform(
        np.broadcast_to(place, (lines, 2, 3)),
        np.broadcast_to(turned, (lines, 2, 3, 3)),
        edges,
        np.array([-0.5, 0.5]) * ifov,
        np.arange(lines),
    )


def seen(
    scene: Scene, platform: Platform, sky: Atmosphere, spectra: Any = None, **options: Any
) -> xr.Dataset:
    # Return what four bands see of a scene
    traced = hp.simulation.trace(scene, platform, [sky], **{"sun_radius": 0.0, **options})
    return hp.simulation.relight(traced, BANDS, atmosphere=sky, spectra=spectra).compute()


def view_factor(distance: float, height: float, half_width: float) -> float:
    # Return the part of the diffuse light of a level spot that goes to a wall, edge to edge with its foot
    # J. R. Howell, A catalog of radiation heat transfer configuration factors, B-4, for both halves.
    slant = np.hypot(distance, height)
    return float(
        (np.arctan(half_width / distance) - (distance / slant * np.arctan(half_width / slant))) / np.pi
    )


def test_a_grey_panel_beside_a_red_wall_is_reddened_as_the_view_factor_says() -> None:
    # the panel is so small that the wall does not see it
    wall = box((0.1, 4.0, 1.0), Material("wall", "brick", "wall"), centre=(0.35, 0.0, 0.0), instance="wall")
    scene = Scene.join([plane(0.03, GREY, instance="panel"), wall], "adjacency")
    line = seen(scene, looking(lines=5, columns=4), light(1.0, 0.25, 50.0, 270.0), samples=16_000, depth=3)
    share = view_factor(0.30, 1.0, 2.0)
    assert share == pytest.approx(0.3529, abs=1e-4)
    level, upright = np.cos(np.radians(50.0)), np.sin(np.radians(50.0))
    red = spectrum_of("brick")(BANDS.wavelength)
    # the wall sees the sky above the horizon, and dark ground below it
    known = 0.2 * (level + 0.25 * (1.0 - share) + share * red * (upright + 0.125)) / (level + 0.25)
    found = line.reflectance.mean(["along_track", "cross_track"]).values
    np.testing.assert_allclose(found, known, rtol=0.005)
    # the excess over a panel without a wall is itself within 0.5 % of the light that the wall loses and gives
    alone = 0.2 * (level + 0.25 * (1.0 - share)) / (level + 0.25)
    np.testing.assert_allclose(found - alone, known - alone, rtol=0.005)
    assert found[2] / found[0] > 1.05


def test_the_glint_of_a_flat_coat_is_that_of_its_formula() -> None:
    zenith, alpha = 40.0, 0.1
    line = seen(
        plane(50.0, Material("paint", "none", "paint", Coat(1.5, alpha, 0.0))),
        looking(zenith=zenith),
        light(1.3, 0.0, zenith, 180.0),
        {"none": ([300.0, 1100.0], [0.0, 0.0])},
        samples=64,
    )
    cosine = np.cos(np.radians(zenith))
    facets = 1.0 / (np.pi * alpha**2)  # all that face the half vector, which is the normal
    shadowing = 1.0 / np.sqrt(1.0 + alpha**2 * np.tan(np.radians(zenith)) ** 2)
    glint = 1.3 * float(fresnel_reflectance(cosine)) * facets * shadowing / (4.0 * cosine)
    np.testing.assert_allclose(line.radiance, glint, rtol=1e-3)
    np.testing.assert_allclose(line.glint_share, 1.0)


@pytest.mark.parametrize("roughness", [0.0, 0.05, 0.1])
@pytest.mark.parametrize("zenith", [0.0, 60.0])
def test_a_furnace_takes_no_more_than_the_paint(roughness: float, zenith: float) -> None:
    # nearly white: a base that reflects everything reads 1.015 near normal, more than a spectrum may have
    line = seen(
        plane(500.0, Material("paint", "bright", "paint", Coat(1.5, roughness))),
        looking(zenith=zenith, lines=4, columns=4),
        light(0.0, 1.0, 30.0, 180.0),
        {"bright": ([300.0, 1100.0], [1.0, 1.0])},
        samples=8192,
    )
    absorbed = (1.0 - float(fresnel_reflectance(np.cos(np.radians(zenith))))) * (
        1.0 - float(measured_factor(1.0))
    )
    np.testing.assert_allclose(line.reflectance.mean(), 1.0 - absorbed, atol=0.005)


def two_boxes() -> Scene:
    red = box((1.0, 2.0, 1.2), Material("red", "red", "paint", Coat()), centre=(-0.9, 0.0, 0.0), instance="a")
    blue = box((1.0, 2.0, 1.2), Material("blue", "blue", "paint"), centre=(0.9, 0.3, 0.0), instance="b")
    return Scene.join([plane(60.0), red, blue], "boxes")


def test_noise_falls_faster_than_the_root_of_the_samples() -> None:
    sky = light(1.0, 0.3, 40.0, 200.0)
    above = looking(lines=8, columns=24, ifov=0.02)

    def noise(samples: int) -> float:
        one, other = (seen(two_boxes(), above, sky, samples=samples, seed=seed).radiance for seed in (1, 2))
        return float(np.sqrt(((one - other) ** 2).mean()))

    assert noise(16) / noise(1024) > 8.0


def triangles(vertices: Any, faces: Any, material: Material = GREY) -> Scene:
    return Scene.from_arrays(vertices, faces, material)


def test_an_open_mesh_is_seen_from_both_sides() -> None:
    corners = [[-9.0, -9.0, 0.0], [9.0, -9.0, 0.0], [0.0, 9.0, 0.0]]
    sky = light(1.0, 0.3, 40.0, 200.0)
    for face in ([0, 1, 2], [0, 2, 1]):
        np.testing.assert_allclose(
            seen(triangles(corners, [face]), looking(), sky, samples=8).reflectance, 0.2, rtol=1e-5
        )


def test_triangles_without_area_are_dropped_and_change_nothing() -> None:
    whole = two_boxes()
    spoilt_faces = np.concatenate([[[0, 0, 1]], whole.faces, [[2, 1, 2]]])
    with pytest.warns(PaintWarning, match="triangle-without-area"):
        spoilt = Scene(
            whole.name,
            whole.vertices,
            spoilt_faces,
            whole.normals,
            np.pad(whole.face_material, 1),
            np.pad(whole.face_instance, 1),
            whole.materials,
            whole.instances,
        )
    sky, above = light(1.0, 0.3, 40.0, 200.0), looking(lines=2, columns=16, ifov=0.02)
    one, other = (seen(scene, above, sky, samples=4) for scene in (whole, spoilt))
    xr.testing.assert_identical(one.radiance, other.radiance)


def test_vertices_that_are_nowhere_are_refused_by_number() -> None:
    corners = np.zeros((40, 3))
    corners[7, 0], corners[31, 2] = np.nan, np.inf
    with refusal(SchemaError, "not-finite", "vertices 7, 31"):
        triangles(corners, [[0, 1, 2]])


def test_in_a_scene_of_nothing_there_is_no_radiance() -> None:
    line = seen(
        triangles(np.zeros((0, 3)), np.zeros((0, 3), int)), looking(), light(1.0, 0.3, 40.0, 200.0), samples=4
    )
    assert line.material.values.tolist() == [[-1]]
    assert np.isnan(line.radiance).all()
    assert np.isnan(line.reflectance).all()


@pytest.mark.slow
def test_a_quarter_of_a_million_triangles_look_like_two() -> None:
    side = np.linspace(-20.0, 20.0, 354)
    east, north = np.meshgrid(side, side, indexing="ij")
    corners = np.array([[0, 354, 355], [0, 355, 1]])
    faces = ((np.arange(353)[:, None] * 354 + np.arange(353)).reshape(-1, 1)[:, None] + corners).reshape(
        -1, 3
    )
    sky, above = light(1.0, 0.3, 40.0, 200.0), looking(lines=4, columns=64, ifov=0.02)
    scene = triangles(np.stack([east, north, np.zeros_like(east)], axis=-1).reshape(-1, 3), faces)
    assert len(scene.faces) > 249_000
    line = seen(scene, above, sky, samples=16)
    np.testing.assert_allclose(
        line.radiance, seen(plane(40.0, GREY), above, sky, samples=16).radiance, rtol=1e-6
    )


def test_reflectance_above_one_is_refused_or_clamped() -> None:
    sky = light(1.0, 0.3, 40.0, 200.0)
    traced = hp.simulation.trace(plane(50.0, GREY), looking(), [sky], samples=4, sun_radius=0.0)
    bright = {"panel_20": ([300.0, 1100.0], [1.3, 1.3])}
    with refusal(SchemaError, "value-out-of-range", "'panel_20'"):
        hp.simulation.relight(traced, BANDS, atmosphere=sky, spectra=bright)
    clamped = hp.simulation.relight(traced, BANDS, atmosphere=sky, spectra=bright, clip=True)
    np.testing.assert_allclose(clamped.reflectance, 1.0, rtol=1e-5)


def test_what_does_not_cover_the_bands_is_named() -> None:
    sky = light(1.0, 0.3, 40.0, 200.0)
    traced = hp.simulation.trace(plane(50.0, GREY), looking(), [sky], samples=4)
    with refusal(SchemaError, "spectrum-coverage", "'panel_20'"):
        hp.simulation.relight(
            traced, BANDS, atmosphere=sky, spectra={"panel_20": ([500.0, 700.0], [0.2, 0.2])}
        )
    wavelength, none = np.array([500.0, 1100.0]), np.zeros(2)
    narrow = Atmosphere(wavelength, none + 1.0, none, none, none, 40.0, 200.0, name="narrow")
    with refusal(SchemaError, "atmosphere-coverage", "'narrow'"):
        hp.simulation.relight(traced, BANDS, atmosphere=narrow)
