"""Scenes: their checks, shapes and refusals, and renders of them against closed forms."""

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, strategies as st
from support.refusals import expect_error, expect_words
from support.traced_scenes import irradiance_series

import hyperpaint as hp
from hyperpaint.base.errors import PaintError, PaintWarning, SchemaError, UnitsError
from hyperpaint.simulation.atmosphere import Atmosphere, preset_atmosphere
from hyperpaint.simulation.camera import BandSet
from hyperpaint.simulation.rendering.car_parks import car_park
from hyperpaint.simulation.rendering.materials import (
    KINDS,
    Coat,
    Flakes,
    Material,
    base_albedo,
    coat_of_gloss,
    flakes_of_flop,
    fresnel_reflectance,
)
from hyperpaint.simulation.rendering.platforms import Platform, matrices, platform_from_poses
from hyperpaint.simulation.rendering.scene import (
    PARTS,
    Factor,
    Instance,
    Scene,
    box,
    cuboid,
    plane,
    polygon,
    put_together,
    smoothed,
    tube,
)
from hyperpaint.simulation.rendering.scene_spectra import generate_paint, paint_spec, spectrum_of

# --- scenes scene ---

GREY = Material("grey", "panel_20", "panel")
RED = Material("red", "red", "paint", Coat(), Flakes(0.3))
TRIANGLE = [[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]


def whole(**changes: object) -> dict[str, object]:
    return {
        "name": "lot",
        "vertices": np.array(TRIANGLE),
        "faces": np.array([[0, 1, 2]]),
        "normals": np.zeros((0, 3)),
        "face_material": np.array([0]),
        "face_instance": np.array([0]),
        "materials": (GREY,),
        "instances": (Instance("thing"),),
    } | changes


def test_arrays_have_the_dtypes_of_the_contract() -> None:
    scene = Scene(**whole(vertices=np.array(TRIANGLE, np.float32), faces=np.array([[0, 1, 2]], np.uint16)))
    assert (scene.vertices.dtype, scene.faces.dtype, scene.normals.dtype) == (
        np.float64,
        np.int64,
        np.float64,
    )
    assert (scene.face_material.dtype, scene.face_instance.dtype) == (np.int32, np.int32)
    assert (scene.face_part.dtype, scene.normals.shape) == (np.int8, (3, 3))
    assert not scene.normals.any()
    # no triangles are a scene
    empty = Scene.join([])
    assert (empty.vertices.shape, empty.faces.shape) == ((0, 3), (0, 3))
    assert np.isnan(empty.bounds).all()
    assert empty.area.shape == (0,)
    # factors are bases, then flakes
    two = Scene.join([plane(1.0, RED), box((1, 1, 1), GREY)])
    assert two.factors == (Factor(0), Factor(1), Factor(0, True))


def test_all_problems_are_listed_at_once() -> None:
    broken = whole(
        vertices=np.array([[0.0, 0, np.nan], [1, 0, 0], [0, 1, 0]]),
        faces=np.array([[0, 1, 3]]),
        face_material=np.array([2]),
        face_instance=np.array([2**40]),
        face_part=np.array([len(PARTS)]),
        materials=(GREY, Material("grey", "panel_50", "panel")),
        instances=(Instance("thing", "spaceship"), Instance("")),
    )
    expect_words(
        str(expect_error(SchemaError, None, lambda: Scene(**broken))),
        "vertices 0 (1 of 3)",
        "faces has numbers from 0 to 3",
        "face_material has numbers from 2 to 2",
        f"face_instance has numbers from {2**40}",
        "face_part",
        "name-duplicate",
        "='spaceship'",
        "name-empty",
    )


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"vertices": np.zeros((3, 2))}, r"vertices has shape .* \[dims-wrong\]"),
        ({"faces": np.zeros((1, 4), int)}, r"faces has shape .* \[dims-wrong\]"),
        ({"faces": np.array([[0.0, 1.0, 2.0]])}, r"faces is float64.*\[type-wrong\]"),
        ({"vertices": np.array([["a"] * 3] * 3)}, r"vertices is <U1.*\[type-wrong\]"),
        ({"face_material": np.array([0, 0])}, r"face_material has .* \[dims-wrong\]"),
        ({"normals": np.full((3, 3), np.inf)}, "normals 0, 1, 2.*not-finite"),
        ({"faces": np.array([[-1, 1, 2]])}, "index-out-of-range"),
        ({"materials": ()}, "index-out-of-range"),
    ],
)
def test_a_problem_is_named(change: dict[str, object], words: str) -> None:
    expect_error(SchemaError, words, lambda: Scene(**whole(**change)))


def test_triangles_without_area_are_dropped_with_their_labels() -> None:
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0]])
    with pytest.warns(PaintWarning, match="triangle-without-area"):
        scene = Scene(
            **whole(
                vertices=vertices,
                faces=np.array([[0, 1, 3], [0, 2, 1], [2, 2, 1]]),
                face_material=np.array([0, 1, 0]),
                face_instance=np.array([0, 0, 0]),
                face_part=np.array([0, 3, 0]),
                materials=(GREY, RED),
            )
        )
    assert (scene.faces.tolist(), scene.face_material.tolist()) == ([[0, 2, 1]], [1])
    assert scene.face_part.tolist() == [3]


@given(st.floats(1e-6, 1e6), st.floats(-1e3, 1e3))
def test_size_does_not_decide_what_has_area(scale: float, shift: float) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(Scene(**whole(vertices=scale * np.array(TRIANGLE) + scale * shift)).faces) == 1


def test_joining_merges_equal_materials_and_keeps_what_each_triangle_is() -> None:
    parts = [plane(2.0, GREY), box((1, 1, 1), RED, instance="one"), box((1, 1, 1), GREY, instance="two")]
    scene = Scene.join(parts, "lot")
    assert (scene.name, scene.materials) == ("lot", (GREY, RED))
    assert [scene.instances[number].name for number in scene.face_instance] == ["ground"] * 2 + [
        "one"
    ] * 12 + ["two"] * 12
    assert scene.face_material.tolist() == [0] * 2 + [1] * 12 + [0] * 12
    np.testing.assert_array_equal(
        scene.vertices[scene.faces], np.concatenate([part.vertices[part.faces] for part in parts])
    )
    twice = Scene.join([box((1, 1, 1), GREY, instance=name) for name in ("a_box", "b_box")])
    assert [one.name for one in twice.instances] == ["a_box", "b_box"]


def test_moving_turns_clockwise_about_the_vertical() -> None:
    north = Scene.from_arrays([[0, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 2]], GREY, normals=[[0, 1, 0]] * 3)
    east = north.moved((10, 0, 0), heading=90)
    np.testing.assert_allclose(east.vertices[1], [11, 0, 0], atol=1e-12)
    np.testing.assert_allclose(east.normals[1], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(north.moved((0, 0, 0), heading=45).vertices[1], [0.5**0.5, 0.5**0.5, 0])


def outward(scene: Scene) -> np.ndarray:
    # Return how far the face normals point away from the middle of a convex body
    corners = scene.vertices[scene.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return (normal * (corners.mean(axis=1) - scene.vertices.mean(axis=0))).sum(axis=1)


def test_shapes_look_outwards_and_have_the_area_of_geometry() -> None:
    solid = box((1.0, 2.0, 3.0), GREY)
    assert (outward(solid) > 0).all()
    assert solid.area.sum() == pytest.approx(22.0)
    pipe = tube((0, 0, 0), (0, 0, 2), (0.5, 0.5), "grey", sides=64).scene({"grey": GREY}, Instance("pipe"))
    assert (outward(pipe) > 0).all()
    assert pipe.area.sum() == pytest.approx(2 * np.pi * 0.5 * 2 + 2 * np.pi * 0.25, rel=3e-3)
    assert plane(3.0).area.sum() == pytest.approx(9.0)


def test_smooth_normals_of_a_tube_are_radial_and_its_ends_stay_sharp() -> None:
    pipe = smoothed(tube((0, 0, 0), (0, 0, 2), (0.5, 0.5), "grey", sides=32), 40.0)
    np.testing.assert_allclose(np.linalg.norm(pipe.normals, axis=1), 1.0)
    flat = np.abs(pipe.normals[:, 2]) > 0.5
    np.testing.assert_allclose(np.abs(pipe.normals[flat, 2]), 1.0)
    np.testing.assert_allclose(pipe.normals[~flat, :2], pipe.vertices[~flat, :2] / 0.5, atol=2e-3)
    # smoothing keeps triangles where they are
    mesh = put_together(
        [cuboid((1, 1, 1), "a", "roof"), polygon([[0, 0, 2], [1, 0, 2], [0, 1, 2]], "b", "boot")]
    )
    made = smoothed(mesh, 30.0)
    np.testing.assert_array_equal(made.vertices[made.faces], mesh.vertices[mesh.faces])
    np.testing.assert_array_equal(made.part, mesh.part)
    np.testing.assert_array_equal(made.surface, mesh.surface)


# --- scene refusals ---

OTHER = Material("grey", "panel_50", "panel")
PAINT = Material("m", "m", "paint", Coat(), Flakes(0.15))
BARE = Material("m", "m", "paint", Coat())
VISIBLE = np.array([380.0, 780.0])
GRID = np.arange(400.0, 1001.0, 5.0)
SERIES = irradiance_series(1)
NO_SERIES = SERIES.drop_vars("irradiance")


def stored(**changes: Any) -> Atmosphere:
    """Read an atmosphere from a dataset without, or with other, variables and attributes."""
    dataset = Atmosphere.clear(50.0, wavelength=GRID).to_dataset()
    dataset = dataset.drop_vars(changes.pop("drop", []))
    dataset["sky"].attrs.update(changes.pop("sky_attrs", {}))
    return Atmosphere.from_dataset(dataset.assign_attrs(changes))


def measured(*given: Any, **options: Any) -> Atmosphere:
    return Atmosphere.from_irradiance(irradiance_series(*given), sun_zenith=60.0, **options)


def of_grid(grid: Any) -> Atmosphere:
    same = np.zeros_like(np.asarray(grid, dtype=float))
    return Atmosphere(grid, same, same, same, same, 30.0, 0.0)


NO_SPECTRA = ("", "rad", "pigment:solid", "pigment:solid:-1", "pigment:solid:1e3", "pigment:gold:1",
              "pigment:solid:1:", "pigment:solid:\u0663")  # fmt: skip
NO_GRIDS = (
    [],
    [500.0],
    [[1.0, 2.0]],
    [500.0, 500.0],
    [500.0, 400.0],
    [-1.0, 5.0],
    [1.0, np.inf],
    [4.0, np.nan],
)

REFUSED: list[tuple[type[PaintError], str, Callable[..., Any], tuple[Any, ...], dict[str, Any]]] = [
    # materials
    (SchemaError, "option-conflict", base_albedo, (0.3,), {"geometry": "0/45", "specular_included": True}),
    (SchemaError, "value-out-of-range", base_albedo, ([5.0, 30.0],), {}),
    (SchemaError, "1 of 2.*not-finite", base_albedo, ([np.nan, 30.0],), {}),
    (SchemaError, "choice-unknown", base_albedo, (0.5,), {"geometry": "8/d"}),
    *((SchemaError, "index", Coat, (index,), {}) for index in (1.0, 0.5, 4.0, np.nan)),
    *((SchemaError, "share", Flakes, (share,), {}) for share in (-0.1, np.nan)),
    (SchemaError, "roughness", Flakes, (0.5, 0.0), {}),
    (SchemaError, "option-conflict", Material, ("leaf", "leaf", "leaf", Coat(), None, "leaf_through"), {}),
    # paints
    *((SchemaError, "spectrum-unknown", spectrum_of, (name,), {}) for name in NO_SPECTRA),
    *((SchemaError, "paint-unknown", paint_spec, (name,), {}) for name in (*NO_SPECTRA, "fleet-x")),
    (SchemaError, "'asphalt'.*spectrum-unknown", spectrum_of, ("asfalt",), {}),
    (SchemaError, "paint-unknown", paint_spec, ("pigment:pearl:3:flakes",), {}),
    (SchemaError, "family.*choice-unknown", generate_paint, ("gold", 1), {}),
    *((SchemaError, "value-out-of-range", generate_paint, ("solid", n), {}) for n in (-1, 10**9)),
    (SchemaError, "value-out-of-range", coat_of_gloss, (95.0,), {}),
    (SchemaError, "value-out-of-range", flakes_of_flop, (16.0, PAINT, VISIBLE, 0.6, 0.85), {}),
    (SchemaError, "flakes-missing", flakes_of_flop, (9.0, BARE, VISIBLE, 0.6, 0.85), {}),
    # scenes
    (SchemaError, "argument-missing", Scene.from_arrays, (TRIANGLE, [[0, 1, 2]], [GREY, PAINT]), {}),
    (SchemaError, "name-duplicate", Scene.join, ([plane(1.0, GREY), plane(1.0, OTHER, instance="b")],), {}),
    (SchemaError, "box.*name-duplicate", Scene.join, ([box((1, 1, 1), GREY)] * 2,), {}),
    (SchemaError, "fleet='rusty'", car_park, (), {"fleet": "rusty"}),
    (SchemaError, "time is not an array", platform_from_poses, (["a", "b"], *[[0] * 2] * 6), {"columns": 2}),
    # light
    *((SchemaError, "wavelength", of_grid, (grid,), {}) for grid in NO_GRIDS),
    *((SchemaError, "wavelength", Atmosphere.clear, (30.0,), {"wavelength": grid}) for grid in NO_GRIDS),
    *(
        (SchemaError, "sun_zenith", Atmosphere.clear, (zenith,), {"wavelength": GRID})
        for zenith in (-1.0, 89.5, 95.0, np.nan)
    ),
    (SchemaError, "choice-unknown", preset_atmosphere, ("midnight",), {}),
    (UnitsError, "'sky'", stored, (), {"sky_attrs": {"units": "W m-2 sr-1 nm-1"}}),
    (SchemaError, "'sun'.*\n.*'sun_zenith'", stored, (), {"drop": ["sun", "sun_zenith"]}),
    *(
        (SchemaError, "metadata-damaged", stored, (), {"haze": text})
        for text in ("{", "[1]", '{"fog": 1}', '{"visibility": "far"}')
    ),
    # light of a spectrometer
    *(
        (SchemaError, "direct_fraction", measured, (1,), {"direct_fraction": fraction})
        for fraction in (-0.1, 1.1, np.nan, [0.5, 0.5])
    ),
    (SchemaError, "irradiance", measured, (1, "W m-2 sr-1 nm-1"), {}),
    (SchemaError, "missing", Atmosphere.from_irradiance, (NO_SERIES,), {"sun_zenith": 1.0}),
    (SchemaError, "argument-missing", measured, (3,), {}),
    *(
        (SchemaError, "irradiance-coverage", measured, (count,), {"time": f"2020-06-21T{time}"})
        for count, time in ((3, "16:59:59"), (3, "17:00:21"), (0, "17:00:00"))
    ),
    *((SchemaError, "time-unreadable", measured, (3,), {"time": time}) for time in ("noon", "NaT", object())),
    (
        SchemaError, "wavelength-unordered", Atmosphere.from_irradiance,
        (SERIES.isel(irradiance_wavelength=slice(None, None, -1)),), {"sun_zenith": 1.0},
    ),
    # tables
]  # fmt: skip


@pytest.mark.parametrize(("kind", "words", "call", "arguments", "options"), REFUSED)
def test_refused(
    kind: type[PaintError],
    words: str,
    call: Callable[..., Any],
    arguments: tuple[Any, ...],
    options: dict[str, Any],
) -> None:
    expect_error(kind, words, lambda: call(*arguments, **options))


def test_all_problems_of_a_material_at_once() -> None:
    error = expect_error(SchemaError, None, lambda: Material("", "", "cheese", flakes=Flakes(0.5)))
    expect_words(str(error), "name is empty", "spectrum is empty", "'cheese'", "coat-missing")
    # labels count on the order of kinds
    assert KINDS[:3] == ("asphalt", "paint", "glass")
    assert len(set(KINDS)) == len(KINDS) == 13


# --- scene physics ---

BANDS = BandSet(np.array([450.0, 550.0, 650.0, 850.0]), np.array(6.0))


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


def triangles(vertices: Any, faces: Any, material: Material = GREY) -> Scene:
    return Scene.from_arrays(vertices, faces, material)


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
