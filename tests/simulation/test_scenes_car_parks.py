"""Car parks: cars, their parts, the ground without overlaps, and the same cars whatever the length."""

import numpy as np
import pytest
from support.refusals import expect_error, expect_refusals, expect_words

from hyperpaint.base.errors import SchemaError
from hyperpaint.simulation.rendering.car_parks import (
    CAR_TYPES,
    NEIGHBOURS,
    car_body,
    car_park,
    paved,
    strips_across,
    worn,
)
from hyperpaint.simulation.rendering.materials import Coat
from hyperpaint.simulation.rendering.scene import PARTS, Mesh, Scene, built
from hyperpaint.simulation.rendering.scene_spectra import FOURTEEN, spectrum_of

BARE = {"neighbours": (), "islands": False, "leaves": 10}


def faces_of(scene: Scene, name: str) -> np.ndarray:
    # Return the corners of the triangles of an instance, shape (face, 3, 3)
    return scene.vertices[
        scene.faces[scene.face_instance == [one.name for one in scene.instances].index(name)]
    ]


def crossed(mesh: Mesh) -> np.ndarray:
    corners = mesh.vertices[mesh.faces]
    return 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


@pytest.mark.parametrize("kind", CAR_TYPES)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_car_is_as_large_as_a_car_and_stands_on_the_ground(kind: str, seed: int) -> None:
    body = car_body(kind, np.random.default_rng(seed))
    assert 600 <= len(body.faces) <= 1500
    width, length, height = np.ptp(body.vertices, axis=0)
    assert 1.9 < width < 2.3  # with mirrors
    assert 3.8 < length < 5.1
    assert 1.35 < height < 2.05
    assert -0.01 < body.vertices[:, 2].min() < 0.03
    assert set(body.surfaces) == {"paint", "glass", "trim", "tyre", "rim", "lamp", "tail_lamp", "plate"}


@pytest.mark.parametrize("kind", CAR_TYPES)
def test_parts_are_where_a_car_has_them(kind: str) -> None:
    body = car_body(kind, np.random.default_rng(4))
    area, middle = crossed(body), body.vertices[body.faces].mean(axis=1)
    found = {}
    for name in (
        "bonnet",
        "windscreen",
        "roof",
        "rear_window",
        "side_window",
        "door",
        "wheel",
        "lamp",
        "mirror",
    ):
        mine = body.part == PARTS.index(name)
        found[name] = (np.linalg.norm(area[mine], axis=1).sum(), middle[mine].mean(axis=0))
    assert 0.6 < found["bonnet"][0] < 2.5
    assert 0.7 < found["roof"][0] < 5.5
    assert (
        found["bonnet"][1][1] > found["windscreen"][1][1] > found["roof"][1][1] > found["rear_window"][1][1]
    )
    assert found["roof"][1][2] > found["bonnet"][1][2] + 0.3
    behind = "bed" if kind == "pickup" else "boot"
    assert middle[body.part == PARTS.index(behind)][:, 1].mean() < found["roof"][1][1]
    up = area[body.part == PARTS.index("roof"), 2] / np.linalg.norm(
        area[body.part == PARTS.index("roof")], axis=1
    )
    assert (up > 0.75).all()  # a roof looks up, whatever its bulge


@pytest.mark.parametrize("kind", CAR_TYPES)
def test_shading_normals_are_unit_and_on_the_side_of_their_triangles(kind: str) -> None:
    body = car_body(kind, np.random.default_rng(5))
    length = np.linalg.norm(body.normals, axis=1)
    assert (np.isclose(length, 1.0) | (length == 0.0)).all()
    flat = crossed(body)
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    assert (body.normals[body.faces] * flat[:, None]).sum(axis=2)[length[body.faces] > 0].min() > np.cos(
        np.radians(45.0)
    )


def test_the_body_is_the_same_on_both_sides() -> None:
    body = car_body("sedan", np.random.default_rng(6))
    assert ({tuple(point) for point in (body.vertices * (-1, 1, 1)).round(6) + 0.0}) == (
        {tuple(point) for point in body.vertices.round(6) + 0.0}
    )


def test_a_longer_park_holds_the_cars_of_the_shorter() -> None:
    short, long = car_park(length=15.0, seed=7, leaves=50), car_park(length=30.0, seed=7, leaves=50)
    paints = {one.name: one.paint for one in long.instances}
    for one in short.instances:
        if one.kind in ("car", "tree", "panel"):
            assert paints[one.name] == one.paint
            np.testing.assert_array_equal(faces_of(short, one.name), faces_of(long, one.name))


def test_the_seed_decides_and_every_spectrum_is_known() -> None:
    first, again, other = (car_park(length=15.0, width=16.0, seed=seed, leaves=50) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.vertices, again.vertices)
    np.testing.assert_array_equal(first.face_material, again.face_material)
    assert [one.paint for one in first.instances] != [one.paint for one in other.instances]
    # every spectrum is known
    park = car_park(length=25.0, neighbours=NEIGHBOURS, leaves=20)
    for material in park.materials:
        assert np.isfinite(spectrum_of(material.spectrum)(np.array([400.0, 1000.0]))).all()
        if material.flakes is not None:
            spectrum_of(material.flakes.spectrum)
    assert {one.kind for one in park.instances} == {"ground", "car", "tree", "wall", "panel", "other"}


def test_every_car_has_a_paint_of_its_own() -> None:
    park = car_park(length=25.0, **BARE)
    cars = [one for one in park.instances if one.kind == "car"]
    named = {material.name: material for material in park.materials}
    assert len(cars) > 25
    for number, one in enumerate(park.instances):
        if one.kind == "car":
            own = named[f"paint of {one.name}"]
            assert own.spectrum == one.paint
            of_car = set(park.face_material[park.face_instance == number].tolist())
            assert {
                park.materials[index].name for index in of_car if park.materials[index].kind == "paint"
            } == {own.name}
    for first in (0, 14):
        assert {one.paint for one in cars[first : first + 14]} == set(FOURTEEN)


def test_occupancy_is_the_share_of_bays_taken() -> None:
    bays = 4 * 10
    for share in (0.0, 0.5, 1.0):
        assert sum(
            one.kind == "car"
            for one in car_park(length=25.0, occupancy=share, types=["hatchback"], **BARE).instances
        ) == pytest.approx(share * bays, abs=4 * (share * (1 - share) * bays) ** 0.5)


def test_coat_and_flakes_are_as_asked() -> None:
    own = {one.name: one for one in car_park(length=15.0, **BARE).materials if one.kind == "paint"}
    assert any(one.flakes is not None for one in own.values())
    assert all(one.coat is not None for one in own.values())
    bare = [one for one in car_park(length=15.0, coat=None, **BARE).materials if one.kind == "paint"]
    assert all(one.coat is None and one.flakes is None for one in bare)
    rough = car_park(length=15.0, coat=Coat(1.4, 0.2), flakes=False, **BARE).materials
    assert {one.coat for one in rough if one.kind == "paint"} == {Coat(1.4, 0.2)}
    assert not any(one.flakes for one in rough)


def test_cars_stand_in_their_bays_and_not_in_one_another() -> None:
    park = car_park(length=30.0, occupancy=1.0, **BARE)
    boxes = []
    for one in park.instances:
        if one.kind == "car":
            corners = faces_of(park, one.name).reshape(-1, 3)[:, :2]
            low, high = corners.min(axis=0), corners.max(axis=0)
            assert (
                abs(0.5 * (low[1] + high[1]) - ((int(one.name.removeprefix("car_")) // 4 + 0.5) * 2.5)) < 0.35
            )
            boxes.append((low, high))
    low, high = (np.array(corner) for corner in zip(*boxes, strict=True))
    apart = (low[:, None] > high[None]).any(axis=2) | (low[None] > high[:, None]).any(axis=2)
    np.fill_diagonal(apart, True)
    assert apart.all()


def test_panels_lie_where_they_did_in_the_plan_view() -> None:
    park = car_park(length=40.0, width=16.0, **BARE)
    first = faces_of(park, "panel_05_000").reshape(-1, 3)
    np.testing.assert_allclose(np.ptp(first[:, :2], axis=0), 0.9)
    np.testing.assert_allclose(0.5 * (first.min(axis=0) + first.max(axis=0))[1], 1.4 + 0.45)
    assert [one.name for one in park.instances if one.kind == "panel"] == [
        f"panel_{level}_{line:03d}" for line in (0, 1) for level in ("05", "20", "50", "90")
    ]


def count_over(mesh: Mesh, x: float, y: float, low: float, high: float) -> int:
    # Return how many triangles between two heights lie over a point
    corners = mesh.vertices[mesh.faces]
    level = (corners[..., 2] >= low).all(axis=1) & (corners[..., 2] <= high).all(axis=1)
    a, b, c = (corners[level, corner, :2] for corner in range(3))
    point = np.array([x, y])

    def side(p: np.ndarray, q: np.ndarray) -> np.ndarray:
        return (q[:, 0] - p[:, 0]) * (point[1] - p[:, 1]) - (q[:, 1] - p[:, 1]) * (point[0] - p[:, 0])

    sides = np.stack([side(a, b), side(b, c), side(c, a)])
    return int(((sides > 0).all(axis=0) | (sides < 0).all(axis=0)).sum())


@pytest.mark.parametrize(("length", "width"), [(21.3, 16.0), (30.0, 32.0), (12.0, 11.0)])
def test_the_ground_covers_everything_once(length: float, width: float) -> None:
    ground = built(paved(strips_across(length, width, None, margin=12.0, line_width=0.12, islands=False)))
    for x, y in np.random.default_rng(0).uniform(
        (-0.5 * width - 11.9, -11.9), (0.5 * width + 11.9, length + 11.9), (400, 2)
    ):
        assert count_over(ground, x, y, 0.09, 0.11) <= 1, (x, y)
        if not count_over(ground, x, y, 0.003, 0.2):  # no arrow, lawn or kerb
            assert count_over(ground, x, y, -1e-9, 1e-9) == 1, (x, y)
        assert count_over(ground, x, y, -0.06, -0.04) == 1  # the sheet beneath


def test_sixteen_metres_are_the_strips_of_the_plan_view() -> None:
    layout = strips_across(20.0, 16.0, None, margin=12.0, line_width=0.12, islands=False)
    np.testing.assert_allclose(np.array(layout.rows) + 8.0, [[1.4, 6.4], [10.9, 15.9]])
    np.testing.assert_allclose(np.array(layout.kerb) + 8.0, [1.0, 1.3])
    assert layout.bays == 8
    # what lies on the asphalt does not lie in it
    for mesh in worn(strips_across(60.0, 32.0, None, margin=12.0, line_width=0.12, islands=True), 3):
        assert mesh.vertices[:, 2].min() >= 0.003


def test_problems_of_a_park_are_listed() -> None:
    wrong = {
        "length": 0.0, "occupancy": 1.5, "types": ["tank"], "neighbours": ["sea"], "seed": -1,
        "line_width": 0.0, "leaves": -1, "margin": np.nan, "paints": [],
    }  # fmt: skip
    expect_words(
        str(expect_error(SchemaError, None, lambda: car_park(**wrong))),
        *(
            "length=0.0",
            "occupancy",
            "'tank'",
            "'sea'",
            "seed",
            "line_width",
            "leaves",
            "margin",
            "empty-input",
        ),
    )
    expect_refusals(
        (SchemaError, "car-park-too-narrow", "69.0 m ", lambda: car_park(rows=9)),
        (SchemaError, "car-park-too-narrow", "11", lambda: car_park(width=8.0)),
    )


@pytest.mark.parametrize("names", [np.array(["red", "blue"]), dict.fromkeys(("red", "blue")).keys()])
def test_paints_are_any_collection_of_names(names: object) -> None:
    park = car_park(length=10.0, width=16.0, neighbours=(), paints=names)  # type: ignore[arg-type]
    expected = car_park(length=10.0, width=16.0, neighbours=(), paints=["red", "blue"])
    np.testing.assert_array_equal(park.faces, expected.faces)
    assert park.materials == expected.materials
