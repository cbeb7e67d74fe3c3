"""Gloss and flop against sums over the tracer's own reflection, and against known readings."""

from dataclasses import replace

import numpy as np
import pytest

from hyperpaint.simulation.rendering.materials import (
    Coat,
    Flakes,
    Material,
    coat_of_gloss,
    coated_reflectance,
    flakes_of_flop,
    flop_index,
    gloss_units,
    reflectance_factor,
)
from hyperpaint.simulation.rendering.scene_spectra import generate_paint, spectrum_of

VISIBLE = np.array([380.0, 780.0])


def glossmeter(coat: Coat, steps: int = 150) -> float:
    # Return gloss units by a sum of the BRDF over receptor and source: ISO 2813 at 20 degrees, flat coat
    # GGX in tangents and Fresnel by Snell's angles, of directions on a grid: nothing of the package
    angle = np.radians(20.0)
    half = 0.5 * np.radians([1.8, 3.6])
    a, b = (((np.arange(steps * k) + 0.5) / (steps * k) * 2 - 1) * h for k, h in ((2, half[0]), (4, half[1])))
    a, b = (part.ravel() for part in np.meshgrid(a, b, indexing="ij"))
    seen = np.stack([np.sin(angle + a) * np.cos(b), np.sin(b), np.cos(angle + a) * np.cos(b)], axis=1)
    cell = np.cos(b) * (2 * half[0] / (2 * steps)) * (2 * half[1] / (4 * steps))

    def mirrored(index: float, cosine: np.ndarray) -> np.ndarray:
        outside = np.arccos(cosine)
        inside = np.arcsin(np.sin(outside) / index)
        s = (np.cos(outside) - index * np.cos(inside)) / (np.cos(outside) + index * np.cos(inside))
        p = (index * np.cos(outside) - np.cos(inside)) / (index * np.cos(outside) + np.cos(inside))
        return (s**2 + p**2) / 2

    flux, count = 0.0, 7
    for i in range(count):
        for j in range(count):
            c, d = (((k + 0.5) / count - 0.5) * np.radians(width) for k, width in ((i, 0.75), (j, 2.5)))
            light = np.array([-np.sin(angle + c) * np.cos(d), -np.sin(d), np.cos(angle + c) * np.cos(d)])
            normal = seen + light
            normal /= np.linalg.norm(normal, axis=1, keepdims=True)
            tan2 = (1 - normal[:, 2] ** 2) / normal[:, 2] ** 2
            density = coat.roughness**2 / (np.pi * normal[:, 2] ** 4 * (coat.roughness**2 + tan2) ** 2)
            brdf = mirrored(coat.index, normal @ light) * density / (4 * light[2] * seen[:, 2])
            flux += float((brdf * seen[:, 2] * cell).sum()) / count**2
    return 100.0 * flux / float(mirrored(1.567, np.array(np.cos(angle))))


@pytest.mark.slow
@pytest.mark.parametrize("roughness", [0.004, 0.01, 0.05])
def test_gloss_is_the_flux_into_the_receptor(roughness: float) -> None:
    flat = Coat(1.5, roughness, 0.0)
    assert gloss_units(flat) == pytest.approx(glossmeter(flat), rel=0.02, abs=0.1)


def test_a_topcoat_is_glossy_and_orange_peel_costs_little() -> None:
    assert 80.0 <= gloss_units(Coat()) <= 100.0
    assert 0.0 < gloss_units(replace(Coat(), waviness=0.0)) - gloss_units(Coat()) < 2.0
    assert gloss_units(Coat(1.5, 0.0, 0.0)) == pytest.approx(82.3, abs=0.4)  # F(1.5) / F(1.567) at 20 degrees
    assert gloss_units(Coat(1.5, 0.05, 0.0)) == pytest.approx(4.9, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("gloss", [5.0, 40.0, 70.0, 80.0])
def test_a_coat_of_a_gloss_has_it(gloss: float) -> None:
    assert gloss_units(coat_of_gloss(gloss)) == pytest.approx(gloss, abs=0.01)
    assert gloss_units(coat_of_gloss(90.0, 1.55)) == pytest.approx(90.0, abs=0.01)


def test_a_solid_paint_reads_as_its_base_under_glass() -> None:
    solid = Material("m", "m", "paint", Coat())
    body = coated_reflectance([0.2, 0.7])
    for view, geometry in ((0.0, "0/0"), (45.0, "0/45")):
        read = reflectance_factor(solid, body, light=0.0, view=view)
        mirror = coated_reflectance([0.2, 0.7], geometry=geometry)  # type: ignore[arg-type]
        np.testing.assert_allclose(read, mirror, rtol=1e-4)
    assert 0.0 <= flop_index(solid, VISIBLE, 0.3) < 0.3  # light at grazing angles stays outside


@pytest.mark.parametrize("share", [0.3, 0.5, 0.7])
@pytest.mark.parametrize("flop", [3.0, 7.0, 8.0])
def test_flakes_of_a_flop_have_it(flop: float, share: float) -> None:
    paint = Material("m", "m", "paint", Coat(), Flakes(share))
    lobe = flakes_of_flop(flop, paint, VISIBLE, 0.1, 0.85)
    assert lobe.share == share
    assert flop_index(replace(paint, flakes=lobe), VISIBLE, 0.1, 0.85) == pytest.approx(flop, abs=0.05)


def test_a_flop_that_no_lobe_gives_becomes_the_nearest() -> None:
    paint = Material("m", "m", "paint", Coat(), Flakes(0.15))
    most = flakes_of_flop(16.0, paint, VISIBLE, 0.6, 0.85, nearest=True)
    assert flop_index(replace(paint, flakes=most), VISIBLE, 0.6, 0.85) < 4.0


def test_the_index_is_almans_formula_of_three_lightnesses() -> None:
    paint = Material("m", "m", "paint", Coat(), Flakes(0.5, 0.2))
    near, face, far = (
        116 * np.cbrt(float(reflectance_factor(paint, 0.1, 0.85, light=45.0, view=view, azimuth=side))) - 16
        for view, side in ((30.0, 180.0), (0.0, 180.0), (65.0, 0.0))
    )
    assert flop_index(paint, VISIBLE, 0.1, 0.85) == pytest.approx(2.69 * (near - far) ** 1.11 / face**0.86)


@pytest.mark.parametrize("family", ["metallic", "pearl"])
def test_generated_paints_flop_as_paints_do(family: str) -> None:
    grid = np.linspace(380.0, 780.0, 41)
    flops = []
    for number in range(60):
        paint = generate_paint(family, number)
        assert paint.flakes is not None
        flakes = spectrum_of(paint.flakes.spectrum)(grid)
        flops.append(flop_index(paint.material(), grid, paint.reflectance(grid), flakes))
        assert gloss_units(paint.coat) > 70.0
    assert 3.0 < min(flops) < max(flops) < 17.0
    assert 7.0 < np.median(flops) < 12.0
