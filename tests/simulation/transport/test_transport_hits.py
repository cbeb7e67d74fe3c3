"""Normals and points where light goes on: coarse meshes that stand for curved ones, and waves of a coat."""

import numpy as np
import pytest
from support.transport_scenes import COMPILED, code, materials, staring, sun, suns, traced, weight_of

from hyperpaint.simulation.transport.hierarchy import Geometry, build_geometry, waved

SKY, SUN = 0, 2


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
    found = traced(vault(), materials(None), suns(), rays, samples=4096 if COMPILED else 64)
    assert found.weight.sum(axis=1).mean() == pytest.approx(1.0, abs=0.004 if COMPILED else 0.1)


@pytest.mark.parametrize("slope", [0.002, 0.01])
def test_waves_have_the_slope_asked_for(slope: float) -> None:
    rng = np.random.default_rng(1)
    count = 20000 if COMPILED else 1000
    tilts = []
    for normal in rng.normal(size=(40, 3)):
        normal /= np.linalg.norm(normal)
        points = rng.uniform(-5, 5, size=(count // 40, 3))
        tilts += [np.dot(waved(tuple(normal), tuple(point), slope), normal) for point in points]
    tilts = np.tan(np.arccos(np.clip(tilts, -1, 1)))
    assert np.sqrt(np.mean(np.square(tilts))) == pytest.approx(slope, rel=0.05 if COMPILED else 0.2)


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
    count = 4096 if COMPILED else 16
    glint = [
        weight_of(traced(floor, paint, suns(light, radius=0.00466), rays, samples=count, depth=1),
                  code(SUN, mirror=True)).mean()
        for paint in (flat, wavy)
    ]  # fmt: skip
    if COMPILED:
        assert 0.1 < glint[1] / glint[0] < 0.75
