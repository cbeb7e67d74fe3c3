"""Many samples against analytic radiometry; normals of curved surfaces, and waves of a coat."""

import numpy as np
import pytest
from oracles.fresnel import plain_glint
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

from hyperpaint.simulation.transport.hierarchy import Geometry, build_geometry, waved

# --- transport physics ---

pytestmark = pytest.mark.skipif(not COMPILED, reason="many samples want a compiler")

PLANE = (ground(), QUAD, 0)
SKY, OVERCAST, SUN = 0, 1, 2
EAST = 90.0


@pytest.mark.parametrize("alpha", [0.05, 0.1])
@pytest.mark.parametrize("view", [(40.0, 270.0), (37.0, 270.0), (40.0, 262.0), (60.0, 270.0), (10.0, 45.0)])
def test_the_glint_of_a_flat_coat(view: tuple[float, float], alpha: float) -> None:
    light, towards = sun(40, EAST), sun(*view)
    found = traced(joined(PLANE), materials((1.5, alpha)), suns(light), staring([0, 0, 0.0], towards, 4))
    irradiance = 1.3
    radiance = weight_of(found, code(SUN, mirror=True)) * irradiance / np.pi
    np.testing.assert_allclose(radiance, plain_glint(towards, light, 1.5, alpha) * irradiance, rtol=1e-3)
    if view == (40.0, 270.0) and alpha == 0.05:  # an order of magnitude above a grey paint
        assert radiance.mean() > 10 * 0.3 / np.pi * np.cos(np.radians(40)) * irradiance


def white_furnace(alpha: float, zenith: float, flakes: float = 0.0, flake_alpha: float = 0.35) -> float:
    surfaces = materials((1.5, alpha), flakes=flakes, flake_alpha=flake_alpha)
    rays = staring([0, 0, 0.0], sun(zenith, EAST), 16)
    found = traced(joined(PLANE), surfaces, suns(), rays, samples=2048, depth=2, seed=3)
    return float(found.weight.sum(axis=1, dtype=float).mean())


@pytest.mark.parametrize("zenith", [0, 30, 60, 80, 85, 88])
@pytest.mark.parametrize("alpha", [0.001, 0.05, 0.1, 0.5])
def test_a_coated_white_base_in_a_white_furnace(alpha: float, zenith: float) -> None:
    assert white_furnace(alpha, zenith) == pytest.approx(1, abs=3e-3)


@pytest.mark.parametrize("zenith", [0, 45, 60, 80, 85])
@pytest.mark.parametrize("share", [0.15, 0.3, 0.5, 0.65, 1.0])
@pytest.mark.parametrize("flake_alpha", [0.12, 0.35, 0.6])
def test_flakes_over_a_white_base_in_a_white_furnace(flake_alpha: float, share: float, zenith: float) -> None:
    assert white_furnace(0.001, zenith, share, flake_alpha) == pytest.approx(1, abs=0.01)


def test_overcast_sky_favours_what_looks_up() -> None:
    # An upright wall gets 1 / pi of the light of a level surface; of an even sky it would be 1 / 2
    wall = (rectangle([0, -50, 0], [0, 100, 0], [0, 0, 50]), QUAD, 0)
    rays = staring([0, 0, 25.0], sun(80, EAST), 64)
    found = traced(joined(wall), materials(None), suns(overcast=True), rays, samples=4096)
    # integral of 1.5 cos(zenith) / pi x cos(incidence) over the quarter sphere
    u, a = np.meshgrid((np.arange(500) + 0.5) / 500, ((np.arange(500) + 0.5) / 500 - 0.5) * np.pi)
    expected = (1.5 * u / np.pi * np.sqrt(1 - u**2) * np.cos(a)).sum() * np.pi / 500**2
    assert weight_of(found, code(OVERCAST, 0)).mean() == pytest.approx(expected, rel=5e-3)
    assert expected == pytest.approx(1 / np.pi, rel=1e-3)


def test_noise_falls_faster_than_the_root_of_the_samples() -> None:
    geometry = joined(PLANE, *[(*box(x, 0.4, 0.5, 1.0), 1) for x in (-1.1, 1.1)])
    rays = staring([0, 0, 0.0], sun(10, 180), 2000)
    counts = np.array([4, 16, 64, 256])
    spread = []
    for samples in counts:
        found = traced(geometry, materials(None, None), suns(), rays, samples=int(samples), seed=5)
        spread.append(weight_of(found, code(SKY, 0)).std())
    assert -1.0 < np.polyfit(np.log(counts), np.log(spread), 1)[0] < -0.6


def test_a_sun_with_a_disc_has_a_half_shadow() -> None:
    light, radius = sun(0), 0.02
    scene = joined(PLANE, ((rectangle([0, -50, 10], [50, 0, 0], [0, 100, 0]), QUAD, 1)))
    places, shares = [-0.25, -0.1, 0.0, 0.1, 0.25], []
    for x in places:
        rays = staring([x, 0, 0.0], sun(30, 270), 16)
        found = traced(
            scene, materials(None, None), suns(light, radius=radius), rays, samples=2048, depth=1, seed=2
        )
        shares.append(found.sun_visibility.mean())
    # share of a disc, seen from 10 m under a straight edge
    t = np.clip(np.array(places) / 10 / radius, -1, 1)
    np.testing.assert_allclose(shares, 0.5 - (t * np.sqrt(1 - t**2) + np.arcsin(t)) / np.pi, atol=0.01)


def test_light_between_floor_and_endless_wall_follows_the_series() -> None:
    # In a right angle that goes on for ever each face sees the other by half, whatever the distance
    floor = (rectangle([-1e6, -1e6, 0], [2e6, 0, 0], [0, 1e6, 0]), QUAD, 0)
    wall = (rectangle([-1e6, 0, 0], [2e6, 0, 0], [0, 0, 1e6]), QUAD, 1)
    rays = staring([0, -0.5, 0.0], sun(30, 180), 64)
    found = traced(joined(floor, wall), materials(None, None), suns(), rays, samples=4096, depth=4)
    ways = [(0,), (0, 1), (0, 1, 0), (0, 1, 0, 1)]
    shares = [weight_of(found, code(SKY, *way, indirect=len(way) > 1)).mean() for way in ways]
    np.testing.assert_allclose(shares, [1 / 2, 1 / 4, 1 / 8, 1 / 16], atol=4e-3)


def test_slots_that_are_few_keep_the_total_and_the_mean() -> None:
    geometry = joined(PLANE, *[(*box(x, 0.4, 0.5, 1.0), 1 + k) for k, x in enumerate((-1.1, 0.0, 1.1))])
    surfaces = materials(None, (1.5, 0.05), (1.5, 0.1), None)
    rays = nadir(24, 64, width=4.0)
    full = traced(geometry, surfaces, suns(sun(50)), rays, samples=64, slots=200)
    few = traced(geometry, surfaces, suns(sun(50)), rays, samples=64, slots=8)
    np.testing.assert_allclose(few.weight.sum(axis=1), full.weight.sum(axis=1), rtol=1e-5)
    assert (full.code[:, -1] == -1).all()
    used = np.unique(full.code[full.code >= 0])
    means = np.array([[weight_of(block, int(one)).mean() for one in used] for block in (full, few)])
    np.testing.assert_allclose(means[1], means[0], atol=4e-3)


# --- transport hits ---


def vault(sides: int = 4, smooth: bool = True) -> Geometry:
    # Return an upright half cylinder of radius 1 along y, 30 degrees a side
    angle = np.radians(30.0) * (np.arange(sides + 1) - sides / 2)
    around = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1)
    points = np.concatenate([around - np.array([0, 50, 0]), around + np.array([0, 50, 0])])
    k = np.arange(sides)
    low, high = np.stack([k, k + 1, k + sides + 2], 1), np.stack([k, k + sides + 2, k + sides + 1], 1)
    normals = np.tile(around, (2, 1)) if smooth else []
    return build_geometry(
        points, np.concatenate([low, high]), normals, np.zeros(2 * sides), np.zeros(2 * sides)
    )


@pytest.mark.parametrize("off", [-4.0, -1.0, 1.0, 4.0])
def test_light_fades_on_a_coarse_mesh_as_on_the_surface_it_stands_for(off: float) -> None:
    # The facet west of the top turns its back to the sun; the round vault there still faces it
    a = np.radians(off)
    inner = np.cos(np.radians(15)) / np.cos(abs(a) - np.radians(15))  # of the facet, from the axis
    rays = staring([float(inner * np.sin(a)), 0.3, float(inner * np.cos(a))], sun(3, 0), 1)
    lit = traced(vault(), materials(None), suns(sun(80)), rays)
    np.testing.assert_allclose(weight_of(lit, code(SUN, 0)), np.cos(np.radians(80) - a), rtol=0.1)
    np.testing.assert_array_equal(lit.sun_visibility, 1)
    assert (
        weight_of(traced(vault(smooth=False), materials(None), suns(sun(80)), rays), code(SUN, 0)) > 0
    ).all() == (off > 0)


def test_a_coarse_mesh_keeps_the_light_of_the_sky() -> None:
    rays = staring([0.0, 0.3, 1.0], sun(1, 0), 8)
    found = traced(vault(), materials(None), suns(), rays, samples=4096)
    assert found.weight.sum(axis=1).mean() == pytest.approx(1.0, abs=0.004)


@pytest.mark.parametrize("slope", [0.002, 0.01])
def test_waves_have_the_slope_asked_for(slope: float) -> None:
    rng = np.random.default_rng(1)
    count = 20000
    tilts = []
    for normal in rng.normal(size=(40, 3)):
        normal /= np.linalg.norm(normal)
        points = rng.uniform(-5, 5, size=(count // 40, 3))
        tilts += [np.dot(waved(tuple(normal), tuple(point), slope), normal) for point in points]
    tilts = np.tan(np.arccos(np.clip(tilts, -1, 1)))
    assert np.sqrt(np.mean(np.square(tilts))) == pytest.approx(slope, rel=0.05)


def test_waves_are_millimetres_to_a_centimetre_long() -> None:
    up, here, slope = (0.0, 0.0, 1.0), (0.31, -0.2, 0.9), 0.005
    start = np.array(waved(up, here, slope))
    apart = [
        np.linalg.norm(np.array(waved(up, (here[0] + step, here[1], here[2]), slope)) - start)
        for step in (1e-5, 1e-4, 5e-3)
    ]
    assert apart[0] < 0.05 * slope
    assert apart[1] < 0.3 * slope
    assert apart[2] > 0.3 * slope
    assert waved(up, here, slope) == waved(up, here, slope)


def test_orange_peel_spreads_a_glint_and_keeps_its_light() -> None:
    # Over a patch the glint is that of more slopes: as bright on the whole, lower at its peak
    towards, light = sun(30, 270), sun(30, 90)
    flat, wavy = materials((1.5, 0.004)), materials((1.5, 0.004))
    wavy.numbers[0, 2] = 0.005
    corners = np.array([[-9.0, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]])
    floor = build_geometry(corners, [[0, 1, 2], [0, 2, 3]], [], [0, 0], [0, 0])
    rays = staring([0, 0, 0.0], towards, 16)._replace(
        column_edges=np.linspace(-5e-3, 5e-3, 17), along_edges=np.array([-5e-3, 5e-3])
    )
    glint = [
        weight_of(traced(floor, paint, suns(light, radius=0.00466), rays, samples=4096, depth=1),
                  code(SUN, mirror=True)).mean()
        for paint in (flat, wavy)
    ]  # fmt: skip
    assert 0.1 < glint[1] / glint[0] < 0.75
