"""Fresnel, GGX and the lobes of a paint against their textbook forms and against sums over directions."""

import numpy as np
import pytest
from oracles.fresnel import plain_fresnel, plain_glint
from support.transport_scenes import COMPILED, materials

from hyperpaint.simulation.rendering.materials import internal_reflectance
from hyperpaint.simulation.transport.hierarchy import frame_of, from_frame, in_frame
from hyperpaint.simulation.transport.surfaces import (
    ENDED,
    RECYCLED,
    TWICE,
    WIDENED_ALPHA,
    Lobes,
    Surfaces,
    facet_density,
    facet_lambda,
    fresnel,
    lobes_at,
    sample_facet,
    scatter,
    scatter_body,
    scatter_coat,
    sun_weights,
)


def direction(zenith: float, azimuth: float = 0.0) -> tuple[float, float, float]:
    z, a = np.radians([zenith, azimuth])
    return float(np.sin(z) * np.cos(a)), float(np.sin(z) * np.sin(a)), float(np.cos(z))


def seen(surfaces: Surfaces, view: tuple[float, float, float], least_alpha: float = 0.0) -> Lobes:
    # Return the lobes of the first material; its coat has no waves
    return lobes_at(surfaces, 0, view, view, least_alpha)


def lit(
    surfaces: Surfaces, lobes: Lobes, light: tuple[float, float, float], radius: float = 0.0
) -> tuple[float, float, float, float]:
    return sun_weights(surfaces.numbers, lobes, light, light, radius)


def test_fresnel_is_the_mean_of_both_polarisations() -> None:
    for index in (1.1, 1.5, 2.4):
        for cosine in (1e-6, 0.1, 0.5, 0.9999, 1.0):
            assert fresnel(cosine, index) == pytest.approx(plain_fresnel(np.arccos(cosine), index), rel=1e-9)
    assert fresnel(1.0, 1.5) == pytest.approx(0.04)


@pytest.mark.parametrize("alpha", [0.02, 0.1, 0.5])
def test_facets_cover_the_surface(alpha: float) -> None:
    cosine = 1 / np.sqrt(1 + np.tan((np.arange(20000) + 0.5) / 20000 * np.pi / 2) ** 2)
    density = np.array([facet_density(float(c), alpha) for c in cosine[:: 1 if COMPILED else 20]])
    cosine = cosine[:: 1 if COMPILED else 20]
    covered = (density * cosine * np.sqrt(1 - cosine**2)).sum() * (np.pi / 2 / cosine.size) * 2 * np.pi
    assert covered == pytest.approx(1, rel=2e-3 if COMPILED else 0.5)


def test_visible_facets_have_their_density() -> None:
    alpha, view = 0.4, direction(55, 20)
    rng = np.random.default_rng(0)
    count = 50000 if COMPILED else 2000
    found = np.array([sample_facet(view, alpha, *rng.uniform(size=2)) for _ in range(count)])
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, rtol=1e-12)
    # mean of a function of the facets = its integral over D (v.h) G1 / cos
    n = 400
    a = (np.arange(n) + 0.5) / n * 2 * np.pi
    cosine, angle = (part.ravel() for part in np.meshgrid((np.arange(n) + 0.5) / n, a, indexing="ij"))
    sine = np.sqrt(1 - cosine**2)
    half = np.stack([sine * np.cos(angle), sine * np.sin(angle), cosine], axis=1)
    density = alpha**2 / (np.pi * ((alpha**2 - 1) * cosine**2 + 1) ** 2)
    density *= (
        np.clip(half @ view, 0, None) * (1 / (1 + facet_lambda(view[2], alpha))) / view[2] * 2 * np.pi / n**2
    )
    assert density.sum() == pytest.approx(1, abs=1e-3)
    expected = np.stack([density @ half, density @ half**2])
    np.testing.assert_allclose(
        np.stack([found.mean(axis=0), (found**2).mean(axis=0)]), expected, atol=4 / np.sqrt(count)
    )


@pytest.mark.parametrize(("zenith", "azimuth"), [(40, 180), (43, 180), (40, 150), (20, 180), (75, 180)])
def test_the_coat_is_the_textbook_glint(zenith: float, azimuth: float) -> None:
    view, light = direction(40), direction(zenith, azimuth)
    paint = materials((1.5, 0.1))
    expected = np.pi * plain_glint(np.array(view), np.array(light), 1.5, 0.1)
    assert lit(paint, seen(paint, view), light)[1] == pytest.approx(expected, rel=1e-9)
    expected = np.pi * plain_glint(np.array(view), np.array(light), 1.5, 0.3)
    assert lit(paint, seen(paint, view, WIDENED_ALPHA), light)[1] == pytest.approx(expected, rel=1e-9)


def disc_around(middle: np.ndarray, radius: float, rings: int = 200) -> np.ndarray:
    # Return directions that cover a disc evenly, (direction, 3)
    r = radius * np.sqrt((np.arange(rings) + 0.5) / rings)
    a = 2 * np.pi * (np.arange(2 * rings) + 0.5) / (2 * rings)
    r, a = (part.ravel() for part in np.meshgrid(r, a, indexing="ij"))
    x, y, z = frame_of(tuple(middle))
    return np.stack([np.sin(r) * np.cos(a), np.sin(r) * np.sin(a), np.cos(r)], axis=1) @ np.array([x, y, z])


@pytest.mark.parametrize("alpha", [0.001, 0.004, 0.03])
@pytest.mark.parametrize(("off", "within"), [(0.0, 0.03), (0.1, 0.03), (0.5, 0.2), (2.0, 0.02), (20.0, 0.02)])
def test_the_image_of_a_disc_is_the_mean_over_it(alpha: float, off: float, within: float) -> None:
    # Near its rim a sharp image is in view by half: what is an ellipse there, is taken for a circle
    view, radius, paint = direction(30), np.radians(0.267), materials((1.5, alpha))
    middle = direction(30 + off, 180)
    points = disc_around(np.array(middle), radius, 200 if COMPILED else 10)
    mean = plain_glint(np.array(view), points, 1.5, alpha)
    assert lit(paint, seen(paint, view), middle, radius)[1] == pytest.approx(
        np.pi * mean, rel=within if COMPILED else 0.2
    )


@pytest.mark.parametrize("alpha", [0.001, 0.05, 0.3])
@pytest.mark.parametrize("radius", [0.0, 0.00466])
def test_light_goes_both_ways_alike(alpha: float, radius: float) -> None:
    # f is the same with view and light exchanged: pi f cos_i, over cos_i
    paint = materials((1.5, alpha), flakes=0.4, flake_alpha=0.25)
    for first, second in (
        ((20, 0), (50, 160)),
        ((85, 10), (5, 200)),
        ((70, 0), (80, 90)),
        ((60, 0), (60, 180)),
    ):
        a, b = direction(*first), direction(*second)
        back = np.array(lit(paint, seen(paint, b), a, radius)) / a[2]
        np.testing.assert_allclose(np.array(lit(paint, seen(paint, a), b, radius)) / b[2], back, rtol=1e-10)


def test_the_base_is_a_diffuse_surface_under_glass() -> None:
    light = direction(50)
    for zenith in (0, 30, 70):
        view = direction(zenith)
        paint = materials((1.5, 0.001))
        base, _, flakes, recycled = lit(paint, seen(paint, view), light)
        through = np.prod([1 - plain_fresnel(np.arccos(side[2]), 1.5) for side in (view, light)])
        assert base == pytest.approx(
            through / (1.5**2 * (1 - float(internal_reflectance(1.5)))) * light[2], rel=1e-5
        )
        assert flakes == recycled == 0
    bare = materials(None)
    assert lit(bare, seen(bare, direction(70)), light) == (light[2], 0.0, 0.0, 0.0)


def test_flakes_are_mirrors_met_by_refracted_light() -> None:
    view, light = direction(25), direction(40, 160)
    paint, plain = materials((1.5, 0.001), flakes=0.4), materials((1.5, 0.001))
    flat = [np.array(side[:2]) / 1.5 for side in (view, light)]
    inner = [np.append(side, np.sqrt(1 - side @ side)) for side in flat]
    through = np.prod([1 - plain_fresnel(np.arccos(side[2]), 1.5) for side in (view, light)])
    full = plain_glint(inner[0], inner[1], 1.5, 0.35) / plain_fresnel(
        np.arccos(inner[0] @ (sum(inner) / np.linalg.norm(sum(inner)))), 1.5
    )
    base, _, flakes, _ = lit(paint, seen(paint, view), light)
    assert flakes == pytest.approx(0.4 * np.pi * through / 1.5**2 * full / inner[1][2] * light[2], rel=1e-6)
    assert base == pytest.approx(0.6 * lit(plain, seen(plain, view), light)[0])


@pytest.mark.parametrize("zenith", [0, 35, 70])
@pytest.mark.parametrize("apart", [False, True])
def test_paths_follow_the_lobes_as_the_sun_sees_them(zenith: float, apart: bool) -> None:
    # What is scattered anywhere equals the integral of what is seen of a sun from there, lobe by lobe
    paint = materials((1.5, 0.15), flakes=0.4)
    lobes = seen(paint, direction(zenith, 15))
    rng = np.random.default_rng(2)
    count = 20000 if COMPILED else 1000
    sums = np.zeros(4)
    for number in range(count):
        u, v = rng.uniform(size=2)
        u = (number + u) / count
        if apart:
            ways = [scatter_coat(lobes, u, v), scatter_body(paint.numbers, lobes, u, v)]
        else:
            ways = [scatter(paint.numbers, lobes, u, v)]
        for kind, towards, weight in ways:
            if kind != ENDED:
                sums[RECYCLED if kind == TWICE else kind] += weight
                assert np.linalg.norm(towards) == pytest.approx(1)
    n = 75 if COMPILED else 25
    a = (np.arange(2 * n) + 0.5) / n * np.pi
    expected = np.zeros(4)
    for cosine in (np.arange(n) + 0.5) / n:
        sine = np.sqrt(1 - cosine**2)
        for angle in a:
            expected += lit(paint, lobes, (sine * np.cos(angle), sine * np.sin(angle), cosine))
    expected *= 2 * np.pi / (2 * n * n) / np.pi
    np.testing.assert_allclose(sums / count, expected, rtol=0.02 if COMPILED else 0.3, atol=2e-3)
    assert sums.sum() / count == pytest.approx(1, abs=5e-3 if COMPILED else 0.1)


def test_paths_follow_a_coat_as_it_is_when_a_sun_sees_it_widened() -> None:
    paint, view = materials((1.5, 0.15), flakes=0.2), direction(50, 15)
    for draw in np.random.default_rng(4).uniform(size=(20, 2)):
        assert scatter(paint.numbers, seen(paint, view, WIDENED_ALPHA), *draw) == scatter(
            paint.numbers, seen(paint, view), *draw
        )


def test_frames_are_right_handed_everywhere() -> None:
    rng = np.random.default_rng(3)
    for normal in [*rng.normal(size=(50, 3)), [0, 0, 1], [0, 0, -1], [1e-9, 0, -1], [1, 0, 0]]:
        z = np.array(normal) / np.linalg.norm(normal)
        frame = np.array(frame_of(tuple(z)))
        np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(frame) == pytest.approx(1)
        a = rng.normal(size=3)
        np.testing.assert_allclose(from_frame(frame_of(tuple(z)), in_frame(frame_of(tuple(z)), a)), a)
