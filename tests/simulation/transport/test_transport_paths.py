"""Traced scenes against geometry by hand, exact where chance plays no part."""

import functools
import itertools
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, strategies as st
from support.transport_scenes import (
    COMPILED,
    QUAD,
    box,
    code,
    ground,
    joined,
    materials,
    nadir,
    rectangle,
    staring,
    sun,
    suns,
    traced,
    weight_of,
)

from hyperpaint.simulation.transport.hierarchy import build_geometry
from hyperpaint.simulation.transport.path_codes import even_pair, philox, pixel_key, uniforms
from hyperpaint.simulation.transport.paths import (
    Block,
    PathTable,
    Rays,
    add_path,
    with_factor,
    write_paths,
)

PLANE = (ground(), QUAD, 0)
SKY, OVERCAST, SUN = 0, 1, 2
LINES, COLUMNS, SAMPLES = (12, 16, 16) if COMPILED else (2, 3, 3)


@functools.cache
def car_park() -> tuple:
    # Return a ground, three boxes and a wall, of five materials, coated and bare, with flakes
    wall = rectangle([-3, 2.5, 0], [6, 0, 0], [0, 0, 2])
    boxes = [(*box(x, y, 0.8, 1.0), label) for x, y, label in ((-2, 0, 1), (0, 0.3, 2), (2, -0.5, 3))]
    surfaces = materials(None, (1.5, 0.05), (1.5, 0.1), (1.6, 0.02), None)
    flakes = materials(None, None, (1.5, 0.1), None, None, flakes=0.5)
    surfaces.numbers[2], surfaces.flake_factor[2] = flakes.numbers[2], 5
    return joined(PLANE, *boxes, (wall, QUAD, 4)), surfaces


def same(first: Block, second: Block) -> None:
    for name, a, b in zip(Block._fields, first, second, strict=True):
        np.testing.assert_array_equal(a, b, err_msg=name)


@pytest.mark.slow
def test_a_lambert_plane_is_exact_in_every_pixel() -> None:
    found = traced(
        joined(PLANE), materials(None), suns(sun(60), overcast=True), nadir(LINES, COLUMNS, width=8.0)
    )
    np.testing.assert_allclose(weight_of(found, code(SKY, 0)), 1, rtol=1e-12)
    np.testing.assert_allclose(weight_of(found, code(SUN, 0)), 0.5, rtol=1e-7)  # float32
    assert (weight_of(found, code(OVERCAST, 0)) > 0).all()
    assert ((found.code >= 0).sum(axis=1) == 3).all()
    # L = rho (E_sun cos + E_sky) / pi
    rho, e_sun, e_sky = 0.3, 1.7, 0.4
    radiance = rho / np.pi * (weight_of(found, code(SUN, 0)) * e_sun + weight_of(found, code(SKY, 0)) * e_sky)
    np.testing.assert_allclose(radiance, rho * (e_sun * 0.5 + e_sky) / np.pi, rtol=1e-6)
    np.testing.assert_array_equal(found.purity, 1)
    np.testing.assert_array_equal(found.sun_visibility, 1)
    np.testing.assert_allclose(found.incidence, 0.5, rtol=1e-7)
    assert (found.material == 0).all()
    assert (found.instance == 0).all()


def test_parts_have_their_types_and_empty_slots_come_last() -> None:
    geometry, surfaces = car_park()
    found = traced(geometry, surfaces, suns(sun(40), sun(70, 200)), nadir(LINES, COLUMNS, width=8.0))
    assert [part.dtype.str[1:] for part in found] == ["f4", "i8", "i4", "i4", "f4", "f4", "f8", "f4", "f4"]
    used = found.code >= 0
    assert (np.diff(used.astype(int), axis=1) <= 0).all()
    assert (np.diff(found.code, axis=1)[used[:, 1:]] > 0).all()
    assert (found.weight[used] > 0).all()
    assert (found.weight[~used] == 0).all()
    assert set(np.unique(found.code[used] & 31)) == {SKY, SUN, SUN + 1}


@pytest.mark.parametrize("cuts", [(0, 1, 5, LINES), (0, LINES // 2, LINES)] if COMPILED else [(0, 1, 2)])
def test_the_same_bits_in_any_blocks(cuts: tuple[int, ...]) -> None:
    geometry, surfaces = car_park()
    light, rays = suns(sun(50), overcast=True, radius=0.005), nadir(LINES, COLUMNS, width=8.0)
    whole = traced(geometry, surfaces, light, rays, samples=SAMPLES, seed=9, first_line=100, slots=6)
    for start, stop in itertools.pairwise(cuts):
        part = Rays(rays.origin[start:stop], rays.rotation[start:stop], *rays[2:])
        same(
            traced(geometry, surfaces, light, part, samples=SAMPLES, seed=9, first_line=100 + start, slots=6),
            Block(*(piece[start:stop] for piece in whole)),
        )


def test_the_same_bits_on_threads() -> None:
    geometry, surfaces = car_park()
    given = (geometry, surfaces, suns(sun(50)), nadir(LINES, COLUMNS, width=8.0))
    alone = traced(*given, samples=SAMPLES)
    with ThreadPoolExecutor(3) as pool:
        found = list(pool.map(lambda _: traced(*given, samples=SAMPLES), range(6)))
    for block in found:
        same(block, alone)


def test_lines_and_seeds_have_numbers_of_their_own() -> None:
    geometry, surfaces = car_park()
    rays = nadir(LINES, COLUMNS, width=8.0)
    given = {"geometry": geometry, "surfaces": surfaces, "sources": suns(sun(50)), "rays": rays, "samples": 4}
    base = traced(**given).weight
    assert (traced(**given).weight == base).all()
    assert (traced(**given, seed=1).weight != base).any()
    assert (traced(**given, first_line=1).weight != base).any()


def test_the_camera_looks_where_its_attitude_says() -> None:
    edges, along = np.array([-0.5, -0.3, 0.5, 0.51]), np.array([0.2, 0.21])
    heading, pitch, roll = np.radians([30.0, 4.0, -7.0])
    cz, sz, cy, sy, cx, sx = (
        f(a) for a in (heading, pitch, roll) for f in (np.cos, np.sin)
    )  # fmt: skip
    north_east_down = (
        np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
        @ np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
        @ np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    )
    rotation = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]]) @ north_east_down
    rays = Rays(np.array([[[3.0, 4, 25], [3, 4, 25]]]), np.tile(rotation, (1, 2, 1, 1)), edges, along)
    found = traced(joined(PLANE), materials(None), suns(), rays, samples=400 if COMPILED else 60)
    for column in range(3):
        middle = np.array([0.205, edges[column : column + 2].mean(), 1])
        towards = rotation @ middle
        point = np.array([3, 4, 25]) - towards * 25 / towards[2]
        np.testing.assert_allclose(found.position[0, :, column], point, atol=0.1 if column == 2 else 1.5)
    assert found.position[0, 0, 0] < found.position[0, 0, 2]  # right is east of left
    np.testing.assert_allclose(
        found.distance[0, 2], np.linalg.norm(rotation @ middle) * 25 / -towards[2], rtol=0.01
    )


def test_exposure_smears_the_line_along_the_flight() -> None:
    origin = np.array([[[0.0, -3, 10], [0.0, 5, 10]]])
    rotation = np.tile(np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]]), (1, 2, 1, 1))
    rays = Rays(origin, rotation, np.array([-1e-6, 1e-6]), np.array([-1e-6, 1e-6]))
    strip = (rectangle([-1, 1, 0.5], [2, 0, 0], [0, 20, 0]), QUAD, 1)
    found = traced(
        joined(PLANE, strip), materials(None, None), suns(), rays, samples=4000 if COMPILED else 200
    )
    near = 0.03 if COMPILED else 0.15
    assert found.position[0, 1, 0] == pytest.approx(1, abs=8 * near)
    assert found.purity[0, 0] == pytest.approx(0.5, abs=near)


def test_labels_are_those_of_most_samples() -> None:
    half = (rectangle([-50, -50, 0.0], [50.6, 0, 0], [0, 100, 0]), QUAD, 1)
    rest = (rectangle([0.6, -50, 0.0], [50, 0, 0], [0, 100, 0]), QUAD, 0)
    rays = nadir(2, 3, width=3.0)  # the middle pixel: -0.5 to 0.5; the last: 0.5 to 1.5
    found = traced(joined(half, rest), materials(None, None), suns(), rays, samples=200)
    np.testing.assert_array_equal(found.material, [[1, 1, 0]] * 2)
    np.testing.assert_array_equal(found.instance, [[0, 0, 1]] * 2)
    np.testing.assert_array_equal(found.purity[:, :2], 1)
    np.testing.assert_allclose(found.purity[:, 2], 0.9, atol=0.08)


def test_a_view_of_the_sky_has_no_labels() -> None:
    rays = staring([0, 0, 5.0], -sun(20), 3)  # from below, upwards
    found = traced(joined(PLANE), materials(None), suns(sun(30), overcast=True), rays._replace(
        origin=np.full((1, 2, 3), 5.0)
    ))  # fmt: skip
    for labels in (found.material, found.instance):
        assert (labels == -1).all()
    for part in (found.distance, found.position, found.sun_visibility, found.weight[:, 0]):
        assert np.isnan(part).all()
    assert (found.weight[:, 1:] == 0).all()
    assert (found.code[:, 0] == code(SKY)).all()


def test_rays_that_meet_nothing_are_no_part_of_a_pixel() -> None:
    edge = (rectangle([-50, -50, 0.0], [50.0, 0, 0], [0, 100, 0]), QUAD, 0)  # half of the pixel
    found = traced(joined(edge), materials(None), suns(sun(60)), nadir(1, 1, width=0.2), samples=64)
    np.testing.assert_allclose(weight_of(found, code(SUN, 0)), 0.5, rtol=1e-6)
    np.testing.assert_allclose(weight_of(found, code(SKY, 0)), 1.0, rtol=1e-6)


def test_light_from_below_the_horizon_ends_at_the_ground() -> None:
    # An upright wall without ground gets half of the even sky, and none through the earth
    wall = (rectangle([0, -50, 0], [0, 100, 0], [0, 0, 50]), QUAD, 0)
    count = 2048 if COMPILED else 64
    found = traced(joined(wall), materials(None), suns(), staring([0, 0, 25.0], sun(80), 4), samples=count)
    assert weight_of(found, code(SKY, 0)).mean() == pytest.approx(0.5, abs=0.005 if COMPILED else 0.1)


def test_shadows_hide_the_sun_only() -> None:
    roof = (rectangle([-1, -1, 3.0], [2, 0, 0], [0, 2, 0]), QUAD, 1)
    towards = sun(45)
    shaded, lit = [-3.0, 0, 0], [3.0, 0, 0]  # the sun stands in the east: the shadow falls west
    for point, seen in ((shaded, 0.0), (lit, 1.0)):
        found = traced(
            joined(PLANE, roof), materials(None, None), suns(towards), staring(point, sun(10, 180), 2)
        )
        np.testing.assert_array_equal(found.sun_visibility, seen)
        np.testing.assert_allclose(found.incidence, np.sqrt(0.5), rtol=1e-6)
        np.testing.assert_allclose(weight_of(found, code(SUN, 0)), seen * np.sqrt(0.5), rtol=1e-6)


def test_surfaces_are_seen_from_both_sides() -> None:
    up = traced(joined(PLANE), materials(None), suns(sun(30)), staring([0, 0, 0.0], sun(20), 1))
    turned = (ground(), QUAD[:, ::-1], 0)
    down = traced(joined(turned), materials(None), suns(sun(30)), staring([0, 0, 0.0], sun(20), 1))
    np.testing.assert_array_equal(up.code, down.code)
    np.testing.assert_allclose(up.weight, down.weight, rtol=1e-6)
    below = traced(joined(PLANE), materials(None), suns(sun(30)), staring([0, 0, 0.0], -sun(20), 1))
    np.testing.assert_array_equal(below.sun_visibility, 0)
    np.testing.assert_array_equal(below.incidence, 0)


def test_smooth_normals_turn_the_light_and_not_the_shape() -> None:
    geometry = build_geometry(ground(), QUAD, np.tile([np.sin(0.2), 0, np.cos(0.2)], (4, 1)), [0, 0], [0, 0])
    found = traced(geometry, materials(None), suns(sun(60)), staring([0, 0, 0.0], sun(5), 2))
    np.testing.assert_allclose(weight_of(found, code(SUN, 0)), np.cos(np.pi / 3 - 0.2), rtol=1e-6)
    np.testing.assert_allclose(found.incidence, np.cos(np.pi / 3 - 0.2), rtol=1e-6)
    np.testing.assert_allclose(found.position[0, :, 0], 0, atol=1e-7)
    assert (weight_of(found, code(SKY, 0)) <= 1 + 1e-6).all()


def test_codes_tell_the_mirror_from_the_diffuse_way() -> None:
    # A smooth coat shows a sun-lit wall: sun, wall's factor, through the mirror, more than one surface
    wall = (rectangle([-200, 4.0, 0], [400, 0, 0], [0, 0, 300]), QUAD, 1)
    towards = sun(60, 180)  # behind the camera's back: on the wall's face
    rays = staring([0, 0, 0.0], sun(50, 180), 8)
    found = traced(
        joined(PLANE, wall), materials((1.5, 0.001), None), suns(towards), rays,
        samples=4000 if COMPILED else 40, depth=2,
    )  # fmt: skip
    mirrored = weight_of(found, code(SUN, 1, mirror=True, indirect=True)).mean()
    cosine = np.cos(np.radians(50))
    g = np.sqrt(1.25 + cosine**2)
    a, b = (g - cosine) / (g + cosine), (cosine * (g + cosine) - 1) / (cosine * (g - cosine) + 1)
    expected = 0.5 * a**2 * (1 + b**2) * np.sin(np.radians(60))  # F x cosine of the sun on the wall
    assert mirrored == pytest.approx(expected, rel=0.03 if COMPILED else 0.5)
    assert weight_of(found, code(SUN, 0, 1, indirect=True)).mean() > 0
    assert (weight_of(found, code(SUN, 1, indirect=True)) == 0).all()


def test_white_grooves_lose_nothing_but_the_last_bounce() -> None:
    # With every factor 1, Lambert surfaces under an even sky are as bright as the sky, of any shape
    left = (rectangle([0, -50, 0], [-1, 0, 1], [0, 100, 0]), QUAD, 0)
    right = (rectangle([0, -50, 0], [1, 0, 1], [0, 100, 0]), QUAD, 0)
    rays = nadir(2, 4, width=1.6)
    deep = traced(joined(left, right), materials(None), suns(), rays, depth=40, digit_bits=1, samples=64)
    np.testing.assert_allclose(deep.weight.sum(axis=1), 1, rtol=1e-6)
    shallow = traced(joined(left, right), materials(None), suns(), rays, depth=2, digit_bits=1, samples=64)
    assert (shallow.weight.sum(axis=1) < 1).any()


#: Known answers of the authors' library Random123 1.09, kat_vectors, "philox4x32 10".
KNOWN = [
    ([0] * 4, [0] * 2, [0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8]),
    ([0xFFFFFFFF] * 4, [0xFFFFFFFF] * 2, [0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD]),
    (
        [0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344],
        [0xA4093822, 0x299F31D0],
        [0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1],
    ),
]


@pytest.mark.parametrize(("counter", "key", "words"), KNOWN)
def test_philox_gives_the_published_words(counter: list[int], key: list[int], words: list[int]) -> None:
    assert [int(word) for word in philox(*map(np.uint64, counter), *map(np.uint64, key))] == words


def test_numbers_are_even_inside_the_interval() -> None:
    count = 20000 if COMPILED else 500
    found = np.array([uniforms(7, 3, 5, sample, 2) for sample in range(count)])
    assert ((found > 0) & (found < 1)).all()
    np.testing.assert_allclose(found.mean(axis=0), 0.5, atol=4 / np.sqrt(12 * count))
    np.testing.assert_allclose(np.corrcoef(found.T), np.eye(4), atol=5 / np.sqrt(count))


def test_every_part_of_the_key_matters() -> None:
    places = [
        (0, 0, 0, 0, 0), (1, 0, 0, 0, 0), (1 << 40, 0, 0, 0, 0), (0, 1, 0, 0, 0), (0, 0, 1, 0, 0),
        (0, 0, 0, 1, 0), (0, 0, 0, 0, 1),
    ]  # fmt: skip
    assert len({uniforms(*place) for place in places}) == len(places)
    assert uniforms(1, 2, 3, 4, 5) == uniforms(1, 2, 3, 4, 5)


@pytest.mark.parametrize("count", [16, 64, 100, 256])
def test_even_pairs_share_out_the_square(count: int) -> None:
    # Any 2^m points of a (0, 2)-sequence: one in each of 2^m boxes, of every shape of a power of two
    mask = (1 << (count - 1).bit_length()) - 1
    whole = 1 << (count.bit_length() - 1)
    for draw in range(3):
        key = pixel_key(5, 3, draw)
        points = np.array([even_pair(key, sample, draw, mask) for sample in range(count)])
        assert ((points > 0) & (points < 1)).all()
        for across in (1 << power for power in range(whole.bit_length())):
            assert (
                len({tuple(box) for box in (points[:whole] * (across, whole // across)).astype(int)}) == whole
            )


def test_even_pairs_of_other_draws_and_pixels_are_others() -> None:
    count = 256 if COMPILED else 64

    def points(key: int, draw: int) -> np.ndarray:
        return np.array([even_pair(key, sample, draw, count - 1) for sample in range(count)])

    one = points(pixel_key(0, 1, 2), 0)
    for other in (
        points(pixel_key(0, 1, 2), 1),
        points(pixel_key(0, 1, 3), 0),
        points(pixel_key(1, 1, 2), 0),
    ):
        assert np.abs(np.corrcoef(np.hstack([one, other]).T)[:2, 2:]).max() < 5 / np.sqrt(count)
    places = np.array([even_pair(pixel_key(9, 0, column), 7, 2, 63) for column in range(count)])
    np.testing.assert_allclose(places.mean(axis=0), 0.5, atol=5 / np.sqrt(12 * count))


# --- codes of paths, and what becomes of them where slots are few -------------------------------------------


def table(size: int = 4096) -> PathTable:
    return PathTable(np.full(size, -1), np.zeros(size), np.empty(size, np.int64), np.zeros(1, np.int64))


def written(paths: list[tuple[int, float]], slots: int, draw: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    room = table()
    for number, weight in paths:
        add_path(room, number, weight)
    weights, codes = np.empty((1, slots, 1), np.float32), np.empty((1, slots, 1), np.int64)
    write_paths(room, 1.0, draw, weights, codes, 0, 0)
    return codes[0, :, 0], weights[0, :, 0]


@given(st.lists(st.integers(0, 6), max_size=4), st.integers(3, 14))
def test_factors_in_any_order_are_one_code(factors: list[int], bits: int) -> None:
    found = set()
    for order in itertools.permutations(factors):
        number = SKY
        for factor in order:
            number = with_factor(number, factor, bits)
        found.add(int(number))
    assert found == {code(0, *factors, digit_bits=bits)}


def test_weights_of_one_code_are_added_and_codes_sorted() -> None:
    rng = np.random.default_rng(0)
    known = rng.integers(0, 2**62, 40)
    paths = [(int(known[k]), float(rng.uniform())) for k in rng.integers(0, 40, 500)]
    codes, weights = written(paths, 48)
    expected = {int(k): sum(w for c, w in paths if c == k) for k in known}
    assert codes[:40].tolist() == sorted(expected)
    np.testing.assert_allclose(weights[:40], [expected[k] for k in sorted(expected)], rtol=1e-6)
    assert (codes[40:] == -1).all()
    assert (weights[40:] == 0).all()


def test_paths_without_weight_leave_no_code() -> None:
    codes, _ = written([(5, 0.0), (6, -1.0), (7, float("nan")), (8, 1.0)], 3)
    assert codes.tolist() == [8, -1, -1]


def test_few_slots_keep_the_heaviest_and_the_total() -> None:
    true = np.concatenate([[5.0, 3.0, 2.0], np.random.default_rng(1).uniform(0.01, 0.1, 60)])
    paths = [(100 + i, float(weight)) for i, weight in enumerate(true)]
    draws = (np.arange(400 if COMPILED else 40) + 0.5) / (400 if COMPILED else 40)
    mean = np.zeros(len(true))
    for draw in draws:
        codes, weights = written(paths, 8, float(draw))
        assert (codes[:3] == [100, 101, 102]).all()
        assert (np.diff(codes) > 0).all()
        np.testing.assert_allclose(weights[:3], true[:3], rtol=1e-6)
        assert weights.sum() == pytest.approx(true.sum(), rel=1e-6)
        mean[codes - 100] += weights / len(draws)
    np.testing.assert_allclose(mean, true, rtol=0.1 if COMPILED else 1, atol=0.02)  # unbiased, code by code


@given(st.lists(st.floats(1e-6, 1e3), min_size=1, max_size=40), st.integers(1, 12), st.floats(1e-9, 1 - 1e-9))
def test_any_pixel_fits_its_slots(weights: list[float], slots: int, draw: float) -> None:
    codes, found = written(list(enumerate(weights)), slots, draw)
    assert (codes >= 0).sum() == min(slots, len(weights))
    assert found.sum() == pytest.approx(sum(weights), rel=1e-5)
    assert (found[codes >= 0] > 0).all()
    assert (np.diff(codes[codes >= 0]) > 0).all()


def test_a_table_is_used_again() -> None:
    room = table(64)
    for round_ in range(3):
        for i in range(room[3][0]):
            room[0][room[2][i]] = -1
        room[3][0] = 0
        for number in range(20):
            add_path(room, 1000 * round_ + number, 1.0)
        weights, codes = np.empty((1, 4, 1), np.float32), np.empty((1, 4, 1), np.int64)
        write_paths(room, 1.0, 0.3, weights, codes, 0, 0)
        assert (codes >= 1000 * round_).all()
        assert weights.sum() == pytest.approx(20)
