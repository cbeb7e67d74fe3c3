"""Fresnel, GGX and the lobes of a paint against their textbook forms and against sums over directions."""

from __future__ import annotations

import numpy as np
import pytest
from support.transport_scenes import COMPILED, materials

from hyperpaint.simulation.rendering.materials import internal_reflectance
from hyperpaint.simulation.transport.surfaces import (
    BASE,
    COAT,
    ENDED,
    FLAKES,
    facet_density,
    facet_lambda,
    fresnel,
    lobes_at,
    sample_facet,
    scatter,
    sun_weights,
)
from hyperpaint.simulation.transport.vectors import frame_of, from_frame, in_frame


def fresnel_by_angles(cosine: np.ndarray, index: float) -> np.ndarray:
    """Return the mean of both polarisations from Snell's angles."""
    outside = np.arccos(cosine)
    inside = np.arcsin(np.sin(outside) / index)
    s = (np.cos(outside) - index * np.cos(inside)) / (np.cos(outside) + index * np.cos(inside))
    p = (index * np.cos(outside) - np.cos(inside)) / (index * np.cos(outside) + np.cos(inside))
    return (s**2 + p**2) / 2


def glint_by_angles(view: np.ndarray, light: np.ndarray, index: float, alpha: float) -> float:
    """Return F D G / (4 cos_o), GGX in tangents (Walter et al. 2007; Heitz 2014, height-correlated)."""
    half = (view + light) / np.linalg.norm(view + light)
    tan2 = (1 - half[2] ** 2) / half[2] ** 2
    density = alpha**2 / (np.pi * half[2] ** 4 * (alpha**2 + tan2) ** 2)
    slope = [np.tan(np.arccos(side[2])) for side in (view, light)]
    smith = [(np.sqrt(1 + alpha**2 * t**2) - 1) / 2 for t in slope]
    shadow = 1 / (1 + sum(smith))
    return float(fresnel_by_angles(np.array(view @ half), index) * density * shadow / (4 * view[2]))


def direction(zenith: float, azimuth: float = 0.0) -> tuple[float, float, float]:
    z, a = np.radians([zenith, azimuth])
    return float(np.sin(z) * np.cos(a)), float(np.sin(z) * np.sin(a)), float(np.cos(z))


def test_fresnel_is_the_mean_of_both_polarisations() -> None:
    for index in (1.1, 1.5, 2.4):
        for cosine in (1e-6, 0.1, 0.5, 0.9999, 1.0):
            expected = fresnel_by_angles(np.array(cosine), index)
            assert fresnel(cosine, index) == pytest.approx(float(expected), rel=1e-9)
    assert fresnel(1.0, 1.5) == pytest.approx(0.04)


@pytest.mark.parametrize("index", [1.2, 1.5, 2.0])
def test_internal_reflectance_is_an_integral_over_directions(index: float) -> None:
    u = (np.arange(200000) + 0.5) / 200000  # cos^2, even: diffuse light
    outside = fresnel_by_angles(np.sqrt(u), index).mean()
    sine = np.sqrt(1 - u) * index
    total = sine >= 1
    leaving = np.where(total, 0, 1 - fresnel_by_angles(np.sqrt(np.where(total, 1, 1 - sine**2)), index))
    assert internal_reflectance(index) == pytest.approx(1 - (1 - outside) / index**2, abs=1e-6)
    assert internal_reflectance(index) == pytest.approx(1 - leaving.mean(), abs=1e-5)


@pytest.mark.parametrize("alpha", [0.02, 0.1, 0.5])
def test_facets_cover_the_surface(alpha: float) -> None:
    tangent = np.tan((np.arange(20000) + 0.5) / 20000 * np.pi / 2)
    cosine = 1 / np.sqrt(1 + tangent**2)
    density = np.array([facet_density(float(c), alpha) for c in cosine[:: 1 if COMPILED else 20]])
    cosine = cosine[:: 1 if COMPILED else 20]
    step = np.pi / 2 / cosine.size
    covered = (density * cosine * np.sqrt(1 - cosine**2)).sum() * step * 2 * np.pi
    assert covered == pytest.approx(1, rel=2e-3 if COMPILED else 0.5)


def test_visible_facets_have_their_density() -> None:
    alpha, view = 0.4, direction(55, 20)
    rng = np.random.default_rng(0)
    count = 50000 if COMPILED else 2000
    found = np.array([sample_facet(view, alpha, *rng.uniform(size=2)) for _ in range(count)])
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, rtol=1e-12)
    # mean of a function of the facets = its integral over D (v.h) G1 / cos
    n = 400
    c = (np.arange(n) + 0.5) / n
    a = (np.arange(n) + 0.5) / n * 2 * np.pi
    cosine, angle = (part.ravel() for part in np.meshgrid(c, a, indexing="ij"))
    sine = np.sqrt(1 - cosine**2)
    half = np.stack([sine * np.cos(angle), sine * np.sin(angle), cosine], axis=1)
    shadow = 1 / (1 + facet_lambda(view[2], alpha))
    density = alpha**2 / (np.pi * ((alpha**2 - 1) * cosine**2 + 1) ** 2)
    density *= np.clip(half @ view, 0, None) * shadow / view[2] * 2 * np.pi / n**2
    assert density.sum() == pytest.approx(1, abs=1e-3)
    expected = np.stack([density @ half, density @ half**2])
    spread = 4 / np.sqrt(count)
    np.testing.assert_allclose(np.stack([found.mean(axis=0), (found**2).mean(axis=0)]), expected, atol=spread)


@pytest.mark.parametrize(("zenith", "azimuth"), [(40, 180), (43, 180), (40, 150), (20, 180), (75, 180)])
def test_the_coat_is_the_textbook_glint(zenith: float, azimuth: float) -> None:
    view, light = direction(40), direction(zenith, azimuth)
    lobes = lobes_at(materials((1.5, 0.1)), 0, view, False)
    expected = np.pi * glint_by_angles(np.array(view), np.array(light), 1.5, 0.1)
    assert sun_weights(lobes, light)[1] == pytest.approx(expected, rel=1e-9)
    widened = lobes_at(materials((1.5, 0.1)), 0, view, True)
    expected = np.pi * glint_by_angles(np.array(view), np.array(light), 1.5, 0.3)
    assert sun_weights(widened, light)[1] == pytest.approx(expected, rel=1e-9)


def test_the_base_is_a_diffuse_surface_under_glass() -> None:
    light = direction(50)
    for zenith in (0, 30, 70):
        view = direction(zenith)
        base, _, flakes = sun_weights(lobes_at(materials((1.5, 0.1)), 0, view, False), light)
        through = np.prod([1 - fresnel_by_angles(np.array(side[2]), 1.5) for side in (view, light)])
        fi = float(internal_reflectance(1.5))
        assert base == pytest.approx(through / (1.5**2 * (1 - fi)) * light[2], rel=1e-9)
        assert flakes == 0
    assert sun_weights(lobes_at(materials(None), 0, direction(70), False), light) == (light[2], 0.0, 0.0)


def test_flakes_are_mirrors_met_by_refracted_light() -> None:
    view, light = direction(25), direction(40, 160)
    lobes = lobes_at(materials((1.5, 0.1), flakes=0.4), 0, view, False)
    flat = [np.array(side[:2]) / 1.5 for side in (view, light)]
    inner = [np.append(side, np.sqrt(1 - side @ side)) for side in flat]
    through = np.prod([1 - fresnel_by_angles(np.array(side[2]), 1.5) for side in (view, light)])
    half = sum(inner) / np.linalg.norm(sum(inner))
    full = glint_by_angles(inner[0], inner[1], 1.5, 0.35) / fresnel_by_angles(np.array(inner[0] @ half), 1.5)
    expected = 0.4 * np.pi * through / 1.5**2 * full / inner[1][2] * light[2]
    base, _, flakes = sun_weights(lobes, light)
    assert flakes == pytest.approx(expected, rel=1e-9)
    alone = sun_weights(lobes_at(materials((1.5, 0.1)), 0, view, False), light)[0]
    assert base == pytest.approx(0.6 * alone)


@pytest.mark.parametrize("zenith", [0, 35, 70])
def test_paths_follow_the_lobes_as_the_sun_sees_them(zenith: float) -> None:
    """What is scattered anywhere equals the integral of what is seen of a sun from there, lobe by lobe."""
    lobes = lobes_at(materials((1.5, 0.15), flakes=0.4), 0, direction(zenith, 15), False)
    rng = np.random.default_rng(2)
    count = 40000 if COMPILED else 1500
    sums = np.zeros(3)
    for _ in range(count):
        kind, towards, weight = scatter(lobes, *rng.uniform(size=3))
        if kind != ENDED:
            sums[[BASE, COAT, FLAKES].index(kind)] += weight
            assert np.linalg.norm(towards) == pytest.approx(1)
    n = 150 if COMPILED else 60
    c = (np.arange(n) + 0.5) / n
    a = (np.arange(2 * n) + 0.5) / n * np.pi
    expected = np.zeros(3)
    for cosine in c:
        sine = np.sqrt(1 - cosine**2)
        for angle in a:
            expected += sun_weights(lobes, (sine * np.cos(angle), sine * np.sin(angle), cosine))
    expected *= 2 * np.pi / (2 * n * n) / np.pi
    np.testing.assert_allclose(sums / count, expected, rtol=0.02 if COMPILED else 0.3, atol=2e-3)
    assert sums.sum() / count <= 1.001


def test_paths_follow_a_coat_as_it_is_when_a_sun_sees_it_widened() -> None:
    given = materials((1.5, 0.15), flakes=0.2), 0, direction(50, 15)
    for draw in np.random.default_rng(4).uniform(size=(20, 3)):
        assert scatter(lobes_at(*given, True), *draw) == scatter(lobes_at(*given, False), *draw)


def test_frames_are_right_handed_everywhere() -> None:
    rng = np.random.default_rng(3)
    normals = [*rng.normal(size=(50, 3)), [0, 0, 1], [0, 0, -1], [1e-9, 0, -1], [1, 0, 0]]
    for normal in normals:
        z = np.array(normal) / np.linalg.norm(normal)
        frame = np.array(frame_of(tuple(z)))
        np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(frame) == pytest.approx(1)
        a = rng.normal(size=3)
        np.testing.assert_allclose(from_frame(frame_of(tuple(z)), in_frame(frame_of(tuple(z)), a)), a)
