"""Scenes: what is checked when one is made, joining, moving, and the order of factors."""

import warnings

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from hyperpaint.base.errors import PaintWarning, SchemaError
from hyperpaint.simulation.rendering.materials import Coat, Flakes, Material
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
    with pytest.raises(SchemaError) as caught:
        Scene(**broken)
    message = str(caught.value)
    for words in (
        "vertices 0 (1 of 3)",
        "faces has numbers from 0 to 3",
        "face_material has numbers from 2 to 2",
        f"face_instance has numbers from {2**40}",
        "face_part",
        "name-duplicate",
        "='spaceship'",
        "name-empty",
    ):
        assert words in message


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
    with pytest.raises(SchemaError, match=words):
        Scene(**whole(**change))


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
@settings(max_examples=25)
def test_size_does_not_decide_what_has_area(scale: float, shift: float) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(Scene(**whole(vertices=scale * np.array(TRIANGLE) + scale * shift)).faces) == 1


def test_no_triangles_are_a_scene() -> None:
    empty = Scene.join([])
    assert (empty.vertices.shape, empty.faces.shape) == ((0, 3), (0, 3))
    assert np.isnan(empty.bounds).all()
    assert empty.area.shape == (0,)


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


def test_joining_keeps_the_names_of_instances() -> None:
    twice = Scene.join([box((1, 1, 1), GREY, instance=name) for name in ("a_box", "b_box")])
    assert [one.name for one in twice.instances] == ["a_box", "b_box"]


def test_factors_are_bases_then_flakes() -> None:
    scene = Scene.join([plane(1.0, RED), box((1, 1, 1), GREY)])
    assert scene.factors == (Factor(0), Factor(1), Factor(0, True))


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


def test_smoothing_keeps_triangles_where_they_are() -> None:
    mesh = put_together(
        [cuboid((1, 1, 1), "a", "roof"), polygon([[0, 0, 2], [1, 0, 2], [0, 1, 2]], "b", "boot")]
    )
    made = smoothed(mesh, 30.0)
    np.testing.assert_array_equal(made.vertices[made.faces], mesh.vertices[mesh.faces])
    np.testing.assert_array_equal(made.part, mesh.part)
    np.testing.assert_array_equal(made.surface, mesh.surface)
