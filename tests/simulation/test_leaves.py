"""Thin plates that pass light: two streams, two Lambert lobes, and leaves in a car park."""

import numpy as np
import pytest
from support.traced_scenes import FEW_BANDS, flat_light

import hyperpaint as hp
from hyperpaint.simulation.rendering.car_parks import car_park
from hyperpaint.simulation.rendering.materials import Material, hemispherical_reflectance
from hyperpaint.simulation.rendering.platforms import pushbroom
from hyperpaint.simulation.rendering.scene import Scene, plane
from hyperpaint.simulation.rendering.scene_spectra import LEAF_INDEX, leaf_optics, spectrum_of

NM = np.arange(400.0, 1001.0, 25.0)
REFLECTED, PASSED = 0.45, 0.40
PLATE = {"r": (np.array([300.0, 1100.0]), np.full(2, REFLECTED)),
         "t": (np.array([300.0, 1100.0]), np.full(2, PASSED)),
         "k": (np.array([300.0, 1100.0]), np.zeros(2))}  # fmt: skip


def test_two_plates_are_one_upon_another() -> None:
    # Of diffuse light between them, R = R1 + T1 r t / (1 - r r) and T = T1 t / (1 - r r)
    passed = np.array([0.2, 0.7, 0.95])
    top, through = leaf_optics(passed, layers=1.0)
    both, under = leaf_optics(passed, layers=2.0)
    outside = 1.0 - hemispherical_reflectance(LEAF_INDEX)
    back = 1.0 - outside / LEAF_INDEX**2
    t = outside * passed * (1.0 - back) / (1.0 - (back * passed) ** 2)
    r = 1.0 - outside + back * passed * t
    np.testing.assert_allclose(under, through * t / (1.0 - r**2), rtol=1e-9)
    np.testing.assert_allclose(both, top + through * r * t / (1.0 - r**2), rtol=1e-9)


def test_a_leaf_without_absorption_keeps_all_light() -> None:
    for layers in (1.0, 1.55, 3.0):
        reflected, transmitted = leaf_optics(np.array([1.0 - 1e-12, 1.0]), layers)
        np.testing.assert_allclose(reflected + transmitted, 1.0, rtol=1e-5)


def test_a_leaf_passes_half_of_the_near_infrared_and_no_red() -> None:
    reflectance, transmittance = (spectrum_of(name)(NM) for name in ("leaf", "leaf_through"))
    assert (reflectance + transmittance < 1.0).all()
    near_infrared, red = NM == 850.0, NM == 675.0
    assert 0.42 < reflectance[near_infrared][0] < 0.55
    assert 0.38 < transmittance[near_infrared][0] < 0.55
    assert transmittance[red][0] < 0.06
    assert transmittance[NM == 550.0][0] > 1.5 * transmittance[red][0]


def plate_over_black(below: str = "k") -> Scene:
    # Return a plate of 200 m at a height of 2 m over black or other ground
    plate = Material("plate", "r", "leaf", transmittance="t")
    return Scene.join([plane(400.0, Material("ground", below)),
                       plane(200.0, plate, centre=(0.0, 0.0, 2.0), instance="plate")])  # fmt: skip


@pytest.mark.slow
def test_a_plate_reflects_from_above_and_passes_from_below() -> None:
    light = flat_light(sky=0.0, direction=(40.0, 150.0))
    over = hp.simulation.trace(
        plate_over_black(), pushbroom(4, 4, altitude=20.0, ground_sample=0.5), [(40.0, 150.0)], samples=4
    )
    seen = hp.simulation.relight(over, FEW_BANDS, spectra=PLATE, atmosphere=light).reflectance
    np.testing.assert_allclose(seen, REFLECTED, rtol=1e-6)
    # the camera flies below the plate, over white ground that the plate lights
    scene = plate_over_black("w")
    traced = hp.simulation.trace(
        scene, pushbroom(4, 4, altitude=1.0, ground_sample=0.05), [(40.0, 150.0)], samples=4000, depth=3
    )
    lit = hp.simulation.relight(
        traced, FEW_BANDS, spectra={**PLATE, "w": (np.array([300.0, 1100.0]), np.ones(2))}, atmosphere=light
    ).reflectance
    # three scatterings: ground and plate, no second time
    assert float(lit.mean()) == pytest.approx(PASSED, rel=0.03)


@pytest.mark.slow
def test_a_plate_that_takes_nothing_over_white_ground_gives_all_back() -> None:
    # Expected: r + t^2 / (1 - r) = 1 with r + t = 1, of light that goes to and fro; over nothing r alone
    flight = pushbroom(4, 4, altitude=20.0, ground_sample=0.5)
    ones = np.array([300.0, 1100.0]), np.ones(2)
    nothing_lost = {**PLATE, "t": (ones[0], np.full(2, 1.0 - REFLECTED)), "k": ones}
    alone = plane(200.0, Material("plate", "r", "leaf", transmittance="t"))
    light = flat_light(sun=0.0, sky=1.0, direction=(40.0, 150.0))
    for scene, expected in ((plate_over_black(), 1.0), (alone, REFLECTED)):
        traced = hp.simulation.trace(scene, flight, [(40.0, 150.0)], samples=64, depth=16)
        seen = hp.simulation.relight(traced, FEW_BANDS, spectra=nothing_lost, atmosphere=light).reflectance
        np.testing.assert_allclose(seen.mean(), expected, rtol=0.02)


def test_leaves_of_a_real_car_park_shine_through() -> None:
    leaf = {one.name: one for one in car_park(length=15.0, fleet="real", leaves=20).materials}["leaf"]
    assert leaf.transmittance == "leaf_through"
    assert {one.name: one for one in car_park(length=15.0, leaves=20).materials}["leaf"].transmittance == ""
