"""Rays among triangles against every triangle tried in turn, and against exact geometry."""

import time

import numpy as np
import pytest
from support.refusals import expect_error
from support.transport_scenes import COMPILED, QUAD, ground

from hyperpaint.simulation.transport.hierarchy import STACK, Geometry, build_geometry, closest, occluded

COUNT = 400 if COMPILED else 25


def geometry_of(triangles: np.ndarray) -> Geometry:
    # Return the geometry of triangles (face, 3, 3), each with a label of its own
    labels = np.arange(len(triangles))
    return build_geometry(
        triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3), [], labels, labels
    )


def met(geometry: Geometry, origin: np.ndarray, direction: np.ndarray, limit: float = np.inf) -> tuple:
    stack, entries = np.empty(STACK, np.int64), np.empty(STACK)
    start, towards = tuple(map(float, origin)), tuple(map(float, direction))
    distance, face, weights = closest(geometry, stack, entries, start, towards, limit)
    assert occluded(geometry, stack, entries, start, towards, limit) == (face >= 0)
    return distance, face, weights


def distances(triangles: np.ndarray, origin: np.ndarray, direction: np.ndarray) -> tuple[float, float]:
    # Return distances to the nearest triangle, had all been a little smaller; a little larger
    a, b, c = triangles[:, 0] - origin, triangles[:, 1] - origin, triangles[:, 2] - origin
    side = np.cross(b - a, c - a)
    slope = side @ direction
    parallel = np.abs(slope) <= 1e-9 * np.linalg.norm(side, axis=1) * np.linalg.norm(direction)
    t = (side * a).sum(axis=1) / np.where(parallel, 1, slope)
    point = t[:, None] * direction
    areas = [(np.cross(q - point, r - point) * side).sum(axis=1) for q, r in ((b, c), (c, a), (a, b))]
    lowest = np.min(areas, axis=0) / np.maximum((side**2).sum(axis=1), 1e-300)
    nearest = [
        np.min(t[~parallel & (lowest > margin) & (t > margin)], initial=np.inf) for margin in (1e-7, -1e-7)
    ]
    return nearest[0], nearest[1]


def soups() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(5)
    triangles = rng.normal(size=(COUNT, 1, 3)) * 3 + rng.normal(size=(COUNT, 3, 3))
    grid = rng.integers(-3, 4, size=(COUNT, 3, 3)).astype(float)  # many share corners, edges, planes
    aligned = triangles.copy()
    aligned[:, :, 2] = np.round(aligned[:, :1, 2])  # level, in few planes
    needles = triangles.copy()
    needles[:, 2] = needles[:, 1] + 1e-5 * (needles[:, 2] - needles[:, 0])
    return {
        "soup": triangles, "grid": grid, "aligned": aligned, "needles": needles, "one": triangles[:1],
        "scales": triangles * 2.0 ** -rng.integers(0, 40, COUNT)[:, None, None],
        "copies": np.repeat(triangles[:3], COUNT // 3, axis=0),
        "line": triangles[:1] + np.arange(COUNT)[:, None, None] * [0, 0.5, 0],
    }  # fmt: skip


@pytest.mark.parametrize("name", sorted(soups()))
@pytest.mark.slow
def test_rays_meet_what_trying_all_finds(name: str) -> None:
    triangles = soups()[name]
    geometry = geometry_of(triangles)
    rng = np.random.default_rng(6)
    hits = 0
    for number in range(600 if COMPILED else 12):
        origin = rng.normal(size=3) * 5
        if number % 2:
            origin = np.round(origin)  # in the planes of boxes
        direction = rng.normal(size=3)
        if number % 3 == 0:  # at a triangle
            direction = rng.dirichlet(np.ones(3)) @ triangles[rng.integers(len(triangles))] - origin
        if number % 5 == 0:  # along axes
            direction = np.eye(3)[number % 3] * rng.choice([-1.0, 1.0])
        inner, outer = distances(triangles, origin, direction)
        distance, face, weights = met(geometry, origin, direction)
        assert outer * (1 - 1e-7) - 1e-7 <= distance <= inner * (1 + 1e-7) + 1e-7
        if face >= 0:
            hits += 1
            np.testing.assert_allclose(
                weights @ triangles[geometry.face_material[face]], origin + distance * direction, atol=1e-6
            )
            assert met(geometry, origin, direction, distance * (1 - 1e-9))[1] == -1
    assert hits > 3 or not COMPILED


def test_the_limit_ends_a_ray() -> None:
    geometry = build_geometry(ground(), QUAD, [], [0, 0], [0, 0])
    for limit, face in ((1.0, -1), (2.0 + 1e-9, 1)):
        distance, found, _ = met(geometry, np.array([0.3, 0.1, 2.0]), np.array([0, 0, -1.0]), limit)
        assert (found >= 0, distance) == (face >= 0, pytest.approx(min(limit, 2.0)))


@pytest.mark.parametrize("shift", [0.0, 12345.678])
def test_no_ray_slips_through_edges_and_corners(shift: float) -> None:
    n = 12 if COMPILED else 4
    rng = np.random.default_rng(1)
    x, y = np.meshgrid(np.arange(n + 1.0), np.arange(n + 1.0), indexing="ij")
    for z in (np.zeros_like(x), rng.normal(size=x.shape) * 0.1):
        corners = np.stack([x, y, z], axis=-1).reshape(-1, 3) / 3 + shift
        at = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
        faces = np.concatenate(
            [np.stack([at, at + n + 1, at + n + 2], 1), np.stack([at, at + n + 2, at + 1], 1)]
        )
        geometry = build_geometry(corners, faces, [], np.zeros(len(faces)), np.zeros(len(faces)))
        inside = corners.reshape(n + 1, n + 1, 3)[1:-1, 1:-1].reshape(-1, 3)
        quad = rng.choice(at, size=4 * len(inside))
        a, b = corners[quad], corners[quad + n + 2]  # diagonals, shared by two
        edge = a + rng.uniform(size=(len(quad), 1)) * (b - a)
        above = np.array([0, 0, 7.0])
        for target in np.concatenate([inside, edge, (a + b) / 2]):
            for origin in (target + above, target + rng.normal(size=3) + 9 * above):
                assert met(geometry, origin, target - origin)[1] >= 0


def test_flat_boxes_are_met_edge_on_and_from_within() -> None:
    geometry = build_geometry(ground(1.0), QUAD, [], [0, 0], [0, 0])
    assert met(geometry, np.array([-5.0, 0, 0]), np.array([1.0, 0, 0]))[1] == -1  # in the plane: no area
    assert met(geometry, np.zeros(3), np.array([0, 0, 1.0]))[1] == -1  # begins on it
    assert met(geometry, np.array([0, 0, 1.0]), np.array([1e-300, 0, -1.0]))[1] >= 0


def test_nothing_and_triangles_without_area_are_not_met() -> None:
    for triangles in (np.empty((0, 3, 3)), np.ones((5, 3, 3)), np.arange(9.0).reshape(1, 3, 3)):
        geometry = geometry_of(triangles)
        assert len(geometry.face_material) == 0
        assert met(geometry, np.array([1.0, 1, 5]), np.array([0, 0, -1.0]))[1] == -1


def depths(geometry: Geometry) -> int:
    # Return the length of the longest branch
    levels = np.zeros(len(geometry.links) // 2, int)
    for node in range(len(levels)):
        for link in geometry.links[2 * node : 2 * node + 2]:
            if link >= 0:
                levels[link] = levels[node] + 1
    return int(levels.max()) + 1


def test_leaves_hold_every_triangle_once_and_branches_stay_short() -> None:
    for triangles in soups().values():
        geometry = geometry_of(triangles)
        packed = -(geometry.links[geometry.links < 0] + 1)
        runs = [np.arange(value >> 4, (value >> 4) + (value & 15)) for value in packed]
        np.testing.assert_array_equal(np.sort(np.concatenate(runs)), np.arange(len(geometry.face_material)))
        assert len(np.unique(geometry.face_material)) == len(geometry.face_material)
        assert depths(geometry) < STACK
        np.testing.assert_array_equal(geometry.triangles.reshape(-1, 3, 3), triangles[geometry.face_material])
        np.testing.assert_array_equal(geometry.face_instance, geometry.face_material)
        box = geometry.nodes.reshape(-1, 2, 3, 2)[0, 0]
        used = triangles[geometry.face_material].reshape(-1, 3)
        np.testing.assert_allclose(box[:, 0], used.min(axis=0), atol=1e-9)
        np.testing.assert_allclose(box[:, 1], used.max(axis=0), atol=1e-9)


def test_ever_smaller_triangles_do_not_outgrow_the_stack() -> None:
    count = 1000 if COMPILED else 200
    small = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.5]]) * 0.5 ** np.arange(count)[:, None, None]
    assert depths(geometry_of(small + [1.0, 0, 0] * 0.5 ** np.arange(count)[:, None, None])) < STACK


def test_shading_normals_are_unit_or_absent() -> None:
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    normals = np.array([[0, 0, 2.0], [0, 3.0, 0], [1, 0, 0], [0, 0, 0]])
    geometry = build_geometry(corners, [[0, 1, 2], [1, 3, 2]], normals, [0, 0], [0, 1])
    smooth = geometry.corner_normals.reshape(2, 3, 3)[np.argsort(geometry.face_instance)]
    np.testing.assert_array_equal(smooth[0], [[0, 0, 1], [0, 1, 0], [1, 0, 0]])
    np.testing.assert_array_equal(smooth[1], 0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"vertices": [[0, 0, np.nan], [1, 0, 0], [0, 1, 0]]}, "finite"),
        ({"vertices": [[0, 0, 1e12], [1, 0, 0], [0, 1, 0]]}, "within 1e"),
    ],
)
def test_hostile_geometry_is_refused(change: dict, words: str) -> None:
    given = {
        "vertices": [[0, 0, 0], [1, 0, 0], [0, 1, 0]], "faces": [[0, 1, 2]], "normals": [],
        "face_material": [0], "face_instance": [0],
    } | change  # fmt: skip
    expect_error(ValueError, words, lambda: build_geometry(**given))


@pytest.mark.skipif(not COMPILED, reason="a million triangles want a compiler")
@pytest.mark.slow
def test_a_million_triangles_are_sorted_in_seconds() -> None:
    n = 708
    x, y = np.meshgrid(np.arange(n + 1.0), np.arange(n + 1.0), indexing="ij")
    corners = np.stack([x, y, np.sin(x) * np.cos(y)], axis=-1).reshape(-1, 3)
    at = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    faces = np.concatenate([np.stack([at, at + n + 1, at + n + 2], 1), np.stack([at, at + n + 2, at + 1], 1)])
    labels = np.zeros(len(faces), np.int32)
    begin = time.process_time()
    geometry = build_geometry(corners, faces, np.zeros_like(corners), labels, labels)
    assert time.process_time() - begin < 20
    assert len(geometry.face_material) == 2 * n * n
    assert depths(geometry) < STACK
    assert met(geometry, np.array([300.2, 400.7, 50.0]), np.array([0.0, 0, -1]))[1] >= 0
